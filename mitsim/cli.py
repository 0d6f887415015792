"""The command line: parse, dispatch, print. No physics; heavy imports happen inside the verb that needs them."""

from __future__ import annotations

import errno
import importlib
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import mitsim
from mitsim.core.errors import MitsimError
from mitsim.core.worker import INTERRUPTED, RESUME, advise, end_stopped

app = typer.Typer(
    name="mitsim",
    help="A physically based simulator of coded-illumination lensless imaging.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

Scene = Annotated[Path, typer.Argument(help="scene XML, or the name of a shipped scene", metavar="SCENE")]
Json = Annotated[bool, typer.Option("--json", help="one JSON object on stdout, nothing else there")]
Quiet = Annotated[bool, typer.Option("--quiet", help="no progress bar")]
Variant = Annotated[
    str,
    typer.Option(
        help="Mitsuba variant: llvm_ad_mono, llvm_ad_rgb or llvm_ad_spectral", callback=lambda name: _variant(name)
    ),
]
Seed = Annotated[int, typer.Option(help="root of every random stream")]
Accuracy = Annotated[float, typer.Option(help="relative rms error of the expected frames")]
Camera = Annotated[Path | None, typer.Option(help="camera electronics, TOML", metavar="FILE.toml")]
ProjectorFile = Annotated[Path | None, typer.Option("--projector", help="projector, TOML", metavar="FILE.toml")]
Defines = Annotated[list[str] | None, typer.Option("-D", help="set a <default> of the scene", metavar="NAME=VALUE")]
Outside = Annotated[bool, typer.Option("--allow-outside-files", help="let the scene read files outside its own folder")]
Effects = Annotated[str, typer.Option("--effects", help="override the plan: +NAME,-NAME", metavar="+NAME,-NAME")]
MaxSeconds = Annotated[float, typer.Option("--max-seconds", help="refuse work that would take longer")]
MaxMemory = Annotated[
    float | None, typer.Option("--max-memory", help="refuse work that would take more [what is free]", metavar="GIB")
]
Patterns = Annotated[str, typer.Option(help="uniform, dots:K, hadamard:K or random:K")]


def run() -> None:
    """Serve the command line in this process: exit 0 done, 1 done but flagged, 2 refused, 128 + n ended by signal n."""
    try:
        code = app(standalone_mode=False)
    except MitsimError as error:
        _fail(str(error))
    except (typer.Abort, KeyboardInterrupt):
        code = INTERRUPTED
    except MemoryError:
        _fail("out of memory; close other programs, or ask for fewer pixels, frames or less accuracy")
    except OSError as error:
        # What no check foresees: a full disk, a name too long, a file taken away. Other errors are faults of ours.
        if error.filename is None and error.errno not in _NO_ROOM:
            raise
        _fail(f"{error.filename or 'output'}: {error.strerror}; choose another place")
    except Exception as error:
        # Usage errors of click (wherever typer keeps it) carry their own one-line message.
        if hasattr(error, "format_message") and hasattr(error, "exit_code"):
            _fail(_usage(error))
        raise
    if code == INTERRUPTED:  # some versions of typer turn Control-C into this status without a word
        end_stopped()
    sys.exit(code if isinstance(code, int) else 0)


def _usage(error: Any) -> str:
    """Click's sentence about a command line, with the value that a typer which checks with pydantic leaves out."""
    message: str = error.format_message()
    checked = getattr(error.__cause__, "errors", None)
    if checked is not None:
        message += f"; got {checked()[0].get('input')!r}"
    # Without arguments the help has been shown already and says what to do.
    return message or "give one of the commands above"


def _fail(message: str) -> None:
    print(f"mitsim: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(2)


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="print the version and exit")] = False,
) -> None:
    if version:
        print(mitsim.__version__)
        raise typer.Exit


@app.command()
def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="folder of the demo")] = Path("demo-output"),
    scene: Annotated[Path | None, typer.Option(help="another scene than scenes/photograph")] = None,
    accuracy: Accuracy = 1e-3,
    seed: Seed = 0,
    variant: Variant = "llvm_ad_mono",
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """The main job on a shipped scene: plan, capture, calibrate, reconstruct, report.html."""
    from mitsim.study.demo import FAMILIES
    from mitsim.study.demo import demo as run_demo

    with _work(output, quiet or as_json) as progress:
        path = _scene(scene) if scene is not None else None
        result = run_demo(output, path, variant, accuracy, seed, progress)
    lines = [
        f"{FAMILIES[name]:>14}: {value:5.1f} dB rendered and calibrated, {result.psnr_ideal[name]:5.1f} dB idealised"
        for name, value in result.psnr.items()
    ]
    lines += [f"49 dots beat uniform by {result.gain_db:.1f} dB.", f"Report: {result.report}"]
    return _finish(as_json, asdict(result), lines, result.warnings)


@app.command()
def plan(
    scene: Scene,
    patterns: Patterns = "dots:7",
    accuracy: Accuracy = 1e-3,
    seed: Seed = 0,
    camera: Camera = None,
    projector: ProjectorFile = None,
    define: Defines = None,
    outside: Outside = False,
    effects: Effects = "",
    variant: Variant = "llvm_ad_mono",
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """What will be simulated, why, and what it costs, before any long work."""
    from mitsim.capture.cost import frames_cost
    from mitsim.capture.light import make_plan
    from mitsim.capture.plan import parse_effects
    from mitsim.capture.run import plan_block

    forced = parse_effects(effects)
    bench = _bench(scene, variant, camera, projector, define, outside)
    labels, weights = bench.family(patterns, seed).classes()
    made = make_plan(bench, labels, weights, accuracy, seed, forced)
    block = plan_block(made)
    payload = {key: block[key] for key in ("effects", "accuracy", "predicted_seconds", "settings", "warnings")}
    payload |= {"sampling_target": made.sampling_target, "systematic_error": made.systematic_error}
    cost = frames_cost(bench, made.settings, weights.shape[1], len(weights))
    payload |= {"predicted_memory_bytes": cost.memory_bytes, "predicted_disk_bytes": cost.disk_bytes}
    if not as_json:
        _print_plan(made, cost)
    return _finish(as_json, payload, [], made.warnings)


@app.command()
def capture(
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="run folder to make", metavar="RUN")],
    patterns: Patterns,
    accuracy: Accuracy = 1e-3,
    camera: Camera = None,
    projector: ProjectorFile = None,
    exposure: Annotated[str, typer.Option(help="seconds a frame, or auto", metavar="auto|SECONDS")] = "auto",
    exposure_fraction: Annotated[float, typer.Option(help="brightest pixel, as a part of full well")] = 0.8,
    effects: Effects = "",
    noise_fraction: Annotated[
        float | None, typer.Option(help="stop sampling at this part of the sensor's noise", metavar="PART")
    ] = None,
    seed: Seed = 0,
    define: Defines = None,
    outside: Outside = False,
    resume: Annotated[bool, typer.Option("--resume", help="finish an interrupted run")] = False,
    variant: Variant = "llvm_ad_mono",
    max_seconds: MaxSeconds = 86400.0,
    max_memory: MaxMemory = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Render, expose and write one frame for each pattern."""
    from mitsim.capture.exposer import Exposure
    from mitsim.capture.plan import parse_effects
    from mitsim.capture.run import capture as run_capture

    forced, limits = parse_effects(effects), _limits(max_seconds, max_memory)
    advise(RESUME)
    chosen = Exposure(_number("--exposure", exposure, "auto"), exposure_fraction)
    with _work(output, quiet or as_json) as progress:
        bench = _bench(scene, variant, camera, projector, define, outside)
        result = run_capture(
            bench, patterns, output, accuracy, seed, chosen, resume, progress, forced, noise_fraction, limits
        )
    payload = {key: value for key, value in asdict(result).items() if key != "plan"}
    seconds = result.seconds
    lines = [
        f"{result.frames} frames of {result.shape[0]}x{result.shape[1]} in {seconds['total']:.1f} s "
        f"(transport {seconds['transport']:.2f}, optics {seconds['optics']:.2f}, sensor {seconds['sensor']:.2f}, "
        f"write {seconds['write']:.2f}): {result.output}",
        f"Monte Carlo error {result.mc_error:.1e}, {result.mc_to_sensor_noise:.0%} of the sensor's noise; "
        f"exposure {result.exposure_s:.3g} s a frame",
    ]
    return _finish(as_json, payload, lines, result.warnings)


@app.command()
def calibrate(
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="calibration folder to make", metavar="CAL")],
    accuracy: Accuracy = 1e-3,
    camera: Camera = None,
    projector: ProjectorFile = None,
    recipe: Annotated[Path | None, typer.Option(help="session recipe, TOML", metavar="FILE.toml")] = None,
    seed: Seed = 0,
    define: Defines = None,
    outside: Outside = False,
    resume: Annotated[bool, typer.Option("--resume", help="finish an interrupted session")] = False,
    variant: Variant = "llvm_ad_mono",
    max_seconds: MaxSeconds = 86400.0,
    max_memory: MaxMemory = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Render a Hadamard session on a white board and estimate the camera's factors."""
    from mitsim.capture.calibrate import calibrate as run_calibration
    from mitsim.core.job import Job
    from mitsim.rig.recipe import load_recipe

    limits = _limits(max_seconds, max_memory)
    advise(RESUME)
    with _work(output, quiet or as_json) as progress:
        bench = _bench(scene, variant, camera, projector, define, outside)
        job = Job(progress=progress, limits=limits)
        result = run_calibration(bench, load_recipe(recipe), accuracy, seed, output, resume, job).result
    lines = [
        f"{result.frames} frames of {result.n} stripes in {result.seconds['total']:.1f} s: {result.output}",
        f"separability residual {result.separability_residual:.2%} ({result.noise_free_residual:.1e} without noise), "
        f"factor error {result.phi_error:.1e}, condition {result.condition:.2e}",
    ]
    return _finish(as_json, asdict(result), lines, result.warnings)


@app.command()
def reconstruct(
    run: Annotated[Path, typer.Argument(help="folder of `mitsim capture`", metavar="RUN")],
    calibration: Annotated[Path, typer.Option(help="folder of `mitsim calibrate`", metavar="CAL")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="folder for the image [RUN/reconstruction]")
    ] = None,
    lam: Annotated[str, typer.Option("--lambda", help="regularisation, or auto", metavar="auto|VALUE")] = "auto",
    method: Annotated[str, typer.Option(help="tikhonov or tv")] = "tikhonov",
    variant: Variant = "llvm_ad_mono",
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Recover the image from frames and a calibration alone."""
    from mitsim.study.quality import reconstruct as run_reconstruct
    from mitsim.study.quality import summary

    value: float | Literal["auto"] = _number("--lambda", lam, "auto", least=0.0) if lam != "auto" else "auto"  # type: ignore[assignment]
    output = output or run / "reconstruction"
    with _work(output, silent=True):
        result = run_reconstruct(run, calibration, output, value, method)
    lines = [result.status]
    if result.psnr is not None and result.ssim is not None:
        lines.append(f"PSNR {result.psnr:.2f} dB, SSIM {result.ssim:.3f}")
    lines.append(
        f"lambda {result.lam:.3g}, rank {result.rank}, condition {result.condition:.3g}, "
        f"residual {result.residual:.1e}: {result.output}"
    )
    return _finish(as_json, summary(result), lines, () if result.ok else (result.status,))


@app.command()
def render(
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="frame to write", metavar="FRAME.exr")],
    estimator: Annotated[str, typer.Option(help="reference or factored")] = "reference",
    spp: Annotated[int, typer.Option(help="samples a pixel of the reference")] = 64,
    accuracy: Accuracy = 1e-3,
    seed: Seed = 0,
    define: Defines = None,
    outside: Outside = False,
    effects: Effects = "",
    variant: Variant = "llvm_ad_mono",
    max_seconds: MaxSeconds = 86400.0,
    max_memory: MaxMemory = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Expected irradiance under the scene's own light, by either estimator."""
    from mitsim.capture.plan import parse_effects
    from mitsim.capture.render import render as run_render

    if output.suffix.lower() != ".exr":
        raise MitsimError(f"--output {output}: the frame is an OpenEXR file; give a name that ends in .exr")
    limits = _limits(max_seconds, max_memory)
    with _work(output, quiet or as_json) as progress:
        result = run_render(
            _scene(scene),
            output,
            estimator,
            spp,
            accuracy,
            seed,
            variant,
            _defines(define),
            progress,
            parse_effects(effects),
            limits,
            outside,
        )
    lines = [
        f"{result.estimator}: mean irradiance {result.mean:.4e} W/m^2, relative noise {result.mc_error:.1e}, "
        f"{result.seconds:.2f} s: {result.output}"
    ]
    return _finish(as_json, asdict(result), lines, result.warnings)


@app.command()
def study(
    name: Annotated[str, typer.Argument(help="accuracy or diffraction", metavar="NAME")],
    scene: Annotated[Path, typer.Argument(help="scene XML, or the name of a shipped scene")] = Path("photograph"),
    output: Annotated[Path, typer.Option("-o", "--output", help="folder of the study")] = Path("study-output"),
    patterns: Patterns = "dots:7",
    seed: Seed = 0,
    define: Defines = None,
    outside: Outside = False,
    variant: Variant = "llvm_ad_mono",
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """An experiment with plots and JSON: what `accuracy` costs in time, what `diffraction` at the mask does."""
    from mitsim.study import STUDIES

    if name not in STUDIES:
        raise MitsimError(f"study {name!r}: this version has {', '.join(STUDIES)}")
    with _work(output, quiet or as_json) as progress:
        module, function = STUDIES[name].split(":")
        run_study = getattr(importlib.import_module(module), function)
        result = run_study(_bench(scene, variant, None, None, define, outside), output, patterns, seed, progress)
    return _finish(as_json, result.payload(), result.lines(), ())


@app.command()
def doctor(
    variant: Variant = "llvm_ad_mono",
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """What works on this machine, and the one command that mends what does not."""
    from mitsim.core.environment import doctor as run_doctor

    checks = run_doctor()
    lines = [
        f"{'ok  ' if check.ok else 'FAIL'} {check.name}: {check.detail}"
        + (f"\n     mend with: {check.remedy}" if check.remedy and not check.ok else "")
        for check in checks
    ]
    bad = tuple(f"{check.name}: {check.detail}" for check in checks if not check.ok)
    return _finish(as_json, {"checks": [asdict(check) for check in checks], "ok": not bad}, lines, bad)


# ---- helpers ---------------------------------------------------------------------------------------------------------


def _scene(scene: Path) -> Path:
    """The path as given, or the shipped scene of that name."""
    if scene.suffix or scene.exists() or len(scene.parts) > 1:
        return scene / "scene.xml" if scene.is_dir() else scene
    from mitsim.core.configuration import shipped

    folder = shipped("scenes")
    if (folder / scene / "scene.xml").is_file():
        return folder / scene / "scene.xml"
    known = ", ".join(sorted(path.parent.name for path in folder.glob("*/scene.xml")))
    raise MitsimError(f"{scene}: no such scene file, and no shipped scene of that name; shipped are {known}")


def _variant(name: str) -> str:
    """The name, refused when it is none that light can be traced in; every verb checks it alike."""
    from mitsim.core.environment import VARIANTS

    # CUDA has the same kinds; whether there is a GPU shows when the variant is loaded.
    if name.replace("cuda_", "llvm_", 1) not in VARIANTS:
        raise MitsimError(f"--variant {name!r}: use {', '.join(VARIANTS)}")
    return name


def _bench(
    scene: Path,
    variant: str,
    camera: Path | None,
    projector: Path | None,
    define: Sequence[str] | None,
    outside: bool,
) -> Any:
    from mitsim.capture.bench import open_bench

    return open_bench(_scene(scene), variant, camera, projector, _defines(define), outside=outside)


def _defines(define: Sequence[str] | None) -> dict[str, str]:
    pairs = {}
    for text in define or ():
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise MitsimError(f"-D {text!r}: give NAME=VALUE")
        pairs[name] = value
    return pairs


def _limits(seconds: float, gibibytes: float | None) -> Any:
    from mitsim.core.resources import Limits

    return Limits(seconds, None if gibibytes is None else gibibytes * 2**30)


def _number(option: str, text: str, word: str, least: float | None = None) -> float | None:
    """The number in ``text``, or None for ``word``."""
    if text == word:
        return None
    try:
        value = float(text)
    except ValueError:
        raise MitsimError(f"{option} {text!r}: give a number or {word}") from None
    if least is not None and not least <= value < float("inf"):
        raise MitsimError(f"{option} {text}: give a finite number of at least {least:g}, or {word}")
    return value


@contextmanager
def _work(output: Path, silent: bool) -> Iterator[Callable[[str, float], None]]:
    """A progress bar while the context lasts; a folder ``output`` left empty by a refusal or Control-C is removed."""
    existed = output.exists()
    try:
        with _progress(silent) as progress:
            yield progress
    except (MitsimError, KeyboardInterrupt):
        if not existed:
            with suppress(OSError):
                output.rmdir()
        raise


@contextmanager
def _progress(silent: bool) -> Iterator[Callable[[str, float], None]]:
    """A progress bar on stderr; nothing when asked to be quiet, or when stderr is no terminal."""
    if silent or not sys.stderr.isatty():
        yield lambda stage, fraction: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = TextColumn("{task.description:<18}"), BarColumn(), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda stage, fraction: bar.update(task, description=stage, completed=fraction)


def _print_plan(made: Any, cost: Any) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"Effect plan at accuracy {made.accuracy:g}")
    for heading in ("effect", "state", "reason", "error if off", "seconds"):
        table.add_column(heading, justify="right" if heading in ("error if off", "seconds") else "left")
    for effect in made.effects:
        error = "-" if effect.error_if_off is None else f"{effect.error_if_off:.1e}"
        table.add_row(effect.name, effect.state, effect.reason, error, f"{effect.seconds:.2f}")
    console = Console()
    console.print(table)
    console.print(f"Predicted time for transport and optics: {made.predicted_seconds:.2f} s")
    console.print(f"At most {cost.memory_bytes / 2**30:.2g} GiB of memory, {cost.disk_bytes / 2**20:.3g} MiB of disk")


def _finish(as_json: bool, payload: Any, lines: Sequence[str], warnings: Sequence[str]) -> int:
    """Print the result; exit status 1 when there are warnings."""
    if as_json:
        from mitsim.core.manifest import plain

        print(json.dumps(plain(payload), allow_nan=False))
    else:
        for line in lines:
            print(line)
    for warning in warnings:
        print(f"mitsim: warning: {warning}", file=sys.stderr)
    return 1 if warnings else 0

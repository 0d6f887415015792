"""Verbs on frames alone, without a scene: `mitsim reconstruct`, `characterise` and `sense`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import mitsim
from mitsim.cli.help_page import DEVICES, QUALITY, WHAT
from mitsim.cli.options import (
    Common,
    ExposureFraction,
    Pictured,
    Seed,
    complete_camera,
    completing,
    given_of,
    is_given,
    number_of,
    option,
    option_name,
    refuse_unused,
    verb,
)
from mitsim.cli.report_verb import finish_folder, finish_frame
from mitsim.cli.screen import finish
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.spectral_manifests import (
    CALIBRATION,
    JOINT,
    RUN,
    check_way,
    is_coloured,
    is_mosaic,
    read_colours,
    read_mosaic,
)
from mitsim.reconstruct.request import MARKOV, METHODS, MODEL, TIKHONOV

if TYPE_CHECKING:
    from mitsim.report.colour_image import ColourImage
    from mitsim.report.reconstruct_run import Judged

# ---- images of frames ------------------------------------------------------------------------------------------------


def method_names() -> str:
    """Methods of solving, as the help lists them."""
    notes = {MARKOV: f"{MARKOV} (neighbouring pixels alike: for noisy frames)"}
    return ", ".join([*(notes.get(name, name) for name in METHODS), f"or MODEL{MODEL}, a file of mitsim train"])


@dataclass(frozen=True)
class Solving:
    """How an image is solved for."""

    PANEL = QUALITY

    lam: str = option("auto", "regularisation, or auto", "--lambda", metavar="auto|VALUE")
    method: str = option(TIKHONOV, method_names(), metavar="NAME|MODEL.pt", autocompletion=completing(lambda: METHODS))
    focus: str | None = option(
        None,
        "depth of the scene; auto: found; map: one for each pixel, by dots; the calibrated one if not given",
        metavar="auto|MM|map",
    )
    depth_range: str | None = option(
        None,
        "nearest and farthest depth that auto and map look for; 1/z within a quarter of the calibrated one's "
        "if not given",
        metavar="A:B",
    )
    bounds: str | None = option(
        None,
        "least and largest number of the image, by nonnegative and tv; either may be left out; if not given, 0: of "
        "nonnegative and with --psf",
        metavar="LOW:HIGH",
    )
    iterations: int | None = option(
        None, "most steps of nonnegative and tv; 5000, and 300 with --psf, if not given", min=1, metavar="N"
    )
    margin: int = option(
        0, "cells round the window that are solved for too: they take up light from outside it", min=0, metavar="K"
    )

    def read(self) -> dict[str, Any]:
        """The options as the solver takes them, with numbers for words; MitsimError for words that are none."""
        method: Any = self.method
        if self.method.endswith(MODEL):
            from mitsim.learn.verbs import load_network

            method = load_network(self.method)
        return {
            "lam": number_of("lam", self.lam),
            "method": method,
            "focus": None if self.focus is None else number_of("focus", self.focus, ("auto", "map")),
            "depth_range": None if self.depth_range is None else _two_depths(self.depth_range),
            "margin": self.margin,
            "bounds": None if self.bounds is None else _two_bounds(self.bounds),
            "iterations": self.iterations,
        }


@dataclass(frozen=True)
class ColouredImage:
    """How an image in colour is made."""

    PANEL = WHAT

    chart: str | None = option(
        None,
        "of a coloured run: the chart in the image that colours are fitted on, a scene's name or a file",
        metavar="NAME|FILE.json",
    )
    mosaic: str | None = option(
        None,
        "of a run behind colour filters: how its images are found",
        metavar="joint|half|demosaic",
        show_default="joint",
    )


@dataclass(frozen=True)
class OfPointSpread(ColouredImage):
    """Cameras that are known by a point spread function, and those in colour."""

    PANEL = WHAT

    psf: Path | None = option(
        None,
        "in place of a calibration: picture of the light of a scene point, of the frames' pixels",
        "--psf",
        metavar="FILE",
    )
    reduce: int = option(1, "with --psf: pixels a side, of frames and picture, that become one", min=1, metavar="K")


@verb
def reconstruct(
    *,
    run: Annotated[Path, typer.Argument(help="folder of `mitsim capture`", metavar="RUN")],
    calibration: Annotated[
        Path | None,
        typer.Option(help="folder of `mitsim calibrate`; needed without --psf", metavar="CAL", rich_help_panel=WHAT),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="folder for the image; RUN/reconstruction if not given", metavar="DIR"),
    ] = None,
    solving: Solving,
    camera: OfPointSpread,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace an earlier image in the folder")] = False,
    common: Pictured,
) -> int:
    """Recover the image from frames and a calibration alone.

    Of coloured folders, an image of each line, and one in colour.

    $ mitsim reconstruct run --calibration cal
    $ mitsim reconstruct run --calibration cal --method markov -o smooth
    $ mitsim reconstruct run --calibration cal --focus auto -o sharp
    """
    from mitsim.core.files import check_output
    from mitsim.core.manifests import CalibrationManifest, RunManifest, read_manifest
    from mitsim.reconstruct.request import ImageRequest, check_parallax, holds_image

    options = solving.read()
    output = output or run / "reconstruction"
    colours = {"chart": camera.chart, "mosaic": camera.mosaic}
    if camera.psf is not None:
        for name, value in {"calibration": calibration, **colours}.items():
            if value is not None:
                raise MitsimError(f"--{name} {value}: has no effect with --psf; leave it out")
        return _reconstruct_psf(run, camera, output, {**options, "overwrite": overwrite}, common)
    if camera.reduce != 1:
        raise MitsimError(f"--reduce {camera.reduce}: has no effect without --psf; leave it out")
    if calibration is None:
        raise MitsimError("--calibration: is missing; give the folder of `mitsim calibrate`, or --psf FILE")
    if not is_mosaic(run):
        ImageRequest(**options)
    if is_coloured(run):
        options["overwrite"] = overwrite
        if is_mosaic(run):
            options = _mosaic_options(options, camera.mosaic or JOINT)
        elif camera.mosaic is not None:
            raise MitsimError(f"--mosaic {camera.mosaic}: {run} has a run for each line; leave out --mosaic")
        return _reconstruct_colours(run, calibration, output, camera.chart, options, common)
    for name, value in colours.items():
        if value is not None:
            raise MitsimError(f"--{name} {value}: {run} is not coloured; leave out --{name}")
    # Refused before the solver is imported, which takes half a second.
    read_manifest(run, RunManifest)
    manifest = read_manifest(calibration, CalibrationManifest)
    if solving.focus is not None or solving.margin:
        check_parallax(manifest.parallax, str(calibration))
    check_output(output, overwrite=holds_image(output))
    from mitsim.core.job import memory_from_here, memory_since
    from mitsim.report.reconstruct_run import reconstruct as reconstruct_folder

    held = memory_from_here()
    with common.job() as job:
        result = reconstruct_folder(run, calibration, output, **options, overwrite=overwrite, job=job)
    payload = {**result.summary(), "memory_bytes": memory_since(held)}
    return _finish_image(result, payload, common)


def _finish_image(result: Judged, payload: dict[str, Any], common: Pictured) -> int:
    """Print a ``result``, whose JSON is the ``payload``; the exit status."""
    image, rank = result.reconstruction, payload["rank"]
    inherits = image.status.verdict.good and not image.ok
    verdict = "Flagged" if inherits else image.status.verdict.value.capitalize()
    rank_words = "" if rank is None else f", rank {rank}, condition {payload['condition_whole']:.3g}"
    trust = "; ".join(known.gist for known in (image.uncertainties, image.misfit, image.fit) if known)
    lines = [
        f"{f'Flagged: {image.status.flags[0]}' if inherits else f'{image.status.sentence}.'}"
        if result.quality is None
        else f"{verdict}: {result.quality}",
        f"Image: {payload['output']}",
        *([] if payload["white"] == 1 else [f"image.png shows {payload['white']:.3g} electrons/s as white"]),
        *([] if image.focus is None else [str(image.focus)]),
        *([trust.capitalize()] if trust else []),
        *image.limits,
        *common.details(
            *([str(image.status)] if image.ok else []),  # a warning has it otherwise
            f"lambda {payload['lambda']:.3g}, residual {payload['residual']:.1e}{rank_words}",
            *image.trust,
        ),
    ]
    return finish_folder(common, Path(result.output), payload, lines, payload["warnings"])


def _reconstruct_psf(run: Path, point: OfPointSpread, output: Path, options: dict[str, Any], common: Pictured) -> int:
    """The image of a ``run`` by a point spread function, solved with ``options``."""
    from mitsim.core.files import check_output
    from mitsim.core.manifests import RunManifest, read_manifest
    from mitsim.reconstruct.request import ImageRequest, holds_image

    # Refused before the solver is imported.
    if is_coloured(run):
        raise MitsimError(f"--psf {point.psf}: {run} is coloured; reconstruct one of its lines, {run}/NAME")
    ImageRequest(**{name: value for name, value in options.items() if name != "overwrite"}).check_point_spread(
        point.reduce
    )
    if point.psf is None or not point.psf.is_file():
        raise MitsimError(f"--psf {point.psf}: is no file; give a picture of the light of a scene point")
    read_manifest(run, RunManifest)
    check_output(output, overwrite=holds_image(output))
    from mitsim.core.job import memory_from_here, memory_since
    from mitsim.report.reconstruct_run import reconstruct_psf

    held = memory_from_here()
    with common.job() as job:
        result = reconstruct_psf(run, point.psf, output, point.reduce, job=job, **options)
    return _finish_image(result, {**result.summary(), "memory_bytes": memory_since(held)}, common)


def _mosaic_options(options: dict[str, Any], way: str) -> dict[str, Any]:
    """Those ``options`` of `mitsim reconstruct` that images behind colour filters have, and their ``way``.

    MitsimError for a way that there is not, and for options that these images have not.
    """
    from mitsim.reconstruct.request import check_joint

    check_way(way)
    check_joint(options["lam"])
    for name, neutral in (
        ("focus", None),
        ("method", "tikhonov"),
        ("margin", 0),
        ("depth_range", None),
        ("bounds", None),
        ("iterations", None),
    ):
        if options[name] != neutral:
            raise MitsimError(
                f"{option_name(name)} {options[name]}: runs behind colour filters are solved by tikhonov at the "
                "calibrated depth; leave it out"
            )
    return {"lam": options["lam"], "overwrite": options["overwrite"], "way": way}


def _reconstruct_colours(
    run: Path, calibration: Path, output: Path, chart: str | None, options: dict[str, Any], common: Pictured
) -> int:
    """The image of every line of a coloured run, each solved with ``options``, and one in colour."""
    from mitsim.core.files import check_output
    from mitsim.core.manifests import CalibrationManifest, RunManifest, read_manifest
    from mitsim.devices.chart import load_chart

    # Refused before the solver and colour-science are imported.
    if is_mosaic(run):
        read_mosaic(run)
        read_manifest(run, RunManifest)
    else:
        for name in read_colours(run, RUN).names:
            read_manifest(run / name, RunManifest)
    for name in read_colours(calibration, CALIBRATION).names:
        read_manifest(calibration / name, CalibrationManifest)
    place = None if chart is None else load_chart(chart)
    # What it holds is looked into later: an image of the same inputs may be replaced.
    check_output(output, overwrite=is_coloured(output))
    from mitsim.core.job import memory_from_here, memory_since
    from mitsim.report.reconstruct_run import reconstruct_colours

    held = memory_from_here()
    with common.job() as job:
        found = reconstruct_colours(run, calibration, output, place, job=job, page=False, **options)
    payload = {**found.summary(), "memory_bytes": memory_since(held)}
    return finish_folder(common, output, payload, _colours_lines(found, common), found.warnings)


# ---- what is said of images, and words of options --------------------------------------------------------------------


def _colours_lines(found: ColourImage, common: Common) -> list[str]:
    """What is said of an image in colour, as ``common`` options have it."""
    verdict = "Solved" if found.ok else "Flagged"
    quality = f"PSNR {found.psnr_db:.2f} dB over all lines" if found.psnr_db is not None else "an image of every line"
    return [
        f"{verdict}: {quality}",
        f"Image: {found.output}",
        *(f"{name}: {row}" for name, row in found.table.items()),
        *(f"{text[0].upper()}{text[1:]}" for text in found.sentences),
        *common.details(*found.described),
    ]


def _two_bounds(text: str) -> tuple[float, float]:
    """The two numbers of LOW:HIGH; -inf and inf for ends that are left out."""
    low, colon, high = text.partition(":")
    try:
        if colon:
            return float(low or -math.inf), float(high or math.inf)
    except ValueError:
        pass
    raise ArgumentError("bounds", f"{text!r}: give the least and the largest number, such as 0:1 or 0:")


def _two_depths(text: str) -> tuple[float, float]:
    """The two numbers of A:B."""
    near, colon, far = text.partition(":")
    try:
        if colon:
            return float(near), float(far)
    except ValueError:
        pass
    raise ArgumentError("depth_range", f"{text!r}: give the nearest and the farthest depth [mm], such as 350:450")


# ---- a camera's sensor alone -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Procedure:
    """How a camera is characterised."""

    PANEL = WHAT

    pixels: int = option(256, "rows and columns of the frames")
    steps: int = option(50, "steps of light, from dark to beyond saturation")
    frames: str = option(
        "100",
        "frames of each stack; without CAMERA: folder of a real camera's frames under even light and in the dark",
        metavar="N|DIR",
    )
    wavelength: float = option(550.0, "of the light, for a curve of quantum efficiency [nm]")
    seed: Seed = 0


@verb
def characterise(
    *,
    context: typer.Context,
    camera: Annotated[
        str | None,
        typer.Argument(
            help="camera electronics: name or TOML file",
            metavar="[CAMERA]",
            show_default=False,
            autocompletion=complete_camera,
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="folder of page, plots, JSON and camera.toml", metavar="DIR")
    ] = Path("characterise-output"),
    asked: Procedure,
    common: Common,
) -> int:
    """Measure a camera after EMVA 1288, simulated or real.

    On simulated frames, beside what the camera's file sets, or on real frames (--frames DIR).

    $ mitsim characterise imx249 -o figures
    $ mitsim characterise --frames flats -o mine
    """
    if camera is None and not is_given(context, "frames"):
        raise MitsimError("characterise: got no CAMERA; give one to simulate, or --frames DIR of a real one")
    frames = int(asked.frames) if asked.frames.isdecimal() and camera is not None else Path(asked.frames)
    procedure = {name: value for name, value in given_of(context, vars(asked)).items() if name != "frames"}
    with common.job() as job:
        done = mitsim.characterise(camera, output, frames, job, **procedure)
    return finish(common.as_json, done.payload(), done.lines(), done.warnings)


@dataclass(frozen=True)
class Exposed:
    """A camera and how long it is exposed."""

    PANEL = WHAT

    camera: str = option(
        ...,
        "camera electronics: name or TOML file",
        metavar="NAME|FILE",
        rich_help_panel=DEVICES,
        autocompletion=complete_camera,
    )
    exposure: str = option("auto", "seconds, or auto", metavar="auto|SECONDS")
    exposure_fraction: ExposureFraction = 0.8
    seed: Seed = 0


@dataclass(frozen=True)
class Irradiance:
    """How an image's numbers are light on the sensor."""

    PANEL = WHAT

    f_number: float | None = option(
        None, "the image is radiance [W/m^2/sr] before a lens of this f-number", metavar="N"
    )
    scale: float = option(1.0, "what its numbers are multiplied by")
    channel: str | None = option(None, "of several channels, the one to take", metavar="NAME")
    wavelength: float = option(550.0, "of the light [nm]")


@verb
def sense(
    context: typer.Context,
    image: Annotated[Path, typer.Argument(help="irradiance [W/m^2], OpenEXR or NPY", metavar="IMAGE.exr")],
    output: Annotated[Path, typer.Option("-o", "--output", help="frame to write", metavar="FRAME.png|exr|npy")],
    exposed: Exposed,
    irradiance: Irradiance,
    common: Pictured,
) -> int:
    """Put an image of any renderer behind a camera's sensor.

    Out come digital numbers, with the sensor's noise.

    $ mitsim sense frame.exr --camera imx249 -o frame.png
    $ mitsim sense photo.exr --camera imx249 --f-number 2.8 -o photo.png
    """
    from mitsim.bench.request import check_ending, check_image
    from mitsim.core.configuration import CAMERA, locate
    from mitsim.core.files import check_apart, output_file
    from mitsim.devices.sensor import load_sensor

    words = {**vars(exposed), "exposure": number_of("exposure", exposed.exposure)}
    if words["exposure"] != "auto":
        refuse_unused(context, ["exposure_fraction"], "on an --exposure in seconds")
    sensor = load_sensor(locate(exposed.camera, "calibration", ".toml", CAMERA))
    check_ending(output, sensor)
    check_image(image)
    check_apart(output, [image])
    with output_file(output, overwrite=True) as place:
        frame = mitsim.sense(image, **words, **vars(irradiance))
        payload = {**frame.summary(), "output": str(frame.save(place))}
    lines = [
        f"{sensor.name}: {payload['shape'][0]}x{payload['shape'][1]} pixels, exposure {frame.exposure_s:.3g} s, "
        f"mean {payload['mean_dn']:.5g} DN, largest {payload['largest_dn']:.5g}: {payload['output']}",
        *frame.notes,
    ]
    return finish_frame(common, (output, frame.digital, "DN"), payload, lines, frame.warnings)

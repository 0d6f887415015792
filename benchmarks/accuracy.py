"""Measured total error of `mitsim capture` against an independent answer, and its seconds, predicted and taken.

    python benchmarks/accuracy.py --json FILE [--scene photograph ...] [--accuracy 1e-2 ...] [--seeds N]

The answer is light of two other seeds with every effect of the scene, in anchors, layers and cells of a plan at 1e-4.
With r1, r2 its two halves, <a - r1, a - r2> / <r1, r2> is the squared error of all
frames a without the noise of the answer; its standard error is the jackknife's over shots. That does not see noise
which all shots share, of lamps and of followed light: at 3e-4 two halves found 1.5 times the accuracy of cookie_bag,
with an interval of 1.15 to 1.84, where eight find 0.65 to 0.9. ``--halves N`` makes answers of more halves; the error
is then the mean over all pairs, and their own jackknife is added. Captures are processes of their own, from the shell
to their exit. What FILE and the answers beside it hold already is not repeated. ``--seeds N`` counts captures with
other seeds whose error lies within the accuracy, and below the bound that the run states; it is not timed.

    python benchmarks/accuracy.py --cover 200 --json FILE --scene corner [--patterns uniform ...] [--camera FILE] ...

``--cover N`` is of the Monte Carlo error alone: frames of N seeds, traced with a plan for every 40 of them, against the
mean of all others. It prints how often the stated 95 % bound holds and how often the target, the variance of the frames
over the stated one, kinds of noise (trace squared over the squared norm of the frames' covariance), and rounds, paths
and processor seconds of a light. A scene may be a file; ``--sensor 64`` gives it so many pixels a side.
To measure an earlier version, set PYTHONPATH to its checkout.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from harness import ROOT, arguments, held, show, write

import mitsim as ms
from mitsim.acquire.exposure import Exposer, Totals
from mitsim.bench.effects import present
from mitsim.core.exr import read_frame
from mitsim.core.seeds import integer
from mitsim.light import light as light_module
from mitsim.light.light import Sampling, trace_light
from mitsim.light.settings import SURE
from mitsim.planner.choose import table_of
from mitsim.planner.pilot import PilotRuns
from mitsim.planner.planner import make_plan

SCENES = (
    *("photograph", "colour_chart", "resolution_target", "keystone", "gift_card", "corner", "cards", "metal_blade"),
    *("compact_disc", "mirror", "lamp_bench", "cookie_bag"),
)
PATTERNS, ACCURACIES = "dots:7", (1e-2, 3e-3, 1e-3, 3e-4)
FINEST, NOISE = 1e-4, 1e-3
"""Accuracy of the answer's plan, and the Monte Carlo error of each of its halves, whose own energy drops out."""
SEED, ANSWERS = 0, 811
PLANNED = 40
"""Seeds of ``--cover`` that share a plan."""
PROMISED = 1e-3
"""Accuracy at which versions are compared."""
Frames = npt.NDArray[np.floating[Any]]


def answer(scene: str, noise: float, halves: int = 2) -> npt.NDArray[np.float32]:
    """(halves, shots, pixels, pixels) irradiance of all shots in so many independent ``halves``."""
    bench = ms.open_bench(scene)
    family = bench.family(PATTERNS, SEED)
    plan = make_plan(bench, family.lighting, FINEST, ANSWERS, dict.fromkeys(present(bench), True))
    measured = PilotRuns(bench, family.lighting, FINEST, ANSWERS).pilot_result
    samples = table_of(measured, plan.settings, {}).candidate(noise, SURE).settings
    plan = replace(plan, settings=samples, sampling_target=noise)
    found = []
    for seed in range(ANSWERS, ANSWERS + halves):
        light = trace_light(bench, plan, family.lighting, integer(seed, "answer"), Sampling(by_pixel=False)).merge()
        found.append([frame.irradiance.astype(np.float32) for frame in light.frames(family.lighting, 0)])
    return np.array(found)


def answer_of(scene: str, file: Path, noise: float, halves: int = 2) -> npt.NDArray[np.float32]:
    """The :func:`answer` of a ``scene``, kept beside ``file``."""
    kept = file.with_suffix(f".{Path(scene).stem}.npy")
    if not kept.exists():
        np.save(kept, answer(scene, noise, halves))
    return np.asarray(np.load(kept))


def captured(
    scene: str, accuracy: float, tree: Path | None, seed: int = SEED, home: Path | None = None
) -> dict[str, Any]:
    """Seconds and manifest of a capture by the version in ``tree`` (this one without), and its frames.

    ``home``: where its kernels are kept, instead of the user's home.
    """
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        command = [sys.executable, "-m", "mitsim", "capture", scene, "--patterns", PATTERNS, "--seed", str(seed)]
        command += ["--accuracy", str(accuracy), "-o", str(run), "--json"]
        environment = {**os.environ, "PYTHONPATH": str(tree or ROOT)}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        if home:
            kept = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")  # which LLVM there is stands there
            environment |= {"HOME": str(home), "XDG_CACHE_HOME": kept}
        before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=folder)
        seconds, after = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
        processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        if not (run / "manifest.json").exists():
            raise SystemExit(f"{scene} at {accuracy:g}: {done.stderr}")
        manifest = json.loads((run / "manifest.json").read_text())
        frames = [read_frame(run / shot["file"])[0]["electrons"] for shot in manifest["patterns"]["captures"]]
    exposure = manifest.get("digital", manifest)["exposure_s"]
    found = {"seconds": seconds, "processor_seconds": processor, "manifest": manifest, "exposure_s": exposure}
    return found | {"frames": np.stack(frames)}


def shares(frames: Frames, halves: Frames) -> npt.NDArray[np.floating[Any]]:
    """(2, pairs, shots): squared error of each of ``frames`` without the noise of the answer, and the energy of that,
    by all pairs of its ``halves``."""
    pairs = list(itertools.combinations(range(len(halves)), 2))
    found = np.empty((2, len(pairs), len(frames)))
    for shot, a in enumerate(frames.astype(np.float64)):
        seen = halves[:, shot].reshape(len(halves), -1).astype(np.float64)
        off = a.ravel() - seen
        for row, products in enumerate((off @ off.T, seen @ seen.T)):
            found[row, :, shot] = [products[pair] for pair in pairs]
    return found


def _jackknife(without: Frames) -> float:
    """Squared standard error of what is so much ``without`` each of its parts."""
    count = len(without)
    return float((count - 1) / count * np.square(without - without.mean()).sum())


def squared_error(products: Frames, energies: Frames) -> tuple[float, float]:
    """Squared relative error from the ``shares`` of pairs and shots, and its standard error by the jackknife over shots
    and, where there are more than two, over halves."""
    by_shot, energy = products.sum(axis=0), energies.sum(axis=0)
    variance = _jackknife((by_shot.sum() - by_shot) / (energy.sum() - energy))
    halves = math.isqrt(2 * len(products)) + 1
    if halves > 2:
        pairs = np.array(list(itertools.combinations(range(halves), 2)))
        kept = [~(pairs == half).any(axis=1) for half in range(halves)]
        variance += _jackknife(np.array([products[each].sum() / energies[each].sum() for each in kept]))
    return float(products.sum() / energies.sum()), math.sqrt(variance)


def bracketed(products: Frames, energies: Frames) -> dict[str, float]:
    """Relative error from the ``shares`` of pairs and shots, and two standard errors about it."""
    square, spread = squared_error(products, energies)
    ends = {"error": square, "low": square - 2 * spread, "high": square + 2 * spread}
    return {name: math.sqrt(max(value, 0)) for name, value in ends.items()}


def held_against(halves: Frames, scene: str, run: Mapping[str, Any]) -> dict[str, Any]:
    """What :func:`captured` gave of a ``scene``, and its error against the answer's ``halves``."""
    bench = ms.open_bench(scene)
    unit = float(Exposer(bench.devices, run["exposure_s"], 0).electrons(_Unit()))
    of_shots = shares(run["frames"] / unit, halves)
    manifest = run["manifest"]
    plan = manifest["plan"]
    return {
        **bracketed(*of_shots),
        "shares": of_shots.tolist(),
        "seconds": run["seconds"],
        "processor_seconds": run["processor_seconds"],
        "predicted_seconds": plan["predicted_seconds"],
        **{name: manifest.get(name) for name in ("total_error", "total_error_bound", "mc_error", "warnings")},
        "stages": manifest["seconds"],
        "predicted": plan.get("predicted"),
        "settings": plan["settings"],
    }


def covered(scene: str, accuracy: float, seeds: int, halves: Frames) -> dict[str, Any]:
    """Errors and stated bounds of captures with ``seeds`` other seeds, and how many hold."""
    bench, rows = ms.open_bench(scene), []
    for seed in range(1, seeds + 1):
        family = bench.family(PATTERNS, SEED)
        plan = make_plan(bench, family.lighting, accuracy, seed)
        expected = trace_light(bench, plan, family.lighting, seed, Sampling(by_pixel=False)).frames(family.lighting, 0)
        square, _ = squared_error(*shares(np.array([frame.irradiance for frame in expected]), halves))
        rows.append((math.sqrt(max(square, 0)), *plan.total(Totals.of(expected).noise)))
    errors, totals, bounds = np.array(rows).T
    return {
        "seeds": seeds,
        "within_accuracy": int((errors <= accuracy).sum()),
        "within_bound": int((errors <= bounds).sum()),
        "errors": errors.tolist(),
        "totals": totals.tolist(),
        "bounds": bounds.tolist(),
    }


def small(scene: Path, side: int, folder: Path) -> Path:
    """A copy of a ``scene`` and its files in a ``folder``, whose sensor has ``side`` pixels a side and its old size."""
    copy = shutil.copytree(scene.parent, folder / "scene") / scene.name
    text = copy.read_text()
    (old,) = set(re.findall(r'name="(?:width|height)" value="(\d+)"', text))
    text = re.sub(r'(name="(?:width|height)" value=)"\d+"', rf'\1"{side}"', text)
    pitch = re.search(r'name="pixel_pitch" value="([^"]+)"', text)
    assert pitch is not None
    copy.write_text(text.replace(pitch[0], f'name="pixel_pitch" value="{float(pitch[1]) * int(old) / side:.9g}"'))
    return copy


def coverage(scene: str, patterns: str, accuracy: float, seeds: int, options: argparse.Namespace) -> dict[str, Any]:
    """How often the stated Monte Carlo error of frames holds, against the mean over the other ``seeds``."""
    given = {name: getattr(options, name) for name in ("camera", "projector", "mask") if getattr(options, name)}
    bench = ms.open_bench(scene, for_render=True, **given)
    if options.sensor:
        with tempfile.TemporaryDirectory() as folder:
            bench = ms.open_bench(
                small(Path(bench.loaded.path), options.sensor, Path(folder)), for_render=True, **given
            )
    family, switches = bench.family(patterns, SEED), dict.fromkeys(options.off, False)
    module: Any = light_module
    simulations, rounds, kept = dict[int, Any](), list[int](), (module.Simulation, module.trace_groups)

    def prepared(apparatus: Any, settings: Any) -> Any:
        """One simulation for each plan, so that its optics are prepared once."""
        if id(settings) not in simulations:
            simulations[id(settings)] = kept[0](apparatus, settings)
        return simulations[id(settings)]

    def counted(*arguments: Any, **named: Any) -> None:
        rounds[-1] += 1
        kept[1](*arguments, **named)

    module.Simulation, module.trace_groups = prepared, counted
    frames, rows, plans, started = list[Frames](), list[tuple[float, ...]](), list[Any](), time.perf_counter()
    for seed in range(1, seeds + 1):
        if time.perf_counter() - started > options.seconds:
            break
        if seed % PLANNED == 1:
            plans.append(make_plan(bench, family.lighting, accuracy, seed, switches))
        plan, before = plans[-1], time.process_time()
        rounds.append(0)
        light = trace_light(bench, plan, family.lighting, seed, Sampling(by_pixel=False))
        expected = list(light.frames(family.lighting, seed, leaking=False))
        spent = time.process_time() - before
        frames.append(np.array([frame.irradiance for frame in expected]).ravel())
        rows.append((*Totals.of(expected).noise, plan.sampling_target, light.paths, spent))
    module.Simulation, module.trace_groups = kept
    seen, (stated, bounds, targets, paths, spent) = np.array(frames), np.array(rows).T
    count, off = len(seen), seen - seen.mean(axis=0)
    products = off @ off.T
    # An error against the mean of the others is larger by (N / (N - 1))^(1/2) than against the truth.
    errors = np.sqrt(np.diag(products) * count / (count - 1) / np.square(seen.mean(axis=0)).sum())
    return {
        "seeds": count,
        "within_bound": float((errors <= bounds).mean()),
        "within_target": float((errors <= targets).mean()),
        "variance_ratio": float(np.square(errors).mean() / np.square(stated).mean()),
        "kinds": float(np.trace(products) ** 2 / np.square(products).sum()),
        "bound_over_error": float(np.median(bounds / stated)),
        "error": float(np.sqrt(np.square(errors).mean())),
        "target": float(targets.mean()),
        "mean": float(seen.mean()),
        "rounds": float(np.mean(rounds)),
        "paths": float(paths.mean()),
        "processor_seconds": float(np.median(spent)),
        "work_for_error": float(spent.mean() * np.square(errors).mean() / np.square(targets).mean()),
    }


class _Unit:
    """A frame of 1 W m^-2."""

    irradiance = 1.0


def main() -> None:
    parser = arguments(__doc__, required=True)
    parser.add_argument("--scene", action="append", default=[])
    parser.add_argument("--accuracy", action="append", type=float, default=[])
    parser.add_argument("--seeds", type=int, default=0)
    parser.add_argument("--noise", type=float, default=NOISE)
    parser.add_argument("--halves", type=int, default=2)
    parser.add_argument("--cover", type=int, default=0)
    parser.add_argument("--patterns", nargs="+", default=["uniform", "dots:4"])
    parser.add_argument("--off", nargs="*", default=[], help="effects that --cover switches off")
    parser.add_argument("--seconds", type=float, default=math.inf, help="that --cover of one case takes at most")
    parser.add_argument("--sensor", type=int, help="pixels a side of --cover's scenes")
    parser.add_argument("--mask", help="of --cover's scenes, such as open")
    parser.add_argument("--camera")
    parser.add_argument("--projector")
    options = parser.parse_args()
    found = held(options.json, {})
    for scene in options.scene or SCENES:
        rows = found.setdefault(scene, {})
        if options.cover:
            for patterns, accuracy in itertools.product(options.patterns, options.accuracy or ACCURACIES[:1]):
                if (key := f"cover {patterns} {accuracy:g}") not in rows:
                    rows[key] = coverage(scene, patterns, accuracy, options.cover, options)
                    show(f"{scene} {key}", rows[key])
                    write(options.json, found)
            continue
        halves = answer_of(scene, options.json, options.noise, options.halves)
        for accuracy in options.accuracy or ACCURACIES:
            key = f"seeds {accuracy:g}" if options.seeds else f"new {accuracy:g}"
            if key not in rows:
                if options.seeds:
                    rows[key] = covered(scene, accuracy, options.seeds, halves)
                else:
                    rows[key] = held_against(halves, scene, captured(scene, accuracy, None))
                shown = ("within_accuracy", "within_bound", "error", "low", "high", "seconds", "predicted_seconds")
                show(f"{scene} {key}", {name: rows[key][name] for name in shown if name in rows[key]})
                write(options.json, found)


if __name__ == "__main__":
    main()

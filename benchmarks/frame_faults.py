"""Count how often faulty frames are flagged, with the true frames among those named, and how often good runs are.

    python benchmarks/frame_faults.py --json FILE [--rounds 4] [--fitting 240] [--seed 0] [--sizes 64 128] [--peaks ...]
        [--old OLD.json]

The runs are of the ideal cameras of the tests (tests/ideal_sessions.py): frames of the paper's model with drawn noise,
with three kinds of masks and pictures that are shipped or drawn here. Each round lays one fault of every kind into a
run of every family, at every size and light level. The frame, the place and the strength of the fault are drawn. A run
is judged by its outcome, not by the name of a cause:

- *flagged*: it is refused, or its image is flagged. Pixels that are wrong in all frames may also be left out: the run
  counts as flagged where `misfit.summary()` lists such pixels.
- *named*: of flagged runs whose fault is in some frames, those whose frames are all among the frames that
  `misfit.summary()["faults"]` lists. A refusal names its frames in words and is not counted here.
- *missed*: it is not flagged, and the image is further from the true one than without the fault by more than 5 %.
- *harmless*: it is not flagged, and the image is not.

Faults that change nothing, for example an exchange of two frames that are alike, are no runs. Good runs have no fault.
A false alarm is a good run that is flagged because of its frames; of glossy scenes, whose misfit may be flagged, one
that lists frames or pixels, or another reading of its frames. FILE holds all runs, the runs that went wrong and
the rates with their 95 % intervals (Wilson). ``--old`` lists the runs that an earlier file has as flagged and
that are not flagged now. 4 rounds and 240 good runs take 25 minutes on a core.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from harness import ROOT, arguments, interval, lost, show, write
from skimage import io, transform

from mitsim.core.errors import MitsimError
from mitsim.core.runs import Capture
from mitsim.devices.camera import centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import reconstruct
from tests.ideal_sessions import BLACK, CODES, DARK, GAIN, READ, Bench
from tests.shadow_factor import scene_factor

FAMILIES = "dots:4", "hadamard:4", "random:4", "dots:1x8", "uniform"
PEAKS = 2e4, 4e3, 800.0
"""Electrons of the brightest pixel."""
PIXELS = {64: 160, 128: 288}
"""Sensor pixels a side before so many scene pixels; both sensors are 6 mm wide."""
PRINTS = "photograph", "resolution_target", "colour_chart"
SCENES = *PRINTS, "text", "shades", "stars", "highlight", "glossy"
GLOSSY = "highlight", "glossy"
MASKS = "mls", "coded", "flatcam"
HARMLESS = 1.05
"""Image error over that of the run without the fault, up to which a fault that is not flagged does no harm."""
SINGLE = "repeated", "swapped", "late", "dim"
"""Faults that the only frame of a run cannot have, or that no data can show: half the light is half the exposure."""
Frames = list[np.ndarray]


@dataclass(frozen=True, eq=False)
class FlatCam(Bench):
    """The same camera behind a mask (1 + m m^T) / 2: ``whole`` are the shadows of its outline."""

    whole: tuple[np.ndarray, np.ndarray] = (np.zeros((1, 1)),) * 2

    def light(self, shown: np.ndarray) -> np.ndarray:
        outline = self.whole[0] @ shown @ self.whole[1].T
        return np.asarray((outline + self.left @ shown @ self.right.T) / 2)

    def calibrated(self, seed: int, error: float = 2e-3) -> Factors:
        half = Bench(self.left / np.sqrt(2), self.right / np.sqrt(2)).calibrated(seed, error)
        return replace(half, manifest=half.manifest.model_copy(update={"centre": True}))


@cache
def camera(mask: str, n: int, other: bool = False) -> Bench:
    """Return a camera of so many scene pixels; ``other``: one of another mask feature."""
    sensor = centred_edges(PIXELS[n], 6.0 / PIXELS[n])
    code = mls_mask().terms[0][1]
    if mask == "coded":
        code = np.random.default_rng(7).integers(0, 2, len(code)).astype(np.float64)
    feature = 0.048 if other else 0.06

    def side(values: np.ndarray, shift: float) -> np.ndarray:
        edges = centred_edges(n, 120 / n) + shift
        return scene_factor(values, feature, sensor, edges, 2.0, 400.0)

    # The camera is not alike along rows and columns: its projector stands aside.
    pair = side(code, 0.0), side(code, 7.0)
    if mask == "flatcam":
        outline = np.ones_like(code)
        whole = side(outline, 0.0), side(outline, 7.0)
        return FlatCam(2 * pair[0] - whole[0], 2 * pair[1] - whole[1], whole=whole)
    return Bench(*pair)


@cache
def scene(name: str, n: int, seed: int) -> np.ndarray:
    """Return (n, n) reflectances."""
    rng = np.random.default_rng([seed, n])
    if name in PRINTS:
        values = io.imread(ROOT / "scenes" / name / "reflectance.png").astype(np.float64)
        values = np.asarray(values if values.ndim == 2 else values[..., :3].mean(axis=2))
        values = np.rot90(values, int(rng.integers(4))) / 255
        return np.asarray(0.05 + 0.9 * transform.resize(values, (n, n), anti_aliasing=True))
    y, x = np.mgrid[:n, :n] / n
    if name == "text":  # words of strokes on white
        page = np.full((n, n), 0.85)
        for line in range(2, n - 4, 7):
            ink = (rng.random((5, n)) < 0.45) & (rng.random(n) < 0.85)
            page[line : line + 5][ink] = 0.08
        return page
    if name == "stars":
        sky = np.full((n, n), 0.02)
        places = rng.integers(0, n, (2, n))
        sky[tuple(places)] = rng.uniform(0.2, 1.0, n)
        return sky
    shades = 0.45 + 0.3 * np.sin(2 * np.pi * (2 * x + rng.random())) * np.cos(2 * np.pi * (1.5 * y + rng.random()))
    if name == "highlight":  # a few pixels that are much brighter than white
        row, column = rng.integers(n // 4, 3 * n // 4, 2)
        shades[row : row + 2, column : column + 2] *= 12
    return np.asarray(shades)


def run_of(mask: str, name: str, family: str, n: int, peak: float, seed: int) -> tuple[Capture, Factors]:
    """Return a good run, and the factors of its camera."""
    bench = replace(camera(mask, n), peak=peak)
    if name in GLOSSY:
        place = np.linspace(-1, 1, PIXELS[n])
        gloss = 1 + 0.05 * np.outer(place, np.exp(-4 * np.square(place - 0.3)))
        bench = replace(bench, optics=lambda light: light * gloss)
    return bench.run(family, scene(name, n, seed), seed), bench.calibrated(seed)


# ---- faults: frames and a generator in, other frames and the shots at fault out


def _one(change: Callable[[Frames, np.ndarray, np.random.Generator], np.ndarray]) -> Any:
    def laid(frames: Frames, rng: np.random.Generator, lit: np.ndarray) -> tuple[Frames, set[int]]:
        number = int(rng.choice(np.flatnonzero(lit)))
        return [change(frames, each, rng) if k == number else each for k, each in enumerate(frames)], {number}

    return laid


def dark(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Return the numbers of a frame without light."""
    return np.asarray(BLACK + GAIN * (rng.poisson(DARK, shape) + READ * rng.standard_normal(shape)))


def dim(frames: Frames, frame: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    # Light thinned by p keeps p of its shot noise; what read noise loses with it is drawn anew.
    part = rng.uniform(0.4, 0.6)
    electrons = (frame - BLACK) / GAIN - DARK
    missing = np.sqrt(part * (1 - part) * np.maximum(electrons, 0) + (1 - part**2) * (READ**2 + DARK))
    return np.asarray(BLACK + GAIN * (DARK + part * electrons + missing * rng.standard_normal(frame.shape)))


def half_lost(frames: Frames, frame: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    lines = np.arange(len(frame)) < rng.uniform(0.3, 0.7) * len(frame)
    lines = lines if rng.random() < 0.5 else ~lines
    lost = lines[:, None] if rng.random() < 0.7 else lines[None, :]
    return np.asarray(np.where(lost, dark(frame.shape, rng) if rng.random() < 0.5 else 0.0, frame))


def shifted(frames: Frames, frame: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    steps = rng.integers(1, 7, 2) * rng.choice([-1, 1], 2)
    return np.roll(frame, steps, (0, 1))


def clipped(frames: Frames, frame: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.asarray(np.minimum(frame, np.rint(BLACK + rng.uniform(0.5, 0.75) * (frame.max() - BLACK))))


def repeated(frames: Frames, rng: np.random.Generator, lit: np.ndarray) -> tuple[Frames, set[int]]:
    own, other = (int(k) for k in rng.choice(np.flatnonzero(lit), 2, replace=False))
    return [frames[other] if k == own else each for k, each in enumerate(frames)], {own}


def swapped(frames: Frames, rng: np.random.Generator, lit: np.ndarray) -> tuple[Frames, set[int]]:
    own, other = (int(k) for k in rng.choice(np.flatnonzero(lit), 2, replace=False))
    places = {own: other, other: own}
    return [frames[places.get(k, k)] for k in range(len(frames))], {own, other}


def dead(frames: Frames, rng: np.random.Generator, lit: np.ndarray) -> tuple[Frames, set[int]]:
    row, column = (int(rng.integers(size)) for size in frames[0].shape)
    bright, changed = rng.random() < 0.5, [each.copy() for each in frames]
    for each in changed:
        each[row, column] = CODES - 1 if bright else BLACK
    return changed, {row, column}


def turned(frames: Frames, rng: np.random.Generator, lit: np.ndarray) -> tuple[Frames, set[int]]:
    turn = [np.flipud, np.fliplr, lambda frame: np.rot90(frame, 2)][rng.integers(3)]
    return [turn(each) for each in frames], set()


def late(frames: Frames, rng: np.random.Generator, lit: np.ndarray) -> tuple[Frames, set[int]]:
    return [frames[-1], *frames[:-1]] if rng.random() < 0.5 else [*frames[1:], frames[0]], set()


def gamma(frames: Frames, rng: np.random.Generator, lit: np.ndarray) -> tuple[Frames, set[int]]:
    span = CODES - 1 - BLACK
    return [BLACK + span * (np.maximum(each - BLACK, 0) / span) ** (1 / 2.2) for each in frames], set()


def aligned(frames: Frames, rng: np.random.Generator, lit: np.ndarray) -> tuple[Frames, set[int]]:
    return [np.rint(each) * 16 for each in frames], set()


FAULTS: dict[str, Any] = {
    "black": _one(lambda frames, frame, rng: dark(frame.shape, rng)),
    "dim": _one(dim),
    "half_lost": _one(half_lost),
    "shifted": _one(shifted),
    "clipped": _one(clipped),
    "repeated": repeated,
    "swapped": swapped,
    "dead": dead,
    "orientation": turned,
    "late": late,
    "gamma": gamma,
    "scale": aligned,
    "rig": lambda frames, rng, lit: (frames, set()),
}
IN_FRAMES = "black", "dim", "half_lost", "shifted", "clipped", "repeated", "swapped"
"""Faults of single frames, which have to be named."""


def changed(shots: Capture, frames: Frames, codes: float = CODES) -> Capture:
    """Return the capture with other frames."""
    files = [shot.file for shot in shots.manifest.patterns.captures]
    numbers = [np.clip(np.rint(frame), 0, codes - 1).astype(np.uint32) for frame in frames]
    digital = shots.manifest.digital.model_copy(update={"saturation_dn": float(codes - 1)})
    memory: dict[str, Any] = {file: ({"DN": each}, {}) for file, each in zip(files, numbers, strict=True)}
    return Capture(shots.manifest.model_copy(update={"digital": digital}), memory=memory)


def verdict(shots: Capture, factors: Factors, true: np.ndarray) -> dict[str, Any]:
    """Return what an image reports of its frames, and its error against the ``true`` one."""
    try:
        found = reconstruct(shots, factors)
    except MitsimError as error:
        return {"refused": str(error), "flagged": True, "named": [], "pixels": False, "readings": False}
    misfit = found.misfit.summary() if found.misfit else {}
    faults = misfit.get("faults") or []
    return {
        "flagged": not found.ok,
        "misfit": bool(misfit.get("flagged")),
        "named": sorted({number for fault in faults for number in fault["frames"]}),
        "pixels": bool(misfit.get("defective_pixels")),
        "readings": bool(misfit.get("reading") or misfit.get("readings")),
        "cause": misfit.get("cause"),
        "chi_square": misfit.get("chi_square"),
        "unexplained": misfit.get("unexplained"),
        "words": f"{found.status} {'; '.join(found.trust)}",
        "error": float(np.linalg.norm(found.image - true) / np.linalg.norm(true)),
    }


def faulty(
    fault: str, mask: str, name: str, family: str, n: int, peak: float, seed: int
) -> tuple[str, dict[str, Any]] | None:
    """Return the outcome of a run with a fault and what is reported of it; None where the fault changes nothing."""
    shots, factors = run_of(mask, name, family, n, peak, seed)
    frames = [np.asarray(each, dtype=np.float64) for each in shots.dn]
    means = np.array([frame.mean() for frame in frames]) - BLACK - GAIN * DARK
    laid, numbers = FAULTS[fault](frames, np.random.default_rng([seed, 3]), means > 0.2 * means.max())
    if fault == "swapped" and _alike(*(frames[number] for number in sorted(numbers))):
        return None
    if fault == "dead" and "hadamard" in family and _is_still(frames, laid):
        return None
    if fault == "rig":
        factors = replace(camera(mask, n, other=True)).calibrated(seed)
    true = scene(name, n, seed)
    reported = verdict(changed(shots, laid, CODES * 16 if fault == "scale" else CODES), factors, true)
    reported["flagged"] |= fault == "dead" and reported["pixels"]
    if reported["flagged"]:
        found = "named" if fault in IN_FRAMES and numbers <= set(reported["named"]) else "flagged"
    else:
        reported["harm"] = reported["error"] / verdict(shots, factors, true).get("error", np.inf)
        found = "harmless" if reported["harm"] < HARMLESS else "missed"
    return found, {**reported, "laid": sorted(numbers)}


def _alike(one: np.ndarray, other: np.ndarray) -> bool:
    """Return True if two frames differ by no more than noise, so that exchanging them changes nothing."""
    electrons = np.maximum((one + other - 2 * BLACK) / GAIN, 0)
    noise = GAIN**2 * (electrons + 2 * READ**2) + 1 / 6
    return bool(np.square(one - other).sum() < noise.sum() * (1 + 30 * np.sqrt(2 / one.size)))


def _is_still(frames: Frames, laid: Frames) -> bool:
    """Return True if the differences of pairs show nothing at the pixel that does not change."""
    row, column = np.argwhere(laid[0] != frames[0])[0] if (laid[0] != frames[0]).any() else (0, 0)
    light = np.array([frame[row, column] for frame in frames]) - BLACK
    noise = 2 * GAIN**2 * (max(light.mean() / GAIN, 0) + READ**2) + 1 / 6
    differences = light[::2] - light[1::2]
    return bool(np.square(differences).mean() < noise * (1 + 10 * np.sqrt(2 / len(differences))))


def main() -> None:
    parser = arguments(__doc__, seed=True, required=True)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--fitting", type=int, default=240, help="runs without a fault")
    parser.add_argument("--sizes", nargs="+", type=int, default=tuple(PIXELS))
    parser.add_argument("--peaks", nargs="+", type=float, default=PEAKS)
    parser.add_argument("--faults", nargs="+", default=tuple(FAULTS))
    parser.add_argument("--families", nargs="+", default=FAMILIES)
    parser.add_argument("--old", type=Path, help="earlier file to compare with")
    options = parser.parse_args()
    counts: dict[str, list[bool]] = defaultdict(list)
    rows: list[dict[str, Any]] = []

    def note(fault: str | None, case: tuple[Any, ...], verdict: str, reported: dict[str, Any]) -> None:
        rows.append({"fault": fault, "case": [*case], "verdict": verdict, **reported})
        if verdict in ("missed", "alarm"):
            show(f"{verdict} {fault} {case}", reported)

    plain = [name for name in SCENES if name not in GLOSSY]
    cases = product(range(options.rounds), options.sizes, options.peaks, options.families, options.faults)
    for number, (turn, n, peak, family, fault) in enumerate(cases):
        if family == "uniform" and fault in SINGLE:
            continue
        mask, name = MASKS[(turn + number) % len(MASKS)], plain[number % len(plain)]
        case = mask, name, family, n, peak, options.seed + 100 * turn + number % 97
        judged = faulty(fault, *case)
        if judged is None:
            continue
        found, reported = judged
        note(fault, case, found, reported)
        counts["harmless"].append(found == "harmless")
        if found != "harmless":
            for key in (f"fault {fault}", f"family {family}", f"pixels {n}", f"peak {peak:g}", "all"):
                counts[f"{key} flagged"].append(found != "missed")
            if fault in IN_FRAMES and found != "missed" and "refused" not in reported:
                for key in (f"fault {fault}", "all"):
                    counts[f"{key} named"].append(found == "named")
    for number in range(options.fitting):
        name, family = SCENES[number % len(SCENES)], options.families[number % len(options.families)]
        n, peak = options.sizes[number // 7 % len(options.sizes)], options.peaks[number // 3 % len(options.peaks)]
        case = MASKS[number // 5 % len(MASKS)], name, family, n, peak, options.seed + 5000 + number
        reported = verdict(*run_of(*case), scene(name, n, case[-1]))
        alarm = "refused" in reported or bool(reported["named"] or reported["pixels"] or reported["readings"])
        alarm |= bool(reported.get("misfit")) and name not in GLOSSY
        counts["false alarms"].append(alarm)
        note(None, case, "alarm" if alarm else "good", reported)
    rates = {key: interval(sum(each), len(each)) for key, each in sorted(counts.items())}
    write(options.json, {"rates": rates, "rows": rows})
    for key, (rate, low, high) in rates.items():
        print(f"{key:28s} {sum(counts[key]):4d} of {len(counts[key]):4d}: {rate:.1%} ({low:.1%} to {high:.1%})")
    if options.old:
        lost([row for row in rows if row["fault"]], options.old, lambda row: (row["fault"], *row["case"]))


if __name__ == "__main__":
    main()

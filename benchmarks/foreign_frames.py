"""Judge the frame checks of `reconstruct` on frames of another forward model: kinds of faults, severities, families.

    python benchmarks/foreign_frames.py --json FILE [--kinds ...] [--families ...] [--severities 0 1 2] [--runs 1]
        [--good 0] [--seed 0] [--peaks 20000 ...] [--old OLD.json]

The forward model below is written in numpy and shares no code with mitsim. Only the stripes of the calibration session
are taken from mitsim, because its list of frames counts them in mitsim's order. Cameras have 48 to 128 sensor pixels
and 24 to 48 scene pixels a side, the brightest pixel gets 50 to 20 000 electrons, and there are ten kinds of pictures.
Frames go through `ms.calibrate_frames` (once for each camera), `ms.import_frames` and `ms.reconstruct`.

Each run has one fault. Its twin is the same run without the fault, with the same random numbers. A run counts as

- ``F`` flagged: refused, or flagged by the import or by the image;
- ``.`` not flagged, and the rms error against the truth is at most twice the stated rms uncertainty;
- ``L`` as ``S``, but the image states the limit (``limits`` in result.json), and the same run with a uniform closing
  frame, which the limit names as the remedy, is flagged;
- ``S`` silent: not flagged, the error is more than twice the stated one, and the fault adds to it: it is more than 1.2
  times that of the twin;
- ``T`` not flagged, the error is more than twice the stated one, and that of the twin is as large: the uncertainty is
  too small for other reasons than the fault.

An image that states no uncertainty counts as silent where its error is more than twice that of its twin.
``--good`` adds runs without a fault. Their false alarms are refusals, warnings of the import, and flags of the misfit;
flags for other reasons, for example "Lambda takes away more of the image than it leaves", are counted apart. The table
shows, for each kind and family, one letter for each run, ordered by severity. ``--old`` compares with an earlier
file and lists the runs that were flagged there and are not flagged now. A run takes about 0.5 s.
"""

from __future__ import annotations

import json
import tempfile
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from harness import arguments, lost, ratios, show, write
from PIL import Image
from scipy.linalg import hadamard
from scipy.ndimage import gaussian_filter, median_filter

import mitsim as ms
from mitsim.devices.patterns import stripe_signs

# ---- Forward model: mask, scene, patterns, sensor --------------------------------------------------------------------

SENSOR_MM, MASK_MM, SCENE_MM, WINDOW_MM = 6.0, 5.0, 400.0, 120.0
"""Width of the sensor, distances of mask and scene, width of the projector's window at the scene."""
PARTS = 4
"""Parts of a projector pixel a side, so that a picture can move by part of a pixel."""


@dataclass(frozen=True)
class Camera:
    """A camera with a separable mask, and its electronics."""

    n: int
    pixels: tuple[int, int]
    seed: int
    feature_mm: float = 0.06
    baseline_mm: float = 0.0
    gain: float = 0.2
    black: float = 100.0
    read: float = 4.0
    dark: float = 30.0
    bits: int = 13

    def code(self, axis: int, flipped: float = 0.0) -> np.ndarray:
        """(features,) open and closed features of a side; the part ``flipped`` of them is drawn anew."""
        rng = np.random.default_rng([self.seed, axis])
        code = rng.integers(0, 2, 401).astype(float)
        drawn = rng.random(401) < flipped
        return np.where(drawn, rng.integers(0, 2, 401), code)

    @lru_cache(maxsize=64)  # noqa: B019 - cameras are few and live as long as the process
    def side(self, axis: int, moved: float = 0.0, nearer: float = 0.0, mask: float = 0.0, flipped: float = 0.0) -> Any:
        """(pixels, PARTS n) light of the parts of projector pixels at sensor pixels.

        Parameters
        ----------
        axis
            0 of rows, 1 of columns.
        moved
            of the sensor, in its pixels.
        nearer, mask
            relative change of the depth of the scene, and of the distance of the mask.
        flipped
            part of the mask's features that are drawn anew.
        """
        code, size = self.code(axis, flipped), self.pixels[axis]
        edges = (np.arange(len(code) + 1) - len(code) / 2) * self.feature_mm
        open_up_to = np.concatenate([[0.0], np.cumsum(code) * self.feature_mm])
        depth, distance = SCENE_MM * (1 + nearer), MASK_MM * (1 + mask)
        pitch, cell = SENSOR_MM / size, WINDOW_MM / SCENE_MM / (self.n * PARTS)
        inside = (np.arange(16) + 0.5) / 16 - 0.5
        place = (np.arange(size) - (size - 1) / 2 + moved) * pitch
        tangent = (np.arange(self.n * PARTS) - (self.n * PARTS - 1) / 2) * cell
        if axis:
            tangent = tangent + self.baseline_mm * (1 / depth - 1 / SCENE_MM)
        at = (place[:, None] + inside * pitch)[..., None] * (1 - distance / depth) + tangent * distance
        half = cell * distance / 2
        seen = np.interp(at + half, edges, open_up_to) - np.interp(at - half, edges, open_up_to)
        fall_off = 1 - 0.3 * np.square(2 * place / SENSOR_MM)
        return seen.mean(axis=1) / (2 * half) * fall_off[:, None] / PARTS

    def factor(self, axis: int) -> np.ndarray:
        """(pixels, n) light of whole projector pixels."""
        return np.asarray(self.side(axis).reshape(self.pixels[axis], self.n, PARTS).sum(axis=2))

    def numbers(self, light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Digital numbers of expected photoelectrons ``light``."""
        charge = rng.poisson(np.maximum(light, 0) + self.dark) + self.read * rng.standard_normal(light.shape)
        return np.asarray(np.clip(np.rint(self.black + self.gain * charge), 0, 2**self.bits - 1))


CAMERAS = (
    Camera(32, (96, 112), 1),
    Camera(24, (48, 64), 2, gain=0.25, read=6.0, black=64.0),
    Camera(48, (128, 128), 3, dark=5.0, baseline_mm=20.0),
    Camera(40, (112, 96), 4, gain=0.1, bits=12, read=8.0, black=32.0),
    Camera(32, (72, 72), 15, feature_mm=0.05, gain=0.6, bits=14, read=2.0, black=200.0),
    Camera(28, (80, 72), 6, dark=80.0, baseline_mm=-15.0),
)
SQUARE = CAMERAS[2], CAMERAS[4]
PEAKS = 2e4, 8e3, 2e3, 300.0, 50.0
"""Photoelectrons of the brightest pixel."""
PICTURES = "smooth", "leaves", "text", "noise", "blocks", "even", "stars", "random", "stripes", "checkers"


def picture(name: str, n: int, seed: int) -> np.ndarray:
    """(n, n) reflectances."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    y, x = np.mgrid[:n, :n] / n
    phase = rng.random(4)
    if name == "smooth":
        return np.asarray(0.5 + 0.3 * np.sin(2 * np.pi * (x + phase[0])) * np.cos(2 * np.pi * (1.3 * y + phase[1])))
    if name == "noise":  # amplitude falls with frequency
        frequency = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.fftfreq(n))
        frequency[0, 0] = 1.0
        values = np.real(np.fft.ifft2(np.fft.fft2(rng.standard_normal((n, n))) / frequency))
        return np.asarray(np.clip(0.5 + 0.18 * (values - values.mean()) / values.std(), 0.02, 1.0))
    if name == "even":
        return np.full((n, n), 0.3 + 0.6 * phase[0])
    if name == "random":
        return rng.random((n, n))
    if name == "stripes":
        bars = np.sin(2 * np.pi * (x * (3 + 5 * phase[0]) + y * 4 * phase[1] + phase[2]))
        return np.asarray(0.5 + 0.4 * np.sign(bars))
    if name == "checkers":
        return np.asarray(0.15 + 0.7 * ((np.indices((n, n)) // rng.integers(1, 5)).sum(axis=0) % 2))
    if name == "stars":
        values = np.full((n, n), 0.02)
        values[tuple(rng.integers(0, n, (2, n)))] = rng.uniform(0.2, 1.0, n)
        return values
    if name == "text":
        values = np.full((n, n), 0.85)
        for line in range(2, n - 4, 7):
            values[line : line + 5][rng.random((5, n)) < 0.4] = 0.08
        return values
    values = np.full((n, n), 0.4)
    for _ in range(60 if name == "leaves" else 12):
        row, column, size = rng.random(), rng.random(), 0.03 + 0.2 * rng.random() ** 3
        if name == "leaves":
            values[np.hypot(y - row, x - column) < size] = rng.uniform(0.05, 0.95)
        else:
            height, width = rng.uniform(0.05, 0.5, 2)
            values[(abs(y - row) < height / 2) & (abs(x - column) < width / 2)] = rng.uniform(0.05, 0.95)
    return values


def family(name: str, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """P_L and P_R (n, K) of a pattern family; `repeats:K` shows the uniform pattern K x K times."""
    kind, _, size = name.partition(":")
    k, pixels = int(size or 1), np.arange(n)
    if kind == "dots":
        return (side := (pixels[:, None] % k == np.arange(k)) * 1.0), side
    if kind == "hadamard":
        return (side := hadamard(k).astype(float)[pixels % k]), side
    if kind == "random":
        rng = np.random.default_rng([seed, n])
        drawn = [rng.integers(0, 2, (n, k)).astype(float) for _ in range(2)]
        for side in drawn:
            side[~side.any(axis=1), int(rng.integers(k))] = 1.0
        return drawn[0], drawn[1]
    return np.ones((n, k)), np.ones((n, k))


@dataclass
class Run:
    """One capture that a fault changes before it is exposed: its light, what is done to its numbers, what is stated."""

    camera: Camera
    family: str
    picture: str
    peak: float
    seed: int
    stated: dict[str, float] = field(default_factory=dict)
    after: list[Callable[[list[np.ndarray]], list[np.ndarray]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.scene = picture(self.picture, self.camera.n, self.seed)
        self.sides = family(self.family, self.camera.n, self.seed)
        self.signed = self.family.startswith("hadamard")
        signs = (1, -1) if self.signed else (0,)
        columns = range(self.sides[1].shape[1])
        self.shots = [(i, j, sign) for i in range(self.sides[0].shape[1]) for j in columns for sign in signs]
        self.rows, self.columns = np.indices(self.camera.pixels)
        self.exposure = 1.0
        light = [self.light_of(shot) for shot in range(len(self.shots))]
        self.exposure = self.peak / max(float(each.max()) for each in light)
        self.light = [each * self.exposure for each in light]

    @property
    def peak_dn(self) -> float:
        """Digital numbers of the brightest pixel above the black level."""
        return self.peak * self.camera.gain

    def time(self, shot: int) -> float:
        """Part of the run at which a ``shot`` is taken."""
        return shot / (len(self.light) - 1)

    def lamp(self, shot: int) -> np.ndarray:
        """(n, n) part of full power that each projector pixel emits in a ``shot``."""
        i, j, sign = self.shots[shot]
        pattern = np.outer(self.sides[0][:, i], self.sides[1][:, j])
        return pattern if sign == 0 else (1 + sign * pattern) / 2

    def light_of(
        self,
        shot: int,
        scene: np.ndarray | None = None,
        steps: tuple[int, int] = (0, 0),
        lamp: np.ndarray | None = None,
        **camera: float,
    ) -> np.ndarray:
        """Expected photoelectrons of a ``shot``.

        Parameters
        ----------
        shot
            its number.
        scene, lamp
            (n, n) reflectances and projector's light; None: those of the run.
        steps
            motion of the picture, in parts of a projector pixel, under the same light.
        **camera
            of :meth:`Camera.side`.
        """
        whole = np.ones((PARTS, PARTS))
        fine = np.kron(self.scene if scene is None else scene, whole)
        for axis, step in enumerate(steps):
            places = np.clip(np.arange(len(fine)) - step, 0, len(fine) - 1)
            fine = fine.take(places, axis=axis)
        lit = fine * np.kron(self.lamp(shot) if lamp is None else lamp, whole)
        left, right = (self.camera.side(axis, **camera) for axis in (0, 1))
        return np.asarray(left @ lit @ right.T) * self.exposure

    def frames(self) -> list[np.ndarray]:
        """Digital numbers of all shots."""
        rngs = (np.random.default_rng([self.seed, 5, shot]) for shot in range(len(self.light)))
        made = [self.camera.numbers(light, rng) for light, rng in zip(self.light, rngs, strict=True)]
        for change in self.after:
            made = change(made)
        return made


# ---- Faults: each changes a run, and returns the numbers of its wrong frames; empty: all, or none in particular ------

Level = Any
Fault = Callable[[Run, Level, np.random.Generator], "set[int] | None"]
Light = Callable[[np.ndarray, int], np.ndarray]
"""Light of a frame and the number of its shot in, light out."""


def some_shots(run: Run, rng: np.random.Generator, count: int = 1) -> set[int]:
    """Return shots that have at least a third of the mean light of the brightest."""
    means = np.array([light.mean() for light in run.light])
    bright = np.flatnonzero(means > means.max() / 3)
    return {int(shot) for shot in rng.choice(bright, min(count, max(len(run.shots) // 3, 1)), replace=False)}


def every(make: Callable[[Run, Level, np.random.Generator], Light]) -> Fault:
    """The light of all frames is changed."""

    def lay(run: Run, level: Level, rng: np.random.Generator) -> None:
        change = make(run, level, rng)
        run.light = [change(light, shot) for shot, light in enumerate(run.light)]

    return lay


def single(
    change: Callable[[Run, Level, np.random.Generator, np.ndarray, int], np.ndarray], many: bool = False
) -> Fault:
    """The light of one frame is changed, or of as many as the level says."""

    def lay(run: Run, level: Level, rng: np.random.Generator) -> set[int]:
        shots = some_shots(run, rng, level if many else 1)
        for shot in shots:
            run.light[shot] = change(run, level, rng, run.light[shot], shot)
        return shots

    return lay


def numbers(make: Callable[[Run, Level, np.random.Generator], Callable[[np.ndarray], np.ndarray]]) -> Fault:
    """The digital numbers of each frame are changed on their own."""

    def lay(run: Run, level: Level, rng: np.random.Generator) -> None:
        change = make(run, level, rng)
        run.after.append(lambda frames: [change(frame.copy()) for frame in frames])

    return lay


def seen(camera: Callable[[Run, Level, np.random.Generator, int], dict[str, Any]]) -> Fault:
    """Frames are seen anew: arguments of :meth:`Run.light_of` by shot, which may be none."""

    def lay(run: Run, level: Level, rng: np.random.Generator) -> None:
        run.light = [run.light_of(shot, **camera(run, level, rng, shot)) for shot in range(len(run.light))]

    return lay


def stated(change: Callable[[Run, Level, np.random.Generator], dict[str, float]]) -> Fault:
    """Something else is stated of the camera."""
    return lambda run, level, rng: run.stated.update(change(run, level, rng))


def order(change: Callable[[Run, Level, np.random.Generator], tuple[list[int], set[int]]]) -> Fault:
    """Frames are in another order: for each place the shot there, and the places at fault."""

    def lay(run: Run, level: Level, rng: np.random.Generator) -> set[int]:
        places, wrong = change(run, level, rng)
        run.light = [run.light[place] for place in places]
        return wrong

    return lay


def hand(count: int) -> Fault:
    """A dark hand of some radius, part of the scene, is in some successive frames."""

    def lay(run: Run, level: Level, rng: np.random.Generator) -> set[int]:
        some = min(count, max(len(run.light) // 2, 1))
        first = int(rng.integers(len(run.light) - some + 1))
        y, x = np.mgrid[: run.camera.n, : run.camera.n] / run.camera.n
        row, column = rng.uniform(0.2, 0.8, 2)
        scene = np.where(np.hypot(y - row, x - column) < level, 0.15 * run.scene, run.scene)
        for shot in range(first, first + some):
            run.light[shot] = run.light_of(shot, scene)
        return set(range(first, first + some))

    return lay


def other_scene(run: Run, level: float, rng: np.random.Generator, light: np.ndarray, shot: int) -> np.ndarray:
    other = picture(PICTURES[(PICTURES.index(run.picture) + 1) % 5], run.camera.n, run.seed + 1)
    return np.asarray((1 - level) * light + level * run.light_of(shot, other))


def repeated(run: Run, level: int, rng: np.random.Generator) -> set[int]:
    shots = some_shots(run, rng, level)
    run.after.append(lambda frames: [frames[k - 1] if k in shots else frame for k, frame in enumerate(frames)])
    return shots


def swapped(run: Run, level: int, rng: np.random.Generator) -> tuple[list[int], set[int]]:
    count = len(run.light)
    places, wrong = list(range(count)), set[int]()
    for first in some_shots(run, rng) if level else (1, count // 2, count - 3):
        other = (first + (level or 1)) % count
        places[first], places[other] = places[other], places[first]
        wrong |= {first, other}
    return places, wrong


def other_order(run: Run, level: str, rng: np.random.Generator) -> tuple[list[int], set[int]]:
    count = len(run.light)
    if level == "reversed":
        return list(range(count))[::-1], set()
    if level == "column-major":
        key = [(j, i, -sign) for i, j, sign in run.shots]
        return sorted(range(count), key=key.__getitem__), set()
    if run.signed:
        changes = [int((np.diff(side) != 0).sum()) for side in hadamard(run.sides[0].shape[1])]
        number = {shot: k for k, shot in enumerate(run.shots)}
        return [number[changes.index(i), changes.index(j), sign] for i, j, sign in run.shots], set()
    return [*range(count // 2, count), *range(count // 2)], set()


def lag(run: Run, level: float, rng: np.random.Generator) -> None:
    before = [run.light[0], *run.light[:-1]]
    run.light = [(1 - level) * light + level * last for light, last in zip(run.light, before, strict=True)]


def dust(run: Run, level: float, rng: np.random.Generator) -> Light:
    spots = np.zeros(run.camera.pixels, bool)
    for row, column in rng.uniform(0, 1, (5, 2)) * run.camera.pixels:
        spots |= np.hypot(run.rows - row, run.columns - column) < 2.5
    return lambda light, shot: light * (1 - level * spots)


def hair(run: Run, level: float, rng: np.random.Generator) -> Light:
    angle, place = rng.uniform(0, np.pi), rng.uniform(0.3, 0.7, 2) * run.camera.pixels
    distance = (run.rows - place[0]) * np.cos(angle) + (run.columns - place[1]) * np.sin(angle)
    return lambda light, shot: light * (1 - level * (abs(distance) < 0.8))


def hot_pixels(run: Run, level: int, rng: np.random.Generator) -> Light:
    hot = np.zeros(run.camera.pixels)
    hot.flat[rng.choice(hot.size, level, replace=False)] = rng.uniform(0.2, 1.0, level) * run.peak
    return lambda light, shot: light + hot


def hot_column(run: Run, level: float, rng: np.random.Generator) -> Light:
    column = run.columns == int(rng.integers(run.camera.pixels[1]))
    return lambda light, shot: light + level * run.peak * column * (shot >= len(run.light) // 2)


def region(run: Run, level: float, rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    sizes = [int(level * size) for size in run.camera.pixels]
    at = [int(rng.integers(size - own + 1)) for size, own in zip(run.camera.pixels, sizes, strict=True)]
    place = tuple(slice(first, first + own) for first, own in zip(at, sizes, strict=True))

    def shifted(frame: np.ndarray) -> np.ndarray:
        frame[place] = np.roll(frame[place], 1, axis=1)
        return frame

    return shifted


def dropped_line(run: Run, level: str, rng: np.random.Generator) -> set[int]:
    count = len(run.light)
    shots = {"one": some_shots(run, rng), "half": set(range(count // 2, count)), "all": set(range(count))}[level]
    line = int(rng.integers(run.camera.pixels[0] // 4, 3 * run.camera.pixels[0] // 4))
    for shot in shots:
        run.light[shot] = np.concatenate([np.delete(run.light[shot], line, axis=0), run.light[shot][-1:]])
    return shots if level == "one" and count > 1 else set()


def bands(run: Run, level: float, rng: np.random.Generator) -> None:
    period, phases, most = rng.uniform(6, 20), rng.uniform(0, 2 * np.pi, len(run.light)), 2**run.camera.bits - 1

    def change(frames: list[np.ndarray]) -> list[np.ndarray]:
        waves = [level * run.peak_dn * np.sin(2 * np.pi * run.rows / period + phase) for phase in phases]
        return [np.clip(np.rint(frame + wave), 0, most) for frame, wave in zip(frames, waves, strict=False)]

    run.after.append(change)


def row_flicker(run: Run, level: float, rng: np.random.Generator) -> Light:
    period = run.camera.pixels[0] / rng.uniform(1.2, 3.0)
    phases = rng.uniform(0, 2 * np.pi, len(run.light))
    return lambda light, shot: light * (1 + level * np.sin(2 * np.pi * run.rows / period + phases[shot]))


def gamma(run: Run, level: float, rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    black, span = run.camera.black, 2**run.camera.bits - 1 - run.camera.black
    return lambda frame: np.rint(black + span * (np.maximum(frame - black, 0) / span) ** level)


def jpeg(run: Run, level: int, rng: np.random.Generator) -> None:
    def packed(frames: list[np.ndarray]) -> list[np.ndarray]:
        scale, made = 255 / max(float(frame.max()) for frame in frames), []
        for frame in frames:
            with tempfile.TemporaryFile() as file:
                Image.fromarray(np.rint(frame * scale).astype(np.uint8)).save(file, "JPEG", quality=level)
                file.seek(0)
                made.append(np.rint(np.asarray(Image.open(file), float) / scale))
        return made

    run.after.append(packed)


def gloss(run: Run, level: float, rng: np.random.Generator) -> Light:
    rows, columns = run.rows / run.camera.pixels[0], run.columns / run.camera.pixels[1]
    row, column = rng.uniform(0.2, 0.8, 2)
    bump = 1 + level * np.exp(-(np.square(rows - row) + np.square(columns - column)) / 0.08)
    return lambda light, shot: light * bump


def leak(run: Run, level: float, rng: np.random.Generator, shot: int) -> dict[str, Any]:
    lamp = run.lamp(shot)
    return {"lamp": lamp + level * (1 - lamp)}


def level_of(run: Run, level: float, rng: np.random.Generator) -> dict[str, float]:
    step = max(level * run.peak_dn, 0.5) * rng.choice([-1, 1])
    return {"black": max(run.camera.black + step, 0.0)}


def nearer(run: Run, level: float, rng: np.random.Generator) -> Fault:
    moved = level * rng.choice([-1, 1])
    return seen(lambda run, level, rng, shot: {"nearer": moved})


TURNS = {"left-right": (1, -1), "up-down": (-1, 1), "half turn": (-1, -1)}
TRANSPOSED = {"transposed": (1, 1), "quarter turn": (-1, 1), "other diagonal": (-1, -1)}
FAULTS: dict[str, tuple[tuple[Any, ...], Fault, str]] = {
    # True gain and read noise over the stated ones; error of the black level, part of the peak.
    "gain": ((0.5, 2.0, 4.0), stated(lambda run, level, rng: {"gain": run.camera.gain / level}), ""),
    "black_level": ((0.003, 0.02, 0.1), stated(level_of), ""),
    "read_noise": ((0.3, 2.0, 5.0), stated(lambda run, level, rng: {"read": run.camera.read / level}), ""),
    # Single frames: part of another scene, pixels of a roll, frames saved again or black, rows lost, light.
    "foreign": ((0.2, 0.5, 1.0), single(other_scene), "time"),
    "rolled": ((1, 2, 6), single(lambda run, level, rng, light, shot: np.roll(light, level, rng.integers(2))), "time"),
    "repeated": ((1, 2, 4), repeated, "frames"),
    "black_frame": ((1, 2, 4), single(lambda run, level, rng, light, shot: 0 * light, many=True), "time"),
    "half_lost": ((0.1, 0.3, 0.6), single(
        lambda run, level, rng, light, shot: light * (run.rows < (1 - level) * run.camera.pixels[0])), "time"),
    "dimmed": ((0.97, 0.9, 0.5), single(lambda run, level, rng, light, shot: light * level), "time"),
    "hand_in_three": ((0.1, 0.2, 0.35), hand(3), "time"),
    "hand_in_one": ((0.1, 0.2, 0.35), hand(1), "time"),
    # Time: deviation of the power, its loss, sensor pixels of motion midway or even, quarters of scene pixels, order.
    "flicker": ((0.01, 0.03, 0.1), every(
        lambda run, level, rng: lambda light, shot: light * (1 + level * rng.standard_normal())), "time"),
    "drift": ((0.02, 0.05, 0.1), every(
        lambda run, level, rng: lambda light, shot: light * (1 - level * run.time(shot))), "time"),
    "camera_moved": ((0.1, 0.5, 1.0), seen(
        lambda run, level, rng, shot: {"moved": level * (2 * shot >= len(run.light))}), "time"),
    "camera_creeps": ((0.1, 0.5, 1.0), seen(
        lambda run, level, rng, shot: {"moved": level * (8 * shot // len(run.light)) / 7}), "time"),
    "scene_moved": ((1, 2, 4), seen(
        lambda run, level, rng, shot: {"steps": (level * (2 * shot >= len(run.light)), 0)}), "time"),
    "swapped": ((1, 5, 0), order(swapped), "frames"),
    "lag": ((0.01, 0.05, 0.2), lag, "frames"),
    "order": (("column-major", "reversed", "sequency or halves"), order(other_order), "frames"),
    "late": ((1, 2, -1), order(
        lambda run, level, rng: ([(k - level) % len(run.light) for k in range(len(run.light))], set())), "frames"),
    # Sensor: light taken by dust and a hair, hot pixels and columns, dead rows, moved regions, lost lines, bands.
    "dust": ((0.05, 0.2, 0.6), every(dust), ""),
    "hair": ((0.1, 0.4, 0.9), every(hair), ""),
    "hot_pixels": ((3, 20, 100), every(hot_pixels), ""),
    "hot_column": ((0.02, 0.1, 0.5), every(hot_column), "time"),
    "dead_row": ((1, 2, 4), every(lambda run, level, rng: (lambda dead: lambda light, shot: light * ~dead)(
        np.isin(run.rows, rng.choice(run.camera.pixels[0], level, replace=False)))), ""),
    "region": ((0.15, 0.3, 0.5), numbers(region), ""),
    "dropped_line": (("one", "half", "all"), dropped_line, ""),
    "bands": ((0.002, 0.01, 0.05), bands, ""),
    "row_flicker": ((0.01, 0.05, 0.2), every(row_flicker), ""),
    # Numbers: clipped from a part of the peak, smoothed, by a tone curve, of other bits, packed, smeared, turned.
    "clipped": ((0.8, 0.65, 0.5), numbers(lambda run, level, rng: lambda frame: np.minimum(
        frame, np.rint(run.camera.black + level * run.peak_dn + run.camera.gain * run.camera.dark))), ""),
    "denoised": ((0.3, 0.7, 1.0), numbers(lambda run, level, rng: lambda frame: np.rint(
        (1 - level) * frame + level * median_filter(frame, 3))), ""),
    "blurred": ((0.4, 0.7, 1.5), numbers(
        lambda run, level, rng: lambda frame: np.rint(gaussian_filter(frame, level))), ""),
    "gamma": ((0.95, 0.8, 1 / 2.2), numbers(gamma), ""),
    "nonlinear": ((0.02, 0.1, 0.3), every(
        lambda run, level, rng: lambda light, shot: light * (1 - level * light / run.peak)), ""),
    "bits": ((10, 8, 6), numbers(lambda run, level, rng: lambda frame: np.floor(
        frame / 2 ** (run.camera.bits - level)) * 2 ** (run.camera.bits - level)), ""),
    "aligned": ((2, 4, 8), numbers(
        lambda run, level, rng: lambda frame: np.minimum(frame * level, 65535 // level * level)), ""),
    "jpeg": ((95, 75, 40), jpeg, ""),
    "smear": ((0.005, 0.02, 0.1), every(
        lambda run, level, rng: lambda light, shot: light + level * light.mean(axis=0)), ""),
    "turned": ((*TURNS,), every(
        lambda run, level, rng: lambda light, shot: light[:: TURNS[level][0], :: TURNS[level][1]].copy()), ""),
    "transposed": ((*TRANSPOSED,), every(lambda run, level, rng: lambda light, shot: light.T[
        :: TRANSPOSED[level][0], :: TRANSPOSED[level][1]].copy()), "square"),
    # Light and optics: ambient light by the peak, even, growing and tilted; glare; dark pixels that leak; depth; gloss.
    "ambient": ((0.02, 0.1, 0.3), every(lambda run, level, rng: lambda light, shot: light + level * run.peak), ""),
    "ambient_growing": ((0.01, 0.05, 0.2), every(
        lambda run, level, rng: lambda light, shot: light + level * run.peak * run.time(shot)), "time"),
    "ambient_tilted": ((0.01, 0.05, 0.2), every(lambda run, level, rng: lambda light, shot: light
        + level * run.peak * run.columns / run.camera.pixels[1]), ""),
    "glare": ((0.02, 0.1, 0.3), every(lambda run, level, rng: lambda light, shot: light + level * light.mean()), ""),
    "leak": ((0.01, 0.05, 0.2), seen(leak), "frames"),
    "depth": ((0.01, 0.03, 0.1), lambda run, level, rng: nearer(run, level, rng)(run, level, rng), ""),
    "gloss": ((0.01, 0.05, 0.2), every(gloss), ""),
    # The mask since the calibration: features drawn anew, its distance, sensor pixels that it moved.
    "another_mask": ((0.05, 0.25, 1.0), seen(lambda run, level, rng, shot: {"flipped": level}), ""),
    "mask_distance": ((0.002, 0.01, 0.03), seen(lambda run, level, rng, shot: {"mask": level}), ""),
    "old_calibration": ((0.1, 0.3, 1.0), seen(lambda run, level, rng, shot: {"moved": level}), ""),
}  # fmt: skip
"""Levels of the three severities, the fault, and what it needs: "frames" that differ, "time", "square" or nothing."""


# ---- Frames handed to mitsim -----------------------------------------------------------------------------------------

FAMILIES = "repeats:2", "dots:4", "hadamard:4", "random:5"


def write_frames(frames: list[np.ndarray], folder: Path) -> None:
    """Write frames as numbered files."""
    folder.mkdir(parents=True)
    for number, frame in enumerate(frames):
        np.save(folder / f"f_{number:04d}.npy", frame.astype(np.uint16))


class Judge:
    """Calibrations of all cameras, and what mitsim reports of runs."""

    def __init__(self, folder: Path, seed: int, peaks: Sequence[float] = PEAKS) -> None:
        self.folder, self.seed, self.peaks, self.count = folder, seed, peaks, 0
        self.calibrations: dict[Camera, tuple[Path, Any]] = {}
        self.twin = cache(self._twin)

    def calibration(self, camera: Camera) -> tuple[Path, Any]:
        """The CAL folder and factors of a session of a ``camera``, 2e4 electrons at its brightest pixel."""
        if camera not in self.calibrations:
            place = self.folder / f"camera{len(self.calibrations)}"
            stripes, ones = stripe_signs(camera.n).astype(float), np.ones(camera.n)
            left, right = camera.factor(0), camera.factor(1)
            shown = [np.outer(column, ones) for column in stripes.T] + [np.outer(ones, column) for column in stripes.T]
            light = [left @ ((1 + sign * pattern) / 2) @ right.T for pattern in shown for sign in (1, -1)]
            exposure = 2e4 / max(float(each.max()) for each in light)
            rng = np.random.default_rng([self.seed, camera.seed, 9])
            write_frames([camera.numbers(exposure * each, rng) for each in light], place / "frames")
            digital = {
                "exposure_s": exposure,
                "gain_dn_per_e": camera.gain,
                "black_level_dn": camera.black,
                "dark_current_e_per_s": camera.dark / exposure,
                "read_noise_e": camera.read,
                "step_dn": 1.0,
                "saturation_dn": 2.0**camera.bits - 1,
            }
            listed = {"camera": "own", "n": camera.n, "signed_capture": "pair", "digital": digital}
            (place / "frames" / "session.json").write_text(json.dumps(listed))
            factors = ms.calibrate_frames(place / "frames", place / "cal")
            if not factors.ok:
                raise SystemExit(f"the calibration of camera {camera} is flagged, which hides faults: {factors.status}")
            self.calibrations[camera] = place / "cal", factors
        return self.calibrations[camera]

    def report(self, run: Run, last: tuple[float, np.ndarray] | None = None) -> dict[str, Any]:
        """What mitsim reports of a run, and its error; ``last`` are exposure and numbers of a uniform closing frame."""
        calibration, factors = self.calibration(run.camera)
        self.count += 1
        place, camera = self.folder / f"run{self.count}", run.camera
        write_frames([*run.frames(), *([last[1]] if last else [])], place / "frames")
        stated = {"gain": camera.gain, "black": camera.black, "read": camera.read, **run.stated}
        (place / "camera.toml").write_text(
            f'name = "own"\npixel_pitch_um = {1000 * SENSOR_MM / camera.pixels[0]}\nfull_well_e = 1e6\n'
            f"read_noise_e = {stated['read']}\ndark_current_e_per_s = {camera.dark / run.exposure}\n"
            f"quantum_efficiency = 0.7\ngain_dn_per_e = {stated['gain']}\nblack_level_dn = {stated['black']}\n"
            f'bits = {camera.bits}\nshutter = "global"\nsource = "own"\n'
        )
        patterns = run.family
        if not run.family.startswith(("dots", "hadamard", "uniform")):
            patterns = str(place / "patterns.json")
            shots = [{"row": i, "column": j, "sign": sign} for i, j, sign in run.shots]
            sides = {"P_L": run.sides[0].tolist(), "P_R": run.sides[1].tolist()}
            Path(patterns).write_text(json.dumps({"family": run.family, "n": camera.n, **sides, "shots": shots}))
        try:
            imported = ms.import_frames(
                place / "frames",
                place / "run",
                patterns=patterns,
                camera=str(place / "camera.toml"),
                exposure=run.exposure,
                calibration=str(calibration),
                closing_frame="uniform" if last else None,
                closing_exposure=last[0] if last else None,
            )
            image = ms.reconstruct(ms.load_run(place / "run"), factors)
        except ms.MitsimError as error:
            return {"flagged": True, "refused": True, "misfit": True, "words": str(error), "named": []}
        finally:
            for file in sorted(place.rglob("*"), reverse=True):
                file.rmdir() if file.is_dir() else file.unlink()
        warnings, found = list(imported["warnings"]), image.misfit.summary() if image.misfit else {}
        difference, known = image.image - run.scene, image.uncertainties
        return {
            "flagged": bool(warnings) or not image.ok,
            "refused": False,
            "misfit": bool(warnings) or bool(found.get("flagged")),
            "warned": bool(warnings),
            "words": "; ".join([*warnings, str(image.status), *image.trust]),
            "chi_square": found.get("chi_square"),
            "unexplained": found.get("unexplained"),
            "limits": [each["words"] for each in found.get("limits") or []],
            "cause": found.get("cause"),
            "named": sorted({n for one in found.get("faults") or [] for n in one["frames"]}),
            "stated": float(np.sqrt(np.mean(np.square(known.total)))) if known else None,
            "error": float(np.sqrt(np.mean(np.square(difference)))),
            "inside": float(np.mean(np.abs(difference) < 1.96 * known.total)) if known else None,
            "lambda": image.lam,
            "extrapolated": bool(known and known.extrapolated),
        }

    def _twin(self, camera: Camera, name: str, shown: str, peak: float, seed: int) -> dict[str, Any]:
        return self.report(Run(camera, name, shown, peak, seed))

    def case(self, index: int, name: str, seed: int, square: bool = False) -> tuple[Camera, str, str, float, int]:
        """Camera, family, picture, peak and seed of a run, in combinations that differ by index."""
        place = FAMILIES.index(name) if name in FAMILIES else 1
        cameras = SQUARE if square else CAMERAS
        shown = PICTURES[(index + 3 * place) % len(PICTURES)]
        camera = cameras[(index // 2 + place) % len(cameras)]
        peak = self.peaks[(index // 3 + 2 * place) % len(self.peaks)]
        return camera, name, shown, peak, 1000 * seed + index % 40

    def judged(self, kind: str, severity: int, name: str, number: int) -> dict[str, Any] | None:
        """One run with a fault beside its twin; None where the family cannot have the fault."""
        levels, lay, needs = FAULTS[kind]
        alone = name == "uniform" or name.endswith(":1")
        if (needs in ("frames", "time") and alone) or (needs == "frames" and name.startswith("repeats")):
            return None
        kind_number = list(FAULTS).index(kind)
        case = self.case(kind_number + 17 * severity + 41 * number, name, self.seed, needs == "square")
        begun = time.perf_counter()
        run = Run(*case)
        wrong = lay(run, levels[severity], np.random.default_rng([self.seed, kind_number, severity, number]))
        found, twin = self.report(run), self.twin(*case)
        beyond, added = is_harmed(found, twin)
        letter, closed = "F" if found["flagged"] else "." if not beyond else "S" if added else "T", None
        if letter in "ST" and found.get("limits"):
            closed = self.report(run, closing_frame(run, kind, levels[severity]))
            letter = "L" if letter == "S" and closed["flagged"] else letter
        return {
            "kind": kind,
            "severity": severity,
            "level": levels[severity],
            **described(case),
            "run": number,
            **found,
            "wrong": sorted(wrong or ()),
            "twin": {key: twin.get(key) for key in ("flagged", "misfit", "stated", "error", "inside", "chi_square")},
            "harmful": beyond and added,
            "verdict": letter,
            "with_closing_frame": closed,
            "seconds": time.perf_counter() - begun,
        }


def closing_frame(run: Run, kind: str, level: Any) -> tuple[float, np.ndarray]:
    """Exposure and numbers of a uniform frame at the end of a run, when what moved is still there."""
    part = run.exposure / max(len(run.light), 4)
    moves: dict[str, dict[str, Any]] = {
        "scene_moved": {"steps": (level, 0)},
        "camera_moved": {"moved": level},
        "camera_creeps": {"moved": level},
    }
    camera, rng = run.camera, np.random.default_rng([run.seed, 6])
    light = run.light_of(0, lamp=np.ones((camera.n, camera.n)), **moves.get(kind, {})) * part / run.exposure
    power = 1 - level if kind == "drift" else 1 + level * rng.standard_normal() if kind == "flicker" else 1.0
    numbers = replace(camera, dark=camera.dark * part / run.exposure).numbers(light * power, rng)
    for change in run.after:
        (numbers,) = change([numbers])
    return part, numbers


def described(case: tuple[Camera, str, str, float, int]) -> dict[str, Any]:
    """The case as RESULT.json has it."""
    camera, name, shown, peak, seed = case
    return {"family": name, "camera": CAMERAS.index(camera), "picture": shown, "peak": peak, "seed": seed}


ADDED = 1.2
"""Error over that of the twin from which the fault, and not the noise or lambda, counts as its cause."""


def is_harmed(found: dict[str, Any], twin: dict[str, Any]) -> tuple[bool, bool]:
    """Return whether an image is off by more than twice what it states, and whether the fault adds to its error."""
    if found["refused"]:
        return False, False
    alone = twin.get("error", np.inf)
    limit = alone if found["stated"] is None else found["stated"]
    return bool(found["error"] > 2 * limit), bool(found["error"] > ADDED * alone)


# ---- Table -----------------------------------------------------------------------------------------------------------


def print_table(rows: list[dict[str, Any]], good: list[dict[str, Any]]) -> None:
    """Print letters by kind and family, counts by family, the silent runs, and the good runs."""
    families = list(dict.fromkeys(one["family"] for one in rows))
    print(f"{'kind':16s}", *(f"{name:>13s}" for name in families))
    for kind in dict.fromkeys(one["kind"] for one in rows):
        own = sorted((one for one in rows if one["kind"] == kind), key=lambda one: (one["severity"], one["run"]))
        letters = ["".join(one["verdict"] for one in own if one["family"] == name) or "-" for name in families]
        framed = [one for one in own if one["wrong"] and one["flagged"] and not one["refused"]]
        named = sum(set(one["wrong"]) <= set(one["named"]) for one in framed)
        counts = [f"{sum(one['verdict'] == letter for one in own)} {letter}" for letter in "FLS"]
        print(f"{kind:16s}", *(f"{each:>13s}" for each in letters), *counts, f"{named} of {len(framed)} named")
    for name in (*families, "all"):
        own = [one for one in rows if name in (one["family"], "all")]
        harmful = [one for one in own if one["harmful"]]
        counted: dict[str, Any] = {letter: sum(one["verdict"] == letter for one in own) for letter in "F.LST"}
        show(name, {"runs": len(own), **counted, "harmful": len(harmful), "flagged of these": sum(
            one["flagged"] for one in harmful)})  # fmt: skip
    shown = ("level", "run", "error", "stated", "extrapolated", "chi_square", "seed", "peak", "picture", "camera")
    for one in (one for one in rows if one["verdict"] in "LST"):
        row = {name: one[name] for name in shown}
        show(f"{one['verdict']} {one['kind']} {one['family']}", {**row, "without the fault": one["twin"]["error"]})
    if good:
        solved = [one for one in good if not one["refused"] and one["stated"]]
        show("good runs", {
            "runs": len(good), "false alarms": sum(one["misfit"] for one in good),
            "flagged for other reasons": sum(one["flagged"] and not one["misfit"] for one in good),
            **ratios([one["error"] / one["stated"] for one in solved]),
        })  # fmt: skip
        for one in (one for one in solved if one["error"] > 2 * one["stated"]):
            show(f"beyond twice the stated error {one['family']}", {name: one[name] for name in shown[2:]})


def main() -> None:
    parser = arguments(__doc__, seed=True, required=True)
    parser.add_argument("--kinds", nargs="*", default=list(FAULTS), choices=list(FAULTS), metavar="KIND")
    parser.add_argument("--families", nargs="+", default=FAMILIES)
    parser.add_argument("--severities", nargs="+", type=int, default=(0, 1, 2))
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--good", type=int, default=0, help="runs without a fault")
    parser.add_argument("--peaks", nargs="+", type=float, default=PEAKS, help="photoelectrons of the brightest pixel")
    parser.add_argument("--old", type=Path, help="earlier file to compare with")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    good: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        judge = Judge(Path(folder), options.seed, options.peaks)
        for kind in options.kinds:
            for name, severity, number in product(options.families, options.severities, range(options.runs)):
                if one := judge.judged(kind, severity, name, number):
                    rows.append(one)
                    if one["verdict"] in "ST":
                        show(one["verdict"], one)
            write(options.json, {"rows": rows, "good": good})
        for number in range(options.good):
            name = options.families[number % len(options.families)]
            case = judge.case(number // len(options.families), name, options.seed + 500 + number)
            good.append({**described(case), **judge.report(Run(*case))})
            if good[-1]["misfit"]:
                show("alarm", good[-1])
    write(options.json, {"rows": rows, "good": good})
    print_table(rows, good)
    if options.old:
        names = ("kind", "severity", "family", "run", "seed", "peak")
        lost(rows, options.old, lambda one: tuple(one[name] for name in names))


if __name__ == "__main__":
    main()

"""Outcome of calibration sessions with planted faults: right, refused or wrong.

    python benchmarks/session_faults.py --json FILE [--sessions 9] [--clean 200] [--kinds ...] [--seed 0] [--n 32 64]

Simulates sessions in numpy (geometric shadow of a mask, falloff, keystone, rotation, blur as by diffraction, Poisson
and read noise, rounding), writes them as files, and calibrates with
:func:`mitsim.reconstruct.captured_session.calibrate_frames`. Each session has a camera of its own by its seed.

A session is *right* if the relative error of both factors, in quadrature, is at most 1.5 times the stated one. It is
*refused* if the calibration raises MitsimError and names frames of the fault, or "all frames"; *misnamed* if it names
other frames. It is *wrong* otherwise. The true factors are those of the same session without noise and fault.
FILE has the outcome of each session, and counts by kind. With ``--uniform`` patterns are shown against one
uniform frame instead of in pairs.
"""

from __future__ import annotations

import json
import re
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from harness import arguments, ratios, show, write

from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas
from mitsim.devices.camera import centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.devices.patterns import stripe_signs
from mitsim.devices.session import SIDES, UNIFORM, Half, halves_in_order
from mitsim.reconstruct.captured_session import calibrate_frames
from mitsim.reconstruct.factors import Factors, predicted_error
from tests.shadow_factor import scene_factor
from tests.stripes import estimated

NOISE = 2.3e-3
"""Relative error of both factors, in quadrature, that the shipped session leaves with the anchor camera."""
BLACK, DARK, CODES, BRIGHTEST = 200.0, 20.0, 2**16, 5e4
"""DN, electrons a frame, codes, and DN of the brightest pixel at most."""
LIMIT = 1.5
"""Error over the stated one up to which a session is right."""


@dataclass(frozen=True)
class Camera:
    """An ideal camera before a white board, by its ``seed``, with ``n`` projector pixels."""

    seed: int
    n: int

    @cached_property
    def traits(self) -> dict[str, Any]:
        """Properties that differ from camera to camera."""
        rng = np.random.default_rng([self.seed, self.n])
        bent = rng.random() < 0.5
        return {
            "mask": str(rng.choice(["separable", "separable", "flatcam", "mura"])),
            "shape": (int(rng.integers(100, 200)), int(rng.integers(100, 200))),
            "view_mm": float(rng.uniform(3.5, 6.0)),
            "gap_mm": float(rng.uniform(1.5, 3.0)),
            "feature_mm": float(rng.uniform(0.05, 0.1)),
            "read_noise_e": float(rng.uniform(2, 15)),
            "ambient": float(rng.choice([0.0, rng.uniform(0, 0.2)])),
            "repeats": int(rng.choice([1, 1, 1, 2])),
            "level": float(np.exp(rng.uniform(0, np.log(10)))),
            "keystone": float(bent * rng.uniform(-0.004, 0.004)),
            "rotation": float(bent * rng.uniform(-0.001, 0.001)),
            "blur": float(rng.choice([0.0, rng.uniform(0.3, 0.8)])),
        }

    @property
    def centre(self) -> bool:
        return bool(self.traits["mask"] != "separable")

    def _factor(self, pixels: int, moved: float = 0.0, sensor: float = 0.0) -> np.ndarray:
        """(pixels, n) shadow of scene lines that are moved by a part of a line, on a sensor moved by pixels."""
        traits = self.traits
        code = np.asarray(mls_mask("separable").terms[0][1])
        if traits["mask"] == "mura":
            squares = {k * k % 251 for k in range(1, 251)}
            code = np.array([1.0 if k in squares else -1.0 for k in range(251)])
        elif traits["mask"] == "flatcam":
            code = 2 * code - 1
        edges = centred_edges(pixels, traits["view_mm"] / pixels) + sensor * traits["view_mm"] / pixels
        scene = centred_edges(self.n, 120 / self.n) + moved * 120 / self.n
        factor = scene_factor(code, traits["feature_mm"], edges, scene, traits["gap_mm"], 400.0)
        if traits["blur"]:
            reach = np.arange(-6, 7)
            kernel = np.exp(-0.5 * np.square(reach / traits["blur"])) + 0.01 / (1 + np.square(reach))
            padded = np.pad(factor, ((6, 6), (0, 0)), mode="edge")
            factor = np.apply_along_axis(np.convolve, 0, padded, kernel / kernel.sum(), "valid")
        return np.asarray(factor * (1 - 0.02 * np.square(np.linspace(-1, 1, self.n))))

    def terms(self, moved: tuple[float, float] = (0.0, 0.0)) -> list[tuple[np.ndarray, np.ndarray]]:
        """Separable terms of the camera: keystone and rotation move scene lines, to first order; ``moved`` are sensor
        pixels of a camera's motion."""
        shape, n, traits = self.traits["shape"], self.n, self.traits
        left, right = (self._factor(pixels, 0.0, by) for pixels, by in zip(shape, moved, strict=True))
        found = [(left, right)]
        place = np.linspace(-1, 1, n)
        if traits["keystone"] or traits["rotation"]:
            steep = [
                (self._factor(pixels, 0.25, by) - self._factor(pixels, -0.25, by)) / 0.5
                for pixels, by in zip(shape, moved, strict=True)
            ]
            keystone, turn = traits["keystone"] * n / 2, traits["rotation"] * n / 2
            found += [
                (steep[0] * (keystone * place), right * place),
                (steep[0] * turn, right * place),
                (left * -place, steep[1] * turn),
            ]
        return found

    @cached_property
    def still(self) -> list[tuple[np.ndarray, np.ndarray]]:
        return self.terms()

    def light(self, shown: np.ndarray, terms: list[tuple[np.ndarray, np.ndarray]] | None = None) -> np.ndarray:
        """(rows, columns) light of a pattern ``shown`` (n, n), 1 at the brightest pixel of the uniform one."""
        frame = sum(left @ shown @ right.T for left, right in terms or self.still)
        if self.centre:
            frame = (frame + shown.sum() * np.ones_like(frame)) / 2
        return np.asarray(frame / self._unit)

    @cached_property
    def _unit(self) -> float:
        whole = np.ones((self.n, self.n))
        frame = sum(left @ whole @ right.T for left, right in self.still)
        return float(((frame + self.n**2) / 2 if self.centre else frame).max())

    @cached_property
    def exact(self) -> tuple[np.ndarray, np.ndarray]:
        """Factors as a calibration has them, of a session without noise and fault, of unit light."""
        signs = stripe_signs(self.n).astype(float)
        one = np.ones(self.n)
        found = estimated(
            (self.light(np.outer(column, one)) for column in signs.T),
            (self.light(np.outer(one, column)) for column in signs.T),
            signs,
            self.centre,
        )
        return found.left, found.right

    @cached_property
    def peak(self) -> float:
        """Electrons of the brightest pixel at which factors have the error that is wanted."""
        uniform, count = self.light(np.ones((self.n, self.n))), stripe_signs(self.n).shape[1]
        vectors = [side.sum(axis=1) for side in self.exact]

        def error(peak: float) -> float:
            still = 2 * (self.traits["read_noise_e"] ** 2 + DARK + 1 / 12)
            light = (1 + 2 * self.traits["ambient"]) * uniform.mean() * peak
            noise = np.sqrt((light + still) / self.traits["repeats"]) / peak
            each = [
                predicted_error(side, noise, float(np.linalg.norm(vector)), count)
                for side, vector in zip(self.exact, reversed(vectors), strict=True)
            ]
            return float(np.hypot(each[0], each[1]))

        peak = 1.0
        for _ in range(60):
            peak *= (error(peak) / (self.traits["level"] * NOISE)) ** 1.5
        return peak


@dataclass
class Session:
    """A session while it is taken: what each frame shows, and what changes its light and its numbers.

    Faults change ``shows`` (the half whose light a frame has; None: black), ``lines`` (what is lit in place of a half),
    ``power`` of each frame, ``ambient`` light (rows, columns) by place in time, ``optics`` of electrons, ``numbers``
    and ``moved`` pixels; ``wrong`` are the frames that are at fault, None: all.
    """

    camera: Camera
    uniform: bool
    rng: np.random.Generator
    wrong: set[Half] | None = field(default_factory=set)
    lines: dict[Half, np.ndarray] = field(default_factory=dict)
    ambient: Callable[[float, Half], Any] = lambda time, half: 0.0
    optics: Callable[[np.ndarray, Half, float], np.ndarray] = lambda light, half, time: light
    numbers: Callable[[np.ndarray, Half, float], np.ndarray] = lambda numbers, half, time: numbers
    moved: Callable[[float], tuple[float, float]] = lambda time: (0.0, 0.0)
    bits: int = 16

    def __post_init__(self) -> None:
        self.signs = stripe_signs(self.camera.n)
        self.order = halves_in_order(self.signs.shape[1], not self.uniform)
        self.shows: dict[Half, Half | None] = {half: half for half in self.order}
        self.power = np.ones(len(self.order))
        self.lag = 0.0

    @property
    def count(self) -> int:
        return int(self.signs.shape[1])

    def pick(self, number: int = 1, least: int = 1) -> list[int]:
        """Patterns at random, the uniform one not among them."""
        return [int(one) for one in self.rng.choice(np.arange(least, self.count), number, replace=False)]

    def halves(self, side: str, *indices: int) -> list[Half]:
        return [half for half in self.order if half[0] == side and half[1] in indices and half[2] != UNIFORM]

    def frame(self) -> Half:
        """A frame at random."""
        return self.halves(SIDES[int(self.rng.integers(2))], *self.pick())[int(self.rng.integers(2 - self.uniform))]

    def show(self, changed: dict[Half, Half | None]) -> None:
        """Frames show the light of other ones."""
        self.shows |= changed
        assert self.wrong is not None
        self.wrong |= set(changed)

    def exchange(self, side: str, *indices: int) -> None:
        for side_, index, sign in self.halves(side, *indices):
            self.show({(side_, index, sign): (side_, index, -sign)})

    def light(self, half: Half, terms: list[tuple[np.ndarray, np.ndarray]] | None) -> np.ndarray:
        side, index, sign = half
        line = np.ones(self.camera.n) if sign == UNIFORM else (1 + sign * self.signs[:, index].astype(float)) / 2
        line, one = self.lines.get(half, line), np.ones(self.camera.n)
        return self.camera.light(np.outer(line, one) if side == SIDES[0] else np.outer(one, line), terms)

    def write(self, folder: Path) -> Path:
        """Take the session's frames, and write them and their list in a new ``folder``."""
        folder.mkdir()
        camera, traits = self.camera, self.camera.traits
        mean = float(camera.light(np.ones((camera.n, camera.n))).mean())
        gain = min(1.0, BRIGHTEST / (camera.peak * (1 + traits["ambient"]) + DARK)) * 2.0 ** (self.bits - 16)
        black, terms, before = BLACK if self.bits > 12 else 2.0, {}, None
        for place, half in enumerate(self.order):
            time = place / (len(self.order) - 1)
            moved = self.moved(time)
            if moved not in terms:
                terms[moved] = None if moved == (0.0, 0.0) else camera.terms(moved)
            target = self.shows[half]
            # Without pairs ambient light is in the factors, unless dark frames subtract it.
            still = traits["ambient"] * mean * (not self.uniform) + self.ambient(time, half)
            if target is None:
                light = np.zeros(traits["shape"])
            else:
                light = self.optics(self.power[place] * self.light(target, terms[moved]) + still, half, time)
            if before is not None and self.lag:
                light = (1 - self.lag) * light + self.lag * before
            before = light
            for repeat in range(traits["repeats"]):
                electrons = camera.peak * light + DARK
                electrons = electrons + np.sqrt(
                    np.maximum(electrons, 0) + traits["read_noise_e"] ** 2
                ) * self.rng.standard_normal(light.shape, dtype=np.float32)
                numbers = self.numbers(np.rint(electrons * gain + black), half, time)
                numbers = np.asarray(np.clip(numbers, 0, 2**self.bits - 1), np.uint16)
                np.save(folder / f"f_{place * traits['repeats'] + repeat:05d}.npy", numbers)
        digital = {
            "exposure_s": 1.0,
            "gain_dn_per_e": gain,
            "black_level_dn": black,
            "dark_current_e_per_s": DARK,
            "read_noise_e": traits["read_noise_e"],
            "step_dn": 1,
            "saturation_dn": 2**self.bits - 1,
        }
        listed = {
            "camera": "ideal",
            "n": camera.n,
            "signed_capture": "uniform" if self.uniform else "pair",
            "repeats": traits["repeats"],
            "digital": digital,
            "centre": camera.centre,
        }
        (folder / "session.json").write_text(json.dumps(listed))
        return folder

    def names(self) -> set[str]:
        """Files of the patterns that are at fault, both frames of pairs."""
        assert self.wrong is not None
        patterns, repeats = {half[:2] for half in self.wrong}, self.camera.traits["repeats"]
        return {
            f"f_{place * repeats + repeat:05d}.npy"
            for place, half in enumerate(self.order)
            for repeat in range(repeats)
            if half[:2] in patterns
        }


# ---- Kinds of faults -------------------------------------------------------------------------------------------------


def _exchanged(number: int) -> Callable[[Session], None]:
    def plant(session: Session) -> None:
        for index in session.pick(number):
            session.exchange(SIDES[int(session.rng.integers(2))], index)

    return plant


def _sides_exchanged(session: Session, *sides: str) -> None:
    for side in sides:
        session.exchange(side, *range(session.count))
    session.wrong = None


def _uniforms_exchanged(session: Session) -> None:
    for side in SIDES:
        session.exchange(side, 0)


def _swapped(next_one: bool) -> Callable[[Session], None]:
    def plant(session: Session) -> None:
        side, (one, other) = SIDES[int(session.rng.integers(2))], session.pick(2)
        other = one % (session.count - 1) + 1 if next_one else other
        for first, second in ((one, other), (other, one)):
            session.show({half: (side, second, half[2]) for half in session.halves(side, first)})

    return plant


def _lines(change: Callable[[Session, np.ndarray], np.ndarray]) -> Callable[[Session], None]:
    """One pattern shows other lines, both frames alike."""

    def plant(session: Session) -> None:
        side, (index,) = SIDES[int(session.rng.integers(2))], session.pick()
        line = change(session, session.signs[:, index].astype(float))
        for half in session.halves(side, index):
            session.lines[half] = (1 + half[2] * line) / 2
            session.show({half: half})

    return plant


def _other_side(session: Session) -> None:
    side, (index,) = int(session.rng.integers(2)), session.pick()
    for half in session.halves(SIDES[side], index):
        session.show({half: (SIDES[1 - side], *half[1:])})


def _stuck_line(lit: float, start: float) -> Callable[[Session], None]:
    """A projector line is stuck from a time on, in both kinds of stripes."""

    def plant(session: Session) -> None:
        row = int(session.rng.integers(session.camera.n))
        for place, half in enumerate(session.order):
            if place >= start * len(session.order) and half[0] == SIDES[0]:
                line = (1 + half[2] * session.signs[:, half[1]].astype(float)) / 2
                session.lines[half] = np.where(np.arange(len(line)) == row, lit, line if half[2] else 1.0)
        session.wrong = None

    return plant


def _frames(
    change: Callable[[Session, np.ndarray], np.ndarray], number: int = 1, half: tuple[int, int] | None = None
) -> Callable[[Session], None]:
    """Single frames whose light is changed; ``half`` is index and sign of a certain one."""

    def plant(session: Session) -> None:
        side = SIDES[int(session.rng.integers(2))]
        wrong = {(side, *half)} if half is not None else {session.frame() for _ in range(number)}
        session.wrong = wrong
        session.optics = lambda light, which, time: change(session, light) if which in wrong else light

    return plant


def _half_lost(session: Session, light: np.ndarray) -> np.ndarray:
    axis, cut = int(session.rng.integers(2)), session.rng.uniform(0.3, 0.7)
    keep = np.arange(light.shape[axis]) < cut * light.shape[axis]
    return np.asarray(light * (keep[:, None] if axis == 0 else keep))


def _rolled(session: Session, light: np.ndarray) -> np.ndarray:
    return np.roll(light, int(session.rng.choice([-3, -2, -1, 1, 2, 3])), int(session.rng.integers(2)))


def _repeated(number: int) -> Callable[[Session], None]:
    def plant(session: Session) -> None:
        for place in session.rng.choice(np.arange(4, len(session.order)), number, replace=False):
            half, before = session.order[place], session.order[place - 1]
            session.show({half: before})

    return plant


def _late(session: Session) -> None:
    start = int(session.rng.integers(len(session.order) // 2))
    for half, other in zip(session.order[start + 1 :], session.order[start:], strict=False):
        session.shows[half] = other
    session.wrong = None


def _ambient(make: Callable[[Session], Callable[[float, Half], Any]]) -> Callable[[Session], None]:
    def plant(session: Session) -> None:
        session.wrong, session.ambient = None, make(session)

    return plant


def _fast(part: float) -> Callable[[Session], Callable[[float, Half], Any]]:
    def make(session: Session) -> Callable[[float, Half], Any]:
        levels = dict(zip(session.order, part * session.rng.random(len(session.order)), strict=True))
        return lambda time, half: levels[half]

    return make


def _cloud(part: float) -> Callable[[Session], Callable[[float, Half], Any]]:
    def make(session: Session) -> Callable[[float, Half], Any]:
        rng, (rows, columns) = session.rng, session.camera.traits["shape"]
        y, x = np.mgrid[:rows, :columns] / max(rows, columns)
        at, wide, speed = rng.random(2), rng.uniform(0.2, 0.5), rng.uniform(0.5, 3)
        shape = np.exp(-(np.square(y - at[0]) + np.square(x - at[1])) / (2 * wide**2))
        return lambda time, half: part * shape * (1 + np.sin(2 * np.pi * speed * time)) / 2

    return make


def _tilted(session: Session) -> Callable[[float, Half], Any]:
    rows, columns = session.camera.traits["shape"]
    plane = np.linspace(0, 1, rows)[:, None] * session.rng.random() + np.linspace(0, 1, columns) * session.rng.random()
    return lambda time, half: 0.2 * time * plane


def _lamp(
    drift: float = 0.0, flicker: float = 0.0, step: float = 0.0, ambient: float = 0.0
) -> Callable[[Session], None]:
    def plant(session: Session) -> None:
        count = len(session.order)
        time = np.linspace(0, 1, count)
        session.power = 1 + drift * (time - 0.5) + flicker * session.rng.standard_normal(count)
        session.power *= 1 + step * (time > session.rng.uniform(0.2, 0.8))
        session.power /= session.power.mean()
        session.ambient = lambda time, half: ambient * time
        session.wrong = None

    return plant


def _every(make: Callable[[Session], Callable[[np.ndarray, float], np.ndarray]]) -> Callable[[Session], None]:
    """The light of all frames is changed, by place in time."""

    def plant(session: Session) -> None:
        change = make(session)
        session.optics, session.wrong = lambda light, half, time: change(light, time), None

    return plant


def _hot(session: Session) -> Callable[[np.ndarray, float], np.ndarray]:
    columns = session.rng.choice(session.camera.traits["shape"][1], 3, replace=False)
    height, start = session.rng.uniform(0.05, 0.3), session.rng.uniform(0.3, 0.7)

    def change(light: np.ndarray, time: float) -> np.ndarray:
        found = light.copy()
        found[:, columns] += height * (time > start)
        return found

    return change


def _clipping(session: Session) -> Callable[[np.ndarray, float], np.ndarray]:
    most = session.rng.uniform(0.5, 0.9)
    return lambda light, time: np.minimum(light, most)


def _gamma(session: Session) -> Callable[[np.ndarray, float], np.ndarray]:
    power = float(session.rng.choice([0.8, 0.9, 0.95, 1.05, 1.1, 1.2]))
    return lambda light, time: np.power(np.maximum(light, 0), power)


def _banding(session: Session) -> Callable[[np.ndarray, float], np.ndarray]:
    size, period, rng = session.rng.uniform(0.01, 0.05), session.rng.uniform(10, 60), session.rng

    def change(light: np.ndarray, time: float) -> np.ndarray:
        bands = 1 + size * np.sin(2 * np.pi * (np.arange(len(light)) / period + rng.random()))
        return light * bands[:, None]

    return change


def _lag(session: Session) -> None:
    session.lag, session.wrong = float(session.rng.uniform(0.01, 0.08)), None


def _motion(pixels: float, slow: bool = False) -> Callable[[Session], None]:
    def plant(session: Session) -> None:
        angle, start = session.rng.uniform(0, 2 * np.pi), session.rng.uniform(0.3, 0.7)
        way = pixels * np.array([np.cos(angle), np.sin(angle)])

        def moved(time: float) -> tuple[float, float]:
            part = round(time * 20) / 20 if slow else float(time > start)
            return float(part * way[0]), float(part * way[1])

        session.moved, session.wrong = moved, None

    return plant


def _six_bits(session: Session) -> None:
    session.bits, session.wrong = 6, None


def _sensor_row(start: float) -> Callable[[Session], None]:
    def plant(session: Session) -> None:
        row = int(session.rng.integers(session.camera.traits["shape"][0]))
        level = float(session.rng.choice([0.0, BLACK, 2.0**15]))

        def numbers(read: np.ndarray, half: Half, time: float) -> np.ndarray:
            if time >= start:
                read[row] = level
            return read

        session.numbers, session.wrong = numbers, None

    return plant


def _black_level(session: Session) -> None:
    by = float(session.rng.uniform(-100, 300))
    session.numbers, session.wrong = lambda read, half, time: read + by * time, None


def _dust(session: Session) -> Callable[[np.ndarray, float], np.ndarray]:
    rows, columns = session.camera.traits["shape"]
    y, x = np.mgrid[:rows, :columns]
    at, size = session.rng.random(2) * (rows, columns), session.rng.uniform(5, 30)
    shade = 1 - 0.3 * np.exp(-(np.square(y - at[0]) + np.square(x - at[1])) / (2 * size**2))
    return lambda light, time: light * shade if time > 0.5 else light


KINDS: dict[str, Callable[[Session], None]] = {
    "one pair exchanged": _exchanged(1),
    "three pairs exchanged": _exchanged(3),
    "all pairs of a side exchanged": lambda session: _sides_exchanged(session, SIDES[int(session.rng.integers(2))]),
    "all pairs exchanged": lambda session: _sides_exchanged(session, *SIDES),
    "pattern 0 exchanged": lambda session: session.exchange(SIDES[int(session.rng.integers(2))], 0),
    "both patterns 0 exchanged": _uniforms_exchanged,
    "patterns swapped": _swapped(False),
    "neighbours swapped": _swapped(True),
    "pattern rolled": _lines(lambda session, line: np.roll(line, int(session.rng.integers(2, len(line) - 1)))),
    "pattern rolled by one": _lines(lambda session, line: np.roll(line, int(session.rng.choice([-1, 1])))),
    "random pattern": _lines(lambda session, line: session.rng.choice([-1.0, 1.0], len(line))),
    "stripes of the other side": _other_side,
    "projector line stuck on": _stuck_line(1.0, 0.0),
    "projector line goes dark": _stuck_line(0.0, 0.25),
    "sensor row stuck": _sensor_row(0.0),
    "sensor row sticks midway": _sensor_row(0.5),
    "black frame": _frames(lambda session, light: 0 * light),
    "three black frames": _frames(lambda session, light: 0 * light, 3),
    "repeated frame": _repeated(1),
    "three repeated frames": _repeated(3),
    "half lost": _frames(_half_lost),
    "frame of half exposure": _frames(lambda session, light: light / 2),
    "frame of 0.95": _frames(lambda session, light: 0.95 * light),
    "bright frame": _frames(lambda session, light: 1.3 * light),
    "frame moved by pixels": _frames(_rolled),
    "clipped frame": _frames(lambda session, light: np.minimum(light, np.quantile(light, 0.8))),
    "uniform frame dim": _frames(lambda session, light: 0.7 * light, half=(0, 1)),
    "uniform frame half lost": _frames(_half_lost, half=(0, 1)),
    "one step out of order": _late,
    "even ambient ramp 3 %": _ambient(lambda session: lambda time, half: 0.03 * time),
    "even ambient ramp 30 %": _ambient(lambda session: lambda time, half: 0.3 * time),
    "tilted ambient ramp": _ambient(_tilted),
    "fast ambient 3 %": _ambient(_fast(0.03)),
    "fast ambient 30 %": _ambient(_fast(0.3)),
    "ambient switched on": _ambient(lambda session: lambda time, half: 0.2 * (time > 0.55)),
    "cloud 3 %": _ambient(_cloud(0.03)),
    "cloud 30 %": _ambient(_cloud(0.3)),
    "drift": _lamp(drift=0.05),
    "drift with ambient": _lamp(drift=-0.1, ambient=0.2),
    "flicker 0.5 %": _lamp(flicker=0.005),
    "flicker 3 %": _lamp(flicker=0.03),
    "power steps by 5 %": _lamp(step=0.05),
    "hot columns midway": _every(_hot),
    "gamma": _every(_gamma),
    "clipping": _every(_clipping),
    "banding": _every(_banding),
    "lag": _lag,
    "6 bits": _six_bits,
    "motion 0.02": _motion(0.02),
    "motion 0.1": _motion(0.1),
    "motion 0.5": _motion(0.5),
    "slow motion 0.3": _motion(0.3, slow=True),
    "black level drifts": _black_level,
    "dust midway": _every(_dust),
}
PAIRED = ("all pairs of a side exchanged", "all pairs exchanged", "pattern 0 exchanged", "both patterns 0 exchanged")
"""Kinds that sessions against a uniform frame do not have."""


# ---- Outcomes --------------------------------------------------------------------------------------------------------


def error(camera: Camera, factors: Factors) -> float:
    """Relative error of both factors, in quadrature; the sign that both share is free."""
    scale, pairs = np.sqrt(camera.peak), list(zip((factors.left, factors.right), camera.exact, strict=True))
    sign = -1.0 if all(np.vdot(found, exact) < 0 for found, exact in pairs) else 1.0
    each = [np.linalg.norm(sign * found - exact * scale) / np.linalg.norm(exact * scale) for found, exact in pairs]
    return float(np.hypot(each[0], each[1]))


@single_threaded_blas()
def outcome(seed: int, n: int, kind: str | None, uniform: bool) -> dict[str, Any]:
    """Simulate and calibrate one session."""
    camera = Camera(seed, n)
    session = Session(camera, uniform, np.random.default_rng([seed, n, 7]))
    if kind is not None:
        KINDS[kind](session)
    row: dict[str, Any] = {"seed": seed, "n": n, **camera.traits}
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        try:
            factors = calibrate_frames(session.write(Path(folder) / "frames"))
        except MitsimError as refusal:
            row["message"] = str(refusal)
            named = set(re.findall(r"f_\d+\.npy", row["message"]))
            true = session.wrong is None or (bool(named) and named <= session.names())
            return {**row, "outcome": "refused" if "all frames" in row["message"] or true else "misnamed"}
    stated = float(np.hypot(*factors.estimate.predicted_error)) if factors.estimate else 0.0
    actual = error(camera, factors)
    row |= {"warnings": list(factors.warnings), "stated": stated, "error": actual}
    return {**row, "outcome": "right" if actual <= LIMIT * stated else "wrong"}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts of outcomes of one kind, of sessions with warnings, and quantiles of error over stated error."""
    over = [row["error"] / row["stated"] for row in rows if "error" in row]
    return {
        **Counter(row["outcome"] for row in rows),
        "flagged": sum(bool(row.get("warnings")) for row in rows),
        "silent": sum(row["outcome"] == "wrong" and not row["warnings"] for row in rows),
        **(ratios(over) if over else {}),
        "stated": float(np.median([row["stated"] for row in rows if "stated" in row])) if over else None,
    }


def main() -> None:
    parser = arguments(__doc__, seed=True, required=True)
    parser.add_argument("--sessions", type=int, default=9, help="sessions of each kind of fault")
    parser.add_argument("--clean", type=int, default=200, help="sessions without a fault")
    parser.add_argument("--kinds", nargs="*", default=[*KINDS])
    parser.add_argument("--n", nargs="+", type=int, default=(32, 64, 128))
    parser.add_argument("--uniform", action="store_true", help="patterns against one uniform frame, no pairs")
    options = parser.parse_args()
    found: dict[str, list[dict[str, Any]]] = {}
    for kind in ("clean", *options.kinds):
        rows = found.setdefault(kind, [])
        if options.uniform and kind in PAIRED:
            continue
        for number in range(options.clean if kind == "clean" else options.sessions):
            n = options.n[number % len(options.n)]
            rows.append(outcome(options.seed + number, n, None if kind == "clean" else kind, options.uniform))
        if rows:
            show(kind, summary(rows))
        total = Counter(row["outcome"] for name, each in found.items() if name != "clean" for row in each)
        facts = {"noise": NOISE, "seed": options.seed, "uniform": options.uniform, "versions": versions()}
        counts = {name: summary(each) for name, each in found.items() if each}
        write(options.json, {**facts, "faulty": total, "summary": counts, "sessions": found})
    show("faulty sessions", total)


if __name__ == "__main__":
    main()

"""Data of changed frames, and draws of noise, against the solver itself: every frame formed, every number disturbed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mitsim.core.arrays import FloatArray
from mitsim.devices.patterns import PatternFamily, parse_patterns
from mitsim.devices.session import Drift
from mitsim.reconstruct.solver import Prepared, prepare
from mitsim.sensor.chain import ripple_level, ripple_response
from mitsim.studies.calibration_study import draw
from mitsim.studies.drift_study import DriftStand
from tests.unit.calibrate.test_responses import CLIPPED

N, PIXELS, LAM, BLACK, SECONDS = 4, 5, 0.3, 1 / 11, 0.01
RNG = np.random.default_rng(4)
LEFT, RIGHT, OTHER, FURTHER = (RNG.standard_normal((PIXELS, N)) + 1 for _ in range(4))
SCENE, LAMPS = RNG.random((N, N)), RNG.random((PIXELS, PIXELS))
SENSOR = CLIPPED.sensor.model_copy(update={"shutter": "rolling", "line_time_us": 700.0})
FAMILIES = ("dots:2", "dots:1x2", "uniform", "random:2", "hadamard:2")


@dataclass(frozen=True, eq=False)
class Toy(DriftStand):
    """A stand without a bench, before a lamp or without one; the drift of a mask adds one term to the shadow."""

    lamps: FloatArray | None = None

    @property
    def _lamps(self) -> FloatArray | None:
        return self.lamps

    def _terms(self, drift: Drift) -> Any:
        return [(OTHER, FURTHER)] if drift.mask_rows_um else []


def stand(name: str, lamps: FloatArray | None = None, centre: bool = False) -> Toy:
    physics = SimpleNamespace(black_level=BLACK)
    bench = SimpleNamespace(sensor=SENSOR, geometry=SimpleNamespace(frame_shape=(PIXELS, PIXELS)))
    lit: Any = SimpleNamespace(
        truth=SCENE, light=SimpleNamespace(simulation=SimpleNamespace(physics=physics)), bench=bench
    )
    factors: Any = SimpleNamespace(left=LEFT, right=RIGHT)
    found = Toy(lit, factors, None, parse_patterns(name, N, seed=3), 7, lamps)  # type: ignore[arg-type]
    found.__dict__.update(before=SimpleNamespace(lam=LAM), exposure_s=SECONDS, model=model_of(name, centre))
    return found


@cache
def model_of(name: str, centre: bool) -> Prepared:
    family = parse_patterns(name, N, seed=3)
    return prepare(LEFT, RIGHT, family.left, family.right, centre=centre)


def shadows(family: PatternFamily, mask: bool = False) -> list[FloatArray]:
    """Frames (m, m') of all shots, with the light of black pixels, a tenth of all."""
    terms = [(LEFT, RIGHT), *([(OTHER, FURTHER)] if mask else [])]
    pictures = [(family.light(shot) + 0.1) * SCENE for shot in family.shots]
    return [np.sum([a @ each @ b.T for a, b in terms], axis=0) for each in pictures]


def solved(own: Toy, rates: Iterable[FloatArray]) -> FloatArray:
    return own.model.solve(own.model.accumulator(own.family.measurements(rates)), LAM).image


@pytest.mark.parametrize("centre", [False, True])
@pytest.mark.parametrize("name", FAMILIES)
def test_data_are_those_of_the_frames_that_a_drift_makes(name: str, centre: bool) -> None:
    """To rounding, with another camera, gains that change from shot to shot, the leak of black pixels and a lamp that
    is not as in its frame. (Planted: shots in another order, signs alike, gains of the lamp, leak once in pairs.)"""
    own = stand(name, LAMPS, centre)
    drift = Drift(mask_rows_um=1.0, power=0.2, exposure=-0.1, power_ramp=0.3, lamp=0.5)
    data, varying = own.data(own.model, drift)
    count = len(own.family.shots)
    levels = 1.2 * 0.9 * (1 + 0.3 * (np.arange(count) + 0.5) / count)
    frames = [level * each + 0.5 * LAMPS for level, each in zip(levels, shadows(own.family, mask=True), strict=True)]
    found = own.model.image(own.model.gain(LAM) * data)
    np.testing.assert_allclose(found, solved(own, frames), rtol=1e-9, atol=1e-9)
    assert varying == 0


def test_without_a_lamp_readings_shift_by_dark_current_and_black_level() -> None:
    """Of frames alone, without an ambient frame that has both. (Planted: black level of one pixel.)"""
    own, drift = stand("dots:2"), Drift(black_level_dn=3.0, exposure=0.1)
    sensor = SENSOR.model_copy(update={"binning": 2})
    own.lit.bench.sensor = sensor  # type: ignore[misc]
    shift = 3.0 * sensor.codes / sensor.gain_dn_per_e / SECONDS + 0.1 * sensor.superpixel_dark_current_e_per_s
    found = own.model.image(own.model.gain(LAM) * own.data(own.model, drift)[0])
    np.testing.assert_allclose(found, solved(own, [1.1 * each + shift for each in shadows(own.family)]), rtol=1e-9)
    same = stand("dots:2", LAMPS)
    assert np.array_equal(same.data(same.model, Drift(black_level_dn=3.0))[0], same.data(same.model, Drift())[0])


@pytest.mark.parametrize("kind", ["power_flicker", "power_ripple", "lamp_flicker", "lamp_ripple"])
@pytest.mark.parametrize("name", FAMILIES)
def test_random_gains_add_the_energy_of_each_frame(name: str, kind: str) -> None:
    """The solver is linear in frames: the squares of the images that each shot's own deviation makes alone, the mean
    over four phases of a ripple; and of the ambient frame, whose mean over its shots all frames lose, unless pairs are
    subtracted. (Planted: the filter once; the ambient frame's shots left out; its part in pairs; one phase alone; rows
    for columns.)"""
    own = stand(name, LAMPS if "lamp" in kind else None)
    drift = Drift.model_validate({kind: 0.3, "power_ripple_hz": 60.0, "lamp_ripple_hz": 60.0})
    shots, energy = own.family.shots, 0.0
    response = ripple_response(SENSOR, SECONDS, 60.0, PIXELS)
    rms: list[Any] = [ripple_level(response, 0.3, phase) - 1 for phase in np.arange(4) * np.pi / 2]
    for gain in rms if "ripple" in kind else [0.3]:
        alone = [gain * (LAMPS if "lamp" in kind else each) for each in shadows(own.family)]
        for number in range(len(shots)):
            energy += np.square(solved(own, [each * (i == number) for i, each in enumerate(alone)])).sum()
        if "lamp" in kind and not own.family.signed:
            sides = (np.float64(own.family.left), np.float64(own.family.right))
            alike = [np.square(side.sum(axis=1)).sum() / np.square(side).sum() for side in sides]
            ambient = int(np.ceil(16 * alike[0] * alike[1]))
            energy += np.square(solved(own, [gain * LAMPS for _ in shots])).sum() / ambient
    found = own.data(own.model, drift)[1]
    assert found == pytest.approx(energy / (4 if "ripple" in kind else 1), rel=1e-9) and found > 0


def units(*shape: int) -> Iterable[FloatArray]:
    return np.eye(int(np.prod(shape))).reshape(-1, *shape)


@pytest.mark.parametrize("name", ["dots:2", "uniform", "hadamard:2"])
@pytest.mark.parametrize("kind", ["datum", "ambient", "left", "right", "light"])
def test_draws_have_the_variance_of_all_disturbances(kind: str, name: str) -> None:
    """The squares of the data that each datum, each number of a factor and each pixel's light makes alone, added up:
    6000 draws, whose variance is known to 2 %. (Planted: factors of the other side, the scene not transposed, the
    deviation for the variance, light through one side.)"""
    family, model = parse_patterns(name, N, seed=3), model_of(name, False)
    patterns, measured = (
        (family.left.astype(float), family.right.astype(float)),
        family.left.shape[1] * family.right.shape[1],
    )

    def frames(left: FloatArray, right: FloatArray, scene: FloatArray) -> list[FloatArray]:
        shown = [(p, q) for p in patterns[0].T for q in patterns[1].T]
        return [left @ (np.outer(p, q) * scene) @ right.T for p, q in shown]

    disturbed: dict[str, Any] = {
        "datum": lambda: units(measured, PIXELS, PIXELS),
        "ambient": lambda: ([one] * measured for one in units(PIXELS, PIXELS)),
        "left": lambda: (frames(one, RIGHT, SCENE) for one in units(PIXELS, N)),
        "right": lambda: (frames(LEFT, one, SCENE) for one in units(PIXELS, N)),
        "light": lambda: (frames(LEFT, RIGHT, one) for one in units(N, N)),
    }
    places = list(np.ndindex(family.left.shape[1], family.right.shape[1]))
    expected = np.zeros_like(model.sigma)
    for own in disturbed[kind]():
        shots = ((frame, *place) for frame, place in zip(own, places, strict=True))
        expected += 0.25 * np.square(model.accumulator(shots).sum)
    rng, found = np.random.default_rng(1), np.zeros_like(expected)
    for _ in range(6000):
        found += np.square(draw({kind: 0.25}, model, patterns, SCENE, rng)) / 6000
    np.testing.assert_allclose(found, expected, rtol=0.1, atol=1e-12 * expected.max())


def test_kinds_of_noise_are_independent() -> None:
    """(Planted: one kind alone; kinds that share their numbers.)"""
    model, patterns = model_of("uniform", False), (np.ones((N, 1)), np.ones((N, 1)))
    rng = np.random.default_rng(1)
    draws = [draw({"datum": 1.0, "light": 2.0}, model, patterns, SCENE, rng) for _ in range(6000)]
    np.testing.assert_allclose(np.square(draws).mean(axis=0), 1 + 2 * np.square(model.sigma), rtol=0.1)
    assert not draw({"datum": 0.0}, model, patterns, SCENE, rng).any()

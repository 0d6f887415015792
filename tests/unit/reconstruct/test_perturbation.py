"""What an image is expected to be, against the solver itself: every frame formed, every datum disturbed on its own."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.reconstruct.perturbation import Changed, LinearImage, Noise
from mitsim.reconstruct.solver import Prepared, prepare
from mitsim.rig.patterns import PatternFamily, parse_patterns

N, PIXELS, LAM = 4, 5, 0.3
RNG = np.random.default_rng(4)
LEFT, RIGHT, OTHER, FURTHER = (RNG.standard_normal((PIXELS, N)) + 1 for _ in range(4))
SCENE, FRAME = RNG.random((N, N)), RNG.random((PIXELS, PIXELS))
GAIN = 1 + 0.1 * RNG.random((2, 2))
FAMILIES = ("dots:2", "uniform", "random:2")


def family(name: str) -> PatternFamily:
    return parse_patterns(name, N, seed=3)


def shadow(left: np.ndarray, right: np.ndarray, shown: PatternFamily) -> np.ndarray:
    """(K, K, m, m) frames."""
    return np.einsum("mn,ni,nN,Nj,MN->ijmM", left, shown.left, SCENE, shown.right, right)


@cache
def prepared(name: str, centre: bool) -> Prepared:
    return prepare(LEFT, RIGHT, family(name).left, family(name).right, centre=centre)


def solved(frames: np.ndarray, shown: PatternFamily, centre: bool = False) -> np.ndarray:
    model = prepared(shown.name, centre)
    sums = model.accumulator()
    for row, column in np.ndindex(frames.shape[:2]):
        sums.add(frames[row, column], row, column)
    return model.solve(sums, LAM).image


def image(shown: PatternFamily, centre: bool = False) -> LinearImage:
    return LinearImage(LEFT, RIGHT, shown, LAM, centre)


CASES: dict[str, tuple[Changed, Callable[[PatternFamily], np.ndarray]]] = {
    "nothing": (Changed(), lambda shown: shadow(LEFT, RIGHT, shown)),
    "another camera": (
        Changed([(OTHER, FURTHER)]), lambda shown: shadow(LEFT, RIGHT, shown) + shadow(OTHER, FURTHER, shown)
    ),
    "gains": (
        Changed(gain=GAIN), lambda shown: gains(shown)[..., None, None] * shadow(LEFT, RIGHT, shown)
    ),
    "a frame in all": (
        Changed(added=FRAME, added_gain=0.5), lambda shown: shadow(LEFT, RIGHT, shown) + 0.5 * FRAME
    ),
    "a leak": (
        Changed(leak=0.1), lambda shown: shadow(LEFT, RIGHT, shown) + 0.1 * leaking(shown)
    ),
}  # fmt: skip


def gains(shown: PatternFamily) -> np.ndarray:
    return GAIN[: shown.left.shape[1], : shown.right.shape[1]]


def leaking(shown: PatternFamily) -> np.ndarray:
    return LEFT @ SCENE @ RIGHT.T


@pytest.mark.parametrize("centre", [False, True])
@pytest.mark.parametrize("name", FAMILIES)
@pytest.mark.parametrize("case", CASES)
def test_the_mean_is_the_solvers_image(case: str, name: str, centre: bool) -> None:
    """To rounding. (Planted: the slabs of the other side; a change added twice; factors not centred.)"""
    shown, (changed, frames) = family(name), CASES[case]
    if case == "gains":
        changed = Changed(gain=gains(shown))
    found = image(shown, centre).expected(SCENE, changed)
    assert np.allclose(found.image, solved(frames(shown), shown, centre), rtol=1e-9, atol=1e-9)
    assert found.variance == 0


@pytest.mark.parametrize("name", FAMILIES)
def test_variances_are_sums_over_all_that_varies(name: str) -> None:
    """The solver is linear in frames: the squares of what each datum, each frame's gain and each number of a factor
    does to the image alone, added up. (Planted: the filter once; the right factor's scene not transposed; the ambient
    frame's noise as that of data.)"""
    shown = family(name)
    seen, dark = shadow(LEFT, RIGHT, shown), np.zeros_like(shadow(LEFT, RIGHT, shown))
    count = seen.shape[:2]

    def energy(disturbances: list[np.ndarray]) -> float:
        return float(sum(np.square(solved(each, shown)).sum() for each in disturbances))

    def single(place: tuple[int, ...]) -> np.ndarray:
        one = dark.copy()
        one[place] = 1
        return one

    def unit(place: tuple[int, int]) -> np.ndarray:
        one = np.zeros((PIXELS, N))
        one[place] = 1
        return one

    rows = RNG.standard_normal(PIXELS)
    pixels = np.eye(N * N).reshape(-1, N, N)
    data = [single(place) for place in np.ndindex(dark.shape)]
    common = [single((slice(None), slice(None), *place)) for place in np.ndindex(PIXELS, PIXELS)]
    alone = [single((row, column)) for row, column in np.ndindex(count)]
    of_frames, of_added = ([frames * one for one in alone] for frames in (seen, FRAME))
    left = [shadow(unit(place), RIGHT, shown) for place in np.ndindex(PIXELS, N)]
    right = [shadow(LEFT, unit(place), shown) for place in np.ndindex(PIXELS, N)]
    light = [np.einsum("mn,ni,nN,Nj,MN->ijmM", LEFT, shown.left, one, shown.right, RIGHT) for one in pixels]
    by_row = [0.5 * rows, np.full(PIXELS, 0.2)]
    rippled = [gain[:, None] * one for gain in by_row for one in of_frames]
    added = [gain[:, None] * one for gain in by_row for one in of_added]
    common_rows = [dark + gain[:, None] * FRAME for gain in by_row]
    cases = [
        (None, Noise(datum=0.7), 0.7, data),
        (None, Noise(ambient=0.7), 0.7, common),
        (None, Noise(left=0.7), 0.7, left),
        (None, Noise(right=0.7), 0.7, right),
        (None, Noise(light=0.7), 0.7, light),
        (None, Noise(datum=0.2, light=0.1) + Noise(datum=0.5, light=0.6), 0.7, data + light),
        (Changed(flicker=(0.3,)), None, 0.09, of_frames),
        (Changed(added=FRAME, added_gain=0.0, added_flicker=(0.3,)), None, 0.09, of_added),
        (Changed(added=FRAME, added_gain=0.0, added_common=(0.3,)), None, 0.09, [dark + FRAME]),
        (Changed(flicker=(0.5 * rows, 0.2)), None, 1.0, rippled),
        (Changed(added=FRAME, added_gain=0.0, added_flicker=(0.5 * rows, 0.2)), None, 1.0, added),
        (Changed(added=FRAME, added_gain=0.0, added_common=(0.5 * rows, 0.2)), None, 1.0, common_rows),
    ]
    for changed, noise, variance, disturbances in cases:
        found = image(shown).expected(SCENE, changed, noise).variance
        assert found == pytest.approx(variance * energy(disturbances), rel=1e-9), (changed, noise)


def test_decibels_of_a_gain_are_known_exactly() -> None:
    """Without noise and with next to no lambda, power 1 + e makes the image (1 + e) X: its error is e X. (Planted: the
    gain squared.)"""
    shown = family("dots:2")
    exact = LinearImage(LEFT, RIGHT, shown, 1e-12)
    found = exact.expected(SCENE, Changed(gain=1.02)).psnr_db(SCENE)
    assert found == pytest.approx(-20 * np.log10(0.02 * np.sqrt(np.square(SCENE).mean())), abs=1e-6)


def test_signed_patterns_are_refused() -> None:
    with pytest.raises(MitsimError, match=r"^patterns 'hadamard:2'[^\n]*uniform, dots or random$"):
        image(family("hadamard:2"))

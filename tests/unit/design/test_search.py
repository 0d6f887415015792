"""Factors and gradients of a mask code, and the search for the code with the least expected error."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.design.objective import CodedSide, Light, Objective, Prior
from mitsim.design.search import Search, cyclic_codes, pinholes
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask import Plate
from mitsim.devices.projector import Spectrum
from mitsim.optics.shadow import Directions
from mitsim.optics.terms import ModelledCamera

N, PIXELS = 16, 24
WINDOW = (-0.15, 0.15)
CAMERA = CameraGeometry(pixels=PIXELS, pixel_pitch=0.05, mask_feature=0.06, mask_distance=2.0, scene_distance=400.0)
LINES = Spectrum(np.array([640.0, 520.0]), np.array([0.6, 0.4]))
DOTS = (np.arange(N)[:, None] % 5 == np.arange(5)).astype(np.float64)
LIGHT = Light(gain=3e4, frame_s=0.5, session_e=1e5, read_noise_e=13.0, dark_e_per_s=6.0)
FEATURES = 39
SCENES = Prior().draw((N, N), 0)
CODE = (np.random.default_rng(3).random(FEATURES) < 0.4).astype(np.float64)


LAMPS = [(Directions.cells(np.linspace(-0.2, 0.1, 7)), np.array([0.1, 0.3, 0.6, 0.9, 0.5, 0.2]))]


def side(spectrum: Spectrum | None = None, patterns: FloatArray = DOTS, lit: bool = False) -> CodedSide:
    directions = Directions.cells(np.linspace(*WINDOW, N + 1))
    return CodedSide(CAMERA, 0, directions, FEATURES, patterns, spectrum, LAMPS if lit else ())


@pytest.fixture(scope="module")
def objective() -> Objective:
    one = side(LINES)
    return Objective((one, one), LIGHT, Prior(), SCENES)


@pytest.mark.parametrize(("spectrum", "error"), [(None, 1e-12), (LINES, 5e-3)])
def test_a_factor_is_that_of_the_modelled_camera(spectrum: Spectrum | None, error: float) -> None:
    """The grid for waves has 16 cells in sqrt(lambda D) where the model has 130; lines are averaged, not fitted."""
    plate = Plate(0.06, np.outer(CODE, CODE), "code")
    worn = CAMERA.model_copy(update={"mask": "plate", "mask_plate": plate})
    modelled = ModelledCamera(worn, (WINDOW, WINDOW), N, spectrum)
    left, _ = modelled.factors(modelled.built)
    found = side(spectrum)(CODE).values.T
    scale = float(np.vdot(found, left) / np.vdot(found, found))
    assert np.linalg.norm(scale * found - left) < error * np.linalg.norm(left)


@pytest.mark.parametrize(
    ("spectrum", "exposure"), [(None, {}), (LINES, {}), (None, {"signal_e": 2e3}), (LINES, {"most_e": 2e4})]
)
def test_the_gradient_of_a_code_agrees_with_differences(spectrum: Spectrum | None, exposure: dict[str, float]) -> None:
    """Two codes and sides of other patterns, grey codes, exposures by time, light and full well: 1e-8 is usual.

    Dots have groups of 4 and of 3 pixels. All but the first have light of lamps.
    """
    random, small, lit = np.random.default_rng(4), 1e-5, spectrum is not None or bool(exposure)
    exposure = exposure | {"ambient_shots": 2 * lit}
    sides = side(spectrum, lit=lit), side(spectrum, 1 - DOTS, lit)
    objective = Objective(sides, replace(LIGHT, **exposure), Prior(), SCENES)
    codes = random.random((2, FEATURES))
    found = objective(codes, slopes=True)
    assert (objective.frame_s(codes) == LIGHT.frame_s) != (len(exposure) > 1)
    for which in (0, 1):
        step = np.zeros((2, FEATURES))
        step[which] = random.standard_normal(FEATURES)
        ahead, behind = (objective(codes + sign * small * step, found.lam).total for sign in (1, -1))
        slope = (ahead - behind) / (2 * small)
        assert slope == pytest.approx(float(found.slopes[which] @ step[which]), rel=1e-6), which


def test_a_search_beats_simple_masks_and_repeats_bit_by_bit(objective: Objective) -> None:
    """Found codes are better than the best of as many random codes; resumed starts are the same as first ones."""
    search = Search([objective], seed=1)
    starts = list(islice(search.starts(), 2))
    found = [search.improve(*start, evaluations=120) for start in starts]
    spent = sum(each.evaluations for each in found)
    best = min(found, key=lambda each: each.score)
    assert best.score < search.best_random(spent).score
    pinholes_ = search.best_pinholes()
    assert pinholes_ is not None and best.score <= pinholes_.score
    done = search.improve("here", CODE, evaluations=3000)
    assert done.evaluations < 150  # 97; flips in the wrong order take 193
    for place in search.used:
        other = done.code.copy()
        other[place] = 1 - other[place]
        assert search.score(other).score > done.score * (1 - 1e-4)
    again = Search([objective], seed=1)
    second = again.improve(*list(islice(again.starts(), 2))[1], evaluations=120)
    assert second.score == found[1].score and np.array_equal(second.code, found[1].code)


def test_bounds_hold_and_are_reported(objective: Objective) -> None:
    search = Search([objective], open_part=(0.1, 0.2))
    found = search.improve(*next(search.starts()), evaluations=80)
    assert search.allows(found.code)
    full = np.zeros(FEATURES)
    full[search.used[: search._most]] = 1
    assert search.active_bounds(full) == ["largest open_part"]


def test_an_impossible_bound_is_refused_by_name(objective: Objective) -> None:
    with pytest.raises(MitsimError, match=r"open_part: got 0\.01 to 0\.011"):
        Search([objective], open_part=(0.01, 0.011))


def test_the_worst_of_two_exposures_counts(objective: Objective) -> None:
    dim = Objective(objective.sides, replace(LIGHT, frame_s=0.05), Prior(), SCENES)
    worst, mean = (Search([objective, dim], worst=worst).score(CODE).score for worst in (True, False))
    alone = [Search([each]).score(CODE).score for each in (objective, dim)]
    assert mean == pytest.approx(np.sqrt(alone[0] * alone[1]), rel=1e-9)
    assert 0.9 * max(alone) < worst <= max(alone)


@pytest.mark.parametrize(("read_noise_e", "lit_pixels"), [(3.0, 2), (300.0, 3)])
def test_the_best_cyclic_patterns_are_those_of_all_codes(read_noise_e: float, lit_pixels: int) -> None:
    """Each of 31 codes of period 5 with patterns of its own; mirror images, which are not tried, differ by 1e-3.

    Behind lamps, whose frame has more shots for patterns that overlap, as in a capture.
    """
    light, patterns = replace(LIGHT, read_noise_e=read_noise_e), list[FloatArray]()
    for number in range(1, 32):
        bits = np.array([number >> place & 1 for place in range(5)], dtype=np.float64)
        patterns.append(np.stack([np.roll(np.tile(bits, 4), shift)[:N] for shift in range(5)], axis=1))
    every = []
    for each in patterns:
        alike = float(np.square(each.sum(axis=1)).sum() / np.square(each).sum()) ** 2
        one = side(LINES, each, lit=True)
        every.append(Objective((one, one), replace(light, ambient_shots=alike), Prior(), SCENES)((CODE, CODE)).total)
    one = side(LINES, lit=True)
    search = Search([Objective((one, one), replace(light, ambient_shots=1.0), Prior(), SCENES)])
    lit = search.best_patterns(CODE, 5)
    found = search.lit_by(lit).score(CODE).score
    assert found < (1 + 1e-3) * min(every) and found <= search.lit_by("10000").score(CODE).score
    assert any(found == pytest.approx(each, rel=1e-9) for each in every)
    assert lit.count("1") == lit_pixels


@pytest.mark.parametrize(("period", "count", "code"), [(7, 17, "1101000"), (19, 36, "1111010100001101100")])
def test_codes_have_difference_sets(period: int, count: int, code: str) -> None:
    """17 necklaces of 7 beads that may be turned over are not all dark; of 19, two sets and runs and even spreads."""
    codes = cyclic_codes(period)
    same = {each[i:] + each[:i] for each in (code, code[::-1]) for i in range(period)}
    assert codes[0] == "1" + "0" * (period - 1) and len(same & set(codes)) == 1
    assert len(codes) == count


def test_pinholes_are_equal_and_centred() -> None:
    assert pinholes(9, 4, 1).tolist() == [1, 0, 0, 0, 1, 0, 0, 0, 1]
    assert pinholes(9, 4, 2).tolist() == [1, 0, 0, 1, 1, 0, 0, 1, 1]

"""What an image is expected to be, against the solver itself: every frame formed, every datum disturbed on its own."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest

from mitsim.devices.patterns import PatternFamily, parse_patterns
from mitsim.reconstruct.solver import Prepared, prepare
from mitsim.studies.causes import Changed, LinearImage, Noise, Scatter

N, PIXELS, LAM = 4, 5, 0.3
RNG = np.random.default_rng(4)
LEFT, RIGHT, OTHER, FURTHER = (RNG.standard_normal((PIXELS, N)) + 1 for _ in range(4))
SCENE, FRAME = RNG.random((N, N)), RNG.random((PIXELS, PIXELS))
RESPONSE = 0.1 * RNG.standard_normal((PIXELS, PIXELS))
GAIN = 1 + 0.1 * RNG.random((2, 2, 2))
GAIN[1, 0, 0] = GAIN[0, 0, 0]
"""Of two shots of each pattern, the same for the first."""
LEAK = 0.1
FAMILIES = ("dots:2", "dots:1x2", "uniform", "random:2", "hadamard:2")


def family(name: str) -> PatternFamily:
    return parse_patterns(name, N, seed=3)


def shadow(
    left: np.ndarray, right: np.ndarray, shown: PatternFamily, scene: np.ndarray = SCENE, leak: float = 0.0
) -> np.ndarray:
    """(S, K, K, m, m) frames: of a pattern of +-1 two."""
    pattern = np.einsum("ni,Nj->ijnN", shown.left, shown.right).astype(float)
    light = np.stack([(1 + pattern) / 2, (1 - pattern) / 2] if shown.signed else [pattern])
    return np.einsum("mn,sijnN,nN,MN->sijmM", left, light + leak, scene, right)


@cache
def prepared(name: str, centre: bool) -> Prepared:
    return prepare(LEFT, RIGHT, family(name).left, family(name).right, centre=centre)


def solved(frames: np.ndarray, shown: PatternFamily, centre: bool = False) -> np.ndarray:
    """Of frames (S, K, K, m, m)."""
    model = prepared(shown.name, centre)
    sums, data = model.accumulator(), frames[0] - frames[1] if shown.signed else frames[0]
    for row, column in np.ndindex(data.shape[:2]):
        sums.add(data[row, column], row, column)
    return model.solve(sums, LAM).image


def image(shown: PatternFamily, centre: bool = False) -> LinearImage:
    return LinearImage(LEFT, RIGHT, shown, LAM, centre)


def seen(shown: PatternFamily, leak: float = 0.0) -> np.ndarray:
    return shadow(LEFT, RIGHT, shown, leak=leak)


def gains(shown: PatternFamily) -> np.ndarray:
    """(S, K, K)"""
    return GAIN[: 2 if shown.signed else 1, : shown.left.shape[1], : shown.right.shape[1]]


def gained(shown: PatternFamily, **others: Any) -> Changed:
    first, last = gains(shown)[0], gains(shown)[-1]
    return Changed(gain=(first + last) / 2, gain_apart=(first - last) / 2, **others)


CASES: dict[str, Callable[[PatternFamily], tuple[Changed, np.ndarray]]] = {
    "nothing": lambda shown: (Changed(), seen(shown)),
    "another camera": lambda shown: (Changed([(OTHER, FURTHER)]), seen(shown) + shadow(OTHER, FURTHER, shown)),
    "gains": lambda shown: (gained(shown), gains(shown)[..., None, None] * seen(shown)),
    "a frame in all": lambda shown: (Changed(added=FRAME, added_gain=0.5), seen(shown) + 0.5 * FRAME),
    "a leak": lambda shown: (Changed(leak=LEAK), seen(shown, LEAK)),
    "responses": lambda shown: (
        gained(shown, response=RESPONSE) if not shown.signed else Changed(response=RESPONSE),
        (1 + RESPONSE) * seen(shown) * (1 if shown.signed else gains(shown)[..., None, None]),
    ),
}


@pytest.mark.parametrize("centre", [False, True])
@pytest.mark.parametrize("name", FAMILIES)
@pytest.mark.parametrize("case", CASES)
def test_the_mean_is_the_solvers_image(case: str, name: str, centre: bool) -> None:
    """To rounding. (Planted: the slabs of the other side; a change added twice; factors not centred; a frame or a leak
    in differences; uniform light of the other sign; responses without the gain.)"""
    shown = family(name)
    changed, frames = CASES[case](shown)
    found = image(shown, centre).expected_image(SCENE, changed)
    assert np.allclose(found.image, solved(frames, shown, centre), rtol=1e-9, atol=1e-9)
    assert found.variance == 0


def test_gains_of_two_frames_weigh_what_black_pixels_leak() -> None:
    """As all of their light. (Planted: the leak once.)"""
    shown = family("hadamard:2")
    found = image(shown).expected_image(SCENE, gained(shown, leak=LEAK)).image
    assert np.allclose(found, solved(gains(shown)[..., None, None] * seen(shown, LEAK), shown), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", FAMILIES)
def test_variances_are_sums_over_all_that_varies(name: str) -> None:
    """The solver is linear in frames: the squares of what each datum, each frame's gain and each number of a factor
    does to the image alone, added up. (Planted: the filter once; the right factor's scene not transposed; the ambient
    frame's noise as that of data; noise and flicker of one frame of two, of
    their light without the leak; columns' light of the other side.)"""
    shown = family(name)
    frames, dark = seen(shown), np.zeros_like(seen(shown))
    count = frames.shape[:3]

    def energy(disturbances: list[np.ndarray]) -> float:
        return float(sum(np.square(solved(each, shown)).sum() for each in disturbances))

    def single(place: tuple[int, ...]) -> np.ndarray:
        one = dark.copy()
        one[place] = 1
        return one

    def unit(place: tuple[int, ...]) -> np.ndarray:
        one = np.zeros((PIXELS, N))
        one[place] = 1
        return one

    rows = RNG.standard_normal(PIXELS)
    pixels = np.eye(N * N).reshape(-1, N, N)
    data = [single(place) for place in np.ndindex(dark.shape)]
    common = [single((..., *place)) for place in np.ndindex(PIXELS, PIXELS)]
    alone = [single(shot) for shot in np.ndindex(count)]
    of_frames, of_added = ([light * one for one in alone] for light in (frames, FRAME))
    of_leaking = [seen(shown, LEAK) * one for one in alone]
    left = [shadow(unit(place), RIGHT, shown) for place in np.ndindex(PIXELS, N)]
    right = [shadow(LEFT, unit(place), shown) for place in np.ndindex(PIXELS, N)]
    light = [shadow(LEFT, RIGHT, shown, one) for one in pixels]
    by_row = [0.5 * rows, np.full(PIXELS, 0.2)]
    rippled = [gain[:, None] * one for gain in by_row for one in of_frames]
    added = [gain[:, None] * one for gain in by_row for one in of_added]
    common_rows = [dark + gain[:, None] * FRAME for gain in by_row]
    columns = [shadow(LEFT * one, RIGHT, shown) for one in np.eye(N)]
    others = [shadow(LEFT, RIGHT * one, shown) for one in np.eye(N)]
    cases = [
        (None, Noise(datum=0.7), 0.7, data),
        *([] if shown.signed else [(None, Noise(ambient=0.7), 0.7, common)]),
        (None, Noise(left=0.7), 0.7, left),
        (None, Noise(right=0.7), 0.7, right),
        (None, Noise(light=0.7), 0.7, light),
        (None, Noise(left_light=0.7), 0.7, columns),
        (None, Noise(right_light=0.7), 0.7, others),
        (None, Noise(datum=0.2, light=0.1) + Noise(datum=0.5, light=0.6), 0.7, data + light),
        (Changed(flicker=(0.3,)), None, 0.09, of_frames),
        (Changed(added=FRAME, added_gain=0.0, added_flicker=(0.3,)), None, 0.09, of_added),
        (Changed(added=FRAME, added_gain=0.0, added_common=(0.3,)), None, 0.09, [dark + FRAME]),
        (Changed(flicker=(0.5 * rows, 0.2)), None, 1.0, rippled),
        *([(Changed(flicker=(0.3,), leak=LEAK), None, 0.09, of_leaking)] if shown.signed else []),
        (Changed(added=FRAME, added_gain=0.0, added_flicker=(0.5 * rows, 0.2)), None, 1.0, added),
        (Changed(added=FRAME, added_gain=0.0, added_common=(0.5 * rows, 0.2)), None, 1.0, common_rows),
    ]
    for changed, noise, variance, disturbances in cases:
        found = image(shown).expected_image(SCENE, changed, noise).variance
        assert found == pytest.approx(variance * energy(disturbances), rel=1e-9), (changed, noise)


def test_decibels_of_a_gain_are_known_exactly() -> None:
    """Without noise and with next to no lambda, power 1 + e makes the image (1 + e) X: its error is e X. (Planted: the
    gain squared.)"""
    shown = family("dots:2")
    exact = LinearImage(LEFT, RIGHT, shown, 1e-12)
    found = exact.expected_image(SCENE, Changed(gain=1.02)).psnr_db(SCENE)
    assert found == pytest.approx(-20 * np.log10(0.02 * np.sqrt(np.square(SCENE).mean())), abs=1e-6)


# -------- How a squared error scatters, against draws of the noise

SIDE, ROWS, WEIGHT, SIZE, DRAWS = 6, 9, 0.3, 0.02, 600
SEEDED = np.random.default_rng(4)
TALL, WIDE = (SEEDED.standard_normal((ROWS, SIDE)) + 0.3 for _ in range(2))
PLANE, ERROR = SEEDED.random((SIDE, SIDE)), 0.02 * SEEDED.standard_normal((SIDE, SIDE))


@pytest.mark.parametrize("name", ["dots:2", "uniform"])
def test_squared_errors_scatter_as_stated(name: str) -> None:
    """600 draws, whose spread is known to 3 to 5 %: every kind of noise alone, beside an error that is none and without
    it, and all of them together, which have more in common than is stated. (Planted: factors' noise
    independent from number to number; the error's coefficients not filtered; the scene not transposed on the right.)"""
    shown, rng = parse_patterns(name, SIDE, seed=3), np.random.default_rng(1)
    model = prepare(TALL, WIDE, shown.left, shown.right)
    scatter = Scatter(LinearImage(TALL, WIDE, shown, WEIGHT), PLANE)

    def solved(left: np.ndarray, right: np.ndarray, scene: np.ndarray, datum: float = 0.0) -> np.ndarray:
        sums = model.accumulator()
        for row, column in np.ndindex(shown.left.shape[1], shown.right.shape[1]):
            lit = np.outer(shown.left[:, row], shown.right[:, column]) * scene
            sums.add(left @ lit @ right.T + datum * rng.standard_normal((ROWS, ROWS)), row, column)
        return model.solve(sums, WEIGHT).image

    def drawn(*shape: int) -> np.ndarray:
        return SIZE * rng.standard_normal(shape)

    draws = {
        "datum": lambda: solved(TALL, WIDE, 0 * PLANE, SIZE),
        "left": lambda: solved(drawn(ROWS, SIDE), WIDE, PLANE),
        "right": lambda: solved(TALL, drawn(ROWS, SIDE), PLANE),
        "light": lambda: solved(TALL, WIDE, drawn(SIDE, SIDE)),
        "left_light": lambda: solved(TALL * drawn(SIDE), WIDE, PLANE),
        "right_light": lambda: solved(TALL, WIDE * drawn(SIDE), PLANE),
    }
    all_kinds = []
    for kind in draws:
        noise = Noise(**{kind: SIZE**2})
        images = np.stack([draws[kind]() for _ in range(DRAWS)])
        all_kinds.append(images)
        for error in (ERROR, 0 * ERROR):
            spread = np.square(images + error).sum(axis=(1, 2)).std()
            assert scatter.deviation(noise, error) == pytest.approx(spread, rel=0.15), kind
        assert scatter.common(noise, ERROR) == pytest.approx(2 * (images * ERROR).sum(axis=(1, 2)).std(), rel=0.12)
    spread = np.square(sum(all_kinds) + ERROR).sum(axis=(1, 2)).std()
    together = Noise(**dict.fromkeys(draws, SIZE**2))
    assert scatter.deviation(together, ERROR) == pytest.approx(spread, rel=0.15)


def test_shares_of_sources_add_up_in_squares() -> None:
    """Of two sources, each with what it has in common with the other. (Planted: the source alone.)"""
    scatter = Scatter(LinearImage(TALL, WIDE, parse_patterns("dots:2", SIDE, seed=3), WEIGHT), PLANE)
    first, second = Noise(datum=1e-4), Noise(left=2e-4, light=1e-4)
    share = scatter.share(first, first + second, ERROR)
    assert share**2 + scatter.deviation(second, ERROR) ** 2 == pytest.approx(
        scatter.deviation(first + second, ERROR) ** 2
    )
    assert share > scatter.deviation(first, ERROR)


def test_factors_of_a_dark_scene_scatter_nothing() -> None:
    """(Planted: sums that begin at 1.)"""
    scatter = Scatter(LinearImage(TALL, WIDE, parse_patterns("dots:2", SIDE, seed=3), WEIGHT), 0 * PLANE)
    for kind in ("left", "right", "left_light", "right_light"):
        assert scatter.deviation(Noise(**{kind: 1.0}), ERROR) == 0, kind

"""How a squared error scatters, against draws of the noise."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.devices.patterns import parse_patterns
from mitsim.reconstruct.solver import prepare
from mitsim.studies.causes import LinearImage, Noise, Scatter

N, PIXELS, LAM, SIZE, DRAWS = 6, 9, 0.3, 0.02, 600
RNG = np.random.default_rng(4)
LEFT, RIGHT = (RNG.standard_normal((PIXELS, N)) + 0.3 for _ in range(2))
SCENE, ERROR = RNG.random((N, N)), 0.02 * RNG.standard_normal((N, N))
KINDS = ("datum", "left", "right", "light", "left_light", "right_light")


@pytest.mark.parametrize("name", ["dots:2", "uniform"])
def test_squared_errors_scatter_as_stated(name: str) -> None:
    """600 draws, whose spread is known to 3 to 5 %: every kind of noise alone, beside an error that is none and without
    it, and all of them together, which have more in common than is stated. (Planted: factors' noise
    independent from number to number; the error's coefficients not filtered; the scene not transposed on the right.)"""
    shown, rng = parse_patterns(name, N, seed=3), np.random.default_rng(1)
    model = prepare(LEFT, RIGHT, shown.left, shown.right)
    scatter = Scatter(LinearImage(LEFT, RIGHT, shown, LAM), SCENE)

    def solved(left: np.ndarray, right: np.ndarray, scene: np.ndarray, datum: float = 0.0) -> np.ndarray:
        sums = model.accumulator()
        for row, column in np.ndindex(shown.left.shape[1], shown.right.shape[1]):
            lit = np.outer(shown.left[:, row], shown.right[:, column]) * scene
            sums.add(left @ lit @ right.T + datum * rng.standard_normal((PIXELS, PIXELS)), row, column)
        return model.solve(sums, LAM).image

    def drawn(*shape: int) -> np.ndarray:
        return SIZE * rng.standard_normal(shape)

    draws = {
        "datum": lambda: solved(LEFT, RIGHT, 0 * SCENE, SIZE),
        "left": lambda: solved(drawn(PIXELS, N), RIGHT, SCENE),
        "right": lambda: solved(LEFT, drawn(PIXELS, N), SCENE),
        "light": lambda: solved(LEFT, RIGHT, drawn(N, N)),
        "left_light": lambda: solved(LEFT * drawn(N), RIGHT, SCENE),
        "right_light": lambda: solved(LEFT, RIGHT * drawn(N), SCENE),
    }
    all_kinds = []
    for kind in KINDS:
        noise = Noise(**{kind: SIZE**2})
        images = np.stack([draws[kind]() for _ in range(DRAWS)])
        all_kinds.append(images)
        for error in (ERROR, 0 * ERROR):
            spread = np.square(images + error).sum(axis=(1, 2)).std()
            assert scatter.deviation(noise, error) == pytest.approx(spread, rel=0.15), kind
        assert scatter.common(noise, ERROR) == pytest.approx(2 * (images * ERROR).sum(axis=(1, 2)).std(), rel=0.12)
    spread = np.square(sum(all_kinds) + ERROR).sum(axis=(1, 2)).std()
    together = Noise(**dict.fromkeys(KINDS, SIZE**2))
    assert scatter.deviation(together, ERROR) == pytest.approx(spread, rel=0.15)


def test_shares_of_sources_add_up_in_squares() -> None:
    """Of two sources, each with what it has in common with the other. (Planted: the source alone.)"""
    scatter = Scatter(LinearImage(LEFT, RIGHT, parse_patterns("dots:2", N, seed=3), LAM), SCENE)
    first, second = Noise(datum=1e-4), Noise(left=2e-4, light=1e-4)
    share = scatter.share(first, first + second, ERROR)
    assert share**2 + scatter.deviation(second, ERROR) ** 2 == pytest.approx(
        scatter.deviation(first + second, ERROR) ** 2
    )
    assert share > scatter.deviation(first, ERROR)


def test_factors_of_a_dark_scene_scatter_nothing() -> None:
    """(Planted: sums that begin at 1.)"""
    scatter = Scatter(LinearImage(LEFT, RIGHT, parse_patterns("dots:2", N, seed=3), LAM), 0 * SCENE)
    for kind in ("left", "right", "left_light", "right_light"):
        assert scatter.deviation(Noise(**{kind: 1.0}), ERROR) == 0, kind

"""Least squares of many frames of a convolutional camera: both solvers against dense algebra.

The matrix of a camera is built from the definition y[s] = sum_p h[s - p] x[p], by slicing and without a transform; all
seeds are 0 unless stated. Sizes are small and awkward: psf of 14 x 11, periods that do not divide the scene.
"""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import parse_patterns
from mitsim.reconstruct.point_spread import DotClasses, ShiftedLight, conjugate_gradients, solve_iteratively
from mitsim.reconstruct.solver import Verdict
from tests.unit.reconstruct.test_point_spread import matrix

CASES = [(1, 9), (2, 9), (3, 9), (3, 10), (5, 5)]
"""Period and scene pixels: uniform, uneven classes, even ones, and a class for each pixel."""


def spread() -> np.ndarray:
    light = np.random.default_rng(7).random((14, 11)) ** 8
    return light / light.sum()


def noisy(camera: ShiftedLight) -> np.ndarray:
    """Frames of a random scene with noise of 1e-3."""
    rng = np.random.default_rng(0)
    frames = camera.image_of(rng.random(camera.scene))
    return frames + 1e-3 * rng.standard_normal(frames.shape)


def distance(image: np.ndarray, exact: np.ndarray) -> float:
    return float(np.linalg.norm(image.ravel() - exact.ravel()) / np.linalg.norm(exact))


@pytest.mark.parametrize("sensor", [None, (15, 12), (8, 15)])
@pytest.mark.parametrize(("k", "n"), CASES)
def test_both_solvers_find_the_dense_minimiser(sensor: tuple[int, int] | None, k: int, n: int) -> None:
    """Conjugate gradients at a residual of 1e-11 are off by that times the condition, at most 1e5 here."""
    camera = ShiftedLight.of(spread(), n, sensor)
    lit = camera.under(parse_patterns(f"dots:{k}", n))
    frames, lam = noisy(lit), 1e-4 * float(np.square(camera.psf).sum())
    system = np.concatenate([matrix(lit), np.sqrt(lam) * np.eye(n * n)])
    exact = np.linalg.lstsq(system, np.concatenate([frames.ravel(), np.zeros(n * n)]), rcond=None)[0]
    iterative = solve_iteratively(lit, frames, lam, 1e-11)
    assert iterative.ok and distance(iterative.image, exact) < 1e-6
    if sensor is None:
        classes = DotClasses(camera, k)
        projected = classes.project(frames)
        np.testing.assert_allclose(projected, lit.correlate(frames), atol=1e-13)
        direct = classes.solve(projected, lam, 1e-11)
        assert direct.ok and distance(direct.image, exact) < 1e-6


def test_iterations_that_do_not_suffice_are_told() -> None:
    camera = ShiftedLight.of(spread(), 9)
    short = solve_iteratively(camera, noisy(camera), 1e-6, 1e-10, iterations=3)
    assert not short.ok and short.status.verdict is Verdict.NOT_CONVERGED and short.iterations == 3
    assert "allow more iterations" in str(short.status)


def test_a_watch_ends_the_iterations() -> None:
    camera, seen = ShiftedLight.of(spread(), 9), list[float]()

    def watch(image: np.ndarray) -> bool:
        seen.append(float(np.linalg.norm(image)))
        return len(seen) == 4

    found = solve_iteratively(camera, noisy(camera), 1e-6, 1e-10, 100, watch)
    assert found.iterations == 4 and seen[-1] == np.linalg.norm(found.image)


def test_nothing_seen_is_a_dark_image() -> None:
    dark = conjugate_gradients(lambda image: image, np.zeros((3, 3)), 0.0)
    assert dark.ok and dark.iterations == 0 and not dark.image.any()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda camera: DotClasses(camera, 2).project(np.ones((3, 6, 6))), r"shape \(3, 6, 6\): give 4 of 6 x 6"),
        (lambda camera: solve_iteratively(camera, np.full((1, 6, 6), np.nan), 1.0), "finite numbers"),
        (lambda camera: DotClasses(camera, 5), "give 1 to 4"),
        (lambda camera: DotClasses(ShiftedLight.of(camera.psf, 4, (2, 2)), 1), "where it gets all light"),
        (lambda camera: DotClasses(camera, 2).solve(np.ones((4, 4)), -1.0), "lambda is -1.0"),
        (lambda camera: camera.under(parse_patterns("uniform", 5)), "patterns of 5"),
        (lambda camera: ShiftedLight.of(camera.psf, 4, (7, 4)), "light reaches 6 x 6"),
        (lambda camera: ShiftedLight.of(camera.psf, 0), "0 pixels a side"),
        (lambda camera: ShiftedLight.of(np.full((3, 3), np.nan), 4), "finite"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused(make: object, words: str) -> None:
    with pytest.raises(MitsimError, match=words):
        make(ShiftedLight.of(np.ones((3, 3)), 4))  # type: ignore[operator]

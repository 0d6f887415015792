"""Convolutional cameras against matrices written out, entry by entry, and their solvers against dense algebra.

The matrix of a camera is built here from the definition y[s] = sum_p h[s - p] x[p], by slicing and without a transform;
all seeds are 0 unless stated. Sizes are small and awkward: psf of 14 x 11, periods that do not divide the scene.
"""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import parse_patterns
from mitsim.reconstruct.convolution import MOST_FACTORISED, Classes, conjugate_gradients, solve_iteratively
from mitsim.reconstruct.point_spread import ShiftedLight
from mitsim.reconstruct.solution import Verdict

SENSORS = [None, (15, 12), (8, 15)]
"""All light; cropped on all sides, unevenly; higher than wide, narrower than all light."""
CASES = [(1, 9), (2, 9), (3, 9), (3, 10), (5, 5)]
"""Period and scene pixels: uniform, uneven classes, even ones, and a class for each pixel."""


def spread() -> np.ndarray:
    light = np.random.default_rng(7).random((14, 11)) ** 8
    return light / light.sum()


def matrix(camera: ShiftedLight) -> np.ndarray:
    """(sensor pixels, n n) from the definition."""
    rows, columns = camera.psf.shape
    top, left = ((whole - size) // 2 for whole, size in zip(camera.whole, camera.sensor, strict=True))
    seen = []
    for row in range(camera.scene[0]):
        for column in range(camera.scene[0]):
            light = np.zeros(camera.whole)
            light[row : row + rows, column : column + columns] = camera.psf
            seen.append(light[top : top + camera.sensor[0], left : left + camera.sensor[1]].ravel())
    return np.stack(seen, axis=1)


def stacked(camera: ShiftedLight, name: str) -> np.ndarray:
    """The matrices of all patterns, one above the other."""
    family, one = parse_patterns(name, camera.scene[0]), matrix(camera)
    patterns = [np.outer(row, column).ravel() for row in family.left.T for column in family.right.T]
    return np.concatenate([one * pattern for pattern in patterns])


def noisy(camera: ShiftedLight, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Frames of a random scene with noise of 1e-3, and all their numbers in one."""
    rng = np.random.default_rng(0)
    family = parse_patterns(name, camera.scene[0])
    frames = camera.under(family).image_of(rng.random(camera.scene))
    frames = np.stack([frame + 1e-3 * rng.standard_normal(frame.shape) for frame in frames])
    return frames, frames.ravel()


def tikhonov(whole: np.ndarray, data: np.ndarray, lam: float) -> np.ndarray:
    """The minimiser, by least squares of the stacked problem (QR: no normal equations)."""
    unknowns = whole.shape[1]
    system = np.concatenate([whole, np.sqrt(lam) * np.eye(unknowns)])
    return np.linalg.lstsq(system, np.concatenate([data, np.zeros(unknowns)]), rcond=None)[0]


def distance(image: np.ndarray, exact: np.ndarray) -> float:
    return float(np.linalg.norm(image.ravel() - exact) / np.linalg.norm(exact))


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("name", ["uniform", "dots:3", "hadamard:4"])
def test_frames_are_the_definition_s_and_their_adjoint_is_the_transpose(
    sensor: tuple[int, int] | None, name: str
) -> None:
    """To rounding of the transforms, 1e-15 of the largest numbers; 1e-12 leaves room for sums."""
    camera, rng = ShiftedLight.of(spread(), 10, sensor), np.random.default_rng(0)
    family, whole, scene = parse_patterns(name, 10), stacked(camera, name), rng.random((10, 10))
    lit = camera.under(family)
    frames = lit.image_of(scene)
    np.testing.assert_allclose(frames.ravel(), whole @ scene.ravel(), atol=1e-12)
    data = rng.standard_normal(frames.shape)
    np.testing.assert_allclose(lit.correlate(data).ravel(), whole.T @ data.ravel(), atol=1e-12)


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize(("k", "n"), CASES)
def test_both_solvers_find_the_dense_minimiser(sensor: tuple[int, int] | None, k: int, n: int) -> None:
    """Conjugate gradients at a residual of 1e-11 are off by that times the condition, at most 1e5 here; Cholesky by
    rounding times the condition."""
    camera, name = ShiftedLight.of(spread(), n, sensor), f"dots:{k}"
    frames, data = noisy(camera, name)
    lam = 1e-4 * float(np.square(camera.psf).sum())
    exact = tikhonov(stacked(camera, name), data, lam)
    family, classes = parse_patterns(name, n), Classes(camera, k)
    iterative = solve_iteratively(camera.under(family), frames, lam, 1e-11)
    assert iterative.ok and distance(iterative.image, exact) < 1e-6
    projected = classes.project(frames)
    np.testing.assert_allclose(projected, camera.under(family).correlate(frames), atol=1e-13)
    direct = classes.factorise(lam).solve(projected, 1e-11)
    assert direct.ok and classes.factorised == (sensor is not None)
    assert distance(direct.image, exact) < (1e-6 if sensor is None else 1e-10)


def test_classes_too_large_to_factorise_are_solved_with_the_crop_in_each_step() -> None:
    side = int(np.sqrt(MOST_FACTORISED)) + 1
    camera = ShiftedLight.of(spread(), 2 * side, (2 * side + 3, 2 * side + 5))
    frames, _ = noisy(camera, "dots:2")
    classes, lam = Classes(camera, 2), 1e-2 * float(np.square(camera.psf).sum())
    assert not classes.factorised
    direct = classes.factorise(lam).solve(classes.project(frames), 1e-9)
    iterative = solve_iteratively(camera.under(parse_patterns("dots:2", 2 * side)), frames, lam, 1e-9)
    assert direct.ok and distance(direct.image, iterative.image.ravel()) < 1e-6
    assert direct.iterations < iterative.iterations  # the division is near the inverse


def test_noise_free_frames_give_the_scene_back() -> None:
    scene = np.random.default_rng(3).random((9, 9))
    for sensor in (None, (16, 13)):
        camera = ShiftedLight.of(spread(), 9, sensor)
        classes = Classes(camera, 3)
        frames = camera.under(parse_patterns("dots:3", 9)).image_of(scene)
        image = classes.factorise(0.0).solve(classes.project(frames), 1e-12).image
        np.testing.assert_allclose(image, scene, atol=1e-9)


def test_iterations_that_do_not_suffice_are_told() -> None:
    camera = ShiftedLight.of(spread(), 9)
    frames, _ = noisy(camera, "uniform")
    short = solve_iteratively(camera, frames, 1e-6, 1e-10, iterations=3)
    assert not short.ok and short.status.verdict is Verdict.NOT_CONVERGED and short.iterations == 3
    assert "allow more iterations" in str(short.status)


def test_a_watch_ends_the_iterations() -> None:
    camera = ShiftedLight.of(spread(), 9)
    frames, _ = noisy(camera, "uniform")
    seen: list[float] = []

    def watch(image: np.ndarray) -> bool:
        seen.append(float(np.linalg.norm(image)))
        return len(seen) == 4

    found = solve_iteratively(camera, frames, 1e-6, 1e-10, 100, watch)
    assert found.iterations == 4 and seen[-1] == np.linalg.norm(found.image)


def test_nothing_seen_is_a_dark_image() -> None:
    dark = conjugate_gradients(lambda image: image, np.zeros((3, 3)), 0.0)
    assert dark.ok and dark.iterations == 0 and not dark.image.any()


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        (np.ones((3, 6, 6)), r"shape \(3, 6, 6\): give 4 of 6 x 6"),
        (np.ones((4, 1, 6)), "give 4 of 6 x 6"),
        (np.full((4, 6, 6), np.nan), "finite numbers"),
    ],
)
def test_frames_that_do_not_fit_are_refused_by_both_solvers(frames: np.ndarray, words: str) -> None:
    camera = ShiftedLight.of(np.ones((3, 3)), 4)
    with pytest.raises(MitsimError, match=words):
        Classes(camera, 2).project(frames)
    with pytest.raises(MitsimError, match=words):
        solve_iteratively(camera.under(parse_patterns("dots:2", 4)), frames, 1e-3)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ShiftedLight.of(np.zeros((3, 3)), 4), "not all 0"),
        (lambda: ShiftedLight.of(np.full((3, 3), np.nan), 4), "finite"),
        (lambda: ShiftedLight.of(np.ones((3, 3)), 0), "0 pixels a side"),
        (lambda: ShiftedLight.of(np.ones((3, 3)), 4, (7, 4)), "light reaches 6 x 6"),
        (lambda: Classes(ShiftedLight.of(np.ones((3, 3)), 4), 5), "give 1 to 4"),
        (lambda: Classes(ShiftedLight.of(np.ones((3, 3)), 4), 2).factorise(-1.0), "lambda is -1.0"),
        (lambda: Classes(ShiftedLight.of(np.ones((3, 3)), 4, (2, 2)), 1).factorise(0.0), "singular"),
        (lambda: ShiftedLight.of(np.ones((3, 3)), 4).under(parse_patterns("uniform", 5)), "patterns of 5"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused(make: object, words: str) -> None:
    with pytest.raises(MitsimError, match=words):
        make()  # type: ignore[operator]

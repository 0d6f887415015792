"""Expected error by cause against Monte Carlo images, and its gradients against finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.core.arrays import FloatArray
from mitsim.design.expected import Cause, ExpectedError, Pair, expected_error

RANDOM = np.random.default_rng(0)
N, M, K = 6, 8, 3
DRAWS = 6000
"""Images of each cause: their means scatter by 2 % or less (one standard error), and 5 of those are allowed."""
FACTORS, MOVED = ([RANDOM.standard_normal((M, N)) for _ in range(2)] for _ in range(2))
PATTERNS = [(RANDOM.random((N, K)) < 0.6).astype(np.float64) for _ in range(2)]
COVARIANCE = 0.9 ** np.abs(np.subtract.outer(np.arange(N), np.arange(N)))
ROOT = np.linalg.cholesky(COVARIANCE)
MEAN, DEVIATION, WEIGHTS = 0.5, 0.2, {"noise": 1e-2, "factors": 4e-4, "detail": 1e-3, "ambient": 3e-3}
SCENES = [MEAN + DEVIATION * ROOT @ RANDOM.standard_normal((N, N)) @ ROOT.T for _ in range(2)]


def matrices(side: int) -> tuple[FloatArray, ...]:
    factor, moved, patterns = FACTORS[side], MOVED[side], PATTERNS[side]
    cross, gram, total = factor.T @ factor, patterns @ patterns.T, patterns.sum(axis=1)
    inside = (factor.T @ moved) * gram
    return cross * gram, cross * (gram @ gram), inside @ inside.T, cross * np.outer(total, total)


def problem() -> tuple[Pair, list[Cause], list[FloatArray]]:
    (gram, reused, inside, summed), others = matrices(0), matrices(1)
    even, one = np.ones((N, N)), np.eye(N)
    second = MEAN**2 * even + DEVIATION**2 * COVARIANCE
    causes = [
        Cause("noise", (1, 1), (one, one), WEIGHTS["noise"]),
        Cause("factors", (0, 2), (reused, second), WEIGHTS["factors"]),
        Cause("factors", (2, 0), (second, others[1]), WEIGHTS["factors"]),
        Cause("detail", (0, 2), (inside, COVARIANCE), WEIGHTS["detail"]),
        Cause("detail", (2, 0), (COVARIANCE, others[2]), WEIGHTS["detail"]),
        Cause("ambient", (0, 0), (summed, others[3]), WEIGHTS["ambient"]),
    ]
    return (gram, others[0]), causes, SCENES


def drawn(lam: float) -> dict[str, FloatArray]:
    """Return squared errors (DRAWS,) of images by cause, with frames as stacks over all patterns."""

    def stack(values: FloatArray, side: int) -> FloatArray:
        return np.concatenate([values * pattern for pattern in PATTERNS[side].T])

    random = np.random.default_rng(1)
    left, right = (stack(FACTORS[side], side) for side in (0, 1))
    (u, s, v), (w, t, x) = (np.linalg.svd(each, full_matrices=False) for each in (left, right))
    gain = np.outer(s, t) / (np.square(np.outer(s, t)) + lam)

    def image(frames: FloatArray) -> FloatArray:
        return np.asarray(v.T @ (gain * (u.T @ frames @ w)) @ x)

    def detail(deviation: float) -> FloatArray:
        """White along rows of the first factor: its own axis; correlated along the other."""
        return np.asarray(deviation * random.standard_normal((N, N)) @ ROOT.T)

    def normal(variance: float, *shape: int) -> FloatArray:
        return np.asarray(np.sqrt(variance) * random.standard_normal(shape))

    found: dict[str, list[float]] = {name: [] for name in ("noise", "factors", "detail", "ambient")}
    for _ in range(DRAWS):
        scene = MEAN + DEVIATION * ROOT @ random.standard_normal((N, N)) @ ROOT.T
        rows, columns = (stack(normal(WEIGHTS["factors"], M, N), side) for side in (0, 1))
        moved = [stack(MOVED[side], side) for side in (0, 1)]
        inside = detail(np.sqrt(WEIGHTS["detail"])), detail(np.sqrt(WEIGHTS["detail"])).T
        errors = {
            "noise": image(normal(WEIGHTS["noise"], K * M, K * M)),
            "factors": image(rows @ scene @ right.T + left @ scene @ columns.T),
            "detail": image(moved[0] @ inside[0] @ right.T + left @ inside[1] @ moved[1].T),
            "ambient": image(np.tile(normal(WEIGHTS["ambient"], M, M), (K, K))),
        }
        for name, error in errors.items():
            found[name].append(float(np.square(error).sum()))
    return {name: np.array(values) for name, values in found.items()}


@pytest.fixture(scope="module")
def best() -> ExpectedError:
    return expected_error(*problem())


def test_each_cause_is_the_mean_of_many_images(best: ExpectedError) -> None:
    """Seed 1, 6000 images; five standard errors, so that one run in a million fails by chance."""
    left, right = (np.concatenate([FACTORS[side] * c for c in PATTERNS[side].T]) for side in (0, 1))
    (u, s, v), (w, t, x) = (np.linalg.svd(each, full_matrices=False) for each in (left, right))
    gain = np.outer(s, t) / (np.square(np.outer(s, t)) + best.lam)
    images = [v.T @ (gain * (u.T @ left @ scene @ right.T @ w)) @ x for scene in SCENES]
    bias = [float(np.square(image - scene).sum()) for image, scene in zip(images, SCENES, strict=True)]
    assert best.parts["regularisation_bias"] == pytest.approx(np.mean(bias), rel=1e-9)
    for name, squares in drawn(best.lam).items():
        error = float(squares.std() / np.sqrt(DRAWS))
        assert abs(best.parts[name] - float(squares.mean())) < 5 * error, name


def test_lambda_has_the_least_error(best: ExpectedError) -> None:
    for factor in (0.9, 1.1):
        assert expected_error(*problem(), best.lam * factor).total > best.total


@pytest.mark.parametrize("equal", [False, True])
def test_gradients_agree_with_differences(best: ExpectedError, equal: bool) -> None:
    """Equal eigenvalues (a multiple of the unit matrix) have no gradient of their vectors, but one of the error."""
    grams, causes, scenes = problem()
    if equal:
        grams = (2 * np.eye(N), 3 * np.eye(N))
    found = expected_error(grams, causes, scenes, best.lam, slopes=True)
    step = RANDOM.standard_normal((N, N))
    step, small = step + step.T, 1e-5

    def total(by_gram: tuple[float, float] = (0, 0), changed: list[Cause] = causes) -> float:
        moved = grams[0] + by_gram[0] * step, grams[1] + by_gram[1] * step
        return expected_error(moved, changed, scenes, best.lam).total

    def slope(ahead: float, behind: float) -> float:
        return (ahead - behind) / (2 * small)

    for side, by in enumerate([(1, 0), (0, 1)]):
        there = [total((sign * small * by[0], sign * small * by[1])) for sign in (1, -1)]
        assert slope(*there) == pytest.approx(float(np.sum(found.of_gram[side] * step)), rel=1e-6), side
    for number, cause in enumerate(causes):
        for side in (0, 1):
            there = []
            for sign in (1, -1):
                pair = list(cause.matrices)
                pair[side] = pair[side] + sign * small * step
                other = Cause(cause.name, cause.powers, (pair[0], pair[1]), cause.weight)
                there.append(total(changed=[*causes[:number], other, *causes[number + 1 :]]))
            expected = float(np.sum(found.of_matrices[number][side] * step))
            assert slope(*there) == pytest.approx(expected, rel=1e-6, abs=1e-9), (cause.name, side)


def test_weights_have_their_sums(best: ExpectedError) -> None:
    weights = [*(cause.weight for cause in problem()[1]), 1.0]
    assert np.dot(weights, best.per_weight) == pytest.approx(best.total, rel=1e-12)

"""The joint solve of a mosaic: an exact adjoint, normal equations of the same model, and the dense solution."""

import numpy as np
import pytest
from scipy.sparse.linalg import LinearOperator

from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import parse_patterns
from mitsim.reconstruct.colour import PLANES, JointMosaic

N, PIXELS, LINES = 6, 10, 3


def model(patterns: str = "dots:3", equal: bool = False) -> JointMosaic:
    rng, family = np.random.default_rng(4), parse_patterns(patterns, N)
    lefts, rights = rng.random((LINES, PIXELS, N)), rng.random((LINES, PIXELS, N))
    if equal:  # one factor for all lines, the same for odd and even rows
        lefts, rights = (np.repeat(np.repeat(side[:1, ::2], 2, axis=1), LINES, axis=0) for side in (lefts, rights))
    weights = rng.random((len(PLANES), LINES))
    return JointMosaic(lefts, rights, weights, family.left.astype(float), family.right.astype(float))


def operator_of(mosaic: JointMosaic) -> LinearOperator:
    """The model with its adjoint: images (lines, n, n') to frames (K, K', m, m'), both in one column."""
    size = mosaic.P_L.shape[1], mosaic.P_R.shape[1], mosaic.lefts.shape[1], mosaic.rights.shape[1]
    shots = list(np.ndindex(size[:2]))

    def forward(images: np.ndarray) -> np.ndarray:
        return np.stack([mosaic.frame(images.reshape(mosaic.shape), *shot) for shot in shots]).ravel()

    def adjoint(frames: np.ndarray) -> np.ndarray:
        return sum(mosaic.gather(frames.reshape(size)[shot], *shot) for shot in shots).ravel()

    count = int(np.prod(size)), int(np.prod(mosaic.shape))
    return LinearOperator(count, matvec=forward, rmatvec=adjoint, dtype=np.dtype(np.float64))


@pytest.mark.parametrize("patterns", ["uniform", "dots:3", "hadamard:2"])
def test_the_adjoint_is_exact(patterns: str) -> None:
    mosaic, rng = model(patterns), np.random.default_rng(1)
    operator = operator_of(mosaic)
    image, frames = rng.standard_normal(operator.shape[1]), rng.standard_normal(operator.shape[0])
    assert np.vdot(operator @ image, frames) == pytest.approx(np.vdot(image, operator.H @ frames), rel=1e-12)
    through = (operator.H @ (operator @ image)).reshape(mosaic.shape)
    assert np.allclose(mosaic.normal(image.reshape(mosaic.shape)), through, rtol=1e-12)


def test_a_pixel_sees_its_own_filter_alone() -> None:
    """By hand: light of one line at the pixels of one plane, row by row. (Planted: a plane that begins elsewhere.)"""
    mosaic, images = model("uniform"), np.zeros((LINES, N, N))
    images[1] = np.arange(N * N).reshape(N, N)
    frame = mosaic.frame(images, 0, 0)
    whole = mosaic.lefts[1] @ images[1] @ mosaic.rights[1].T
    for plane, (a, b) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        assert np.allclose(frame[a::2, b::2], mosaic.weights[plane, 1] * whole[a::2, b::2])


@pytest.mark.parametrize("patterns", ["dots:3", "hadamard:2"])
def test_it_is_the_dense_solution(patterns: str) -> None:
    mosaic, rng, lam = model(patterns), np.random.default_rng(2), 1e-2
    operator = operator_of(mosaic)
    dense = operator @ np.eye(operator.shape[1])
    frames = dense @ rng.random(operator.shape[1]) + 0.1 * rng.standard_normal(operator.shape[0])
    expected = np.linalg.solve(dense.T @ dense + lam * np.eye(operator.shape[1]), dense.T @ frames)
    found = mosaic.solve((operator.H @ frames).reshape(mosaic.shape), lam)
    # The stopping residual over the least eigenvalue, lambda at worst.
    limit = 1e-7 * np.linalg.norm(dense.T @ frames) / lam
    assert found.ok and np.linalg.norm(found.image.ravel() - expected) < limit


def test_equal_factors_are_solved_in_one_step() -> None:
    mosaic, rng = model(equal=True), np.random.default_rng(3)
    assert mosaic.solve(rng.standard_normal(mosaic.shape), 1e-3).iterations == 1


def test_lambda_is_relative_to_the_largest_eigenvalue() -> None:
    """Where the preconditioner is the model itself. (Planted: the least eigenvalue of its rows.)"""
    mosaic = model(equal=True)
    dense = operator_of(mosaic) @ np.eye(int(np.prod(mosaic.shape)))
    assert mosaic.scale == pytest.approx(np.linalg.norm(dense, 2) ** 2, rel=1e-9)


def test_what_does_not_fit_is_refused() -> None:
    good = model()
    parts = {name: getattr(good, name) for name in ("lefts", "rights", "weights", "P_L", "P_R")}
    for name, wrong, words in (
        ("weights", good.weights[:3], r"weights are \(3, 3\); give one for each of 4 planes and 3 lines"),
        ("rights", good.rights[:, 1:], r"right factors are \(3, 9, 6\).*an even number"),
        ("lefts", good.lefts[:, :, 1:], "a column for each scene pixel"),
    ):
        with pytest.raises(MitsimError, match=words):
            JointMosaic(**{**parts, name: wrong})
    with pytest.raises(MitsimError, match=r"lambda is 0\.0; give a finite number above 0"):
        good.solve(np.zeros(good.shape), 0.0)

"""Colours of reflectances at lines: white stays white, the matrix is the best there is, truth is the spectra's own."""

import numpy as np
import pytest
from scipy.sparse.linalg import LinearOperator

from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import parse_patterns
from mitsim.reconstruct.colour import PLANES, ColourModel, JointMosaic, chart, delta_e, linear_srgb, white_xyz

LINES = (638.0, 520.0, 445.0)


@pytest.mark.parametrize("lines", [(562.0,), LINES, (430.0, 480.0, 530.0, 590.0, 650.0)])
def test_a_white_board_is_white(lines: tuple[float, ...]) -> None:
    model = ColourModel.of_lines(lines)
    assert np.allclose(model.xyz(np.ones(len(lines))), white_xyz(), rtol=1e-12)
    # sRGB's own matrix is given to four digits.
    assert np.allclose(linear_srgb(model.xyz(np.full(len(lines), 0.5))), 0.5, atol=2e-4)


def test_the_matrix_is_the_least_squares_one_that_keeps_white() -> None:
    """Against the solution of the optimum's own conditions, with a multiplier for white (Karush, Kuhn and Tucker)."""
    patches, ones = chart().at(LINES), np.ones((1, 3))
    conditions = np.block([[patches.T @ patches, ones.T], [ones, np.zeros((1, 1))]])
    right = np.concatenate([patches.T @ chart().xyz, white_xyz()[None]])
    expected = np.linalg.solve(conditions, right)[:3].T
    assert np.allclose(ColourModel.of_lines(LINES).matrix, expected, rtol=1e-9)


def test_colours_that_a_matrix_can_tell_are_told_exactly() -> None:
    """Patches that are a picture of their own colours: the fitted matrix undoes the mixing."""
    mixing = np.array([[0.6, 0.3, 0.1], [0.2, 0.7, 0.1], [0.1, 0.1, 0.8]])
    model = ColourModel.fit(LINES, chart().xyz / white_xyz() @ mixing.T, "a picture")
    found = model.xyz(chart().xyz / white_xyz() @ mixing.T)
    assert np.allclose(found, chart().xyz, atol=1e-12) and delta_e(found, chart().xyz).max() < 1e-9


def test_the_truth_is_the_spectrum_in_daylight() -> None:
    """The sum over the measured wavelengths, from the published tables; off by their ends beyond the spectra."""
    import colour

    waves = chart().wavelengths_nm
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    light = np.array([colour.SDS_ILLUMINANTS["D65"][wave] for wave in waves])
    seen = np.array([observer[wave] for wave in waves]) * light[:, None]
    assert np.allclose(chart().spectra @ seen / seen.sum(axis=0) * white_xyz(), chart().xyz, atol=3e-4)


def test_the_difference_of_greys_is_that_of_their_lightness() -> None:
    """Delta E 2000 of colours without chroma is |L1 - L2| / S_L, S_L of their mean lightness (CIE 142)."""
    white, level = white_xyz(), np.array([0.18, 0.4])
    first, second = 116 * np.cbrt(level) - 16
    mean = (first + second) / 2
    scale = 1 + 0.015 * (mean - 50) ** 2 / np.sqrt(20 + (mean - 50) ** 2)
    assert delta_e(level[0] * white, level[1] * white) == pytest.approx(abs(first - second) / scale, rel=1e-6)
    assert np.isfinite(delta_e(-0.01 * white, level[0] * white)), "noise below black"
    assert linear_srgb(white) == pytest.approx(np.ones(3), abs=2e-4)


def test_lines_that_no_eye_sees_are_refused() -> None:
    with pytest.raises(MitsimError, match=r"a line has 1064 nm, and the chart's spectra are of 380 to 780 nm"):
        ColourModel.of_lines((520.0, 1064.0))
    with pytest.raises(MitsimError, match=r"patches are \(24, 2\) with 0 values"):
        ColourModel.fit(LINES, chart().at(LINES[:2]), "a picture")
    with pytest.raises(MitsimError, match="with 1 values that are not finite"):
        ColourModel.fit(LINES, np.where(np.arange(72).reshape(24, 3) == 5, np.nan, 0.5), "a picture")


def test_reflectances_are_the_charts_own_and_straight_between() -> None:
    """(Planted: twice as much.)"""
    waves, spectra = chart().wavelengths_nm, chart().spectra
    assert np.array_equal(chart().at(waves), spectra)
    np.testing.assert_allclose(chart().at((waves[1:] + waves[:-1]) / 2), (spectra[:, 1:] + spectra[:, :-1]) / 2)


# ---- Images of all lines behind a mosaic -----------------------------------------------------------------------------

# The joint solve of a mosaic: an exact adjoint, normal equations of the same model, and the dense solution.

N, PIXELS, SEEN_LINES = 6, 10, 3


def model(patterns: str = "dots:3", equal: bool = False) -> JointMosaic:
    rng, family = np.random.default_rng(4), parse_patterns(patterns, N)
    lefts, rights = rng.random((SEEN_LINES, PIXELS, N)), rng.random((SEEN_LINES, PIXELS, N))
    if equal:  # one factor for all lines, the same for odd and even rows
        lefts, rights = (np.repeat(np.repeat(side[:1, ::2], 2, axis=1), SEEN_LINES, axis=0) for side in (lefts, rights))
    weights = rng.random((len(PLANES), SEEN_LINES))
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
    mosaic, images = model("uniform"), np.zeros((SEEN_LINES, N, N))
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

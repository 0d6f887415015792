"""Digits that the solver keeps, against answers in 50 digits from the very same frames and factors.

The gate everywhere is an error of 10 eps / sqrt(lambda_rel), relative: eps ||Y|| sigma / (sigma^2 + lambda) is at most
eps ||Y|| / (2 sqrt(lambda)), and twenty units in the last place are left to SVD and products of this size. Then the
solver where the model is short, dark, close or repeated, in any unit, and centring.
"""

from __future__ import annotations

import re

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsim.core.errors import MitsimError
from mitsim.devices.camera import centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.optics.terms import centre_terms as centred_terms
from mitsim.reconstruct.solver import ROUNDING_LIMIT, Prepared, Solution, centre_frame, prepare
from mitsim.reconstruct.solvers import solve_tv
from tests.robustness import Recorder
from tests.shadow_factor import scene_factor

pytestmark = pytest.mark.robustness("Solver")
LAMBDAS = tuple(10.0**-power for power in range(2, 17, 2))


def dots(n: int, k: int) -> np.ndarray:
    """(n, k): pixel i shines in pattern i mod k."""
    return np.eye(k)[np.arange(n) % k]


def with_spectrum(singular: np.ndarray, rows: int, seed: int) -> np.ndarray:
    """(rows, n) factor with these singular values between random orthonormal bases."""
    rng = np.random.default_rng(seed)
    u, v = (np.linalg.qr(rng.normal(size=(size, len(singular))))[0] for size in (rows, len(singular)))
    return (u * singular) @ v.T


def solved(left, right, P_L, P_R, frames: Frames, relative: float, **options: str) -> Solution:
    """The solver's answer at a relative lambda, by default in its default form."""
    prepared = prepare(left, right, P_L, P_R, **options)
    sums = prepared.accumulator()
    for key, frame in frames.items():
        sums.add(frame, *key)
    return prepared.solve(sums, relative * prepared.problem(sums).scale)


class Exact:
    """Tikhonov images in 50 digits: eigenvectors of A = Phi^T Phi o P P^T of each side, and Q = sum P o Phi^T Y Phi."""

    def __init__(self, left, right, P_L, P_R, frames: Frames) -> None:
        with mpmath.workdps(50):
            factors, patterns = [_exact(left), _exact(right)], [_exact(P_L), _exact(P_R)]
            grams = [phi.T @ phi * (p @ p.T) for phi, p in zip(factors, patterns, strict=True)]
            sides = [mpmath.eigsy(mpmath.matrix(gram.tolist())) for gram in grams]
            self.values = [np.array(list(values)) for values, _ in sides]
            self.vectors = [np.array(vectors.tolist()) for _, vectors in sides]
            total = sum(
                np.outer(patterns[0][:, i], patterns[1][:, j]) * (factors[0].T @ _exact(frame) @ factors[1])
                for (i, j), frame in frames.items()
            )
            self.rotated = self.vectors[0].T @ total @ self.vectors[1]
        self.energy = sum(float(np.sum(np.square(frame))) for frame in frames.values())

    def image(self, lam: float) -> np.ndarray:
        with mpmath.workdps(50):
            filtered = self.rotated / (np.outer(*self.values) + mpmath.mpf(lam))
            return (self.vectors[0] @ filtered @ self.vectors[1].T).astype(np.float64)

    def error(self, solution: Solution) -> float:
        """||error|| / ||image||, or over ||Y|| / sigma_max, the least norm of an image with these frames."""
        image = self.image(solution.lam)
        scale = float(max(self.values[0]) * max(self.values[1]))
        least = np.sqrt(self.energy / scale) if solution.lam else 0.0
        return float(np.linalg.norm(solution.image - image) / max(np.linalg.norm(image), least))


def _exact(values: np.ndarray) -> np.ndarray:
    """The same numbers as an object array of mpmath's."""
    flat = [mpmath.mpf(float(value)) for value in np.ravel(values)]
    return np.array(flat, dtype=object).reshape(np.shape(values))


def gate(relative: float) -> float:
    return 10 * EPS / np.sqrt(relative)


# ---- how many digits -------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None, derandomize=True)
@given(data=st.data())
def test_the_default_stays_below_the_gate(measured: Recorder, data) -> None:
    """Any spectrum, size, kind of pattern, lambda_rel from 1e-2 to 1e-16, units from 1e-12 to 1e12.

    The solver's own bound must hold as well, and is never looser than 55 eps / sqrt(lambda_rel), or 110 eps.
    """
    n, n2 = data.draw(st.integers(2, 6)), data.draw(st.integers(2, 6))
    power = data.draw(st.floats(0, 9))
    seed = data.draw(st.integers(0, 999))
    relative = 10.0 ** -data.draw(st.floats(2, 16))
    units = [10.0 ** data.draw(st.integers(-12, 12)) for _ in range(2)]
    rng = np.random.default_rng(seed)
    left = units[0] * with_spectrum(10 ** -(power * rng.random(n)), n + 3, seed)
    right = units[1] * with_spectrum(10 ** -(power * rng.random(n2)), n2 + 2, seed + 1)
    family = data.draw(st.sampled_from(["uniform", "dots", "signs", "grey"]))
    P_L, P_R = (
        {
            "uniform": np.ones((size, 1)),
            "dots": dots(size, 2),
            "signs": rng.choice([-1.0, 1.0], size=(size, 2)),
            "grey": rng.random((size, 2)),
        }[family]
        for size in (n, n2)
    )
    frames = frames_of(left, right, P_L, P_R, rng.random((n, n2)))
    solution = solved(left, right, P_L, P_R, frames, relative)
    error = Exact(left, right, P_L, P_R, frames).error(solution)
    measured(error / gate(relative), at_most=1, what="of the gate")
    assert error < solution.rounding <= max(5.5 * gate(relative), 110 * EPS) * (1 + 1e-9)
    assert solution.ok and np.isfinite(solution.image).all()


@pytest.mark.parametrize("low", [*(pytest.param(low, marks=pytest.mark.slow) for low in (1.0, 1e-2)), 1e-4])
def test_close_singular_values_keep_to_the_stated_rounding(measured: Recorder, low: float) -> None:
    """LAPACK ends the SVD of singular values at 1 and ``low``, equal to 1e-12 .. 1e-16, 49 eps from the matrix.

    40 models of 2 to 7 pixels a side under uniform light, each at three lambdas. (Seen failing: ten units of eps.)
    """
    worst = 0.0
    for seed in range(40):
        rng = np.random.default_rng([int(-np.log10(low)), seed])
        sizes = rng.integers(2, 8, 2)
        spectra = [
            np.where(rng.random(size) < 0.5, 1, low) * (1 + 10 ** -rng.uniform(12, 16) * rng.normal(size=size))
            for size in sizes
        ]
        left, right = (with_spectrum(spectrum, len(spectrum) + 3, seed + 50 * i) for i, spectrum in enumerate(spectra))
        P_L, P_R = (np.ones((size, 1)) for size in sizes)
        frames = frames_of(left, right, P_L, P_R, rng.random(sizes))
        exact = Exact(left, right, P_L, P_R, frames)
        for relative in (1e-2, 1e-5, 1e-8):
            solution = solved(left, right, P_L, P_R, frames, relative)
            worst = max(worst, exact.error(solution) / solution.rounding)
    measured(worst, at_most=1, what="of the stated rounding")


def test_noise_is_magnified_more_than_rounding(measured: Recorder) -> None:
    """Frames that no image explains: rounding turns the basis by eps / sqrt(lambda_rel), and misfit into image.

    Perturbation theory of least squares (Golub and Van Loan, 4th ed., 5.3.8) adds residual / sqrt(lambda_rel) to the
    gate's factor; the noise itself leaves far more in the image.
    """
    one, image = np.ones((8, 1)), np.random.default_rng(3).random((8, 8))
    left, right = (with_spectrum(np.geomspace(1, 1e-6, 8), 16, seed) for seed in (1, 2))
    clean = frames_of(left, right, one, one, image)
    noisy = {(0, 0): clean[0, 0] + 1e-3 * np.random.default_rng(0).normal(size=(16, 16))}
    exact, without = Exact(left, right, one, one, noisy), Exact(left, right, one, one, clean)
    for relative in LAMBDAS:
        solution = solved(left, right, one, one, noisy, relative)
        error = exact.error(solution)
        limit = gate(relative) * (1 + solution.residual / np.sqrt(relative))
        measured(error / limit, at_most=1, what="of the gate")
        answer = exact.image(solution.lam)
        moved = np.linalg.norm(answer - without.image(solution.lam)) / np.linalg.norm(answer)
        measured(error / moved, at_most=1e-6, what="of what noise moves")


# ---- frames and columns that are hard --------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None, derandomize=True)
@given(data=st.data())
def test_repeated_dark_and_nearly_parallel_columns(measured: Recorder, data) -> None:
    """Zero columns, unlit scene pixels, copies, and copies at an angle of 1e-1 to 1e-17: the gate holds.

    At lambda = 0 the answer is either within the stated rounding, or flagged.
    """
    n, seed = data.draw(st.integers(3, 6)), data.draw(st.integers(0, 999))
    rng = np.random.default_rng(seed)
    left, right = rng.random((n + 4, n)), rng.random((n + 3, n))
    lit = np.ones((n, 1))
    case = data.draw(st.sampled_from(["zero", "unlit", "copy", "angle"]))
    if case == "zero":
        left[:, 1] = 0
    elif case == "unlit":
        lit[1] = 0
    elif case == "copy":
        left[:, 1] = left[:, 0]
    else:
        left[:, 1] = left[:, 0] + 10.0 ** -data.draw(st.floats(1, 17)) * rng.normal(size=n + 4)
    frames = frames_of(left, right, lit, lit[:, [0, 0]], rng.random((n, n)))
    exact = Exact(left, right, lit, lit[:, [0, 0]], frames)
    relative = 10.0 ** -data.draw(st.floats(2, 16))
    solution = solved(left, right, lit, lit[:, [0, 0]], frames, relative)
    measured(exact.error(solution) / gate(relative), at_most=1, what="of the gate")
    bare = solved(left, right, lit, lit[:, [0, 0]], frames, 0.0)
    assert np.isfinite(bare.image).all()
    if case == "angle":
        assert not bare.ok or exact.error(bare) < bare.rounding <= 0.01
    else:
        lost = n * n - (n - 1) * (n - 1 if case == "unlit" else n)
        assert not bare.ok and all(f"Rank {n * n - lost} of" in str(each.status) for each in (bare, solution))
        assert f"{lost} of {n * n} directions" in str(bare.status) and f"{lost} of {n * n} directions" in str(
            solution.status
        )


EPS = float(np.finfo(np.float64).eps)
NUMBER = r"(inf|\d\.\de[+-]\d\d)"
ENDING = re.compile(
    r"Rank (\d+) of (\d+) \(rows (\d+) of (\d+), columns (\d+) of (\d+)\), "
    rf"condition {NUMBER} \(rows {NUMBER}, columns {NUMBER}\)"
)
Frames = dict[tuple[int, int], np.ndarray]


def shadow(distance_mm: float = 2.0, pixels: int = 512, n: int = 128) -> np.ndarray:
    """(pixels, n) geometric shadow of the anchor geometry; fewer pixels are larger, on the same sensor and scene."""
    profile = mls_mask().terms[0][1]
    sensor, scene = centred_edges(pixels, 512 * 0.01172 / pixels), centred_edges(n, 120 / n)
    return scene_factor(profile, 0.06, sensor, scene, distance_mm, 400.0)


def spread(condition: float, n: int = 8, rows: int = 16, seed: int = 0) -> np.ndarray:
    """(rows, n) factor of this condition number, singular values a geometric series from 1 down."""
    rng = np.random.default_rng(seed)
    u, v = (np.linalg.qr(rng.normal(size=(size, n)))[0] for size in (rows, n))
    return (u * np.geomspace(1, 1 / condition, n)) @ v.T


def frames_of(left: np.ndarray, right: np.ndarray, P_L: np.ndarray, P_R: np.ndarray, image: np.ndarray) -> Frames:
    return {(i, j): left @ (np.outer(p, q) * image) @ right.T for i, p in enumerate(P_L.T) for j, q in enumerate(P_R.T)}


def summed(prepared: Prepared, frames: Frames):
    sums = prepared.accumulator()
    for key, frame in frames.items():
        sums.add(frame, *key)
    return sums


def check_ending(status: str, prepared: Prepared) -> None:
    """Rank and condition of the whole and of both sides stand in the status, and are those of the model.

    (Planted: the condition of one side in the place of the whole's.)
    """
    found = ENDING.search(status)
    assert found and status.endswith("."), status
    left, right = prepared.left, prepared.right
    ranks = prepared.rank, prepared.unknowns, left.rank, left.scene_size, right.rank, right.scene_size
    assert tuple(map(int, found.groups()[:6])) == ranks
    conditions = tuple(map(float, found.groups()[6:]))
    # Two digits are written.
    assert conditions[1:] == pytest.approx((left.condition, right.condition), rel=0.06)
    assert conditions[0] == pytest.approx(left.condition * right.condition, rel=0.06)


@pytest.mark.parametrize("distance", [2.0, 1.0, 0.5, 0.2, 0.1, 0.05, 0.02])
def test_full_size_masks_from_2_mm_to_20_um(measured: Recorder, distance: float) -> None:
    """512 pixels, 128 x 128 scene, one frame, every lambda: finite; rank, condition and rounding told.

    The error is held against the filtered truth V k V^T X V k V^T in the solver's own basis, so it measures what the
    data went through: frames, projections and division. (The basis itself is judged in test_solver_digits.py.)
    """
    phi, one, image = shadow(distance), np.ones((128, 1)), np.random.default_rng(1).random((128, 128))
    prepared = prepare(phi, phi, one, one)
    sums = summed(prepared, frames_of(phi, phi, one, one, image))
    problem = prepared.problem(sums)
    for relative in (*LAMBDAS, 0.0):
        lam = relative * problem.scale
        solution = prepared.solve(sums, lam)
        check_ending(str(solution.status), prepared)
        assert np.isfinite(solution.image).all()
        expected = prepared.image(problem.kept_share(lam) * prepared.coefficients(image))
        error = np.linalg.norm(solution.image - expected) / np.linalg.norm(image)
        measured(error / solution.rounding, at_most=1, what="of the stated bound")
        assert f"rounding below {solution.rounding:.0e}." in str(solution.status)
        if relative:
            assert solution.ok and solution.rounding < 56 * EPS / np.sqrt(relative)
        elif prepared.rank < prepared.unknowns:
            assert not solution.ok and str(solution.status).startswith("Rank deficient")
        else:
            assert solution.ok == (solution.rounding <= ROUNDING_LIMIT)
    assert (prepared.rank == 128**2) == (distance > 0.1)


@pytest.mark.parametrize(("pixels", "k"), [(512, 1), (256, 1), (128, 1), (64, 1), (32, 1), (512, 7), (64, 7), (32, 7)])
def test_binned_sensors(measured: Recorder, pixels: int, k: int) -> None:
    """512 to 32 pixels for 128 scene pixels: what is not measured is named, what is measured is right.

    The answer at lambda = 0 is the truth's part in the measured subspace. With one frame that is all there is below 128
    pixels; 49 dots are enough for 32.
    """
    phi, P, image = shadow(2.0, pixels), dots(128, k), np.random.default_rng(1).random((128, 128))
    prepared = prepare(phi, phi, P, P)
    sums = summed(prepared, frames_of(phi, phi, P, P, image))
    solution = prepared.solve(sums, 0.0)
    check_ending(str(solution.status), prepared)
    visible = prepared.image((prepared.problem(sums).sigma > 0) * prepared.coefficients(image))
    error = np.linalg.norm(solution.image - visible) / np.linalg.norm(image)
    measured(error, at_most=min(solution.rounding, 1e-4))
    short = pixels * k < 128
    assert solution.ok == (not short and solution.rounding <= ROUNDING_LIMIT)
    assert str(solution.status).startswith("Under-determined") == short
    assert prepared.rank == min(pixels * k, 128) ** 2
    if not short:
        assert np.linalg.norm(visible - image) < 1e-4 * np.linalg.norm(image)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(dark=st.sets(st.integers(0, 8), max_size=8), seed=st.integers(0, 99), k=st.integers(1, 4))
def test_unlit_projector_pixels(measured: Recorder, dark: set[int], seed: int, k: int) -> None:
    """Rows of scene pixels without light come out as exact zeros, the others as if alone; the status counts them."""
    rng = np.random.default_rng(seed)
    factor, image, P = rng.random((14, 9)), rng.random((9, 9)), dots(9, k)
    lit = np.array([i not in dark for i in range(9)])
    P_L = P * lit[:, None]
    prepared = prepare(factor, factor, P_L, P)
    frames = frames_of(factor, factor, P_L, P, image)
    solution = prepared.solve(summed(prepared, frames), 0.0)
    check_ending(str(solution.status), prepared)
    assert prepared.rank == 9 * lit.sum() and solution.ok == bool(lit.all())
    assert not solution.image[~lit].any()
    # Nine random columns have a condition below 100 a side; ten eps times 1e4 and room for the worst draw.
    measured(np.abs(solution.image[lit] - image[lit]).max(), at_most=1e-9)
    if dark:
        assert f"{9 * (~lit).sum()} of 81 directions" in str(solution.status)


def test_models_that_see_nothing_are_refused() -> None:
    """Light where the factor is dark, and a factor that is constant once centred: refused, not divided by zero."""
    one = np.ones((4, 1))
    half = np.random.default_rng(0).random((6, 4))
    half[:, :2] = 0
    lit = np.array([[1.0], [1.0], [0.0], [0.0]])
    with pytest.raises(MitsimError, match="no scene pixel that the left factor sees"):
        prepare(half, np.eye(5, 4), lit, one)
    with pytest.raises(MitsimError, match="no scene pixel that the right factor sees"):
        prepare(np.eye(5, 4), half, one, lit)
    with pytest.raises(MitsimError, match="left factor once centred"):
        prepare(np.full((6, 4), 0.1), half, one, one, centre=True)
    # One column without contrast: its pixel is not measured, and no rounding stands in for it.
    flat = np.random.default_rng(1).random((6, 4))
    flat[:, 2] = 0.1
    assert prepare(flat, flat, one, one, centre=True).rank == 9


# ---- what the status says --------------------------------------------------------------------------------------------


def test_every_status_names_rank_and_condition() -> None:
    rng = np.random.default_rng(0)
    one, image = np.ones((8, 1)), rng.random((8, 8))
    twin = spread(10)
    twin[:, 1] = twin[:, 0]
    cases = {
        "Solved: every": (spread(10), 0.0, True),
        "Ill-conditioned": (spread(1e7), 0.0, False),
        "Rank deficient": (twin, 0.0, False),
        "Partly measured: ": (twin, 1e-3, True),
        "Under-determined": (spread(10, 8, 8)[:5], 1e-3, False),
    }
    for start, (factor, lam, ok) in cases.items():
        prepared = prepare(factor, factor, one, one)
        sums = summed(prepared, frames_of(factor, factor, one, one, image))
        solution = prepared.solve(sums, lam)
        assert str(solution.status).startswith(start) and solution.ok == ok
        check_ending(str(solution.status), prepared)
        tv = solve_tv(prepared, sums, 1e-6, iterations=2)
        check_ending(str(tv.status), prepared)
        assert str(tv.status).startswith("Not converged") and not tv.ok
        # A tolerance that the first step meets: TV may fill in what is not measured, but says how much that is.
        tv = solve_tv(prepared, sums, 1e-6, iterations=2, tolerance=1e9)
        check_ending(str(tv.status), prepared)
        lost = prepared.unknowns - prepared.rank
        assert tv.ok and (f"{lost} of 64 directions are not measured" in str(tv.status)) == bool(lost)


@pytest.mark.parametrize("exponent", range(13))
def test_rounding_is_bounded_or_flagged(measured: Recorder, exponent: int) -> None:
    """Full rank at lambda = 0, cond(A) of each side from 1 to 1e24: the error keeps to the bound; above 1 % is flagged.

    cond(A) = 1e14 each side is a condition of 1e14 in sigma, and two digits: flagged. The lambda that the status names
    is enough.
    """
    left, right = spread(10.0**exponent, seed=1), spread(10.0**exponent, seed=2)
    one, image = np.ones((8, 1)), np.random.default_rng(0).random((8, 8))
    prepared = prepare(left, right, one, one)
    sums = summed(prepared, frames_of(left, right, one, one, image))
    solution = prepared.solve(sums, 0.0)
    assert prepared.rank == 64 and np.isfinite(solution.image).all()
    assert solution.rounding == pytest.approx(110 * EPS * 100.0**exponent, rel=2e-2)
    measured(np.linalg.norm(solution.image - image) / np.linalg.norm(image), at_most=solution.rounding)
    assert solution.ok == (exponent <= 5)
    if not solution.ok:
        advised = float(re.search(r"lambda above (\S+),", str(solution.status))[1])
        again = prepared.solve(sums, 1.05 * advised)
        assert again.ok and again.rounding < ROUNDING_LIMIT


# ---- Units from 1e-30 to 1e30 change nothing but the scale of the image ----


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    shifts=st.tuples(*[st.integers(-20, 20)] * 5),
    family=st.sampled_from(["uniform", "dots", "grey"]),
    lam=st.sampled_from(["auto", 0.0, 1e-6]),
)
def test_units_change_nothing(shifts: tuple[int, ...], family: str, lam: float | str) -> None:
    """Factors, patterns and frames times 2^-40 to 2^40 (1e-12 to 1e12) each: the image scales, bit for bit.

    Even powers of two are exact in every step, square roots included, so no tolerance is needed. Rank, condition,
    relative lambda (also the automatic one), residual, rounding and the status do not move.
    """
    rng = np.random.default_rng(7)
    left, right, image = rng.random((12, 6)), rng.random((11, 5)), rng.random((6, 5))
    P_L, P_R = (
        {"uniform": np.ones((size, 1)), "dots": dots(size, 2), "grey": rng.random((size, 2))}[family] for size in (6, 5)
    )
    frames = frames_of(left, right, P_L, P_R, image)
    frames = {key: frame + 1e-3 * rng.normal(size=frame.shape) for key, frame in frames.items()}
    units = [4.0**shift for shift in shifts]
    found = []
    for a, b, c, d, e in (np.ones(5), units):
        prepared = prepare(a * left, b * right, c * P_L, d * P_R)
        sums = summed(prepared, {key: e * frame for key, frame in frames.items()})
        scale = prepared.problem(sums).scale
        solution = prepared.solve(sums, lam if isinstance(lam, str) else lam * scale)
        facts = prepared.rank, prepared.condition, solution.lam / scale, solution.residual, solution.rounding
        found.append((solution, (*facts, solution.ok)))
    (one, facts), (other, same) = found
    np.testing.assert_array_equal(other.image, one.image * (units[4] / np.prod(units[:4])))
    assert facts == same
    assert re.sub("lambda above \\S+", "", str(other.status)) == re.sub("lambda above \\S+", "", str(one.status))


@pytest.mark.parametrize("size", [1e-150, 1e-31, 1e31, 1e150])
def test_units_whose_squares_leave_double_precision_are_refused(size: float) -> None:
    """sigma^2 of 1e-600 is 0, of 1e600 infinite: one line says so before either can spoil an image."""
    good = {"left": np.eye(5, 4), "right": np.eye(5, 4), "P_L": np.ones((4, 1)), "P_R": np.ones((4, 1))}
    for name, words in (("left", "left factor"), ("right", "right factor"), ("P_L", "P_L"), ("P_R", "P_R")):
        with pytest.raises(MitsimError, match="allowed are 1e-30 to 1e\\+30") as caught:
            prepare(**(good | {name: size * good[name]}))
        assert words in str(caught.value) and f"{size:.1e}" in str(caught.value) and "\n" not in str(caught.value)
    sums = prepare(**good).accumulator()
    if not 1e-100 < size < 1e100:
        with pytest.raises(MitsimError, match="allowed are 0 and 1e-100 to 1e\\+100"):
            sums.add(np.full((5, 5), size), 0, 0)
    sums.add(np.zeros((5, 5)), 0, 0)
    assert not sums.sum.any(), "a dark frame is a frame"


@pytest.mark.parametrize("size", [1e-30, 1e30])
def test_the_largest_and_smallest_allowed_units(size: float) -> None:
    """All four at the limit, every lambda: nothing overflows or vanishes."""
    factor, P, image = spread(1e3), size * dots(8, 3), np.random.default_rng(0).random((8, 8))
    factor *= size / np.abs(factor).max()
    for relative in (*LAMBDAS, 0.0):
        prepared = prepare(factor, factor, P, P)
        sums = summed(prepared, frames_of(factor / size**2, factor, P, P, image))
        solution = prepared.solve(sums, relative * prepared.problem(sums).scale)
        assert np.isfinite(solution.image).all() and 0 <= solution.residual < 1
        kept = prepared.problem(sums).kept_share(solution.lam)
        expected = prepared.image(kept * prepared.coefficients(image / size**2))
        assert np.linalg.norm(solution.image - expected) <= solution.rounding * np.linalg.norm(image / size**2)


# ---- Centring ----


def test_centring_is_its_own_adjoint() -> None:
    """Of frames and of separable operators: <C Y C, Z> = <Y, C Z C>, C Y C twice is once, <A_c X, Y> = <A X, C Y C>."""
    rng = np.random.default_rng(0)
    one, other = rng.normal(size=(9, 7)), rng.normal(size=(9, 7))
    assert np.vdot(centre_frame(one), other) == pytest.approx(np.vdot(one, centre_frame(other)), abs=1e-13)
    np.testing.assert_allclose(centre_frame(centre_frame(one)), centre_frame(one), atol=1e-15)
    terms = [(rng.normal(size=(9, 4)), rng.normal(size=(7, 5))) for _ in range(3)]
    image = rng.normal(size=(4, 5))
    whole, taken = (sum(left @ image @ right.T for left, right in found) for found in (terms, centred_terms(terms)))
    assert np.vdot(taken, one) == pytest.approx(np.vdot(whole, centre_frame(one)), rel=1e-12)

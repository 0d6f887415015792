"""The solver's error against seconds: the judge against 50 digits and a closed form, the rows against what is known."""

import json
import math
from dataclasses import asdict
from itertools import product

import mpmath
import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.core.seeds import stream
from mitsim.reconstruct.solver import prepare
from tests.exact_solver import (
    LAMBDAS,
    PRECISIONS,
    Judge,
    Problem,
    SolverRow,
    dots,
    make_problem,
    paper_factor,
    time_solver,
)

SEED, K = 5, 2


def small_problem(condition: float = 100.0, k: int = K, seed: int = SEED) -> Problem:
    """n = 10, m = 24, singular values of Phi from 1 down to 1 / condition."""
    rng = stream(seed, "factor")
    u, v = (np.linalg.qr(rng.normal(size=(rows, 10)))[0] for rows in (24, 10))
    return make_problem((u * np.geomspace(1, 1 / condition, 10)) @ v.T, k, seed)


@pytest.fixture(scope="module")
def rows() -> tuple[SolverRow, ...]:
    return time_solver(SEED, lambda stage, part: None, small_problem(), repeats=1)


def find(rows: tuple[SolverRow, ...], **wanted: object) -> SolverRow:
    [row] = [row for row in rows if all(getattr(row, name) == value for name, value in wanted.items())]
    return row


def in_50_digits(problem: Problem, lam: float) -> np.ndarray:
    """The Tikhonov image of exact frames: per pair of blocks, by the eigenvectors of Phi_r^T Phi_r."""
    image = np.empty_like(problem.image)
    with mpmath.workdps(50):
        sides = [mpmath.matrix(problem.factor[:, i :: problem.k].tolist()) for i in range(problem.k)]
        eigen = [mpmath.eigsy(side.T * side) for side in sides]
        for i, j in product(range(problem.k), repeat=2):
            here = (slice(i, None, problem.k), slice(j, None, problem.k))
            (left_values, left), (right_values, right) = eigen[i], eigen[j]
            rotated = left.T * mpmath.matrix(problem.image[here].tolist()) * right
            for a, b in product(range(rotated.rows), range(rotated.cols)):
                power = left_values[a] * right_values[b]
                rotated[a, b] *= power / (power + mpmath.mpf(lam))
            image[here] = np.array((left * rotated * right.T).tolist(), dtype=np.float64)
    return image


@pytest.mark.parametrize("lam", [1e-1, 1e-4, 1e-12])
def test_the_judge_is_right_to_the_last_bit(lam: float) -> None:
    problem = small_problem(1e4)
    image, error = Judge(problem).image(lam)
    assert error < 1e-17
    assert np.abs(image - in_50_digits(problem, lam)).max() <= 2.0**-52


def test_the_judge_of_a_diagonal_model_is_a_filter() -> None:
    sigma = np.array([1.0, 0.5, 0.125, 2.0])
    problem = make_problem(np.diag(sigma), 2, SEED)
    power = np.square(np.outer(sigma, sigma))
    assert Judge(problem).image(0.25)[0] == pytest.approx(problem.image * power / (power + 0.25), rel=1e-15)


def test_the_judge_refuses_what_double_precision_cannot_correct() -> None:
    with pytest.raises(MitsimError, match="raise lambda"):
        Judge(small_problem(1e12, k=1)).image(1e-30)


def test_frames_are_those_of_the_model() -> None:
    problem = small_problem()
    for i, j in product(range(K), repeat=2):
        pattern = np.outer(dots(10, K)[:, i], dots(10, K)[:, j])
        expected = problem.factor @ (pattern * problem.image) @ problem.factor.T
        assert problem.frames[i * K + j] == pytest.approx(expected, rel=1e-12, abs=1e-15)


def test_relative_lambda_is_the_solver_s() -> None:
    problem = small_problem()
    prepared = prepare(problem.factor, problem.factor, problem.patterns, problem.patterns)
    frames = prepared.accumulator()
    for index, frame in enumerate(problem.frames):
        frames.add(frame, *divmod(index, K))
    assert problem.largest_power == pytest.approx(prepared.problem(frames).scale, rel=1e-12)


def test_every_form_has_a_row_for_every_lambda(rows: tuple[SolverRow, ...]) -> None:
    forms = {(row.precision, row.lambda_rel) for row in rows}
    assert forms == set(product(PRECISIONS, LAMBDAS)) and len(rows) == len(forms)
    for row in rows:
        assert 0 < row.seconds < 10 and 0 < row.error < 1 and row.judge_error < 1e-3 * row.error and row.seed == SEED
    assert json.loads(json.dumps([asdict(row) for row in rows]))[0]["precision"] == rows[0].precision


def test_precision_lost_is_what_rounding_predicts(rows: tuple[SolverRow, ...]) -> None:
    """Errors grow by at most 1 / sigma_min of the model, 1e4 here."""
    eps, single = (float(np.finfo(kind).eps) for kind in (np.float64, np.float32))
    error = {precision: find(rows, precision=precision, lambda_rel=LAMBDAS[-1]).error for precision in PRECISIONS}
    assert error["float64"] < 1e4 * eps and error["float64"] < 1e-3 * error["float32 frames"]
    assert 0.01 * single < error["float32 frames"] < 1e4 * single
    assert error["float32 products"] > error["float32 frames"]


def test_errors_do_not_depend_on_the_run(rows: tuple[SolverRow, ...]) -> None:
    seen: list[float] = []
    again = time_solver(SEED, lambda stage, part: seen.append(part), small_problem(), repeats=2)
    assert [row.error for row in again] == [row.error for row in rows]
    assert seen == sorted(seen) and seen[-1] == pytest.approx(1.0)


def test_the_paper_s_geometry_is_the_anchor_s() -> None:
    """Largest cond(A) of 49 dots at the anchor geometry: 539 (docs/decisions.md)."""
    factor = paper_factor()
    values = [np.linalg.svd(factor[:, i::7], compute_uv=False) for i in range(7)]
    largest, smallest = max(v[0] for v in values), min(v[-1] for v in values)
    assert factor.shape == (512, 128)
    assert math.isclose((largest / smallest) ** 2, 539, rel_tol=2e-3)

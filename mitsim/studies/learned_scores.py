"""A network, or a classical method, and a case of the bench in; its image and a row of scores out.

torch, an extra, is imported when an image is scored.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import gaussian_filter

from mitsim.core.arrays import FloatArray
from mitsim.metrics import psnr, ssim
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.misfit import UNEXPLAINED
from mitsim.reconstruct.request import MARKOV, NONNEGATIVE, TIKHONOV, TV
from mitsim.reconstruct.solution import Solution
from mitsim.reconstruct.solver import Accumulator, Prepared
from mitsim.reconstruct.solvers import solve_nonnegative, solve_tv
from mitsim.report.lit_scene import LAMBDAS
from mitsim.report.pages import Value
from mitsim.studies.camera_studies import modulation
from mitsim.studies.framework.experiment import PRINT_MM
from mitsim.studies.framework.studio import flags_of
from mitsim.studies.learned_bench import SHEET_MM, SIDE, Case

if TYPE_CHECKING:
    from mitsim.learn.learned_solver import LearnedSolver

AUTOMATIC, BEST = WEIGHTS = ("automatic", "best")
"""Weight of a classical method: chosen by the frames, or that of the highest PSNR, which takes the truth to choose."""
CLASSICAL = (TIKHONOV, MARKOV, TV, NONNEGATIVE)
_AROUND = tuple(float(weight) for weight in np.logspace(-0.75, 2.0, 12))
"""Weights of what is solved by iterations, over the automatic one: a quarter of a decade apart, and up to where the
best lies under a mismatch."""
_DETAIL_PIXELS = 1.5
"""Deviation of the blur that an image is less than its detail: what is left is above an eighth of a cycle a pixel."""
_MARGIN = 4
"""Pixels beside the border of a half with bars that are not looked at: the window's edge, and the other half."""


def scores(image: FloatArray, case: Case, picture: str) -> dict[str, Value]:
    """How good an image is.

    Parameters
    ----------
    image
        (n, n).
    case
        with the truth.
    picture
        name of the print: of bars the contrast is measured, of others PSNR, SSIM and detail.

    Returns
    -------
    dict
        of bars ``contrast`` and ``true_contrast`` at ``cycles`` a pixel, and ``bars_db``, their PSNR; of others
        ``psnr_db``, ``ssim``, ``detail``, the correlation of the image's detail with the truth's, and
        ``detail_energy``, its rms over that of the truth's.
    """
    kind, _, frequency = picture.partition(" ")
    if kind == "bars":
        cycles = float(frequency) * PRINT_MM / SIDE * _WINDOW_PART
        contrasts = {"contrast": contrast(image, cycles), "true_contrast": contrast(case.truth, cycles)}
        return {"cycles": cycles, "bars_db": psnr(image, case.truth), **contrasts}
    own, true = (each - gaussian_filter(each, _DETAIL_PIXELS) for each in (image, case.truth))
    return {
        "psnr_db": psnr(image, case.truth),
        "ssim": ssim(image, case.truth),
        "detail": float(np.corrcoef(own.ravel(), true.ravel())[0, 1]),
        "detail_energy": float(own.std() / true.std()),
    }


_WINDOW_PART = 60.0 / SHEET_MM
"""Part of the sheet's width that the window has."""


def contrast(image: FloatArray, cycles: float) -> float:
    """Contrast of bars of so many ``cycles`` a pixel in an ``image`` (n, n): upright in its left half, lying in its
    right one; the mean of both."""
    left, right = np.split(image, 2, axis=1)
    inside = slice(_MARGIN, -_MARGIN)
    halves = (left[inside, inside], 0), (right[inside, inside], 1)
    return float(np.mean([modulation(half, axis, cycles) for half, axis in halves]))


def classical_rows(case: Case, picture: str) -> Iterator[tuple[dict[str, Value], FloatArray]]:
    """Scores and images of all classical methods at their automatic and best weight; ``case`` and ``picture`` are what
    is imaged, and its print."""
    from mitsim.learn.learned_solver import beyond_noise

    prepared = case.prepare()
    sums = case.sums(prepared)
    problem = prepared.problem(sums)
    for method in CLASSICAL:
        started = time.process_time()
        solve = _solver(method, prepared, sums)
        own = solve("auto")
        seconds = time.process_time() - started
        others = _AROUND if method in (TV, NONNEGATIVE) else [each * problem.scale / own.lam for each in LAMBDAS]
        best = max(own, *(solve(own.lam * factor) for factor in others), key=lambda each: psnr(each.image, case.truth))
        for weight, each in zip(WEIGHTS, (own, best), strict=True):
            _, beyond = beyond_noise(prepared, problem, each.image)
            row: dict[str, Value] = {"training": "none", "method": method, "weight": weight}
            row |= {"beyond": beyond, "seconds": seconds, "unexplained": case.unexplained}
            yield {**row, **_flags(each, case), **scores(each.image, case, picture)}, each.image


def _flags(found: Solution, case: Case) -> dict[str, Value]:
    """Return the columns that flag an image ``found`` of a ``case`` by its solution and its frames."""
    return flags_of(found.status, others=("frames fit no image",) * (case.unexplained > UNEXPLAINED))


def _solver(method: str, prepared: Prepared, sums: Accumulator) -> Callable[[Any], Solution]:
    """Return the function that solves with a weight, or with the automatic one of the ``method``."""
    if method == MARKOV:
        prepared, sums = _with_correlation(prepared, sums)

    if method in (TV, NONNEGATIVE):
        return partial(solve_tv if method == TV else solve_nonnegative, prepared, sums)
    return partial(prepared.solve, sums)


def _with_correlation(prepared: Prepared, sums: Accumulator) -> tuple[Prepared, Accumulator]:
    """The model for images whose neighbouring pixels are alike, and its sums: both have one range, so these are the
    others, turned."""
    other = prepared.with_correlation()
    turns = []
    for before, after in ((prepared.left, other.left), (prepared.right, other.right)):
        turn = np.zeros((len(before.singular), len(after.singular)))
        for index, (one, two) in enumerate(zip(before.slabs, after.slabs, strict=True)):
            turn[before.columns(index)] += one.matrix.T @ two.matrix
        turns.append(turn)
    return other, Accumulator.of_sums(other, turns[0].T @ sums.quarters @ turns[1], sums.energy)


def network_row(
    model: LearnedSolver, factors: Factors, case: Case, picture: str
) -> tuple[dict[str, Value], FloatArray]:
    """Scores and image of a network, and what it is flagged for: frames that the image does not give, frames that no
    image gives, another camera or calibration, noise that the network does not know.

    Parameters
    ----------
    model, factors
        the network, and the calibration that the image is made with.
    case, picture
        what is imaged, and its print.
    """
    from mitsim.learn.learned_solver import beyond_noise

    prepared: Any = model.init(factors, case.patterns)
    sums, started = case.sums(prepared), time.process_time()
    solution = model.compute(prepared, sums, "auto")
    seconds = time.process_time() - started
    _, beyond = beyond_noise(prepared, prepared.problem(sums), solution.image)
    frames, camera = beyond > UNEXPLAINED, bool(prepared.doubts)
    noise = len(solution.status.flags) > frames + camera
    flags: dict[str, Value] = {"flag_image": frames, "flag_frames": case.unexplained > UNEXPLAINED}
    flags |= {"flag_camera": camera, "flag_noise": noise, **_flags(solution, case)}
    return {"beyond": beyond, "seconds": seconds, **flags, **scores(solution.image, case, picture)}, solution.image

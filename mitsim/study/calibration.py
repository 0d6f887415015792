"""A calibration session in; how far its factors are off, by entry, by singular value and by cause, and its cost, out.

Factors of noisy frames are compared with those of the expected frames of the same light, whose difference is noise
alone; how large it may be is predicted from the sensor's closed form, before any frame is drawn. What no separable
camera explains of the expected frames is told apart by forming them again with one cause left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mitsim.capture.bench import Bench
from mitsim.capture.calibrate import NOISE_FREE, NOISY, estimate, estimates
from mitsim.capture.light import Light
from mitsim.capture.request import Exposure, Request
from mitsim.capture.session import LitSession, Session
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.core.manifests import SIDES as FACTORS
from mitsim.core.parallel import single_threaded_blas
from mitsim.reconstruct.calibration import Estimate, decibels
from mitsim.rig.board import BoardShape
from mitsim.rig.order import SIDES
from mitsim.rig.recipe import SessionRecipe, load_recipe
from mitsim.study import plots
from mitsim.study.knobs import reformed, without
from mitsim.study.table import Table

_FORMED = frozenset({"diffraction", "mask-thickness", "black-level"})
"""Effects of which frames are formed again in the same light; for others light is traced again, by the same seed."""
_APART = 0.3
"""Predicted turn of its vectors [rad] up to which a singular value stands apart from others: beyond, noise mixes them,
and bias and angle to first order do not hold."""
_SHOWN_DEVIATIONS = 4.0
"""Range of the maps: one of 16 000 entries lies beyond."""


@dataclass(frozen=True)
class EntryRow:
    """Error of a factor's entries [its rms]: found, predicted from the noise, and the largest in predicted deviations;
    ``chi_square`` is the mean square of all in these."""

    factor: str
    error: float
    predicted_error: float
    largest: float
    chi_square: float


@dataclass(frozen=True)
class SingularRow:
    """A singular value of a factor and of the same with noise, its predicted standard error and bias, how far it is
    off in standard errors beyond the bias; and the angle [rad] of its two vectors, predicted and found."""

    factor: str
    number: int
    value: float
    noisy: float
    standard_error: float
    bias: float
    off: float
    predicted_angle: float
    angle: float


@dataclass(frozen=True)
class CauseRow:
    """Separability residual without one cause; ``part`` is the root of what it takes away from the squared residual,
    below 0 where the residual grows without it."""

    cause: str
    residual: float
    part: float


@dataclass(frozen=True, eq=False)
class CalibrationFindings:
    """What a session came to.

    Attributes
    ----------
    entries, singular, causes
        rows of the report.
    maps
        (m, n) error of each factor's entries in predicted deviations, by factor.
    residual
        separability residual of the expected frames, and of the noisy ones.
    session
        frames, seconds of exposure, photoelectrons and photons.
    """

    entries: tuple[EntryRow, ...]
    singular: tuple[SingularRow, ...]
    causes: tuple[CauseRow, ...]
    maps: dict[str, FloatArray]
    residual: tuple[float, float]
    session: dict[str, float]

    def payload(self) -> dict[str, Any]:
        """The JSON of the command line."""
        return {
            "separability_residual": self.residual[1],
            "noise_free_residual": self.residual[0],
            "entries": [asdict(row) for row in self.entries],
            "singular": [asdict(row) for row in self.singular],
            "causes": [asdict(row) for row in self.causes],
            "session": self.session,
        }

    def lines(self) -> list[str]:
        """For people."""
        entries = [
            f"{row.factor:>5} factor: error {row.error:.2e}, predicted {row.predicted_error:.2e}; chi-square "
            f"{row.chi_square:.3f} an entry, largest {row.largest:.1f} deviations"
            for row in self.entries
        ]
        offs = np.array([row.off for row in self.singular if row.predicted_angle < _APART])
        causes = [
            f"{row.cause:>16}: {abs(row.part):.1e} ({decibels(abs(row.part)):.1f} dB)"
            + (" less without it" if row.part > 0 else " more without it")
            if row.part
            else f"{row.cause:>16}: nothing"
            for row in self.causes
        ]
        return [
            *entries,
            f"singular values: {len(offs)} of {len(self.singular)} stand apart from others"
            + (f", rms {np.sqrt(np.mean(offs**2)):.2f} standard errors off" if len(offs) else ""),
            f"separability residual {self.residual[1]:.2e}, {self.residual[0]:.2e} without noise; by cause:",
            *causes,
            f"{self.session['frames']:.0f} frames, {self.session['exposure_seconds']:.3g} s of exposure, "
            f"{self.session['photons']:.3g} photons on the sensor",
        ]

    def figures(self) -> dict[str, Figure]:
        """Maps of the entries' errors, singular values with their errors, and the residual by cause."""
        parts = {row.cause: abs(row.part) for row in self.causes if row.part}
        found = {f"{name}.png": plots.deviations(values, _SHOWN_DEVIATIONS) for name, values in self.maps.items()}
        rows = {
            name: np.array(
                [(row.value, row.noisy - row.bias, row.standard_error) for row in self.singular if row.factor == name]
            )
            for name in self.maps
        }
        found["singular.png"] = plots.singular_errors(rows)
        return {**found, "causes.png": plots.error_bars(parts)} if parts else found

    def tables(self) -> dict[str, Table]:
        """By file name."""
        return {
            "singular.csv": Table(tuple(asdict(row) for row in self.singular)),
            "causes.csv": Table(tuple(asdict(row) for row in self.causes)),
        }


def measure(bench: Bench, request: Request, job: Job, recipe: SessionRecipe | None = None) -> CalibrationFindings:
    """Run a session and judge it.

    Parameters
    ----------
    bench, request, job
        whose camera, seed and accuracy; clock, progress and limits.
    recipe
        how the session is run; None: the shipped one.

    Raises
    ------
    MitsimError
        for a recipe with depths, or whose patterns are taken with a uniform frame: its noise is shared.
    """
    recipe = recipe or load_recipe()
    if recipe.depths or recipe.signed_capture != "pair":
        raise MitsimError(
            "study calibration: takes a session at one depth whose signed_capture is 'pair'; give such a recipe"
        )
    Exposure(None, recipe.exposure_fraction).check(bench.rig)
    session = Session(bench, recipe, request.seed)
    plan = session.plan(request.accuracy, job)
    lit = session.lit(session.trace(plan, job), job)
    (noisy, clean), _ = estimates(lit, job, (NOISY, NOISE_FREE))
    return judged(lit, noisy, clean, tuple(_by_cause(lit, noisy, clean, job)))


@single_threaded_blas()
def judged(lit: LitSession, noisy: Estimate, clean: Estimate, causes: tuple[CauseRow, ...] = ()) -> CalibrationFindings:
    """Errors of ``noisy`` factors of a session against ``clean`` ones, beside their prediction.

    Parameters
    ----------
    lit
        the session.
    noisy, clean
        estimates from noisy and from expected frames.
    causes
        of its residual.
    """
    entries, singular, maps = [], [], {}
    pairs = zip(FACTORS, SIDES, (clean.left, clean.right), (noisy.left, noisy.right), strict=True)
    for name, side, exact, found in pairs:
        # Factors are known up to a common scale and sign; this one is not drawn towards zero by the noise.
        found = found * (np.vdot(exact, exact) / np.vdot(found, exact))
        deviation = entry_deviation(lit, clean, side)
        off = (found - exact) / deviation[:, None]
        maps[name] = off
        norm = float(np.linalg.norm(exact))
        predicted = float(np.linalg.norm(deviation)) * np.sqrt(exact.shape[1]) / norm
        error = float(np.linalg.norm(found - exact)) / norm
        entries.append(EntryRow(name, error, predicted, float(np.abs(off).max()), float(np.square(off).mean())))
        singular += list(singular_rows(name, exact, found, deviation))
    return CalibrationFindings(
        tuple(entries),
        tuple(singular),
        causes,
        maps,
        (clean.separability_residual, noisy.separability_residual),
        spent(lit),
    )


def entry_deviation(lit: LitSession, clean: Estimate, side: str) -> FloatArray:
    """(m,) predicted standard deviation of the entries of each row of a factor, of all columns alike.

    u_i = Y_i v / |v|^2 has the variance sum_c V_rc v_c^2 / |v|^4 in row r, V being that of a response's pixels, and
    U H^T / N averages N of them with signs.

    Parameters
    ----------
    lit, clean
        the session, and the estimate from its expected frames.
    side
        whose stripes give the factor.
    """
    common = (clean.right if side == SIDES[0] else clean.left).sum(axis=1)
    variance = lit.response_variance(side)
    variance = variance if side == SIDES[0] else variance.T
    spread = variance @ np.square(common)
    return np.asarray(np.sqrt(spread / lit.session.signs.shape[1]) / np.dot(common, common))


def singular_rows(factor: str, exact: FloatArray, found: FloatArray, deviation: FloatArray) -> Iterator[SingularRow]:
    """Singular values and vectors of a factor with noise beside those without.

    To first order s_k moves by u_k^T E v_k, to second order by the mean s^2 ((m - n) / (2 s_k) + sum_j s_k / (s_k^2 -
    s_j^2)) of noise of the deviation s; v_k turns by sqrt(sum_j s^2 (s_k^2 + s_j^2)) / |s_k^2 - s_j^2| (Stewart and Sun
    1990, Matrix Perturbation Theory, chapter V). Both want gaps between values that are larger than their errors.

    Parameters
    ----------
    factor
        its name.
    exact, found
        (m, n) without and with noise.
    deviation
        (m,) of each row's entries.
    """
    left, values, right = np.linalg.svd(exact, full_matrices=False)
    _, noisy, turned = np.linalg.svd(found, full_matrices=False)
    errors = np.sqrt(np.square(deviation) @ np.square(left))
    variance = float(np.square(deviation).mean())
    rows, columns = exact.shape
    squares = np.square(values)
    for number, value in enumerate(values):
        others = np.delete(squares, number)
        gaps = squares[number] - others
        with np.errstate(divide="ignore", over="ignore"):
            bias = variance * ((rows - columns) / (2 * value) + float(np.sum(value / gaps)))
            angle = float(np.sqrt(variance * np.sum((squares[number] + others) / np.square(gaps))))
        cosine = min(abs(float(np.dot(right[number], turned[number]))), 1.0)
        yield SingularRow(
            factor=factor,
            number=number,
            value=float(value),
            noisy=float(noisy[number]),
            standard_error=float(errors[number]),
            bias=bias,
            off=float((noisy[number] - value - bias) / errors[number]),
            predicted_angle=min(angle, float(np.pi / 2)),
            angle=float(np.arccos(cosine)),
        )


def spent(lit: LitSession) -> dict[str, float]:
    """Frames, seconds of exposure, expected photoelectrons and photons of a session ``lit``, without its read-out."""
    recipe, pairs = lit.session.recipe, len(lit.session.order) / 2
    lit_s = sum(lit.exposures_s) * recipe.repeats
    electrons = float(lit.uniform_rate.sum()) * pairs * lit_s
    return {
        "frames": lit.session.shots,
        "exposure_seconds": 2 * pairs * lit_s + recipe.dark_frames * sum(lit.exposures_s),
        "photoelectrons": electrons,
        "photons": electrons / (lit.session.bench.sensor.quantum_efficiency or np.nan),
    }


def _by_cause(lit: LitSession, noisy: Estimate, clean: Estimate, job: Job) -> Iterator[CauseRow]:
    """Residual of a session's expected frames without each cause, and what noise adds to it."""
    residual = clean.separability_residual
    yield _row("noise", noisy.separability_residual, residual)
    simulation, session = lit.light.simulation, lit.session
    for name, settings in without(simulation.settings, simulation.settings.effects):
        if name in _FORMED:
            light = reformed(lit.light, frozenset({name}))
        else:
            light = session.trace(replace(lit.light.plan, settings=settings), job)
        yield _row(name, residual, _residual(session, light, job))
    if session.recipe.board != BoardShape():
        flat = replace(session, recipe=session.recipe.model_copy(update={"board": BoardShape()}))
        yield _row("board", residual, _residual(flat, flat.trace(lit.light.plan, job), job))


def _residual(session: Session, light: Light, job: Job) -> float:
    return estimate(session.lit(light, job), job, noise_free=True)[0].separability_residual


def _row(cause: str, residual: float, left: float) -> CauseRow:
    less = residual**2 - left**2
    return CauseRow(cause, left, float(np.copysign(np.sqrt(abs(less)), less)))

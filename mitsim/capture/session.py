"""A bench and a recipe in; what a rendered Hadamard calibration session on a white board shows, and its light, out.

The paper's procedure (section IV-A): every column h_i of a Hadamard matrix is shown as horizontal stripes h_i 1^T and
as vertical ones 1 h_i^T, each +-1 pattern as two shots (or one and a uniform one), all at one exposure, with sensor
noise. When n is no Hadamard order the next one is used and its first n rows: rows stay orthogonal.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mitsim.capture.bench import Bench
from mitsim.capture.board import missed_pixels
from mitsim.capture.drift import levels
from mitsim.capture.evidence import Settings
from mitsim.capture.exposer import camera_warnings
from mitsim.capture.light import Light, Sampling, trace_lines
from mitsim.capture.plan import Plan
from mitsim.capture.planning import make_plan
from mitsim.capture.request import Exposure
from mitsim.capture.responses import LitSession
from mitsim.capture.session_cost import session_cost, session_seconds
from mitsim.core.arrays import FloatArray
from mitsim.core.job import Job
from mitsim.optics.separable import best_term, centred
from mitsim.optics.shadow import Directions, SeparableTerms
from mitsim.optics.terms import shadow_terms
from mitsim.reconstruct.calibration import SEPARABLE_RESIDUAL, decibels
from mitsim.rig.board import BoardShape
from mitsim.rig.camera import CameraGeometry
from mitsim.rig.order import UNIFORM, Half, taken
from mitsim.rig.patterns import Lighting, PatternFamily, stripe_signs
from mitsim.rig.projector import Spectrum
from mitsim.rig.recipe import SessionRecipe

_IN_RAYS = 0.5
"""Part of what no separable camera has, rms, that rays leave where the rest, three quarters of its energy, is said to
be of diffraction."""
_LINES = 4
"""Rows, and columns, of pixels that the plan looks at: chosen so that each quarter of the window shows."""


@dataclass(frozen=True)
class Session:
    """What a calibration session shows, of a ``bench`` by a ``recipe``, at one depth.

    Attributes
    ----------
    bench, recipe
        what is calibrated, and how.
    seed
        of its noise and light.
    depth
        of the board [mm]; None: on the aligned plane.
    filters
        (pixels, pixels) part of the light that colour filters over them pass, which readings are divided by; None: all.
    """

    bench: Bench
    recipe: SessionRecipe
    seed: int = 0
    depth: float | None = None
    filters: FloatArray | None = None

    @property
    def distance(self) -> float:
        """From the sensor to the board's middle [mm]."""
        return self.depth or self.bench.geometry.scene_distance

    @cached_property
    def board(self) -> Bench:
        """The bench with the white board instead of its scene."""
        return self.bench.with_board(self.recipe.board_reflectance, self.recipe.board, self.depth)

    @property
    def centre(self) -> bool:
        """Whether row and column means are taken out of every response, as for a FlatCam mask."""
        return self.bench.geometry.centred

    @property
    def warnings(self) -> tuple[str, ...]:
        """What board, mask and sensor do that factors do not know of."""
        return (
            *self.board_warnings,
            *self.mask_warnings,
            *camera_warnings(self.bench.sensor, self.bench.geometry.frame_shape),
        )

    @cached_property
    def board_warnings(self) -> tuple[str, ...]:
        """Projector pixels that the board leaves dark."""
        shape = self.recipe.board
        missed = 0 if shape == BoardShape() else missed_pixels(self.board)
        if not missed:
            return ()
        z = self.distance
        rows, columns = (z * (last - first) for first, last in self.bench.windows_at(z))
        return (
            f"board: {missed} of {self.bench.n**2} projector pixels do not fall whole on it ({shape.words}), and "
            f"their light is missing in the factors; the window is {rows:.4g} x {columns:.4g} mm there: "
            "take a larger board, or hang it straight",
        )

    @cached_property
    def mask_warnings(self) -> tuple[str, ...]:
        """What the best separable camera leaves of this one's shadow between projector pixels and sensor, where it is
        much, and what of it waves make. Stripes, whose lines add up, show less of it."""
        geometry, spectrum = self.bench.geometry, self.bench.spectrum
        rays = residual = best_term(self.shadow(geometry)).residual
        if geometry.few_wave_terms and spectrum is not None:
            residual = best_term(self.shadow(geometry, spectrum)).residual
        if residual <= SEPARABLE_RESIDUAL:
            return ()
        cause, remedy = "", "straighten the mask, or take a separable one"
        if rays < _IN_RAYS * residual:
            cause = f" by diffraction ({rays:.1%} without)"
            remedy = "take a separable mask, or one nearer to the sensor or of larger features"
        return (
            f"the mask ({geometry.mask_words}) is not separable{cause}: the best separable one leaves {residual:.1%} "
            f"of its shadow, {-decibels(residual):.1f} dB below it, and images of these factors lack it; {remedy}",
        )

    def shadow(self, geometry: CameraGeometry, spectrum: Spectrum | None = None) -> SeparableTerms:
        """The operator of a camera's ``geometry`` from projector pixels at the board's distance to the sensor, of
        transmissions: in rays, or in waves of a ``spectrum``; centred where frames are."""
        rows, columns = (
            Directions.cells(np.linspace(*edges, self.bench.n + 1)) for edges in self.bench.windows_at(self.distance)
        )
        terms = shadow_terms(geometry, rows, columns, self.distance, spectrum)
        return centred(terms) if self.centre else terms

    @cached_property
    def signs(self) -> FloatArray:
        """(n, N) first n rows of the smallest Hadamard matrix that has them; column 0 is all +1."""
        return stripe_signs(self.bench.n).astype(np.float64)

    @property
    def lit_lines(self) -> float:
        """Part of the lines that are +1, mean over patterns: about half."""
        return float((1 + self.signs).mean()) / 2

    @property
    def pairs(self) -> bool:
        """Whether a +-1 pattern is the difference of two shots, and not taken from one and a uniform shot."""
        return self.recipe.signed_capture == "pair"

    def filtered(self, light: FloatArray) -> FloatArray:
        """What passes the filters of ``light`` (pixels, pixels)."""
        return light if self.filters is None else light * self.filters

    @property
    def shots(self) -> int:
        """Frames of the whole session."""
        lit = len(self.order) * self.recipe.repeats
        return (lit + self.recipe.dark_frames) * len(self.recipe.exposure_ladder)

    @property
    def order(self) -> list[Half]:
        """What the lit frames show, as they are taken; each with all exposures, one after the other, and of each all
        repeats. Dark frames come last."""
        return taken(self.signs.shape[1], self.pairs, self.recipe.order, self.recipe.order_seed)

    @cached_property
    def powers(self) -> Mapping[tuple[str, int], FloatArray]:
        """(exposures, repeats) power of the projector in frames of each shot, by side and number; 1 at the session's
        begin."""
        drift, order = self.recipe.drift, self.order
        each = len(order), len(self.recipe.exposure_ladder), self.recipe.repeats
        found = levels(self.seed, "session", math.prod(each), drift.session_ramp, drift.session_flicker).reshape(each)

        def shot(half: Half) -> tuple[str, int]:
            side, number, sign = half
            return side, 2 * number + (sign < 0) if self.pairs else number + (sign != UNIFORM)

        return {shot(half): power for half, power in zip(order, found, strict=True)}

    def plan(self, accuracy: float, job: Job) -> Plan:
        """What to simulate for responses of this relative ``accuracy``, and what the session takes.

        MitsimError when that is more memory or time than the ``job`` allows: before the look at the board, or after it.
        """
        n, count, starting = self.bench.n, self.signs.shape[1], job.clock.seconds()["total"]
        first = Settings(self.distance)
        seconds = session_seconds(self.board, count, self.shots, first)
        exposures = len(self.recipe.exposure_ladder)
        session_cost(self.board, count, first, sum(seconds.values()), exposures).check("calibration", job.limits)
        with job.planning("calibration"):
            plan = make_plan(self.board, _lines(n), accuracy, self.seed)
        seconds = session_seconds(self.board, count, self.shots, plan.settings)
        # There is no truth to be traced, and other frames are formed than those that the plan looks at.
        plan = plan.taking(start=starting, truth=0.0, **seconds)
        cost = session_cost(self.board, count, plan.settings, plan.predicted_seconds, exposures)
        cost.check("calibration", job.limits)
        return replace(plan, cost=cost)

    def trace(self, plan: Plan, job: Job) -> Light:
        """The board's light, by projector pixel, sampled as the ``plan`` says; ``job`` is told how far it is."""
        (light,) = self.trace_lines((self.board,), plan, job)
        return light

    def trace_lines(self, boards: Sequence[Bench], plan: Plan, job: Job) -> list[Light]:
        """The same of every line of the board's light.

        Parameters
        ----------
        boards
            this session's with each line alone; the board itself where light is not told apart.
        plan, job
            as for :meth:`trace`.
        """
        with job.clock.stage("transport"):
            sampling, lighting = Sampling(purpose="calibration"), _lines(self.bench.n)
            lights = trace_lines(self.board, boards, plan, lighting, self.seed, sampling, job.progress)
        return [light.merged() for light in lights]

    def lit(self, light: Light, job: Job) -> LitSession:
        """The session in the ``light`` that :meth:`trace` gave; ``job`` takes the time of choosing the exposure."""
        with job.clock.stage("optics"):
            white = next(iter(light.frames(Lighting.uniform(self.bench.n), self.seed)))
            exposure = Exposure(None, self.recipe.exposure_fraction)
            exposure_s = exposure.choose(self.bench.rig, float(self.filtered(white.irradiance).max()))
        stripes = PatternFamily("stripes", self.signs[:, 1:2].astype(np.int8), np.ones((self.bench.n, 1), np.int8))
        return LitSession(self, light, white, exposure_s, light.speckle(stripes))


def _lines(n: int) -> Lighting:
    """Shots of one row or one column of pixels each, evenly spread.

    The accuracy of a session is that of single lines: by the patterns' orthogonality the squared errors of all +-1
    responses add up to N times those of all lines, and so do the squared responses themselves. Frames of half the
    pixels are far brighter than the responses that are taken from their differences.
    """
    chosen = np.unique(((np.arange(_LINES) + 0.5) * n / _LINES).astype(np.int64))
    rows = np.zeros((len(chosen), n, n))
    rows[np.arange(len(chosen)), chosen] = 1
    return Lighting(np.arange(n * n), np.concatenate([rows, rows.transpose(0, 2, 1)]).reshape(-1, n * n))

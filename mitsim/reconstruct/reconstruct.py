"""Shots and factors in, the scene's image out. Never sees the scene's truth."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from mitsim.core.arguments import checked
from mitsim.core.arrays import FloatArray
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.resources import Cost, Limits
from mitsim.core.runs import Capture, Measurement
from mitsim.reconstruct.causes import Cause, Evidence
from mitsim.reconstruct.cost import BYTES_A_NUMBER, is_kept, predicted, slab_numbers
from mitsim.reconstruct.depth import Depth, best_depth
from mitsim.reconstruct.depth_map import DepthMap, depth_map
from mitsim.reconstruct.detail import Model, print_energy
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.faults import FrameCheck
from mitsim.reconstruct.focus import focused
from mitsim.reconstruct.framefault import FrameFault
from mitsim.reconstruct.margin import Margin
from mitsim.reconstruct.misfit import Lack, Misfit, faulty_frames, judge
from mitsim.reconstruct.noise import FrameNoise, factor_energy
from mitsim.reconstruct.request import MARKOV, TIKHONOV, TV, check_asked
from mitsim.reconstruct.result import Reconstruction
from mitsim.reconstruct.solver import Accumulator, Prepared, Solution, prepare
from mitsim.reconstruct.status import Verdict
from mitsim.reconstruct.tv import TVSolution, solve_tv
from mitsim.reconstruct.uncertainty import Propagation, Uncertainty, uncertainty

_LAMBDA_OF_TV = 1e-3
"""Lambda, over the largest sigma^2, by which frames are foretold beside an image of total variation, whose own weight
says nothing of it: chosen, between those of bright and of dim runs."""

_DEFECT_ROUNDS = 6
"""Times that defective pixels are looked for: beside bright ones dim ones show when these are left out, of a tenth of
their energy each time."""
_BETTER = 0.5
"""Part of what was unexplained, rms, that frames may leave without pixels that count as defective though the rest does
not fit either."""


_OF_THE_SCENE = Cause.GLOSS, Cause.INDIRECT, Cause.DETAIL, Cause.UNKNOWN, Cause.RIG
"""Causes that light of a depth beyond the searched range is taken for."""


@single_threaded_blas()
@checked
def reconstruct(
    shots: Capture,
    factors: Factors,
    lam: float | Literal["auto"] = "auto",
    method: str = TIKHONOV,
    focus: float | Literal["auto", "map"] | None = None,
    margin: int = 0,
    depth_range: tuple[float, float] | None = None,
) -> Reconstruction:
    """Recover the image from a capture and a calibration alone.

    Parameters
    ----------
    shots
        in memory, or of :func:`mitsim.core.runs.load_run`; frames on disk are read one at a time.
    factors
        of the same camera.
    lam
        lambda >= 0 in the unit of (Phi_L Phi_R)^2, for ``tv`` the weight of the total variation; ``auto`` chooses it
        from the data.
    method
        ``tikhonov`` (closed form, pixels independent), ``markov`` (closed form, neighbours alike:
        :mod:`mitsim.reconstruct.solver`) or ``tv`` (least total variation).
    focus
        depth of the scene [mm], whose factors are taken instead of the calibrated depth's; ``auto``: that which leaves
        least of the measurements unexplained; ``map``: one for each projector pixel, from shifting dots, by
        ``tikhonov``.
    margin
        cells round the projector's window that are solved for too, lit in every pattern, and left out of the image:
        they take up light from outside the window (:mod:`mitsim.reconstruct.margin`). By ``tikhonov``, without focus.
    depth_range
        nearest and farthest depth [mm] that ``auto`` and ``map`` look for; None: a quarter of 1/z either way of the
        calibrated depth.

    Raises
    ------
    MitsimError
        for a capture and factors that do not fit each other, a frame that cannot be read, more memory than is free,
        another lambda, method, focus, margin or range, or a calibration that does not state its parallax.
    """
    asked = inputs(shots, factors, lam, method, focus, margin, depth_range)
    factors.check_fit(shots)
    beside = Margin(margin) if margin else None
    if beside:
        wider = beside.factors(factors)
        shots, factors = beside.of(wider.of(shots)), wider.factors
    # Depths that are looked for, and total variation, take as long as the data ask for.
    cost = predicted(shots, factors) if method == TIKHONOV and focus not in ("auto", "map") else None
    _check_factorising(shots, factors, method)
    if cost:
        Cost(sum(cost.seconds.values()), cost.memory_bytes).check(f"{shots.name}: its image", Limits())
    started = time.perf_counter()
    depth = _depth(shots, factors, lam, focus, depth_range)
    doubts = [depth.doubt] if depth else []
    found = time.perf_counter()
    if isinstance(depth, Depth):
        of_depth = focused(factors, depth.mm)
        shots, factors = of_depth.of(shots), of_depth.factors
        if of_depth.hidden:
            hidden = f"{of_depth.hidden:.1%} of the scene's pixels, which come out dark"
            doubts.append(f"At {depth.mm:.4g} mm the field stop takes most of the light of {hidden}.")
    data = accumulated(shots, factors, method)
    prepared, frames = data.prepared, data.frames
    added = time.perf_counter()
    solution: DepthMap | Solution | TVSolution
    solution = depth if isinstance(depth, DepthMap) and not depth.doubt else data.solution(lam, method)
    solved = time.perf_counter()
    misfit = data.misfit(shots, factors, solution)
    if misfit and isinstance(solution, DepthMap):
        # At the depth of most of the scene a frame that is not what it says is off by more than depth puts it.
        of_depth = focused(factors, float(np.median(solution.mm)))
        faults = accumulated(of_depth.of(shots), of_depth.factors).faulty_frames(
            of_depth.of(shots), of_depth.factors, solution
        )
        misfit = replace(misfit, flagged=True, cause=Cause.FRAMES, faults=faults) if faults else misfit
    if misfit and misfit.defects:
        shots, data, solution, misfit = _without_defects(shots, factors, lam, method, data, misfit)
        prepared, frames = data.prepared, data.frames
    if misfit and misfit.cause in _OF_THE_SCENE and isinstance(depth, Depth) and depth.at_end:
        misfit = replace(misfit, cause=Cause.DEPTH)
    explained = factors.status.verdict is not Verdict.NOT_SEPARABLE and (misfit is None or not misfit.flagged)
    if isinstance(solution, Solution) and lam == "auto" and (factors.lacking or not explained):
        lack = data.lack(factors, solution.image)
        known = (lack.struck, lack.energy) if lack else None
        solution = prepared.solve(frames, lam, explained=explained, lack=known)
    judged = time.perf_counter()
    uncertainties = data.uncertainty(shots, factors, solution) if isinstance(solution, Solution) else None
    status = misfit.judged(solution.status) if misfit else solution.status
    image = solution.image
    if beside:
        image = beside.inside(image)
        uncertainties = uncertainties and Uncertainty(
            {name: beside.inside(values) for name, values in uncertainties.sources.items()}, uncertainties.bias_factor
        )
    doubts.append(uncertainties.loss(image) if uncertainties else "")
    flags = (*status.flags, *(doubt for doubt in doubts if doubt), *_flags(shots, factors))
    return Reconstruction(
        image=image,
        lam=solution.lam,
        rank=prepared.rank,
        condition=prepared.condition,
        rank_sides=(prepared.left.rank, prepared.right.rank),
        condition_sides=(prepared.left.condition, prepared.right.condition),
        residual=solution.residual,
        rounding=getattr(solution, "rounding", None),
        misfit=misfit,
        uncertainties=uncertainties,
        status=replace(status, flags=flags),
        seconds={
            **({"focus": found - started} if depth else {}),
            "accumulate": added - found,
            "solve": solved - added,
            "misfit": judged - solved,
            "uncertainty": time.perf_counter() - judged,
        },
        inputs=asked,
        focus=depth,
        predicted=cost,
        objective=getattr(solution, "objective", None),
        relative_gap=getattr(solution, "relative_gap", None),
    )


@dataclass(frozen=True, eq=False)
class Accumulated:
    """A run's frames added up.

    Attributes
    ----------
    model
        that the frames are of, factorised.
    frames, noise
        sums of all frames, and of their noise.
    kept
        the frames themselves while they are few; all or none.
    """

    model: Model
    frames: Accumulator
    noise: FrameNoise
    kept: tuple[Measurement, ...]

    @property
    def prepared(self) -> Prepared:
        """The factorised model."""
        return self.model.prepared

    @property
    def weights(self) -> FloatArray:
        """(r, r') W of all frames."""
        problem = self.prepared.problem(self.frames)
        return np.where(problem.sigma > 0, problem.projected, 0.0)

    def solution(self, lam: float | Literal["auto"], method: str) -> Solution | TVSolution:
        """Their image at ``lam`` by a ``method``."""
        if method == TV:
            return solve_tv(self.prepared, self.frames, lam)
        return self.prepared.solve(self.frames, lam)

    def lack(self, factors: Factors, image: FloatArray) -> Lack | None:
        """What ``factors`` are known to lack of the camera, of an ``image`` (n, n'); None where nothing is known."""
        return Lack(self.model, factors.lacking, image) if factors.lacking else None

    def misfit(
        self,
        shots: Capture,
        factors: Factors,
        solution: DepthMap | Solution | TVSolution,
        with_defects: bool = True,
    ) -> Misfit | None:
        """What of the measurements the model leaves unexplained, or None; reads frames again that were not kept.

        Parameters
        ----------
        shots, factors
            that these sums are of.
        solution
            of them, for what the factors' noise adds to the frames.
        with_defects
            whether defective pixels are looked for, and no cause where there are some.
        """
        problem, stated, image = self.prepared.problem(self.frames), factors.manifest.noise, solution.image
        added = factor_energy(self.prepared, shots.patterns, stated, image) if stated else None
        lack = self.lack(factors, image)
        if isinstance(solution, DepthMap):
            return solution.misfit(self.noise, added, print_energy(self.model, image))
        lam = _LAMBDA_OF_TV * problem.scale if isinstance(solution, TVSolution) else solution.lam
        evidence = Evidence(factors, shots.patterns, lack.energy if lack else None)
        return judge(self._check(shots, lam), added, print_energy(self.model, image), evidence, with_defects)

    def faulty_frames(self, shots: Capture, factors: Factors, depths: DepthMap) -> tuple[FrameFault, ...]:
        """Frames at fault of a scene of several depths.

        Parameters
        ----------
        shots, factors
            that these sums are of, at the depth of most of the scene.
        depths
            of its pixels, and their image.
        """
        stated = factors.manifest.noise
        added = factor_energy(self.prepared, shots.patterns, stated, depths.image) if stated else 0.0
        beside = self.noise.rendering + added + print_energy(self.model, depths.image)
        return faulty_frames(self._check(shots, depths.lam), beside, Evidence(factors, shots.patterns))

    def _check(self, shots: Capture, lam: float) -> FrameCheck:
        measured = self.measured(shots)
        return FrameCheck(self.prepared, self.weights, lam, shots.patterns, shots.manifest, self.noise, measured)

    def measured(self, shots: Capture) -> Callable[[], Iterable[Measurement]]:
        """What gives the measurements of ``shots``, any number of times: those that are kept, or reads them."""
        return lambda: self.kept or shots.measured()

    def uncertainty(self, shots: Capture, factors: Factors, solution: Solution) -> Uncertainty:
        """Standard uncertainty of a solution.

        Parameters
        ----------
        shots, factors
            that these sums are of.
        solution
            of these sums.
        """
        calibrated = factors.manifest.digital.exposure_uncertainty if factors.manifest.digital else 0.0
        return uncertainty(
            Propagation(self.model, solution.lam),
            self.noise,
            factors.manifest.noise,
            math.hypot(shots.manifest.digital.exposure_uncertainty, calibrated),
            solution.image,
            self.prepared.problem(self.frames),
            self.lack(factors, solution.image),
        )


def _without_defects(
    shots: Capture,
    factors: Factors,
    lam: float | Literal["auto"],
    method: str,
    data: Accumulated,
    misfit: Misfit,
) -> tuple[Capture, Accumulated, Solution | TVSolution, Misfit | None]:
    """Shots without the readings of defective pixels, their sums, solution and misfit; all as it was where the frames
    fit no better so.

    Parameters
    ----------
    shots, factors, lam, method
        as :func:`reconstruct` takes them.
    data, misfit
        sums of ``shots``, and their misfit with the first defects.
    """
    found, now, without = None, misfit, data
    for _ in range(_DEFECT_ROUNDS):
        if now.defects is None:
            break
        found = now.defects.with_others(found)
        rest = found.left_out(shots, data.measured(shots), data.prepared, data.weights)
        without = accumulated(rest, factors, method)
        solution = without.solution(lam, method)
        again = without.misfit(rest, factors, solution)
        now = again or now
    # What bright ones put into other pixels is none of these: they are taken in again.
    while found and (own := found.beyond_chance(rest, data.noise)) and len(own.rows) < len(found.rows):
        found, rest = own, own.left_out(shots, data.measured(shots), data.prepared, data.weights)
        without = accumulated(rest, factors, method)
        solution = without.solution(lam, method)
        now = without.misfit(rest, factors, solution, with_defects=False) or now
    if now.flagged:
        now = without.misfit(rest, factors, solution, with_defects=False) or now
    if now.flagged and now.unexplained > _BETTER * misfit.unexplained:
        solution = data.solution(lam, method)
        return shots, data, solution, data.misfit(shots, factors, solution, with_defects=False)
    return rest, without, solution, replace(now, defects=found)


def accumulated(shots: Capture, factors: Factors, method: str = TIKHONOV) -> Accumulated:
    """The model of shots and factors factorised, and every frame added.

    Parameters
    ----------
    shots, factors
        that fit each other.
    method
        of the image that they are for.

    Raises
    ------
    MitsimError
        when that takes more memory than is free, or a frame cannot be read.
    """
    left, right = shots.patterns
    _check_factorising(shots, factors, method)
    prepared = prepare(factors.left, factors.right, left, right, centre=factors.manifest.centre)
    if method == MARKOV:
        prepared = prepared.correlated()
    noise = FrameNoise(shots.manifest, _ambient_noise(shots))
    frames, kept = prepared.accumulator(), list[Measurement]()
    few = is_kept(shots, factors)
    for measurement in shots.measured((len(factors.left), len(factors.right))):
        frames.add(measurement.frame, measurement.row, measurement.column)
        noise.add(measurement)
        if few:
            kept.append(measurement)
    return Accumulated(Model(prepared, factors.sides, shots.patterns), frames, noise, tuple(kept))


def _check_factorising(shots: Capture, factors: Factors, method: str) -> None:
    """MitsimError where factorising the model of ``shots`` and ``factors`` for a ``method`` takes more memory than is
    free."""
    cost = Cost(memory_bytes=BYTES_A_NUMBER * slab_numbers(shots, factors, whole=method == MARKOV))
    cost.check(f"{shots.name}: factorising its patterns", Limits())


def _ambient_noise(shots: Capture) -> tuple[FloatArray, FloatArray] | None:
    """Variance, by sensor row and by sensor column, of the frame that is taken off all others; None where none is."""
    if shots.ambient is None or any(shot.sign for shot in shots.manifest.patterns.captures):
        return None
    return shots.ambient.variance.mean(axis=1), shots.ambient.variance.mean(axis=0)


def inputs(
    shots: Capture,
    factors: Factors,
    lam: float | str,
    method: str,
    focus: float | str | None = None,
    margin: int = 0,
    depth_range: tuple[float, float] | None = None,
) -> dict[str, Any]:
    """What decides an image.

    Parameters
    ----------
    shots, factors
        told by their fingerprints.
    lam, method, focus, margin, depth_range
        as asked for; ArgumentError for an unknown method, or another lambda, focus, margin or range than reconstruct
        takes.
    """
    check_asked(lam, method, focus, margin, depth_range)
    asked: dict[str, Any] = {
        "run": shots.fingerprint,
        "calibration": factors.fingerprint,
        "lambda": lam,
        "method": method,
    }
    asked |= {} if focus is None else {"focus": focus}
    asked |= {} if depth_range is None else {"depth_range": list(depth_range)}
    return {**asked, "margin": margin} if margin else asked


def _depth(
    shots: Capture,
    factors: Factors,
    lam: float | Literal["auto"],
    focus: float | str | None,
    depth_range: tuple[float, float] | None,
) -> Depth | DepthMap | None:
    if focus == "map":
        return depth_map(shots, factors, lam, depth_range)
    if focus == "auto":
        return best_depth(shots, factors, depth_range)
    return None if focus is None else Depth(float(focus))


def _flags(shots: Capture, factors: Factors) -> tuple[str, ...]:
    """Sentences on why the capture or the calibration was flagged: an image made of them is flagged too."""
    return tuple(
        f"The {what} was flagged: {' '.join(warning.split()).rstrip('.')}."
        for what, warnings in (("capture", shots.warnings), ("calibration", factors.warnings))
        for warning in warnings
    )

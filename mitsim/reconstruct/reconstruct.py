"""Shots and factors in, the scene's image out. Never sees the scene's truth."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import checked
from mitsim.core.job import Cost, Limits
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import Capture, Measurement
from mitsim.reconstruct.causes import Cause, Evidence
from mitsim.reconstruct.cost import BYTES_A_NUMBER, keeps_frames, predict_cost, slab_numbers
from mitsim.reconstruct.defects import Defects, LeftOut
from mitsim.reconstruct.depth import Depth, best_depth
from mitsim.reconstruct.depth_map import DepthMap, depth_map
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.faults import FrameFault
from mitsim.reconstruct.focus import move_factors
from mitsim.reconstruct.frame_check import FrameCheck
from mitsim.reconstruct.margin import Margin
from mitsim.reconstruct.misfit import Lack, Misfit, faulty_frames, find_misfit
from mitsim.reconstruct.noise import FrameNoise, factor_energy
from mitsim.reconstruct.request import TIKHONOV, ImageRequest
from mitsim.reconstruct.result import Reconstruction
from mitsim.reconstruct.solution import Solution, Verdict
from mitsim.reconstruct.solver import Accumulator, Prepared
from mitsim.reconstruct.solvers import SOLVERS, SeparableSolver
from mitsim.reconstruct.subpixel import Model, print_energy
from mitsim.reconstruct.uncertainty import Propagation, Uncertainty, uncertainty

_LAMBDA_BESIDE = 1e-3
"""Lambda, over the largest sigma^2, by which frames are predicted beside an image whose own weight says nothing of it,
as of total variation: chosen, between those of bright and of dim runs."""
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
    request = ImageRequest(lam, method, focus, margin, depth_range)
    solver, asked = SOLVERS[method], request.inputs(shots, factors)
    factors.check_fit(shots)
    beside = Margin(margin) if margin else None
    if beside:
        wider = beside.factors(factors)
        shots, factors = beside.of(wider.of(shots)), wider.factors
    # Depths that are looked for, and total variation, take as long as the data ask for.
    cost = predict_cost(shots, factors) if method == TIKHONOV and not request.looks_for_depth else None
    _check_factorising(shots, factors, solver)
    if cost:
        Cost(sum(cost.seconds.values()), cost.memory_bytes).check(f"{shots.name}: its image", Limits())
    started = time.perf_counter()
    depth = _depth(shots, factors, request)
    doubts = [depth.doubt] if depth else []
    found = time.perf_counter()
    if isinstance(depth, Depth):
        of_depth = move_factors(factors, depth.mm)
        shots, factors = of_depth.of(shots), of_depth.factors
        if of_depth.hidden:
            hidden = f"{of_depth.hidden:.1%} of the scene's pixels, which come out dark"
            doubts.append(f"At {depth.mm:.4g} mm the field stop takes most of the light of {hidden}.")
    data = accumulate(shots, factors, method)
    added = time.perf_counter()
    by_pixel = depth if isinstance(depth, DepthMap) and not depth.doubt else None
    solution = by_pixel.solution if by_pixel else data.solution(lam)
    solved = time.perf_counter()
    misfit = data.misfit_at(by_pixel) if by_pixel else data.misfit(solution)
    if misfit and misfit.defects:
        data, solution, misfit = _without_defects(data, lam, misfit)
    if misfit and misfit.cause in _OF_THE_SCENE and isinstance(depth, Depth) and depth.at_end:
        misfit = replace(misfit, cause=Cause.DEPTH)
    explained = factors.status.verdict is not Verdict.NOT_SEPARABLE and (misfit is None or not misfit.flagged)
    linear = solver.linear and not by_pixel
    if linear and lam == "auto" and (factors.lacking or not explained):
        lack = data.lack(solution.image)
        known = (lack.struck, lack.energy) if lack else None
        solution = data.prepared.solve(data.frames, lam, explained=explained, lack=known)
    judged = time.perf_counter()
    uncertainties = data.uncertainty(solution) if linear else None
    status = misfit.judged(solution.status) if misfit else solution.status
    image = solution.image
    if beside:
        image = beside.inside(image)
        uncertainties = uncertainties and Uncertainty(
            {name: beside.inside(values) for name, values in uncertainties.sources.items()}, uncertainties.bias_factor
        )
    doubts.append(uncertainties.loss(image) if uncertainties else "")
    flags = (*status.flags, *(doubt for doubt in doubts if doubt), *_flags(data.shots, factors))
    left, right = data.model.sides
    return Reconstruction(
        image=image,
        lam=solution.lam,
        rank=data.prepared.rank,
        condition=data.prepared.condition,
        rank_sides=(left.rank, right.rank),
        condition_sides=(left.condition, right.condition),
        residual=solution.residual,
        rounding=solution.rounding,
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
        objective=solution.objective,
        relative_gap=solution.relative_gap,
    )


@dataclass(frozen=True, eq=False)
class Accumulation:
    """A run's frames added up.

    Attributes
    ----------
    shots, factors, method
        of which, and for what image.
    model
        that the frames are of, factorised.
    frames, noise
        sums of all frames, and of their noise.
    kept
        the frames themselves while they are few; all or none.
    """

    shots: Capture
    factors: Factors
    method: str
    model: Model
    frames: Accumulator
    noise: FrameNoise
    kept: tuple[Measurement, ...]

    @property
    def solver(self) -> SeparableSolver:
        """Of the method."""
        return SOLVERS[self.method]

    @property
    def prepared(self) -> Prepared:
        """The factorised model."""
        return self.model.prepared

    @property
    def weights(self) -> FloatArray:
        """(r, r') W of all frames."""
        problem = self.prepared.problem(self.frames)
        return np.where(problem.sigma > 0, problem.projected, 0.0)

    def measured(self) -> Iterable[Measurement]:
        """All measurements once more: those that are kept, or reads them."""
        return self.kept or self.shots.measured()

    def solution(self, lam: float | Literal["auto"]) -> Solution:
        """Their image at ``lam``."""
        return self.solver.compute(self.prepared, self.frames, lam)

    def lack(self, image: FloatArray) -> Lack | None:
        """What the factors are known to lack of the camera, of an ``image`` (n, n'); None where nothing is known."""
        return Lack(self.model, self.factors.lacking, image) if self.factors.lacking else None

    def misfit(self, solution: Solution, with_defects: bool = True) -> Misfit | None:
        """What of the measurements the model leaves unexplained, or None; reads frames again that were not kept.

        Parameters
        ----------
        solution
            of them, for what the factors' noise adds to the frames.
        with_defects
            whether defective pixels are looked for, and no cause where there are some.
        """
        image, lack = solution.image, self.lack(solution.image)
        lam = solution.lam if self.solver.linear else _LAMBDA_BESIDE * self.prepared.problem(self.frames).scale
        evidence = Evidence(self.factors, self.shots.patterns, lack.energy if lack else None)
        of_factors = self._factor_energy(image)
        return find_misfit(self._check(lam), of_factors, print_energy(self.model, image), evidence, with_defects)

    def misfit_at(self, depths: DepthMap) -> Misfit:
        """The same of an image with a depth for each pixel, ``depths``."""
        of_factors = self._factor_energy(depths.image)
        misfit = depths.misfit(self.noise, of_factors, print_energy(self.model, depths.image))
        # At the depth of most of the scene a frame that is not what it says is off by more than depth puts it.
        most = move_factors(self.factors, float(np.median(depths.mm)))
        faults = accumulate(most.of(self.shots), most.factors)._faulty_frames(depths)
        return replace(misfit, flagged=True, cause=Cause.FRAMES, faults=faults) if faults else misfit

    def _faulty_frames(self, depths: DepthMap) -> tuple[FrameFault, ...]:
        """Frames at fault of a scene of several ``depths``, these sums being at that of most of it."""
        added = self._factor_energy(depths.image) or 0.0
        beside = self.noise.rendering + added + print_energy(self.model, depths.image)
        return faulty_frames(self._check(depths.lam), beside, Evidence(self.factors, self.shots.patterns))

    def _factor_energy(self, image: FloatArray) -> float | None:
        stated = self.factors.manifest.noise
        return factor_energy(self.prepared, self.shots.patterns, stated, image) if stated else None

    def _check(self, lam: float) -> FrameCheck:
        patterns, manifest = self.shots.patterns, self.shots.manifest
        return FrameCheck(self.prepared, self.weights, lam, patterns, manifest, self.noise, self.measured)

    def uncertainty(self, solution: Solution) -> Uncertainty:
        """Standard uncertainty of a ``solution`` of these sums."""
        manifest = self.factors.manifest
        calibrated = manifest.digital.exposure_uncertainty if manifest.digital else 0.0
        return uncertainty(
            Propagation(self.model, solution.lam),
            self.noise,
            manifest.noise,
            math.hypot(self.shots.manifest.digital.exposure_uncertainty, calibrated),
            solution.image,
            self.prepared.problem(self.frames),
            self.lack(solution.image),
        )


def _without_defects(
    data: Accumulation, lam: float | Literal["auto"], misfit: Misfit
) -> tuple[Accumulation, Solution, Misfit | None]:
    """Sums without the readings of defective pixels, their solution at ``lam`` and misfit; all as it was where the
    frames fit no better so. ``misfit`` is that of ``data``, with the first defects."""

    def left_out(defects: Defects) -> tuple[LeftOut, Accumulation, Solution]:
        rest = defects.left_out(data.shots, data.measured, data.prepared, data.weights)
        without = accumulate(rest, data.factors, data.method)
        return rest, without, without.solution(lam)

    found, now, without = None, misfit, data
    for _ in range(_DEFECT_ROUNDS):
        if now.defects is None:
            break
        found = now.defects.with_others(found)
        rest, without, solution = left_out(found)
        now = without.misfit(solution) or now
    # What bright ones put into other pixels is none of these: they are taken in again.
    while found and (own := found.beyond_chance(rest, data.noise)) and len(own.rows) < len(found.rows):
        found = own
        rest, without, solution = left_out(found)
        now = without.misfit(solution, with_defects=False) or now
    if now.flagged:
        now = without.misfit(solution, with_defects=False) or now
    if now.flagged and now.unexplained > _BETTER * misfit.unexplained:
        solution = data.solution(lam)
        return data, solution, data.misfit(solution, with_defects=False)
    return without, solution, replace(now, defects=found)


def accumulate(shots: Capture, factors: Factors, method: str = TIKHONOV) -> Accumulation:
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
    solver = SOLVERS[method]
    _check_factorising(shots, factors, solver)
    prepared = solver.init(factors, shots.patterns)
    noise = FrameNoise(shots.manifest, _ambient_noise(shots))
    frames, kept = prepared.accumulator(), list[Measurement]()
    few = keeps_frames(shots, factors)
    for measurement in shots.measured((len(factors.left), len(factors.right))):
        frames.add(measurement.frame, measurement.row, measurement.column)
        noise.add(measurement)
        if few:
            kept.append(measurement)
    model = Model(prepared, factors.sides, shots.patterns)
    return Accumulation(shots, factors, method, model, frames, noise, tuple(kept))


def _check_factorising(shots: Capture, factors: Factors, solver: SeparableSolver) -> None:
    """MitsimError where factorising the model of ``shots`` and ``factors`` takes more memory than is free."""
    cost = Cost(memory_bytes=BYTES_A_NUMBER * slab_numbers(shots, factors, whole=solver.whole))
    cost.check(f"{shots.name}: factorising its patterns", Limits())


def _ambient_noise(shots: Capture) -> tuple[FloatArray, FloatArray] | None:
    """Variance, by sensor row and by sensor column, of the frame that is taken off all others; None where none is."""
    if shots.ambient is None or any(shot.sign for shot in shots.manifest.patterns.captures):
        return None
    return shots.ambient.variance.mean(axis=1), shots.ambient.variance.mean(axis=0)


def _depth(shots: Capture, factors: Factors, request: ImageRequest) -> Depth | DepthMap | None:
    if request.focus == "map":
        return depth_map(shots, factors, request.lam, request.depth_range)
    if request.focus == "auto":
        return best_depth(shots, factors, request.depth_range)
    return None if request.focus is None else Depth(float(request.focus))


def _flags(shots: Capture, factors: Factors) -> tuple[str, ...]:
    """Sentences on why the capture or the calibration was flagged: an image made of them is flagged too."""
    return tuple(
        f"The {what} was flagged: {' '.join(warning.split()).rstrip('.')}."
        for what, warnings in (("capture", shots.warnings), ("calibration", factors.warnings))
        for warning in warnings
    )

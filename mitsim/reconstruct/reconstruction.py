"""Shots and factors in, the scene's image out. Never sees the scene's truth."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.framefile import write_frame
from mitsim.core.jsonfile import read_json, write_json
from mitsim.core.measurement import Measurement
from mitsim.core.output import output_folder, whole_file
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.pictures import card, png, scaled, span
from mitsim.core.resources import Cost, Limits
from mitsim.core.runs import Capture
from mitsim.reconstruct.accumulator import Accumulator
from mitsim.reconstruct.causes import Evidence
from mitsim.reconstruct.depth import Depth, best_depth
from mitsim.reconstruct.detail import Model, print_energy
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.focus import focused
from mitsim.reconstruct.misfit import Misfit, judge
from mitsim.reconstruct.noise import FrameNoise, factor_energy
from mitsim.reconstruct.solver import Prepared, Solution, prepare
from mitsim.reconstruct.status import Status, Verdict
from mitsim.reconstruct.tv import solve_tv
from mitsim.reconstruct.uncertainty import NO_UNCERTAINTY, Propagation, Uncertainty, uncertainty

METHODS = ("tikhonov", "tv")
IMAGE_FILE, UNCERTAINTY_FILE, RESULT_FILE = "image.exr", "uncertainty.exr", "result.json"
_BYTES_A_NUMBER = 32.0
"""Memory for each number of the factors' slabs: itself, and the copies that factorising makes."""
_KEPT_NUMBERS = 1 << 24
"""Pixels of all measurements up to which they are kept for a second look: 64 of 512 x 512, at most 256 MiB."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """An image and how far to trust it.

    Attributes
    ----------
    image
        (n, n') reflectance, 1 = the calibration's board, neither clipped nor normalised.
    lam
        lambda that was used, in the unit of (Phi_L Phi_R)^2; for ``tv`` the weight of the total variation.
    rank
        of the whole model, the product of ``rank_sides``.
    condition
        the larger of ``condition_sides``; that of the whole model is their product, ``condition_whole``.
    rank_sides, condition_sides
        of scene rows and of scene columns.
    residual
        ||Y - model|| / ||Y|| over all frames.
    rounding
        what rounding may have changed, ||error|| / ||image||; None for ``tv``.
    misfit
        what of the measurements fits no image; None where there are no more data than unknowns.
    uncertainties
        standard uncertainty of the image by source; None for ``tv``, which is not linear in the frames.
    status
        whether it can be trusted, what is wrong and what to do; misfit and flags of the capture and of the calibration
        count.
    seconds
        by stage.
    inputs
        fingerprints of shots and factors, ``lam`` as it was asked for, and the method; the focus, where one was.
    focus
        the depth whose factors were used; None: the calibrated one's.
    """

    image: FloatArray
    lam: float
    rank: int
    condition: float
    rank_sides: tuple[int, int]
    condition_sides: tuple[float, float]
    residual: float
    rounding: float | None
    misfit: Misfit | None
    uncertainties: Uncertainty | None
    status: Status
    seconds: dict[str, float]
    inputs: dict[str, str | float]
    focus: Depth | None = None

    @property
    def ok(self) -> bool:
        """Whether the image can be used as it is."""
        return self.status.ok

    @property
    def condition_whole(self) -> float:
        """Condition of the whole model; inf when rank deficient."""
        return self.condition_sides[0] * self.condition_sides[1]

    @property
    def uncertainty(self) -> FloatArray | None:
        """(n, n') standard uncertainty of the image, random and systematic parts together."""
        return self.uncertainties.total if self.uncertainties else None

    @property
    def trust(self) -> tuple[str, ...]:
        """A line on the misfit, and one on the uncertainty by source, where these are known."""
        return tuple(str(known) for known in (self.misfit, self.uncertainties) if known)

    def summary(self) -> dict[str, Any]:
        """What result.json and the command line's JSON say of it."""
        return {
            "lambda": self.lam,
            "rank": self.rank,
            "rank_sides": self.rank_sides,
            "condition": self.condition,
            "condition_whole": self.condition_whole,
            "condition_sides": self.condition_sides,
            "residual": self.residual,
            "focus_mm": self.focus and self.focus.mm,
            "focus_error_mm": self.focus and self.focus.error_mm,
            "misfit": self.misfit and self.misfit.summary(),
            **(self.uncertainties.summary() if self.uncertainties else NO_UNCERTAINTY),
            "status": str(self.status),
            "seconds": {**self.seconds, "total": sum(self.seconds.values())},
        }

    def save(self, folder: Path | str, overwrite: bool = False, more: Mapping[str, Any] | None = None) -> Path:
        """Write image.exr, image.png (for display), uncertainty.exr where it is known, and result.json.

        Parameters
        ----------
        folder
            new or empty, or with an earlier image of the same inputs, which is replaced.
        overwrite
            whether an earlier image of other inputs may be replaced, too.
        more
            entries of result.json beside :meth:`summary`.

        Raises
        ------
        MitsimError
            when the folder holds another image or something else, or cannot be written.
        """
        with output_folder(folder, overwrite=may_replace(Path(folder), self.inputs, overwrite)) as place:
            return self.write(place, more)

    def write(self, folder: Path, more: Mapping[str, Any] | None = None) -> Path:
        """The same in a ``folder`` that this process holds already (:func:`mitsim.core.output.output_folder`); ``more``
        are further entries of result.json."""
        write_frame(
            folder / IMAGE_FILE, {"reflectance": self.image.astype(np.float32)}, {"method": self.inputs["method"]}
        )
        (folder / UNCERTAINTY_FILE).unlink(missing_ok=True)
        if self.uncertainties:
            write_frame(folder / UNCERTAINTY_FILE, self.uncertainties.channels(), {"method": self.inputs["method"]})
        with whole_file(folder / "image.png") as part:
            part.write_bytes(png(self.image))
        write_json(folder / RESULT_FILE, {**(more or {}), **self.summary(), "inputs": self.inputs})
        return folder

    def __repr__(self) -> str:
        rows, columns = self.image.shape
        return f"Reconstruction({rows} x {columns}: {self.status.verdict.value}, residual {self.residual:.1e})"

    def _repr_html_(self) -> str:
        facts = f"lambda {self.lam:.3g}, residual {self.residual:.1e} of the frames"
        pictures = {"reflectance 0 to 1": self.image}
        if self.uncertainty is not None:
            caption = f"standard uncertainty of each pixel\n{span(self.uncertainty, 'of reflectance')}"
            pictures[caption] = scaled(self.uncertainty)
        return card(f"Reconstruction: {self.status.verdict.value}", pictures, (str(self.status), *self.trust, facts))


@single_threaded_blas()
def reconstruct(
    shots: Capture,
    factors: Factors,
    lam: float | Literal["auto"] = "auto",
    method: str = "tikhonov",
    focus: float | Literal["auto"] | None = None,
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
        ``tikhonov`` (closed form) or ``tv`` (least total variation).
    focus
        depth of the scene [mm], whose factors are taken instead of the calibrated depth's; ``auto``: that which leaves
        least of the measurements unexplained.

    Raises
    ------
    MitsimError
        for a capture and factors that do not fit each other, a frame that cannot be read, more memory than is free,
        another lambda, method or focus, or a calibration that does not state its parallax.
    """
    asked = inputs(shots, factors, lam, method, focus)
    factors.check_fit(shots)
    started = time.perf_counter()
    depth = best_depth(shots, factors) if focus == "auto" else Depth(focus) if focus is not None else None
    found = time.perf_counter()
    if depth is not None:
        of_depth = focused(factors, depth.mm)
        shots, factors = of_depth.of(shots), of_depth.factors
    data = accumulated(shots, factors)
    prepared, frames = data.prepared, data.frames
    added = time.perf_counter()
    solution = prepared.solve(frames, lam) if method == "tikhonov" else solve_tv(prepared, frames, lam)
    solved = time.perf_counter()
    misfit = data.misfit(shots, factors, solution.image)
    separable = factors.status.verdict is not Verdict.NOT_SEPARABLE
    if method == "tikhonov" and lam == "auto" and not (separable and (misfit is None or not misfit.flagged)):
        solution = prepared.solve(frames, lam, explained=False)
    judged = time.perf_counter()
    uncertainties = data.uncertainty(shots, factors, solution) if isinstance(solution, Solution) else None
    status = misfit.judged(solution.status) if misfit else solution.status
    flags = (*status.flags, *((depth.doubt,) if depth and depth.doubt else ()), *_flags(shots, factors))
    return Reconstruction(
        image=solution.image,
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

    def misfit(self, shots: Capture, factors: Factors, image: FloatArray) -> Misfit | None:
        """What of the measurements the model leaves unexplained, or None; reads frames again that were not kept.

        Parameters
        ----------
        shots, factors
            that these sums are of.
        image
            their reconstruction, for what the factors' noise adds to the frames.
        """
        problem, stated = self.prepared.problem(self.frames), factors.manifest.noise
        return judge(
            self.prepared,
            np.where(problem.sigma > 0, problem.projected, 0.0),
            self.kept or shots.measured(),
            self.noise,
            factor_energy(self.prepared, shots.patterns, stated, image) if stated else None,
            print_energy(self.model, image),
            Evidence(factors, shots.patterns),
        )

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
        )


def accumulated(shots: Capture, factors: Factors) -> Accumulated:
    """The model of ``shots`` and ``factors`` factorised, and every frame added. MitsimError when that takes more memory
    than is free, or a frame cannot be read."""
    left, right = shots.patterns
    sides = (factors.left, left), (factors.right, right)
    numbers = sum(len(factor) * np.count_nonzero(patterns) + factor.size for factor, patterns in sides)
    Cost(memory_bytes=_BYTES_A_NUMBER * float(numbers)).check(f"{shots.name}: factorising its patterns", Limits())
    prepared = prepare(factors.left, factors.right, left, right, centre=factors.manifest.centre)
    noise = FrameNoise(shots.manifest, _ambient_noise(shots))
    frames, kept = prepared.accumulator(), list[Measurement]()
    few = left.shape[1] * right.shape[1] * len(factors.left) * len(factors.right) <= _KEPT_NUMBERS
    for measurement in shots.measured((len(factors.left), len(factors.right))):
        frames.add(measurement.frame, measurement.row, measurement.column)
        noise.add(measurement)
        if few:
            kept.append(measurement)
    return Accumulated(Model(prepared, factors.sides, shots.patterns), frames, noise, tuple(kept))


def _ambient_noise(shots: Capture) -> tuple[FloatArray, FloatArray] | None:
    """Variance, by sensor row and by sensor column, of the frame that is taken off all others; None where none is."""
    if shots.ambient is None or any(shot.sign for shot in shots.manifest.patterns.captures):
        return None
    return shots.ambient.variance.mean(axis=1), shots.ambient.variance.mean(axis=0)


def inputs(
    shots: Capture, factors: Factors, lam: float | str, method: str, focus: float | str | None = None
) -> dict[str, str | float]:
    """What decides an image.

    Parameters
    ----------
    shots, factors
        told by their fingerprints.
    lam, method, focus
        as asked for; ArgumentError for an unknown method, or another lambda or focus than reconstruct takes.
    """
    if method not in METHODS:
        raise ArgumentError("method", f"{method!r}: use {' or '.join(METHODS)}")
    if lam != "auto" and (isinstance(lam, str) or not 0 <= lam < np.inf):
        raise ArgumentError("lam", f"{lam}: give a finite number of at least 0, or auto")
    if focus is not None and focus != "auto" and (isinstance(focus, str) or not 0 < focus < np.inf):
        raise ArgumentError("focus", f"{focus}: give a depth above 0 mm, or auto")
    asked = {"run": shots.fingerprint, "calibration": factors.fingerprint, "lambda": lam, "method": method}
    return asked if focus is None else {**asked, "focus": focus}


def may_replace(folder: Path, asked: Mapping[str, str | float], overwrite: bool) -> bool:
    """Whether a folder holds an image that may be replaced; False when it holds none.

    Parameters
    ----------
    folder
        that is to be written to.
    asked
        the :func:`inputs` of the new image.
    overwrite
        whether an image of other inputs may be replaced.

    Raises
    ------
    MitsimError
        when there is an image of other inputs, and ``overwrite`` is off.
    """
    if not (folder / IMAGE_FILE).is_file():
        return False
    if overwrite:
        return True
    result = read_json(folder / RESULT_FILE) if (folder / RESULT_FILE).is_file() else {}
    earlier = result.get("inputs") if isinstance(result, dict) else None
    earlier = earlier if isinstance(earlier, dict) else {}
    changed = [name for name, value in asked.items() if earlier.get(name) != value]
    if changed:
        raise MitsimError(
            f"output {folder}: holds an image of other inputs ({', '.join(changed)} differ); "
            "choose another folder, or replace it with overwrite=True"
        )
    return True


def _flags(shots: Capture, factors: Factors) -> tuple[str, ...]:
    """Sentences on why the capture or the calibration was flagged: an image made of them is flagged too."""
    return tuple(
        f"The {what} was flagged: {' '.join(warning.split()).rstrip('.')}."
        for what, warnings in (("capture", shots.warnings), ("calibration", factors.warnings))
        for warning in warnings
    )

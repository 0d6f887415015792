"""Image of a scene from a capture and factors, and how far to trust it; the scene's truth is never used."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import Drawn, takes
from mitsim.core.environment import versions
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, checked_fields
from mitsim.core.exr import verify_files, write_frame
from mitsim.core.files import output_folder, plain, read_json, remove_page, write_bytes, write_json
from mitsim.core.headline import each_once, image_headline
from mitsim.core.images import card, from_above, normalise, png, span
from mitsim.core.job import Cost, Job, Limits
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import Capture
from mitsim.reconstruct.accumulation import Accumulation, FrameNoise, accumulate, check_factorising, print_energy
from mitsim.reconstruct.depth import Depth, DepthMap, best_depth, depth_map, move_factors, parallax_of
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.misfit import GROSS, GROSS_CHI_SQUARE, Cause, LeftOut, Misfit, faulty_frames, find_misfit, weigh
from mitsim.reconstruct.request import IMAGE_FILE, PICTURE_FILE, RESULT_FILE, TIKHONOV, ImageCost, ImageRequest
from mitsim.reconstruct.solver import Solution, Status, Verdict
from mitsim.reconstruct.solvers import SOLVERS, Solver
from mitsim.reconstruct.uncertainty import Uncertainty, rms, uncertainty
from mitsim.reconstruct.volume import Volume, solve_volume

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from xarray import Dataset

# ---- Fit to a point spread function ----------------------------------------------------------------------------------

_TURNED, _EQUAL = 0.85, 0.98
"""Cost ratios of the best turned copy below which it is recommended, and below which the light is wrong."""
MOST_SCALE, MOST_TURN_DEG = 0.1, 6.0
"""Largest change of scale, and rotation [degrees], that the mending of a point spread function looks for."""
_RIVAL = 1.02
"""Cost ratio of a second shift below which the shift is unknown."""
_APART = 3.0
"""Standard errors by which two fits differ at most, and those of a change that is used at least."""
_LEAST_GAIN, _RISE, _NOISY = 1.015, 0.02, 1.2
"""Least cost ratio of right light: the first times chi-square to the second; noise explains frames below the last."""
_NEEDED, _SHARE = 1.1, 0.1
"""Least cost ratio without a depth that has at least that share of the light. Of 30 simulated volumes above it 66 to
82 % of the light was at the right depth, and below 33 to 57 %, or up to 84 % where a depth of the list was empty."""


@dataclass(frozen=True)
class Mending:
    """Change of a point spread function: ``scale`` and ``rotation_deg`` (columns towards rows) about its middle.

    The copy named ``reading`` is changed so and then moved by ``shift_px`` [rows, columns], None under uniform light.
    ``rival`` is the cost of the second best shift over that of the best, None if no other was found.
    ``cost`` is that of the changed function over that of the given one. Errors are standard errors; fits to less and
    to more blurred frames are ``apart`` by so many of them.
    """

    scale: float = 1.0
    rotation_deg: float = 0.0
    reading: str = ""
    scale_error: float = 0.0
    rotation_error: float = 0.0
    cost: float = 1.0
    apart: float = 0.0
    shift_px: tuple[float, float] | None = None
    shift_error: tuple[float, float] | None = None
    rival: float | None = None

    @property
    def is_better(self) -> bool:
        """Return True if the frames show a change, by more than three standard errors."""
        return not self.fault[0]

    @property
    def fault(self) -> tuple[str, str]:
        numbers = self.scale - 1, self.rotation_deg, *(self.shift_px or ())
        errors = self.scale_error, self.rotation_error, *(self.shift_error or ())
        far = math.hypot(*(number / max(error, 1e-12) for number, error in zip(numbers, errors, strict=True)))
        if abs(self.scale - 1) >= MOST_SCALE or abs(self.rotation_deg) >= MOST_TURN_DEG:
            why = f"the best fit is at the end of the search, {MOST_SCALE:.0%} of scale or {MOST_TURN_DEG:g} degrees"
        elif (
            self.cost >= 1 or not all(map(math.isfinite, (*errors, self.apart))) or (far < _APART and not self.reading)
        ):
            why = "no scale, rotation or shift explains the frames better"
        elif self.apart > _APART:
            why = f"fits to less and to more blurred frames are {self.apart:.1f} standard errors apart"
        elif self.rival and self.rival < _RIVAL:
            why = "another shift explains the frames almost as well"
        else:
            return "", ""
        return f"Not mended: {why}; the light is used as given", "use the light of one point as this camera sees it"

    def __str__(self) -> str:
        turned = f"{self.reading}, " if self.reading else ""
        words = f"{turned}scale {self.scale:.4f} ± {self.scale_error:.4f}, "
        words += f"rotation {self.rotation_deg:.2f} ± {self.rotation_error:.2f} degrees"
        for name, shift, error in zip(("rows", "columns"), self.shift_px or (), self.shift_error or (), strict=False):
            words += f", {shift:+.2f} ± {error:.2f} {name}"
        return f"mended light: {words}; it costs {self.cost:.2g} times as much as the light as given"


@dataclass(frozen=True)
class PointSpreadFit:
    """Fit of frames to a point spread function.

    ``gain`` is the cost of the best turned or mirrored copy (``reading``) over that of the light as given, None where
    all are alike. ``without`` has that of the light without each depth. ``off`` is the distance [rows, columns] from
    the middle of the picture to the light's centre.
    """

    chi_square: float
    unexplained: float
    stated: bool
    gain: float | None
    reading: str
    off: tuple[float, float]
    size: tuple[int, int]
    without: tuple[float, ...] = ()
    mended: Mending | None = None

    @property
    def fault(self) -> tuple[str, str]:
        energy = f"{self.chi_square:.3g} times the noise's energy"
        left = f"{self.unexplained:.1%} of the frames is left unexplained, {energy}"
        same = "use the light of one point as this camera sees it, as it lies in the frames"
        if self.gain is not None and self.gain < _TURNED:
            return f"Misfit: the point spread function fits better {self.reading}; {left}", f"turn it so, or {same}"
        least = _EQUAL if self.chi_square < _NOISY else _LEAST_GAIN * self.chi_square**_RISE
        if self.gain is not None and self.gain < least:
            return f"Misfit: the point spread function fits no better as given than {self.reading}; {left}", same
        if self.unexplained > GROSS and self.chi_square > GROSS_CHI_SQUARE:
            return f"Misfit: {left}", same
        rows, columns = self.off
        if max(abs(rows) / self.size[0], abs(columns) / self.size[1]) > 0.125:
            return (
                f"Misfit: the point's light is centred {rows:+.0f} rows and {columns:+.0f} columns from the middle of "
                "its picture, and the image is displaced as much",
                "take the picture of a point in the middle of the field, or shift it there",
            )
        return "", ""

    @property
    def gist(self) -> str:
        return f"{self.unexplained:.1%} unexplained" + (f"; {self.mended}" if self.mended else "")

    def __str__(self) -> str:
        noise = "its stated noise" if self.stated else "noise, measured from the frames"
        cost = "" if self.gain is None else f"; turned or mirrored, the light costs {self.gain:.3g} times as much"
        mended = f"; {self.mended}" if self.mended else ""
        chi_square = f"chi-square {self.chi_square:.3g} against {noise}"
        return f"misfit: {self.unexplained:.1e} unexplained, {chi_square}{cost}{mended}"

    def summary(self) -> dict[str, Any]:
        sentence, _ = self.fault
        return {
            "chi_square": self.chi_square,
            "unexplained": self.unexplained,
            "noise_stated": self.stated,
            "flagged": bool(sentence),
            "turned_cost": self.gain,
            "reading": self.reading if self.gain is not None and self.gain < _TURNED else None,
            "off_centre": list(self.off),
            "without_depth": list(self.without) or None,
            "mended": self.mended and asdict(self.mended),
        }

    def doubt_of(self, slices: FloatArray, depths_mm: FloatArray) -> str:
        """Return a sentence if the frames do not need a depth of whose light much is in its slice."""
        light = np.maximum(slices, 0.0).sum(axis=(1, 2))
        share = light / max(float(light.sum()), 1e-300)
        needless = [k for k, cost in enumerate(self.without) if cost < _NEEDED and share[k] > _SHARE]
        if not needless:
            return ""
        places = " or ".join(f"{depths_mm[k]:g} mm ({share[k]:.0%} of the light)" for k in needless)
        return (
            f"Depths are uncertain: the frames are explained nearly as well without {places}; leave one out, or give "
            "depths farther apart. Few small objects are told apart best."
        )

    def judge(self, status: Status) -> Status:
        sentence, remedy = self.fault
        if not sentence and self.mended:
            sentence, remedy = self.mended.fault
        return status.with_misfit(sentence, remedy) if sentence else status


# ---- An image and how far to trust it --------------------------------------------------------------------------------

UNCERTAINTY_FILE, DEPTH_FILE, VOLUME_FILE = "uncertainty.exr", "depth.exr", "volume.exr"
_INCOMPLETE = "incomplete"
MADE_OF = "made_of"
POINT_SPREAD = "psf"


@checked_fields
@dataclass(frozen=True, eq=False, kw_only=True)
class Reconstruction(Solution):
    """Image and its quality: reflectance relative to the calibration's board, or electrons/s by a point spread.

    Attributes
    ----------
    rank
        Rank of the whole model, the product of ``rank_sides``; None, as the next three, where the model is not
        factorised.
    condition
        Larger of ``condition_sides``.
    rank_sides, condition_sides
        For scene rows and for scene columns.
    misfit
        Misfit of the measurements; None where there are no more data than unknowns.
    uncertainties
        Standard uncertainty by source; None for methods that are not linear in the frames, with a depth for each pixel,
        and by a point spread function.
    seconds
        Seconds by stage.
    inputs
        Fingerprints of shots and factors, and the request.
    focus
        Depth, or depth for each pixel; None: the calibrated one.
    predicted
        Predicted seconds by stage and memory, if known.
    fit
        Fit to a point spread function; None for an image by factors.
    """

    rank: int | None = None
    condition: float | None = None
    rank_sides: tuple[int, int] | None = None
    condition_sides: tuple[float, float] | None = None
    misfit: Misfit | None = None
    uncertainties: Uncertainty | None = None
    seconds: dict[str, float]
    inputs: dict[str, Any]
    focus: Depth | DepthMap | None = None
    predicted: ImageCost | None = None
    fit: PointSpreadFit | None = None

    @property
    def depths(self) -> DepthMap | None:
        """Depth for each pixel, where it was requested and is reliable."""
        return self.focus if isinstance(self.focus, DepthMap) and not self.focus.doubt else None

    @property
    def volume(self) -> Volume | None:
        """Reflectance by depth, where it was requested."""
        return self.focus if isinstance(self.focus, Volume) else None

    @property
    def condition_whole(self) -> float | None:
        """Condition of the whole model; inf when rank deficient."""
        return None if self.condition_sides is None else self.condition_sides[0] * self.condition_sides[1]

    @property
    def uncertainty(self) -> FloatArray | None:
        """Standard uncertainty (n, n') of the image, random and systematic parts together."""
        return self.uncertainties.total if self.uncertainties else None

    @property
    def white(self) -> float:
        """Number that pictures show as white: 1, or the largest number by a point spread function."""
        largest = float(self.image.max()) if POINT_SPREAD in self.inputs else 0.0
        return largest if largest > 0 else 1.0

    @property
    def trust(self) -> tuple[str, ...]:
        """Lines on misfit, fit and uncertainty, where these are known."""
        return tuple(str(known) for known in (self.misfit, self.fit, self.uncertainties) if known)

    @property
    def limits(self) -> tuple[str, ...]:
        """Sentences on questions that the frames of a real camera leave undecided."""
        return tuple(f"Not decided: {limit['words']}" for limit in self.misfit.limits) if self.misfit else ()

    def summary(self) -> dict[str, Any]:
        """Return the entries of result.json."""
        return {
            "lambda": self.lam,
            "rank": self.rank,
            "rank_sides": self.rank_sides,
            "condition": self.condition,
            "condition_whole": self.condition_whole,
            "condition_sides": self.condition_sides,
            "white": self.white,
            "residual": self.residual,
            "iterations": self.iterations,
            "objective": self.objective,
            "relative_gap": self.relative_gap,
            "focus_mm": self.focus.mm if isinstance(self.focus, Depth) else None,
            "focus_error_mm": self.focus.error_mm if isinstance(self.focus, Depth) else None,
            "focus_range_mm": self.focus.range_mm if self.focus else None,
            "focus_alternatives": [asdict(other) for other in self.focus.alternatives] if self.focus else None,
            "depths": self.depths.summary() if self.depths else None,
            "volume_depths_mm": self.volume.depths_mm.tolist() if self.volume else None,
            "misfit": known.summary() if (known := self.misfit or self.fit) else None,
            "uncertainty": (known_to := self.uncertainties) and rms(known_to.total),
            "uncertainty_budget": known_to and known_to.budget,
            "uncertainty_extrapolated": known_to and known_to.extrapolated,
            "regularisation_bias_factor": known_to and known_to.bias_factor,
            "shape": self.image.shape,
            "status": str(self.status),
            "warnings": self.status.reasons,
            "seconds": {**self.seconds, "total": sum(self.seconds.values())},
            "predicted": self.predicted and self.predicted.seconds,
            "predicted_seconds": self.predicted and sum(self.predicted.seconds.values()),
            "predicted_memory_bytes": self.predicted and self.predicted.memory_bytes,
        }

    @check_arguments
    def save(self, folder: Path | str, overwrite: bool = False, more: Mapping[str, Any] | None = None) -> Path:
        """Write image.exr, image.png (for display), result.json, and uncertainty, depth.exr and volume.exr where known.

        Parameters
        ----------
        folder
            New or empty folder, or one with an earlier image of the same inputs, which is replaced.
        overwrite
            Whether an earlier image of other inputs may be replaced, too.
        more
            Entries of result.json beside :meth:`summary`.

        Raises
        ------
        MitsimError
            If the folder contains something else, or cannot be written.
        """
        _check_stored(more)
        with output_folder(folder, overwrite=may_replace(Path(folder), self.inputs, overwrite)) as place:
            return self.write(place, more)

    @check_arguments
    def write(self, folder: Path | str, more: Mapping[str, Any] | None = None) -> Path:
        """Write the files to a ``folder`` that this process holds already (:func:`mitsim.core.files.output_folder`)."""
        _check_stored(more)
        folder = Path(folder)
        remove_page(folder)
        # First of all, so that an image which a killed process left is known to be of these inputs, and unfinished.
        write_json(folder / RESULT_FILE, {"status": _INCOMPLETE, "inputs": self.inputs})
        channels: dict[str, Any] = {IMAGE_FILE: {"reflectance": self.image.astype(np.float32)}}
        known = self.uncertainties
        errors = known and {"uncertainty": known.total, "random": known.random, "systematic": known.systematic}
        maps = {"depth_mm": self.depths.mm, "confidence": self.depths.confidence} if self.depths else {}
        slices = {f"slice_{k:03d}": each for k, each in enumerate(self.volume.slices)} if self.volume else {}
        for name, arrays in ((UNCERTAINTY_FILE, errors), (DEPTH_FILE, maps), (VOLUME_FILE, slices)):
            channels[name] = {channel: values.astype(np.float32) for channel, values in (arrays or {}).items()}
        checksums = {}
        for name, values in channels.items():
            (folder / name).unlink(missing_ok=True)
            if values:
                checksums[name] = write_frame(folder / name, values, {"method": self.inputs["method"]})
        checksums[PICTURE_FILE] = write_bytes(folder / PICTURE_FILE, png(self.image / self.white))
        stated = {"inputs": self.inputs, "checksums": checksums}
        result = {**(more or {}), **self.summary(), **stated}
        headline = image_headline(result, self.status.reasons)
        write_json(folder / RESULT_FILE, {"headline": headline, "versions": versions(), **result})
        return folder

    @takes(Drawn)
    def plot(
        self, quantity: Literal["image", "uncertainty", "depth"] = "image", ax: Axes | None = None, **figure: Any
    ) -> Axes:
        """Draw the image, its standard uncertainty or the depths with a colour bar, and return the axes.

        Raises MitsimError for an uncertainty or depths that are not known.
        """
        return from_above("report.plots", "draw_image")(self, quantity, ax, **figure)

    @check_arguments
    def to_xarray(self, factors: Factors | None = None) -> Dataset:
        """Return the image, and where known its uncertainty and depths, as an ``xarray.Dataset`` with units.

        The ``factors`` that it was solved with give coordinates in mm.
        """
        return from_above("exchange.other_programs", "label_image")(self, factors)

    def __repr__(self) -> str:
        rows, columns = self.image.shape
        return f"Reconstruction({rows} x {columns}: {self.status.verdict.value}, residual {self.residual:.1e})"

    def _repr_html_(self) -> str:
        facts = {"lambda": f"{self.lam:.3g}", "residual of the frames": f"{self.residual:.1e}"}
        unit = "electrons/s" if POINT_SPREAD in self.inputs else "reflectance"
        pictures = {f"{unit} 0 to {self.white:.3g}": self.image / self.white}
        if self.uncertainty is not None:
            caption = f"standard uncertainty of each pixel\n{span(self.uncertainty, 'of reflectance')}"
            pictures[caption] = normalise(self.uncertainty)
        if self.depths:
            pictures[f"depth of each pixel\n{span(self.depths.mm, 'mm')}"] = normalise(self.depths.mm)
        lines = str(self.status), *self.trust, *self.limits
        return card(f"Reconstruction: {self.status.verdict.value}", pictures, lines, facts)


def _check_stored(more: object) -> None:
    try:
        plain(more)
    except TypeError as error:
        raise ArgumentError("more", f"cannot be stored ({error})") from None


def may_replace(folder: Path, asked: Mapping[str, str | float], overwrite: bool) -> bool:
    """Return True if ``folder`` contains an image that may be replaced, False if it contains none."""
    result = folder / RESULT_FILE
    if not (result.is_file() or (folder / IMAGE_FILE).is_file()):
        return False
    if not overwrite:
        check_same_inputs(folder, read_json(result) if result.is_file() else {}, asked)
    return True


def read_result(folder: Path) -> dict[str, Any]:
    result = read_json(folder / RESULT_FILE)
    if not isinstance(result, dict) or result.get("status") == _INCOMPLETE:
        raise MitsimError(f"{folder / RESULT_FILE}: holds no result of a finished image; reconstruct it again")
    verify_files(folder, result.get("checksums"), "reconstruct it again")
    return result


def check_same_inputs(folder: Path, head: object, asked: Mapping[str, str | float]) -> None:
    earlier = head.get("inputs") if isinstance(head, dict) else None
    earlier = earlier if isinstance(earlier, dict) else {}
    changed = [name for name in {**asked, **earlier} if earlier.get(name) != asked.get(name)]
    if changed:
        words = f"holds an image of other inputs ({', '.join(changed)} differ)"
        raise MitsimError(f"output {folder}: {words}; choose another folder, or replace it with overwrite=True")


# ---- From shots and factors to an image ------------------------------------------------------------------------------


@takes(ImageRequest)
def reconstruct(
    shots: Capture,
    factors: Factors,
    lam: float | Literal["auto"] = "auto",
    method: str | Solver = TIKHONOV,
    **options: Any,
) -> Reconstruction:
    """Recover the image from a capture and a calibration.

    Parameters
    ----------
    shots
        Capture in memory, or of :func:`mitsim.core.runs.load_run`; frames on disk are read one at a time.
    factors
        Factors of the same camera.
    lam
        Lambda >= 0 in the unit of (Phi_L Phi_R)^2, for ``tv`` the weight of the total variation; "auto" chooses it from
        the data.
    method
        ``tikhonov`` (closed form, independent pixels), ``markov`` (closed form, correlated neighbours), ``nonnegative``
        (Tikhonov's solution of at least 0), ``tv`` (least total variation), or a solver, such as a trained network
        (:func:`mitsim.load_network`).

    Raises
    ------
    MitsimError
        For a capture and factors that do not fit each other, a frame that cannot be read, too little memory, another
        lambda, method, focus or range, or a calibration without parallax where that is needed.
    """
    return reconstruct_request(shots, factors, ImageRequest(lam=lam, method=method, **options))


@single_threaded_blas()
def reconstruct_request(
    shots: Capture, factors: Factors, request: ImageRequest, job: Job | None = None
) -> Reconstruction:
    asked, lam, doubts = request.inputs(shots, factors), request.lam, list[str]()
    solver = check_image(shots, factors, request)
    # Depths that are looked for, and total variation, take as long as the data ask for.
    cost = ImageCost.of(shots, factors) if request.method == TIKHONOV and not request.looks_for_depth else None
    if cost:
        Cost(sum(cost.seconds.values()), cost.memory_bytes).check(f"{shots.name}: its image", Limits())
    clock = (job or Job()).apart("").clock
    focus: Depth | DepthMap | None = None
    if request.focus is not None:
        with clock.stage("focus"):
            if request.focus == "map":
                focus = depth_map(shots, factors, lam, request.depth_range)
            elif request.focus == "volume":
                focus = solve_volume(shots, factors, request, lam)
            elif request.focus == "auto":
                focus = best_depth(shots, factors, request.depth_range)
            else:
                focus = Depth(float(request.focus))
        doubts.append(focus.doubt)
    if isinstance(focus, Depth):
        of_depth = move_factors(factors, focus.mm)
        shots, factors = of_depth.of(shots), of_depth.factors
        if of_depth.hidden:
            hidden = f"{of_depth.hidden:.1%} of the scene's pixels, which come out dark"
            doubts.append(f"At {focus.mm:.4g} mm the field stop takes most of the light of {hidden}.")
    depths = focus if isinstance(focus, DepthMap) and not focus.doubt else None
    with clock.stage("accumulate"):
        data = accumulate(shots, factors, solver, **request.iterative)
    with clock.stage("solve"):
        if isinstance(focus, Volume):
            solution = focus.solution
        elif depths:
            solved = Status(Verdict.SOLVED, "Solved: a depth and a reflectance for each projector pixel")
            residual = float(np.sqrt(depths.left_over / depths.energy))
            solution = Solution(depths.image, depths.lam, residual, solved)
        else:
            solution = data.solution(lam)
    with clock.stage("misfit"):
        # Depths in steps of a pixel of parallax leave more than noise, and the residual states it.
        misfit: Misfit | None = None
        if not isinstance(focus, Volume):
            data, solution, misfit = _judge(data, solution, depths, lam)
    with clock.stage("uncertainty"):
        shown = misfit.chi_square if misfit else 1.0
        one_depth = not (depths or isinstance(focus, Volume))
        uncertainties = uncertainty(data, solution, shown) if solver.linear and one_depth else None
        if uncertainties and misfit and misfit.picture and shots.manifest.plan is None:
            # Of a simulated run the lamp and the place of every frame are known.
            frames = misfit.picture.uncertainty(solution.image)
            uncertainties = replace(uncertainties, sources={**uncertainties.sources, "frames": frames})
    focused = request.focus is not None or factors.manifest.parallax is None
    status, image = misfit.judge(solution.status, focused) if misfit else solution.status, solution.image
    doubts.append(uncertainties.loss(image) if uncertainties else "")
    inherited = each_once({"the capture": data.shots.warnings, "the calibration": factors.warnings})
    flags = (*status.flags, *filter(None, doubts), *inherited)
    left, right = data.model.sides
    return Reconstruction(
        **{**vars(solution), "image": image, "status": replace(status, flags=flags)},
        rank=data.prepared.rank,
        condition=data.prepared.condition,
        rank_sides=(left.rank, right.rank),
        condition_sides=(left.condition, right.condition),
        misfit=misfit,
        uncertainties=uncertainties,
        seconds={stage: spent for stage, spent in clock.seconds().items() if stage != "total"},
        inputs=asked,
        focus=focus,
        predicted=cost,
    )


def check_image(shots: Capture, factors: Factors, request: ImageRequest) -> Solver:
    solver = SOLVERS[request.method] if isinstance(request.method, str) else request.method
    factors.check_fit(shots)
    if request.focus is not None:
        parallax_of(factors)
    if isinstance(request.focus, (int, float)):
        move_factors(factors, float(request.focus))
    check_factorising(shots, factors, solver)
    return solver


def depth_misfit(depths: DepthMap, noise: FrameNoise, factor_energy: float | None, print_energy: float) -> Misfit:
    spare = 1 - 2 * depths.image.size / depths.data  # a reflectance and a depth for each pixel
    variance = float(noise.variance.mean()) * depths.data * spare
    expected = variance + depths.part * (noise.rendering + depths.smoothing * (factor_energy or 0.0))
    whole = depths.left_over, depths.energy, expected, depths.data / noise.variance.size
    energies = tuple(np.array([[value]]) for value in whole)
    return weigh(energies, factor_energy is not None, noise, depths.part * print_energy)[0]


def _judge(
    data: Accumulation, solution: Solution, depths: DepthMap | None, lam: float | Literal["auto"]
) -> tuple[Accumulation, Solution, Misfit | None]:
    if depths:
        image = depths.image
        misfit = depth_misfit(depths, data.noise, data.factor_energy(image), print_energy(data.model, image))
        # At the depth of most of the scene a frame that is not what it says is off by more than depth puts it.
        most = move_factors(data.factors, float(np.median(depths.mm)))
        faults = faulty_frames(accumulate(most.of(data.shots), most.factors), image, depths.lam)
        return data, solution, replace(misfit, flagged=True, cause=Cause.FRAMES, faults=faults) if faults else misfit
    found = find_misfit(data, solution)
    if found and found.defects:
        defects, now, whole = None, found, data
        for _ in range(6):
            if now.defects is None:
                break
            defects = now.defects.with_others(defects)
            data = accumulate(LeftOut(whole, defects), whole.factors, whole.solver, **whole.iterative)
            solution = data.solution(lam)
            now = find_misfit(data, solution) or now
        if now.flagged:
            now = find_misfit(data, solution, with_defects=False) or now
        if now.flagged and now.unexplained > 0.5 * found.unexplained:
            data, solution = whole, whole.solution(lam)
            found = find_misfit(data, solution, with_defects=False)
        else:
            found = replace(now, defects=defects)
    explained = data.factors.status.verdict is not Verdict.NOT_SEPARABLE and not (found and found.flagged)
    if data.solver.linear and lam == "auto" and (data.factors.lacking or not explained):
        solution = data.prepared.solve(data.frames, lam, explained=explained, lack=data.lack(solution.image))
    return data, solution, found

"""`mitsim reconstruct` of a run behind colour filters: frames of all lines at once and each line's factors in, an image
of each line and one in colour out.

*Demosaiced*: every frame becomes three whole ones (colour-demosaicing), a solve for each channel, and channels are
taken apart into lines. *Half resolution*: a solve for each plane of filters with its own rows of the factors, no pixel
interpolated. *Joint*: all planes for all lines (:mod:`mitsim.reconstruct.colour`). A channel or plane that sees several
lines has the one factor that is nearest to them; only the joint solve knows that each line has its own.

Lambda is found without a truth: each plane, or channel, chooses its own as any other frames do
(:mod:`mitsim.reconstruct.solver`), and the joint solve takes the geometric mean of the planes'. They have the
same scene, and nearly the same noise, which lambda weighs against each other.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from mitsim.core import spectral_manifests
from mitsim.core.arrays import FloatArray
from mitsim.core.exr import write_frame
from mitsim.core.files import output_folder, read_json, write_bytes
from mitsim.core.images import png
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import MosaicCapture, load_mosaic
from mitsim.core.spectral_manifests import JOINT, check_way
from mitsim.devices.chart import ChartPlace
from mitsim.metrics import Quality
from mitsim.optics.terms import BestTerm, best_term
from mitsim.reconstruct.colour import PLANES, JointMosaic
from mitsim.reconstruct.factors import Factors, load_calibration
from mitsim.reconstruct.misfit import UNEXPLAINED
from mitsim.reconstruct.reconstruct import check_same_inputs
from mitsim.reconstruct.request import IMAGE_FILE, PICTURE_FILE, check_joint
from mitsim.reconstruct.solution import Solution
from mitsim.reconstruct.solver import automatic_lambda, prepare
from mitsim.report.colour_image import ColourImage, JudgedColours, begin_image, board_of

# ---- From a run to its images ----


@single_threaded_blas()
def reconstruct_mosaic(
    run: Path | str,
    calibration: Path | str,
    output: Path | str,
    chart: ChartPlace | None = None,
    overwrite: bool = False,
    origin: Mapping[str, Any] | None = None,
    **options: Any,
) -> JudgedColours:
    """Recover the image of every line of a run behind colour filters, and bring them together.

    Writes image.exr and image.png in colour and of each line, and colour.json.

    Parameters
    ----------
    run, calibration
        folders of `mitsim capture --colour mosaic` and `mitsim calibrate --colour mosaic`.
    output, chart, overwrite
        as :func:`mitsim.report.quality.reconstruct_colours`.
    origin
        entries of colour.json on where the image comes from.
    **options
        ``way``, one of :data:`mitsim.core.spectral_manifests.WAYS`, and ``lam``, lambda above 0 in the unit of
        (Phi_L Phi_R)^2, of each plane or channel where these are solved one by one; ``auto`` chooses it from the data.

    Raises
    ------
    MitsimError
        for folders that do not fit each other, a way that there is not, and as
        :func:`mitsim.report.quality.reconstruct_colours`.
    """
    started = time.perf_counter()
    way, lam = _checked_options(**options)
    run, calibration = Path(run), Path(calibration)
    shots = load_mosaic(run)
    factors = fitting_factors(shots, calibration)
    inputs: dict[str, str | float] = {
        "run": shots.shots.fingerprint, "calibration": "-".join(each.fingerprint for each in factors.values()),
        "mosaic": way, "lambda": lam,
    }  # fmt: skip
    replaces = _may_replace(Path(output), inputs, overwrite)
    with output_folder(output, overwrite=replaces) as folder:
        read = time.perf_counter()
        camera = MosaicCamera.of(
            [(each.left, each.right) for each in factors.values()], shots.weights, shots.manifest.mosaic
        )
        solver = solver_of(way, camera, shots.shots.patterns)
        noise = _add_frames(solver, shots, (len(camera.lefts[0]), len(camera.rights[0])))
        added = time.perf_counter()
        solved = solver.images(lam)
        ended = time.perf_counter()
        board = board_of(calibration, shots.manifest)
        truth = shots.truth(board)
        images = np.moveaxis(solved.images, 0, -1)
        qualities = _qualities(shots, images, truth, board)
        unexplained = _unexplained(solved.residual, noise, factors.values())
        steps = "" if solved.joint is None else f", {solved.joint.iterations} steps"
        left = f"residual {solved.residual:.1e}, {unexplained:.1e} unexplained"
        found = JudgedColours(
            colours=ColourImage.of(shots.manifest, images, board, truth, chart),
            qualities=qualities,
            described=[
                *(f"{name}: {each or 'no truth to compare with'}" for name, each in qualities.items()),
                f"{way}: lambda {solved.lam:.3g}{steps}, {left}",
            ],
            facts={
                "frames": "all lines at once, behind colour filters",
                "solved": f"{way}{steps}",
                "lambda": f"{solved.lam:.3g}",
                "residual of the frames": f"{solved.residual:.1e}, of which {unexplained:.1e} is unexplained",
            },
            warnings=_warnings(shots, factors, solved, unexplained),
            seconds={
                "read": read - started,
                "accumulate": added - read,
                "solve": ended - added,
                "total": time.perf_counter() - started,
            },
            output=str(folder),
            solution={
                "mosaic": way,
                "lambda": solved.lam,
                "steps": solved.joint and solved.joint.iterations,
                "residual": solved.residual,
                "unexplained": unexplained,
            },
        )
        begin_image(folder, shots.manifest, inputs=inputs)
        for name, image in zip(shots.manifest.names, solved.images, strict=True):
            with output_folder(folder / name, overwrite=True) as place:
                write_frame(place / IMAGE_FILE, {"reflectance": image.astype(np.float32)}, {"lambda": solved.lam})
                write_bytes(place / PICTURE_FILE, png(image))
        found.write(folder, inputs=inputs, **(origin or {}))
    return found


def _checked_options(way: str = JOINT, lam: Lambda = "auto") -> tuple[str, Lambda]:
    check_way(way)
    check_joint(lam)
    return way, lam


def fitting_factors(shots: MosaicCapture, calibration: Path) -> dict[str, Factors]:
    """Factors of every line of ``shots``, by its name, from a ``calibration`` of the same lines and camera.

    MitsimError for one of others.
    """
    spectral_manifests.check_lines(shots.manifest, shots.shots.name, calibration)
    found = {name: load_calibration(calibration / name) for name in shots.manifest.names}
    for factors in found.values():
        factors.check_fit(shots.shots)
    return found


# ---- Unexplained energy, quality and warnings ----


def _add_frames(solver: Solver, shots: MosaicCapture, shape: tuple[int, int]) -> float:
    """Every frame of ``shots`` (``shape``) added to a ``solver``; returns the part of their squares that is noise."""
    data = noise = 0.0
    for each in shots.shots.pattern_measurements(shape):
        solver.add(each.frame, each.row, each.column)
        data += float(np.square(each.frame).sum())
        noise += float(np.maximum(shots.shots.manifest.digital.variance(each.light, each.shots), 0.0).sum())
    return noise / data if data else 0.0


def _unexplained(residual: float, noise: float, factors: Iterable[Factors]) -> float:
    """Part of the data, rms, that a ``residual`` has beyond ``noise`` and the noise of ``factors``, lines' own."""
    explained = 0.0
    for each in factors:
        if (own := each.manifest.noise) is not None:
            sides = (own.left, each.left), (own.right, each.right)
            explained = max(explained, sum(s**2 * side.size / float(np.square(side).sum()) for s, side in sides))
    return float(np.sqrt(max(residual**2 - noise - explained, 0.0)))


def _qualities(
    shots: MosaicCapture, images: FloatArray, truth: FloatArray | None, board: float | None
) -> dict[str, Quality | None]:
    names = shots.manifest.names
    if truth is None:
        return dict.fromkeys(names)
    errors = [
        float(np.sqrt(np.square(own.standard_error).mean())) * own.board / (board or own.board)
        for own in (shots.truths[name] for name in names)
    ]
    return {
        name: Quality.of(images[..., number], truth[..., number], errors[number]) for number, name in enumerate(names)
    }


def _warnings(
    shots: MosaicCapture, factors: Mapping[str, Factors], solved: LineImages, unexplained: float
) -> tuple[str, ...]:
    warnings = []
    if solved.joint is not None and not solved.joint.ok:
        warnings.append(
            f"Not converged: {solved.joint.iterations} steps leave {solved.joint.residual:.1e} of the normal "
            "equations; raise lambda."
        )
    if unexplained > UNEXPLAINED:
        warnings.append(
            f"Misfit: {unexplained:.1e} of the measurements are explained by no image of these lines, beyond noise; "
            "look for depth, light over several surfaces or another camera than was calibrated."
        )
    warnings += [f"The capture was flagged: {text.rstrip('.')}." for text in shots.warnings]
    warnings += [
        f"The calibration of {name} was flagged: {text.rstrip('.')}."
        for name, each in factors.items()
        for text in each.warnings
    ]
    return tuple(warnings)


def _may_replace(folder: Path, options: Mapping[str, str | float], overwrite: bool) -> bool:
    """Whether a ``folder`` holds an image that may be replaced: ``overwrite``, or of the same inputs ``asked`` for.

    MitsimError where it holds one of others."""
    if not (folder / spectral_manifests.COLOUR).is_file():
        return False
    spectral_manifests.read_colours(folder, spectral_manifests.IMAGE)
    if not overwrite:
        check_same_inputs(folder, read_json(folder / spectral_manifests.COLOUR), options)
    return True


# ---- A camera under a mosaic of colour filters ----

Patterns = tuple[FloatArray, FloatArray]
Lambda = float | Literal["auto"]


@dataclass(frozen=True, eq=False)
class MosaicCamera:
    """A camera under a mosaic of colour filters.

    Attributes
    ----------
    lefts, rights
        (lines, m, n) and (lines, m', n') factors of each line, of pixels without filters.
    weights
        (4, lines) what pixels of each plane of 2 x 2 see of each line.
    mosaic
        colours of these four, such as ``RGGB``.
    """

    lefts: FloatArray
    rights: FloatArray
    weights: FloatArray
    mosaic: str

    @classmethod
    def of(cls, factors: Sequence[tuple[FloatArray, FloatArray]], weights: FloatArray, mosaic: str) -> MosaicCamera:
        """Of all lines' factors.

        Parameters
        ----------
        factors
            (left, right) of each line.
        weights, mosaic
            as above.
        """
        lefts, rights = (np.stack(side) for side in zip(*factors, strict=True))
        return cls(lefts, rights, weights, mosaic)

    def term(self, weights: FloatArray) -> BestTerm:
        """The one separable camera that is nearest to that of a plane's ``weights`` (lines,) of all lines."""
        pairs = zip(weights, self.lefts, self.rights, strict=True)
        return best_term([(weight * left, right) for weight, left, right in pairs])

    def mixing(self, weights: FloatArray, terms: Sequence[BestTerm]) -> FloatArray:
        """(terms, lines) part of each line's image in those that are solved with single ``terms`` of some ``weights``
        (terms, lines): what the term has of the line's own."""
        return np.array(
            [
                [
                    weight * np.vdot(left, term.left) * np.vdot(right, term.right)
                    for weight, left, right in zip(row, self.lefts, self.rights, strict=True)
                ]
                / (np.square(np.linalg.norm(term.left)) * np.square(np.linalg.norm(term.right)))
                for row, term in zip(weights, terms, strict=True)
            ]
        )


# ---- Ways from frames to images of the lines ----


@dataclass(frozen=True, eq=False)
class LineImages:
    """Images of all lines by one way.

    Attributes
    ----------
    images
        (lines, n, n') reflectances.
    lam
        lambda of the joint solve, or the geometric mean of those of the planes or channels.
    residual
        ||Y - model|| / ||Y|| over all frames, of planes or channels as they were solved.
    joint
        the joint solution; None of other ways.
    """

    images: FloatArray
    lam: float
    residual: float
    joint: Solution | None = None


class Solver(Protocol):
    """One way from frames to images of the lines."""

    def add(self, frame: FloatArray, row: int, column: int) -> None:
        """Add what was measured under one pattern.

        Parameters
        ----------
        frame
            (m, m') [electrons/s].
        row, column
            of the pattern.
        """

    def images(self, lam: Lambda, relative: bool = False) -> LineImages:
        """Images of all lines from what was added, with a lambda ``lam``: a number, ``relative`` to the largest sigma^2
        where asked for, or ``auto``."""


def solver_of(way: str, camera: MosaicCamera, patterns: Patterns) -> Solver:
    """A solver without frames.

    Parameters
    ----------
    way, camera
        one of :data:`mitsim.core.spectral_manifests.WAYS`, and the camera.
    patterns
        P_L (n, K) and P_R (n', K').

    Raises
    ------
    MitsimError
        as :func:`check_way`, and for factors that do not fit.
    """
    if check_way(way) == JOINT:
        return _Joint(camera, patterns)
    return _Apart(camera, patterns, way == spectral_manifests.HALF)


class _Apart:
    """A solve for each plane, or for each channel of demosaiced frames, whose images are then taken apart."""

    def __init__(self, camera: MosaicCamera, patterns: Patterns, half: bool) -> None:
        self._half, self._mosaic = half, camera.mosaic
        self.weights = camera.weights if half else camera.weights[[camera.mosaic.index(name) for name in "RGB"]]
        terms = [camera.term(weights) for weights in self.weights]
        places = PLANES if half else [(None, None)] * 3
        self.models = [
            prepare(*(term.left[a::2], term.right[b::2]) if half else (term.left, term.right), *patterns)
            for term, (a, b) in zip(terms, places, strict=True)
        ]
        self._undo = np.linalg.pinv(camera.mixing(self.weights, terms))
        self._sums = [model.accumulator() for model in self.models]

    def add(self, frame: FloatArray, row: int, column: int) -> None:
        parts = planes_of(frame) if self._half else np.moveaxis(demosaic(frame, self._mosaic), -1, 0)
        for total, part in zip(self._sums, parts, strict=True):
            total.add(part, row, column)

    def lambdas(self) -> FloatArray:
        """(planes or channels,) lambda that each chooses from its own data."""
        pairs = zip(self.models, self._sums, strict=True)
        return np.array([automatic_lambda(model.problem(total)) for model, total in pairs])

    def images(self, lam: Lambda, relative: bool = False) -> LineImages:
        if isinstance(lam, str):
            lambdas = self.lambdas()
        else:
            pairs = zip(self.models, self._sums, strict=True)
            lambdas = np.array([lam * (model.problem(total).scale if relative else 1) for model, total in pairs])
        solved = zip(self.models, self._sums, lambdas, strict=True)
        found = [model.solve(total, float(own)) for model, total, own in solved]
        left = sum(each.residual**2 * total.energy for each, total in zip(found, self._sums, strict=True))
        images = np.tensordot(self._undo, np.stack([each.image for each in found]), axes=1)
        return LineImages(images, _geometric(lambdas), float(np.sqrt(left / self.energy)))

    @property
    def energy(self) -> float:
        """Sum of the squares of all that was added."""
        return sum(total.energy for total in self._sums)


class _Joint:
    """All planes for all lines together."""

    def __init__(self, camera: MosaicCamera, patterns: Patterns) -> None:
        self._planes = _Apart(camera, patterns, half=True)
        self._model = JointMosaic(camera.lefts, camera.rights, camera.weights, *patterns)
        self._gathered = np.zeros(self._model.shape)

    def add(self, frame: FloatArray, row: int, column: int) -> None:
        self._gathered += self._model.gather(frame, row, column)
        self._planes.add(frame, row, column)

    def images(self, lam: Lambda, relative: bool = False) -> LineImages:
        if isinstance(lam, str):
            lam = _geometric(self._planes.lambdas())
        elif relative:
            lam *= self._model.scale
        found = self._model.solve(self._gathered, lam)
        energy, images = self._planes.energy, found.image
        left = energy + float(np.vdot(images, self._model.normal(images) - 2 * self._gathered))
        return LineImages(images, lam, float(np.sqrt(max(left, 0.0) / energy)), found)


# ---- Planes of filters, and demosaicing ----


def planes_of(frame: FloatArray) -> list[FloatArray]:
    """(m / 2, m' / 2) pixels of a ``frame`` (m, m') in each plane of 2 x 2."""
    return [frame[a::2, b::2] for a, b in PLANES]


def demosaic(frame: FloatArray, mosaic: str) -> FloatArray:
    """(m, m', 3) red, green and blue of a ``frame`` (m, m') behind a ``mosaic`` such as RGGB (Menon and others 2007).

    MitsimError without colour-demosaicing.
    """
    check_way(spectral_manifests.DEMOSAIC)
    from colour_demosaicing import demosaicing_CFA_Bayer_Menon2007

    return np.asarray(demosaicing_CFA_Bayer_Menon2007(frame, mosaic), dtype=np.float64)


def _geometric(values: FloatArray) -> float:
    """Their geometric mean; 0 where one is 0."""
    return float(np.exp(np.mean(np.log(values)))) if (values > 0).all() else 0.0

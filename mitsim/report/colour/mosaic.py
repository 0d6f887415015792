"""`mitsim reconstruct` of a run behind colour filters: frames of all lines at once and each line's factors in, an image
of each line and one in colour out."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.exr import write_frame
from mitsim.core.files import output_folder, read_json, whole_file
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.pictures import png
from mitsim.core.runs import MosaicCapture, load_mosaic
from mitsim.core.spectral_manifests import (
    COLOUR,
    IMAGE,
    JOINT,
    ColourManifest,
    check_lines,
    check_way,
    read_colours,
    write_colours,
)
from mitsim.devices.chart import ChartPlace
from mitsim.metrics import Quality
from mitsim.reconstruct.factors import Factors, load_calibration
from mitsim.reconstruct.misfit import UNEXPLAINED
from mitsim.reconstruct.request import IMAGE_FILE, check_joint
from mitsim.reconstruct.result import check_same_inputs
from mitsim.report.colour.image import ColourImage, board_of
from mitsim.report.colour.page import PAGE, write_page
from mitsim.report.colour.ways import Lambda, LineImages, MosaicCamera, Solver, solver_of


@dataclass(frozen=True, eq=False)
class JudgedMosaic:
    """Images of all lines from frames behind colour filters.

    Attributes
    ----------
    colours
        the image in colour.
    solved
        images of the lines, and lambda.
    way
        one of :data:`mitsim.core.spectral_manifests.WAYS`.
    qualities
        of each line's image by its name; None without a truth.
    unexplained
        rms part of the measurements that neither noise nor the factors' noise explains.
    warnings
        what is wrong with the images.
    seconds
        by stage.
    output
        the folder that holds all.
    """

    colours: ColourImage
    solved: LineImages
    way: str
    qualities: Mapping[str, Quality | None]
    unexplained: float
    warnings: tuple[str, ...]
    seconds: Mapping[str, float]
    output: str

    @property
    def ok(self) -> bool:
        """Whether the images can be used as they are."""
        return not self.warnings

    def summary(self) -> dict[str, Any]:
        """All but the pictures, by the keys of the command line's JSON."""
        known = [found.ssim for found in self.qualities.values() if found and found.ssim]
        joint = self.solved.joint
        return {
            "mosaic": self.way,
            "channels": [
                {
                    **line.model_dump(),
                    "psnr": (found := self.qualities[line.name]) and found.psnr_db,
                    "ssim": found and found.ssim,
                    "truth_error": found and found.truth_error,
                }
                for line in self.colours.lines.channels
            ],
            "ssim": float(np.mean(known)) if known else None,
            **self.colours.summary(),
            "lambda": self.solved.lam,
            "steps": None if joint is None else joint.steps,
            "residual": self.solved.residual,
            "unexplained": self.unexplained,
            "status": " ".join(self.warnings) or "Solved: every line's image can be used as it is.",
            "seconds": dict(self.seconds),
            "output": self.output,
        }

    @property
    def sentences(self) -> list[str]:
        """What the command line says of it."""
        each = [f"{name}: {found or 'no truth to compare with'}" for name, found in self.qualities.items()]
        steps = "" if self.solved.joint is None else f", {self.solved.joint.steps} steps"
        told = (
            f"{self.way}: lambda {self.solved.lam:.3g}{steps}, residual {self.solved.residual:.1e}, "
            f"{self.unexplained:.1e} unexplained"
        )
        return [*each, told, *self.colours.sentences]

    @property
    def facts(self) -> dict[str, str]:
        """How the images were made, by name."""
        steps = "" if self.solved.joint is None else f", {self.solved.joint.steps} steps"
        return {
            "frames": "all lines at once, behind colour filters",
            "solved": f"{self.way}{steps}",
            "lambda": f"{self.solved.lam:.3g}",
            "residual of the frames": f"{self.solved.residual:.1e}, of which {self.unexplained:.1e} is unexplained",
        }

    def _repr_html_(self) -> str:
        return self.colours._repr_html_()


@single_threaded_blas()
def reconstruct_mosaic(
    run: Path | str,
    calibration: Path | str,
    output: Path | str,
    chart: ChartPlace | None = None,
    overwrite: bool = False,
    way: str = JOINT,
    lam: Lambda = "auto",
) -> JudgedMosaic:
    """Recover the image of every line of a run behind colour filters, and bring them together.

    Writes image.exr and image.png in colour and of each line, colour.json and report.html.

    Parameters
    ----------
    run, calibration
        folders of `mitsim capture --colour mosaic` and `mitsim calibrate --colour mosaic`.
    output, chart, overwrite
        as :func:`mitsim.report.colour.by_line.reconstruct_colours`.
    way
        one of :data:`mitsim.core.spectral_manifests.WAYS`.
    lam
        lambda above 0 in the unit of (Phi_L Phi_R)^2, of each plane or channel where these are solved one by one;
        ``auto`` chooses it from the data.

    Raises
    ------
    MitsimError
        for folders that do not fit each other, a way that there is not, and as
        :func:`mitsim.report.colour.by_line.reconstruct_colours`.
    """
    started = time.perf_counter()
    check_way(way)
    check_joint(lam)
    run, calibration = Path(run), Path(calibration)
    shots = load_mosaic(run)
    factors = fitting_factors(shots, calibration)
    asked: dict[str, str | float] = {
        "run": shots.shots.fingerprint, "calibration": "-".join(each.fingerprint for each in factors.values()),
        "mosaic": way, "lambda": lam,
    }  # fmt: skip
    replaces = _may_replace(Path(output), asked, overwrite)
    with output_folder(output, overwrite=replaces) as folder:
        read = time.perf_counter()
        camera = MosaicCamera.of(
            [(each.left, each.right) for each in factors.values()], shots.weights, shots.manifest.mosaic
        )
        solver = solver_of(way, camera, shots.shots.patterns)
        sums = _added(solver, shots, (len(camera.lefts[0]), len(camera.rights[0])))
        added = time.perf_counter()
        solved = solver.images(lam)
        ended = time.perf_counter()
        board = board_of(calibration, shots.manifest)
        truth = shots.truth(board)
        images = np.moveaxis(solved.images, 0, -1)
        lines = ColourManifest(kind="colour-image", channels=shots.manifest.channels)
        unexplained = sums.unexplained(solved.residual, list(factors.values()))
        found = JudgedMosaic(
            colours=ColourImage.of(lines, images, board, truth, chart),
            solved=solved,
            way=way,
            qualities=_qualities(shots, images, truth, board),
            unexplained=unexplained,
            warnings=_warnings(shots, factors, solved, unexplained),
            seconds={
                "read": read - started,
                "accumulate": added - read,
                "solve": ended - added,
                "total": time.perf_counter() - started,
            },
            output=str(folder),
        )
        _write(found, folder, asked)
    return found


def fitting_factors(shots: MosaicCapture, calibration: Path) -> dict[str, Factors]:
    """Factors of every line of ``shots``, by its name, from a ``calibration`` of the same lines and camera.

    MitsimError for one of others.
    """
    check_lines(shots.manifest, shots.shots.name, calibration)
    found = {name: load_calibration(calibration / name) for name in shots.manifest.names}
    for factors in found.values():
        factors.check_fit(shots.shots)
    return found


@dataclass(frozen=True)
class _Energies:
    """Sums over all data of a run: of their squares, and of their noise's variances."""

    data: float
    noise: float

    def unexplained(self, residual: float, factors: list[Factors]) -> float:
        """Part of the data, rms, that a ``residual`` has beyond noise and the noise of ``factors``, lines' own."""
        own = [each.manifest.noise for each in factors]
        told = 0.0
        for each, noise in zip(factors, own, strict=True):
            if noise is not None:
                sides = (noise.left, each.left), (noise.right, each.right)
                told = max(told, sum(s**2 * side.size / float(np.square(side).sum()) for s, side in sides))
        left = residual**2 - (self.noise / self.data if self.data else 0.0) - told
        return float(np.sqrt(max(left, 0.0)))


def _added(solver: Solver, shots: MosaicCapture, shape: tuple[int, int]) -> _Energies:
    """Every frame of ``shots`` (``shape``) added to a ``solver``."""
    data = noise = 0.0
    for each in shots.shots.measured(shape):
        solver.add(each.frame, each.row, each.column)
        data += float(np.square(each.frame).sum())
        noise += float(np.maximum(shots.shots.manifest.digital.variance(each.light, each.shots), 0.0).sum())
    return _Energies(data, noise)


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
    said = []
    if solved.joint is not None and not solved.joint.converged:
        said.append(
            f"Not converged: {solved.joint.steps} steps leave {solved.joint.residual:.1e} of the normal equations; "
            "raise lambda."
        )
    if unexplained > UNEXPLAINED:
        said.append(
            f"Misfit: {unexplained:.1e} of the measurements are explained by no image of these lines, beyond noise; "
            "look for depth, light over several surfaces or another camera than was calibrated."
        )
    said += [f"The capture was flagged: {text.rstrip('.')}." for text in shots.warnings]
    said += [
        f"The calibration of {name} was flagged: {text.rstrip('.')}."
        for name, each in factors.items()
        for text in each.warnings
    ]
    return tuple(said)


def _may_replace(folder: Path, asked: Mapping[str, str | float], overwrite: bool) -> bool:
    """Whether a ``folder`` holds an image that may be replaced: ``overwrite``, or of the same inputs ``asked`` for.

    MitsimError where it holds one of others."""
    if not (folder / COLOUR).is_file():
        return False
    read_colours(folder, IMAGE)
    if not overwrite:
        check_same_inputs(folder, read_json(folder / COLOUR), asked)
    return True


def _write(found: JudgedMosaic, folder: Path, asked: Mapping[str, str | float]) -> None:
    """All files of an image, colour.json last."""
    for number, name in enumerate(found.colours.lines.names):
        place, image = folder / name, found.solved.images[number]
        with output_folder(place, overwrite=True):
            write_frame(place / IMAGE_FILE, {"reflectance": image.astype(np.float32)}, {"lambda": found.solved.lam})
            with whole_file(place / "image.png") as part:
                part.write_bytes(png(image))
    found.colours.write(folder)
    write_page(folder / PAGE, found.colours, found.qualities, found.facts, found.warnings)
    parts = {key: value for key, value in found.summary().items() if key != "channels"}
    write_colours(folder, found.colours.lines, inputs=dict(asked), **parts)

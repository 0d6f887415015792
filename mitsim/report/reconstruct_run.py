"""Images of a run's spectral lines from the folders RUN and CAL, compared with the truth where there is one.

A run has one unnamed line, a folder for each line, or frames of all lines behind colour filters.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mitsim.core import colour_files
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import takes
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.exr import write_frame
from mitsim.core.files import output_folder, read_json, write_bytes
from mitsim.core.headline import each_once, image_headline
from mitsim.core.images import png
from mitsim.core.job import Job
from mitsim.core.manifests import CalibrationManifest, read_manifest
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import load_mosaic, load_run
from mitsim.devices.camera import load_psf_channels
from mitsim.devices.framelist import ChartPlace
from mitsim.metrics import Quality, summary_of, truth_error_for, truth_for
from mitsim.optics.terms import best_term
from mitsim.reconstruct.colour import PLANES, ColourModel, JointMosaic
from mitsim.reconstruct.factors import load_calibration
from mitsim.reconstruct.misfit import UNEXPLAINED
from mitsim.reconstruct.reconstruct import MADE_OF, Reconstruction, check_same_inputs, may_replace, reconstruct_request
from mitsim.reconstruct.request import IMAGE_FILE, LIST, PICTURE_FILE, ImageRequest, check_joint
from mitsim.reconstruct.solver import Solution, automatic_lambda, prepare
from mitsim.report.folder_page import ColourImage, report_folder, state_image

_LEAST = 1e-300

# -------- The image of one line


@dataclass(frozen=True)
class Judged:
    """A reconstruction, its folder, and its quality against the truth (None for a real camera)."""

    reconstruction: Reconstruction
    quality: Quality | None
    output: str
    truth: FloatArray | None = None

    def summary(self) -> dict[str, Any]:
        result = {**summary_of(self.quality), **self.reconstruction.summary(), "output": self.output}
        return {"headline": image_headline(result, result["warnings"]), **result}


def reconstruct(
    run: Path, calibration: Path, output: Path, overwrite: bool = False, job: Job | None = None, **options: Any
) -> Judged:
    """Recover the image of a run with a calibration, and write image.exr, image.png and result.json.

    ``output`` is a new or empty folder, or one with an earlier image of the same inputs (of other inputs with
    ``overwrite``). The ``options`` are those of :class:`mitsim.reconstruct.request.ImageRequest`.

    Raises
    ------
    MitsimError
        For folders that do not fit each other, options that are not allowed, or an output that cannot be written.
    """
    started, job, request = time.perf_counter(), job or Job(), ImageRequest(**options)
    with job.clock.stage("read"):
        shots, factors = load_run(run), load_calibration(calibration)
        factors.check_fit(shots)
        board = factors.manifest.board_reflectance
        truth, truth_error = truth_for(shots, board), truth_error_for(shots, board)
    replaces = may_replace(output, request.inputs(shots, factors), overwrite)
    with output_folder(output, overwrite=replaces) as folder:
        read = time.perf_counter() - started
        image = reconstruct_request(shots, factors, request, job)
        quality = None if truth is None else Quality.of(image.image, truth, truth_error)
        judged = Judged(replace(image, seconds={"read": read, **image.seconds}), quality, str(folder), truth)
        with job.clock.stage("write"):
            judged.reconstruction.write(folder, {**judged.summary(), **_origin(job, run, calibration)})
    return judged


def reconstruct_psf(
    run: Path,
    psf: Path,
    output: Path,
    reduce: int = 1,
    mend: bool = False,
    overwrite: bool = False,
    job: Job | None = None,
    **options: Any,
) -> Judged:
    """Recover the image of a run with a measured point spread function, and write the files of :func:`reconstruct`.

    ``reduce`` x ``reduce`` pixels of frames and ``psf`` become one. ``mend`` and the ``options`` ``lam``, ``method``,
    ``bounds`` and ``iterations`` are those of :func:`mitsim.reconstruct_psf`.
    """
    from mitsim.reconstruct.point_spread import lights_of, psf_inputs, reconstruct_psf_request

    request = ImageRequest(**options)
    request.check_point_spread(reduce)
    shots, lights = load_run(run), lights_of(psf, reduce)
    replaces = may_replace(output, psf_inputs(shots, lights, reduce, request, mend), overwrite)
    with output_folder(output, overwrite=replaces) as folder:
        judged = Judged(reconstruct_psf_request(shots, lights, reduce, request, job, mend), None, str(folder))
        judged.reconstruction.write(folder, {**judged.summary(), **_origin(job, run)})
    return judged


def _origin(job: Job | None, run: Path, calibration: Path | None = None) -> dict[str, Any]:
    made_of = {"run": str(run.absolute())} | ({"calibration": str(calibration.absolute())} if calibration else {})
    return {"command": job and job.command, MADE_OF: made_of}


# -------- Images of several lines, and one in colour


@takes(ImageRequest)
def reconstruct_colours(
    run: Path | str,
    calibration: Path | str,
    output: Path | str,
    chart: ChartPlace | None = None,
    overwrite: bool = False,
    job: Job | None = None,
    page: bool = True,
    reduce: int = 1,
    mend: bool = False,
    **options: Any,
) -> ColourImage:
    """Recover the image of every line of a coloured run, and combine them to one image in colour.

    Writes the folder of each line's image, image.exr (linear sRGB and XYZ), image.png, colour.json and report.html.

    Parameters
    ----------
    run, calibration
        Coloured folders of the same lines. In place of a calibration a picture of a point spread function may be given,
        with a channel for each line or one for all.
    output
        A folder: new or empty, or with an earlier coloured image of the same inputs.
    chart
        Place of the chart in the image; the colour matrix is then fitted on it. None: a fixed matrix, fitted on the
        chart's spectra at the lines.
    overwrite
        Whether an earlier image of other inputs may be replaced.
    job
        Clock of the work.
    page
        False to leave out pictures and report.html, which :func:`mitsim.report` makes later.
    reduce
        Pixels a side that become one, by a point spread function.
    mend
        Whether the point spread function is fitted to the frames of the middle line first, and changed for all alike.
    **options
        Options of :func:`mitsim.reconstruct`, for every line; of a run behind colour filters, ``lam`` alone; by a point
        spread function those of :func:`mitsim.reconstruct_psf`.

    Raises
    ------
    MitsimError
        For folders of different lines, and as :func:`reconstruct`.
    """
    run, calibration, output, job = Path(run), Path(calibration), Path(output), job or Job()
    found = colour_files.open_lines(run, colour_files.RUN, colour_files.MOSAIC)
    lines = found.filters or colour_files.read_colours(run, colour_files.RUN)
    by_point, board = calibration.is_file(), None
    if by_point and calibration.suffix.lower() == LIST:
        raise MitsimError(f"{calibration}: lists are of one line, and {run} is coloured; give a picture")
    if by_point and (found.filters or chart):
        raise MitsimError(f"{calibration}: is no folder; runs behind colour filters, and charts, need a calibration")
    if not by_point:
        colour_files.check_lines(lines, str(run), calibration)
        parts = [calibration / name for name in lines.names]
        boards = {read_manifest(part, CalibrationManifest).board_reflectance for part in parts}
        if len(boards) > 1:
            raise MitsimError(
                f"calibration {calibration}: its lines' boards reflect {boards}; calibrate all with one board"
            )
        board = boards.pop()

    def finish(folder: Path, **solved: Any) -> ColourImage:
        image = ColourImage(lines=lines, board=board or 1.0, chart=chart, output=str(folder), **solved)
        image.write(folder, **_origin(job, run, None if by_point else calibration))
        return image

    if by_point:
        image = _solve_by_point(lines, run, calibration, output, reduce, mend, overwrite, job, finish, **options)
    elif found.filters:
        for name in options.keys() - {"lam"}:
            raise ArgumentError(name, "has no effect behind colour filters; leave it out")
        image = _solve_at_once(lines, run, calibration, output, board, overwrite, job, finish, **options)
    else:
        replaces = colour_files.is_coloured(output) and (
            colour_files.read_colours(output, colour_files.IMAGE).names == lines.names or overwrite
        )
        with output_folder(output, overwrite=replaces) as folder:
            begins, images = not colour_files.is_coloured(folder), dict[str, Judged]()
            if begins:
                state_image(folder, lines, status="incomplete")
            try:
                for name in lines.names:
                    own = {"overwrite": overwrite, "job": job.apart(f"{name} "), **options}
                    images[name] = reconstruct(run / name, calibration / name, folder / name, **own)
            except BaseException:
                if begins and not any((folder / name).is_dir() for name in lines.names):  # refused before any image
                    (folder / colour_files.COLOUR).unlink()
                raise
            solved = {name: judged.reconstruction for name, judged in images.items()}
            truths = [judged.truth for judged in images.values() if judged.truth is not None]
            of_lines = {name: judged.summary() for name, judged in images.items()}
            image = finish(
                folder,
                images=_stack(solved),
                truth=np.stack(truths, axis=-1) if len(truths) == len(images) else None,
                qualities={name: judged.quality for name, judged in images.items()},
                facts={
                    "frames": "one line at a time, a run for each",
                    "solved": "each line by itself",
                    "lambda": ", ".join(f"{name} {each.lam:.3g}" for name, each in solved.items()),
                    "residual of the frames": ", ".join(f"{name} {each.residual:.1e}" for name, each in solved.items()),
                },
                warnings=each_once({name: each.status.reasons for name, each in solved.items()}),
                seconds={"total": sum(each["seconds"]["total"] for each in of_lines.values())},
                of_lines=of_lines,
            )
    if page:
        report_folder(output)
    return image


def _stack(solved: Mapping[str, Reconstruction]) -> FloatArray:
    shapes = {each.image.shape for each in solved.values()}
    if len(shapes) > 1:
        raise MitsimError(f"colour: the lines' images have {sorted(shapes)} pixels; capture all lines in one grid")
    return np.stack([each.image for each in solved.values()], axis=-1)


@single_threaded_blas()
def _solve_by_point(
    lines: colour_files.ColourManifest,
    run: Path,
    psf: Path,
    output: Path,
    reduce: int,
    mend: bool,
    overwrite: bool,
    job: Job,
    finish: Callable[..., ColourImage],
    **options: Any,
) -> ColourImage:
    """Solve each line with its own channel of the light, and one lambda: channels of other sharpness have fringes."""
    from mitsim.reconstruct.light_list import Lights
    from mitsim.reconstruct.point_spread import SeenFrames, automatic_weight, psf_inputs

    started, request = time.perf_counter(), ImageRequest(**options)
    request.check_point_spread(reduce)
    shots = {name: load_run(run / name) for name in lines.names}
    first = shots[lines.names[0]]
    (rows, columns), how = first.summary()["shape"], first.manifest.configuration.get("prepare")
    light = load_psf_channels(psf, lines.names, (rows, columns), how if isinstance(how, dict) else {}, reduce)
    totals = light.sum(axis=(1, 2))
    inputs = psf_inputs(first, Lights(light), reduce, request, mend)
    inputs["run"] = "-".join(each.fingerprint for each in shots.values())
    replaces = colour_files.is_coloured(output)
    if replaces and not overwrite:
        colour_files.read_colours(output, colour_files.IMAGE)
        check_same_inputs(output, read_json(output / colour_files.COLOUR), inputs)
    with output_folder(output, overwrite=replaces) as folder:
        channels = (light / totals[:, None, None]).repeat(len(lines.names) // len(light), axis=0)
        seen = {
            name: SeenFrames(each, Lights(channel), reduce, job.apart(f"{name} "))
            for (name, each), channel in zip(shots.items(), channels, strict=True)
        }
        if mend:
            found = list(seen.values())[len(seen) // 2].mend()
            for each in seen.values():
                each.mend(found)
        lam = request.lam
        if lam == "auto":
            weights = [automatic_weight(each.camera, each.frames, request.name) for each in seen.values()]
            lam = float(np.exp(np.mean(np.log(np.maximum(weights, _LEAST)))))
        state_image(folder, lines, status="incomplete", inputs=inputs)
        solved, of_lines = dict[str, Reconstruction](), dict[str, dict[str, Any]]()
        for name, each in seen.items():
            solved[name] = each.image(request, lam)
            with output_folder(folder / name, overwrite=True) as place:
                of_lines[name] = Judged(solved[name], None, str(place)).summary()
                solved[name].write(place, {**of_lines[name], **_origin(job, run / name)})
        images = _stack(solved)
        # A white object has the colours of the point.
        balance = np.broadcast_to(totals / totals.mean(), len(solved))
        white = max(float((images / balance).max()), _LEAST)
        return finish(
            folder,
            images=images,
            qualities=dict.fromkeys(lines.names),
            facts={"solved": "each line by its light of a point, all with one lambda", "lambda": f"{lam:.3g}"},
            warnings=each_once({name: each.status.reasons for name, each in solved.items()}),
            seconds={"total": time.perf_counter() - started},
            solution={"lambda": lam, "white": white, "balance": balance},
            of_lines=of_lines,
            inputs=inputs,
            by_point=ColourModel.of_channels(lines.names, lines.wavelengths_nm, white * balance),
        )


@single_threaded_blas()
def _solve_at_once(
    lines: colour_files.ColourManifest,
    run: Path,
    calibration: Path,
    output: Path,
    board: float | None,
    overwrite: bool,
    job: Job,
    finish: Callable[..., ColourImage],
    lam: Lambda = "auto",
) -> ColourImage:
    check_joint(lam)
    clock = job.apart("").clock
    with clock.stage("read"):
        mosaic = load_mosaic(run)
        factors, shots = {name: load_calibration(calibration / name) for name in lines.names}, mosaic.shots
        for each in factors.values():
            each.check_fit(shots)
    made_of = "-".join(each.fingerprint for each in factors.values())
    inputs = {"run": shots.fingerprint, "calibration": made_of, "mosaic": colour_files.JOINT, "lambda": lam}
    replaces = colour_files.is_coloured(output)
    if replaces:
        colour_files.read_colours(output, colour_files.IMAGE)
        if not overwrite:
            check_same_inputs(output, read_json(output / colour_files.COLOUR), inputs)
    with output_folder(output, overwrite=replaces) as folder:
        with clock.stage("accumulate"):
            pairs = [(each.left, each.right) for each in factors.values()]
            solver, data, noise = MosaicSolver(pairs, mosaic.weights, shots.patterns), 0.0, 0.0
            for datum in shots.pattern_measurements((len(pairs[0][0]), len(pairs[0][1]))):
                solver.add(datum.frame, datum.row, datum.column)
                data += float(np.square(datum.frame).sum())
                noise += float(np.maximum(shots.manifest.digital.variance(datum.light, datum.shots), 0.0).sum())
        with clock.stage("solve"):
            solved, lam, residual = solver.solve(lam)
        # Part of the residual that the noise of frames and factors explains, relative to the data.
        explained = 0.0
        for each in factors.values():
            if (own := each.manifest.noise) is not None:
                sides = (own.left, each.left), (own.right, each.right)
                explained = max(explained, sum(s**2 * side.size / float(np.square(side).sum()) for s, side in sides))
        unexplained = float(np.sqrt(max(residual**2 - (noise / data if data else 0.0) - explained, 0.0)))
        truth, qualities = mosaic.truth(board), dict[str, Quality | None].fromkeys(lines.names)
        if truth is not None:
            for number, (name, known) in enumerate(mosaic.truths.items()):
                error = float(np.sqrt(np.square(known.standard_error).mean())) * known.board / (board or known.board)
                qualities[name] = Quality.of(solved.image[number], truth[..., number], error)
        warnings = []
        if not solved.ok:
            left = f"{solved.iterations} steps leave {solved.residual:.1e} of the normal equations"
            warnings.append(f"Not converged: {left}; raise lambda.")
        if unexplained > UNEXPLAINED:
            warnings.append(
                f"Misfit: {unexplained:.1e} of the measurements are explained by no image of these lines, beyond "
                "noise; look for depth, light over several surfaces or another camera than was calibrated."
            )
        flags = {f"the calibration of {name}": each.warnings for name, each in factors.items()}
        warnings += each_once({"the capture": mosaic.warnings, **flags})
        state_image(folder, lines, status="incomplete", inputs=inputs)
        for name, image in zip(lines.names, solved.image, strict=True):
            with output_folder(folder / name, overwrite=True) as place:
                write_frame(place / IMAGE_FILE, {"reflectance": image.astype(np.float32)}, {"lambda": lam})
                write_bytes(place / PICTURE_FILE, png(image))
        return finish(
            folder,
            images=np.moveaxis(solved.image, 0, -1),
            truth=truth,
            qualities=qualities,
            facts={
                "frames": "all lines at once, behind colour filters",
                "solved": f"{colour_files.JOINT}, {solved.iterations} steps",
                "lambda": f"{lam:.3g}",
                "residual of the frames": f"{residual:.1e}, of which {unexplained:.1e} is unexplained",
            },
            warnings=tuple(warnings),
            seconds=clock.seconds(),
            solution={"mosaic": colour_files.JOINT, "lambda": lam, "steps": solved.iterations}
            | {"residual": residual, "unexplained": unexplained},
            inputs=inputs,
        )


# -------- Images of the lines from frames behind colour filters

Patterns = tuple[FloatArray, FloatArray]
Lambda = float | Literal["auto"]


class MosaicSolver:
    """Joint solve of all pixels for all lines, each with its own factors, from frames behind 2 x 2 colour filters.

    ``factors`` are (m, n) and (m', n') of each line without filters, ``weights`` (4, lines) the responses of the four
    pixels, and patterns the columns P_L (n, K) and P_R (n', K'). Lambda is chosen without a truth: a plane of filters
    sees several lines, so that it has the one separable camera that is nearest to them, and chooses its own lambda
    (:mod:`mitsim.reconstruct.solver`). The joint solve takes the geometric mean, because the planes have the same scene
    and nearly the same noise.
    """

    def __init__(
        self, factors: Sequence[tuple[FloatArray, FloatArray]], weights: FloatArray, patterns: Patterns
    ) -> None:
        lefts, rights = (np.stack(side) for side in zip(*factors, strict=True))
        self._joint = JointMosaic(lefts, rights, weights, *patterns)
        self._gathered, self._models = np.zeros(self._joint.shape), []
        for row, (a, b) in zip(weights, PLANES, strict=True):
            seen = best_term([(weight * left, right) for weight, left, right in zip(row, lefts, rights, strict=True)])
            self._models.append(prepare(seen.left[a::2], seen.right[b::2], *patterns))
        self._sums = [model.accumulator() for model in self._models]

    def add(self, frame: FloatArray, row: int, column: int) -> None:
        self._gathered += self._joint.gather(frame, row, column)
        for total, (a, b) in zip(self._sums, PLANES, strict=True):
            total.add(frame[a::2, b::2], row, column)

    def solve(self, lam: Lambda, relative: bool = False) -> tuple[Solution, float, float]:
        """Return the solution, whose image is (lines, n, n'), lambda, and ||Y - model|| / ||Y|| over all frames."""
        if isinstance(lam, str):
            pairs = zip(self._models, self._sums, strict=True)
            lambdas = [automatic_lambda(model.problem(total)) for model, total in pairs]
            lam = float(np.exp(np.mean(np.log(lambdas)))) if min(lambdas) > 0 else 0.0
        elif relative:
            lam *= self._joint.scale
        joint, energy = self._joint.solve(self._gathered, lam), sum(total.energy for total in self._sums)
        left = energy + float(np.vdot(joint.image, self._joint.normal(joint.image) - 2 * self._gathered))
        return joint, lam, float(np.sqrt(max(left, 0.0) / energy))

"""Images of a run's spectral lines from the folders RUN and CAL, compared with the truth where there is one.

A run has one unnamed line, a folder for each line, or frames of all lines behind colour filters. :func:`reconstruct`
makes the image of one line, :func:`reconstruct_colours` the images of several lines and one image in colour.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError, check_arguments
from mitsim.core.exr import checksum, write_frame
from mitsim.core.files import output_folder, read_json, remove_page, write_bytes
from mitsim.core.images import card, png
from mitsim.core.job import Job
from mitsim.core.manifests import CalibrationManifest, read_manifest
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import load_mosaic, load_run
from mitsim.core.spectral_manifests import (
    COLOUR,
    IMAGE,
    JOINT,
    MOSAIC,
    RUN,
    ColourManifest,
    check_lines,
    check_way,
    is_coloured,
    open_lines,
    read_colours,
    write_colours,
)
from mitsim.devices.chart import ChartPlace
from mitsim.devices.mask_profile import load_psf
from mitsim.metrics import Quality, psnr, summary_of, truth_error_for, truth_for
from mitsim.reconstruct.colour import ColourModel, chart, delta_e, linear_srgb
from mitsim.reconstruct.factors import load_calibration
from mitsim.reconstruct.misfit import UNEXPLAINED
from mitsim.reconstruct.reconstruct import (
    MADE_OF,
    Reconstruction,
    check_same_inputs,
    may_replace,
    reconstruct_request,
)
from mitsim.reconstruct.request import IMAGE_FILE, PICTURE_FILE, ImageRequest, check_joint
from mitsim.reconstruct.solution import Status
from mitsim.report.mosaic_images import Lambda, MosaicCamera, Solver

# -------- The image of one line


@dataclass(frozen=True)
class Judged:
    """A reconstruction, the folder that holds it, and its quality against the truth (None for a real camera)."""

    reconstruction: Reconstruction
    quality: Quality | None
    output: str
    truth: FloatArray | None = None

    def summary(self) -> dict[str, Any]:
        """Return all but the images, by the keys of the command line's JSON."""
        return {**summary_of(self.quality), **self.reconstruction.summary(), "output": self.output}


def reconstruct(
    run: Path | str,
    calibration: Path | str,
    output: Path | str,
    lam: float | Literal["auto"] = "auto",
    overwrite: bool = False,
    job: Job | None = None,
    **options: Any,
) -> Judged:
    """Recover the image of a run with a calibration, and write image.exr, image.png and result.json.

    Parameters
    ----------
    run, calibration, output
        RUN and CAL folders, and one for the image: new or empty, or with an earlier image of the same inputs.
    lam, **options
        As for :class:`mitsim.reconstruct.request.ImageRequest`.
    overwrite
        Whether an earlier image of other inputs may be replaced.
    job
        Clock of the work.

    Raises
    ------
    MitsimError
        For folders that do not fit each other, options that are not allowed, or an output that cannot be written.
    """
    started, job, request = time.perf_counter(), job or Job(), ImageRequest(lam, **options)
    with job.clock.stage("read"):
        shots, factors = load_run(run), load_calibration(calibration)
        factors.check_fit(shots)
        board = factors.manifest.board_reflectance
        truth, truth_error = truth_for(shots, board), truth_error_for(shots, board)
    replaces = may_replace(Path(output), request.inputs(shots, factors), overwrite)
    with output_folder(output, overwrite=replaces) as folder:
        read = time.perf_counter() - started
        image = reconstruct_request(shots, factors, request, job)
        quality = None if truth is None else Quality.of(image.image, truth, truth_error)
        judged = Judged(replace(image, seconds={"read": read, **image.seconds}), quality, str(folder), truth)
        with job.clock.stage("write"):
            judged.reconstruction.write(folder, {**judged.summary(), **_origin(job, run, calibration)})
    return judged


def reconstruct_psf(
    run: Path | str,
    psf: Path | str,
    output: Path | str,
    reduce: int = 1,
    overwrite: bool = False,
    job: Job | None = None,
    **options: Any,
) -> Judged:
    """Recover the image of a run with a measured point spread function, and write the files of :func:`reconstruct`.

    Parameters
    ----------
    run, psf, output
        RUN folder, picture of the light of a scene point, and a folder for the image, as for :func:`reconstruct`.
    reduce
        Pixels a side, of frames and picture, that become one.
    overwrite, job, **options
        As for :func:`reconstruct`; the options are ``lam``, ``method``, ``bounds`` and ``iterations``.

    Raises
    ------
    MitsimError
        As :func:`mitsim.reconstruct.point_spread_image.reconstruct_psf`, and for an output that cannot be written.
    """
    from mitsim.reconstruct.point_spread_image import psf_inputs, reconstruct_psf_request

    request = ImageRequest(**options)
    request.check_point_spread(reduce)
    shots, light = load_run(run), load_psf(psf, reduce)
    replaces = may_replace(Path(output), psf_inputs(shots, light, reduce, request), overwrite)
    with output_folder(output, overwrite=replaces) as folder:
        judged = Judged(reconstruct_psf_request(shots, psf, reduce, request, job), None, str(folder))
        judged.reconstruction.write(folder, {**judged.summary(), **_origin(job, run)})
    return judged


def _origin(job: Job | None, run: Path | str, calibration: Path | str | None = None) -> dict[str, Any]:
    """Return entries of result.json that say where an image comes from: the command and the folders."""
    folders = {"run": run, "calibration": calibration}
    made_of = {name: str(Path(folder).absolute()) for name, folder in folders.items() if folder is not None}
    return {"command": job and job.command, MADE_OF: made_of}


# -------- Images of several lines, and one in colour


@dataclass(frozen=True, eq=False, kw_only=True)
class ColourImage:
    """Images of a scene at spectral lines, their colours, and how well both are known.

    Attributes
    ----------
    lines
        Spectral lines and their names.
    images : (n, n', lines) array
        Reflectances, 1 = the calibration's board.
    board
        Reflectance of that board.
    model
        Conversion of reflectances at the lines to colours.
    truth : (n, n', lines) array
        What perfect images would show, relative to the board; None for a real camera.
    chart
        Place of a colour chart in the image; None where there is none, or it is not known.
    qualities
        Quality of each line's image; None without a truth.
    facts
        How the images were found, in words, for the page.
    warnings
        What is wrong with the images.
    seconds
        Wall time by stage.
    output
        The folder that holds all files.
    solution, of_lines
        Numbers of one solve for all lines, or of the solve of each line, by the keys of the command line's JSON.
    inputs
        What one solve for all lines was made of: an image of other inputs is not replaced.
    """

    lines: ColourManifest
    images: FloatArray
    board: float
    model: ColourModel
    truth: FloatArray | None = None
    chart: ChartPlace | None = None
    qualities: Mapping[str, Quality | None] = field(default_factory=dict)
    facts: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    output: str = ""
    solution: Mapping[str, Any] = field(default_factory=dict)
    of_lines: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    inputs: Mapping[str, str | float] = field(default_factory=dict)

    @classmethod
    def of(
        cls, lines: ColourManifest, images: FloatArray, board: float | None, chart: ChartPlace | None, **more: Any
    ) -> ColourImage:
        """Convert images to colours, by a matrix fitted on the chart where its place is known, else by the fixed one.

        Parameters
        ----------
        lines, images, chart, **more
            As the attributes.
        board
            Reflectance of the calibration's board; None is taken for 1.

        Raises
        ------
        MitsimError
            Where the chart lies outside the image.
        """
        model, board = ColourModel.of_lines(lines.wavelengths_nm), board or 1.0
        if chart is not None:
            means = board * chart.means(images)
            model = ColourModel.fit(lines.wavelengths_nm, means, "the chart in this image")
        return cls(lines=lines, images=images, board=board, model=model, chart=chart, **more)

    @property
    def reflectances(self) -> FloatArray:
        """(n, n', lines) reflectances, 1 = a perfect reflector."""
        return self.board * self.images

    @property
    def ok(self) -> bool:
        """True if the images of all lines can be used as they are."""
        return not self.warnings

    @property
    def psnr_db(self) -> float | None:
        """PSNR over the images of all lines together; None without a truth."""
        count = self.images.shape[0]
        return None if self.truth is None else psnr(self.images.reshape(count, -1), self.truth.reshape(count, -1))

    @cached_property
    def xyz(self) -> FloatArray:
        """(n, n', 3) CIE XYZ under D65; a perfect reflector has Y = 1."""
        return self.model.xyz(self.reflectances)

    @cached_property
    def truth_xyz(self) -> FloatArray | None:
        """(n, n', 3) CIE XYZ of the truth, by the same matrix; None without a truth."""
        return None if self.truth is None else self.model.xyz(self.board * self.truth)

    @cached_property
    def delta_e(self) -> FloatArray | None:
        """(n, n') CIE Delta E 2000 of each pixel to the truth's, by the same matrix; None without a truth."""
        return None if self.truth_xyz is None else delta_e(self.xyz, self.truth_xyz)

    @cached_property
    def patches(self) -> list[dict[str, Any]]:
        """Name of each patch of the chart, and CIE Delta E 2000 of its mean to its spectrum in D65.

        ``delta_e`` is of this image, ``floor`` of the patch's spectrum at the lines by the fixed matrix, below which no
        camera behind these lines is, and ``truth`` of the truth by the image's matrix. Empty without a chart.
        """
        if self.chart is None:
            return []
        known, waves = chart(), self.lines.wavelengths_nm
        columns = {
            "delta_e": delta_e(self.chart.means(self.xyz), known.xyz),
            "floor": delta_e(ColourModel.of_lines(waves).xyz(known.at(waves)), known.xyz),
            "truth": None if self.truth_xyz is None else delta_e(self.chart.means(self.truth_xyz), known.xyz),
        }
        return [
            {"name": name, **{key: None if each is None else float(each[number]) for key, each in columns.items()}}
            for number, name in enumerate(known.names)
        ]

    def patch_mean(self, key: str) -> float | None:
        """Return the mean over all patches of the number ``key``; None where it is not known."""
        return _mean(patch[key] for patch in self.patches)

    @property
    def sentences(self) -> list[str]:
        """Statements on the colours, for the command line."""
        sentences = [f"colours by a matrix fitted on {self.model.fitted_on}"]
        if self.delta_e is not None:
            sentences.append(f"Delta E 2000 of a pixel to the truth {self.delta_e.mean():.2f} in the mean")
        if self.patches:
            mean, floor = self.patch_mean("delta_e"), self.patch_mean("floor")
            sentences.append(f"of {len(self.patches)} patches to their spectra {mean:.2f}, floor {floor:.2f}")
        return sentences

    @property
    def described(self) -> list[str]:
        """Quality of each line, and how the images were found, for the command line's details."""
        qualities = [f"{name}: {each or 'no truth to compare with'}" for name, each in self.qualities.items()]
        return [*qualities, *(f"{name}: {value}" for name, value in self.facts.items())]

    @property
    def table(self) -> dict[str, str]:
        """What differs between lines that were solved one by one, in words by line."""
        rows = {}
        for number, line in enumerate(self.lines.names if self.of_lines else ()):
            found, size = self.of_lines[line], float(np.sqrt(np.square(self.images[..., number]).mean()))
            fit = "" if found["misfit"] is None else f", chi-square {found['misfit']['chi_square']:.3g}"
            known = "" if found["uncertainty"] is None else f" +- {found['uncertainty']:.2e}"
            rows[line] = f"lambda {found['lambda']:.3g}{fit}, image {size:.2e}{known} rms"
        return rows

    def summary(self) -> dict[str, Any]:
        """Return all but the pictures, by the keys of the command line's JSON."""
        channels = [
            {**line.model_dump(), **summary_of(self.qualities[line.name]), **self.of_lines.get(line.name, {})}
            for line in self.lines.channels
        ]
        return {
            **self.solution,
            "channels": channels,
            "ssim": _mean(channel["ssim"] or None for channel in channels),
            **self.model.summary(),
            "psnr": self.psnr_db,
            "delta_e": None if self.delta_e is None else float(self.delta_e.mean()),
            "delta_e_chart": self.patch_mean("delta_e"),
            "delta_e_floor": self.patch_mean("floor"),
            "patches": self.patches or None,
            "warnings": self.warnings,
            "status": " ".join(self.warnings) or "Solved: every line's image can be used as it is.",
            "seconds": dict(self.seconds),
            "output": self.output,
        }

    def write(self, folder: Path, **origin: Any) -> None:
        """Write image.exr, image.png, and colour.json last, with the entries ``origin``; an earlier page is removed."""
        remove_page(folder)
        rgb = linear_srgb(self.xyz)
        named = dict(zip("RGBXYZ", np.moveaxis(np.concatenate([rgb, self.xyz], axis=-1), -1, 0), strict=True))
        channels = {name: values.astype(np.float32) for name, values in named.items()}
        units = {"rgb": "linear sRGB", "xyz": "CIE 1931 under D65, perfect reflector Y = 1"}
        checksums = {
            IMAGE_FILE: write_frame(folder / IMAGE_FILE, channels, units),
            PICTURE_FILE: write_bytes(folder / PICTURE_FILE, png(rgb)),
        }
        of_lines = (f"{name}/{IMAGE_FILE}" for name in self.lines.names)
        checksums |= {name: checksum(folder / name) for name in of_lines if (folder / name).is_file()}
        more = {key: value for key, value in self.summary().items() if key != "channels"}
        write_colours(
            folder,
            ColourManifest(kind="colour-image", channels=self.lines.channels),
            **({"inputs": self.inputs} if self.inputs else {}),
            **origin,
            **more,
            facts={**self.facts, **self.table},
            board_reflectance=self.board,
            chart=self.chart,
            checksums=checksums,
        )

    def _repr_html_(self) -> str:
        pictures = {"in colour\nsRGB under D65": linear_srgb(self.xyz)}
        if self.truth_xyz is not None:
            pictures["truth\nsRGB under D65"] = linear_srgb(self.truth_xyz)
        for number, name in enumerate(self.lines.names):
            pictures[f"{name}\nreflectance 0 to 1"] = self.reflectances[..., number]
        return card("Image in colour", pictures, self.sentences)


@check_arguments
def reconstruct_colours(
    run: Path | str,
    calibration: Path | str,
    output: Path | str,
    chart: ChartPlace | None = None,
    overwrite: bool = False,
    job: Job | None = None,
    **options: Any,
) -> ColourImage:
    """Recover the image of every line of a coloured run, and combine them to one image in colour.

    Writes the folder of each line's image, image.exr (linear sRGB and XYZ), image.png, colour.json and report.html.

    Parameters
    ----------
    run, calibration
        Coloured folders of the same lines.
    output
        A folder: new or empty, or with an earlier coloured image of the same inputs.
    chart
        Place of the chart in the image; the colour matrix is then fitted on it. None: a fixed matrix, fitted on the
        chart's spectra at the lines.
    overwrite
        Whether an earlier image of other inputs may be replaced.
    job
        Clock of the work.
    **options
        Options of :func:`reconstruct`, for every line. Of a run behind colour filters: ``way``, one of
        :data:`mitsim.core.spectral_manifests.WAYS`, and ``lam``, of each plane or channel where these are solved one by
        one. ``page=False`` leaves out pictures and report.html, which :func:`mitsim.report_folder` makes later.

    Raises
    ------
    MitsimError
        For folders of different lines, and as :func:`reconstruct`.
    """
    from mitsim.report.folder_page import report_folder

    run, calibration, output, job = Path(run), Path(calibration), Path(output), job or Job()
    page, filters = options.pop("page", True), open_lines(run, RUN, MOSAIC).filters
    lines = filters or read_colours(run, RUN)
    check_lines(lines, str(run), calibration)
    if filters:
        with job.clock.stage("images"):
            found = _solve_mosaic(run, calibration, output, chart, overwrite, job, **options)
    else:
        found = _solve_each(run, calibration, output, chart, overwrite, job, lines, **options)
    if page:
        report_folder(output)
    return found


def _solve_each(
    run: Path,
    calibration: Path,
    output: Path,
    chart: ChartPlace | None,
    overwrite: bool,
    job: Job,
    lines: ColourManifest,
    **options: Any,
) -> ColourImage:
    """Solve each line by itself, in a folder of its own."""
    held = is_coloured(output)
    earlier = held and read_colours(output, IMAGE).names == lines.names
    with output_folder(output, overwrite=earlier or (overwrite and held)) as folder:
        images = {
            name: reconstruct(
                run / name, calibration / name, folder / name, overwrite=overwrite, job=job.apart(f"{name} "), **options
            )
            for name in lines.names
        }
        solved = {name: judged.reconstruction for name, judged in images.items()}
        shapes = {each.image.shape for each in solved.values()}
        if len(shapes) > 1:
            raise MitsimError(f"colour: the lines' images have {sorted(shapes)} pixels; capture all lines in one grid")
        truths = [judged.truth for judged in images.values() if judged.truth is not None]
        of_lines = {name: judged.summary() for name, judged in images.items()}
        found = ColourImage.of(
            lines,
            np.stack([each.image for each in solved.values()], axis=-1),
            _board_of(calibration, lines),
            chart,
            truth=np.stack(truths, axis=-1) if len(truths) == len(images) else None,
            qualities={name: judged.quality for name, judged in images.items()},
            facts={
                "frames": "one line at a time, a run for each",
                "solved": "each line by itself",
                "lambda": ", ".join(f"{name} {each.lam:.3g}" for name, each in solved.items()),
                "residual of the frames": ", ".join(f"{name} {each.residual:.1e}" for name, each in solved.items()),
            },
            warnings=one_paragraph({name: each.status for name, each in solved.items()}),
            seconds={"total": sum(each["seconds"]["total"] for each in of_lines.values())},
            output=str(folder),
            of_lines=of_lines,
        )
        found.write(folder, **_origin(job, run, calibration))
    return found


@single_threaded_blas()
def _solve_mosaic(
    run: Path,
    calibration: Path,
    output: Path,
    chart: ChartPlace | None,
    overwrite: bool,
    job: Job,
    way: str = JOINT,
    lam: Lambda = "auto",
) -> ColourImage:
    """Solve all lines from the same frames, which were seen through colour filters."""
    started = time.perf_counter()
    check_way(way)
    check_joint(lam)
    shots, names = load_mosaic(run), open_lines(run, MOSAIC).names
    factors = {name: load_calibration(calibration / name) for name in names}
    for each in factors.values():
        each.check_fit(shots.shots)
    fingerprints = {"run": shots.shots.fingerprint, "calibration": "-".join(f.fingerprint for f in factors.values())}
    inputs: dict[str, str | float] = {**fingerprints, "mosaic": way, "lambda": lam}
    replaces = is_coloured(output)
    if replaces:
        read_colours(output, IMAGE)
        if not overwrite:
            check_same_inputs(output, read_json(output / COLOUR), inputs)
    with output_folder(output, overwrite=replaces) as folder:
        read = time.perf_counter()
        camera = MosaicCamera.of([(f.left, f.right) for f in factors.values()], shots.weights, shots.manifest.mosaic)
        solver, data, noise = Solver(way, camera, shots.shots.patterns), 0.0, 0.0
        for each in shots.shots.pattern_measurements((len(camera.lefts[0]), len(camera.rights[0]))):
            solver.add(each.frame, each.row, each.column)
            data += float(np.square(each.frame).sum())
            noise += float(np.maximum(shots.shots.manifest.digital.variance(each.light, each.shots), 0.0).sum())
        added = time.perf_counter()
        solved = solver.images(lam)
        ended = time.perf_counter()
        # What the noise of frames and factors leaves of the residual, as a part of the data.
        explained = 0.0
        for each in factors.values():
            if (own := each.manifest.noise) is not None:
                sides = (own.left, each.left), (own.right, each.right)
                explained = max(explained, sum(s**2 * side.size / float(np.square(side).sum()) for s, side in sides))
        unexplained = float(np.sqrt(max(solved.residual**2 - (noise / data if data else 0.0) - explained, 0.0)))
        board, qualities = _board_of(calibration, shots.manifest), dict[str, Quality | None].fromkeys(names)
        truth = shots.truth(board)
        for number, name in enumerate(names if truth is not None else ()):
            own = shots.truths[name]
            error = float(np.sqrt(np.square(own.standard_error).mean())) * own.board / (board or own.board)
            qualities[name] = Quality.of(solved.images[number], truth[..., number], error)
        warnings = [f"The capture was flagged: {text.rstrip('.')}." for text in shots.warnings]
        warnings += [
            f"The calibration of {name} was flagged: {text.rstrip('.')}."
            for name, each in factors.items()
            for text in each.warnings
        ]
        if unexplained > UNEXPLAINED:
            warnings.insert(
                0,
                f"Misfit: {unexplained:.1e} of the measurements are explained by no image of these lines, beyond "
                "noise; look for depth, light over several surfaces or another camera than was calibrated.",
            )
        if solved.joint is not None and not solved.joint.ok:
            warnings.insert(
                0,
                f"Not converged: {solved.joint.iterations} steps leave {solved.joint.residual:.1e} of the normal "
                "equations; raise lambda.",
            )
        steps = solved.joint and solved.joint.iterations
        found = ColourImage.of(
            shots.manifest,
            np.moveaxis(solved.images, 0, -1),
            board,
            chart,
            truth=truth,
            qualities=qualities,
            facts={
                "frames": "all lines at once, behind colour filters",
                "solved": way if steps is None else f"{way}, {steps} steps",
                "lambda": f"{solved.lam:.3g}",
                "residual of the frames": f"{solved.residual:.1e}, of which {unexplained:.1e} is unexplained",
            },
            warnings=tuple(warnings),
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
                "steps": steps,
                "residual": solved.residual,
                "unexplained": unexplained,
            },
            inputs=inputs,
        )
        for name, image in zip(names, solved.images, strict=True):
            with output_folder(folder / name, overwrite=True) as place:
                write_frame(place / IMAGE_FILE, {"reflectance": image.astype(np.float32)}, {"lambda": solved.lam})
                write_bytes(place / PICTURE_FILE, png(image))
        found.write(folder, **_origin(job, run, calibration))
    return found


def one_paragraph(statuses: Mapping[str, Status]) -> tuple[str, ...]:
    """Combine the ``statuses`` of a run's lines, by name, to one warning; return none where all lines are usable.

    Each verdict has the sentence of the first line with that verdict, and each flag appears once.
    """
    flagged = {name: status for name, status in statuses.items() if not status.ok}
    parts = []
    for verdict in dict.fromkeys(status.verdict for status in flagged.values()):
        names = [name for name, status in flagged.items() if status.verdict is verdict]
        first = flagged[names[0]]
        alike = len({flagged[name].sentence for name in names}) == 1
        of_first = "" if alike else f" (so {names[0]}; the table has the others)"
        parts.append(f"{', '.join(names)}: {first.sentence}{of_first}{'; ' if first.remedy else ''}{first.remedy}.")
    flags = dict.fromkeys(flag for status in flagged.values() for flag in status.flags)
    return (" ".join([*parts, *flags]),) if parts else ()


def _board_of(calibration: Path, lines: ColourManifest) -> float | None:
    """Return the reflectance of the board that images are relative to, which all lines must share."""
    boards = {read_manifest(calibration / name, CalibrationManifest).board_reflectance for name in lines.names}
    if len(boards) > 1:
        raise MitsimError(
            f"calibration {calibration}: its lines' boards reflect {boards}; calibrate all with one board"
        )
    return boards.pop()


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None

"""`mitsim reconstruct`: a RUN and a CAL folder in, the image written, and compared with the truth if there is one; of
coloured folders an image of each line, and one in colour.

It stands alone so that an image starts without what pages and figures load.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from mitsim.core.errors import MitsimError, check_arguments
from mitsim.core.files import output_folder
from mitsim.core.job import Job
from mitsim.core.runs import load_run
from mitsim.core.spectral_manifests import IMAGE, is_coloured, is_mosaic, read_colours, same_lines
from mitsim.devices.chart import ChartPlace
from mitsim.devices.mask_profile import load_psf
from mitsim.metrics import Quality, summary_of, truth_error_for, truth_for
from mitsim.reconstruct.factors import load_calibration
from mitsim.reconstruct.reconstruct import MADE_OF, Reconstruction, may_replace, reconstruct_request
from mitsim.reconstruct.request import ImageRequest

if TYPE_CHECKING:
    from mitsim.report.colour_image import JudgedColours


@dataclass(frozen=True)
class Judged:
    """A reconstruction, its quality (None for frames without a truth), and the folder ``output`` that holds it."""

    reconstruction: Reconstruction
    quality: Quality | None
    output: str

    def summary(self) -> dict[str, Any]:
        """All but the image, by the keys of the command line's JSON."""
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
    """Recover the image of a run with a calibration; writes image.exr, image.png and result.json.

    MitsimError for folders that do not fit, an unknown method, lambda, focus or margin, or an output that cannot be
    written.

    Parameters
    ----------
    run, calibration, output
        RUN and CAL folders, and one for the image: new or empty, or with an earlier image of the same inputs.
    lam
        as for :func:`mitsim.reconstruct.reconstruct.reconstruct`.
    overwrite
        whether an earlier image of other inputs may be replaced.
    job
        its clock.
    **options
        ``method``, ``focus``, ``margin``, ``depth_range``, ``bounds`` and ``iterations``, as of
        :class:`mitsim.reconstruct.request.ImageRequest`.
    """
    started, job, request = time.perf_counter(), job or Job(), ImageRequest(lam=lam, **options)
    with job.clock.stage("read"):
        shots, factors = load_run(run), load_calibration(calibration)
        factors.check_fit(shots)
        board = factors.manifest.board_reflectance
        truth, truth_error = truth_for(shots, board), truth_error_for(shots, board)
    replaces = may_replace(Path(output), request.inputs(shots, factors), overwrite)
    with output_folder(output, overwrite=replaces) as folder:
        read = time.perf_counter() - started
        image = reconstruct_request(shots, factors, request, job)
        judged = Judged(
            reconstruction=replace(image, seconds={"read": read, **image.seconds}),
            quality=None if truth is None else Quality.of(image.image, truth, truth_error),
            output=str(folder),
        )
        with job.clock.stage("write"):
            judged.reconstruction.write(folder, {**judged.summary(), **_origin(job, run, calibration)})
    return judged


def _origin(job: Job | None, run: Path | str, calibration: Path | str | None = None) -> dict[str, Any]:
    """Entries of result.json on where an image comes from: the command of a ``job``, and the folders of its ``run`` and
    ``calibration``."""
    folders = {"run": run, "calibration": calibration}
    made_of = {name: str(Path(folder).absolute()) for name, folder in folders.items() if folder is not None}
    return {"command": job and job.command, MADE_OF: made_of}


def reconstruct_psf(
    run: Path | str,
    psf: Path | str,
    output: Path | str,
    reduce: int = 1,
    overwrite: bool = False,
    job: Job | None = None,
    **options: Any,
) -> Judged:
    """Recover the image of a run with a measured point spread function; writes image.exr, image.png and result.json.

    MitsimError as :func:`mitsim.reconstruct.point_spread_image.reconstruct_psf`, and for an output that cannot be
    written.

    Parameters
    ----------
    run, psf, output
        RUN folder, picture of the light of a scene point, and a folder for the image, as for :func:`reconstruct`.
    reduce
        pixels a side, of frames and picture, that become one.
    overwrite
        whether an earlier image of other inputs may be replaced.
    job
        its clock.
    **options
        ``lam``, ``method``, ``bounds`` and ``iterations``, as there.
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


@check_arguments
def reconstruct_colours(
    run: Path | str,
    calibration: Path | str,
    output: Path | str,
    chart: ChartPlace | None = None,
    overwrite: bool = False,
    job: Job | None = None,
    **options: Any,
) -> JudgedColours:
    """Recover the image of every line of a coloured run, and bring them together.

    Writes the folder of each line's image, image.exr (linear sRGB and XYZ), image.png, colour.json and report.html.

    Parameters
    ----------
    run, calibration
        coloured folders of the same lines.
    output
        a folder: new or empty, or with an earlier coloured image of the same inputs.
    chart
        where the image shows the chart; the colour matrix is then fitted on it. None: a fixed matrix, fitted on the
        chart's spectra at the lines.
    overwrite
        whether an earlier image of other inputs may be replaced.
    job
        its clock.
    **options
        of :func:`reconstruct`, for every line; of a run behind colour filters, ``way`` and
        ``lam`` as for :func:`mitsim.report.mosaic_images.reconstruct_mosaic`; ``page=False`` leaves out pictures and
        report.html, which :func:`mitsim.report_folder` makes later.

    Raises
    ------
    MitsimError
        for folders of different lines, and as :func:`reconstruct`.
    """
    from mitsim.report.colour_image import ColourImage, JudgedColours, board_of, one_paragraph
    from mitsim.report.folders import report_folder
    from mitsim.report.mosaic_images import reconstruct_mosaic

    run, calibration, output, job = Path(run), Path(calibration), Path(output), job or Job()
    origin, page = _origin(job, run, calibration), options.pop("page", True)
    if is_mosaic(run):
        with job.clock.stage("images"):
            found = reconstruct_mosaic(run, calibration, output, chart, overwrite, origin, **options)
        if page:
            report_folder(output)
        return found
    lines = same_lines(run, calibration)
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
        board, stack = board_of(calibration, lines), np.stack([each.image for each in solved.values()], axis=-1)
        truths = [truth_for(load_run(run / name), board) for name in lines.names]
        known = [truth for truth in truths if truth is not None]
        truth = np.stack(known, axis=-1) if len(known) == len(truths) else None
        summaries = {name: judged.summary() for name, judged in images.items()}
        found = JudgedColours(
            colours=ColourImage.of(lines, stack, board, truth, chart),
            qualities={name: judged.quality for name, judged in images.items()},
            described=[
                f"{name}: {judged.quality or 'no truth to compare with'}, lambda {solved[name].lam:.3g}, residual "
                f"{solved[name].residual:.1e}"
                for name, judged in images.items()
            ],
            facts={
                "frames": "one line at a time, a run for each",
                "solved": "each line by itself",
                "lambda": ", ".join(f"{name} {each.lam:.3g}" for name, each in solved.items()),
                "residual of the frames": ", ".join(f"{name} {each.residual:.1e}" for name, each in solved.items()),
            },
            warnings=one_paragraph({name: each.status for name, each in solved.items()}),
            seconds={"total": sum(each["seconds"]["total"] for each in summaries.values())},
            output=str(folder),
            of_lines=summaries,
        )
        found.write(folder, **origin)
    if page:
        report_folder(output)
    return found

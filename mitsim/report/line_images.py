"""`mitsim reconstruct` of coloured folders: an image of each spectral line by a solve of its own, and one in colour."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core import spectral_manifests
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError, checked
from mitsim.core.files import output_folder
from mitsim.core.runs import load_run
from mitsim.core.spectral_manifests import ColourManifest
from mitsim.devices.chart import ChartPlace
from mitsim.metrics import truth_for
from mitsim.reconstruct.colour import ColourModel
from mitsim.report.colour_image import PAGE, ColourImage, board_of, write_page
from mitsim.report.mosaic_images import JudgedMosaic, reconstruct_mosaic
from mitsim.report.quality import Judged, reconstruct


@dataclass(frozen=True, eq=False)
class JudgedColours:
    """An image in colour.

    Attributes
    ----------
    lines
        spectral lines and their folders' names.
    images
        of each line, by its name.
    colours
        the image in colour.
    output
        the folder that holds all.
    """

    lines: ColourManifest
    images: Mapping[str, Judged]
    colours: ColourImage
    output: str

    @property
    def model(self) -> ColourModel:
        """From reflectances at the lines to colours."""
        return self.colours.model

    @property
    def reflectances(self) -> FloatArray:
        """(n, n', lines) reflectance at each line, 1 = a perfect reflector."""
        return self.colours.reflectances

    @property
    def xyz(self) -> FloatArray:
        """(n, n', 3) CIE XYZ under D65; a perfect reflector has Y = 1."""
        return self.colours.xyz

    @property
    def ok(self) -> bool:
        """Whether the images of all lines can be used as they are."""
        return not self.warnings

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is wrong with images of single lines."""
        return tuple(
            f"{name}: {judged.reconstruction.status}"
            for name, judged in self.images.items()
            if not judged.reconstruction.ok
        )

    @property
    def psnr_db(self) -> float | None:
        """Of all lines' images together: of the mean of their squared errors; None without a truth."""
        return self.colours.psnr_db

    def summary(self) -> dict[str, Any]:
        """All but the pictures, by the keys of the command line's JSON."""
        known = [judged.quality.ssim for judged in self.images.values() if judged.quality and judged.quality.ssim]
        each = {name: judged.summary() for name, judged in self.images.items()}
        return {
            "channels": [{**line.model_dump(), **each[line.name]} for line in self.lines.channels],
            "ssim": float(np.mean(known)) if known else None,
            **self.colours.summary(),
            "status": " ".join(self.warnings) or "Solved: every line's image can be used as it is.",
            "seconds": {"total": sum(part["seconds"]["total"] for part in each.values())},
            "output": self.output,
        }

    @property
    def sentences(self) -> list[str]:
        """What the command line says of it."""
        each = [
            f"{name}: {judged.quality or 'no truth to compare with'}, lambda {judged.reconstruction.lam:.3g}, residual "
            f"{judged.reconstruction.residual:.1e}"
            for name, judged in self.images.items()
        ]
        return [*each, *self.colours.sentences]

    @property
    def facts(self) -> dict[str, str]:
        """How the images were made, by name."""
        solved = {name: judged.reconstruction for name, judged in self.images.items()}
        return {
            "frames": "one line at a time, a run for each",
            "solved": "each line by itself",
            "lambda": ", ".join(f"{name} {found.lam:.3g}" for name, found in solved.items()),
            "residual of the frames": ", ".join(f"{name} {found.residual:.1e}" for name, found in solved.items()),
        }

    def _repr_html_(self) -> str:
        return self.colours._repr_html_()


@checked
def reconstruct_colours(
    run: Path | str,
    calibration: Path | str,
    output: Path | str,
    chart: ChartPlace | None = None,
    overwrite: bool = False,
    **options: Any,
) -> JudgedColours | JudgedMosaic:
    """Recover the image of every line of a coloured run, and bring them together.

    Writes the folder of each line's image, image.exr (linear sRGB and XYZ), image.png, report.html and colour.json.

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
    **options
        of :func:`mitsim.report.quality.reconstruct`, for every line; of a run behind colour filters, ``way`` and
        ``lam`` as for :func:`mitsim.report.mosaic_images.reconstruct_mosaic`.

    Raises
    ------
    MitsimError
        for folders of different lines, and as :func:`mitsim.report.quality.reconstruct`.
    """
    run, calibration = Path(run), Path(calibration)
    if spectral_manifests.is_mosaic(run):
        return reconstruct_mosaic(run, calibration, output, chart, overwrite, **options)
    lines = spectral_manifests.same_lines(run, calibration)
    earlier = (Path(output) / spectral_manifests.COLOUR).is_file() and spectral_manifests.read_colours(
        output, spectral_manifests.IMAGE
    ).names == lines.names
    with output_folder(
        output, overwrite=earlier or (overwrite and (Path(output) / spectral_manifests.COLOUR).is_file())
    ) as folder:
        images = {
            name: reconstruct(run / name, calibration / name, folder / name, overwrite=overwrite, **options)
            for name in lines.names
        }
        board = board_of(calibration, lines)
        truths = [truth_for(load_run(run / name), board) for name in lines.names]
        known = [truth for truth in truths if truth is not None]
        truth = np.stack(known, axis=-1) if len(known) == len(truths) else None
        found = JudgedColours(
            lines, images, ColourImage.of(lines, stack_lines(images), board, truth, chart), str(folder)
        )
        found.colours.write(folder)
        qualities = {name: judged.quality for name, judged in images.items()}
        write_page(folder / PAGE, found.colours, qualities, found.facts, found.warnings)
        parts = {key: value for key, value in found.summary().items() if key != "channels"}
        spectral_manifests.write_colours(folder, ColourManifest(kind="colour-image", channels=lines.channels), **parts)
    return found


def stack_lines(images: Mapping[str, Judged]) -> FloatArray:
    """(n, n', lines) the ``images`` of all lines; MitsimError where they differ in size."""
    shapes = {judged.reconstruction.image.shape for judged in images.values()}
    if len(shapes) > 1:
        raise MitsimError(f"colour: the lines' images have {sorted(shapes)} pixels; capture all lines in one grid")
    return np.stack([judged.reconstruction.image for judged in images.values()], axis=-1)

"""`mitsim reconstruct` of coloured folders: an image of each spectral line by a solve of its own, and one in colour."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.colours import COLOUR, IMAGE, ColourManifest, read_colours, same_lines, write_colours
from mitsim.core.errors import MitsimError
from mitsim.core.framefile import write_frame
from mitsim.core.manifests import CalibrationManifest, read_manifest
from mitsim.core.output import output_folder, whole_file
from mitsim.core.pictures import colour_png
from mitsim.reconstruct.colour import ColourModel, linear_srgb
from mitsim.reconstruct.result import IMAGE_FILE
from mitsim.rig.chart import ChartPlace
from mitsim.study.quality import Judged, reconstruct


@dataclass(frozen=True, eq=False)
class JudgedColours:
    """An image in colour.

    Attributes
    ----------
    lines
        spectral lines and their folders' names.
    images
        of each line, by its name.
    model
        from reflectances at the lines to colours.
    board
        reflectance of the calibrations' board; 1 where they do not state it.
    output
        the folder that holds all.
    """

    lines: ColourManifest
    images: Mapping[str, Judged]
    model: ColourModel
    board: float
    output: str

    @property
    def reflectances(self) -> FloatArray:
        """(n, n', lines) reflectance at each line, 1 = a perfect reflector."""
        return self.board * stacked(self.images)

    @property
    def xyz(self) -> FloatArray:
        """(n, n', 3) CIE XYZ under D65; a perfect reflector has Y = 1."""
        return self.model.xyz(self.reflectances)

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
        known = [judged.quality.psnr_db for judged in self.images.values() if judged.quality]
        return -10 * math.log10(np.mean([10 ** (-each / 10) for each in known])) if known else None

    def summary(self) -> dict[str, Any]:
        """All but the pictures, by the keys of the command line's JSON."""
        known = [judged.quality.ssim for judged in self.images.values() if judged.quality and judged.quality.ssim]
        each = {name: judged.summary() for name, judged in self.images.items()}
        return {
            "channels": [{**line.model_dump(), **each[line.name]} for line in self.lines.channels],
            "psnr": self.psnr_db,
            "ssim": float(np.mean(known)) if known else None,
            **self.model.summary(),
            "status": " ".join(self.warnings) or "Solved: every line's image can be used as it is.",
            "seconds": {"total": sum(part["seconds"]["total"] for part in each.values())},
            "output": self.output,
        }


def reconstruct_colours(
    run: Path | str,
    calibration: Path | str,
    output: Path | str,
    chart: ChartPlace | None = None,
    overwrite: bool = False,
    **options: Any,
) -> JudgedColours:
    """Recover the image of every line of a coloured run, and bring them together.

    Writes the folder of each line's image, image.exr (linear sRGB and XYZ), image.png and colour.json.

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
        of :func:`mitsim.study.quality.reconstruct`, for every line.

    Raises
    ------
    MitsimError
        for folders of different lines, and as :func:`mitsim.study.quality.reconstruct`.
    """
    run, calibration = Path(run), Path(calibration)
    lines = same_lines(run, calibration)
    earlier = (Path(output) / COLOUR).is_file() and read_colours(output, IMAGE).names == lines.names
    with output_folder(output, overwrite=earlier or (overwrite and (Path(output) / COLOUR).is_file())) as folder:
        images = {
            name: reconstruct(run / name, calibration / name, folder / name, overwrite=overwrite, **options)
            for name in lines.names
        }
        model, board = ColourModel.of_lines(lines.wavelengths_nm), _board(calibration, lines)
        if chart is not None:
            model = ColourModel.fitted(
                lines.wavelengths_nm, board * chart.means(stacked(images)), "the chart in this image"
            )
        found = JudgedColours(lines, images, model, board, str(folder))
        write_colour_image(folder, found.xyz)
        parts = {key: value for key, value in found.summary().items() if key != "channels"}
        write_colours(folder, ColourManifest(kind="colour-image", channels=lines.channels), **parts)
    return found


def _board(calibration: Path, lines: ColourManifest) -> float:
    """Reflectance of the board that a calibration's images are relative to; 1 where it is not stated."""
    boards = {read_manifest(calibration / name, CalibrationManifest).board_reflectance for name in lines.names}
    if len(boards) > 1:
        raise MitsimError(
            f"calibration {calibration}: its lines' boards reflect {boards}; calibrate all with one board"
        )
    return boards.pop() or 1.0


def stacked(images: Mapping[str, Judged]) -> FloatArray:
    """(n, n', lines) the ``images`` of all lines; MitsimError where they differ in size."""
    shapes = {judged.reconstruction.image.shape for judged in images.values()}
    if len(shapes) > 1:
        raise MitsimError(f"colour: the lines' images have {sorted(shapes)} pixels; capture all lines in one grid")
    return np.stack([judged.reconstruction.image for judged in images.values()], axis=-1)


def write_colour_image(folder: Path, xyz: FloatArray) -> None:
    """Write image.exr and image.png of ``xyz`` (n, n', 3) under D65 to a ``folder``; MitsimError when it cannot be."""
    rgb = linear_srgb(xyz)
    named = dict(zip("RGBXYZ", np.moveaxis(np.concatenate([rgb, xyz], axis=-1), -1, 0), strict=True))
    channels = {name: values.astype(np.float32) for name, values in named.items()}
    write_frame(
        folder / IMAGE_FILE, channels, {"rgb": "linear sRGB", "xyz": "CIE 1931 under D65, perfect reflector Y = 1"}
    )
    with whole_file(folder / "image.png") as part:
        part.write_bytes(colour_png(rgb))

"""Reflectances at spectral lines in, an image in colour out: its colours, and how far they are from what is known."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.exr import write_frame
from mitsim.core.files import whole_file
from mitsim.core.manifests import CalibrationManifest, read_manifest
from mitsim.core.pictures import card, colour_png
from mitsim.core.spectral_manifests import ColourManifest
from mitsim.devices.chart import ChartPlace
from mitsim.metrics import psnr
from mitsim.reconstruct.colour import ColourModel, chart, delta_e, linear_srgb
from mitsim.reconstruct.request import IMAGE_FILE


@dataclass(frozen=True)
class Patch:
    """A patch of the chart.

    Attributes
    ----------
    name
        of its colour.
    delta_e
        CIE Delta E 2000 of its mean in the image to its spectrum in D65.
    floor
        the same of its spectrum at the lines, by the fixed matrix: what no camera behind these lines is below.
    truth
        the same of its mean in the truth, by the image's matrix; None without a truth.
    """

    name: str
    delta_e: float
    floor: float
    truth: float | None


@dataclass(frozen=True, eq=False)
class ColourImage:
    """An image in colour.

    Attributes
    ----------
    lines
        spectral lines and their names.
    images
        (n, n', lines) reflectances, 1 = the calibration's board.
    board
        reflectance of that board.
    model
        from reflectances to colours.
    truth
        (n, n', lines) what perfect images would show, relative to the board; None for a real camera.
    chart
        where the image shows the chart; None: it shows none, or nobody says so.
    """

    lines: ColourManifest
    images: FloatArray
    board: float
    model: ColourModel
    truth: FloatArray | None = None
    chart: ChartPlace | None = None

    @classmethod
    def of(
        cls,
        lines: ColourManifest,
        images: FloatArray,
        board: float | None,
        truth: FloatArray | None,
        place: ChartPlace | None,
    ) -> ColourImage:
        """The image, by a matrix fitted on the chart where it is known, else by the fixed one.

        Parameters
        ----------
        lines
            of the images.
        images, board
            (n, n', lines) relative to a board of that reflectance; None: unknown, and taken for 1.
        truth
            (n, n', lines) relative to it, too; None without one.
        place
            the chart in the image.

        Raises
        ------
        MitsimError
            where the chart lies outside the image.
        """
        model, board = ColourModel.of_lines(lines.wavelengths_nm), board or 1.0
        if place is not None:
            means = board * place.means(images)
            model = ColourModel.fitted(lines.wavelengths_nm, means, "the chart in this image")
        return cls(lines, images, board, model, truth, place)

    @property
    def reflectances(self) -> FloatArray:
        """(n, n', lines) 1 = a perfect reflector."""
        return self.board * self.images

    @property
    def psnr_db(self) -> float | None:
        """Of all lines' images together: of the mean of their squared errors; None without a truth."""
        count = self.images.shape[0]
        return None if self.truth is None else psnr(self.images.reshape(count, -1), self.truth.reshape(count, -1))

    @cached_property
    def xyz(self) -> FloatArray:
        """(n, n', 3) CIE XYZ under D65; a perfect reflector has Y = 1."""
        return self.model.xyz(self.reflectances)

    @cached_property
    def truth_xyz(self) -> FloatArray | None:
        """(n, n', 3) the same of the truth, by the same matrix; None without one."""
        return None if self.truth is None else self.model.xyz(self.board * self.truth)

    @cached_property
    def delta_e(self) -> FloatArray | None:
        """(n, n') CIE Delta E 2000 of each pixel to the truth's, by the same matrix; None without a truth."""
        return None if self.truth_xyz is None else delta_e(self.xyz, self.truth_xyz)

    @cached_property
    def patches(self) -> tuple[Patch, ...]:
        """Of the chart; none where the image shows none."""
        if self.chart is None:
            return ()
        known, waves = chart(), self.lines.wavelengths_nm
        seen = delta_e(self.chart.means(self.xyz), known.xyz)
        floor = delta_e(ColourModel.of_lines(waves).xyz(known.at(waves)), known.xyz)
        truth = None if self.truth_xyz is None else delta_e(self.chart.means(self.truth_xyz), known.xyz)
        return tuple(
            Patch(name, float(seen[number]), float(floor[number]), None if truth is None else float(truth[number]))
            for number, name in enumerate(known.names)
        )

    def summary(self) -> dict[str, Any]:
        """For colour.json and the command line's JSON."""
        return {
            **self.model.summary(),
            "psnr": self.psnr_db,
            "delta_e": None if self.delta_e is None else float(self.delta_e.mean()),
            "delta_e_chart": mean_of(patch.delta_e for patch in self.patches),
            "delta_e_floor": mean_of(patch.floor for patch in self.patches),
            "patches": [vars(patch) for patch in self.patches] or None,
        }

    @property
    def sentences(self) -> list[str]:
        """What the command line says of its colours."""
        said = [f"colours by a matrix fitted on {self.model.fitted_on}"]
        if self.delta_e is not None:
            said.append(f"Delta E 2000 of a pixel to the truth {self.delta_e.mean():.2f} in the mean")
        if self.patches:
            mean, floor = (mean_of(getattr(patch, name) for patch in self.patches) for name in ("delta_e", "floor"))
            said.append(f"of {len(self.patches)} patches to their spectra {mean:.2f}, floor {floor:.2f}")
        return said

    def write(self, folder: Path) -> None:
        """Write image.exr and image.png to a ``folder``. MitsimError when they cannot be written."""
        rgb = linear_srgb(self.xyz)
        named = dict(zip("RGBXYZ", np.moveaxis(np.concatenate([rgb, self.xyz], axis=-1), -1, 0), strict=True))
        channels = {name: values.astype(np.float32) for name, values in named.items()}
        write_frame(
            folder / IMAGE_FILE, channels, {"rgb": "linear sRGB", "xyz": "CIE 1931 under D65, perfect reflector Y = 1"}
        )
        with whole_file(folder / "image.png") as part:
            part.write_bytes(colour_png(rgb))

    def _repr_html_(self) -> str:
        pictures = {"in colour\nsRGB under D65": linear_srgb(self.xyz)}
        if self.truth_xyz is not None:
            pictures["truth\nsRGB under D65"] = linear_srgb(self.truth_xyz)
        for number, name in enumerate(self.lines.names):
            pictures[f"{name}\nreflectance 0 to 1"] = self.reflectances[..., number]
        return card("Image in colour", pictures, self.sentences)


def board_of(calibration: Path, lines: ColourManifest) -> float | None:
    """Reflectance of the board that a ``calibration``'s images are relative to, the same for all ``lines``; None where
    it is not stated. MitsimError where lines have different boards."""
    boards = {read_manifest(calibration / name, CalibrationManifest).board_reflectance for name in lines.names}
    if len(boards) > 1:
        raise MitsimError(
            f"calibration {calibration}: its lines' boards reflect {boards}; calibrate all with one board"
        )
    return boards.pop()


def mean_of(values: Iterable[float]) -> float | None:
    """Mean of ``values``; None where there are none."""
    known = list(values)
    return float(np.mean(known)) if known else None

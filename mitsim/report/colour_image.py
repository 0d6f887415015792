"""An image in colour from images of spectral lines, and its difference from known colours."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.exr import checksum, write_frame
from mitsim.core.files import remove_page, write_bytes
from mitsim.core.images import card, png
from mitsim.core.manifests import ColourManifest, write_colours
from mitsim.devices.framelist import ChartPlace
from mitsim.metrics import Quality, psnr, summary_of
from mitsim.reconstruct.colour import ColourModel, chart, delta_e, linear_srgb
from mitsim.reconstruct.request import IMAGE_FILE, PICTURE_FILE


@dataclass(frozen=True, eq=False, kw_only=True)
class ColourImage:
    """Images of a scene at spectral lines, their colours, and how well both are known.

    ``images`` and ``truth`` (n, n', lines) are reflectances relative to the calibration's ``board``. Colours are fitted
    on a ``chart``; MitsimError if it lies outside. ``solution`` and ``of_lines`` are numbers of one solve for all
    lines, or of each line's, by the keys of the JSON. An image of other ``inputs`` is not replaced.
    """

    lines: ColourManifest
    images: FloatArray
    board: float
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

    def __post_init__(self) -> None:
        self.model  # noqa: B018 - refuses a chart outside the image

    @cached_property
    def model(self) -> ColourModel:
        waves = self.lines.wavelengths_nm
        if self.chart is None:
            return ColourModel.of_lines(waves)
        return ColourModel.fit(waves, self.board * self.chart.means(self.images), "the chart in this image")

    @property
    def reflectances(self) -> FloatArray:
        """(n, n', lines) reflectances, 1 = a perfect reflector."""
        return self.board * self.images

    @property
    def ok(self) -> bool:
        return not self.warnings

    @property
    def psnr_db(self) -> float | None:
        """PSNR over all lines together; None without a truth."""
        count = self.images.shape[0]
        return None if self.truth is None else psnr(self.images.reshape(count, -1), self.truth.reshape(count, -1))

    @cached_property
    def xyz(self) -> FloatArray:
        """(n, n', 3) CIE XYZ under D65; a perfect reflector has Y = 1."""
        return self.model.xyz(self.reflectances)

    @cached_property
    def truth_xyz(self) -> FloatArray | None:
        return None if self.truth is None else self.model.xyz(self.board * self.truth)

    @cached_property
    def delta_e(self) -> FloatArray | None:
        """(n, n') CIE Delta E 2000 to the truth; None without a truth."""
        return None if self.truth_xyz is None else delta_e(self.xyz, self.truth_xyz)

    @cached_property
    def patches(self) -> list[dict[str, Any]]:
        """Return CIE Delta E 2000 of the mean of each patch to its spectrum in D65; empty without a chart.

        ``floor`` is that of the patch's spectrum at the lines by the fixed matrix, the least for these lines. ``truth``
        is that of the truth by the image's matrix.
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
        return _mean(patch[key] for patch in self.patches)

    @property
    def sentences(self) -> list[str]:
        sentences = [f"colours by a matrix fitted on {self.model.fitted_on}"]
        if self.delta_e is not None:
            sentences.append(f"Delta E 2000 of a pixel to the truth {self.delta_e.mean():.2f} in the mean")
        if self.patches:
            mean, floor = self.patch_mean("delta_e"), self.patch_mean("floor")
            sentences.append(f"of {len(self.patches)} patches to their spectra {mean:.2f}, floor {floor:.2f}")
        return sentences

    @property
    def described(self) -> list[str]:
        qualities = [f"{name}: {each or 'no truth to compare with'}" for name, each in self.qualities.items()]
        return [*qualities, *(f"{name}: {value}" for name, value in self.facts.items())]

    @property
    def table(self) -> dict[str, str]:
        rows = {}
        for number, line in enumerate(self.lines.names if self.of_lines else ()):
            found, size = self.of_lines[line], float(np.sqrt(np.square(self.images[..., number]).mean()))
            fit = "" if found["misfit"] is None else f", chi-square {found['misfit']['chi_square']:.3g}"
            known = "" if found["uncertainty"] is None else f" +- {found['uncertainty']:.2e}"
            rows[line] = f"lambda {found['lambda']:.3g}{fit}, image {size:.2e}{known} rms"
        return rows

    def summary(self) -> dict[str, Any]:
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
        """Write image.exr, image.png, and colour.json last; an earlier page is removed."""
        rgb = linear_srgb(self.xyz)
        named = dict(zip("RGBXYZ", np.moveaxis(np.concatenate([rgb, self.xyz], axis=-1), -1, 0), strict=True))
        channels = {name: values.astype(np.float32) for name, values in named.items()}
        units = {"rgb": "linear sRGB", "xyz": "CIE 1931 under D65, perfect reflector Y = 1"}
        remove_page(folder)
        checksums = {
            IMAGE_FILE: write_frame(folder / IMAGE_FILE, channels, units),
            PICTURE_FILE: write_bytes(folder / PICTURE_FILE, png(rgb)),
        }
        of_lines = (f"{name}/{IMAGE_FILE}" for name in self.lines.names)
        checksums |= {name: checksum(folder / name) for name in of_lines if (folder / name).is_file()}
        more = {key: value for key, value in self.summary().items() if key != "channels"}
        more |= {"inputs": self.inputs} if self.inputs else {}
        more |= {**origin, "facts": {**self.facts, **self.table}, "board_reflectance": self.board, "chart": self.chart}
        state_image(folder, self.lines, checksums=checksums, **more)

    def _repr_html_(self) -> str:
        pictures = {"in colour\nsRGB under D65": linear_srgb(self.xyz)}
        if self.truth_xyz is not None:
            pictures["truth\nsRGB under D65"] = linear_srgb(self.truth_xyz)
        for number, name in enumerate(self.lines.names):
            pictures[f"{name}\nreflectance 0 to 1"] = self.reflectances[..., number]
        return card("Image in colour", pictures, self.sentences)


def state_image(folder: Path, lines: ColourManifest, **more: Any) -> None:
    """Write colour.json; with ``status="incomplete"``, a killed work can be replaced."""
    remove_page(folder)
    write_colours(folder, ColourManifest(kind="colour-image", channels=lines.channels), **more)


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None

"""Reflectances at spectral lines in, an image in colour out: its colours, and how far they are from what is known."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError
from mitsim.core.exr import write_frame
from mitsim.core.files import whole_file
from mitsim.core.images import card, data_uri, grey_png, lightness, png
from mitsim.core.manifests import CalibrationManifest, read_manifest
from mitsim.core.spectral_manifests import ColourManifest, write_colours
from mitsim.devices.chart import ChartPlace
from mitsim.metrics import Quality, psnr, summary_of
from mitsim.reconstruct.colour import ColourModel, chart, delta_e, linear_srgb
from mitsim.reconstruct.request import IMAGE_FILE
from mitsim.report.pages import page_figure, render_page, write_html
from mitsim.report.plots import BLUE, FONT, GREEN, VERMILION, WIDTH, figure_of, label_axes


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
            model = ColourModel.fit(lines.wavelengths_nm, means, "the chart in this image")
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

    @property
    def patch_means(self) -> list[float | None]:
        """Means over the patches of Delta E: found, floor, and the truth's; None where there are none."""
        known = ((getattr(patch, name) for patch in self.patches) for name in ("delta_e", "floor", "truth"))
        return [mean_of(value for value in values if value is not None) for values in known]

    def summary(self) -> dict[str, Any]:
        """For colour.json and the command line's JSON."""
        found, floor, _ = self.patch_means
        return {
            **self.model.summary(),
            "psnr": self.psnr_db,
            "delta_e": None if self.delta_e is None else float(self.delta_e.mean()),
            "delta_e_chart": found,
            "delta_e_floor": floor,
            "patches": [vars(patch) for patch in self.patches] or None,
        }

    @property
    def sentences(self) -> list[str]:
        """What the command line says of its colours."""
        sentences = [f"colours by a matrix fitted on {self.model.fitted_on}"]
        if self.delta_e is not None:
            sentences.append(f"Delta E 2000 of a pixel to the truth {self.delta_e.mean():.2f} in the mean")
        if self.patches:
            mean, floor, _ = self.patch_means
            sentences.append(f"of {len(self.patches)} patches to their spectra {mean:.2f}, floor {floor:.2f}")
        return sentences

    def write(self, folder: Path) -> None:
        """Write image.exr and image.png to a ``folder``. MitsimError when they cannot be written."""
        rgb = linear_srgb(self.xyz)
        named = dict(zip("RGBXYZ", np.moveaxis(np.concatenate([rgb, self.xyz], axis=-1), -1, 0), strict=True))
        channels = {name: values.astype(np.float32) for name, values in named.items()}
        write_frame(
            folder / IMAGE_FILE, channels, {"rgb": "linear sRGB", "xyz": "CIE 1931 under D65, perfect reflector Y = 1"}
        )
        with whole_file(folder / "image.png") as part:
            part.write_bytes(png(rgb))

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


# -------- An image in colour with what is known of it, and its files


@dataclass(frozen=True, eq=False)
class JudgedColours:
    """An image in colour, and how good it and the images of its lines are.

    Attributes
    ----------
    colours
        the image in colour.
    qualities
        of each line's image by its name; None without a truth.
    described
        sentences on how the images were found.
    facts
        the same by name, for the page.
    warnings
        what is wrong with the images.
    seconds
        by stage.
    output
        the folder that holds all.
    solution
        numbers of one solve for all lines, by the keys of the command line's JSON; none where each has its own.
    of_lines
        numbers of the solve of each line, by its name, where each has its own.
    """

    colours: ColourImage
    qualities: Mapping[str, Quality | None]
    described: Sequence[str]
    facts: Mapping[str, str]
    warnings: tuple[str, ...]
    seconds: Mapping[str, float]
    output: str
    solution: Mapping[str, Any] = field(default_factory=dict)
    of_lines: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

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
    def psnr_db(self) -> float | None:
        """Of all lines' images together: of the mean of their squared errors; None without a truth."""
        return self.colours.psnr_db

    @property
    def sentences(self) -> list[str]:
        """What the command line says of it."""
        return [*self.described, *self.colours.sentences]

    def summary(self) -> dict[str, Any]:
        """All but the pictures, by the keys of the command line's JSON."""
        known = [found.ssim for found in self.qualities.values() if found and found.ssim]
        return {
            **self.solution,
            "channels": [
                {**line.model_dump(), **summary_of(self.qualities[line.name]), **self.of_lines.get(line.name, {})}
                for line in self.colours.lines.channels
            ],
            "ssim": mean_of(known),
            **self.colours.summary(),
            "status": " ".join(self.warnings) or "Solved: every line's image can be used as it is.",
            "seconds": dict(self.seconds),
            "output": self.output,
        }

    def write(self, folder: Path, **inputs: Any) -> None:
        """Write the image in colour, its page, and colour.json last, to a ``folder``.

        Parameters
        ----------
        folder
            that holds all.
        **inputs
            further entries of colour.json.
        """
        self.colours.write(folder)
        write_page(folder / PAGE, self.colours, self.qualities, self.facts, self.warnings)
        parts = {key: value for key, value in self.summary().items() if key != "channels"}
        lines = ColourManifest(kind="colour-image", channels=self.colours.lines.channels)
        write_colours(folder, lines, **inputs, **parts)

    def _repr_html_(self) -> str:
        return self.colours._repr_html_()


# -------- An image in colour in, one self-contained HTML page out

PAGE = "report.html"
_SMALLEST = 512
"""Pixels a side of a picture, in two dots each of a column of the page."""
_INK = 0.5
"""Of a colour's lightness, below which letters on it are white."""


def write_page(
    path: Path,
    image: ColourImage,
    qualities: Mapping[str, Quality | None],
    facts: Mapping[str, str],
    warnings: Sequence[str],
) -> Path:
    """Write the page of an image, all or nothing, and return its path.

    Parameters
    ----------
    path
        where.
    image
        in colour.
    qualities
        of each line's image, by its name.
    facts
        how it was made, by name.
    warnings
        what is wrong with it.

    Raises
    ------
    MitsimError
        when it cannot be written.
    """
    seen = {"image": image.xyz} | ({} if image.truth_xyz is None else {"truth": image.truth_xyz})
    text = render_page(
        "colour.html",
        verdict=_verdict(image),
        pictures={name: data_uri(png(linear_srgb(xyz), smallest=_SMALLEST)) for name, xyz in seen.items()},
        lines=[_line(image, number, qualities[name]) for number, name in enumerate(image.lines.names)],
        figures=_figures(image),
        patches=image.patches,
        means=image.patch_means,
        matrix=[(axis, [f"{value:.4f}" for value in row]) for axis, row in zip("XYZ", image.model.matrix, strict=True)],
        names=[f"{line.wavelength_nm:g} nm" for line in image.lines.channels],
        model=image.model.summary(),
        facts=facts,
        warnings=warnings,
        size=image.images.shape[:2],
        board=image.board,
        versions=versions(),
    )
    return write_html(path, text)


def _verdict(image: ColourImage) -> tuple[str, str]:
    """Headline and detail."""
    quality = "" if image.psnr_db is None else f"PSNR of the {len(image.lines.names)} lines: {image.psnr_db:.1f} dB. "
    if image.patches:
        mean, floor, _ = image.patch_means
        return (
            f"Mean Delta E 2000 of {len(image.patches)} patches: {mean:.2f}",
            f"{quality}The floor is {floor:.2f}: these spectral lines alone, without a camera.",
        )
    if image.delta_e is not None:
        return f"Mean Delta E 2000 to the truth: {image.delta_e.mean():.2f}", f"{quality}Mean over all pixels."
    return f"An image from {len(image.lines.names)} spectral lines", "No truth to compare it with."


def _line(image: ColourImage, number: int, quality: Quality | None) -> dict[str, Any]:
    """What is shown of one spectral line."""
    line, truth = image.lines.channels[number], image.truth
    return {
        "name": f"{line.wavelength_nm:g} nm",
        "share": None if line.radiant_share is None else f"{100 * line.radiant_share:.0f} %",
        "image": _grey(image.images[..., number]),
        "truth": None if truth is None else _grey(truth[..., number]),
        "quality": None if quality is None else f"{quality.psnr_db:.1f} dB",
        "ssim": None if quality is None or quality.ssim is None else f"{quality.ssim:.3f}",
    }


def _grey(values: Any) -> str:
    return data_uri(grey_png(lightness(values), smallest=_SMALLEST))


def _figures(image: ColourImage) -> dict[str, tuple[str, int]]:
    """The page's figures by name: what holds each, and its width [pixels]."""
    drawn: dict[str, Figure] = {}
    if image.delta_e is not None:
        drawn["differences"] = differences(image.delta_e)
    if image.patches and image.chart is not None:
        names, found = [patch.name for patch in image.patches], [patch.delta_e for patch in image.patches]
        drawn["by_patch"] = by_patch(names, [patch.floor for patch in image.patches], {"this image": found})
        title = "Left half: the patch's spectrum in D65. Right half: this image. Number: Delta E 2000"
        drawn["halves"] = halves(names, found, chart().xyz, image.chart.means(image.xyz), title)
    return {name: page_figure(figure) for name, figure in drawn.items()}


# -------- Colours of a chart's patches in, matplotlib Figures out

_TILE = 24
"""Pixels a side of a patch in the picture of the chart."""
_SHOWN_PERCENT = 99.0
"""Of the pixels, those that the scale holds: single ones near black are off by far more, and nobody sees them."""
_BAR = "#c7d2de"
"""What is below every marker: lighter than these."""


def by_patch(names: Sequence[str], floor: Sequence[float], found: Mapping[str, Sequence[float]]) -> Figure:
    """Delta E of each patch.

    Parameters
    ----------
    names
        of the patches.
    floor
        what no camera is below, of each.
    found
        of each, by what found them; three at most.
    """
    figure, axes = figure_of(4.4)
    place = np.arange(len(names))
    axes.bar(place, floor, 0.8, color=_BAR, label="floor: no camera, these lines alone")
    for (label, values), colour, marker in zip(found.items(), (VERMILION, BLUE, GREEN), ("s", "o", "^"), strict=False):
        axes.plot(place, values, marker, ms=5, color=colour, label=label)
    axes.set_xticks(place, names, rotation=45, ha="right", rotation_mode="anchor", fontsize=FONT - 2)
    axes.margins(x=0.01)
    label_axes(axes, "", "Delta E 2000 to the spectrum in D65", grid="y")
    axes.legend(fontsize=FONT - 1, frameon=False, ncols=4, loc="lower left", bbox_to_anchor=(0, 1.0))
    return figure


def halves(names: Sequence[str], values: Sequence[float], known: FloatArray, seen: FloatArray, title: str) -> Figure:
    """The chart: left half of a patch the colour of its spectrum, right half what was found.

    Parameters
    ----------
    names, values
        of the patches, row by row of six, and the numbers that stand below them.
    known, seen
        (24, 3) CIE XYZ under D65.
    title
        above all.
    """
    truth, found = (lightness(linear_srgb(each)) for each in (known, seen))
    figure, axes = figure_of(0.62 * WIDTH)
    axes.set_facecolor("#3a3a3a")
    for number, (name, value) in enumerate(zip(names, values, strict=True)):
        top, left = divmod(number, 6)
        tile = np.concatenate([np.tile(each[number], (_TILE, _TILE // 2, 1)) for each in (truth, found)], axis=1)
        axes.imshow(tile, extent=(left + 0.06, left + 0.94, top + 0.78, top + 0.06), interpolation="none")
        axes.text(
            left + 0.5, top + 0.98, f"{name}  {value:.1f}", ha="center", va="bottom", color="white", fontsize=FONT - 3
        )
    axes.set(xlim=(0, 6), ylim=(4.05, 0), xticks=[], yticks=[], aspect="auto")
    axes.set_title(title, fontsize=FONT)
    return figure


def differences(values: FloatArray) -> Figure:
    """Delta E 2000 ``values`` (n, n') of each pixel to the truth, with its scale."""
    # Beside pictures of the same pixels, and as wide: no room for axes of its own, which they have not either.
    figure, axes = figure_of(0.43 * WIDTH, 0.36 * WIDTH)
    most = max(float(np.percentile(values, _SHOWN_PERCENT)), 1.0)
    drawn = axes.imshow(values, vmin=0, vmax=most, cmap="viridis", interpolation="none")
    axes.set(xticks=[], yticks=[])
    bar = figure.colorbar(drawn, ax=axes, extend="max", orientation="horizontal", pad=0.03, aspect=25)
    bar.set_label("Delta E 2000 to the truth", fontsize=FONT)
    bar.ax.tick_params(labelsize=FONT - 1)
    return figure

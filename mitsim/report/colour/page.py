"""An image in colour in, one self-contained HTML page out: the image beside the truth, its colours, every line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import versions
from mitsim.core.pictures import colour_png, data_uri, grey_png, lightness
from mitsim.metrics import Quality
from mitsim.reconstruct.colour import chart, linear_srgb
from mitsim.report.colour.image import ColourImage, Patch, mean_of
from mitsim.report.html import rendered, shown_figure, write_html
from mitsim.report.plots import BLUE, FONT, GREEN, VERMILION, WIDTH, figure_of, label_axes

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
    text = rendered(
        "colour.html",
        verdict=_verdict(image),
        pictures=_pictures(image),
        lines=[_line(image, number, qualities[name]) for number, name in enumerate(image.lines.names)],
        figures=_figures(image),
        patches=image.patches,
        means=_means(image.patches),
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
        mean, floor = _means(image.patches)[:2]
        return (
            f"Mean Delta E 2000 of {len(image.patches)} patches: {mean:.2f}",
            f"{quality}The floor is {floor:.2f}: these spectral lines alone, without a camera.",
        )
    if image.delta_e is not None:
        return f"Mean Delta E 2000 to the truth: {image.delta_e.mean():.2f}", f"{quality}Mean over all pixels."
    return f"An image from {len(image.lines.names)} spectral lines", "No truth to compare it with."


def _pictures(image: ColourImage) -> dict[str, str]:
    """Image and truth, as data URIs."""
    seen = {"image": image.xyz} | ({} if image.truth_xyz is None else {"truth": image.truth_xyz})
    return {name: data_uri(colour_png(linear_srgb(xyz), smallest=_SMALLEST)) for name, xyz in seen.items()}


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
    return {name: shown_figure(figure) for name, figure in drawn.items()}


def _means(patches: Sequence[Patch]) -> tuple[float, float, float | None]:
    """Means over the patches: found, floor, truth (None without one)."""
    truths = [patch.truth for patch in patches if patch.truth is not None]
    found, floor = (np.mean([getattr(patch, name) for patch in patches] or [0.0]) for name in ("delta_e", "floor"))
    return float(found), float(floor), mean_of(truths)


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

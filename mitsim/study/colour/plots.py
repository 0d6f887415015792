"""Colours of a chart's patches in, matplotlib Figures out: their Delta E 2000 as bars, and themselves side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from mitsim.core.arrays import FloatArray
from mitsim.core.pictures import lightness
from mitsim.reconstruct.colour import linear_srgb
from mitsim.study.plots import BLUE, FONT, GREEN, VERMILION, WIDTH, figure_of, label_axes

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

"""An image in colour in, one self-contained HTML page out: the image beside the truth, its colours, every line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mitsim.core.pictures import colour_png, data_uri, grey_png, lightness
from mitsim.core.versions import versions
from mitsim.reconstruct.colour import chart, linear_srgb
from mitsim.study.colour.image import ColourImage, Patch, mean_of
from mitsim.study.colour.plots import by_patch, differences, halves
from mitsim.study.html import rendered, shown_figure, write_html
from mitsim.study.metrics import Quality

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

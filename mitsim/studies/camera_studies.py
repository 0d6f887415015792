"""Studies of the paper on the camera: the mask's distance, the sensor's pixels, and the resolution.

*distance*, section IV-C and figure 5: the mask at 500 to 2000 um, and on to where diffraction ends the shadow; mean
PSNR of eight test images by the number of dots.

*binning*, section V-D and its supplement: 512, 256, 128 and 64 pixels a side, the last two with fewer data than
unknowns in a single frame. Frames are binned by averaging after capture.

*resolution*, section V-C and figure 11: bars of 0.13 to 0.6 line pairs a mm under 9, 16 and 49 patterns, and the
transfer of a slanted edge. The paper takes (I_max - I_min) / (I_max + I_min) of the mean along the bars, of which noise
alone makes 0.2 to 0.5: it is in the table as `contrast_of_extremes`; figure and verdicts take the contrast at the bars'
own frequency. Pixels of the image are 0.9375 mm, so 0.533 line pairs a mm are the most there can be.

The slanted edge is ISO 12233's: the edge's place is fitted row by row, all pixels are put in order of their distance
from it, four bins a pixel, and the spectrum of the derivative is the modulation transfer function.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.report import EQUAL_FRAME, EQUAL_PEAK, MODELS
from mitsim.report.lit_scene import LitScene
from mitsim.studies.framework.claims import (
    Gain,
    Holds,
    Judged,
    Level,
    choose_rows,
    distinct,
    mean_of,
    measured,
    stated,
    value_name,
    within,
)
from mitsim.studies.framework.experiment import PRINT_MM, Axes, Found, Point, Study
from mitsim.studies.framework.panels import Images, Lines
from mitsim.studies.framework.studio import Image, Studio, finding, image_arrays, measure_image

if TYPE_CHECKING:
    from pandas import DataFrame

# -------- The distance of the mask

DISTANCES_MM = (0.5, 0.75, 1.0, 2.0, 4.0, 8.0)
"""The paper's four; features of 60 um have a Fresnel number of 3.2 at 2 mm and of 0.8 at 8 mm."""
_FAMILIES, _SHOWN = ("uniform", "dots:5", "dots:7"), ("uniform", "dots:7")
"""Families of this study and the next, and those whose images are shown."""
_COMPARABLE_DB = 1.0
"""A difference that may be seen: a fifth of the squared error."""

DISTANCE = Study(
    "distance",
    "How far the mask is from the sensor",
    "What does a thin camera cost, and how much of it do patterns give back?",
    points=Axes(
        {"patterns": _FAMILIES, "exposure": (EQUAL_PEAK, EQUAL_FRAME), "model": MODELS},
        scene={"mask_distance": DISTANCES_MM},
        quick={"mask_distance": (0.75, 2.0)},  # the two that the paper gives decibels of
    ),
    measure=partial(measure_image, shown=_SHOWN),
    claims=(
        stated("At 750 um, uniform light gives 16.9 to 19 dB", 16.9, 19.0, mask_distance="0.75", patterns="uniform"),
        stated("At 750 um, 49 dots give 30 to 30.5 dB", 30.0, 30.5, mask_distance="0.75", patterns="dots:7"),
        Gain(
            f"25 dots at 750 um are comparable to uniform light at 2000 um (within {_COMPARABLE_DB:g} dB)",
            {"mask_distance": "0.75", "patterns": "dots:5"},
            {"mask_distance": "2.0", "patterns": "uniform"},
            paper="comparable",
            at_least=-_COMPARABLE_DB,
            at_most=_COMPARABLE_DB,
        ),
    ),
    panels=(
        Lines("mask_distance", "sensor to mask [mm]", each="exposure", title="PSNR by the mask's distance", log=True),
        Images("mask_distance", each="patterns", where={"exposure": EQUAL_FRAME, "patterns": _SHOWN}, names="{} mm"),
    ),
)

# -------- The number of sensor pixels

BINNINGS = (1, 2, 4, 8)
"""Pixels a side that are averaged: the paper's 512 to 64 pixels a side."""
_FINE, _COARSE = BINNINGS[0], BINNINGS[-1]
_STABLE_DB = 3.0
"""Loss of an image that is still called stable: half of its squared error is then as before."""


def _binning_measure(studio: Studio, point: Point) -> Found:
    binning = int(point["binning"])
    frames = studio.frames(point.setup, point["model"], point["patterns"], int(point["seed"]))
    # With fewer data than unknowns the noise can't be estimated, so the best lambda stands in for the automatic one.
    image = Image.of(frames, frames.seconds(EQUAL_PEAK), "best", binning)
    pixels = frames.lit.bench.geometry.frame_shape[0] // binning
    return finding(studio, point, image.image if point["patterns"] in _SHOWN else None, pixels=pixels, **image.row())


BINNING = Study(
    "binning",
    "How many sensor pixels",
    "What is left where the sensor has fewer pixels than the image, with one frame and with 49?",
    points=Axes(
        {"patterns": _FAMILIES, "binning": BINNINGS, "model": MODELS},
        quick={"patterns": _SHOWN, "binning": (_FINE, _COARSE)},
    ),
    measure=_binning_measure,
    claims=(
        Gain(
            "49 dots are stable down to 64 x 64 pixels (3 dB lost at most)",
            {"binning": _FINE},
            {"binning": _COARSE},
            where="dots:7",
            paper="stable",
            at_least=-inf,
            at_most=_STABLE_DB,
        ),
        Gain(
            "Uniform light degrades with fewer pixels",
            {"binning": _FINE},
            {"binning": _COARSE},
            where="uniform",
            paper="degrades",
        ),
        Gain(
            "49 dots on 64 x 64 pixels are better than uniform light on 512 x 512",
            {"patterns": "dots:7", "binning": _COARSE},
            {"patterns": "uniform", "binning": _FINE},
            paper="better",
        ),
    ),
    panels=(
        Lines("pixels", "rows of the sensor [pixel]", title="PSNR by the sensor's rows, equal peak", log=True),
        Images("pixels", each="patterns", where={"patterns": _SHOWN}, names="{} rows"),
    ),
)

# -------- The resolution

PAIRS_A_MM = (0.13, 0.17, 0.21, 0.26, 0.35, 0.43, 0.52, 0.6)
"""The paper's groups 20 to 5, and one that pixels of 0.9375 mm can't resolve."""
RESOLVING = ("uniform", "dots:3", "dots:4", "dots:7")
_TOLD = 0.1
"""Contrast above which bars are resolved: what the eye needs of a print."""
_SEEN, _BESIDE = slice(16, -16), slice(8, -8)
"""Pixels that are evaluated: the margin is beside the bars of the sheet's other half, or beyond the print."""
_FINEST = 0.52  # the paper's group 5
_SHOWN_CYCLES = 0.35
"""Cycles a pixel up to which the truth must show bars: pixels that average over them leave 0.8 of their contrast."""
_SHOWS = 0.4
"""Contrast that the truth must have of such bars: half of what print and pixels leave."""


def _resolution_measure(studio: Studio, point: Point) -> Found:
    image = studio.image(point.setup, point["model"], point["patterns"], int(point["seed"]), EQUAL_FRAME)
    lit = studio.lit_scene(point.setup)
    kind, _, frequency = str(point.setup.picture).partition(" ")
    pixel_mm, row = _pixel_mm(lit), point.row(**image.row())
    if kind == "edge":
        cycles, transfer = slanted_edge(image.image[_SEEN, _SEEN])
        pairs = zip(cycles / pixel_mm, transfer, strict=True)
        return Found(tuple({**row, "pairs_a_mm": float(each), "transfer": float(value)} for each, value in pairs))
    own = float(frequency) * pixel_mm
    if own < _SHOWN_CYCLES and (there := _contrast(lit.truth, own)) < _SHOWS:
        raise MitsimError(
            f"scene {point.setup.scene}: bars of {frequency} line pairs a mm have a contrast of {there:.2f} in its "
            f"truth; give a print {PRINT_MM:g} mm wide, flat and facing the camera, that fills the image"
        )
    extremes = float(np.mean([contrast(*half) for half in _halves(image.image)]))
    row |= {"pairs_a_mm": float(frequency), "contrast": _contrast(image.image, own), "contrast_of_extremes": extremes}
    return Found((row,), image_arrays(image.image, lit.truth))


def _pixel_mm(lit: LitScene) -> float:
    """Width of the image's pixels on the print."""
    depth = lit.light.plan.settings.depth
    extents = [high - low for low, high in lit.bench.windows_at(depth)]
    return float(np.mean(extents)) * depth / lit.bench.n


def _halves(image: FloatArray) -> list[tuple[FloatArray, int]]:
    """Bars of each half of an ``image``, without the margins, and the axis along which they lie."""
    left, right = np.split(image, 2, axis=1)
    return [(left[_SEEN, _BESIDE], 0), (right[_SEEN, _BESIDE], 1)]


def _contrast(image: FloatArray, cycles: float) -> float:
    """Mean of both halves at so many ``cycles`` a pixel."""
    return float(np.mean([modulation(*half, cycles) for half in _halves(image)]))


def _rises(rows: DataFrame) -> tuple[str, Holds]:
    """Compare the contrast of the finest bars from fewer to more patterns, in the order of the table."""
    families = {name: choose_rows(rows, {"patterns": name}) for name in distinct(rows, "patterns")}
    fine = [choose_rows(own, {"pairs_a_mm": _FINEST}) for own in families.values()]
    text = ", ".join(
        f"{value_name('patterns', name)} {_limit(own):g} ({mean_of(finest, 'contrast').value:.2f})"
        for (name, own), finest in zip(families.items(), fine, strict=True)
    )
    gains = [within(mean_of(more, "contrast", fewer), low=0) for fewer, more in pairwise(fine)]
    return text, False if False in gains else within(mean_of(fine[-1], "contrast", fine[0]), low=0)


def _limit(rows: DataFrame) -> float:
    """Return the finest bars up to which all are resolved; 0 for none."""
    limit = 0.0
    for pairs in sorted(distinct(rows, "pairs_a_mm")):
        if mean_of(choose_rows(rows, {"pairs_a_mm": pairs}), "contrast").value < _TOLD:
            break
        limit = pairs
    return limit


_BARS = "spatial frequency on the print [line pairs/mm]"

RESOLUTION = Study(
    "resolution",
    "How fine",
    "Which bars are told apart, and how much contrast does an edge keep?",
    points=Axes(
        {"patterns": RESOLVING, "model": MODELS, "exposure": (EQUAL_FRAME,)},
        quick={"patterns": _SHOWN, "picture": ("bars 0.13", "bars 0.26", "bars 0.52", "edge")},
        prints=(*(f"bars {pairs:g}" for pairs in PAIRS_A_MM), "edge"),
        repeats=True,
    ),
    measure=_resolution_measure,
    claims=(
        Judged(
            "Resolution rises with the number of patterns (finest bars of 10 % contrast, line pairs a mm; contrast at "
            f"{_FINEST})",
            _rises,
            where={"contrast": measured},
            paper="rises",
        ),
        Level(
            f"49 patterns tell {_FINEST} line pairs a mm apart",
            every="pairs_a_mm",
            column="contrast",
            unit="",
            where={"patterns": "dots:7", "pairs_a_mm": lambda pairs: pairs <= _FINEST, "contrast": measured},
            paper="told apart",
            at_least=_TOLD,
        ),
    ),
    panels=(
        Lines("pairs_a_mm", _BARS, y="contrast", y_label="contrast of bars at their own frequency [1]", ticks=False),
        Lines("pairs_a_mm", _BARS, y="transfer", y_label="transfer of a slanted edge [1]", file="edge", ticks=False),
        Images(
            "picture",
            title=f"Bars by line pairs/mm of the print, exposure {EQUAL_FRAME}",
            down=("patterns", "model"),
            where={"picture": lambda name: str(name).startswith("bars")},
            caption="contrast {contrast:.2f}",
        ),
    ),
    note="Pixels of the image are 0.94 mm on the shipped print, so 0.533 line pairs/mm are the most that they show; "
    "bars just below beat with them. Bars lie along the sensor's rows and columns and the edge does not, and lambda "
    "is chosen for each image: the two need not agree.",
)


# -------- Images of bars and of a slanted edge in, how much contrast is left by spatial frequency out

_BINS = 4
"""Bins a pixel along the edge's normal, as the standard has them."""
_LEAST_STEP = 0.05
"""Least step of reflectance that an edge is looked for at."""


def contrast(image: FloatArray, axis: int) -> float:
    """(I_max - I_min) / (I_max + I_min) of an ``image`` of bars, averaged along them, which lie along ``axis``.

    The paper's definition; above 1 where the least is negative.
    """
    profile = image.mean(axis=axis)
    high, low = float(profile.max()), float(profile.min())
    return (high - low) / (high + low)


def modulation(image: FloatArray, axis: int, frequency: float) -> float:
    """Contrast of an image of bars at their own frequency, which noise of others does not feign.

    Amplitude over mean of the fundamental of the profile across the bars; a square wave of contrast c has 4 c / pi.

    Parameters
    ----------
    image, axis
        as for :func:`contrast`.
    frequency
        cycles a pixel.
    """
    profile = image.mean(axis=axis)
    phase = 2 * np.pi * frequency * np.arange(len(profile))
    waves = np.stack([np.cos(phase), np.sin(phase), np.ones(len(profile))], axis=1)
    cosine, sine, mean = np.linalg.lstsq(waves, profile, rcond=None)[0]
    return float(np.hypot(cosine, sine) / mean * np.pi / 4)


def slanted_edge(image: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Modulation transfer function of an ``image`` (rows, columns) of one edge, a few degrees off its columns.

    Returns frequencies [cycles a pixel], up to half a cycle, and the transfer, 1 at zero; without that of the bins and
    of the difference that stands for the derivative.

    Raises
    ------
    MitsimError
        for an image without an edge from left to right.
    """
    rows, columns = image.shape
    centres: FloatArray = np.arange(columns, dtype=np.float64) + 0.5
    between: FloatArray = centres[:-1] + 0.5
    if abs(float(image[:, -columns // 4 :].mean() - image[:, : columns // 4].mean())) < _LEAST_STEP:
        raise MitsimError("slanted edge: the image has no step from left to right")
    slopes = np.diff(image, axis=1)
    line = np.polyfit(np.arange(rows), [_centroid(slope, between) for slope in slopes], 1)
    # Once more about the first line, so that noise far from the edge does not move it.
    near = np.exp(-np.square((between - np.polyval(line, np.arange(rows))[:, None]) / 8))
    places = [_centroid(np.asarray(slope), between) for slope in slopes * near]
    line = np.polyfit(np.arange(rows), places, 1)
    distance = (centres - np.polyval(line, np.arange(rows))[:, None]) / np.hypot(1, line[0])
    bins = np.floor(distance * _BINS).astype(int).ravel()
    half = _BINS * (columns // 4)
    inside = (bins >= -half) & (bins < half)
    count = np.bincount(bins[inside] + half, minlength=2 * half)
    edge = np.bincount(bins[inside] + half, image.ravel()[inside], 2 * half) / np.maximum(count, 1)
    spread = np.diff(edge) * np.hanning(2 * half - 1)
    spectrum = np.abs(np.fft.rfft(spread))
    frequency = np.fft.rfftfreq(len(spread)) * _BINS
    own = np.sinc(frequency / _BINS) ** 2
    kept = frequency <= 0.5
    return np.asarray(frequency[kept], dtype=np.float64), np.asarray(spectrum[kept] / spectrum[0] / own[kept])


def _centroid(weights: FloatArray, places: FloatArray) -> float:
    squares = np.square(weights)
    return float((squares * places).sum() / squares.sum())


STUDIES = {each.name: each for each in (DISTANCE, BINNING, RESOLUTION)}

"""Studies of the paper by what the camera is: the mask's distance, the sensor's pixels, and how fine it sees.

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

import math
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise

import numpy as np
from matplotlib.figure import Figure

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.report import EQUAL_FRAME, EQUAL_PEAK, MODELS
from mitsim.report.lit_scene import LitScene
from mitsim.report.pages import Table, Value
from mitsim.report.plots import curves
from mitsim.studies.framework import claims
from mitsim.studies.framework.claims import Holds, image_arrays, measure_image
from mitsim.studies.framework.experiment import PRINT_MM, Claim, Experiment, Found, Point, Results, Scope
from mitsim.studies.framework.studio import Image, Studio

# -------- How far the mask is from the sensor

DISTANCES_MM = (0.5, 0.75, 1.0, 2.0, 4.0, 8.0)
"""The paper's four; features of 60 um have a Fresnel number of 3.2 at 2 mm and of 0.8 at 8 mm."""
_FEW_MM = (0.75, 2.0)  # the two that the paper gives decibels of
_FAMILIES = ("uniform", "dots:5", "dots:7")
_SHOWN = ("uniform", "dots:7")
"""Of both these and the next study: families, and those whose images are shown."""
_NEAR_UNIFORM, _NEAR_DOTS = (16.9, 19.0), (30.0, 30.5)
"""Decibels in the paper's figure 5, mask at 750 um."""
_COMPARABLE_DB = 1.0
"""A difference that may be seen: a fifth of the squared error."""


def _distance_points(scope: Scope) -> Sequence[Point]:
    return Point.grid(
        [
            scope.setup.with_parameters(mask_distance=distance).with_print(name)
            for distance in scope.choose(DISTANCES_MM, _FEW_MM)
            for name in scope.pictures
        ],
        "model patterns exposure seed",
        seed=scope.seeds,
        patterns=_FAMILIES,
        exposure=(EQUAL_PEAK, EQUAL_FRAME),
        model=MODELS,
    )


def _distance_claims(results: Results) -> Sequence[Claim]:
    near = results.table.where(mask_distance="0.75")
    return [
        claims.psnr_claim(
            near.where(patterns="uniform"), "At 750 um, uniform light gives 16.9 to 19 dB", _NEAR_UNIFORM
        ),
        claims.psnr_claim(near.where(patterns="dots:7"), "At 750 um, 49 dots give 30 to 30.5 dB", _NEAR_DOTS),
        claims.gain_claim(
            results.table,
            f"25 dots at 750 um are comparable to uniform light at 2000 um (within {_COMPARABLE_DB:g} dB)",
            "comparable",
            ({"mask_distance": "0.75", "patterns": "dots:5"}, {"mask_distance": "2.0", "patterns": "uniform"}),
            "{one} against {other} dB: {gain:+} dB",
            (-_COMPARABLE_DB, _COMPARABLE_DB),
        ),
    ]


def _distance_figures(results: Results) -> Mapping[str, Figure]:
    table, title = results.table, "PSNR by the mask's distance"
    drawn = dict(claims.by_exposure(table, claims.by_patterns, "mask_distance", "sensor to mask [mm]", title, log=True))
    distances = table.distinct("mask_distance")
    names, title = [f"{float(each):g} mm" for each in distances], f"{{}}, exposure {EQUAL_FRAME}"
    shown = table.where(exposure=EQUAL_FRAME)
    return drawn | claims.family_images(results, shown, _SHOWN, "mask_distance", distances, title, names)


DISTANCE = Experiment(
    "distance",
    "How far the mask is from the sensor",
    "What does a thin camera cost, and how much of it do patterns give back?",
    _distance_points, partial(measure_image, shown=_SHOWN), _distance_claims, _distance_figures,
)  # fmt: skip


# -------- How many sensor pixels

BINNINGS = (1, 2, 4, 8)
"""Pixels a side that are averaged: the paper's 512 to 64 pixels a side."""
_FINE, _COARSE = BINNINGS[0], BINNINGS[-1]
_STABLE_DB = 3.0
"""What an image may lose and still be called stable: half of its squared error is then as before."""


def _binning_points(scope: Scope) -> Sequence[Point]:
    return Point.grid(
        map(scope.setup.with_print, scope.pictures),
        "model patterns binning seed",
        seed=scope.seeds,
        patterns=scope.choose(_FAMILIES, _SHOWN),
        binning=scope.choose(BINNINGS, (_FINE, _COARSE)),
        model=MODELS,
    )


def _binning_measure(studio: Studio, point: Point) -> Found:
    binning = int(point["binning"])
    frames = studio.frames(point.setup, point["model"], point["patterns"], int(point["seed"]))
    # With fewer data than unknowns noise cannot be told, nor lambda chosen by it.
    image = Image.of(frames, frames.seconds(EQUAL_PEAK), "best", binning)
    pixels = frames.lit.bench.geometry.frame_shape[0] // binning
    return claims.finding(
        studio, point, image.image if point["patterns"] in _SHOWN else None, pixels=pixels, **image.row()
    )


def _binning_claims(results: Results) -> Sequence[Claim]:
    few, few_coarse, many, many_coarse = (
        dict[str, Value](patterns=family, binning=binning) for family in _SHOWN for binning in (_FINE, _COARSE)
    )
    lost, table = "{one} to {other} dB: {gain} dB lost", results.table
    stable = "49 dots are stable down to 64 x 64 pixels (3 dB lost at most)"
    better = "49 dots on 64 x 64 pixels are better than uniform light on 512 x 512"
    return [
        claims.gain_claim(table, stable, "stable", (many, many_coarse), lost, (-math.inf, _STABLE_DB)),
        claims.gain_claim(table, "Uniform light degrades with fewer pixels", "degrades", (few, few_coarse), lost),
        claims.gain_claim(table, better, "better", (many_coarse, few)),
    ]


def _binning_figures(results: Results) -> Mapping[str, Figure]:
    table = results.table
    shown = claims.panels(claims.by_patterns(table), "pixels")
    title = f"PSNR by the sensor's rows, exposure {EQUAL_PEAK}"
    drawn = {"psnr.png": curves(shown, "rows of the sensor [pixel]", log=True, title=title)}
    pixels = table.distinct("pixels")
    names, title = [f"{each} rows" for each in pixels], f"{{}}, {EQUAL_PEAK}, by sensor rows"
    return drawn | claims.family_images(results, table, _SHOWN, "pixels", pixels, title, names)


BINNING = Experiment(
    "binning",
    "How many sensor pixels",
    "What is left where the sensor has fewer pixels than the image, with one frame and with 49?",
    _binning_points, _binning_measure, _binning_claims, _binning_figures,
)  # fmt: skip


# -------- How fine

PAIRS_A_MM = (0.13, 0.17, 0.21, 0.26, 0.35, 0.43, 0.52, 0.6)
"""The paper's groups 20 to 5, and one that no pixel of 0.9375 mm can tell."""
RESOLVING = ("uniform", "dots:3", "dots:4", "dots:7")
_TOLD = 0.1
"""Contrast below which bars are not told apart: what the eye needs of a print."""
_SEEN, _BESIDE = slice(16, -16), slice(8, -8)
"""Pixels that are looked at: the margin is beside the bars of the sheet's other half, or beyond the print."""
_FINEST = 0.52  # the paper's group 5
_SHOWN_CYCLES = 0.35
"""Cycles a pixel up to which the truth must show bars: pixels that average over them leave 0.8 of their contrast."""
_SHOWS = 0.4
"""Contrast that the truth must have of such bars: half of what print and pixels leave."""


def _resolution_points(scope: Scope) -> Sequence[Point]:
    pairs = scope.choose(PAIRS_A_MM, (0.13, 0.26, 0.52))
    return Point.grid(
        map(scope.setup.with_print, [f"bars {each:g}" for each in pairs] + ["edge"]),
        "model patterns exposure seed",
        seed=scope.repeats,
        patterns=scope.choose(RESOLVING, ("uniform", "dots:7")),
        model=MODELS,
        exposure=(EQUAL_FRAME,),
    )


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


def _resolution_claims(results: Results) -> Sequence[Claim]:
    table = results.table

    def rises(rows: Table) -> tuple[str, Holds]:
        limits = {name: _limit(of_family) for name, of_family in claims.by_patterns(rows).items()}
        fine = claims.by_patterns(rows.where(pairs_a_mm=_FINEST))
        kept = {name: claims.sample_mean(of_family, "contrast").value for name, of_family in fine.items()}
        text = ", ".join(f"{name[:1].lower()}{name[1:]} {limits[name]:g} ({kept[name]:.2f})" for name in limits)
        gains = [
            claims.within(claims.difference(more, fewer, "contrast"), low=0) for fewer, more in pairwise(fine.values())
        ]
        families = list(fine.values())
        gain = claims.within(claims.difference(families[-1], families[0], "contrast"), low=0)
        return text, False if False in gains else gain

    def apart(rows: Table) -> tuple[str, Holds]:
        dots = rows.where(patterns="dots:7")
        seen = {
            pairs: claims.sample_mean(dots.where(pairs_a_mm=pairs), "contrast")
            for pairs in _bars(dots)
            if pairs <= _FINEST
        }
        return f"contrast {seen[_FINEST].value:.2f}", claims.every(
            *(claims.within(each, low=_TOLD) for each in seen.values())
        )

    resolution = (
        f"Resolution rises with the number of patterns (finest bars of 10 % contrast, line pairs a mm; contrast at "
        f"{_FINEST})"
    )
    return [
        claims.judge_claim(table, resolution, "rises", rises),
        claims.judge_claim(table, f"49 patterns tell {_FINEST} line pairs a mm apart", "told apart", apart),
    ]


def _limit(rows: Table) -> float:
    """Finest bars up to which all are told apart; 0 for none."""
    limit = 0.0
    for pairs in _bars(rows):
        if claims.sample_mean(rows.where(pairs_a_mm=pairs), "contrast").value < _TOLD:
            break
        limit = pairs
    return limit


def _bars(rows: Table) -> list[float]:
    """Line pairs a mm of all bars that a contrast was measured of."""
    return sorted(rows.means("contrast", "pairs_a_mm"))


def _resolution_figures(results: Results) -> Mapping[str, Figure]:
    table, drawn, lines = results.table, {}, claims.by_patterns(results.table)
    for column, file, title in (
        ("contrast", "contrast", "Contrast of bars at their own frequency"),
        ("transfer", "edge", "Modulation transfer by a slanted edge (ISO 12233)"),
    ):
        axis = "spatial frequency on the print [line pairs/mm]"
        shown = claims.panels(lines, "pairs_a_mm", column)
        drawn[f"{file}.png"] = curves(shown, axis, f"{column} [1]", ticks=False, title=title)
    names = [name for name in table.distinct("picture") if name.startswith("bars")]
    both = {f"{name}, {model}": rows.where(model=model) for name, rows in lines.items() for model in MODELS}
    grid = claims.image_rows(results, both, "picture", names, "contrast {contrast:.2f}")
    title = f"Bars by line pairs/mm of the print, exposure {EQUAL_FRAME}"
    drawn["images.png"] = claims.grid_with_truths(grid, [name.replace("bars ", "") for name in names], title)
    return drawn


RESOLUTION = Experiment(
    "resolution",
    "How fine",
    "Which bars are told apart, and how much contrast does an edge keep?",
    _resolution_points, _resolution_measure, _resolution_claims, _resolution_figures,
    note="Pixels of the image are 0.94 mm on the shipped print, so 0.533 line pairs/mm are the most that they show; "
    "bars just below beat with them. Bars lie along the sensor's rows and columns and the edge does not, and lambda "
    "is chosen for each image: the two need not agree.",
)  # fmt: skip


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


EXPERIMENTS = {each.name: each for each in (DISTANCE, BINNING, RESOLUTION)}

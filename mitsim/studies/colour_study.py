"""Colours of a ColorChecker: Delta E 2000 of each patch to its spectrum in daylight, by patterns and by ways to see it.

*Floor*: no camera, but the matrix from reflectances at the projector's lines to XYZ; what three lines cannot tell.
*Rendered*: frames of every line with the sensor's noise, a calibration and a solve for each. *One calibration for all*:
the middle line's factors serve all lines. *D65*: a lamp of daylight shines on the chart, its frame taken off. *Mosaic*:
all lines at once behind colour filters (:mod:`mitsim.studies.lit_lines`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mitsim.acquire.capture import expose
from mitsim.acquire.exposure import ambient_shots
from mitsim.core.arrays import FloatArray
from mitsim.core.images import lightness
from mitsim.devices.chart import ChartPlace, load_chart
from mitsim.metrics import psnr
from mitsim.reconstruct.colour import ColourModel, chart, delta_e, linear_srgb
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.report import label
from mitsim.report.colour_image import by_patch, halves
from mitsim.report.pages import Table, Value
from mitsim.report.plots import BLUE, FONT, VERMILION, figure_of, label_axes, panels_of
from mitsim.studies import daylight as by_lux
from mitsim.studies.daylight import BY_LUX, GOAL, DaylitLine
from mitsim.studies.framework.claims import difference, every, sample_mean, verdict, within
from mitsim.studies.framework.experiment import Claim, Experiment, Found, PageTable, Results, Scope
from mitsim.studies.framework.setup import Point
from mitsim.studies.framework.studio import Studio
from mitsim.studies.lit_lines import LitLine, available_ways, daylight_frame, lit_lines, mosaic_shots, serving

FAMILIES = ("uniform", "dots:7", "hadamard:8")
OWN, ONE = "one line at a time", "one calibration for all lines"
DAYLIGHT = {"D65 a tenth as bright as the projector": 0.1, "D65 as bright as the projector": 1.0}
"""Irradiance of daylight on the chart's middle over that of the projector's white light: some 60 and 600 lx, a dim room
and a bright office (:data:`mitsim.studies.daylight.FULL_LX`)."""
_IMAGE = "xyz"
_SHOWN = "dots:7"


def _points(scope: Scope) -> Sequence[Point]:
    setup = scope.setup if scope.pictures == (None,) else replace(scope.setup, scene="colour_checker")
    seen = {
        OWN: FAMILIES,
        ONE: scope.chosen(FAMILIES, (_SHOWN,)),
        **{way: scope.chosen(FAMILIES, (_SHOWN,)) for way in DAYLIGHT},
        **{f"mosaic, {way}": scope.chosen((_SHOWN, "hadamard:8"), (_SHOWN,)) for way in available_ways()},
    }
    points = [
        Point.of(setup, way=way, patterns=patterns, seed=seed)
        for seed in scope.repeats
        for way, families in seen.items()
        for patterns in (families if seed in scope.seeds else (_SHOWN,))
    ]
    return points + by_lux.points_of(scope, setup)


def _measure(studio: Studio, point: Point) -> Found:
    setup, way, patterns, seed = point.setup, str(point["way"]), str(point["patterns"]), int(point["seed"])
    lines = studio.once("lines", 1, (setup, seed), lambda: lit_lines(setup, seed))
    if way.startswith("mosaic"):
        shots = studio.once("mosaic", 1, (setup, patterns, seed), lambda: mosaic_shots(lines, patterns, seed))
        images = np.moveaxis(shots.images(way.removeprefix("mosaic, ")), 0, -1)
    elif way in (*DAYLIGHT, BY_LUX):
        light = studio.once("daylight", 1, setup, lambda: daylight_frame(setup, studio.folder("daylight")))
        if way == BY_LUX:
            return by_lux.measure_ladder(lines, light, point, _place(setup.scene))
        images = _under_daylight(lines, light, DAYLIGHT[way], patterns, seed)
    else:
        middle = lines[len(lines) // 2]
        factors = [line.factors if way == OWN else serving(line, middle) for line in lines]
        images = np.stack([_solve(*pair, patterns, seed) for pair in zip(lines, factors, strict=True)], axis=-1)
    truth = np.stack([line.lit.truth for line in lines], axis=-1)
    board = lines[0].factors.manifest.board_reflectance or 1.0
    return _judge(point, [line.wavelength_nm for line in lines], images * board, truth * board)


def _solve(line: LitLine, factors: Factors, patterns: str, seed: int) -> FloatArray:
    """(n, n) image of a line, as a user's own frames are exposed and reconstructed."""
    return reconstruct(expose(line.lit.light, patterns, seed=line.seed(seed)), factors).image


def _under_daylight(
    lines: Sequence[LitLine], light: tuple[FloatArray, float], part: float, patterns: str, seed: int
) -> FloatArray:
    """(n, n, lines) images of frames beside a ``part`` of a lamp's ``light`` (irradiance and wavelength), less it."""
    images = []
    for line in lines:
        lit = DaylitLine.of(line, light, patterns, seed)
        shots = 0 if lit.family.signed else ambient_shots(lit.family)
        images += lit.images([(part, seed)], [lit.model], shots)[0]
    return np.stack(images, axis=-1)


def _judge(point: Point, wavelengths: Sequence[float], images: FloatArray, truth: FloatArray) -> Found:
    """Rows of all patches of the chart in ``images`` (n, n, lines), and its colours."""
    place, known, fixed = _place(point.setup.scene), chart(), ColourModel.of_lines(wavelengths)
    means = place.means(images)
    seen, fitted = fixed.xyz(means), ColourModel.fitted(wavelengths, means, "").xyz(means)
    columns: dict[str, Any] = {
        "floor": delta_e(fixed.xyz(known.at(wavelengths)), known.xyz),
        "delta_e": delta_e(seen, known.xyz),
        "delta_e_fitted": delta_e(fitted, known.xyz),
        "delta_e_pixel": [
            float(delta_e(fixed.xyz(block), xyz).mean())
            for block, xyz in zip(place.blocks(images), known.xyz, strict=True)
        ],
        "delta_e_truth": delta_e(fixed.xyz(place.means(truth)), known.xyz),
        "delta_e_to_noise_free": delta_e(seen, fixed.xyz(place.means(truth))),
    }
    lines, n = len(wavelengths), images.shape[0]
    quality = psnr(images.reshape(n, -1), truth.reshape(n, -1))
    by_line = {
        f"psnr_{wave:g}nm": psnr(images[..., index], truth[..., index]) for index, wave in enumerate(wavelengths)
    }
    rows = [
        point.row(
            number=number, patch=name, lines=lines, psnr_db=quality, **by_line,
            **{column: float(values[number]) for column, values in columns.items()},
            **{f"truth_{axis}": float(value) for axis, value in zip("XYZ", known.xyz[number], strict=True)},
            **{axis: float(value) for axis, value in zip("XYZ", seen[number], strict=True)},
        )
        for number, name in enumerate(known.names)
    ]  # fmt: skip
    return Found(tuple(rows), {_IMAGE: fixed.xyz(images).astype(np.float32)})


def _place(scene: str) -> ChartPlace:
    path = Path(scene)
    return load_chart(path.with_name("chart.json") if path.suffix == ".xml" else scene)


def _claims(results: Results) -> Sequence[Claim]:
    table = results.table

    def told(way: str) -> Claim:
        rows = table.where(way=way, patterns=_SHOWN)
        floor, mean = rows.mean("floor").value, sample_mean(rows, "delta_e")
        return Claim(
            f"49 dots add at most {GOAL:g} to the floor's mean Delta E 2000 ({way})",
            "", "", f"mean Delta E {mean}, floor {floor:.2f}", verdict(within(mean, high=floor + GOAL)),
        )  # fmt: skip

    beside = table.where(way=BY_LUX)
    own, one = (table.where(way=way, patterns=_SHOWN) for way in (OWN, ONE))
    loss, more = difference(own, one, "psnr_db"), difference(one, own, "delta_e")
    mosaics = [way for way in table.distinct("way") if str(way).startswith("mosaic")]
    found = {way: table.where(way=way, patterns=_SHOWN) for way in mosaics}
    *others, joint = found.values()
    return [
        told(OWN),
        *(by_lux.claim_of(beside, patterns) for patterns in beside.distinct("patterns")),
        Claim(
            "Each line needs a calibration of its own (49 dots)", "", "",
            f"one for all: {loss} dB less, mean Delta E {more:+}", verdict(within(loss, low=0)),
        ),
        Claim(
            f"Behind a mosaic, the joint solve has the most PSNR of {len(found)} (49 dots)", "", "",
            "; ".join(
                f"{way}: {sample_mean(rows, 'psnr_db')} dB, Delta E {sample_mean(rows, 'delta_e')}"
                for way, rows in found.items()
            ),
            verdict(every(*(within(difference(joint, other, "psnr_db"), low=0) for other in others))),
        ),
    ]  # fmt: skip


def _figures(results: Results) -> Mapping[str, Figure]:
    table = results.table
    drawn = {"delta_e.png": _by_patch(table.where(way=OWN)), "ways.png": _by_way(table)}
    rows = table.where(way=OWN, patterns=_SHOWN).rows
    drawn["chart.png"] = _patches(rows[: len(chart().names)])
    drawn["images.png"] = _images(results)
    drawn["daylight.png"] = by_lux.figure(table.where(way=BY_LUX))
    return drawn


def _by_patch(table: Table) -> Figure:
    """Delta E of each patch: the floor, and what each family of patterns comes to."""
    names = [str(name) for name in table.distinct("patch")]
    found = {
        label(family): [table.mean("delta_e", patch=name, patterns=family).value for name in names]
        for family in FAMILIES
    }
    return by_patch(names, [table.mean("floor", patch=name).value for name in names], found)


def _by_way(table: Table) -> Figure:
    """Mean Delta E of each way to see colour, under 49 dots."""
    rows = table.where(patterns=_SHOWN)
    ways = [way for way in rows.distinct("way") if way != BY_LUX]
    figure, axes = figure_of(0.42 * len(ways) + 1.0)
    means = [rows.mean("delta_e", way=way).value for way in ways]
    bars = axes.barh(ways, means, color=BLUE)
    axes.bar_label(
        bars,
        [f"{mean:.2f}, {rows.mean('psnr_db', way=way).value:.1f} dB" for mean, way in zip(means, ways, strict=True)],
        padding=3,
        fontsize=FONT - 1,
    )
    floor = rows.mean("floor").value
    axes.axvline(floor, color=VERMILION, lw=1.5)
    axes.text(floor, -0.75, f"floor {floor:.2f}", color=VERMILION, fontsize=FONT - 1, ha="center", va="bottom")
    axes.invert_yaxis()
    axes.margins(x=0.25)
    axes.tick_params(labelsize=FONT - 1)
    label_axes(axes, f"mean Delta E 2000 of 24 patches, {label(_SHOWN)}", "", grid="x")
    return figure


def _patches(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """The chart: left half of a patch its spectrum's colour, right half what the camera found."""
    known, seen = (np.array([[row[f"{which}{axis}"] for axis in "XYZ"] for row in rows]) for which in ("truth_", ""))
    title = f"Left half: the patch's spectrum in D65. Right half: {label(_SHOWN)}. Number: Delta E 2000"
    names, values = [str(row["patch"]) for row in rows], [float(row["delta_e"]) for row in rows]
    return halves(names, values, known, seen, title)


def _images(results: Results) -> Figure:
    """What each family of patterns recovers, in colour."""
    figure, (places,) = panels_of(1, len(FAMILIES), 3.2)
    for axes, family in zip(places, FAMILIES, strict=True):
        row = results.table.where(way=OWN, patterns=family).rows[0]
        image = results.array(row, _IMAGE)
        if image is not None:
            axes.imshow(lightness(linear_srgb(image)), interpolation="none")
        axes.set(xticks=[], yticks=[])
        mean = results.table.mean("delta_e", way=OWN, patterns=family).value
        axes.set_title(label(family), fontsize=FONT)
        axes.set_xlabel(f"{row['psnr_db']:.1f} dB, mean Delta E {mean:.2f}", fontsize=FONT - 1)
    return figure


def _tables(results: Results) -> Sequence[PageTable]:
    """Delta E of each patch by what found it, and its mean by way and patterns."""
    table, own = results.table, results.table.where(way=OWN)
    names = [str(name) for name in own.distinct("patch")]

    def row(title: str, **chosen: str) -> tuple[str, ...]:
        known = (own.mean(column, patterns=_SHOWN, **chosen) for column in ("floor", "delta_e_truth"))
        found = (own.mean("delta_e", patterns=family, **chosen) for family in FAMILIES)
        return (title, *(f"{mean.value:.2f}" for mean in (*known, *found)))

    def cell(way: Value, family: str) -> str:
        rows = table.where(way=way, patterns=family)
        return f"{rows.mean('delta_e').value:.2f}, {rows.mean('psnr_db').value:.1f} dB" if rows.rows else "-"

    labels = tuple(map(label, FAMILIES))
    return (
        PageTable(
            "Mean Delta E 2000 of 24 patches, and PSNR of all lines, by the way to see colour",
            ("Way", *labels),
            tuple(
                (str(way), *(cell(way, family) for family in FAMILIES))
                for way in table.distinct("way")
                if way != BY_LUX
            ),
        ),
        *by_lux.tables(table.where(way=BY_LUX)),
        PageTable(
            f"Delta E 2000 of each patch to its spectrum in D65, {OWN}: the floor (no camera), the truth (no noise), "
            "and what is reconstructed",
            ("Patch", "Floor", "Truth", *labels),
            (row(f"mean of {len(names)}"), *(row(name, patch=name) for name in names)),
        ),
    )


EXPERIMENT = Experiment(
    "colour",
    "Colours of a ColorChecker",
    "How near are recovered colours to those of the patches' spectra, and what does each way to see colour cost?",
    _points, _measure, _claims, _figures, _tables,
    about="A chart of known spectra on rendered frames: light of each line traced with diffraction at the mask and "
    "falloff, and the sensor's noise, solved with factors that were calibrated from rendered frames.",
    heads=("", "", "Found"),
)  # fmt: skip

"""Colours of a ColorChecker: Delta E 2000 of each patch to its spectrum in daylight, by patterns and by ways to see it.

*Floor*: no camera, but the matrix from reflectances at the projector's lines to XYZ; what three lines cannot tell.
*Rendered*: frames of every line with the sensor's noise, a calibration and a solve for each. *One calibration for all*:
the middle line's factors serve all lines. *D65*: a lamp of daylight shines on the chart, its frame taken off. *Mosaic*:
all lines at once behind colour filters (:mod:`mitsim.studies.lit_lines`).

Daylight of any illuminance is measured by two ways to solve the same frames, beside the least that any linear image
without bias comes to, from which follows what keeps the goal in more light: repeats, or laser power. Frames of k times
the power in k times the daylight are the same at a k-th of the exposure, so that power counts as less daylight does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mitsim.acquire.capture import expose
from mitsim.acquire.exposure import ambient_shots
from mitsim.core.arrays import FloatArray
from mitsim.core.images import lightness
from mitsim.devices.framelist import ChartPlace, load_chart
from mitsim.metrics import psnr
from mitsim.reconstruct.colour import ColourModel, chart, delta_e, linear_srgb
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.reconstruct.request import MARKOV, TIKHONOV
from mitsim.reconstruct.solution import Solution
from mitsim.report import label
from mitsim.report.pages import Mean, Table, Value
from mitsim.report.plots import (
    BLUE,
    FONT,
    GREEN,
    VERMILION,
    WIDTH,
    curves,
    figure_of,
    grouped_bars,
    image_grid,
    label_axes,
)
from mitsim.studies import lit_lines
from mitsim.studies.framework.claims import every, verdict, within
from mitsim.studies.framework.experiment import Claim, Found, Point, Results, Scope, Setup
from mitsim.studies.framework.legacy import Experiment, difference, sample_mean
from mitsim.studies.framework.page import Part
from mitsim.studies.framework.studio import Studio, flags_of

# -------- Beside daylight of any brightness

GOAL = 0.5
"""Most that 49 dots may add to the floor's mean Delta E."""
BY_LUX = "D65, by its illuminance"
"""Rows of the mean Delta E under :data:`LADDER_LX`, by ``method``; they have no patches."""
LADDER_LX, DRAWS = (0.0, 5.0, 10.0, 20.0, 60.0, 200.0, 600.0), 3
"""Illuminances of daylight [lx], dark, dusk, a dim room, a bright office; and exposures at each."""
LEAST = "least without bias"
METHODS = TIKHONOV, MARKOV, LEAST
"""Of the column ``method``: two ways to solve the same frames, and what no linear image without bias is below."""
_FEW_LX, _ASKED_LX = (0.0, 60.0), (60.0, 600.0)
"""Of a quick look: the dark, and where the goal is near its end; and those for which the page says what they take."""
_LADDER_FAMILIES = ("dots:7", "hadamard:8")
_BETWEEN_LX, _VARIANCES = (1e-2, 1e5), (1e-6, 1.0)
"""Where the illuminance that keeps the goal, and the part of one exposure's variance that does, are looked for."""


def ladder_points(scope: Scope, setup: Setup) -> list[Point]:
    """A point for each family: all of its exposures share its frames.

    Parameters
    ----------
    scope, setup
        how much is wanted, and of what.
    """
    ladder, draws = (_FEW_LX, 2) if scope.quick else (LADDER_LX, DRAWS)
    lux = " ".join(f"{each:g}" for each in ladder)
    return [
        Point.of(setup, way=BY_LUX, patterns=patterns, seed=scope.seeds[0], ladder=lux, draws=draws)
        for patterns in scope.choose(_LADDER_FAMILIES, _LADDER_FAMILIES[:1])
    ]


def measure_ladder(
    lines: Sequence[lit_lines.LitLine], light: tuple[FloatArray, float], point: Point, place: ChartPlace
) -> Found:
    """A row for every exposure and method, and one of the least for every illuminance.

    Parameters
    ----------
    lines
        the scene in each line's light.
    light
        daylight as bright as the projector: irradiance (m, m') [W m^-2], and wavelength [nm] of its photons.
    point
        of :func:`ladder_points`.
    place
        of the chart's patches.
    """
    ladder = [float(lux) for lux in str(point["ladder"]).split()]
    model, known = ColourModel.of_lines([line.wavelength_nm for line in lines]), chart()
    board = lines[0].factors.manifest.board_reflectance or 1.0

    def judge(means: FloatArray) -> FloatArray:
        return delta_e(model.xyz(means * board), known.xyz)

    lit = [lit_lines.DaylitLine.of(line, light, str(point["patterns"]), int(point["seed"])) for line in lines]
    draws = list(product(ladder, range(int(point["draws"]))))
    exposures = [(lux / lit_lines.FULL_LX, draw) for lux, draw in draws]
    images = [each.images(exposures, [each.model, each.model.with_correlation()], each.shots) for each in lit]
    truth = place.means(np.stack([line.lit.truth for line in lines], axis=-1))
    goal = float(delta_e(model.xyz(known.at(model.wavelengths_nm)), known.xyz).mean()) + GOAL

    def least(lux: float, repeats: float = 1.0) -> float:
        variances = [each.least_variance(lux / lit_lines.FULL_LX, place) / repeats for each in lit]
        return lit_lines.expected_delta_e(truth, np.stack(variances, axis=-1), judge)

    def repeats(lux: float) -> float | None:
        part = lit_lines.most(lambda part: least(lux, 1 / part) <= goal, *_VARIANCES)
        return float(np.ceil(1 / part)) if part else None

    kept = lit_lines.most(lambda lux: least(lux) <= goal, *_BETWEEN_LX)
    rows = [
        point.row(
            lux=lux,
            draw=draw,
            method=method,
            mean_delta_e=float(judge(place.means(_stacked(found))).mean()),
            **flags_of(*(line.status for line in found)),
        )
        for (lux, draw), by_line in zip(draws, zip(*images, strict=True), strict=True)
        for method, found in zip((TIKHONOV, MARKOV), zip(*by_line, strict=True), strict=True)
    ]
    for lux in ladder:
        power = lux / kept if kept else None
        needed = {"kept_lx": kept, "repeats": repeats(lux), "power": power}
        rows.append(point.row(lux=lux, method=LEAST, mean_delta_e=least(lux), **needed))
    return Found(tuple({**row, "goal_delta_e": goal} for row in rows))


def ladder_claim(rows: Table, patterns: str) -> Claim:
    """Up to which illuminance a family keeps the goal.

    Parameters
    ----------
    rows, patterns
        those of :data:`BY_LUX`, and the family.
    """
    own = rows.where(patterns=patterns)
    by_lux, goal = own.where(method=MARKOV).means("mean_delta_e", "lux"), own.mean("goal_delta_e").value
    kept, last = kept_lx(by_lux, goal), max(by_lux)
    limit = f"the brightest tried, {last:g} lx" if kept == last else f"{_digits(kept)} lx"
    least = own.mean("kept_lx", method=LEAST).value
    holds = within(by_lux[last if kept == last else min(by_lux)], high=goal) if kept in (0, last) else True
    return Claim(
        f"{label(patterns)} add at most {GOAL:g} to the floor's mean Delta E 2000 beside D65 ({MARKOV})", "", "",
        f"kept up to {limit}; without bias at best up to {_digits(least)} lx",
        verdict(holds) if kept in (0, last) else f"confirmed only if D65 has at most {_digits(kept)} lx",
    )  # fmt: skip


def kept_lx(by_lux: Mapping[float, Mean], goal: float) -> float:
    """Illuminance [lx] up to which a mean Delta E is at most a goal; 0 where it never is.

    Parameters
    ----------
    by_lux
        by illuminance [lx]; straight between two over the logarithm, from the dark on over the illuminance itself.
    goal
        the most.
    """
    order = sorted(by_lux)
    if by_lux[order[0]].value > goal:
        return 0.0
    for low, high in pairwise(order):
        first, second = by_lux[low].value, by_lux[high].value
        if second > goal:
            share = (goal - first) / (second - first)
            return float(low * (high / low) ** share if low else high * share)
    return order[-1]


def _digits(value: float) -> str:
    """A ``value`` to two digits, without a power of ten."""
    return f"{float(f'{value:.2g}'):g}"


def ladder_figure(rows: Table) -> Figure:
    """Mean Delta E by the illuminance of daylight, measured and least, and what is allowed; ``rows`` of
    :data:`BY_LUX`."""
    panels = {}
    for patterns in rows.distinct("patterns"):
        own = rows.where(patterns=patterns)
        shown = {method: own.where(method=method).means("mean_delta_e", "lux") for method in METHODS}
        shown[f"floor + {GOAL:g}"] = own.means("goal_delta_e", "lux")
        panels[label(patterns)] = {
            name: {lux: mean for lux, mean in curve.items() if lux} for name, curve in shown.items()
        }
    return curves(panels, "D65 on the chart [lx]", "mean Delta E 2000 of 24 patches [1]", log=True)


def ladder_tables(rows: Table) -> tuple[Part, Part]:
    """Mean Delta E by illuminance, and what keeps the goal; ``rows`` of :data:`BY_LUX`."""
    families = [str(patterns) for patterns in rows.distinct("patterns")]
    pairs = list(product(families, METHODS))
    chosen = [lux for lux in rows.distinct("lux") if lux in _ASKED_LX]

    def cell(lux: float, family: str, method: str) -> str:
        mean = rows.mean("mean_delta_e", lux=lux, patterns=family, method=method)
        return f"{mean.value:.2f}" if mean.of == 1 else f"{mean.value:.2f} \N{PLUS-MINUS SIGN} {mean.error:.2f}"

    def needs(family: str) -> tuple[str, ...]:
        least = rows.where(patterns=family, method=LEAST)
        by_lux = rows.where(patterns=family, method=MARKOV).means("mean_delta_e", "lux")
        kept = kept_lx(by_lux, least.mean("goal_delta_e").value), least.mean("kept_lx").value
        needed = [(least.numbers("repeats", lux=lux), least.numbers("power", lux=lux)) for lux in chosen]
        return (
            label(family), *map(_digits, kept),
            *(f"{count[0]:g}; {_digits(max(power[0], 1))}" if count and power else "never" for count, power in needed),
        )  # fmt: skip

    count = len(rows.where(method=MARKOV).distinct("draw"))
    return (
        Part(
            "Mean Delta E 2000 of 24 patches by the illuminance of D65 on the chart: mean and standard error of "
            f"{count} exposures, less a frame of as many shots as patterns", "",
            ("D65 [lx]", *(f"{label(family)}, {method}" for family, method in pairs)),
            tuple((f"{lux:g}", *(cell(lux, *pair) for pair in pairs)) for lux in rows.distinct("lux")),
        ),
        Part(
            f"What keeps the mean Delta E at most {GOAL:g} above the floor: D65 [lx] with one exposure a pattern; in "
            "more light repeats of all exposures, or times the laser power (the same as a filter that lets through "
            "one over that part of D65), by the least noise without bias", "",
            ("Patterns", f"Most [lx], {MARKOV}", f"Most [lx], {LEAST}",
             *(f"{lux:g} lx: repeats; power" for lux in chosen)),
            tuple(map(needs, families)),
        ),
    )  # fmt: skip


# -------- Every way to see the colours of the chart

FAMILIES = ("uniform", "dots:7", "hadamard:8")
OWN, ONE = "one line at a time", "one calibration for all lines"
DAYLIGHT = {"D65 a tenth as bright as the projector": 0.1, "D65 as bright as the projector": 1.0}
"""Irradiance of daylight on the chart's middle over that of the projector's white light: some 60 and 600 lx, a dim room
and a bright office (:data:`mitsim.studies.lit_lines.FULL_LX`)."""
_IMAGE = "xyz"
_SHOWN = "dots:7"


def _points(scope: Scope) -> Sequence[Point]:
    setup = scope.setup if scope.pictures == (None,) else replace(scope.setup, scene="colour_checker")
    seen = {
        OWN: FAMILIES,
        ONE: scope.choose(FAMILIES, (_SHOWN,)),
        **{way: scope.choose(FAMILIES, (_SHOWN,)) for way in DAYLIGHT},
        **{f"mosaic, {way}": scope.choose((_SHOWN, "hadamard:8"), (_SHOWN,)) for way in lit_lines.available_ways()},
    }
    points = [
        Point.of(setup, way=way, patterns=patterns, seed=seed)
        for seed in scope.repeats
        for way, families in seen.items()
        for patterns in (families if seed in scope.seeds else (_SHOWN,))
    ]
    return points + ladder_points(scope, setup)


def _measure(studio: Studio, point: Point) -> Found:
    setup, way, patterns, seed = point.setup, str(point["way"]), str(point["patterns"]), int(point["seed"])
    lines = studio.once("lines", 1, (setup, seed), lambda: lit_lines.light_lines(setup, seed))
    if way.startswith("mosaic"):
        shots = studio.once("mosaic", 1, (setup, patterns, seed), lambda: lit_lines.mosaic_shots(lines, patterns, seed))
        found = shots.images(way.removeprefix("mosaic, "))
        images, flags = np.moveaxis(found.images, 0, -1), flags_of(found.joint.status) if found.joint else {}
    elif way in (*DAYLIGHT, BY_LUX):
        light = studio.once("daylight", 1, setup, lambda: lit_lines.daylight_frame(setup, studio.folder("daylight")))
        if way == BY_LUX:
            return measure_ladder(lines, light, point, _place(setup.scene))
        solved = _under_daylight(lines, light, DAYLIGHT[way], patterns, seed)
        images, flags = _stacked(solved), flags_of(*(each.status for each in solved))
    else:
        middle = lines[len(lines) // 2]
        factors = [line.factors if way == OWN else lit_lines.serving(line, middle) for line in lines]
        solved = [_solve(*pair, patterns, seed) for pair in zip(lines, factors, strict=True)]
        images, flags = _stacked(solved), flags_of(*(each.status for each in solved))
    truth = np.stack([line.lit.truth for line in lines], axis=-1)
    board = lines[0].factors.manifest.board_reflectance or 1.0
    return _judge(point, [line.wavelength_nm for line in lines], images * board, truth * board, flags)


def _solve(line: lit_lines.LitLine, factors: Factors, patterns: str, seed: int) -> Solution:
    return reconstruct(expose(line.lit.light, patterns, seed=line.seed(seed)), factors)


def _stacked(solved: Sequence[Solution]) -> FloatArray:
    """Return the images of all lines, (n, n, lines)."""
    return np.stack([each.image for each in solved], axis=-1)


def _under_daylight(
    lines: Sequence[lit_lines.LitLine], light: tuple[FloatArray, float], part: float, patterns: str, seed: int
) -> list[Solution]:
    """Solve frames of each line beside a ``part`` of a lamp's ``light`` (irradiance and wavelength), less it."""
    images = []
    for line in lines:
        lit = lit_lines.DaylitLine.of(line, light, patterns, seed)
        shots = 0 if lit.family.signed else ambient_shots(lit.family)
        images += lit.images([(part, seed)], [lit.model], shots)[0]
    return images


def _judge(
    point: Point, wavelengths: Sequence[float], images: FloatArray, truth: FloatArray, flags: Mapping[str, Any]
) -> Found:
    """Rows of all patches of the chart in ``images`` (n, n, lines), and its colours."""
    place, known, fixed = _place(point.setup.scene), chart(), ColourModel.of_lines(wavelengths)
    means = place.means(images)
    seen, fitted = fixed.xyz(means), ColourModel.fit(wavelengths, means, "").xyz(means)
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
            number=number, patch=name, lines=lines, psnr_db=quality, **by_line, **flags,
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

    def reported(way: str) -> Claim:
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
        reported(OWN),
        *(ladder_claim(beside, patterns) for patterns in beside.distinct("patterns")),
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
    drawn["daylight.png"] = ladder_figure(table.where(way=BY_LUX))
    return drawn


_TILE = 24
"""Pixels a side of a patch in the picture of the chart."""
_BAR = "#c7d2de"
"""What is below every marker: lighter than these."""


def _by_patch(table: Table) -> Figure:
    """Delta E of each patch by family, above the floor."""
    names = [str(name) for name in table.distinct("patch")]
    found = {
        label(family): [table.mean("delta_e", patch=name, patterns=family).value for name in names]
        for family in FAMILIES
    }
    figure, axes = figure_of(4.4)
    place = np.arange(len(names))
    floor = [table.mean("floor", patch=name).value for name in names]
    axes.bar(place, floor, 0.8, color=_BAR, label="floor: no camera, these lines alone")
    for (title, values), colour, marker in zip(found.items(), (VERMILION, BLUE, GREEN), ("s", "o", "^"), strict=False):
        axes.plot(place, values, marker, ms=5, color=colour, label=title)
    axes.set_xticks(place, names, rotation=45, ha="right", rotation_mode="anchor", fontsize=FONT - 2)
    axes.margins(x=0.01)
    label_axes(axes, "", "Delta E 2000 to the spectrum in D65", grid="y")
    axes.legend(fontsize=FONT - 1, frameon=False, ncols=4, loc="lower left", bbox_to_anchor=(0, 1.0))
    return figure


def _by_way(table: Table) -> Figure:
    """Mean Delta E of each way to see colour, under 49 dots, above the floor."""
    rows = table.where(patterns=_SHOWN)
    means = {
        f"{way}, {rows.mean('psnr_db', way=way).value:.1f} dB": rows.mean("delta_e", way=way)._replace(error=0.0)
        for way in rows.distinct("way")
        if way != BY_LUX
    }
    floor = {"floor, no camera": rows.mean("floor")._replace(error=0.0)}
    groups = {
        **{way: {"found": mean} for way, mean in means.items()},
        **{way: {"floor": mean} for way, mean in floor.items()},
    }
    return grouped_bars(groups, f"mean Delta E 2000 of 24 patches, {label(_SHOWN)} [1]", ordered=True)


def _patches(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """The chart: left half of a patch its spectrum's colour, right half what the camera found."""
    known, seen = (np.array([[row[f"{which}{axis}"] for axis in "XYZ"] for row in rows]) for which in ("truth_", ""))
    truth, found = (lightness(linear_srgb(each)) for each in (known, seen))
    figure, axes = figure_of(0.62 * WIDTH)
    axes.set_facecolor("#3a3a3a")
    for number, row in enumerate(rows):
        top, left = divmod(number, 6)
        tile = np.concatenate([np.tile(each[number], (_TILE, _TILE // 2, 1)) for each in (truth, found)], axis=1)
        axes.imshow(tile, extent=(left + 0.06, left + 0.94, top + 0.78, top + 0.06), interpolation="none")
        words = f"{row['patch']}  {row['delta_e']:.1f}"
        axes.text(left + 0.5, top + 0.98, words, ha="center", va="bottom", color="white", fontsize=FONT - 3)
    axes.set(xlim=(0, 6), ylim=(4.05, 0), xticks=[], yticks=[], aspect="auto")
    axes.set_title(
        f"Left half: the patch's spectrum in D65. Right half: {label(_SHOWN)}. Number: Delta E 2000", fontsize=FONT
    )
    return figure


def _images(results: Results) -> Figure:
    """What each family of patterns recovers, in colour."""
    cells = []
    for family in FAMILIES:
        rows = results.table.where(way=OWN, patterns=family)
        image = results.array(rows.rows[0], _IMAGE)
        caption = f"{rows.rows[0]['psnr_db']:.1f} dB,\nmean Delta E {rows.mean('delta_e').value:.2f}"
        cells += [(linear_srgb(image), caption)] if image is not None else []
    return image_grid({OWN: cells}, [label(family) for family in FAMILIES])


def _tables(results: Results) -> Sequence[Part]:
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
        Part(
            "Mean Delta E 2000 of 24 patches, and PSNR of all lines, by the way to see colour",
            "",
            ("Way", *labels),
            tuple(
                (str(way), *(cell(way, family) for family in FAMILIES))
                for way in table.distinct("way")
                if way != BY_LUX
            ),
        ),
        *ladder_tables(table.where(way=BY_LUX)),
        Part(
            f"Delta E 2000 of each patch to its spectrum in D65, {OWN}: the floor (no camera), the truth (no noise), "
            "and what is reconstructed",
            "",
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

"""A lamp beside the projector, from a hundredth of its light to a hundred times: what is left once it is taken off.

Paper, supplement: one uniform pattern, 64 dots and 64 Hadamard patterns under ambient light, whose reference frame is
subtracted; the dynamic range of the measurements decides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from mitsim.report import EQUAL_PEAK, RENDERED, in_text
from mitsim.report.lit_scene import Unexposed
from mitsim.report.pages import Mean, Table, Value
from mitsim.report.plots import curves
from mitsim.studies.framework.claims import by_patterns, difference, finding, images, verdict, within
from mitsim.studies.framework.experiment import Claim, Experiment, Found, Results, Scope
from mitsim.studies.framework.setup import Point
from mitsim.studies.framework.studio import Studio

RADIANCES = (1.17, 11.7, 117.0, 1170.0, 11700.0)
"""Of the scene's lamp [W m^-2 sr^-1]: that of lamp_bench lights its sheet a hundredth as the projector does, to a
hundred times."""
FAMILIES = ("uniform", "dots:8", "hadamard:8")
_SPREAD = (1.0, 99.0)
"""Percentiles that a dynamic range lies between: single pixels' noise is no signal."""


def _points(scope: Scope) -> Sequence[Point]:
    own = scope.pictures == (None,)
    setup = scope.setup if own else replace(scope.setup, scene="lamp_bench")
    setups = [
        setup.printed(name).changed(lamp=f"{radiance:g}")
        for name in scope.chosen(scope.pictures, scope.pictures[:1])
        for radiance in scope.chosen(RADIANCES, RADIANCES[::2])
    ]
    fixed = {"model": (RENDERED,), "exposure": (EQUAL_PEAK,)}
    return Point.grid(setups, "model patterns exposure seed", seed=scope.seeds, patterns=FAMILIES, **fixed)


def _measure(studio: Studio, point: Point) -> Found:
    setup, patterns, seed = point.setup, str(point["patterns"]), int(point["seed"])
    image = studio.image(setup, RENDERED, patterns, seed)
    low, high = _range(studio.frames(setup, RENDERED, patterns, seed))
    ratio = _ratio(studio.frames(setup, RENDERED, "uniform", seed))
    return finding(point, image.image, ratio=ratio, range_low=low, range_high=high, **image.row())


def _ratio(uniform: Unexposed) -> float:
    """Light of the lamp over the projector's in frames of ``uniform`` light, on the whole sensor."""
    (white,) = uniform.expected
    lamp = uniform.expected.projector_off.irradiance.sum()
    return float(lamp / (white.irradiance.sum() - lamp))


def _by_lamp(table: Table) -> Table:
    """Rows with the lamp's ratio a mean over prints, which differ by a tenth, to two digits."""
    ratios = {lamp: float(f"{table.mean('ratio', lamp=lamp).value:.2g}") for lamp in table.distinct("lamp")}
    return Table(tuple({**row, "ratio": ratios[row["lamp"]]} for row in table.rows))


def _range(frames: Unexposed) -> tuple[float, float]:
    """Part of the full well that ``frames`` take up without the lamp's light, from dark to bright pixels."""
    exposer = frames.exposer(frames.seconds(EQUAL_PEAK))
    dark = exposer.electrons(frames.expected.projector_off)
    ends = [np.percentile(exposer.electrons(frame) - dark, _SPREAD) for frame in frames.expected]
    low, high = np.mean(ends, axis=0) / frames.lit.bench.sensor.superpixel_full_well_e
    return float(low), float(high)


def _claims(results: Results) -> Sequence[Claim]:
    table = _by_lamp(results.table)
    ratios = table.distinct("ratio")
    least, most = ratios[0], ratios[-1]
    strong = next((ratio for ratio in ratios if ratio >= 1), most)

    def psnr_text(family: str, ratio: float) -> str:
        return f"{in_text(family)} {table.mean('psnr_db', patterns=family, ratio=ratio)} dB"

    def spread(family: str) -> str:
        rows = table.where(patterns=family, ratio=strong)
        low, high = (rows.mean(name).value for name in ("range_low", "range_high"))
        return f"{in_text(family)} {low:.3f} to {high:.3f}"

    def more(ratio: float, column: str) -> Mean:
        hadamard, dots = (table.where(patterns=name, ratio=ratio) for name in ("hadamard:8", "dots:8"))
        return difference(hadamard, dots, column)

    gains = {ratio: more(ratio, "psnr_db") for ratio in ratios}
    holds = {ratio: within(gain, low=0) for ratio, gain in gains.items()}
    better = [ratio for ratio, each in holds.items() if each]
    beyond = better == [ratio for ratio in ratios if better and ratio >= better[0]]
    where = f"from {better[0]:g} times on" if better else "at no ratio"
    return [
        Claim(
            "Under strong ambient light dots keep less dynamic range than Hadamard patterns (part of the full well)",
            "0 to 0.02 against 0.06 to 0.17", "",
            f"lamp {strong:g} times: {spread('dots:8')}, {spread('hadamard:8')}",
            verdict(within(more(strong, "range_high"), low=0)),
        ),
        Claim(
            "Hadamard patterns are better under strong ambient light", "better", "",
            f"{where}; lamp {strong:g} times: {psnr_text('dots:8', strong)}, {psnr_text('hadamard:8', strong)}; "
            f"lamp {most:g} times: {psnr_text('dots:8', most)}, {psnr_text('hadamard:8', most)}",
            "confirmed only at some ratios" if better and not beyond else
            verdict(True if better else None if None in holds.values() else False),
        ),
        Claim(
            "Dots are preferred when ambient light is not strong: they take half the frames", "preferred",
            "", f"lamp {least:g} times: {psnr_text('dots:8', least)}, {psnr_text('hadamard:8', least)}",
            verdict(within(gains[least], high=0)),
        ),
    ]  # fmt: skip


def _figures(results: Results) -> Mapping[str, Figure]:
    table = _by_lamp(results.table)
    axis, lines = "lamp's light over the projector's [1]", by_patterns(table)

    def panel(title: str, column: str, y_axis: str) -> Figure:
        shown = {name: rows.means(column, "ratio") for name, rows in lines.items()}
        return curves({"": shown}, axis, y_axis, log=True, title=title)

    drawn = {
        "psnr.png": panel("PSNR by the lamp's light, exposure equal peak", "psnr_db", "PSNR [dB]"),
        "range.png": panel(
            "The projector's light in bright pixels (99th percentile)", "range_high", "part of the full well [1]"
        ),
    }
    ratios: list[Value] = table.distinct("ratio")
    names, title = [f"lamp {ratio:g} times" for ratio in ratios], "Images by the lamp's light, exposure equal peak"
    return drawn | images("images.png", results, lines, "ratio", ratios, title, names)


EXPERIMENT = Experiment(
    "ambient",
    "A lamp beside the projector",
    "How much ambient light does each kind of pattern stand?",
    _points, _measure, _claims, _figures,
    heads=("Paper", "", "Rendered"),
    note="The lamp's light is its part of a frame of uniform light over the projector's, on the whole sensor. From "
    "every frame a frame with the projector off is taken; its noise stays. PSNR of an even grey is that of no image: "
    "12 to 20 dB, by the print's contrast.",
)  # fmt: skip

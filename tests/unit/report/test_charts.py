"""Figures of studies and of results, and numbers, means and warnings as pages and figures print them."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

import mitsim as ms
from mitsim.acquire.capture import Rendered
from mitsim.core.errors import MitsimError
from mitsim.core.images import lightness, linear_light
from mitsim.report.pages import Mean, round_to_error, scientific, typeset
from mitsim.report.plots import curves, grouped_bars
from tests.exchanged import made
from tests.unit.planner.test_choice import plan as invented_plan


def test_curves_are_in_the_order_of_their_numbers() -> None:
    """Also where these are text, and a single value has no standard error. (Planted: text in its own order.)"""
    nan = float("nan")
    shown = {"10": Mean(3.0, 0.5, 2), "2.5": Mean(1.0, nan, 1), "4": Mean(2.0, 0.5, 2)}
    figure = curves({"above": {"a": shown}, "below": {"a": shown}}, "x [mm]")
    line = figure.axes[0].containers[0].lines[0]
    assert np.array_equal(line.get_xdata(), [2.5, 4, 10]) and np.array_equal(line.get_ydata(), [1, 2, 3])
    assert [axes.get_title() for axes in figure.axes] == ["above", "below"]
    assert [axes.get_xlabel() for axes in figure.axes] == ["", "x [mm]"]
    assert [axes.get_ylabel() for axes in figure.axes] == ["PSNR [dB]"] * 2


def test_a_curve_without_points_keeps_its_colour_from_others() -> None:
    """So that a cause looks alike in two figures, of which one lacks another; and it has no line in the legend.
    (Planted: colours by the curves that there are.)"""
    there = {"1": Mean(1.0, 0.1, 2), "2": Mean(1.0, 0.1, 2)}
    with_all, without = (curves({"": {"a": there, "b": middle, "c": there}}, "x [mm]") for middle in (there, {}))
    colours = [figure.axes[0].containers[-1].lines[0].get_color() for figure in (with_all, without)]
    assert colours[0] == colours[1]
    assert [text.get_text() for text in without.legends[0].get_texts()] == ["a", "c"]


def test_an_error_that_nobody_knows_is_no_bar_of_zero() -> None:
    """(Planted: zeros for what is not known, whose caps look like a sure number.)"""
    single, several = (
        curves({"": {"a": {"1": Mean(1.0, error, 1), "2": Mean(2.0, error, 1)}}}, "x [mm]").axes[0].containers[0]
        for error in (float("nan"), 0.5)
    )
    assert several.has_yerr and not single.has_yerr
    pair = {"measured": Mean(2.0, float("nan"), 1), "predicted": Mean(1.0, 0.2, 4)}
    both = grouped_bars({"mask, 2 um": pair}, "lost [dB]")
    assert [container.has_xerr for container in both.axes[0].containers if hasattr(container, "has_xerr")] == [True]
    assert [tick.get_text() for tick in both.axes[0].get_yticklabels()] == ["mask, 2 \N{GREEK SMALL LETTER MU}m"]


def curve(*points: tuple[float, float]) -> dict[float, Mean]:
    return {x: Mean(y, float("nan"), 1) for x, y in points}


@pytest.mark.parametrize(
    ("points", "scales"),
    [
        (((1, 1e-4), (1000, 1e-1)), ("log", "log")),
        (((1, 20.0), (64, 30.0)), ("log", "linear")),
        (((380, 20.0), (420, 30.0)), ("linear", "linear")),
        (((0, 0.0), (1000, 1e-1)), ("linear", "linear")),
        (((-1, -1e-4), (1000, 1e-1)), ("linear", "linear")),
    ],
)
def test_an_axis_over_decades_is_logarithmic(points: tuple[tuple[float, float], ...], scales: tuple[str, str]) -> None:
    """Where none of its numbers is 0 or below. (Planted: x as its caller says, y always linear.)"""
    (axes,) = curves({"": {"a": curve(*points)}}, "x [mm]", "y [1]").axes
    assert (axes.get_xscale(), axes.get_yscale()) == scales


def test_a_panel_of_nothing_is_left_out() -> None:
    """One point, or none that is a number, tells nothing along x. (Planted: an empty panel beside the other.)"""
    nothing = {"point": {"a": curve((1, 20.0))}, "nan": {"a": curve((1, float("nan")), (2, float("nan")))}}
    figure = curves({**nothing, "told": {"a": curve((1, 20.0), (2, 30.0))}}, "x [mm]")
    assert [axes.get_title() for axes in figure.axes] == ["told"]
    assert not curves(nothing, "x [mm]").axes


# ---- Numbers and texts ----


TIMES, MICRO = "\N{MULTIPLICATION SIGN}", "\N{GREEK SMALL LETTER MU}"


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("one anchor leaves 7.8e-04", f"one anchor leaves 7.8{TIMES}10⁻⁴"),
        ("condition 6.2e+06.", f"condition 6.2{TIMES}10⁶."),
        ("0.0e+00 of them, below 1e-3", "0 of them, below 10⁻³"),
        ("up to 9.4e-02 and 3.87e-02, 7.0e+02 of 1.0e+00", "up to 0.094 and 0.0387, 700 of 1.0"),
        ("512 x 512 pixels of 11.72 um", f"512 {TIMES} 512 pixels of 11.72 {MICRO}m"),
        ("3x3 anchors, -3.5 +- 0.1 dB", f"3{TIMES}3 anchors, -3.5 \N{PLUS-MINUS SIGN} 0.1 dB"),
        ("dots:7x16, abc1e-3, v1.2e3x, the um of 23 mm", "dots:7x16, abc1e-3, v1.2e3x, the um of 23 mm"),
    ],
)
def test_numbers_in_a_text_are_printed_and_names_are_left_alone(text: str, printed: str) -> None:
    """No pattern's name is a size, and no number 10 to the power of nothing."""
    assert typeset(text) == printed


@pytest.mark.parametrize(
    ("value", "printed"),
    [
        (None, "\N{EN DASH}"),
        (0.0, "0"),
        (0.011, "0.0110"),
        (1234.4, "1234"),
        (999.6, "1000"),
        (99.97, "100"),
        (2.6e-3, f"2.6{TIMES}10⁻³"),
        (-6.2e6, f"-6.2{TIMES}10⁶"),
    ],
)
def test_a_number_keeps_its_digits(value: float | None, printed: str) -> None:
    """Not 0.011 beside 0.0108, nor 1.23e+03 for 1234."""
    assert scientific(value) == printed


@pytest.mark.parametrize(
    ("value", "error", "printed"),
    [(0.66877, 0.00088, "0.66877"), (-3.8364e-4, 0.0012, "-0.0004"), (128_314.0, 880.0, "128310"), (1.5, 0.0, "1.5")],
)
def test_a_measured_number_ends_where_its_error_does(value: float, error: float, printed: str) -> None:
    """No digits of a number whose first one is not known."""
    assert round_to_error(value, error) == printed


# ---- Means with standard errors, against numpy ----


def test_a_mean_has_the_standard_error_of_its_numbers() -> None:
    """(Planted: deviation with n in the denominator.)"""
    mean = Mean.of_numbers([20.0, 23.0, 26.0], "psnr_db")
    assert mean.value == 23 and mean.of == 3
    assert mean.error == pytest.approx(np.std([20, 23, 26], ddof=1) / 3**0.5)
    single = Mean.of_numbers([40.0], "psnr_db")
    assert single.value == 40 and math.isnan(single.error) and str(single) == "40.0" and "23.0 ± 1.7" in str(mean)
    with pytest.raises(MitsimError, match="nothing was measured of psnr_db"):
        Mean.of_numbers([], "psnr_db")


def test_an_error_of_a_mean_is_never_nought() -> None:
    """(Planted: one place whatever the error, so 0.04 dB was 0.0.)"""
    assert str(Mean(23.41, 0.04, 2)) == "23.41 \N{PLUS-MINUS SIGN} 0.04"
    assert str(Mean(23.41, 0.94, 2)) == "23.4 \N{PLUS-MINUS SIGN} 0.9" and str(Mean(23.41, math.nan, 1)) == "23.4"


# ---- Results on axes: units, numbers, and no global state of matplotlib ----


def test_no_pyplot_is_loaded() -> None:
    program = (
        "import sys; from mitsim.report import plots; plots.image_grid({'': [([[0.5]], '')]}, ['a']);"
        "sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


# ---- results on axes -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> tuple[ms.Capture, ms.Factors, ms.Reconstruction]:
    """Of a camera that nobody rendered."""
    bench = made(tmp_path_factory.mktemp("plots") / "made")
    shots, factors = ms.load_run(bench.run), ms.load_calibration(bench.calibration)
    return shots, factors, ms.reconstruct(shots, factors)


def axes() -> Axes:
    return Figure().subplots()


def test_results_are_drawn_on_the_axes_that_are_given(results: tuple[Any, Any, Any]) -> None:
    """Their own numbers, with a title, units on axes and colour bar, and how numbers become greys. (Planted: a frame's
    digital numbers for its electrons; a colour bar without its mapping; axes of a new figure.)"""
    shots, factors, image = results
    sensed = ms.sense(np.outer(np.ones(5), np.linspace(1e-3, 1e-2, 6)), "imx249")
    rendered = Rendered(np.full((4, 6, 3), 0.5), np.zeros((4, 6, 3)), {"estimator": "factored"})
    drawings: list[tuple[Any, dict[str, Any], Any, str]] = [
        (shots, {"shot": 2}, shots.dn[2], "[DN], linear"),
        (shots, {"shot": 1, "quantity": "electrons"}, shots.electrons[1], "[e-], linear"),
        (shots, {"quantity": "truth"}, shots.truth, "reflectance, 1 = board, shown by the sRGB curve"),
        (factors, {}, factors.left, "e^-/s"),
        (factors, {"side": "right"}, factors.right, "linear"),
        (image, {}, image.image, "reflectance, 1 = board, shown by the sRGB curve"),
        (image, {"quantity": "uncertainty"}, image.uncertainty, "reflectance, 1 = board, linear"),
        (sensed, {}, sensed.digital, "[DN], linear"),
        (rendered, {}, np.full((4, 6), 0.5), "[W/m$^2$], linear"),
    ]
    for result, options, values, unit in drawings:
        own = axes()
        drawn = result.plot(**options, ax=own)
        assert drawn is own and np.array_equal(np.asarray(own.images[0].get_array()), values), (result, options)
        assert own.get_title() and "pixel]" in own.get_xlabel() and "pixel]" in own.get_ylabel()
        (bar,) = (other for other in own.figure.axes if other is not own)
        assert unit in bar.get_ylabel(), bar.get_ylabel()
        own.figure.canvas.draw()


def test_reflectances_are_shown_as_a_screen_shows_them(results: tuple[Any, Any, Any]) -> None:
    """Half of the light is three quarters of the way to white, as in image.png; the bar is told of what is cut.
    (Planted: greys in equal steps.)"""
    drawn = results[2].plot(ax=axes())
    picture = drawn.images[0]
    assert picture.norm(0.5) == pytest.approx(0.7354, abs=1e-4) and picture.get_clim() == (0.0, 1.0)
    shades = np.linspace(0, 1, 50)
    assert np.allclose(lightness(linear_light(shades)), shades, atol=1e-7)


def test_a_plan_is_drawn_as_errors_and_as_seconds() -> None:
    """(Planted: an effect that is left out of the chart; seconds of the wrong stage.)"""
    kept = replace(invented_plan(1e-3), predicted={"plan": 1.0, "transport": 2.5, "write": 0.2})
    own = kept.plot(ax=axes())
    named = {text.get_text().partition(" (")[0] for text in own.get_yticklabels()}
    assert named == {row.name for row in kept.effects if row.error_if_off is not None}
    assert "[1]" in own.get_xlabel() and own.get_xscale() == "log"
    stages = kept.plot("seconds", ax=axes())
    widths = {
        text.get_text(): bar.get_width() for text, bar in zip(stages.get_yticklabels(), stages.patches, strict=True)
    }
    assert widths == kept.predicted and "[s]" in stages.get_xlabel()


def test_a_drawing_for_a_paper_is_written_as_three_files(results: tuple[Any, Any, Any], tmp_path: Path) -> None:
    """The PDF is 89 mm wide [252.28 pt] with its fonts embedded as TrueType, all letters have at most 8 pt, a long
    label is broken and not cut off, and a second drawing has the same bytes. (Planted: files with the date; the width
    of the screen; fonts of type 3.)"""
    for name in ("one.pdf", "two"):
        own = results[2].plot(ax=axes(), output=tmp_path / name, style="paper")
    assert len([*tmp_path.iterdir()]) == 6
    for ending in ("png", "svg", "pdf"):
        assert (tmp_path / f"one.{ending}").read_bytes() == (tmp_path / f"two.{ending}").read_bytes(), ending
    pdf = (tmp_path / "one.pdf").read_bytes()
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ", pdf)
    assert box and float(box[1]) == pytest.approx(89 / 25.4 * 72, abs=1e-3)
    assert b"/FontFile2" in pdf and b"/Type3" not in pdf and b"CreationDate" not in pdf
    assert Image.open(tmp_path / "one.png").size[0] == round(89 / 25.4 * 300)
    assert max(text.get_fontsize() for text in own.figure.findobj(Text)) <= 8
    (bar,) = (other for other in own.figure.axes if other is not own)
    assert bar.get_ylabel().replace("\n", " ") == "reflectance, 1 = board, shown by the sRGB curve"
    assert bar.yaxis.label.get_window_extent().height <= own.figure.bbox.height


def test_what_is_not_known_is_not_drawn(results: tuple[Any, Any, Any]) -> None:
    shots, _, image = results
    for draw, line in (
        (lambda: shots.plot(shot=99), "shot 99: give 0 to 5"),
        (lambda: shots.plot(quantity="light"), "quantity 'light': give 'dn' or 'electrons' or 'truth'"),
        (lambda: image.plot("depth"), "quantity 'depth': is not known of this image"),
        (lambda: image.plot(style="poster"), "style 'poster': give 'screen' or 'paper'"),
        (lambda: image.plot(output="no such/x"), "the folder no such does not exist"),
        (lambda: image.plot(outptu="x"), "outptu is no option of plot; did you mean output"),
        (lambda: image.plot(ax="here"), "ax 'here': give a Axes or None"),
    ):
        with pytest.raises(MitsimError, match=line):
            draw()


def test_without_axes_there_is_a_figure_of_pyplot(results: tuple[Any, Any, Any]) -> None:
    """Which notebooks show."""
    from matplotlib import pyplot

    before = pyplot.get_fignums()
    with pyplot.rc_context({"backend": "agg"}):
        drawn = results[0].plot()
    assert pyplot.fignum_exists(drawn.figure.number) and len(pyplot.get_fignums()) == len(before) + 1
    pyplot.close(drawn.figure)

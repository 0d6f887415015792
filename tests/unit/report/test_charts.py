"""Figures of studies: curves by numbers in order, grids with their own titles."""

import numpy as np
import pytest

from mitsim.report.pages import Mean
from mitsim.report.plots import curves, grouped_bars, image_grid


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


def test_a_grid_has_a_title_of_its_own_and_one_for_each_column() -> None:
    """(Planted: the last column's for the whole.)"""
    cells = [(np.full((4, 4), value), f"{value} dB") for value in (0.2, 0.8)]
    figure = image_grid({"one": cells, "two": cells}, ["a", "b"], "all of them")
    assert figure.get_suptitle() == "all of them"
    assert [axes.get_title() for axes in figure.axes] == ["a", "b", "", ""]
    assert [axes.get_xlabel() for axes in figure.axes] == ["0.2 dB", "0.8 dB"] * 2
    assert [axes.get_ylabel() for axes in figure.axes] == ["one", "", "two", ""]


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


def test_what_an_image_has_lost_and_would_lose_are_told_apart() -> None:
    """Each kind of bar has its colour. (Planted: one colour.)"""
    groups = {
        "noise": {"has lost": Mean(2.0, 0.1, 1)},
        "b": {"would lose": Mean(3.0, 0.1, 1)},
        "a": {"would lose": Mean(1.0, 0.1, 1)},
    }
    (axes,) = grouped_bars(groups, "lost [dB]").axes
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["noise", "b", "a"], "from the top"
    legend = axes.get_legend()
    assert legend and [text.get_text() for text in legend.get_texts()] == ["has lost", "would lose"]
    assert len({patch.get_facecolor() for patch in axes.patches}) == 2
    single = grouped_bars({"noise": groups["noise"]}, "lost [dB]").axes[0]
    assert single.get_legend() is None


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

"""Figures of studies: curves by numbers in order, grids with their own titles."""

import numpy as np

from mitsim.report.pages import Mean
from mitsim.report.plots import bars, curves, image_grid, pair_chart


def test_curves_are_in_the_order_of_their_numbers() -> None:
    """Also where these are text, and a single value has no standard error. (Planted: text in its own order.)"""
    nan = float("nan")
    shown = {"10": Mean(3.0, 0.5, 2), "2.5": Mean(1.0, nan, 1), "4": Mean(2.0, 0.5, 2)}
    figure = curves({"left": {"a": shown}, "right": {"a": {}}}, "x [mm]")
    line = figure.axes[0].containers[0].lines[0]
    assert np.array_equal(line.get_xdata(), [2.5, 4, 10]) and np.array_equal(line.get_ydata(), [1, 2, 3])
    assert [axes.get_title() for axes in figure.axes] == ["left", "right"]
    assert figure.axes[0].get_xlabel() == "x [mm]" and figure.axes[0].get_ylabel() == "PSNR [dB]"


def test_a_curve_without_points_keeps_its_colour_from_others() -> None:
    """So that a cause looks alike in two figures, of which one lacks another; and it has no line in the legend.
    (Planted: colours by the curves that there are.)"""
    there = {"1": Mean(1.0, 0.1, 2)}
    with_all, without = (curves({"": {"a": there, "b": middle, "c": there}}, "x [mm]") for middle in (there, {}))
    colours = [figure.axes[0].containers[-1].lines[0].get_color() for figure in (with_all, without)]
    assert colours[0] == colours[1]
    assert [text.get_text() for text in without.legends[0].get_texts()] == ["a", "c"]


def test_long_names_of_rows_take_two_lines() -> None:
    """(Planted: one; "49 dots, idealised" then ran into the next row's beside small images.)"""
    cells = [(np.zeros((4, 4)), "")] * 8
    figure = image_grid({"49 dots, idealised": cells, "card": cells}, [""] * 8)
    assert [axes.get_ylabel() for axes in figure.axes[::8]] == ["49 dots,\nidealised", "card"]


def test_a_grid_has_a_title_of_its_own_and_one_for_each_column() -> None:
    """(Planted: the last column's for the whole.)"""
    cells = [(np.full((4, 4), value), f"{value} dB") for value in (0.2, 0.8)]
    figure = image_grid({"one": cells, "two": cells}, ["a", "b"], "all of them")
    assert figure.get_suptitle() == "all of them"
    assert [axes.get_title() for axes in figure.axes] == ["a", "b", "", ""]
    assert [axes.get_xlabel() for axes in figure.axes] == ["0.2 dB", "0.8 dB"] * 2
    assert [axes.get_ylabel() for axes in figure.axes] == ["one", "", "two", ""]


def test_long_titles_of_columns_take_two_lines() -> None:
    """(Planted: one; "as the matt scene" then ran into its neighbour.)"""
    cells = [(np.zeros((4, 4)), "")] * 6
    figure = image_grid({"card": cells}, ["49 dots\nas the matt scene"] * 6)
    assert figure.axes[0].get_title() == "49 dots\nas the matt\nscene"


def test_a_title_stands_above_all_panels() -> None:
    """(Planted: the last panel's own.)"""
    figure = curves({"left": {"a": {"1": Mean(1.0, 0.1, 2)}}, "right": {"a": {}}}, "x [mm]", title="both")
    assert figure.get_suptitle() == "both"


def test_an_error_that_nobody_knows_is_no_bar_of_zero() -> None:
    """(Planted: zeros for what is not known, whose caps look like a sure number.)"""
    single, several = (
        curves({"": {"a": {"1": Mean(1.0, error, 1), "2": Mean(2.0, error, 1)}}}, "x [mm]").axes[0].containers[0]
        for error in (float("nan"), 0.5)
    )
    assert several.has_yerr and not single.has_yerr
    both = pair_chart(
        {"mask, 2 um": (Mean(2.0, float("nan"), 1), Mean(1.0, 0.2, 4))}, ("measured", "predicted"), "lost [dB]"
    )
    assert [container.has_xerr for container in both.axes[0].containers if hasattr(container, "has_xerr")] == [True]
    assert [tick.get_text() for tick in both.axes[0].get_yticklabels()] == ["mask, 2 \N{GREEK SMALL LETTER MU}m"]


def test_a_curve_alone_has_no_legend_and_a_long_name_of_an_axis_two_lines() -> None:
    """(Planted: one line, which a figure cut off.)"""
    curve = {"1": Mean(1.0, 0.1, 2), "2": Mean(2.0, 0.1, 2)}
    figure = curves({"": {"": curve}}, "x [mm]", "misfit: part of the measurements that no image explains [1]")
    assert not figure.legends and "\n" in figure.axes[0].get_ylabel()


def test_what_an_image_has_lost_and_would_lose_are_told_apart() -> None:
    """Bars of two kinds are in one order, each kind in its colour. (Planted: one colour.)"""
    kinds = {"has lost": {"noise": Mean(2.0, 0.1, 1)}, "would lose": {"b": Mean(3.0, 0.1, 1), "a": Mean(1.0, 0.1, 1)}}
    (axes,) = bars(kinds, "lost [dB]").axes
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["a", "noise", "b"]
    legend = axes.get_legend()
    assert legend and [text.get_text() for text in legend.get_texts()] == ["has lost", "would lose"]
    assert len({patch.get_facecolor() for patch in axes.patches}) == 2
    single = bars({"has lost": kinds["has lost"], "would lose": {}}, "lost [dB]").axes[0]
    assert single.get_legend() is None

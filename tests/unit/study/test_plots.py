"""Figures say their units, show the numbers they were given, and leave matplotlib's global state alone."""

from __future__ import annotations

import subprocess
import sys

import numpy as np

from mitsim.study import plots


def test_every_axis_has_a_unit() -> None:
    figures = (
        plots.frame(np.ones((4, 4))),
        plots.singular_values({"a": np.ones(3)}),
        plots.error_bars({"a": 1e-3}, 1e-2),
        plots.seconds_by_stage({"a": 1.0}),
        plots.quality_bars(["a"], [20.0], [10.0]),
    )
    for figure in figures:
        axes = figure.axes[0]
        labels = [text for text in (axes.get_xlabel(), axes.get_ylabel()) if text]
        assert labels and all("[" in text for text in labels)


def test_frame_shows_row_zero_at_the_top_with_its_own_range() -> None:
    values = np.arange(12.0).reshape(3, 4)
    figure = plots.frame(values, unit="e-")
    drawn = figure.axes[0].images[0]
    assert np.array_equal(np.asarray(drawn.get_array()), values)
    assert drawn.get_clim() == (0.0, 11.0)
    low, high = figure.axes[0].get_ylim()
    assert low > high, "rows grow downwards"
    assert figure.axes[1].get_ylabel() == "signal [e-]"


def test_singular_values_are_sorted_and_relative_to_the_largest() -> None:
    line = plots.singular_values({"a": [1.0, 4.0, 2.0, 0.0]}).axes[0].lines[0]
    assert np.array_equal(np.asarray(line.get_ydata()), [1.0, 0.5, 0.25, 0.0])
    assert np.array_equal(np.asarray(line.get_xdata()), [25.0, 50.0, 75.0, 100.0])


def test_error_bars_put_the_largest_on_top_and_keep_the_limit_in_sight() -> None:
    axes = plots.error_bars({"small": 1e-5, "large": 1e-2}, limit=0.5).axes[0]
    assert [text.get_text() for text in axes.get_yticklabels()] == ["small", "large"]
    low, high = axes.get_xlim()
    assert low < 1e-5 and high > 0.5


def test_values_of_error_bars_stand_beside_the_axes_where_no_line_crosses_them() -> None:
    figure = plots.error_bars({"small": 1e-5, "close": 7.8e-4, "large": 1e-2}, limit=1e-3)
    figure.canvas.draw()
    axes = figure.axes[0]
    right = axes.get_window_extent().x1
    written = [text for text in axes.texts if "e-" in text.get_text() and "asked" not in text.get_text()]
    assert [text.get_text() for text in written] == ["1.0e-05", "7.8e-04", "1.0e-02"]
    for text in written:
        box = text.get_window_extent()
        assert box.x0 > right and box.x1 < figure.bbox.x1


def test_labels_of_a_frame_lie_inside_the_figure() -> None:
    figure = plots.frame(np.arange(262144.0).reshape(512, 512))
    figure.canvas.draw()
    for text in (figure.axes[0].yaxis.label, figure.axes[0].xaxis.label, figure.axes[1].yaxis.label):
        box = text.get_window_extent()
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1


def test_seven_families_can_be_told_apart() -> None:
    lines = plots.singular_values({str(k): np.ones(2) for k in range(7)}).axes[0].lines
    assert len({(line.get_color(), line.get_linestyle()) for line in lines}) == 7
    assert len({line.get_color() for line in lines}) == 7


def test_no_pyplot_is_loaded() -> None:
    program = (
        "import sys, numpy; from mitsim.study import plots; plots.frame(numpy.ones((4, 4)));"
        "sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0

"""Figures say their units, show the numbers they were given, and leave matplotlib's global state alone."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

import mitsim as ms
from mitsim.acquire.capture import Rendered
from mitsim.core.images import lightness, linear_light
from mitsim.report import plots
from mitsim.report.folder_page import Trust
from tests.exchanged import made
from tests.unit.planner.invented_pilot_result import plan as invented_plan


def test_stated_and_actual_errors_share_one_scale() -> None:
    """(Planted: each picture with a range of its own.)"""
    error = np.linspace(0.0, 0.01, 10_000).reshape(100, 100)
    stated, actual = Trust(np.full((100, 100), 0.004), error).pictures()
    white = f"black 0, white {np.percentile(error, 99):.3g} of the board"
    assert white in stated.caption and white in actual.caption
    assert "rms 0.0040" in stated.caption and "rms 0.0058" in actual.caption
    greys = np.asarray(Image.open(BytesIO(stated.data))).astype(float)
    assert np.abs(greys - 255 * lightness(0.004 / np.percentile(error, 99))).max() < 0.51


def test_singular_values_are_sorted_and_relative_to_the_largest() -> None:
    line = plots.singular_values({"a": [1.0, 4.0, 2.0, 0.0]}).axes[0].lines[0]
    assert np.array_equal(np.asarray(line.get_ydata()), [1.0, 0.5, 0.25, 0.0])
    assert np.array_equal(np.asarray(line.get_xdata()), [25.0, 50.0, 75.0, 100.0])


def test_no_pyplot_is_loaded() -> None:
    program = (
        "import sys; from mitsim.report import plots; plots.singular_values({'a': [2.0, 1.0]});"
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


def test_what_is_not_known_is_not_drawn(results: tuple[Any, Any, Any]) -> None:
    shots, _, image = results
    for draw, line in (
        (lambda: shots.plot(shot=99), "shot 99: give 0 to 5"),
        (lambda: shots.plot(quantity="light"), "quantity 'light': give 'dn' or 'electrons' or 'truth'"),
        (lambda: image.plot("depth"), "quantity 'depth': is not known of this image"),
        (lambda: image.plot(ax="here"), "ax 'here': give a Axes or None"),
    ):
        with pytest.raises(ms.ArgumentError, match=line):
            draw()


def test_without_axes_there_is_a_figure_of_pyplot(results: tuple[Any, Any, Any]) -> None:
    """Which notebooks show."""
    from matplotlib import pyplot

    before = pyplot.get_fignums()
    with pyplot.rc_context({"backend": "agg"}):
        drawn = results[0].plot()
    assert pyplot.fignum_exists(drawn.figure.number) and len(pyplot.get_fignums()) == len(before) + 1
    pyplot.close(drawn.figure)

"""The study of colours: its points, its verdicts on invented images, and a whole one of a small scene."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from mitsim.devices.framelist import load_chart
from mitsim.reconstruct.colour import ColourModel, chart, delta_e
from mitsim.report.pages import Table
from mitsim.studies import colour_study
from mitsim.studies.framework.experiment import Point, Results, Scope, Setup, find_experiment
from mitsim.studies.framework.run import batches
from tests.unit.studies.test_colour_daylight import rows_of

LINES = (638.0, 520.0, 445.0)


def images(scale: float = 1.0) -> np.ndarray:
    """(128, 128, 3) reflectances of the chart where scenes/colour_checker has it, times a scale."""
    seen = np.zeros((128, 128, 3))
    for values, (top, bottom, left, right) in zip(chart().at(LINES), load_chart("colour_checker").patches, strict=True):
        seen[top:bottom, left:right] = scale * values
    return seen


def results(**scales: float) -> Results:
    """Of images of the chart that are so many times too bright, by the way they were seen."""
    rows, arrays = [], {}
    dim, bright = colour_study.DAYLIGHT
    for way, scale in scales.items():
        named = {"own": colour_study.OWN, "one": colour_study.ONE, "dim": dim, "bright": bright}.get(
            way
        ) or f"mosaic, {way}"
        families = colour_study.FAMILIES if way == "own" else ("dots:7",)
        for family, seed in product(families, (0, 1)):
            point = Point.of(Setup("colour_checker"), way=named, patterns=family, seed=seed)
            found = colour_study._judge(point, LINES, images(scale), images(), {})
            rows += [{**row, "point": point.key} for row in found.rows]
            arrays |= {(point.key, name): array for name, array in found.arrays.items()}
    return Results(Table((*rows, *rows_of(2.0, 30.0).rows)), arrays)


def test_points_are_of_the_chart_and_share_its_light() -> None:
    points = find_experiment("colour").points(Scope(Setup(), ("chelsea", "page")))
    assert {point.setup.scene for point in points} == {"colour_checker"} and len(batches(points)) == 1
    few = find_experiment("colour").points(Scope(Setup("mine.xml"), (None,), quick=True))
    assert {point.setup.scene for point in few} == {"mine.xml"} and len(few) < len(points)


def test_an_exact_image_has_the_floors_colours() -> None:
    found = results(own=1.0).table.where(seed=0)
    floor = delta_e(ColourModel.of_lines(LINES).xyz(chart().at(LINES)), chart().xyz)
    assert np.allclose(found.where(patterns="dots:7").numbers("delta_e"), floor)
    assert np.allclose(found.where(patterns="dots:7").numbers("delta_e_pixel"), floor)
    assert found.mean("delta_e_to_noise_free").value == pytest.approx(0, abs=1e-9)
    assert results(own=1.1).table.mean("delta_e_to_noise_free").value > 1
    row = found.rows[18]
    assert row["patch"] == "white 9.5" and row["truth_Y"] == pytest.approx(chart().xyz[18, 1])


def test_verdicts_are_on_what_is_added_to_the_floor() -> None:
    """Images 2 % too bright are near it, 30 % are not; a scale is what a fitted matrix takes out, but for white. Beside
    daylight, rows of their own say up to where."""
    mosaics = {"half resolution": 0.9, "joint": 1.01}
    claims = colour_study._claims(results(own=1.02, one=1.3, dim=1.02, bright=1.3, **mosaics))
    beside = ["confirmed only if D65 has at most 30 lx"] * 2
    assert [claim.verdict for claim in claims] == ["confirmed", *beside, "confirmed", "confirmed"]
    assert "most PSNR of 2" in claims[4].claim
    swapped = colour_study._claims(
        results(own=1.3, one=1.01, dim=1.3, bright=1.01, **{"half resolution": 1.01, "joint": 0.9})
    )
    assert [claim.verdict for claim in swapped] == ["not confirmed", *beside, "not confirmed", "not confirmed"]


def test_every_figure_is_drawn() -> None:
    drawn = colour_study._figures(results(own=1.02, one=1.3, dim=1.02, bright=1.3, joint=1.01))
    assert set(drawn) == {"delta_e.png", "ways.png", "chart.png", "images.png", "daylight.png"}


def test_the_page_has_every_patch() -> None:
    """By patch: floor, truth and three families; images 2 % too bright are off the truth's, which is the floor's."""
    ways, ladder, needed, patches = colour_study._tables(results(own=1.02, one=1.3, dim=1.02, bright=1.3, joint=1.01))
    assert patches.head == ("Patch", "Floor", "Truth", "Uniform", "49 dots", "64 Hadamard")
    assert [row[0] for row in patches.rows] == ["mean of 24", *chart().names]
    assert all(row[1] == row[2] and row[3] == row[4] for row in patches.rows)
    assert patches.rows[0][1] == "4.37" and float(patches.rows[0][4]) != 4.37
    assert ways.rows[0][0] == colour_study.OWN and ways.rows[-1][1] == "-", "mosaics are not seen under uniform light"
    assert "dB" in ways.rows[0][2] and colour_study.BY_LUX not in [row[0] for row in ways.rows]
    assert [len(table.rows) for table in (ladder, needed)] == [3, 2]


@pytest.mark.slow
def test_a_small_scene_is_studied_whole(small_scene: Callable[..., Path], tmp_path: Path) -> None:
    """A grey that rises with wavelength, in a process of its own: the variant knows wavelengths."""
    path = small_scene(n=32)
    text = path.read_text(encoding="utf-8").replace("$albedo", "380:0.2, 780:0.6")
    path.write_text(text, encoding="utf-8")
    boxes = [[8 * i + 1, 8 * i + 7, 5 * j + 1, 5 * j + 4] for i in range(4) for j in range(6)]
    (path.parent / "chart.json").write_text(json.dumps({"spectra": "ColorChecker N Ohta", "patches": boxes}))
    command = ["study", "colour", str(path), "-o", str(tmp_path / "out"), "--quick", "--jobs", "1", "--json", "--quiet"]
    done = subprocess.run([sys.executable, "-m", "mitsim", *command], capture_output=True, text=True)
    reported = json.loads(done.stdout)
    judged = [row for row in reported["rows"] if row["way"] in (colour_study.OWN, colour_study.ONE, "mosaic, joint")]
    judged += [row for row in reported["rows"] if row.get("method") in ("tikhonov", "markov")]
    assert all(isinstance(row["flagged"], bool) for row in judged)
    assert done.returncode == any(row["flagged"] for row in judged) == bool(reported["warnings"]), done.stderr
    assert reported["points"] >= 6 and {row["way"] for row in reported["rows"]} >= {colour_study.OWN, "mosaic, joint"}
    own = [row for row in reported["rows"] if row["way"] == colour_study.OWN and row["patterns"] == "dots:7"]
    assert all(row["psnr_db"] > 25 for row in own)

"""The drawing of a bench is to scale, and its page needs no network."""

from __future__ import annotations

import html
import itertools
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.testing import assert_allclose

from mitsim.api.bench import open_bench
from mitsim.bench.layout import Layout, Preview, Surface
from mitsim.core.errors import MitsimError
from mitsim.report.lit_scene import BenchView

CORNERS = np.array([[60.0, 60, 400], [-60, 60, 400], [-60, -60, 400], [60, -60, 400]])


@pytest.fixture(scope="module")
def seen(shared_scene: Callable[..., Path], variant: str) -> BenchView:
    """Of a made layout: nothing is traced. A tower of 30 x 50 mm stands at 340 to 380 mm, a lamp far above."""
    box = np.array([[x, y, z] for x in (-10.0, 20) for y in (-60, -10) for z in (340, 380)])
    sides = [[0, 1, 3], [0, 3, 2], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4], [2, 3, 7], [2, 7, 6]]
    tower = Surface("tower", box, np.array(sides), np.full((8, 1), 0.5), False)
    sheet = Surface("sheet", CORNERS, np.array([[0, 1, 2], [0, 2, 3]]), np.full((4, 3), 0.8), False)
    lamp = Surface("lamp", CORNERS + [0, 900, 0], np.array([[0, 1, 2]]), np.full((4, 1), 0.8), True)
    layout = Layout(
        surfaces=(tower, sheet, lamp),
        projector=np.array([60.0, 0, 0]),
        window=CORNERS,
        lamps={"bulb, line 3": np.array([0.0, 90, 300])},
        seen=250,
        depths=(340.0, 400.0),
        moves=(0.0, 3200.0),
        obstacles=(),
    )
    picture = Preview(np.full((8, 8, 1), 0.5), np.eye(4), 0.2)
    return BenchView(open_bench(shared_scene("seen")), layout, (picture, picture))


def drawn(seen: BenchView, axis: int) -> Figure:
    figure = Figure()
    seen._plan(figure.subplots(), axis)
    return figure


@pytest.mark.parametrize("axis", [0, 1])
def test_plans_are_to_scale(seen: BenchView, axis: int) -> None:
    """Both with one scale for z and x or y: the tower and the window are as wide as they are, the lamp is named for it
    has no room. (Planted: x and y exchanged; the aspect left to the sheet of
    paper; the lamp drawn over all from above.)"""
    (axes,) = drawn(seen, axis).axes
    assert axes.get_aspect() == 1.0
    (filled,) = axes.collections
    paths = [path.vertices for path in filled.get_paths()]
    assert len(paths) == 8 + 2
    tower = np.concatenate([path for path in paths if path[:, 0].min() < 385])
    assert_allclose(np.ptp(tower, axis=0), [40, (30, 50)[axis]])
    window = [line for line in axes.lines if line.get_linewidth() == 3.5]
    assert_allclose(window[0].get_xydata(), [[400, -60], [400, 60]])
    assert axes.get_title(loc="left").endswith("(outside: lamp)")
    texts = {text.get_text() for text in axes.texts}
    assert {"400 mm", "field stop, 20°", "calibrated plane"} <= texts
    assert ("60 mm" in texts) == (axis == 0) and ("camera and\nprojector" in texts) == (axis == 1)


def test_the_camera_is_drawn_with_its_own_mask(seen: BenchView) -> None:
    """Dark where the mask's code is 0, at its distance: s = -x. (Planted: the code upside down.)"""
    figure = Figure()
    seen._camera(figure.subplots())
    (lines,) = figure.axes[0].collections
    mask = seen.bench.geometry.build_mask()
    for (z, a), (_, b) in lines.get_segments():
        column = int(np.floor(-(a + b) / 2 / mask.feature_mm + len(mask.openings[0][1]) / 2))
        assert z == 2 and not mask.openings[0][1][column]
    assert len(lines.get_segments()) > 5


def test_words_state_what_the_numbers_do(seen: BenchView) -> None:
    words = seen.facts
    assert words["projector"] == "60 mm left of the camera's sensor"
    assert words["window"] == "120 x 120 mm at 400 mm, 16 x 16 pixels"
    assert words["light is seen"] == "from 340 to 400 mm, of 250 of 256 projector pixels (97.7%)"
    assert words["parallax"].endswith("by 0 rows and 1.41 columns of its pixels")
    said = json.loads(json.dumps(seen.summary()))
    assert (
        said["depths_mm"] == [340, 400]
        and said["parallax_pixels"] == pytest.approx([0, 24 / 17])
        and said["seen_pixels"] == 250
    )
    assert [each["name"] for each in said["surfaces"]] == ["tower", "sheet", "lamp"]
    flat = replace(seen, layout=replace(seen.layout, depths=(400.0, 400.0)))
    assert flat.facts["light is seen"].startswith("at 400 mm, ")
    assert flat.facts["parallax"].startswith("none; 4 mm nearer the window moves by 0 rows and 0.0808 columns")
    far = replace(seen, layout=replace(seen.layout, projector=np.array([-5.0, 20, -30])))
    assert far.facts["projector"] == "5 mm right of, 20 mm above, 30 mm behind the camera's sensor"
    dark = replace(seen, layout=replace(seen.layout, depths=None, seen=0, obstacles=("no light",)))
    assert dark.facts["light is seen"] == "nowhere" and dark.warnings == ("no light",)


def test_the_model_has_every_part_in_place(seen: BenchView) -> None:
    """Plotly's x is z of the bench, its z is y; only lamps have the lamp's colour, and the legend shows each surface in
    a colour of its own. (Planted: y for x; a line's corners in another order; one colour for all surfaces.)"""
    model = seen.model().data
    traces = {trace.name: trace for trace in model}
    squares = {trace.name: trace for trace in model if trace.legendgroup and trace.type == "scatter3d"}
    assert len({trace.marker.color for trace in squares.values()}) == len(seen.layout.surfaces)
    for name, square in squares.items():
        assert square.legendgroup == traces[name].legendgroup and not traces[name].showlegend
    places = {name: np.stack([trace.y, trace.z, trace.x], axis=1) for name, trace in traces.items()}
    for surface in seen.layout.surfaces:
        mesh = traces[surface.name]
        assert_allclose(places[surface.name], surface.points)
        assert_allclose(np.stack([mesh.i, mesh.j, mesh.k], axis=1), surface.triangles)
        assert (mesh.color is not None) == surface.is_lamp
    assert_allclose(traces["tower"].intensity, 0.735, atol=1e-3)  # 0.5 by the curve of sRGB
    assert_allclose(traces["sheet"].vertexcolor, 231)
    assert_allclose(places["bulb, line 3"], [[0, 90, 300]])
    line = places["projector and its light"].tolist()
    edges = {frozenset([tuple(a), tuple(b)]) for a, b in itertools.pairwise(line)}
    corners = [tuple(corner) for corner in CORNERS]
    around = zip(corners, [*corners[1:], corners[0]], strict=True)
    assert edges == {frozenset(edge) for edge in [*around, *((corner, (60.0, 0, 0)) for corner in corners)]}


def test_a_view_is_written_whole_or_not_at_all(
    seen: BenchView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """(Planted: the file opened before it is drawn.)"""
    with pytest.raises(MitsimError, match=r"output .*bench\.jpg: give a name that ends in \.png or \.html"):
        seen.save(tmp_path / "bench.jpg")
    (tmp_path / "bench.png").write_bytes(b"before")

    def broken(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(BenchView, "figure", broken)
    with pytest.raises(ZeroDivisionError):
        seen.save(tmp_path / "bench.png")
    assert [path.name for path in tmp_path.iterdir()] == ["bench.png"]
    assert (tmp_path / "bench.png").read_bytes() == b"before"


def test_names_of_a_scene_are_no_html(seen: BenchView, tmp_path: Path) -> None:
    """Plotly reads tags and entities in names, which are shown as they are; a page requests nothing, and dollar signs
    are no formula. (Planted: a surface's name as the scene has it; a name with dollar signs in the title.)"""
    bad = "<b style=\"background:url(http://evil.example/x)\">s</b>&lt;img src='http://evil.example'&gt; $^{x$"
    shapes = [replace(surface, name=bad) for surface in seen.layout.surfaces]
    layout = replace(seen.layout, surfaces=shapes, lamps={bad: np.array([0.0, 9000, 300])}, obstacles=(bad,))
    view = replace(seen, layout=layout)
    named = [trace.name for trace in view.model().data if "evil" in trace.name]
    assert len(named) == 2 * len(shapes) + 1 and {*named} == {html.escape(bad)}
    text = view.save(tmp_path / "bench.html").read_text()
    assert "<b style" not in text and "Plotly.newPlot(" in text
    assert re.search(r"<title>Bench: seen, Sony IMX249, [^<]*\d{4}-\d\d-\d\d \d\d:\d\d</title>", text)
    assert not re.search(r'<(script|link|img)[^>]*\b(src|href)="https?:', text)

"""`mitsim demo` on the small scene: it ends, the page stands alone, and the folder is its own."""

from __future__ import annotations

import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from tests.system.refusals import Call

LABELS = ("Uniform", "16 dots", "25 dots", "49 dots", "64 Hadamard")
FAMILIES = ("uniform", "dots:4", "dots:5", "dots:7", "hadamard:8")
LINKS = ("src", "href", "srcset", "data", "poster", "action", "xlink:href", "background")


class Links(HTMLParser):
    """Everything in a page that could make a browser fetch something."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.found += [value or "" for name, value in attrs if name in LINKS]


def assert_self_contained(page: Path) -> str:
    """The page refers to nothing outside itself; its text."""
    text = page.read_text(encoding="utf-8")
    links = Links()
    links.feed(text)
    assert not [link for link in links.found if not link.startswith(("data:image/", "#"))]
    assert not {"script", "link", "iframe", "object", "embed"} & set(links.tags)
    assert len([link for link in links.found if link.startswith("data:image/png;base64,")]) > 10
    bare = re.sub(r"data:image/png;base64,[A-Za-z0-9+/=]+", "", text)
    assert not re.search(r"https?://|file://|url\(|@import", bare)
    return bare


@pytest.fixture(scope="module")
def done(call: Call, lab: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A finished demo and its report."""
    folder: Path = tmp_path_factory.mktemp("demo") / "demo"
    options = lab.scene, "-o", folder, "--accuracy", "0.02", "--json"
    outcome = call("demo", *options)
    assert outcome.code == 0, outcome.err
    return folder, outcome.payload


def test_demo_compares_all_families(done: tuple[Path, dict[str, Any]]) -> None:
    folder, report = done
    assert {"psnr", "psnr_ideal", "gain_db", "seconds", "report"} <= report.keys()
    assert tuple(report["psnr"]) == tuple(report["psnr_ideal"]) == FAMILIES
    assert all(15 < value < 100 for value in [*report["psnr"].values(), *report["psnr_ideal"].values()])
    assert report["gain_db"] == pytest.approx(report["psnr"]["dots:7"] - report["psnr"]["uniform"])
    assert report["gain_db"] > 8
    assert tuple(report["exposure"]) == FAMILIES
    for rows in report["exposure"].values():
        assert set(rows) == {"equal peak", "equal frame", "equal total"}
    assert report["report"] == str(folder / "report.html")


def test_the_page_stands_alone_and_shows_every_family(done: tuple[Path, dict[str, Any]]) -> None:
    text = assert_self_contained(done[0] / "report.html")
    for label in (*LABELS, "equal peak", "equal frame", "equal total", "Sensor noise", "Calibration", "Monte Carlo"):
        assert label.lower() in text.lower(), label


def test_the_folders_are_those_of_capture_and_calibrate(
    call: Call, done: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    folder, report = done
    options = "--calibration", folder / "calibration", "-o", tmp_path / "image", "--json"
    found = call("reconstruct", folder / "run", *options).payload
    assert found["psnr"] == pytest.approx(report["psnr"]["dots:7"], abs=0.01)


@pytest.mark.slow
def test_a_second_demo_of_ones_own_devices_and_patterns_replaces_the_first(
    call: Call, lab: Any, done: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(done[0], tmp_path / "demo"))
    old = (folder / "report.html").stat().st_mtime_ns
    (folder / "run" / "frame_99999.exr").write_text("of another family")
    scene = lab.write_scene("grey_demo", reflectance=None)
    options = "--patterns", "dots:2", "-D", "albedo=0.4", "--seed", 1, "--quiet"
    second = call("demo", scene, *lab.electronics, "-o", folder, *options)
    assert second.code == 0 and "4 dots" in second.out and str(folder / "report.html") in second.out
    page = assert_self_contained(folder / "report.html")
    for words in ("test camera", "test projector", "albedo = 0.4", "4 dots", "exposure (4 dots)"):
        assert words in page, words
    reported = json.loads((folder / "demo.json").read_text())
    assert tuple(reported["psnr"]) == ("uniform", "dots:4", "dots:5", "dots:2", "hadamard:8")
    assert reported["verdict"].startswith("4 dots") and reported["verdict"] in page
    assert (folder / "report.html").stat().st_mtime_ns > old
    first, now = ({path.relative_to(place) for path in place.rglob("*")} for place in (done[0], folder))
    gone = {Path("run", f"frame_{index:05d}.exr") for index in range(4, 49)}
    assert now == first - gone, "nothing of the first is left"
    assert json.loads((folder / "run" / "manifest.json").read_text())["configuration"]["seed"] == 1


@pytest.mark.slow
def test_the_shipped_demo(shell: Call, tmp_path: Path) -> None:
    """The photograph at the default accuracy: 49 dots beat uniform light by at least 8 dB (issue 2)."""
    outcome = shell("demo", "-o", "demo", "--json", cwd=tmp_path)
    assert outcome.code == 0 and outcome.err == ""
    assert outcome.payload["gain_db"] >= 8 and outcome.payload["mc_error"] <= 1e-3
    assert_self_contained(tmp_path / "demo" / "report.html")

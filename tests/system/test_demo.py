"""`mitsim demo` on the small scene: it ends, and the folder is its own."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from tests.system.refusals import Call

LABELS = ("Uniform", "16 dots", "25 dots", "49 dots", "64 Hadamard")
FAMILIES = ("uniform", "dots:4", "dots:5", "dots:7", "hadamard:8")


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


def test_the_page_shows_every_family(done: tuple[Path, dict[str, Any]]) -> None:
    """With the numbers of the JSON, and links to the pages of its folders. (Planted: the idealised PSNR.)"""
    folder, report = done
    text = (folder / "report.html").read_text(encoding="utf-8")
    tables = [re.findall(r"<td[^>]*>(.*?)</td>", table) for table in text.split("<table")[1:]]
    levels = [[name, *(f"{value:.1f}" for value in report["exposure"][key].values())]
              for name, key in zip(LABELS, FAMILIES, strict=True)]  # fmt: skip
    assert tables[0] == [cell for line in levels for cell in line]
    assert tables[1][::7] == [*LABELS] and report["gain_db"] > 8 and "beat uniform by" in text
    assert [place for place in re.findall('href="(.*?)"', text) if (folder / place).is_file()] == [
        "run/report.html", "calibration/report.html"
    ]  # fmt: skip
    assert not re.search(r'<script|@import|url\(|src="(?!data:image/(png|svg.xml);base64,)', text)


def test_the_folders_are_those_of_capture_and_calibrate(
    call: Call, done: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    folder, report = done
    options = "--calibration", folder / "calibration", "-o", tmp_path / "image", "--json"
    found = call("reconstruct", folder / "run", *options).payload
    assert found["psnr"] == pytest.approx(report["psnr"]["dots:7"], abs=0.01)

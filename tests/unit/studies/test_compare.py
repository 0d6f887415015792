"""Comparison of images: quality in closed form, one scale, and refusals in one line."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mitsim as ms
from mitsim.core.exr import read_frame
from mitsim.core.files import read_json, write_json
from mitsim.report.reconstruct_run import reconstruct
from mitsim.studies.compare import Image, means_over_seeds
from tests.exchanged import made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two images of one run with truth; the first image in a file of other numbers, and plus 0.01."""
    place = tmp_path_factory.mktemp("compare")
    bench = made(place / "made")
    reconstruct(bench.run, bench.calibration, place / "one")
    reconstruct(bench.run, bench.calibration, bench.run / "reconstruction", lam=1e3)
    values = read_frame(place / "one" / "image.exr")[0]["reflectance"].astype(np.float64)
    np.save(place / "plus.npy", values + 0.01)
    np.save(place / "small.npy", values[:5])
    np.save(place / "holes.npy", np.where(values > 0.5, np.nan, values))
    (place / "bad.png").write_bytes(b"no picture")
    return place


def test_the_quality_of_an_image_plus_a_constant_is_known(folder: Path, tmp_path: Path) -> None:
    """A difference of 0.01 everywhere is 40 dB by definition, with a mean and an rms of 0.01; page, JSON and result
    agree. A picture of 8 bits is decoded, which the notes state, and differs by its steps alone. The run's truth judges
    files too. (Planted: the truth as the first image; a picture that is not decoded.)"""
    run = folder / "made" / "run"
    found = ms.compare([folder / "one", run, folder / "plus.npy", folder / "one" / "image.png"], tmp_path / "out")
    one, _, plus, picture = found.images
    assert [row["name"] for row in found.images] == ["one", "run", "plus.npy", "image.png"]
    assert plus["psnr_to_first"] == pytest.approx(40, abs=1e-5)
    assert found.largest_difference == pytest.approx(0.01, rel=0.2) and found.white == pytest.approx(1, abs=0.1)
    assert plus["mean_difference"] == pytest.approx(0.01) and plus["rms_difference"] == pytest.approx(0.01)
    image, truth = read_frame(folder / "one" / "image.exr")[0]["reflectance"], ms.load_run(run).truth
    assert truth is not None and one["psnr"] == pytest.approx(ms.psnr(image.astype(np.float64), truth))
    assert plus["psnr"] == pytest.approx(ms.psnr(np.load(folder / "plus.npy"), truth))
    assert picture["psnr_to_first"] > 45 and "sRGB" in picture["scale"] and one["scale"] == "as stored"
    assert found.notes[1] == f"Scales were matched: image.png was {picture['scale']}."
    assert read_json(tmp_path / "out" / "compare.json")["images"][2] == json.loads(json.dumps(plus))
    page = (tmp_path / "out" / "compare.html").read_text()
    assert "Scales were matched" in page and "40" in page and page.count("<img") == 2
    assert {path.name for path in (tmp_path / "out").iterdir() if path.suffix in (".png", ".svg", ".pdf")} == {
        f"{name}.{kind}" for name in ("images", "differences") for kind in ("png", "svg", "pdf")
    }


def test_images_of_several_seeds_have_a_mean_with_its_interval() -> None:
    """Student's interval of two numbers in closed form. (Planted: images of another setting in the same mean.)"""
    rows = [{"psnr": 30.0 + seed, "seed": seed, "mask": "open", "patterns": "", "method": ""} for seed in range(3)]
    images = [Image("", np.zeros((1, 1)), run={"setting": setting}) for setting in "aab"]
    (mean,) = means_over_seeds(images, rows)
    assert (mean["images"], mean["psnr"], mean["of"][0]) == (2, 30.5, "open")
    assert mean["psnr_ci95"] == pytest.approx(12.7062 / 2, rel=1e-4)


def test_a_flagged_image_is_said_to_be(folder: Path, tmp_path: Path) -> None:
    """(Planted: warnings of the first image alone.)"""
    flagged = Path(shutil.copytree(folder / "one", tmp_path / "flagged"))
    write_json(flagged / "result.json", read_json(flagged / "result.json") | {"warnings": ["Misfit: depth."]})
    found = ms.compare([folder / "one", flagged], tmp_path / "out")
    assert found.warnings == ("flagged is flagged: Misfit: depth.",)
    assert [row["flagged"] for row in found.images] == [False, True]


def test_files_are_the_same_each_time_and_replaced_if_asked(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The title's date apart. (Planted: a folder of something else replaced.)"""
    monkeypatch.setattr(time, "localtime", lambda *_: time.gmtime(0))
    both: list[Any] = [folder / "one", folder / "plus.npy"]
    kept = []
    for overwrite in (False, True):
        ms.compare(both, tmp_path / "out", overwrite=overwrite, style="paper")
        kept.append({path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()})
    assert kept[0] == kept[1]
    for place, options in ((tmp_path / "out", {}), (folder / "one", {"overwrite": True})):
        with pytest.raises(ms.MitsimError, match="the folder holds files already"):
            ms.compare(both, place, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("other", "line"),
    [
        ("small.npy", "image small.npy: has 5x14 pixels, but one has 10x14; compare images of one size"),
        ("holes.npy", r"holes\.npy: \d+ values are not finite"),
        ("bad.png", r"bad\.png: cannot be read"),
        ("nothing", "nothing: cannot be read"),
        ("made", "made: holds no image; give a folder of mitsim reconstruct or run"),
        (None, "compare: got 1 image; give two or more"),
    ],
)
def test_what_cannot_be_compared_is_refused(folder: Path, tmp_path: Path, other: str | None, line: str) -> None:
    with pytest.raises(ms.MitsimError, match=line):
        ms.compare([folder / "one", *([] if other is None else [folder / other])], tmp_path / "out")
    assert not (tmp_path / "out").exists()

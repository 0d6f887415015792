"""Pairs as a data set: the layout of Hugging Face's imagefolder, and images that dense least squares confirms."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import mitsim as ms
from mitsim.bench.request import Request, Task
from mitsim.core.errors import MitsimError
from mitsim.learn.pair_store import PairStore
from mitsim.learn.pairs import make_pairs
from mitsim.learn.requests import PairsRequest, Variation
from tests.exchanged import made

pytestmark = pytest.mark.usefixtures("kept_plans")
PYTHON = {"int64": int, "float64": float}


@pytest.fixture(scope="module")
def folder(shared_scene: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory, variant: str) -> Path:
    """Six pairs of three pictures, on two benches, with the calibration beside them and the data set."""
    folder = tmp_path_factory.mktemp("dataset")
    (folder / "pictures").mkdir()
    for number, level in enumerate((60, 120, 240)):
        shade = np.linspace(0, level, 16).astype(np.uint8)
        Image.fromarray(np.tile(shade, (16, 1))).save(folder / "pictures" / f"{number}.png")
    bench = ms.open_bench(shared_scene("pairs", n=16, reflectance=np.full((256, 256), 128)), variant)
    vary = Variation.model_validate({"groups": 2, "exposure_fraction": [0.5, 0.8]})
    request = Request.of(patterns="dots:2", accuracy=2e-3, seed=3)
    asked = PairsRequest(capture=request, count=6, vary=vary, pictures=folder / "pictures")
    make_pairs(bench, asked, Task(folder / "pairs"))
    bench.calibrate(folder / "pairs" / "calibration")
    found = ms.export(folder / "pairs", "dataset", folder / "data")
    assert (found["pairs"], found["frames"], found["calibration"]) == (6, 24, str(folder / "pairs" / "calibration"))
    assert "2 in train, 2 in validation, 2 in test" in found["notes"][0]
    return folder


def lines_of(data: Path, split: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (data / split / "metadata.jsonl").read_text().splitlines()]


def test_the_layout_is_that_of_an_imagefolder(folder: Path) -> None:
    """https://huggingface.co/docs/datasets/image_dataset: in each split a line for each row, whose `file_name` keys are
    images beside it, all named once; the card has each column with its type, and no path of this machine.

    (Planted: names relative to the root; a column that the card lacks; files without a line.)
    """
    data = folder / "data"
    head = (data / "README.md").read_text().split("---\n")[1].splitlines()
    card = {name: json.loads(value) for name, _, value in (line.partition(": ") for line in head)}
    columns = {column["name"]: column["dtype"] for column in card["dataset_info"]["features"]}
    assert {path.name for path in data.iterdir()} == {"README.md", "train", "validation", "test"}
    for split in ("train", "validation", "test"):
        named = list[Path]()
        for row in lines_of(data, split):
            names = [key.removesuffix("file_name").removesuffix("_") or "image" for key in row if "file_name" in key]
            assert [*names, *(key for key in row if "file_name" not in key)] == [*columns]
            named += [data / split / value for key, value in row.items() if "file_name" in key]
            numbers = {name: value for name, value in row.items() if "file_name" not in name}
            assert {name: PYTHON[columns[name]] for name in numbers} == {n: type(v) for n, v in numbers.items()}
        assert sorted(named) == sorted((data / split).rglob("*.tif")) and named
    assert card["license"] == "unknown" and {columns.pop("image"), columns.pop("truth")} == {"image"}
    known = card["mitsim"]
    assert (known["seed"], known["patterns"], known["pictures"]) == (3, "dots:2", "3 files")
    assert known["versions"]["mitsim"] == ms.__version__ and known["scene"].count("/") == 1
    assert str(folder) not in (data / "README.md").read_text()


def test_images_are_least_squares_on_the_grid_of_the_truth(folder: Path) -> None:
    """Against a dense solve of the whole model; no picture is in two splits. (Planted: frames in another order; pairs
    of the first group alone; a split by pairs; images clipped or of 8 bits.)"""
    data, store = folder / "data", PairStore.open(folder / "pairs")
    factors, (left, right) = ms.load_calibration(folder / "pairs" / "calibration"), store.patterns
    model = np.vstack([np.kron(factors.left * left[:, i], factors.right * right[:, j]) for i, j in store.indices])
    rows = {split: lines_of(data, split) for split in ("train", "validation", "test")}
    assert sorted(row["pair"] for each in rows.values() for row in each) == [*range(6)]
    assert len({(split, row["photograph"]) for split, each in rows.items() for row in each}) == 3
    for split, each in rows.items():
        for row in each:
            named = row["file_name"], row["truth_file_name"]
            image, truth = (np.asarray(Image.open(data / split / name)) for name in named)
            assert image.dtype == truth.dtype == np.float32 and np.array_equal(truth, store.truth(row["pair"]))
            normal = model.T @ model + row["lambda"] * np.eye(256)
            exact = np.linalg.solve(normal, model.T @ store.frames(row["pair"]).ravel()).reshape(16, 16)
            assert np.linalg.norm(image - exact) < 1e-5 * np.linalg.norm(exact)
            assert row["psnr_db"] == pytest.approx(ms.psnr(exact, truth), abs=1e-3) and row["psnr_db"] > 15
            assert row["exposure_s"] == store.exposure_s(row["pair"]) and row["group"] == row["pair"] // 3
            assert row["exposure_fraction"] == store.manifest.groups[row["group"]]["exposure_fraction"]


def test_what_makes_no_data_set_is_refused_and_leaves_nothing(folder: Path, tmp_path: Path) -> None:
    """(Planted: no look at the camera.)"""
    pairs, own = folder / "pairs", folder / "pairs" / "calibration"
    factors, run = ms.load_calibration(own), made(tmp_path / "made")
    sensor = {**factors.manifest.camera["sensor"], "name": "another"}
    other = factors.manifest.model_copy(update={"camera": {**factors.manifest.camera, "sensor": sensor}})
    replace(factors, manifest=other).save(tmp_path / "other")
    replace(factors, left=factors.left[:-1]).save(tmp_path / "small")
    output, bare = tmp_path / "new", tmp_path / "bare"
    shutil.copytree(pairs, bare, ignore=shutil.ignore_patterns("calibration"))
    for source, calibration, place, words in (
        (run.run, None, output, r"holds no pairs\.json; give a folder of `mitsim pairs`"),
        (pairs, tmp_path / "none", output, "none"),
        (pairs, tmp_path / "other", output, r"is of another camera than .*: sensor\.name differs; calibrate"),
        (pairs, tmp_path / "small", output, r"has frames of \(63, 64\)"),
        (pairs, own, pairs, "output"),
        (bare, None, output, "calibration is not given, and .* holds none; give the folder of its camera"),
        (pairs, own, folder / "data", "exists|holds"),
        (pairs, run.run, output, "calibration"),
    ):
        with pytest.raises(MitsimError, match=words) as caught:
            ms.export(source, "dataset", place, calibration)
        assert "\n" not in str(caught.value)
    assert not output.exists()

"""`mitsim reconstruct` of coloured folders: images of each line, alone and behind colour filters, and their colours."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from PIL import Image

from mitsim.core.errors import MitsimError
from mitsim.core.exr import read_frame
from mitsim.core.runs import load_mosaic, load_run
from mitsim.metrics import psnr
from mitsim.reconstruct.colour import ColourModel, chart, delta_e, linear_srgb
from mitsim.reconstruct.factors import load_calibration
from mitsim.report.lit_scene import LitScene
from mitsim.report.reconstruct_run import ColourImage, reconstruct, reconstruct_colours
from mitsim.studies.colour_study import LitLine, serving
from tests.coloured import LINES, PLACE, WEIGHTS, folders, mosaic_folders, scenes

pytestmark = pytest.mark.usefixtures("draft_figures")


def main(command: list[str]) -> int:
    """Exit status of mitsim, run in this process."""
    from mitsim.cli import run

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["mitsim", *command])
        with pytest.raises(SystemExit) as ended:
            run()
    return int(ended.value.code or 0)


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return folders(tmp_path_factory.mktemp("coloured"))


def test_each_line_is_solved_as_it_is_alone(pair: tuple[Path, Path], tmp_path: Path) -> None:
    run, calibration = pair
    found = reconstruct_colours(run, calibration, tmp_path / "image", lam=1e3)
    for index, name in enumerate(found.qualities):
        alone = reconstruct(run / name, calibration / name, tmp_path / name, lam=1e3).reconstruction
        assert np.array_equal(found.reflectances[..., index], alone.image) and alone.lam == 1e3, "options are passed on"
        assert (tmp_path / "image" / name / "result.json").is_file()
    errors = [10 ** (-quality.psnr_db / 10) for quality in found.qualities.values() if quality]
    assert found.psnr_db == pytest.approx(-10 * np.log10(np.mean(errors)))


def test_colours_of_the_chart_are_those_of_its_spectra_at_the_lines(pair: tuple[Path, Path], tmp_path: Path) -> None:
    found = reconstruct_colours(*pair, tmp_path / "image")
    floor = delta_e(ColourModel.of_lines(LINES).xyz(chart().at(LINES)), chart().xyz)
    seen = delta_e(PLACE.means(found.xyz), chart().xyz)
    # The camera is good to 40 dB a pixel, of which a patch has 8: its colour moves by some 0.3.
    assert found.psnr_db is not None and found.psnr_db > 40
    assert np.abs(seen - floor).max() < 1.0 and abs(seen.mean() - floor.mean()) < 0.2
    channels, _ = read_frame(tmp_path / "image" / "image.exr")
    kept = np.stack([channels[name] for name in "XYZ"], axis=-1)
    assert np.allclose(kept, found.xyz, atol=1e-6)
    shown = np.asarray(Image.open(tmp_path / "image" / "image.png"))
    rgb = np.clip(linear_srgb(found.xyz), 0, 1)
    assert np.allclose(np.where(shown > 10, ((shown / 255 + 0.055) / 1.055) ** 2.4, rgb), rgb, atol=5e-3)


def test_the_matrix_is_fitted_on_the_chart_where_it_is_known(pair: tuple[Path, Path], tmp_path: Path) -> None:
    found = reconstruct_colours(*pair, tmp_path / "image", PLACE)
    expected = ColourModel.fit(LINES, PLACE.means(found.reflectances), "")
    assert np.array_equal(found.model.matrix, expected.matrix)
    assert not np.array_equal(found.model.matrix, ColourModel.of_lines(LINES).matrix)
    kept = json.loads((tmp_path / "image" / "colour.json").read_text())
    assert kept["kind"] == "colour-image" and np.allclose(kept["matrix"], expected.matrix)


def test_folders_that_do_not_belong_together_are_refused(pair: tuple[Path, Path], tmp_path: Path) -> None:
    run, calibration = pair
    other = tmp_path / "other"
    shutil.copytree(calibration, other)
    named = json.loads((other / "colour.json").read_text())
    named["channels"][0]["wavelength_nm"] = 660.0
    (other / "colour.json").write_text(json.dumps(named))
    for wrong, words in (
        (other, r"its lines are 638nm, 520nm, 445nm, but .* calibrate each line"),
        (run, "holds a colour-run, not a colour-calibration"),
        (calibration / "638nm", "holds no colour.json"),
    ):
        with pytest.raises(MitsimError, match=words):
            reconstruct_colours(run, wrong, tmp_path / "image")
        assert not (tmp_path / "image").exists()
    named["channels"][0]["name"] = ".."
    (other / "colour.json").write_text(json.dumps(named))
    with pytest.raises(MitsimError, match=r"'\.\.' is no folder of its own"):
        reconstruct_colours(run, other, tmp_path / "image")


def test_a_chart_of_a_grey_run_is_refused(pair: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    run, calibration = (str(folder / "638nm") for folder in pair)
    assert main(["reconstruct", run, "--calibration", calibration, "--chart", "colour_checker"]) == 2
    assert "which is not coloured; leave it out" in capsys.readouterr().err


def test_a_calibration_of_another_line_is_refused(
    pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """(Planted: light left out of what is compared.) Folders that state none are taken, on either side."""
    run, calibration = pair
    image = ["-o", str(tmp_path / "image")]
    assert main(["reconstruct", str(run / "638nm"), "--calibration", str(calibration / "520nm"), *image]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "projector.lines_nm is [520.0], but" in line and "638nm it is [638.0]; calibrate in this light" in line
    assert not (tmp_path / "image").exists()
    shutil.copytree(run / "638nm", tmp_path / "old")
    path = tmp_path / "old" / "manifest.json"
    kept = json.loads(path.read_text())
    path.write_text(json.dumps({**kept, "camera": {"projector": {"n": kept["camera"]["projector"]["n"]}}}))
    assert main(["reconstruct", str(tmp_path / "old"), "--calibration", str(calibration / "520nm"), *image]) != 2


def test_one_calibration_for_all_lines_is_taken_where_it_is_asked_for(pair: tuple[Path, Path]) -> None:
    """As `study colour` does, with the gain that is nearest. (Planted: its light kept.)"""
    lit = cast(LitScene, None)
    red, green = (LitLine(name, float(name[:3]), lit, load_calibration(pair[1] / name)) for name in ("638nm", "520nm"))
    green = replace(green, factors=replace(green.factors, left=3 * green.factors.left))
    served = serving(red, green)
    served.check_fit(load_run(pair[0] / "638nm"))
    assert np.allclose(served.left @ served.left.T, green.factors.left @ green.factors.left.T / 3, rtol=1e-3)
    with pytest.raises(MitsimError, match=r"lines_nm is \[638.0\], but in .* it is \[520.0\]"):
        served.check_fit(load_run(pair[0] / "520nm"))


def test_the_board_counts_with_its_reflectance(pair: tuple[Path, Path], tmp_path: Path) -> None:
    """Images are relative to it; colours are not."""
    run, calibration = pair
    plain = reconstruct_colours(run, calibration, tmp_path / "plain")
    shutil.copytree(calibration, tmp_path / "cal")
    for name in plain.qualities:
        path = tmp_path / "cal" / name / "manifest.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), "board_reflectance": 0.8}))
    found = reconstruct_colours(run, tmp_path / "cal", tmp_path / "image")
    assert np.allclose(found.xyz, 0.8 * plain.xyz)
    path.write_text(json.dumps({**json.loads(path.read_text()), "board_reflectance": 0.9}))
    with pytest.raises(MitsimError, match="calibrate all with one board"):
        reconstruct_colours(run, tmp_path / "cal", tmp_path / "other")


# -------- Behind colour filters


@pytest.fixture(scope="module")
def filtered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return mosaic_folders(tmp_path_factory.mktemp("mosaic"))


def solved(filtered: tuple[Path, Path], output: Path, **options: object) -> ColourImage:
    return reconstruct_colours(*filtered, output, **options)  # type: ignore[arg-type]


def test_the_folder_holds_what_was_saved(filtered: tuple[Path, Path]) -> None:
    found = load_mosaic(filtered[0])
    assert np.array_equal(found.weights, WEIGHTS) and found.manifest.mosaic == "BGGR"
    truth = found.truth(0.5)
    assert truth is not None, "of a board of 0.99, told relative to one of half that"
    assert np.allclose(truth[..., 1], scenes()["520nm"] * 0.99 / 0.5, rtol=1e-6)


def test_lines_come_apart_and_have_their_colours(filtered: tuple[Path, Path], tmp_path: Path) -> None:
    found = solved(filtered, tmp_path / "image", chart=PLACE)
    for number, (name, truth) in enumerate(scenes().items()):
        assert psnr(found.images[..., number], truth) > 30
        kept = read_frame(tmp_path / "image" / name / "image.exr")[0]["reflectance"]
        assert np.allclose(kept, found.images[..., number], atol=1e-6)
    floor = delta_e(ColourModel.of_lines(LINES).xyz(chart().at(LINES)), chart().xyz)
    reported = json.loads((tmp_path / "image" / "colour.json").read_text())
    assert reported["kind"] == "colour-image" and reported["mosaic"] == "joint" and reported["psnr"] == found.psnr_db
    assert reported["delta_e_floor"] == pytest.approx(floor.mean()) and reported["delta_e_chart"] < floor.mean() + 1
    assert [patch["name"] for patch in reported["patches"]] == list(chart().names)
    assert reported["unexplained"] < 3.5e-3 and found.ok
    seen = found.delta_e
    assert seen is not None and reported["delta_e"] == pytest.approx(seen.mean())
    page = (tmp_path / "image" / "report.html").read_text()
    assert all(text in page for text in ("638 nm", "black 2", "The truth", "joint", "the chart in this image"))
    assert "data:image/png" in found._repr_html_() and "520nm" in found._repr_html_()


def test_lambda_is_found_from_the_data(filtered: tuple[Path, Path], tmp_path: Path) -> None:
    """Within half a decibel of the best of a ladder. An image of other inputs is kept."""
    found = solved(filtered, tmp_path / "image")
    before = (tmp_path / "image" / "colour.json").read_bytes()
    with pytest.raises(MitsimError, match=r"other inputs \(lambda differ\)"):
        solved(filtered, tmp_path / "image", lam=1.0)
    assert json.loads(before)["inputs"] == json.loads((tmp_path / "image" / "colour.json").read_text())["inputs"]
    lam = found.solution["lambda"]
    steps = (0.1, 0.3, 3.0, 10.0)
    ladder = [solved(filtered, tmp_path / "image", lam=lam * step, overwrite=True).psnr_db for step in steps]
    assert found.psnr_db > max(ladder) - 0.5, ladder


@pytest.mark.parametrize("kind", ["pair", "filtered"])
def test_the_command_line_tells_every_line(
    request: pytest.FixtureRequest, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, calibration = map(str, request.getfixturevalue(kind))
    command = ["reconstruct", run, "--calibration", calibration, "-o", str(tmp_path / "image"), "--json"]
    assert main(command) == 0
    reported = json.loads(capsys.readouterr().out)
    assert [line["name"] for line in reported["channels"]] == ["638nm", "520nm", "445nm"]
    if kind == "filtered":
        assert reported["mosaic"] == "joint" and reported["steps"] > 0 and reported["lambda"] > 0
        return
    assert all(line["psnr"] > 30 and line["status"] for line in reported["channels"]) and len(reported["matrix"]) == 3
    assert main([*command, "--lambda", "3"]) == 2, "an image of other inputs is kept"
    assert "638nm" in (tmp_path / "image" / "colour.json").read_text()
    assert main([*command, "--lambda", "3", "--overwrite"]) == 0


def test_a_real_camera_has_no_truth(tmp_path: Path) -> None:
    found = solved(mosaic_folders(tmp_path, truths=False), tmp_path / "image")
    assert found.psnr_db is None and found.delta_e is None and found.summary()["delta_e_chart"] is None
    page = (tmp_path / "image" / "report.html").read_text()
    assert "pixels in each of 3 lines</p>" in page, "the headline states no PSNR"
    assert "The truth." not in page and "Delta E" not in page


def test_a_camera_that_does_not_explain_the_frames_is_flagged(filtered: tuple[Path, Path], tmp_path: Path) -> None:
    """Lines that lend each other their factors are half a pixel off."""
    run, calibration = filtered
    shutil.copytree(calibration, tmp_path / "cal")
    for name, other in (("638nm", "445nm"), ("445nm", "638nm")):
        shutil.rmtree(tmp_path / "cal" / name)
        shutil.copytree(calibration / other, tmp_path / "cal" / name)
    found = solved((run, tmp_path / "cal"), tmp_path / "image")
    assert not found.ok and "explained by no image of these lines" in found.warnings[0]


def test_a_manifest_has_a_weight_for_each_line(filtered: tuple[Path, Path], tmp_path: Path) -> None:
    shutil.copytree(filtered[0], tmp_path / "run")
    path = tmp_path / "run" / "colour.json"
    data = json.loads(path.read_text())
    path.write_text(json.dumps({**data, "weights": [row[:2] for row in data["weights"]]}))
    with pytest.raises(MitsimError, match="weights have 2, 2, 2, 2 numbers; give each of the four pixels one for each"):
        load_mosaic(tmp_path / "run")

"""EMVA 1288's procedure on simulated frames: what was set comes out, and standard errors are the actual ones."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from mitsim.bench.request import Procedure
from mitsim.core.configuration import locate
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.devices.sensor import SensorModel, load_sensor
from mitsim.sensor.emva import figures
from mitsim.studies.characterise import Frames, characterise, session_of
from tests.invented import sensor

SMALL = Procedure(pixels=64, steps=25, frames=16)
PLAIN = {
    "full_well_e": 20_000.0, "read_noise_e": 4.0, "gain_dn_per_e": 0.19, "black_level_dn": 60.0, "bits": 12,
    "quantum_efficiency": 0.6, "dark_current_e_per_s": 5.0,
}  # fmt: skip
CAMERAS: dict[str, dict[str, object]] = {
    "plain": {},
    "nonuniform": {
        "dsnu_pixel_e": 2.0, "dsnu_row_e": 0.8, "dsnu_column_e": 1.0, "prnu_pixel": 0.008, "prnu_row": 0.002,
        "prnu_column": 0.004, "dark_current_spread_e_per_s": 2.0,
    },
    "rows and defects": {
        "row_noise_e": 2.0, "dsnu_row_e": 1.0, "dead_pixels": 0.002, "hot_pixels": 0.002,
        "hot_dark_current_e_per_s": 200.0, "crosstalk": 0.1,
    },
    "bent": {"linearity": (-0.02, 0.01), "binning": 2, "binning_on_chip": True, "binned_full_well_e": 20_000.0},
}  # fmt: skip


def camera(name: str) -> SensorModel:
    return sensor(**{**PLAIN, **CAMERAS[name]})


@pytest.mark.parametrize("name", CAMERAS)
def test_what_is_set_is_found_within_five_standard_errors(name: str) -> None:
    """(Planted: gain 10 % off in the chain; nonuniformity set to twice its deviation.)"""
    done = characterise(camera(name), SMALL)
    assert not done.warnings
    for row in done.fields:
        assert abs(row.deviations or 0) < 5 and row.standard_error >= 0, row
    rows = {row.name: row for row in done.rows}
    assert rows["system_gain"].set == 0.19
    if name != "bent":  # the standard reads gain and noise off straight lines
        for figure in ("system_gain", "quantum_efficiency", "dark_noise", "full_well"):
            assert rows[figure].found == pytest.approx(rows[figure].set, rel=0.02), figure
    if name == "nonuniform":  # units and roots: 2 e-, 0.8 %
        assert rows["prnu_pixel"].set == pytest.approx(0.8) and rows["prnu_pixel"].found == pytest.approx(0.8, rel=0.1)
        assert rows["dsnu_pixel"].found == pytest.approx(rows["dsnu_pixel"].set, rel=0.15)


@pytest.mark.parametrize("name", ["imx249", "imx250", "imx255", "imx477", "mt9m031", "mt9m034", "ov5647"])
def test_shipped_cameras_have_sources_and_are_found_as_their_files_say(name: str) -> None:
    model = load_sensor(locate(name, "calibration", ".toml"))
    assert "http" in model.source
    assert not characterise(model, SMALL).warnings


COARSE: dict[str, dict[str, object]] = {
    "8 bits, a fifth of dark readings 0": {
        "bits": 8, "read_noise_e": 25.0, "gain_dn_per_e": 0.0235, "black_level_dn": 1.0
    },
    "16 bits, no black level": {"bits": 16, "read_noise_e": 60.0, "gain_dn_per_e": 5.0, "black_level_dn": 0.0},
    "8 bits, black between two codes": {
        "bits": 8, "read_noise_e": 4.0, "gain_dn_per_e": 0.024, "black_level_dn": 2.5
    },
    "16 bits, counts of one dark electron": {
        "bits": 16, "read_noise_e": 0.1, "gain_dn_per_e": 5.0, "black_level_dn": 100.0
    },
}  # fmt: skip


@pytest.mark.parametrize("name", COARSE)
def test_few_bits_and_clipped_darks_do_not_mislead_the_camera_found(name: str) -> None:
    """(Planted: moments without rounding.)"""
    model = sensor(**{**PLAIN, "full_well_e": 10_000.0, **COARSE[name]})
    done = characterise(model, Procedure(pixels=128, steps=20, frames=4))
    assert not done.warnings and "gain_dn_per_e" in {row.name for row in done.fields}


def test_a_camera_that_is_not_as_its_file_says_is_flagged(monkeypatch: pytest.MonkeyPatch) -> None:
    from mitsim.studies import characterise as module

    frames = module.expose
    monkeypatch.setattr(module, "expose", lambda light, *rest: np.rint(60 + 1.2 * (frames(light, *rest) - 60.0)))
    done = characterise(camera("plain"), SMALL)
    assert any(line.startswith("gain_dn_per_e of the camera found: 0.2") for line in done.warnings)


PLOTS = "pdf", "png", "svg"


def test_page_plots_and_json_lie_in_the_folder(tmp_path: Path) -> None:
    done = characterise(camera("plain"), Procedure(pixels=32, steps=20, frames=2), tmp_path / "found")
    assert sorted(path.name for path in (tmp_path / "found").glob("[!.]*")) == [
        "camera.toml", "characterise.html", "characterise.json",
        *(f"{name}.{kind}" for name in ("dark_current", "linearity", "photon_transfer") for kind in PLOTS),
    ]  # fmt: skip
    page = (tmp_path / "found" / "characterise.html").read_text(encoding="utf-8")
    assert page.count('<img src="data:image/') == 3 and done.headline in page and done.warnings == ()
    gain = next(row for row in done.fields if row.name == "gain_dn_per_e")
    assert done.headline.startswith(f"Characterised invented: gain {gain.found:.4g} DN/e-, read noise ")
    assert all(f"<td>{row.name}</td>" in page for row in (*done.rows, *done.fields))
    written = json.loads((tmp_path / "found" / "characterise.json").read_text())
    assert written["kind"] == "characterise" and written["pixels"] == 32
    assert [figure["name"] for figure in written["figures"]] == [row.name for row in done.rows]
    assert done.lines()[2] == f"Page, plots, JSON and the camera found, camera.toml: {tmp_path / 'found'}"
    assert load_sensor(tmp_path / "found" / "camera.toml") == done.found.sensor


def test_without_a_quantum_efficiency_light_is_counted_in_electrons() -> None:
    done = characterise(sensor(**{**PLAIN, "quantum_efficiency": None}), Procedure(pixels=32, steps=20, frames=2))
    assert "quantum_efficiency" not in {row.name for row in done.rows} and done.rows[0].name == "system_gain"


def test_of_a_curve_the_efficiency_is_found_at_the_light_s_wavelength() -> None:
    """That of a mosaic has no one value: its light is counted in electrons."""
    curve = {"wavelengths_nm": [400.0, 600.0], "efficiency": [0.2, 0.6]}
    of_a_curve = sensor(**{**PLAIN, "quantum_efficiency": None, "quantum_efficiency_curve": curve})
    small = Procedure(pixels=32, steps=20, frames=2, wavelength=500.0)
    by_number = characterise(sensor(**{**PLAIN, "quantum_efficiency": 0.4}), small)
    assert characterise(of_a_curve, small).rows == by_number.rows and by_number.rows[1].set == 0.4
    with pytest.raises(MitsimError, match="700 nm"):
        characterise(of_a_curve, Procedure(pixels=32, steps=20, frames=2, wavelength=700.0))
    filters = {"quantum_efficiency": None, "mosaic": "RGGB", "mosaic_curves": {plane: curve for plane in "RGB"}}
    rows = characterise(sensor(**{**PLAIN, **filters}), small).rows
    assert rows == characterise(sensor(**{**PLAIN, "quantum_efficiency": None}), small).rows


def test_noise_that_rounding_hides_is_the_standard_s_limit_and_of_real_numbers_what_was_set() -> None:
    """0.1 DN of noise: rounded, (0.24 - 1/12)^(1/2) DN; not rounded, itself. (Planted: real numbers as if rounded.)"""
    quiet = {**PLAIN, "read_noise_e": 0.5, "dark_current_e_per_s": 0.0, "gain_dn_per_e": 0.2}
    for bits, expected in ((12, 0.39581 / 0.2), (None, 0.5)):
        frames = Frames(sensor(**{**quiet, "bits": bits}), SMALL)
        session = session_of(frames.take(Job()), frames.dark, frames.bright, True, bits is not None)
        assert float(figures(session)["dark_noise"]) == pytest.approx(expected, rel=0.02)
        assert frames.figures_set()["dark_noise"] == 0.5


def test_what_cannot_be_characterised_is_refused() -> None:
    with pytest.raises(MitsimError, match="no light saturates it"):
        characterise(sensor(full_well_e=math.inf))
    for values, name in (({"pixels": 8}, "pixels"), ({"steps": 5}, "steps"), ({"frames": 1}, "frames")):
        with pytest.raises(MitsimError, match=name):
            Procedure(**values)

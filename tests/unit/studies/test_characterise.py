"""EMVA 1288's procedure on simulated frames: what was set comes out, and predicted errors are the actual ones."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.configuration import locate
from mitsim.core.errors import MitsimError
from mitsim.devices.sensor import SensorModel, load_sensor
from mitsim.studies.characterise import characterise
from mitsim.studies.emva_options import Procedure
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
def test_what_is_set_is_found_within_five_predicted_standard_errors(name: str) -> None:
    """(Planted: gain 10 % off in the chain; nonuniformity set to twice its deviation.)"""
    done = characterise(camera(name), SMALL)
    assert not done.warnings
    rows = {row.name: row for row in done.rows}
    for row in done.rows:
        assert abs(row.deviations) < 5 and row.standard_error > 0, row
    assert rows["system_gain"].set == 0.19 and (rows["system_gain"].expected is None) == (name != "bent")


@pytest.mark.parametrize("name", ["imx249", "imx250", "imx255", "imx477", "mt9m031", "mt9m034", "ov5647"])
def test_shipped_cameras_have_sources_and_are_found_as_their_files_say(name: str) -> None:
    model = load_sensor(locate(name, "calibration", ".toml"))
    assert "http" in model.source
    assert not characterise(model, SMALL).warnings


@pytest.mark.slow
def test_predicted_standard_errors_are_the_spread_over_seeds_and_specimens() -> None:
    """Twelve sessions of a nonuniform camera: each figure's deviations, as a chi-square of 12 (significance 1e-4 each).

    Roots and extremes have longer tails than that: of 90 sums over five times twelve seeds two are above 39.

    (Planted: half the ladder's noise in the prediction.)
    """
    off = np.array(
        [
            [
                row.deviations
                for row in characterise(
                    camera("nonuniform").model_copy(update={"pattern_seed": seed}),
                    Procedure(pixels=48, steps=20, frames=8, seed=seed),
                ).rows
            ]
            for seed in range(24, 36)
        ]
    )
    squares = np.square(off).sum(axis=0)
    names = [row.name for row in characterise(camera("plain"), Procedure(pixels=48, steps=20, frames=8)).rows]
    for name, value in zip(names, squares, strict=True):
        # The largest variance falls on the same step in all: its figure is known to a step, not to its noise.
        least = 0.0 if name == "saturation_capacity" else 1.6
        assert least < value < 39, (name, value)
    assert np.square(off).mean() == pytest.approx(1, abs=0.45)


COARSE: dict[str, tuple[dict[str, object], str]] = {
    "8 bits, a fifth of dark readings 0": (
        {"bits": 8, "read_noise_e": 25.0, "gain_dn_per_e": 0.0235, "black_level_dn": 1.0}, "raise black_level_dn"
    ),
    "10 bits, no black level": (
        {"bits": 10, "read_noise_e": 10.0, "gain_dn_per_e": 0.1, "black_level_dn": 0.0}, "raise black_level_dn"
    ),
    "16 bits, no black level": (
        {"bits": 16, "read_noise_e": 60.0, "gain_dn_per_e": 5.0, "black_level_dn": 0.0}, "raise black_level_dn"
    ),
    "6 bits, next to no noise": (
        {"bits": 6, "read_noise_e": 4.0, "gain_dn_per_e": 0.006, "black_level_dn": 2.0}, "rounding to whole DN"
    ),
    "8 bits, black between two codes": (
        {"bits": 8, "read_noise_e": 4.0, "gain_dn_per_e": 0.024, "black_level_dn": 2.5}, "rounding to whole DN"
    ),
    "8 bits, noise of 0.6 DN": ({"bits": 8, "read_noise_e": 25.0, "gain_dn_per_e": 0.0235, "black_level_dn": 3.0}, ""),
    "16 bits, counts of one dark electron": (
        {"bits": 16, "read_noise_e": 0.1, "gain_dn_per_e": 5.0, "black_level_dn": 100.0}, ""
    ),
    "12 bits, noise of 60 electrons": ({"read_noise_e": 60.0, "gain_dn_per_e": 0.3, "black_level_dn": 100.0}, ""),
}  # fmt: skip


SLOW_COARSE = "6 bits, next to no noise", "8 bits, noise of 0.6 DN"


def coarse(name: str) -> SensorModel:
    return sensor(**{**PLAIN, "full_well_e": 10_000.0, **COARSE[name][0]})


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW_COARSE else []) for name in COARSE]
)
def test_few_bits_and_clipped_darks_are_expected_and_flagged(name: str) -> None:
    """Where the ADC's ends and steps mislead the procedure, that is said with its cause; and nowhere else.

    (Planted: `bias` left at 0.)
    """
    done = characterise(coarse(name), Procedure(pixels=128, steps=20, frames=4))
    cause = COARSE[name][1]
    assert (cause in done.warnings[0]) if cause else not done.warnings
    for row in done.rows:
        assert abs(row.deviations) < 4.5, row


@pytest.mark.slow
@pytest.mark.parametrize("name", list(COARSE)[::2])
def test_few_bits_and_clipped_darks_leave_the_predicted_spread(name: str) -> None:
    """Twenty seeds: the deviations of gain, dark noise and full well are standard normal: |mean| below 0.9 (4 of its
    standard errors), mean square below 2.5 (a chance of 2e-4), the largest below 4."""
    names = ("system_gain", "dark_noise", "full_well")
    off = np.array(
        [
            [
                row.deviations
                for row in characterise(coarse(name), Procedure(pixels=64, steps=20, frames=4, seed=seed)).rows
                if row.name in names
            ]
            for seed in range(20)
        ]
    )
    assert np.all(np.abs(off.mean(axis=0)) < 0.9) and np.all(np.square(off).mean(axis=0) < 2.5), off
    assert np.abs(off).max() < 4


def test_a_camera_that_is_not_as_its_file_says_is_flagged(monkeypatch: pytest.MonkeyPatch) -> None:
    from mitsim.studies import camera_frames as module

    frames = module.expose
    monkeypatch.setattr(module, "expose", lambda light, *rest: np.rint(60 + 1.2 * (frames(light, *rest) - 60.0)))
    done = characterise(camera("plain"), SMALL)
    assert any(line.startswith("system_gain: found 0.2") for line in done.warnings)


def test_page_plots_and_json_lie_in_the_folder(tmp_path: Path) -> None:
    done = characterise(camera("plain"), Procedure(pixels=32, steps=20, frames=2), tmp_path / "found")
    assert sorted(path.name for path in (tmp_path / "found").glob("[!.]*")) == [
        "camera.toml", "characterise.html", "characterise.json", "dark_current.png", "deviations.png", "linearity.png",
        "photon_transfer.png",
    ]  # fmt: skip
    page = (tmp_path / "found" / "characterise.html").read_text(encoding="utf-8")
    assert page.count('<img src="data:image/') == 4 and done.message in page and done.warnings == ()
    gain = next(row for row in done.fields if row.name == "gain_dn_per_e")
    assert done.message.startswith(f"Gain {gain.found:.4g} DN/e-, read noise ")
    assert all(f"<td>{row.name}</td>" in page for row in (*done.rows, *done.fields))
    written = json.loads((tmp_path / "found" / "characterise.json").read_text())
    assert written["kind"] == "characterise" and written["pixels"] == 32
    assert [figure["name"] for figure in written["figures"]] == [row.name for row in done.rows]
    assert done.lines()[1] == f"Page, plots, JSON and the camera found, camera.toml: {tmp_path / 'found'}"
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
    """0.1 DN of noise: rounded, (0.24 - 1/12)^(1/2) DN; not rounded, itself, known as a stack's variance and the gain
    are. (Planted: either of the sessions, drawn and expected, of real numbers as if rounded.)"""
    quiet = {**PLAIN, "read_noise_e": 0.5, "dark_current_e_per_s": 0.0, "gain_dn_per_e": 0.2}
    for bits, expected, limit in ((12, 0.39581 / 0.2, True), (None, 0.5, False)):
        done = characterise(sensor(**{**quiet, "bits": bits}), SMALL)
        (row,) = (row for row in done.rows if row.name == "dark_noise")
        assert not done.warnings and row.set == 0.5 and (row.expected is not None) == limit
        assert row.found == pytest.approx(expected, abs=5 * row.standard_error)
    gain = next(row for row in done.rows if row.name == "system_gain")
    alone = math.hypot(1 / math.sqrt(2 * SMALL.pixels**2 * (SMALL.frames - 1)), gain.standard_error / gain.set)
    assert row.standard_error == pytest.approx(0.5 * alone, rel=0.05)


def test_what_cannot_be_characterised_is_refused() -> None:
    with pytest.raises(MitsimError, match="no light saturates it"):
        characterise(sensor(full_well_e=math.inf))
    for values, name in (({"pixels": 8}, "pixels"), ({"steps": 5}, "steps"), ({"frames": 1}, "frames")):
        with pytest.raises(MitsimError, match=name):
            Procedure(**values)

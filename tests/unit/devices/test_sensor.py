import math
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from mitsim.core.configuration import shipped_path
from mitsim.core.errors import MitsimError
from mitsim.devices.sensor import load_sensor
from tests.invented import sensor

CURVE = {"wavelengths_nm": [450.0, 550, 650.0], "efficiency": [0.5, 0.7, 0.4]}
PLANES = {
    name: {"wavelengths_nm": [400.0, 700.0], "efficiency": values}
    for name, values in (("R", [0.0, 0.6]), ("G", [0.2, 0.1]), ("B", [0.5, 0.0]))
}
BEYOND = [("full_well_e", -1.0), ("full_well_e", 1e13), ("binning", 2.0), ("colour", "red"), ("crosstalk", 0.6)]
BEYOND += [("quantum_efficiency", 1.01), ("quantum_efficiency", 1e-9)]
COLOUR = {"quantum_efficiency": None, "mosaic": "RGGB", "mosaic_curves": PLANES}


def test_a_superpixel_is_the_sum_of_its_pixels() -> None:
    pixel = {"pixel_pitch_um": 5.0, "read_noise_e": 3.0, "dark_current_e_per_s": 2.0, "black_level_dn": 10.0}
    model = sensor(**pixel, binning=3, bits=12)
    assert model.superpixel_pitch_um == 15.0
    assert model.superpixel_area_m2 * 1e12 == pytest.approx(225.0, rel=1e-12)
    assert model.superpixel_full_well_e == 9000.0
    assert model.superpixel_read_noise_e == 9.0  # sqrt(9) x 3: nine independent readings
    assert model.superpixel_dark_current_e_per_s == 18.0
    assert model.superpixel_black_level_dn == 90.0
    assert model.largest_dn == 9 * 4095


@pytest.mark.parametrize(
    ("change", "message"),
    [
        *(({name: value}, name) for name, value in BEYOND),
        ({"temperature_c": 40.0}, "dark_doubling_c"),
        *(({"hot_pixels": 0.1}, "go together"), ({"mosaic": "RGGB"}, "go together")),
        ({"linearity": (0.1,), "full_well_e": math.inf}, "finite full_well_e"),
        *(({"linearity": (math.nan,)}, "linearity"), ({**COLOUR, "binning": 2}, "mosaic RGGB: binning 2")),
        ({"quantum_efficiency_curve": CURVE}, "quantum_efficiency and quantum_efficiency_curve; give one"),
        ({"quantum_efficiency_curve": {**CURVE, "wavelengths_nm": [450.0, 550.0]}}, "2 wavelengths_nm and 3"),
        ({"quantum_efficiency_curve": {**CURVE, "efficiency": [0.5, 1.01, 0.5]}}, "efficiency.1"),
        ({"quantum_efficiency_curve": {"wavelengths_nm": [500.0], "efficiency": [0.5]}}, "at least 2"),
    ],
)
def test_numbers_of_no_camera_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        sensor(**change)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("read_noise_e = -6.7", r"read_noise_e: got -6\.7; give a number from 0 to "),
        ("read_noise = 6.7", r"read_noise: got 6\.7, no such field; did you mean read_noise_e\?$"),
    ],
)
def test_a_bad_file_is_one_line(tmp_path: Path, line: str, message: str) -> None:
    text = shipped_path("calibration", "imx249.toml").read_text(encoding="utf-8")
    (tmp_path / "a.toml").write_text(text.replace("read_noise_e = 6.7", line))
    with pytest.raises(MitsimError, match=rf"^file [^\n]*a\.toml: {message}[^\n]*"):
        load_sensor(tmp_path / "a.toml")


def test_the_shipped_sensor_fills_its_adc_but_does_not_overflow_it() -> None:
    model = load_sensor(shipped_path("calibration", "imx249.toml"))
    assert model.superpixel_pitch_um == pytest.approx(11.72)  # the paper's binned pitch
    assert model.largest_dn is not None
    top = model.superpixel_full_well_e * model.gain_dn_per_e + model.superpixel_black_level_dn
    assert 0.95 < top / model.largest_dn < 1
    # Below about half a code of noise the rounding is not dithered and 1/12 DN^2 does not hold.
    assert model.superpixel_read_noise_e * model.gain_dn_per_e > 0.5
    # The two figures its full well and read noise are derived from (mvBlueFOX3 manual).
    assert 10 * math.log10(model.full_well_e) == pytest.approx(45.1, abs=0.05)
    assert 20 * math.log10(model.full_well_e / (model.read_noise_e + 0.5)) == pytest.approx(73, abs=0.5)


def test_a_camera_s_identity_has_the_effects_that_it_names_and_no_others() -> None:
    """Calibrations of 0.4, which know no effects, fit the cameras that they were made of."""
    plain = sensor().identity
    assert set(plain) == {
        "name", "pixel_pitch_um", "binning", "full_well_e", "read_noise_e", "dark_current_e_per_s",
        "quantum_efficiency", "gain_dn_per_e", "black_level_dn", "bits",
    }  # fmt: skip
    assert sensor(prnu_row=0.01).identity == {**plain, "prnu_row": 0.01}


# ---- electrons per photon: one number, a curve, or curves under colour filters


def test_a_curve_is_linear_between_its_points() -> None:
    model = sensor(quantum_efficiency=None, quantum_efficiency_curve=CURVE)
    found = [model.efficiency(wavelength) for wavelength in (450.0, 500.0, 550.0, 575.0, 650.0)]
    np.testing.assert_allclose(found, [0.5, 0.6, 0.7, 0.625, 0.4], rtol=1e-14)


@pytest.mark.parametrize("wavelength", [449.9, 650.1, float("nan")])
def test_outside_its_curve_a_camera_tells_nothing(wavelength: float) -> None:
    model = sensor(quantum_efficiency=None, quantum_efficiency_curve=CURVE)
    with pytest.raises(MitsimError, match=r"^sensor 'invented': got \S+ nm; .* 450 to 650 nm; use light of these"):
        model.efficiency(wavelength)


def test_each_plane_of_a_mosaic_has_its_curve() -> None:
    model = sensor(**COLOUR)
    assert [model.efficiency(550.0, plane) for plane in ("R", "G", "B")] == pytest.approx([0.3, 0.15, 0.25], rel=1e-14)
    with pytest.raises(MitsimError, match="mosaic RGGB, and monochrome frames"):
        model.efficiency(550.0)
    with pytest.raises(MitsimError, match="no mosaic, and plane G"):
        sensor().efficiency(550.0, "G")


def test_a_file_states_curves_as_tables(tmp_path: Path) -> None:
    numbers = {"pixel_pitch_um": 2.0, "full_well_e": 1000.0, "read_noise_e": 1.0, "gain_dn_per_e": 1.0}
    plain = "".join(f"{name} = {value}\n" for name, value in numbers.items())
    plain += 'name = "colour"\nsource = "invented"\nmosaic = "GRBG"\n[mosaic_curves]\n'
    line = "{wavelengths_nm = [400, 700], efficiency = [0.1, 0.3]}"
    (tmp_path / "a.toml").write_text(plain + "".join(f"{plane} = {line}\n" for plane in "RGB"))
    assert load_sensor(tmp_path / "a.toml").efficiency(550.0, "B") == pytest.approx(0.2)
    (tmp_path / "b.toml").write_text(plain + "".join(f"{plane} = {line}\n" for plane in "RG"))
    with pytest.raises(MitsimError, match=r"b\.toml: mosaic_curves\.B: is missing"):
        load_sensor(tmp_path / "b.toml")

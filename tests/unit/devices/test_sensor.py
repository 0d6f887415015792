import math
from pathlib import Path

import pytest
from pydantic import ValidationError

from mitsim.core.configuration import shipped_path
from mitsim.core.errors import MitsimError
from mitsim.devices.sensor import load_sensor
from tests.invented import sensor


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
    ("field", "value"),
    [
        *(("full_well_e", -1.0), ("full_well_e", 1e13), ("quantum_efficiency", 1.01), ("quantum_efficiency", 1e-9)),
        *(("binning", 2.0), ("colour", "red")),
    ],
)
def test_a_value_out_of_range_is_refused(field: str, value: object) -> None:
    with pytest.raises(ValidationError, match=field):
        sensor(**{field: value})


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

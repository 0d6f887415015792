"""Electrons per photon: one number, a curve, or curves under colour filters."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.devices.sensor import load_sensor
from tests.invented import sensor

CURVE = {"wavelengths_nm": [450.0, 550, 650.0], "efficiency": [0.5, 0.7, 0.4]}
PLANES = {
    name: {"wavelengths_nm": [400.0, 700.0], "efficiency": values}
    for name, values in (("R", [0.0, 0.6]), ("G", [0.2, 0.1]), ("B", [0.5, 0.0]))
}
COLOUR = {"quantum_efficiency": None, "mosaic": "RGGB", "mosaic_curves": PLANES}


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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"quantum_efficiency_curve": CURVE}, "quantum_efficiency and quantum_efficiency_curve; give one"),
        ({"mosaic": "RGGB"}, "go together"),
        ({**COLOUR, "binning": 2}, "mosaic RGGB: binning 2"),
        ({"quantum_efficiency_curve": {**CURVE, "wavelengths_nm": [450.0, 550.0]}}, "2 wavelengths_nm and 3"),
        ({"quantum_efficiency_curve": {**CURVE, "efficiency": [0.5, 1.01, 0.5]}}, "efficiency.1"),
        ({"quantum_efficiency_curve": {"wavelengths_nm": [500.0], "efficiency": [0.5]}}, "at least 2"),
    ],
)
def test_what_is_no_efficiency_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sensor(**change)


def test_a_file_states_curves_as_tables(tmp_path: Path) -> None:
    plain = """name = "colour"
pixel_pitch_um = 2.0
full_well_e = 1000.0
read_noise_e = 1.0
gain_dn_per_e = 1.0
source = "invented"
mosaic = "GRBG"
[mosaic_curves]
"""
    line = "{wavelengths_nm = [400, 700], efficiency = [0.1, 0.3]}"
    (tmp_path / "a.toml").write_text(plain + "".join(f"{plane} = {line}\n" for plane in "RGB"))
    assert load_sensor(tmp_path / "a.toml").efficiency(550.0, "B") == pytest.approx(0.2)
    (tmp_path / "b.toml").write_text(plain + "".join(f"{plane} = {line}\n" for plane in "RG"))
    with pytest.raises(MitsimError, match=r"b\.toml: mosaic_curves\.B: is missing"):
        load_sensor(tmp_path / "b.toml")

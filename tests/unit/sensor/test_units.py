import pytest

from mitsim.sensor import chain


def test_photon_energy_of_green_light() -> None:
    # E[eV] = 1239.841984 / lambda[nm] (CODATA 2018), and 1 eV = 1.602176634e-19 J.
    # In eV: approx's absolute tolerance of 1e-12 would swallow an energy in joules.
    assert chain.photon_energy(550.0) / 1.602176634e-19 == pytest.approx(1239.841984 / 550, rel=1e-9)


@pytest.mark.parametrize("wavelength", [0.0, -1.0, float("nan")])
def test_a_wavelength_must_be_positive(wavelength: float) -> None:
    with pytest.raises(ValueError, match="wavelength_nm"):
        chain.photon_energy(wavelength)

"""Physical constants and unit conversions: wavelength in, photon energy out.

Lengths in mitsim are millimetres unless a name ends in `_um` or `_nm`.
"""

PLANCK = 6.62607015e-34
"""Planck constant, J s (exact, SI 2019)."""
LIGHT_SPEED = 299_792_458.0
"""Speed of light in vacuum, m/s (exact, SI 2019)."""
LUMINOUS_EFFICACY = 683.0
"""Luminous efficacy of light at 540 THz (555 nm), lm/W (exact, SI 2019)."""


def photon_energy(wavelength_nm: float) -> float:
    """Energy of one photon [J], E = h c / lambda, at a vacuum wavelength ``wavelength_nm`` [nm]; ValueError unless that
    is above 0."""
    if not wavelength_nm > 0:
        raise ValueError(f"photon_energy: wavelength_nm is {wavelength_nm}; it must be above 0")
    return PLANCK * LIGHT_SPEED / (wavelength_nm * 1e-9)

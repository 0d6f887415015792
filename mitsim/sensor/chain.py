"""Irradiance on the sensor in, digital numbers out, stage by stage after EMVA 1288 release 4.0.

The order is physics and not to be permuted: irradiance x area x time -> photons -> quantum efficiency ->
photoelectrons + dark current -> Poisson -> full-well clip -> read noise -> gain -> black level -> quantise.
Means and variances in closed form are in `mitsim.sensor.moments`. All values are per superpixel (see
`SensorModel`); arrays keep their shape and are float64 until the last stage.
"""

import math

import numpy as np
import numpy.typing as npt

from mitsim.core.errors import MitsimError
from mitsim.core.units import photon_energy
from mitsim.rig.sensor import SensorModel

Array = npt.NDArray[np.float64]
Digital = npt.NDArray[np.float64] | npt.NDArray[np.uint32]
_MANY = 1e11
"""Electrons above which numpy's Poisson draw loses digits: its variance is 1 % off at 1e14, 100 times at 1e17."""


def electrons_from_irradiance(
    irradiance: npt.ArrayLike, exposure_s: float, model: SensorModel, wavelength_nm: float
) -> Array:
    """Expected photoelectrons (without dark current) from irradiance in W/m^2, any shape.

    mu_e = eta E A t / (h c / lambda), EMVA 1288 4.0, "sensitivity". Raises ValueError for negative or NaN
    irradiance.
    """
    light = checked_light(irradiance, "irradiance")
    if not 0 <= exposure_s < math.inf:
        raise ValueError(f"electrons_from_irradiance: exposure_s is {exposure_s}; it must be finite and 0 or more")
    return light * (exposure_s * _electrons_per_joule_m2(model, wavelength_nm))


def exposure_for_peak(peak_irradiance: float, fraction: float, model: SensorModel, wavelength_nm: float) -> float:
    """Exposure time in seconds after which `peak_irradiance` (W/m^2), with dark current, fills `fraction`
    of the full well in the mean. Raises MitsimError if there is no light, no full well, or the fraction is
    not in (0, 1].
    """
    if not 0 < fraction <= 1:
        raise MitsimError(f"exposure: got fraction {fraction} of full well; allowed is above 0, up to 1")
    if not 0 < peak_irradiance < np.inf:
        raise MitsimError(
            f"exposure: the peak irradiance is {peak_irradiance} W/m^2; it must be above 0 and finite; "
            "check that light reaches the sensor"
        )
    if not np.isfinite(model.full_well_e):
        raise MitsimError(f"exposure: sensor {model.name!r} has no full well to fill; choose exposure_s instead")
    rate = peak_irradiance * _electrons_per_joule_m2(model, wavelength_nm)
    return float(fraction * model.superpixel_full_well_e / (rate + model.superpixel_dark_current_e_per_s))


def expose(
    expected_electrons: npt.ArrayLike,
    exposure_s: float,
    model: SensorModel,
    shot_rng: np.random.Generator,
    read_rng: np.random.Generator,
) -> Digital:
    """One noisy frame from expected photoelectrons (any shape): uint32 DN, or float64 where the model has
    no bits.

    Dark electrons of `exposure_s` are added here. `shot_rng` and `read_rng` must be streams of their own,
    so that switching one noise off leaves the other's draw as it was. Raises ValueError for negative or NaN
    electrons.
    """
    expected = add_dark_current(expected_electrons, exposure_s, model)
    electrons = clip_at_full_well(draw_electrons(expected, shot_rng), model)
    return quantise(amplify(add_read_noise(electrons, model, read_rng), model), model)


def dn_to_electrons(dn: npt.ArrayLike, model: SensorModel) -> Array:
    """What a user of frames does: (DN - black level) / gain, electrons, float64. Dark electrons stay in;
    noise may make values negative, and they stay so.
    """
    return (np.asarray(dn, dtype=np.float64) - model.superpixel_black_level_dn) / model.gain_dn_per_e


# ---- the stages, in order
# -------------------------------------------------------------------------------------


def add_dark_current(expected_electrons: npt.ArrayLike, exposure_s: float, model: SensorModel) -> Array:
    """Expected photo- plus dark electrons, mu_e + mu_I t (EMVA 1288 4.0, "dark current"). Deterministic."""
    expected = checked_light(expected_electrons, "expected_electrons")
    return expected + model.superpixel_dark_current_e_per_s * exposure_s


def draw_electrons(expected: Array, rng: np.random.Generator) -> Array:
    """Poisson electrons, float64; mean and variance are both `expected`.

    Above 1e11 by Cornish and Fisher's expansion, rounded, which is off by some 1/sqrt(mu) of an electron. Above 2^53 =
    9e15 not every whole number is a float64.
    """
    drawn = np.asarray(rng.poisson(np.minimum(expected, _MANY)), dtype=np.float64)
    many = expected > _MANY
    if not np.any(many):
        return drawn
    z = rng.standard_normal(np.shape(expected))
    return np.where(many, np.rint(poisson_quantile(expected, z)), drawn)


def poisson_quantile(expected: Array, z: Array | float) -> Array:
    """Where a Poisson count's distribution equals that of a standard normal deviate z; Cornish and Fisher (1938)."""
    return np.asarray(expected + np.sqrt(expected) * z + (np.square(z) - 1) / 6)


def clip_at_full_well(electrons: Array, model: SensorModel) -> Array:
    """Charge above the full well is lost: min(N, F). Moments: `moments.clipped_moments`."""
    return np.minimum(electrons, model.superpixel_full_well_e)


def add_read_noise(electrons: Array, model: SensorModel, rng: np.random.Generator) -> Array:
    """Normal noise of the superpixel's read noise; mean unchanged, variance plus sigma_d^2."""
    return electrons + model.superpixel_read_noise_e * rng.standard_normal(np.shape(electrons))


def amplify(electrons: Array, model: SensorModel) -> Array:
    """K (DN/e) electrons + black level, real-valued; mean times K plus black level, variance times K^2."""
    return electrons * model.gain_dn_per_e + model.superpixel_black_level_dn


def quantise(signal_dn: Array, model: SensorModel) -> Digital:
    """The ADC: nearest code, saturating at 0 and at the largest code; passes real values through if bits is
    None.

    Mean unchanged and variance plus 1/12 DN^2 (EMVA 1288 4.0, "noise model"), away from both ends and for
    noise above about half a code; elsewhere see `moments.frame_moments`.
    """
    if model.largest_dn is None:
        return signal_dn
    return np.clip(np.rint(signal_dn), 0, model.largest_dn).astype(np.uint32)


def _electrons_per_joule_m2(model: SensorModel, wavelength_nm: float) -> float:
    return model.quantum_efficiency * model.superpixel_area_m2 / photon_energy(wavelength_nm)


def checked_light(values: npt.ArrayLike, name: str) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if not np.all((array >= 0) & (array < np.inf)):
        raise ValueError(f"{name}: the range is {array.min()} to {array.max()}; all must be finite and 0 or more")
    return array

"""Irradiance on the sensor in, digital numbers out, stage by stage after EMVA 1288 release 4.0.

The order is physics and not to be permuted: irradiance x area x time -> photons -> quantum efficiency ->
photoelectrons -> crosstalk -> response of each pixel -> + dark current -> Poisson -> full-well clip -> linearity ->
+ offset, row noise, read noise -> gain -> black level -> quantise. A stage that a camera does not name is left out.
Means and variances in closed form are in `mitsim.sensor.moments`. All values are per superpixel (see
`SensorModel`); arrays keep their shape and are float64 until the last stage.
"""

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.units import photon_energy
from mitsim.rig.sensor import SensorModel
from mitsim.sensor.compiled import by_pixel, operations
from mitsim.sensor.specimen import neighbours, specimen

Digital = FloatArray | npt.NDArray[np.uint32]
"""Digital numbers: codes, or real values of a sensor without bits."""
_MANY = 64.0
"""Mean electrons from which counts are quantiles of normal deviates: three draws in a million are another count (see
:func:`poisson_count`), less than 1e9 draws tell; numpy's Poisson draw, besides, loses digits above 1e11."""


def electrons_from_irradiance(
    irradiance: npt.ArrayLike, exposure_s: float, model: SensorModel, wavelength_nm: float
) -> FloatArray:
    """Expected photoelectrons, without dark current.

    mu_e = eta E A t / (h c / lambda), EMVA 1288 4.0, "sensitivity". ValueError for negative or NaN irradiance or
    exposure.

    Parameters
    ----------
    irradiance
        [W m^-2], any shape, which the result has.
    exposure_s
        0 or more.
    model
        the sensor.
    wavelength_nm
        of the light.
    """
    light = checked_light(irradiance, "irradiance")
    if not 0 <= exposure_s < math.inf:
        raise ValueError(f"electrons_from_irradiance: exposure_s is {exposure_s}; it must be finite and 0 or more")
    return light * (exposure_s * _electrons_per_joule_m2(model, wavelength_nm))


def exposure_for_peak(peak_irradiance: float, fraction: float, model: SensorModel, wavelength_nm: float) -> float:
    """Exposure [s] after which light and dark current fill a part of the full well in the mean.

    MitsimError when there is no light or no full well, or the fraction is not in (0, 1].

    Parameters
    ----------
    peak_irradiance, wavelength_nm
        of the light [W m^-2].
    fraction
        of the full well.
    model
        the sensor.
    """
    if not 0 < fraction <= 1:
        raise MitsimError(f"exposure: got fraction {fraction} of full well; allowed is above 0, up to 1")
    if not 0 < peak_irradiance < np.inf:
        raise MitsimError(
            f"exposure: the peak irradiance is {peak_irradiance} W/m^2; it must be above 0 and finite; "
            "check that light reaches the sensor"
        )
    if not np.isfinite(model.full_well_e):
        raise MitsimError(f"exposure: sensor {model.name!r} has no full well to fill; give it in seconds")
    rate = peak_irradiance * _electrons_per_joule_m2(model, wavelength_nm)
    if rate == 0:
        raise MitsimError(f"exposure: sensor {model.name!r} is blind at {wavelength_nm:g} nm; give it in seconds")
    return float(fraction * model.superpixel_full_well_e / (rate + model.superpixel_dark_current_e_per_s))


def expose(
    expected_electrons: npt.ArrayLike,
    exposure_s: float,
    model: SensorModel,
    shot_rng: np.random.Generator,
    read_rng: np.random.Generator,
) -> Digital:
    """One noisy frame: uint32 DN, or float64 where the model has no bits. ValueError for negative or NaN electrons.

    Parameters
    ----------
    expected_electrons
        photoelectrons, any shape; (rows, columns) of a camera whose pixels differ, share noise or light.
    exposure_s
        adds its dark electrons.
    model
        the sensor.
    shot_rng, read_rng
        streams of their own, so that switching one noise off leaves the other's draw as it was. Row noise is drawn
        from a child of the latter.
    """
    light, dark = gathered(expected_electrons, exposure_s, model)
    shape = np.shape(light)
    offset = reading_offset(shape, model, read_rng)
    light = light.reshape(-1)
    dark = dark.reshape(-1) if isinstance(dark, np.ndarray) else dark
    arrays = light, dark, _few(light, dark, shot_rng), offset
    dtype = np.float64 if model.largest_dn is None else np.uint32
    return by_pixel(_read_out, _shared(model), arrays, (shot_rng, read_rng), dtype).reshape(shape)


def _read_out(model: Any, light: Any, dark: Any, few: Any, offset: Any, shot: Any, read: Any) -> Any:
    """All stages from the Poisson draw on, of pixels whose normal deviates are ``shot`` and ``read``."""
    electrons = bend(clip_at_full_well(_counted(light + dark, few, shot), model), model)
    if offset is not None:
        electrons = electrons + offset
    return quantise(amplify(add_read_noise(electrons, model, read), model), model)


def _shared(model: SensorModel) -> dict[str, float | tuple[float, ...] | None]:
    """The numbers of ``model`` that :func:`_read_out` asks it for."""
    return {
        "superpixel_full_well_e": model.superpixel_full_well_e,
        "linearity": tuple(model.linearity),
        "superpixel_read_noise_e": model.superpixel_read_noise_e,
        "gain_dn_per_e": model.gain_dn_per_e,
        "superpixel_black_level_dn": model.superpixel_black_level_dn,
        "largest_dn": model.largest_dn,
    }


def dn_to_electrons(dn: npt.ArrayLike, model: SensorModel) -> FloatArray:
    """What a user of the frames ``dn`` of a ``model`` does: (DN - black level) / gain, in electrons.

    Dark electrons stay in; noise may make values negative, and they stay so.
    """
    return (np.asarray(dn, dtype=np.float64) - model.superpixel_black_level_dn) / model.gain_dn_per_e


# ---- the stages, in order
# -------------------------------------------------------------------------------------


def add_dark_current(expected_electrons: npt.ArrayLike, exposure_s: float, model: SensorModel) -> FloatArray:
    """Expected photo- plus dark electrons, mu_e + mu_I t (EMVA 1288 4.0, "dark current"). Deterministic.

    Parameters
    ----------
    expected_electrons
        photoelectrons, any shape; ValueError where negative or NaN.
    exposure_s, model
        time and sensor.
    """
    expected = checked_light(expected_electrons, "expected_electrons")
    return expected + model.superpixel_dark_current_e_per_s * exposure_s


def gathered(
    expected_electrons: npt.ArrayLike, exposure_s: float, model: SensorModel
) -> tuple[FloatArray, FloatArray | float]:
    """Light after crosstalk and each pixel's response, and dark electrons: their sum is what is drawn. Deterministic.

    Of a camera without these: the light as it was, and one number of dark electrons. Charge that strays before it is
    counted leaves the counts of pixels independent and Poisson, so crosstalk is of the mean.

    Parameters
    ----------
    expected_electrons
        photoelectrons, any shape, or (rows, columns) as :func:`expose` says; ValueError where negative or NaN.
    exposure_s, model
        time and sensor.
    """
    light = checked_light(expected_electrons, "expected_electrons")
    dark: FloatArray | float = model.superpixel_dark_current_e_per_s * exposure_s
    if model.crosstalk:
        _frame_shape(light.shape, model)
        light = neighbours(light, model.superpixel_crosstalk)
    if not model.has_fixed_pattern:
        return light, dark
    own = specimen(model, _frame_shape(light.shape, model))
    if own.response is not None:
        light = light * own.response
    # One array of both: the blocks of a frame take it apart.
    return (light, dark) if own.dark_e_per_s is None else (light + own.dark_e_per_s * exposure_s, 0.0)


def most_gathered(expected_electrons: FloatArray, exposure_s: float, model: SensorModel) -> float:
    """Most electrons, dark ones too, that a pixel is expected to gather.

    Parameters
    ----------
    expected_electrons, exposure_s, model
        as :func:`gathered` has them.
    """
    if model.has_fixed_pattern or model.crosstalk:
        light, dark = gathered(expected_electrons, exposure_s, model)
        return float((light + dark).max())
    return float(add_dark_current(expected_electrons.max(), exposure_s, model))


def reading_offset(shape: tuple[int, ...], model: SensorModel, rng: np.random.Generator | None) -> FloatArray | None:
    """What is added to the charge of each pixel when it is read, flat [electrons]: fixed offset, and a row's noise.

    None where the camera has neither.

    Parameters
    ----------
    shape
        of the frame.
    model
        the sensor.
    rng
        whose child the row noise is drawn from; None: the offset alone.
    """
    fixed = specimen(model, _frame_shape(shape, model)).offset_e if any(model.offset_parts) else None
    offset = None if fixed is None else fixed.astype(np.float64)
    if model.row_noise_e and rng is not None:
        rows, columns = _frame_shape(shape, model)
        (own,) = rng.spawn(1)
        lines = model.superpixel_row_noise_e * own.standard_normal((rows, 1))
        offset = np.broadcast_to(lines, (rows, columns)) if offset is None else offset + lines
    return None if offset is None else offset.reshape(-1)


def draw_electrons(expected: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Poisson electrons, float64; mean and variance are both ``expected`` (any shape).

    Exact below a mean of 64, and :func:`poisson_count` of normal deviates above. Above 2^53 = 9e15 not every whole
    number is a float64. ``rng`` gives what is random.
    """
    flat = np.reshape(expected, -1)
    drawn = by_pixel(lambda _, *values: _counted(*values), {}, (flat, _few(flat, 0.0, rng)), (rng,))
    return np.asarray(drawn.reshape(np.shape(expected)))


def _few(light: FloatArray, dark: FloatArray | float, rng: np.random.Generator) -> FloatArray | None:
    """Electrons of pixels that expect fewer than :data:`_MANY`, not a number elsewhere; None where no pixel does."""
    if not light.size or light.min() + np.min(dark) >= _MANY:
        return None
    expected = light + dark
    few = expected < _MANY
    counts = np.full(expected.shape, np.nan)
    # Of a child, so that the pixels which expect many have the same deviates whatever these have.
    counts[few] = rng.spawn(1)[0].poisson(expected[few])
    return counts


def _counted(expected: Any, few: Any, z: Any) -> Any:
    """Electrons of pixels, drawn before where they are ``few``, and elsewhere as probable as ``z``."""
    many = poisson_count(expected, z)
    return many if few is None else operations(many).select(few == few, few, many)


def poisson_count(expected: Any, z: Any) -> Any:
    """Whole number of mean ``expected``, 64 or more, as probable as the normal deviate ``z``; both of one shape.

    The expansion of the inverse Poisson distribution by Giles (2016, ACM Transactions on Mathematical Software 42,
    algorithm 955, Q_N2): what :func:`poisson_quantile` has, and terms of 1/sqrt(mu) and 1/mu, which hold third and
    fourth cumulants and the correction for rounding. Off the law by a total variation of 3e-6 at 64, 2e-7 at 256, 1e-8
    at 1000; its variance by 7e-6 of it at 64, its third moment by 2e-6.
    """
    of, square = operations(expected), z * z
    root, part = of.sqrt(expected), 1 / expected
    third = (square + 2) * (z * root) / 72
    fourth = (square / 270 + 7 / 810) * square - 8 / 405
    return of.round(expected + z * root + ((square - 1) / 6 + (fourth - third) * part))


def poisson_quantile(expected: FloatArray, z: FloatArray | float) -> FloatArray:
    """Count of mean ``expected`` as probable as the normal deviate ``z``; Cornish and Fisher (1938)."""
    return np.asarray(expected + np.sqrt(expected) * z + (np.square(z) - 1) / 6)


def clip_at_full_well(electrons: Any, model: Any) -> Any:
    """``electrons`` less those above the full well of ``model``: min(N, F). Moments: `moments.clipped_moments`."""
    return operations(electrons).minimum(electrons, model.superpixel_full_well_e)


def bend(electrons: Any, model: Any) -> Any:
    """What ``electrons`` (any shape) are read as by a ``model`` that is not linear: N (1 + sum c_k (N/F)^k).

    Its moments: `moments.bent_moments`.
    """
    if not model.linearity:
        return electrons
    part = electrons / model.superpixel_full_well_e
    factor: Any = 0.0
    for coefficient in reversed(model.linearity):
        factor = (factor + coefficient) * part
    return electrons * (1 + factor)


def add_read_noise(electrons: Any, model: Any, z: Any) -> Any:
    """Electrons with normal noise added; mean unchanged, variance plus sigma_d^2.

    Parameters
    ----------
    electrons
        any shape.
    model
        whose read noise.
    z
        normal deviates of that shape.
    """
    return electrons + model.superpixel_read_noise_e * z


def amplify(electrons: Any, model: Any) -> Any:
    """``electrons`` times the gain K of ``model`` plus its black level, real-valued; variance times K^2."""
    return electrons * model.gain_dn_per_e + model.superpixel_black_level_dn


def quantise(signal_dn: Any, model: Any) -> Any:
    """The ADC of ``model``: nearest code to ``signal_dn``, from 0 to the largest; without bits, the signal itself.

    Mean unchanged and variance plus 1/12 DN^2 (EMVA 1288 4.0, "noise model"), away from both ends and for
    noise above about half a code; elsewhere see `moments.frame_moments`.
    """
    if model.largest_dn is None:
        return signal_dn
    of = operations(signal_dn)
    return of.clip(of.round(signal_dn), 0, model.largest_dn)


def _electrons_per_joule_m2(model: SensorModel, wavelength_nm: float) -> float:
    return model.efficiency(wavelength_nm) * model.superpixel_area_m2 / photon_energy(wavelength_nm)


def _frame_shape(shape: tuple[int, ...], model: SensorModel) -> tuple[int, int]:
    """``shape`` of a frame; ValueError where it is none."""
    if len(shape) != 2:
        raise ValueError(
            f"expected_electrons: the shape is {shape}; sensor {model.name!r} has pixels that differ, or that share "
            "light or noise, so give a frame of rows and columns"
        )
    return shape[0], shape[1]


def checked_light(values: npt.ArrayLike, name: str) -> FloatArray:
    """``values`` as float64; ValueError where one is negative or not finite, with their ``name``."""
    array = np.asarray(values, dtype=np.float64)
    # Of no number, least and largest are none either.
    if array.size and not (array.min() >= 0 and array.max() < np.inf):
        raise ValueError(f"{name}: the range is {array.min()} to {array.max()}; all must be finite and 0 or more")
    return array

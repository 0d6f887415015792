"""Irradiance on the sensor in, digital numbers out, stage by stage after EMVA 1288 release 4.0.

The order is physics and not to be permuted: irradiance x area x time -> photons -> quantum efficiency ->
photoelectrons -> crosstalk -> response of each pixel -> + dark current -> Poisson -> full-well clip -> linearity ->
+ offset, row noise, read noise -> gain -> black level -> quantise. A stage that a camera does not name is left out.
Means and variances in closed form are in `mitsim.sensor.moments`. All values are per superpixel (see
`SensorModel`); arrays keep their shape and are float64 until the last stage.
"""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.units import photon_energy
from mitsim.rig.sensor import SensorModel
from mitsim.sensor.specimen import neighbours, specimen

Digital = FloatArray | npt.NDArray[np.uint32]
"""Digital numbers: codes, or real values of a sensor without bits."""
_MANY = 256.0
"""Mean electrons from which counts are quantiles of normal deviates: four draws in a million are another count (see
:func:`poisson_count`), less than 1e9 draws tell, in half the time of numpy's Poisson draw; which, besides, loses digits
above 1e11."""
_BLOCK = 2**15
"""Pixels that go through all stages together: the stages' arrays stay in the cache (half the time of whole frames)."""
_ARRAYS = 5
"""Arrays of a block that :func:`expose` works in: expected electrons, and those of :func:`draw_electrons`."""


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
        raise MitsimError(f"exposure: sensor {model.name!r} has no full well to fill; choose exposure_s instead")
    rate = peak_irradiance * _electrons_per_joule_m2(model, wavelength_nm)
    if rate == 0:
        raise MitsimError(
            f"exposure: sensor {model.name!r} is blind at {wavelength_nm:g} nm; choose exposure_s instead"
        )
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
    offset = reading_offset(np.shape(light), model, read_rng)
    frame = np.empty(light.shape, np.float64 if model.largest_dn is None else np.uint32)
    light, numbers = light.reshape(-1), frame.reshape(-1)
    # All stages work in the same few arrays: new ones for each take a third of the time of two threads.
    arrays = np.empty((_ARRAYS, min(_BLOCK, light.size)))
    for start in range(0, light.size, _BLOCK):
        block = slice(start, start + _BLOCK)
        work = arrays[:, : light[block].size]
        expected = np.add(light[block], dark, out=work[0])
        electrons = draw_electrons(expected, shot_rng, work[1:])
        electrons = bend(clip_at_full_well(electrons, model, electrons), model)
        if offset is not None:
            electrons += offset[block]
        electrons = add_read_noise(electrons, model, read_rng, work[0])
        numbers[block] = quantise(amplify(electrons, model, electrons), model, electrons)
    return frame


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


def draw_electrons(
    expected: FloatArray, rng: np.random.Generator, work: Sequence[FloatArray] | FloatArray | None = None
) -> FloatArray:
    """Poisson electrons, float64; mean and variance are both ``expected``.

    Exact below a mean of 256, and :func:`poisson_count` of normal deviates above. Above 2^53 = 9e15 not every whole
    number is a float64.

    Parameters
    ----------
    expected
        mean electrons, any shape.
    rng
        random numbers.
    work
        four arrays of its shape to work in, the result among them; new ones if not given.
    """
    if expected.size and expected.min() >= _MANY:
        return _many(expected, rng, work)
    few = expected < _MANY
    if np.all(few):
        return np.asarray(rng.poisson(expected), dtype=np.float64)
    drawn = _many(np.maximum(expected, _MANY), rng, work)
    drawn[few] = rng.poisson(expected[few])
    return drawn


def _many(expected: FloatArray, rng: np.random.Generator, work: Sequence[FloatArray] | FloatArray | None) -> FloatArray:
    """Electrons where all ``expected`` are many; the others are those of :func:`draw_electrons`."""
    z, *rest = np.empty((4, *np.shape(expected))) if work is None else work
    return poisson_count(expected, rng.standard_normal(out=z), rest)


def poisson_count(
    expected: FloatArray, z: FloatArray, work: Sequence[FloatArray] | FloatArray | None = None
) -> FloatArray:
    """Whole number of mean ``expected``, 256 or more, as probable as the normal deviate ``z``; both of one shape.

    The expansion of the inverse Poisson distribution by Giles (2016, ACM Transactions on Mathematical Software 42,
    algorithm 955, Q_N2 without its last term): what :func:`poisson_quantile` has, and the term of 1/sqrt(mu), which
    holds the third cumulant and the correction for rounding. Off the law by a total variation of 4e-6 at 256, 5e-7
    at 1000, 2e-8 at 1e4; its variance by 1e-7 of it, its third moment by 7e-4.

    Parameters
    ----------
    expected, z
        mean electrons and normal deviates; with ``work``, z is worked in.
    work
        three arrays of their shape to work in, the first the result; new ones if not given.
    """
    count, root, square = np.empty((3, *np.shape(expected))) if work is None else work
    if work is None:
        z = np.array(z)
    np.square(z, out=square)
    np.subtract(square, 1, out=count)
    count /= 6
    square += 2
    square *= z
    np.sqrt(expected, out=root)
    z *= root
    z += expected
    count += z
    root *= 72
    square /= root
    count -= square
    return np.asarray(np.rint(count, out=count))


def poisson_quantile(expected: FloatArray, z: FloatArray | float) -> FloatArray:
    """Count of mean ``expected`` as probable as the normal deviate ``z``; Cornish and Fisher (1938)."""
    return np.asarray(expected + np.sqrt(expected) * z + (np.square(z) - 1) / 6)


def clip_at_full_well(electrons: FloatArray, model: SensorModel, out: FloatArray | None = None) -> FloatArray:
    """Electrons less those above the full well: min(N, F). Moments: `moments.clipped_moments`.

    Parameters
    ----------
    electrons
        any shape.
    model
        whose full well.
    out
        an array of that shape for the result; a new one if not given.
    """
    return np.minimum(electrons, model.superpixel_full_well_e, out=out)


def bend(electrons: FloatArray, model: SensorModel) -> FloatArray:
    """What ``electrons`` (any shape) are read as by a ``model`` that is not linear: N (1 + sum c_k (N/F)^k).

    Its moments: `moments.bent_moments`.
    """
    if not model.linearity:
        return electrons
    part = electrons / model.superpixel_full_well_e
    factor = np.zeros_like(part)
    for coefficient in reversed(model.linearity):
        factor += coefficient
        factor *= part
    return np.asarray(electrons * (1 + factor))


def add_read_noise(
    electrons: FloatArray, model: SensorModel, rng: np.random.Generator, out: FloatArray | None = None
) -> FloatArray:
    """Electrons with normal noise added; mean unchanged, variance plus sigma_d^2.

    Parameters
    ----------
    electrons
        any shape.
    model, rng
        whose read noise, and where it is drawn from.
    out
        an array of that shape, not the electrons', for the result; a new one if not given.
    """
    noise = rng.standard_normal(np.shape(electrons), out=out)
    noise *= model.superpixel_read_noise_e
    noise += electrons
    return noise


def amplify(electrons: FloatArray, model: SensorModel, out: FloatArray | None = None) -> FloatArray:
    """Electrons times the gain K plus the black level, real-valued; variance times K^2.

    Parameters
    ----------
    electrons
        any shape.
    model
        whose gain and black level.
    out
        an array of that shape for the result; a new one if not given.
    """
    signal = np.multiply(electrons, model.gain_dn_per_e, out=out)
    signal += model.superpixel_black_level_dn
    return signal


def quantise(signal_dn: FloatArray, model: SensorModel, out: FloatArray | None = None) -> Digital:
    """The ADC: nearest code to the signal, from 0 to the largest; without bits, the signal itself.

    Mean unchanged and variance plus 1/12 DN^2 (EMVA 1288 4.0, "noise model"), away from both ends and for
    noise above about half a code; elsewhere see `moments.frame_moments`.

    Parameters
    ----------
    signal_dn
        any shape.
    model
        whose ADC.
    out
        an array of that shape to work in; a new one if not given.
    """
    if model.largest_dn is None:
        return signal_dn
    codes = np.rint(signal_dn, out=out)
    np.maximum(codes, 0, out=codes)
    np.minimum(codes, model.largest_dn, out=codes)
    return codes.astype(np.uint32)


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

"""Irradiance on the sensor in, digital numbers out, stage by stage after EMVA 1288 release 4.0.

The order is physics and not to be permuted: irradiance x area x time -> photons -> quantum efficiency ->
photoelectrons + dark current -> Poisson -> full-well clip -> read noise -> gain -> black level -> quantise.
Beside each random or non-linear stage stands its mean and variance in closed form. All values are per
superpixel (see `SensorModel`); arrays keep their shape and are float64 until the last stage.
"""

import math

import numpy as np
import numpy.typing as npt
from scipy import special

from mitsim.core.errors import MitsimError
from mitsim.core.units import photon_energy
from mitsim.sensor.model import SensorModel

Array = npt.NDArray[np.float64]
Digital = npt.NDArray[np.float64] | npt.NDArray[np.uint32]
_MANY = 1e11
"""Electrons above which numpy's Poisson draw loses digits: its variance is 1 % off at 1e14, 100 times at 1e17."""
_FEW = 64.0
"""Electrons below which moments behind the ADC are summed count by count."""
_DITHERED = 0.8
"""Noise [DN] from which the variance of rounding is 1/12 to 1e-5 of the whole."""
_SMOOTH = 2.0
"""Standard deviation [DN] from which a sum over codes is an integral to 1e-4."""


def electrons_from_irradiance(
    irradiance: npt.ArrayLike, exposure_s: float, model: SensorModel, wavelength_nm: float
) -> Array:
    """Expected photoelectrons (without dark current) from irradiance in W/m^2, any shape.

    mu_e = eta E A t / (h c / lambda), EMVA 1288 4.0, "sensitivity". Raises ValueError for negative or NaN
    irradiance.
    """
    light = _expected(irradiance, "irradiance")
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
    expected = _expected(expected_electrons, "expected_electrons")
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
    return np.where(many, np.rint(_poisson_quantile(expected, z)), drawn)


def _poisson_quantile(expected: Array, z: Array | float) -> Array:
    """Where a Poisson count's distribution equals that of a standard normal deviate z; Cornish and Fisher (1938)."""
    return np.asarray(expected + np.sqrt(expected) * z + (np.square(z) - 1) / 6)


def clip_at_full_well(electrons: Array, model: SensorModel) -> Array:
    """Charge above the full well is lost: min(N, F). Moments: `clipped_moments`."""
    return np.minimum(electrons, model.superpixel_full_well_e)


def clipped_moments(expected: npt.ArrayLike, full_well_e: float) -> tuple[Array, Array]:
    """Mean and variance of min(N, F) for Poisson N with mean `expected` (any shape) and full well F.

    With k P(N=k) = mu P(N=k-1), K = ceil(F), Q = P(N >= K), d = mu - F and e = mu P(N = K-1), the loss L = (N - F)^+
    has E[L] = d Q + e and E[L^2] = (d^2 + mu) Q + (mu + K - 2F) e. Below the full well, as L (F - min(N, F)) is 0,
    E[min] = mu - E[L] and Var[min] = mu - E[L^2] - E[L]^2 + 2 E[L] d; above it the same of the room D = (F - N)^+,
    E[D] = e - d (1 - Q) and E[D^2] = mu + d^2 - E[L^2], where less cancels: E[min] = F - E[D], Var[min] = Var[D].
    """
    mean = _expected(expected, "expected")
    clipped, variance = mean.copy(), mean.copy()
    # Twelve standard deviations below the full well the loss is under 1e-30: left out, and with it nearly all the time.
    near = full_well_e - mean < 12 * np.sqrt(full_well_e) if np.isfinite(full_well_e) else np.zeros(mean.shape, bool)
    if near.any():
        clipped[near], variance[near] = _clipped(mean[near], full_well_e)
    return clipped, variance


def _clipped(mean: Array, full_well_e: float) -> tuple[Array, Array]:
    """:func:`clipped_moments` without short cuts."""
    step = math.ceil(full_well_e)
    over = mean - full_well_e
    above, below = _tails(step, mean)
    edge = mean * _poisson(step - 1, mean)
    skew = (mean + step - 2 * full_well_e) * edge
    # The differences of nearly equal terms can leave a rounding error below zero, where the truth is zero.
    loss, room = np.maximum(over * above + edge, 0.0), np.maximum(edge - over * below, 0.0)
    low = mean - ((over**2 + mean) * above + skew) - loss**2 + 2 * loss * over
    high = (over**2 + mean) * below - skew - room**2
    dim = over < 0
    return np.where(dim, mean - loss, full_well_e - room), np.maximum(np.where(dim, low, high), 0.0)


def _tails(count: int, mean: Array) -> tuple[Array, Array]:
    """P(N >= count) and P(N < count) for Poisson N, each as a tail of its own, so that 1e-20 still has its digits.

    Large counts by Temme's uniform expansion (DLMF 8.12.8, one term: 1/count is left), because scipy's sums stop early
    beyond 4.5 deviations: 3e-9 instead of 2.9e-7 at 1e12.
    """
    if count < 300_000:
        return special.pdtrc(count - 1, mean), special.pdtr(count - 1, mean)
    apart = (mean - count) / count
    with np.errstate(divide="ignore"):
        eta = np.sign(apart) * np.sqrt(2 * (apart - np.log1p(apart)))
    small = np.abs(apart) < 1e-4
    first = np.where(small, -1 / 3 + apart / 12, 1 / np.where(small, 1, apart) - 1 / np.where(small, 1, eta))
    shift = np.exp(-count * np.square(eta) / 2) / math.sqrt(2 * math.pi * count) * first
    above, below = special.ndtr(eta * math.sqrt(count)) - shift, special.ndtr(-eta * math.sqrt(count)) + shift
    return np.maximum(above, 0.0), np.maximum(below, 0.0)


def _poisson(count: int, mean: Array) -> Array:
    """P(N = count) for Poisson N, by Loader's saddle point expansion (2000), which keeps its digits up to 1e15."""
    if count == 0:
        return np.exp(-mean)
    if count < 32:
        remainder = math.lgamma(count + 1) - (count + 0.5) * math.log(count) + count - math.log(2 * math.pi) / 2
    else:
        remainder = 1 / (12 * count) - 1 / (360 * count**3) + 1 / (1260 * count**5)
    apart = (mean - count) / count
    with np.errstate(divide="ignore"):
        return np.asarray(np.exp(-remainder - count * (apart - np.log1p(apart))) / math.sqrt(2 * math.pi * count))


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
    noise above about half a code; elsewhere see `frame_moments`.
    """
    if model.largest_dn is None:
        return signal_dn
    return np.clip(np.rint(signal_dn), 0, model.largest_dn).astype(np.uint32)


def frame_moments(expected_electrons: npt.ArrayLike, exposure_s: float, model: SensorModel) -> tuple[Array, Array]:
    """Mean (DN) and variance (DN^2) of `expose`'s output (EMVA 1288 4.0, photon transfer).

    Where an end of the ADC is within eight deviations, or too little noise dithers its codes, the moments are those of
    rounded and cut numbers: summed over the counts below 64 electrons, and averaged over 129 of them above, which
    leaves up to 7 % of the variance and 0.25 DN of the mean (next to no read noise, gains above 1/2).
    """
    expected = add_dark_current(expected_electrons, exposure_s, model)
    clipped, variance = clipped_moments(expected, model.superpixel_full_well_e)
    read, gain = model.superpixel_read_noise_e * model.gain_dn_per_e, model.gain_dn_per_e
    mean, noise = np.asarray(amplify(clipped, model)), np.asarray(variance * gain**2 + read**2)
    if model.largest_dn is None:
        return mean, noise
    room, dim = np.minimum(mean, model.largest_dn - mean), expected < _FEW
    # Counts are a lattice that only read noise blurs, as long as they are few.
    hard = (room < 8 * np.sqrt(noise)) | (np.where(dim, read, np.sqrt(noise)) < _DITHERED)
    total = np.asarray(noise + 1 / 12)
    gone = room < -10 * np.sqrt(noise)
    mean[gone], total[gone] = model.largest_dn, 0.0
    for part, moments in ((hard & dim & ~gone, _counted), (hard & ~dim & ~gone, _averaged)):
        if part.any():
            mean[part], total[part] = moments(expected[part], model)
    return mean, total


def _counted(expected: Array, model: SensorModel) -> tuple[Array, Array]:
    """:func:`frame_moments` as a sum over electron counts; `expected` (pixels,) of few electrons."""
    most = float(expected.max())
    counts = np.arange(int(most + 12 * math.sqrt(most)) + 20, dtype=np.float64)
    levels, variances = _read_out(counts, model)
    weight = np.exp(-expected)
    first, second = np.zeros_like(expected), np.zeros_like(expected)
    for count, rise, variance in zip(counts, levels - levels[0], variances, strict=True):
        first += weight * rise
        second += weight * (rise**2 + variance)
        weight = weight * (expected / (count + 1))
    return levels[0] + first, np.maximum(second - first**2, 0.0)


def _averaged(expected: Array, model: SensorModel) -> tuple[Array, Array]:
    """:func:`frame_moments` as a mean over 129 electron counts, for many electrons.

    It depends on the light alone, and smoothly: shot noise has a deviation of 1/2 in the root of the counts. So many
    pixels are interpolated in steps of 1/20 of that root.
    """
    roots = np.sqrt(expected)
    nodes = int(np.ptp(roots) * 20) + 2
    if nodes < expected.size:
        grid = np.linspace(roots.min(), roots.max(), nodes)
        first, second = _averaged(np.square(grid), model)
        return np.interp(roots, grid, first), np.interp(roots, grid, second)
    deviates = np.linspace(-8, 8, 129)
    weights = np.exp(-np.square(deviates) / 2)
    start, _ = _read_out(expected, model)
    first, second = np.zeros_like(expected), np.zeros_like(expected)
    for z, weight in zip(deviates, weights / weights.sum(), strict=True):
        level, variance = _read_out(_poisson_quantile(expected, z), model)
        first += weight * (level - start)
        second += weight * (np.square(level - start) + variance)
    return start + first, np.maximum(second - first**2, 0.0)


def _read_out(electrons: Array, model: SensorModel) -> tuple[Array, Array]:
    """Mean and variance [DN] of what the ADC makes of known electrons (pixels,), before the full well."""
    assert model.largest_dn is not None
    signal = amplify(clip_at_full_well(electrons, model), model)
    read = np.full(signal.shape, model.superpixel_read_noise_e * model.gain_dn_per_e)
    return _rounded(signal, read, model.largest_dn)


def _rounded(mean: Array, deviation: Array, largest: int) -> tuple[Array, Array]:
    """Mean and variance of a normal signal (pixels,) rounded to the codes 0 .. `largest`, all in DN."""
    first, second = np.empty_like(mean), np.empty_like(mean)
    wide = deviation >= _SMOOTH
    for part, moments in ((wide, _cut_moments), (~wide, _code_moments)):
        if part.any():
            first[part], second[part] = moments(mean[part], deviation[part], largest)
    return first, second


def _cut_moments(mean: Array, deviation: Array, largest: int) -> tuple[Array, Array]:
    """:func:`_rounded` for deviations of at least 2 DN.

    The number is the sum over its codes of P(signal > code - 1/2), the midpoint rule for an integral in closed form:
    that of a cut normal signal. Euler and Maclaurin's first term, -1/24 of the integrand's slope between the ends, is
    1/12 DN^2 where nothing is cut.
    """
    # Noise far wider than the ADC leaves its two ends, whatever its width; and 40 deviations beyond an end are enough.
    narrower = np.minimum(deviation, 1e4 * largest)
    mean, deviation = mean * (narrower / deviation), narrower
    mean = np.clip(mean, -40 * deviation, largest + 40 * deviation)
    low, high = -mean / deviation, (largest - mean) / deviation
    under, over = special.ndtr(low), special.ndtr(-high)
    slope_low, slope_high = (np.exp(-np.square(x) / 2) / math.sqrt(2 * math.pi) for x in (low, high))
    first = low * under + high * over + slope_low - slope_high
    second = low**2 * under + high**2 * over + (1 - under - over) + low * slope_low - high * slope_high
    first = deviation * first + (slope_high - slope_low) / (24 * deviation)
    second = deviation**2 * second + (1 - under - over + high * slope_high - low * slope_low) / 12
    return mean + first, np.maximum(second - first**2, 0.0)


def _code_moments(mean: Array, deviation: Array, largest: int) -> tuple[Array, Array]:
    """:func:`_rounded` for deviations below 2 DN: code by code around the nearest one."""
    nearest = np.clip(np.rint(mean), 0, largest)
    if not deviation.any():
        return nearest, np.zeros_like(mean)
    scale = np.where(deviation > 0, deviation, 1)
    first, second = np.zeros_like(mean), np.zeros_like(mean)
    for step in range(1, 18):
        up = special.ndtr((mean - (nearest + step - 0.5)) / scale) * (nearest + step <= largest)
        down = special.ndtr(((nearest - step + 0.5) - mean) / scale) * (nearest - step >= 0)
        first += up - down
        second += (2 * step - 1) * (up + down)
    # Next to no noise resolves a tie as `quantise` does, to the even code.
    still = deviation < 1e-9
    first[still], second[still] = 0, 0
    return nearest + first, np.maximum(second - first**2, 0.0)


def _electrons_per_joule_m2(model: SensorModel, wavelength_nm: float) -> float:
    return model.quantum_efficiency * model.superpixel_area_m2 / photon_energy(wavelength_nm)


def _expected(values: npt.ArrayLike, name: str) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if not np.all((array >= 0) & (array < np.inf)):
        raise ValueError(f"{name}: the range is {array.min()} to {array.max()}; all must be finite and 0 or more")
    return array

"""Mean and variance of the sensor's output in closed form, after EMVA 1288 release 4.0.

Tails of the Poisson law and of the ADC's codes keep their digits from 1e-6 to 1e15 electrons.
"""

import math

import numpy as np
import numpy.typing as npt
import scipy

from mitsim.core.arrays import FloatArray
from mitsim.devices.sensor import SensorModel
from mitsim.sensor.chain import (
    Digital,
    add_dark_current,
    amplify,
    bend,
    checked_light,
    clip_at_full_well,
    mean_electrons,
    most_gathered,
    poisson_quantile,
    reading_offset,
)

_SOME = 1e4
_CAN_SATURATE = 1e-3
_DITHERED = 0.8
"""Noise [DN] from which the variance of rounding is 1/12 to 1e-5 of the whole."""
_SMOOTH = 2.0
"""Standard deviation [DN] from which a sum over codes is an integral to 1e-4."""
_STEP, _FINEST = 1 / 8, 1 / 64
"""Distance of interpolated offsets, in deviations of the noise of reading, and the least distance [DN]."""


def clipped_moments(expected: npt.ArrayLike, full_well_e: float) -> tuple[FloatArray, FloatArray]:
    """Return mean and variance of min(N, F) for Poisson N with mean ``expected`` (any shape) and full well F.

    With k P(N=k) = mu P(N=k-1), K = ceil(F), Q = P(N >= K), d = mu - F and e = mu P(N = K-1), the loss L = (N - F)^+
    has E[L] = d Q + e and E[L^2] = (d^2 + mu) Q + (mu + K - 2F) e. Below the full well, as L (F - min(N, F)) is 0,
    E[min] = mu - E[L] and Var[min] = mu - E[L^2] - E[L]^2 + 2 E[L] d. Above it the room D = (F - N)^+ cancels less:
    E[D] = e - d (1 - Q), E[D^2] = mu + d^2 - E[L^2], E[min] = F - E[D] and Var[min] = Var[D].
    """
    mean = checked_light(expected, "expected")
    clipped, variance = mean.copy(), mean.copy()
    # Twelve standard deviations below the full well the loss is under 1e-30: left out, and with it nearly all the time.
    near = full_well_e - mean < 12 * np.sqrt(full_well_e) if np.isfinite(full_well_e) else np.zeros(mean.shape, bool)
    if near.any():
        part, step = mean[near], math.ceil(full_well_e)
        over = part - full_well_e
        above, below = _tails(step, part)
        edge = part * _poisson(step - 1, part)
        skew = (part + step - 2 * full_well_e) * edge
        # The differences of nearly equal terms can leave a rounding error below zero, where the truth is zero.
        loss, room = np.maximum(over * above + edge, 0.0), np.maximum(edge - over * below, 0.0)
        low = part - ((over**2 + part) * above + skew) - loss**2 + 2 * loss * over
        high = (over**2 + part) * below - skew - room**2
        clipped[near] = np.where(over < 0, part - loss, full_well_e - room)
        variance[near] = np.maximum(np.where(over < 0, low, high), 0.0)
    return clipped, variance


def _tails(count: int, mean: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return P(N >= count) and P(N < count) for Poisson N, as two tails, so that 1e-20 keeps its digits.

    Large counts use Temme's uniform expansion (DLMF 8.12.8, one term), because scipy's sums stop early.
    """
    if count < 300_000:
        return scipy.special.pdtrc(count - 1, mean), scipy.special.pdtr(count - 1, mean)
    apart = (mean - count) / count
    with np.errstate(divide="ignore"):
        eta = np.sign(apart) * np.sqrt(2 * (apart - np.log1p(apart)))
    small = np.abs(apart) < 1e-4
    first = np.where(small, -1 / 3 + apart / 12, 1 / np.where(small, 1, apart) - 1 / np.where(small, 1, eta))
    shift = np.exp(-count * np.square(eta) / 2) / math.sqrt(2 * math.pi * count) * first
    apart = eta * math.sqrt(count)
    above, below = scipy.special.ndtr(apart) - shift, scipy.special.ndtr(-apart) + shift
    return np.maximum(above, 0.0), np.maximum(below, 0.0)


def _poisson(count: int, mean: FloatArray) -> FloatArray:
    """Return P(N = count) for Poisson N by Loader's saddle point expansion (2000), with full digits up to 1e15."""
    if count == 0:
        return np.exp(-mean)
    if count < 32:
        remainder = math.lgamma(count + 1) - (count + 0.5) * math.log(count) + count - math.log(2 * math.pi) / 2
    else:
        remainder = 1 / (12 * count) - 1 / (360 * count**3) + 1 / (1260 * count**5)
    apart = (mean - count) / count
    with np.errstate(divide="ignore"):
        return np.asarray(np.exp(-remainder - count * (apart - np.log1p(apart))) / math.sqrt(2 * math.pi * count))


def frame_moments(
    expected_electrons: npt.ArrayLike, exposure_s: float, model: SensorModel
) -> tuple[FloatArray, FloatArray]:
    """Return mean (DN) and variance (DN^2) of the output of `expose` for one specimen (EMVA 1288 4.0, photon transfer).

    Fixed patterns move means. The variance includes row noise, which is the covariance of two pixels of a row. Near an
    end of the ADC, or if too little noise dithers its codes, the moments are those of rounded and clipped numbers.
    """
    light, dark = mean_electrons(expected_electrons, exposure_s, model)
    expected = np.asarray(light + dark)
    offset = reading_offset(expected.shape, model, None)
    if offset is not None or model.linearity:
        return _general(expected, None if offset is None else offset.reshape(expected.shape), model)
    mean, variance = np.asarray(amplify(expected, model)), _linear_variance(expected, model)
    first, last = _linear(model)
    rest = (expected < first) | (expected > last)
    if rest.any():
        mean[rest], variance[rest] = _cut(expected[rest], model)
    return mean, variance


def _general(expected: FloatArray, offset: FloatArray | None, model: SensorModel) -> tuple[FloatArray, FloatArray]:
    level, spread = bent_moments(expected, model)
    mean = np.asarray(amplify(level if offset is None else level + offset, model))
    noise = np.asarray(_linear_variance(spread, model))
    rest = expected > model.superpixel_full_well_e - 12 * math.sqrt(min(model.superpixel_full_well_e, 1e300))
    if model.largest_dn is not None:
        deviation = np.sqrt(noise)
        dither = np.where(expected < _SOME, model.superpixel_reading_noise_e * model.gain_dn_per_e, deviation)
        room = np.minimum(mean, model.largest_dn - mean)
        rest |= (room < 8 * deviation) | (dither < _DITHERED)
    if rest.any():
        mean[rest], noise[rest] = _cut_by_offset(expected[rest], 0.0 if offset is None else offset[rest], model)
    return mean, noise


def _cut_by_offset(
    expected: FloatArray, offset: FloatArray | float, model: SensorModel
) -> tuple[FloatArray, FloatArray]:
    """Interpolate moments between black levels, because an offset acts as another black level."""
    if not np.ptp(offset):
        return _cut(expected, _with_offset(model, float(np.mean(offset))))
    read = model.superpixel_reading_noise_e * model.gain_dn_per_e
    step = max(_STEP * read, _FINEST) / model.gain_dn_per_e
    place = np.asarray(offset) / step
    below = np.floor(place)
    part = place - below
    mean, variance = np.zeros_like(expected), np.zeros_like(expected)
    for node in np.unique(np.concatenate([below, below + 1])):
        for here, weight in ((below == node, 1 - part), (below + 1 == node, part)):
            if here.any():
                first, second = _cut(expected[here], _with_offset(model, node * step))
                mean[here] += weight[here] * first
                variance[here] += weight[here] * second
    return mean, variance


def _with_offset(model: SensorModel, offset: float) -> SensorModel:
    black = model.black_level_dn + offset * model.gain_dn_per_e / model.codes
    return model.model_copy(update={"black_level_dn": black})


def bent_moments(expected: npt.ArrayLike, model: SensorModel) -> tuple[FloatArray, FloatArray]:
    """Return mean and variance [electrons] of `chain.bend` of unclipped Poisson counts with mean ``expected``.

    With g the polynomial of the model, a_j = g^(j)(mu) / j! and m_j the central moments of the Poisson law,
    m_{j+1} = mu (m_j' + j m_{j-1}) (Kendall and Stuart): E = sum a_j m_j and Var = sum a_i a_j (m_{i+j} - m_i m_j), i
    and j from 1. The differences are formed as polynomials in mu, so that no digits cancel.
    """
    mean = checked_light(expected, "expected")
    if not model.linearity:
        return mean.copy(), mean.copy()
    well = model.superpixel_full_well_e
    g = np.polynomial.Polynomial([0.0, 1.0, *(c / well**k for k, c in enumerate(model.linearity, 1))])
    degree = g.degree()
    central = _central_moments(2 * degree)
    moments = [moment(mean) for moment in central]
    slopes = [np.asarray(g.deriv(j)(mean) / math.factorial(j)) if j else g(mean) for j in range(degree + 1)]
    level, spread = np.asarray(slopes[0]), np.zeros_like(mean)
    for i in range(1, degree + 1):
        level = level + slopes[i] * moments[i]
        for j in range(1, degree + 1):
            spread += slopes[i] * slopes[j] * (central[i + j] - central[i] * central[j])(mean)
    return level, spread


def _central_moments(most: int) -> list[np.polynomial.Polynomial]:
    mu = np.polynomial.Polynomial([0.0, 1.0])
    found = [np.polynomial.Polynomial([1.0]), np.polynomial.Polynomial([0.0])]
    for j in range(1, most):
        found.append(mu * (found[j].deriv() + j * found[j - 1]))
    return found


def mean_variance(expected_electrons: npt.ArrayLike, exposure_s: float, model: SensorModel) -> float:
    """Return the mean over pixels of the variance (DN^2) of `frame_moments`; fast if the noise is linear."""
    if model.has_fixed_pattern or model.linearity or model.crosstalk:
        return float(frame_moments(expected_electrons, exposure_s, model)[1].mean())
    light = checked_light(expected_electrons, "expected_electrons")
    low, high, mean = (
        float(add_dark_current(value, exposure_s, model)) for value in (light.min(), light.max(), light.mean())
    )
    first, last = _linear(model)
    if first <= low and high <= last:
        return float(_linear_variance(np.float64(mean), model))
    return float(frame_moments(light, exposure_s, model)[1].mean())


def _linear_variance(expected: FloatArray | np.float64, model: SensorModel) -> FloatArray:
    read, gain = model.superpixel_reading_noise_e * model.gain_dn_per_e, model.gain_dn_per_e
    return np.asarray(expected * gain**2 + (read**2 + (0.0 if model.largest_dn is None else 1 / 12)))


def _linear(model: SensorModel) -> tuple[float, float]:
    """Return the least and most expected electrons between which moments are linear.

    The range is 12 deviations below the full well and 8 from both ends of the ADC, where the noise dithers its codes. A
    signal y [DN] of variance K (y - b) + r^2 is 8 deviations from 0 beyond the larger root of
    y^2 - 64 K y + 64 (K b - r^2), and from M below the smaller root of (M - y)^2 - 64 (K y - K b + r^2).
    """
    well, top = model.superpixel_full_well_e, model.largest_dn
    last = well - 12 * math.sqrt(well) if math.isfinite(well) else math.inf
    if top is None:
        return 0.0, last
    gain, black = model.gain_dn_per_e, model.superpixel_black_level_dn
    read = model.superpixel_reading_noise_e * gain
    offset = 64 * (gain * black - read**2)
    under = (32 * gain) ** 2 - offset
    first = (32 * gain + math.sqrt(under) - black) / gain if under > 0 else 0.0
    over = max((32 * gain) ** 2 + 64 * gain * top - offset, 0.0)
    last = min(last, (top + 32 * gain - math.sqrt(over) - black) / gain)
    if read < _DITHERED:
        first = max(first, _SOME, (_DITHERED**2 - read**2) / gain**2)
    return max(first, 0.0), last


def _cut(expected: FloatArray, model: SensorModel) -> tuple[FloatArray, FloatArray]:
    clipped, variance = clipped_moments(expected, model.superpixel_full_well_e)
    read, gain = model.superpixel_reading_noise_e * model.gain_dn_per_e, model.gain_dn_per_e
    mean, noise = np.asarray(amplify(clipped, model)), np.asarray(variance * gain**2 + read**2)
    few = expected < _SOME
    if model.linearity:
        return _sum_counts(expected, np.ones(expected.shape, bool), (mean, noise), model)
    if model.largest_dn is None:
        return mean, noise
    room, deviation = np.minimum(mean, model.largest_dn - mean), np.sqrt(noise)
    # Few counts form a lattice that only read noise blurs, and so do counts at the full well.
    full = model.superpixel_full_well_e - expected < 8 * np.sqrt(expected)
    hard = (room < 8 * deviation) | (np.where(few | full, read, deviation) < _DITHERED)
    total = np.asarray(noise + 1 / 12)
    gone = room < -10 * deviation
    mean[gone], total[gone] = np.clip(mean[gone], 0, model.largest_dn), 0.0
    return _sum_counts(expected, hard & ~gone, (mean, total), model)


def _sum_counts(
    expected: FloatArray, hard: npt.NDArray[np.bool_], moments: tuple[FloatArray, FloatArray], model: SensorModel
) -> tuple[FloatArray, FloatArray]:
    """Replace the moments of hard pixels by sums over counts, or by quadrature if there are many."""
    mean, total = moments
    for part, found in ((hard & (expected < _SOME), _sum_about_mean), (hard & (expected >= _SOME), _average_counts)):
        if part.any():
            mean[part], total[part] = found(expected[part], model)
    return mean, total


def _sum_about_mean(expected: FloatArray, model: SensorModel) -> tuple[FloatArray, FloatArray]:
    nodes = _grid(expected)
    reach = 12 * np.sqrt(nodes) + 20
    first, last = np.floor(nodes - reach).clip(0).astype(np.intp), np.ceil(nodes + reach).astype(np.intp)
    counts = np.arange(first.min(), last.max() + 1, dtype=np.float64)
    levels, variances = _read_out(counts, model)
    logarithms = scipy.special.gammaln(counts + 1)
    mean, variance = np.empty_like(nodes), np.empty_like(nodes)
    for index, node in enumerate(nodes):
        near = slice(first[index] - first.min(), last[index] - first.min() + 1)
        weights = np.exp(scipy.special.xlogy(counts[near], node) - node - logarithms[near])
        middle = levels[near][int(node) - first[index]]
        rise = (weights * (levels[near] - middle)).sum()
        mean[index] = middle + rise
        variance[index] = (weights * (np.square(levels[near] - middle - rise) + variances[near])).sum()
    return _between(expected, nodes, mean, variance)


def _average_counts(expected: FloatArray, model: SensorModel) -> tuple[FloatArray, FloatArray]:
    nodes = _grid(expected)
    deviates = np.linspace(-8, 8, 129)
    weights = np.exp(-np.square(deviates) / 2)
    weights /= weights.sum()
    start, _ = _read_out(nodes, model)
    first, second = np.zeros_like(nodes), np.zeros_like(nodes)
    # All quantiles of few nodes in one call; of many nodes, a few quantiles at a time, because of memory.
    for some in np.array_split(np.arange(deviates.size), min(nodes.size // 10_000 + 1, deviates.size)):
        counts = poisson_quantile(nodes, deviates[some, None])
        level, variance = _read_out(counts, model)
        first += weights[some] @ (level - start)
        second += weights[some] @ (np.square(level - start) + variance)
    return _between(expected, nodes, start + first, np.maximum(second - first**2, 0.0))


def _grid(expected: FloatArray) -> FloatArray:
    """Return expected counts of the pixels, or fewer between which moments are interpolated.

    Shot noise has a deviation of 1/2 in the root of the counts, and the steps are 1/20 of that root.
    """
    roots = np.sqrt(expected)
    count = int(np.ptp(roots) * 20) + 2
    return expected if count >= expected.size else np.square(np.linspace(roots.min(), roots.max() + 1e-6, count))


def _between(
    expected: FloatArray, nodes: FloatArray, mean: FloatArray, variance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    if nodes is expected:
        return mean, variance
    curves = scipy.interpolate.CubicSpline(np.sqrt(nodes), np.stack([mean, variance], axis=1))(np.sqrt(expected))
    return curves[:, 0], np.maximum(curves[:, 1], 0.0)


def _read_out(electrons: FloatArray, model: SensorModel) -> tuple[FloatArray, FloatArray]:
    signal = amplify(bend(clip_at_full_well(electrons, model), model), model)
    read = np.full(signal.shape, model.superpixel_reading_noise_e * model.gain_dn_per_e)
    if model.largest_dn is None:
        return signal, np.square(read)
    return _round_moments(signal, read, model.largest_dn)


def _round_moments(mean: FloatArray, deviation: FloatArray, largest: int) -> tuple[FloatArray, FloatArray]:
    first, second = np.empty_like(mean), np.empty_like(mean)
    wide = deviation >= _SMOOTH
    for part, moments in ((wide, _cut_moments), (~wide, _code_moments)):
        if part.any():
            first[part], second[part] = moments(mean[part], deviation[part], largest)
    return first, second


def _cut_moments(mean: FloatArray, deviation: FloatArray, largest: int) -> tuple[FloatArray, FloatArray]:
    """Return moments of a rounded normal signal for deviations of at least 2 DN.

    The sum over codes is the midpoint rule for a closed-form integral, with Euler and Maclaurin's first term.
    """
    # Noise far wider than the ADC leaves its two ends, whatever its width; and 40 deviations beyond an end are enough.
    narrower = np.minimum(deviation, 1e4 * largest)
    mean, deviation = mean * (narrower / deviation), narrower
    mean = np.clip(mean, -40 * deviation, largest + 40 * deviation)
    low, high = -mean / deviation, (largest - mean) / deviation
    under, over = scipy.special.ndtr(low), scipy.special.ndtr(-high)
    slope_low, slope_high = (np.exp(-np.square(x) / 2) / math.sqrt(2 * math.pi) for x in (low, high))
    first = low * under + high * over + slope_low - slope_high
    second = low**2 * under + high**2 * over + (1 - under - over) + low * slope_low - high * slope_high
    first = deviation * first + (slope_high - slope_low) / (24 * deviation)
    second = deviation**2 * second + (1 - under - over + high * slope_high - low * slope_low) / 12
    return mean + first, np.maximum(second - first**2, 0.0)


def _code_moments(mean: FloatArray, deviation: FloatArray, largest: int) -> tuple[FloatArray, FloatArray]:
    """Return moments of a rounded normal signal for deviations below 2 DN, code by code."""
    nearest = np.clip(np.rint(mean), 0, largest)
    if not deviation.any():
        return nearest, np.zeros_like(mean)
    scale = np.where(deviation > 0, deviation, 1)
    first, second = np.zeros_like(mean), np.zeros_like(mean)
    for step in range(1, math.ceil(8 * float(deviation.max())) + 2):
        up = scipy.special.ndtr((mean - (nearest + step - 0.5)) / scale) * (nearest + step <= largest)
        down = scipy.special.ndtr(((nearest - step + 0.5) - mean) / scale) * (nearest - step >= 0)
        first += up - down
        second += (2 * step - 1) * (up + down)
    # Next to no noise resolves a tie as `quantise` does, to the even code.
    still = deviation < 1e-9
    first[still], second[still] = 0, 0
    return nearest + first, np.maximum(second - first**2, 0.0)


def saturated_pixels(digital: Digital, expected_electrons: FloatArray, exposure_s: float, model: SensorModel) -> int:
    """Count the pixels of a frame that reached the full well or the ADC's end.

    A reading at the full well counts if the chance of saturation in the whole frame is 1e-3 or more.
    """
    well, brightest = model.superpixel_full_well_e, float(digital.max())
    ends = math.inf if model.largest_dn is None else float(model.largest_dn)
    if np.isfinite(well) and brightest >= np.floor(model.full_well_dn):
        peak = most_gathered(expected_electrons, exposure_s, model)
        if scipy.special.pdtrc(np.ceil(well) - 1, peak) * digital.size >= _CAN_SATURATE:
            ends = min(ends, float(np.floor(model.full_well_dn)))
    return int(np.count_nonzero(digital >= ends)) if brightest >= ends else 0

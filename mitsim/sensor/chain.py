"""The sensor chain after EMVA 1288 release 4.0, from irradiance to digital numbers.

The order is physics and must not change: irradiance x area x time -> photons -> quantum efficiency ->
photoelectrons -> crosstalk -> response of each pixel -> + dark current -> Poisson -> full-well clip -> linearity ->
+ offset, row noise, read noise -> gain -> black level -> quantise. A stage that a camera does not name is left out.
All values are per superpixel (see `SensorModel`). Mean and variance of the output are in closed form.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import compiled_arrays, device_array
from mitsim.core.errors import MitsimError
from mitsim.core.job import compiled_kernels
from mitsim.core.seeds import stream
from mitsim.devices.sensor import SensorModel

Digital = FloatArray | npt.NDArray[np.uint32]
Moments = tuple[FloatArray, FloatArray]
"""Mean and variance."""
_NUMBERS = (
    "superpixel_full_well_e", "linearity", "superpixel_read_noise_e", "gain_dn_per_e", "superpixel_black_level_dn",
    "largest_dn",
)  # fmt: skip
"""Numbers of a model that all pixels share."""
_MANY = 64.0
"""Mean electrons from which counts are quantiles of normal deviates."""


def electrons_from_irradiance(
    irradiance: npt.ArrayLike, exposure_s: float, model: SensorModel, wavelength_nm: float
) -> FloatArray:
    """Compute photoelectrons without dark current, mu_e = eta E A t / (h c / lambda) (EMVA 1288 4.0, "sensitivity")."""
    light = checked_light(irradiance, "irradiance")
    if not 0 <= exposure_s < math.inf:
        raise ValueError(f"electrons_from_irradiance: exposure_s is {exposure_s}; it must be finite and 0 or more")
    return light * (exposure_s * _electrons_per_joule_m2(model, wavelength_nm))


def exposure_for_peak(peak_irradiance: float, fraction: float, model: SensorModel, wavelength_nm: float) -> float:
    if not 0 < peak_irradiance < np.inf:
        problem = f"exposure: the peak irradiance is {peak_irradiance} W/m^2"
        raise MitsimError(f"{problem}; it must be above 0 and finite; check that light reaches the sensor")
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
    """Draw one noisy frame: uint32 DN, or float64 if the model has no bits.

    `expected_electrons` is (rows, columns) if pixels differ or share noise or light. The streams are separate, so that
    one noise can be switched off without a change of the other.
    """
    light, dark = mean_electrons(expected_electrons, exposure_s, model)
    shape = np.shape(light)
    offset = reading_offset(shape, model, read_rng)
    light = light.reshape(-1)
    dark = dark.reshape(-1) if isinstance(dark, np.ndarray) else dark
    arrays = light, dark, _few(light, dark, shot_rng), offset
    dtype = np.float64 if model.largest_dn is None else np.uint32
    numbers = {name: getattr(model, name) for name in _NUMBERS}
    return by_pixel(_read_out, numbers, arrays, (shot_rng, read_rng), dtype).reshape(shape)


def _read_out(model: Any, light: Any, dark: Any, few: Any, offset: Any, shot: Any, read: Any) -> Any:
    counts = poisson_count(light + dark, shot)
    counts = counts if few is None else operations(counts).select(few == few, few, counts)
    electrons = bend(clip_at_full_well(counts, model), model)
    if offset is not None:
        electrons = electrons + offset
    return quantise(amplify(electrons + model.superpixel_read_noise_e * read, model), model)


def dn_to_electrons(dn: npt.ArrayLike, model: SensorModel) -> FloatArray:
    """Convert digital numbers to electrons, (DN - black level) / gain, including dark electrons."""
    return (np.asarray(dn, dtype=np.float64) - model.superpixel_black_level_dn) / model.gain_dn_per_e


# -------- One specimen of a camera

Map = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Specimen:
    """Fixed differences between the pixels of one camera, (rows, columns) each; None without differences.

    `offset_e` is the reading beyond the black level, `response` is relative to undamaged pixels, and `hot` and `dead`
    count superpixels.
    """

    offset_e: Map | None
    response: Map | None
    dark_e_per_s: Map | None
    hot: int = 0
    dead: int = 0


@lru_cache(maxsize=2)
def specimen(model: SensorModel, shape: tuple[int, int]) -> Specimen:
    """Return the specimen that ``model.pattern_seed`` names (EMVA 1288 4.0, "spatial nonuniformity")."""
    count, pixels = math.prod(shape), math.prod(shape) * model.binning**2

    def draw(name: str, parts: tuple[float, float, float]) -> Map | None:
        if not any(parts):
            return None
        total, sizes = np.zeros(shape, dtype=np.float32), (shape, (shape[0], 1), (1, shape[1]))
        for deviation, kind, size in zip(parts, ("pixel", "row", "column"), sizes, strict=True):
            if deviation:
                total += deviation * stream(model.pattern_seed, name, kind).standard_normal(size, dtype=np.float32)
        return total

    def choose(kind: str, part: float) -> Map | None:
        if not part:
            return None
        chosen = stream(model.pattern_seed, kind).choice(pixels, round(part * pixels), replace=False)
        return np.bincount(chosen % count, minlength=count).reshape(shape).astype(np.float32)

    hot, dead = choose("hot", model.hot_pixels), choose("dead", model.dead_pixels)
    response = draw("response", model.response_parts)
    if response is not None:
        response = np.maximum(1 + response, np.float32(0))
    if dead is not None:
        alive = np.ones(shape, dtype=np.float32) if response is None else response
        response = np.asarray(alive * (1 - dead / model.binning**2), dtype=np.float32)
    mean, spread, dark = model.dark_current_e_per_s, model.dark_current_spread_e_per_s, None
    if spread or hot is not None:
        current = np.full(shape, mean * model.binning**2)
        if spread:  # a gamma law, which is never negative and whose sums over binned pixels are gamma, too
            shape_of_law = (mean * model.binning / spread) ** 2
            drawn = stream(model.pattern_seed, "dark current").standard_gamma(shape_of_law, shape)
            current = (spread**2 / mean) * drawn
        if hot is not None:
            current += model.hot_dark_current_e_per_s * hot
        dark = np.asarray(model.dark_factor * current, dtype=np.float32)
    hot_count, dead_count = (0 if each is None else int(np.count_nonzero(each)) for each in (hot, dead))
    return Specimen(draw("offset", model.offset_parts), response, dark, hot_count, dead_count)


def response_variance(model: SensorModel) -> float:
    """Return the variance over pixels of the response.

    With p of the pixels dead, b^2 in a superpixel: (1 + sum s^2) (q^2 + p q / b^2) - q^2, q = 1 - p.
    """
    dead, alive = model.dead_pixels, 1 - model.dead_pixels
    spread = sum(part**2 for part in model.response_parts)
    return (1 + spread) * (alive**2 + dead * alive / model.binning**2) - alive**2


def dark_current_variance(model: SensorModel) -> float:
    """Return the variance of superpixels' dark current [(electrons/s)^2]: b^2 (s^2 + p (1 - p) h^2)."""
    hot = model.hot_pixels * (1 - model.hot_pixels) * model.hot_dark_current_e_per_s**2
    return (model.binning * model.dark_factor) ** 2 * (model.dark_current_spread_e_per_s**2 + hot)


def mean_dark_current(model: SensorModel) -> float:
    hot = model.hot_pixels * model.hot_dark_current_e_per_s * model.binning**2 * model.dark_factor
    return model.superpixel_dark_current_e_per_s + hot


def neighbours(light: FloatArray, part: float) -> FloatArray:
    """Move a part of each pixel's light to its neighbours; the edge is continued, so that even light stays even."""
    around = np.pad(light, 1, mode="edge")
    shared = around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:]
    return np.asarray((1 - part) * light + (part / 4) * shared)


# -------- Stages of a frame, in order


def add_dark_current(expected_electrons: npt.ArrayLike, exposure_s: float, model: SensorModel) -> FloatArray:
    expected = checked_light(expected_electrons, "expected_electrons")
    return expected + model.superpixel_dark_current_e_per_s * exposure_s


def mean_electrons(
    expected_electrons: npt.ArrayLike, exposure_s: float, model: SensorModel
) -> tuple[FloatArray, FloatArray | float]:
    """Return light after crosstalk and response, and dark electrons; their sum is the mean of the Poisson draw."""
    light = checked_light(expected_electrons, "expected_electrons")
    dark: FloatArray | float = model.superpixel_dark_current_e_per_s * exposure_s
    if model.crosstalk:
        _frame_shape(light.shape, model)
        light = neighbours(light, model.crosstalk / model.binning)
    if not model.has_fixed_pattern:
        return light, dark
    own = specimen(model, _frame_shape(light.shape, model))
    if own.response is not None:
        light = light * own.response
    # One array of both: the blocks of a frame take it apart.
    return (light, dark) if own.dark_e_per_s is None else (light + own.dark_e_per_s * exposure_s, 0.0)


def reading_offset(shape: tuple[int, ...], model: SensorModel, rng: np.random.Generator | None) -> FloatArray | None:
    """Return the fixed offset and, with `rng`, row noise for each pixel, flat [electrons], or None."""
    fixed = specimen(model, _frame_shape(shape, model)).offset_e if any(model.offset_parts) else None
    offset = None if fixed is None else fixed.astype(np.float64)
    if model.row_noise_e and rng is not None:
        rows, columns = _frame_shape(shape, model)
        (own,) = rng.spawn(1)
        lines = model.superpixel_row_noise_e * own.standard_normal((rows, 1))
        offset = np.broadcast_to(lines, (rows, columns)) if offset is None else offset + lines
    return None if offset is None else offset.reshape(-1)


def _few(light: FloatArray, dark: FloatArray | float, rng: np.random.Generator) -> FloatArray | None:
    """Draw the electrons of pixels that expect few; NaN elsewhere, None without such pixels."""
    if not light.size or light.min() + np.min(dark) >= _MANY:
        return None
    expected = light + dark
    few = expected < _MANY
    counts = np.full(expected.shape, np.nan)
    # Of a child, so that the pixels which expect many have the same deviates whatever these have.
    counts[few] = rng.spawn(1)[0].poisson(expected[few])
    return counts


def poisson_count(expected: Any, z: Any) -> Any:
    """Return the Poisson count of mean ``expected`` (64 or more) at the quantile of the normal deviate ``z``.

    Giles (2016, ACM Transactions on Mathematical Software 42, algorithm 955, Q_N2); total variation 3e-6 at 64.
    """
    of, square = operations(expected), z * z
    root, part = of.sqrt(expected), 1 / expected
    third = (square + 2) * (z * root) / 72
    fourth = (square / 270 + 7 / 810) * square - 8 / 405
    return of.round(expected + z * root + ((square - 1) / 6 + (fourth - third) * part))


def poisson_quantile(expected: FloatArray, z: FloatArray | float) -> FloatArray:
    """Return the real count of mean ``expected`` at the quantile of the deviate ``z`` (Cornish, Fisher, 1938)."""
    return np.asarray(expected + np.sqrt(expected) * z + (np.square(z) - 1) / 6)


def clip_at_full_well(electrons: Any, model: Any) -> Any:
    return operations(electrons).minimum(electrons, model.superpixel_full_well_e)


def bend(electrons: Any, model: Any) -> Any:
    """Return the electrons that a nonlinear sensor reads, N (1 + sum c_k (N/F)^k)."""
    if not model.linearity:
        return electrons
    part = electrons / model.superpixel_full_well_e
    factor: Any = 0.0
    for coefficient in reversed(model.linearity):
        factor = (factor + coefficient) * part
    return electrons * (1 + factor)


def amplify(electrons: Any, model: Any) -> Any:
    return electrons * model.gain_dn_per_e + model.superpixel_black_level_dn


def quantise(signal_dn: Any, model: Any) -> Any:
    """Round to the nearest code of the ADC, which adds 1/12 DN^2 away from both ends (EMVA 1288 4.0)."""
    if model.largest_dn is None:
        return signal_dn
    of = operations(signal_dn)
    return of.clip(of.round(signal_dn), 0, model.largest_dn)


def _electrons_per_joule_m2(model: SensorModel, wavelength_nm: float) -> float:
    return model.efficiency(wavelength_nm) * model.superpixel_area_m2 / photon_energy(wavelength_nm)


def _frame_shape(shape: tuple[int, ...], model: SensorModel) -> tuple[int, int]:
    if len(shape) != 2:
        raise ValueError(
            f"expected_electrons: the shape is {shape}; sensor {model.name!r} has pixels that differ, or that share "
            "light or noise, so give a frame of rows and columns"
        )
    return shape[0], shape[1]


def checked_light(values: npt.ArrayLike, name: str) -> FloatArray:
    """Return values as float64; ValueError if one is negative or not finite."""
    array = np.asarray(values, dtype=np.float64)
    # Of no number, least and largest are none either.
    if array.size and not (array.min() >= 0 and array.max() < np.inf):
        raise ValueError(f"{name}: the range is {array.min()} to {array.max()}; all must be finite and 0 or more")
    return array


# -------- Compiled kernel of the stages
# Once light is known, noise takes most of the time of a frame: two normal deviates a pixel and some twenty operations.
# Dr.Jit makes one kernel of them for all processors, which takes a quarter of the time of numpy in as many threads.
#
# Deviates are found by counter (Philox; Salmon, Moraes, Dror and Shaw 2011, "Parallel random numbers: as easy as 1,
# 2, 3"): a pixel has its own, whatever is drawn for others and on however many threads. A counter gives four of them,
# so a lane of the kernel has four pixels, a quarter of a block apart. Deviates are float32, all else is float64.

LANE = 4
_BLOCK = 2**22
"""32 MiB of each array."""
_turn = threading.Lock()
"""Threads that take turns at each operation need twice as long."""

Numbers = Mapping[str, float | tuple[float, ...] | None]


def operations(values: Any) -> ModuleType:
    return np if isinstance(values, np.ndarray | float) else compiled_arrays()[0]


def by_pixel(
    stages: Callable[..., Any],
    numbers: Numbers,
    arrays: Sequence[FloatArray | float | None],
    streams: Sequence[np.random.Generator],
    dtype: npt.DTypeLike = np.float64,
) -> npt.NDArray[Any]:
    """Apply ``stages`` to every pixel and return (pixels,) results.

    ``stages`` is a function of a namespace of the ``numbers`` (which all pixels share), a value of each of the
    ``arrays`` ((pixels,), or shared floats), and a normal deviate of each of the ``streams``.
    """
    keys = [int(stream.bit_generator.random_raw()) for stream in streams]
    size = len(arrays[0])  # type: ignore[arg-type]
    result = np.empty(size, dtype)
    for start in range(0, size, _BLOCK):
        block = slice(start, min(start + _BLOCK, size))
        parts = [values[block] if isinstance(values, np.ndarray) else values for values in arrays]
        with _turn:
            _run(stages, numbers, parts, keys, start // LANE, result[block])
    return result


def _run(
    stages: Callable[..., Any],
    numbers: Numbers,
    arrays: Sequence[FloatArray | float | None],
    keys: Sequence[int],
    first: int,
    result: npt.NDArray[Any],
) -> None:
    dr, types = compiled_arrays()
    quarter = -(-len(result) // LANE)

    def share(value: float | None) -> Any:
        return None if value is None else dr.opaque(types.Float64, value, 1)

    def quarters(values: FloatArray | float | None) -> Sequence[Any]:
        if not isinstance(values, np.ndarray):
            return [share(values)] * LANE
        if len(values) < LANE * quarter:
            values = np.pad(values, (0, LANE * quarter - len(values)), mode="edge")
        return [device_array(types.Float64, part) for part in values.reshape(LANE, quarter)]

    every = SimpleNamespace(**{
        name: tuple(map(share, value)) if isinstance(value, tuple) else share(value)
        for name, value in numbers.items()
    })  # fmt: skip
    lane = dr.opaque(types.UInt32, first, 1) + dr.arange(types.UInt32, quarter)
    deviates = [types.Philox4x32(dr.opaque(types.UInt64, key, 1), lane).next_float32x4_normal() for key in keys]
    values = [quarters(array) for array in arrays]
    kind = types.UInt32 if result.dtype == np.uint32 else types.Float64
    filled = [
        kind(stages(every, *(value[k] for value in values), *(types.Float64(four[k]) for four in deviates)))
        for k in range(LANE)
    ]
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):  # which each thread has for itself
        dr.eval(filled)
    dr.sync_thread()
    compiled_kernels()
    for k, part in enumerate(filled):
        room = result[k * quarter : (k + 1) * quarter]
        room[...] = np.asarray(part)[: len(room)]


# -------- Mean and variance of the output
# Tails of the Poisson law and of the ADC's codes keep their digits from 1e-6 to 1e15 electrons.

_SOME = 1e4
_CAN_SATURATE = 1e-3
_DITHERED = 0.8
"""Noise [DN] from which the variance of rounding is 1/12 to 1e-5 of the whole."""
_SMOOTH = 2.0
"""Standard deviation [DN] from which a sum over codes is an integral to 1e-4."""
_STEP, _FINEST = 1 / 8, 1 / 64
"""Distance of interpolated offsets, in deviations of the noise of reading, and the least distance [DN]."""


def clipped_moments(expected: npt.ArrayLike, full_well_e: float) -> Moments:
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


def _tails(count: int, mean: FloatArray) -> Moments:
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


def frame_moments(expected_electrons: npt.ArrayLike, exposure_s: float, model: SensorModel) -> Moments:
    """Return mean (DN) and variance (DN^2) of the output of `expose` for one specimen (EMVA 1288 4.0, photon transfer).

    Fixed patterns move means. The variance includes row noise, which is the covariance of two pixels of a row. Near an
    end of the ADC, or if too little noise dithers its codes, the moments are those of rounded and clipped numbers.
    """
    light, dark = mean_electrons(expected_electrons, exposure_s, model)
    expected = np.asarray(light + dark)
    offset = reading_offset(expected.shape, model, None)
    offset = None if offset is None else offset.reshape(expected.shape)
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


def _cut_by_offset(expected: FloatArray, offset: FloatArray | float, model: SensorModel) -> Moments:
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


def bent_moments(expected: npt.ArrayLike, model: SensorModel) -> Moments:
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
    mu = np.polynomial.Polynomial([0.0, 1.0])
    central = [np.polynomial.Polynomial([1.0]), np.polynomial.Polynomial([0.0])]
    for j in range(1, 2 * degree):
        central.append(mu * (central[j].deriv() + j * central[j - 1]))
    moments = [moment(mean) for moment in central]
    slopes = [np.asarray(g.deriv(j)(mean) / math.factorial(j)) if j else g(mean) for j in range(degree + 1)]
    level, spread = np.asarray(slopes[0]), np.zeros_like(mean)
    for i in range(1, degree + 1):
        level = level + slopes[i] * moments[i]
        for j in range(1, degree + 1):
            spread += slopes[i] * slopes[j] * (central[i + j] - central[i] * central[j])(mean)
    return level, spread


def mean_variance(expected_electrons: npt.ArrayLike, exposure_s: float, model: SensorModel) -> float:
    """Return the mean over pixels of the variance (DN^2) of `frame_moments`; fast if the noise is linear."""
    if model.has_fixed_pattern or model.linearity or model.crosstalk:
        return float(frame_moments(expected_electrons, exposure_s, model)[1].mean())
    light = checked_light(expected_electrons, "expected_electrons")
    extremes = light.min(), light.max(), light.mean()
    low, high, mean = (float(add_dark_current(value, exposure_s, model)) for value in extremes)
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


def _cut(expected: FloatArray, model: SensorModel) -> Moments:
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


def _sum_counts(expected: FloatArray, hard: npt.NDArray[np.bool_], moments: Moments, model: SensorModel) -> Moments:
    """Replace the moments of hard pixels by sums over counts, or by quadrature if there are many."""
    mean, total = moments
    for part, found in ((hard & (expected < _SOME), _sum_about_mean), (hard & (expected >= _SOME), _average_counts)):
        if part.any():
            mean[part], total[part] = found(expected[part], model)
    return mean, total


def _sum_about_mean(expected: FloatArray, model: SensorModel) -> Moments:
    nodes = _grid(expected)
    reach = 12 * np.sqrt(nodes) + 20
    first, last = np.floor(nodes - reach).clip(0).astype(np.intp), np.ceil(nodes + reach).astype(np.intp)
    counts = np.arange(first.min(), last.max() + 1, dtype=np.float64)
    levels, variances = _read_moments(counts, model)
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


def _average_counts(expected: FloatArray, model: SensorModel) -> Moments:
    nodes = _grid(expected)
    deviates = np.linspace(-8, 8, 129)
    weights = np.exp(-np.square(deviates) / 2)
    weights /= weights.sum()
    start, _ = _read_moments(nodes, model)
    first, second = np.zeros_like(nodes), np.zeros_like(nodes)
    # All quantiles of few nodes in one call; of many nodes, a few quantiles at a time, because of memory.
    for some in np.array_split(np.arange(deviates.size), min(nodes.size // 10_000 + 1, deviates.size)):
        counts = poisson_quantile(nodes, deviates[some, None])
        level, variance = _read_moments(counts, model)
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


def _between(expected: FloatArray, nodes: FloatArray, mean: FloatArray, variance: FloatArray) -> Moments:
    if nodes is expected:
        return mean, variance
    curves = scipy.interpolate.CubicSpline(np.sqrt(nodes), np.stack([mean, variance], axis=1))(np.sqrt(expected))
    return curves[:, 0], np.maximum(curves[:, 1], 0.0)


def _read_moments(electrons: FloatArray, model: SensorModel) -> Moments:
    signal = amplify(bend(clip_at_full_well(electrons, model), model), model)
    read = model.superpixel_reading_noise_e * model.gain_dn_per_e
    if model.largest_dn is None:
        return signal, np.full(signal.shape, read * read)
    return (_cut_moments if read >= _SMOOTH else _code_moments)(signal, read, model.largest_dn)


def _cut_moments(mean: FloatArray, deviation: float, largest: int) -> Moments:
    """Return moments of a rounded normal signal for deviations of at least 2 DN.

    The sum over codes is the midpoint rule for a closed-form integral, with Euler and Maclaurin's first term.
    """
    # Noise far wider than the ADC leaves its two ends, whatever its width; and 40 deviations beyond an end are enough.
    narrower = min(deviation, 1e4 * largest)
    mean, deviation = mean * (narrower / deviation), narrower
    mean = np.clip(mean, -40 * deviation, largest + 40 * deviation)
    low, high = -mean / deviation, (largest - mean) / deviation
    under, over = scipy.special.ndtr(low), scipy.special.ndtr(-high)
    slope_low, slope_high = (np.exp(-np.square(x) / 2) / math.sqrt(2 * math.pi) for x in (low, high))
    first = low * under + high * over + slope_low - slope_high
    second = low**2 * under + high**2 * over + (1 - under - over) + low * slope_low - high * slope_high
    first = deviation * first + (slope_high - slope_low) / (24 * deviation)
    second = deviation * deviation * second + (1 - under - over + high * slope_high - low * slope_low) / 12
    return mean + first, np.maximum(second - first**2, 0.0)


def _code_moments(mean: FloatArray, deviation: float, largest: int) -> Moments:
    """Return moments of a rounded normal signal for deviations below 2 DN, code by code."""
    nearest, first, second = np.clip(np.rint(mean), 0, largest), np.zeros_like(mean), np.zeros_like(mean)
    # Next to no noise resolves a tie as `quantise` does, to the even code.
    for step in range(1, math.ceil(8 * deviation) + 2) if deviation >= 1e-9 else ():
        up = scipy.special.ndtr((mean - (nearest + step - 0.5)) / deviation) * (nearest + step <= largest)
        down = scipy.special.ndtr(((nearest - step + 0.5) - mean) / deviation) * (nearest - step >= 0)
        first += up - down
        second += (2 * step - 1) * (up + down)
    return nearest + first, np.maximum(second - first**2, 0.0)


def saturated_pixels(digital: Digital, expected_electrons: FloatArray, exposure_s: float, model: SensorModel) -> int:
    """Count the pixels of a frame that reached the full well or the ADC's end.

    A reading at the full well counts if the chance of saturation in the whole frame is 1e-3 or more.
    """
    well, brightest = model.superpixel_full_well_e, float(digital.max())
    ends = math.inf if model.largest_dn is None else float(model.largest_dn)
    if np.isfinite(well) and brightest >= np.floor(model.full_well_dn):
        light, dark = mean_electrons(expected_electrons, exposure_s, model)
        peak = float(np.max(light + dark))
        if scipy.special.pdtrc(np.ceil(well) - 1, peak) * digital.size >= _CAN_SATURATE:
            ends = min(ends, float(np.floor(model.full_well_dn)))
    return int(np.count_nonzero(digital >= ends)) if brightest >= ends else 0


# -------- Ripple of the light
# Light whose power is 1 + c cos(2 pi f t + phi) has over the exposure of a row, from t_r to t_r + T, the mean
#
#     1 + c sinc(f T) cos(2 pi f (t_r + T/2) + phi),   sinc(x) = sin(pi x) / (pi x),
#
# that is 1 + c Re[A_r exp(i phi)] with ``A_r = sinc(f T) exp(2 pi i f (t_r + T/2))``. Rows of a global shutter all
# begin at 0, pixel row r of a rolling one at r times its line time. A row of superpixels has the mean A of the rows
# that are summed in it; where charge is summed on chip and read as one line, it begins as one. The variance follows
# from the mean, by the law of photons. Over phases phi, all alike, the level has the
# mean 1, the variance c^2 |A_r|^2 / 2, and between rows the covariance c^2 Re[A_r A_s*] / 2.


def ripple_response(model: SensorModel, exposure_s: float, hertz: float, rows: int) -> npt.NDArray[np.complex128]:
    """Return (rows,) amplitude and phase A_r of a ripple of the light with amplitude 1."""
    summed = 1 if model.binning_on_chip else model.binning
    begins = model.known_line_time_s() * np.arange(rows * summed)
    lines = np.exp(2j * np.pi * hertz * (begins + exposure_s / 2))
    return np.asarray(np.sinc(hertz * exposure_s) * lines.reshape(rows, summed).mean(axis=1))


def ripple_level(response: npt.NDArray[np.complex128], amplitude: float, phase: float) -> FloatArray:
    """Return (rows, 1) the level of the light in each row of one frame; its mean over all phases is 1."""
    return np.asarray(1 + amplitude * (response * np.exp(1j * phase)).real[:, None])


# -------- Energy of a photon

PLANCK = 6.62607015e-34
"""J s (exact, SI 2019)."""
LIGHT_SPEED = 299_792_458.0
"""m/s (exact, SI 2019)."""


def photon_energy(wavelength_nm: float) -> float:
    """Return the energy of one photon [J], E = h c / lambda, at a vacuum wavelength [nm]."""
    if not wavelength_nm > 0:
        raise ValueError(f"photon_energy: wavelength_nm is {wavelength_nm}; it must be above 0")
    return PLANCK * LIGHT_SPEED / (wavelength_nm * 1e-9)

"""The sensor chain after EMVA 1288 release 4.0, from irradiance to digital numbers.

The order is physics and must not change: irradiance x area x time -> photons -> quantum efficiency ->
photoelectrons -> crosstalk -> response of each pixel -> + dark current -> Poisson -> full-well clip -> linearity ->
+ offset, row noise, read noise -> gain -> black level -> quantise. A stage that a camera does not name is left out.
All values are per superpixel (see `SensorModel`).
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

from mitsim.core.arrays import FloatArray, stream
from mitsim.core.environment import compiled_arrays
from mitsim.core.errors import MitsimError
from mitsim.core.job import compiled_kernels
from mitsim.devices.sensor import SensorModel

Digital = FloatArray | npt.NDArray[np.uint32]
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
    return quantise(amplify(add_read_noise(electrons, model, read), model), model)


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
            drawn = stream(model.pattern_seed, "dark current").standard_gamma(
                (mean * model.binning / spread) ** 2, shape
            )
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


def most_gathered(expected_electrons: FloatArray, exposure_s: float, model: SensorModel) -> float:
    if model.has_fixed_pattern or model.crosstalk:
        light, dark = mean_electrons(expected_electrons, exposure_s, model)
        return float((light + dark).max())
    return float(add_dark_current(expected_electrons.max(), exposure_s, model))


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


def add_read_noise(electrons: Any, model: Any, z: Any) -> Any:
    return electrons + model.superpixel_read_noise_e * z


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
        return [types.Float64(part) for part in values.reshape(LANE, quarter)]

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


# -------- Ripple of the light
# Light whose power is 1 + c cos(2 pi f t + phi) has over the exposure of a row, from t_r to t_r + T, the mean
#
#     1 + c sinc(f T) cos(2 pi f (t_r + T/2) + phi),   sinc(x) = sin(pi x) / (pi x),
#
# that is 1 + c Re[A_r exp(i phi)] with ``A_r = sinc(f T) exp(2 pi i f (t_r + T/2))``. Rows of a global shutter all
# begin at 0, pixel row r of a rolling one at r times its line time. A row of superpixels has the mean A of the rows
# that are summed in it; where charge is summed on chip and read as one line, it begins as one. The variance follows
# from the mean, by the law of photons (:mod:`mitsim.sensor.moments`). Over phases phi, all alike, the level has the
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

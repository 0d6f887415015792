"""Irradiance on the sensor in, digital numbers out, stage by stage after EMVA 1288 release 4.0.

The order is physics and not to be permuted: irradiance x area x time -> photons -> quantum efficiency ->
photoelectrons -> crosstalk -> response of each pixel -> + dark current -> Poisson -> full-well clip -> linearity ->
+ offset, row noise, read noise -> gain -> black level -> quantise. A stage that a camera does not name is left out.
Means and variances in closed form are in `mitsim.sensor.moments`. All values are per superpixel (see
`SensorModel`); arrays keep their shape and are float64 until the last stage.
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

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import compiled_arrays
from mitsim.core.errors import MitsimError
from mitsim.core.job import compiled_kernels
from mitsim.core.seeds import stream
from mitsim.devices.sensor import SensorModel

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
    light, dark = mean_electrons(expected_electrons, exposure_s, model)
    shape = np.shape(light)
    offset = reading_offset(shape, model, read_rng)
    light = light.reshape(-1)
    dark = dark.reshape(-1) if isinstance(dark, np.ndarray) else dark
    arrays = light, dark, _few(light, dark, shot_rng), offset
    dtype = np.float64 if model.largest_dn is None else np.uint32
    return by_pixel(_read_out, _numbers_of(model), arrays, (shot_rng, read_rng), dtype).reshape(shape)


def _read_out(model: Any, light: Any, dark: Any, few: Any, offset: Any, shot: Any, read: Any) -> Any:
    """All stages from the Poisson draw on, of pixels whose normal deviates are ``shot`` and ``read``."""
    electrons = bend(clip_at_full_well(_electron_counts(light + dark, few, shot), model), model)
    if offset is not None:
        electrons = electrons + offset
    return quantise(amplify(add_read_noise(electrons, model, read), model), model)


def _numbers_of(model: SensorModel) -> dict[str, float | tuple[float, ...] | None]:
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


# -------- One specimen of a camera

Map = npt.NDArray[np.float32]
"""(rows, columns) numbers of seven digits, more than any is known to."""
_MOST_MAPS = 2
"""Specimens that are kept: frames of a run have one size, and a test's may have two."""


@dataclass(frozen=True, eq=False)
class Specimen:
    """What is fixed in space of a camera; None is no difference between pixels.

    Attributes
    ----------
    offset_e
        (rows, columns) what a pixel reads beyond the black level without charge [electrons]; mean 0.
    response
        (rows, columns) a pixel's response to light over the mean of undamaged ones; 0 is dead.
    dark_e_per_s
        (rows, columns) dark current at the sensor's temperature, hot pixels' too.
    hot, dead
        how many superpixels have a hot pixel, and a dead one.
    """

    offset_e: Map | None
    response: Map | None
    dark_e_per_s: Map | None
    hot: int = 0
    dead: int = 0


@lru_cache(maxsize=_MOST_MAPS)
def specimen(model: SensorModel, shape: tuple[int, int]) -> Specimen:
    """The specimen that ``model.pattern_seed`` names, for frames of ``shape`` (rows, columns)."""
    hot, dead = (_defects(model, shape, kind) for kind in ("hot", "dead"))
    return Specimen(
        offset_e=_parts(model, shape, "offset", model.offset_parts),
        response=_response(model, shape, dead),
        dark_e_per_s=_dark_current(model, shape, hot),
        hot=0 if hot is None else int(np.count_nonzero(hot)),
        dead=0 if dead is None else int(np.count_nonzero(dead)),
    )


def response_variance(model: SensorModel) -> float:
    """Variance over pixels of the ``model``'s response, whose mean is that of undamaged pixels (1) less dead ones.

    With p of the pixels dead, b^2 in a superpixel: (1 + sum s^2) (q^2 + p q / b^2) - q^2, q = 1 - p.
    """
    dead, alive = model.dead_pixels, 1 - model.dead_pixels
    spread = sum(part**2 for part in model.response_parts)
    return (1 + spread) * (alive**2 + dead * alive / model.binning**2) - alive**2


def dark_current_variance(model: SensorModel) -> float:
    """Variance over superpixels of the ``model``'s dark current [(electrons/s)^2]: b^2 (s^2 + p (1 - p) h^2)."""
    hot = model.hot_pixels * (1 - model.hot_pixels) * model.hot_dark_current_e_per_s**2
    return (model.binning * model.dark_factor) ** 2 * (model.dark_current_spread_e_per_s**2 + hot)


def mean_dark_current(model: SensorModel) -> float:
    """Mean over superpixels of the ``model``'s dark current, hot pixels' too [electrons/s]."""
    hot = model.hot_pixels * model.hot_dark_current_e_per_s * model.binning**2 * model.dark_factor
    return model.superpixel_dark_current_e_per_s + hot


def _parts(model: SensorModel, shape: tuple[int, int], name: str, parts: tuple[float, float, float]) -> Map | None:
    """Sum of independent normal parts by pixel, row and column, of these standard deviations; None without any."""
    if not any(parts):
        return None
    total = np.zeros(shape, dtype=np.float32)
    sizes = shape, (shape[0], 1), (1, shape[1])
    for deviation, kind, size in zip(parts, ("pixel", "row", "column"), sizes, strict=True):
        if deviation:
            total += deviation * stream(model.pattern_seed, name, kind).standard_normal(size, dtype=np.float32)
    return total


def _response(model: SensorModel, shape: tuple[int, int], dead: Map | None) -> Map | None:
    spread = _parts(model, shape, "response", model.response_parts)
    if spread is None and dead is None:
        return None
    response = np.ones(shape, dtype=np.float32) if spread is None else np.maximum(1 + spread, np.float32(0))
    return response if dead is None else np.asarray(response * (1 - dead / model.binning**2), dtype=np.float32)


def _dark_current(model: SensorModel, shape: tuple[int, int], hot: Map | None) -> Map | None:
    """Gamma distributed, which is never below zero, and whose sums over the pixels that are binned are gamma too."""
    if not model.dark_current_spread_e_per_s and hot is None:
        return None
    mean, spread = model.dark_current_e_per_s, model.dark_current_spread_e_per_s
    if spread:
        drawn = stream(model.pattern_seed, "dark current").standard_gamma((mean * model.binning / spread) ** 2, shape)
        dark = (spread**2 / mean) * drawn
    else:
        dark = np.full(shape, mean * model.binning**2)
    if hot is not None:
        dark += model.hot_dark_current_e_per_s * hot
    return np.asarray(model.dark_factor * dark, dtype=np.float32)


def _defects(model: SensorModel, shape: tuple[int, int], kind: str) -> Map | None:
    """How many pixels of each superpixel are ``hot`` or ``dead``; None where the model has none of this ``kind``."""
    part = model.hot_pixels if kind == "hot" else model.dead_pixels
    if not part:
        return None
    count = math.prod(shape)
    pixels = count * model.binning**2
    chosen = stream(model.pattern_seed, kind).choice(pixels, round(part * pixels), replace=False)
    return np.bincount(chosen % count, minlength=count).reshape(shape).astype(np.float32)


def neighbours(light: FloatArray, part: float) -> FloatArray:
    """``light`` (rows, columns) of which each pixel's four neighbours have got a ``part``, a quarter each.

    Beyond the edge lies what lies at the edge, so even light stays even.
    """
    around = np.pad(light, 1, mode="edge")
    shared = around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:]
    return np.asarray((1 - part) * light + (part / 4) * shared)


# -------- Stages of a frame, in order


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


def mean_electrons(
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
        as :func:`mean_electrons` has them.
    """
    if model.has_fixed_pattern or model.crosstalk:
        light, dark = mean_electrons(expected_electrons, exposure_s, model)
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
    drawn = by_pixel(lambda _, *values: _electron_counts(*values), {}, (flat, _few(flat, 0.0, rng)), (rng,))
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


def _electron_counts(expected: Any, few: Any, z: Any) -> Any:
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


# -------- Compiled kernel of the stages
# Once light is known, noise is most of what a frame costs: two normal deviates a pixel and some twenty operations.
# Dr.Jit makes one kernel of them for all processors, which takes a quarter of the time of numpy in as many threads.
#
# Deviates are found by counter (Philox; Salmon, Moraes, Dror and Shaw 2011, "Parallel random numbers: as easy as 1,
# 2, 3"): a pixel has its own, whatever is drawn for others and on however many threads. A counter gives four of them,
# so a lane of the kernel has four pixels, a quarter of a block apart. Deviates are float32, all else is float64.

LANE = 4
"""Pixels of a lane: the deviates that a counter gives."""
_BLOCK = 2**22
"""Pixels that go through the stages at a time: 32 MiB of each array, where a sensor may have 2^28."""
_turn = threading.Lock()
"""Held while stages are described and run: threads that take turns at each operation take twice as long."""

Numbers = Mapping[str, float | tuple[float, ...] | None]
"""What all pixels share, by name."""


def operations(values: Any) -> ModuleType:
    """Where minimum, sqrt, square, round and clip of ``values`` are: in numpy, or, for arrays of its own, in Dr.Jit."""
    return np if isinstance(values, np.ndarray | float) else compiled_arrays()[0]


def by_pixel(
    stages: Callable[..., Any],
    numbers: Numbers,
    arrays: Sequence[FloatArray | float | None],
    streams: Sequence[np.random.Generator],
    dtype: npt.DTypeLike = np.float64,
) -> npt.NDArray[Any]:
    """(pixels,) what ``stages`` make of every pixel.

    Parameters
    ----------
    stages
        of a namespace of the numbers, a value of each of the arrays, and a normal deviate of each of the streams. It is
        called with Dr.Jit's arrays and describes what to do; it need not be the same function twice.
    numbers
        what all pixels share; other values need no new kernel.
    arrays
        (pixels,) each, the first at least; or floats that all pixels share; None stays None.
    streams
        each gives the key of its deviates, in one draw.
    dtype
        of the result, np.uint32 or np.float64.
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
    """Fill the ``result`` of one block, whose first lane is ``first``."""
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
    """(rows,) A_r: amplitude and phase of a ripple of amplitude 1 in each row of a frame.

    MitsimError for a rolling shutter whose line time is not known.

    Parameters
    ----------
    model
        the sensor.
    exposure_s
        T, for which each row is exposed [s].
    hertz
        f, frequency of the ripple [Hz].
    rows
        of the frame, of superpixels.
    """
    summed = 1 if model.binning_on_chip else model.binning
    begins = model.known_line_time_s() * np.arange(rows * summed)
    lines = np.exp(2j * np.pi * hertz * (begins + exposure_s / 2))
    return np.asarray(np.sinc(hertz * exposure_s) * lines.reshape(rows, summed).mean(axis=1))


def ripple_level(response: npt.NDArray[np.complex128], amplitude: float, phase: float) -> FloatArray:
    """(rows, 1) level of the light in each row of one frame, 1 on average over all phases.

    Parameters
    ----------
    response
        (rows,) of the shutter to the ripple.
    amplitude, phase
        c and phi [radians]; an amplitude of at most 1, so that no level is below 0.
    """
    return np.asarray(1 + amplitude * (response * np.exp(1j * phase)).real[:, None])


# -------- Energy of a photon

PLANCK = 6.62607015e-34
"""Planck constant, J s (exact, SI 2019)."""
LIGHT_SPEED = 299_792_458.0
"""Speed of light in vacuum, m/s (exact, SI 2019)."""


def photon_energy(wavelength_nm: float) -> float:
    """Energy of one photon [J], E = h c / lambda, at a vacuum wavelength ``wavelength_nm`` [nm]; ValueError unless that
    is above 0."""
    if not wavelength_nm > 0:
        raise ValueError(f"photon_energy: wavelength_nm is {wavelength_nm}; it must be above 0")
    return PLANCK * LIGHT_SPEED / (wavelength_nm * 1e-9)

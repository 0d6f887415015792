"""Sets of a real camera's frames in, their statistics out, or a line that says why they tell nothing of the camera.

What frames themselves betray is said: unequal light in a set, saturation, uneven or drifting light, noise that was
smoothed or compressed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.images import image_size, read_image
from mitsim.core.job import Cost, Job
from mitsim.core.parallel import in_threads
from mitsim.devices.flatlist import DarkSet, FlatFrames, LitSet
from mitsim.sensor.emva import LINEAR, MOST_FITTED, Alike, alike
from mitsim.sensor.found_camera import FoundCamera
from mitsim.sensor.photon_transfer import Taken, saturation_of

_LEAST_SIDE = 16
"""Rows and columns without which a frame's rows, columns and surface are not told apart."""
_UNEQUAL = 0.1
"""Part of the light by which the frames of a set may differ, as a standard deviation: a lamp that varies by more was
not on, or the exposure was another one."""
_SURE = 6.0
"""Standard errors from which a difference is none by chance, of thousands that are looked at."""
_WHITE = 0.02
"""Correlation of the noise of neighbours that charge between pixels may make (some 1 to 2 % in infrared arrays)."""
_MIXED = 0.1
"""The same, from which frames were computed from their neighbours: variances are then a tenth off, and no fit explains
them."""
_EVEN = 0.03
"""Part of the light by which EMVA 1288 4.0 lets it differ over the frame."""
_STEADY = 0.01
"""Part of the light by which sets may be off what their exposures say before it is said."""
_STRAIGHT = 0.05
"""Part of a variance by which it may be off what the camera explains before it is said."""
_STILL = 0.1
"""Digital numbers by which a dark mean may be off what the camera explains before it is said: chosen, a tenth of the
least step."""
_SWAPPED = 1.5
"""Response over that of most sets, or below, at which no lamp is steady enough."""
_PEAK = 0.6
"""Part of the brightest signal at which a camera's variance is largest at least: cameras reach it at 0.8 or later, and
charge that is held at a soft full well somewhat before."""
_FLOATS = 9
"""Arrays of the frame's size in double precision that are held for a set; counted."""


@dataclass(frozen=True, eq=False)
class FlatSet:
    """Frames that were taken alike, and what they say.

    Attributes
    ----------
    flats, listed
        the list, and the set in it.
    taken
        the statistics.
    factor
        that all its numbers have in common.
    """

    flats: FlatFrames
    listed: DarkSet
    taken: Taken
    factor: int

    def mean_image(self) -> FloatArray:
        """Mean of its frames (M, N) [DN]; they are read again."""
        total = 0.0 + sum(values.astype(np.float64) for _, values in _numbers(self.flats, self.listed))
        return np.asarray(total / len(self.listed.files))

    @property
    def name(self) -> str:
        """Its first and last file."""
        return f"{self.listed.files[0]} to {self.listed.files[-1]}"


def read_sets(flats: FlatFrames, job: Job) -> list[FlatSet]:
    """Statistics of every set, frame by frame.

    Parameters
    ----------
    flats
        what is read.
    job
        told how far it is.

    Raises
    ------
    MitsimError
        for frames that cannot be read or differ in size, numbers that the list does not explain, frames of a set that
        are not alike, and sets of which none is below saturation.
    """
    where = f"frames {flats.folder}"
    shape = image_size(flats.folder / flats.sets[0].files[0], flats.wanted)
    if min(shape) < _LEAST_SIDE:
        raise MitsimError(f"{where}: {shape[0]} x {shape[1]} pixels; give {_LEAST_SIDE} or more a side")
    Cost(memory_bytes=2 * 8 * _FLOATS * math.prod(shape)).check(where, job.limits)
    job.progress("frames", 0.0)
    with job.clock.stage("frames"):
        sets = in_threads(lambda each: _read_set(flats, each, shape), flats.sets)
    _check_numbers(where, flats, sets)
    _check_light(where, sets)
    _check_noise(where, sets)
    return sets


def _numbers(flats: FlatFrames, listed: DarkSet) -> Iterator[tuple[Path, npt.NDArray[np.generic]]]:
    for name in listed.files:
        yield flats.folder / name, read_image(flats.folder / name, flats.wanted)


def _read_set(flats: FlatFrames, listed: DarkSet, shape: tuple[int, int]) -> FlatSet:
    facts, factor = flats.listed, 0
    largest = math.inf if facts.bits is None else 2.0**facts.bits - 1

    def frames() -> Iterator[npt.NDArray[np.generic]]:
        nonlocal factor
        for path, values in _numbers(flats, listed):
            if values.shape != shape:
                sizes = " and ".join(f"{m} x {n}" for m, n in (shape, values.shape[:2]))
                raise MitsimError(f"frame {path}: frames have {sizes} pixels; give frames of one size")
            if facts.bits is not None:
                least, most = float(values.min()), float(values.max())
                if least < 0 or most > largest:
                    raise MitsimError(
                        f"frame {path}: holds {least if least < 0 else most:g}, and numbers of {facts.bits} bits "
                        "are 0 to "
                        f"{largest:g}; correct bits"
                    )
                if values.dtype.kind == "f" and np.any(values != np.rint(values)):
                    raise MitsimError(f"frame {path}: holds numbers that are not whole; leave bits out")
                factor = math.gcd(factor, int(np.gcd.reduce(values.astype(np.int64), axis=None)))
            yield values

    said = alike(frames(), largest)
    light = 0.0
    if isinstance(listed, LitSet):
        light = listed.light * listed.exposure_s * (facts.photons_per_s or 1.0)
    return FlatSet(flats, listed, Taken(light, listed.exposure_s, said), factor)


def _check_numbers(where: str, flats: FlatFrames, sets: Sequence[FlatSet]) -> None:
    """MitsimError for numbers that were shifted."""
    factor = math.gcd(*(each.factor for each in sets))
    if factor > 1:
        raise MitsimError(
            f"{where}: all numbers are multiples of {factor}, so they were scaled after the ADC; divide them by "
            f"{factor}, "
            f"and state the bits that are left of {flats.listed.bits}"
        )


def _check_light(where: str, sets: Sequence[FlatSet]) -> None:
    """MitsimError for sets that are not what the list says."""
    dark = {each.taken.exposure_s: each for each in sets if not each.taken.light}
    lit = [each for each in sets if each.taken.light]
    signals = list[float]()
    for each in lit:
        said, still = each.taken.said, dark[each.taken.exposure_s].taken.said
        signals.append(float(said.pair.mean) - float(still.pair.mean))
        if signals[-1] <= _SURE * math.hypot(said.mean_error, still.mean_error):
            raise MitsimError(
                f"{where}: {each.name} is no brighter than the dark frames of its exposure; light it, or list it as "
                "dark"
            )
        if said.flicker > _UNEQUAL * signals[-1]:
            raise MitsimError(
                f"{where}: {each.name} differ by {100 * said.flicker / signals[-1]:.0f} % of their light; take the "
                "frames of a set with one exposure, under a steady lamp"
            )
    brightest = max(float(each.taken.said.pair.mean) for each in lit)
    for each in dark.values():
        if each.taken.said.flicker > _UNEQUAL * max(brightest - float(each.taken.said.pair.mean), 0.0):
            raise MitsimError(
                f"{where}: {each.name} are listed as dark and differ by {each.taken.said.flicker:.3g} DN; cover the "
                "camera, and take them again"
            )
    if all(each.taken.said.cut[1] for each in lit):
        part = min(each.taken.said.cut[1] for each in lit)
        raise MitsimError(
            f"{where}: all sets under light hold saturated numbers, {100 * part:.3g} % of them at least; expose "
            "some for less"
        )
    peak, _ = saturation_of([each.taken for each in sets])
    full = signals[lit.index(sets[peak])]
    for each, signal in zip(lit, signals, strict=True):
        if not each.taken.said.cut[1] and signal <= full and not float(each.taken.said.pair.variance):
            raise MitsimError(
                f"{where}: {each.name} are equal in every number: one frame twice, or noise below a code; take two, "
                "at a higher gain"
            )
    responses = {
        each.name: signal / each.taken.light
        for each, signal in zip(lit, signals, strict=True)
        if LINEAR[0] * full < signal < MOST_FITTED * full
    }
    middle = float(np.median([*responses.values()])) if responses else 1.0
    for name, response in responses.items():
        if not 1 / _SWAPPED < response / middle < _SWAPPED:
            raise MitsimError(
                f"{where}: {name} are {response / middle:.3g} times as bright as most sets are at their exposures; "
                "correct exposure_s, light or files of the list"
            )


def _check_noise(where: str, sets: Sequence[FlatSet]) -> None:
    """MitsimError for pictures that were computed from a camera's readings."""
    mixed = float(np.median([max(map(abs, _correlations(each.taken.said))) for each in sets]))
    if mixed > _MIXED:
        raise MitsimError(
            f"{where}: noise of neighbouring pixels is correlated by {mixed:.2g}, so frames were compressed, "
            "smoothed, scaled or demosaiced, and tell no gain or noise of the camera; give raw frames"
        )
    means = [float(each.taken.said.pair.mean) for each in sets]
    part = (means[saturation_of([each.taken for each in sets])[0]] - min(means)) / (max(means) - min(means))
    if part < _PEAK:
        raise MitsimError(
            f"{where}: the variance is largest at {100 * part:.0f} % of the brightest signal, not near it, as after "
            "a gamma curve, compression or too coarse codes; give raw frames of more bits, or of a higher gain"
        )


def remarks(sets: Sequence[FlatSet], found: FoundCamera) -> tuple[str, ...]:
    """What is amiss with frames though they can be measured, with what it does to the figures.

    Parameters
    ----------
    sets
        of frames.
    found
        the camera that explains them.
    """
    transfer, lines = found.transfer, list[str]()
    used = [(sets[index], off) for index, off in enumerate(transfer.off) if np.all(np.isfinite(off))]
    smooth, each = max(
        ((max(map(abs, _correlations(each.taken.said))), each) for each, _ in used), key=lambda pair: pair[0]
    )
    if smooth > 0:
        lines.append(
            f"noise of neighbouring pixels is correlated by {smooth:.2g} in {each.name}: frames were compressed, "
            "smoothed, scaled or demosaiced, and gain and noise are of those pictures, not of the camera; give raw "
            "frames"
        )
    widened = math.sqrt(max(transfer.chi_square / max(transfer.freedom, 1), 1))
    bent = [
        (abs(off[1]) * said.variance_error / float(said.pair.variance), each.name)
        for each, off in used
        for said in [each.taken.said]
        if abs(off[1]) > _SURE and each.taken.light
    ]
    if bent and max(bent)[0] > _STRAIGHT:
        part, name = max(bent)
        lines.append(
            f"variances do not rise with means as those of counted electrons: {name} is off by {100 * part:.0f} %; a "
            f"gamma curve, compression or automatic gain does that; standard errors are widened by {widened:.2g}"
        )
    still = [(abs(off[0]) * each.taken.said.mean_error, each.name) for each, off in used
             if abs(off[0]) > _SURE and not each.taken.light]  # fmt: skip
    if still and max(still)[0] > _STILL:
        lines.append(
            f"dark means do not rise with exposure: {max(still)[1]} is off by {max(still)[0]:.2g} DN; the black level "
            "or the temperature drifts, or frames are listed at another exposure; black_level_dn and "
            f"dark_current_e_per_s are not to be trusted, standard errors are widened by {widened:.2g}"
        )
    known = (
        "gain and noise hold; quantum_efficiency, saturation_capacity and linearity are known to that, as their "
        "standard errors say; take the frames again under a steady lamp"
    )
    if transfer.light == "undecided":
        lines.append(
            "means bend with exposure, and variances do not tell whether the camera bends or the lamp drifts: "
            "linearity, gain, full_well and quantum_efficiency of the camera found have the difference in their "
            "standard errors; take more frames in each set, or measure the lamp at each and list it as light"
        )
    elif transfer.light == "drifts":
        lines.append(
            "means bend with exposure and variances over means do not, so the lamp drifts or exposures are not as "
            f"listed, by {100 * transfer.lamp:.2g} %; {known}"
        )
    elif transfer.lamp > _STEADY:
        lines.append(f"light scatters by {100 * transfer.lamp:.2g} % about what exposures say; {known}")
    if found.uneven > _EVEN:
        lines.append(
            f"light differs by {100 * found.uneven:.0f} % over the frame, and EMVA 1288 allows {100 * _EVEN:.0f} %: "
            "the "
            "figures prnu_* hold it; in the camera found a surface of second degree is taken off"
        )
    return tuple(lines)


def _correlations(said: Alike) -> tuple[float, float]:
    """Correlations of the noise of neighbours that are more than chance and charge between pixels make; else 0."""
    limit = _WHITE + _SURE / math.sqrt(math.prod(said.shape))
    along, across = said.neighbours
    return (along if abs(along) > limit else 0.0), (across if abs(across) > limit else 0.0)

"""Reading of a real camera's flat and dark frames, and tests whether the frames can be those of a camera.

Frames that show nothing of the camera are refused: unequal light in a set, saturation, smoothing, scaling. Whatever
else does not fit the camera that was found is reported with its size.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.images import image_size, read_image
from mitsim.core.job import Cost, Job
from mitsim.core.parallel import in_threads
from mitsim.devices.flatlist import DarkSet, FlatFrames, LitSet
from mitsim.sensor.emva import LEAST_DARK, LINEAR, MOST_FITTED, Alike, alike
from mitsim.sensor.found_camera import FoundCamera, Places
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
_COMB, _SCALED = 0.05, 0.99
"""Amplitudes of a pattern in the histogram of codes: beyond that of a real ADC; and of codes that all lie apart."""
_EVEN = 0.03
"""Part of the light by which EMVA 1288 4.0 lets it differ over the frame."""
_STEADY = 0.01
"""Part of the light by which sets may be off what their exposures say before it is said."""
_STRAIGHT = 0.05
"""Part of a variance by which it may be off what the camera explains before it is said."""
_STILL = 0.1
"""Digital numbers by which a dark mean may be off what the camera explains before it is said: chosen, a tenth of the
least step."""
_OUT, _SWAPPED = 0.02, 1.5
"""Response over that of the other sets from which a set is named, and from which no lamp is steady enough."""
_DARK_CUT = 0.01
"""Part of dark readings that may be 0 beyond those that the camera found explains."""
_DEAD = 0.01
"""Part of the pixels that may be dead before it is said."""
_PEAK = 0.6
"""Part of the brightest signal at which a camera's variance is largest at least: cameras reach it at 0.8 or later, and
charge that is held at a soft full well somewhat before."""
_FLOATS = 9
"""Arrays of the frame's size in double precision that are held for a set; counted."""


@dataclass(frozen=True, eq=False)
class FlatSet:
    """Frames that were taken alike: their list, their place in it, and their statistics."""

    flats: FlatFrames
    listed: DarkSet
    taken: Taken

    def mean_image(self) -> FloatArray:
        """Return the mean (M, N) [DN] of the frames, which are read again."""
        total = 0.0 + sum(
            read_image(self.flats.folder / name, self.flats.wanted).astype(np.float64) for name in self.listed.files
        )
        return np.asarray(total / len(self.listed.files))

    @property
    def name(self) -> str:
        """Return the names of the first and the last file."""
        return f"{self.listed.files[0]} to {self.listed.files[-1]}"


def read_sets(flats: FlatFrames, job: Job) -> list[FlatSet]:
    """Compute the statistics of every set, frame by frame.

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
        are not alike, frames that are there twice, and sets of which none is below saturation.
    """
    where = f"frames {flats.folder}"
    shape = image_size(flats.folder / flats.sets[0].files[0], flats.wanted)
    if min(shape) < _LEAST_SIDE:
        raise MitsimError(f"{where}: {shape[0]} x {shape[1]} pixels; give {_LEAST_SIDE} or more a side")
    Cost(memory_bytes=2 * 8 * _FLOATS * math.prod(shape)).check(where, job.limits)
    job.progress("frames", 0.0)
    with job.clock.stage("frames"):
        taken = read_again(flats, None, shape)
    sets = [FlatSet(flats, *each) for each in zip(flats.sets, taken, strict=True)]
    _check_twice(where, sets)
    _check_light(where, sets)
    _check_noise(where, sets)
    for name, response, _ in _responses(sets, [each.taken for each in sets]):
        if not 1 / _SWAPPED < response < _SWAPPED:
            raise MitsimError(
                f"{where}: {name} are {response:.3g} times as bright as most sets are at their exposures; correct "
                "exposure_s, light or files of the list"
            )
    return sets


def read_again(flats: FlatFrames, places: Places | None, shape: tuple[int, int]) -> list[Taken]:
    """Compute the statistics of every set, with the pixel at ``places`` (M, N) read in place of each pixel.

    Parameters
    ----------
    flats, shape
        what is read, and rows and columns of the frames.
    places
        flat indices; None: each pixel's own.
    """
    return in_threads(lambda each: _read_set(flats, each, places, shape), flats.sets)


def _read_set(flats: FlatFrames, listed: DarkSet, places: Places | None, shape: tuple[int, int]) -> Taken:
    facts = flats.listed
    largest = math.inf if facts.bits is None else 2.0**facts.bits - 1

    def frames() -> Iterator[npt.NDArray[np.generic]]:
        for path in (flats.folder / name for name in listed.files):
            values = read_image(path, flats.wanted)
            if values.shape != shape:
                sizes = " and ".join(f"{m} x {n}" for m, n in (shape, values.shape[:2]))
                raise MitsimError(f"frame {path}: frames have {sizes} pixels; give frames of one size")
            if facts.bits is not None:
                least, most = float(values.min()), float(values.max())
                if least < 0 or most > largest:
                    held = f"{least if least < 0 else most:g}, and numbers of {facts.bits} bits are 0 to {largest:g}"
                    raise MitsimError(f"frame {path}: holds {held}; correct bits")
                if values.dtype.kind == "f" and np.any(values != np.rint(values)):
                    raise MitsimError(f"frame {path}: holds numbers that are not whole; leave bits out")
            yield values if places is None else values.flat[places]

    light = 0.0
    if isinstance(listed, LitSet):
        light = listed.light * listed.exposure_s * (facts.photons_per_s or 1.0)
    return Taken(light, listed.exposure_s, alike(frames(), largest))


def _check_twice(where: str, sets: Sequence[FlatSet]) -> None:
    """Raise MitsimError for frames that are there twice: noise makes no frame again."""
    seen = dict[bytes, str]()
    for each in sets:
        for name, digest in zip(each.listed.files, each.taken.said.digests, strict=True):
            if digest and digest in seen:
                raise MitsimError(
                    f"{where}: {seen[digest]} and {name} are equal in every number: one frame twice, or noise below a "
                    "code; take each frame anew, or at a higher gain"
                )
            seen[digest] = name


def _check_light(where: str, sets: Sequence[FlatSet]) -> None:
    """Raise MitsimError for sets that do not show what the list says."""
    dark = {each.taken.exposure_s: each for each in sets if not each.taken.light}
    lit = [each for each in sets if each.taken.light]
    brightest = max(float(each.taken.said.pair.mean) for each in lit)
    for each in lit:
        said, still = each.taken.said, dark[each.taken.exposure_s].taken.said
        signal = float(said.pair.mean) - float(still.pair.mean)
        if signal <= _SURE * math.hypot(said.mean_error, still.mean_error):
            raise MitsimError(
                f"{where}: {each.name} is no brighter than the dark frames of its exposure; light it, or list it as "
                "dark"
            )
        if said.flicker > _UNEQUAL * signal:
            raise MitsimError(
                f"{where}: {each.name} differ by {100 * said.flicker / signal:.0f} % of their light; take the "
                "frames of a set with one exposure, under a steady lamp"
            )
    for each in dark.values():
        flicker, room = each.taken.said.flicker, max(brightest - float(each.taken.said.pair.mean), 0.0)
        if flicker > _UNEQUAL * room:
            what = f"{each.name} are listed as dark and differ by {flicker:.3g} DN"
            raise MitsimError(f"{where}: {what}; cover the camera, and take them again")
    if part := min(each.taken.said.cut[1] for each in lit):
        what = f"all sets under light hold saturated numbers, {100 * part:.3g} % of them at least"
        raise MitsimError(f"{where}: {what}; expose some for less")


def _responses(sets: Sequence[FlatSet], taken: Sequence[Taken]) -> list[tuple[str, float, str]]:
    """Return the sets whose response to light is not that of the others: name, ratio, and which exposure they fit.

    Logarithms of responses follow a robust line over light, because a camera bends and a lamp drifts smoothly.
    """
    dark = {each.exposure_s: float(each.said.pair.mean) for each in taken if not each.light}
    signals = np.array([float(each.said.pair.mean) - dark[each.exposure_s] for each in taken])
    light = np.array([each.light for each in taken])
    full = np.max(signals, where=np.array([not each.said.cut[1] for each in taken]), initial=0.0)
    used = (light > 0) & (signals > LINEAR[0] * full) & (signals < LINEAR[1] * full)
    used |= (signals >= LINEAR[1] * full) & (light < np.max(light, where=used, initial=0.0) * LINEAR[1])
    if used.sum() < 3:
        return []
    names, light = [each.name for each, use in zip(sets, used, strict=True) if use], light[used]
    response = np.log(signals[used] / light)
    slope = scipy.stats.theilslopes(response, light)[0] if np.ptp(light) else 0.0
    level = float(np.median(response - slope * light))
    off, about = response - level - slope * light, response - np.median(response)
    limit = max(_SURE * 1.4826 * float(np.median(np.abs(off))), _OUT)
    off = np.where(np.abs(about) > math.log(_SWAPPED), about, np.where(np.abs(off) > limit, off, 0.0))
    found = []
    for index in np.flatnonzero(off):
        apart = np.abs(np.log(light / light[index]) - off[index])
        of = int(apart.argmin())
        as_of = f", as if they were of the exposure of {names[of]}"
        found.append((names[index], math.exp(off[index]), as_of if of != index and apart[of] < limit else ""))
    return found


def _comb(taken: Sequence[Taken]) -> tuple[float, float, int]:
    """Return the largest amplitude of a pattern in the codes of lit sets that nothing cuts, its period and the set."""
    dark = min(float(each.said.pair.mean) for each in taken if not each.light)
    full = dark + MOST_FITTED * (float(taken[saturation_of(taken)[0]].said.pair.mean) - dark)
    return max(
        (*each.said.comb, index) if each.said.comb[0] > _SURE / math.sqrt(each.said.count * math.prod(each.said.shape))
        and each.light and not any(each.said.cut) and float(each.said.pair.mean) < full else (0.0, 1.0, index)
        for index, each in enumerate(taken)
    )  # fmt: skip


def _check_noise(where: str, sets: Sequence[FlatSet]) -> None:
    """Raise MitsimError for pictures that were computed from a camera's readings."""
    amplitude, period, _ = _comb([each.taken for each in sets])
    if amplitude > _SCALED:
        raise MitsimError(
            f"{where}: all numbers are {period:.3g} apart, so they were scaled after the ADC, or a bit of it is stuck; "
            f"divide by {period:.3g}, and state the bits that are left of {sets[0].flats.listed.bits}"
        )
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
    """Return what does not fit the camera that was ``found`` in the ``sets``, with its size and its effect."""
    transfer, size = found.transfer, math.prod(sets[0].taken.said.shape)
    used = [
        (each, off, taken.said)
        for each, off, taken in zip(sets, transfer.off, found.maps.taken, strict=True) if np.isfinite(off[0])
    ]  # fmt: skip
    widened = math.sqrt(max(transfer.chi_square / max(transfer.freedom, 1), 1))
    smooth, smoothed = max((max(map(abs, _correlations(said))), each.name) for each, _, said in used)
    amplitude, period, combed = _comb(found.maps.taken)
    bent, curved = max(
        (abs(off[1]) * said.variance_error / max(float(said.pair.variance), LEAST_DARK), each.name)
        for each, off, said in used if abs(off[1]) > _SURE or each is used[0][0]
    )  # fmt: skip
    moved, moving = max(
        (abs(off[0]) * said.mean_error * (abs(off[0]) > _SURE), each.name)
        for each, off, said in used if not each.taken.light
    )  # fmt: skip
    noise = math.sqrt(transfer["read"] ** 2 + max(transfer["spatial"], 0.0) + 1 / 12)
    cut = max(said.cut[0] for each, _, said in used if not each.taken.light)
    zero = scipy.special.ndtr((0.5 - transfer["black"]) / noise)
    dead, filled, uneven = found.sensor.dead_pixels, found.maps.filled, found.maps.uneven
    known = (
        "gain and noise hold; quantum_efficiency, saturation_capacity and linearity are known to that, as their "
        "standard errors say; take the frames again under a steady lamp"
    )
    light = {
        "undecided": "means bend with exposure, and variances do not tell whether the camera bends or the lamp drifts: "
        "linearity, gain, full_well and quantum_efficiency of the camera found have the difference in their standard "
        "errors; take more frames in each set, or measure the lamp at each and list it as light",
        "drifts": "means bend with exposure and variances over means do not, so the lamp drifts or exposures are not "
        f"as listed, by {100 * transfer.lamp:.2g} %; {known}",
    }.get(transfer.light, f"light scatters by {100 * transfer.lamp:.2g} % about what exposures say; {known}")
    off_light = 1.0 if transfer.light in ("undecided", "drifts") else transfer.lamp
    table = [
        (smooth, 0.0, f"noise of neighbouring pixels is correlated by {smooth:.2g} in {smoothed}: frames were "
         "compressed, smoothed, scaled or demosaiced, and gain and noise are of those pictures; give raw frames"),
        (amplitude, _COMB, f"codes are missing or too frequent with a period of {period:.2g} DN, by an amplitude of "
         f"{amplitude:.2g} in {sets[combed].name}: numbers were scaled after the ADC, or a bit of it is stuck; gain, "
         "noise, black level and dsnu_* are of those numbers; give raw frames"),
        *((1.0, 0.0, f"{name} are {ratio:.3g} times as bright as the other sets are at their exposures{as_of}: sets "
           "were exchanged or repeated, or gain or lamp was another one; correct exposure_s, light or files of the "
           "list, or leave the set out") for name, ratio, as_of in _responses(sets, found.maps.taken)),
        (bent, _STRAIGHT, f"variances do not rise with means as those of counted electrons: {curved} is off by "
         f"{100 * bent:.0f} %; a gamma curve, compression or automatic gain does that; standard errors are widened "
         f"by {widened:.2g}"),
        (moved, _STILL, f"dark means do not rise with exposure: {moving} is off by {moved:.2g} DN; the black level or "
         "the temperature drifts, or frames are listed at another exposure; black_level_dn and dark_current_e_per_s "
         f"are not to be trusted, standard errors are widened by {widened:.2g}"),
        (cut - 1.1 * zero, _DARK_CUT, f"{100 * cut:.2g} % of dark readings are 0 DN, and {100 * zero:.2g} % would be "
         "if pixels differed by a normal law: some have a black level below 0, which moves black_level_dn, "
         "read_noise_e and dsnu_*; raise the black level of the camera"),
        (filled, 0.0, f"{round(filled * size)} hot pixels ({100 * filled:.2g} %) are full in the longest dark frames: "
         "the figures of EMVA 1288 have them; in the camera found they count as hot_pixels, with at least "
         "hot_dark_current_e_per_s, or as dead_pixels if full at every exposure, and are in no other number"),
        (dead, _DEAD, f"{100 * dead:.2g} % of the pixels show less than half of the light of most: dead columns, dust, "
         "or light that does not fill the frame; the camera found counts them as dead_pixels"),
        (off_light, _STEADY, light),
        (uneven, _EVEN, f"light differs by {100 * uneven:.0f} % over the frame, and EMVA 1288 allows "
         f"{100 * _EVEN:.0f} %: the figures prnu_* hold it; in the camera found a surface of second degree is taken "
         "off"),
    ]  # fmt: skip
    return tuple(line for value, limit, line in table if value > limit)


def _correlations(said: Alike) -> tuple[float, float]:
    """Return the correlations of neighbours' noise beyond chance and charge between pixels; else 0."""
    limit = _WHITE + _SURE / math.sqrt(math.prod(said.shape))
    along, across = said.neighbours
    return (along if abs(along) > limit else 0.0), (across if abs(across) > limit else 0.0)

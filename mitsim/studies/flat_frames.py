"""A real camera's flat and dark frames: their statistics, and tests whether a camera can have taken them."""

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
from mitsim.sensor.camera_fit import FoundCamera, Places, saturation_of
from mitsim.sensor.emva import LEAST_DARK, LINEAR, MOST_FITTED, Alike, alike

_LEAST_SIDE = 16
_SURE = 6.0
"""Standard errors from which a difference is not chance, among thousands of comparisons."""
_UNEQUAL = 0.1
"""Standard deviation of the light in a set from which the lamp was off or the exposure was different."""
_WHITE = 0.02
"""Correlation of neighbours' noise that charge between pixels may cause."""
_OUT, _SWAPPED = 0.02, 1.5
"""Response relative to the other sets from which a set is reported, and from which frames are refused."""
_MIXED, _SCALED, _PEAK = 0.1, 0.99, 0.6
"""Limits of refusals: correlation of neighbours' noise, amplitude of a pattern in the codes, and the least fraction of
the brightest signal with the largest variance.
"""
_COMB, _EVEN, _STEADY, _STRAIGHT, _STILL, _DARK_CUT, _DEAD = 0.05, 0.03, 0.01, 0.05, 0.1, 0.01, 0.01
"""Limits of remarks: pattern in the codes, unevenness (EMVA 1288 4.0), scatter of the light, misfits of a variance and
of a dark mean [DN], unexplained dark readings at 0, and dead pixels.
"""
_FLOATS = 9
"""Arrays of the frame's size in double precision that a set needs."""


@dataclass(frozen=True, eq=False)
class FlatSet:
    flats: FlatFrames
    listed: DarkSet
    taken: Alike

    def mean_image(self) -> FloatArray:
        total = 0.0 + sum(
            read_image(self.flats.folder / name, self.flats.wanted).astype(np.float64) for name in self.listed.files
        )
        return np.asarray(total / len(self.listed.files))

    @property
    def name(self) -> str:
        return f"{self.listed.files[0]} to {self.listed.files[-1]}"


def read_sets(flats: FlatFrames, job: Job) -> list[FlatSet]:
    """Compute the statistics of every set; MitsimError if the frames show nothing of the camera."""
    where = f"frames {flats.folder}"
    shape = image_size(flats.folder / flats.sets[0].files[0], flats.wanted)
    if min(shape) < _LEAST_SIDE:
        raise MitsimError(f"{where}: {shape[0]} x {shape[1]} pixels; give {_LEAST_SIDE} or more a side")
    Cost(memory_bytes=2 * 8 * _FLOATS * math.prod(shape)).check(where, job.limits)
    job.progress("frames", 0.0)
    with job.clock.stage("frames"):
        taken = read_again(flats, None, shape)
    sets = [FlatSet(flats, *each) for each in zip(flats.sets, taken, strict=True)]
    for fault in _faults(sets):
        raise MitsimError(f"{where}: {fault}")
    return sets


def read_again(flats: FlatFrames, places: Places | None, shape: tuple[int, int]) -> list[Alike]:
    """Compute the statistics of every set, with the pixel at `places` (M, N) read in place of each pixel."""
    bits = flats.listed.bits
    largest = math.inf if bits is None else 2.0**bits - 1

    def frames(listed: DarkSet) -> Iterator[npt.NDArray[np.generic]]:
        for path in (flats.folder / name for name in listed.files):
            values = read_image(path, flats.wanted)
            if values.shape != shape:
                sizes = " and ".join(f"{m} x {n}" for m, n in (shape, values.shape[:2]))
                raise MitsimError(f"frame {path}: frames have {sizes} pixels; give frames of one size")
            least, most = float(values.min()), float(values.max())
            if bits is not None and (least < 0 or most > largest):
                held = f"{least if least < 0 else most:g}, and numbers of {bits} bits are 0 to {largest:g}"
                raise MitsimError(f"frame {path}: holds {held}; correct bits")
            if bits is not None and values.dtype.kind == "f" and np.any(values != np.rint(values)):
                raise MitsimError(f"frame {path}: holds numbers that are not whole; leave bits out")
            yield values if places is None else values.flat[places]

    def taken(listed: DarkSet) -> Alike:
        power = listed.light if isinstance(listed, LitSet) else 0.0
        light = power * listed.exposure_s * (flats.listed.photons_per_s or 1.0)
        return alike(frames(listed), largest, light, listed.exposure_s)

    return in_threads(taken, flats.sets)


def _faults(sets: Sequence[FlatSet]) -> Iterator[str]:
    """Yield reasons why the frames show nothing of the camera."""
    taken, seen = [each.taken for each in sets], dict[bytes, str]()
    for each in sets:
        for name, digest in zip(each.listed.files, each.taken.digests, strict=True):
            if digest and digest in seen:
                yield (
                    f"{seen[digest]} and {name} are equal in every number: one frame twice, or noise below a code; "
                    "take each frame anew, or at a higher gain"
                )
            seen[digest] = name
    dark = {each.exposure_s: each for each in taken if not each.light}
    brightest = max(each.mean for each in taken if each.light)
    for each in sets:
        said, still = each.taken, dark[each.taken.exposure_s]
        signal = said.mean - still.mean
        if said.light and signal <= _SURE * math.hypot(said.mean_error, still.mean_error):
            yield f"{each.name} is no brighter than the dark frames of its exposure; light it, or list it as dark"
        if said.light and said.flicker > _UNEQUAL * signal:
            what = f"{each.name} differ by {100 * said.flicker / signal:.0f} % of their light"
            yield f"{what}; take the frames of a set with one exposure, under a steady lamp"
        if not said.light and said.flicker > _UNEQUAL * max(brightest - said.mean, 0.0):
            what = f"{each.name} are listed as dark and differ by {said.flicker:.3g} DN"
            yield f"{what}; cover the camera, and take them again"
    if full := 100 * min(each.cut[1] for each in taken if each.light):
        yield f"all sets under light hold saturated numbers, {full:.3g} % of them at least; expose some for less"
    yield from (text for _, refused, text in _altered(sets, taken, taken) if refused)


def _altered(sets: Sequence[FlatSet], taken: Sequence[Alike], used: Sequence[Alike]) -> list[tuple[bool, bool, str]]:
    """Return signs that numbers were altered or sets exchanged: seen, refused, and the text."""
    amplitude, period, combed = _comb(taken)
    noises, means = [_correlation(each) for each in used], [each.mean for each in taken]
    smooth, smoothed = max(noises), sets[[*taken].index(used[int(np.argmax(noises))])].name
    part = (means[saturation_of(taken)[0]] - min(means)) / (max(means) - min(means))
    return [
        (amplitude > _COMB, amplitude > _SCALED, f"codes are missing or too frequent with a period of {period:.2g} DN, "
         f"by an amplitude of {amplitude:.2g} in {sets[combed].name}: numbers were scaled after the ADC, or a bit of "
         "it is stuck; gain, noise, black level and dsnu_* are of those numbers; give raw frames, or divide by the "
         "period and state fewer bits"),
        (smooth > 0, float(np.median(noises)) > _MIXED, f"noise of neighbouring pixels is correlated by {smooth:.2g} "
         f"in {smoothed}, so frames were compressed, smoothed, scaled or demosaiced, and gain and noise are of those "
         "pictures; give raw frames"),
        (part < _PEAK, part < _PEAK, f"the variance is largest at {100 * part:.0f} % of the brightest signal, not near "
         "it, as after a gamma curve, compression or too coarse codes; give raw frames of more bits, or of a higher "
         "gain"),
        *((True, not 1 / _SWAPPED < ratio < _SWAPPED, f"{name} are {ratio:.3g} times as bright as the other sets are "
           f"at their exposures{as_of}; correct exposure_s, light or files of the list, or leave the set out")
          for name, ratio, as_of in _responses(sets, taken)),
    ]  # fmt: skip


def _responses(sets: Sequence[FlatSet], taken: Sequence[Alike]) -> list[tuple[str, float, str]]:
    """Return the sets whose response to light differs from the others: name, ratio, and the exposure that they fit.

    Logarithms of responses follow a robust line over light, because a camera bends and a lamp drifts smoothly.
    """
    dark = {each.exposure_s: each.mean for each in taken if not each.light}
    signals = np.array([each.mean - dark[each.exposure_s] for each in taken])
    light = np.array([each.light for each in taken])
    full = np.max(signals, where=np.array([not each.cut[1] for each in taken]), initial=0.0)
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


def _comb(taken: Sequence[Alike]) -> tuple[float, float, int]:
    """Return the largest amplitude of a pattern in the codes of lit sets that nothing cuts, its period and the set."""
    dark = min(each.mean for each in taken if not each.light)
    full = dark + MOST_FITTED * (taken[saturation_of(taken)[0]].mean - dark)
    found = [
        (*each.comb, index) for index, each in enumerate(taken)
        if each.comb[0] > _SURE / math.sqrt(each.count * math.prod(each.shape))
        and each.light and not any(each.cut) and each.mean < full
    ]  # fmt: skip
    return max(found, default=(0.0, 1.0, 0))


def _correlation(said: Alike) -> float:
    """Return the largest correlation of neighbours' noise beyond chance and charge between pixels; otherwise 0."""
    largest = max(map(abs, said.neighbours))
    return largest if largest > _WHITE + _SURE / math.sqrt(math.prod(said.shape)) else 0.0


def remarks(sets: Sequence[FlatSet], found: FoundCamera) -> tuple[str, ...]:
    """Return what does not fit the camera that was found in the sets, with its size and its effect."""
    transfer, size = found.transfer, math.prod(sets[0].taken.shape)
    used = [
        (each.name, abs(off), taken)
        for each, off, taken in zip(sets, transfer.off, found.pixels.taken, strict=True) if np.isfinite(off[0])
    ]  # fmt: skip
    darks = [each for each in used if not each[2].light]
    bent, curved = max(
        (off[1] * said.variance_error / max(said.variance, LEAST_DARK), name)
        for name, off, said in used if off[1] > _SURE or name is used[0][0]
    )  # fmt: skip
    moved, moving = max((off[0] * said.mean_error * (off[0] > _SURE), name) for name, off, said in darks)
    noise = math.sqrt(transfer["read"] ** 2 + max(transfer["spatial"], 0.0) + 1 / 12)
    cut, zero = max(said.cut[0] for *_, said in darks), scipy.special.ndtr((0.5 - transfer["black"]) / noise)
    dead, filled, uneven, lamp = found.sensor.dead_pixels, found.pixels.filled, found.pixels.uneven, 100 * transfer.lamp
    widened = f"standard errors are widened by {math.sqrt(max(transfer.chi_square / max(transfer.freedom, 1), 1)):.2g}"
    known = (
        "gain and noise hold; quantum_efficiency, saturation_capacity and linearity are known to that, as their "
        "standard errors say; take the frames again under a steady lamp"
    )
    light = {
        "undecided": "means bend with exposure, and variances do not tell whether the camera bends or the lamp drifts: "
        "the standard errors of linearity, gain, full_well and quantum_efficiency include the difference; take more "
        "frames in each set, or list the lamp's measured light",
        "drifts": "means bend with exposure and variances over means do not, so the lamp drifts or exposures are not "
        f"as listed, by {lamp:.2g} %; {known}",
    }.get(transfer.light, f"light scatters by {lamp:.2g} % about what exposures say; {known}")
    table = [
        *((seen, text) for seen, _, text in _altered(sets, found.pixels.taken, [said for *_, said in used])),
        (bent > _STRAIGHT, f"variances do not rise with means as those of counted electrons: {curved} is off by "
         f"{100 * bent:.0f} %; a gamma curve, compression or automatic gain does that; {widened}"),
        (moved > _STILL, f"dark means do not rise with exposure: {moving} is off by {moved:.2g} DN; black level or "
         "temperature drifts, or exposures are listed wrongly; do not trust black_level_dn and dark_current_e_per_s; "
         f"{widened}"),
        (cut - 1.1 * zero > _DARK_CUT, f"{100 * cut:.2g} % of dark readings are 0 DN, and a normal law of pixels "
         f"explains {100 * zero:.2g} %: some black levels are below 0, which moves black_level_dn, read_noise_e and "
         "dsnu_*; raise the black level of the camera"),
        (filled > 0, f"{round(filled * size)} hot pixels ({100 * filled:.2g} %) are full in the longest dark frames: "
         "the figures of EMVA 1288 include them; the camera found counts them as hot_pixels, or as dead_pixels if full "
         "at every exposure, and its hot_dark_current_e_per_s is a lower limit"),
        (dead > _DEAD, f"{100 * dead:.2g} % of the pixels show less than half of the light of most: dead columns, "
         "dust, or light that does not fill the frame; the camera found counts them as dead_pixels"),
        (transfer.light in ("undecided", "drifts") or transfer.lamp > _STEADY, light),
        (uneven > _EVEN, f"light differs by {100 * uneven:.0f} % over the frame, and EMVA 1288 allows "
         f"{100 * _EVEN:.0f} %: the figures prnu_* include it; the camera found is without a surface of second degree"),
    ]  # fmt: skip
    return tuple(text for said, text in table if said)

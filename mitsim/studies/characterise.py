"""Characterise a camera by EMVA 1288 release 4.0: figures, the fitted camera, a page and plots.

Frames are simulated, or come from a real camera. The fitted camera's fields have standard errors; for simulated frames
they are compared with the camera file.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy
from matplotlib.figure import Figure

from mitsim.bench.request import Procedure
from mitsim.core.arrays import FloatArray
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError
from mitsim.core.files import write_json, write_text
from mitsim.core.headline import headline
from mitsim.core.images import image_pages, read_image
from mitsim.core.job import Cost, Job
from mitsim.core.parallel import in_threads
from mitsim.core.seeds import stream
from mitsim.devices.framelist import DarkSet, FlatFrames, LitSet, capacity_of
from mitsim.devices.sensor import EXPOSURE_S, SensorModel
from mitsim.report.pages import Mean, page_figure, round_to_error, typeset
from mitsim.report.plots import curves
from mitsim.sensor.camera_fit import FoundCamera, Pixels, Places, nonuniform, saturation_of
from mitsim.sensor.chain import dark_current_variance, expose, mean_dark_current, response_variance
from mitsim.sensor.emva import LEAST_DARK, LINE, LINEAR, MOST_FITTED, SPLIT, Alike, Session, alike, figures
from mitsim.studies.framework.campaign import study_folder, write_figures
from mitsim.studies.framework.panels import Part, Section, write_page

CAMERA_FILE = "camera.toml"
MOST_OFF = 5.0
"""Standard errors from which a field of the camera found is reported as off."""

# -------- Simulated frames

_TO = 1.15
_DARK_STEPS = 6
_DARK_FILL, _DARK_ELECTRONS = 0.4, 2000.0
"""Dark electrons at the longest exposure: a fraction of saturation, or enough for a permille."""
_LONGEST_S = 10.0
_FILLED_BY_DARK = 0.01


class Frames:
    """Frames of a simulated camera in S sets with equal settings; `dark` and `bright` are stacks.

    ``light`` and ``electrons`` (S,) are photons and photoelectrons of a pixel; 0 in the dark. MitsimError if no light
    saturates the camera.
    """

    def __init__(self, sensor: SensorModel, procedure: Procedure) -> None:
        self.sensor, self.shape, self.seed = sensor, (procedure.pixels, procedure.pixels), procedure.seed
        capacity, steps = capacity_of(sensor), procedure.steps
        hottest = sensor.dark_current_e_per_s + sensor.hot_dark_current_e_per_s
        hottest = sensor.binning**2 * sensor.dark_factor * hottest
        longest, exposure_s = _LONGEST_S, math.inf
        if hottest:
            longest = min(_DARK_FILL * capacity / hottest, _DARK_ELECTRONS / mean_dark_current(sensor))
            exposure_s = _FILLED_BY_DARK * capacity / hottest
        longest = min(max(longest, EXPOSURE_S[0] * _DARK_STEPS), EXPOSURE_S[1])
        times = longest * np.arange(_DARK_STEPS) / (_DARK_STEPS - 1)
        ladder, beyond = capacity * _TO * np.arange(1, steps + 1) / steps, 2 * capacity + 20 * math.sqrt(capacity)
        self.electrons = np.concatenate([ladder, [beyond, capacity / 2, 0.0], np.zeros(_DARK_STEPS)])
        self.light = self.electrons / procedure.efficiency(sensor)
        self.exposure_s = np.concatenate([np.full(steps + 3, min(0.01, exposure_s)), times])
        self.counts, self.bright, self.dark = np.full(len(self.electrons), 2), steps + 1, steps + 2
        self.counts[[self.bright, self.dark]] = procedure.frames

    def images(self, index: int, places: Places | None = None) -> Iterator[FloatArray]:
        """Yield the frames of a set, with the pixel at `places` (M, N) in place of each pixel."""
        for number in range(self.counts[index]):
            shot, read = (stream(self.seed, "characterise", noise, index, number) for noise in ("shot", "read"))
            light = np.full(self.shape, self.electrons[index])
            image = np.asarray(expose(light, float(self.exposure_s[index]), self.sensor, shot, read), dtype=np.float64)
            yield image if places is None else image.flat[places]

    def take(self, job: Job, places: Places | None = None) -> list[Alike]:
        largest = math.inf if self.sensor.largest_dn is None else float(self.sensor.largest_dn)

        def taken(index: int) -> Alike:
            return alike(self.images(index, places), largest, float(self.light[index]), float(self.exposure_s[index]))

        job.progress("frames", 0.0)
        with job.clock.stage("frames"):
            return in_threads(taken, range(len(self.light)))

    def figures_set(self) -> dict[str, float]:
        """Return the figures of the camera file; variances where :func:`mitsim.sensor.emva.figures` has them."""
        sensor, brightest, current = self.sensor, int(self.light.argmax()), mean_dark_current(self.sensor)
        alive, exposure_s = 1 - sensor.dead_pixels, float(self.exposure_s[self.dark])
        pixel, row, column = np.square(sensor.offset_parts)
        offsets = row, column, pixel + dark_current_variance(sensor) * exposure_s**2
        _, row, column = np.square(sensor.response_parts)
        responses = np.array([row, column, response_variance(sensor) - row - column]) / alive**2
        return {
            "system_gain": sensor.gain_dn_per_e,
            "quantum_efficiency": float(self.electrons[brightest]) / float(self.light[brightest]) * alive,
            "dark_noise": math.sqrt(sensor.superpixel_reading_noise_e**2 + current * exposure_s),
            "row_noise": sensor.superpixel_row_noise_e**2,
            "saturation_capacity": capacity_of(sensor),
            "full_well": (capacity_of(sensor) - current * float(self.exposure_s[brightest])) * alive,
            **dict.fromkeys(("linearity_min", "linearity_max"), 0.0),
            **dict.fromkeys(("dark_current", "dark_current_by_variance"), current),
            **{f"dsnu_{part}": float(each) for part, each in zip(SPLIT, (sum(offsets), *offsets), strict=True)},
            **{f"prnu_{part}": float(each) for part, each in zip(SPLIT, (responses.sum(), *responses), strict=True)},
        }


def session_of(taken: Sequence[Alike], dark: int, bright: int, saturates: bool, rounded: bool) -> Session:
    names, stacks = ("light", "exposure_s", "mean", "variance", "rows"), (taken[dark].stack, taken[bright].stack)
    light, time, *pairs = (np.array([getattr(each, name) for each in taken]) for name in names)
    return Session(taken[0].shape, light, time, pairs[0], pairs[1], pairs[2], dark, bright, *stacks, saturates, rounded)


# -------- A real camera's frames

_LEAST_SIDE = 16
_SURE = 6.0
_UNEQUAL = 0.1
_WHITE = 0.02
"""Correlation of neighbours' noise that charge between pixels may cause."""
_OUT, _SWAPPED = 0.02, 1.5
"""Relative response from which a set is reported, and from which frames are refused."""
_MIXED, _SCALED, _PEAK = 0.1, 0.99, 0.6
"""Limits of refusals: neighbours' correlation, a pattern in the codes, and the brightest signal's least fraction."""
_COMB, _EVEN, _STEADY, _STRAIGHT, _STILL, _DARK_CUT, _DEAD = 0.05, 0.03, 0.01, 0.05, 0.1, 0.01, 0.01
"""Limits of remarks, among them unevenness (EMVA 1288 4.0), misfits of a variance and of a dark mean [DN]."""
_FLOATS = 9


def read_sets(flats: FlatFrames, shape: tuple[int, int], places: Places | None = None) -> list[Alike]:
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


def _names(flats: FlatFrames) -> list[str]:
    return [f"{listed.files[0]} to {listed.files[-1]}" for listed in flats.sets]


def _faults(flats: FlatFrames, taken: Sequence[Alike]) -> Iterator[str]:
    seen = dict[bytes, str]()
    for listed, each in zip(flats.sets, taken, strict=True):
        for name, digest in zip(listed.files, each.digests, strict=True):
            if digest and digest in seen:
                yield f"{seen[digest]} and {name} are equal in every number; take each frame anew, or at a higher gain"
            seen[digest] = name
    dark, lit = {each.exposure_s: each for each in taken if not each.light}, [each for each in taken if each.light]
    brightest = max(each.mean for each in lit)
    for name, said in zip(_names(flats), taken, strict=True):
        still = dark[said.exposure_s]
        signal = said.mean - still.mean
        if said.light and signal <= _SURE * math.hypot(said.mean_error, still.mean_error):
            yield f"{name} is no brighter than the dark frames of its exposure; light it, or list it as dark"
        most = signal if said.light else max(brightest - said.mean, 0.0)
        if said.flicker > _UNEQUAL * most:
            yield (
                f"{name} differ by {said.flicker:.3g} DN, {100 * said.flicker / max(most, 1e-9):.0f} % of their light; "
                "take the frames of a set with one exposure under a steady lamp, and dark ones with the camera covered"
            )
    if full := 100 * min(each.cut[1] for each in lit):
        yield f"all sets under light hold saturated numbers, {full:.3g} % of them at least; expose some for less"
    yield from (text for _, refused, text in _altered(flats, taken, taken) if refused)


def _altered(flats: FlatFrames, taken: Sequence[Alike], used: Sequence[Alike]) -> list[tuple[bool, bool, str]]:
    """Return what was done to the numbers after the ADC: whether to report it, whether to refuse it, and in words."""
    names, means = _names(flats), [each.mean for each in taken]
    peak, dark = means[saturation_of(taken)[0]], min(each.mean for each in taken if not each.light)
    combs = [
        (*each.comb, name) for name, each in zip(names, taken, strict=True)
        if each.comb[0] > _SURE / math.sqrt(each.count * math.prod(each.shape))
        and each.light and not any(each.cut) and each.mean < dark + MOST_FITTED * (peak - dark)
    ]  # fmt: skip
    amplitude, period, combed = max(combs, default=(0.0, 1.0, ""))
    # A correlation of neighbours' noise counts beyond chance and charge between pixels.
    noises = [max(map(abs, each.neighbours)) for each in used]
    least = [_WHITE + _SURE / math.sqrt(math.prod(each.shape)) for each in used]
    noises = [noise if noise > chance else 0.0 for noise, chance in zip(noises, least, strict=True)]
    smooth, smoothed = max(noises), names[[*taken].index(used[int(np.argmax(noises))])]
    part = (peak - min(means)) / (max(means) - min(means))
    found = [
        (amplitude > _COMB, amplitude > _SCALED, f"codes are missing or too frequent in {combed} with a period of "
         f"{period:.2g} DN, so numbers were scaled after the ADC or a bit is stuck; give raw frames"),
        (smooth > 0, float(np.median(noises)) > _MIXED, f"noise of neighbouring pixels is correlated by {smooth:.2g} "
         f"in {smoothed}, so frames were compressed, smoothed, scaled or demosaiced; give raw frames"),
        (part < _PEAK, part < _PEAK, f"the variance is largest at {100 * part:.0f} % of the brightest signal, as after "
         "a gamma curve, compression or too coarse codes; give raw frames of more bits, or of a higher gain"),
    ]  # fmt: skip

    # The logarithm of the response follows a robust line over light; sets beside it have other light than listed.
    darks = {each.exposure_s: each.mean for each in taken if not each.light}
    signals = np.array([each.mean - darks[each.exposure_s] for each in taken])
    light = np.array([each.light for each in taken])
    full = np.max(signals, where=np.array([not each.cut[1] for each in taken]), initial=0.0)
    fitted = (light > 0) & (signals > LINEAR[0] * full) & (signals < LINEAR[1] * full)
    fitted |= (signals >= LINEAR[1] * full) & (light < np.max(light, where=fitted, initial=0.0) * LINEAR[1])
    if fitted.sum() < LINE:
        return found
    response = np.log(signals[fitted] / light[fitted])
    slope = scipy.stats.theilslopes(response, light[fitted])[0] if np.ptp(light[fitted]) else 0.0
    off, about = response - slope * light[fitted], response - np.median(response)
    off -= float(np.median(off))
    limit = max(_SURE * 1.4826 * float(np.median(np.abs(off))), _OUT)
    off = np.where(np.abs(about) > math.log(_SWAPPED), about, np.where(np.abs(off) > limit, off, 0.0))
    for name, ratio in zip(np.array(names)[fitted][off != 0], np.exp(off[off != 0]), strict=True):
        text = f"{name} are {ratio:.3g} times as bright as the other sets are at their exposures; correct the list"
        found.append((True, not 1 / _SWAPPED < ratio < _SWAPPED, text))
    return found


def remarks(flats: FlatFrames, found: FoundCamera) -> tuple[str, ...]:
    """Return findings about the frames of a real camera, each with the numbers that it makes doubtful."""
    transfer, pixels = found.transfer, found.pixels
    used = [
        (name, abs(off), taken)
        for name, off, taken in zip(_names(flats), transfer.off, pixels.taken, strict=True) if np.isfinite(off[0])
    ]  # fmt: skip
    darks = [each for each in used if not each[2].light]
    bent, curved = max(
        (off[1] * said.variance_error / max(said.variance, LEAST_DARK), name)
        for name, off, said in used if off[1] > _SURE or name is used[0][0]
    )  # fmt: skip
    moved, moving = max((off[0] * said.mean_error * (off[0] > _SURE), name) for name, off, said in darks)
    noise = math.sqrt(transfer["read"] ** 2 + max(transfer["spatial"], 0.0) + 1 / 12)
    cut, zero = max(said.cut[0] for *_, said in darks), scipy.special.ndtr((0.5 - transfer["black"]) / noise)
    dead, lamp, hot = found.sensor.dead_pixels, 100 * transfer.lamp, round(pixels.filled * math.prod(pixels.shape))
    light = {
        "undecided": ("means bend with exposure, and variances do not show whether by the camera or by the lamp"),
        "drifts": f"means bend with exposure and variances do not, so the lamp drifts by {lamp:.2g} %",
    }.get(transfer.light, f"light scatters by {lamp:.2g} % about the values that exposures predict")
    table = [
        *((seen, text) for seen, _, text in _altered(flats, pixels.taken, [said for *_, said in used])),
        (bent > _STRAIGHT, f"variances do not rise with means as those of counted electrons: {curved} is off by "
         f"{100 * bent:.0f} %; a gamma curve, compression or automatic gain does that"),
        (moved > _STILL, f"dark means do not rise with exposure: {moving} is off by {moved:.2g} DN; do not trust "
         "black_level_dn and dark_current_e_per_s"),
        (cut - 1.1 * zero > _DARK_CUT, f"{100 * cut:.2g} % of dark readings are 0 DN, more than noise explains; raise "
         "the black level, and do not trust black_level_dn, read_noise_e and dsnu_*"),
        (pixels.filled > 0, f"{hot} hot pixels ({100 * pixels.filled:.2g} %) are full in the longest dark frames; "
         "hot_dark_current_e_per_s is a lower limit"),
        (dead > _DEAD, f"{100 * dead:.2g} % of the pixels show less than half of the light of most; the camera found "
         "counts them as dead_pixels"),
        (transfer.light in ("undecided", "drifts") or transfer.lamp > _STEADY, f"{light}; standard errors of "
         "quantum_efficiency and linearity include it; take the frames again under a steady lamp"),
        (pixels.uneven > _EVEN, f"light differs by {100 * pixels.uneven:.0f} % over the frame, and EMVA 1288 allows "
         f"{100 * _EVEN:.0f} %; the figures prnu_* include it"),
    ]  # fmt: skip
    return tuple(text for said, text in table if said)


# -------- Figures and fields

FIGURES: Mapping[str, tuple[str, str]] = {
    "system_gain": ("K", "DN/e-"),
    "quantum_efficiency": ("eta", "e-/photon"),
    "dark_noise": ("sigma_d", "e-"),
    "row_noise": ("sigma_row", "e-"),
    "saturation_capacity": ("mu_e.sat", "e-"),
    "full_well": ("F", "e-"),
    "linearity_min": ("LE_min", "%"),
    "linearity_max": ("LE_max", "%"),
    "dark_current": ("mu_I.mean", "e-/s"),
    "dark_current_by_variance": ("mu_I.var", "e-/s"),
    **{f"dsnu_{part}": (f"DSNU1288.{part}", "e-") for part in SPLIT},
    **{f"prnu_{part}": (f"PRNU1288.{part}", "%") for part in SPLIT},
}
_VARIANCES = "dsnu", "prnu", "row_noise"
_UNITS = {
    "gain_dn_per_e": "DN/e-", "quantum_efficiency": "e-/photon", "e_per_s": "e-/s", "_dn": "DN", "_e": "e-", "": "1"
}  # fmt: skip
"""Unit of a field of a camera file by its first matching ending."""


@dataclass(frozen=True)
class Row:
    """A figure, or a fitted field with its standard error; `set` is None for a real camera's frames."""

    name: str
    symbol: str
    unit: str
    set: float | None
    found: float
    standard_error: float | None = None
    deviations: float | None = None


def figure_rows(found: Mapping[str, FloatArray], given: Mapping[str, float], efficient: bool) -> tuple[Row, ...]:
    """Return the figures in their units; without a quantum efficiency light is counted in electrons."""
    rows = []
    for name, (symbol, unit) in FIGURES.items():
        if name not in found or (name == "quantum_efficiency" and not efficient):
            continue
        values = [float(found[name]), given.get(name, math.nan)]
        if name.startswith(_VARIANCES):
            values = [math.copysign(math.sqrt(abs(value)), value) for value in values]
        value, set_value = (each * (100.0 if unit == "%" else 1.0) for each in values)
        rows.append(Row(name, symbol, unit, None if math.isnan(set_value) else set_value, value))
    return tuple(rows)


def fields_set(model: SensorModel) -> dict[str, float | None]:
    offsets, responses = (np.roll(parts, -1).tolist() for parts in (model.offset_parts, model.response_parts))
    defects = ("hot_pixels", "hot_dark_current_e_per_s", "dead_pixels")
    return {
        "gain_dn_per_e": model.gain_dn_per_e,
        "quantum_efficiency": model.quantum_efficiency,
        "read_noise_e": model.superpixel_read_noise_e,
        "row_noise_e": model.superpixel_row_noise_e,
        "black_level_dn": model.superpixel_black_level_dn,
        "full_well_e": capacity_of(model),
        "dark_current_e_per_s": model.superpixel_dark_current_e_per_s,
        "dark_current_spread_e_per_s": model.binning * model.dark_factor * model.dark_current_spread_e_per_s,
        **{f"dsnu_{part}_e": each for part, each in zip(SPLIT[1:], offsets, strict=True)},
        **{f"prnu_{part}": each for part, each in zip(SPLIT[1:], responses, strict=True)},
        **{name: getattr(model, name) if model.binning == 1 else None for name in defects},
        **dict(zip(("linearity.0", "linearity.1"), (*model.linearity, 0.0, 0.0), strict=False)),
    }


def field_rows(found: FoundCamera, model: SensorModel | None) -> tuple[Row, ...]:
    """Return the fields of the camera found, compared with those of the simulated ``model``."""
    rows, transfer, given = [], found.transfer, {} if model is None else fields_set(model)
    values = {**fields_set(found.sensor), "full_well_e": found.sensor.full_well_e}
    errors = dict(found.errors)
    if found.sensor.linearity:
        errors |= {"linearity.0": transfer.error("bend"), "linearity.1": transfer.error("bend_2")}
    for name, value in values.items():
        if value is not None and math.isfinite(value) and name in errors:
            error, set_value = errors.get(name, 0.0), given.get(name)
            off = None if set_value is None or not error else (value - set_value) / error
            unit = next(unit for end, unit in _UNITS.items() if name.endswith(end))
            rows.append(Row(name, "", unit, set_value, value, error, off))
    return tuple(rows)


# -------- Results


@dataclass(frozen=True, eq=False)
class Characterisation:
    """A camera's figures (`rows`) and the fields of the camera that explains its frames (`fields`)."""

    camera: str
    session: Session = field(repr=False)
    rows: tuple[Row, ...]
    found: FoundCamera
    fields: tuple[Row, ...]
    asked: Mapping[str, Any]
    real: bool = False
    about: tuple[str, ...] = ()
    output: str | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        off = [row for row in self.fields if row.deviations is not None and abs(row.deviations) > MOST_OFF]
        return *self.about, *(
            f"{row.name} of the camera found: {row.found:.5g} {row.unit}, {abs(row.deviations or 0):.1f} standard "
            f"errors off {row.set:.5g}, which is set"
            for row in off
        )

    def payload(self) -> dict[str, Any]:
        transfer = self.found.transfer
        fields = [asdict(row) for row in self.fields]
        return {
            "headline": self.headline,
            "camera": self.camera,
            **self.asked,
            "exposure_s": float(self.session.exposure_s[self.session.dark]),
            # Figures have no standard errors; the keys are kept for readers of version 0.12.
            "figures": [{**asdict(row), "expected": None, "bias": None} for row in self.rows],
            "camera_found": [{name: row[name] for name in row if name != "symbol"} for row in fields],
            "light": {
                "uneven": self.found.pixels.uneven, "scatter": transfer.lamp, "drifts": transfer.light == "drifts",
                "seen": transfer.light, "chi_square": transfer.chi_square, "freedom": transfer.freedom,
            },
            "notes": list(self.found.notes),
            "warnings": list(self.warnings),
            "output": self.output,
        }  # fmt: skip

    @property
    def headline(self) -> str:
        named = {"gain_dn_per_e": "gain", "read_noise_e": "read noise", "full_well_e": "full well"}
        rows = {named[row.name]: row for row in self.fields if row.name in named}
        found = (f"{name} {row.found:{'.4g' if row.found < 1e4 else '.0f'}} {row.unit}" for name, row in rows.items())
        return headline(f"Characterised {self.camera}: {', '.join(found)}", self.warnings)

    @property
    def where(self) -> str:
        (m, n), lit, unlit = self.session.shape, len(self.session.lit), len(self.session.unlit)
        return f"{m} x {n} pixels, {lit} sets of frames under light, {unlit} in the dark"

    @property
    def parts(self) -> tuple[Part, Part]:
        def text(value: float | None, error: float | None = None) -> str:
            return "" if value is None else round_to_error(value, error or math.nan)

        def table(head: str, rows: Iterable[tuple[str, ...]]) -> tuple[Any, Any]:
            # Of a real camera nothing is set, so that columns are empty.
            kept = [column for column in zip(head.split("|"), *rows, strict=True) if any(column[1:])]
            heads, *lines = zip(*kept, strict=True)
            return heads, tuple(lines)

        figures = ((row.name, row.symbol, row.unit, text(row.set), text(row.found)) for row in self.rows)
        fields = (
            (row.name, row.unit, text(row.set), text(row.found, row.standard_error),
             text(row.standard_error, row.standard_error), text(row.deviations, 1.0))
            for row in self.fields
        )  # fmt: skip
        plots = "photon_transfer.png", "linearity.png", "dark_current.png"
        lead = "Numbers that the standard's procedure finds in the frames."
        found = table("camera found|unit|set|found|std error|off by", fields)
        return (
            Part("Results of EMVA 1288", lead, *table("figure|symbol|unit|set|found", figures), plots),
            Part("Fitted camera", "Fields of camera.toml, which --camera reads.", *found, notes=self.found.notes),
        )

    def lines(self) -> list[str]:
        lines = [self.headline, f"Frames: {self.where}"]
        if self.output:
            lines.append(f"Page, plots, JSON and the camera found, camera.toml: {self.output}")
        for part in self.parts:
            lines += [*part.lines(), ""]
        return lines[:-1]


def figures_of(done: Characterisation) -> Mapping[str, Figure]:
    """Return the plots by file name: measured points, and the line of the camera found."""
    session, rows = done.session, {row.name: row.found for row in done.rows}
    gain, black = done.found.sensor.gain_dn_per_e, done.found.sensor.superpixel_black_level_dn

    def chart(x: FloatArray, named: Mapping[str, FloatArray], title: str, x_label: str, y_label: str) -> Figure:
        lines = {
            name: {place: Mean(value, math.nan, 1) for place, value in zip(x.tolist(), y.tolist(), strict=True)}
            for name, y in named.items()
        }
        return curves({"": lines}, x_label, typeset(y_label), title=typeset(title))

    photons, signal, noise = session.transfer()
    charts = {
        "photon_transfer.png": chart(
            signal, {"camera found": gain * signal, "frames": noise},
            f"EMVA 1288 finds a gain of {rows['system_gain']:.4g} DN/e-",
            "signal less dark signal [DN]", "variance less dark variance [DN$^2$]",
        )
    }  # fmt: skip
    if "linearity_min" in rows:
        top = float(signal[int(noise.argmax())]) if session.saturates else float(signal.max()) / LINEAR[1]
        used = (signal >= LINEAR[0] * top) & (signal <= LINEAR[1] * top * (1 + 1e-12))
        slope, start = np.polyfit(photons[used], signal[used], 1, w=1 / signal[used])
        off = 100 * (signal[used] / (start + slope * photons[used]) - 1)
        light = "photons on a pixel [1]" if done.found.sensor.states_efficiency else "light on a pixel [a.u.]"
        title = f"Linearity: {rows['linearity_min']:.2g} to {rows['linearity_max']:+.2g} % off a line"
        charts["linearity.png"] = chart(photons[used], {"frames": off}, title, light, "deviation from a line [%]")
    if "dark_current" in rows:
        times = session.exposure_s[session.unlit]
        current = done.found.sensor.superpixel_dark_current_e_per_s
        charts["dark_current.png"] = chart(
            times, {"camera found": current * times, "frames": (session.mean[session.unlit] - black) / gain},
            f"EMVA 1288 finds a dark current of {rows['dark_current']:.4g} e-/s", "exposure time [s]",
            "dark signal less black level [e-]",
        )  # fmt: skip
    return charts


# -------- Characterisation


def characterise(
    sensor: SensorModel, procedure: Procedure | None = None, output: Path | str | None = None, job: Job | None = None
) -> Characterisation:
    """Run EMVA 1288's procedure on simulated frames of a camera, in a new, empty or earlier folder `output`."""
    procedure, job = procedure or Procedure(), job or Job()
    frames = Frames(sensor, procedure)
    bits = None if sensor.largest_dn is None else int(sensor.largest_dn).bit_length()
    stated = {"name": f"{sensor.name}, found", "pixel_pitch_um": sensor.superpixel_pitch_um, "bits": bits}
    stated["source"] = f"simulated frames of {sensor.name}"
    with ExitStack() as stack:
        folder = None if output is None else stack.enter_context(study_folder(output, "characterise"))
        taken = frames.take(job)
        pixels = Pixels(taken, lambda index: np.mean([*frames.images(index)], axis=0), partial(frames.take, job))
        found = pixels.camera(stated, sensor.states_efficiency)
        session = session_of(taken, frames.dark, frames.bright, True, sensor.bits is not None)
        rows = figure_rows(figures(session), frames.figures_set(), sensor.states_efficiency)
        done = Characterisation(sensor.name, session, rows, found, field_rows(found, sensor), procedure.stated)
        return _write(done, folder, procedure.style)


def characterise_frames(
    listed: FlatFrames, output: Path | str | None = None, job: Job | None = None, style: str = "screen"
) -> Characterisation:
    """Characterise a real camera by its listed frames; MitsimError for frames without a camera's noise."""
    job, facts, where = job or Job(), listed.listed, f"frames {listed.folder}"
    stated = {name: getattr(facts, name) for name in ("name", "pixel_pitch_um", "source", "bits")}
    efficient = facts.photons_per_s is not None

    def mean_image(index: int) -> FloatArray:
        files = listed.sets[index].files
        total = 0.0 + sum(read_image(listed.folder / name, listed.wanted).astype(np.float64) for name in files)
        return np.asarray(total / len(files))

    with ExitStack() as stack:
        folder = None if output is None else stack.enter_context(study_folder(output, "characterise"))
        shape = image_pages(listed.folder / listed.sets[0].files[0], listed.wanted)[1]
        if min(shape) < _LEAST_SIDE:
            raise MitsimError(f"{where}: {shape[0]} x {shape[1]} pixels; give {_LEAST_SIDE} or more a side")
        Cost(memory_bytes=2 * 8 * _FLOATS * math.prod(shape)).check(where, job.limits)
        job.progress("frames", 0.0)
        with job.clock.stage("frames"):
            taken = read_sets(listed, shape)
        for fault in _faults(listed, taken):
            raise MitsimError(f"{where}: {fault}")
        found = Pixels(taken, mean_image, partial(read_sets, listed, shape)).camera(stated, efficient)
        saturates = saturation_of(taken)[1] is not None
        session = session_of(taken, *nonuniform(taken), saturates, facts.bits is not None)
        rows, fields = figure_rows(figures(session), {}, efficient), field_rows(found, None)
        asked = {"folder": str(listed.folder), "shape": shape, "sets": len(taken)}
        done = Characterisation(facts.name, session, rows, found, fields, asked, True, remarks(listed, found))
        return _write(done, folder, style)


def _write(done: Characterisation, folder: Path | None, style: str) -> Characterisation:
    if folder is None:
        return done
    done = replace(done, output=str(folder))
    results = folder / "characterise.json"  # written last, so that a folder with it is complete
    results.unlink(missing_ok=True)
    pictures = {name: page_figure(figure) for name, figure in write_figures(folder, figures_of(done), style).items()}
    title, light = "Camera after EMVA 1288", "real frames" if done.real else "simulated even light"
    shown: dict[str, Any] = {"warnings": done.warnings, "scene": light, "camera": done.camera}
    section = Section("characterise", title, done.headline, done.where, pictures, done.parts, **shown)
    write_page([section], folder / "characterise.html", title)
    write_text(folder / CAMERA_FILE, done.found.toml())
    write_json(results, {**done.payload(), "kind": "characterise", "versions": versions()})
    return done

"""Lit and dark frames of a camera in, the sensor model that makes such frames out, each number with its standard error.

Gain, noise of reading, black level, dark current, response and linearity are fitted to means and variances
(`mitsim.sensor.photon_transfer`); offsets, responses, dark currents and defects of pixels are told by mean images.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import toml_value, validate
from mitsim.core.errors import MitsimError
from mitsim.devices.sensor import SensorModel
from mitsim.sensor.emva import LEAST_DARK
from mitsim.sensor.photon_transfer import Taken, Transfer, fit, nonuniform, saturation_of

_DEAD = 0.5
"""Response over the median one below which a pixel is dead."""
_HOT = 8.0
"""Robust deviations beyond the median dark current from which a pixel is hot: of a normal law none in 1e14, and few of
the longer tail that dark currents have."""
_SURE = 4.0
"""Standard errors from which an effect is put into the camera: one in 3e4 is there by chance."""
_UNEVEN = 0.01
"""Part of the light by which it differs over the frame from which a surface is taken off before pixels are compared."""
_MOST_UNEVEN = 0.25
"""The same at most: with more, frames at 0.7 of saturation hold pixels at 0.8, from where few counts are lost."""
_ROBUST = 1.4826
"""Standard deviation over median absolute deviation, of a normal law."""
_ROUNDED = 12**-0.5
"""Standard deviation of what rounding takes off a mean [DN], where no noise dithers it."""
_CUT = 1e-3
"""Part of dark readings that are 0 from which the black level is told by lit frames."""
_FILLED = 0.9
"""Part of the brightest mean from which a hot pixel is full."""
_HIDES = 2.0
"""Error of the offsets over that of what is seen of them from which they count as hidden."""
_MOST_RESPONSE = 0.1
"""Largest relative spread of responses that a camera file states."""

Images = Callable[[int], FloatArray]
"""Mean image (M, N) [DN] of the set of an index."""
Parts = tuple[FloatArray, FloatArray]
"""Spatial variances by pixel, row and column, and their standard errors; in the image's unit squared."""
Places = npt.NDArray[np.intp]
"""(M, N) flat index of the pixel that is read in place of each pixel."""


@dataclass(frozen=True)
class Stated:
    """What frames do not tell of a camera: its `name`, `pixel_pitch_um`, `source` and `bits`; and whether light is
    counted in photons."""

    name: str
    pixel_pitch_um: float
    source: str
    bits: int | None
    photons: bool


@dataclass(frozen=True, eq=False)
class FoundCamera:
    """The camera that frames show.

    Attributes
    ----------
    sensor
        whose pixels are the frames' elements.
    errors
        standard error of each field that was measured, by name.
    transfer
        the fit of means and variances.
    maps
        mean images, and the sets with other pixels in place of defects.
    notes
        what the frames do not tell.
    """

    sensor: SensorModel
    errors: dict[str, float]
    transfer: Transfer = field(repr=False)
    maps: Maps = field(repr=False)
    notes: tuple[str, ...]

    def toml(self) -> str:
        """The camera file, with standard errors in comments."""
        lines = ["# Measured by `mitsim characterise`: numbers with their standard errors.", "#"]
        lines += [f"# {note}" for note in self.notes]
        lines.append("")
        for name, value in self.sensor.model_dump(exclude_defaults=True).items():
            error = self.errors.get(name)
            lines.append(f"{name} = {toml_value(value)}" + (f"  # +- {error:.2g}" if error else ""))
        return "\n".join(lines) + "\n"


def find_camera(
    taken: Sequence[Taken], images: Images, stated: Stated, again: Callable[[Places], Sequence[Taken]]
) -> FoundCamera:
    """Find the camera that explains frames.

    Hot and dead pixels are counted, and then read as other pixels, so that they are in no other number.

    Parameters
    ----------
    taken
        sets of frames that were taken alike: some in the dark, one of them at the exposure of each under light.
    images
        their mean images.
    stated
        what frames do not tell.
    again
        statistics of the same sets, with some pixels replaced.

    Raises
    ------
    MitsimError
        for light that is far from even, and where no camera file can state what was found.
    """
    maps = Maps.of(taken, images, again)
    if maps.uneven > _MOST_UNEVEN:
        raise MitsimError(
            f"light differs by {100 * maps.uneven:.0f} % over the frame; at most {100 * _MOST_UNEVEN:.0f} % is "
            "possible; move the lamp away, or cut frames to what it lights evenly"
        )
    wide = math.sqrt(max(*maps.responses()[0], 0.0))
    if wide > _MOST_RESPONSE:
        raise MitsimError(
            f"responses of pixels differ by {100 * wide:.0f} %, and a camera file states at most "
            f"{100 * _MOST_RESPONSE:.0f} %; give the frames of one colour behind filters, and light that is even"
        )
    values, errors = maps.offsets()
    least = 1e-12 if stated.bits is None else 1 / maps.offset.size  # one pixel may have another code
    spatial = float(values.sum()), max(math.hypot(*errors), least)
    return _Findings(maps, fit(maps.taken, stated.bits, maps.short, spatial), spatial).camera(stated)


# ---- Maps of single pixels ----


@dataclass(frozen=True, eq=False)
class Maps:
    """Mean images, with defect pixels replaced, and counts of defects.

    `dark` and `bright` show nonuniformity, and `short` the offsets. `excess` (M, N) [DN] is gathered in the dark from
    the set `least` to the set `long`, and `contrast` (M, N) [DN] is made by light. `dead`, `hot` and `filled` are parts
    of the pixels; `beyond` [DN] is the mean excess of hot pixels over that of the others.
    """

    taken: Sequence[Taken]
    dark: int
    bright: int
    short: int
    least: int
    long: int
    offset: FloatArray
    contrast: FloatArray
    excess: FloatArray | None
    dead: float
    hot: float
    filled: float
    beyond: float
    uneven: float
    surface: tuple[float, float, float]

    @classmethod
    def of(cls, taken: Sequence[Taken], images: Images, again: Callable[[Places], Sequence[Taken]]) -> Maps:
        """Find the defects, and replace them.

        Parameters
        ----------
        taken, images, again
            as :func:`find_camera` takes them.
        """
        dark, bright = nonuniform(taken)
        unlit = [index for index, each in enumerate(taken) if not each.light]
        long = max(unlit, key=lambda index: (taken[index].exposure_s, taken[index].said.count))
        least = min(unlit, key=lambda index: (taken[index].exposure_s, -taken[index].said.count))
        short = max(unlit, key=lambda index: (taken[index].said.count, -taken[index].exposure_s))
        offset = images(short)
        contrast = images(bright) - (offset if dark == short else images(dark))
        middle = float(np.median(contrast))
        noise = math.sqrt(_noise_left(taken, bright) + _noise_left(taken, dark))
        dead = contrast < _DEAD * middle if 10 * noise < middle else np.zeros(contrast.shape, bool)
        longest = images(long)
        middle, full = float(np.median(longest)), float(taken[saturation_of(taken)[0]].said.pair.mean)
        filled, hot = longest > middle + _FILLED * (full - middle), np.zeros(contrast.shape, bool)
        excess, beyond = None, 0.0
        if taken[long].exposure_s > taken[least].exposure_s:
            excess = longest - (offset if least == short else images(least))
            middle = float(np.median(excess))
            # Of few codes most readings are one number: noise is then what is left of it.
            wide = math.sqrt(_noise_left(taken, long) + _noise_left(taken, least))
            wide = max(wide, _ROBUST * float(np.median(np.abs(excess - middle))), 1e-9)
            if float(taken[least].said.pair.variance) < LEAST_DARK:
                wide = max(wide, _ROUNDED)
            hot = excess > middle + _HOT * wide
            beyond = float(excess[hot].mean() - excess[~hot].mean()) if hot.any() else 0.0
        dead = (dead | filled) & ~hot  # pixels that are full at every exposure show no light
        bad = dead | hot
        if bad.any():
            places = _places(bad)
            taken = again(places)
            offset, contrast = offset.flat[places], contrast.flat[places]
            excess = None if excess is None else excess.flat[places]
        surface = _surface(contrast)
        surface /= surface.mean()
        uneven, parts = float(np.ptp(surface)), np.zeros(3)
        if uneven > _UNEVEN:
            contrast = contrast / surface
            parts = np.roll(_spatial_parts(surface, 0.0, 0.0)[0], -1)
        return cls(
            taken, dark, bright, short, least, long, offset, contrast, excess, float(dead.mean()), float(hot.mean()),
            float(filled.mean()), beyond, uneven, (float(parts[0]), float(parts[1]), float(parts[2])),
        )  # fmt: skip

    def offsets(self) -> Parts:
        """Return the spatial variances of the offsets [DN^2], with dark current's part at that exposure."""
        said = self.taken[self.short].said
        return _spatial_parts(self.offset, _noise_left(self.taken, self.short), float(said.pair.rows) / said.count)

    def responses(self) -> Parts:
        """Return the spatial variances of the responses, over their squared mean."""
        both = [self.taken[index].said for index in (self.bright, self.dark)]
        noise, rows = (
            sum(float(getattr(said.pair, name)) / said.count for said in both) for name in ("variance", "rows")
        )
        square = float(self.contrast.mean()) ** 2
        return _spatial_parts(self.contrast / math.sqrt(square), noise / square, rows / square)


def _places(bad: npt.NDArray[np.bool_]) -> Places:
    """Return for each of the ``bad`` pixels (M, N) a good one anywhere, drawn by chance: rows gain no common noise."""
    places = np.arange(bad.size).reshape(bad.shape)
    places[bad] = np.random.default_rng(0).choice(np.flatnonzero(~bad), np.count_nonzero(bad))
    return places


def _noise_left(taken: Sequence[Taken], index: int) -> float:
    """Variance [DN^2] that noise leaves in a pixel of a mean image."""
    return float(taken[index].said.pair.variance) / taken[index].said.count


def _spatial_parts(image: FloatArray, noise: float, rows: float) -> Parts:
    """Spatial variances of an ``image`` (M, N) [DN], in which ``noise`` is left, of which rows share a part."""
    m, n = image.shape
    rows *= 1 - 1 / m  # of variances about the frame's mean, which hold a row of m less
    about = image - image.mean()
    total = float(np.square(about).sum()) / (m * n - 1) - noise
    row, column = (float(np.square(about.mean(axis=k)).mean()) for k in (1, 0))
    row -= (noise - rows) / n + rows
    column -= (noise - rows) / m
    pixel = m * n / (m * n - m - n) * (total - row - column)
    values = np.array([pixel, row - pixel / n, column - pixel / m])
    own = max(pixel, 0.0) + noise - rows
    errors = np.sqrt(2.0 / np.array([(m - 1) * (n - 1), m - 1, n - 1])) * (
        own / np.array([1.0, n, m]) + np.maximum([0.0, values[1] + rows, values[2]], 0.0)
    )
    return values, errors


def _surface(image: FloatArray) -> FloatArray:
    """The surface of second degree (M, N) nearest to an ``image`` (M, N)."""
    m, n = image.shape
    y, x = (np.linspace(-1, 1, side) for side in (m, n))
    legendre = [np.polynomial.legendre.legvander(each, 2) for each in (y, x)]
    weights = [np.linalg.pinv(each) for each in legendre]
    found = weights[0] @ image @ weights[1].T
    keep = np.add.outer(np.arange(3), np.arange(3)) <= 2
    return np.asarray(legendre[0] @ (found * keep) @ legendre[1].T)


# ---- Findings ----


@dataclass(frozen=True, eq=False)
class _Findings:
    """All that was measured, as fields of a camera are made of it."""

    maps: Maps
    transfer: Transfer
    spatial: tuple[float, float]

    def camera(self, stated: Stated) -> FoundCamera:
        """The camera, of what was ``stated`` and measured."""
        transfer, notes = self.transfer, list[str]()
        gain, gain_error = transfer["gain"], transfer.error("gain") / transfer["gain"]
        found: dict[str, tuple[float, float]] = {"gain_dn_per_e": (gain, gain * gain_error)}
        found |= self._noise(gain, gain_error)
        found |= self._dark(gain, notes)
        found |= self._offsets(gain, gain_error, found["dark_current_spread_e_per_s"][0], notes)
        found |= self._responses()
        if stated.photons:
            # The specimen's pixels are a part of the error.
            mean = np.maximum(self.maps.responses()[0], 0) / [self.maps.offset.size, *self.maps.offset.shape]
            error = math.hypot(transfer.error("response"), transfer["response"] * math.sqrt(mean.sum()))
            found["quantum_efficiency"] = transfer["response"], error
            if transfer["response"] > 1 + _SURE * found["quantum_efficiency"][1]:
                raise MitsimError(
                    f"photons_per_s: light makes {transfer['response']:.3g} electrons a photon; at most 1 is possible, "
                    "so correct photons_per_s (photons on one pixel in a second), or leave it out"
                )
        found |= self._end(stated, notes)
        bend = [transfer["bend"], transfer["bend_2"]]
        fields: dict[str, Any] = {name: _short(value) for name, (value, _) in found.items()}
        if any(bend):
            fields["linearity"] = tuple(_short(value) for value in bend)
        if "quantum_efficiency" in fields:
            fields["quantum_efficiency"] = min(fields["quantum_efficiency"], 1.0)
        fields |= {name: getattr(stated, name) for name in ("name", "pixel_pitch_um", "source", "bits")}
        errors = {name: error for name, (_, error) in found.items()}
        if any(bend):
            errors["linearity"] = transfer.error("bend")
        sensor = validate(SensorModel, fields, "camera found")
        return FoundCamera(sensor, errors, transfer, self.maps, tuple(notes))

    def _noise(self, gain: float, gain_error: float) -> dict[str, tuple[float, float]]:
        """Noise of reading, of which rows share a part, and black level."""
        transfer = self.transfer
        read, error = transfer["read"], transfer.error("read")
        if min(float(each.said.pair.variance) for each in self.maps.taken if not each.light) < LEAST_DARK:
            error = max(error, math.sqrt(LEAST_DARK - 1 / 12) - read)  # few codes hide it: an upper limit is known
        rows, row_error = self._rows()
        shared, shared_error = _root(rows, row_error)
        own = math.sqrt(max(read**2 - shared**2, 0.0))
        still = math.sqrt(
            max(float((self.maps.offsets()[0] / [self.maps.offset.size, *self.maps.offset.shape]).sum()), 0)
        )
        own_error = math.hypot(error, own * gain_error, row_error / max(2 * own, 1e-9) if shared else 0.0)
        black, black_error = transfer["black"], math.hypot(transfer.error("black"), still)
        if black < -_SURE * black_error and max(each.said.cut[0] for each in self.maps.taken if not each.light) > _CUT:
            raise MitsimError(
                f"frames: the black level is {black:.3g} +- {black_error:.1g} DN by the frames under light, so that "
                "dark readings are cut at 0; a camera file states 0 or more; raise the black level (offset, pedestal) "
                "of the camera, or subtract less from the frames"
            )
        rest = {"row_noise_e": (shared / gain, shared_error / gain), "black_level_dn": (max(black, 0.0), black_error)}
        return {"read_noise_e": (own / gain, own_error / gain), **rest}

    def _rows(self) -> tuple[float, float]:
        """Variance of the noise that rows share [DN^2], and its standard error, of all sets in the dark."""
        m, n = self.maps.offset.shape
        pairs = [(each.said.pair, each.said.count) for each in self.maps.taken if not each.light]
        values = np.array([float(pair.rows) for pair, _ in pairs])
        middle = max(float(np.median(values)), 0.0)
        errors = np.array([
            math.sqrt(2 / m / (count - 1)) * ((float(pair.variance) - middle) / n + middle) for pair, count in pairs
        ])  # fmt: skip
        weight = 1 / np.maximum(errors, 1e-12) ** 2
        share = (1 - self.maps.hot - self.maps.dead) ** 2  # the others were read in other rows
        return float((values * weight).sum() / weight.sum() / share), float(weight.sum() ** -0.5 / share)

    def _dark(self, gain: float, notes: list[str]) -> dict[str, tuple[float, float]]:
        """Dark current, its spread, and hot pixels."""
        maps, taken = self.maps, self.maps.taken
        mean, error = self.transfer["dark"], self.transfer.error("dark")
        names = "dark_current_e_per_s", "dark_current_spread_e_per_s", "hot_pixels", "hot_dark_current_e_per_s"
        if maps.excess is None:
            notes.append("dark current is not told by dark frames of one exposure, and taken as 0; take two or more")
            return dict.fromkeys(names, (0.0, 0.0))
        seconds = taken[maps.long].exposure_s - taken[maps.least].exposure_s
        unit, count, (m, n) = gain * seconds, maps.excess.size, maps.excess.shape
        if not error:
            error = 0.5 / unit
            notes.append(f"dark current is hidden by rounding, and taken as 0; it is below {error:.2g} e-/s")
        beyond = max(maps.beyond, 0.0) / unit
        both = taken[maps.long], taken[maps.least]
        # As in `_spatial_parts`.
        rows = sum(max(float(each.said.pair.rows), 0.0) / each.said.count for each in both) * (1 - 1 / m)
        noise = _noise_left(taken, maps.long) + _noise_left(taken, maps.least) - rows
        even = maps.excess - maps.excess.mean(axis=1, keepdims=True)
        variance = float(np.square(even).mean()) * n / (n - 1)
        spread, spread_error = (variance - noise) / unit**2, math.sqrt(2 / count) * variance / unit**2
        wide, wide_error = _root(spread if mean > 0 else 0.0, spread_error)
        counted = sum(gain**2 * beyond * each.exposure_s / each.said.count for each in both)
        hot_error = math.sqrt((variance + counted) / max(maps.hot * count, 1) + rows / m) / unit
        return dict(zip(names, (
            (max(mean, 0.0), math.hypot(error, wide / math.sqrt(count))), (wide, wide_error),
            (maps.hot, math.sqrt(max(maps.hot, 1 / count) / count)), (beyond, hot_error if maps.hot else 0.0),
        ), strict=True))  # fmt: skip

    def _offsets(
        self, gain: float, gain_error: float, spread: float, notes: list[str]
    ) -> dict[str, tuple[float, float]]:
        """Return the offsets by pixel, row and column [e-].

        Rounding and the ADC's end change the spread of mean readings; the fit gives that of the offsets.
        """
        (seen, seen_error), true, error = self.spatial, self.transfer["spatial"], self.transfer.error("spatial")
        sure = seen > _SURE * seen_error and true > _SURE * error
        values = self.maps.offsets()[0] * (true / seen if sure else 0.0)
        own = math.sqrt(max(error**2 - seen_error**2, 0.0)) / max(true, 1e-300) if sure else 0.0
        hidden = not sure and error > _HIDES * seen_error
        errors = np.full(3, error) if hidden else self.maps.offsets()[1] * (true / seen if sure else 1.0)
        values[0] -= (gain * spread * self.maps.taken[self.maps.short].exposure_s) ** 2
        found = {}
        for name, value, each in zip(("pixel", "row", "column"), values, errors, strict=True):
            kept, kept_error = _root(value / gain**2, math.hypot(each, value * own) / gain**2)
            found[f"dsnu_{name}_e"] = kept, math.hypot(kept_error, kept * gain_error)
        if hidden:
            notes.append(
                "dsnu_*_e are hidden by rounding or by the ADC's end, and taken as 0; dsnu_pixel_e is below "
                f"{found['dsnu_pixel_e'][1]:.2g} e-"
            )
        return found

    def _responses(self) -> dict[str, tuple[float, float]]:
        """Responses by pixel, row and column, and dead pixels."""
        (b1, b2), full = self.transfer.values[5:7], 1.0
        if b1 or b2:
            light = self.transfer["response"] * self.maps.taken[self.maps.bright].light
            end = self.transfer.saturation_dn or math.inf
            well = max((end - self.transfer["black"]) / self.transfer["gain"] / (1 + b1 + b2), 1.0)
            x = light / well
            full = (1 + 2 * b1 * x + 3 * b2 * x**2) / (1 + b1 * x + b2 * x**2)
        dead, count = self.maps.dead, self.maps.offset.size
        return {"dead_pixels": (dead, math.sqrt(max(dead, 1 / count) / count))} | {
            f"prnu_{name}": _root(value / full**2, error / full**2)
            for name, value, error in zip(("pixel", "row", "column"), *self.maps.responses(), strict=True)
        }

    def _end(self, stated: Stated, notes: list[str]) -> dict[str, tuple[float, float]]:
        """Full well: where frames saturate, or where the ADC does."""
        transfer = self.transfer
        top = None if stated.bits is None else 2.0**stated.bits - 1
        end = transfer.saturation_dn if transfer.saturates else top
        bent = 1 + transfer["bend"] + transfer["bend_2"]
        if transfer.saturation_dn is None:
            what = "is taken as what the ADC's end needs" if top else "is taken as infinite"
            notes.append(f"full well: no frame is saturated, so it {what}; take brighter frames")
        elif not transfer.saturates:
            notes.append("full well: the ADC's end is reached first, so it may be larger")
        if end is None:
            return {"full_well_e": (math.inf, 0.0)}
        full = (end - transfer["black"]) / transfer["gain"] / bent
        if transfer.saturation_dn is None:
            return {"full_well_e": (full, 0.0)}  # what is not told has no error
        # By gain, black level and both bends (`photon_transfer.NAMES`), whose errors are not independent.
        slopes = np.array([1 / transfer["gain"], 0, 1 / (end - transfer["black"]), 0, 0, 1 / bent, 1 / bent, 0])
        return {"full_well_e": (full, full * math.sqrt(slopes @ transfer.covariance @ slopes))}


def _root(square: float, error: float) -> tuple[float, float]:
    """Return the root of a ``square`` with its standard error; 0 and the largest likely root where it may be chance."""
    root = math.sqrt(square) if square > _SURE * error else 0.0
    return root, error / (2 * root) if root else math.sqrt(max(square, 0.0) + error)


def _short(value: float) -> float:
    """A number of seven digits: more than any is known to."""
    return float(f"{value:.7g}")

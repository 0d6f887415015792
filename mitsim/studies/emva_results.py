"""What a characterisation found: figures of EMVA 1288 beside those set, and the camera that explains the frames."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from mitsim.core.arrays import FloatArray
from mitsim.devices.sensor import SensorModel
from mitsim.report.pages import round_to_error
from mitsim.sensor import emva
from mitsim.sensor.emva import Session
from mitsim.sensor.found_camera import FoundCamera
from mitsim.sensor.specimen import mean_dark_current
from mitsim.studies.emva_frames import Frames
from mitsim.studies.emva_options import capacity_of
from mitsim.studies.framework.page import Part, text_table

UNITS: Mapping[str, tuple[str, str]] = {
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
    **{f"dsnu_{part}": (f"DSNU1288.{part}", "e-") for part in emva.SPLIT},
    **{f"prnu_{part}": (f"PRNU1288.{part}", "%") for part in emva.SPLIT},
}
"""Symbol of the standard, and unit, of each figure in the order in which they are shown."""
_SQUARES = ("row_noise", "dsnu", "prnu")
"""Figures that are found as variances, which may be below zero, and shown as their roots."""
FIELDS: Mapping[str, str] = {
    "gain_dn_per_e": "DN/e-",
    "quantum_efficiency": "e-/photon",
    "read_noise_e": "e-",
    "row_noise_e": "e-",
    "black_level_dn": "DN",
    "full_well_e": "e-",
    "dark_current_e_per_s": "e-/s",
    "dark_current_spread_e_per_s": "e-/s",
    **{f"dsnu_{part}_e": "e-" for part in emva.SPLIT[1:]},
    **{f"prnu_{part}": "1" for part in emva.SPLIT[1:]},
    "hot_pixels": "1",
    "hot_dark_current_e_per_s": "e-/s",
    "dead_pixels": "1",
}
"""Fields of a camera file that are measured, and their units."""
_BIASED, _MISLEADS = 0.5, 1.0
"""Standard errors by which the procedure's own bias by the ADC moves a figure, from which it is held against what is
expected of it, and from which it is flagged: with less, 98 of 100 found figures are still within three standard errors
of the value set."""
_BY_METHOD = ("saturation_capacity", "linearity_min", "linearity_max")
"""Figures that depend on the steps of light and on their noise, and have no value that a camera file sets."""
_DUST = 1e-10
"""Least standard error of a figure, above what rounding of the arithmetic leaves of no noise."""
_WHOLE = 1e4
"""From which a headline has whole numbers."""
MOST_OFF = 5.0
"""Standard errors from which a figure is off: one of twenty figures is so by chance in 1e5 characterisations."""


@dataclass(frozen=True)
class Row:
    """One figure: what was set, what the procedure is expected to find where that differs (otherwise None), what it
    found, its predicted standard error, by how many of these it is off, and by how many the ADC's ends and steps move
    what is expected from what was set (0 where those are not at fault)."""

    name: str
    symbol: str
    unit: str
    set: float
    expected: float | None
    found: float
    standard_error: float
    deviations: float
    bias: float = 0.0


@dataclass(frozen=True)
class FieldRow:
    """One field of the camera that explains the frames: what a file sets, where there is one, what was found, its
    standard error, and by how many of these it is off."""

    name: str
    unit: str
    set: float | None
    found: float
    standard_error: float
    deviations: float | None


@dataclass(frozen=True, eq=False)
class Characterisation:
    """A camera's figures.

    Attributes
    ----------
    camera
        the camera's name.
    frames
        what was characterised, and in which frames; of a real camera it is the one that was found in them.
    session, expected
        what the frames said, and what closed forms expect of them.
    rows
        the figures.
    found, fields
        the camera that explains the frames, and its fields.
    asked
        what the request said, for JSON.
    real
        whether the frames are of a real camera.
    about
        what was noticed in the frames, and what is to be mended.
    output
        folder of page, plots, JSON and the camera file; None where none was asked for.
    """

    camera: str
    frames: Frames
    session: Session = field(repr=False)
    expected: Session = field(repr=False)
    rows: tuple[Row, ...]
    found: FoundCamera
    fields: tuple[FieldRow, ...]
    asked: Mapping[str, Any]
    real: bool = False
    about: tuple[str, ...] = ()
    output: str | None = None

    @property
    def sensor(self) -> SensorModel:
        """What was characterised."""
        return self.frames.sensor

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was noticed in real frames, figures that are off by more than five standard errors, and those that the
        procedure cannot find."""
        biased = [row for row in self.rows if abs(row.bias) > _MISLEADS]
        off = [
            f"{row.name}: found {row.found:.5g} {row.unit}, {abs(row.deviations):.1f} standard errors off "
            f"{row.set if row.expected is None else row.expected:.5g}; the procedure does not fit this camera"
            for row in self.rows
            if not abs(row.deviations) <= MOST_OFF
        ]
        off += [
            f"{row.name} of the camera found: {row.found:.5g} {row.unit}, {abs(row.deviations):.1f} standard errors "
            f"off {row.set:.5g}, which is set"
            for row in self.fields
            if row.deviations is not None and not abs(row.deviations) <= MOST_OFF
        ]
        if biased:
            of, sensor = "the camera" if self.real else "what is set", self.frames.sensor
            found = ", ".join(f"{row.name} {row.expected:.5g} {row.unit} for {row.set:.5g}" for row in biased)
            noise = sensor.superpixel_reading_noise_e * sensor.gain_dn_per_e
            black = sensor.superpixel_black_level_dn
            why = f"a black level of {black:.3g} DN and rounding to whole DN hide part of a noise of {noise:.2g} DN"
            what = f"the procedure does not find {of}, but {found}"
            off.insert(0, f"{what}: {why}; raise black_level_dn or gain_dn_per_e")
        return (*self.about, *off)

    def payload(self) -> dict[str, Any]:
        """What the command line reports as JSON."""
        transfer = self.found.transfer
        return {
            "camera": self.camera,
            **self.asked,
            "exposure_s": float(self.frames.exposure_s[self.frames.dark]),
            "figures": [asdict(row) for row in self.rows],
            "camera_found": [asdict(row) for row in self.fields],
            "light": {
                "uneven": self.found.maps.uneven, "scatter": transfer.lamp, "drifts": transfer.light == "drifts",
                "seen": transfer.light,
                "chi_square": transfer.chi_square, "freedom": transfer.freedom,
            },
            "notes": list(self.found.notes),
            "warnings": list(self.warnings),
            "output": self.output,
        }  # fmt: skip

    @property
    def title(self) -> str:
        """Of which camera it is."""
        return f"{self.camera} after EMVA 1288"

    @property
    def message(self) -> str:
        """What is asked first of a camera, as found."""
        found = {row.name: row for row in self.fields}
        named = {"Gain": "gain_dn_per_e", "read noise": "read_noise_e", "full well": "full_well_e"}
        rows = {name: found[each] for name, each in named.items() if each in found}
        return ", ".join(
            f"{name} {row.found:{'.4g' if row.found < _WHOLE else '.0f'}} {row.unit}" for name, row in rows.items()
        )

    @property
    def where(self) -> str:
        """In which frames."""
        (m, n), lit, unlit = self.frames.shape, len(self.session.lit), len(self.session.unlit)
        return f"{m} x {n} pixels, {lit} sets of frames under light, {unlit} in the dark"

    @property
    def parts(self) -> tuple[Part, Part]:
        """Tables, and the plots that stand with them: the figures of EMVA 1288, and the camera that was found."""
        rows = [
            (
                row.name,
                row.symbol,
                row.unit,
                _text(row.set),
                _text(row.expected),
                *_digits(row),
                _text(row.deviations, ".1f"),
            )
            for row in self.rows
        ]
        fields: list[tuple[str, ...]] = [
            (row.name, row.unit, _text(row.set), *_digits(row), _text(row.deviations, ".1f")) for row in self.fields
        ]
        found = ("found", "std. error", "off by")
        head = ("figure", "symbol", "unit", "camera" if self.real else "set", "expected", *found)
        of_fields: tuple[str, ...] = ("camera found", "unit", "set", *found)
        if self.real:  # nothing is set
            of_fields, fields = ((*of_fields[:2], *of_fields[3:5]), [(*row[:2], *row[3:5]) for row in fields])
        figure = "the camera has" if self.real else "the one set"
        note = f"expected: where the procedure finds another figure than {figure}, at these steps and frames"
        return (
            Part(
                "Figures of EMVA 1288",
                "What the standard's procedure finds, with its standard error, and by how many of these it is off.",
                head, tuple(rows), ("deviations.png", "photon_transfer.png", "linearity.png", "dark_current.png"),
                (note,) if any(row.expected is not None for row in self.rows) else (),
            ),
            Part(
                "The camera that explains the frames", "The fields of camera.toml, which --camera takes.",
                of_fields, tuple(fields), notes=tuple(self.found.notes),
            ),
        )  # fmt: skip

    def lines(self) -> list[str]:
        """For people."""
        figures, camera = self.parts
        lines = [f"{self.camera}: {self.where}"]
        if self.output:
            lines.append(f"Page, plots, JSON and the camera found, camera.toml: {self.output}")
        lines += [*text_table(figures.head, figures.rows), *figures.notes]
        return [*lines, "", *text_table(camera.head, camera.rows), *camera.notes]


def _digits(row: Row | FieldRow) -> tuple[str, str]:
    """Return the number found and its standard error, to the digits that are known."""
    return round_to_error(row.found, row.standard_error), round_to_error(row.standard_error, row.standard_error)


def _text(value: float | None, digits: str = ".5g") -> str:
    return "" if value is None else f"{value:{digits}}"


def _set(frames: Frames, name: str) -> float:
    """What the camera's file sets of a figure ``name``; squares of those that are found as variances."""
    sensor, time = frames.sensor, float(frames.exposure_s[frames.dark])
    kind, _, part = name.partition("_")
    if kind in ("dsnu", "prnu"):
        parts = frames.parts(frames.dark)
        if kind == "prnu":
            alive = float(frames.electrons[frames.bright]) * (1 - sensor.dead_pixels)
            parts = (frames.parts(frames.bright) - parts) / alive**2
        return float(dict(zip(emva.SPLIT, (parts.sum(), *parts), strict=True))[part])
    dark = mean_dark_current(sensor)
    return {
        "system_gain": sensor.gain_dn_per_e,
        "quantum_efficiency": frames.efficiency * (1 - sensor.dead_pixels),
        "dark_noise": math.sqrt(
            sensor.superpixel_reading_noise_e**2 + (0.0 if frames.ladder_of_exposures else dark * time)
        ),
        "row_noise": sensor.superpixel_row_noise_e**2,
        "saturation_capacity": capacity_of(sensor),
        "full_well": (capacity_of(sensor) - dark * frames.brightest_s) * (1 - sensor.dead_pixels),
        "linearity_min": 0.0,
        "linearity_max": 0.0,
        "dark_current": dark,
        "dark_current_by_variance": dark,
    }[name]


def row_of(frames: Frames, name: str, found: FloatArray, sessions: FloatArray, bend: float = 0.0) -> Row:
    """A figure as it is shown.

    Parameters
    ----------
    frames
        that it was found in.
    name
        of the figure.
    found
        the figure.
    sessions
        (count,) the same of drawn sessions, which tell its error.
    bend
        standard error of the linearity that is expected.
    """
    sensor = frames.sensor
    value, spread, centre = float(found), max(float(sessions.std()), _DUST), float(sessions.mean())
    given = _set(frames, name)
    # What the linear method makes of a camera that is not linear, and of rows that share noise, is not what is set.
    method = name in _BY_METHOD or bool(sensor.linearity)
    method |= bool(sensor.row_noise_e) and name.startswith(("dsnu", "prnu"))
    bias = 0.0 if method or sensor.bits is None else (centre - given) / spread
    method |= abs(bias) > _BIASED
    if name == "dark_noise" and (given * sensor.gain_dn_per_e) ** 2 + emva.QUANTISATION < emva.LEAST_DARK:
        bias = 0.0  # it is found as the standard's limit, as it should be
    spread = math.hypot(spread, bend if name.startswith("linearity") else 0.0)
    if name == "saturation_capacity":
        spread = math.hypot(spread, frames.step / math.sqrt(12))
    against = centre if method else given
    off = (value - against) / spread
    symbol, unit = UNITS[name]
    scale = 100.0 if unit == "%" else 1.0
    if name.startswith(_SQUARES):
        root = math.sqrt(max(against, 0.0))
        spread = spread / (2 * max(root, math.sqrt(spread)))
        given, value, centre = (math.copysign(math.sqrt(abs(square)), square) for square in (given, value, centre))
    expected = scale * centre if method else None
    return Row(name, symbol, unit, scale * given, expected, scale * value, scale * spread, off, bias)


def fields_of(found: FoundCamera, model: SensorModel | None) -> tuple[FieldRow, ...]:
    """The fields of a camera that was ``found``, beside those of the ``model`` that took frames; None: not known."""
    rows = []
    bends = {
        f"linearity.{power}": (value, ("bend", "bend_2")[power]) for power, value in enumerate(found.sensor.linearity)
    }
    for name, unit in {**FIELDS, **dict.fromkeys(bends, "1")}.items():
        value, error = getattr(found.sensor, name, None), found.errors.get(name, 0.0)
        if name in bends:
            value, error = bends[name][0], found.transfer.error(bends[name][1])
        if value is not None and math.isfinite(value):
            given = None if model is None else _set_field(model, name)
            off = None if given is None or not error else (value - given) / error
            rows.append(FieldRow(name, unit, given, value, error, off))
    return tuple(rows)


def _set_field(model: SensorModel, name: str) -> float | None:
    """What a ``model`` sets of a field of the camera whose pixels its superpixels are; None: no number."""
    pixel, row, column = model.offset_parts
    of_pixel, of_row, of_column = model.response_parts
    defects = {kind: getattr(model, kind) for kind in ("hot_pixels", "dead_pixels", "hot_dark_current_e_per_s")}
    known: dict[str, float | None] = {
        "gain_dn_per_e": model.gain_dn_per_e,
        "quantum_efficiency": model.quantum_efficiency,
        "read_noise_e": model.superpixel_read_noise_e,
        "row_noise_e": model.superpixel_row_noise_e,
        "black_level_dn": model.superpixel_black_level_dn,
        "full_well_e": capacity_of(model),
        "dark_current_e_per_s": model.superpixel_dark_current_e_per_s,
        "dark_current_spread_e_per_s": model.binning * model.dark_factor * model.dark_current_spread_e_per_s,
        **dict(zip((f"dsnu_{part}_e" for part in emva.SPLIT[1:]), (row, column, pixel), strict=True)),
        **dict(zip((f"prnu_{part}" for part in emva.SPLIT[1:]), (of_row, of_column, of_pixel), strict=True)),
        **({} if model.binning > 1 else defects),
        **{f"linearity.{power}": value for power, value in enumerate([*model.linearity, 0.0, 0.0])},
    }
    return known.get(name)

"""Characterise a camera after EMVA 1288 release 4.0: figures, the camera file, a page and plots.

Figures of simulated frames are compared with the camera file, and those of real frames with the camera that explains
the frames. Standard errors are the scatter of a thousand drawn sessions (GUM, supplement 1).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import versions
from mitsim.core.files import write_json, write_text
from mitsim.core.job import Job
from mitsim.devices.framelist import FlatFrames, capacity_of
from mitsim.devices.sensor import SensorModel
from mitsim.report.pages import Mean, page_figure, round_to_error, typeset
from mitsim.report.plots import curves, grouped_bars
from mitsim.sensor.camera_fit import FoundCamera, Pixels
from mitsim.sensor.chain import mean_dark_current
from mitsim.sensor.emva import LEAST_DARK, LINE, LINEAR, QUANTISATION, SPLIT, Alike, Session, figures
from mitsim.studies.camera_frames import Frames, draw_sessions, mean_image, read_again, read_sets, remarks
from mitsim.studies.emva_options import Procedure
from mitsim.studies.framework.campaign import study_folder, write_figures
from mitsim.studies.framework.panels import Part, build_findings, text_table

CAMERA_FILE = "camera.toml"
MOST_OFF = 5.0
_BIASED, _MISLEADS = 0.5, 1.0
"""Standard errors of the procedure's own bias from which the expected value is compared, and a figure flagged."""
_DUST = 1e-10
_OF_FIELDS = "name", "unit", "set", "found", "standard_error", "deviations"
_WHOLE = 1e4


# ---- tables of the measured numbers ----------------------------------------------------------------------------------


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


def figures_set(frames: Frames) -> dict[str, float]:
    sensor, brightest, current = frames.sensor, int(frames.light.argmax()), mean_dark_current(frames.sensor)
    alive, light = 1 - sensor.dead_pixels, float(frames.light[brightest])
    # At no exposure if the light varies by exposure.
    ladder = len(np.unique(frames.exposure_s[frames.light > 0])) >= LINE
    dark = 0.0 if ladder else current * float(frames.exposure_s[frames.dark])
    offsets = frames.parts(frames.dark)
    responses = (frames.parts(frames.bright) - offsets) / (float(frames.electrons[frames.bright]) * alive) ** 2
    return {
        "system_gain": sensor.gain_dn_per_e,
        "quantum_efficiency": float(frames.electrons[brightest]) / light * alive,
        "dark_noise": math.sqrt(sensor.superpixel_reading_noise_e**2 + dark),
        "row_noise": sensor.superpixel_row_noise_e**2,
        "saturation_capacity": capacity_of(sensor),
        "full_well": (capacity_of(sensor) - current * float(frames.exposure_s[brightest])) * alive,
        **dict.fromkeys(("linearity_min", "linearity_max"), 0.0),
        **dict.fromkeys(("dark_current", "dark_current_by_variance"), current),
        **{f"dsnu_{part}": float(each) for part, each in zip(SPLIT, (offsets.sum(), *offsets), strict=True)},
        **{f"prnu_{part}": float(each) for part, each in zip(SPLIT, (responses.sum(), *responses), strict=True)},
    }


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


@dataclass(frozen=True)
class Row:
    """A figure, or a field of the camera that explains the frames, with `expected` if it differs from the set one;
    `deviations` and `bias` are in standard errors.
    """

    name: str
    symbol: str
    unit: str
    set: float | None
    expected: float | None
    found: float
    standard_error: float
    deviations: float | None
    bias: float = 0.0


def row_of(frames: Frames, name: str, given: float, found: FloatArray, sessions: FloatArray, bend: float = 0.0) -> Row:
    """Compare a figure with its set or expected value.

    `sessions` (count,) are figures of drawn sessions, and `bend` is the standard error of the expected linearity.
    """
    sensor, (symbol, unit) = frames.sensor, FIGURES[name]
    value, spread, centre = float(found), max(float(sessions.std()), _DUST), float(sessions.mean())
    # A linear method does not find the set value of a bent camera, or of nonuniformity under noise that rows share.
    method = name.startswith(("saturation", "linearity")) or bool(sensor.linearity)
    method |= bool(sensor.row_noise_e) and name.startswith(("dsnu", "prnu"))
    bias = 0.0 if method or sensor.bits is None else (centre - given) / spread
    method |= abs(bias) > _BIASED
    if name == "dark_noise" and (given * sensor.gain_dn_per_e) ** 2 + QUANTISATION < LEAST_DARK:
        bias = 0.0  # the standard's limit is found, as it should be
    spread = math.hypot(spread, bend if name.startswith("linearity") else 0.0)
    if name == "saturation_capacity":
        spread = math.hypot(spread, frames.step / math.sqrt(12))
    against = centre if method else given
    off = (value - against) / spread
    if name.startswith(_VARIANCES):
        root = math.sqrt(max(against, 0.0))
        spread = spread / (2 * max(root, math.sqrt(spread)))
        given, value, centre = (math.copysign(math.sqrt(abs(square)), square) for square in (given, value, centre))
    scale = 100.0 if unit == "%" else 1.0
    expected = scale * centre if method else None
    return Row(name, symbol, unit, scale * given, expected, scale * value, scale * spread, off, bias)


def fields_of(found: FoundCamera, model: SensorModel | None) -> tuple[Row, ...]:
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
            rows.append(Row(name, "", unit, set_value, None, value, error, off))
    return tuple(rows)


# ---- results ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Characterisation:
    """A camera's figures (`rows`), the camera that explains its frames (`fields`), and closed forms (`expected`)."""

    camera: str
    frames: Frames
    session: Session = field(repr=False)
    expected: Session = field(repr=False)
    rows: tuple[Row, ...]
    found: FoundCamera
    fields: tuple[Row, ...]
    asked: Mapping[str, Any]
    real: bool = False
    about: tuple[str, ...] = ()
    output: str | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        lines, sensor = [*self.about], self.frames.sensor
        if biased := [row for row in self.rows if abs(row.bias) > _MISLEADS]:
            of = "the camera" if self.real else "what is set"
            found = ", ".join(f"{row.name} {row.expected:.5g} {row.unit} for {row.set:.5g}" for row in biased)
            noise = sensor.superpixel_reading_noise_e * sensor.gain_dn_per_e
            lines.append(
                f"the procedure does not find {of}, but {found}: a black level of "
                f"{sensor.superpixel_black_level_dn:.3g} DN and rounding to whole DN hide part of a noise of "
                f"{noise:.2g} DN; raise black_level_dn or gain_dn_per_e"
            )
        for row in (*self.rows, *self.fields):
            if row.deviations is not None and abs(row.deviations) > MOST_OFF:
                off = f"{row.found:.5g} {row.unit}, {abs(row.deviations):.1f} standard errors off"
                against = row.set if row.expected is None else row.expected
                lines.append(
                    f"{row.name}: found {off} {against:.5g}; the procedure does not fit this camera"
                    if row.symbol
                    else f"{row.name} of the camera found: {off} {row.set:.5g}, which is set"
                )
        return tuple(lines)

    def payload(self) -> dict[str, Any]:
        transfer = self.found.transfer
        return {
            "camera": self.camera,
            **self.asked,
            "exposure_s": float(self.frames.exposure_s[self.frames.dark]),
            "figures": [asdict(row) for row in self.rows],
            "camera_found": [{name: getattr(row, name) for name in _OF_FIELDS} for row in self.fields],
            "light": {
                "uneven": self.found.pixels.uneven, "scatter": transfer.lamp, "drifts": transfer.light == "drifts",
                "seen": transfer.light, "chi_square": transfer.chi_square, "freedom": transfer.freedom,
            },
            "notes": list(self.found.notes),
            "warnings": list(self.warnings),
            "output": self.output,
        }  # fmt: skip

    @property
    def message(self) -> str:
        named = {"gain_dn_per_e": "Gain", "read_noise_e": "read noise", "full_well_e": "full well"}
        rows = {named[row.name]: row for row in self.fields if row.name in named}
        return ", ".join(
            f"{name} {row.found:{'.4g' if row.found < _WHOLE else '.0f'}} {row.unit}" for name, row in rows.items()
        )

    @property
    def where(self) -> str:
        (m, n), lit, unlit = self.frames.shape, len(self.session.lit), len(self.session.unlit)
        return f"{m} x {n} pixels, {lit} sets of frames under light, {unlit} in the dark"

    @property
    def parts(self) -> tuple[Part, Part]:

        def cell(row: Row, name: str) -> str:
            value = getattr(row, name)
            if name in ("found", "standard_error"):
                return round_to_error(value, row.standard_error)
            if value is None or isinstance(value, str):
                return value or ""
            return f"{value:{'.1f' if name == 'deviations' else '.5g'}}"

        def table(rows: Sequence[Row], columns: Mapping[str, str]) -> tuple[Any, Any]:
            return tuple(columns), tuple(tuple(cell(row, name) for name in columns.values()) for row in rows)

        found, off = {"found": "found", "std. error": "standard_error"}, {"off by": "deviations"}
        figure = {"figure": "name", "symbol": "symbol", "unit": "unit", "camera" if self.real else "set": "set"}
        compared = {**found} if self.real else {"set": "set", **found, **off}
        which = "the camera has" if self.real else "the one set"
        note = f"expected: where the procedure finds another figure than {which}, at these steps and frames"
        return (
            Part(
                "Figures of EMVA 1288",
                "What the standard's procedure finds, with its standard error, and by how many of these it is off.",
                *table(self.rows, {**figure, "expected": "expected", **found, **off}),
                ("deviations.png", "photon_transfer.png", "linearity.png", "dark_current.png"),
                (note,) if any(row.expected is not None for row in self.rows) else (),
            ),
            Part(
                "The camera that explains the frames", "The fields of camera.toml, which --camera takes.",
                *table(self.fields, {"camera found": "name", "unit": "unit", **compared}),
                notes=tuple(self.found.notes),
            ),
        )  # fmt: skip

    def lines(self) -> list[str]:
        lines = [f"{self.camera}: {self.where}"]
        if self.output:
            lines.append(f"Page, plots, JSON and the camera found, camera.toml: {self.output}")
        for part in self.parts:
            lines += [*text_table(part.head, part.rows), *part.notes, ""]
        return lines[:-1]


# ---- plots -----------------------------------------------------------------------------------------------------------


def figures_of(done: Characterisation) -> Mapping[str, Figure]:
    rows, what = {row.name: row for row in done.rows}, "camera found" if done.real else "closed form"
    gain, black = rows["system_gain"].found, done.frames.sensor.superpixel_black_level_dn

    def found(name: str) -> str:
        row = rows[name]
        value, error = (round_to_error(each, row.standard_error) for each in (row.found, row.standard_error))
        given = f"{'camera found' if done.real else 'set'} {row.set:.5g}"
        return typeset(f"{value} +- {error} {row.unit}, {given}".replace("e-", "e\N{SUPERSCRIPT MINUS}"))

    def chart(points: Callable[[Session], tuple[FloatArray, FloatArray]], title: str, x: str, y: str) -> Figure:
        lines = {
            name: {place: Mean(value, math.nan, 1) for place, value in zip(*points(session), strict=True)}
            for name, session in ((what, done.expected), ("pairs of frames", done.session))
        }
        return curves({"": lines}, x, y, ticks=False, title=title)

    def straightness(session: Session) -> tuple[FloatArray, FloatArray]:
        photons, signal, noise = session.transfer()
        top = float(signal[int(noise.argmax())]) if session.saturates else float(signal.max()) / LINEAR[1]
        used = (signal >= LINEAR[0] * top) & (signal <= LINEAR[1] * top * (1 + 1e-12))
        slope, start = np.polyfit(photons[used], signal[used], 1, w=1 / signal[used])
        return photons[used], 100 * (signal[used] / (start + slope * photons[used]) - 1)

    off = {row.name.replace("_", " "): {"": Mean(row.deviations or 0.0, math.nan, 1)} for row in done.rows}
    far = sum(abs(row.deviations or 0.0) > MOST_OFF for row in done.rows)
    title = (
        f"{far or 'None'} of {len(off)} figures {'are' if far > 1 else 'is'} more than {MOST_OFF:g} standard errors off"
    )
    given = "the camera's" if done.real else "set"
    charts = {
        "deviations.png": grouped_bars(off, f"found less {given} or expected [standard errors]", title),
        "photon_transfer.png": chart(
            lambda session: session.transfer()[1:], f"EMVA 1288 finds a gain of {found('system_gain')}",
            "signal less dark signal [DN]", "variance less dark variance [DN$^2$]",
        ),
    }  # fmt: skip
    if "linearity_min" in rows:
        light = "photons on a pixel [1]" if done.frames.sensor.states_efficiency else "light on a pixel [a.u.]"
        title = f"Linearity: {rows['linearity_min'].found:.2g} to {rows['linearity_max'].found:+.2g} % off a line"
        charts["linearity.png"] = chart(straightness, typeset(title), light, "deviation from a line [%]")
    if "dark_current" in rows:
        charts["dark_current.png"] = chart(
            lambda session: (
                session.exposure_s[session.unlit], (session.pairs.mean[session.unlit] - black) / gain
            ),
            f"EMVA 1288 finds a dark current of {found('dark_current')}", "exposure time [s]",
            "dark signal less black level [e$^-$]",
        )  # fmt: skip
    return charts


# ---- characterisation ------------------------------------------------------------------------------------------------


def characterise(
    sensor: SensorModel, procedure: Procedure | None = None, output: Path | str | None = None, job: Job | None = None
) -> Characterisation:
    """Run EMVA 1288's procedure on simulated frames of a camera, in a new, empty or earlier folder `output`."""
    procedure, job = procedure or Procedure(), job or Job()
    frames = Frames.of(sensor, procedure)
    bits = None if sensor.largest_dn is None else int(sensor.largest_dn).bit_length()
    stated = {"name": f"{sensor.name}, found", "pixel_pitch_um": sensor.superpixel_pitch_um, "bits": bits}
    stated["source"] = f"simulated frames of {sensor.name}"

    def measure(folder: str | None) -> Characterisation:
        taken = frames.take(job)
        pixels = Pixels(taken, lambda index: np.mean([*frames.images(index)], axis=0), partial(frames.take, job))
        found = pixels.camera(stated, sensor.states_efficiency)
        return _compare(frames, taken, found, asked=procedure.stated, camera=sensor.name, output=folder)

    return _write(measure, output)


def characterise_frames(
    listed: FlatFrames, output: Path | str | None = None, job: Job | None = None
) -> Characterisation:
    job, facts = job or Job(), listed.listed
    stated = {name: getattr(facts, name) for name in ("name", "pixel_pitch_um", "source", "bits")}

    def measure(folder: str | None) -> Characterisation:
        taken = read_sets(listed, job)
        pixels = Pixels(taken, partial(mean_image, listed), partial(read_again, listed, taken[0].shape))
        found = pixels.camera(stated, facts.photons_per_s is not None)
        asked = {"folder": str(listed.folder), "shape": taken[0].shape, "sets": len(taken)}
        frames, about = Frames.as_taken(taken, found), remarks(listed, found)
        return _compare(frames, taken, found, asked=asked, camera=facts.name, output=folder, real=True, about=about)

    return _write(measure, output)


def _compare(
    frames: Frames, taken: list[Alike], found: FoundCamera, real: bool = False, **facts: Any
) -> Characterisation:
    expected, sensor = frames.expect(), frames.sensor
    session = frames.session(taken, taken[frames.dark].stack, taken[frames.bright].stack)
    spread, of_frames = figures(draw_sessions(frames, expected)), figures(session)
    bend = found.transfer.error("bend") if real else 0.0  # the error of a real camera's expected linearity
    given = figures_set(frames)
    rows = tuple(
        row_of(frames, name, given[name], of_frames[name], spread[name], bend)
        for name in FIGURES
        # Without a quantum efficiency light is counted in electrons, so there is none to find.
        if name in of_frames and name in spread and (sensor.states_efficiency or name != "quantum_efficiency")
    )
    fields = fields_of(found, None if real else sensor)
    return Characterisation(
        frames=frames, session=session, expected=expected, rows=rows, found=found, fields=fields, real=real, **facts
    )


def _write(measure: Callable[[str | None], Characterisation], output: Path | str | None) -> Characterisation:
    if output is None:
        return measure(None)
    with study_folder(output, "characterise") as folder:
        done = measure(str(folder))
        results = folder / "characterise.json"  # written last, so that a folder with it is complete
        results.unlink(missing_ok=True)
        drawn = write_figures(folder, figures_of(done))
        pictures = {name: page_figure(figure) for name, figure in drawn.items()}
        titles = f"{done.camera} after EMVA 1288", done.message
        page = build_findings("characterise", titles, done.where, done.parts, pictures, done.warnings)
        write_text(folder / "characterise.html", page)
        write_text(folder / CAMERA_FILE, done.found.toml())
        write_json(results, {**done.payload(), "kind": "characterise", "versions": versions()})
    return done

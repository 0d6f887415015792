"""Colours of a ColorChecker: Delta E 2000 of each patch to its spectrum in D65, by patterns and ways to see colour.

The *floor* needs no camera: it is the error of the matrix from reflectances at the projector's lines to XYZ. *One
calibration for all*: the middle line's factors serve all lines. *D65*: a lamp of daylight shines on the chart, and its
frame is subtracted. *Mosaic*: all lines are shown at once, behind colour filters. The noise of the subtracted daylight
frame is common to all frames, so that it adds up in the mean over a region; it is therefore the mean of as many shots
as there are patterns.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from mitsim.acquire.capture import expose
from mitsim.acquire.exposure import AmbientFrame, Exposer
from mitsim.acquire.spectral import MosaicFrames, SpectralBench, plan_request
from mitsim.bench.request import Request, SessionRequest, Task
from mitsim.calibrate.calibrate import calibrate_lines
from mitsim.core.arrays import FloatArray
from mitsim.core.colour_files import JOINT, RUN
from mitsim.core.configuration import CAMERA, load_model, locate
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer
from mitsim.devices.framelist import load_chart
from mitsim.devices.patterns import PatternFamily
from mitsim.devices.sensor import SensorModel
from mitsim.light.light import trace_lines
from mitsim.metrics import psnr
from mitsim.optics.frames import Frame
from mitsim.reconstruct.colour import ColourModel, behind, chart, daylight, delta_e, linear_srgb
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.reconstruct.solver import Solution, prepare
from mitsim.report import RENDERED
from mitsim.report.lit_scene import LitScene, peak_time
from mitsim.report.reconstruct_run import MosaicSolver
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.studies.framework.claims import Gain
from mitsim.studies.framework.experiment import IMAGE, TRUTH, Axes, Found, Point, Setup, Study
from mitsim.studies.framework.panels import Bars, Images, Lines
from mitsim.studies.framework.studio import Studio, flags_of, single_precision

# -------- A scene in the light of each line

_SPECTRUM = re.compile(r'value="(\s*[\d.]+\s*:[^"]*)"')
_LAMP = Path(__file__).parent / "templates" / "daylight_lamp.xml"
"""End of a scene file, with a lamp of daylight."""
DAYLIGHT_RADIANCE = 117.0
"""Radiance of the lamp [W m^-2 sr^-1] that lights the sheet as the projector's white does."""
FULL_LX = 2.97 * 205.0
"""Illuminance of that light: 2.97 W/m^2 at the chart's middle, and 205 lm/W of D65 from 380 to 780 nm."""
FILTERS = "ov5647"
"""Camera whose array RGGB of filters lies over the pixels."""


@dataclass(frozen=True, eq=False)
class LitLine:
    """Scene in the light of the line ``name``, and the camera's ``factors`` at this wavelength [nm]."""

    name: str
    wavelength_nm: float
    lit: LitScene
    factors: Factors

    def seed(self, seed: int) -> int:
        return integer(seed, "line", self.name)


def light_lines(studio: Studio, setup: Setup, seed: int) -> tuple[LitLine, ...]:
    """Trace the light of each line of a scene, and calibrate the camera in it."""
    colours = SpectralBench.of(studio.bench(_spectral(setup)), RUN)
    request = Request.of(accuracy=setup.accuracy, seed=seed)
    plan = plan_request(colours.whole, request)
    lighting = colours.whole.family(request.patterns, seed).lighting
    lights = trace_lines(colours.whole, colours.benches, plan, lighting, seed)
    factors = calibrate_lines(colours.whole, SessionRequest(seed=seed, accuracy=setup.accuracy), Task())
    return tuple(
        LitLine(name, light.bench.projector.effective_wavelength_nm, LitScene(light), factors[name])
        for name, light in zip(colours.names, lights, strict=True)
    )


def daylight_frame(studio: Studio, setup: Setup) -> tuple[FloatArray, float]:
    """Return the irradiance (m, m') [W m^-2] of a scene in daylight (D65), and its photons' mean wavelength [nm].

    The scene's spectra are averaged over D65's photons, 380 to 780 nm, for a camera of constant efficiency. MitsimError
    for a scene without spectra.
    """
    own, folder, found = locate(setup.scene, "scenes", "scene.xml"), studio.folder("daylight"), 0
    shutil.copytree(own.parent, folder, dirs_exist_ok=True)

    def even(match: re.Match[str]) -> str:
        pairs = np.array([[float(part) for part in pair.split(":")] for pair in re.split(r"[,\s]+", match[1].strip())])
        photons = daylight(pairs[:, 0]) * pairs[:, 0]
        return f'value="{float((pairs[:, 1] * photons).sum() / photons.sum()):.9g}"'

    for file in folder.glob("*.xml"):
        text, count = _SPECTRUM.subn(even, file.read_text(encoding="utf-8"))
        found += count
        if file.name == own.name:
            lamp = Template(_LAMP.read_text("utf-8")).substitute(radiance=f"{DAYLIGHT_RADIANCE:g}")
            text = text[: text.rindex("</scene>")] + lamp
        file.write_text(text, encoding="utf-8")
    if not found:
        raise MitsimError(
            f"scene {setup.scene}: has no spectra (nm:value), so it looks alike in all lines; give one such as "
            "colour_checker"
        )
    wavelengths = np.arange(380.0, 781.0, 5.0)
    mean = float((daylight(wavelengths) * wavelengths).sum() / daylight(wavelengths).sum())
    bench = studio.bench(replace(_spectral(setup), scene=str(folder / own.name)))
    bench = replace(bench, devices=replace(bench.devices, projector=bench.projector.at(mean)))
    light = bench.light("uniform", accuracy=setup.accuracy)
    return light.merge().frames(bench.family("uniform").lighting, light.seed).projector_off.irradiance, mean


def serving(line: LitLine, other: LitLine) -> Factors:
    own, model = line.factors, other.factors
    gain = 1.0
    for mine, theirs in ((own.left, model.left), (own.right, model.right)):
        gain *= float(np.vdot(mine, theirs) / np.vdot(theirs, theirs))
    root = np.sqrt(gain)
    manifest = model.manifest.model_copy(update={"camera": own.manifest.camera})
    return replace(model, left=root * model.left, right=root * model.right, manifest=manifest, lacking=())


def _spectral(setup: Setup) -> Setup:
    return replace(setup, variant=f"{setup.variant.rpartition('_')[0]}_spectral")


# -------- Filters over the sensor's pixels, and daylight beside the projector


def mosaic_images(lines: Sequence[LitLine], family: PatternFamily, seed: int) -> Solution:
    """Expose all lines at once behind filters, and solve their images (lines, n, n') with the best lambda.

    MitsimError for a line outside the filters' curves.
    """
    bench = lines[0].lit.bench
    units = [electrons_from_irradiance(1.0, 1.0, bench.sensor, line.wavelength_nm) for line in lines]
    passed = behind(filter_weights(lines) * np.array(units) / units[0], bench.geometry.frame_shape)
    expected = MosaicFrames([line.lit.expected_frames(RENDERED, family) for line in lines], passed)
    exposer = Exposer(bench.devices, peak_time(bench, expected), integer(seed, "mosaic"))
    return solve_mosaic(lines, family, exposer.measurements(family, expected))


@single_threaded_blas()
def solve_mosaic(
    lines: Sequence[LitLine], family: PatternFamily, shots: Iterable[tuple[FloatArray, int, int]]
) -> Solution:
    factors = [(line.factors.left, line.factors.right) for line in lines]
    truth = np.stack([line.lit.truth for line in lines]).reshape(len(lines), -1)
    solver = MosaicSolver(
        factors, filter_weights(lines), (family.left.astype(np.float64), family.right.astype(np.float64))
    )
    for each in shots:
        solver.add(*each)
    solved = [solver.solve(float(lam), relative=True)[0] for lam in np.logspace(-9, -3, 13)]
    return max(solved, key=lambda each: psnr(each.image.reshape(truth.shape), truth))


def filter_weights(lines: Sequence[LitLine]) -> FloatArray:
    """Return (4, lines) electrons behind each filter, R, G, G, B, relative to the camera without filters."""
    curves = load_model(locate(FILTERS, "calibration", ".toml", CAMERA), SensorModel)
    sensor = lines[0].lit.bench.sensor
    return np.array(
        [
            [curves.efficiency(line.wavelength_nm, plane) / sensor.efficiency(line.wavelength_nm) for line in lines]
            for plane in ("R", "G", "G", "B")
        ]
    )


@single_threaded_blas()
def daylit_image(line: LitLine, light: tuple[FloatArray, float], lux: float, patterns: str, seed: int) -> Solution:
    bench, family = line.lit.bench, line.lit.bench.family(patterns, seed)
    units = [electrons_from_irradiance(1.0, 1.0, bench.sensor, each) for each in (light[1], line.wavelength_nm)]
    lamp = Frame(lux / FULL_LX * units[0] / units[1] * light[0], 0.0, 0.0, 0.0)
    of_line = line.lit.expected_frames(RENDERED, family)
    expected = MosaicFrames([of_line], np.ones((1, *lamp.irradiance.shape)), lamp)
    exposer = Exposer(bench.devices, peak_time(bench, expected), line.seed(seed))
    shots = 0 if family.signed else len(family.shots)
    off = exposer.rate(AmbientFrame.expose(exposer, expected, shots).digital) if shots else 0.0
    plain = prepare(*line.factors.sides, family.left, family.right, centre=line.factors.manifest.centre)
    model, seen = plain.with_correlation(), exposer.measurements(family, expected)
    return model.solve(model.accumulator((frame - off, row, column) for frame, row, column in seen), "auto")


# -------- The study

OWN, ONE, D65, MOSAIC = "one line at a time", "one calibration for all lines", "beside D65", f"mosaic, {JOINT}"
GOAL = 0.5
_SHOWN = "dots:7"


def _measure(studio: Studio, point: Point) -> Found:
    setup, way, patterns, seed = point.setup, str(point["way"]), str(point["patterns"]), int(point["seed"])
    lines = studio.once("lines", 1, (setup, seed), lambda: light_lines(studio, setup, seed))
    if way == MOSAIC:
        joint = mosaic_images(lines, lines[0].lit.bench.family(patterns, seed), seed)
        images, flags = np.moveaxis(joint.image, 0, -1), flags_of(joint.status)
    else:
        if way == D65:
            light = studio.once("daylight", 1, setup, lambda: daylight_frame(studio, setup))
            solved = [daylit_image(line, light, point["lux"], patterns, seed) for line in lines]
        else:
            factors = [line.factors if way == OWN else serving(line, lines[len(lines) // 2]) for line in lines]
            solved = [
                reconstruct(expose(line.lit.light, patterns, seed=line.seed(seed)), own)
                for line, own in zip(lines, factors, strict=True)
            ]
        images, flags = np.stack([each.image for each in solved], axis=-1), flags_of(*(each.status for each in solved))
    truth = np.stack([line.lit.truth for line in lines], axis=-1)
    board = lines[0].factors.manifest.board_reflectance or 1.0
    return judge_colours(point, [line.wavelength_nm for line in lines], images * board, truth * board, flags)


def judge_colours(
    point: Point, wavelengths: Sequence[float], images: FloatArray, truth: FloatArray, flags: Mapping[str, Any]
) -> Found:
    """Return a row for each patch of the point's chart, and the colours of both images.

    ``images`` and ``truth`` (n, n, lines) are reflectances at the ``wavelengths`` [nm].
    """
    path = Path(point.setup.scene)
    place = load_chart(path.with_name("chart.json") if path.suffix == ".xml" else point.setup.scene)
    known, fixed = chart(), ColourModel.of_lines(wavelengths)
    floor = delta_e(fixed.xyz(known.at(wavelengths)), known.xyz)
    found = delta_e(fixed.xyz(place.means(images)), known.xyz)
    psnr_db = psnr(images.reshape(len(images), -1), truth.reshape(len(images), -1))
    rows = [
        point.row(patch=name, psnr_db=psnr_db, floor=float(least), delta_e=float(own), **flags)
        for name, least, own in zip(known.names, floor, found, strict=True)
    ]
    colours = {IMAGE: linear_srgb(fixed.xyz(images)), TRUTH: linear_srgb(fixed.xyz(truth))}
    return Found(tuple(rows), single_precision(colours))


def _added(claim: str, **where: Any) -> Gain:
    return Gain(f"{claim} at most {GOAL:g} to the floor's mean Delta E 2000", {}, {}, where=where, column="delta_e",
                other_column="floor", unit="", at_least=-np.inf, at_most=GOAL)  # fmt: skip


def _is_point(values: Mapping[str, Any]) -> bool:
    seen = values["patterns"] != "uniform" or values["way"] == OWN
    return bool(seen) and (values["lux"] is not None) == (values["way"] == D65)


_DOTS = {"patterns": _SHOWN}
STUDY = Study(
    "colour",
    "Colours of a ColorChecker",
    "How near are recovered colours to those of the patches' spectra, and what does each way to see colour cost?",
    points=Axes(
        {
            "way": (OWN, ONE, MOSAIC, D65),
            "patterns": ("uniform", _SHOWN, "hadamard:8"),
            "lux": (None, 5.0, 20.0, 60.0, 200.0, 600.0),
        },
        quick={"patterns": (_SHOWN,), "lux": (None, 60.0)},
        prints=(None,), repeats=True, default="colour_checker", kept=_is_point,
    ),
    measure=_measure,
    claims=(
        _added("49 dots add", way=OWN, patterns=_SHOWN),
        replace(_added("Beside D65 of {lux} lx, 49 dots add (markov)", way=D65, lux=(60.0, 600.0), patterns=_SHOWN),
                each="lux"),
        replace(_added("Beside D65 of {lux} lx, 64 Hadamard patterns add (markov)", way=D65, lux=(60.0, 600.0),
                       patterns="hadamard:8"), each="lux", optional=True),
        Gain("Each line needs a calibration of its own (49 dots)", {"way": OWN}, {"way": ONE}, where=_DOTS),
    ),
    panels=(
        Bars("way", file="ways", title="Mean Delta E 2000 of 24 patches, 49 dots", where={**_DOTS, "lux": None},
             colour={"delta_e": "found", "floor": "floor: no camera"}, x_label="mean Delta E 2000 [1]"),
        Lines("lux", "D65 on the chart [lx]", file="daylight", y="delta_e", y_label="mean Delta E 2000 [1]", log=True,
              facet="", where={"way": D65}),
        Images("patterns", down=("way",), where={"way": OWN}, title="Colours by patterns, PSNR of all lines"),
    ),
    about="A chart of known spectra on rendered frames: light of each line traced with diffraction at the mask and "
    "falloff, and the sensor's noise, solved with factors that were calibrated from rendered frames.",
    heads=("", "", "Found"),
)  # fmt: skip

"""A scene with measured spectra in; the same scene in the light of each line of its projector, lit and calibrated, out.

Each line has a bench of its own, with the line's power, diffraction, photons and factors; light of all is traced on the
same paths (:mod:`mitsim.acquire.spectral`). Daylight beside the projector is that of a lamp, in frames of its own.

Three ways to images of the lines are compared (:mod:`mitsim.report.reconstruct_run`), all with factors that were
calibrated line by line, each with its best lambda.

Beside daylight the brightest pixel fills the well in every frame, by daylight too, whose frame is taken off. That
frame's noise is the same in all frames, so in the mean over a region it adds up: it is the mean of as many shots as
there are patterns, which then bring as much noise as the patterns' own frames. (A joint estimate of image and daylight
is a few per cent less noisy; signed patterns need none.)

Of all linear images without bias the least-squares one (lambda = 0) has the least variance (Gauss and Markov). With B =
U S V^T on each side, the mean over a patch of the rows 1_r and columns 1_c has, a = V_L^T 1_r / s_L and b = V_R^T 1_c /
s_R, the variance

    (v |a|^2 |b|^2 + v_0 |(sum_i U_Li) a|^2 |(sum_j U_Rj) b|^2) / pixels^2

with v the variance of a datum and v_0 that of the frame which is taken off.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.acquire.exposure import Exposer
from mitsim.acquire.spectral import SpectralBench, plan_request
from mitsim.api.bench import Bench, open_bench
from mitsim.bench.request import Request, SessionRequest, Task
from mitsim.calibrate.calibrate import calibrate_lines
from mitsim.core import manifests as spectral_manifests
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import CAMERA, load_model, locate
from mitsim.core.errors import MitsimError
from mitsim.core.manifests import RUN
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer
from mitsim.devices.framelist import ChartPlace
from mitsim.devices.patterns import PatternFamily
from mitsim.devices.sensor import SensorModel
from mitsim.light.light import trace_lines
from mitsim.metrics import psnr
from mitsim.reconstruct.colour import behind, daylight
from mitsim.reconstruct.factorisation import Side
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.solution import Solution
from mitsim.reconstruct.solver import Prepared, prepare
from mitsim.report import RENDERED
from mitsim.report.lit_scene import LAMBDAS, LitScene
from mitsim.report.reconstruct_run import LineImages, MosaicCamera, Solver
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.studies.framework.experiment import Setup

_SPECTRUM = re.compile(r'value="(\s*[\d.]+\s*:[^"]*)"')
"""Wavelengths and values, nm:value, as Mitsuba reads them."""
_LAMP = """
    <shape type="rectangle" id="daylight">
        <transform name="to_world">
            <scale x="200" y="80" z="1"/> <rotate x="1" angle="90"/> <translate x="0" y="600" z="300"/>
        </transform>
        <emitter type="area"> <spectrum name="radiance" value="{radiance:g}"/> </emitter>
        <bsdf type="diffuse"> <spectrum name="reflectance" value="0"/> </bsdf>
    </shape>
</scene>"""
"""The lamp of scenes/lamp_bench."""
DAYLIGHT_RADIANCE = 117.0
"""Of the lamp [W m^-2 sr^-1]: it lights the sheet as the projector's white does, 2.97 W/m^2 at its middle."""
Weigh = Callable[[FloatArray, FloatArray], float]
"""From wavelengths [nm] and values of a spectrum to one number."""


@dataclass(frozen=True, eq=False)
class LitLine:
    """A scene in one line's light, and the camera's factors there.

    Attributes
    ----------
    name, wavelength_nm
        of the line [nm].
    lit
        the scene in its light.
    factors
        calibrated in it.
    """

    name: str
    wavelength_nm: float
    lit: LitScene
    factors: Factors

    def seed(self, seed: int) -> int:
        """One of this line's own, from the ``seed`` of all."""
        return integer(seed, "line", self.name)


def light_lines(setup: Setup, seed: int) -> tuple[LitLine, ...]:
    """The scene of a setup in the light of each line.

    Parameters
    ----------
    setup
        the scene, and its projector, whose lines they are.
    seed
        of the light, and of the calibrations' noise.

    Raises
    ------
    MitsimError
        as :meth:`mitsim.bench.apparatus.Bench.capture_lines`.
    """
    colours = SpectralBench.of(_open(setup, locate(setup.scene, "scenes", "scene.xml")), RUN)
    request = Request.of(accuracy=setup.accuracy, seed=seed)
    plan = plan_request(colours.whole, request)
    lighting = colours.whole.family(request.patterns, seed).lighting
    lights = trace_lines(colours.whole, colours.benches, plan, lighting, seed)
    factors = calibrate_lines(colours.whole, SessionRequest(seed=seed, accuracy=setup.accuracy), Task())
    return tuple(
        LitLine(name, light.bench.projector.effective_wavelength_nm, LitScene(light), factors[name])
        for name, light in zip(colours.names, lights, strict=True)
    )


def daylight_frame(setup: Setup, folder: Path) -> tuple[FloatArray, float]:
    """What the camera sees of a scene in a lamp's daylight (D65) with the projector off.

    Its spectra count as D65's photons do, 380 to 780 nm, in a camera of equal efficiency for all of them.

    Parameters
    ----------
    setup
        a scene with spectra.
    folder
        for scene files.

    Returns
    -------
    irradiance, wavelength_nm
        (m, m') [W m^-2], and the wavelength whose photons carry as much energy.
    """

    def weigh(at: FloatArray, values: FloatArray) -> float:
        photons = daylight(at) * at
        return float((values * photons).sum() / photons.sum())

    scene = replace_spectra(setup.scene, folder / "daylight", weigh)
    text = scene.read_text(encoding="utf-8")
    end = text.rindex("</scene>")
    scene.write_text(text[:end] + _LAMP.format(radiance=DAYLIGHT_RADIANCE), encoding="utf-8")
    wavelengths = np.arange(380.0, 781.0, 5.0)
    mean = float((daylight(wavelengths) * wavelengths).sum() / daylight(wavelengths).sum())
    bench = _open(setup, scene)
    bench = replace(bench, devices=replace(bench.devices, projector=bench.projector.at(mean)))
    light = bench.light("uniform", accuracy=setup.accuracy)
    return light.merge().frames(bench.family("uniform").lighting, light.seed).projector_off.irradiance, mean


def replace_spectra(scene: str, folder: Path, weigh: Weigh) -> Path:
    """A copy of a scene whose spectra are single numbers; its XML.

    Parameters
    ----------
    scene
        shipped name, or path.
    folder
        new, for the copy.
    weigh
        from a spectrum to its number.

    Raises
    ------
    MitsimError
        for a scene without spectra.
    """
    own = locate(scene, "scenes", "scene.xml")
    shutil.copytree(own.parent, folder)
    found = 0

    def number(match: re.Match[str]) -> str:
        pairs = np.array([[float(part) for part in pair.split(":")] for pair in re.split(r"[,\s]+", match[1].strip())])
        return f'value="{weigh(pairs[:, 0], pairs[:, 1]):.9g}"'

    for file in folder.glob("*.xml"):
        text, count = _SPECTRUM.subn(number, file.read_text(encoding="utf-8"))
        file.write_text(text, encoding="utf-8")
        found += count
    if not found:
        raise MitsimError(
            f"scene {scene}: has no spectra (nm:value), so it looks alike in all lines; give one such as colour_checker"
        )
    return folder / own.name


def serving(line: LitLine, other: LitLine) -> Factors:
    """The factors of an ``other`` line, said to be of a ``line``, with the gain that is nearest to its own factors."""
    own, model = line.factors, other.factors
    gain = 1.0
    for mine, theirs in ((own.left, model.left), (own.right, model.right)):
        gain *= float(np.vdot(mine, theirs) / np.vdot(theirs, theirs))
    root = np.sqrt(gain)
    manifest = model.manifest.model_copy(update={"camera": own.manifest.camera})
    return replace(model, left=root * model.left, right=root * model.right, manifest=manifest, lacking=())


def _open(setup: Setup, scene: Path) -> Bench:
    parameters: dict[str, Any] = dict(setup.parameters)
    variant = f"{setup.variant.rpartition('_')[0]}_spectral"
    return open_bench(scene, variant, setup.camera, setup.projector, setup.outside, **parameters)


# -------- Light of each line in, and filters over the sensor's pixels

DEMOSAICED, HALF, JOINT = "demosaiced", "half resolution", "joint"
WAYS = {DEMOSAICED: spectral_manifests.DEMOSAIC, HALF: spectral_manifests.HALF, JOINT: spectral_manifests.JOINT}
"""Names in tables, and those of the ways."""
FILTERS, ARRAY = "ov5647", "RGGB"
"""Camera file whose measured curves the filters have, and their array."""
_COARSE = tuple(float(relative) for relative in np.logspace(-9, -3, 7))
"""Lambdas of the joint solve, of its largest eigenvalue; the best of them is refined by half a decade."""
Lines = Sequence[LitLine]


def available_ways() -> tuple[str, ...]:
    """Those of :data:`WAYS` that are: demosaicing is an extra."""
    return tuple(name for name, way in WAYS.items() if way in spectral_manifests.installed_ways())


@dataclass(frozen=True, eq=False)
class MosaicShots:
    """One noisy exposure of a family on a sensor with filters.

    Attributes
    ----------
    lines
        light and factors of each line.
    family
        the patterns.
    frames
        (frame (m, m') [electrons/s], row, column) of every pattern.
    """

    lines: Lines
    family: PatternFamily
    frames: tuple[tuple[FloatArray, int, int], ...]

    @property
    def truth(self) -> FloatArray:
        """(lines, n, n') reflectance at each line."""
        return np.stack([line.lit.truth for line in self.lines])

    def images(self, way: str) -> LineImages:
        """Solve the images of all lines by a ``way``, one of :data:`WAYS`, with the best lambda for the truth.

        MitsimError for demosaicing without colour-demosaicing.
        """
        patterns = self.family.left.astype(np.float64), self.family.right.astype(np.float64)
        solver = Solver(WAYS[way], self.camera, patterns)
        with single_threaded_blas():
            return self._best(solver, way)

    def _best(self, solver: Solver, way: str) -> LineImages:
        for each in self.frames:
            solver.add(*each)
        flat, solved = self.truth.reshape(len(self.lines), -1), dict[float, LineImages]()

        def quality(lam: float) -> float:
            if lam not in solved:
                solved[lam] = solver.images(lam, relative=True)
            return psnr(solved[lam].images.reshape(flat.shape), flat)

        best = max(_COARSE if way == JOINT else LAMBDAS, key=quality)
        if way == JOINT:
            best = max((best, best * 10**0.5, best / 10**0.5), key=quality)
        return solved[best]

    @cached_property
    def camera(self) -> MosaicCamera:
        """Factors of all lines, and filters."""
        factors = [(line.factors.left, line.factors.right) for line in self.lines]
        return MosaicCamera.of(factors, filter_weights(self.lines), ARRAY)


def mosaic_shots(lines: Lines, patterns: str, seed: int) -> MosaicShots:
    """All lines shown at once, at equal peak, on the scene's camera behind filters.

    Parameters
    ----------
    lines
        light and factors of each line.
    patterns, seed
        the family, and seed of the noise.

    Raises
    ------
    MitsimError
        for a line that the filters' curves do not hold.
    """
    first, family = lines[0].lit, lines[0].lit.bench.family(patterns, seed)
    devices, weights = first.bench.devices, filter_weights(lines)
    # Light, and what is noise of a shot, is of electrons: any time and wavelength between them.
    one_second = [Exposer(line.lit.bench.devices, 1.0, 0) for line in lines]
    expected = [line.lit.expected_frames("rendered", family) for line in lines]
    passed = behind(weights, devices.camera.frame_shape)
    rates = [
        np.einsum("lij,lij->ij", passed, [unit.electrons(frame) for unit, frame in zip(one_second, shot, strict=True)])
        for shot in zip(*expected, strict=True)
    ]
    frames = expose_rates(Exposer(devices, peak_seconds(devices.sensor, rates), integer(seed, "mosaic")), family, rates)
    return MosaicShots(lines, family, tuple(frames))


def peak_seconds(sensor: SensorModel, rates: Sequence[FloatArray]) -> float:
    """Exposure time [s] at equal peak: of expected ``rates`` [electrons/s] and dark current the brightest pixel fills
    the default part of the ``sensor``'s full well."""
    from mitsim.bench.request import Exposure

    most = max(float(rate.max()) for rate in rates) + sensor.superpixel_dark_current_e_per_s
    return float(Exposure().fraction * sensor.superpixel_full_well_e / most)


def expose_rates(
    exposer: Exposer, family: PatternFamily, rates: Sequence[FloatArray], ambient: FloatArray | float = 0.0
) -> Iterator[tuple[FloatArray, int, int]]:
    """Noisy measurement (m, m') [electrons/s] of each pattern, and its indices.

    Parameters
    ----------
    exposer
        the camera.
    family
        of patterns; the halves of a signed one come as their difference.
    rates
        (m, m') expected electrons a second of each shot.
    ambient
        what is taken off every shot that is not one of a pair.
    """
    positive: FloatArray | None = None
    for shot, rate in zip(family.shots, rates, strict=True):
        noisy = exposer.rate(exposer.digital(rate * exposer.exposure_s, *shot.names))
        if shot.sign == 1:
            positive = noisy
            continue
        yield noisy - ambient if positive is None else positive - noisy, shot.row, shot.column
        positive = None


def filter_weights(lines: Lines) -> FloatArray:
    """(4, lines) electrons behind each filter of :data:`ARRAY` over those of the ``lines``' camera without filters."""
    curves = load_model(locate(FILTERS, "calibration", ".toml", CAMERA), SensorModel)
    sensor = lines[0].lit.bench.sensor
    return np.array(
        [
            [curves.efficiency(line.wavelength_nm, plane) / sensor.efficiency(line.wavelength_nm) for line in lines]
            for plane in ("R", "G", "G", "B")
        ]
    )


# -------- Daylight beside a line

LUMENS_A_WATT = 205.0
"""Of D65, 380 to 780 nm."""
FULL_LX = 2.97 * LUMENS_A_WATT
"""Illuminance of daylight as bright as the projector's white light, which is 2.97 W/m^2 on the chart's middle."""


_DRAWS = 400
"""Of the errors of all patches, of which a mean is taken: its standard error is some 0.5 % of what they add."""
Judge = Callable[[FloatArray], FloatArray]
"""From means (..., patches, lines) to Delta E (..., patches)."""


@dataclass(frozen=True, eq=False)
class DaylitLine:
    """Frames of a line before any exposure.

    Attributes
    ----------
    line
        the scene in its light.
    family
        the patterns.
    lamp
        (m, m') electrons a second of daylight as bright as the projector.
    """

    line: LitLine
    family: PatternFamily
    lamp: FloatArray

    @classmethod
    def of(cls, line: LitLine, light: tuple[FloatArray, float], patterns: str, seed: int) -> DaylitLine:
        """Those of a line beside daylight.

        Parameters
        ----------
        line, patterns, seed
            the scene, the family, and its seed.
        light
            irradiance (m, m') [W m^-2] of daylight as bright as the projector, and wavelength [nm] of its photons.
        """
        bench = line.lit.bench
        return cls(line, bench.family(patterns, seed), electrons_from_irradiance(light[0], 1.0, bench.sensor, light[1]))

    def rates(self) -> list[FloatArray]:
        """(m, m') electrons a second of every shot in the dark."""
        unit = Exposer(self.line.lit.bench.devices, 1.0, 0)
        return [unit.electrons(frame) for frame in self.line.lit.expected_frames(RENDERED, self.family)]

    @cached_property
    def levels(self) -> tuple[FloatArray, float]:
        """(m, m') the brightest shot at each pixel in the dark, and the mean of all [electrons/s]."""
        rates = self.rates()
        return np.maximum.reduce(rates), float(np.mean([rate.mean() for rate in rates]))

    @cached_property
    def model(self) -> Prepared:
        """The factorised model."""
        factors, family = self.line.factors, self.family
        with single_threaded_blas():
            return prepare(*factors.sides, family.left, family.right, centre=factors.manifest.centre)

    @property
    def shots(self) -> int:
        """Shots of the frame that is taken off: as many as patterns."""
        return 0 if self.family.signed else len(self.family.shots)

    def seconds(self, part: float) -> float:
        """Exposure time [s] of each shot in daylight that is so bright a ``part`` of the projector's light."""
        return peak_seconds(self.line.lit.bench.sensor, [self.levels[0] + part * self.lamp])

    def images(
        self, exposures: Sequence[tuple[float, int]], models: Sequence[Prepared], shots: int
    ) -> list[list[Solution]]:
        """Solve each noisy exposure of all patterns by each of some models, with automatic lambda.

        Parameters
        ----------
        exposures
            part of daylight, as for :meth:`seconds`, and seed of the noise, of each.
        models
            the factorised model, and others of the same frames.
        shots
            of the frame that is taken off.
        """
        rates = self.rates()
        with single_threaded_blas():
            return [self._images(rates, each, models, shots) for each in exposures]

    def _images(
        self, rates: Sequence[FloatArray], exposure: tuple[float, int], models: Sequence[Prepared], shots: int
    ) -> list[Solution]:
        lamp, sums = exposure[0] * self.lamp, [model.accumulator() for model in models]
        exposer = Exposer(self.line.lit.bench.devices, self.seconds(exposure[0]), self.line.seed(exposure[1]))
        off: FloatArray | float = 0.0
        for shot in range(shots):
            off = off + exposer.rate(exposer.digital(lamp * exposer.exposure_s, "ambient", shot)) / shots
        for measured in expose_rates(exposer, self.family, [rate + lamp for rate in rates], off):
            for each in sums:
                each.add(*measured)
        return [model.solve(each, "auto") for model, each in zip(models, sums, strict=True)]

    def least_variance(self, part: float, place: ChartPlace) -> FloatArray:
        """(patches,) least variance of the means over a chart's patches that an image without bias has.

        Parameters
        ----------
        part
            of daylight, as for :meth:`seconds`.
        place
            of the patches.
        """
        bench, seconds, lamp = self.line.lit.bench, self.seconds(part), part * self.lamp
        exposer, read = Exposer(bench.devices, seconds, 0), 2 if self.family.signed else 1
        frames, off = ((exposer.sensor_noise((light + lamp) * seconds) / seconds) ** 2 for light in (self.levels[1], 0))
        own, common = self._noise_gain(place)
        return read * frames * own + (off / self.shots * common if self.shots else 0.0)

    def _noise_gain(self, place: ChartPlace) -> tuple[FloatArray, FloatArray]:
        """(patches,) variances of means over a unit of noise in every frame, and in what is taken off all of them."""
        both = []
        for top, bottom, first, last in place.patches:
            sides = _weights(self.model.left, top, bottom), _weights(self.model.right, first, last)
            both.append(np.prod(sides, axis=0) / ((bottom - top) * (last - first)) ** 2)
        own, common = np.array(both).T
        return own, common


def _weights(side: Side, first: int, end: int) -> tuple[float, float]:
    """|a|^2 and |(sum_i U_i) a|^2 of the mean over scene rows ``first`` up to ``end``."""
    a = np.divide(
        side.basis[first:end].sum(axis=0), side.singular, out=np.zeros_like(side.singular), where=side.singular > 0
    )
    return float(a @ a), float(np.square(side.common @ a).sum())


def expected_delta_e(means: FloatArray, variances: FloatArray, judged: Judge) -> float:
    """Mean Delta E that patches come to whose means have independent normal errors.

    Parameters
    ----------
    means, variances
        (patches, lines) without error, and of the error.
    judged
        from means (..., patches, lines) to Delta E.
    """
    errors = np.random.default_rng(0).standard_normal((_DRAWS, *means.shape))
    return float(judged(means + np.sqrt(variances) * errors).mean())


def most(keeps: Callable[[float], bool], low: float, high: float) -> float:
    """The largest number that is kept, to 1 %; 0 where none is.

    Parameters
    ----------
    keeps
        whether a number is; all below one are, none above.
    low, high
        ends of where it is looked for, above 0.
    """
    if keeps(high):
        return high
    if not keeps(low):
        return 0.0
    while high > 1.01 * low:
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if keeps(middle) else (low, middle)
    return low

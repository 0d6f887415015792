"""Where points of a study are measured: setups in; light, factors and images out, kept while neighbours share them."""

from __future__ import annotations

import shutil
import tempfile
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from skimage import io

from mitsim.capture.ambient import taken_off
from mitsim.capture.bench import Bench, open_bench
from mitsim.capture.exposer import Exposer
from mitsim.capture.light import Light
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import locate
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas
from mitsim.optics.frames import ExpectedFrames
from mitsim.reconstruct.accumulator import Accumulator
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruction import reconstruct
from mitsim.reconstruct.solver import Prepared, prepare
from mitsim.rig.patterns import PatternFamily
from mitsim.study.compare import CONVENTIONS, peak_time
from mitsim.study.experiment import Setup
from mitsim.study.ideal import IdealCamera
from mitsim.study.metrics import Quality, psnr
from mitsim.study.pictures import picture
from mitsim.study.table import Value

Kept = TypeVar("Kept")
EQUAL_PEAK, EQUAL_FRAME, EQUAL_TOTAL = CONVENTIONS
IDEALISED, RENDERED = MODELS = ("idealised", "rendered")
"""The paper's model of a scene, with its own exact factors; and light that is rendered, with calibrated factors."""
LAMBDAS = tuple(float(relative) for relative in np.logspace(-14, 0, 57))
"""Of the largest sigma^2: where none can be chosen by the data, the best of these, a quarter of a decade apart."""
_PRINT = "reflectance.png"
"""What a scene with a print of its own has beside it."""


@dataclass(frozen=True, eq=False)
class Image:
    """One reconstruction and how good it is.

    Attributes
    ----------
    image, quality, lam
        (n, n) reflectance, against the truth, and lambda.
    shots, exposure_s
        frames, and seconds of each.
    flagged
        whether its run or the solver warned.
    trust
        where it is known: the unexplained part of the measurements, their chi-square, the image's standard uncertainty.
    """

    image: FloatArray
    quality: Quality
    lam: float
    shots: int
    exposure_s: float
    flagged: bool
    trust: Mapping[str, float | None] = field(default_factory=dict)

    def row(self) -> dict[str, Value]:
        """As a table has it."""
        return {
            "psnr_db": self.quality.psnr_db,
            "ssim": self.quality.ssim,
            "lambda": self.lam,
            "shots": self.shots,
            "exposure_s": self.exposure_s,
            "flagged": self.flagged,
            **self.trust,
        }


class Studio:
    """Benches, their light and their factors, the last few of each; a temporary folder holds scenes with other prints.

    To be used as a context, which removes that folder.
    """

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="mitsim-study-")
        self._kept: dict[str, OrderedDict[Hashable, Any]] = {}

    def __enter__(self) -> Studio:
        return self

    def __exit__(self, *_: object) -> None:
        self._kept.clear()
        self._folder.cleanup()

    def bench(self, setup: Setup) -> Bench:
        """The bench of a ``setup``.

        MitsimError as :func:`mitsim.open_bench`, and for another print on a scene that has none.
        """
        return self._once("bench", 3, setup, lambda: self._opened(setup))

    def scene(self, setup: Setup) -> Scene:
        """Light and truth of a ``setup``."""
        return self._once("scene", 1, setup, lambda: Scene(self.bench(setup), setup.accuracy))

    def factors(self, setup: Setup, seed: int) -> Factors:
        """What a session with the camera of a ``setup`` estimates, its noise from ``seed``; whatever is printed."""
        blank = setup.printed(None)
        return self._once("factors", 4, (blank, seed), lambda: self.bench(blank).calibrate(seed))

    def shoot(self, setup: Setup, model: str, patterns: str | PatternFamily, seed: int = 0) -> Shoot:
        """Frames of a family before the sensor, with all that makes images of them.

        Parameters
        ----------
        setup, model, seed
            as for :meth:`image`.
        patterns
            the family, or its name.
        """
        scene = self.scene(setup)
        family = scene.bench.family(patterns, seed) if isinstance(patterns, str) else patterns
        if model == RENDERED:
            return scene.rendered_shoot(self.factors(setup, seed), family, seed)
        return scene.idealised_shoot(family, seed)

    def image(self, setup: Setup, model: str, patterns: str, seed: int = 0, exposure: str = EQUAL_PEAK) -> Image:
        """A scene as it comes out.

        Parameters
        ----------
        setup
            the scene.
        model
            one of :data:`MODELS`.
        patterns
            the family.
        seed
            of the frames' noise, and of the calibration's.
        exposure
            one of :data:`mitsim.study.compare.CONVENTIONS`.
        """
        scene = self.scene(setup)
        if model == RENDERED:
            return scene.rendered(self.factors(setup, seed), patterns, seed, exposure)
        return scene.idealised(patterns, seed, exposure)

    def _opened(self, setup: Setup) -> Bench:
        path = setup.scene if setup.picture is None else self._printed(setup.scene, setup.picture)
        parameters: dict[str, Any] = dict(setup.parameters)
        return open_bench(path, setup.variant, setup.camera, setup.projector, setup.outside, **parameters)

    def _printed(self, scene: str, name: str) -> Path:
        """A copy of a ``scene`` with the picture ``name`` for its print."""
        own = locate(scene, "scenes", "scene.xml")
        if not (own.parent / _PRINT).is_file():
            raise MitsimError(
                f"scene {scene}: has no {_PRINT} beside it, so there is no print to replace; keep its own"
            )
        place = Path(self._folder.name) / own.parent.name / name
        if not place.exists():
            shutil.copytree(own.parent, place)
            io.imsave(place / _PRINT, picture(name), check_contrast=False)
        return place / own.name

    def _once(self, kind: str, most: int, key: Hashable, make: Callable[[], Kept]) -> Kept:
        kept = self._kept.setdefault(kind, OrderedDict())
        if key not in kept:
            while len(kept) >= most:
                kept.popitem(last=False)  # before the new one is made: two lights need not fit
            kept[key] = make()
        kept.move_to_end(key)
        found: Kept = kept[key]
        return found


class Scene:
    """A bench in its light: images of any family, at any exposure.

    Parameters
    ----------
    bench, accuracy
        what is lit, and how well its light is known.
    """

    def __init__(self, bench: Bench, accuracy: float) -> None:
        self.bench, self.accuracy = bench, accuracy

    @cached_property
    def light(self) -> Light:
        """By projector pixel."""
        return self.bench.light(accuracy=self.accuracy)

    @property
    def truth(self) -> FloatArray:
        """(n, n) apparent reflectance."""
        return self.light.truth

    def rendered(self, factors: Factors, patterns: str, seed: int, exposure: str) -> Image:
        """As a user's own frames are exposed and reconstructed.

        Parameters
        ----------
        factors
            of the camera.
        patterns, seed, exposure
            as for :meth:`Studio.image`.
        """
        seconds = "auto" if exposure == EQUAL_PEAK else self._seconds(patterns, exposure)
        shots = self.light.expose(patterns, seed=seed, exposure=seconds)
        found = reconstruct(shots, factors)
        quality = Quality.of(found.image, self.truth, self.light.apparent.error)
        count, flagged = len(shots.manifest.patterns.captures), not found.ok
        misfit, told = found.misfit, found.uncertainty
        trust = {
            "misfit": misfit.unexplained if misfit else None,
            "chi_square": misfit.chi_square if misfit else None,
            "uncertainty": None if told is None else float(np.sqrt(np.square(told).mean())),
        }
        return Image(found.image, quality, found.lam, count, shots.exposure_s, flagged, trust)

    def idealised(self, patterns: str, seed: int, exposure: str) -> Image:
        """The paper's model, with its own factors and the same sensor.

        Parameters
        ----------
        patterns, seed, exposure
            as for :meth:`Studio.image`.
        """
        shoot = self.idealised_shoot(self.bench.family(patterns, seed), seed)
        uniform = shoot if exposure == EQUAL_PEAK else self.idealised_shoot(self.bench.family("uniform"), seed)
        return shoot.image(uniform.peak_s / (len(shoot.family.shots) if exposure == EQUAL_TOTAL else 1))

    def rendered_shoot(self, factors: Factors, family: PatternFamily, seed: int) -> Shoot:
        """As :meth:`Studio.shoot`, of rendered light.

        Parameters
        ----------
        factors
            of the camera.
        family, seed
            the patterns, and seed of the noise.
        """
        light = self.light
        expected = light.merged().frames(family.lighting, light.seed)
        sides, centre = (factors.left, factors.right), factors.manifest.centre
        return Shoot(self, family, expected, sides, centre, seed, light.simulation.physics.speckle)

    def idealised_shoot(self, family: PatternFamily, seed: int) -> Shoot:
        """As :meth:`Studio.shoot`, of the paper's model.

        Parameters
        ----------
        family, seed
            the patterns, and seed of the noise.
        """
        camera, flux = self._ideal, float(self.light.apparent.board_flux.mean())
        expected = camera.frames(family, self.truth * flux)
        # Its noise is not that of the rendered frames.
        return Shoot(self, family, expected, camera.calibrated(flux), camera.centre, seed + 1)

    def _seconds(self, patterns: str, exposure: str) -> float:
        """Exposure time [s] of each shot where uniform light fills the full well as far as it may."""
        return self._uniform_s / (len(self.bench.family(patterns).shots) if exposure == EQUAL_TOTAL else 1)

    @cached_property
    def _uniform_s(self) -> float:
        frames = self.light.merged().frames(self.bench.family("uniform").lighting, self.light.seed)
        return peak_time(self.bench, frames)

    @cached_property
    def _ideal(self) -> IdealCamera:
        return IdealCamera(self.bench, self.bench.geometry.mask)


@dataclass(frozen=True, eq=False)
class Shoot:
    """Frames of a ``scene`` under a ``family`` as they are ``expected`` without noise, and what makes images of them.

    Attributes
    ----------
    scene, family, expected
        what is seen.
    sides, centre
        left and right factor that are assumed, and whether means are taken out of frames.
    seed, speckle
        of the noise, and contrast of laser speckle.
    """

    scene: Scene
    family: PatternFamily
    expected: ExpectedFrames
    sides: tuple[FloatArray, FloatArray]
    centre: bool
    seed: int
    speckle: float = 0.0

    @cached_property
    def peak_s(self) -> float:
        """Exposure time [s] at equal peak."""
        return peak_time(self.scene.bench, self.expected)

    def model(self, binning: int = 1) -> Prepared:
        """The factorised model of frames whose pixels are averaged ``binning`` x ``binning``."""
        left, right = (side.reshape(-1, binning, side.shape[1]).mean(axis=1) for side in self.sides)
        return prepare(left, right, self.family.left, self.family.right, centre=self.centre)

    def noise(self, seconds: float) -> float:
        """Standard deviation of a datum [electrons/s], rms over all frames, of exposures of so many ``seconds``."""
        exposer, sensor = Exposer(self.scene.bench.rig, seconds, self.seed), self.scene.bench.sensor
        rounding = 0.0 if sensor.bits is None else 1 / (12 * sensor.gain_dn_per_e**2)
        read = sensor.superpixel_read_noise_e**2 + sensor.superpixel_dark_current_e_per_s * seconds + rounding
        variances = [exposer.electrons(frame).mean() + read for frame in self.expected]
        return float(np.sqrt(np.mean(variances))) / seconds

    def image(self, seconds: float, lam: float | Literal["auto", "best"] = "auto", binning: int = 1) -> Image:
        """What one exposure of the frames comes to.

        Parameters
        ----------
        seconds
            exposure time of each frame.
        lam
            lambda; best: that of :data:`LAMBDAS` which is nearest to the truth.
        binning
            pixels a side that are averaged.
        """
        model, sums = self.data(seconds, binning)
        scale = model.problem(sums).scale
        tried = [scale * relative for relative in LAMBDAS] if lam == "best" else [lam]
        truth, error = self.scene.truth, self.scene.light.apparent.error
        solved = [model.solve(sums, each) for each in tried]
        best = max(solved, key=lambda one: psnr(one.image, truth))
        good = best.status.verdict.good
        quality = Quality.of(best.image, truth, error)
        return Image(best.image, quality, best.lam, len(self.family.shots), seconds, not good)

    def data(self, seconds: float, binning: int = 1) -> tuple[Prepared, Accumulator]:
        """The factorised model, and one noisy exposure of all frames added up for it.

        Parameters
        ----------
        seconds, binning
            as for :meth:`image`.
        """
        model = self.model(binning)
        exposer = Exposer(self.scene.bench.rig, seconds, self.seed, self.speckle)
        sums, family, expected = model.accumulator(), self.family, self.expected
        with single_threaded_blas():
            ambient = taken_off(exposer, family, expected)
            for measurement, row, column in exposer.measurements(family, expected):
                frame = measurement - ambient
                size = len(frame) // binning
                sums.add(frame.reshape(size, binning, size, binning).mean(axis=(1, 3)), row, column)
        return model, sums

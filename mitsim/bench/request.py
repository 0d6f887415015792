"""What is asked of a bench: one model for the command line's options, the arguments of Python, and the manifest.

Arguments that travel together are one value: :class:`Request` is what a capture is to show, :class:`SessionRequest`
what a calibration is to find, and :class:`Task` where results go and who watches the work.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict

from pydantic import AfterValidator, BeforeValidator

from mitsim.bench.effects import check_switches, parse_switches
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.files import check_plain
from mitsim.core.job import Job
from mitsim.core.options import QUALITY, Options, option
from mitsim.core.seeds import check_root
from mitsim.core.worker import pause_collector
from mitsim.devices.patterns import pattern_names, read_name
from mitsim.devices.sensor import EXPOSURE_FRACTION, EXPOSURE_S, SensorModel
from mitsim.devices.session import SessionRecipe

if TYPE_CHECKING:
    from mitsim.devices.camera import Devices

LOWEST_ACCURACY, HIGHEST_ACCURACY = 1e-6, 0.3
"""Below, single precision in the renderer (6e-8 a connection) and the pilot's samples tell nothing; above, no frame is
worth its name."""
LONGEST_S = 1e6
"""Seconds that may be asked for: eleven days, far beyond what any accuracy takes."""
PSNR_DB = 1.0, 100.0
"""PSNR that may be asked of an image: below, its error is its whole range; above, the truth is not known."""
REFERENCE, FACTORED = ESTIMATORS = ("reference", "factored")
"""Of the expected irradiance."""
VIEWS = (".png", ".html")
"""Endings of files that a bench is drawn in: a picture, and a page."""
FEWEST_PASSES = 4
"""Passes of the reference are compared to tell the noise; four tell it to 40 %."""
MOST_SAMPLES = 2**20
"""An error of a thousandth of one sample's: an hour a pixel row, beyond use."""
_LEAST_NOISE = 1e-3
"""Rendering noise of a thousandth of the sensor's adds a millionth to its variance: sampling beyond buys nothing."""


@dataclass(frozen=True)
class Task:
    """Where the results of a work go, and how it is watched; of no influence on them.

    Attributes
    ----------
    output
        folder that is written; None keeps them in memory.
    resume
        whether to go on with what an interrupted work left there.
    job
        clock, progress and limits.
    """

    output: Path | None = None
    resume: bool = False
    job: Job = field(default_factory=Job)

    @classmethod
    def of(cls, output: Path | str | None = None, resume: bool = False, job: Job | None = None) -> Task:
        """Of the Python face's arguments.

        Parameters
        ----------
        output, resume, job
            as there.
        """
        return cls(None if output is None else Path(output), resume, job or Job())

    @contextmanager
    def importing(self) -> Iterator[None]:
        """The stage "imports" of the job's clock."""
        with self.job.clock.stage("imports"), pause_collector():
            yield


@dataclass(frozen=True)
class Exposure:
    """One exposure for a whole session: ``seconds`` by hand, or the brightest pixel at ``fraction`` of full well."""

    seconds: float | None = None
    fraction: float = 0.8

    def __post_init__(self) -> None:
        if self.seconds is not None:
            _check_range("exposure", self.seconds, *EXPOSURE_S, "{} seconds, or auto")
        _check_range("exposure_fraction", self.fraction, *EXPOSURE_FRACTION, "a part of the full well, {}")

    def check(self, sensor: SensorModel, camera_file: Path | str) -> None:
        """MitsimError when the ``sensor``, of a ``camera_file``, sees through colour filters, whose frames are captured
        otherwise, or the time is to follow from a full well that it does not have."""
        if sensor.mosaic is not None:
            raise MitsimError(
                f"camera {camera_file}: has a mosaic {sensor.mosaic}, whose frames show all lines at once; "
                "capture and calibrate by --colour mosaic (capture_mosaic, calibrate_mosaic), make pairs by another"
            )
        if self.seconds is None and not math.isfinite(sensor.full_well_e):
            raise MitsimError(
                f"camera {camera_file}: full_well_e is inf, so there is no full well to fill; "
                "give a finite one, or an exposure in seconds"
            )

    def choose(self, devices: Devices, peak_irradiance: float) -> float:
        """Exposure time [s] of ``devices`` for frames whose brightest expected pixel has ``peak_irradiance``
        [W m^-2]."""
        if self.seconds is not None:
            return self.seconds
        from mitsim.sensor.chain import exposure_for_peak  # here: it needs numpy, and checking a request does not

        wavelength = devices.projector.effective_wavelength_nm
        return exposure_for_peak(peak_irradiance, self.fraction, devices.sensor, wavelength)


def _check_range(name: str, value: float, least: float, most: float, rule: str) -> float:
    """``value``, or ArgumentError with the ``rule``, which has {} in place of the least and the most."""
    if not least <= value <= most:
        raise ArgumentError(name, f"{value}: give {rule.format(f'{least:g} to {most:g}')}")
    return value


def check_accuracy(accuracy: float) -> float:
    """``accuracy``, or ArgumentError when it is outside what the estimator can promise."""
    return _check_range("accuracy", accuracy, LOWEST_ACCURACY, HIGHEST_ACCURACY, "a relative error from {}")


def check_psnr(psnr: float) -> float:
    """``psnr`` [dB], or ArgumentError when no image of worth has it."""
    return _check_range("psnr", psnr, *PSNR_DB, "{} dB")


def check_samples(estimator: str, spp: int | None) -> None:
    """ArgumentError for an ``estimator`` that there is not, or too few or too many samples ``spp`` a pixel of the
    reference; None: those of the scene."""
    if estimator not in ESTIMATORS:
        raise ArgumentError("estimator", f"{estimator!r}: use {' or '.join(ESTIMATORS)}")
    if estimator == REFERENCE and spp is not None and not FEWEST_PASSES <= spp <= MOST_SAMPLES:
        raise ArgumentError("spp", f"{spp}: give at least {FEWEST_PASSES} samples a pixel, at most {MOST_SAMPLES}")


def check_untimed(seconds: float | None) -> None:
    """ArgumentError where a run in colour is to take so many ``seconds``."""
    if seconds is not None:
        raise ArgumentError(
            "seconds", f"{seconds:g}: runs in colour are not planned by time; give an accuracy, or leave colour out"
        )


def _switches(effects: object) -> object:
    return parse_switches(effects) if isinstance(effects, str) else effects


def _of_a_family(patterns: str) -> str:
    read_name(patterns)
    return patterns


def _some_time(seconds: float) -> float:
    if not 0 < seconds <= LONGEST_S:
        raise ArgumentError("seconds", f"{seconds:g}: give a number above 0, at most {LONGEST_S:g}")
    return seconds


def _worth_it(fraction: float) -> float:
    return _check_range("noise_fraction", fraction, _LEAST_NOISE, 1, "a part of the sensor's noise from {}")


def _some_shots(shots: int) -> int:
    from mitsim.core.manifests import MOST_SHOTS  # here: it takes 7 ms to import, and most requests have no shots

    _check_range("ambient_shots", shots, 1, MOST_SHOTS, "{} shots, or none for the patterns' own")
    return shots


class Seeded(Options):
    """The root of all random streams."""

    seed: Annotated[int, AfterValidator(check_root)] = option(0, "root of every random stream", panel=QUALITY)


class SeedKeys(TypedDict, total=False):
    """Keywords of :class:`Seeded`, for type checkers; tests/test_verbs.py compares such classes with their models."""

    seed: int


class SampledKeys(SeedKeys, total=False):
    """Keywords of :class:`Sampled`."""

    accuracy: float


class SessionKeys(SampledKeys, total=False):
    """Keywords of :class:`SessionRequest`."""

    recipe: SessionRecipe | None


class ExposureKeys(SampledKeys, total=False):
    """Keywords of :class:`Request`, without the patterns."""

    exposure: float | Literal["auto"]
    exposure_fraction: float
    seconds: float | None
    effects: dict[str, bool] | str
    noise_fraction: float | None
    ambient_frame: Literal["auto", "yes", "no"]
    ambient_shots: int | None
    closing_frame: Literal["first", "uniform"] | None


class Sampled(Seeded):
    """How finely light is sampled."""

    accuracy: Annotated[float, AfterValidator(check_accuracy)] = option(
        1e-3, "relative rms error of the expected frames", panel=QUALITY
    )


class Timed(Seeded):
    """How long the camera is exposed."""

    exposure: float | Literal["auto"] = option("auto", "seconds a frame, or auto", metavar="auto|SECONDS")
    exposure_fraction: float = option(0.8, "brightest pixel, as a part of full well", metavar="PART")


class Request(Sampled, Timed):
    """Which shots of a scene are wanted, and how well."""

    patterns: Annotated[str, AfterValidator(_of_a_family)] = option("dots:7", pattern_names(), metavar="PATTERNS")
    seconds: Annotated[float, AfterValidator(_some_time)] | None = option(
        None, "the finest accuracy that a run of so long buys", metavar="S", panel=QUALITY
    )
    effects: Annotated[dict[str, bool], BeforeValidator(_switches), AfterValidator(check_switches)] = option(
        {}, "override the plan: +NAME,-NAME", metavar="+NAME,-NAME", panel=QUALITY
    )
    noise_fraction: Annotated[float, AfterValidator(_worth_it)] | None = option(
        None, "stop sampling at this part of the sensor's noise", metavar="PART", panel=QUALITY
    )
    ambient_frame: Literal["auto", "yes", "no"] = option(
        "auto", "take a frame with the projector off and lamps on", metavar="auto|yes|no"
    )
    ambient_shots: Annotated[int, AfterValidator(_some_shots)] | None = option(
        None, "shots of that frame; by the patterns if not given", metavar="N"
    )
    closing_frame: Literal["first", "uniform"] | None = option(
        None,
        "frame at the end that checks lamp, camera and scene: the first one again, or a uniform one",
        metavar="first|uniform",
    )

    @classmethod
    def of(cls, **values: Any) -> Request:
        """Return the request of these ``values``; MitsimError for one that cannot be served."""
        return cls(**values)

    def with_values(self, **values: object) -> Request:
        """The same request with other ``values``; MitsimError as :meth:`of`."""
        return Request.of(**{**self.model_dump(exclude_unset=True), **values})

    @property
    def deciding(self) -> dict[str, Any]:
        """What is asked, as the manifest's configuration holds it: an accuracy or seconds."""
        unused = {"accuracy" if self.seconds is not None else "seconds"}
        # Without a closing frame the configuration, and so the digest in each frame, is as before there was the choice.
        return self.model_dump(mode="json", exclude=unused if self.closing_frame else {*unused, "closing_frame"})

    def model_post_init(self, _: object) -> None:
        """MitsimError for an exposure that no camera has, and for seconds beside what they decide."""
        self.timing  # noqa: B018 - checks itself
        if self.seconds is None:
            return
        if "accuracy" in self.model_fields_set:
            raise ArgumentError(
                "seconds", f"{self.seconds:g}: the accuracy is what they buy; give seconds or an accuracy, not both"
            )
        if self.noise_fraction is not None:
            raise ArgumentError(
                "noise_fraction",
                f"{self.noise_fraction:g}: stops sampling by another rule than seconds; give one of both",
            )

    @property
    def timing(self) -> Exposure:
        """How the exposure time is found."""
        return Exposure(None if self.exposure == "auto" else self.exposure, self.exposure_fraction)


class SessionRequest(Sampled):
    """Which factors a calibration is to find, and how well."""

    recipe: SessionRecipe | None = option(None, "session recipe, TOML", metavar="FILE.toml")


# ---- What `mitsim sense` takes ----

IMAGES, ENDINGS = (".exr", ".npy"), (".png", ".exr", ".npy")
"""Files that an image is read from, and digital numbers are written to."""
_LARGEST_PNG = 2**16 - 1
"""What 16 bits of grey hold."""
_WAVELENGTHS_NM = 1.0, 1e6
"""As a projector's."""


def check_image(path: Path) -> None:
    """MitsimError for a ``path`` that no image is read from."""
    if path.suffix.lower() not in IMAGES:
        raise MitsimError(f"image {path}: give an OpenEXR (.exr) or NumPy (.npy) file")
    check_plain(path, "image")


def check_wavelength(wavelength_nm: float) -> None:
    """ArgumentError for light of a ``wavelength_nm`` [nm] that there is not."""
    _check_range("wavelength", wavelength_nm, *_WAVELENGTHS_NM, "{} nm")


def check_f_number(f_number: float) -> None:
    """ArgumentError for an ``f_number`` that no lens has."""
    if not 0.5 <= f_number < math.inf:
        raise ArgumentError("f_number", f"{f_number:g}: no lens in air is below 0.5; give its f-number")


def check_view(path: Path | str) -> Path:
    """The ``path`` of a bench's drawing; ArgumentError for one that is neither a picture nor a page."""
    if Path(path).suffix.lower() not in VIEWS:
        raise ArgumentError("output", f"{path}: give a name that ends in {' or '.join(VIEWS)}")
    return Path(path)


def check_ending(path: Path, sensor: SensorModel) -> None:
    """MitsimError for a ``path`` that no frame is written to, or whose kind cannot hold a ``sensor``'s numbers."""
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise MitsimError(f"output {path}: give a name that ends in {', '.join(ENDINGS)}")
    if ending == ".png" and (sensor.largest_dn is None or sensor.largest_dn > _LARGEST_PNG):
        numbers = "real numbers" if sensor.largest_dn is None else f"numbers up to {sensor.largest_dn}"
        raise MitsimError(
            f"output {path}: sensor {sensor.name!r} gives {numbers}, 16 bits end at {_LARGEST_PNG}; use .exr"
        )

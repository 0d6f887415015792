"""Models of requests to a bench, which serve the command line, Python and the manifest.

Arguments that belong together are one value. :class:`Request` describes a capture and :class:`SessionRequest` a
calibration; :class:`Task` states the output folder and the job that watches the work.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from mitsim.bench.effects import parse_switches
from mitsim.core import configuration
from mitsim.core.colour_files import BANDS, LINES, bands_of
from mitsim.core.configuration import (
    CAMERA,
    PROJECTOR,
    QUALITY,
    FilePath,
    Options,
    Styled,
    option,
    shipped_names,
    validated_by,
)
from mitsim.core.environment import DEFAULT_VARIANT, check_variant
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, short_text
from mitsim.core.files import check_plain
from mitsim.core.job import Job
from mitsim.core.seeds import check_root
from mitsim.core.worker import pause_collector
from mitsim.devices.patterns import pattern_names, read_name
from mitsim.devices.sensor import EXPOSURE_FRACTION, EXPOSURE_S, SensorModel, load_sensor
from mitsim.devices.session import SessionRecipe, load_recipe

if TYPE_CHECKING:
    from mitsim.devices.camera import Devices

LOWEST_ACCURACY, HIGHEST_ACCURACY = 1e-6, 0.3
"""Below, single precision in the renderer (6e-8 a connection) and the pilot's samples tell nothing; above, no frame is
worth its name."""
PSNR_DB = 1.0, 100.0
"""PSNR that may be asked of an image: below, its error is its whole range; above, the truth is not known."""
LONGEST_S = 1e6
"""Seconds that may be asked for: eleven days, far beyond what any accuracy takes."""
REFERENCE, FACTORED = ESTIMATORS = ("reference", "factored")
"""Of the expected irradiance."""
VIEWS = (".png", ".html")
"""Endings of files that a bench is drawn in: a picture, and a page."""
FEWEST_PASSES = 4
"""Passes of the reference are compared to tell the noise; four tell it to 40 %."""
MOST_SAMPLES = 2**20
"""An error of a thousandth of one sample's: an hour a pixel row, beyond use."""


@dataclass(frozen=True)
class Task:
    """Output folder and job of a piece of work, which do not influence its results.

    Attributes
    ----------
    output
        folder that is written; None keeps them in memory.
    resume
        True to continue interrupted work in that folder.
    job
        clock, progress and limits.
    """

    output: Path | None = None
    resume: bool = False
    job: Job = field(default_factory=Job)

    @classmethod
    @check_arguments
    def of(cls, output: Path | str | None = None, resume: bool = False, job: Job | None = None) -> Task:
        """Return the value that the arguments of a Python function describe.

        Parameters
        ----------
        output, resume, job
            as the attributes.
        """
        return cls(None if output is None else Path(output), resume, job or Job())

    @classmethod
    def taken(cls, output: Path | str | None, options: dict[str, Any]) -> Task:
        """Return the task of an ``output`` and of the options of :class:`Working`, which are taken out."""
        return cls.of(output, **{name: options.pop(name) for name in Working.model_fields if name in options})

    @contextmanager
    def importing(self) -> Iterator[Task]:
        """Count the time of this context as the stage "imports" of the job's clock; yield the task."""
        with self.job.clock.stage("imports"), pause_collector():
            yield self


@dataclass(frozen=True)
class Exposure:
    """One exposure for a whole session: ``seconds``, or the brightest pixel fills ``fraction`` of the full well."""

    seconds: float | None = None
    fraction: float = 0.8

    def __post_init__(self) -> None:
        if self.seconds is not None:
            _check_range("exposure", self.seconds, *EXPOSURE_S, "{} seconds, or auto")
        _check_range("exposure_fraction", self.fraction, *EXPOSURE_FRACTION, "a part of the full well, {}")

    def check(self, sensor: SensorModel, camera_file: Path | str) -> None:
        """Refuse a ``sensor`` under colour filters, and one without the full well that decides the time."""
        if sensor.mosaic is not None:
            problem = f"camera {camera_file}: has a mosaic {sensor.mosaic}, whose frames show all lines at once"
            remedy = "capture and calibrate by --colour mosaic (capture_mosaic, calibrate_mosaic)"
            raise MitsimError(f"{problem}; {remedy}, make pairs by another")
        if self.seconds is None and not math.isfinite(sensor.full_well_e):
            raise MitsimError(f"camera {camera_file}: full_well_e is inf; give a finite one, or an exposure in seconds")

    def choose(self, devices: Devices, peak_irradiance: float) -> float:
        """Return the exposure time [s] for a brightest expected pixel of ``peak_irradiance`` [W m^-2]."""
        if self.seconds is not None:
            return self.seconds
        from mitsim.sensor.chain import exposure_for_peak  # here: it needs numpy, and checking a request does not

        wavelength = devices.projector.effective_wavelength_nm
        return exposure_for_peak(peak_irradiance, self.fraction, devices.sensor, wavelength)


class Working(Options):
    """How the verbs of a bench work, without influence on their results."""

    resume: bool = option(False, "True to resume interrupted work of the same request in ``output``, bit-equal")
    job: Job | None = option(None, "clock, progress and limits")


def _check_range(name: str, value: float, least: float, most: float, rule: str) -> float:
    if not least <= value <= most:
        raise ArgumentError(name, f"{value}: give {rule.format(f'{least:g} to {most:g}')}")
    return value


def check_accuracy(accuracy: float) -> float:
    """Return the ``accuracy``; ArgumentError if no estimator can promise it."""
    return _check_range("accuracy", accuracy, LOWEST_ACCURACY, HIGHEST_ACCURACY, "a relative error from {}")


def check_psnr(psnr: float) -> float:
    """Return the ``psnr`` [dB]; ArgumentError if no useful image has it."""
    return _check_range("psnr", psnr, *PSNR_DB, "{} dB")


def check_samples(estimator: str, spp: int | None) -> None:
    """Refuse an unknown ``estimator``, and too few or too many samples ``spp`` a pixel of the reference."""
    if estimator not in ESTIMATORS:
        raise ArgumentError("estimator", f"{estimator!r}: use {' or '.join(ESTIMATORS)}")
    if estimator == REFERENCE and spp is not None and not FEWEST_PASSES <= spp <= MOST_SAMPLES:
        raise ArgumentError("spp", f"{spp}: give at least {FEWEST_PASSES} samples a pixel, at most {MOST_SAMPLES}")


def _switches(effects: object) -> dict[str, bool]:
    if isinstance(effects, Mapping) and all(isinstance(value, bool) for value in effects.values()):
        effects = ",".join(f"{'+' if on else '-'}{name}" for name, on in effects.items())
    if not isinstance(effects, str):
        raise ArgumentError("effects", f"{short_text(effects)}: give +NAME,-NAME, or True or False by name")
    return parse_switches(effects)


def family_of(patterns: str) -> str:
    """Return the ``patterns``, a family's name, or a file with its SHA-256; ArgumentError for another name."""
    return read_name(patterns)


class Seeded(Options):
    """The root of all random streams."""

    seed: Annotated[int, validated_by(check_root)] = option(0, "seed of all random numbers", panel=QUALITY)


class Family(Options):
    """Patterns that the projector shows."""

    patterns: Annotated[str, validated_by(family_of)] = option("dots:7", pattern_names(), metavar="PATTERNS")


Accuracy = Annotated[float, validated_by(check_accuracy)]
Effects = Annotated[Any, validated_by(_switches)]


class Accurate(Options):
    """Accuracy of the traced light."""

    accuracy: Accuracy = option(1e-3, "allowed relative rms error of the expected frames", panel=QUALITY)


class Sampled(Seeded, Accurate):
    """Options of sampling light."""


class Timed(Seeded):
    """Exposure time of the camera."""

    exposure: float | Literal["auto"] = option("auto", "seconds for each frame, or auto", metavar="auto|SECONDS")
    exposure_fraction: float = option(0.8, "automatic exposure: brightest pixel as part of full well", metavar="PART")

    def model_post_init(self, context: object) -> None:
        """Refuse an exposure that no camera has."""
        super().model_post_init(context)
        self.timing  # noqa: B018 - checks itself

    def refuse_idle(self) -> None:
        """Refuse a part of the full well beside an exposure in seconds."""
        if self.exposure != "auto":
            self.refuse(["exposure_fraction"], "on an exposure in seconds")

    @property
    def timing(self) -> Exposure:
        """Return how the exposure time is found."""
        return Exposure(None if self.exposure == "auto" else self.exposure, self.exposure_fraction)


class Planned(Sampled, Family):
    """Options of a plan: simulated effects and their resolution."""

    seconds: float | None = option(
        None, "use the best accuracy reachable within S seconds", metavar="S", panel=QUALITY, gt=0, le=LONGEST_S
    )
    effects: Effects = option({}, "force effects on or off, such as +glare", metavar="+NAME,-NAME", panel=QUALITY)

    def model_post_init(self, context: object) -> None:
        """Refuse an accuracy beside the seconds that decide it."""
        super().model_post_init(context)
        if self.seconds is not None and "accuracy" in self.model_fields_set:
            raise ArgumentError("seconds", f"{self.seconds:g}: decides the accuracy; give one of both, not both")


class Request(Timed, Planned):
    """Options of a capture."""

    ambient_frame: Literal["auto", "yes", "no"] = option(
        "auto", "record a frame with the projector off; auto: if lamps are on", metavar="auto|yes|no"
    )

    @classmethod
    def of(cls, **values: Any) -> Request:
        """Return the request of these ``values``; effects may be written ``"+ambient,-diffraction"``."""
        return cls(**values)

    def with_values(self, **values: object) -> Request:
        """Return the request with other ``values`` of some fields."""
        return Request.of(**{**self.model_dump(exclude_unset=True), **values})

    @property
    def deciding(self) -> dict[str, Any]:
        """Return the fields that decide frames, as the manifest's configuration holds them."""
        return self.model_dump(mode="json", exclude={"seconds" if self.seconds is None else "accuracy"})


class SessionRequest(Sampled):
    """Options of a calibration."""

    recipe: SessionRecipe | None = option(
        None, "session recipe, a file of `mitsim new recipe`", metavar="FILE.toml", kind=Path, read=load_recipe
    )


def _prior(prior: object) -> tuple[float, float, float]:
    """Return mean, variance and correlation length [projector pixels] of reflectance; ArgumentError for others."""
    parts = prior.split(",") if isinstance(prior, str) else prior
    try:
        mean, variance, length = (float(str(part)) for part in parts)  # type: ignore[attr-defined]
    except (TypeError, ValueError):
        mean = math.nan
    if not (0 < mean <= 1 and 0 <= variance <= 1 and 0 < length <= 1e6):
        allowed = "give MEAN,VARIANCE,LENGTH: reflectance above 0 to 1, 0 to 1, and above 0 to 1e6 projector pixels"
        raise ArgumentError("prior", f"{short_text(prior)}: {allowed}")
    return mean, variance, length


class PredictRequest(Timed, Family):
    """Which image is predicted: its patterns, exposure, calibration and scene."""

    VERB = "predict"

    exposure_total: float | None = option(
        None, "seconds of all frames together, shared evenly; in place of --exposure", metavar="S", gt=0, le=1e6
    )
    recipe: SessionRecipe | None = option(
        None, "session recipe, a file of `mitsim new recipe`", metavar="FILE.toml", kind=Path, read=load_recipe
    )
    pictures: FilePath | None = option(
        None, "predict the mean over this folder's pictures instead of the scene's own", metavar="FOLDER", kind=Path
    )
    prior: Annotated[Any, validated_by(lambda prior: None if prior is None else _prior(prior))] = option(
        None, "mean, variance and correlation length [projector pixels] instead of the scene's own reflectance",
        metavar="MEAN,VARIANCE,LENGTH", kind=str,
    )  # fmt: skip
    lam: float | Literal["auto"] = option(
        "auto", "regularisation lambda; auto: that of the least expected error", "--lambda", metavar="auto|VALUE"
    )

    def model_post_init(self, context: object) -> None:
        """Refuse two exposures, and two scenes."""
        super().model_post_init(context)
        if self.exposure_total is not None:
            self.refuse(["exposure", "exposure_fraction"], "beside the seconds of all frames")
        if self.prior is not None:
            self.refuse(["pictures"], "on a prior")
        if self.lam != "auto" and not 0 <= self.lam < math.inf:
            raise ArgumentError("lam", f"{self.lam}: give auto, or a finite number of at least 0")

    @property
    def weight(self) -> float | None:
        """Return lambda; None for auto."""
        return None if self.lam == "auto" else self.lam


# ---- A scene and its devices ----

NO, MOSAIC, AUTO = "no", "mosaic", "auto"
"""Words of ``colour`` beside ``lines`` and ``bands:K``."""


def by_line(colour: str) -> bool:
    """Return True if a ``colour`` is lines, or bands of them, one after the other."""
    return colour.partition(":")[0] in (LINES, BANDS)


def _parameters(texts: Iterable[str]) -> dict[str, Any]:
    parameters = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise MitsimError(f"-D {text!r}: give NAME=VALUE")
        if name in ("scene", "for_render", *Opening.model_fields):
            raise MitsimError(f"-D {text!r}: mitsim itself uses the name {name}; give the scene's <default> another")
        parameters[name] = value
    return parameters


class Variant(Options):
    """The variant of Mitsuba."""

    variant: Annotated[str, validated_by(check_variant)] = option(
        DEFAULT_VARIANT,
        "Mitsuba variant: llvm_ad_mono, llvm_ad_rgb or llvm_ad_spectral; on an NVIDIA GPU cuda_ad_mono and so on",
        metavar="VARIANT",
        panel=configuration.LIMITS,
    )


class LitScene(Variant):
    """Scene and projector of a bench."""

    PANEL = configuration.DEVICES

    projector: FilePath | None = option(
        None, "projector: shipped name, or TOML file", metavar="NAME|FILE", complete=partial(shipped_names, PROJECTOR)
    )
    parameters: Mapping[str, Any] = option(
        {}, "set a parameter of the scene; repeatable", "-D", metavar="NAME=VALUE", kind=list[str], read=_parameters
    )
    allow_outside_files: bool = option(False, "let the scene read files outside its own folder")


class Opening(LitScene):
    """Devices and options that open a bench."""

    camera: FilePath | None = option(
        None, "camera: shipped name, or TOML file", metavar="NAME|FILE", complete=partial(shipped_names, CAMERA)
    )

    def check(
        self, scene: Path | str, patterns: str | None = None, timing: Exposure | None = None, colour: str = NO
    ) -> None:
        """Refuse options that scene and devices do not permit, before the renderer is imported.

        Parameters
        ----------
        scene, patterns
            Scene of the bench, and a family that its projector is to show; None for no family.
        timing
            Exposure; None if nothing is exposed.
        colour
            Colours that are captured separately.
        """
        from mitsim.bench.apparatus import check_devices, check_scene

        camera, projector = check_devices(self.camera, self.projector)
        sensor = load_sensor(camera)
        if colour == MOSAIC and sensor.mosaic is None:
            problem = f"mosaic: camera {camera} has no mosaic of colour filters"
            raise ArgumentError("colour", f"{problem}; give one that has, such as imx249_rggb, or use colour lines")
        if colour not in (NO, MOSAIC) and sensor.mosaic is not None:
            raise ArgumentError("colour", f"{colour}: camera {camera} has a mosaic {sensor.mosaic}; use colour mosaic")
        if colour != NO:
            from mitsim.devices.projector import ProjectorModel  # here: it imports numpy

            light = configuration.load_model(projector, ProjectorModel)
            (light.in_bands(bands_of(colour)) if colour.startswith(BANDS) else light).traced_lines  # noqa: B018
        if timing is not None and colour != MOSAIC:
            timing.check(sensor, camera)
        check_scene(scene, self.texts, self.allow_outside_files, [] if patterns is None else [patterns])

    @property
    def texts(self) -> dict[str, str]:
        """Return the parameters as a scene spells them."""
        from mitsim.bench.apparatus import spelling

        return {name: spelling(value) for name, value in self.parameters.items()}

    @property
    def models(self) -> list[Path]:
        """Return the files of the camera and its mask, and of the projector, that are named."""
        from mitsim.devices.camera import load_mask  # here: it imports numpy

        named = (self.camera, CAMERA), (self.projector, PROJECTOR)
        files = [configuration.locate(each, "calibration", ".toml", field) for each, field in named if each]
        mask = load_mask(files[0]) if self.camera else None
        return files if mask is None or mask.file is None else [*files, files[0].parent / mask.file]


def _known_colour(colour: str) -> None:
    if colour.startswith(f"{BANDS}:"):
        bands_of(colour)
    elif colour not in (NO, LINES, MOSAIC):
        raise ArgumentError("colour", f"{colour!r}: use {NO}, {LINES}, {BANDS}:K or {MOSAIC}")


_COLOUR_WORDS = (
    "no: grey; lines: one folder for each spectral line of the projector; bands:K: one folder for each of K bands of "
    "these lines; mosaic: all lines at once, with a camera that has colour filters"
)


class Coloured(Options):
    """Colours of the projector that are captured separately."""

    colour: Annotated[str, validated_by(_known_colour)] = option(NO, _COLOUR_WORDS, metavar="no|lines|bands:K|mosaic")


class AnyColour(Coloured):
    """Colours of the projector that are captured separately, or auto."""

    colour: Annotated[str, validated_by(lambda colour: None if colour == AUTO else _known_colour(colour))] = option(
        NO,
        f"{_COLOUR_WORDS}; auto: no if grey light costs at most half of the accuracy, otherwise lines",
        metavar="no|lines|bands:K|mosaic|auto",
    )


# ---- What `mitsim sense` takes ----

IMAGES, ENDINGS = (".exr", ".npy"), (".png", ".exr", ".npy")
"""Files that an image is read from, and digital numbers are written to."""
_LARGEST_PNG = 2**16 - 1
"""What 16 bits of grey hold."""


class Lit(Options):
    """Light of one wavelength."""

    wavelength: float = option(550.0, "wavelength of the light [nm]", ge=1, le=1e6)


class Irradiance(Timed, Lit):
    """Conversion of an image's numbers to light on a sensor, and the sensor's exposure."""

    VERB = "sense"

    exposure: float | Literal["auto"] = option("auto", "exposure time [s], or auto", metavar="auto|SECONDS")
    f_number: float | None = option(
        None, "f-number of a lens; the image is then radiance [W/m^2/sr] in front of it", metavar="N", ge=0.5, le=1e100
    )
    scale: float = option(1.0, "factor that multiplies the image", gt=0, lt=math.inf)
    channel: str | None = option(None, "channel to use, if the image has several", metavar="NAME")


class Procedure(Lit, Seeded, Styled):
    """Options of a characterisation on simulated frames.

    Below 32 rows a row's part is uncertain by a quarter; EMVA 1288 requires at least 50 steps and 16 frames.
    """

    VERB = "characterise"

    pixels: int = option(256, "rows and columns of the simulated frames", ge=32, le=4096)
    steps: int = option(50, "number of light levels, from dark to beyond saturation", ge=20, le=1000)
    frames: int = option(100, "frames of each stack", kind=False, ge=2, le=10_000)
    wavelength: float = option(550.0, "wavelength [nm], for cameras with a quantum efficiency curve", ge=1, le=1e6)

    @property
    def stated(self) -> dict[str, float]:
        sizes = {name: getattr(self, name) for name in ("pixels", "steps", "frames", "seed")}
        return {**sizes, "wavelength_nm": self.wavelength}

    def efficiency(self, sensor: SensorModel) -> float:
        """Return electrons per photon; 1 if the sensor states none or has filters, because electrons are counted."""
        return sensor.efficiency(self.wavelength) if sensor.states_efficiency else 1.0


def check_image(path: Path) -> None:
    """Refuse a ``path`` whose file is no image that mitsim reads."""
    if path.suffix.lower() not in IMAGES:
        raise MitsimError(f"image {path}: give an OpenEXR (.exr) or NumPy (.npy) file")
    check_plain(path, "image")


def check_view(path: Path | str) -> Path:
    """Return the ``path`` of a bench's drawing; ArgumentError if it is neither a picture nor a page."""
    if Path(path).suffix.lower() not in VIEWS:
        raise ArgumentError("output", f"{path}: give a name that ends in {' or '.join(VIEWS)}")
    return Path(path)


def check_ending(path: Path, sensor: SensorModel) -> None:
    """Refuse a ``path`` of a kind that mitsim does not write, or that cannot hold the ``sensor``'s numbers."""
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise MitsimError(f"output {path}: give a name that ends in {', '.join(ENDINGS)}")
    if ending == ".png" and (sensor.largest_dn is None or sensor.largest_dn > _LARGEST_PNG):
        numbers = "real numbers" if sensor.largest_dn is None else f"numbers up to {sensor.largest_dn}"
        raise MitsimError(f"output {path}: sensor {sensor.name!r} gives {numbers}, beyond 16 bits; use .exr")

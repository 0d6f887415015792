"""Table of all effects that a scene may call for, and the physics that result from a bench and its active effects.

An effect that is off takes its neutral value, which leaves light unchanged. Plan, pilot, simulation, studies and tests
read :data:`EFFECTS`. To add an effect: give it a field of :class:`Physics` (or of the camera or projector in it),
compute it where that field is read, enter it here, test it, and describe it in docs/physics.md.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from operator import attrgetter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel

from mitsim.core.errors import ArgumentError

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsim.bench.apparatus import Apparatus
    from mitsim.devices.camera import CameraGeometry
    from mitsim.devices.projector import Spectrum
    from mitsim.transport.connect import ProjectorOptics

DIRECT, FOLLOWED = "direct", "followed"
"""Kinds of traced light: from one surface, and over several surfaces or from the camera."""


@dataclass(frozen=True, eq=False)
class Physics:
    """What is simulated of a bench.

    Attributes
    ----------
    geometry
        The camera.
    projector
        The projector's pixels and lens.
    spectrum
        Light whose diffraction at the mask is simulated; None for a geometric shadow.
    black_level
        Light of a black projector pixel relative to a white one.
    speckle
        Speckle contrast of the frames.
    lamps
        True for emitters beside the projector.
    mirrors
        True to follow light over surfaces that reflect or transmit in single directions.
    interreflection
        True to follow light over several surfaces.
    """

    geometry: CameraGeometry
    projector: ProjectorOptics
    spectrum: Spectrum | None
    black_level: float
    speckle: float
    lamps: tuple[mi.Emitter, ...]
    mirrors: bool
    interreflection: bool

    @classmethod
    def of(cls, bench: Apparatus) -> Physics:
        """Return all effects of ``bench``."""
        return cls(
            geometry=bench.geometry,
            projector=bench.projector_optics,
            spectrum=bench.waves,
            black_level=bench.projector.black_level,
            speckle=bench.speckle(),
            lamps=bench.loaded.lamps,
            mirrors=bench.loaded.mirrors,
            interreflection=True,
        )

    @classmethod
    def with_effects(cls, bench: Apparatus, effects: Collection[str]) -> Physics:
        """Return the given ``effects`` of ``bench``; all others take their neutral values."""
        physics = cls.of(bench)
        for effect in EFFECTS.values():
            if effect.name not in effects:
                physics = effect.without(physics)
        return physics


@dataclass(frozen=True)
class Effect:
    """One effect, with all properties that are needed to simulate and judge it.

    Attributes
    ----------
    name
        Name in plans, on the command line and in manifests.
    neutral
        Neutral values by field of :class:`Physics`; ``part.field`` names one of the camera or projector.
    what
        Description.
    absent
        Reason that a plan gives if a bench lacks the effect.
    note
        Sentence of a plan about a bench with the effect.
    retraced
        Light (:data:`DIRECT`, :data:`FOLLOWED`) that must be traced again to form frames without the effect.
    kind
        Kind of traced light that is omitted instead; None for none.
    first_pilot_run
        True if it shapes direct light so much that the pilot includes it while choosing anchors, layers and cells.
    followed
        True if its light is followed over several surfaces or from the camera.
    in_shadow
        True if it costs time in the mask's shadow.
    in_frames
        True if it is part of the expected frames; others are drawn with the sensor's noise.
    in_reference
        True if the reference estimator has it.
    in_truth
        True if it also acts on a calibration board and therefore cancels in apparent reflectance.
    """

    name: str
    neutral: Mapping[str, object]
    what: str = ""
    absent: str = ""
    note: Callable[[Apparatus], str] = field(default=lambda bench: "")
    retraced: Callable[[Physics], frozenset[str]] = field(default=lambda physics: frozenset())
    kind: Literal["indirect", "ambient"] | None = None
    first_pilot_run: bool = False
    followed: bool = False
    in_shadow: bool = False
    in_frames: bool = True
    in_reference: bool = False
    in_truth: bool = False

    def present(self, bench: Apparatus) -> bool:
        """Return True if ``bench`` has the effect."""
        physics = Physics.of(bench)
        return any(attrgetter(name)(physics) != value for name, value in self.neutral.items())

    def without(self, physics: Physics) -> Physics:
        """Return ``physics`` with the neutral values of the effect."""
        for name, value in self.neutral.items():
            physics = _with_value(physics, name, value)
        return physics


def _with_value(owner: Any, name: str, value: object) -> Any:
    name, _, part = name.partition(".")
    own = getattr(owner, name)
    value = _with_value(own, part, value) if part else value
    if own == value:
        return owner  # with what it remembers
    return owner.model_copy(update={name: value}) if isinstance(owner, BaseModel) else replace(owner, **{name: value})


def _diffraction(bench: Apparatus) -> str:
    camera, wavelength = bench.geometry, bench.projector.effective_wavelength_nm
    # a^2 / (lambda d): well above 1, a geometric shadow is good.
    number, lines = camera.mask_feature**2 / (wavelength * 1e-6 * camera.mask_distance), len(bench.spectrum.weights)
    counted = f"{lines} line{'s' if lines > 1 else ''}"
    return f"a mask feature's Fresnel number is {number:.1f} at {wavelength:.0f} nm, {counted}"


def _lamps(bench: Apparatus) -> str:
    counted = ", counted from {:g} to {:g} nm".format(*bench.counted_lamps.range_nm) if bench.counted_lamps else ""
    lamps = len(bench.loaded.lamps)
    return f"{lamps} emitter{'s' if lamps > 1 else ''} beside the projector{counted}"


def _lens(bench: Apparatus) -> str:
    lens, far = bench.projector_optics, bench.geometry.scene_distance
    spot = 2 * lens.aperture * abs(far - lens.focus) / lens.focus  # similar triangles
    return f"a lens of radius {lens.aperture:g} mm, sharp at {lens.focus:g} mm: spots of {spot:.3g} mm at {far:g} mm"


_TABLE = (
    Effect(
        "interreflection",
        {"interreflection": False},
        what="light that several surfaces reflect",
        # Lamps' light bounces as well, and only paths that were never followed tell how much of it.
        retraced=lambda physics: frozenset({FOLLOWED} if physics.lamps else ()),
        kind="indirect",
        followed=True,
        in_reference=True,
    ),
    Effect(
        "mirrors",
        {"mirrors": False},
        what="light over mirrors and through glass, and of a projector in view",
        absent="no surface reflects or transmits light in single directions",
        retraced=lambda physics: frozenset({FOLLOWED}),
        first_pilot_run=True,
        followed=True,
        in_reference=True,
    ),
    Effect(
        "ambient",
        {"lamps": ()},
        what="light of lamps beside the projector",
        absent="the projector is the only emitter",
        note=_lamps,
        kind="ambient",
        followed=True,
        in_reference=True,
    ),
    Effect(
        "diffraction",
        {"spectrum": None},
        what="diffraction at the mask; without this effect its shadow is geometric",
        absent="the mask's shadow is geometric, or a picture that includes diffraction",
        note=_diffraction,
        first_pilot_run=True,
        in_shadow=True,
    ),
    Effect(
        "mask-thickness",
        {"geometry.mask_thickness": 0.0},
        what="walls of the mask's openings, which block oblique light",
        absent="the mask is thin",
        in_reference=True,
    ),
    Effect(
        "pixel-response",
        {"geometry.pixel_fill_factor": 1.0, "geometry.angular_exponent": 0.0},
        what="lower sensitivity of pixels at their edges and to oblique light",
        absent="pixels are fully sensitive at all angles",
        retraced=lambda physics: frozenset({DIRECT, FOLLOWED}),
        in_reference=True,
        in_truth=True,
    ),
    Effect(
        "aperture",
        {"projector.aperture": 0.0},
        what="defocus of the projector's lens, which is sharp at one distance",
        absent="the projector is a pinhole: sharp at all distances",
        note=_lens,
        retraced=lambda physics: frozenset({DIRECT, FOLLOWED}),
        first_pilot_run=True,
        in_truth=True,
    ),
    Effect(
        "blur",
        {"projector.blur": 0.0},
        what="blur of projector pixels into their neighbours",
        absent="the projector's pixels are sharp",
        retraced=lambda physics: frozenset({DIRECT, FOLLOWED}),
        first_pilot_run=True,
        in_truth=True,
    ),
    Effect(
        "glare",
        {"projector.share": 1.0},
        what="light that the projector's lens scatters over its picture",
        absent="the projector file gives no ANSI contrast",
        note=lambda bench: f"the projector's lens scatters {1 - bench.projector_optics.share:.2g} of its light",
        retraced=lambda physics: frozenset({DIRECT, FOLLOWED}),
    ),
    Effect("black-level", {"black_level": 0.0}, what="light of black pixels", absent="the projector's black is black"),
    Effect(
        "speckle",
        {"speckle": 0.0},
        what="the grain of laser light",
        absent="the projector file gives no speckle contrast",
        in_frames=False,
    ),
)
EFFECTS: Mapping[str, Effect] = MappingProxyType({effect.name: effect for effect in _TABLE})
"""All effects in the order of a plan's rows."""

DISCRETISED: Mapping[str, str] = MappingProxyType({
    "anchors": "sensor points to which light is traced, because it varies over the sensor",
    "layers": "depths, each with its own shadow of the mask",
})  # fmt: skip
"""Quantities that a plan counts instead of switching; off means one."""
SWITCHES = (*DISCRETISED, *EFFECTS)
"""Names that a user may switch on or off."""


def present(bench: Apparatus) -> tuple[str, ...]:
    """Return the names of the effects that ``bench`` has."""
    return tuple(name for name, effect in EFFECTS.items() if effect.present(bench))


def names(which: Callable[[Effect], bool]) -> frozenset[str]:
    """Return the names of the effects for which ``which`` is true."""
    return frozenset(name for name, effect in EFFECTS.items() if which(effect))


def parse_switches(text: str) -> dict[str, bool]:
    """Parse a ``text`` such as ``+ambient,-diffraction`` as {name: on}; raise MitsimError for anything else."""
    switches: dict[str, bool] = {}
    for word in filter(None, (part.strip() for part in text.split(","))):
        if word[0] not in "+-" or word[1:] not in SWITCHES:
            allowed = ", ".join(SWITCHES)
            raise ArgumentError("effects", f"{text!r}: {word!r} is not +NAME or -NAME; the names are {allowed}")
        if switches.get(word[1:], word[0] == "+") != (word[0] == "+"):
            raise ArgumentError("effects", f"{text!r}: {word[1:]} is switched both on and off; keep one")
        switches[word[1:]] = word[0] == "+"
    return switches

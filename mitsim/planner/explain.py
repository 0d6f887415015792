"""Deciding a plan: measured pilot result and an accuracy in; what is simulated, why, and what it costs, out.

Accuracy is the relative rms error of the expected frames, ``||a - b|| / ||b||`` over all frames and pixels, all in all:
what is left out, what is made coarse, and sampling. The cheapest settings that are predicted to keep it are chosen
(:mod:`mitsim.planner.choose`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from mitsim.bench.effects import EFFECTS, Effect
from mitsim.bench.request import check_accuracy
from mitsim.light.cost_model import (
    Numbers,
    UnitCosts,
    accumulation_seconds,
    checking_seconds,
    costly_effects,
    entries,
    optics_seconds,
    tracing_seconds,
    truth_seconds,
    unit_costs_of,
)
from mitsim.light.passes import FOLLOWED
from mitsim.light.plan import LEFT_OUT, NO_TIME, ONE, WITHOUT, Plan, PlanRow, State
from mitsim.light.settings import Estimate, PilotResult, Settings
from mitsim.planner.choose import Candidate, cheapest, predicted_candidate
from mitsim.transport.missed import polished_shapes
from mitsim.transport.plugins.base import turn_and_origin

if TYPE_CHECKING:
    from mitsim.bench.apparatus import Apparatus
    from mitsim.scene.load import LoadedScene
    from mitsim.scene.outline import Tag


_GREY = "no surface differs by wavelength; the mask's shadow is the mean over all lines"
"""What is said of a scene in greys."""
_FEW_WAVELENGTHS = 2
"""Mean width of a mask's openings below which scalar waves, and shadows, are a guess: half the openings of codes and of
random masks are one feature, which is half the mean and a wavelength then."""
_VAGUE = 2.0
"""An estimate whose bound is above this much of it is reported as a bound."""


@dataclass(frozen=True)
class SceneFacts:
    """What a plan says of a bench's devices besides the pilot's pilot result.

    Attributes
    ----------
    notes
        what to say of an effect that the bench has, by name.
    keystone
        how far the projector's window is off a square [projector pixels].
    warnings
        what the model of the devices does not cover, and which of the scene's light frames are known to lack.
    shapes
        where the scene's shapes are written, if that is known.
    mirrors
        those of them that reflect or bend light into single directions.
    spectrum
        what to say of colours.
    """

    notes: Mapping[str, str]
    keystone: float
    warnings: tuple[str, ...] = ()
    shapes: tuple[Tag, ...] = ()
    mirrors: tuple[Tag, ...] = ()
    spectrum: PlanRow = field(default_factory=lambda: PlanRow("spectrum", "off", _GREY, 0.0, 0.0))

    @classmethod
    def of(cls, bench: Apparatus, switches: Mapping[str, bool] | None = None) -> SceneFacts:
        """The facts of ``bench``, without what effects that the user's ``switches`` put out would bring."""
        loaded, off = bench.loaded, {name for name, on in (switches or {}).items() if not on}
        warnings = (*known_losses(loaded, switches or {}), *_limits(bench, off))
        notes = {name: effect.note(bench) for name, effect in EFFECTS.items()}
        polished = polished_shapes(loaded.scene) if loaded.mirrors and loaded.shapes else ()
        mirrors = tuple(loaded.shapes[number] for number in polished)
        return cls(notes, loaded.pixels.keystone, warnings, loaded.shapes, mirrors, _spectrum(bench))


def _limits(bench: Apparatus, off: Collection[str]) -> Iterator[str]:
    """What the model of a ``bench``'s devices does not cover, of effects that are not ``off``."""
    geometry, waves = bench.geometry, "diffraction" not in off
    if bench.projector.glare and bench.loaded.mirrors and not {"glare", "mirrors"} & set(off):
        yield (
            f"{bench.projector.glare:.2g} of the light over mirrors alone is to be scattered in the projector's lens "
            "(ansi_contrast), and stays in its own pixels; --effects=-glare says that no scattering is meant"
        )
    lens = bench.projector.aperture_radius_mm
    if lens and bench.loaded.in_view and not {"aperture", "mirrors"} & set(off):
        camera = turn_and_origin(bench.loaded.camera.world_transform())[1]
        blur = 2 * lens * geometry.mask_distance / math.dist(camera, bench.projector_optics.canvas_map.origin)
        yield (
            "the projector shines on the sensor itself as a pinhole, without its lens, which would blur the mask's "
            f"shadow by {blur:.2g} mm; keep it out of the view, or set aperture_radius_mm to 0"
        )
    if bench.field_stop_cuts:
        yield (
            "the field stop (fov) cuts into the projector's window for part of the sensor; its edge is blurred over "
            "the anchors, so open it or accept an error there"
        )
    if geometry.wall_shift_features >= 1:
        yield (
            f"mask_thickness {geometry.mask_thickness} mm shifts the far face by {geometry.wall_shift_features:.1f} "
            "features at the field stop; the two-face model holds below 1"
        )
    of_light = bool(geometry.mask_plate and geometry.mask_plate.irradiance)
    if not geometry.diffracts and not of_light and waves:
        yield (
            "diffraction is left out: behind blurred edges it is worked out for masks of one separable term, and this "
            f"one ({geometry.mask_words}) has more; --effects=-diffraction says that a geometric shadow is meant"
        )
    left_out = geometry.tilt_left_out(geometry.diffracts and waves)
    if left_out or (any(geometry.mask_tilt) and bench.loaded.mirrors):
        yield (
            f"the mask's tilt is left out{'' if left_out else ' of light over mirrors'}: it moves shadows by up to "
            f"{geometry.tilt_shift_mm * 1e3:.2g} um; render --estimator reference has it, or set it to 0 in the "
            "camera's [mask]"
        )
    longest, opening = float(bench.spectrum.wavelengths_nm.max()), geometry.build_mask().opening_mm
    if opening * 1e6 < _FEW_WAVELENGTHS * longest and not of_light:
        yield (
            f"mask_feature {geometry.mask_feature:g} mm: the mask's openings are {opening:.3g} mm wide, less than "
            f"{_FEW_WAVELENGTHS} wavelengths of {longest:.0f} nm; scalar theory of masks needs wider ones, so the "
            "shadow is a guess"
        )


# -------- A plan, and what it says of its choice


def explain_plan(
    accuracy: float,
    pilot_result: PilotResult,
    facts: SceneFacts,
    switches: Mapping[str, bool] | None = None,
    chosen: Candidate | None = None,
) -> Plan:
    """Choose effects, anchors, layers, cells and samples.

    Parameters
    ----------
    accuracy
        relative rms error of the expected frames.
    pilot_result
        what the pilot measured.
    facts
        what to say of the devices.
    switches
        effects that the user switches on or off, by name.
    chosen
        the choice, where it is known.
    """
    check_accuracy(accuracy)
    switches = switches or {}
    chosen = chosen or cheapest(accuracy, pilot_result, switches)
    words = _Words(accuracy, pilot_result, chosen, facts, switches)
    stages = _stages(pilot_result, chosen.settings, unit_costs_of(pilot_result))
    return Plan(
        accuracy=accuracy,
        effects=words.rows,
        predicted_seconds=sum(stages.values()),
        settings=chosen.settings,
        sampling_target=chosen.target,
        systematic_error=chosen.systematic.value,
        systematic_bound=chosen.systematic.bound,
        warnings=facts.warnings + words.warnings,
        predicted=stages,
    )


def _stages(pilot_result: PilotResult, settings: Settings, costs: UnitCosts) -> dict[str, float]:
    """Seconds of transport, truth and optics."""
    forming, numbers = pilot_result.forming, Numbers.of(settings)
    tracing = tracing_seconds(pilot_result, settings, costs)
    held = entries(pilot_result.sample_costs["direct"].paths, forming.classes, numbers, settings)
    return {
        "transport": sum(tracing.values())
        + float(accumulation_seconds(forming, numbers, held, costs))
        + float(checking_seconds(forming, numbers, costs)),
        "truth": truth_seconds(pilot_result, settings, costs),
        "optics": float(optics_seconds(forming, numbers, costs)),
    }


@dataclass(frozen=True)
class _Words:
    """What a plan says of its choice."""

    accuracy: float
    pilot_result: PilotResult
    chosen: Candidate
    facts: SceneFacts
    switches: Mapping[str, bool]

    @property
    def rows(self) -> tuple[PlanRow, ...]:
        """A row for each effect and discretisation."""
        effects = (self._effect(effect) for effect in EFFECTS.values())
        anchors = self._anchors(), self._followed_anchors(), self._occluded_anchors()
        counted = (anchors[0], self._layers(), self._cells(), *anchors[1:], *self._shadow())
        return (*counted, *effects, *_fixed_rows(self.facts))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why the frames will not keep the accuracy."""
        chosen, accuracy, missing = self.chosen, self.accuracy, self.pilot_result.unresolved
        if chosen.total.bound <= accuracy:
            return ()
        sentences, parts = [], self._bounds_by_part()
        if missing > accuracy:
            sentences.append(
                f"{missing:.0%} of the direct light comes over lobes too sharp to sample, and the frames lack "
                "most of it; give those surfaces more roughness, or make them perfect mirrors (conductor)"
            )
        largest = max(parts, key=lambda name: parts[name])
        shapes, mirror = self.facts.shapes, self.pilot_result.mirror
        if mirror is not None and shapes and self.pilot_result.left_out >= min(accuracy, parts[largest]):
            sentences.append(self._left_out(shapes[mirror]))
        if self.facts.mirrors and self.pilot_result.unresolved_specular >= min(accuracy, parts[largest]):
            sentences.append(self._unresolved_specular(self.facts.mirrors))
        return tuple(sentences) or (
            f"the predicted total error, up to {chosen.total.bound:.1e}, exceeds the requested {accuracy:g}; "
            f"largest: {largest}, {parts[largest]:.1e}",
        )

    def _unresolved_specular(self, mirrors: tuple[Tag, ...]) -> str:
        """What is lost of light over ``mirrors`` alone."""
        kinds = Counter(str(mirror.attributes.get("type", "shape")) for mirror in mirrors)
        among = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
        rule = (
            f"{self.pilot_result.unresolved_specular:.2g} of the light comes over the scene's mirrors and curved glass "
            f"alone ({among}; this is the first), in beams too fine to be placed on the sensor: it is left out, or in "
            "the wrong pixels; use fewer or larger ones, move them apart, or make them rough"
        )
        return str(mirrors[0].refusal("shape", repr(mirrors[0].attributes.get("type", "")), rule))

    def _left_out(self, mirror: Tag) -> str:
        """What is lost over a ``mirror`` or curved glass."""
        rule = (
            f"{self.pilot_result.left_out:.2g} of the light comes over it and, besides, a mirror, curved glass or a "
            "sharp lobe, where paths find it never or too seldom, so all or most of it is left out of the frames; turn "
            "it away, make it rough, or give the projector a lens (aperture_radius_mm) with the effect interreflection"
        )
        return str(mirror.refusal("shape", repr(mirror.attributes.get("type", "")), rule))

    def _bounds_by_part(self) -> dict[str, float]:
        """By what leaves it, the bound on each part of the systematic error."""
        pilot_result, settings, of_raster = self.pilot_result, self.chosen.settings, self._of_raster
        anchors, layers, cells = settings.anchors, len(settings.depths), settings.subdivision
        sharp = settings.sharp
        followed, occluded, width = settings.followed_anchors, settings.occluded_anchors, settings.followed_width
        return {
            f"anchors ({anchors}x{anchors})": self._number("anchors", anchors).bound,
            f"layers ({layers})": self._number("layers", layers).bound,
            f"cells ({cells}x{cells})": self._number("cells", cells).bound,
            f"followed anchors ({followed}x{followed})": self._number("followed_anchors", followed).bound,
            f"cells of their light ({width} pixels)": self._number("followed_width", width).bound,
            **({"the mask's raster": of_raster.bound} if of_raster and settings.raster else {}),
            **({f"anchors of sharp light ({sharp.anchors}x{sharp.anchors})": sharp.left} if sharp else {}),
            f"occluded anchors ({occluded}x{occluded})": self._number("occluded_anchors", occluded).bound,
            **self.chosen.lacking,
            **{f"{name} (off)": e.bound for name, e in pilot_result.effects.items() if name not in settings.effects},
        }

    def _number(self, name: str, count: int) -> Estimate:
        return self.pilot_result.ladders[name][count]

    def _seconds(self, **changes: Any) -> float:
        """What the settings take beyond those with ``changes``."""
        settings, costs = self.chosen.settings, unit_costs_of(self.pilot_result)
        with_it, without = (
            sum(_stages(self.pilot_result, each, costs).values()) for each in (settings, replace(settings, **changes))
        )
        return max(with_it - without, 0.0)

    def _without(self, settings: Settings) -> str:
        """What the total error would be with other ``settings``."""
        other = predicted_candidate(self.accuracy, self.pilot_result, settings, {})
        total = math.hypot(other.systematic.bound, self.chosen.noise)
        return f"{WITHOUT} would be up to {total:.1e}, and {self.accuracy:g} is allowed"

    def _anchors(self) -> PlanRow:
        side = self.chosen.settings.anchors
        alone, several = "falloff, gloss and parallax over the sensor: one anchor", "falloff, gloss and parallax"
        seconds = self._seconds(anchors=1, occluded_anchors=1)
        return self._row_of_anchors("anchors", alone, f"{several}: {side}x{side} anchors", seconds)

    def _layers(self) -> PlanRow:
        depths, one = self.chosen.settings.depths, self._number("layers", 1)
        if len(depths) == 1:
            reason = f"the light is seen at {self.pilot_result.depth:.1f} mm; one layer leaves {_error_words(one)}"
            return PlanRow("layers", "off", reason, one.value, 0.0)
        left = _error_words(self._number("layers", len(depths)))
        reason = f"the light is seen from {depths[-1]:.0f} to {depths[0]:.0f} mm; {len(depths)} layers leave {left}"
        return PlanRow(
            "layers", "approximate", f"{reason}{ONE} {_error_words(one)}", one.value, self._seconds(layers=())
        )

    def _cells(self) -> PlanRow:
        cells, errors = self.chosen.settings.subdivision, self.pilot_result.ladders["cells"]
        reason = f"{cells}x{cells} cells of even light a projector pixel leave {_error_words(errors[cells])}"
        return PlanRow("cells", "approximate", reason, max(error.value for error in errors.values()), 0.0)

    def _followed_anchors(self) -> PlanRow:
        settings, light = self.chosen.settings, "light over several surfaces, in mirrors and of lamps"
        if not settings.effects & FOLLOWED:
            reason = "no light over several surfaces, in mirrors or of lamps is followed"
            return PlanRow("followed-anchors", "off", reason, 0.0, 0.0)
        side, width = settings.followed_anchors, settings.followed_width
        several = f"{light}: {side}x{side}{f' in cells of {width}x{width} pixels' if width > 1 else ''}"
        seconds = self._seconds(followed_anchors=1)
        return self._row_of_anchors("followed_anchors", f"{light}: one point", several, seconds)

    def _occluded_anchors(self) -> PlanRow:
        pixels, side = len(self.pilot_result.occluded), self.chosen.settings.occluded_anchors
        if not pixels:
            return PlanRow("occluded-anchors", "off", "few anchors serve all projector pixels", 0.0, 0.0)
        hidden = f"{pixels} projector pixels are hidden from part of the sensor"
        # To see them apart saves time: with as many anchors for all pixels, it would take far more.
        return self._row_of_anchors(
            "occluded_anchors", f"{hidden}: one anchor", f"{hidden}: {side}x{side} anchors", 0.0
        )

    def _row_of_anchors(self, count: str, alone: str, several: str, seconds: float) -> PlanRow:
        """Of the setting ``count``, in words for one and for ``several``."""
        name, one = count.replace("_", "-"), self._number(count, 1)
        if (chosen := getattr(self.chosen.settings, count)) == 1:
            return PlanRow(name, "off", f"{alone} leaves {_error_words(one)}", one.value, 0.0)
        reason = f"{several} leave {_error_words(self._number(count, chosen))}{ONE} {_error_words(one)}"
        return PlanRow(name, "approximate", reason, one.value, seconds)

    @property
    def _waves(self) -> bool:
        """Whether the mask's shadow is wave-optical."""
        return any(EFFECTS[name].in_shadow for name in self.chosen.settings.effects)

    @property
    def _of_raster(self) -> Estimate | None:
        """What the raster leaves that is chosen, or one of the fewest cells where the mask may be drawn on one."""
        return self.pilot_result.raster[self._waves].error_left(self.chosen.settings.raster_cells)

    def _shadow(self) -> tuple[PlanRow, ...]:
        """How frames behind a mask of more than two terms are formed."""
        left, settings, forming = self._of_raster, self.chosen.settings, self.pilot_result.forming
        if left is None:
            return ()
        drawn, costs = self.pilot_result.raster[self._waves], unit_costs_of(self.pilot_result)

        def seconds(cells: int) -> float:
            formed = replace(settings, raster=cells > 0, raster_cells=cells)
            return _stages(self.pilot_result, formed, costs)["optics"]

        fewest, leaves = drawn.cells[0], _error_words(left)
        cells = settings.raster_cells or fewest
        on_raster, by_fft = f"on a raster of {cells} cells a pixel", seconds(cells)
        if drawn.needed:
            reason = f"the mask's shadow is drawn {on_raster}, and frames are formed by FFT: that leaves {leaves}"
            spent = 0.0
            if cells != fewest and drawn.error is not None:
                reason += f", {fewest} {_error_words(drawn.error)}"
                spent = max(by_fft - seconds(fewest), 0.0)
            return (PlanRow("mask-shadow", "approximate", reason, None, spent),)
        sums = seconds(0)
        terms = f"{forming.geometric_terms:.0f} separable terms"
        if settings.raster:
            reason = f"{terms}: by FFT {on_raster}, {by_fft:.2g} s, which leaves {leaves}; their sum takes {sums:.2g} s"
            return (PlanRow("mask-shadow", "approximate", reason, 0.0, max(by_fft, 0.0)),)
        reason = f"{terms} are summed, {sums:.2g} s; by FFT {on_raster}, {by_fft:.2g} s, {leaves} would be left"
        return (PlanRow("mask-shadow", "exact", reason, left.value, sums),)

    def _effect(self, effect: Effect) -> PlanRow:
        settings, name = self.chosen.settings, effect.name
        on = name in settings.effects
        state: State = "exact" if on else "off"
        error = self.pilot_result.effects.get(name)
        if error is None:
            return PlanRow(name, state, effect.absent or "nothing in the scene calls for it", 0.0, 0.0)
        sentences = [self.facts.notes.get(name, ""), "switched by the user" if name in self.switches else ""]
        sentences.append(f"{LEFT_OUT} {_error_words(error)}")
        takes_time = name in costly_effects()
        if on and name not in self.switches:
            less = replace(settings, effects=settings.effects - {name})
            sentences.append(self._without(less) if takes_time else NO_TIME)
        seconds = self._seconds(effects=settings.effects - {name}) if on and takes_time else 0.0
        return PlanRow(name, state, "; ".join(filter(None, sentences)), error.value, seconds)


def _error_words(error: Estimate) -> str:
    """An error as people read it: below its bound where it cannot be told from none."""
    if error.bound == 0:
        return "0"
    return f"{error.value:.1e}" if error.bound < _VAGUE * error.value else f"less than {error.bound:.1e}"


def _spectrum(bench: Apparatus) -> PlanRow:
    """What monochrome frames of a ``bench`` leave out of colours, as far as that is known without tracing."""
    if bench.lines is not None:
        nanometres = ", ".join(f"{wave:g}" for wave in bench.lines.wavelengths_nm)
        return PlanRow("spectrum", "exact", f"all is simulated at {nanometres} nm", None, 0.0)
    coloured = bench.loaded.coloured
    if coloured:
        place = f"{coloured[0].path.name}:{coloured[0].line}"
        may = f"{len(coloured)} of the scene's tags may have colours, the first {place}"
        reason = f"one panchromatic reflectance; {may}; what that leaves out: --colour auto"
        return PlanRow("spectrum", "off", reason, None, 0.0)
    if bench.sensor.quantum_efficiency_curve is not None:
        return PlanRow("spectrum", "off", f"{_GREY}, but the camera does; what that leaves: --colour auto", None, 0.0)
    return PlanRow("spectrum", "off", _GREY, 0.0, 0.0)


def _fixed_rows(facts: SceneFacts) -> tuple[PlanRow, ...]:
    keystone = (
        f"the projector's window is {facts.keystone:.1f} of its pixels off a square; responses are not separable"
        if facts.keystone
        else "the projector faces the aligned plane squarely"
    )
    noise = "Poisson, full well, read noise and quantisation of each frame"
    return (
        PlanRow("keystone", "exact" if facts.keystone else "off", keystone, None if facts.keystone else 0.0, 0.0),
        facts.spectrum,
        PlanRow("sensor-noise", "exact", noise, None, 0.0),
    )


# -------- Light that frames are known to lack, whatever the plan


_PATHS = 2**15
"""Paths of the pilot's shortest looks, 4 of 2 x 64 x 64: light that these miss is in no plan."""
_FEWEST = 8.0
"""Hits of a lamp by all paths below which they may meet it so seldom that nobody knows its light: of Poisson's numbers
about 8, one in 3000 is none."""


def known_losses(loaded: LoadedScene, effects: Mapping[str, bool]) -> Iterator[str]:
    """What the factored estimator does not find of a scene; nothing of effects that are switched off.

    Parameters
    ----------
    loaded
        the scene.
    effects
        switched on or off by the user.
    """
    if effects.get("ambient", True):
        yield from unseen_lamps(loaded, _PATHS, "the factored estimator")
    if effects.get("mirrors", True):
        if loaded.unfit.lamps and effects.get("ambient", True):
            yield loaded.unfit.lamps
        if loaded.unfit.instances:
            yield loaded.unfit.instances


def unseen_lamps(loaded: LoadedScene, paths: float, estimator: str) -> Iterator[str]:
    """Lamps that shine on the sensor itself, and that paths from there do not meet, or hardly.

    Parameters
    ----------
    loaded
        the scene.
    paths
        from all over the field stop.
    estimator
        whose they are, in words.
    """
    from mitsim.transport.connect import part_of_view, shines_in

    for lamp, tag in loaded.small_lamps:
        if shines_in(loaded.scene, loaded.camera, lamp):
            rule = (
                f"it shines on the sensor itself, and {estimator} has no light of a lamp but over surfaces, so that is "
                "missing; keep it out of the view, or use a light that has a surface (area)"
            )
            yield str(tag.refusal("light", repr(tag.attributes.get("type", "")), rule))
    for tag, shape in zip(loaded.shapes, loaded.scene.shapes(), strict=True) if loaded.shapes else ():
        part = part_of_view(loaded.scene, loaded.camera, shape) if shape.is_emitter() else 0.0
        if 0 < part * paths < _FEWEST:
            rule = (
                f"{estimator} meets what shines on the sensor itself by chance, and {paths:.2g} paths meet this "
                f"{part * paths:.1g} times, so its light may be missing; keep it out of the view, or take a lamp that "
                f"is {(_FEWEST / (part * paths)) ** 0.5:.2g} times as wide and as much dimmer"
            )
            yield str(tag.refusal("lamp", f"{part:.1e} of the field of view", rule))

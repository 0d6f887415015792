"""The plan of a choice: rows that say what is simulated and why, warnings, and light that frames lack in any plan.

Accuracy is the relative rms error of the expected frames, ``||a - b|| / ||b||`` over all frames and pixels, from all
that is left out, all that is made coarse, and sampling.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from mitsim.bench.effects import EFFECTS, Effect
from mitsim.bench.request import check_accuracy
from mitsim.light.cost_model import (
    Numbers,
    UnitCosts,
    accumulation_seconds,
    checking_seconds,
    entries,
    optics_seconds,
    tracing_seconds,
    truth_seconds,
)
from mitsim.light.passes import FOLLOWED
from mitsim.light.plan import LEFT_OUT, NO_TIME, ONE, WITHOUT, Plan, PlanRow, State
from mitsim.light.settings import COUNTED, WIDE, Estimate, PilotResult, Settings
from mitsim.planner.choose import Candidate, cheapest, costly_effects, counts_of, predicted_candidate, unit_costs_of
from mitsim.transport.missed import polished_shapes
from mitsim.transport.plugins.base import turn_and_origin

if TYPE_CHECKING:
    from mitsim.bench.apparatus import Apparatus
    from mitsim.scene.load import LoadedScene
    from mitsim.scene.outline import Tag


_GREY = "no surface differs by wavelength; the mask's shadow is the mean over all lines"
_FEW_WAVELENGTHS = 2
"""Mean width of a mask's openings, in wavelengths, below which scalar diffraction is a guess."""
_VAGUE = 2.0
"""An error is reported as a bound if its bound is larger than this multiple of its estimate."""


@dataclass(frozen=True)
class SceneFacts:
    """Facts about a bench that a plan reports.

    ``keystone`` is the deviation of the projector's window from a square [projector pixels], ``mirrors`` are tags of
    mirrors and curved glass, and ``spectrum`` is the row of colours.
    """

    notes: Mapping[str, str]
    keystone: float
    warnings: tuple[str, ...] = ()
    shapes: tuple[Tag, ...] = ()
    mirrors: tuple[Tag, ...] = ()
    spectrum: PlanRow = field(default_factory=lambda: PlanRow("spectrum", "off", _GREY, 0.0, 0.0))

    @classmethod
    def of(cls, bench: Apparatus, switches: Mapping[str, bool] | None = None) -> SceneFacts:
        """Collect the facts of ``bench``, without those of effects that the user's ``switches`` turn off."""
        loaded, off = bench.loaded, {name for name, on in (switches or {}).items() if not on}
        warnings = (*known_losses(loaded, switches or {}), *_limits(bench, off))
        notes = {name: effect.note(bench) for name, effect in EFFECTS.items()}
        polished = polished_shapes(loaded.scene) if loaded.mirrors and loaded.shapes else ()
        mirrors = tuple(loaded.shapes[number] for number in polished)
        return cls(notes, loaded.pixels.keystone, warnings, loaded.shapes, mirrors, _spectrum(bench))


def _limits(bench: Apparatus, off: Collection[str]) -> Iterator[str]:
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
    """Choose effects, numbers and samples, and explain the choice; ``chosen`` is the choice if it is known."""
    check_accuracy(accuracy)
    switches = switches or {}
    chosen = chosen or cheapest(accuracy, pilot_result, switches)
    explanation = _Explanation(accuracy, pilot_result, chosen, facts, switches)
    stages = _stages(pilot_result, chosen.settings, unit_costs_of(pilot_result))
    return Plan(
        accuracy=accuracy,
        effects=explanation.rows,
        predicted_seconds=sum(stages.values()),
        settings=chosen.settings,
        sampling_target=chosen.target,
        systematic_error=chosen.systematic.value,
        systematic_bound=chosen.systematic.bound,
        warnings=facts.warnings + explanation.warnings,
        predicted=stages,
    )


def _stages(pilot_result: PilotResult, settings: Settings, costs: UnitCosts) -> dict[str, float]:
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
class _NumberRow:
    """Row of a number that the plan chooses: words for one and for several, and settings with one."""

    setting: str
    one: str
    several: str
    with_one: Mapping[str, Any] = field(default_factory=dict)
    absent: str = ""


_FALLOFF = "falloff, gloss and parallax"
_FOLLOWED = "light over several surfaces, in mirrors and of lamps"
_CELLS = "{n}x{n} cells of even light"
_HIDDEN = "{hidden} projector pixels are hidden from part of the sensor"
_NUMBERS = (
    _NumberRow("anchors", f"{_FALLOFF} over the sensor: one anchor", f"{_FALLOFF}: {{n}}x{{n}} anchors",
               {"anchors": 1, "occluded_anchors": 1}),
    _NumberRow("layers", "the light is seen at {depth:.1f} mm; one layer",
               "the light is seen from {near:.0f} to {far:.0f} mm; {n} layers", {"layers": ()}),
    _NumberRow("cells", f"{_CELLS} a projector pixel", f"{_CELLS} a projector pixel"),
    _NumberRow("followed_anchors", f"{_FOLLOWED}: one point",
               f"{_FOLLOWED}: {{n}}x{{n}} in cells of {{width}}x{{width}} pixels", {"followed_anchors": 1},
               "no light over several surfaces, in mirrors or of lamps is followed"),
    # Separate anchors for these pixels save time: as many anchors for all pixels would take far more.
    _NumberRow("occluded_anchors", f"{_HIDDEN}: one anchor", f"{_HIDDEN}: {{n}}x{{n}} anchors", {},
               "few anchors serve all projector pixels"),
)  # fmt: skip


@dataclass(frozen=True)
class _Explanation:
    """Rows and warnings of a plan for its choice."""

    accuracy: float
    pilot_result: PilotResult
    chosen: Candidate
    facts: SceneFacts
    switches: Mapping[str, bool]

    @property
    def rows(self) -> tuple[PlanRow, ...]:
        keystone = self.facts.keystone
        fixed = (
            PlanRow(
                "keystone",
                "exact" if keystone else "off",
                f"the projector's window is {keystone:.1f} of its pixels off a square; responses are not separable"
                if keystone
                else "the projector faces the aligned plane squarely",
                None if keystone else 0.0,
                0.0,
            ),
            self.facts.spectrum,
            PlanRow(
                "sensor-noise", "exact", "Poisson, full well, read noise and quantisation of each frame", None, 0.0
            ),
        )
        effects = map(self._of_effect, EFFECTS.values())
        return (*map(self._of_number, _NUMBERS), *self._of_shadow(), *effects, *fixed)

    @property
    def warnings(self) -> tuple[str, ...]:
        chosen, accuracy, result = self.chosen, self.accuracy, self.pilot_result
        if chosen.total.bound <= accuracy:
            return ()
        sentences, parts = [], self._bounds_by_part()
        if result.unresolved > accuracy:
            sentences.append(
                f"{result.unresolved:.0%} of the direct light comes over lobes too sharp to sample, and the frames "
                "lack most of it; give those surfaces more roughness, or make them perfect mirrors (conductor)"
            )
        largest = max(parts, key=lambda name: parts[name])
        counts, shapes, mirrors = min(accuracy, parts[largest]), self.facts.shapes, self.facts.mirrors
        if result.mirror is not None and shapes and result.left_out >= counts:
            sentences.append(
                _refusal(
                    shapes[result.mirror],
                    f"{result.left_out:.2g} of the light comes over it and, besides, a mirror, curved glass or a sharp "
                    "lobe, where paths find it never or too seldom, so all or most of it is left out of the frames; "
                    "turn it away, make it rough, or give the projector a lens (aperture_radius_mm) with the effect "
                    "interreflection",
                )
            )
        if mirrors and result.unresolved_specular >= counts:
            kinds = Counter(str(mirror.attributes.get("type", "shape")) for mirror in mirrors)
            among = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
            sentences.append(
                _refusal(
                    mirrors[0],
                    f"{result.unresolved_specular:.2g} of the light comes over the scene's mirrors and curved glass "
                    f"alone ({among}; this is the first), in beams too fine to be placed on the sensor: it is left "
                    "out, or in the wrong pixels; use fewer or larger ones, move them apart, or make them rough",
                )
            )
        return tuple(sentences) or (
            f"the predicted total error, up to {chosen.total.bound:.1e}, exceeds the requested {accuracy:g}; "
            f"largest: {largest}, {parts[largest]:.1e}",
        )

    def _bounds_by_part(self) -> dict[str, float]:
        result, settings, raster = self.pilot_result, self.chosen.settings, self._raster_error
        sharp, width = settings.sharp, settings.followed_width
        counted = {
            f"{name.replace('_', ' ')} ({count}{'' if name == 'layers' else f'x{count}'})": result.ladders[name][count]
            for name, count in self._counts.items()
        }
        return {
            **{name: error.bound for name, error in counted.items()},
            **(
                {f"cells of their light ({width} pixels)": result.error(WIDE).bound / settings.coarse_cells**2}
                if width > 1
                else {}
            ),
            **({"the mask's raster": raster.bound} if raster and settings.raster else {}),
            **({f"anchors of sharp light ({sharp.anchors}x{sharp.anchors})": sharp.left} if sharp else {}),
            **self.chosen.lacking,
            **{f"{name} (off)": e.bound for name, e in result.effects.items() if name not in settings.effects},
        }

    @cached_property
    def _counts(self) -> dict[str, int]:
        return dict(zip(COUNTED, counts_of(self.chosen.settings), strict=True))

    def _seconds(self, **changes: Any) -> float:
        settings, costs = self.chosen.settings, unit_costs_of(self.pilot_result)
        with_it, without = (
            sum(_stages(self.pilot_result, each, costs).values()) for each in (settings, replace(settings, **changes))
        )
        return max(with_it - without, 0.0)

    def _of_number(self, row: _NumberRow) -> PlanRow:
        settings, result = self.chosen.settings, self.pilot_result
        name, count, errors = row.setting.replace("_", "-"), self._counts[row.setting], result.ladders[row.setting]
        there = {"followed_anchors": settings.effects & FOLLOWED, "occluded_anchors": result.occluded}
        if not there.get(row.setting, True):
            return PlanRow(name, "off", row.absent, 0.0, 0.0)
        reason = (row.one if count == 1 else row.several).format(
            n=count,
            depth=result.depth,
            near=settings.depths[-1],
            far=settings.depths[0],
            width=settings.followed_width,
            hidden=len(result.occluded),
        )
        left, one = _error_words(errors[count]), errors[1]
        if row.setting == "cells":
            worst = max(error.value for error in errors.values())
            return PlanRow(name, "approximate", f"{reason} leave {left}", worst, 0.0)
        if count == 1:
            return PlanRow(name, "off", f"{reason} leaves {left}", one.value, 0.0)
        seconds = self._seconds(**row.with_one)
        return PlanRow(name, "approximate", f"{reason} leave {left}{ONE} {_error_words(one)}", one.value, seconds)

    @property
    def _waves(self) -> bool:
        return any(EFFECTS[name].in_shadow for name in self.chosen.settings.effects)

    @property
    def _raster_error(self) -> Estimate | None:
        return self.pilot_result.raster[self._waves].error_left(self.chosen.settings.raster_cells)

    def _of_shadow(self) -> Iterator[PlanRow]:
        """Describe how frames behind a mask of more than two separable terms are formed."""
        left, settings = self._raster_error, self.chosen.settings
        if left is None:
            return
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
            yield PlanRow("mask-shadow", "approximate", reason, None, spent)
            return
        sums, terms = seconds(0), f"{self.pilot_result.forming.geometric_terms:.0f} separable terms"
        if settings.raster:
            reason = f"{terms}: by FFT {on_raster}, {by_fft:.2g} s, which leaves {leaves}; their sum takes {sums:.2g} s"
            yield PlanRow("mask-shadow", "approximate", reason, 0.0, max(by_fft, 0.0))
            return
        reason = f"{terms} are summed, {sums:.2g} s; by FFT {on_raster}, {by_fft:.2g} s, {leaves} would be left"
        yield PlanRow("mask-shadow", "exact", reason, left.value, sums)

    def _of_effect(self, effect: Effect) -> PlanRow:
        settings, name = self.chosen.settings, effect.name
        on, takes_time = name in settings.effects, name in costly_effects()
        state: State = "exact" if on else "off"
        error = self.pilot_result.effects.get(name)
        if error is None:
            return PlanRow(name, state, effect.absent or "nothing in the scene calls for it", 0.0, 0.0)
        less = settings.effects - {name}
        sentences = [self.facts.notes.get(name, ""), "switched by the user" if name in self.switches else ""]
        sentences.append(f"{LEFT_OUT} {_error_words(error)}")
        if on and name not in self.switches and takes_time:
            other = predicted_candidate(self.accuracy, self.pilot_result, replace(settings, effects=less), {})
            total = math.hypot(other.systematic.bound, self.chosen.noise)
            sentences.append(f"{WITHOUT} would be up to {total:.1e}, and {self.accuracy:g} is allowed")
        elif on and name not in self.switches:
            sentences.append(NO_TIME)
        seconds = self._seconds(effects=less) if on and takes_time else 0.0
        return PlanRow(name, state, "; ".join(filter(None, sentences)), error.value, seconds)


def _refusal(tag: Tag, rule: str) -> str:
    return str(tag.refusal("shape", repr(tag.attributes.get("type", "")), rule))


def _error_words(error: Estimate) -> str:
    """Return an error as text, as a bound if it cannot be told from zero."""
    if error.bound == 0:
        return "0"
    return f"{error.value:.1e}" if error.bound < _VAGUE * error.value else f"less than {error.bound:.1e}"


def _spectrum(bench: Apparatus) -> PlanRow:
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


# -------- Light that frames are known to lack, whatever the plan


_PATHS = 2**15
"""Paths of the pilot's shortest runs."""
_FEWEST = 8.0
"""Hits of a lamp below which its light may be unknown: a Poisson number of mean 8 is zero once in 3000."""


def known_losses(loaded: LoadedScene, effects: Mapping[str, bool]) -> Iterator[str]:
    """Describe light of a scene that the factored estimator does not find, except that of ``effects`` switched off."""
    if effects.get("ambient", True):
        yield from unseen_lamps(loaded, _PATHS, "the factored estimator")
    if effects.get("mirrors", True):
        if loaded.unfit.lamps and effects.get("ambient", True):
            yield loaded.unfit.lamps
        if loaded.unfit.instances:
            yield loaded.unfit.instances


def unseen_lamps(loaded: LoadedScene, paths: float, estimator: str) -> Iterator[str]:
    """Describe lamps that shine on the sensor directly and that ``paths`` of an ``estimator`` rarely meet."""
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

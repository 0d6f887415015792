"""The plan of a capture, made from a short pilot run for a given accuracy or a given time.

Accuracy is the relative rms error of the expected frames, ``||a - b|| / ||b||`` over all frames and pixels, from
sampling, omissions and coarse numbers.
"""

from __future__ import annotations

import math
import time
from bisect import bisect_left
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import drjit as dr

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import EFFECTS
from mitsim.bench.request import HIGHEST_ACCURACY, check_accuracy
from mitsim.core.arrays import Labels
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer
from mitsim.devices.patterns import Lighting
from mitsim.light import cost_model
from mitsim.light.passes import FOLLOWED, PASSES, Simulation
from mitsim.light.plan import Plan, PlanRow, State
from mitsim.light.settings import COUNTED, GROUPS, WIDE, Estimate, PilotResult, Settings
from mitsim.optics.diffraction import check_openings
from mitsim.optics.fft_shadow import check_waves
from mitsim.planner import choose, pilot
from mitsim.scene.load import LoadedScene
from mitsim.transport.connect import part_of_view, shines_in
from mitsim.transport.plugins.base import turn_and_origin

_OPENING_S = 1.5
"""Seconds to start the program and open a scene (1.2 to 1.6 on two cores)."""
_FIRST_ACCURACY = 1e-3
"""Accuracy of the first pilot for a time."""
_GRID = [HIGHEST_ACCURACY, *(float(f"{10 ** (-step / 10):.3g}") for step in range(6, 51))]
"""Accuracies for a time: ten a decade, to near the end of the ladders of anchors and cells."""
_TIMED = 2**18
"""Paths that measure the pace of this machine."""
_FOR_HEAVY_PATHS = 2**21
"""Paths from the camera that a run with sharp lobes has at least: half a second."""
_SELDOM = 3.0
"""Ratio of what a closer run may save to its work below which it is not made: it seldom saves that."""
_OF_RUN = 0.2
"""Part of the work on light and frames that closer runs may take in total."""


@single_threaded_blas()
def make_plan(
    bench: Apparatus,
    lighting: Lighting,
    accuracy: float,
    seed: int,
    switches: Mapping[str, bool] | None = None,
    lines: int = 1,
) -> Plan:
    check_accuracy(accuracy)
    started, look = time.perf_counter(), _look(bench, lighting, accuracy, seed, switches or {}, lines)
    return _explain(accuracy, look, look.taken(accuracy), started)


@single_threaded_blas()
def plan_within(bench: Apparatus, lighting: Lighting, seconds: float, seed: int, switches: Mapping[str, bool]) -> Plan:
    """Make the plan of the finest accuracy that is predicted to take at most ``seconds`` from the program's start.

    A pilot predicts what finer accuracies than its own take, but not whether they are kept; so a second one looks at
    the finest that there is time for. Predictions use fixed unit costs, so that the same time gives the same plan.
    """
    started, accuracy, tried = time.perf_counter(), _FIRST_ACCURACY, list[tuple[float, float, _Look]]()
    left = seconds - _OPENING_S - sum(cost_model.frame_seconds(bench, len(lighting.weights)).values())
    while len(tried) < 2:
        look = _look(bench, lighting, accuracy, seed, switches, 1)
        left -= look.runs.seconds
        found = _finest(look, left, accuracy)
        tried.append((found, look.seconds(found) - left, look))
        accuracy = _finest(look, left - look.runs.seconds)
        if tried[0][1] > 0 or accuracy >= found:
            break
    accuracy, over, look = min((each for each in tried if each[1] <= 0), key=lambda each: each[0], default=tried[0])
    plan = replace(_explain(accuracy, look, look.taken(accuracy), started), asked_seconds=seconds)
    few = (
        f"{seconds:g} seconds are too few: even accuracy {accuracy:g}, which was taken, is predicted to take "
        f"{seconds + over:.1f} s from start to finish; give more"
    )
    return plan if over <= 0 else replace(plan, warnings=(few, *plan.warnings))


def _finest(look: _Look, seconds: float, kept_from: float | None = None) -> float:
    """Return the finest accuracy whose light takes at most ``seconds``, or the loosest if none does.

    With ``kept_from``, the accuracy must be kept, and is no finer than that.
    """

    def fails(tried: float) -> bool:
        kept = kept_from is None or (tried >= kept_from and look.taken(tried).fits)
        return look.seconds(tried) > seconds or not kept

    return _GRID[max(bisect_left(_GRID, True, key=fails) - 1, 0)]


class _Look(NamedTuple):
    """A pilot run that serves one accuracy, and what it shows of others."""

    runs: pilot.PilotRuns
    candidates: choose.Candidates
    notes: tuple[str, ...]

    def taken(self, accuracy: float) -> choose.Candidate:
        chosen, result = self.candidates.choice(accuracy), self.runs.pilot_result
        if result.sharp is None:
            return chosen
        # Light over two sharp lobes comes in paths so rare that nothing shows it where the first samples meet none.
        samples, costs = dict(chosen.settings.samples), result.sample_costs
        for name in ("from_camera", "camera_residual"):
            if samples.get(name) and costs[name].paths:
                samples[name] = max(samples[name], _FOR_HEAVY_PATHS / (GROUPS * costs[name].paths))
        return replace(chosen, settings=replace(chosen.settings, samples=samples))

    def seconds(self, accuracy: float) -> float:
        return sum(_stages(self.runs.pilot_result, self.taken(accuracy).settings, 1.0).values())


def _look(
    bench: Apparatus, lighting: Lighting, accuracy: float, seed: int, switches: Mapping[str, bool], lines: int
) -> _Look:
    if bench.loaded.unfit.factored is not None:
        raise bench.loaded.unfit.factored
    if bench.geometry.diffracts and switches.get("diffraction") is not False:
        check_openings(bench.geometry.build_mask(), float(bench.spectrum.wavelengths_nm.max()))
        check_waves(bench.geometry, bench.spectrum)
    spent, notes = 0.0, tuple[str, ...]()
    runs = pilot.PilotRuns(bench, lighting, accuracy, seed, lines)
    while True:  # Pilot runs are repeated with more samples while that is worth its work.
        candidates = choose.Candidates(runs.pilot_result, switches)
        worth, part = choose.value_of_refining(accuracy, candidates)
        run = pilot.run_of(part)
        work = runs.work(run)
        if _SELDOM * work > worth:
            break
        spent += work
        whole = candidates.choice(accuracy).work
        if spent > _OF_RUN * whole:
            note = (
                f"{part.name.replace('_', ' ')} and all settings that depend on them have safe values, because "
                f"measuring them would take {spent:.1f} s, more than a fifth of the {whole:.1f} s for light and frames"
            )
            notes = (note,)
            break
        runs.refine(run)
    return _Look(runs, candidates, notes)


def _explain(accuracy: float, look: _Look, taken: choose.Candidate, started: float) -> Plan:
    (runs, candidates, notes), bench = look, look.runs.bench
    simulation, switches = Simulation(bench, taken.settings), candidates.switches
    pace = _measure_pace(runs.pilot_result, simulation, runs.lighting.labels, integer(runs.seed, "pilot", "paces"))
    plan = explain_plan(accuracy, runs.pilot_result, taken, SceneFacts.of(bench, switches), switches, pace)
    if simulation.physics.mirrors:
        # The pilot formed the frames of other shots, or of fewer effects, from the same beams.
        plan = plan.taking(optics=plan.predicted["optics"] + bench.specular.seconds)
    return replace(plan.taking(plan=time.perf_counter() - started), notes=notes)


def _measure_pace(result: PilotResult, simulation: Simulation, labels: Labels, seed: int) -> float:
    """Return the ratio of the measured to the fixed time of a path, in the pass that is predicted to take longest."""
    planned = cost_model.tracing_seconds(result, simulation.settings)
    name = max(simulation.passes, key=lambda name: planned.get(name, 0.0))
    row, each, seconds = PASSES[name], simulation.passes[name], list[float]()
    samples = max(1, min(_TIMED // each.tracer.paths_per_sample, each.whole))
    for _ in range(2):  # The first launch may compile the kernel.
        started = time.perf_counter()
        found = each.trace(seed, 0, samples, simulation.accumulator(name, labels, 1))
        simulation.accumulate(name, found, labels, samples)
        dr.sync_thread()  # Sums on the device run asynchronously.
        seconds.append(time.perf_counter() - started)
    # A path of shared light counts for several.
    paths = result.sample_costs[name].paths if name == "indirect" else each.tracer.paths_per_sample
    return min(seconds) / (samples * paths * row.unit_cost * float(row.connections(simulation.settings)))


# -------- The table of a plan

_FEW_WAVELENGTHS = 2
"""Mean width of a mask's openings, in wavelengths, below which scalar diffraction is a guess."""
_VAGUE = 2.0
"""An error is reported as a bound if its bound is larger than this multiple of its estimate."""
_NUMBERS: Mapping[str, tuple[str, str, Mapping[str, Any]]] = {
    "anchors": ("falloff, gloss and parallax over the sensor: {n}x{n} anchors", "",
                {"anchors": 1, "occluded_anchors": 1}),
    "layers": ("light from {near:.0f} to {far:.0f} mm: {n} of its depths", "", {"layers": ()}),
    "cells": ("{n}x{n} cells of even light a projector pixel", "", {}),
    "followed_anchors": ("light over several surfaces, in mirrors and of lamps: {n}x{n} points, in cells of "
                         "{width}x{width} pixels", "no light over several surfaces, in mirrors or of lamps is followed",
                         {"followed_anchors": 1}),
    # Separate anchors for hidden pixels save time: as many anchors for all pixels would take far more.
    "occluded_anchors": ("{hidden} projector pixels are hidden from part of the sensor: {n}x{n} anchors",
                         "few anchors serve all projector pixels", {}),
}  # fmt: skip
"""Numbers that a plan chooses: their words where they count and where they do not, and the settings with one."""
_REMEDIES = {
    choose.SHARP_LOBES: "give those surfaces more roughness, or make them perfect mirrors (conductor)",
    choose.MIRRORS_TWICE: (
        "turn those surfaces away, make them rough, or give the projector a lens (aperture_radius_mm) with the effect "
        "interreflection"
    ),
    choose.SMALL_MIRRORS: "use fewer or larger mirrors and glasses, move them apart, or make them rough",
}
"""What helps against light that is missing, by its cause."""


def explain_plan(
    accuracy: float,
    pilot_result: PilotResult,
    chosen: choose.Candidate,
    facts: SceneFacts,
    switches: Mapping[str, bool],
    pace: float,
) -> Plan:
    """Return the plan of a choice, with its reasons; a path takes ``pace`` times as long as its fixed cost."""
    stages = _stages(pilot_result, chosen.settings, pace)
    return Plan(
        accuracy=accuracy,
        effects=tuple(_rows(pilot_result, chosen.settings, facts, switches, pace)),
        predicted_seconds=sum(stages.values()),
        settings=chosen.settings,
        sampling_target=chosen.target,
        systematic_error=chosen.systematic.value,
        systematic_bound=chosen.systematic.bound,
        warnings=(*facts.warnings, *_shortfall(accuracy, pilot_result, chosen)),
        predicted=stages,
    )


def _stages(pilot_result: PilotResult, settings: Settings, pace: float) -> dict[str, float]:
    forming, numbers = pilot_result.forming, cost_model.Numbers.of(settings)
    held = cost_model.entries(pilot_result.sample_costs["direct"].paths, forming.classes, numbers, settings)
    tracing = sum(cost_model.tracing_seconds(pilot_result, settings).values())
    accumulating = float(cost_model.accumulation_seconds(forming, numbers, held))
    checking = float(cost_model.checking_seconds(forming, numbers))
    return {
        "transport": pace * tracing + accumulating + checking,
        "truth": pace * cost_model.truth_seconds(pilot_result, settings),
        "optics": float(cost_model.optics_seconds(forming, numbers)),
    }


def _rows(
    result: PilotResult, settings: Settings, facts: SceneFacts, switches: Mapping[str, bool], pace: float
) -> Iterator[PlanRow]:
    costly, waves = choose.costly_effects(), cost_model.in_waves(settings.effects)
    now = sum(_stages(result, settings, pace).values())

    def saved(**changes: Any) -> float:
        return max(now - sum(_stages(result, replace(settings, **changes), pace).values()), 0.0)

    for name, count in zip(COUNTED, choose.counts_of(settings), strict=True):
        words, unused, with_one = _NUMBERS[name]
        errors, row = result.ladders[name], name.replace("_", "-")
        if unused and not (settings.effects & FOLLOWED if name == "followed_anchors" else result.occluded):
            yield PlanRow(row, "off", unused, 0.0, 0.0)
            continue
        reason = words.format(
            n=count, near=settings.depths[-1], far=settings.depths[0], width=settings.followed_width,
            hidden=len(result.occluded),
        )  # fmt: skip
        state: State = "off" if count == 1 and name != "cells" else "approximate"
        if_off = max(error.value for error in errors.values()) if name == "cells" else errors[1].value
        seconds = saved(**with_one) if count > 1 else 0.0
        yield PlanRow(row, state, f"{reason}, which leaves {_words(errors[count])}", if_off, seconds)

    drawn = result.raster[waves]
    left = drawn.error_left(settings.raster_cells)
    if left is not None:  # The mask has more than two separable terms.
        cells = settings.raster_cells or drawn.cells[0]
        by_fft, sums = (
            float(cost_model.optics_seconds(result.forming, cost_model.Numbers.of(replace(settings, raster_cells=own))))
            for own in (cells, 0)
        )
        if settings.raster or drawn.needed:
            reason = f"by FFT on a raster of {cells} cells a pixel, which leaves {_words(left)}"
            yield PlanRow("mask-shadow", "approximate", reason, None if drawn.needed else 0.0, by_fft)
        else:
            reason = f"{result.forming.geometric_terms:.0f} separable terms are summed; by FFT it takes {by_fft:.2g} s"
            yield PlanRow("mask-shadow", "exact", reason, left.value, sums)

    for name, effect in EFFECTS.items():
        on, error = name in settings.effects, result.effects.get(name)
        state = "exact" if on else "off"
        if error is None:
            yield PlanRow(name, state, effect.absent or "no part of the scene needs it", 0.0, 0.0)
            continue
        parts = [facts.notes.get(name, ""), "switched by the user" if name in switches else ""]
        if error.bound >= _VAGUE * error.value and error.bound:
            parts.append(f"left out, the frames change by {_words(error)}")
        seconds = saved(effects=settings.effects - {name}) if on and name in costly else 0.0
        yield PlanRow(name, state, "; ".join(filter(None, parts)), error.value, seconds)

    if facts.keystone:
        off = f"the projector's window is {facts.keystone:.1f} of its pixels off a square; responses are not separable"
        yield PlanRow("keystone", "exact", off, None, 0.0)
    else:
        yield PlanRow("keystone", "off", "the projector faces the aligned plane squarely", 0.0, 0.0)
    yield facts.spectrum
    noise = "Poisson, full well, read noise and quantisation of each frame"
    yield PlanRow("sensor-noise", "exact", noise, None, 0.0)


def _words(error: Estimate) -> str:
    if error.bound == 0:
        return "0"
    return f"{error.value:.1e}" if error.bound < _VAGUE * error.value else f"less than {error.bound:.1e}"


def _shortfall(accuracy: float, result: PilotResult, chosen: choose.Candidate) -> list[str]:
    """Return why the choice misses the accuracy, with a remedy where light is missing; empty if it is kept."""
    if chosen.total.bound <= accuracy:
        return []
    settings, counts = chosen.settings, zip(COUNTED, choose.counts_of(chosen.settings), strict=True)
    parts = {f"{name.replace('_', ' ')} ({count})": result.ladders[name][count].bound for name, count in counts}
    raster = result.raster[cost_model.in_waves(settings.effects)].error_left(settings.raster_cells)
    if settings.followed_width > 1:
        wide = f"cells of their light ({settings.followed_width} pixels)"
        parts[wide] = result.error(WIDE).bound / settings.coarse_cells**2
    if raster and settings.raster:
        parts["the mask's raster"] = raster.bound
    if sharp := settings.sharp:
        parts[f"anchors of sharp light ({sharp.anchors})"] = sharp.left
    parts |= {f"{name} (off)": error.bound for name, error in result.effects.items() if name not in settings.effects}
    parts |= chosen.lacking
    largest = max(parts, key=lambda name: parts[name])
    remedy = f"; {_REMEDIES[largest]}" if largest in _REMEDIES else ""
    return [
        f"the predicted total error, up to {chosen.total.bound:.1e}, exceeds the requested {accuracy:g}; largest: "
        f"{largest}, {parts[largest]:.1e}{remedy}"
    ]


# -------- Facts about a bench that a plan reports


_GREY = "no surface differs by wavelength; the mask's shadow is the mean over all lines"


@dataclass(frozen=True)
class SceneFacts:
    notes: Mapping[str, str]
    keystone: float
    warnings: tuple[str, ...] = ()
    spectrum: PlanRow = field(default_factory=lambda: PlanRow("spectrum", "off", _GREY, 0.0, 0.0))

    @classmethod
    def of(cls, bench: Apparatus, switches: Mapping[str, bool] | None = None) -> SceneFacts:
        loaded, off = bench.loaded, {name for name, on in (switches or {}).items() if not on}
        warnings = (*known_losses(loaded, switches or {}), *_limits(bench, off))
        notes = {name: effect.note(bench) for name, effect in EFFECTS.items()}
        reason, curve = _GREY, bench.sensor.quantum_efficiency_curve
        state: State = "off"
        if bench.lines is not None:
            nanometres = ", ".join(f"{wave:g}" for wave in bench.lines.wavelengths_nm)
            state, reason = "exact", f"all is simulated at {nanometres} nm"
        elif loaded.coloured:
            may = f"{len(loaded.coloured)} of the scene's tags may have colours"
            first = f"the first {loaded.coloured[0].path.name}:{loaded.coloured[0].line}"
            reason = f"one panchromatic reflectance; {may}, {first}; --colour lines simulates them"
        elif curve is not None:
            reason = f"{_GREY}, but the camera does; --colour lines simulates this"
        spectrum = PlanRow("spectrum", state, reason, 0.0 if reason == _GREY else None, 0.0)
        return cls(notes, loaded.pixels.keystone, warnings, spectrum)


def _limits(bench: Apparatus, off: Collection[str]) -> Iterator[str]:
    geometry, waves = bench.geometry, "diffraction" not in off
    if bench.projector.glare and bench.loaded.mirrors and not {"glare", "mirrors"} & set(off):
        yield (
            f"{bench.projector.glare:.2g} of the light over mirrors alone is to be scattered in the projector's lens "
            "(ansi_contrast), but stays in its own pixels; if no scattering is intended, use --effects=-glare"
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
            f"one ({geometry.mask_words}) has more; if a geometric shadow is intended, use --effects=-diffraction"
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
    for lamp, tag in loaded.small_lamps:
        if shines_in(loaded.scene, loaded.camera, lamp):
            rule = (
                f"it shines directly on the sensor, and {estimator} simulates light of such lamps only by way of "
                "surfaces, so that this light is missing; keep it out of the view, or use a light that has a surface "
                "(area)"
            )
            yield str(tag.refusal("light", repr(tag.attributes.get("type", "")), rule))
    for tag, shape in zip(loaded.shapes, loaded.scene.shapes(), strict=True) if loaded.shapes else ():
        part = part_of_view(loaded.scene, loaded.camera, shape) if shape.is_emitter() else 0.0
        if 0 < part * paths < _FEWEST:
            rule = (
                f"{estimator} finds light that shines directly on the sensor only by chance: {paths:.2g} paths meet "
                f"this lamp {part * paths:.1g} times, so that its light may be missing; keep it out of the view, or "
                f"take a lamp that is {(_FEWEST / (part * paths)) ** 0.5:.2g} times as wide and correspondingly dimmer"
            )
            yield str(tag.refusal("lamp", f"{part:.1e} of the field of view", rule))

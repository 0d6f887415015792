"""The plan of a capture, made from a short pilot run for a given accuracy or a given time.

Accuracy is the relative rms error of the expected frames, ``||a - b|| / ||b||`` over all frames and pixels, from
sampling, omissions and coarse numbers.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import drjit as dr

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import EFFECTS
from mitsim.bench.request import check_accuracy
from mitsim.core.arrays import Labels
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer
from mitsim.devices.patterns import Lighting
from mitsim.light import cost_model
from mitsim.light.passes import FOLLOWED
from mitsim.light.plan import Plan, PlanRow, State
from mitsim.light.settings import (
    COUNTED,
    GROUPS,
    MOST_PATHS,
    REPLICATES,
    WIDE,
    Estimate,
    PilotResult,
    SampleCost,
    Settings,
)
from mitsim.light.simulation import Simulation
from mitsim.optics.diffraction import check_openings
from mitsim.optics.fft_shadow import check_waves
from mitsim.planner import choose, pilot
from mitsim.transport.connect import part_of_view, shines_in
from mitsim.transport.missed import polished_shapes
from mitsim.transport.plugins.base import turn_and_origin

if TYPE_CHECKING:
    from mitsim.scene.load import LoadedScene
    from mitsim.scene.outline import Tag

OPENING_S = 1.5
"""Seconds to start the program and open a scene (1.2 to 1.6 on two cores)."""
_LONGER = 2.0
"""Seconds of a second, finer pilot over those of the first."""
_REHEARSED = 2**16
_SELDOM = 3.0
"""Ratio of what a closer run may save to its work below which it is not made: it seldom saves that."""
_OF_RUN = 0.2
"""Part of the work on light and frames that closer runs may take in total."""
_MORE, _OF_ALL, _TIMED = 4, 0.1, 0.02
_MOSTLY = 0.75
_USUAL = 1.5
"""Ratio to its fixed cost from which a launch was disturbed, and is repeated."""
_LEAST_SLOPE = 0.25
"""Smallest part of a path's seconds in a launch that grows with the paths."""
_HEAVY_PATHS, _MOST_HEAVY_PATHS = 2**19, 2**23
"""First and largest number of paths that search for heavy paths, 0.1 s and 1 s."""
_FEW, _FEWEST = 8.0, 4.0
_LEAST, _MOST = 0.7, 5.0
"""Ratios of actual to planned work on few heavy paths: nine of ten runs lie between."""
_HEAVIER = 1.25


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
    _refuse_unfit(bench, switches or {})
    started = time.perf_counter()
    runs = pilot.PilotRuns(bench, lighting, accuracy, seed, lines)
    candidates, notes = _refine(runs, accuracy, switches or {})
    plan = _decide(runs, accuracy, candidates).taking(plan=time.perf_counter() - started)
    return replace(plan, notes=notes)


def _refine(
    runs: pilot.PilotRuns, accuracy: float, switches: Mapping[str, bool]
) -> tuple[choose.Candidates, tuple[str, ...]]:
    """Repeat pilot runs with more samples while that is worth its work; return candidates and notes."""
    spent = 0.0
    while True:
        candidates = choose.Candidates(runs.pilot_result, switches)
        worth, part = choose.value_of_refining(accuracy, candidates)
        run = pilot.run_of(part)
        work = runs.work(run)
        if _SELDOM * work > worth:
            return candidates, ()
        spent += work
        whole = candidates.choice(accuracy).work
        if spent > _OF_RUN * whole:
            note = (
                f"{part.name.replace('_', ' ')} and all that hangs on them are chosen safely: to look closer would "
                f"take {spent:.1f} s, more than a fifth of the {whole:.1f} s of light and frames"
            )
            return candidates, (note,)
        runs.refine(run)


@single_threaded_blas()
def plan_within(
    bench: Apparatus, lighting: Lighting, seconds: float, seed: int, switches: Mapping[str, bool] | None = None
) -> Plan:
    """Make the plan of the finest accuracy that is predicted to take at most ``seconds`` from the program's start.

    Predictions use fixed unit costs, so that the same time gives the same plan.
    """
    started, switches = time.perf_counter(), switches or {}
    _refuse_unfit(bench, switches)
    around = OPENING_S + sum(cost_model.frame_seconds(bench, len(lighting.weights)).values())
    runs = pilot.PilotRuns(bench, lighting, choose.FIRST_ACCURACY, seed)
    around += runs.seconds
    again = _LONGER * runs.seconds
    candidates = choose.Candidates(runs.pilot_result, switches)
    found = choose.accuracy_for_time(candidates, seconds - around, choose.FIRST_ACCURACY)
    # A pilot run predicts the cost of finer accuracies than its own, but not whether they are kept.
    aim = choose.accuracy_for_time(candidates, seconds - around - again, 0.0, kept=False)
    if found.fits and aim.fits and aim.accuracy < choose.FIRST_ACCURACY:
        around += again
        closer = pilot.PilotRuns(bench, lighting, aim.accuracy, seed)
        others = choose.Candidates(closer.pilot_result, switches)
        finer = choose.accuracy_for_time(others, seconds - around, aim.accuracy)
        # The closer runs may keep no accuracy at all, and then give the loosest.
        if finer.fits and finer.accuracy <= found.accuracy:
            runs, candidates, found = closer, others, finer
    plan = _decide(runs, found.accuracy, candidates).taking(plan=time.perf_counter() - started)
    warnings = plan.warnings
    if not found.fits:
        warnings = (
            f"{seconds:g} seconds are too few: even accuracy {found.accuracy:g}, which was taken, is predicted to take "
            f"{found.seconds + around:.1f} s from start to finish; give more",
            *warnings,
        )
    return replace(plan, asked_seconds=seconds, warnings=warnings)


def _refuse_unfit(bench: Apparatus, switches: Mapping[str, bool]) -> None:
    if bench.loaded.unfit.factored is not None:
        raise bench.loaded.unfit.factored
    if bench.geometry.diffracts and switches.get("diffraction") is not False:
        check_openings(bench.geometry.build_mask(), float(bench.spectrum.wavelengths_nm.max()))
        check_waves(bench.geometry, bench.spectrum)


def _decide(runs: pilot.PilotRuns, accuracy: float, candidates: choose.Candidates) -> Plan:
    pilot_result, switches, bench = candidates.pilot_result, candidates.switches, runs.bench
    chosen = candidates.choice(accuracy)
    if pilot_result.sharp is not None and Simulation(bench, chosen.settings).from_camera is not None:
        pilot_result, chosen = _with_heavy_paths(runs, accuracy, chosen, switches)
    simulation = Simulation(bench, chosen.settings)
    timed = _time_paths(pilot_result, simulation, runs.lighting.labels, runs.seed)
    plan = explain_plan(accuracy, timed, SceneFacts.of(bench, switches), switches, chosen)
    plan = replace(plan, predicted_range=_range(timed, plan))
    if simulation.physics.mirrors:
        # The pilot formed the frames of other shots, or of fewer effects, from the same beams.
        plan = plan.taking(optics=plan.predicted["optics"] + bench.specular.seconds)
    return plan


def _with_heavy_paths(
    runs: pilot.PilotRuns, accuracy: float, chosen: choose.Candidate, switches: Mapping[str, bool]
) -> tuple[PilotResult, choose.Candidate]:
    plain = cost_model.tracing_seconds(runs.pilot_result, chosen.settings, cost_model.FIXED)
    paths = _HEAVY_PATHS
    while True:
        known = runs.pilot_result.sample_costs
        heavier = {
            name: replace(known[name], noise=sample_cost.noise)
            for name, sample_cost in runs.heavy(max(1, paths // (REPLICATES * known["from_camera"].paths))).items()
            if sample_cost.variance > known[name].variance
        }
        pilot_result = runs.pilot_result.with_sample_costs(heavier)
        planned = choose.predicted_candidate(accuracy, pilot_result, chosen.settings, switches)
        seconds = cost_model.tracing_seconds(pilot_result, planned.settings, cost_model.FIXED)
        if sum(seconds.values()) <= _HEAVIER * sum(plain.values()):
            return runs.pilot_result, chosen
        paths *= _MORE
        asked = {name: seconds[name] / cost_model.FIXED.passes[name] for name in heavier}
        few = any(sample_cost.noise.heavy < _FEW for sample_cost in heavier.values())
        if paths > (_MOST_HEAVY_PATHS if few else min(_MOST_HEAVY_PATHS, _OF_ALL * sum(asked.values()))):
            samples = dict(planned.settings.samples)
            samples |= {name: MOST_PATHS / count * samples[name] for name, count in asked.items() if count > MOST_PATHS}
            return pilot_result, replace(planned, settings=replace(planned.settings, samples=samples))


def _range(pilot_result: PilotResult, plan: Plan) -> tuple[float, float] | None:
    """Return the seconds between which nine of ten runs end, if few heavy paths make most of their noise."""
    costs, least, most = choose.unit_costs_of(pilot_result), 0.0, 0.0
    for name, seconds in cost_model.tracing_seconds(pilot_result, plan.settings, costs).items():
        heavy = pilot_result.sample_costs[name].noise.heavy
        if seconds and math.isfinite(heavy):
            limit = MOST_PATHS * costs.passes[name]
            least += (_LEAST - 1) * seconds
            most += max((min(_MOST * seconds, limit) if heavy >= _FEWEST else limit) - seconds, 0.0)
    total = plan.predicted_seconds
    return (total + least, total + most) if most else None


def _seconds(simulation: Simulation, name: str, seed: int, labels: Labels, samples: int) -> float:
    accumulator = simulation.accumulator(name, labels, 1)
    started = time.perf_counter()
    simulation.accumulate(name, simulation.passes[name].trace(seed, 0, samples, accumulator), labels, samples)
    # Sums on the device run asynchronously.
    dr.sync_thread()
    return time.perf_counter() - started


def _time_paths(pilot_result: PilotResult, simulation: Simulation, labels: Labels, seed: int) -> PilotResult:
    own, spread = integer(seed, "pilot", "paces"), pilot_result.spread
    fixed = {name: 0.0 for name in simulation.passes} | cost_model.tracing_seconds(
        pilot_result, simulation.settings, cost_model.FIXED
    )
    timed, ratios, ray = dict[str, float](), dict[str, float](), 0.0
    for name in sorted(simulation.passes, key=lambda name: -fixed[name]):
        rest = sum(seconds for other, seconds in fixed.items() if other not in timed)
        if timed and rest <= (1 - _MOSTLY) * sum(fixed.values()):
            break
        # A path of shared light counts for several.
        own_paths = simulation.passes[name].tracer.paths_per_sample
        paths = pilot_result.sample_costs[name].paths if name == "indirect" else own_paths
        seconds, alone = _pace(simulation, name, labels, own)
        timed[name], ratios[name] = seconds / paths, seconds / paths / cost_model.FIXED.passes[name]
        if name == "direct":
            ray = alone / paths
    whole = sum(fixed[name] for name in timed)
    # If no pass takes any time, all timed passes have equal weight.
    by = {name: fixed[name] / whole if whole else 1 / len(timed) for name in timed}
    slower = sum(by[name] * ratio for name, ratio in ratios.items()) if timed else 1.0
    found = {
        name: replace(
            pilot_result.sample_costs.get(name, SampleCost.none()),
            seconds=timed.get(name, slower * cost_model.FIXED.passes[name]),
        )
        for name in simulation.passes
    }
    spread = replace(spread, seconds=ray or slower * cost_model.FIXED.passes["direct"])
    return replace(pilot_result.with_sample_costs(found), spread=spread)


def _pace(simulation: Simulation, name: str, labels: Labels, seed: int) -> tuple[float, float]:
    each, at_once = simulation.passes[name], simulation.paths_at_once
    planned, paths_per_sample = each.whole, each.tracer.paths_per_sample
    every = GROUPS * planned

    def once(samples: int) -> float:
        seconds = _seconds(simulation, name, seed, labels, samples)
        # The first launch may compile the kernel, and a short disturbance would be multiplied.
        unusual = seconds > _USUAL * samples * paths_per_sample * cost_model.FIXED.passes[name]
        again = unusual and (samples == 1 or samples <= _TIMED * every)
        return min(seconds, _seconds(simulation, name, seed, labels, samples)) if again else seconds

    launch = once(1)
    samples = max(1, _REHEARSED // paths_per_sample)
    longest = once(samples) if samples > 1 else launch
    least = longest / samples
    while _MORE * samples * paths_per_sample <= at_once and _MORE * samples <= _TIMED * every:
        samples *= _MORE
        longest = once(samples)
        least = min(least, longest / samples)
    slope = min(max((longest - launch) / (samples - 1), _LEAST_SLOPE * least), least) if samples > 1 else launch
    launches = cost_model.ROUNDS * math.ceil(planned / max(1, at_once // paths_per_sample))
    return slope + max(launch - slope, 0.0) * launches / planned, slope


# -------- The table of a plan

_FEW_WAVELENGTHS = 2
"""Mean width of a mask's openings, in wavelengths, below which scalar diffraction is a guess."""
_VAGUE = 2.0
"""An error is reported as a bound if its bound is larger than this multiple of its estimate."""
_FALLOFF = "falloff, gloss and parallax"
_FOLLOWED = "light over several surfaces, in mirrors and of lamps"
_CELLS = "{n}x{n} cells of even light a projector pixel"
_HIDDEN = "{hidden} projector pixels are hidden from part of the sensor"
# Separate anchors for hidden pixels save time: as many anchors for all pixels would take far more.
_NUMBERS: Mapping[str, tuple[str, str, Mapping[str, Any]]] = {
    "anchors": (f"{_FALLOFF} over the sensor: one anchor", f"{_FALLOFF}: {{n}}x{{n}} anchors",
                {"anchors": 1, "occluded_anchors": 1}),
    "layers": ("the light is seen at {depth:.1f} mm; one layer",
               "the light is seen from {near:.0f} to {far:.0f} mm; {n} layers", {"layers": ()}),
    "cells": (_CELLS, _CELLS, {}),
    "followed_anchors": (f"{_FOLLOWED}: one point", f"{_FOLLOWED}: {{n}}x{{n}} in cells of {{width}}x{{width}} pixels",
                         {"followed_anchors": 1}),
    "occluded_anchors": (f"{_HIDDEN}: one anchor", f"{_HIDDEN}: {{n}}x{{n}} anchors", {}),
}  # fmt: skip
"""Numbers that a plan chooses: words for one and for several, and the settings with one."""


def explain_plan(
    accuracy: float,
    pilot_result: PilotResult,
    facts: SceneFacts,
    switches: Mapping[str, bool] | None = None,
    chosen: choose.Candidate | None = None,
) -> Plan:
    check_accuracy(accuracy)
    switches = switches or {}
    chosen = chosen or choose.Candidates(pilot_result, switches).choice(accuracy)
    stages = _stages(pilot_result, chosen.settings, choose.unit_costs_of(pilot_result))
    return Plan(
        accuracy=accuracy,
        effects=tuple(_rows(pilot_result, chosen.settings, facts, switches)),
        predicted_seconds=sum(stages.values()),
        settings=chosen.settings,
        sampling_target=chosen.target,
        systematic_error=chosen.systematic.value,
        systematic_bound=chosen.systematic.bound,
        warnings=(*facts.warnings, *_shortfall(accuracy, pilot_result, chosen, facts)),
        predicted=stages,
    )


def _stages(pilot_result: PilotResult, settings: Settings, costs: cost_model.UnitCosts) -> dict[str, float]:
    forming, numbers = pilot_result.forming, cost_model.Numbers.of(settings)
    held = cost_model.entries(pilot_result.sample_costs["direct"].paths, forming.classes, numbers, settings)
    return {
        "transport": sum(cost_model.tracing_seconds(pilot_result, settings, costs).values())
        + float(cost_model.accumulation_seconds(forming, numbers, held, costs))
        + float(cost_model.checking_seconds(forming, numbers, costs)),
        "truth": cost_model.truth_seconds(pilot_result, settings, costs),
        "optics": float(cost_model.optics_seconds(forming, numbers, costs)),
    }


def _rows(
    result: PilotResult, settings: Settings, facts: SceneFacts, switches: Mapping[str, bool]
) -> Iterator[PlanRow]:
    costs, costly, waves = choose.unit_costs_of(result), choose.costly_effects(), cost_model.in_waves(settings.effects)
    now = _stages(result, settings, costs)

    def stages(**changes: Any) -> dict[str, float]:
        return _stages(result, replace(settings, **changes), costs)

    def saved(**changes: Any) -> float:
        return max(sum(now.values()) - sum(stages(**changes).values()), 0.0)

    for name, count in zip(COUNTED, choose.counts_of(settings), strict=True):
        one, several, with_one = _NUMBERS[name]
        errors, row = result.ladders[name], name.replace("_", "-")
        if name == "followed_anchors" and not settings.effects & FOLLOWED:
            reason = "no light over several surfaces, in mirrors or of lamps is followed"
            yield PlanRow(row, "off", reason, 0.0, 0.0)
        elif name == "occluded_anchors" and not result.occluded:
            yield PlanRow(row, "off", "few anchors serve all projector pixels", 0.0, 0.0)
        else:
            reason = (one if count == 1 else several).format(
                n=count, depth=result.depth, near=settings.depths[-1], far=settings.depths[0],
                width=settings.followed_width, hidden=len(result.occluded),
            )  # fmt: skip
            left = _words(errors[count])
            if name == "cells":
                worst = max(error.value for error in errors.values())
                yield PlanRow(row, "approximate", f"{reason} leave {left}", worst, 0.0)
            elif count == 1:
                yield PlanRow(row, "off", f"{reason} leaves {left}", errors[1].value, 0.0)
            else:
                yield PlanRow(row, "approximate", f"{reason} leave {left}", errors[1].value, saved(**with_one))

    drawn = result.raster[waves]
    left_by_raster = drawn.error_left(settings.raster_cells)
    if left_by_raster is not None:  # The mask has more than two separable terms.
        fewest, terms = drawn.cells[0], f"{result.forming.geometric_terms:.0f} separable terms"
        cells = settings.raster_cells or fewest
        by_fft, with_fewest, sums = (
            stages(raster=count > 0, raster_cells=count)["optics"] for count in (cells, fewest, 0)
        )
        formed = f"by FFT on a raster of {cells} cells a pixel, which leaves {_words(left_by_raster)}"
        if drawn.needed:
            yield PlanRow("mask-shadow", "approximate", formed, None, max(by_fft - with_fewest, 0.0))
        elif settings.raster:
            reason = f"{terms}: {formed}, in {by_fft:.2g} s; their sum takes {sums:.2g} s"
            yield PlanRow("mask-shadow", "approximate", reason, 0.0, max(by_fft, 0.0))
        else:
            reason = f"{terms} are summed, in {sums:.2g} s; {formed}, in {by_fft:.2g} s"
            yield PlanRow("mask-shadow", "exact", reason, left_by_raster.value, sums)

    for name, effect in EFFECTS.items():
        on, error = name in settings.effects, result.effects.get(name)
        state: State = "exact" if on else "off"
        if error is None:
            yield PlanRow(name, state, effect.absent or "nothing in the scene calls for it", 0.0, 0.0)
            continue
        parts = [facts.notes.get(name, ""), "switched by the user" if name in switches else ""]
        if error.bound >= _VAGUE * error.value and error.bound:
            parts.append(f"left out, the frames change by {_words(error)}")
        seconds = saved(effects=settings.effects - {name}) if on and name in costly else 0.0
        yield PlanRow(name, state, "; ".join(filter(None, parts)), error.value, seconds)

    square = PlanRow("keystone", "off", "the projector faces the aligned plane squarely", 0.0, 0.0)
    off = f"the projector's window is {facts.keystone:.1f} of its pixels off a square; responses are not separable"
    yield PlanRow("keystone", "exact", off, None, 0.0) if facts.keystone else square
    yield facts.spectrum
    noise = "Poisson, full well, read noise and quantisation of each frame"
    yield PlanRow("sensor-noise", "exact", noise, None, 0.0)


def _words(error: Estimate) -> str:
    if error.bound == 0:
        return "0"
    return f"{error.value:.1e}" if error.bound < _VAGUE * error.value else f"less than {error.bound:.1e}"


def _shortfall(accuracy: float, result: PilotResult, chosen: choose.Candidate, facts: SceneFacts) -> list[str]:
    """Return the reasons why the choice misses the accuracy, with remedies; empty if it is kept."""
    if chosen.total.bound <= accuracy:
        return []
    settings, found = chosen.settings, list[str]()
    parts = {
        f"{name.replace('_', ' ')} ({count}{'' if name == 'layers' else f'x{count}'})": result.ladders[name][
            count
        ].bound
        for name, count in zip(COUNTED, choose.counts_of(settings), strict=True)
    }
    width, raster = (
        settings.followed_width,
        result.raster[cost_model.in_waves(settings.effects)].error_left(settings.raster_cells),
    )
    if width > 1:
        parts[f"cells of their light ({width} pixels)"] = result.error(WIDE).bound / settings.coarse_cells**2
    if raster and settings.raster:
        parts["the mask's raster"] = raster.bound
    if sharp := settings.sharp:
        parts[f"anchors of sharp light ({sharp.anchors}x{sharp.anchors})"] = sharp.left
    off = {f"{name} (off)": error.bound for name, error in result.effects.items() if name not in settings.effects}
    parts |= {**chosen.lacking, **off}
    largest = max(parts, key=lambda name: parts[name])
    counts = min(accuracy, parts[largest])
    if result.unresolved > accuracy:
        found.append(
            f"{result.unresolved:.0%} of the direct light comes over lobes too sharp to sample, and the frames "
            "lack most of it; give those surfaces more roughness, or make them perfect mirrors (conductor)"
        )
    if result.mirror is not None and facts.shapes and result.left_out >= counts:
        rule = (
            f"{result.left_out:.2g} of the light comes over it and, besides, a mirror, curved glass or a sharp "
            "lobe, where paths find it never or too seldom, so all or most of it is left out of the frames; "
            "turn it away, make it rough, or give the projector a lens (aperture_radius_mm) with the effect "
            "interreflection"
        )
        found.append(_refusal(facts.shapes[result.mirror], rule))
    if facts.mirrors and result.unresolved_specular >= counts:
        kinds = Counter(str(mirror.attributes.get("type", "shape")) for mirror in facts.mirrors)
        among = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
        rule = (
            f"{result.unresolved_specular:.2g} of the light comes over the scene's mirrors and curved glass "
            f"alone ({among}; this is the first), in beams too fine to be placed on the sensor: it is left "
            "out, or in the wrong pixels; use fewer or larger ones, move them apart, or make them rough"
        )
        found.append(_refusal(facts.mirrors[0], rule))
    return found or [
        f"the predicted total error, up to {chosen.total.bound:.1e}, exceeds the requested {accuracy:g}; "
        f"largest: {largest}, {parts[largest]:.1e}"
    ]


def _refusal(tag: Tag, rule: str, place: str = "shape") -> str:
    return str(tag.refusal(place, repr(tag.attributes.get("type", "")), rule))


# -------- Facts about a bench that a plan reports


_GREY = "no surface differs by wavelength; the mask's shadow is the mean over all lines"


@dataclass(frozen=True)
class SceneFacts:
    notes: Mapping[str, str]
    keystone: float
    warnings: tuple[str, ...] = ()
    shapes: tuple[Tag, ...] = ()
    mirrors: tuple[Tag, ...] = ()
    spectrum: PlanRow = field(default_factory=lambda: PlanRow("spectrum", "off", _GREY, 0.0, 0.0))

    @classmethod
    def of(cls, bench: Apparatus, switches: Mapping[str, bool] | None = None) -> SceneFacts:
        loaded, off = bench.loaded, {name for name, on in (switches or {}).items() if not on}
        warnings = (*known_losses(loaded, switches or {}), *_limits(bench, off))
        notes = {name: effect.note(bench) for name, effect in EFFECTS.items()}
        polished = polished_shapes(loaded.scene) if loaded.mirrors and loaded.shapes else ()
        mirrors = tuple(loaded.shapes[number] for number in polished)
        spectrum = PlanRow("spectrum", "off", _GREY, 0.0, 0.0)
        if bench.lines is not None:
            nanometres = ", ".join(f"{wave:g}" for wave in bench.lines.wavelengths_nm)
            spectrum = PlanRow("spectrum", "exact", f"all is simulated at {nanometres} nm", None, 0.0)
        elif loaded.coloured:
            may = f"{len(loaded.coloured)} of the scene's tags may have colours"
            first = f"the first {loaded.coloured[0].path.name}:{loaded.coloured[0].line}"
            reason = f"one panchromatic reflectance; {may}, {first}; what that leaves out: --colour auto"
            spectrum = PlanRow("spectrum", "off", reason, None, 0.0)
        elif bench.sensor.quantum_efficiency_curve is not None:
            reason = f"{_GREY}, but the camera does; what that leaves: --colour auto"
            spectrum = PlanRow("spectrum", "off", reason, None, 0.0)
        return cls(notes, loaded.pixels.keystone, warnings, loaded.shapes, mirrors, spectrum)


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
                f"it shines on the sensor itself, and {estimator} has no light of a lamp but over surfaces, so that is "
                "missing; keep it out of the view, or use a light that has a surface (area)"
            )
            yield _refusal(tag, rule, "light")
    for tag, shape in zip(loaded.shapes, loaded.scene.shapes(), strict=True) if loaded.shapes else ():
        part = part_of_view(loaded.scene, loaded.camera, shape) if shape.is_emitter() else 0.0
        if 0 < part * paths < _FEWEST:
            rule = (
                f"{estimator} meets what shines on the sensor itself by chance, and {paths:.2g} paths meet this "
                f"{part * paths:.1g} times, so its light may be missing; keep it out of the view, or take a lamp that "
                f"is {(_FEWEST / (part * paths)) ** 0.5:.2g} times as wide and as much dimmer"
            )
            yield str(tag.refusal("lamp", f"{part:.1e} of the field of view", rule))

"""Search of masks for a goal on a bench, and the files to make one with."""

from __future__ import annotations

import itertools
import math
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from pydantic import Field
from scipy.optimize import brentq

from mitsim.acquire.exposure import ambient_shots
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.request import PredictRequest
from mitsim.calibrate.board_session import Session
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import Configuration, validate
from mitsim.core.errors import MitsimError
from mitsim.core.files import read_json, write_json, write_text
from mitsim.core.images import write_numbers
from mitsim.core.job import Job
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import stream
from mitsim.design.goal import Goal
from mitsim.design.objective import CodedSide, Light, Objective, Prior, cyclic_patterns
from mitsim.design.predict import CELLS, Stand, scenes_of
from mitsim.design.search import Found, Search
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.patterns import PatternFamily, short_name
from mitsim.devices.session import load_recipe
from mitsim.optics.diffraction import narrowest_mm
from mitsim.optics.shadow import Directions

STATE, PATTERNS, FOR_DOTS = "search.json", "patterns.toml", "mask for dots"
_FULL = 0.8
"""Part of the full well that the brightest pixel of a frame may reach, as in a capture by default."""
_ALIKE = 1e-3
"""Part of a projector pixel within which rows and columns are searched as one."""
_EDGE_FEATURES = 8
"""Features beyond those that the sensor sees: a mask is mounted with some play."""


@dataclass(frozen=True)
class Choice:
    """Options of a design that are not its code."""

    feature_mm: float
    distance_mm: float
    patterns: str
    lit: str = ""
    """Code of cyclic patterns, of characters 0 and 1."""

    @property
    def shown(self) -> str:
        """Name of the patterns, with the code of cyclic ones."""
        return f"{short_name(self.patterns)} {self.lit}".strip()

    @property
    def words(self) -> str:
        place = f"features of {self.feature_mm * 1e3:g} um, {self.distance_mm:g} mm from the sensor"
        return f"{place}, {self.shown}"

    def family(self, bench: Apparatus) -> PatternFamily:
        if not self.lit:
            return bench.family(self.patterns)
        factor = cyclic_patterns(self.lit, bench.n).astype(np.int8)
        return PatternFamily(self.shown, factor, factor)


@dataclass(frozen=True)
class Candidate:
    """A mask with its predicted and rendered PSNR [dB], by cause, mean and scatter over seeds, and one image."""

    name: str
    choice: Choice
    found: Found
    exposures: tuple[float, ...]
    """Seconds of all frames, for each dose."""
    cases: tuple[Mapping[str, Any], ...] = ()
    """Predicted and rendered PSNR [dB] of each picture and dose."""
    predicted: float = math.nan
    causes: Mapping[str, float] = field(default_factory=dict)
    rendered: float = math.nan
    scatter: float = math.nan
    session_s: float = math.nan
    warnings: tuple[str, ...] = ()
    image: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))

    def payload(self) -> dict[str, Any]:
        return {
            **{name: getattr(self, name) for name in ("name", "cases", "causes", "warnings")},
            **{f"psnr_{name}": getattr(self, name) for name in ("predicted", "rendered", "scatter")},
            "feature_um": self.choice.feature_mm * 1e3,
            "mask_distance_mm": self.choice.distance_mm,
            "patterns": self.choice.shown,
            "origin": self.found.origin,
            "code": _text(self.found.code),
            "evaluations": self.found.evaluations,
            "exposure_total_s": self.exposures[0],
            "psnr_of_search": self.found.psnr_db,
            "session_exposure_s": self.session_s,
        }


# -------- Search


def _camera(bench: Apparatus, **update: Any) -> CameraGeometry:
    bare = {"mask": "separable", "mask_plate": None, "mask_thickness": 0.0, **update}
    return validate(CameraGeometry, {**dict(bench.geometry), **bare}, "goal")


def stand_of(bench: Apparatus, seed: int) -> Stand:
    """Trace the light of a scene and of its white board; the bench, of any mask, gets a thin separable one."""
    bench.loaded.camera.wear(_camera(bench))
    bench = replace(bench, devices=replace(bench.devices, camera=_camera(bench)))
    stand = Stand.of(Session(bench, load_recipe(), seed))
    if not (stand.unit > 0 and stand.truth.any()):
        problem = f"scene {bench.loaded.path}: no light of the projector comes from it to the camera"
        raise MitsimError(f"{problem}, so that no mask is better than another; give another scene")
    return stand


@single_threaded_blas()
def objectives(stand: Stand, goal: Goal, choice: Choice) -> list[Objective]:
    """Return the objectives of a ``choice``, one for each dose and distance."""
    bench, sensor = stand.bench, stand.bench.sensor
    family = choice.family(bench)
    scenes = [each.pixels(CELLS) for _, each in scenes_of(PredictRequest(pictures=goal.pictures), stand)]
    judged = [[each] for each in scenes] if goal.judge == "worst" else [scenes]
    if goal.prior is not None:
        judged = [Prior(*goal.prior).draw(stand.truth.shape, goal.seed)]
    if family.signed:
        problem = f"patterns: got {choice.patterns!r}, which are differences of two frames, and a search knows single"
        raise MitsimError(f"goal: {problem} ones; give uniform, dots:K, random:K or own patterns")
    shown = family.left.astype(np.float64), family.right.astype(np.float64)
    if all(size * side.shape[1] <= bench.n for size, side in zip(bench.geometry.frame_shape, shown, strict=True)):
        problem = f"patterns: got {short_name(choice.patterns)!r}, too few data for a solver to estimate their noise"
        raise MitsimError(f"goal: {problem} from so few pixels; give more patterns, or another camera")
    narrowest = narrowest_mm(float(bench.spectrum.wavelengths_nm.max()))
    if choice.feature_mm < narrowest:
        problem = f"feature_um: got {choice.feature_mm * 1e3:g}, too narrow for the model of diffraction"
        raise MitsimError(f"goal: {problem}; give at least {narrowest * 1e3:.3g}")
    lamps, shots = _lamps(stand), 0 if stand.ambient is None else ambient_shots(family)
    depths, found = goal.scene_distances_mm or (bench.geometry.scene_distance,), list[Objective]()
    update: dict[str, Any] = {"mask_feature": choice.feature_mm, "mask_distance": choice.distance_mm}
    camera = _camera(bench, **update, scene_distance=min(depths))
    seen = camera.half_width + choice.distance_mm * (camera.tan_half_fov + camera.half_width / min(depths))
    features = 2 * (math.ceil(seen / choice.feature_mm) + _EDGE_FEATURES) + 1
    for depth in depths:
        camera = _camera(bench, **update, scene_distance=depth)
        directions = [Directions.cells(np.linspace(*window, bench.n + 1)) for window in bench.windows_at(depth)]
        rows = CodedSide(camera, 0, directions[0], features, shown[0], bench.waves, lamps[0])
        near = np.allclose(directions[0].centres, directions[1].centres, rtol=0, atol=_ALIKE * directions[0].width)
        alike = camera.axes_alike and near and np.array_equal(shown[0], shown[1]) and not shots
        columns = rows if alike else CodedSide(camera, 1, directions[1], features, shown[1], bench.waves, lamps[1])
        for dose in goal.doses:
            light = Light(
                gain=stand.unit * (bench.geometry.scene_distance / depth) ** 2,
                frame_s=goal.exposure_total_s * dose / len(family.shots),
                session_e=load_recipe().exposure_fraction * sensor.superpixel_full_well_e,
                read_noise_e=sensor.superpixel_read_noise_e,
                dark_e_per_s=sensor.superpixel_dark_current_e_per_s,
                most_e=_FULL * sensor.superpixel_full_well_e,
                ambient_shots=shots,
            )
            found += [Objective((rows, columns), light, prior_of(each, goal), each) for each in judged]
    if goal.exposures == "light":
        code = Search(found).maximum_length().code
        found = [each.of_equal_light((code, code)) for each in found]
    return found


def _lamps(stand: Stand) -> list[list[tuple[Directions, FloatArray]]]:
    """Return the directions of ambient light along both axes, with margins that are relative to a white pixel."""
    grids, every, last = stand.scene.simulation.grids, stand.scene.estimate.light.items(), [stand.bench.n**2]
    lit = [(grids[name].bundle, light[last].toarray()) for name, light in every if stand.ambient is not None]
    scale = (sum(light.sum() for _, light in lit) * stand.board.pixels.mean()) ** -0.5 if lit else 0.0
    margins = [[light.reshape(each.cells).sum(axis=1 - k) * scale for each, light in lit] for k in (0, 1)]
    return [
        [(each.directions[k], at) for (each, _), at in zip(lit, margins[k], strict=True) if at.any()] for k in (0, 1)
    ]


def prior_of(scenes: Sequence[FloatArray], goal: Goal) -> Prior:
    """Return the goal's prior, or mean, deviation and correlation of the apparent reflectance of scenes."""
    if goal.prior is not None:
        return Prior(*goal.prior)
    mean = float(np.mean(scenes))
    off = np.stack(scenes) - mean
    variance = float(np.square(off).mean())
    if not variance:
        return Prior(mean, 0.0, 0.5)
    neighbours = (off[:, 1:] * off[:, :-1]).mean(), (off[:, :, 1:] * off[:, :, :-1]).mean()
    return Prior(mean, variance**0.5, float(np.clip(np.mean(neighbours) / variance, 0.0, 0.999)))


class _Start(Configuration):
    """A start that is done, and its result."""

    origin: str
    code: str = Field(pattern="^[01]+$")
    evaluations: int = Field(ge=0)


class _State(Configuration):
    """Content of ``search.json``: starts that are done, by choice."""

    starts: dict[str, list[_Start]] = Field(default_factory=dict)


def searches(stand: Stand, goal: Goal) -> dict[Choice, Search]:
    """Return each choice of feature size, distance and family with its search."""
    distances = goal.mask_distance_mm or (stand.bench.geometry.mask_distance,)
    options = itertools.product(goal.feature_um, distances, goal.families)
    order = [Choice(feature * 1e-3, distance, patterns) for feature, distance, patterns in options]
    known = goal.open_part, goal.judge == "worst", goal.seed
    return {choice: Search(objectives(stand, goal, choice), *known) for choice in order}


@single_threaded_blas()
def run_search(goal: Goal, folder: Path, job: Job, every: dict[Choice, Search]) -> tuple[list[Candidate], bool]:
    """Return the best masks: the found one, then simple ones; and whether all starts were made; add to ``every``.

    Starts that are done are in ``search.json``, from which a search that was stopped goes on. For cyclic patterns,
    masks for dots are searched first. Masks for the code that is best with the best of them follow, until codes repeat.
    """
    path = folder / STATE
    done = validate(_State, read_json(path), f"file {path}").starts if path.is_file() else {}
    began, best, complete = time.monotonic(), dict[str, tuple[Choice, Found, Search]](), True

    def keep(name: str, choice: Choice, found: Found | None, search: Search) -> None:
        if found is not None and (name not in best or found.score < best[name][1].score):
            best[name] = choice, found, search

    order = list(every)
    known_masks = dict[Choice, list[tuple[str, FloatArray]]]()
    for number, choice in enumerate(order):  # to which cyclic patterns are added
        search, masks, spent = every[choice], list[Found](), 0
        own = done.setdefault(repr(astuple(choice)), [])
        if any(len(each.code) != search.features for each in own):
            raise MitsimError(f"file {path}: has codes of other lengths; remove it, and the search begins again")
        starts = itertools.chain(known_masks.get(choice, ()), search.starts())
        for index, (origin, start) in enumerate(itertools.islice(starts, goal.starts)):
            if index == len(own):
                if goal.time_limit_s is not None and time.monotonic() - began > goal.time_limit_s:
                    complete = False
                    break
                found = search.improve(origin, start, goal.evaluations)
                own.append(_Start(origin=found.origin, code=_text(found.code), evaluations=found.evaluations))
                write_json(path, _State(starts=done).model_dump())
            known = own[index]
            code = np.array([float(each) for each in known.code])
            found = Found(known.origin, code, search.score(code).score, known.evaluations)
            spent += found.evaluations
            masks.append(found)
            keep("design", choice, found, search)
            job.progress("search", (number + (index + 1) / goal.starts) / len(order))
        cyclic = re.sub("^dots:", "cyclic:", choice.patterns)
        if masks and cyclic.startswith("cyclic:") and cyclic in goal.patterns:
            mask = min(masks, key=lambda each: each.score)
            if not choice.lit:
                keep(FOR_DOTS, choice, mask, search)
            lit = search.best_patterns(mask.code, int(cyclic.partition(":")[2]))
            changed = replace(choice, patterns=cyclic, lit=lit)
            if lit.count("1") > 1 and changed not in every:  # a single 1 is dots
                order.append(changed)
                every[changed] = search.lit_by(lit)
                known_masks[changed] = [(f"the mask for {choice.shown}", mask.code)]
                keep("design", changed, replace(mask, score=every[changed].score(mask.code).score), every[changed])
        keep("random", choice, search.best_random(spent), search)
        keep("pinholes", choice, search.best_pinholes(), search)
        keep("maximum length sequence", choice, search.maximum_length(), search)
    if FOR_DOTS in best and best[FOR_DOTS][1] is best["design"][1]:
        del best[FOR_DOTS]
    candidates = []
    for name, (choice, found, search) in best.items():
        each = len(search.objectives) // max(len(goal.scene_distances_mm), 1) // len(goal.doses)  # pictures
        longer = [one.frame_s((found.code, found.code)) / one.light.frame_s for one in search.objectives]
        parts = (min(longer[k * each : (k + 1) * each]) for k in range(len(goal.doses)))
        exposures = tuple(goal.exposure_total_s * dose * part for dose, part in zip(goal.doses, parts, strict=True))
        candidates.append(Candidate(name, choice, found, exposures))
    return candidates, complete


def _text(code: FloatArray) -> str:
    return "".join(str(int(each)) for each in code)


# -------- Files to make a mask with


def write_camera(folder: Path, bench: Apparatus, candidate: Candidate) -> Path:
    """Write a camera file with the mask as a drawing, its PNG, an SVG in millimetres, and a file of 0/1 patterns.

    Return the camera file.
    """
    code, feature = candidate.found.code > 0.5, candidate.choice.feature_mm
    folder.mkdir(exist_ok=True)
    write_numbers(folder / "mask.png", (255 * np.outer(code, code)).astype(np.uint8))
    starts, ends = (np.flatnonzero(np.diff(code, prepend=False, append=False) != 0)[k::2] * feature for k in (0, 1))
    side = len(code) * feature
    rows = (
        f'<rect x="{x0:.6g}" y="{y0:.6g}" width="{x1 - x0:.6g}" height="{y1 - y0:.6g}"/>'
        for y0, y1 in zip(starts, ends, strict=True)
        for x0, x1 in zip(starts, ends, strict=True)
    )
    size, title = f"{side:.6g}", "Openings, as seen from the sensor; units are mm"
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{size}mm" height="{size}mm" viewBox="0 0 {size} {size}">'
    write_text(folder / "mask.svg", "\n".join([head, f"<title>{title}</title>", *rows, "</svg>", ""]))
    sensor = bench.counting.model_dump(mode="json", exclude_defaults=True)
    mask = {"kind": "drawing", "feature_mm": feature, "file": "mask.png", "distance_mm": candidate.choice.distance_mm}
    write_text(folder / "camera.toml", tomli_w.dumps({**sensor, "mask": mask}))
    family = candidate.choice.family(bench)
    if family.grey is None and not family.signed:
        left, right = (side.T.tolist() for side in (family.left, family.right))
        write_text(folder / PATTERNS, f"left = {left}\nright = {right}\n")
    return folder / "camera.toml"


# -------- What a mask is worth


def sensitivity(stand: Stand, goal: Goal, choice: Choice, search: Search, code: FloatArray) -> dict[str, float]:
    """Return the expected change [dB] by features that are made wrongly, by less light and by a farther scene."""
    here, random = search.score(code).score, stream(search.seed, "flaws")
    worse = []
    for _ in range(8):
        places = random.choice(search.used, max(round(len(search.used) / 100), 1), replace=False)
        worse.append(search.score(np.abs(code - np.isin(np.arange(len(code)), places))).score)
    near = min(goal.scene_distances_mm or (stand.bench.geometry.scene_distance,))
    both = objectives(stand, goal.model_copy(update={"scene_distances_mm": (near, 1.1 * near)}), choice)
    half = len(both) // 2
    before, after = (replace(search, objectives=each).score(code).score for each in (both[:half], both[half:]))
    losses = {
        "one feature in a hundred wrong": float(np.mean(worse)) / here,
        "a tenth of the light": _score(search, code, 0.1) / here,
        "a scene and its calibration a tenth farther away": after / before,
    }
    return {name: -10 * math.log10(loss) for name, loss in losses.items()}


def _score(search: Search, code: FloatArray, longer: float) -> float:
    changed = [replace(one, light=replace(one.light, frame_s=one.light.frame_s * longer)) for one in search.objectives]
    return Search(changed, search.open_part, search.worst, search.seed).score(code).score


def seconds_for(search: Search, code: FloatArray, goal: Goal) -> float | None:
    """Return the seconds of all frames after which the wanted PSNR is expected; None if no exposure reaches it."""

    def short(log: float) -> float:
        return -10 * math.log10(_score(search, code, 10**log)) - float(goal.wanted_psnr_db or 0)

    if short(-6.0) > 0 or short(4.0) < 0:
        return None
    return float(goal.exposure_total_s * 10 ** brentq(short, -6.0, 4.0, xtol=1e-3))

"""Pairs to learn from: pictures on the prints of a bench, their frames and truths.

The light of a picture is that of a white print times the reflectance of each cell's pixel, for light from one flat
sheet straight to the sensor. Elsewhere (:func:`mitsim.bench.board.traced_anew`) each picture's light is traced.
Idealised frames follow the paper's separable model.

Pictures are square, of eight bits, drawn from a seed or cut from files. Drawn pictures have the statistics of natural
ones: leaves that hide each other (the dead leaves of Matheron, 1968), whose sizes follow a power law, with soft edges,
shades and a texture of 1/f amplitude; some have letters or stripes. A picture depends on the seed and its number alone.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from scipy import sparse

from mitsim.acquire.capture import trace_request
from mitsim.acquire.exposure import ambient_shots, camera_warnings, drift_mask, peak_irradiance
from mitsim.acquire.spectral import plan_request
from mitsim.api.bench import Bench
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.board import show_picture, show_white, traced_anew
from mitsim.bench.request import Task
from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.environment import deciding_versions, versions
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.files import PAIRS, check_plain, output_folder, plain, write_json
from mitsim.core.job import Cost, Job
from mitsim.core.manifests import CalibrationManifest
from mitsim.core.prepare import read_reflectance
from mitsim.core.seeds import integer, stream
from mitsim.devices.patterns import PatternFamily
from mitsim.devices.sensor import digital_of
from mitsim.devices.session import Drift
from mitsim.learn.pair_store import (
    WHITE,
    Pair,
    PairsManifest,
    PairStore,
    PrintLight,
    PrintPart,
    Shard,
    is_shard,
    read_pairs_manifest,
    write_shard,
)
from mitsim.learn.requests import CALIBRATION, PairsRequest, picture_files
from mitsim.light.cost_model import first_shadow, frames_cost
from mitsim.light.light import SampledLight, Sampling, trace_light, traced_again
from mitsim.light.plan import Plan
from mitsim.light.simulation import Simulation, emission
from mitsim.optics.image_formation import FrameOptics
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.solution import Status, Verdict
from mitsim.report.lit_scene import IdealCamera
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.transport.records import Bundle

SHARD = 100
"""Most pairs of a shard, because an interruption then loses a minute."""
_PICTURE_S = 3e-6
_PAIR_BYTES, _FRAME_BYTES = 4, 4
_SHADOW_BYTES = 40
"""Bytes of the stored shadow per pixel of the frame's and projector's sides; measured 27 to 30."""
_FORMED = 0.5
"""Time to form a pair's frames over that of a capture; measured 0.4 to 0.6."""

Opening = Callable[[Mapping[str, str]], Bench]

# -------- Light of white prints

_STRAIGHT = ("fine", "anchor_residual")


@dataclass(frozen=True, eq=False)
class WhitePrints:
    """Bench whose prints are white, in its light.

    Attributes
    ----------
    white
        (n, n) apparent reflectance of the white prints.
    shares
        (n^2, n^2) part of each projector pixel's direct light that each pixel of the picture reflects.
    """

    light: SampledLight
    white: FloatArray
    shares: sparse.csr_array
    warnings: tuple[str, ...]

    @classmethod
    def of(cls, light: SampledLight) -> WhitePrints:
        direct, settings = light, light.plan.settings
        if "glare" in settings.effects:  # which is in no truth
            without = replace(settings, effects=settings.effects - {"glare"})
            direct = traced_again(light, Simulation(light.bench, without))
        pixels, fine = light.bench.n**2, direct.merge()
        rows, columns = picture_axes(fine, fine.simulation.grids["fine"].bundle)
        of_place = (rows[:, None] * light.bench.n + columns).ravel()
        entries = (np.ones(len(of_place)), (np.arange(len(of_place)), of_place))
        seen = fine.groups[0]["fine"][:pixels] @ sparse.csr_array(entries, shape=(len(of_place), pixels))
        total = np.asarray(seen.sum(axis=1))
        inverse = np.divide(1.0, total, out=np.zeros_like(total), where=total > 0)
        shares = sparse.csr_array(sparse.diags_array(inverse) @ seen)
        return cls(light.merge(), light.truth, shares, (*light.warnings, *light.unreached))

    def truth(self, reflectance: FloatArray) -> FloatArray:
        return np.asarray(self.white * (self.shares @ reflectance.ravel()).reshape(self.white.shape))

    def rendered_light(self, bench: Apparatus, family: PatternFamily) -> PrintLight:
        light = self.light.behind(bench)
        simulation, estimate, pixels = light.simulation, light.groups[0], bench.n**2
        lighting, unit, parts = family.lighting, electrons_per_joule(bench), list[PrintPart]()
        classes = int(lighting.labels.max()) + 1
        by_class = sparse.csr_array((np.ones(pixels), (lighting.labels, np.arange(pixels))), shape=(classes, pixels))
        lamps = [
            (name, grid, pixels + band) for band, grids in enumerate(simulation.by_band) for name, grid in grids.items()
        ]
        for name, grid, row in [*((name, grid, None) for name, grid in simulation.grids.items()), *lamps]:
            of_grid = estimate[name]
            own = by_class @ of_grid[:pixels] if row is None else of_grid[[row]]
            if own.nnz:
                assert name in _STRAIGHT and len(grid.bundle.depths) == 1, "light of one flat sheet alone"
                own = sparse.csr_array(own * unit)
                own.sort_indices()
                parts.append(PrintPart(grid.optics, own, *picture_axes(light, grid.bundle), row is not None))
        return PrintLight(tuple(parts), emission(simulation.physics, lighting))

    def ideal_light(self, family: PatternFamily) -> PrintLight:
        bench, lighting = self.light.bench, family.lighting
        pixels, classes = bench.n**2, int(lighting.labels.max()) + 1
        sides = IdealCamera(bench, bench.geometry.mask).directions
        optics = FrameOptics(bench.geometry, *sides, (bench.geometry.scene_distance,), 1, None)
        even = float(self.light.apparent.board_flux.mean()) * electrons_per_joule(bench) * self.white.ravel()
        light = sparse.csr_array((even, (lighting.labels, np.arange(pixels))), shape=(classes, pixels))
        line = np.arange(bench.n)
        return PrintLight((PrintPart(optics, light, line, line, False),), lighting.weights)


def picture_axes(light: SampledLight, bundle: Bundle) -> tuple[Labels, Labels]:
    """Return the row and column of the picture's pixel, or the nearest one, of each row and column of cells."""
    axes = zip((bundle.grid.rows, bundle.grid.columns), light.bench.windows_at(light.plan.settings.depth), strict=True)
    n = light.bench.n
    rows, columns = (
        np.clip(np.floor(((each.edges[:-1] + each.edges[1:]) / 2 - near) / (far - near) * n), 0, n - 1).astype(np.int64)
        for each, (near, far) in axes
    )
    return rows, columns


def electrons_per_joule(bench: Apparatus) -> float:
    wavelength = bench.projector.effective_wavelength_nm
    return float(electrons_from_irradiance(1.0, 1.0, bench.sensor, wavelength))


# -------- Pictures

Codes = npt.NDArray[np.uint8]
_OVER = 2
"""Points per pixel and axis of a drawn picture."""
_RADII = 0.015, 0.35
"""Smallest and largest leaf over the side."""
_POWERS = 1.6, 3.2
"""Power by which the number of leaves falls with their radius; natural pictures have about 3 (Lee, Mumford and Huang,
2001), portraits fewer small leaves."""
_COVERED = 2.5
_MOST_LEAVES = 600
_SOFT = 0.3, 2.5
"""Width of an edge in pixels, because a network learned nothing from hard ones."""
_SHADE, _TEXTURE = 0.25, 0.12
_DARKEST, _BRIGHTEST = (0.03, 0.15), (0.55, 0.95)
_LETTERS, _STRIPES = 0.2, 0.15
_TAILS = 0.002
_SMALLEST_CROP = 0.5


@dataclass(frozen=True)
class DrawnPictures:
    seed: int
    photographs: ClassVar[tuple[int, ...]] = ()
    source: ClassVar[str] = "drawn by code: dead leaves with soft edges, shades and 1/f texture, letters, stripes"

    def draw(self, number: int, n: int) -> Codes:
        rng = stream(self.seed, "picture", number)
        side = _OVER * n
        texture = pink_noise(side, rng)
        line, slopes = np.linspace(-0.5, 0.5, side), rng.uniform(-0.4, 0.4, 2)
        canvas = np.asarray(rng.uniform(0.3, 0.7) + slopes[0] * line[:, None] + slopes[1] * line[None])
        _lay_leaves(canvas, texture, rng)
        kind = rng.random()
        if kind < _LETTERS:
            _lay_letters(canvas, rng)
        elif kind < _LETTERS + _STRIPES:
            _lay_stripes(canvas, rng)
        small = canvas.reshape(n, _OVER, n, _OVER).mean(axis=(1, 3))
        low, high = np.quantile(small, (_TAILS, 1 - _TAILS))
        dark, bright = rng.uniform(*_DARKEST), rng.uniform(*_BRIGHTEST)
        scaled = np.clip((small - low) / max(high - low, 1e-6), 0.0, 1.0)
        return np.asarray(np.rint(WHITE * (dark + (bright - dark) * scaled)), np.uint8)


def pink_noise(side: int, rng: np.random.Generator) -> FloatArray:
    """Draw periodic noise (side, side) of mean 0 and rms 1 whose amplitude falls as one over the frequency."""
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None])
    frequency[0, 0] = np.inf
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((side, side))) / frequency, (side, side))
    return np.asarray(noise / noise.std())


def _lay_leaves(canvas: FloatArray, texture: FloatArray, rng: np.random.Generator) -> None:
    side = len(canvas)
    power, roughness = rng.uniform(*_POWERS), rng.uniform(0.0, _TEXTURE)
    soft = _OVER * math.exp(rng.uniform(math.log(_SOFT[0]), math.log(_SOFT[1])))
    low, high = (limit ** (1 - power) for limit in _RADII)
    radii = (low + (high - low) * rng.random(_MOST_LEAVES)) ** (1 / (1 - power))
    covered = np.cumsum(math.pi * np.square(radii))
    for radius in radii[: int(np.searchsorted(covered, _COVERED)) + 1] * side:
        middle = rng.uniform(0, side, 2)
        shape, turn = rng.uniform(0.4, 1.0), rng.uniform(0, math.pi)
        boxed = rng.random() < 0.35  # rectangles; the others are ellipses
        grey, slopes = rng.random(), rng.uniform(-_SHADE, _SHADE, 2) / (2 * radius)
        reach = radius * (math.sqrt(2) if boxed else 1.0) + soft
        (top, bottom), (left, right) = (
            (max(0, math.floor(at - reach)), min(side, math.ceil(at + reach))) for at in middle
        )
        if top >= bottom or left >= right:
            continue
        down, across = np.arange(top, bottom)[:, None] - middle[0], np.arange(left, right)[None] - middle[1]
        along = (math.cos(turn) * down + math.sin(turn) * across) / radius
        beside = (math.cos(turn) * across - math.sin(turn) * down) / (radius * shape)
        size = np.maximum(abs(along), abs(beside)) if boxed else np.hypot(along, beside)
        cover = np.clip(0.5 + (1 - size) * radius * shape / soft, 0.0, 1.0)
        patch = np.roll(texture, tuple(rng.integers(0, side, 2)), (0, 1))[: bottom - top, : right - left]
        leaf = grey + slopes[0] * down + slopes[1] * across + roughness * patch
        canvas[top:bottom, left:right] += cover * (leaf - canvas[top:bottom, left:right])


def _lay_letters(canvas: FloatArray, rng: np.random.Generator) -> None:
    from PIL import Image, ImageDraw, ImageFont  # here: most pictures need none

    side = len(canvas)
    size = int(side * rng.uniform(0.05, 0.14))
    page = Image.new("L", (side, side))
    pen, font = ImageDraw.Draw(page), ImageFont.load_default(max(size, 6))
    first, last = sorted(rng.uniform(0, side, 2))
    for top in range(int(first), int(max(last, first + 1.5 * size)), max(int(1.3 * size), 1)):
        words = "".join(chr(code) for code in rng.choice([32, 32, *range(65, 91), *range(97, 123)], 60))
        pen.text((int(rng.uniform(-size, size)), top), words, fill=WHITE, font=font)
    cover = np.asarray(page, dtype=np.float64) / WHITE
    canvas += cover * (rng.choice([0.02, 0.98]) - canvas)


def _lay_stripes(canvas: FloatArray, rng: np.random.Generator) -> None:
    side = len(canvas)
    top, left = (int(at) for at in rng.uniform(0, 0.5 * side, 2))
    box = canvas[top : top + int(rng.uniform(0.2, 0.5) * side), left : left + int(rng.uniform(0.2, 0.5) * side)]
    width, turn = side * math.exp(rng.uniform(math.log(0.02), math.log(0.15))), rng.uniform(0, math.pi)
    down, across = np.arange(box.shape[0])[:, None], np.arange(box.shape[1])[None]
    phase = (math.cos(turn) * down + math.sin(turn) * across) / width
    wave = np.clip(0.5 + np.sin(2 * math.pi * phase) * width / math.pi, 0.0, 1.0)
    dark, bright = sorted(rng.random(2))
    box[...] = dark + (bright - dark) * wave


@dataclass(frozen=True)
class FolderPictures:
    """Grey pictures of a folder's files in order: middle squares, then drawn squares, turned and mirrored."""

    folder: Path
    seed: int

    @cached_property
    def files(self) -> tuple[Path, ...]:
        return picture_files(self.folder)

    @cached_property
    def source(self) -> str:
        digest = hashlib.sha256()
        for path in self.files:
            digest.update(f"{path.name} {check_plain(path, 'picture').st_size}\n".encode())
        return f"{len(self.files)} files of {self.folder}, names and sizes {digest.hexdigest()[:16]}"

    @cached_property
    def photographs(self) -> tuple[int, ...]:
        digests = [hashlib.sha256(path.read_bytes()).digest() for path in self.files]
        return tuple(map(digests.index, digests))

    def draw(self, number: int, n: int) -> Codes:
        """Cut a picture of n x n pixels; MitsimError for a file that is unreadable or smaller."""
        path = self.files[number % len(self.files)]
        grey = read_reflectance(path)
        whole = min(grey.shape)
        if whole < n:
            raise MitsimError(f"picture {path}: has {whole} pixels on its shorter side, and {n} are shown; give larger")
        if number < len(self.files):
            side, places, turns, mirrored = whole, [(size - whole) // 2 for size in grey.shape], 0, False
        else:
            rng = stream(self.seed, "crop", number)
            side = int(rng.uniform(max(n, _SMALLEST_CROP * whole), whole))
            places = [int(rng.integers(0, size - side + 1)) for size in grey.shape]
            turns, mirrored = int(rng.integers(4)), bool(rng.integers(2))
        square = np.rot90(grey[places[0] : places[0] + side, places[1] : places[1] + side], turns)
        square = square[:, ::-1] if mirrored else square
        below = np.clip(np.arange(side + 1)[None] - np.linspace(0, side, n + 1)[:-1, None], 0, side / n)
        weights = np.diff(below, axis=1) * n / side
        return np.asarray(np.rint(WHITE * (weights @ square @ weights.T)), np.uint8)


# -------- Making a store


class _Maker:
    def __init__(self, opening: Opening, asked: PairsRequest, job: Job) -> None:
        self._opening, self._asked, self._job = opening, asked, job
        self._groups, seed = asked.groups(), asked.capture.seed
        self._pictures = DrawnPictures(seed) if asked.pictures is None else FolderPictures(Path(asked.pictures), seed)
        self._open: tuple[dict[str, str], Bench, Plan] | None = None
        self._white: tuple[Bench, WhitePrints] | None = None
        self.bench, self._plan = self._bench_of(0)
        self._family = self.bench.family(asked.capture.patterns, seed)
        self.why_anew = self._why(self.bench)

    @property
    def configuration(self) -> dict[str, Any]:
        asked, bench = self._asked, self.bench
        found = {**asked.capture.deciding, "count": asked.count, "idealised": asked.idealised}
        found |= {"pictures": self._pictures.source, "groups": self._groups}
        found |= {"bench": {**bench.provenance(), **bench.identity()}, "versions": deciding_versions()}
        return dict(plain(found))

    def _why(self, bench: Bench) -> str:
        return "" if self._asked.idealised else traced_anew(bench)

    def check(self, shards: Sequence[Shard]) -> None:
        if isinstance(self._pictures, FolderPictures):
            files = len(self._pictures.files)
            for number in {index % files for each in shards for index in range(each.first, each.first + each.count)}:
                self._pictures.draw(number, self.bench.n)
        of_groups = {tuple(self._parameters(each.group).items()): each.group for each in shards}
        for parameters, group in of_groups.items():
            if not self.why_anew and parameters and (why := self._why(self._opening(dict(parameters)))):
                raise ArgumentError(
                    "vary",
                    f"bench {group} ({', '.join(f'{name} {value}' for name, value in parameters)}): {why}, other than "
                    "before bench 0; vary it less, or leave out what turns or hides the sheet",
                )

    def _parameters(self, group: int) -> dict[str, str]:
        drawn = self._groups[group].items()
        return {name.partition(".")[2]: repr(value) for name, value in drawn if name.startswith("scene.")}

    def _bench_of(self, group: int) -> tuple[Bench, Plan]:
        parameters = self._parameters(group)
        if self._open is None or self._open[0] != parameters:
            bench = self._opening(parameters)
            self._asked.capture.timing.check(bench.sensor, bench.devices.camera_file)
            with self._job.planning("pairs", first_shadow(bench, self._asked.capture.effects)):
                if self._why(bench):
                    show_picture(bench, self._pictures.draw(0, bench.n) / WHITE)
                else:
                    show_white(bench)
                self._open = parameters, bench, plan_request(bench, self._asked.capture)
        return self._open[1:]

    def _white_of(self, group: int) -> WhitePrints:
        bench, plan = self._bench_of(group)
        if self._white is None or self._white[0] is not bench:
            own = group if self._asked.vary and self._asked.vary.scene else 0
            light = trace_request(bench, plan, self._job, integer(self._asked.capture.seed, "white prints", own))
            self._white = bench, WhitePrints.of(light)
        return self._white[1]

    def write(self, shard: Shard, path: Path, digest: str) -> None:
        bench, plan = self._bench_of(shard.group)
        drawn = self._groups[shard.group].items()
        mask = {name.partition(".")[2]: value for name, value in drawn if name.startswith("mask.")}
        moved, idealised = drift_mask(bench, Drift(**mask)) if mask else bench, self._asked.idealised
        light: PrintLight | None = None
        if not self.why_anew:
            white = self._white_of(shard.group)
            light = white.ideal_light(self._family) if idealised else white.rendered_light(moved, self._family)
        speckled = "speckle" in plan.settings.effects and not idealised
        speckle = bench.speckle(self._family) if speckled else 0.0
        kept = light if light is not None and light.few else None
        with self._job.clock.stage("pairs"):
            write_shard(path, digest, self._pairs(shard, moved, light, kept is None), speckle, kept)

    def _pairs(self, shard: Shard, moved: Apparatus, light: PrintLight | None, keep: bool) -> Iterator[Pair]:
        (bench, plan), lighting, sensor = self._bench_of(shard.group), self._family.lighting, moved.sensor
        timing, per_joule = self._asked.capture.timing, electrons_per_joule(moved)
        timing = replace(timing, fraction=self._groups[shard.group].get("exposure_fraction", timing.fraction))
        for index in range(shard.first, shard.first + shard.count):
            picture = self._pictures.draw(index, bench.n)
            reflectance = picture / WHITE
            if light is None:
                show_picture(bench, reflectance)
                seed = integer(self._asked.capture.seed, "prints", index)
                own = trace_light(bench, plan, lighting, seed, Sampling(by_pixel=False))
                expected, unit = own.merge().behind(moved).frames(lighting, seed), per_joule
                truth, warnings = own.truth, (*own.warnings, *own.unreached)
            else:
                white = self._white_of(shard.group)
                truth = white.white * reflectance if self._asked.idealised else white.truth(reflectance)
                expected, unit, warnings = light.frames_of(reflectance), 1.0, white.warnings
            peak = peak_irradiance(expected) * unit
            exposure_s = timing.choose(moved.devices, peak / per_joule)
            saturated = (peak + sensor.superpixel_dark_current_e_per_s) * exposure_s >= sensor.superpixel_full_well_e
            rows: dict[str, Any] = {"picture": picture, "truth": truth.astype(np.float32)}
            rows |= {"exposure_s": exposure_s, "saturated": np.uint8(saturated)}
            if keep:
                rows["expected"] = np.stack([(frame.irradiance * unit).astype(np.float32) for frame in expected])
                rows["lamps"] = (expected.projector_off.irradiance * unit).astype(np.float32)
            self._job.progress("pairs", (index + 1) / self._asked.count)
            yield rows, warnings

    def cost(self, left: Sequence[Shard]) -> Cost:
        pairs, pixels, shots = sum(shard.count for shard in left), self.bench.n**2, len(self._family.shots)
        geometry, taken, anew = self.bench.geometry, self._plan.predicted, bool(self.why_anew)
        varied = self._asked.vary is not None and bool(self._asked.vary.scene)
        benches = len({tuple(sorted(self._groups[shard.group].items())) for shard in left}) if varied else 1
        tracing = taken["transport"] + taken["truth"]
        each = _FORMED * taken["optics"] + _PICTURE_S * pixels
        seconds = pairs * (each + tracing * anew) + benches * (taken["plan"] + tracing * (not anew))
        few = not anew and not geometry.is_correlated(geometry.diffracts)
        frames = 0 if few else _FRAME_BYTES * shots * math.prod(geometry.frame_shape)
        shadow = len(left) * _SHADOW_BYTES * sum(geometry.frame_shape) * self.bench.n
        memory = frames_cost(self.bench, self._plan.settings, self._family.lighting).memory_bytes
        return Cost(seconds, memory, pairs * (pixels * _PAIR_BYTES + frames) + shadow)

    def begin(self, configuration: Mapping[str, Any], shards: tuple[Shard, ...]) -> PairsManifest:
        bench, asked, capture = self.bench, self._asked, self._asked.capture
        lamps = "ambient" in self._plan.settings.effects and not asked.idealised
        auto = capture.ambient_frame == "auto" and lamps and not self._family.signed
        taken = capture.ambient_frame == "yes" or auto
        return PairsManifest(
            status="incomplete",
            configuration=dict(configuration),
            n=bench.n,
            m=bench.geometry.frame_shape,
            frames=sum(shot.sign != -1 for shot in self._family.shots),
            patterns=capture.patterns,
            exposure_s=1.0,
            camera=plain(bench.identity()),
            sensor=json.dumps(bench.sensor.model_dump(exclude_none=True)),
            digital=digital_of(bench.sensor, 1.0),
            scene=str(bench.loaded.path),
            idealised=asked.idealised,
            traced_anew=self.why_anew,
            seed=capture.seed,
            count=asked.count,
            pictures=self._pictures.source,
            photographs=self._pictures.photographs,
            ambient_shots=ambient_shots(self._family) if taken else 0,
            groups=tuple(self._groups) if asked.vary else (),
            shards=shards,
            versions=versions(),
        )

    def factors(self) -> Factors:
        camera = IdealCamera(self.bench, self.bench.geometry.mask)
        sides = camera.calibrated(float(self._white_of(0).light.apparent.board_flux.mean()))
        left, right = (side.astype(np.float32).astype(np.float64) for side in sides)
        status = Status(Verdict.CALIBRATED, "Exact factors of the idealised model")
        about: dict[str, Any] = {"camera": plain(self.bench.identity()), "centre": camera.centre}
        about |= {"estimate": str(status), "verdict": status.verdict.value, "versions": versions()}
        return Factors(left, right, CalibrationManifest(**about), status)

    def finish(self, store: PairStore) -> PairsManifest:
        begun, facts = store.manifest, [store.facts(shard) for shard in store.manifest.shards]
        exposure_s = float(np.median(np.concatenate([exposures for exposures, _, _ in facts])))
        found = [text for _, _, warnings in facts for text in warnings]
        if saturated := sum(count for _, count, _ in facts):
            found.append(f"saturation: {saturated} pairs are expected to fill the full well; expose for less")
        if self.bench.loaded.lamps and self._asked.capture.ambient_frame == "no" and not self._family.signed:
            found.append("light of lamps is not taken off (ambient_frame is no): frames have it, and truths have not")
        found += camera_warnings(self.bench.sensor, begun.m)
        digital = digital_of(begun.sensor_model, exposure_s)
        new = {
            "status": "complete",
            "exposure_s": exposure_s,
            "digital": digital,
            "warnings": tuple(dict.fromkeys(found)),
        }
        return begun.model_copy(update=new)


def make_pairs(opening: Opening, asked: PairsRequest, task: Task) -> tuple[PairStore, Cost]:
    """Make pairs of pictures on the prints of a scene in a folder, and return their predicted cost too.

    A resumed store equals an uninterrupted one bit for bit. MitsimError if the request cannot be served, limits do not
    suffice, the scene has no print, or the output is that of another request.
    """
    asked.check()
    assert task.output is not None, "pairs are kept in a folder"
    again = task.resume and (task.output / PAIRS).is_file()
    maker, job = _Maker(opening, asked, task.job), task.job
    configuration = maker.configuration
    if again:
        before = read_pairs_manifest(task.output).configuration
        if changed := [key for key, value in configuration.items() if before.get(key) != value]:
            raise MitsimError(
                f"resume=True: {task.output} holds pairs of another configuration ({', '.join(changed)} differ); use "
                "the same options, or another folder"
            )
    digest = hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest()
    shards, groups = list[Shard](), 1 if asked.vary is None else asked.vary.groups
    ends = [asked.count * group // groups for group in range(groups + 1)]
    for group, (start, end) in enumerate(pairwise(ends)):
        for first in range(start, end, SHARD):
            file = f"pairs_{len(shards):05}.h5"
            shards.append(Shard(file=file, first=first, count=min(SHARD, end - first), group=group))
    with output_folder(task.output, overwrite=again) as folder:
        left = [shard for shard in shards if not is_shard(folder / shard.file, digest, shard.count)]
        maker.check(left)
        cost = maker.cost(left)
        cost.check(f"{asked.count} pairs", job.limits, folder)
        begun = maker.begin(configuration, tuple(shards))
        write_json(folder / PAIRS, begun)
        for shard in left:
            maker.write(shard, folder / shard.file, digest)
        if asked.idealised:
            (folder / CALIBRATION).mkdir(exist_ok=True)
            maker.factors().write(folder / CALIBRATION)
        manifest = maker.finish(PairStore(folder, begun))
        write_json(folder / PAIRS, manifest)
    return PairStore(folder, manifest), cost

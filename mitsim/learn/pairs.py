"""Pairs to learn from: pictures on the print of a bench, their frames and truths.

The light of a picture is that of a white print times the reflectance of each cell's pixel, for light from one flat
sheet straight to the sensor (:func:`mitsim.bench.layout.show_white`). Other scenes are refused.

Pictures are square, of eight bits, drawn from a seed or cut from files. Drawn pictures have the statistics of natural
ones: leaves that hide each other (the dead leaves of Matheron, 1968), whose sizes follow a power law, with soft edges,
shades and a texture of 1/f amplitude; some have letters or stripes. A picture depends on the seed and its number alone.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
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
from mitsim.bench.layout import show_white
from mitsim.bench.request import Task
from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.environment import deciding_versions, versions
from mitsim.core.errors import MitsimError
from mitsim.core.files import PAIRS, check_plain, output_folder, plain, write_json
from mitsim.core.images import read_reflectance
from mitsim.core.job import Cost
from mitsim.core.manifests import other_request
from mitsim.core.picture_files import picture_files
from mitsim.core.seeds import integer, stream
from mitsim.devices.patterns import PatternFamily, is_own
from mitsim.devices.sensor import digital_of
from mitsim.devices.session import Drift
from mitsim.learn.pair_store import (
    WHITE,
    PairsManifest,
    PairStore,
    PrintLight,
    PrintPart,
    Shard,
    is_shard,
    read_pairs_manifest,
    write_shard,
)
from mitsim.learn.requests import PairsRequest
from mitsim.light.cost_model import first_shadow, frames_cost
from mitsim.light.light import SampledLight, traced_again
from mitsim.light.passes import Simulation, emission
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.transport.records import Bundle

SHARD = 100
"""Most pairs of a shard, because an interruption then loses a minute."""
_PICTURE_S = 3e-6
_PAIR_BYTES = 4
_SHADOW_BYTES = 40
"""Bytes of the stored shadow per pixel of the frame's and projector's sides; measured 27 to 30."""
_FORMED = 0.5
"""Time to form a pair's frames over that of a capture; measured 0.4 to 0.6."""

# -------- Light of a white print


def white_shares(light: SampledLight) -> sparse.csr_array:
    """Return the (n^2, n^2) part of each projector pixel's direct light that each pixel of the picture reflects."""
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
    return sparse.csr_array(sparse.diags_array(inverse) @ seen)


def print_light(light: SampledLight, bench: Apparatus, family: PatternFamily) -> PrintLight:
    """Return the light of a white print before the camera of ``bench``; MitsimError for a shadow on a raster."""
    light = light.behind(bench)
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
        if not own.nnz:
            continue
        straight = name in ("fine", "anchor_residual") and len(grid.bundle.depths) == 1
        assert straight, "light of one flat sheet alone"
        if grid.optics.terms is None:
            raise MitsimError("this mask's shadow is drawn on a raster, which pairs do not keep; use a separable mask")
        own = sparse.csr_array(own * unit)
        own.sort_indices()
        parts.append(PrintPart(grid.optics, own, *picture_axes(light, grid.bundle), row is not None))
    return PrintLight(tuple(parts), emission(simulation.physics, lighting))


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
            from PIL import Image, ImageDraw, ImageFont  # here, because most pictures need none

            size = int(side * rng.uniform(0.05, 0.14))
            page = Image.new("L", (side, side))
            pen, font = ImageDraw.Draw(page), ImageFont.load_default(max(size, 6))
            first, last = sorted(rng.uniform(0, side, 2))
            for top in range(int(first), int(max(last, first + 1.5 * size)), max(int(1.3 * size), 1)):
                words = "".join(chr(code) for code in rng.choice([32, 32, *range(65, 91), *range(97, 123)], 60))
                pen.text((int(rng.uniform(-size, size)), top), words, fill=WHITE, font=font)
            cover = np.asarray(page, dtype=np.float64) / WHITE
            canvas += cover * (rng.choice([0.02, 0.98]) - canvas)
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


def make_pairs(bench: Bench, asked: PairsRequest, task: Task) -> tuple[PairStore, Cost]:
    """Make pairs of pictures on the print of a bench in a folder, and return their predicted cost too.

    A resumed store equals an uninterrupted one bit for bit. MitsimError if the request cannot be served, limits do not
    suffice, the scene is no flat sheet with a print, or the output is that of another request.
    """
    assert task.output is not None, "pairs are kept in a folder"
    job, capture, seed = task.job, asked.capture, asked.capture.seed
    again = task.resume and (task.output / PAIRS).is_file()
    bench = bench.in_variant(bench.variant)  # loaded anew, as its print is changed
    show_white(bench)
    capture.timing.check(bench.sensor, bench.devices.camera_file)
    pictures = DrawnPictures(seed) if asked.pictures is None else FolderPictures(Path(asked.pictures), seed)
    family = bench.family(capture.patterns, seed)
    with job.planning("pairs", first_shadow(bench, capture.effects)):
        plan = plan_request(bench, capture)
    groups = [{}] if asked.vary is None else [asked.vary.draw(seed, group) for group in range(asked.vary.groups)]

    about = {**capture.deciding, "count": asked.count, "pictures": pictures.source, "groups": groups}
    about |= {"bench": {**bench.provenance(), **bench.identity()}, "versions": deciding_versions()}
    configuration: dict[str, Any] = dict(plain(about))
    if again:
        before = read_pairs_manifest(task.output).configuration
        if before != configuration:
            raise other_request(task.output, "pairs", before, configuration)
    digest = hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest()
    shards = list[Shard]()
    ends = [asked.count * group // len(groups) for group in range(len(groups) + 1)]
    for group, (start, end) in enumerate(pairwise(ends)):
        for first in range(start, end, SHARD):
            file = f"pairs_{len(shards):05}.h5"
            shards.append(Shard(file=file, first=first, count=min(SHARD, end - first), group=group))

    with output_folder(task.output, overwrite=again) as folder:
        left = [shard for shard in shards if not is_shard(folder / shard.file, digest, shard.count)]
        numbers = [index for shard in left for index in range(shard.first, shard.first + shard.count)]
        if isinstance(pictures, FolderPictures):  # a picture that cannot be shown is refused before light is traced
            for number in {index % len(pictures.files) for index in numbers}:
                pictures.draw(number, bench.n)
        taken, pixels = plan.predicted, bench.n**2
        seconds = taken["plan"] + taken["transport"] + taken["truth"]
        seconds += len(numbers) * (_FORMED * taken["optics"] + _PICTURE_S * pixels)
        disk = len(numbers) * pixels * _PAIR_BYTES
        disk += len(left) * _SHADOW_BYTES * sum(bench.geometry.frame_shape) * bench.n
        cost = Cost(seconds, frames_cost(bench, plan.settings, family.lighting).memory_bytes, disk)
        cost.check(f"{asked.count} pairs", job.limits, folder)

        lamps = "ambient" in plan.settings.effects
        off = capture.ambient_frame == "yes" or (capture.ambient_frame == "auto" and lamps and not family.signed)
        begun = PairsManifest(
            status="incomplete",
            configuration=configuration,
            n=bench.n,
            m=bench.geometry.frame_shape,
            frames=sum(shot.sign != -1 for shot in family.shots),
            patterns=capture.patterns,
            own_patterns=(family.left.tolist(), family.right.tolist()) if is_own(capture.patterns) else None,
            exposure_s=1.0,
            camera=plain(bench.identity()),
            sensor=json.dumps(bench.sensor.model_dump(exclude_none=True)),
            digital=digital_of(bench.sensor, 1.0),
            scene=str(bench.loaded.path),
            seed=seed,
            count=asked.count,
            pictures=pictures.source,
            photographs=pictures.photographs,
            ambient_shots=ambient_shots(family) if off else 0,
            groups=tuple(groups) if asked.vary else (),
            shards=tuple(shards),
            versions=versions(),
        )
        write_json(folder / PAIRS, begun)

        if left:
            light = trace_request(bench, plan, job, integer(seed, "white prints", 0))
            shares, white, whole = white_shares(light), light.truth, light.merge()
            speckle = bench.speckle(family) if "speckle" in plan.settings.effects else 0.0

        def pairs_of(shard: Shard, moved: Apparatus, kept: PrintLight) -> Iterator[dict[str, Any]]:
            per_joule, sensor = electrons_per_joule(moved), moved.sensor
            fraction = groups[shard.group].get("exposure_fraction", capture.timing.fraction)
            timing = replace(capture.timing, fraction=fraction)
            for index in range(shard.first, shard.first + shard.count):
                picture = pictures.draw(index, bench.n)
                reflectance = picture / WHITE
                truth = white * (shares @ reflectance.ravel()).reshape(white.shape)
                peak = peak_irradiance(kept.frames_of(reflectance))
                exposure_s = timing.choose(moved.devices, peak / per_joule)
                filled = (peak + sensor.superpixel_dark_current_e_per_s) * exposure_s
                saturated = np.uint8(filled >= sensor.superpixel_full_well_e)
                job.progress("pairs", (index + 1) / asked.count)
                yield {
                    "picture": picture, "truth": truth.astype(np.float32), "exposure_s": exposure_s,
                    "saturated": saturated,
                }  # fmt: skip

        for shard in left:
            mask = {
                name.partition(".")[2]: value for name, value in groups[shard.group].items() if name.startswith("mask.")
            }
            moved = drift_mask(bench, Drift(**mask)) if mask else bench
            kept, warnings = print_light(whole, moved, family), (*light.warnings, *light.unreached)
            with job.clock.stage("pairs"):
                write_shard(folder / shard.file, digest, pairs_of(shard, moved, kept), kept, speckle, warnings)

        facts = [PairStore(folder, begun).facts(shard) for shard in shards]
        exposure_s = float(np.median(np.concatenate([exposures for exposures, _, _ in facts])))
        found = [text for _, _, texts in facts for text in texts]
        if saturated := sum(count for _, count, _ in facts):
            found.append(f"saturation: {saturated} pairs are expected to fill the full well; use a shorter exposure")
        if bench.loaded.lamps and capture.ambient_frame == "no" and not family.signed:
            found.append("light of lamps is not subtracted (ambient_frame is no): frames contain it, but truths do not")
        found += camera_warnings(bench.sensor, begun.m)
        new = {"status": "complete", "exposure_s": exposure_s, "digital": digital_of(bench.sensor, exposure_s)}
        manifest = begun.model_copy(update={**new, "warnings": tuple(dict.fromkeys(found))})
        write_json(folder / PAIRS, manifest)
    return PairStore(folder, manifest), cost

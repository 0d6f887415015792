"""Pairs to learn from: pictures on the prints of a bench, their frames and truths.

Each cell of the light lies in one pixel of the picture. The light of a picture is therefore that of a white print times
the reflectance of each cell's pixel. That holds for light from one flat sheet straight to the sensor, however the
projector blurs, scatters or leaks. Elsewhere (:func:`mitsim.bench.prints.traced_anew`) each picture's light is traced.
Idealised frames follow the paper's separable model.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from mitsim.acquire.capture import trace_request
from mitsim.acquire.drifting import drift_mask
from mitsim.acquire.exposure import ambient_shots, camera_warnings, peak_irradiance
from mitsim.acquire.spectral import plan_request
from mitsim.api.bench import Bench
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.prints import show_picture, show_white, traced_anew
from mitsim.bench.request import Task
from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.environment import deciding_versions, versions
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.files import PAIRS, output_folder, plain, write_json
from mitsim.core.job import Cost, Job
from mitsim.core.manifests import CalibrationManifest
from mitsim.core.seeds import integer
from mitsim.devices.patterns import PatternFamily
from mitsim.devices.sensor import digital_of
from mitsim.devices.session import Drift
from mitsim.learn.pair_request import CALIBRATION, PairsRequest
from mitsim.learn.pair_store import (
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
from mitsim.learn.pictures import WHITE, DrawnPictures, FolderPictures
from mitsim.light.light import SampledLight, Sampling, trace_light, traced_again
from mitsim.light.memory import first_shadow, frames_cost
from mitsim.light.plan import Plan
from mitsim.light.simulation import Simulation, emission
from mitsim.optics.image_formation import FrameOptics
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.solution import Status, Verdict
from mitsim.report.lit_scene import IdealCamera
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.transport.records import Bundle

SHARD = 100
"""Most pairs of a shard: an interruption loses a minute, and light is kept once for a hundred pairs."""
_PICTURE_S = 3e-6
_PAIR_BYTES, _FRAME_BYTES = 4, 4
_SHADOW_BYTES = 40
"""Bytes of the stored shadow for a pixel of the frame's sides and a pixel of the projector's; measured 27 to 30."""
_FORMED = 0.5
"""Time to form a pair's frames over that of a capture, whose Monte Carlo error is probed as well; measured 0.4 to 0.6
(uniform light, 49 dots)."""

Opening = Callable[[Mapping[str, str]], Bench]

# -------- Light of white prints

_STRAIGHT = ("fine", "anchor_residual")


@dataclass(frozen=True, eq=False)
class WhitePrints:
    """Bench whose prints are white, in its light.

    Attributes
    ----------
    light
        Light merged into one group.
    white
        (n, n) apparent reflectance of the white prints.
    shares
        (n^2, n^2) part of each projector pixel's direct light that each pixel of the picture reflects.
    warnings
        Warnings of the light.
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
        """Return the light by the classes of a family, before the mask of a bench."""
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
        """Return the light of the separable model: even on all pixels, the mask without diffraction."""
        bench, lighting = self.light.bench, family.lighting
        pixels, classes = bench.n**2, int(lighting.labels.max()) + 1
        sides = IdealCamera(bench, bench.geometry.mask).directions
        optics = FrameOptics(bench.geometry, *sides, (bench.geometry.scene_distance,), 1, None)
        even = float(self.light.apparent.board_flux.mean()) * electrons_per_joule(bench) * self.white.ravel()
        light = sparse.csr_array((even, (lighting.labels, np.arange(pixels))), shape=(classes, pixels))
        line = np.arange(bench.n)
        return PrintLight((PrintPart(optics, light, line, line, False),), lighting.weights)


def picture_axes(light: SampledLight, bundle: Bundle) -> tuple[Labels, Labels]:
    """Return the row and column of the picture's pixel in which each row and column of a bundle's cells lies.

    Cells outside the projector's window get the nearest pixel.
    """
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


# -------- Making a store


class _Maker:
    """Benches, their light and their pairs; the last bench and its light are kept."""

    def __init__(self, opening: Opening, asked: PairsRequest, job: Job) -> None:
        self._opening, self._asked, self._job = opening, asked, job
        self._groups, seed = asked.groups(), asked.capture.seed
        self._pictures = DrawnPictures(seed) if asked.pictures is None else FolderPictures(Path(asked.pictures), seed)
        self._open: tuple[dict[str, str], Bench, Plan] | None = None
        self._white: tuple[Bench, WhitePrints] | None = None
        self.bench, self._plan = self._bench_of(0)
        self._family = self.bench.family(asked.capture.patterns, asked.capture.seed)
        self.why_anew = self._why(self.bench)

    @property
    def configuration(self) -> dict[str, Any]:
        asked, bench = self._asked, self.bench
        found: dict[str, Any] = plain(
            {
                **asked.capture.deciding,
                "count": asked.count,
                "idealised": asked.idealised,
                "pictures": self._pictures.source,
                "groups": self._groups,
                "bench": {**bench.provenance(), **bench.identity()},
                "versions": deciding_versions(),
            }
        )
        return found

    def _why(self, bench: Bench) -> str:
        return "" if self._asked.idealised else traced_anew(bench)

    def check_pictures(self, shards: Iterable[Shard]) -> None:
        if isinstance(self._pictures, FolderPictures):
            files = len(self._pictures.files)
            for number in {index % files for each in shards for index in range(each.first, each.first + each.count)}:
                self._pictures.draw(number, self.bench.n)

    def check_benches(self, groups: Iterable[int]) -> None:
        """Open all benches before any light is traced.

        Raise MitsimError if one cannot be opened, or if its light must be traced for each picture and that of the first
        bench need not.
        """
        if self.why_anew:
            return
        of_groups = {tuple(self._parameters(group).items()): group for group in groups}
        for parameters, group in of_groups.items():
            if parameters and (why := self._why(self._opening(dict(parameters)))):
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
        drawn = self._groups[shard.group]
        mask = {name.partition(".")[2]: value for name, value in drawn.items() if name.startswith("mask.")}
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
        timing = self._asked.capture.timing
        timing = replace(timing, fraction=self._groups[shard.group].get("exposure_fraction", timing.fraction))
        per_joule = electrons_per_joule(moved)
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
            frames = None
            if keep:
                rates = np.stack([(frame.irradiance * unit).astype(np.float32) for frame in expected])
                frames = rates, (expected.projector_off.irradiance * unit).astype(np.float32)
            self._job.progress("pairs", (index + 1) / self._asked.count)
            yield Pair(picture, truth, exposure_s, saturated, warnings, frames)

    def cost(self, left: Sequence[Shard]) -> Cost:
        pairs, pixels, shots = sum(shard.count for shard in left), self.bench.n**2, len(self._family.shots)
        of_benches = {tuple(sorted(self._groups[shard.group].items())) for shard in left}
        varied = self._asked.vary is not None and bool(self._asked.vary.scene)
        taken = self._plan.predicted
        tracing = taken["transport"] + taken["truth"]
        each = _FORMED * taken["optics"] + _PICTURE_S * pixels
        few = not self.why_anew and not self.bench.geometry.is_correlated(self.bench.geometry.diffracts)
        frames = 0 if few else _FRAME_BYTES * shots * math.prod(self.bench.geometry.frame_shape)
        benches = len(of_benches) if varied else 1
        seconds = pairs * (each + (tracing if self.why_anew else 0.0))
        seconds += benches * (taken["plan"] + (0.0 if self.why_anew else tracing))
        memory = frames_cost(self.bench, self._plan.settings, self._family.lighting).memory_bytes
        shadow = len(left) * _SHADOW_BYTES * sum(self.bench.geometry.frame_shape) * self.bench.n
        return Cost(seconds, memory, pairs * (pixels * _PAIR_BYTES + frames) + shadow)

    def begin(self, configuration: Mapping[str, Any], shards: tuple[Shard, ...]) -> PairsManifest:
        bench, asked, capture = self.bench, self._asked, self._asked.capture
        lamps = "ambient" in self._plan.settings.effects and not asked.idealised
        taken = capture.ambient_frame == "yes" or (
            capture.ambient_frame == "auto" and lamps and not self._family.signed
        )
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
            ambient_shots=(capture.ambient_shots or ambient_shots(self._family)) if taken else 0,
            groups=tuple(self._groups) if asked.vary else (),
            shards=shards,
            versions=versions(),
        )

    def factors(self) -> Factors:
        camera = IdealCamera(self.bench, self.bench.geometry.mask)
        sides = camera.calibrated(float(self._white_of(0).light.apparent.board_flux.mean()))
        left, right = (side.astype(np.float32).astype(np.float64) for side in sides)
        status = Status(Verdict.CALIBRATED, "Exact factors of the idealised model")
        manifest = CalibrationManifest(
            camera=plain(self.bench.identity()),
            centre=camera.centre,
            estimate=str(status),
            verdict=status.verdict.value,
            versions=versions(),
        )
        return Factors(left, right, manifest, status)

    def finish(self, store: PairStore) -> PairsManifest:
        begun, facts = store.manifest, [store.facts(shard) for shard in store.manifest.shards]
        exposure_s = float(np.median(np.concatenate([exposures for exposures, _, _ in facts])))
        saturated = sum(count for _, count, _ in facts)
        found = [text for _, _, warnings in facts for text in warnings]
        if saturated:
            found.append(f"saturation: {saturated} pairs are expected to fill the full well; expose for less")
        if self.bench.loaded.lamps and self._asked.capture.ambient_frame == "no" and not self._family.signed:
            found.append("light of lamps is not taken off (ambient_frame is no): frames have it, and truths have not")
        found += camera_warnings(self.bench.sensor, begun.m)
        return begun.model_copy(
            update={
                "status": "complete",
                "exposure_s": exposure_s,
                "digital": digital_of(begun.sensor_model, exposure_s),
                "warnings": tuple(dict.fromkeys(found)),
            }
        )


def _shards(asked: PairsRequest) -> tuple[Shard, ...]:
    found, groups = list[Shard](), 1 if asked.vary is None else asked.vary.groups
    ends = [asked.count * (group + 1) // groups for group in range(groups)]
    for group, (start, end) in enumerate(zip([0, *ends], ends, strict=False)):
        for first in range(start, end, SHARD):
            file = f"pairs_{len(found):05}.h5"
            found.append(Shard(file=file, first=first, count=min(SHARD, end - first), group=group))
    return tuple(found)


def make_pairs(opening: Opening, asked: PairsRequest, task: Task) -> tuple[PairStore, Cost]:
    """Make pairs of pictures on the prints of a scene in a folder, and return their predicted cost too.

    Idealised pairs get their factors. A resumed store equals an uninterrupted one bit for bit.

    Raises
    ------
    MitsimError
        If the request cannot be served, the limits of time, memory or disk do not suffice, the scene has no print, or
        the output cannot be written or is that of another request.
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
    shards = _shards(asked)
    with output_folder(task.output, overwrite=again) as folder:
        left = [shard for shard in shards if not is_shard(folder / shard.file, digest, shard.count)]
        maker.check_pictures(left)
        maker.check_benches(shard.group for shard in left)
        cost = maker.cost(left)
        cost.check(f"{asked.count} pairs", job.limits, folder)
        job.clock.predict({"pairs": cost.seconds})
        begun = maker.begin(configuration, shards)
        write_json(folder / PAIRS, begun)
        for shard in left:
            maker.write(shard, folder / shard.file, digest)
        if asked.idealised:
            (folder / CALIBRATION).mkdir(exist_ok=True)
            maker.factors().write(folder / CALIBRATION)
        manifest = maker.finish(PairStore(folder, begun))
        write_json(folder / PAIRS, manifest)
    return PairStore(folder, manifest), cost

"""Pairs to learn from: a bench, pictures and what is asked for in; a store of frames and truths out.

Rendered, light of a white print is traced once for each bench and multiplied by every picture, where that is exact;
elsewhere it is traced anew for each picture. Idealised, frames are of the paper's separable model.
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

from mitsim.acquire.capture import trace_request
from mitsim.acquire.drifting import drift_mask
from mitsim.acquire.exposure import ambient_shots, camera_warnings, peak_irradiance
from mitsim.acquire.spectral import plan_request
from mitsim.api.bench import Bench
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.prints import show_picture, show_white, traced_anew
from mitsim.bench.request import Exposure, Task
from mitsim.core.arrays import FloatArray
from mitsim.core.environment import deciding_versions, versions
from mitsim.core.errors import ArgumentError
from mitsim.core.files import PAIRS, output_folder, plain
from mitsim.core.job import Cost, Job
from mitsim.core.manifests import CalibrationManifest
from mitsim.core.seeds import integer
from mitsim.devices.sensor import digital_of
from mitsim.devices.session import Drift
from mitsim.learn.pair_request import CALIBRATION, PairsRequest
from mitsim.learn.pair_store import (
    Pair,
    PairsManifest,
    PairStore,
    PrintLight,
    Shard,
    check_same,
    is_shard,
    write_pairs_manifest,
    write_shard,
)
from mitsim.learn.pictures import WHITE, Codes, DrawnPictures, FolderPictures, Pictures
from mitsim.learn.white_prints import WhitePrints, electrons_per_joule
from mitsim.light.light import Sampling, trace_light
from mitsim.light.memory import first_shadow, frames_cost
from mitsim.light.plan import Plan
from mitsim.optics.frames import ExpectedFrames
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.solution import Status, Verdict
from mitsim.report.lit_scene import IdealCamera

SHARD = 100
"""Pairs of a shard at most; chosen: an interrupted work loses a minute, and light is kept once for a hundred pairs."""
_PICTURE_S = 3e-6
"""Seconds of processor time that a pixel of a drawn picture takes; measured of 128 x 128 pixels, 50 ms each."""
_PAIR_BYTES, _FRAME_BYTES = 4, 4
"""Bytes of a pixel of picture and truth, packed, and of one of a frame that is kept; measured."""
_SHADOW_BYTES = 40
"""Bytes that a shard keeps of the shadow for a pixel of the frame's sides and a pixel of the projector's: some five
factors of 8 bytes; measured 27 to 30 (photograph)."""

Opening = Callable[[Mapping[str, str]], Bench]
"""Opens the bench with some parameters of the scene."""
# -------- Making a store

_FORMED = 0.5
"""Time of forming a pair's frames over that of a capture's, whose Monte Carlo error is probed as well; measured 0.4 to
0.6 (uniform light, 49 dots)."""


@dataclass(frozen=True, eq=False)
class _Shown:
    """A picture on the prints: ``picture`` (n, n) codes and ``truth`` (n, n); ``expected`` frames, and electrons a
    second in their ``unit``; ``warnings`` of the light."""

    picture: Codes
    truth: FloatArray
    expected: ExpectedFrames
    unit: float
    warnings: tuple[str, ...]


class _Maker:
    """Benches and their light, the last of each kept; and pairs before them.

    Parameters
    ----------
    opening, asked, job
        as :func:`make_pairs` has them.
    """

    def __init__(self, opening: Opening, asked: PairsRequest, job: Job) -> None:
        self._opening, self._asked, self._job = opening, asked, job
        self._groups, self._pictures = asked.groups(), _pictures(asked)
        self._open: tuple[dict[str, str], Bench, Plan] | None = None
        self._white: tuple[Bench, WhitePrints] | None = None
        self.bench, self._plan = self._bench_of(0)
        self._family = self.bench.family(asked.capture.patterns, asked.capture.seed)
        self.why_anew = self._why(self.bench)

    @property
    def configuration(self) -> dict[str, Any]:
        """All that decides the pairs."""
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
        """Why light on a ``bench`` is traced anew for each picture."""
        return "" if self._asked.idealised else traced_anew(bench)

    def check_pictures(self, shards: Iterable[Shard]) -> None:
        """Read the files of pictures of all ``shards``: a store is not resumed with others. MitsimError for one that
        cannot be shown."""
        if isinstance(self._pictures, FolderPictures):
            files = len(self._pictures.files)
            for number in {index % files for each in shards for index in range(each.first, each.first + each.count)}:
                self._pictures.draw(number, self.bench.n)

    def check_benches(self, groups: Iterable[int]) -> None:
        """Open the benches of all ``groups`` before any light is traced. MitsimError for one that cannot be opened, and
        where light is to be traced anew for each picture before some benches and not before the first."""
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
        """Parameters of the scene that are drawn for a ``group``."""
        drawn = self._groups[group].items()
        return {name.partition(".")[2]: repr(value) for name, value in drawn if name.startswith("scene.")}

    def _bench_of(self, group: int) -> tuple[Bench, Plan]:
        """The bench of a ``group``, its prints white where one tracing serves all pictures, and its plan."""
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

    def _with_moved_mask(self, bench: Bench, group: int) -> Apparatus:
        """The ``bench`` of a ``group`` with its mask where it has moved to."""
        drawn = self._groups[group].items()
        moved = {name.partition(".")[2]: value for name, value in drawn if name.startswith("mask.")}
        return drift_mask(bench, Drift(**moved)) if moved else bench

    def _timing(self, group: int) -> Exposure:
        """How the exposure of a ``group`` is found."""
        timing = self._asked.capture.timing
        return replace(timing, fraction=self._groups[group].get("exposure_fraction", timing.fraction))

    def _white_of(self, group: int) -> WhitePrints:
        bench, plan = self._bench_of(group)
        if self._white is None or self._white[0] is not bench:
            own = group if self._asked.variation and self._asked.variation.scene else 0
            light = trace_request(bench, plan, self._job, integer(self._asked.capture.seed, "white prints", own))
            self._white = bench, WhitePrints.of(light)
        return self._white[1]

    def write(self, shard: Shard, path: Path, digest: str) -> None:
        """Write the file of a ``shard`` to a ``path``, marked with a ``digest``."""
        bench, plan = self._bench_of(shard.group)
        moved, asked, light = self._with_moved_mask(bench, shard.group), self._asked, None
        if self.why_anew:
            shown = self._in_own_light(shard, bench, moved)
        else:
            white = self._white_of(shard.group)
            light = white.ideal_light(self._family) if asked.idealised else white.rendered_light(moved, self._family)
            shown = self._in_white_light(shard, white, light)
        speckled = "speckle" in plan.settings.effects and not asked.idealised
        speckle = bench.speckle(self._family) if speckled else 0.0
        kept = light if light is not None and light.few else None
        with self._job.clock.stage("pairs"):
            write_shard(path, digest, self._expose(shard, moved, shown, kept is None), speckle, kept)

    def _in_white_light(self, shard: Shard, white: WhitePrints, light: PrintLight) -> Iterator[_Shown]:
        """Pictures of a ``shard`` in the ``light`` of ``white`` prints."""
        for index in range(shard.first, shard.first + shard.count):
            picture = self._pictures.draw(index, self.bench.n)
            reflectance = picture / WHITE
            truth = white.white * reflectance if self._asked.idealised else white.truth(reflectance)
            yield _Shown(picture, truth, light.frames_of(reflectance), 1.0, white.warnings)

    def _in_own_light(self, shard: Shard, bench: Bench, moved: Apparatus) -> Iterator[_Shown]:
        """Pictures of a ``shard`` on the prints of a ``bench``, in light that is traced for each; ``moved``: the same
        with its mask moved."""
        _, plan = self._bench_of(shard.group)
        for index in range(shard.first, shard.first + shard.count):
            picture = self._pictures.draw(index, bench.n)
            show_picture(bench, picture / WHITE)
            seed = integer(self._asked.capture.seed, "prints", index)
            light = trace_light(bench, plan, self._family.lighting, seed, Sampling(by_pixel=False))
            expected = light.merge().behind(moved).frames(self._family.lighting, seed)
            warnings = *light.warnings, *light.unreached
            yield _Shown(picture, light.truth, expected, electrons_per_joule(bench), warnings)

    def _expose(self, shard: Shard, bench: Apparatus, shown: Iterable[_Shown], keep: bool) -> Iterator[Pair]:
        """Pairs of what is ``shown``, each with its exposure; ``keep``: with its frames."""
        timing, sensor, unit = self._timing(shard.group), bench.sensor, electrons_per_joule(bench)
        for number, each in enumerate(shown):
            peak = peak_irradiance(each.expected) * each.unit
            exposure_s = timing.choose(bench.devices, peak / unit)
            saturated = (peak + sensor.superpixel_dark_current_e_per_s) * exposure_s >= sensor.superpixel_full_well_e
            frames = None
            if keep:
                rates = np.stack([(frame.irradiance * each.unit).astype(np.float32) for frame in each.expected])
                frames = rates, (each.expected.projector_off.irradiance * each.unit).astype(np.float32)
            self._job.progress("pairs", (shard.first + number + 1) / self._asked.count)
            yield Pair(each.picture, each.truth, exposure_s, saturated, each.warnings, frames)

    def cost(self, left: Sequence[Shard]) -> Cost:
        """What the shards that are ``left`` take, with the first plan, which is made."""
        pairs, pixels, shots = sum(shard.count for shard in left), self.bench.n**2, len(self._family.shots)
        of_benches = {tuple(sorted(self._groups[shard.group].items())) for shard in left}
        varied = self._asked.variation is not None and bool(self._asked.variation.scene)
        taken = self._plan.predicted
        tracing = taken["transport"] + taken["truth"]
        each = _FORMED * taken["optics"] + _PICTURE_S * pixels
        few = not self.why_anew and not self.bench.geometry.is_correlated(self.bench.geometry.diffracts)
        stored = pixels * _PAIR_BYTES + (
            0 if few else _FRAME_BYTES * shots * math.prod(self.bench.geometry.frame_shape)
        )
        benches = len(of_benches) if varied else 1
        seconds = pairs * (each + (tracing if self.why_anew else 0.0))
        seconds += benches * (taken["plan"] + (0.0 if self.why_anew else tracing))
        memory = frames_cost(self.bench, self._plan.settings, self._family.lighting).memory_bytes
        shadow = len(left) * _SHADOW_BYTES * sum(self.bench.geometry.frame_shape) * self.bench.n
        return Cost(seconds, memory, pairs * stored + shadow)

    def begin(self, configuration: Mapping[str, Any], shards: tuple[Shard, ...]) -> PairsManifest:
        """The manifest of an unfinished store of that ``configuration`` and these ``shards``."""
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
            groups=tuple(self._groups) if asked.variation else (),
            shards=shards,
            versions=versions(),
        )

    def factors(self) -> Factors:
        """Exact factors of the idealised model."""
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
        """The manifest of a ``store`` whose shards are all written."""
        begun, facts = store.manifest, [store.facts(shard) for shard in store.manifest.shards]
        exposure_s = float(np.median(np.concatenate([each.exposure_s for each in facts])))
        saturated = sum(each.saturated for each in facts)
        found = [text for each in facts for text in each.warnings]
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


def _pictures(asked: PairsRequest) -> Pictures:
    """Where pictures of pairs that are ``asked`` for come from."""
    seed = asked.capture.seed
    return DrawnPictures(seed) if asked.folder is None else FolderPictures(asked.folder, seed)


def _shards(asked: PairsRequest) -> tuple[Shard, ...]:
    """Files of the pairs that are ``asked`` for; benches get equal parts of these."""
    found, groups = list[Shard](), 1 if asked.variation is None else asked.variation.groups
    ends = [asked.count * (group + 1) // groups for group in range(groups)]
    for group, (start, end) in enumerate(zip([0, *ends], ends, strict=False)):
        for first in range(start, end, SHARD):
            file = f"pairs_{len(found):05}.h5"
            found.append(Shard(file=file, first=first, count=min(SHARD, end - first), group=group))
    return tuple(found)


def make_pairs(opening: Opening, asked: PairsRequest, task: Task) -> tuple[PairStore, Cost]:
    """Pairs of pictures on the prints of a scene, in a folder, idealised ones with their factors; and what they were
    predicted to take.

    Parameters
    ----------
    opening
        of the bench.
    asked
        which pairs.
    task
        whose output is made, or resumed: bit-equal to one that was not interrupted.

    Raises
    ------
    MitsimError
        for a request that cannot be served, more time, memory or disk than the limits allow, a scene without a print,
        and an output that cannot be written or is of another request.
    """
    asked.check()
    assert task.output is not None, "pairs are kept in a folder"
    again = task.resume and (task.output / PAIRS).is_file()
    maker, job = _Maker(opening, asked, task.job), task.job
    configuration = maker.configuration
    if again:
        check_same(task.output, configuration)
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
        write_pairs_manifest(folder, begun)
        for shard in left:
            maker.write(shard, folder / shard.file, digest)
        if asked.idealised:
            (folder / CALIBRATION).mkdir(exist_ok=True)
            maker.factors().write(folder / CALIBRATION)
        manifest = maker.finish(PairStore(folder, begun))
        write_pairs_manifest(folder, manifest)
    return PairStore(folder, manifest), cost

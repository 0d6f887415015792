"""From the paper's idealised model of a scene to its rendered frames, one effect at a time: the cost of each in dB.

An effect is added *alone* to the idealised model, *in order* after all effects before it, or *left out* of the whole.
Effects of the scene are removed from its light (:class:`Ablation`). Shot noise, read noise and dark current
are always on, because the paper's model has them. The exposure is that of equal peak. Images are made with the *model
assumed*, the exact factors of the idealised camera. The last image is made again with the *model calibrated*, the
factors of a session (:mod:`mitsim.studies.calibration_study` shares out what this image still loses).

**Light without effects** (:class:`Ablation`). Light without any effect is the paper's idealised model: an evenly lit
sheet at the aligned distance that shows the truth, under the geometric shadow of the mask. Without

- *falloff*, every projector pixel is as bright on a white board as their mean, in matt scenes all over the sensor;
- *diffraction*, *black level*, *speckle*, values are neutral (:data:`mitsim.bench.effects.EFFECTS`);
- *keystone*, light lies where its projector pixel would, if the window filled its bounding box evenly;
- *depth*, light lies where its ray from the projector meets the aligned plane;
- *occlusion* or *gloss*, every point of the sensor sees the mean over the sensor;
- *detail*, the light of a projector pixel is even over the pixel, or over its points that send light;
- *interreflection*, *mirrors*, *ambient*, light over several surfaces, over mirrors, or from lamps is absent;
- *defocus*, a pinhole replaces the projector's lens, and pixels are sharp;
- *render noise*, each projector pixel has the flux that the truth states.

The truth is the same for all. Glare and light of sharp lobes are not moved, and indirect light stays where it is seen.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy import sparse

from mitsim.acquire.capture import capture
from mitsim.acquire.spectral import SpectralBench
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.request import Exposure
from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.manifests import CalibrationManifest
from mitsim.core.seeds import integer
from mitsim.devices.patterns import Lighting
from mitsim.devices.sensor import SensorModel
from mitsim.light.light import SampledLight, Truth, traced_again
from mitsim.light.passes import FOLLOWED, PASSES, LightEstimate, Simulation, TracedPass, expected_of
from mitsim.light.settings import Settings
from mitsim.metrics import psnr
from mitsim.optics.frames import ExpectedFrames
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.reconstruct.solver import Solution, Status, Verdict
from mitsim.report import RENDERED
from mitsim.report.lit_scene import IdealCamera, LitScene
from mitsim.scene.load import straightening
from mitsim.studies.framework.claims import TOLERANCE_DB, Gain
from mitsim.studies.framework.experiment import QUICK_IMAGES, TRUTH, Found, Point, Scope, Study
from mitsim.studies.framework.panels import Bars, Images
from mitsim.studies.framework.studio import Studio, flags_of, single_precision
from mitsim.transport.connect import CanvasMap
from mitsim.transport.plugins.base import rows_columns, turn_and_origin
from mitsim.transport.records import DIRECT, DeviceAccumulator, DeviceSums, PathSamples

EFFECTS = (
    FALLOFF, DIFFRACTION, KEYSTONE, DEPTH, OCCLUSION, DETAIL, INTERREFLECTION, MIRRORS, GLOSS, AMBIENT, BLACK_LEVEL,
    DEFOCUS, SPECKLE, SATURATION, QUANTISATION, RENDER_NOISE,
) = (
    "falloff", "diffraction", "keystone", "depth", "occlusion", "detail", "interreflection", "mirrors", "gloss",
    "ambient", "black level", "defocus", "speckle", "saturation", "quantisation", "render noise",
)  # fmt: skip
REGISTERED: Mapping[str, set[str]] = {
    DIFFRACTION: {"diffraction"}, INTERREFLECTION: {"interreflection"}, MIRRORS: {"mirrors"}, AMBIENT: {"ambient"},
    BLACK_LEVEL: {"black-level"}, DEFOCUS: {"aperture", "blur"}, SPECKLE: {"speckle"},
}  # fmt: skip
"""Effects of :data:`mitsim.bench.effects.EFFECTS` by name."""
_MOVED = frozenset({KEYSTONE, DEPTH, DETAIL, DEFOCUS})
_FURTHER = frozenset({"interreflection", "mirrors", "ambient"})
_WHOLE = "pixels that are lit all over"
_POINTS = 2
"""Points per side of a cell that represent even light."""
_SIMULATIONS = 4
_IN_PLACE = 1e-3
"""Tolerated distance from the aligned plane [projector pixels], because float32 leaves 1e-4."""


# -------- Light without some of its effects


class Ablation:
    """Light from which any of its effects can be removed; retraced light is kept."""

    def __init__(self, light: SampledLight) -> None:
        truth, bench, simulation = light.apparent, light.bench, light.simulation
        board, settings, physics = truth.board_flux, simulation.settings, simulation.physics
        self.light, self._exact = light, truth.reflectance.ravel() * board  # direct light by the truth [W m^-2]
        self._even = np.divide(board.mean(), board, out=np.ones_like(board), where=board > 0)
        self._kept: dict[tuple[bool, frozenset[str]], SampledLight] = {}
        self._simulated = lru_cache(maxsize=_SIMULATIONS)(lambda settings: Simulation(bench, settings))
        samples = simulation.direct.trace(integer(light.seed, "transport", "place"), 0, 1)
        pixel = np.array([(last - first) / bench.n for first, last in bench.windows])
        aside = np.abs(_Place(bench).parallax(samples)) / pixel[:, None]
        present = {
            FALLOFF: True,
            DIFFRACTION: physics.spectrum is not None,
            KEYSTONE: bench.loaded.pixels.keystone > 0,
            DEPTH: bool(aside.size and aside.max() > _IN_PLACE),
            OCCLUSION: bool(settings.with_own_anchors),
            DETAIL: settings.subdivision > 1,
            INTERREFLECTION: physics.interreflection and any(group["indirect"].nnz for group in light.groups),
            MIRRORS: physics.mirrors,
            GLOSS: bench.loaded.glossy and (settings.anchors > 1 or settings.sharp is not None),
            AMBIENT: bool(physics.lamps),
            BLACK_LEVEL: physics.black_level > 0,
            DEFOCUS: not physics.projector.ideal,
            SPECKLE: physics.speckle > 0,
            RENDER_NOISE: True,
        }
        self.effects = tuple(name for name, there in present.items() if there)

    def without(self, off: frozenset[str]) -> SampledLight:
        off &= frozenset(self.effects)
        if not off:
            return self.light
        bench, moved = self.light.bench, off & _MOVED
        brightness = self._even if FALLOFF in off else np.ones_like(self._even)
        absent = _FURTHER | _registered(off)
        # Light over mirrors lies among direct light, and only tracing separates them.
        direct = self._trace(direct=True, off=moved) if moved or MIRRORS in self.effects else self.light
        share = self.light.simulation.physics.projector.share  # the truth has no glare
        flux = share * self._exact if RENDER_NOISE in off else self.light.flux
        by_pixel = np.divide(flux, direct.flux, out=np.ones_like(flux), where=direct.flux > 0)
        groups = tuple(_scale(group, np.append(by_pixel * brightness, 0.0)) for group in direct.groups)
        if GLOSS in off:
            sharp = (_even_lobes(group["sharp"], direct.simulation) for group in groups)
            groups = tuple(group.with_light({"sharp": own}) for group, own in zip(groups, sharp, strict=True))
        settings = direct.simulation.settings
        formed = replace(
            settings, effects=settings.effects - absent, occluded=() if OCCLUSION in off else settings.occluded,
            anchors=1 if (GLOSS if bench.loaded.glossy else FALLOFF) in off else settings.anchors, followed_anchors=1,
        )  # fmt: skip
        own = {field.name: getattr(self.light, field.name) for field in fields(SampledLight)}
        own |= {"groups": groups, "simulation": self._simulated(formed)}
        return AblatedLight(**own, whole=self.light, rest=self._rest(off, brightness))

    def _rest(self, off: frozenset[str], brightness: FloatArray) -> SampledLight | None:
        light, settings = self.light, self.light.simulation.settings
        effects = settings.effects - _registered(off)
        if not effects & _FURTHER:
            return None
        brightness = np.append(brightness, 1.0)
        if MIRRORS in self.effects:
            light = self._trace(direct=False, off=off & {MIRRORS})
            groups = tuple(_scale(group, brightness) for group in light.groups)
        else:
            lamps = np.append(np.zeros(len(brightness) - 1), 1.0)
            groups = tuple(
                _scale(group, brightness).with_light({"fine": _weigh(group["fine"], lamps)}) for group in light.groups
            )
        plain = replace(settings, anchors=1, sharp=None, occluded=(), effects=effects)
        return replace(light, groups=groups, simulation=self._simulated(plain))

    def _trace(self, direct: bool, off: frozenset[str]) -> SampledLight:
        if (direct, off) not in self._kept:
            settings, bench = self.light.simulation.settings, self.light.bench
            own = off
            if DETAIL in off and off >= {DEPTH, DEFOCUS} & frozenset(self.effects):
                own |= {_WHOLE}
            absent = _registered(off)
            if direct:
                absent |= _FURTHER
                settings = replace(settings, followed_anchors=1)
            if DEPTH in off:
                settings = replace(settings, depth=bench.geometry.scene_distance, layers=())
            settings = replace(settings, effects=settings.effects - absent)
            self._kept[direct, off] = traced_again(self.light, _AblationSimulation(bench, settings, direct, own))
        return self._kept[direct, off]


@dataclass(frozen=True, eq=False)
class AblatedLight(SampledLight):
    whole: SampledLight | None = None
    rest: SampledLight | None = None

    def frames(self, lighting: Lighting, seed: int, leaking: bool = True) -> ExpectedFrames:
        parts = [(each.simulation, each.groups) for each in (self, self.rest) if each is not None]
        return expected_of(parts, self.rows_of(lighting), lighting, seed, leaking)

    @cached_property
    def apparent(self) -> Truth:
        assert self.whole is not None
        return self.whole.apparent


class _AblationSimulation(Simulation):
    def __init__(self, bench: Apparatus, settings: Settings, direct: bool, off: frozenset[str]) -> None:
        super().__init__(bench, settings)
        self._only_direct, self._off, self._place = direct, off, _Place(bench)

    @cached_property
    def passes(self) -> Mapping[str, TracedPass]:
        return {
            name: each for name, each in super().passes.items() if (each.row.effects >= FOLLOWED) != self._only_direct
        }

    def accumulator(self, name: str, labels: Labels, lines: int) -> DeviceAccumulator | None:
        # Light that is accumulated on the device lies where it was traced.
        moved = self._off & {DEPTH, KEYSTONE} and PASSES[name].anchors
        return None if moved else super().accumulator(name, labels, lines)

    def accumulate(self, name: str, found: PathSamples | DeviceSums, labels: Labels, samples: int) -> LightEstimate:
        if isinstance(found, DeviceSums) or not (name == "direct" or PASSES[name].anchors):
            return super().accumulate(name, found, labels, samples)
        if name != "direct":
            return super().accumulate(name, self._place.move(found, self._off), labels, samples)
        if _WHOLE in self._off:
            seen = self._place.whole(found, _POINTS * self.settings.subdivision, KEYSTONE in self._off)
        else:
            even, pixels = found, self.bench.n**2
            if DETAIL in self._off:
                count, total = (np.bincount(found.pixel, weights, pixels) for weights in (None, found.value))
                even = replace(found, value=(total / np.maximum(count, 1))[found.pixel])
            seen = self._place.move(even, self._off)
        return replace(super().accumulate(name, seen, labels, samples), flux=self.flux(found, samples))


class _Place:
    def __init__(self, bench: Apparatus) -> None:
        loaded, grid = bench.loaded, bench.loaded.pixels
        turn, origin = turn_and_origin(loaded.camera.world_transform())
        x, y, self._z = (CanvasMap.of(loaded.projector).origin - origin) @ turn
        self._row, self._column = (float(value) for value in rows_columns(x, y))
        self._plane = 1 / bench.geometry.scene_distance
        self._n, self._windows = grid.n, bench.windows
        self._straight = straightening(
            str(loaded.path), loaded.projector, loaded.camera, grid, bench.geometry.scene_distance
        )

    def move(self, path_samples: PathSamples, off: frozenset[str]) -> PathSamples:
        if not off & {DEPTH, KEYSTONE}:
            return path_samples
        row, column, on_plane = path_samples.row, path_samples.column, self._on_plane(path_samples)
        straight = _project(self._straight, *on_plane) if KEYSTONE in off else on_plane
        if DEPTH in off:
            return replace(
                path_samples, row=straight[0], column=straight[1], inverse_depth=np.full_like(row, self._plane)
            )
        row, column = row + straight[0] - on_plane[0], column + straight[1] - on_plane[1]
        return replace(path_samples, row=row, column=column)

    def whole(self, path_samples: PathSamples, side: int, straight: bool) -> PathSamples:
        """Return light at ``side`` x ``side`` even points of each projector pixel; ``straight`` omits keystone."""
        n = self._n
        part = (np.arange(n * side) + 0.5) / side
        lines = [first + (last - first) * part / n for first, last in self._windows]
        row, column = (np.asarray(places.ravel(), np.float64) for places in np.meshgrid(*lines, indexing="ij"))
        pixel = np.add.outer(part.astype(np.int64) * n, part.astype(np.int64)).ravel()
        if not straight:
            row, column = _project(np.asarray(np.linalg.inv(self._straight), np.float64), row, column)
        value = np.bincount(path_samples.pixel, path_samples.value, n * n)[pixel] / side**2
        first = np.zeros_like(pixel)
        depth, kind = np.full_like(row, self._plane), np.full(len(pixel), DIRECT, dtype=np.int16)
        return PathSamples(pixel, first, first, row, column, depth, value, kind).where(value > 0)

    def parallax(self, path_samples: PathSamples) -> FloatArray:
        """Return the tan-angles (2, m) between ``path_samples`` and their places on the plane."""
        row, column = self._on_plane(path_samples)
        return np.stack([path_samples.row - row, path_samples.column - column])

    def _on_plane(self, path_samples: PathSamples) -> tuple[FloatArray, FloatArray]:
        inverse, places = path_samples.inverse_depth, list[FloatArray]()
        for tangent, origin in ((path_samples.row, self._row), (path_samples.column, self._column)):
            # A ray from (o, o_z) with slope s is seen at tangent s (1 - o_z / z) + o / z at depth z.
            slope = (tangent - origin * inverse) / (1 - self._z * inverse)
            places.append(np.asarray(slope * (1 - self._z * self._plane) + origin * self._plane))
        return places[0], places[1]


def _project(homography: FloatArray, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
    first, second, scale = homography @ np.stack([row, column, np.ones_like(row)])
    return first / scale, second / scale


def _registered(off: frozenset[str]) -> frozenset[str]:
    return frozenset().union(*(REGISTERED.get(name, ()) for name in off))


def _even_lobes(sharp: sparse.csr_array, simulation: Simulation) -> sparse.csr_array:
    if simulation.settings.sharp is None:
        return sharp
    bundle = simulation.grids["sharp"].bundle
    weights = simulation.mean_weights(bundle.anchors)
    rows, columns = bundle.cells
    layer, place = np.divmod(np.arange(bundle.size), bundle.anchors**2 * rows * columns)
    line, spot = np.divmod(place, bundle.anchors * columns)
    (first, row), (second, column) = np.divmod(line, rows), np.divmod(spot, columns)
    one = (layer * rows + row) * columns + column
    entries = weights[first] * weights[second], (np.arange(bundle.size), one)
    mean = sparse.csr_array(entries, shape=(bundle.size, bundle.size // bundle.anchors**2))
    return bundle.repeat(sparse.csr_array(sharp @ mean))


def _scale(light: LightEstimate, by: FloatArray) -> LightEstimate:
    return light.with_light({name: _weigh(each, by) for name, each in light.light.items()})


def _weigh(rows: sparse.csr_array, by: FloatArray) -> sparse.csr_array:
    scaled = sparse.csr_array(sparse.diags_array(by) @ rows)
    scaled.eliminate_zeros()
    return scaled


# -------- Images with some of the effects

_ROOM = 1024.0
"""Full wells of a sensor without saturation: a power of two changes no other number."""
_LARGEST_ADC, _CODES = 24, 2**32
_SURE = 6.0


class Levels:
    """Images of a scene with any of its effects, by the factors of the idealised camera."""

    def __init__(self, lit: LitScene, patterns: str, seed: int) -> None:
        self.lit, self._patterns, self._seed, self._ablation = lit, patterns, seed, Ablation(lit.light)
        bench = lit.bench
        sides = IdealCamera(bench, bench.geometry.mask).calibrated(float(lit.light.apparent.board_flux.mean()))
        manifest = CalibrationManifest(camera=bench.identity(), centre=bench.geometry.centred, parallax=bench.parallax)
        self._factors = Factors(*sides, manifest, Status(Verdict.CALIBRATED, "Factors of the idealised camera"))
        fills = fills_well(bench.sensor, lit.light.simulation.physics.speckle)
        own = {SATURATION: fills, QUANTISATION: bench.sensor.bits is not None}
        self.effects = tuple(name for name in EFFECTS if name in self._ablation.effects or own.get(name, False))

    def image(self, on: frozenset[str]) -> Solution:
        off, light = frozenset(self.effects) - on, self.lit.light
        sensor, fraction = sensor_without(light.bench.sensor, off), Exposure().fraction
        fraction = fraction / _ROOM if SATURATION in off else fraction
        bench = replace(light.bench, devices=replace(light.bench.devices, sensor=sensor))
        request = light.plan.request
        assert request is not None
        options = request.with_values(patterns=self._patterns, seed=self._seed, exposure_fraction=fraction)
        shots = capture(SpectralBench(bench), options, lights=[self._ablation.without(off)]).runs[0]
        manifest = self._factors.manifest.model_copy(update={"camera": shots.manifest.camera})
        return reconstruct(shots, replace(self._factors, manifest=manifest))


def sensor_without(sensor: SensorModel, off: frozenset[str]) -> SensorModel:
    changed: dict[str, object] = {}
    if SATURATION in off:
        most = math.floor(math.log2(_CODES / sensor.binning**2))
        changed |= {"full_well_e": sensor.full_well_e * _ROOM, "bits": sensor.bits and min(_LARGEST_ADC, most)}
    if QUANTISATION in off:
        changed["bits"] = None
    return sensor.model_copy(update=changed)


def fills_well(sensor: SensorModel, speckle: float) -> bool:
    """Return True if light at equal peak, under ``speckle``, can saturate a ``sensor``."""
    well, largest = sensor.superpixel_full_well_e, sensor.largest_dn
    if largest is not None:
        well = min(well, (largest - sensor.superpixel_black_level_dn) / sensor.gain_dn_per_e)
    peak = Exposure().fraction * sensor.superpixel_full_well_e
    noise = math.hypot(math.sqrt(peak), sensor.superpixel_reading_noise_e)
    return speckle > 0 or peak + _SURE * noise > well


# -------- The study

ALONE, IN_ORDER, LEFT_OUT = WAYS = ("alone", "in order", "left out")
_KEPT = 64
_IDEAL, _ASSUMED, _CALIBRATED = "idealised", "assumed", "calibrated"
_LAST = {"way": IN_ORDER, "effect": EFFECTS[-1]}


def _points(scope: Scope) -> Sequence[Point]:
    pictures = [name for name in scope.pictures if name in (*QUICK_IMAGES, None)] or list(scope.pictures)
    return [
        Point.of(replace(scope.setup, picture=name), patterns="dots:7", seed=seed, way=way, effect=effect)
        for name in scope.choose(pictures, pictures[:1])
        for seed in scope.repeats
        for way in scope.choose(WAYS, WAYS[:2])
        for effect in EFFECTS
    ]


def _measure(studio: Studio, point: Point) -> Found:
    setup, seed, patterns = point.setup, int(point["seed"]), str(point["patterns"])
    way, effect, lit = point["way"], str(point["effect"]), studio.lit_scene(setup)
    levels = studio.once("levels", 1, (setup, seed), lambda: Levels(lit, patterns, seed))

    def image(on: frozenset[str]) -> Solution:
        own = on & frozenset(levels.effects)
        return studio.once("images", _KEPT, (setup, seed, own), lambda: levels.image(own))

    ideal, without, having = map(image, (frozenset[str](), *ends(way, effect)))
    before, after = psnr(without.image, lit.truth), psnr(having.image, lit.truth)
    row = point.row(
        called_for=effect in levels.effects, ideal_db=psnr(ideal.image, lit.truth), without_db=before, with_db=after,
        change_db=after - before, **flags_of(having.status),
    )  # fmt: skip
    if (way, effect) != (IN_ORDER, EFFECTS[-1]):
        return Found((row,))
    calibrated = studio.image(setup, RENDERED, patterns, seed)
    kept = {_IDEAL: ideal.image, _ASSUMED: having.image, _CALIBRATED: calibrated.image, TRUTH: lit.truth}
    return Found(({**row, "calibrated_db": calibrated.quality.psnr_db},), single_precision(kept))


def ends(way: str, effect: str) -> tuple[frozenset[str], frozenset[str]]:
    if way == ALONE:
        return frozenset(), frozenset({effect})
    if way == LEFT_OUT:
        return frozenset(EFFECTS) - {effect}, frozenset(EFFECTS)
    place = EFFECTS.index(effect)
    return frozenset(EFFECTS[:place]), frozenset(EFFECTS[: place + 1])


STUDY = Study(
    "waterfall",
    "From the idealised model to rendered frames",
    "What does each physical effect cost in decibels: alone, in order, and left out of the whole?",
    points=_points,
    measure=_measure,
    claims=(
        Gain(
            "A calibrated camera keeps what the idealised model promises (2 dB lost at most)", {}, {}, where=_LAST,
            column="calibrated_db", other_column="ideal_db", at_least=-TOLERANCE_DB, apart=True,
        ),
        Gain(
            "A calibrated model is better than the idealised one", {}, {}, where=_LAST, column="calibrated_db",
            other_column="with_db", apart=True,
        ),
    ),
    panels=(
        Bars(
            "effect", file="waterfall", title="Change of PSNR by each effect that the scene has", x="change_db",
            x_label="change of PSNR [dB]", colour="way", where={"called_for": True},
        ),
        Images(
            {
                _IDEAL: ("idealised", "{ideal_db:.1f} dB"), _ASSUMED: ("rendered, model assumed", "{with_db:.1f} dB"),
                _CALIBRATED: ("rendered, model calibrated", "{calibrated_db:.1f} dB"),
            },
            before={TRUTH: "truth"}, down=("picture",), where=_LAST,
        ),
    ),
    about="An image of 49 dots, exposed at equal peak, from the idealised model (even light on a plane, the mask's "
    "geometric shadow, factors known) to rendered frames, one physical effect after the other. Model assumed: the "
    "solver keeps the idealised camera's factors. Model calibrated: it has factors of a session.",
    heads=("", "Before", "After"),
)  # fmt: skip

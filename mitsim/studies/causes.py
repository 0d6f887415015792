"""Light of a scene and names of its effects in; the light as it would be without these, out.

Without any of them it is the paper's idealised model: an evenly lit sheet at the aligned distance that shows the truth,
under the geometric shadow of the mask. Between that and the light itself nothing is changed but what is taken out:

- *falloff*: every projector pixel is as bright on a white board as their mean (its light is divided by its own flux
  there, times the mean), and the sensor sees it everywhere as in the mean over the sensor (that in matt scenes only).
- *diffraction*, *black level*, *speckle*: their neutral values (:data:`mitsim.bench.effects.EFFECTS`).
- *keystone*: light lies where its projector pixel would, if the window filled its bounding box evenly.
- *depth*: light lies where its ray from the projector meets the aligned plane.
- *occlusion*: pixels that an edge hides from part of the sensor are as bright everywhere as in the mean over it.
- *detail*: the light of a projector pixel is even over the pixel; with depth or defocus on, over all points of it that
  send any (where the plan has several cells a pixel; one cell holds no detail).
- *interreflection*, *mirrors*, *ambient*: light over several surfaces, over mirrors, of lamps is none.
- *gloss*: every point of the sensor sees what it sees in the mean over the sensor, in scenes with glossy surfaces (the
  falloff over the sensor, below 1e-3 of the frames, goes with it). The truth shows that mean, so gloss over the scene
  is no error.
- *defocus*: a pinhole for the projector's lens, and sharp pixels.
- *render noise*: each projector pixel has the flux that the truth states, without the sampling error of the light: no
  effect of nature, but what the simulation adds at its accuracy.

The truth is the same for all. Not taken out: what lies in the idealised model as well (response of pixels, thickness of
the mask), and glare; it and light of sharp lobes are not moved, and indirect light stays where it is seen.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from types import MappingProxyType

import numpy as np
from scipy import sparse

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import names
from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.seeds import integer
from mitsim.devices.patterns import Lighting
from mitsim.light.light import SampledLight, traced_again
from mitsim.light.passes import FOLLOWED, PASSES, LightEstimate
from mitsim.light.settings import Settings
from mitsim.light.simulation import Simulation, TracedPass, expected_of
from mitsim.light.truth import Truth
from mitsim.optics.frames import ClassFrames, ExpectedFrames
from mitsim.scene.window import straightening
from mitsim.transport.integrator import ANY, FollowingTracer
from mitsim.transport.plugins.base import rows_columns, turn_and_origin
from mitsim.transport.projector import CanvasMap
from mitsim.transport.records import DIRECT, DeviceAccumulator, DeviceSums, PathSamples

FALLOFF, DIFFRACTION, KEYSTONE, DEPTH, OCCLUSION, DETAIL, INTERREFLECTION, MIRRORS = (
    "falloff", "diffraction", "keystone", "depth", "occlusion", "detail", "interreflection", "mirrors",
)  # fmt: skip
GLOSS, AMBIENT, BLACK_LEVEL, DEFOCUS, SPECKLE, RENDER_NOISE = (
    "gloss", "ambient", "black level", "defocus", "speckle", "render noise",
)  # fmt: skip
REGISTERED = MappingProxyType(
    {
        DIFFRACTION: frozenset({"diffraction"}),
        INTERREFLECTION: frozenset({"interreflection"}),
        MIRRORS: frozenset({"mirrors"}),
        AMBIENT: frozenset({"ambient"}),
        BLACK_LEVEL: frozenset({"black-level"}),
        DEFOCUS: frozenset({"aperture", "blur"}),
        SPECKLE: frozenset({"speckle"}),
    }
)
"""Effects of :data:`mitsim.bench.effects.EFFECTS` that a name stands for."""
_MOVED = frozenset({KEYSTONE, DEPTH, DETAIL, DEFOCUS})
"""Effects on where light lies, for which it is accumulated anew."""
_FURTHER = frozenset({"interreflection", "mirrors", "ambient"})
_WHOLE = "pixels that are lit all over"
"""Beside :data:`DETAIL`, where nothing moves or hides a pixel's points."""
_POINTS = 2
"""Points a side of a cell that stand for even light, none on an edge; a keystone leaves 1e-3 of cells uneven."""
_SIMULATIONS = 4
"""Kept, as shadows seen from many anchors take seconds to prepare, but up to half a GB each (cookie_bag)."""
_IN_PLACE = 1e-3
"""Projector pixels that light may lie beside its place on the aligned plane and count as on it: float32 leaves 1e-4."""


class Ablation:
    """A light that any of its effects can be taken out of; what was traced anew for it is kept.

    Parameters
    ----------
    light
        by projector pixel, with its samples.
    exact, board
        (n^2,) direct light of each projector pixel on the sensor as the truth tells it, and over a white board
        [W m^-2].
    purpose
        of the light, which names its random streams.

    Attributes
    ----------
    effects
        names of those that the light has.
    """

    def __init__(self, light: SampledLight, exact: FloatArray, board: FloatArray, purpose: str = "scene") -> None:
        self.light, self._exact, self._purpose = light, exact, purpose
        self._even = np.divide(board.mean(), board, out=np.ones_like(board), where=board > 0)
        self._kept: dict[tuple[bool, frozenset[str]], SampledLight] = {}
        self._simulated = lru_cache(maxsize=_SIMULATIONS)(lambda settings: Simulation(light.bench, settings))
        self.effects = tuple(name for name, present in _present(light).items() if present)

    @classmethod
    def of(cls, light: SampledLight) -> Ablation:
        """That of a scene's ``light``, with its own truth."""
        truth = light.apparent
        return cls(light, truth.reflectance.ravel() * truth.board_flux, truth.board_flux)

    def without(self, off: frozenset[str]) -> SampledLight:
        """The light without the effects ``off``; one that it does not have makes no difference."""
        off &= frozenset(self.effects)
        if not off:
            return self.light
        bench, moved = self.light.bench, off & _MOVED
        # Light over mirrors lies among direct light, and only tracing tells one from the other.
        direct = self._trace(direct=True, off=moved) if moved or MIRRORS in self.effects else self.light
        share = self.light.simulation.physics.projector.share  # the truth has no glare
        flux = share * self._exact if RENDER_NOISE in off else self.light.flux
        by_pixel = np.divide(flux, direct.flux, out=np.ones_like(flux), where=direct.flux > 0)
        groups = tuple(_scale(group, np.append(by_pixel * self._brightness(off), 0.0)) for group in direct.groups)
        if GLOSS in off:
            sharp = (_even_lobes(group["sharp"], direct.simulation) for group in groups)
            groups = tuple(group.with_light({"sharp": own}) for group, own in zip(groups, sharp, strict=True))
        simulation = self._simulated(_form_settings(direct.simulation.settings, off, bench.loaded.glossy))
        own = {field.name: getattr(self.light, field.name) for field in fields(SampledLight)}
        own |= {"groups": groups, "simulation": simulation}
        return AblatedLight(**own, whole=self.light, rest=self._rest(off))

    def _rest(self, off: frozenset[str]) -> SampledLight | None:
        """All but direct light; None where there is none."""
        light, settings = self.light, self.light.simulation.settings
        effects = settings.effects - frozenset[str]().union(*(REGISTERED.get(name, frozenset()) for name in off))
        if not effects & _FURTHER:
            return None
        brightness = np.append(self._brightness(off), 1.0)
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

    def _brightness(self, off: frozenset[str]) -> FloatArray:
        return self._even if FALLOFF in off else np.ones_like(self._even)

    def _trace(self, direct: bool, off: frozenset[str]) -> SampledLight:
        if (direct, off) not in self._kept:
            settings, bench = self.light.simulation.settings, self.light.bench
            own = off
            if DETAIL in off and off >= {DEPTH, DEFOCUS} & frozenset(self.effects):
                own |= {_WHOLE}
            absent = frozenset[str]().union(*(REGISTERED.get(name, frozenset()) for name in off))
            if direct:
                absent |= _FURTHER
                settings = replace(settings, followed_anchors=1)
            if DEPTH in off:
                settings = replace(settings, depth=bench.geometry.scene_distance, layers=())
            settings = replace(settings, effects=settings.effects - absent)
            self._kept[direct, off] = traced_again(
                self.light, _AblationSimulation(bench, settings, direct, own), self._purpose
            )
        return self._kept[direct, off]


@dataclass(frozen=True, eq=False)
class AblatedLight(SampledLight):
    """Direct light without some effects, and the ``rest`` of the light ``whole`` without them."""

    whole: SampledLight | None = None
    rest: SampledLight | None = None

    def frames(self, lighting: Lighting, seed: int, leaking: bool = True) -> ExpectedFrames:
        """As :meth:`Light.frames`, which has the parameters ``lighting``, ``seed`` and ``leaking``.

        Parameters
        ----------
        lighting, seed, leaking
            as there.
        """
        parts = [(each.simulation, each.groups) for each in (self, self.rest) if each is not None]
        return expected_of(parts, self.rows_of(lighting), lighting, seed, leaking)

    @cached_property
    def apparent(self) -> Truth:
        """That of the whole."""
        assert self.whole is not None
        return self.whole.apparent


class _AblationSimulation(Simulation):
    """Direct light with its glare, or all other, accumulated where it would be seen without the effects ``off``."""

    def __init__(self, bench: Apparatus, settings: Settings, direct: bool, off: frozenset[str]) -> None:
        super().__init__(bench, settings)
        self._only_direct, self._off, self._place = direct, off, _Place(bench)

    @cached_property
    def passes(self) -> Mapping[str, TracedPass]:
        return {
            name: each for name, each in super().passes.items() if (each.row.effects >= FOLLOWED) != self._only_direct
        }

    def accumulator(self, name: str, labels: Labels, lines: int) -> DeviceAccumulator | None:
        # What is added up on the device lies where it was traced.
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
            even = _even(found, self.bench.n**2) if DETAIL in self._off else found
            seen = self._place.move(even, self._off)
        return replace(super().accumulate(name, seen, labels, samples), flux=self.flux(found, samples))


class _Place:
    """Where light that a projector's pixel sends to one depth would be seen at another, or without its keystone."""

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
        """``path_samples`` without depth and keystone, where these are ``off``."""
        if not off & {DEPTH, KEYSTONE}:
            return path_samples
        row, column, inverse = path_samples.row, path_samples.column, path_samples.inverse_depth
        on_plane = self._on_plane(row, inverse, self._row), self._on_plane(column, inverse, self._column)
        straight = _project(self._straight, *on_plane) if KEYSTONE in off else on_plane
        if DEPTH in off:
            return replace(
                path_samples, row=straight[0], column=straight[1], inverse_depth=np.full_like(row, self._plane)
            )
        row, column = row + straight[0] - on_plane[0], column + straight[1] - on_plane[1]
        return replace(path_samples, row=row, column=column)

    def whole(self, path_samples: PathSamples, side: int, straight: bool) -> PathSamples:
        """The light of each projector pixel from even points of it on the plane.

        Parameters
        ----------
        path_samples, side
            the light, and how many points a side stand for a pixel.
        straight
            whether without the keystone.
        """
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
        """(2, m) tan-angles by which ``path_samples`` are seen beside their places on the plane, rows and columns."""
        inverse, row, column = path_samples.inverse_depth, path_samples.row, path_samples.column
        on_plane = self._on_plane(row, inverse, self._row), self._on_plane(column, inverse, self._column)
        return np.stack([row - on_plane[0], column - on_plane[1]])

    def _on_plane(self, tangent: FloatArray, inverse: FloatArray, origin: float) -> FloatArray:
        """A ray from (o, o_z) with slope s is seen at tangent s (1 - o_z / z) + o / z at depth z."""
        slope = (tangent - origin * inverse) / (1 - self._z * inverse)
        return np.asarray(slope * (1 - self._z * self._plane) + origin * self._plane)


def _project(homography: FloatArray, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points ``row``, ``column`` (m,) under a ``homography`` (3, 3)."""
    first, second, scale = homography @ np.stack([row, column, np.ones_like(row)])
    return first / scale, second / scale


def _present(light: SampledLight) -> dict[str, bool]:
    """Which effects a light has."""
    bench, settings, physics = light.bench, light.simulation.settings, light.simulation.physics
    return {
        FALLOFF: True,
        DIFFRACTION: physics.spectrum is not None,
        KEYSTONE: bench.loaded.pixels.keystone > 0,
        DEPTH: _off_plane(light),
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


def _off_plane(light: SampledLight) -> bool:
    """Whether one ray of each projector pixel tells of light that is seen beside its place on the aligned plane."""
    bench, simulation = light.bench, light.simulation
    path_samples = simulation.direct.trace(integer(light.seed, "transport", "place"), 0, 1)
    size = [(last - first) / bench.n for first, last in bench.windows]
    aside = np.abs(_Place(bench).parallax(path_samples)) / np.array(size)[:, None]
    return bool(aside.size and aside.max() > _IN_PLACE)


def _form_settings(settings: Settings, off: frozenset[str], glossy: bool) -> Settings:
    """What frames of direct light are formed with."""
    absent = _FURTHER.union(*(REGISTERED.get(name, frozenset()) for name in off))
    anchors = 1 if (GLOSS if glossy else FALLOFF) in off else settings.anchors
    occluded = () if OCCLUSION in off else settings.occluded
    effects = settings.effects - absent
    return replace(settings, effects=effects, anchors=anchors, occluded=occluded, followed_anchors=1)


def _even(path_samples: PathSamples, pixels: int) -> PathSamples:
    """``path_samples`` of so many projector ``pixels``, each of which has one value."""
    count, total = (np.bincount(path_samples.pixel, weights, pixels) for weights in (None, path_samples.value))
    return replace(path_samples, value=(total / np.maximum(count, 1))[path_samples.pixel])


def _even_lobes(sharp: sparse.csr_array, simulation: Simulation) -> sparse.csr_array:
    """``sharp`` light that every anchor of a ``simulation`` sees as in the mean over the sensor."""
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
    """``rows`` times ``by``, one number each; rows of zero hold nothing."""
    scaled = sparse.csr_array(sparse.diags_array(by) @ rows)
    scaled.eliminate_zeros()
    return scaled


# -------- Effects that need no light to be traced anew, and settings without one of them


def reform(light: SampledLight, absent: frozenset[str]) -> SampledLight:
    """The same ``light``, traced no further, whose frames are formed with the effects ``absent`` at their neutral
    values: of such as need no light to be traced anew."""
    simulation = light.simulation
    settings = replace(simulation.settings, effects=simulation.settings.effects - absent)
    return replace(light, simulation=Simulation(simulation.bench, settings))


def ablations(settings: Settings, present: frozenset[str]) -> Iterator[tuple[str, Settings]]:
    """The name of each effect of those ``present`` that shows in expected frames, and ``settings`` without it; numbers
    fall to one."""
    for name in sorted(present & names(lambda effect: effect.in_frames)):
        yield name, replace(settings, effects=settings.effects - {name})
    if settings.anchors > 1:
        yield "anchors", replace(settings, anchors=1, occluded_anchors=1)
    if settings.followed_anchors > 1:
        yield "followed-anchors", replace(settings, followed_anchors=1)
    if len(settings.depths) > 1:
        yield "layers", replace(settings, layers=())
    if settings.subdivision > 1:
        yield "cells", replace(settings, subdivision=1)


# -------- A bench, settings and orders of light in

MOST = ANY
"""The order of light over any number of surfaces."""


class OfOrders(Simulation):
    """Followed light of the orders ``fewest`` to ``most`` alone (:class:`mitsim.transport.integrator.FollowingTracer`):
    no direct light, no specular chains."""

    def __init__(self, bench: Apparatus, settings: Settings, fewest: int, most: int) -> None:
        """What is followed.

        Parameters
        ----------
        bench, settings
            as for :class:`Simulation`.
        fewest, most
            orders of the light that is kept.
        """
        super().__init__(bench, settings)
        self._orders = fewest, most

    @cached_property
    def passes(self) -> Mapping[str, TracedPass]:
        """Those that follow light, by name."""
        found = {}
        for name, each in super().passes.items():
            if isinstance(each.tracer, FollowingTracer):
                found[name] = replace(each, tracer=each.tracer.of_orders(*self._orders))
        return found

    def specular_frames(self, labels: Labels) -> ClassFrames | None:
        """None, whatever the ``labels``: specular chains are not followed by any of these tracers."""
        return None

"""Effects of causes on light and on images: light without some of its effects, and expected errors of changed frames.

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

**Images of changed frames** (:class:`LinearImage`). With lambda fixed the solver is linear, so that the expected
squared error follows from the factors. With B_L = [Phi_L diag(p_i)]_i = U_L S_L V_L^T (row blocks U_Li of U_L), and the
same on the right, the image of frames Y_ij is

    X^ = V_L [F o W] V_R^T,  W = sum_ij U_Li^T Y_ij U_Rj,  F = s_L s_R^T / (s_L^2 s_R^2^T + lambda).

Changes of the frames affect W as follows (likewise on the right):

* frames L (P_ij o X) R^T of other factors: W = G(L) X G(R)^T with ``G(L) = sum_i U_Li^T L diag(p_i)``;
* gains g_ij of frames: W = sum_ij g_ij G_i X G_j^T, with the terms G_i of G;
* gains of rows, 1 + u_ij d with u_ij of variance 1: the square of each frame's term with diag(d) L in place of L; a
  ripple of the light has two such d, cosine and sine;
* a frame E added to all: W = (sum_i U_Li)^T E (sum_j U_Rj);
* responses that differ by R from the factors: W = sum_ij U_Li^T (R o Y_ij) U_Rj;
* noise of variance v in each datum: variance v of W, as U_L and U_R are orthonormal; in a frame that is subtracted from
  all others v |sum_i U_Li|^2 |sum_j U_Rj|^2, column by column;
* noise of variance nu^2 in each number of the left factor: that of G is nu^2 |sum_i p_i(x) U_Li|^2;
* an error of variance e^2 in each scene pixel's light, equal in all frames: e^2 s_L^2 s_R^2^T;
* columns x of the left factor times 1 + eta_x of variance eta^2: eta^2 sum_x (s_L V_L(x))^2 (X V_R S_R)(x)^2.

A pattern of +-1 is the difference of two frames (1 +- P) / 2: constant additions cancel, noise and flicker add up, and
gains g+ and g- give (g+ + g-) / 2 of the pattern and (g+ - g-) / 2 of uniform light. The expected squared error is that
of the mean plus, as V is orthonormal, the sum of F^2 times these variances.

With b the error that is not noise and C the covariance of normal noise e, |b + e|^2 has the variance 2 tr(C^2) + 4 b^T
C b. In the coefficients above, e = F o dW:

* independent noise of variance v_kl in W: tr(C^2) = sum F_kl^4 v_kl^2;
* noise of variance nu_kx^2 of the left factor's G: row k of W sees scene pixel x through a_x = (X V_R S_R)(x), C_k =
  F_k o (sum_x nu_kx^2 a_x a_x^T) o F_k, hence tr(C_k^2) = nu_k^2^T (K_k o K_k) nu_k^2 with K_k(x, y) = sum_l F_kl^2
  a_xl a_yl; rows are assumed independent, as they are where patterns share no pixels;
* columns of the left factor off by eta_x: tr(C^2) = eta^4 sum_xy (sum_k s_k^2 V_L(x, k) V_L(y, k) K_k(x, y))^2.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from types import MappingProxyType

import numpy as np
from scipy import sparse

from mitsim.bench.apparatus import Apparatus
from mitsim.core.arrays import FloatArray, Labels, integer
from mitsim.devices.patterns import Lighting, PatternFamily
from mitsim.light.light import SampledLight, Truth, traced_again
from mitsim.light.passes import FOLLOWED, PASSES, LightEstimate, Simulation, TracedPass, expected_of
from mitsim.light.settings import Settings
from mitsim.optics.frames import ExpectedFrames
from mitsim.scene.load import straightening
from mitsim.transport.connect import CanvasMap
from mitsim.transport.plugins.base import rows_columns, turn_and_origin
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
        absent = _FURTHER.union(*(REGISTERED.get(name, frozenset()) for name in off))
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
        effects = settings.effects - frozenset[str]().union(*(REGISTERED.get(name, frozenset()) for name in off))
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
            absent = frozenset[str]().union(*(REGISTERED.get(name, frozenset()) for name in off))
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
            even = _even(found, self.bench.n**2) if DETAIL in self._off else found
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
        """Return the light of each projector pixel from ``side`` x ``side`` even points; ``straight`` omits the
        keystone.
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
        """Return the tan-angles (2, m) between ``path_samples`` and their places on the plane."""
        inverse, row, column = path_samples.inverse_depth, path_samples.row, path_samples.column
        on_plane = self._on_plane(row, inverse, self._row), self._on_plane(column, inverse, self._column)
        return np.stack([row - on_plane[0], column - on_plane[1]])

    def _on_plane(self, tangent: FloatArray, inverse: FloatArray, origin: float) -> FloatArray:
        # A ray from (o, o_z) with slope s is seen at tangent s (1 - o_z / z) + o / z at depth z.
        slope = (tangent - origin * inverse) / (1 - self._z * inverse)
        return np.asarray(slope * (1 - self._z * self._plane) + origin * self._plane)


def _project(homography: FloatArray, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
    first, second, scale = homography @ np.stack([row, column, np.ones_like(row)])
    return first / scale, second / scale


def _even(path_samples: PathSamples, pixels: int) -> PathSamples:
    count, total = (np.bincount(path_samples.pixel, weights, pixels) for weights in (None, path_samples.value))
    return replace(path_samples, value=(total / np.maximum(count, 1))[path_samples.pixel])


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


# -------- The image that is expected of changed frames

Terms = Sequence[tuple[FloatArray, FloatArray]]
Gains = Sequence[float | FloatArray]
"""Root mean squares of independent gains: of a whole frame, or (m,) of its rows."""


@dataclass(frozen=True, eq=False)
class Axis:
    """One side of the camera: (K, m, r) blocks of U, (r,) singular values, (n, r) V and (n, K) patterns."""

    slabs: FloatArray
    singular: FloatArray
    basis: FloatArray
    patterns: FloatArray

    @classmethod
    def of(cls, factor: FloatArray, patterns: FloatArray) -> Axis:
        stacked = np.concatenate([factor * column for column in patterns.T])
        left, singular, right = np.linalg.svd(stacked, full_matrices=False)
        return cls(left.reshape(patterns.shape[1], *factor.shape[:1], -1), singular, right.T, patterns)

    @cached_property
    def total(self) -> FloatArray:
        return np.asarray(self.slabs.sum(axis=0))

    def terms_of(self, factor: FloatArray) -> FloatArray:
        """Return the terms of G (K, r, n) of a ``factor``."""
        return np.asarray(np.einsum("kmr,mn,nk->krn", self.slabs, factor, self.patterns, optimize=True))

    def seen_evenly(self, factor: FloatArray) -> FloatArray:
        """Return the terms of G (K, r, n) of a ``factor`` in uniform light."""
        return np.asarray(np.einsum("kmr,mn->krn", self.slabs, factor, optimize=True))

    @cached_property
    def noise(self) -> FloatArray:
        """Return the (r, n) variance of G for unit variance of each number of the factor."""
        mixed = np.einsum("nk,kmr->nmr", self.patterns, self.slabs, optimize=True)
        return np.asarray(np.square(mixed).sum(axis=1).T)


@dataclass(frozen=True, eq=False)
class Expected:
    """Mean (n, n') of an image, and the sum of the variances of all its numbers."""

    image: FloatArray
    variance: float = 0.0

    def psnr_db(self, truth: FloatArray) -> float:
        square = (float(np.square(self.image - truth).sum()) + self.variance) / truth.size
        return float("inf") if square == 0 else float(-10 * np.log10(square))


@dataclass(frozen=True, eq=False)
class Changed:
    """Differences of a scene's frames from those of the solver's factors; by default none.

    Attributes
    ----------
    gain, gain_apart
        (K, K') mean gains of the frames; for a difference of two frames, their mean gain and half their difference.
    flicker, added_flicker, added_common
        rms of independent gains of each frame, of ``added`` in each frame, and in all: a number each, or (m,) by row.
    response
        (m, m') relative error of each pixel's response in the factors.
    leak
        part of the light of all pixels that is in every frame.
    added, added_gain
        (m, m') frame that is added to all frames, and its mean gain.
    """

    terms: Terms = ()
    gain: FloatArray | float = 1.0
    gain_apart: FloatArray | float = 0.0
    flicker: Gains = ()
    response: FloatArray | None = None
    leak: float = 0.0
    added: FloatArray | None = None
    added_gain: float = 1.0
    added_flicker: Gains = ()
    added_common: Gains = ()


@dataclass(frozen=True)
class Noise:
    """Variances of independent noise.

    Attributes
    ----------
    datum, ambient
        of each datum of every single frame, and of a frame that is subtracted from all others.
    left, right, left_light, right_light
        of each number of the factors, and of the gain of each column.
    light
        of each scene pixel's light, relative to a white board's, in all frames alike.
    """

    datum: float = 0.0
    ambient: float = 0.0
    left: float = 0.0
    right: float = 0.0
    light: float = 0.0
    left_light: float = 0.0
    right_light: float = 0.0

    def __add__(self, other: Noise) -> Noise:
        return Noise(*(getattr(self, each.name) + getattr(other, each.name) for each in fields(self)))

    def __sub__(self, other: Noise) -> Noise:
        return Noise(*(getattr(self, each.name) - getattr(other, each.name) for each in fields(self)))


@dataclass(frozen=True, eq=False)
class LinearImage:
    """Solver with its lambda fixed: Phi_L (m, n), Phi_R (m', n'), and whether row and column means are removed."""

    left: FloatArray
    right: FloatArray
    family: PatternFamily
    lam: float
    centre: bool = False

    def expected_image(self, scene: FloatArray, changed: Changed | None = None, noise: Noise | None = None) -> Expected:
        changed, noise = changed or Changed(), noise or Noise()
        left, right = self.axes
        cameras = [(self.left, self.right), *changed.terms]  # U has no means where frames are to lose theirs
        weights = np.zeros_like(self.filter)
        gain, apart = (np.broadcast_to(each, self._count) for each in (changed.gain, changed.gain_apart))
        seen = [(left.terms_of(first), right.terms_of(second)) for first, second in cameras]
        for row, column in np.ndindex(gain.shape):
            weights += gain[row, column] * _together(seen, row, column, scene)
        even = [(left.seen_evenly(first), right.seen_evenly(second)) for first, second in cameras]
        lit = 1 + 2 * changed.leak
        if self.family.signed and apart.any():
            for row, column in np.ndindex(gain.shape):
                weights += apart[row, column] * lit * _together(even, row, column, scene)
        if changed.response is not None:
            weights += self._by_response(changed.response, cameras, scene, gain)
        if changed.leak and not self.family.signed:
            uniform = sum(first @ scene @ second.T for first, second in cameras)
            weights += changed.leak * left.total.T @ uniform @ right.total
        if changed.added is not None and not self.family.signed:
            weights += changed.added_gain * left.total.T @ changed.added @ right.total
        variance = sum(self._energy(np.square(term)) for term in self._by_gains(scene, changed))
        variance += self.variance(scene, noise)
        return Expected(left.basis @ (self.filter * weights) @ right.basis.T, variance)

    def _by_gains(self, scene: FloatArray, changed: Changed) -> Iterator[FloatArray]:
        left, right = self.axes
        cameras = [(self.left, self.right), *changed.terms]
        lit = 1 + 2 * changed.leak
        for rms in changed.flicker:
            varied = [(left.terms_of(_by_row(rms) * first), right.terms_of(second)) for first, second in cameras]
            evenly = [(left.seen_evenly(_by_row(rms) * first), right.seen_evenly(second)) for first, second in cameras]
            for row, column in np.ndindex(self._count):
                term = _together(varied, row, column, scene)
                if self.family.signed:  # the gains of two frames
                    uniform = lit * _together(evenly, row, column, scene)
                    yield (uniform + term) / 2
                    yield (uniform - term) / 2
                else:
                    yield term
        if changed.added is None:
            return
        for rms in changed.added_flicker:
            varying = _by_row(rms) * changed.added
            for row, column in np.ndindex(self._count):
                term = left.slabs[row].T @ varying @ right.slabs[column]
                yield from [term, -term] if self.family.signed else [term]
        if not self.family.signed:
            for rms in changed.added_common:
                yield left.total.T @ (_by_row(rms) * changed.added) @ right.total

    def _by_response(self, response: FloatArray, cameras: Terms, scene: FloatArray, gain: FloatArray) -> FloatArray:
        left, right = self.axes
        weights = np.zeros_like(self.filter)
        for row, column in np.ndindex(self._count):
            lit = np.outer(left.patterns[:, row], right.patterns[:, column]) * scene
            frame = sum(first @ lit @ second.T for first, second in cameras)
            weights += gain[row, column] * left.slabs[row].T @ (response * frame) @ right.slabs[column]
        return weights

    def variance(self, scene: FloatArray, noise: Noise) -> float:
        units = self.units(scene)
        return self._energy(sum((getattr(noise, name) * unit for name, unit in units.items()), np.zeros((1, 1))))

    def units(self, scene: FloatArray) -> dict[str, FloatArray]:
        """Return the variance (r, r') of the numbers of W by unit variance of each :class:`Noise`."""
        left, right = self.axes
        of_left, of_right = np.square(left.basis * left.singular).T, np.square(right.basis * right.singular)
        seen_right = np.square(scene @ (right.basis * right.singular))
        seen_left = np.square(scene.T @ (left.basis * left.singular)).T
        return {
            "datum": np.full(self.filter.shape, 2.0 if self.family.signed else 1.0),
            "ambient": np.outer(*(np.square(axis.total).sum(axis=0) for axis in (left, right))),
            "left": left.noise @ seen_right,
            "right": seen_left @ right.noise.T,
            "light": np.outer(np.square(left.singular), np.square(right.singular)),
            "left_light": of_left @ seen_right,
            "right_light": seen_left @ of_right,
        }

    @property
    def _count(self) -> tuple[int, int]:
        return len(self.axes[0].slabs), len(self.axes[1].slabs)

    def _energy(self, variance: FloatArray) -> float:
        return float((np.square(self.filter) * variance).sum())

    @cached_property
    def axes(self) -> tuple[Axis, Axis]:
        left = Axis.of(self._centre(self.left), self.family.left.astype(np.float64))
        right = Axis.of(self._centre(self.right), self.family.right.astype(np.float64))
        return left, right

    @cached_property
    def filter(self) -> FloatArray:
        sigma = np.outer(self.axes[0].singular, self.axes[1].singular)
        return np.asarray(sigma / (np.square(sigma) + self.lam))

    def _centre(self, matrix: FloatArray) -> FloatArray:
        return np.asarray(matrix - matrix.mean(axis=0)) if self.centre else matrix


def _by_row(rms: float | FloatArray) -> FloatArray:
    return np.reshape(np.asarray(rms, dtype=np.float64), (-1, 1))


def _together(seen: Terms, row: int, column: int, scene: FloatArray) -> FloatArray:
    """Return the part of W (r, r') of one frame from terms of G, (K, r, n) and (K', r', n')."""
    return np.asarray(sum(first[row] @ scene @ second[column].T for first, second in seen))


_KINDS = tuple(each.name for each in fields(Noise))


@dataclass(frozen=True, eq=False)
class Scatter:
    """Scatter of the summed squared error of a ``scene`` (n, n') about its mean; errors are (n, n')."""

    solver: LinearImage
    scene: FloatArray

    def deviation(self, noise: Noise, error: FloatArray) -> float:
        """Return the standard deviation of the squared error with ``noise`` and an ``error`` that is not noise."""
        return math.sqrt(self._variance(noise, error))

    def share(self, noise: Noise, among: Noise, error: FloatArray) -> float:
        """Return the standard deviation due to one source of ``noise`` ``among`` all."""
        return math.sqrt(max(self._variance(among, error) - self._variance(among - noise, error), 0.0))

    def common(self, noise: Noise, error: FloatArray) -> float:
        """Return the standard deviation of the cross term 2 b . e of ``noise`` and ``error``."""
        return math.sqrt(float(self._beside(error) @ _amounts(noise)))

    def _variance(self, noise: Noise, error: FloatArray) -> float:
        amounts = _amounts(noise)
        return float(amounts @ self._own @ amounts + self._beside(error) @ amounts)

    def _beside(self, error: FloatArray) -> FloatArray:
        """Return the (kinds,) variance of 2 b . e per unit variance."""
        (left, right), gain = self.solver.axes, self.solver.filter
        off = left.basis.T @ error @ right.basis
        found = 4 * self._energies @ np.square(off).ravel()
        for (side, axis, seen), weights in zip(self._sides, (gain * off, (gain * off).T), strict=True):
            beside = weights @ seen.T  # (r, n)
            found[_KINDS.index(side)] = 4 * float((axis.noise * np.square(beside)).sum())
            light = ((axis.basis * axis.singular).T * beside).sum(axis=0)
            found[_KINDS.index(f"{side}_light")] = 4 * float(np.square(light).sum())
        return np.asarray(found)

    @cached_property
    def _own(self) -> FloatArray:
        found, gain = 2 * self._energies @ self._energies.T, self.solver.filter
        for (side, axis, seen), weights in zip(self._sides, (gain, gain.T), strict=True):
            for name, square in zip((side, f"{side}_light"), _squares(axis, seen, weights), strict=True):
                found[_KINDS.index(name), _KINDS.index(name)] = 2 * square
        return np.asarray(found)

    @cached_property
    def _energies(self) -> FloatArray:
        """Return the (kinds, r r') variance of the image's coefficients per unit variance."""
        units = self.solver.units(self.scene)
        return np.stack([(np.square(self.solver.filter) * units[name]).ravel() for name in _KINDS])

    @property
    def _sides(self) -> tuple[tuple[str, Axis, FloatArray], tuple[str, Axis, FloatArray]]:
        left, right = self.solver.axes
        through_right = self.scene @ (right.basis * right.singular)
        return ("left", left, through_right), ("right", right, self.scene.T @ (left.basis * left.singular))


def _amounts(noise: Noise) -> FloatArray:
    return np.array([getattr(noise, name) for name in _KINDS])


def _squares(axis: Axis, seen: FloatArray, gain: FloatArray) -> tuple[float, float]:
    """Return tr(C^2) of unit noise in the numbers of a factor and in its columns' gains; ``seen`` (n, r') is a_x."""
    square, light = 0.0, axis.basis * axis.singular
    together = np.zeros((len(seen), len(seen)))
    for row, weights in enumerate(gain):
        passed, variance = seen * weights, axis.noise[row]
        kernel = passed @ passed.T
        square += float(variance @ np.square(kernel) @ variance)
        together += np.outer(light[:, row], light[:, row]) * kernel
    return square, float(np.square(together).sum())

"""Rays that follow perfect mirrors: from points of a pinhole projector's window to where they cross the sensor plane.

Rays are traced in Mitsuba's float32, which is good to about 1e-4 mm at the sensor: 1 % of a pixel, and as much error
in a masked frame. So each hit is polished in float64: the ray is met with the tangent plane of the surface that was
hit, the normal is moved along, and reflection or refraction is worked out again from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.transport.factored import Projector

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Chains = npt.NDArray[np.uint64]
Mask = npt.NDArray[np.bool_]
_WAVELENGTH_SETS = 8
_FAINTEST = 1e-5
_AGREEMENT = 1e-4
_OFFSET = 1e-4


def specular_bsdfs(scene: Any) -> list[Any]:
    """The scene's materials that reflect or refract into single directions."""
    kinds = (mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission)
    found: list[Any] = []
    for shape in scene.shapes():
        bsdf = shape.bsdf()
        if bsdf is not None and any(mi.has_flag(bsdf.flags(), kind) for kind in kinds) and bsdf not in found:
            found.append(bsdf)
    return found


def wavelength_sets() -> list[Any]:
    """Wavelengths [nm] at which spectra are taken: none but for spectral variants, there evenly over the range."""
    if not mi.is_spectral:
        return [None]
    size = len(dr.zeros(mi.UnpolarizedSpectrum))
    step = (mi.MI_CIE_MAX - mi.MI_CIE_MIN) / (_WAVELENGTH_SETS * size)
    even = mi.MI_CIE_MIN + step * (np.arange(_WAVELENGTH_SETS * size) + 0.5)
    return [type(dr.zeros(mi.Ray3f).wavelengths)(*even[i::_WAVELENGTH_SETS].tolist()) for i in range(_WAVELENGTH_SETS)]


class PinholeRays:
    """Rays of a stock ``projector``: from points of its window to directions, and the power between them.

    Attributes
    ----------
    origin
        (3,) pinhole in world coordinates [mm].
    area
        area of one pixel on the plane at unit distance [mm^2 at 1 mm].
    power
        (n * n, channels) irradiance on that plane that each pixel casts, by colour channel or wavelength [W m^-2].
    """

    def __init__(self, projector: Projector, wavelengths: list[Any]) -> None:
        """``wavelengths``: sets at which spectra are taken, from :func:`wavelength_sets`."""
        self._projector = projector
        emitter, n = projector.emitter, projector.n
        matrix = np.array(mi.traverse(emitter)["to_world"].matrix, dtype=np.float64).reshape(4, 4, -1)[..., 0]
        self.origin, self._turn = matrix[:3, 3], matrix[:3, :3]
        # Points on a plane whose uv the emitter tells; uv is an affine map of local tan-angles.
        probe = np.linspace(-0.02, 0.02, 24)
        for _ in range(2):  # first on the axis, to learn the field of view, then over all of it
            x, y = (part.ravel() for part in np.meshgrid(probe, probe))
            uv = self._uv(np.stack([x, y, np.ones(x.size)], axis=1))
            design = np.stack([uv[:, 0], np.ones(x.size)], axis=1)
            self._x = np.linalg.lstsq(design, x, rcond=None)[0]
            self._y = np.linalg.lstsq(np.stack([uv[:, 1], np.ones(x.size)], axis=1), y, rcond=None)[0]
            probe = np.linspace(-0.49, 0.49, 24) * min(abs(self._x[0]), abs(self._y[0]))
        rows, columns = projector.canvas
        self.area = abs(self._x[0] * self._y[0]) / (rows * columns)
        centre = np.stack(np.divmod(np.arange(n * n), n), axis=1) + 0.5
        self.power = np.concatenate([self._irradiance(centre, chosen) for chosen in wavelengths], axis=1)

    def directions(self, points: FloatArray) -> FloatArray:
        """(k, 3) world directions of unit length through window points (row, column) (k, 2) in projector pixels."""
        world = self._local(points) @ self._turn.T
        return np.asarray(world / np.linalg.norm(world, axis=1, keepdims=True))

    def _local(self, points: FloatArray) -> FloatArray:
        projector = self._projector
        u = (projector.first_column + points[:, 1]) / projector.canvas[1]
        v = (projector.first_row + points[:, 0]) / projector.canvas[0]
        x, y = self._x[0] * u + self._x[1], self._y[0] * v + self._y[1]
        return np.stack([x, y, np.ones(len(x))], axis=1)

    def _sample(self, local: FloatArray, wavelengths: Any) -> tuple[Any, Any, FloatArray]:
        """The emitter's direction sample at points in ``local`` directions, with the cosine to the axis."""
        distance = self._depth()
        forward = self._turn[:, 2] / np.linalg.norm(self._turn[:, 2])
        world = local @ self._turn.T
        world *= distance / (world @ forward)[:, None]
        interaction = dr.zeros(mi.SurfaceInteraction3f, len(local))
        interaction.p = mi.Point3f((self.origin + world).T.astype(np.float32))
        if wavelengths is not None:
            interaction.wavelengths = wavelengths
        sample, emitted = self._projector.emitter.sample_direction(interaction, mi.Point2f(0.5), True)
        return sample, emitted, distance / np.linalg.norm(world, axis=1)

    def _depth(self) -> float:
        """Depth at which the emitter is asked [mm]: far enough that float32 coordinates do not matter."""
        return 1000 * max(1.0, float(np.abs(self.origin).max()) / 100)

    def _uv(self, local: FloatArray) -> FloatArray:
        uv = self._sample(local, None)[0].uv
        return np.stack([np.array(uv.x, dtype=np.float64), np.array(uv.y, dtype=np.float64)], axis=1)

    def _irradiance(self, points: FloatArray, wavelengths: Any) -> FloatArray:
        """(k, channels) irradiance on the plane at unit distance that window points (k, 2) cast [W m^-2]."""
        local = self._local(points)
        _, emitted, cosine = self._sample(local, wavelengths)
        depth = self._depth()
        return _channels(mi.unpolarized_spectrum(emitted), len(points)) * (cosine * depth**2)[:, None]


@dataclass(frozen=True, eq=False)
class Crossings:
    """Rays that crossed the sensor plane from the front after at least one mirror; one ray may arrive several times.

    Attributes
    ----------
    ray
        (k,) number of the ray that was sent.
    chain
        (k,) a number for the sequence of surfaces it met, and whether each reflected or transmitted it.
    sensor, tangent
        (k, 2) where it crosses [mm] and its tan-angles from there, (row, column) in index coordinates.
    throughput
        (k,) part of the light left.
    """

    ray: IntArray
    chain: Chains
    sensor: FloatArray
    tangent: FloatArray
    throughput: FloatArray


@dataclass(frozen=True, eq=False)
class _Rays:
    """Rays under way. ``start`` lies on the ray a little beyond ``origin``, clear of the surface that it leaves."""

    index: IntArray
    origin: FloatArray
    direction: FloatArray
    start: FloatArray
    chain: Chains
    spectrum: FloatArray

    def __getitem__(self, chosen: Any) -> _Rays:
        parts = (self.index, self.origin, self.direction, self.start, self.chain, self.spectrum)
        return _Rays(*(part[chosen] for part in parts))


class MirrorTracer:
    """Follows rays of a projector over delta reflections, refractions and straight transmissions to the sensor plane.

    At a surface that both reflects and transmits, a ray goes both ways. A ray that meets anything that scatters ends
    there: that light is the camera-side estimators'.
    """

    def __init__(self, scene: Any, camera: Any, projector: Projector, max_depth: int) -> None:
        self._scene, self._max_depth = scene, max_depth
        self._wavelengths = wavelength_sets()
        self.rays = PinholeRays(projector, self._wavelengths)
        mean = self.rays.power.mean(axis=0)
        self._colour = mean / mean.sum() if mean.sum() > 0 else np.full(len(mean), 1 / len(mean))
        self._lobes = [(bsdf, context) for bsdf in specular_bsdfs(scene) for context in _contexts(bsdf)]
        matrix = np.array(camera.world_transform().matrix, dtype=np.float64).reshape(4, 4, -1)[..., 0]
        self._camera_turn, self._camera_place = matrix[:3, :3], matrix[:3, 3]

    def follow(self, points: FloatArray) -> Crossings:
        """Send rays through window points (row, column) (k, 2), in projector pixels."""
        count = len(points)
        origin = np.broadcast_to(self.rays.origin, (count, 3))
        rays = _Rays(
            np.arange(count),
            origin,
            self.rays.directions(points),
            origin,
            np.zeros(count, dtype=np.uint64),
            np.ones((count, len(self._colour))),
        )
        found = [Crossings(np.zeros(0, np.int64), rays.chain[:0], np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))]
        for depth in range(self._max_depth + 1):
            if not len(rays.index):
                break
            si = self._intersect(rays)
            distance = np.where(_host(si.is_valid(), len(rays.index)), _host(si.t, len(rays.index)), np.inf)
            distance = distance + np.linalg.norm(rays.start - rays.origin, axis=1)
            crossing, arrived = self._cross(rays, distance)
            if depth:
                found.append(crossing)
            rays = self._bounce(rays, si, ~arrived & np.isfinite(distance))
        parts = zip(*((c.ray, c.chain, c.sensor, c.tangent, c.throughput) for c in found), strict=True)
        return Crossings(*(np.concatenate(part) for part in parts))

    def _intersect(self, rays: _Rays) -> Any:
        ray = mi.Ray3f(mi.Point3f(rays.start.T.astype(np.float32)), mi.Vector3f(rays.direction.T.astype(np.float32)))
        flags = mi.RayFlags.All | mi.RayFlags.dNSdUV
        si = self._scene.ray_intersect(ray, flags, True)
        dr.eval(si)
        return si

    def _cross(self, rays: _Rays, distance: FloatArray) -> tuple[Crossings, Mask]:
        """Rays that cross the sensor plane from the front before they meet anything."""
        origin = (rays.origin - self._camera_place) @ self._camera_turn
        direction = rays.direction @ self._camera_turn
        ahead = (origin[:, 2] > 0) & (direction[:, 2] < 0)
        reach = np.full(len(ahead), np.inf)
        np.divide(-origin[:, 2], direction[:, 2], out=reach, where=ahead)
        arrived = ahead & (reach < distance)
        o, d, r = origin[arrived], direction[arrived], reach[arrived, None]
        crossing = Crossings(
            rays.index[arrived],
            rays.chain[arrived],
            -(o + d * r)[:, 1::-1],
            -(d[:, :2] / d[:, 2:])[:, ::-1],
            rays.spectrum[arrived] @ self._colour,
        )
        return crossing, arrived

    def _bounce(self, rays: _Rays, si: Any, active: Mask) -> _Rays:
        """The rays that go on, polished; see the module."""
        count = len(active)
        point, geometric, normal = _polished(rays, si)
        shapes = _host(dr.reinterpret_array(mi.UInt32, si.shape), count).astype(np.uint64)
        onward: list[_Rays] = []
        for bsdf, context in self._lobes:
            here = mi.Bool(active) & (si.bsdf() == mi.BSDFPtr(bsdf))
            if not dr.any(here):
                continue
            sample, weight = self._sampled(bsdf, context, si, here)
            kind, eta = _host(sample.sampled_type, count), _host(sample.eta, count)
            single = (kind & int(mi.BSDFFlags.Delta)) != 0
            spectrum = rays.spectrum * np.nan_to_num(weight)
            chosen = np.flatnonzero(_host(here, count) & single & ((spectrum @ self._colour) > _FAINTEST))
            traced = _vectors(si.to_world(sample.wo), count)[chosen]
            direction = _redirected(rays.direction[chosen], normal[chosen], kind[chosen], eta[chosen], traced)
            slope = np.abs((direction * geometric[chosen]).sum(axis=1))
            clear = _OFFSET * (1 + np.abs(point[chosen]).max(axis=1, initial=0)) / np.maximum(slope, 0.02)
            reflected = (kind[chosen] & int(mi.BSDFFlags.DeltaReflection)) != 0
            code = shapes[chosen] * np.uint64(2) + reflected.astype(np.uint64) + np.uint64(1)
            chain = rays.chain[chosen] * np.uint64(0x9E3779B97F4A7C15) + code
            start = point[chosen] + direction * clear[:, None]
            onward.append(_Rays(rays.index[chosen], point[chosen], direction, start, chain, spectrum[chosen]))
        if not onward:
            return rays[np.zeros(0, dtype=np.int64)]
        names = ("index", "origin", "direction", "start", "chain", "spectrum")
        return _Rays(*(np.concatenate([getattr(part, name) for part in onward]) for name in names))

    def _sampled(self, bsdf: Any, context: Any, si: Any, active: Any) -> tuple[Any, FloatArray]:
        """Direction sample, and weights (k, channels) over all wavelength sets."""
        weights = []
        for wavelengths in self._wavelengths:
            if wavelengths is not None:
                si.wavelengths = wavelengths
            sample, weight = bsdf.sample(context, si, 0.5, mi.Point2f(0.5), active)
            weights.append(_channels(mi.unpolarized_spectrum(weight), dr.width(si.t)))
        return sample, np.concatenate(weights, axis=1)


def _contexts(bsdf: Any) -> list[Any]:
    """One context for each way on, so that sampling has nothing to choose by chance.

    Kinds are chosen by type, because components of a ``twosided`` are not numbered alike on both sides; the parts of a
    blend can be told by component only.
    """
    delta = int(mi.BSDFFlags.Delta)
    contexts = []
    if "BlendBSDF" in str(bsdf):
        for component in range(bsdf.component_count()):
            if bsdf.flags(component) & delta:
                contexts.append(mi.BSDFContext(mi.TransportMode.Importance))
                contexts[-1].component = component
        return contexts
    reflection = int(mi.BSDFFlags.DeltaReflection)
    for kinds in (reflection, delta & ~reflection):
        if bsdf.flags() & kinds:
            contexts.append(mi.BSDFContext(mi.TransportMode.Importance))
            contexts[-1].type_mask = kinds
    return contexts


def _polished(rays: _Rays, si: Any) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Hit point, geometric and shading normal (k, 3), the ray met in float64 with the surface's tangent plane."""
    count = len(rays.index)
    hit, geometric, normal = (_vectors(v, count) for v in (si.p, si.n, si.sh_frame.n))
    with np.errstate(all="ignore"):
        geometric /= np.linalg.norm(geometric, axis=1, keepdims=True)
        along = ((hit - rays.origin) * geometric).sum(axis=1) / (rays.direction * geometric).sum(axis=1)
        point = rays.origin + rays.direction * along[:, None]
        shift = point - hit
        good = np.linalg.norm(shift, axis=1) < 10 * _OFFSET * (1 + np.abs(hit).max(axis=1))
        shift[~good] = 0
        du, dv, ndu, ndv = (_vectors(v, count) for v in (si.dp_du, si.dp_dv, si.dn_du, si.dn_dv))
        e, f, g = (du * du).sum(axis=1), (du * dv).sum(axis=1), (dv * dv).sum(axis=1)
        a, b, determinant = (shift * du).sum(axis=1), (shift * dv).sum(axis=1), e * g - f * f
        turn = ((a * g - b * f) / determinant)[:, None] * ndu + ((b * e - a * f) / determinant)[:, None] * ndv
        normal += np.where(np.isfinite(turn).all(axis=1, keepdims=True), turn, 0)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.where(good[:, None], point, hit), geometric, normal


def _redirected(
    direction: FloatArray, normal: FloatArray, kind: IntArray, eta: FloatArray, traced: FloatArray
) -> FloatArray:
    """(k, 3) unit directions after the surface in float64: reflected, refracted by ``eta`` (Snell) or straight on.

    Where that disagrees with Mitsuba's own direction ``traced`` (a material that bends light in another way), Mitsuba's
    stands.
    """
    cosine = (direction * normal).sum(axis=1, keepdims=True)
    reflected = direction - 2 * cosine * normal
    inside = 1 - (1 - cosine**2) / eta[:, None] ** 2
    refracted = (direction - cosine * normal) / eta[:, None] + np.sign(cosine) * np.sqrt(np.maximum(inside, 0)) * normal
    exact = np.where((kind & int(mi.BSDFFlags.DeltaTransmission))[:, None] != 0, refracted, direction)
    exact = np.where((kind & int(mi.BSDFFlags.DeltaReflection))[:, None] != 0, reflected, exact)
    agrees = np.linalg.norm(exact - traced, axis=1, keepdims=True) < _AGREEMENT
    chosen = np.where(agrees, exact, traced)
    return np.asarray(chosen / np.linalg.norm(chosen, axis=1, keepdims=True))


def _host(values: Any, count: int) -> npt.NDArray[Any]:
    """(count,) of a Dr.Jit array that may hold one number for all."""
    array = np.array(values)
    array = array.astype(np.float64) if array.dtype.kind == "f" else array
    return np.broadcast_to(array.reshape(-1), (count,))


def _vectors(values: Any, count: int) -> FloatArray:
    return np.stack([_host(part, count) for part in (values.x, values.y, values.z)], axis=1)


def _channels(spectrum: Any, count: int) -> FloatArray:
    """(count, channels) of a spectrum."""
    return np.stack([_host(spectrum[i], count) for i in range(len(spectrum))], axis=1)

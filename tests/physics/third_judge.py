"""Light of simple scenes in float64, apart from Mitsuba and mitsim: shapes, projector and camera in, irradiance out.

Both estimators trace rays by Mitsuba in float32, so they can lose the same light. This module knows rectangles with
holes, spheres, cylinders, one pane of glass, matt surfaces and mirrors, and gives by quadrature what a pinhole
projector brings to points of the sensor over one matt surface at most, with shadows: directly, over mirrors before it
or behind it, through the pane and after reflections inside of it; and over mirrors or the pane's faces alone. Light
over two matt surfaces is left out: the estimators are compared without ``interreflection``. Lengths are mm in the
camera's frame (sensor at z = 0, +z to the scene), irradiance is W/m^2.

*Over one matt surface:* each projector pixel is cut into k x k rays. A ray of flux phi that meets a surface of
reflectance rho at P brings a sensor point X

    E = rho / pi  phi  cos_P T  |dw / dA|,      dw / dA = cos_X / r^2 in free space

Through a pane of thickness t and index n, with a and b the angles outside and inside, D the distance along its normal
and m pairs of reflections inside, light moves sideways by s(a) = (D - t) tan a + (2 m + 1) t tan b. This is solved for
a, and dA = s s' / sin a dw on planes parallel to the pane. What a mirror shows is summed over the mirror's surface.

*Over mirrors alone:* the ray that lands at X is found by Newton's method on the projector's plane, and E = phi |dp /
dX| R, the derivative by central differences.

Fresnel's factors are those of unpolarised light at each face. The error is the difference of two quadratures, of k and
k + 1 rays a side.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Print = Callable[[Array, Array], Array]
"""Of coordinates (u, v) of -1 to 1 over a rectangle."""
NEAR = 1e-9
"""Distance [mm] below which a ray is still at the surface that it left: float64 leaves 1e-13 of a metre."""
MOST_MIRRORS, MOST_ORDER = 4, 3
"""Turns in mirrors one after the other, and pairs of reflections inside of a pane: at 60 degrees R^8 is 4e-9."""
LEAST = 1e-5
"""Part of the light below which more reflections inside of a pane are left out."""
FEWER = 3
"""Part of the rays a side that reflections inside of a pane take: they are a hundredth of the light."""
SHOWN = 100
"""Parts a side of a mirror, for what it shows."""
STEP = 1e-7
"""Step of tan-angles for derivatives of landings: 1e-9 by rounding, 1e-5 by curvature of a ball of 0.02 mm at 400."""


def dot(a: Array, b: Array) -> Array:
    return np.einsum("...i,...i->...", a, b)


def unit(a: Array) -> Array:
    return a / np.sqrt(dot(a, a))[..., None]


def vector(*numbers: float) -> Array:
    return np.array(numbers, dtype=np.float64)


def reflect(d: Array, n: Array) -> Array:
    return d - 2 * dot(d, n)[..., None] * n


def fresnel(cosine: Array, ratio: float) -> tuple[Array, Array]:
    """Reflectance of unpolarised light and the cosine beyond, for an index ``ratio`` of beyond over before."""
    inside = np.sqrt(np.maximum(1 - (1 - cosine**2) / ratio**2, 0))
    s = (cosine - ratio * inside) / (cosine + ratio * inside)
    p = (ratio * cosine - inside) / (ratio * cosine + inside)
    return (s**2 + p**2) / 2, inside


# ---- shapes


@dataclass(frozen=True)
class Rectangle:
    """Two-sided, ``centre`` + u ``half_u`` + v ``half_v``; ``open`` tells where it has holes."""

    centre: Array
    half_u: Array
    half_v: Array
    albedo: float | Print = 0.5
    mirror: float = 0.0
    open: Callable[[Array, Array], npt.NDArray[np.bool_]] | None = None

    def _coordinates(self, p: Array) -> tuple[Array, Array]:
        away = p - self.centre
        return dot(away, self.half_u) / dot(self.half_u, self.half_u), dot(away, self.half_v) / dot(
            self.half_v, self.half_v
        )

    def crossings(self, o: Array, d: Array) -> list[Array]:
        n = np.cross(self.half_u, self.half_v)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = dot(self.centre - o, n) / dot(d, n)
            u, v = self._coordinates(o + t[..., None] * d)
            here = (np.abs(u) <= 1) & (np.abs(v) <= 1)
            if self.open is not None:
                here &= ~self.open(u, v)
        return [np.where(here, t, np.inf)]

    def normal(self, p: Array) -> Array:
        return np.broadcast_to(unit(np.cross(self.half_u, self.half_v)), p.shape)

    def reflectance(self, p: Array) -> Array:
        return self.albedo(*self._coordinates(p)) if callable(self.albedo) else np.full(len(p), self.albedo)

    def near(self, o: Array, d: Array, width: float) -> npt.NDArray[np.bool_]:
        del o, width
        return np.zeros(len(d), dtype=bool)

    def parts(self, x: Array, k: int) -> tuple[Array, Array, Array]:
        """Middles, normals and areas of k x k parts of what ``x`` sees of it."""
        del x
        even = (2 * np.arange(k) + 1) / k - 1
        u, v = (part.ravel()[:, None] for part in np.meshgrid(even, even))
        p = self.centre + u * self.half_u + v * self.half_v
        return p, self.normal(p), np.full(k * k, np.linalg.norm(np.cross(self.half_u, self.half_v)) * 4 / k**2)

    def guess(self, a: Array, b: Array) -> Array:
        """Where light from ``a`` to ``b`` is reflected, or nearly."""
        n = unit(np.cross(self.half_u, self.half_v))
        image = a - 2 * dot(a - self.centre, n) * n
        return image + (b - image) * (dot(self.centre - image, n) / dot(b - image, n))[..., None]


@dataclass(frozen=True)
class Sphere:
    centre: Array
    radius: float
    albedo: float = 0.5
    mirror: float = 0.0

    def crossings(self, o: Array, d: Array) -> list[Array]:
        away = self.centre - o
        along = dot(away, d)
        beside = away - along[..., None] * d
        square = self.radius**2 - dot(beside, beside)
        half = np.sqrt(np.maximum(square, 0))
        return [np.where(square > 0, along + sign * half, np.inf) for sign in (-1, 1)]

    def normal(self, p: Array) -> Array:
        return unit(p - self.centre)

    def reflectance(self, p: Array) -> Array:
        return np.full(len(p), self.albedo)

    def near(self, o: Array, d: Array, width: float) -> npt.NDArray[np.bool_]:
        away = self.centre - o
        along = dot(away, d)
        beside = away - along[..., None] * d
        return np.sqrt(dot(beside, beside)) < self.radius + width * along

    def parts(self, x: Array, k: int) -> tuple[Array, Array, Array]:
        axis = unit(x - self.centre)
        side = unit(np.cross(axis, vector(0.6, 0.8, 0.1)))
        height, angle = np.meshgrid((np.arange(k) + 0.5) / k, 2 * np.pi * (np.arange(k) + 0.5) / k)
        h, w = height.ravel()[:, None], angle.ravel()[:, None]
        n = h * axis + np.sqrt(1 - h**2) * (np.cos(w) * side + np.sin(w) * np.cross(axis, side))
        return self.centre + self.radius * n, n, np.full(k * k, 2 * np.pi * self.radius**2 / k**2)

    def guess(self, a: Array, b: Array) -> Array:
        n = unit(unit(a - self.centre) + unit(b - self.centre))
        for _ in range(60):
            p = self.centre + self.radius * n
            n = unit(unit(a - p) + unit(b - p))
        return self.centre + self.radius * n


@dataclass(frozen=True)
class Cylinder:
    """An open tube, two-sided."""

    p0: Array
    p1: Array
    radius: float
    albedo: float = 0.5
    mirror: float = 0.0

    def _across(self, a: Array) -> tuple[Array, Array]:
        """Parts along and across the axis."""
        axis = unit(self.p1 - self.p0)
        along = dot(a, axis)
        return along, a - along[..., None] * axis

    def crossings(self, o: Array, d: Array) -> list[Array]:
        (start, away), (slope, across) = self._across(o - self.p0), self._across(d)
        squared = dot(across, across)
        middle = -dot(away, across) / squared
        beside = away + middle[..., None] * across
        square = self.radius**2 - dot(beside, beside)
        half = np.sqrt(np.maximum(square, 0) / squared)
        length = float(np.linalg.norm(self.p1 - self.p0))
        found = []
        for t in (middle - half, middle + half):
            height = start + t * slope
            found.append(np.where((square > 0) & (height >= 0) & (height <= length), t, np.inf))
        return found

    def normal(self, p: Array) -> Array:
        return unit(self._across(p - self.p0)[1])

    def reflectance(self, p: Array) -> Array:
        return np.full(len(p), self.albedo)

    def near(self, o: Array, d: Array, width: float) -> npt.NDArray[np.bool_]:
        (start, away), (slope, across) = self._across(o - self.p0), self._across(d)
        t = -dot(away, across) / dot(across, across)
        beside, height = away + t[..., None] * across, start + t * slope
        reach, length = self.radius + width * t, float(np.linalg.norm(self.p1 - self.p0))
        return (np.sqrt(dot(beside, beside)) < reach) & (height > -reach) & (height < length + reach)

    def parts(self, x: Array, k: int) -> tuple[Array, Array, Array]:
        axis, (_, off) = unit(self.p1 - self.p0), self._across(x - self.p0)
        along, angle = np.meshgrid((np.arange(k) + 0.5) / k, np.pi * ((np.arange(k) + 0.5) / k - 0.5))
        w = angle.ravel()[:, None]
        n = np.cos(w) * unit(off) + np.sin(w) * np.cross(axis, unit(off))
        length = float(np.linalg.norm(self.p1 - self.p0))
        p = self.p0 + along.ravel()[:, None] * length * axis + self.radius * n
        return p, n, np.full(k * k, np.pi * self.radius * length / k**2)

    def guess(self, a: Array, b: Array) -> Array:
        axis = unit(self.p1 - self.p0)
        (from_a, off_a), (from_b, off_b) = self._across(a - self.p0), self._across(b - self.p0)
        n = unit(unit(off_a) + unit(off_b))
        for _ in range(60):  # in the plane across the axis: light of these two points, where lengths count
            foot = self.radius * n
            near_a, near_b = (np.sqrt(dot(off - foot, off - foot)) for off in (off_a, off_b))
            n = unit((off_a - foot) / near_a[..., None] + (off_b - foot) / near_b[..., None])
        height = (from_a * near_b + from_b * near_a) / (near_a + near_b)
        return self.p0 + height[..., None] * axis + self.radius * n


Shape = Rectangle | Sphere | Cylinder


@dataclass(frozen=True)
class Slab:
    """A pane of glass, wider than all light, about a ``centre``."""

    centre: Array
    normal: Array
    thickness: float
    index: float = 1.5


# ---- devices


@dataclass(frozen=True)
class Projector:
    """A pinhole that looks along +z: n x n pixels between ``left`` and ``right`` (x / z) and ``bottom`` and ``top``.

    Row 0 is at the top and column 0 at +x (``right`` is the larger). On a plane at z = 1 it casts pi times ``scale``.
    """

    place: Array
    n: int
    scale: float
    left: float
    right: float
    bottom: float
    top: float

    @property
    def area(self) -> float:
        """Of a pixel on the plane at unit distance."""
        return (self.right - self.left) * (self.top - self.bottom) / self.n**2

    def rays(self, pixel: npt.NDArray[np.int64], k: int) -> tuple[Array, npt.NDArray[np.int64]]:
        """Unit directions of k x k rays of each ``pixel``, and whose they are."""
        part = (np.arange(k) + 0.5) / k
        row, column = np.divmod(pixel, self.n)
        i = row[:, None, None] + part[:, None]
        j = column[:, None, None] + part
        y = self.top - i * (self.top - self.bottom) / self.n
        x = self.right - j * (self.right - self.left) / self.n
        x, y = np.broadcast_arrays(x, y)
        d = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
        return unit(d), np.repeat(pixel, k * k)

    def pixel(self, p: Array) -> npt.NDArray[np.int64]:
        """Pixel of tan-angles (x, y); -1 beside the window."""
        i = np.floor((self.top - p[..., 1]) / (self.top - self.bottom) * self.n).astype(np.int64)
        j = np.floor((self.right - p[..., 0]) / (self.right - self.left) * self.n).astype(np.int64)
        inside = (i >= 0) & (i < self.n) & (j >= 0) & (j < self.n)
        return np.where(inside, i * self.n + j, -1)


@dataclass(frozen=True)
class Camera:
    """A square sensor at z = 0; ``code`` are the features of a separable mask's rows and columns, None: open."""

    pixels: int
    pitch: float
    fov: float = 20.0
    distance: float = 2.0
    code: Array | None = None
    feature: float = 0.06

    def point(self, row: float, column: float, offset: tuple[float, float] = (0, 0)) -> Array:
        """The middle of a pixel, or ``offset`` from it in pixels down the rows and along the columns."""
        half = (self.pixels - 1) / 2
        return vector((half - column - offset[1]) * self.pitch, (half - row - offset[0]) * self.pitch, 0)

    def within(self, t: Array) -> npt.NDArray[np.bool_]:
        """Whether light of tan-angles (x, y) comes through the stop."""
        stop = np.tan(np.radians(self.fov / 2))
        return (np.abs(t) <= stop).all(axis=-1)

    def _mean(self, low: Array, high: Array) -> Array:
        """Mean of the code between two coordinates of an axis, which grow with the index."""
        assert self.code is not None
        edges = (np.arange(len(self.code) + 1) - len(self.code) / 2) * self.feature
        total = np.concatenate([[0], np.cumsum(self.code)]) * self.feature
        return (np.interp(high, edges, total) - np.interp(low, edges, total)) / (high - low)

    def transmission(self, x: Array, t: Array, depth: Array, width: float = 1.0) -> Array:
        """Of the mask, mean over ``width`` pixels about the point ``x``, for light that seems to be from ``depth``."""
        if self.code is None:
            return np.ones(len(t))
        total = np.ones(len(t))
        for axis in (0, 1):
            middle = -(x[axis] + self.distance * t[:, axis])
            half = np.abs(1 - self.distance / depth) * (width * self.pitch / 2)
            total *= self._mean(middle - half, middle + half)
        return total


@dataclass(frozen=True)
class Scene:
    projector: Projector
    camera: Camera
    shapes: Sequence[Shape]
    pane: Slab | None = None

    def nearest(self, o: Array, d: Array) -> tuple[Array, npt.NDArray[np.int64]]:
        """Distance to the first shape, inf where there is none, and its number."""
        best, number = np.full(len(d), np.inf), np.full(len(d), -1)
        for i, shape in enumerate(self.shapes):
            for t in shape.crossings(o, d):
                first = (t > NEAR) & (t < best)
                best, number = np.where(first, t, best), np.where(first, i, number)
        return best, number

    def free(self, a: Array, b: Array) -> npt.NDArray[np.bool_]:
        """Whether nothing stands between points ``a`` and ``b``; panes are not asked."""
        a, b = np.broadcast_arrays(a, b)
        length = np.sqrt(dot(b - a, b - a))
        d = (b - a) / np.maximum(length, 1e-300)[:, None]
        found = np.ones(len(a), dtype=bool)
        for shape in self.shapes:
            for t in shape.crossings(a, d):
                found &= ~((t > NEAR) & (t < length - NEAR))
        return found


@dataclass(frozen=True)
class Lit:
    """Lit places of matt surfaces: where, normal to the lit side, radiant intensity along it, and for which pixel."""

    p: Array
    n: Array
    intensity: Array
    pixel: npt.NDArray[np.int64]


def lit(scene: Scene, pixel: npt.NDArray[np.int64], k: int, order: int = 0) -> tuple[Lit, npt.NDArray[np.bool_]]:
    """What k x k rays of each projector ``pixel`` light; and whether the rays of one meet several shapes.

    ``order`` pairs of reflections happen inside of the pane; without one there is light of order 0 alone.
    """
    projector = scene.projector
    d, of = projector.rays(pixel, k)
    o = np.broadcast_to(projector.place, d.shape).copy()
    t, number = scene.nearest(o, d)
    part = np.ones(len(d))
    if scene.pane:
        n = scene.pane.normal * np.sign(dot(d.mean(axis=0), scene.pane.normal))
        cosine = dot(d, n)
        to_face = (dot(scene.pane.centre - o, n) - scene.pane.thickness / 2) / cosine
        before = t < to_face
        reflected, inside = fresnel(cosine, scene.pane.index)
        sideways = (d - cosine[:, None] * n) * ((2 * order + 1) / (scene.pane.index * inside))[:, None]
        beyond = o + to_face[:, None] * d + scene.pane.thickness * (n + sideways)
        o = np.where(before[:, None], o, beyond)
        part = np.where(before, order == 0, (1 - reflected) ** 2 * reflected ** (2 * order))
        t, number = scene.nearest(o, d)
    first = number.reshape(len(pixel), -1)
    mixed = (first != first[:, :1]).any(axis=1)
    for _ in range(MOST_MIRRORS):
        for i, shape in enumerate(scene.shapes):
            here = np.flatnonzero(number == i)
            if shape.mirror and len(here):
                o[here] += t[here, None] * d[here]
                d[here] = reflect(d[here], shape.normal(o[here]))
                part[here] *= shape.mirror
                t[here], number[here] = scene.nearest(o[here], d[here])
    p = o + np.where(np.isfinite(t), t, 0)[:, None] * d
    phi = np.pi * projector.scale * projector.area / k**2
    normal, intensity = np.zeros_like(p), np.zeros(len(p))
    for i, shape in enumerate(scene.shapes):
        here = number == i
        if here.any() and not shape.mirror:
            n = shape.normal(p[here])
            normal[here] = n * -np.sign(dot(n, d[here]))[:, None]
            intensity[here] = phi / np.pi * part[here] * shape.reflectance(p[here])
    seen = intensity > 0
    return Lit(p[seen], normal[seen], intensity[seen], of[seen]), mixed


def lamp(rectangle: Rectangle, radiance: float, k: int) -> Lit:
    """Places of an area lamp, k x k of Gauss's, that shines to the side of half_u x half_v; all for pixel 0."""
    node, weight = np.polynomial.legendre.leggauss(k)
    u, v = (part.ravel() for part in np.meshgrid(node, node))
    p = rectangle.centre + u[:, None] * rectangle.half_u + v[:, None] * rectangle.half_v
    area = float(np.linalg.norm(np.cross(rectangle.half_u, rectangle.half_v)))
    return Lit(p, rectangle.normal(p), radiance * area * np.outer(weight, weight).ravel(), np.zeros(k * k, np.int64))


def received(scene: Scene, lights: Lit, x: Array, width: float = 1.0, order: int = 0) -> Array:
    """Irradiance at a sensor point ``x`` by each of lit places, mean over ``width`` pixels of a mask.

    ``order`` pairs of reflections happen inside of the pane.
    """
    camera, p = scene.camera, lights.p
    if scene.pane is None:
        away = x - p
        r = np.sqrt(dot(away, away))
        direction, apparent, part, dw = away / r[:, None], p, np.ones(len(p)), -away[:, 2] / r**3
        legs = [(p, np.broadcast_to(x, p.shape))]
    else:
        direction, apparent, part, dw, legs = through(scene.pane, p, x, order)
    t = (apparent - x)[:, :2] / (apparent - x)[:, 2:]
    light = lights.intensity * part * np.maximum(dot(lights.n, direction), 0) * np.maximum(dw, 0)
    light = light * camera.within(t) * camera.transmission(x, t, apparent[:, 2], width)
    for a, b in legs:
        seen = np.flatnonzero(light > 0)
        light[seen[~scene.free(a[seen], b[seen])]] = 0
    return light


def through(
    pane: Slab, p: Array, x: Array, order: int = 0
) -> tuple[Array, Array, Array, Array, list[tuple[Array, Array]]]:
    """Direction that light leaves ``p`` in to arrive at ``x``, apparent place, part of it, dw / dA, and legs in air."""
    n = pane.normal * np.sign(-pane.normal[2])  # towards the sensor
    between = (dot(pane.centre - p, n) > 0) & (dot(x - pane.centre, n) > 0)
    height = dot(x - p, n)
    lateral = (x - p) - height[:, None] * n
    length = np.sqrt(dot(lateral, lateral))
    side = lateral / np.maximum(length, 1e-300)[:, None]
    air, glass = height - pane.thickness * between, (2 * order + 1) * pane.thickness * between
    # g(tan a) = air tan a + glass tan b rises and is concave: Newton's steps from below stay below the root.
    tangent = length / (air + glass / pane.index)
    for _ in range(8):
        root = np.sqrt(pane.index**2 + (pane.index**2 - 1) * tangent**2)
        slope = air + glass * pane.index**2 / root**3
        tangent = tangent + (length - air * tangent - glass * tangent / root) / slope
    cosine = 1 / np.sqrt(1 + tangent**2)
    sine = tangent * cosine
    inside = np.sqrt(pane.index**2 - sine**2)
    grows = air / cosine**2 + glass * cosine * pane.index**2 / inside**3
    reflected = fresnel(cosine, pane.index)[0]
    part = np.where(between, (1 - reflected) ** 2 * reflected ** (2 * order), float(order == 0))
    direction = cosine[:, None] * n + sine[:, None] * side
    # On planes parallel to the pane dA = s s' / sin a dw, s / sin a with a limit at 0; across the light, times cos a.
    across = (air / cosine + glass / inside) * grows * cosine
    apparent = x - direction * np.sqrt(across)[:, None]
    to_face = (dot(x - pane.centre, n) - pane.thickness / 2) / cosine
    face = x - to_face[:, None] * direction
    beyond = face - pane.thickness * n - (glass * sine / inside)[:, None] * side
    legs = [
        (np.where(between[:, None], beyond, x), p),
        (np.where(between[:, None], face, x), np.broadcast_to(x, p.shape)),
    ]
    return direction, apparent, part, -direction[:, 2] / across, legs


def mirrored(scene: Scene, x: Array, k: int) -> tuple[Array, npt.NDArray[np.int64]]:
    """Irradiance at a sensor point ``x`` of lit matt surfaces that mirrors show, by k x k parts of each, and pixels."""
    projector, lights, pixels = scene.projector, [], []
    for shape in scene.shapes:
        if not shape.mirror:
            continue
        p, n, area = shape.parts(x, k)
        away = p - x
        r = np.sqrt(dot(away, away))
        d = away / r[:, None]
        facing = np.abs(dot(n, d)) if isinstance(shape, Rectangle) else np.maximum(-dot(n, d), 0)
        light = area * facing * d[:, 2] / r**2 * shape.mirror
        t = d[:, :2] / d[:, 2:]
        light = light * scene.camera.within(t) * scene.camera.transmission(x, t, np.full(len(t), np.inf))
        light[~scene.free(np.broadcast_to(x, p.shape), p)] = 0
        o, d = p, reflect(d, n)
        far, number = scene.nearest(o, d)
        for _ in range(MOST_MIRRORS - 1):
            for i, other in enumerate(scene.shapes):
                here = np.flatnonzero(number == i)
                if other.mirror and len(here):
                    o[here] += far[here, None] * d[here]
                    d[here] = reflect(d[here], other.normal(o[here]))
                    light[here] *= other.mirror
                    far[here], number[here] = scene.nearest(o[here], d[here])
        q = o + np.where(np.isfinite(far), far, 0)[:, None] * d
        radiance = np.zeros(len(q))
        from_projector = q - projector.place
        distance = np.sqrt(dot(from_projector, from_projector))
        ray = from_projector / np.maximum(distance, 1e-300)[:, None]
        for i, other in enumerate(scene.shapes):
            here = np.flatnonzero((number == i) & (ray[:, 2] > 0))
            if len(here) and not other.mirror:
                normal = other.normal(q[here])
                sides = dot(normal, ray[here]) * dot(normal, d[here])
                cosine = np.where(sides > 0, np.abs(dot(normal, ray[here])), 0)
                intensity = np.pi * projector.scale / ray[here, 2] ** 3
                radiance[here] = other.reflectance(q[here]) / np.pi * intensity * cosine / distance[here] ** 2
        with np.errstate(all="ignore"):
            pixel = np.where(ray[:, 2] > 0, projector.pixel(ray[:, :2] / ray[:, 2:]), -1)
        light = light * radiance * (pixel >= 0)
        seen = np.flatnonzero(light > 0)
        light[seen[~scene.free(np.broadcast_to(projector.place, q.shape)[seen], q[seen])]] = 0
        lights.append(light)
        pixels.append(pixel)
    if not lights:
        return np.zeros(0), np.zeros(0, np.int64)
    return np.concatenate(lights), np.concatenate(pixels)


# ---- light over mirrors


def specular(scene: Scene, x: Array) -> list[tuple[Array, Array, Array]]:
    """Light over one mirror, or a pane's faces, that arrives at sensor points ``x`` (m, 3).

    A list over ways: tan-angles (m, 2) of the projector's ray, irradiance (m,) where it is seen, and tan-angles (m, 2)
    at the sensor; the projector's window is not asked.
    """
    found = []
    for shape in scene.shapes:
        if shape.mirror:
            assert scene.pane is None, "mirrors beside panes are not known"
            found.append(_by_way(scene, x, shape.guess(scene.projector.place, x), _Mirror(scene, shape)))
    if scene.pane:
        slab, n = scene.pane, scene.pane.normal * np.sign(-scene.pane.normal[2])
        for order in range(MOST_ORDER + 1):  # reflections: the front, then one, three, five inside
            depth = -slab.thickness / 2 if order == 0 else slab.thickness * ((2 * order - 1) / slab.index - 0.5)
            plane = slab.centre - n * depth
            image = scene.projector.place - 2 * dot(scene.projector.place - plane, n) * n
            start = image + (x - image) * (dot(plane - image, n) / dot(x - image, n))[:, None]
            found.append(_by_way(scene, x, start, _Faces(scene, slab, n, order)))
    return found


@dataclass(frozen=True)
class _Mirror:
    scene: Scene
    shape: Shape

    def landing(self, o: Array, d: Array) -> tuple[Array, Array, Array, list[Array]]:
        """Direction at the sensor's plane, place there, part of the light left, and places on the way."""
        t = np.minimum.reduce([np.where(t > NEAR, t, np.inf) for t in self.shape.crossings(o, d)])
        p = o + t[:, None] * d
        out = reflect(d, self.shape.normal(p))
        return out, p - (p[:, 2] / out[:, 2])[:, None] * out, np.full(len(d), self.shape.mirror), [p, p]


@dataclass(frozen=True)
class _Faces:
    scene: Scene
    slab: Slab
    n: Array
    order: int

    def landing(self, o: Array, d: Array) -> tuple[Array, Array, Array, list[Array]]:
        slab, n = self.slab, self.n
        cosine = -dot(d, n)
        t = (dot(o - slab.centre, n) - slab.thickness / 2) / cosine
        first = o + t[:, None] * d
        out, (reflected, inside) = reflect(d, n), fresnel(cosine, slab.index)
        last, part = first, reflected
        if self.order:
            across = d + cosine[:, None] * n
            last = first + (2 * self.order * slab.thickness / (slab.index * inside))[:, None] * across
            part = (1 - reflected) ** 2 * reflected ** (2 * self.order - 1)
        return out, last - (last[:, 2] / out[:, 2])[:, None] * out, part, [first, last]


def _by_way(scene: Scene, x: Array, start: Array, way: _Mirror | _Faces) -> tuple[Array, Array, Array]:
    place = scene.projector.place
    p = (start - place)[:, :2] / (start - place)[:, 2:]
    o = np.broadcast_to(place, x.shape)

    def landing(p: Array) -> tuple[Array, Array, Array, list[Array]]:
        return way.landing(o, unit(np.column_stack([p, np.ones(len(p))])))

    def slopes(p: Array) -> Array:
        """(m, 2, 2) d landing / d p."""
        columns = []
        for axis in (0, 1):
            step = np.zeros(2)
            step[axis] = STEP
            columns.append((landing(p + step)[1] - landing(p - step)[1])[:, :2] / (2 * STEP))
        return np.stack(columns, axis=-1)

    with np.errstate(all="ignore"):
        for _ in range(8):
            p = p + np.linalg.solve(slopes(p), (x - landing(p)[1])[:, :2, None])[..., 0]
        out, there, part, on_the_way = landing(p)
        missed = np.sqrt(dot(there - x, there - x))
        determinant = np.abs(np.linalg.det(slopes(p)))
        arrives = (missed < 1e-6) & (out[:, 2] < 0) & (determinant > 0)
    light = np.zeros(len(x))
    t = out[:, :2] / out[:, 2:]
    good = np.flatnonzero(arrives & scene.camera.within(t))
    clear = scene.free(o[good], on_the_way[0][good]) & scene.free(on_the_way[-1][good], x[good])
    good = good[clear]
    light[good] = np.pi * scene.projector.scale / determinant[good] * part[good]
    return p, light, t


# ---- answers


@dataclass(frozen=True)
class Answer:
    """(classes, points) irradiance, and its relative error (rms over both) by the difference of two quadratures."""

    light: Array
    error: float


def answer(
    scene: Scene,
    points: Sequence[tuple[float, float]],
    labels: npt.NDArray[np.int64] | None = None,
    k: int = 4,
    fine: int = 0,
    parts: int = 4,
) -> Answer:
    """Light of each class of projector pixels at sensor pixels.

    Parameters
    ----------
    scene
        what is lit.
    points
        (row, column) of sensor pixels, or of places between their middles.
    labels
        (n^2,) class of each projector pixel; None: one for all.
    k
        rays a side of each projector pixel.
    fine
        the same of pixels that have several shapes in them, or a ball or cylinder; 0: four times as many.
    parts
        points a side of each sensor pixel for light over mirrors.
    """
    labels = np.zeros(scene.projector.n**2, np.int64) if labels is None else labels
    both = [_quadrature(scene, points, labels, k + more, (fine or 4 * k) + more, parts + more) for more in (0, 1)]
    error = float(np.linalg.norm(both[1] - both[0]) / np.linalg.norm(both[1]))
    return Answer(both[1], error)


def direct(scene: Scene, point: tuple[float, float], k: int = 4, fine: int = 16) -> float:
    """All light over one matt surface alone at a place (row, column) of the sensor, without its mask's shadow."""
    x = scene.camera.point(*point)
    return sum(float(received(scene, lit(scene, some, count)[0], x).sum()) for some, count in _pixels(scene, k, fine))


def _pixels(scene: Scene, k: int, fine: int) -> Iterator[tuple[npt.NDArray[np.int64], int]]:
    """Portions of the projector's pixels, and rays a side of each: ``fine`` where a pixel has several shapes in it."""
    every = np.arange(scene.projector.n**2)
    middle, _ = scene.projector.rays(every, 1)
    crowded = lit(scene, every, max(k, 4))[1]
    for shape in scene.shapes:
        crowded |= shape.near(scene.projector.place, middle, float(np.sqrt(scene.projector.area)))
    for pixels, count in ((every[~crowded], k), (every[crowded], fine)):
        portions = np.array_split(pixels, max(1, len(pixels) * count**2 // 2**19))
        yield from ((some, count) for some in portions if len(some))


def _quadrature(
    scene: Scene, points: Sequence[tuple[float, float]], labels: npt.NDArray[np.int64], k: int, fine: int, parts: int
) -> Array:
    projector, classes = scene.projector, int(labels.max()) + 1
    total = np.zeros((classes, len(points)))
    for some, count in _pixels(scene, k, fine):
        found: list[float] = []
        for order in range(MOST_ORDER + 1 if scene.pane else 1):
            found.append(0.0)
            for before in range(order + 1):
                lights, _ = lit(scene, some, max(2, count // FEWER) if order else count, before)
                for j, (row, column) in enumerate(points):
                    light = received(scene, lights, scene.camera.point(row, column), order=order - before)
                    total[:, j] += np.bincount(labels[lights.pixel], light, minlength=classes)
                    found[-1] += float(light.sum())
            if order and found[-1] ** 2 < LEAST * found[0] * found[-2]:
                break
    for j, (row, column) in enumerate(points):
        light, pixel = mirrored(scene, scene.camera.point(row, column), SHOWN + 7 * parts)
        shown = light > 0
        total[:, j] += np.bincount(labels[pixel[shown]], light[shown], minlength=classes)
    offsets = (np.arange(parts) + 0.5) / parts - 0.5
    x = np.array([[scene.camera.point(*point, (a, b)) for a in offsets for b in offsets] for point in points])
    flat = x.reshape(-1, 3)
    for p, light, t in specular(scene, flat):
        masked = light / parts**2
        if scene.camera.code is not None:
            depth = np.full(len(t), np.inf)
            coded = [scene.camera.transmission(u, t[[i]], depth[[i]], 1 / parts)[0] for i, u in enumerate(flat)]
            masked = masked * np.array(coded)
        pixel = projector.pixel(p)
        seen = np.flatnonzero((pixel >= 0) & (masked > 0))
        np.add.at(total, (labels[pixel[seen]], seen // parts**2), masked[seen])
    return total

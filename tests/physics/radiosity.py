"""Light transport solved without a renderer: a corner of two diffuse walls, and the inside of a diffuse sphere.

Judges for estimators that follow light over many reflections. Only numpy; nothing of mitsim or Mitsuba is used. Lengths
are mm in the camera's frame (sensor's centre at the origin, +z to the scene). All results scale with the projector's
``scale`` and are split by class of projector pixel, ``dots:k``: class (i, j) holds the pixels (row, column) with
row = i and column = j modulo k, and is number i k + j.

The projector. A pinhole at P that faces along z puts the flux pi scale dp dq into the tan-angles dp dq (Mitsuba's
``projector``: irradiance pi scale / z^2 on every plane z = const, so flux is uniform over the plane z = 1). So its
intensity is pi scale / cos^3, and on a surface point x with normal n the irradiance is

    E(x) = pi scale  n.(P - x) / z^3,      E dA = pi scale dp dq.

On a plane n.(P - x) is one number, the distance D_P of P from it: E depends on z alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

SCALE = 111000.0  # of the small scene's projector
PROJECTOR_X = 60.0
WIDE, TALL = (-0.3, 0.0), (-0.15, 0.15)  # tan-angles of the window, x and y, from the projector
ROOT2 = np.sqrt(2.0)
WALLS, SIDE = (0, 1), (1, -1)  # walls A and B, and the sign of x on them
Source = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Nodes in a and their weights (nodes,), edges of strips in y (nodes, strips + 1), values (nodes, strips or 1)."""


def gauss(low: np.ndarray | float, high: np.ndarray | float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights of the intervals low..high, on a new last axis."""
    node, weight = np.polynomial.legendre.leggauss(count)
    low, high = np.asarray(low)[..., None], np.asarray(high)[..., None]
    return (low + high) / 2 + node * (high - low) / 2, weight * (high - low) / 2


def panels(low: float, high: float, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss nodes and weights of low..high; where low is the edge, 0, panels that halve toward it 10 times."""
    edges = np.array([low, high]) if low > 0 else np.concatenate(([0.0], high * 2.0 ** np.arange(-10, 1)))
    nodes, weights = gauss(edges[:-1], edges[1:], order)
    return nodes.ravel(), weights.ravel()


def solid_angle(tan_half: float) -> float:
    """Integral of (1 + |t|^2)^-2 over the square |t_x|, |t_y| < tan_half: pi times a view factor (Howell, B-3)."""
    root = np.sqrt(1 + tan_half**2)
    return float(4 * tan_half / root * np.arctan(tan_half / root))


# ---- the corner


@dataclass(frozen=True)
class Corner:
    """Two walls that meet at a right angle along the line x = 0, z = ``edge``; the camera sees into the corner.

    Wall A (0) runs from the edge along (1, 0, -1)/sqrt 2, wall B (1) along (-1, 0, -1)/sqrt 2: ``depth`` from the edge,
    ``half_height`` up and down, reflectance ``rho``. A point of a wall is (a, y), a its distance from the edge; on both
    z = edge - a/sqrt 2. ``n`` pixels a side of the projector, ``k`` a side of the class pattern.

    Radiosity. A flat wall does not light itself. With M the irradiance that comes from the other wall,

        M_A(x) = rho  integral over B of (E + M_B)(x') K(x, x') dA',   K = a b / (pi (a^2 + b^2 + (y - y')^2)^2)

    (both cosines are the distance from the other plane over the length), and the same with A and B exchanged.

    Measurement. An unmasked sensor point weighs the irradiance of a wall by (rho / pi) w, w = z D_u / r^4 inside the
    field stop, r its length and D_u its distance from the wall's plane. K is symmetric, so the equation with w in place
    of E gives the *importance* psi, and light of more than one reflection is (rho / pi) integral of psi E dA, that is
    rho scale  integral of psi dp dq over the pixels of a class. psi is smooth; M is not, it is striped near the edge.

    Numbers. A source is constant over narrow strips of tan-angle y/z (E exactly so), which K's antiderivative in y
    integrates; Gauss panels graded toward the edge do the other direction. M is constant on ``cells`` x ``cells``
    patches that shrink toward the edge, with the exact integral of K over each, and is found at their centres;
    elsewhere it follows from the equation itself (Nystrom's interpolation). ``strips``: number of strips for w.
    """

    rho: float
    n: int = 16
    k: int = 2
    cells: int = 24
    strips: int = 40
    tan_half: float = 0.17633
    edge: float = 450.0
    depth: float = 120.0
    half_height: float = 80.0

    def expected(self, u_x: float = 0.0, u_y: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Irradiance of an unmasked sensor point by light of one reflection, and of more: (k^2,) each, by class.

        The field stop (``tan_half``) must not cut the light of one reflection.
        """
        one, more = np.zeros(self.k**2), np.zeros(self.k**2)
        sources = [self._seen(wall, u_x, u_y) for wall in WALLS]
        bounces = [partial(self._bounce_sum, source) for source in (sources[1], sources[0])]
        psi = self._solve(bounces)
        rows = self._rows
        q, dq = (part.ravel() for part in gauss(rows[1:], rows[:-1], 2))
        label_q = np.repeat(np.arange(self.n), 2)
        for wall in WALLS:
            a, da, label_a = self._lit_nodes(wall, 3)
            z = self.edge - a / ROOT2
            # dp of da: pi scale dp dq = E dA, with dA = z dq da.
            flux = self.rho * SCALE * (self._distance(wall) / z**2 * da)[:, None] * dq
            points = np.broadcast_to(a[:, None], flux.shape).ravel(), (z[:, None] * q).ravel()
            direct = flux * self._weight(wall, *points, u_x, u_y).reshape(flux.shape)
            if not direct.all():
                raise ValueError("the field stop cuts the light of one reflection")
            later = bounces[wall](*points) + self.rho * self._patch_kernel(*points) @ psi[1 - wall]
            label = (label_q % self.k) * self.k + label_a[:, None] % self.k
            one += np.bincount(label.ravel(), direct.ravel(), self.k**2)
            more += np.bincount(label.ravel(), flux.ravel() * later.ravel(), self.k**2)
        return one, more

    def radiance(self, wall: int, a: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Radiance of a wall at (a, y) [(points,)] by one reflection, and by more: (points, k^2) each, by class."""
        z, side = self.edge - a / ROOT2, SIDE[wall]
        row = (TALL[1] - y / z) / (TALL[1] - TALL[0]) * self.n
        column = (WIDE[1] - (side * a / ROOT2 - PROJECTOR_X) / z) / (WIDE[1] - WIDE[0]) * self.n
        inside = (row >= 0) & (row < self.n) & (column >= 0) & (column < self.n)
        label = (row.astype(int) % self.k) * self.k + column.astype(int) % self.k
        light = inside * self._distance(wall) * np.pi * SCALE / z**3
        one = light[:, None] * (label[:, None] == np.arange(self.k**2))
        more = self._by_class(1 - wall, a, y) + self.rho * self._patch_kernel(a, y) @ self._classes[1 - wall]
        return self.rho / np.pi * one, self.rho / np.pi * more

    # -- sources

    def _distance(self, wall: int) -> float:
        """D_P, the projector's distance from the plane of a wall."""
        return (self.edge - SIDE[wall] * PROJECTOR_X) / ROOT2

    @property
    def _rows(self) -> np.ndarray:
        """(n + 1,) edges of the projector's rows, y/z, the top one first."""
        return np.linspace(TALL[1], TALL[0], self.n + 1)

    def _lit_nodes(self, wall: int, order: int, graded: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gauss nodes in a over the lit part of a wall, their weights, and the projector's column at each."""
        side, p = SIDE[wall], np.linspace(WIDE[1], WIDE[0], self.n + 1)
        place = np.maximum(ROOT2 * (self.edge - (self.edge - side * PROJECTOR_X) / (1 + side * p)), 0.0)
        if place.max() > self.depth or TALL[1] * self.edge > self.half_height:
            raise ValueError("the projector lights more than the walls")
        found = []
        for column in np.flatnonzero(np.diff(place)):
            low, high = sorted(place[column : column + 2])
            nodes, weights = panels(low, high, order) if graded else gauss(low, high, order)
            found.append((nodes, weights, np.full(nodes.size, column)))
        return tuple(np.concatenate(part) for part in zip(*found, strict=True))

    def _seen(self, wall: int, u_x: float, u_y: float) -> Source:
        """w on a wall, in strips."""
        side = SIDE[wall]
        z_stop = (self.edge - side * u_x) / (1 + self.tan_half)
        a, da = panels(0.0, min(self.depth, ROOT2 * (self.edge - z_stop)), 6)
        z = (self.edge - a / ROOT2)[:, None]
        # Strips of y/z from the sensor point, as far as stop and wall let it see.
        top = np.minimum(self.tan_half, (self.half_height - u_y) / z)
        bottom = np.maximum(-self.tan_half, (-self.half_height - u_y) / z)
        edges = u_y + z * (top + (bottom - top) * np.linspace(0, 1, self.strips + 1))
        centre = (edges[:, 1:] + edges[:, :-1]) / 2
        value = self._weight(wall, np.broadcast_to(a[:, None], centre.shape), centre, u_x, u_y)
        return a, da, edges, value

    def _weight(self, wall: int, a: np.ndarray, y: np.ndarray, u_x: float, u_y: float) -> np.ndarray:
        """w at points of a wall: z D_u / r^4 inside the field stop, else 0."""
        z, x = self.edge - a / ROOT2, SIDE[wall] * a / ROOT2 - u_x
        inside = np.maximum(np.abs(x), np.abs(y - u_y)) <= self.tan_half * z * (1 + 1e-12)
        return inside * z * (self.edge - SIDE[wall] * u_x) / ROOT2 / (x**2 + (y - u_y) ** 2 + z**2) ** 2

    # -- transport

    def _bounce(self, source: Source, a: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(points, nodes, strips): irradiance at (a, y) of the other wall by each piece of a source, reflected."""
        b, db, edges, value = source
        squared = (a[:, None] ** 2 + b**2)[:, :, None]
        v = edges - y[:, None, None]
        # Antiderivative of K in y'; edges run from the top down.
        part = v / (2 * squared * (squared + v**2)) + np.arctan(v / np.sqrt(squared)) / (2 * squared**1.5)
        return self.rho * (part[:, :, :-1] - part[:, :, 1:]) * (a[:, None] * (b * db) / np.pi)[:, :, None] * value

    def _bounce_sum(self, source: Source, a: np.ndarray, y: np.ndarray) -> np.ndarray:
        return self._bounce(source, a, y).sum(axis=(1, 2))

    def _by_class(self, wall: int, a: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(points, k^2): irradiance at (a, y) of the other wall by the projector's light, reflected here."""
        b, db, column = self._lit_nodes(wall, 6, graded=True)
        z = (self.edge - b / ROOT2)[:, None]
        pieces = self._bounce((b, db, z * self._rows, self._distance(wall) * np.pi * SCALE / z**3), a, y)
        classes = [pieces[:, column % self.k == j, i :: self.k] for i in range(self.k) for j in range(self.k)]
        return np.stack([piece.sum(axis=(1, 2)) for piece in classes], axis=1)

    @cached_property
    def _classes(self) -> list[np.ndarray]:
        """M at the patches of walls A and B under the light of each class: (cells^2, k^2) each."""
        return self._solve([partial(self._by_class, 1), partial(self._by_class, 0)])

    def _solve(self, first: Sequence[Callable[[np.ndarray, np.ndarray], np.ndarray]]) -> list[np.ndarray]:
        """M at the patches of walls A and B, from functions of (a, y) that give its first part on each."""
        centres = [(edges[1:] + edges[:-1]) / 2 for edges in self._patches]
        a, y = (grid.ravel() for grid in np.meshgrid(*centres, indexing="ij"))
        on_a, on_b = (part(a, y) for part in first)
        # The walls mirror each other, so one matrix serves both directions.
        kernel = self.rho * self._patch_kernel(a, y)
        on_a = np.linalg.solve(np.eye(a.size) - kernel @ kernel, on_a + kernel @ on_b)
        return [on_a, on_b + kernel @ on_a]

    @cached_property
    def _patches(self) -> tuple[np.ndarray, np.ndarray]:
        """Edges of the patches in a and in y."""
        steps = np.arange(self.cells + 1) / self.cells
        return self.depth * steps**2, self.half_height * (2 * steps - 1)

    def _patch_kernel(self, a: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(points, cells^2): integral of K over each patch of the other wall, seen from (a, y)."""
        a_edges, y_edges = self._patches
        c = np.hypot(a[:, None], a_edges)[:, :, None]
        across = np.diff(np.arctan((y_edges - y[:, None])[:, None, :] / c), axis=2) / c
        return (-a[:, None, None] / (2 * np.pi) * np.diff(across, axis=1)).reshape(len(a), -1)


# ---- the furnace


@dataclass(frozen=True)
class Furnace:
    """Inside of a sphere of radius ``radius`` about (0, 0, ``centre``), reflectance ``rho``, around all devices.

    Between points of a sphere the kernel cos cos / (pi r^2) is 1 / area, whatever the points. So light that was
    reflected once is spread evenly, and so is every later reflection: beside its own light, flux Phi of the projector
    gives the irradiance rho Phi / area + rho^2 Phi / area + ... = Phi rho / (area (1 - rho)) everywhere on the wall.
    """

    rho: float
    radius: float = 220.0
    centre: float = 180.0

    def flux(self) -> float:
        """Flux of the whole window: pi scale dp dq. A class has the share of its pixels."""
        return float(np.pi * SCALE * (WIDE[1] - WIDE[0]) * (TALL[1] - TALL[0]))

    def indirect(self, tan_half: float) -> float:
        """Irradiance of any unmasked sensor point by light of more than one reflection: exact."""
        wall = self.flux() * self.rho / (4 * np.pi * self.radius**2 * (1 - self.rho))
        return self.rho / np.pi * wall * solid_angle(tan_half)

    def direct(self) -> float:
        """Irradiance at the sensor's centre by light of one reflection, rho scale  integral of z n.(-x) / r^4 dp dq."""
        (p, dp), (q, dq) = gauss(*WIDE, 24), gauss(*TALL, 24)
        direction = np.stack(np.broadcast_arrays(p[:, None], q[None, :], 1.0))
        squared = (direction**2).sum(axis=0)
        start = np.array([PROJECTOR_X, 0.0, -self.centre])[:, None, None]
        along = (start * direction).sum(axis=0)
        reach = (-along + np.sqrt(along**2 - squared * ((start**2).sum() - self.radius**2))) / squared
        normal = -(start + reach * direction) / self.radius
        point = start + reach * direction + np.array([0.0, 0.0, self.centre])[:, None, None]
        seen = point[2] * -(normal * point).sum(axis=0) / (point**2).sum(axis=0) ** 2
        return float(self.rho * SCALE * dp @ seen @ dq)

"""Scenes whose caustics are seen over mirrors or curved glass, and how much of that light there is, in float64.

No tracer finds such light: from the projector over mirrors to a wall, and from the wall over mirrors to the camera. The
judge here shares no code with mitsim. It follows rays of a grid over the projector's window, and rays of a grid over
the camera's view, to the walls, and multiplies both in squares of the walls: the integral over a wall of the light that
comes to each square by how much of it the sensor's centre sees.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
SCALE, FOV, PIXELS, PITCH = 151250.0, 44.0, 32, 0.18752
GLASS, DEPTH, FAINTEST = 1.5, 8, 1e-4
"""Refractive index, surfaces that a ray may meet, and the part of its light below which it ends."""


@dataclass(frozen=True)
class Shape:
    """A ``rectangle`` of half sides, turned about y, or a ``sphere`` of a radius; ``matt`` (0.7), ``mirror``, ``glass``
    or a ``pane``: both faces of a flat pane of glass, whose normals point out of it."""

    kind: str
    material: str
    centre: tuple[float, float, float]
    size: tuple[float, ...]
    turn: float = 0.0

    @property
    def axes(self) -> Array:
        c, s = np.cos(np.radians(self.turn)), np.sin(np.radians(self.turn))
        return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])

    def meet(self, origin: Array, way: Array) -> tuple[Array, Array]:
        """Distances (k,), inf where there is none, and normals (k, 3) there."""
        local, along = (origin - self.centre) @ self.axes, way @ self.axes
        if self.kind == "sphere":
            b, c = (local * along).sum(1), (local**2).sum(1) - self.size[0] ** 2
            root = np.sqrt(np.maximum(b**2 - c, 0))
            near, far = -b - root, -b + root
            t = np.where(near > 1e-6, near, np.where(far > 1e-6, far, np.inf))
            t[b**2 < c] = np.inf
            normal = (local + np.where(np.isfinite(t), t, 0)[:, None] * along) / self.size[0]
        else:
            with np.errstate(divide="ignore", invalid="ignore"):
                t = -local[:, 2] / along[:, 2]
                place = local + t[:, None] * along
                inside = (t > 1e-6) & (np.abs(place[:, 0]) < self.size[0]) & (np.abs(place[:, 1]) < self.size[1])
            t = np.where(inside, t, np.inf)
            normal = np.broadcast_to([0.0, 0.0, 1.0], local.shape)
        return t, normal @ self.axes.T

    @property
    def xml(self) -> str:
        """Of a stock scene."""
        paint = '<bsdf type="diffuse"><spectrum name="reflectance" value="0.7"/></bsdf>'
        metal = '<bsdf type="conductor"><string name="material" value="none"/></bsdf>'
        material = {
            "matt": f'<bsdf type="twosided">{paint}</bsdf>',
            "mirror": f'<bsdf type="twosided">{metal}</bsdf>',
        }.get(self.material, f'<bsdf type="dielectric"><float name="int_ior" value="{GLASS}"/>'
              '<float name="ext_ior" value="1"/></bsdf>')  # fmt: skip
        x, y, z = self.centre
        if self.kind == "sphere":
            place = f'<point name="center" x="{x}" y="{y}" z="{z}"/><float name="radius" value="{self.size[0]}"/>'
        else:
            place = (
                f'<transform name="to_world"><scale x="{self.size[0]}" y="{self.size[1]}"/>'
                f'<rotate y="1" angle="{self.turn}"/><translate x="{x}" y="{y}" z="{z}"/></transform>'
            )
        return f'<shape type="{self.kind}">{place}{material}</shape>'


@dataclass(frozen=True)
class Hidden:
    """A scene: its shapes, and the projector's place, what it looks at, and its field of view [degrees]."""

    shapes: tuple[Shape, ...]
    origin: tuple[float, float, float] = (60, 0, 0)
    target: tuple[float, float, float] = (-40, 0, 320)
    fov: float = 12.0

    def write(self, folder: Path, name: str) -> Path:
        """The scene's file, and its white picture."""
        from skimage.io import imsave

        imsave(folder / "projector.png", np.full((16, 16), 255, np.uint8), check_contrast=False)
        (x, y, z), (u, v, w) = self.origin, self.target
        text = f"""<?xml version="1.0" encoding="utf-8"?>
<scene version="3.0.0">
<integrator type="path"/>
<sensor type="mitsim_lensless" id="camera"><float name="pixel_pitch" value="{PITCH}"/>
<string name="mask" value="open"/><integer name="mask_order" value="8"/><float name="mask_feature" value="0.12"/>
<float name="mask_distance" value="2"/><float name="scene_distance" value="400"/><float name="fov" value="{FOV}"/>
<film type="hdrfilm"><integer name="width" value="{PIXELS}"/><integer name="height" value="{PIXELS}"/>
<rfilter type="box"/><string name="pixel_format" value="luminance"/>
<string name="component_format" value="float32"/></film><sampler type="independent"/></sensor>
<emitter type="projector" id="projector"><transform name="to_world">
<lookat origin="{x},{y},{z}" target="{u},{v},{w}" up="0,1,0"/></transform><string name="fov_axis" value="x"/>
<float name="fov" value="{self.fov}"/><float name="scale" value="{SCALE}"/>
<texture name="irradiance" type="bitmap"><string name="filename" value="projector.png"/>
<boolean name="raw" value="true"/><string name="filter_type" value="nearest"/>
<string name="wrap_mode" value="clamp"/></texture></emitter>
{"".join(shape.xml for shape in self.shapes)}
</scene>
"""
        path = folder / f"{name}.xml"
        path.write_text(text, encoding="utf-8")
        return path

    def light(self, rays: int = 1000, squares: int = 100) -> float:
        """Irradiance at the sensor's centre of light that mirrors or glass turn before and after a wall [W m^-2].

        ``rays`` go over the side of window and view, ``squares`` over that of a wall.
        """
        rng = np.random.default_rng(1)
        tan = np.tan(np.radians(self.fov / 2))
        grid = self._grid(rng, rays, tan)
        ahead = np.subtract(self.target, self.origin)
        ahead = ahead / np.linalg.norm(ahead)
        aside = np.cross([0.0, 1, 0], ahead)
        aside /= np.linalg.norm(aside)
        ways = grid @ np.stack([aside, np.cross(ahead, aside), ahead])
        flux = np.full(len(grid), np.pi * SCALE * (2 * tan / rays) ** 2)
        brought = self._follow(np.asarray(self.origin, dtype=float), ways, flux, squares)
        stop = np.tan(np.radians(FOV / 2))
        grid = self._grid(rng, rays, stop)
        seen = self._follow(np.zeros(3), grid, (2 * stop / rays) ** 2 / (grid**2).sum(1) ** 2, squares)
        total = 0.0
        for number, one in brought.items():
            if number in seen:
                area = 4 * self.shapes[number].size[0] * self.shapes[number].size[1] / squares**2
                total += 0.7 / np.pi * float((one * seen[number]).sum()) / area
        return total

    @staticmethod
    def _grid(rng: np.random.Generator, rays: int, tan: float) -> Array:
        x, y = ((np.arange(rays) + rng.random(rays)) / rays * 2 - 1 for _ in range(2))
        return np.stack([*(part.ravel() * tan for part in np.meshgrid(x, y)), np.ones(rays**2)], axis=1)

    def _follow(self, origin: Array, ways: Array, weight: Array, squares: int) -> dict[int, Array]:
        """What lands on matt rectangles after a turn, by the rectangle's number: (2 sides, squares, squares)."""
        way = ways / np.linalg.norm(ways, axis=1, keepdims=True)
        found: dict[int, Array] = {}
        batch = [
            (np.broadcast_to(origin, way.shape), way, weight, np.zeros(len(way), bool), np.full(len(way), weight.max()))
        ]
        for _ in range(DEPTH):
            following = []
            for at, to, light, turned, unit in batch:
                met = [shape.meet(at, to) for shape in self.shapes]
                first = np.argmin([t for t, _ in met], axis=0)
                for number, (shape, (t, normals)) in enumerate(zip(self.shapes, met, strict=True)):
                    own = (first == number) & np.isfinite(t)
                    if not own.any():
                        continue
                    place, d, normal = at[own] + t[own, None] * to[own], to[own], normals[own]
                    if shape.material == "matt":
                        local = (place - shape.centre) @ shape.axes
                        cell = np.floor((local[:, :2] / shape.size + 1) / 2 * squares).astype(int).clip(0, squares - 1)
                        side = ((d * normal).sum(1) > 0).astype(int)
                        sums = found.setdefault(number, np.zeros((2, squares, squares)))
                        np.add.at(sums, (side, *cell.T), light[own] * turned[own])
                        continue
                    cosine = (d * normal).sum(1)
                    mirror = d - 2 * cosine[:, None] * normal
                    if shape.material == "mirror":
                        following.append((place, mirror, light[own], np.ones(own.sum(), bool), unit[own]))
                        continue
                    eta = np.where(cosine < 0, GLASS, 1 / GLASS)
                    facing = -np.sign(cosine)[:, None] * normal
                    inside = 1 - (1 - cosine**2) / eta**2
                    other = np.sqrt(np.maximum(inside, 0))
                    bent = d / eta[:, None] + (np.abs(cosine) / eta - other)[:, None] * facing
                    c = np.abs(cosine)
                    part = (
                        ((c - eta * other) / (c + eta * other)) ** 2 + ((eta * c - other) / (eta * c + other)) ** 2
                    ) / 2
                    part = np.where(inside > 0, part, 1.0)
                    after = turned[own] | (shape.material == "glass")
                    following.append((place, mirror, light[own] * part, np.ones(own.sum(), bool), unit[own]))
                    following.append((place, bent, light[own] * (1 - part), after, unit[own]))
            batch = []
            for ray in following:
                kept = ray[2] > FAINTEST * ray[4]
                if kept.any():
                    batch.append(tuple(part[kept] for part in ray))
        return found


def rectangle(material: str, x: float, z: float, half: float | tuple[float, float], turn: float = 180.0) -> Shape:
    sides = half if isinstance(half, tuple) else (half, half)
    return Shape("rectangle", material, (x, 0.0, z), sides, turn)


def ball(material: str, x: float, z: float, radius: float, y: float = 0.0) -> Shape:
    return Shape("sphere", material, (x, y, z), (radius,))


def pane(z: float, half: float, thickness: float = 6.0) -> tuple[Shape, Shape]:
    """Both large faces of a pane; light through its edges is left out by all."""
    return rectangle("pane", 0, z, half, 180.0), rectangle("pane", 0, z + thickness, half, 0.0)


WALL, SIDE = rectangle("matt", 0, 430, 130), rectangle("mirror", -40, 315, 100, 90.0)
"""A wall across the view, and a mirror along it, as in the unit tests of light that is left out."""
SCENES = {
    "own mirror": Hidden(
        (rectangle("mirror", 25, 400, 30, 215), rectangle("matt", -50, 400, 60, 150)), (90, 0, 0), (25, 0, 400), 8
    ),
    "mirror along a wall": Hidden((WALL, SIDE)),
    "another mirror": Hidden((WALL, SIDE, rectangle("mirror", 70, 315, 100, -90.0))),
    "mirror ball, in a mirror": Hidden(
        (WALL, rectangle("mirror", 70, 315, 100, -90.0), ball("mirror", -20, 330, 20)), target=(-20, 0, 330), fov=6
    ),
    "in a mirror ball": Hidden((WALL, SIDE, ball("mirror", 40, 330, 25))),
    "glass ball, in itself": Hidden((WALL, ball("glass", 0, 330, 30)), target=(0, 0, 330), fov=10),
    "glass ball, in a mirror ball": Hidden(
        (WALL, ball("glass", -20, 350, 20), ball("mirror", 40, 340, 20)), target=(-20, 0, 350), fov=8
    ),
    "through a glass ball": Hidden((WALL, SIDE, ball("glass", 0, 300, 25))),
    "twice reflected": Hidden(
        (WALL, rectangle("mirror", -60, 330, 60, 90.0), rectangle("mirror", 60, 330, 60, -90.0)),
        (0, 0, 0),
        (-60, 0, 250),
        8,
    ),
    "through a pane": Hidden((WALL, SIDE, rectangle("mirror", 70, 315, 100, -90.0), *pane(200, 160))),
    "in a small mirror": Hidden((WALL, SIDE, rectangle("mirror", 40, 330, 8, -97.0))),
}
"""By name: what is seen, and where."""

"""Nothing in, triangle meshes out: the bodies of the shipped scenes that are no rectangle, as binary PLY.

A body's frame has x to the LEFT, y up and z away from who looks at it, like the camera's. Its pictures have row 0 on
top and column 0 at the left: u grows with -x, v with -y, as Mitsuba lays a bitmap out. Triangles run counterclockwise
as seen from outside. Coordinates are rounded to 1/1024 mm, exact in float32, so that no platform's last bit shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
Faces = NDArray[np.int32]

BAG_WIDTH, BAG_HEIGHT, BAG_BULGE = 76.0, 100.0, 16.0
BAG_CRIMPS = (4.0, 8.0)  # height of the flat seams below and above the body
CORNER_REACH, CORNER_HEIGHT = 84.853, 200.0  # 120 mm / sqrt 2 along x and z
BOX_SIZE = (44.0, 48.0, 36.0)
BLADE_LENGTH, BLADE_BODY, BLADE_BEVEL = 92.0, 26.0, 12.0
BLADE_THICKNESS, BLADE_DROP = 4.0, 3.2  # the bevel falls back by 3.2 over 12 mm: 14.9 degrees


@dataclass(frozen=True, eq=False)
class Mesh:
    """Vertices (n, 3) mm, texture coordinates (n, 2) and triangles (m, 3)."""

    points: Points
    uv: Points
    faces: Faces

    def ply(self) -> bytes:
        """The mesh as a binary PLY file."""
        vertices = np.empty(len(self.points), dtype=[(name, "<f4") for name in ("x", "y", "z", "u", "v")])
        for name, column in zip("xyz", np.rint(self.points * 1024).T / 1024 + 0.0, strict=True):
            vertices[name] = column
        for name, column in zip("uv", np.rint(self.uv * 65536).T / 65536 + 0.0, strict=True):
            vertices[name] = column
        triangles = np.empty(len(self.faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
        triangles["count"], triangles["index"] = 3, self.faces
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
        header += [f"property float {name}" for name in vertices.dtype.names or ()]
        header += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header", ""]
        return "\n".join(header).encode("ascii") + vertices.tobytes() + triangles.tobytes()


def corner() -> Mesh:
    """Two walls of 120 x 200 mm that meet at a right angle, the edge on the y axis, open toward -z at 45 degrees each.

    One mesh, because Mitsuba merges two rectangles of one material and then loses the scene's bounding box.
    """
    r, h = CORNER_REACH, CORNER_HEIGHT / 2
    left = [(r, h, -r), (0, h, 0), (0, -h, 0), (r, -h, -r)]
    right = [(0, h, 0), (-r, h, -r), (-r, -h, -r), (0, -h, 0)]
    uv = np.array([(0, 0), (0.5, 0), (0.5, 1), (0, 1), (0.5, 0), (1, 0), (1, 1), (0.5, 1)])
    return Mesh(np.array(left + right, dtype=np.float64), uv, _quads(2))


def cookie_bag() -> Mesh:
    """A closed bag of 76 x 100 mm, bottom seam at y = 0, that bulges by 16 mm to either side of z = 0.

    Half its thickness is 0.4 + 16 (1 - s^4)(1 - t^4) mm plus wrinkles near the seams, s and t running -1 to 1 over the
    body; the seams are flat strips of 0.8 mm with ripples along y. The front and the back carry the same picture.
    """
    low, high = BAG_CRIMPS
    body = BAG_HEIGHT - low - high
    y = np.concatenate(
        [np.arange(0, low, 0.5), np.arange(low, low + body, 2.0), np.arange(low + body, BAG_HEIGHT + 0.25, 0.5)]
    )
    s = np.arange(-19, 20) / 19.0
    t = np.clip(2 * (y - low) / body - 1, -1, 1)[:, None]
    seam = (y < low) | (y > low + body)
    ripple = np.where(seam, np.array([0.0, 0.5, 0.0, -0.5])[np.rint(y / 0.5).astype(int) % 4], 0.0)[:, None]
    # Wrinkles: four waves across (a triangle wave's square, smooth at its zeros), strongest 1/12 away from a seam.
    wave = 1 - 2 * np.abs((2 * s + 0.25) % 1 - 0.5)
    fold = 6.0 * (wave * wave - 0.33) * t**8 * (1 - t**8) * (1 - s**4)
    half = 0.4 + BAG_BULGE * (1 - s**4) * (1 - t**4) + fold
    x = BAG_WIDTH / 2 * s * (1 - 0.06 * (1 - t * t))  # a filled bag draws its sides in
    rows = np.broadcast_to(y[:, None], half.shape)
    front = np.stack([x, rows, ripple - half], axis=-1).reshape(-1, 3)
    back = np.stack([x, rows, ripple + half], axis=-1).reshape(-1, 3)
    uv = np.stack([0.5 - front[:, 0] / BAG_WIDTH, 1 - front[:, 1] / BAG_HEIGHT], axis=-1)
    index = np.arange(len(front), dtype=np.int32).reshape(half.shape)
    ahead, behind = index, index + np.int32(len(front))
    strips = [
        np.stack([ahead[edge], behind[edge]]) for edge in (np.s_[0], np.s_[:, -1], np.s_[-1, ::-1], np.s_[::-1, 0])
    ]
    # With x to the left, rows up and s along +x, a front cell is counterclockwise to the camera as it stands.
    faces = [_cells(ahead[:, ::-1]), _cells(behind), *(_cells(strip) for strip in strips)]
    return Mesh(np.concatenate([front, back]), np.concatenate([uv, uv]), np.concatenate(faces))


def box() -> Mesh:
    """A closed box of 44 x 48 x 36 mm, its bottom's middle at the origin, vertices apart for each face.

    Its picture, 80 x 84 mm, has the front (44 x 48) top left, beside it the left side (36 x 48), below it the top
    (44 x 36) and in the last corner plain board for the right side, the back and the bottom, which no camera in front
    sees.
    """
    wide, h, deep = BOX_SIZE
    w, d = wide / 2, deep / 2
    front, side, top, plain = ((0, 0, wide, h), (wide, 0, deep, h), (0, h, wide, deep), (wide, h, deep, deep))
    # Each face: its corners as seen from outside, clockwise from the top left one; its part of the picture.
    sides: list[tuple[list[tuple[float, float, float]], tuple[float, float, float, float]]] = [
        ([(w, h, -d), (-w, h, -d), (-w, 0, -d), (w, 0, -d)], front),
        ([(w, h, d), (w, h, -d), (w, 0, -d), (w, 0, d)], side),
        ([(w, h, d), (-w, h, d), (-w, h, -d), (w, h, -d)], top),
        ([(-w, h, -d), (-w, h, d), (-w, 0, d), (-w, 0, -d)], plain),
        ([(-w, h, d), (w, h, d), (w, 0, d), (-w, 0, d)], plain),
        ([(w, 0, -d), (-w, 0, -d), (-w, 0, d), (w, 0, d)], plain),
    ]
    across, down = np.array([0, 1, 1, 0]), np.array([0, 0, 1, 1])
    uv = np.concatenate(
        [
            np.stack([(x + across * width) / (wide + deep), (y + down * height) / (h + deep)], axis=-1)
            for _, (x, y, width, height) in sides
        ]
    )
    return Mesh(np.array([point for corners, _ in sides for point in corners]), uv, _quads(len(sides)))


def block() -> Mesh:
    """The box, whose longest side is 1, as a user's mesh has before a scene scales it."""
    whole = box()
    return Mesh(whole.points / max(BOX_SIZE), whole.uv, whole.faces)


def blade() -> Mesh:
    """A closed blade, 92 mm along x with a slanted tip at the right, 38 mm tall: a flat body (y from 0 to 26) whose
    front is at z = -2, and below it a bevel to an edge at y = -12. The picture covers x from -46 to 46, y from -12 to
    26.
    """
    left, right = BLADE_LENGTH / 2, -BLADE_LENGTH / 2
    top, edge, front = BLADE_BODY, -BLADE_BEVEL, -BLADE_THICKNESS / 2
    rear = front + BLADE_DROP
    section = [(top, front), (0.0, front), (edge, rear), (top, rear)]

    def tip(y: float) -> float:
        return right + 0.5 * (y - edge)

    sides = []
    for (y0, z0), (y1, z1) in zip(section, section[1:] + section[:1], strict=True):
        sides.append([(left, y0, z0), (tip(y0), y0, z0), (tip(y1), y1, z1), (left, y1, z1)])
    profile = [(y, z) for y, z in section]
    sides.append([(tip(y), y, z) for y, z in (profile[0], profile[3], profile[2], profile[1])])
    sides.append([(left, y, z) for y, z in profile])
    points = np.array([point for corners in sides for point in corners])
    uv = np.stack([(left - points[:, 0]) / (left - right), (top - points[:, 1]) / (top - edge)], axis=-1)
    return Mesh(points, uv, _quads(len(sides)))


def flat(tiles: Sequence[tuple[float, float, float, float]]) -> Mesh:
    """Tiles in the plane z = 0 that face -z, each by its top (y), left (x), bottom (y) and right (x)."""
    corners = [
        [(x, y, 0) for x, y in ((left, top), (right, top), (right, bottom), (left, bottom))]
        for top, left, bottom, right in tiles
    ]
    uv = np.tile([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], (len(tiles), 1))
    return Mesh(np.array(corners, dtype=np.float64).reshape(-1, 3), uv, _quads(len(tiles)))


def _quads(count: int) -> Faces:
    """(2 count, 3) triangles: every four vertices, clockwise as seen from outside, are one face."""
    first = 4 * np.arange(count, dtype=np.int32)[:, None]
    return np.asarray(np.concatenate([first + [0, 2, 1], first + [0, 3, 2]]), dtype=np.int32)


def _cells(index: Faces | Sequence[Faces]) -> Faces:
    """(2 cells, 3) triangles between neighbouring rows and columns of an index grid (n, m)."""
    grid = np.asarray(index)
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    return np.concatenate([np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))])

"""Scenes of the third judge's shapes: drawn by a seeded generator or by hand, written as XML, and held against mitsim.

:func:`scenes` gives 30 of them by name. Each lies in the camera's frame; ``moved`` puts all devices elsewhere in its
file. mitsim renders without ``interreflection``, diffraction and black level, which the judge does not have.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.signal import max_len_seq
from skimage.io import imsave

from tests.physics import third_judge as judge
from tests.physics.third_judge import Array, Camera, Cylinder, Projector, Rectangle, Scene, Shape, Slab, Sphere, vector

if TYPE_CHECKING:
    from mitsim.api.bench import Bench

N, SCALE = 64, 151250.0
PROJECTOR = Projector(vector(60, 0, 0), N, SCALE, -0.3, 0.0, -0.15, 0.15)
OPEN = Camera(128, 0.04688, feature=0.12)
CODED = replace(OPEN, code=np.asarray(max_len_seq(8)[0], dtype=np.float64))
POINTS = [(i, j) for i in range(6, 128, 38) for j in range(8, 128, 37)]
"""16 sensor pixels, spread evenly."""
CAMERA_FILE = """name = "128 pixels of 46.88 um"
pixel_pitch_um = 11.72
binning = 4
full_well_e = 32360.0
read_noise_e = 6.7
dark_current_e_per_s = 1.5
quantum_efficiency = 0.75
gain_dn_per_e = 0.125
black_level_dn = 40.0
bits = 12
source = "test"
"""
LEFT_OUT = {"interreflection": False, "diffraction": False, "black-level": False}
"""Effects that the judge does not have."""


@dataclass(frozen=True)
class Judged:
    """A scene, rays a side that settle it (see :func:`tests.physics.third_judge.answer`), and where its devices
    stand."""

    scene: Scene
    k: int = 4
    fine: int = 0
    moved: tuple[float, float, float] = (0, 0, 0)


@dataclass(frozen=True)
class Texels:
    """A picture of 8 bits over a rectangle, nearest texel: row 0 at v = -1, column 0 at u = -1."""

    values: tuple[tuple[int, ...], ...]

    def __call__(self, u: Array, v: Array) -> Array:
        array = np.array(self.values) / 255
        rows, columns = array.shape
        i = np.clip(((np.nan_to_num(v) + 1) / 2 * rows).astype(int), 0, rows - 1)
        j = np.clip(((np.nan_to_num(u) + 1) / 2 * columns).astype(int), 0, columns - 1)
        return np.asarray(array[i, j])


@dataclass(frozen=True)
class Holes:
    """Where a picture is black."""

    texels: Texels

    def __call__(self, u: Array, v: Array) -> Any:
        return self.texels(u, v) < 0.5


def picture(seed: int, side: int, low: int = 30, high: int = 240) -> Texels:
    values = np.random.default_rng(seed).integers(low, high, (side, side))
    return Texels(tuple(map(tuple, values.tolist())))


# ---- XML


def _bitmap(name: str, file: str) -> str:
    return (
        f'<texture name="{name}" type="bitmap"><string name="filename" value="{file}"/><boolean name="raw" '
        'value="true"/><string name="filter_type" value="nearest"/><string name="wrap_mode" value="clamp"/></texture>'
    )


def _material(shape: Shape, folder: Path, name: str) -> str:
    if shape.mirror:
        inner = (
            '<bsdf type="conductor"><string name="material" value="none"/><spectrum name="specular_reflectance" '
            f'value="{shape.mirror!r}"/></bsdf>'
        )
    elif isinstance(shape.albedo, Texels):
        imsave(folder / f"{name}.png", np.array(shape.albedo.values, dtype=np.uint8), check_contrast=False)
        inner = f'<bsdf type="diffuse">{_bitmap("reflectance", name + ".png")}</bsdf>'
    else:
        inner = f'<bsdf type="diffuse"><spectrum name="reflectance" value="{shape.albedo!r}"/></bsdf>'
    inner = f'<bsdf type="twosided">{inner}</bsdf>'
    if isinstance(shape, Rectangle) and isinstance(shape.open, Holes):
        imsave(folder / f"{name}_open.png", np.array(shape.open.texels.values, dtype=np.uint8), check_contrast=False)
        inner = f'<bsdf type="mask">{_bitmap("opacity", name + "_open.png")}{inner}</bsdf>'
    return inner


def _matrix(columns: Sequence[Array]) -> str:
    matrix = np.eye(4)
    for i, column in enumerate(columns):
        matrix[:3, i] = column
    return '<matrix value="' + " ".join(repr(float(number)) for number in matrix.ravel()) + '"/>'


def _shape(shape: Shape | Slab, folder: Path, name: str, move: str) -> str:
    if isinstance(shape, Slab):
        n = shape.normal
        side = np.cross(vector(0, 1, 0), n)
        side = side / np.linalg.norm(side)
        place = _matrix([150 * side, 150 * np.cross(n, side), shape.thickness / 2 * n, shape.centre])
        glass = f'<float name="int_ior" value="{shape.index}"/><float name="ext_ior" value="1"/>'
        bsdf = f'<bsdf type="dielectric">{glass}</bsdf>'
        return f'<shape type="cube"><transform name="to_world">{place}{move}</transform>{bsdf}</shape>'
    bsdf, world = _material(shape, folder, name), f'<transform name="to_world">{move}</transform>'
    if isinstance(shape, Rectangle):
        n = np.cross(shape.half_u, shape.half_v)
        place = _matrix([shape.half_u, shape.half_v, n / np.linalg.norm(n), shape.centre])
        return f'<shape type="rectangle"><transform name="to_world">{place}{move}</transform>{bsdf}</shape>'

    def point(name: str, p: Array) -> str:
        x, y, z = (repr(float(number)) for number in p)
        return f'<point name="{name}" x="{x}" y="{y}" z="{z}"/>'

    radius = f'<float name="radius" value="{shape.radius!r}"/>{world}{bsdf}'
    if isinstance(shape, Sphere):
        return f'<shape type="sphere">{point("center", shape.centre)}{radius}</shape>'
    return f'<shape type="cylinder">{point("p0", shape.p0)}{point("p1", shape.p1)}{radius}</shape>'


def write(judged: Judged, folder: Path) -> Path:
    """The scene file of a judged scene, with its pictures and the camera file ``cam.toml`` beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    scene, camera, projector = judged.scene, judged.scene.camera, judged.scene.projector
    (folder / "cam.toml").write_text(CAMERA_FILE, encoding="utf-8")
    canvas = np.zeros((projector.n, 2 * projector.n), dtype=np.uint8)
    canvas[:, projector.n :] = 255
    imsave(folder / "projector.png", canvas, check_contrast=False)
    x, y, z = judged.moved
    move = f'<translate x="{x}" y="{y}" z="{z}"/>' if any(judged.moved) else ""
    mask = "open" if camera.code is None else "separable"
    integrator = "volpath" if any(isinstance(one, Rectangle) and one.open for one in scene.shapes) else "path"
    px, py, pz = projector.place
    shapes = "\n".join(
        _shape(one, folder, f"shape{i}", move) for i, one in enumerate([*scene.shapes, *filter(None, [scene.pane])])
    )
    (folder / "scene.xml").write_text(
        f"""<scene version="3.0.0">
<integrator type="{integrator}"><integer name="max_depth" value="2"/></integrator>
<sensor type="mitsim_lensless"><transform name="to_world">{move}</transform>
<float name="pixel_pitch" value="{camera.pitch}"/><string name="mask" value="{mask}"/>
<integer name="mask_order" value="8"/><float name="mask_feature" value="{camera.feature}"/>
<float name="mask_distance" value="{camera.distance}"/><float name="scene_distance" value="400"/>
<float name="fov" value="{camera.fov}"/>
<film type="hdrfilm"><integer name="width" value="{camera.pixels}"/><integer name="height" value="{camera.pixels}"/>
<rfilter type="box"/><string name="pixel_format" value="luminance"/><string name="component_format" value="float32"/>
</film><sampler type="independent"/></sensor>
<emitter type="projector"><transform name="to_world"><translate x="{px}" y="{py}" z="{pz}"/>{move}</transform>
<string name="fov_axis" value="x"/><float name="fov" value="33.398488"/><float name="scale" value="{projector.scale}"/>
{_bitmap("irradiance", "projector.png")}</emitter>
{shapes}
</scene>
""",
        encoding="utf-8",
    )
    return folder / "scene.xml"


# ---- scenes


def sheet(z: float, albedo: float | Texels = 0.7, half: float = 90.0) -> Rectangle:
    return Rectangle(vector(0, 0, z), vector(half, 0, 0), vector(0, half, 0), albedo)


def rods(seed: int, count: int, radius: float, near: float, far: float, albedo: float = 1.0) -> list[Shape]:
    """Straight ones in all directions across the view, each as likely at every distance."""
    rng = np.random.default_rng(seed)
    found: list[Shape] = []
    for _ in range(count):
        z, angle = rng.uniform(near, far), rng.uniform(0, np.pi)
        x, y = rng.uniform(-0.1, 0.1, 2) * z
        along = vector(np.cos(angle), np.sin(angle), rng.uniform(-0.3, 0.3)) * 0.12 * z
        found.append(Cylinder(vector(x, y, z) - along, vector(x, y, z) + along, radius, albedo))
    return found


def balls(seed: int, count: int, radius: float, near: float, far: float, mirror: float = 0.0) -> list[Shape]:
    rng = np.random.default_rng(seed)
    found: list[Shape] = []
    for _ in range(count):
        z = rng.uniform(near, far)
        x, y = rng.uniform(-0.1, 0.1, 2) * z
        found.append(Sphere(vector(x, y, z), radius, 0.9, mirror))
    return found


def tilted(degrees: float, about_x: float = 0.0) -> Array:
    a, b = np.radians(degrees), np.radians(about_x)
    return vector(np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b))


def card(centre: Array, half: float, normal: Array, albedo: float | Texels, cut: Texels | None = None) -> Rectangle:
    side = np.cross(vector(0, 1, 0), normal)
    side = side / np.linalg.norm(side)
    return Rectangle(centre, half * side, half * np.cross(normal, side), albedo, 0.0, Holes(cut) if cut else None)


def drawn(seed: int) -> Judged:
    """A printed sheet with some things before it."""
    rng = np.random.default_rng((813, seed))
    z = rng.uniform(370, 440)
    shapes: list[Shape] = [sheet(z, picture(seed, int(rng.integers(5, 40))))]
    paned = rng.random() < 0.35
    for _ in range(rng.integers(1, 7)):
        depth = rng.uniform(200, z - 30)
        place = vector(*(rng.uniform(-0.1, 0.1, 2) * depth), depth)
        kind = rng.integers(4)
        radius = float(np.exp(rng.uniform(np.log(0.05), np.log(18))))
        albedo = float(rng.uniform(0.05, 0.95))
        if kind == 0:
            shapes.append(Sphere(place, radius, albedo))
        elif kind == 1:
            along = vector(*rng.normal(size=2), 0.3 * rng.normal()) * rng.uniform(10, 40)
            shapes.append(Cylinder(place - along, place + along, float(np.clip(radius, 1.5, 6.0)), albedo))
        elif kind == 2:
            cut = picture(int(rng.integers(1000)), 7, 0, 255)
            binary = Texels(tuple(tuple(255 * (value > 127) for value in row) for row in cut.values))
            shapes.append(card(place, rng.uniform(5, 25), tilted(*rng.uniform(-30, 30, 2)), albedo, binary))
        elif paned:
            shapes.append(card(place, rng.uniform(5, 20), tilted(*rng.uniform(-50, 50, 2)), albedo))
        else:
            shapes.append(Sphere(place, radius, 0.5, mirror=float(rng.uniform(0.5, 1))))
    pane = Slab(vector(0, 0, 120), tilted(*rng.uniform(-35, 35, 2)), rng.uniform(1, 8)) if paned else None
    camera = CODED if rng.random() < 0.5 else OPEN
    return Judged(Scene(PROJECTOR, camera, shapes, pane), k=5, fine=20)


def _by_hand() -> dict[str, Judged]:
    def of(*shapes: Shape, camera: Camera = OPEN, pane: Slab | None = None, **rest: Any) -> Judged:
        return Judged(Scene(PROJECTOR, camera, shapes, pane), **rest)

    leaf = Texels(tuple(tuple(255 * ((i * 7 + j * 3) % 5 < 2) for j in range(9)) for i in range(9)))
    glass = Slab(vector(0, 0, 398), vector(0, 0, 1), 4.0)
    print_ = picture(5, 30)
    return {
        "rods, coded": of(*rods(2, 25, 1.5, 90, 420), camera=CODED, fine=24),
        "rods before a wall": of(sheet(440, 0.1), *rods(4, 12, 1.5, 150, 420), k=6, fine=30),
        "balls of 0.05 mm at 1 m": of(sheet(1060, 0.1, 400), *balls(5, 20, 0.05, 950, 1050), fine=40),
        "mirror balls of 0.4 mm": of(sheet(460, 0.03, 110), *balls(6, 30, 0.4, 360, 400, mirror=0.85)),
        "print 0.03 mm behind glass": of(sheet(400.03, print_, 85), pane=glass),
        "print 0.005 mm behind glass": of(sheet(400.005, print_, 85), pane=glass),
        "glass at 60 degrees": of(
            sheet(420, print_), pane=Slab(vector(0, 0, 180), tilted(60), 5.0, 1.6), camera=CODED
        ),
        "leaf behind leaf": of(
            sheet(430, print_), card(vector(5, 3, 380), 40, tilted(10), 0.4, leaf),
            card(vector(-10, -5, 300), 30, tilted(-20, 15), 0.8, leaf), k=6, fine=20,
        ),
        "devices 300 m away": of(
            sheet(440, print_), Sphere(vector(15, 5, 375), 20.0, 0.6), camera=CODED, fine=16, moved=(3e5, -3e5, 3e5)
        ),
        "rods 1 km away": of(*rods(7, 25, 1.5, 90, 420), fine=24, moved=(-1e6, 2e5, 1e6)),
    }  # fmt: skip


@functools.cache
def scenes() -> dict[str, Judged]:
    """The thirty, by name."""
    hand = _by_hand()
    return {**hand, **{f"drawn {seed}": drawn(seed) for seed in range(30 - len(hand))}}


# ---- verdicts


@dataclass(frozen=True)
class Verdict:
    """Relative difference (rms over shots and points) between mitsim and the judge, of their sums, and what both state.

    ``bound`` is mitsim's own but for effects that were left out, ``uncertain`` the judge's error, ``warnings`` why
    mitsim's run is flagged, ``right`` the judge's sum [W m^-2] over all points in uniform light.
    """

    difference: float
    total: float
    bound: float
    uncertain: float
    warnings: tuple[str, ...]
    right: float

    @property
    def agrees(self) -> bool:
        return self.difference <= self.bound + self.uncertain


def opened(judged: Judged, folder: Path, open_bench: Callable[..., Bench]) -> Bench:
    return open_bench(write(judged, folder), camera=folder / "cam.toml")


def verdict(judged: Judged, bench: Bench, patterns: str = "dots:3", accuracy: float = 1e-2, seed: int = 0) -> Verdict:
    """Frames of a family by the factored estimator against the judge's."""
    light = bench.light(patterns, accuracy=accuracy, seed=seed, effects=LEFT_OUT)
    lighting = bench.family(patterns, seed).lighting
    rows, columns = np.array(POINTS).T
    ours = np.array([frame.irradiance[rows, columns] for frame in light.frames(lighting, 0)])
    right = judge.answer(judged.scene, POINTS, lighting.labels, judged.k, judged.fine)
    frames = lighting.weights @ right.light
    difference = float(np.linalg.norm(ours - frames) / np.linalg.norm(frames))
    warnings = (*light.warnings, *light.unreached)
    total = float(ours.sum() / frames.sum() - 1)
    # What the judge lacks too is no part of it; the plan adds its errors as energies.
    left_out = sum((row.error_if_off or 0.0) ** 2 for row in light.plan.effects if row.name in LEFT_OUT)
    bound = float(np.sqrt(max(light.error_bound**2 - left_out, light.sampling_error**2)))
    return Verdict(difference, total, bound, right.error, warnings, float(right.light.sum()))

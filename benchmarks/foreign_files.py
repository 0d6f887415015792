"""Meshes and pictures by other programs' writers, each read right or refused in one line: a folder in, a table out.

    python benchmarks/foreign_files.py write FOLDER    # by a Python that has trimesh, meshio, open3d, imageio, tifffile
    python benchmarks/foreign_files.py read FOLDER     # by the Python of mitsim; status 1 where a file is read wrong

Writers that are not installed are left out, and named. ``FOLDER/index.json`` has the right answer of each file: area
and box of a mesh, numbers of a picture. A mesh is read in a scene and as ``-D object=``; a picture in a scene, as
``-D picture=``, by ``sense`` and as a frame. Each file has a process of its own, because a reader may end it.
"""

from __future__ import annotations

import contextlib
import io
import json
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

Faces = Sequence[Sequence[int]]
RNG = np.random.default_rng(7)
BOX = np.array([[x, y, z] for x in (0, 30) for y in (0, 20) for z in (0, 10)], dtype=float) + [1, 2, 3]
BOX_QUADS: Faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
BOX_TRIANGLES: Faces = [t for a, b, c, d in BOX_QUADS for t in ((a, b, c), (a, c, d))]
"""A box of 30 x 20 x 10."""
ARROW = np.array([[0, 0, 0], [30, 0, 0], [30, 20, 0], [15, 5, 0], [0, 20, 0]], dtype=float)
"""A polygon with a dent at its fourth corner."""
SHEET = np.array([[0, 0, 0], [20, 0, 0], [20, 20, 6], [0, 20, 0]], dtype=float)
"""A quad whose corners lie in no plane: its area is that of no triangulation alone."""
GREY = RNG.integers(0, 256, (12, 16)).astype(np.uint8)
COLOUR = np.kron(RNG.integers(0, 256, (3, 4, 3)), np.ones((8, 8, 1), int)).astype(np.uint8)
REAL = RNG.random((12, 16)).astype(np.float32)


def area_of(points: Any, faces: Faces) -> float:
    """Area of plane polygons, by Newell's formula."""
    total = 0.0
    for face in faces:
        corners = points[list(face)]
        total += float(np.linalg.norm(np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0))) / 2
    return total


class Writer:
    """Files in a folder, and the right answers about them."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.index, self.without = folder, list[dict[str, Any]](), set[str]()

    @contextlib.contextmanager
    def by(self, writer: str) -> Iterator[Any]:
        """Import a ``writer``; what needs it is left out where it is not installed."""
        try:
            yield import_module(writer)
        except ImportError:
            self.without.add(writer)

    def mesh(self, name: str, writer: str, points: Any, faces: Faces, write: Callable[[str], Any] | str) -> None:
        """Write one mesh, by a function of its path or as a text."""
        self._write(name, write)
        low, high = points[sorted({at for face in faces for at in face})].min(0), points.max(0)
        self.index.append(
            {"file": name, "writer": writer, "area": area_of(points, faces), "size": (high - low).tolist()}
        )

    def picture(
        self, name: str, writer: str, codes: Any, write: Callable[[str], Any] | bytes, most: float = 1.0, off: float = 0
    ) -> None:
        """Write one picture of ``codes``, of which ``most`` is white, to be read within ``off`` of white."""
        self._write(name, write)
        np.save(self.folder / f"{name}.npy", np.asarray(codes))
        self.index.append({"file": name, "writer": writer, "most": most, "off": off})

    def _write(self, name: str, write: Callable[[str], Any] | str | bytes) -> None:
        path = self.folder / name
        if callable(write):
            with contextlib.redirect_stdout(io.StringIO()):
                write(str(path))
        else:
            path.write_bytes(write if isinstance(write, bytes) else write.encode())


def obj(points: Any, faces: Faces, head: str = "", corner: str = "{}", after: str = "") -> str:
    """A Wavefront file as modellers write it."""
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points]
    return "\n".join([head, *lines, after, *("f " + " ".join(corner.format(at + 1) for at in f) for f in faces), ""])


def write_meshes(to: Writer) -> None:
    """Meshes by libraries, and in the manner of modellers that write Wavefront files."""
    with to.by("trimesh") as trimesh:
        box = trimesh.Trimesh(BOX, BOX_TRIANGLES, process=False)
        ball = trimesh.creation.icosphere(2, 15)
        ring = trimesh.creation.torus(20, 5)
        for name, made in (("box", box), ("ball", ball), ("ring", ring)):
            held = np.asarray(made.vertices), np.asarray(made.faces).tolist()
            for kind, extra in (
                ("ply", {}), ("ascii.ply", {"encoding": "ascii"}), ("normals.ply", {"vertex_normal": True}),
                ("obj", {}), ("normals.obj", {"include_normals": True}),
            ):  # fmt: skip
                to.mesh(f"trimesh_{name}.{kind}", "trimesh", *held, lambda p, m=made, e=extra: m.export(p, **e))
        painted = box.copy()
        painted.visual.vertex_colors = RNG.integers(0, 255, (8, 4)).astype(np.uint8)
        for kind in ("ply", "obj", "stl", "off", "glb"):
            to.mesh(f"trimesh_painted.{kind}", "trimesh", BOX, BOX_TRIANGLES, lambda p: painted.export(p))
        picture = import_module("PIL.Image").fromarray(COLOUR)
        papered = box.copy()
        papered.visual = trimesh.visual.TextureVisuals(uv=BOX[:, :2] / 40, image=picture)
        to.mesh("trimesh_papered.obj", "trimesh", BOX, BOX_TRIANGLES, lambda p: papered.export(p))
        to.mesh("trimesh_papered.ply", "trimesh", BOX, BOX_TRIANGLES, lambda p: papered.export(p))
        earcut = import_module("mapbox_earcut")
        cut = earcut.triangulate_float64(ARROW[:, :2], np.array([5], np.uint32)).reshape(-1, 3).tolist()
        flat = trimesh.Trimesh(ARROW, cut, process=False)
        to.mesh("trimesh_arrow.obj", "trimesh, earcut", ARROW, cut, lambda p: flat.export(p))
    with to.by("meshio") as meshio:
        quads, both = [("quad", BOX_QUADS)], [("triangle", BOX_TRIANGLES[:6]), ("quad", BOX_QUADS[3:])]
        for name, cells in (("triangles", [("triangle", BOX_TRIANGLES)]), ("quads", quads), ("mixed", both)):
            faces = [face for _, some in cells for face in some]
            made = meshio.Mesh(BOX, [(kind, np.array(some)) for kind, some in cells])
            for kind in ("ply", "obj", "off", "stl"):
                if name == "triangles" or kind in ("ply", "obj"):
                    to.mesh(f"meshio_{name}.{kind}", "meshio", BOX, faces, lambda p, m=made: m.write(p))
            to.mesh(f"meshio_{name}.text.ply", "meshio", BOX, faces, lambda p, m=made: m.write(p, binary=False))
        polygon = meshio.Mesh(ARROW, [("polygon", np.array([range(5)]))])
        to.mesh("meshio_arrow.ply", "meshio", ARROW, [range(5)], lambda p: polygon.write(p))
    with to.by("open3d") as o3d:
        vector = o3d.utility
        save = o3d.io.write_triangle_mesh
        box = o3d.geometry.TriangleMesh(vector.Vector3dVector(BOX), vector.Vector3iVector(np.array(BOX_TRIANGLES)))
        knot = o3d.geometry.TriangleMesh.create_torus(20, 6)
        knot.compute_vertex_normals()
        for name, made in (("box", box), ("torus", knot)):
            held = np.asarray(made.vertices), np.asarray(made.triangles).tolist()
            to.mesh(f"open3d_{name}.ply", "Open3D", *held, lambda p, m=made: save(p, m))
            to.mesh(f"open3d_{name}.ascii.ply", "Open3D", *held, lambda p, m=made: save(p, m, write_ascii=True))
            to.mesh(f"open3d_{name}.obj", "Open3D", *held, lambda p, m=made: save(p, m))
    blender = "# Blender 4.2.1 LTS\n# www.blender.org\nmtllib box.mtl\no Cube"
    papers = "vn 0 0 1\nvt 0.5 0.5\ns 0\nusemtl Material"
    to.mesh("blender.obj", "as Blender", BOX, BOX_QUADS, obj(BOX, BOX_QUADS, blender, "{}/1/1", papers))
    to.mesh("ngon.obj", "as Blender", ARROW, [range(5)], obj(ARROW, [range(5)], blender))
    to.mesh("bent.obj", "as Blender", SHEET, [(0, 1, 2), (0, 2, 3)], obj(SHEET, [range(4)], blender))
    dented: Faces = [(4, 0, 1, 2, 3), (0, 1, 2, 3, 4)]
    to.mesh("turned_ngon.obj", "as Blender", ARROW, dented, obj(ARROW, dented))
    continued = obj(BOX, BOX_QUADS, "# Rhino\n").replace(" 3\n", " \\\n3\n").replace(" 4 ", " \\\n 4 ")
    to.mesh("continued.obj", "as Rhino", BOX, BOX_QUADS, continued)
    backwards: Faces = [[at - 9 for at in face] for face in BOX_QUADS]
    to.mesh("backwards.obj", "from the end", BOX, BOX_QUADS, obj(BOX, backwards))
    maya = "# This file uses centimeters as units for non-parametric coordinates.\n\nmtllib a.mtl\ng default"
    to.mesh("maya.obj", "as Maya", BOX, BOX_QUADS, obj(BOX, BOX_QUADS, maya, "{}", "s off\ng pCube1\n"))
    hole = np.array([[0, 0, 0], [9, 0, 0], [9, 9, 0], [0, 9, 0], [3, 3, 0], [3, 6, 0], [6, 6, 0], [6, 3, 0]], float)
    bridged: Faces = [(0, 1, 2, 3, 0, 4, 5, 6, 7, 4)]
    to.mesh("hole.obj", "as Blender", hole, bridged, obj(hole, bridged))
    scan = ["ply", "format ascii 1.0", "comment VCGLIB generated", "comment TextureFile wall.png", "element vertex 8"]
    scan += [*(f"property float {axis}" for axis in "xyz"), "element face 12"]
    scan += ["property list uchar int vertex_indices", "property list uchar float texcoord", "end_header"]
    rows = [" ".join(f"{x:g}" for x in point) for point in BOX]
    wedges = [f"3 {a} {b} {c} 6 0 0 1 0 0 1" for a, b, c in BOX_TRIANGLES]
    to.mesh("meshlab.ply", "as MeshLab", BOX, BOX_TRIANGLES, "\n".join([*scan, *rows, *wedges, ""]))
    plain = [line for line in scan if "texcoord" not in line]
    bare = [wedge.removesuffix(" 6 0 0 1 0 0 1") for wedge in wedges]
    to.mesh("named_texture.ply", "as MeshLab", BOX, BOX_TRIANGLES, "\n".join([*plain, *rows, *bare, ""]))


def write_pictures(to: Writer) -> None:
    """Pictures by libraries."""
    wide = (GREY.astype(np.uint16) * 257) + 3
    with to.by("PIL.Image") as image:
        turned = image.Exif()
        turned[274] = 6
        for name, codes, most, extra in (
            ("grey.png", GREY, 255, {}), ("colour.png", COLOUR, 255, {}), ("wide.png", wide, 65535, {}),
            ("bits.png", GREY > 99, 1, {}), ("grey.tif", GREY, 255, {}), ("packed.tif", GREY, 255, {"compression":
            "tiff_adobe_deflate"}), ("lzw.tif", wide, 65535, {"compression": "tiff_lzw"}), ("real.tif", REAL, 1, {}),
            ("turned.jpg", COLOUR, 255, {"exif": turned, "quality": 98, "subsampling": 0}), ("real.pfm", REAL, 1, {}),
            ("colour.jpg", COLOUR, 255, {"quality": 98, "subsampling": 0}),
            ("grey.jpg", GREY.repeat(8, 0).repeat(8, 1), 255, {"quality": 98}),
            ("grey.bmp", GREY, 255, {}), ("grey.webp", GREY, 255, {"lossless": True}),
        ):  # fmt: skip
            shown = np.rot90(codes, -1) if name == "turned.jpg" else codes
            off = 0.03 if name.endswith("jpg") else 0.0
            save = image.fromarray(codes).save
            to.picture(f"pillow_{name}", "Pillow", shown, lambda p, s=save, e=extra: s(p, **e), most, off)
        palette = image.fromarray(COLOUR).quantize(8)
        to.picture("pillow_palette.png", "Pillow", np.array(palette.convert("RGB")), palette.save, 255)
        see_through = np.dstack([COLOUR, np.full(COLOUR.shape[:2], 128, np.uint8)])
        to.picture("pillow_alpha.png", "Pillow", see_through, image.fromarray(see_through).save, 255)
        ink = image.fromarray(COLOUR).convert("CMYK")
        save = ink.save
        to.picture("pillow_ink.jpg", "Pillow", COLOUR, lambda p: save(p, quality=98, subsampling=0), 255, 0.03)
    with to.by("imageio.v3") as iio:
        for name, codes, most in (("grey.png", GREY, 255), ("wide.png", wide, 65535), ("colour.tif", COLOUR, 255),
                                  ("real.tif", REAL, 1), ("colour.png", COLOUR, 255)):  # fmt: skip
            to.picture(f"imageio_{name}", "imageio", codes, lambda p, c=codes: iio.imwrite(p, c), most)
    with to.by("tifffile") as tifffile:
        for name, codes, most, extra in (
            ("grey", GREY, 255, {}), ("wide", wide, 65535, {}), ("real", REAL, 1, {}),
            ("big", wide, 65535, {"bigtiff": True}), ("zlib", wide, 65535, {"compression": "zlib"}),
            ("predicted", wide, 65535, {"compression": "zlib", "predictor": True}),
            ("tiled", np.tile(GREY, (4, 4)), 255, {"tile": (16, 16)}), ("planar", COLOUR.transpose(2, 0, 1), 255,
            {"photometric": "rgb", "planarconfig": "separate"}), ("white", 255 - GREY, 255, {"photometric":
            "miniswhite"}), ("motorola", wide, 65535, {"byteorder": ">"}), ("double", REAL.astype(float), 1, {}),
            ("signed", GREY.astype(np.int16), 255, {}), ("half", REAL.astype(np.float16), 1, {}),
        ):  # fmt: skip
            right = COLOUR if name == "planar" else GREY if name == "white" else codes
            save = tifffile.imwrite
            to.picture(
                f"tifffile_{name}.tif", "tifffile", right, lambda p, s=save, c=codes, e=extra: s(p, c, **e), most
            )
    write_exr(to)


def write_exr(to: Writer) -> None:
    """Pictures by OpenEXR: windows, tiles, parts, depths, subsampled channels and luminance with chroma."""

    def corners(left: int, top: int, right: int, bottom: int) -> tuple[Any, Any]:
        return np.array([left, top], np.int32), np.array([right, bottom], np.int32)

    with to.by("OpenEXR") as exr:
        plain: dict[str, Any] = {"type": exr.scanlineimage}
        high, wide = REAL.shape
        mono, three = {"Y": REAL}, {name: np.roll(REAL, at) for at, name in enumerate("RGB")}
        colours = np.dstack([three[name] for name in "RGB"])
        shown = corners(0, 0, wide - 1, high - 1)
        padded = np.pad(REAL, ((2, 4), (3, 5)))
        for name, right, channels, more in (
            ("grey", REAL, mono, {}), ("colour", colours, three, {}), ("half", REAL.astype(np.float16), {"Y":
            REAL.astype(np.float16)}, {}), ("below", REAL, mono, {"lineOrder": exr.DECREASING_Y}),
            ("tiled", REAL, mono, {"type": exr.tiledimage, "tiles": exr.TileDescription()}),
            ("negative", REAL[2:, 3:], mono, {"dataWindow": corners(-3, -2, wide - 4, high - 3), "displayWindow":
            corners(0, 0, wide - 4, high - 3)}), ("crop", padded, mono, {"dataWindow": corners(3, 2, wide + 2, high +
            1), "displayWindow": corners(0, 0, wide + 7, high + 5)}), ("overscan", REAL[:-1, :-2], mono,
            {"displayWindow": corners(0, 0, wide - 3, high - 2), "dataWindow": shown}), ("shifted", REAL, mono,
            {"dataWindow": corners(5, 5, wide + 4, high + 4), "displayWindow": corners(5, 5, wide + 4, high + 4)}),
            ("chroma", None, {"Y": REAL, "RY": 0 * REAL, "BY": 0 * REAL}, {}), ("alpha", REAL, {"Y": REAL,
            "A": np.ones_like(REAL)}, {}), ("depth", colours, {**three, "Z": REAL}, {}),
            ("whole", GREY.astype(np.uint32), {"Y": GREY.astype(np.uint32)}, {}),
            ("dwaa", REAL, mono, {"compression": exr.DWAA_COMPRESSION}),
            ("piz", REAL, mono, {"compression": exr.PIZ_COMPRESSION}),
        ):  # fmt: skip
            held = np.dstack([REAL] * 3) if right is None else right

            def save(place: str, channels: Any = channels, more: Any = more) -> None:
                exr.File({**plain, **more}, dict(channels)).write(place)

            to.picture(f"openexr_{name}.exr", "OpenEXR", held, save, 1.0, 0.05 if name == "dwaa" else 1e-6)

        def parts(place: str) -> None:
            exr.File([exr.Part(dict(plain), {"Y": REAL}, name=f"p{n}") for n in range(2)]).write(place)

        to.picture("openexr_parts.exr", "OpenEXR", REAL, parts)
        fewer = {"Y": REAL, **{n: exr.Channel(n, np.zeros_like(REAL[::2, ::2]), 2, 2) for n in ("RY", "BY")}}
        with contextlib.suppress(Exception):
            to.picture("openexr_fewer.exr", "OpenEXR", REAL, lambda p: exr.File(dict(plain), fewer).write(p))
    header = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 12 +X 16\n"
    steps = RNG.integers(128, 256, (12, 16, 3)).astype(np.uint8)
    body = np.dstack([steps, np.full((12, 16), 128, np.uint8)]).tobytes()
    to.picture("flat.hdr", "as Radiance", steps / 256, header + body, 1.0, 2e-3)
    ends = struct.pack("<192f", *REAL[::-1].ravel())
    to.picture("little.pfm", "as Debevec", REAL, b"Pf\n16 12\n-1.0\n" + ends)


# -------- Reading

CAMERA = """<scene version="3.0.0"><integrator type="path"/><sensor type="mitsim_lensless"><string name="mask"
 value="open"/><float name="pixel_pitch" value="0.2"/><float name="mask_distance" value="2"/><float name="fov"
 value="20"/><float name="scene_distance" value="400"/><film type="hdrfilm"><integer name="width" value="8"/><integer
 name="height" value="8"/><rfilter type="box"/></film></sensor><emitter type="point"/>{}</scene>"""
MATT = '<bsdf type="twosided"><bsdf type="diffuse">{}</bsdf></bsdf></shape>'


def read_mesh(path: Path, right: dict[str, Any]) -> Iterator[tuple[str, Callable[[], bool]]]:
    """What reads a mesh, and whether area and box are right."""
    import mitsuba as mi

    import mitsim as ms
    from mitsim.scene.load import load_scene

    def sizes(shape: Any) -> tuple[float, Any]:
        points = np.array(mi.traverse(shape)["vertex_positions"]).reshape(-1, 3)
        return float(np.array(shape.surface_area()).ravel()[0]), points.max(0) - points.min(0)

    def in_scene() -> bool:
        scene = path.parent / f"{path.name}.xml"
        kind = path.suffix[1:]
        shape = f'<shape type="{kind}"><string name="filename" value="{path.name}"/>{MATT.format("")}'
        scene.write_text(CAMERA.format(shape))
        (found,) = load_scene(scene, needs_projector=False).scene.shapes()
        area, box = sizes(found)
        return bool(np.isclose(area, right["area"], rtol=2e-3) and np.allclose(box, right["size"], atol=1e-3))

    def as_object() -> bool:
        shapes = ms.shelf_scene(path, size_mm=50, variant=mi.variant()).loaded.scene.shapes()
        area, _ = sizes(next(shape for shape in shapes if shape.id() == "object"))
        return bool(np.isclose(area, right["area"] * (50 / max(right["size"])) ** 2, rtol=2e-3))

    yield "scene", in_scene
    yield "-D object", as_object


def read_picture(path: Path, right: dict[str, Any]) -> Iterator[tuple[str, Callable[[], bool]]]:
    """What reads a picture, and whether its numbers are right."""
    import mitsuba as mi

    from mitsim.acquire.sense import read_image
    from mitsim.core.images import read_images, read_reflectance
    from mitsim.scene.load import load_scene

    codes, most = np.load(f"{path}.npy").astype(float), right["most"]

    def alike(found: Any, wanted: Any, white: float, rounded: float = 1e-6) -> bool:
        found, wanted = np.squeeze(np.asarray(found, dtype=float)), np.squeeze(wanted)
        return found.shape == wanted.shape and bool(np.abs(found - wanted).max() <= (right["off"] + rounded) * white)

    def in_scene() -> bool:
        scene = path.parent / f"{path.name}.xml"
        bitmap = f'<string name="filename" value="{path.name}"/><boolean name="raw" value="true"/>'
        texture = f'<texture type="bitmap" name="reflectance">{bitmap}</texture>'
        scene.write_text(CAMERA.format(f'<shape type="rectangle">{MATT.format(texture)}'))
        held = mi.traverse(load_scene(scene, needs_projector=False).scene)
        (name,) = (name for name in held.keys() if name.endswith(".data"))  # noqa: SIM118 - no dictionary
        values = np.array(held[name])
        seen = codes[..., :3] if codes.ndim == 3 else codes
        seen = seen @ [0.212671, 0.715160, 0.072169] if values.shape[-1] == 1 and seen.ndim == 3 else seen
        return alike(values / (255 if values.dtype == np.uint8 else 1), seen / most, 1.0, 5e-4)

    def as_print() -> bool:
        grey = codes.mean(axis=2) if codes.ndim == 3 else codes
        return alike(read_reflectance(path), grey / most, 1.0)

    def as_light() -> bool:
        light = codes @ [0.2126, 0.7152, 0.0722] if codes.ndim == 3 else codes
        return alike(read_image(path)[0], light, most)

    yield "scene", in_scene
    yield "-D picture", as_print
    if path.suffix == ".exr":
        yield "sense", as_light
    yield "import", lambda: alike(next(read_images(path)), codes, most)


def read_one(folder: Path, name: str) -> None:
    """Print the verdict of each reader on a file, one a line."""
    from mitsim.core.environment import load_variant
    from mitsim.core.errors import MitsimError
    from mitsim.transport import plugins

    mi = load_variant("llvm_ad_mono")
    mi.set_log_level(mi.LogLevel.Error)
    plugins.register()
    (right,) = (one for one in json.loads((folder / "index.json").read_text()) if one["file"] == name)
    for reader, judge in (read_mesh if "area" in right else read_picture)(folder / name, right):
        try:
            verdict = "right" if judge() else "WRONG"
        except MitsimError as error:
            said = str(error)
            verdict = "TWO LINES" if "\n" in said else f"refused: {said[-150:]}"
        print(f"{reader}: {verdict}", flush=True)


def read(folder: Path) -> int:
    """Print a table of all files and readers; returns how many are wrong."""
    wrong = counted = refused = 0
    for right in json.loads((folder / "index.json").read_text()):
        command = [sys.executable, __file__, "one", str(folder), right["file"]]
        done = subprocess.run(command, capture_output=True, text=True)
        lines = [line for line in done.stdout.splitlines() if ": " in line]
        ended = [] if done.returncode == 0 else [f"ended by {done.returncode}: {done.stderr.strip()[-200:]}"]
        bad = bool(ended) or any("WRONG" in line or "TWO LINES" in line for line in lines)
        words = {line.partition(": ")[2].partition(":")[0] for line in lines}
        wrong, counted, refused = wrong + bad, counted + 1, refused + (words == {"refused"})
        print(f"{'**' if bad else '  '} {right['file']:28} {right['writer']:16} " + "; ".join([*lines, *ended]))
    print(
        f"{counted} files: {wrong} wrong, {refused} refused by all readers, {counted - wrong - refused} right in some"
    )
    return wrong


def main() -> int:
    """Write, or read and judge."""
    verb, folder = sys.argv[1], Path(sys.argv[2]).resolve()
    if verb == "one":
        read_one(folder, sys.argv[3])
    elif verb == "read":
        return int(read(folder) > 0)
    else:
        to = Writer(folder)
        write_meshes(to)
        write_pictures(to)
        (folder / "index.json").write_text(json.dumps(to.index, indent=1))
        print(f"{len(to.index)} files; not installed: {', '.join(sorted(to.without)) or 'none'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Valid meshes as other programs write them: let pass, loaded by Mitsuba as what they are, and always as the same."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.arrays import FloatArray
from mitsim.scene.headers import check_ply
from mitsim.scene.load import LoadedScene, load_scene
from tests.ply import ply_text

pytestmark = pytest.mark.usefixtures("variant")
VERTICES = [(-20.0, -20.0, 0.0), (20.0, -20.0, 0.0), (20.0, 20.0, 0.0), (-20.0, 20.0, 0.0)]
FACES = [(0, 1, 2), (0, 2, 3)]
AREA = 1600.0
CODES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
XYZ = ["float x", "float y", "float z"]
COLOUR = ["uchar red", "uchar green", "uchar blue", "uchar alpha"]
Row = tuple[float, ...]


@dataclass
class Dialect:
    """How a program writes the two triangles: vertices' and faces' properties beside the list, values of those before
    and after x, y, z or the list, and ``further`` elements (name, place, properties, rows)."""

    vertex: Sequence[str] = tuple(XYZ)
    before: Row = ()
    after: Row = ()
    face_before: Sequence[str] = ()
    face_after: Sequence[str] = ()
    listed: str = "uchar int vertex_indices"
    further: Sequence[tuple[str, int, Sequence[str], Sequence[Row]]] = ()
    faces_first: bool = False
    line_end: str = "\n"
    comments: Sequence[str] = ()

    def elements(self) -> list[tuple[str, list[str], list[list[float]]]]:
        faces = [*self.face_before, f"list {self.listed}", *self.face_after]
        of_vertices = [[*self.before, *place, *self.after] for place in VERTICES]
        of_faces = [[*[7] * len(self.face_before), 3, *face, *[9] * len(self.face_after)] for face in FACES]
        found = [("vertex", [*self.vertex], of_vertices), ("face", faces, of_faces)]
        found = found[::-1] if self.faces_first else found
        for name, place, properties, rows in self.further:
            found.insert(place, (name, [*properties], [list(row) for row in rows]))
        return found

    def written(self, order: str) -> bytes:
        head = ["ply", f"format {order} 1.0", *self.comments]
        for name, properties, rows in self.elements():
            head += [f"element {name} {len(rows)}", *(f"property {one}" for one in properties)]
        content = self.line_end.join([*head, "end_header", ""]).encode()
        for _, properties, rows in self.elements():
            kinds = "".join(kind for one in properties for kind in _codes(one))
            for row in rows:
                if order == "ascii":
                    content += (" ".join(f"{value:g}" for value in row) + self.line_end).encode()
                else:
                    numbers = [value if kind in "fd" else int(value) for kind, value in zip(kinds, row, strict=True)]
                    content += struct.pack(f"{'<' if 'little' in order else '>'}{kinds}", *numbers)
        return content


def _codes(written: str) -> list[str]:
    kinds = written.split()
    return [CODES[kinds[1]], *[CODES[kinds[2]]] * 3] if kinds[0] == "list" else [CODES[kinds[0]]]


EDGES = ["int vertex1", "int vertex2"]
DIALECTS = {
    "plain": Dialect(),
    "line ends of Windows": Dialect(line_end="\r\n"),
    "another order": Dialect(["float q", *XYZ], before=(0.5,)),
    "colours of both": Dialect([*XYZ, *COLOUR], after=(255, 0, 0, 255), face_after=COLOUR),
    "normals": Dialect([*XYZ, "float nx", "float ny", "float nz"], after=(0, 0, 1)),
    "texture coordinates s t": Dialect([*XYZ, "float s", "float t"], after=(0.1, 0.2)),
    "flags before the corners": Dialect(face_before=["uchar flags"]),
    "short lists": Dialect(listed="uchar ushort vertex_index"),
    "edges between": Dialect(further=[("edge", 1, EDGES, [(0, 1)] * 3)]),
    "faces first": Dialect(faces_first=True),
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_valid_mesh_is_loaded_as_it_is(tmp_path: Path, dialect: str) -> None:
    """(Seen failing: names shared by vertices and faces, other orders of properties, elements besides.)"""
    import mitsuba as mi

    for order in ("ascii", "binary_little_endian", "binary_big_endian"):
        path = tmp_path / f"{order}.ply"
        path.write_bytes(DIALECTS[dialect].written(order))
        check_ply(path)
        mesh = mi.load_dict({"type": "ply", "filename": str(path)})
        assert mesh.face_count() == 2
        assert float(np.array(mesh.surface_area()).ravel()[0]) == pytest.approx(AREA, rel=1e-6)


def test_a_header_that_mitsuba_does_not_know_is_refused(tmp_path: Path) -> None:
    """The line that scanners write, valid as it is, by its words; once Mitsuba reads it, let it pass."""
    import mitsuba as mi

    path = tmp_path / "scan.ply"
    path.write_bytes(Dialect(comments=["obj_info num_cols 512"]).written("ascii"))
    with pytest.raises(ValueError, match=r"header line that is not understood \('obj_info num_cols 512'\); remove it"):
        check_ply(path)
    with pytest.raises(RuntimeError, match="invalid PLY header"):
        mi.load_dict({"type": "ply", "filename": str(path)})


# -------- Normals that no file gives: sums over faces, in 32 bits

SIDE = 300
"""Corners a side: with so many faces eight threads give one sum in every loading, and Mitsuba another one."""
UP = (0.0, 0.0, 1.0)
MATT = '<bsdf type="diffuse" id="matt"/>\n'


def rough(side: int) -> tuple[FloatArray, FloatArray]:
    """Corners of a sheet of random heights, and its triangles in a random order."""
    rng = np.random.default_rng(3)
    row, column = np.mgrid[:side, :side] / side
    at = np.arange(side * side).reshape(side, side)
    first = np.stack([at[:-1, :-1], at[:-1, 1:], at[1:, :-1]], axis=-1)
    second = np.stack([at[1:, :-1], at[:-1, 1:], at[1:, 1:]], axis=-1)
    faces = np.concatenate([first, second]).reshape(-1, 3)
    points = np.stack([column, row, rng.random((side, side)) / side], axis=-1)
    return points.reshape(-1, 3), rng.permutation(faces)


def write_mesh(path: Path, side: int, normals: bool = False) -> None:
    """A rough sheet as PLY or Wavefront file; with ``normals`` all corners have the same one."""
    points, faces = rough(side)
    text = ply_text([(*point, *UP * normals) for point in points], faces)
    if path.suffix == ".obj":
        lines = [*(("v", *point) for point in points), *(("f", *face) for face in faces + 1)]
        lines += [("vn", *UP)] if normals else []
        text = "".join(" ".join(map(str, line)) + "\n" for line in lines)
    path.write_text(text, encoding="utf-8")


def mesh(name: str) -> str:
    file = f'<string name="filename" value="{name}"/>'
    return f'<shape type="{name.rpartition(".")[2]}">{file}<ref id="matt"/></shape>'


def normals_of(loaded: LoadedScene) -> dict[str, FloatArray]:
    """Those of each mesh, by the first of its files."""
    import mitsuba as mi

    found, parameters = {}, mi.traverse(loaded.scene)
    for key in parameters.keys():  # noqa: SIM118 - SceneParameters is no dict
        if key.endswith("vertex_normals") and len(parameters[key]):
            files = str(parameters.properties[key][2]).partition('name = "')[2]
            found[files.partition('"')[0]] = np.array(parameters[key])
    return found


def test_normals_do_not_depend_on_threads(small_scene: Callable[..., Path], set_threads: Callable[[int], None]) -> None:
    """And those of Mitsuba but for rounding. (Seen failing: Mitsuba's own, which differ from loading to loading, and
    frames by them; sums in 32 bits; faces that count alike at all their corners.)"""
    import drjit as dr
    import mitsuba as mi

    path = small_scene(extra=MATT + mesh("rough.ply"))
    write_mesh(path.parent / "rough.ply", SIDE)
    found = set()
    for threads in (2, 8, 8):
        set_threads(threads)
        found.add(normals_of(load_scene(path))["rough.ply"].tobytes())
        assert dr.thread_count() == threads
    assert len(found) == 1
    theirs = mi.load_dict({"type": "ply", "filename": str(path.parent / "rough.ply")})
    ours = np.frombuffer(found.pop(), dtype=np.float32)
    assert np.allclose(ours, np.array(mi.traverse(theirs)["vertex_normals"]), rtol=0, atol=2e-6)


@pytest.mark.parametrize(
    ("extra", "smoothed"),
    [
        ("", False),
        ('<shape type="cube"/>', False),
        ('<shape type="sphere"><float name="radius" value="5"/></shape>', False),
        ("bent.ply", True),
        (mesh("bent.ply").replace("<ref", '<boolean name="face_normals" value="true"/><ref'), False),
        ("flat.ply", False),
        ("turned.ply", False),
        ("leaning.ply", True),
        ('<shape type="shapegroup" id="group"><shape type="disk"/></shape>'
         '<shape type="instance"><ref id="group"/></shape>', True),
    ],
)  # fmt: skip
def test_foreign_shading_normals_are_seen(small_scene: Callable[..., Path], extra: str, smoothed: bool) -> None:
    """Of a bent sheet, though some faces be even; of a flat one whose file gives others, by three degrees, but not the
    other side's; and what an instance hides may have them. (Planted: of all faces; the side counts; 25 degrees; no
    instance; never.)"""
    path = small_scene(extra=MATT + (mesh(extra) if extra.endswith(".ply") else extra))
    flat = [(*place, 0) for place in ((0.0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (2, 1))]
    faces = [(0, 1, 2), (1, 3, 2), (1, 4, 3), (4, 5, 3)]
    lean = np.radians(3.0)
    (path.parent / "bent.ply").write_text(ply_text([*flat[:5], (2, 1, 1.0)], faces))
    (path.parent / "flat.ply").write_text(ply_text(flat, faces))
    (path.parent / "turned.ply").write_text(ply_text([(*row, 0, 0, -1) for row in flat], faces))
    (path.parent / "leaning.ply").write_text(ply_text([(*row, np.sin(lean), 0, np.cos(lean)) for row in flat], faces))
    assert load_scene(path).smoothed is smoothed


def test_sums_are_added_anew(small_scene: Callable[..., Path], variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In groups and merged shapes, too; but normals that a file gives, a shape of its own or one among those merged,
    stay. (Planted: another order of the sums, here a change of all normals.)"""
    import mitsuba as mi

    anew = ("one.ply", "two.obj", "in a group.ply", "merged 1.ply + merged 2.obj")
    kept = ("own.ply", "own.obj", "merged 3.ply + own 2.ply")
    merged = [f'<shape type="merge">{"".join(map(mesh, names.split(" + ")))}</shape>' for names in (anew[3], kept[2])]
    group = f'<shape type="shapegroup" id="group">{mesh(anew[2])}</shape>'
    alone = [mesh(name) for name in (*anew[:2], *kept[:2])]
    instance = '<shape type="instance"><ref id="group"/></shape>'
    path = small_scene(extra="\n".join([MATT, *alone, *merged, group, instance]))
    for name in " + ".join((*anew, *kept)).split(" + "):
        write_mesh(path.parent / name, 5, normals=name.startswith("own"))
    right, instantiate = normals_of(load_scene(path)), mi.parser.instantiate

    def instantiate_otherwise(*scene: object) -> mi.Scene:
        parameters = mi.traverse(made := instantiate(*scene))
        for key in parameters.keys():  # noqa: SIM118 - SceneParameters is no dict
            if key.endswith("vertex_normals"):
                parameters[key] = parameters[key] * 1.001
        parameters.update()
        return made

    monkeypatch.setattr(mi.parser, "instantiate", instantiate_otherwise)
    changed = normals_of(load_scene(path))
    assert changed.keys() == right.keys() and {*anew, *kept} == changed.keys()
    for name, normals in changed.items():
        same = normals.tobytes() == right[name].tobytes()
        assert same == (name in anew), name

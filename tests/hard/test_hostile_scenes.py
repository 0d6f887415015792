"""Hostile and mistaken scene files: each is refused in one line with its place, in time, and leaves no trace.

No variant of Mitsuba is selected: its parser reads what passes the look at the bytes, and makes no objects.
"""

import re
import struct
import time
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.scene.check import check_file
from tests.hard.hostile import GOOD, OBJ, Case, ball, beside, file, mesh, picture, png, put, skin, swap
from tests.hard.hostile.files import CASES as OF_FILES
from tests.hard.hostile.text import CASES as OF_TEXT

pytestmark = pytest.mark.robustness("Input")

CASES = [*OF_TEXT, *OF_FILES]

LONGEST = 5.0
"""Seconds of processor time that any file may take; the slowest takes 0.1 s here."""


def listed(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if not path.is_symlink())


def refusal(path: Path, defines: dict[str, str] | None = None) -> str:
    before, started = listed(path.parent.parent), time.process_time()
    with pytest.raises(MitsimError) as caught:
        check_file(path, defines or {})
    assert time.process_time() - started < LONGEST
    assert listed(path.parent.parent) == before
    message = str(caught.value)
    assert len(message.splitlines()) == 1 and message.replace("\t", "").isprintable() and len(message) < 2000
    return message


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name[:60])
def test_a_hostile_scene_is_refused(tmp_path: Path, case: Case) -> None:
    """Refused with ``file:line`` (the file alone where no line is at fault), the value and what is allowed."""
    (tmp_path / "scene").mkdir()
    message = refusal(case.write(tmp_path / "scene"), dict(case.defines))
    for words in (case.says,) if isinstance(case.says, str) else case.says:
        assert words in message, message
    assert not case.line or re.match(rf"{re.escape(str(tmp_path))}/scene/[\w/]+\.(xml|png):\d+: ", message), message


@pytest.mark.parametrize("line", [3, 400])
def test_the_line_is_that_of_the_fault(tmp_path: Path, line: int) -> None:
    """Counted by hand: blank lines before a bad sphere, and an attribute on a later line of its own."""
    start = GOOD.count("\n", 0, GOOD.index("<!--here-->")) + 1
    path = Case("", put("\n" * line + '<shape type="sphere">\n<float\nname="radius"\nvalue="-1"/></shape>'), ()).write(
        tmp_path
    )
    assert f"{path}:{start + line + 1}: radius: got -1 in <float name='radius' value='-1'>; " in refusal(path)


NORMAL = {
    "the good scene": GOOD,
    "other line ends": GOOD.replace("\n", "\r\n"),
    "a byte order mark": "\ufeff" + GOOD,
    "no declaration": GOOD[GOOD.index("<scene") :],
    "ASCII": GOOD.replace("utf-8", "US-ASCII"),
    "version 2": swap('"3.0.0"', '"2.1.0"'),
    "comments and CDATA": put("<!-- <path value='/tmp'/> --><![CDATA[<path/>]]>"),
    "character references": swap('"$albedo"', '"&#48;.5"'),
    "names of other scripts": ball('<bsdf type="diffuse" id="gläsern"/>'),
    "mesh": mesh("mesh.ply"),
    "Wavefront mesh": mesh("mesh.obj", "obj"),
    "picture": picture("projector.png"),
    "picture by a detour": picture("./sub/../projector.png"),
    "metal": skin("conductor", '<string name="material" value="Au"/>'),
    "dark metal": skin("conductor", '<spectrum name="eta" value="0.05"/><spectrum name="k" value="4.2"/>'),
    "glass by name": skin("dielectric", '<string name="int_ior" value="bk7"/>'),
    "spectrum of pairs": skin("diffuse", '<spectrum name="reflectance" value="400:0.2, 700:0.5"/>'),
    "spectrum of a file": skin("diffuse", '<spectrum name="reflectance" filename="sub/s.spd"/>'),
    "include": put('<include filename="sub/part.xml"/>'),
    "a hundred shapes of one material": put('<shape type="sphere"><ref id="paper"/></shape>' * 100),
    "two parameters": put('<default name="b" value="1"/><string name="x" value="$albedo $b"/>'),
    "turned camera": swap('<rotate y="1" angle="0"/>', '<lookat origin="1 2 3" target="4 5 600" up="0 1 0"/>'),
    "mirrored sphere": ball('<transform name="to_world"><scale x="-1" y="2"/></transform>'),
    "mask 20 um above the sensor": swap('"mask_distance" value="2"', '"mask_distance" value="0.02"'),
    "mask of 1 um features": swap('"mask_feature" value="0.06"', '"mask_feature" value="0.001"'),
}


def prepared(folder: Path, content: str) -> Path:
    beside(folder)
    file("sub/s.spd", "# nm, -\n400 0.2\n700 0.5\n")(folder)
    file("sub/part.xml", '<scene version="3.0.0"><default name="r" value="2"/><shape type="sphere"/></scene>')(folder)
    (folder / "scene.xml").write_bytes(content.encode())
    return folder / "scene.xml"


@pytest.mark.parametrize("name", NORMAL)
def test_a_normal_scene_is_not_refused(tmp_path: Path, name: str) -> None:
    """The other half of the proof: a check that refused all would pass the hostile cases."""
    files = check_file(prepared(tmp_path, NORMAL[name]), {}).files
    assert files[0] == tmp_path / "scene.xml" and tmp_path / "projector.png" in files


def test_every_file_is_listed_once(tmp_path: Path) -> None:
    """So that a run can note the checksum of each."""
    content = put(
        '<include filename="sub/part.xml"/><shape type="ply"><string name="filename" value="mesh.ply"/></shape>'
        '<bsdf type="diffuse"><spectrum name="reflectance" filename="sub/s.spd"/></bsdf>'
        '<shape type="ply"><string name="filename" value="mesh.ply"/></shape>'
    )
    files = check_file(prepared(tmp_path, content), {}).files
    names = [str(path.relative_to(tmp_path)) for path in files]
    assert sorted(names) == ["mesh.ply", "projector.png", "scene.xml", "sub/part.xml", "sub/s.spd"]


@pytest.mark.parametrize(
    "content",
    [picture("../out.png"), picture("link.png"), put('<include filename="../out.xml"/>')],
    ids=["above", "link", "include"],
)
def test_files_outside_are_read_when_the_user_says_so(tmp_path: Path, content: str) -> None:
    (tmp_path / "out.png").write_bytes(png(2, 2))
    (tmp_path / "out.xml").write_text('<scene version="3.0.0"/>')
    (tmp_path / "scene").mkdir()
    path = prepared(tmp_path / "scene", content)
    (tmp_path / "scene" / "link.png").symlink_to("../out.png")
    assert "--allow-outside-files" in refusal(path)
    assert len(check_file(path, {}, outside=True).files) == 3


def test_defaults_of_an_include_do_not_override(tmp_path: Path) -> None:
    """The first <default> counts, as in Mitsuba, wherever it stands; -D comes before all."""
    file("p.xml", '<scene version="3.0.0"><default name="albedo" value="7"/></scene>')(tmp_path)
    late = put('<include filename="p.xml"/>')
    early = swap("<default", '<include filename="p.xml"/><default')
    assert check_file(prepared(tmp_path, late), {})
    assert "reflectance: got 7" in refusal(prepared(tmp_path, early))
    assert check_file(prepared(tmp_path, early), {"albedo": "0.5"})


def test_native_code_in_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mitsuba looks for plugins there too, before its own: a downloaded folder could bring a "diffuse.so"."""
    (tmp_path / "scene").mkdir()
    file("plugins/diffuse.so", b"\x7fELF")(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert "plugins/diffuse.so would run native code" in refusal(prepared(tmp_path / "scene", GOOD))


@pytest.mark.parametrize(("order", "name"), [("<", "binary_little_endian"), (">", "binary_big_endian")])
def test_corners_are_found_among_other_numbers(tmp_path: Path, order: str, name: str) -> None:
    """Colours of vertices and flags of faces do not shift what is taken for a corner, in either byte order."""
    head = (
        f"ply\nformat {name} 1.0\ncomment made here\nelement vertex 3\nproperty float x\nproperty float y\n"
        "property float z\nproperty uchar red\nelement face 2\nproperty uchar flag\n"
        "property list uchar int vertex_indices\nend_header\n"
    ).encode()
    points = b"".join(struct.pack(order + "3fB", i, 2, 3, 255) for i in range(3))
    good, bad = (b"".join(struct.pack(order + "BB3i", 9, 3, 0, 1, last) for _ in range(2)) for last in (2, 3))
    path = prepared(tmp_path, mesh("mesh.ply"))
    file("mesh.ply", head + points + good)(tmp_path)
    assert check_file(path, {})
    file("mesh.ply", head + points + bad)(tmp_path)
    assert "0 to 3, but 3 vertices" in refusal(path)


def test_an_obj_without_faces_is_refused(tmp_path: Path) -> None:
    file("m.obj", OBJ[: OBJ.index("f ")])(tmp_path)
    with pytest.raises(
        MitsimError, match=r"'m.obj' .*; the file has no faces: it is a cloud of points; export a mesh$"
    ):
        check_file(prepared(tmp_path, mesh("m.obj", "obj")), {})


@pytest.mark.parametrize("verb", ["plan", "capture", "calibrate", "render"])
def test_every_verb_passes_the_permission_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variant: str, verb: str
) -> None:
    """With ``--allow-outside-files`` the scene is opened with its outside picture, without it is refused."""
    from mitsim import cli
    from mitsim.scene import load

    class Opened(Exception):
        pass

    def stop(*_: object, **__: object) -> None:
        raise Opened

    monkeypatch.setattr(load.mi.parser, "instantiate", stop)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out.png").write_bytes(png(2, 2))
    (tmp_path / "scene").mkdir()
    scene = str(prepared(tmp_path / "scene", picture("../out.png")))
    arguments = {
        "plan": ["plan", scene, "--patterns", "uniform"],
        "capture": ["capture", scene, "-o", "new", "--patterns", "uniform"],
        "calibrate": ["calibrate", scene, "-o", "new"],
        "render": ["render", scene, "-o", "new.exr"],
    }[verb]
    with pytest.raises(MitsimError, match="--allow-outside-files"):
        cli.app(arguments, standalone_mode=False)
    with pytest.raises(Opened):
        cli.app([*arguments, "--allow-outside-files"], standalone_mode=False)


def test_a_loaded_scene_knows_its_files(tmp_path: Path, variant: str) -> None:
    """Also where Mitsuba really reads a picture outside: the list is what it read."""
    from mitsim.scene.load import load_scene

    (tmp_path / "out.png").write_bytes(png(2, 2))
    (tmp_path / "scene").mkdir()
    path = prepared(tmp_path / "scene", picture("../out.png"))
    loaded = load_scene(path, outside=True)
    assert [item.name for item in loaded.files] == ["scene.xml", "projector.png", "out.png"]


COLOURED = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "property float r\nproperty float g\nproperty float b\nelement face 1\n"
    "property list uchar int vertex_indices\nend_header\n0 0 500 {0} {0} {0}\n9 0 500 0 0 0\n0 9 500 1 1 1\n3 0 1 2\n"
)


@pytest.mark.parametrize(
    ("bsdf", "worst"),
    [
        ('<bsdf type="diffuse">{}</bsdf>', "5"),
        ('<bsdf type="diffuse"><texture name="reflectance" type="checkerboard">{}</texture></bsdf>', "-1"),
        ('<emitter type="area">{}</emitter>', "-1"),
    ],
    ids=["colour", "below a checkerboard", "light"],
)
def test_colours_of_vertices(tmp_path: Path, variant: str, bsdf: str, worst: str) -> None:
    """A mesh brings reflectances too: 5 of the light would leave a surface where 1 arrives."""
    from mitsim.scene.load import load_scene

    name = "color0" if "checkerboard" in bsdf else "radiance" if "emitter" in bsdf else "reflectance"
    colour = f'<texture name="{name}" type="mesh_attribute"><string name="name" value="vertex_color"/></texture>'
    path = prepared(tmp_path, mesh("c.ply").replace("</shape>\n</scene>", bsdf.format(colour) + "</shape>\n</scene>"))
    file("c.ply", COLOURED.format(0.5))(tmp_path)
    load_scene(path)
    file("c.ply", COLOURED.format(worst))(tmp_path)
    with pytest.raises(MitsimError, match=rf"number 0 of its vertex_color is {worst}; allowed are finite numbers of 0"):
        load_scene(path)


def test_a_referenced_bitmap_keeps_the_limit_of_its_use(tmp_path: Path, variant: str) -> None:
    """Mitsuba calls it by a number, not by the parameter that it is given for."""
    from mitsim.core.exr import write_frame
    from mitsim.scene.load import load_scene

    texture = '<texture id="t" type="bitmap"><string name="filename" value="t.exr"/></texture>'
    path = prepared(
        tmp_path,
        put(texture + '<shape type="sphere"><bsdf type="diffuse"><ref name="reflectance" id="t"/></bsdf></shape>'),
    )
    write_frame(tmp_path / "t.exr", {"Y": np.full((4, 4), 0.5, np.float32)}, {})
    load_scene(path)
    write_frame(tmp_path / "t.exr", {"Y": np.full((4, 4), 3, np.float32)}, {})
    with pytest.raises(MitsimError, match=r"row 0, column 0 is 3 .* 0 to 1"):
        load_scene(path)

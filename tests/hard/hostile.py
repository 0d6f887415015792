"""Scenes, meshes and pictures that mean harm or are mistakes, made by code: each an edit of one good scene."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

GOOD = """<?xml version="1.0" encoding="utf-8"?>
<scene version="3.0.0">
    <default name="albedo" value="0.5"/>
    <integrator type="path"><integer name="max_depth" value="2"/></integrator>
    <sensor type="mitsim_lensless" id="camera">
        <transform name="to_world"><rotate y="1" angle="0"/></transform>
        <float name="pixel_pitch" value="0.01172"/>
        <string name="mask" value="separable"/>
        <integer name="mask_order" value="9"/>
        <float name="mask_feature" value="0.06"/>
        <float name="mask_distance" value="2"/>
        <float name="scene_distance" value="400"/>
        <float name="fov" value="20"/>
        <film type="hdrfilm">
            <integer name="width" value="32"/> <integer name="height" value="32"/> <rfilter type="box"/>
            <string name="pixel_format" value="luminance"/> <string name="component_format" value="float32"/>
        </film>
        <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
    </sensor>
    <emitter type="projector" id="projector">
        <transform name="to_world"><translate x="60"/></transform>
        <string name="fov_axis" value="x"/> <float name="fov" value="33.4"/> <float name="scale" value="111000"/>
        <texture name="irradiance" type="bitmap">
            <string name="filename" value="projector.png"/> <boolean name="raw" value="true"/>
            <string name="filter_type" value="nearest"/> <string name="wrap_mode" value="clamp"/>
        </texture>
    </emitter>
    <shape type="rectangle" id="sheet">
        <transform name="to_world"><scale x="64" y="64"/> <translate z="400"/></transform>
        <boolean name="flip_normals" value="true"/>
        <bsdf type="diffuse" id="paper"><spectrum name="reflectance" value="$albedo"/></bsdf>
    </shape>
    <!--here-->
</scene>
"""
MESH = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 500\n9 0 500\n0 9 500\n3 0 1 2\n"
)
OBJ = "v 0 0 500\nv 9 0 500\nv 0 9 500\nf 1 2 3\n"
PRINCIPLED = ("sheen", "sheen_tint", "spec_tint", "spec_trans", "flatness", "clearcoat", "clearcoat_gloss", "specular")
Prepare = Callable[[Path], object]


def nothing(folder: Path) -> None:
    """Most cases need no further files."""


@dataclass(frozen=True)
class Case:
    """A scene file, what is put beside it, and words of the refusal; ``line`` tells whether the place has a line."""

    name: str
    content: str | bytes
    says: tuple[str, ...]
    prepare: Prepare = nothing
    line: bool = True
    defines: tuple[tuple[str, str], ...] = ()

    def write(self, folder: Path) -> Path:
        """The scene in a folder, its good files beside it."""
        beside(folder)
        self.prepare(folder)
        path = folder / "scene.xml"
        content = self.content.encode() if isinstance(self.content, str) else self.content
        path.write_bytes(content)
        return path


def beside(folder: Path) -> None:
    """The files of the good scene, and a good mesh of each kind."""
    (folder / "projector.png").write_bytes(png(4, 4))
    (folder / "mesh.ply").write_text(MESH)
    (folder / "mesh.obj").write_text(OBJ)


def png(width: int, height: int, claimed: tuple[int, int] | None = None) -> bytes:
    """A white 8-bit picture, or one whose header claims another size."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = struct.pack(">IIBBBBB", *(claimed or (width, height)), 8, 0, 0, 0, 0)
    rows = zlib.compress((b"\0" + b"\xff" * width) * height)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def jpeg(width: int, height: int, hidden: bool = False) -> bytes:
    """The header of a JPEG picture; ``hidden``: a reader that gives a length to the first marker lands in a comment."""

    def frame(width: int, height: int) -> bytes:
        return b"\xff\xc0" + struct.pack(">HBHHB", 17, 8, height, width, 3) + b"\1\x11\0\2\x11\0\3\x11\0"

    start = b"\xff\xd8" + b"\xff\xd0" * hidden + frame(width, height)
    lure = bytes(4 + 0xFFC0 - len(start) - 4) + frame(4, 4)
    comment = b"\xff\xfe" + struct.pack(">H", len(lure) + 2) + lure
    return start + comment * hidden + b"\xff\xda" + struct.pack(">HB", 6, 0) + bytes(3)


def put(text: str) -> str:
    """The good scene with something more at its end."""
    assert GOOD.count("<!--here-->") == 1
    return GOOD.replace("<!--here-->", text)


def swap(old: str, new: str) -> str:
    """The good scene with its first ``old`` replaced."""
    assert old in GOOD, old
    return GOOD.replace(old, new, 1)


def ball(inside: str) -> str:
    """A sphere with something in it."""
    return put(f'<shape type="sphere">{inside}</shape>')


_OBJECT_FOR_FILE = '<texture name="filename" type="checkerboard"/>'


def skin(kind: str, inside: str = "") -> str:
    """A sphere of one material."""
    return ball(f'<bsdf type="{kind}">{inside}</bsdf>')


def picture(name: str) -> str:
    """A sphere with a bitmap."""
    return skin(
        "diffuse", f'<texture name="reflectance" type="bitmap"><string name="filename" value="{name}"/></texture>'
    )


def mesh(name: str, kind: str = "ply") -> str:
    """A mesh file."""
    return put(f'<shape type="{kind}"><string name="filename" value="{name}"/></shape>')


def file(name: str, content: str | bytes) -> Prepare:
    """Puts a file beside the scene."""

    def write(folder: Path) -> None:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)

    return write


def included(content: str, name: str = "part.xml") -> tuple[str, Prepare]:
    """The good scene with an include, and the included scene's content."""
    return put(f'<include filename="{name}"/>'), file(name, f'<scene version="3.0.0">{content}</scene>')


def _not_well_formed() -> list[Case]:
    words = ("not well-formed",)
    head = '<scene version="3.0.0">'
    return [
        Case("empty", "", words),
        Case("blank", " \n ", words),
        Case("cut short", GOOD[: len(GOOD) // 2], words),
        Case("two roots", head + "</scene>" + head + "</scene>", words),
        Case("text after the root", GOOD + "more", words),
        Case("crossed tags", put("<shape><bsdf></shape></bsdf>"), words),
        Case("attribute twice", put('<float name="a" name="b" value="1"/>'), words),
        Case("attribute without quotes", put("<float name=a value=1/>"), words),
        Case("less-than in attribute", put('<string name="a" value="<shape/>"/>'), words),
        Case("unknown entity", put("&nope;"), words),
        Case("character zero", put("&#0;"), words),
        Case("character of a surrogate", put("&#xD800;"), words),
        Case("two dashes in a comment", put("<!-- a -- b -->"), words),
        Case("open comment", put("<!-- a"), words),
        Case("open CDATA", put("<![CDATA["), words),
        Case("zero byte", GOOD.encode().replace(b"<!--here-->", b"\0"), words),
        Case("control character", put("\x01"), words),
        Case("bytes of no encoding", GOOD.encode().replace(b"<!--here-->", b"<!--\xff\xfe-->"), words),
        Case("overlong UTF-8", GOOD.encode().replace(b"<!--here-->", b"<!--\xc0\xbc-->"), words),
        Case("UTF-16", GOOD.replace("utf-8", "utf-16").encode("utf-16"), words),
        Case("UTF-16 without mark", GOOD.replace("utf-8", "utf-16").encode("utf-16-le"), words),
        Case("UTF-32", GOOD.encode("utf-32"), words),
        Case("random bytes", bytes(range(256)) * 40, words),
        Case("a picture", png(4, 4), words),
        Case("late XML declaration", "\n" + GOOD, words),
    ]


def _not_allowed() -> list[Case]:
    latin = GOOD.replace("utf-8", "iso-8859-1")
    bomb = "".join(f'<!ENTITY a{i + 1} "{f"&a{i};" * 10}">' for i in range(9))
    first = GOOD.index("<scene")
    dtd = GOOD[:first] + "{}" + GOOD[first:]
    return [
        Case("latin-1", latin, ("encoding: got 'iso-8859-1'", "UTF-8")),
        Case("windows encoding", GOOD.replace("utf-8", "windows-1252"), ("UTF-8",)),
        Case("UTF-7", GOOD.replace("utf-8", "utf-7"), ("UTF-8",)),
        Case("unknown encoding", GOOD.replace("utf-8", "none-such"), ("UTF-8",)),
        Case("DTD", dtd.format("<!DOCTYPE scene>"), ("DTD",)),
        Case("entity", dtd.format('<!DOCTYPE scene [<!ENTITY a "b">]>'), ("DTD",)),
        Case("billion laughs", dtd.format(f'<!DOCTYPE scene [<!ENTITY a0 "ha">{bomb}]>'), ("DTD",)),
        Case("quadratic entity", dtd.format(f'<!DOCTYPE s [<!ENTITY a "{"x" * 99999}">]>'), ("DTD",)),
        Case("external entity", dtd.format('<!DOCTYPE s [<!ENTITY a SYSTEM "file:///etc/passwd">]>'), ("DTD",)),
        Case("external DTD", dtd.format('<!DOCTYPE scene SYSTEM "http://localhost:1/x.dtd">'), ("DTD",)),
        Case("parameter entity", dtd.format('<!DOCTYPE s [<!ENTITY % a SYSTEM "x"> %a;]>'), ("DTD",)),
        Case("style sheet", dtd.format('<?xml-stylesheet href="x.xsl"?>'), ("processing instruction",)),
        Case("instruction inside", put("<?php system('id') ?>"), ("processing instruction",)),
        Case("other root", '<shape version="3.0.0" type="sphere"/>', ("<shape>", "<scene>")),
        Case("no version", GOOD.replace('scene version="3.0.0"', "scene"), ("version: got none",)),
        Case("old version", swap('"3.0.0"', '"0.6.0"'), ("version: got 0.6.0", "2 and 3")),
        Case("future version", swap('"3.0.0"', '"9999999999.0.0"'), ("version",)),
        Case("version by parameter", swap('"3.0.0"', '"$albedo"'), ("version",)),
        Case("unknown tag", put("<sphere/>"), ("refuses <sphere>", "unsupported XML element")),
        Case("capital tag", put('<Shape type="sphere"/>'), ("refuses <Shape type='sphere'>",)),
        Case("tag of a namespace", put('<m:shape xmlns:m="x" type="sphere"/>'), ("m:shape",)),
        Case("unknown attribute", put('<shape type="sphere" onload="x"/>'), ('unexpected attribute "onload"',)),
        Case("shape without type", put("<shape/>"), ('missing required attribute "type"',)),
        Case("number without value", ball('<float name="radius"/>'), ('missing required attribute "value"',)),
        Case(
            "number with children",
            ball('<float name="radius" value="1"><bsdf type="null"/></float>'),
            ("<bsdf> element cannot occur",),
        ),
        Case("turn outside a transform", put('<translate x="1"/>'), ("only appear inside a <transform>",)),
        Case(
            "shape in a transform",
            ball('<transform name="to_world"><shape type="cube"/></transform>'),
            ("unexpected <shape>",),
        ),
        Case("scene in a scene", put('<scene version="3.0.0"/>'), ('unexpected attribute "version"',)),
        Case("path", put('<path value="/tmp"/>'), ("path: got '/tmp'", "native code")),
        Case("path in a shape", ball('<path value="."/>'), ("native code",)),
        Case("plugin with a path", put('<shape type="../../tmp/evil"/>'), ("type: got '../../tmp/evil'",)),
        Case("plugin with an absolute path", put('<shape type="/tmp/evil"/>'), ("type: got",)),
        Case("plugin with a backslash", put(r'<shape type="..\evil"/>'), ("backslash",)),
        Case("plugin with a dot", put('<shape type="sphere.so"/>'), ("type: got 'sphere.so'",)),
        Case("empty plugin", put('<shape type=""/>'), ("type: got ''",)),
        Case(
            "plugin by parameter",
            put('<default name="t" value="../evil"/><shape type="$t"/>'),
            ("type: got '../evil'",),
        ),
        Case("plugin of another tag", put('<bsdf type="sphere"/>'), ("type: got 'sphere'", "allowed are")),
        Case("misspelt plugin", put('<shape type="spere"/>'), ("did you mean sphere",)),
        Case("plugin with blanks", put('<shape type=" sphere"/>'), ("type: got ' sphere'",)),
        Case("plugin of a look-alike letter", put('<shape type="\u0455phere"/>'), ("type: got",)),
        Case("plugin of a thousand letters", put(f'<shape type="{"a" * 99999}"/>'), ("type: got 'aaa", "...")),
        Case("plugin with a new line", put('<shape type="a&#10;b"/>'), ("type: got",)),
        Case("plugin with an escape sequence", put('<shape type="\u009b31m"/>'), ("type: got", "allowed are")),
        Case("serialized mesh", put('<shape type="serialized"/>'), ("type: got 'serialized'",)),
        Case("volume file", put('<volume type="gridvolume"/>'), ("type: got 'gridvolume'",)),
        Case("integrator of other numbers", swap('type="path"', 'type="aov"'), ("type: got 'aov'",)),
        Case(
            "material file by name", skin("conductor", '<string name="material" value="../../x"/>'), ("material: got",)
        ),
        Case("path in a text", skin("conductor", '<string name="distribution" value="../x"/>'), ("may hold a path",)),
        Case("file for no reader", ball('<string name="filename" value="mesh.ply"/>'), ("only bitmap",)),
        Case(
            "two files",
            mesh("mesh.ply").replace("/></shape>", '/><string name="filename" value="a"/></shape>'),
            ("name: got 'filename'", "has it already"),
        ),
        Case(
            "bitmap without file",
            skin("diffuse", '<texture name="reflectance" type="bitmap"/>'),
            ("filename: got nothing",),
        ),
        Case(
            "object for the file of a bitmap",
            skin("diffuse", f'<texture name="reflectance" type="bitmap">{_OBJECT_FOR_FILE}</texture>'),
            ("filename: got no text",),
        ),
        Case(
            "object for the file of a mesh",
            put(f'<shape type="ply">{_OBJECT_FOR_FILE}</shape>'),
            ("filename: got no text",),
        ),
        Case(
            "transform without a name in a texture",
            skin(
                "diffuse",
                '<texture name="reflectance" type="checkerboard"><transform name=""><scale x="3"/></transform>'
                "</texture>",
            ),
            ("name: got ''",),
        ),
        Case(
            "number for the file of a bitmap",
            skin("diffuse", '<texture name="reflectance" type="bitmap"><float name="filename" value="1"/></texture>'),
            ("filename",),
        ),
    ]


def _parameters() -> list[Case]:
    return [
        Case("unknown parameter", swap('"$albedo"', '"$albdo"'), ("parameter: got $albdo", "albedo")),
        Case("parameter before its default", swap("<default", '<include filename="$a"/><default'), ("$a",)),
        Case("parameter in a parameter", put('<default name="b" value="$albedo"/>'), ("without $",)),
        Case("parameter as a name", put('<default name="$albedo" value="1"/>'), ("without $",)),
        Case("parameters that touch", put('<float name="x" value="$albedo$albedo"/>'), ('"0.50.5"',)),
        Case("longer name with a known beginning", swap('"$albedo"', '"$albedo2"'), ("$albedo2",)),
        Case("escaped parameter", swap('"$albedo"', r'"\$albedo"'), ("backslash",)),
        Case("lone dollar", put('<string name="x" value="a $ b"/>'), ("parameter: got $",)),
        Case("dollar by character reference", put('<string name="x" value="&#36;nope"/>'), ("$nope",)),
        Case("default without name", put('<default name="" value="1"/>'), ("default: got ''",)),
        Case("default of a strange name", put('<default name="a.b" value="1"/>'), ("default: got 'a.b'",)),
        Case(
            "define of markup", GOOD, ("name='reflectance'", "pairs"), defines=(("albedo", '"/><path value="/tmp"/>'),)
        ),
        Case(
            "define of a dollar", GOOD, ("parameter albedo", "without $"), line=False, defines=(("albedo", "$albedo"),)
        ),
        Case("define of a line break", GOOD, ("parameter albedo",), line=False, defines=(("albedo", "1\n2"),)),
        Case("define of a reflectance", GOOD, ("reflectance: got 7", "'$albedo'"), defines=(("albedo", "7"),)),
        Case("define of nothing known", GOOD, ("parameter nope=1", "albedo"), line=False, defines=(("nope", "1"),)),
        Case(
            "define of a keyword",
            put('<default name="filename" value="1"/>'),
            ("parameter filename",),
            line=False,
            defines=(("filename", "0"),),
        ),
        Case(
            "define that is not used",
            put('<default name="optimize" value="1"/>'),
            ("unused parameters: $optimize=0",),
            line=False,
            defines=(("optimize", "0"),),
        ),
        Case("empty define", GOOD, ("reflectance",), defines=(("albedo", ""),)),
    ]


def _sizes() -> list[Case]:
    chain = '<bsdf type="diffuse" id="b0"/>' + "".join(
        f'<bsdf type="mask" id="b{i + 1}"><ref id="b{i}"/></bsdf>' for i in range(4000)
    )
    double = '<bsdf type="diffuse" id="b0"/>' + "".join(
        f'<bsdf type="blendbsdf" id="b{i + 1}"><ref id="b{i}"/><ref id="b{i}"/></bsdf>' for i in range(12)
    )
    two = '<bsdf type="twosided">' * 11 + '<bsdf type="diffuse"/>' + "</bsdf>" * 11
    tower = "".join(f'<scene version="3.0.0"><include filename="p{i + 1}.xml"/></scene>\0' for i in range(20)).split(
        "\0"
    )

    def towers(folder: Path) -> None:
        for i, text in enumerate(tower[:-1]):
            (folder / f"p{i}.xml").write_text(text)

    def fans(folder: Path) -> None:
        for i in range(6):
            more = f'<include filename="p{i + 1}.xml"/>' * 10
            (folder / f"p{i}.xml").write_text(f'<scene version="3.0.0">{more}</scene>')
        (folder / "p6.xml").write_text('<scene version="3.0.0"/>')

    many = '<shape type="sphere"/>' * 6000
    return [
        Case("depth of 20", put('<bsdf type="mask">' * 20 + "</bsdf>" * 20), ("nested over 16",)),
        Case("depth of 100000", put("<a>" * 100000), ("nested over 16",)),
        Case("50000 elements", put("<shape/>" * 50000), ("10000 elements",)),
        Case("8 MiB", put("<!--" + "x" * (8 << 20) + "-->"), ("over 4 MiB",), line=False),
        Case("chain of 4000 references", put(chain), ("nesting", "16 levels")),
        Case("doubling references", put(double), ("nesting", "256 objects")),
        Case("doubling sides", ball(two), ("nesting",)),
        Case("reference to itself", put('<bsdf type="twosided" id="a"><ref id="a"/></bsdf>'), ("circular reference",)),
        Case(
            "two references in a ring",
            put('<bsdf type="mask" id="a"><ref id="b"/></bsdf><bsdf type="mask" id="b"><ref id="a"/></bsdf>'),
            ("circular reference",),
        ),
        Case(
            "ring by another name",
            put('<bsdf type="mask" id="a"><ref id="c"/></bsdf><alias id="a" as="c"/>'),
            ("circular reference",),
        ),
        Case("reference to nothing", ball('<ref id="nope"/>'), ('unresolved reference to "nope"',)),
        Case("id twice", put('<bsdf type="null" id="a"/><bsdf type="null" id="a"/>'), ('duplicate ID: "a"',)),
        Case("alias of nothing", put('<alias id="a" as="b"/>'), ('alias source ID "a" not found',)),
        Case("alias over an id", put('<alias id="paper" as="camera"/>'), ("already",)),
        Case("include of itself", put('<include filename="scene.xml"/>'), ("comes back to itself",)),
        Case(
            "include of itself by a detour",
            put('<include filename="./x/../scene.xml"/>'),
            ("comes back",),
            lambda f: (f / "x").mkdir(),
        ),
        Case(
            "include of its includer", *_second(included('<include filename="scene.xml"/>'), ("comes back to itself",))
        ),
        Case("tower of includes", put('<include filename="p0.xml"/>'), ("64 includes, 8 deep",), towers),
        Case("million includes", put('<include filename="p0.xml"/>'), ("64 includes",), fans),
        Case(
            "elements over several files",
            put(many + '<include filename="p.xml"/>'),
            ("10000 elements",),
            file("p.xml", f'<scene version="3.0.0">{many}</scene>'),
            line=False,
        ),
    ]


def _second(made: tuple[str, Prepare], says: tuple[str, ...]) -> tuple[str, tuple[str, ...], Prepare]:
    return made[0], says, made[1]


def _places() -> list[Case]:
    def link(name: str, to: str) -> Prepare:
        return lambda folder: (folder / name).symlink_to(to)

    def outside(name: str, content: str | bytes) -> Prepare:
        return lambda folder: file(name, content)(folder.parent)

    def native(name: str) -> Prepare:
        return file(name, b"\x7fELF")

    lies = "in the scene's folder"
    spectrum = skin("diffuse", '<spectrum name="reflectance" filename="{}"/>')
    return [
        Case("picture above", picture("../out.png"), (lies, "--allow-outside-files"), outside("out.png", png(2, 2))),
        Case(
            "picture by a detour",
            picture("x/../../out.png"),
            (lies,),
            lambda f: ((f / "x").mkdir(), outside("out.png", png(2, 2))(f)),
        ),
        Case("absolute file", picture("/etc/passwd"), (lies,)),
        Case("linked picture", picture("l.png"), (lies,), link("l.png", "/etc/passwd")),
        Case("linked folder", picture("l/passwd"), (lies,), link("l", "/etc")),
        Case("link to itself", picture("l.png"), ("no such file",), link("l.png", "l.png")),
        Case(
            "file by parameter",
            put('<default name="f" value="/etc/passwd"/>').replace(
                "</scene>", '<shape type="ply"><string name="filename" value="$f"/></shape></scene>'
            ),
            (lies,),
        ),
        Case("device", picture("/dev/zero"), (lies,)),
        Case("linked device", picture("z.png"), (lies,), link("z.png", "/dev/zero")),
        Case("pipe", picture("pipe.png"), ("plain file",), lambda folder: os.mkfifo(folder / "pipe.png")),
        Case(
            "included pipe",
            put('<include filename="pipe"/>'),
            ("plain file",),
            lambda folder: os.mkfifo(folder / "pipe"),
        ),
        Case("folder", picture("sub"), ("plain file",), lambda folder: (folder / "sub").mkdir()),
        Case("scene's folder", picture("."), ("plain file",)),
        Case("no name", picture(""), ("plain file",)),
        Case("empty file", picture("e.png"), ("plain file",), file("e.png", b"")),
        Case(
            "huge sparse file",
            picture("h.png"),
            ("512 MiB",),
            lambda folder: os.truncate(_touched(folder / "h.png"), 1 << 40),
        ),
        Case("missing file", picture("none.png"), ("no such file",)),
        Case("name of 5000 letters", picture("n" * 5000), ("no such file",)),
        Case("address", picture("http://localhost/x.png"), ("no such file",)),
        Case("file of the working folder", picture("pyproject.toml"), ("no such file",)),
        Case(
            "include above",
            put('<include filename="../p.xml"/>'),
            (lies,),
            outside("p.xml", '<scene version="3.0.0"/>'),
        ),
        Case("absolute include", put('<include filename="/etc/passwd"/>'), (lies,)),
        Case("include of nothing", put('<include filename=""/>'), ("plain file",)),
        Case("include of a picture", put('<include filename="projector.png"/>'), ("not well-formed",)),
        Case(
            "include of another root",
            put('<include filename="p.xml"/>'),
            ("version",),
            file("p.xml", '<path value="/"/>'),
        ),
        Case("spectrum above", spectrum.format("../s.spd"), (lies,), outside("s.spd", "400 1\n700 1\n")),
        Case(
            "spectrum of text",
            spectrum.format("s.spd"),
            ("s.spd", "wavelength in line 1"),
            file("s.spd", "root:x:0:0\n"),
        ),
        Case(
            "spectrum of no number",
            spectrum.format("s.spd"),
            ("reflectance: got nan",),
            file("s.spd", "400 nan\n700 1\n"),
        ),
        Case("spectrum above 1", spectrum.format("s.spd"), ("reflectance: got 3",), file("s.spd", "400 1\n700 3\n")),
        Case("negative spectrum", spectrum.format("s.spd"), ("got -3",), file("s.spd", "400 1\n700 -3\n")),
        Case("native plugin", GOOD, ("plugins/evil.so", "native code"), native("plugins/evil.so"), line=False),
        Case("native plugin of a stock name", GOOD, ("native code",), native("plugins/diffuse.so"), line=False),
        Case("native plugin in capitals", GOOD, ("native code",), native("PLUGINS/evil.SO"), line=False),
        Case("native plugin of Windows", GOOD, ("native code",), native("Plugins/evil.dll"), line=False),
        Case("native plugin of macOS", GOOD, ("native code",), native("plugins/evil.dylib"), line=False),
        Case(
            "linked plugins",
            GOOD,
            ("native code",),
            lambda folder: (file("hidden/evil.so", b"x")(folder), (folder / "plugins").symlink_to("hidden")),
            line=False,
        ),
        Case(
            "native plugin of an include",
            put('<include filename="sub/p.xml"/>'),
            ("native code",),
            lambda folder: (
                file("sub/p.xml", '<scene version="3.0.0"/>')(folder),
                native("sub/plugins/evil.so")(folder),
            ),
            line=False,
        ),
        Case(
            "fault in an include",
            *_second(
                included('\n<shape type="sphere"><float name="radius" value="-1"/></shape>'),
                ("part.xml:2: radius: got -1",),
            ),
        ),
        Case("path in an include", *_second(included('<path value="/tmp"/>'), ("part.xml:1: path", "native code"))),
    ]


def _touched(path: Path) -> Path:
    path.touch()
    return path


def _numbers() -> list[Case]:
    def number(name: str, value: str, kind: str = "float") -> str:
        return f'<{kind} name="{name}" value="{value}"/>'

    def camera(name: str, old: str, new: str, *says: str) -> Case:
        return Case(
            f"{name} {new}", swap(f'"{name}" value="{old}"', f'"{name}" value="{new}"'), (f"{name}: got", *says)
        )

    def turned(inside: str, *says: str) -> Case:
        return Case(inside, ball(f'<transform name="to_world">{inside}</transform>'), says)

    def rig(who: str, inside: str) -> Case:
        old = {"camera": '<rotate y="1" angle="0"/>', "projector": '<translate x="60"/>'}[who]
        return Case(f"{who} {inside}", swap(old, inside), ("to_world: got", "moved and turned only"))

    rough = '<bsdf type="roughconductor">{}</bsdf>'
    texture = '<texture name="reflectance" type="{}">{}</texture>'
    cases = [Case(f"radius {v}", ball(number("radius", v)), ("radius: got",)) for v in ("0", "-1", "nan", "inf", "1e9")]
    cases += [
        Case(f"reflectance {v}", skin("diffuse", number("reflectance", v, "spectrum")), ("reflectance",))
        for v in (
            "1.0001",
            "-0.1",
            "nan",
            "inf",
            "1e400",
            "0x1",
            "1_0",
            "400:0.5, 700:2",
            "400:0.5 nan",
            "700:0.1 400:0.1",
            "",
            "½",
        )
    ]
    cases += [
        Case(f"alpha {v}", ball(rough.format(number("alpha", v))), ("alpha: got", "above 0 to 1"))
        for v in ("0", "-0.1", "2")
    ]
    cases += [
        Case("empty number", swap('<float name="scale" value="111000"/>', number("scale", "")), ("scale: got ''",)),
        Case("name twice", skin("diffuse", texture.format("uniform", number("value", "0.5")) * 2), ("has it already",)),
        Case("number of 40 digits", ball(number("x", "99999999999", "integer")), ("x: got 1e+11",)),
        *(
            Case(f"{kind} with {name} {value}", skin(kind, number(name, value)), (f"{name}: got {float(value):g}",))
            for kind, name, value in (
                *(("principled", name, "1e10") for name in PRINCIPLED),
                *(("principledthin", name, "3") for name in ("sheen", "spec_tint", "flatness", "diff_trans")),
                *(("principled", "sheen", "-1"), ("principledthin", "diff_trans", "-0.1")),
                *(("conductor", "eta", "-1"), ("hair", "eumelanin", "-1"), ("polarizer", "transmittance", "2")),
            )
        ),
        Case(
            "sheen by a texture",
            skin("principled", texture.format("uniform", number("value", "9")).replace("reflectance", "sheen")),
            ("sheen: got 9",),
        ),
        Case(
            "opacity by a texture",
            skin("mask", texture.format("uniform", number("value", "9")).replace("reflectance", "opacity")),
            ("opacity: got 9",),
        ),
        Case(
            "colour above 1 in a checkerboard",
            skin(
                "diffuse",
                texture.format(
                    "checkerboard", texture.format("uniform", number("value", "3")).replace("reflectance", "color0")
                ),
            ),
            ("color0: got 3",),
        ),
        Case("light as a reflectance", skin("diffuse", texture.format("d65", "")), ("type: got 'd65'", "no light")),
        Case(
            "colours of vertices made brighter",
            skin(
                "diffuse",
                texture.format("mesh_attribute", number("name", "vertex_color", "string") + number("scale", "5")),
            ),
            ("reflectance: got 5",),
        ),
        Case(
            "projector with a part of its bitmap",
            swap(
                '<boolean name="raw" value="true"/>',
                '<boolean name="raw" value="true"/><transform name="to_uv"><scale x="2" y="2"/></transform>',
            ),
            ("to_uv: got", "window"),
        ),
        Case("colour above 1", skin("diffuse", number("reflectance", "0.1 0.2 1.5", "rgb")), ("got 1.5",)),
        Case("reflectance as a number", skin("diffuse", number("reflectance", "2")), ("reflectance: got 2",)),
        Case("uniform texture above 1", skin("diffuse", texture.format("uniform", number("value", "2"))), ("got 2",)),
        Case(
            "checkerboard above 1",
            skin("diffuse", texture.format("checkerboard", number("color0", "2", "rgb"))),
            ("got 2",),
        ),
        Case(
            "table above 1", skin("diffuse", texture.format("regular", number("values", "1, 2", "string"))), ("got 2",)
        ),
        Case("negative texture", skin("diffuse", texture.format("uniform", number("value", "-1"))), ("got -1",)),
        Case(
            "reflectance by reference",
            put(f'<texture id="t" type="uniform">{number("value", "3")}</texture>').replace(
                "</scene>", '<bsdf type="diffuse"><ref name="reflectance" id="t"/></bsdf></scene>'
            ),
            ("reflectance: got 3",),
        ),
        Case(
            "negative light",
            put(f'<emitter type="constant">{number("radiance", "-1", "spectrum")}</emitter>'),
            ("radiance: got -1",),
        ),
        Case(
            "light beyond single precision",
            put(f'<emitter type="constant">{number("radiance", "1e39", "rgb")}</emitter>'),
            ("radiance: got 1e+39",),
        ),
        Case("negative scale of the projector", swap('"111000"', '"-1"'), ("scale: got -1", "at least 0")),
        Case("index below 1", skin("dielectric", number("int_ior", "0.1")), ("int_ior: got 0.1", "1 to 10")),
        Case("index of 1e9", skin("dielectric", number("ext_ior", "1e9")), ("ext_ior: got 1e+09",)),
        Case("opacity 2", skin("mask", number("opacity", "2")), ("opacity: got 2",)),
        Case("two numbers for one", ball(number("radius", "1 2")), ("name='radius'", 'value "1 2"')),
        Case("no number", ball(number("radius", "")), ("radius: got ''",)),
        Case("a word", ball(number("radius", "big")), ("name='radius'", 'value "big"')),
        Case("digits of another script", ball(number("radius", "١٢")), ("name='radius'", "could not parse")),
        Case(
            "fraction for a whole number",
            swap('"max_depth" value="2"', '"max_depth" value="2.5"'),
            ("max_depth", 'integer value "2.5"'),
        ),
        Case(
            "whole number of 40 digits",
            swap('"max_depth" value="2"', f'"max_depth" value="{"9" * 40}"'),
            ("could not parse integer",),
        ),
        Case(
            "neither true nor false",
            swap('"flip_normals" value="true"', '"flip_normals" value="maybe"'),
            ('"true" or "false"',),
        ),
        Case(
            "point of two numbers",
            ball('<point name="center" x="1" y="2"/>'),
            ("center", 'missing required attribute "z"'),
        ),
        Case("point beyond 10 km", ball('<point name="center" value="0, 0, 1e30"/>'), ("center: got 1e+30",)),
        camera("fov", "20", "0"),
        camera("fov", "20", "180"),
        camera("fov", "20", "-20"),
        camera("mask_order", "9", "40", "equal to 16"),
        camera("mask_distance", "2", "0", "greater than"),
        camera("mask_distance", "2", "400", "less than scene_distance"),
        camera("mask_distance", "2", "-1"),
        camera("scene_distance", "400", "0.4", "1 unit is 1 mm", "metres"),
        camera("pixel_pitch", "0.01172", "1.172e-5", "1 unit is 1 mm", "metres"),
        camera("mask_feature", "0.06", "6e-5", "1 unit is 1 mm", "metres"),
        camera("width", "32", "1000000", "16384"),
        camera("height", "32", "0", "1 to 16384"),
        camera("sample_count", "4", "0"),
        camera("sample_count", "4", "999999999"),
        camera("max_depth", "2", "-7"),
        camera("max_depth", "2", "999999"),
        turned('<scale value="0"/>', "stretching by 0", "invertible"),
        turned('<scale x="1e-30" y="1e-30" z="1e-30"/>', "invertible"),
        turned('<scale value="1e30"/>', "stretching by 1e+30"),
        turned('<scale value="1 2"/>', "1 or 3 numbers"),
        turned('<scale value="1" x="2"/>', "1 or 3 numbers"),
        turned('<translate x="nan"/>', "to_world: got", "nan"),
        turned('<translate x="1e20"/>', "moving by 1e+20"),
        turned('<rotate angle="30"/>', "axis cannot be zero"),
        turned('<rotate x="1" angle="inf"/>', "to_world: got", "nan"),
        turned('<matrix value="1 2 3"/>', "9 or 16"),
        turned('<matrix value="1 0 0 0 1 0 0 0 0"/>', "invertible"),
        turned('<matrix value="1 0 0 0 0 1 0 0 0 0 1 0 0 0 1 1"/>', "last row"),
        turned('<matrix value="1 0 0 0 0 1 0 0 0 0 1 nan 0 0 0 1"/>', "to_world: got", "nan"),
        turned('<lookat origin="0 0 0" target="0 0 0"/>', "invalid lookat"),
        turned('<lookat origin="0 0 0" target="0 5 0" up="0 1 0"/>', "invalid lookat"),
        turned('<lookat origin="0 0" target="0 5 0"/>', "expected 3 values"),
        rig("camera", '<scale value="2"/>'),
        rig("camera", '<scale x="-1"/>'),
        rig("camera", '<scale z="1000"/>'),
        rig("camera", '<matrix value="1 0.1 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/>'),
        rig("projector", '<scale value="1000"/><translate x="60"/>'),
        rig("projector", '<scale x="-1"/>'),
    ]
    return cases


def _contents() -> list[Case]:
    def shown(name: str, content: str | bytes, *says: str) -> Case:
        return Case(f"picture: {name}", picture("p.png"), ("filename: got 'p.png'", *says), file("p.png", content))

    def meshed(name: str, content: str | bytes, *says: str, kind: str = "ply") -> Case:
        return Case(
            f"{kind}: {name}", mesh(f"m.{kind}", kind), (f"filename: got 'm.{kind}'", *says), file(f"m.{kind}", content)
        )

    def header(vertices: object = 3, faces: object = 1, kind: str = "binary_little_endian") -> bytes:
        return (
            MESH[: MESH.index("end_header") + 11]
            .replace("ascii", kind)
            .replace("vertex 3", f"vertex {vertices}")
            .replace("face 1", f"face {faces}")
            .encode()
        )

    points = struct.pack("<9f", 0, 0, 500, 9, 0, 500, 0, 9, 500)
    good = header() + points + struct.pack("<B3i", 3, 0, 1, 2)
    large = b"PF\n30000 30000\n-1.0\n"
    return [
        shown("claims 2^31 texels", png(4, 4, (65535, 32769)), "65535x32769"),
        shown("claims no texels", png(4, 4, (0, 4)), "damaged PNG"),
        shown("claims 2^32 a side", png(4, 4, (0xFFFFFFFF, 0xFFFFFFFF)), "4294967295"),
        shown("text", "hello", "no PNG"),
        shown("SVG", '<svg xmlns="http://www.w3.org/2000/svg"/>', "no PNG"),
        shown("GIF", b"GIF89a" + bytes(20), "no PNG"),
        shown("cut JPEG", b"\xff\xd8\xff\xe0\0\x10JFIF", "damaged PNG or JPEG"),
        shown("huge JPEG", jpeg(65535, 65535), "65535x65535"),
        shown("JPEG behind a marker without length", jpeg(20000, 20000, hidden=True), "20000x20000"),
        shown(
            "JPEG of two sizes", jpeg(4, 4).replace(b"\xff\xda", jpeg(20000, 20000)[2:-8] + b"\xff\xda"), "20000x20000"
        ),
        shown("huge PFM", large, "30000x30000"),
        shown("huge HDR", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 90000 +X 90000\n", "90000x90000"),
        shown(
            "huge HDR with a blank",
            b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 20000 +X 20000 \n-Y 4 +X 4\n",
            "Radiance",
        ),
        shown("HDR without a size", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n", "Radiance"),
        shown("PFM of no numbers", b"PF\nx 4\n-1.0\n", "PFM"),
        shown("cut EXR", b"\x76\x2f\x31\x01\x02\0\0\0chan", "cut short"),
        shown("EXR with an attribute of 2 GB", b"\x76\x2f\x31\x01\x02\0\0\0a\0string\0\xff\xff\xff\x7f", "cut short"),
        Case(
            "pictures that are large together",
            picture("p.png").replace(
                "</bsdf></shape>\n</scene>",
                '</bsdf></shape><emitter type="envmap"><string name="filename" value="p.png"/></emitter></scene>',
            ),
            ("texels: got 3.6",),
            file("p.png", png(4, 4, (4500, 4000))),
        ),
        meshed("text", "hello", "no PLY"),
        meshed("no end of header", b"ply\n" + b"comment x\n" * 9999, "no PLY"),
        meshed("a billion vertices", header(999999999) + points, "more than its bytes hold"),
        meshed("a billion faces", header(3, 999999999) + points, "more than its bytes hold"),
        meshed("10^20 vertices", header(10**20) + points, "not understood"),
        meshed("-1 vertices", header(-1) + points, "not understood"),
        meshed("corner beyond the vertices", header() + points + struct.pack("<B3i", 3, 0, 1, 99999999), "3 vertices"),
        meshed("negative corner", header() + points + struct.pack("<B3i", 3, 0, 1, -1), "3 vertices"),
        meshed("corner beyond the vertices, as text", MESH.replace("3 0 1 2", "3 0 1 99999999"), "3 vertices"),
        meshed("faces of 255 corners", header() + points + struct.pack("<B3i", 255, 0, 1, 2), "no triangles"),
        meshed("cut short", good[:-1], "more than its bytes hold"),
        meshed("cut short, as text", MESH[:-3], "more than its text holds"),
        meshed(
            "vertex not finite",
            header() + struct.pack("<9f", float("nan"), *range(8)) + struct.pack("<B3i", 3, 0, 1, 2),
            "not finite",
        ),
        meshed(
            "vertex beyond 10 km",
            header() + struct.pack("<9f", 1e30, *range(8)) + struct.pack("<B3i", 3, 0, 1, 2),
            "beyond 1e+07",
        ),
        meshed("words for numbers", MESH.replace("9 0 500", "9 zero 500"), "no numbers"),
        meshed("unknown format", good.replace(b"binary_little_endian", b"binary_odd"), "no format"),
        meshed("unknown type", good.replace(b"float x", b"quad x"), "not understood"),
        meshed(
            "faces first",
            good.replace(b"element face", b"element vertex").replace(b"element vertex", b"element face", 1),
            "other than vertex and face",
        ),
        meshed(
            "further elements",
            MESH.replace("end_header", "element tristrips 1\nproperty int a\nend_header"),
            "other than vertex and face",
        ),
        meshed(
            "line ends of another kind",
            good.replace(b"float z\n", b"float z\ncomment \x85property float w\n").replace(points, points[:-4]),
            "more than its bytes hold",
        ),
        meshed("text", "hello", "no vertices", kind="obj"),
        meshed("vertex not finite", OBJ.replace("9 0 500", "nan 0 500"), "not finite", kind="obj"),
        meshed("two coordinates", OBJ.replace("9 0 500", "9 0"), "three numbers", kind="obj"),
        meshed("words", OBJ.replace("9 0 500", "9 zero 0"), "three numbers", kind="obj"),
    ]


CASES = [
    *_not_well_formed(),
    *_not_allowed(),
    *_parameters(),
    *_sizes(),
    *_places(),
    *_numbers(),
    *_contents(),
]

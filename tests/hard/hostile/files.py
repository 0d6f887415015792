"""Scenes that are too large or too deep, that reach for files outside their folder, or whose files are damaged."""

from __future__ import annotations

import io
import os
import struct
from pathlib import Path

from PIL import Image

from tests.hard.hostile import GOOD, MESH, OBJ, Case, Prepare, file, jpeg, mesh, picture, png, put, skin


def _sizes() -> list[Case]:
    chain = '<bsdf type="diffuse" id="b0"/>' + "".join(
        f'<bsdf type="mask" id="b{i + 1}"><ref id="b{i}"/></bsdf>' for i in range(4000)
    )
    double = '<bsdf type="diffuse" id="b0"/>' + "".join(
        f'<bsdf type="blendbsdf" id="b{i + 1}"><ref id="b{i}"/><ref id="b{i}"/></bsdf>' for i in range(12)
    )

    def towers(folder: Path) -> None:
        for i in range(20):
            (folder / f"p{i}.xml").write_text(f'<scene version="3.0.0"><include filename="p{i + 1}.xml"/></scene>')

    def fans(folder: Path) -> None:
        for i in range(6):
            more = f'<include filename="p{i + 1}.xml"/>' * 10
            (folder / f"p{i}.xml").write_text(f'<scene version="3.0.0">{more}</scene>')
        (folder / "p6.xml").write_text('<scene version="3.0.0"/>')

    many = '<shape type="sphere"/>' * 6000
    return [
        Case("depth of 20", put('<bsdf type="mask">' * 20 + "</bsdf>" * 20), "nested over 16"),
        Case("depth of 100000", put("<a>" * 100000), "nested over 16"),
        Case("50000 elements", put("<shape/>" * 50000), "10000 elements"),
        Case("8 MiB", put("<!--" + "x" * (8 << 20) + "-->"), "over 4 MiB", line=False),
        Case("chain of 4000 references", put(chain), ("nesting", "16 levels")),
        Case("doubling references", put(double), ("nesting", "256 objects")),
        Case(
            "include of itself by a detour",
            put('<include filename="./x/../scene.xml"/>'),
            "comes back",
            lambda f: (f / "x").mkdir(),
        ),
        Case("tower of includes", put('<include filename="p0.xml"/>'), "64 includes, 8 deep", towers),
        Case("million includes", put('<include filename="p0.xml"/>'), "64 includes", fans),
        Case(
            "elements over several files",
            put(many + '<include filename="p.xml"/>'),
            "10000 elements",
            file("p.xml", f'<scene version="3.0.0">{many}</scene>'),
            line=False,
        ),
    ]


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
        Case("linked picture", picture("l.png"), lies, link("l.png", "/etc/passwd")),
        Case("link to itself", picture("l.png"), "no such file", link("l.png", "l.png")),
        Case("pipe", picture("pipe.png"), "plain file", lambda folder: os.mkfifo(folder / "pipe.png")),
        Case("folder", picture("sub"), "plain file", lambda folder: (folder / "sub").mkdir()),
        Case("empty file", picture("e.png"), "plain file", file("e.png", b"")),
        Case(
            "huge sparse file",
            picture("h.png"),
            "512 MiB",
            lambda folder: ((folder / "h.png").touch(), os.truncate(folder / "h.png", 1 << 40)),
        ),
        Case(
            "include above", put('<include filename="../p.xml"/>'), lies, outside("p.xml", '<scene version="3.0.0"/>')
        ),
        Case("spectrum above", spectrum.format("../s.spd"), lies, outside("s.spd", "400 1\n700 1\n")),
        Case("native plugin", GOOD, ("plugins/evil.so", "native code"), native("plugins/evil.so"), line=False),
        Case("native plugin of a stock name", GOOD, "native code", native("plugins/diffuse.so"), line=False),
        Case(
            "linked plugins",
            GOOD,
            "native code",
            lambda folder: (file("hidden/evil.so", b"x")(folder), (folder / "plugins").symlink_to("hidden")),
            line=False,
        ),
        Case(
            "native plugin of an include",
            put('<include filename="sub/p.xml"/>'),
            "native code",
            lambda folder: (
                file("sub/p.xml", '<scene version="3.0.0"/>')(folder),
                native("sub/plugins/evil.so")(folder),
            ),
            line=False,
        ),
    ]


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

    def saved(kind: str, **more: object) -> bytes:
        held, exif = io.BytesIO(), Image.Exif()
        exif[274] = 6
        Image.new("L", (4, 8), 128).save(held, kind, **{"exif": exif, **more})
        return held.getvalue()

    frames = {"exif": b"", "save_all": True, "append_images": [Image.new("L", (4, 8))]}
    large = b"PF\n30000 30000\n-1.0\n"
    return [
        shown("claims 2^31 texels", png(4, 4, (65535, 32769)), "65535x32769"),
        shown("claims no texels", png(4, 4, (0, 4)), "damaged PNG"),
        shown("text", "hello", "no PNG"),
        shown("cut JPEG", b"\xff\xd8\xff\xe0\0\x10JFIF", "damaged PNG or JPEG"),
        shown("huge JPEG", jpeg(65535, 65535), "65535x65535"),
        shown("JPEG behind a marker without length", jpeg(20000, 20000, hidden=True), "20000x20000"),
        shown(
            "JPEG of two sizes", jpeg(4, 4).replace(b"\xff\xda", jpeg(20000, 20000)[2:-8] + b"\xff\xda"), "20000x20000"
        ),
        shown("turned JPEG", saved("JPEG"), "orientation 6"),
        shown("animated PNG", saved("PNG", **frames), "animated"),
        shown("huge PFM", large, "30000x30000"),
        shown("huge HDR", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 90000 +X 90000\n", "90000x90000"),
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
            "texels: got 3.6",
            file("p.png", png(4, 4, (4500, 4000))),
        ),
        meshed("text", "hello", "no PLY"),
        meshed("no end of header", b"ply\n" + b"comment x\n" * 9999, "no PLY"),
        meshed("a billion vertices", header(999999999) + points, "more than its bytes hold"),
        meshed("-1 vertices", header(-1) + points, "not understood"),
        meshed("corner beyond the vertices", header() + points + struct.pack("<B3i", 3, 0, 1, 99999999), "3 vertices"),
        meshed("faces of 255 corners", header() + points + struct.pack("<B3i", 255, 0, 1, 2), "no triangles"),
        meshed("cut short", good[:-1], "more than its bytes hold"),
        meshed(
            "vertex not finite",
            header() + struct.pack("<9f", float("nan"), *range(8)) + struct.pack("<B3i", 3, 0, 1, 2),
            "not finite",
        ),
        meshed("words for numbers", MESH.replace("9 0 500", "9 zero 500"), "no numbers"),
        meshed("unknown format", good.replace(b"binary_little_endian", b"binary_odd"), "no format"),
        meshed(
            "vertices with a list",
            good.replace(b"element face", b"element vertex").replace(b"element vertex", b"element face", 1),
            "a list in element vertex",
        ),
        meshed(
            "further elements with a list",
            MESH.replace("end_header", "element tristrips 1\nproperty list int int a\nend_header"),
            "a list in element tristrips",
        ),
        meshed(
            "a billion of further elements",
            MESH.replace("end_header", "element nothing 999999999\nend_header"),
            "element nothing without properties",
        ),
        meshed("whole numbers for coordinates", MESH.replace("float x", "int x"), "of type float or double"),
        meshed("no faces", header(3, 0) + points, "cloud of points"),
        meshed("bytes after the last face", good + b"\0", "more than its header"),
        meshed(
            "line ends of another kind",
            good.replace(b"float z\n", b"float z\ncomment \x85property float w\n").replace(points, points[:-4]),
            "more than its bytes hold",
        ),
        meshed("text", "hello", "not understood, 1 ('hello')", kind="obj"),
        meshed("vertex not finite", OBJ.replace("9 0 500", "nan 0 500"), "not finite", kind="obj"),
    ]


CASES = [*_sizes(), *_places(), *_contents()]

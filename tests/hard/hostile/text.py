"""Scenes whose text is wrong: XML that is none, tags and attributes that no scene has, parameters that nobody set."""

from __future__ import annotations

from tests.hard.hostile import GOOD, Case, ball, mesh, png, put, skin, swap

_OBJECT_FOR_FILE = '<texture name="filename" type="checkerboard"/>'


def _not_well_formed() -> list[Case]:
    words = ("not well-formed",)
    return [
        Case("empty", "", words),
        Case("cut short", GOOD[: len(GOOD) // 2], words),
        Case("text after the root", GOOD + "more", words),
        Case("crossed tags", put("<shape><bsdf></shape></bsdf>"), words),
        Case("unknown entity", put("&nope;"), words),
        Case("character of a surrogate", put("&#xD800;"), words),
        Case("zero byte", GOOD.encode().replace(b"<!--here-->", b"\0"), words),
        Case("bytes of no encoding", GOOD.encode().replace(b"<!--here-->", b"<!--\xff\xfe-->"), words),
        Case("overlong UTF-8", GOOD.encode().replace(b"<!--here-->", b"<!--\xc0\xbc-->"), words),
        Case("UTF-16", GOOD.replace("utf-8", "utf-16").encode("utf-16"), words),
        Case("UTF-32", GOOD.encode("utf-32"), words),
        Case("a picture", png(4, 4), words),
    ]


def _not_allowed() -> list[Case]:
    latin = GOOD.replace("utf-8", "iso-8859-1")
    bomb = "".join(f'<!ENTITY a{i + 1} "{f"&a{i};" * 10}">' for i in range(9))
    first = GOOD.index("<scene")
    dtd = GOOD[:first] + "{}" + GOOD[first:]
    return [
        Case("latin-1", latin, ("encoding: got 'iso-8859-1'", "UTF-8")),
        Case("unknown encoding", GOOD.replace("utf-8", "none-such"), ("UTF-8",)),
        Case("DTD", dtd.format("<!DOCTYPE scene>"), ("DTD",)),
        Case("entity", dtd.format('<!DOCTYPE scene [<!ENTITY a "b">]>'), ("DTD",)),
        Case("billion laughs", dtd.format(f'<!DOCTYPE scene [<!ENTITY a0 "ha">{bomb}]>'), ("DTD",)),
        Case("external entity", dtd.format('<!DOCTYPE s [<!ENTITY a SYSTEM "file:///etc/passwd">]>'), ("DTD",)),
        Case("style sheet", dtd.format('<?xml-stylesheet href="x.xsl"?>'), ("processing instruction",)),
        Case("other root", '<shape version="3.0.0" type="sphere"/>', ("<shape>", "<scene>")),
        Case("no version", GOOD.replace('scene version="3.0.0"', "scene"), ("version: got none",)),
        Case("old version", swap('"3.0.0"', '"0.6.0"'), ("version: got 0.6.0", "2 and 3")),
        Case("future version", swap('"3.0.0"', '"9999999999.0.0"'), ("version",)),
        Case("version by parameter", swap('"3.0.0"', '"$albedo"'), ("version",)),
        Case("unknown tag", put("<sphere/>"), ("refuses <sphere>", "unsupported XML element")),
        Case("tag of a namespace", put('<m:shape xmlns:m="x" type="sphere"/>'), ("m:shape",)),
        Case("unknown attribute", put('<shape type="sphere" onload="x"/>'), ('unexpected attribute "onload"',)),
        Case("shape without type", put("<shape/>"), ('missing required attribute "type"',)),
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
        Case("path", put('<path value="/tmp"/>'), ("path: got '/tmp'", "native code")),
        Case("plugin with a path", put('<shape type="../../tmp/evil"/>'), ("type: got '../../tmp/evil'",)),
        Case("plugin with a backslash", put(r'<shape type="..\evil"/>'), ("backslash",)),
        Case("empty plugin", put('<shape type=""/>'), ("type: got ''",)),
        Case(
            "plugin by parameter",
            put('<default name="t" value="../evil"/><shape type="$t"/>'),
            ("type: got '../evil'",),
        ),
        Case("plugin of another tag", put('<bsdf type="sphere"/>'), ("type: got 'sphere'", "allowed are")),
        Case("misspelt plugin", put('<shape type="spere"/>'), ("did you mean sphere",)),
        Case("plugin of a thousand letters", put(f'<shape type="{"a" * 99999}"/>'), ("type: got 'aaa", "...")),
        Case("plugin with a new line", put('<shape type="a&#10;b"/>'), ("type: got",)),
        Case("plugin with an escape sequence", put('<shape type="\u009b31m"/>'), ("type: got", "allowed are")),
        Case("serialized mesh", put('<shape type="serialized"/>'), ("type: got 'serialized'",)),
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
            "transform without a name in a texture",
            skin(
                "diffuse",
                '<texture name="reflectance" type="checkerboard"><transform name=""><scale x="3"/></transform>'
                "</texture>",
            ),
            ("name: got ''",),
        ),
    ]


def _parameters() -> list[Case]:
    return [
        Case("unknown parameter", swap('"$albedo"', '"$albdo"'), ("parameter: got $albdo", "albedo")),
        Case("parameter before its default", swap("<default", '<include filename="$a"/><default'), ("$a",)),
        Case("parameter in a parameter", put('<default name="b" value="$albedo"/>'), ("without $",)),
        Case("parameters that touch", put('<float name="x" value="$albedo$albedo"/>'), ('"0.50.5"',)),
        Case("escaped parameter", swap('"$albedo"', r'"\$albedo"'), ("backslash",)),
        Case("lone dollar", put('<string name="x" value="a $ b"/>'), ("parameter: got $",)),
        Case("dollar by character reference", put('<string name="x" value="&#36;nope"/>'), ("$nope",)),
        Case("default without name", put('<default name="" value="1"/>'), ("default: got ''",)),
        Case(
            "define of markup", GOOD, ("name='reflectance'", "pairs"), defines=(("albedo", '"/><path value="/tmp"/>'),)
        ),
        Case(
            "define of a dollar", GOOD, ("parameter albedo", "without $"), line=False, defines=(("albedo", "$albedo"),)
        ),
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
    ]


CASES = [*_not_well_formed(), *_not_allowed(), *_parameters()]

"""Scenes whose text is wrong: XML that is none, tags and attributes that no scene has, parameters that nobody set."""

from __future__ import annotations

from tests.hard.hostile import GOOD, Case, ball, mesh, png, put, skin, swap

_OBJECT_FOR_FILE = '<texture name="filename" type="checkerboard"/>'


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


CASES = [*_not_well_formed(), *_not_allowed(), *_parameters()]

"""Scenes whose text is wrong: XML that is none, and those of scenes.toml, each a small edit of the good scene."""

from __future__ import annotations

from pathlib import Path

from mitsim.core.configuration import read_toml
from tests.hard.hostile import GOOD, Case, ball, file, mesh, nothing, picture, png, put, skin, swap

EDITS = {edit.__name__: edit for edit in (put, swap, ball, skin, picture, mesh)}


def _not_well_formed() -> list[Case]:
    words = ("not well-formed",)
    return [
        Case("empty", "", words),
        Case("cut short", GOOD[: len(GOOD) // 2], words),
        Case("text after the root", GOOD + "more", words),
        Case("zero byte", GOOD.encode().replace(b"<!--here-->", b"\0"), words),
        Case("bytes of no encoding", GOOD.encode().replace(b"<!--here-->", b"<!--\xff\xfe-->"), words),
        Case("overlong UTF-8", GOOD.encode().replace(b"<!--here-->", b"<!--\xc0\xbc-->"), words),
        Case("UTF-16", GOOD.replace("utf-8", "utf-16").encode("utf-16"), words),
        Case("UTF-32", GOOD.encode("utf-32"), words),
        Case("a picture", png(4, 4), words),
    ]


def _not_allowed() -> list[Case]:
    bomb = "".join(f'<!ENTITY a{i + 1} "{f"&a{i};" * 10}">' for i in range(9))
    first = GOOD.index("<scene")
    dtd = GOOD[:first] + "{}" + GOOD[first:]
    twice = mesh("mesh.ply").replace("/></shape>", '/><string name="filename" value="a"/></shape>')
    referred = put('<texture id="t" type="uniform"><float name="value" value="3"/></texture>').replace(
        "</scene>", '<bsdf type="diffuse"><ref name="reflectance" id="t"/></bsdf></scene>'
    )
    return [
        Case("latin-1", GOOD.replace("utf-8", "iso-8859-1"), ("encoding: got 'iso-8859-1'", "UTF-8")),
        Case("unknown encoding", GOOD.replace("utf-8", "none-such"), ("UTF-8",)),
        Case("DTD", dtd.format("<!DOCTYPE scene>"), ("DTD",)),
        Case("entity", dtd.format('<!DOCTYPE scene [<!ENTITY a "b">]>'), ("DTD",)),
        Case("billion laughs", dtd.format(f'<!DOCTYPE scene [<!ENTITY a0 "ha">{bomb}]>'), ("DTD",)),
        Case("external entity", dtd.format('<!DOCTYPE s [<!ENTITY a SYSTEM "file:///etc/passwd">]>'), ("DTD",)),
        Case("style sheet", dtd.format('<?xml-stylesheet href="x.xsl"?>'), ("processing instruction",)),
        Case("other root", '<shape version="3.0.0" type="sphere"/>', ("<shape>", "<scene>")),
        Case("no version", GOOD.replace('scene version="3.0.0"', "scene"), ("version: got none",)),
        Case("plugin of a thousand letters", put(f'<shape type="{"a" * 99999}"/>'), ("type: got 'aaa", "...")),
        Case("two files", twice, ("name: got 'filename'", "has it already")),
        Case("reflectance by reference", referred, ("reflectance: got 3",)),
    ]


def _listed() -> list[Case]:
    cases = []
    for name, told in read_toml(Path(__file__).parent / "scenes.toml").items():
        content = next((edit(*told[kind]) for kind, edit in EDITS.items() if kind in told), GOOD)
        defines = tuple(told.get("defines", {}).items())
        prepare = file(*told["file"]) if "file" in told else nothing
        cases.append(Case(name, content, tuple(told["says"]), prepare, told.get("line", True), defines))
    return cases


CASES = [*_not_well_formed(), *_not_allowed(), *_listed()]

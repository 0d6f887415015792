"""Scenes with values that no device, transform or material can have."""

from __future__ import annotations

from tests.hard.hostile import PRINCIPLED, Case, ball, put, skin, swap


def _numbers() -> list[Case]:
    def number(name: str, value: str, kind: str = "float") -> str:
        return f'<{kind} name="{name}" value="{value}"/>'

    def camera(name: str, old: str, new: str, *says: str) -> Case:
        return Case(
            f"{name} {new}", swap(f'"{name}" value="{old}"', f'"{name}" value="{new}"'), (f"{name}: got", *says)
        )

    def turned(inside: str, *says: str) -> Case:
        return Case(inside, ball(f'<transform name="to_world">{inside}</transform>'), says)

    def posed(who: str, inside: str) -> Case:
        old = {"camera": '<rotate y="1" angle="0"/>', "projector": '<translate x="60"/>'}[who]
        return Case(f"{who} {inside}", swap(old, inside), ("to_world: got", "moved and turned only"))

    rough = '<bsdf type="roughconductor">{}</bsdf>'
    texture = '<texture name="reflectance" type="{}">{}</texture>'
    cases = [Case(f"radius {v}", ball(number("radius", v)), ("radius: got",)) for v in ("0", "-1", "nan", "inf", "1e9")]
    cases += [
        Case(f"reflectance {v}", skin("diffuse", number("reflectance", v, "spectrum")), ("reflectance",))
        for v in ("1.0001", "nan", "1e400", "1_0", "400:0.5, 700:2", "700:0.1 400:0.1", "")
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
        Case(
            "checkerboard above 1",
            skin("diffuse", texture.format("checkerboard", number("color0", "2", "rgb"))),
            ("got 2",),
        ),
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
        Case("opacity 2", skin("mask", number("opacity", "2")), ("opacity: got 2",)),
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
        camera("mask_order", "9", "40", "from 2 to 16"),
        camera("mask_distance", "2", "0", "from 1e-09"),
        camera("mask_distance", "2", "400", "less than scene_distance"),
        camera("scene_distance", "400", "0.4", "1 unit is 1 mm", "metres"),
        camera("pixel_pitch", "0.01172", "1.172e-5", "1 unit is 1 mm", "metres"),
        camera("width", "32", "1000000", "16384"),
        camera("height", "32", "0", "1 to 16384"),
        camera("sample_count", "4", "0"),
        camera("max_depth", "2", "-7"),
        turned('<scale value="0"/>', "stretching by 0", "invertible"),
        turned('<scale value="1e30"/>', "stretching by 1e+30"),
        turned('<scale value="1 2"/>', "1 or 3 numbers"),
        turned('<translate x="nan"/>', "to_world: got", "nan"),
        turned('<translate x="1e20"/>', "moving by 1e+20"),
        turned('<rotate angle="30"/>', "axis cannot be zero"),
        turned('<matrix value="1 2 3"/>', "9 or 16"),
        turned('<matrix value="1 0 0 0 0 1 0 0 0 0 1 0 0 0 1 1"/>', "last row"),
        turned('<lookat origin="0 0 0" target="0 0 0"/>', "invalid lookat"),
        turned('<lookat origin="0 0" target="0 5 0"/>', "expected 3 values"),
        posed("camera", '<scale value="2"/>'),
        posed("camera", '<matrix value="1 0.1 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/>'),
        posed("projector", '<scale value="1000"/><translate x="60"/>'),
    ]
    return cases


CASES = _numbers()

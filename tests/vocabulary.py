"""A small scene for each plugin that a scene may have, and what a run of all verbs on it gave.

``python -m tests.vocabulary VARIANT FOLDER [NAMES]`` runs them all in one variant and prints one JSON object: for each
plugin, as "tag type", a line for each verb that did not end with a finite frame.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mitsim.core.errors import MitsimError
from mitsim.scene.check import PLUGINS, STRAIGHT
from tests import measured_tables
from tests.conftest import write_png, write_small_scene

PLATE = '<shape type="rectangle"><transform name="to_world"><rotate y="1" angle="180"/><scale x="20" y="20"/>'
PLATE += '<translate x="{x}" y="{y}" z="{z}"/></transform>{inside}</shape>'
BALL = '<shape type="sphere"><point name="center" x="0" y="0" z="370"/><float name="radius" value="15"/>{}</shape>'
GREY = '<bsdf type="diffuse"><spectrum name="reflectance" value="0.4"/></bsdf>'
FLOAT = '<float name="{}" value="{}"/>'

_NESTED = {
    "blendbsdf": f'<float name="weight" value="0.3"/>{GREY}<bsdf type="roughconductor"/>',
    "bumpmap": f'<texture name="arbitrary" type="bitmap"><string name="filename" value="grey.png"/></texture>{GREY}',
    "mask": f'<float name="opacity" value="0.5"/>{GREY}',
    "measured": '<string name="filename" value="table.bsdf"/>',
    "mitsim_glass": '<string name="glass" value="n-bk7"/>',
    "mitsim_grating": FLOAT.format("pitch", 1600),
    "normalmap": '<texture name="normalmap" type="bitmap"><string name="filename" value="normals.png"/>'
    f'<boolean name="raw" value="true"/></texture>{GREY}',
    "twosided": GREY,
}
"""What a BSDF needs inside."""
_TEXTURES = {
    "bitmap": '<string name="filename" value="colours.png"/>',
    "blackbody": FLOAT.format("temperature", 3000),
    "irregular": '<string name="wavelengths" value="400, 500, 700"/><string name="values" value="0.2, 0.4, 0.5"/>',
    "mesh_attribute": '<string name="name" value="vertex_color"/>',
    "rawconstant": FLOAT.format("value", 0.4),
    "regular": FLOAT.format("wavelength_min", 360)
    + FLOAT.format("wavelength_max", 830)
    + '<string name="values" value="0.2, 0.4, 0.5"/>',
    "srgb": '<rgb name="color" value="0.2, 0.4, 0.6"/>',
    "uniform": FLOAT.format("value", 0.4),
}
_LIGHTS = ("blackbody", "d65")
"""Textures that are light: what they stand for is a lamp's radiance."""
_MESH = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property float r
property float g
property float b
element face 2
property list uchar int vertex_indices
end_header
-20 -20 0 0.1 0.2 0.3
-20 20 0 0.4 0.5 0.6
20 20 0 0.7 0.8 0.9
20 -20 0 0.3 0.3 0.3
3 0 1 2
3 0 2 3
"""
_OBJ = "v -20 -20 0\nv -20 20 0\nv 20 20 0\nv 20 -20 0\nf 1 2 3\nf 1 3 4\n"
_AT = '<transform name="to_world"><translate z="380"/></transform>'


def scene(folder: Path, tag: str, plugin: str) -> Path:
    """A scene in ``folder`` that has the ``plugin`` under its ``tag``."""
    folder.mkdir(parents=True, exist_ok=True)
    write_png(folder / "grey.png", np.linspace(40, 200, 64).reshape(8, 8))
    write_png(folder / "colours.png", np.random.default_rng(1).integers(0, 256, (8, 8, 3)))
    write_png(folder / "normals.png", np.broadcast_to([128, 128, 255], (4, 4, 3)))
    measured_tables.save(folder / "table.bsdf", measured_tables.known(0.3))
    (folder / "lamp.ies").write_text("IES TILT=NONE 1 -1 1 2 1 1 2 0 0 0 1 1 1 0 90 0 100 50")
    (folder / "mesh.ply").write_text(_MESH)
    (folder / "mesh.obj").write_text(_OBJ)
    path = write_small_scene(folder, f"{tag}_{plugin}", 4, pixels=16, mask="open", extra=_extra(tag, plugin))
    text = path.read_text()
    for old, new in _replaced(tag, plugin):
        assert old in text
        text = text.replace(old, new, 1)
    path.write_text(text)
    return path


def _extra(tag: str, plugin: str) -> str:
    """What is added to the scene."""
    if tag == "bsdf":
        return BALL.format(f'<bsdf type="{plugin}">{_NESTED.get(plugin, "")}</bsdf>')
    if tag in ("texture", "spectrum"):
        light = plugin in _LIGHTS
        inside = _TEXTURES.get(plugin, "")
        texture = f'<{tag} name="{"radiance" if light else "reflectance"}" type="{plugin}">{inside}</{tag}>'
        holder = f'<emitter type="area">{texture}</emitter>' if light else f'<bsdf type="diffuse">{texture}</bsdf>'
        return f'<shape type="ply"><string name="filename" value="mesh.ply"/>{_AT}{holder}</shape>'
    if tag == "emitter":
        return {
            "area": BALL.format('<emitter type="area"><spectrum name="radiance" value="0.1"/></emitter>'),
            "constant": '<emitter type="constant"><spectrum name="radiance" value="0.1"/></emitter>',
            "directional": '<emitter type="directional"><vector name="direction" x="0" y="0.3" z="1"/></emitter>',
            "envmap": '<emitter type="envmap"><string name="filename" value="grey.png"/></emitter>',
            "mitsim_ies": '<emitter type="mitsim_ies"><string name="filename" value="lamp.ies"/></emitter>',
            "mitsim_projector": _LENS,
            "point": '<emitter type="point"><point name="position" x="0" y="40" z="200"/></emitter>',
            "projector": "",
            "spot": '<emitter type="spot"><transform name="to_world"><translate y="40"/></transform></emitter>',
        }[plugin]
    if tag == "shape":
        return _shape(plugin)
    medium = f'<medium name="interior" type="homogeneous">{FLOAT.format("sigma_t", 0.01)}%s</medium>'
    if tag in ("medium", "volume"):
        volume = '<volume name="albedo" type="constvolume"><float name="value" value="0.5"/></volume>'
        return BALL.format('<bsdf type="null"/>' + medium % volume)
    if tag == "phase":
        inside = '<phase type="isotropic"/><phase type="rayleigh"/><float name="weight" value="0.5"/>'
        inside = inside if plugin == "blendphase" else ""
        return BALL.format('<bsdf type="null"/>' + medium % f'<phase type="{plugin}">{inside}</phase>')
    if tag == "sensor" and plugin != "mitsim_lensless":
        film = '<film type="hdrfilm"><integer name="width" value="1"/><integer name="height" value="1"/>'
        film += '<rfilter type="box"/></film>'
        sensor = f'<sensor type="{plugin}">{FLOAT.format("aperture_radius", 1) if plugin == "thinlens" else ""}{film}'
        return (
            PLATE.format(x=0, y=0, z=500, inside=sensor + "</sensor>")
            if plugin == "irradiancemeter"
            else (sensor + "</sensor>")
        )
    return ""


_LENS = f"""<shape type="disk"><transform name="to_world"><scale x="2" y="2"/><translate x="-60"/></transform>
<bsdf type="diffuse"><spectrum name="reflectance" value="0"/></bsdf><emitter type="mitsim_projector">
<transform name="to_world"><translate x="-60"/></transform>{FLOAT.format("fov", 33.4)}{FLOAT.format("scale", 111000)}
{FLOAT.format("focus", 400)}<texture name="irradiance" type="bitmap"><string name="filename" value="grey.png"/>
<boolean name="raw" value="true"/><string name="filter_type" value="nearest"/><string name="wrap_mode" value="clamp"/>
</texture></emitter></shape>"""


def _shape(plugin: str) -> str:
    inside = {
        "cube": f'<transform name="to_world"><scale value="10"/><translate z="380"/></transform>{GREY}',
        "cylinder": '<point name="p0" x="-30" y="-10" z="370"/><point name="p1" x="-30" y="10" z="370"/>'
        f"{FLOAT.format('radius', 5)}{GREY}",
        "disk": '<transform name="to_world"><rotate y="1" angle="180"/><scale value="15"/><translate z="380"/>'
        f"</transform>{GREY}",
        "merge": PLATE.format(x=0, y=0, z=380, inside=GREY).replace("rectangle", "cube"),
        "obj": f'<string name="filename" value="mesh.obj"/>{_AT}{GREY}',
        "ply": f'<string name="filename" value="mesh.ply"/>{_AT}{GREY}',
        "rectangle": f'<transform name="to_world"><rotate y="1" angle="180"/><scale value="15"/><translate z="380"/>'
        f"</transform>{GREY}",
        "sphere": f'<point name="center" x="0" y="0" z="380"/>{FLOAT.format("radius", 10)}{GREY}',
    }
    if plugin in ("instance", "shapegroup"):
        group = f'<shape type="shapegroup" id="group"><shape type="sphere">{FLOAT.format("radius", 10)}{GREY}</shape>'
        return f'{group}</shape><shape type="instance"><ref id="group"/>{_AT}</shape>'
    return f'<shape type="{plugin}">{inside[plugin]}</shape>'


def _replaced(tag: str, plugin: str) -> Iterator[tuple[str, str]]:
    """What is put in the place of what stands in every scene."""
    if tag == "integrator":
        yield '<integrator type="path">', f'<integrator type="{plugin}">'
        if plugin == "direct":
            yield '<integer name="max_depth" value="2"/>', ""
    elif tag in ("medium", "volume", "phase") or plugin in STRAIGHT:
        yield '<integrator type="path">', '<integrator type="volpath">'
    elif tag == "sampler":
        yield '<sampler type="independent"/>', f'<sampler type="{plugin}"/>'
    elif tag == "rfilter":
        yield '<rfilter type="box"/>', f'<rfilter type="{plugin}"/>'
    elif tag == "film" and plugin == "specfilm":
        yield 'type="hdrfilm"', 'type="specfilm"'
        yield '<string name="pixel_format" value="luminance"/>', '<spectrum name="band" value="400:1, 700:1"/>'


def cases() -> list[tuple[str, str]]:
    """(tag, plugin) of all that the guard allows."""
    return [(tag, plugin) for tag, all in PLUGINS.items() for plugin in all]


def outcome(path: Path, variant: str) -> dict[str, str]:
    """For each verb that gave no finite frame: its refusal, or "uncaught" and what came."""
    from mitsim.api.bench import open_bench

    found: dict[str, str] = {}

    def tried(verb: str, work: object) -> object:
        try:
            return work()  # type: ignore[operator]
        except MitsimError as error:
            found[verb] = str(error).replace(f"{path.parent}/", "")
        except Exception as error:
            found[verb] = f"uncaught {type(error).__name__}: {' '.join(str(error).split())[-300:]}"
        return None

    def rendered(estimator: str) -> None:
        bench = open_bench(path, variant, for_render=True)
        frame = bench.render(estimator, 4, accuracy=0.1)
        assert np.isfinite(frame.mean).all(), "not finite"
        assert frame.mean.any(), f"dark {frame.warnings}"

    tried("reference", lambda: rendered("reference"))
    tried("factored", lambda: rendered("factored"))
    tried("capture", lambda: open_bench(path, variant).capture("dots:2", accuracy=0.1))
    return found


def main() -> None:
    from mitsim.core.environment import load_variant
    from mitsim.transport import plugins

    variant, folder, names = sys.argv[1], Path(sys.argv[2]), sys.argv[3:]
    mi = load_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)
    plugins.register()
    all_found = {}
    for tag, plugin in cases():
        if not names or f"{tag}_{plugin}" in names:
            found = outcome(scene(folder / f"{tag}_{plugin}", tag, plugin), variant)
            print(f"{tag} {plugin}: {found}", file=sys.stderr, flush=True)
            all_found[f"{tag} {plugin}"] = found
    print(json.dumps(all_found))


if __name__ == "__main__":
    main()

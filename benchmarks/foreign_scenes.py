"""Twelve scenes that no test knows, for `benchmarks/accuracy.py --scene`: a folder in, scene files out.

    python benchmarks/foreign_scenes.py FOLDER

Each is the photograph's bench with something put between sheet and camera: half-transparent and cut-out cards, a tilted
window, a card at half the distance, balls, plates of sharp gloss, a glossy cylinder, a lamp behind glass, a strip of
mirror, instances, bumps under a blend. FOLDER/NAME/NAME.xml stands beside the files that it refers to.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
from harness import ROOT
from skimage import io

BENCH = ROOT / "scenes" / "photograph"


def twosided(bsdf: str) -> str:
    """The same ``bsdf`` on both sides."""
    return f'<bsdf type="twosided">{bsdf}</bsdf>'


def matt(reflectance: float) -> str:
    """A diffuse surface."""
    return twosided(f'<bsdf type="diffuse"><spectrum name="reflectance" value="{reflectance}"/></bsdf>')


def metal(alpha: float) -> str:
    """A rough conductor that reflects everything."""
    rough = f'<string name="material" value="none"/><float name="alpha" value="{alpha}"/>'
    return twosided(f'<bsdf type="roughconductor">{rough}</bsdf>')


MIRROR = twosided('<bsdf type="conductor"><string name="material" value="none"/></bsdf>')


def plate(z: float, bsdf: str, half: float = 25, x: float = 0, y: float = 0, turn: float = 0) -> str:
    """A square that faces the camera, turned about the vertical by so many degrees."""
    return (
        f'<shape type="rectangle"><transform name="to_world"><scale x="{half}" y="{half}"/>'
        f'<rotate y="1" angle="{180 + turn}"/><translate x="{x}" y="{y}" z="{z}"/></transform>{bsdf}</shape>'
    )


def slab(z: float, thickness: float, turn: float) -> str:
    """A pane of glass that is larger than the view."""
    return (
        f'<shape type="cube"><transform name="to_world"><scale x="100" y="100" z="{thickness / 2}"/>'
        f'<rotate y="1" angle="{turn}"/><translate z="{z}"/></transform><bsdf type="dielectric"/></shape>'
    )


def card(opacity: float) -> str:
    """A dark card that lets part of the light through."""
    return f'<bsdf type="mask"><float name="opacity" value="{opacity}"/>{matt(0.05)}</bsdf>'


def leaf(bsdf: str) -> str:
    """A surface with holes."""
    return f'<bsdf type="mask">{texture("opacity")}{bsdf}</bsdf>'


def texture(name: str) -> str:
    """The leaf's squares as a texture called ``name``."""
    return (
        f'<texture name="{name}" type="bitmap"><string name="filename" value="leaf.png"/>'
        '<boolean name="raw" value="true"/><string name="filter_type" value="nearest"/></texture>'
    )


def ball(x: float, y: float, z: float, radius: float) -> str:
    """A matt ball."""
    return (
        f'<shape type="sphere"><point name="center" x="{x}" y="{y}" z="{z}"/><float name="radius" value="{radius}"/>'
        f"{matt(0.6)}</shape>"
    )


def scenes() -> dict[str, str]:
    """What each scene adds to the bench, by name."""
    lamp = (
        '<shape type="rectangle"><transform name="to_world"><scale x="15" y="15"/><translate z="120" x="-90"/>'
        '</transform><emitter type="area"><spectrum name="radiance" value="20"/></emitter></shape>'
    )
    cylinder = (
        '<shape type="cylinder"><point name="p0" x="-40" y="-30" z="380"/><point name="p1" x="40" y="30" z="380"/>'
        f'<float name="radius" value="8"/>{metal(0.05)}</shape>'
    )
    leaves = f'<shape type="shapegroup" id="leaves">{plate(0, leaf(matt(0.6)), 20)}</shape>' + "".join(
        f'<shape type="instance"><ref id="leaves"/><transform name="to_world"><rotate z="1" angle="{angle}"/>'
        f'<translate x="{x}" z="{z}"/></transform></shape>'
        for angle, x, z in ((20, -25, 350), (50, 25, 320))
    )
    blend = (
        '<bsdf type="blendbsdf"><float name="weight" value="0.4"/><bsdf type="roughconductor"><string name="material" '
        'value="none"/><float name="alpha" value="0.15"/></bsdf><bsdf type="diffuse"/></bsdf>'
    )
    bumps = twosided(f'<bsdf type="bumpmap">{texture("arbitrary")}<float name="scale" value="2"/>{blend}</bsdf>')
    return {
        "half_card": plate(330, card(0.5), 40, 10),
        "leaf": plate(350, leaf(matt(0.6)), 35, -5, 8) + plate(300, leaf(metal(0.3)), 15, 25, -10),
        "window": slab(250, 5, 12),
        "near_card": plate(200, matt(0.6), 18, -38),
        "two_balls": ball(-20, 10, 350, 22) + ball(25, -15, 365, 18),
        "plate_0.01": plate(380, metal(0.01), 30, 10, turn=6),
        "plate_0.001": plate(380, metal(0.001), 30, 10, turn=6),
        "cylinder": cylinder,
        "lamp_behind_pane": slab(220, 4, 15) + lamp,
        "mirror_strip": plate(360, MIRROR, 10, -45, turn=40) + ball(20, 0, 360, 15),
        "instances": leaves,
        "bumps": plate(370, bumps, 35, turn=10),
    }


def write(folder: Path) -> dict[str, Path]:
    """The scene files, by name, made in ``folder``."""
    found = {}
    squares = np.random.default_rng(2).random((16, 16)) > 0.5
    for name, extra in scenes().items():
        here = folder / name
        here.mkdir(parents=True, exist_ok=True)
        for beside in BENCH.glob("*.png"):
            shutil.copy(beside, here / beside.name)
        io.imsave(here / "leaf.png", np.kron(squares, np.full((4, 4), 255)).astype(np.uint8), check_contrast=False)
        text = (BENCH / "scene.xml").read_text(encoding="utf-8")
        found[name] = here / f"{name}.xml"
        found[name].write_text(text.replace("</scene>", f"{extra}</scene>"), encoding="utf-8")
    return found


if __name__ == "__main__":
    write(Path(sys.argv[1]))

"""Wrapped mirrors and glass in double precision: a judge of the light that they send on to matt surfaces.

A panel of a nested material turns the whole beam of a projector to a wall behind it and to a card beside it, which the
camera sees; the panel itself it does not see. The judge follows rays in NumPy. It knows each wrapper by the definition
in Mitsuba's manual, shares no code with the package, and leaves nothing to chance but the place of a ray in its cell.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from skimage.io import imsave

from mitsim.api.bench import Bench
from mitsim.transport.direct import DirectTracer
from mitsim.transport.integrator import IndirectTracer, Paths

Material = tuple[Any, ...]
"""``("mirror",)``, ``("glass",)``, ``("black",)`` or a wrapper, its number or ``"textured"``, and its materials."""
WRAPPERS = ("blendbsdf", "mask", "twosided", "bumpmap", "normalmap")
SENSOR, FOV, INDEX, ALBEDO = 0.37504, 38.0, 1.3, 0.7
PROJECTOR, PANEL, BEAM, POWER = np.array([260.0, 0, 60]), np.array([150.0, 0, 250]), 5.0, 111000.0
TO_CARD = np.array([0.0, 70, 300])
HALF = 60.0
"""Half the side of the panel [mm]."""
CARDS = ((np.array([70.0, -10, 430]), 65.0, 45.0), (np.array([0.0, 85, 300]), 110.0, 60.0))
"""Centre of the wall and of the card [mm], both facing the camera, and their half sides."""
_WEIGHTS = np.array([51, 204, 102, 230])
"""Codes of a textured weight or opacity, along u."""
_HEIGHTS = np.array([0, 40, 110, 140, 200, 190, 220, 255])
"""Codes of a bump map along u, whose slopes differ from texel to texel."""
_NORMALS = np.array([[136, 128, 250], [122, 134, 250]])
"""Codes of a normal map along u."""
_BUMP = 5.0
"""Height of the bump map's white [mm]."""


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _frame(direction: np.ndarray) -> np.ndarray:
    """(3, 3) axes (rows) of Mitsuba's ``lookat`` toward a ``direction``, with y up."""
    ahead = _unit(direction)
    left = _unit(np.cross([0, 1.0, 0], ahead))
    return np.stack([left, np.cross(ahead, left), ahead])


_IN = _unit(PANEL - PROJECTOR)
AXES = _frame(_unit(TO_CARD - PANEL) - _IN)
"""Axes of the panel, the normal last: a mirror turns the middle of the beam to the card."""


# -------- The scene file


def xml(material: Material) -> str:
    """The element of a ``material``."""
    kind, *rest = material
    if kind == "mirror":
        return '<bsdf type="conductor"><string name="material" value="none"/></bsdf>'
    if kind == "glass":
        return (
            f'<bsdf type="dielectric"><float name="int_ior" value="{INDEX}"/><float name="ext_ior" value="1"/></bsdf>'
        )
    if kind == "black":
        return '<bsdf type="diffuse"><spectrum name="reflectance" value="0"/></bsdf>'
    number, inner = rest[0], "".join(map(xml, rest[1:]))
    picture = '<string name="filename" value="{}.png"/><boolean name="raw" value="true"/>'
    picture += '<string name="wrap_mode" value="clamp"/><string name="filter_type" value="{}"/>'
    name = {"blendbsdf": "weight", "mask": "opacity", "normalmap": "normalmap", "bumpmap": "bump"}.get(kind, "")
    own = ""
    if kind == "twosided":
        own = '<boolean name="allow_transmission" value="true"/>' if "glass" in str(rest) or "mask" in str(rest) else ""
    elif kind in ("blendbsdf", "mask") and number != "textured":
        own = f'<float name="{name}" value="{number}"/>'
    else:
        file = {"bumpmap": "heights", "normalmap": "normals"}.get(kind, "weights")
        if kind in ("bumpmap", "normalmap") and number != "textured":
            file += "_even"
        own = f'<texture name="{name}" type="bitmap">'
        own += picture.format(file, "bilinear" if kind == "bumpmap" else "nearest") + "</texture>"
        own += f'<float name="scale" value="{_BUMP}"/>' if kind == "bumpmap" else ""
    return f'<bsdf type="{kind}">{own}{inner}</bsdf>'


def _lookat(origin: np.ndarray, direction: np.ndarray) -> str:
    places = (" ".join(f"{x:.9g}" for x in point).replace(" ", ", ") for point in (origin, origin + 100 * direction))
    return '<lookat origin="{}" target="{}" up="0, 1, 0"/>'.format(*places)


def write_scene(folder: Path, material: Material, lens: float = 0.0) -> Path:
    """Write the scene of a panel of a ``material`` into a ``folder``; return its path.

    ``lens`` is the radius [mm] of a ``mitsim_projector`` in place of the pinhole, for the reference.
    """
    pictures = {
        "weights": _WEIGHTS[None], "heights": _HEIGHTS[None], "heights_even": np.arange(0, 256, 17)[None],
        "normals": _NORMALS[None], "normals_even": _NORMALS[None, :1], "white": np.full((1, 4), 255),
    }  # fmt: skip
    for name, codes in pictures.items():
        imsave(folder / f"{name}.png", np.repeat(codes, 4, axis=0).astype(np.uint8), check_contrast=False)
    light = f"""<float name="fov" value="{BEAM}"/><float name="scale" value="{POWER}"/>
        <texture name="irradiance" type="bitmap"><string name="filename" value="white.png"/>
        <boolean name="raw" value="true"/><string name="filter_type" value="nearest"/>
        <string name="wrap_mode" value="clamp"/></texture>"""
    turn = _lookat(PROJECTOR, _IN)
    if lens:
        focus = np.linalg.norm(PANEL - PROJECTOR)
        emitter = f"""<shape type="disk"><transform name="to_world"><scale x="{lens}" y="{lens}"/>{turn}</transform>
            {xml(("black",))}<emitter type="mitsim_projector"><transform name="to_world">{turn}</transform>
            <float name="focus" value="{focus}"/>{light}</emitter></shape>"""
    else:
        emitter = f"""<emitter type="projector"><transform name="to_world">{turn}</transform>
            <string name="fov_axis" value="x"/>{light}</emitter>"""
    cards = "".join(
        f"""<shape type="rectangle"><transform name="to_world"><scale x="{x}" y="{y}"/><rotate y="1" angle="180"/>
            <translate x="{c[0]}" y="{c[1]}" z="{c[2]}"/></transform><bsdf type="diffuse">
            <spectrum name="reflectance" value="{ALBEDO}"/></bsdf></shape>"""
        for c, x, y in CARDS
    )
    text = f"""<scene version="3.0.0"><integrator type="volpath"><integer name="max_depth" value="3"/>
        <integer name="rr_depth" value="12"/></integrator>
        <sensor type="mitsim_lensless"><float name="pixel_pitch" value="{SENSOR / 32}"/>
        <string name="mask" value="open"/><integer name="mask_order" value="8"/>
        <float name="mask_feature" value="0.12"/><float name="mask_distance" value="2"/>
        <float name="scene_distance" value="400"/><float name="fov" value="{FOV}"/><film type="hdrfilm">
        <integer name="width" value="32"/><integer name="height" value="32"/><rfilter type="box"/>
        <string name="pixel_format" value="luminance"/><string name="component_format" value="float32"/></film>
        <sampler type="independent"><integer name="sample_count" value="64"/></sampler></sensor>{emitter}{cards}
        <shape type="rectangle"><transform name="to_world"><scale x="{HALF}" y="{HALF}"/>{_lookat(PANEL, AXES[2])}
        </transform>{xml(material)}</shape></scene>"""
    path = folder / "scene.xml"
    path.write_text(text)
    return path


# -------- The judge


@dataclass
class Lobe:
    """One direction that light goes on in: ``out`` (k, 3) in the local frame, and (k,) the part of the light.

    ``cosines`` (k,) is the ratio of the cosines of both directions to the normal of the lobe's own frame.
    """

    part: np.ndarray
    out: np.ndarray
    cosines: np.ndarray


def _fresnel(cosine: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reflected part, and the cosine of the refracted ray; total reflection gives 1 and 0."""
    inside = 1 - (1 - cosine**2) / index**2
    beyond = np.sqrt(np.maximum(inside, 0))
    s, p = (cosine - index * beyond) / (cosine + index * beyond), (index * cosine - beyond) / (index * cosine + beyond)
    return np.where(inside > 0, (s**2 + p**2) / 2, 1.0), beyond


def _of_texels(codes: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.asarray(codes[np.clip((u * len(codes)).astype(int), 0, len(codes) - 1)] / 255)


def _slope(codes: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Slope along u of a texture with bilinear interpolation."""
    place = np.floor(u * len(codes) - 0.5).astype(int)
    left, right = (np.clip(each, 0, len(codes) - 1) for each in (place, place + 1))
    return np.asarray((codes[right] - codes[left]) / 255 * len(codes))


def _shadowed(normal: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Shadowing of bumps (Estevez et al., Ray Tracing Gems 2019, 12), as Mitsuba has it."""
    tan2 = [np.square(v[:, :2]).sum(axis=1) / np.square(v[:, 2]) for v in (normal, direction)]
    return np.asarray(2 / (1 + np.sqrt(1 + np.minimum(tan2[0] / 8, 1) * tan2[1])))


def _bumps(kind: str, number: object, at: np.ndarray, u: np.ndarray) -> np.ndarray:
    """(k, 3) normals of a map in the local frame, which face the directions ``at``."""
    if kind == "normalmap":
        codes = _NORMALS if number == "textured" else _NORMALS[:1]
        normal = _unit(2 * _of_texels(codes, u) - 1)
    else:
        codes = _HEIGHTS if number == "textured" else np.arange(0, 256, 17)
        slope = _BUMP * _slope(codes, u) / (2 * HALF)
        normal = _unit(np.stack([-slope, 0 * slope, 1 + 0 * slope], axis=1))
    turned = at[:, 2] * (at * normal).sum(axis=1) <= 0
    return np.where(turned[:, None], normal * [-1, -1, 1], normal)


def lobes(material: Material, to: np.ndarray, u: np.ndarray) -> Iterator[Lobe]:
    """Single directions of a ``material`` for light that comes from the directions ``to`` (k, 3)."""
    kind, *rest = material
    straight = np.ones(len(to))
    if kind == "mirror":
        yield Lobe((to[:, 2] > 0) * 1.0, to * [-1, -1, 1], straight)
    elif kind == "glass":
        index = np.where(to[:, 2] > 0, INDEX, 1 / INDEX)
        reflected, beyond = _fresnel(np.abs(to[:, 2]), index)
        yield Lobe(reflected, to * [-1, -1, 1], straight)
        out = np.column_stack([-to[:, :2] / index[:, None], -np.sign(to[:, 2]) * beyond])
        with np.errstate(divide="ignore"):
            yield Lobe(1 - reflected, out, np.where(beyond > 0, np.abs(to[:, 2]) / beyond, 0))
    elif kind in ("blendbsdf", "mask"):
        weight = _of_texels(_WEIGHTS, u) if rest[0] == "textured" else float(rest[0]) * straight
        if kind == "mask":
            yield Lobe(1 - weight, -to, straight)
        for own, part in zip((weight,) if kind == "mask" else (1 - weight, weight), rest[1:], strict=True):
            for lobe in lobes(part, to, u):
                yield Lobe(own * lobe.part, lobe.out, lobe.cosines)
    elif kind == "twosided":
        # Each side is met from its front.
        for material_of, mine in zip((rest[1], rest[-1]), (to[:, 2] > 0, to[:, 2] < 0), strict=True):
            sign = np.where(mine & (to[:, 2] < 0), -1.0, 1.0)[:, None] * [0, 0, 1] + [1, 1, 0]
            for lobe in lobes(material_of, to * sign, u):
                yield Lobe(mine * lobe.part, lobe.out * sign, lobe.cosines)
    elif kind in ("bumpmap", "normalmap"):
        normal = _bumps(kind, rest[0], to, u)
        s = _unit(np.array([1.0, 0, 0]) - normal * normal[:, :1])
        frame = np.stack([s, np.cross(normal, s), normal], axis=1)
        for lobe in lobes(rest[1], np.einsum("kij,kj->ki", frame, to), u):
            out = np.einsum("kij,ki->kj", frame, lobe.out)
            # Seen from there, the bumps must be the same ones, and both sides agree.
            same = (_bumps(kind, rest[0], out, u) == normal).all(axis=1) & (out[:, 2] * lobe.out[:, 2] > 0)
            yield Lobe(same * lobe.part * _shadowed(normal, to), out, lobe.cosines)


def irradiance(material: Material, sensor: Sequence[float] = (0.0, 0.0), lens: float = 0.0, side: int = 500) -> float:
    """Irradiance [W m^-2] at a point of the ``sensor`` [mm] by light that the panel of a ``material`` sends on."""
    rng = np.random.default_rng(3)
    reach, axes = np.tan(np.radians(BEAM / 2)), _frame(_IN)
    cells = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), axis=-1).reshape(-1, 2)
    window = ((cells + rng.random(cells.shape)) / side * 2 - 1) * reach
    angle, radius = 2 * np.pi * rng.random(len(cells)), lens * np.sqrt(rng.random(len(cells)))
    shift = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    focus = np.linalg.norm(PANEL - PROJECTOR)
    origin = PROJECTOR + shift @ axes[:2]
    direction = _unit((window * focus - shift) @ axes[:2] + focus * axes[2])
    flux = np.pi * POWER * (2 * reach / side) ** 2
    # To the panel, which all light meets.
    along = ((PANEL - origin) @ AXES[2]) / (direction @ AXES[2])
    place = origin + along[:, None] * direction
    local = (place - PANEL) @ AXES.T
    assert (np.abs(local[:, :2]) < HALF).all() and (direction @ AXES[2] < 0).all()
    to, u = -direction @ AXES.T, (local[:, 0] / HALF + 1) / 2
    total, point = 0.0, np.array([*sensor, 0.0])
    for lobe in lobes(material, to, u):
        out = lobe.out @ AXES
        # Factor of shading normals: cosines to the bumps over those to the surface (Veach 1997, 5.3).
        part = lobe.part * lobe.cosines * np.abs(lobe.out[:, 2] / to[:, 2])
        reached = np.full(len(out), np.inf)
        for middle, x, y in CARDS:
            reached = np.minimum(reached, _met(place, out, middle, x, y))
        lit = np.flatnonzero(np.isfinite(reached) & (out[:, 2] > 0) & (part > 0))
        at = place[lit] + reached[lit, None] * out[lit]
        back = point - at
        distance = np.linalg.norm(back, axis=1)
        cosine = -back[:, 2] / distance
        seen = (np.abs(at[:, :2] - point[:2]) < np.tan(np.radians(FOV / 2)) * at[:, 2:]).all(axis=1)
        for middle, x, y in CARDS:
            seen &= ~(_met(at, back, middle, x, y) < 1)
        crossing = ((PANEL - at) @ AXES[2]) / (back @ AXES[2])
        beside = np.abs((at + crossing[:, None] * back - PANEL) @ AXES[:2].T).max(axis=1)
        assert not (seen & (crossing > 0) & (crossing < 1) & (beside < HALF)).any(), "seen through the panel"
        total += (part[lit] * flux * ALBEDO / np.pi * cosine**2 / distance**2)[seen].sum()
    return float(total)


def _met(origin: np.ndarray, direction: np.ndarray, middle: np.ndarray, x: float, y: float) -> np.ndarray:
    """(k,) lengths of ``direction`` at which rays meet a card, inf where they do not."""
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (middle[2] - origin[:, 2]) / direction[:, 2]
        at = origin + along[:, None] * direction - middle
        hit = (along > 1e-9) & (np.abs(at[:, 0]) < x) & (np.abs(at[:, 1]) < y)
    return np.where(hit, along, np.inf)


# -------- Light that the factored estimator finds


def traced(bench: Bench, seeds: int = 8, samples: int = 2048) -> tuple[float, float]:
    """Irradiance [W m^-2] at the sensor's centre by all light that mirrors send on once, and its standard error."""
    tracers = DirectTracer(bench.setup, 1), IndirectTracer(bench.setup, Paths(mirrors=True))
    found = [sum(each.trace(seed, 0, samples).value.sum() for each in tracers) / samples for seed in range(seeds)]
    return float(np.mean(found)), float(np.std(found, ddof=1) / np.sqrt(seeds))


# -------- All nestings of depth two


def nested(outer: str, inner: str, leaf: str, textured: bool) -> Material:
    """The material of two wrappers around a ``leaf``; weights are constant or ``textured``."""

    def wrap(kind: str, within: Material, number: float) -> Material:
        own: object = "textured" if textured else number
        return (kind, own, within, ("black",)) if kind == "blendbsdf" else (kind, own, within)

    return wrap(outer, wrap(inner, (leaf,), 0.6), 0.3)


def all_nestings() -> Iterator[tuple[str, str, str, bool]]:
    """Outer and inner wrapper, leaf, and whether weights are textured, of all nestings of depth two."""
    for leaf in ("mirror", "glass"):
        for outer in WRAPPERS:
            for inner in WRAPPERS:
                for textured in (False, True):
                    yield outer, inner, leaf, textured


def refused(outer: str, inner: str) -> bool:
    """Return True if mitsim refuses these wrappers: a hole under bumps, or bumps in a bump map."""
    return (outer, inner) in (
        ("bumpmap", "mask"),
        ("normalmap", "mask"),
        ("bumpmap", "bumpmap"),
        ("bumpmap", "normalmap"),
    )

"""Wrapped and directed materials: light followed forward is light seen backward, and no choice loses any."""

from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsim.api.bench import open_bench
from mitsim.scene.check import DIRECTED, PLUGINS
from mitsim.transport import integrator
from mitsim.transport.connect import SensorPoints
from mitsim.transport.from_camera import FromCameraTracer
from mitsim.transport.integrator import IndirectTracer, Paths
from mitsim.transport.path_reuse import PathReuseTracer
from mitsim.transport.records import aligned_grid
from tests import measured_tables as tables
from tests.conftest import write_png
from tests.physics import nestings

pytestmark = pytest.mark.usefixtures("variant")
MATT = '<bsdf type="diffuse"/>'
ROUGH = '<bsdf type="roughplastic"><float name="alpha" value="0.3"/></bsdf>'
BENT = '<bsdf type="roughdielectric"><float name="alpha" value="0.3"/></bsdf>'
LOBE = '<bsdf type="roughconductor"><string name="material" value="none"/>{}</bsdf>'
ALONG = '<float name="alpha_u" value="0.3"/><float name="alpha_v" value="0.15"/>'
THIN = """<bsdf type="principledthin"><spectrum name="base_color" value="0.8"/><float name="roughness" value="0.4"/>
    <float name="spec_trans" value="0.5"/><float name="diff_trans" value="0.8"/><float name="eta" value="1.4"/>
    </bsdf>"""
PAINT = """<bsdf type="principled"><float name="roughness" value="0.4"/><float name="spec_trans" value="0.7"/>
    <float name="eta" value="1.5"/><float name="sheen" value="1"/><float name="anisotropic" value="0.7"/></bsdf>"""
HAIR = """<bsdf type="hair"><spectrum name="sigma_a" value="0.4"/><float name="longitudinal_roughness" value="0.4"/>
    <float name="azimuthal_roughness" value="0.4"/></bsdf>"""
MAP = """<bsdf type="{}"><texture name="map" type="bitmap"><string name="filename" value="{}.png"/>
    <boolean name="raw" value="true"/></texture>{}</bsdf>"""
NORMALS = MAP.replace('name="map"', 'name="normalmap"')
HALF = '<bsdf type="blendbsdf"><float name="weight" value="0.4"/>{}{}</bsdf>'
EXAMPLES = {
    "blendbsdf": (HALF.format(MATT, LOBE.format("")), HALF.format(HAIR, '<bsdf type="conductor"/>')),
    "bumpmap": (MAP.format("bumpmap", "heights", ROUGH), MAP.format("bumpmap", "heights", BENT)),
    "hair": (HAIR,),
    "mask": (f'<bsdf type="mask">{BENT}</bsdf>', f'<bsdf type="mask">{HALF.format(THIN, BENT)}</bsdf>'),
    "measured": ('<bsdf type="measured"><string name="filename" value="table.bsdf"/></bsdf>',),
    "mitsim_grating": ('<bsdf type="mitsim_grating"><float name="sigma" value="0.3"/></bsdf>',),
    "normalmap": (NORMALS.format("normalmap", "normals", MATT), NORMALS.format("normalmap", "normals", HAIR)),
    "pplastic": ('<bsdf type="pplastic"><float name="alpha" value="0.2"/></bsdf>',),
    "principled": (PAINT,),
    "principledthin": (THIN,),
    "roughconductor": (LOBE.format(ALONG),),
    "roughdielectric": (BENT,),
    "roughplastic": (ROUGH,),
    "twosided": (f'<bsdf type="twosided">{ROUGH}{MAP.format("bumpmap", "heights", MATT)}</bsdf>',),
}
"""Each allowed BSDF, some nested, but for those in :data:`PLAIN`."""
PLAIN = (
    *("circular", "conductor", "dielectric", "diffuse", "mitsim_glass", "null", "plastic", "polarizer", "retarder"),
    "thindielectric",
)
"""Those that need no parameters, most of single directions."""


PLATE = '<shape type="rectangle"><transform name="to_world"><translate z="{}"/></transform>{}</shape>'


def write_maps(folder: Path) -> None:
    write_png(folder / "heights.png", np.arange(64).reshape(8, 8) * 3)
    tables.save(folder / "table.bsdf", tables.known(0.3))
    write_png(folder / "normals.png", np.tile(np.array([[160, 110, 240], [100, 140, 240]]), (2, 1, 1)))


def test_every_material_gives_forward_what_it_gives_backward(small_scene: Callable[..., Path]) -> None:
    """f*(a, b) = f(b, a) at random directions, refraction with its squares of indices: Veach 1997, 5.3.

    A material that is not reciprocal and not in DIRECTED shows. (Planted: hair left out of DIRECTED, 1.0 off.)
    """
    assert {*EXAMPLES, *PLAIN} == set(PLUGINS["bsdf"]), "a BSDF without an example"
    given = [(name, text) for name, texts in EXAMPLES.items() for text in texts]
    given += [(name, f'<bsdf type="{name}"/>') for name in PLAIN]
    path = small_scene(extra="".join(PLATE.format(500 + 9 * i, text) for i, (_, text) in enumerate(given)))
    write_maps(path.parent)
    count, random = 2000, np.random.default_rng(1)
    z, phi = random.uniform(0.15, 1, (2, count)) * random.choice([-1, 1], (2, count)), random.uniform(0, 7, (2, count))
    a, b = (mi.Vector3f(*np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], 1)[i])
            for i in range(2))  # fmt: skip
    uv, shapes = (
        mi.Point2f(*random.random((2, count))),
        open_bench(path, for_render=True).loaded.scene.shapes()[-len(given) :],
    )
    lit = 0
    for (name, text), shape in zip(given, shapes, strict=True):

        def value(mode: mi.TransportMode, wi: mi.Vector3f, wo: mi.Vector3f) -> np.ndarray:
            si = dr.zeros(mi.SurfaceInteraction3f, count)
            si.sh_frame = mi.Frame3f(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
            si.n, si.dp_du, si.dp_dv = mi.Normal3f(0, 0, 1), mi.Vector3f(60, 0, 0), mi.Vector3f(0, 60, 0)
            si.wi, si.uv = wi, uv
            shone = shape.bsdf().eval(mi.BSDFContext(mode), si, wo)  # noqa: B023
            return np.array(mi.unpolarized_spectrum(shone)[0], np.float64) / np.abs(np.array(wo.z, np.float64))

        forward, backward = value(mi.TransportMode.Importance, a, b), value(mi.TransportMode.Radiance, b, a)
        scale = np.maximum(np.maximum(forward, backward), 1e-3)
        assert np.abs((forward - backward) / scale).max() < 2e-3, (name, text)
        lit += bool(backward.any())
    assert lit == sum(map(len, EXAMPLES.values())) + 2 and set(DIRECTED) < set(
        EXAMPLES
    )  # diffuse and plastic shine, too


CHOICES = (
    ({"type": "mitsim_blendbsdf", "weight": 0.4, "a": {"type": "dielectric"}, "b": {"type": "plastic"}}, 0.6, 0.4),
    ({"type": "mitsim_mask", "opacity": 0.4, "in": {"type": "dielectric"}}, 0.4, 0.0),
    ({"type": "mitsim_twosided", "a": {"type": "plastic"}, "b": {"type": "conductor", "material": "none"}}, 0.0, 1.0),
)


@pytest.mark.parametrize(("bsdf", "glass", "paint"), CHOICES, ids=["blend", "mask", "sides"])
def test_a_choice_samples_each_part_by_its_share(variant: str, bsdf: dict, glass: float, paint: float) -> None:
    """What Mitsuba's own integrators sample, the reference's: light of each kind, 5 sigma of 2^18 draws.

    (Mitsuba's blend of half a mirror: 0.8 of it.)
    """
    count, cosine = 2**18, 0.8
    material, rng = mi.load_dict(bsdf), mi.PCG32(count)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi, si.t = mi.Vector3f(0.6, 0, cosine), 1
    drawn = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
    bs, value = material.sample(mi.BSDFContext(), si, *drawn, True)
    kind, value = np.array(bs.sampled_type), np.array(value[0], np.float64)
    reflected = float(mi.fresnel(mi.Float(cosine), mi.Float(1.5046))[0][0])
    coat = float(mi.fresnel(mi.Float(cosine), mi.Float(1.49 / 1.000277))[0][0])
    right = {32: glass * reflected + paint * coat, 64: glass * (1 - reflected) / 1.5046**2, 1: 1 - glass - paint}
    for which, expected in right.items():
        each = np.where(kind == which, value, 0)
        assert abs(each.mean() - expected) < 5 * each.std() / np.sqrt(count) + 1e-5, which


def test_a_blend_of_matt_parts_is_their_weighted_mean() -> None:
    """Values and densities as formulas, each component as its part; glass has no value in any direction.
    (Planted: the share of the other part; components swapped; a weight that no program can change.)"""
    matt = [{"type": "diffuse", "reflectance": albedo} for albedo in (0.2, 0.9)]
    blend = mi.load_dict({"type": "mitsim_blendbsdf", "weight": 0.3, "a": matt[0], "b": matt[1]})
    si, out, single = dr.zeros(mi.SurfaceInteraction3f), mi.Vector3f(0.0, 0.6, 0.8), mi.BSDFContext()
    si.wi = mi.Vector3f(0.6, 0.0, 0.8)
    weights, parts = mi.traverse(blend), (0.4 * 0.2, 0.6 * 0.9)
    weights["weight.value"] = 0.6
    weights.update()
    value, pdf = blend.eval_pdf(mi.BSDFContext(), si, out)
    assert [value[0][0], pdf[0]] == pytest.approx([sum(parts) * 0.8 / np.pi, 0.8 / np.pi], rel=1e-5)
    for single.component, part in enumerate(parts):
        assert blend.sample(single, si, 0.5, mi.Point2f(0.3, 0.4))[1][0][0] == pytest.approx(part, rel=1e-5)
    value, pdf = mi.load_dict({"type": "mitsim_glass"}).eval_pdf(mi.BSDFContext(), si, out)
    assert value[0][0] == pdf[0] == 0


NESTED = (("blendbsdf", "normalmap", "mirror", True), ("mask", "bumpmap", "glass", False))


@pytest.mark.parametrize("case", NESTED, ids=map(str, NESTED))
def test_nested_mirrors_and_glass_send_on_all_their_light(tmp_path: Path, case: tuple[str, str, str, bool]) -> None:
    """Against float64 rays, seven standard errors of 0.1 to 0.4 %; `benchmarks/nestings.py` has all 92 nestings.

    (Planted: the factor of bumps left out, 48 % too much under an even normal map.)
    """
    material = nestings.nested(*case)
    light, error = nestings.traced(open_bench(nestings.write_scene(tmp_path, material)), samples=1024)
    right = nestings.irradiance(material, side=300)
    assert error < 6e-3 * right
    assert abs(light - right) < 7 * error + 1e-3 * right


WALL = """<shape type="rectangle"><transform name="to_world"><scale x="60" y="60"/><rotate y="1" angle="75"/>
    <translate x="-30" z="360"/></transform>{}</shape>"""


STRANDS = "".join(
    f'<shape type="cylinder"><point name="p0" x="{x}" y="-60" z="370"/><point name="p1" x="{x + 3}" y="60" z="380"/>'
    f'<float name="radius" value="2"/>{HAIR}</shape>'
    for x in range(-42, 43, 7)
)


@pytest.mark.slow
@pytest.mark.parametrize("own", [IndirectTracer, PathReuseTracer])
def test_light_over_hair_is_followed_from_the_camera(
    shared_scene: Callable[..., Path], own: type[IndirectTracer]
) -> None:
    """Both sides give together what the camera's alone gives, and paths over hair bring little noise.

    8 seeds of 512 samples. (Planted: hair followed from the projector as matt surfaces are; 5 % of error.)
    """
    bench = open_bench(shared_scene("strands", extra=WALL.format(MATT) + STRANDS))
    grid = aligned_grid(*bench.windows, 32, 1, bench.geometry.tan_half_fov)
    points = SensorPoints(bench.geometry.half_width)

    def light(tracer: IndirectTracer | FromCameraTracer) -> list[np.ndarray]:
        return [tracer.trace(seed, 0, 512).value / 512 for seed in range(8)]

    divided = Paths(interreflection=True, steep=bench.loaded.hairy)
    from_projector = light(own(bench.setup, divided, points))
    from_camera = light(FromCameraTracer(bench.setup, grid, divided, points))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(integrator, "_SHARP", 1e-6)
        alone = light(FromCameraTracer(bench.setup, grid, Paths(interreflection=True), points))
    both = [np.append(*pair) for pair in zip(from_projector, from_camera, strict=True)]
    sums = np.array([[each.sum() for each in values] for values in (both, alone)])
    (one, other), errors = sums.mean(axis=1), sums.std(axis=1, ddof=1) / np.sqrt(8)
    assert np.hypot(*errors) < 1.5e-2 * other
    assert abs(one - other) < 4 * np.hypot(*errors)

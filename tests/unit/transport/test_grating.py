"""The grating BSDF against the grating equation, its own formula written again in float64, and its integrals.

Directions are given by their cosines in the tangent plane. The grating vector is the local x axis unless
said otherwise.
"""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsim.core.environment import device_array
from mitsim.core.errors import MitsimError
from mitsim.transport.plugins.materials import GlassModel, is_glass, tune

pytestmark = pytest.mark.usefixtures("variant")
LINES, SHARES = (638.0, 520.0, 445.0), (0.4757, 0.3348, 0.1895)
SIGNIFICANCE = 1e-4
SETTINGS = [
    {},
    {"efficiencies": "0.2, 0.1", "negative_efficiencies": "0.5, 0.05, 0.02", "sigma": 0.03, "sigma_groove": 0.1},
    {"efficiencies": "0.1, 0.3", "pitch": 900.0, "diffuse": 0.2, "reflectance": 0.7, "sigma_groove": 0.05},
]


def grating(**parameters: Any) -> Any:
    return mi.load_dict({"type": "mitsim_grating", **parameters})


def cosines(theta_degrees: float, phi_degrees: float) -> tuple[float, float]:
    theta, phi = np.radians(theta_degrees), np.radians(phi_degrees)
    return float(np.sin(theta) * np.cos(phi)), float(np.sin(theta) * np.sin(phi))


def vector(flat: Any) -> Any:
    """Directions of the upper hemisphere from cosines (2,) or (2, k)."""
    x, y = np.atleast_1d(flat[0]), np.atleast_1d(flat[1])
    return mi.Vector3f(np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))]))


def interaction(wi: Any, count: int = 1) -> Any:
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.sh_frame = mi.Frame3f(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(7, 0, 0), mi.Vector3f(0, 3, 0)
    si.wi = vector(wi)
    return si


def evaluate(bsdf: Any, wi: Any, wo: Any) -> tuple[np.ndarray, np.ndarray]:
    """f cos(theta_o) and pdf at directions given by cosines wi (2,) and wo (2, k)."""
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), interaction(wi, np.shape(wo)[1]), vector(wo))
    return np.array(value, dtype=np.float64)[0], np.array(pdf, dtype=np.float64)


def draw(bsdf: Any, si: Any, count: int, seed: int) -> tuple[Any, np.ndarray]:
    random = np.random.default_rng(seed).random((3, count)).astype(np.float32)
    bs, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(random[0]), mi.Point2f(random[1], random[2]))
    return bs, np.array(weight, dtype=np.float64)[0]


def lobes(bsdf: Any) -> list[tuple[float, float]]:
    """(part, shift) of every line and order, from the plugin's parameters."""
    model = bsdf.model
    share = np.array(model.shares) / sum(model.shares)
    return [
        (part * s, m * line / model.pitch)
        for s, line in zip(share, model.wavelengths, strict=True)
        for m, part in model.orders.items()
    ]


def widths(bsdf: Any) -> tuple[float, float]:
    return bsdf.model.sigma, bsdf.model.sigma_groove or bsdf.model.sigma


def formula(bsdf: Any, wi: Any, wo: np.ndarray) -> np.ndarray:
    """f(wi, wo) without reflectance, in float64."""
    sigma, along = widths(bsdf)
    x, y = wi[0] + wo[0], wi[1] + wo[1]
    density = sum(p * stats.norm.pdf(x, shift, sigma) * stats.norm.pdf(y, 0, along) for p, shift in lobes(bsdf))
    return density + bsdf.model.diffuse / np.pi


def reflected_part(bsdf: Any, wi: Any) -> float:
    """Integral of f cos over the hemisphere: Gaussians over the unit disc, one axis in closed form, one by sums."""
    sigma, along = widths(bsdf)
    total = bsdf.model.diffuse
    for part, shift in lobes(bsdf):
        low, high = max(-1.0, shift - wi[0] - 9 * sigma), min(1.0, shift - wi[0] + 9 * sigma)
        if low < high:
            edges = np.linspace(low, high, 20_001)
            x = (edges[1:] + edges[:-1]) / 2
            half = np.sqrt(1 - x**2)
            inside = stats.norm.cdf((half + wi[1]) / along) - stats.norm.cdf((-half + wi[1]) / along)
            total += part * float((stats.norm.pdf(x, shift - wi[0], sigma) * inside).sum()) * (high - low) / len(x)
    return float(bsdf.model.reflectance * total)


# ---- directions of the orders


@pytest.mark.parametrize("grooves", ["circular", "linear"])
@pytest.mark.parametrize("azimuth", [0.0, 77.0, 200.0])
def test_grooves_lie_as_said_on_a_turned_disc(grooves: str, azimuth: float) -> None:
    """A tilted, flipped disc hit by a ray, all in world coordinates: order 1 leaves along the radius, or as said."""
    direction = np.array([0.2, 1.0, 0.3])
    bsdf = grating(
        grooves=grooves, direction=direction.tolist(), wavelengths=520.0, efficiencies="0, 0.5",
        negative_efficiencies="0", sigma=1e-3,
    )  # fmt: skip
    place = (
        mi.ScalarAffineTransform4f().translate([3, -2, 400]).rotate([0.6, 0, 0.8], 20).rotate([0, 1, 0], 15).scale(60)
    )
    scene = mi.load_dict(
        {"type": "scene", "disc": {"type": "disk", "to_world": place, "flip_normals": True, "b": bsdf}}
    )
    matrix = np.array(place.matrix)
    radius = matrix[:3, :3] @ [np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth)), 0]
    target = matrix[:3, 3] + 0.5 * radius
    sight = target - [5, 1, 0]
    ray = mi.Ray3f(mi.Point3f(5, 1, 0), mi.Vector3f((sight / np.linalg.norm(sight)).tolist()))
    si = scene.ray_intersect(ray)
    bs, _ = draw(bsdf, si, 5000, seed=2)
    out = np.array(si.to_world(bs.wo), dtype=np.float64).mean(axis=1)
    normal = -matrix[:3, 2] / 60
    across = radius if grooves == "circular" else direction
    across = across - normal * (across @ normal)
    expected = np.array(ray.d, dtype=np.float64).ravel() + 520 / 1600 * across / np.linalg.norm(across)
    tangential = np.eye(3) - np.outer(normal, normal)
    assert np.abs(tangential @ (out - expected)).max() < 1e-4  # 5e-3 / sqrt(5000), float32 geometry


# ---- values


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_values_are_those_of_the_formula(settings: dict[str, Any]) -> None:
    bsdf = grating(**settings)
    random = np.random.default_rng(3)
    for wi in (0.0, 0.0), cosines(50, 130), cosines(85, 10):
        shifts = random.choice([shift for _, shift in lobes(bsdf)], 5000)
        wo = np.stack([shifts - wi[0], 0 * shifts - wi[1]]) + random.normal(0, 0.05, (2, 5000))
        wo = wo[:, np.hypot(*wo) < 0.999]
        value, pdf = evaluate(bsdf, wi, wo)
        cosine = np.sqrt(1 - (wo**2).sum(axis=0))
        f = formula(bsdf, wi, wo)
        assert np.allclose(value, bsdf.model.reflectance * f * cosine, rtol=1e-4, atol=1e-4 * f.max())
        total = bsdf.model.diffuse + sum(bsdf.model.orders.values())
        assert np.allclose(pdf, f * cosine / total, rtol=1e-4, atol=1e-4 * f.max())


def test_grooves_that_lie_upright_are_those_along_the_first_axis() -> None:
    """A direction along the normal has no part in the plane. (Planted: the part that is none over its length.)"""
    out, settings = np.array([[0.1, 0.3], [0.0, 0.05]]), {"grooves": "linear", "sigma": 0.1}
    upright, first = (grating(direction=to, **settings) for to in ([0.0, 0.0, 2.0], [1.0, 0.0, 0.0]))
    found, known = (np.stack(evaluate(bsdf, (0.0, 0.0), out)) for bsdf in (upright, first))
    assert found == pytest.approx(known) and found.min() > 0.1


def test_nothing_from_behind_to_behind_or_for_another_kind_of_lobe() -> None:
    bsdf, context = grating(diffuse=0.3), mi.BSDFContext()
    si = interaction((0.0, 0.0))
    assert bsdf.eval(context, si, mi.Vector3f(0, 0, 1))[0][0] > 0
    assert bsdf.eval(context, si, mi.Vector3f(0, 0, -1))[0][0] == 0
    assert bsdf.sample(context, si, 0.5, mi.Point2f(0.5))[1][0][0] > 0
    context.type_mask = +mi.BSDFFlags.DeltaReflection
    assert bsdf.eval(context, si, mi.Vector3f(0, 0, 1))[0][0] == 0
    assert bsdf.sample(context, si, 0.5, mi.Point2f(0.5))[1][0][0] == 0
    si.wi = mi.Vector3f(0, 0, -1)
    assert bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, -1))[0][0] == 0
    assert bsdf.sample(mi.BSDFContext(), si, 0.5, mi.Point2f(0.5))[1][0][0] == 0


@pytest.mark.parametrize("other", ["llvm_ad_rgb", "llvm_ad_spectral"])
def test_colour_variants_diffract_each_channel_by_its_own_wavelength(other: str) -> None:
    """In a process of its own; the peak of each channel is where its line goes, and samples weigh what they should."""
    program = f"""
from mitsim.core.environment import load_variant
mi = load_variant({other!r})
mi.set_log_level(mi.LogLevel.Error)
import drjit as dr, numpy as np
from mitsim.transport import plugins
plugins.register()
bsdf = mi.load_dict({{"type": "mitsim_grating", "efficiencies": "0, 0.5", "negative_efficiencies": "0"}})
si = dr.zeros(mi.SurfaceInteraction3f, 1)
si.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
si.wi, si.dp_du = mi.Vector3f(0, 0, 1), mi.Vector3f(1, 0, 0)
lines = [638.0, 520.0, 445.0, 580.0][:len(mi.Spectrum())]
if mi.is_spectral:
    si.wavelengths = mi.UnpolarizedSpectrum(lines)
x = np.linspace(0.2, 0.5, 3001)
wo = mi.Vector3f(x, 0 * x, np.sqrt(1 - x**2))
peaks = x[(np.array(bsdf.eval(mi.BSDFContext(), si, wo)) / np.sqrt(1 - x**2)).argmax(axis=1)]
assert np.allclose(peaks, np.array(lines) / 1600, atol=1.1e-4), peaks
random = mi.Float(np.random.default_rng(7).random((3, 100000)).astype(np.float32).ravel())
u = dr.unravel(mi.Vector3f, random, order="F")
bs, weight = bsdf.sample(mi.BSDFContext(), si, u.x, mi.Point2f(u.y, u.z))
mean = np.array(weight).mean(axis=1)  # variance of weights is below (channels x 0.5)^2
assert np.allclose(mean, 0.5, atol=5 * 2 / 100000**0.5), mean
if mi.is_rgb:
    try:
        mi.load_dict({{"type": "mitsim_grating", "wavelengths": "500, 600"}})
    except RuntimeError as error:
        assert "wants three" in str(error)
    else:
        raise AssertionError("two lines for three channels")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


# ---- energy and sampling


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_drawn_directions_follow_the_density(settings: dict[str, Any]) -> None:
    """Chi-square over cells of direction cosines, expectations in closed form: a million samples, significance 1e-4.

    Cells on the rim and samples that left the hemisphere are one cell. A bug that moves 1 % of the light moves 10 000.
    """
    bsdf, count = grating(**settings), 1_000_000
    sigma, along = widths(bsdf)
    edges = np.linspace(-1, 1, 51)
    total = bsdf.model.diffuse + sum(bsdf.model.orders.values())
    far = np.maximum(np.abs(edges[1:]), np.abs(edges[:-1]))
    inside = np.hypot(far[:, None], far[None, :]) < 1
    for wi in (0.0, 0.0), cosines(35, 60):
        chance = np.full((50, 50), bsdf.model.diffuse / total * 0.04**2 / np.pi)
        for part, shift in lobes(bsdf):
            across = np.diff(stats.norm.cdf(edges, shift - wi[0], sigma))
            chance += part / total * np.outer(across, np.diff(stats.norm.cdf(edges, -wi[1], along)))
        bs, weight = draw(bsdf, interaction(wi, count), count, seed=8)
        valid = np.array(bs.pdf) > 0
        assert np.allclose(weight[valid], bsdf.model.reflectance * total, rtol=1e-4) and not weight[~valid].any()
        found = np.histogram2d(np.array(bs.wo.x)[valid], np.array(bs.wo.y)[valid], bins=(edges, edges))[0]
        often = inside & (chance * count > 10)
        observed = np.append(found[often], count - found[often].sum())
        expected = count * np.append(chance[often], 1 - chance[often].sum())
        statistic = (np.square(observed - expected) / expected).sum()
        assert stats.chi2.sf(statistic, len(expected) - 1) > SIGNIFICANCE
        # The rest of the lobes is lost beyond the rim.
        kept = reflected_part(bsdf, wi) / bsdf.model.reflectance / total
        assert abs(valid.mean() - kept) < 5 * np.sqrt(max(kept * (1 - kept), 0) / count) + 1e-5


# ---- parameters


HOSTILE = {
    "pitch below nothing": ({"pitch": -1600.0}, "pitch"),
    "too much light": ({"efficiencies": "0.4, 0.31"}, "sum of 1.02"),
    "too much with the diffuse part": ({"efficiencies": "0.4, 0.3", "diffuse": 0.1}, "sum of 1.1"),
    "negative light": ({"efficiencies": "0.4, -0.1"}, "efficiencies.1: got -0.1"),
    "no order": ({"efficiencies": " "}, "efficiencies"),
    "words": ({"efficiencies": "many"}, "numbers separated by commas"),
    "too many orders": ({"efficiencies": ", ".join(["0.01"] * 18)}, "efficiencies"),
    "no lobe": ({"sigma": 0.0}, "sigma"),
    "negative diffuse": ({"diffuse": -0.1}, "diffuse"),
    "darkness": ({"wavelengths": "0, 500"}, "wavelengths"),
    "too few shares": ({"wavelengths": "500, 600", "shares": "1"}, "one number for each line"),
    "shares of nothing": ({"shares": "0, 0, 0"}, "not all 0"),
    "no direction": ({"direction": [0.0, 0.0, 0.0]}, "direction"),
    "a direction out of bounds": ({"direction": [float("inf"), 0.0, 0.0]}, "direction"),
    "other grooves": ({"grooves": "spiral"}, "'circular' or 'linear'"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_no_grating_can_have_is_refused_in_one_line(name: str) -> None:
    settings, words = HOSTILE[name]
    with pytest.raises(RuntimeError) as caught:
        grating(**settings)
    last = str(caught.value).strip().splitlines()[-1]
    assert "MitsimError: mitsim_grating: " in last and words in last, last


# -------- Glass
#
# `mitsim_glass` against Mitsuba's own dielectric at each index, and its indices against published ones.

LANES = 1000
PUBLISHED = {
    "n-bk7": (1.51680, 64.17),
    "n-sf11": (1.78472, 25.68),
    "fused-silica": (1.45846, 67.82),
    "pmma": (1.4906, 53.2),
    "polycarbonate": (1.5848, 27.9),
    "water": (1.3334, 55.8),
}
"""n_d and V_d: of Schott's data sheets and Malitson's table; of the other sources' own figures."""


def index(model: GlassModel, nanometres: float) -> float:
    return float(np.sqrt(model.index_squared(nanometres)))


@pytest.mark.parametrize("name", PUBLISHED)
def test_indices_are_those_published(name: str) -> None:
    model, (n_d, abbe) = GlassModel.build(glass=name), PUBLISHED[name]
    assert index(model, 587.56) == pytest.approx(n_d, abs=6e-5)
    dispersion = index(model, 486.13) - index(model, 656.27)
    assert (index(model, 587.56) - 1) / dispersion == pytest.approx(abbe, rel=2e-3)


def test_index_and_abbe_number_are_what_they_say() -> None:
    """At the lines that define them, and N-SF11 by its two numbers to 0.003 all over the visible."""
    model, sf11 = GlassModel.build(index=1.78472, abbe=25.68), GlassModel.build(glass="n-sf11")
    assert index(model, 587.56) == pytest.approx(1.78472)
    assert 0.78472 / (index(model, 486.13) - index(model, 656.27)) == pytest.approx(25.68)
    assert max(abs(index(model, nm) - index(sf11, nm)) for nm in range(440, 700)) < 3e-3


def test_a_face_does_what_plain_glass_of_that_index_does() -> None:
    """Reflected, refracted or either, of light and of importance, from both sides, beyond the critical angle too."""
    glass = mi.load_dict({"type": "mitsim_glass", "glass": "n-sf11", "wavelength": 500.0})
    plain = mi.load_dict(
        {"type": "dielectric", "int_ior": index(GlassModel.build(glass="n-sf11"), 500), "ext_ior": 1.0}
    )
    assert is_glass(glass) and not is_glass(plain)
    random = np.random.default_rng(1)
    directions = random.normal(size=(3, LANES))
    si = dr.zeros(mi.SurfaceInteraction3f, LANES)
    si.wi = mi.Vector3f((directions / np.linalg.norm(directions, axis=0)).astype(np.float32))
    number, point = device_array(mi.Float, random.random(LANES)), mi.Point2f(0.5)
    kinds = 0xFFFFFFFF, int(mi.BSDFFlags.DeltaReflection), int(mi.BSDFFlags.DeltaTransmission), int(mi.BSDFFlags.Glossy)
    for mode in (mi.TransportMode.Radiance, mi.TransportMode.Importance):
        for kind in kinds:
            context = mi.BSDFContext(mode)
            context.type_mask = kind
            (ours, own), (theirs, weight) = (each.sample(context, si, number, point) for each in (glass, plain))
            lit = np.broadcast_to(np.array(theirs.pdf) > 0, LANES)
            assert lit.any() == (kind != int(mi.BSDFFlags.Glossy))
            pairs = [(own, weight), (ours.pdf, theirs.pdf)]
            pairs += [(getattr(ours, name), getattr(theirs, name)) for name in ("wo", "eta", "sampled_type")]
            for place, pair in enumerate(pairs):
                full = (np.broadcast_to(np.array(one, dtype=np.float64), (*np.shape(one)[:-1], LANES)) for one in pair)
                a, b = (one if place < 2 else one[..., lit] for one in full)
                np.testing.assert_allclose(a, b, atol=2e-6)


def test_a_scene_has_the_wavelength_of_its_light_but_where_it_says_its_own() -> None:
    nested = {"type": "mask", "opacity": 0.5, "nested": {"type": "mitsim_glass"}}
    own = {"type": "mitsim_glass", "wavelength": 500.0}
    scene = mi.load_dict(
        {"type": "scene", "a": {"type": "sphere", "bsdf": nested}, "b": {"type": "rectangle", "bsdf": own}}
    )
    tune(scene, 638.0)
    found = {name: value for name, value in mi.traverse(scene) if name.endswith("wavelength")}
    assert [float(value[0]) for value in found.values()] == [638, 500]
    assert float(np.array(mi.load_dict({"type": "mitsim_glass"}).wavelength)[0]) == 562, "the MP-CL1's"


@pytest.mark.parametrize(
    ("values", "reported"),
    [
        ({"glass": "n-bk8"}, "glass: got 'n-bk8'; give n-bk7, n-sf11"),
        ({"glass": "water", "index": 1.5, "abbe": 50.0}, "index: glass states the index already"),
        ({"index": 1.5}, "abbe: is not given"),
        ({"abbe": 50.0}, "index: is not given"),
        ({"sellmeier": "1.0, 0.01, 0.2"}, "sellmeier: got 3 numbers"),
        ({"sellmeier": "1.0, x"}, "sellmeier: got '1.0, x'; give numbers"),
        ({"sellmeier": "1.0, 0.25"}, "sellmeier: its index squared is"),
        ({"index": 0.9, "abbe": 50.0}, "index: got 0.9"),
        ({"wavelength": 100.0}, "wavelength: got 100.0"),
    ],
)
def test_bad_glass_is_refused(values: dict[str, object], reported: str) -> None:
    with pytest.raises((MitsimError, RuntimeError), match="mitsim_glass: ") as caught:
        mi.load_dict({"type": "mitsim_glass", **values})
    assert reported in str(caught.value)

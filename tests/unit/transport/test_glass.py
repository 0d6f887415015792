"""`mitsim_glass` against Mitsuba's own dielectric at each index, and its indices against published ones."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.transport.plugins.materials import GlassModel, is_glass, tune

pytestmark = pytest.mark.usefixtures("variant")
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
    number, point = mi.Float(random.random(LANES).astype(np.float32)), mi.Point2f(0.5)
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
        ({"glass": "water", "index": 1.5, "abbe": 50.0}, "index: the index is told by glass already"),
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

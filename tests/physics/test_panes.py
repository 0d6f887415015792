"""Light through flat panes of glass: closed forms under a pinhole, and Mitsuba's ``path`` under a lens.

Rationale. A path of Mitsuba finds no pinhole behind glass. It runs into a lens by chance, however, and a large lens
often: so the reference sees a projector whose lens is a disk of 50 mm that shines (``mitsim_projector``), and so does
the factored estimator, which finds the same light by refracted connections, from the projector's side and, over
mirrors, from the camera's. All light is compared, whichever tracer finds it, reflections inside of the glass too; what
would be found twice or not at all shows. Panes are slanted so that none mirrors the lens into the sensor, which is the
beams' light (tests/unit/transport/test_specular.py). The unmasked sensor of 0.75 mm is seen as a whole, whose mean is
that at its centre to 1e-6.

Significance. Means over independent seeds (8 of each side); a gate of seven standard errors stands for five of the t
distribution, and each test states how narrow it is. Seeds are fixed.
"""

from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.transport import plugins
from mitsim.transport.records import AMBIENT, DIRECT, INDIRECT
from tests.aperture import aperture_scene_parts
from tests.physics.passages import LAMP, METAL, MIRROR, SEEDS, SIGMAS, THIN, all_light, direct_light, mean, plate
from tests.unit.transport.test_panes import WALL, slab

pytestmark = pytest.mark.usefixtures("variant")
LENS = 50.0
# At x = -40 mm, from 305 to 385 mm: it throws light on the wall, and the camera sees the wall in it.
MIRROR_WALL = f"""<shape type="rectangle"><transform name="to_world"><scale x="40" y="40"/><rotate y="1" angle="90"/>
    <translate x="-40" z="345"/></transform>{MIRROR}</shape>"""
SCENES = {
    "one, slanted": slab(220, 6, 20),
    "two, both slanted": slab(220, 6, 12) + slab(320, 10, -25),
    "an edge in the view": slab(330, 4, 20, 25, 25) + plate(390, METAL, 30, -10, 10),
    "before the camera alone": slab(60, 3, 25, -12, 18),
    "a thin pane and a thick one before rough metal": plate(200, THIN, 60, 0, 15) + slab(320, 8, 20, 0, 60)
    + plate(400, METAL, 30, 5, 15),
    "a mirror wall behind": slab(220, 5, 20) + MIRROR_WALL,
    "a lamp before": slab(300, 5, 20) + LAMP,
}  # fmt: skip


@pytest.fixture(scope="module")
def scene(shared_scene: Callable[..., Path], variant: str) -> Callable[..., Bench]:
    count = iter(range(1000))

    def load(extra: str, **numbers: object) -> Bench:
        values = {"sheet_z": WALL, "mask": "open", **numbers}
        return open_bench(shared_scene(f"panes{next(count)}", extra=extra, **values), variant)

    return load


def reference_with_lens(bench: Bench, spp: int) -> tuple[float, float]:
    """Mean over the sensor, and its standard error."""
    plugins.register()
    loaded = bench.loaded
    shapes = {f"shape{i}": shape for i, shape in enumerate(loaded.scene.shapes())}
    parts = aperture_scene_parts(loaded.projector, LENS, WALL)
    integrator = {"type": "volpath", "max_depth": 24, "rr_depth": 100}
    whole = mi.load_dict({"type": "scene", "integrator": integrator, "camera": loaded.camera, **shapes, **parts})
    return mean([float(np.array(mi.render(whole, spp=spp, seed=seed), np.float64).mean()) for seed in range(SEEDS)])


def test_an_upright_pane_dims_the_wall_and_brings_it_nearer(scene: Callable[..., Bench]) -> None:
    """Direct light keeps (1 - R)^4, R = ((n - 1) / (n + 1))^2, and the wall is t (1 - 1/n) nearer to the projector.

    The sensor looks at an even wall through a narrow stop: radiance, which distance does not change. Angles of 10
    degrees at most change T and the shift by 5e-4.
    """
    alone, behind = scene("", fov=8), scene(slab(220, 6), fov=8)
    nearer = WALL / (WALL - 6 * (1 - 1 / 1.5))
    found = direct_light(behind, 1) / direct_light(alone, 1)
    assert found == pytest.approx((1 - 0.04) ** 4 * nearer**2, rel=1e-3)


def test_with_all_reflections_the_pane_passes_the_closed_form(scene: Callable[..., Bench]) -> None:
    """T = (1 - R)^2 / (1 - R^2) for each crossing, once reflections inside of the glass are followed.

    Light between wall and pane (up to 2 R times the wall's 0.5, spread over the hemisphere) is told apart as indirect.
    """
    alone, behind = scene("", fov=8), scene(slab(220, 6), fov=8)
    light = [all_light(behind, seed, 128)[DIRECT] for seed in range(SEEDS)]
    found, error = mean(light)
    passed = (1 - 0.04) ** 2 / (1 - 0.04**2)
    expected = direct_light(alone, 1) * passed**2 * (WALL / (WALL - 2)) ** 2
    assert SIGMAS * error < 1e-3 * expected
    assert abs(found - expected) < SIGMAS * error + 1e-3 * expected
    # Without what the followers add, the 0.3 % between (1 - R)^4 and T^2, it would be told apart.
    assert direct_light(behind, 1) < expected * (1 - 2e-3)


def test_a_pane_before_the_camera_counts_light_once(scene: Callable[..., Bench]) -> None:
    """The projector shines past it, so both sides could find the wall's light: seen through the pane, or connected."""
    bench = scene(slab(30, 3, 0, -12, 20), fov=8)
    alone = scene("", fov=8)
    found, error = mean([all_light(bench, seed, 64)[DIRECT] for seed in range(SEEDS)])
    expected = direct_light(alone, 1) * (1 - 0.04) ** 2 / (1 - 0.04**2)
    assert SIGMAS * error < 2e-3 * expected
    assert abs(found - expected) < SIGMAS * error + 1e-3 * expected


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_all_light_is_that_of_paths_that_meet_the_lens(scene: Callable[..., Bench], name: str) -> None:
    bench = scene(SCENES[name])
    light = [all_light(bench, seed, 64, LENS, WALL) for seed in range(SEEDS)]
    found, error = mean([float(parts.sum()) for parts in light])
    expected, spread = reference_with_lens(bench, 512)
    gate = SIGMAS * np.hypot(error, spread)
    assert gate < 0.04 * expected
    assert abs(found - expected) < gate, f"{found / expected - 1:+.2%}, gate {gate / expected:.2%}"
    assert np.mean(light, axis=0)[[DIRECT, INDIRECT]].min() > 0 and (np.mean(light, axis=0)[AMBIENT] > 0) == (
        name == "a lamp before"
    )


@pytest.mark.parametrize("before", [slab, lambda z, thick: plate(z + thick / 2, THIN, 60)])
def test_a_wall_close_behind_glass(scene: Callable[..., Bench], before: Callable[..., str]) -> None:
    """Its light is the same at 0.1 and 0.004 mm of air, of which Mitsuba's rays skip 0.036. (Seen failing: none.)"""
    far, close = (direct_light(scene(before(WALL - gap - 2, 4), fov=8), 1) for gap in (0.1, 0.004))
    assert close == pytest.approx(far, rel=2e-4)


@pytest.mark.slow
def test_a_point_lamp_behind_a_pane(scene: Callable[..., Bench]) -> None:
    """E = I T sin a / (r dr/da) at a distance r from below the lamp, r = (z - t) tan a + t tan b, sin a = n sin b.

    The pane stands in the lamp's way alone, and the stop shows 15 mm of the wall. (Seen failing: no light at all.)
    """
    lamp = """<emitter type="point"><point name="position" x="-150" y="0" z="200"/>
        <spectrum name="intensity" value="1000"/></emitter>"""
    light = [scene(lamp + pane, fov=2) for pane in ("", slab(380, 6, 0, -40, 30))]
    alone, behind = (float(np.mean([all_light(bench, seed, 64)[AMBIENT] for seed in range(4)])) for bench in light)
    z, r, thick, index = WALL - 200, 150.0, 6.0, 1.5
    slope = r / z
    for _ in range(40):
        sine = slope / np.hypot(1, slope) / index
        slope = (r - thick * sine / np.sqrt(1 - sine**2)) / (z - thick)
    cosine, inside = 1 / np.hypot(1, slope), np.sqrt(1 - sine**2)
    s, p = (cosine - index * inside) / (cosine + index * inside), (index * cosine - inside) / (index * cosine + inside)
    grows = (z - thick) / cosine**2 + thick * cosine / (index * inside**3)
    expected = (1 - (s**2 + p**2) / 2) ** 2 * slope * cosine / (r * grows) / (z / np.hypot(z, r) ** 3)
    # Interreflection between wall and pane, and the pane's reflections of the projector, are no part of it.
    assert behind / alone == pytest.approx(expected, rel=5e-3)

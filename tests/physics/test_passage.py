"""Light that passes cut-outs, thin panes and filters: the factored estimator against ``volpath`` and closed forms.

Rationale. Mitsuba's ``path`` takes the hole of a ``mask`` for opaque when it connects a surface to a light, ``volpath``
does not, so that is the judge. It sees the unmasked sensor of 0.75 mm as a whole; the factored estimator's light at the
sensor's centre is that mean to 1e-6, as the falloff over the sensor is even. All light is compared, whichever tracer
finds it: counted twice or not at all, it shows. Scenes are small, so that a third of a permille is seen.

Significance. Means over independent seeds (8 of the factored estimator, 8 passes of the reference); a gate of seven
standard errors stands for five of the t distribution, and each test states how narrow it is. Seeds are fixed.
"""

from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.transport.records import AMBIENT, DIRECT
from tests.conftest import write_png
from tests.physics.passages import LAMP, METAL, MIRROR, SEEDS, SIGMAS, THIN, all_light, direct_light, mean, plate

pytestmark = pytest.mark.usefixtures("variant")
WALL = 440.0
MATT = '<bsdf type="twosided"><bsdf type="diffuse"/></bsdf>'
LEAF = """<bsdf type="mask"><texture name="opacity" type="bitmap"><string name="filename" value="leaf.png"/>
    <boolean name="raw" value="true"/><string name="filter_type" value="nearest"/></texture>{inner}</bsdf>"""


def card(opacity: float, inner: str = MATT) -> str:
    return f'<bsdf type="mask"><float name="opacity" value="{opacity}"/>{inner}</bsdf>'


SCENES = {
    "leaf": plate(350, LEAF.format(inner=MATT)),
    "two cut-outs behind each other": plate(350, LEAF.format(inner=MATT), 30)
    + plate(300, LEAF.format(inner=METAL), 20),
    "half a card before rough metal": plate(330, card(0.5), 40) + plate(380, METAL, 40, 5, 15),
    "slanted thin pane before rough metal": plate(330, THIN, 60, 0, 20) + plate(400, METAL, 30, 5, 15),
    "thin pane that is half cut out": plate(330, LEAF.format(inner=THIN), 50),
    "lamp behind a cut-out": LAMP + plate(200, LEAF.format(inner=MATT), 45, -20),
}


@pytest.fixture(scope="module")
def scene(shared_scene: Callable[..., Path], variant: str) -> Callable[..., Bench]:
    """A wall at 440 mm with other things before it; ``leaf.png`` has ragged holes and a grey stripe."""
    count = iter(range(1000))

    def load(extra: str, depth: int = -1, **numbers: object) -> Bench:
        options = f'<integer name="max_depth" value="{depth}"/><integer name="rr_depth" value="100"/>'
        values = {"sheet_z": WALL, "mask": "open", "integrator": "volpath", "integrator_options": options, **numbers}
        path = shared_scene(f"passage{next(count)}", extra=extra, **values)
        rows, columns = np.mgrid[:32, :32]
        leaf = np.where((rows * 7 + columns * columns) % 11 < 5, 255, 0)
        leaf[:, 10:14] = 128
        write_png(path.parent / "leaf.png", leaf)
        return open_bench(path, variant)

    return load


def reference(bench: Bench, spp: int) -> tuple[float, float]:
    """Mean over the sensor by the scene's own integrator, and its standard error."""
    frames = [mi.render(bench.loaded.scene, sensor=bench.loaded.camera, spp=spp, seed=seed) for seed in range(SEEDS)]
    return mean([float(np.array(frame, dtype=np.float64).mean()) for frame in frames])


def test_a_card_of_opacity_0_is_no_card(scene: Callable[..., Bench]) -> None:
    """The wall alone, ray by ray; float32 moves rays that start anew by 1e-7 of their way."""
    alone, behind = scene(""), scene(plate(350, card(0)))
    assert not behind.loaded.mirrors
    assert direct_light(behind, 1) == pytest.approx(direct_light(alone, 1), rel=1e-6)


@pytest.mark.parametrize("radius", [6.0, 1.5])
def test_a_cylinder_does_not_hide_itself(scene: Callable[..., Bench], radius: float) -> None:
    """Its points lie off its surface by single precision. (Seen failing with the short offset of flat surfaces: 28
    and 62 % of the light were lost.)"""
    rod = f"""<shape type="cylinder"><point name="p0" x="-40" y="-30" z="330"/><point name="p1" x="40" y="25" z="310"/>
        <float name="radius" value="{radius}"/>{MATT}</shape>"""
    alone, beside = scene(rod, sheet_z=-400), scene(rod + plate(350, card(0)), sheet_z=-400)
    assert direct_light(beside, 1) == pytest.approx(direct_light(alone, 1), rel=1e-3)


def test_an_instance_does_not_hide_itself(scene: Callable[..., Bench]) -> None:
    """Rods, alone and of a group in which they are half as large. (Seen failing with the short offset of what is no
    instance: 16 % was lost.)"""

    def rods(scale: float, z: float) -> str:
        ends = ("p0", -40, -30, 330), ("p1", 40, 25, 310)
        points = "".join(
            f'<point name="{name}" x="{x * scale}" y="{y * scale}" z="{(depth - z) * scale}"/>'
            for name, x, y, depth in ends
        )
        return f'<shape type="cylinder">{points}<float name="radius" value="{1.5 * scale}"/>{MATT}</shape>'

    group = f"""<shape type="shapegroup" id="group">{rods(0.5, 300)}</shape><shape type="instance"><ref id="group"/>
        <transform name="to_world"><scale value="2"/><translate z="300"/></transform></shape>"""
    alone = scene(rods(1, 0), sheet_z=-400)
    assert direct_light(scene(group, sheet_z=-400), 1) == pytest.approx(direct_light(alone, 1), rel=1e-3)


def test_what_stands_behind_the_sensor_hides_nothing(scene: Callable[..., Bench]) -> None:
    """A wall of the room behind camera and projector (seen failing: what lay beyond the sensor hid all light)."""
    room = plate(-300, MATT, 1000)
    alone, behind = scene(room), scene(room + plate(350, card(0)))
    assert direct_light(behind, 1) == pytest.approx(direct_light(alone, 1), rel=1e-6)


@pytest.mark.parametrize("opacity", [0.25, 1.0])
def test_a_black_card_dims_the_wall_by_its_opacity_squared(scene: Callable[..., Bench], opacity: float) -> None:
    """It stands in the whole way to the wall, and in the whole way back."""
    black = '<bsdf type="diffuse"><spectrum name="reflectance" value="0"/></bsdf>'
    alone, behind = direct_light(scene(""), 1), direct_light(scene(plate(220, card(opacity, black), 90)), 1)
    assert behind == pytest.approx((1 - opacity) ** 2 * alone, rel=1e-6)


def test_a_thin_pane_dims_the_wall_by_its_transmittance_squared(scene: Callable[..., Bench]) -> None:
    """T = (1 - R) / (1 + R) with all reflections inside, R = ((n - 1) / (n + 1))^2; tilts change it by 1e-3 at most."""
    pane = '<bsdf type="thindielectric"><float name="int_ior" value="1.5"/><float name="ext_ior" value="1"/></bsdf>'
    transmittance = (1 - 0.04) / (1 + 0.04)
    alone, behind = scene("", fov=4), scene(plate(220, pane, 90), fov=4)
    assert direct_light(behind, 1) == pytest.approx(transmittance**2 * direct_light(alone, 1), rel=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_all_light_is_that_of_the_reference(scene: Callable[..., Bench], name: str) -> None:
    bench = scene(SCENES[name])
    found, error = mean([float(all_light(bench, seed).sum()) for seed in range(SEEDS)])
    expected, spread = reference(bench, 64)
    gate = SIGMAS * np.hypot(error, spread)
    assert gate < 0.02 * expected
    assert abs(found - expected) < gate, f"{found / expected - 1:+.2%}, gate {gate / expected:.2%}"


def test_light_through_a_hole_is_direct_light(scene: Callable[..., Bench]) -> None:
    """With one surface on the way, and nothing but direct light; so truth has it."""
    bench = scene(SCENES["leaf"], 2)
    found, error = mean([direct_light(bench, seed) for seed in range(SEEDS)])
    expected, spread = reference(bench, 64)
    gate = SIGMAS * np.hypot(error, spread)
    assert gate < 8e-3 * expected
    assert abs(found - expected) < gate
    blind = direct_light(scene(plate(350, MATT)), 1)
    assert abs(blind - expected) > 3 * gate, "an opaque card is told apart"


@pytest.mark.slow
def test_a_hole_before_a_mirror_is_no_hole(scene: Callable[..., Bench]) -> None:
    """What mirrors add (specular chains, caustics, things seen in them) is the same behind a card of opacity 0."""
    mirror = plate(395, MIRROR, 30, 30)
    alone, behind = scene(mirror), scene(mirror + plate(250, card(0), 14, 12))
    light = [
        [all_light(bench, seed, 64)[[AMBIENT, DIRECT]].sum() for seed in range(SEEDS)] for bench in (alone, behind)
    ]
    (found, error), (expected, spread) = (mean(values) for values in light)
    gate = SIGMAS * np.hypot(error, spread)
    assert gate < 0.02 * expected and abs(found - expected) < gate
    frames = [bench.specular.frames(np.zeros(bench.n**2, np.int64), bench.geometry, None) for bench in (alone, behind)]
    assert frames[0].irradiance.sum() > 0
    assert frames[1].irradiance.sum() == pytest.approx(frames[0].irradiance.sum(), rel=1e-5)

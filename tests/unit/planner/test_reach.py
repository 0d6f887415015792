"""Light of near surfaces at the edge of the view: the cells hold it, and what they do not hold is counted and
said.

A card at 150 mm stands before a camera that is aligned to 400 mm. Through the field stop the sensor's edge sees
the card at tan-angles (from the centre) that no surface at 400 mm has. Judge: an integral over the card.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.acquire.exposure import Totals
from mitsim.api.bench import Bench, open_bench
from mitsim.devices.patterns import Lighting
from mitsim.light.light import SampledLight, Sampling, trace_light
from mitsim.light.passes import Simulation
from mitsim.light.settings import Settings
from mitsim.planner.pilot import light_reach
from mitsim.planner.planner import make_plan

N, Z, NEAR, ALBEDO, SCALE, HALF = 48, 400.0, 150.0, 0.1, 111000.0, 3.2
STOP = np.tan(np.radians(10))
LEFT, RIGHT, TALL = 20.0, 30.0, 20.0
CARD = f"""<shape type="rectangle"><transform name="to_world"><rotate y="1" angle="180"/>
    <scale x="{(RIGHT - LEFT) / 2}" y="{TALL}"/><translate x="{(LEFT + RIGHT) / 2}" z="{NEAR}"/></transform>
    <bsdf type="diffuse"><spectrum name="reflectance" value="{ALBEDO}"/></bsdf></shape>"""


@pytest.fixture
def scene(small_scene: Callable[..., Path], variant: str) -> Callable[..., Bench]:
    def opened(name: str, **numbers: object) -> Bench:
        numbers = {"extra": CARD, "mask": "open", "n": N, "pitch": 2 * HALF / 64, **numbers}
        return open_bench(small_scene(name, **numbers), variant, for_render=True)

    return opened


def card_alone() -> float:
    """Irradiance of the card on the open sensor, mean over it: L times the integral of (1 + |t|^2)^-2."""
    node, weight = np.polynomial.legendre.leggauss(24)
    total = 0.0
    for u, du in zip(node * HALF, weight / 2, strict=True):
        high = min(RIGHT, u + STOP * NEAR)
        x, dx = (LEFT + high) / 2 + node * (high - LEFT) / 2, weight * (high - LEFT) / 2
        for v, dv in zip(node * HALF, weight / 2, strict=True):
            tx, ty = (x - u) / NEAR, (node * TALL - v) / NEAR
            falloff = (1 + np.square(tx)[:, None] + np.square(ty)[None, :]) ** -2
            total += du * dv * float(dx @ falloff @ (weight * TALL)) / NEAR**2
    return ALBEDO * SCALE / NEAR**2 * total


def accumulated(bench: Bench, reach: float | None, samples: int = 64) -> tuple[float, float]:
    """Irradiance that is accumulated, and that which is not."""
    made = Simulation(bench, Settings(depth=Z, anchors=3, reach=reach))
    labels = np.zeros(N * N, dtype=np.int64)
    light = made.accumulate("direct", made.direct.trace(5, 0, samples), labels, samples)
    return float(light["fine"].sum()), light.outside


def test_the_cells_hold_what_the_sensors_edge_sees_of_a_near_card(scene: Callable[..., Bench]) -> None:
    """All light of the card is accumulated, to 0.5 %: 64 samples a pixel."""
    bench = scene("card", sheet_z=-500)
    reach = light_reach(Simulation(bench, Settings(depth=Z)), seed=1)
    assert reach is not None and STOP + HALF / Z < RIGHT / NEAR * 0.95 < reach < STOP + HALF / NEAR + 1e-6
    kept, outside = accumulated(bench, reach)
    assert kept == pytest.approx(card_alone(), rel=5e-3) and outside == 0
    # The cells of 400 mm alone would lose light, and say how much.
    few, lost = accumulated(bench, None)
    assert lost > 0.02 * kept and few + lost == pytest.approx(kept, rel=1e-12)


def test_flat_scenes_keep_their_cells(scene: Callable[..., Bench]) -> None:
    for name, numbers in {"flat": {}, "far": {"sheet_z": 300}}.items():
        bench = scene(name, extra="", **numbers)
        depth = float(numbers.get("sheet_z", Z))
        assert light_reach(Simulation(bench, Settings(depth=depth)), seed=1) is None


def light(bench: Bench, reach: bool) -> SampledLight:
    lighting = Lighting.uniform(N)
    plan = make_plan(bench, lighting, 1e-2, 0, {"anchors": True})
    assert plan.settings.reach is not None
    settings = replace(plan.settings, depth=Z, reach=plan.settings.reach if reach else None)
    return trace_light(bench, replace(plan, settings=settings, warnings=()), lighting, 0, Sampling(by_pixel=False))


def test_light_beyond_the_cells_flags_the_result(scene: Callable[..., Bench], tmp_path: Path) -> None:
    """A plan that knows of the card is not flagged; one that does not is, for the light that it loses."""
    bench = scene("both")
    kept, lost = light(bench, reach=True), light(bench, reach=False)
    assert kept.lost == 0 and not kept.warnings
    assert lost.lost > 2e-3 and "missing in the frames" in lost.warnings[0]
    # The frames lack what is said to be lost.
    frames = [next(iter(each.frames(Lighting.uniform(N), 0))) for each in (kept, lost)]
    whole, part = (float(frame.irradiance.sum()) for frame in frames)
    assert 1 - part / whole == pytest.approx(lost.lost, rel=0.1)
    assert Totals.of(frames).noise.value < 1e-2
    run = tmp_path / "run"
    bench.capture("uniform", run, accuracy=1e-2)
    assert json.loads((run / "manifest.json").read_text())["lost_light"] == 0

"""Cards smaller than a projector pixel against the closed form: few rays meet them, and their number tells the error.

The projector lights a plane at z with pi * scale / z^2 all over its window; a card of area A and albedo rho on the axis
sends rho / pi of that, times A cos / z^2, to the sensor.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.acquire.exposure import Totals
from mitsim.api.bench import open_bench
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import Lighting

Z, SCALE, ALBEDO, ASIDE = 400.0, 111000.0, 0.9, 60.0
PER_AREA = ALBEDO * SCALE / Z**4
"""Irradiance [W m^-2] that a square millimetre facing the camera brings."""
BLACK = """<shape type="rectangle"><transform name="to_world"><rotate y="1" angle="180"/> <scale x="90" y="90"/>
<translate z="430"/></transform><bsdf type="diffuse"><spectrum name="reflectance" value="0"/></bsdf></shape>"""


def card(width: float, height: float, x: float = 0.0, y: float = 0.0, turned: float = 0.0) -> tuple[str, float]:
    """A card's XML and the irradiance that it brings; ``turned`` away from the projector by degrees about y."""
    off, towards = math.radians(turned), math.atan2(ASIDE, Z)
    # The window's irradiance is that of planes that face the camera: on a turned one it goes by the angle from its ray.
    faces = math.cos(off + towards) / math.cos(towards)
    at_camera = (1 + (x * x + y * y) / Z**2) ** -2
    xml = f"""<shape type="rectangle"><transform name="to_world"><scale x="{width / 2}" y="{height / 2}"/>
    <rotate y="1" angle="{180 + turned}"/> <translate x="{x}" y="{y}" z="{Z}"/></transform>
    <bsdf type="diffuse"><spectrum name="reflectance" value="{ALBEDO}"/></bsdf></shape>"""
    return xml, PER_AREA * width * height * math.cos(off) * faces * at_camera


def off(path: Path, expected: float, seed: int, accuracy: float = 1e-2) -> tuple[float, float]:
    """Relative error of the mean irradiance, and the bound that is stated for it."""
    bench = open_bench(path)
    light = bench.light("uniform", accuracy=accuracy, seed=seed)
    frames = light.frames(Lighting(np.zeros(bench.n**2, int), np.ones((1, 1))), seed)
    (frame,) = frames
    stated = light.plan.total(Totals.of(frames).noise)
    assert light.reached and stated.bound <= accuracy
    return abs(float(frame.irradiance.mean()) / expected - 1), stated.bound


def scene(small_scene: Callable[..., Path], *cards: tuple[str, float], behind: str = "") -> tuple[Path, float]:
    """A scene of ``cards`` alone, lit by 16 x 16 projector pixels of 8 mm, and the irradiance that they bring."""
    path = small_scene(pixels=16, mask="open", extra="".join(xml for xml, _ in cards) + behind)
    sheet = r'<shape type="rectangle">\s*<transform name="to_world">\s*<rotate z="1".*?</shape>'
    text, found = re.subn(sheet, "", path.read_text(), flags=re.S)
    assert found == 1
    path.write_text(text)
    return path, sum(each for _, each in cards)


@pytest.mark.parametrize(
    ("side", "place", "seed"), [(0.7, (1, 2), 2), pytest.param(0.36, (1, 1), 0, marks=pytest.mark.slow)]
)
def test_a_card_that_few_rays_meet(
    small_scene: Callable[..., Path], variant: str, side: float, place: tuple[int, int], seed: int
) -> None:
    """Where the pilot's looks meet it equally often, as the first, and where groups hardly differ.

    (Planted: no count of hits. The first card came out black with an error of 2.8e-6 stated, the second 2.4e-2 off
    where 2.0e-2 was stated.)
    """
    error, bound = off(*scene(small_scene, card(side, side, *place)), seed, 3e-2)
    assert error < bound


def test_a_card_that_no_look_can_count_on_is_refused(small_scene: Callable[..., Path], variant: str) -> None:
    with pytest.raises(MitsimError, match="too small for the projector: together they fill"):
        off(*scene(small_scene, card(0.2, 0.2, 1, 1)), 0)


CARDS = {
    "one": [card(0.5, 0.5, 2, -3)],
    "two": [card(0.6, 0.6, -20, 5), card(0.9, 0.5, 17, -12)],
    "turned": [card(1.2, 0.8, turned=50)],
    "rod": [card(0.1, 9, 3, 2)],
    "before black": [card(0.7, 0.7, 3, 3)],
}


@pytest.mark.slow
def test_cards_are_within_what_is_stated(small_scene: Callable[..., Path], variant: str) -> None:
    """Twenty runs at 1e-2: each within it, and all but two at most within their bound (95 %: three or more beyond it in
    one of 13 such tests, and seeds are fixed)."""
    beyond = []
    for name, cards in CARDS.items():
        for seed in range(4):
            error, bound = off(*scene(small_scene, *cards, behind=BLACK if name == "before black" else ""), seed)
            assert error < 1e-2, (name, seed)
            beyond += [(name, seed, error, bound)] if error > bound else []
    assert len(beyond) <= 2, beyond

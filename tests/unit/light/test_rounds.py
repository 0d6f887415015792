"""How much of each light the next round of sampling traces: what buys the missing accuracy with the least work."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mitsim.light.light import SampledPass, cheapest_samples, next_samples
from mitsim.light.passes import EVEN, even

LIGHTS = (
    SampledPass("direct", 24, 0.165, 3.0),
    SampledPass("anchor_residual", 1, 0.015, 8.0),
    SampledPass("indirect", 59, 0.5, 2.0),
    SampledPass("indirect_residual", 3, 0.23, 15.0),
)


def left(light: SampledPass, samples: int) -> float:
    """By hand: 1 / N, but for direct light, whose 2^k samples are better than 3 * 2^k."""
    if light.name != "direct":
        return light.variance * light.done / samples
    found = light.variance * (light.done / samples) ** 1.5
    return found / 1.2 if even(samples) == 2 ** round(math.log2(samples)) else found


@pytest.mark.parametrize("allowed", [0.9, 0.7, 0.5, 0.3])
def test_no_other_samples_take_less_work(allowed: float) -> None:
    """Against all that there are, but for what is rounded up: half a sample of each light that takes any number.

    (Planted: the last that is enough, direct light as if 3 * 2^k samples were as good.)
    """
    found = cheapest_samples(LIGHTS, allowed)
    assert sum(left(light, found[light.name]) for light in LIGHTS) <= allowed
    assert all(found[light.name] >= light.done for light in LIGHTS)
    assert all(even(found[light.name]) == found[light.name] for light in LIGHTS if light.name in EVEN)

    ladders = [(24, 32, 48, 64, 96), (1, 2, 3, 4, 6, 8), range(59, 400), range(3, 24)]
    choices = list(zip(LIGHTS, ladders, strict=True))
    work = sum(np.ix_(*([light.work * count for count in counts] for light, counts in choices)))
    variance = sum(np.ix_(*([left(light, count) for count in counts] for light, counts in choices)))
    assert sum(light.work * found[light.name] for light in LIGHTS) <= work[variance <= allowed].min() + (2.0 + 15.0)


def test_a_heavy_path_makes_its_own_light_grow() -> None:
    """Indirect light with 0.95 of the variance: the others, of ten times its work, stay as they are.

    (Planted: each given its part by Lagrange, though it has more.)
    """
    shares = ("direct", 32, 0.03, 20.0), ("indirect", 57, 0.95, 2.0), ("penumbra", 6, 0.02, 20.0)
    more = ("from_camera", 9, 0.0, 20.0), ("indirect_residual", 9, 0.0001, 20.0)
    lights = [SampledPass(*share) for share in (*shares, *more)]
    found = cheapest_samples(lights, 1 / 6)
    grown = math.ceil(57 * 0.95 / (1 / 6 - 0.0501))
    assert found == {"direct": 32, "indirect": grown, "penumbra": 6, "from_camera": 9, "indirect_residual": 9}


def simulated(**tracers: tuple[Any, float]) -> Any:
    """A simulation of these tracers, with predicted samples."""
    passes = {name: SimpleNamespace(tracer=tracer, predicted=count) for name, (tracer, count) in tracers.items()}
    return SimpleNamespace(passes=passes)


def of_lanes(paths_per_sample: int) -> Any:
    return SimpleNamespace(paths_per_sample=paths_per_sample)


def test_the_next_round_lowers_the_variance_by_what_is_missing_and_a_twentieth() -> None:
    """At least by a tenth, at most to a sixth. (Planted: each of the three left out.)"""
    simulation, done = simulated(indirect=(of_lanes(10), 100.0)), {"indirect": 1000}

    def grown(excess: float) -> float:
        return next_samples(simulation, done, {"indirect": 3.0}, excess)["indirect"]

    assert grown(1.5) == math.ceil(1000 * 1.05 * 1.5**2)
    assert grown(1.001) == 1100
    assert grown(1e200) == 6000

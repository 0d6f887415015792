"""Pilot result of a scene that nobody rendered: a pilot's word on every effect in, plans and their rows out.

Sizes of changes are chosen so that each accuracy of ``ACCURACIES`` needs others of them.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from mitsim.bench.effects import parse_switches
from mitsim.light.cost_model import (
    Numbers,
    accumulation_seconds,
    checking_seconds,
    entries,
    optics_seconds,
    tracing_seconds,
    truth_seconds,
)
from mitsim.light.plan import Plan, PlanRow
from mitsim.light.settings import (
    REPLICATES,
    SURE,
    Approximation,
    ErrorCovariance,
    Forming,
    PilotResult,
    SampleCost,
    Settings,
)
from mitsim.planner.choose import Candidate, Candidates
from mitsim.planner.planner import SceneFacts, explain_plan

FACTS = SceneFacts(notes={"diffraction": "Fresnel number 3.2"}, keystone=0.0)
SIZES = {
    **{Approximation("anchors", count): size for count, size in {1: 2e-3, 2: 3e-4, 3: 4e-5, 5: 1e-5}.items()},
    **{Approximation("layers", count): size for count, size in {1: 4e-3, 2: 6e-4, 3: 2e-4, 4: 5e-5}.items()},
    **{Approximation("cells", count): size for count, size in {1: 6e-3, 2: 2e-3, 4: 1e-4, 8: 1e-5}.items()},
    **{
        Approximation(name): size
        for name, size in {"interreflection": 2e-2, "diffraction": 0.3, "ambient": 5e-4}.items()
    },
    **{Approximation("followed_anchors", count): size for count, size in {1: 7e-4, 2: 9e-5, 3: 1e-5}.items()},
    Approximation("blur"): 1e-3,
    Approximation("anchor_residual cells", 1): 2e-4,
    Approximation("indirect cells", 1): 4e-4,
    Approximation("indirect layers", 1): 3e-4,
}
APART = {"speckle": 8e-3}


def changes(sizes: dict[Approximation, float], noise: float = 0.0, seed: int = 0) -> ErrorCovariance:
    """Changes at right angles to each other, each look with ``noise`` of its own: independent, of norm ``noise``."""
    rng, count = np.random.default_rng(seed), len(sizes)
    vectors = np.diag(list(sizes.values()))
    space = count + 40
    exact = np.zeros((count, space))
    exact[:, :count] = vectors
    replicates = exact[:, None] + noise * rng.normal(size=(count, REPLICATES, space)) / math.sqrt(space)
    return ErrorCovariance.between(dict(zip(sizes, replicates, strict=True)), 1.0)


PILOT_RESULT = PilotResult(
    depth=380.0,
    layers={1: (380.0,), 2: (400.0, 300.0), 3: (400.0, 343.0, 300.0), 4: (400.0, 369.0, 327.0, 300.0)},
    changes=changes(SIZES),
    sample_costs={
        "direct": SampleCost(2e-3, 16, 16_384, 0.8),
        "anchor_residual": SampleCost(3e-4, 4, 16_384),
        "indirect": SampleCost(4e-3, 2, 16_384),
        "from_camera": SampleCost(1e-2, 2, 20_000),
        "indirect_residual": SampleCost(2e-3, 2, 36_384),
        "camera_residual": SampleCost.none(),
    },
    spread=SampleCost(2e-3, 16, 16_384, 0.8),
    forming=Forming(pixels=512, cells=150, lit=0.2, terms=3.0, shots=49, classes=49),
    apart=APART,
)
ONE_CLASS = replace(PILOT_RESULT, forming=replace(PILOT_RESULT.forming, shots=1, classes=1))
"""The same under one pattern, whose light takes no memory."""


ACCURACIES = [0.1, 1e-2, 3e-3, 1e-3, 3e-4]


def cheapest(accuracy: float, pilot_result: PilotResult, switches: Mapping[str, bool], sure: float = SURE) -> Candidate:
    """The choice of least work that keeps ``accuracy``, or of least error if none does."""
    return Candidates(pilot_result, switches).choice(accuracy, sure)


def plan(
    accuracy: float = 1e-3,
    pilot_result: PilotResult = PILOT_RESULT,
    effects: str = "",
    facts: SceneFacts = FACTS,
    pace: float = 1.0,
) -> Plan:
    return explain_plan(accuracy, pilot_result, facts, parse_switches(effects), pace=pace)


def rows(found: Plan) -> dict[str, PlanRow]:
    return {effect.name: effect for effect in found.effects}


def stages(pilot_result: PilotResult, settings: Settings, pace: float = 1.0) -> dict[str, float]:
    """Seconds of each stage: paths, accumulating of what they bring, looks at the error; rays of the truth; frames."""
    forming, numbers = pilot_result.forming, Numbers.of(settings)
    held = entries(pilot_result.sample_costs["direct"].paths, forming.classes, numbers, settings)
    rest = float(accumulation_seconds(forming, numbers, held)) + float(checking_seconds(forming, numbers))
    return {
        "transport": pace * sum(tracing_seconds(pilot_result, settings).values()) + rest,
        "truth": pace * truth_seconds(pilot_result, settings),
        "optics": float(optics_seconds(forming, numbers)),
    }


def with_sample_costs(pilot_result: PilotResult, **costs: SampleCost) -> PilotResult:
    return replace(pilot_result, sample_costs={**pilot_result.sample_costs, **costs})


def with_occluded(sizes: dict[int, float]) -> PilotResult:
    """150 pixels that leave so much by the number of their anchors."""
    found = changes(SIZES | {Approximation("occluded_anchors", count): size for count, size in sizes.items()})
    several = replace(ONE_CLASS, changes=found, occluded=tuple(range(150)))
    return with_sample_costs(several, penumbra=SampleCost(1e-4, 4, 150))

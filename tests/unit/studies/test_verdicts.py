"""Verdicts on claims: paired differences with their standard errors, on both sides of every border."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.report import EQUAL_FRAME, EQUAL_PEAK, IDEALISED, MODELS, RENDERED
from mitsim.report.pages import Mean, Value
from mitsim.studies import drift_study
from mitsim.studies.framework.claims import (
    CONFIRMED,
    NOT_CONFIRMED,
    UNDECIDED,
    every,
    mean_of,
    verdict_at,
    within,
)
from mitsim.studies.framework.experiment import Results, find_experiment
from mitsim.studies.light_studies import AS_BRIGHT, STRONG, WEAK
from mitsim.studies.waterfall_study import EFFECTS

Row = dict[str, Value]
Build = Callable[[float], list[Row]]
"""From what decides a claim to the rows of a study."""
JITTER = (-0.1, 0.0, 0.1)
"""Of three prints: a standard error of 0.058, and a 95 % interval of 4.3 of them, 0.25, either way."""
ASIDE = 0.3
"""From a border to where it is decided."""
PRINTS_DB = (0.0, 7.0, 14.0)
"""What prints differ by, which would hide any gain of images that are not paired: an interval of 17 dB either way."""


def rows(
    value: float, column: str = "psnr_db", jitter: bool = False, absolute: bool = True, **named: Value
) -> list[Row]:
    """Three prints that come to a ``value``, of both models unless one is named."""
    models = (str(named.pop("model")),) if "model" in named else MODELS
    return [
        {
            **named, "model": model, "picture": name, "seed": 0, "point": f"{name}{model}{sorted(named.items())}",
            column: value + (0 if absolute else offset) + more * jitter,
        }
        for model in models
        for name, offset, more in zip("abc", PRINTS_DB, JITTER, strict=True)
    ]  # fmt: skip


def gain(column: str, better: Mapping[str, Value], other: Mapping[str, Value], **named: Value) -> Build:
    """Two sets of images, one better by a gain."""
    return lambda value: [
        *rows(20 + value, column, jitter=True, absolute=False, **better, **named),
        *rows(20, column, absolute=False, **other, **named),
    ]


def level(column: str = "psnr_db", **named: Value) -> Build:
    return lambda value: rows(value, column, jitter=True, **named)


def beside(build: Build, *others: list[Row]) -> Build:
    """What a study measures besides, which decides nothing."""
    return lambda value: [*build(value), *(row for each in others for row in each)]


def patterns(better: str, other: str) -> Build:
    rest = [rows(20, patterns=name, exposure=EQUAL_PEAK) for name in ("uniform", "dots:2", "dots:7", "dots:8",
            "random:7", "hadamard:8") if name not in (better, other)]  # fmt: skip
    return beside(gain("psnr_db", {"patterns": better}, {"patterns": other}, exposure=EQUAL_PEAK), *rest)


def frames(better: str, other: str) -> Build:
    """Of moved masks: SweepCam's frames, those of uniform light and of dots."""
    names = "uniform frames", "SweepCam", "shifting dots"
    rest = [rows(25, patterns=name, exposure=each, frames=49, absolute=False) for name in names
            for each in (EQUAL_PEAK, EQUAL_FRAME) if name not in (better, other)]  # fmt: skip
    rest += [rows(22, patterns="uniform frames", exposure=each, frames=1) for each in (EQUAL_PEAK, EQUAL_FRAME)]

    def build(value: float) -> list[Row]:
        pairs = (gain("psnr_db", {"patterns": better}, {"patterns": other}, exposure=each, frames=49)(value)
                 for each in (EQUAL_PEAK, EQUAL_FRAME))  # fmt: skip
        return [row for pair in pairs for row in pair]

    return beside(build, *rest)


def bars(fine: Build) -> Build:
    """Coarse bars that every family tells apart, the fewest patterns first, and fine ones."""
    coarse = [row for name in ("uniform", "dots:7") for row in rows(0.9, "contrast", patterns=name, pairs_a_mm=0.13)]
    return lambda value: sorted([*coarse, *fine(value)], key=lambda row: row["patterns"] != "uniform")


def binned(**gains: tuple[str, int, str, int]) -> Build:
    ((better, fine, other, coarse),) = gains.values()
    cases = [(name, count) for name in ("uniform", "dots:7") for count in (1, 8)]
    rest = [rows(20, patterns=name, binning=count) for name, count in cases
            if (name, count) not in ((better, fine), (other, coarse))]  # fmt: skip
    return beside(gain("psnr_db", {"patterns": better, "binning": fine}, {"patterns": other, "binning": coarse}), *rest)


def shared(better: str, other: str) -> Build:
    third = [rows(20, patterns=name) for name in ("1 uniform", "49 uniform", "49 dots") if name not in (better, other)]
    law = rows(1.0, "ser_over_law", patterns="49 dots", model=IDEALISED)
    return beside(gain("psnr_db", {"patterns": better}, {"patterns": other}), *third, law)


def law(value: float) -> list[Row]:
    """A ratio of measured error and law; its scatter is a tenth of the others', as its borders are nearer."""
    ratios = rows(0.0, "ser_over_law", jitter=True, model=IDEALISED)
    found = [{**row, "ser_over_law": value + 0.1 * row["ser_over_law"]} for row in ratios]
    return [*found, *(row for name in ("1 uniform", "49 uniform", "49 dots") for row in rows(20, patterns=name))]


def at_depths(value: float, auto: float = 0.0, mapped: float = 9.0) -> list[Row]:
    """Images lose ``value`` dB 5 mm off 400, in the idealised model and rendered; that of a found depth gains ``auto``
    dB, a map of depths ``mapped``."""
    found: list[Row] = []
    for model, named in ((IDEALISED, {"baseline": 0.0}), (RENDERED, {"focus": "none"})):
        case = {"model": model, "patterns": "dots:7", **named}
        found += rows(40, depth=400.0, absolute=False, jitter=True, **case)
        found += [row for depth in (395.0, 405.0) for row in rows(40 - value, depth=depth, absolute=False, **case)]
    for depth in (395.0, 405.0):
        case = {"model": RENDERED, "patterns": "dots:7", "depth": depth}
        found += rows(30, focus="own calibration", absolute=False, **case)
        found += rows(30 + auto, focus="auto", absolute=False, jitter=True, **case)
    case = {"model": RENDERED, "patterns": "dots:7x14", "scene": "cards"}
    found += rows(20, focus="none", absolute=False, **case)
    return [*found, *rows(20 + mapped, focus="map", absolute=False, jitter=True, **case)]


def lamps(hadamard_db: float, dots_range: float = 0.5) -> list[Row]:
    """Under a lamp as bright as the projector, under one a hundredth of it, and under a strong one."""
    found: list[Row] = []
    for lamp, ratio in ((WEAK, 0.01), (AS_BRIGHT, 1.0), (STRONG, 100.0)):
        case = {"lamp": lamp, "ratio": ratio, "model": RENDERED, "range_low": 0.0}
        for name, gained, top in (("dots:8", 0.0, dots_range), ("hadamard:8", hadamard_db, 0.5), ("uniform", 0.0, 0.5)):
            shown = rows(20 + gained, patterns=name, absolute=False, jitter=name == "hadamard:8", **case)
            found += [
                {**row, "range_high": top + more * (name == "dots:8")} for row, more in zip(shown, JITTER, strict=True)
            ]
    return found


def drifted(value: float) -> list[Row]:
    case = {"kind": "power", "what": "power, 10 %", "amount": 0.1, "model": RENDERED, "predicted_error_db": 0.0}
    predicted = {name: offset for name, offset in zip("abc", PRINTS_DB, strict=True)}
    found = rows(value, "lost_db", jitter=True, absolute=False, **case)
    return [{**row, "predicted_lost_db": predicted[str(row["picture"])]} for row in found]


def fallen(lost: float = 5.0, gained: float = 5.0) -> list[Row]:
    """From the idealised image to a rendered one of calibrated factors, beside one of assumed ones."""
    shown = rows(40 - lost, "calibrated_db", jitter=True, absolute=False, way="in order", effect=EFFECTS[-1], model="")
    return [
        {**row, "ideal_db": 40 + offset, "with_db": 40 - lost - gained + offset}
        for row, offset in zip(shown, PRINTS_DB, strict=True)
    ]


def glossy(card: float = 40.0, disc: float = 10.0) -> list[Row]:
    return [
        row
        for name, decibels in (("gift_card", card), ("compact_disc", disc))
        for row in rows(decibels, "artefacts_db", jitter=True, model=RENDERED, subject=name)
    ]


def diffused(uniform: float = 22.0, dots: float = 41.0, times: float = 20.0) -> list[Row]:
    """By a convolutional camera whose iterations take so many ``times`` as long as both closed forms."""
    found: list[Row] = []
    for count, decibels in ((1, uniform), (49, dots)):
        for exposure in (EQUAL_PEAK, EQUAL_FRAME):
            found += rows(
                decibels, jitter=True, model="", psf="rendered", part="quality", patterns=count, exposure=exposure
            )
    for count, more in zip((4, 9, 49), JITTER, strict=True):
        seconds = {"iterative_s": times * math.exp(more), "direct_s": 1.0, "separable_s": 1.0}
        found.append({"psf": "rendered", "part": "speed", "sensor": "all light", "patterns": count, **seconds})
    return found


STATED = [("patterns", 0, 19.0, 25.0, "uniform"), ("patterns", 1, 32.0, 37.5, "dots:7")]
BORDERS = [
    # study, its claim, what decides it, from, to
    *(
        (study, claim, beside(level(patterns=name, exposure=EQUAL_PEAK), *(rows(20, patterns=other, exposure=EQUAL_PEAK)
         for other in ("uniform", "dots:2", "dots:7", "dots:8", "random:7", "hadamard:8") if other != name)), low, high)
        for study, claim, low, high, name in STATED
    ),
    ("patterns", 2, patterns("dots:7", "dots:2"), 0.0, math.inf),
    ("patterns", 3, patterns("dots:7", "random:7"), 0.0, math.inf),
    ("patterns", 4, patterns("hadamard:8", "dots:8"), 0.0, math.inf),
    ("distance", 2, beside(
        gain("psnr_db", {"mask_distance": "0.75", "patterns": "dots:5"},
             {"mask_distance": "2.0", "patterns": "uniform"}),
        rows(18, mask_distance="0.75", patterns="uniform"), rows(30, mask_distance="0.75", patterns="dots:7"),
    ), -1.0, 1.0),
    ("multishot", 3, frames("shifting dots", "SweepCam"), 0.5, math.inf),
    ("multishot", 4, frames("SweepCam", "uniform frames"), 0.5, math.inf),
    ("resolution", 0, bars(
        gain("contrast", {"patterns": "dots:7"}, {"patterns": "uniform"}, pairs_a_mm=0.52)
    ), 0.0, math.inf),
    ("resolution", 1, bars(beside(
        level("contrast", patterns="dots:7", pairs_a_mm=0.52),
        rows(0.0, "contrast", patterns="uniform", pairs_a_mm=0.52),
    )), 0.1, math.inf),
    ("binning", 0, binned(lost=("dots:7", 1, "dots:7", 8)), -math.inf, 3.0),
    ("binning", 1, binned(lost=("uniform", 1, "uniform", 8)), 0.0, math.inf),
    ("binning", 2, binned(gain=("dots:7", 8, "uniform", 1)), 0.0, math.inf),
    ("exposure", 0, shared("49 dots", "49 uniform"), 0.0, math.inf),
    ("exposure", 1, shared("49 uniform", "1 uniform"), 0.0, math.inf),
    ("exposure", 2, law, 0.9, 1.1),
    ("depth", 0, at_depths, -math.inf, 3.0),
    ("depth", 1, at_depths, -math.inf, 3.0),
    ("depth", 2, lambda value: at_depths(1.0, auto=value), -3.0, math.inf),
    ("depth", 3, lambda value: at_depths(1.0, mapped=value), 3.0, math.inf),
    ("ambient", 0, lambda value: lamps(1.0, 0.5 + value), -math.inf, 0.0),
    ("ambient", 1, lamps, 0.0, math.inf),
    ("ambient", 2, lamps, -math.inf, 0.0),
    ("drift", 0, drifted, -drift_study.AGREE_DB, drift_study.AGREE_DB),
    ("waterfall", 0, lambda value: fallen(lost=value), -math.inf, 2.0),
    ("waterfall", 1, lambda value: fallen(gained=value), 0.0, math.inf),
    ("reflectivity", 0, lambda value: glossy(card=value), 20.0, math.inf),
    ("reflectivity", 1, lambda value: glossy(disc=value), -math.inf, 20.0),
    ("convolutional", 0, lambda value: diffused(uniform=value), 17.0, 26.6),
    ("convolutional", 1, lambda value: diffused(dots=value), 36.5, 46.5),
    ("convolutional", 2, lambda value: diffused(times=5 * math.exp(value)), 0.0, math.inf),
    ("convolutional", 3, lambda value: diffused(times=10 * math.exp(value)), 0.0, math.inf),
]  # fmt: skip
"""What decides each claim of the paper but those of colour, and between which borders it holds."""


@pytest.mark.parametrize(
    ("study", "claim", "build", "low", "high"), BORDERS, ids=[f"{each[0]} {each[1]}" for each in BORDERS]
)
def test_claims_are_decided_on_both_sides_of_each_border(
    study: str, claim: int, build: Build, low: float, high: float
) -> None:
    """Prints differ by 14 dB, so that only paired differences decide; on a border nothing is. (Planted: any gain above
    0; the lower border of "comparable" left out; means of all images in place of pairs.)"""

    def verdict(value: float) -> str:
        return find_experiment(study).judge(Results(build(value)))[claim].verdict

    aside = ASIDE / 10 if (study, claim) == ("exposure", 2) else ASIDE  # of a ratio near 1
    for border, inwards in ((low, aside), (high, -aside)):
        if math.isfinite(border):
            assert verdict(border + inwards) == CONFIRMED
            assert verdict(border) == UNDECIDED
            assert verdict(border - inwards) == NOT_CONFIRMED


def test_every_study_of_the_paper_is_held() -> None:
    from mitsim.studies import PAPER

    assert {study for study, *_ in BORDERS} == set(PAPER) | {"drift"}


def test_an_interval_decides_where_no_border_lies_in_it() -> None:
    """Student's interval of three values is 4.30 errors either way, of nine 2.31. (Planted: 1.96 for any number.)"""
    assert within(Mean(1.0, 0.2, 3), low=0.13) is True and within(Mean(1.0, 0.2, 3), low=0.15) is None
    assert within(Mean(1.0, 0.2, 9), low=0.53) is True and within(Mean(1.0, 0.2, 9), low=0.55) is None
    assert within(Mean(1.0, 0.2, 3), high=0.13) is False and within(Mean(1.0, 0.2, 3), -9, 9) is True
    assert within(Mean(1.0, math.nan, 1), low=-99) is None, "a single value has no error"


def test_pairs_are_of_prints_or_of_seeds_of_one_print() -> None:
    """Seeds of one print are averaged first: they share its detail. (Planted: all images as if independent.)"""
    one = [{"picture": name, "seed": seed, "x": value} for name, seed, value in
           (("a", 0, 10.0), ("a", 1, 12.0), ("b", 0, 20.0), ("b", 1, 22.0))]  # fmt: skip
    other = [{**row, "x": float(row["x"]) - 1.0 - (row["picture"] == "b")} for row in one]
    assert mean_of(Results(one).frame, "x") == Mean(16.0, pytest.approx(5.0), 2)
    assert mean_of(Results(one).frame, "x", Results(other).frame) == Mean(1.5, pytest.approx(0.5), 2)
    assert mean_of(Results(one[:2]).frame, "x") == Mean(11.0, pytest.approx(1.0), 2)
    with pytest.raises(MitsimError, match="nothing was measured of x"):
        mean_of(Results(one[:2]).frame, "x", Results(other[2:]).frame)


def test_a_claim_of_parts_and_of_places() -> None:
    """(Planted: an undecided part passed over.)"""
    assert [every(True, True), every(True, None), every(None, False)] == [True, None, False]
    assert verdict_at({"peak": True, "frame": None}) == f"confirmed only at peak, {UNDECIDED} at frame"
    assert verdict_at({"peak": True, "frame": False}) == "confirmed only at peak"
    assert verdict_at({"peak": None, "frame": False}) == UNDECIDED
    assert verdict_at({"peak": False, "frame": False}) == NOT_CONFIRMED


def test_false_verdicts_are_rare() -> None:
    """Of 2000 draws of eight prints at a border, as many lie outside as the confidence says: 2.5 % on either side,
    0.35 % one standard deviation. (Planted: one standard error for the interval.)"""
    draws = np.random.default_rng(1).normal(0.0, 1.0, (2000, 8))
    holds = [within(Mean.of_numbers(list(draw), "x"), low=0.0) for draw in draws]
    assert sum(each is True for each in holds) / 2000 == pytest.approx(0.025, abs=4 * 0.0035)
    assert sum(each is False for each in holds) / 2000 == pytest.approx(0.025, abs=4 * 0.0035)

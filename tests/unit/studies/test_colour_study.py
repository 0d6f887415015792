"""The study of colours: points, verdicts on invented images, frames behind filters, and a whole small study."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.devices.framelist import load_chart
from mitsim.devices.patterns import parse_patterns
from mitsim.metrics import psnr
from mitsim.reconstruct.colour import ColourModel, JointMosaic, chart, delta_e
from mitsim.studies.colour_study import (
    D65,
    ONE,
    OWN,
    STUDY,
    daylight_frame,
    filter_weights,
    judge_colours,
    solve_mosaic,
)
from mitsim.studies.framework.campaign import batches
from mitsim.studies.framework.experiment import Point, Results, Scope, Setup
from mitsim.studies.framework.studio import Studio
from tests.ideal_sessions import picture, shadow
from tests.invented import sensor

N, LINES = 16, (638.0, 520.0, 445.0)


def images(scale: float = 1.0) -> np.ndarray:
    """(128, 128, 3) reflectances of the chart where scenes/colour_checker has it, times a scale."""
    seen = np.zeros((128, 128, 3))
    for values, (top, bottom, left, right) in zip(chart().at(LINES), load_chart("colour_checker").patches, strict=True):
        seen[top:bottom, left:right] = scale * values
    return seen


def results(**scales: float) -> Results:
    """Images of the chart that are so many times too bright, by the way they were seen; two seeds differ by 0.2 %."""
    rows: list[Any] = []
    arrays: dict[Any, Any] = {}
    named = {"own": (OWN, None), "one": (ONE, None), "dim": (D65, 60.0), "bright": (D65, 600.0)}
    for key, scale in scales.items():
        way, lux = named.get(key, (f"mosaic, {key}", None))
        families = ("uniform", "dots:7", "hadamard:8") if key == "own" else ("dots:7",)
        for family, seed in product(families, (0, 1)):
            point = Point.of(Setup("colour_checker"), way=way, patterns=family, lux=lux, seed=seed)
            found = judge_colours(point, LINES, images(scale * (1 + 0.002 * seed)), images(), {})
            rows += [{**row, "point": point.key} for row in found.rows]
            arrays |= {(point.key, name): array for name, array in found.arrays.items()}
    return Results(rows, arrays)


def test_points_are_of_the_chart_and_share_its_light() -> None:
    points = STUDY.points(Scope(Setup(), ("chelsea", "page")))
    assert {point.setup.scene for point in points} == {"colour_checker"} and len(batches(points)) == 1
    few = STUDY.points(Scope(Setup("mine.xml"), (None,), quick=True))
    assert {point.setup.scene for point in few} == {"mine.xml"} and len(few) < len(points) / 5
    assert all((point["lux"] is None) == (point["way"] != D65) for point in points)


def test_an_exact_image_has_the_floors_colours() -> None:
    rows: list[Any] = [row for row in results(own=1.0).rows if row["seed"] == 0 and row["patterns"] == "dots:7"]
    floor = delta_e(ColourModel.of_lines(LINES).xyz(chart().at(LINES)), chart().xyz)
    for column in ("delta_e", "floor"):
        assert np.allclose([row[column] for row in rows], floor, atol=1e-9)
    assert rows[18]["patch"] == "white 9.5"


def test_verdicts_are_on_what_is_added_to_the_floor() -> None:
    """Images 2 % too bright are near it, 30 % are not. (Planted: the floor of another chart; ways changed for one
    another.)"""
    found = results(own=1.02, one=1.3, dim=1.02, bright=1.3, joint=1.01)
    good = STUDY.judge(found)
    assert [claim.verdict for claim in good[:3]] == ["confirmed", "confirmed", "not confirmed"]
    assert {claim.verdict for claim in good[3:]} == {"confirmed"}
    drawn = STUDY.draw(found)
    assert set(drawn) == {"ways.png", "images.png", "daylight.png"}
    assert [text.get_text() for text in drawn["ways.png"].axes[0].get_yticklabels()] == [OWN, ONE, "mosaic, joint"]
    assert good[2].claim.startswith("Beside D65 of 600 lx, 49 dots add (markov) at most 0.5")
    bad = STUDY.judge(results(own=1.3, one=1.01, dim=1.3, bright=1.01, joint=0.9))
    assert [claim.verdict for claim in bad[:3]] == ["not confirmed", "not confirmed", "confirmed"]
    assert {claim.verdict for claim in bad[3:]} == {"not confirmed"}


# -------- Frames behind filters, spectra as numbers, lent factors


def seen_by(*shifts: float) -> tuple[Any, ...]:
    """A camera without noise at three lines; each moves its shadow by a part of a pixel."""
    bench = SimpleNamespace(sensor=sensor(quantum_efficiency=0.5))
    return tuple(
        SimpleNamespace(
            wavelength_nm=wavelength,
            lit=SimpleNamespace(truth=picture(seed), bench=bench),
            factors=SimpleNamespace(left=shadow(shift, N), right=shadow(-shift, N)),
        )
        for seed, (wavelength, shift) in enumerate(zip(LINES, shifts, strict=True))
    )


def quality(*shifts: float) -> float:
    """PSNR for frames of three pictures under 3 x 3 dots, as the model has them."""
    lines, family = seen_by(*shifts), parse_patterns("dots:3", N)
    left, right = (np.stack([getattr(line.factors, side) for line in lines]) for side in ("left", "right"))
    model = JointMosaic(left, right, filter_weights(lines), family.left.astype(float), family.right.astype(float))
    truth = np.stack([line.lit.truth for line in lines])
    frames = [(model.frame(truth, shot.row, shot.column), shot.row, shot.column) for shot in family.shots]
    return psnr(solve_mosaic(lines, family, frames).image.reshape(3, -1), truth.reshape(3, -1))


def test_the_joint_solve_knows_a_camera_for_each_line() -> None:
    assert quality(0.0, 0.0, 0.0) > 60 and quality(-0.3, 0.0, 0.3) > 100


def test_pixels_see_a_line_as_their_filters_curves_say() -> None:
    """Red light through the array RGGB: most in the first pixel of four, by the published curve over the camera's."""
    weights = filter_weights(seen_by(0, 0, 0))
    assert weights.shape == (4, 3) and np.array_equal(weights[1], weights[2])
    assert weights[0].argmax() == 0 and weights[1].argmax() == 1 and weights[3].argmax() == 2
    assert weights[0, 0] == pytest.approx((0.2 * 0.405 + 0.8 * 0.352) / 0.5)  # 638 nm, between 630 and 640


def test_a_scene_without_spectra_is_refused() -> None:
    with Studio() as studio, pytest.raises(MitsimError, match="scene photograph: has no spectra"):
        daylight_frame(studio, Setup("photograph"))

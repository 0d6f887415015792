"""Daylight beside a projector: the least noise of patches by linear algebra, what keeps a goal, how a page says so."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mitsim.core.configuration import load_model, locate
from mitsim.devices.framelist import ChartPlace
from mitsim.devices.patterns import parse_patterns
from mitsim.devices.sensor import SensorModel
from mitsim.report.pages import Mean, Table
from mitsim.studies import colour_study
from mitsim.studies.colour_study import BY_LUX, LEAST, METHODS, kept_lx, ladder_claim
from mitsim.studies.framework.claims import UNDECIDED
from mitsim.studies.framework.experiment import Scope, Setup
from mitsim.studies.lit_lines import DaylitLine, expected_delta_e, most

N, PIXELS = 8, 15
BOXES = ((0, 2, 1, 4), (3, 8, 5, 7), *[(0, 1, 0, 1)] * 22)
PLACE = ChartPlace(spectra="ColorChecker N Ohta", patches=BOXES)


def line(patterns: str, rates: float = 1e4, lamp: float = 1e5) -> DaylitLine:
    """A small camera, its frames even, with an IMX249 of so many pixels."""
    rng, family = np.random.default_rng(0), parse_patterns(patterns, N, 0)
    sensor = load_model(locate("imx249", "calibration", ".toml"), SensorModel)
    bench = SimpleNamespace(sensor=sensor, devices=SimpleNamespace(sensor=sensor))
    factors = SimpleNamespace(
        sides=(rng.random((PIXELS, N)), rng.random((PIXELS, N))), manifest=SimpleNamespace(centre=False)
    )
    of: Any = SimpleNamespace(lit=SimpleNamespace(bench=bench), factors=factors)
    daylit = DaylitLine(of, family, np.full((PIXELS, PIXELS), lamp))
    daylit.__dict__["levels"] = np.full((PIXELS, PIXELS), rates), rates
    return daylit


@pytest.mark.parametrize("patterns", ["uniform", "dots:3", "hadamard:4"])
def test_the_least_variance_is_that_of_least_squares(patterns: str) -> None:
    """By the pseudo-inverse of the whole matrix: of frames' own noise and, for patterns of one sign, of a frame that is
    taken off all. (Planted: one shot for it; pixels not squared; pairs counted once.)"""
    daylit = line(patterns)
    P_L, P_R = daylit.family.left.astype(float), daylit.family.right.astype(float)
    left, right = daylit.line.factors.sides
    whole = np.concatenate([np.kron(left * p, right * q) for p in P_L.T for q in P_R.T])
    inverse = np.linalg.pinv(whole)
    sensor, seconds = daylit.line.lit.bench.sensor, daylit.seconds(1.0)
    assert seconds * (1.1e5 + sensor.superpixel_dark_current_e_per_s) == pytest.approx(
        0.8 * sensor.superpixel_full_well_e
    )
    floor = sensor.superpixel_dark_current_e_per_s * seconds + sensor.superpixel_reading_noise_e**2
    frames, off = ((light * seconds + floor) / seconds**2 for light in (1.1e5, 1.0e5))
    found = daylit.least_variance(1.0, PLACE)
    for number, (top, bottom, first, last) in enumerate(BOXES[:2]):
        patch = np.zeros((N, N))
        patch[top:bottom, first:last] = 1 / ((bottom - top) * (last - first))
        weights = (patch.ravel() @ inverse).reshape(-1, PIXELS**2)
        common = np.square(weights.sum(axis=0)).sum()
        exact = 2 * frames * np.square(weights).sum()
        if not daylit.family.signed:
            exact = frames * np.square(weights).sum() + off / len(P_L.T) / len(P_R.T) * common
        # Clipping at the full well and rounding are in the sensor's variance alone.
        assert found[number] == pytest.approx(exact, rel=0.01)
    assert daylit.shots == {"uniform": 1, "dots:3": 9, "hadamard:4": 0}[patterns]


def test_more_light_of_the_projector_is_as_good_as_less_daylight() -> None:
    """Ten times the power beside a daylight is one power beside a tenth of it, but for dark current and read noise,
    some electrons of thousands. (Planted: the exposure kept.)"""
    strong, weak = line("dots:3", rates=1e5), line("dots:3", rates=1e4)
    relative = strong.least_variance(1.0, PLACE) / 1e5**2, weak.least_variance(0.1, PLACE) / 1e4**2
    assert relative[0] == pytest.approx(relative[1], rel=0.01)


def test_expected_differences_are_means_over_the_errors() -> None:
    """Of a difference that is the square: error's variance on top, to 400 draws of 24 numbers (2.9 % each)."""
    means, variances = np.full((24, 3), 2.0), np.full((24, 3), 0.25)

    def judged(values: np.ndarray) -> np.ndarray:
        return np.asarray(np.square(values[..., 0]))

    assert expected_delta_e(means, 0 * variances, judged) == 4.0
    assert expected_delta_e(means, variances, judged) == pytest.approx(4.25, abs=4 * 2 * 2 * 0.5 / np.sqrt(9600))


def test_the_most_that_is_kept() -> None:
    assert most(lambda value: value <= 3.0, 0.01, 1000.0) == pytest.approx(3.0, rel=0.01)
    assert most(lambda value: True, 0.01, 1000.0) == 1000.0 and most(lambda value: False, 0.01, 1000.0) == 0.0


def test_illuminance_that_keeps_a_goal_lies_between_those_measured() -> None:
    """Between rungs straight over the logarithm of the illuminance, up to the first that is not kept."""
    by_lux = {lux: Mean(value, 0.1, 3) for lux, value in ((0.0, 1.0), (10.0, 2.0), (1000.0, 4.0))}
    assert kept_lx(by_lux, 3.0) == pytest.approx(100.0) and kept_lx(by_lux, 1.5) == pytest.approx(5.0)
    assert kept_lx(by_lux, 9.0) == 1000.0 and kept_lx(by_lux, 0.5) == 0.0


def rows_of(measured: float, kept: float | None) -> Table:
    """Both families at 0, 60 and 600 lx; what is measured rises from 4 by ``measured`` to 600 lx."""
    rows: list[dict[str, Any]] = []
    for patterns in ("dots:7", "hadamard:8"):
        for lux, share in ((0.0, 0.0), (60.0, 0.5), (600.0, 1.0)):
            own = {"way": BY_LUX, "patterns": patterns, "lux": lux, "goal_delta_e": 4.5}
            for method in METHODS[:2]:
                rows += [
                    {**own, "method": method, "draw": k, "mean_delta_e": 4 + share * measured + 0.01 * k}
                    for k in (-1, 1)
                ]
            reported = {"kept_lx": kept or 0.0, "repeats": 3.0 if kept else None, "power": lux / kept if kept else None}
            rows.append({**own, "method": LEAST, "mean_delta_e": 4 + share, **reported})
    return Table(tuple(rows))


def test_claims_say_up_to_which_illuminance_they_hold() -> None:
    """1 more at 600 lx: 0.5 at 60 lx is just kept. 2 more: 0.5 of 1 on the way to 60 lx."""
    claim = ladder_claim(rows_of(1.0, 30.0), "dots:7")
    assert claim.verdict == "confirmed only if D65 has at most 60 lx" and "up to 30 lx" in claim.rendered
    assert ladder_claim(rows_of(2.0, 30.0), "dots:7").verdict == "confirmed only if D65 has at most 30 lx"
    assert ladder_claim(rows_of(0.1, 900.0), "hadamard:8").verdict == "confirmed"
    dim = Table(tuple({**row, "goal_delta_e": 3.0} for row in rows_of(1.0, None).rows))
    assert ladder_claim(dim, "dots:7").verdict == "not confirmed"
    # 0.01 of two exposures are an interval of 0.13 either way.
    assert ladder_claim(rows_of(0.4, 900.0), "dots:7").verdict == UNDECIDED


def test_tables_have_every_illuminance_and_what_it_takes() -> None:
    ladder, needed = colour_study.ladder_tables(rows_of(2.0, 30.0))
    assert [row[0] for row in ladder.rows] == ["0", "60", "600"] and len(ladder.head) == 7
    assert ladder.rows[2][1:4] == ("6.00 \N{PLUS-MINUS SIGN} 0.01", "6.00 \N{PLUS-MINUS SIGN} 0.01", "5.00")
    assert "of 2 exposures" in ladder.title
    assert needed.rows[0] == ("49 dots", "30", "30", "3; 2", "3; 20")
    assert colour_study.ladder_tables(rows_of(2.0, None))[1].rows[1][3:] == ("never", "never")


def test_the_figure_has_all_methods_and_the_goal() -> None:
    figure = colour_study.ladder_figure(rows_of(1.0, 30.0))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [*METHODS, "floor + 0.5"]
    assert [axes.get_title() for axes in figure.axes] == ["49 dots", "64 Hadamard"]


def test_a_quick_look_has_few_points() -> None:
    setup = Setup("colour_checker")
    whole, quick = (colour_study.ladder_points(Scope(setup, (None,), quick=quick), setup) for quick in (False, True))
    assert [point["patterns"] for point in whole] == ["dots:7", "hadamard:8"] and len(quick) == 1
    assert quick[0]["ladder"] == "0 60" and quick[0]["draws"] < whole[0]["draws"]

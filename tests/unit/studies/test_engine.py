"""The engine of studies: axes, rows that claims choose, means, claims and figures, on invented rows; experiments of the
paper and sweeps."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mitsim as ms
from mitsim.core.errors import MitsimError
from mitsim.core.images import lightness
from mitsim.reconstruct.solver import Status, Verdict
from mitsim.report import MODELS
from mitsim.report.pages import Mean, Value
from mitsim.studies import EXPERIMENTS, PAPER
from mitsim.studies.framework import claims
from mitsim.studies.framework.campaign import batches
from mitsim.studies.framework.claims import (
    UNDECIDED,
    Gain,
    Judged,
    Level,
    choose_rows,
    distinct,
    mean_of,
    measured,
    with_intervals,
)
from mitsim.studies.framework.experiment import IMAGE, TRUTH, Axes, Claim, Results, Scope, Setup, find_experiment
from mitsim.studies.framework.panels import Images, Lines, flag_warnings, section_of, write_page
from mitsim.studies.framework.studio import flags_of
from mitsim.studies.light_studies import ERROR_SOURCES
from mitsim.verbs import StudyOptions, scope_of

Row = dict[str, Any]
ROWS: list[Row] = [
    {"patterns": name, "picture": picture, "seed": 0, "depth": depth, "psnr_db": level + offset + depth / 100}
    for name, level in (("uniform", 20.0), ("dots:7", 30.0))
    for depth in (390.0, 400.0)
    for picture, offset in (("a", -5.0), ("b", 0.0), ("c", 5.2))
]


def test_axes_are_all_combinations_of_scene_and_values() -> None:
    """Setups in a row, values of a quick study in place of all; combinations that are not kept are no points. (Planted:
    the quick study's prints of a whole one; values that are not kept.)"""
    axes = Axes(
        {"patterns": ("uniform", "dots:7"), "model": ("idealised", "rendered")},
        scene={"lamp": ("1", "2")},
        quick={"lamp": ("1",), "patterns": ("dots:7",)},
        quick_prints=1,
        default="lamp_bench",
        kept=lambda values: values["patterns"] == "dots:7" or values["model"] == "idealised",
    )
    whole, quick = (axes(Scope(Setup(), ("coins", "page"), quick=quick)) for quick in (False, True))
    assert len(whole) == 2 * 2 * 3 and {point.key for point in quick} < {point.key for point in whole}
    assert [(point["patterns"], point["model"]) for point in whole[:3]] == [
        ("uniform", "idealised"), ("dots:7", "idealised"), ("dots:7", "rendered")
    ]  # fmt: skip
    assert len(quick) == 2 and {point.setup.picture for point in quick} == {"coins"}
    assert {point.setup.scene for point in whole} == {"lamp_bench"}
    assert {point.setup.scene for point in axes(Scope(Setup("mine.xml"), (None,)))} == {"mine.xml"}
    assert {point["seed"] for point in replace(axes, repeats=True)(Scope(Setup(), ("page",), (4,)))} == {4, 5, 6}


def test_rows_are_chosen_by_values_sets_and_functions() -> None:
    """A column that is not there is None; a text is the patterns. (Planted: a missing column that fits any value.)"""
    table = Results([*ROWS, {"patterns": None, "depth": math.nan}]).frame
    assert len(choose_rows(table, "dots:7")) == 6
    assert len(choose_rows(table, {"patterns": ("uniform", "dots:7"), "depth": 390.0})) == 6
    assert len(choose_rows(table, {"depth": lambda depth: depth > 395})) == 6
    assert len(choose_rows(table, {"psnr_db": measured})) == 12 and len(choose_rows(table, {"patterns": None})) == 1
    assert len(choose_rows(table, {"focus": None})) == 13 and choose_rows(table, {"focus": "auto"}).empty
    assert len(choose_rows(table, {"depth": "390"})) == len(choose_rows(table, {"depth": ("390.0",)})) == 6
    assert distinct(table, "depth") == [390.0, 400.0] and distinct(table, "focus") == []


def test_errors_that_all_rows_share_are_added_in_quadrature() -> None:
    """(Planted: errors of rows in place of prints.)"""
    table = Results([{**row, "shared": 3.0} for row in [*ROWS, *ROWS]]).frame
    error = np.std([-5.0, 0.0, 5.2], ddof=1) / 3**0.5
    assert mean_of(choose_rows(table, "dots:7"), error_column="shared").error == pytest.approx(math.hypot(error, 3.0))


def test_claims_for_each_value_and_for_every_value() -> None:
    """(Planted: the first of the values taken for every one.)"""
    rows = [
        {**row, "psnr_db": row["psnr_db"] - 12 * (row["patterns"] == "dots:7" and row["depth"] == 400)} for row in ROWS
    ]
    results = Results(rows)
    each = Gain("At {depth} mm dots are better", "dots:7", "uniform", each="depth").judge(results)
    assert [(claim.claim, claim.verdict) for claim in each] == [
        ("At 390 mm dots are better", "confirmed"), ("At 400 mm dots are better", "not confirmed")
    ]  # fmt: skip
    (level,) = Level("Images are good", where="uniform", at_least=10.0).judge(results)
    assert level.verdict == "confirmed"


def test_a_claim_without_rows_is_an_error_or_left_out() -> None:
    """(Planted: left out in silence.)"""
    claim = Level("Nobody measured this", where={"focus": "auto"})
    with pytest.raises(MitsimError, match="nothing was measured of the claim 'Nobody measured this'"):
        claim.judge(Results(ROWS))
    assert replace(claim, optional=True).judge(Results(ROWS)) == []
    beside = Gain("Nobody measured the other", "dots:7", "dots:8", optional=True)
    assert beside.judge(Results(ROWS)) == []
    with pytest.raises(MitsimError, match="nothing was measured of psnr_db"):
        replace(beside, optional=False).judge(Results(ROWS))


def test_a_claim_states_its_own_models_and_both_means_apart() -> None:
    """(Planted: the paper's models for any other.)"""
    rows = [
        {**row, "psf": psf, "psnr_db": row["psnr_db"] + 60 * (psf == "traced")}
        for row in ROWS
        for psf in ("seen", "traced")
    ]
    models = ("psf", "seen", "traced")
    (claim,) = Level("Bright", where="uniform", at_least=45.0, models=models).judge(Results(rows))
    assert claim.verdict == "confirmed only traced"
    pairs = [
        {"picture": name, "lost_db": 1.0 + step, "told_db": 1.2 + step, "known": 0.4}
        for name, step in (("a", 0), ("b", 1))
    ]
    sides: dict[str, Any] = {"column": "lost_db", "other_column": "told_db", "other_error": "known"}
    apart = Gain("Told", {}, {}, at_least=-1.0, at_most=1.0, apart=True, **sides)
    (told,) = apart.judge(Results(pairs))
    assert told.verdict == "confirmed"
    assert told.idealised == "1.7 \N{PLUS-MINUS SIGN} 0.6 dB" and told.rendered == "1.5 \N{PLUS-MINUS SIGN} 0.5 dB"


PRINTS_DB = (0.0, 7.0, 14.0)
"""What prints differ by, which would hide any gain of images that are not paired: an interval of 17 dB either way."""
JITTER = (-0.1, 0.0, 0.1)
"""Of three prints: a standard error of 0.058, and a 95 % interval of 4.3 of them, 0.25, either way."""


@pytest.mark.parametrize("kind", ["level", "gain", "every"])
def test_claims_are_decided_on_both_sides_of_each_border(kind: str) -> None:
    """Prints differ by 14 dB, so that only paired differences decide; on a border nothing is. (Planted: any gain above
    0; the upper border left out; means of all images in place of pairs; the first of the values for every one.)"""
    levels = Level("", where="a", at_least=20.0, at_most=25.0)
    gains = Gain("", "b", "a", at_least=-1.0, at_most=3.0, every="depth" if kind == "every" else "")
    claim, low, high = (levels, 20.0, 25.0) if kind == "level" else (gains, -1.0, 3.0)

    def verdict(value: float) -> str:
        rows = [
            {"patterns": name, "picture": picture, "depth": depth,
             "psnr_db": (value if kind == "level" else offset) + jitter if name == "a" else offset + more}
            for picture, offset, jitter in zip("abc", PRINTS_DB, JITTER, strict=True)
            for depth, more in ((1, value), (2, 1.0))
            for name in "ab"
        ]  # fmt: skip
        shown = rows if kind == "every" else [row for row in rows if row["depth"] == 1]
        return claim.judge(Results(shown))[0].verdict

    for border, inwards in ((low, 0.3), (high, -0.3)):
        assert verdict(border + inwards) == "confirmed" and verdict(border) == UNDECIDED
        assert verdict(border - inwards) == "not confirmed"


def test_an_interval_decides_where_no_border_lies_in_it() -> None:
    """Student's interval of three values is 4.30 errors either way, of nine 2.31. (Planted: 1.96 for any number; one
    standard error for the interval.)"""
    assert claims.within(Mean(1.0, 0.2, 3), low=0.13) is True and claims.within(Mean(1.0, 0.2, 3), low=0.15) is None
    assert claims.within(Mean(1.0, 0.2, 9), low=0.53) is True and claims.within(Mean(1.0, 0.2, 9), low=0.55) is None
    assert claims.within(Mean(1.0, 0.2, 3), high=0.13) is False and claims.within(Mean(1.0, 0.2, 3), -9, 9) is True
    assert claims.within(Mean(1.0, math.nan, 1), low=-99) is None, "a single value has no error"


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


def test_lines_have_a_figure_for_each_value_and_rows_that_begin_every_curve() -> None:
    """(Planted: shared rows as a curve of their own.)"""
    rows = [
        {"kind": kind, "count": count, "exposure": exposure, "psnr_db": 20.0 + count, "ssim": 0.5}
        for kind, count in (("uniform", 1), ("dots", 4), ("dots", 9), ("random", 9))
        for exposure in ("equal peak", "equal frame")
    ]
    shared = {"kind": "uniform"}
    panel = Lines("count", "frames [1]", each="exposure", colour="kind", facet="", shared=shared, title="PSNR")
    drawn = panel.draw(Results(rows))
    assert set(drawn) == {"psnr_equal_peak.png", "psnr_equal_frame.png"}
    figure = drawn["psnr_equal_peak.png"]
    curves = {container.get_label(): container.lines[0].get_xdata().tolist() for container in figure.axes[0].containers}
    assert curves == {"dots": [1, 4, 9], "random": [1, 9]} and figure.get_suptitle() == "PSNR, exposure equal peak"
    both = Lines("count", "frames [1]", colour={"psnr_db": "image", "ssim": "likeness"}, facet="").draw(Results(rows))
    assert {text.get_text() for text in both["psnr.png"].legends[0].get_texts()} == {"image", "likeness"}
    assert Lines("count", "frames [1]", where={"kind": "none"}).draw(Results(rows)) == {}


def test_images_of_several_arrays_stand_side_by_side() -> None:
    """Of the first row of each group that kept them; a caption without its number is empty. (Planted: the number of
    another row.)"""
    rows = [
        {"point": name, "subject": name, "way": "x", "psnr_db": 20.0, "lost_db": lost}
        for name, lost in (("p", 1.0), ("q", None))
    ]
    arrays = {(name, array): np.full((2, 2), 0.5) for name in "pq" for array in ("truth", "x image", "error")}
    shown = {"{way} image": ("image", "{psnr_db:.1f} dB"), "error": ("error", "{lost_db:.1f} dB")}
    panel = Images(shown, before={TRUTH: "truth"}, down=("subject",))
    (figure,) = panel.draw(Results(rows, arrays)).values()
    assert [axes.get_title() for axes in figure.axes[:3]] == ["truth", "image", "error"]
    assert [axes.get_xlabel() for axes in figure.axes] == ["", "20.0 dB", "1.0 dB", "", "20.0 dB", ""]
    kept = {("p", IMAGE): np.zeros((2, 2))}
    assert Images("subject", columns=("p", "q"), down=("way",)).draw(Results(rows, kept)) == {}, "q has no image"


def test_flags_are_of_all_statuses_once() -> None:
    """(Planted: reasons repeated.)"""

    good = next(verdict for verdict in Verdict if verdict.good)
    status = Status(good, "solved", flags=("The frames are dim. Expose longer.",))
    assert flags_of(status, status, others=("light is lost",)) == {
        "flagged": True, "reason": "The frames are dim; light is lost"
    }  # fmt: skip
    assert flags_of(Status(good, "solved")) == {"flagged": False, "reason": ""}


# -------- Experiments of the paper, and sweeps

TIMES = "\N{MULTIPLICATION SIGN}"
WHOLE = Scope(Setup(), ("coins", "page"))


@pytest.mark.parametrize("name", PAPER)
def test_points_differ_and_share_light(name: str) -> None:
    experiment = find_experiment(name)
    points = experiment.points(WHOLE)
    assert len({point.key for point in points}) == len(points)
    groups = batches(points)
    assert len(groups) == len({point.setup for point in points}), "points of one setup follow each other"
    few = experiment.points(Scope(Setup(), ("coins", "page"), quick=True))
    assert {point.key for point in few} <= {point.key for point in points}, "a quick study is a start of the whole"
    assert experiment.name == name and experiment.question.endswith("?") and name in EXPERIMENTS


def judged(claim: Level, **means: float) -> Claim:
    """The ``claim``, judged by two prints a tenth of a decibel apart of each ``model__exposure``."""
    rows: list[dict[str, Value]] = [
        {"model": name.split("__")[0], "exposure": name.split("__")[1], "psnr_db": mean + side, "picture": f"{side}"}
        for name, mean in means.items()
        for side in (-0.05, 0.05)
    ]
    (found,) = claim.judge(Results(rows))
    return found


def test_a_claim_holds_where_both_models_are_near_the_papers_figure() -> None:
    """Two decibels beside a band count as it. (Planted: the rendered model alone.)"""
    band = claims.stated("49 dots give 34 to 35.5 dB", 34, 35.5)
    claim = judged(band, idealised__peak=36.8, rendered__peak=40.0, idealised__frame=32.7, rendered__frame=36.8)
    assert claim.verdict == "confirmed only at frame" and claim.paper == "34 to 35.5 dB"
    assert claim.idealised == "peak: 36.80 ± 0.05 dB; frame: 32.70 ± 0.05 dB"
    assert judged(band, idealised__peak=36.8, rendered__peak=33.0).verdict == "confirmed"
    assert judged(band, idealised__peak=31.2, rendered__peak=38.2).verdict == "not confirmed"


@pytest.mark.parametrize(
    ("peak", "frame", "verdict"),
    [
        ("--", "--", "not confirmed"),
        ("+-", "-+", "not confirmed"),
        ("++", "--", "confirmed only at peak"),
        ("++", "+?", f"confirmed only at peak, {UNDECIDED} at frame"),
        ("-+", "-+", "confirmed only rendered"),
        ("?+", "?+", f"confirmed only rendered, idealised {UNDECIDED}"),
        ("+?", "-+", UNDECIDED),
        ("??", "--", UNDECIDED),
        ("?-", "-?", "not confirmed"),
        ("++", "++", "confirmed"),
    ],
)
def test_verdicts(peak: str, frame: str, verdict: str) -> None:
    """What holds, does not, or is not decided of both models at two exposures. (Planted: exposures of which one model
    holds; what is not decided taken for what fails.)"""
    holds = {"+": True, "-": False, "?": None}
    signs = {(model, name): holds[sign] for name, two in (("peak", peak), ("frame", frame))
             for model, sign in zip(MODELS, two, strict=True)}  # fmt: skip
    claim = Judged("", lambda rows: ("", signs[rows["model"].iloc[0], rows["exposure"].iloc[0]]))
    assert judged(claim, **{f"{model}__{name}": 0.0 for model, name in signs}).verdict == verdict


def test_a_page_says_how_many_images_are_flagged_and_what_for() -> None:
    """An image of many rows, such as a transfer function's, counts once. (Planted: nothing said; rows counted.)"""
    same = {"exposure": "equal peak", "psnr_db": 20.0}
    rows = [
        {"point": "a", "flagged": True, "reason": "misfit, likely cause: depth; The capture was flagged: dim", **same},
        *[{"point": "b", "flagged": True, "reason": "misfit, likely cause: depth", **same}] * 5,
        *({"point": "c", "method": method, "flagged": False, "reason": "", **same} for method in "ab"),
        {"point": "d", "square": 1.0},
    ]
    (text,) = flag_warnings("toy", Results(rows))
    assert text.startswith("2 of 4 images are flagged") and text.endswith("(column flagged of toy.csv)")
    counts = f": 2 {TIMES} misfit, likely cause: depth; 1 {TIMES} The capture was flagged: dim; the means include them"
    assert counts in text
    assert not flag_warnings("toy", Results(rows[-2:]))


def test_the_page_of_a_sweep_says_what_was_swept_and_its_command(tmp_path: Path) -> None:
    """Knobs without numbers have no figure, and a table all the same. (Planted: no command; the lead of
    the paper's claims.)"""
    knob, measures = ("mask", ("separable", "flatcam")), ("psnr", "misfit")
    scope = Scope(Setup(), (None,), (3,), sweep=(knob,), measures=measures, patterns="dots:4")
    experiment = find_experiment("sweep")
    values = zip(experiment.points(scope), (31.24, 20.0), (0.0, 0.05), (False, True), strict=True)
    rows = [
        {"point": point.key, **point.row(psnr_db=psnr, misfit=misfit, flagged=off, reason="misfit" if off else "")}
        for point, psnr, misfit, off in values
    ]
    results = Results(rows, scope=scope)
    assert not experiment.draw(results)
    section = section_of(experiment, (), {}, results, "mitsim study sweep --over 'mask=separable,flatcam'")
    page = write_page([section], tmp_path / "sweep.html", section.title).read_text()
    assert "<code>mitsim study sweep --over &#39;mask=separable,flatcam&#39;</code>" in page
    assert "Sweep of mask" in page and "Zheng" not in page
    assert "1 of 2 images are flagged" in page
    (table,) = section.parts
    assert table.head == ("", "psnr [dB]", "misfit [1]")
    assert [(name, psnr, float(misfit)) for name, psnr, misfit in table.rows] == [
        ("separable", "31.2", 0), ("flatcam", "20.0", 0.05)
    ]  # fmt: skip


def test_figures_of_gloss_have_each_image_under_its_title() -> None:
    """(Seen failing: the truths twice in a row, more images than titles.)"""
    names = ["matt paint", "apparent", "49 dots", *ERROR_SOURCES]
    levels_db = {"psnr_db": 20.0, **{f"{cause}_db": 30.0 for cause in ERROR_SOURCES}}
    rows = [{"point": name, "part": "gloss", "subject": name, **levels_db} for name in ("gift_card", "compact_disc")]
    levels = dict(zip(names, np.linspace(0, 0.4, len(names)), strict=True))
    arrays = {(str(row["point"]), name): np.full((2, 2), level) for row in rows for name, level in levels.items()}
    cells = find_experiment("reflectivity").draw(Results(rows, arrays))["images.png"].axes
    assert [axes.get_title().replace("-\n", "").replace("-", "") for axes in cells[: len(names)]] == names
    shown = [float(axes.images[0].get_array()[0, 0]) for axes in cells]
    assert shown == [lightness(np.array(levels[name])) for name in names] * 2


def test_what_a_sweep_varies_and_measures() -> None:
    swept = ["roughness=0.1:0.5:5", "mask=separable,flatcam", "patterns=dots:4,dots:7"]
    assert StudyOptions(over=swept).varied == (
        ("roughness", ("0.1", "0.2", "0.3", "0.4", "0.5")),
        ("mask", ("separable", "flatcam")),
        ("patterns", ("dots:4", "dots:7")),
    )
    assert scope_of("sweep", WHOLE, "dots:7", (("mask", ("a", "b")),), "psnr,misfit").measures == ("psnr", "misfit")
    with pytest.raises(MitsimError, match="--measure 'speed': use psnr, ssim"):
        scope_of("sweep", WHOLE, "dots:7", (("mask", ("a", "b")),), "psnr,speed")


def test_method_and_lambda_of_a_sweep_are_axes_like_others() -> None:
    """From the command line and from Python; lambda is asked for in a column of its own, because each row states the
    lambda that was used. (Planted: a list that is one method.)"""
    swept = StudyOptions(over=["mask=open"], method="tikhonov,tv", lam="auto,1e6").varied
    assert swept == (("mask", ("open",)), ("method", ("tikhonov", "tv")), ("asked_lambda", ("auto", "1e6")))
    over = {"mask": ["open"], "method": ["tikhonov", "tv"], "lambda": ["auto", "1e6"]}
    assert swept == StudyOptions(over=over).varied
    assert StudyOptions(over={"a": 1}, lam=[1, 2.5]).varied[1] == ("asked_lambda", ("1.0", "2.5"))
    points = find_experiment("sweep").points(Scope(Setup(), (None,), (4, 5), sweep=swept))
    assert [(point["method"], point["asked_lambda"], point["seed"]) for point in points[:5]] == [
        ("tikhonov", "auto", 4), ("tikhonov", "1e6", 4), ("tv", "auto", 4), ("tv", "1e6", 4), ("tikhonov", "auto", 5)
    ]  # fmt: skip
    for options, line in (
        ({"method": "tikhonov,x"}, "--over method=x: use tikhonov"),
        ({"method": "net.pt"}, "--over method=net.pt: use tikhonov"),
        ({"lam": "-1"}, "lam -1.0: give a finite number of at least 0"),
        ({"lam": "much"}, "--over lambda=much: give numbers"),
        ({"over": ["method=tv"], "method": "tv"}, "something is varied twice"),
        ({"over": ["seed=1,2"], "seeds": 2}, "--seeds: seeds are varied by --over seed already"),
        ({"seeds": 0}, "seeds 0: give a number from 1 to 1000"),
        ({"seeds": 1000, "over": ["roughness=0.1:0.5:50"]}, "50000 points; give at most"),
    ):
        with pytest.raises(MitsimError, match=line):
            ms.study("sweep", "photograph", **{"over": ["roughness=0.1,0.2"], **options})
    with pytest.raises(MitsimError, match="seeds has no effect on the study patterns, but on sweep"):
        ms.study("patterns", seeds=3)


def test_the_means_of_a_sweep_have_student_intervals() -> None:
    """Of 30, 31 and 33 dB by hand: mean 94/3, standard error sqrt(7/9), and t(2) = 4.30265 for 95 %. The curve's bar
    and the table's columns are equal, and the mean of another setting is not mixed in. (Planted: the normal
    distribution's 1.96; the mean of all rows.)"""
    scope = Scope(Setup(), (None,), (0, 1, 2), sweep=(("sheet_z", ("390", "400")),), measures=("psnr",))
    experiment, psnr = find_experiment("sweep"), {"390": (20.0, 20.0, 20.0), "400": (30.0, 31.0, 33.0)}
    rows = [
        {"point": each.key, **each.row(psnr_db=psnr[dict(each.setup.parameters)["sheet_z"]][each["seed"]])}
        for each in experiment.points(scope)
    ]
    results = with_intervals(Results(rows, scope=scope))
    found = {(row["sheet_z"], row["psnr_db_mean"], row["psnr_db_ci95"]) for row in results.rows}
    half = 4.302653 * math.sqrt(7 / 9)
    assert len(results.rows) == 6 and sorted(found) == [
        ("390", 20, 0), ("400", pytest.approx(94 / 3), pytest.approx(half, rel=1e-6))
    ]  # fmt: skip
    drawn = experiment.draw(results)["psnr.png"]
    _, _, (bars,) = drawn.axes[0].containers[0].lines
    assert np.ptp(bars.get_segments()[1][:, 1]) == pytest.approx(2 * half, rel=1e-6)
    assert drawn.get_suptitle() == "Mean and 95 % interval of 3 seeds"
    assert drawn.axes[0].get_xlabel() == "sheet_z [mm, where the printed sheet stands]"
    alone = Results(rows[:2], scope=replace(scope, seeds=(0,)))
    assert with_intervals(alone) is alone


@pytest.mark.parametrize("text", ["", "roughness", "roughness=", "=1:2:3", "z=1:2:x", "z=1:2:1", "z=1:2:99999"])
def test_a_sweep_that_cannot_be_read_is_one_line(text: str) -> None:
    with pytest.raises(MitsimError, match=f"--over {re.escape(repr(text))}: "):
        StudyOptions(over=[text]).varied  # noqa: B018

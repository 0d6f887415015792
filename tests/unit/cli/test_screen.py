"""What a run shows on stderr while it works."""

from __future__ import annotations

import io
import itertools
import re
from typing import Any, cast

import pytest
from rich.console import Console

from mitsim.cli import commands as screen
from mitsim.cli.bench_verbs import plan_lines
from mitsim.core import job as progress
from mitsim.core.errors import MitsimError
from mitsim.core.job import Clock, Cost, Job
from mitsim.light.plan import Plan, PlanRow, State


@pytest.fixture
def every_half_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that is half a minute further at each look."""
    ticks = itertools.count(step=progress.SECONDS_A_LINE / 2)
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(ticks))


def test_a_log_gets_a_line_a_minute(capsys: pytest.CaptureFixture[str], every_half_minute: None) -> None:
    """A job of a cluster has no terminal: what is done and what is left stands in its log, but not at every step."""
    with progress.progress() as job:
        for point in range(1, 7):
            job.progress(f"patterns: {point} of 6 points", point / 6)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == [
        "mitsim: patterns: 2 of 6 points (33%)",
        "mitsim: patterns: 4 of 6 points (67%)",
        "mitsim: patterns: 6 of 6 points (100%)",
    ]


def test_hidden_progress_leaves_no_line(capsys: pytest.CaptureFixture[str], every_half_minute: None) -> None:
    """``--quiet``."""
    with progress.progress(hidden=True) as job:
        for point in range(6):
            job.progress("transport", point / 6)
    assert capsys.readouterr().err == ""


# ---- rows of a terminal ----------------------------------------------------------------------------------------------


class Terminal:
    """Rows of a program that began 2 s ago, on a clock that is moved by hand; ``now`` in seconds."""

    def __init__(self, patch: pytest.MonkeyPatch, height: int = 24) -> None:
        self.now, self.height = 100.0, height
        for name in ("monotonic", "perf_counter"):
            patch.setattr(progress.time, name, lambda: self.now)
        self.rows = progress._Rows(2.0)
        self.clock = Clock(0.0, self.rows)

    @property
    def shown(self) -> dict[str, str]:
        """What stands behind each row's bar, by its words."""
        console = Console(file=io.StringIO(), width=80, height=self.height, force_terminal=True, no_color=True)
        with console.capture() as seen:
            console.print(self.rows)
        assert max(map(len, seen.get().splitlines()), default=0) <= 80
        lines = [re.split(r"\s{2,}", re.sub(r"[━╸╺]+| (?=  )", " ", line).strip()) for line in seen.get().splitlines()]
        return {words: ", ".join(rest) for words, *rest in lines}


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    return Terminal(monkeypatch)


def test_each_stage_has_a_row_that_moves_and_ends(terminal: Terminal) -> None:
    """As the plan predicts, until light tells its own rate. (Planted: the plan's seconds whatever the rate says.)"""
    rows = terminal.rows
    rows.begin("plan")
    terminal.now += 3
    assert terminal.shown == {"plan": "3.0 s", "total": "5.0 s"}
    rows.end("plan", 3.0)
    rows.predict({"transport": 10.0, "optics": 2.0, "write": 0.01})
    waiting = {"optics": "2.0 s left"}
    assert terminal.shown == {"plan": "3.0 s", "transport": "10.0 s left", **waiting, "total": "5.0 s, 12.0 s left"}
    rows.begin("transport")
    terminal.now += 4
    light = {"transport": "4.0 s, 6.0 s left", **waiting}
    assert terminal.shown == {"plan": "3.0 s", **light, "total": "9.0 s, 8.0 s left"}
    rows.report("transport", 0.2)
    light = {"transport": "4.0 s, 16.0 s left", **waiting}
    assert terminal.shown == {"plan": "3.0 s", **light, "total": "9.0 s, 18.0 s left"}
    terminal.now += 16
    rows.end("transport", 20.0)
    assert terminal.shown == {"plan": "3.0 s", "transport": "20.0 s", **waiting, "total": "25.0 s, 2.0 s left"}


def test_longer_than_was_predicted_is_said_by_no_number(terminal: Terminal) -> None:
    """Neither a frozen nor a negative one, of the stage and of all. (Planted: 0.0 s left; the sum of the others.)"""
    terminal.rows.predict({"transport": 10.0, "optics": 2.0})
    terminal.rows.begin("transport")
    before = 12.0
    for _ in range(40):
        terminal.now += 0.5
        (*_, left) = terminal.shown["total"].split(", ")
        seconds = float(left.removesuffix(" s left")) if "left" in left else 0.0
        assert seconds == pytest.approx(before - 0.5) if terminal.now < 110 else seconds == 0.0
        before = seconds
    assert terminal.shown["transport"] == "20.0 s" and terminal.shown["total"] == "22.0 s"


def test_a_loop_over_stages_says_how_long_they_go_on(terminal: Terminal) -> None:
    """Frames are formed, exposed and written in turns; what a stage took before does not count. (Planted: it does.)"""
    rows, clock = terminal.rows, terminal.clock
    with clock.stage("optics"):
        terminal.now += 5
    rows.report("frames", 0.0)
    for done in range(1, 5):
        for stage in ("optics", "sensor"):
            with clock.stage(stage):
                terminal.now += 1
            if done == 2:
                rest = {"frames": "3.0 s, 5.0 s left" if stage == "optics" else "4.0 s, 4.0 s left"}
                assert rest.items() <= terminal.shown.items()
        rows.report("frames", done / 4)
        if done == 2:
            each = {"optics": "7.0 s", "sensor": "2.0 s", "frames": "4.0 s, 4.0 s left"}
            assert terminal.shown == {**each, "total": "11.0 s, 4.0 s left"}
    over = {"optics": "9.0 s", "sensor": "4.0 s", "frames": "8.0 s"}
    terminal.now += 1
    assert terminal.shown == {**over, "total": "16.0 s"}


def test_a_loop_that_goes_on_has_the_rate_of_what_it_did(terminal: Terminal) -> None:
    """Stripes of an interrupted session take no time. (Planted: they do.)"""
    terminal.rows.report("stripes", 0.75)
    terminal.now += 1
    terminal.rows.report("stripes", 0.8)
    assert terminal.shown["stripes"] == "1.0 s, 4.0 s left"


def test_work_within_work_has_rows_of_its_own(terminal: Terminal) -> None:
    """Of its own seconds, and of the same watch. (Planted: reports without the prefix.)"""
    job = Job(terminal.clock, terminal.rows.report)
    with job.clock.stage("optics"):
        terminal.now += 1
    part = job.apart("calibration ")
    part.clock.predict({"optics": 4.0})
    with part.clock.stage("optics"):
        terminal.now += 1
        part.progress("optics", 0.5)
        assert terminal.shown["calibration optics"] == "1.0 s, 1.0 s left" and terminal.shown["optics"] == "1.0 s"
    assert terminal.shown == {"optics": "1.0 s", "calibration optics": "1.0 s", "total": "4.0 s"}


def test_a_report_with_numbers_in_it_keeps_its_row(terminal: Terminal) -> None:
    """A study of many points says how many are measured, in one row. (Planted: a row for each number.)"""
    terminal.rows.report("patterns: 0 of 4 points", 0.0)
    for point in range(1, 4):
        terminal.now += 60
        terminal.rows.report(f"patterns: {point} of 4 points, 3 min left", point / 4)
    assert terminal.shown == {"patterns: 3 of 4 points": "3:00, 1:00 left", "total": "3:02, 1:00 left"}


def test_rows_fit_a_small_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that are over go first, so that what works is seen. (Planted: all of them.)"""
    terminal = Terminal(monkeypatch, height=6)
    for number in range(12):
        with terminal.clock.stage(f"stage {number}"):
            terminal.now += 1
    terminal.rows.begin("last")
    terminal.rows.predict({f"next {number}": 1.0 for number in range(9)})
    assert [*terminal.shown] == ["last", "next 0", "next 1", "next 2", "total"]


HOSTILE = "a\x1b]0;title\x07\u202eb\x9bc [bold]d[/] \\x1b"
HARMLESS = "a ]0;title  b c [bold]d[/] \\x1b"


def test_no_control_character_of_a_file_reaches_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """Escape, bell, C1's CSI and a turn of direction; line ends of results stay. JSON escapes them by itself. (Planted:
    warnings as they are.)"""
    assert screen.print_result(False, {}, [f"{HOSTILE}\nnext"], [HOSTILE]) == 1
    out, err = capsys.readouterr()
    assert out == f"{HARMLESS}\nnext\n" and err == f"mitsim: warning: {HARMLESS}\n"
    screen.print_result(True, {"name": HOSTILE}, [], [])
    assert capsys.readouterr().out.isascii()
    with progress.progress() as job:
        job.progress(HOSTILE, 0.5)
    assert "\x1b" not in capsys.readouterr().err


ROWS = [
    ("anchors", "approximate", "falloff, gloss and parallax: 3x3 anchors leave 2.8e-06", 1.3e-3),
    ("layers", "approximate", "the light is seen from 364 to 450 mm; 3 layers leave 2.0e-05", 6.6e-3),
    ("cells", "approximate", "4x4 cells of even light a projector pixel leave 1.6e-04", 2.2e-3),
    (
        "followed-anchors", "approximate",
        "light over several surfaces, in mirrors and of lamps: 3x3 in cells of 4x4 pixels leave 1.9e-04",
        4.3e-4,
    ),
    (
        "occluded-anchors", "approximate",
        "101 projector pixels are hidden from part of the sensor: 8x8 anchors leave 2.3e-04", 6.7e-3,
    ),
    ("interreflection", "exact", "", 5.6e-2),
    ("mirrors", "off", "no surface reflects or transmits light in single directions", 0.0),
    ("diffraction", "exact", "a mask feature's Fresnel number is 3.2 at 562 nm, 3 lines", 7.9e-2),
    ("blur", "off", "the projector's pixels are sharp", 0.0),
    ("black-level", "exact", "", 6e-4),
    ("spectrum", "off", "one panchromatic reflectance; --colour lines tells them apart", None),
    ("sensor-noise", "exact", "Poisson, full well, read noise and quantisation of each frame", None),
]  # fmt: skip
"""Of cookie_bag, as `mitsim plan` has them."""


def plan_of(*more: tuple[str, str, str, float | None], **fields: Any) -> Plan:
    """A plan at 1e-3 of these rows, and ``more``."""
    rows = tuple(PlanRow(name, cast(State, state), reason, error, 0.5) for name, state, reason, error in (*ROWS, *more))
    seconds = {"transport": 3.76, "truth": 0.41, "optics": 1.2, "plan": 1.4, "start": 1.1}
    return Plan(
        1e-3, rows, 7.6, cast(Any, None), 5e-4, 4e-4, 5e-4, (), seconds, cost=Cost(7.6, 2.5 * 2**30, 1e8), **fields
    )


def test_a_plan_says_first_what_it_comes_to_and_fits_a_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    """24 lines of 80; no reason is cut. (Planted: no room kept for the end; what is off and leaves nothing shown.)"""
    monkeypatch.setenv("COLUMNS", "80")
    lines = plan_lines(plan_of())
    assert lines[0] == "Plan at accuracy 0.001: 7.6 s, error up to 7.1e-04"
    printed = [part for line in lines for part in screen.wrap_text(line)]
    assert len(printed) <= 24 and max(map(len, printed)) <= 80
    text = " ".join(" ".join(printed).split())
    assert not any(line.startswith(("mirrors", "blur")) for line in lines)
    assert [line.split()[0] for line in lines if " exact" in line] == ["interreflection", "black-level"]
    assert "diffraction 7.9e-02 0.50 a mask feature's Fresnel number is 3.2 at 562 nm, 3 lines interref" in text
    assert "3x3 in cells of 4x4 pixels leave 1.9e-04 left out" in text
    assert text.endswith("start 1.1 At most 2.5 GiB of memory, 95.4 MiB of disk")
    assert "left out error if off seconds why spectrum - 0.50 one panchromatic" in text
    assert "No room for sensor-noise, and for 2 that nothing calls for (--all)" in text


def test_what_is_left_out_is_named_within_two_decades_of_the_accuracy() -> None:
    """(Planted: one decade, and three.)"""
    text = "\n".join(plan_lines(plan_of(("glare", "off", "small", 1.1e-5), ("speckle", "off", "less", 0.9e-5))))
    assert "\nglare " in text and "speckle" not in text and "3 that nothing calls for" in text


def test_rows_beyond_a_screen_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The least ones. (Planted: all shown, 31 lines.)"""
    monkeypatch.setenv("COLUMNS", "80")
    more = [(f"effect-{k}", "exact", "for a reason of its own", 10.0**-k) for k in range(1, 9)]
    lines = plan_lines(plan_of(*more))
    assert sum(len(screen.wrap_text(line)) for line in lines) <= 24
    (unshown,) = (line for line in lines if line.startswith("No room for"))
    assert "effect-8" in unshown and "effect-1," not in unshown


def test_all_of_a_plan_has_every_row_with_its_whole_reason() -> None:
    lines = plan_lines(plan_of(), everything=True)
    assert all(f"    {reason}" in lines for _, _, reason, _ in ROWS)
    assert [line.split()[0] for line in lines[2::2]][: len(ROWS)] == [name for name, *_ in ROWS]


def test_names_in_a_plan_are_printable(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A surface that a scene calls "[/]" was an error of rich. (Planted: printed as it is.)"""
    made = plan_of(("gloss", "exact", f"of {HOSTILE}", 0.5), notes=("cells are chosen safely",))
    screen.print_result(False, {}, plan_lines(made), ())
    out = capsys.readouterr().out
    assert "\x1b]" not in out and "[/]" in out.replace("\n", "") and made.notes[0] in out


def test_lines_are_as_wide_as_the_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """80 characters where there is none; a path is not broken. (Planted: printed as they are.)"""
    monkeypatch.delenv("COLUMNS", raising=False)
    path = "/a-folder/" * 9
    screen.print_result(False, {}, ["word " * 40, f"Image: {path}", "", "a  " * 40], ())
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines[:3])) <= 80 and len(lines) == 7
    assert f"  {path}" in lines and lines[-2:] == ["", "a  " * 40]


def test_output_that_nobody_reads_ends_as_by_a_signal(monkeypatch: pytest.MonkeyPatch) -> None:
    """A closed pipe is SIGPIPE's status, a full disk one line. (Planted: either passed over.)"""

    class Full:
        def __init__(self, number: int) -> None:
            self.number = number

        def write(self, text: str) -> int:
            raise OSError(self.number, "No space left on device")

        flush = write

    monkeypatch.setattr(screen.sys, "stdout", Full(32))
    with pytest.raises(SystemExit) as ended, screen.write_at_end():
        print("result")
    assert ended.value.code == 141
    monkeypatch.setattr(screen.sys, "stdout", Full(28))
    with pytest.raises(MitsimError, match="standard output: cannot be written"), screen.write_at_end():
        print("result")


# ---- rows of a notebook ----------------------------------------------------------------------------------------------


def test_a_notebook_has_the_rows_below_its_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    """One output, written anew, which stays. (Planted: another output at each stage; nothing written at the end.)"""
    import IPython
    import IPython.display

    pages: list[list[str]] = []

    class Handle:
        """What ``display`` gives for an output."""

        def update(self, page: Any) -> None:
            """Take the place of it."""
            pages[-1].append(page.data)

    def display(page: Any, display_id: bool) -> Handle:
        assert display_id
        pages.append([page.data])
        return Handle()

    monkeypatch.setattr(IPython, "get_ipython", lambda: type("Shell", (), {"kernel": object()})())
    monkeypatch.setattr(IPython.display, "display", display)
    clock = [100.0]
    for name in ("monotonic", "perf_counter"):
        monkeypatch.setattr(progress.time, name, lambda: clock[0])
    with progress.progress() as job:
        with job.clock.stage("plan"):
            clock[0] += 1.0
        with job.clock.stage("transport"):
            clock[0] += 1.0
            job.progress("transport", 0.5)
            clock[0] += 0.1  # too soon to be written again
            job.progress("transport", 1.0)
    (shown,) = pages
    assert "plan" in shown[0] and "transport" not in shown[0] and "<pre" in shown[0]
    assert "left" in shown[-2] and "transport" in shown[-1] and "left" not in shown[-1] and "1.1 s" in shown[-1]

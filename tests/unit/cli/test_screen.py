"""What a run shows on stderr while it works."""

from __future__ import annotations

import io
import itertools
import re
import signal
from typing import Any, cast

import pytest
import typer
from rich.console import Console

from mitsim import cli
from mitsim.cli import commands as screen
from mitsim.cli.bench_verbs import plan_lines
from mitsim.core import job as progress
from mitsim.core import worker
from mitsim.core.errors import MitsimError
from mitsim.core.job import Cost
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


def test_each_stage_has_a_row_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """With its bar, its seconds, and what is left at its rate; a report with numbers in it keeps its row."""
    shown = io.StringIO()
    console = Console(file=shown, width=80, force_terminal=True, no_color=True)
    monkeypatch.setattr("rich.console.Console", lambda **_: console)
    monkeypatch.setattr(progress, "has_rows", lambda: True)
    with progress.progress() as job:
        with job.clock.stage("plan"):
            pass
        part = job.apart("calibration ")
        with part.clock.stage("optics"):
            part.progress("optics", 0.5)
        for point in range(1, 5):
            job.progress(f"patterns: {point} of 4 points, 3 min left", point / 4)
        job.progress(HOSTILE, 0.5)
    rows = [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", line) for line in shown.getvalue().splitlines()]
    for words in ("plan ", "calibration optics ", "patterns: 4 of 4 points ", f"{HARMLESS} "):
        assert any(line.strip().startswith(words) and "━" in line for line in rows), words
    assert any("0.0 s" in line for line in rows) and not any("1 of 4" in line for line in rows[-8:])


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


def test_a_plan_says_first_what_it_comes_to(monkeypatch: pytest.MonkeyPatch) -> None:
    """No reason is cut. (Planted: what is off and leaves nothing shown.)"""
    monkeypatch.setenv("COLUMNS", "80")
    lines = plan_lines(plan_of())
    assert lines[0] == "Plan at accuracy 0.001: 7.6 s, error up to 7.1e-04"
    printed = [part for line in lines for part in screen.wrap_text(line)]
    assert max(map(len, printed)) <= 80
    text = " ".join(" ".join(printed).split())
    assert not any(line.startswith(("mirrors", "blur")) for line in lines)
    assert [line.split()[0] for line in lines if " exact" in line] == ["interreflection", "black-level"]
    assert "diffraction 7.9e-02 0.50 a mask feature's Fresnel number is 3.2 at 562 nm, 3 lines interref" in text
    assert "3x3 in cells of 4x4 pixels leave 1.9e-04" in text
    assert text.endswith("start 1.1 At most 2.5 GiB of memory, 95.4 MiB of disk")
    assert "left out error if off seconds why spectrum - 0.50 one panchromatic" in text
    assert "2 more effects that this scene does not need (--all lists them)" in text


def test_what_is_left_out_is_named_within_two_decades_of_the_accuracy() -> None:
    """(Planted: one decade, and three.)"""
    text = "\n".join(plan_lines(plan_of(("glare", "off", "small", 1.1e-5), ("speckle", "off", "less", 0.9e-5))))
    assert "\nglare " in text and "speckle" not in text and "3 more effects that this scene does not need" in text


def test_all_of_a_plan_has_every_row() -> None:
    text = " ".join(" ".join(plan_lines(plan_of(), everything=True)).split())
    assert all(f"{name} " in text and reason in text for name, _, reason, _ in ROWS) and "does not need" not in text


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
    with pytest.raises(SystemExit) as ended:
        screen.print_result(False, {}, ["result"], ())
    assert ended.value.code == 141
    monkeypatch.setattr(screen.sys, "stdout", Full(28))
    with pytest.raises(MitsimError, match="standard output: cannot be written"):
        screen.print_result(False, {}, ["result"], ())


# ---- How a command that cannot go on ends ----------------------------------------------------------------------------


def test_a_file_that_ends_too_early_is_no_interrupt(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Click takes any EOFError for Control-D. (Planted: "interrupted", 130.)"""

    def app(standalone_mode: bool) -> int:
        raise typer.Abort from EOFError("no data left")

    monkeypatch.setattr(cli, "app", app)
    with pytest.raises(SystemExit) as ended:
        cli.run()
    assert ended.value.code == 2 and "EOFError: no data left" in capsys.readouterr().err


@pytest.mark.parametrize(("by", "status", "reported"), [(None, 2, "no variant"), (signal.SIGINT, 130, "interrupted")])
def test_an_error_that_an_interrupt_became_is_an_interrupt(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], by: int | None, status: int, reported: str
) -> None:
    """Control-C while an extension initialises is an ImportError of that. (Planted: told as that error.)"""

    def app(standalone_mode: bool) -> int:
        raise MitsimError("no variant")

    monkeypatch.setattr(cli, "app", app)
    monkeypatch.setattr(worker, "_stopped_by", by)
    with pytest.raises(SystemExit) as ended:
        cli.run()
    assert ended.value.code == status and capsys.readouterr().err == f"mitsim: {reported}\n"

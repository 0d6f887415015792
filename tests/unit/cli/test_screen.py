"""What a run shows on stderr while it works."""

from __future__ import annotations

import itertools
from typing import Any, cast

import pytest

from mitsim.cli import screen
from mitsim.core.errors import MitsimError


@pytest.fixture
def every_half_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that is half a minute further at each look."""
    ticks = itertools.count(step=screen.SECONDS_A_LINE / 2)
    monkeypatch.setattr(screen.time, "monotonic", lambda: next(ticks))


def test_a_log_gets_a_line_a_minute(capsys: pytest.CaptureFixture[str], every_half_minute: None) -> None:
    """A job of a cluster has no terminal: what is done and what is left stands in its log, but not at every step."""
    with screen.showing_progress(hidden=False) as progress:
        for point in range(1, 7):
            progress(f"patterns: {point} of 6 points", point / 6)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == [
        "mitsim: patterns: 2 of 6 points (33%)",
        "mitsim: patterns: 4 of 6 points (67%)",
        "mitsim: patterns: 6 of 6 points (100%)",
    ]


def test_hidden_progress_leaves_no_line(capsys: pytest.CaptureFixture[str], every_half_minute: None) -> None:
    """``--quiet``."""
    with screen.showing_progress(hidden=True) as progress:
        for point in range(6):
            progress("transport", point / 6)
    assert capsys.readouterr().err == ""


HOSTILE = "a\x1b]0;title\x07\u202eb\x9bc [bold]d[/] \\x1b"
HARMLESS = "a ]0;title  b c [bold]d[/] \\x1b"


def test_no_control_character_of_a_file_reaches_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """Escape, bell, C1's CSI and a turn of direction; line ends of results stay. JSON escapes them by itself. (Planted:
    warnings as they are.)"""
    assert screen.finish(False, {}, [f"{HOSTILE}\nnext"], [HOSTILE]) == 1
    out, err = capsys.readouterr()
    assert out == f"{HARMLESS}\nnext\n" and err == f"mitsim: warning: {HARMLESS}\n"
    screen.finish(True, {"name": HOSTILE}, [], [])
    assert capsys.readouterr().out.isascii()
    with screen.showing_progress(hidden=False) as progress:
        progress(HOSTILE, 0.5)
    assert "\x1b" not in capsys.readouterr().err


def test_names_in_a_plan_are_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    """A surface that a scene calls "[/]" was an error of rich. (Planted: markup read.)"""

    class Row:
        name, state, reason, error_if_off, seconds = "gloss", "exact", f"of {HOSTILE}", 0.1, 1.0

    class Plan:
        accuracy, effects, predicted, predicted_seconds = 1e-3, (Row,), {"plan": 1.0}, 1.0
        range_words = "nine of ten such runs take 1 to 5 s."
        colour = asked_seconds = cost = None
        notes = ("cells are chosen safely",)

    screen.print_plan(cast(Any, Plan))
    out = capsys.readouterr().out
    assert "\x1b]" not in out and "[/]" in out.replace("\n", "") and Plan.range_words in out and Plan.notes[0] in out


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

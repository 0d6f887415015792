"""What a run shows on stderr while it works."""

from __future__ import annotations

import itertools

import pytest

from mitsim.cli import screen


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

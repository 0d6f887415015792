"""How a command that cannot go on ends."""

import signal

import pytest
import typer

from mitsim import cli
from mitsim.core import worker
from mitsim.core.errors import MitsimError


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

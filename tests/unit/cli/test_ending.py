"""How a command that cannot go on ends."""

import signal

import pytest

from mitsim import cli
from mitsim.core import worker
from mitsim.core.errors import MitsimError


@pytest.mark.parametrize(("by", "status", "said"), [(None, 2, "no variant"), (signal.SIGINT, 130, "interrupted")])
def test_an_error_that_an_interrupt_became_is_an_interrupt(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], by: int | None, status: int, said: str
) -> None:
    """Control-C while an extension initialises is an ImportError of that. (Planted: told as that error.)"""

    def app(standalone_mode: bool) -> int:
        raise MitsimError("no variant")

    monkeypatch.setattr(cli, "app", app)
    monkeypatch.setattr(worker, "_stopped_by", by)
    with pytest.raises(SystemExit) as ended:
        cli.run()
    assert ended.value.code == status and capsys.readouterr().err == f"mitsim: {said}\n"

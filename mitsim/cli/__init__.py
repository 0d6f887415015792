"""The command line: parse, call the Python face, print. No physics; heavy imports happen in the verb that needs them.

Options come from the models that the Python functions take, so that they are the same there.
"""

from __future__ import annotations

import errno
import signal
import sys
import warnings
from pathlib import Path
from typing import Annotated

import typer

import mitsim
from mitsim.cli import frame_verbs
from mitsim.cli.bench_verbs import (
    capture,
    demo,
    design,
    doctor,
    pairs,
    plan,
    predict,
    render,
    run_,
    study,
    transport,
    view,
)
from mitsim.cli.calibrate_verb import calibrate
from mitsim.cli.commands import Program, Verb, help_of, message_of
from mitsim.cli.shelf_verbs import list_, new
from mitsim.core.errors import MitsimError, printable
from mitsim.core.worker import INTERRUPTED, end_stopped, end_uncaught, is_stopped, say_note

app = typer.Typer(
    name="mitsim",
    help="A physically based simulator of coded-illumination lensless imaging.",
    no_args_is_help=True,
    cls=Program,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def run() -> None:
    """Serve the command line in this process.

    The exit status is 0 done, 1 done but flagged, 2 refused or failed, or 128 + n ended by signal n.
    """
    try:
        Path.cwd()
    except FileNotFoundError:
        _fail("the working folder does not exist any more; change to another one")
    if sys.argv[1:3] == ["design", "predict"]:  # the same as `mitsim predict`
        del sys.argv[1]
    try:
        with warnings.catch_warnings(record=True) as found:
            code = app(standalone_mode=False)
        for note in dict.fromkeys(str(each.message) for each in found):  # not before: progress is shown meanwhile
            say_note(note)
    except SystemExit as ended:
        if ended.code == 1:  # click's for a reader that went away
            sys.exit(128 + signal.SIGPIPE)
        raise
    except MitsimError as error:
        _fail(*message_of(error).split("\n"))
    except (typer.Abort, KeyboardInterrupt) as error:
        if isinstance(error.__cause__, EOFError):  # which click takes for Control-D
            end_uncaught(error.__cause__)
        code = INTERRUPTED
    except MemoryError:
        _fail("out of memory; close other programs, or ask for fewer pixels, frames or less accuracy")
    except OSError as error:
        # What no check foresees: a full disk, a name too long, a file taken away. Other errors are faults of ours.
        if error.filename is None and error.errno not in _NO_ROOM:
            end_uncaught(error)
        _fail(f"{error.filename or 'output'}: {error.strerror}; choose another place")
    except Exception as error:
        # Usage errors of click (wherever typer keeps it) carry their own one-line message.
        if not (hasattr(error, "format_message") and hasattr(error, "exit_code")):
            end_uncaught(error)
        message: str = error.format_message()
        if message.startswith("Usage:"):  # no command was given, and click's sentence is the whole help
            typer.echo(message, err=True)
            _fail("give one of the commands above")
        checked, context = getattr(error.__cause__, "errors", None), getattr(error, "ctx", None)
        if checked is not None:  # a typer that checks with pydantic leaves out the value
            message += f"; got {checked()[0].get('input')!r}"
        _fail(message if context is None else f"{message.rstrip('.')}; see {context.command_path} --help")
    if code == INTERRUPTED:  # some versions of typer turn Control-C into this status without a word
        end_stopped()
    sys.exit(code if isinstance(code, int) else 0)


def _fail(*lines: str) -> None:
    if is_stopped():
        end_stopped()  # what an interrupt became on its way, as of a module that was being imported
    print("mitsim:", "\n  ".join(" ".join(printable(line).split()) for line in lines), file=sys.stderr)
    sys.exit(2)


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False) -> None:
    if version:
        print(mitsim.__version__)
        raise typer.Exit


_VERBS = {
    "Main steps": (demo, run_, view, plan, predict, capture, calibrate, frame_verbs.reconstruct),
    "Light and sensor alone": (render, frame_verbs.sense, frame_verbs.characterise),
    "Experiments": (study, frame_verbs.compare, design),
    "Neural networks": (pairs, frame_verbs.train),
    "Real devices and other programs": (frame_verbs.export, frame_verbs.import_, frame_verbs.patterns, transport),
    "Files and installation": (frame_verbs.show, frame_verbs.report, list_, new, doctor),
}
"""Verbs by heading, in the order of the help."""
for _panel, _verbs in _VERBS.items():
    for _verb in _verbs:
        _name, _help = _verb.__name__.rstrip("_"), help_of(_verb.__doc__)
        app.command(_name, cls=Verb, help=_help, short_help=_help.partition("\n")[0], rich_help_panel=_panel)(_verb)

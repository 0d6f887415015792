"""`mitsim run`: a session file in, what the terminal shows of its steps out; or a folder in, its session file out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

import mitsim
from mitsim.cli.help_page import WHAT
from mitsim.cli.options import LimitedPictured, Resume, is_given, option, refuse_unused, verb
from mitsim.cli.screen import finish
from mitsim.core.errors import MitsimError
from mitsim.core.worker import RESUME, advise


@dataclass(frozen=True)
class Running:
    """How a session is run."""

    PANEL = WHAT

    output: Path | None = option(
        None,
        "folder to make; of --from, session file",
        "-o",
        "--output",
        metavar="FOLDER",
        show_default="session-output",
    )
    values: list[str] | None = option(
        None, "set a field of the file; may be given again", "-D", metavar="TABLE.FIELD=VALUE"
    )
    resume: Resume = False
    shard: str = option("1/1", "measure part I of N of a sweep's points", metavar="I/N")
    scheduler: str | None = option(None, "Dask scheduler that measures a sweep's points")
    repeated: Path | None = option(None, "write the session file that repeats a folder", "--from", metavar="FOLDER")


@verb
def run_(
    *,
    context: typer.Context,
    session: Annotated[
        str | None, typer.Argument(help="session file, or the name of a shipped one", metavar="SESSION.toml")
    ] = None,
    running: Running,
    limited: LimitedPictured,
) -> int:
    """Take all steps of a session file, or write that of a folder.

    Each step, such as capture or a sweep, has its folder in that of the session.

    $ mitsim run demo -o out
    $ mitsim run fig1.toml -o out -D capture.patterns=dots:5
    $ mitsim run --from out/image -o figure.toml
    """
    if running.repeated is not None:
        return _repeat(context, session, running.repeated, running.output, limited)
    if session is None:
        raise MitsimError("run: give a session file, or --from FOLDER to write one")
    values: dict[str, Any] = {}
    for text in running.values or ():
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise MitsimError(f"-D {text!r}: give TABLE.FIELD=VALUE")
        values[name] = value
    if is_given(context, "variant"):
        values["scene.variant"] = limited.variant
    from mitsim.sessions.session_file import value_of

    asked = {name: value_of(value) for name, value in values.items()}
    advise(RESUME)
    options: dict[str, Any] = {"resume": running.resume, "pictures": not limited.no_pictures}
    with limited.job() as job:
        done = mitsim.run(
            session,
            running.output or "session-output",
            asked,
            job,
            **options,
            shard=running.shard,
            scheduler=running.scheduler,
        )
    return finish(limited.as_json, done.payload(), done.lines(), done.warnings)


def _repeat(
    context: typer.Context, session: str | None, folder: Path, output: Path | None, limited: LimitedPictured
) -> int:
    """Print the session file of a ``folder``, or write it to an ``output``."""
    if session is not None:
        raise MitsimError(f"--from {folder}: writes a session file, and {session} is one; give one of both")
    others = "values", "resume", "shard", "scheduler", "no_pictures", "variant", "max_seconds", "max_memory"
    refuse_unused(context, others, "with --from, which runs nothing")
    from mitsim.core.files import check_output

    if output is not None:
        check_output(output, kind="file")
    found = mitsim.session_of(folder)
    written = None if output is None else str(found.save(output))
    payload = {"session": found.text, "output": written, "warnings": found.warnings}
    lines = [found.text.rstrip()] if written is None else [f"Session file: {written}"]
    return finish(limited.as_json, payload, lines, found.warnings)

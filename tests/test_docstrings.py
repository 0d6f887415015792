"""Options of the command line have help, and no function takes more parameters than a reader can follow.

Ruff's rules D check the form of docstrings (pyproject.toml).
"""

from __future__ import annotations

import ast
from pathlib import Path

from tests.test_architecture import modules, parsed

Function = ast.FunctionDef | ast.AsyncFunctionDef


def parameters(node: Function) -> list[str]:
    """Return all names that a call may fill, ``self`` included."""
    given = node.args
    plain = [*given.posonlyargs, *given.args, *given.kwonlyargs]
    return [argument.arg for argument in [*plain, *filter(None, (given.vararg, given.kwarg))]]


def test_every_option_of_the_command_line_has_a_help_text() -> None:
    import typer

    from mitsim.cli import app

    verbs = typer.main.get_command(app).commands
    silent = [
        f"{verb} {parameter.name}"
        for verb, command in verbs.items()
        for parameter in command.params
        if parameter.name != "help" and not getattr(parameter, "help", "")
    ]
    assert not silent, silent


MOST_PARAMETERS = 7
"""More parameters ask for a type of the values that travel together; those of a verb are its options."""


def test_no_function_takes_more_than_seven_parameters() -> None:
    long = [
        f"{module}.{node.name}: {len(names)}"
        for module, path in modules()
        for node in ast.walk(parsed(Path(path).read_text(encoding="utf-8")))
        if isinstance(node, Function)
        and not module.startswith("mitsim.cli.")
        and len(names := {*parameters(node)} - {"self", "cls"}) > MOST_PARAMETERS
    ]
    assert not long, long

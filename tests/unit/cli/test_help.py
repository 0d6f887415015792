"""The options of every verb, held against a list of them: other programs rely on their names and defaults."""

from __future__ import annotations

import inspect
import json
import os
import re
import shlex
from pathlib import Path
from typing import Any, Literal
from unittest.mock import patch

import pytest
import typer
from typer.testing import CliRunner

from mitsim.bench.request import Seeded
from mitsim.cli import app
from mitsim.cli.commands import Common, argument
from mitsim.cli.commands import command as command_of
from mitsim.cli.commands import shown as changed
from mitsim.core.configuration import DEVICES, LIMITS, OUTPUT, QUALITY, WHAT, option
from mitsim.core.errors import ArgumentError
from mitsim.devices.patterns import pattern_names
from mitsim.reconstruct.request import method_names

LIST = Path(__file__).with_name("options.json")
"""Help, metavar and default of each option; written anew by ``python -m tests.unit.cli.test_help``."""


def described(command: Any) -> dict[str, Any]:
    """What the help of a ``command`` says, in no order, as JSON."""
    options = {}
    for parameter in command.params:
        name = " ".join(parameter.opts) if parameter.param_type_name == "option" else parameter.name
        default = parameter.default
        # These grow with their registries.
        reported = parameter.help.replace(pattern_names(), "PATTERNS").replace(method_names(), "METHODS")
        options[name] = {
            "help": reported,
            "metavar": parameter.metavar,
            "default": default if isinstance(default, str | int | float | None) else str(default),
            "shown": parameter.show_default,
            "required": parameter.required,
            "panel": parameter.rich_help_panel,
            "several": getattr(parameter, "multiple", False) or parameter.nargs != 1,
        }
    return {"help": command.help, "options": options}


PROGRAM: Any = typer.main.get_command(app)


def found() -> dict[str, Any]:
    return {name: described(command) for name, command in PROGRAM.commands.items()}


def page(*verb: str, columns: int = 80) -> str:
    context = typer.Context(PROGRAM, info_name="mitsim")
    for name in verb:
        context = typer.Context(PROGRAM.commands[name], info_name=name, parent=context)
    with patch.dict(os.environ, COLUMNS=str(columns)):
        return re.sub(r"\x1b\[\d+m", "", context.command.get_help(context))


def test_the_verbs_have_the_options_of_the_list() -> None:
    listed = json.loads(LIST.read_text(encoding="utf-8"))
    assert [*found()] == [*listed], "verbs, in their order"
    for name, now in found().items():
        assert now == listed[name], name


# ---- pages -----------------------------------------------------------------------------------------------------------


def test_the_program_says_in_a_line_what_each_verb_is_for() -> None:
    """Whole sentences, each on one line of 80 columns. (Planted: a first line of two lines' length.)"""
    lines = page().splitlines()
    for name, command in PROGRAM.commands.items():
        assert command.short_help.endswith("."), name
        assert sum(line.split()[:1] == [name] and line.endswith(command.short_help) for line in lines) == 1, name


@pytest.mark.parametrize("verb", PROGRAM.commands)
def test_a_page_has_its_options_below_headings_and_examples_that_run(verb: str) -> None:
    """No line is longer than the terminal. (Planted: a panel that is not shown; `--pattern` for `--patterns`.)"""
    command, lines = PROGRAM.commands[verb], page(verb).splitlines()
    assert max(map(len, lines)) <= 80
    headings = [line[:-1] for line in lines if line.endswith(":") and not line.startswith(" ")]
    order = "Arguments", "A real camera's frames", "An exported file", WHAT, QUALITY, DEVICES, OUTPUT, LIMITS
    assert headings == [each for each in order if each in headings]
    for each in command.params:
        names = [re.split(r"\s{2,}", line[2:])[0].replace(",", "").split() for line in lines if line.startswith("  -")]
        old = [name for name in each.opts if name.startswith("--")][1:]
        named = [words for words in names if {*each.opts} - {*old} <= {*words}]
        assert each.param_type_name == "argument" or len(named) == (not each.hidden), each.opts
        assert not any({*old} & {*words} for words in names), each.opts
    examples = [line[line.index("mitsim ") :] for line in lines if re.match(r"    mitsim |  .* {2}mitsim ", line)]
    assert any(line.startswith(f"mitsim {verb}") for line in examples)
    for line in examples:
        _, name, *words = shlex.split(line)
        PROGRAM.commands[name].make_context(name, words)


# ---- from models to options ------------------------------------------------------------------------------------------


class Base(Seeded):
    """A model that another one derives from."""

    PANEL = OUTPUT

    quick: bool = option(False, "a few")


class Group(Base):
    """A model of options of several kinds."""

    PANEL = WHAT

    place: str = argument(..., "of it", "PLACE")
    name: str = option(..., "of it", metavar="NAME")
    sizes: list[int] | None = option(None, "of it", kind=list[int])
    level: float | Literal["auto"] = option("auto", "of it")


class Some(Seeded, Common):
    """A verb that shows an option otherwise, and first, and not another."""

    FIRST, HIDDEN, CHANGES = "seed", "variant quiet verbose as_json", changed(seed={"help": "another"})


def of_a_group(asked: Group) -> int:
    return 0


def of_some(asked: Some) -> int:
    return 0


def call(*words: str) -> Any:
    program, seen = typer.Typer(), []

    @program.command()
    @command_of
    def read(asked: Group) -> int:
        seen.append(asked)
        return 0

    done = CliRunner().invoke(program, [*words])
    return seen[0] if seen else done.exception if isinstance(done.exception, ArgumentError) else done.exit_code


def shown(function: Any) -> dict[str, Any]:
    parameters = inspect.signature(command_of(function)).parameters.values()
    return {each.name: each.annotation.__metadata__[0] for each in parameters if each.name != "context"}


def test_a_way_to_calibrate_has_a_line_with_its_command() -> None:
    """(Planted: the option of one of them misspelt, which the test of pages finds, too.)"""
    lines = [line for line in page("calibrate").splitlines() if re.match(r"  \w.* {2}mitsim calibrate ", line)]
    assert [next((each for each in line.split() if each in WAYS), "") for line in lines] == WAYS


WAYS = ["", "--frames", "--known", "--model", "--plan-session"]


def test_old_spellings_are_read_and_not_shown() -> None:
    """(Planted: the old spelling dropped.)"""
    for words in ("--plan", "--plan-session"):
        context = PROGRAM.commands["calibrate"].make_context("calibrate", ["photograph", words])
        assert context.params["planning"] is True
    assert "--plan " not in page("calibrate") and "--frames N" not in page("characterise")


def test_the_fields_of_a_model_are_options() -> None:
    """Those that are given make the model, which knows them. (Planted: defaults that count as given.)"""
    asked = call("here", "--name", "x")
    assert asked == Group(place="here", name="x") and asked.given == {"place": "here", "name": "x"}
    words = "there --seed 3 --sizes 1 --sizes 2 --quick --name y --level 0.5"
    assert call(*words.split()) == Group(place="there", seed=3, quick=True, name="y", sizes=[1, 2], level=0.5)
    assert [*shown(of_a_group)] == ["place", "name", "sizes", "level", "quick", "seed"]


def test_a_model_names_the_heading_of_its_own_options() -> None:
    """Not of those that it inherits, nor of one that names another. (Planted: the last model's for all.)"""
    panels = {name: mark.rich_help_panel for name, mark in shown(of_a_group).items() if name != "place"}
    assert panels == {"name": WHAT, "sizes": WHAT, "level": WHAT, "seed": QUALITY, "quick": OUTPUT}


def test_a_verb_shows_some_fields_as_it_needs() -> None:
    """(Planted: changes of one verb that all others have, too.)"""
    for _ in range(2):
        assert {name: mark.help for name, mark in shown(of_some).items()} == {"seed": "another"}
    assert shown(of_a_group)["seed"].help == Group.model_fields["seed"].description == "seed of all random numbers"


@pytest.mark.parametrize("words", ["here", "here --name x --seed y", "--name x", "here --name x --size 1"])
def test_options_of_a_model_are_refused_as_others_are(words: str) -> None:
    assert call(*words.split()) == 2


@pytest.mark.parametrize(
    ("words", "refusal"), [("--level y", "level 'y': give a number or auto"), ("--seed -1", "seed")]
)
def test_values_that_a_model_refuses_are_refused(words: str, refusal: str) -> None:
    assert str(call("here", "--name", "x", *words.split())).startswith(refusal)


if __name__ == "__main__":
    LIST.write_text(json.dumps(found(), indent=1) + "\n", encoding="utf-8")

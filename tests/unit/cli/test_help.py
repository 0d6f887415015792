"""The options of every verb, held against a list of them: other programs rely on their names and defaults."""

from __future__ import annotations

import inspect
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer
from typer.testing import CliRunner

from mitsim.cli import app
from mitsim.cli.frame_verbs import method_names
from mitsim.cli.options import Seed, option, verb
from mitsim.devices.patterns import pattern_names

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
            "several": getattr(parameter, "multiple", False) or parameter.nargs != 1,
        }
    return {"help": command.help, "options": options}


def found() -> dict[str, Any]:
    verbs = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    return {name: described(command) for name, command in verbs.items()}


def test_the_verbs_have_the_options_of_the_list() -> None:
    listed = json.loads(LIST.read_text(encoding="utf-8"))
    assert [*found()] == [*listed], "verbs, in their order"
    for name, now in found().items():
        assert now == listed[name], name


@dataclass(frozen=True)
class Base:
    seed: Seed = 0
    quick: bool = option(False, "a few", "--quick")


@dataclass(frozen=True, kw_only=True)
class Group(Base):
    name: str = option(..., "of it", metavar="NAME")
    sizes: list[int] | None = option(None, "of it")


def call(*words: str) -> Any:
    program, seen = typer.Typer(), []

    @program.command()
    @verb
    def read(*, context: typer.Context, place: Annotated[str, typer.Argument()], group: Group, last: int = 1) -> int:
        seen.append((context.get_parameter_source("seed").name, place, group, last))
        return 0

    done = CliRunner().invoke(program, [*words])
    return seen[0] if seen else done.exit_code


def test_the_fields_of_a_group_are_options() -> None:
    """Its own before those that it inherits. (Planted: a default that is the option itself.)"""
    assert call("here", "--name", "x") == ("DEFAULT", "here", Group(name="x"), 1)
    words = "there --seed 3 --sizes 1 --sizes 2 --quick --last 5 --name y"
    assert call(*words.split()) == ("COMMANDLINE", "there", Group(seed=3, quick=True, name="y", sizes=[1, 2]), 5)
    assert [*inspect.signature(verb(of_a_group)).parameters] == ["name", "sizes", "seed", "quick"]


def of_a_group(group: Group) -> int:
    return 0


@pytest.mark.parametrize("words", ["here", "here --name x --seed y", "--name x", "here --name x --size 1"])
def test_options_of_a_group_are_refused_as_others_are(words: str) -> None:
    assert call(*words.split()) == 2


if __name__ == "__main__":
    LIST.write_text(json.dumps(found(), indent=1) + "\n", encoding="utf-8")

"""Every public function, method and constructor of the package says what it takes, read from the source text.

With three or more parameters the docstring has a ``Parameters`` section that names each of them; with one or two they
are named there or in double backticks. A constructor's parameters are those of its class's docstring. The command
line's verbs are documented by the help of their options instead.
"""

from __future__ import annotations

import ast
import inspect
import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
from numpydoc.docscrape import NumpyDocString

from tests.test_architecture import modules, parsed

pytestmark = pytest.mark.usefixtures("trees")
IN_TEXT = 2
"""The most parameters that a sentence may name; chosen: more are easier found in a list."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


def public_functions(source: str) -> Iterator[tuple[str, list[str], str]]:
    """(name, parameters, docstring) of all that callers of a module see; nested functions are not seen."""

    def walk(body: list[ast.stmt], owner: ast.ClassDef | None) -> Iterator[tuple[str, list[str], str]]:
        prefix = f"{owner.name}." if owner else ""
        for node in body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                yield from walk(node.body, node)
            if not isinstance(node, Function):
                continue
            decorators = {ast.unparse(decorator) for decorator in node.decorator_list}
            if "verb" in decorators:  # its docstring is the help, which has a line for each option
                continue
            constructor = owner is not None and node.name == "__init__"
            if node.name.startswith("_") and not constructor:
                continue
            names = parameters(node)[int(owner is not None and "staticmethod" not in decorators) :]
            text = ast.get_docstring(node) or (ast.get_docstring(owner) if constructor and owner else "") or ""
            yield prefix + node.name, [name for name in names if not name.startswith("_")], text

    yield from walk(parsed(source).body, None)


def parameters(node: Function) -> list[str]:
    """All names that a call may fill, ``self`` included."""
    given = node.args
    plain = [*given.posonlyargs, *given.args, *given.kwonlyargs]
    return [argument.arg for argument in [*plain, *filter(None, (given.vararg, given.kwarg))]]


def missing(names: list[str], text: str) -> list[str]:
    """What a docstring leaves out: parameters, or the docstring itself."""
    if not text:
        return ["docstring"] if names else []
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a section that numpydoc does not know, or one that stands twice
        sections = NumpyDocString(inspect.cleandoc(text))
    listed = [entry.name for title in ("Parameters", "Other Parameters") for entry in sections[title]]
    described = {name.strip().lstrip("*") for entry in listed for name in entry.split(",")}
    if len(names) <= IN_TEXT:
        described |= {word for span in text.split("``")[1::2] for word in re.findall(r"\w+", span)}
    return [name for name in names if name not in described]


def room_of(module: str) -> str:
    return module.split(".")[1] if "." in module else "mitsim"


def judged() -> dict[str, list[tuple[str, list[str]]]]:
    """By room: (function, what its docstring leaves out) of every function that takes anything."""
    rooms: dict[str, list[tuple[str, list[str]]]] = {}
    for module, path in modules():
        for name, names, text in public_functions(Path(path).read_text(encoding="utf-8")):
            if names:
                rooms.setdefault(room_of(module), []).append((f"{module}.{name}", missing(names, text)))
    return rooms


def test_every_public_function_says_what_it_takes() -> None:
    broken = []
    for room, functions in sorted(judged().items()):
        left = [f"{name}: {', '.join(absent)}" for name, absent in functions if absent]
        print(f"{room:12} {len(functions) - len(left):4} of {len(functions):4} documented")
        broken += left
    assert not broken, "\n".join(broken)


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


LISTED = '''
    """Sum.

    Parameters
    ----------
    a, b : float
        Summands.
    c : float
        Another.
    """
'''


@pytest.mark.parametrize(
    ("source", "left_out"),
    [
        ("def f(a): ...", ["docstring"]),
        ('def f(a):\n    """Nothing of use."""', ["a"]),
        ('def f(a):\n    """``a`` doubled."""', []),
        ('def f(a, *, b=1):\n    """Values ``a[b]``."""', []),
        ('def f(a, b, c):\n    """``a``, ``b`` and ``c``."""', ["a", "b", "c"]),
        ("def f(a, b, c):" + LISTED, []),
        ("def f(a, b, c, *d):" + LISTED, ["d"]),
        ('class C:\n    def m(self, a):\n        """Nothing."""', ["a"]),
        ('class C:\n    """A ``size`` in."""\n    def __init__(self, size): ...', []),
        ('class C:\n    """Nothing."""\n    def __init__(self, size): ...', ["size"]),
        ('class C:\n    @staticmethod\n    def m(a):\n        """Nothing."""', ["a"]),
    ],
)
def test_the_rule_catches_a_planted_function(source: str, left_out: list[str]) -> None:
    ((_, names, text),) = public_functions(source)
    assert missing(names, text) == left_out


@pytest.mark.parametrize(
    "source", ["def _f(a): ...", "class _C:\n    def m(self, a): ...", "def f():\n    def g(a): ..."]
)
def test_the_rule_lets_private_functions_be(source: str) -> None:
    assert not [name for name, names, _ in public_functions(source) if names]


MOST_PARAMETERS = 7
"""Chosen: more ask for a type of what travels together."""


def test_no_function_takes_more_than_seven_parameters() -> None:
    long = [
        f"{module}.{node.name}: {len(names)}"
        for module, path in modules()
        for node in ast.walk(parsed(Path(path).read_text(encoding="utf-8")))
        if isinstance(node, Function) and len(names := {*parameters(node)} - {"self", "cls"}) > MOST_PARAMETERS
    ]
    assert not long, long

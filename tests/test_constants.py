"""Every numeric constant of the package says why it has its value, read from the source text.

A constant is a name in capitals, of a module or a class, that is given a number, an arithmetic of numbers or a tuple of
them. Its reason is the docstring below it, or a comment beside it or on the line above.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize

import pytest

from tests.test_architecture import modules, parsed
from tests.test_docstrings import room_of

pytestmark = pytest.mark.usefixtures("trees")
NAME = re.compile(r"_?[A-Z][A-Z0-9_]*")
NO_REASON = re.compile(r"#\s*(-{2,}|noqa|type:|fmt:|pragma)")


def is_number(node: ast.expr) -> bool:
    """A number, or an expression of numbers and names with a number in it."""
    allowed = (ast.Constant, ast.UnaryOp, ast.BinOp, ast.Tuple, ast.List, ast.Set, ast.Name, ast.Attribute)
    helpers = (ast.operator, ast.unaryop, ast.expr_context)
    parts = list(ast.walk(node))
    values = [part.value for part in parts if isinstance(part, ast.Constant)]
    numbers = [value for value in values if isinstance(value, int | float) and not isinstance(value, bool)]
    return all(isinstance(part, allowed + helpers) for part in parts) and bool(numbers) and len(numbers) == len(values)


def constants(source: str) -> list[tuple[str, bool]]:
    """(name, whether it has a reason) of every numeric constant in a module's text."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = {t.start[0]: t for t in tokens if t.type == tokenize.COMMENT and not NO_REASON.match(t.string)}
    lines = source.splitlines()

    def alone(line: int) -> bool:
        return line in comments and lines[line - 1].lstrip().startswith("#")

    found = []

    def walk(body: list[ast.stmt]) -> None:
        for node, after in zip(body, [*body[1:], None], strict=True):
            if isinstance(node, ast.ClassDef):
                walk(node.body)
            targets = (
                node.targets
                if isinstance(node, ast.Assign)
                else [node.target]
                if isinstance(node, ast.AnnAssign)
                else []
            )
            names = [part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]
            if not names or not all(map(NAME.fullmatch, names)) or node.value is None or not is_number(node.value):
                continue
            below = (
                isinstance(after, ast.Expr)
                and isinstance(after.value, ast.Constant)
                and isinstance(after.value.value, str)
            )
            beside = any(line in comments for line in range(node.lineno, node.end_lineno + 1))
            found.extend((name, below or beside or alone(node.lineno - 1)) for name in names)

    walk(parsed(source).body)
    return found


def test_every_constant_has_a_reason() -> None:
    rooms: dict[str, list[tuple[str, bool]]] = {}
    for module, path in modules():
        named = [(f"{module}.{name}", reason) for name, reason in constants(path.read_text(encoding="utf-8"))]
        rooms.setdefault(room_of(module), []).extend(named)
    broken = []
    for room, found in sorted(rooms.items()):
        left = [name for name, reason in found if not reason]
        print(f"{room:12} {len(found) - len(left):3} of {len(found):3} constants with a reason")
        broken += left
    assert not broken, "\n".join(broken)


@pytest.mark.parametrize(
    ("source", "reasons"),
    [
        ("A = 1", [False]),
        ("_A = 2 * 3.5", [False]),
        ("A = 1 << 16\nB = 2\n", [False, False]),
        ("A = (1, -2)", [False]),
        ("class C:\n    A: int = 3\n", [False]),
        ("# ---- numbers\nA = 1", [False]),
        ("A = 1  # noqa: E501", [False]),
        ("# chosen so\n\nA = 1", [False]),
        ("B = 1  # measured\nA = 1", [True, False]),
        ("A = 1\n'''Chosen so.'''", [True]),
        ("A = 1  # a millimetre", [True]),
        ("# Measured on a bench.\nA = 1", [True]),
        ("A = (\n    1,  # of this\n    2,\n)", [True]),
        ("A, B = 1, 2  # by the format", [True, True]),
    ],
)
def test_the_rule_catches_a_planted_constant(source: str, reasons: list[bool]) -> None:
    assert [reason for _, reason in constants(source)] == reasons


@pytest.mark.parametrize(
    "source", ["a = 1", "A = 'text'", "A = f(1)", "A = {'a': 1}", "A = B", "A = True", "def f():\n    A = 1"]
)
def test_the_rule_lets_other_names_be(source: str) -> None:
    assert not constants(source)

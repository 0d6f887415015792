"""A module's text in, its mutants out: the same text with one change that a programmer could have made by mistake."""

from __future__ import annotations

import ast
import builtins
import hashlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass

# fmt: off
_OPERATORS: dict[type, type] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Div,
    ast.Mod: ast.FloorDiv, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
    ast.And: ast.Or, ast.Or: ast.And, ast.Break: ast.Continue, ast.Continue: ast.Break,
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}
_REVERSED: dict[type, type] = {ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt}
_TWINS = (
    ("min", "max"), ("minimum", "maximum"), ("floor", "ceil"), ("any", "all"), ("argmin", "argmax"),
    ("zeros", "ones"), ("zeros_like", "ones_like"), ("sum", "mean"), ("sin", "cos"),
    ("rows", "columns"), ("left", "right"), ("horizontal", "vertical"),
)
# fmt: on
_OTHER = dict(_TWINS) | {second: first for first, second in _TWINS}
_UNTOUCHED = (ast.JoinedStr, ast.Raise, ast.Import, ast.ImportFrom, ast.arg)
"""Messages, imports and annotations: tests of bad input and of the architecture read these."""
_SYMMETRIC = "min", "max", "minimum", "maximum", "hypot", "array_equal", "vdot"
"""Functions that the order of their arguments means nothing to."""
Place = tuple[str, ast.AST, Callable[[ast.AST], None], list[ast.AST]]


@dataclass(frozen=True)
class Mutant:
    """A change of a module: ``key`` says it in words, ``place`` finds it in the text."""

    module: str
    line: int
    key: str
    place: tuple[int, int]


def mutants(module: str, source: str) -> list[Mutant]:
    """All mutants of a ``module``, whose text is ``source``."""
    lines, times, found = source.splitlines(), Counter[str](), []
    names = {node.id for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Name)}
    for index, (scope, node, _, variants) in enumerate(_places(ast.parse(source))):
        for number, variant in enumerate(variants):
            if isinstance(variant, ast.Name) and variant.id not in names and not _built_in(node, variant):
                continue
            old, new = (ast.unparse(ast.fix_missing_locations(part)).partition("\n")[0] for part in (node, variant))
            line = getattr(node, "lineno", 1)
            change = f"{old} -> {new}" if len(old) + len(new) < 160 else f"{old[:60]}... -> {new[:90]}..."
            key = f"{module} {scope or 'module'}: {lines[line - 1].strip()} | {change}"
            times[key] += 1
            found.append(Mutant(module, line, f"{key} #{times[key]}" if times[key] > 1 else key, (index, number)))
    return found


def drawn(found: list[Mutant], count: int, seed: int) -> list[Mutant]:
    """``count`` of the mutants ``found``; which, hangs on the ``seed`` and on each change alone."""
    ranked = sorted(found, key=lambda mutant: hashlib.sha256(f"{seed} {mutant.key}".encode()).digest())
    return sorted(ranked[:count], key=lambda mutant: mutant.place)


def mutated(source: str, place: tuple[int, int]) -> str:
    """The module's text with the change at a ``place``."""
    tree = ast.parse(source)
    _, _, replace, variants = list(_places(tree))[place[0]]
    replace(variants[place[1]])
    return ast.unparse(ast.fix_missing_locations(tree))


def _places(tree: ast.AST, scope: str = "", returns: str = "") -> Iterator[Place]:
    """(scope, node, how to replace it, its variants) of all that may be changed, depth first."""
    for field, value in ast.iter_fields(tree):
        if field in ("annotation", "returns", "decorator_list", "type_comment"):
            continue
        for index, node in enumerate(value if isinstance(value, list) else [value]):
            if not isinstance(node, ast.AST) or isinstance(node, _UNTOUCHED):
                continue
            if isinstance(node, ast.keyword) and node.arg == "strict":  # of zip: a guard that never speaks
                continue

            def replace(new: ast.AST, value: object = value, field: str = field, index: int = index) -> None:
                if isinstance(value, list):
                    value[index] = new
                else:
                    setattr(tree, field, new)

            inner, result = scope, returns
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                if node.name in ("__repr__", "_repr_html_"):
                    continue
                inner = f"{scope}.{node.name}".lstrip(".")
                result = ast.unparse(node.returns) if isinstance(node, ast.FunctionDef) and node.returns else ""
            variants = [*_of_statement(node, returns)] if isinstance(node, ast.stmt) else []
            yield inner, node, replace, [*variants, *_of_expression(node)]
            yield from _places(node, inner, result)


def _of_expression(node: ast.AST) -> Iterator[ast.AST]:
    """What stands in for a ``node``: another operator, constant, order of arguments, function, side."""
    match node:
        case ast.BinOp() | ast.BoolOp() | ast.AugAssign() if type(node.op) in _OPERATORS:
            yield _with(node, op=_OPERATORS[type(node.op)]())
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            yield node.operand
        case ast.Compare(ops=[single]):
            for table in (_OPERATORS, _REVERSED):
                if type(single) in table:
                    yield _with(node, ops=[table[type(single)]()])
        case ast.Constant(value=bool()):
            yield ast.Constant(not node.value)
        case ast.Constant(value=int()):
            yield ast.Constant(node.value + 1)
        case ast.Constant(value=float()):
            yield ast.Constant(2 * node.value or 1.0)
        case ast.IfExp():
            yield _with(node, body=node.orelse, orelse=node.body)
        case ast.Call(args=[first, second, *rest]) if ast.dump(first) != ast.dump(second) and not _symmetric(node):
            yield _with(node, args=[second, first, *rest])
        case ast.Attribute() if node.attr in _OTHER:
            yield _with(node, attr=_OTHER[node.attr])
        case ast.Name(ctx=ast.Load()) if node.id in _OTHER:
            yield _with(node, id=_OTHER[node.id])


def _of_statement(node: ast.stmt, returns: str) -> Iterator[ast.stmt]:
    """What stands in for a statement of a function that ``returns`` a type of that text: none, its negation, double."""
    match node:
        case ast.AugAssign() | ast.Expr(value=ast.Call()) | ast.Assign(targets=[ast.Subscript() | ast.Attribute()]):
            yield ast.Pass()
        case ast.If() | ast.While():
            yield ast.fix_missing_locations(_with(node, test=ast.UnaryOp(ast.Not(), node.test)))
        case ast.Return(value=ast.Tuple(elts=[first, second])):
            yield ast.Return(ast.Tuple([second, first], ast.Load()))
        case ast.Return(value=ast.expr() as value) if returns == "bool":
            yield ast.Return(ast.UnaryOp(ast.Not(), value))
        case ast.Return(value=ast.expr() as value) if returns in ("float", "int", "FloatArray"):
            yield ast.Return(ast.BinOp(ast.Constant(2), ast.Mult(), value))
        case ast.Break() | ast.Continue():
            yield _OPERATORS[type(node)]()


def _built_in(*names: ast.AST) -> bool:
    return all(isinstance(node, ast.Name) and hasattr(builtins, node.id) for node in names)


def _symmetric(call: ast.Call) -> bool:
    return ast.unparse(call.func).rpartition(".")[2] in _SYMMETRIC


def _with(node: ast.AST, **fields: object) -> ast.AST:
    return type(node)(**{**dict(ast.iter_fields(node)), **fields})

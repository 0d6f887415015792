"""What the fields of a file are: its model in; meanings, allowed values and a file to begin with, in TOML, out."""

from __future__ import annotations

import ast
import inspect
import itertools
import re
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any, get_args

import tomli_w
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

_PLAIN = {"string": "text", "boolean": "true or false", "integer": "whole number", "number": "number"}
_WIDTH = 100
"""Columns of a comment: chosen, so that a file fits beside its neighbour on a screen."""


def meanings(model: type[BaseModel]) -> dict[str, str]:
    """What each field of a ``model`` is: the first paragraph of the docstring below it, as tables and refusals have it;
    nothing where the source is not there."""
    found: dict[str, str] = {}
    for base in reversed([one for one in model.__mro__ if issubclass(one, BaseModel) and one.model_fields]):
        try:
            (written,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        except (OSError, TypeError, SyntaxError):
            continue
        body = getattr(written, "body", [])
        for field, below in itertools.pairwise(body):
            text = getattr(getattr(below, "value", None), "value", None)
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(text, str):
                text = " ".join(text.split("\n\n")[0].split()).removesuffix(".")
                plain = len(text) > 1 and (text[1].islower() or text[1] == " ")
                found[ast.unparse(field.target)] = text[0].lower() + text[1:] if plain else text
    return found


def default_text(value: object) -> str:
    """A field's default ``value`` in words."""
    if value is None or value in ({}, (), "") or isinstance(value, BaseModel):
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    return "infinite" if value == float("inf") else f"{value:g}" if isinstance(value, float) else str(value)


def allowed_text(rules: Mapping[str, Any]) -> str:
    """What a field takes, from the ``rules`` of its JSON schema."""
    if "anyOf" in rules:
        choices = rules["anyOf"]
        return ", ".join("null" if choice.get("type") == "null" else allowed_text(choice) for choice in choices)
    if "const" in rules or "enum" in rules:
        return ", ".join(f"`{value}`" for value in rules.get("enum", [rules.get("const")]))
    if "$ref" in rules or rules.get("type") == "object":
        return "object"
    if "prefixItems" in rules:
        return f"list of {len(rules['prefixItems'])}: {allowed_text(rules['prefixItems'][0])}"
    if rules.get("type") == "array":
        length = f", at most {rules['maxItems']}" if "maxItems" in rules else ""
        return f"list: {allowed_text(rules['items'])}{length}"
    if "pattern" in rules:
        words = re.fullmatch(r"\^\(([\w|]+)\)\$", rules["pattern"])
        return ", ".join(f"`{word}`" for word in words[1].split("|")) if words else "text without / and \\"
    least, above = rules.get("minimum"), rules.get("exclusiveMinimum")
    most, below = rules.get("maximum"), rules.get("exclusiveMaximum")
    start = f"{least:g}" if least is not None else f"above {above:g}" if above is not None else ""
    end = f"{most:g}" if most is not None else f"below {below:g}" if below is not None else ""
    if start and end:
        return start if start == end else f"{start} to {end}"
    kind = _PLAIN.get(rules.get("type", ""), "anything")
    return f"{kind}, at least {start}" if least is not None else f"{kind}, {start}" if start else kind


def toml_value(value: object) -> str:
    """Return text, a number, a truth, a list or a table as a TOML file has the ``value``, on one line."""
    # In a list with a number a table is inline. Line ends are those of lists, because texts have theirs escaped.
    text = tomli_w.dumps({"": [value, 0]}).partition("\n")[2].rpartition(",\n    0,")[0].strip()
    return re.sub(r",\n\s*", ", ", re.sub(r"(?<=\[)\n\s*|,\n\s*(?=\])", "", text))


def starter(model: type[BaseModel], values: Mapping[str, Any], table: str = "") -> Iterator[str]:
    """Lines of a file of a ``model``: every field with what it is and may be, those without a value after a #.

    Parameters
    ----------
    model
        of the file.
    values
        fields that are set; they make the file whole.
    table
        name of the table that the fields are in; empty: of none.
    """
    parts = {name: _model_of(field.annotation) for name, field in model.model_fields.items()}
    schema, known = model.model_json_schema()["properties"], meanings(model)
    if table:
        yield f"{'' if values else '#'}[{table}]"
    plain = [name for name, part in parts.items() if part is None]
    given = [name for name in plain if name in values]
    for name in (*given, *(name for name in plain if name not in values)):
        if given and name not in values:
            yield from ("", *_comment("Further fields."))
            given = []
        allowed = allowed_text(schema[name]).replace("`", "").removesuffix(", null")
        default = model.model_fields[name].default
        lacks = default is PydanticUndefined or default_text(default) in ("none", "infinite")
        yield from _comment(f"{known[name]}. Allowed: {allowed}.")
        shown = "..." if lacks else toml_value(default)
        yield f"{name} = {toml_value(values[name])}" if name in values else f"#{name} = {shown}"
    for name, part in parts.items():
        if part is not None:
            yield from ("", *_comment(f"{known[name]}."))
            yield from starter(part, values.get(name) or {}, f"{table}.{name}".removeprefix("."))


def _comment(text: str) -> list[str]:
    text = text[0].upper() + text[1:] if text[1].islower() or text[1] == " " else text
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ", break_long_words=False)


def _model_of(kind: Any) -> type[BaseModel] | None:
    """The model of a table, where a field of a ``kind`` is one; None of other fields, lists of tables among them."""
    kinds = [kind, *get_args(kind)]
    found = (each for each in kinds if isinstance(each, type) and issubclass(each, BaseModel))
    return next(found, None)

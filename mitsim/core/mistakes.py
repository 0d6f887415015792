"""Mistakes in files that people write: what pydantic found in; a refusal with all of them, each with its line, out."""

from __future__ import annotations

import math
import re
import reprlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, get_args

import pydantic

from mitsim.core.errors import MitsimError, cut, near_name
from mitsim.core.field_docs import allowed_text, meanings

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_MOST_LINES = 100
"""Of one value, read one after the other: the parser begins anew with each."""
_MOST_MISTAKES = 20
"""That are listed: a screen of them."""
_SHORT = reprlib.Repr()  # values as a message shows them
_SHORT.maxstring = _SHORT.maxother = 100  # characters: a line of 120 with what stands around them
Place = tuple[str | int, ...]
"""Names, and numbers of list items, that lead to a part of nested data."""


class Table(dict[str, Any]):
    """Names and values that a person wrote into a file: all mistakes in them are told at once, each with its line.

    Parameters
    ----------
    values
        the table.
    text
        of the TOML file that it was read from; empty where lines are not known.
    place
        names of the tables that it stands in.
    """

    def __init__(self, values: Mapping[str, Any], text: str = "", place: Place = ()) -> None:
        super().__init__(values)
        self.text, self.place = text, place

    def part(self, name: str) -> Table:
        """The table ``name`` in this one."""
        return Table(self[name], self.text, (*self.place, name))

    def lines(self) -> dict[Place, int]:
        """The line on which each name, and each table, of the file begins."""
        found: dict[Place, int] = {}
        entries: dict[Place, int] = {}  # of arrays of tables
        table: Place = ()
        statement, first = "", 1
        for number, line in enumerate(self.text.split("\n"), 1):
            statement += line + "\n"
            try:
                data = tomllib.loads(statement)
            except ValueError:  # it goes on in the next line
                if number - first > _MOST_LINES:
                    break
                continue
            if line.lstrip().startswith("[") and number == first:
                table = _header(data, entries)
                found.setdefault(table, number)
            else:
                for place in _places(data, table):
                    found.setdefault(place, first)
            statement, first = "", number + 1
        return found


def _header(data: Any, entries: dict[Place, int]) -> Place:
    """Place of the table that a line ``[name]`` or ``[[name]]`` begins, of which ``entries`` counts those before."""
    place: Place = ()
    while data:
        ((name, data),) = data.items()
        place = (*place, name)
        if isinstance(data, list):
            data = None
            entries[place] = entries.get(place, -1) + 1
        if place in entries:
            place = (*place, entries[place])
    return place


def _places(data: Any, above: Place) -> Iterator[Place]:
    """Places of all names in ``data``, which stands in a table ``above``."""
    for name, value in data.items() if isinstance(data, dict) else ():
        yield (*above, name)
        yield from _places(value, (*above, name))


def refusal(
    model: type[pydantic.BaseModel], error: pydantic.ValidationError, where: str, data: object = None
) -> MitsimError:
    """What pydantic found wrong, as :func:`mitsim.core.configuration.validate` raises it.

    Parameters
    ----------
    model
        that was to be made.
    error
        that pydantic raised.
    where
        what the message begins with.
    data
        that was read.
    """
    found = _mistakes_in(model, error, data)
    if isinstance(data, Table):
        return told_together(where, found)
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    return MitsimError(f"{where}: {found[0][1]}{more}")


Mistake = tuple[int, str]
"""Its line, 0 where that is not known, and what is said of it."""


def told_together(where: str, found: Sequence[Mistake]) -> MitsimError:
    """A refusal, which begins with ``where``, for all mistakes that were ``found``."""
    if len(found) == 1:
        ((line, text),) = found
        return MitsimError(f"{where}:{line}: {text}" if line else f"{where}: {text}")
    listed = [
        f"line {line}: {text}" if line else text for line, text in sorted(found, key=lambda one: one[0] or math.inf)
    ]
    more = [f"and {len(listed) - _MOST_MISTAKES} more"] if len(listed) > _MOST_MISTAKES else []
    return MitsimError(f"{where}: has {len(found)} mistakes:", *listed[:_MOST_MISTAKES], *more)


def mistakes(model: type[pydantic.BaseModel], data: Table) -> list[Mistake]:
    """What is wrong with ``data`` that is to be a ``model``: nothing, where it is right."""
    try:
        model.model_validate(data)
    except pydantic.ValidationError as error:
        return _mistakes_in(model, error, data)
    return []


def _mistakes_in(model: type[pydantic.BaseModel], error: pydantic.ValidationError, data: object) -> list[Mistake]:
    """What pydantic found wrong, unknown names first and missing ones last."""
    lines = data.lines() if isinstance(data, Table) else {}
    above = data.place if isinstance(data, Table) else ()

    def line_of(place: Place) -> int:
        return next(
            (lines[above + place[:end]] for end in range(len(place), -1, -1) if above + place[:end] in lines), 0
        )

    found = error.errors(include_url=False)
    # Items that are wrong themselves are missing from a list's length.
    found = [one for one in found if not (one["type"] == "too_short" and _within(one["loc"], found))]
    problems = {_place_in(data, problem): problem for problem in reversed(found)}
    wrong: list[Mistake] = []
    meant, unknown = set[Place](), 0
    missing: dict[Place, list[str]] = {}
    for place, problem in reversed(problems.items()):
        if problem["type"] == "missing":
            missing.setdefault(place[:-1], []).append(str(place[-1]))
            continue
        text = _complaint(model, problem, above)
        if problem["type"] == "extra_forbidden":
            meant |= {(*place[:-1], text.rpartition("did you mean ")[2].rstrip("?"))}
            wrong.insert(unknown, (line_of(place), text))
            unknown += 1
        else:
            wrong.append((line_of(place), text))
    for place, names in missing.items():
        # A mistyped name is both an unknown field and a missing one; the first tells more.
        if left := [name for name in names if (*place, name) not in meant]:
            table = ".".join(str(part) for part in above + place)
            fields = ", ".join(f"{table}.{name}" if table else name for name in left)
            wrong.append(
                (line_of(place), f"{fields}: {'is' if len(left) == 1 else 'are'} missing{_about(model, place, left)}")
            )
    return wrong


def _within(place: Place, problems: Sequence[Any]) -> bool:
    """Whether one of the ``problems`` is of a part of what stands at a ``place``."""
    return any(len(one["loc"]) > len(place) and one["loc"][: len(place)] == place for one in problems)


def _place_in(data: object, problem: Any) -> Place:
    """Where a ``problem`` is in the ``data``: pydantic's place without the names of a union's alternatives."""
    place: Place = problem["loc"]
    if problem["type"] in ("missing", "extra_forbidden"):
        return place
    for end, part in enumerate(place):
        try:
            data = data[part]  # type: ignore[index]
        except (KeyError, IndexError, TypeError):
            return place[:end] or place
    return place


def _complaint(model: type[pydantic.BaseModel], problem: Any, above: Place = ()) -> str:
    """Field, value and rule of one problem that pydantic found, in tables that are ``above`` the model's."""
    place = problem["loc"]
    field = ".".join(cut(str(part)) for part in (*above, *place))
    if problem["type"] == "value_error":  # a validator of ours, whose text says all
        return f"{field}: {problem['ctx']['error']}" if field else str(problem["ctx"]["error"])
    value = _short_text(problem["input"])
    if problem["type"] == "extra_forbidden":
        fields = getattr(_holder(model, place[:-1]), "model_fields", ())
        near = near_name(str(place[-1]), fields).strip()
        hint = "; " + (near or (f"known fields: {', '.join(fields)}" if fields else "remove it"))
        return f"{field}: got {value}, no such field{hint}"
    holder, rule = _holder(model, place[:-1]), problem["msg"][0].lower() + problem["msg"][1:]
    rules = holder.model_json_schema()["properties"].get(place[-1]) if holder and place else None
    allowed = allowed_text(rules).replace("`", "").removesuffix(", null") if rules else "anything"
    kind = {"int": "a whole number, ", "flo": "a number, "}.get(problem["type"][:3], "")
    if problem["type"] == "literal_error":
        rule = f"give {problem['ctx']['expected']}"
    elif allowed not in ("anything", "object"):
        rule = "give " + (f"a {allowed}" if re.match("whole|number|list", allowed) else kind + allowed)
    return f"{field or 'contents'}: got {value}; {rule}{_about(model, place[:-1], place[-1:])}"


def _about(model: type[pydantic.BaseModel], place: Place, names: Sequence[str | int]) -> str:
    """What the one of the ``names`` at a ``place`` in a ``model`` is, in brackets; nothing of several."""
    holder = _holder(model, place)
    meaning = meanings(holder).get(str(names[0])) if holder and len(names) == 1 else None
    return f" ({meaning})" if meaning else ""


def _holder(model: type[pydantic.BaseModel], place: Place) -> type[pydantic.BaseModel] | None:
    """The model of the part at ``place`` inside a ``model``; None for another kind of part."""
    for name in place:
        if isinstance(name, str) and name in model.model_fields:
            kinds = [model.model_fields[name].annotation]
            for kind in kinds:  # grows: a part may stand in a tuple, or be optional
                kinds += get_args(kind)
            models = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, pydantic.BaseModel)]
            if not models:
                return None
            model = models[0]
    return model


def _short_text(value: object) -> str:
    """A value on one short line, however large it is."""
    try:
        return cut(_SHORT.repr(value), 120)
    except (ValueError, RecursionError):  # a number of thousands of digits
        return f"a {type(value).__name__} too large to show"

"""Options of verbs: a pydantic model declares each once, for Python, the command line, session files and manifests.

A field states its kind, default and limits as pydantic does, and by :func:`option` its help and how the command line
spells it. :func:`takes` gives a function the fields of a model as keyword arguments.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable
from typing import Any, ClassVar, ParamSpec, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mitsim.core.errors import ArgumentError, check_arguments, near_name, plain_number, short_text

WHAT, QUALITY, DEVICES = "What", "Quality", "Scene and devices"
OUTPUT, LIMITS = "Output", "Machine and limits"
PANELS = WHAT, QUALITY, DEVICES, OUTPUT, LIMITS
"""Headings of options in the help, in the order of a page."""

P = ParamSpec("P")
R = TypeVar("R")


def option(default: Any, help: str, *names: str, kind: Any = None, **shown: Any) -> Any:
    """Declare a field of a model of options.

    Parameters
    ----------
    default
        Value of an option that is not given; ``...`` if it must be given.
    help
        Sentence of the help.
    names
        Spellings on the command line, if they differ from the field's name.
    kind
        Type of the word on the command line, if it differs from the field's; False for an option of Python alone.
    shown
        Further arguments of :class:`typer.Option`: ``metavar``, ``panel``, ``show_default``, ``min``, ``max``,
        ``complete``, a function that lists words; and ``read``, which makes the value of the word.
    """
    extra: Any = {"names": names, "kind": kind, "shown": shown}
    return Field(default, description=help, json_schema_extra=extra)


class Options(BaseModel):
    """Options that go together. A value that an option cannot have is refused by ArgumentError, which names it."""

    model_config = ConfigDict(
        frozen=True, strict=True, extra="forbid", arbitrary_types_allowed=True, defer_build=True, validate_default=False
    )
    PANEL: ClassVar[str] = WHAT
    """Heading of the options in the help."""
    VERB: ClassVar[str] = ""
    """Function that takes the options, as refusals name it."""

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**{name: plain_number(value) for name, value in values.items()})
        except ValidationError as error:
            raise self._refusal(error) from error

    @classmethod
    def _refusal(cls, error: ValidationError) -> ArgumentError:
        """Return the refusal of the first value that pydantic found wrong; a misspelt name comes first."""
        found = sorted(error.errors(include_url=False), key=lambda one: one["type"] != "extra_forbidden")[0]
        name, *inner = map(str, found["loc"])
        if found["type"] == "extra_forbidden" and not inner:
            known = [*cls.model_fields]
            of = f"option of {cls.VERB}" if cls.VERB else "such option"
            return ArgumentError(name, f"is no {of}; {near_name(name, known)}use {', '.join(known)}")
        if found["type"] == "missing":
            return ArgumentError(name, "is missing; give it")
        kinds = [one["msg"] for one in error.errors() if one["loc"][0] == found["loc"][0]]
        rule = " or ".join(dict.fromkeys(_rule(text) for text in kinds))
        return ArgumentError(name, f"{short_text(found['input'])}: give {rule}")

    @property
    def given(self) -> dict[str, Any]:
        """The options that were given, by name."""
        return {name: getattr(self, name) for name in type(self).model_fields if name in self.model_fields_set}

    def refuse(self, names: Iterable[str], where: str) -> None:
        """Refuse options that are given and have no effect: a user would believe that they are obeyed.

        Parameters
        ----------
        names
            Options without effect.
        where
            When they have none, for the message.
        """
        refuse_unused(self.model_fields_set, names, where)


def refuse_unused(given: Iterable[str], names: Iterable[str], where: str) -> None:
    """Refuse the first of the ``names`` that is ``given`` and has no effect ``where`` the message says."""
    for name in names:
        if name in given:
            raise ArgumentError(name, f"has no effect {where}; leave it out")


def _rule(message: str) -> str:
    """Return a rule of pydantic, without the words that all of them begin with."""
    return message.removeprefix("Value error, ").removeprefix("Input should be ")


def takes(model: type[Options], *leave_out: str, **defaults: Any) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Give a function that ends in ``**options`` the fields of a model as keyword arguments in its signature.

    Its other arguments are checked as :func:`mitsim.core.errors.check_arguments` does.

    Parameters
    ----------
    model
        What the function makes of its ``**options``.
    leave_out
        Fields that the function does not take by keyword.
    defaults
        Defaults that differ from the model's.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        checked = check_arguments(function)
        signature = inspect.signature(function)
        own = [each for each in signature.parameters.values() if each.kind != each.VAR_KEYWORD]
        fields = [
            inspect.Parameter(
                name,
                inspect.Parameter.KEYWORD_ONLY,
                default=defaults.get(name, each.get_default(call_default_factory=True))
                if not each.is_required()
                else inspect.Parameter.empty,
                annotation=each.annotation,
            )
            for name, each in model.model_fields.items()
            if name not in {*leave_out, *signature.parameters}
        ]
        known = {each.name for each in (*own, *fields)}

        @functools.wraps(function)
        def call(*arguments: P.args, **named: P.kwargs) -> R:
            for name in named.keys() - known:
                of = f"option of {function.__name__}"
                raise ArgumentError(
                    name, f"is no {of}; {near_name(name, known)}use {', '.join(e.name for e in fields)}"
                )
            return checked(*arguments, **named)

        call.__signature__ = signature.replace(parameters=[*own, *fields])  # type: ignore[attr-defined]
        lines = [f"    {each.name}\n        {model.model_fields[each.name].description}." for each in fields]
        call.__doc__ = "\n".join([inspect.getdoc(function) or "", "", "Options", "-------", *lines])
        return call

    return decorate

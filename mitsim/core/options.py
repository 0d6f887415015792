"""Options of verbs: a pydantic model declares each once, for Python, the command line, session files and manifests.

A field states its kind, default and limits as pydantic does, and by :func:`option` its help and how the command line
spells it. :func:`takes` gives a function the fields of a model as keyword arguments.
"""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, ParamSpec, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from mitsim.core.configuration import rule_of, shipped_files
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, is_path, near_name, plain_number, short_text

WHAT, QUALITY, DEVICES = "What", "Quality", "Scene and devices"
OUTPUT, LIMITS = "Output", "Machine and limits"
PANELS = WHAT, QUALITY, DEVICES, OUTPUT, LIMITS
"""Headings of options in the help, in the order of a page."""

P = ParamSpec("P")
R = TypeVar("R")
M = TypeVar("M", bound="Options")


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
        Further arguments of :class:`typer.Option`, such as ``metavar`` and ``show_default``; ``panel``, a heading;
        ``complete``, which lists words; ``read``, which makes the value of the word; and limits of a number: ``ge``,
        ``gt``, ``le`` and ``lt``, or ``min`` and ``max`` where the help states them.
    """
    limits: Any = {name: shown.pop(name) for name in ("ge", "gt", "le", "lt") if name in shown}
    limits |= {name: shown[own] for name, own in (("ge", "min"), ("le", "max")) if own in shown}
    extra: Any = {"names": names, "kind": kind, **shown}
    return Field(default, description=help, json_schema_extra=extra, **limits)


class _Refused(ValueError):
    """A refusal of ours, which pydantic collects with its own."""

    def of(self, name: str) -> ArgumentError:
        """Return the refusal as one of the option ``name``."""
        (error,) = self.args
        return error if isinstance(error, ArgumentError) else ArgumentError(name, re.sub(f"^{name}:? ", "", str(error)))


def validated_by(check: Callable[[Any], Any]) -> AfterValidator:
    """Return a validator of a field by a ``check``, which raises MitsimError, and returns the value or nothing."""

    def validate(value: Any) -> Any:
        try:
            result = check(value)
        except MitsimError as error:
            raise _Refused(error) from error
        return value if result is None else result

    return AfterValidator(validate)


def _can_be_path(value: Path | str) -> Path | str:
    if not is_path(value):
        raise ValueError("a path")
    return value


FilePath = Annotated[Path | str, AfterValidator(_can_be_path)]
"""Path of a file or folder, or the name of a shipped file."""


def shipped_names(field: str) -> list[str]:
    """Return the names of shipped files that have a ``field``, which a shell offers."""
    return [*shipped_files("calibration", ".toml", field)]


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
            first, *others = self._refusals(error)
            first.others = tuple(others)
            raise first from error

    @classmethod
    def _refusals(cls, error: ValidationError) -> list[ArgumentError]:
        """Return the refusal of each option that pydantic found wrong; misspelt names come first."""
        found: dict[str, ArgumentError] = {}
        errors = error.errors(include_url=False)
        for one in sorted(errors, key=lambda one: one["type"] != "extra_forbidden"):
            name, original = str(one["loc"][0]), one.get("ctx", {}).get("error")
            if isinstance(original, _Refused):
                found.setdefault(name, original.of(name))
            elif one["type"] == "extra_forbidden" and len(one["loc"]) == 1:
                found[name] = unknown_option(name, cls.VERB, [*cls.model_fields])
            elif one["type"] == "missing":
                found.setdefault(name, ArgumentError(name, "is missing; give it"))
            elif name not in found:
                rules = (rule_of(each["msg"]).removeprefix("give ") for each in errors if each["loc"][0] == name)
                rule, limits = " or ".join(dict.fromkeys(rules)), limits_of(cls.model_fields[name])
                if limits:
                    kind = "a number" if one["type"].startswith(("greater", "less")) else rule
                    rule = f"{kind} {limits}"
                found[name] = ArgumentError(name, f"{short_text(one['input'])}: give {rule}")
        return [*found.values()]

    @property
    def given(self) -> dict[str, Any]:
        """The options that were given, by name."""
        return {name: getattr(self, name) for name in type(self).model_fields if name in self.model_fields_set}

    def part(self, model: type[M]) -> M:
        """Return the options that were given of those that another ``model`` has, as that model."""
        return model(**{name: value for name, value in self.given.items() if name in model.model_fields})

    def without(self, *names: str) -> dict[str, Any]:
        """Return the options that were given, but for those of some ``names``."""
        return {name: value for name, value in self.given.items() if name not in names}

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


def limits_of(field: FieldInfo) -> str:
    """Return the range of a number that a ``field`` states, in words; empty without one."""
    names = "ge", "gt", "le", "lt"
    found = {name: getattr(mark, name) for mark in field.metadata for name in names if hasattr(mark, name)}
    ends = {name: f"{end:g}" if isinstance(end, float) else str(end) for name, end in found.items()}
    if {"ge", "le"} <= ends.keys():
        return f"from {ends['ge']} to {ends['le']}"
    words = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
    return ", ".join(f"{words[name]} {end}" for name, end in ends.items())


def takes(*models: type[Options], without: str = "") -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Give a function that ends in ``**options`` the fields of models as keyword arguments in its signature.

    Its other arguments are checked as :func:`mitsim.core.errors.check_arguments` does.

    Parameters
    ----------
    models
        What the function makes of its ``**options``.
    without
        Fields that the function does not take by keyword, with spaces between.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        checked, signature = check_arguments(function), inspect.signature(function)
        own = [each for each in signature.parameters.values() if each.kind != each.VAR_KEYWORD]
        left_out = {*without.split(), *signature.parameters}
        fields = {name: each for model in models for name, each in model.model_fields.items() if name not in left_out}

        @functools.wraps(function)
        def call(*arguments: P.args, **named: P.kwargs) -> R:
            for name in named:
                if name not in fields and name not in signature.parameters:
                    raise unknown_option(name, function.__name__, [*fields])
            return checked(*arguments, **named)

        keywords = [_keyword(name, each) for name, each in fields.items()]
        call.__signature__ = signature.replace(parameters=[*own, *keywords])  # type: ignore[attr-defined]
        lines = [f"{name}\n    {each.description}" for name, each in fields.items()]
        call.__doc__ = "\n".join([inspect.getdoc(function) or "", "", "Other Parameters", "----------------", *lines])
        return call

    return decorate


def _keyword(name: str, field: FieldInfo) -> inspect.Parameter:
    """Return the parameter of a signature that a ``field`` of a ``name`` is."""
    default = inspect.Parameter.empty if field.is_required() else field.default
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=field.annotation)


def unknown_option(name: str, function: str, known: Sequence[str]) -> ArgumentError:
    """Return the refusal of an option that a ``function`` does not have, with those that are ``known``."""
    of = f"option of {function}" if function else "such option"
    return ArgumentError(name, f"is no {of}; {near_name(name, known)}use {', '.join(known)}")

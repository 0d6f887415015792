"""Words of a command line in; what a study of many points varies and shows out, or a refusal before anything heavy is
imported."""

from __future__ import annotations

import re
from collections.abc import Sequence
from math import prod

from mitsim.bench.request import Request
from mitsim.core.errors import MitsimError
from mitsim.devices.drift import Drift
from mitsim.devices.patterns import read_name

MEASURES = {
    "psnr": ("psnr_db", "PSNR [dB]"),
    "ssim": ("ssim", "SSIM [1]"),
    "misfit": ("misfit", "misfit: part of the measurements that no image explains [1]"),
    "chi_square": ("chi_square", "chi-square of a measurement, 1 where the model fits [1]"),
    "uncertainty": ("uncertainty", "standard uncertainty, rms [reflectance]"),
    "lambda": ("lambda", "lambda, weight of the regularisation [(electrons/s)²]"),
}
"""Column of the table and axis, by what people ask for."""
CONVENTIONS = ("equal peak", "equal frame", "equal total")
"""Exposures: see :mod:`mitsim.report.exposures`."""
NO_SCENE = ("patterns", "exposure", "seed", "accuracy")
"""What a sweep may vary besides parameters of the scene."""
OTHERS = {"point", "picture", "model", "shots", "exposure_s", "flagged", "reason", "lambda", "psnr_db", "ssim"} | {
    column for column, _ in MEASURES.values()
}
"""Columns of every study's table, which are no knob."""
_NOT_FINITE = re.compile(r"\s*[+-]?(nan|inf|infinity)\s*", re.IGNORECASE)
"""As Python and Mitsuba read them."""
_LISTED = ("patterns", "exposure", "seed")
"""Knobs whose values are a list, whatever stands between its commas."""
_MOST = 10_000
"""Points of one sweep: more are a typing error."""
Sweep = Sequence[tuple[str, Sequence[str]]]
"""Knobs and their values."""


def values_of(text: str) -> tuple[str, tuple[str, ...]]:
    """Name and values of a knob in ``text``: NAME=FIRST:LAST:COUNT, evenly spaced, or NAME=VALUE,VALUE,...

    MitsimError for anything else.
    """
    name, equals, given = text.partition("=")
    ends = given.split(":")
    if not (name and equals and given):
        raise MitsimError(f"--over {text!r}: give NAME=FIRST:LAST:COUNT or NAME=VALUE,VALUE")
    if name in _LISTED or len(ends) != 3:
        return name, tuple(given.split(","))
    try:
        first, last, count = float(ends[0]), float(ends[1]), int(ends[2])
    except ValueError:
        raise MitsimError(f"--over {text!r}: {given} is not FIRST:LAST:COUNT in numbers") from None
    if not 2 <= count <= _MOST:
        raise MitsimError(f"--over {text!r}: give 2 to {_MOST} values")
    return name, tuple(f"{first + (last - first) * index / (count - 1):.6g}" for index in range(count))


def measures_of(text: str) -> tuple[str, ...]:
    """Measures named in ``text``, separated by commas; MitsimError for one that there is not."""
    names = tuple(text.split(","))
    for name in names:
        if name not in MEASURES:
            raise MitsimError(f"--measure {name!r}: use {', '.join(MEASURES)}")
    return names


def check_sweep(sweep: Sweep, pictures: int) -> None:
    """MitsimError for a ``sweep`` over so many ``pictures`` that varies nothing, or what it cannot."""
    knobs = dict(sweep)
    if not knobs:
        raise MitsimError(
            "study sweep: nothing is varied; give --over NAME=FIRST:LAST:COUNT, such as roughness=0.1:0.5:5"
        )
    if taken := OTHERS.intersection(knobs):
        raise MitsimError(f"--over {taken.pop()}: is a column of every study's table; give the parameter another name")
    if (points := pictures * prod(len(values) for values in knobs.values())) > _MOST:
        raise MitsimError(f"study sweep: {points} points; give at most {_MOST}")
    for name, text in ((name, text) for name, texts in knobs.items() for text in texts):
        if _NOT_FINITE.fullmatch(text):
            raise MitsimError(f"--over {name}={text}: give finite numbers")
    for text in knobs.get("exposure", ()):
        if text not in CONVENTIONS:
            raise MitsimError(f"--over exposure={text}: use {', '.join(CONVENTIONS)}")
    for text in knobs.get("patterns", ()):
        read_name(text)
    for name, kind in (("seed", int), ("accuracy", float)):
        for text in knobs.get(name, ()):
            Request.of(**{name: number_of(name, text, kind)})


def check_drifts(sweep: Sweep) -> None:
    """MitsimError for a ``sweep`` of anything but kinds of drift and their amounts."""
    still = Drift(power_ripple_hz=1.0, lamp_ripple_hz=1.0)  # a recipe states them, which is not read yet
    for kind, texts in sweep:
        for text in texts:
            still.alone(kind, number_of(kind, text))


def number_of(knob: str, text: str, kind: type[int] | type[float] = float) -> float:
    """A value of a knob.

    Parameters
    ----------
    knob, text
        its name and the value, as they were given.
    kind
        of number.

    Raises
    ------
    MitsimError
        for what is no such number.
    """
    try:
        return kind(text)
    except ValueError:
        raise MitsimError(f"--over {knob}={text}: give {'whole ' if kind is int else ''}numbers") from None

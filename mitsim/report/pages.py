"""What people read: rows of a study in, means with standard errors and a tidy CSV file out; numbers as text; a template
and what it shows in, one self-contained HTML page out.

Processes that measure points load this and neither templates nor figures.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mitsim.core.errors import MitsimError
from mitsim.core.files import whole_file
from mitsim.core.images import data_uri

if TYPE_CHECKING:
    from jinja2 import Environment
    from matplotlib.figure import Figure

# -------- Pages

_SHOWN_DPI = 110
"""Figures are 8.6 inches wide at most: 946 pixels of the page."""


def render_page(template: str, filters: Mapping[str, Callable[..., str]] | None = None, **shown: Any) -> str:
    """A page as text.

    Parameters
    ----------
    template
        file of ``mitsim/report/templates``.
    filters
        of its own, by name, beside ``sci`` and ``seconds`` of a number, ``typeset`` of a text and ``sentence`` of a
        warning.
    **shown
        what it shows, by the names that it has there; one that is missing is an error.
    """
    return _environment(tuple((filters or {}).items())).get_template(template).render(**shown)


@cache
def _environment(filters: tuple[tuple[str, Callable[..., str]], ...]) -> Environment:
    """Templates with these ``filters``, kept for the next page: to compile them takes longer than to fill them."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("mitsim.report")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    own = {"sci": scientific, "typeset": typeset, "sentence": sentence, "seconds": duration}
    environment.filters.update({**own, **dict(filters)})
    return environment


def page_figure(figure: Figure) -> tuple[str, int]:
    """A figure for a page: an SVG, sharp at any size, of a third of a PNG's bytes; the same of the same figure.

    Parameters
    ----------
    figure
        drawn.

    Returns
    -------
    tuple of str and int
        its data URI, and how wide it is shown [pixels].
    """
    from matplotlib import rc_context

    with rc_context({"svg.hashsalt": "mitsim"}):  # names inside the file; without it they are random
        figure.savefig(buffer := BytesIO(), format="svg", metadata={"Date": None})
    return data_uri(buffer.getvalue(), "svg+xml"), round(float(figure.get_figwidth()) * _SHOWN_DPI)


def written_figure(figure: Figure, path: Path) -> tuple[str, int]:
    """The same of a ``figure`` that was written to the PNG file ``path``, which takes no time."""
    return data_uri(path.read_bytes(), "png"), round(float(figure.get_figwidth()) * _SHOWN_DPI)


def figure_uri(figure: Figure, dots_per_inch: int) -> str:
    """A figure as a data URI.

    Parameters
    ----------
    figure
        drawn.
    dots_per_inch
        of its picture.
    """
    figure.savefig(buffer := BytesIO(), format="png", dpi=dots_per_inch)
    return data_uri(buffer.getvalue())


# -------- Numbers and plain text in, the same as a page or a figure prints them out

DASH = "\N{EN DASH}"
"""Where there is no number."""
_SUPERSCRIPT = str.maketrans("+-0123456789", "⁺⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_TIMES = "\N{MULTIPLICATION SIGN}"
_POWER = re.compile(r"(?<![\w.])(\d+(?:\.\d+)?)e([+-]?\d+)(?![\w.]\w)")
"""A number such as 4.9e-03, and neither a part of a name nor of a longer number."""
_SIZE = re.compile(r"(?<![\w:.])(\d+(?:\.\d+)?)( ?)x\2(?=\d+(?:\.\d+)?(?![\w:]))")
"""512 x 512 and 3x3, but not dots:7x16."""


def scientific(value: float | None) -> str:
    """A number of three digits, a ``value`` below 0.01 or from 10,000 on of two with a power of ten; None as a dash."""
    if value is None or value == 0.0:
        return DASH if value is None else "0"
    if 1e-2 <= abs(value) < 1e4:
        return f"{value:.0f}" if abs(value) >= 99.95 else f"{value:#.3g}"
    return typeset(f"{value:.1e}")


def duration(value: float) -> str:
    """Seconds, a ``value``, in three digits."""
    return f"{value:.2f} s" if value < 10 else f"{value:.1f} s" if value < 100 else f"{value:.0f} s"


def round_to_error(value: float, error: float) -> str:
    """A number to the second digit of its standard error.

    Parameters
    ----------
    value, error
        in one unit; an error of 0, or none that is finite, leaves five digits.
    """
    if not (error > 0 and math.isfinite(error) and math.isfinite(value)):
        return f"{value:.5g}"
    places = 1 - math.floor(math.log10(error))
    return f"{round(value, places) + 0.0:.{max(places, 0)}f}"


def reflectance(value: float) -> str:
    """An error in reflectance, its ``value``: four places, as all are below 1 and few below 0.001."""
    return f"{value:.4f}" if value >= 1e-3 else scientific(value)


def with_error(value: float, error: float, unit: str = "") -> str:
    """A number and its standard error, neither finer than 0.01: to the second digit of the error, without one that
    rounds to nothing.

    Parameters
    ----------
    value, error, unit
        in one unit, which stands behind both.
    """
    places = min(max(1 - math.floor(math.log10(error)), 0), 2) if error > 0 else 2
    deviation = f" \N{PLUS-MINUS SIGN} {error:.{places}f}" if round(error, 2) else ""
    # Zero has no sign.
    return f"{value:z.{places}f}".replace("-", "\N{MINUS SIGN}") + deviation + unit


def sentence(text: str) -> str:
    """A warning ``text`` of the command line as a sentence: a capital first, a full stop last."""
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def typeset(text: str) -> str:
    """A ``text`` for people: 4.9e-03 as a power of ten and 4.9e-02 without one, +- as one sign, 512 x 512 with a times
    sign, um with a Greek letter."""
    text = _POWER.sub(_power, text).replace("+-", "\N{PLUS-MINUS SIGN}")
    text = _SIZE.sub(rf"\1\2{_TIMES}\2", text)
    return re.sub(r"(?<=[\d\[(] )um\b|(?<=[\[(/])um\b", "\N{GREEK SMALL LETTER MU}m", text)


def _power(found: re.Match[str]) -> str:
    mantissa, exponent = found[1], int(found[2])
    if not float(mantissa):
        return "0"
    if mantissa != "1" and 1e-2 <= float(found[0]) < 1e4:  # as ``scientific`` prints it, with the digits that it has
        return f"{float(found[0]):.{max(len(mantissa.partition('.')[2]) - exponent, 0)}f}"
    power = f"10{str(exponent).translate(_SUPERSCRIPT)}"
    return power if float(mantissa) == 1 and "." not in mantissa else f"{mantissa}{_TIMES}{power}"


# -------- Rows of a study in, their means out

Value = str | int | float | bool | None
_SEEN = 0.05
"""Error from which one place shows it: less would be 0.0, which is no error."""


class Mean(NamedTuple):
    """A mean, its standard error (NaN of a single value), and how many values it is of."""

    value: float
    error: float
    of: int

    def __str__(self) -> str:
        return format(self)

    def __format__(self, sign: str) -> str:
        """With its error; ``sign`` is "+" for a number that always shows its own."""
        if math.isnan(self.error):
            return f"{self.value:{sign}.1f}"
        places = 1 if self.error >= _SEEN else 2
        return f"{self.value:{sign}.{places}f} \N{PLUS-MINUS SIGN} {self.error:.{places}f}"

    @classmethod
    def of_numbers(cls, numbers: Sequence[float], what: str) -> Mean:
        """Of independent ``numbers``; MitsimError that nothing was measured of ``what`` where there are none."""
        if not numbers:
            raise MitsimError(f"study: nothing was measured of {what}")
        array = np.array(numbers)
        error = float(array.std(ddof=1) / math.sqrt(len(array))) if len(array) > 1 else math.nan
        return cls(float(array.mean()), error, len(array))


@dataclass(frozen=True)
class Table:
    """Rows of named values, one for each thing measured; a value that a row does not have is None."""

    rows: tuple[Mapping[str, Value], ...]

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of all values, in the order of first use."""
        return tuple(dict.fromkeys(name for row in self.rows for name in row))

    def where(self, **values: Value) -> Table:
        """Rows that have these ``values``."""
        return Table(tuple(row for row in self.rows if all(row.get(name) == value for name, value in values.items())))

    def distinct(self, name: str) -> list[Any]:
        """Different values of the column ``name``, in the order of first use."""
        return list(dict.fromkeys(row[name] for row in self.rows if row.get(name) is not None))

    def mean(self, name: str, **values: Value) -> Mean:
        """Mean of the column ``name`` over rows with these ``values``.

        MitsimError where there is none.
        """
        wanted = ", ".join(f"{key} = {value}" for key, value in values.items())
        return Mean.of_numbers(self.numbers(name, **values), f"{name} with {wanted}" if wanted else name)

    def numbers(self, name: str, **values: Value) -> list[float]:
        """Column ``name`` of the rows with these ``values``, where it has a number."""
        chosen = self.where(**values).rows
        return [float(value) for row in chosen if isinstance(value := row.get(name), (int, float))]

    def means(self, name: str, by: str) -> dict[Any, Mean]:
        """:meth:`mean` of the column ``name`` for each value of the column ``by`` that it has numbers at."""
        return {
            value: self.mean(name, **{by: value}) for value in self.distinct(by) if self.numbers(name, **{by: value})
        }

    def write(self, path: Path) -> None:
        """To the CSV file ``path``, a header line first, all or nothing; MitsimError when it cannot be written."""
        with whole_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self.columns)
            writer.writeheader()
            writer.writerows(self.rows)

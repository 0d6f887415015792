"""Rows of a study in; means with standard errors, and a tidy CSV file, out.

Processes that measure points load this and no figures.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mitsim.core.errors import MitsimError
from mitsim.core.files import whole_file

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

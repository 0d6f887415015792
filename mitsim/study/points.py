"""Findings of points on disk: each point a file, there whole or not at all, so that work goes on where it stopped."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from mitsim.core.errors import MitsimError
from mitsim.core.output import sweep, whole_file
from mitsim.core.plainfile import check_plain
from mitsim.study.experiment import Found, Point, Results

_ROWS = "rows"


@dataclass(frozen=True)
class Store:
    """The findings in a ``folder``, which exists."""

    folder: Path

    def has(self, point: Point) -> bool:
        """Whether a ``point`` is measured."""
        return self._file(point).is_file()

    def save(self, point: Point, found: Found) -> None:
        """Keep what was ``found`` at a ``point``; MitsimError when it cannot be written."""
        import numpy as np

        rows = np.frombuffer(json.dumps([dict(row) for row in found.rows]).encode(), dtype=np.uint8)
        with whole_file(self._file(point)) as part, part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **{_ROWS: rows, **found.arrays})  # type: ignore[arg-type]

    def load(self, point: Point) -> Found:
        """What was found at a ``point``; MitsimError when the file is damaged."""
        from mitsim.core.arrayfile import read_npz

        path = self._file(point)
        try:
            if not check_plain(path).st_size:
                raise ValueError("it is empty: the disk was full, or the machine stopped")
            with path.open("rb") as file:
                arrays = read_npz(file, path)
            rows = json.loads(arrays.pop(_ROWS).tobytes())
            if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
                raise ValueError("its rows are none")
            return Found(tuple(rows), arrays)
        except (OSError, ValueError, KeyError, RecursionError) as error:
            raise MitsimError(
                f"file {path}: cannot be read as a point of a study ({error}); remove it and run again"
            ) from error

    def take(self, other: Store) -> None:
        """Copy what an ``other`` store has and this one has not."""
        for file in sorted(other.folder.glob("*.npz")):
            if not (self.folder / file.name).exists():
                check_plain(file)
                with whole_file(self.folder / file.name) as part:
                    shutil.copyfile(file, part)

    def results(self, points: Iterable[Point]) -> Results:
        """Everything found at ``points``, in their order."""
        from mitsim.study.table import Table

        found = {point.key: self.load(point) for point in points}
        rows = tuple({**row, "point": key} for key, each in found.items() for row in each.rows)
        arrays = {(key, name): array for key, each in found.items() for name, array in each.arrays.items()}
        return Results(Table(rows), arrays)

    def tidy(self) -> None:
        """Remove what killed processes left half-written."""
        sweep(self.folder)

    def _file(self, point: Point) -> Path:
        return self.folder / f"{point.key}.npz"


def batches(points: Sequence[Point]) -> list[tuple[Point, ...]]:
    """The ``points`` in their order, those of one setup together: they share its light."""
    return [tuple(group) for _, group in groupby(points, key=lambda point: point.setup)]


@dataclass(frozen=True)
class Shard:
    """Part ``number`` of ``count``, from 1 on, of a study that several jobs of a cluster share."""

    number: int = 1
    count: int = 1

    @classmethod
    def of(cls, text: str) -> Shard:
        """From a ``text`` such as 2/8; MitsimError for anything else."""
        number, slash, count = text.partition("/")
        if not (slash and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
            raise MitsimError(f"--shard {text!r}: give I/N with I from 1 to N, such as 1/4")
        return cls(int(number), int(count))

    def part(self, points: Sequence[Point]) -> list[Point]:
        """The ``points`` of this part: every ``count``-th batch, as a batch's light is traced once."""
        own = batches(points)[self.number - 1 :: self.count]
        return [point for batch in own for point in batch]

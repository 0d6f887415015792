"""Arguments, result files, tables, rates and seconds that the benchmarks share."""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # for the judges that live with the tests


def arguments(description: str, seed: bool = False, required: bool = False) -> argparse.ArgumentParser:
    """Return a parser with ``--json FILE`` (a ``required`` one is gone on with), and ``--seed`` if asked for."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=required, metavar="FILE", help="file of results")
    if seed:
        parser.add_argument("--seed", type=int, default=0, help="another draws other runs")
    return parser


def held(path: Path | None, empty: Any) -> Any:
    """Return what a result file holds, so that an interrupted benchmark goes on; ``empty`` where there is none."""
    return json.loads(path.read_text(encoding="utf-8")) if path and path.is_file() else empty


def write(path: Path | None, results: Any) -> None:
    """Write all results so far; nothing without a file."""
    if path:
        part = path.with_suffix(".part")
        part.write_text(json.dumps(results, indent=1, default=str) + "\n", encoding="utf-8")
        part.replace(path)


def show(label: str, row: Mapping[str, Any]) -> None:
    """Print one result on one line, numbers with three digits."""
    cells = (f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}" for name, value in row.items())
    print(f"{label}: {', '.join(cells)}", flush=True)


def interval(right: int, of: int) -> list[float]:
    """Return a rate and its 95 % interval after Wilson (1927)."""
    z, rate = 1.96, right / of
    middle, half = rate + z * z / 2 / of, z * np.sqrt(rate * (1 - rate) / of + z * z / 4 / of**2)
    return [float(value) for value in (rate, (middle - half) / (1 + z * z / of), (middle + half) / (1 + z * z / of))]


def ratios(values: Sequence[float]) -> dict[str, float]:
    """Return least, 5 %, median, 95 % and most of ratios, such as stated over actual error."""
    return dict(zip(("least", "5 %", "median", "95 %", "most"), np.quantile(values, [0, 0.05, 0.5, 0.95, 1]).tolist()))  # noqa: B905


def median_seconds(work: Callable[[], object], repeat: int) -> float:
    """Return the median time of warm calls [s]."""
    times = []
    for _ in range(repeat + 1):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times[1:])


def lost(rows: Sequence[Mapping[str, Any]], old: Path, key: Callable[[Mapping[str, Any]], Any]) -> list[Any]:
    """Return and print the runs that an earlier result file has as flagged and that are not flagged now."""
    before = {key(row): row for row in json.loads(old.read_text(encoding="utf-8"))["rows"]}
    pairs = [(row, before[key(row)]) for row in rows if key(row) in before]
    gone = [row for row, earlier in pairs if earlier["flagged"] and not row["flagged"]]
    print(f"flagged in {old.name} and not now: {len(gone)} of {sum(earlier['flagged'] for _, earlier in pairs)}")
    for row in gone:
        print(f"  {key(row)}: {row['verdict']}")
    return gone

"""Commit ca61f08 and this checkout in turn: seconds of first and later captures by stage, at their measured errors.

    python benchmarks/versions.py --json FILE [--scene NAME ...] [--pairs 5] [--old COMMIT] [--quick]

The earlier version runs from a worktree beside FILE with the packages of this one's environment. Of each pair, seeds 0
to 4, either version captures dots:7 at 1e-3 three times in processes of their own, from the shell to their exit, with
a home of its own that holds no kernels: the *first* run compiles them, the second is not counted, the third is the
*later* one. Which version begins changes from pair to pair. The error is that of :mod:`accuracy`, against the same
answer for both, which is made beside FILE where it is missing. ``equal`` is how many times the later run of the earlier
version is longer than this one's at equal error: if this one's error over all seeds is the larger, its light is counted
for as many more samples as would make it equal. ``predicted``: seconds that the plan predicted over those taken, of
every run. ``--quick``: one pair of one scene, against a noisy answer. What FILE holds already is not repeated. The last
lines say of every limit whether it is kept.
"""

from __future__ import annotations

import os
import platform
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import accuracy
import numpy as np
from harness import ROOT, arguments, held, write

OLD_COMMIT = "ca61f08"
WHOLE = {
    "photograph": 1.6, "gift_card": 3.2, "compact_disc": 3.2, "metal_blade": 3.2, "corner": 6.5, "cookie_bag": 8.5,
}  # fmt: skip
"""Scenes, and the seconds below which their later runs are to stay."""
PLAN_PART, PLAN_S = 0.15, 1.0
"""Of a later run, and seconds, that its plan may take."""
FIRST_TIMES, FIRST_S = 1.5, 1.0
"""Times a later run, and seconds beyond, that a first one may take."""
PREDICTED = 0.67, 1.5
"""Predicted over taken seconds."""
QUICK_NOISE = 5e-3
Run = Mapping[str, Any]


def worktree(folder: Path, commit: str) -> Path:
    """The ``commit`` in a worktree of its own in ``folder``, where it is not there."""
    if not folder.exists():
        command = ["git", "-C", str(ROOT), "worktree", "add", "-f", "--quiet", "--detach", str(folder), commit]
        subprocess.run(command, check=True)
    return folder.resolve()


def turns(scene: str, wanted: float, tree: Path | None, seed: int) -> Iterator[dict[str, Any]]:
    """The first and the later run of the version in ``tree`` (this one without), as :func:`accuracy.captured`."""
    with tempfile.TemporaryDirectory() as home:
        for counted in (True, False, True):
            run = accuracy.captured(scene, wanted, tree, seed, Path(home))
            if counted:
                yield run


def facts_of(run: Run) -> dict[str, Any]:
    """Seconds of a run by stage, predicted and taken; ``whole`` from the shell to its exit."""
    manifest = run["manifest"]
    stages, predicted = manifest["seconds"], manifest["plan"]["predicted_seconds"]
    return {
        "whole": run["seconds"],
        "processor": run["processor_seconds"],
        "plan": stages["plan"],
        "stages": stages,
        "predicted": predicted / stages["total"],
        "predicted_stages": manifest["plan"]["predicted"],
    }


def measured(scene: str, tree: Path | None, seed: int, halves: Any) -> dict[str, Any]:
    """First and later run of one version, with the later one's error against the answer's ``halves``."""
    first, later = turns(scene, accuracy.PROMISED, tree, seed)
    shares = accuracy.held_against(halves, scene, later)["shares"]
    return {"first": facts_of(first), "later": facts_of(later), "shares": shares}


def summary(pairs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Medians over pairs of each version's first and later runs, their errors over all, and how they compare."""
    found: dict[str, Any] = {}
    for name in pairs[0]:
        runs = [pair[name] for pair in pairs]
        found[name] = {kind: _medians([run[kind] for run in runs]) for kind in ("first", "later")}
        found[name] |= accuracy.bracketed(*np.mean([run["shares"] for run in runs], axis=0))
    more = max(1.0, (found["new"]["error"] / found["old"]["error"]) ** 2) if found["old"]["error"] else 1.0
    found["ratios"] = {kind: _ratio(pairs, kind) for kind in ("first", "later")}
    found["ratios"] |= {"equal": _ratio(pairs, "later", more), "more_samples": more}
    return found


def _medians(runs: Sequence[Run]) -> dict[str, Any]:
    names = [name for name in runs[0]["stages"] if all(name in run["stages"] for run in runs)]
    predicted = [run["predicted"] for run in runs]
    return {
        **{key: statistics.median(run[key] for run in runs) for key in ("whole", "processor", "plan", "predicted")},
        "plan_part": statistics.median(run["plan"] / run["whole"] for run in runs),
        "predicted_range": [min(predicted), max(predicted)],
        "stages": {name: statistics.median(run["stages"][name] for run in runs) for name in names},
    }


def _ratio(pairs: Sequence[Mapping[str, Any]], kind: str, more: float = 1.0) -> float:
    """Median over ``pairs`` of the earlier version's seconds over this one's with ``more`` samples."""
    ratios = []
    for pair in pairs:
        new = pair["new"][kind]
        ratios.append(pair["old"][kind]["whole"] / (new["whole"] + (more - 1) * new["stages"]["transport"]))
    return statistics.median(ratios)


def limits(scene: str, found: Mapping[str, Any]) -> dict[str, tuple[float, bool]]:
    """What of this version has a limit in a ``scene``: its value, and whether it keeps it."""
    first, later = found["new"]["first"], found["new"]["later"]
    kept = {
        "first - 1.5 later": (first["whole"] - FIRST_TIMES * later["whole"], FIRST_S),
        "plan": (later["plan"], PLAN_S),
        "plan part": (later["plan_part"], PLAN_PART),
        "whole": (later["whole"], WHOLE[scene]),
    }
    checked = {name: (value, value <= most) for name, (value, most) in kept.items()}
    for kind, runs in (("first", first), ("later", later)):
        least, most = runs["predicted_range"]
        checked[f"predicted, {kind}"] = runs["predicted"], PREDICTED[0] <= least and most <= PREDICTED[1]
    return checked


def table(cases: Mapping[str, Any]) -> str:
    """A line for each version of each scene, and the limits."""
    heads = f"{'scene':<22}{'first: plan / all':>19}{'later: plan / all':>19}{'processor':>11}{'plan part':>11}"
    lines = [f"{heads}{'predicted':>11}{'error':>9}"]
    for scene, case in cases.items():
        found = case["summary"]
        for name in ("old", "new"):
            row = found[name]
            pairs = (f"{row[kind]['plan']:.2f} / {row[kind]['whole']:.2f}" for kind in ("first", "later"))
            later = row["later"]
            lines.append(
                f"{f'{scene} {name}':<22}{''.join(f'{pair:>19}' for pair in pairs)}{later['processor']:>11.2f}"
                f"{later['plan_part']:>11.0%}{later['predicted']:>11.2f}{row['error']:>9.1e}"
            )
        first, later, equal = (found["ratios"][name] for name in ("first", "later", "equal"))
        count = len(case["pairs"])
        lines.append(f"  {count} pairs: first {first:.2f}, later {later:.2f}, at equal error {equal:.2f} times as fast")
        limited = [
            f"{name} {value:.2f} {'kept' if kept else 'NOT KEPT'}"
            for name, (value, kept) in limits(scene, found).items()
        ]
        lines.append(f"  {', '.join(limited)}")
    return "\n".join(lines)


def main() -> None:
    parser = arguments(__doc__, required=True)
    parser.add_argument("--scene", action="append", default=[], choices=list(WHOLE), metavar="NAME")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--old", default=OLD_COMMIT, metavar="COMMIT")
    parser.add_argument("--noise", type=float, default=accuracy.NOISE)
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    if options.quick:
        options.scene, options.pairs = options.scene or ["photograph"], 1
        options.noise = max(options.noise, QUICK_NOISE)
    results = held(options.json, {"cases": {}})
    results |= {"machine": f"{platform.machine()}, {os.cpu_count()} processors", "old": options.old}
    trees = {"old": worktree(options.json.with_suffix(f".{options.old}"), options.old), "new": None}
    for tree in trees.values():
        accuracy.captured("photograph", 1e-2, tree)  # writes byte code
    for scene in options.scene or WHOLE:
        case = results["cases"].setdefault(scene, {})
        halves = accuracy.answer_of(scene, options.json, options.noise)
        pairs = case.setdefault("pairs", [])
        while len(pairs) < options.pairs:
            seed = len(pairs)
            order = list(trees) if seed % 2 == 0 else list(reversed(trees))
            pairs.append({name: measured(scene, trees[name], seed, halves) for name in order})
            case["summary"] = summary(pairs)
            write(options.json, results)
            taken = ", ".join(f"{name} {pairs[-1][name]['later']['whole']:.1f} s" for name in trees)
            print(f"{scene}, pair {len(pairs)}: {taken}", file=sys.stderr, flush=True)
    print(table(results["cases"]))


if __name__ == "__main__":
    main()

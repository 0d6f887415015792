"""Commit ca61f08 and this checkout in turn: seconds of first and later captures by stage, at their measured errors.

    python benchmarks/versions.py --json FILE [--scene NAME ...] [--own] [--pairs 5] [--old COMMIT] [--quick]

The earlier version runs from a worktree beside FILE with the packages of this one's environment. Of each pair, seeds 0
to 4, either version captures dots:7 at 1e-3 three times in processes of their own, from the shell to their exit, with
a home of its own that holds no kernels: the *first* run compiles them, the second is not counted, the third is the
*later* one. Which version begins changes from pair to pair. What LLVM there is, and byte code, are known before. The
error is that of :mod:`accuracy`, against the same answer for both, which stands beside FILE and is made where it is
missing. ``equal`` is how many times the later run of the earlier version is longer than this one's at equal error:
where this one's error, over all seeds, is the larger, its light is counted for as many more samples as would make it
equal; where it is the smaller, nothing is. The plan is a stage of its own; the *floor* beside it is what this version's
kernels and products take alone (:mod:`floors`). ``predicted``: seconds that the plan foretold over those it took, of
every run. ``--own``: the same of this version alone on ten scenes that are no shipped ones (:mod:`foreign_scenes`), at
1e-2, without errors and floors. ``--quick``: one pair of one scene, against a noisy answer. What FILE holds
already is not repeated. A line in the end says of every limit whether it is kept.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import accuracy
import floors
import foreign_scenes
import numpy as np

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
OWN = (
    *("half_card", "leaf", "window", "two_balls", "plate_0.01", "cylinder", "lamp_behind_pane", "mirror_strip"),
    *("instances", "bumps"),
)
OWN_ACCURACY, QUICK_NOISE = 1e-2, 5e-3
Run = Mapping[str, Any]


def worktree(folder: Path, commit: str) -> Path:
    """The ``commit`` in a worktree of its own in ``folder``, where it is not there."""
    if not folder.exists():
        command = ["git", "-C", str(accuracy.ROOT), "worktree", "add", "-f", "--quiet", "--detach", str(folder), commit]
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


def measured(scene: str, wanted: float, tree: Path | None, seed: int, halves: Any) -> dict[str, Any]:
    """First and later run of one version, with the later one's error where there is an answer, ``halves``."""
    first, later = turns(scene, wanted, tree, seed)
    found: dict[str, Any] = {"first": facts_of(first), "later": facts_of(later)}
    if halves is not None:
        found["shares"] = accuracy.held_against(halves, scene, later)["shares"]
    return found


def summary(pairs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Medians over pairs of each version's first and later runs, their errors over all, and how they compare."""
    found: dict[str, Any] = {}
    for name in pairs[0]:
        runs = [pair[name] for pair in pairs]
        found[name] = {kind: _medians([run[kind] for run in runs]) for kind in ("first", "later")}
        if "shares" in runs[0]:
            found[name] |= accuracy.bracketed(*np.mean([run["shares"] for run in runs], axis=0))
    if "old" in found:
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
    kept = {"first - 1.5 later": (first["whole"] - FIRST_TIMES * later["whole"], FIRST_S)}
    if scene in WHOLE:
        kept |= {
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
    """A line for each version of each scene, its floor, and the limits, for people."""
    heads = f"{'scene':<22}{'first: plan / all':>19}{'later: plan / all':>19}{'processor':>11}{'plan part':>11}"
    lines = [f"{heads}{'predicted':>11}{'error':>9}{'floor':>7}"]
    for scene, case in cases.items():
        found = case["summary"]
        for name in (each for each in ("old", "new") if each in found):
            row = found[name]
            pairs = (f"{row[kind]['plan']:.2f} / {row[kind]['whole']:.2f}" for kind in ("first", "later"))
            later = row["later"]
            floor = f"{case['floor']['floor']:.2f}" if name == "new" and "floor" in case else ""
            error = f"{row['error']:.1e}" if "error" in row else ""
            lines.append(
                f"{f'{scene} {name}':<22}{''.join(f'{pair:>19}' for pair in pairs)}{later['processor']:>11.2f}"
                f"{later['plan_part']:>11.0%}{later['predicted']:>11.2f}{error:>9}{floor:>7}"
            )
        if "ratios" in found:
            ratios = found["ratios"]
            lines.append(
                f"  {len(case['pairs'])} pairs: first {ratios['first']:.2f}, later {ratios['later']:.2f}, at equal "
                f"error {ratios['equal']:.2f} times as fast"
            )
        told = (f"{name} {value:.2f} {'kept' if kept else 'NOT KEPT'}" for name, (value, kept) in
                limits(scene, found).items())  # fmt: skip
        lines.append(f"  {', '.join(told)}")
    return "\n".join(lines)


def answer_of(scene: str, file: Path, noise: float) -> Any:
    """What frames of a ``scene`` are held against, as :mod:`accuracy` keeps it beside ``file``."""
    kept = file.with_suffix(f".{scene}.npy")
    if not kept.exists():
        np.save(kept, accuracy.answer(scene, noise))
    return np.load(kept)


def _pairs(
    case: dict[str, Any], scene: str, wanted: float, trees: Mapping[str, Path | None], count: int, halves: Any,
    save: Callable[[], None],
) -> None:  # fmt: skip
    """Run the pairs of a ``case`` that are missing, with seeds 0, 1, ...; ``save`` after each."""
    pairs = case.setdefault("pairs", [])
    while len(pairs) < count:
        seed = len(pairs)
        order = list(trees) if seed % 2 == 0 else list(reversed(trees))
        found = {name: measured(scene, wanted, trees[name], seed, halves) for name in order}
        pairs.append({name: found[name] for name in trees})
        case["summary"] = summary(pairs)
        save()
        taken = ", ".join(f"{name} {found[name]['later']['whole']:.1f} s" for name in trees)
        print(f"{scene}, pair {len(pairs)}: {taken}", file=sys.stderr, flush=True)


def main() -> None:
    """Measure what is asked for, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--scene", action="append", default=[], choices=list(WHOLE), metavar="NAME")
    parser.add_argument("--own", action="store_true")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--old", default=OLD_COMMIT, metavar="COMMIT")
    parser.add_argument("--noise", type=float, default=accuracy.NOISE)
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    if options.quick:
        options.scene, options.pairs = options.scene or ([] if options.own else ["photograph"]), 1
        options.noise = max(options.noise, QUICK_NOISE)
    results: dict[str, Any] = json.loads(options.json.read_text()) if options.json.exists() else {"cases": {}}
    results |= {"machine": f"{platform.machine()}, {os.cpu_count()} processors", "old": options.old}
    cases = results["cases"]

    def save() -> None:
        options.json.write_text(json.dumps(results, indent=1) + "\n")

    shipped = options.scene or (() if options.own else WHOLE)
    trees: dict[str, Path | None] = {"new": None}
    if shipped:
        trees = {"old": worktree(options.json.with_suffix(f".{options.old}"), options.old), "new": None}
    for tree in trees.values():
        accuracy.captured("photograph", OWN_ACCURACY, tree)  # writes byte code
    own = foreign_scenes.write(options.json.with_suffix(".scenes")) if options.own else {}
    for name in (OWN[:1] if options.quick else OWN) if own else ():
        _pairs(cases.setdefault(name, {}), str(own[name]), OWN_ACCURACY, {"new": None}, options.pairs, None, save)
    for scene in shipped:
        case = cases.setdefault(scene, {})
        halves = answer_of(scene, options.json, options.noise)
        _pairs(case, scene, accuracy.PROMISED, trees, options.pairs, halves, save)
        if "floor" not in case:
            case["floor"] = floors.measured(scene, accuracy.PATTERNS, accuracy.PROMISED)
            save()
    print(table(cases))


if __name__ == "__main__":
    main()

"""Hostile inputs through the command line: how each kind ends, in how many lines, seconds and bytes of memory.

    python benchmarks/hostile.py --json FILE [--count 1000] [--seed 0] [--kind pictures ...]

Inputs are made from a seed: good files of every kind that mitsim reads with bytes changed, and files that lie in one
place. Each goes through its verb in a process that is forked for it, as the command line runs there, without the parent
that would watch it, so that a crash in native code is seen. Ends with 1, and names them, where an input gives a
traceback, a fault of mitsim's own, or another status than 0, 1 or 2; a refusal of other than one printable line, or by
which a file is left, lost or changed; or where one takes more than ``SECONDS`` of processor time or ``MEMORY``. FILE
has a row for each kind and one for each input, is written as the work goes, and is gone on with where it holds rows of
the same seed and the same code.
"""

from __future__ import annotations

import hashlib
import importlib
import os
import pkgutil
import random
import re
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import hostile_texts as texts
import psutil
from harness import arguments, held, show, write
from hostile_files import Good, Make, arrays, changed, hdf5, matlab, openexr, pictures, saved

import mitsim.cli
from mitsim.core.errors import MitsimError

SECONDS, MEMORY = 20.0, 2 << 30
"""Of one input: processor time, so that a busy machine makes no verdict, and memory beyond what the command has when it
starts. Refusals take 0.3 s; the largest good frame, of 64 megapixels, some 6 s and 1.6 GB."""
_ALARM = 600
"""Seconds after which an input counts as hanging, on a machine that is busy too."""


@dataclass
class Outcome:
    """How one input ended."""

    kind: str
    seed: int
    command: list[str]
    status: int
    lines: int
    seconds: float
    processor_seconds: float
    memory_bytes: int
    broken: list[str] = field(default_factory=list)
    said: str = ""


BEFOREHAND = "core devices sensor scene bench acquire reconstruct report studies exchange sessions".split()
"""Rooms whose modules commands import where they use them: all before the first input, which then takes no second."""
KINDS: dict[str, tuple[int, list[Callable[[Good], Make]]]] = {
    "pictures": (11, [pictures]),
    "pictures, bytes": (8, [changed(name) for name in ("a.png", "a.tif", "b.tif", "a.npy", "a.exr")]),
    "pictures, as programs write them": (9, [saved]),
    "OpenEXR": (6, [openexr]),
    "HDF5": (7, [hdf5]),
    "HDF5, bytes": (3, [changed("run.h5")]),
    "HDF5 and MATLAB, other types": (8, [arrays]),
    "MATLAB": (7, [matlab]),
    "MATLAB, bytes": (3, [changed("run.mat")]),
    "images of sense": (4, [changed("light.npy"), changed("light.exr")]),
    "studies": (5, [texts.studies]),
    "manifests": (13, [texts.manifests]),
    "sessions": (6, [texts.sessions]),
    "folders that are repeated": (6, [texts.repeats]),
    "sessions that go on": (6, [texts.resumed]),
    "sessions with a bad step": (6, [texts.steps]),
    "devices": (12, [texts.devices]),
    "masks": (2, [texts.masks]),
    "places": (7, [texts.places]),
    "arguments": (4, [texts.arguments]),
    "scenes": (4, [texts.scenes]),
    "scenes, changed": (7, [texts.changed_scenes]),
}
"""Share of all inputs, and what makes them."""


CHECKED = "devices", "scenes, changed"
"""Kinds that are tried as far as the renderer, which takes seconds to load: what passes all checks is refused there."""


def unloaded(*_: object, **__: object) -> None:
    """In place of what loads a scene into the renderer."""
    raise MitsimError("the scene and its devices passed")


def serve(kind: str, command: Sequence[str], stdout: Path, stderr: Path) -> None:
    """Run a command as the worker does, in this process, and end it."""
    if kind in CHECKED:
        bench = [vars(module) for name, module in sys.modules.items() if name.startswith("mitsim.bench.")]
        (opening,) = [names for names in bench if "_load" in names]
        opening["_load"] = unloaded
    for number, path in ((1, stdout), (2, stderr)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    signal.alarm(_ALARM)
    sys.argv = ["mitsim", *command]
    status = 70
    try:
        mitsim.cli.run()
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else 1
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def tried(kind: str, seed: int, make: Make) -> Outcome:
    """One input, made and run; what it broke."""
    with tempfile.TemporaryDirectory(prefix="mitsim-hostile-") as name:
        folder = Path(name)
        work = folder / "work"
        work.mkdir()
        command = [*make(random.Random(f"{kind} {seed}"), work)]
        before = listed(work)
        started, held = time.perf_counter(), psutil.Process().memory_info().rss
        child = os.fork()
        if not child:
            serve(kind, command, folder / "stdout", folder / "stderr")
        _, ended, usage = os.wait4(child, 0)
        outcome = Outcome(
            kind,
            seed,
            [word.encode(errors="backslashreplace").decode() for word in command],
            os.waitstatus_to_exitcode(ended),
            0,
            round(time.perf_counter() - started, 3),
            round(usage.ru_utime + usage.ru_stime, 3),
            max(usage.ru_maxrss * 1024 - held, 0),
        )
        message = (folder / "stderr").read_bytes().decode(errors="backslashreplace")
        judge(outcome, message, before, listed(work))
        return outcome


def judge(
    outcome: Outcome, message: str, before: dict[str, tuple[int, ...]], after: dict[str, tuple[int, ...]]
) -> None:
    """Add to an ``outcome`` what it broke, by what it ``message`` on stderr and what its folder held before and
    after."""
    lines = [line for line in message.split("\n") if line]
    status, broken, outcome.lines = outcome.status, outcome.broken, len(lines)
    if status not in (0, 1, 2):
        broken.append(f"status {status}")
    if "Traceback" in message or "a fault of mitsim's own" in message:
        broken.append("traceback")
    if status == 2 and not is_refusal(lines):
        broken.append(f"{len(lines)} lines of a refusal")
    if not all(line.isprintable() for line in lines):
        broken.append("control characters")
    if status == 2 and (changed := sorted(path for path in {*before, *after} if before.get(path) != after.get(path))):
        broken.append(f"left, lost or changed: {changed[:3]}")
    if outcome.processor_seconds > SECONDS:
        broken.append(f"{outcome.processor_seconds:.1f} s")
    if outcome.memory_bytes > MEMORY:
        broken.append(f"{outcome.memory_bytes / 2**30:.2f} GiB")
    outcome.said = message[-1500:] if broken else message[:200]


def is_refusal(lines: Sequence[str]) -> bool:
    """Whether some ``lines`` are what a refusal is: one, or of a file with several mistakes one more for each, of
    twenty at most, and one that counts the rest."""
    several = re.search(r": has (\d+) mistakes:$", lines[0]) if lines else None
    if several is None:
        return len(lines) == 1
    return len(lines) - 1 == min(int(several[1]), 21) and all(line.startswith("  ") for line in lines[1:])


def listed(folder: Path) -> dict[str, tuple[int, ...]]:
    """All that is in a folder, links not followed: kind and permissions, and of files bytes and time of writing."""
    found = {}
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            status = os.lstat(os.path.join(place, name))
            written = (status.st_size, status.st_mtime_ns) if name in files else ()
            found[repr(os.path.relpath(os.path.join(place, name), folder))] = (status.st_mode, *written)
    return found


def table(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """A row for each kind."""
    rows = []
    for kind in dict.fromkeys(each.kind for each in outcomes):
        own = [each for each in outcomes if each.kind == kind]
        rows.append(
            {
                "kind": kind,
                "inputs": len(own),
                "status": {str(code): sum(e.status == code for e in own) for code in sorted({e.status for e in own})},
                "most_lines": max(each.lines for each in own),
                "most_seconds": max(each.seconds for each in own),
                "most_processor_seconds": max(each.processor_seconds for each in own),
                "most_memory_bytes": max(each.memory_bytes for each in own),
                "broken": sum(bool(each.broken) for each in own),
            }
        )
    return rows


def code() -> str:
    """SHA-256 of mitsim's source and of these inputs."""
    digest = hashlib.sha256()
    for path in sorted([*Path(mitsim.__file__).parent.rglob("*.py"), *Path(__file__).parent.glob("hostile*.py")]):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def main() -> int:
    """Run them all, print and write the table; 1 where a rule was broken."""
    parser = arguments(__doc__, seed=True)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--kind", nargs="*", choices=KINDS, default=[*KINDS])
    asked = parser.parse_args()
    for room in BEFOREHAND:
        package = importlib.import_module(f"mitsim.{room}")
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(module.name)
    about = {"seed": asked.seed, "code": code()}
    kept = held(asked.json, {})
    outcomes = [Outcome(**row) for row in kept["outcomes"]] if about.items() <= kept.items() else list[Outcome]()
    done, whole = {(each.kind, each.seed) for each in outcomes}, sum(KINDS[kind][0] for kind in asked.kind)

    def save() -> None:
        table_and_rows = {"kinds": table(outcomes), "outcomes": [asdict(each) for each in outcomes]}
        write(asked.json, {**about, "inputs": len(outcomes), **table_and_rows})

    with tempfile.TemporaryDirectory(prefix="mitsim-good-") as folder:
        good = Good(Path(folder) / "good")
        for kind in asked.kind:
            share, makers = KINDS[kind]
            makes = [maker(good) for maker in makers]
            for number in range(max(round(asked.count * share / whole), 1)):
                if (kind, asked.seed + number) not in done:
                    one = tried(kind, asked.seed + number, makes[number % len(makes)])
                    outcomes.append(one)
                    if one.broken:
                        said = one.said.strip()[-300:]
                        print(f"{kind} {one.seed}: {'; '.join(one.broken)}: {said!r}\n  {one.command}", flush=True)
                    if number % 20 == 0:
                        save()
            for row in table([each for each in outcomes if each.kind == kind]):
                show(kind, row)
    save()
    broken = sum(bool(each.broken) for each in outcomes)
    print(f"{len(outcomes)} inputs, {broken} broke a rule")
    return int(bool(broken))


if __name__ == "__main__":
    sys.exit(main())

"""Planted bugs ("mutants") of the modules whose mistakes no picture shows: which of them do the quick tests see?

    python benchmarks/mutants.py [--room optics] [--json FILE] [--again FILE] [--jobs 2] [--seed 0]

`mutants.json` has, for every room, the tests that must see its mutants, how many are drawn of each module, and the
survivors that are explained (reason: [mutants]). Which are drawn hangs on the seed and on each change alone: the same
code gives the same mutants, and an edit moves only those of the lines that it touches. Each runs in a copy of the tree
up to the first failure or a time limit.

Exit status: 0; 1 when a mutant survives that is not explained, or one that is explained does not; 2 when the tests
fail as they are.

Why not mutmut or cosmic-ray: mutmut 3.8 leaves out functions with decorators, so all properties, and what stands at
module level; cosmic-ray 8.7 writes into the checkout and has one test command for all modules.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import hypothesis
import pytest
from mutations import Mutant, drawn, mutants, mutated

ROOT = Path(__file__).resolve().parents[1]
SETTINGS = json.loads(Path(__file__).with_name("mutants.json").read_text(encoding="utf-8"))
PRELOADED = ("numpy", "pydantic", "mpmath", "skimage.data")
PRELOADED += tuple(f"scipy.{part}" for part in ("special", "stats", "optimize", "signal", "sparse.linalg"))
PRELOADED += ("torch",) if find_spec("torch") else ()
"""What else takes long to import and is no part of mitsim: each mutant's process is forked off one that has it."""
WHOLE = ("sensor", "optics", "reconstruct")
"""Rooms of which every module must be listed, or left out for a reason."""
MEMORY = 8 * 2**30
"""Address space of a mutant [bytes]: a wrong size must not take the machine's memory."""
SLOWER, LATER_S = 4, 30
"""A mutant may take this many times the processor time of the tests without one, and so much more [s]: an endless loop
ends, and a busy machine makes no verdict."""
WAITING = 20
"""Seconds on the clock for a second of that limit, after which a mutant waits for something that never comes."""

_NO_SHRINKING = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
"""The smallest example of a failure takes minutes, and nobody reads it here."""
Tests = tuple[str, ...]
_copy = Path()
"""This process's own copy of the tree."""


def start(parent: str) -> None:
    """Begin a worker: its copy of the tree, in the folder ``parent``, and the libraries that all tests need."""
    global _copy
    _copy = Path(tempfile.mkdtemp(dir=parent))
    listed = subprocess.run(
        ("git", "ls-files", "-coz", "--exclude-standard"), cwd=ROOT, capture_output=True, check=True
    )
    for name in filter(None, listed.stdout.decode().split("\0")):
        if (ROOT / name).is_file():
            (_copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, _copy / name)
    for name in PRELOADED:
        __import__(name)


class Notes:
    """Plugin of the run without a mutant: seconds of each test, and the lines of mitsim that it runs.

    What a test's set-up runs, its fixtures serve to the other tests of its file, so it counts for all of them.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.seconds, self.lines = path, dict[str, float](), defaultdict[str, set[str]](set)

    def pytest_runtest_logreport(self, report: Any) -> None:
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item: Any) -> Iterator[None]:
        return (yield from self._traced(file_of(item.nodeid)))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: Any) -> Iterator[None]:
        return (yield from self._traced(item.nodeid))

    def pytest_sessionfinish(self) -> None:
        self.path.write_text(json.dumps([self.seconds, {name: list(lines) for name, lines in self.lines.items()}]))

    def _traced(self, name: str) -> Iterator[None]:
        package, seen = f"{_copy}/mitsim/", self.lines[name]

        def trace(frame: Any, event: str, _: object) -> Any:
            where = frame.f_code.co_filename
            if not where.startswith(package):
                return None
            seen.add(f"{where[len(package) :]}:{frame.f_lineno}")
            return trace

        sys.settrace(trace)
        threading.settrace(trace)
        try:
            return (yield)
        finally:
            sys.settrace(None)
            threading.settrace(None)  # type: ignore[arg-type]


class Order:
    """Plugin of the run with a mutant: tests that run its line before those that run its module, fast ones first;
    others cannot see it."""

    def __init__(self, mutant: Mutant, paths: list[Path]) -> None:
        self.module, self.line = f"{mutant.module}:", f"{mutant.module}:{mutant.line}"
        self.seconds, self.lines = dict[str, float](), dict[str, list[str]]()
        for notes in (json.loads(path.read_text()) for path in paths):
            self.seconds |= notes[0]
            self.lines |= notes[1]

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        cost = defaultdict[str, float](float)
        for item in items:
            cost[file_of(item.nodeid)] += self.seconds.get(item.nodeid, 0.0)

        def order(item: Any) -> tuple[bool, float, float]:
            return (
                self.line not in self._lines(item), cost[file_of(item.nodeid)], self.seconds.get(item.nodeid, 0.0),
            )  # fmt: skip

        items[:] = sorted((item for item in items if runs(self.module, self._lines(item))), key=order)

    def _lines(self, item: Any) -> list[str]:
        return [*self.lines.get(item.nodeid, ()), *self.lines.get(file_of(item.nodeid), ())]


def runs(module: str, lines: Iterable[str]) -> bool:
    """Whether some of the ``lines`` are of a ``module:``."""
    return any(line.startswith(module) for line in lines)


def file_of(test: str) -> str:
    """The file of a test, by its name."""
    return test.partition("::")[0]


def judged(mutant: Mutant | None, tests: Tests, limit_s: float) -> tuple[str, float]:
    """Verdict on a ``mutant`` (None: the code as it is, by one file) by ``tests``, and their processor time [s]."""
    if mutant is None:
        return _verdict(tests, limit_s, Notes(notes_of(_copy.parent, *tests)))
    path = _copy / "mitsim" / mutant.module
    source, written = path.read_text(encoding="utf-8"), path.stat()
    path.write_text(mutated(source, mutant.place), encoding="utf-8")
    verdict = _verdict(tests, limit_s, Order(mutant, [notes_of(_copy.parent, test) for test in tests]))
    path.write_text(source, encoding="utf-8")
    os.utime(path, ns=(written.st_atime_ns, written.st_mtime_ns))  # its compiled form is valid again
    return verdict


def notes_of(folder: Path, test: str) -> Path:
    """Where what a file of tests runs is noted, in the ``folder`` of the copies."""
    return folder / f"{test.replace('/', '-')}.json"


def telling(mutant: Mutant, lines: dict[str, set[str]]) -> Tests:
    """Files of tests that can see a ``mutant``: those that run its line or, where it is one of none of them or of no
    function (a module's constant, which runs in the test that happens to import it first), its module. ``lines``: what
    each runs."""
    line = f"{mutant.module}:{mutant.line}"
    in_function = not mutant.key.startswith(f"{mutant.module} module: ")
    here = tuple(test for test, run in lines.items() if in_function and line in run)
    return here or tuple(test for test, run in lines.items() if runs(f"{mutant.module}:", run))


def _verdict(tests: Tests, limit_s: float, plugin: Notes | Order) -> tuple[str, float]:
    end = time.monotonic() + WAITING * limit_s
    child = os.fork() or _test(tests, limit_s, plugin)
    ended, status, usage = os.wait4(child, os.WNOHANG)
    while not ended and time.monotonic() < end:
        time.sleep(0.02)
        ended, status, usage = os.wait4(child, os.WNOHANG)
    if not ended:
        os.killpg(child, signal.SIGKILL)
        _, status, usage = os.wait4(child, 0)
    code, seconds = os.waitstatus_to_exitcode(status), round(usage.ru_utime + usage.ru_stime, 1)
    if not ended or code == -signal.SIGXCPU:
        return "timeout", seconds
    return "killed" if code else "survived", seconds


def _test(tests: Tests, limit_s: float, plugin: Notes | Order) -> int:
    """Run the tests in this process and end it."""
    code = 3
    try:
        os.setsid()
        os.chdir(_copy)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s) + 1, int(limit_s) + 60))
        sys.dont_write_bytecode = isinstance(plugin, Order)
        sys.path[:0], os.environ["PYTHONPATH"] = [str(_copy)], str(_copy)
        hypothesis.settings.register_profile("mutants", derandomize=True, phases=_NO_SHRINKING, database=None)
        hypothesis.settings.load_profile("mutants")
        for stream in (1, 2):
            os.dup2(os.open("pytest.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND), stream)
        options = "-x", "-m", "not slow", "-p", "no:cacheprovider", f"--basetemp={_copy}/tmp"
        code = int(pytest.main([*options, *(f"tests/{test}" for test in tests)], [plugin]))
        code = 0 if code == pytest.ExitCode.NO_TESTS_COLLECTED and isinstance(plugin, Order) else code
    finally:
        os._exit(code)


def main() -> int:
    """Draw, run, compare with what is explained, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--room", action="append", choices=SETTINGS["rooms"], help="only this room; may be repeated")
    parser.add_argument("--json", type=Path, default=ROOT / "docs" / "_build" / "mutants.json", help="result file")
    parser.add_argument("--again", type=Path, help="only what survived in this result file")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    again = None
    if options.again:
        before = json.loads(options.again.read_text(encoding="utf-8"))["mutants"]
        again = {mutant["key"] for mutant in before if mutant["verdict"] == "survived"}
    work = [one for room in options.room or SETTINGS["rooms"] for one in _drawn(room, options.seed, again)]
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    with (
        tempfile.TemporaryDirectory(prefix="mutants-") as parent,
        ProcessPoolExecutor(options.jobs, multiprocessing.get_context("fork"), start, (parent,)) as pool,
    ):
        files = list(dict.fromkeys(test for *_, tests in work for test in tests))
        bare = pool.map(judged, [None] * len(files), [(file,) for file in files], [3600] * len(files))
        usual = dict[str, float]()
        for file, (verdict, seconds) in zip(files, bare, strict=True):
            if verdict != "survived":
                print(f"tests fail without a mutant: {file}")
                return 2
            usual[file] = seconds
        read = {file: json.loads(notes_of(Path(parent), file).read_text())[1] for file in files}
        lines = {file: set().union(*by_test.values()) for file, by_test in read.items()}
        tasks = []
        for _, mutant, tests in work:
            own = telling(mutant, {test: lines[test] for test in tests})
            tasks.append((mutant, own, SLOWER * sum(usual[test] for test in own) + LATER_S))
        results = []
        for (room, mutant, _), (verdict, seconds) in zip(work, pool.map(judged, *zip(*tasks)), strict=True):  # noqa: B905
            where = f"mitsim/{mutant.module}:{mutant.line}"
            results.append({"room": room, "where": where, "key": mutant.key, "verdict": verdict, "seconds": seconds})
            print(f"{verdict:8} {seconds:5.1f} s  {where}  {mutant.key}", flush=True)
    return _report(results, options.json, complete=again is None and options.seed == 0)


def _drawn(room: str, seed: int, again: set[str] | None) -> list[tuple[str, Mutant, Tests]]:
    """(room, mutant, files of tests) of a room; only those whose keys are in ``again``, if given."""
    work, listed = [], SETTINGS["rooms"][room]
    paths = [ROOT / "tests" / name for name in listed["tests"]]
    files = [file for path in paths for file in (sorted(path.glob("test_*.py")) if path.is_dir() else [path])]
    tests = tuple(dict.fromkeys(file.relative_to(ROOT / "tests").as_posix() for file in files))
    for module, count in listed["modules"].items():
        found = mutants(module, (ROOT / "mitsim" / module).read_text(encoding="utf-8"))
        chosen = drawn(found, count, seed) if again is None else [one for one in found if one.key in again]
        work += [(room, mutant, tests) for mutant in chosen]
    return work


def _report(results: list[dict[str, object]], path: Path, complete: bool) -> int:
    """Print and write the score of every room and the survivors; the exit status."""
    explained = {key for keys in SETTINGS["explained"].values() for key in keys}
    rooms = {}
    for room in dict.fromkeys(str(one["room"]) for one in results):
        here = [one for one in results if one["room"] == room]
        count = Counter(str(one["verdict"]) for one in here)
        known = sum(one["verdict"] == "survived" and one["key"] in explained for one in here)
        rooms[room] = {"mutants": len(here), **count, "explained": known}
        print(f"{room}: {count['killed'] + count['timeout']} of {len(here)} killed, {known} survivors explained")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"rooms": rooms, "mutants": results}, indent=1), encoding="utf-8")
    survived = {str(one["key"]): one["where"] for one in results if one["verdict"] == "survived"}
    modules = tuple(f"{module} " for room in rooms for module in SETTINGS["rooms"][room]["modules"])
    left = survived.keys() - explained
    gone = {key for key in explained - survived.keys() if key.startswith(modules)} if complete else set()
    for key in sorted(left):
        print(f"survived, not explained: {survived[key]}  {key}")
    for key in sorted(gone):
        print(f"explained, but killed or not drawn: {key}")
    listed = {module for room in SETTINGS["rooms"].values() for module in room["modules"]}
    there = {f"{room}/{path.name}" for room in WHOLE for path in (ROOT / "mitsim" / room).glob("[a-z]*.py")}
    there -= {module for modules in SETTINGS["left_out"].values() for module in modules}
    for module in sorted(there - listed):
        print(f"no mutants are drawn of {module}: list it in mutants.json")
    return 1 if left or gone or there - listed else 0


if __name__ == "__main__":
    sys.exit(main())

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

import ast
import builtins
import hashlib
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
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import hypothesis
import pytest
from harness import ROOT, arguments, write

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

# -------- Mutants: the same text with one change that a programmer could have made by mistake

# fmt: off
_OPERATORS: dict[type, type] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Div,
    ast.Mod: ast.FloorDiv, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
    ast.And: ast.Or, ast.Or: ast.And, ast.Break: ast.Continue, ast.Continue: ast.Break,
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}
_REVERSED: dict[type, type] = {ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt}
_TWINS = (
    ("min", "max"), ("minimum", "maximum"), ("floor", "ceil"), ("any", "all"), ("argmin", "argmax"),
    ("zeros", "ones"), ("zeros_like", "ones_like"), ("sum", "mean"), ("sin", "cos"),
    ("rows", "columns"), ("left", "right"), ("horizontal", "vertical"),
)
# fmt: on
_OTHER = dict(_TWINS) | {second: first for first, second in _TWINS}
_UNTOUCHED = (ast.JoinedStr, ast.Raise, ast.Import, ast.ImportFrom, ast.arg)
"""Messages, imports and annotations: tests of bad input and of the architecture read these."""
_SYMMETRIC = "min", "max", "minimum", "maximum", "hypot", "array_equal", "vdot"
"""Functions that the order of their arguments means nothing to."""
Place = tuple[str, ast.AST, Callable[[ast.AST], None], list[ast.AST]]


@dataclass(frozen=True)
class Mutant:
    """A change of a module: ``key`` says it in words, ``place`` finds it in the text."""

    module: str
    line: int
    key: str
    place: tuple[int, int]


def mutants(module: str, source: str) -> list[Mutant]:
    """All mutants of a ``module``, whose text is ``source``."""
    lines, times, found = source.splitlines(), Counter[str](), []
    names = {node.id for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Name)}
    for index, (scope, node, _, variants) in enumerate(_places(ast.parse(source))):
        for number, variant in enumerate(variants):
            if isinstance(variant, ast.Name) and variant.id not in names and not _built_in(node, variant):
                continue
            old, new = (ast.unparse(ast.fix_missing_locations(part)).partition("\n")[0] for part in (node, variant))
            line = getattr(node, "lineno", 1)
            change = f"{old} -> {new}" if len(old) + len(new) < 160 else f"{old[:60]}... -> {new[:90]}..."
            key = f"{module} {scope or 'module'}: {lines[line - 1].strip()} | {change}"
            times[key] += 1
            found.append(Mutant(module, line, f"{key} #{times[key]}" if times[key] > 1 else key, (index, number)))
    return found


def drawn(found: list[Mutant], count: int, seed: int) -> list[Mutant]:
    """``count`` of the mutants ``found``; which, hangs on the ``seed`` and on each change alone."""
    ranked = sorted(found, key=lambda mutant: hashlib.sha256(f"{seed} {mutant.key}".encode()).digest())
    return sorted(ranked[:count], key=lambda mutant: mutant.place)


def mutated(source: str, place: tuple[int, int]) -> str:
    """The module's text with the change at a ``place``."""
    tree = ast.parse(source)
    _, _, replace, variants = list(_places(tree))[place[0]]
    replace(variants[place[1]])
    return ast.unparse(ast.fix_missing_locations(tree))


def _places(tree: ast.AST, scope: str = "", returns: str = "") -> Iterator[Place]:
    """(scope, node, how to replace it, its variants) of all that may be changed, depth first."""
    for field, value in ast.iter_fields(tree):
        if field in ("annotation", "returns", "decorator_list", "type_comment"):
            continue
        for index, node in enumerate(value if isinstance(value, list) else [value]):
            if not isinstance(node, ast.AST) or isinstance(node, _UNTOUCHED):
                continue
            if isinstance(node, ast.keyword) and node.arg == "strict":  # of zip: a guard that never speaks
                continue

            def replace(new: ast.AST, value: object = value, field: str = field, index: int = index) -> None:
                if isinstance(value, list):
                    value[index] = new
                else:
                    setattr(tree, field, new)

            inner, result = scope, returns
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                if node.name in ("__repr__", "_repr_html_"):
                    continue
                inner = f"{scope}.{node.name}".lstrip(".")
                result = ast.unparse(node.returns) if isinstance(node, ast.FunctionDef) and node.returns else ""
            variants = [*_of_statement(node, returns)] if isinstance(node, ast.stmt) else []
            yield inner, node, replace, [*variants, *_of_expression(node)]
            yield from _places(node, inner, result)


def _of_expression(node: ast.AST) -> Iterator[ast.AST]:
    """What stands in for a ``node``: another operator, constant, order of arguments, function, side."""
    match node:
        case ast.BinOp() | ast.BoolOp() | ast.AugAssign() if type(node.op) in _OPERATORS:
            yield _with(node, op=_OPERATORS[type(node.op)]())
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            yield node.operand
        case ast.Compare(ops=[single]):
            for table in (_OPERATORS, _REVERSED):
                if type(single) in table:
                    yield _with(node, ops=[table[type(single)]()])
        case ast.Constant(value=bool()):
            yield ast.Constant(not node.value)
        case ast.Constant(value=int()):
            yield ast.Constant(node.value + 1)
        case ast.Constant(value=float()):
            yield ast.Constant(2 * node.value or 1.0)
        case ast.IfExp():
            yield _with(node, body=node.orelse, orelse=node.body)
        case ast.Call(args=[first, second, *rest]) if ast.dump(first) != ast.dump(second) and not _symmetric(node):
            yield _with(node, args=[second, first, *rest])
        case ast.Attribute() if node.attr in _OTHER:
            yield _with(node, attr=_OTHER[node.attr])
        case ast.Name(ctx=ast.Load()) if node.id in _OTHER:
            yield _with(node, id=_OTHER[node.id])


def _of_statement(node: ast.stmt, returns: str) -> Iterator[ast.stmt]:
    """What stands in for a statement of a function that ``returns`` a type of that text: none, its negation, double."""
    match node:
        case ast.AugAssign() | ast.Expr(value=ast.Call()) | ast.Assign(targets=[ast.Subscript() | ast.Attribute()]):
            yield ast.Pass()
        case ast.If() | ast.While():
            yield ast.fix_missing_locations(_with(node, test=ast.UnaryOp(ast.Not(), node.test)))
        case ast.Return(value=ast.Tuple(elts=[first, second])):
            yield ast.Return(ast.Tuple([second, first], ast.Load()))
        case ast.Return(value=ast.expr() as value) if returns == "bool":
            yield ast.Return(ast.UnaryOp(ast.Not(), value))
        case ast.Return(value=ast.expr() as value) if returns in ("float", "int", "FloatArray"):
            yield ast.Return(ast.BinOp(ast.Constant(2), ast.Mult(), value))
        case ast.Break() | ast.Continue():
            yield _OPERATORS[type(node)]()


def _built_in(*names: ast.AST) -> bool:
    return all(isinstance(node, ast.Name) and hasattr(builtins, node.id) for node in names)


def _symmetric(call: ast.Call) -> bool:
    return ast.unparse(call.func).rpartition(".")[2] in _SYMMETRIC


def _with(node: ast.AST, **fields: object) -> ast.AST:
    return type(node)(**{**dict(ast.iter_fields(node)), **fields})


# -------- Runs


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
    parser = arguments(__doc__, seed=True)
    parser.set_defaults(json=ROOT / "docs" / "_build" / "mutants.json")
    parser.add_argument("--room", action="append", choices=SETTINGS["rooms"], help="only this room; may be repeated")
    parser.add_argument("--again", type=Path, help="only what survived in this result file")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
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
    write(path, {"rooms": rooms, "mutants": results})
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

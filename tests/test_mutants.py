"""The mutation tester's own parts: what a mutant is, which are drawn, and that its list covers the rooms."""

from __future__ import annotations

import ast
import importlib.util
import json
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]
BENCHMARKS = ROOT / "benchmarks"
SOURCE = '''"""Text."""

LIMIT = 3


def clipped(values: list[float], low: float = 0.5) -> float:
    """Text with numbers: 1."""
    total = max(LIMIT, low)
    for value in values:
        if value > LIMIT and not value == 7:
            total += round(value, low)
    return total


@property
def same(a: int = 1) -> bool:
    if a:
        raise ValueError(f"{a + 1} is wrong", 5)
    return a < 2
'''
CHANGES = """
3 -> 4
0.5 -> 1.0
max -> min
if not (value > LIMIT and (not value == 7)):
value > LIMIT or not value == 7
value > LIMIT -> value >= LIMIT
value > LIMIT -> value <= LIMIT
not value == 7 -> value == 7
value == 7 -> value != 7
7 -> 8
total += round(value, low) -> pass
total += round(value, low) -> total -= round(value, low)
round(value, low) -> round(low, value)
return total -> return 2 * total
1 -> 2
if a: -> if not a:
return a < 2 -> return not a < 2
a < 2 -> a <= 2
a < 2 -> a >= 2
2 -> 3
"""


@pytest.fixture(scope="module")
def mutations() -> ModuleType:
    spec = importlib.util.spec_from_file_location("benchmark_mutants", BENCHMARKS / "mutants.py")
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:  # dataclasses look their module up by name
        patch.syspath_prepend(str(BENCHMARKS))
        patch.setitem(sys.modules, spec.name, module)
        spec.loader.exec_module(module)
    return module


def test_a_mutant_is_one_change_that_its_words_name(mutations: ModuleType) -> None:
    """Operators, boundaries, conditions, constants, statements, arguments; no message, docstring or annotation."""
    found = mutations.mutants("module.py", SOURCE)
    for words in filter(None, CHANGES.splitlines()):
        assert any(mutant.key.endswith(words) for mutant in found), words
    assert len(found) == len(CHANGES.strip().splitlines()), [mutant.key for mutant in found]
    plain = ast.unparse(ast.parse(SOURCE))
    texts = [mutations.mutated(SOURCE, mutant.place) for mutant in found]
    assert len({plain, *texts}) == 1 + len(found), "none is another, and none is the code as it is"
    assert all(ast.parse(text) for text in texts) and all('"""Text with numbers: 1."""' in text for text in texts)
    assert all(sum(a != b for a, b in zip(plain.split(), text.split(), strict=False)) for text in texts)


def test_an_edit_moves_only_the_mutants_of_its_own_lines(mutations: ModuleType) -> None:
    before = mutations.mutants("module.py", SOURCE)
    after = mutations.mutants("module.py", SOURCE.replace("LIMIT = 3", "# a comment\nOTHER = 8\nLIMIT = 3"))
    drawn = [{mutant.key for mutant in mutations.drawn(found, 8, 0)} for found in (before, after)]
    assert len(drawn[0]) == 8 and len(drawn[0] - drawn[1]) <= 1, "the new constant may take one place"
    assert drawn[0] != {mutant.key for mutant in mutations.drawn(before, 8, 1)}, "another seed draws others"


def test_a_constant_is_met_by_all_files_that_run_its_module(mutations: ModuleType) -> None:
    """Its line is run by whichever test imports the module first, which may say nothing of it. (Planted: that file
    alone.)"""
    found = {mutant.key.partition(": ")[0]: mutant for mutant in mutations.mutants("a.py", SOURCE)}
    lines = {"first.py": {"a.py:3", "a.py:6"}, "own.py": {"a.py:8"}, "other.py": {"b.py:3"}}
    assert mutations.telling(found["a.py module"], lines) == ("first.py", "own.py")
    in_function = next(one for one in mutations.mutants("a.py", SOURCE) if one.line == 8)
    assert mutations.telling(in_function, lines) == ("own.py",)


def test_the_list_names_modules_and_tests_that_are_there() -> None:
    """All that has moved is told at once, with where a file of that name is now."""
    settings = json.loads((BENCHMARKS / "mutants.json").read_text(encoding="utf-8"))
    listed = {module for room in settings["rooms"].values() for module in room["modules"]}
    explained = {key.partition(" ")[0] for keys in settings["explained"].values() for key in keys}
    tests = {test for room in settings["rooms"].values() for test in room["tests"]}
    left_out = {module for modules in settings["left_out"].values() for module in modules}
    moved = moves("mitsim", {*listed, *explained, *left_out}) + moves("tests", tests)
    assert not moved, "\n".join(moved)
    assert {*settings["rooms"]} >= {"sensor", "optics", "reconstruct", "light", "planner"}
    for name, room in settings["rooms"].items():
        assert {module.partition("/")[0] for module in room["modules"]} == {name}
    assert sum(count for room in settings["rooms"].values() for count in room["modules"].values()) >= 300
    assert explained <= {*listed} and all(len(reason) > 20 for reason in settings["explained"])


def moves(folder: str, names: set[str]) -> list[str]:
    """A line for each of ``names`` that is not in a ``folder``."""
    found = []
    for name in sorted(names):
        if not (ROOT / folder / name).exists():
            now = [path.relative_to(ROOT).as_posix() for path in (ROOT / folder).rglob(Path(name).name)]
            found.append(
                f"mutants.json: {name} is not in {folder}/; of that name there is {', '.join(now) or 'nothing'}"
            )
    return found


def test_every_module_of_whole_rooms_is_listed() -> None:
    settings = json.loads((BENCHMARKS / "mutants.json").read_text(encoding="utf-8"))
    listed = {module for room in settings["rooms"].values() for module in room["modules"]}
    listed |= {module for modules in settings["left_out"].values() for module in modules}
    whole = re.search(r"^WHOLE = \((.*)\)$", (BENCHMARKS / "mutants.py").read_text(encoding="utf-8"), flags=re.M)
    for room in re.findall(r"\w+", whole[1]):
        assert listed >= {f"{room}/{path.name}" for path in (ROOT / "mitsim" / room).glob("[a-z]*.py")}, room


def test_a_file_that_has_moved_is_told() -> None:
    (line,) = moves("mitsim", {"sensor/chain.py", "capture/chain.py"})
    assert line.startswith("mutants.json: capture/chain.py") and line.endswith("mitsim/sensor/chain.py")

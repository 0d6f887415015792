"""docs/extending.md as a reader follows it: a section's edits, new files and commands, in a copy of the tree.

An edit is a sentence "In `FILE`, below (above, in place of) `LINE`:" or "In `FILE`, at the end:" over a block of code;
a new file is "New file `FILE`:" over its text. A command is an indented line that begins with ``$``.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "extending.md"
_STEP = re.compile(
    r"^(?:New file `(?P<new>[^`\n]+)`|In `(?P<file>[^`\n]+)`, (?:(?P<how>below|above|in place of) `(?P<line>[^`\n]+)`"
    r"|at the end)):\n\n```\w*\n(?P<code>[\s\S]*?)^```$|^    \$ (?P<command>.+)$",
    flags=re.M,
)
_PROGRAMS = {"mitsim": "-m mitsim", "python": "", "pytest": "-m pytest -q -n 0 -p no:cacheprovider"}
"""What the page's commands are here."""


@dataclass(frozen=True)
class Step:
    """One thing that a reader does: ``code`` into a file, or a command."""

    file: str = ""
    how: str = ""
    line: str = ""
    code: str = ""
    command: str = ""


@dataclass
class Section:
    """A section of the page: what is done, in its order."""

    title: str
    steps: list[Step] = field(default_factory=list)

    @property
    def files(self) -> list[str]:
        """All that a reader writes to."""
        return [step.file for step in self.steps if step.file]

    def edit(self, tree: Path) -> None:
        """Write everything that the section says into a ``tree``; AssertionError where it says a line that is not
        there."""
        for step in self.steps:
            if step.file:
                _write(step, tree / step.file)

    def run(self, tree: Path) -> None:
        """Do all that the section says in a ``tree``, in its order; AssertionError where a command fails."""
        environment = {**os.environ, "PYTHONPATH": str(tree), "PATH": f"{_programs(tree)}:{os.environ['PATH']}"}
        for step in self.steps:
            if step.file:
                _write(step, tree / step.file)
            else:
                command = ["bash", "-c", step.command]
                done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=False)
                assert done.returncode == 0, f"{step.command}\n{done.stdout}\n{done.stderr}"


def sections() -> dict[str, Section]:
    """Those of the page that have something to do, by title."""
    found = {}
    for text in re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.M)[1:]:
        title, _, body = text.partition("\n")
        section = Section(title)
        for match in _STEP.finditer(body):
            reported = {name: value or "" for name, value in match.groupdict().items()}
            file, how = (
                reported["new"] or reported["file"],
                "new" if reported["new"] else reported["how"] or "at the end",
            )
            step = (
                Step(command=reported["command"])
                if reported["command"]
                else Step(file, how, reported["line"], reported["code"])
            )
            section.steps.append(step)
        assert len(re.findall("^```", body, flags=re.M)) == 2 * len(section.files), f"{title}: a block of no file"
        if section.steps:
            found[title] = section
    return found


def copied(tree: Path) -> Path:
    """A copy of this checkout as ``tree``, byte code too, so that modules that stay as they are load at once."""
    listed = subprocess.run(
        ("git", "ls-files", "-coz", "--exclude-standard"), cwd=ROOT, capture_output=True, check=True
    )
    for name in filter(None, listed.stdout.decode().split("\0")):
        if (ROOT / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            (tree / name).write_bytes((ROOT / name).read_bytes())
    return tree


def _write(step: Step, path: Path) -> None:
    if step.how == "new":
        assert not path.exists(), f"{step.file} is there"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(step.code, encoding="utf-8")
        return
    text = path.read_text(encoding="utf-8")
    if step.how == "at the end":
        path.write_text(text + step.code, encoding="utf-8")
        return
    lines = text.splitlines(keepends=True)
    at = [number for number, line in enumerate(lines) if line.strip() == step.line.strip()]
    assert len(at) == 1, f"{step.file}: `{step.line}` stands there {len(at)} times"
    first, last = {"below": (at[0] + 1, at[0] + 1), "above": (at[0], at[0]), "in place of": (at[0], at[0] + 1)}[
        step.how
    ]
    path.write_text("".join([*lines[:first], step.code, *lines[last:]]), encoding="utf-8")


def _programs(tree: Path) -> Path:
    folder = tree / ".programs"
    folder.mkdir(exist_ok=True)
    for name, options in _PROGRAMS.items():
        (folder / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" {options} "$@"\n')
        (folder / name).chmod(0o755)
    return folder

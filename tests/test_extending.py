"""docs/extending.md followed to the letter: each section's edits in a copy of the tree, and the checks it names."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.extended import ROOT, Section, copied, sections

SECTIONS = sections()


def test_the_page_says_how_to_add_all_of_these() -> None:
    assert {
        "A camera",
        "A mask",
        "A projector",
        "A pattern family",
        "An effect",
        "A study",
        "A pass of light",
        "A solver",
    } <= {*SECTIONS}


@pytest.mark.parametrize("title", SECTIONS)
def test_every_line_that_a_section_names_is_there(title: str, tmp_path: Path) -> None:
    """In the files of this tree, once; and what comes out is Python. (Planted: a line that has moved.)"""
    section = SECTIONS[title]
    for name in section.files:
        if (ROOT / name).is_file():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    section.edit(tmp_path)
    for name in section.files:
        if name.endswith(".py"):
            compile((tmp_path / name).read_text(encoding="utf-8"), name, "exec")


QUICK = ("A mask", "A projector")
"""Sections that take a few seconds."""


@pytest.mark.parametrize(
    "title", [pytest.param(title, marks=[] if title in QUICK else [pytest.mark.slow]) for title in SECTIONS]
)
def test_a_section_works_as_written(title: str, tmp_path: Path) -> None:
    SECTIONS[title].run(copied(tmp_path / "tree"))


def test_a_line_that_is_not_there_is_told(tmp_path: Path) -> None:
    section = Section("x", [step for step in SECTIONS["An effect"].steps if step.how == "below"][:1])
    path = tmp_path / section.files[0]
    path.parent.mkdir(parents=True)
    path.write_text("nothing\n")
    with pytest.raises(AssertionError, match="stands there 0 times"):
        section.edit(tmp_path)

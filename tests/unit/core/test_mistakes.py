"""Mistakes in a file: all of them together, each with its field, value and rule."""

from __future__ import annotations

from pathlib import Path

import pydantic
import pytest

from mitsim.core.configuration import Configuration, load_model, read_table
from mitsim.core.errors import MitsimError


class Part(Configuration):
    """A part of a device."""

    gap_um: float = pydantic.Field(ge=0, le=10)
    side: int = 1


class Device(Configuration):
    """A device."""

    name: str
    bits: int = pydantic.Field(ge=1, le=24)
    kind: str = "usual"
    part: Part | None = None
    parts: tuple[Part, ...] = pydantic.Field(default=(), strict=False)


def refused(tmp_path: Path, text: str) -> list[str]:
    """Return the lines of the refusal of a file."""
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    with pytest.raises(MitsimError) as caught:
        load_model(tmp_path / "mine.toml", Device)
    return str(caught.value).replace(f"{tmp_path}/", "").split("\n")


def test_all_mistakes_are_reported_together(tmp_path: Path) -> None:
    """(Planted: the first alone.)"""
    text = '# mine\n\nnames = "a"\nbits = 30\nlist = [\n  1,\n]\n'
    text += '[part]\nside = 1.5\ngap_um = "wide"\n[[parts]]\nside = 1\n'
    first, *rest = refused(tmp_path, text)
    assert first == "file mine.toml: has 6 mistakes:"
    assert {*rest} == {
        "  names: got 'a', no such field; did you mean name?",
        "  list: got [1], no such field; known fields: name, bits, kind, part, parts",
        "  bits: got 30; give a number from 1 to 24",
        "  part.gap_um: got 'wide'; give a number from 0 to 10",
        "  part.side: got 1.5; give a whole number",
        "  parts.0.gap_um: is missing",
    }


def test_one_mistake_is_one_line_with_its_place(tmp_path: Path) -> None:
    assert refused(tmp_path, 'name = "a"\nbits = 0\n') == ["file mine.toml: bits: got 0; give a number from 1 to 24"]


def test_many_mistakes_are_cut(tmp_path: Path) -> None:
    lines = refused(tmp_path, "".join(f"x{k} = 1\n" for k in range(50)) + 'name = "a"\nbits = 1\n')
    assert lines[0] == "file mine.toml: has 50 mistakes:" and lines[-1] == "  and 30 more" and len(lines) == 22


def test_a_json_file_holds_a_table(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"bits": 0}')
    assert read_table(tmp_path / "a.json", "list") == {"bits": 0}
    (tmp_path / "a.json").write_text("[]")
    with pytest.raises(MitsimError, match=r"list .*a\.json: holds a list; give a table"):
        read_table(tmp_path / "a.json", "list")

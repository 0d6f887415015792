"""Mistakes in a person's file: all of them together, each with its line, field, value and rule."""

from __future__ import annotations

from pathlib import Path

import pydantic
import pytest

from mitsim.bench.apparatus import check_devices
from mitsim.core.configuration import Configuration, Table, load_model, mistakes, read_table, read_toml, validate
from mitsim.core.errors import MitsimError
from mitsim.devices.framelist import KnownList


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
    """(Planted: the first alone; lines counted from 0.)"""
    text = '# mine\n\nnames = "a"\nbits = 30\nlist = [\n  1,\n]\n'
    text += '[part]\nside = 1.5\ngap_um = "wide"\n[[parts]]\nside = 1\n'
    assert refused(tmp_path, text) == [
        "file mine.toml: has 6 mistakes:",
        "  line 3: names: got 'a', no such field; did you mean name?",
        "  line 4: bits: got 30; give a number from 1 to 24",
        "  line 5: list: got [1], no such field; known fields: name, bits, kind, part, parts",
        "  line 9: part.side: got 1.5; give a whole number",
        "  line 10: part.gap_um: got 'wide'; give a number",
        "  line 11: parts.0.gap_um: is missing",
    ]


def test_one_mistake_is_one_line_with_its_place(tmp_path: Path) -> None:
    assert refused(tmp_path, 'name = "a"\nbits = 0\n') == ["file mine.toml:2: bits: got 0; give a number from 1 to 24"]


def test_a_line_is_that_of_the_name_itself(tmp_path: Path) -> None:
    """Also of dotted names and of tables in lists. (Planted: the first line with the name's text.)"""
    text = "[c.d]\ne.f = 1\ne.g = 2\nb = 2\n[x]\nb = 3\n[[h]]\nk = 1\n[[h]]\nk = 2\n[[h.l]]\nm = 1\n"
    (tmp_path / "a.toml").write_text(text)
    table = read_toml(tmp_path / "a.toml")
    wanted = {("c", "d"): 1, ("c", "d", "e", "f"): 2, ("c", "d", "e", "g"): 3, ("c", "d", "b"): 4, ("x", "b"): 6}
    wanted |= {("h", 0, "k"): 8, ("h", 1): 9, ("h", 1, "k"): 10, ("h", 1, "l", 0, "m"): 12, ("none",): 0}
    assert {place: table.line(place) for place in wanted} == wanted
    assert table.part("c").line(("d", "e", "f")) == 2


def test_many_mistakes_are_cut(tmp_path: Path) -> None:
    lines = refused(tmp_path, "".join(f"x{k} = 1\n" for k in range(50)) + 'name = "a"\nbits = 1\n')
    assert lines[0] == "file mine.toml: has 50 mistakes:" and lines[-1] == "  and 30 more" and len(lines) == 22


def test_what_a_program_wrote_is_refused_by_its_first_mistake() -> None:
    with pytest.raises(MitsimError, match=r"^here: name: got 2; .* \(and 1 more\)$"):
        validate(Device, {"name": 2, "bits": 0}, "here")


def test_a_json_file_has_all_of_them_without_lines(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"bits": 0, "name": 1}')
    table = read_table(tmp_path / "a.json", "list")
    assert {text.partition(":")[0] for _, text in mistakes(Device, table)} == {"name", "bits"}
    (tmp_path / "a.json").write_text("[]")
    with pytest.raises(MitsimError, match=r"list .*a\.json: holds a list; give a table"):
        read_table(tmp_path / "a.json", "list")


def test_items_that_are_wrong_are_not_called_too_few() -> None:
    """(Seen: "tuple should have at least 1 item after validation" beside the item's own mistake.)"""
    found = [text for _, text in mistakes(KnownList, Table({"known": [{"run": "a", "pictur": "b"}]}))]
    assert "known.0.pictur: got 'b', no such field; did you mean picture?" in found
    assert not any("at least 1 item" in text for text in found)


def test_a_cameras_mask_is_refused_with_its_sensor(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('name = "a"\n[mask]\nkind = "flat"\nfeature_mm = 0\n')
    with pytest.raises(MitsimError) as caught:
        check_devices(tmp_path / "a.toml", None)
    first, *rest = str(caught.value).split("\n  ")
    assert first.endswith("has 7 mistakes:")
    assert [line.partition(" got ")[0] for line in rest[:2]] == ["line 3: mask.kind:", "line 4: mask.feature_mm:"]
    assert rest[2] == "pixel_pitch_um: is missing"

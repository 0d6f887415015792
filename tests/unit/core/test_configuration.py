"""Mistakes in a file: all of them together, each with its field, value and rule."""

from __future__ import annotations

from pathlib import Path

import pydantic
import pytest

from mitsim.core.configuration import Configuration, load_model, read_table, read_toml, shipped_path
from mitsim.core.errors import MitsimError


class Part(Configuration):
    """A part of a device."""

    gap_um: float = pydantic.Field(ge=0, le=10)
    side: int = 1
    pitch_um: float = pydantic.Field(default=1.0, gt=0)


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
    text += '[part]\nside = 1.5\ngap_um = "wide"\npitch_um = 0.0\n[[parts]]\nside = 1\n'
    first, *rest = refused(tmp_path, text)
    assert first == "file mine.toml: has 7 mistakes:"
    assert {*rest} == {
        "  names: got 'a', no such field; did you mean name?",
        "  list: got [1], no such field; known fields: name, bits, kind, part, parts",
        "  bits: got 30; give a number from 1 to 24",
        "  part.gap_um: got 'wide'; give a number from 0 to 10",
        "  part.side: got 1.5; give a whole number",
        "  part.pitch_um: got 0.0; give a number above 0",
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


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(MitsimError, match=r"a\.toml: cannot be read"):
        read_toml(tmp_path / "a.toml")
    (tmp_path / "a.toml").write_text("x = \n")
    with pytest.raises(MitsimError, match=r"a\.toml: not valid TOML"):
        read_toml(tmp_path / "a.toml")


def test_shipped_files_are_found_and_missing_ones_named() -> None:
    assert shipped_path("calibration", "imx249.toml").is_file()
    with pytest.raises(MitsimError, match=r"calibration/none\.toml: not found"):
        shipped_path("calibration", "none.toml")


def test_the_shipped_projector_is_consistent_with_itself() -> None:
    # Derived figures must follow from the ones they are derived from, to the digits written.
    data = read_toml(shipped_path("calibration", "mp_cl1.toml"))
    shares, lines = data["radiant_shares"], data["wavelengths_nm"]
    assert sum(shares) == pytest.approx(1.0, abs=1e-9)
    effective = sum(s * w for s, w in zip(shares, lines, strict=True))
    assert data["effective_wavelength_nm"] == pytest.approx(effective, abs=0.5)
    assert data["radiant_flux_w"] == pytest.approx(
        data["luminous_flux_lm"] / data["luminous_efficacy_lm_per_w"], rel=5e-3
    )

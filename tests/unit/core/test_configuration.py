from pathlib import Path

import pytest
from pydantic import BaseModel, ConfigDict, Field

from mitsim.core.configuration import load_model, read_toml, shipped_path, validate
from mitsim.core.errors import MitsimError


class Inner(BaseModel):
    model_config = ConfigDict(extra="forbid")
    gap_um: float = Field(gt=0)


class Outer(BaseModel):
    model_config = ConfigDict(extra="forbid")
    name: str
    inner: Inner


def test_a_file_becomes_a_model(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('name = "µ"\n[inner]\ngap_um = 2\n', encoding="utf-8")
    assert load_model(tmp_path / "a.toml", Outer) == Outer(name="µ", inner=Inner(gap_um=2.0))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"name": "a", "inner": {"gap_um": -2}}, r"^here: inner\.gap_um: got -2; give a number above 0$"),
        ({"name": "a", "inner": {}}, r"^here: inner\.gap_um: is missing$"),
        ({"name": "a", "inner": {"gap_um": 1}, "gap": 3}, r"gap: got 3, .* known fields: name, inner$"),
    ],
)
def test_a_broken_rule_is_one_line_with_place_value_and_rule(data: dict, message: str) -> None:
    with pytest.raises(MitsimError, match=message) as caught:
        validate(Outer, data, "here")
    assert "\n" not in str(caught.value)


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

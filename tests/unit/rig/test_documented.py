"""docs/formats.md names every field of a camera, projector or session file, with its range."""

import re
from pathlib import Path

import pytest
from pydantic import BaseModel

from mitsim.rig.projector import ProjectorModel
from mitsim.rig.recipe import SessionRecipe
from mitsim.rig.sensor import SensorModel

FORMATS = Path(__file__).parents[3] / "docs" / "formats.md"


def documented(heading: str) -> dict[str, str]:
    """Allowed values by field, from the table under a heading; a row may name several fields."""
    section = re.search(rf"^### {heading}.*?\n(.*?)(?=^##|\Z)", FORMATS.read_text(), re.MULTILINE | re.DOTALL)
    assert section is not None
    rows = [row.split("|") for row in section[1].splitlines() if row.startswith("| `")]
    return {name: row[3] for row in rows for name in re.findall(r"`(\w+)`", row[1])}


@pytest.mark.parametrize(
    ("heading", "model"),
    [("Camera \\(`--camera", SensorModel), ("Projector \\(`", ProjectorModel), ("Session \\(", SessionRecipe)],
)
def test_files_are_documented_as_they_are_checked(heading: str, model: type[BaseModel]) -> None:
    table = documented(heading)
    assert set(table) == set(model.model_fields)
    for name, field in model.model_fields.items():
        ends = {key: getattr(m, key) for m in field.metadata for key in ("ge", "le") if hasattr(m, key)}
        if len(ends) == 2:
            assert f"{ends['ge']:g} to {ends['le']:g}" in table[name], name

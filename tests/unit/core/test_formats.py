"""docs/formats.md says what the models of each format say, docs/shipped.md what is shipped."""

import importlib.util
from pathlib import Path
from types import ModuleType

TABLES = Path(__file__).parents[3] / "docs" / "tables.py"


def documents() -> ModuleType:
    """What writes the tables."""
    spec = importlib.util.spec_from_file_location("tables", TABLES)
    assert spec is not None and spec.loader is not None
    tables = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tables)
    return tables


def test_the_tables_are_those_of_the_models() -> None:
    tables = documents()
    text = tables.FORMATS.read_text(encoding="utf-8")
    assert tables.rewritten(text) == text, "run: python docs/tables.py"
    for model in tables.MODELS:
        assert {*model.model_fields} == {*tables.meanings(model)}, model


def test_the_lists_are_those_of_mitsim_list() -> None:
    """(Planted: a row of the page taken away; the list of effects taken away.)"""
    tables = documents()
    text = tables.SHIPPED.read_text(encoding="utf-8")
    assert tables.with_lists(text) == text, "run: python docs/tables.py"
    assert all(f"<!-- list: {kind} -->" in text + tables.FORMATS.read_text("utf-8") for kind in tables.KINDS)

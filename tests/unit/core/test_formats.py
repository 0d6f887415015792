"""The docs show the fields of each format's model, and the lists of shipped things."""

import importlib.util
from pathlib import Path
from types import ModuleType

TABLES = Path(__file__).parents[3] / "docs" / "tables.py"


def documents() -> ModuleType:
    spec = importlib.util.spec_from_file_location("tables", TABLES)
    assert spec is not None and spec.loader is not None
    tables = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tables)
    return tables


def test_the_tables_are_those_of_the_models_and_of_mitsim_list() -> None:
    """(Planted: a row of a page removed, of the table of studies too; a mark or a model removed.)"""
    tables = documents()
    texts = {page: page.read_text(encoding="utf-8") for page in tables.PAGES}
    stale = [page.name for page, text in texts.items() if tables.rewritten(text) != text]
    assert not stale, "run: python docs/tables.py"
    marks = "".join(texts.values())
    wanted = [f"<!-- fields: {model.__name__} -->" for model in tables.MODELS]
    wanted += [f"<!-- list: {kind} -->" for kind in tables.KINDS if kind != "studies"]
    assert {mark: marks.count(mark) for mark in wanted} == dict.fromkeys(wanted, 1)
    studies = (TABLES.parent / "studies.md").read_text(encoding="utf-8")
    assert all(f"\n| `{study.name}` | " in studies for study in tables.KINDS["studies"]())  # a table with more columns
    for model in tables.MODELS:
        assert {*model.model_fields} == {*tables.meanings(model)}, model

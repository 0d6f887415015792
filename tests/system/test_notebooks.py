"""The notebooks: their code speaks the face as it is, what is stored in them is fit for anybody, and all cells run."""

import ast
import itertools
import json
import re
from pathlib import Path
from typing import Any

import pytest

import mitsim

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs" / "notebooks"
NOTEBOOKS = sorted(DOCS.glob("*.ipynb"))
LARGEST = 600_000
"""Bytes of a notebook with its outputs."""
MOST_CELLS = 10
FIT = {("stream", "stdout"), ("display_data", ""), ("execute_result", "")}
"""Outputs that may come: neither warnings on stderr nor errors."""
NETWORK = "networks"
"""The one that needs torch."""
every = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def code(notebook: dict[str, Any]) -> list[dict[str, Any]]:
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def read(path: Path) -> dict[str, Any]:
    notebook: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return notebook


def kinds(cell: dict[str, Any]) -> list[tuple[str, ...]]:
    """What came out of a cell, without what it says; neighbouring texts count as one."""
    found: list[tuple[str, ...]] = []
    for output in cell["outputs"]:
        kind = output["output_type"], output.get("name", ""), *sorted(output.get("data", {}))
        if kind[0] != "stream" or found[-1:] != [kind]:
            found.append(kind)
    return found


def words(cell: dict[str, Any]) -> str:
    """All text that came out of a cell, without pictures."""
    texts = []
    for output in cell["outputs"]:
        texts += [output.get("text", "")]
        texts += [text for kind, text in output.get("data", {}).items() if kind.startswith("text/")]
    return re.sub(r"data:image/png;base64,[A-Za-z0-9+/=]+", "", "\n".join("".join(text) for text in texts))


def test_every_notebook_is_in_the_order_to_learn_by_and_leads_to_the_next() -> None:
    """The site's list and the page of tutorials name each file, and each but the last ends with a link to the next.

    (Planted: a name missing from the list, a link to the notebook after the next.)"""
    site = (ROOT / "docs" / "conf.py").read_text(encoding="utf-8")
    order = ast.literal_eval(re.sub(r"\nTUTORIALS \+=", ",", re.findall(r"^TUTORIALS = (.*\n.*)", site, flags=re.M)[0]))
    assert sorted(order) == [path.stem for path in NOTEBOOKS]
    assert re.findall(r"\((\w+)\.ipynb\)", (DOCS / "index.md").read_text(encoding="utf-8")) == [*order]
    for name, following in itertools.pairwise(order):
        last = "".join(read(DOCS / f"{name}.ipynb")["cells"][-1]["source"])
        assert "## Try next\n" in last and f"]({following}.ipynb)" in last


@every
def test_a_notebook_asks_one_question_answers_it_and_is_short(path: Path) -> None:
    """(Planted: an answer removed, an eleventh cell.)"""
    cells = read(path)["cells"]
    first, last = ("".join(cells[number]["source"]) for number in (0, -1))
    assert len(cells) <= MOST_CELLS
    assert first.startswith("# ") and "\n**Question.** " in first and "\n**Expectation.** " in first
    assert last.startswith("**Answer.** ")


@every
def test_every_name_is_one_of_the_face(path: Path) -> None:
    used = {
        node.attr
        for cell in code(read(path))
        for node in ast.walk(ast.parse("".join(cell["source"])))
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "ms"
    }
    assert used and used <= {*mitsim.__all__, "__file__"}


@every
def test_what_is_stored_is_fit_for_anybody(path: Path) -> None:
    cells = code(read(path))
    assert path.stat().st_size < LARGEST
    assert [cell["execution_count"] for cell in cells] == [*range(1, len(cells) + 1)]
    for cell in cells:
        assert not re.search(r"/(tmp|work|home|root|Users)\b| object at 0x|[Ww]arning", words(cell))
        assert {kind[:2] for kind in kinds(cell)} <= FIT


@pytest.mark.parametrize("path", [pytest.param(path, id=path.stem, marks=pytest.mark.slow) for path in NOTEBOOKS])
def test_it_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From top to bottom in an empty folder, by this Python, without the user's settings; the same kinds come out."""
    if path.stem == NETWORK:
        pytest.importorskip("torch", reason="torch is an extra: pip install 'mitsim[learn]'")
    import nbformat
    from jupyter_client.kernelspec import KernelSpecManager
    from jupyter_client.manager import AsyncKernelManager
    from nbclient import NotebookClient

    for name in ("IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_RUNTIME_DIR", "MPLCONFIGDIR"):
        (tmp_path / name).mkdir()
        monkeypatch.setenv(name, str(tmp_path / name))
    monkeypatch.delenv("MPLBACKEND", raising=False)
    empty = tmp_path / "empty"
    empty.mkdir()
    # Without folders of kernels only that of this Python is known.
    kernel = AsyncKernelManager(kernel_name="python3", kernel_spec_manager=KernelSpecManager(kernel_dirs=[]))
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, km=kernel, timeout=600, resources={"metadata": {"path": str(empty)}}).execute(
        cleanup_kc=True  # a manager of one's own would leave its kernel running, with a gigabyte
    )
    assert not kernel.has_kernel
    for cell, stored in zip(code(notebook), code(read(path)), strict=True):
        assert kinds(cell) == kinds(stored), cell["source"]

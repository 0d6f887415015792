"""Figures that marked tests measure in, docs/robustness.md out; `make robustness` runs all of them.

    pytestmark = pytest.mark.robustness("Optics")           # or on one test: the table in which it stands

    def test_a_slit(measured) -> None:
        measured(error, at_most=1e-12, what="far field")    # holds the gate, and writes figure and gate down

A row of the page is a test that measured: its name in words, figures and gates. The files of a table, and the number of
their other marked tests, are below it. The rest of the page is tests/robustness.md, where a table's name in braces
stands for it.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pytest

TEMPLATE = Path(__file__).with_suffix(".md")
RECORDS = Path("docs/_build/robustness.json")
"""All figures so far, so that a part of the tests renews its own rows only."""

MOST_FIGURES = 4
"""Figures that a row lists one by one, because more do not fit a row."""


@dataclass
class Figure:
    """What was measured, and the gate that the test holds it to."""

    value: float
    at_most: float | None = None
    at_least: float | None = None
    unit: str = ""

    @property
    def strain(self) -> float:
        """How near the gate the figure is: 1 touches it."""
        if self.at_least is not None:
            return self.at_least / self.value if self.value else math.inf
        return abs(self.value) / self.at_most if self.at_most else abs(self.value)


@dataclass
class Row:
    """One marked test: figures by what they are of, of all its parameters."""

    table: str
    file: str
    line: int
    name: str
    cases: list[str] = field(default_factory=list)
    figures: dict[str, Figure] = field(default_factory=dict)

    def add(self, other: Row) -> None:
        """The cases and figures of another run of the same test, which replace older ones."""
        self.line = other.line
        self.cases = list(dict.fromkeys([*self.cases, *other.cases]))
        self.figures |= other.figures

    @property
    def words(self) -> str:
        return self.name.removeprefix("test_").replace("_", " ")


class Recorder:
    """``measured(value, at_most=gate)``: asserts the gate and keeps the figure; of many examples the nearest to it."""

    def __init__(self) -> None:
        self.figures: dict[str, Figure] = {}

    def __call__(
        self,
        value: float,
        *,
        at_most: float | None = None,
        at_least: float | None = None,
        what: str = "",
        unit: str = "",
    ) -> None:
        figure = Figure(float(value), *(None if gate is None else float(gate) for gate in (at_most, at_least)), unit)
        if what not in self.figures or figure.strain > self.figures[what].strain:
            self.figures[what] = figure
        assert at_most is None or value <= at_most, f"{what} {value} {unit} is above {at_most}"
        assert at_least is None or value >= at_least, f"{what} {value} {unit} is below {at_least}"


RECORDER = Recorder()


@pytest.fixture(scope="session")
def measured() -> Recorder:
    """Of the session, because hypothesis takes no fixture of one test; every test starts without figures."""
    return RECORDER


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    RECORDER.figures = {}
    result = yield
    marker = item.get_closest_marker("robustness")
    if marker is not None and isinstance(item, pytest.Function):
        identity = item.nodeid[item.nodeid.index("[") + 1 : -1] if "[" in item.nodeid else ""
        row = Row(marker.args[0], item.location[0], item.location[1] or 0, item.originalname, [identity])
        for what, figure in RECORDER.figures.items():
            row.figures[", ".join(filter(None, (identity, what)))] = figure
        item.user_properties.append(("robustness", asdict(row)))
    return result


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--robustness", metavar="FILE", help="write the page of figures by tests marked `robustness`")


def pytest_configure(config: pytest.Config) -> None:
    page = config.getoption("--robustness")
    if page and not hasattr(config, "workerinput"):  # the parent of pytest-xdist's processes
        config.pluginmanager.register(Page(Path(page)))


class Page:
    """Collects the rows of all processes, and writes the page when every test has passed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        earlier = json.loads(RECORDS.read_text(encoding="utf-8")) if RECORDS.exists() else {}
        self.rows = {key: row_of(row) for key, row in earlier.items()}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        for name, value in report.user_properties:
            if name == "robustness" and report.when == "call" and report.passed:
                row = row_of(value)  # type: ignore[arg-type]
                self.rows.setdefault(f"{row.file}::{row.name}", row).add(row)

    def pytest_sessionfinish(self, exitstatus: int) -> None:
        RECORDS.parent.mkdir(parents=True, exist_ok=True)
        rows = {key: asdict(row) for key, row in self.rows.items()}
        RECORDS.write_text(json.dumps(rows, indent=1), encoding="utf-8")
        if exitstatus == 0:
            page = page_of(TEMPLATE.read_text(encoding="utf-8"), list(self.rows.values()))
            self.path.write_text(page, encoding="utf-8")


def row_of(values: dict[str, Any]) -> Row:
    return Row(**{**values, "figures": {what: Figure(**figure) for what, figure in values["figures"].items()}})


def page_of(template: str, rows: list[Row]) -> str:
    """The template with every table's name in braces replaced by the table; a table without a place is an error."""
    tables = {row.table for row in rows}
    places = set(re.findall(r"^\{(.+)\}$", template, flags=re.M))
    assert tables <= places, f"{TEMPLATE.name} has no place for {tables - places}"
    for name in places:
        ordered = sorted((row for row in rows if row.table == name), key=lambda row: (row.file, row.line))
        template = template.replace(f"{{{name}}}\n", table_of(ordered))
    return template


def table_of(rows: list[Row]) -> str:
    """Return a row for each test that measured something, and the files of all tests with the number of other ones."""
    lines = ["| case | measured | gate |", "|---|---|---|"]
    for row in rows:
        if row.figures:
            lines.append(f"| {' | '.join((named(row), *figures_of(row)))} |")
    lines = lines if len(lines) > 2 else []
    files = Counter({row.file: 0 for row in rows})
    files.update(row.file for row in rows if not row.figures)
    if files:
        links = (f"[{Path(file).name}](../{file})" + (f" ({n} more)" if n else "") for file, n in files.items())
        lines += [*([""] if lines else []), f"Tests: {', '.join(links)}."]
    return "\n".join([*lines, ""])


def named(row: Row) -> str:
    """Return the name of a test in words, with the number of its cases."""
    return row.words + (f" ({len(row.cases)} cases)" if len(row.cases) > 1 else "")


def figures_of(row: Row) -> tuple[str, str]:
    """The cells of a row: its figures, or their range when they are many, and the gate or the range of gates."""
    figures = list(row.figures.items())
    units = {figure.unit for _, figure in figures}
    if len(figures) > MOST_FIGURES:
        values = [figure.value for _, figure in figures]
        shown = f"{len(values)} figures, {number(min(values))} to {number(max(values))} {units.pop()}".strip()
    else:
        shown = "; ".join(
            f"{what}{': ' if what else ''}{number(figure.value)} {figure.unit}".strip() for what, figure in figures
        )
    gates = []
    for sign, values in (
        ("<=", [figure.at_most for _, figure in figures if figure.at_most is not None]),
        (">=", [figure.at_least for _, figure in figures if figure.at_least is not None]),
    ):
        ends = list(dict.fromkeys(number(value) for value in (min(values), max(values)))) if values else []
        gates += [f"{sign} {' to '.join(ends)}"] if ends else []
    return shown.replace("|", "\\|"), ", ".join(gates)


def number(value: float) -> str:
    """A whole number as such, anything else with two digits."""
    text = str(int(value)) if abs(value) < 1e5 and value == int(value) else f"{value:.2g}"
    return text.replace("e-0", "e-").replace("e+0", "e").replace("e+", "e")

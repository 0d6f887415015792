"""What all studies share: one folder each, which holds nothing else, and a JSON that says what it is."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from matplotlib.figure import Figure

from mitsim.bench.request import Request
from mitsim.core.errors import MitsimError
from mitsim.report import plots
from mitsim.studies import STUDIES
from mitsim.studies.framework.campaign import Findings, StudyResult, find_study, run_study, study_folder
from tests.unit.studies.test_colour_by_line import main

BENCH: Any = SimpleNamespace(loaded=SimpleNamespace(path=Path("scene.xml")))


@dataclass(frozen=True)
class Toy(Findings):
    """Findings of a study that measures nothing."""

    value: float

    def payload(self) -> dict[str, Any]:
        return {"rows": [self.value]}

    def lines(self) -> list[str]:
        return [f"It is {self.value:g}."]

    def figures(self) -> dict[str, Figure]:
        return {"toy.png": plots.error_bars({"a": self.value, "b": 1.0}), "none.png": plots.error_bars({"a": 1.0})}


def run(folder: Path, value: float = 1.0, name: str = "toy") -> StudyResult:
    return run_study(name, lambda bench, request, job: Toy(value), BENCH, folder, Request.of(seed=4))


def test_a_study_is_its_measure_and_the_runner_does_the_rest(tmp_path: Path) -> None:
    """A chart of one point is not drawn. (Planted: it is.)"""
    result = run(tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["toy.json", "toy.png"]
    written = json.loads((tmp_path / "out" / "toy.json").read_text())
    payload = {"rows": [1.0], "scene": "scene.xml", "patterns": "dots:7", "output": str(tmp_path / "out")}
    assert result.payload() == payload and payload.items() <= written.items()
    assert written["kind"] == "toy" and written["seed"] == 4 and "mitsim" in written["versions"]
    assert result.lines()[1] == "It is 1." and str(tmp_path / "out") in result.lines()[0]


class Doubtful(Toy):
    """Findings that say so."""

    warnings = ("a cause is missing",)


def test_findings_that_may_not_be_trusted_end_with_1(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """(Planted: no warnings on the command line.)"""
    monkeypatch.setattr("mitsim.verbs.open_as", lambda *_: BENCH)
    for number, (toy, status) in enumerate(((Toy, 0), (Doubtful, 1))):
        measure = partial(run_study, "calibration", lambda bench, request, job, toy=toy: toy(1.0))
        monkeypatch.setattr("mitsim.studies.framework.campaign.find_study", lambda *_, measure=measure: measure)
        assert main(["study", "calibration", "-o", str(tmp_path / f"{number}")]) == status
        assert ("mitsim: warning: a cause is missing" in capsys.readouterr().err) == bool(status)


def test_a_study_replaces_an_earlier_one_of_its_name_alone(tmp_path: Path) -> None:
    run(tmp_path / "out")
    run(tmp_path / "out", 2.0)
    assert json.loads((tmp_path / "out" / "toy.json").read_text())["rows"] == [2.0]
    with pytest.raises(MitsimError, match="holds files already"):
        run(tmp_path / "out", name="other")
    (tmp_path / "out" / "letter.txt").write_text("keep me")
    with pytest.raises(MitsimError, match="holds files already"):
        run(tmp_path / "out")
    assert json.loads((tmp_path / "out" / "toy.json").read_text())["rows"] == [2.0]


@pytest.mark.parametrize("text", ["", "{", "[]", '{"kind": "recipe"}', '{"rows": []}'])
def test_a_json_of_something_else_is_no_earlier_study(tmp_path: Path, text: str) -> None:
    (tmp_path / "toy.json").write_text(text)
    with pytest.raises(MitsimError, match=r"toy\.json|holds files"), study_folder(tmp_path, "toy"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["toy.json"]


def test_a_study_that_fails_leaves_no_new_folder(tmp_path: Path) -> None:
    def broken(bench: Any, request: Any, job: Any) -> Toy:
        raise MitsimError("no light")

    with pytest.raises(MitsimError, match="no light"):
        run_study("toy", broken, BENCH, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", STUDIES)
def test_every_study_can_be_found(name: str) -> None:
    assert callable(find_study(name))


def test_another_name_is_refused_with_the_studies() -> None:
    with pytest.raises(MitsimError, match=r"'weather'.*calibration, patterns"):
        find_study("weather")

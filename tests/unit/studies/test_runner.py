"""What all studies share: one folder each, which holds nothing else, and a JSON that says what it is."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from mitsim.core.errors import MitsimError
from mitsim.report import plots
from mitsim.studies.framework.campaign import StudyResult, study_folder, write_figures
from mitsim.verbs import study
from tests.unit.studies.test_colour_by_line import main


def test_a_figure_without_axes_is_not_written(tmp_path: Path) -> None:
    """(Planted: it is.)"""
    figures = {"toy.png": plots.singular_values({"a": [2.0, 1.0]}), "none.png": Figure()}
    assert [*write_figures(tmp_path, figures)] == ["toy.png"] == [path.name for path in tmp_path.iterdir()]


def test_findings_that_may_not_be_trusted_end_with_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """(Planted: no warnings on the command line.)"""
    for warnings, status in (((), 0), (("a cause is missing",), 1)):
        found = StudyResult("calibration", "out", warnings=warnings)
        monkeypatch.setattr("mitsim.study", lambda *_, found=found, **__: found)
        assert main(["study", "calibration", "-o", "out"]) == status
        assert ("mitsim: warning: a cause is missing" in capsys.readouterr().err) == bool(status)


def write(folder: Path, name: str) -> None:
    with study_folder(folder, name) as place:
        (place / f"{name}.json").write_text(json.dumps({"kind": name}))


def test_a_study_replaces_an_earlier_one_of_its_name_alone(tmp_path: Path) -> None:
    write(tmp_path / "out", "toy")
    write(tmp_path / "out", "toy")
    with pytest.raises(MitsimError, match="holds files already"):
        write(tmp_path / "out", "other")
    (tmp_path / "out" / "letter.txt").write_text("keep me")
    with pytest.raises(MitsimError, match="holds files already"):
        write(tmp_path / "out", "toy")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["letter.txt", "toy.json"]


@pytest.mark.parametrize("text", ["", "{", "[]", '{"kind": "recipe"}', '{"rows": []}'])
def test_a_json_of_something_else_is_no_earlier_study(tmp_path: Path, text: str) -> None:
    (tmp_path / "toy.json").write_text(text)
    with pytest.raises(MitsimError, match=r"toy\.json|holds files"), study_folder(tmp_path, "toy"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["toy.json"]


def test_a_study_that_fails_leaves_no_new_folder(tmp_path: Path) -> None:
    with pytest.raises(MitsimError, match="no light"), study_folder(tmp_path / "out", "toy"):
        raise MitsimError("no light")
    assert not (tmp_path / "out").exists()


def test_another_name_is_refused_with_the_studies() -> None:
    with pytest.raises(MitsimError, match=r"'weather'.*patterns, .*calibration"):
        study("weather")

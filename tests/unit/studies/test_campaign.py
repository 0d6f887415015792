"""Studies of many points: every point once, resumed, sharded and merged to the same bytes, a killed worker's loss."""

import csv
import io
import json
import os
import pickle
import re
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.report import plots
from mitsim.studies.framework import campaign
from mitsim.studies.framework.campaign import StudyResult, Where, merge, run_experiment, shard_of, study_folder
from mitsim.studies.framework.experiment import Scope, Setup
from mitsim.studies.framework.panels import write_page
from mitsim.verbs import study
from tests.unit.studies.test_colour_folders import main

pytestmark = pytest.mark.usefixtures("draft_figures")

TOY = "tests.unit.studies.toy_study"
ROOT = Path(__file__).parents[3]
SCOPE = Scope(Setup("photograph"), (None,))
ALL = {f"{place}{number}" for place in "abcd" for number in (1, 2, 3)}
Run = Callable[..., StudyResult]
Whole = tuple[StudyResult, Path]


def set_up(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """The toy study can be imported, here and in workers, and tells of its points in a ``folder``."""
    patch.setenv("TOY_FOLDER", str(folder))
    patch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]))
    patch.syspath_prepend(str(ROOT))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, draft_figures: None) -> Whole:
    """All of it in one go, and its folder, which is not to be changed."""
    folder = tmp_path_factory.mktemp("toy")
    with pytest.MonkeyPatch.context() as patch:
        set_up(folder, patch)
        return run_experiment(TOY, SCOPE, folder / "whole", where=Where(jobs=1)), folder / "whole"


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    """Runs the toy study into a folder of that name; ``run.begun()`` are the points that were begun since."""
    set_up(tmp_path, monkeypatch)

    def call(name: str = "out", scope: Scope = SCOPE, **where: object) -> StudyResult:
        return run_experiment(TOY, scope, tmp_path / name, where=Where(**{"jobs": 1, **where}))  # type: ignore[arg-type]

    yield call
    sys.modules.pop(TOY, None)


@pytest.fixture
def copied(run: Run, whole: Whole, tmp_path: Path) -> Path:
    """The folder of the whole study, which may be changed."""
    return Path(shutil.copytree(whole[1], tmp_path / "out"))


def begun(folder: Path) -> list[str]:
    """Points that were begun since the last call."""
    file = folder / "begun"
    names = file.read_text().split() if file.exists() else []
    file.unlink(missing_ok=True)
    return sorted(names)


def contents(folder: Path) -> dict[str, bytes]:
    """All that tells of results: time and place apart."""
    kept = {
        file.name: re.sub(rb"\d{4}-\d\d-\d\d \d\d:\d\d", b"", file.read_bytes())  # of the page's title
        for file in folder.iterdir()
        if file.suffix in (".csv", ".png", ".svg", ".pdf", ".html")
    }
    reported = json.loads((folder / "toy.json").read_text())
    return kept | {"rows": json.dumps([reported["rows"], reported["claims"], reported["figures"]]).encode()}


def test_every_point_is_measured_once_and_put_together(run: Run, tmp_path: Path) -> None:
    result = run(jobs=2)
    assert begun(tmp_path) == sorted(ALL) and result.points == 12 and not result.missing
    assert [claim.verdict for claim in result.claims] == ["confirmed"]
    folder = tmp_path / "out"
    assert {file.name for file in folder.iterdir()} == {
        *("toy.json", "toy.csv", "toy.html", "squares.png", "squares.svg", "squares.pdf", "points")
    }
    rows = list(csv.DictReader((folder / "toy.csv").open()))
    assert [row["place"] + row["number"] for row in rows] == sorted(ALL), "in the order of the points"
    reported = json.loads((folder / "toy.json").read_text())
    assert reported["rows"][4]["square"] == float(rows[4]["square"]) == pytest.approx(4, abs=0.1)
    assert reported["status"] == "complete" and reported["kind"] == "toy" and reported["figures"] == ["squares.png"]
    page = (folder / "toy.html").read_text()
    assert "Two squared is four" in page and "data:image/svg+xml;base64," in page and "<script" not in page
    # (Planted: no command in the page; none in the JSON.)
    run_experiment(TOY, SCOPE, folder, Job(command="mitsim study toy"), Where(jobs=1))
    assert "<code>mitsim study toy</code>" in (folder / "toy.html").read_text()
    assert json.loads((folder / "toy.json").read_text())["command"] == "mitsim study toy"


def test_what_is_there_is_not_measured_again(run: Run, tmp_path: Path, whole: Whole) -> None:
    """Quick points first, then all; results equal those of one go. (Planted: points named by their place.)"""
    run("two", Scope(SCOPE.setup, (None,), quick=True))
    assert begun(tmp_path) == sorted(point for point in ALL if point[1] != "3")
    run("two")
    assert begun(tmp_path) == sorted(point for point in ALL if point[1] == "3")
    assert contents(tmp_path / "two") == contents(whole[1])


@pytest.mark.parametrize("count", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_shards_share_the_points_and_merge_to_the_same(run: Run, tmp_path: Path, whole: Whole, count: int) -> None:
    parts = [tmp_path / f"part{number}" for number in range(count)]
    for number, part in enumerate(parts, start=1):
        found = run(part.name, shard=(number, count))
        assert found.missing == 12 - found.points and not found.claims and "merge" in found.lines()[-1]
    assert begun(tmp_path) == sorted(ALL), "each point in one part"
    joined = merge(parts, tmp_path / "joined", TOY)
    assert begun(tmp_path) == [] and not joined.missing
    assert contents(tmp_path / "joined") == contents(whole[1])
    assert merge(parts[1:], tmp_path / "half", TOY).missing == len(list((parts[0] / "points").iterdir()))


def test_all_studies_are_sharded_and_merged_too(
    run: Run, tmp_path: Path, whole: Whole, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On one page. (Planted: parts merged as one study's.)"""
    monkeypatch.setattr(campaign, "PAPER", (TOY,))
    parts = [tmp_path / f"part{number}" for number in (1, 2)]
    for number, part in enumerate(parts, start=1):
        found = run_experiment("all", SCOPE, part, where=Where((number, 2), jobs=1))
        assert found.missing == 6 and not (part / "all.html").exists()
    joined = merge(parts, tmp_path / "whole", TOY)
    assert not joined.missing and begun(tmp_path) == sorted(ALL)
    assert [claim.verdict for claim in joined.claims] == ["confirmed"] and joined.figures == (f"{TOY}/squares.png",)
    assert "Two squared is four" in (tmp_path / "whole" / "all.html").read_text()
    assert contents(tmp_path / "whole" / TOY) == contents(whole[1])


def test_a_page_of_several_has_each_claim_under_its_study(whole: Whole, tmp_path: Path) -> None:
    """(Planted: one table without studies.)"""
    section = whole[0].section
    assert section
    page = write_page([section, replace(section, name="other")], tmp_path / "page.html", "Two")
    summary = page.read_text().split("<h2")[1]
    first, second = (summary.index(f'<a href="#{each}">') for each in (section.name, "other"))
    claim = summary.index("Two squared is four")
    assert first < claim < second < summary.index("Two squared is four", claim + 1)


def test_a_killed_worker_loses_its_point_only(
    run: Run, tmp_path: Path, whole: Whole, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And nothing that processes leave in their temporary folders stays. (Planted: their folder the parent's.)"""
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setenv("TMPDIR", str(scratch))  # for the processes
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    (tmp_path / "fatal b2").write_text("once")
    assert not run(jobs=2).missing
    assert list(scratch.iterdir()) == []
    assert begun(tmp_path) == sorted([*ALL, "b2"])
    assert contents(tmp_path / "out") == contents(whole[1])


def test_a_point_that_kills_again_ends_the_study_and_keeps_the_rest(run: Run, tmp_path: Path) -> None:
    (tmp_path / "fatal d1").write_text("always")
    with pytest.raises(MitsimError, match=r"2 processes ended at one point \(mask = d, number = 1\).*exit code -9"):
        run(jobs=1)
    assert begun(tmp_path) == sorted([*(point for point in ALL if point[0] != "d"), "d1", "d1"])
    (tmp_path / "fatal d1").unlink()
    assert not run().missing
    assert begun(tmp_path) == ["d1", "d2", "d3"]


def test_what_a_point_refuses_is_one_line_and_the_rest_is_kept(run: Run, tmp_path: Path) -> None:
    (tmp_path / "refuse c3").touch()
    with pytest.raises(MitsimError, match="number 3: is not wanted; give another"):
        run(jobs=1)
    (tmp_path / "refuse c3").unlink()
    begun(tmp_path)
    assert not run().missing
    assert begun(tmp_path) == ["c3", "d1", "d2", "d3"]


def npy_header(shape: tuple[int, ...], kind: str) -> bytes:
    """The beginning of an NPY file that claims such an array."""
    held = io.BytesIO()
    np.lib.format.write_array_header_1_0(held, {"descr": kind, "fortran_order": False, "shape": shape})
    return held.getvalue()


def packed(**parts: bytes) -> bytes:
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in parts.items():
            file.writestr(f"{name}.npy", content)
    return held.getvalue()


UNREAD = "cannot be read as a point of a study .*"
DAMAGED = {
    UNREAD + "not a zip.* remove": packed(rows=b"hello")[:50],
    UNREAD + "it is empty: the disk was full.* remove": b"",
    UNREAD + "claims 549755813888 bytes": packed(rows=npy_header((1 << 36,), "<f8") + bytes(1 << 20)),
    UNREAD + "more than 10000 arrays": packed(**{str(number): b"" for number in range(10_001)}),
    UNREAD + "objects of Python": packed(rows=npy_header((1,), "|O") + pickle.dumps([1])),
    UNREAD + "magic string": packed(rows=b"hello"),
    UNREAD + "rows": packed(other=npy_header((1 << 20,), "|u1") + bytes(1 << 20)),
    "would take about 64 MiB of memory": packed(rows=npy_header((1 << 25,), "|u1") + bytes(1 << 25)),
}


@pytest.mark.parametrize("reason", DAMAGED)
def test_a_damaged_or_hostile_point_is_named_and_takes_no_memory(
    run: Run, copied: Path, monkeypatch: pytest.MonkeyPatch, reason: str
) -> None:
    """(Planted: read by numpy, which allocates what a header claims.)"""
    file = sorted((copied / "points").iterdir())[0]
    file.write_bytes(DAMAGED[reason])
    monkeypatch.setattr("mitsim.core.job.free_memory", lambda: 2**26)
    with pytest.raises(MitsimError, match=f"{file.name}: {reason}"):
        run()


def test_no_module_is_imported_because_a_file_names_it(
    copied: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither of a study, nor of one among all. (Planted: the file's name taken.)"""
    for file in (tmp_path / "modules" / "harmless.py", tmp_path / "modules" / "lab" / "study.py"):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    monkeypatch.syspath_prepend(str(tmp_path / "modules"))
    reported = json.loads((copied / "toy.json").read_text())
    for name in ("lab.study", "harmless", "..harmless", "os.path", ["lab.study"], {"a": 1}, None, 3, "\x1b[2J.a"):
        (copied / "toy.json").write_text(json.dumps({**reported, "study": name}))
        for experiment in (None, TOY):
            with pytest.raises(MitsimError, match=r"is of the study .*merged by its name") as refusal:
                merge([copied], tmp_path / "joined", experiment)
            assert str(refusal.value).isprintable()
    assert not (tmp_path / "ran").exists() and not (tmp_path / "joined").exists()


def test_parts_of_other_versions_are_not_signed_by_this_one(run: Run, copied: Path, whole: Whole) -> None:
    """Though all parts are of the same; nor is it resumed. (Planted: parts held against each other alone.)"""
    reported = json.loads((copied / "toy.json").read_text())
    (copied / "toy.json").write_text(json.dumps({**reported, "versions": {**reported["versions"], "mitsim": "0.1"}}))
    for parts in ([copied, copied], [whole[1], copied]):
        with pytest.raises(MitsimError, match=r"is of another study or scope than .* was measured by other versions"):
            merge(parts, copied.parent / "joined", TOY)
    assert not (copied.parent / "joined").exists()
    with pytest.raises(MitsimError, match="measured by other versions"):
        run()


def test_bad_folders_are_refused(run: Run, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").touch()
    with pytest.raises(MitsimError, match="holds files already"):
        run("other")
    with pytest.raises(MitsimError, match="holds no part of a study"):
        merge([tmp_path / "other"], tmp_path / "joined")


@pytest.mark.parametrize("text", ["", "1", "0/2", "3/2", "a/b", "1/2/3", "-1/2", "1/0"])
def test_a_shard_is_part_i_of_n(text: str) -> None:
    with pytest.raises(MitsimError, match="give I/N"):
        shard_of(text)
    assert shard_of("2/4") == (2, 4)


@pytest.mark.slow
def test_a_cluster_gives_the_same(run: Run, tmp_path: Path) -> None:
    """A real scheduler and two workers of Dask."""
    distributed = pytest.importorskip("distributed")
    run("here")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        run("there", scheduler=cluster.scheduler_address)
    assert contents(tmp_path / "here") == contents(tmp_path / "there")
    with pytest.raises(MitsimError, match="no Dask scheduler answers there"):
        run("nobody", scheduler="tcp://127.0.0.1:9")


# -------- Folders and names of all studies


def test_a_figure_without_axes_is_not_written(tmp_path: Path) -> None:
    """(Planted: it is.)"""
    figures = {"toy.png": plots.image_grid({"": [(np.zeros((2, 2)), "")]}, ["a"]), "none.png": Figure()}
    assert [*campaign.write_figures(tmp_path, figures)] == ["toy.png"]
    assert {path.name for path in tmp_path.iterdir()} == {"toy.png", "toy.svg", "toy.pdf"}


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

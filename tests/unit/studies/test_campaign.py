"""Studies of many points: every point once, resumed, sharded and merged to the same bytes, a killed worker's loss."""

import csv
import io
import json
import os
import pickle
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.studies.framework import campaign
from mitsim.studies.framework.campaign import StudyResult, Where, merge, run_experiment, shard_of
from mitsim.studies.framework.experiment import Scope, Setup
from mitsim.studies.framework.panels import write_page

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


def begun(folder: Path) -> list[str]:
    """Points that were begun since the last call."""
    file = folder / "begun"
    names = file.read_text().split() if file.exists() else []
    file.unlink(missing_ok=True)
    return sorted(names)


def contents(folder: Path) -> dict[str, bytes]:
    """All that tells of results: time and place apart."""
    kept = {file.name: file.read_bytes() for file in folder.iterdir() if file.suffix in (".csv", ".png", ".html")}
    reported = json.loads((folder / "toy.json").read_text())
    return kept | {"rows": json.dumps([reported["rows"], reported["claims"], reported["figures"]]).encode()}


def test_every_point_is_measured_once_and_put_together(run: Run, tmp_path: Path) -> None:
    result = run(jobs=2)
    assert begun(tmp_path) == sorted(ALL) and result.points == 12 and not result.missing
    assert [claim.verdict for claim in result.claims] == ["confirmed"]
    folder = tmp_path / "out"
    assert {file.name for file in folder.iterdir()} == {"toy.json", "toy.csv", "toy.html", "squares.png", "points"}
    rows = list(csv.DictReader((folder / "toy.csv").open()))
    assert [row["place"] + row["number"] for row in rows] == sorted(ALL), "in the order of the points"
    reported = json.loads((folder / "toy.json").read_text())
    assert reported["rows"][4]["square"] == float(rows[4]["square"]) == pytest.approx(4, abs=0.1)
    assert reported["status"] == "complete" and reported["kind"] == "toy" and reported["figures"] == ["squares.png"]
    page = (folder / "toy.html").read_text()
    assert "Two squared is four" in page and "data:image/svg+xml;base64," in page and "<script" not in page


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
        assert found.missing == 12 - found.points and not found.claims and "merge" in found.lines()[1]
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


def test_a_page_of_several_has_each_claim_under_its_command(whole: Whole, tmp_path: Path) -> None:
    """(Planted: one table without commands.)"""
    section = whole[0].section
    assert section
    page = write_page([section, replace(section, command="mitsim study other")], tmp_path / "page.html", "Two")
    summary = page.read_text().split("<h2")[1]
    first, second = (summary.index(f"<code>{each}</code>") for each in (section.command, "mitsim study other"))
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


def test_a_damaged_point_is_named(run: Run, tmp_path: Path, whole: Whole) -> None:
    shutil.copytree(whole[1], tmp_path / "out")
    file = sorted((tmp_path / "out" / "points").iterdir())[0]
    for content, reason in ((file.read_bytes()[:100], "not a zip"), (b"", "it is empty: the disk was full")):
        file.write_bytes(content)
        with pytest.raises(MitsimError, match=f"{file.name}: cannot be read as a point of a study .*{reason}.* remove"):
            run()


def test_no_module_is_imported_because_a_file_names_it(
    run: Run, tmp_path: Path, whole: Whole, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither of a study, nor of one among all. (Planted: the file's name taken.)"""
    folder = tmp_path / "modules"
    folder.mkdir()
    (folder / "harmless.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    (folder / "lab").mkdir()
    (folder / "lab" / "study.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    monkeypatch.syspath_prepend(str(folder))
    part = tmp_path / "part"
    shutil.copytree(whole[1], part)
    reported = json.loads((part / "toy.json").read_text())
    for name in ("lab.study", "harmless", "..harmless", "os.path", ["lab.study"], {"a": 1}, None, 3, "\x1b[2J.a"):
        (part / "toy.json").write_text(json.dumps({**reported, "study": name}))
        for experiment in (None, TOY):
            with pytest.raises(MitsimError, match=r"is of the study .*merged by its name") as refusal:
                merge([part], tmp_path / "joined", experiment)
            assert str(refusal.value).isprintable()
    assert not (tmp_path / "ran").exists() and not (tmp_path / "joined").exists()


def test_parts_of_other_versions_are_not_signed_by_this_one(run: Run, tmp_path: Path, whole: Whole) -> None:
    """Though all parts are of the same. (Planted: parts held against each other alone.)"""
    parts = [tmp_path / "a", tmp_path / "b"]
    for part in parts:
        shutil.copytree(whole[1], part)
        reported = json.loads((part / "toy.json").read_text())
        (part / "toy.json").write_text(json.dumps({**reported, "versions": {"mitsim": "0.1"}}))
    with pytest.raises(MitsimError, match="was measured by other versions"):
        merge(parts, tmp_path / "joined", TOY)
    assert not (tmp_path / "joined").exists()


def test_a_point_of_a_hostile_part_takes_no_memory(run: Run, tmp_path: Path, whole: Whole) -> None:
    """Half a terabyte claimed by a header, many arrays, objects of Python. (Planted: read by numpy, which allocates
    what a header claims.)"""
    shutil.copytree(whole[1], tmp_path / "out")
    file = sorted((tmp_path / "out" / "points").iterdir())[0]
    claims = npy_header((1 << 36,), "<f8") + bytes(1 << 20)
    many = npy_header((1 << 20,), "|u1") + bytes(1 << 20)
    for parts, reason in (
        ({"rows.npy": claims}, "claims 549755813888 bytes"),
        ({f"{number}.npy": b"" for number in range(10_001)}, "more than 10000 arrays"),
        ({"rows.npy": npy_header((1,), "|O") + pickle.dumps([1])}, "objects of Python"),
        ({"rows.npy": b"hello"}, "magic string"),
        ({"other.npy": many}, "rows"),
    ):
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
            for name, content in parts.items():
                packed.writestr(name, content)
        with pytest.raises(MitsimError, match=f"cannot be read as a point of a study .*{reason}"):
            run()


def test_a_zip_bomb_is_refused_before_it_is_unpacked(
    run: Run, tmp_path: Path, whole: Whole, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(whole[1], tmp_path / "out")
    file = sorted((tmp_path / "out" / "points").iterdir())[0]
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("rows.npy", npy_header((1 << 25,), "|u1") + bytes(1 << 25))
    monkeypatch.setattr("mitsim.core.job.free_memory", lambda: 2**26)
    with pytest.raises(MitsimError, match=f"{file.name}: would take about 64 MiB of memory"):
        run()


def npy_header(shape: tuple[int, ...], kind: str) -> bytes:
    """The beginning of an NPY file that claims such an array."""
    held = io.BytesIO()
    np.lib.format.write_array_header_1_0(held, {"descr": kind, "fortran_order": False, "shape": shape})
    return held.getvalue()


@pytest.mark.slow
def test_bad_folders_are_refused(run: Run, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").touch()
    with pytest.raises(MitsimError, match="holds files already"):
        run("other")
    with pytest.raises(MitsimError, match="holds no part of a study"):
        merge([tmp_path / "other"], tmp_path / "joined")
    run("new")
    head = tmp_path / "new" / "toy.json"
    reported = json.loads(head.read_text())
    head.write_text(json.dumps({**reported, "versions": {**reported["versions"], "mitsim": "0.1"}}))
    with pytest.raises(MitsimError, match="measured by other versions"):
        run("new")
    run("fresh")
    with pytest.raises(MitsimError, match="is of another study or scope than"):
        merge([tmp_path / "fresh", tmp_path / "new"], tmp_path / "joined")
    assert not (tmp_path / "joined").exists()


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

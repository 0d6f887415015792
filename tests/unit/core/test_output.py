"""Output places are refused before work, held against other processes, and filled with whole files only."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mitsim.core import files
from mitsim.core.environment import versions as all_versions
from mitsim.core.errors import MitsimError
from mitsim.core.exr import verify
from mitsim.core.files import LOCK, check_apart, output_file, output_folder, prepare_output, whole_file, whole_folder


def test_prepare_output_makes_the_folder(tmp_path: Path) -> None:
    assert files.prepare_output(str(tmp_path / "run")) == tmp_path / "run"
    assert (tmp_path / "run").is_dir()
    files.prepare_output(tmp_path / "run")  # empty: still free
    (tmp_path / "run" / "frame").touch()
    with pytest.raises(MitsimError, match="holds files already"):
        files.prepare_output(tmp_path / "run")
    files.prepare_output(tmp_path / "run", overwrite=True)
    assert (tmp_path / "run" / "frame").exists()


def test_prepare_output_for_a_file(tmp_path: Path) -> None:
    path = tmp_path / "frame.exr"
    assert files.prepare_output(path, kind="file") == path
    assert not path.exists()
    path.touch()
    with pytest.raises(MitsimError, match="exists already"):
        files.prepare_output(path, kind="file")
    files.prepare_output(path, overwrite=True, kind="file")
    with pytest.raises(MitsimError, match="is a folder"):
        files.prepare_output(tmp_path, kind="file")


def test_a_file_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_text("old")
    with pytest.raises(ValueError, match="half way"), whole_file(path) as part:
        part.write_text("ne")
        raise ValueError("half way")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    with whole_file(path) as part:
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


def test_a_folder_in_use_is_refused_and_free_again_afterwards(tmp_path: Path) -> None:
    with output_folder(tmp_path / "run") as folder:
        with pytest.raises(MitsimError, match="another mitsim is writing there"), output_folder(folder):
            pass
        assert (folder / LOCK).exists(), "a refusal does not take the lock away"
    assert not (folder / LOCK).exists()
    with output_folder(folder):
        pass


HOLD = """
import sys, time
from mitsim.core.files import output_folder
with output_folder(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_killed_process_holds_nothing(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path / "run")], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    with pytest.raises(MitsimError, match="another mitsim"), output_folder(tmp_path / "run"):
        pass
    process.kill()
    process.wait()
    process.stdout.close()
    assert (tmp_path / "run" / LOCK).exists()
    with output_folder(tmp_path / "run"):  # what it left behind does not count as content
        pass


def test_a_folder_made_for_nothing_goes_away(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), output_folder(tmp_path / "run"):
        raise KeyboardInterrupt
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_a_name_that_is_not_utf8_is_refused_before_work(tmp_path: Path, kind: str) -> None:
    """OpenEXR cannot open it, nor a terminal print it: it ended in a traceback after all the work."""
    path = Path(str(tmp_path) + "/\udcff.exr")  # the byte 0xff, as Python reads it from a command line
    with pytest.raises(MitsimError, match="is not UTF-8 text") as caught:
        files.prepare_output(path, kind=kind)
    assert str(caught.value).isprintable() and not list(tmp_path.iterdir())


def test_an_unfinished_calibration_is_not_to_be_emptied(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text('{"kind": "calibration", "status": "incomplete"}')
    (tmp_path / "left.exr").touch()
    (tmp_path / "responses.part.npz").touch()
    with pytest.raises(MitsimError, match="holds files already; continue with resume=True"):
        files.prepare_output(tmp_path)
    for text in ("{", "[" * 100_000, "[1]", '{"status": "complete"}'):
        (tmp_path / "manifest.json").write_text(text)
        with pytest.raises(MitsimError, match="holds files already; choose a new folder, or empty this one"):
            files.prepare_output(tmp_path)


@pytest.mark.parametrize(
    ("marks", "begun", "left"),
    [(("capture",), True, "new"), (("capture",), False, "old"), (("calibration", "pairs.json"), False, "old")],
)
def test_an_earlier_result_is_replaced_once_a_new_one_is_begun(
    tmp_path: Path, marks: tuple[str, ...], begun: bool, left: str
) -> None:
    """It comes back after a refusal, and a result of another kind is in the way as before. (Planted: the old result
    deleted at once; folders of all kinds moved.)"""
    run = tmp_path / "run"
    run.mkdir()
    (run / "manifest.json").write_text('{"kind": "capture"}')
    (run / "old").touch()
    refused = pytest.raises(MitsimError, match=r"refused|holds files already")
    with refused, files.replaced(run, marks), output_folder(run) as folder:
        if begun:
            (folder / "new").touch()
        raise MitsimError("refused")
    assert {"old", "new"} & {item.name for item in run.iterdir()} == {left} and [*tmp_path.iterdir()] == [run]


def test_the_working_folder_is_not_moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of relative names would be written beside it. (Planted: moved.)"""
    (tmp_path / "manifest.json").write_text('{"kind": "capture"}')
    monkeypatch.chdir(tmp_path)
    with files.replaced(Path(), ["capture"]):
        assert (tmp_path / "manifest.json").is_file()


def test_no_device_pipe_or_socket_is_replaced(tmp_path: Path) -> None:
    """`-o /dev/null` as root made a file of it, for the whole machine. (Planted: the check left out of either.)"""
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(tmp_path / "socket"))
        (tmp_path / "link").symlink_to("/dev/null")
        places = {"pipe": "a named pipe", "socket": "a socket", "link": "a device", "/dev/null": "a device"}
        for name, kind in places.items():
            path = tmp_path / name
            with pytest.raises(MitsimError, match=f"is {kind}, which a file would replace"):
                prepare_output(path, overwrite=True, kind="file")
            with pytest.raises(MitsimError, match=f"is {kind}"), whole_file(path) as part:
                part.write_text("x")
            assert not path.is_file()


def test_a_link_stays_and_its_file_is_written(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to("there/frame")
    with whole_file(tmp_path / "link") as part:
        part.write_text("new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "there" / "frame").read_text() == "new"
    assert [path.name for path in (tmp_path / "there").iterdir()] == ["frame"]


@pytest.mark.parametrize("name", ["n" * 251 + ".exr", "\u00e9" * 125 + ".exr"])
def test_the_longest_names_are_written(tmp_path: Path, name: str) -> None:
    """255 bytes: hidden files beside it have to be shorter. (Planted: the whole name in theirs, which failed once the
    work was done.)"""
    with output_file(tmp_path / name) as place, whole_file(place) as part:
        part.write_text("new")
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_link_to_itself_is_refused_in_a_line(tmp_path: Path) -> None:
    """(Planted: `Path.resolve`, which raises RuntimeError before Python 3.13; no check, and the link was replaced.)"""
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "other").write_text("x")
    check_apart(tmp_path / "loop", [tmp_path / "other"])
    check_apart(tmp_path / "other", [tmp_path / "loop"])
    with pytest.raises(MitsimError, match="leads to itself"), whole_file(tmp_path / "loop") as part:
        part.write_text("y")
    with pytest.raises(MitsimError, match="loop: cannot be read"):
        verify(tmp_path, "loop", {"loop": "0"}, "copy it again")
    assert (tmp_path / "loop").is_symlink() and sorted(path.name for path in tmp_path.iterdir()) == ["loop", "other"]


def test_one_of_two_writers_of_a_file_is_refused(tmp_path: Path) -> None:
    """By whatever name. (Planted: no lock, so that the later one won in silence.)"""
    (tmp_path / "link").symlink_to(tmp_path / "frame.exr")
    with output_file(tmp_path / "frame.exr", overwrite=True) as place:
        for name in ("frame.exr", "link"):
            with pytest.raises(MitsimError, match="another mitsim is writing there"), output_file(tmp_path / name):
                pass
        with output_file(tmp_path / "other.exr"):
            place.write_text("ours")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frame.exr", "link"]
    with pytest.raises(MitsimError, match="exists already"), output_file(place):
        pass


def test_what_is_read_is_not_replaced(tmp_path: Path) -> None:
    """(Planted: names compared.)"""
    (tmp_path / "run").mkdir()
    for name in ("frame.exr", "run/manifest.json"):
        (tmp_path / name).write_text("mine")
    (tmp_path / "hard").hardlink_to(tmp_path / "frame.exr")
    (tmp_path / "soft").symlink_to("frame.exr")
    inputs = tmp_path / "frame.exr", tmp_path / "run"
    for name in ("frame.exr", "hard", "soft", "run/../frame.exr", "run/manifest.json"):
        with pytest.raises(MitsimError, match="would replace"):
            check_apart(tmp_path / name, inputs)
    for name in ("new.exr", "run/new.h5"):
        check_apart(tmp_path / name, inputs)


def test_what_a_killed_process_left_is_removed_by_the_same_work(tmp_path: Path) -> None:
    """A folder whose files appear together is begun anew, and parts of a file go; those of other files stay."""
    killed = "import os, sys; from mitsim.core.files import output_file, whole_file, whole_folder\n"
    folder = f"{killed}with whole_folder(sys.argv[1]) as place:\n (place / 'a').write_text('b'); os._exit(9)"
    file = f"{killed}with output_file(sys.argv[1]) as place, whole_file(place) as part:\n part.touch(); os._exit(9)"
    others = tmp_path / ".run.h5.1-2.part", tmp_path / ".run.5.1-2.part"
    for code, name in ((folder, "pngs"), (file, "run")):
        assert subprocess.run([sys.executable, "-c", code, str(tmp_path / name)]).returncode == 9
    assert (tmp_path / "pngs" / "a").is_file() and len([*tmp_path.glob(".run.*.part")]) == 1
    for each in others:
        each.touch()
    with whole_folder(tmp_path / "pngs") as place:
        (place / "c").touch()
    with output_file(tmp_path / "run"):
        pass
    assert [path.name for path in (tmp_path / "pngs").iterdir()] == ["c"]
    assert {*tmp_path.glob(".run.*.part")} == {*others}
    with pytest.raises(MitsimError, match="holds files already"), whole_folder(tmp_path / "pngs"):
        pass


# ---- JSON files ------------------------------------------------------------------------------------------------------


def test_json_comes_back(tmp_path: Path) -> None:
    written = {"array": np.array([[1.5, 2.0]]), "count": np.int64(2**40), "where": Path("a/b"), "pair": (1, True)}
    plain = {"array": [[1.5, 2.0]], "count": 2**40, "where": "a/b", "pair": [1, True]}
    files.write_json(tmp_path / "m.json", {**written, "none": None, "worst": np.inf, "name": "µm"})
    assert files.read_json(tmp_path / "m.json") == {**plain, "none": None, "worst": None, "name": "µm"}
    assert [item.name for item in tmp_path.iterdir()] == ["m.json"]


def test_what_json_cannot_hold_is_refused_and_the_old_file_stays(tmp_path: Path) -> None:
    files.write_json(tmp_path / "m.json", {"a": 1})
    with pytest.raises(TypeError, match="object"):
        files.write_json(tmp_path / "m.json", {"a": object()})
    assert files.read_json(tmp_path / "m.json") == {"a": 1}


def test_reading_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(MitsimError, match=r"m\.json: cannot be read"):
        files.read_json(tmp_path / "m.json")
    (tmp_path / "m.json").write_text('{"a": ')
    with pytest.raises(MitsimError, match=r"m\.json: not valid JSON"):
        files.read_json(tmp_path / "m.json")


def test_versions_names_what_decides_the_numbers() -> None:
    versions = all_versions()
    assert {"mitsim", "mitsuba", "drjit", "numpy", "python"} <= set(versions)
    assert versions["numpy"] == np.__version__

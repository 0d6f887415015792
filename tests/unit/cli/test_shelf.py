"""`mitsim list` and `mitsim new`: what there is, said from where it stands; files to begin with, which load at once."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import typer

from mitsim.bench.effects import SWITCHES
from mitsim.cli import app
from mitsim.cli.shelf_verbs import KINDS
from mitsim.core.configuration import load_model, shipped_path
from mitsim.devices.camera import KINDS as MASK_KINDS
from mitsim.devices.camera import load_mask
from mitsim.devices.patterns import read_name
from mitsim.devices.projector import ProjectorModel
from mitsim.devices.sensor import load_sensor
from mitsim.devices.session import load_recipe
from mitsim.exchange.capture_list import load_capture_list
from mitsim.learn.requests import METHODS as LEARNED
from mitsim.reconstruct.request import METHODS
from mitsim.sessions.session_file import read_session
from mitsim.studies import EXPERIMENTS
from mitsim.studies.framework.experiment import Scope, Setup, find_experiment

PROGRAM: Any = typer.main.get_command(app)


def test_a_list_has_all_that_there_is() -> None:
    """And says of each what it is for, on one line. (Planted: studies' titles in place of their questions; an effect
    without a word.)"""
    listed = {kind: [*entries()] for kind, entries in KINDS.items()}
    names = {kind: [each.name for each in entries] for kind, entries in listed.items()}
    assert {*names["scenes"]} == {path.parent.name for path in shipped_path("scenes").glob("*/scene.xml")}
    shelf = {path.stem for path in shipped_path("calibration").glob("*.toml")}
    assert shelf - {"session", "drift", "flatcam", "diffusercam"} == {*names["cameras"], *names["projectors"]}
    assert names["effects"] == [*SWITCHES] and names["methods"] == [*METHODS, *LEARNED]
    assert {*names["studies"]} == {*EXPERIMENTS}
    assert all(each.serves.endswith("?") == (each.name in EXPERIMENTS) for each in listed["studies"])
    for entry in (entry for entries in listed.values() for entry in entries):
        assert len(entry.serves) > 12 and "\n" not in entry.serves + entry.what, entry
        assert not entry.serves.endswith(".") and "`" not in entry.serves, entry


@pytest.mark.slow
def test_a_study_is_listed_by_the_question_that_it_asks() -> None:
    """Read from its text, as Python has it."""
    listed = {entry.name: entry.serves for entry in KINDS["studies"]()}
    assert {name: find_experiment(name).question for name in EXPERIMENTS} == {
        name: listed[name] for name in EXPERIMENTS
    }


def test_a_camera_without_efficiency_says_that_it_is_a_sensor_only() -> None:
    """By its file. (Planted: every camera captures.)"""
    for entry in KINDS["cameras"]():
        sensor = load_sensor(shipped_path("calibration", f"{entry.name}.toml"))
        assert entry.serves.startswith("sensor only") == (sensor.mosaic is None and not sensor.states_efficiency)
        assert entry.what.startswith(sensor.name)


def test_lists_fit_the_terminal(shell_of: Callable[..., Any]) -> None:
    """Names first, what follows them below what they say. (Planted: no hanging indent.)"""
    with patch.dict(os.environ, COLUMNS="60"):
        lines = shell_of("list", "studies").splitlines()
    assert max(map(len, lines)) <= 60
    first = lines[0].index("What do")
    assert all(line[:first].split() in ([name] if (name := line[:first].strip()) else [[]], []) for line in lines)
    every = json.loads(shell_of("list", "--json"))
    assert [*every] == [*KINDS] and every["scenes"][0]["name"] == "cards"
    assert every["scenes"][0]["what"].startswith("Two printed diffuse cards")


@pytest.fixture
def shell_of(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """What a command line prints, which ends well."""

    def call(*words: object) -> str:
        assert PROGRAM.main([*map(str, words)], standalone_mode=False) == 0
        return capsys.readouterr().out

    return call


# ---- files to begin with ---------------------------------------------------------------------------------------------


def begun(shell_of: Callable[..., str], kind: str, path: Path, *words: str) -> Path:
    found = json.loads(shell_of("new", kind, "mine", "-o", path, *words, "--json"))
    assert found["output"] == str(path) and str(path) in found["use"] and found["use"].startswith("mitsim ")
    return path


@pytest.mark.parametrize("like", ["imx249", "imx477", "ov5647"])
def test_a_new_camera_loads(shell_of: Callable[..., str], tmp_path: Path, like: str) -> None:
    """With the numbers of the one that it is like. (Planted: fields that have a value and are left out.)"""
    path = begun(shell_of, "camera", tmp_path / "x.toml", "--like", like)
    made, other = load_sensor(path), load_sensor(shipped_path("calibration", f"{like}.toml"))
    assert made.model_copy(update={"name": other.name, "source": other.source}) == other and made.name == "mine"
    assert "# Distance between centres of pixels in a row, um.\npixel_pitch_um = " in path.read_text(encoding="utf-8")


def test_new_devices_sessions_and_lists_load(shell_of: Callable[..., str], tmp_path: Path) -> None:
    projector = load_model(begun(shell_of, "projector", tmp_path / "p.toml"), ProjectorModel)
    assert (projector.name, projector.columns) == ("mine", 1920)
    mask = begun(shell_of, "mask", tmp_path / "m.toml")
    found = load_mask(mask)
    assert load_sensor(mask).name == "mine" and found is not None and found.kind == "separable"
    assert load_recipe(begun(shell_of, "recipe", tmp_path / "s.toml")).signed_capture == "pair"
    assert load_recipe(begun(shell_of, "recipe", tmp_path / "d.toml", "--like", "drift")).drift is not None
    session = begun(shell_of, "session", tmp_path / "run.toml")
    assert read_session(session).steps == read_session("demo").steps
    assert session.read_text(encoding="utf-8").startswith(f"# Session mine. For example: mitsim run {session}")
    listed = load_capture_list(begun(shell_of, "list", tmp_path / "l.toml"))
    read_name(str(listed.patterns), listed.n)


@pytest.mark.parametrize("kind", MASK_KINDS)
def test_a_new_mask_is_of_any_kind(shell_of: Callable[..., str], tmp_path: Path, kind: str) -> None:
    """(Planted: always separable; what its kind cannot do without left out.)"""
    path = begun(shell_of, "mask", tmp_path / "m.toml", "--like", kind)
    found = load_mask(path)
    assert found is not None and found.kind == kind and load_sensor(path).name == "mine"


def test_a_new_study_is_one(shell_of: Callable[..., str], tmp_path: Path) -> None:
    """(Planted: the name of the one that it was copied from.)"""
    study = find_experiment(str(begun(shell_of, "study", tmp_path / "tilt.py")))
    points = study.points(Scope(Setup(), (None,), quick=True))
    assert study.name == "mine" and len(points) == 4
    assert {dict(point.setup.parameters)["sheet_z"] for point in points} == {"390", "400"}


@pytest.mark.parametrize("like", ["photograph", "colour_checker"])
def test_a_new_scene_is_a_folder_of_its_own(shell_of: Callable[..., str], tmp_path: Path, like: str) -> None:
    folder = begun(shell_of, "scene", tmp_path / "bench", "--like", like)
    shipped = shipped_path("scenes", like)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {
        path.name: path.read_bytes() for path in shipped.iterdir()
    }


@pytest.mark.parametrize(
    ("words", "fragments"),
    [
        ("list camera", ["did you mean cameras?", "patterns"]),
        ("new camra mine", ["did you mean camera?", "session"]),
        ("new camera 2x", ["a name of letters"]),
        ("new camera mine --like mp_cl1", ["no shipped camera", "imx249, imx249_rggb"]),
        ("new camera mine --like random", ["no shipped camera", "imx249, imx249_rggb"]),
        ("new mask mine --like rando", ["did you mean random?", "separable, flatcam", "imx249"]),
        ("new scene mine --like photo", ["did you mean photograph?"]),
        ("new study mine --like depth", ["--like", "leave it out"]),
        ("new camera mine -o mine.txt", ["mine.txt", ".toml"]),
        ("new camera mine -o there.toml", ["exists already"]),
        ("new scene mine -o full", ["holds files already"]),
    ],
)
def test_what_cannot_be_begun_is_refused(
    words: str, fragments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In one line, with nothing written. (Planted: files replaced.)"""
    from mitsim.core.errors import MitsimError

    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.toml").write_text("mine")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(MitsimError) as caught:
        PROGRAM.main(words.split(), standalone_mode=False)
    from mitsim.cli.commands import message_of

    message = message_of(caught.value)
    assert all(fragment in message for fragment in fragments) and "\n" not in message, message
    assert sorted(tmp_path.rglob("*")) == before and (tmp_path / "there.toml").read_text() == "mine"


def test_what_a_verb_made_is_replaced_if_asked(shell_of: Callable[..., str], tmp_path: Path) -> None:
    """A folder of pictures, a scene and a file; not a folder of another kind. (Planted: overwrite passed over.)"""
    from mitsim.core.errors import MitsimError

    made = {"patterns": ("uniform", "--projector-pixels", 4), "new": ("scene", "mine")}
    for verb, words in made.items():
        shell_of(verb, *words, "-o", tmp_path / verb)
        (tmp_path / verb / "stray").touch()
        shell_of(verb, *words, "-o", tmp_path / verb, "--overwrite")
        assert not (tmp_path / verb / "stray").exists()
    for like in ("imx249", "imx477"):
        shell_of("new", "camera", "mine", "-o", tmp_path / "c.toml", "--like", like, "--overwrite")
    assert load_sensor(tmp_path / "c.toml").bits == load_sensor(shipped_path("calibration", "imx477.toml")).bits
    with pytest.raises(MitsimError, match="holds files already"):
        shell_of("patterns", "uniform", "-o", tmp_path / "new", "--overwrite")


# ---- completion ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("mitsim cap", ["capture"]),
        ("mitsim capture cookie", ["cookie_bag"]),
        ("mitsim capture photograph --camera imx249", ["imx249", "imx249_rggb"]),
        ("mitsim plan photograph --projector m", ["mp_cl1"]),
        ("mitsim study dr", ["drift"]),
        ("mitsim reconstruct run --method t", ["tikhonov", "tv"]),
        ("mitsim train un", ["unrolled"]),
        ("mitsim import frames --list f", ["flatcam"]),
        ("mitsim list st", ["studies"]),
        ("mitsim new camera mine --like imx25", ["imx250", "imx255"]),
    ],
)
def test_a_shell_completes_names(line: str, words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """(Planted: cameras among projectors.)"""
    typed = line.split(" ")
    asked = {"_MITSIM_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(typed) - 1)}
    with patch.dict(os.environ, asked), pytest.raises(SystemExit) as ended:
        PROGRAM.main([], prog_name="mitsim", standalone_mode=False)
    assert ended.value.code == 0 and capsys.readouterr().out.split() == words

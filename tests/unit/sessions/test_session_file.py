"""Session files: what is read of them, and all mistakes at once, before anything heavy is imported. Nothing is
rendered."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path

import pytest

import mitsim as ms
from mitsim.api.bench import open_bench
from mitsim.bench.request import Request
from mitsim.core.configuration import shipped_path, value_of
from mitsim.sessions.session_file import fields_of, read_session, session_text

WHOLE = """
[scene]
scene = "bench/scene.xml"
camera = "camera.toml"
projector = "mp_cl1"
sheet_z = 402

[capture]
patterns = "dots:4"
effects = "-diffraction"

[calibrate]
recipe = "recipe.toml"

[[reconstruct]]
[[reconstruct]]
method = "tv"
bounds = [0, inf]
output = "smooth"

[[export]]
format = "hdf5"
output = "all.h5"
"""


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str], Path]:
    def write(text: str) -> Path:
        path = tmp_path / "session.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_tables_become_steps_in_order_with_folders_of_their_own(write: Callable[[str], Path], tmp_path: Path) -> None:
    """Relative paths count from the file; names of shipped files stay. (Planted: paths from the working folder; a
    shipped name that becomes a path; two images in one folder.)"""
    found = read_session(write(WHOLE))
    names = [(step.verb, step.output) for step in found.steps]
    assert names == [
        *(("capture", "run"), ("calibrate", "calibration"), ("reconstruct", "image"), ("reconstruct", "smooth")),
        ("export", "all.h5"),
    ]
    assert found.scene == {
        "scene": str(tmp_path / "bench/scene.xml"),
        "camera": str(tmp_path / "camera.toml"),
        "projector": "mp_cl1",
        "sheet_z": 402,
    }
    assert found.step("calibrate").values == {"recipe": str(tmp_path / "recipe.toml")}  # type: ignore[union-attr]
    assert found.steps[3].values == {"method": "tv", "bounds": [0, float("inf")]}
    several = read_session(write(f"{SCENE}[capture]\n[calibrate]\n[[reconstruct]]\n[[reconstruct]]\n"))
    assert [step.output for step in several.steps] == ["run", "calibration", "image", "image-2"]


def test_what_is_written_is_read_again(write: Callable[[str], Path]) -> None:
    """(Planted: a text with a quote in it that is not escaped.)"""
    found = read_session(write(WHOLE), {"scene.camera": 'a "b"\\c.toml', "capture.effects": {"diffraction": False}})
    again = read_session(write(session_text(found.tables)))
    assert (again.scene, again.steps) == (found.scene, found.steps)
    assert session_text({"scene": {"scene": "x", "odd name": 1e-3}}, None, "a note") == (
        '# a note\n\n[scene]\nscene = "x"\n"odd name" = 0.001\n'
    )


@pytest.mark.parametrize(
    "name", ["\U0001f600", "a\u0001\u007f\u0085b", "\u2028\u2029", "q\"'\\", "[capture]", "#", "\t", "\U0010ffff"]
)
def test_any_text_is_written_and_read_again(write: Callable[[str], Path], name: str) -> None:
    """As a value, a key and a list item. (Planted: JSON's spelling, in which a smile is two surrogates.)"""
    tables = {
        "scene": {"scene": "x", name: name},
        "study": [{"name": "sweep", "over": {name: [name, 1.5, True]}, "parameters": {name: -1e-300}}],
    }
    again = read_session(write(session_text(tables))).tables
    assert again["scene"] == tables["scene"] and again["study"] == tables["study"]


def test_a_note_begins_no_table(write: Callable[[str], Path]) -> None:
    """What a manifest brings into a comment stays in it. (Planted: a note that is written with its line ends.)"""
    notes = "a\n[export]\nformat = 'hdf5'", "b\r[study]", "c\x00\x1b[2J\u2028[study]", "d\x85[study]"
    text = session_text({"scene": {"scene": "x"}, "capture": {}}, None, *notes)
    assert read_session(write(text)).tables.keys() == {"scene", "capture"}
    assert all(line.startswith("#") and line.isprintable() for line in text.splitlines()[: len(notes)])


@pytest.mark.parametrize(
    "output",
    ["report.html", "pictures", "session.toml", "session.json", "Pictures", "REPORT.HTML", "./pictures", "x/../a.html",
     "pictures/", ".mitsim.lock", ".hidden", "..", "run", "RUN", "a/b", "/tmp/x", "Se\u017f\u017fion.toml"],
)  # fmt: skip
def test_names_of_others_are_refused(write: Callable[[str], Path], output: str) -> None:
    """Those that the session writes itself, and another step's, in any spelling that a disk may confuse.
    (Planted: names that are compared as they are written.)"""
    with pytest.raises(ms.MitsimError) as refused:
        read_session(write(f"{SCENE}[capture]\n[calibrate]\noutput = {output!r}\n"))
    assert "calibrate.output" in str(refused.value) and len(str(refused.value).splitlines()) <= 3


def test_paths_are_written_as_seen_from_the_file(write: Callable[[str], Path], tmp_path: Path) -> None:
    """And read again from there; a bare name is no shipped one. (Planted: `photograph` for `./photograph`; own patterns
    seen from the working folder.)"""
    (tmp_path / "s").mkdir()
    for name in ("photograph", "s/camera.toml", "s/own.npy"):
        (tmp_path / name).touch()
    tables = {
        "scene": {"scene": str(tmp_path / "s" / "photograph"), "camera": str(tmp_path / "s" / "camera.toml")},
        "capture": {"patterns": str(tmp_path / "s" / "own.npy")},
        "design": {"scene": "cards", "exposure_total_s": 1.0, "patterns": [str(tmp_path / "s" / "own.npy"), "dots:3"]},
        "reconstruct": [{"run": str(tmp_path / "run"), "calibration": "/elsewhere/cal"}],
    }
    text = session_text(tables, tmp_path / "s")
    assert 'scene = "./photograph"' in text and 'run = "../run"' in text and str(tmp_path) not in text
    (tmp_path / "s" / "session.toml").write_text(text)
    assert read_session(tmp_path / "s" / "session.toml").tables == tables


def test_fields_are_those_of_the_models() -> None:
    """A field that a model gains is one of the table's. (Planted: a field that a table leaves out.)"""
    assert Request.model_fields.keys() <= fields_of("capture").keys()
    named = {name for name, each in inspect.signature(open_bench).parameters.items() if each.kind < each.VAR_KEYWORD}
    assert fields_of("scene").keys() == named - {"for_render"}
    assert "lambda" in fields_of("reconstruct") and "shard" not in fields_of("study")


def test_all_mistakes_are_reported_at_once(write: Callable[[str], Path]) -> None:
    """(Planted: a table without a check.)"""
    text = (
        '[scene]\nscene = "photograph"\n[capture]\npatterns = "dotz:4"\nseed = -1\ncolour = "red"\n[calibrate]\n'
        'accuracy = 7.0\n[reconstruct]\nmethod = "wiener"\n[[export]]\nformat = "hdf6"\noutput = "a/b.h5"\n'
    )
    with pytest.raises(ms.MitsimError) as refused:
        read_session(write(text))
    head, *lines = str(refused.value).split("\n")
    assert head.endswith("session.toml: has 7 mistakes:")
    assert {line.strip().partition(": ")[0] for line in lines} == {
        *("capture.patterns", "capture.seed", "capture.colour", "calibrate.accuracy", "reconstruct.0.method"),
        *("export.0.format", "export.0.output"),
    }


SCENE = '[scene]\nscene = "photograph"\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[captur]\n", "captur: got {}, no such field; did you mean capture?"),
        ('[capture]\npatern = "dots:4"\n', "capture.patern: got 'dots:4', no such field; did you mean patterns?"),
        (SCENE + "[capture]\nseed = 1.5\n", "session.toml: capture.seed: 1.5: give a whole number"),
        ("[capture]\n", "capture: is of a scene, and there is none; add a table [scene]"),
        (SCENE, "has no step; add a table, such as [capture]"),
        (SCENE + "[reconstruct]\n", "reconstruct.0.run: is missing, and there is no [capture]"),
        (SCENE + "[transport]\n[capture]\naccuracy = 0.1\n", "capture.accuracy: is the transport's; give it in [tr"),
        (SCENE + '[transport]\n[capture]\ncolour = "lines"\n', "capture.colour: cannot go with [transport]"),
        (SCENE + '[capture]\n[calibrate]\noutput = "run"\n', "calibrate.output: 'run' is another step's too"),
        (SCENE + "[calibrate]\nrecipe = {exposure_fracton = 0.5}\n", "exposure_fracton: got 0.5, no such field"),
        (SCENE + "sheet_z = [1]\n[capture]\n", "scene.sheet_z: [1]: give a number"),
        (f'[scene]\nscene = "{"n" * 300}"\n[capture]\n', "scene.scene: 'nnn"),
        (SCENE + f'[calibrate]\nrecipe = "{"n" * 300}"\n', "calibrate.recipe: 'nnn"),
        (SCENE + '[capture]\n[calibrate]\ncolour = "lines"\n', "calibrate.colour: lines, but the capture's is no"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(write: Callable[[str], Path], text: str, words: str) -> None:
    with pytest.raises(ms.MitsimError) as refused:
        read_session(write(text))
    assert words in str(refused.value)


def test_changes_take_the_place_of_fields(write: Callable[[str], Path]) -> None:
    """Of several tables the one that is counted. (Planted: a change that is passed over.)"""
    path = write(WHOLE)
    found = read_session(path,
                         {"capture.patterns": "dots:2", "reconstruct.0.method": "markov"})  # fmt: skip
    assert found.step("capture").values["patterns"] == "dots:2"  # type: ignore[union-attr]
    assert found.steps[2].values == {"method": "markov"}
    for name, words in (
        ("reconstruct.method", "has several [[reconstruct]]; say which, as reconstruct.0.method"),
        ("reconstruct.7.method", "has no 7 there"),
        ("captur.patterns", "did you mean capture? give TABLE.FIELD=VALUE"),
        ("capture", "give TABLE.FIELD=VALUE"),
    ):
        with pytest.raises(ms.MitsimError) as refused:
            read_session(path, {name: "x"})
        assert words in str(refused.value)
    assert [value_of(text) for text in ("3", "0.5", "dots:4", "true", '"3"', "[1, 2]", "")] == [
        *(3, 0.5, "dots:4", True, "3", [1, 2], "")
    ]


def test_nothing_is_written_where_a_step_would_be_refused(write: Callable[[str], Path], tmp_path: Path) -> None:
    """The last step too, whatever comes before it. (Planted: steps that are checked as they come;
    only the first missing file named.)"""
    for text, words in (
        ("[capture]\n[study]\nname = 'wether'\n", "there is no such study"),
        ("[capture]\n[reconstruct]\ncalibration = 'none'\n", "no such folder"),
        ("[capture]\n[calibrate]\nrecipe = 'none.toml'\n[reconstruct]\ncalibration = './no'\n", "has 2 mistakes"),
        ("[capture]\n[calibrate]\n[reconstruct]\nchart = 'nosuch'\n", "the frames are not coloured"),
        ("[capture]\npatterns = 'dots:200'\n", "dots:200"),
        ("[design]\nscene = 'photograph'\nexposure_total_s = 1.0\npatterns = ['dots:500']\n", "K is 500"),
        ("[capture]\ncolour = 'mosaic'\n", "has no mosaic of colour filters"),
    ):
        with pytest.raises(ms.MitsimError) as refused:
            ms.run(write(SCENE + text), tmp_path / "out")
        assert words in str(refused.value) and not (tmp_path / "out").exists()


def test_shipped_sessions_are_read() -> None:
    """All that come with mitsim, by their names."""
    names = [path.stem for path in shipped_path("sessions").glob("*.toml")]
    assert "demo" in names
    for name in names:
        assert read_session(name).steps

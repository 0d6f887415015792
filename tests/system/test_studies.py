"""Studies of many points on the command line: keys that other programs read, parts that merge, refusals in one line."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.system.refusals import Call

TOY = "tests.unit.studies.toy_study"
ROOT = Path(__file__).parents[2]


@pytest.fixture
def study(call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """``mitsim study`` of the toy study, or of another name."""
    monkeypatch.setenv("TOY_FOLDER", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]))
    monkeypatch.syspath_prepend(str(ROOT))
    return lambda *options, name=TOY: call("study", name, *options, "--quiet")


def test_keys_of_a_study(study: Call, tmp_path: Path) -> None:
    found = study("-o", tmp_path / "out", "--quick", "--json")
    assert found.code == 0, found.err
    payload = found.payload
    keys = {"headline", "study", "points", "missing", "seconds", "rows", "claims", "warnings", "figures", "output"}
    assert keys == payload.keys()
    assert payload["points"] == len(payload["rows"]) == 8 and payload["missing"] == 0
    for claim in payload["claims"]:
        assert {"claim", "paper", "idealised", "rendered", "verdict"} == claim.keys()
    for name in payload["figures"]:
        assert (tmp_path / "out" / name).is_file()


def test_parts_merge_on_the_command_line(study: Call, tmp_path: Path) -> None:
    for number in (1, 2):
        part = study("-o", tmp_path / f"p{number}", "--quick", "--shard", f"{number}/2", "--jobs", 1)
        assert part.code == 0 and "Measured 4 points" in part.out and "4 points of other parts are missing" in part.out
    parts = tmp_path / "p1", tmp_path / "p2"
    refused = study(*parts, "-o", tmp_path / "whole", name="merge")
    assert refused.code == 2 and "--experiment MODULE" in refused.err and not (tmp_path / "whole").exists()
    joined = study(*parts, "-o", tmp_path / "whole", "--experiment", TOY, name="merge")
    assert joined.code == 0 and "confirmed: Two squared is four" in joined.out, joined.err


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("weather", (), "there is no such study; use patterns, distance"),
        ("models", (), "use `mitsim calibrate SCENE --model wave`"),
        ("diffraction", (), "use `mitsim study calibration SCENE`"),
        ("regularisation", (), "use `mitsim study sweep SCENE --over method=tikhonov,tv`"),
        ("sweep", ("--over", "method=mcmc"), "--over method=mcmc: use tikhonov"),
        ("no_such.module", (), "cannot be used"),
        ("patterns", ("--shard", "3/2"), "--shard '3/2': give I/N"),
        ("patterns", ("--jobs", 0), "--jobs 0: give 1 or more"),
        ("patterns", ("--over", "z=1:2:3"), "measures its own points"),
        ("distance", ("--patterns", "dots:3"), "measures its own points"),
        ("sweep", (), "nothing is varied; give --over"),
        pytest.param("sweep", ("--over", "z=1:2", "--jobs", 1), "has no <default name='z'>", marks=pytest.mark.slow),
        ("depth", ("cards", "--jobs", 1), "has no <default name='sheet_z'>"),
        ("sweep", ("--over", "z=a:b:c"), "is not FIRST:LAST:COUNT"),
        ("sweep", ("--over", "exposure=long"), "use equal peak, equal frame, equal total"),
        ("sweep", ("--over", "seed=x"), "give whole numbers"),
        ("sweep", ("--over", "albedo=1:2:3", "--measure", "speed"), "--measure 'speed': use psnr"),
        ("patterns", ("a.xml", "b.xml"), "give one scene"),
        pytest.param("patterns", ("no_such_scene", "--jobs", 1), "no_such_scene", marks=pytest.mark.slow),
        ("merge", (), "give the folders of the parts"),
    ],
)
def test_refusals(study: Call, tmp_path: Path, name: str, options: tuple[Any, ...], words: str) -> None:
    """Exit 2, one line, nothing left behind."""
    found = study(*options, "-o", tmp_path / "out", name=name)
    assert found.code == 2 and words in found.err, found.err
    assert len(found.err.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()

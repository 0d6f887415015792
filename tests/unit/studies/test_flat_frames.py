"""Frames of a camera that mitsim is told nothing of: the camera comes out, or a line that says why not."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.fft import dctn, idctn

from mitsim.core.errors import MitsimError
from mitsim.devices.flatlist import load_flats
from mitsim.devices.sensor import load_sensor
from mitsim.studies.characterise import CAMERA_FILE, characterise_frames
from mitsim.studies.emva_results import FIELDS, Characterisation, _set_field
from tests.real_flats import CAMERAS, camera, write_flats

QUICK = ("plain", "high read noise, cut darks", "nonuniform", "defects")
"""Cameras of the quick tests: one of each kind of fault."""


def off_by(done: Characterisation, name: str) -> dict[str, float]:
    """By how many standard errors each field of the camera found is off that of the camera of this ``name``."""
    model = camera(name)
    bends = [*model.linearity, 0.0, 0.0]
    given = {row.name: _set_field(model, row.name) if row.name in FIELDS else bends[int(row.name[-1])]
             for row in done.fields}  # fmt: skip
    return {
        row.name: (row.found - value) / row.standard_error
        for row in done.fields
        if (value := given[row.name]) is not None and row.standard_error
    }


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow) for name in CAMERAS]
)
def test_frames_of_a_camera_characterise_to_that_camera(name: str, tmp_path: Path) -> None:
    """Every field within five standard errors, of some fifteen a camera; and its file is a camera's."""
    done = characterise_frames(load_flats(write_flats(tmp_path / "frames", camera(name), stack=8)), tmp_path / "out")
    off = off_by(done, name)
    assert len(off) >= 14 and all(abs(value) < 5 for value in off.values()), off
    assert all(abs(row.deviations) < 5 for row in done.rows), done.warnings
    found = load_sensor(tmp_path / "out" / CAMERA_FILE)
    assert found == done.found.sensor
    assert bool(found.row_noise_e) == bool(camera(name).row_noise_e) and bool(found.linearity) == (name == "bent")


def test_cut_dark_readings_and_few_codes_move_the_standard_s_gain_and_not_the_camera_s(tmp_path: Path) -> None:
    """A fifth of the dark readings is 0: the standard's gain is 0.7 % too high; six bits and next to no noise: 50 %."""
    for name, least in (("high read noise, cut darks", 1.003), ("six bits, next to no noise", 1.3)):
        model = camera(name)
        done = characterise_frames(load_flats(write_flats(tmp_path / name, model, side=192)))
        standard = next(row for row in done.rows if row.name == "system_gain")
        assert standard.found > least * model.gain_dn_per_e
        assert abs(off_by(done, name)["gain_dn_per_e"]) < 4


def compressed(frame: np.ndarray) -> np.ndarray:
    """A frame as a JPEG of 8 bits makes it: blocks of 8 x 8 without their finer waves, after a gamma curve."""
    grey = 255 * (frame / 4095) ** (1 / 2.2)
    rows, columns = (side // 8 for side in frame.shape)
    blocks = grey.reshape(rows, 8, columns, 8).transpose(0, 2, 1, 3)
    waves = np.round(dctn(blocks, axes=(2, 3), norm="ortho"))
    waves[..., np.add.outer(np.arange(8), np.arange(8)) > 5] = 0
    smooth = idctn(waves, axes=(2, 3), norm="ortho")
    return np.clip(np.rint(smooth.transpose(0, 2, 1, 3).reshape(frame.shape)), 0, 255)


def shaded(photons: float, number: int, frame: int) -> np.ndarray:
    return photons * (1 + 0.1 * np.linspace(-1, 1, 96) + np.zeros((96, 1)))


AMISS: dict[str, tuple[dict[str, Any], str]] = {
    "an uneven lamp": ({"light": shaded}, "light differs by 20 % over the frame"),
    "a drifting lamp": ({"light": lambda photons, number, frame: photons * (1 - 0.2 * number / 16), "side": 192},
                        "so the lamp drifts"),
    "a scattering lamp": ({"light": lambda photons, number, frame: photons * (1 + 0.03 * np.sin(5.0 * number))},
                          "light scatters by"),
    "8 bits as of a JPEG": ({"read": compressed, "bits": 8}, "noise of neighbouring pixels is correlated by"),
    "a gamma curve": ({"read": lambda frame: np.rint(4095 * (frame / 4095) ** (1 / 2.2)), "photons_per_s": None},
                      "variances do not rise with means"),
}  # fmt: skip


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if "JPEG" in name else []) for name in AMISS]
)
def test_what_is_amiss_with_frames_is_said_once(name: str, tmp_path: Path) -> None:
    changes, words = AMISS[name]
    done = characterise_frames(load_flats(write_flats(tmp_path / "frames", camera("plain"), **changes)))
    assert any(words in line for line in done.about), done.about
    if "lamp" in name:
        off = off_by(done, "plain")
        assert all(abs(off[field]) < 5 for field in ("gain_dn_per_e", "read_noise_e", "black_level_dn")), off
        assert not done.found.sensor.linearity


def alone(listed: dict[str, Any]) -> None:
    listed["lit"][3]["files"] = listed["lit"][3]["files"][:1]


def without_dark(listed: dict[str, Any]) -> None:
    del listed["dark"][2]


def unequal(listed: dict[str, Any]) -> None:
    first, second = listed["lit"][3]["files"], listed["lit"][9]["files"]
    first[1], second[1] = second[1], first[1]


def only_saturated(listed: dict[str, Any]) -> None:
    listed["lit"] = listed["lit"][-2:]


def twice(listed: dict[str, Any]) -> None:
    listed["lit"][3]["files"] = listed["lit"][2]["files"]


def dark_is_lit(listed: dict[str, Any]) -> None:
    listed["lit"][5]["files"] = listed["dark"][5]["files"]
    listed["dark"][5]["files"] = ["lit_05_00.npy", "lit_05_01.npy"]


def too_few_bits(listed: dict[str, Any]) -> None:
    listed["bits"] = 10


def photons_of_another_lamp(listed: dict[str, Any]) -> None:
    listed["photons_per_s"] /= 4


WRONG: dict[Callable[[dict[str, Any]], None], str] = {
    alone: "lit.3 holds lit_03_00.npy alone",
    without_dark: "is exposed for 0.0075 s, and no dark set is",
    unequal: "of their light; take the frames of a set with one exposure",
    only_saturated: "all sets under light hold saturated numbers",
    twice: "is listed twice",
    dark_is_lit: "is no brighter than the dark frames",
    too_few_bits: "numbers of 10 bits are 0 to 1023",
    photons_of_another_lamp: "electrons a photon; at most 1 is possible",
}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_flats(tmp_path_factory.mktemp("flats") / "frames", camera("saturating ADC"), side=48)


@pytest.mark.parametrize("mistake", WRONG, ids=lambda mistake: mistake.__name__)
def test_a_list_s_mistakes_are_refused_in_one_line(
    bench: Path, mistake: Callable[[dict[str, Any]], None], tmp_path: Path
) -> None:
    listed = json.loads((bench / "session.json").read_text())
    mistake(listed)
    for frame in bench.glob("*.npy"):
        (tmp_path / frame.name).symlink_to(frame)
    (tmp_path / "session.json").write_text(json.dumps(listed))
    with pytest.raises(MitsimError) as caught:
        characterise_frames(load_flats(tmp_path), tmp_path / "out")
    assert WRONG[mistake] in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_numbers_that_were_shifted_are_named_with_their_factor(tmp_path: Path) -> None:
    folder = write_flats(tmp_path / "f", camera("plain"), side=32, steps=4, read=lambda frame: 16 * frame, bits=16)
    with pytest.raises(MitsimError, match="multiples of 16"):
        characterise_frames(load_flats(folder))


def test_one_exposure_tells_gain_and_noise_and_says_what_it_does_not(tmp_path: Path) -> None:
    listed = write_flats(tmp_path / "frames", camera("plain"))
    facts = json.loads((listed / "session.json").read_text())
    facts |= {"lit": facts["lit"][6:7], "dark": facts["dark"][6:7]}
    (listed / "session.json").write_text(json.dumps(facts))
    done = characterise_frames(load_flats(listed), tmp_path / "out")
    off = off_by(done, "plain")
    assert all(abs(off[field]) < 5 for field in ("gain_dn_per_e", "read_noise_e", "quantum_efficiency")), off
    said = " ".join(done.found.notes)
    assert "dark current is not told" in said and "full well" in said
    names = {row.name for row in done.rows}
    assert "system_gain" in names and not names & {"linearity_min", "dark_current", "full_well", "saturation_capacity"}

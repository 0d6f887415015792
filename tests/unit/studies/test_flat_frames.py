"""Frames of a camera that mitsim is told nothing of: the camera comes out, or a line that says why not."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.fft import dctn, idctn

from mitsim.core.errors import MitsimError
from mitsim.devices.framelist import load_flats
from mitsim.devices.sensor import load_sensor
from mitsim.studies.characterise import CAMERA_FILE, Characterisation, characterise_frames, fields_set
from tests.real_flats import CAMERAS, Light, camera, write_flats

pytestmark = pytest.mark.usefixtures("draft_figures")
QUICK = "nonuniform", "defects", "bent"
"""Cameras of the quick tests, one of each kind of fault; the fits of few codes take up to a minute."""
QUICK_LAMPS = "scattering", "weakly linear"
"""Light that scatters, and light that drifts."""


def exchange(one: dict[str, Any], other: dict[str, Any]) -> None:
    one["files"], other["files"] = other["files"], one["files"]


def relisted(folder: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Write the list of a ``folder`` anew, with a ``change``."""
    listed = json.loads((folder / "session.json").read_text())
    change(listed)
    (folder / "session.json").write_text(json.dumps(listed))
    return folder


def off_by(done: Characterisation, name: str) -> dict[str, float]:
    """By how many standard errors each field of the camera found is off that of the camera of this ``name``."""
    given = fields_set(camera(name))
    return {
        row.name: (row.found - value) / row.standard_error
        for row in done.fields
        if (value := given[row.name]) is not None and row.standard_error
    }


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else [pytest.mark.slow]) for name in CAMERAS]
)
def test_frames_of_a_camera_characterise_to_that_camera(name: str, tmp_path: Path) -> None:
    """Every field within five standard errors, of some fifteen a camera; and its file is a camera's.

    (Planted, each seen by the camera that it is of: row noise not less by a row of m; hot pixels told by noise that
    rounding hides; a spread of offsets that is chance; saturation by variance alone; dark current fitted to one code.)
    """
    done = characterise_frames(load_flats(write_flats(tmp_path / "frames", camera(name), stack=8)), tmp_path / "out")
    off = off_by(done, name)
    assert len(off) >= 12 and all(abs(value) < 5 for value in off.values()), off
    found = load_sensor(tmp_path / "out" / CAMERA_FILE)
    assert found == done.found.sensor
    assert bool(found.row_noise_e) == bool(camera(name).row_noise_e) and bool(found.linearity) == (name == "bent")


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


def gamma(frame: np.ndarray) -> np.ndarray:
    return np.rint(4095 * (frame / 4095) ** (1 / 2.2))


WALK = np.cumsum(np.random.default_rng(0).normal(0, 0.02, 16))
LAMPS: dict[str, tuple[Light, int, str]] = {
    "linear": (lambda photons, number, frame: photons * (1 - 0.2 * number / 16), 96, "so the lamp drifts"),
    "warming up": (lambda photons, number, frame: photons * (1 + 0.1 * np.exp(-number / 4)), 96, "so the lamp drifts"),
    "random walk": (lambda photons, number, frame: photons * (1 + WALK[number]), 96, "under a steady lamp"),
    "step": (lambda photons, number, frame: photons * (1.05 if number >= 8 else 1.0), 96, "light scatters by"),
    "scattering": (lambda photons, number, frame: photons * (1 + 0.03 * np.sin(5.0 * number)), 96, "light scatters by"),
    "weakly linear": (lambda photons, number, frame: photons * (1 + 0.02 * number / 16), 96,
                      "variances do not show whether by the camera or by the lamp"),
    "weakly linear, more pixels": (lambda photons, number, frame: photons * (1 + 0.02 * number / 16), 192,
                                   "so the lamp drifts"),
}  # fmt: skip


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK_LAMPS else [pytest.mark.slow]) for name in LAMPS]
)
def test_a_lamp_that_drifts_is_said_and_in_the_errors_of_what_depends_on_it(name: str, tmp_path: Path) -> None:
    """All fields and figures within five standard errors, and a line that names those which are known the less.

    (Planted: the lamp's part left out of the error of the response, of the drawn sessions; the difference between bent
    camera and drifting lamp left out of the covariance; an error for a full well that no frame reaches.)
    """
    light, side, words = LAMPS[name]
    done = characterise_frames(load_flats(write_flats(tmp_path / "frames", camera("plain"), light=light, side=side)))
    line = next(line for line in done.warnings if words in line)
    assert "quantum_efficiency" in line and "linearity" in line
    assert bool(done.found.sensor.linearity) == (done.found.transfer.light == "undecided")
    off = off_by(done, "plain")
    assert all(abs(value) < 5 for value in off.values()), off
    assert ("full_well_e" in off) == (name != "linear")  # its brightest frames are below saturation


def test_light_that_is_uneven_or_smoothed_somewhat_is_said(tmp_path: Path) -> None:
    """A fifth over the frame; and 6 % of the neighbour in a row."""
    done = characterise_frames(load_flats(write_flats(tmp_path / "a", camera("plain"), light=shaded)))
    assert any("light differs by 20 % over the frame" in line for line in done.about)
    off = off_by(done, "plain")
    assert all(abs(off[name]) < 5 for name in ("gain_dn_per_e", "read_noise_e", "quantum_efficiency")), off

    def smoothed(frame: np.ndarray) -> np.ndarray:
        return np.rint(0.94 * frame + 0.06 * np.roll(frame, 1, axis=1))

    flats = load_flats(write_flats(tmp_path / "b", camera("saturating ADC"), side=192, read=smoothed))
    done = characterise_frames(flats)
    assert any("noise of neighbouring pixels is correlated by" in line for line in done.about), done.about


def vignetted(photons: float, number: int, frame: int) -> np.ndarray:
    y, x = np.mgrid[-1:1:96j, -1:1:96j]
    return photons * (1 - 0.15 * (x**2 + y**2))


def behind_filters(photons: float, number: int, frame: int) -> np.ndarray:
    light = np.full((96, 96), photons)
    light[::2, ::2] *= 0.6
    light[1::2, 1::2] *= 0.4
    return light


NO_CAMERA: dict[str, tuple[dict[str, Any], str]] = {
    "8 bits as of a JPEG": ({"read": compressed, "bits": 8}, "so frames were compressed"),
    "a gamma curve": ({"read": gamma}, "a gamma curve, compression"),
    "a vignetted lamp": ({"light": vignetted}, "light differs by 33 % over the frame"),
    "colour filters": ({"light": behind_filters}, "give the frames of one colour behind filters"),
    "shifted numbers": ({"read": lambda frame: 16 * frame, "bits": 16}, "with a period of 16 DN"),
}  # fmt: skip


@pytest.mark.parametrize("name", NO_CAMERA)
def test_frames_that_tell_nothing_of_a_camera_are_refused(name: str, tmp_path: Path) -> None:
    """(Planted: each limit of a refusal at 1.)"""
    changes, words = NO_CAMERA[name]
    flats = load_flats(write_flats(tmp_path / "frames", camera("plain"), **changes))
    with pytest.raises(MitsimError, match=re.escape(words)):
        characterise_frames(flats)


def stuck(frame: np.ndarray) -> np.ndarray:
    return (frame.astype(int) & ~4).astype(float)


def partly_below(frame: np.ndarray) -> np.ndarray:
    return np.where(np.arange(frame.shape[1]) % 4 == 0, np.maximum(frame - 70, 0), frame)


def without_columns(frame: np.ndarray) -> np.ndarray:
    return np.where(np.isin(np.arange(frame.shape[1]), (5, 30)), 60, frame)


ALTERED: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "every third code is missing": (lambda frame: np.floor(1.5 * frame), "with a period of 3 DN"),
    "bit 2 is stuck": (stuck, "with a period of 8 DN"),
    "a quarter of the pixels is black below 0": (partly_below, "25 % of dark readings are 0 DN"),
    "two columns are dead": (without_columns, "of the pixels show less than half of the light"),
}


@pytest.mark.parametrize("name", ALTERED)
def test_numbers_that_no_camera_reads_are_flagged_with_what_is_wrong(name: str, tmp_path: Path) -> None:
    """Frames of a camera of 14 bits, altered after the ADC; as they are, nothing is flagged.

    (Planted: the threshold of patterns in the codes, of dark readings and of dead pixels, at 1 each.)
    """
    read, words = ALTERED[name]
    model = camera("plain").model_copy(update={"bits": 14})
    done = characterise_frames(load_flats(write_flats(tmp_path / "f", model, side=64, steps=8, stack=4, read=read)))
    assert any(words in line for line in done.about), done.about


def test_sets_and_hot_pixels_are_named_and_good_frames_are_not(tmp_path: Path) -> None:
    """Neighbouring sets exchanged, both named; hot pixels that are full in the dark.

    (Planted: hot pixels left in the statistics.)
    """
    folder = write_flats(tmp_path / "a", camera("saturating ADC"), side=64, steps=10, stack=4)
    assert not characterise_frames(load_flats(folder)).about
    relisted(folder, lambda each: exchange(each["lit"][5], each["lit"][6]))
    lines = characterise_frames(load_flats(folder)).about
    assert "lit_06_00.npy to lit_06_01.npy are 1.17 times as bright" in lines[0]
    assert "0.857 times" in lines[1]

    def hot(frame: np.ndarray) -> np.ndarray:
        return np.where(np.arange(frame.size).reshape(frame.shape) % 500 == 7, 3860, frame)

    done = characterise_frames(load_flats(write_flats(tmp_path / "b", camera("plain"), side=64, stack=4, read=hot)))
    assert "9 hot pixels (0.22 %) are full in the longest dark frames" in done.about[0]
    off = off_by(done, "plain")
    names = "gain_dn_per_e", "read_noise_e", "black_level_dn", "dark_current_e_per_s", "dsnu_pixel_e", "full_well_e"
    assert all(abs(off[name]) < 5 for name in names), off


@pytest.mark.slow
def test_a_black_level_below_zero_is_refused_with_its_size(tmp_path: Path) -> None:
    """Firmware takes 80 off a black level of 60. (Planted: the black level cut at 0, as a camera file has it.)"""
    flats = write_flats(tmp_path / "f", camera("plain"), side=64, steps=8, read=lambda frame: np.maximum(frame - 80, 0))
    with pytest.raises(MitsimError, match=r"the black level is -(20|19\.9|20\.1) \+- 0\.\d+ DN"):
        characterise_frames(load_flats(flats))


@pytest.mark.parametrize(
    ("read_noise_e", "black_level_dn"),
    [(12.0, 5.0), *(pytest.param(*each, marks=pytest.mark.slow) for each in ((8.0, 5.4), (25.0, 0.5)))],
)
def test_offsets_that_rounding_hides_are_found_or_said_to_be_hidden(
    read_noise_e: float, black_level_dn: float, tmp_path: Path
) -> None:
    """Of 8 bits, offsets of 4 e- are 0.08 DN: mean readings show a third to twice of them, or half where cut at 0.

    (Planted: the fit's variance of offsets replaced by that of mean readings.)
    """
    few = {"bits": 8, "full_well_e": 11_000.0, "gain_dn_per_e": 0.02, "dsnu_pixel_e": 4.0}
    few |= {"read_noise_e": read_noise_e, "black_level_dn": black_level_dn, "dark_current_e_per_s": 0.0}
    model = camera("plain").model_copy(update=few)
    done = characterise_frames(load_flats(write_flats(tmp_path / "f", model, side=96, steps=10, stack=16)))
    row = next(row for row in done.fields if row.name == "dsnu_pixel_e")
    assert abs(row.found - 4.0) < 5 * row.standard_error and row.standard_error < 0.5, row


Mistake = Callable[[dict[str, Any]], object]
WRONG: dict[str, tuple[Mistake, str]] = {
    "alone": (lambda each: each["lit"][3]["files"].pop(), "lit.3 holds lit_03_00.npy alone"),
    "without dark": (lambda each: each["dark"].pop(2), "is exposed for 0.0075 s, and no dark set is"),
    "unequal": (lambda each: (each["lit"][3].update(files=["lit_03_00.npy", "lit_09_01.npy"]),
                              each["lit"][9].update(files=["lit_09_00.npy", "lit_03_01.npy"])),
                "of their light; take the frames of a set with one exposure"),
    "only saturated": (lambda each: each.update(lit=each["lit"][-2:]), "all sets under light hold saturated numbers"),
    "twice": (lambda each: each["lit"][3].update(files=each["lit"][2]["files"]), "is listed twice"),
    "copied": (lambda each: each["lit"][3].update(files=["lit_03_00.npy", "copy.npy"]),
               "lit_03_00.npy and copy.npy are equal in every number"),
    "swapped": (lambda each: exchange(each["lit"][4], each["lit"][8]),
                "lit_08_00.npy to lit_08_01.npy are 1.8 times as bright as the other sets"),
    "dark is lit": (lambda each: exchange(each["lit"][5], each["dark"][5]), "is no brighter than the dark frames"),
    "too few bits": (lambda each: each.update(bits=10), "numbers of 10 bits are 0 to 1023"),
    "photons of another lamp": (lambda each: each.update(photons_per_s=each["photons_per_s"] / 4),
                                "electrons a photon; at most 1 is possible"),
}  # fmt: skip


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_flats(tmp_path_factory.mktemp("flats") / "frames", camera("saturating ADC"), side=48)


@pytest.mark.parametrize(("mistake", "words"), WRONG.values(), ids=WRONG)
def test_a_list_s_mistakes_are_refused_in_one_line(bench: Path, mistake: Mistake, words: str, tmp_path: Path) -> None:
    for frame in bench.glob("*.npy"):
        (tmp_path / frame.name).symlink_to(frame)
    (tmp_path / "copy.npy").symlink_to(bench / "lit_03_00.npy")
    shutil.copyfile(bench / "session.json", tmp_path / "session.json")
    relisted(tmp_path, mistake)
    with pytest.raises(MitsimError) as caught:
        characterise_frames(load_flats(tmp_path), tmp_path / "out")
    assert words in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_darks_of_another_exposure_are_named(tmp_path: Path) -> None:
    """The shortest and the longest dark pair are listed for each other; one saturated set is enough for a full well."""
    folder = write_flats(tmp_path / "frames", camera("plain"))
    relisted(folder, lambda each: each.update(lit=each["lit"][:10] + each["lit"][-1:]))
    done = characterise_frames(load_flats(folder))
    off = off_by(done, "plain")
    assert not done.about and "full_well_e" in off and all(abs(value) < 5 for value in off.values()), off
    relisted(folder, lambda each: exchange(each["dark"][0], each["dark"][-1]))
    (line,) = characterise_frames(load_flats(folder)).about
    assert "dark means do not rise with exposure: dark_15" in line and "dark_current_e_per_s" in line


def test_one_exposure_tells_gain_and_noise_and_says_what_it_does_not(tmp_path: Path) -> None:
    listed = write_flats(tmp_path / "frames", camera("plain"))
    relisted(listed, lambda each: each.update(lit=each["lit"][6:7], dark=each["dark"][6:7]))
    done = characterise_frames(load_flats(listed), tmp_path / "out")
    off = off_by(done, "plain")
    assert all(abs(off[field]) < 5 for field in ("gain_dn_per_e", "read_noise_e", "quantum_efficiency")), off
    said = " ".join(done.found.notes)
    assert "dark current needs dark frames of two exposures" in said and "full well" in said
    names = {row.name for row in done.rows}
    assert "system_gain" in names and not names & {"linearity_min", "dark_current", "full_well", "saturation_capacity"}

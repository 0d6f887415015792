"""Frames of a real session: a camera that is numpy alone, its factors found again from files in any format.

Several exposures of one frame: which of them a pixel is read at, and with what weight.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mitsim.core.errors import MitsimError
from mitsim.core.manifests import Digital
from mitsim.devices.framelist import load_frames
from mitsim.reconstruct.captured_session import Ladder, calibrate_frames
from mitsim.reconstruct.factors import Factors, load_calibration
from tests.real_session import COLUMNS, DIGITAL, ROWS, RealSession, write_image, write_list


def error(factors: Factors, session: RealSession) -> tuple[float, float]:
    """Relative errors of both factors; their common scale is c and 1/c."""
    errors = []
    for found, exact in ((factors.left, session.left), (factors.right, session.right)):
        scaled = found * np.vdot(found, exact) / np.vdot(found, found)
        errors.append(float(np.linalg.norm(scaled - exact) / np.linalg.norm(exact)))
    return errors[0], errors[1]


@pytest.mark.parametrize("ending", ["png", "exr", "raw", "bin"])
def test_the_factors_of_pairs_are_the_cameras_within_their_stated_noise(tmp_path: Path, ending: str) -> None:
    """(Planted: halves in the other order, the transposed side, a black level left in.) 96 numbers of a factor tell a
    noise to 7 %; the product of both is in electrons a second."""
    session = RealSession()
    folder = session.write(tmp_path / "frames", name=("f_{}." + ending).format)
    layout = {"raw": {"bits": 12, "byte_order": "big"}, "bin": {"pixel_format": "Mono12p"}}.get(ending)
    if layout is not None:
        write_list(folder, raw={"shape": [ROWS, COLUMNS], **layout})
    factors = calibrate_frames(folder)
    assert factors.ok, factors.warnings
    for own, stated in zip(error(factors, session), factors.estimate.predicted_error, strict=True):
        assert own == pytest.approx(stated, rel=0.25)
    assert factors.manifest.result["response_noise"] == pytest.approx(factors.estimate.noise, rel=0.05)
    light = factors.left.sum(axis=1) @ np.ones(ROWS), session.left.sum(axis=1) @ np.ones(ROWS)
    other = factors.right.sum(axis=1) @ np.ones(COLUMNS), session.right.sum(axis=1) @ np.ones(COLUMNS)
    assert light[0] * other[0] == pytest.approx(light[1] * other[1], rel=2e-3)


def test_frames_against_a_uniform_one_lose_what_dark_frames_show(tmp_path: Path) -> None:
    """40 DN that the list's black level does not know of: without dark frames they count as ambient light, which is
    measured across the common vector, subtracted and flagged. (Planted: dark frames taken off twice.)"""
    session = RealSession()
    folder = session.write(tmp_path / "frames", "uniform", offset=40.0)
    bad = calibrate_frames(folder)
    for number in range(4):
        write_image(folder / f"dark_{number}.png", session.frame(np.zeros((4, 4)), offset=40.0))
    good = calibrate_frames(folder)
    assert good.ok and good.manifest.result["dark_frames"] == 4, good.warnings
    assert max(error(good, session)) < 0.02 and any("even light" in words for words in bad.warnings)
    assert max(good.estimate.predicted_error) < max(error(bad, session)) < max(bad.estimate.predicted_error)
    assert good.manifest.result["response_noise"] == pytest.approx(good.estimate.noise, rel=0.1)


def test_names_count_by_their_numbers_and_a_list_by_what_it_says(tmp_path: Path) -> None:
    """f_10 follows f_9; frames in a list may be in any order and have exposures of their own."""
    session = RealSession()
    ordered = calibrate_frames(session.write(tmp_path / "frames"))
    again = tmp_path / "again"
    again.mkdir()
    entries = []
    for number, (side, index, sign, _) in enumerate(session.shown("pair")):
        (tmp_path / "frames" / f"f_{number}.png").rename(again / f"x{number}.png")
        entries.append({"file": f"x{number}.png", "side": side, "index": index, "sign": sign})
    write_list(again, frames=entries[::-1])
    listed = calibrate_frames(again)
    assert np.array_equal(listed.left, ordered.left) and np.array_equal(listed.right, ordered.right)

    longer = [{**entry, "exposure_s": 0.03} if entry["index"] % 2 else entry for entry in entries]
    for number, (_, index, _, light) in enumerate(session.shown("pair")):
        write_image(again / f"x{number}.png", session.frame(light, 0.03 if index % 2 else 0.02))
    write_list(again, frames=longer)
    mixed = calibrate_frames(again)
    assert mixed.ok and max(error(mixed, session)) < 0.02


def test_the_folder_is_one_that_reconstruct_takes(tmp_path: Path) -> None:
    frames = RealSession().write(tmp_path / "frames")
    factors = calibrate_frames(frames, tmp_path / "cal")
    kept = load_calibration(tmp_path / "cal")
    assert np.array_equal(kept.left, factors.left) and kept.status.verdict == factors.status.verdict
    assert kept.manifest.camera == {"name": "bench 3"} and kept.manifest.digital == Digital(**DIGITAL)
    assert len(kept.manifest.configuration["frames_sha256"]) == 16
    with pytest.raises(MitsimError, match="holds files already"):
        calibrate_frames(frames, tmp_path / "cal")


def test_what_is_not_known_is_left_out_and_said(tmp_path: Path) -> None:
    folder = RealSession().write(tmp_path / "frames")
    reported = calibrate_frames(folder).manifest
    assert reported.result["phi_error"] is None and reported.result["noise_free_residual"] is None
    assert reported.board_reflectance is None and reported.parallax is None
    unknown = [text.split(":")[0] for text in reported.result["not_known"]]
    assert unknown == ["phi_error, noise_free_residual", "board_reflectance", "parallax"]
    bare = {name: value for name, value in DIGITAL.items() if name not in ("read_noise_e", "saturation_dn")}
    write_list(folder, digital=bare)
    reported = calibrate_frames(folder).manifest
    assert reported.result["response_noise"] is None
    unknown = {text.split(":")[0] for text in reported.result["not_known"]}
    assert {"digital.read_noise_e", "digital.saturation_dn"} <= unknown


def test_saturated_frames_flag_the_result(tmp_path: Path) -> None:
    """Where the list does not state the end, that of the file counts. (Planted: `>`.)"""
    session = RealSession()
    folder = session.write(tmp_path / "frames")
    full = session.frame(np.ones((4, 4)))
    full[3, 5] = 4095
    write_image(folder / "f_0.png", full)
    factors = calibrate_frames(folder)
    assert not factors.ok and factors.manifest.result["saturated_frames"] == 1
    assert "saturation: 1 of 16 frames" in factors.warnings[-1] and "f_0.png" in factors.warnings[-1]
    write_list(folder, digital={**DIGITAL, "saturation_dn": None})
    with pytest.raises(
        MitsimError, match=r"f_0\.png .*f_1\.png .*: the two do not have the sum"
    ):  # no longer saturated
        calibrate_frames(folder)
    full[3, 5] = 65535
    write_image(folder / "f_0.png", full)
    assert calibrate_frames(folder).manifest.result["saturated_frames"] == 1


def entries(**changes: Any) -> list[dict[str, Any]]:
    """A list of all frames; the one named f_3.png with ``changes``."""
    shots = enumerate(RealSession().shown("pair"))
    found: list[dict[str, Any]] = [
        {"file": f"f_{number}.png", "side": side, "index": index, "sign": sign}
        for number, (side, index, sign, _) in shots
    ]
    found[3].update(changes)
    return found


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"frames": entries()[:-2]}, "2 of 16 frames are missing, as vertical stripes 3 of sign +1"),
        ({"frames": entries(index=0)}, "horizontal stripes 0 of sign -1 is there twice, f_1.png and f_3.png"),
        ({"frames": entries(file="f_2.png")}, "f_2.png is listed twice"),
        ({"frames": entries(file="g.png")}, "g.png is listed, but no file"),
        ({"frames": entries(sign=0)}, "the uniform frame of horizontal stripes, which no such session has"),
        ({"frames": entries(exposure_s=0.1)}, "halves of one pattern, exposed for 0.02 and 0.1 s"),
        ({"frames": entries(file="../f_3.png")}, "frames.3.file: got '../f_3.png'"),
        ({"repeats": 2}, "signed_capture 'pair', repeats 2 are 32"),
        ({"signed_capture": "uniform"}, "are 10, from horizontal to vertical"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_lists_with_a_mistake_are_refused(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    folder = RealSession().write(tmp_path / "frames")
    write_list(folder, **changes)
    with pytest.raises(MitsimError) as reported:
        load_frames(folder)
    assert words in str(reported.value) and str(folder) in str(reported.value)


def test_folders_with_a_mistake_are_refused(tmp_path: Path) -> None:
    """Sizes, damage and links are seen before any work."""
    folder = RealSession().write(tmp_path / "frames")

    def refusal() -> str:
        with pytest.raises(MitsimError) as reported:
            calibrate_frames(folder, tmp_path / "cal")
        assert not (tmp_path / "cal").exists()
        return str(reported.value)

    write_image(folder / "f_3.png", np.ones((20, 24)))
    assert "f_3.png is 20 x 24 pixels, but f_0.png is 24 x 20" in refusal()
    (folder / "f_3.png").write_bytes(b"no picture")
    assert "f_3.png: cannot be read" in refusal()
    (folder / "f_3.png").unlink()
    assert "holds 15 frames" in refusal()
    (tmp_path / "elsewhere.png").write_bytes((folder / "f_2.png").read_bytes())
    (folder / "f_3.png").symlink_to(tmp_path / "elsewhere.png")
    assert "leads out of its folder" in refusal()
    (folder / "session.toml").write_text("")
    assert "holds both session.toml and session.json" in refusal()
    (folder / "session.toml").unlink()
    (folder / "session.json").unlink()
    assert "holds neither session.toml nor session.json" in refusal()


@pytest.mark.parametrize("mode", ["pair", "uniform"])
def test_a_black_level_above_all_numbers_is_refused(tmp_path: Path, mode: str) -> None:
    """Frames of 8 bits, and a level of the same camera's 12 bits."""
    session = RealSession()
    folder = session.write(tmp_path / "frames", mode)
    for number, (*_, light) in enumerate(session.shown(mode)):
        Image.fromarray((session.frame(light) / 16).astype(np.uint8)).save(folder / f"f_{number}.png")
    write_list(folder, signed_capture=mode, digital={**DIGITAL, "black_level_dn": 300})
    with pytest.raises(MitsimError) as reported:
        calibrate_frames(folder, tmp_path / "cal")
    message = str(reported.value)
    assert "f_0.png" in message and "black_level_dn 300" in message and "\n" not in message
    assert not (tmp_path / "cal").exists()


def test_one_uniform_exposure_without_a_dark_frame_is_refused(tmp_path: Path) -> None:
    session = RealSession()
    folder = session.write(tmp_path / "frames", "uniform")
    write_image(folder / "dark.png", session.frame(np.zeros((4, 4))))
    data = json.loads((folder / "session.json").read_text())
    write_list(folder, **{**data, "dark": [{"file": "dark.png", "exposure_s": 0.5}]})
    with pytest.raises(MitsimError, match=r"no dark frame is exposed for 0\.02 s"):
        load_frames(folder)


@pytest.mark.parametrize(
    ("listed", "change", "words"),
    [
        ({}, {"exposure": 1}, "which no such session has"),
        ({"exposure_ladder": [1, 2]}, {"exposure_s": 0.5}, "beside exposure_ladder; give the number"),
        ({"exposure_ladder": [1, 2], "digital": {**DIGITAL, "saturation_dn": None}}, {}, "saturation_dn: is not given"),
        ({"exposure_ladder": [1, 1]}, {}, "rising numbers"),
    ],
)
def test_exposures_that_disagree(tmp_path: Path, listed: dict[str, Any], change: dict[str, Any], words: str) -> None:
    rungs = range(len(listed.get("exposure_ladder", [1])))
    entries = []
    for number, (side, index, sign, _) in enumerate(RealSession().shown("pair")):
        for rung in rungs:
            name = f"{number}_{rung}.png"
            write_image(tmp_path / name, np.zeros((2, 2)))
            entries.append({"file": name, "side": side, "index": index, "sign": sign, "exposure": rung})
    entries[0].update(change)
    write_list(tmp_path, frames=entries, **listed)
    with pytest.raises(MitsimError, match=words):
        load_frames(tmp_path)


def test_a_camera_fills_what_the_list_leaves_out_and_is_compared_with_the_rest(tmp_path: Path) -> None:
    """(Planted: what the list states overwritten, a gain that is 10 % off let pass, its part of 1 for its part.)"""
    folder, camera = RealSession().write(tmp_path / "frames"), tmp_path / "camera.toml"

    def found(gain: float = 0.125, black: float = 160.0, **digital: Any) -> Factors:
        write_list(folder, digital=digital)
        camera.write_text(
            f"name = 'bench'\npixel_pitch_um = 5.0\nfull_well_e = 30000\nread_noise_e = 9\ndark_current_e_per_s = 0\n"
            f"quantum_efficiency = 0.5\ngain_dn_per_e = {gain}\nblack_level_dn = {black}\nbits = 12\nsource = 'me'\n"
        )
        return calibrate_frames(folder, camera=camera)

    few = {name: DIGITAL[name] for name in ("exposure_s", "black_level_dn", "gain_dn_per_e", "dark_current_e_per_s")}
    filled = found(0.127, 160.5, **few)
    assert filled.ok
    assert (filled.manifest.digital.read_noise_e, filled.manifest.digital.saturation_dn) == (9, 3970)
    assert filled.manifest.digital.gain_dn_per_e == 0.125 and filled.manifest.result["response_noise"] is not None
    for wrong, words in (
        (found(0.1375, **few), "camera bench: digital.gain_dn_per_e is 0.125 in the list, and 0.1375"),
        (found(black=170.0, **few), "black_level_dn is 160 in the list, and 170"),
        (found(**{**DIGITAL, "saturation_dn": 4000}), "saturation_dn is 4000 in the list, and 3910"),
    ):
        (warning,) = wrong.warnings
        assert words in warning


def repeated(folder: Path, listed: dict[str, Any], shots: list[tuple[int, float]], wrong: tuple[int, int]) -> Factors:
    """Factors of a session of pairs that takes each half in ``shots`` (repeat or exposure, exposure over the first);
    that of half and shot ``wrong`` is half as bright."""
    session = RealSession()
    folder.mkdir()
    for number, (*_, light) in enumerate(session.shown("pair")):
        for shot, factor in shots:
            part = 0.5 if (number, shot) == wrong else 1.0
            frame = session.frame(part * light, factor * DIGITAL["exposure_s"])
            write_image(folder / f"f_{len(shots) * number + shot}.png", frame)
    write_list(folder, **listed)
    return calibrate_frames(folder)


def test_a_wrong_repeat_or_exposure_is_named(tmp_path: Path) -> None:
    """The pair's sum shows both. (Planted: exposures are compared with themselves.)"""
    for name, listed, second in (("repeat", {"repeats": 2}, 1.0), ("rung", {"exposure_ladder": [1, 2]}, 2.0)):
        shots = [(0, 1.0), (1, second)]
        good = repeated(tmp_path / f"good_{name}", listed, shots, (-1, -1))
        assert good.ok, good.warnings
        bad = tmp_path / f"bad_{name}"
        if name == "rung":
            with pytest.raises(MitsimError, match=r"f_10\.png and 1 more .* the two do not have the sum"):
                repeated(bad, listed, shots, (5, 1))
        else:
            (words,) = (found := repeated(bad, listed, shots, (5, 1))).warnings
            assert "f_10.png and 1 more" in words and "0.755 of its light" in words
            assert max(error(found, RealSession())) < 0.05


def test_a_dark_frame_with_light_is_refused(tmp_path: Path) -> None:
    session = RealSession()
    folder = session.write(tmp_path / "frames", "uniform")
    for number in range(4):
        write_image(folder / f"dark_{number}.png", session.frame(np.full((4, 4), 0.1 * (number == 2))))
    with pytest.raises(MitsimError, match=r"dark_2\.png, with the projector off, has \+10"):
        calibrate_frames(folder)


# ---- Exposures of one frame ----


_STATED = {"gain_dn_per_e": 0.5, "black_level_dn": 20, "dark_current_e_per_s": 100, "read_noise_e": 10}
FIRST = Digital(exposure_s=0.1, saturation_dn=1020, **_STATED)
DIGITALS = [FIRST.model_copy(update={"exposure_s": 0.1 * factor}) for factor in (1, 2, 8)]
LIGHT = np.array([[0.0, 1000.0, 9e3, 2e4]])
"""Electrons a second; 2000 electrons saturate."""


def test_pixels_are_read_where_a_uniform_frame_cannot_saturate_them() -> None:
    """Of 9000 electrons a second, 1820 in 0.2 s, dark ones too; five deviations of this frame, scaled from the first,
    are 400 more. (Planted: no room.)"""
    used = Ladder.of(DIGITALS, LIGHT, 1, "weighted")
    expected = [[[True] * 4], *[[[True, True, False, False]]] * 2]
    assert [used.used_pixels(number).tolist() for number in range(3)] == expected
    longest = Ladder.of(DIGITALS, LIGHT, 1, "longest")
    assert np.argmax(longest.weights, axis=0).tolist() == [[2, 2, 0, 0]]
    assert longest.weights.sum(axis=0) == pytest.approx(1)


def test_weights_are_those_of_the_least_variance() -> None:
    """Of half of the light, in whole numbers: 1/v with v = (L/2 + D)/t + read^2/t^2; any other weights leave more."""
    found = Ladder.of(DIGITALS, LIGHT, 1, "weighted")
    inverse = np.array([1 / ((500 + 100) / time + 100 / time**2) for time in (0.1, 0.2, 0.8)])
    np.testing.assert_allclose(found.weights[:, 0, 1], inverse / inverse.sum(), rtol=1e-12)
    assert found.weights[:, 0, 3].tolist() == [1, 0, 0]
    half = LIGHT[:, :2] / 2
    best = Ladder(tuple(DIGITALS), found.weights[:, :, :2]).variance(half)
    assert best == pytest.approx((1 / inverse.sum() + 1 / sum(1 / (100 / t + 100 / t**2) for t in (0.1, 0.2, 0.8))) / 2)
    for shift in (0.01, -0.01):
        other = Ladder(tuple(DIGITALS), found.weights[:, :, :2] + shift * np.array([1, -2, 1])[:, None, None])
        assert other.variance(half) > best

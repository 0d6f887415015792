"""Closing frames and orders of shots of real frames: the last file closes, and files come to the right shots."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import mitsim as ms
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import shot_orders
from mitsim.exchange.formats import export, import_frames, pattern_pictures
from tests.exchanged import DIGITAL, Made, bytes_of, made
from tests.unit.exchange.test_real import ELECTRONICS

PROJECTOR = 'name = "p"\neffective_wavelength_nm = 550.0\ncolumns = 96\nrows = 54\n'


def imported(bench: Made, frames: list[np.ndarray], patterns: str, name: str = "again", **more: object) -> ms.Capture:
    """The run that becomes of ``frames``, files of the camera of a ``bench``."""
    folder = bench.run.parent
    (folder / "camera.toml").write_text(ELECTRONICS)
    source = folder / f"{name} frames"
    source.mkdir()
    for index, frame in enumerate(frames):
        np.save(source / f"{index}.npy", frame)
    facts = {"camera": folder / "camera.toml", "exposure": DIGITAL.exposure_s, "calibration": bench.calibration}
    import_frames(source, folder / name, patterns=patterns, **facts, **more)
    return ms.load_run(folder / name)


@pytest.mark.parametrize("kind", ["first", "uniform"])
@pytest.mark.parametrize("ambient", [False, True])
def test_light_of_a_closing_frame_is_that_of_measurements(kind: str, ambient: bool, tmp_path: Path) -> None:
    """The first frame again, or the sum of all: both to their noise, of 2080 pixels to five standard deviations.

    (Planted: ambient light left in; dark current left in; the run's exposure in the place of the frame's own.)
    """
    shots = ms.load_run(made(tmp_path, ambient=ambient, closing=kind).run)
    found, measured = shots.closing, [frame for frame, _, _ in shots.measurements()]
    assert found is not None and found.kind == kind and found.saturated == 0
    summed = measured[:1] if kind == "first" else measured
    noise = sum(shots.manifest.digital.variance(frame + shots.ambient.rate if ambient else frame) for frame in summed)
    # The ambient frame is one draw, taken off the closing frame once and off the sum once a frame.
    noise = noise + found.variance + (shots.ambient.variance * (len(summed) - 1) ** 2 if ambient else 0.0)
    score = (found.light - sum(summed)) / np.sqrt(noise)
    assert abs(score.mean()) < 5 / np.sqrt(score.size)
    assert abs((score**2).mean() - 1) < 5 * np.sqrt(2 / score.size)


def test_light_of_signed_patterns_keeps_ambient_light_as_their_halves_do(tmp_path: Path) -> None:
    bench = made(tmp_path, signed=True, ambient=True, closing="first")
    shots = ms.load_run(bench.run)
    half = shots.manifest.digital.rate(shots.dn[0])
    score = (shots.closing.light - half) / np.sqrt(2 * shots.closing.variance)
    assert abs(score.mean()) < 5 / np.sqrt(score.size)


def test_the_last_file_closes_a_run_and_its_exposure_may_be_its_own(tmp_path: Path) -> None:
    """A half of the exposure, and a half of the numbers above the dark level: the same light a second.

    (Planted: the dark level of the run's exposure under even response; the closing frame read as the first file.)
    """
    bench = made(tmp_path, closing="uniform")
    shots = ms.load_run(bench.run)
    last = shots.read("closing.exr")[0]["DN"]
    again = imported(bench, [*shots.dn, last], "dots:2x3", closing_frame="uniform")
    assert np.array_equal(again.dn, shots.dn) and np.array_equal(again.closing.light, shots.closing.light)
    black, dark = DIGITAL.black_level_dn, DIGITAL.dark_current_e_per_s * DIGITAL.exposure_s * DIGITAL.gain_dn_per_e
    shorter = np.rint(black + dark / 2 + (last - black - dark) / 2).clip(0).astype(np.uint32)
    response = np.linspace(0.5, 1.5, last.size).reshape(last.shape)
    np.save(tmp_path / "flat.npy", black + dark + 5000 * response)
    for name, more in {"plain": {}, "flat": {"flat_frame": tmp_path / "flat.npy"}}.items():
        facts = {"closing_frame": "uniform", **more}
        whole = imported(bench, [*shots.dn, last], "dots:2x3", name, **facts)
        facts["closing_exposure"] = DIGITAL.exposure_s / 2
        half = imported(bench, [*shots.dn, shorter], "dots:2x3", f"{name} half", **facts)
        rounding = 0.5 / DIGITAL.gain_dn_per_e / (DIGITAL.exposure_s / 2) / (response if more else 1.0)
        assert (
            np.abs(half.closing.light - whole.closing.light) < 1.01 * rounding
        ).all()  # frames under a flat are of single precision
        assert half.manifest.closing_frame.exposure_s == DIGITAL.exposure_s / 2
    images = [ms.reconstruct(run, ms.load_calibration(bench.calibration)).image for run in (shots, again)]
    assert np.array_equal(*images), "a closing frame is no measurement"
    assert again.save(tmp_path / "saved") and bytes_of(tmp_path / "saved") == bytes_of(again.folder)
    without = ms.Capture(shots.manifest.model_copy(update={"closing_frame": None}), shots.folder)
    assert without.fingerprint != shots.fingerprint


def test_a_damaged_closing_frame_is_refused_and_one_that_clips_is_counted(tmp_path: Path) -> None:
    bench = made(tmp_path, closing="uniform")
    shots = ms.load_run(bench.run)
    last = shots.read("closing.exr")[0]["DN"].copy()
    last[3, 4:7] = 65535
    assert imported(bench, [*shots.dn, last], "dots:2x3", closing_frame="uniform").closing.saturated == 3
    (bench.run / "closing.exr").write_bytes((bench.run / "frame_00000.exr").read_bytes())
    with pytest.raises(MitsimError, match=r"closing\.exr"):
        ms.load_run(bench.run).closing  # noqa: B018


def test_what_does_not_fit_a_closing_frame_is_refused_in_a_line(tmp_path: Path) -> None:
    bench = made(tmp_path)
    frames = [*ms.load_run(bench.run).dn]
    np.save(tmp_path / "dark.npy", frames[0])
    refused = {
        "holds 6 frames, but patterns 'dots:2x3' take 6 and a closing frame": (frames, {"closing_frame": "first"}),
        r"holds 7 frames.*\(is the last a closing frame\? say so\)": ([*frames, frames[0]], {}),
        "closing_exposure_s is of a closing frame; give closing_frame too": (frames, {"closing_exposure": 0.5}),
        "beside dark frames": (frames, {"closing_frame": "first", "closing_exposure": 0.5,
                                        "dark_frame": tmp_path / "dark.npy"}),
        "closing_frame 'last': give 'first' or 'uniform'": (frames, {"closing_frame": "last"}),
        "order 'snake': give row-major, column-major, reversed": (frames, {"order": "snake"}),
    }  # fmt: skip
    for number, (words, (held, more)) in enumerate(refused.items()):
        with pytest.raises(MitsimError, match=words) as caught:
            imported(bench, held, "dots:2x3", f"refused {number}", **more)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("signed", [False, True])
def test_frames_taken_in_an_order_become_the_run_bit_for_bit(signed: bool, tmp_path: Path) -> None:
    """Factors, frames and image; a closing frame stays the last. (Planted: the inverse permutation; the closing frame
    put into the order; files permuted again at each plane.)"""
    bench = made(tmp_path, signed=signed, closing="first")
    patterns, shots = "hadamard:2" if signed else "dots:2x3", ms.load_run(bench.run)
    in_order = shots.dn.reshape(-1, 2, *shots.dn.shape[1:])[:, ::-1].reshape(shots.dn.shape) if signed else shots.dn
    last = shots.read("closing.exr")[0]["DN"]
    plain = imported(bench, [*in_order, last], patterns, closing_frame="first")
    assert plain.manifest.order is None
    orders = shot_orders(plain.manifest.patterns)
    assert len(orders) == (18 if signed else 3)
    image = ms.reconstruct(plain, ms.load_calibration(bench.calibration)).image
    for name, order in orders.items():
        taken = np.empty_like(in_order)
        taken[order] = in_order  # shot k is file order[k]
        run = imported(bench, [*taken, last], patterns, name, closing_frame="first", order=name)
        assert np.array_equal(run.dn, plain.dn) and np.array_equal(run.closing.light, plain.closing.light)
        assert run.manifest.order == name and run.manifest.configuration["order"] == name
        assert np.array_equal(ms.reconstruct(run, ms.load_calibration(bench.calibration)).image, image), name


@pytest.mark.parametrize("kind", ["first", "uniform"])
def test_pictures_end_with_the_closing_one_and_frames_are_read_again(kind: str, tmp_path: Path) -> None:
    """`patterns` and `export --format png`. (Planted: the last picture for the first; none drawn.)"""
    (tmp_path / "p.toml").write_text(PROJECTOR)
    projector, bench = str(tmp_path / "p.toml"), made(tmp_path / "bench", closing=kind)
    drawn = pattern_pictures(
        "dots:2x3", tmp_path / "drawn", projector=projector, projector_pixels=10, closing_frame=kind
    )
    export(bench.run, "png", tmp_path / "out", projector=projector)
    for folder in ("drawn", "out"):
        files = sorted((tmp_path / folder / "patterns").glob("pattern_*.png"))
        pictures = [np.asarray(Image.open(path)) for path in files]
        assert len(pictures) == drawn["pictures"] == 7
        expected = pictures[0] if kind == "first" else np.asarray(Image.open(files[0].parent / "white.png"))
        assert np.array_equal(pictures[-1], expected) and not np.array_equal(pictures[-1], pictures[-2])
        assert len(json.loads((tmp_path / folder / "patterns.json").read_text())["shots"]) == 6
    shots, frames = ms.load_run(bench.run), sorted((tmp_path / "out" / "frames").iterdir())
    again = imported(bench, [np.asarray(Image.open(path)) for path in frames], str(tmp_path / "out" / "patterns.json"),
                     closing_frame=kind)  # fmt: skip
    assert np.array_equal(again.dn, shots.dn) and np.array_equal(again.closing.light, shots.closing.light)
    with pytest.raises(MitsimError, match="closing_frame has no effect on stripes"):
        pattern_pictures("stripes", tmp_path / "s", projector=projector, projector_pixels=4, closing_frame=kind)

"""Point spread functions from frames of a point source, against the light that the frames were drawn from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.devices.camera import load_psf
from mitsim.exchange.formats import import_frames
from tests.unit.reconstruct.test_point_spread import CAMERA, called, mosaic, save

SIZE = 120, 131
ROOM = 90.0
"""Light of the room, in all frames [electrons]."""


def point_light() -> np.ndarray:
    """Light of a point off the middle, in red, green and blue [electrons]."""
    light = np.zeros((*SIZE, 3))
    light[30:71, 50:101] = np.random.default_rng(4).random((41, 51))[..., None] ** 6 * [2000.0, 4000.0, 1000.0]
    return light


def frames(folder: Path, light: np.ndarray, count: int = 6, cut: float = 65535) -> Path:
    """Frames of a ``light`` that flickers by a tenth, with the room's and noise, seed 5."""
    folder.mkdir()
    rng = np.random.default_rng(5)
    for number in range(count):
        seen = rng.poisson(light * (1 + 0.1 * (number % 2)) + ROOM) + rng.normal(10, 2, light.shape)
        np.save(folder / f"{number}.npy", np.rint(seen).clip(0, cut).astype(np.uint16))
    return folder


def stacked(folder: Path, source: Path, **more: Any) -> dict[str, Any]:
    (folder / "camera.toml").write_text(CAMERA)
    facts = {"camera": folder / "camera.toml", "exposure": 1.0, "point": True}
    return import_frames(source, folder / "psf.npy", overwrite=True, **facts, **more)


def test_the_stack_is_the_light_about_its_centre(tmp_path: Path) -> None:
    """To the noise of six frames. (Planted: dark frames not subtracted; background left in; channels exchanged; the
    middle of the frame for the light's.)"""
    light = point_light()
    source, dark = frames(tmp_path / "point", light), frames(tmp_path / "dark", 0 * light)
    found = stacked(tmp_path, source, dark_frame=dark)
    assert not found["warnings"] and found["holds"] == ["psf"] and found["planes"] == ["r", "g", "b"]
    assert np.abs(found["background"]).max() < 10, "of 90 in the room"
    psf = np.load(tmp_path / "psf.npy")
    assert list(psf.shape[:2]) == found["shape"] and psf.shape[2] == 3
    places = np.indices(psf.shape[:2])
    centre = [float(np.average(place, weights=np.maximum(psf.sum(axis=2), 0) ** 2)) for place in places]
    assert centre == pytest.approx([(side - 1) / 2 for side in psf.shape[:2]], abs=3)
    assert psf.sum(axis=(0, 1)) / psf.sum() == pytest.approx(np.array([2, 4, 1]) / 7, rel=0.01)
    assert load_psf(tmp_path / "psf.npy", 1).sum() == pytest.approx(1)
    whole = stacked(tmp_path, source, dark_frame=dark, crop=(0, 0))
    assert whole["shape"] == [*SIZE]
    left = np.load(tmp_path / "psf.npy") - 1.05 * light
    assert np.sqrt(np.square(left).mean()) < 3 * np.sqrt((2 * ROOM + light.mean()) / 6), (
        "a mean of 1.05, as it flickers"
    )
    raw = tmp_path / "raw"
    raw.mkdir()
    for file in source.iterdir():
        np.save(raw / file.name, mosaic(np.load(file)))
    planes = stacked(tmp_path, raw, channel="all", mosaic="RGGB")
    assert planes["planes"] == ["r", "gb", "gr", "b"] and planes["background"] == pytest.approx([ROOM] * 4, abs=10)
    assert np.load(tmp_path / "psf.npy").sum(axis=(0, 1)) == pytest.approx(
        1.05 * light.sum(axis=(0, 1))[[0, 1, 1, 2]], 0.1
    )


def test_frames_that_spoil_the_stack_are_flagged(tmp_path: Path) -> None:
    """(Planted: no limit of the difference; saturated readings counted in the mean alone; lit edges passed over.)"""
    light = point_light()
    moved = frames(tmp_path / "moved", light)
    np.save(moved / "3.npy", np.roll(np.load(moved / "3.npy"), 2, axis=0))
    (warning,) = stacked(tmp_path, moved)["warnings"]
    assert "1 of 6 differ" in warning and "3.npy (4)" in warning
    for number in (4, 5):
        np.save(moved / f"{number}.npy", np.roll(np.load(moved / f"{number}.npy"), 2, axis=0))
    assert "6 of 6 differ" in stacked(tmp_path, moved)["warnings"][0]
    for full, cut in ((light * 30, 65535), (light, 2000)):  # at the full well, and clipped below it
        found = stacked(tmp_path, frames(tmp_path / f"full {cut}", full, cut=cut))
        assert found["saturated"] > 0 and any("Saturated" in each for each in found["warnings"])
    dark, lit = frames(tmp_path / "dark", 0 * light), frames(tmp_path / "lit", light + 100)
    assert "Lit edges" in str(stacked(tmp_path, lit, dark_frame=dark)["warnings"])


def test_what_is_no_point_is_refused_in_a_line(tmp_path: Path) -> None:
    light = point_light()
    source = frames(tmp_path / "point", light, 1)
    (tmp_path / "camera.toml").write_text(CAMERA)
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    asked = "--point", "--camera", tmp_path / "camera.toml", "--exposure", 1
    for place, words, text in (
        (source, ("-o", tmp_path / "psf.png"), "a file that ends in .npy"),
        (source, ("-o", source / "psf.npy"), "lies among the frames"),
        (source, ("--patterns", "uniform", "-o", tmp_path / "a.npy"), "has no effect on frames of a point source"),
        (frames(tmp_path / "none", 0 * light, 1), ("-o", tmp_path / "a.npy"), "nothing is brighter"),
        (save(tmp_path / "small.npy", np.ones((20, 20))), ("-o", tmp_path / "a.npy"), "nothing is brighter"),
        (save(tmp_path / "nan.npy", np.full(SIZE, np.nan)), ("-o", tmp_path / "a.npy"), "not finite"),
        (save(tmp_path / "four.npy", np.ones((*SIZE, 4))), ("-o", tmp_path / "a.npy"), "has 4 numbers a pixel"),
        (tmp_path / "bad", ("-o", tmp_path / "a.npy"), "cannot be read"),
        (tmp_path / "nothing", ("-o", tmp_path / "a.npy"), "No such file"),
    ):
        status, said = called("import", place, *asked, *words)
        assert status == 2 and text in said and not (tmp_path / "a.npy").exists(), said
    status, found = called("import", source, *asked, "-o", tmp_path / "a.npy")
    assert status == 0 and found["output"] == str(tmp_path / "a.npy")
    assert called("import", source, *asked, "-o", tmp_path / "a.npy")[0] == 2, "it is there"
    assert called("import", source, *asked, "-o", tmp_path / "a.npy", "--overwrite")[0] == 0

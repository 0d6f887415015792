"""Patterns drawn without a run: what a camera sees of their pictures is what mitsim takes their frames for."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsim.core.errors import MitsimError
from mitsim.exchange.drawn import draw_family, draw_stripes, session_of
from mitsim.reconstruct.measured import calibrate_frames
from mitsim.rig.patterns import parse_patterns
from tests.real_session import RealSession, write_image

N = 4
PROJECTOR = 'name = "p"\neffective_wavelength_nm = 550.0\ncolumns = 30\nrows = 14\n'
CAMERA = """
name = "bench 3"
pixel_pitch_um = 5.0
full_well_e = 34720.0
read_noise_e = 10.0
dark_current_e_per_s = 4000.0
quantum_efficiency = 0.5
gain_dn_per_e = 0.125
black_level_dn = 160.0
bits = 12
source = "made up"
"""


@pytest.fixture
def devices(tmp_path: Path) -> tuple[str, str]:
    """Files of a projector, whose grid of 4 cells takes 12 of 14 rows and of 30 columns, and of a camera."""
    (tmp_path / "projector.toml").write_text(PROJECTOR)
    (tmp_path / "camera.toml").write_text(CAMERA)
    return str(tmp_path / "projector.toml"), str(tmp_path / "camera.toml")


def lights(folder: Path) -> list[np.ndarray]:
    """(n, n) of 0 to 1 in each picture, in the order of their names; nothing around the grid."""
    found = []
    for path in sorted((folder / "patterns").glob("pattern_*.png")):
        with Image.open(path) as picture:
            values = np.asarray(picture)
        assert values.shape == (14, 30) and set(np.unique(values)) <= {0, 255}
        grid = values[1:13, 9:21]
        assert values.sum() == grid.sum()
        found.append(grid.reshape(N, 3, N, 3).mean(axis=(1, 3)) / 255)
    return found


@pytest.mark.parametrize("mode", ["pair", "uniform"])
def test_frames_of_the_stripes_give_the_cameras_factors(mode: str, devices: tuple[str, str], tmp_path: Path) -> None:
    """The list that comes with them is theirs: the camera that sees them is found again, to its noise. (Planted:
    rows for columns, the negative half first, no uniform frame, another exposure in the list.)"""
    result = draw_stripes(tmp_path / "stripes", devices[0], session_of(devices[1], 0.02, N, mode))
    shown, session = lights(tmp_path / "stripes"), RealSession()
    assert result["pictures"] == len(shown) == (16 if mode == "pair" else 10)
    assert result["projector"] == {"rows": 14, "columns": 30, "cell": 3, "first_row": 1, "first_column": 9}
    (tmp_path / "frames").mkdir()
    for number, light in enumerate(shown):
        write_image(tmp_path / "frames" / f"shot {number}.png", session.frame(light))
    shutil.copy(tmp_path / "stripes" / "session.json", tmp_path / "frames")
    factors = calibrate_frames(tmp_path / "frames")
    assert factors.ok, factors.warnings
    found, exact = (np.kron(*sides) for sides in ((factors.left, factors.right), (session.left, session.right)))
    assert np.linalg.norm(found - exact) < 0.03 * np.linalg.norm(exact)


def test_a_family_is_drawn_shot_by_shot(devices: tuple[str, str], tmp_path: Path) -> None:
    """Of signed ones the positive half first. (Planted: rows and columns of a shot changed places.)"""
    for name in ("dots:2x3", "hadamard:2"):
        folder = tmp_path / name.replace(":", "_")
        result = draw_family(folder, name, N, devices[0])
        family = parse_patterns(name, N, 0)
        for light, shot in zip(lights(folder), family.shots, strict=True):
            assert np.array_equal(light, family.light(shot))
        described = json.loads((folder / "patterns.json").read_text())
        assert described["projector"] == result["projector"] and described["family"] == name
        assert [(shot["row"], shot["column"], shot["sign"]) for shot in described["shots"]] == [
            (shot.row, shot.column, shot.sign) for shot in family.shots
        ]


def test_what_cannot_be_drawn_is_refused_and_leaves_nothing(devices: tuple[str, str], tmp_path: Path) -> None:
    place = tmp_path / "new"
    (tmp_path / "bare.toml").write_text('name = "p"\neffective_wavelength_nm = 550.0\n')
    for words, name, n, projector in (
        ("do not fit a projector of 14 rows x 30 columns", "dots:2", 15, devices[0]),
        ("does not say its rows", "dots:2", N, str(tmp_path / "bare.toml")),
        ("K is 5", "dots:5", N, devices[0]),
        ("use uniform", "stripe", N, devices[0]),
    ):
        with pytest.raises(MitsimError, match=words):
            draw_family(place, name, n, projector)
    for words, exposure, n, mode in (("'pair' or 'uniform'", 0.02, N, "both"), ("exposure 0:", 0.0, N, "pair")):
        with pytest.raises(MitsimError, match=words):
            session_of(devices[1], exposure, n, mode)
    assert not place.exists()

"""`--colour lines` through the installed program: what each line's folder holds is a mono capture of that line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.configuration import shipped_path
from mitsim.core.exr import read_frame
from tests.system.refusals import Call
from tests.unit.transport.test_path_reuse import WALL

LINES = {638: 0.5, 520: 0.3, 445: 0.2}
"""Wavelengths [nm] and their parts of the power."""
SHEET, BOARD = {638: 0.9, 520: 0.3, 445: 0.5}, {638: 0.2, 520: 0.8, 445: 0.6}
"""Reflectance of the sheet and of a wall beside it, whose light on the sheet is a tenth of all."""
PROJECTOR = 'name = "lines"\neffective_wavelength_nm = {mean}\nwavelengths_nm = {lines}\nradiant_shares = {shares}\n'
POWER = 111000.0
ACCURACY = 1e-2
RANDOM = 'kind = "random"\nfeature_mm = 0.06\nfeatures = 63\n'
TURNED = 'kind = "separable"\nfeature_mm = 0.06\norder = 6\nrotation_deg = 0.3\n'
"""Masks whose shadows are drawn on a raster, for each line of its own."""
LAMP = '<emitter type="constant"><spectrum name="radiance" value="0.1"/></emitter>'


def spectrum(parts: dict[int, float]) -> str:
    """A reflectance that has these ``parts`` at the lines."""
    known = sorted(parts.items())
    ends = (known[0][0] - 40, known[0][1]), *known, (known[-1][0] + 40, known[-1][1])
    return ", ".join(f"{nm}:{part}" for nm, part in ends)


def projector(path: Path, lines: dict[int, float]) -> Path:
    """A file of a projector with these ``lines``."""
    mean = sum(nm * part for nm, part in lines.items()) / sum(lines.values())
    path.write_text(PROJECTOR.format(mean=mean, lines=[float(nm) for nm in lines], shares=list(lines.values())))
    return path


@pytest.fixture(scope="module")
def coloured(shared_scene: Callable[..., Path]) -> Callable[[str], Path]:
    """A coloured sheet, alone, beside a coloured wall or under a lamp; ``-D`` sets spectra and power."""

    def write(name: str) -> Path:
        bsdf = '<bsdf type="diffuse"><spectrum name="reflectance" value="$wall"/></bsdf>'
        extra = {"corner": WALL.format(turn=90, x=-30, bsdf=bsdf), "lamp": LAMP}.get(name, "")
        path = shared_scene(f"coloured {name}", extra=extra)
        text = path.read_text().replace('value="111000"', 'value="$power"')
        known = f'<default name="power" value="{POWER}"/><default name="wall" value="{spectrum(BOARD)}"/>'
        text = text.replace(
            '<default name="albedo" value="0.5"/>', f'<default name="albedo" value="{spectrum(SHEET)}"/>{known}'
        )
        path.write_text(text)
        return path

    return write


def worn(folder: Path, mask: str) -> tuple[str, ...]:
    """The options of a camera with that table ``mask``, kept in a ``folder``; none for the scene's own."""
    if not mask:
        return ()
    text = shipped_path("calibration", "imx249.toml").read_text(encoding="utf-8")
    (folder / "camera.toml").write_text(f"{text}\n[mask]\n{mask}", encoding="utf-8")
    return "--camera", str(folder / "camera.toml")


def electrons(run: Path) -> np.ndarray:
    """(shots, rows, columns) expected electrons of a ``run``."""
    return np.stack([read_frame(path)[0]["electrons"].astype(float) for path in sorted(run.glob("frame_*.exr"))])


@pytest.mark.parametrize(
    ("name", "mask"),
    [
        ("sheet", ""),
        pytest.param("corner", "", marks=pytest.mark.slow),
        pytest.param("sheet", RANDOM, marks=pytest.mark.slow),
        pytest.param("sheet", TURNED, marks=pytest.mark.slow),
    ],
)
def test_each_line_is_what_a_mono_capture_of_it_gives(
    call: Call, shell: Call, coloured: Callable[[str], Path], tmp_path: Path, name: str, mask: str
) -> None:
    """Reflectances, power, diffraction and photons of each line alone: frames differ by their Monte Carlo errors, also
    behind masks that are drawn on a raster for each line.

    In mono, light has other random numbers (seed 1), so that the two differ as independent estimates do; twice the
    error that both state for themselves, of thousands of pixels and 4 shots, is far beyond chance. A line's own
    brightness is off by half or more where a share, a spectrum or the photons' energy is wrong.
    """
    scene = coloured(name)
    # Fine enough to tell a random mask's shadow of one line from that of another, 1.1e-2.
    accuracy = 3e-3 if mask else ACCURACY
    common = "--patterns", "dots:2", "--accuracy", accuracy, "--exposure", 0.05, "--json", *worn(tmp_path, mask)
    whole = projector(tmp_path / "all.toml", LINES)
    outcome = shell("capture", scene, "-o", tmp_path / "run", "--colour", "lines", "--projector", whole, *common)
    # A random or turned mask has no two factors, so that the capture is flagged.
    assert outcome.code == bool(mask) and bool(outcome.err) == bool(mask)
    named = json.loads((tmp_path / "run" / "colour.json").read_text())
    assert named["kind"] == outcome.payload["kind"] == "colour-run"
    for channel, (nm, part) in zip(outcome.payload["channels"], LINES.items(), strict=True):
        assert (channel["name"], channel["wavelength_nm"], channel["radiant_share"]) == (f"{nm}nm", nm, part)
        alone = projector(tmp_path / f"{nm}.toml", {nm: 1.0})
        own = {"albedo": SHEET[nm], "power": POWER * part} | ({"wall": BOARD[nm]} if name == "corner" else {})
        defines = [text for key, value in own.items() for text in ("-D", f"{key}={value}")]
        folder = tmp_path / f"mono {nm}"
        mono = call("capture", scene, "-o", folder, "--projector", alone, *defines, *common, "--seed", 1).payload
        ours, theirs = electrons(tmp_path / "run" / f"{nm}nm"), electrons(folder)
        expected = np.hypot(channel["mc_error"], mono["mc_error"])
        assert np.linalg.norm(ours - theirs) < 2 * expected * np.linalg.norm(theirs)
        truths = [read_frame(run / "truth.exr")[0]["reflectance"] for run in (tmp_path / "run" / f"{nm}nm", folder)]
        assert truths[0] == pytest.approx(truths[1], abs=2 * ACCURACY)


@pytest.mark.slow
@pytest.mark.parametrize("mask", ["", TURNED])
def test_each_line_is_calibrated_for_itself(
    call: Call, shell: Call, coloured: Callable[[str], Path], tmp_path: Path, mask: str
) -> None:
    """Factors of a line are those of a mono session whose projector shows it alone, noise apart.

    Light is traced to a tenth of the turned mask's residual of 0.03: the error of each session's light is in its own.
    """
    whole = projector(tmp_path / "all.toml", LINES)
    scene, common = coloured("sheet"), (*worn(tmp_path, mask), "--accuracy", 3e-3, "--json", "-o")
    payload = shell("calibrate", scene, "--colour", "lines", "--projector", whole, *common, tmp_path / "cal").payload
    assert payload["kind"] == "colour-calibration"
    for channel, nm in zip(payload["channels"], LINES, strict=True):
        alone = projector(tmp_path / f"{nm}.toml", {nm: 1.0})
        mono = call("calibrate", scene, "--projector", alone, *common, tmp_path / f"mono {nm}").payload
        for key in ("separability_residual", "noise_free_residual", "condition"):
            assert channel[key] == pytest.approx(mono[key], rel=0.02), key
        assert channel["exposure_s"] * LINES[nm] == pytest.approx(mono["exposure_s"], rel=0.01)

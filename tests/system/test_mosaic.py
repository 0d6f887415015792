"""`--colour mosaic` through the installed program: frames are the lines' own behind filters, and come apart again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.exr import read_frame
from tests.system.conftest import CAMERA
from tests.system.refusals import Call
from tests.system.test_colour import LINES, SHEET, electrons, projector, spectrum

CURVES = {
    "R": {638: 0.4, 520: 0.1, 445: 0.05},
    "G": {638: 0.1, 520: 0.5, 445: 0.1},
    "B": {638: 0.05, 520: 0.2, 445: 0.4},
}
"""Electrons per photon of pixels under each filter at the lines."""
COMMON = "--patterns", "dots:2", "--accuracy", "1e-2", "--json"


def sheet(path: Path) -> Path:
    """The scene of a ``path`` with a coloured sheet."""
    known = f'<default name="albedo" value="{spectrum(SHEET)}"/>'
    path.write_text(path.read_text().replace('<default name="albedo" value="0.5"/>', known))
    return path


@pytest.fixture(scope="module")
def scene(shared_scene: Callable[..., Path]) -> Path:
    return sheet(shared_scene("sheet behind filters"))


@pytest.fixture(scope="module")
def devices(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    """Options of a camera behind filters, and of a projector of three lines."""
    folder = tmp_path_factory.mktemp("devices")
    camera = camera_behind_filters(folder / "filters.toml")
    return "--camera", str(camera), "--projector", str(projector(folder / "lines.toml", LINES))


def camera_behind_filters(path: Path) -> Path:
    """A file of a camera behind filters, of superpixels as the scene has them."""
    single = CAMERA.replace("5.86", "11.72").replace("binning = 2\n", "").replace("quantum_efficiency = 0.75\n", "")
    tables = "".join(
        f"[mosaic_curves.{name}]\nwavelengths_nm = {sorted(map(float, parts))}\n"
        f"efficiency = {[parts[nm] for nm in sorted(parts)]}\n"
        for name, parts in CURVES.items()
    )
    path.write_text(f'{single}mosaic = "GBRG"\n{tables}')
    return path


def test_a_pixel_sees_each_line_through_its_own_filter(
    shell: Call, scene: Path, devices: tuple[str, ...], tmp_path: Path
) -> None:
    """Against runs of each line by a monochrome camera, of the same paths: electrons by efficiencies' ratio."""
    run, lines = tmp_path / "run", tmp_path / "lines"
    common = *COMMON, "--exposure", "0.1"
    reported = shell("capture", scene, "-o", run, "--colour", "mosaic", *devices, *common).payload
    assert reported["kind"] == "mosaic-run" and reported["mosaic"] == "GBRG" and reported["warnings"] == []
    shell("capture", scene, "-o", lines, "--colour", "lines", *devices[2:], *common)
    seen, expected = electrons(run), np.zeros_like(electrons(run))
    for nm in LINES:
        alone = electrons(lines / f"{nm}nm") / 0.75
        for plane, (a, b) in zip("GBRG", ((0, 0), (0, 1), (1, 0), (1, 1)), strict=True):
            expected[:, a::2, b::2] += CURVES[plane][nm] * alone[:, a::2, b::2]
        truths = [read_frame(each / f"{nm}nm" / "truth.exr")[0]["reflectance"] for each in (run, lines)]
        assert np.array_equal(*truths)
    assert np.allclose(seen, expected, rtol=1e-5, atol=1e-5 * seen.max())
    assert reported["mc_error"] < 2e-2 and (run / "truth.exr").is_file()


NONE = "imx249.toml has no mosaic of colour filters; give one"


@pytest.mark.parametrize(
    ("verb", "options", "words"),
    [
        ("capture", "mosaic --patterns dots:2", NONE),
        ("calibrate", "mosaic --camera imx249", NONE),
        ("capture", "lines --camera ov5647 --patterns dots:2", "use colour mosaic"),
        ("capture", "no --camera ov5647 --patterns dots:2", "capture and calibrate by --colour mosaic"),
        ("capture", "red --patterns dots:2", "--colour 'red': use no, lines, bands:K or mosaic"),
        ("capture", "bands --patterns dots:2", "--colour 'bands': use no, lines, bands:K or mosaic"),
        ("capture", "bands:5 --patterns dots:2", "--colour 'bands:5': give bands:1 to bands:4"),
    ],
)
def test_what_colour_cannot_do_is_refused(
    call: Call, scene: Path, tmp_path: Path, verb: str, options: str, words: str
) -> None:
    assert words in call(verb, scene, "-o", tmp_path / "new", "--colour", *options.split()).refusal
    assert not (tmp_path / "new").exists()

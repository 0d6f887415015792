"""Images of lines from frames behind colour filters, by three ways; scenes whose spectra are numbers; lent factors."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.core.manifests import CalibrationManifest
from mitsim.devices.patterns import parse_patterns
from mitsim.metrics import psnr
from mitsim.reconstruct.colour import PLANES, JointMosaic, chart
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.solution import Status, Verdict
from mitsim.report.mosaic_images import demosaic
from mitsim.studies.lit_lines import ARRAY, HALF, JOINT, MosaicShots, filter_weights, replace_spectra, serving
from tests.ideal_sessions import picture, shadow
from tests.invented import sensor

N, WAVELENGTHS = 16, (638.0, 520.0, 445.0)


def lines(*shifts: float) -> tuple[Any, ...]:
    """A camera without noise at three lines; each moves its shadow by a part of a pixel."""
    bench = SimpleNamespace(sensor=sensor(quantum_efficiency=0.5))
    return tuple(
        SimpleNamespace(
            wavelength_nm=wavelength,
            lit=SimpleNamespace(truth=picture(seed), bench=bench),
            factors=SimpleNamespace(left=shadow(shift, N), right=shadow(-shift, N)),
        )
        for seed, (wavelength, shift) in enumerate(zip(WAVELENGTHS, shifts, strict=True))
    )


def shots(*shifts: float) -> MosaicShots:
    """Frames of three pictures under 3 x 3 dots, as the model has them."""
    seen, family = lines(*shifts), parse_patterns("dots:3", N)
    sides = (np.stack([getattr(line.factors, side) for line in seen]) for side in ("left", "right"))
    model = JointMosaic(*sides, filter_weights(seen), family.left.astype(float), family.right.astype(float))
    images = np.stack([line.lit.truth for line in seen])
    frames = [(model.frame(images, shot.row, shot.column), shot.row, shot.column) for shot in family.shots]
    return MosaicShots(seen, family, tuple(frames))


def quality(found: MosaicShots, way: str) -> float:
    return psnr(found.images(way).images.reshape(3, -1), found.truth.reshape(3, -1))


def test_planes_are_exact_where_lines_share_a_camera() -> None:
    found = shots(0.0, 0.0, 0.0)
    assert quality(found, HALF) > 60 and quality(found, JOINT) > 60


def test_only_the_joint_solve_knows_a_camera_for_each_line() -> None:
    found = shots(-0.3, 0.0, 0.3)
    assert quality(found, JOINT) > 100 and quality(found, HALF) < 55


def test_pixels_see_a_line_as_their_filters_curves_say() -> None:
    """Red light through the array RGGB: most in the first pixel of four, by the published curve over the camera's."""
    weights = filter_weights(lines(0, 0, 0))
    assert weights.shape == (4, 3) and np.array_equal(weights[1], weights[2])
    assert weights[0].argmax() == 0 and weights[1].argmax() == 1 and weights[3].argmax() == 2
    assert weights[0, 0] == pytest.approx((0.2 * 0.405 + 0.8 * 0.352) / 0.5)  # 638 nm, between 630 and 640


def test_a_demosaiced_frame_of_one_colour_is_that_colour() -> None:
    pytest.importorskip("colour_demosaicing")
    colour, frame = np.array([3.0, 5.0, 2.0]), np.zeros((12, 16))
    for name, (a, b) in zip(ARRAY, PLANES, strict=True):
        frame[a::2, b::2] = colour["RGB".index(name)]
    assert np.allclose(demosaic(frame, ARRAY), colour, atol=1e-9)


def test_demosaicing_names_what_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "colour_demosaicing", None)
    with pytest.raises(MitsimError, match=r"pip install 'mitsim\[mosaic\]'"):
        demosaic(np.zeros((4, 4)), ARRAY)


def test_spectra_become_numbers(tmp_path: Path) -> None:
    scene = replace_spectra("colour_checker", tmp_path / "copy", lambda at, values: float(np.interp(638.0, at, values)))
    text = (scene.parent / "patches.xml").read_text(encoding="utf-8")
    found = [float(number) for number in re.findall(r'name="reflectance" value="([\d.e-]+)"', text)]
    assert np.allclose(found, chart().at([638.0])[:, 0], rtol=1e-8)
    with pytest.raises(MitsimError, match="scene photograph: has no spectra"):
        replace_spectra("photograph", tmp_path / "other", lambda at, values: 1.0)


def test_a_lent_camera_has_the_gain_of_the_line() -> None:
    """Its own factors twice and three times as large lend themselves exactly."""
    manifest = CalibrationManifest(camera={})
    status = Status(Verdict.CALIBRATED, "Calibrated")
    own, lent = (Factors(left, left, manifest, status) for left in (shadow(0.0, N), 2 * shadow(0.0, N)))
    line, other = (SimpleNamespace(factors=each) for each in (own, lent))
    found = serving(line, other)  # type: ignore[arg-type]
    assert np.allclose(found.left, own.left) and np.allclose(found.right, own.right)

"""What goes wrong with masks, against closed forms of open areas."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry, MaskProfile
from mitsim.devices.mask import Plate

BARE = CameraGeometry(pixels=64)


def made(kind: str = "separable", **fields: object) -> Plate:
    return MaskProfile.model_validate({"kind": kind, "feature_mm": 0.06, "order": 6, **fields}).plate(Path())


def test_closed_and_open_parts_let_through_what_is_stated() -> None:
    plate, sharp = made(opaque_transmission=0.02, clear_transmission=0.9), made()
    assert set(np.unique(plate.values)) == {0.02, 0.9}
    assert plate.values.mean() == pytest.approx(0.02 + 0.88 * sharp.values.mean(), rel=1e-6)
    assert len(plate.terms) == 2 and plate.crosses is not None and plate.diffracts


def test_quarter_turns_are_numpys_and_no_flaw_is_no_change() -> None:
    """Bit for bit. (Planted: turned the other way.)"""
    profile = MaskProfile(kind="random", feature_mm=0.06, features=31)
    plain = profile.plate(Path())
    for turn, quarters in ((90.0, 1), (-90.0, 3), (180.0, 2)):
        turned = profile.model_copy(update={"rotation_deg": turn}).plate(Path())
        np.testing.assert_array_equal(turned.values, np.rot90(plain.values, quarters))
        assert turned.plain
    named = MaskProfile(kind="separable", feature_mm=0.06, rotation_deg=0.0)
    assert named.put_on(BARE, Path()) == CameraGeometry(pixels=64)


def test_masks_too_large_for_their_flaws_are_refused_in_one_line() -> None:
    with pytest.raises(MitsimError, match=r"^[^\n]*up to 12[^\n]*$"):
        MaskProfile(kind="separable", feature_mm=0.06, order=13, edge_blur_um=1.0).plate(Path())
    thick = CameraGeometry(mask_thickness=0.1)
    for flaw in ({"edge_blur_um": 1.0}, {"rotation_deg": 1.0}, {"tilt_row_mrad": 1.0}):
        with pytest.raises(MitsimError, match="mask_thickness"):
            MaskProfile.model_validate({"kind": "separable", "feature_mm": 0.06, **flaw}).put_on(thick, Path())
    MaskProfile(kind="flatcam", feature_mm=0.06, opaque_transmission=0.1).put_on(thick, Path())

"""The table [drift]: what it takes, what moves, and the recipe that ships with one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

from mitsim.core.configuration import Configuration, shipped_path, validate
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.session import DRIFTS, BoardShape, Drift, Exposures, MaskMotion, SessionRecipe, load_recipe


def test_one_kind_alone() -> None:
    """Warmth widens the gap; other kinds stay behind. (Planted: the gap left out; all kinds kept.)"""
    both = Drift(mask_rows_um=3.0, temperature_k=20.0, gap_um_per_k=0.05)
    assert both.alone("temperature_k").mask_mm == pytest.approx((0, 0, 1e-3))
    assert both.alone("mask_rows_um", 5).mask_mm == pytest.approx((5e-3, 0, 0))
    assert both.kinds == ("mask_rows_um", "temperature_k")
    assert Drift(mask_tilt_rows_mrad=2.0, mask_tilt_columns_mrad=-1.0).tilt_mrad == (2.0, -1.0)
    assert Drift(mask_tilt_columns_mrad=-1.0).tilt_mrad == (0.0, -1.0) and both.tilt_mrad is None
    assert Drift(vibration_um=2.0).motion == MaskMotion(vibration_um=2.0)


def test_a_ripple_has_a_frequency_and_keeps_it() -> None:
    """Each source its own. (Planted: the other's frequency; frequencies left behind.)"""
    both = Drift(power_ripple=0.2, power_ripple_hz=60.0, lamp_ripple=0.5, lamp_ripple_hz=100.0)
    assert both.ripples == {"power": (0.2, 60.0), "lamp": (0.5, 100.0)}
    assert both.alone("lamp_ripple", 0.1).ripples == {"lamp": (0.1, 100.0)}
    assert both.alone("power").ripples == {} and Drift(power_ripple_hz=60.0).kinds == ()
    with pytest.raises(MitsimError, match=r"^drift[^\n]*lamp_ripple 0\.1 has no frequency; give lamp_ripple_hz[^\n]*$"):
        Drift(power_ripple_hz=60.0).alone("lamp_ripple", 0.1)


def test_the_shipped_drift_is_of_the_shipped_session(tmp_path: Path) -> None:
    """All kinds move in it; its session is that of session.toml. (Planted: another exposure there.)"""
    recipe = load_recipe(shipped_path("calibration", "drift.toml"))
    assert recipe.drift.kinds == tuple(DRIFTS)
    bare = {"drift": Drift(), "source": ""}
    assert recipe.model_copy(update=bare) == load_recipe().model_copy(update=bare)
    bad = tmp_path / "bad.toml"
    bad.write_text(shipped_path("calibration", "drift.toml").read_text().replace("power = 0.005", 'power = "5 %"'))
    with pytest.raises(MitsimError, match=r"drift\.power"):
        load_recipe(bad)


@pytest.mark.parametrize(
    ("model", "taken", "beyond"),
    [
        (Drift, {"power_ramp": -1.0}, {"power_ramp": -1.001}),  # a lamp that ends dark
        (Drift, {"temperature_k": 200.0}, {"temperature_k": 200.001}),
        (Drift, {"temperature_k": -200.0}, {"temperature_k": -200.001}),
        (BoardShape, {"size_mm": 250.0, "bow_mm": -25.0}, {"size_mm": 250.0, "bow_mm": -25.001}),
        (SessionRecipe, {"repeats": 1}, {"repeats": 0}),
    ],
)
def test_a_session_is_taken_up_to_its_limits(
    model: type[Configuration], taken: dict[str, Any], beyond: dict[str, Any]
) -> None:
    """(Planted: a negative power taken; a limit one larger; a board that may not bow a tenth.)"""
    recipe = {"board_reflectance": 0.9, "exposure_fraction": 0.8, "signed_capture": "pair", "source": ""}
    stated = recipe if model is SessionRecipe else {}
    assert validate(model, stated | taken, "here").model_dump(include=set(taken)) == taken
    with pytest.raises(MitsimError, match=list(beyond)[-1]):
        validate(model, stated | beyond, "here")


def test_exposures_of_one_frame_rise_from_1() -> None:
    ladder: TypeAdapter[tuple[float, ...]] = TypeAdapter(Exposures)
    assert ladder.validate_python((1, 4, 16)) == (1, 4, 16)
    for wrong in ((1, 4, 4), (2, 4), (1, 8, 4)):
        with pytest.raises(ValueError, match="rising numbers"):
            ladder.validate_python(wrong)


def test_a_camera_that_moves_is_another() -> None:
    """(Planted: its motion left out of the identity.)"""
    still = CameraGeometry()
    turned = still.model_copy(update={"mask_motion": MaskMotion(rotation_mrad=1.0)})
    assert turned.identity != still.identity and "mask_motion" not in still.identity
    assert hash(turned) != hash(still)

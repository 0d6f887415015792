"""What drifts, as a camera's exposures and a bench's optics have it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from mitsim.acquire.exposure import AmbientFrame, DriftedExposer, Exposer, drift_mask, levels, taken_off, warmer
from mitsim.api.bench import Bench
from mitsim.calibrate.board_session import Session
from mitsim.core.configuration import load_model, shipped_path
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import stream
from mitsim.devices.camera import CameraGeometry, Devices, MaskProfile
from mitsim.devices.patterns import parse_patterns
from mitsim.devices.projector import ProjectorModel
from mitsim.devices.sensor import load_sensor
from mitsim.devices.session import SIDES, Drift, load_recipe
from mitsim.optics.frames import Frame
from mitsim.optics.shadow import Directions
from mitsim.optics.terms import shadow_terms
from mitsim.sensor.chain import ripple_level, ripple_response

PIXELS, SECONDS, SEED = 12, 0.01, 5
SENSOR = load_sensor(shipped_path("calibration", "imx249.toml"))
DEVICES = Devices(
    CameraGeometry(pixels=PIXELS),
    SENSOR,
    load_model(shipped_path("calibration", "mp_cl1.toml"), ProjectorModel),
    "imx249.toml",
)
FAMILY = parse_patterns("dots:2", 4)
RNG = np.random.default_rng(1)
AMBIENT = 2e-3 * RNG.random((PIXELS, PIXELS))
FRAMES = [Frame(AMBIENT + 0.02 * RNG.random((PIXELS, PIXELS)), 0.0, 0.0, 0.0) for _ in FAMILY.shots]


def exposer(**drift: float) -> DriftedExposer:
    return DriftedExposer(DEVICES, SECONDS, SEED, drift=Drift(**drift), family=FAMILY, ambient=AMBIENT)


def frames(camera: Exposer) -> np.ndarray:
    return np.stack([rate for rate, _, _ in camera.measurements(FAMILY, cast(Any, FRAMES))])


def test_without_drift_frames_are_the_same_bit_for_bit() -> None:
    """(Planted: the lamps' light added once more.)"""
    still, drifting = Exposer(DEVICES, SECONDS, SEED), exposer()
    assert np.array_equal(frames(drifting), frames(still))
    for shot, frame in zip(FAMILY.shots, FRAMES, strict=True):
        assert np.array_equal(drifting.shot_electrons(frame, *shot.names), still.shot_electrons(frame, *shot.names))


def test_power_scales_the_projectors_light_and_lamps_that_of_lamps() -> None:
    """Without lamps all light is the projector's. (Planted: the lamps' light scaled with the projector's.)"""
    dark = DriftedExposer(DEVICES, SECONDS, SEED, drift=Drift(power=0.1), family=FAMILY)
    assert np.allclose(dark.shot_electrons(FRAMES[0], *FAMILY.shots[0].names), 1.1 * dark.electrons(FRAMES[0]))
    for camera, power, lamp in ((exposer(power=0.1), 1.1, 1.0), (exposer(lamp=0.3), 1.0, 1.3)):
        for shot, frame in zip(FAMILY.shots, FRAMES, strict=True):
            expected = power * (frame.irradiance - AMBIENT) + lamp * AMBIENT
            unit = Exposer(DEVICES, SECONDS, SEED).electrons(Frame(expected, 0.0, 0.0, 0.0))
            assert np.allclose(camera.shot_electrons(frame, *shot.names), unit, rtol=1e-12)


def test_ramps_and_flicker_are_of_frames_in_their_order() -> None:
    """(Planted: a ramp that ends before the last frame; flicker of one draw for all.)"""
    assert np.allclose(levels(0, "power", 4, ramp=0.8), [1.1, 1.3, 1.5, 1.7])
    many = levels(0, "power", 4000, flicker=0.01)
    assert many.std() == pytest.approx(0.01, rel=0.05) and abs(many.mean() - 1) < 5e-4
    assert (
        np.array_equal(many[:7], levels(0, "power", 7, flicker=0.01))
        and levels(1, "power", 7, flicker=0.01)[0] != many[0]
    )
    assert levels(0, "power", 500, flicker=0.9).min() == 0
    camera = exposer(power_ramp=0.8)
    assert [camera.levels[shot.names][0] for shot in FAMILY.shots] == pytest.approx([1.1, 1.3, 1.5, 1.7])


def test_an_exposure_that_is_too_long_is_read_as_more_light() -> None:
    """Of light and dark current alike; the mean over 4 frames of 144 pixels is good to 0.1 %. (Planted: the rate by the
    time that the shutter was open.)"""
    before, after = (frames(camera).mean() for camera in (exposer(), exposer(exposure=0.2)))
    assert after / before == pytest.approx(1.2, rel=3e-3)


def test_black_level_and_warmth_add_to_every_datum() -> None:
    """4 pixels a superpixel at 0.125 DN an electron: 2 DN are 64 electrons. A kelvin more dark current where the file
    states its law, and none where it does not. (Planted: one code a superpixel; the user's sensor warm, too.)"""
    change = (frames(exposer(black_level_dn=2.0)) - frames(exposer())).mean() * SECONDS
    assert change == pytest.approx(64, abs=0.5)
    assert warmer(SENSOR, 10.0) == SENSOR
    law = {"dark_current_temperature_c": 25.0, "dark_doubling_c": 8.0, "dark_current_e_per_s": 1e5}
    stated = SENSOR.model_copy(update=law)
    assert warmer(stated, 8.0).superpixel_dark_current_e_per_s == pytest.approx(2 * 4e5)
    hot = replace(exposer(temperature_k=8.0), devices=replace(DEVICES, sensor=stated))
    cold = replace(exposer(), devices=replace(DEVICES, sensor=stated))
    assert (frames(hot) - frames(cold)).mean() == pytest.approx(4e5, rel=0.01)


def test_an_ambient_frame_holds_the_lamps_as_they_were() -> None:
    """Their change is after it, their flicker is in it: the mean of 16 shots. (Planted: the change in it; nothing taken
    off where there are lamps.)"""

    class Lit(list[Frame]):
        has_ambient, projector_off = True, Frame(AMBIENT, 0.0, 0.0, 0.0)

    lit = cast(Any, Lit(FRAMES))
    known = taken_off(exposer(), FAMILY, lit)
    assert np.array_equal(taken_off(exposer(lamp=0.5), FAMILY, lit), known)
    flickering = exposer(lamp_flicker=0.2)
    found = (
        AmbientFrame.expose(flickering, lit, 16).digital.mean() - AmbientFrame.expose(exposer(), lit, 16).digital.mean()
    )
    electrons = exposer().electrons(Lit.projector_off).mean()
    assert np.mean(known) == pytest.approx(electrons / SECONDS, rel=0.02)
    assert found == pytest.approx((flickering.ambient_levels.mean() - 1) * electrons * SENSOR.gain_dn_per_e, rel=0.2)


@pytest.mark.parametrize("order", ["listed", "reversed"])
@pytest.mark.parametrize("signed", ["pair", "uniform"])
def test_a_sessions_power_drifts_in_the_order_of_its_frames(order: str, signed: str) -> None:
    """Evenly from its first frame to its last, over repeats. (Planted: a pair's halves swapped.)"""
    changes = {"order": order, "signed_capture": signed, "repeats": 2}
    recipe = load_recipe().model_copy(update={**changes, "drift": Drift(session_ramp=0.5)})
    session = Session(cast(Any, SimpleNamespace(n=4)), recipe)
    powers = session.powers
    in_order = [powers[shot] for shot in sorted(powers, key=lambda shot: powers[shot][0])]
    assert np.allclose(np.ravel(in_order), 1 + 0.5 * (np.arange(2 * len(powers)) + 0.5) / (2 * len(powers)))
    shots = [(side, number) for side in SIDES for number in range(len(powers) // 2)]
    width = 2 if signed == "pair" else 1
    blocks = [shots[start : start + width] for start in range(0, len(shots), width)]
    expected = [shot for block in (blocks if order == "listed" else blocks[::-1]) for shot in block]
    assert sorted(powers, key=lambda shot: powers[shot][0]) == expected


def bench(mirrors: bool = False, **geometry: Any) -> Bench:
    return Bench(
        cast(Any, SimpleNamespace(mirrors=mirrors, path=Path("scene.xml"))),
        replace(DEVICES, camera=DEVICES.camera.model_copy(update=geometry)), "", {},
    )  # fmt: skip


def test_a_mask_moved_by_a_pixel_casts_the_same_shadow_a_pixel_on() -> None:
    """Along the rows alone, and by the pixel as the mask sees it: the frame of a scene is shifted by a row. (Planted:
    the columns instead; the other sign.)"""
    camera, cells = DEVICES.camera.model_copy(update={"pixels": 64}), Directions.cells(np.linspace(-0.05, 0.05, 9))
    by_um = 1e3 * camera.pixel_pitch * (1 - camera.mask_distance / 400.0)
    moved = drift_mask(bench(pixels=64), Drift(mask_rows_um=by_um)).geometry
    scene = np.random.default_rng(2).random((8, 8))
    frame, before = (
        sum(left @ scene @ right.T for left, right in shadow_terms(each, cells, cells, 400.0))
        for each in (moved, camera)
    )
    assert np.allclose(frame[1:], before[:-1], rtol=1e-9) and not np.allclose(frame, before, rtol=1e-3)


def test_a_mask_that_tilts_casts_the_shadow_of_one_that_was_made_so() -> None:
    """Of a camera file's mask with that tilt, and with a part of it in the file."""

    def made(rows: float, columns: float) -> CameraGeometry:
        table = {
            "kind": "separable",
            "feature_mm": 0.06,
            "order": 7,
            "tilt_row_mrad": rows,
            "tilt_column_mrad": columns,
        }
        return MaskProfile.model_validate(table).put_on(DEVICES.camera.model_copy(update={"pixels": 48}), Path())

    def frame(camera: CameraGeometry) -> np.ndarray:
        cells = Directions.cells(np.linspace(-0.15, 0.15, 4))
        return np.asarray(sum(left @ right.T for left, right in shadow_terms(camera, cells, cells, 400.0)))

    expected, even = frame(made(6.0, -2.0)), frame(made(0.0, 0.0))
    for before, drift in (
        (made(0.0, 0.0), Drift(mask_tilt_rows_mrad=6.0, mask_tilt_columns_mrad=-2.0)),
        (made(2.0, -2.0), Drift(mask_tilt_rows_mrad=4.0)),
    ):
        moved = drift_mask(replace(bench(), devices=replace(DEVICES, camera=before)), drift).geometry
        assert np.linalg.norm(frame(moved) - expected) < 1e-3 * np.linalg.norm(expected - even)
    assert Drift().tilt_mrad is None and drift_mask(bench(), Drift()).geometry.identity == bench().geometry.identity
    assert drift_mask(bench(), Drift(mask_tilt_rows_mrad=4.0)).geometry.identity != bench().geometry.identity


def test_what_cannot_be_formed_is_refused() -> None:
    """(Planted: mirrors not looked at; the raster as well.)"""
    with pytest.raises(MitsimError, match=r"^drift: [^\n]*mirrors$"):
        drift_mask(bench(mirrors=True), Drift(vibration_um=1.0))
    mask = MaskProfile.model_validate({"kind": "separable", "feature_mm": 0.06, "order": 5, "rotation_deg": 1.0})
    turned = mask.put_on(DEVICES.camera, Path())
    for drift in (Drift(vibration_um=1.0), Drift(mask_tilt_columns_mrad=1.0)):
        with pytest.raises(MitsimError, match=rf"^drift: {drift.kinds[0]} [^\n]*\[mask\]$"):
            drift_mask(bench(mask="plate", mask_plate=turned.mask_plate), drift)
    with pytest.raises(MitsimError, match=r"^drift: mask_tilt_rows_mrad [^\n]*mirrors$"):
        drift_mask(bench(mirrors=True), Drift(mask_tilt_rows_mrad=1.0))
    with pytest.raises(MitsimError, match=r"^drift: mask_tilt_rows_mrad [^\n]*mask_thickness to 0$"):
        drift_mask(bench(mask_thickness=0.1), Drift(mask_tilt_rows_mrad=1.0))
    both = Drift(mask_tilt_rows_mrad=20.0, mask_tilt_columns_mrad=20.0)
    with pytest.raises(MitsimError, match=r"^drift: mask_tilt_rows_mrad and mask_tilt_columns_mrad [^\n]*one axis$"):
        drift_mask(bench(pixels=512), both)
    with pytest.raises(MitsimError, match=r"^drift: mask_axis_um [^\n]*$"):
        drift_mask(bench(mask_distance=0.5), Drift(mask_axis_um=-600.0))


ROLLING = replace(DEVICES, sensor=SENSOR.model_copy(update={"shutter": "rolling", "line_time_us": 300.0}))


def rippled(devices: Devices, **drift: float) -> DriftedExposer:
    return replace(exposer(**drift), devices=devices)


def test_a_ripple_is_a_level_of_each_row_by_a_phase_of_each_frame() -> None:
    """Of the projector's light or of the lamps' alone; a global shutter's rows have one level. Frames are the same in
    any order. (Planted: both sources rippled; one phase for all frames; columns for rows; the exposure that was asked
    for in place of the one that the camera has.)"""
    for source, devices in (("power", ROLLING), ("lamp", ROLLING), ("power", DEVICES)):
        camera = rippled(devices, **{f"{source}_ripple": 0.4, f"{source}_ripple_hz": 37.0, "exposure": 0.5})
        seen = []
        for shot, frame in reversed(list(zip(FAMILY.shots, FRAMES, strict=True))):
            open_s = 1.5 * SECONDS
            own = {"power": frame.irradiance - AMBIENT, "lamp": AMBIENT}
            unit = Exposer(DEVICES, SECONDS, SEED).electrons(Frame(own[source], 0.0, 0.0, 0.0))
            whole = Exposer(DEVICES, SECONDS, SEED).electrons(frame)
            level = 1 + (camera.shot_electrons(frame, *shot.names) / 1.5 - whole) / unit
            assert np.allclose(level, level[:, :1], rtol=1e-9)
            phase = stream(SEED, "drift", f"{source} ripple", *shot.names).uniform(0, 2 * np.pi)
            response = ripple_response(devices.sensor, open_s, 37.0, PIXELS)
            assert np.allclose(level, ripple_level(response, 0.4, phase), rtol=1e-9)
            assert (np.ptp(level[:, 0]) < 1e-9) == (devices is DEVICES)
            seen.append(level[0, 0])
        assert len(set(np.round(seen, 6))) == len(FRAMES)

"""Noise of frames and of their differences, on devices of plain numbers: no scene is loaded and no light traced.

The sensor has no ADC and no full well, so a frame's numbers are its electrons, shot noise plus read noise.

Shots that are exposed in chunks while files of the chunk before are written, on devices of plain numbers.
"""

from __future__ import annotations

import copy
from types import SimpleNamespace

import numpy as np
import pytest

from mitsim.acquire.exposure import AmbientFrame, Exposer, Shooting, camera_warnings
from mitsim.calibrate.board_session import Session
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.core.runs import Recorder
from mitsim.devices.camera import Devices
from mitsim.devices.patterns import parse_patterns
from mitsim.devices.sensor import SensorModel
from mitsim.devices.session import load_recipe
from mitsim.light import cost_model
from mitsim.optics.frames import Frame
from mitsim.sensor import chain
from tests.invented import sensor

SENSOR = SensorModel(
    name="bare",
    pixel_pitch_um=10.0,
    full_well_e=float("inf"),
    read_noise_e=3.0,
    quantum_efficiency=0.5,
    gain_dn_per_e=1.0,
    source="chosen",
)
PIXELS = 8


def exposer(**sensor: float) -> Exposer:
    devices = Devices(
        camera=SimpleNamespace(),
        sensor=SENSOR.model_copy(update=sensor),
        projector=SimpleNamespace(effective_wavelength_nm=550.0),
        camera_file="none",
    )
    return Exposer(devices, exposure_s=0.25, seed=5)


def frame(peak: float) -> Frame:
    """Light that rises along the rows to ``peak`` [W m^-2]."""
    return Frame(peak * np.linspace(0.1, 1.0, PIXELS**2).reshape(PIXELS, PIXELS), 0.0, 0.0, 0.0)


# ---- streams ---------------------------------------------------------------------------------------------------------


def test_read_noise_is_the_same_draw_whatever_the_light() -> None:
    """What read noise adds to shot noise does not hang on how many numbers shot noise took from its stream.

    (Planted: one generator for both.) A Poisson draw takes more numbers the brighter a pixel is.
    """

    def read_noise(electrons: float) -> FloatArray:
        light = np.full((PIXELS, PIXELS), electrons)
        return exposer().digital(light, "frame", 0) - exposer(read_noise_e=0.0).digital(light, "frame", 0)

    dark, dim, bright = (read_noise(electrons) for electrons in (0.0, 5.0, 500.0))
    assert dark.std() == pytest.approx(3.0, rel=5 / np.sqrt(2 * PIXELS**2)), "five deviations of the deviation of 64"
    # Sums with some 500 electrons round to 1e-13.
    np.testing.assert_allclose(dim, dark, rtol=0, atol=1e-11)
    np.testing.assert_allclose(bright, dark, rtol=0, atol=1e-11)


def test_no_two_noises_of_a_capture_share_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shot and read noise of both halves of all patterns draw from streams that have no 64-bit number in common.

    (Planted: the stream "shot" for both; the sign left out of a shot's names.) By chance two of 8 x 2 x 100 numbers of
    64 bits agree once in 1e13 runs.
    """
    drawn: list[int] = []

    def recorded(electrons: FloatArray, _: float, __: object, *streams: np.random.Generator) -> FloatArray:
        for rng in streams:
            drawn.extend(copy.deepcopy(rng).integers(2**64, size=100, dtype=np.uint64).tolist())
        return electrons

    monkeypatch.setattr(chain, "expose", recorded)
    shots = parse_patterns("hadamard:2", 4).shots
    for shot in shots:
        exposer().digital(np.ones((2, 2)), *shot.names)
    assert len(drawn) == 2 * 100 * len(shots) == len(set(drawn))


# ---- differences -----------------------------------------------------------------------------------------------------


def test_a_signed_measurement_is_the_plain_difference_of_its_two_frames() -> None:
    """(Planted: the -1 frame weighted 0.999.) The halves are known to the last bit: their noise is found by names."""
    family = parse_patterns("hadamard:2", 4)
    camera = exposer(dark_current_e_per_s=40.0, black_level_dn=20.0)
    frames = [frame(1e-6 * (2 + index)) for index in range(len(family.shots))]
    rates = [
        camera.rate(camera.digital(camera.shot_electrons(light, *shot.names), *shot.names))
        for shot, light in zip(family.shots, frames, strict=True)
    ]
    measured = list(camera.measurements(family, frames))
    assert [index for _, *index in measured] == [[0, 0], [0, 1], [1, 0], [1, 1]]
    for (difference, *_), positive, negative in zip(measured, rates[::2], rates[1::2], strict=True):
        assert np.array_equal(difference, positive - negative)


# ---- figures ---------------------------------------------------------------------------------------------------------


def test_electrons_and_rates_are_each_others_inverse_in_the_mean() -> None:
    """E A t eta / (h c / lambda) electrons, of which the rate is that over t: dark current and black level cancel."""
    camera = exposer(dark_current_e_per_s=40.0, black_level_dn=20.0)
    photon_j = 6.62607015e-34 * 299792458 / 550e-9
    expected = 2e-6 * (10e-6) ** 2 * 0.25 * 0.5 / photon_j
    electrons = camera.electrons(frame(2e-6))
    assert electrons.max() == pytest.approx(expected, rel=1e-6)
    noiseless = electrons + 40.0 * 0.25 + 20.0
    np.testing.assert_allclose(camera.rate(noiseless), electrons / 0.25, rtol=1e-12)


def test_what_an_image_does_not_know_of_a_camera_is_said() -> None:
    quiet = sensor(dsnu_pixel_e=2.0, prnu_row=0.01, prnu_column=0.01)
    assert not list(camera_warnings(quiet, (10, 10)))
    loud = sensor(dead_pixels=0.03, row_noise_e=2.0, linearity=(-0.01,), prnu_pixel=0.01, binning=2)
    defects, response, rows, bent = camera_warnings(loud, (10, 10))
    assert " are hot and " in defects and "by 0.50% of" in response and "5.65685 electrons" in rows and "-1.0%" in bent


def test_a_session_says_what_factors_do_not_know_of_a_camera() -> None:
    """(Planted: the mask's warnings alone.)"""
    loud = sensor(dead_pixels=0.03, row_noise_e=2.0, linearity=(-0.01,))
    bench = SimpleNamespace(sensor=loud, geometry=SimpleNamespace(mask_plate=None, frame_shape=(10, 10)))
    session = Session(bench, load_recipe())  # type: ignore[arg-type]
    session.__dict__["mask_warnings"] = ("the mask",)
    assert session.warnings == ("the mask", *camera_warnings(loud, (10, 10)))


FAMILY = parse_patterns("dots:5", 10)
FRAMES = [frame(1e-6 * (2 + index)) for index in range(25)]


def shot(recorder: Recorder) -> Shooting:
    shooting = Shooting(FAMILY, recorder, exposer(), None, np.zeros((PIXELS, PIXELS)))
    shooting.shoot(FRAMES, Job())
    return shooting


@pytest.mark.parametrize("together", [1, 7, 100])
def test_shots_are_the_same_however_many_are_exposed_at_a_time(together: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit by bit, and with them what is told of all. (Planted: noise named by the place in the chunk; the last chunk's
    files not waited for; its sums left out.)"""
    one, other = Recorder(), Recorder()
    first = shot(one)
    monkeypatch.setattr(cost_model, "FRAMES_AT_ONCE", together)
    second = shot(other)
    assert one.files.keys() == other.files.keys() and len(one.files) == 25
    for name, (channels, metadata) in one.files.items():
        assert metadata == other.files[name][1]
        assert all(np.array_equal(values, other.files[name][0][channel]) for channel, values in channels.items())
    for reported in ("sensor_noise", "saturated", "noise_ratio", "dilution", "ambient_part", "noise_to_signal"):
        assert getattr(first, reported) == getattr(second, reported)
    electrons = np.array([channels["electrons"] for channels, _ in one.files.values()], dtype=np.float64)
    assert first.sensor_noise**2 * np.square(electrons).sum() == pytest.approx((electrons + 9).sum(), rel=1e-6)


def test_noise_is_stated_relative_to_the_light_without_lamps() -> None:
    """With an ambient frame of four shots, whose noise is in every frame; here a datum's variance is its electrons and
    9. (Planted: the noise of one frame's ambient light for all; lamps counted as light.)"""
    camera, recorder = exposer(), Recorder()
    lamps = camera.electrons(frame(1e-6))
    shooting = Shooting(FAMILY, recorder, camera, AmbientFrame(4, lamps, lamps, False), lamps)
    shooting.shoot(FRAMES, Job())
    electrons = np.array([channels["electrons"] for channels, _ in recorder.files.values()], dtype=np.float64)
    noise, ambient = (electrons + 9).sum(), 25 * (lamps + 9).sum() / 4
    assert shooting.noise_to_signal**2 * np.square(electrons - lamps).sum() == pytest.approx(noise + ambient, rel=1e-5)


def test_a_file_that_cannot_be_written_ends_the_shooting(monkeypatch: pytest.MonkeyPatch) -> None:
    """In one line, whichever of the chunks it is in; frames that are not begun are not written either."""
    monkeypatch.setattr(cost_model, "FRAMES_AT_ONCE", 4)
    for bad in ("frame_00000.exr", "frame_00024.exr"):

        class Full(Recorder):
            def write(self, name, channels, metadata, bad=bad) -> None:
                if name == bad:
                    raise MitsimError(f"file {name}: cannot be written (No space left on device)")
                super().write(name, channels, metadata)

        recorder = Full()
        with pytest.raises(MitsimError, match=f"^file {bad}: cannot be written"):
            shot(recorder)
        assert bad not in recorder.files and len(recorder.files) <= (24 if bad.endswith("24.exr") else 8)

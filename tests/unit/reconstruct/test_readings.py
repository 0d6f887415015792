"""Frames that fit only when they are read otherwise: turned, in another order, of another scale or curve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mitsim.core.runs import Capture
from mitsim.devices.patterns import shot_orders
from mitsim.reconstruct.misfit import Cause
from mitsim.reconstruct.reconstruct import reconstruct
from tests.ideal_sessions import BLACK, CODES, Bench, bench, picture, shadow
from tests.unit.reconstruct.test_faults import Frames, with_frames

CAMERA = Bench(shadow(), shadow(1.3))
"""Not alike along rows and columns, so that frames on their side are seen under uniform light, too."""
TURNS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "upside down": np.flipud,
    "mirrored": np.fliplr,
    "180": lambda frame: np.rot90(frame, 2),
    "transposed, their rows": np.transpose,
    "90 degrees counter-clockwise": np.rot90,
    "90 degrees clockwise": lambda frame: np.rot90(frame, -1),
    "other diagonal": lambda frame: np.rot90(frame, 2).T,
}


def reported(
    patterns: str, change: Callable[[Frames], Frames], camera: Bench = CAMERA
) -> tuple[Cause | None, list[str]]:
    shots = with_frames(camera.run(patterns, picture(1), 1), change)
    misfit = reconstruct(shots, camera.calibrated(1)).misfit
    assert misfit is not None
    return misfit.cause, [reading.words for reading in misfit.readings]


@pytest.mark.parametrize("patterns", ["uniform", "dots:4", "hadamard:4", "random:4"])
@pytest.mark.parametrize("turn", TURNS)
def test_turned_frames(patterns: str, turn: str) -> None:
    """(Planted: the turn itself in place of the one that brings frames back.)"""
    cause, (words,) = reported(patterns, lambda frames: [TURNS[turn](frame) for frame in frames])
    assert cause is Cause.READING and turn in words


@pytest.mark.parametrize("patterns", ["dots:4", "hadamard:4", "random:4"])
def test_another_order(patterns: str) -> None:
    assert "one step late" in reported(patterns, lambda frames: [frames[-1], *frames[:-1]])[1][0]
    assert "one step early" in reported(patterns, lambda frames: [*frames[1:], frames[0]])[1][0]
    cause, (words,) = reported(patterns, lambda frames: frames[::-1])
    assert cause is Cause.READING and words == "the shots were taken in the order reversed"


@pytest.mark.parametrize("name", ["column-major", "sequency", "dyadic", "halves-exchanged", "plus-first"])
def test_orders_that_import_knows(name: str) -> None:
    """Frames in another order are restored by the permutation of that name, and by no other of this camera."""
    shots = CAMERA.run("hadamard:4", picture(1), 1)
    order = np.argsort(shot_orders(shots.manifest.patterns)[name])
    misfit = reconstruct(with_frames(shots, lambda frames: [frames[k] for k in order]), CAMERA.calibrated(1)).misfit
    assert misfit is not None and [reading.order for reading in misfit.readings] == [name]


def test_readings_that_fit_alike_are_all_listed() -> None:
    """With equal masks on both sides transposed frames and shots of a loop over columns cannot be told apart."""
    cause, words = reported("dots:4", lambda frames: [frames[4 * (k % 4) + k // 4] for k in range(16)], bench())
    assert cause is Cause.READING and len(words) == 2
    assert any("transposed" in each for each in words) and any("column-major" in each for each in words)


def test_exchanged_halves_of_all_pairs() -> None:
    cause, words = reported("hadamard:4", lambda frames: [frames[number ^ 1] for number in range(len(frames))])
    assert cause is Cause.READING and "halves-exchanged" in words[0]


@pytest.mark.parametrize("patterns", ["uniform", "dots:4", "hadamard:4", "random:4"])
@pytest.mark.parametrize("exponent", [1.8, 2.2])
def test_a_tone_curve(patterns: str, exponent: float) -> None:
    """Its exponent is found to a tenth. (Planted: the misfit in curved numbers, by which any crushing curve wins.)"""
    span = CODES - 1 - BLACK
    cause, words = reported(
        patterns, lambda frames: [BLACK + span * (np.maximum(f - BLACK, 0) / span) ** (1 / exponent) for f in frames]
    )
    assert cause is Cause.READING and float(words[0].split()[-1]) == pytest.approx(1 / exponent, rel=0.1)


def test_lag() -> None:
    """Each frame holds a tenth of the frame before."""

    def lagging(frames: Frames) -> Frames:
        earlier = [np.full_like(frames[0], BLACK), *frames[:-1]]
        return [0.9 * own + 0.1 * before for own, before in zip(frames, earlier, strict=True)]

    cause, words = reported("dots:4", lagging)
    found = float(words[0].split("holds ")[1].split("%")[0])
    assert cause is Cause.READING and found == pytest.approx(10, rel=0.03)


def test_light_of_walls_is_no_other_reading() -> None:
    """Nearly half of all light spread over the sensor."""
    walls = bench(optics=lambda light: light + 0.42228 * gaussian_filter(light, 25), peak=4e3)
    misfit = reconstruct(walls.run("random:2", picture(2), 2), bench().calibrated(2)).misfit
    assert misfit is not None and misfit.flagged and not misfit.readings


def test_another_order_of_dim_light() -> None:
    shots = replace(CAMERA, peak=10.0).run("dots:4", picture(1), 1)
    late = with_frames(shots, lambda frames: [frames[-1], *frames[:-1]])
    misfit = reconstruct(late, CAMERA.calibrated(1)).misfit
    assert misfit is not None and misfit.flagged and "one step late" in misfit.reason


def left_aligned(gain: float) -> Capture:
    """Numbers of 13 bits moved up by 4, in a file whose camera has ``gain`` times the numbers an electron."""
    shots = bench(peak=2e3).run("dots:4", picture(1), 1)
    digital = shots.manifest.digital
    known = digital.model_copy(
        update={
            "saturation_dn": 16.0 * CODES,
            "gain_dn_per_e": digital.gain_dn_per_e * gain,
            "black_level_dn": digital.black_level_dn * gain,
        }
    )
    memory = {
        shot.file: ({"DN": 16 * shots._memory[shot.file][0]["DN"]}, {}) for shot in shots.manifest.patterns.captures
    }
    return Capture(shots.manifest.model_copy(update={"digital": known}), memory=memory)


def test_numbers_that_were_multiplied() -> None:
    """An image 16 times too bright fits, but its noise does not. A camera file of these numbers fits."""
    found = reconstruct(left_aligned(1.0), bench().calibrated(1))
    assert not found.ok and found.misfit is not None and found.misfit.cause is Cause.READING
    assert "multiples of 16" in str(found.status) and "divided by 16" in str(found.status)
    assert reconstruct(left_aligned(16.0), bench().calibrated(1)).ok


def test_a_scene_that_does_not_fit_is_no_other_reading() -> None:
    """Gloss and depth."""
    place = np.linspace(-1, 1, 96)
    glossy = Bench(shadow(), shadow(), lambda light: light * (1 + 0.1 * np.outer(place, place)))
    for camera in (glossy, bench(0.3)):
        misfit = reconstruct(camera.run("dots:4", picture(1), 1), bench().calibrated(1)).misfit
        assert misfit is not None and misfit.flagged and not misfit.readings and not misfit.faults


def test_noise_of_the_factors_is_no_misfit_of_a_reading() -> None:
    """Turned frames against factors of a fiftieth's error. (Planted: the factors' noise left out of what is
    allowed.)"""
    shots = with_frames(CAMERA.run("dots:4", picture(1), 1), lambda frames: [np.flipud(frame) for frame in frames])
    misfit = reconstruct(shots, CAMERA.calibrated(1, 0.02)).misfit
    assert misfit is not None and misfit.cause is Cause.READING

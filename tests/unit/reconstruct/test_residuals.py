"""Parts of the misfit in closed form, where whole sessions would hardly show a wrong term.

Frames that fit only when they are read otherwise: turned, in another order, of another scale or curve.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from mitsim.core.manifests import Digital, FactorNoise, Patterns
from mitsim.core.runs import Measurement
from mitsim.devices.patterns import parse_patterns, shot_orders
from mitsim.reconstruct.accumulation import FrameNoise, Model, factor_energy
from mitsim.reconstruct.misfit import Cause, weigh
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.reconstruct.residuals import Residuals
from mitsim.reconstruct.solver import prepare
from mitsim.reconstruct.uncertainty import Propagation
from tests.ideal_sessions import Bench, bench, picture, shadow
from tests.unit.reconstruct.test_faults import Frames, with_frames


def test_centring_takes_up_noise_as_well() -> None:
    """Of white noise in frames whose row and column means are taken out, and then the model's part. (Planted: what
    centring takes not counted, 11 % too much is expected.)"""
    rng = np.random.default_rng(3)
    prepared = prepare(rng.random((16, 3)), rng.random((20, 2)), np.ones((3, 1)), np.ones((2, 1)), centre=True)
    left = []
    for _ in range(2000):
        frame, sums = rng.standard_normal((16, 20)), prepared.accumulator()
        sums.add(frame, 0, 0)
        problem = prepared.problem(sums)
        left.append(problem.energy - float(np.square(problem.projected[problem.sigma > 0]).sum()))
    error = np.std(left) / np.sqrt(len(left))
    assert prepared.spare * 320 == pytest.approx(np.mean(left), abs=4 * error) and error < 1


def test_noise_of_a_measurement_is_its_shots_and_that_of_the_ambient_frame_where_one_was_taken_off() -> None:
    """The difference of a pair has lost the ambient frame. Rendering is off by its two errors, of all light."""
    digital = Digital(
        exposure_s=0.1, gain_dn_per_e=0.5, black_level_dn=8.0, read_noise_e=3.0, dark_current_e_per_s=20.0
    )
    patterns = Patterns.of(parse_patterns("uniform", 2), ["frame"])
    manifest = SimpleNamespace(
        digital=digital, patterns=patterns, mc_error=3e-3, light_error=None, plan={"systematic_error": 4e-3}
    )
    noise = FrameNoise(manifest, ambient=(np.full(4, 50.0), np.full(5, 50.0)))  # type: ignore[arg-type]
    light = np.array([100.0, 4000.0])
    np.testing.assert_allclose(noise.of(light, 1), digital.variance(light, 1) + 50)
    np.testing.assert_allclose(noise.of(light, 2), digital.variance(light, 2))
    noise.power = 8.0
    assert noise.rendering == noise.discretisation == pytest.approx(2.5e-5 * 8)
    noise.light_error = 0.01  # then sampling is told by it
    assert noise.discretisation == pytest.approx(1.6e-5 * 8)


def oblong() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Factors 5 x 3 and 6 x 2, and two patterns of each side: no size is another's."""
    rng = np.random.default_rng(4)
    return [rng.random((5, 3)), rng.random((6, 2))], [rng.random((3, 2)), rng.random((2, 2))]


def test_an_ambient_frame_s_noise_goes_into_an_oblong_image_from_both_its_sides() -> None:
    """Under uniform light, solved once for each of its 30 numbers: variances of independent numbers add up."""
    sides, _ = oblong()
    patterns = np.ones((3, 1)), np.ones((2, 1))
    prepared, lam = prepare(*sides, *patterns), 0.01
    images = []
    for unit in np.eye(30):
        sums = prepared.accumulator()
        sums.add(unit.reshape(5, 6), 0, 0)
        images.append(prepared.solve(sums, lam).image)
    found = Propagation(Model(prepared, (sides[0], sides[1]), patterns), lam).of_ambient_frame(
        np.full(5, 3.0), np.full(6, 3.0)
    )
    np.testing.assert_allclose(found, 3.0 * np.square(images).sum(axis=0), rtol=1e-9)


def test_noisy_factors_add_the_same_energy_whichever_side_is_called_left() -> None:
    sides, patterns = oblong()
    image = np.random.default_rng(5).random((3, 2))
    one = factor_energy(
        prepare(*sides, *patterns), tuple(patterns), FactorNoise(left=0.1, right=0.3, unexplained=0.0), image
    )
    turned = prepare(*sides[::-1], *patterns[::-1])
    other = factor_energy(turned, tuple(patterns[::-1]), FactorNoise(left=0.3, right=0.1, unexplained=0.0), image.T)
    assert one == pytest.approx(other, rel=1e-12) and one > 0


def oblong_residuals(frames: list[np.ndarray], lights: list[np.ndarray], shots: int = 1) -> Residuals:
    """Residuals of frames of 16 x 24 pixels under patterns that light rows of the scene in turn."""
    rng = np.random.default_rng(6)
    rows = np.eye(3)[:, : len(frames)] if len(frames) > 1 else np.ones((3, 1))
    patterns = rows, np.ones((2, 1))
    prepared = prepare(rng.random((16, 3)), rng.random((24, 2)), *patterns)
    sums = prepared.accumulator()
    measurements = [
        Measurement(f, k, 0, light, shots, 0) for k, (f, light) in enumerate(zip(frames, lights, strict=True))
    ]
    for each in measurements:
        sums.add(each.frame, each.row, each.column)
    noise = SimpleNamespace(
        light=np.sum(lights, axis=0), shots=shots, variance=np.ones((len(frames), 1)), rendering=5.0, stated=True,
        of=lambda light, _: 1.0 + 0 * light,
    )  # fmt: skip
    problem = prepared.problem(sums)
    data = SimpleNamespace(
        prepared=prepared, noise=noise, weights=np.where(problem.sigma > 0, problem.projected, 0.0),
        coefficients={}, measurements_again=lambda: measurements,
    )  # fmt: skip
    return Residuals(data)  # type: ignore[arg-type]


@pytest.mark.parametrize("shots", [1, 2])
def test_power_is_that_of_the_shots(shots: int) -> None:
    """For two halves, whose sum and difference are known: (sum^2 + difference^2) / 2. (Planted: the sum's for both.)"""
    rng = np.random.default_rng(7)
    light, frame = rng.random((16, 24)), rng.random((16, 24))
    sums = oblong_residuals([frame], [light], shots)
    power = (np.square(frame) + np.square(light)).sum() / 2 if shots == 2 else np.square(light).sum()
    assert sums.shots[0, 0] == pytest.approx(power, rel=1e-12)
    assert sums.energy.sum() == pytest.approx(np.square(frame).sum(), rel=1e-12)


def test_the_energy_of_a_frame_that_others_predict() -> None:
    """e^T (I - H_kk)^-1 e is the squared difference from the prediction of the other frames, whitened.

    Two equal patterns: the other frame alone predicts the part of this one in the model's range, with as much noise as
    its own. The closed form is compared with least squares without the frame. (Planted: no division by 1 - h.)"""
    rng = np.random.default_rng(8)
    left, right = rng.random((12, 3)), rng.random((10, 2))
    patterns = np.ones((3, 2)), np.ones((2, 1))
    frames = [rng.standard_normal((12, 10)) for _ in range(2)]
    prepared = prepare(left, right, *patterns)
    sums = prepared.accumulator()
    measurements = [Measurement(frame, k, 0, frame, 1, 0) for k, frame in enumerate(frames)]
    for each in measurements:
        sums.add(each.frame, each.row, 0)
    noise = SimpleNamespace(
        light=sum(frames), shots=1, variance=np.ones((2, 1)), of=lambda light, _: 1.0 + 0 * light, rendering=0.0
    )
    problem = prepared.problem(sums)
    data = SimpleNamespace(
        prepared=prepared,
        noise=noise,
        weights=problem.projected,
        coefficients={},
        measurements_again=lambda: measurements,
    )
    found = Residuals(data).leave_out[0, 0]  # type: ignore[arg-type]
    whole = np.kron(left, right)
    others = whole @ np.linalg.lstsq(whole, frames[1].ravel(), rcond=None)[0]
    away = frames[0].ravel() - others
    projector = whole @ np.linalg.pinv(whole)
    # Its covariance is I + H for unit noise.
    assert found == pytest.approx(away @ np.linalg.solve(np.eye(120) + projector, away), rel=1e-9)


@pytest.mark.parametrize("gain", [0.5, 1.0, 4.0])
def test_measured_noise(gain: float) -> None:
    """Frames with gain times the stated noise; 40 frames of 16 x 24 pixels: the median of 40 ratios with 63 degrees of
    freedom each is known to 3.5 %, and 4 deviations are allowed. (Planted: no part that the model takes up.)"""
    rng = np.random.default_rng(9)
    ratios = []
    for _ in range(40):
        frame = np.sqrt(gain) * rng.standard_normal((16, 24))
        test = oblong_residuals([frame], [np.ones((16, 24))]).noise_test
        assert test is not None
        ratios.append(test.ratio)
    assert np.mean(ratios) == pytest.approx(gain, rel=0.14)


@pytest.mark.parametrize(("above", "flagged"), [(0.9, False), (1.1, True)])
def test_chance_is_that_of_all_data(above: float, flagged: bool) -> None:
    """Six deviations of 64 x 100 data, as much in each tile. (Planted: of a tile's.)"""
    expected = np.full((8, 8), 100.0)
    residual = expected * (1 + above * 6 * np.sqrt(2 / 6400))
    # A tenth and more of 10^5 in all is unexplained, less than 2 % of a tile.
    noise = SimpleNamespace(stated=True, variance=np.ones((1, 1)))
    noise.chance = partial(FrameNoise.chance, noise)  # type: ignore[arg-type]
    energies = residual, expected * 1e3, expected, np.full((8, 8), 100.0)
    found, _ = weigh(energies, True, noise, 0.0)  # type: ignore[arg-type]
    assert found.unexplained > 3.5e-3 and found.worst_tile < 2e-2 and found.flagged == flagged


# ---- Other readings ----


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


def test_a_scene_that_does_not_fit_is_no_other_reading() -> None:
    """Gloss and depth."""
    place = np.linspace(-1, 1, 96)
    glossy = Bench(shadow(), shadow(), lambda light: light * (1 + 0.1 * np.outer(place, place)))
    for camera in (glossy, bench(0.3)):
        misfit = reconstruct(camera.run("dots:4", picture(1), 1), bench().calibrated(1)).misfit
        assert misfit is not None and misfit.flagged and not misfit.readings and not misfit.faults

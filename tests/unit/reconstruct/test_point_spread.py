"""Images by a point spread function, against matrices written out, active sets, and a smoothed Newton method.

A camera's matrix is made here from its definition, pixel by pixel, without a transform; numbers are double precision.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import lsq_linear, nnls

from mitsim.core.errors import MitsimError
from mitsim.reconstruct.point_spread import (
    ShiftedLight,
    find_fit,
    frame_error,
    frame_noise,
    minimise,
    reduce_frame,
    solve_point_spread,
)
from mitsim.reconstruct.solver import Verdict
from mitsim.reconstruct.solvers import Prior
from tests.unit.reconstruct.test_tv import SIZE, smoothed_minimum

INF = np.inf


def spread(rows: int = 5, columns: int = 4) -> np.ndarray:
    light = np.random.default_rng(7).random((rows, columns)) ** 4
    return light / light.sum()


def dots(rows: int, columns: int, period: int) -> tuple[np.ndarray, np.ndarray]:
    rows_lit, columns_lit = (
        (np.arange(size)[:, None] % period == np.arange(period)).astype(float) for size in (rows, columns)
    )
    return rows_lit, columns_lit


def matrix(light: ShiftedLight) -> np.ndarray:
    """(K K' m m', n n') from y[s] = sum_p h[s - p] x[p], the sensor centred in all that light reaches."""
    rows, columns = light.psf.shape
    whole = [n + k - 1 for n, k in zip(light.scene, light.psf.shape, strict=True)]
    top, left = ((most - size) // 2 for most, size in zip(whole, light.sensor, strict=True))
    seen = []
    for row, column in np.ndindex(*light.scene):
        plane = np.zeros(whole)
        plane[row : row + rows, column : column + columns] = light.psf
        seen.append(plane[top : top + light.sensor[0], left : left + light.sensor[1]].ravel())
    one = np.stack(seen, axis=1)
    if light.patterns is None:
        return one
    lit = [np.outer(row, column).ravel() for row in light.patterns[0].T for column in light.patterns[1].T]
    return np.concatenate([one * each for each in lit])


LIGHTS = [
    ShiftedLight(spread(), (6, 7)),
    ShiftedLight(spread(4, 5), (9, 3)),
    ShiftedLight(spread(), (7, 6), dots(8, 7, 2)),
    ShiftedLight(spread(), (12, 10), dots(8, 7, 1)),
]
"""More unknowns than data, twice; cropped frames of dots; all light of a scene, which is dark beyond."""


def noisy(light: ShiftedLight, seed: int = 0) -> np.ndarray:
    """Frames of a scene of numbers of both signs, with noise."""
    rng = np.random.default_rng(seed)
    frames = light.image_of(rng.normal(size=light.scene))
    return frames + 0.02 * rng.normal(size=frames.shape)


@pytest.mark.parametrize("light", LIGHTS)
def test_frames_are_the_definition_s_and_their_adjoint_is_the_transpose(light: ShiftedLight) -> None:
    """Where light wraps round on the small grid, it lands beside the sensor. (Planted: a grid one column smaller.)"""
    rng, whole = np.random.default_rng(0), matrix(light)
    scene = rng.normal(size=light.scene)
    frames = light.image_of(scene)
    np.testing.assert_allclose(frames.ravel(), whole @ scene.ravel(), atol=1e-13)
    data = rng.normal(size=frames.shape)
    np.testing.assert_allclose(light.correlate(data).ravel(), whole.T @ data.ravel(), atol=1e-13)
    assert np.square(whole).sum(axis=0).mean() <= light.column_power * (1 + 1e-12)


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("bounds", [(-INF, INF), (0.0, INF), (0.0, 0.5), (-INF, 0.3)])
def test_the_image_is_that_of_active_sets(light: ShiftedLight, bounds: tuple[float, float]) -> None:
    """Objectives are no less than that of scipy's active sets after one step, and equal after many. (Planted: bounds
    heeded by the image only after the last step.)"""
    lam, frames, whole = 1e-2, noisy(light), matrix(light)
    system = np.concatenate([whole, np.sqrt(lam) * np.eye(whole.shape[1])])
    target = np.concatenate([frames.ravel(), np.zeros(whole.shape[1])])
    exact = nnls(system, target)[0] if bounds == (0, INF) else lsq_linear(system, target, bounds, "bvls", 1e-14).x
    least = 0.5 * np.square(system @ exact - target).sum()
    for iterations in (1, 4, 2000):
        found = minimise(light, frames, Prior(ridge=lam, bounds=bounds), iterations, 1e-11)
        assert bounds[0] <= found.image.min() and found.image.max() <= bounds[1] and found.iterations <= iterations
        assert found.objective == pytest.approx(0.5 * np.square(system @ found.image.ravel() - target).sum(), rel=1e-9)
        assert least * (1 - 1e-9) <= found.objective
    assert found.fall <= 1e-11 and found.objective <= least * (1 + 1e-9)
    np.testing.assert_allclose(found.image.ravel(), exact, atol=np.sqrt(2e-9 * least / lam) + 1e-9)


SQUARE = [ShiftedLight(spread(), (8, 9)), ShiftedLight(spread(), (10, 9), dots(SIZE, SIZE, 2))]
"""The same of scenes that the other solver takes."""


@pytest.mark.parametrize("light", SQUARE)
@pytest.mark.parametrize("weight", [1e-3, 0.05])
def test_total_variation_comes_to_its_minimum(light: ShiftedLight, weight: float) -> None:
    """(Planted: slopes ten times as blunt.)"""
    frames = noisy(light)
    lower, upper = smoothed_minimum(matrix(light), frames.ravel(), weight)
    for iterations in (1, 10, 3000):
        found = minimise(light, frames, Prior(weight=weight), iterations, 1e-5)
        assert lower * (1 - 1e-9) <= found.objective
    assert found.fall <= 1e-5 and found.objective <= upper * 1.002
    held = minimise(light, frames, Prior(weight=weight, bounds=(0.0, 1.0)), 3000, 1e-5)
    assert held.image.min() >= 0 and held.image.max() <= 1 and held.objective >= lower * (1 - 1e-9)


def test_half_the_size_sees_half_the_frame() -> None:
    """Of a scene without fine detail; a pixel beside, the two differ by a tenth. (Planted: a start one pixel off.)"""
    for side in (70, 71):
        rows, columns = np.mgrid[:side, :side] / side - 0.5
        light = ShiftedLight(np.exp(-60 * (rows - 0.1) ** 2 - 90 * columns**2) / 100, (80, 82))
        half = light.half_size()
        assert half is not None and half.sensor == (40, 41) and half.half_size() is None
        rows, columns = np.mgrid[: half.scene[0], : half.scene[1]]
        scene = 1 + np.sin(rows / 6) * np.cos(columns / 7)
        seen, expected = reduce_frame(light.image_of(light.double(scene))[0], 2), half.image_of(scene)[0]
        inside = np.s_[5:-5, 5:-5]
        assert np.abs(seen - expected)[inside].max() < 4e-3 * np.ptp(expected)
    assert LIGHTS[2].half_size() is None
    np.testing.assert_array_equal(reduce_frame(np.arange(12.0).reshape(3, 4), 2), [[2.5, 4.5]])


@pytest.mark.parametrize(
    ("noise", "method", "times", "above"),
    [(0.05, "nonnegative", 1, 0.01), (0.05, "tv", 10, 0.04), (0.01, "tv", 1, 0.07)],
)
def test_converged_is_said_near_the_minimum_alone(noise: float, method: str, times: float, above: float) -> None:
    """Of blocks, whose light is halved once: where the rule holds the objective is that near to what 1500 steps find,
    and a pass sooner it does not. (Planted: only the last pass's fall;
    no heed of what was promised; slopes that no pass sharpens; a rule from the first pass on.)"""
    rng = np.random.default_rng(4)
    psf = np.zeros((70, 72))
    psf[rng.integers(8, 62, 40), rng.integers(8, 62, 40)] = 1 / 40
    light = ShiftedLight(psf, (70, 72), precision=np.float32)
    scene = 200.0 * np.kron(rng.random((14, 13)) > 0.6, np.ones((10, 11)))[:139, :143]
    frame = light.image_of(scene)
    frame = (frame + noise * frame.mean() * rng.normal(size=frame.shape)).astype(np.float32)
    lam = times * solve_point_spread(light, frame, method, iterations=1).lam
    found = solve_point_spread(light, frame, method, lam, tolerance=0.025)
    assert found.objective is not None and found.ok and str(found.status).startswith("Converged")
    prior = Prior(weight=lam, bounds=(0, INF)) if method == "tv" else Prior(ridge=lam, bounds=(0, INF))
    least = minimise(light, frame, prior, 1500, 1e-6).objective
    assert least <= found.objective * (1 + 1e-4) and found.objective <= least * (1 + above)
    assert not solve_point_spread(light, frame, method, lam, None, found.iterations - 6, 0.025).ok


def test_noise_is_told_and_weights_follow_it() -> None:
    """Of a frame of thin bright lines the noise is found to a tenth; twice the noise has twice the weight, in any unit
    of the frames."""
    rng = np.random.default_rng(3)
    frame = 50 * (rng.random((60, 80)) > 0.997) + np.linspace(0, 9, 80) ** 2
    frame = frame + 0.3 * rng.normal(size=frame.shape)
    assert frame_noise(frame) == pytest.approx(0.3, rel=0.25) and frame_noise(frame[:2]) == 0
    light = ShiftedLight(spread(), frame.shape)

    def automatic(frame: np.ndarray) -> list[float]:
        return [solve_point_spread(light, frame[None], name, iterations=1).lam for name in ("tikhonov", "tv")]

    lam, weight = automatic(frame)
    assert lam > 0 and automatic(7 * frame) == pytest.approx([lam, 7 * weight])


def point_and_frame(noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Light of twenty lenses, and the frame (1, 48, 56) of blocks by it, of mean 1."""
    rng = np.random.default_rng(0)
    light = np.zeros((48, 56))
    light[rng.integers(8, 40, 20), rng.integers(8, 48, 20)] = 0.3 + rng.random(20)
    light = gaussian_filter(light, 0.7)
    scene = np.kron(rng.random((12, 14)), np.ones((8, 8)))[:95, :111] ** 3
    frame = ShiftedLight(light / light.sum(), (48, 56)).image_of(scene)
    frame /= frame.mean()
    return light / light.sum(), frame + noise * rng.normal(size=frame.shape)


def test_light_that_is_turned_or_random_is_flagged() -> None:
    """Right light is not flagged at a noise of 0.5 and of 5 %. With 5 % frames may not decide how the light lies.
    (Planted: no total variation.)"""
    for noise in (0.005, 0.05):
        light, frames = point_and_frame(noise)
        wrong = {
            "turned by 180 degrees": light[::-1, ::-1],
            "mirrored upside down": light[::-1],
            "mirrored left to right": light[:, ::-1],
            "random numbers": np.random.default_rng(0).random(light.shape),
        }
        right = find_fit(ShiftedLight(light, (48, 56), precision=np.float32), frames.astype(np.float32), None)
        assert right.fault == ("", "") and right.gain is not None and right.gain > 1
        if noise < 0.01:
            for name, other in wrong.items():
                camera = ShiftedLight(np.ascontiguousarray(other / other.sum()), (48, 56), precision=np.float32)
                found = find_fit(camera, frames.astype(np.float32), None)
                assert found.fault[0].startswith("Misfit: ") and found.summary()["flagged"], name
                assert found.unexplained > right.unexplained, name
                assert name == "random numbers" or (found.gain is not None and found.gain < 1)


def test_displaced_light_is_flagged_and_light_without_a_side_is_not_compared() -> None:
    light, frames = point_and_frame(0.01)
    moved = find_fit(ShiftedLight(np.roll(light, 8, axis=0), (48, 56)), frames, None)
    assert "displaced" in moved.fault[0] and moved.off[0] > 6
    row, column = np.indices((21, 21)) - 10
    even = np.exp(-(row**2 + column**2) / 8.0)
    blurred = ShiftedLight(even / even.sum(), (48, 56))
    found = find_fit(blurred, blurred.image_of(np.random.default_rng(2).random(blurred.scene)), None)
    assert found.gain is None and found.fault == ("", "")


def test_the_error_of_frames_is_their_noise_or_that_of_the_model() -> None:
    """A frame of noise alone, and one with a tone curve, which no image by the light explains. (Planted: pixels held
    out one by one.)"""
    rng = np.random.default_rng(1)
    row, column = np.indices((48, 56))
    light = gaussian_filter(rng.random((48, 56)) ** 8, 2.0)
    light *= np.exp(-((row - 23.5) ** 2 + (column - 27.5) ** 2) / 162)
    scene = np.maximum(gaussian_filter(rng.normal(size=(95, 111)), 2) * 6 + 1, 0)
    camera = ShiftedLight(light / light.sum(), (48, 56), precision=np.float32)
    frame = camera.image_of(scene)[0]
    frame /= frame.mean()
    noisy, bent = (
        (frame + noise * rng.normal(size=frame.shape)).astype(np.float32) ** gamma
        for noise, gamma in ((0.005, 1.0), (0.001, 0.8))
    )
    assert frame_error(camera, noisy[None]) == pytest.approx(frame_noise(noisy), rel=1e-4)
    assert frame_error(camera, bent[None]) > 3 * frame_noise(bent)


def test_what_cannot_be_solved_is_refused_and_too_few_steps_are_said() -> None:
    light = LIGHTS[0]
    frames = noisy(light)
    short = solve_point_spread(light, frames, "nonnegative", 1e-6, iterations=1, tolerance=1e-9)
    assert short.status.verdict is Verdict.NOT_CONVERGED and not short.ok and short.iterations == 1
    assert short.image.shape == light.sensor
    for wrong in (frames[0], frames[:, 1:], frames * np.nan):
        with pytest.raises(MitsimError, match="give 1 of 6 x 7 finite numbers"):
            solve_point_spread(light, wrong, "tikhonov", 1.0)
    with pytest.raises(MitsimError, match="give at least 1"):
        solve_point_spread(light, frames, "tv", 1.0, iterations=0)
    for lam in (-1.0, INF, "none"):
        with pytest.raises(MitsimError, match="finite number of at least 0"):
            solve_point_spread(light, frames, "tv", lam)  # type: ignore[arg-type]
    with pytest.raises(MitsimError, match="under uniform light alone"):
        solve_point_spread(LIGHTS[2], noisy(LIGHTS[2]), "tikhonov")
    with pytest.raises(MitsimError, match="cannot be chosen; check exposure"):
        frame_error(light, 0 * frames)
    with pytest.raises(MitsimError, match="give a point spread function of the frames' pixels"):
        ShiftedLight(spread(), (20, 7), dots(8, 7, 2))
    with pytest.raises(MitsimError, match="not all 0"):
        ShiftedLight(np.zeros((3, 3)), (6, 7))
    dark = solve_point_spread(light, 0 * frames, "nonnegative", 1.0)
    assert dark.ok and not dark.image.any() and dark.residual == 0

"""Check each term of the predicted error against the image of the solver itself, which is linear at a fixed lambda.

Variances are exact: unit noise of every datum, or of every number of a factor, is solved. The light of these frames is
a product of rows and columns, as the closed form assumes. A prior, and all causes together, are compared with the mean
of drawn scenes and noise at five standard errors.
"""

from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.fft import idctn

from mitsim.api.bench import open_bench
from mitsim.bench.request import PredictRequest
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.design import predictor
from mitsim.design.predictor import Camera, Noise, Predictor, Scene
from mitsim.metrics import psnr
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.reconstruct.solver import prepare

M, N, C, LAM = 14, 6, 2, 40.0
RNG = np.random.default_rng(5)
FACTORS = RNG.random((M, C * N)), RNG.random((M, C * N))
LACKING = 0.1 * RNG.normal(size=(M, C * N)), 0.1 * RNG.normal(size=(M, C * N))
DOTS = np.array([[1.0, 0.0], [0.0, 1.0]] * (N // 2))
SIGNS = np.array([[1.0, 1.0], [1.0, -1.0]] * (N // 2))
EVEN: FloatArray = np.full((C * N, C * N), 0.6)
PRINT: FloatArray = RNG.random((C * N, C * N))


def pixels(cells: FloatArray, axis: int = -1) -> FloatArray:
    return np.asarray(cells.reshape(*cells.shape[:-1], -1, C).mean(axis=-1))


def by_pixel(scene: FloatArray) -> FloatArray:
    return pixels(pixels(scene).T).T


def camera(lacking: bool = False, leak: float = 0.0) -> Camera:
    terms = [FACTORS, LACKING] if lacking else [FACTORS]
    return Camera((pixels(FACTORS[0]), pixels(FACTORS[1])), FACTORS, terms, leak=leak)


def frames_of(camera: Camera, scene: FloatArray, patterns: FloatArray) -> FloatArray:
    """Return the frames (K, K, m, m) of a scene in cells, less nothing."""
    lit = np.repeat(patterns, C, axis=0)
    each = [
        sum(a @ (scene * (np.outer(lit[:, i], lit[:, j]) + camera.leak)) @ b.T for a, b in camera.terms) / C**2
        for i, j in product(range(lit.shape[1]), repeat=2)
    ]
    return np.asarray(each).reshape(lit.shape[1], lit.shape[1], M, M)


@cache
def operator(signed: bool) -> FloatArray:
    """Return the image of each datum by dense algebra, without the solver's factorisation."""
    (left, right), patterns = camera().factors, SIGNS if signed else DOTS
    shown = product(range(patterns.shape[1]), repeat=2)
    model = np.concatenate([np.kron(left * patterns[:, i], right * patterns[:, j]) for i, j in shown])
    return np.asarray(np.linalg.solve(model.T @ model + LAM * np.eye(N * N), model.T))


def solved(frames: FloatArray, patterns: FloatArray = DOTS) -> FloatArray:
    """Return the images (..., n, n) of frames (..., K, K, m, m)."""
    data = frames.reshape(*frames.shape[:-4], -1)
    return np.asarray((data @ operator(patterns is SIGNS).T).reshape(*frames.shape[:-4], N, N))


def causes(scene: Scene, noise: Noise, patterns: FloatArray = DOTS) -> dict[str, float]:
    model = Predictor(camera(), (patterns, patterns), scene, noise)
    return dict(model.errors(LAM).causes)


def white(variances: FloatArray, patterns: FloatArray) -> float:
    """Return the mean squared error by independent noise of ``variances`` (K, K, m, m) of all data."""
    units = np.eye(variances.size).reshape(-1, *variances.shape)
    return float(variances.ravel() @ np.square(solved(units, patterns)).mean(axis=(1, 2)))


@pytest.mark.parametrize("patterns", [DOTS, SIGNS])
def test_noise_of_frames_is_propagated(patterns: FloatArray) -> None:
    """Both shots of a signed pattern have noise, and together the light of uniform frames."""
    noise = Noise(seconds=0.3, dark=0.7, read=0.2, uneven=0.01)
    found, shots = causes(Scene(EVEN), noise, patterns), 2 if (patterns < 0).any() else 1
    light = frames_of(camera(), EVEN, np.ones_like(patterns) if shots == 2 else patterns)
    assert found[predictor.SHOT] == pytest.approx(white(light / 0.3, patterns), rel=1e-9)
    flat = np.ones_like(light)
    assert found[predictor.DARK] == pytest.approx(white(shots * 0.7 / 0.3 * flat, patterns), rel=1e-9)
    assert found[predictor.READ] == pytest.approx(white(shots * 0.2 / 0.3**2 * flat, patterns), rel=1e-9)
    assert found[predictor.UNEVEN] == pytest.approx(white(0.01 * np.square(light).mean() * flat, patterns), rel=1e-9)


def test_ambient_light_adds_shot_noise_and_that_of_its_frame() -> None:
    """The subtracted frame is in all frames alike, so that its noise adds up in amplitude."""
    ambient = np.outer(1 + RNG.random(M), 1 + RNG.random(M))
    found = causes(Scene(EVEN), Noise(seconds=0.3, dark=0.7, ambient=ambient, ambient_shots=3))
    alike = np.broadcast_to(np.eye(M * M).reshape(-1, 1, 1, M, M), (M * M, 2, 2, M, M))
    # The closed form takes the frame's variance for a product, which ambient light with dark current is not quite.
    mean = (ambient + 0.7) / 0.3 / 3
    split = np.outer(mean.mean(axis=1), mean.mean(axis=0)) / mean.mean()
    of_frame = float(split.ravel() @ np.square(solved(alike, DOTS)).mean(axis=(1, 2)))
    shot = white(np.broadcast_to(ambient / 0.3, (2, 2, M, M)), DOTS)
    assert found[predictor.AMBIENT] == pytest.approx(shot + of_frame, rel=1e-9)


def test_noise_of_factors_is_propagated_through_either_side() -> None:
    """Its mean squared error, and the scatter of that between sessions: by its own square, if the noise is large, and
    by its product with other noise, if it is small. (Planted: either term of the scatter halved; one
    factor's alone; noise or lambda of the first factors kept.)
    """
    scene, (left, right) = by_pixel(PRINT), camera().factors
    moved = []
    for row, pixel in product(range(M), range(N)):
        error = np.zeros((M, N))
        error[row, pixel] = 1.0
        for deviation, first, second in ((0.2, error, right), (0.5, left, error)):
            lit = [np.outer(DOTS[:, i], DOTS[:, j]) * scene for i, j in product(range(2), repeat=2)]
            moved.append(deviation * np.asarray([first @ each @ second.T for each in lit]).reshape(2, 2, M, M))
    images = solved(np.asarray(moved)).reshape(len(moved), -1)
    found = causes(Scene(PRINT), Noise(1.0, factors=(0.2, 0.5)))
    assert found[predictor.SESSION] == pytest.approx(np.square(images).sum() / N**2, rel=1e-9)
    model = Predictor(camera(), (DOTS, DOTS), Scene(PRINT), Noise(1.0, factors=(0.2, 0.5)))
    left_basis, right_basis = model.prepared.left.basis, model.prepared.right.basis
    moved_by = (left_basis.T @ images.reshape(-1, N, N) @ right_basis).reshape(len(images), -1)
    session, errors = moved_by.T @ moved_by, model._by_coefficient(LAM)
    others = np.sum([each for name, each in errors.items() if name != predictor.SESSION], axis=0)
    terms = 2 * np.square(session).sum(), 4 * np.vdot(session.diagonal(), others.ravel())
    assert min(terms) > 0.05 * sum(terms)
    assert model.session_scatter(LAM) == pytest.approx(sum(terms) ** 0.5 / N**2 / model.errors(LAM).total, rel=1e-9)
    _ = model.errors()  # and other factors take nothing of it
    anew = Predictor(camera(), (DOTS, DOTS), Scene(PRINT), Noise(1.0, factors=(0.3, 0.1))).errors()
    other = model.calibrated((0.3, 0.1)).errors()
    assert other.causes == anew.causes and other.lam == anew.lam


def test_errors_without_noise_are_those_of_the_solved_image() -> None:
    """Regularisation, detail in pixels, terms that the factors lack, black pixels, and light from elsewhere."""
    own, truth = camera(lacking=True, leak=0.02), by_pixel(PRINT)
    even: FloatArray = np.asarray(np.kron(truth, np.ones((C, C))))
    full = frames_of(camera(lacking=True), PRINT, DOTS)
    leaking, seen = frames_of(own, PRINT, DOTS) - full, 1.1 * full
    model = Predictor(own, (DOTS, DOTS), Scene(PRINT), Noise(seconds=1e15))
    model.seen = model.prepared.accumulator((seen[i, j], i, j) for i, j in product(range(2), repeat=2)).sum
    whole = solved(seen + leaking, DOTS) - truth
    assert model.errors(LAM).total == pytest.approx(float(np.square(whole).mean()), rel=1e-9)
    parts = {
        predictor.REGULARISATION: solved(frames_of(camera(), even, DOTS), DOTS) - truth,
        predictor.DETAIL: solved(frames_of(camera(), PRINT - even, DOTS), DOTS),
        predictor.DIFFRACTION: solved(full - frames_of(camera(), PRINT, DOTS), DOTS),
        predictor.ELSEWHERE: solved(seen - full, DOTS),
        predictor.BLACK: solved(leaking, DOTS),
    }
    found = model.errors(LAM).causes
    for name, part in parts.items():
        assert found[name] == pytest.approx(float((part * whole).mean()), rel=1e-9), name


def test_a_prior_and_all_noise_are_as_drawn() -> None:
    """2000 drawn scenes with noise of all kinds; a wrong power of the detail, or a missing term, shows."""
    rng, noise = np.random.default_rng(1), Noise(0.4, dark=0.3, read=0.1, factors=(0.01, 0.02))
    scene, own = Scene.prior(C * N, 0.5, 0.04, 3.0), camera(lacking=True, leak=0.01)
    light = np.maximum(frames_of(own, scene.mean, DOTS), 0.0)
    deviation = np.sqrt((light + 0.3) / 0.4 + 0.1 / 0.4**2)
    assert scene.power is not None
    squares = []
    for _ in range(2000):
        drawn = scene.mean + idctn(np.sqrt(scene.power) * rng.normal(size=scene.mean.shape), norm="ortho")
        truth, (left, right) = by_pixel(drawn), own.factors
        frames = frames_of(own, drawn, DOTS) + deviation * rng.normal(size=light.shape)
        off_left, off_right = 0.01 * rng.normal(size=left.shape), 0.02 * rng.normal(size=right.shape)
        for i, j in product(range(2), repeat=2):
            lit = np.outer(DOTS[:, i], DOTS[:, j]) * truth
            frames[i, j] -= off_left @ lit @ right.T + left @ lit @ off_right.T
        squares.append(float(np.square(solved(frames, DOTS) - truth).mean()))
    expected, error = float(np.mean(squares)), float(np.std(squares)) / len(squares) ** 0.5
    found = Predictor(own, (DOTS, DOTS), scene, noise).errors(LAM).total
    assert abs(found - expected) < 5 * error < 0.1 * expected


def test_automatic_lambda_has_the_least_weighted_error_and_undetected_parts_count() -> None:
    """With one uniform pattern fewer sensor rows than scene rows leave a part of the scene that no data show."""
    even: FloatArray = np.asarray(np.kron(by_pixel(PRINT), np.ones((C, C))))  # without detail, whose sign is not known
    model = Predictor(camera(), (DOTS, DOTS), Scene(even), Noise(0.01))
    best, sigma = model.automatic, model.prepared.sigma
    risks = [
        sum(np.vdot(sigma**0.5, each) for each in model._by_coefficient(lam).values())
        for lam in (best / 1.2, best, 1.2 * best)
    ]
    assert best > 0 and risks[1] < min(risks[0], risks[2])
    few = tuple(side[:3] for side in FACTORS)
    short = Camera((pixels(few[0]), pixels(few[1])), (few[0], few[1]), [(few[0], few[1])])
    uniform = np.ones((N, 1))
    basis = prepare(*short.factors, uniform, uniform)
    kept = basis.left.basis @ basis.left.basis.T @ by_pixel(PRINT) @ basis.right.basis @ basis.right.basis.T
    found = Predictor(short, (uniform, uniform), Scene(even), Noise(1e15)).errors(0.0)
    assert found.total == pytest.approx(float(np.square(kept - by_pixel(PRINT)).mean()), rel=1e-6)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"prior": "0.4,0.1"}, "MEAN,VARIANCE,LENGTH"),
        ({"prior": "0.4,-0.1,3"}, "MEAN,VARIANCE,LENGTH"),
        ({"prior": "0.4,0.1,3", "pictures": "."}, "pictures"),
        ({"exposure_total": 1.0, "exposure": 0.1}, "exposure"),
        ({"lam": -1.0}, "lam"),
    ],
)
def test_requests_without_a_meaning_are_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(MitsimError, match=words):
        PredictRequest(**wrong)


def test_a_rendered_image_is_as_predicted(small_scene: Callable[..., Path], variant: str) -> None:
    """Light, exposure, noise of frames and of the session, and the solver's own lambda, for a print of fine detail."""
    scene = small_scene(reflectance=np.kron(np.random.default_rng(2).integers(60, 250, (48, 48)), np.ones((4, 4))))
    bench = open_bench(scene, variant)
    found = bench.predict("dots:2", exposure_fraction=0.05)
    shots = bench.capture("dots:2", exposure_fraction=0.05, accuracy=3e-3)
    image = reconstruct(shots, bench.calibrate(accuracy=3e-3))
    assert shots.manifest.digital.exposure_s == pytest.approx(found.exposure_s, rel=0.01)
    assert shots.truth is not None and found.psnr_db == pytest.approx(psnr(image.image, shots.truth), abs=0.5)
    assert image.uncertainties is not None
    square = {name: value**2 for name, value in image.uncertainties.budget.items()}
    own = bench.predict("dots:2", exposure_fraction=0.05, lam=image.lam).errors.causes
    assert own[predictor.SESSION] == pytest.approx(square["calibration_noise"], rel=0.3)
    assert own[predictor.SHOT] + own[predictor.DARK] + own[predictor.READ] == pytest.approx(
        square["frame_noise"], rel=0.1
    )
    # The traced light of a flat print is that of its cells: a grid that is off by a cell would show here.
    assert not found.warnings and abs(own[predictor.ELSEWHERE]) < 0.05 * own[predictor.DETAIL]

"""A calibration's responses and factors in light that is given: no scene is loaded and nothing traced.

The camera is a toy of random factors, whose frames under any light are known in closed form.

Frames of stripes: mixed from frames of lines, or formed in lots, they are the same; no scene is loaded.

What a calibration session is predicted to take, from sizes: worked out by hand; no scene is loaded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from mitsim.acquire.exposure import Exposer
from mitsim.calibrate import board_session as session
from mitsim.calibrate.board_session import LitSession, Session
from mitsim.calibrate.calibrate import NOISE_FREE, NOISY, Checkpoint, estimate, estimates
from mitsim.core.arrays import FloatArray
from mitsim.core.job import Job
from mitsim.devices.camera import Devices
from mitsim.devices.patterns import Lighting, hadamard_matrix
from mitsim.devices.sensor import SensorModel
from mitsim.devices.session import SIDES, load_recipe
from mitsim.light import cost_model
from mitsim.light.settings import Settings
from mitsim.optics import frames
from mitsim.optics.frames import Frame
from mitsim.sensor.chain import Digital

SENSOR = SensorModel(
    name="bare",
    pixel_pitch_um=10.0,
    full_well_e=float("inf"),
    read_noise_e=20.0,
    dark_current_e_per_s=5000.0,
    quantum_efficiency=0.5,
    gain_dn_per_e=1.0,
    source="chosen",
)
PIXELS = 24
EXPOSURE_S = 0.02
DEVICES = Devices(
    camera=SimpleNamespace(mask="separable"),
    sensor=SENSOR,
    projector=SimpleNamespace(effective_wavelength_nm=550.0),
    camera_file="none",
)
CLIPPED = replace(DEVICES, sensor=SENSOR.model_copy(update={"full_well_e": 1.3e3, "bits": 12}))
"""A camera whose full well the toy's uniform light fills by 0.3, dark electrons too."""


class ToyLight:
    """Light of a camera Y = L X R^T, in electrons a second; ``left`` and ``right`` have different shapes and norms."""

    def __init__(self, n: int, leak: float = 0.0) -> None:
        rng = np.random.default_rng(n)
        self.left, self.right = 30 * rng.random((PIXELS, n)), 20 * rng.random((PIXELS + 3, n))
        self.simulation = SimpleNamespace(physics=SimpleNamespace(black_level=leak))
        self.unit = float(Exposer(DEVICES, 1.0, 0).electrons(Frame(np.ones(1), 0.0, 0.0, 0.0))[0])

    def frames(self, lighting: Lighting, _: int, leaking: bool = True) -> list[Frame]:
        n, leak = self.left.shape[1], self.simulation.physics.black_level if leaking else 0.0
        emitted = leak + (1 - leak) * lighting.weights
        pictures = [weights[lighting.labels].reshape(n, n) for weights in emitted]
        return [Frame(self.left @ picture @ self.right.T / self.unit, 0.0, 0.0, 0.0) for picture in pictures]


def lit_session(
    n: int = 7, mode: str = "pair", mask: str = "separable", devices: Devices = DEVICES, **recipe_fields: object
) -> LitSession:
    recipe = load_recipe().model_copy(update={"signed_capture": mode, **recipe_fields})
    bench = SimpleNamespace(
        n=n,
        devices=devices,
        sensor=devices.sensor,
        geometry=SimpleNamespace(centred=mask == "flatcam", frame_shape=(PIXELS, PIXELS + 3)),
    )
    light = ToyLight(n)
    white = light.frames(Lighting.uniform(n), 0)[0]
    return LitSession(Session(bench, recipe, seed=4), light, white, EXPOSURE_S, 0.0)  # type: ignore[arg-type]


def relative_error(ours: FloatArray, truth: FloatArray) -> float:
    """After the best common scale: the two factors share one unknown number."""
    scale = np.vdot(ours, truth) / np.vdot(truth, truth)
    return float(np.linalg.norm(ours / scale - truth) / np.linalg.norm(truth))


# ---- factors ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["pair", "uniform"])
@pytest.mark.parametrize("n", [1, 4, 7])
def test_expected_frames_give_the_camera_itself(n: int, mode: str) -> None:
    """To rounding: 7 is no Hadamard order, so 8 patterns of 7 rows each are shown. Both factors have one norm."""
    lit = lit_session(n, mode)
    found, saturated = estimate(lit, Job(), noise_free=True)
    assert saturated == 0 and found.separability_residual < 1e-12
    assert relative_error(found.left, lit.light.left) < 1e-12 and relative_error(found.right, lit.light.right) < 1e-12
    left, right = found.left.sum(axis=1), found.right.sum(axis=1)
    assert np.linalg.norm(left) == pytest.approx(np.linalg.norm(right), rel=1e-12)
    uniform = lit.light.left.sum(axis=1)[:, None] * lit.light.right.sum(axis=1)
    np.testing.assert_allclose(np.outer(left, right), uniform, rtol=1e-10)


@pytest.mark.parametrize("mode", ["pair", "uniform"])
def test_noisy_frames_give_the_camera_within_the_error_that_is_predicted(mode: str) -> None:
    """The stated noise of a response is the one that its frames have, and the factors err as it predicts.

    8 responses of 648 numbers tell their noise to 1/sqrt(2 x 5184) = 1 %; 168 and 189 numbers of the factors their
    error to 5 %. Five deviations each. Noise is light plus dark current (half of it) plus read noise.
    """
    lit = lit_session(7, mode)
    off = np.array(
        list(lit.each("vertical", lambda it: lit.noisy("vertical", *it).rate - lit.noise_free(it[1]), Job()))
    )
    assert off.std() == pytest.approx(lit.response_noise, rel=0.05)
    found, _ = estimate(lit, Job())
    assert found.noise == pytest.approx(lit.response_noise, rel=0.05)
    for ours, truth, predicted in zip(
        (found.left, found.right), (lit.light.left, lit.light.right), found.predicted_error, strict=True
    ):
        assert relative_error(ours, truth) == pytest.approx(predicted, rel=0.3)
    assert found.unexplained < 0.3 * found.separability_residual, "the stated noise is all there is"


def test_a_flatcam_s_responses_are_centred() -> None:
    found, _ = estimate(lit_session(4, mask="flatcam"), Job(), noise_free=True)
    for factor in (found.left, found.right):
        assert np.abs(factor.sum(axis=0)).max() < 1e-10 * np.abs(factor).sum()


def test_progress_of_each_side_rises_to_the_whole() -> None:
    reported: list[tuple[str, float]] = []
    estimate(lit_session(29), Job(progress=lambda stage, part: reported.append((stage, part))))
    for side in SIDES:  # 16 patterns at once, of 32 less the first, which is the uniform one
        assert [part for stage, part in reported if stage == f"{side} stripes"] == [1 / 32, 17 / 32, 1.0]


# ---- shots -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def shots(monkeypatch: pytest.MonkeyPatch) -> dict[tuple[str, int], FloatArray]:
    """Expected electrons of every shot that is exposed, by side and number."""
    found: dict[tuple[str, int], FloatArray] = {}
    digital = Exposer.digital

    def counted(self: Exposer, electrons: FloatArray, *names: str | int) -> Digital:
        assert names[0] == "calibration" and names[1:] not in found, "exposed before"
        found[names[1:]] = electrons.copy()  # type: ignore[index]
        return digital(self, electrons, *names)

    monkeypatch.setattr(Exposer, "digital", counted)
    return found


@pytest.mark.parametrize(("mode", "count"), [("pair", 16), ("uniform", 9)])
def test_every_signed_pattern_is_shown_by_shots_of_light_that_is_there(
    shots: dict[tuple[str, int], FloatArray], mode: str, count: int
) -> None:
    """The +1 pixels of a pattern, then its -1 pixels; or the uniform one, then the +1 pixels of each; 7 pixels by the
    first 7 rows of 8 x 8. (Planted: -1 pixels twice.)"""
    lit = lit_session(7, mode)
    session, toy = lit.session, lit.light
    estimate(lit, Job())
    assert session.shots == 2 * count == len(shots) and session.signs.shape == (7, 8)
    for side, (across, along) in zip(SIDES, ((toy.left, toy.right), (toy.right, toy.left)), strict=True):
        for number, sign in enumerate(session.signs.T):
            lit_pixels = {2 * number: (1 + sign) / 2, 2 * number + 1: (1 - sign) / 2}
            if mode == "uniform":
                lit_pixels = {0: np.ones(7), number + 1: (1 + sign) / 2}
            for index, pixels in lit_pixels.items():
                expected = EXPOSURE_S * np.outer(across @ pixels, along.sum(axis=1))
                seen = shots[side, index] if side == SIDES[0] else shots[side, index].T
                np.testing.assert_allclose(seen, expected, rtol=1e-12, atol=1e-12 * expected.max() + 1e-9)


@pytest.mark.parametrize("mode", ["pair", "uniform"])
def test_no_two_shots_of_a_session_share_noise(monkeypatch: pytest.MonkeyPatch, mode: str) -> None:
    """Not of the two sides, not the two shots of a pair: shot noise of the same light, frame by frame.
    (Planted: the -1 frame named as the +1 frame.)"""
    noise: list[FloatArray] = []
    digital = Exposer.digital

    def kept(self: Exposer, electrons: FloatArray, *names: str | int) -> Digital:
        frame = digital(self, electrons, *names)
        noise.append((frame - electrons).ravel())
        return frame

    monkeypatch.setattr(Exposer, "digital", kept)
    lit = lit_session(4, mode)
    estimate(lit, Job())
    assert len(noise) == lit.session.shots
    # Of 648 numbers each: correlations of independent noise are below 5 / sqrt(648) = 0.2.
    correlations = np.corrcoef(np.array(noise)) - np.eye(len(noise))
    assert np.abs(correlations).max() < 0.2


# ---- resumed ---------------------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def every_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    """Checkpoints are kept however little time has passed."""
    monkeypatch.setattr("mitsim.calibrate.calibrate._SAVED_AFTER_S", 0.0)


class Kept(Checkpoint):
    """A checkpoint in memory that ends the session after so many parts."""

    def __init__(self) -> None:
        super().__init__()
        self.part: dict[str, npt.NDArray[np.float64]] | None = None
        self.left = 0

    def save(self, arrays: Mapping[str, npt.ArrayLike]) -> None:
        self.part = {key: np.array(value) for key, value in arrays.items()}
        self.left -= 1
        if self.left == 0:
            raise KeyboardInterrupt

    def load(self) -> dict[str, npt.NDArray[np.float64]] | None:
        return self.part


@pytest.mark.parametrize("kinds", [(NOISY,), (NOISE_FREE,), (NOISY, NOISE_FREE)])
@pytest.mark.parametrize("mode", ["pair", "uniform"])
def test_a_resumed_estimate_is_the_same_to_the_bit(mode: str, kinds: tuple[str, ...]) -> None:
    """16 responses a side are kept after 8 and after 16: interrupted after each of the four parts, and finished."""
    lit = lit_session(13, mode)
    whole, _, _ = estimates(lit, Job(), kinds)
    kept = Kept()
    for life in range(4):
        kept.left = 1
        with pytest.raises(KeyboardInterrupt):
            estimates(lit, Job(), kinds, kept)
        for kind in kinds:
            done = [int((kept.part or {})[f"{kind}_{side}_done"]) for side in SIDES]
            assert done == [[8, 1], [16, 1], [16, 8], [16, 16]][life]
    again, _, _ = estimates(lit, Job(), kinds, kept)
    for ours, theirs in zip(again, whole, strict=True):
        for name in ("left", "right", "noise", "separability_residual", "unexplained", "predicted_error", "status"):
            assert np.array_equal(getattr(ours, name), getattr(theirs, name)), name


@pytest.mark.parametrize("first", [0, 1, 5, 9, 12])
def test_stripes_that_are_formed_in_lots_are_all_there(monkeypatch: pytest.MonkeyPatch, first: int) -> None:
    """16 patterns in lots of 4 that begin at the same numbers wherever a session goes on; lots before are not formed.
    (Planted: lots from the first number on, one pattern left out between lots.)"""
    monkeypatch.setattr("mitsim.calibrate.board_session.mixes", lambda *_: False)
    monkeypatch.setattr("mitsim.calibrate.board_session.lines_held", lambda *_: False)
    monkeypatch.setattr("mitsim.calibrate.board_session.at_once", lambda _: 4)
    lit, formed = lit_session(13), []
    whole = {number: frame.irradiance for number, frame in lit.stripes("vertical", 0)}
    frames = ToyLight.frames

    def counted(self: ToyLight, lighting: Lighting, seed: int, leaking: bool = True) -> list[Frame]:
        formed.append(lighting.weights)
        return frames(self, lighting, seed, leaking)

    monkeypatch.setattr(ToyLight, "frames", counted)
    found = dict(lit.stripes("vertical", first))
    assert list(found) == list(range(first, 16)) and all(
        np.array_equal(frame.irradiance, whole[number]) for number, frame in found.items()
    )
    lots = [(1 + lit.session.signs.T[start : start + 4]) / 2 for start in range(4 * (first // 4), 16, 4)]
    assert all(np.array_equal(*pair) for pair in zip(formed, lots, strict=True))


def test_saturated_shots_are_counted_once_across_an_interruption(monkeypatch: pytest.MonkeyPatch) -> None:
    """All shots, the uniform one of each side too: 2 x (1 + 16)."""
    monkeypatch.setattr(Exposer, "saturates", lambda *_: True)
    lit, kept = lit_session(13, "uniform"), Kept()
    assert estimate(lit, Job())[1] == lit.session.shots == 34
    kept.left = 3
    with pytest.raises(KeyboardInterrupt):
        estimates(lit, Job(), (NOISY,), kept)
    assert estimates(lit, Job(), (NOISY,), kept)[1] == 34


# ---- differences -----------------------------------------------------------------------------------------------------


def test_a_noise_free_response_is_that_of_the_signed_pattern() -> None:
    """Expected frames hold no noise to hide in: light of the +1 pixels less that of the -1 pixels, to rounding."""
    lit = lit_session(2)
    lights = {"horizontal": (lit.light.left, lit.light.right), "vertical": (lit.light.right, lit.light.left)}
    for side, (across, along) in lights.items():
        for sign, rate in zip(
            lit.session.signs.T, lit.each(side, lambda it: lit.noise_free(it[1]), Job()), strict=True
        ):
            found = rate if side == "horizontal" else rate.T
            np.testing.assert_allclose(found, np.outer(across @ sign, along.sum(axis=1)), rtol=1e-12, atol=1e-9)


def test_light_that_black_pixels_leak_is_in_both_shots_of_a_pair(shots: dict[tuple[str, int], FloatArray]) -> None:
    """A shot shows w + l (1 - w) of each pixel, by light that was formed for the +1 pixels alone. (Planted: no leak in
    the sum of both, or in the +1 frame.)"""
    lit, leaking = lit_session(4), ToyLight(4, leak=0.05)
    estimate(replace(lit, light=leaking), Job())
    (whole,) = leaking.frames(Lighting.uniform(4), 0)
    unit = float(shots["horizontal", 0].sum() / whole.irradiance.sum())
    for number, sign in enumerate(lit.session.signs.T):
        shown = Lighting(np.repeat(np.arange(4), 4), np.array([(1 + sign) / 2, (1 - sign) / 2]))
        for index, frame in enumerate(leaking.frames(shown, 0), start=2 * number):
            np.testing.assert_allclose(shots["horizontal", index], unit * frame.irradiance, rtol=1e-9)


# ---- frames on disk --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["pair", "uniform"])
def test_responses_have_the_mean_and_the_noise_of_the_closed_form(mode: str) -> None:
    """Over 12 seeds, 16 responses of 648 pixels each. Their mean is the noise-free response, but for 5 deviations of
    10 368 means; their variance is the stated one to 3 %.

    The uniform shot is shared by a side's responses: 12 x 1296 of these numbers tell a variance to 1.1 %, and they make
    a quarter of the whole. (Planted: its noise left out.)
    """
    lit, seeds = lit_session(7, mode, devices=CLIPPED), 12
    total, squares, saturated = 0.0, 0.0, 0
    for seed in range(seeds):
        own = replace(lit, session=replace(lit.session, seed=seed))
        responses = [(own.noisy(side, *it), own.noise_free(it[1])) for side in SIDES for it in own.stripes(side, 0)]
        off = np.array([response.rate - clean for response, clean in responses])
        total, squares = total + off, squares + np.square(off)
        saturated += sum(response.saturated for response, _ in responses)
    assert saturated == 0
    variance = squares / seeds
    assert float(np.mean(variance)) == pytest.approx(lit.response_noise**2, rel=0.03)
    assert np.abs(total / np.sqrt(seeds * variance.mean())).max() < 7  # of pixels up to twice as noisy as the mean


# -------- Frames of stripes, and the cost of sessions

N, ROWS, COLUMNS = 12, 20, 23


class StripeLight:
    """Frames L X R^T; ``removed`` is what the frame of line 3 lost below zero."""

    def __init__(self, removed: float = 0.0) -> None:
        rng = np.random.default_rng(1)
        self.left, self.right, self.removed = rng.random((ROWS, N)), rng.random((COLUMNS, N)), removed
        self.formed = 0

    def frames(self, lighting: Lighting, _: int, leaking: bool = True) -> list[Frame]:
        assert not leaking, "it is added later"
        self.formed += len(lighting.weights)
        return [self._frame(weights[lighting.labels].reshape(N, N)) for weights in lighting.weights]

    def _frame(self, picture: FloatArray) -> Frame:
        alone = picture.sum() == N and picture[3].all()
        return Frame(self.left @ picture @ self.right.T, 0.0, self.removed if alone else 0.0, 0.0)


def found(light: StripeLight, first: int = 1) -> dict[int, FloatArray]:
    bench = SimpleNamespace(n=N, geometry=SimpleNamespace(frame_shape=(ROWS, COLUMNS)))
    own: Any = session.Session(bench, load_recipe()), light  # type: ignore[arg-type]
    numbered = dict(session.LitSession(*own, Frame(np.ones(1), 0.0, 0.0, 0.0), 1.0, 0.0).stripes("horizontal", first))
    assert all(frame.variance == frame.removed == frame.heaviest == 0 for frame in numbered.values())
    return {number: frame.irradiance for number, frame in numbered.items()}


@pytest.fixture
def many_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """More lines than frames of a family would be mixed of, in lots of 5 and parts of 64 pixels."""
    monkeypatch.setattr(session, "mixes", lambda *_: False)
    monkeypatch.setattr(session, "at_once", lambda _: 5)
    monkeypatch.setattr(frames, "_COLUMNS", 64)


@pytest.mark.usefixtures("many_lines")
@pytest.mark.parametrize("first", [1, 6, 11])
def test_lines_are_mixed_into_the_frames_of_patterns(first: int) -> None:
    """Each line is formed once, and what is mixed has the same bits wherever one goes on. (Planted: the last part of
    pixels left as it was, the weights of the first lot for all, rows for columns.)"""
    light = StripeLight()
    mixed = found(light, first)
    assert light.formed == N and list(mixed) == list(range(first, N))
    whole = found(light)
    for number, sign in enumerate(hadamard_matrix(N).T):
        expected = np.outer(light.left @ ((1 + sign) / 2), light.right.sum(axis=1))
        if number >= first:
            np.testing.assert_allclose(mixed[number], expected, rtol=1e-12)
            assert np.array_equal(mixed[number], whole[number])


@pytest.mark.usefixtures("many_lines")
def test_lines_that_lost_light_are_not_mixed() -> None:
    """Set to zero in a line, it would be missing in every pattern. (Planted: mixed all the same.)"""
    light = StripeLight(removed=1e-9)
    formed = found(light)
    assert light.formed > N and len(formed) == N - 1
    for number, sign in list(enumerate(hadamard_matrix(N).T))[1:]:
        assert np.array_equal(formed[number], light._frame(np.repeat((1 + sign) / 2, N).reshape(N, N)).irradiance)


@pytest.mark.parametrize(
    ("lines", "pixels", "held"),
    [(128, 512, True), (896, 512, True), (897, 512, False), (128, 1024, True), (512, 1024, False), (128, 2048, False)],
)
def test_lines_are_held_up_to_so_many_bytes(lines: int, pixels: int, held: bool) -> None:
    """1.75 GiB. (Planted: 1 GiB less, three times as much.)"""
    assert session.lines_held(lines, lines, pixels) == held
    assert not session.lines_held(lines, lines - 1, pixels)


# ---- Cost of sessions ----


CELLS, FORMED_S, LIGHT = 80, 7.0, 1e6
HELD, FORMED = (128, 512), (128, 2048)
"""Lines and pixels a side: frames of the lines are held and mixed; those of patterns are formed."""


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What is asked of the price of forming frames, which says 7 s; light takes a megabyte."""
    calls: list[Any] = []
    fine = SimpleNamespace(bundle=SimpleNamespace(cells=(CELLS - 1, CELLS)))
    monkeypatch.setattr(session, "Simulation", lambda *_: SimpleNamespace(grids={"fine": fine}))
    monkeypatch.setattr(cost_model, "forming_seconds", lambda *arguments: calls.append(arguments) or FORMED_S)
    monkeypatch.setattr(cost_model, "light_bytes", lambda board, rows, settings: LIGHT * (rows == board.n**2))
    return calls


def board(n: int, pixels: int, mask: str = "separable") -> Any:
    geometry, spectrum = (
        SimpleNamespace(
            frame_side=pixels,
            frame_shape=(pixels, pixels),
            mask_terms=1 + (mask == "flatcam"),
            diffracts=True,
            is_drawn=lambda waves: False,
        ),
        SimpleNamespace(weights=(0.5, 0.3, 0.2)),
    )
    return SimpleNamespace(n=n, geometry=geometry, spectrum=spectrum)


@pytest.mark.parametrize(("size", "count", "lit", "frames"), [(HELD, 128, 1, 128), (FORMED, 100, 64, 100)])
def test_stripes_are_formed_for_both_sides(
    asked: list[Any], size: tuple[int, int], count: int, lit: float, frames: int
) -> None:
    """Single lines where they are mixed; else patterns, each of half of the lines. Three lines of light, and two terms
    of each with a mask of two."""
    settings, (n, pixels) = Settings(400.0), size
    found = session.session_seconds(board(*size), count, 1000, settings)
    forming, numbers, formed, _ = asked[0]
    assert formed == frames and forming.lit == lit / CELLS and (forming.pixels, forming.cells) == (pixels, CELLS)
    assert forming.terms == 3 and (forming.shots, forming.classes) == (count, n) and numbers.mixed == 0
    each = n * 1.1e-11 + 8e-9 if size == HELD else 1e-8
    assert found["optics"] == pytest.approx(2 * FORMED_S + 2 * count * pixels**2 * each)
    assert found["sensor"] == pytest.approx(1000 * pixels**2 * 1.1e-8) and found.keys() == {"optics", "sensor"}
    session.session_seconds(board(*size, "flatcam"), count, 1000, settings)
    assert asked[1][0].terms == 6


@pytest.mark.usefixtures("asked")
@pytest.mark.parametrize(("size", "lines", "formed", "exposed"), [(HELD, 128, 32, 16), (FORMED, 0, 4, 4)])
def test_memory_is_that_of_light_frames_and_sums(size: tuple[int, int], lines: int, formed: int, exposed: int) -> None:
    """Lines that are held, three lots that are formed, five frames of the session and five of each response that is
    worked on; and eight numbers for each pattern and row."""
    cost = session.session_cost(board(*size), 128, Settings(400.0), 3.0)
    frames, pixels = lines + 3 * formed + 5 + 5 * exposed, size[1]
    assert cost.seconds == 3.0
    assert cost.memory_bytes == pytest.approx(LIGHT + 8 * (frames * pixels**2 + 8 * 128 * pixels))

"""Sessions with planted faults are mended, and the stated error holds, or they are refused with the frames named.

Errors are compared with exact factors of a geometric shadow.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.devices.camera import centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.devices.patterns import stripe_signs
from mitsim.devices.session import SIDES, Half, halves_in_order
from mitsim.reconstruct.factors import StripeSums, stripe_sums
from mitsim.reconstruct.session_check import CheckedSession, MovingShadow, check_session, frame_words
from tests.shadow_factor import scene_factor

N, PIXELS = 32, (90, 100)
SIGNS = stripe_signs(N).astype(float)
ORDER = halves_in_order(N, True)
Frames = dict[Half, np.ndarray]


def shadow(pixels: int, moved: float = 0.0) -> np.ndarray:
    """Factor of the anchor's mask before a sensor that has ``moved`` by pixels."""
    edges = centred_edges(pixels, 5.0 / pixels) + moved * 5.0 / pixels
    return scene_factor(mls_mask().terms[0][1], 0.06, edges, centred_edges(N, 120 / N), 2.0, 400.0)


EXACT = [shadow(pixels) for pixels in PIXELS]
WHOLE = [factor.sum(axis=1) for factor in EXACT]
UNIT = 1 / np.outer(*WHOLE).max()
"""Light of the uniform frame is 1 at its brightest pixel."""


def light(half: Half, exact: list[np.ndarray] = EXACT, lit: np.ndarray | None = None) -> np.ndarray:
    """Light of a frame by ``exact`` factors; ``lit`` lines in place of the pattern's."""
    side, index, sign = half
    lines = (1 + sign * SIGNS[:, index]) / 2 if lit is None else lit
    whole = [factor.sum(axis=1) for factor in exact]
    sides = (exact[0] @ lines, whole[1]) if side == SIDES[0] else (whole[0], exact[1] @ lines)
    return UNIT * np.outer(*sides)


Change = Callable[[np.ndarray, float, Half], np.ndarray]


def frames(change: Change = lambda frame, time, half: frame, noise: float = 1e-3) -> Frames:
    """All frames, each after a ``change`` by time (0 to 1) and half, with ``noise``."""
    rng, last = np.random.default_rng(3), len(ORDER) - 1
    shown = ((half, change(light(half), place / last, half)) for place, half in enumerate(ORDER))
    return {half: frame + noise * rng.standard_normal(PIXELS) for half, frame in shown}


def sums_of(shown: Frames, pairs: bool = True) -> tuple[StripeSums, StripeSums]:
    """Sums of frames; not ``pairs``: each response is of its +1 frame and that of all light."""

    def pair(side: str, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        one, other = shown[side, index, 1], shown[side, index, -1]
        return (one - other, one + other) if pairs else (2 * one - shown.get((side, 0, 0), shown[side, 0, 1]), None)

    first = [pair(side, 0) for side in SIDES]
    sums = stripe_sums(first[0][0], first[1][0], N, lights=[both for _, both in first])
    for own in sums:
        for index in range(1, N):
            response, both = pair(own.side, index)
            own.put(own.fit_response(response, both))
    return sums


def checked(shown: Frames, pairs: bool = True) -> CheckedSession:
    return check_session(sums_of(shown, pairs), SIGNS, ORDER)


def error(found: CheckedSession) -> tuple[float, float]:
    """Actual and stated relative error of both factors, in quadrature."""
    estimate = found.estimate(SIGNS, None)
    balance = np.sqrt(UNIT * np.linalg.norm(WHOLE[1]) / np.linalg.norm(WHOLE[0]))
    exact = EXACT[0] * balance, EXACT[1] * UNIT / balance
    pairs = zip((estimate.left, estimate.right), exact, strict=True)
    actual = [np.linalg.norm(one - other) / np.linalg.norm(other) for one, other in pairs]
    return float(np.hypot(*actual)), float(np.hypot(*estimate.predicted_error))


def holds(found: CheckedSession, most: float = 0.1) -> bool:
    """Return True if the error is stated within a factor of 1.5, and is below ``most``."""
    actual, stated = error(found)
    return actual < 1.5 * stated < 1.5 * most


CLEAN = error(checked(frames()))[0]


def shown_frames(text: str) -> set[tuple[str, int]]:
    """Patterns that a message names."""
    return {(side, int(index)) for side, index in re.findall(r"(horizontal|vertical) stripes (\d+)", text)}


# ---- Good sessions ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pairs", [True, False])
def test_a_good_session_is_left_as_it_is_to_the_bit(pairs: bool) -> None:
    """(Planted: the uniform pattern's vector is set to zero in the given sums; ambient light taken off the misfit.)"""
    given = sums_of(frames(), pairs)
    vectors, misfits = [own.vectors.copy() for own in given], [own.misfit for own in given]
    found = check_session(given, SIGNS, ORDER)
    assert not found.warnings and found.lamp is None
    assert all(np.array_equal(own.vectors, exact) for own, exact in zip(found.sums, vectors, strict=True))
    assert [own.misfit for own in found.sums] == misfits
    actual, stated = error(found)
    assert 0.7 * stated < actual < 1.2 * stated


# ---- Single frames and patterns --------------------------------------------------------------------------------------


@pytest.mark.parametrize("half", [("horizontal", 5, 1), ("vertical", 20, -1)])
@pytest.mark.parametrize(
    "change",
    [
        lambda frame: 0 * frame,
        lambda frame: np.where(np.arange(PIXELS[1]) < 50, frame, 0.0),
        lambda frame: np.roll(frame, 3, 0),
        lambda frame: np.minimum(frame, np.quantile(frame, 0.7)),
    ],
)
def test_the_other_frame_replaces_a_wrong_one(change: Callable[[np.ndarray], np.ndarray], half: Half) -> None:
    """(Planted: the other frame is left out; the sum's deviation is added with the wrong sign.)"""
    found = checked({**frames(), half: change(light(half))})
    (fault,) = found.faults
    assert (fault.side, fault.index, fault.sign, fault.kind) == (*half, "replaced")
    assert error(found)[0] < 1.2 * CLEAN and holds(found, 0.01)
    (named,) = found.warnings
    assert named.startswith(f"frames: {frame_words(half)}: the two do not have the sum")
    assert fault.frames == [frame_words(half)]


@pytest.mark.parametrize("other", [("horizontal", 4, -1), ("horizontal", 5, -1), ("vertical", 0, 1)])
def test_a_frame_that_repeats_another_is_replaced(other: Half) -> None:
    found = checked({**(shown := frames()), ("horizontal", 5, 1): shown[other]})
    assert [fault.index for fault in found.faults] == [5] and error(found)[0] < 1.2 * CLEAN and holds(found, 0.01)


@pytest.mark.parametrize("part", [0.5, 0.9, 1.2])
def test_a_response_is_divided_by_a_single_frames_power(part: float) -> None:
    """(Planted: of half the power; of the other frame.)"""
    half = ("vertical", 20, -1)
    found = checked({**(shown := frames()), half: part * shown[half]})
    (fault,) = found.faults
    assert (*half, "power") == (fault.side, fault.index, fault.sign, fault.kind)
    assert f"{part:g} of its light" in fault.detail
    assert error(found)[0] < 1.2 * CLEAN and holds(found, 0.01)


def test_the_power_of_a_uniform_frame_is_divided_out_and_its_ambient_light_counts() -> None:
    """(Planted: the size of both uniform frames; ambient light of other pairs alone.)"""
    shown = frames()
    found = checked({**shown, ("vertical", 0, 1): 0.7 * shown["vertical", 0, 1]})
    (fault,) = found.faults
    assert (fault.side, fault.index, fault.kind) == ("vertical", 0, "power") and holds(found, 0.01)
    found = checked({**shown, ("vertical", 0, 1): 0.7 * shown["vertical", 0, 1] + 0.02})
    assert holds(found, 0.1) and any("even light that changes" in words for words in found.doubts)


def test_a_uniform_frame_that_shows_something_else_is_refused_and_named() -> None:
    shown = frames()
    lost = np.where(np.arange(PIXELS[1]) < 50, shown["vertical", 0, 1], 0.0)
    with pytest.raises(MitsimError, match="the two do not have the sum") as refusal:
        checked({**shown, ("vertical", 0, 1): lost})
    assert shown_frames(str(refusal.value)) == {("vertical", 0)}


@pytest.mark.parametrize("indices", [[0], [1], [3, 9, 30], range(N)])
@pytest.mark.parametrize("side", SIDES)
def test_the_signs_of_exchanged_pairs_are_turned(side: str, indices: list[int]) -> None:
    """The light decides on pattern 0, the moving shadow on all others. (Planted: pattern 0 is turned by the shadow,
    which cannot tell it from the turn of all others.)"""
    shown = frames()
    turned = {(side, index, sign): shown[side, index, -sign] for index in indices for sign in (1, -1)}
    found = checked({**shown, **turned})
    assert [(fault.side, fault.index, fault.kind) for fault in found.faults] == [
        (side, index, "exchanged") for index in (indices if len(indices) < N else [0])
    ]
    assert error(found)[0] == pytest.approx(CLEAN, rel=0.02)


@pytest.mark.parametrize("pairs", [True, False])
@pytest.mark.parametrize(
    ("index", "lines"),
    [
        (9, SIGNS[:, 25]),
        (1, SIGNS[:, 2]),
        (16, np.roll(SIGNS[:, 16], 1)),
        (13, np.roll(SIGNS[:, 13], 5)),
        (20, np.random.default_rng(1).choice([-1.0, 1.0], N)),
    ],
)
def test_a_pattern_that_shows_other_stripes_is_refused_and_named(index: int, lines: np.ndarray, pairs: bool) -> None:
    """(Planted: the worst pattern is not fitted before the others are judged, which names more than one.)"""
    shown = frames()
    for sign in (1, -1):
        shown["horizontal", index, sign] += light(("horizontal", 0, 1), lit=sign * (lines - SIGNS[:, index]) / 2)
    with pytest.raises(MitsimError, match="other horizontal stripes than the other patterns predict") as refusal:
        checked(shown, pairs)
    assert shown_frames(str(refusal.value)) - {("horizontal", 0)} == {("horizontal", index)}


def test_swapped_patterns_and_stripes_of_the_other_side_are_refused_and_named() -> None:
    shown = frames()
    swapped = {("vertical", one, sign): shown["vertical", 30 - one, sign] for one in (9, 21) for sign in (1, -1)}
    with pytest.raises(MitsimError) as refusal:
        checked({**shown, **swapped})
    assert shown_frames(str(refusal.value)) == {("vertical", 9), ("vertical", 21)}
    with pytest.raises(MitsimError, match=r"(light that no vertical stripes cast|other vertical stripes)") as refusal:
        checked({**shown, **{("vertical", 7, sign): shown["horizontal", 7, sign] for sign in (1, -1)}})
    assert shown_frames(str(refusal.value)) == {("vertical", 7)}


@pytest.mark.parametrize("start", [0, 20])
def test_frames_that_are_one_step_out_of_order_are_refused(start: int) -> None:
    shown, names = frames(), ORDER[start:]
    late = {**shown, **{name: shown[ORDER[start + place - 1]] for place, name in enumerate(names)}}
    with pytest.raises(MitsimError, match=r"^all frames: the two frames of .* patterns do not have the sum"):
        checked(late)


# ---- Faults of the whole session -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "ambient",
    [
        lambda time, y, x: 0.03 * time,
        lambda time, y, x: 0.3 * time,
        lambda time, y, x: 0.2 * time * (y + 0.5 * x),
        lambda time, y, x: 0.2 * (time > 0.4),
    ],
)
def test_ambient_light_is_told_from_the_lamp(ambient: Callable[..., np.ndarray]) -> None:
    """Slow, tilted, switched on. (Planted: the sums are projected on the uniform response alone; the change within
    pairs is not subtracted.)"""
    y, x = np.meshgrid(*(np.linspace(0, 1, length) for length in PIXELS), indexing="ij")
    found = checked(frames(lambda frame, time, half: frame + ambient(time, y, x)))
    assert not found.faults and found.lamp is None
    assert error(found)[0] < 2 * CLEAN and holds(found, 0.02)


@pytest.mark.parametrize("ambient", [0.0, 0.2])
def test_a_drifting_lamp_is_divided_out(ambient: float) -> None:
    """With and without ambient light that grows. (Planted: the trend's mean is not 1.)"""
    found = checked(frames(lambda frame, time, half: (1 + 0.05 * (time - 0.5)) * frame + ambient * time))
    assert not found.faults and not found.lamp["flicker"]
    assert found.lamp["drift"] == pytest.approx(0.05, rel=0.05)
    assert found.lamp["drift_cost"] == pytest.approx(0.05 / np.sqrt(12) * np.sqrt(2), rel=0.2), "of both sides"
    assert error(found)[0] < (2.0 if ambient else 1.3) * CLEAN and holds(found, 0.05)
    words, *_ = found.doubts
    assert words.startswith("lamp: its power drifts by +5.0% over the session")


@pytest.mark.parametrize("seed", [1, 12])
def test_a_flickering_lamp_is_divided_out(seed: int) -> None:
    """An error of 2 % becomes half a percent. (Planted: the unequal power of both frames is not divided out.)"""
    power = dict(zip(ORDER, 1 + 0.005 * np.random.default_rng(seed).standard_normal(len(ORDER)), strict=True))
    found = checked(frames(lambda frame, time, half: power[half] * frame))
    assert not found.faults and abs(found.lamp["drift"]) < 0.005
    assert found.lamp["flicker"] == pytest.approx(0.005, rel=0.25) and found.lamp["flicker_cost"] > 0.015
    actual, stated = error(found)
    assert 0.5 * stated < actual < 1.5 * stated < 0.015


@pytest.mark.parametrize("pixels", [0.02, 0.03])
def test_motion_midway_is_measured_and_counts(pixels: float) -> None:
    """(Planted: the motion along the columns is taken for that along the rows.)"""
    moved = [shadow(PIXELS[0], pixels), EXACT[1]]
    found = checked(frames(lambda frame, time, half: light(half, moved) if time > 0.25 else frame, noise=5e-3))
    (words,) = (words for words in found.doubts if "camera or mask" in words)
    assert float(words.split(" pixels")[0].split()[-1]) == pytest.approx(pixels, rel=0.3) and holds(found)


Y, X = np.meshgrid(*(np.linspace(-1, 1, length) for length in PIXELS), indexing="ij")
COLUMN = np.arange(PIXELS[1])


def every(change: Callable[[np.ndarray], np.ndarray], noise: float = 1e-3) -> Frames:
    return frames(lambda frame, time, half: change(frame), noise)


def lagging(lag: float) -> Frames:
    before = dict(zip(ORDER[1:], ORDER, strict=False))
    return frames(lambda frame, time, half: (1 - lag) * frame + lag * light(before.get(half, half)))


def banded(size: float) -> Frames:
    rng, rows = np.random.default_rng(4), np.arange(PIXELS[0])
    return every(lambda frame: frame * (1 + size * np.sin(rows / 4 + 6.3 * rng.random()))[:, None])


def lit(part: float) -> Frames:
    rng = np.random.default_rng(6)
    return every(lambda frame: frame + part * rng.random())


def flickering(flicker: float) -> Frames:
    power = dict(zip(ORDER, 1 + flicker * np.random.default_rng(5).standard_normal(len(ORDER)), strict=True))
    return frames(lambda frame, time, half: power[half] * frame)


def stuck() -> Frames:
    def change(frame: np.ndarray, time: float, half: Half) -> np.ndarray:
        lines = np.where(np.arange(N) == 11, 1.0, (1 + half[2] * SIGNS[:, half[1]]) / 2)
        return light(half, lit=lines) if half[0] == "horizontal" else frame

    return frames(change)


def moving() -> Frames:
    moved = [shadow(length, 0.5) for length in PIXELS]
    return frames(lambda frame, time, half: light(half, moved) if time > 0.5 else frame)


def uniform(change: Callable[[np.ndarray], np.ndarray], sides: tuple[str, ...] = SIDES, sign: int = 1) -> Frames:
    """Only the uniform frames are changed."""
    shown = frames()
    return {**shown, **{(side, 0, sign): change(shown[side, 0, 1]) for side in sides}}


@pytest.mark.parametrize(
    ("pairs", "make", "words"),
    [
        (True, lambda: every(lambda frame: np.where(np.arange(PIXELS[0])[:, None] == 40, 0.3, frame)), "row 40 shows"),
        (True, lambda: every(lambda frame: np.power(frame, 0.98), 5e-3), "not in proportion to light"),
        (True, lambda: every(lambda frame: np.power(frame, 1.02), 5e-3), "not in proportion to light"),
        (True, lambda: lagging(0.003), "each frame holds 0.3% of the one before"),
        (True, lambda: banded(0.01), "pairs add up to light that changes"),
        (True, lambda: lit(0.03), "even light that changes"),
        (False, lambda: flickering(0.002), "frames are of different power"),
        (False, lambda: flickering(0.005), "frames are of different power"),
        (
            False,
            lambda: frames(lambda frame, time, half: (1 + 0.03 * (half[0] == SIDES[1])) * frame),
            "different power",
        ),
        (False, lambda: uniform(lambda frame: frame + 0.01 * np.exp(-8 * (X**2 + Y**2))), "uniform frame does not fit"),
    ],
)
def test_small_faults_count_in_the_stated_error(pairs: bool, make: Callable[[], Frames], words: str) -> None:
    """(Planted: the frame before is taken for the one after; what sums have beyond noise is left out; the power's own
    noise alone; the first line is not looked at.)"""
    found = checked(make(), pairs)
    assert holds(found, 0.15) and any(words in doubt for doubt in found.doubts)


@pytest.mark.parametrize(
    ("pairs", "make", "words"),
    [
        (True, stuck, ""),
        (False, stuck, ""),
        (True, moving, r".*(nothing moves \(|mask move by )0.[456]"),
        (True, lambda: lagging(0.02), r".*no frame holds light of the one before \(2.0%\)"),
        (True, lambda: banded(0.05), ""),
        (True, lambda: lit(0.3), "responses hold even light that changes"),
        (False, lambda: uniform(lambda frame: 0.9 * frame, SIDES[:1], 0), ""),
        (False, lambda: uniform(lambda frame: 0.7 * frame, SIDES[1:]), ""),
        (False, lambda: uniform(lambda frame: np.minimum(frame, 0.8)), "the uniform frame does not fit those of"),
        (False, lambda: every(lambda frame: frame + 2.0 * (COLUMN == 30)), ".*sensor column 30 shows no light, or too"),
    ],
)
def test_large_faults_are_refused(pairs: bool, make: Callable[[], Frames], words: str) -> None:
    """(Planted: the first line alone is looked at; dark rows alone.)"""
    with pytest.raises(MitsimError, match=rf"^all frames: {words}"):
        checked(make(), pairs)


def test_light_that_the_stated_camera_explains_is_not_ambient() -> None:
    """A tilted mask adds light that no product has to every response, and noise-free responses of the stated camera
    have it, too. (Planted: the stated camera's light counts as ambient light.)"""
    camera = every(lambda frame: frame, 0.0)
    rng = np.random.default_rng(6)
    own = {half: frame + 0.03 * rng.random() for half, frame in camera.items()}
    noise = np.random.default_rng(7)
    shown = {half: frame + 1e-3 * noise.standard_normal(PIXELS) for half, frame in own.items()}
    found = check_session(sums_of(shown), SIGNS, ORDER, stated=sums_of(own))
    assert any("even light" in words for words in checked(shown).doubts)
    assert not any("even light" in words for words in found.doubts)


# ---- Without pairs ---------------------------------------------------------------------------------------------------


def test_photon_noise_of_peaked_light_is_no_changing_light() -> None:
    """Bright pixels are noisier and weigh more; the stated error includes it. (Planted: all excess is named light; all
    rows equally noisy, so that noise of small responses is a lamp's that flickers.)"""
    rng, falloff = np.random.default_rng(5), np.outer(*(np.sin(np.pi * (np.arange(m) + 0.5) / m) ** 4 for m in PIXELS))
    clean = frames(lambda frame, time, half: falloff * frame, noise=1e-7)
    shown = {half: frame + 1e-3 * np.sqrt(np.abs(frame)) * rng.standard_normal(PIXELS) for half, frame in clean.items()}
    found = checked(shown)
    assert not found.doubts and found.lamp is None and min(found.extra) > 0
    exact, measured = checked(clean).estimate(SIGNS, None), found.estimate(SIGNS, None)
    for name, stated in zip(("left", "right"), measured.predicted_error, strict=True):
        one, other = getattr(measured, name), getattr(exact, name)
        assert np.linalg.norm(one - other) / np.linalg.norm(other) == pytest.approx(stated, rel=0.15)


@pytest.mark.parametrize(("feature", "gap"), [(0.11, 0.8), (0.12, 1.0)])
def test_a_line_behind_closed_features_is_not_dead(feature: float, gap: float) -> None:
    """It has little light, but more than noise. (Planted: a fiftieth of its neighbours' energy is a dead row.)"""
    edges = centred_edges(48, 5.0 / 48), centred_edges(N, 120 / N)
    exact, rng = [scene_factor(mls_mask().terms[0][1], feature, *edges, gap, 400.0)] * 2, np.random.default_rng(3)
    shown = {half: light(half, exact) for half in ORDER}
    top = max(frame.max() for frame in shown.values())
    noisy = {half: each / top + 1e-3 * rng.standard_normal(each.shape) for half, each in shown.items()}
    assert not checked(noisy).doubts


def test_a_sign_is_turned_without_pairs() -> None:
    half, clean = ("vertical", 20, 1), error(checked(frames(), pairs=False))[0]
    found = checked({**frames(), half: light(("vertical", 20, -1))}, pairs=False)
    assert [(fault.index, fault.sign, fault.kind) for fault in found.faults] == [(20, 1, "exchanged")]
    assert error(found)[0] == pytest.approx(clean, rel=0.1)


@pytest.mark.parametrize("change", [lambda frame: 0 * frame, lambda frame: np.roll(frame, 3, 0)])
def test_a_wrong_frame_without_pairs_is_refused_and_named(change: Callable[[np.ndarray], np.ndarray]) -> None:
    half = ("horizontal", 20, 1)
    with pytest.raises(MitsimError) as refusal:
        checked({**frames(), half: change(light(half))}, pairs=False)
    assert shown_frames(str(refusal.value)) == {half[:2]}


# ---- The moving shadow -----------------------------------------------------------------------------------------------


def test_shares_are_the_part_of_a_pattern_that_disagrees() -> None:
    """0 of good patterns, 2 of a turned sign, 1 of a vector that is gone; a missing column has all of its square."""
    vectors = EXACT[0] @ SIGNS
    assert np.abs(MovingShadow(vectors, SIGNS).shares[[0, 9, 16]]).max() < 0.1
    for factor, share in ((-1.0, 2.0), (1e-6, -1e6)):
        wrong = vectors.copy()
        wrong[:, 9] *= factor
        assert MovingShadow(wrong, SIGNS).shares[9] == pytest.approx(share, rel=0.1)
    missing = EXACT[0] * (np.arange(N) != 11)
    assert MovingShadow(missing @ SIGNS, SIGNS).lines[11] == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize(("n", "pixels"), [(64, 64), (128, 64), (128, 128)])
def test_pixels_as_coarse_as_the_mask_are_no_fault(n: int, pixels: int) -> None:
    """Pixels alias finer detail of the mask many times; two swapped patterns are seen all the same.

    (Planted: four aliases, by which up to three patterns of these good cameras are refused.)
    """
    signs = stripe_signs(n).astype(float)
    edges = centred_edges(pixels, 6.0 / pixels), centred_edges(n, 120 / n)
    vectors = scene_factor(mls_mask().terms[0][1], 0.06, *edges, 2.0, 400.0) @ signs
    vectors += 1e-3 * np.sqrt(np.square(vectors).mean()) * np.random.default_rng(0).standard_normal(vectors.shape)
    assert MovingShadow(vectors, signs).deviations[1:].max() < 15
    vectors[:, [5, 9]] = vectors[:, [9, 5]]
    swapped = MovingShadow(vectors, signs)
    assert (swapped.deviations[[5, 9]] > 40).all() and (swapped.unlike[[5, 9]] > 0.03).all()

"""Faulty frames, one at a time, in the ideal sessions of `tests.ideal_sessions`.

benchmarks/frame_faults.py and benchmarks/foreign_frames.py have the rates, over scenes, masks, light and sizes.

A closing frame is compared with the frames before it, in ideal sessions.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mitsim.core.manifests import Patterns
from mitsim.core.runs import Capture, ClosingFrame
from mitsim.devices.camera import centred_edges
from mitsim.reconstruct.misfit import Cause, PictureCheck
from mitsim.reconstruct.reconstruct import Reconstruction, reconstruct
from mitsim.reconstruct.solver import Verdict
from tests.ideal_sessions import BLACK, DARK, GAIN, PIXELS, READ, Bench, bench, picture, shadow
from tests.shadow_factor import scene_factor

FAMILIES = "dots:4", "hadamard:4", "random:4", "dots:1x8"
Frames = list[np.ndarray]


def with_frames(shots: Capture, change: Callable[[Frames], Frames]) -> Capture:
    """The capture with its frames changed."""
    captures = shots.manifest.patterns.captures
    numbers = change([np.asarray(each, dtype=np.float64) for each in shots.dn])
    whole = (np.clip(np.rint(each), 0, 2**13 - 1).astype(np.uint32) for each in numbers)
    memory = {shot.file: ({"DN": each}, {}) for shot, each in zip(captures, whole, strict=True)}
    return Capture(shots.manifest, memory=memory)


def image(patterns: str, change: Callable[[Frames], Frames], seed: int = 1) -> Reconstruction:
    return reconstruct(with_frames(bench().run(patterns, picture(seed), seed), change), bench().calibrated(seed))


def named_by(found: Reconstruction) -> set[int]:
    """Numbers of all frames at fault."""
    return {number for reported in found.misfit.faults for number in reported.numbers}


def dark(frame: np.ndarray, seed: int = 0) -> np.ndarray:
    """Numbers of a frame without light."""
    rng = np.random.default_rng([seed, 7])
    return BLACK + GAIN * (rng.poisson(DARK, frame.shape) + READ * rng.standard_normal(frame.shape))


def dim(frame: np.ndarray) -> np.ndarray:
    """Half of a frame's light, with the noise of that."""
    light = (frame - BLACK) / GAIN - DARK
    missing = np.sqrt(0.25 * np.maximum(light, 0) + 0.75 * (READ**2 + DARK))
    noise = np.random.default_rng(8).standard_normal(frame.shape)
    return BLACK + GAIN * (DARK + 0.5 * light + missing * noise)


FAULTS: dict[str, Callable[[Frames], np.ndarray]] = {
    "black": lambda frames: dark(frames[3]),
    "dim": lambda frames: dim(frames[3]),
    "repeated": lambda frames: frames[2],
    "half_lost": lambda frames: np.where(np.arange(PIXELS)[:, None] < 40, dark(frames[3]), frames[3]),
    "shifted": lambda frames: np.roll(frames[3], (3, -2), (0, 1)),
    "clipped": lambda frames: np.minimum(frames[3], BLACK + 0.7 * (frames[3].max() - BLACK)),
}


@pytest.mark.parametrize(
    ("fault", "patterns"),
    [
        *(("black", "dots:4"), ("black", "hadamard:4"), ("dim", "random:4"), ("repeated", "random:4")),
        *(("repeated", "dots:1x8"), ("half_lost", "dots:4"), ("half_lost", "hadamard:4"), ("shifted", "dots:1x8")),
        *(("shifted", "hadamard:4"), ("clipped", "dots:4"), ("clipped", "random:4")),
    ],
)
def test_a_faulty_frame_is_named(patterns: str, fault: str) -> None:
    """By its number and its file. (Planted: a leave-one-out energy without the part that the frame itself explains.)"""
    found = image(patterns, lambda frames: [*frames[:3], FAULTS[fault](frames), *frames[4:]])
    assert not found.ok and found.status.verdict is Verdict.MISFIT
    assert found.misfit.cause is Cause.FRAMES
    named = named_by(found)
    first = {number for reported in found.misfit.faults[:2] for number in reported.numbers}
    assert 3 in first and len(named) <= 4
    assert "frame_00003.exr" in str(found.status) and "capture these frames again" in str(found.status)
    summary = found.summary()["misfit"]
    assert summary["cause"] == "frames" and summary["faults"] == [each.summary() for each in found.misfit.faults]


@pytest.mark.parametrize("patterns", ["dots:4", "hadamard:4"])
def test_a_frame_that_is_clipped_where_noise_hides_it(patterns: str) -> None:
    """A few readings cut by a tenth of them, which no residual shows; noise alone ends in no number so often."""
    shots = bench(peak=800.0).run(patterns, picture(1), 1)

    def cut(frames: Frames) -> Frames:
        return [*frames[:3], np.minimum(frames[3], np.sort(frames[3], axis=None)[-60]), *frames[4:]]

    misfit = reconstruct(with_frames(shots, cut), bench().calibrated(1)).misfit
    assert ("clipped", (3,)) in [(reported.kind, reported.numbers) for reported in misfit.faults]


def test_a_dim_frame_of_dim_light() -> None:
    """Where patterns overlap it puts others off, by nearly as much as itself."""
    shots = bench(peak=150.0).run("random:4", picture(1), 1)
    one_dim = with_frames(shots, lambda frames: [*frames[:3], dim(frames[3]), *frames[4:]])
    found = reconstruct(one_dim, bench().calibrated(1))
    assert 3 in named_by(found)


@pytest.mark.parametrize("patterns", ["hadamard:4", "dots:1x8"])
def test_exchanged_frames_are_named(patterns: str) -> None:
    found = image(patterns, lambda frames: [*frames[:2], frames[5], *frames[3:5], frames[2], *frames[6:]])
    assert named_by(found) >= {2, 5}


def powered(frames: Frames, powers: np.ndarray) -> Frames:
    """The frames with the lamp at these powers."""
    own = BLACK + GAIN * DARK
    return [own + (each - own) * power for each, power in zip(frames, powers, strict=True)]


def test_a_lamp_that_flickers_between_the_halves_of_pairs() -> None:
    """All pairs have the same sum; power that differs from shot to shot goes into their differences, slow drift does
    not. (Planted: the part common to both halves alone; any cost allowed.)"""
    patterns, count = "hadamard:4", 32
    flicker = 1 + 0.04 * np.random.default_rng(5).standard_normal(count)
    found = image(patterns, lambda frames: powered(frames, flicker))
    assert not found.ok
    (reported,) = found.misfit.faults
    assert reported.kind == "power" and reported.numbers == tuple(range(count))
    differs = float(reported.words.split("differ by ")[1].split("%")[0])
    assert abs(differs / (100 * flicker.std()) - 1) < 0.15
    assert image(patterns, lambda frames: powered(frames, np.linspace(1, 0.99, count))).ok
    assert image(patterns, list).ok


@pytest.mark.parametrize("pair", [(6, 17), (10, 11)])
def test_exchanged_halves_are_named(pair: tuple[int, int]) -> None:
    """Of two pairs, whose sums show it, and of one pair, whose difference contradicts the others."""
    one, other = pair
    found = image("hadamard:4", lambda frames: [frames[{one: other, other: one}.get(n, n)] for n in range(len(frames))])
    named = named_by(found)
    assert named >= set(pair) and len(named) <= 4


@pytest.mark.parametrize(
    ("print_", "patterns"),
    [
        *itertools.product(("smooth", "stars"), FAMILIES),
        *itertools.product(("stripes", "black"), ("uniform", "dots:2", "dots:4", "hadamard:2")),
    ],
)
def test_no_frame_of_a_fitting_run_is_named(patterns: str, print_: str) -> None:
    """Stripes as fine as the dots make half of the frames bright and half of them dark; stars, and a card before
    nothing, leave some without light."""
    scene = picture(3)
    if print_ == "stripes":
        scene = np.tile([0.05, 0.95], (16, 8))
    elif print_ == "stars":
        scene = np.where(np.random.default_rng(5).random((16, 16)) < 0.08, 0.9, 0.01)
    elif print_ == "black":
        scene = np.zeros((16, 16))
        scene[4:7, 5:8] = 0.9
    shots = bench(peak=3e3).run(patterns, scene, 4)
    misfit = reconstruct(shots, bench().calibrated(4)).misfit
    assert not misfit.faults and not misfit.flagged and misfit.defects is None


@pytest.mark.parametrize("patterns", ["dots:1x8", "hadamard:4"])
def test_frames_of_gloss_are_not_at_fault(patterns: str) -> None:
    """Gloss is light that has no image. The run may be flagged for it, and no frame is named, because all frames were
    captured rightly. (Planted: the even pattern is at fault; windows are reported beside light that has no image.)"""
    rng, seed = np.random.default_rng(1), 1
    code = rng.integers(0, 2, 511).astype(np.float64)
    y, x = np.mgrid[:64, :64] / 64
    scene = 0.45 + 0.3 * np.sin(2 * np.pi * (2 * x + rng.random())) * np.cos(2 * np.pi * (1.5 * y + rng.random()))
    row, column = rng.integers(16, 48, 2)
    scene[row : row + 2, column : column + 2] *= 12
    edges = centred_edges(PIXELS, 6.0 / PIXELS), centred_edges(64, 120 / 64)
    sides = [scene_factor(code, 0.06, edges[0], edges[1] + shift, 2.0, 400.0) for shift in (0.0, 7.0)]
    place = np.linspace(-1, 1, PIXELS)
    gloss = 1 + 0.05 * np.outer(place, np.exp(-4 * np.square(place - 0.3)))
    camera = Bench(*sides, optics=lambda light: light * gloss)
    misfit = reconstruct(camera.run(patterns, scene, seed), camera.calibrated(seed)).misfit
    assert not misfit.faults


@pytest.mark.parametrize("seed", [0, 3])
def test_bars_along_lines_of_dots_decide_nothing(seed: int) -> None:
    """Bars that are random from line to line: a frame lights few of them, and one that is at many edges is a good one.
    (Planted: lines as single pixels, in the picture as a whole and in windows.)"""
    rng = np.random.default_rng(seed)
    bars = np.where(rng.random(64) < 0.2, 0.1, 0.85) if seed % 2 else 0.1 + 0.8 * (rng.random(64) > 0.5)
    camera = Bench(shadow(n=64), shadow(n=64))
    misfit = reconstruct(camera.run("dots:1x8", np.tile(bars, (64, 1)), seed), camera.calibrated(seed)).misfit
    assert not misfit.faults and not misfit.flagged
    assert seed == 3 or "same along the dots' lines, to decide" in str(misfit.limits)  # four frames see no bar of 3


def test_scatter_that_the_picture_s_errors_explain_is_no_flicker() -> None:
    """Powers agree within their errors, so that the stated part is smaller than the scatter; the power of a lamp that
    flickers is covered. (Planted: no error of the scatter; no errors of the powers.)"""
    n, stated = 48, {0.0: [], 0.01: [], 0.05: []}
    frames, scatter = np.add.outer(4 * (np.arange(n) % 4), np.arange(n) % 4), []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        scene = 0.5 + 0.1 * gaussian_filter(rng.standard_normal((n, n)), 1.0) / 0.28
        powers = rng.permutation(np.linspace(-1.63, 1.63, 16))
        for level, found in stated.items():
            check = PictureCheck(scene * (1 + level * powers)[frames], frames, (4, 4), np.zeros((n, n)))
            found.append(float(check.uncertainty(np.ones((n, n))).mean()))
            scatter += [] if level else [float(np.std(check.power))]
    ratios = np.divide(stated[0.0], scatter)
    assert np.median(ratios) < 0.7 and ratios.min() > 0.4
    assert min(stated[0.01]) > 0.005 and min(stated[0.05]) > 0.025
    assert np.median(stated[0.05]) == pytest.approx(0.05, rel=0.3)


def test_noise_that_the_dots_of_a_frame_share_is_no_disturbance() -> None:
    """Dots whose shadows overlap have correlated noise. (Seen: good frames of lamp_bench beside a bright lamp were
    called faulty, for which the automatic weight cost 5 dB. Planted: windows counted as of independent pixels.)"""
    worst, hands = [], []
    for seed in range(6):
        rng, n = np.random.default_rng(seed), 128
        frames = np.add.outer(4 * (np.arange(n) % 4), np.arange(n) % 4)
        seen = 0.5 + 0.05 * gaussian_filter(rng.standard_normal((n, n)), 1.0) / 0.28
        for k in range(16):
            noise = gaussian_filter(rng.standard_normal((n // 4, n // 4)), 0.8)
            seen[frames == k] += (0.1 * noise / noise.std()).ravel()
        hand = seen.copy()
        hand[40:72, 40:72][np.isin(frames[40:72, 40:72], (5, 6, 7))] -= 0.4
        checks = [PictureCheck(each, frames, (4, 4), np.full((n, n), 0.01)) for each in (seen, hand)]
        worst.append(checks[0].disturbed.max())
        hands.append(checks[1].disturbed[5:8].max())
    assert max(worst) < 7.5 < min(hands), (worst, hands)


def test_more_than_a_quarter_of_the_dots_black() -> None:
    """(Planted: named up to a quarter of all frames, so that five of sixteen passed in silence.)"""
    page = np.where(np.random.default_rng(3).random((32, 32)) < 0.35, 0.4, 0.85)
    camera = Bench(shadow(n=32), shadow(n=32))
    shots = with_frames(camera.run("dots:4", page, 1), lambda f: [dark(f[k], k) if k < 5 else f[k] for k in range(16)])
    assert not reconstruct(shots, camera.calibrated(1)).ok


def test_the_only_frame_without_light() -> None:
    black = image("uniform", lambda frames: [dark(frames[0])])
    assert not black.ok and "frame 0 (frame_00000.exr) holds no light" in str(black.status)


def test_patterns_that_repeat_may_look_alike() -> None:
    """Two patterns that are the same show the same light with other noise."""
    shots = bench().run("dots:2", picture(1), 1)
    captures = shots.manifest.patterns.captures
    twice = bench().run("dots:2", picture(1), 2)
    P_L = tuple((*row, *row) for row in shots.manifest.patterns.P_L)
    seconds = ({"file": f"second{n}.exr", "row": shot.row + 2} for n, shot in enumerate(captures))
    files = [(shot.model_copy(update=new), shot) for new, shot in zip(seconds, captures, strict=True)]
    patterns = Patterns(P_L=P_L, P_R=shots.manifest.patterns.P_R, captures=(*captures, *(new for new, _ in files)))
    memory = {**shots._memory, **{new.file: twice._memory[old.file] for new, old in files}}
    both = Capture(shots.manifest.model_copy(update={"patterns": patterns}), memory=memory)
    assert reconstruct(both, bench().calibrated(1)).ok
    # But no frame with its noise comes twice.
    same = {**memory, files[0][0].file: memory[files[0][1].file]}
    found = reconstruct(Capture(both.manifest, memory=same), bench().calibrated(1)).misfit
    assert (0, 4) in [reported.numbers for reported in found.faults if reported.kind == "repeated"]


@pytest.mark.parametrize(
    "change", [lambda frame: np.where(np.arange(PIXELS)[:, None] < 52, 0.0, frame), dark], ids=["half_lost", "black"]
)
def test_a_faulty_frame_behind_a_constant_term(change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Even light in front of all frames, which the solver removes as it does behind a FlatCam's mask."""
    even = replace(bench(), optics=lambda light: light / 50 + 0.98 * light.mean())
    shots, factors = even.run("random:4", picture(1), 1), bench().calibrated(1)
    factors = replace(factors, manifest=factors.manifest.model_copy(update={"centre": True}))
    assert reconstruct(shots, factors).ok
    found = reconstruct(with_frames(shots, lambda frames: [*frames[:3], change(frames[3]), *frames[4:]]), factors)
    assert 3 in named_by(found)


# ---- A closing frame ----


def closed(kind: str, patterns: str, power: float, seed: int = 2) -> Reconstruction:
    """Reconstruct a run whose closing frame shows ``power`` times the light of the frames before it."""
    shots = bench().run(patterns, picture(1), seed)
    digital, rng = shots.manifest.digital, np.random.default_rng(seed)
    if kind == "first":
        light = digital.rate(np.asarray(shots.dn[0], dtype=np.float64))
    else:
        light = sum(each.frame for each in shots.pattern_measurements())
    variance = np.maximum(digital.variance(light), 0.0)
    shown = power * light + np.sqrt(variance) * rng.standard_normal(light.shape)
    shots.__dict__["closing"] = ClosingFrame(kind, shown, variance, 0)  # type: ignore[arg-type]
    return reconstruct(shots, bench().calibrated(1))


def test_a_closing_frame_that_decides_nothing() -> None:
    """Random patterns do not add up to even light, which is said. (Planted: nothing said.)"""
    found = closed("uniform", "random:4", 1.0)
    assert not found.ok and "closing frame decides nothing" in str(found.status)
    # What is off by more than 0.4 % of the light, but by less than chance, is no fault.
    assert closed("first", "dots:4", 1.0145).ok


@pytest.mark.parametrize(("kind", "patterns"), [("first", "dots:4"), ("first", "hadamard:4"), ("uniform", "dots:4")])
def test_a_closing_frame_of_another_power(kind: str, patterns: str) -> None:
    """3 % of drift is reported with the power, and none is reported without it. (Planted: a prediction of another
    shot.)"""
    assert closed(kind, patterns, 1.0).ok
    found = closed(kind, patterns, 1.03)
    assert not found.ok
    (fault,) = found.misfit.faults
    assert fault.kind == "closing"
    assert float(fault.words.split("power is ")[1].split()[0]) == pytest.approx(1.03, abs=3e-3)


def test_a_saturated_closing_frame_decides_nothing() -> None:
    """The result says so. (Planted: saturated readings not asked for.)"""
    shots = bench().run("dots:4", picture(1), 2)
    light = np.asarray(sum(each.frame for each in shots.pattern_measurements()))
    shots.__dict__["closing"] = ClosingFrame("uniform", light, np.zeros_like(light), 7)
    found = reconstruct(shots, bench().calibrated(1))
    assert not found.ok and "decides nothing, because it is saturated" in str(found.status)


def test_what_dots_leave_undecided_is_stated_until_a_closing_frame_decides_it() -> None:
    """In words and numbers, and only of a real camera. (Planted: stated beside a uniform closing frame, too.)"""
    page = np.where(np.random.default_rng(3).random((32, 32)) < 0.35, 0.1, 0.85)
    camera = Bench(shadow(n=32), shadow(n=32))
    shots, factors = camera.run("dots:4", page, 1), camera.calibrated(1)
    found = reconstruct(shots, factors)
    assert found.ok and found.misfit is not None
    (limit,) = found.summary()["misfit"]["limits"]
    assert "--closing-frame uniform" in limit["words"] and limit["words"] in found.limits[0]
    # Two of three pixels are bright: others hardly tell a pixel of such a page, and each frame has 64 of them.
    assert 0.1 < limit["pixel"] < 0.5 and 0.005 < limit["power"] < 0.1
    simulated = shots.manifest.model_copy(update={"plan": {"systematic_error": 0.0}})
    known = reconstruct(Capture(simulated, memory=shots._memory), factors)
    assert not known.misfit.limits
    light = np.asarray(sum(each.frame for each in shots.pattern_measurements()))
    variance = np.maximum(shots.manifest.digital.variance(light), 0.0)
    shots.__dict__["closing"] = ClosingFrame("uniform", light, variance, 0)
    closed = reconstruct(shots, factors)
    assert not closed.misfit.limits


def test_a_projector_that_leaks_light() -> None:
    """Signed patterns cancel a leak of 5 %, which darkens the image by as much: its size is stated. (Planted: the leak
    of another pattern than the even one; twice the leak.)"""
    shots = bench().run("hadamard:4", picture(1), 1)
    captures, digital = shots.manifest.patterns.captures, shots.manifest.digital
    bright = next(np.asarray(dn, float) for shot, dn in zip(captures, shots.dn, strict=True) if shot.sign == 1)
    even = BLACK + GAIN * DARK
    leaking = with_frames(shots, lambda frames: [dn + 0.05 * ((bright - even) - (dn - even)) for dn in frames])
    assert digital.black_level_dn == BLACK
    misfit = reconstruct(leaking, bench().calibrated(1)).misfit
    assert misfit.limits[0]["leak"] == pytest.approx(0.05, rel=0.05)
    known = reconstruct(shots, bench().calibrated(1)).misfit
    assert not known.limits

"""A closing frame of a capture: the light of the first frame, or of all pixels, with noise of its own."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.acquire.capture import Light
from mitsim.api.bench import Bench, open_bench
from mitsim.core.errors import ArgumentError
from mitsim.core.runs import Capture, load_run
from mitsim.sensor.moments import frame_moments

pytestmark = pytest.mark.usefixtures("kept_plans")
ACCURACY = 2e-2


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str) -> Bench:
    printed = np.random.default_rng(6).integers(90, 250, (32, 32))
    return open_bench(shared_scene("closing", reflectance=printed), variant)


@pytest.fixture(scope="module")
def light(bench: Bench) -> Light:
    return bench.light("dots:3", accuracy=ACCURACY, seed=5)


def _score(shots: Capture, exposure_s: float, bench: Bench) -> np.ndarray:
    """Noise of the closing frame in units of its closed-form deviation."""
    channels = shots.read("closing.exr")[0]
    mean, variance = frame_moments(channels["electrons"], exposure_s, bench.sensor)
    return (channels["DN"] - mean) / np.sqrt(variance)


@pytest.mark.parametrize("patterns", ["dots:3", "hadamard:2"])
def test_other_frames_are_the_same_bytes_with_and_without_one(
    patterns: str, light: Light, bench: Bench, tmp_path: Path
) -> None:
    """Only the digest of the configuration in their headers differs. (Planted: the closing frame's streams drawn from
    those of the first frame; the exposure chosen for the closing frame too.)"""
    plain = light.expose(patterns)
    assert plain.closing is None and "closing_frame" not in plain.manifest.configuration
    light.expose(patterns, tmp_path / "plain")
    written = json.loads((tmp_path / "plain" / "manifest.json").read_text())
    assert not {"closing_frame", "order"} & written.keys(), "version 0.10.0 refuses keys that it does not know"
    for kind in ("first", "uniform"):
        closed = light.expose(patterns, tmp_path / kind, closing_frame=kind)
        assert np.array_equal(closed.dn, plain.dn) and np.array_equal(closed.electrons, plain.electrons)
        assert closed.manifest.configuration["closing_frame"] == kind
        again = load_run(tmp_path / kind)
        stated = again.manifest.closing_frame
        assert stated.kind == kind and again.manifest.checksums["closing.exr"] and again.closing.saturated == 0
        score = _score(again, stated.exposure_s, bench)
        assert abs(score.mean()) < 5 / np.sqrt(score.size) and abs(score.std() - 1) < 5 / np.sqrt(2 * score.size)
        expected = again.read("closing.exr")[0]["electrons"]
        if kind == "first":
            assert stated.exposure_s == plain.exposure_s and np.array_equal(expected, plain.electrons[0])
            first = (plain.dn[0] - frame_moments(expected, plain.exposure_s, bench.sensor)[0]).ravel()
            assert abs(np.corrcoef(first, score.ravel())[0, 1]) < 6 / np.sqrt(first.size)


@pytest.mark.parametrize(("patterns", "shown"), [("dots:3", 9), ("hadamard:2", 2)])
def test_a_uniform_one_is_the_sum_of_frames_that_light_each_pixel_once(
    patterns: str, shown: int, light: Light, bench: Bench
) -> None:
    """With black pixels that leak b of the light, the sum of k such frames is 1 + (k - 1) b of the uniform one; the
    brightest pixel of that fills the part of the full well that was asked for. (Planted: the run's exposure stated.)"""
    shots = light.expose(patterns, closing_frame="uniform", exposure_fraction=0.5)
    seconds, black = shots.manifest.closing_frame.exposure_s, light.simulation.physics.black_level
    expected, summed = shots.read("closing.exr")[0]["electrons"], shots.electrons[:shown].astype(float).sum(axis=0)
    uniform = expected * (shots.exposure_s / seconds) * (1 + (shown - 1) * black)
    assert np.linalg.norm(uniform - summed) < 1e-5 * np.linalg.norm(summed)
    well, dark = bench.sensor.superpixel_full_well_e, bench.sensor.superpixel_dark_current_e_per_s * seconds
    assert expected.max() + dark == pytest.approx(0.5 * well, rel=1e-5)
    short = light.expose(patterns, closing_frame="uniform", exposure=seconds / 10)
    assert short.manifest.closing_frame.exposure_s == seconds / 10, "it fits the run's exposure, which it has then"


def test_an_interrupted_run_is_resumed_with_its_closing_frame(bench: Bench, tmp_path: Path) -> None:
    """Light by class, as a capture traces it: to the bit."""
    request = {"accuracy": ACCURACY, "seed": 5, "closing_frame": "uniform"}
    whole = bench.capture("dots:3", tmp_path / "run", **request)
    kept = {name: (tmp_path / "run" / name).read_bytes() for name in whole.files}
    for name in ("closing.exr", "frame_00004.exr"):
        (tmp_path / "run" / name).unlink()
    bench.capture("dots:3", tmp_path / "run", resume=True, **request)
    assert {name: (tmp_path / "run" / name).read_bytes() for name in whole.files} == kept
    alone = bench.light("dots:3", accuracy=ACCURACY, seed=5).expose("dots:3", closing_frame="uniform")
    found, expected = (each.read("closing.exr")[0]["electrons"] for each in (whole, alone))
    assert np.linalg.norm(found - expected) < 3 * ACCURACY * np.linalg.norm(expected)


def test_another_kind_is_refused(light: Light) -> None:
    with pytest.raises(ArgumentError, match=r"closing_frame 'last': give 'first' or 'uniform'"):
        light.expose("dots:3", closing_frame="last")

"""The ambient frame: what it holds, how often it is taken, that it is taken off, and what is said where it is not.

Small scenes of 16 x 16 projector pixels and 64 x 64 sensor pixels; seeds stated. Lamps are the test's own: a ceiling
lamp at the side, a second one in another corner, a constant sky.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.acquire.exposure import Exposer, ambient_shots
from mitsim.api.bench import Bench, open_bench
from mitsim.core.exr import checksum, read_frame
from mitsim.core.runs import Capture
from mitsim.devices.patterns import parse_patterns
from mitsim.light.light import SampledLight
from mitsim.light.passes import Simulation
from mitsim.sensor.chain import frame_moments

pytestmark = pytest.mark.usefixtures("kept_plans")
N, ACCURACY = 16, 3e-3
LAMPS = """<default name="lamp" value="15"/>
<shape type="rectangle">
    <transform name="to_world"><scale x="60" y="40"/> <rotate x="1" angle="90"/> <translate x="-80" y="300" z="250"/>
    </transform>
    <emitter type="area"><spectrum name="radiance" value="$lamp"/></emitter>
</shape>
<shape type="rectangle">
    <transform name="to_world"><scale x="25" y="25"/> <rotate x="1" angle="-70"/> <translate x="150" y="-220" z="260"/>
    </transform>
    <emitter type="area"><spectrum name="radiance" value="$lamp"/></emitter>
</shape>"""


@pytest.fixture(scope="module")
def scene(shared_scene: Callable[..., Path]) -> Path:
    # Texels of half a millimetre, 15 a side of a projector pixel, which is even then, as the model has it.
    print_ = np.pad(np.kron(np.random.default_rng(4).integers(20, 256, (N, N)), np.ones((15, 15))), 8, mode="edge")
    return shared_scene("lamps", reflectance=print_, extra=LAMPS)


@pytest.fixture(scope="module")
def bench(scene: Path, variant: str) -> Bench:
    return open_bench(scene, variant)


@pytest.fixture(scope="module")
def light(bench: Bench) -> SampledLight:
    return bench.light("dots:4", accuracy=ACCURACY, seed=2)


@pytest.fixture(scope="module")
def captured(light: SampledLight, tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return light.expose("dots:4", tmp_path_factory.mktemp("ambient") / "run")


def test_the_folder_carries_it(captured: Capture) -> None:
    folder, block = captured.folder, captured.manifest.ambient_frame
    assert folder is not None and block is not None and block.file == "ambient.exr" and block.shots == 16
    assert captured.manifest.checksums["ambient.exr"] == checksum(folder / "ambient.exr")
    assert not captured.warnings and captured.summary()["ambient_frame"] == block.model_dump()
    channels, metadata = read_frame(folder / "ambient.exr")
    assert set(channels) == {"DN", "electrons"} and metadata["shots"] == 16
    # What the frames hold beyond the projector's light: of all light, as the manifest says.
    part = len(captured.electrons) * channels["electrons"].astype(float).sum() / captured.electrons.astype(float).sum()
    assert block.part == pytest.approx(part, rel=1e-5) and 0.1 < part < 0.9
    assert json.loads((folder / "manifest.json").read_text())["ambient_frame"]["shots"] == 16


def test_the_error_is_stated_relative_to_the_projectors_light(
    captured: Capture, light: SampledLight, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the norms of the frames with and without ambient light; flagged where lamps dilute it too far."""
    off = read_frame(captured.folder / "ambient.exr")[0]["electrons"].astype(float)
    electrons = captured.electrons.astype(float)
    diluted = np.linalg.norm(electrons) / np.linalg.norm(electrons - off)
    manifest = captured.manifest
    assert diluted > 1.1
    assert manifest.total_error_of_projector == pytest.approx(manifest.total_error_bound * diluted, rel=1e-4)
    monkeypatch.setattr("mitsim.acquire.capture._DILUTED", 1e-6)
    (warning,) = light.expose("dots:2").warnings
    assert "relative to the projector's light alone, the error is up to" in warning


def test_it_holds_the_lamps_light_alone(captured: Capture, light: SampledLight) -> None:
    """The expected frame is that of a scene whose projector gives nothing, contrast ratio 100 or not."""
    expected = light.frames(parse_patterns("dots:4", N).lighting, 2)
    shown = np.stack([frame.irradiance for frame in expected])
    off = expected.projector_off.irradiance
    assert off.min() > 0 and (shown - off).min() > -1e-9 * off.max()
    exposer = Exposer(light.bench.devices, captured.exposure_s, 0)
    electrons = read_frame(captured.folder / "ambient.exr")[0]["electrons"]
    assert electrons == pytest.approx(exposer.electrons(expected.projector_off), rel=1e-6)
    # Light is linear: all dots together are uniform light, and 15 times what black pixels leak; ambient light once.
    white = next(iter(light.frames(parse_patterns("uniform", N).lighting, 2))).irradiance
    together = off + (1 + 15 * light.simulation.physics.black_level) * (white - off)
    assert shown.sum(axis=0) - 15 * off == pytest.approx(together, rel=1e-6)


def test_black_pixels_leak_into_frames_but_not_into_it(light: SampledLight) -> None:
    """At a contrast of 20 the frames are brighter, and the ambient frame is the same to the last bit."""
    bench = light.bench
    grey = replace(
        bench, devices=replace(bench.devices, projector=bench.projector.model_copy(update={"contrast_ratio": 20.0}))
    )
    settings = replace(light.plan.settings, effects=light.plan.settings.effects | {"black-level"})
    leaky = replace(light, simulation=Simulation(grey, settings))
    assert leaky.simulation.physics.black_level == pytest.approx(0.05)
    frames = [each.frames(parse_patterns("dots:4", N).lighting, 2) for each in (light, leaky)]
    assert np.array_equal(*(each.projector_off.irradiance for each in frames))
    sums = [sum(frame.irradiance.sum() for frame in each) for each in frames]
    assert sums[1] > 1.1 * sums[0]


def test_frames_of_grey_pictures_are_sums_of_single_pixels(light: SampledLight, tmp_path: Path) -> None:
    """Each pixel shines between black and white by the tone curve; lamps shine once.

    (Planted: the tone curve left out; black added to grey pixels in place of mixed.)
    """
    devices = {"contrast_ratio": 20.0, "tone_curve": 2.2}
    bench = replace(
        light.bench, devices=replace(light.bench.devices, projector=light.bench.projector.model_copy(update=devices))
    )
    settings = replace(light.plan.settings, effects=light.plan.settings.effects | {"black-level"})
    leaky = replace(light, simulation=Simulation(bench, settings))
    levels = np.rint(np.outer(np.linspace(0, 255, N), np.linspace(0.2, 1, N))).astype(np.uint8)
    np.save(tmp_path / "grey.npy", levels)
    (shown,) = leaky.frames(bench.family(str(tmp_path / "grey.npy")).lighting, 2)
    single = leaky.frames(parse_patterns(f"dots:{N}", N).lighting, 2)
    off, black = single.projector_off.irradiance, 0.05
    white = next(iter(leaky.frames(parse_patterns("uniform", N).lighting, 2))).irradiance - off
    expected = off + black * white
    for level, frame in zip(levels.ravel().tolist(), single, strict=True):
        expected = expected + (level / 255) ** 2.2 * (frame.irradiance - off - black * white)
    assert shown.irradiance == pytest.approx(expected, rel=1e-5)


def test_its_noise_is_what_it_says(light: SampledLight, captured: Capture) -> None:
    """Mean residual over 4096 pixels of 16 shots, in units of its deviation: normal to five of it.

    The variance is that of the mean's own light, and of no shot. (Planted: variance of one shot; one stream for all
    shots; the sum instead of the mean.)
    """
    sensor = light.bench.sensor
    channels, _ = read_frame(captured.folder / "ambient.exr")
    mean, variance = frame_moments(channels["electrons"], captured.exposure_s, sensor)
    scores = (channels["DN"] - mean) / np.sqrt(variance / 16)
    assert abs(scores.mean()) < 5 / np.sqrt(scores.size) and abs(scores.std() - 1) < 5 / np.sqrt(2 * scores.size)
    ambient, unit = captured.ambient, sensor.gain_dn_per_e * captured.exposure_s
    assert ambient is not None and ambient.shots == 16
    assert ambient.variance == pytest.approx(variance / 16 / unit**2, rel=0.1), "known to its own noise"
    assert ambient.variance.mean() == pytest.approx((variance / 16 / unit**2).mean(), rel=1e-3)


def test_it_is_taken_off_each_frame(captured: Capture) -> None:
    """Measurements have the mean of the projector's light: residuals of 16 x 4096 pixels within five deviations."""
    off = captured.read("ambient.exr")[0]["electrons"].astype(float)
    scores = []
    for index, (rate, _, _) in enumerate(captured.measurements()):
        expected = (captured.electrons[index] - off) / captured.exposure_s
        scores.append((rate - expected) * captured.exposure_s / np.sqrt(captured.electrons[index]))
    scores = np.stack(scores)
    assert abs(scores.mean()) < 5 * np.sqrt((1 + 16 / 16) / scores.size), "the ambient frame's noise is common to all"
    assert 0.9 < scores.std() < 1.5


@pytest.mark.parametrize(
    ("patterns", "shots"),
    [("uniform", 16), ("dots:4", 16), ("dots:7", 16), ("random:2", 36), ("random:4", 100), ("random:32", 4096)],
)
def test_shots_follow_how_alike_patterns_are(patterns: str, shots: int) -> None:
    """16 where each pixel is lit once. K random patterns a side light half of the pixels each, so a pixel is lit in
    1 + (K - 1) / 2 of them, on average over those that light it: 16 ((K + 1) / 2)^2, within 15 %; at most 4096."""
    found = ambient_shots(parse_patterns(patterns, 128))
    assert found == pytest.approx(shots, rel=0.15 if "random" in patterns else 0)


def test_it_is_taken_where_it_helps(light: SampledLight) -> None:
    """A signed pair's difference has no ambient light, and taking a frame off both halves would change nothing."""
    pairs, asked = light.expose("hadamard:4"), light.expose("hadamard:4", ambient_frame="yes")
    assert pairs.manifest.ambient_frame is None and pairs.summary()["ambient_frame"] is None and not pairs.warnings
    assert asked.manifest.ambient_frame is not None and asked.ambient is not None
    for (a, *_), (b, *_) in zip(pairs.measurements(), asked.measurements(), strict=True):
        assert np.array_equal(a, b)


def test_frames_in_another_order_are_the_same_frames(light: SampledLight) -> None:
    """Noise belongs to a pattern, not to its place. (Planted: streams by a shot's number.)"""
    frames = list[dict[tuple[int, int, int], np.ndarray]]()
    for run in map(light.expose, ("hadamard:4", "hadamard:4:cake-cutting")):
        shots = [(shot.row, shot.column, shot.sign) for shot in run.manifest.patterns.captures]
        frames.append(dict(zip(shots, run.dn, strict=True)))
    assert [*frames[0]] != [*frames[1]] and all(np.array_equal(dn, frames[1][shot]) for shot, dn in frames[0].items())


def test_without_it_the_run_is_flagged(light: SampledLight) -> None:
    """The image would be wrong, in silence; `no` is for those who take it off by themselves."""
    (warning,) = light.expose("dots:2", ambient_frame="no").warnings
    assert "ambient" in warning and "not subtracted" in warning
    assert not light.expose("hadamard:2", ambient_frame="no").warnings


def test_a_dark_room_needs_none(shared_scene: Callable[..., Path], variant: str) -> None:
    dark = open_bench(shared_scene("dark"), variant)
    light = dark.light("dots:2", accuracy=0.1)
    assert light.expose("dots:2").manifest.ambient_frame is None
    assert not light.expose("dots:2", ambient_frame="no").warnings
    taken = light.expose("dots:2", ambient_frame="yes")
    assert taken.ambient is not None and taken.manifest.ambient_frame.part == 0
    noise = np.sqrt(taken.ambient.variance) * taken.exposure_s
    assert np.abs(taken.ambient.rate * taken.exposure_s).max() < 6 * noise.max()

"""Frames behind colour filters are sums of the lines' own; calibrations behind them are those of bare pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mitsim.acquire import spectral
from mitsim.acquire.spectral import MosaicFrames, MosaicLight, without_filters
from mitsim.api.bench import Bench, open_bench
from mitsim.bench.request import SessionRequest, Task
from mitsim.calibrate import calibrate
from mitsim.calibrate.board_session import LitSession, Session
from mitsim.calibrate.calibrate import NOISE_FREE, NOISY, estimates
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.devices.patterns import Lighting
from mitsim.devices.projector import CountedLamps, Response, Spectrum
from mitsim.devices.sensor import EfficiencyCurve, MosaicCurves
from mitsim.devices.session import load_recipe
from mitsim.light.light import SampledLight, Truth
from mitsim.light.passes import Grid, Simulation
from mitsim.light.settings import Settings
from mitsim.optics.frames import Frame
from mitsim.reconstruct.colour import behind
from mitsim.transport.records import AMBIENT, DIRECT, PathSamples

WEIGHTS = np.array([[0.4, 0.1], [0.2, 0.3], [0.2, 0.3], [0.1, 0.5]])


class Frames:
    """Expected frames as they are given; iterate as often as needed."""

    def __init__(self, frames: list[Frame]) -> None:
        self.frames = frames

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)


def test_a_pixel_counts_each_line_by_its_filter() -> None:
    rng = np.random.default_rng(1)
    lines = [[Frame(rng.random((4, 4)), 0.0, 0.0, 0.0) for _ in range(2)] for _ in range(2)]
    seen = list(MosaicFrames([Frames(line) for line in lines], behind(WEIGHTS, (4, 4))))  # type: ignore[arg-type, misc]
    for shot in range(2):
        first, second = (line[shot].irradiance for line in lines)
        assert seen[shot].irradiance[0, 0] == pytest.approx(0.4 * first[0, 0] + 0.1 * second[0, 0])
        assert seen[shot].irradiance[2, 1] == pytest.approx(0.2 * first[2, 1] + 0.3 * second[2, 1])
        assert seen[shot].irradiance[3, 3] == pytest.approx(0.1 * first[3, 3] + 0.5 * second[3, 3])


def test_errors_of_lines_on_one_path_add_up() -> None:
    """Both lines off by the same part in every group: the sum is off by the sum; and as many parts are told."""
    rng, spread = np.random.default_rng(2), np.sqrt(np.square(WEIGHTS).mean(axis=0))
    off = rng.random(8) - 0.5
    products, parts = np.outer(off, off), off**2
    lines = [Frame(rng.random((4, 4)), scale**2 * parts.sum(), 0.0, 0.0, scale**2 * products) for scale in (1, 3)]
    (seen,) = MosaicFrames([Frames([line]) for line in lines], behind(WEIGHTS, (4, 4)))  # type: ignore[list-item]
    assert seen.variance == pytest.approx((spread[0] + 3 * spread[1]) ** 2 * parts.sum())
    assert seen.by_group == pytest.approx((spread[0] + 3 * spread[1]) ** 2 * products)
    assert seen.heaviest == pytest.approx(parts.max() / parts.sum())


@pytest.mark.parametrize("apart", [True, False])
def test_lamps_are_in_every_frame_and_alone_in_the_dark_one(apart: bool) -> None:
    """Their error is its own, or goes together with the lines'. (Planted: lamps in no frame; errors in squares.)"""
    rng, spread = np.random.default_rng(3), np.sqrt(np.square(WEIGHTS).mean(axis=0))
    own, theirs = (np.outer(*[rng.random(8) - 0.5] * 2) for _ in range(2))
    lines = [Frame(rng.random((4, 4)), np.trace(own), removed, 0.0, own) for removed in (0.1, 0.2)]
    lamps = Frame(rng.random((4, 4)), np.trace(theirs), 0.3, 0.0, theirs)
    passed, given = behind(WEIGHTS, (4, 4)), [Frames([line]) for line in lines]
    frames = MosaicFrames(given, passed, lamps, apart)  # type: ignore[arg-type]
    (dark,) = MosaicFrames(given, passed)  # type: ignore[arg-type]
    (lit,) = frames
    assert frames.has_ambient and frames.projector_off.irradiance is lamps.irradiance
    assert frames.projector_off.by_group.tolist() == [[0.0]]
    assert lit.irradiance == pytest.approx(dark.irradiance + lamps.irradiance)
    root = spread.sum() * np.sign(own) * np.sqrt(abs(own)) + np.sign(theirs) * np.sqrt(abs(theirs))
    assert lit.by_group == pytest.approx(dark.by_group + theirs if apart else root * abs(root))
    assert lit.variance == pytest.approx(np.trace(lit.by_group)) and (lit.removed, dark.removed) == (0.3, 0.2)


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str) -> Bench:
    return open_bench(shared_scene("mosaic", n=16), variant)


def coloured(bench: Bench) -> Bench:
    """The bench's camera under a mosaic that passes a tenth to half of the light."""
    flat = {
        name: EfficiencyCurve(wavelengths_nm=(400.0, 700.0), efficiency=(part, part))
        for name, part in {"R": 0.5, "G": 0.2, "B": 0.1}.items()
    }
    change = {"mosaic": "RGGB", "mosaic_curves": MosaicCurves(**flat), "quantum_efficiency": None, "binning": 1}
    sensor = bench.sensor.model_copy(update=change)
    return replace(bench, devices=replace(bench.devices, sensor=sensor))


def test_a_session_behind_filters_tells_the_bare_camera(bench: Bench, kept_plans: None) -> None:
    """Its factors are those without filters, within what their noise predicts; its noise is what it says it is."""
    passed = behind(np.array([[0.5], [0.2], [0.2], [0.1]]), (bench.geometry.pixels,) * 2)[0]
    job, recipe = Job(), load_recipe()
    session = Session(bench, recipe, 0, filters=passed)
    plan = session.plan(1e-2, job)
    lit = LitSession.of(session, session.trace(plan, job)[0], job)
    (noisy, clean), saturated, _ = estimates(lit, job, (NOISY, NOISE_FREE))
    assert saturated == 0
    for name, predicted in zip(("left", "right"), noisy.predicted_error, strict=True):
        found, exact = getattr(noisy, name), getattr(clean, name)
        error = np.linalg.norm(found - exact) / np.linalg.norm(exact)
        # 64 x 16 numbers: their rms is known to a few percent; what is common to them is left out of the prediction.
        assert 0.6 < error / predicted < 1.5
    # Of 2 x 32 responses of 64 x 64 pixels the noise's variance is known to 0.3 %.
    assert noisy.noise == pytest.approx(lit.response_noise, rel=0.02)
    # The brightest pixel behind its filter fills the well, so light is gathered longer than without.
    bare = Session(bench, recipe, 0)
    assert lit.exposure_s == pytest.approx(2 * LitSession.of(bare, lit.light, job).exposure_s, rel=0.1)


def test_a_session_behind_filters_repeats_its_frames_by_default(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Four times, where no recipe is given; each line's light passes by its filter, and all of it without filters.
    (Seen: TypeError, because the request is no dataclass.)"""
    asked, seen, about = list[Any](), coloured(bench), SimpleNamespace(wavelengths_nm=(500.0, 600.0))
    monkeypatch.setattr(calibrate, "_run_sessions", lambda lines, *_: asked.extend(lines) or lines)
    for own, whole in ((seen, without_filters(seen)), (bench, bench)):
        lines = SimpleNamespace(manifest=about, names=("a", "b"), benches=(bench, bench), whole=whole)
        monkeypatch.setattr(calibrate, "SpectralBench", SimpleNamespace(of=lambda *_, lines=lines: lines))
        sessions: Any = calibrate.calibrate_lines(own, SessionRequest(), Task(None, False, Job()), own is seen)
        if own is seen:
            assert [each.filters[:2, :2].tolist() for each in sessions.values()] == [[[0.5, 0.2], [0.2, 0.1]]] * 2
    assert sessions["a"].filters is None and asked[0].recipe.repeats == 4


def test_only_a_camera_with_filters_has_a_mosaic(bench: Bench) -> None:
    with pytest.raises(MitsimError, match=r"imx249.toml: has no mosaic of colour filters, and colour mosaic was asked"):
        bench.capture_mosaic("dots:2")
    with pytest.raises(MitsimError, match="knows no wavelengths; open the bench with llvm_ad_spectral"):
        coloured(bench).calibrate_mosaic()
    for mono in (lambda: coloured(bench).capture("dots:2"), lambda: coloured(bench).calibrate()):
        with pytest.raises(MitsimError, match="has a mosaic RGGB, whose frames show all lines at once; capture and"):
            mono()


def test_lamps_are_seen_by_each_pixel_through_its_filter(shared_scene: Callable[..., Path], variant: str) -> None:
    """A spot of each band of each colour of filters, in every line's light: at pixels of that colour, diffracted by the
    band's wavelengths, once. (Planted: a filter's light at all pixels; lines' lamps left in; one filter's bands for
    all.)
    """
    scene = shared_scene("lit mosaic", extra='<emitter type="constant"/>')
    seen = without_filters(coloured(open_bench(scene, variant)))
    responses = Response.of_each(seen.counting)
    assert [response.planes for response in responses] == [(0,), (1, 2), (3,)]
    spectra = tuple(Spectrum(np.array([nm]), np.ones(1)) for nm in np.linspace(420.0, 690.0, 12))
    units = ((600.0, 2e-4), (500.0, 5e-4))
    counted_lamps = CountedLamps(responses, ((400.0, 700.0),) * 12, spectra, np.full(12, 1 / 12), units=units)
    settings = Settings(depth=400.0, effects=frozenset({"ambient", "diffraction"}))
    rng, n = np.random.default_rng(4), seen.n
    counts, none, place = rng.random(12), np.zeros(12, np.int64), np.linspace(-0.03, 0.03, 12)
    parts = np.repeat([response.part for response in responses], 4)
    lights = []
    for nm, unit in units:
        own = replace(seen, devices=replace(seen.devices, projector=seen.projector.at(nm)), counted_lamps=counted_lamps)
        simulation = Simulation(own, settings)
        lamps = PathSamples(
            n**2 + np.arange(12), none, none, place, place[::-1], place * 0 + 0.0025, counts * parts * unit,
            np.full(12, AMBIENT, np.int16),
        )  # fmt: skip
        spot = PathSamples(
            none[:1], none[:1], none[:1], place[3:4], place[5:6], place[:1] * 0 + 0.0025, np.array([unit]),
            np.full(1, DIRECT, np.int16),
        )  # fmt: skip
        accumulated = simulation.accumulate("indirect", PathSamples.join([lamps, spot]), none[:1].repeat(n**2), 1)
        plan: Any = SimpleNamespace(settings=settings)
        zeros = np.zeros(n**2)
        # Reflectances of 0.6 and 0.5, of boards of light 1 and 3.
        truth = Truth(np.full((n, n), nm / 1e3), np.zeros((n, n)), np.full(n**2, 13 - nm / 50), 1)
        light = SampledLight((accumulated,), simulation, plan, 0, none[:1].repeat(n**2), zeros, zeros, 1, 0.0, True)
        lights.append(replace(light, known_truth=truth))
    whole = MosaicLight.of(replace(seen, counted_lamps=counted_lamps), lights, [nm for nm, _ in units])
    lighting = Lighting(none[:1].repeat(n**2), np.ones((1, 1)))
    expected = np.zeros(seen.geometry.frame_shape)
    for band, spectrum in enumerate(spectra):
        row = lights[0].groups[0]["fine"][[1 + band]].tocsr()
        alone = Grid(lights[0].simulation.grids["fine"].bundle, seen.geometry, spectrum).optics.frame(
            row.indices, row.data
        )
        for a, b in [divmod(plane, 2) for plane in responses[band // 4].planes]:
            # Of unit irradiance of the first line, one electron a photon of the projector's wavelength.
            scale = 1 / (units[0][1] * parts[band] * seen.projector.effective_wavelength_nm)
            expected[a::2, b::2] += scale * alone[a::2, b::2]
    frames = whole.frames(lighting, 0)
    assert frames.projector_off.irradiance == pytest.approx(expected, rel=1e-9, abs=1e-12 * expected.max())
    (lit,), off = frames, [light.frames(lighting, 0) for light in lights]
    lines = [next(iter(each)).irradiance - each.projector_off.irradiance for each in off]
    weights = np.array(seen.counting.planes([nm for nm, _ in units])) * [nm for nm, _ in units]
    passed = behind(weights / seen.projector.effective_wavelength_nm, expected.shape)
    assert lit.irradiance - expected == pytest.approx(np.einsum("lij,lij->ij", passed, np.array(lines)), rel=1e-6)
    counted = passed.mean(axis=(1, 2)) * [1.0, 3.0]
    assert whole.apparent.board_flux == pytest.approx(counted.sum())
    assert whole.apparent.reflectance == pytest.approx(counted @ [0.6, 0.5] / counted.sum())


def test_lamps_behind_filters_are_sampled_until_each_filters_light_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the light of every filter is three times less certain than all light, the error is three times larger; it
    is never smaller, and without lamps it is what it is. (Planted: errors multiplied; lamps without bands.)"""
    names, rows = (SimpleNamespace(part=0.25), SimpleNamespace(part=0.5)), [slice(0, 2), slice(2, 4)]
    lamps = SimpleNamespace(responses=names, rows=rows.__getitem__, shares=np.array([0.1, 0.2, 0.3, 0.4]))
    for counted, each, whole, expected in (
        (lamps, 0.03, 0.01, 3.0), (lamps, 0.005, 0.01, 1.0), (lamps, 0.03, 0.0, 1.0), (None, 0.03, 0.01, 1.0),
    ):  # fmt: skip

        def alone(_: Any, bands: slice, __: int, each: float = each, whole: float = whole) -> Any:
            return SimpleNamespace(sampling_error=lambda: (whole if bands == slice(None) else each, 0))

        monkeypatch.setattr(spectral, "_lamps_alone", alone)
        light: Any = SimpleNamespace(bench=SimpleNamespace(counted_lamps=counted), seed=1)
        assert spectral.excess_behind_filters([light]) == pytest.approx(expected)


@pytest.mark.parametrize("part", [{"rows": 63}, {"roi": (0, 3, 20, 20)}, {"roi": (2, 0, 21, 20)}])
def test_frames_that_cut_through_filters_are_refused(bench: Bench, part: dict[str, object]) -> None:
    """An odd side, and a region that begins at another filter. (Planted: where a region begins not looked at.)"""
    seen = coloured(bench)
    devices = replace(seen.devices, camera=seen.devices.camera.model_copy(update=part))
    with pytest.raises(MitsimError, match=r"do not hold whole filters of 2 x 2; give the scene's film even numbers"):
        without_filters(replace(seen, devices=devices))


def test_a_bench_behind_filters_says_which_camera_it_has(bench: Bench) -> None:
    """The sensor's own identity, filters and all, though frames are formed of bare pixels."""
    seen = without_filters(coloured(bench))
    assert seen.identity()["sensor"]["mosaic"] == "RGGB" and seen.sensor.quantum_efficiency == 1.0
    assert seen.identity()["geometry"] == bench.identity()["geometry"]

"""The first look at lamps: what it makes of light that is given, band by band. Nothing is traced."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mitsim.acquire import spectral as counted_lamps
from mitsim.core.seeds import integer
from mitsim.devices.projector import SPECTRA_NM, Lines, Response, line_units
from tests.invented import sensor

LINES = Lines((638.0, 445.0), (0.5, 0.5))
N = 40


def spectrum(wavelengths: np.ndarray) -> np.ndarray:
    """Light by wavelength: nothing from 500 to 600 nm, and a straight line elsewhere."""
    return np.where((wavelengths > 500) & (wavelengths < 600), 0.0, 1 + wavelengths / 100)


def between(low: float, high: float, of: Callable[[np.ndarray], np.ndarray] = spectrum) -> float:
    """Integral from ``low`` to ``high`` [nm]."""
    middles = low + (high - low) * (np.arange(4000) + 0.5) / 4000  # to 1e-4 of light that begins or ends there
    return float(of(middles).mean() * (high - low))


@dataclass
class Tracer:
    """Path samples two entries of each band, a quarter and the rest of it, and says what it was asked for."""

    like: Any
    counted: Any
    of = staticmethod(spectrum)
    asked = []  # noqa: RUF012

    def trace(self, seed: int, first: int, samples: int) -> Any:
        self.asked.append((seed, first, samples))
        light = np.array([between(*band, self.of) for band in self.counted.bands])
        pixel = np.tile(np.arange(len(light)) + 16**2, 2)
        return SimpleNamespace(pixel=pixel, value=samples * np.concatenate([light / 4, 3 * light / 4]))


@dataclass
class OfBench:
    """What is asked of a bench."""

    counting: Any
    n: int = N
    counted_lamps: Any = None
    lamps: bool = True

    @property
    def loaded(self) -> Any:
        return SimpleNamespace(lamps=self.lamps)

    @property
    def geometry(self) -> Any:
        return SimpleNamespace(scene_distance=410.0)

    @property
    def projector(self) -> Any:
        return SimpleNamespace(lines=LINES)


class Followed:
    """The tracer of a simulation."""

    projector = SimpleNamespace(n=16)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, int]]:
    """Settings and pixels of the simulations that are made."""
    found: list[tuple[Any, int]] = []

    def simulation(bench: Any, settings: Any, pixels: int) -> Any:
        found.append((settings, pixels))
        return SimpleNamespace(from_camera=Followed())

    monkeypatch.setattr(counted_lamps, "Simulation", simulation)
    monkeypatch.setattr(counted_lamps, "FromCameraTracer", Followed)
    monkeypatch.setattr(counted_lamps, "LampTracer", Tracer)
    monkeypatch.setattr(counted_lamps, "present", lambda bench: ("ambient", "diffraction", "blur"))
    monkeypatch.setattr(Tracer, "of", staticmethod(spectrum))
    monkeypatch.setattr(Tracer, "asked", [])
    return found


def camera(first: float = 400.0, last: float = 800.0, **changes: object) -> Any:
    curve = {"wavelengths_nm": [first, last], "efficiency": [0.5, 0.5]}
    return sensor(**{"quantum_efficiency": None, "quantum_efficiency_curve": curve, **changes})


def test_a_look_tells_bands_apart_and_what_is_beyond_them(made: list[tuple[Any, int]]) -> None:
    """Shares are integrals over the bands, their spectra those over fifths of 20 nm, none of which has no light; what
    no band counts goes on as it ends. (Planted: parts one after another; light beyond either end alone.)"""
    bench: Any = OfBench(camera(400.0, 800.0))
    found = counted_lamps.lit_by_lamps(bench, {"blur": False}, 3).counted_lamps
    ((settings, pixels),) = made
    assert pixels == 32 and settings.depth == 410 and settings.effects == {"ambient", "diffraction"}
    assert set(Tracer.asked) == {(integer(3, "lamplight"), 0, 16)} and len(Tracer.asked) == 6
    bands = [(400.0, 500.0), (500.0, 600.0), (600.0, 700.0), (700.0, 800.0)]
    light = np.array([between(*band) for band in bands])
    assert found.bands == tuple(bands) and found.shares == pytest.approx(light / light.sum(), rel=1e-9)
    for (low, _), spectrum_of_band in zip(bands, found.spectra, strict=True):
        edges = low + 20.0 * np.arange(6)
        parts = np.array([between(*ends) for ends in pairwise(edges)])
        assert list(spectrum_of_band.wavelengths_nm) == list(edges[:5] + 10)
        assert spectrum_of_band.weights == pytest.approx(parts / parts.sum() if parts.any() else np.full(5, 0.2))
    beyond = between(SPECTRA_NM[0], 400) + between(800, SPECTRA_NM[1])
    assert found.unknown == pytest.approx(beyond / (beyond + light.sum()), rel=1e-9)
    assert found.units == tuple(zip(LINES.wavelengths_nm, line_units(bench.counting, LINES), strict=True))
    assert found.responses == (Response.of(bench.counting),)


def test_parts_of_a_band_without_light_are_left_out(
    made: list[tuple[Any, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """(Planted: kept.)"""
    monkeypatch.setattr(Tracer, "of", staticmethod(lambda at: np.where(at < 430, 0.0, 1.0)))
    first, *_ = counted_lamps.lit_by_lamps(OfBench(camera()), {}, 0).counted_lamps.spectra  # type: ignore[arg-type, union-attr]
    assert first.wavelengths_nm == pytest.approx([430, 450, 470, 490]) and first.weights == pytest.approx(
        np.array([10, 20, 20, 20]) / 70, rel=0.01
    )


def test_a_curve_that_goes_on_farther_than_spectra_has_unknown_light(made: list[tuple[Any, int]]) -> None:
    """As much a nanometre as in the last ten. (Planted: as much in all as in these.)"""
    bench: Any = OfBench(camera(360.0, 930.0))
    found = counted_lamps.lit_by_lamps(bench, {}, 0).counted_lamps
    beyond = between(820, 830) / 10 * Response.of(bench.counting).beyond_nm
    assert found.unknown == pytest.approx(beyond / (beyond + between(*SPECTRA_NM)), rel=1e-3)
    whole: Any = OfBench(camera(360.0, 830.0))
    assert counted_lamps.lit_by_lamps(whole, {}, 0).counted_lamps.unknown == 0


def test_pixels_behind_filters_share_the_light(made: list[tuple[Any, int]], monkeypatch: pytest.MonkeyPatch) -> None:
    """Each band by the part of the pixels that count it; what is not known is that of the worst filter; even where it
    is dark. (Planted: each colour as much; the best filter.)"""
    curves = {
        name: {"wavelengths_nm": [first, 800.0], "efficiency": [0.5, 0.5]}
        for name, first in {"G": 400.0, "R": 420.0, "B": 440.0}.items()
    }
    bench: Any = OfBench(camera(mosaic="GBRG", mosaic_curves=curves, quantum_efficiency_curve=None, binning=1))
    found = counted_lamps.lit_by_lamps(bench, {}, 0).counted_lamps
    lights = [
        part * between(low, high)
        for first, part in ((400.0, 0.5), (440.0, 0.25), (420.0, 0.25))
        for low, high in pairwise(np.linspace(first, 800, 5))
    ]
    assert len(found.bands) == len(found.spectra) == 12
    assert found.shares == pytest.approx(np.array(lights) / sum(lights), rel=1e-3)
    missing = between(SPECTRA_NM[0], 440.0) + between(800, SPECTRA_NM[1])
    assert found.unknown == pytest.approx(missing / (missing + between(440, 800)), rel=1e-3)
    monkeypatch.setattr(Tracer, "of", staticmethod(np.zeros_like))
    dark = counted_lamps.lit_by_lamps(bench, {}, 0).counted_lamps
    assert dark.shares == pytest.approx(np.full(12, 1 / 12)) and dark.unknown == 0


def test_a_bench_without_lamps_stays_as_it_is(made: list[tuple[Any, int]]) -> None:
    """And one whose lamps are switched off; few pixels are looked at one by one."""
    dark: Any = OfBench(camera(), lamps=False)
    lit: Any = OfBench(camera(), n=5)
    assert (
        counted_lamps.lit_by_lamps(dark, {}, 0) is dark
        and counted_lamps.lit_by_lamps(lit, {"ambient": False}, 0) is lit
    )
    assert counted_lamps.lit_by_lamps(lit, {"ambient": True}, 0) is not lit and [pixels for _, pixels in made] == [5]

"""Lamps of known spectra over a matt sheet, as a camera of known efficiency counts them, against integrals.

The geometry is that of ``test_lamps``: a point lamp, a sheet at 400 mm, an open mask. What a line's run sees is

    integral I(lambda) rho(lambda) eta(lambda) lambda dlambda / (470 nm eta_l lambda_l)

times what it sees of a lamp of intensity 1 over a sheet of reflectance 1; I / 470 nm is the lamp's spectral intensity.
"""

import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.acquire.spectral import SpectralBench
from mitsim.api.bench import open_bench
from mitsim.core.colour_files import MOST_LINES, RUN
from mitsim.devices.projector import SPECTRA_NM
from mitsim.light.passes import Simulation
from mitsim.light.settings import Settings
from mitsim.transport.from_camera import CombinedTracer, FromCameraTracer, LampTracer
from mitsim.transport.integrator import Paths
from tests.conftest import write_small_scene
from tests.system.conftest import CAMERA
from tests.unit.bench.test_lamps import ALBEDO, POSITION, seen
from tests.unit.transport.closed_forms import in_child

LAMPS = {
    "flat": '<spectrum name="intensity" value="3e4"/>',
    "coloured": '<spectrum name="intensity" value="400:1e4, 500:6e4, 505:2e5, 510:6e4, 650:2e4, 800:5e4"/>',
    "cie_a": '<spectrum name="intensity" type="blackbody"><float name="temperature" value="2856"/></spectrum>',
    "d65": '<spectrum name="intensity" type="d65"><float name="scale" value="3e4"/></spectrum>',
}
SHEETS = {"grey": "0.5", "coloured": "350:0.2, 550:0.8, 850:0.4"}
CURVE = {420.0: 0.2, 530.0: 0.8, 700.0: 0.3}
"""A camera's electrons per photon."""
LINES = [638.0, 520.0, 445.0]
SHARES = [0.5, 0.3, 0.2]
SEEDS, SAMPLES = 8, 64
CASES = [("flat", "grey", False), ("coloured", "coloured", True), ("cie_a", "grey", False), ("d65", "coloured", True)]


def spectral(lamp: str, wavelengths: np.ndarray) -> np.ndarray:
    """Intensity of a ``lamp``, as Mitsuba's plugins have it."""
    if lamp == "flat":
        return np.full(wavelengths.shape, 3e4)
    if lamp == "coloured":
        known = {400: 1e4, 500: 6e4, 505: 2e5, 510: 6e4, 650: 2e4, 800: 5e4}
        return np.interp(wavelengths, list(known), list(known.values()), 0, 0)
    if lamp == "cie_a":  # Planck's law [W m^-2 sr^-1 nm^-1]
        metres, h, c, k = wavelengths * 1e-9, 6.62607015e-34, 299792458.0, 1.380649e-23
        return 1e-9 * 2 * h * c**2 / metres**5 / np.expm1(h * c / (metres * k * 2856.0))
    import colour

    daylight = colour.SDS_ILLUMINANTS["D65"]
    return 3e4 * np.interp(wavelengths, daylight.wavelengths, daylight.values) / D65_UNIT


D65_UNIT = 98.99741751876255
"""Mitsuba's D65 has a luminance of 1: MI_CIE_D65_NORMALIZATION."""


def counted(
    lamp: str, sheet: str, curve: bool | dict[float, float], low: float = SPECTRA_NM[0], high: float = SPECTRA_NM[1]
) -> float:
    """Integral from ``low`` to ``high`` [nm] of what the camera counts, or pixels of a ``curve``."""
    known = curve if isinstance(curve, dict) else CURVE
    at = np.linspace(low, high, 2 + int((high - low) * 20))
    pairs = dict(map(float, pair.split(":")) for pair in SHEETS[sheet].split(", ")) if sheet == "coloured" else {}
    albedo = np.interp(at, list(pairs), list(pairs.values())) if pairs else ALBEDO
    efficiency = np.interp(at, list(known), list(known.values())) if curve else 0.75
    return float(np.trapezoid(spectral(lamp, at) * albedo * efficiency * at, at) / (SPECTRA_NM[1] - SPECTRA_NM[0]))


def traced(folder: str) -> list[dict[str, Any]]:
    """Light of each case in this process, whose variant is spectral from then on."""
    place, found = Path(folder), []
    (place / "number.toml").write_text(CAMERA)
    table = f"[quantum_efficiency_curve]\nwavelengths_nm = {list(CURVE)}\nefficiency = {list(CURVE.values())}\n"
    (place / "curve.toml").write_text(CAMERA.replace("quantum_efficiency = 0.75\n", "") + table)
    (place / "lines.toml").write_text(
        f'name = "lines"\neffective_wavelength_nm = 550\nwavelengths_nm = {LINES}\nradiant_shares = {SHARES}\n'
    )
    for lamp, sheet, curve in CASES:
        emitter = f'<emitter type="point">{POSITION}{LAMPS[lamp]}</emitter>'
        path = write_small_scene(place, lamp, mask="open", extra=emitter)
        camera = place / ("curve.toml" if curve else "number.toml")
        bench = open_bench(path, "llvm_ad_spectral", camera, place / "lines.toml", albedo=SHEETS[sheet])
        whole = SpectralBench.of(bench, RUN).lit_by_lamps({}, 0).whole
        assert whole.counted_lamps is not None
        simulation = Simulation(whole, Settings(depth=400.0, effects=frozenset({"ambient"})))
        assert isinstance(simulation.from_camera, LampTracer)
        traced_runs = [simulation.from_camera.trace(seed, 0, SAMPLES) for seed in range(SEEDS)]
        lines = [[light.value.sum() / SAMPLES for light in run.by_line(len(LINES))] for run in traced_runs]
        mirrors = FromCameraTracer(simulation.setup, simulation.aim, Paths(mirrors=True))
        mirrored = CombinedTracer(mirrors, simulation.from_camera)
        both = mirrored.trace(0, 0, SAMPLES).by_line(len(LINES)) if lamp == "flat" else []
        labels = np.zeros(whole.n**2, dtype=np.int64)
        accumulated = [
            simulation.accumulate("indirect", run.by_line(3)[2], labels, SAMPLES)["fine"] for run in traced_runs[:1]
        ]
        other = open_bench(path, "llvm_ad_spectral", place / "number.toml", place / "lines.toml", albedo=SHEETS[sheet])
        lamps = SpectralBench.of(other, RUN).lit_by_lamps({}, 0).whole.counted_lamps if lamp == "coloured" else None
        found.append(
            {
                "spectra": [
                    (each.wavelengths_nm.tolist(), each.weights.tolist()) for each in (lamps.spectra if lamps else ())
                ],
                "lines": np.array(lines).tolist(),
                "together": [float(light.value.sum()) / SAMPLES for light in both],
                "accumulated": np.asarray(accumulated[0].sum(axis=1)).tolist(),
                "unknown": whole.counted_lamps.unknown,
            }
        )
    return found


@pytest.fixture(scope="module")
def light(tmp_path_factory: pytest.TempPathFactory) -> Mapping[tuple[str, str, bool], dict[str, Any]]:
    """Light of each case, from one child process: this one has another variant."""
    return dict(zip(CASES, in_child("tests.unit.light.test_lamps", tmp_path_factory.mktemp("lamps")), strict=True))


@pytest.mark.parametrize("case", CASES)
def test_every_line_sees_the_lamp_as_its_closed_form(light: Mapping[Any, dict[str, Any]], case: Any) -> None:
    """Seven standard errors of eight seeds, 1 % at most, and 2e-4 of rounding and of the geometry's judge."""
    *_, curve = case
    ends = (min(CURVE), max(CURVE)) if curve else SPECTRA_NM
    geometry = seen("point") / (ALBEDO * 3e4)
    runs, found = np.array(light[case]["lines"]), light[case]
    for line, wavelength in enumerate(LINES):
        efficiency = np.interp(wavelength, list(CURVE), list(CURVE.values())) if curve else 0.75
        expected = geometry * counted(*case, *ends) / (efficiency * wavelength)
        error = runs[:, line].std(ddof=1) / np.sqrt(SEEDS)
        assert 7 * error < 0.01 * expected
        assert abs(runs[:, line].mean() - expected) < 7 * error + 2e-4 * expected, (case, wavelength)
    assert found["together"] in ([], pytest.approx(runs[0], rel=1e-12)), "beside paths over mirrors, which see none"
    assert sum(found["accumulated"]) == pytest.approx(runs[0, 2], rel=1e-6) and found["accumulated"][0] == 0


def test_light_beyond_a_curve_is_known_to_be_missing(light: Mapping[Any, dict[str, Any]]) -> None:
    """As if the efficiency stayed what it is at the curve's ends. (Planted: none told.)"""
    for case in CASES:
        *_, curve = case
        if not curve:
            assert light[case]["unknown"] == 0
            continue
        ends = min(CURVE), max(CURVE)
        inside, whole = counted(*case, *ends), counted(*case)
        assert light[case]["unknown"] == pytest.approx((whole - inside) / whole, abs=0.01)


def test_a_bands_light_diffracts_like_its_lit_parts(light: Mapping[Any, dict[str, Any]]) -> None:
    """Parts of equal width, at most 24 nm, each with its part of the band's photons; dark ones are left out. To 3 % of
    a band, which is what the paths find. (Planted: parts weighed evenly; parts too fine.)"""
    (spectra,) = [light[case]["spectra"] for case in CASES if case[0] == "coloured"]
    bands = np.linspace(*SPECTRA_NM, MOST_LINES + 1)
    for (begin, end), (wavelengths, weights) in zip(itertools.pairwise(bands), spectra, strict=True):
        edges = np.linspace(begin, end, 1 + math.ceil((end - begin) / 24))
        parts = np.array([counted("coloured", "coloured", False, *ends) for ends in itertools.pairwise(edges)])
        assert wavelengths == pytest.approx(((edges[1:] + edges[:-1]) / 2)[parts > 0])
        assert weights == pytest.approx(parts[parts > 0] / parts.sum(), abs=0.03)

"""Choice of the colours to simulate: mono, bands or lines of light, with its plan.

A monochrome camera that sees all lines l of a projector at once makes electrons from their irradiances E_l in
proportion to sum_l q_l lambda_l E_l, with its quantum efficiency q. A band of lines is simulated as one line at their
mean wavelength; *mono* replaces all by one panchromatic reflectance behind the mean of their shadows. The error of
either is the relative rms difference of its frames from the sum over lines. Both are formed from the same few rays per
projector pixel, so that the difference contains no noise of the geometry; only direct light is compared.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Generic

import numpy as np

from mitsim.acquire.spectral import SpectralBench, line_alone, plan_request
from mitsim.bench.apparatus import Apparatus, Opened, reopen
from mitsim.bench.request import Request, check_untimed
from mitsim.core.arrays import FloatArray
from mitsim.core.manifests import BANDS, LINES, MONO, MOST_LINES, RUN, bands_of, check_undecided, spectral_of
from mitsim.core.seeds import integer
from mitsim.devices.patterns import Lighting
from mitsim.devices.projector import Lines
from mitsim.light.cost_model import traced_for
from mitsim.light.plan import ColourCandidate, ColourChoice, Plan
from mitsim.light.settings import Settings
from mitsim.light.simulation import Simulation, expected_of
from mitsim.transport.records import PathSamples

_RAYS_OF_BANDS, _SHOTS = 4, 4
"""Rays per pixel (a tenth of a second), and shots that are compared."""
_NONE = 1e-6
"""Difference that counts as none in single precision (photograph: 3e-8)."""
_PART = 0.5
"""Part of the accuracy that colours may use: the frames then keep 0.87 of it, at a third more paths."""
_ONCE, _TRACED = ("start", "plan"), ("transport", "truth")
"""Stages that lines share, and stages in which they share paths."""


@dataclass(frozen=True)
class Coloured(Generic[Opened]):
    """The choice, ready for a capture.

    Attributes
    ----------
    plan
        Plan of the frames, with the alternatives (:attr:`Plan.colour`); its accuracy is reduced by the colours' error.
    bench
        Bench in the variant in which the choice is traced, with its projector in the chosen bands.
    """

    plan: Plan
    bench: Opened

    @property
    def mono(self) -> bool:
        """Return True if wavelengths are not distinguished."""
        return self.plan.colour is not None and self.plan.colour.chosen == MONO


def choose_colour(bench: Opened, request: Request) -> Coloured[Opened]:
    """Choose the fastest of mono, bands and lines that is predicted to keep the accuracy.

    See :meth:`mitsim.api.bench.Bench.choose_colour`, also for errors.
    """
    check_untimed(request.seconds)
    check_undecided(bench.variant)
    started, runs = time.perf_counter(), _runs(bench)
    if _in_greys(bench):
        errors, spectral = {name: 0.0 for name in runs if name in (MONO, LINES)}, None
    else:
        pilot = _ColourPilot(bench, request)
        errors, spectral = pilot.errors(runs), pilot.spectral
    most = _PART * request.accuracy
    chosen = next((name for name in errors if errors[name] <= most), min(errors, key=lambda name: errors[name]))
    looked = time.perf_counter() - started
    left = request
    if 0 < errors[chosen] <= most:
        left = request.with_values(accuracy=math.sqrt(request.accuracy**2 - errors[chosen] ** 2))
    if chosen == MONO:
        own = reopen(bench, bench.variant) if spectral else bench
        plan = plan_request(own, left)
    else:
        whole = spectral or reopen(bench, spectral_of(bench.variant))
        own = whole if chosen == LINES else whole.in_bands(bands_of(chosen))
        plan = SpectralBench.of(own, RUN).plan(left)
    plan = plan.taking(plan=plan.predicted["plan"] + looked)
    candidates = tuple(
        ColourCandidate(name, error, _seconds(plan.predicted, runs[chosen], runs[name], bool(bench.loaded.parting)))
        for name, error in errors.items()
    )
    return Coloured(_with_choice(plan, ColourChoice(chosen, candidates), request), own)


def _runs(bench: Apparatus) -> dict[str, int]:
    lines = bench.projector.lines
    bands = range(1, min(len(lines.shining.shares) - 1, MOST_LINES) + 1)
    every = {LINES: len(lines.shares)} if len(lines.shares) <= MOST_LINES else {}
    return {MONO: 1} | {f"{BANDS}:{count}": count for count in bands} | every


def _in_greys(bench: Apparatus) -> bool:
    return not bench.loaded.coloured and bench.sensor.quantum_efficiency_curve is None


def _seconds(predicted: Mapping[str, float], runs: int, others: int, parted: bool) -> float:
    shared = sum(predicted.get(stage, 0.0) for stage in _ONCE)
    traced = sum(predicted.get(stage, 0.0) for stage in _TRACED)
    own = sum(predicted.values()) - shared - traced
    return shared + traced_for(others, parted) / traced_for(runs, parted) * traced + others / runs * own


def _with_choice(plan: Plan, choice: ColourChoice, request: Request) -> Plan:
    error, mono = choice.taken.error or 0.0, choice.candidates[0].error
    warnings = plan.warnings
    if error > _PART * request.accuracy:
        warnings = (
            *warnings,
            f"colour: {choice.chosen} leaves {error:.1e} of a band's light, more than half of the accuracy "
            f"{request.accuracy:g}, and no more than {MOST_LINES} bands are traced; ask for less, or give a projector "
            "of fewer lines",
        )
    rows = tuple(
        replace(row, reason=f"{choice.chosen} leaves {error:.1e}, mono {mono:.1e}", error_if_off=mono)
        if row.name == "spectrum" and mono
        else row
        for row in plan.effects
    )
    return replace(plan, colour=choice, effects=rows, warnings=warnings)


class _ColourPilot(Generic[Opened]):
    """Frames of few rays by candidate, in electrons up to a common factor."""

    def __init__(self, bench: Opened, request: Request) -> None:
        family = bench.family(request.patterns, request.seed).lighting
        shots = len(family.weights)
        chosen = np.unique(np.linspace(0, shots - 1, min(shots, _SHOTS)).astype(int))
        # Pixels that these shots light alike are one class.
        weights, classes = np.unique(family.weights[chosen], axis=1, return_inverse=True)
        self._lighting = Lighting(classes.ravel()[family.labels], weights)
        self._bench, self._seed = bench, integer(request.seed, "colour")
        diffracts = bench.geometry.diffracts and request.effects.get("diffraction", True)
        effects = frozenset({"diffraction"} if diffracts else ())
        self._settings = Settings(bench.geometry.scene_distance, effects=effects)

    @cached_property
    def spectral(self) -> Opened:
        return reopen(self._bench, spectral_of(self._bench.variant))

    def errors(self, names: Iterable[str]) -> dict[str, float]:
        mono = self._electrons(self._bench, self._path_samples(self._bench)[0])  # before another variant is set
        lines = self._bench.projector.lines.shining
        cut = {name: lines.bands(bands_of(name)) for name in names if name.startswith(BANDS)}
        bands = {band for each in cut.values() for band in each if band.several}
        sums = {band: np.zeros_like(mono) for band in bands | {lines}}
        for line, frames in self._of_lines(lines.single):
            for band, whole in sums.items():
                if line.wavelengths_nm[0] in band.wavelengths_nm:
                    whole += frames
        merged = {Lines((band.mean_nm,), (sum(band.shares),)): band for band in bands}
        left = {merged[line]: _relative(frames, sums[merged[line]]) for line, frames in self._of_lines(tuple(merged))}
        errors = {name: max(left.get(band, 0.0) for band in each) for name, each in cut.items()}
        known = {MONO: _relative(mono, sums[lines]), **errors, LINES: 0.0}
        return {name: known[name] for name in names}

    def _of_lines(self, lines: tuple[Lines, ...]) -> Iterator[tuple[Lines, FloatArray]]:
        for first in range(0, len(lines), MOST_LINES):
            some = lines[first : first + MOST_LINES]
            together = Lines(tuple(line.wavelengths_nm[0] for line in some), tuple(line.shares[0] for line in some))
            lit = self._path_samples(replace(self.spectral, lines=together))
            for line, path_samples in zip(some, lit, strict=True):
                yield line, self._electrons(line_alone(self.spectral, line), path_samples)

    def _path_samples(self, bench: Apparatus) -> list[PathSamples]:
        found = Simulation(bench, self._settings).direct.trace(self._seed, 0, _RAYS_OF_BANDS)
        return found.by_line(1 if bench.lines is None else len(bench.lines.shares))

    def _electrons(self, bench: Apparatus, path_samples: PathSamples) -> FloatArray:
        simulation, lighting = Simulation(bench, self._settings), self._lighting
        accumulated = simulation.accumulate("direct", path_samples, lighting.labels, _RAYS_OF_BANDS)
        rows = np.arange(lighting.weights.shape[1])
        frames = expected_of([(simulation, [accumulated])], rows, lighting, self._seed, leaking=False)
        wavelength = bench.projector.effective_wavelength_nm
        each = bench.sensor.efficiency(wavelength) * wavelength
        return np.stack([frame.irradiance for frame in frames]) * each


def _relative(found: FloatArray, true: FloatArray) -> float:
    whole = float(np.linalg.norm(true))
    error = float(np.linalg.norm(found - true)) / whole if whole else 0.0
    if error < _NONE:
        return 0.0
    digit = 10.0 ** (math.floor(math.log10(error)) - 1)
    return float(f"{math.ceil(round(error / digit, 6)) * digit:.1e}")

"""A first look at a scene's lamps: a bench in; which part of their light has which wavelength, as its camera counts it,
out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import present
from mitsim.core.arrays import FloatArray
from mitsim.core.seeds import integer
from mitsim.core.spectral_manifests import MOST_LINES
from mitsim.devices.lamps import SPECTRA_NM, Band, CountedLamps, Response, line_units
from mitsim.devices.projector import Spectrum
from mitsim.light.settings import Settings
from mitsim.light.simulation import Simulation
from mitsim.transport.from_camera import FromCameraTracer, LampResponse, LampTracer

_STEP_NM = 24.0
"""Widest part of a band whose light diffracts as that of its middle: a shadow's fringes hardly move over it, as for
ambient light without colours."""
_CELLS, _SAMPLES = 32, 16
"""Cells a side, and paths of each: a part of 5 % of the light is told to some percent, in a tenth of a second."""
_END_NM = 10.0
"""Of spectra, what tells how much light there is beyond their end."""


def lit_by_lamps(bench: Apparatus, effects: Mapping[str, bool], seed: int) -> Apparatus:
    """The same bench, whose lamps shine at wavelengths of their own; as it is without lamps.

    Parameters
    ----------
    bench
        of a spectral variant.
    effects
        switched on or off by the user.
    seed
        root of the random streams.

    Raises
    ------
    MitsimError
        for a camera whose efficiency is not known where lamps' spectra are, or that is blind to the projector's lines.
    """
    if not bench.loaded.lamps or not effects.get("ambient", True):
        return bench
    responses = Response.of_each(bench.counting)
    found = frozenset(name for name in present(bench) if effects.get(name, True))
    settings = Settings(bench.geometry.scene_distance, effects=found)
    tracer = Simulation(bench, settings, pixels=min(bench.n, _CELLS)).from_camera
    assert isinstance(tracer, FromCameraTracer), "lamps are followed, not yet apart"
    looks = [_Look.of(response, tracer, integer(seed, "lamplight")) for response in responses]
    light = np.concatenate([response.part * look.light for response, look in zip(responses, looks, strict=True)])
    lines = bench.projector.lines
    counted_lamps = CountedLamps(
        responses,
        tuple(band for response in responses for band in response.bands(MOST_LINES)),
        tuple(spectrum for look in looks for spectrum in look.spectra),
        light / light.sum() if light.any() else np.full(len(light), 1 / len(light)),
        max(look.unknown for look in looks),
        tuple(zip(lines.wavelengths_nm, line_units(bench.counting, lines), strict=True)),
    )
    return replace(bench, counted_lamps=counted_lamps)


@dataclass(frozen=True)
class _Look:
    """What one response counts: ``light`` (bands,) and ``spectra`` of each of its bands, and the part ``unknown``."""

    light: FloatArray
    spectra: tuple[Spectrum, ...]
    unknown: float

    @classmethod
    def of(cls, response: Response, tracer: FromCameraTracer, stream: int) -> _Look:
        """By a few paths.

        Parameters
        ----------
        response
            that counts.
        tracer, stream
            whose paths they are, and their random numbers.
        """
        first, last = response.range_nm
        parts = math.ceil((last - first) / MOST_LINES / _STEP_NM)

        def seen(*bands: Band) -> FloatArray:
            """(bands,) light of each."""
            light = LampTracer(tracer, LampResponse(response, bands, (1.0,))).trace(stream, 0, _SAMPLES)
            return np.asarray(np.bincount(light.pixel - tracer.projector.n**2, light.value, MOST_LINES) / _SAMPLES)

        # (bands, parts)
        light = np.stack([seen(*response.bands(MOST_LINES, part, parts)) for part in range(parts)], axis=1)
        middles = [[(low + high) / 2 for low, high in response.bands(MOST_LINES, part, parts)] for part in range(parts)]
        unknown = seen((SPECTRA_NM[0], first), (last, SPECTRA_NM[1]), *_ends())
        return cls(
            light.sum(axis=1),
            tuple(map(_spectrum, np.array(middles).T, light)),
            _unknown(response, unknown, float(light.sum())),
        )


def _spectrum(wavelengths: FloatArray, light: FloatArray) -> Spectrum:
    """Of a band whose ``light`` is (parts,) at ``wavelengths`` [nm]; where there is none, even."""
    lit = light > 0 if light.any() else np.ones(len(light), dtype=bool)
    weights = light[lit] if light.any() else np.ones(len(light))
    return Spectrum(wavelengths[lit], weights / weights.sum())


def _ends() -> tuple[Band, Band]:
    """Last wavelengths of spectra, and none."""
    return (SPECTRA_NM[1] - _END_NM, SPECTRA_NM[1]), (SPECTRA_NM[1], SPECTRA_NM[1])


def _unknown(response: Response, light: FloatArray, counted: float) -> float:
    """Part of the light that is not counted but would be, if efficiency and spectra went on as they end.

    Parameters
    ----------
    response
        of the camera.
    light
        (bands,) before its range, after it, and at the spectra's end.
    counted
        light that is.
    """
    missing = float(light[0] + light[1] + light[2] / _END_NM * response.beyond_nm)
    return missing / (missing + counted) if missing else 0.0

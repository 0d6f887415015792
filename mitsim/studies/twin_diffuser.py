"""A measured point spread function of a diffuser in; the statistics of a simulated diffuser that is like it, and how
like, out.

A diffuser is a random relief: no simulation has its caustics where a real one has them, so statistics are compared.
Slopes of a normal relief move light by d (n - 1) grad h (:mod:`mitsim.transport.plugins.diffuser`), and two numbers
tell them all: the relief's correlation length, and the rms distance that light is moved by. A blur (of the point that
was measured, pixels, diffraction) and a part of the light that is even (haze) are fitted beside.

The fit is by landing rays of small slopes on a grid of both numbers; what is then compared is traced by Mitsuba.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from scipy import ndimage

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import load_variant
from mitsim.core.errors import MitsimError
from mitsim.core.imagelist import Wanted
from mitsim.core.images import read_image
from mitsim.core.job import Progress
from mitsim.core.seeds import stream
from mitsim.devices.mask_profile import load_psf
from mitsim.transport.plugins.diffuser import Diffuser, Relief, point_spread, random_relief

PITCH_MM = 4 * 5.86e-3
"""Of four of its pixels, of the shipped sensor's size: lengths go with it, and nothing else."""
_REDUCE = 4
"""Pixels a side of the picture that become one."""
_CORRELATIONS_MM = np.geomspace(0.15, 0.45, 8)
_MOVES_MM = np.geomspace(0.05, 0.25, 8)
"""Correlation lengths and rms moves of light that are tried: steps of a sixth and a fourth, as wide as fits to single
diffusers scatter."""
_BLURS = np.linspace(0.0, 2.0, 11)
"""Standard deviations of the blur [pixels]."""
_HAZES = np.linspace(0.0, 0.5, 11)
"""Parts of the light that are even."""
_SEEDS = 2
"""Diffusers at each point of the grid."""
TRACED = 6
"""Diffusers that are traced and compared: their scatter is known to a third."""
_RAYS = 1280, 2048
"""A side of the square of rays, of the fit and of what is traced: 20 and 50 a pixel."""
_BANDS = 14
"""Of the radial spectrum: a fourth of a frequency wide, as caustic cells vary."""
_LOWEST, _HIGHEST = 1 / 70, 0.4
"""Bands of the radial spectrum, from a few caustic cells to where noise of rays would show [cycles / pixel]."""
_EDGES = np.geomspace(_LOWEST, _HIGHEST, _BANDS + 1)
_LIT, _SURE = 0.2, 12.0
"""Part of the brightest smoothed light that counts as lit, and the width of that smoothing [pixels], a cell's."""
_BRIGHTEST = 0.05
"""Part of the pixels whose share of the light tells how sharp caustics are."""
_MARGIN_MM = 1.2
"""Of the relief beyond the compared square: light is moved by less."""
_SLOPE = 0.1
"""Of the reliefs that rays are landed from; their moves are scaled."""


@dataclass(frozen=True)
class Spread:
    """Statistics of a point spread function within a square.

    Attributes
    ----------
    spectrum
        mean power of each radial band, of light over its mean, windowed.
    contrast
        standard deviation over mean.
    brightest
        share of the light in the brightest twentieth of the pixels.
    """

    spectrum: FloatArray
    contrast: float
    brightest: float


@dataclass(frozen=True, eq=False)
class DiffuserTwin:
    """A measured point spread function beside simulated ones.

    Attributes
    ----------
    measured, simulated
        squares of light, over their mean; of the latter the first.
    correlation_mm, move_mm, blur, haze
        fitted: correlation length, rms distance that light is moved by along an axis, blur [pixels], part that is even.
    spreads
        of the measured one, and of the simulated ones.
    scatter
        of the four numbers over fits to single simulated diffusers, as the measured one is single: standard deviation.
    """

    measured: FloatArray
    simulated: FloatArray
    correlation_mm: float
    move_mm: float
    blur: float
    haze: float
    spreads: tuple[Spread, ...]
    scatter: tuple[float, float, float, float]

    def deviations(self, name: str) -> tuple[float, float, float]:
        """Measured value of a statistic ``name``, mean and standard deviation of the simulated ones."""
        values = [float(getattr(each, name)) for each in self.spreads]
        return values[0], float(np.mean(values[1:])), float(np.std(values[1:], ddof=1))

    @property
    def spectrum_error(self) -> tuple[float, float]:
        """Rms difference of the logarithms of measured and mean simulated spectrum; the same of a single simulated one
        and the mean of the others."""
        logs = np.log([each.spectrum for each in self.spreads])
        own = [logs[k] - np.delete(logs[1:], k - 1, axis=0).mean(axis=0) for k in range(1, len(logs))]
        return float(np.sqrt(np.square(logs[0] - logs[1:].mean(axis=0)).mean())), float(np.sqrt(np.square(own).mean()))


def spread_of(light: FloatArray) -> Spread:
    """Statistics of a square of ``light``."""
    even = light / light.mean()
    ordered = np.sort(even.ravel())
    count = max(1, round(_BRIGHTEST * even.size))
    return Spread(radial_power(even, _EDGES), float(even.std()), float(ordered[-count:].sum() / ordered.sum()))


def frequencies() -> FloatArray:
    """(bands,) middles of the radial bands [cycles / pixel]."""
    return np.asarray(np.sqrt(_EDGES[1:] * _EDGES[:-1]))


def radial_power(values: FloatArray, edges: FloatArray) -> FloatArray:
    """(bands,) mean power a pixel of ``values`` (rows, columns), windowed and without their mean, between frequencies
    ``edges`` (bands + 1,) [cycles / pixel]."""
    window = np.outer(*(np.hanning(side) for side in values.shape))
    window /= np.sqrt(np.square(window).mean())
    power = np.square(np.abs(np.fft.fft2((values - (values * window**2).mean()) * window))) / values.size
    radius = np.hypot(*np.meshgrid(*(np.fft.fftfreq(side) for side in values.shape), indexing="ij"))
    which = np.digitize(radius.ravel(), edges)
    sums, counts = (np.bincount(which, weights, len(edges) + 1) for weights in (power.ravel(), None))
    return np.asarray(sums[1:-1] / np.maximum(counts[1:-1], 1))


def read_spread(path: Path) -> FloatArray:
    """(rows, columns) light of the point spread function in the picture ``path``; MitsimError for one of colours."""
    if read_image(path, Wanted("point spread function", colour=True)).ndim != 2:
        raise MitsimError(f"point spread function {path}: is in colour; give the sensor's own grey picture")
    return lit_square(load_psf(path, _REDUCE))


def lit_square(light: FloatArray) -> FloatArray:
    """The largest centred square of a point spread function's ``light`` that is lit; MitsimError for one without."""
    smooth = ndimage.gaussian_filter(light, _SURE)
    lit = smooth > _LIT * smooth.max()
    ends = [np.flatnonzero(lit.any(axis=axis))[[0, -1]] for axis in (1, 0)]
    middle = [int(each.mean()) for each in ends]
    half = int(min(np.ptp(each) for each in ends) / 2 - _SURE)
    if half < 1 / _LOWEST:  # else bands have no frequency
        raise MitsimError(
            f"point spread function: its lit part is {2 * half} pixels wide; a twin needs {2 / _LOWEST:.0f}, so give a "
            "larger picture"
        )
    return light[middle[0] - half : middle[0] + half, middle[1] - half : middle[1] + half]


def _land(relief: Relief, move_mm: float, count: int, seed: int) -> FloatArray:
    """(count, count) light over its mean of rays that a ``relief`` moves by ``move_mm`` rms, by small slopes."""
    rays, side = _RAYS[0], relief.side_mm
    jitter = stream(seed, "twin's rays").random((2, rays, rays))
    places = (np.stack(np.meshgrid(np.arange(rays), np.arange(rays), indexing="ij")) + jitter).reshape(2, -1) / rays
    at = places * (len(relief.height_mm) - 1)
    landed = [
        (place - 0.5) * side + move_mm / _SLOPE * ndimage.map_coordinates(slope, at, order=1)
        for place, slope in zip(places, (relief.slope_x, relief.slope_y), strict=True)
    ]
    row, column = (np.floor(count / 2 + each / PITCH_MM).astype(np.intp) for each in landed)
    seen = (row >= 0) & (row < count) & (column >= 0) & (column < count)
    light = np.bincount(row[seen] * count + column[seen], minlength=count * count).reshape(count, count)
    return np.asarray(light * (side / rays / PITCH_MM) ** 2)


def fit(measured: FloatArray, grid: FloatArray) -> tuple[int, int, float, float]:
    """Indices on the grid, blur and haze of the spectrum most like the ``measured`` one (bands,).

    ``grid`` is (correlations, moves, bands), means over diffusers. Bands count alike, by the logarithm: each of a
    diffuser scatters by some tenths of it.
    """
    damped = np.exp(-np.square(2 * np.pi * frequencies() * _BLURS[:, None]))  # of power
    best = (np.inf, 0, 0, 0.0, 0.0)
    for first, second in product(range(grid.shape[0]), range(grid.shape[1])):
        logs = np.log(grid[first, second] * damped)  # (blurs, bands)
        off = np.log(measured) - logs[None] - 2 * np.log1p(-_HAZES)[:, None, None]
        errors = np.square(off).mean(axis=2)
        haze, blur = np.unravel_index(int(np.argmin(errors)), errors.shape)
        best = min(best, (float(errors[haze, blur]), first, second, float(_BLURS[blur]), float(_HAZES[haze])))
    return best[1:]


def twin_of(square: FloatArray, seed: int, variant: str, progress: Progress) -> DiffuserTwin:
    """A diffuser whose statistics are those of a point spread function.

    Parameters
    ----------
    square
        lit part of it, as :func:`read_spread` finds it, in pixels of :data:`PITCH_MM`.
    seed
        of the diffusers.
    variant, progress
        of Mitsuba, and who is told how far the work is.
    """
    count = len(square)
    side = count * PITCH_MM + 2 * _MARGIN_MM
    grids = np.empty((_SEEDS, len(_CORRELATIONS_MM), len(_MOVES_MM), _BANDS))
    floor = (_RAYS[0] / side * PITCH_MM) ** -2.0 / 6  # of jittered rays: at most a sixth of even ones' noise
    for row, correlation in enumerate(_CORRELATIONS_MM):
        progress("diffuser", row / len(_CORRELATIONS_MM) / 2)
        for each in range(_SEEDS):
            relief = random_relief(side, float(correlation), _SLOPE, seed + each)
            for column, move in enumerate(_MOVES_MM):
                spectrum = radial_power(_land(relief, float(move), count, each), _EDGES)
                grids[each, row, column] = np.maximum(spectrum - floor, spectrum / 10)
    measured = spread_of(square)
    found = fit(measured.spectrum, grids.mean(axis=0))
    row, column, blur, haze = found
    load_variant(variant)
    correlation, move = float(_CORRELATIONS_MM[row]), float(_MOVES_MM[column])
    squares = []
    for each in range(TRACED):
        progress("diffuser", (1 + each / TRACED) / 2)
        glass = Diffuser()
        slope = move / (glass.distance_mm * (glass.index - 1))
        relief = random_relief(side, correlation, slope, seed + _SEEDS + each)
        traced = point_spread(Diffuser(relief), (count, count), PITCH_MM, rays=_RAYS[1], seed=each)
        even = ndimage.gaussian_filter(traced / traced.mean(), blur) if blur else traced / traced.mean()
        squares.append((1 - haze) * even + haze)
    spreads = tuple(spread_of(each) for each in squares)
    singles = [fit(each.spectrum, grids.mean(axis=0)) for each in spreads]
    numbers = np.array([(_CORRELATIONS_MM[a], _MOVES_MM[b], c, d) for a, b, c, d in singles])
    scatter = numbers.std(axis=0, ddof=1)
    return DiffuserTwin(
        square / square.mean(), squares[0] / squares[0].mean(), correlation, move, blur, haze, (measured, *spreads),
        (float(scatter[0]), float(scatter[1]), float(scatter[2]), float(scatter[3])),
    )  # fmt: skip

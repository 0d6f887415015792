"""The paper's idealised camera: from a reflectance image to the frames that Y = Phi_L (P o X) Phi_R^T promises.

A planar scene lit evenly, a geometric shadow, no falloff: the yardstick beside rendered measurements. It takes the
reflectance and the mean flux of the rendered bench, so exposure and noise are the same and only the model differs.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse

from mitsim.capture.bench import Bench
from mitsim.capture.light import Light
from mitsim.capture.simulation import Light as Estimate
from mitsim.capture.simulation import Simulation
from mitsim.optics.shadow import Directions
from mitsim.scene.plan import Settings

FloatArray = npt.NDArray[np.float64]


def ideal_light(bench: Bench, reflectance: FloatArray, board_flux: float) -> Light:
    """Light of the ideal model: pixel p of the projector puts reflectance[p] * board_flux [W m^-2] into its own cell.

    ``reflectance`` is (n, n) relative to the calibration board, ``board_flux`` the board's mean flux a projector pixel.
    """
    simulation = Simulation(bench, Settings(bench.geometry.scene_distance))
    grid, pixels = simulation.bundle.grid, np.arange(bench.n**2)
    first = [
        round((w[0] - axis.start) / axis.size) for w, axis in zip(bench.windows, (grid.rows, grid.columns), strict=True)
    ]
    row, column = np.divmod(pixels, bench.n)
    places = (row + first[0]) * grid.columns.count + column + first[1]
    flux = reflectance.ravel() * board_flux
    light = sparse.csr_array((flux, (pixels, places)), shape=(bench.n**2 + 1, simulation.bundle.size))
    coarse, smooth = (
        sparse.csr_array((bench.n**2 + 1, which.size)) for which in (simulation.coarse, simulation.smooth)
    )
    return Light(
        (Estimate(light, coarse, smooth),), simulation, pixels, flux, paths=0, sampling_error=0.0, reached=True
    )


def ideal_factors(bench: Bench, board_flux: float, electrons_per_joule: float) -> tuple[FloatArray, FloatArray]:
    """Phi_L, Phi_R (pixels, n) of the ideal model [sqrt(electrons / s)], for a board of reflectance 1.

    For a FlatCam mask these are the factors of the coded term; the constant one vanishes when frames are centred.
    ``electrons_per_joule`` turns W m^-2 into electrons a second.
    """
    rows, columns = (Directions.cells(np.linspace(*window, bench.n + 1)) for window in bench.windows)
    left, right = bench.geometry.shadow_terms(rows, columns, bench.geometry.scene_distance)[-1]
    scale = np.sqrt(board_flux * electrons_per_joule)
    return left * scale, right * scale

"""The paper's idealised camera: from a reflectance image to the frames that Y = Phi_L (P o X) Phi_R^T promises.

A planar scene lit evenly, a geometric shadow, no falloff: the yardstick beside rendered measurements. It takes the
reflectance and the mean flux of the rendered bench, so exposure and noise are the same and only the model differs.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy import sparse

from mitsim.capture.bench import Bench
from mitsim.capture.evidence import Settings
from mitsim.capture.light import Light
from mitsim.capture.simulation import FiledLight, Simulation
from mitsim.core.arrays import FloatArray
from mitsim.optics.frames import ExpectedFrames, Filed, FrameOptics
from mitsim.optics.separable import best_term, centred
from mitsim.optics.shadow import Directions, SeparableTerms
from mitsim.optics.terms import shadow_terms
from mitsim.rig.camera import CameraGeometry
from mitsim.rig.mask import MaskKind
from mitsim.rig.patterns import PatternFamily
from mitsim.rig.projector import Spectrum


def ideal_light(bench: Bench, reflectance: FloatArray, board_flux: float) -> Light:
    """Light of the ideal model: pixel p of the projector puts reflectance[p] * board_flux [W m^-2] into its own cell.

    ``reflectance`` is (n, n) relative to the calibration board, ``board_flux`` the board's mean flux a projector pixel.
    """
    simulation = Simulation(bench, Settings(bench.geometry.scene_distance))
    grid, pixels = simulation.fine.bundle.grid, np.arange(bench.n**2)
    first = [
        round((w[0] - axis.start) / axis.size) for w, axis in zip(bench.windows, (grid.rows, grid.columns), strict=True)
    ]
    row, column = np.divmod(pixels, bench.n)
    places = (row + first[0]) * grid.columns.count + column + first[1]
    flux = reflectance.ravel() * board_flux
    light = sparse.csr_array((flux, (pixels, places)), shape=(bench.n**2 + 1, simulation.fine.bundle.size))
    coarse, smooth = (
        sparse.csr_array((bench.n**2 + 1, which.size)) for which in (simulation.coarse, simulation.smooth)
    )
    return Light(
        (FiledLight(light, coarse, smooth),), simulation, pixels, flux, paths=0, sampling_error=0.0, reached=True
    )


def ideal_factors(bench: Bench, board_flux: float, electrons_per_joule: float) -> tuple[FloatArray, FloatArray]:
    """Phi_L, Phi_R (pixels, n) of the ideal model [sqrt(electrons / s)], for a board of reflectance 1.

    For a FlatCam mask these are the factors of the coded term; the constant one vanishes when frames are centred.
    ``electrons_per_joule`` turns W m^-2 into electrons a second.
    """
    rows, columns = (Directions.cells(np.linspace(*window, bench.n + 1)) for window in bench.windows)
    left, right = shadow_terms(bench.geometry, rows, columns, bench.geometry.scene_distance)[-1]
    scale = np.sqrt(board_flux * electrons_per_joule)
    return left * scale, right * scale


class IdealCamera:
    """The idealised camera with one mask in one light: projector pixels of the aligned plane to sensor pixels."""

    def __init__(self, bench: Bench, mask: MaskKind, spectrum: Spectrum | None) -> None:
        """``spectrum`` None: the geometric shadow."""
        self.mask, self.spectrum = mask, spectrum
        self.geometry: CameraGeometry = bench.geometry.model_copy(update={"mask": mask})
        self._depth = bench.geometry.scene_distance
        self._rows, self._columns = (Directions.cells(np.linspace(*window, bench.n + 1)) for window in bench.windows)
        self.terms = shadow_terms(self.geometry, self._rows, self._columns, self._depth, spectrum)

    @property
    def centre(self) -> bool:
        """Whether a solver takes row and column means off its frames."""
        return self.mask == "flatcam"

    def points(self) -> SeparableTerms:
        """The same operator for point sources at the centres of the projector's pixels."""
        rows, columns = (Directions(pixels.centres, 0.0) for pixels in (self._rows, self._columns))
        return shadow_terms(self.geometry, rows, columns, self._depth, self.spectrum)

    @cached_property
    def factors(self) -> tuple[FloatArray, FloatArray]:
        """(pixels, n) left and right factor of the nearest separable operator, of transmissions."""
        best = best_term(centred(self.terms) if self.centre else self.terms)
        return best.left, best.right

    def frames(self, family: PatternFamily, flux: FloatArray, seed: int) -> ExpectedFrames:
        """Frames of a family when each projector pixel puts ``flux`` (n, n) [W m^-2] on the sensor without the mask."""
        light = sparse.csr_array(sparse.diags_array(flux.ravel()))
        return ExpectedFrames([Filed(self._optics, (light,))], family.lighting, seed)

    @cached_property
    def _optics(self) -> FrameOptics:
        return FrameOptics(self.geometry, self._rows, self._columns, (self._depth,), 1, self.spectrum)

"""The paper's idealised camera: from a reflectance image to the frames that Y = Phi_L (P o X) Phi_R^T promises.

A planar scene lit evenly, no falloff, and with a geometric shadow one separable term: the yardstick beside rendered
measurements. It takes the reflectance and the mean flux of the rendered bench, so exposure and noise are the same and
only the model differs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from mitsim.capture.bench import Bench
from mitsim.core.arrays import FloatArray
from mitsim.optics.frames import ExpectedFrames, Filed, FrameOptics
from mitsim.optics.separable import best_term, centred
from mitsim.optics.shadow import Directions, SeparableTerms
from mitsim.optics.terms import shadow_terms
from mitsim.rig.camera import CameraGeometry
from mitsim.rig.mask import MaskKind
from mitsim.rig.patterns import PatternFamily
from mitsim.rig.projector import Spectrum
from mitsim.sensor.chain import electrons_from_irradiance

Pair = tuple[FloatArray, FloatArray]
"""Left and right factor, (pixels, n) each."""


@dataclass(frozen=True, eq=False)
class IdealCamera:
    """The idealised camera: projector pixels of the aligned plane to sensor pixels.

    Attributes
    ----------
    bench
        whose geometry, projector and electronics it has.
    mask
        its code.
    spectrum
        light whose diffraction it shows; None: the geometric shadow.
    """

    bench: Bench
    mask: MaskKind
    spectrum: Spectrum | None = None

    @property
    def centre(self) -> bool:
        """Whether a solver takes row and column means off its frames."""
        return self.mask == "flatcam"

    @cached_property
    def terms(self) -> SeparableTerms:
        """Its operator, from pixels that shine evenly."""
        return self._terms(*self._pixels)

    def points(self) -> SeparableTerms:
        """The same operator for point sources at the centres of the projector's pixels."""
        rows, columns = (Directions(pixels.centres, 0.0) for pixels in self._pixels)
        return self._terms(rows, columns)

    @cached_property
    def factors(self) -> Pair:
        """(pixels, n) left and right factor of the nearest separable operator, of transmissions."""
        best = best_term(centred(self.terms) if self.centre else self.terms)
        return best.left, best.right

    def calibrated(self, board_flux: float) -> Pair:
        """The same factors as a calibration has them [sqrt(electrons / s)], where each pixel of a white board puts
        ``board_flux`` [W m^-2] on the sensor without the mask."""
        model = self.bench.projector
        rate = electrons_from_irradiance(board_flux, 1.0, self.bench.sensor, model.effective_wavelength_nm)
        left, right = self.factors
        return left * np.sqrt(rate), right * np.sqrt(rate)

    def frames(self, family: PatternFamily, flux: FloatArray) -> ExpectedFrames:
        """Frames of a ``family`` when each projector pixel puts ``flux`` (n, n) [W m^-2] on the sensor without the
        mask."""
        light = sparse.csr_array(sparse.diags_array(flux.ravel()))
        return ExpectedFrames([Filed(self._optics, (light,))], family.lighting, seed=0)

    @property
    def _geometry(self) -> CameraGeometry:
        return self.bench.geometry.model_copy(update={"mask": self.mask})

    @property
    def _pixels(self) -> tuple[Directions, Directions]:
        rows, columns = (Directions.cells(np.linspace(*edges, self.bench.n + 1)) for edges in self.bench.windows)
        return rows, columns

    def _terms(self, rows: Directions, columns: Directions) -> SeparableTerms:
        return shadow_terms(self._geometry, rows, columns, self.bench.geometry.scene_distance, self.spectrum)

    @cached_property
    def _optics(self) -> FrameOptics:
        return FrameOptics(self._geometry, *self._pixels, (self.bench.geometry.scene_distance,), 1, self.spectrum)

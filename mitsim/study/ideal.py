"""The paper's idealised camera: from a reflectance image to the frames that Y = Phi_L (P o X) Phi_R^T promises.

A planar scene lit evenly, no falloff, and with a geometric shadow one separable term: the yardstick beside rendered
measurements. It takes the reflectance and the mean flux of the rendered bench, so exposure and noise are the same and
only the model differs. Its shadows in several lights: how far from the geometric one, how far from one separable term.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from mitsim.capture.bench import Bench
from mitsim.core.arrays import FloatArray
from mitsim.optics.closed_form import FrameOptics
from mitsim.optics.frames import ExpectedFrames, Filed
from mitsim.optics.separable import best_term, centred, relative_difference
from mitsim.optics.shadow import Directions, SeparableTerms
from mitsim.optics.terms import shadow_terms
from mitsim.rig.camera import CameraGeometry
from mitsim.rig.mask import CameraMask
from mitsim.rig.patterns import PatternFamily
from mitsim.rig.projector import Spectrum
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.study.metrics import relative_error

BROADBAND_NM, BROADBAND_BANDS = (400.0, 700.0), 13
"""What a camera with a usual filter sees, in bands of 23 nm, over which a shadow's fringes hardly move."""
GEOMETRIC, LINE, PROJECTOR, BROADBAND = "no diffraction", "one line", "projector", "broadband"

Pair = tuple[FloatArray, FloatArray]
"""Left and right factor, (pixels, n) each."""


@dataclass(frozen=True)
class Plane:
    """A plane scene at ``depth_mm``, lit from ``baseline_mm`` beside the camera, along rows and columns (index
    coordinates)."""

    depth_mm: float
    baseline_mm: tuple[float, float]


@dataclass(frozen=True, eq=False)
class IdealCamera:
    """The idealised camera of a ``bench``, with one mask in one light (``spectrum`` None: the geometric shadow)."""

    bench: Bench
    mask: CameraMask
    spectrum: Spectrum | None = None

    @property
    def centre(self) -> bool:
        """Whether a solver takes row and column means off its frames."""
        return self._geometry.centred

    @cached_property
    def terms(self) -> SeparableTerms:
        """Its operator, from pixels that shine evenly."""
        return self._terms(*self.directions)

    def points(self) -> SeparableTerms:
        """The same operator for point sources at the centres of the projector's pixels."""
        rows, columns = (Directions(pixels.centres, 0.0) for pixels in self.directions)
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

    def frames(self, family: PatternFamily, flux: FloatArray, plane: Plane | None = None) -> ExpectedFrames:
        """Frames of a family.

        Parameters
        ----------
        family
            the patterns.
        flux
            (n, n) [W m^-2] that each projector pixel puts on the sensor without the mask.
        plane
            where the scene is; None: where the camera was calibrated.
        """
        light = sparse.csr_array(sparse.diags_array(flux.ravel()))
        optics = self._optics if plane is None else self._optics_at(plane)
        return ExpectedFrames([Filed(optics, (light,))], family.lighting, seed=0)

    def _optics_at(self, plane: Plane) -> FrameOptics:
        shift = 1 / plane.depth_mm - 1 / self.bench.geometry.scene_distance
        rows, columns = (
            Directions(pixels.centres + baseline * shift, pixels.width)
            for pixels, baseline in zip(self.directions, plane.baseline_mm, strict=True)
        )
        return FrameOptics(self._geometry, rows, columns, (plane.depth_mm,), 1, self.spectrum)

    @property
    def _geometry(self) -> CameraGeometry:
        return self.bench.geometry.model_copy(update={"mask": self.mask})

    @property
    def directions(self) -> tuple[Directions, Directions]:
        """Of the projector's pixels, along rows and columns."""
        rows, columns = (Directions.cells(np.linspace(*edges, self.bench.n + 1)) for edges in self.bench.windows)
        return rows, columns

    def _terms(self, rows: Directions, columns: Directions) -> SeparableTerms:
        return shadow_terms(self._geometry, rows, columns, self.bench.geometry.scene_distance, self.spectrum)

    @cached_property
    def _optics(self) -> FrameOptics:
        return FrameOptics(self._geometry, *self.directions, (self.bench.geometry.scene_distance,), 1, self.spectrum)


@dataclass(frozen=True)
class ShadowRow:
    """One mask in one light against its geometric shadow; relative rms differences of operators, no unit.

    ``terms``: separable terms of the operator. ``point_source`` and ``scene_pixel``: difference from the geometric
    shadow, for point sources at the centres of projector pixels and averaged over these pixels. ``factor``: difference
    of the factor that a solver uses on one side. ``separability``: what the best single separable term leaves of the
    operator, and ``separability_centred`` once row and column means are taken off its frames.
    """

    mask: str
    light: str
    wavelengths: int
    terms: int
    point_source: float
    scene_pixel: float
    factor: float
    separability: float
    separability_centred: float


def lights(bench: Bench) -> dict[str, Spectrum | None]:
    """The study's lights on ``bench`` by name; None is light that does not diffract."""
    edges = np.linspace(*BROADBAND_NM, BROADBAND_BANDS + 1)
    return {
        GEOMETRIC: None,
        LINE: Spectrum(np.array([bench.projector.effective_wavelength_nm]), np.ones(1)),
        PROJECTOR: bench.spectrum,
        BROADBAND: Spectrum((edges[:-1] + edges[1:]) / 2, np.full(BROADBAND_BANDS, 1 / BROADBAND_BANDS)),
    }


def shadow_row(light: str, systems: Mapping[str, IdealCamera]) -> ShadowRow:
    """The camera in one ``light`` of the ``systems`` of one mask, compared with the geometric one of them."""
    system, geometric = systems[light], systems[GEOMETRIC]
    factor, assumed = system.factors[0], geometric.factors[0]
    # (left, right) and (-left, -right) are one camera.
    sign = 1.0 if np.vdot(factor, assumed) >= 0 else -1.0
    return ShadowRow(
        mask=system.mask,
        light=light,
        wavelengths=len(system.spectrum.weights) if system.spectrum else 0,
        terms=len(system.terms),
        point_source=relative_difference(system.points(), geometric.points()),
        scene_pixel=relative_difference(system.terms, geometric.terms),
        factor=relative_error(sign * factor, assumed),
        separability=best_term(system.terms).residual,
        separability_centred=best_term(centred(system.terms)).residual,
    )


def point_profiles(bench: Bench) -> dict[str, FloatArray]:
    """(pixels,) shadow of a point on the axis of ``bench`` down the rows of the sensor, through the separable mask, by
    light."""
    camera, axis = bench.geometry.model_copy(update={"mask": "separable"}), Directions(np.zeros(1), 0.0)
    return {
        name: best_term(shadow_terms(camera, axis, axis, camera.scene_distance, spectrum)).left[:, 0]
        for name, spectrum in lights(bench).items()
    }

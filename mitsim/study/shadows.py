"""Shadows of a camera's masks in several lights: how far from the geometric shadow, how far from one separable term."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mitsim.capture.bench import Bench
from mitsim.core.arrays import FloatArray
from mitsim.optics.separable import best_term, centred, relative_difference
from mitsim.optics.shadow import Directions
from mitsim.optics.terms import shadow_terms
from mitsim.rig.projector import Spectrum
from mitsim.study.ideal import IdealCamera
from mitsim.study.metrics import relative_error

BROADBAND_NM, BROADBAND_BANDS = (400.0, 700.0), 13
"""What a camera with a usual filter sees, in bands of 23 nm, over which a shadow's fringes hardly move."""
GEOMETRIC, LINE, PROJECTOR, BROADBAND = "no diffraction", "one line", "projector", "broadband"


@dataclass(frozen=True)
class ShadowRow:
    """One mask in one light against its geometric shadow; relative rms differences of operators, no unit.

    Attributes
    ----------
    mask, light
        of which the row is.
    wavelengths, terms
        lines of the light (0: no diffraction), and separable terms of the operator.
    point_source, scene_pixel
        difference from the geometric shadow, for point sources at the centres of projector pixels and averaged over
        these pixels.
    factor
        difference of the factor that a solver uses on one side.
    separability, separability_centred
        what the best single separable term leaves of the operator, as it is and once row and column means are taken off
        its frames.
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
    """(pixels,) shadow of a point on the axis of ``bench`` along one side of the sensor, through the separable mask, by
    light."""
    camera, axis = bench.geometry.model_copy(update={"mask": "separable"}), Directions(np.zeros(1), 0.0)
    return {
        name: best_term(shadow_terms(camera, axis, axis, camera.scene_distance, spectrum)).left[:, 0]
        for name, spectrum in lights(bench).items()
    }

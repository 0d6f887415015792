"""Shadow of a camera's mask: its geometry and directions in, separable terms out."""

from __future__ import annotations

from mitsim.optics.diffraction import wave_terms
from mitsim.optics.shadow import Directions, SeparableTerms, Setting, geometric_terms
from mitsim.rig.camera import CameraGeometry
from mitsim.rig.projector import Spectrum


def shadow_setting(geometry: CameraGeometry, depth: float) -> Setting:
    """Sensor and mask of ``geometry`` and a ``depth`` [mm] of the scene, for one shadow."""
    edges = geometry.pixel_edges
    return Setting(
        mask=geometry.build_mask(),
        pixel_centres_mm=(edges[:-1] + edges[1:]) / 2,
        active_mm=geometry.active_side,
        distance_mm=geometry.mask_distance,
        thickness_mm=geometry.mask_thickness,
        depth_mm=depth,
    )


def shadow_terms(
    geometry: CameraGeometry, rows: Directions, columns: Directions, depth: float, spectrum: Spectrum | None = None
) -> SeparableTerms:
    """Shadow on each pixel of directions at one depth, as separable terms: [(left (m, r), right (m, c)), ...].

    The mean over a pixel's active area times the fill factor: irradiance is per pixel area. All weights are folded
    into left. The angular response is not in here; it belongs to the light.

    Parameters
    ----------
    geometry
        the camera.
    rows, columns
        directions along the two axes, r and c of them.
    depth
        where they end [mm].
    spectrum
        wave-optical with one: each wavelength has terms of its own, weighted by its share. None: geometric.
    """
    place = shadow_setting(geometry, depth)
    terms = geometric_terms(place, rows, columns) if spectrum is None else wave_terms(place, rows, columns, spectrum)
    if geometry.pixel_fill_factor == 1:
        return terms
    return [(geometry.pixel_fill_factor * left, right) for left, right in terms]

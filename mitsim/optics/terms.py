"""Shadow of a camera's mask: its geometry and directions in, separable terms out."""

from __future__ import annotations

from dataclasses import replace

from mitsim.devices.camera import CameraGeometry
from mitsim.devices.projector import Spectrum
from mitsim.optics.diffraction import wave_terms
from mitsim.optics.fft_shadow import raster
from mitsim.optics.mask_defects import moving_terms, tilted_terms
from mitsim.optics.shadow import Directions, Places, SeparableTerms, ShadowGeometry, geometric_terms


def shadow_terms(
    geometry: CameraGeometry,
    rows: Directions,
    columns: Directions,
    depth: float,
    spectrum: Spectrum | None = None,
    places: Places | None = None,
) -> SeparableTerms:
    """Shadow on each pixel of directions at one depth, as separable terms: [(left (m, r), right (m', c)), ...].

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
    places
        rows and columns of a frame, increasing; None: all.
    """
    shadow, waves = ShadowGeometry.of(geometry, depth, places), spectrum is not None
    if geometry.drawn(waves):
        shadow, spectrum = replace(shadow, mask=raster(geometry, depth, spectrum)), None
    if geometry.mask_motion is not None:
        others = rows, columns, depth, spectrum, places
        return moving_terms(geometry, shadow, rows, columns, lambda still: shadow_terms(still, *others))

    def formed(shadow: ShadowGeometry) -> SeparableTerms:
        if spectrum is None:
            return geometric_terms(shadow, rows, columns)
        return wave_terms(shadow, rows, columns, spectrum)

    nodes = geometry.tilt_nodes(waves)
    terms = tilted_terms(shadow, rows, columns, geometry.mask_tilt, nodes, formed) if nodes else formed(shadow)
    if geometry.pixel_fill_factor == 1:
        return terms
    return [(geometry.pixel_fill_factor * left, right) for left, right in terms]

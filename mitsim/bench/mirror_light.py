"""Light that comes to the sensor over mirrors alone: from a projector's beams to frames of each class of its pixels."""

from __future__ import annotations

import math
import time
from functools import lru_cache

import numpy as np

from mitsim.core.arrays import Labels
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.projector import Spectrum
from mitsim.optics.fft_shadow import SampledTerm, geometric_samplers, wave_samplers
from mitsim.optics.frames import ClassFrames
from mitsim.optics.mirror_frames import Beams, specular_frames

_KEPT = 4
"""Frames of so many lightings and cameras: what the pilot switches between."""


class Glint:
    """Frames made from ``beams``; the last few are kept, because forming them takes as long as tracing does.

    Attributes
    ----------
    beams
        of the scene.
    seconds
        that forming frames of all of them took last; 0 before.
    """

    def __init__(self, beams: Beams) -> None:
        self.beams, self.seconds = beams, 0.0
        self._kept = lru_cache(_KEPT)(self._form)

    def frames(self, labels: Labels, geometry: CameraGeometry, spectrum: Spectrum | None) -> ClassFrames | None:
        """Frames by class of projector pixels; None where no beam reaches the sensor.

        Parameters
        ----------
        labels
            (n^2,) class of each pixel.
        geometry
            the camera.
        spectrum
            light whose diffraction is simulated; None: the mask's shadow is geometric.
        """
        if not len(self.beams):
            return None
        return self._kept(np.asarray(labels, np.int64).tobytes(), geometry, spectrum)

    def irradiance(self, geometry: CameraGeometry) -> tuple[float, float]:
        """Mean irradiance on the sensor without its mask, and what of it lacks or may be off in each pixel [W m^-2].

        Parameters
        ----------
        geometry
            the camera.
        """
        beams = self.beams
        area, pixels = math.prod(geometry.pitches), math.prod(geometry.frame_shape)
        met = (np.abs(beams.sensor.mean(axis=(1, 2))) < geometry.half_width).all(axis=1)
        # Points that edges leave lie in single pixels: their rms over all of them.
        unsure = math.hypot(beams.unresolved, beams.error * math.sqrt(pixels))
        return float(beams.delivered[met].sum()) / area / pixels, unsure / area / pixels

    def _form(self, labels: bytes, geometry: CameraGeometry, spectrum: Spectrum | None) -> ClassFrames:
        started, terms = time.perf_counter(), self._terms(geometry, spectrum)
        found = specular_frames(self.beams, geometry, terms, np.frombuffer(labels, np.int64))
        self.seconds = time.perf_counter() - started
        return found

    def _terms(self, geometry: CameraGeometry, spectrum: Spectrum | None) -> list[SampledTerm]:
        """The mask for a virtual source at the beams' mean depth and direction."""
        if spectrum is None:
            return geometric_samplers(geometry)
        wide = self.beams.wide
        near = float(np.mean(self.beams.inverse_depth[wide])) if wide.any() else 0.0
        depth = 1 / near if near > 0 else math.inf
        tau = np.average(self.beams.tangent.mean(axis=(1, 2)), axis=0, weights=self.beams.delivered)
        return wave_samplers(geometry, spectrum, depth, (float(tau[0]), float(tau[1])))

"""Parametric model of a camera's factors: displacements of mask and projector as numbers that a fit can vary.

Column p of a factor is the mask's shadow of light from projector pixel p, geometric or wave-optical, in closed form
(:mod:`mitsim.optics.terms`), times the losses of slanted rays between a flat diffuse board and a flat sensor: both
cosines and the square of the distance, z^2 / r^4 with r^2 = z^2 (1 + t_row^2 + t_column^2) and t = tau - u / z. As a
product of the two axes, (1 + t_row^2)^-2 (1 + t_column^2)^-2, the error is at most 2 t_row^2 t_column^2. All projector
pixels are assumed to be equally bright.

A mask that is turned by a small angle phi from rows toward columns transmits r(s + phi t) c(t - phi s), which is not
separable. To first order it is L (x) R + phi (dL/ds (x) T o R - S o L (x) dR/dt), with S and T the mask coordinates of
rays from pixels to directions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.projector import Spectrum
from mitsim.optics.shadow import Directions, SeparableTerms
from mitsim.optics.terms import best_term, centre_terms, shadow_terms

_ANGLE = 2.0
"""Half the power of the cosine: light from a flat board to a flat sensor falls with the fourth power."""
_DERIVED_MM = 5e-4
"""Shift of the mask for derivatives: a twentieth of a pixel."""
_KEPT = 12
"""Cached factors: one point, and one step of each number."""


@dataclass(frozen=True)
class Placement:
    """Positions of mask and projector, and brightness of the board.

    Attributes
    ----------
    mask_distance
        Sensor to mask [mm].
    mask_shift_row, mask_shift_column
        Shift of the mask's centre beyond the camera's own offset [mm], index coordinates.
    mask_rotation
        Rotation about its centre from rows toward columns [rad].
    magnification
        Scale of the projector's window about its centre.
    projector_row, projector_column
        Shift of the window [tangent of the angle].
    gain
        Electrons per second that a projector pixel on the board makes on a sensor pixel without the mask.
    """

    mask_distance: float
    mask_shift_row: float = 0.0
    mask_shift_column: float = 0.0
    mask_rotation: float = 0.0
    magnification: float = 1.0
    projector_row: float = 0.0
    projector_column: float = 0.0
    gain: float = 1.0

    def move(self, steps: Mapping[str, float]) -> Placement:
        """Return a placement with ``steps`` added to some of its numbers, by name."""
        return replace(self, **{name: getattr(self, name) + step for name, step in steps.items()})


@dataclass(frozen=True, eq=False)
class ModelledCamera:
    """Model of a camera as designed.

    Attributes
    ----------
    geometry
        The camera.
    windows
        Row and column tan-angles of the projector's window on the aligned plane.
    n
        Projector pixels per side.
    spectrum
        Lines of a wave-optical shadow; None for a geometric shadow.
    """

    geometry: CameraGeometry
    windows: tuple[tuple[float, float], tuple[float, float]]
    n: int
    spectrum: Spectrum | None = None

    @property
    def built(self) -> Placement:
        """Return the placement as designed."""
        return Placement(self.geometry.mask_distance)

    def factors(self, placement: Placement) -> tuple[FloatArray, FloatArray]:
        """Return the (m, n) left and (m', n) right factor [sqrt(electrons / s)] of an unturned mask."""
        built = self.built
        left, right = self._cached_factors(replace(placement, gain=built.gain, mask_rotation=built.mask_rotation))
        root = np.sqrt(placement.gain)
        return left * root, right * root

    @cached_property
    def _cached_factors(self) -> Callable[[Placement], tuple[FloatArray, FloatArray]]:
        return lru_cache(maxsize=_KEPT)(self._form_factors)

    @cached_property
    def _cached_axis(self) -> Callable[[float, float, Directions], SeparableTerms]:
        return lru_cache(maxsize=_KEPT)(self._axis)

    def _form_factors(self, placement: Placement) -> tuple[FloatArray, FloatArray]:
        shifts = placement.mask_shift_row, placement.mask_shift_column
        by_row, by_column = (
            self._cached_axis(placement.mask_distance, own + shift, directions)
            for own, shift, directions in zip(
                self.geometry.mask_offset, shifts, self._directions(placement), strict=True
            )
        )
        terms = [(left, right) for (left, _), (_, right) in zip(by_row, by_column, strict=True)]
        best = best_term(centre_terms(terms) if self.geometry.centred else terms)
        return best.left, best.right

    def _axis(self, distance: float, offset: float, directions: Directions) -> SeparableTerms:
        update = {"mask_distance": distance, "mask_offset_row": offset, "mask_offset_column": offset}
        camera = self.geometry.model_copy(update=update)
        of_rows, of_columns = (self._falloff(directions, axis) for axis in (0, 1))
        terms = shadow_terms(camera, directions, directions, camera.scene_distance, self.spectrum)
        return [(left * of_rows, right * of_columns) for left, right in terms]

    def rotation_terms(self, placement: Placement) -> SeparableTerms:
        """Return the change of the product of the factors per radian of rotation of the mask at a ``placement``."""
        step = {"mask_shift_row": _DERIVED_MM, "mask_shift_column": _DERIVED_MM}
        ahead = self.factors(placement.move(step))
        behind = self.factors(placement.move({name: -value for name, value in step.items()}))
        # A mask that moves on by o is seen at s - o.
        slopes = [(back - on) / (2 * _DERIVED_MM) for on, back in zip(ahead, behind, strict=True)]
        left, right = self.factors(placement)
        across, along = self._crossings(placement)
        return [(slopes[0], along * right), (-across * left, slopes[1])]

    def _directions(self, placement: Placement) -> tuple[Directions, Directions]:
        edges = []
        for (first, last), shift in zip(
            self.windows, (placement.projector_row, placement.projector_column), strict=True
        ):
            middle, half = (first + last) / 2 + shift, (last - first) / 2 * placement.magnification
            edges.append(np.linspace(middle - half, middle + half, self.n + 1))
        return Directions.cells(edges[0]), Directions.cells(edges[1])

    def _falloff(self, directions: Directions, axis: int) -> FloatArray:
        depth, pixels = self.geometry.scene_distance, self.geometry.centres(axis)
        squared = np.square(directions.centres - pixels[:, None] / depth)
        return np.asarray((1 + squared) ** -_ANGLE * self.geometry.angular_response(squared))

    def _crossings(self, placement: Placement) -> tuple[FloatArray, FloatArray]:
        depth, distance = self.geometry.scene_distance, placement.mask_distance
        shifts = placement.mask_shift_row, placement.mask_shift_column
        return tuple(  # type: ignore[return-value]
            (1 - distance / depth) * self.geometry.centres(axis)[:, None] + distance * each.centres - own - shift
            for axis, (each, own, shift) in enumerate(
                zip(self._directions(placement), self.geometry.mask_offset, shifts, strict=True)
            )
        )

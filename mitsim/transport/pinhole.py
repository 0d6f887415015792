"""A stock ``projector`` from outside: where its rays go, and how much light they carry.

The emitter does not tell its field of view, so it is asked for the uv of many points; the power is what it casts on the
plane at unit distance, pi x scale x texture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.transport.source import Projector

_WAVELENGTH_SETS = 8


def wavelength_sets() -> list[Any]:
    """Wavelengths [nm] at which spectra are taken: none but for spectral variants, there evenly over the range."""
    if not mi.is_spectral:
        return [None]
    size = len(dr.zeros(mi.UnpolarizedSpectrum))
    step = (mi.MI_CIE_MAX - mi.MI_CIE_MIN) / (_WAVELENGTH_SETS * size)
    even = mi.MI_CIE_MIN + step * (np.arange(_WAVELENGTH_SETS * size) + 0.5)
    return [type(dr.zeros(mi.Ray3f).wavelengths)(*even[i::_WAVELENGTH_SETS].tolist()) for i in range(_WAVELENGTH_SETS)]


@dataclass(frozen=True, eq=False)
class PinholeMap:
    """Where a stock ``projector`` sends its canvas: local tan-angles x = x[0] u + x[1], y = y[0] v + y[1].

    ``origin`` (3,) [mm] and ``turn`` (3, 3) take local points to the world.
    """

    origin: FloatArray
    turn: FloatArray
    x: FloatArray
    y: FloatArray

    @classmethod
    def of(cls, emitter: Any) -> PinholeMap:
        """The map of an emitter, fitted in float64 to what it says in float32 (6e-8 of the canvas a point)."""
        matrix = np.array(mi.traverse(emitter)["to_world"].matrix, dtype=np.float64).reshape(4, 4, -1)[..., 0]
        origin, turn = matrix[:3, 3], matrix[:3, :3]
        reach = 0.02
        for _ in range(2):  # first near the axis, to learn the field of view, then over all of it
            x, y = (part.ravel() for part in np.meshgrid(*[np.linspace(-reach, reach, 24)] * 2))
            uv = _asked(emitter, origin, turn, np.stack([x, y, np.ones(x.size)], axis=1), None)[0].uv
            fits = [
                np.linalg.lstsq(np.stack([host(part, x.size), np.ones(x.size)], axis=1), tangent, rcond=None)[0]
                for part, tangent in ((uv.x, x), (uv.y, y))
            ]
            reach = 0.49 * min(abs(fits[0][0]), abs(fits[1][0]))
        return cls(origin, turn, fits[0], fits[1])


class PinholeRays:
    """Rays of a stock ``projector``: from points of its window to directions, and the power between them.

    Attributes
    ----------
    origin
        (3,) pinhole in world coordinates [mm].
    area
        area of one pixel on the plane at unit distance [mm^2 at 1 mm].
    power
        (n * n, channels) irradiance on that plane that each pixel casts, by colour channel or wavelength [W m^-2].
    """

    def __init__(self, projector: Projector, wavelengths: list[Any]) -> None:
        """``wavelengths``: sets at which spectra are taken, from :func:`wavelength_sets`."""
        self._projector, n = projector, projector.n
        self.map = PinholeMap.of(projector.emitter)
        self.origin = self.map.origin
        rows, columns = projector.canvas
        self.area = abs(self.map.x[0] * self.map.y[0]) / (rows * columns)
        centre = np.stack(np.divmod(np.arange(n * n), n), axis=1) + 0.5
        self.power = np.concatenate([self._irradiance(centre, chosen) for chosen in wavelengths], axis=1)

    def directions(self, points: FloatArray) -> FloatArray:
        """(k, 3) world directions of unit length through window points (row, column) (k, 2) in projector pixels."""
        world = self._local(points) @ self.map.turn.T
        return np.asarray(world / np.linalg.norm(world, axis=1, keepdims=True))

    def _local(self, points: FloatArray) -> FloatArray:
        projector = self._projector
        u = (projector.first_column + points[:, 1]) / projector.canvas[1]
        v = (projector.first_row + points[:, 0]) / projector.canvas[0]
        return np.stack([self.map.x[0] * u + self.map.x[1], self.map.y[0] * v + self.map.y[1], np.ones(len(u))], axis=1)

    def _irradiance(self, points: FloatArray, wavelengths: Any) -> FloatArray:
        """(k, channels) irradiance on the plane at unit distance that window points (k, 2) cast [W m^-2]."""
        _, emitted, depth, cosine = _asked(
            self._projector.emitter, self.origin, self.map.turn, self._local(points), wavelengths
        )
        return channels(mi.unpolarized_spectrum(emitted), len(points)) * (cosine * depth**2)[:, None]


def _asked(
    emitter: Any, origin: FloatArray, turn: FloatArray, local: FloatArray, wavelengths: Any
) -> tuple[Any, Any, float, FloatArray]:
    """A projector's direction sample at points in ``local`` directions (k, 3): sample, light, depth [mm], cosines.

    The depth is large enough that float32 coordinates do not matter.
    """
    depth = 1000 * max(1.0, float(np.abs(origin).max()) / 100)
    forward = turn[:, 2] / np.linalg.norm(turn[:, 2])
    world = local @ turn.T
    world *= depth / (world @ forward)[:, None]
    interaction = dr.zeros(mi.SurfaceInteraction3f, len(local))
    interaction.p = mi.Point3f((origin + world).T.astype(np.float32))
    if wavelengths is not None:
        interaction.wavelengths = wavelengths
    sample, emitted = emitter.sample_direction(interaction, mi.Point2f(0.5), True)
    return sample, emitted, depth, depth / np.linalg.norm(world, axis=1)


def host(values: Any, count: int) -> npt.NDArray[Any]:
    """(count,) of a Dr.Jit array that may hold one number for all."""
    array = np.array(values)
    array = array.astype(np.float64) if array.dtype.kind == "f" else array
    return np.broadcast_to(array.reshape(-1), (count,))


def vectors(values: Any, count: int) -> FloatArray:
    """(count, 3) of a Dr.Jit vector."""
    return np.stack([host(part, count) for part in (values.x, values.y, values.z)], axis=1)


def channels(spectrum: Any, count: int) -> FloatArray:
    """(count, channels) of a spectrum."""
    return np.stack([host(spectrum[i], count) for i in range(len(spectrum))], axis=1)

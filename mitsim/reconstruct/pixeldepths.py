"""Measurements and a depth for each projector pixel in, the image out; and how depths should change to explain more.

Of a frame under dots Y = sum_p X_p l_p(z_p) r_p(z_p)^T over its lit pixels p, with columns of both factors at the
pixels' own depths. The normal matrix of a frame is (L^T L) o (R^T R), a number for each pair of lit pixels; frames
of dots share no pixel, so they are solved one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.measurement import Measurement
from mitsim.reconstruct.alldepths import AllDepths

_SMALL = 1e-3
"""Lambda over the mean diagonal of the normal matrix while depths are looked for: images under 98 dots differ by 0.1 dB
from 1e-2 to 1e-4."""
_LARGEST = 1e-2
"""The same of the last image at most: noise asks for more only where there is no image."""
_MOST_LIT = 4096
"""Pixels of one frame: their normal matrix has 128 MiB, and takes seconds to factorise."""
_CUBIC = np.array([[0, -2, 3, -1], [6, -3, -6, 3], [0, 6, 3, -3], [0, -1, 0, 1]]) / 6
"""Lagrange's cubic through -1, 0, 1, 2: weight of each by power of the place."""


@dataclass(frozen=True, eq=False)
class Solved:
    """An ``image`` (n, n') at given depths, its ``lam``, and the energy that it leaves over."""

    image: FloatArray
    lam: float
    left_over: float


class PixelDepths:
    """The model with a depth for each projector pixel.

    Parameters
    ----------
    depths
        frames and factors.
    limit, step
        largest change of 1/z [1/mm], and the distance between those that columns are computed at; others lie on a cubic
        between them.
    """

    def __init__(self, depths: AllDepths, limit: float, step: float) -> None:
        self._all = depths
        self._shifts = np.linspace(-limit, limit, max(2 * int(np.ceil(limit / step)) + 1, len(_CUBIC)))
        self._tables = [np.stack([depths.side(axis, shift).T for shift in self._shifts], axis=1) for axis in (0, 1)]
        self._lit = [[np.flatnonzero(column) for column in patterns.T] for patterns in depths.patterns]
        most = max(len(row) for row in self._lit[0]) * max(len(column) for column in self._lit[1])
        if most > _MOST_LIT:
            raise MitsimError(
                f"focus map: {most} pixels are lit at a time, and {_MOST_LIT} can be told; use dots further apart"
            )
        middle = len(self._shifts) // 2
        left, right = (float(np.square(table[:, middle]).sum(axis=1).mean()) for table in self._tables)
        self._scale = left * right

    def solve(self, shift: FloatArray, lam: float | None = None) -> Solved:
        """The image with 1/z of each pixel changed by ``shift`` (n, n') [1/mm]; ``lam`` None: a small one."""
        lam = _SMALL * self._scale if lam is None else lam
        image, left_over = np.zeros(shift.shape), self._all.outside
        for frame in self._all.frames:
            lit = self._pixels(frame)
            left, right = (self._columns(axis, place, shift[lit]) for axis, place in enumerate(lit))
            normal, data = (left @ left.T) * (right @ right.T), ((left @ frame.frame) * right).sum(axis=1)
            found = np.linalg.solve(normal + lam * np.eye(len(data)), data)
            image[lit] = found
            left_over += float(np.square(frame.frame).sum() + found @ (normal @ found - 2 * data))
        return Solved(image, lam, left_over)

    def variance(self, solved: Solved) -> float:
        """Of a datum, from what a ``solved`` image leaves over, less a reflectance and a depth for each pixel."""
        return float(solved.left_over / max(self._all.data - 2 * solved.image.size, 1))

    def final(self, shift: FloatArray, solved: Solved) -> Solved:
        """The image at the lambda that its own residual asks for: variance of a datum over the mean square of pixels.

        Parameters
        ----------
        shift, solved
            depths, and the image at them.
        """
        ideal = self.variance(solved) / max(float(np.square(solved.image).mean()), np.finfo(float).tiny)
        return self.solve(shift, min(ideal, _LARGEST * self._scale))

    def step(self, shift: FloatArray, unit: float) -> tuple[FloatArray, FloatArray]:
        """Image X and X o d, both (n, n'), that explain most together; d changes ``shift``, in ``unit`` [1/mm]."""
        lam, image, moved = _SMALL * self._scale, np.zeros(shift.shape), np.zeros(shift.shape)
        for frame in self._all.frames:
            lit = self._pixels(frame)
            (u, du), (v, dv) = (
                (self._columns(axis, place, shift[lit]), unit * self._columns(axis, place, shift[lit], slope=True))
                for axis, place in enumerate(lit)
            )
            # Columns of the model are u v^T, and by d du v^T + u dv^T.
            uu, uv, vv = u @ u.T, (u @ du.T, v @ dv.T), v @ v.T
            across = uv[0] * vv + uu * uv[1]
            own = (du @ du.T) * vv + uu * (dv @ dv.T) + uv[0].T * uv[1] + uv[0] * uv[1].T
            normal = np.block([[uu * vv, across], [across.T, own]])
            seen, slid = u @ frame.frame, du @ frame.frame
            data = np.concatenate([(seen * v).sum(axis=1), (slid * v + seen * dv).sum(axis=1)])
            both = np.linalg.solve(normal + lam * np.eye(len(data)), data)
            image[lit], moved[lit] = np.split(both, 2)
        return image, moved

    def gains(self, shift: FloatArray, image: FloatArray, others: Sequence[FloatArray]) -> FloatArray:
        """(len(``others``), n, n') energy that each pixel alone explains more at another change of 1/z.

        Pixels of a frame lie a period apart and hardly share measurements, so each is weighed with all else as it is.

        Parameters
        ----------
        shift, image
            (n, n') changes of 1/z, and the image at them.
        others
            (n, n') changes of 1/z that are tried.
        """
        gains = np.zeros((len(others), *shift.shape))
        for frame in self._all.frames:
            lit = self._pixels(frame)
            left, right = self._columns(0, lit[0], shift[lit]), self._columns(1, lit[1], shift[lit])
            rest = frame.frame - (left * image[lit][:, None]).T @ right
            for index, other in enumerate((shift, *others)):
                u, v = self._columns(0, lit[0], other[lit]), self._columns(1, lit[1], other[lit])
                own = image[lit] * (left * u).sum(axis=1) * (right * v).sum(axis=1)
                size = np.square(u).sum(axis=1) * np.square(v).sum(axis=1)
                explained = np.square(((u @ rest) * v).sum(axis=1) + own) / size
                if index == 0:
                    gains[:, lit[0], lit[1]] -= explained
                else:
                    gains[index - 1][lit] += explained
        return gains

    def _pixels(self, frame: Measurement) -> tuple[np.ndarray, np.ndarray]:
        rows, columns = np.meshgrid(self._lit[0][frame.row], self._lit[1][frame.column], indexing="ij")
        return rows.ravel(), columns.ravel()

    def _columns(self, axis: int, pixels: np.ndarray, shift: FloatArray, slope: bool = False) -> FloatArray:
        """(k, r) columns of the ``pixels`` of an axis at changes ``shift`` (k,) of 1/z, or their derivative by it."""
        step = self._shifts[1] - self._shifts[0]
        place = (shift - self._shifts[0]) / step
        start = np.clip(np.floor(place).astype(np.intp), 1, len(self._shifts) - 3)
        part = place - start
        one, zero = np.ones_like(part), np.zeros_like(part)
        powers = [zero, one / step, 2 * part / step, 3 * part**2 / step] if slope else [one, part, part**2, part**3]
        weights = _CUBIC @ np.stack(powers)
        table = self._tables[axis]
        return np.asarray(sum(weight[:, None] * table[pixels, start + k - 1] for k, weight in enumerate(weights)))

"""Checks of shifting dots: each frame against the picture that all other frames show.

Under shifting dots every scene pixel is in one frame only, so that a frame of another scene, of another lamp power or
of a moved camera fits the model as well as a right one. The only redundancy is the picture: neighbouring scene pixels
are in different frames. A symmetric stencil of neighbours, fitted to the run itself, predicts each pixel from other
frames. Three measurements follow from the differences r between pixels and predictions:

1. the mean of log(1 + u^2) over a frame, u being r over its robust scale: a foreign frame stands out;
2. least squares of the power and then of the shift of all frames, because a frame of power 1 + a adds a X at its own
   pixels and changes the predictions of its neighbours;
3. the same mean as in 1 over windows of a few dots and one to four consecutive shots: a hand in a few frames stands
out.

What the picture leaves undecided is stated as a standard error of the power and of the place of single frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy.ndimage import correlate1d, uniform_filter
from scipy.optimize import nnls
from scipy.sparse import csr_matrix

from mitsim.core.arrays import FloatArray
from mitsim.reconstruct.factorisation import IndexArray

_POWER, _SHIFT = 0.1, 0.5
"""Standard deviations of the power of a frame and of its place [scene pixels] before the frames are seen."""
_SCALES = 8.0, 3.0, 1.0, 1.0
"""Scales of the rounds of reweighted least squares, because small ones at once end in another minimum."""
_PIXELS, _FEWEST = 2500, 4
"""Pixels to which the stencil is fitted at most, to save time; and pixels for each number that is fitted, below which
the picture decides nothing."""
_WINDOWS, _LONGEST = (3, 5), 4
"""Dots along each side of the windows, and most consecutive shots, in which a disturbance is looked for."""
_FEW, _OF_NORMAL = 0.2, 0.253
"""Part of the frames that no disturbance reaches, and the quantile of the size of normal numbers there."""
_BLACK, _DARKER = 6.0, 1.5
"""Deviations of noise up to which a frame has no light, and weight of its deviation, because no good frame lacks all of
what the picture predicts."""
_MOST, _FIXED = 3.0, 1e12
"""Scales at which a single pixel's difference counts in full, because edges of a print reach more; and weight with
which the mean change of all frames is held at zero."""
_UNDERSTATED = 2.0
"""Scatter of powers and places in good runs over their standard errors, at most, because neighbours share errors."""
_UNMOVED, _SHARED = 0.3, 0.25
"""Part of the frames that a wrong one leaves as they are, and part of the differences that pixels along a line share
from which the picture varies in one direction only, and decides nothing."""


def robust_scatter(values: FloatArray) -> float:
    """Return 1.4826 times the median absolute deviation of ``values``, the standard deviation of normal numbers."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


class PictureCheck:
    """What the picture decides of the frames of a run of shifting dots, in the order of its K shots.

    Parameters
    ----------
    image
        (n, n') the image, reflectance.
    frame_of
        (n, n') number of the shot that lights each pixel.
    periods
        scene pixels from one dot to the next along rows and columns.
    noise
        (n, n') variance of the image by the frames' noise.

    Attributes
    ----------
    decides
        whether the picture is large enough to decide anything; without it there are no other attributes.
    power, power_error
        (K,) relative power of each frame beyond the mean, and its standard error.
    predicted
        standard error with which the other frames predict a pixel, reflectance.
    foreign, disturbed
        (K,) robust deviations of the whole frame, and of its most deviating window, from those of other frames.
    """

    def __init__(self, image: FloatArray, frame_of: IndexArray, periods: Sequence[int], noise: FloatArray) -> None:
        self._shape, self._frames, self._noise = image.shape, frame_of.ravel(), noise.ravel()
        self._count, self._floor = int(frame_of.max()) + 1, 1e-9 * float(np.abs(image).max()) + 1e-300
        reach, width = [2 if size >= 24 else 1 for size in image.shape], image.shape[1]
        inner = (np.arange(far, size - far) for far, size in zip(reach, image.shape, strict=True))
        self._pixels: IndexArray = np.ravel_multi_index(np.meshgrid(*inner, indexing="ij"), image.shape).ravel()
        own = self._frames[self._pixels]
        offsets = [y * width + x for y in range(reach[0] + 1) for x in range(-reach[1], reach[1] + 1) if y or x > 0]
        near = {each: self._frames[np.stack([self._pixels + each, self._pixels - each])] for each in offsets}
        self._offsets = [each for each, frames in near.items() if (frames != own).all()]
        self._weights = np.full(len(self._offsets) + 2, 1.0 / max(len(self._offsets), 1))
        self.decides = bool(self._offsets) and len(own) >= _FEWEST * (self._count + len(self._offsets))
        if not self.decides:
            return
        self._some = np.random.default_rng(0).choice(self._pixels, min(len(own), _PIXELS), replace=False)
        # Differences along a line of pixels that the same frame lights share their error.
        along = [axis for axis in (0, 1) if (np.diff(frame_of, axis=axis) == 0).all()]
        self._line_of: IndexArray = np.indices(image.shape)[1 - along[0]].ravel() if along else np.arange(image.size)
        self.power, self.power_error = self._fit(image, [image], _POWER, _SCALES)
        self._even = image * (1 - self.power[frame_of])
        left_over = self._differences(self._even)
        differences = left_over / self._scale(left_over, self._pixels)
        self.predicted = float(np.sqrt(np.mean(np.square(left_over))))
        moved, roughness = np.clip(differences, -_MOST, _MOST), np.log1p(np.square(differences))
        # Along a line, bars of a print make the same difference of all pixels. A wrong frame does so, too, but leaves a
        # part of the frames as they are.
        number = np.bincount(lines := self._line_of[self._pixels])
        shared = (np.bincount(lines, moved) / np.maximum(number, 1))[lines] * moved
        parts = np.bincount(own, shared, self._count) / (np.bincount(own, moved**2, self._count) + 1e-300)
        alike = max(float(np.quantile(parts, _UNMOVED)) * number.max(), 1.0)
        lit = np.maximum(np.bincount(own, minlength=self._count), 1)
        lack = -self._differences(image)
        means, shown, missing, squares, noises = (
            np.bincount(own, each, self._count) / lit
            for each in (roughness, image.ravel()[self._pixels], lack, np.square(lack), self._noise[self._pixels])
        )
        away = means - np.median(means)
        self.foreign = away / np.maximum(robust_scatter(means), np.sqrt(alike * roughness.var() / lit))
        # A black frame decides nothing of its own power, but its mean is far below the predicted one.
        black = (np.square(shown) < _BLACK**2 * noises / lit) & (missing > shown)
        chance = np.sqrt(alike * np.maximum(squares - np.square(missing), 0.0) / lit) + 1e-300
        self.foreign = np.maximum(self.foreign, np.where(black, _DARKER * missing / chance, 0.0))
        self.decides = bool(black.any() or alike - 1 <= _SHARED * (number.max() - 1))
        common = float(shared.sum() / (np.square(moved).sum() + 1e-300)) if along else 0.0
        self.disturbed = self._disturbance(moved, periods, common)

    @cached_property
    def place(self) -> tuple[FloatArray, FloatArray]:
        """The place (2, K) of each frame along rows and columns [scene pixels], and its standard error."""
        # Looked for in the picture without the powers, because in even parts these look like a slope.
        place, error = self._fit(self._even, [*np.gradient(self._even)], _SHIFT)
        return place.reshape(2, -1), error.reshape(2, -1)

    def uncertainty(self, image: FloatArray) -> FloatArray:
        """Return (n, n') standard uncertainty of an ``image`` (n, n') by the power and the place of single frames.

        Of the scatter of the powers and places over the frames, the part that their own errors explain is no change of
        lamp, camera or scene. The variance that remains is stated, and at least its standard error, because a flicker
        as small as the errors is not seen. A regular print makes a part of the scatter, which cannot be told from a
        flicker.
        """
        found, errors = (
            np.stack([own, *others]) for own, others in zip((self.power, self.power_error), self.place, strict=True)
        )
        scatter, known = np.var(found, axis=1), np.mean(np.square(_UNDERSTATED * errors), axis=1)
        power, *moves = np.sqrt(np.maximum(scatter - known, scatter * np.sqrt(2 / self._count)))
        variance = np.square(image * power)
        for axis, move in enumerate(moves):  # to either side, because a slope over both misses the finest print
            for step in ([0.0, -1.0, 1.0], [-1.0, 1.0, 0.0]):
                variance += np.square(move * correlate1d(image, step, axis, mode="nearest")) / 2
        return np.asarray(np.sqrt(variance))

    def _disturbance(self, moved: FloatArray, periods: Sequence[int], common: float) -> FloatArray:
        """Return the largest deviation (K,) of the mean of a window of each frame, alone and with up to three later.

        Parameters
        ----------
        moved
            differences of pixels from their predictions in units of their scale, limited.
        periods
            as of the class.
        common
            part of the differences' energy that pixels along a line share.
        """
        cells = [
            place // each for place, each in zip(np.unravel_index(self._pixels, self._shape), periods, strict=True)
        ]
        shape = self._count, *(-(-size // period) for size, period in zip(self._shape, periods, strict=True))
        index = np.ravel_multi_index((self._frames[self._pixels], *cells), shape)
        parts = [np.bincount(index, weights, int(np.prod(shape))).reshape(shape) for weights in (moved, moved**2, None)]
        found, spread = np.zeros(self._count), float(np.mean(np.square(moved)))
        for dots in _WINDOWS:
            light, power, lit = (
                uniform_filter(part * 1.0, (0, dots, dots), mode="constant") * dots**2 for part in parts
            )
            # Windows over a texture of the print scatter more than others, in all frames.
            usual = np.maximum(np.median(power / np.maximum(lit, 1), axis=0), spread) * (1 + (dots - 1) * common)
            for length in range(1, min(_LONGEST, self._count // 3) + 1):
                runs = range(self._count - length + 1)
                total, number = (np.stack([part[k : k + length].sum(axis=0) for k in runs]) for part in (light, lit))
                scores = np.abs(total) / np.sqrt(np.maximum(number, dots**2 * length / 2) * usual + 1e-300)
                # A texture with a period of its own deviates in most frames, and a disturbance in few.
                few = int(_FEW * (len(scores) - 1))
                scores /= np.maximum(np.partition(scores, few, axis=0)[few] / _OF_NORMAL, 1.0)
                for k, worst in enumerate(scores.max(axis=(1, 2))):
                    found[k : k + length] = np.maximum(found[k : k + length], worst)
        return found

    def _fit(
        self, image: FloatArray, changes: Sequence[FloatArray], prior: float, learned: Sequence[float] = ()
    ) -> tuple[FloatArray, FloatArray]:
        """Fit how far each frame is off by each of the ``changes`` (n, n') of an ``image`` (n, n').

        Returns the parameters, change by change, and their standard errors by the sandwich estimator (Huber 1967),
        which does not take differences for normal numbers. Parameters have a normal ``prior``. Least squares are
        reweighted by Cauchy's weights, because edges of the print are outliers; with scales ``learned`` for these, the
        stencil is fitted, too.

        The stencil has no negative weights, because these imitate a lamp that flickers in the period of the dots. A
        stencil along the other direction may still do so, and the errors of the powers then show it.
        """
        own, target = self._pairs(image, self._some), image.ravel()[self._some]
        # The same change of all frames is a change of the picture, and is held at zero.
        known = np.kron(np.eye(len(changes)), np.eye(self._count) / prior**2 + _FIXED)
        found, left_over = np.zeros(len(known)), target - own @ self._weights
        design = self._sensitivity(changes)
        for wider in learned or (1.0, 1.0):
            weights = 1 / (np.square(wider * self._scale(left_over, self._some)) + np.square(left_over))
            if learned:
                normal = own.T @ (weights[:, None] * own)
                normal[np.diag_indices_from(normal)] += 1e-9 * np.trace(normal)
                root = np.linalg.cholesky(normal)
                side = own.T @ (weights * (target - design @ found))
                self._weights = nnls(root.T, np.linalg.solve(root, side))[0]
                design = self._sensitivity(changes)
            rest, weighted = target - own @ self._weights, design.multiply(weights[:, None]).tocsr()
            inverse = np.linalg.inv((weighted.T @ design).toarray() + known)
            found = inverse @ (weighted.T @ rest)
            left_over = rest - design @ found
        lines, place = self._line_of[self._some], np.arange(len(self._some))
        scores = csr_matrix((np.ones(len(lines)), (lines, place))) @ weighted.multiply(left_over[:, None]).tocsr()
        covariance = inverse @ ((scores.T @ scores).toarray() + np.eye(len(known)) / prior**2) @ inverse
        spare = max(len(left_over) - len(inverse), 1) / len(left_over)
        return found, np.sqrt(np.maximum(np.diag(covariance), 0.0) / spare)

    def _differences(self, image: FloatArray) -> FloatArray:
        """Return the pixels inside of an ``image`` (n, n') less what the stencil predicts of them."""
        return np.asarray(image.ravel()[self._pixels] - self._pairs(image, self._pixels) @ self._weights)

    def _scale(self, left_over: FloatArray, pixels: IndexArray) -> FloatArray:
        """Return the scale of the differences ``left_over`` of ``pixels``."""
        return np.maximum(np.sqrt(robust_scatter(left_over) ** 2 + self._noise[pixels]), self._floor)

    def _pairs(self, image: FloatArray, pixels: IndexArray) -> FloatArray:
        """Return the means of opposite neighbours (pixels, pairs), and a constant of either sign."""
        values, ones = image.ravel(), np.ones(len(pixels))
        pairs = [(values[pixels + each] + values[pixels - each]) / 2 for each in self._offsets]
        return np.stack([*pairs, ones, -ones], axis=1)

    def _sensitivity(self, changes: Sequence[FloatArray]) -> csr_matrix:
        """Return the change of pixels less their predictions (pixels, len(changes) K) by one frame alone."""
        place, near = np.arange(len(self._some)), zip(self._offsets, self._weights, strict=False)
        terms = [(0, 1.0), *((sign * offset, -weight / 2) for offset, weight in near for sign in (1, -1) if weight)]
        parts = [
            (weight * change.ravel()[places], place, self._frames[places] + number * self._count)
            for number, change in enumerate(changes)
            for offset, weight in terms
            for places in (self._some + offset,)
        ]
        values, rows, columns = (np.concatenate(part) for part in zip(*parts, strict=True))
        return csr_matrix((values, (rows, columns)), shape=(len(place), len(changes) * self._count))

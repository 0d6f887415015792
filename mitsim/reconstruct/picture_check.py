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
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter
from scipy.optimize import nnls
from scipy.sparse import csr_matrix

from mitsim.core.arrays import FloatArray

IntArray = npt.NDArray[np.intp]

_SCALES = 8.0, 3.0, 1.0, 1.0
"""Scales of the rounds of reweighted least squares, because small ones at once end in another minimum."""
_WINDOWS = 3, 5
"""Dots along each side of the windows in which a disturbance is looked for."""
_FEW, _OF_NORMAL = 0.2, 0.253
"""Part of the frames that no disturbance reaches, and the quantile of the size of normal numbers there."""
_BLACK, _DARK, _DARKER = 6.0, 0.5, 1.5
"""Deviations of noise up to which a frame has no light; part of its predicted light whose lack counts as
darkness; and weight of its deviation, because no good frame lacks so much."""
_MOST = 3.0
"""Scales at which a single pixel's difference counts in full: edges of a print reach more."""
_POWER, _SHIFT = 0.1, 0.5
"""Standard deviations of the power of a frame and of its place [scene pixels] before the picture is seen."""
_FIXED = 1e12
"""Weight with which the mean change of all frames is held at zero."""
_LONGEST = 4
"""Most consecutive shots in which one disturbance is looked for."""
_FEWEST = 4
"""Pixels for each number that is fitted, below which the picture decides nothing."""


@dataclass(frozen=True, eq=False)
class PictureCheck:
    """What the picture decides of the frames of a run of shifting dots, in the order of its K shots.

    Attributes
    ----------
    power, power_error
        (K,) relative power of each frame beyond the mean, and its standard error.
    shift, shift_error
        (2, K) place of each frame along rows and columns [scene pixels], and its standard error.
    foreign, disturbed
        (K,) robust deviations of the whole frame, and of its most deviating window, from those of other frames.
    """

    power: FloatArray
    power_error: FloatArray
    shift: FloatArray
    shift_error: FloatArray
    foreign: FloatArray
    disturbed: FloatArray

    def uncertainty(self, image: FloatArray) -> FloatArray:
        """Return (n, n') standard uncertainty of an ``image`` (n, n') by the power and the place of single frames:
        their scatter over the frames, beyond what the picture makes of it, which may be twice the errors."""
        power, *moves = (
            np.sqrt(max(robust_scatter(own) ** 2 - float(np.median(2 * error)) ** 2, 0.0))
            for own, error in ((self.power, self.power_error), *zip(self.shift, self.shift_error, strict=True))
        )
        parts = [image * power, *(slope * move for slope, move in zip(np.gradient(image), moves, strict=True))]
        return np.asarray(np.sqrt(sum(np.square(part) for part in parts)))


def robust_scatter(values: FloatArray) -> float:
    """Return 1.4826 times the median absolute deviation of ``values``, the standard deviation of normal numbers."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def check_picture(
    image: FloatArray, frame_of: IntArray, periods: Sequence[int], noise: FloatArray
) -> PictureCheck | None:
    """Compare each frame of shifting dots with the picture of the others; None where the picture is too small.

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
    """
    count = int(frame_of.max()) + 1
    stencil = _Stencil(image, frame_of)
    if not stencil.offsets or stencil.pixels.size < _FEWEST * (count + len(stencil.offsets)):
        return None
    power, power_error, differences = stencil.fit(count, noise, _POWER)
    predicted = stencil.predict(image)
    # A shift is looked for in the picture without the powers, because in even parts these look like a slope.
    even = image / np.maximum(1 + power, _POWER)[frame_of]
    shift, shift_error = stencil.fit_with_weights(even, [*np.gradient(even)], count, noise, _SHIFT)
    own = frame_of.ravel()[stencil.pixels]
    lit = np.maximum(np.bincount(own, minlength=count), 1)
    roughness = np.log1p(np.square(differences))
    means = np.bincount(own, roughness, count) / lit
    foreign = (means - np.median(means)) / np.maximum(robust_scatter(means), np.sqrt(roughness.var() / lit))
    # A black frame decides nothing of its own power, but its mean is far below the predicted one.
    missing = np.bincount(own, predicted - image.ravel()[stencil.pixels], count) / lit
    squares = np.bincount(own, np.square(predicted - image.ravel()[stencil.pixels]), count) / lit
    shown = np.bincount(own, predicted, count) / lit
    black = np.square(shown - missing) < _BLACK**2 * np.bincount(own, noise.ravel()[stencil.pixels], count) / lit**2
    dark = black & (missing > _DARK * shown)
    chance = np.sqrt(np.maximum(squares - np.square(missing), 0.0) / lit) + 1e-300
    foreign = np.maximum(foreign, np.where(dark, _DARKER * missing / chance, 0.0))
    disturbed = _disturbance(stencil, own, np.clip(differences, -_MOST, _MOST), periods, count)
    return PictureCheck(power, power_error, shift.reshape(2, -1), shift_error.reshape(2, -1), foreign, disturbed)


def _solve(
    design: csr_matrix, weights: FloatArray, rest: FloatArray, prior: float, count: int
) -> tuple[FloatArray, FloatArray, csr_matrix]:
    """Return weighted least squares of ``rest``, the inverse of the normal matrix, and the weighted design.

    The same change of all ``count`` frames is a change of the picture, and is held at zero.
    """
    size = design.shape[1]
    known = np.eye(size) / prior**2 + np.kron(np.eye(size // count), np.full((count, count), _FIXED))
    weighted = design.multiply(weights[:, None]).tocsr()
    inverse = np.linalg.inv((weighted.T @ design).toarray() + known)
    return inverse @ (weighted.T @ rest), inverse, weighted


def _errors(weighted: csr_matrix, inverse: FloatArray, left_over: FloatArray, prior: float, count: int) -> FloatArray:
    """Return the standard errors of the sandwich estimator (Huber 1967), which does not take differences for normal
    numbers."""
    scores = weighted.multiply(left_over[:, None]).tocsr()
    known = np.eye(len(inverse)) / prior**2
    covariance = inverse @ ((scores.T @ scores).toarray() + known) @ inverse
    spare = max(len(left_over) - len(inverse), 1) / len(left_over)
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0) / spare))


def _disturbance(stencil: _Stencil, own: IntArray, moved: FloatArray, periods: Sequence[int], count: int) -> FloatArray:
    """Return the largest deviation (K,) of the mean of a window of each frame, alone and with up to three later ones.

    ``moved`` are the differences of pixels from their predictions in units of their scale, limited.
    """
    places = np.unravel_index(stencil.pixels, stencil.shape)
    cells = [place // period for place, period in zip(places, periods, strict=True)]
    shape = count, *(-(-size // period) for size, period in zip(stencil.shape, periods, strict=True))
    index = np.ravel_multi_index((own, *cells), shape)
    parts = [np.bincount(index, weights, int(np.prod(shape))).reshape(shape) for weights in (moved, moved**2, None)]
    found, spread = np.zeros(count), float(np.mean(np.square(moved)))
    for dots in _WINDOWS:
        light, power, lit = (uniform_filter(part * 1.0, (0, dots, dots), mode="constant") * dots**2 for part in parts)
        # Windows over a texture of the print scatter more than others, in all frames.
        usual = np.maximum(np.median(power / np.maximum(lit, 1), axis=0), spread)
        for length in range(1, min(_LONGEST, count // 3) + 1):
            runs = range(count - length + 1)
            total, number = (np.stack([part[k : k + length].sum(axis=0) for k in runs]) for part in (light, lit))
            scores = np.abs(total) / np.sqrt(np.maximum(number, dots**2 * length / 2) * usual + 1e-300)
            # A texture with a period of its own deviates in most frames, and a disturbance in few.
            scores /= np.maximum(np.quantile(scores, _FEW, axis=0) / _OF_NORMAL, 1.0)
            for k, worst in enumerate(scores.max(axis=(1, 2))):
                found[k : k + length] = np.maximum(found[k : k + length], worst)
    return found


class _Stencil:
    """Predicts pixels from the means of pairs of opposite neighbours, none of which is in the pixel's own frame."""

    def __init__(self, image: FloatArray, frame_of: IntArray) -> None:
        self.shape, self._image, self._frames = image.shape, image.ravel(), frame_of.ravel()
        reach = [2 if size >= 24 else 1 for size in self.shape]
        inner = (np.arange(far, size - far) for far, size in zip(reach, self.shape, strict=True))
        self.pixels: IntArray = np.ravel_multi_index(np.meshgrid(*inner, indexing="ij"), self.shape).ravel()
        width, own = self.shape[1], self._frames[self.pixels]
        offsets = [y * width + x for y in range(reach[0] + 1) for x in range(-reach[1], reach[1] + 1) if y or x > 0]
        self.offsets = [
            each for each in offsets if all((self._frames[self.pixels + sign * each] != own).all() for sign in (1, -1))
        ]

    def fit(self, count: int, noise: FloatArray, prior: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Fit the stencil together with the power of each frame.

        Returns the ``count`` relative powers, their standard errors, and the differences of the pixels from their
        predictions in units of their scale. Least squares are reweighted by Cauchy's weights, because edges of the
        print are outliers; powers have a normal ``prior``.

        The stencil has no negative weights, because these imitate a lamp that flickers in the period of the dots. A
        stencil along the other direction may still do so, and the errors of the powers then show it.
        """
        image = self._image.reshape(self.shape)
        own, target = self._pairs(self._image), self._image[self.pixels]
        self.weights, found = np.full(own.shape[1], 1.0 / len(self.offsets)), np.zeros(count)
        left_over = target - own @ self.weights
        design = self._sensitivity([image], count)
        for wider in _SCALES:
            weights = self._robust(left_over, noise, wider)[0]
            explained = target - design @ found
            normal = own.T @ (weights[:, None] * own)
            normal[np.diag_indices_from(normal)] += 1e-9 * np.trace(normal)
            root = np.linalg.cholesky(normal)
            self.weights = nnls(root.T, np.linalg.solve(root, own.T @ (weights * explained)))[0]
            design = self._sensitivity([image], count)
            rest = target - own @ self.weights
            found, inverse, weighted = _solve(design, weights, rest, prior, count)
            left_over = rest - design @ found
        errors = _errors(weighted, inverse, left_over, prior, count)
        return found, errors, left_over / self._robust(left_over, noise, 1.0)[1]

    def fit_with_weights(
        self, image: FloatArray, changes: Sequence[FloatArray], count: int, noise: FloatArray, prior: float
    ) -> tuple[FloatArray, FloatArray]:
        """Fit how far each frame is off by each of the ``changes`` (n, n') of an ``image`` (n, n') with the present
        stencil; return the parameters and their standard errors."""
        rest = image.ravel()[self.pixels] - self.predict(image)
        design, left_over = self._sensitivity(changes, count), rest
        for _ in range(2):
            weights = self._robust(left_over, noise, 1.0)[0]
            found, inverse, weighted = _solve(design, weights, rest, prior, count)
            left_over = rest - design @ found
        return found, _errors(weighted, inverse, left_over, prior, count)

    def predict(self, image: FloatArray) -> FloatArray:
        """Return the pixels inside as the stencil predicts them from an ``image`` (n, n')."""
        return np.asarray(self._pairs(image.ravel()) @ self.weights)

    def _pairs(self, values: FloatArray) -> FloatArray:
        """Return the means of opposite neighbours (pixels, pairs), and a constant of either sign."""
        pairs = [(values[self.pixels + each] + values[self.pixels - each]) / 2 for each in self.offsets]
        ones = np.ones(len(self.pixels))
        return np.stack([*pairs, ones, -ones], axis=1)

    def _robust(self, left_over: FloatArray, noise: FloatArray, wider: float) -> tuple[FloatArray, FloatArray]:
        """Return Cauchy's weights of differences, and their scale."""
        floor = 1e-9 * float(np.abs(self._image).max()) + 1e-300
        scale = np.maximum(np.sqrt(robust_scatter(left_over) ** 2 + noise.ravel()[self.pixels]), floor)
        return 1 / (np.square(wider * scale) + np.square(left_over)), scale

    def _sensitivity(self, changes: Sequence[FloatArray], count: int) -> csr_matrix:
        """Return the change of pixels less their predictions (pixels, len(changes) count) by one frame alone."""
        place, terms = np.arange(len(self.pixels)), [(0, 1.0)]
        for offset, weight in zip(self.offsets, self.weights, strict=False):
            terms += [(offset, -weight / 2), (-offset, -weight / 2)] if weight else []
        parts = [
            (weight * change.ravel()[self.pixels + offset], place, self._frames[self.pixels + offset] + number * count)
            for number, change in enumerate(changes)
            for offset, weight in terms
        ]
        values, rows, columns = (np.concatenate(part) for part in zip(*parts, strict=True))
        return csr_matrix((values, (rows, columns)), shape=(len(place), len(changes) * count))

"""Compare the residual of the factorised model with the noise of the measurements.

If a run does not fit its model to within its noise, it is flagged. The flag names the place of the misfit, and readings
of the data that restore the fit. Four measurements decide, in this order:

1. Noise: second differences of the residuals (:mod:`mitsim.reconstruct.residuals`).
2. Energy: the residuals' energy beyond that of noise, calibration error, rendering and print finer than a scene pixel,
   for the whole sensor, its tiles, rows, columns and pixels.
3. Frames: each frame against the prediction of the others (:class:`FrameCheck`).
4. Readings, if one of the first three fails: turned frames and shots in another order.

docs/reconstruction.md explains the checks of frames, and of pictures under shifting dots, whose frames share no pixel.
Readings of defective pixels are replaced by the prediction from all others: y - r / (1 - h) at a datum of residual r
and leverage h leaves an image as if it had not been measured. Pixels that share frames are set in rounds.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np
from scipy.ndimage import correlate1d, maximum_filter, uniform_filter
from scipy.optimize import nnls
from scipy.sparse import csr_matrix

from mitsim.core.arrays import FloatArray, sum_of_squares
from mitsim.core.runs import Measurement
from mitsim.reconstruct.accumulation import CHANCE, OFF, TINY, Accumulation, DerivedCapture, FrameNoise, print_energy
from mitsim.reconstruct.factors import decibels
from mitsim.reconstruct.residuals import NoiseTest, Place, Reading, Residuals, find_readings, is_negative
from mitsim.reconstruct.solver import IndexArray, Pair, Solution, Status, robust_scatter
from mitsim.reconstruct.uncertainty import Propagation

# ---- The picture of shifting dots -----------------------------------------------------------------------------------

_SCALES = 8.0, 3.0, 1.0, 1.0
_PIXELS, _FEWEST = 2500, 4
_WINDOWS, _LONGEST = (3, 5), 4
_CLIPPED, _FIXED = 3.0, 1e12


class PictureCheck:
    """Comparison of each frame of shifting dots with the picture that the other frames show.

    ``frame_of`` (n, n') is the number of the shot that lights each pixel; ``foreign`` and ``disturbed`` (K,) are
    robust deviations of the whole frame and of its worst window. Results exist only if the picture is large enough
    (``decides``).
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
        self.power, self.power_error = self._fit(image, [image], 0.1, _SCALES)
        self._even = image * (1 - self.power[frame_of])
        left_over = self._differences(self._even)
        differences = left_over / self._scale(left_over, self._pixels)
        self.predicted = float(np.sqrt(np.mean(np.square(left_over))))
        moved, roughness = np.clip(differences, -_CLIPPED, _CLIPPED), np.log1p(np.square(differences))
        # Along a line, bars of a print make the same difference of all pixels. A wrong frame does so, too, but leaves a
        # part of the frames as they are.
        number = np.bincount(lines := self._line_of[self._pixels])
        shared = (np.bincount(lines, moved) / np.maximum(number, 1))[lines] * moved
        parts = np.bincount(own, shared, self._count) / (np.bincount(own, moved**2, self._count) + 1e-300)
        alike = max(float(np.quantile(parts, 0.3)) * number.max(), 1.0)
        lit = np.maximum(np.bincount(own, minlength=self._count), 1)
        lack = -self._differences(image)
        sums = roughness, image.ravel()[self._pixels], lack, np.square(lack), self._noise[self._pixels]
        means, shown, missing, squares, noises = (np.bincount(own, each, self._count) / lit for each in sums)
        away = means - np.median(means)
        self.foreign = away / np.maximum(robust_scatter(means), np.sqrt(alike * roughness.var() / lit))
        # A black frame decides nothing of its own power, but its mean is far below the predicted one.
        black = (np.square(shown) < 6.0**2 * noises / lit) & (missing > shown)
        chance = np.sqrt(alike * np.maximum(squares - np.square(missing), 0.0) / lit) + 1e-300
        self.foreign = np.maximum(self.foreign, np.where(black, 1.5 * missing / chance, 0.0))
        self.decides = bool(black.any() or alike - 1 <= 0.25 * (number.max() - 1))
        common = float(shared.sum() / (np.square(moved).sum() + 1e-300)) if along else 0.0
        self.disturbed = self._disturbance(moved, periods, common)

    @cached_property
    def place(self) -> Pair:
        # Looked for in the picture without the powers, because in even parts these look like a slope.
        place, error = self._fit(self._even, [*np.gradient(self._even)], 0.5)
        return place.reshape(2, -1), error.reshape(2, -1)

    def uncertainty(self, image: FloatArray) -> FloatArray:
        """Return the (n, n') standard uncertainty that power and place of single frames cause in an ``image``.

        The scatter over the frames beyond its own error is stated, and at least its standard error, because a flicker
        as small as the errors is not seen.
        """
        found, errors = np.stack([self.power, *self.place[0]]), np.stack([self.power_error, *self.place[1]])
        scatter, known = np.var(found, axis=1), np.mean(np.square(2.0 * errors), axis=1)
        power, *moves = np.sqrt(np.maximum(scatter - known, scatter * np.sqrt(2 / self._count)))
        variance = np.square(image * power)
        for axis, move in enumerate(moves):  # to either side, because a slope over both misses the finest print
            for step in ([0.0, -1.0, 1.0], [-1.0, 1.0, 0.0]):
                variance += np.square(move * correlate1d(image, step, axis, mode="nearest")) / 2
        return np.asarray(np.sqrt(variance))

    def _disturbance(self, moved: FloatArray, periods: Sequence[int], common: float) -> FloatArray:
        places = np.unravel_index(self._pixels, self._shape)
        cells = [place // each for place, each in zip(places, periods, strict=True)]
        shape = self._count, *(-(-size // period) for size, period in zip(self._shape, periods, strict=True))
        index = np.ravel_multi_index((self._frames[self._pixels], *cells), shape)
        parts = [np.bincount(index, weights, int(np.prod(shape))).reshape(shape) for weights in (moved, moved**2, None)]
        found, spread = np.zeros(self._count), float(np.mean(np.square(moved)))
        for dots in _WINDOWS:
            size = 0, dots, dots
            light, power, lit = (uniform_filter(part * 1.0, size, mode="constant") * dots**2 for part in parts)
            # Windows over a texture of the print scatter more than others, in all frames.
            usual = np.maximum(np.median(power / np.maximum(lit, 1), axis=0), spread) * (1 + (dots - 1) * common)
            for length in range(1, min(_LONGEST, self._count // 3) + 1):
                runs = range(self._count - length + 1)
                total, number = (np.stack([part[k : k + length].sum(axis=0) for k in runs]) for part in (light, lit))
                scores = np.abs(total) / np.sqrt(np.maximum(number, dots**2 * length / 2) * usual + 1e-300)
                # A texture with a period of its own deviates in most frames, and a disturbance in few.
                few = int(0.2 * (len(scores) - 1))
                # Noise of pixels that share a frame is correlated, so that windows scatter more than single pixels.
                usual_score = max(float(np.median(scores)) / 0.6745, 1.0)
                scores /= np.maximum(np.partition(scores, few, axis=0)[few] / 0.253, usual_score)
                for k, worst in enumerate(scores.max(axis=(1, 2))):
                    found[k : k + length] = np.maximum(found[k : k + length], worst)
        return found

    def _fit(
        self, image: FloatArray, changes: Sequence[FloatArray], prior: float, learned: Sequence[float] = ()
    ) -> Pair:
        """Return how far each frame is off by each of the ``changes`` (n, n') of an ``image``, with errors.

        The errors are those of the sandwich estimator (Huber 1967), because differences are not normal. Least squares
        are reweighted by Cauchy's weights, because edges of the print are outliers. The stencil has no negative
        weights, because these imitate a lamp that flickers in the period of the dots.
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
        return np.asarray(image.ravel()[self._pixels] - self._pairs(image, self._pixels) @ self._weights)

    def _scale(self, left_over: FloatArray, pixels: IndexArray) -> FloatArray:
        return np.maximum(np.sqrt(robust_scatter(left_over) ** 2 + self._noise[pixels]), self._floor)

    def _pairs(self, image: FloatArray, pixels: IndexArray) -> FloatArray:
        values, ones = image.ravel(), np.ones(len(pixels))
        pairs = [(values[pixels + each] + values[pixels - each]) / 2 for each in self._offsets]
        return np.stack([*pairs, ones, -ones], axis=1)

    def _sensitivity(self, changes: Sequence[FloatArray]) -> csr_matrix:
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


# ---- Defective pixels -----------------------------------------------------------------------------------------------

_AROUND, _CROWD = 3, 0.35
_ROUNDS, _PLACES_SHOWN = 8, 5


@dataclass(frozen=True)
class Defects:
    """Defective pixels, by row and column."""

    places: list[tuple[int, int]]

    def __str__(self) -> str:
        count, more = len(self.places), ", ..." if len(self.places) > _PLACES_SHOWN else ""
        places = ", ".join(map(str, self.places[:_PLACES_SHOWN]))
        return f"{count} defective pixel{'s' * (count > 1)} left out, at (row, column) {places}{more}"

    def summary(self) -> dict[str, object]:
        return {"count": len(self.places), "first": self.places[:_PLACES_SHOWN]}

    def with_others(self, others: Defects | None) -> Defects:
        return Defects(sorted({*self.places, *(others.places if others else ())}))


class LeftOut(DerivedCapture):
    def __init__(self, data: Accumulation, defects: Defects) -> None:
        super().__init__(data.shots)
        rows, columns = np.array(defects.places).T
        self._data, self._places = data, (rows, columns)
        prepared, weights, whole = data.prepared, data.weights, data.lit_everywhere
        frames = ((each.row, each.column, prepared.as_solved(each.frame)) for each in data.measurements_again())
        values = {(row, column): frame[self._places] for row, column, frame in frames}
        self._moved = {pattern: np.zeros(len(rows)) for pattern in values}
        # If a reading changes, the means of its row and column take up their part.
        gain = (1 - 1 / prepared.left.sensor_size) * (1 - 1 / prepared.right.sensor_size) if prepared.centre else 1.0
        for _ in range(_ROUNDS):
            change = np.zeros_like(weights)
            for pattern, value in values.items():
                left, right = prepared.slabs(pattern)
                own, other = left.matrix[rows], right.matrix[columns]
                predicted = (own @ weights[left.columns][:, right.columns] * other).sum(axis=1)
                step = (predicted - value) / gain - self._moved[pattern]
                self._moved[pattern] += step
                change[prepared.places(pattern)] += own.T @ (step[:, None] * other)
            weights += change
        # The sum of the halves of a signed pattern, which is that of all pairs.
        self._total = prepared.frame(weights, whole)[self._places] if whole else np.zeros(len(rows))

    def pattern_measurements(self, shape: tuple[int, int] | None = None) -> Iterator[Measurement]:
        for each in self._data.measurements_again():
            frame, light = each.frame.copy(), each.light.copy()
            frame[self._places] += self._moved[each.row, each.column]
            light[self._places] = np.maximum(np.abs(frame[self._places]), self._total)
            yield replace(each, frame=frame, light=light)


def defects_of(squares: FloatArray, variance: FloatArray, count: int) -> Defects | None:
    mean = float(variance.mean()) or 1.0
    ratio = squares / np.clip(variance, 0.001 * mean, 4.0 * mean)
    limit, typical, most, width = _limit(count), (1 - 2 / (9 * count)) ** 3, float(ratio.max()), 2 * _AROUND + 1
    # What the scene's light is off by at a pixel may be the same in all frames: the square of one number.
    # What bright ones are off by leaks into others: these first.
    least = limit + _limit(1) * max(float(np.median(ratio)) / typical - 1, 0.0)
    off = (ratio > least) & (ratio > 0.1 * most)
    places = np.argwhere(off)
    if not most > limit or not 0 < len(places) <= 0.02 * ratio.size:
        return None
    padded = np.pad(ratio, _AROUND, mode="reflect")
    around = np.array([np.median(padded[row : row + width, column : column + width]) for row, column in places])
    # A spot of light is off in pixels side by side, and so are its edges.
    crowd = np.where(off, uniform_filter(off.astype(np.float64), width, mode="constant"), 0.0)
    kept = ratio[off] > limit * np.maximum(around / typical, 1.0)
    found = places[kept & (maximum_filter(crowd, width)[off] < _CROWD)].tolist()
    return Defects([(row, column) for row, column in found]) if found else None


def _limit(count: int) -> float:
    """Return the quantile of a chi-square of ``count`` degrees of freedom over ``count`` (Wilson and Hilferty 1931)."""
    return float((1 - 2 / (9 * count) + 7.0 * np.sqrt(2 / (9 * count))) ** 3)


# ---- Single frames ---------------------------------------------------------------------------------------------------

_MORE, _LEADING, _MOST_BAD = 12.0, 0.35, 0.25
_DOTS = "under dots each scene pixel is in one frame, so that only the picture shows a change of lamp, camera or scene."
_LEAKING = "Light of the room cancels. A projector that leaks it since it was calibrated darkens the image as much."
_REMEDY = "A closing frame (--closing-frame uniform) decides it."


@dataclass(frozen=True)
class FrameFault:
    kind: str
    numbers: tuple[int, ...]
    files: tuple[str, ...]
    words: str
    part: float = 0.0

    def summary(self) -> dict[str, Any]:
        return {"fault": self.kind, "frames": list(self.numbers), "files": list(self.files), "words": self.words}


class FrameCheck:
    """Tests of single frames; under shifting dots they use the ``picture`` that all frames show together."""

    def __init__(self, data: Accumulation, sums: Residuals, lam: float, ratio: float, beside: float) -> None:
        self._data, self._sums, self._beside = data, sums, beside
        self._variance, self._signed = ratio * data.noise.variance, data.noise.shots == 2
        self._shots, self._most = data.shots.manifest.patterns.captures, max(1, _MOST_BAD * data.noise.variance.size)
        self._number = {(shot.row, shot.column, shot.sign): index for index, shot in enumerate(self._shots)}
        spare = float(self._variance.sum()) * sums.squares.size * data.prepared.spare
        self._excess = float(sums.squares.sum()) - spare - beside
        # Errors of the factors differ from dot to dot, as those of a wrong frame do.
        self._doubt = float(np.sqrt(1 + beside / max(spare, TINY)))
        single = all(((side != 0).sum(axis=1) == 1).all() for side in data.shots.patterns)
        self._exclusive = single and not self._signed and self._variance.size > 1
        self.picture: PictureCheck | None = None
        if self._exclusive:
            seen, shape = Propagation(data.model, lam), self._variance.shape
            rows, columns = ((side != 0).argmax(axis=1) for side in data.shots.patterns)
            numbers = np.reshape([self._number.get((*pattern, 0), 0) for pattern in np.ndindex(*shape)], shape)
            image, noise = data.prepared.image(seen.gain * sums.weights), seen.of_white(float(self._variance.mean()))
            picture = PictureCheck(image, numbers[np.ix_(rows, columns)], shape, noise)
            self.picture = picture if picture.decides else None

    def faults(self) -> tuple[FrameFault, ...]:
        noise, count, sums, picture = self._data.noise, len(self._shots), self._sums, self.picture
        # The error of a coarse simulation differs by pattern, so that no frame is at fault.
        by_model = [] if noise.coarse else [*self._unlike_model()]
        found, powers = list[FrameFault](), list[FrameFault]()
        if abs(float(noise.means.sum())) < CHANCE * float(np.sqrt(noise.variance.sum() / sums.squares.size)):
            found.append(self._fault("dark", range(count), "holds no light" if count == 1 else "hold no light"))
        for digest, shots in sums.same.items():
            if digest and len(shots) > 1 and noise.variance.any():
                numbers = [self._number[shot] for shot in shots]
                found.append(self._fault("repeated", numbers, "are equal, noise and all"))
        for shot, readings in sums.clipped.items() if len(sums.clipped) <= self._most else ():
            words = f"has {readings} readings at its largest number"
            found.append(self._fault("clipped", [self._number[shot]], words))
        if picture is not None:
            foreign = np.flatnonzero(picture.foreign > 6.5 * self._doubt)
            if len(foreign):
                words = "show another picture than the frames around, dot by dot"
                powers.append(self._fault("picture", foreign, words))
            disturbed = np.flatnonzero(picture.disturbed > 7.5 * self._doubt)
            # Gloss is seen in some frames, too, but its light has no image: no frame is at fault.
            if len(disturbed) and not len(foreign) and self._excess < OFF**2 * float(sums.shots.sum()):
                strongest = disturbed[np.argsort(-picture.disturbed[disturbed])][:8]
                words = "show a part of the scene otherwise than the frames around"
                powers.append(self._fault("picture", strongest, words))
            powers += self._powers(picture.power, picture.power_error, range(count), 15.0)
        if len(sums.powers) >= 4 and noise.stated and not noise.coarse:
            power, error = np.concatenate([*sums.powers.values()], axis=1)
            numbers = [self._number[(*pattern, sign)] for pattern in sums.powers for sign in (1, -1)]
            powers += self._powers(power, error, numbers, CHANCE)
        # A lamp that flickers disturbs single frames by a few times its scatter; a wrong frame, the power of all.
        if by_model and by_model[0].part >= 4.0 * max((fault.part for fault in powers), default=0.0):
            found += by_model
        patterns = [(shot.row, shot.column) for shot in self._shots]
        named = {patterns[number] for fault in found for number in fault.numbers}
        powers = [each for each in powers if each.kind != "power" or not named & {patterns[n] for n in each.numbers}]
        return (*found, *powers, *self._closing())

    def _unlike_model(self) -> Iterator[FrameFault]:
        sums, count, noise = self._sums, self._variance.size, self._variance
        share = self._beside * sums.shots / max(float(sums.shots.sum()), TINY)
        tests = [(sums.leave_out - noise * sums.free - share, noise * np.sqrt(2 * sums.free))]
        if sums.powers:
            of_sums, whole = noise + noise.mean() / (count - 1), sums.squares.size / sums.compared
            beyond = whole * (sums.rest - of_sums * sums.compared) - share
            tests.append((beyond, 2 * whole * of_sums * np.sqrt(2 * sums.compared)))
        off, even = np.zeros(noise.shape), self._data.lit_everywhere
        for number, (beyond, chance) in enumerate(tests):
            part = np.maximum(beyond, 0.0) / np.maximum(sums.shots, np.median(sums.shots) + TINY)
            usual = float(np.median(part)) if count > 2 else float(part.max())
            bad = (beyond > CHANCE * chance) & (part > max(OFF**2, _MORE * usual)) & (part > _LEADING * part.max())
            # Gloss is in the even pattern above all. A wrong frame of it changes the sum of its pair, too, and
            # exchanged halves leave twice its light.
            if sums.powers and even and part[even] < 0.5 and not (tests[1][0] > CHANCE * tests[1][1])[even]:
                bad[even] = False
            # By the model, single frames are at fault only if they explain the misfit of the run.
            least = 0.9 * self._excess - CHANCE * float(np.sqrt(np.square(chance).sum()))
            if number or bad.sum() > self._most or beyond[bad].sum() >= least:
                off = np.maximum(off, np.where(bad, part, 0.0))
        worst = np.argwhere(off)[np.argsort(-off[off > 0])].tolist()
        for row, column in worst if len(worst) <= self._most else ():
            side = sums.side[row, column]  # it decides which half is at fault
            signs = [1, -1] if abs(side) < 0.3 else [int(np.sign(side))]
            numbers = [self._number[row, column, sign] for sign in (signs if self._signed else [0])]
            size = float(np.sqrt(off[row, column]))
            yield self._fault("model", numbers, f"differ by {size:.1%} from what the other frames predict", size)

    def _powers(self, power: FloatArray, error: FloatArray, of: Sequence[int], errors: float) -> Iterator[FrameFault]:
        scatter, middle = robust_scatter(power), float(np.median(power))
        single = np.abs(power - middle) > np.maximum(6.5 * np.maximum(error, scatter), 0.02)
        if single.any() and single.sum() <= max(1, _MOST_BAD * len(power)):
            for index in np.flatnonzero(single):
                words = f"has {1 + power[index] - middle:.2f} times the light that the others predict"
                yield self._fault("power", [of[int(index)]], words)
        elif single.any() or scatter > max(0.01, errors * float(np.median(error))):
            words = f"differ by {float(np.std(power)):.2%} in their power"
            yield self._fault("power", range(len(self._shots)), words, scatter)

    def _closing(self) -> Iterator[FrameFault]:
        closing, noise, sides = self._data.shots.closing, self._data.noise, self._data.shots.patterns
        if closing is None:
            return
        first, shot = closing.kind == "first", self._shots[0]
        # Shares of the patterns that add up to the closing one.
        shares = [
            np.eye(side.shape[1])[index] if first else np.linalg.lstsq(side, np.ones(len(side)), rcond=None)[0]
            for side, index in zip(sides, (shot.row, shot.column), strict=True)
        ]
        even = all(np.abs(side @ share - 1).max() < 1e-6 for side, share in zip(sides, shares, strict=True))
        if closing.saturated or not (first or even):
            reason = "it is saturated" if closing.saturated else "the patterns do not add up to even light"
            yield FrameFault("closing", (), (), f"the closing frame decides nothing, because {reason}")
            return
        predicted, variance = np.zeros_like(closing.light), closing.variance
        for each in self._data.measurements_again():
            if share := float(shares[0][each.row] * shares[1][each.column]):
                half = first and shot.sign
                light = (each.light + shot.sign * each.frame) / 2 if half else each.frame
                own = noise.of(light, 1) if half else noise.of(each.light, each.shots)
                predicted, variance = predicted + share * light, variance + share**2 * np.maximum(own, 0.0)
        energy = max(sum_of_squares(predicted), TINY)
        beyond = sum_of_squares(closing.light - predicted) - float(variance.sum())
        part = float(np.sqrt(max(beyond, 0.0) / energy))
        if beyond > CHANCE * float(np.sqrt(2 * np.square(variance).sum())) and part > 4e-3:
            words = f"{part:.1%} of the closing frame differs from the frames before it, and its power is "
            words += f"{np.vdot(closing.light, predicted) / energy:.3f} of theirs: lamp, camera or scene changed"
            yield FrameFault("closing", tuple(range(len(self._shots))), (), words, part)

    def limits(self) -> tuple[dict[str, Any], ...]:
        shots = self._data.shots
        if shots.manifest.plan is not None or (shots.closing and shots.closing.kind == "uniform"):
            return ()
        whole, found = self._data.lit_everywhere, self.picture
        if self._exclusive:
            sizes: dict[str, float | None] = dict.fromkeys(("pixel", "power", "place"))
            told = "is too small, or too much the same along the dots' lines, to decide about single frames"
            if found:
                values = found.predicted, np.median(found.power_error), np.median(found.place[1])
                sizes = dict(zip(sizes, map(float, values), strict=True))
                told = "decides pixels to {:.2g}, power to {:.1%}, places to {:.2g} scene pixels".format(*values)
            words = f"{_DOTS} The picture {told}; an object over few dots of some frames is not seen. {_REMEDY}"
            return ({"words": words, **sizes},)
        contrast = float(self._sums.contrast[whole]) if whole and self._sums.powers else 1.0
        leak = (1 - contrast) / (1 + contrast)
        words = f"the dark half of the even pattern has {leak:.1%} of the light of the bright one. {_LEAKING} {_REMEDY}"
        return ({"words": words, "leak": leak},) if leak > 5e-3 else ()

    def _fault(self, kind: str, numbers: Iterable[int], words: str, part: float = 0.0) -> FrameFault:
        numbers = tuple(sorted(int(number) for number in numbers))
        files = tuple(self._shots[number].file for number in numbers)
        if len(numbers) == 1:
            words = words.replace("differ ", "differs ", 1).replace("show ", "shows ", 1)
        shown = ", ".join(f"{number} ({file})" for number, file in list(zip(numbers, files, strict=True))[:4])
        more = f" and {len(numbers) - 4} more" if len(numbers) > 4 else ""
        which = f"frame{'s' * (len(numbers) > 1)} {shown}{more}"
        which = "all frames" if 1 < len(numbers) == len(self._shots) else which
        return FrameFault(kind, numbers, files, f"{which} {words}", part)


# ---- Misfit of a run -------------------------------------------------------------------------------------------------

UNEXPLAINED = 3.5e-3
"""Unexplained part of the measurements, rms, at most: prints leave up to 3e-3; 2 mm off 400 leaves 4.2e-3 or more."""
GROSS, GROSS_CHI_SQUARE = 0.1, 4.0
_SHOWN, _MOSTLY = 4, 0.5


_FOCUS = "for a scene of other depths use `--focus auto` or `--focus map`, "


class Cause(Enum):
    NOISE = (
        "the frames' noise",
        "check gain, read noise and black level of the camera file, and that numbers are raw; print finer than a "
        "projector pixel looks alike",
    )
    READING = "another reading of the frames", "see which of the readings is true, and import the frames so"
    FRAMES = "frames that do not fit the others", "capture these frames again"
    PIXELS = "a part of the sensor or of the session", "look at the map of the misfit, and capture again"
    SATURATION = "readings at the full well or the ADC's end", "expose for less"
    MODEL = (
        "light that the calibrated camera does not see from a flat matt scene at the calibrated distance: depth, "
        "gloss, indirect light, light of the room, print finer than a scene pixel, numbers that are not linear in the "
        "light, or another camera",
        f"{_FOCUS}darken the room or take an ambient_frame, check that the camera is the calibrated one and compare "
        "the misfit's map with the scene",
    )


@dataclass(frozen=True, eq=False)
class Misfit:
    """Part of the measurements that the model does not explain, and its cause.

    ``chi_square`` is the residual's energy over the expected one, and ``tiles`` has it by tile. ``unexplained`` is the
    rms excess beyond print, relative to the measurements; the calibration predicts the part ``predicted``. A coarse
    simulation states its relative error ``rendered``. Without ``stated`` noise only gross misfit is flagged. ``noise``
    is measured over stated noise, and ``gain`` is the camera's stated gain [DN per electron].
    """

    chi_square: float
    unexplained: float
    tiles: FloatArray
    worst_tile: float
    stated: bool
    flagged: bool
    cause: Cause | None = None
    noise: NoiseTest | None = None
    gain: float | None = None
    predicted: float | None = None
    rendered: float = 0.0
    faults: tuple[FrameFault, ...] = ()
    places: tuple[Place, ...] = ()
    readings: tuple[Reading, ...] = ()
    defects: Defects | None = None
    picture: PictureCheck | None = None
    limits: tuple[dict[str, Any], ...] = ()

    @property
    def gist(self) -> str:
        return f"chi-square {chi_square_text(self.chi_square)} a datum"

    def __str__(self) -> str:
        noise = "" if self.stated else " of shot noise alone, as no other was stated"
        others = "".join(f"; {other}" for other in (self.reason, self.defects) if other)
        return f"misfit: {self.gist}{noise}, {self.unexplained:.1e} unexplained{others}"

    @property
    def reason(self) -> str:
        words = self.cause.value[0] if self.cause else ""
        if self.cause is Cause.READING:
            words = f"the frames fit if {'; or if '.join(each.words for each in self.readings[:_SHOWN])}"
            if len(self.readings) > 1:
                words += f" ({len(self.readings)} readings fit alike, and the frames cannot decide)"
        elif self.cause is Cause.FRAMES:
            words = "; ".join(fault.words for fault in self.faults[:_SHOWN])
        elif self.cause is Cause.PIXELS and self.places:
            words = f"the misfit is in {self.places[0].words}"
        elif self.cause is Cause.NOISE and self.noise:
            words = f"neighbouring pixels differ by {self.noise.ratio:.3g} times the variance of stated noise"
            if self.gain and self.noise.gain_error < 0.1 * self.noise.gain:
                measured, error = self.gain * self.noise.gain, self.gain * self.noise.gain_error
                words += f"; stated gain {self.gain:.4g} DN per electron, measured {measured:.3g} +- {error:.1g}"
        return words

    def summary(self) -> dict[str, Any]:
        measured = self.gain * self.noise.gain if self.gain and self.noise and self.noise.gain > 0 else None
        return {
            "chi_square": self.chi_square,
            "unexplained": self.unexplained,
            "worst_tile": self.worst_tile,
            "flagged": self.flagged,
            "detail": 0.0,  # of earlier versions, which measured print finer than a scene pixel
            "noise_stated": self.stated,
            "cause": self.cause.name.lower() if self.cause else None,
            "reason": self.reason or None,
            "noise_ratio": self.noise.ratio if self.noise else None,
            "gain_stated": self.gain,
            "gain_measured": measured,
            "foretold": self.predicted,
            "defective_pixels": self.defects.summary() if self.defects else None,
            "reading": self.readings[0].words if len(self.readings) == 1 else None,
            "readings": [{"words": r.words, "order": r.order, "unexplained": r.left} for r in self.readings],
            "places": [place.words for place in self.places],
            "faults": [fault.summary() for fault in self.faults],
            "limits": list(self.limits),
            "power_error": float(np.median(self.picture.power_error)) if self.picture else None,
            "map": self.tiles.tolist(),
        }

    def judge(self, status: Status, focused: bool = False) -> Status:
        """Return ``status`` with the misfit; one that is ``focused`` already is not told to look for depths."""
        if self.cause is None:
            return status
        times = f", {chi_square_text(self.chi_square)} times what its noise makes" if self.stated else ""
        head = f"Misfit: {self.unexplained:.1%} of the measurements fit no image{times}; "
        head = {Cause.NOISE: "Unlike the stated noise: ", Cause.FRAMES: "Faulty frames: "}.get(self.cause, head)
        sentence, remedy = head + self.reason, self.cause.value[1]
        remedy = remedy.removeprefix(_FOCUS) if focused else remedy
        if self.predicted:
            sentence += f"; its calibration foretells up to {self.predicted:.1%} ({decibels(self.predicted):.1f} dB)"
        if self.rendered:
            sentence += f"; the run states an error of {self.rendered:.1%} of its own light"
            remedy = f"capture with a finer accuracy; otherwise {remedy}"
        if len(self.faults) > _SHOWN and self.cause is Cause.FRAMES:
            sentence += f"; and {len(self.faults) - _SHOWN} more"
        return status.with_misfit(sentence, remedy)


def chi_square_text(chi_square: float) -> str:
    return f"{chi_square:.3f}" if chi_square < 10 else f"{chi_square:.3g}"


# ---- Measurements held against the model ----


def find_misfit(data: Accumulation, solution: Solution, with_defects: bool = True) -> Misfit | None:
    """Compare all measurements with the model; return None where there are no more data than unknowns."""
    prepared, noise, image = data.prepared, data.noise, solution.image
    if prepared.spare <= 0:
        return None
    factor_energy, of_ramps = data.factor_energy(image), print_energy(data.model, image)
    beside, known = noise.rendering + (factor_energy or 0.0), factor_energy is not None
    stated = float(noise.variance.sum()) * noise.light.size * prepared.spare
    lam = solution.lam if data.solver.linear else 1e-3 * prepared.problem(data.frames).scale
    sums = Residuals(data)
    test, energy, whole = sums.noise_test, max(float(sums.energy.sum()), TINY), float(sums.squares.sum())
    # Numbers without an ADC may be means of many shots.
    digital = data.shots.manifest.digital
    off = test is not None and test.off(noise, whole, stated, beside) and bool(test.ratio >= 1 or digital.step_dn)
    ratio = 1.0 if test is None or (noise.stated and not off) else test.ratio if off else max(test.ratio, 1.0)
    energies = sums.residual, sums.energy, sums.expected_energy(ratio, factor_energy or 0.0), sums.pixels
    found, excess = weigh(energies, known, noise, of_ramps)
    chi_square = whole / max(stated + beside, TINY) if off else found.chi_square  # by the stated noise
    found = replace(found, noise=test, gain=digital.gain_dn_per_e, chi_square=chi_square, rendered=noise.coarse)
    if lack := data.lack(image):
        found = replace(found, predicted=float(np.sqrt(lack[1] / energy)))
    if with_defects and noise.stated and not sums.clipped:
        mean, count, whole_light = noise.light / noise.variance.size, noise.variance.size, data.lit_everywhere
        variance = ratio * noise.of(mean, noise.shots)
        defects = defects_of(sums.squares, count * variance, count)
        if noise.shots == 2 and whole_light is not None:
            # Differences of halves show little of pixels that stand still, and their sums show all of it.
            off_sums = prepared.as_solved(mean) - prepared.frame(data.weights, whole_light)
            still = defects_of(np.square(off_sums), variance / count, 1)
            defects = still.with_others(defects) if still else defects
        if defects:
            return replace(found, defects=defects)  # the caller leaves them out, and tries again
    check = FrameCheck(data, sums, lam, ratio, beside + of_ramps)
    faults, places = check.faults(), tuple(sums.places(ratio)) if noise.stated and not off else ()
    turned = noise.shots == 2 and is_negative(prepared, data.shots.patterns, sums.weights)
    # A reading is looked for in dim light, too, where chance hides half of what is off.
    hint = 1 + noise.chance(float(sums.pixels.sum())) / 2
    hinted = found.stated and found.unexplained > UNEXPLAINED and found.chi_square > hint
    suspect = found.flagged or faults or places or off or turned or hinted
    readings = find_readings(data, ratio, beside + of_ramps) if suspect else ()
    full, local = noise.saturated > 1e-5 * noise.readings, bool(places) and places[0].energy > _MOSTLY * excess
    unlike = Cause.SATURATION if full else Cause.PIXELS if local else Cause.MODEL
    findings = {Cause.READING: readings, Cause.FRAMES: faults, unlike: found.flagged and not off}
    later = {Cause.PIXELS: places, Cause.MODEL: turned, Cause.NOISE: off}
    cause = next((cause for some in (findings, later) for cause, finding in some.items() if finding), None)
    found = replace(found, faults=faults, places=places, readings=readings, flagged=cause is not None, cause=cause)
    return replace(found, picture=check.picture, limits=check.limits())


def faulty_frames(data: Accumulation, image: FloatArray, lam: float) -> tuple[FrameFault, ...]:
    beside = data.noise.rendering + (data.factor_energy(image) or 0.0) + print_energy(data.model, image)
    return FrameCheck(data, Residuals(data), lam, 1.0, beside).faults()


# ---- Energies found and expected ----


def weigh(
    energies: tuple[FloatArray, ...], factors_stated: bool, noise: FrameNoise, print_energy: float
) -> tuple[Misfit, float]:
    residual, energy, expected, pixels = energies
    beyond = residual - expected - print_energy * pixels / pixels.sum()
    excess = float(beyond.sum())
    unexplained = float(np.sqrt(max(excess, 0.0) / max(float(energy.sum()), TINY)))
    tiles = np.sqrt(np.maximum(beyond, 0.0) / np.maximum(energy, TINY))
    chi_square = float(residual.sum() / max(float(expected.sum()), TINY))
    chi_squares = residual / np.maximum(expected, TINY)
    stated = noise.stated and factors_stated
    part, most = (UNEXPLAINED, 1 + noise.chance(float(pixels.sum()))) if stated else (GROSS, GROSS_CHI_SQUARE)
    flagged = unexplained > part and chi_square > most
    cause = Cause.MODEL if flagged else None
    return Misfit(chi_square, unexplained, chi_squares, float(tiles.max()), stated, flagged, cause), excess

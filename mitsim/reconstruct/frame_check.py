"""Checks of single frames: each is compared with the prediction from all other frames of the run.

Where patterns overlap, the other frames predict a frame by the model: e^T (I - H_kk)^-1 e is the energy of the
difference, in closed form. The halves of every signed pattern add up to the same light. A closing frame repeats the
first pattern, or all pixels lit, at the end of the session.

*Picture.* Under shifting dots every scene pixel is in one frame only, so that a frame of another scene, of another
lamp power or of a moved camera fits the model as well as a right one. The only redundancy is the picture: a symmetric
stencil of neighbours, fitted to the run itself, predicts each pixel from other frames. Three measurements follow from
the differences r between pixels and predictions:

1. the mean of log(1 + u^2) over a frame, u being r over its robust scale, detects a foreign frame;
2. least squares of the power and then of the shift of all frames, because a frame of power 1 + a adds a X at its own
   pixels and changes the predictions of its neighbours;
3. the mean of 1 over windows of a few dots and one to four consecutive shots detects a hand in a few frames.

The undecided rest is stated as a standard error of the power and of the place of single frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.ndimage import correlate1d, uniform_filter
from scipy.optimize import nnls
from scipy.sparse import csr_matrix

from mitsim.core.arrays import FloatArray, sum_of_squares
from mitsim.reconstruct.accumulation import Accumulation
from mitsim.reconstruct.residuals import CHANCE, TINY, Residuals
from mitsim.reconstruct.solver import IndexArray, robust_scatter
from mitsim.reconstruct.uncertainty import Propagation

# ---- The picture of shifting dots -----------------------------------------------------------------------------------

_PRIOR_POWER, _PRIOR_SHIFT = 0.1, 0.5
_SCALES = 8.0, 3.0, 1.0, 1.0
_PIXELS, _FEWEST = 2500, 4
_WINDOWS, _LONGEST = (3, 5), 4
_FEW, _OF_NORMAL = 0.2, 0.253
_BLACK, _DARKER = 6.0, 1.5
_MOST, _FIXED = 3.0, 1e12
_UNDERSTATED = 2.0
_UNMOVED, _SHARED = 0.3, 0.25


class PictureCheck:
    """Comparison of each of the K frames of a run of shifting dots with the picture that the others show.

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
        self.power, self.power_error = self._fit(image, [image], _PRIOR_POWER, _SCALES)
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
        # Looked for in the picture without the powers, because in even parts these look like a slope.
        place, error = self._fit(self._even, [*np.gradient(self._even)], _PRIOR_SHIFT)
        return place.reshape(2, -1), error.reshape(2, -1)

    def uncertainty(self, image: FloatArray) -> FloatArray:
        """Return (n, n') standard uncertainty of an ``image`` (n, n') by the power and the place of single frames.

        The scatter over the frames beyond its own error is stated, and at least its standard error, because a flicker
        as small as the errors is not seen.
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


OFF = 7e-3
"""Part of a frame, rms, by which it may be off: twice what all measurements together may, as print is not averaged."""
_CLOSING = 4e-3
_TURNED, _SIDE = 0.5, 0.3
_MORE, _LEADING, _MOST_BAD = 12.0, 0.35, 0.25
_FOREIGN, _DISTURBED = 6.5, 7.5
_FLICKERS, _POWER = 15.0, 0.01
_FEWEST_PAIRS = 4
_DOTS = "under dots each scene pixel is in one frame, so that only the picture shows a change of lamp, camera or scene."
_LEAKING = "Light of the room cancels. A projector that leaks it since it was calibrated darkens the image as much."
_REMEDY = "A closing frame (--closing-frame uniform) decides it."
_LEAK = 5e-3
_RESTORED, _SCATTERS = 0.9, 4.0
_OUTLIER, _DIMMED = 6.5, 0.02


@dataclass(frozen=True)
class FrameFault:
    kind: str
    numbers: tuple[int, ...]
    files: tuple[str, ...]
    words: str
    part: float = 0.0

    def __str__(self) -> str:
        return self.words

    def summary(self) -> dict[str, Any]:
        return {"fault": self.kind, "frames": list(self.numbers), "files": list(self.files), "words": self.words}


class FrameCheck:
    """Tests of single frames of a run; under shifting dots with the ``picture`` that they show together."""

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
        found, powers, by_model = list[FrameFault](), list[FrameFault](), [*self._unlike_model()]
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
            foreign = np.flatnonzero(picture.foreign > _FOREIGN * self._doubt)
            if len(foreign):
                words = "show another picture than the frames around, dot by dot"
                powers.append(self._fault("picture", foreign, words))
            disturbed = np.flatnonzero(picture.disturbed > _DISTURBED * self._doubt)
            # Gloss is seen in some frames, too, but its light has no image: no frame is at fault.
            if len(disturbed) and not len(foreign) and self._excess < OFF**2 * float(sums.shots.sum()):
                strongest = disturbed[np.argsort(-picture.disturbed[disturbed])][:8]
                words = "show a part of the scene otherwise than the frames around"
                powers.append(self._fault("picture", strongest, words))
            powers += self._powers(picture.power, picture.power_error, range(count), _FLICKERS)
        if len(sums.powers) >= _FEWEST_PAIRS and noise.stated:
            power, error = np.concatenate([*sums.powers.values()], axis=1)
            numbers = [self._number[(*pattern, sign)] for pattern in sums.powers for sign in (1, -1)]
            powers += self._powers(power, error, numbers, CHANCE)
        # A lamp that flickers disturbs single frames by a few times its scatter; a wrong frame, the power of all.
        if by_model and by_model[0].part >= _SCATTERS * max((fault.part for fault in powers), default=0.0):
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
            if sums.powers and even and part[even] < _TURNED and not (tests[1][0] > CHANCE * tests[1][1])[even]:
                bad[even] = False
            # By the model, single frames are at fault only if they explain the misfit of the run.
            least = _RESTORED * self._excess - CHANCE * float(np.sqrt(np.square(chance).sum()))
            if number or bad.sum() > self._most or beyond[bad].sum() >= least:
                off = np.maximum(off, np.where(bad, part, 0.0))
        for row, column in (
            np.argwhere(off)[np.argsort(-off[off > 0])].tolist() if (off > 0).sum() <= self._most else ()
        ):
            side = sums.side[row, column]  # it decides which half is at fault
            signs = [1, -1] if abs(side) < _SIDE else [int(np.sign(side))]
            numbers = [self._number[row, column, sign] for sign in (signs if self._signed else [0])]
            size = float(np.sqrt(off[row, column]))
            yield self._fault("model", numbers, f"differ by {size:.1%} from what the other frames predict", size)

    def _powers(self, power: FloatArray, error: FloatArray, of: Sequence[int], errors: float) -> Iterator[FrameFault]:
        scatter, middle = robust_scatter(power), float(np.median(power))
        single = np.abs(power - middle) > np.maximum(_OUTLIER * np.maximum(error, scatter), _DIMMED)
        if single.any() and single.sum() <= max(1, _MOST_BAD * len(power)):
            for index in np.flatnonzero(single):
                words = f"has {1 + power[index] - middle:.2f} times the light that the others predict"
                yield self._fault("power", [of[int(index)]], words)
        elif single.any() or scatter > max(_POWER, errors * float(np.median(error))):
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
        if beyond > CHANCE * float(np.sqrt(2 * np.square(variance).sum())) and part > _CLOSING:
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
        return ({"words": words, "leak": leak},) if leak > _LEAK else ()

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

"""Checks of single frames: each against what all other frames of the run predict of it.

Where patterns overlap, the other frames predict a frame by the model: e^T (I - H_kk)^-1 e is the energy of the frame's
difference from the prediction, in closed form. Signed patterns have a second redundancy, because the halves of every
pair add up to the same light. Under shifting dots no scene pixel is in two frames, and the picture of the other frames
predicts a frame (:mod:`mitsim.reconstruct.picture_check`). A closing frame repeats the first pattern, or all pixels
lit, at the end of the session and is compared with the frames before it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray, sum_of_squares
from mitsim.reconstruct.accumulation import Accumulation
from mitsim.reconstruct.defects import lit_everywhere
from mitsim.reconstruct.picture_check import PictureCheck, robust_scatter
from mitsim.reconstruct.residuals import CHANCE, TINY, Residuals
from mitsim.reconstruct.uncertainty import Propagation

Pattern = tuple[int, int]

OFF = 7e-3
"""Part of a frame, rms, by which it may be off: twice what all measurements together may, as print is not averaged."""
_CLOSING = 4e-3
"""Part of a closing frame, rms, by which it may be off: no calibration and no print is between it and other frames."""
_TURNED = 0.5
"""Part of its energy by which a pattern of exchanged halves differs at least: they leave twice its light."""
_SIDE = 0.3
"""Correlation of a pair's sum with its difference from which one of its halves is at fault."""
_MORE, _LEADING, _MOST_BAD = 12.0, 0.35, 0.25
"""Times the median excess, and part of the largest, from which a frame is named; part of all frames above which the run
does not fit as a whole, and no single frames are named."""
_FOREIGN, _DISTURBED = 6.5, 7.5
"""Robust deviations from which a frame, and a window of frames, contradict the picture: no good run does."""
_FLICKERS, _POWER = 15.0, 0.01
"""Scatter of the powers of frames over its error, and least scatter, from which a flicker is reported. The picture of a
print of a regular texture imitates smaller ones; all are part of the uncertainty."""
_FEWEST_PAIRS, _FEWEST_FRAMES, _MOST_NUMBERS = 4, 3, 3e7
"""Pairs, and frames that overlap, from which powers are told, and numbers that their fit may keep in memory."""
_DOTS = (
    "under dots each scene pixel is in one frame, so that only the picture tells a lamp, camera or scene that changed."
)
_LEAKING = (
    "Light of the room cancels. A projector that leaks it, and did not when calibrated, darkens the image as much."
)
_REMEDY = "A closing frame (--closing-frame uniform) decides it."
"""Sentences on what is not decided."""
_LEAK = 5e-3
"""Light of a dark pattern, over that of the bright one, from which a leaking projector is spoken of."""
_RESTORED = 0.9
"""Part of the unexplained energy by which the residual must fall without frames that are at fault."""
_SCATTERS = 4.0
"""Scatters of the power up to which the difference of a single frame is that of a flicker."""
_OUTLIER, _DIMMED = 6.5, 0.02
"""Robust deviations, and change, from which the power of a single frame is reported."""


@dataclass(frozen=True)
class FrameFault:
    """Shots that do not fit the others: ``kind`` of the test, ``numbers`` from 0 in the manifest's order, ``files``,
    ``words`` for people, and the part of their light, rms, by which they differ."""

    kind: str
    numbers: tuple[int, ...]
    files: tuple[str, ...]
    words: str
    part: float = 0.0

    def __str__(self) -> str:
        return self.words

    def summary(self) -> dict[str, Any]:
        """Return the entry of result.json."""
        return {"fault": self.kind, "frames": list(self.numbers), "files": list(self.files), "words": self.words}


class FrameCheck:
    """Tests the frames of accumulated ``data``.

    Parameters
    ----------
    data, sums
        the run, and its residuals.
    lam
        lambda of the image that shows the picture.
    ratio
        measured over stated variance of the noise.
    beside
        energy that rendering, the factors' noise and print add to all residuals.
    """

    def __init__(self, data: Accumulation, sums: Residuals, lam: float, ratio: float, beside: float) -> None:
        self._data, self._sums, self._beside = data, sums, beside
        self._variance = ratio * data.noise.variance
        self._shots = data.shots.manifest.patterns.captures
        self._number = {(shot.row, shot.column, shot.sign): index for index, shot in enumerate(self._shots)}
        self._patterns = [(shot.row, shot.column) for shot in self._shots]
        spare = float(self._variance.sum()) * sums.squares.size * data.prepared.spare
        self._excess = float(sums.squares.sum()) - spare - beside
        self._signed = data.noise.shots == 2
        lit = [(side != 0).sum(axis=1) for side in data.shots.patterns]
        exclusive = not self._signed and all((each == 1).all() for each in lit) and self._variance.size > 1
        self.picture = self._check_picture(lam) if exclusive else None
        self._exclusive = exclusive

    def faults(self) -> tuple[FrameFault, ...]:
        """Return all frames that do not fit the others."""
        found, by_others = [*self._alone()], [*self._unlike_model()]
        powers = [*self._unlike_picture(), *self._flicker()]
        # A lamp that flickers disturbs single frames by a few times its scatter; a wrong frame, the power of all.
        flicker = max((fault.part for fault in powers), default=0.0)
        if by_others and by_others[0].part >= _SCATTERS * flicker:
            found += by_others
        named = {self._patterns[number] for fault in found for number in fault.numbers}
        known = [each for each in powers if each.kind == "power" and named & {self._patterns[n] for n in each.numbers}]
        return (*found, *(fault for fault in powers if fault not in known), *self._closing())

    # ---- Tests of single frames

    def _alone(self) -> Iterator[FrameFault]:
        """Report a run without light, frames that are equal to the last bit, and single frames that are clipped."""
        noise, count = self._data.noise, len(self._shots)
        least = CHANCE * float(np.sqrt(noise.variance.sum() / self._sums.squares.size))
        if abs(float(noise.means.sum())) < least:
            yield self._fault("dark", range(count), "holds no light" if count == 1 else "hold no light")
        for digest, shots in self._sums.same.items():
            if digest and len(shots) > 1 and noise.variance.any():
                yield self._fault("repeated", [self._of(*each) for each in shots], "are equal, noise and all")
        if len(self._sums.clipped) <= max(1, _MOST_BAD * count):
            for shot, readings in self._sums.clipped.items():
                yield self._fault("clipped", [self._of(*shot)], f"has {readings} readings at its largest number")

    def _unlike_model(self) -> Iterator[FrameFault]:
        """Compare each frame with the prediction of the others by the model."""
        sums, count, noise = self._sums, self._variance.size, self._variance
        share = self._beside * sums.shots / max(float(sums.shots.sum()), TINY)
        tests = [(sums.leave_out - noise * sums.free - share, noise * np.sqrt(2 * sums.free))]
        if sums.pairs:
            data, of_sums = sums.pairs[0, 0].size, noise + noise.mean() / (count - 1)
            rest = np.reshape([sums.pairs[pattern].rest for pattern in np.ndindex(noise.shape)], noise.shape)
            whole = sums.squares.size / data
            tests.append((whole * (rest - of_sums * data) - share, 2 * whole * of_sums * np.sqrt(2 * data)))
        # Gloss is in the even pattern above all; were its frame wrong, the sum of its pair would be, too, or its halves
        # are exchanged, which leaves twice its light.
        off, even = np.zeros(noise.shape), lit_everywhere(self._data)
        for beyond, chance in tests:
            part = np.maximum(beyond, 0.0) / np.maximum(sums.shots, np.median(sums.shots) + TINY)
            usual = float(np.median(part)) if count > 2 else float(part.max())
            bad = (beyond > CHANCE * chance) & (part > max(OFF**2, _MORE * usual)) & (part > _LEADING * part.max())
            if sums.pairs and even and part[even] < _TURNED and not (tests[1][0] > CHANCE * tests[1][1])[even]:
                bad[even] = False
            few = 0 < int(np.count_nonzero(bad)) <= max(1, _MOST_BAD * count)
            if few and beyond is tests[0][0]:
                # Single frames are at fault only if the rest fits without them.
                restored = sums.without([(int(i), int(j)) for i, j in np.argwhere(bad)])
                restored -= float((noise * sums.free + share)[bad].sum())
                few = restored >= _RESTORED * self._excess - CHANCE * float(np.sqrt(np.square(chance).sum()))
            if few or np.count_nonzero(bad) > max(1, _MOST_BAD * count):
                off = np.maximum(off, np.where(bad, part, 0.0))
        named = sorted(((int(i), int(j)) for i, j in np.argwhere(off)), key=lambda place: -off[place])
        if len(named) <= max(1, _MOST_BAD * count):
            for row, column in named:
                size, signs = float(np.sqrt(off[row, column])), [0]
                if self._signed:  # the sums of pairs decide which half
                    side = self._sums.pairs[row, column].side if self._sums.pairs else 0.0
                    signs = [1, -1] if abs(side) < _SIDE else [int(np.sign(side))]
                numbers = [self._number[row, column, sign] for sign in signs]
                yield self._fault("model", numbers, f"differ by {size:.1%} from what the other frames predict", size)

    # ---- The picture of shifting dots

    def _check_picture(self, lam: float) -> PictureCheck | None:
        seen = Propagation(self._data.model, lam)
        rows, columns = ((side != 0).argmax(axis=1) for side in self._data.shots.patterns)
        shape = self._variance.shape
        numbers = np.reshape([self._number.get((*pattern, 0), 0) for pattern in np.ndindex(*shape)], shape)
        image, noise = self._data.prepared.image(seen.gain * self._sums.weights), float(self._variance.mean())
        found = PictureCheck(image, numbers[np.ix_(rows, columns)], shape, seen.of_white(noise))
        return found if found.decides else None

    def _unlike_picture(self) -> Iterator[FrameFault]:
        found = self.picture
        if found is None:
            return
        foreign = np.flatnonzero(found.foreign > _FOREIGN)
        if len(foreign):
            yield self._fault("picture", foreign, "show another picture than the frames around, dot by dot")
        disturbed = np.flatnonzero(found.disturbed > _DISTURBED)
        # Gloss is seen in some frames, too, but its light has no image: no frame is at fault.
        if len(disturbed) and not len(foreign) and self._excess < OFF**2 * float(self._sums.shots.sum()):
            strongest = disturbed[np.argsort(-found.disturbed[disturbed])][:8]
            yield self._fault("picture", strongest, "show a part of the scene otherwise than the frames around")
        limit = max(_POWER, _FLICKERS * float(np.median(found.power_error)))
        yield from self._powers(found.power, found.power_error, range(len(self._shots)), limit)

    def _flicker(self) -> Iterator[FrameFault]:
        """Report shots of another power.

        The halves of all signed patterns add up to the same light. Where other patterns overlap, a frame of power 1 + a
        adds a (I - H) Y to all residuals, so that the powers follow from normal equations with the matrix |Y_k|^2
        delta_kl - C_k . C_l, C being the coefficients of frames in the model's range.
        """
        pairs, weights, count = self._sums.pairs, self._sums.weights, self._variance.size
        if len(pairs) >= _FEWEST_PAIRS and self._data.noise.stated:
            power, error = np.concatenate([(pair.powers, pair.errors) for pair in pairs.values()], axis=1)
            numbers = [self._number[(*pattern, sign)] for pattern in pairs for sign in (1, -1)]
            limit = max(_POWER, CHANCE * float(np.median(error)))
            yield from self._powers(power, error, numbers, limit)
        if self._signed or self._exclusive or count < _FEWEST_FRAMES or count * weights.size > _MOST_NUMBERS:
            return
        seen, whole, patterns = np.zeros((count, *weights.shape)), np.zeros(count), [*np.ndindex(*self._variance.shape)]
        for k, pattern in enumerate(patterns):
            places = self._data.prepared.places(pattern)
            left, right = (slab.matrix.T @ slab.matrix for slab in self._data.prepared.slabs(pattern))
            seen[k][places] = left @ weights[places] @ right
            whole[k] = float(np.vdot(weights, seen[k]))
        flat, variance = seen.reshape(count, -1), float(self._variance.mean())
        values, vectors = np.linalg.eigh(np.diag(whole) - flat @ flat.T)
        known = values > max(variance, 1e-9 * float(values.max()))
        inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T
        error = np.sqrt(variance * np.diag(inverse))
        limit = max(_POWER, CHANCE * float(np.median(error)))
        numbers = [self._number[(*pattern, 0)] for pattern in patterns]
        yield from self._powers(inverse @ self._sums.fitted.ravel(), error, numbers, limit)

    def _powers(
        self, power: FloatArray, error: FloatArray, numbers: Sequence[int], most: float
    ) -> Iterator[FrameFault]:
        """Name shots of another power than the rest, or all of them if the powers of most differ.

        Parameters
        ----------
        power, error
            (shots,) relative powers and their standard errors.
        numbers
            of the shots.
        most
            scatter from which all differ.
        """
        scatter, middle = robust_scatter(power), float(np.median(power))
        single = np.abs(power - middle) > np.maximum(_OUTLIER * np.maximum(error, scatter), _DIMMED)
        if single.any() and single.sum() <= max(1, _MOST_BAD * len(power)):
            for index in np.flatnonzero(single):
                words = f"has {1 + power[index] - middle:.2f} times the light that the others predict"
                yield self._fault("power", [numbers[int(index)]], words)
        elif single.any() or scatter > most:
            words = f"differ by {float(np.std(power)):.2%} in their power"
            yield self._fault("power", range(len(self._shots)), words, scatter)

    # ---- A closing frame

    def _closing(self) -> Iterator[FrameFault]:
        """Compare the closing frame with the frames before it."""
        closing, noise, sides = self._data.shots.closing, self._data.noise, self._data.shots.patterns
        if closing is None:
            return
        first, shot = closing.kind == "first", self._shots[0]
        half = first and shot.sign != 0
        # Shares of the patterns that add up to the closing one.
        shares = [np.eye(side.shape[1])[index] for side, index in zip(sides, (shot.row, shot.column), strict=True)]
        if not first:
            shares = [np.linalg.lstsq(side, np.ones(len(side)), rcond=None)[0] for side in sides]
        even = all(np.abs(side @ share - 1).max() < 1e-6 for side, share in zip(sides, shares, strict=True))
        if closing.saturated or not (first or even):
            reason = "it is saturated" if closing.saturated else "the patterns do not add up to even light"
            yield FrameFault("closing", (), (), f"the closing frame decides nothing, because {reason}")
            return
        predicted, variance = np.zeros_like(closing.light), closing.variance
        for each in self._data.measurements_again():
            if share := float(shares[0][each.row] * shares[1][each.column]):
                light = (each.light + shot.sign * each.frame) / 2 if half else each.frame
                own = noise.of(light, 1) if half else noise.of(each.light, each.shots)
                predicted, variance = predicted + share * light, variance + share**2 * np.maximum(own, 0.0)
        energy = max(sum_of_squares(predicted), TINY)
        beyond = sum_of_squares(closing.light - predicted) - float(variance.sum())
        part = float(np.sqrt(max(beyond, 0.0) / energy))
        if beyond > CHANCE * float(np.sqrt(2 * np.square(variance).sum())) and part > _CLOSING:
            words = (
                f"{part:.1%} of the closing frame differs from the frames before it, and its power is "
                f"{np.vdot(closing.light, predicted) / energy:.3f} of theirs: lamp, camera or scene changed"
            )
            yield FrameFault("closing", tuple(range(len(self._shots))), (), words, part)

    # ---- What no test decides

    def limits(self) -> tuple[dict[str, Any], ...]:
        """Return what the frames of a real camera leave undecided, unless a uniform closing frame decides it: entries
        of result.json, with words and the sizes up to which nothing is seen."""
        shots = self._data.shots
        if shots.manifest.plan is not None or (shots.closing and shots.closing.kind == "uniform"):
            return ()
        whole, found = lit_everywhere(self._data), self.picture
        if self._exclusive:
            sizes: dict[str, float | None] = dict.fromkeys(("pixel", "power", "place"))
            told = "is too small to decide about single frames"
            if found:
                power, place = (float(np.median(each)) for each in (found.power_error, found.place[1]))
                sizes = {"pixel": found.predicted, "power": power, "place": place}
                told = (
                    f"decides pixels to {found.predicted:.2g}, power to {power:.1%}, places to {place:.2g} scene pixels"
                )
            words = f"{_DOTS} The picture {told}; an object over few dots of some frames is not seen. {_REMEDY}"
            return ({"words": words, **sizes},)
        pair = self._sums.pairs.get(whole) if whole else None
        leak = (1 - pair.contrast) / (1 + pair.contrast) if pair else 0.0
        words = f"the dark half of the even pattern has {leak:.1%} of the light of the bright one. {_LEAKING} {_REMEDY}"
        return ({"words": words, "leak": leak},) if leak > _LEAK else ()

    # ---- Words

    def _of(self, pattern: Pattern, half: int) -> int:
        return self._number[(*pattern, (1 - 2 * half) if self._signed else 0)]

    def _fault(self, kind: str, numbers: Iterable[int], words: str, part: float = 0.0) -> FrameFault:
        """Make a fault of some shots, of which the words name the first few with their files."""
        numbers = tuple(sorted(int(number) for number in numbers))
        files = tuple(self._shots[number].file for number in numbers)
        verb, rest = words.split(" ", 1)
        if len(numbers) == 1 and verb in ("differ", "show"):
            words = f"{verb}s {rest}"
        if len(numbers) == len(self._shots) and len(numbers) > 1:
            return FrameFault(kind, numbers, files, f"all frames {words}", part)
        shown = ", ".join(f"{number} ({file})" for number, file in zip(numbers[:4], files[:4], strict=True))
        more = f" and {len(numbers) - 4} more" if len(numbers) > 4 else ""
        return FrameFault(kind, numbers, files, f"frame{'s' if len(numbers) > 1 else ''} {shown}{more} {words}", part)

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

OFF = 7e-3
"""Part of a frame, rms, by which it may be off: twice what all measurements together may, as print is not averaged."""
_CLOSING = 4e-3
"""Part of a closing frame, rms, by which it may be off: no calibration and no print is between it and other frames."""
_TURNED, _SIDE = 0.5, 0.3
"""Part of its energy by which a pattern of exchanged halves differs at least, because they leave twice its light; and
correlation of a pair's sum with its difference from which one of its halves is at fault."""
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
_DOTS = "under dots each scene pixel is in one frame, so that only the picture shows a change of lamp, camera or scene."
_LEAKING = "Light of the room cancels. A projector that leaks it since it was calibrated darkens the image as much."
_REMEDY = "A closing frame (--closing-frame uniform) decides it."
"""Sentences on what is not decided."""
_LEAK = 5e-3
"""Light of a dark pattern, over that of the bright one, from which a leaking projector is reported."""
_RESTORED, _SCATTERS = 0.9, 4.0
"""Part of the unexplained energy that frames at fault must explain; and scatters of the power up to which the
difference of a single frame is that of a flicker."""
_OUTLIER, _DIMMED = 6.5, 0.02
"""Robust deviations, and change, from which the power of a single frame is reported."""


@dataclass(frozen=True)
class FrameFault:
    """Shots that do not fit the others, and the part of their light, rms, by which they differ.

    ``kind`` is the test, ``numbers`` count from 0 in the manifest's order, and ``words`` are for people.
    """

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
        self._variance, self._signed = ratio * data.noise.variance, data.noise.shots == 2
        self._shots, self._most = data.shots.manifest.patterns.captures, max(1, _MOST_BAD * data.noise.variance.size)
        self._number = {(shot.row, shot.column, shot.sign): index for index, shot in enumerate(self._shots)}
        spare = float(self._variance.sum()) * sums.squares.size * data.prepared.spare
        self._excess = float(sums.squares.sum()) - spare - beside
        # Errors of the factors differ from dot to dot, as those of a wrong frame do.
        self._doubt = float(np.sqrt(1 + beside / max(spare, TINY)))
        single = all(((side != 0).sum(axis=1) == 1).all() for side in data.shots.patterns)
        self._exclusive = single and not self._signed and self._variance.size > 1
        self.picture = self._check_picture(lam) if self._exclusive else None

    def faults(self) -> tuple[FrameFault, ...]:
        """Return all frames that do not fit the others."""
        found, by_others = [*self._alone()], [*self._unlike_model()]
        powers = [*self._unlike_picture(), *self._flicker()]
        # A lamp that flickers disturbs single frames by a few times its scatter; a wrong frame, the power of all.
        flicker = max((fault.part for fault in powers), default=0.0)
        if by_others and by_others[0].part >= _SCATTERS * flicker:
            found += by_others
        patterns = [(shot.row, shot.column) for shot in self._shots]
        named = {patterns[number] for fault in found for number in fault.numbers}
        powers = [each for each in powers if each.kind != "power" or not named & {patterns[n] for n in each.numbers}]
        return (*found, *powers, *self._closing())

    # ---- Tests of single frames

    def _alone(self) -> Iterator[FrameFault]:
        """Report a run without light, frames that are equal to the last bit, and single frames that are clipped."""
        noise, count = self._data.noise, len(self._shots)
        if abs(float(noise.means.sum())) < CHANCE * float(np.sqrt(noise.variance.sum() / self._sums.squares.size)):
            yield self._fault("dark", range(count), "holds no light" if count == 1 else "hold no light")
        for digest, shots in self._sums.same.items():
            if digest and len(shots) > 1 and noise.variance.any():
                yield self._fault("repeated", [self._number[shot] for shot in shots], "are equal, noise and all")
        if len(self._sums.clipped) <= self._most:
            for shot, readings in self._sums.clipped.items():
                yield self._fault("clipped", [self._number[shot]], f"has {readings} readings at its largest number")

    def _unlike_model(self) -> Iterator[FrameFault]:
        """Compare each frame with the prediction of the others by the model."""
        sums, count, noise = self._sums, self._variance.size, self._variance
        share = self._beside * sums.shots / max(float(sums.shots.sum()), TINY)
        tests = [(sums.leave_out - noise * sums.free - share, noise * np.sqrt(2 * sums.free))]
        if sums.powers:
            of_sums, whole = noise + noise.mean() / (count - 1), sums.squares.size / sums.compared
            beyond = whole * (sums.rest - of_sums * sums.compared) - share
            tests.append((beyond, 2 * whole * of_sums * np.sqrt(2 * sums.compared)))
        off, even = np.zeros(noise.shape), lit_everywhere(self._data)
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
        foreign = np.flatnonzero(found.foreign > _FOREIGN * self._doubt)
        if len(foreign):
            yield self._fault("picture", foreign, "show another picture than the frames around, dot by dot")
        disturbed = np.flatnonzero(found.disturbed > _DISTURBED * self._doubt)
        # Gloss is seen in some frames, too, but its light has no image: no frame is at fault.
        if len(disturbed) and not len(foreign) and self._excess < OFF**2 * float(self._sums.shots.sum()):
            strongest = disturbed[np.argsort(-found.disturbed[disturbed])][:8]
            yield self._fault("picture", strongest, "show a part of the scene otherwise than the frames around")
        yield from self._powers(found.power, found.power_error, range(len(self._shots)), _FLICKERS)

    def _flicker(self) -> Iterator[FrameFault]:
        """Report shots of another power.

        The halves of all signed patterns add up to the same light. Where other patterns overlap, a frame of power 1 + a
        adds a (I - H) Y to all residuals, so that the powers follow from normal equations with the matrix |Y_k|^2
        delta_kl - C_k . C_l, C being the coefficients of frames in the model's range.
        """
        powers, weights, count = self._sums.powers, self._sums.weights, self._variance.size
        if len(powers) >= _FEWEST_PAIRS and self._data.noise.stated:
            power, error = np.concatenate([*powers.values()], axis=1)
            numbers = [self._number[(*pattern, sign)] for pattern in powers for sign in (1, -1)]
            yield from self._powers(power, error, numbers, CHANCE)
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
        power, error = inverse @ self._sums.fitted.ravel(), np.sqrt(variance * np.diag(inverse))
        yield from self._powers(power, error, [self._number[(*pattern, 0)] for pattern in patterns], CHANCE)

    def _powers(self, power: FloatArray, error: FloatArray, of: Sequence[int], errors: float) -> Iterator[FrameFault]:
        """Name shots of another power than the rest, or all of them if the powers of most differ.

        Parameters
        ----------
        power, error, of
            (shots,) relative powers, their standard errors, and the numbers of the shots.
        errors
            standard errors from which the scatter of all powers is a flicker.
        """
        scatter, middle = robust_scatter(power), float(np.median(power))
        single = np.abs(power - middle) > np.maximum(_OUTLIER * np.maximum(error, scatter), _DIMMED)
        if single.any() and single.sum() <= max(1, _MOST_BAD * len(power)):
            for index in np.flatnonzero(single):
                words = f"has {1 + power[index] - middle:.2f} times the light that the others predict"
                yield self._fault("power", [of[int(index)]], words)
        elif single.any() or scatter > max(_POWER, errors * float(np.median(error))):
            words = f"differ by {float(np.std(power)):.2%} in their power"
            yield self._fault("power", range(len(self._shots)), words, scatter)

    # ---- A closing frame

    def _closing(self) -> Iterator[FrameFault]:
        """Compare the closing frame with the frames before it."""
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

    # ---- What no test decides

    def limits(self) -> tuple[dict[str, Any], ...]:
        """Return entries of result.json on what the frames of a real camera leave undecided without a closing frame."""
        shots = self._data.shots
        if shots.manifest.plan is not None or (shots.closing and shots.closing.kind == "uniform"):
            return ()
        whole, found = lit_everywhere(self._data), self.picture
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

    # ---- Words

    def _fault(self, kind: str, numbers: Iterable[int], words: str, part: float = 0.0) -> FrameFault:
        """Make a fault of some shots, of which the words name the first few with their files."""
        numbers = tuple(sorted(int(number) for number in numbers))
        files = tuple(self._shots[number].file for number in numbers)
        if len(numbers) == 1:
            words = words.replace("differ ", "differs ", 1).replace("show ", "shows ", 1)
        shown = ", ".join(f"{number} ({file})" for number, file in list(zip(numbers, files, strict=True))[:4])
        more = f" and {len(numbers) - 4} more" if len(numbers) > 4 else ""
        which = f"frame{'s' * (len(numbers) > 1)} {shown}{more}"
        which = "all frames" if 1 < len(numbers) == len(self._shots) else which
        return FrameFault(kind, numbers, files, f"{which} {words}", part)

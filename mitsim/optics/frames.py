"""Frames of a family: from light of its classes to the expected irradiance of every shot, and its Monte Carlo error.

The closed form of one light distribution is :mod:`mitsim.optics.image_formation`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.special import stdtrit

from mitsim.core.arrays import FloatArray
from mitsim.core.parallel import in_threads
from mitsim.core.seeds import stream
from mitsim.devices.camera import side_of
from mitsim.devices.patterns import Lighting
from mitsim.optics.image_formation import Entries, FrameOptics, IntArray

_AT_ONCE, _BYTES_AT_ONCE = 32, 2**27
"""Frames formed at a time: enough to keep all processors busy; and their bytes, where fewer have as many: 4 frames of a
sensor of 2048 pixels."""
_LARGEST_BASIS, _BASIS_BYTES = 256, 7 * 2**28
"""Classes whose frames are held to be mixed, 512 MiB of a sensor of 512 pixels; and their bytes, of which a process of
4 GiB has room for: 56 frames of a sensor of 2048 pixels. Beyond them frames are formed twice."""
PROBES = 8
"""Random signs beside the constant vector; chosen so that probing costs less than a frame, see :func:`_probes`."""
_FEW = 2
"""Classes a shot, beside what all shots light alike, up to which adding up their frames takes less than a product of
matrices: a twentieth for dots whose black pixels leak."""
_COLUMNS = 2**14
"""Columns of a product at a time: how a product is cut shows in its last bits, so not by the number of threads."""
_FLOAT = 8
"""Bytes of a pixel of a frame."""
_SURE = 0.95
"""How often an error is to be below its bound."""
_MOST_COLUMNS = 2**22
"""Places of light from which a product is worked out on those that are lit: SciPy takes 16 bytes for each of all, and
20 to add two unsorted matrices."""
_ALL = sparse.csr_array(np.ones((1, 1)))
"""The one mixture of ambient light: all of it."""


@dataclass(frozen=True, eq=False)
class Frame:
    """What one shot casts on the sensor.

    Attributes
    ----------
    irradiance
        (m, m') expected [W m^-2].
    variance
        its Monte Carlo variance, mean over pixels.
    removed
        Interpolation between anchors can leave specks below zero where a pixel sees almost no light; they are set to
        zero, and this is their sum over the sum of the frame, so that nothing is hidden.
    heaviest
        largest part of the variance that one group of the light brings: with one heavy path among G groups,
        (G - 1) / G.
    by_group
        (G,) parts of the variance that each group of the light brings.
    """

    irradiance: FloatArray
    variance: float
    removed: float
    heaviest: float
    by_group: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class ClassFrames:
    """Frames of some classes at full power, without Monte Carlo error.

    Attributes
    ----------
    classes
        (c,) increasing class numbers; every other class's frame is zero.
    irradiance
        (c, m, m') [W m^-2].
    """

    classes: IntArray
    irradiance: FloatArray


@dataclass(frozen=True, eq=False)
class Filed:
    """Light and the optics that forms it.

    Attributes
    ----------
    optics
        fits the cells that the light is filed in.
    groups
        independent estimates of the light, (rows, cells) each; their mean is used.
    """

    optics: FrameOptics
    groups: tuple[sparse.csr_array, ...]


def at_once(pixels: float) -> int:
    """Frames of ``pixels`` a side, or as many in all, that are formed at a time."""
    return max(1, min(_AT_ONCE, int(_BYTES_AT_ONCE // (_FLOAT * pixels**2))))


def frames_in_memory(classes: int, shots: int, pixels: float) -> int:
    """Frames that :class:`ExpectedFrames` holds at once: two lots that are in use, and one that is formed.

    Parameters
    ----------
    classes, shots, pixels
        of the family, and a side of the sensor (:func:`mitsim.devices.camera.side_of`).
    """
    return (classes if mixes(classes, shots, pixels) else 0) + 3 * at_once(pixels)


def formed_frames(classes: int, shots: int, pixels: float) -> int:
    """Frames that are formed for a run, whose frames are asked for twice.

    Parameters
    ----------
    classes, shots, pixels
        of the family, and a side of the sensor (:func:`mitsim.devices.camera.side_of`).
    """
    return classes if mixes(classes, shots, pixels) else 2 * shots


def mixes(classes: int, shots: int, pixels: float) -> bool:
    """Whether shots are mixed from frames of classes, which are held, and not formed one by one.

    Parameters
    ----------
    classes, shots, pixels
        of the family, and a side of the sensor (:func:`mitsim.devices.camera.side_of`).
    """
    return classes <= min(_LARGEST_BASIS, shots, _BASIS_BYTES // (_FLOAT * pixels**2))


class ExpectedFrames:
    """Frames of every shot of a family, each with the Monte Carlo variance of its mean; iterate as often as needed.

    Light is linear, so the frames are formed once for a *basis* of light distributions and mixed: the classes of
    projector pixels that a family always lights together. A family with too many classes is formed shot by shot
    and never held in memory as a whole; what black pixels leak in all of its shots is formed once.

    The variance is that of the mean of G groups, ``sum ||F(T_g) - F(T)||^2 / (G (G - 1))``; with one group there is
    none to tell, and it is 0. Squared norms are estimated without bias from products with random signs (Hutchinson's
    estimator), because forming G times as many frames would cost more than the frames themselves.

    Parameters
    ----------
    lights
        light of the same rows (projector pixels, or classes of them), filed in one kind of cells or more; their groups
        are paired.
    lighting
        class of each row, and the fraction of full power that each class emits in each shot.
    seed
        of the random signs.
    ambient
        light (1, cells) of every shot, its groups paired with those of ``lights``.
    glint
        frames to be added to those of some classes.
    probed
        :attr:`probed` of other shots of the same lights, classes and seed.
    """

    def __init__(
        self,
        lights: Sequence[Filed],
        lighting: Lighting,
        seed: int,
        ambient: Sequence[Filed] = (),
        glint: ClassFrames | None = None,
        probed: FloatArray | None = None,
    ) -> None:
        self._lights, self._ambient, self._glint = tuple(lights), tuple(ambient), glint
        self._seed, self._weights = seed, lighting.weights
        (shots, classes), rows = lighting.weights.shape, lighting.labels.size
        indicator = sparse.csr_array((np.ones(rows), (lighting.labels, np.arange(rows))), shape=(classes, rows))
        self._mixed = mixes(classes, shots, side_of(self._shape))
        self._shares = np.eye(classes) if self._mixed else self._weights
        least = self._least = self._weights.min(axis=0)
        self._own = sparse.csr_array(self._weights - least)
        self._of_classes = _Mixture(self._weights, self._least, self._own)
        self._pairs = _paired(self._weights) if self._mixed and self._own.nnz > _FEW * shots else None
        if self._mixed or shots < 2 or 2 * np.count_nonzero(self._weights == least) < self._weights.size:
            least = np.zeros(classes)
        self._leak = sparse.csr_array(sparse.csr_array(least[None]) @ indicator) if least.any() else None
        self._basis = (
            indicator if self._mixed else sparse.csr_array(sparse.csr_array(self._weights - least) @ indicator)
        )
        self._formed: tuple[FloatArray, FloatArray] | None = None
        self._held: Sequence[Frame] | None = None
        self._always: tuple[FloatArray, FloatArray] | None = None
        self._leaked: tuple[FloatArray, FloatArray] | None = None
        self._probed = probed if self._mixed else None
        self._noise: FloatArray | None = None

    def __len__(self) -> int:
        return int(self._weights.shape[0])

    @property
    def has_ambient(self) -> bool:
        """Whether there is light of other emitters than the projector in every frame."""
        return bool(self._ambient)

    @property
    def projector_off(self) -> Frame:
        """The frame of ambient light alone, dark where there is none; its Monte Carlo error is that of all frames."""
        light = np.zeros(self._shape) if self._ambient_formed is None else self._ambient_formed[0][0]
        return Frame(np.maximum(light, 0.0), 0.0, 0.0, 0.0)

    @property
    def of_projector(self) -> ExpectedFrames:
        """The same shots in a dark room."""
        dark = copy(self)
        dark._ambient, dark._always, dark._held = (), None, None
        return dark

    @property
    def _ambient_formed(self) -> tuple[FloatArray, FloatArray] | None:
        if self._ambient and self._always is None:
            self._always = self._form_with_probes(self._ambient, _ALL)
        return self._always

    @property
    def _leak_formed(self) -> tuple[FloatArray, FloatArray] | None:
        if self._leak is not None and self._leaked is None:
            self._leaked = self._form_with_probes(self._lights, self._leak)
        return self._leaked

    def __iter__(self) -> Iterator[Frame]:
        step = at_once(side_of(self._shape))
        if not self._mixed:
            for start in range(0, len(self), step):
                irradiance, probed = self._form(start, min(start + step, len(self)))
                yield from self._frames(list(irradiance), list(probed))
            return
        if self._of_classes.one_each:
            if self._held is None:
                irradiance, probed = self._form(0, len(self))
                shots = self._of_classes.in_place(irradiance)
                self._held = self._frames(shots, self._of_classes.shots(probed, 0, len(self)), owned=True)
            yield from self._held
            return
        if self._formed is None:
            self._formed = self._form(0, self._basis.shape[0])
            if self._pairs is not None:
                chosen, (irradiance, probed) = self._pairs[0], self._formed
                # The classes' frames are not needed any more, and their probes may be another's.
                self._formed = _mix(chosen, irradiance, irradiance[: len(chosen)]), _mix(chosen, probed)
        (irradiance, probed), mixture = self._formed, self._pairs[1] if self._pairs else self._of_classes
        for start in range(0, len(self), step):
            stop = min(start + step, len(self))
            yield from self._frames(mixture.shots(irradiance, start, stop), mixture.shots(probed, start, stop))

    def sampling_error(self) -> tuple[float, float]:
        """Relative Monte Carlo error of all frames, and what it is below at 95 %, without forming any.

        The frames' energy is told by the random signs as well: as :func:`monte_carlo_error` and
        :func:`monte_carlo_bound` to a few percent, in a fraction of the time.
        """
        parts, energy, _ = self._told
        return (float(np.sqrt(parts.sum() / energy)), bound_of(parts, energy)) if energy else (0.0, 0.0)

    @property
    def noise(self) -> tuple[FloatArray, FloatArray]:
        """(lights, groups) and (ambient, groups) parts of the Monte Carlo variance of all frames, up to one factor, as
        :meth:`sampling_error` tells that of all; 0 of what was probed before."""
        of_lights = self._told[2]
        return of_lights[: len(self._lights)], of_lights[len(self._lights) :]

    @cached_property
    def _told(self) -> tuple[FloatArray, float, FloatArray]:
        """By the random signs: (groups,) parts of the frames' variance, their energy, and (lights + ambient, groups)
        squared norms of noise, not to scale."""
        count, energy = self._groups, 0.0
        parts, noise = np.zeros(count), np.zeros((len(self._lights) + len(self._ambient), count))
        if count < 2:
            return parts, energy, noise
        for start in range(0, len(self), _AT_ONCE):
            shots, of_lights = self._shots_probed(start, min(start + _AT_ONCE, len(self)))
            noise += of_lights
            for probed in shots:
                by_group = probed.reshape(self._shape[0], count, -1)
                mean = by_group.mean(axis=1)
                energy += float(np.square(mean).sum())
                parts += _squares(by_group - mean[:, None])
        return parts / (count * (count - 1)), energy, noise

    @property
    def probed(self) -> FloatArray | None:
        """(classes, m * groups * probes) frames of classes by single groups, as random signs see them.

        None where shots are formed one by one.
        """
        if self._mixed and self._probed is None:
            self._probed, self._noise = _probed(self._lights, self._basis, self._probes)
        return self._probed

    def _shots_probed(self, start: int, stop: int) -> tuple[FloatArray, FloatArray]:
        """(shots, m * groups * probes) frames of single groups as random signs see them, and (lights + ambient,
        groups) squared norms of their noise."""
        classes, weights = self.probed, self._weights[start:stop]
        if classes is not None:
            probed = np.stack(self._of_classes.shots(classes, start, stop))
            of_classes = np.zeros((1, len(self._lights), self._groups)) if self._noise is None else self._noise
            noise = (np.square(weights).sum(axis=0)[:, None, None] * of_classes).sum(axis=0)
        else:
            probed, of_shots = _probed(self._lights, self._basis[start:stop], self._probes)
            noise = of_shots.sum(axis=0)
            if self._leak_formed is not None:
                probed += self._leak_formed[1][0]
        if self._glint is not None:  # in every group
            brought = np.repeat((self._glint.irradiance @ self._probes)[:, :, None], self._groups, axis=2)
            probed += weights[:, self._glint.classes] @ brought.reshape(len(brought), -1)
        if self._ambient:
            seen, of_one = _probed(self._ambient, _ALL, self._probes)
            probed += seen
            noise = np.concatenate([noise, len(weights) * of_one[0]])
        return probed, noise

    def _form(self, start: int, stop: int) -> tuple[FloatArray, FloatArray]:
        """(b, m, m') frames of basis lights, (b, m * groups * probes) those of groups as signs see them.

        Glint is exact: it is in the frames alone, as no difference between groups has any. Classes that were probed
        before are not probed again.
        """
        basis = self._basis[start:stop]
        if self._probed is None:
            frames, probed = self._form_with_probes(self._lights, basis)
        else:
            frames, probed = _formed(self._lights, basis, None)[0], self._probed[start:stop]
        if not self._mixed and self._leak_formed is not None:
            frames += self._leak_formed[0]
            probed += self._leak_formed[1]
        if self._glint is not None:
            shares = self._shares[start:stop][:, self._glint.classes]
            for frame, share in zip(frames, shares, strict=True):
                for index in np.flatnonzero(share):
                    frame += share[index] * self._glint.irradiance[index]
        return frames, probed

    def _form_with_probes(self, lights: Sequence[Filed], basis: sparse.csr_array) -> tuple[FloatArray, FloatArray]:
        """As :func:`_formed`; a single group's frames differ from no others."""
        return _formed(lights, basis, self._probes if self._groups > 1 else None)

    @cached_property
    def _probes(self) -> FloatArray:
        return _probes(self._shape[1], self._seed)

    @property
    def _groups(self) -> int:
        return len(self._lights[0].groups)

    @property
    def _shape(self) -> tuple[int, int]:
        return self._lights[0].optics.frame_shape

    def _frames(
        self, irradiance: Sequence[FloatArray], probes: Sequence[FloatArray], owned: bool = False
    ) -> list[Frame]:
        """Frames (m, m') of light with what is in all of them, and their variance by ``probes``.

        Light that is ``owned`` by nobody else is changed in place.
        """
        ambient = self._ambient_formed
        count = self._groups
        pairs = count * (count - 1)

        def seen(row: int) -> Frame:
            frame, probed = irradiance[row], probes[row]
            if ambient is not None:
                frame = np.add(frame, ambient[0][0], out=frame if owned else None)
                probed = probed + ambient[1][0]
            by_group = probed.reshape(self._shape[0], count, -1)
            squared = _squares(by_group - by_group.mean(axis=1, keepdims=True)) if pairs else np.zeros(1)
            spread = float(squared.sum())
            variance = spread / pairs / frame.size if pairs else 0.0
            heaviest = float(squared.max()) / spread if spread else 0.0
            parts = tuple(float(part) / pairs / frame.size for part in squared) if pairs else ()
            if frame.min() >= 0:
                frame.flags.writeable = False  # of those that are held, which nobody may change
                return Frame(frame, variance, 0.0, heaviest, parts)
            whole = float(frame.sum())
            light = np.maximum(frame, 0, out=frame if owned else None)
            light.flags.writeable = False
            total = float(light.sum())
            return Frame(light, variance, (total - whole) / total if total else 0.0, heaviest, parts)

        return in_threads(seen, range(len(irradiance)))


def _squares(deviations: FloatArray) -> FloatArray:
    """(groups,) squared norms of ``deviations`` (m, groups, probes).

    Not products of vectors: BLAS adds up in an order that hangs on its threads.
    """
    return np.asarray(np.square(deviations).sum(axis=(0, 2)))


def _formed(
    lights: Sequence[Filed], basis: sparse.csr_array, probes: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Frames (b, m, m') of mixtures ``basis`` (b, rows), and the groups' own as ``probes`` see them.

    The latter are (b, m * groups * probes); none without probes.
    """
    shape, groups = lights[0].optics.frame_shape, len(lights[0].groups)
    mixed, count = _mixed(lights, basis), basis.shape[0]
    frames = np.zeros((count, *shape))
    probed = np.zeros((count, shape[0] * groups * (0 if probes is None else probes.shape[1])))

    def form(row: int) -> None:
        for number, (optics, parts) in enumerate(mixed):
            frame, seen = optics.seen([_row(part, row) for part in parts], probes, None if number else frames[row])
            if number:
                frames[row] += frame
            probed[row] += seen.ravel()

    in_threads(form, range(count))
    return frames, probed


def _probed(lights: Sequence[Filed], basis: sparse.csr_array, probes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """As :func:`_formed`, without the frames; and (b, lights, groups) squared norms of the groups' differences."""
    rows, groups = lights[0].optics.frame_shape[0], len(lights[0].groups)
    mixed, count = _mixed(lights, basis), basis.shape[0]
    probed, noise = np.zeros((count, rows * groups * probes.shape[1])), np.zeros((count, len(lights), groups))

    def probe(row: int) -> None:
        for number, (optics, parts) in enumerate(mixed):
            estimates = [_row(part, row) for part in parts]
            if not any(len(places) for places, _ in estimates):
                continue
            seen = optics.probe(estimates, probes)
            by_group = seen.reshape(rows, groups, -1)
            noise[row, number] = _squares(by_group - by_group.mean(axis=1, keepdims=True))
            probed[row] += seen.ravel()

    in_threads(probe, range(count))
    return probed, noise


def _mixed(lights: Sequence[Filed], basis: sparse.csr_array) -> list[tuple[FrameOptics, list[sparse.csr_array]]]:
    """Mixtures ``basis`` (b, rows) of each group of each light, with the light's optics."""
    mixed = [(light.optics, [_product(basis, group) for group in light.groups]) for light in lights]
    for _, parts in mixed:
        for part in parts:
            part.sort_indices()
    return mixed


def _product(basis: sparse.csr_array, light: sparse.csr_array) -> sparse.csr_array:
    """``basis @ light``; ``light`` itself where each row stays what it is."""
    if basis.nnz == len(basis.indices) == basis.shape[1] and not (basis - sparse.eye_array(*basis.shape)).nnz:
        return light
    if light.shape[1] <= _MOST_COLUMNS:
        return basis @ light
    places, indices = np.unique(light.indices, return_inverse=True)
    lit = sparse.csr_array((light.data, indices, light.indptr), shape=(light.shape[0], max(len(places), 1)))
    product = (basis @ lit).tocsr()
    # SciPy adds matrices of sorted rows entry by entry, and others by way of all their columns.
    product.sort_indices()
    wide = places[product.indices] if len(places) else product.indices
    return sparse.csr_array((product.data, wide, product.indptr), shape=(basis.shape[0], light.shape[1]))


def _probes(pixels: int, seed: int) -> FloatArray:
    """(pixels, 1 + 8) vectors v with E sum |A v|^2 = ||A||^2: the constant one exactly, the rest by random signs.

    Most of a frame's error is common to its columns, and a few signs alone would see that part with 12 % scatter.
    """
    constant = np.full((pixels, 1), pixels**-0.5)
    signs = stream(seed, "probe").choice((-1.0, 1.0), size=(pixels, PROBES)) / PROBES**0.5
    return np.concatenate([constant, signs - constant @ (constant.T @ signs)], axis=1)


@dataclass(frozen=True, eq=False)
class _Mixture:
    """Shots as sums of frames that are held.

    Attributes
    ----------
    weights
        (shots, b) of each held frame in each shot.
    least
        (b,) parts of them that all shots have and are added once.
    own
        the weights less these.
    """

    weights: FloatArray
    least: FloatArray
    own: sparse.csr_array

    @cached_property
    def one_each(self) -> bool:
        """Whether every shot has one held frame, and every held frame one shot."""
        shots, held = self.own.shape
        alone = np.array_equal(np.diff(self.own.indptr), np.ones(shots))
        return shots == held and alone and np.array_equal(np.sort(self.own.indices), np.arange(held))

    def in_place(self, basis: FloatArray) -> Sequence[FloatArray]:
        """All shots of which :attr:`one_each` holds, bit for bit as :meth:`shots` has them, where the frames of the
        ``basis`` (b, ...) lay: those are overwritten, for no memory is as dear as new memory."""
        common = _mix(self.least[None], basis)[0] if self.least.any() else None

        def turned(shot: int) -> FloatArray:
            (number,), (weight,) = _row(self.own, shot)
            frame: FloatArray = basis[number]
            if weight != 1:
                frame *= weight
            if common is not None:
                frame += common
            return frame

        return in_threads(turned, range(len(self.weights)))

    def shots(self, basis: FloatArray, start: int, stop: int) -> Sequence[FloatArray]:
        """Those from ``start`` to ``stop``, of the held frames ``basis`` (b, ...); some may be of the basis itself."""
        if self.own.nnz > _FEW * len(self.weights):
            return list(_mix(self.weights[start:stop], basis))
        common = _mix(self.least[None], basis)[0] if self.least.any() else None

        def added(shot: int) -> FloatArray:
            numbers, weights = _row(self.own, shot)
            if common is None and list(weights) == [1]:
                return np.asarray(basis[numbers[0]])
            total = np.zeros(basis.shape[1:]) if common is None else common.copy()
            for number, weight in zip(numbers, weights, strict=True):
                if weight == -1:
                    total -= basis[number]
                else:
                    total += basis[number] if weight == 1 else weight * basis[number]
            return total

        return in_threads(added, range(start, stop))


def _paired(weights: FloatArray) -> tuple[FloatArray, _Mixture] | None:
    """Shots of which all others are one, or what one leaves of the light of all pixels; and all shots by these.

    Patterns of +1 and -1 are shown as two shots that add up to the light of all pixels (of Hadamard patterns the first
    is that light), so half of the shots need no product of matrices. None where ``weights`` (shots, classes) have
    other values than two, or more pairs of shots than classes.
    """
    low, high = float(weights.min()), float(weights.max())
    lit = weights == high
    if not low < high or np.any(weights[~lit] != low):
        return None
    chosen: dict[bytes, int] = {}
    kept: list[npt.NDArray[np.bool_]] = []
    numbers, left = np.zeros(len(weights), int), np.zeros(len(weights), bool)
    for shot, row in enumerate(lit):
        key, other = row.tobytes(), (~row).tobytes()
        if key not in chosen and other not in chosen:
            chosen[key if row.any() else other] = len(kept)
            kept.append(row if row.any() else ~row)
        left[shot] = key not in chosen
        numbers[shot] = chosen[other if left[shot] else key]
    everything = chosen.get(np.ones(weights.shape[1], bool).tobytes())
    if everything is None or len(kept) > weights.shape[1]:
        return None
    by_pair = np.zeros((len(weights), len(kept)))
    by_pair[left, everything] = (low + high) / high
    by_pair[np.arange(len(weights)), numbers] += np.where(left, -1.0, 1.0)
    mixture = _Mixture(by_pair, np.zeros(len(kept)), sparse.csr_array(by_pair))
    return np.where(np.array(kept), high, low), mixture


def _mix(weights: FloatArray, basis: FloatArray, out: FloatArray | None = None) -> FloatArray:
    """(shots, ...) sums of a basis by weights.

    Parameters
    ----------
    weights
        (shots, b).
    basis
        (b, ...) arrays.
    out
        (shots, ...) for the result, which may be the first of the basis itself; a new array if not given.
    """
    flat = basis.reshape(len(basis), -1)
    mixed = np.empty((len(weights), flat.shape[1])) if out is None else out.reshape(len(weights), -1)

    def part(start: int) -> None:
        inside = slice(start, start + _COLUMNS)
        mixed[:, inside] = weights @ flat[:, inside]

    in_threads(part, range(0, flat.shape[1], _COLUMNS))
    return mixed.reshape(len(weights), *basis.shape[1:])


def monte_carlo_error(frames: Sequence[Frame] | ExpectedFrames) -> float:
    """Monte Carlo part of ||a - b|| / ||b|| over all pixels of all ``frames``."""
    variance = energy = 0.0
    for frame in frames:
        variance += frame.variance * frame.irradiance.size
        energy += float(np.square(frame.irradiance).sum())
    return float(np.sqrt(variance / energy)) if energy > 0 else 0.0


def monte_carlo_bound(frames: Sequence[Frame] | ExpectedFrames) -> float:
    """What the Monte Carlo error of all ``frames`` is below, at 95 %; see :func:`bound_of`."""
    parts, energy = np.zeros(1), 0.0
    for frame in frames:
        parts = parts + np.asarray(frame.by_group or (0.0,)) * frame.irradiance.size
        energy += float(np.square(frame.irradiance).sum())
    return bound_of(parts, energy)


def bound_of(parts: FloatArray, energy: float) -> float:
    """What a relative Monte Carlo error is below, at 95 %, from its square's ``parts`` by group and frames' ``energy``.

    The error that was made is one draw, and its estimate another. Where few paths make the noise, groups of the light
    differ much in the energy of theirs, and so would other draws: with v the relative variance of that energy among G
    groups, the squared error is below 1 + t sqrt(v G / (G - 1)) times its estimate. Student's t of G - 1 degrees of
    freedom, as v is an estimate too.
    """
    if not energy or not parts.sum():
        return 0.0
    count = len(parts)
    above = bound_over_error((float(parts.std(ddof=1) / parts.mean())) ** 2, count) if count > 1 else 1.0
    return above * float(np.sqrt(parts.sum() / energy))


def bound_over_error(variance: float, count: int) -> float:
    """How far :func:`bound_of` lies above the error, as a ratio.

    Parameters
    ----------
    variance
        relative variance of the energy of the noise among groups.
    count
        of groups.
    """
    return math.sqrt(1 + math.sqrt(variance) * _deviations(count))


def _deviations(count: int) -> float:
    """Standard deviations of so many groups' energies from their mean to the bound on an error's."""
    return float(stdtrit(count - 1, _SURE)) * math.sqrt(count / (count - 1))


def shares_of_bound(parts: FloatArray) -> FloatArray:
    """(lights,) what each of several lights brings to the square of :func:`bound_of`, from their ``parts`` (lights,
    groups) of the variance, on their scale: none less than nothing.

    The bound's square is the variance and a multiple of how much groups differ in it; of that, a light brings its
    covariance with all light.
    """
    total, count = parts.sum(axis=0), parts.shape[1]
    deviation = float(total.std(ddof=1))
    found = parts.sum(axis=1)
    if deviation:
        along = (parts * (total - total.mean())).sum(axis=1) / (count - 1) / deviation
        found = found + _deviations(count) * count * along
    return np.asarray(np.maximum(found, 0.0))


def _row(matrix: sparse.csr_array, row: int) -> Entries:
    inside = slice(matrix.indptr[row], matrix.indptr[row + 1])
    return matrix.indices[inside], matrix.data[inside]

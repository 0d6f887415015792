"""Frames of a family: from light of its classes to the expected irradiance of every shot, and its Monte Carlo error.

Frames are formed, and their error told, by :mod:`mitsim.optics.forming`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy import sparse

from mitsim.core.arrays import FloatArray
from mitsim.core.parallel import in_threads
from mitsim.devices.camera import side_of
from mitsim.devices.patterns import Lighting
from mitsim.optics.forming import (
    AccumulatedLight,
    Mixture,
    bound_of,
    form_frames,
    mix_frames,
    noise_of_groups,
    pair_shots,
    probe_frames,
    probe_vectors,
)
from mitsim.optics.image_formation import IntArray

_AT_ONCE, _BYTES_AT_ONCE = 32, 2**27
"""Frames formed at a time: enough to keep all processors busy; and their bytes, where fewer have as many: 4 frames of a
sensor of 2048 pixels."""
_LARGEST_BASIS, _BASIS_BYTES = 256, 7 * 2**28
"""Classes whose frames are held to be mixed, 512 MiB of a sensor of 512 pixels; and their bytes, of which a process of
4 GiB has room for: 56 frames of a sensor of 2048 pixels. Beyond them frames are formed twice."""
_FLOAT = 8
"""Bytes of a pixel of a frame."""
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
        (G, G) inner products of what each group of the light brings to the variance, which is their trace.
    """

    irradiance: FloatArray
    variance: float
    removed: float
    heaviest: float
    by_group: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))


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


# -------- How many frames are held


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


# -------- All frames of a family


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
        light of the same rows (projector pixels, or classes of them), accumulated in one kind of cells or more; their
        groups are paired.
    lighting
        class of each row, and the fraction of full power that each class emits in each shot.
    seed
        of the random signs.
    ambient
        light (1, cells) of every shot, its groups paired with those of ``lights``.
    specular
        frames to be added to those of some classes.
    probed
        :attr:`probed` of other shots of the same lights, classes and seed.
    restated
        factor of the Monte Carlo error over that by the groups' differences.
    """

    def __init__(
        self,
        lights: Sequence[AccumulatedLight],
        lighting: Lighting,
        seed: int,
        ambient: Sequence[AccumulatedLight] = (),
        specular: ClassFrames | None = None,
        probed: FloatArray | None = None,
        restated: float = 1.0,
    ) -> None:
        self._restated = restated
        self._lights, self._ambient, self._specular = tuple(lights), tuple(ambient), specular
        self._seed, self._weights = seed, lighting.weights
        (shots, classes), rows = lighting.weights.shape, lighting.labels.size
        indicator = sparse.csr_array((np.ones(rows), (lighting.labels, np.arange(rows))), shape=(classes, rows))
        self._mixed = mixes(classes, shots, side_of(self._shape))
        self._shares = np.eye(classes) if self._mixed else self._weights
        least = self._weights.min(axis=0)
        self._of_classes = Mixture(self._weights, least, sparse.csr_array(self._weights - least))
        self._pairs = pair_shots(self._weights) if self._mixed and not self._of_classes.sparse else None
        if self._mixed or shots < 2 or 2 * np.count_nonzero(self._weights == least) < self._weights.size:
            least = np.zeros(classes)
        self._leak = sparse.csr_array(sparse.csr_array(least[None]) @ indicator) if least.any() else None
        self._basis = (
            indicator if self._mixed else sparse.csr_array(sparse.csr_array(self._weights - least) @ indicator)
        )
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
        light = np.zeros(self._shape) if self._ambient_light is None else self._ambient_light[0][0]
        return Frame(np.maximum(light, 0.0), 0.0, 0.0, 0.0)

    @property
    def of_projector(self) -> ExpectedFrames:
        """The same shots in a dark room."""
        dark = copy(self)
        dark._ambient = ()
        for with_ambient in ("_ambient_light", "_frames_of_classes", "_energies"):
            vars(dark).pop(with_ambient, None)
        return dark

    def __iter__(self) -> Iterator[Frame]:
        if self._mixed and self._of_classes.one_each:
            yield from self._frames_of_classes
            return
        step = at_once(side_of(self._shape))
        for start in range(0, len(self), step):
            stop = min(start + step, len(self))
            if self._mixed:
                (irradiance, probed), mixture = self._mixed_basis, self._pairs[1] if self._pairs else self._of_classes
                yield from self._frames(mixture.shots(irradiance, start, stop), mixture.shots(probed, start, stop))
            else:
                irradiance, probed = self._form(start, stop)
                yield from self._frames(list(irradiance), list(probed))

    # ---- Monte Carlo error, from random signs alone ----

    def sampling_error(self) -> tuple[float, float]:
        """Relative Monte Carlo error of all frames, and what it is below at 95 %, without forming any.

        The frames' energy is told by the random signs as well: as :func:`monte_carlo_error` and
        :func:`monte_carlo_bound` to a few percent, in a fraction of the time.
        """
        parts, energy, _ = self._energies
        return (float(np.sqrt(np.trace(parts) / energy)), bound_of(parts, energy)) if energy else (0.0, 0.0)

    @property
    def noise(self) -> tuple[FloatArray, FloatArray]:
        """(lights, G, G) and (ambient, G, G) parts of the Monte Carlo variance of all frames, up to one factor, as
        :meth:`sampling_error` tells that of all; 0 of what was probed before."""
        of_lights = self._energies[2]
        return of_lights[: len(self._lights)], of_lights[len(self._lights) :]

    @cached_property
    def _energies(self) -> tuple[FloatArray, float, FloatArray]:
        """(G, G) parts of the frames' variance, the frames' energy, and (lights + ambient, G, G) inner products of
        noise, not to scale."""
        count, energy = self._groups, 0.0
        parts, noise = np.zeros((count, count)), np.zeros((len(self._lights) + len(self._ambient), count, count))
        if count < 2:
            return parts, energy, noise
        for start in range(0, len(self), _AT_ONCE):
            shots, of_lights = self._shots_probed(start, min(start + _AT_ONCE, len(self)))
            noise += of_lights
            for probed in shots:
                energy += float(np.square(probed.reshape(self._shape[0], count, -1).mean(axis=1)).sum())
                parts += noise_of_groups(probed, self._shape[0], count)
        return parts * (self._restated**2 / (count * (count - 1))), energy, noise

    @property
    def probed(self) -> FloatArray | None:
        """(classes, m * groups * probes) frames of classes by single groups, as random signs see them.

        None where shots are formed one by one.
        """
        if self._mixed and self._probed is None:
            self._probed, self._noise = probe_frames(self._lights, self._basis, self._probes)
        return self._probed

    def _shots_probed(self, start: int, stop: int) -> tuple[FloatArray, FloatArray]:
        """(shots, m * groups * probes) frames of single groups times the probes, and (lights + ambient, G, G) inner
        products of their noise."""
        classes, weights = self.probed, self._weights[start:stop]
        if classes is not None:
            probed = np.stack(self._of_classes.shots(classes, start, stop))
            unknown = np.zeros((1, len(self._lights), self._groups, self._groups))
            of_classes = unknown if self._noise is None else self._noise
            noise = (np.square(weights).sum(axis=0)[:, None, None, None] * of_classes).sum(axis=0)
        else:
            probed, of_shots = probe_frames(self._lights, self._basis[start:stop], self._probes)
            noise = of_shots.sum(axis=0)
            if self._leaked_light is not None:
                probed += self._leaked_light[1][0]
        if self._specular is not None:  # in every group
            brought = np.repeat((self._specular.irradiance @ self._probes)[:, :, None], self._groups, axis=2)
            probed += weights[:, self._specular.classes] @ brought.reshape(len(brought), -1)
        if self._ambient:
            seen, of_one = probe_frames(self._ambient, _ALL, self._probes)
            probed += seen
            noise = np.concatenate([noise, len(weights) * of_one[0]])
        return probed, noise

    # ---- Forming, once for all iterations ----

    @cached_property
    def _ambient_light(self) -> tuple[FloatArray, FloatArray] | None:
        return self._form_with_probes(self._ambient, _ALL) if self._ambient else None

    @cached_property
    def _leaked_light(self) -> tuple[FloatArray, FloatArray] | None:
        return None if self._leak is None else self._form_with_probes(self._lights, self._leak)

    @cached_property
    def _frames_of_classes(self) -> Sequence[Frame]:
        """All shots, where each is one class: they lie where the classes' frames lay."""
        irradiance, probed = self._form(0, len(self))
        shots = self._of_classes.in_place(irradiance)
        return self._frames(shots, self._of_classes.shots(probed, 0, len(self)), owned=True)

    @cached_property
    def _mixed_basis(self) -> tuple[FloatArray, FloatArray]:
        """Frames that shots are mixed from: of classes, or the first shots of pairs, in the classes' place."""
        irradiance, probed = self._form(0, self._basis.shape[0])
        if self._pairs is None:
            return irradiance, probed
        chosen = self._pairs[0]  # the probes stay, which may be another's
        return mix_frames(chosen, irradiance, irradiance[: len(chosen)]), mix_frames(chosen, probed)

    def _form(self, start: int, stop: int) -> tuple[FloatArray, FloatArray]:
        """(b, m, m') frames of basis lights, (b, m * groups * probes) those of groups as signs see them.

        Light of specular chains is exact: it is in the frames alone, as no difference between groups has any. Classes
        that were probed before are not probed again.
        """
        basis = self._basis[start:stop]
        if self._probed is None:
            frames, probed = self._form_with_probes(self._lights, basis)
        else:
            frames, probed = form_frames(self._lights, basis, None)[0], self._probed[start:stop]
        if not self._mixed and self._leaked_light is not None:
            frames += self._leaked_light[0]
            probed += self._leaked_light[1]
        if self._specular is not None:
            shares = self._shares[start:stop][:, self._specular.classes]
            for frame, share in zip(frames, shares, strict=True):
                for index in np.flatnonzero(share):
                    frame += share[index] * self._specular.irradiance[index]
        return frames, probed

    def _form_with_probes(
        self, lights: Sequence[AccumulatedLight], basis: sparse.csr_array
    ) -> tuple[FloatArray, FloatArray]:
        """As :func:`form_frames`; a single group's frames differ from no others."""
        return form_frames(lights, basis, self._probes if self._groups > 1 else None)

    @cached_property
    def _probes(self) -> FloatArray:
        return probe_vectors(self._shape[1], self._seed)

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
        ambient = self._ambient_light
        count = self._groups
        pairs = count * (count - 1)

        def frame_of(row: int) -> Frame:
            frame, probed = irradiance[row], probes[row]
            if ambient is not None:
                frame = np.add(frame, ambient[0][0], out=frame if owned else None)
                probed = probed + ambient[1][0]
            products = noise_of_groups(probed, self._shape[0], count) if pairs else np.zeros((1, 1))
            spread = float(np.trace(products))
            scale = self._restated**2 / max(pairs, 1) / frame.size
            variance, parts = spread * scale, products * scale
            heaviest = float(products.max()) / spread if spread else 0.0
            if frame.min() >= 0:
                frame.flags.writeable = False  # of those that are held, which nobody may change
                return Frame(frame, variance, 0.0, heaviest, parts)
            whole = float(frame.sum())
            light = np.maximum(frame, 0, out=frame if owned else None)
            light.flags.writeable = False
            total = float(light.sum())
            return Frame(light, variance, (total - whole) / total if total else 0.0, heaviest, parts)

        return in_threads(frame_of, range(len(irradiance)))


# -------- The error of frames that were formed


def monte_carlo_error(frames: Sequence[Frame] | ExpectedFrames) -> float:
    """Monte Carlo part of ||a - b|| / ||b|| over all pixels of all ``frames``."""
    variance = energy = 0.0
    for frame in frames:
        variance += frame.variance * frame.irradiance.size
        energy += float(np.square(frame.irradiance).sum())
    return float(np.sqrt(variance / energy)) if energy > 0 else 0.0


def monte_carlo_bound(frames: Sequence[Frame] | ExpectedFrames) -> float:
    """What the Monte Carlo error of all ``frames`` is below, at 95 %; see :func:`bound_of`."""
    parts, energy = np.zeros((1, 1)), 0.0
    for frame in frames:
        parts = parts + frame.by_group * frame.irradiance.size
        energy += float(np.square(frame.irradiance).sum())
    return bound_of(parts, energy)

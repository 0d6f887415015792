"""Factors as codes seen through shifts, fitted to frames of known pictures.

A mask before a sensor casts the same shadow from every direction, shifted. So a side's factor is an unknown code c on a
grid of sensor pixels, seen from scene pixel i through a shift::

    Phi[u, i] = sum_k b_k(i) c_k(u + o + s i)

with s the sensor pixels that one scene pixel shifts the shadow by, o the place of this frame's pixels (planes of a
Bayer sensor lie half a pixel apart), and b_k polynomials over the scene, b_0 = 1. Several terms describe a code that
changes smoothly over the scene, for example by falloff, a lens or a mask of some thickness.

*Alternating least squares.* With Z = X Phi_R^T a frame is Y = Phi_L Z, and Phi_L is linear in its codes. Left and right
take turns until the misfit is constant. A code's numbers have an independent prior of variance 1 / alpha, estimated
from the frames (MacKay 1992, Neural Computation 4, 415): alpha = gamma / |c|^2, where gamma = tr N (N + alpha)^-1 is
the number of parameters that the frames determine, and (N + alpha)^-1 is their covariance.

*Start.* A frame's spectrum is Y(f, g) = C_L(f) C_R(g) X(-s f, -s' g), up to the sensor's edges. Y over X is a product
of two vectors only for the right orientation and scale of the scene."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize_scalar

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.exr import checksum, finite_channel, read_frame
from mitsim.core.imagelist import BGGR, PLANES, Crop, Preparation, Wanted, planes_of
from mitsim.core.images import orient, own_end, read_image
from mitsim.core.job import Cost, Limits
from mitsim.core.manifests import MANIFEST
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import load_run
from mitsim.devices.framelist import KnownCapture, KnownCaptures, preparation_of
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.solver import centre_columns, centre_frame


@dataclass(frozen=True, eq=False)
class Exposure:
    """Frame and the light that it shows.

    Attributes
    ----------
    scene : (n, n') array
        Picture times its pattern.
    frame : (m, m') array, electrons/s
        Measurement, centred where the camera's factors are.
    group
        Picture number; frames of one picture are held out together.
    plane
        Name of the sensor's plane; planes have gains of their own.
    offset
        Offset of the plane's pixels, down and to the right, 0 to below 1 pixel.
    """

    scene: FloatArray
    frame: FloatArray
    group: int = 0
    plane: str = ""
    offset: tuple[float, float] = (0.0, 0.0)

    def turn_scene(self, orientation: str) -> Exposure:
        """Return the exposure with its scene in another ``orientation``."""
        return replace(self, scene=TURNS[orientation](self.scene))


TURNS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "upright": lambda scene: scene,
    "mirrored": lambda scene: scene[:, ::-1],
    "upside down": lambda scene: scene[::-1],
    "turned": lambda scene: scene[::-1, ::-1],
    "transposed": lambda scene: scene.T,
    "transposed, mirrored": lambda scene: scene.T[:, ::-1],
    "transposed, upside down": lambda scene: scene.T[::-1],
    "transposed, turned": lambda scene: scene.T[::-1, ::-1],
}
"""Orientations of a picture relative to the camera's code."""


@dataclass(frozen=True)
class Shape:
    """Fixed quantities of a fit: ``scales`` s of both sides [sensor pixels / scene pixel], codes a side, centring."""

    scales: tuple[float, float]
    terms: int = 1
    centre: bool = False


# ---- One side ----


@dataclass(frozen=True, eq=False)
class Side:
    """Geometry of one side: ``sensor`` and ``scene`` pixels, ``scale``, ``terms``, and whether it is centred."""

    sensor: int
    scene: int
    scale: float
    terms: int
    centre: bool

    @property
    def width(self) -> int:
        """Length of the window of the code that one sensor pixel sees."""
        return int(np.floor(self.scale * (self.scene - 1))) + 3

    @property
    def length(self) -> int:
        """Length of the code."""
        return self.sensor + self.width - 1

    @cached_property
    def weights(self) -> FloatArray:
        """Polynomials b_k (terms, n) of mean square 1."""
        place = np.linspace(-1, 1, self.scene) if self.scene > 1 else np.zeros(1)
        return np.stack(
            [np.polynomial.legendre.Legendre.basis(k)(place) * np.sqrt(2 * k + 1) for k in range(self.terms)]
        )

    def hats(self, offset: float) -> FloatArray:
        """Return the linear interpolation (n, width) of each scene pixel in its window, at an ``offset``."""
        place = offset + self.scale * np.arange(self.scene)
        first = np.floor(place).astype(int)
        found = np.zeros((self.scene, self.width))
        rows = np.arange(self.scene)
        found[rows, first] = 1 - (place - first)
        found[rows, first + 1] += place - first
        return found

    def factor(self, codes: FloatArray, offset: float) -> FloatArray:
        """Return Phi (m, n) of ``codes`` (terms, length) for pixels at an ``offset``."""
        hats, phi = self.hats(offset), np.zeros((self.sensor, self.scene))
        for code, weight in zip(codes, self.weights, strict=True):
            phi += (sliding_window_view(code, self.width) @ hats.T) * weight
        return centre_columns(phi) if self.centre else phi

    def normal(self, offset: float, gram: FloatArray, product: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return normal matrix and right-hand side of the codes.

        ``gram`` (n, n) and ``product`` (m, n) are the sums of Z Z^T and Y Z^T over the noise's variance.
        """
        hats, w, k = self.hats(offset), self.width, self.terms
        spread = (self.weights[:, :, None] * hats[None]).transpose(1, 0, 2).reshape(self.scene, k * w)
        block = (spread.T @ gram @ spread).reshape(k, w, k, w)
        side = (product @ spread).reshape(self.sensor, k, w)
        matrix, right = np.zeros((k, self.length, k, self.length)), np.zeros((k, self.length))
        total = np.zeros((self.scene, k, self.length))
        for row in range(self.sensor):
            window = slice(row, row + w)
            matrix[:, window, :, window] += block
            right[:, window] += side[row]
            total[:, :, window] += spread.reshape(self.scene, k, w)
        flat = matrix.reshape(k * self.length, -1)
        if self.centre:
            every = total.reshape(self.scene, -1)
            flat -= every.T @ (gram @ every) / self.sensor
        return flat, right.ravel()


# ---- Both sides ----


@dataclass(frozen=True, eq=False)
class Codes:
    """Fitted codes.

    Attributes
    ----------
    sides
        Geometry of rows and of columns.
    codes : (terms, length) arrays
        Codes of either side.
    gains
        Gain of each plane.
    variances
        Mean square of what is left of each frame.
    explained
        Mean explained part of the frames' energy.
    errors
        Standard deviation of a number of each factor, rms, at gains of 1, undetermined numbers included.
    seen_errors
        Independent errors that change frames of these scenes as much as the factors' errors do.
    told
        Numbers of each side's codes that the frames determine.
    """

    sides: tuple[Side, Side]
    codes: tuple[FloatArray, FloatArray]
    gains: dict[str, float]
    variances: FloatArray
    explained: float
    errors: tuple[float, float]
    seen_errors: tuple[float, float]
    told: tuple[float, float]

    def factors(self, offset: tuple[float, float] = (0.0, 0.0), plane: str = "") -> tuple[FloatArray, FloatArray]:
        """Return Phi_L (m, n) and Phi_R (m', n') of a ``plane`` whose pixels are at an ``offset``."""
        gain = self.gains[plane]
        left, right = (
            side.factor(codes, place) * np.sqrt(abs(gain))
            for side, codes, place in zip(self.sides, self.codes, offset, strict=True)
        )
        return np.sign(gain) * left, right

    @property
    def evidence(self) -> float:
        """Log-likelihood of the frames, less the penalty of the determined numbers (Schwarz 1978)."""
        size = self.sides[0].sensor * self.sides[1].sensor
        likelihood = -0.5 * size * float(np.log(self.variances).sum())
        return likelihood - 0.5 * sum(self.told) * float(np.log(size * len(self.variances)))

    def explains(self, exposures: Sequence[Exposure]) -> float:
        """Return the mean part of the energy of other ``exposures`` that the codes explain."""
        parts = []
        for each in exposures:
            left, right = self.factors(each.offset, each.plane)
            misfit = each.frame - left @ each.scene @ right.T
            parts.append(1 - float(np.sum(np.square(misfit)) / np.sum(np.square(each.frame))))
        return float(np.mean(parts))


_TURNS, _STILL = 20, 1e-5
"""Largest number of turns, and the gain of the explained part that ends them."""
_VAGUE = 1e-3
"""First guess of alpha, over the mean of N's diagonal."""


@single_threaded_blas()
def fit_codes(
    exposures: Sequence[Exposure], shape: Shape, start: FloatArray | None = None, turns: int = _TURNS
) -> Codes:
    """Fit the codes of both sides to ``exposures`` whose scenes lie as the code runs.

    Parameters
    ----------
    start
        Code of columns to begin with; None: that of the spectra.
    turns
        Largest number of turns of both sides.

    Raises
    ------
    MitsimError
        For frames or scenes without light.
    """
    sides = _sides(exposures, shape)
    first = spectral_start(exposures, shape.scales)[1] if start is None else start
    codes = [np.zeros((shape.terms, side.length)) for side in sides]
    codes[1][0] = np.interp(np.arange(sides[1].length), np.arange(len(first)), first)
    gains = dict.fromkeys((each.plane for each in exposures), 1.0)
    energies = np.array([np.mean(np.square(each.frame)) for each in exposures])
    if not (energies > 0).all():
        raise MitsimError("known pictures: a frame is even, and tells nothing of the camera; leave it out")
    variances, explained = energies.copy(), -1.0
    known: list[_Known] = [_Known.vague(side) for side in sides]
    for _ in range(turns):
        for axis in (0, 1):
            codes[axis], known[axis] = _solve_side(
                exposures, sides, axis, codes[1 - axis], gains, variances, known[axis]
            )
        gains, variances = _levels(exposures, sides, codes, gains)
        before, explained = explained, 1 - float(np.mean(variances / energies))
        if explained - before < _STILL:
            break
    balance = float(np.sqrt(np.linalg.norm(codes[1]) / np.linalg.norm(codes[0])))
    scales = balance, 1 / balance
    spread = [_spread(side, each.covariance) for side, each in zip(sides, known, strict=True)]
    return Codes(
        sides,
        (codes[0] * balance, codes[1] / balance),
        gains,
        variances,
        explained,
        (spread[0] * scales[0], spread[1] * scales[1]),
        (known[0].seen * scales[0], known[1].seen * scales[1]),
        (known[0].told, known[1].told),
    )


def _sides(exposures: Sequence[Exposure], shape: Shape) -> tuple[Side, Side]:
    left, right = (
        Side(sensor, scene, scale, shape.terms, shape.centre)
        for sensor, scene, scale in zip(exposures[0].frame.shape, exposures[0].scene.shape, shape.scales, strict=True)
    )
    return left, right


@dataclass(frozen=True, eq=False)
class _Known:
    alphas: FloatArray
    covariance: FloatArray
    told: float = 0.0
    seen: float = 0.0

    @classmethod
    def vague(cls, side: Side) -> _Known:
        return cls(np.zeros(side.terms), np.zeros((0, 0)))


def _solve_side(
    exposures: Sequence[Exposure],
    sides: tuple[Side, Side],
    axis: int,
    other: FloatArray,
    gains: dict[str, float],
    variances: FloatArray,
    before: _Known,
) -> tuple[FloatArray, _Known]:
    own, across = sides[axis], sides[1 - axis]
    phis = {place: across.factor(other, place) for place in {each.offset[1 - axis] for each in exposures}}
    sums: dict[float, list[FloatArray]] = {}
    for each, variance in zip(exposures, variances, strict=True):
        scene, frame = (each.scene, each.frame) if axis == 0 else (each.scene.T, each.frame.T)
        light = gains[each.plane] * (scene @ phis[each.offset[1 - axis]].T)
        added = [light @ light.T / variance, frame @ light.T / variance]
        place = each.offset[axis]
        sums[place] = [a + b for a, b in zip(sums[place], added, strict=True)] if place in sums else added
    matrix: FloatArray = np.zeros((own.terms * own.length,) * 2)
    right: FloatArray = np.zeros(len(matrix))
    for place, (gram, product) in sums.items():
        parts = own.normal(place, gram, product)
        matrix += parts[0]
        right += parts[1]
    level = float(np.trace(matrix)) / len(matrix)
    if not level > 0:
        raise MitsimError("known pictures: have no light, or an even one, and tell nothing of the camera; give others")
    alphas = np.where(before.alphas > 0, before.alphas, _VAGUE * level)
    factored = cho_factor(matrix + np.diag(np.repeat(alphas, own.length)))
    found = cho_solve(factored, right).reshape(own.terms, -1)
    covariance = cho_solve(factored, np.eye(len(matrix)))
    unknown = alphas * np.diag(covariance).reshape(own.terms, -1).sum(axis=1)
    told = np.maximum(own.length - unknown, 0.0)
    # Codes that explain nothing would make alpha infinite, and the matrix singular to rounding.
    energies = np.maximum(np.square(found).sum(axis=1), told / (_LARGEST * level))
    alphas = np.clip(told / np.maximum(energies, 1e-300), _SMALLEST * level, _LARGEST * level)
    lit = sum(float(np.trace(gram)) for gram, _ in sums.values())
    return found, _Known(alphas, covariance, float(told.sum()), float(np.sqrt(told.sum() / (own.sensor * lit))))


_SMALLEST, _LARGEST = 1e-9, 1e6
"""Limits of alpha over the mean of N's diagonal."""


def _levels(
    exposures: Sequence[Exposure], sides: tuple[Side, Side], codes: list[FloatArray], gains: dict[str, float]
) -> tuple[dict[str, float], FloatArray]:
    phis = [
        {place: side.factor(code, place) for place in {each.offset[axis] for each in exposures}}
        for axis, (side, code) in enumerate(zip(sides, codes, strict=True))
    ]
    models = [phis[0][each.offset[0]] @ each.scene @ phis[1][each.offset[1]].T for each in exposures]
    above, below = dict.fromkeys(gains, 0.0), dict.fromkeys(gains, 0.0)
    for each, model in zip(exposures, models, strict=True):
        above[each.plane] += float(np.vdot(model, each.frame))
        below[each.plane] += float(np.vdot(model, model))
    gains = {name: above[name] / below[name] for name in gains}
    left = [
        np.mean(np.square(each.frame - gains[each.plane] * model))
        for each, model in zip(exposures, models, strict=True)
    ]
    return gains, np.asarray(left)


def _spread(side: Side, covariance: FloatArray) -> float:
    hats = side.hats(0.0)
    k, w = side.terms, side.width
    spread = (side.weights[:, :, None] * hats[None]).transpose(1, 0, 2)  # (n, terms, w)
    block = np.zeros((k, w, k, w))
    whole = covariance.reshape(k, side.length, k, side.length)
    for row in range(side.sensor):
        block += whole[:, row : row + w, :, row : row + w]
    total = float(np.einsum("iaw,awbv,ibv->", spread, block, spread, optimize=True))
    return float(np.sqrt(max(total, 0.0) / (side.sensor * side.scene)))


# ---- The start: orientation, scale and codes by spectra ----

_FREQUENCIES = 20
"""Frequencies of either sign, lowest first, whose spectra are compared."""
_COMPARED = 2
"""Frames whose spectra are compared."""
_STEP = 1.1
"""Ratio of neighbouring tried scales."""
_WIDEST, _NARROWEST = 1.0, 0.03
"""Limits of the shadow's way over the whole scene, over the length of the sensor."""
_FIRST_TURNS, _SCALE_TURNS = 2, 3
"""Turns that decide the orientation, and the scale."""
_CERTAIN = 1.2
"""Least ratio of what another orientation and the right one leave of the frames."""


def spectral_start(exposures: Sequence[Exposure], scales: tuple[float, float]) -> tuple[float, FloatArray]:
    """Return how nearly the spectra are a product of two vectors, 0 to 1, and the resulting code of columns."""
    some = exposures[:: -(-len(exposures) // _COMPARED)]
    return _Spectra.of(some).compare([each.scene for each in some], scales)


@dataclass(frozen=True, eq=False)
class _Spectra:
    frames: list[npt.NDArray[np.complex128]]
    periods: tuple[float, float]

    @classmethod
    def of(cls, exposures: Sequence[Exposure]) -> _Spectra:
        """Return spectra of ``exposures``, with periods that leave room for a shadow that moves by half the sensor."""
        rows, columns = exposures[0].frame.shape
        periods = 1.5 * rows, 1.5 * columns
        waves = [_waves(count, period) for count, period in zip((rows, columns), periods, strict=True)]
        return cls([waves[0] @ each.frame @ waves[1].T for each in exposures], periods)

    def compare(self, scenes: Sequence[FloatArray], scales: tuple[float, float]) -> tuple[float, FloatArray]:
        above, below = np.zeros_like(self.frames[0]), np.zeros(self.frames[0].shape)
        left, right = (
            np.conj(_waves(count, period / scale))
            for count, period, scale in zip(scenes[0].shape, self.periods, scales, strict=True)
        )
        for frame, scene in zip(self.frames, scenes, strict=True):
            lit = left @ scene @ right.T
            above += frame * np.conj(lit)
            below += np.abs(frame * lit)
        # Phases alone: of amplitudes a few strong waves would decide, which any code has.
        _, values, code_waves = np.linalg.svd(above / np.maximum(below, np.finfo(np.float64).tiny))
        code = np.real(code_waves[0] @ np.conj(_waves(int(2 * self.periods[1]), self.periods[1])))
        return float(values[0] ** 2 / max(np.sum(np.square(values)), np.finfo(np.float64).tiny)), code


def _waves(count: int, period: float) -> npt.NDArray[np.complex128]:
    order = np.arange(1, _FREQUENCIES + 1)
    return np.asarray(
        np.exp(-2j * np.pi / period * np.multiply.outer(np.concatenate([order, -order]), np.arange(count)))
    )


@dataclass(frozen=True)
class Pose:
    """Orientation and scale of scenes before the camera.

    Attributes
    ----------
    orientation
        One of :data:`TURNS`.
    scales
        Scales of rows and of columns [sensor pixels / scene pixel].
    margin
        Explained part of the energy beyond that of the best other orientation; None: not compared.
    certain
        Whether that is clear.
    """

    orientation: str
    scales: tuple[float, float]
    margin: float | None = None
    certain: bool = True


@single_threaded_blas()
def find_pose(
    exposures: Sequence[Exposure], orientation: str | None = None, scales: tuple[float, float] | None = None
) -> Pose:
    """Find the pose of scenes by spectra, and then by codes that are fitted to centred frames."""
    exposures = [replace(each, frame=centre_frame(each.frame)) for each in exposures]
    some = exposures[:: -(-len(exposures) // _COMPARED)]
    spectra = _Spectra.of(some)
    scenes = {name: [turn(each.scene) for each in some] for name, turn in TURNS.items()}
    ratio = some[0].frame.shape[0] / some[0].scene.shape[0]
    count = int(np.ceil(np.log(_WIDEST / _NARROWEST) / np.log(_STEP)))
    places = [(ratio * _NARROWEST * _STEP**power,) * 2 for power in range(count + 1)] if scales is None else [scales]
    scores = {name: np.array([spectra.compare(own, place)[0] for place in places]) for name, own in scenes.items()}
    # Of a scale near 0 a frame is the product of two vectors whichever way the scene lies; the right way is one alone.
    usual = np.median(list(scores.values()), axis=0)
    found = [
        (score - common, name, place)
        for name, row in scores.items()
        for score, common, place in zip(row, usual, places, strict=True)
        if orientation in (None, name)
    ]
    candidates = {name: max(each for each in found if each[1] == name) for name in {name for _, name, _ in found}}
    tried = []
    for _, name, place in candidates.values():
        turned = [each.turn_scene(name) for each in some]
        if scales is None:
            place = _refine(partial(_unlike, spectra, [each.scene for each in turned]), place, _STEP)
        fitted = fit_codes(turned, Shape(place, 1, True), turns=_FIRST_TURNS)
        tried.append((fitted.evidence, fitted.explained, name, place))
    best = max(tried)
    others = [explained for _, explained, name, _ in tried if name != best[2]]
    pose = Pose(best[2], best[3])
    if others:
        pose = replace(pose, margin=best[1] - max(others), certain=1 - max(others) > _CERTAIN * (1 - best[1]))
    if scales is not None:
        return pose
    turned = [each.turn_scene(pose.orientation) for each in exposures]

    def misfit(at: tuple[float, float]) -> float:
        return -fit_codes(turned, Shape(at, 1, True), turns=_SCALE_TURNS).evidence

    for _ in range(_STEPS):
        before, pose = pose.scales, replace(pose, scales=_refine(misfit, pose.scales, _FINE))
        if np.all(np.abs(np.log(pose.scales) - np.log(before)) < np.log(_FINE) / 2):
            break
    return pose


def _unlike(spectra: _Spectra, scenes: Sequence[FloatArray], scales: tuple[float, float]) -> float:
    return -spectra.compare(scenes, scales)[0]


_FINE, _STEPS = 1.03, 10
"""Ratio by which a fit may change a scale at once, and the number of changes."""


def _refine(
    misfit: Callable[[tuple[float, float]], float], start: tuple[float, float], reach: float
) -> tuple[float, float]:
    options = {"xatol": np.log(reach) * _TOLERANCE}
    bounds = -np.log(reach), np.log(reach)
    row = minimize_scalar(
        lambda x: misfit((start[0] * np.exp(x), start[1])), bounds=bounds, method="bounded", options=options
    )
    rows = start[0] * float(np.exp(row.x))
    column = minimize_scalar(
        lambda x: misfit((rows, start[1] * np.exp(x))), bounds=bounds, method="bounded", options=options
    )
    return rows, start[1] * float(np.exp(column.x))


_TOLERANCE = 0.05
"""Tolerance of a search for a scale, relative to its reach."""


# ---- How many codes: by frames that are held out ----

_GAIN = 0.02
"""Part of the residual of held-out frames that more codes must explain."""


@dataclass(frozen=True)
class Choice:
    """Number of codes, and the explained part of held-out frames for each tried number, from one on."""

    terms: int
    held_out: tuple[float, ...] = ()


def choose_terms(exposures: Sequence[Exposure], shape: Shape, most: int) -> Choice:
    """Choose the number of codes, at most ``most``, by holding out half of the pictures, or of the frames."""
    groups = sorted({each.group for each in exposures})
    if len(groups) > 1:
        halves = [{group: index % 2 for index, group in enumerate(groups)}[each.group] for each in exposures]
    else:
        halves = [index % 2 for index in range(len(exposures))]
    folds = [[each for each, half in zip(exposures, halves, strict=True) if half == own] for own in (0, 1)]
    if not all(folds) or any({e.plane for e in folds[0]} != {e.plane for e in folds[1]} for _ in groups[1:]):
        return Choice(shape.terms)
    found: list[float] = []
    for terms in range(1, most + 1):
        tried = replace(shape, terms=terms)
        parts = [_held_out(folds[own], folds[1 - own], tried) for own in (0, 1)]
        found.append(float(np.mean(parts)))
        if len(found) > 1 and 1 - found[-1] > (1 - _GAIN) * (1 - found[-2]):
            return Choice(terms - 1, tuple(found))
    return Choice(most, tuple(found))


def _held_out(kept: Sequence[Exposure], left_out: Sequence[Exposure], shape: Shape) -> float:
    codes = fit_codes(kept, shape)
    gains = codes.gains
    for plane in {each.plane for each in left_out} - {*gains}:
        gains = gains | {plane: float(np.mean([*codes.gains.values()]))}
    return replace(codes, gains=gains).explains(left_out)


_COLOURS = {"red": 0, "green": 1, "blue": 2}
_PICTURE = Wanted("picture", colour=True)
_REFLECTANCE = "reflectance"
"""Channel of an image, or of a truth, in OpenEXR."""


class KnownFrames:
    """Frames, scenes and noise of a list of captures.

    Attributes
    ----------
    noises
        Noise variance of a number of each frame, NaN where the run does not state its sensor.
    saturated
        Names of runs with saturated readings.
    frames
        Number of shots.
    sums
        SHA-256 of pictures and of the runs' manifests.
    prepared
        Preparation of the files at import.
    places
        Offsets of the planes of a colour sensor [pixels of a plane].
    """

    def __init__(self, captures: KnownCaptures) -> None:
        self.exposures: list[Exposure] = []
        self.noises: list[float] = []
        self.saturated: list[str] = []
        self.frames = 0
        self.sums: dict[str, str] = {}
        self.prepared = preparation_of(next(iter(captures.manifests.values())), captures.path)
        self.places = plane_offsets(self.prepared)

    @classmethod
    def of(cls, captures: KnownCaptures, aged: Mapping[str, Factors] | None = None) -> KnownFrames:
        """Read all ``captures``, which must be of the camera of ``aged`` factors where these are given."""
        read = cls(captures)
        for number, capture in enumerate(captures.listed.known):
            picture = _picture(captures, capture)
            read.sums[capture.picture] = checksum(captures.picture(capture))
            for line in captures.manifests:
                if captures.lines is not None and line not in PLANES:
                    raise MitsimError(
                        f"list {captures.path}: {capture.run} has the line {line}, and lines of a projector see codes "
                        f"of their own; calibrate each alone, by runs such as {capture.run}/{line}"
                    )
                light = _plane(captures, capture, picture, line)
                read._add(captures, number, line, light, None if aged is None else aged[line])
        return read

    def _add(self, captures: KnownCaptures, number: int, line: str, light: FloatArray, aged: Factors | None) -> None:
        capture = captures.listed.known[number]
        folder = captures.run(capture, line)
        shots = load_run(folder)
        self.sums[str(Path(capture.run) / line)] = checksum(folder / MANIFEST)
        left, right = shots.patterns
        if light.shape != (len(left), len(right)):
            raise MitsimError(
                f"picture {captures.picture(capture)}: is {light.shape[0]} x {light.shape[1]} pixels, but the run "
                f"{folder} has {len(left)} x {len(right)} scene pixels; give one of its size"
            )
        first = self.exposures[0].frame.shape if self.exposures else None
        if aged is not None:
            aged.check_fit(shots)
            first = len(aged.left), len(aged.right)
        digital, centre = shots.manifest.digital, captures.listed.centre if aged is None else aged.manifest.centre
        saturated = 0
        for each in shots.pattern_measurements(first):
            if not self.exposures:
                count = len(captures.listed.known) * len(captures.manifests) * left.shape[1] * right.shape[1]
                held = Cost(memory_bytes=_COPIES * float(each.frame.nbytes) * count)
                held.check(f"list {captures.path}: its frames", Limits())
            frame = centre_frame(each.frame) if centre else each.frame
            scene = light * np.multiply.outer(left[:, each.row], right[:, each.column])
            self.exposures.append(Exposure(scene, frame, number, line, self.places.get(line, (0.0, 0.0))))
            variance = float(np.mean(np.maximum(digital.variance(each.light, each.shots), 0.0)))
            self.noises.append(variance if digital.noise_is_stated else np.nan)
            self.frames += each.shots
            saturated += each.saturated
        if saturated:
            self.saturated.append(str(Path(capture.run) / line))

    def noise(self, number: int, misfit: FloatArray) -> float:
        """Return the stated noise variance of an exposure, or estimate it from second differences of the ``misfit``."""
        if np.isfinite(self.noises[number]):
            return self.noises[number]
        guess = float(np.mean(np.square(np.diff(np.diff(misfit, 2, 0), 2, 1)))) / _OF_DIFFERENCES**2
        return guess / _differences_of_turned(misfit.shape, self.prepared)

    def misfit(self, models: Iterable[tuple[FloatArray, float]]) -> tuple[float, float, float]:
        """Return explained part, rms part that neither models nor noise explain, and mean of misfit over noise.

        ``models`` are the frames of a model, each with the variance of its known errors. Both are centred before
        comparison.
        """
        excess = energy = total = 0.0
        ratios = []
        for number, (each, (model, error)) in enumerate(zip(self.exposures, models, strict=True)):
            misfit = centre_frame(each.frame - model)
            noise = self.noise(number, misfit) + error
            left_over = float(np.mean(np.square(misfit)))
            excess += left_over - noise
            total += left_over
            energy += float(np.mean(np.square(centre_frame(each.frame))))
            ratios.append(left_over / noise if noise > 0 else 1.0)
        return 1 - total / energy, float(np.sqrt(max(excess, 0.0) / energy)), float(np.mean(ratios))

    def warnings(self) -> Iterator[str]:
        """Return a warning if runs are saturated."""
        if self.saturated:
            yield (
                f"saturation: {len(self.saturated)} runs have readings at the full well or the ADC's end, first "
                f"{self.saturated[0]}, so their frames are not linear; expose for less"
            )


_OF_DIFFERENCES = 6
"""Variance of second differences of white noise over that of the noise."""


def _differences_of_turned(shape: tuple[int, ...], how: Preparation) -> float:
    """Return the noise that second differences show over the true noise, after turning by bilinear interpolation.

    A pixel that is r of one neighbour and 1 - r of the other has r^2 + (1 - r)^2 of the noise. Its second differences,
    as of (r, 1 - 3 r, 3 r - 2, 1 - r), have less.
    """
    angle, crop = np.radians(how.turn_deg), how.crop or Crop()
    pivot = (np.array(shape) - 1) / 2 if how.turn_about == "centre" else np.array([-crop.row, -crop.column])
    y, x = np.arange(shape[0])[:, None] - pivot[0], np.arange(shape[1]) - pivot[1]
    sources = np.cos(angle) * y + np.sin(angle) * x + pivot[0], np.cos(angle) * x - np.sin(angle) * y + pivot[1]
    kept, seen = np.ones(shape), np.ones(shape)
    for r in (source % 1 for source in sources):
        kept *= r**2 + (1 - r) ** 2
        seen *= (r**2 + (1 - 3 * r) ** 2 + (3 * r - 2) ** 2 + (1 - r) ** 2) / _OF_DIFFERENCES
    return float(seen.mean() / kept.mean())


def plane_offsets(how: Preparation) -> dict[str, tuple[float, float]]:
    """Return the offset of each plane of a mosaic in frames of a preparation ``how`` [pixels of a plane]."""
    cell = np.empty((2, 2), dtype=object)
    for name, place in planes_of(how.mosaic or BGGR).items():
        cell[place] = name
    turned = orient(cell, how.orientation) if isinstance(how.orientation, int) else cell
    return {str(turned[row, column]): (row / 2, column / 2) for row in (0, 1) for column in (0, 1)}


_COPIES = 4
"""Copies of all frames that are in memory at a time."""


def _picture(captures: KnownCaptures, capture: KnownCapture) -> FloatArray:
    path, gamma = captures.picture(capture), captures.listed.gamma
    if path.suffix.lower() == ".exr":
        channels = read_frame(path)[0]
        values = (
            finite_channel(channels, _REFLECTANCE, path) if _REFLECTANCE in channels else read_image(path, _PICTURE)
        )
    else:
        values = read_image(path, _PICTURE)
    if values.ndim == 3 and values.shape[2] != 3:
        raise MitsimError(f"picture {path}: has {values.shape[2]} channels; save it without transparency")
    light = np.asarray(values, dtype=np.float64) / (own_end(values) or 1.0)
    if gamma == 1:
        return light
    if light.min() < 0:
        raise MitsimError(f"picture {path}: has numbers below 0, which have no gamma; leave gamma out of the list")
    return np.asarray(light**gamma)


def _plane(captures: KnownCaptures, capture: KnownCapture, picture: FloatArray, line: str) -> FloatArray:
    if picture.ndim == 2:
        if capture.colour is not None:
            raise MitsimError(
                f"list {captures.path}: picture {capture.picture} is grey; leave colour {capture.colour!r} out"
            )
        return picture
    if line:
        return picture[:, :, "rgb".index(line[0])]
    if capture.colour is None:
        raise MitsimError(
            f"list {captures.path}: picture {capture.picture} is in colour; say which plane {capture.run} shows, "
            f"colour = {', '.join(map(repr, _COLOURS))}, or give a grey one"
        )
    return picture[:, :, _COLOURS[capture.colour]]

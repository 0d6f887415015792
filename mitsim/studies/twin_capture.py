"""A FlatCam's raw capture and its authors' image of it in; frame, noise and the mask's codes, learned or read, out.

What the camera's own program does before its solver is done here: a plane of the Bayer sensor is turned by 0.1 degrees,
cut, and loses the means of its rows and columns.

A mask close to a sensor casts the same shadow from every direction, shifted: Phi[u, i] = c(u + s i), with s the sensor
pixels that one scene pixel moves it by, and c the mask's code on a grid of sensor pixels, linear between them. That is
the mean over a pixel of a mask whose features are as large as pixels, so a code can be drawn. Given one side's code,
frames Y = Phi_L X Phi_R^T are linear in the other's, and the sides take turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import ndimage
from scipy.optimize import minimize_scalar

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.imagelist import Wanted
from mitsim.core.images import read_image
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import stream
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.solver import centre_columns, centre_frame

TURN_DEG = 0.1
"""How the mask is turned against the sensor: 0.00174 rad in the authors' program."""
CROP = slice(6, 506), slice(10, 630)
"""Rows and columns of the turned plane that their program keeps."""
SCALES = 0.475, 0.48
"""Sensor pixels of a plane that a scene pixel moves the mask's shadow by, along rows and columns: where the residual of
learned codes is least, to 0.003."""
FLIPPED = True, True
"""Whether the scene lies upside down, and mirrored, before that camera: frames that are held out then correlate by 0.87
and 0.80 with codes learned from the other capture; any other way by 0.81 and 0.68 at most."""
PLANES = {"b": ((0, 0), 2), "gb": ((0, 1), 1), "r": ((1, 1), 0)}
"""Planes that are compared: row and column in a cell of the Bayer sensor, and channel of the authors' images. The
second green one lies half a pixel beside the first and tells nothing else."""
_RIDGE = 1e-3
"""Of a code's normal equations, over their mean diagonal: at 1e-4 and 1e-2 a frame that is held out is explained as
well to 0.002."""
_TURNS = 4
"""Of both sides: what codes explain stands still to 1e-4 from the third on."""
_BLOCK = 48
"""Side of the blocks whose noise and mean are compared [pixels]: light varies by some per cent within."""
_SMOOTH = 31
"""Side of the square that gives a pixel's mean light [pixels], far more than the mask's features."""
_APART = 4
"""Scene pixels over the distance between those whose shadows are compared first: a quarter of the scene."""


# ---- Frames ----


@dataclass(frozen=True, eq=False)
class Measured:
    """One plane of a capture.

    Attributes
    ----------
    name
        of capture and plane.
    level
        (m, m') turned and cut plane [DN].
    variance
        (m, m') of its noise [DN^2], means off.
    frame
        (m, m') the plane without row and column means [DN].
    scene
        (n, n') authors' image of it, as the camera sees it, 0 to 1.
    gain, read_variance
        DN an electron, and noise without light [DN^2], of the raw plane.
    """

    name: str
    level: FloatArray
    variance: FloatArray
    frame: FloatArray
    scene: FloatArray
    gain: float
    read_variance: float

    @property
    def energy(self) -> float:
        """Sum of squares of the plane about its mean."""
        return float(np.square(self.level - self.level.mean()).sum())


def turn_plane(plane: FloatArray) -> FloatArray:
    """A ``plane``, or noise alone, turned and cut as the camera's own program does, between pixels linearly."""
    return np.asarray(ndimage.map_coordinates(plane, _places(plane.shape), order=1, mode="nearest"))


def _places(shape: tuple[int, ...]) -> FloatArray:
    """(2, m, m') rows and columns of a plane of that ``shape`` that a turned, cut plane shows."""
    angle, middle = np.radians(TURN_DEG), (np.array(shape) - 1) / 2
    row, column = (np.arange(side.start, side.stop) - at for side, at in zip(CROP, middle, strict=True))
    cosine, sine = np.cos(angle), np.sin(angle)
    rows = cosine * row[:, None] + sine * column[None, :]
    columns = -sine * row[:, None] + cosine * column[None, :]
    return np.stack([rows + middle[0], columns + middle[1]])


def read_plane(path: Path, plane: str) -> FloatArray:
    """(rows, columns) of a ``plane`` of the raw capture ``path``, in steps of its converter: files hold these times a
    power of two. MitsimError for a file that is none, or another size."""
    numbers = read_image(path, Wanted("capture"))
    if numbers.shape[0] // 2 < CROP[0].stop or numbers.shape[1] // 2 < CROP[1].stop:
        raise MitsimError(
            f"capture {path}: is {numbers.shape[0]} x {numbers.shape[1]}; give the raw frame, 1024 x 1280"
        )
    (row, column), _ = PLANES[plane]
    common = max(int(np.gcd.reduce(numbers.astype(np.int64).ravel())), 1)
    return np.asarray(numbers[row::2, column::2] / common, dtype=np.float64)


def read_scene(path: Path, plane: str) -> FloatArray:
    """(n, n') authors' image in the file ``path`` of what a ``plane`` shows, as the camera sees it."""
    image = read_image(path, Wanted("image", colour=True))
    if image.ndim != 3:
        raise MitsimError(f"image {path}: has no colours; give the authors' image, of red, green and blue")
    values = np.asarray(image[..., PLANES[plane][1]] / 255, dtype=np.float64)
    return values[:: -1 if FLIPPED[0] else 1, :: -1 if FLIPPED[1] else 1].copy()


def measure_plane(name: str, raw: FloatArray, gain: float, read_variance: float, scene: FloatArray) -> Measured:
    """A raw plane, turned and cut, with its noise.

    Parameters
    ----------
    name
        of capture and plane.
    raw
        (rows, columns) of it [DN].
    gain, read_variance
        of its noise, as :func:`noise_of`.
    scene
        (n, n') what it is of.
    """
    places = _places(raw.shape)
    rows, columns = places - np.floor(places)
    kept = (rows**2 + (1 - rows) ** 2) * (columns**2 + (1 - columns) ** 2)  # of white noise between pixels
    level = turn_plane(raw)
    light = np.maximum(ndimage.uniform_filter(level, _SMOOTH), 0)
    left = (1 - 1 / level.shape[0]) * (1 - 1 / level.shape[1])  # of it without means
    variance = kept * (gain * light + read_variance) * left
    return Measured(name, level, variance, centre_frame(level), scene, gain, read_variance)


def noise_of(planes: Sequence[FloatArray]) -> tuple[float, float]:
    """Gain [DN an electron] and variance without light [DN^2], from the ``planes`` of several captures themselves.

    Second differences along both axes leave nothing of the light: between the two green planes of a capture, which see
    it half a pixel apart, they correlate by less than 0.01. Their mean squares in blocks are a line over the means.
    """
    means, squares = [], []
    for plane in planes:
        second = np.array([1.0, -2.0, 1.0]) / np.sqrt(6)
        fine = ndimage.convolve1d(ndimage.convolve1d(plane, second, axis=0), second, axis=1)
        for row in range(1, plane.shape[0] - _BLOCK, _BLOCK):
            for column in range(1, plane.shape[1] - _BLOCK, _BLOCK):
                block = np.s_[row : row + _BLOCK, column : column + _BLOCK]
                means.append(plane[block].mean())
                squares.append(np.square(fine[block]).mean())
    light, variance = np.array(means), np.array(squares)
    gain, dark = np.polyfit(light, variance, 1)
    if dark < 0 or gain <= 0:  # no dark light is seen: all noise is that of photons
        gain, dark = float(light @ variance / (light @ light)), 0.0
    return float(gain), float(dark)


# ---- Codes ----


@dataclass(frozen=True, eq=False)
class Code:
    """One side of a camera.

    Attributes
    ----------
    values
        (T,) the mask along that side, a value a sensor pixel; its mean is not known.
    scale
        s.
    scene
        pixels of the scene.
    """

    values: FloatArray
    scale: float
    scene: int

    @property
    def factor(self) -> FloatArray:
        """(m, n) of all sensor pixels that see the code from every scene pixel; columns without their means."""
        hats = _hats(self.scale, self.scene)
        return centre_columns(sliding_window_view(self.values, hats.shape[1]) @ hats.T)


def _hats(scale: float, scene: int) -> FloatArray:
    """(n, w) what each scene pixel takes of the window of a code that one sensor pixel sees."""
    place = scale * np.arange(scene)
    first = np.floor(place).astype(int)
    found = np.zeros((scene, first[-1] + 2))
    found[np.arange(scene), first] = 1 - (place - first)
    found[np.arange(scene), first + 1] += place - first
    return found


def _fit_side(scale: float, lights: Sequence[FloatArray], frames: Sequence[FloatArray]) -> Code:
    """The code of rows in ``frames`` (m, k) each = Phi Z, Z of ``lights`` (n, k); least squares, each frame over its
    energy."""
    hats = _hats(scale, len(lights[0]))
    (scene, width), sensor = hats.shape, len(frames[0])
    weights = [1 / float(np.square(frame).sum()) for frame in frames]
    gram = np.sum([part * light @ light.T for part, light in zip(weights, lights, strict=True)], axis=0)
    product = (
        np.sum([p * frame @ light.T for p, frame, light in zip(weights, frames, lights, strict=True)], axis=0) @ hats
    )
    block = hats.T @ gram @ hats
    length = sensor + width - 1
    matrix, right, total = np.zeros((length, length)), np.zeros(length), np.zeros((scene, length))
    for row in range(sensor):
        window = slice(row, row + width)
        matrix[window, window] += block
        right[window] += product[row]
        total[:, window] += hats
    matrix -= total.T @ gram @ total / sensor  # frames have no column means
    matrix[np.diag_indices(length)] += _RIDGE * np.trace(matrix) / length
    return Code(np.linalg.solve(matrix, right), scale, scene)


@single_threaded_blas()
def learn_codes(
    planes: Sequence[Measured], scales: tuple[float, float] = SCALES, start: Code | None = None
) -> tuple[Code, Code]:
    """Codes of rows and columns, from frames of known scenes.

    Parameters
    ----------
    planes
        frames and scenes.
    scales
        s of rows and of columns.
    start
        code of columns to begin with; None: a random one, from which the sides come to the same.
    """
    scenes, frames = [each.scene for each in planes], [each.frame for each in planes]
    hats = _hats(scales[1], scenes[0].shape[1])
    draws = stream(0, "twin's codes").standard_normal(frames[0].shape[1] + hats.shape[1] - 1)
    right = start or Code(draws, scales[1], scenes[0].shape[1])
    for _ in range(_TURNS):
        across = right.factor
        left = _fit_side(scales[0], [scene @ across.T for scene in scenes], frames)
        along = left.factor
        right = _fit_side(scales[1], [scene.T @ along.T for scene in scenes], [frame.T for frame in frames])
    return left, right


@single_threaded_blas()
def read_code(factor: FloatArray) -> tuple[Code, bool, float]:
    """The code that a calibrated ``factor`` (m, n) is, seen through shifts; whether it is so for the scene in reverse
    order; and the part of the factor that is something else, in energy.

    MitsimError where no shift is seen: of a mask that does not reach beyond the view.
    """
    without = centre_columns(factor)
    step = factor.shape[1] // _APART
    spectra = np.fft.rfft(without, 2 * len(factor), axis=0)
    alike = np.fft.irfft((spectra[:, :-step].conj() * spectra[:, step:]).sum(axis=1))
    # c(u + s i): a step on in the scene the shadow lies s step earlier.
    peak = int(np.argmax(alike))
    shift = -(peak if peak < len(factor) else peak - 2 * len(factor)) / step
    if abs(shift) * step < 1:
        raise MitsimError("factor: its columns are not one shadow, shifted; a twin needs a mask that fills the view")
    straight = without if shift > 0 else without[:, ::-1]

    def fit(scale: float) -> tuple[Code, float]:
        code = _fit_side(scale, [np.eye(factor.shape[1])], [straight])
        return code, float(np.square(straight - code.factor).sum() / np.square(straight).sum())

    near = 1.0 / step  # a peak is found to a pixel
    found = minimize_scalar(lambda s: fit(s)[1], bounds=(abs(shift) - near, abs(shift) + near), method="bounded")
    code, rest = fit(float(found.x))
    return code, shift < 0, rest


def codes_of(factors: Factors) -> tuple[Code, Code, tuple[bool, bool], float]:
    """Codes of rows and columns in a calibration's ``factors``, whether each is for the scene in reverse order, and the
    larger part that is no code."""
    (left, up, beside), (right, mirrored, along) = (read_code(each) for each in (factors.left, factors.right))
    return left, right, (up, mirrored), max(beside, along)

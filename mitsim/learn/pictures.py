"""Square pictures of eight bits for a sheet, drawn from a seed or cut from a folder of files.

Drawn pictures have the statistics of natural ones: leaves that hide each other (the dead leaves of Matheron, 1968),
whose sizes follow a power law, with soft edges, shades and a texture of 1/f amplitude; some have lines of letters, and
some stripes. A picture depends on the seed and its number alone. None is a photograph.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.files import check_plain
from mitsim.core.prepare import read_reflectance
from mitsim.core.seeds import stream
from mitsim.learn.pair_request import picture_files

Codes = npt.NDArray[np.uint8]
WHITE = 255
_OVER = 2
"""Points per pixel and axis that a picture is drawn on; four show no difference, because edges are soft."""
_RADII = 0.015, 0.35
"""Smallest and largest leaf over the side: two pixels of 128, and a third of the picture."""
_POWERS = 1.6, 3.2
"""Power by which the number of leaves falls with their radius, drawn for each picture; natural pictures have about 3
(Lee, Mumford and Huang, 2001), portraits and pictures of things have fewer small leaves."""
_COVERED = 2.5
_MOST_LEAVES = 600
_SOFT = 0.3, 2.5
"""Width of an edge in pixels, from sharp to out of focus, because a network learned nothing from hard ones."""
_SHADE, _TEXTURE = 0.25, 0.12
_DARKEST, _BRIGHTEST = (0.03, 0.15), (0.55, 0.95)
_LETTERS, _STRIPES = 0.2, 0.15
_TAILS = 0.002
_SMALLEST_CROP = 0.5


@dataclass(frozen=True)
class DrawnPictures:
    """Pictures drawn from a seed."""

    seed: int
    photographs: ClassVar[tuple[int, ...]] = ()
    source: ClassVar[str] = "drawn by code: dead leaves with soft edges, shades and 1/f texture, letters, stripes"

    def draw(self, number: int, n: int) -> Codes:
        rng = stream(self.seed, "picture", number)
        side = _OVER * n
        texture = pink_noise(side, rng)
        canvas = _ground(side, rng)
        _lay_leaves(canvas, texture, rng)
        kind = rng.random()
        if kind < _LETTERS:
            _lay_letters(canvas, rng)
        elif kind < _LETTERS + _STRIPES:
            _lay_stripes(canvas, rng)
        small = canvas.reshape(n, _OVER, n, _OVER).mean(axis=(1, 3))
        low, high = np.quantile(small, (_TAILS, 1 - _TAILS))
        dark, bright = rng.uniform(*_DARKEST), rng.uniform(*_BRIGHTEST)
        scaled = np.clip((small - low) / max(high - low, 1e-6), 0.0, 1.0)
        return _codes(dark + (bright - dark) * scaled)


def pink_noise(side: int, rng: np.random.Generator) -> FloatArray:
    """Draw periodic noise (side, side) of mean 0 and rms 1 whose amplitude falls as one over the frequency."""
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None])
    frequency[0, 0] = np.inf
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((side, side))) / frequency, (side, side))
    return np.asarray(noise / noise.std())


def _ground(side: int, rng: np.random.Generator) -> FloatArray:
    line = np.linspace(-0.5, 0.5, side)
    slopes = rng.uniform(-0.4, 0.4, 2)
    return np.asarray(rng.uniform(0.3, 0.7) + slopes[0] * line[:, None] + slopes[1] * line[None])


def _lay_leaves(canvas: FloatArray, texture: FloatArray, rng: np.random.Generator) -> None:
    side = len(canvas)
    power, roughness = rng.uniform(*_POWERS), rng.uniform(0.0, _TEXTURE)
    soft = _OVER * math.exp(rng.uniform(math.log(_SOFT[0]), math.log(_SOFT[1])))
    radii = _radii(power, rng) * side
    for radius in radii:
        middle = rng.uniform(0, side, 2)
        shape, turn = rng.uniform(0.4, 1.0), rng.uniform(0, math.pi)
        boxed = rng.random() < 0.35  # rectangles; the others are ellipses
        grey, slopes = rng.random(), rng.uniform(-_SHADE, _SHADE, 2) / (2 * radius)
        reach = radius * (math.sqrt(2) if boxed else 1.0) + soft
        (top, bottom), (left, right) = (
            (max(0, math.floor(at - reach)), min(side, math.ceil(at + reach))) for at in middle
        )
        if top >= bottom or left >= right:
            continue
        down, across = np.arange(top, bottom)[:, None] - middle[0], np.arange(left, right)[None] - middle[1]
        along = (math.cos(turn) * down + math.sin(turn) * across) / radius
        beside = (math.cos(turn) * across - math.sin(turn) * down) / (radius * shape)
        size = np.maximum(abs(along), abs(beside)) if boxed else np.hypot(along, beside)
        cover = np.clip(0.5 + (1 - size) * radius * shape / soft, 0.0, 1.0)
        patch = np.roll(texture, tuple(rng.integers(0, side, 2)), (0, 1))[: bottom - top, : right - left]
        leaf = grey + slopes[0] * down + slopes[1] * across + roughness * patch
        canvas[top:bottom, left:right] += cover * (leaf - canvas[top:bottom, left:right])


def _radii(power: float, rng: np.random.Generator) -> FloatArray:
    low, high = (limit ** (1 - power) for limit in _RADII)
    radii = (low + (high - low) * rng.random(_MOST_LEAVES)) ** (1 / (1 - power))
    covered = np.cumsum(math.pi * np.square(radii))
    return np.asarray(radii[: int(np.searchsorted(covered, _COVERED)) + 1])


def _lay_letters(canvas: FloatArray, rng: np.random.Generator) -> None:
    from PIL import Image, ImageDraw, ImageFont  # here: most pictures need none

    side = len(canvas)
    size = int(side * rng.uniform(0.05, 0.14))
    page = Image.new("L", (side, side))
    pen, font = ImageDraw.Draw(page), ImageFont.load_default(max(size, 6))
    first, last = sorted(rng.uniform(0, side, 2))
    for top in range(int(first), int(max(last, first + 1.5 * size)), max(int(1.3 * size), 1)):
        words = "".join(chr(code) for code in rng.choice([32, 32, *range(65, 91), *range(97, 123)], 60))
        pen.text((int(rng.uniform(-size, size)), top), words, fill=WHITE, font=font)
    cover = np.asarray(page, dtype=np.float64) / WHITE
    canvas += cover * (rng.choice([0.02, 0.98]) - canvas)


def _lay_stripes(canvas: FloatArray, rng: np.random.Generator) -> None:
    side = len(canvas)
    top, left = (int(at) for at in rng.uniform(0, 0.5 * side, 2))
    box = canvas[top : top + int(rng.uniform(0.2, 0.5) * side), left : left + int(rng.uniform(0.2, 0.5) * side)]
    width, turn = side * math.exp(rng.uniform(math.log(0.02), math.log(0.15))), rng.uniform(0, math.pi)
    down, across = np.arange(box.shape[0])[:, None], np.arange(box.shape[1])[None]
    phase = (math.cos(turn) * down + math.sin(turn) * across) / width
    wave = np.clip(0.5 + np.sin(2 * math.pi * phase) * width / math.pi, 0.0, 1.0)
    dark, bright = sorted(rng.random(2))
    box[...] = dark + (bright - dark) * wave


def _codes(reflectance: FloatArray) -> Codes:
    return np.rint(WHITE * reflectance).astype(np.uint8)


@dataclass(frozen=True)
class FolderPictures:
    """Grey pictures of the files in a folder, in the order of their names.

    The first pictures are the middle squares of the files; further ones are squares drawn from them, turned and
    mirrored.
    """

    folder: Path
    seed: int

    @cached_property
    def files(self) -> tuple[Path, ...]:
        return picture_files(self.folder)

    @cached_property
    def source(self) -> str:
        """Number, folder and digest of the files, which a store states."""
        digest = hashlib.sha256()
        for path in self.files:
            digest.update(f"{path.name} {check_plain(path, 'picture').st_size}\n".encode())
        return f"{len(self.files)} files of {self.folder}, names and sizes {digest.hexdigest()[:16]}"

    @cached_property
    def photographs(self) -> tuple[int, ...]:
        """Number of the first file that holds the same bytes as each file."""
        digests = [hashlib.sha256(path.read_bytes()).digest() for path in self.files]
        return tuple(map(digests.index, digests))

    def draw(self, number: int, n: int) -> Codes:
        """Cut a picture of n pixels along each axis; raise MitsimError for a file that is unreadable or smaller."""
        path = self.files[number % len(self.files)]
        grey = read_reflectance(path)
        whole = min(grey.shape)
        if whole < n:
            raise MitsimError(f"picture {path}: has {whole} pixels on its shorter side, and {n} are shown; give larger")
        if number < len(self.files):
            side, places, turns, mirrored = whole, [(size - whole) // 2 for size in grey.shape], 0, False
        else:
            rng = stream(self.seed, "crop", number)
            side = int(rng.uniform(max(n, _SMALLEST_CROP * whole), whole))
            places = [int(rng.integers(0, size - side + 1)) for size in grey.shape]
            turns, mirrored = int(rng.integers(4)), bool(rng.integers(2))
        square = np.rot90(grey[places[0] : places[0] + side, places[1] : places[1] + side], turns)
        return _codes(_shrink(square[:, ::-1] if mirrored else square, n))


def _shrink(square: FloatArray, n: int) -> FloatArray:
    size = len(square)
    edges = np.linspace(0, size, n + 1)
    below = np.clip(np.arange(size + 1)[None] - edges[:-1, None], 0, size / n)
    weights = np.diff(below, axis=1) * n / size
    return np.asarray(weights @ square @ weights.T)

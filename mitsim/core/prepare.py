"""Frames from the numbers of files: common factor, dark signal, response, plane of a mosaic, orientation and crop.

Saturated pixels, and pixels interpolated from them, get the saturation level that :attr:`Preparer.digital` states.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.files import MOST_SIDE, check_plain
from mitsim.core.imagelist import BGGR, JPEG, PRINTS, Preparation, Wanted, image_files, planes_of
from mitsim.core.images import Numbers, orient, own_end, read_image, read_images
from mitsim.core.manifests import Digital

LEAST_RESPONSE = 0.1
"""Pixels with a smaller response, relative to the mean, are not corrected, because that would multiply their noise by
ten."""
_EDGE = 1e-9
"""Pixels by which rounding of sine and cosine may exceed the picture."""


@dataclass(frozen=True, eq=False)
class Preparer:
    """Steps that make frames of files' numbers.

    Attributes
    ----------
    end
        Saturation of the files' numbers, or None.
    dark
        (rows, columns) mean number without light; None: as ``digital`` states.
    response
        (rows, columns) relative to the mean pixel; None: uniform.
    unlit
        Number of pixels with a response below :data:`LEAST_RESPONSE`, which are not corrected.
    """

    how: Preparation
    digital: Digital
    end: float | None = None
    dark: FloatArray | None = None
    response: FloatArray | None = None
    unlit: int = 0

    @classmethod
    def of(
        cls, how: Preparation, digital: Digital, wanted: Wanted, base: Path = Path(), end: float | None = None
    ) -> Preparer:
        """Return a preparer with the dark and flat frames of ``how``, whose paths begin at ``base``.

        MitsimError for dark or flat frames that cannot be read, differ in size, or have no light.
        """
        end = digital.saturation_dn if end is None else end
        plain, response, unlit = cls(how, digital, end), None, 0
        dark, under = (
            None if path is None else plain.mean(base / path, wanted) for path in (how.dark, how.flat_dark or how.dark)
        )
        if how.flat is not None:
            flat = plain.mean(base / how.flat, wanted)
            for name, other in (("dark", dark), ("flat_dark", under)):
                if other is not None and other.shape != flat.shape:
                    raise MitsimError(f"{base / how.flat}: is {_size(flat)}, but {name} {_size(other)}; give one size")
            light = flat - (plain.level if under is None else under)
            mean = plain.plane(light).mean()
            if not mean > 0:
                raise MitsimError(f"{base / how.flat}: has no more light than its dark frames; give a lit one")
            response = light / mean
            unlit = int((plain.plane(response) < LEAST_RESPONSE).sum())
            response[response < LEAST_RESPONSE] = 1.0
        if end is not None and (dark is not None or response is not None):
            top = (end - (plain.level if dark is None else dark)) / (1.0 if response is None else response)
            digital = digital.model_copy(update={"saturation_dn": float(np.max(top)) + plain.level})
        return cls(how, digital, end, dark, response, unlit)

    @property
    def level(self) -> float:
        """Return the stated digital number without light, which corrected frames have, too."""
        stated = self.digital
        return stated.black_level_dn + stated.dark_current_e_per_s * stated.exposure_s * stated.gain_dn_per_e

    @property
    def counts(self) -> bool:
        """Return True if frames hold the files' whole numbers."""
        return self.dark is None and self.response is None and not self.how.turn_deg

    def plane(self, values: Numbers) -> Numbers:
        if self.how.channel is None:
            return values
        row, column = planes_of(self.how.mosaic or BGGR)[self.how.channel]
        return values[row::2, column::2]

    def mean(self, source: Path, wanted: Wanted) -> FloatArray:
        """Return the mean of all frames in ``source``, divided by the common factor but otherwise as stored."""
        total, count = np.zeros(()), 0
        for path in image_files(source, wanted):
            for values in read_images(path, wanted):
                if count and values.shape != total.shape:
                    raise MitsimError(f"{path}: is {_size(values)}, but others are {_size(total)}; give one size")
                total, count = total + values / (self.how.divide_by or 1), count + 1
        return np.asarray(total / count, dtype=np.float64)

    def frame(self, path: Path, values: Numbers, mean: bool = False) -> Numbers:
        """Return the frame of a file's ``values``, in single precision if corrected or turned.

        ``mean`` marks means of frames, which need not be multiples of the factor. MitsimError for values that the
        factor does not divide, another size than the dark and flat frames', and a crop or turn that needs pixels beyond
        the picture.
        """
        factor = self.how.divide_by or 1
        if mean:
            values = values / factor
        elif factor > 1:
            if (values % factor).any():
                raise MitsimError(f"{path}: holds numbers that are no multiples of {factor}; correct divide_by")
            values = values // factor
        if self.counts:
            return np.ascontiguousarray(self._place(path, values))
        full = None if self.end is None else values >= self.end
        for name, other in (("dark", self.dark), ("flat", self.response)):
            if other is not None and other.shape != values.shape:
                raise MitsimError(f"{path}: is {_size(values)}, but {name} frames {_size(other)}; give one size")
        light = values.astype(np.float64)
        if self.dark is not None or self.response is not None:
            light -= self.level if self.dark is None else self.dark
            light /= 1.0 if self.response is None else self.response
            light += self.level
        light = self._place(path, light)
        if full is not None and full.any():
            light[self._place(path, full.astype(np.float64)) > 0] = self.digital.saturation_dn
        return light.astype(np.float32)

    def _place(self, path: Path, values: Numbers) -> Numbers:
        values = self.plane(values)
        values = values if self.how.orientation is None else orient(values, self.how.orientation)
        first, end, crop = (0, 0), values.shape, self.how.crop
        if crop is not None:
            rows, columns = values.shape
            first = crop.row, crop.column
            end = crop.row + (crop.rows or rows - crop.row), crop.column + (crop.columns or columns - crop.column)
            if not (crop.row < end[0] <= rows and crop.column < end[1] <= columns):
                kind = "its plane" if self.how.channel else "it"
                raise MitsimError(
                    f"{path}: {kind} is {_size(values)}, and crop takes rows {crop.row} to {end[0] - 1} and columns "
                    f"{crop.column} to {end[1] - 1}; correct the crop"
                )
        if self.how.turn_deg:
            from scipy.ndimage import affine_transform  # here: most frames are not turned

            angle = math.radians(self.how.turn_deg)
            cosine, sine = math.cos(angle), math.sin(angle)
            matrix, last = np.array([[cosine, sine], [-sine, cosine]]), np.array(values.shape) - 1
            pivot = last / 2 if self.how.turn_about == "centre" else np.zeros(2)
            offset = pivot - matrix @ pivot
            corners = np.array([[row, column] for row in (first[0], end[0] - 1) for column in (first[1], end[1] - 1)])
            seen = corners @ matrix.T + offset
            if (seen < -_EDGE).any() or (seen > last + _EDGE).any():
                raise MitsimError(
                    f"{path}: turned by {self.how.turn_deg:g} degrees about its {self.how.turn_about}, a part of it "
                    f"lies beyond its {_size(values)} pixels; give a smaller crop"
                )
            values = affine_transform(values, matrix, offset, order=1, mode="nearest")
        return values[first[0] : end[0], first[1] : end[1]]


@dataclass
class CommonFactor:
    """Largest whole number that divides all numbers of some files (0 for zeros alone), and the highest number."""

    factor: int = 0
    high: float = 0.0
    _bits: int = 0

    def add(self, values: Numbers) -> None:
        self.high, self._bits = max(self.high, float(values.max())), 8 * values.dtype.itemsize
        if values.dtype.kind not in "ui" and not np.array_equal(values, np.rint(values)):
            self.factor = 1
        for row in values:  # of noisy numbers the first row tells
            if self.factor == 1:
                break
            self.factor = int(np.gcd.reduce(np.append(row.astype(np.int64), self.factor)))

    def choose(self, end: float | None) -> int:
        """Return the factor by which numbers beyond the camera's ``end`` were scaled, or 1.

        Bits that were shifted to the high ones are likelier than a larger factor, which few numbers share by chance.
        """
        if end is None or self.high <= end:
            return 1
        shift = 1 << max(self._bits - int(end).bit_length(), 0)
        likely = shift if shift > 1 and self.factor % shift == 0 else max(self.factor, 1)
        return likely if self.high / likely <= end else 1


def _size(values: npt.NDArray[np.generic]) -> str:
    return "x".join(map(str, values.shape))


# -------- Pictures to be printed

_MOST_SIDE = 4096
"""Four prints of that many texels a side fill a scene's limit (:data:`mitsim.scene.headers.MOST_TEXELS`)."""


def read_reflectance(path: Path) -> FloatArray:
    """Return a picture's reflectances, (rows, columns) in 0 to 1, without a gamma curve.

    Whole numbers of 8 or 16 bits are divided by 255 or 65 535; other numbers are reflectances as they are. Colours are
    averaged. MitsimError for a file that cannot be read, transparent pixels, and numbers outside 0 to 1.
    """
    suffix = path.suffix.lower()
    if suffix not in PRINTS:
        raise MitsimError(f"picture {path}: ends in {suffix or 'nothing'}; read are {', '.join(PRINTS)}")
    if suffix in JPEG:
        from PIL import Image, ImageOps

        check_plain(path, "picture")
        try:
            with Image.open(path, formats=("JPEG",)) as picture:
                if max(picture.size) > MOST_SIDE:
                    raise MitsimError(f"picture {path}: {picture.size} pixels; at most {MOST_SIDE} a side are read")
                values = np.asarray(ImageOps.exif_transpose(picture).convert("RGB"))
        except (OSError, ValueError, Image.DecompressionBombError) as error:
            raise MitsimError(f"picture {path}: cannot be read as a JPEG ({error}); write it again") from error
    else:
        values = read_image(path, Wanted("picture", colour=True))
    grey = np.asarray(values, dtype=np.float64) / (own_end(values) or 1.0)
    if grey.ndim == 3:
        if (grey[..., 3:] < 1).any():
            raise MitsimError(f"picture {path}: has transparent pixels; lay it on a ground, and save it without")
        grey = grey[..., :3].mean(axis=2)
    if not (np.isfinite(grey).all() and grey.min() >= 0 and grey.max() <= 1):
        raise MitsimError(f"picture {path}: its numbers reach from {grey.min():g} to {grey.max():g}; give 0 to 1")
    return np.asarray(grey)


def fit_square(reflectance: FloatArray) -> FloatArray:
    """Centre a picture in a black square; above 4096 pixels a side, means over equal blocks reduce it first."""
    block = -(-max(reflectance.shape) // _MOST_SIDE)
    if block > 1:
        for axis, size in enumerate(reflectance.shape):
            starts = np.arange(0, size, block)
            counts = np.diff(np.append(starts, size))
            sums = np.add.reduceat(reflectance, starts, axis=axis)
            reflectance = sums / (counts[:, None] if axis == 0 else counts)
    side = max(reflectance.shape)
    before = [(side - own) // 2 for own in reflectance.shape]
    return np.pad(reflectance, [(gap, side - own - gap) for gap, own in zip(before, reflectance.shape, strict=True)])

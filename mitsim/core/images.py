"""Numbers of pictures (PNG, TIFF, NPY, OpenEXR and bare numbers), and PNG and HTML for people.

Nothing is scaled, inverted, turned or converted to grey; a file whose numbers the library would change is refused.
Files are never mapped, because a mapped file that is cut short ends the process.
"""

from __future__ import annotations

import base64
import html
import io
import logging
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray, npy_header
from mitsim.core.errors import MitsimError, reason_of
from mitsim.core.files import FRAME_LIMITS, MOST_SIDE, check_plain, fits_a_frame, whole_file
from mitsim.core.job import Cost, Limits
from mitsim.core.manifests import Digital
from mitsim.core.picture_files import (
    BARE,
    BGGR,
    FORMATS,
    FRAME,
    JPEG,
    PIXEL_FORMATS,
    PRINTS,
    PixelFormat,
    Preparation,
    Wanted,
    image_files,
    planes_of,
)

# -------- Pictures of other programs

Numbers = npt.NDArray[Any]
"""(rows, columns) whole or real numbers of a picture, or (rows, columns, 3 or 4) in colour."""
_PNG_BITS = {"1": 1, "L;2": 2, "L;4": 4, "L": 8, "I;16B": 16}
"""Bits of a grey PNG by Pillow's mode."""
_COLOURS_A_PIXEL = 3, 4
_COLOURS = "RGB", "RGBA", "RGB;16B", "RGBA;16B"
_ORIENTATION = 274
"""Tag of TIFF and Exif."""
_NO_PAGE = 0b101
"""Bits of TIFF's NewSubfileType: reduced picture, transparency mask."""
_TILE_MARGIN = 1024
"""Readers allocate whole tiles, so a tile may not exceed its picture by more pixels; usual tiles have 64 to 512."""
_UPRIGHT = 1
_TURNS = {1: (0, False), 2: (0, True), 3: (2, False), 4: (2, True), 5: (-1, True), 6: (-1, False), 7: (1, True)}
_TURNS[8] = (1, False)
"""Counter-clockwise quarter turns, and whether left and right are swapped afterwards (TIFF 6.0, tag 274)."""
ORIENTATIONS = {
    "upright": 1, "mirrored": 2, "upside down": 4, "turned": 3, "transposed": 5,
    "transposed, mirrored": 6, "transposed, upside down": 8, "transposed, turned": 7,
}  # fmt: skip
"""Orientations of TIFF 6.0 and Exif by the words of lists and messages."""
_MOST_PAGES = 1 << 16
_PIXEL_BYTES = 24
"""Memory of a pixel while a page is read and checked; measured: at most 21, for a PNG of 16 bits."""
_TWINS: dict[PixelFormat, PixelFormat] = {"Mono12p": "Mono12Packed", "Mono12Packed": "Mono12p"}
"""Packed formats that differ in the order of bits alone."""
_FEW = 64
"""Numbers that may have two zero bits in common by chance."""
_SMOOTHER = 4.0
"""Factor by which another packed format makes neighbours more alike before the stated one is refused."""
_BLACK_IS_ZERO, _RGB = 1, 2
"""PhotometricInterpretation of TIFF; 0 (refused) stores black as the largest number."""
_CHANNEL = "DN"


_Reader = Iterator[Any]
"""Yields the header's pages, size and memory per pixel, then the numbers of each page."""


def image_pages(path: Path | str, wanted: Wanted = FRAME) -> tuple[int, tuple[int, int]]:
    """Return pages, and rows and columns of the first page, from the header."""
    pages, (rows, columns, *_) = image_header(path, wanted)
    return pages, (rows, columns)


def image_header(path: Path | str, wanted: Wanted = FRAME) -> tuple[int, tuple[int, ...]]:
    """Return pages, and rows, columns and, in colour, numbers a pixel of the first page, from the header."""
    with _one_line_refusals(Path(path), wanted):
        (pages, size, _), _ = _read_header(Path(path), wanted)
        return pages, size


def read_image(path: Path | str, wanted: Wanted = FRAME) -> Numbers:
    """Return the numbers of a picture of one page; raises as :func:`read_images`, and for several pages."""
    pages, _ = image_pages(path, wanted)
    if pages != 1:
        raise wanted.refusal(Path(path), f"has {pages} pages; give each {wanted.what} a file of its own")
    return next(read_images(path, wanted))


def read_images(path: Path | str, wanted: Wanted = FRAME) -> Iterator[Numbers]:
    """Yield the numbers of every page as they are stored: no gamma, no scale.

    OpenEXR files need a channel `DN` or a single channel; NPY files may have an axis of pages first. MitsimError for a
    file that is missing, damaged, animated, or not of the kind, size, colours or orientation ``wanted``; and for
    numbers that the library would change, that are not finite, or that do not fit into memory.
    """
    path = Path(path)
    with _one_line_refusals(path, wanted):
        (_, size, pixel_bytes), numbers = _read_header(path, wanted)
        Cost(memory_bytes=pixel_bytes * math.prod(size)).check(f"{wanted.what} {path}", Limits())
        for values in numbers:
            _check_size(path, wanted, values.shape[0], values.shape[1])
            bad = np.count_nonzero(~np.isfinite(values))
            if bad:
                raise wanted.refusal(path, f"{bad} values are not finite; write it again")
            yield values.astype(values.dtype.newbyteorder("="), copy=False)


def own_end(values: Numbers) -> float | None:
    """Return 255 or 65535 by the type of ``values``; None for types that cameras seldom fill."""
    return float(np.iinfo(values.dtype).max) if values.dtype.kind == "u" and values.dtype.itemsize < 4 else None


def _read_header(path: Path, wanted: Wanted) -> tuple[tuple[int, tuple[int, ...], float], Iterator[Numbers]]:
    check_plain(path, wanted.what)
    ending = path.suffix.lower()
    if ending not in _READERS:
        raise wanted.refusal(path, f"ends in {ending or 'nothing'}; read are {', '.join(_READERS)}")
    numbers = _READERS[ending](path, wanted)
    header = next(numbers)
    _check_size(path, wanted, *header[1][:2])
    return header, numbers


def _check_size(path: Path, wanted: Wanted, rows: int, columns: int) -> None:
    if not (0 < rows <= wanted.most and 0 < columns <= wanted.most):
        raise wanted.refusal(path, f"{rows} x {columns} pixels; 1 to {wanted.most} a side are allowed")
    if not fits_a_frame((rows, columns)):
        raise wanted.refusal(path, f"{rows} x {columns} pixels; {FRAME_LIMITS} are read; bin it, or cut out a part")


def _png(path: Path, wanted: Wanted) -> _Reader:
    from PIL.PngImagePlugin import PngImageFile  # not Image.open, for which the size that it states may be too large

    with open(path, "rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on metadata that is damaged; where pixels are, reading them raises
        try:
            picture = PngImageFile(file)
        except SyntaxError:
            raise ValueError("it does not begin as a PNG") from None
        if picture.custom_mimetype is not None:
            raise wanted.refusal(path, f"is an animated PNG of several; give each {wanted.what} a file of its own")
        stored = str(picture.tile[0][3]) if picture.tile else ""
        bits = _PNG_BITS.get(stored, 0)
        colours = (picture.mode,) if wanted.colour and stored in _COLOURS else ()
        if bits not in wanted.bits and not colours:
            known = (count for count in wanted.bits if count in _PNG_BITS.values())
            raise wanted.refusal(path, f"is no {_allowed_kinds('PNG', known, wanted)}")
        yield 1, (*picture.size[::-1], *map(len, colours)), _PIXEL_BYTES
        if "transparency" in picture.info:
            raise wanted.refusal(path, "names a number that is transparent; save it without transparency")
        # Some versions of Pillow give 16 bits of a PNG as 32.
        values = np.array(picture).astype(bool if bits == 1 else np.uint8 if bits <= 8 else np.uint16)
        if stored.endswith(";16B") and colours:
            # Pillow keeps the high byte of colours. As if the bytes were swapped, it gives the low one.
            file.seek(0)
            low = PngImageFile(file)
            low.tile = [(*low.tile[0][:3], f"{stored[:-1]}L")]  # type: ignore[list-item]
            values = values.astype(np.uint16) << 8 | np.array(low)
        _check_upright(path, picture.getexif().get(_ORIENTATION, _UPRIGHT), wanted)  # perhaps behind its pixels
        yield values


def _check_upright(path: Path, stated: Any, wanted: Wanted) -> None:
    if stated != _UPRIGHT:
        problem = f"has the orientation {stated}: viewers rotate or mirror it; save it without this entry"
        raise wanted.refusal(path, problem + ("" if wanted.colour else ", and turn frames by --orientation 2 to 8"))


def orient(values: Numbers, orientation: int) -> Numbers:
    """Turn ``values`` by an ``orientation`` of TIFF 6.0 and Exif, 1 to 8."""
    turns, mirrored = _TURNS[orientation]
    turned = np.rot90(values, turns)
    return turned[:, ::-1] if mirrored else turned


def _tiff(path: Path, wanted: Wanted) -> _Reader:
    import tifffile  # most work reads no picture of this kind

    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # what matters is raised

    def check(page: Any) -> None:
        bits, kind = page.bitspersample, page.photometric
        grey = kind == _BLACK_IS_ZERO and page.samplesperpixel == 1 and page.ndim == 2 and bits in wanted.bits
        colour = wanted.colour and kind == _RGB and page.ndim == 3 and page.planarconfig == 1 and bits in (8, 16, 32)
        if page.dtype is None or page.dtype.kind not in "buif" or not (grey or colour):
            raise wanted.refusal(path, f"is no {_allowed_kinds('TIFF', wanted.bits, wanted)}")
        if int(page.subfiletype) & _NO_PAGE or page.subifds:
            raise wanted.refusal(path, "holds previews, masks or parts beside the picture; save the picture alone")
        if page.is_tiled and max(page.tilewidth, page.tilelength) > max(page.shape[:2]) + _TILE_MARGIN:
            raise wanted.refusal(path, "is of tiles larger than the picture; save it in strips")
        _check_size(path, wanted, *page.shape[:2])
        _check_upright(path, page.tags[_ORIENTATION].value if _ORIENTATION in page.tags else _UPRIGHT, wanted)

    # Given a file and no name, tifffile cannot map it.
    with open(path, "rb") as file, tifffile.TiffFile(file) as tiff:
        pages = tiff.pages
        if not 0 < len(pages) <= _MOST_PAGES:
            raise wanted.refusal(path, f"has {len(pages)} pages; give 1 to {_MOST_PAGES}")
        check(pages[0])
        yield len(pages), pages[0].shape, _PIXEL_BYTES
        for page in pages:
            check(page)
            yield page.asarray()


def _npy(path: Path, wanted: Wanted) -> _Reader:
    with open(path, "rb") as file:
        shape, dtype = npy_header(file, path.stat().st_size)
        kinds, sides = "buif" if 1 in wanted.bits else "uif", shape[-2:]
        if len(shape) not in (2, 3) or dtype.kind not in kinds:
            payload = f"{dtype} of shape {shape}"
            raise wanted.refusal(path, f"holds {payload}; rows x columns of numbers are needed, or pages of them")
        colours = len(shape) == 3 and sides[1] in _COLOURS_A_PIXEL
        if colours and not wanted.colour:
            kind = f"{shape[0]} x {shape[1]} pixels of {shape[2]} numbers, as of red, green and blue"
            raise wanted.refusal(path, f"holds {kind}; {wanted.grey}")
        pages = shape[0] if len(shape) == 3 and not colours else 1
        yield pages, shape if colours else sides, pages * dtype.itemsize + _PIXEL_BYTES
        values = np.load(file, allow_pickle=False)
        yield from values if len(shape) == 3 and not colours else [values]


def _exr(path: Path, wanted: Wanted) -> _Reader:
    from mitsim.core.exr import read_frame, read_header  # most work reads no picture of this kind

    header = read_header(path)
    yield 1, (header.height, header.width), _PIXEL_BYTES
    channels = read_frame(path)[0]
    name = _CHANNEL if _CHANNEL in channels or len(channels) > 1 else next(iter(channels))
    if name not in channels:
        names = ", ".join(channels)
        raise wanted.refusal(path, f"its channels are {names}; {_CHANNEL}, or a single one, is needed")
    yield channels[name]


def _bare(path: Path, wanted: Wanted) -> _Reader:
    raw = wanted.raw
    if raw is None:
        raise wanted.refusal(path, "has no header; say how it is read by shape and bits, or by shape and pixel_format")
    form, count, size = raw.pixel_format, math.prod(raw.shape), path.stat().st_size
    bits, stored = PIXEL_FORMATS[form] if form else (raw.bits or 0, 8 * raw.kind.itemsize)
    needed = -(-count * stored // 8)
    if size != needed:
        numbers, name = (f"numbers in {form}", "pixel_format") if form else (f"numbers of {bits} bits", "bits")
        claimed = f"{size_of(raw.shape)} {numbers} take {needed}"
        raise wanted.refusal(path, f"has {size} bytes, but {claimed}; correct shape or {name}")
    yield 1, raw.shape, _PIXEL_BYTES
    stream = np.fromfile(path, raw.kind, needed // raw.kind.itemsize)
    values = _unpack(stream, form, count) if form else stream
    if form:
        _check_format(path, wanted, form, stream, values)
    elif (most := values.max()) >= 2**bits:
        raise wanted.refusal(path, f"has the number {most}, beyond {bits} bits; correct bits or byte_order")
    yield values.reshape(raw.shape)


def _unpack(stream: npt.NDArray[np.uint8], form: PixelFormat, count: int) -> Numbers:
    """Return ``count`` numbers from the bytes of a packed format of GenICam (PFNC 2.4 and GigE Vision 2.2).

    A format with p is a stream of bits, lowest bits first. A Packed one has two numbers in three bytes: the high eight
    bits of each, and between them the low bits, those of the first number from bit 0 and of the second from bit 4.
    """
    bits, stored = PIXEL_FORMATS[form]
    low, numbers, size = bits - 8, *((4, 5) if stored == 10 else (2, 3))
    group = np.zeros((-(-count // numbers), size), np.uint16)
    group.ravel()[: len(stream)] = stream
    values = np.empty((len(group), numbers), np.uint16)
    for k in range(numbers):
        if form.endswith("Packed"):
            values[:, k] = group[:, 2 * k] << low | group[:, 1] >> 4 * k & (1 << low) - 1
        else:
            values[:, k] = (group[:, k] | group[:, k + 1] << 8) >> low * k & (1 << bits) - 1
    return values.ravel()[:count]


def _check_format(path: Path, wanted: Wanted, form: PixelFormat, stream: Numbers, values: Numbers) -> None:
    """Refuse numbers in another packed format of the same length.

    Mono10Packed leaves four bits of three bytes zero, which are bits 2 and 3 of a number in Mono12Packed. Mono12p and
    Mono12Packed exchange parts of every second number, so that in the wrong one most neighbours differ by much.
    """

    def roughness(numbers: Numbers) -> float:
        return float(np.median(np.abs(np.diff(numbers.astype(np.int32))))) if len(numbers) > 1 else 0.0

    twin, bright = _TWINS.get(form), values[values > 0b1111]
    if form == "Mono10Packed" and (stream[1::3] & 0b11001100).any():
        likely = "Mono12Packed or Mono12p"
    elif form == "Mono12Packed" and len(bright) > _FEW and (bright & 0b11).any() and not (bright & 0b1100).any():
        likely = "Mono10Packed"
    elif twin and _SMOOTHER * roughness(_unpack(stream, twin, len(values))) < roughness(values):
        likely = twin
    else:
        return
    raise wanted.refusal(path, f"is probably in {likely}, not in {form}; correct pixel_format")


_READERS: dict[str, Callable[[Path, Wanted], _Reader]] = {
    **dict(zip(FORMATS, (_png, _tiff, _tiff, _npy, _exr), strict=True)),
    **dict.fromkeys(BARE, _bare),
}


def _allowed_kinds(kind: str, bits: Any, wanted: Wanted) -> str:
    *most, last = (str(count) for count in bits)
    colours = ", nor of red, green and blue of 8 or 16 bits, pixel by pixel" if wanted.colour else ""
    zero = " whose zero is black" if kind == "TIFF" else ""
    return f"grey {kind} of {', '.join(most)} or {last} bits{zero}{colours}; {wanted.grey}"


@contextmanager
def _one_line_refusals(path: Path, wanted: Wanted) -> Iterator[None]:
    try:
        yield
    except MitsimError:
        raise
    # Readers of damaged files raise whatever they stumble over.
    except Exception as error:
        raise wanted.refusal(
            path,
            f"cannot be read: damaged, or of another kind than its name says ({reason_of(error)}); "
            "write or copy it again, without compression",
        ) from error


# -------- Frames from the numbers of files
# Steps: common factor, dark signal, response, plane of a mosaic, orientation and crop. Saturated pixels, and pixels
# interpolated from them, get the saturation level that :attr:`Preparer.digital` states.

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
                    raise MitsimError(f"{base / how.flat}: {size_of(flat)}, but {name} {size_of(other)}; give one size")
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
        if values.ndim == 3:
            return values[..., "rgb".index(self.how.channel[0])]
        row, column = planes_of(self.how.mosaic or BGGR)[self.how.channel]
        return values[row::2, column::2]

    def mean(self, source: Path, wanted: Wanted) -> FloatArray:
        """Return the mean of all frames in ``source``, divided by the common factor but otherwise as stored."""
        total, count = np.zeros(()), 0
        for path in image_files(source, wanted):
            for values in read_images(path, wanted):
                if count and values.shape != total.shape:
                    raise MitsimError(f"{path}: is {size_of(values)}, but others are {size_of(total)}; give one size")
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
                raise MitsimError(f"{path}: is {size_of(values)}, but {name} frames {size_of(other)}; give one size")
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
                    f"{path}: {kind} is {size_of(values)}, and crop takes rows {crop.row} to {end[0] - 1} and columns "
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
                    f"lies beyond its {size_of(values)} pixels; give a smaller crop"
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


def size_of(values: npt.NDArray[np.generic] | Sequence[int]) -> str:
    """Return the sides of an array, or of a shape, as text."""
    return "x".join(map(str, getattr(values, "shape", values)))


def reduce_frame(frame: Numbers, reduce: int) -> Numbers:
    """Return the means of whole blocks of ``reduce`` x ``reduce`` pixels, in the type of ``frame``."""
    rows, columns = (size // reduce for size in frame.shape[-2:])
    whole = frame[..., : rows * reduce, : columns * reduce]
    blocks = whole.reshape(*frame.shape[:-2], rows, reduce, columns, reduce)
    return np.asarray(blocks.mean(axis=(-3, -1)), frame.dtype)


def write_numbers(path: Path, values: Numbers) -> None:
    """Write whole numbers of 8 or 16 bits to a PNG or TIFF file, or any numbers to an NPY file; whole or not at all."""
    from PIL import Image

    with whole_file(path) as part, part.open("wb") as file:
        if path.suffix.lower() == ".npy":
            np.save(file, values, allow_pickle=False)
        else:
            Image.fromarray(values).save(file, "PNG" if path.suffix.lower() == ".png" else "TIFF")


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
            raise MitsimError(f"picture {path}: has transparent pixels; save it with an opaque background")
        grey = grey[..., :3].mean(axis=2)
    if not (np.isfinite(grey).all() and grey.min() >= 0 and grey.max() <= 1):
        raise MitsimError(f"picture {path}: its numbers reach from {grey.min():g} to {grey.max():g}; give 0 to 1")
    return np.asarray(grey)


def fit_square(reflectance: FloatArray) -> FloatArray:
    """Centre a picture in a black square; above 4096 pixels a side, means over equal blocks reduce it first."""
    block = -(-max(reflectance.shape) // _MOST_SIDE)
    if block > 1:
        from PIL import Image

        reflectance = np.asarray(Image.fromarray(reflectance.astype(np.float32)).reduce(block), np.float64)
    side = max(reflectance.shape)
    before = [(side - own) // 2 for own in reflectance.shape]
    return np.pad(reflectance, [(gap, side - own - gap) for gap, own in zip(before, reflectance.shape, strict=True)])


# -------- Pictures for people

_LARGEST_INLINE = 128
"""Largest side of pictures in a notebook, which keeps them below 100 kB for each object."""
_SHORT_CELL = 20
"""Table cells of fewer letters are not broken into lines."""
_SHOWN_HEIGHT = 144
"""Height in a notebook [screen pixels]; four fit side by side."""


def png(values: npt.ArrayLike, largest: int | None = None, smallest: int = 1) -> bytes:
    """Encode reflectances, or linear sRGB, as :func:`grey_png` after :func:`lightness`."""
    return grey_png(lightness(values), largest, smallest)


def lightness(reflectance: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Clip to 0..1 and encode by the sRGB curve (IEC 61966-2-1)."""
    linear = np.clip(np.asarray(reflectance, dtype=np.float64), 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def linear_light(shade: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Invert :func:`lightness`."""
    encoded = np.clip(np.asarray(shade, dtype=np.float64), 0, 1)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def grey_png(values: npt.ArrayLike, largest: int | None = None, smallest: int = 1) -> bytes:
    """Encode (rows, columns) or (rows, columns, 3) values as a PNG, 0 black and 1 white.

    Pictures above ``largest`` pixels a side are reduced by means over blocks; below ``smallest``, values are repeated.
    """
    # Imported here: most work shows nothing.
    from PIL import Image

    shown = np.asarray(values, dtype=np.float64)
    copies = -(-smallest // max(shown.shape[:2]))
    levels = np.rint(255 * np.clip(shown.repeat(copies, axis=0).repeat(copies, axis=1), 0, 1))
    picture = Image.fromarray(levels.astype(np.uint8))
    if largest:
        picture = picture.reduce(max(1, -(-max(picture.size) // largest)))
    buffer = io.BytesIO()
    picture.save(buffer, format="png", optimize=True)
    return buffer.getvalue()


def from_above(module: str, name: str) -> Callable[..., Any]:
    """Return a function of a higher room that draws or labels results for a method; imported at its first call."""
    found: Callable[..., Any] = getattr(import_module(f"mitsim.{module}"), name)
    return found


def data_uri(picture: bytes, kind: str = "png") -> str:
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode('ascii')}"


def span(values: npt.ArrayLike, unit: str) -> str:
    ends = np.min(values), np.max(values)
    low, high = (f"{end:.0f}" if abs(end) >= 1000 else f"{end:.3g}" for end in ends)
    return f"{low} to {high} {unit}"


def normalise(values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    shown = np.asarray(values, dtype=np.float64)
    low, high = float(shown.min()), float(shown.max())
    return (shown - low) / (high - low) if high > low else np.zeros_like(shown)


def card(title: str, pictures: Mapping[str, npt.ArrayLike], facts: Iterable[str], rows: Any = ()) -> str:
    """Return an object's HTML for a notebook.

    ``pictures`` are values in 0..1 or linear sRGB by caption, ``rows`` a mapping that becomes a small table, and
    ``facts`` lines below it.
    """
    sources = {caption: data_uri(png(values, _LARGEST_INLINE)) for caption, values in pictures.items()}
    figures = "".join(
        '<figure style="display:inline-block;vertical-align:top;margin:4px 12px 4px 0">'
        f'<img style="height:{_SHOWN_HEIGHT}px;image-rendering:pixelated" src="{source}">'
        f'<figcaption style="font-size:85%;white-space:pre-line">{html.escape(caption)}</figcaption></figure>'
        for caption, source in sources.items()
    )
    small = "".join(_row((name, str(value)), "td") for name, value in dict(rows).items())
    return _with_title(title, f"<div>{figures}</div><table>{small}</table>", facts)


def table(
    title: str, headings: Sequence[str], rows: Iterable[Sequence[str]], facts: Iterable[str] = (), numbers: int = 0
) -> str:
    """Return a table's HTML for a notebook; the last ``numbers`` columns are aligned as numbers."""
    body = "".join(_row(row, "td", numbers) for row in rows)
    return _with_title(title, f"<table>{_row(headings, 'th', numbers)}{body}</table>", facts)


def _row(cells: Sequence[str], tag: str, numbers: int = 0) -> str:
    sides = ["left"] * (len(cells) - numbers) + ["right"] * numbers
    style = "padding:2px 10px 2px 0;vertical-align:top"
    whole = (";white-space:nowrap" if len(cell) < _SHORT_CELL else "" for cell in cells)
    each = zip(cells, sides, whole, strict=True)
    texts = (f'<{tag} style="{style};text-align:{side}{wrap}">{html.escape(cell)}' for cell, side, wrap in each)
    return f"<tr>{''.join(f'{text}</{tag}>' for text in texts)}</tr>"


def _with_title(title: str, body: str, facts: Iterable[str]) -> str:
    lines = "".join(f"<div>{html.escape(fact)}</div>" for fact in facts)
    return f"<div><b>{html.escape(title)}</b></div>{body}{lines}"

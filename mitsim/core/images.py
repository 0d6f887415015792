"""Numbers of pictures (PNG, TIFF, NPY, OpenEXR, DNG and bare numbers), and PNG and HTML for people.

Nothing is scaled, inverted or converted to grey, and a picture is turned only on request; a file whose numbers the
library would change is refused. Files are copied, not mapped, because a mapped file that is cut short ends the process.
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
from importlib import import_module
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, BinaryIO, Literal, cast

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import Npy
from mitsim.core.errors import MitsimError, cut, reason_of
from mitsim.core.files import FRAME_LIMITS, check_plain, fits_a_frame, stderr_silenced
from mitsim.core.imagelist import BARE, FORMATS, FRAME, TO_FILE, Wanted
from mitsim.core.job import Cost, Limits

if TYPE_CHECKING:
    from PIL.Image import Image

# -------- Pictures of other programs

Numbers = npt.NDArray[Any]
"""(rows, columns) whole or real numbers of a picture, or (rows, columns, 3 or 4) in colour."""
_PNG_BITS = {"1": 1, "L;2": 2, "L;4": 4, "L": 8, "I;16B": 16}
"""Bits of a grey PNG by Pillow's mode."""
_COLOURS_A_PIXEL = 3, 4
_COLOURS = "RGB", "RGBA"
_BITS, _COMPRESSION, _PHOTOMETRIC, _SAMPLES = 258, 259, 262, 339
"""TIFF 6.0: BitsPerSample, Compression, PhotometricInterpretation, SampleFormat."""
_BIG = 43
"""Version number of BigTIFF."""
_BEGINNINGS = b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"
"""Magic numbers of TIFF and BigTIFF."""
_DNG_VERSION = 50706
"""Tag in the first page of every DNG (Digital Negative Specification 1.4)."""
_PLAIN = 1
_LOSSY = (6, 7)
"""JPEG compressions of TIFF (TIFF 6.0, technical note 2)."""
_PAGE_KIND, _ORIENTATION, _TILES, _PARTS = 254, 274, (322, 323), 330
"""NewSubfileType, Orientation, TileWidth and TileLength, and SubIFDs of TIFF/EP, where raw files keep the picture."""
_NO_PAGE = 0b101
"""Bits of NewSubfileType: reduced picture, transparency mask."""
_TILE_MARGIN = 1024
"""Readers allocate whole tiles, so a tile may not exceed its picture by more pixels; usual tiles have 64 to 512."""
_UPRIGHT = 1
_TURNS = {1: (0, False), 2: (0, True), 3: (2, False), 4: (2, True), 5: (-1, True), 6: (-1, False), 7: (1, True)}
_TURNS[8] = (1, False)
"""Counter-clockwise quarter turns, and whether left and right are swapped afterwards (TIFF 6.0, tag 274)."""
_MOST_PAGES = 1 << 16
_MOST_ENTRIES = 512
_WIDTHS = {1: 1, 3: 2, 4: 4}
_PIXEL_BYTES = 24
"""Memory of a pixel while a page is read and checked; measured: at most 21, for a PNG of 16 bits."""
_BLACK_IS_ZERO, _RGB = 1, 2
"""PhotometricInterpretation; 0 (refused) stores black as the largest number."""
_FLIPS = {0: 1, 3: 3, 5: 8, 6: 6}
"""TIFF orientations by LibRaw's flip."""
_UNSIGNED = 1
"""Also the default without the tag."""
_CHANNEL = "DN"


_Reader = Iterator[Any]
"""Yields the header's pages, size and memory per pixel, then the numbers of each page."""


def image_pages(path: Path | str, wanted: Wanted = FRAME) -> tuple[int, tuple[int, int]]:
    """Return pages, and rows and columns of the first page, from the header."""
    with _one_line_refusals(Path(path), wanted):
        (pages, size, _), _ = _read_header(Path(path), wanted)
        return pages, size


def image_size(path: Path | str, wanted: Wanted = FRAME) -> tuple[int, int]:
    return image_pages(path, wanted)[1]


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


def _read_header(path: Path, wanted: Wanted) -> tuple[tuple[int, tuple[int, int], float], Iterator[Numbers]]:
    check_plain(path, wanted.what)
    ending = path.suffix.lower()
    if ending not in _READERS:
        raise wanted.refusal(path, f"ends in {ending or 'nothing'}; read are {', '.join(_READERS)}")
    numbers = _READERS[ending](path, wanted)
    header = next(numbers)
    _check_size(path, wanted, *header[1])
    return header, numbers


def _check_size(path: Path, wanted: Wanted, rows: int, columns: int) -> None:
    if not (0 < rows <= wanted.most and 0 < columns <= wanted.most):
        raise wanted.refusal(path, f"{rows} x {columns} pixels; 1 to {wanted.most} a side are allowed")
    if not fits_a_frame((rows, columns)):
        raise wanted.refusal(path, f"{rows} x {columns} pixels; {FRAME_LIMITS} are read; bin it, or cut out a part")


def _png(path: Path, wanted: Wanted) -> _Reader:
    from PIL.PngImagePlugin import PngImageFile

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with PngImageFile(path) as picture:  # not by Image.open, for which the size that it states may be too large
                stored, (columns, rows) = str(picture.tile[0][3]) if picture.tile else "", picture.size
                animated = picture.custom_mimetype is not None
        except SyntaxError:
            raise ValueError("it does not begin as a PNG") from None
    if animated:
        raise wanted.refusal(path, f"is an animated PNG of several; give each {wanted.what} a file of its own")
    bits = _PNG_BITS.get(stored, 0)
    if bits not in wanted.bits and not (wanted.colour and stored in _COLOURS):
        known = (count for count in wanted.bits if count in _PNG_BITS.values())
        raise wanted.refusal(path, f"is no {_allowed_kinds('PNG', known, wanted)}")
    yield 1, (rows, columns), _PIXEL_BYTES
    with _open_picture(path, "PNG") as picture:
        if "transparency" in picture.info:
            raise wanted.refusal(path, "names a number that is transparent; save it without transparency")
        # Some versions of Pillow give 16 bits of a PNG as 32.
        values = np.array(picture).astype(bool if bits == 1 else np.uint8 if bits <= 8 else np.uint16)
        stated = picture.getexif().get(_ORIENTATION, _UPRIGHT)  # which a PNG may say behind its pixels
        yield _upright(path, values, stated, wanted)


def _upright(path: Path, values: Numbers, stated: Any, wanted: Wanted) -> Numbers:
    """Turn a picture as ``wanted``; MitsimError if it states an orientation and no choice was made."""
    if wanted.orientation is None and stated != _UPRIGHT:
        raise wanted.refusal(
            path,
            f"has the orientation {stated}: it is to be shown turned or mirrored; save it as it is to be read"
            + ("" if wanted.colour else ", or give --orientation file to turn it so, or 1 to read it as it is stored"),
        )
    if wanted.orientation != TO_FILE:
        return values
    if stated not in _TURNS:
        raise wanted.refusal(path, f"has the orientation {stated}; there are 1 to 8, so give the one that is meant")
    return orient(values, stated)


def orient(values: Numbers, orientation: int) -> Numbers:
    """Turn ``values`` by an ``orientation`` of TIFF 6.0 and Exif, 1 to 8."""
    turns, mirrored = _TURNS[orientation]
    turned = np.rot90(values, turns)
    return turned[:, ::-1] if mirrored else turned


def _tiff(path: Path, wanted: Wanted) -> _Reader:
    pages, places = _pages_of(path)
    if not pages:
        raise wanted.refusal(path, "is no TIFF, or has no page; write it again")
    if pages > _MOST_PAGES:
        raise wanted.refusal(path, f"has over {_MOST_PAGES} pages; give fewer")
    with _open_picture(path, "TIFF", places=places) as picture:
        _check_tags(path, picture, wanted)
        size = picture.height, picture.width
        packed = picture.tag_v2.get(_COMPRESSION, _PLAIN) != _PLAIN  # type: ignore[attr-defined]
    first = places[0][0] if places.get(0) else _UPRIGHT
    if wanted.orientation is None:
        _upright(path, np.empty((0, 0)), first, wanted)
    if wanted.orientation == TO_FILE and abs(_TURNS.get(first, (0, False))[0]) == 1:
        size = size[::-1]
    held = path.stat().st_size / max(math.prod(size), 1) if packed or places else 0.0
    yield pages, size, held + _PIXEL_BYTES
    with _open_picture(path, "TIFF", packed, places) as picture:
        for page in range(pages):
            picture.seek(page)
            unsigned = _check_tags(path, picture, wanted)
            _check_size(path, wanted, picture.height, picture.width)
            with stderr_silenced():
                values = np.array(picture)
            # Pillow holds 32 bits as if they had a sign.
            values = values.view(np.uint32) if unsigned and values.dtype == np.int32 else values
            yield _upright(path, values, places[page][0] if page in places else _UPRIGHT, wanted)


def _pages_of(path: Path) -> tuple[int, dict[int, tuple[int, int, bytes]]]:
    """Return the number of pages of a TIFF, and value, offset and replacement of each orientation that is not upright.

    Pillow is given a copy in which all pages are upright, because it turns some pictures as it loads them, depending on
    compression and version.
    """
    found: dict[int, tuple[int, int, bytes]] = {}
    with open(path, "rb") as file:
        order: Literal["little", "big"] = "little" if file.read(2) == b"II" else "big"
        big = int.from_bytes(file.read(2), order) == _BIG
        file.seek(8 if big else 4)
        counted, entry, place = (8, 20, 8) if big else (2, 12, 4)
        following, pages = int.from_bytes(file.read(place), order), 0
        while following and pages <= _MOST_PAGES:
            file.seek(following)
            count = int.from_bytes(file.read(counted), order)
            entries = file.read(min(count, _MOST_ENTRIES) * entry)
            for start in range(0, len(entries) - entry + 1, entry):
                tag, kind = (int.from_bytes(entries[start + at : start + at + 2], order) for at in (0, 2))
                width = _WIDTHS.get(kind, 0) if tag == _ORIENTATION else 0
                value = int.from_bytes(entries[start + entry - place :][:width], order)
                if width and value != _UPRIGHT:
                    at = following + counted + start + entry - place
                    found[pages] = value, at, _UPRIGHT.to_bytes(width, order)
            file.seek(following + counted + count * entry)
            following, pages = int.from_bytes(file.read(place), order), pages + 1
    return pages, found


def _check_tags(path: Path, picture: Image, wanted: Wanted) -> bool:
    tags: Any = picture.tag_v2  # type: ignore[attr-defined]
    bits, photometric, samples = tags.get(_BITS, (1,)), tags.get(_PHOTOMETRIC), tags.get(_SAMPLES, (_UNSIGNED,))
    grey = photometric == _BLACK_IS_ZERO and len(bits) == 1 and bits[0] in wanted.bits
    if not grey and not (wanted.colour and photometric == _RGB and set(bits) == {8}):
        raise wanted.refusal(path, f"is no {_allowed_kinds('TIFF', wanted.bits, wanted)}")
    if grey and tags.get(_COMPRESSION, _PLAIN) in _LOSSY:
        raise wanted.refusal(path, "is compressed by JPEG, which changes numbers; save it without, or by deflate")
    if tags.get(_PAGE_KIND, 0) & _NO_PAGE or _PARTS in tags:
        raise wanted.refusal(path, "holds previews, masks or parts beside the picture; save the picture alone")
    if tags.get(_ORIENTATION, _UPRIGHT) != _UPRIGHT:
        raise wanted.refusal(path, "states an orientation in no usual way; save it upright")
    if any(tags.get(tag, 0) > max(picture.size) + _TILE_MARGIN for tag in _TILES):
        raise wanted.refusal(path, "is of tiles larger than the picture; save it in strips")
    return bool(samples[0] == _UNSIGNED)


def _npy(path: Path, wanted: Wanted) -> _Reader:
    with open(path, "rb") as file:
        array = Npy.of(file, path.stat().st_size)
    kinds, sides = "buif" if 1 in wanted.bits else "uif", array.shape[-2:]
    if len(array.shape) not in (2, 3) or array.dtype.kind not in kinds:
        payload = f"{array.dtype} of shape {array.shape}"
        raise wanted.refusal(path, f"holds {payload}; rows x columns of numbers are needed, or pages of them")
    if len(array.shape) == 3 and sides[1] in _COLOURS_A_PIXEL:
        rows, columns, colours = array.shape
        kind = f"{rows} x {columns} pixels of {colours} numbers, as of red, green and blue"
        raise wanted.refusal(path, f"holds {kind}; save one number a pixel, raw and not demosaiced")
    pages = range(array.shape[0]) if len(array.shape) == 3 else [None]
    # Columns first, a page is scattered over the whole file.
    at_once = array.bytes / max(math.prod(sides), 1) if array.fortran else float(array.dtype.itemsize)
    yield len(pages), (sides[0], sides[1]), at_once + _PIXEL_BYTES
    with open(path, "rb") as file:
        for page in pages:
            yield array.part(file, page)


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


def _dng(path: Path, wanted: Wanted) -> _Reader:
    try:
        import rawpy  # an extra: most benches write other files
    except ImportError:
        raise wanted.refusal(path, "rawpy is not installed; pip install 'mitsim[raw]', or save it as TIFF") from None

    with open(path, "rb") as file:
        order: Literal["little", "big"] = "little" if file.read(2) == b"II" else "big"
        file.seek(4)
        file.seek(int.from_bytes(file.read(4), order))
        entries = file.read(2 + 12 * _MOST_ENTRIES)
    if _DNG_VERSION.to_bytes(2, order) not in (entries[start : start + 2] for start in range(2, len(entries), 12)):
        raise ValueError("its header is none of a DNG")
    with stderr_silenced(), rawpy.imread(str(path)) as raw:
        sizes = raw.sizes
        colours = raw.color_desc.decode("ascii", "replace")
        corner = [(sizes.top_margin + row, sizes.left_margin + column) for row in (0, 1) for column in (0, 1)]
        mosaic = "".join(colours[raw.raw_color(*place)] for place in corner) if raw.num_colors > 1 else None
    if mosaic is not None and mosaic != (wanted.mosaic or mosaic):
        raise wanted.refusal(path, f"its mosaic is {cut(mosaic)}, and {wanted.mosaic} is stated; correct that")
    yield 1, (sizes.height, sizes.width), _PIXEL_BYTES
    with stderr_silenced(), rawpy.imread(str(path)) as raw:
        flat = raw.raw_type == rawpy.RawType.Flat
        values = raw.raw_image_visible.copy() if flat else np.empty(0)
    if values.ndim != 2:
        raise wanted.refusal(path, "holds colours, and no number a pixel; save the raw numbers")
    yield _upright(path, values, _FLIPS.get(sizes.flip, 0), wanted)


def _bare(path: Path, wanted: Wanted) -> _Reader:
    raw = wanted.raw
    if raw is None:
        raise wanted.refusal(path, "has no header; say how it is read by shape and bits")
    needed, size = math.prod(raw.shape) * raw.kind.itemsize, path.stat().st_size
    if size != needed:
        claimed = f"{raw.shape[0]}x{raw.shape[1]} numbers of {raw.bits} bits take {needed}"
        raise wanted.refusal(path, f"has {size} bytes, but {claimed}; correct shape or bits")
    yield 1, raw.shape, _PIXEL_BYTES
    values = np.fromfile(path, raw.kind, math.prod(raw.shape)).reshape(raw.shape)
    if (most := values.max()) >= 2**raw.bits:
        raise wanted.refusal(path, f"has the number {most}, beyond {raw.bits} bits; correct bits or byte_order")
    yield values


_READERS: dict[str, Callable[[Path, Wanted], _Reader]] = {
    **dict(zip(FORMATS, (_png, _tiff, _tiff, _npy, _exr, _dng), strict=True)),
    **dict.fromkeys(BARE, _bare),
}


def _allowed_kinds(kind: str, bits: Any, wanted: Wanted) -> str:
    *most, last = (str(count) for count in bits)
    colours = ", nor of red, green and blue of 8 bits" if wanted.colour else ""
    zero = " whose zero is black" if kind == "TIFF" else ""
    raw = "" if wanted.colour else ", raw and not demosaiced"
    return f"grey {kind} of {', '.join(most)} or {last} bits{zero}{colours}; save one number a pixel{raw}"


@contextmanager
def _open_picture(
    path: Path, kind: str, whole: bool = False, places: Mapping[int, tuple[int, int, bytes]] | None = None
) -> Iterator[Image]:
    """Open a picture file without reading its pixels.

    ``whole`` opens a copy in memory, because libtiff maps the file or reads all of it for each page.
    """
    from PIL import Image, UnidentifiedImageError  # most work reads no picture

    logs = logging.getLogger("PIL")
    if not logs.handlers:  # where nobody listens, Python writes errors in a log to stderr
        logs.addHandler(logging.NullHandler())
    with open(path, "rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on metadata that is damaged; where pixels are, reading them raises
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        source = io.BytesIO(file.read()) if whole or places else cast("IO[bytes]", _Copied(file))
        for _, place, upright in (places or {}).values():
            source.seek(place)
            source.write(upright)
        source.seek(0)
        try:
            opened = Image.open(source, formats=(kind,))
        except UnidentifiedImageError:
            file.seek(0)
            if file.read(4) not in _BEGINNINGS:
                raise ValueError(f"its header is none of a {kind}") from None
            unread = "such as real numbers of 16 or 64 bits, transparency, or a mosaic by its tags"
            raise MitsimError(
                f"file {path}: its pixels are of a kind that is not read, {unread}; save it anew"
            ) from None
        with opened as picture:
            yield picture


class _Copied:
    """File without name and descriptor, which Pillow can read but not map."""

    def __init__(self, file: BinaryIO) -> None:
        self.read, self.seek, self.tell = file.read, file.seek, file.tell


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
            "write or copy it again",
        ) from error


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


def card(title: str, pictures: Mapping[str, npt.ArrayLike], facts: Iterable[str]) -> str:
    """Return an object's HTML for a notebook; ``pictures`` are values in 0..1 or linear sRGB by caption."""
    sources = {caption: data_uri(png(values, _LARGEST_INLINE)) for caption, values in pictures.items()}
    figures = "".join(
        '<figure style="display:inline-block;vertical-align:top;margin:4px 12px 4px 0">'
        f'<img style="height:{_SHOWN_HEIGHT}px;image-rendering:pixelated" src="{source}">'
        f'<figcaption style="font-size:85%;white-space:pre-line">{html.escape(caption)}</figcaption></figure>'
        for caption, source in sources.items()
    )
    return _with_title(title, f"<div>{figures}</div>", facts)


def table(
    title: str, headings: Sequence[str], rows: Iterable[Sequence[str]], facts: Iterable[str] = (), numbers: int = 0
) -> str:
    """Return a table's HTML for a notebook; the last ``numbers`` columns are aligned as numbers."""

    def line(cells: Sequence[str], tag: str) -> str:
        sides = ["left"] * (len(cells) - numbers) + ["right"] * numbers
        style = "padding:2px 10px 2px 0;vertical-align:top"
        whole = (";white-space:nowrap" if len(cell) < _SHORT_CELL else "" for cell in cells)
        each = zip(cells, sides, whole, strict=True)
        texts = (f'<{tag} style="{style};text-align:{side}{wrap}">{html.escape(cell)}' for cell, side, wrap in each)
        return "".join(f"{text}</{tag}>" for text in texts)

    body = "".join(f"<tr>{line(row, 'td')}</tr>" for row in rows)
    return _with_title(title, f"<table><tr>{line(headings, 'th')}</tr>{body}</table>", facts)


def _with_title(title: str, body: str, facts: Iterable[str]) -> str:
    lines = "".join(f"<div>{html.escape(fact)}</div>" for fact in facts)
    return f"<div><b>{html.escape(title)}</b></div>{body}{lines}"

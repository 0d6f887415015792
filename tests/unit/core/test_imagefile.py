"""Pictures of other programs: numbers as they are stored, and a line for every file that is none.

What a file's reader may do to numbers (scale, invert, swap bytes) is tried on numbers that would show it.
"""

from __future__ import annotations

import io
import os
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image, PngImagePlugin

from mitsim.core.errors import MitsimError
from mitsim.core.exr import write_frame
from mitsim.core.images import (
    _one_line_refusals,
    _read_header,
    card,
    image_pages,
    normalise,
    own_end,
    png,
    read_image,
    read_images,
    span,
    table,
)
from mitsim.core.picture_files import Raw, Wanted, image_files

NUMBERS = (np.arange(35).reshape(5, 7) * 113).astype(np.uint16)
LARGE = np.arange(35, dtype=np.uint32).reshape(5, 7) * 120_000_000
Write = Callable[[Path], object]


def saved(values: np.ndarray, **options: object) -> Write:
    return lambda path: Image.fromarray(values).save(path, **options)


@pytest.mark.parametrize(
    ("name", "write", "expected"),
    [
        ("a.png", saved(NUMBERS), NUMBERS),
        ("a.PNG", saved((NUMBERS // 113).astype(np.uint8)), (NUMBERS // 113).astype(np.uint8)),
        ("a.tif", saved(NUMBERS), NUMBERS),
        ("a.tif", saved((NUMBERS // 113).astype(np.uint8)), (NUMBERS // 113).astype(np.uint8)),
        ("a.tiff", saved(NUMBERS, compression="packbits"), NUMBERS),
        ("a.tif", lambda path: tifffile.imwrite(path, NUMBERS, byteorder=">"), NUMBERS),
        ("a.tif", lambda path: tifffile.imwrite(path, NUMBERS, tile=(16, 16), compression="zlib"), NUMBERS),
        ("a.tif", saved(NUMBERS.astype(np.float32) / 7), NUMBERS.astype(np.float32) / 7),
        ("a.tif", saved(NUMBERS.astype(np.int32) * -1000), NUMBERS.astype(np.int32) * -1000),
        ("a.tif", lambda path: tifffile.imwrite(path, LARGE), LARGE),
        ("a.npy", lambda path: np.save(path, NUMBERS), NUMBERS),
        ("a.npy", lambda path: np.save(path, NUMBERS.astype(">u2")), NUMBERS),
        ("a.npy", lambda path: np.save(path, np.asfortranarray(NUMBERS / 3.0)), NUMBERS / 3.0),
        ("a.exr", lambda path: write_frame(path, {"Y": NUMBERS.astype(np.float32)}, {}), NUMBERS.astype(np.float32)),
    ],
)
def test_numbers_are_read_as_they_are_stored(tmp_path: Path, name: str, write: Write, expected: np.ndarray) -> None:
    """To the bit, of every type that a file may have. (Planted: 32 bits without a sign read with one; bytes of 16 bits
    changed places.)"""
    write(tmp_path / name)
    assert image_pages(tmp_path / name)[1] == (5, 7)
    values = read_image(tmp_path / name)
    assert np.array_equal(values, expected) and values.dtype == expected.dtype and values.dtype.isnative


def test_pages_come_in_their_order(tmp_path: Path) -> None:
    stack = [Image.fromarray(NUMBERS * scale) for scale in (1, 2, 3)]
    stack[0].save(tmp_path / "a.tif", save_all=True, append_images=stack[1:])
    np.save(tmp_path / "a.npy", np.stack([NUMBERS, NUMBERS * 2, NUMBERS * 3]))
    for name in ("a.tif", "a.npy"):
        assert image_pages(tmp_path / name)[1] == (5, 7)
        assert [page[4, 6] for page in read_images(tmp_path / name)] == [3842, 7684, 11526]


def test_the_end_of_a_file_is_that_of_its_bits() -> None:
    """A real or 32 bit number ends where no camera does."""
    assert own_end(np.zeros(1, np.uint8)) == 255 and own_end(np.zeros(1, np.uint16)) == 65535
    assert own_end(np.zeros(1, np.uint32)) is None and own_end(np.zeros(1)) is None


def transparent(path: Path) -> None:
    Image.fromarray((NUMBERS // 113).astype(np.uint8)).save(path, transparency=3)


def few_bits(path: Path) -> None:
    """A grey PNG of 4 bits, whose numbers Pillow multiplies by 17."""
    header, rows = struct.pack(">IIBBBBB", 4, 2, 4, 0, 0, 0, 0), b"\0\x01\x23" * 2
    parts = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    path.write_bytes(PngImagePlugin._MAGIC + parts)


def cut_short(path: Path) -> None:
    """A header that says 10 x 20 pixels, and half of them."""
    noise = np.random.default_rng(1).integers(0, 256, (10, 20), np.uint8)
    Image.fromarray(noise).save(path)
    path.write_bytes(path.read_bytes()[:150])


@pytest.mark.parametrize(
    ("name", "write", "words"),
    [
        ("a.png", saved(np.zeros((5, 7, 3), np.uint8)), "is no grey PNG of 8 or 16 bits"),
        ("a.png", saved(np.zeros((5, 7, 4), np.uint8)), "is no grey PNG of 8 or 16 bits"),
        ("a.png", lambda path: Image.new("P", (7, 5)).save(path), "is no grey PNG of 8 or 16 bits"),
        ("a.png", saved(np.zeros((5, 7), bool)), "is no grey PNG of 8 or 16 bits"),
        ("a.png", few_bits, "is no grey PNG of 8 or 16 bits"),
        ("a.png", transparent, "transparent"),
        ("a.png", cut_short, "damaged"),
        ("a.png", saved(NUMBERS, format="tiff"), "does not begin as a PNG"),
        ("a.png", lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n cut"), "cannot be read"),
        ("a.tif", saved(np.zeros((5, 7, 3), np.uint8)), "is no grey TIFF of 8, 16 or 32 bits whose zero is black"),
        ("a.tif", saved(np.zeros((5, 7), bool)), "is no grey TIFF"),
        ("a.tif", saved(NUMBERS, save_all=True, append_images=[Image.fromarray(NUMBERS)]), "has 2 pages"),
        ("a.tif", lambda path: tifffile.imwrite(path, NUMBERS, photometric="miniswhite"), "whose zero is black"),
        ("a.tif", cut_short, "damaged"),
        ("a.tif", saved(np.zeros((5, 7), np.uint8), compression="jpeg"), "cannot be read"),
        ("a.tif", lambda path: path.write_bytes(b"II*\0\0\0\0\0"), "has 0 pages"),
        ("a.npy", lambda path: np.save(path, np.ones((12, 10, 3), np.uint16)), "12 x 10 pixels of 3 numbers"),
        ("a.npy", lambda path: np.save(path, np.stack([NUMBERS] * 2)), "has 2 pages"),
        ("a.npy", lambda path: np.save(path, NUMBERS[None, None]), "uint16 of shape (1, 1, 5, 7)"),
        ("a.npy", lambda path: np.save(path, NUMBERS > 0), "bool of shape (5, 7)"),
        ("a.npy", lambda path: np.save(path, np.array([["a"]])), "rows x columns of numbers"),
        ("a.npy", lambda path: np.save(path, np.array([[None]]), allow_pickle=True), "cannot be read"),
        ("a.npy", lambda path: np.save(path, np.array([[np.nan, 1.0]])), "1 values are not finite"),
        ("a.npy", lambda path: np.save(path, np.zeros((0, 3))), "0 x 3 pixels"),
        ("a.exr", lambda path: write_frame(path, dict.fromkeys("RGB", np.ones((2, 2), np.float32)), {}), "DN, or a"),
        ("a.raw", lambda path: NUMBERS.tofile(path), "has no header; say how it is read by shape and bits"),
        ("a.jpg", saved(np.zeros((5, 7), np.uint8)), "ends in .jpg"),
        ("a.png", lambda path: None, "No such file"),
        ("a.png", lambda path: path.mkdir(), "Is a directory"),
    ],
)
def test_what_is_no_frame_is_refused(tmp_path: Path, name: str, write: Write, words: str) -> None:
    """(Planted: 4 bits read as Pillow gives them; white for black.)"""
    write(tmp_path / name)
    with pytest.raises(MitsimError) as reported:
        read_image(tmp_path / name)
    line = str(reported.value)
    assert words in line and line.startswith(f"frame {tmp_path / name}: ") and "\n" not in line


def test_a_picture_too_large_for_any_sensor_is_refused_by_its_header(tmp_path: Path) -> None:
    """(Planted: no bound of pixels in all.)"""
    for name, sides in (("a.npy", (2, 20000)), ("b.npy", (8193, 8192))):
        np.lib.format.open_memmap(tmp_path / name, "w+", np.uint8, sides).flush()
        with pytest.raises(MitsimError, match=f"{sides[0]} x {sides[1]} pixels; "):
            image_pages(tmp_path / name)[1]
    saved(NUMBERS)(tmp_path / "a.png")
    with pytest.raises(MitsimError, match=r"drawing .*5 x 7 pixels; 1 to 6 a side"):
        read_image(tmp_path / "a.png", Wanted("drawing", most=6))
    stack = [Image.fromarray(NUMBERS[:, :3]), Image.fromarray(NUMBERS)]
    stack[0].save(tmp_path / "a.tif", save_all=True, append_images=stack[1:])
    with pytest.raises(MitsimError, match="5 x 7 pixels; 1 to 6 a side"):
        list(read_images(tmp_path / "a.tif", Wanted(most=6)))


def deep_colours(path: Path, colours: np.ndarray) -> None:
    """A PNG of 16 bits, of which Pillow writes none."""
    rows, columns, _ = colours.shape
    lines = b"".join(b"\0" + row.astype(">u2").tobytes() for row in colours)
    parts = b"IHDR" + struct.pack(">IIBBBBB", columns, rows, 16, 2, 0, 0, 0), b"IDAT" + zlib.compress(lines), b"IEND"
    chunks = (struct.pack(">I", len(part) - 4) + part + struct.pack(">I", zlib.crc32(part)) for part in parts)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))


@pytest.mark.parametrize(("name", "bits"), [("a.png", 8), ("a.tif", 8), ("a.png", 16), ("a.tif", 16), ("a.npy", 16)])
def test_colours_are_read_where_they_are_wanted(tmp_path: Path, name: str, bits: int) -> None:
    """(Planted: the low byte of 16 bits left out, or read as the high one.)"""
    colours = np.random.default_rng(2).integers(0, 2**bits, (5, 7, 3), f"u{bits // 8}")
    if bits == 8:
        saved(colours)(tmp_path / name)
    elif name == "a.tif":
        tifffile.imwrite(tmp_path / name, colours, photometric="rgb")
    else:
        {"a.png": deep_colours, "a.npy": np.save}[name](tmp_path / name, colours)
    assert np.array_equal(read_image(tmp_path / name, Wanted(colour=True)), colours)
    if name == "a.png":
        good = (tmp_path / name).read_bytes()
        for bad in (good[:60], good.replace(b"IDAT", b"IDAX"), good[:24] + b"\x05" + good[25:]):
            (tmp_path / name).write_bytes(bad)
            with pytest.raises(MitsimError, match=r"cannot be read|is no grey PNG"):
                read_image(tmp_path / name, Wanted(colour=True))
    if name == "a.tif":
        tifffile.imwrite(tmp_path / name, np.moveaxis(colours, 2, 0), photometric="rgb", planarconfig="separate")
        with pytest.raises(MitsimError, match="pixel by pixel"):
            read_image(tmp_path / name, Wanted(colour=True))
    name = name.replace("npy", "png")
    Image.new("P", (7, 5)).save(tmp_path / name)
    with pytest.raises(MitsimError, match="nor of red, green and blue"):
        read_image(tmp_path / name, Wanted(colour=True))


@pytest.mark.parametrize(
    ("shape", "bits", "order", "words"),
    [
        ("10", 16, "little", "give ROWSxCOLUMNS"),
        ("0x20", 16, "little", "give ROWSxCOLUMNS"),
        ("10x20", None, "little", "give the bits"),
        ("10x20", 33, "little", "give the bits"),
        ("10x20", 12, "middle", "use little or big"),
        ("20x20", 12, "little", "400 bytes, but 20x20 numbers of 12 bits take 800"),
        ("10x20", 7, "little", "400 bytes, but 10x20 numbers of 7 bits take 200"),
        ("10x20", 12, "big", "beyond 12 bits"),
    ],
)
def test_a_file_without_a_header_is_read_as_is_said_or_refused(
    shape: str, bits: int | None, order: str, words: str, tmp_path: Path
) -> None:
    numbers = np.arange(200, dtype="<u2").reshape(10, 20)
    numbers.tofile(tmp_path / "a.raw")
    assert np.array_equal(read_image(tmp_path / "a.raw", Wanted(raw=Raw.of("10x20", 12, "little"))), numbers)
    numbers.astype(">u2").tofile(tmp_path / "b.raw")
    assert np.array_equal(read_image(tmp_path / "b.raw", Wanted(raw=Raw.of("10x20", 12, "big"))), numbers)
    with pytest.raises(MitsimError, match=words):
        read_image(tmp_path / "a.raw", Wanted(raw=Raw.of(shape, bits, order)))


def packed(numbers: list[int], form: str) -> bytes:
    """Numbers in a packed format of GenICam, put together as text of bits."""
    bits = int(form[4:6])
    texts = [f"{number:0{bits}b}" for number in numbers]
    if form.endswith("p"):  # the stream of bits from its end, as one binary number
        stream = "".join(reversed(texts))
        return bytes(int(byte, 2) for byte in reversed(re.findall("." * 8, "0" * (-len(stream) % 8) + stream)))
    found = list[str]()
    for first, second in zip(texts[::2], [*texts[1::2], ""], strict=False):
        between = second[8:].zfill(4) + first[8:].zfill(4)
        found += [first[:8], between, *([second[:8]] if second else [])]
    return bytes(int(byte, 2) for byte in found)


SMOOTH = (900 + 40 * np.sin(np.arange(400) / 30) + np.random.default_rng(5).normal(0, 3, 400)).astype(int).tolist()
"""A row of a frame, with its noise."""


@pytest.mark.parametrize("form", ["Mono10p", "Mono12p", "Mono10Packed", "Mono12Packed"])
def test_packed_numbers_are_those_of_an_independent_packer(form: str, tmp_path: Path) -> None:
    """Also an odd count, whose last bytes are partly used. (Planted: the second number's low bits from bit 2; the
    highest bits of a stream first; 12 bits a number for Mono10p.)"""
    by_hand = {
        "Mono12p": ("23c1ab", [0x123, 0xABC]), "Mono12Packed": ("12c3ab", [0x123, 0xABC]),
        "Mono10p": ("f1e52a7c01", [0x1F1, 0x2B9, 0x3C2, 5]), "Mono10Packed": ("7c11ae", [0x1F1, 0x2B9]),
    }  # fmt: skip
    text, known = by_hand[form]
    assert packed(known, form).hex() == text
    for size in ("10x20", "7x3", "1x1"):
        rows, columns = map(int, size.split("x"))
        numbers = np.random.default_rng(rows).integers(0, 1 << int(form[4:6]), rows * columns)
        (tmp_path / "a.raw").write_bytes(packed(numbers.tolist(), form))
        found = read_image(tmp_path / "a.raw", Wanted(raw=Raw.of(size, None, "little", form)))
        assert found.dtype == np.uint16 and np.array_equal(found.ravel(), numbers) and found.shape == (rows, columns)


@pytest.mark.parametrize(
    ("numbers", "stored", "stated", "words"),
    [
        (SMOOTH, "Mono12p", "Mono12Packed", "is probably in Mono12p, not in Mono12Packed; correct pixel_format"),
        (SMOOTH, "Mono12Packed", "Mono12p", "is probably in Mono12Packed, not"),
        (SMOOTH, "Mono10Packed", "Mono12p", "is probably in Mono12Packed, not"),
        (SMOOTH, "Mono10Packed", "Mono12Packed", "is probably in Mono10Packed, not"),
        (SMOOTH, "Mono12Packed", "Mono10Packed", "is probably in Mono12Packed or Mono12p, not"),
        (SMOOTH, "Mono12p", "Mono10p", "has 600 bytes, but 20x20 numbers in Mono10p take 500; correct shape or pixel"),
        (SMOOTH[1:], "Mono12p", "Mono12p", "has 599 bytes, but 20x20 numbers in Mono12p take 600"),
        (SMOOTH[:-1] * 2, "Mono10Packed", "Mono10Packed", "has 1197 bytes"),
        ([], "Mono10p", "Mono10p", "has 0 bytes"),
    ],
)
def test_a_packed_file_in_another_format_is_refused(
    numbers: list[int], stored: str, stated: str, words: str, tmp_path: Path
) -> None:
    """Of the three formats of one length, too. (Planted: no look at unused bits, or at neighbours.)"""
    (tmp_path / "a.raw").write_bytes(packed(numbers, stored))
    with pytest.raises(MitsimError, match=words) as caught:
        read_image(tmp_path / "a.raw", Wanted(raw=Raw.of("20x20", None, "little", stated)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("numbers", [[0] * 400, [4095] * 400, [0] * 200 + [0x800] + [0] * 199, [160] * 400])
def test_dark_full_and_even_frames_are_in_the_format_that_is_stated(numbers: list[int], tmp_path: Path) -> None:
    """(Planted: means in place of medians; a look at bits 2 and 3 alone.)"""
    for form in ("Mono12p", "Mono12Packed"):
        (tmp_path / "a.raw").write_bytes(packed(numbers, form))
        found = read_image(tmp_path / "a.raw", Wanted(raw=Raw.of("20x20", None, "little", form)))
        assert found.ravel().tolist() == numbers


def test_files_are_ordered_by_their_numbers(tmp_path: Path) -> None:
    for name in ("f10.png", "f9.png", "f1.png", "notes.txt", ".f2.png", "f3.raw"):
        (tmp_path / name).touch()
    assert [path.name for path in image_files(tmp_path)] == ["f1.png", "f9.png", "f10.png"]
    headless = Wanted(raw=Raw.of("1x1", 8, "little"))
    assert [path.name for path in image_files(tmp_path, headless)] == ["f1.png", "f3.raw", "f9.png", "f10.png"]
    assert image_files(tmp_path / "notes.txt") == (tmp_path / "notes.txt",)


def turned(number: int) -> Image.Exif:
    """Metadata that asks for a picture to be shown turned or mirrored."""
    exif = Image.Exif()
    exif[274] = number
    return exif


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_with(kind: bytes, data: bytes, behind: bool = False) -> Write:
    """A good PNG with one more chunk, before its pixels or behind them."""

    def write(path: Path) -> None:
        Image.fromarray(NUMBERS).save(path)
        whole = path.read_bytes()
        at = whole.index(b"IEND" if behind else b"IDAT") - 4
        path.write_bytes(whole[:at] + chunk(kind, data) + whole[at:])

    return write


def pages(count: int) -> Write:
    """A TIFF of 8 bits whose pages, so many, share their pixels and all but the place of the next."""

    def write(path: Path) -> None:
        tags = {256: 7, 257: 5, 258: 8, 259: 1, 262: 1, 273: 8, 277: 1, 278: 5, 279: 35}
        entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
        size, first = 2 + len(entries) + 4, 8 + 36
        places = [*(first + size * (page + 1) for page in range(count - 1)), 0]
        parts = (struct.pack("<H", len(tags)) + entries + struct.pack("<I", place) for place in places)
        path.write_bytes(b"II*\0" + struct.pack("<I", first) + bytes(36) + b"".join(parts))

    return write


def raw_photograph(path: Path) -> None:
    """A preview, and the picture itself in a part of it, as DNG has it."""
    with tifffile.TiffWriter(path) as file:
        file.write(NUMBERS[::2, ::2], subifds=1)
        file.write(NUMBERS)


@pytest.mark.parametrize("number", range(2, 9))
@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_a_picture_to_be_shown_turned_is_refused(tmp_path: Path, name: str, number: int) -> None:
    """Pillow turns the pixels of a TIFF and not those of a PNG; what is stored is another picture than what is seen.
    An orientation of 1 says nothing. (Planted: no look at the orientation.)"""
    saved(NUMBERS, exif=turned(number))(tmp_path / name)
    for wanted in (Wanted(), Wanted("mask drawing"), Wanted("point spread function", colour=True)):
        with pytest.raises(MitsimError, match=f"has the orientation {number}: viewers rotate or mirror it"):
            read_image(tmp_path / name, wanted)
    saved(NUMBERS, exif=turned(1))(tmp_path / name)
    assert np.array_equal(read_image(tmp_path / name), NUMBERS)


@pytest.mark.parametrize(
    ("name", "write", "words"),
    [
        (
            "a.png",
            saved(NUMBERS.astype(np.uint8), save_all=True, append_images=[Image.new("L", (7, 5))] * 3),
            "animated",
        ),
        # One frame besides the picture, which then is none of them.
        ("a.png", png_with(b"acTL", struct.pack(">II", 1, 0)), "animated"),
        ("a.png", png_with(b"eXIf", turned(3).tobytes()[6:], behind=True), "orientation 3"),
        ("a.tif", lambda path: tifffile.imwrite(path, NUMBERS, subfiletype=1), "previews"),
        ("a.tif", raw_photograph, "previews"),
        ("a.tif", lambda path: tifffile.imwrite(path, NUMBERS, tile=(2048, 2048), compression="zlib"), "tiles larger"),
        ("a.tif", pages(2**16 + 1), "give 1 to 65536"),
        (
            "a.npy",
            lambda path: (np.save(path, NUMBERS), os.truncate(path, 1 << 40)),
            "numbers, and 1099511627648 follow",
        ),
    ],
    ids=["animated", "one frame", "turned behind", "preview", "parts", "tiles", "pages", "sparse"],
)
def test_a_picture_that_holds_another_is_refused(tmp_path: Path, name: str, write: Write, words: str) -> None:
    """(Planted: each of the checks left out.)"""
    write(tmp_path / name)
    with pytest.raises(MitsimError, match=words):
        next(read_images(tmp_path / name))


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("a.npy", lambda path: np.save(path, np.zeros((3, 500, 500)))),
        ("a.npy", lambda path: np.save(path, np.asfortranarray(np.zeros((3, 500, 500))))),
        ("a.tif", lambda path: tifffile.imwrite(path, np.zeros((3, 500, 500), np.uint16), photometric="minisblack")),
        ("a.raw", lambda path: np.zeros((500, 500), np.uint16).tofile(path)),
        ("a.png", lambda path: Image.effect_noise((500, 500), 50).save(path)),
    ],
    ids=["npy", "npy columns first", "tif", "raw", "png"],
)
def test_a_file_that_is_cut_while_it_is_read_is_refused(tmp_path: Path, name: str, write: Write) -> None:
    """Between header and pixels: a map of the file would end the process. (Planted: NPY mapped, which it did.)"""
    write(tmp_path / name)
    wanted = Wanted(raw=Raw.of("500x500", 16, "little"))
    with _one_line_refusals(tmp_path / name, wanted):
        _, numbers = _read_header(tmp_path / name, wanted)
    os.truncate(tmp_path / name, 600)
    with pytest.raises(MitsimError, match="cannot be read"), _one_line_refusals(tmp_path / name, wanted):
        list(numbers)


def test_a_picture_beyond_free_memory_is_refused_by_its_header(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sparse files cost nothing on disk."""
    np.lib.format.open_memmap(tmp_path / "a.npy", "w+", np.float64, (8000, 8000)).flush()
    monkeypatch.setattr("mitsim.core.job.free_memory", lambda: 2**30)
    with pytest.raises(MitsimError, match=r"a\.npy: would take about .* GiB of memory; allowed are 922 MiB"):
        read_image(tmp_path / "a.npy")


# ---- Pictures for people ---------------------------------------------------------------------------------------------


def opened(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)), dtype=float)


def test_a_picture_is_grey_cut_and_curved() -> None:
    """0.5 is 0.7354 on the sRGB curve (IEC 61966-2-1)."""
    assert np.array_equal(opened(png([[-1.0, 0.0, 0.5, 1.0, 7.0]])), [[0, 0, np.rint(255 * 0.7354), 255, 255]])


def test_a_large_picture_is_averaged_never_thinned() -> None:
    """Every second row of a fine pattern would show another pattern."""
    stripes = np.tile([0.0, 1.0], (10, 5))
    small = opened(png(stripes, largest=5))
    assert small.shape == (5, 5) and np.all(np.abs(small - 127.5) <= 1)
    assert opened(png(stripes, largest=10)).shape == (10, 10)
    assert opened(png(np.ones((9, 4)), largest=4)).shape == (3, 2)


def test_a_span_is_short() -> None:
    assert span([[65520.0, 12.0]], "DN") == "12 to 65520 DN"
    assert span([0.00098642, 0.0104], "W/m^2") == "0.000986 to 0.0104 W/m^2"


def test_scaled_numbers_fill_their_range() -> None:
    assert np.array_equal(normalise([2, 4, 3]), [0, 1, 0.5]) and np.array_equal(normalise([[5, 5]]), [[0, 0]])


def test_text_is_escaped_and_numbers_stand_right() -> None:
    assert "a &lt; b" in card("a < b", {"c & d": [[0.5]]}, ["e > f"])
    shown = table("t", ("name", "x [s]"), [("long" * 10, "1.5")], ["fact"], numbers=1)
    assert shown.count("text-align:right") == 2 and shown.count("text-align:left") == 2
    assert shown.count("nowrap") == 3  # not the long one

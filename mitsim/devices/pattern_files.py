"""Patterns from files: pictures of grey levels, or two factors of them, become light and its factors.

Pictures show 8 bits, and a projector shows the level g as the light t_g, with t_0 = 0 and t_255 = 1. Pattern (i, j) is
picture i K' + j. All patterns are products u_i v_j^T if and only if the light M[(i, r), (j, c)] of pattern (i, j) at
the pixel (r, c) is a matrix of rank 1. The nearest matrix of rank 1 is found by a step of the power method. It may be
off by one grey level, because pictures are rounded to levels: frames are those of the pictures, and solvers get the
factors.
"""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsim.core.configuration import read_toml
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.files import check_plain
from mitsim.core.picture_files import Wanted, image_files

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from mitsim.core.arrays import FloatArray

    Levels = npt.NDArray[np.uint8]
ENDINGS = (".npy", ".png", ".tif", ".tiff", ".toml")
OWN = f"a file ({', '.join(ENDINGS)}) or a folder of pictures"
_FACTORS = ".toml"
_WHITE = 255
_MOST_VALUES = 1 << 26
"""Levels of all patterns: 4096 patterns of 128 x 128 pixels, which take some seconds."""
_MOST_BYTES = 1 << 30
_MOST_TEXT = 1 << 22
_DIGITS = 12
_ROUNDING = 1e-9
Sides = tuple[int, int]


@dataclass(frozen=True, eq=False)
class GreyPictures:
    """Pictures as (shots, n, n') grey ``levels``, with the ``light`` (256,) of each level."""

    levels: Levels
    light: FloatArray


@dataclass(frozen=True, eq=False)
class OwnPatterns:
    """Factors (n, K) and (n', K') of patterns, and their ``grey`` pictures; None if all is 0 or 1."""

    left: npt.NDArray[np.int8] | FloatArray
    right: npt.NDArray[np.int8] | FloatArray
    grey: GreyPictures | None = None


# ---- Names ----


def split_name(text: str) -> tuple[Path, str]:
    """Return path and stated SHA-256, perhaps empty, of own patterns that are written PATH or PATH#SHA256."""
    found = re.fullmatch(r"(.+)#([0-9a-f]{64})", text, re.DOTALL)
    return (Path(found[1]), found[2]) if found else (Path(text), "")


def looks_like_file(text: str, base: Path = Path()) -> bool:
    return (
        os.sep in text or split_name(text)[0].suffix.lower() in ENDINGS or (text != "" and os.path.isdir(base / text))
    )


def own_name(text: str) -> str:
    """Return the name of own patterns as requests have it, PATH#SHA256, so that a changed file is noticed.

    The SHA-256 of a folder is that of its files one after the other. MitsimError for files that cannot be read, that
    are too large, or that have another SHA-256 than the stated one.
    """
    path, stated = split_name(text)
    digest = _digest(_look(path))
    if stated not in ("", digest):
        raise MitsimError(f"patterns {path}: were changed since, their SHA-256 is {digest}; give the earlier file")
    return f"{os.path.abspath(path)}#{digest}"


Look = tuple[tuple[str, int, int], ...]


def _look(path: Path) -> Look:
    if path.suffix.lower() not in ENDINGS and not path.is_dir():
        check_plain(path, "patterns")
        raise MitsimError(f"patterns {path}: give {OWN}")
    files = [path] if path.suffix.lower() == _FACTORS else image_files(path, _wanted())
    found = [(str(each), check_plain(each, "patterns")) for each in files]
    if (size := sum(status.st_size for _, status in found)) > _MOST_BYTES:
        raise MitsimError(f"patterns {path}: have {size} bytes; at most {_MOST_BYTES} are read, give 8 bits a pixel")
    return tuple((name, status.st_mtime_ns, status.st_size) for name, status in found)


def _wanted() -> Wanted:
    from mitsim.core.manifests import MOST_PIXELS  # here: it takes 7 ms to import

    return Wanted("patterns", MOST_PIXELS, (1, 8), colour=True)


@lru_cache(64)
def _digest(look: Look) -> str:
    digest = hashlib.sha256()
    for name, *_ in look:
        try:
            digest.update(Path(name).read_bytes())
        except OSError as error:
            raise MitsimError(f"patterns {name}: cannot be read ({error.strerror}); check the path") from error
    return digest.hexdigest()


# ---- Levels ----


def read_own(text: str, sides: Sides, light: tuple[float, ...] | None) -> OwnPatterns:
    """Return the patterns in a file, for ``sides`` (n, n') and the ``light`` of each grey level, None if not known.

    Raises MitsimError for files without patterns of this size, numbers that are no grey levels, patterns without
    light, patterns that are not separable, and grey levels whose light is not known.
    """
    path, _ = split_name(own_name(text))
    return _read(path, sides, light, _look(path))


@lru_cache(4)
def _read(path: Path, sides: Sides, light: tuple[float, ...] | None, look: Look) -> OwnPatterns:
    import numpy as np

    if path.suffix.lower() == _FACTORS:
        left, right = _read_factors(path, sides)
        _check_count(path, (len(left) * len(right), *sides))
        shots = (np.rint(_WHITE * own[:, None] * right[:, None, :]).astype(np.uint8) for own in left)
        rows, levels = [len(left)], np.concatenate([*shots])
    else:
        pages = _read_pages(path, sides, look)
        count, scale = len(pages), _WHITE / _white(path, pages)
        levels = np.stack([np.rint(page * scale).astype(np.uint8) for page in pages])
        rows = sorted((k for k in range(1, count + 1) if count % k == 0), key=lambda k: abs(math.log(k * k / count)))
    binary = bool(((levels == _WHITE) | (levels == 0)).all())
    if light is None and not binary:
        problem = "have grey levels, whose light depends on a projector's tone curve that is not known here"
        raise ArgumentError("patterns", f"{path}: {problem}; use a family of a bench, or patterns.json")
    shown = np.arange(_WHITE + 1) / _WHITE if light is None else np.array(light)
    if not shown[levels.max()] > 0:
        raise MitsimError(f"patterns {path}: are all dark; light some pixels")
    left_right = next(filter(None, (_factorise(levels, shown, k) for k in rows)), None)
    if left_right is None:
        lit = (k for k in range(len(levels)) if shown[levels[k]].any())
        alone = next((k + 1 for k in lit if _factorise(levels[k : k + 1], shown, 1) is None), None)
        which = f"pattern {alone} of {len(levels)} is no column times a row" if alone else "not all, or not in order"
        rule = "give every pair of K left profiles and K' right ones, in the order (1, 1), (1, 2), ... (K, K')"
        raise MitsimError(f"patterns {path}: {which}; {rule}")
    left, right = left_right
    if binary and np.isin(left, (0, 1)).all() and np.isin(right, (0, 1)).all():
        return OwnPatterns(left.astype(np.int8), right.astype(np.int8))
    return OwnPatterns(left, right, GreyPictures(levels, shown))


def _check_count(path: Path, shape: tuple[int, ...]) -> None:
    from mitsim.core.manifests import MOST_SHOTS

    if shape[0] > MOST_SHOTS or math.prod(shape) > _MOST_VALUES:
        most = min(MOST_SHOTS, _MOST_VALUES // math.prod(shape[1:]))
        raise MitsimError(f"patterns {path}: are {shape[0]} or more; at most {most} of this size are read, give fewer")


def _read_factors(path: Path, sides: Sides) -> list[FloatArray]:
    import numpy as np

    data, found = read_toml(path, _MOST_TEXT), list[Any]()
    if data.keys() != {"left", "right"}:
        raise MitsimError(f"patterns {path}: give two fields, left and right, each a list of rows of numbers")
    for name, side in zip(("left", "right"), sides, strict=True):
        try:
            values = np.array(data[name], dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            values = np.zeros(())
        if values.ndim != 2 or values.shape[1] != side or not len(values):
            raise MitsimError(f"patterns {path}: {name} is no list of rows of {side} numbers; give one row a pattern")
        found.append(values / _white(path, [values]))
    return found


def _read_pages(path: Path, sides: Sides, look: Look) -> list[npt.NDArray[Any]]:
    from mitsim.core.images import image_pages, read_images

    count, pages = 0, list[Any]()
    for name, *_ in look:
        count += image_pages(name, _wanted())[0]
        _check_count(path, (count, *sides))
        for values in read_images(name, _wanted()):
            if values.ndim == 3:  # as many programs save grey
                if (values[..., 1:3] != values[..., :1]).any() or (values[..., 3:] < _WHITE).any():
                    raise MitsimError(f"patterns {name}: are coloured or transparent; save them in grey")
                values = values[..., 0]
            if values.shape != sides:
                own, needed = (" x ".join(map(str, size)) for size in (values.shape, sides))
                raise MitsimError(f"patterns {name}: are of {own} pixels, and {needed} are lit; give these")
            pages.append(values)
    if not pages:
        raise MitsimError(f"patterns {path}: hold no pattern; give at least one")
    return pages


def _white(path: Path, arrays: Sequence[npt.NDArray[Any]]) -> int:
    """Return the number of white: 1, or 255 if there are numbers above 1; MitsimError for others than grey levels."""
    import numpy as np

    low, high = min(float(each.min()) for each in arrays), max(float(each.max()) for each in arrays)
    whole = high <= 1 or all(np.array_equal(each, np.rint(each)) for each in arrays)
    if not (low >= 0 and high <= _WHITE and whole):
        reach = f"numbers of {low:g} to {high:g}"
        raise MitsimError(f"patterns {path}: have {reach}; give numbers of 0 to 1, or whole numbers of 0 to 255")
    return _WHITE if high > 1 else 1


# ---- Factors ----


def _factorise(levels: Levels, light: FloatArray, rows: int) -> tuple[FloatArray, FloatArray] | None:
    """Return the factors (n, ``rows``) and (n', K') of patterns in a grid; None if light is off by over one level."""
    import numpy as np

    count, n, _ = levels.shape
    blocks = levels.reshape(rows, count // rows, *levels.shape[1:])

    def unfolded(block: Levels, table: FloatArray) -> FloatArray:
        return np.asarray(table[block].transpose(1, 0, 2).reshape(n, -1))

    sums = np.array([unfolded(block, light).sum(axis=1) for block in blocks])
    brightest, row = np.unravel_index(sums.argmax(), sums.shape)
    right = unfolded(blocks[brightest], light)[row]
    left = np.array([unfolded(block, light) @ right for block in blocks]) / (right @ right)
    right = sum(own @ unfolded(block, light) for own, block in zip(left, blocks, strict=True)) / np.square(left).sum()
    left, right = np.round(left, _DIGITS), np.round(right, _DIGITS)
    below = np.append(0.0, light[:-1]) - _ROUNDING
    above = np.append(light[1:], 2 * light[-1] - light[-2]) + _ROUNDING
    for own, block in zip(left, blocks, strict=True):
        product = np.outer(own, right)
        if (product < unfolded(block, below)).any() or (product > unfolded(block, above)).any():
            return None
    return left.T, right.reshape(count // rows, -1).T

"""Recipes in, textures and meshes of the shipped scenes out: 8-bit grey PNGs whose value / 255 IS the reflectance
(or the projector's window), and binary PLYs. `python scenes/generate.py` writes them, `--check` compares what is
shipped.

Rows run top (+y) to bottom, columns left (+x) to right, as one sees the sheet looking along +z. A sheet is
128 mm a side; the projector's lit window is its central 120 mm. No resampling library and no font takes part,
so the pixels do not depend on their versions.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path

import meshes
import numpy as np
import pictures
from drawing import Grey, glyph
from numpy.typing import NDArray

Reflectance = NDArray[np.float64]

SHEET_MM = 128.0
WINDOW_MM = 120.0
PROJECTOR_GRID = 128
REFLECTANCE_RANGE = (0.03, 0.90)
CHART_FRAME, CHART_PAPER = 0.04, 0.80
TARGET_BLACK, TARGET_WHITE = 0.04, 0.90
# Reflectances are averaged over the span of a laser projector's three lines, in nm.
CHART_BAND_NM = (450.0, 640.0, 5.0)
# The paper calls a group g when its line pairs are 0.375 mm x g apart: group 20 is 7.5 mm (0.13 lp/mm),
# group 5 is 1.9 mm (0.53 lp/mm). One texel is 1/16 mm, so every bar, and a projector pixel (15), is a whole
# number of texels.
TARGET_TEXELS_PER_MM = 16
TARGET_TEXELS_PER_PIXEL = 15
# Rows of (label, width of one bar in texels, number of white bars).
TARGET_GROUPS: tuple[tuple[tuple[str, int, int], ...], ...] = (
    (("20", 60, 3), ("16", 48, 3), ("12", 36, 4)),
    (("10", 30, 5), ("8", 24, 6), ("6", 18, 8)),
    (("5", 15, 9), ("4", 12, 11), ("3", 9, 15)),
    (("2", 6, 22), ("1.7", 5, 26)),
)


def projector_window() -> Grey:
    """(128, 256) grey: the projector's canvas, the 128 x 128 window at the right half lit, the rest black."""
    canvas = np.zeros((PROJECTOR_GRID, 2 * PROJECTOR_GRID), dtype=np.uint8)
    canvas[:, PROJECTOR_GRID:] = 255
    return canvas


def toed_in_window() -> Grey:
    """(128, 128) grey: the canvas of a projector without lens shift is its window, all lit."""
    return np.full((PROJECTOR_GRID, PROJECTOR_GRID), 255, dtype=np.uint8)


def photograph() -> Grey:
    """(512, 512) grey: the portrait, interpolated between texels."""
    return _to_grey(_double(_portrait()))


def small_photograph() -> Grey:
    """(256, 256) grey: the portrait as it is, 0.5 mm a texel."""
    return _to_grey(_portrait())


def _portrait() -> Reflectance:
    """(256, 256): NASA's portrait of Eileen Collins (public domain, shipped with scikit-image), face and
    shoulders, as linear luminance (Rec. 709) mapped linearly onto reflectances 0.03 to 0.90."""
    from skimage.data import astronaut

    crop = astronaut()[0:256, 96:352].astype(np.float64) / 255.0
    linear = np.where(crop <= 0.04045, crop / 12.92, ((crop + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    luminance = linear @ np.array([0.2126, 0.7152, 0.0722])
    low, high = float(luminance.min()), float(luminance.max())
    dark, bright = REFLECTANCE_RANGE
    return np.asarray(dark + (bright - dark) * (luminance - low) / (high - low))


def colour_chart() -> Grey:
    """(512, 512) grey, 0.25 mm a texel: the 24 patches (16 mm) of a ColorChecker on its dark frame, on paper.

    A patch's grey is the plain mean, over 450 to 640 nm in steps of 5 nm, of N. Ohta's measured spectral
    reflectance (colour-science, `SDS_COLOURCHECKERS["ColorChecker N Ohta"]`): what a camera of flat response
    sees under light of flat spectrum in that band. First patch (dark skin) top left.
    """
    from colour import SDS_COLOURCHECKERS

    first, last, step = CHART_BAND_NM
    band = np.arange(first, last + step / 2, step)
    spectra = SDS_COLOURCHECKERS["ColorChecker N Ohta"].values()
    means = [float(np.mean([spectrum[float(w)] for w in band])) for spectrum in spectra]
    sheet = np.full((512, 512), CHART_PAPER)
    pitch, patch, gap = 74, 64, 10
    height, width = 4 * pitch + gap, 6 * pitch + gap
    top, left = (512 - height) // 2, (512 - width) // 2
    sheet[top : top + height, left : left + width] = CHART_FRAME
    for index, mean in enumerate(means):
        row = top + gap + pitch * (index // 6)
        column = left + gap + pitch * (index % 6)
        sheet[row : row + patch, column : column + patch] = mean
    return _to_grey(sheet)


def resolution_target() -> Grey:
    """(2048, 2048) grey, 1/16 mm a texel: groups of vertical (left) and horizontal (right) white bars on
    black, 0.13 to 1.6 line pairs per mm, each under its number, and a white square as the zero frequency.

    Groups start on projector pixel borders, so group 5, two projector pixels a line pair, is the finest that
    a projector grid of 128 can carry; of the groups beyond it only an alias is left.
    """
    size = int(SHEET_MM * TARGET_TEXELS_PER_MM)
    margin = int((SHEET_MM - WINDOW_MM) / 2 * TARGET_TEXELS_PER_MM)
    step = TARGET_TEXELS_PER_PIXEL
    sheet = np.zeros((size, size), dtype=bool)
    row = margin + 3 * step
    for groups in TARGET_GROUPS:
        for (label, bar, count), start in zip(groups, (3, 47, 88), strict=False):
            column = margin + start * step
            _draw_text(sheet, label, row, column, step)
            block = (2 * count - 1) * bar
            lines = np.arange(block) // bar % 2 == 0
            top, right = row + 8 * step, column + _round_up(block, step) + 2 * step
            sheet[top : top + block, column : column + block] = lines[None, :]
            sheet[top : top + block, right : right + block] = lines[:, None]
        row += 31 * step
    column = margin + 88 * step
    sheet[top : top + 17 * step, column : column + 17 * step] = True
    return _to_grey(np.where(sheet, TARGET_WHITE, TARGET_BLACK))


def _round_up(value: int, step: int) -> int:
    return -(-value // step) * step


def _draw_text(sheet: NDArray[np.bool_], text: str, row: int, column: int, dot: int) -> None:
    """Set `text` in `sheet`, in place: dots of `dot` texels, top left corner at (row, column)."""
    for position, character in enumerate(text):
        for line, bit in np.argwhere(glyph(character)):
            y, x = row + line * dot, column + (6 * position + bit) * dot
            sheet[y : y + dot, x : x + dot] = True


def _to_grey(reflectance: Reflectance) -> Grey:
    """Reflectance 0..1 to the nearest of 255 steps; the rounded value is the scene's reflectance, exactly."""
    if reflectance.min() < 0.0 or reflectance.max() > 1.0:
        raise ValueError(f"reflectance {reflectance.min():g}..{reflectance.max():g} is outside 0..1")
    return np.rint(reflectance * 255.0).astype(np.uint8)


def _double(image: Reflectance) -> Reflectance:
    """(n, m) to (2n, 2m) by linear interpolation between texel centres (weights 3/4 and 1/4)."""
    for axis in (0, 1):
        padded = np.pad(image, [(1, 1) if a == axis else (0, 0) for a in (0, 1)], mode="edge")
        inner = np.take(padded, range(1, padded.shape[axis] - 1), axis)
        before = np.take(padded, range(padded.shape[axis] - 2), axis)
        after = np.take(padded, range(2, padded.shape[axis]), axis)
        pair = np.stack([0.75 * inner + 0.25 * before, 0.75 * inner + 0.25 * after], axis=axis + 1)
        shape = [2 * s if a == axis else s for a, s in enumerate(image.shape)]
        image = pair.reshape(shape)
    return image


TEXTURES: dict[str, Callable[[], Grey]] = {
    "photograph/projector.png": projector_window,
    "photograph/reflectance.png": photograph,
    "colour_chart/projector.png": projector_window,
    "colour_chart/reflectance.png": colour_chart,
    "compact_disc/projector.png": projector_window,
    "resolution_target/projector.png": projector_window,
    "resolution_target/reflectance.png": resolution_target,
    "corner/projector.png": projector_window,
    "cards/projector.png": projector_window,
    "cards/front.png": pictures.front_card,
    "cards/back.png": pictures.back_card,
    "mirror/projector.png": projector_window,
    "lamp_bench/projector.png": projector_window,
    "lamp_bench/reflectance.png": pictures.bench_chart,
    "cookie_bag/projector.png": projector_window,
    "cookie_bag/bag.png": pictures.cookie_bag,
    "cookie_bag/box.png": pictures.cardboard_box,
    "gift_card/projector.png": projector_window,
    "gift_card/card.png": pictures.gift_card,
    "metal_blade/projector.png": projector_window,
    "metal_blade/etching.png": pictures.blade_etching,
    "highlight/projector.png": toed_in_window,
    "keystone/projector.png": toed_in_window,
    "keystone/reflectance.png": small_photograph,
}
MESHES: dict[str, Callable[[], meshes.Mesh]] = {
    "corner/walls.ply": meshes.corner,
    "cookie_bag/bag.ply": meshes.cookie_bag,
    "cookie_bag/box.ply": meshes.box,
    "metal_blade/blade.ply": meshes.blade,
}


def difference(folder: Path, name: str) -> str | None:
    """None when the file at folder/name is exactly what its recipe makes, else a sentence saying why.

    A PNG is compared by its pixels (packing differs between library versions), a mesh by its bytes.
    """
    from PIL import Image

    path = folder / name
    if not path.is_file():
        return f"{path} is missing"
    if name in MESHES:
        return None if path.read_bytes() == MESHES[name]().ply() else f"{path} differs from its recipe"
    with Image.open(path) as image:
        mode, shipped = image.mode, np.asarray(image)
    expected = TEXTURES[name]()
    if mode != "L" or shipped.shape != expected.shape:
        return f"{path} is {mode} {shipped.shape}, its recipe makes L {expected.shape}"
    wrong = int(np.count_nonzero(shipped != expected))
    return f"{path} differs from its recipe in {wrong} pixels" if wrong else None


def write(folder: Path, name: str) -> None:
    """Write the file of `name` under `folder` (beside it first, then moved into place)."""
    from PIL import Image

    path = folder / name
    part = path.with_suffix(".part")
    if name in MESHES:
        part.write_bytes(MESHES[name]().ply())
    else:
        Image.fromarray(TEXTURES[name]()).save(part, format="PNG", optimize=True)
    os.replace(part, path)


def main(arguments: list[str] | None = None) -> int:
    """0 when all is written, or with --check when all agrees; 1 when a shipped file differs."""
    parser = argparse.ArgumentParser(description="Make the textures and meshes of the shipped scenes.")
    parser.add_argument("--check", action="store_true", help="compare, write nothing")
    check: bool = parser.parse_args(arguments).check
    folder = Path(__file__).resolve().parent
    if not check:
        for name in (*TEXTURES, *MESHES):
            write(folder, name)
        return 0
    complaints = [text for name in (*TEXTURES, *MESHES) if (text := difference(folder, name))]
    for text in complaints:
        sys.stderr.write(f"{text}; run: python scenes/generate.py\n")
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())

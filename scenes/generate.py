"""Recipes in, files of the shipped scenes out: textures, 8-bit grey PNGs whose value / 255 IS the reflectance (or the
projector's window), meshes, binary PLYs, and XML of shapes with spectra. `python scenes/generate.py` writes them,
`--check` compares what is shipped.

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
# The chart in texels of 0.25 mm: from patch to patch, a patch, the frame around it; 4 rows of 6.
CHART_PITCH, CHART_PATCH, CHART_GAP, CHART_ROWS, CHART_COLUMNS = 74, 64, 10, 4, 6
CHART_TEXEL_MM = 0.25
CHART_SPECTRA = "ColorChecker N Ohta"
PATCHES_XML = """<?xml version="1.0" encoding="utf-8"?>
<!-- The patches of a ColorChecker with their measured reflectances, nm:part, as colour-science has them
(SDS_COLOURCHECKERS["{spectra}"], N. Ohta). Made by ../generate.py. -->
<scene version="3.0.0">
{shapes}</scene>
"""
PATCH_XML = """    <shape type="rectangle" id="{name}">
        <transform name="to_world">
            <rotate z="1" angle="180"/>
            <scale x="{half:g}" y="{half:g}" z="1"/>
            <translate x="{x:g}" y="{y:g}" z="$sheet_z"/>
        </transform>
        <boolean name="flip_normals" value="true"/>
        <bsdf type="diffuse">
            <spectrum name="reflectance" value="
                {values}"/>
        </bsdf>
    </shape>
"""
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
    spectra = SDS_COLOURCHECKERS[CHART_SPECTRA].values()
    means = [float(np.mean([spectrum[float(w)] for w in band])) for spectrum in spectra]
    sheet = np.full((512, 512), CHART_PAPER)
    top, left, height, width = chart_box()
    sheet[top : top + height, left : left + width] = CHART_FRAME
    for (row, column), mean in zip(chart_patches(), means, strict=True):
        sheet[row : row + CHART_PATCH, column : column + CHART_PATCH] = mean
    return _to_grey(sheet)


def chart_box() -> tuple[int, int, int, int]:
    """Top, left, height and width [texels of 0.25 mm] of the chart's frame on its sheet of 512 x 512."""
    height, width = (count * CHART_PITCH + CHART_GAP for count in (CHART_ROWS, CHART_COLUMNS))
    return (512 - height) // 2, (512 - width) // 2, height, width


def chart_patches() -> list[tuple[int, int]]:
    """Top row and left column [texels of 0.25 mm] of each of the 24 patches."""
    top, left, _, _ = chart_box()
    rows, columns = (
        [start + CHART_GAP + CHART_PITCH * i for i in range(count)]
        for start, count in ((top, CHART_ROWS), (left, CHART_COLUMNS))
    )
    return [(row, column) for row in rows for column in columns]


def chart_paper() -> meshes.Mesh:
    """The sheet of the coloured chart around its frame, in mm about its middle."""
    top, left, height, width = chart_box()
    low, right = top + height, left + width
    return _tiles([(0, 0, top, 512), (top, 0, low, left), (top, right, low, 512), (low, 0, 512, 512)])


def chart_frame() -> meshes.Mesh:
    """The frame of the coloured chart, in mm about the sheet's middle, with a gap for each patch."""
    top, left, height, width = chart_box()
    tops, lefts = (sorted({place[axis] for place in chart_patches()}) for axis in (0, 1))
    ends = [top, *(start + CHART_PATCH for start in tops)]
    bars = [(above, left, below, left + width) for above, below in zip(ends, [*tops, top + height], strict=True)]
    for start in tops:
        sides = [left, *(first + CHART_PATCH for first in lefts)]
        pairs = zip(sides, [*lefts, left + width], strict=True)
        bars += [(start, one, start + CHART_PATCH, other) for one, other in pairs]
    return _tiles(bars)


def _tiles(tiles: list[tuple[int, int, int, int]]) -> meshes.Mesh:
    """Flat tiles of the chart's sheet, each by its top, left, bottom and right in texels."""
    return meshes.flat([tuple((256 - edge) * CHART_TEXEL_MM for edge in tile) for tile in tiles])


def chart_patches_xml() -> str:
    """The 24 patches of the coloured chart, each a rectangle with N. Ohta's measured spectral reflectance (380 to 780
    nm in steps of 5 nm, as colour-science has it). First patch (dark skin) top left."""
    from colour import SDS_COLOURCHECKERS

    shapes = []
    half = CHART_PATCH * CHART_TEXEL_MM / 2
    for (row, column), spectrum in zip(chart_patches(), SDS_COLOURCHECKERS[CHART_SPECTRA].values(), strict=True):
        x, y = ((256 - edge) * CHART_TEXEL_MM - half for edge in (column, row))
        values = [f"{nm:g}:{part:g}" for nm, part in zip(spectrum.wavelengths, spectrum.values, strict=True)]
        lines = [", ".join(values[start : start + 9]) for start in range(0, len(values), 9)]
        name = spectrum.name.partition(" (")[0].replace(" ", "_").replace(".", "_")
        shapes.append(PATCH_XML.format(name=name, half=half, x=x, y=y, values=(",\n" + 16 * " ").join(lines)))
    return PATCHES_XML.format(spectra=CHART_SPECTRA, shapes="".join(shapes))


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
    "colour_checker/projector.png": projector_window,
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
    "shelf/projector.png": projector_window,
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
    "colour_checker/paper.ply": chart_paper,
    "colour_checker/frame.ply": chart_frame,
    "cookie_bag/bag.ply": meshes.cookie_bag,
    "cookie_bag/box.ply": meshes.box,
    "shelf/object.ply": meshes.block,
    "metal_blade/blade.ply": meshes.blade,
}
TEXTS: dict[str, Callable[[], str]] = {"colour_checker/patches.xml": chart_patches_xml}


def difference(folder: Path, name: str) -> str | None:
    """None when the file at folder/name is exactly what its recipe makes, else a sentence saying why.

    A PNG is compared by its pixels (packing differs between library versions), another file by its bytes.
    """
    from PIL import Image

    path = folder / name
    if not path.is_file():
        return f"{path} is missing"
    if name not in TEXTURES:
        return None if path.read_bytes() == _recipe(name) else f"{path} differs from its recipe"
    with Image.open(path) as image:
        mode, shipped = image.mode, np.asarray(image)
    expected = TEXTURES[name]()
    if mode != "L" or shipped.shape != expected.shape:
        return f"{path} is {mode} {shipped.shape}, its recipe makes L {expected.shape}"
    wrong = int(np.count_nonzero(shipped != expected))
    return f"{path} differs from its recipe in {wrong} pixels" if wrong else None


def _recipe(name: str) -> bytes:
    """What a mesh or a text is to hold."""
    return MESHES[name]().ply() if name in MESHES else TEXTS[name]().encode()


def write(folder: Path, name: str) -> None:
    """Write the file of `name` under `folder` (beside it first, then moved into place)."""
    from PIL import Image

    path = folder / name
    part = path.with_suffix(".part")
    if name in TEXTURES:
        Image.fromarray(TEXTURES[name]()).save(part, format="PNG", optimize=True)
    else:
        part.write_bytes(_recipe(name))
    os.replace(part, path)


def main(arguments: list[str] | None = None) -> int:
    """0 when all is written, or with --check when all agrees; 1 when a shipped file differs."""
    parser = argparse.ArgumentParser(description="Make the textures, meshes and spectra of the shipped scenes.")
    parser.add_argument("--check", action="store_true", help="compare, write nothing")
    check: bool = parser.parse_args(arguments).check
    folder = Path(__file__).resolve().parent
    if not check:
        for name in (*TEXTURES, *MESHES, *TEXTS):
            write(folder, name)
        return 0
    complaints = [text for name in (*TEXTURES, *MESHES, *TEXTS) if (text := difference(folder, name))]
    for text in complaints:
        sys.stderr.write(f"{text}; run: python scenes/generate.py\n")
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())

"""The captures in this folder from the published ones: folders flatcam and diffusercam of DATA in, the same of OUT out.

    python captures/reduce.py DATA OUT

FlatCam: of each plane of its mosaic rows 2 to 509 and columns 2 to 637, the mean of 4 x 4 pixels, rounded, put back
into a mosaic in the high bits of 16; its authors' images, the mean of 4 x 4 pixels. DiffuserCam: the mean of 8 x 8.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image

SHIFT = 64
"""What the numbers of FlatCam's captures are multiples of."""


def mean_of_blocks(values: np.ndarray, side: int) -> np.ndarray:
    """Mean of blocks of ``side`` x ``side`` of ``values`` (rows, columns), rounded, of their type."""
    rows, columns = (length // side for length in values.shape)
    blocks = values[: rows * side, : columns * side].reshape(rows, side, columns, side)
    return np.rint(blocks.mean(axis=(1, 3))).astype(values.dtype)


def main() -> None:
    data, out = map(Path, sys.argv[1:])
    for name in ("flatcam", "diffusercam"):
        (out / name).mkdir(parents=True, exist_ok=True)
    for number in (6, 7):
        capture = np.array(Image.open(data / "flatcam" / f"fc_{number}.png")) // SHIFT
        small = np.zeros((254, 318), np.uint16)
        for row, column in np.ndindex(2, 2):
            small[row::2, column::2] = mean_of_blocks(capture[row::2, column::2][2:510, 2:638], 4)
        Image.fromarray(small * SHIFT).save(out / "flatcam" / f"fc_{number}.png", optimize=True)
        image = Image.open(data / "flatcam" / f"rec_{number}.png").reduce(4)
        image.save(out / "flatcam" / f"rec_{number}.png", optimize=True)
    for name in ("psf_sample.tif", "rawdata_hand_sample.tif"):
        small = mean_of_blocks(tifffile.imread(data / "diffusercam" / name), 8)
        how = {"photometric": "minisblack", "compression": "zlib", "predictor": True}
        tifffile.imwrite(out / "diffusercam" / name, small, **how)


if __name__ == "__main__":
    main()

"""Where a colour chart's patches lie in an image: a JSON file, or the name of a shipped scene, in; boxes out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import Configuration, locate, validate
from mitsim.core.errors import MitsimError
from mitsim.core.files import read_json

PATCHES = 24
"""Of a ColorChecker."""
Edge = Annotated[int, Field(ge=0, le=1 << 14)]
Box = Annotated[tuple[Edge, ...], Field(strict=False, min_length=4, max_length=4)]
"""First row, row after the last, first column, column after the last [projector pixels]."""


class ChartPlace(Configuration):
    """The patches of a chart in an image."""

    spectra: Literal["ColorChecker N Ohta"]
    """Measured spectra of the patches, in colour-science."""
    patches: Annotated[tuple[Box, ...], Field(strict=False, min_length=PATCHES, max_length=PATCHES)]
    """Of each patch, row by row: [first row, end, first column, end] inside it [image pixels]."""

    @field_validator("patches")
    @classmethod
    def _not_empty(cls, patches: tuple[Box, ...]) -> tuple[Box, ...]:
        for number, (top, bottom, left, right) in enumerate(patches):
            if not (top < bottom and left < right):
                raise ValueError(f"patch {number} is [{top}, {bottom}, {left}, {right}]; ends must lie beyond firsts")
        return patches

    def means(self, image: FloatArray) -> FloatArray:
        """(24, ...) means over the patches of an ``image`` (rows, columns, ...); MitsimError where one lies outside."""
        return np.array([block.mean(axis=(0, 1)) for block in self.blocks(image)])

    def blocks(self, image: FloatArray) -> list[FloatArray]:
        """The pixels (rows, columns, ...) of each patch in an ``image``; MitsimError where one lies outside."""
        rows, columns = image.shape[:2]
        outside = next((box for box in self.patches if box[1] > rows or box[3] > columns), None)
        if outside is not None:
            raise MitsimError(
                f"chart: a patch is {list(outside)}, but the image has {rows} x {columns} pixels; give the chart's "
                "place in this image"
            )
        return [image[top:bottom, left:right] for top, bottom, left, right in self.patches]


def load_chart(name: Path | str) -> ChartPlace:
    """The chart ``name``: a shipped scene that shows one, or a JSON file. MitsimError when it cannot be read."""
    path = locate(name, "scenes", "chart.json")
    return validate(ChartPlace, read_json(path), f"file {path}")

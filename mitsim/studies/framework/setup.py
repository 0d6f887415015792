"""Where a study measures: setups, whose points share light and calibration, points, and test images to print.

The paper's means are over eight images, which it does not name. These come with scikit-image, which states their
licences.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, Any

from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.errors import MitsimError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from mitsim.core.arrays import FloatArray
    from mitsim.report.pages import Value

_KEY_DIGITS = 16
"""Of a point's name: two of 10^4 points have the same with a chance of 10^-11."""


@dataclass(frozen=True)
class Setup:
    """What light is traced for and a camera calibrated: points that share one share its light.

    Attributes
    ----------
    scene
        scene XML, or the name of a shipped scene.
    picture
        print that the scene's own is replaced with (:func:`picture`); None: its own.
    parameters
        (name, value) of the scene's parameters.
    camera, projector, variant, outside
        as for :func:`mitsim.open_bench`; ``outside`` is its ``allow_outside_files``.
    accuracy
        of the light.
    """

    scene: str = "photograph"
    picture: str | None = None
    parameters: tuple[tuple[str, str], ...] = ()
    camera: str | None = None
    projector: str | None = None
    variant: str = DEFAULT_VARIANT
    outside: bool = False
    accuracy: float = 1e-3

    def changed(self, **parameters: object) -> Setup:
        """The same with other ``parameters`` of the scene."""
        new = {**dict(self.parameters), **{name: f"{value}" for name, value in parameters.items()}}
        return replace(self, parameters=tuple(sorted(new.items())))

    def printed(self, picture: str | None) -> Setup:
        """The same with another ``picture`` on its print."""
        return replace(self, picture=picture)


@dataclass(frozen=True)
class Point:
    """One measurement of a study: its ``setup``, and the ``values`` of all else that varies, by name."""

    setup: Setup
    values: tuple[tuple[str, Value], ...]

    @classmethod
    def of(cls, setup: Setup, **values: Value) -> Point:
        """Of a ``setup``, with these ``values``."""
        return cls(setup, tuple(values.items()))

    @classmethod
    def grid(cls, setups: Iterable[Setup], columns: str, **varied: Sequence[Value]) -> list[Point]:
        """All combinations of what varies, the last fastest, at each of some ``setups``.

        Parameters
        ----------
        setups, columns
            where, and names of the values in the order in which the table has them.
        **varied
            values by name; what is fixed has one.
        """
        names = columns.split()
        chosen = [dict(zip(varied, values, strict=True)) for values in product(*varied.values())]
        return [cls.of(setup, **{name: values[name] for name in names}) for setup in setups for values in chosen]

    def __getitem__(self, name: str) -> Any:
        return dict(self.values)[name]

    def row(self, **measured: Value) -> dict[str, Value]:
        """A row of the table: all that varies, and what was ``measured``."""
        return {"picture": self.setup.picture, **dict(self.setup.parameters), **dict(self.values), **measured}

    @property
    def key(self) -> str:
        """Name of the file that keeps its findings."""
        text = json.dumps(asdict(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:_KEY_DIGITS]


# -------- Test images

TEST_IMAGES = ("astronaut", "camera", "chelsea", "coffee", "coins", "rocket", "page", "brick")
"""Portraits, an animal, things, a page of text and a texture."""
QUICK_IMAGES = ("chelsea", "page")
"""For a first look: fur and letters."""
PRINT_MM = 128.0
"""Width of the photograph's sheet, which they are printed on."""
EDGE_DEGREES = 5.0
"""Of the slanted edge, as ISO 12233 has it."""
SIDE = 512
"""Pixels a side: four of each of 128 projector pixels."""
_INK, _PAPER = 0.05, 0.90
"""Reflectances of black and white print, as on the shipped scenes."""


def picture(name: str) -> npt.NDArray[np.uint8]:
    """(512, 512) eight-bit reflectance of the test image ``name``: the middle square of it, grey.

    Besides, ``bars 0.26`` are bars of so many line pairs a mm of the print, upright on the left, lying on the right,
    and ``edge`` is one edge 5 degrees off the upright. MitsimError for another name.
    """
    import numpy as np
    from skimage import data
    from skimage.transform import resize

    kind, _, frequency = name.partition(" ")
    if kind == "bars" and frequency:
        return _reflectance(_bars(float(frequency)))
    if name == "edge":
        return _reflectance(_edge())
    if name not in TEST_IMAGES:
        raise MitsimError(f"picture {name!r}: use {', '.join((*TEST_IMAGES, 'edge', 'bars PAIRS_A_MM'))}")
    image = np.asarray(getattr(data, name)(), dtype=np.float64)
    grey = image.mean(axis=2) if image.ndim == 3 else image
    side = min(grey.shape)
    top, left = ((size - side) // 2 for size in grey.shape)
    square = resize(grey[top : top + side, left : left + side], (SIDE, SIDE), anti_aliasing=True)
    return _reflectance((square - square.min()) / (square.max() - square.min()))


def _reflectance(grey: FloatArray) -> npt.NDArray[np.uint8]:
    """Eight-bit reflectance of ``grey``, 0 black to 1 white."""
    import numpy as np

    return np.asarray(np.rint(255 * (_INK + (_PAPER - _INK) * grey)), dtype=np.uint8)


def _bars(frequency: float) -> FloatArray:
    """(512, 512) bars of so many pairs a mm, each texel the mean of the bars over it."""
    import numpy as np

    edges = np.arange(SIDE + 1) * PRINT_MM / SIDE * frequency
    white = np.floor(edges) / 2 + np.minimum(edges % 1, 0.5)  # integral of the bars, in periods
    profile = np.diff(white) / np.diff(edges)
    across = np.broadcast_to(profile, (SIDE, SIDE))
    return np.concatenate([across[:, : SIDE // 2], across.T[:, SIDE // 2 :]], axis=1)


def _edge() -> FloatArray:
    """(512, 512) black to white, each texel the part of it that is right of the edge, by 8 points a row of it."""
    import numpy as np

    rows, columns = ((np.arange(8 * SIDE) + 0.5) / 8, np.arange(SIDE))
    place = SIDE / 2 + (rows - SIDE / 2) * np.tan(np.radians(EDGE_DEGREES))
    return np.asarray(np.clip(columns + 1 - place[:, None], 0, 1).reshape(SIDE, 8, SIDE).mean(axis=1))

"""A run behind colour filters, in memory or in its folder: frames of all lines at once, and what each line would show.

The folder is a RUN folder of the frames, with colour.json, and ``638nm/truth.exr`` for each line.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.arguments import checked
from mitsim.core.arrays import FloatArray
from mitsim.core.colours import MosaicManifest, read_mosaic, write_colours
from mitsim.core.framefile import finite_channel, read_frame, write_frame
from mitsim.core.output import output_folder
from mitsim.core.recorders import TRUTH
from mitsim.core.runs import Capture, load_run


@dataclass(frozen=True, eq=False)
class LineTruth:
    """What a perfect image of a line would show.

    Attributes
    ----------
    reflectance
        (n, n), relative to the board.
    standard_error
        (n, n) of it, from sampling.
    board
        reflectance of the board that counts as 1.
    """

    reflectance: FloatArray
    standard_error: FloatArray
    board: float


@dataclass(frozen=True, eq=False)
class MosaicCapture:
    """All shots of a family, seen through a mosaic of colour filters.

    Attributes
    ----------
    shots
        the frames. Their own truth is the lines' by the light that all pixels together see of each.
    manifest
        lines, filters, and what each passes.
    truths
        of each line by its name; none of a real camera.
    """

    shots: Capture
    manifest: MosaicManifest
    truths: Mapping[str, LineTruth]

    @property
    def weights(self) -> FloatArray:
        """(4, lines) electrons per photon of each of 2 x 2 pixels, row by row."""
        return np.array(self.manifest.weights, dtype=np.float64)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why the capture is flagged."""
        return self.shots.warnings

    def truth(self, board: float | None = None) -> FloatArray | None:
        """(n, n, lines) of all lines, relative to a ``board`` of that reflectance; None without truths."""
        if not self.truths:
            return None
        each = (self.truths[name] for name in self.manifest.names)
        return np.stack([one.reflectance * (one.board / (board or one.board)) for one in each], axis=-1)

    @checked
    def save(self, folder: Path | str) -> Path:
        """Write the folder that `mitsim capture --colour mosaic` writes, to a new or empty ``folder``; returns it.

        MitsimError when it holds something, or cannot be written.
        """
        path = self.shots.save(folder)
        self.write_lines(path)
        return path

    def write_lines(self, folder: Path) -> None:
        """Write the lines' truths and colour.json beside the frames in ``folder``, colour.json last."""
        for name, truth in self.truths.items():
            with output_folder(folder / name, overwrite=True) as place:
                channels = {"reflectance": truth.reflectance, "standard_error": truth.standard_error}
                single = {key: values.astype(np.float32) for key, values in channels.items()}
                write_frame(place / TRUTH, single, {"board_reflectance": truth.board})
        write_colours(folder, self.manifest)

    def summary(self) -> dict[str, Any]:
        """What the command line reports: the keys of a capture, and of colour.json."""
        return {**self.manifest.model_dump(), **self.shots.summary()}

    def __repr__(self) -> str:
        return f"MosaicCapture({', '.join(self.manifest.names)} behind {self.manifest.mosaic}: {self.shots!r})"

    def _repr_html_(self) -> str:
        return self.shots._repr_html_()


@checked
def load_mosaic(folder: Path | str) -> MosaicCapture:
    """The run behind colour filters in ``folder``. MitsimError when it is not a complete one."""
    folder = Path(folder)
    manifest = read_mosaic(folder)
    files = {name: folder / name / TRUTH for name in manifest.names}
    truths = {name: _truth(path) for name, path in files.items() if path.is_file()}
    return MosaicCapture(load_run(folder), manifest, truths if len(truths) == len(files) else {})


def _truth(path: Path) -> LineTruth:
    channels, metadata = read_frame(path)
    board = metadata.get("board_reflectance")
    return LineTruth(
        finite_channel(channels, "reflectance", path),
        finite_channel(channels, "standard_error", path),
        1.0 if board is None else float(board),
    )

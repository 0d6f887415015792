"""A run as PNG files: frames of 16 bits, and its patterns at a projector's own resolution, to show on a real one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.colours import COLOUR
from mitsim.core.errors import MitsimError
from mitsim.core.jsonfile import write_json
from mitsim.core.manifests import RunManifest
from mitsim.core.output import whole_file, whole_folder, write_text
from mitsim.exchange.coloured import Coloured
from mitsim.exchange.drawn import (
    PATTERNS,
    Raster,
    cells_told,
    described,
    draw,
    frame_name,
    pictures_of,
    write_png,
)
from mitsim.exchange.packed import Packed, shots_of

_LARGEST = 2**16 - 1
"""Of a PNG's numbers."""


def write_pngs(folder: Path, run: Packed[RunManifest], projector: str | None = None) -> tuple[str, ...]:
    """Write the frames of a run, and its patterns as a projector shows them, to a new folder, whole or not at all.

    Parameters
    ----------
    folder
        to make: `frames/`, `patterns/`, `patterns.json`, and `ambient.npy` where an ambient frame was taken.
    run
        with digital numbers of up to 16 bits.
    projector
        name or TOML file; None: the run's own.

    Returns
    -------
    tuple of str
        how the frames are read again, and how large the patterns' cells are.

    Raises
    ------
    MitsimError
        for numbers that PNG cannot hold, patterns that are not of 0, 1 and -1, or a projector of unknown or too few
        pixels.
    """
    raster = _raster(run, projector)
    with whole_folder(folder) as place:
        where = _fill(place, run, raster)
    return _read_again(folder, "RUN", "CAL", run.manifest), f"Patterns in cells of {cells_told(where)}"


def write_pngs_lines(folder: Path, run: Coloured[RunManifest], projector: str | None = None) -> tuple[str, ...]:
    """Write a coloured run as pictures to a new folder, whole or not at all: a folder of each line, as
    :func:`write_pngs` writes it, and colour.json.

    Parameters
    ----------
    folder
        to make.
    run, projector
        as for :func:`write_pngs`.

    Returns
    -------
    tuple of str
        as of :func:`write_pngs`.

    Raises
    ------
    MitsimError
        as for :func:`write_pngs`.
    """
    with whole_folder(folder) as place:
        for name, shots in run.lines.items():
            (place / name).mkdir()
            where = _fill(place / name, shots, _raster(shots, projector))
        write_text(place / COLOUR, run.text)
    again = (_read_again(folder / name, f"RUN/{name}", f"CAL/{name}", run.lines[name].manifest) for name in run.lines)
    return f"Begin with: mkdir RUN; cp {folder / COLOUR} RUN", *again, f"Patterns in cells of {cells_told(where)}"


def _fill(place: Path, run: Packed[RunManifest], raster: Raster) -> dict[str, Any]:
    """Write a run's pictures to a folder that this process holds; returns the grid's place as :func:`draw` does."""
    manifest = run.manifest
    sides = tuple(len(matrix) for matrix in manifest.patterns.matrices)
    pictures = pictures_of(manifest.patterns, str(run.place))
    where = draw(place, pictures, raster, (sides[0], sides[1]), str(run.place))
    (place / "frames").mkdir()
    names = []
    for index, (shot, channels, _) in enumerate(shots_of(run)):
        dn = channels["DN"]
        if dn.dtype != np.uint32 or int(dn.max()) > _LARGEST:
            raise MitsimError(
                f"{run.place / shot.file}: has {dn.dtype} numbers up to {dn.max():g}, and PNG holds whole ones up to "
                f"{_LARGEST}; use the format hdf5"
            )
        names.append(frame_name(index))
        write_png(place / "frames" / names[-1], dn.astype(np.uint16))
    if manifest.ambient_frame is not None:
        with whole_file(place / "ambient.npy") as part, part.open("wb") as file:
            np.save(file, run.read(manifest.ambient_frame.file)[0]["DN"])
    write_json(place / PATTERNS, described(manifest.patterns, names, where))
    return where


def _read_again(folder: Path, run: str, calibration: str, manifest: RunManifest) -> str:
    """How the frames in a ``folder`` become the RUN folder ``run`` again."""
    again = f"--patterns {folder / PATTERNS} --exposure {manifest.digital.exposure_s!r}"
    if manifest.ambient_frame is not None:
        again += f" --ambient-frame {folder / 'ambient.npy'} --ambient-shots {manifest.ambient_frame.shots}"
    frames = folder / "frames"
    return f"Read again by: mitsim import {frames} {again} --camera NAME --calibration {calibration} -o {run}"


def _raster(run: Packed[RunManifest], projector: str | None) -> Raster:
    """That of the ``projector``, or of the one that took part in the ``run``."""
    if projector is not None:
        return Raster.of(projector)
    known = run.manifest.configuration.get("projector_model")
    return Raster.known(known if isinstance(known, dict) else {})

"""A run as PNG files: frames of 16 bits, and its patterns at a projector's own resolution, to show on a real one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.configuration import load_model, locate
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.jsonfile import write_json
from mitsim.core.manifests import Patterns, RunManifest
from mitsim.core.output import whole_folder
from mitsim.exchange.packed import Packed, shots_of
from mitsim.rig.projector import ProjectorModel

PATTERNS = "patterns.json"
"""Which picture shows what, and where the grid lies in it."""
_LARGEST = 2**16 - 1
"""Of a PNG's numbers."""
_WHITE = 255
"""Of a picture for the projector; black is 0, so that its gamma plays no part."""


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
        how the frames are read again.

    Raises
    ------
    MitsimError
        for numbers that PNG cannot hold, patterns that are not of 0, 1 and -1, or a projector of unknown or too few
        pixels.
    """
    manifest = run.manifest
    raster = _raster(run, projector)
    light = _pictures(manifest.patterns, run.place)
    grid = grid_in(raster, manifest.patterns, run.place)
    with whole_folder(folder) as place:
        (place / "frames").mkdir()
        (place / "patterns").mkdir()
        names = []
        for index, (shot, channels, _) in enumerate(shots_of(run)):
            dn = channels["DN"]
            if dn.dtype != np.uint32 or int(dn.max()) > _LARGEST:
                raise MitsimError(
                    f"{run.place / shot.file}: has {dn.dtype} numbers up to {dn.max():g}, and PNG holds whole ones "
                    f"up to {_LARGEST}; use the format hdf5"
                )
            names.append(f"frame_{index:05d}.png")
            _write(place / "frames" / names[-1], dn.astype(np.uint16))
            _write(place / "patterns" / f"pattern_{index:05d}.png", shown(light[index], grid, raster))
        sides = tuple(len(matrix) for matrix in manifest.patterns.matrices)
        for name, level in (("black", 0), ("white", 1)):
            _write(place / "patterns" / f"{name}.png", shown(np.full(sides, level), grid, raster))
        if manifest.ambient_frame is not None:
            np.save(place / "ambient.npy", run.read(manifest.ambient_frame.file)[0]["DN"])
        write_json(place / PATTERNS, _described(manifest.patterns, grid, raster, names))
    again = f"--patterns {folder / PATTERNS} --exposure {manifest.digital.exposure_s!r}"
    if manifest.ambient_frame is not None:
        again += f" --ambient-frame {folder / 'ambient.npy'} --ambient-shots {manifest.ambient_frame.shots}"
    return (f"Read again by: mitsim import {folder / 'frames'} {again} --camera NAME --calibration CAL -o RUN",)


def grid_in(raster: tuple[int, int], patterns: Patterns, place: Path) -> dict[str, int]:
    """Where the patterns' grid lies in a projector's raster: whole pixels a cell, as large as fits, in the middle.

    Parameters
    ----------
    raster
        rows and columns of the projector.
    patterns
        of the run.
    place
        of the run, for messages.

    Returns
    -------
    dict
        `cell` [pixels a side], `first_row`, `first_column` of its first cell.

    Raises
    ------
    MitsimError
        where a cell would have no pixel.
    """
    sides = [len(matrix) for matrix in patterns.matrices]
    cell = min(pixels // side for pixels, side in zip(raster, sides, strict=True))
    if cell < 1:
        raise MitsimError(
            f"{place}: patterns of {sides[0]} x {sides[1]} pixels do not fit a projector of {raster[0]} rows x "
            f"{raster[1]} columns; give a larger projector"
        )
    first = [(pixels - cell * side) // 2 for pixels, side in zip(raster, sides, strict=True)]
    return {"cell": cell, "first_row": first[0], "first_column": first[1]}


def shown(light: npt.NDArray[Any], grid: dict[str, int], raster: tuple[int, int]) -> npt.NDArray[np.uint8]:
    """A picture for the projector, (rows, columns), black around the grid.

    Parameters
    ----------
    light
        (n, n') of 0 and 1.
    grid, raster
        as of :func:`grid_in`.
    """
    picture = np.zeros(raster, np.uint8)
    cells = np.kron(light, np.ones((grid["cell"], grid["cell"])))
    rows, columns = cells.shape
    picture[grid["first_row"] :, grid["first_column"] :][:rows, :columns] = np.rint(_WHITE * cells)
    return picture


def _raster(run: Packed[RunManifest], projector: str | None) -> tuple[int, int]:
    """Rows and columns of the projector."""
    if projector is not None:
        model = load_model(locate(projector, "calibration", ".toml"), ProjectorModel)
        rows, columns = model.rows, model.columns
    else:
        known = run.manifest.configuration.get("projector_model")
        rows, columns = (known.get(key) if isinstance(known, dict) else None for key in ("rows", "columns"))
    if not (isinstance(rows, int) and isinstance(columns, int)):
        raise ArgumentError("projector", "does not say its rows and columns; give one that does")
    return rows, columns


def _pictures(patterns: Patterns, place: Path) -> list[npt.NDArray[Any]]:
    """(n, n') of 0 and 1 for each shot."""
    left, right = patterns.matrices
    if not np.isin(np.concatenate([left.ravel(), right.ravel()]), (-1, 0, 1)).all():
        raise MitsimError(
            f"{place}: patterns have values other than 0, 1 and -1, whose light a projector's gamma changes"
        )
    found = []
    for shot in patterns.captures:
        pattern = np.outer(left[:, shot.row], right[:, shot.column])
        light = (1 + shot.sign * pattern) / 2 if shot.sign else pattern
        if not np.isin(light, (0, 1)).all():
            raise MitsimError(f"{place}: {shot.file} shows light other than 0 and 1, which a projector's gamma changes")
        found.append(light)
    return found


def _described(patterns: Patterns, grid: dict[str, int], raster: tuple[int, int], names: list[str]) -> dict[str, Any]:
    shots = [
        {
            "file": name,
            "pattern": f"patterns/pattern_{index:05d}.png",
            **shot.model_dump(include={"row", "column", "sign"}),
        }
        for index, (name, shot) in enumerate(zip(names, patterns.captures, strict=True))
    ]
    return {
        "projector": {"rows": raster[0], "columns": raster[1], **grid},
        **patterns.model_dump(include={"family", "n", "P_L", "P_R"}),
        "shots": shots,
    }


def _write(path: Path, values: npt.NDArray[Any]) -> None:
    from PIL import Image

    try:
        Image.fromarray(values).save(path, format="png")
    except OSError as error:
        raise MitsimError(
            f"file {path}: cannot be written ({error.strerror or error}); choose a folder with room"
        ) from error

"""Patterns in; pictures at a projector's own resolution out, to show on a real one: of a family, or a calibration's."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.configuration import CAMERA, PROJECTOR, load_model, locate, validate
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.files import whole_file, whole_folder, write_json, write_text
from mitsim.core.job import Cost, Limits
from mitsim.core.manifests import COLOUR, ClosingKind, Patterns, RunManifest
from mitsim.devices.framelist import FrameList
from mitsim.devices.patterns import parse_patterns, stripe_signs
from mitsim.devices.projector import ProjectorModel
from mitsim.devices.sensor import check_exposure, digital_of, load_sensor
from mitsim.devices.session import UNIFORM, halves_in_order
from mitsim.exchange.packed import Run, shots_of

PATTERNS = "patterns.json"
"""Which picture shows what, and where the grid lies in it."""
SESSION = "session.json"
"""The list of a session's frames, as `mitsim calibrate --frames` reads it."""
SQUARE = 0.01
"""How far a cell's width on the scene may be off its height, as a logarithm, to count as square: a hundredth, which
nobody sees in an image."""
_SECONDS_PER_PIXEL, _PIXEL_BYTES = 2e-8, 3
"""Of drawing a picture: measured 6e-9 s of dots:7 in a raster of 720 x 1920, and some three times that for a slow
disk. Bytes of cells, picture and file."""
_WHITE = 255
"""Of a picture for the projector; black is 0, so that its gamma plays no part."""


# ---- A projector's raster ----


@dataclass(frozen=True)
class Raster:
    """A projector's own pixels.

    Attributes
    ----------
    rows, columns
        how many there are.
    aspect
        width of one on the scene, over its height.
    """

    rows: int
    columns: int
    aspect: float = 1.0

    @classmethod
    def of(cls, projector: str) -> Raster:
        """Return that of the ``projector``, a name or TOML file. MitsimError where its rows and columns are unknown."""
        path = locate(projector, "calibration", ".toml", PROJECTOR)
        return cls.of_projector(load_model(path, ProjectorModel).model_dump())

    @classmethod
    def of_projector(cls, model: Mapping[str, Any]) -> Raster:
        """Return that of a projector's ``model``, as a run's manifest has it; MitsimError as :meth:`of`."""
        if not model:
            raise ArgumentError("projector", "is not known of a run of imported frames; give its name or file")
        rows, columns = model.get("rows"), model.get("columns")
        if not (isinstance(rows, int) and isinstance(columns, int)):
            raise ArgumentError("projector", "does not say its rows and columns; give one that does")
        return cls(rows, columns, float(model.get("pixel_aspect", 1.0)))


# ---- Folders of pictures: of a family, and of a calibration session ----


def draw_family(
    folder: Path, name: str, n: int, projector: str, seed: int = 0, closing: ClosingKind | None = None
) -> dict[str, Any]:
    """Draw every shot of a family of patterns to a new folder, whole or not at all.

    Parameters
    ----------
    folder
        to make: `patterns/` and `patterns.json`.
    name
        of the family.
    n
        projector pixels a side that the patterns have.
    projector
        name or TOML file, of known rows and columns.
    seed
        of patterns of a `random` family.
    closing
        light of a last picture, for the closing frame; None: there is none.

    Returns
    -------
    dict
        `patterns`, `n`, `pictures`, `projector` (its rows and columns, and the grid's place), `output`.

    Raises
    ------
    MitsimError
        for a family that there is none of, or a projector of unknown or too few pixels.
    """
    family = parse_patterns(name, n, seed)
    names = [frame_name(index) for index in range(len(family.shots))]
    patterns, raster = Patterns.of(family, names), Raster.of(projector)
    light = with_closing(pictures_of(patterns, f"patterns {name}"), closing)
    count = len(names) + (closing is not None)
    with whole_folder(folder) as place:
        where = draw(place, light, count, raster, (n, n), f"projector {projector}")
        write_json(place / PATTERNS, describe(patterns, names, where))
    return {"patterns": name, "n": n, "pictures": count, "projector": where, "output": str(folder)}


def draw_stripes(folder: Path, projector: str, listed: FrameList) -> dict[str, Any]:
    """Draw every shot of a calibration session to a new folder, whole or not at all.

    The order is that in which `mitsim calibrate --frames` counts frames.

    Parameters
    ----------
    folder
        to make: `patterns/`, `patterns.json`, and the list that goes with the frames, `session.json`.
    projector
        name or TOML file, of known rows and columns.
    listed
        list of the frames that will be taken.

    Returns
    -------
    dict
        as of :func:`draw_family`.

    Raises
    ------
    MitsimError
        for a projector of unknown or too few pixels, and where no Hadamard matrix has so many rows.
    """
    n, raster, signs = listed.n, Raster.of(projector), stripe_signs(listed.n)
    light, shots = [], []
    for number, (side, index, sign) in enumerate(halves_in_order(signs.shape[1], listed.signed_capture == "pair")):
        stripes = signs[:, index, None] if side == "horizontal" else signs[None, :, index]
        light.append(np.broadcast_to(np.ones((1, 1)) if sign == UNIFORM else (1 + sign * stripes) / 2, (n, n)))
        shots.append(
            {"file": frame_name(number), "pattern": picture_name(number), "side": side, "index": index, "sign": sign}
        )
    with whole_folder(folder) as place:
        where = draw(place, light, len(light), raster, (n, n), f"projector {projector}")
        write_json(place / PATTERNS, {"projector": where, "shots": shots})
        write_json(place / SESSION, listed.model_dump(mode="json", exclude_defaults=True))
    return {"patterns": "stripes", "n": n, "pictures": len(light), "projector": where, "output": str(folder)}


def session_of(camera: str, exposure_s: float, n: int, signed_capture: str) -> FrameList:
    """Return the list of a calibration session's frames, in the order of their names.

    Parameters
    ----------
    camera
        electronics: name of a shipped file, or a TOML file.
    exposure_s
        of every frame [s].
    n
        projector pixels a side.
    signed_capture
        `pair` or `uniform`: how a +-1 pattern is captured.

    Raises
    ------
    MitsimError
        for values that cannot be.
    """
    sensor = load_sensor(locate(camera, "calibration", ".toml", CAMERA))
    digital = digital_of(sensor, check_exposure(exposure_s)).model_dump(exclude_none=True)
    stated = {"camera": {"name": sensor.name}, "n": n, "signed_capture": signed_capture, "digital": digital}
    return validate(FrameList, stated, "stripes")


# ---- Names of files ----


def frame_name(index: int) -> str:
    """Return the name of the frame of shot ``index`` among PNG files."""
    return f"frame_{index:05d}.png"


def picture_name(index: int) -> str:
    """Return the path of the picture of shot ``index`` in the folder that holds it."""
    return f"patterns/pattern_{index:05d}.png"


def draw(
    folder: Path, light: Iterable[npt.NDArray[Any]], count: int, raster: Raster, sides: tuple[int, int], place: str
) -> dict[str, Any]:
    """Write a picture for each shot to `patterns/` in a folder that this process holds, and a black and a white one.

    Parameters
    ----------
    folder
        that holds `patterns/`.
    light, count
        (n, n') of 0 and 1 for each shot, and their number.
    raster
        of the projector.
    sides
        n and n'.
    place
        of the grid, for messages.

    Returns
    -------
    dict
        `rows`, `columns` of the projector, and the grid's place as of :func:`grid_in`.

    Raises
    ------
    MitsimError
        where a cell would have no pixel, and where the pictures take more than a day, or than the memory that is free.
    """
    pixels = raster.rows * raster.columns
    cost = Cost(count * pixels * _SECONDS_PER_PIXEL, _PIXEL_BYTES * pixels)
    cost.check(f"{count} pictures of {raster.rows} x {raster.columns} pixels", Limits())
    grid = grid_in(raster, sides, place)
    (folder / "patterns").mkdir()
    pictures = ((picture_name(index), shot) for index, shot in enumerate(light))
    ends = [(f"patterns/{name}.png", np.full(sides, level)) for name, level in (("black", 0), ("white", 1))]
    for name, shot in chain(pictures, ends):
        cells = (_WHITE * shot).astype(np.uint8).repeat(grid["cell"], axis=0).repeat(grid["cell_columns"], axis=1)
        picture = np.zeros((raster.rows, raster.columns), np.uint8)
        picture[grid["first_row"] :, grid["first_column"] :][: cells.shape[0], : cells.shape[1]] = cells
        write_png(folder / name, picture)
    return {"rows": raster.rows, "columns": raster.columns, **grid}


# ---- The patterns' grid in the raster ----


def grid_in(raster: Raster, sides: tuple[int, int], place: str) -> dict[str, Any]:
    """Return the place of the patterns' grid in a projector's raster: whole pixels a cell, in the middle.

    On the scene a cell is square to :data:`SQUARE`, and of such cells as large as fits; where none is, it is the
    squarest.

    Parameters
    ----------
    raster
        of the projector.
    sides
        rows and columns of the grid.
    place
        name of the grid's projector or run, for messages.

    Returns
    -------
    dict
        `cell`, `cell_columns`: rows and columns of a cell [pixels]; `cell_shape`: its width on the scene over its
        height; `first_row`, `first_column` of the first cell.

    Raises
    ------
    MitsimError
        where a cell would have no pixel.
    """
    most = raster.rows // sides[0], raster.columns // sides[1]
    if min(most) < 1:
        raise MitsimError(
            f"{place}: patterns of {sides[0]} x {sides[1]} pixels do not fit a projector of {raster.rows} rows x "
            f"{raster.columns} columns; give a larger projector"
        )
    found: tuple[float, int, int] | None = None
    for rows in range(most[0], 0, -1):
        columns = min(max(round(rows / raster.aspect), 1), most[1])
        off = abs(math.log(columns * raster.aspect / rows))
        if found is None or (off < found[0] and found[0] > SQUARE):
            found = off, rows, columns
    if found is None:
        raise AssertionError  # a row fits
    _, rows, columns = found
    return {
        "cell": rows,
        "cell_columns": columns,
        "cell_shape": columns * raster.aspect / rows,
        "first_row": (raster.rows - rows * sides[0]) // 2,
        "first_column": (raster.columns - columns * sides[1]) // 2,
    }


def describe_cells(where: Mapping[str, Any]) -> str:
    """Return a cell's size, and its shape on the scene, of the place ``where`` of a grid as of :func:`grid_in`."""
    rows, columns, shape = where["cell"], where["cell_columns"], where["cell_shape"]
    size = f"{rows} pixels a side" if rows == columns else f"{rows} x {columns} pixels"
    if abs(math.log(shape)) > SQUARE:
        return f"{size}, {shape:.3g} times as wide as high on the scene, but square in an image"
    return size if rows == columns else f"{size}, square on the scene"


def pictures_of(patterns: Patterns, place: str) -> Iterator[npt.NDArray[Any]]:
    """Yield the projector's light for each shot, (n, n') of 0 and 1, one at a time.

    Parameters
    ----------
    patterns
        and their shots.
    place
        of the run, for messages.

    Raises
    ------
    MitsimError
        for light between, which a projector's gamma changes.
    """
    left, right = patterns.matrices
    if not np.isin(np.concatenate([left.ravel(), right.ravel()]), (-1, 0, 1)).all():
        raise MitsimError(
            f"{place}: patterns have values other than 0, 1 and -1, whose light a projector's gamma changes"
        )
    for shot in patterns.captures:
        pattern = np.outer(left[:, shot.row], right[:, shot.column])
        light = (1 + shot.sign * pattern) / 2 if shot.sign else pattern
        if not np.isin(light, (0, 1)).all():
            raise MitsimError(f"{place}: {shot.file} shows light other than 0 and 1, which a projector's gamma changes")
        yield light


def with_closing(pictures: Iterable[npt.NDArray[Any]], closing: ClosingKind | None) -> Iterator[npt.NDArray[Any]]:
    """Yield the ``pictures`` of all shots, and for a ``closing`` frame the first one again or a uniform one."""
    first = None
    for picture in pictures:
        first = picture if first is None else first
        yield picture
    if closing is not None and first is not None:
        yield first if closing == "first" else np.ones_like(first)


# ---- What patterns.json says ----


def describe(patterns: Patterns, names: Sequence[str], where: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of `patterns.json` for a family.

    Parameters
    ----------
    patterns
        and their shots.
    names
        of the frames, one a shot.
    where
        the grid's place, as :func:`draw` gives it.
    """
    shots = [
        {"file": name, "pattern": picture_name(index), **shot.model_dump(include={"row", "column", "sign"})}
        for index, (name, shot) in enumerate(zip(names, patterns.captures, strict=True))
    ]
    return {"projector": where, **patterns.model_dump(include={"family", "n", "P_L", "P_R"}), "shots": shots}


# ---- One PNG file ----


def write_png(path: Path, values: npt.NDArray[Any]) -> None:
    """Write ``values`` (rows, columns) of 8 or 16 bits to ``path``. MitsimError where that is not possible."""
    from PIL import Image

    with whole_file(path) as part:
        Image.fromarray(values).save(part, format="png")


# ---- A run as PNG files ----

_LARGEST = 2**16 - 1
"""Of a PNG's numbers."""


def write_pngs(folder: Path, run: Run, projector: str | None = None) -> tuple[str, ...]:
    """Write the frames of a run, and its patterns as a projector shows them, to a new folder, whole or not at all.

    Parameters
    ----------
    folder
        to make: `frames/`, `patterns/`, `patterns.json`, and `ambient.npy` where an ambient frame was taken; of a
        coloured run a folder of each line with these, and colour.json.
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
    rasters = {name: check_pictures(shots.manifest, projector, str(shots.place)) for name, shots in run.parts.items()}
    notes = [f"Begin with: mkdir RUN; cp {folder / COLOUR} RUN"] if run.colours else []
    with whole_folder(folder) as whole:
        for line, shots in run.parts.items():
            manifest, place, names = shots.manifest, whole / line, list[str]()
            rows, columns = (len(matrix) for matrix in manifest.patterns.matrices)
            closing, captures = manifest.closing_frame, manifest.patterns.captures
            pictures = with_closing(pictures_of(manifest.patterns, str(shots.place)), closing.kind if closing else None)
            place.mkdir(exist_ok=True)
            count = len(captures) + bool(closing)
            where = draw(place, pictures, count, rasters[line], (rows, columns), str(shots.place))
            (place / "frames").mkdir()
            frames = ((shot.file, channels["DN"]) for shot, channels, _ in shots_of(shots))
            last = [(closing.file, shots.read(closing.file)[0]["DN"])] if closing else []
            for index, (file, dn) in enumerate(chain(frames, last)):
                if dn.dtype != np.uint32 or int(dn.max()) > _LARGEST:
                    raise MitsimError(
                        f"{shots.place / file}: has {dn.dtype} numbers up to {dn.max():g}, and PNG holds whole ones up "
                        f"to {_LARGEST}; use the format hdf5"
                    )
                names.append(frame_name(index))
                write_png(place / "frames" / names[-1], dn.astype(np.uint16))
            own = folder / line
            again = f"--patterns {own / PATTERNS} --exposure {manifest.digital.exposure_s!r}"
            if (ambient := manifest.ambient_frame) is not None:
                with whole_file(place / "ambient.npy") as part, part.open("wb") as stream:
                    np.save(stream, shots.read(ambient.file)[0]["DN"])
                again += f" --ambient-frame {own / 'ambient.npy'} --ambient-shots {ambient.shots}"
            if closing is not None:
                again += f" --closing-frame {closing.kind} --closing-exposure {closing.exposure_s!r}"
            write_json(place / PATTERNS, describe(manifest.patterns, names[: len(captures)], where))
            again += f" --camera NAME --calibration {Path('CAL', line)} -o {Path('RUN', line)}"
            notes.append(f"Read again by: mitsim import {own / 'frames'} {again}")
        if run.colours:
            write_text(whole / COLOUR, run.text)
    return (*notes, f"Patterns in cells of {describe_cells(where)}")


def check_pictures(manifest: RunManifest, projector: str | None, place: str) -> Raster:
    """Return the raster that a run's pictures are drawn for.

    Parameters
    ----------
    manifest
        of the run.
    projector
        name or TOML file; None: the run's own.
    place
        of the run, for messages.

    Raises
    ------
    MitsimError
        for a projector or patterns of which no pictures can be drawn.
    """
    known = manifest.configuration.get("projector_model")
    own = known if isinstance(known, dict) else {}
    raster, sides = Raster.of(projector) if projector else Raster.of_projector(own), manifest.patterns.matrices
    grid_in(raster, (len(sides[0]), len(sides[1])), place)
    next(pictures_of(manifest.patterns, place), None)
    return raster

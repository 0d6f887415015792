"""Pictures of patterns, or of a calibration's stripes, in a projector's own resolution."""

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
from mitsim.core.files import whole_file, whole_folder, write_json
from mitsim.core.job import Cost, Limits
from mitsim.core.manifests import ClosingKind, Patterns, RunManifest
from mitsim.devices.framelist import FrameList
from mitsim.devices.patterns import parse_patterns, stripe_signs
from mitsim.devices.projector import ProjectorModel
from mitsim.devices.sensor import check_exposure, digital_of, load_sensor
from mitsim.devices.session import UNIFORM, halves_in_order
from mitsim.exchange.packed import Run, shots_of

PATTERNS = "patterns.json"
"""Describes each picture, and the grid's place in it."""
SESSION = "session.json"
"""List of a session's frames, as `mitsim calibrate --frames` reads it."""
SQUARE = 0.01
"""Largest logarithm of a cell's width over its height that counts as square; not visible in an image."""
_SECONDS_PER_PIXEL, _PIXEL_BYTES = 2e-8, 3
"""Measured: 6e-9 s for dots:7 in 720 x 1920 pixels, tripled for slow disks. Bytes of cells, picture and file."""
_WHITE = 255
"""Only white and black (0) are shown, so that the projector's gamma has no effect."""


# ---- A projector's raster ----


@dataclass(frozen=True)
class Raster:
    """A projector's pixels; ``aspect`` is a pixel's width on the scene over its height."""

    rows: int
    columns: int
    aspect: float = 1.0

    @classmethod
    def of(cls, projector: str) -> Raster:
        path = locate(projector, "calibration", ".toml", PROJECTOR)
        return cls.of_projector(load_model(path, ProjectorModel).model_dump())

    @classmethod
    def of_projector(cls, model: Mapping[str, Any]) -> Raster:
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
    """Draw every shot of a family to a new folder, `patterns/` and `patterns.json`, whole or not at all.

    ``closing`` adds a picture for the closing frame. Returns `patterns`, `n`, `pictures`, `projector` and `output`.
    MitsimError for an unknown family, or a projector of unknown or too few pixels.
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
    """Draw every shot of a calibration session to a new folder, with a list of its frames.

    The order is that of `mitsim calibrate --frames`. Returns and raises as :func:`draw_family`; MitsimError also if no
    Hadamard matrix has so many rows.
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
    """Return the list of a session's frames in the order of their names; MitsimError for invalid values."""
    sensor = load_sensor(locate(camera, "calibration", ".toml", CAMERA))
    digital = digital_of(sensor, check_exposure(exposure_s)).model_dump(exclude_none=True)
    stated = {"camera": {"name": sensor.name}, "n": n, "signed_capture": signed_capture, "digital": digital}
    return validate(FrameList, stated, "stripes")


# ---- Names of files ----


def frame_name(index: int) -> str:
    return f"frame_{index:05d}.png"


def picture_name(index: int) -> str:
    return f"patterns/pattern_{index:05d}.png"


def draw(
    folder: Path, light: Iterable[npt.NDArray[Any]], count: int, raster: Raster, sides: tuple[int, int], place: str
) -> dict[str, Any]:
    """Write a picture for each of ``count`` shots, and a black and a white one, to `patterns/` in a folder.

    ``light`` yields (n, n') of 0 and 1. Returns `rows`, `columns` and :func:`grid_in`. MitsimError if a cell would have
    no pixel, or the pictures exceed a day or the free memory.
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
    """Return the place of the patterns' grid in a projector's raster: whole pixels a cell, centred.

    The largest cells that are square on the scene to :data:`SQUARE` are used, or else the squarest. MitsimError if a
    cell would have no pixel.

    Returns
    -------
    dict
        `cell`, `cell_columns`: rows and columns of a cell [pixels]; `cell_shape`: its width on the scene over its
        height;
        `first_row`, `first_column` of the first cell.
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
    rows, columns, shape = where["cell"], where["cell_columns"], where["cell_shape"]
    size = f"{rows} pixels a side" if rows == columns else f"{rows} x {columns} pixels"
    if abs(math.log(shape)) > SQUARE:
        return f"{size}, {shape:.3g} times as wide as high on the scene, but square in an image"
    return size if rows == columns else f"{size}, square on the scene"


def pictures_of(patterns: Patterns, place: str) -> Iterator[npt.NDArray[Any]]:
    """Yield the projector's light for each shot, (n, n') of 0 and 1.

    MitsimError for values between, because a projector's gamma would change them.
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
    first = None
    for picture in pictures:
        first = picture if first is None else first
        yield picture
    if closing is not None and first is not None:
        yield first if closing == "first" else np.ones_like(first)


# ---- Content of patterns.json ----


def describe(patterns: Patterns, names: Sequence[str], where: Mapping[str, Any]) -> dict[str, Any]:
    shots = [
        {"file": name, "pattern": picture_name(index), **shot.model_dump(include={"row", "column", "sign"})}
        for index, (name, shot) in enumerate(zip(names, patterns.captures, strict=True))
    ]
    return {"projector": where, **patterns.model_dump(include={"family", "n", "P_L", "P_R"}), "shots": shots}


# ---- One PNG file ----


def write_png(path: Path, values: npt.NDArray[Any]) -> None:
    from PIL import Image

    with whole_file(path) as part:
        Image.fromarray(values).save(part, format="png")


# ---- A run as PNG files ----

_LARGEST = 2**16 - 1


def write_pngs(folder: Path, run: Run, projector: str | None = None) -> tuple[str, ...]:
    """Write the frames of a run, and its patterns as pictures, to a new folder, whole or not at all.

    Returns notes on reading frames and on the size of cells. MitsimError for digital numbers above 16 bits, patterns of
    other values than 0, 1 and -1, or a projector of unknown or too few pixels.
    """
    shots = run.parts[""]
    manifest, source, names = shots.manifest, str(shots.place), list[str]()
    raster = check_pictures(manifest, projector, source)
    rows, columns = (len(matrix) for matrix in manifest.patterns.matrices)
    closing, captures = manifest.closing_frame, manifest.patterns.captures
    again = f"--patterns {folder / PATTERNS} --exposure {manifest.digital.exposure_s!r}"
    with whole_folder(folder) as place:
        pictures = with_closing(pictures_of(manifest.patterns, source), closing.kind if closing else None)
        where = draw(place, pictures, len(captures) + bool(closing), raster, (rows, columns), source)
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
        if (ambient := manifest.ambient_frame) is not None:
            with whole_file(place / "ambient.npy") as part, part.open("wb") as stream:
                np.save(stream, shots.read(ambient.file)[0]["DN"])
            again += f" --ambient-frame {folder / 'ambient.npy'} --ambient-shots {ambient.shots}"
        if closing is not None:
            again += f" --closing-frame {closing.kind} --closing-exposure {closing.exposure_s!r}"
        write_json(place / PATTERNS, describe(manifest.patterns, names[: len(captures)], where))
    note = f"Read again by: mitsim import {folder / 'frames'} {again} --camera NAME --calibration CAL -o RUN"
    return note, f"Patterns in cells of {describe_cells(where)}"


def check_pictures(manifest: RunManifest, projector: str | None, place: str) -> Raster:
    known = manifest.configuration.get("projector_model")
    own = known if isinstance(known, dict) else {}
    raster, sides = Raster.of(projector) if projector else Raster.of_projector(own), manifest.patterns.matrices
    grid_in(raster, (len(sides[0]), len(sides[1])), place)
    next(pictures_of(manifest.patterns, place), None)
    return raster

"""Runs and factors for MATLAB, PyTorch, xarray and as PNG files, and a real FlatCam's calibration from its MATLAB file.

PyTorch and xarray are extras (`pip install mitsim[torch,xarray]`), imported when they are used.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray, read_variables, write_variables
from mitsim.core.colour_files import CALIBRATION, lines_of_planes
from mitsim.core.configuration import CAMERA, PROJECTOR, load_model, locate, validate
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.exr import Channel
from mitsim.core.files import whole_folder, write_json
from mitsim.core.images import write_numbers
from mitsim.core.job import Cost, Limits
from mitsim.core.manifests import SIDES, CalibrationManifest, ClosingKind, Patterns, RunManifest
from mitsim.core.picture_files import ALL, WAVELENGTHS_NM
from mitsim.core.runs import TRUTH, Capture
from mitsim.devices.framelist import FrameList
from mitsim.devices.patterns import parse_patterns, stripe_signs
from mitsim.devices.projector import ProjectorModel
from mitsim.devices.sensor import check_exposure, digital_of, load_sensor
from mitsim.devices.session import UNIFORM, halves_in_order
from mitsim.exchange.capture_list import TURNED
from mitsim.exchange.packed import FACTORS, Calibration, Content, Loaded, Packed, Run, as_channel, shots_of
from mitsim.learn.requests import check_torch
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import POINT_SPREAD, Reconstruction
from mitsim.version import __version__

if TYPE_CHECKING:
    from xarray import Dataset

# -------- MATLAB


def write_matlab(path: Path, run: Run, calibration: Calibration | None) -> tuple[str, ...]:
    """Write a run with the variables of the paper's script, whole or not at all; return notes on omitted parts.

    `phi_left` (P o X) `phi_right`' = `data_coded` - `measBg` in digital numbers, for each pattern P = PL(:, i)
    PR(:, j)' (Zheng & Asif, arXiv 2111.12862, section III-B). `data_coded` and, for signed pairs, `data_negative` are
    (rows, columns, K, K'), `measBg` is (rows, columns). MitsimError for a run that such a file cannot hold.
    """
    shots = run.parts[""]
    manifest, digital = shots.manifest, shots.manifest.digital
    dn_per_rate = digital.gain_dn_per_e * digital.exposure_s
    signs = {abs(shot.sign) for shot in manifest.patterns.captures}
    if len(signs) != 1:
        raise MitsimError(f"{shots.place}: mixes whole shots and signed pairs; use the format hdf5")
    left, right = manifest.patterns.matrices
    stacks: dict[int, FloatArray] = {}
    for shot, channels, _ in shots_of(shots):
        dn = channels["DN"]
        if not stacks:
            shape = *dn.shape, left.shape[1], right.shape[1]
            stacks = {sign: np.empty(shape, order="F") for sign in ((-1, 1) if signs == {1} else (0,))}
        stacks[shot.sign][:, :, shot.row, shot.column] = dn
    others = {name: shots.read(file)[0]["DN"] for name, file in manifest.others.items()}
    variables: dict[str, Any] = {"run_manifest": shots.text, "PL": left, "PR": right, **others}
    if signs == {1}:
        variables |= {"data_coded": stacks[1] - stacks[-1], "data_negative": stacks[-1], "measBg": np.zeros(dn.shape)}
    else:
        dark = digital.black_level_dn + digital.dark_current_e_per_s * dn_per_rate
        background = others["ambient"].astype(np.float64) if "ambient" in others else np.full(dn.shape, dark)
        variables |= {"data_coded": stacks[0], "measBg": background}
    if TRUTH in shots.names:
        channels, metadata = shots.read(TRUTH)
        variables["truth"] = channels["reflectance"]
        variables["truth_board_reflectance"] = float(metadata.get("board_reflectance", math.nan))
        if "standard_error" in channels:
            variables["truth_standard_error"] = channels["standard_error"]
    if calibration:
        factors = calibration.parts[""]
        for side, file in zip(SIDES, FACTORS, strict=True):  # [sqrt(electrons / s)] in sqrt(DN)
            factor = factors.read(file)[0]["factor"].astype(np.float64)
            variables[f"phi_{side}"] = factor * math.sqrt(dn_per_rate)
        variables["calibration_manifest"] = factors.text
    write_variables(path, variables)
    without = () if calibration else ("phi_left and phi_right are left out: no calibration was given",)
    return (*without, "Left out: expected electrons of the frames")


@contextmanager
def load_flatcam(path: Path, channel: str | None) -> Iterator[Loaded]:
    """Read one plane of a real FlatCam, or `all`, from its calibration file (Asif et al. 2017, arXiv 1509.00116).

    A plane of the colour sensor without the means of its rows and columns is P1 X Q1^T. The manifests' configuration
    holds the angle by which frames are turned first. MitsimError for a file without that plane.
    """
    if channel is None:
        problem = f"is not given, and {path} is read as a FlatCam's calibration, by planes"
        raise ArgumentError("channel", f"{problem}; give it, and take runs back by the format hdf5")
    variables = read_variables(path)
    angle = float(np.ravel(variables.get("angle", 0.0))[0])

    def matrix(name: str) -> Channel:
        values = np.asarray(variables.get(name))
        if values.ndim != 2 or values.dtype.kind not in "uif" or values.shape[0] < values.shape[1]:
            given = f"is {values.dtype} of shape {values.shape}" if name in variables else "is missing"
            raise MitsimError(f"{path}: {name} {given}; a matrix of sensor pixels x fewer scene pixels is needed")
        return as_channel(values.astype(np.float32), name, path)

    def part(plane: str) -> Packed[CalibrationManifest]:
        sides = {name: matrix(f"{stem}{plane}") for name, stem in zip(FACTORS, ("P1", "Q1"), strict=True)}
        manifest = CalibrationManifest(
            camera={"name": path.stem, "channel": plane}, centre=True, configuration={TURNED: angle} if angle else {}
        )
        return Packed(manifest, "", FACTORS, lambda name: ({"factor": sides[name]}, {}), path)

    if channel != ALL:
        yield None, Content({"": part(channel)})
        return
    colours = lines_of_planes(CALIBRATION, WAVELENGTHS_NM)
    text = json.dumps(colours.model_dump(mode="json"))
    yield None, Content({name: part(name) for name in colours.names}, colours, text)


# -------- Tensors of PyTorch


def write_torch(path: Path, run: Run, calibration: Calibration | None) -> tuple[str, ...]:
    """Write a run as tensors that `torch.load` reads with `weights_only`, whole or not at all.

    `y` (K K', rows, columns) are electrons a second without ambient light, patterns row-major over (i, j).
    MitsimError if PyTorch is not installed or a frame cannot be read.
    """
    check_torch("the format torch needs", "torch")
    import torch

    from mitsim.learn.networks import write_tensors

    part = run.parts[""]
    shots = Capture(part.manifest, None, {file: part.read(file) for file in dict.fromkeys(part.names)})
    left, right = shots.patterns
    frames = {(each.row, each.column): each.frame for each in shots.pattern_measurements()}
    arrays = {"y": np.stack([frames[place] for place in sorted(frames)]), "P_L": left, "P_R": right}
    if TRUTH in part.names:
        arrays["x"] = part.read(TRUTH)[0]["reflectance"][None].astype(np.float64)
    if calibration is not None:
        factors = (calibration.parts[""].read(file)[0]["factor"] for file in FACTORS)
        arrays.update({side: np.asarray(factor, np.float64) for side, factor in zip(SIDES, factors, strict=True)})
    tensors = {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in arrays.items()}
    write_tensors(path, tensors)
    return ()


# -------- Labelled arrays of xarray, after the CF conventions

Labels = dict[str, tuple[Any, ...]]
"""Dimensions, values and attributes by name, as xarray requires."""


def label_capture(shots: Capture) -> Dataset:
    """Label frames (shot, row, column), and expected electrons and truth if known; MitsimError without xarray."""
    captures = shots.manifest.patterns.captures
    frame = ("shot", "row", "column")
    numbers: Labels = {"dn": (frame, shots.dn, _attributes("DN", "digital number"))}
    if shots.electrons is not None:
        numbers["electrons"] = (frame, shots.electrons, _attributes("electron", "expected photoelectrons"))
    if shots.truth is not None:
        scene = ("scene_row", "scene_column")
        numbers["truth"] = (scene, shots.truth, _attributes("1", "apparent reflectance, relative to the board"))
        if (error := shots.truth_standard_error) is not None:
            numbers["truth_standard_error"] = (scene, error, _attributes("1", "its standard error"))
    places: Labels = {
        "shot": ("shot", np.arange(len(captures)), _attributes("1", "number of the frame")),
        "pattern_row": ("shot", [each.row for each in captures], _attributes("1", "index i of the pattern")),
        "pattern_column": ("shot", [each.column for each in captures], _attributes("1", "index j of the pattern")),
        "sign": ("shot", [each.sign for each in captures], _attributes("1", "half of a signed pattern; 0: unsigned")),
    }
    places |= _sensor_places(shots.manifest.camera, shots.dn.shape[1:])
    facts: dict[str, Any] = {"exposure_s": shots.exposure_s, "fingerprint": shots.fingerprint}
    if shots.manifest.patterns.family is not None:
        facts["patterns"] = shots.manifest.patterns.family
    if shots.truth_board is not None:
        facts["board_reflectance"] = shots.truth_board
    return _dataset("capture", numbers, places, facts)


def label_factors(factors: Factors) -> Dataset:
    numbers: Labels = {
        name: ((axis, f"scene_{axis}"), side, _attributes("electron0.5 s-0.5", f"factor of the {axis}s"))
        for name, axis, side in (("left", "row", factors.left), ("right", "column", factors.right))
    }
    places = _scene_places(factors) | _sensor_places(factors.manifest.camera, (len(factors.left), len(factors.right)))
    facts = {"status": str(factors.status), "condition": factors.condition, "fingerprint": factors.fingerprint}
    return _dataset("calibration", numbers, places, facts)


def label_image(image: Reconstruction, factors: Factors | None = None) -> Dataset:
    """Label an image; ``factors`` provide the positions of its pixels.

    MitsimError without xarray, and for factors of another number of pixels.
    """
    scene, places = ("scene_row", "scene_column"), Labels()
    if factors is not None:
        sides = factors.left.shape[1], factors.right.shape[1]
        if sides != image.image.shape:
            raise MitsimError(
                f"factors are of {sides[0]} x {sides[1]} scene pixels, but the image has {image.image.shape[0]} x "
                f"{image.image.shape[1]}; give those that it was solved with"
            )
        places = _scene_places(factors)
    rate = POINT_SPREAD in image.inputs
    words = _attributes("electron s-1", "light") if rate else _attributes("1", "reflectance, relative to the board")
    numbers: Labels = {"image": (scene, image.image, words)}
    if image.uncertainty is not None:
        numbers["uncertainty"] = (scene, image.uncertainty, _attributes(words["units"], "standard uncertainty"))
    if image.depths is not None:
        numbers["depth"] = (scene, image.depths.mm, _attributes("mm", "depth"))
    facts = {"status": str(image.status), "method": str(image.inputs.get("method")), "lambda": image.lam}
    return _dataset("image", numbers, places, {**facts, "residual": image.residual})


def _attributes(units: str, long_name: str) -> dict[str, str]:
    return {"units": units, "long_name": long_name}


def _dataset(title: str, numbers: Labels, places: Labels, facts: Mapping[str, Any]) -> Dataset:
    try:
        from xarray import Dataset
    except ImportError:
        raise MitsimError("xarray is not installed; type: pip install 'mitsim[xarray]'") from None
    about = {"Conventions": "CF-1.11", "title": f"mitsim {title}", "source": f"mitsim {__version__}"}
    return Dataset(numbers, places, {**about, **facts})


def _sensor_places(camera: Mapping[str, Any], shape: tuple[int, ...]) -> Labels:
    known, found = camera.get("geometry"), Labels()
    for letter, axis, count in zip("yx", ("row", "column"), shape, strict=True):
        if isinstance(known, Mapping) and "pixel_pitch" in known:
            row = axis == "row"
            pitch = (known.get("row_pitch") if row else None) or known["pixel_pitch"]
            whole = known.get(f"{axis}s") or known["pixels"]
            first = 0 if not known.get("roi") else known["roi"][0 if row else 1]
            said = _attributes(
                "mm", f"place of the {axis} on the sensor, from the optical axis, growing with its number"
            )
            found[letter] = axis, pitch * (first + np.arange(count) - (whole - 1) / 2), said
    return found


def _scene_places(factors: Factors) -> Labels:
    parallax, found = factors.manifest.parallax, Labels()
    if parallax is None:
        return found
    sides = (("row", "y", factors.left, parallax.row_tan), ("column", "x", factors.right, parallax.column_tan))
    for axis, letter, side, (near, far) in sides:
        parts: npt.NDArray[np.float64] = (np.arange(side.shape[1]) + 0.5) / side.shape[1]
        said = _attributes("mm", f"place of the scene's {axis} at {parallax.depth_mm:g} mm, from the frame's middle")
        found[f"scene_{letter}"] = f"scene_{axis}", parallax.depth_mm * (near + (far - near) * parts), said
    return found


# -------- Pictures of patterns in a projector's own resolution

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
_LARGEST = 2**16 - 1


class Raster(NamedTuple):
    """A projector's pixels; ``aspect`` is a pixel's width on the scene over its height."""

    rows: int
    columns: int
    aspect: float = 1.0


def raster_of(projector: str | None, recorded: Any = None) -> Raster:
    """Return the raster of a ``projector``, by name or file, or else of a run's ``recorded`` model."""
    if projector:
        path = locate(projector, "calibration", ".toml", PROJECTOR)
        recorded = load_model(path, ProjectorModel).model_dump()
    if not isinstance(recorded, dict) or not recorded:
        raise ArgumentError("projector", "is not known of a run of imported frames; give its name or file")
    rows, columns = recorded.get("rows"), recorded.get("columns")
    if not (isinstance(rows, int) and isinstance(columns, int)):
        raise ArgumentError("projector", "does not say its rows and columns; give one that does")
    return Raster(rows, columns, float(recorded.get("pixel_aspect", 1.0)))


def draw_family(
    folder: Path, name: str, n: int, projector: str, seed: int = 0, closing: ClosingKind | None = None
) -> dict[str, Any]:
    """Draw every shot of a family to a new folder, `patterns/` and `patterns.json`, whole or not at all.

    ``closing`` adds a picture for the closing frame. Returns `patterns`, `n`, `pictures`, `projector` and `output`.
    MitsimError for an unknown family, or a projector of unknown or too few pixels.
    """
    known = load_model(locate(projector, "calibration", ".toml", PROJECTOR), ProjectorModel)
    family = parse_patterns(name, n, seed, known.grey_light)
    patterns = Patterns.of(family, [frame_name(index) for index in range(len(family.shots))])
    where = grid_in(raster_of(projector), (n, n), f"projector {projector}")
    shown: Iterable[npt.NDArray[Any]] = patterns_light(patterns, f"patterns {name}", closing)
    if family.grey:  # by level, because the projector makes the light
        levels = family.grey.levels
        last = levels[:1] if closing == "first" else np.full((int(closing is not None), n, n), _WHITE)
        shown = (each / _WHITE for each in chain(levels, last))
    with whole_folder(folder) as place:
        count = draw(place, shown, where, describe(patterns), closing)
    return {"patterns": name, "n": n, "pictures": count, "projector": where, "output": str(folder)}


def draw_stripes(
    folder: Path, n: int, projector: str, camera: str, exposure_s: float, signed_capture: str
) -> dict[str, Any]:
    """Draw every shot of a calibration session to a new folder, with a list of its frames.

    The order is that of `mitsim calibrate --frames`. Returns and raises as :func:`draw_family`; MitsimError also for
    invalid values, and if no Hadamard matrix has so many rows.
    """
    sensor = load_sensor(locate(camera, "calibration", ".toml", CAMERA))
    digital = digital_of(sensor, check_exposure(exposure_s)).model_dump(exclude_none=True)
    stated = {"camera": {"name": sensor.name}, "n": n, "signed_capture": signed_capture, "digital": digital}
    listed = validate(FrameList, stated, "stripes")
    signs, light, shots = stripe_signs(n), list[npt.NDArray[Any]](), list[dict[str, Any]]()
    for number, (side, index, sign) in enumerate(halves_in_order(signs.shape[1], signed_capture == "pair")):
        stripes = signs[:, index, None] if side == "horizontal" else signs[None, :, index]
        light.append(np.broadcast_to(np.ones((1, 1)) if sign == UNIFORM else (1 + sign * stripes) / 2, (n, n)))
        shots.append({**named(number), "side": side, "index": index, "sign": sign})
    where = grid_in(raster_of(projector), (n, n), f"projector {projector}")
    with whole_folder(folder) as place:
        draw(place, light, where, {"shots": shots})
        write_json(place / SESSION, listed.model_dump(mode="json", exclude_defaults=True))
    return {"patterns": "stripes", "n": n, "pictures": len(light), "projector": where, "output": str(folder)}


def frame_name(index: int) -> str:
    return f"frame_{index:05d}.png"


def named(index: int) -> dict[str, str]:
    """Return the names of a shot's frame and of its picture."""
    return {"file": frame_name(index), "pattern": f"patterns/pattern_{index:05d}.png"}


def draw(folder: Path, light: Iterable[npt.NDArray[Any]], where: Any, about: Any, closing: str | None = None) -> int:
    """Write a picture for each of the shots in ``about``, and a black and a white one, to `patterns/` in a folder.

    ``light`` yields (n, n') of 0 and 1, shown ``where`` :func:`grid_in` says; `patterns.json` has both. Returns the
    number of pictures. MitsimError if they exceed a day or the free memory.
    """
    pixels, count = where["rows"] * where["columns"], len(about["shots"]) + bool(closing)
    cost = Cost(count * pixels * _SECONDS_PER_PIXEL, _PIXEL_BYTES * pixels)
    cost.check(f"{count} pictures of {where['rows']} x {where['columns']} pixels", Limits())
    (folder / "patterns").mkdir()
    shot, level = np.zeros(()), {"black": 0, "white": 1}
    for index, shot in enumerate(light):
        _draw_picture(folder / named(index)["pattern"], shot, where)
    for name in level:
        _draw_picture(folder / "patterns" / f"{name}.png", np.full(shot.shape, level[name]), where)
    write_json(folder / PATTERNS, {"projector": where, **about})
    return count


def _draw_picture(path: Path, light: npt.NDArray[Any], where: Mapping[str, Any]) -> None:
    cells = (_WHITE * light).astype(np.uint8).repeat(where["cell"], axis=0).repeat(where["cell_columns"], axis=1)
    picture = np.zeros((where["rows"], where["columns"]), np.uint8)
    picture[where["first_row"] :, where["first_column"] :][: cells.shape[0], : cells.shape[1]] = cells
    write_numbers(path, picture)


def grid_in(raster: Raster, sides: tuple[int, int], place: str) -> dict[str, Any]:
    """Return the place of the patterns' grid in a projector's raster: whole pixels a cell, centred.

    The largest cells that are square on the scene to :data:`SQUARE` are used, or else the squarest. MitsimError if a
    cell would have no pixel.

    Returns
    -------
    dict
        `rows`, `columns` of the raster; `cell`, `cell_columns`: rows and columns of a cell [pixels]; `cell_shape`: its
        width on the scene over its height; `first_row`, `first_column` of the first cell.
    """
    most = raster.rows // sides[0], raster.columns // sides[1]
    if min(most) < 1:
        raise MitsimError(
            f"{place}: patterns of {sides[0]} x {sides[1]} pixels do not fit a projector of {raster.rows} rows x "
            f"{raster.columns} columns; give a larger projector"
        )
    sizes = [(rows, min(max(round(rows / raster.aspect), 1), most[1])) for rows in range(most[0], 0, -1)]

    def off(size: tuple[int, int]) -> float:
        return abs(math.log(size[1] * raster.aspect / size[0]))

    rows, columns = next((size for size in sizes if off(size) <= SQUARE), min(sizes, key=off))
    return {
        "rows": raster.rows,
        "columns": raster.columns,
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


def patterns_light(patterns: Patterns, place: str, closing: ClosingKind | None = None) -> Iterator[npt.NDArray[Any]]:
    """Yield the projector's light for each shot and for a ``closing`` frame, (n, n') of 0 and 1.

    MitsimError for values between, because a projector's gamma would change them.
    """
    left, right = patterns.matrices
    if not np.isin(np.concatenate([left.ravel(), right.ravel()]), (-1, 0, 1)).all():
        raise MitsimError(
            f"{place}: patterns have values other than 0, 1 and -1, whose light a projector's gamma changes"
        )
    first = None
    for shot in patterns.captures:
        pattern = np.outer(left[:, shot.row], right[:, shot.column])
        light = (1 + shot.sign * pattern) / 2 if shot.sign else pattern
        if not np.isin(light, (0, 1)).all():
            raise MitsimError(f"{place}: {shot.file} shows light other than 0 and 1, which a projector's gamma changes")
        first = light if first is None else first
        yield light
    if closing is not None and first is not None:
        yield first if closing == "first" else np.ones_like(first)


def describe(patterns: Patterns) -> dict[str, Any]:
    shown = [shot.model_dump(include={"row", "column", "sign"}) for shot in patterns.captures]
    shots = [{**named(index), **shot} for index, shot in enumerate(shown)]
    return {**patterns.model_dump(include={"family", "n", "P_L", "P_R"}), "shots": shots}


def write_pngs(folder: Path, run: Run, projector: str | None = None) -> tuple[str, ...]:
    """Write the frames of a run, and its patterns as pictures, to a new folder, whole or not at all.

    Returns notes on reading frames and on the size of cells. MitsimError for digital numbers above 16 bits, patterns of
    other values than 0, 1 and -1, or a projector of unknown or too few pixels.
    """
    shots = run.parts[""]
    manifest, source = shots.manifest, str(shots.place)
    where, closing = check_pictures(manifest, projector, source), manifest.closing_frame
    again = f"--patterns {folder / PATTERNS} --exposure {manifest.digital.exposure_s!r}"
    with whole_folder(folder) as place:
        kind = closing.kind if closing else None
        draw(place, patterns_light(manifest.patterns, source, kind), where, describe(manifest.patterns), kind)
        (place / "frames").mkdir()
        frames = ((shot.file, channels["DN"]) for shot, channels, _ in shots_of(shots))
        last = [(closing.file, shots.read(closing.file)[0]["DN"])] if closing else []
        for index, (file, dn) in enumerate(chain(frames, last)):
            if dn.dtype != np.uint32 or int(dn.max()) > _LARGEST:
                raise MitsimError(
                    f"{shots.place / file}: has {dn.dtype} numbers up to {dn.max():g}, and PNG holds whole ones up "
                    f"to {_LARGEST}; use the format hdf5"
                )
            write_numbers(place / "frames" / frame_name(index), dn.astype(np.uint16))
        if (ambient := manifest.ambient_frame) is not None:
            write_numbers(place / "ambient.npy", shots.read(ambient.file)[0]["DN"])
            again += f" --ambient-frame {folder / 'ambient.npy'} --ambient-shots {ambient.shots}"
        if closing is not None:
            again += f" --closing-frame {closing.kind} --closing-exposure {closing.exposure_s!r}"
    note = f"Import again by: mitsim import {folder / 'frames'} {again} --camera NAME --calibration CAL -o RUN"
    return note, f"Patterns in cells of {describe_cells(where)}"


def check_pictures(manifest: RunManifest, projector: str | None, place: str) -> dict[str, Any]:
    left, right = manifest.patterns.matrices
    where = grid_in(raster_of(projector, manifest.configuration.get("projector_model")), (len(left), len(right)), place)
    next(patterns_light(manifest.patterns, place), None)
    return where

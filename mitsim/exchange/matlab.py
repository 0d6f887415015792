"""A run and its calibration in one MATLAB file, with the variables of the paper's public script.

`phi_left` (P o X) `phi_right`' = `data_coded` - `measBg` in digital numbers, for each pattern P = PL(:, i) PR(:, j)'
(Zheng & Asif, arXiv 2111.12862, section III-B). Written files are of version 5; version 7.3 is read, too. In the
calibration of a real FlatCam (Asif et al. 2017, arXiv 1509.00116), a plane of the colour sensor without the means of
its rows and columns is P1 X Q1^T.
"""

from __future__ import annotations

import json
import math
import operator
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mitsim.core import manifests
from mitsim.core.arrays import FloatArray, checked_hdf5, hdf5_errors, is_hdf5, read_variables, write_variables
from mitsim.core.errors import MitsimError, cut
from mitsim.core.exr import Channel, Channels, Metadata
from mitsim.core.imagelist import ALL, WAVELENGTHS_NM, check_channel
from mitsim.core.manifests import SIDES, CalibrationManifest, Digital, RunManifest, lines_of_planes
from mitsim.core.runs import TRUTH
from mitsim.exchange import packed
from mitsim.exchange.capture_list import TURNED
from mitsim.exchange.packed import FACTORS, Calibration, Content, Loaded, Packed, Run, as_channel, shots_of, unpack

if TYPE_CHECKING:
    import h5py

ELECTRONS = "expected electrons of the frames"
"""Part of a simulated run that such a file does not hold."""

# -------- The variables of a file


@dataclass(frozen=True, eq=False)
class MatFile:
    """Variables of a MATLAB file, or of one line in it, checked when they are read."""

    path: Path
    values: Mapping[str, Any]

    def __contains__(self, name: str) -> bool:
        return name in self.values

    def text(self, name: str) -> str:
        value = np.asarray(self.values.get(name))
        if value.dtype.kind != "U" or value.size != 1:
            raise MitsimError(
                f"{self.path}: has no text {name}, so it is not of `mitsim export`; it holds "
                f"{', '.join(key for key in self.values if not key.startswith('__'))}"
            )
        return str(value.item())

    def array(self, name: str, shape: tuple[int, ...]) -> npt.NDArray[Any]:
        """Return an array in ``shape``, because MATLAB drops trailing axes of length 1, or raise MitsimError."""
        array = np.asarray(self.values.get(name))
        if array.dtype.kind not in "uif" or array.size != math.prod(shape):
            reported = f"is {array.dtype} of shape {array.shape}" if name in self else "is missing"
            raise MitsimError(f"{self.path}: {name} {reported}; numbers of shape {shape} are needed")
        return array.reshape(shape, order="F")

    def matrix(self, name: str) -> FloatArray:
        matrix = np.asarray(self.values.get(name))
        if matrix.ndim != 2 or matrix.dtype.kind not in "uif":
            reported = "no matrix of numbers" if name in self else "missing"
            raise MitsimError(f"{self.path}: {name} is {reported}; write it again")
        return matrix.astype(np.float64)

    def image(self, name: str, scale: float = 1.0) -> Channel:
        """Return a matrix, divided by ``scale``, as a float32 channel."""
        # Rounding in double precision is far below half of the last digit in single: the number is the one written.
        return as_channel((self.matrix(name) / scale).astype(np.float32), name, self.path)

    def by_line(self, names: Sequence[str]) -> dict[str, MatFile]:
        return {
            name: MatFile(
                self.path, {key.removesuffix(end): each for key, each in self.values.items() if key.endswith(end)}
            )
            for name, end in endings(names, self.path).items()
        }


_CLASSES = {"char", "single", "double", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}


def variables_in(path: Path) -> dict[str, Any]:
    """Return the real arrays and the texts of a MATLAB file of version 5 or 7.3; other classes are skipped.

    MitsimError for a file that is missing, damaged, of version 4, or does not fit into memory.
    """
    if not is_hdf5(path):
        return read_variables(path)
    import h5py

    found = dict[str, Any]()

    def kind(dataset: h5py.Dataset) -> str:
        held = dataset.name.count("/") > 1 or dataset.dtype.kind not in "uif" or "MATLAB_empty" in dataset.attrs
        return "" if held else bytes(dataset.attrs.get("MATLAB_class", b"double")).decode("ascii")

    with hdf5_errors(path), checked_hdf5(path, lambda each: 2.0 * (kind(each) in _CLASSES)) as file:
        for name in file:
            # Groups are structures, sparse matrices, or content of cells.
            if isinstance(file[name], h5py.Dataset) and (known := kind(file[name])) in _CLASSES:
                values = packed.hdf5_item(file, name, path)[()].T  # MATLAB stores columns first
                # Texts are stored as numbers of 16 bits.
                text = known == "char"
                found[name] = np.array(["".join(map(chr, values.ravel("F").tolist()))]) if text else values
    return found


COLOURED, FILTERED, _CALIBRATED = "colour_run", "mosaic_run", "colour_calibration"
"""Variables with the colour.json of a coloured run, of one behind filters, and of a calibration."""
_LONGEST_LINE = 31
"""MATLAB's names have at most 63 letters; truth_board_reflectance_ takes half of them."""


def endings(names: Sequence[str], path: Path) -> dict[str, str]:
    """Return the endings of each line's variables; "" for a run without lines.

    MitsimError for a name that no variable can end in, or two that MATLAB does not distinguish.
    """
    ends = {name: name and "_" + re.sub(r"[^0-9A-Za-z_]", "_", name) for name in names}
    for name in filter(None, names):
        # Beginning with a digit, they are no end of another variable: truth_standard_error is not of a line `error`.
        if not (name[0].isdigit() and len(name) <= _LONGEST_LINE) or [*ends.values()].count(ends[name]) > 1:
            raise MitsimError(
                f"{path}: a line is called {cut(name)}, which no variable of MATLAB can end in; use the format hdf5"
            )
    return ends


def _dn_per_rate(digital: Digital) -> float:
    return digital.gain_dn_per_e * digital.exposure_s


# -------- Writing the paper's variables


def write_matlab(path: Path, run: Run, calibration: Calibration | None) -> tuple[str, ...]:
    """Write a run with the paper's variables, whole or not at all; return notes on omitted parts.

    With several lines, variables end in the line's name: `phi_left_638nm`. Behind colour filters only truths and
    factors do, because the frames belong to all lines, and `weights` (4, lines) is the light that each filter passes.
    MitsimError for a run that such a file cannot hold.
    """
    variables: dict[str, Any] = {}

    def add_truth(channels: Channels, metadata: Metadata, end: str) -> None:
        variables[f"truth{end}"] = channels["reflectance"]
        variables[f"truth_board_reflectance{end}"] = float(metadata.get("board_reflectance", math.nan))
        if "standard_error" in channels:
            variables[f"truth_standard_error{end}"] = channels["standard_error"]

    for name, end in {"": "", **endings(run.names, path)}.items():
        if name in run.parts:
            shots = run.parts[name]
            variables |= {f"{key}{end}": values for key, values in _run_variables(shots).items()}
            if TRUTH in shots.names:
                add_truth(*shots.read(TRUTH), end)
        elif name in run.truths:
            add_truth(*run.truths[name], end)
        if calibration and name in calibration.parts:
            factors, root = calibration.parts[name], math.sqrt(_dn_per_rate(run.of_line(name).manifest.digital))
            for side, file in zip(SIDES, FACTORS, strict=True):  # [sqrt(electrons / s)] in sqrt(DN)
                variables[f"phi_{side}{end}"] = factors.read(file)[0]["factor"].astype(np.float64) * root
            variables[f"calibration_manifest{end}"] = factors.text
    if run.colours:
        variables[FILTERED if run.filters else COLOURED] = run.text
    if run.filters:
        variables["weights"] = np.array(run.filters.weights)
    if calibration and calibration.colours:
        variables[_CALIBRATED] = calibration.text
    write_variables(path, variables)
    without = () if calibration else ("phi_left and phi_right are left out: no calibration was given",)
    return (*without, f"Left out: {ELECTRONS}")


def _run_variables(run: Packed[RunManifest]) -> dict[str, Any]:
    """Return manifest, patterns, other frames, and the frames of a run by name.

    `data_coded` and, for signed pairs, `data_negative` are (rows, columns, K, K'), `measBg` is (rows, columns).
    """
    manifest, digital = run.manifest, run.manifest.digital
    signs = {abs(shot.sign) for shot in manifest.patterns.captures}
    if len(signs) != 1:
        raise MitsimError(f"{run.place}: mixes whole shots and signed pairs; use the format hdf5")
    left, right = manifest.patterns.matrices
    stacks: dict[int, FloatArray] = {}
    for shot, channels, _ in shots_of(run):
        dn = channels["DN"]
        if not stacks:
            shape = *dn.shape, left.shape[1], right.shape[1]
            stacks = {sign: np.empty(shape, order="F") for sign in ((-1, 1) if signs == {1} else (0,))}
        stacks[shot.sign][:, :, shot.row, shot.column] = dn
    others = {name: run.read(file)[0]["DN"] for name, file in manifest.others.items()}
    variables = {"run_manifest": run.text, "PL": left, "PR": right, "dn_class": dn.dtype.name, **others}
    if signs == {1}:
        difference = stacks[1] - stacks[-1]
        if not np.array_equal(difference + stacks[-1], stacks[1]):
            raise MitsimError(
                f"{run.place}: differences of its pairs have more digits than a double; use the format hdf5"
            )
        return {**variables, "data_coded": difference, "data_negative": stacks[-1], "measBg": np.zeros(dn.shape)}
    dark = digital.black_level_dn + digital.dark_current_e_per_s * _dn_per_rate(digital)
    background = others["ambient"].astype(np.float64) if "ambient" in others else np.full(dn.shape, dark)
    return {**variables, "data_coded": stacks[0], "measBg": background}


# -------- Reading


@contextmanager
def load_mat(path: Path, channel: str | None) -> Iterator[Loaded]:
    """Read a MATLAB file of `mitsim export`, or with a ``channel`` the calibration of a real FlatCam."""
    if channel is not None:
        yield None, flatcam_calibration(path, channel), ()
        return
    file = MatFile(path, variables_in(path))
    if COLOURED in file:
        text = file.text(COLOURED)
        colours = packed.unpack_colours(text, manifests.RUN, path)
        lines = file.by_line(colours.names)
        run = Content({name: _run_in(own) for name, own in lines.items()}, colours, text)
    elif FILTERED in file:
        shots, text = _run_in(file), file.text(FILTERED)
        colours = packed.unpack_colours(text, manifests.MOSAIC, path, shots.names)
        lines = file.by_line(colours.names)
        truths = {name: _truth_in(own) for name, own in lines.items() if "truth" in own}
        run = Content({"": shots}, colours, text, truths)
    else:
        run, lines = Content({"": _run_in(file)}), {"": file}
    parts = {
        name: _calibration_in(own, run.of_line(name).manifest.digital)
        for name, own in lines.items()
        if "calibration_manifest" in own
    }
    calibration = None
    if not run.colours and parts:
        calibration = Content(parts)
    elif run.colours and _CALIBRATED in file:
        text = file.text(_CALIBRATED)
        colours = packed.unpack_colours(text, manifests.CALIBRATION, path)
        if {*parts} != {*colours.names}:
            raise MitsimError(f"{path}: has calibrations of {', '.join(parts)}, not of {', '.join(colours.names)}")
        calibration = Content(parts, colours, text)
    yield run, calibration, (ELECTRONS,)


def _run_in(own: MatFile) -> Packed[RunManifest]:
    text = own.text("run_manifest")
    manifest = unpack(text, RunManifest, own.path)
    ambient, closing = manifest.ambient_frame, manifest.closing_frame
    shots = {shot.file: shot for shot in manifest.patterns.captures}
    kind = np.float32 if own.text("dn_class") == "float32" else np.uint32
    coded = np.asarray(own.values.get("data_coded"))
    if coded.ndim < 2:
        raise MitsimError(f"{own.path}: data_coded is missing, or no frames; export it again")
    shape = *coded.shape[:2], *(matrix.shape[1] for matrix in manifest.patterns.matrices)
    data = own.array("data_coded", shape)
    stacks = {0: data}
    if any(shot.sign for shot in shots.values()):
        negative = own.array("data_negative", shape)
        stacks = {1: data + negative, -1: negative}

    def exactly(values: npt.NDArray[Any], name: str) -> dict[str, Channel]:
        with np.errstate(invalid="ignore"):
            digital = np.asarray(values).astype(kind)
        if not np.array_equal(digital.astype(np.float64), values):
            raise MitsimError(f"{own.path}: {name} has numbers that are no {np.dtype(kind).name}; export it again")
        return {"DN": as_channel(digital, name, own.path)}

    def read(name: str) -> tuple[Channels, Metadata]:
        known: Metadata = {"exposure_s": manifest.digital.exposure_s}
        if name in shots:
            shot = shots[name]
            place: Metadata = {"row": shot.row, "column": shot.column, "sign": shot.sign}
            return exactly(stacks[shot.sign][:, :, shot.row, shot.column], name), {**place, **known}
        if ambient is not None and name == ambient.file:
            return {"DN": own.image("ambient")}, {"shots": ambient.shots, **known}
        if closing is not None and name == closing.file:
            return exactly(own.matrix("closing"), name), {"exposure_s": closing.exposure_s}
        return _truth_in(own)

    names = (*shots, *manifest.others.values(), *((TRUTH,) if "truth" in own else ()))
    return Packed(manifest, text, names, read, own.path)


def _truth_in(own: MatFile) -> tuple[Channels, Metadata]:
    channels = {"reflectance": own.image("truth")}
    if "truth_standard_error" in own:
        own.array("truth_standard_error", channels["reflectance"].shape)
        channels["standard_error"] = own.image("truth_standard_error")
    board = math.nan
    if "truth_board_reflectance" in own:
        board = float(own.array("truth_board_reflectance", (1,))[0])
    return channels, {} if math.isnan(board) else {"board_reflectance": board}


def _calibration_in(own: MatFile, digital: Digital) -> Packed[CalibrationManifest]:
    """Return the calibration in the unit of `phi_left` and `phi_right`."""
    text = own.text("calibration_manifest")
    manifest = unpack(text, CalibrationManifest, own.path)
    metadata: Metadata = {"unit": "sqrt(e-/s)"}
    if manifest.board_reflectance is not None:
        metadata = {**metadata, "reflectance": manifest.board_reflectance}
    root = math.sqrt(_dn_per_rate(digital))

    def read(name: str) -> tuple[Channels, Metadata]:
        return {"factor": own.image(f"phi_{Path(name).stem}", root)}, metadata

    return Packed(manifest, text, FACTORS, read, own.path)


def flatcam_calibration(path: Path, channel: str) -> Calibration:
    """Return the factors of one plane of a real FlatCam, or of `all`, from its calibration file.

    The manifests' configuration holds the angle by which frames are turned first. MitsimError for a file without that
    plane, or with rows and columns exchanged.
    """
    check_channel(channel)
    file = MatFile(path, {"angle": [[0.0]], **variables_in(path)})
    angle = float(file.matrix("angle")[0, 0])
    size = tuple(map(int, file.matrix("cSize").ravel())) if "cSize" in file else ()

    def part(plane: str) -> Packed[CalibrationManifest]:
        sides = {name: file.image(f"{stem}{plane}") for name, stem in zip(FACTORS, ("P1", "Q1"), strict=True)}
        pixels, scene = zip(*(side.shape for side in sides.values()), strict=True)
        if size != pixels and all(map(operator.lt, pixels, scene)):
            raise MitsimError(
                f"{path}: P1{plane} and Q1{plane} have {pixels[0]} and {pixels[1]} pixels for {scene[0]} and "
                f"{scene[1]} of the scene: rows and columns are exchanged; a file of version 7.3 holds columns first"
            )
        manifest = CalibrationManifest(
            camera={"name": path.stem, "channel": plane}, centre=True, configuration={TURNED: angle} if angle else {}
        )
        return Packed(manifest, "", FACTORS, lambda name: ({"factor": sides[name]}, {}), path)

    if channel != ALL:
        return Content({"": part(channel)})
    colours = lines_of_planes(manifests.CALIBRATION, WAVELENGTHS_NM)
    text = json.dumps(colours.model_dump(mode="json"))
    return Content({name: part(name) for name in colours.names}, colours, text)

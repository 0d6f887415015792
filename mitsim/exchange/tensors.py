"""Runs and factors in, tensors out: a file for PyTorch.

PyTorch is an extra (`pip install mitsim[torch]`), imported when it is used.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError, cut, reason_of
from mitsim.core.files import whole_file
from mitsim.core.manifests import SIDES, RunManifest
from mitsim.core.runs import TRUTH, Capture
from mitsim.exchange.packed import FACTORS, Calibration, Packed, Run

_PATTERNS = ("P_L", "P_R")
"""Tensors of the patterns' factors."""
Tensor = Any
"""A torch.Tensor."""


def extra(name: str) -> Any:
    """The module ``name`` of an extra of the same name. MitsimError where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MitsimError(f"{name} is not installed ({error}); type: pip install 'mitsim[{name}]'") from error


def write_tensors(path: Path, run: Run, calibration: Calibration | None) -> tuple[str, ...]:
    """Write a run as a file of tensors that `torch.load` reads with `weights_only`, whole or not at all.

    Of several lines the tensors have an axis of lines before the others. Behind colour filters `y` has none, and
    `weights` (4, lines) is what each filter passes.

    Parameters
    ----------
    path
        of the file.
    run
        that is exported; its lines were captured under the same patterns.
    calibration
        that goes with it, of the same lines.

    Raises
    ------
    MitsimError
        where PyTorch is not installed, a frame cannot be read, or lines differ in their patterns or in the shape of a
        tensor.
    """
    torch = extra("torch")
    if run.colours is None:
        arrays = {**_frames(run.parts[""]), **_line(run, calibration, "")}
    else:
        arrays = _join_lines(path, run, calibration)
        arrays["wavelengths_nm"] = np.array(run.colours.wavelengths_nm)
    tensors = {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in arrays.items()}
    with whole_file(path) as part:
        try:
            torch.save(tensors, part)
        except RuntimeError as error:  # torch's own words for a full disk, in pages
            raise OSError(f"torch: {cut(reason_of(error))}") from error
    return ()


def _join_lines(path: Path, run: Run, calibration: Calibration | None) -> dict[str, FloatArray]:
    """Tensors of all lines: those of frames behind filters, which are of all at once, have no axis of them."""
    frames = {name: _frames(part) for name, part in run.parts.items()}
    lines = {name: {**frames.get(name, {}), **_line(run, calibration, name)} for name in run.names}
    first, *others = lines.values()
    for arrays in others:
        if arrays.keys() != first.keys() or any(arrays[key].shape != first[key].shape for key in first):
            raise MitsimError(f"{path}: lines differ in shape; use the format hdf5")
        if not all(np.array_equal(arrays[key], first[key]) for key in first.keys() & {*_PATTERNS}):
            raise MitsimError(f"{path}: lines differ in their patterns; use the format hdf5")
    shared = {**frames[""], "weights": np.array(run.filters.weights)} if run.filters else {}
    for key, values in first.items():
        # The truth has an axis of one channel, which the lines take.
        join = np.concatenate if key == "x" else np.stack
        shared[key] = values if key in _PATTERNS else join([arrays[key] for arrays in lines.values()])
    return shared


def _frames(run: Packed[RunManifest]) -> dict[str, FloatArray]:
    shots = Capture(run.manifest, None, {name: run.read(name) for name in dict.fromkeys(run.names)})
    return {"y": measurements(shots), **dict(zip(_PATTERNS, shots.patterns, strict=True))}


def _line(run: Run, calibration: Calibration | None, name: str) -> dict[str, FloatArray]:
    """Truth and factors of a line; truths behind filters where those of all lines are known."""
    arrays = {}
    if name in run.parts and TRUTH in run.parts[name].names:
        arrays["x"] = run.parts[name].read(TRUTH)[0]["reflectance"][None].astype(np.float64)
    elif run.truths.keys() >= {*run.names}:
        arrays["x"] = run.truths[name][0]["reflectance"][None].astype(np.float64)
    if calibration is not None:
        factors = (calibration.parts[name].read(file)[0]["factor"] for file in FACTORS)
        arrays.update({side: np.asarray(factor, np.float64) for side, factor in zip(SIDES, factors, strict=True)})
    return arrays


def measurements(shots: Capture) -> FloatArray:
    """(K K', rows, columns) electrons a second of every pattern of ``shots``, row-major over (i, j): differences of
    signed pairs, others less the ambient frame. MitsimError for a frame that cannot be read."""
    columns = shots.patterns[1].shape[1]
    frames = {each.row * columns + each.column: each.frame for each in shots.pattern_measurements()}
    return np.stack([frames[index] for index in sorted(frames)])

"""Export of runs and factors to tensors of PyTorch, and of captures, factors and images to xarray (CF conventions).

Both libraries are extras (`pip install mitsim[torch,xarray]`), imported when they are used.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError, cut, reason_of
from mitsim.core.files import whole_file
from mitsim.core.manifests import SIDES
from mitsim.core.runs import TRUTH, Capture
from mitsim.exchange.packed import FACTORS, Calibration, Run
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import POINT_SPREAD, Reconstruction
from mitsim.version import __version__

if TYPE_CHECKING:
    from xarray import Dataset

# -------- Tensors

_PATTERNS = ("P_L", "P_R")


def write_tensors(path: Path, run: Run, calibration: Calibration | None) -> tuple[str, ...]:
    """Write a run as tensors that `torch.load` reads with `weights_only`, whole or not at all.

    Several lines add a first axis to the tensors. Behind colour filters `y` has no such axis, and `weights` (4, lines)
    is the light that each filter passes. MitsimError if PyTorch is not installed, a frame cannot be read, or lines
    differ in their patterns or shapes.
    """
    try:
        torch: Any = importlib.import_module("torch")
    except ImportError as error:
        raise MitsimError(f"torch is not installed ({error}); type: pip install 'mitsim[torch]'") from error
    shared, lines = dict[str, FloatArray](), dict[str, dict[str, FloatArray]]()
    for name, part in run.parts.items():
        shots = Capture(part.manifest, None, {file: part.read(file) for file in dict.fromkeys(part.names)})
        lines[name] = {"y": measurements(shots), **dict(zip(_PATTERNS, shots.patterns, strict=True))}
    if run.filters:  # frames of all lines at once
        shared = {**lines.pop(""), "weights": np.array(run.filters.weights)}
    for name in run.names:
        arrays = lines.setdefault(name, {})
        if name in run.parts and TRUTH in run.parts[name].names:
            arrays["x"] = run.parts[name].read(TRUTH)[0]["reflectance"][None].astype(np.float64)
        elif run.truths.keys() >= {*run.names}:
            arrays["x"] = run.truths[name][0]["reflectance"][None].astype(np.float64)
        if calibration is not None:
            factors = (calibration.parts[name].read(file)[0]["factor"] for file in FACTORS)
            arrays.update({side: np.asarray(factor, np.float64) for side, factor in zip(SIDES, factors, strict=True)})
    first, *others = lines.values()
    for arrays in others:
        if arrays.keys() != first.keys() or any(arrays[key].shape != first[key].shape for key in first):
            raise MitsimError(f"{path}: lines differ in shape; use the format hdf5")
        if not all(np.array_equal(arrays[key], first[key]) for key in first.keys() & {*_PATTERNS}):
            raise MitsimError(f"{path}: lines differ in their patterns; use the format hdf5")
    for key, values in first.items():
        # The truth has an axis of one channel, which the lines take.
        join = np.concatenate if key == "x" else np.stack
        alone = run.colours is None or key in _PATTERNS
        shared[key] = values if alone else join([arrays[key] for arrays in lines.values()])
    if run.colours:
        shared["wavelengths_nm"] = np.array(run.colours.wavelengths_nm)
    tensors = {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in shared.items()}
    with whole_file(path) as place:
        try:
            torch.save(tensors, place)
        except RuntimeError as error:  # torch's own words for a full disk, in pages
            raise OSError(f"torch: {cut(reason_of(error))}") from error
    return ()


def measurements(shots: Capture) -> FloatArray:
    """Return (K K', rows, columns) electrons a second without ambient light, patterns row-major over (i, j)."""
    columns = shots.patterns[1].shape[1]
    frames = {each.row * columns + each.column: each.frame for each in shots.pattern_measurements()}
    return np.stack([frames[index] for index in sorted(frames)])


# -------- Labelled arrays

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
    """Return the centres of scene pixels on the calibrated plane [mm], if known."""
    parallax, found = factors.manifest.parallax, Labels()
    if parallax is None:
        return found
    sides = (("row", "y", factors.left, parallax.row_tan), ("column", "x", factors.right, parallax.column_tan))
    for axis, letter, side, (near, far) in sides:
        parts: npt.NDArray[np.float64] = (np.arange(side.shape[1]) + 0.5) / side.shape[1]
        said = _attributes("mm", f"place of the scene's {axis} at {parallax.depth_mm:g} mm, from the frame's middle")
        found[f"scene_{letter}"] = f"scene_{axis}", parallax.depth_mm * (near + (far - near) * parts), said
    return found

"""Runs and factors for MATLAB, PyTorch and xarray, and a real FlatCam's calibration from its MATLAB file.

PyTorch and xarray are extras (`pip install mitsim[torch,xarray]`), imported when they are used.
"""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray, read_variables, write_variables
from mitsim.core.colour_files import ALL, CALIBRATION, WAVELENGTHS_NM, lines_of_planes
from mitsim.core.errors import ArgumentError, MitsimError, cut, reason_of
from mitsim.core.exr import Channel
from mitsim.core.files import whole_file
from mitsim.core.manifests import SIDES, CalibrationManifest
from mitsim.core.runs import TRUTH, Capture
from mitsim.exchange.capture_list import TURNED
from mitsim.exchange.packed import FACTORS, Calibration, Content, Loaded, Packed, Run, as_channel, shots_of
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


def write_tensors(path: Path, run: Run, calibration: Calibration | None) -> tuple[str, ...]:
    """Write a run as tensors that `torch.load` reads with `weights_only`, whole or not at all.

    `y` (K K', rows, columns) are electrons a second without ambient light, patterns row-major over (i, j).
    MitsimError if PyTorch is not installed or a frame cannot be read.
    """
    try:
        torch: Any = importlib.import_module("torch")
    except ImportError as error:
        raise MitsimError(f"torch is not installed ({error}); type: pip install 'mitsim[torch]'") from error
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
    with whole_file(path) as place:
        try:
            torch.save(tensors, place)
        except RuntimeError as error:  # torch's own words for a full disk, in pages
            raise OSError(f"torch: {cut(reason_of(error))}") from error
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

"""Captures, factors and images in; xarray Datasets out, with axes, units and coordinates by the CF conventions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.runs import Capture
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import POINT_SPREAD, Reconstruction
from mitsim.version import __version__

if TYPE_CHECKING:
    from xarray import Dataset

Labels = dict[str, tuple[Any, ...]]
"""Dimensions, values and attributes by name, as xarray takes them."""
_CONVENTIONS = "CF-1.11"


def label_capture(shots: Capture) -> Dataset:
    """Frames (shot, row, column), expected electrons and the truth where they are known, of ``shots``.

    MitsimError where xarray is not installed.
    """
    captures = shots.manifest.patterns.captures
    frame = ("shot", "row", "column")
    numbers: Labels = {"dn": (frame, shots.dn, _attributes("DN", "digital number"))}
    if shots.electrons is not None:
        numbers["electrons"] = (frame, shots.electrons, _attributes("electron", "expected photoelectrons"))
    if shots.truth is not None:
        scene = ("scene_row", "scene_column")
        numbers["truth"] = (scene, shots.truth, _attributes("1", "apparent reflectance, relative to the board"))
        if shots.truth_standard_error is not None:
            numbers["truth_standard_error"] = (
                scene,
                shots.truth_standard_error,
                _attributes("1", "its standard error"),
            )
    places: Labels = {
        "shot": ("shot", np.arange(len(captures)), _attributes("1", "number of the frame")),
        "pattern_row": ("shot", [each.row for each in captures], _attributes("1", "index i of the pattern")),
        "pattern_column": ("shot", [each.column for each in captures], _attributes("1", "index j of the pattern")),
        "sign": ("shot", [each.sign for each in captures], _attributes("1", "half of a signed pattern; 0: unsigned")),
    }
    for name, axis, count in zip(("y", "x"), ("row", "column"), shots.dn.shape[1:], strict=True):
        places |= _sensor_places(shots.manifest.camera, name, axis, count)
    facts: dict[str, Any] = {"exposure_s": shots.exposure_s, "fingerprint": shots.fingerprint}
    if shots.manifest.patterns.family is not None:
        facts["patterns"] = shots.manifest.patterns.family
    if shots.truth_board is not None:
        facts["board_reflectance"] = shots.truth_board
    return _dataset("capture", numbers, places, facts)


def label_factors(factors: Factors) -> Dataset:
    """Both of a camera's ``factors``, with places on the sensor and in the scene where the calibration states them.

    MitsimError where xarray is not installed.
    """
    numbers: Labels = {
        name: ((axis, f"scene_{axis}"), side, _attributes("electron0.5 s-0.5", f"factor of the {axis}s"))
        for name, axis, side in (("left", "row", factors.left), ("right", "column", factors.right))
    }
    places = _scene_places(factors)
    for name, axis, side in (("y", "row", factors.left), ("x", "column", factors.right)):
        places |= _sensor_places(factors.manifest.camera, name, axis, len(side))
    facts = {"status": str(factors.status), "condition": factors.condition, "fingerprint": factors.fingerprint}
    return _dataset("calibration", numbers, places, facts)


def label_image(image: Reconstruction, factors: Factors | None = None) -> Dataset:
    """An image, its uncertainty and depths where they are known.

    Parameters
    ----------
    image
        that was recovered.
    factors
        that it was solved with, which state the places of its pixels; None: they are not said.

    Raises
    ------
    MitsimError
        where xarray is not installed, and for factors of another number of pixels.
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
    """Attributes of a variable."""
    return {"units": units, "long_name": long_name}


def _dataset(title: str, numbers: Labels, places: Labels, facts: Mapping[str, Any]) -> Dataset:
    try:
        from xarray import Dataset
    except ImportError:
        raise MitsimError("xarray is not installed; type: pip install 'mitsim[xarray]'") from None
    about = {"Conventions": _CONVENTIONS, "title": f"mitsim {title}", "source": f"mitsim {__version__}"}
    return Dataset(numbers, places, {**about, **facts})


def _sensor_places(camera: Mapping[str, Any], name: str, axis: str, count: int) -> Labels:
    """Middles of a frame's rows or columns on the sensor [mm], where a ``camera``'s identity states its pixels."""
    known = camera.get("geometry")
    if not isinstance(known, Mapping) or "pixel_pitch" not in known:
        return {}
    row = axis == "row"
    pitch = (known.get("row_pitch") if row else None) or known["pixel_pitch"]
    whole = known.get("rows" if row else "columns") or known["pixels"]
    first = 0 if not known.get("roi") else known["roi"][0 if row else 1]
    middles: FloatArray = pitch * (first + np.arange(count) - (whole - 1) / 2)
    said = _attributes("mm", f"place of the {axis} on the sensor, from the optical axis, growing with its number")
    return {name: (axis, middles, said)}


def _scene_places(factors: Factors) -> Labels:
    """Middles of scene pixels on the calibrated plane [mm], where a calibration states its parallax."""
    parallax = factors.manifest.parallax
    if parallax is None:
        return {}
    sides = (("row", factors.left, parallax.row_tan), ("column", factors.right, parallax.column_tan))
    found: Labels = {}
    for axis, side, (near, far) in sides:
        count = side.shape[1]
        parts: npt.NDArray[np.float64] = (np.arange(count) + 0.5) / count
        said = _attributes("mm", f"place of the scene's {axis} at {parallax.depth_mm:g} mm, from the frame's middle")
        found[f"scene_{'y' if axis == 'row' else 'x'}"] = (
            f"scene_{axis}",
            parallax.depth_mm * (near + (far - near) * parts),
            said,
        )
    return found

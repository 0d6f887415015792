"""Numbers that a scene can have: finite, of a sensible size, and no more light out of a surface than into it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitsim.scene.guard.headers import FARTHEST
from mitsim.scene.guard.reading import Element
from mitsim.scene.guard.vocabulary import is_plugin

Matrix = npt.NDArray[np.float64]
_LARGEST = 1e20
"""Squared, still far from the end of single precision (3.4e38) in which Mitsuba calculates."""
_RIGID = 1e-4
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]{1,3})?")
_INTEGER = re.compile(r"[+-]?[0-9]{1,9}")
_SPECIAL = re.compile(r"[+-]?(nan|inf(inity)?)", re.IGNORECASE)
_ODD_LENGTH = "; 1 unit is 1 mm, and this looks like metres"


@dataclass(frozen=True)
class Range:
    """Numbers from ``low`` to ``high``; ``above`` and ``below`` leave out the bounds themselves."""

    low: float
    high: float
    above: bool = False
    below: bool = False
    hint: str = ""

    def holds(self, number: float) -> bool:
        """Whether the number is allowed."""
        over = number > self.low if self.above else number >= self.low
        return over and (number < self.high if self.below else number <= self.high)

    def __str__(self) -> str:
        words = f"{'above ' if self.above else ''}{self.low:g} to {'below ' if self.below else ''}{self.high:g}"
        return f"allowed is {words}{self.hint}"


_ANY = Range(-_LARGEST, _LARGEST)
_LIGHT = Range(0, _LARGEST, hint=", light is at least 0")
_REFLECTED = Range(0, 1, hint=": light is at least 0, and nothing reflects more than 1")
_PART = Range(0, 1)
_ANGLE = Range(0, 180, above=True, below=True)
_ROUGHNESS = Range(0, 1, above=True)
_INDEX = Range(1, 10)
_SIDE = Range(1, 16384)
_COORDINATE = Range(-FARTHEST, FARTHEST)
_SMALL_LENGTH = Range(1e-4, FARTHEST, hint=_ODD_LENGTH)
_REFLECTANCES = (
    *("reflectance", "diffuse_reflectance", "albedo", "base_color"),
    *("specular_reflectance", "specular_transmittance"),
)
_RANGES = {
    **dict.fromkeys(_REFLECTANCES, _REFLECTED),
    **dict.fromkeys(("radiance", "irradiance", "intensity", "scale"), _LIGHT),
    **dict.fromkeys(("alpha", "alpha_u", "alpha_v"), _ROUGHNESS),
    **dict.fromkeys(("roughness", "anisotropic", "metallic", "opacity", "weight", "pixel_fill_factor"), _PART),
    **dict.fromkeys(("fov", "cutoff_angle", "beam_width"), _ANGLE),
    **dict.fromkeys(("int_ior", "ext_ior"), _INDEX),
    **dict.fromkeys(("width", "height", "crop_width", "crop_height"), _SIDE),
    "radius": Range(0, FARTHEST, above=True),
    "temperature": Range(0, 1e5, above=True),
    "g": Range(-1, 1, above=True, below=True),
    "sample_count": Range(1, 1e6),
    "max_depth": Range(-1, 10000),
    "rr_depth": Range(1, 10000),
    "pixel_pitch": _SMALL_LENGTH,
    "mask_feature": _SMALL_LENGTH,
    "mask_order": Range(2, 16),
    "mask_distance": Range(0, FARTHEST, above=True),
    "mask_thickness": Range(0, FARTHEST),
    "scene_distance": Range(1, FARTHEST, hint=_ODD_LENGTH),
    "angular_exponent": Range(0, 1000),
}
"""What a number may be, by the name of the parameter, whatever plugin has it."""
_TABLES = ("value", "values", "color0", "color1")
"""Numbers by which a texture without a file says how much light it stands for."""
_DISTANCES = {"mask_distance": 2.0, "mask_thickness": 0.0, "scene_distance": 400.0}


def check_numbers(element: Element, parent: Element | None) -> None:
    """MitsimError for a number that is none, not finite, or outside what its name allows."""
    tag, name = element.tag, element.name
    if tag == "transform":
        _check_transform(element, parent)
    elif tag in ("point", "vector"):
        for axis in "xyz":
            if "value" not in element.attributes and axis not in element.attributes:
                raise element.refusal(name, "no " + axis, "give x, y and z, or value")
        for key in ("value", "x", "y", "z"):
            for number in _numbers(element, key, name):
                _check(element, name, number, _COORDINATE)
    elif tag in ("float", "integer"):
        (number,) = _numbers(element, "value", name, 1, _INTEGER if tag == "integer" else _NUMBER)
        dark = parent is not None and parent.tag in ("texture", "spectrum") and name in _TABLES
        _check(element, name, number, _RANGES.get(name, _LIGHT if dark else _ANY))
    elif tag in ("rgb", "spectrum") and not is_plugin(element):
        for number in amounts(element):
            _check(element, name, number, _RANGES.get(name, _LIGHT))
    elif tag == "string" and name in ("values", "wavelengths"):
        for number in _numbers(element, "value", name):
            _check(element, name, number, _LIGHT)
    elif tag == "boolean" and element.attributes["value"].lower() not in ("true", "false"):
        raise element.refusal(name, repr(element.attributes["value"]), "give true or false")


def check_reflectance(name: str, element: Element, read: Callable[[Element], list[tuple[float, float]]]) -> None:
    """MitsimError when what a surface reflects by, under that name, holds numbers above 1; ``read`` opens a spectrum's
    file."""
    for child in (element, *element.children):
        if child is element and is_plugin(element):
            continue
        if child.tag == "spectrum" and "filename" in child.attributes:
            numbers = [value for _, value in read(child)]
        elif child is element or child.name in _TABLES:
            numbers = [*amounts(child)] if child.tag in ("float", "rgb", "spectrum", "string") else []
        else:
            continue
        for number in numbers:
            _check(child, name, number, _REFLECTED)


def is_reflectance(name: str) -> bool:
    """Whether a parameter of that name is the part of light that a surface sends on."""
    return name in _REFLECTANCES


def amounts(element: Element) -> Iterator[float]:
    """The numbers of a colour, or the values of a spectrum, without its wavelengths."""
    text = element.attributes.get("value", "")
    if ":" not in text:
        yield from _numbers(element, "value", element.name)
        return
    last = 0.0
    for pair in re.split(r"[\s,]+", text.strip()):
        wavelength, colon, value = pair.partition(":")
        if not colon:
            raise element.refusal(element.name, repr(pair), "give pairs WAVELENGTH:VALUE")
        at = _number(element, "value", element.name, wavelength)
        if at <= last:
            raise element.refusal(element.name, repr(pair), "wavelengths [nm] rise from above 0")
        last = at
        yield _number(element, "value", element.name, value)


def _check(element: Element, name: str, number: float, allowed: Range) -> None:
    if not allowed.holds(number):
        raise element.refusal(name, number, str(allowed))


def _numbers(
    element: Element, key: str, name: str, exactly: int = 0, form: re.Pattern[str] = _NUMBER
) -> Iterator[float]:
    """The numbers in an attribute, separated by blanks or commas; none where the attribute is missing."""
    if key not in element.attributes:
        return
    words = [word for word in re.split(r"[\s,]+", element.attributes[key]) if word]
    if not words or (exactly and len(words) != exactly):
        rule = f"give {exactly or 'at least 1'} number{'s' if exactly > 1 else ''}"
        raise element.refusal(name, repr(element.attributes[key]), rule)
    for word in words:
        yield _number(element, key, name, word, form)


def _number(element: Element, key: str, name: str, word: str, form: re.Pattern[str] = _NUMBER) -> float:
    if _SPECIAL.fullmatch(word):
        raise element.refusal(name, word, "give a finite number")
    if not form.fullmatch(word):
        what = "a whole number of at most 9 digits" if form is _INTEGER else "a number"
        raise element.refusal(name, repr(element.attributes[key]), f"give {what}")
    number = float(word)
    if not math.isfinite(number):
        raise element.refusal(name, word, "give a finite number")
    return number


def check_camera(camera: Element) -> None:
    """MitsimError when the mask does not lie between the sensor and the scene."""
    own = {child.name: child for child in camera.children if child.tag == "float" and child.name in _DISTANCES}
    found = {name: float(own[name].attributes["value"]) if name in own else value for name, value in _DISTANCES.items()}
    if found["mask_distance"] + found["mask_thickness"] >= found["scene_distance"]:
        place = own.get("mask_distance", camera)
        rule = f"with mask_thickness it must be less than scene_distance, {found['scene_distance']:g} mm"
        raise place.refusal("mask_distance", found["mask_distance"], rule)


def _check_transform(element: Element, parent: Element | None) -> None:
    """The transform as a whole can be undone; that of a camera or projector turns and moves only."""
    total = np.eye(4)
    for step in element.children:
        total = _step(step) @ total
    name = element.name
    turn = total[:3, :3]
    sizes = np.linalg.svd(turn, compute_uv=False) if np.isfinite(total).all() else np.zeros(3)
    if not (sizes[2] > 1e-9 and sizes[0] < FARTHEST and sizes[0] < 1e7 * sizes[2] and np.abs(total).max() <= FARTHEST):
        rule = f"it must be invertible, with sizes of 1e-9 to {FARTHEST:g}"
        raise element.refusal(name, f"stretching by {sizes[2]:g} to {sizes[0]:g}", rule)
    if not np.array_equal(total[3], (0, 0, 0, 1)):
        raise element.refusal(name, f"last row {total[3].tolist()}", "it must be 0 0 0 1")
    rigid = parent is not None and name == "to_world" and parent.kind in ("mitsim_lensless", "projector")
    error = float(np.abs(turn.T @ turn - np.eye(3)).max())
    if rigid and not (error < _RIGID and np.linalg.det(turn) > 0):
        raise element.refusal(
            name,
            f"R^T R {error:.2g} from 1",
            "a camera or projector is moved and turned only: no scaling, no mirroring",
        )


def _step(step: Element) -> Matrix:
    matrix = np.eye(4)
    if step.tag == "matrix":
        numbers = [*_numbers(step, "value", "matrix")]
        if len(numbers) not in (9, 16):
            raise step.refusal("matrix", f"{len(numbers)} numbers", "give 9 or 16")
        side = math.isqrt(len(numbers))
        matrix[:side, :side] = np.reshape(numbers, (side, side))
    elif step.tag == "lookat":
        matrix = _looking(step)
    elif step.tag == "translate":
        matrix[:3, 3] = _axes(step, 0, _COORDINATE)
    elif step.tag == "scale":
        matrix[:3, :3] = np.diag(_axes(step, 1, Range(-FARTHEST, FARTHEST)))
        if not np.diag(matrix).all():
            raise step.refusal("scale", 0, "a scale of 0 flattens the object; give another number")
    else:
        axis = np.array(_axes(step, 0, _COORDINATE))
        (angle,) = _numbers(step, "angle", "rotate", 1)
        _check(step, "angle", angle, Range(-1e6, 1e6))
        length = float(np.linalg.norm(axis))
        if not length:
            raise step.refusal("rotate", "axis 0, 0, 0", "give an axis")
        x, y, z = axis / length
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])  # Rodrigues
        turned = math.radians(angle)
        matrix[:3, :3] += math.sin(turned) * cross + (1 - math.cos(turned)) * cross @ cross
    return matrix


def _axes(step: Element, default: float, allowed: Range) -> list[float]:
    whole = [*_numbers(step, "value", step.tag)]
    if whole and (len(whole) not in (1, 3) or {"x", "y", "z"} & step.attributes.keys()):
        raise step.refusal(step.tag, repr(step.attributes["value"]), "give value with 1 or 3 numbers, or x, y and z")
    numbers = whole * (3 // len(whole)) if whole else []
    if not whole:
        for axis in "xyz":
            numbers += [*_numbers(step, axis, step.tag, 1)] or [default]
    for number in numbers:
        _check(step, step.tag, number, allowed)
    return numbers


def _looking(step: Element) -> Matrix:
    """Mitsuba's frame of a ``lookat``: x to the left, y up, z from origin to target."""
    ends = {}
    for key in ("origin", "target", "up"):
        ends[key] = np.array([*_numbers(step, key, key, 3)] or (0.0, 0.0, 0.0))
        for number in ends[key]:
            _check(step, key, number, _COORDINATE)
    ahead = ends["target"] - ends["origin"]
    up = ends["up"] if ends["up"].any() else np.eye(3)[int(np.argmin(np.abs(ahead)))]
    left = np.cross(up, ahead)
    if np.linalg.norm(left) <= 1e-6 * np.linalg.norm(up) * np.linalg.norm(ahead):
        rule = "origin and target differ, and up points elsewhere than from one to the other"
        raise step.refusal("lookat", step.attributes["target"], rule)
    ahead, left = ahead / np.linalg.norm(ahead), left / np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3, :4] = np.stack([left, np.cross(ahead, left), ahead, ends["origin"]], axis=1)
    return matrix

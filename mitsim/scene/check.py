"""A scene file's text in, a refusal or silence out: what Mitsuba would crash on, obey or silently accept.

Loading a scene can run native code or overflow a stack, and it takes NaN, negative light or a reflectance of 2 without
a word (DESIGN section 9), so the XML is read here first.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree

from defusedxml import ElementTree as SafeTree
from defusedxml.common import DefusedXmlException

from mitsim.core.errors import MitsimError

_DEEPEST = 16
_RESERVED = ("path", "parallel", "update_scene", "variant")
_NATIVE = (".so", ".dylib", ".dll")
_NUMBERS = (
    *("float", "integer", "point", "vector", "spectrum", "rgb"),
    *("translate", "scale", "rotate", "lookat", "matrix"),
)
_LIGHT = ("spectrum", "rgb")
_REFLECTANCES = (
    *("reflectance", "diffuse_reflectance", "albedo", "base_color"),
    *("specular_reflectance", "specular_transmittance"),
)


def check_file(path: Path, defines: Mapping[str, str]) -> None:
    """Refuse a scene file that must not reach Mitsuba, or that lacks a parameter named by ``-D``.

    Raises
    ------
    MitsimError
        for a file that is missing, no well-formed scene XML, too deeply nested, that loads native code, or holds a
        number no scene can have; one line with the place and the value.
    """
    root = _parsed(path)
    if root.tag != "scene":
        raise MitsimError(f"{path}:1: the root element is <{root.tag}>; a Mitsuba scene starts with <scene>")
    values = {element.get("name", ""): element.get("value", "") for element in root.iter("default")}
    for name in defines:
        if name not in values or name in _RESERVED:
            raise MitsimError(
                f"-D {name}={defines[name]}: {path} has no <default name={name!r}>; "
                f"it knows {', '.join(sorted(values)) or 'none'}"
            )
    _check_content(path, root, {**values, **defines}, (path.resolve(),))


def _parsed(path: Path) -> ElementTree.Element:
    if not path.is_file():
        raise MitsimError(f"{path}: no such scene file; give the path of a Mitsuba scene XML")
    try:
        _check_depth(path)
        root: ElementTree.Element = SafeTree.parse(path, forbid_dtd=True).getroot()
    except ElementTree.ParseError as error:
        line, column = error.position
        raise MitsimError(
            f"{path}:{line}: not well-formed XML (column {column}: {str(error).split(':')[0]}); mend the file"
        ) from None
    except DefusedXmlException as error:
        raise MitsimError(f"{path}: DTDs and entities are not allowed in a scene ({error}); remove them") from None
    except (OSError, UnicodeDecodeError) as error:
        raise MitsimError(f"{path}: cannot be read ({error}); check the file") from None
    return root


def _check_depth(path: Path) -> None:
    """Refuse deep nesting before anything recursive sees it: it overflows Mitsuba's stack, or takes for ever."""
    depth = 0
    for event, element in SafeTree.iterparse(path, events=("start", "end"), forbid_dtd=True):
        depth += 1 if event == "start" else -1
        if depth > _DEEPEST:
            raise MitsimError(f"{path}: elements are nested over {_DEEPEST} deep (<{element.tag}>); flatten the scene")


def _check_content(path: Path, root: ElementTree.Element, values: Mapping[str, str], seen: tuple[Path, ...]) -> None:
    """Native code, numbers, and the same for included files."""
    # Mitsuba looks for a plugin it does not know in the folder "plugins" beside the scene.
    for library in sorted((path.parent / "plugins").glob("*")):
        if library.suffix in _NATIVE:
            raise MitsimError(f"{path}: {library} would run native code; move it away from the scene")
    for element in root.iter():
        if element.tag == "path":
            raise MitsimError(
                f"{path}: <path value={element.get('value')!r}> can load native code; remove it and name files "
                "relative to the scene"
            )
        if element.tag == "include":
            _check_included(path, _substituted(element.get("filename", ""), values), values, seen)
        if element.tag in _NUMBERS:
            _check_numbers(path, element, values)


def _check_included(path: Path, filename: str, values: Mapping[str, str], seen: tuple[Path, ...]) -> None:
    included = path.parent / filename
    if included.resolve() in seen:
        raise MitsimError(f"{path}: <include filename={filename!r}> comes back to itself; remove one of the two")
    if not included.is_file():
        raise MitsimError(f"{path}: <include filename={filename!r}>: no such file in {path.parent}; mend the name")
    root = _parsed(included)
    own = {element.get("name", ""): element.get("value", "") for element in root.iter("default")}
    _check_content(included, root, {**own, **values}, (*seen, included.resolve()))


def _check_numbers(path: Path, element: ElementTree.Element, values: Mapping[str, str]) -> None:
    """Numbers are finite, light is not negative, and a reflectance is at most 1."""
    name = element.get("name", element.tag)
    for key, text in element.items():
        if key in ("name", "id", "filename"):
            continue
        for number in _numbers(_substituted(text, values)):
            rule = ""
            if not math.isfinite(number):
                rule = "give a finite number"
            elif number < 0 and element.tag in _LIGHT:
                rule = "give a number of at least 0"
            elif number > 1 and element.tag in _LIGHT and name in _REFLECTANCES:
                rule = "nothing reflects more than 1"
            if rule:
                raise MitsimError(f"{path}: {name}: got {number:g} in <{element.tag} {key}={text!r}>; {rule}")


def _numbers(text: str) -> Iterator[float]:
    """The numbers in an attribute: separated by blanks or commas, and after the colon of a wavelength."""
    for word in re.split(r"[\s,]+", text):
        try:
            yield float(word.rpartition(":")[2])
        except ValueError:
            continue


def _substituted(text: str, values: Mapping[str, str]) -> str:
    """The text with ``$name`` replaced as Mitsuba does it."""
    return re.sub(r"\$(\w+)", lambda match: values.get(match[1], match[0]), text)

"""A scene file in, a refusal or the list of its files out: what Mitsuba would crash on, obey or silently accept.

Loading a scene can run native code, read any file or overflow a stack, and it takes NaN, negative light or a
reflectance of 2 without a word (DESIGN section 9), so the XML and all files that it names are read here first.
``reading`` gives the elements, ``vocabulary`` the words, ``sanity`` the numbers, ``files`` and ``headers`` the files.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from mitsim.scene.guard.files import SceneFiles
from mitsim.scene.guard.headers import MOST_TEXELS, check_image, check_obj, check_ply, read_spectrum
from mitsim.scene.guard.reading import DEEPEST, MOST_ELEMENTS, Element, read_scene
from mitsim.scene.guard.sanity import check_camera, check_numbers, check_reflectance, is_reflectance
from mitsim.scene.guard.vocabulary import check_words, is_plugin

_IMAGES = ("bitmap", "envmap")
_LARGEST_MATERIAL = 256
"""Elements of one BSDF: all of them are compiled into every kernel."""


def check_file(path: Path, defines: Mapping[str, str], outside: bool = False) -> tuple[Path, ...]:
    """Refuse a scene that must not reach Mitsuba, or that lacks a parameter named by ``-D``; else list its files.

    The files are the scene, what it includes, its bitmaps, meshes and spectra, each once. They must lie in the scene's
    folder unless ``outside`` is set.

    Raises
    ------
    MitsimError
        one line ``file:line: name: got VALUE in <tag ...>; what is allowed`` for content, or with the file alone where
        no line is at fault.
    """
    files = SceneFiles(path, outside)
    root = read_scene(path, defines, files)
    known: dict[str, Element] = {}
    texels = 0
    elements = [*_elements(root, None)]
    for element, parent in elements:
        check_words(element, parent)
    for element, parent in elements:
        check_numbers(element, parent)
        _note(element, known)
        if element.tag == "string":
            _check_string(element, parent)
        if element.tag == "spectrum" and "filename" in element.attributes:
            for _, value in _spectrum(element, files):
                if value < 0:
                    raise element.refusal(element.name, value, "light is at least 0")
        if is_plugin(element) and element.kind in (*_IMAGES, "ply", "obj"):
            texels += _check_resource(element, files)
            if texels > MOST_TEXELS:
                raise element.refusal("texels", texels, f"all bitmaps together may have {MOST_TEXELS}")
    _check_references(root, known)
    for element, _ in elements:
        if element.kind == "mitsim_lensless":
            check_camera(element)
        if is_reflectance(element.name):
            meant = known[element.attributes["id"]] if element.tag == "ref" else element
            check_reflectance(element.name, meant, lambda child: _spectrum(child, files))
    return tuple(files.used)


def _elements(element: Element, parent: Element | None) -> Iterator[tuple[Element, Element | None]]:
    """Every element with its parent, in the order of the files; what a file includes belongs to who includes it."""
    yield element, parent
    for child in element.children:
        yield from _elements(child, parent if element.tag == "include" else element)


def _note(element: Element, known: dict[str, Element]) -> None:
    """Remember an element's id, or its other name."""
    name, meant = element.attributes.get("id", ""), element
    if element.tag == "ref":
        return
    if element.tag == "alias":
        if name not in known:
            raise element.refusal("alias", repr(name), "give the id of an element above")
        name, meant = element.attributes["as"], known[name]
    if name in known:
        raise element.refusal("id", repr(name), f"it is that of {known[name].path}:{known[name].line} already")
    if name:
        known[name] = meant


def _check_string(element: Element, parent: Element | None) -> None:
    """Texts that Mitsuba makes file names of."""
    name, value = element.name, element.attributes["value"]
    if name == "filename":
        if parent is None or parent.kind not in (*_IMAGES, "ply", "obj"):
            raise element.refusal(name, repr(value), "only bitmap, envmap, ply and obj read a file")
    elif name == "material":
        if not re.fullmatch(r"[A-Za-z0-9_-]+", value):
            raise element.refusal(name, repr(value), "give the name of a material, as Au")
    elif "/" in value or ".." in value:
        raise element.refusal(name, repr(value), "only filename may hold a path")


def _check_resource(element: Element, files: SceneFiles) -> int:
    """The file of a bitmap or mesh; number of texels."""
    named = [child for child in element.children if child.tag == "string" and child.name == "filename"]
    if len(named) != 1:
        raise element.refusal("filename", f"{len(named)} of them", f"a {element.kind} reads one file")
    (place,) = named
    path = files.resource(place, place.attributes["value"])
    try:
        if element.kind in _IMAGES:
            return check_image(path)
        (check_ply if element.kind == "ply" else check_obj)(path)
    except (ValueError, OSError) as error:
        raise place.refusal("filename", repr(place.attributes["value"]), f"the file {error}") from None
    return 0


def _spectrum(element: Element, files: SceneFiles) -> list[tuple[float, float]]:
    name = element.attributes["filename"]
    path = files.included(element, name)
    try:
        return read_spectrum(path)
    except (ValueError, OSError) as error:
        raise element.refusal("filename", repr(name), f"the file {error}") from None


def _check_references(root: Element, known: Mapping[str, Element]) -> None:
    """References lead somewhere, never back, and what they unfold to is neither deep nor large."""
    found: dict[int, tuple[int, int]] = {}
    open_: set[int] = set()

    def unfold(element: Element, depth: int) -> tuple[int, int]:
        """Depth below the element, and number of elements, with references followed."""
        if element.tag == "ref":
            name = element.attributes["id"]
            if name not in known:
                raise element.refusal("ref", repr(name), "no element has this id")
            if id(known[name]) in open_:
                raise element.refusal("ref", repr(name), "it comes back to itself; remove it")
        if id(element) not in found:
            below = [known[element.attributes["id"]]] if element.tag == "ref" else element.children
            if depth > 2 * DEEPEST:
                raise element.refusal("nesting", f"over {DEEPEST} levels", "flatten the scene")
            open_.add(id(element))
            parts = [unfold(child, depth + 1) for child in below]
            open_.discard(id(element))
            own = 0 if element.tag in ("ref", "include") else 1
            sides = 2 if element.kind == "twosided" else 1  # each side is a copy
            deepest = max((part[0] for part in parts), default=0)
            found[id(element)] = own + deepest, own + sides * sum(part[1] for part in parts)
        levels, size = found[id(element)]
        most = _LARGEST_MATERIAL if element.tag == "bsdf" else MOST_ELEMENTS
        if levels > DEEPEST or size > most:
            got = f"{levels} levels of {size} elements with references followed"
            raise element.refusal("nesting", got, f"{DEEPEST} levels and {most} elements are allowed")
        return levels, size

    unfold(root, 0)

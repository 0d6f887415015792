"""Positions of all tags of a scene file, and refusals of content that Mitsuba's parser must not receive.

Mitsuba's parser has faults that this module prevents (cases in tests/hard/hostile/). It recurses until its stack
overflows. It opens what ``<include>`` and ``<spectrum>`` name while it reads, even a pipe or a file outside, and each
include again; ``<path>`` lets it find native code. It reads ``$albedo2`` as ``$albedo`` followed by 2, an empty number
as 0, and a matrix without its last row. Of two objects with one name it takes the second.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn
from xml.parsers import expat

from mitsim.core.errors import MitsimError, cut, near_name

if TYPE_CHECKING:
    import mitsuba as mi


DEEPEST = 16
"""Deepest nesting with references followed: shipped scenes have 5."""
MOST_ELEMENTS = 10_000
"""A hundred times the largest shipped scene."""
_MOST_INCLUDES = 64
_DEEPEST_INCLUDE = 8
"""Below the 15 at which Mitsuba's parser ends."""
_MOST_BYTES = 4 << 20
"""``MOST_ELEMENTS`` of 400 bytes."""
_PARAMETER = re.compile(r"\$([A-Za-z0-9_]*)")
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_VERSION = re.compile(r"[23]\.[0-9]{1,3}\.[0-9]{1,3}")
_LAST_ROW = re.compile(r"([+-]?0*\.?0* ){3}[+]?0*1\.?0*")
_TRIPLES = ("point", "rotate", "scale", "translate", "vector")
_NUMBERS = (*_TRIPLES, "float", "integer", "lookat", "matrix", "rgb")


@dataclass(frozen=True)
class Tag:
    path: Path
    line: int
    name: str
    attributes: Mapping[str, str]

    def __str__(self) -> str:
        written = "".join(f" {key}={cut(text)!r}" for key, text in self.attributes.items())
        return f"<{cut(self.name + written, 200)}>"

    def refusal(self, what: str, value: object, rule: str) -> MitsimError:
        got = cut(value if isinstance(value, str) else f"{value:g}")
        return MitsimError(f"{self.path}:{self.line}: {cut(what)}: got {got} in {self}; {rule}")


class Outline:
    """Positions of all tags in a scene file and its includes.

    ``defines`` precede the values of ``<default>``; files become absolute paths. ``used`` are the files that the scene
    reads, the scene first, and ``own`` the parameters by which the user names some; all are in the scene's folder
    unless ``outside``. ``projected`` are files that objects inside the projectors name.

    Raises MitsimError if the XML is not well formed, too large or nested too deep, names files that are not allowed, or
    has parameters that are missing, unknown or not plain.
    """

    def __init__(self, path: Path, defines: Mapping[str, str], outside: bool = False) -> None:
        self.path, self.outside = path, outside
        self.own: dict[Path, str] = {}
        self.used: dict[Path, None] = {}
        self._values, self._given, self.defines = dict(defines), defines, dict(defines)
        self._defaults: set[str] = set()
        self._tags: dict[tuple[int, int, str], Tag] = {}
        self._places: dict[tuple[str, str, str], Tag] = {}
        self.projected: list[Path] = []
        self._opened = self._elements = 0
        for name, value in defines.items():
            if "$" in value or "\\" in value or not value.isprintable():
                raise MitsimError(f"parameter {cut(name)}={cut(value)!r}: give one without $, backslash or line breaks")
        if not path.is_file():
            raise MitsimError(f"{path}: no such scene file; give the path of a Mitsuba scene XML")
        self.used[path] = None
        # Mitsuba searches the folder "plugins" beside the scene and in the working folder before its own.
        for folder in (path.parent, Path()):
            _check_native(path, folder)
        self._read(path, path.parent, ())
        known = ", ".join(sorted(self._defaults)) or "none"
        unknown = [
            f"parameter {cut(name)}={cut(value)}: {path} has no <default name={cut(name)!r}>; "
            f"{near_name(name, self._defaults)}"
            for name, value in defines.items()
            if name not in self._defaults or name in ("config", "filename")  # Mitsuba's own arguments
        ]
        if len(unknown) == 1:
            raise MitsimError(f"{unknown[0]}it knows {known}")
        if unknown:
            raise MitsimError(f"{path}: {len(unknown)} parameters are unknown; it knows {known}:", *unknown)

    def tag(self, node: mi.parser.SceneNode, name: str = "") -> Tag:
        key = node.file_index, node.offset
        return self._tags.get((*key, name)) or self._tags[(*key, "")]

    def refusal(self, error: BaseException) -> MitsimError:
        message = one_line(error)
        places = [*re.finditer(r"(?:[Ww]hile loading|At) (\S.*?) \(line (\d+), col (\d+)\): ", message)]
        if not places:
            return MitsimError(f"{self.path}: Mitsuba refuses the scene: {message}")
        file, line, column = places[-1].groups()
        what = self._places.get((file, line, column), "the scene")
        return MitsimError(f"{file}:{line}: Mitsuba refuses {what}: {message[places[-1].end() :]}")

    def _read(self, path: Path, beside: Path, above: tuple[Path, ...]) -> None:
        try:
            with open(path, "rb") as opened:
                content = opened.read(_MOST_BYTES + 1)
        except OSError as error:
            raise MitsimError(f"{path}: cannot be read ({error.strerror}); check the file") from None
        if len(content) > _MOST_BYTES:
            raise MitsimError(f"{path}: over {_MOST_BYTES >> 20} MiB; a scene is smaller, give meshes their own files")
        try:
            content.decode("utf-8")
            wrong = content.find(b"\0")  # where Mitsuba's parser would end
        except UnicodeDecodeError as error:
            wrong = error.start
        if wrong >= 0:
            line = content.count(b"\n", 0, wrong) + 1
            raise MitsimError(f"{path}:{line}: not well-formed XML (no UTF-8, or a zero byte); write it in UTF-8")
        file, self._opened = self._opened, self._opened + 1
        parser = expat.ParserCreate()
        open_tags: list[int] = []

        def refuse(what: str) -> NoReturn:
            raise MitsimError(f"{path}:{parser.CurrentLineNumber}: {what}")

        def declare(version: str, encoding: str | None, standalone: int) -> None:
            if encoding is not None and encoding.lower() not in ("utf-8", "us-ascii"):
                refuse(f"encoding: got {cut(encoding)!r}; write the scene in UTF-8")

        def start(name: str, attributes: dict[str, str]) -> None:
            self._elements += 1
            if len(open_tags) >= DEEPEST:
                refuse(f"elements are nested over {DEEPEST} deep (<{cut(name)}>); flatten the scene")
            if self._elements > MOST_ELEMENTS:
                refuse(f"over {MOST_ELEMENTS} elements with all includes; make the scene smaller")
            tag = Tag(path, parser.CurrentLineNumber, name, attributes)
            own = attributes.get("value", "")
            if (name, attributes.get("name")) == ("string", "filename") and own[:1] == "$" and own[1:] in self._given:
                path_of_own = str(self.find_named(own[1:], self._given[own[1:]]))
                self.defines[own[1:]] = self._values[own[1:]] = path_of_own
            texts = {key: self._with_parameters(tag, text) for key, text in attributes.items()}
            if texts.get("name") == "" and name != "default":
                raise tag.refusal("name", "''", "give a name; only objects may go without the attribute")
            if not open_tags:
                if name != "scene" and not above:
                    refuse(f"the root element is <{cut(name)}>; a Mitsuba scene starts with <scene>")
                version = attributes.get("version", "")
                if not _VERSION.fullmatch(version):
                    raise tag.refusal("version", version or "none", 'give version="3.0.0"; 2 and 3 are read')
            elif name not in ("default", "include") and texts.get("name"):
                key = file, open_tags[-1], texts["name"]
                if key in self._tags:
                    raise tag.refusal("name", repr(texts["name"]), f"line {self._tags[key].line} has it already")
                self._tags[key] = tag
            open_tags.append(parser.CurrentByteIndex + 1)  # Mitsuba counts to the tag's name
            self._tags[file, open_tags[-1], ""] = tag
            self._places[str(path), str(tag.line), str(parser.CurrentColumnNumber + 2)] = tag
            if name == "path":
                rule = "it can load native code; remove it and name files relative to the scene"
                raise tag.refusal("path", repr(texts.get("value", "")), rule)
            if name == "default":
                parameter, value = (attributes.get(key, "") for key in ("name", "value"))
                if not _NAME.fullmatch(parameter) or "$" in value:
                    rule = "its name has letters, digits and _ only, and it has a plain value without $"
                    raise tag.refusal("default", repr(parameter), rule)
                self._defaults.add(parameter)
                self._values.setdefault(parameter, value)
            elif name == "include":
                inner = self.find(tag, texts.get("filename", ""), path.parent)
                open_files = *above, path.resolve()
                _check_native(path, inner.parent)
                if inner.resolve() in open_files:
                    raise tag.refusal("include", inner.name, "it comes back to itself; remove one of the two")
                if self._opened > _MOST_INCLUDES or len(open_files) > _DEEPEST_INCLUDE:
                    rule = f"{_MOST_INCLUDES} includes, {_DEEPEST_INCLUDE} deep, are allowed; join some"
                    raise tag.refusal("include", inner.name, rule)
                self._read(inner, path.parent, open_files)
            elif name == "spectrum" and "filename" in texts:
                name = texts["filename"]
                if self.find(tag, name, beside).stat().st_size > _MOST_SPECTRUM:
                    raise tag.refusal("filename", repr(name), "the file is over 1 MiB; a spectrum is smaller")
            elif name in _NUMBERS:
                _check_numbers(tag, texts)
            elif (name, texts.get("name")) == ("string", "filename"):
                outer = (self._tags[file, at, ""].attributes for at in open_tags[:-1])
                if any(attributes.get("type") == "projector" for attributes in outer):
                    self.projected.append(self.path.parent / texts.get("value", ""))

        parser.XmlDeclHandler = declare
        parser.StartDoctypeDeclHandler = lambda *_: refuse("a scene has no DTDs and entities; remove <!DOCTYPE ...>")
        parser.ProcessingInstructionHandler = lambda target, _: refuse(
            f"processing instructions are not allowed in a scene; remove <?{cut(target)} ...?>"
        )
        parser.StartElementHandler = start
        parser.EndElementHandler = lambda _: open_tags.pop()
        try:
            parser.Parse(content, True)
        except expat.ExpatError as error:
            reason = f"column {error.offset}: {expat.ErrorString(error.code)}"
            raise MitsimError(f"{path}:{error.lineno}: not well-formed XML ({reason}); mend the file") from None
        except ValueError as error:  # an encoding that Python does not know
            raise MitsimError(f"{path}:1: not well-formed XML ({error}); write the scene in UTF-8") from None

    def _with_parameters(self, tag: Tag, text: str) -> str:
        if "\\" in text:
            raise tag.refusal("text", repr(text), "backslashes are not allowed")

        def value(match: re.Match[str]) -> str:
            if match[1] not in self._values:
                known = ", ".join(sorted(self._values)) or "none"
                raise tag.refusal("parameter", match[0], f"parameters that are set by then: {known}")
            return self._values[match[1]]

        return text if tag.name == "default" else _PARAMETER.sub(value, text)

    def find_named(self, parameter: str, name: str) -> Path:
        """Return the path of the file that a user names for a scene ``parameter``.

        A ``name`` is relative to the working folder if it starts with a dot, and to the scene's folder if only that has
        it. Raises MitsimError if the file is missing, or both folders have one of that name.
        """
        own, here = self.path.parent / name, Path(name)
        places = [here] if name.startswith(".") or here.is_absolute() else [own, here]
        found = {place.resolve(): place for place in places if os.path.isfile(place)}  # also of a name too long
        if not found:
            folders = " or ".join(str(folder) for folder in dict.fromkeys((Path.cwd(), self.path.parent)))
            raise MitsimError(f"parameter {cut(parameter)}={cut(name)}: no such file in {folders}; mend the name")
        if len(found) > 1:
            problem = f"parameter {cut(parameter)}={cut(name)}: the scene's folder and the working folder have"
            raise MitsimError(f"{problem} a file of that name; give ./{cut(name)} or {own}")
        path = next(iter(found.values()))
        path = self.path.parent.absolute() / name if path == own else path.absolute()
        self.own[path] = parameter
        return path

    def find(self, tag: Tag, name: str, folder: Path | None = None) -> Path:
        """Return the file ``name``, relative to a ``folder`` (None: the scene's).

        Raises MitsimError if it lies outside the scene's folder, or is no plain file of at most 512 MiB.
        """
        folder = folder or self.path.parent
        path = folder / name
        try:
            status = path.stat()
            inside = path.resolve().is_relative_to(self.path.parent.resolve())
        except (OSError, ValueError, RuntimeError):
            raise tag.refusal("filename", repr(name), f"no such file in {folder}; mend the name") from None
        if not (inside or self.outside or path in self.own):
            rule = f"files lie in the scene's folder {self.path.parent}; copy it there, or use --allow-outside-files"
            raise tag.refusal("filename", repr(name), rule)
        if not stat.S_ISREG(status.st_mode) or not 0 < status.st_size <= _MOST_FILE:
            raise tag.refusal("filename", repr(name), f"a plain file of 1 byte to {_MOST_FILE >> 20} MiB is needed")
        self.used[path] = None
        return path


def _check_numbers(tag: Tag, texts: Mapping[str, str]) -> None:
    name, words = texts.get("name", tag.name), re.split(r"[\s,]+", texts.get("value", "").strip())
    for text in texts.values():
        if not text.strip():
            raise tag.refusal(name, repr(text), "give a number")
    if tag.name in _TRIPLES and "value" in texts and (len(words) not in (1, 3) or {"x", "y", "z"} & texts.keys()):
        raise tag.refusal(name, repr(texts["value"]), "give value with 1 or 3 numbers, or x, y and z")
    last = " ".join(words[12:])
    if tag.name == "matrix" and len(words) == 16 and not _LAST_ROW.fullmatch(last):
        raise tag.refusal("matrix", f"last row {last}", "it must be 0 0 0 1")


def one_line(error: BaseException) -> str:
    text = re.sub(r"\x1b\[[0-9;]*m|\[\w+\.cpp:\d+\] ", "", str(error))
    lines = [re.sub(r"\s+", " ", line).strip(" -*│╰╭─") for line in text.splitlines()]
    lines = [re.sub(r"^\d{4}-\d\d-\d\d [\d:]+ \w+ +\w* *\[[^\]]*\] *", "", line) for line in lines if line]
    if "Traceback" in text:  # raised by our own plugin: the last line says what, the rest is Python's stack
        lines = [re.sub(r" Traceback .*", "", lines[0]), re.sub(r"^[\w.]*Error: ", "", lines[-1])]
    return " ".join(lines)[:400] if lines else type(error).__name__


# -------- The files of a scene

_NATIVE = (".so", ".dylib", ".dll")
_MOST_FILE = 512 << 20
"""Room for the largest environment map, 400 MiB."""
_MOST_SPECTRUM = 1 << 20
"""Some 50 000 lines; measured spectra have 1000."""


def _check_native(scene: Path, folder: Path) -> None:
    try:
        beside = [entry for entry in os.scandir(folder) if entry.name.lower() == "plugins" and entry.is_dir()]
        libraries = [Path(entry.path) for place in beside for entry in os.scandir(place.path)]
    except OSError as error:
        raise MitsimError(f"{scene}: {error.filename}: cannot be read ({error.strerror}); check the folder") from None
    for library in sorted(libraries):
        if library.suffix.lower() in _NATIVE:
            raise MitsimError(f"{scene}: {library} would run native code; move it away from the scene")


# -------- Size of a projector's picture, where it is known without the renderer

_MODES_OF_PIXELS = ("1", "L", "RGB")
"""Modes of pictures whose dark texels are 0 in every channel."""
_MOST_TEXELS = 1 << 24
"""A picture of 4096 x 4096, decoded in 0.1 s."""


def lit_side(picture: Path) -> int | None:
    """Return the side of the lit square in a PNG file in pixels; None without one."""
    from PIL.PngImagePlugin import PngImageFile

    try:
        with PngImageFile(picture) as image:
            if image.mode not in _MODES_OF_PIXELS or image.width * image.height > _MOST_TEXELS:
                return None
            left, top, right, bottom = image.getbbox() or (0, 0, 0, 0)
    except (SyntaxError, OSError, ValueError):
        return None
    return right - left if right - left == bottom - top > 0 else None

"""A scene's XML in, its elements and their lines out, as Mitsuba will see them: parameters put in, includes opened.

Mitsuba reads XML with another parser (pugixml) than this one (expat). Whatever the two could see differently is refused
rather than understood: encodings other than UTF-8, DTDs, processing instructions, parameters inside parameters.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from mitsim.core.errors import MitsimError, cut
from mitsim.scene.guard.files import SceneFiles

DEEPEST = 16
"""Elements inside elements, references followed: beyond, Mitsuba's stack overflows or it takes for ever."""
MOST_ELEMENTS = 10_000
MOST_INCLUDES = 64
_DEEPEST_INCLUDE = 8
_MOST_BYTES = 4 << 20
_RESERVED = ("path", "filename", "parallel", "optimize", "update_scene", "variant")
_PARAMETER = re.compile(r"\$([A-Za-z0-9_]*)(\$?)")
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_ENCODINGS = ("utf-8", "us-ascii")


@dataclass
class Element:
    """One tag: ``raw`` attributes as written, ``attributes`` with parameters put in; an include holds what it opens."""

    path: Path
    line: int
    tag: str
    raw: Mapping[str, str]
    attributes: dict[str, str] = field(default_factory=dict)
    children: list[Element] = field(default_factory=list)

    @property
    def name(self) -> str:
        """What the parent calls it."""
        return self.attributes.get("name", "")

    @property
    def kind(self) -> str:
        """The plugin that it asks for."""
        return self.attributes.get("type", "")

    def refusal(self, what: str, value: object, rule: str) -> MitsimError:
        """``file:line: what: got VALUE in <tag ...>; rule``."""
        written = "".join(f" {key}={cut(text)!r}" for key, text in self.raw.items())
        got = cut(value if isinstance(value, str) else f"{value:g}")
        tag = cut(self.tag + written, 200)
        return MitsimError(f"{self.path}:{self.line}: {cut(what)}: got {got} in <{tag}>; {rule}")


def read_scene(path: Path, defines: Mapping[str, str], files: SceneFiles) -> Element:
    """The scene's root; children of an ``include`` are those of the file that it names.

    Raises
    ------
    MitsimError
        for what is no well-formed scene XML, too large or nested too deep, for files that ``files`` does not allow,
        and for parameters that are missing, unused or not plain.
    """
    for name, value in defines.items():
        if "$" in value or "\\" in value or not value.isprintable():
            raise MitsimError(f"-D {cut(name)}={cut(value)!r}: give a plain value without $, backslash or line breaks")
    reader = _Reader(defines, files)
    root = reader.opened(files.scene(path), path, ())
    if root.tag != "scene":
        raise MitsimError(
            f"{path}:{root.line}: the root element is <{cut(root.tag)}>; a Mitsuba scene starts with <scene>"
        )
    for name in defines:
        if name not in reader.defaults or name in _RESERVED:
            raise MitsimError(
                f"-D {cut(name)}={cut(defines[name])}: {path} has no <default name={cut(name)!r}>; "
                f"it knows {', '.join(sorted(reader.defaults)) or 'none'}"
            )
    return root


class _Reader:
    """All files of one scene: they share parameters, in the order in which Mitsuba meets them, and caps."""

    def __init__(self, defines: Mapping[str, str], files: SceneFiles) -> None:
        self.values = dict(defines)
        self.defaults: set[str] = set()
        self.files = files
        self.elements = 0
        self.includes = 0

    def opened(self, path: Path, shown: Path, above: tuple[Path, ...]) -> Element:
        """The root of one file, with everything below it."""
        root, found = _parsed(path, shown)
        self.elements += found
        if self.elements > MOST_ELEMENTS:
            raise MitsimError(f"{shown}: over {MOST_ELEMENTS} elements with all its includes; make the scene smaller")
        version = root.raw.get("version", "")
        if not re.fullmatch(r"[23]\.[0-9]{1,3}\.[0-9]{1,3}", version):
            raise root.refusal("version", version or "none", 'give the scene version="3.0.0"; 2 and 3 are read')
        self._resolve(root, (*above, path.resolve()))
        return root

    def _resolve(self, element: Element, above: tuple[Path, ...]) -> None:
        if element.tag == "default" and any("$" in element.raw.get(key, "") for key in ("name", "value")):
            raise element.refusal("default", element.raw.get("value", ""), "give a plain value without $")
        element.attributes = {key: self._substituted(element, text) for key, text in element.raw.items()}
        if element.tag == "default":
            name = element.name
            if not _NAME.fullmatch(name):
                raise element.refusal("default", repr(name), "its name has letters, digits and _ only")
            self.defaults.add(name)
            self.values.setdefault(name, element.attributes.get("value", ""))
        for child in element.children:
            self._resolve(child, above)
        if element.tag == "include":
            self._include(element, above)

    def _include(self, element: Element, above: tuple[Path, ...]) -> None:
        path = self.files.included(element, element.attributes.get("filename", ""))
        if path.resolve() in above:
            raise element.refusal("include", path.name, "it comes back to itself; remove one of the two")
        self.includes += 1
        if self.includes > MOST_INCLUDES or len(above) >= _DEEPEST_INCLUDE:
            rule = f"{MOST_INCLUDES} includes, {_DEEPEST_INCLUDE} deep, are allowed; join some"
            raise element.refusal("include", path.name, rule)
        root = self.opened(path, path, above)
        element.children += root.children if root.tag == "scene" else [root]

    def _substituted(self, element: Element, text: str) -> str:
        """The text with each ``$name`` replaced; only where no order of replacing can give another result."""
        if "\\" in text or not text.replace("\n", "").replace("\t", "").isprintable():
            raise element.refusal("text", repr(text), "backslashes and control characters are not allowed")

        def value(match: re.Match[str]) -> str:
            if match[1] not in self.values or match[2]:
                known = ", ".join(sorted(self.values)) or "none"
                rule = f"parameters that are set by then: {known}; separate two of them"
                raise element.refusal("parameter", cut(match[0]), rule)
            return self.values[match[1]]

        return _PARAMETER.sub(value, text)


def _parsed(path: Path, shown: Path) -> tuple[Element, int]:
    """The root element of a file and the number of its elements; parameters are not yet put in."""
    content = _content(path, shown)
    parser = expat.ParserCreate()
    parser.buffer_text = True
    roots: list[Element] = []
    stack: list[Element] = []
    count = 0

    def refuse(what: str) -> MitsimError:
        return MitsimError(f"{shown}:{parser.CurrentLineNumber}: {what}")

    def declared(version: str, encoding: str | None, standalone: int) -> None:
        if encoding is not None and encoding.lower() not in _ENCODINGS:
            raise refuse(f"encoding: got {cut(encoding)!r}; write the scene in UTF-8")

    def doctype(*_: object) -> None:
        raise refuse("DTDs and entities are not allowed in a scene; remove <!DOCTYPE ...>")

    def instruction(target: str, _: str) -> None:
        raise refuse(f"processing instructions are not allowed in a scene; remove <?{cut(target)} ...?>")

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if len(stack) >= DEEPEST:
            raise refuse(f"elements are nested over {DEEPEST} deep (<{cut(tag)}>); flatten the scene")
        if count > MOST_ELEMENTS:
            raise refuse(f"over {MOST_ELEMENTS} elements; make the scene smaller")
        element = Element(shown, parser.CurrentLineNumber, tag, attributes)
        (stack[-1].children if stack else roots).append(element)
        stack.append(element)

    parser.XmlDeclHandler = declared
    parser.StartDoctypeDeclHandler = doctype
    parser.ProcessingInstructionHandler = instruction
    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: stack.pop()
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise MitsimError(
            f"{shown}:{error.lineno}: not well-formed XML (column {error.offset}: {expat.ErrorString(error.code)}); "
            "mend the file"
        ) from None
    except ValueError as error:  # an encoding that Python does not know
        raise MitsimError(f"{shown}:1: not well-formed XML ({error}); write the scene in UTF-8") from None
    return roots[0], count


def _content(path: Path, shown: Path) -> bytes:
    try:
        with open(path, "rb") as file:
            content = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise MitsimError(f"{shown}: cannot be read ({error.strerror}); check the file") from None
    if len(content) > _MOST_BYTES:
        raise MitsimError(
            f"{shown}: over {_MOST_BYTES >> 20} MiB; a scene is smaller, its meshes have files of their own"
        )
    try:
        content.decode("utf-8")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise MitsimError(f"{shown}:{line}: not well-formed XML (no UTF-8); write the scene in UTF-8") from None
    if b"\0" in content:
        line = content.count(b"\n", 0, content.index(b"\0")) + 1
        raise MitsimError(f"{shown}:{line}: not well-formed XML (a zero byte); write the scene in UTF-8")
    return content

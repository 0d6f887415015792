"""Checks of images, meshes and measured materials before Mitsuba allocates memory for them.

Each function raises ValueError with a sentence that completes "the file ...", or OSError.
"""

from __future__ import annotations

import math
import re
import struct
from array import array
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core import exr
from mitsim.core.errors import cut

MOST_TEXELS = 1 << 25
"""An environment map of 8192 x 4096."""
FARTHEST = 1e7
_ORIENTATION = 274
_HEADER = 1 << 16
_GREY = ("1", "L", "LA", "I", "I;16")
"""Pillow's modes of pictures without colours."""
_PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
"""NumPy's type for each type in a header."""
_CORNERS, _INDICES = "corner count", "corner indices"
_LINE = re.compile(
    rb"f\s+(?P<face>(?:[1-9][0-9]{0,8}(?:/[0-9]{0,9}){0,2}(?:\s+|$)){3,})(?:#.*)?|"
    rb"v\s+(?P<vertex>\S+\s+\S+\s+\S+)(?:\s[^\r]*)?|(?P<normal>vn)\s[^\r]*|(?:mtllib|usemtl)\s+(?P<material>[^\r]*)|#[^\r]*|"
    rb"(?:g|l|o|p|s|vt|bevel|[cd]_interp|lod|maplib|mg|shadow_obj|trace_obj|usemap)(?:\s[^\r]*)?|"
)
"""Lines of Wavefront files that are read or ignored; free-form surfaces are refused (Wavefront, "Object Files")."""
_TURNED, _BENT = 1e-3, 1e-2
"""Parts of a face's area by which rounding may turn a triangle over, and triangles may exceed it (16 degrees).
"""
_MOST_TEXT, _MOST_PROFILE, _PROFILE_HEAD = 64 << 20, 4 << 20, 13
_MEASURED = {
    "phi_i": "p", "theta_i": "t", "ndf": "ab", "sigma": "cd", "vndf": "ptef", "luminance": "ptss", "jacobian": "1",
    "wavelengths": "w", "spectra": "ptwss", "rgb": "pt3ss",
}  # fmt: skip
"""Fields of a measured material, with a letter or number for the length of each axis."""
_GAP, _TURN_BEGINS, _MOST_FIELDS = 0.2, -170, 100
_NEGATIVE = 0.01
"""Part of its largest value by which a measured value may be negative."""


def check_image(path: Path) -> tuple[int, bool]:
    """Return the number of texels of an image, and True if it has no colours."""
    with open(path, "rb") as file:
        start = file.read(_HEADER)
    if start.startswith(exr.MAGIC):
        header = exr.read_header(path)
        width, height, grey = header.width, header.height, header.channels < 3
        if header.types not in ({"half"}, {"float"}):  # Mitsuba converts all to the first one, in silence
            raise ValueError(f"its channels are {' and '.join(sorted(header.types))}; save all as float, or as half")
    elif start.startswith(b"#?"):
        # This is the first line that Mitsuba could read as the size.
        size = next((line for line in start.split(b"\n") if b"-Y" in line), b"")
        (height, width), grey = _two_numbers(rb"-Y (\d{1,9}) \+X (\d{1,9})", size), False
    elif start[:2] in (b"PF", b"Pf"):
        (width, height), grey = _two_numbers(rb"P[Ff]\s+(\d{1,9})\s+(\d{1,9})\s.*", start), start[:2] == b"Pf"
    else:
        from PIL.Image import Exif
        from PIL.JpegImagePlugin import JpegImageFile
        from PIL.PngImagePlugin import PngImageFile

        reader = {b"\x89PN": PngImageFile, b"\xff\xd8\xff": JpegImageFile}.get(start[:3])
        if reader is None:
            raise ValueError("is no PNG, JPEG, OpenEXR, Radiance or PFM image; convert it")
        try:
            opened = reader(path)
        except (SyntaxError, OSError, ValueError):
            raise ValueError("is a damaged PNG or JPEG image; save it again") from None
        with opened as image:
            exif = Exif()  # not by getexif, which looks for it behind a PNG's pixels too, and decodes them
            try:
                exif.load(image.info.get("exif", b""))
                turned = exif.get(_ORIENTATION, 1)
            except Exception:  # of a damaged one, whatever its reader stumbles over
                raise ValueError("has damaged Exif data; save it again") from None
            if turned != 1:
                raise ValueError(f"has the orientation {turned}, which Mitsuba ignores; save it turned as it is seen")
            if getattr(image, "custom_mimetype", None) == "image/apng":
                raise ValueError("is animated, and Mitsuba shows its first picture alone; save that")
            (width, height), grey = image.size, image.mode in _GREY
    if width * height == 0 or width * height > MOST_TEXELS:
        raise ValueError(f"has {width}x{height} texels; 1 to {MOST_TEXELS} are allowed")
    return width * height, grey


def _two_numbers(pattern: bytes, header: bytes) -> tuple[int, int]:
    match = re.fullmatch(pattern, header, re.DOTALL)
    if not match:
        raise ValueError("is a damaged Radiance or PFM image; save it again")
    return int(match[1]), int(match[2])


def check_ply(path: Path) -> tuple[bool, str]:
    """Check a PLY mesh, because Mitsuba would read beyond its arrays.

    Return True if vertices have normals, and the name of the texture, "" without.
    """
    with open(path, "rb") as file:
        found = re.match(rb"ply\r?\n.*?\nend_header\r?\n", file.read(_HEADER), re.DOTALL)
        if not found:
            raise ValueError("is no PLY mesh; its header must end within 64 KiB")
        file.seek(found.end())
        body = file.read()
    order, parts = _ply_header(found[0])
    if order is None and len(body) > _MOST_TEXT:
        raise ValueError(f"is a text of over {_MOST_TEXT >> 20} MiB; export it as binary")
    # A text is an array of words, all of which are read as double precision.
    words = body.split() if order is None else []
    types = dict[str, np.dtype[np.void]]()
    for part, (_, properties) in parts.items():
        fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
        for name, kind in properties:
            if " " in kind:
                length, item = ("f8", "f8") if order is None else [order + each for each in kind.split()]
                fields += [(_CORNERS, length), (_INDICES, item, (3,))]
            else:
                fields.append((name, "f8" if order is None else order + kind))
        types[part] = np.dtype(fields)
    widths = [types[name].itemsize // (8 if order is None else 1) for name in parts]
    starts = np.cumsum([0, *(count * width for (count, _), width in zip(parts.values(), widths, strict=True))]).tolist()
    held, count = len(words if order is None else body), parts["vertex"][0]
    if starts[-1] > held:
        holder = "text holds" if order is None else "bytes hold"
        counts = f"{count} vertices and {parts['face'][0]} triangles"
        raise ValueError(f"claims {counts}, more than its {holder}; export the mesh again")
    rows: dict[str, npt.NDArray[Any]] = {}
    for name, start, end in zip(parts, starts, starts[1:], strict=False):
        if name not in ("vertex", "face"):
            continue
        if order is not None:
            rows[name] = np.frombuffer(body, types[name], parts[name][0], start)
            continue
        try:
            numbers = np.array(words[start:end]).astype(np.float64)
        except ValueError:
            raise ValueError("holds words that are no numbers; export the mesh again") from None
        rows[name] = numbers.view(types[name])
    vertex, corners = rows["vertex"], rows["face"][_INDICES]
    if (rows["face"][_CORNERS] != 3).any():
        raise ValueError("has faces that are no triangles; export triangles")
    if held > starts[-1]:
        raise ValueError("holds more than its header claims; export the mesh again")
    if not np.isfinite(corners).all():
        raise ValueError("has corners that are no numbers; export the mesh again")
    _check_points(np.stack([vertex[axis].astype(np.float64) for axis in "xyz"]))
    low, high = corners.astype(np.int64).min(), corners.astype(np.int64).max()
    if low < 0 or high >= count:
        raise ValueError(f"has faces with vertices {low} to {high}, but {count} vertices; mend the mesh")
    texture = re.search(rb"\ncomment TextureFile ([^\r\n]*)", found[0])
    named = texture[1].decode("utf-8", "replace").strip() if texture else ""
    return {"nx", "ny", "nz"} <= dict(parts["vertex"][1]).keys(), named


_Properties = list[tuple[str, str]]


def _ply_header(header: bytes) -> tuple[str | None, dict[str, tuple[int, _Properties]]]:
    """Return the byte order (None for text) and the elements in order.

    Whole numbers as coordinates are refused because Mitsuba divides them by the largest of their type.
    """
    order: str | None = ""
    parts: dict[str, tuple[int, _Properties]] = {}
    for line in header.split(b"\n")[1:-2]:
        # Lines are split as in C, because Python splits at further blanks and line ends that Mitsuba ignores.
        words = [word.decode("ascii", "replace") for word in line.split()]
        kinds = words[2:4] if words[:2] == ["property", "list"] else words[1:2]
        match words:
            case ["comment", *_] | []:
                continue
            case ["format", name, _]:
                order = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}.get(name, "")
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,9}", count) and name not in parts:
                parts[name] = (int(count), [])
            case ["property", *_, name] if parts and len(words) in (3, 5) and {*kinds} <= _PLY_TYPES.keys():
                parts[[*parts][-1]][1].append((name, " ".join(_PLY_TYPES[kind] for kind in kinds)))
            case _:
                raise ValueError(f"has a header line that is not understood ({' '.join(words)[:40]!r}); remove it")
    if order == "" or not {"vertex", "face"} <= parts.keys():
        raise ValueError("has no format, or no elements vertex and face; export vertices and triangles")
    for element, (rows, properties) in parts.items():
        names = [name for name, _ in properties]
        if len({*names}) != len(names):
            raise ValueError(f"has two properties of one name in element {element[:40]}; export the mesh again")
        if rows and not names:
            raise ValueError(f"has an element {element[:40]} without properties; export the mesh again")
        if element != "face" and any(" " in kind for _, kind in properties):
            raise ValueError(f"has a list in element {element[:40]}; export vertices and triangles alone")
    kinds_of = dict(parts["vertex"][1])
    if not all(kinds_of.get(axis, "") in ("f4", "f8") for axis in "xyz"):
        raise ValueError("has vertices without x, y, z of type float or double; export the mesh again")
    if [name for name, kind in parts["face"][1] if " " in kind] not in (["vertex_index"], ["vertex_indices"]):
        raise ValueError("has faces without one list vertex_indices, or with others; export triangles alone")
    if not parts["face"][0]:
        raise ValueError("has no triangles: it is a cloud of points; export a mesh")
    return order, parts


def read_measured(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Return the fields of a measured material by name; it has ``spectra`` and ``wavelengths``, or ``rgb``.

    Small negative values, which noise and narrow colours cause, become 0.
    """
    content = path.read_bytes()
    try:
        fields = _tensors(content)
    except (struct.error, UnicodeDecodeError):
        fields = {}
    wanted = {*_MEASURED} - ({"rgb"} if "wavelengths" in fields else {"spectra", "wavelengths"})
    if not wanted <= fields.keys():
        raise ValueError("is no measured material in the tensor format, or a damaged one; fetch it again")
    table, lengths = dict[str, npt.NDArray[Any]](), {"1": 1, "3": 3}
    for name in sorted(wanted, key=[*_MEASURED].index):
        kind, start, shape = fields[name]
        axes, item = _MEASURED[name], np.dtype("u1" if name == "jacobian" else "<f4")
        fits = kind == (1 if name == "jacobian" else 10) and len(shape) == len(axes)
        if not fits or any(lengths.setdefault(axis, size) != size for axis, size in zip(axes, shape, strict=True)):
            raise ValueError(f"has a field {name} of another type or shape than its format has; fetch it again")
        if start + math.prod(shape) * item.itemsize > len(content):
            raise ValueError(f"claims more values of {name} than it holds; fetch it again")
        values = np.frombuffer(content, item, math.prod(shape), start).reshape(shape).astype(item)
        low, high = float(values.min(initial=0)), float(values.max(initial=0))
        if not np.isfinite(values).all() or (name != "phi_i" and low < -_NEGATIVE * high):
            raise ValueError(f"has {name} that are negative or not finite; fetch it again")
        table[name] = values if name == "phi_i" else np.maximum(values, 0)
    if min(lengths[axis] for axis in "abcdefst") < 2 or not lengths["p"] or lengths.get("w", 2) < 2:
        raise ValueError("has an axis of a single value; a table is interpolated between two or more")
    for name, end in (("phi_i", np.pi), ("theta_i", np.pi / 2), ("wavelengths", np.inf)):
        if name in table and (np.any(np.diff(table[name]) <= 0) or np.abs(table[name]).max() > end + 1e-5):
            raise ValueError(f"has {name} that do not grow, or lie outside their range; fetch it again")
    first, last = np.degrees(table["phi_i"][[0, -1]])
    parts = 360 / (last - first) if lengths["p"] > 2 else 1
    if min(abs(parts - whole) for whole in (1, 2, 4)) > _GAP or (lengths["p"] > 2 and first > _TURN_BEGINS):
        rule = "a whole turn, a half or a quarter is read, from -180 degrees on"
        raise ValueError(f"has phi_i of {first:.4g} to {last:.4g} degrees; {rule}")
    if min(table[name].sum(axis=(2, 3)).min() for name in ("vndf", "luminance")) <= 0 or (
        table["jacobian"][0] and not table["sigma"].all()
    ):
        raise ValueError("has a direction without light in vndf, luminance or sigma; fetch it again")
    return table


def _tensors(content: bytes) -> dict[str, tuple[int, int, tuple[int, ...]]]:
    """Return type, offset and shape of each field of a file in Mitsuba's tensor format."""
    fields, at = dict[str, tuple[int, int, tuple[int, ...]]](), 18
    head, version, count = struct.unpack_from("<12sHI", content)
    for _ in range(count if head == b"tensor_file\0" and version == 1 and count < _MOST_FIELDS else 0):
        (length,) = struct.unpack_from("<H", content, at)
        name, at = content[at + 2 : at + 2 + length].decode(), at + 2 + length
        dimensions, kind, offset = struct.unpack_from("<HBQ", content, at)
        fields[name] = kind, offset, struct.unpack_from(f"<{dimensions}Q", content, at + 11)
        at += 11 + 8 * dimensions
    return fields


def read_ies(path: Path) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]]:
    """Return vertical angles, horizontal angles [degrees] and candelas by (horizontal, vertical) of an IES profile."""
    if path.stat().st_size > _MOST_PROFILE:
        raise ValueError(f"is over {_MOST_PROFILE >> 20} MiB; an IES profile is smaller")
    head, tilt, body = path.read_bytes().partition(b"TILT=NONE")
    if not head.startswith(b"IES") or not tilt:
        raise ValueError("is no IES profile with the line TILT=NONE (LM-63); export it without tilt")
    try:
        numbers = np.array(re.split(rb"[\s,]+", body.strip()), dtype=np.float64)
    except ValueError:
        numbers = np.full(1, np.nan)
    if numbers.size < _PROFILE_HEAD or not np.isfinite(numbers).all():
        raise ValueError("holds words that are no numbers below TILT=NONE, or too few; export it again")
    (count, turns, kind), rest = numbers[3:6], numbers[_PROFILE_HEAD:]
    if kind != 1:
        raise ValueError(f"has photometric type {kind:g}; type C, 1, is read, so export that")
    if count % 1 or turns % 1 or count < 2 or turns < 1 or rest.size != count + turns + count * turns:
        raise ValueError(f"claims {count:g} x {turns:g} angles and holds {rest.size} numbers; export it again")
    vertical, horizontal, candela = np.split(rest, np.cumsum(numbers[3:5].astype(int)))
    fits = vertical[0] in (0, 90) and vertical[-1] in (90, 180) and horizontal[0] == 0
    if not fits or horizontal[-1] not in (0, 90, 180, 360):
        raise ValueError("has angles beyond 0 to 180 and 0 to 0, 90, 180 or 360 degrees; export those of type C")
    if np.any(np.diff(vertical) <= 0) or np.any(np.diff(horizontal) <= 0):
        raise ValueError("has angles that do not grow; export it again")
    if candela.min() < 0 or candela.max() <= 0:
        raise ValueError("has negative candelas, or no light; export it again")
    return vertical, horizontal, candela.reshape(horizontal.size, vertical.size)


def check_obj(path: Path) -> tuple[bool, str]:
    """Check that Mitsuba reads a Wavefront mesh correctly.

    Mitsuba drops continued lines, faces that it cannot read, and free-form surfaces, and covers concave faces by a fan
    that overlaps. Return True if any vertices have normals, and the name of the materials, "" without.
    """
    if path.stat().st_size > _MOST_TEXT:
        raise ValueError(f"is a text of over {_MOST_TEXT >> 20} MiB; export it as binary PLY")
    vertices, fans, normals, material = list[list[bytes]](), array("q"), False, b""
    with open(path, "rb") as file:
        for number, line in enumerate(map(bytes.strip, file), 1):
            found = _LINE.fullmatch(line)
            if not found or line.endswith(b"\\"):
                rule = "no line may end in a backslash, vertices have three numbers, and faces have three or more"
                shown = cut(line.decode("latin-1"))
                raise ValueError(f"has a line that is not understood, {number} ({shown!r}); {rule} corners from 1 on")
            if found["vertex"]:
                vertices.append(found["vertex"].split())
            elif found["face"]:
                corners = [int(corner.partition(b"/")[0]) - 1 for corner in found["face"].split()]
                for after, before in pairwise(corners[1:]):
                    fans.extend((number, corners[0], after, before))
            normals, material = normals or bool(found["normal"]), material or found["material"] or b""
    try:
        points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    except ValueError:
        raise ValueError("holds vertices that are not three numbers; export the mesh again") from None
    _check_points(points)
    if not fans:
        raise ValueError("has no faces: it is a cloud of points; export a mesh")
    lines, *corner = np.frombuffer(fans, np.int64).reshape(-1, 4).T
    if np.max(corner) >= len(points):
        raise ValueError(f"has faces with vertex {np.max(corner) + 1}, but {len(points)} vertices; mend the mesh")
    first, after, before = points[np.array(corner)]
    areas = np.cross(after - first, before - first)  # vectors, twice as long as a triangle is large
    lines, face = np.unique(lines, return_inverse=True)
    whole = np.stack([np.bincount(face, along, len(lines)) for along in areas.T], axis=1)
    size, sums = np.square(whole).sum(axis=1), np.bincount(face, np.linalg.norm(areas, axis=1), len(lines))
    turned = lines[face[(areas * whole[face]).sum(axis=1) < -_TURNED * size[face]]]
    bent = lines[sums > (1 + _BENT) * np.sqrt(size)]
    for wrong, why in ((turned, "is concave, or crosses itself"), (bent, "lies in no plane")):
        if wrong.size:
            raise ValueError(f"has a face that {why}, in line {wrong[0]}; triangulate the mesh")
    return normals, material.decode("utf-8", "replace")


def _check_points(points: npt.NDArray[np.float64]) -> None:
    if not np.isfinite(points).all() or np.abs(points).max(initial=0) > FARTHEST:
        raise ValueError(f"has vertices that are not finite or beyond {FARTHEST:g} mm; mend the mesh")

"""Pictures and meshes of the user in the tree of a checked scene, converted to files that Mitsuba reads.

A picture becomes the reflectances of a sheet (:func:`mitsim.core.prepare.read_reflectance`), in the middle of a
square. A mesh is moved and scaled before the scene's own ``to_world`` acts: its longest side is 1, it stands on the
plane y = 0, and the middle of its box is over the origin.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import mitsuba as mi
import numpy as np

from mitsim.core.errors import MitsimError
from mitsim.core.prepare import fit_square, read_reflectance
from mitsim.scene.check import PICTURE, CheckedScene
from mitsim.scene.headers import check_obj, check_ply
from mitsim.scene.tree import placement_of, tilts

_BEHIND = 0.01
"""Part of a mesh's corners whose normal may oppose the winding of the face, because of slivers."""


@contextmanager
def with_own_files(checked: CheckedScene) -> Iterator[None]:
    """Prepare the files that the user named; the prepared files exist within the context.

    Raises
    ------
    MitsimError
        For a picture that is no reflectance, a mesh without faces or with normals that point inwards, and if files
        cannot be written.
    """
    with ExitStack() as stack:
        for node in checked.state.nodes:
            name = str(node.props["filename"]) if "filename" in node.props else ""
            if name not in checked.own:
                continue
            if checked.own[name] == PICTURE:
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
                node.props["filename"] = str(_print(Path(name), folder))
                node.props["raw"] = True
            else:
                checked.unread[name] = _stand(node.props, Path(name))
        yield


def _print(path: Path, folder: Path) -> Path:
    square = fit_square(read_reflectance(path))
    codes = np.rint(255 * square)
    # As a shipped print's where that holds them: the same file gives the same frames, whichever way it is named.
    whole = bool(np.abs(codes - 255 * square).max() < _ROUNDING)
    made = folder / f"picture{'.png' if whole else '.exr'}"
    values = codes.astype(np.uint8) if whole else square.astype(np.float32)
    try:
        mi.Bitmap(values[..., None]).write(str(made))
    except RuntimeError as error:
        raise MitsimError(f"picture {path}: {made} cannot be written ({error}); set TMPDIR to another folder") from None
    return made


_ROUNDING = 1e-9
"""Rounding of 8-bit codes that were divided by 255 and are multiplied again."""


def _stand(props: mi.Properties, path: Path) -> str:
    kinds = {".ply": check_ply, ".obj": check_obj}
    kind = path.suffix.lower()
    if kind not in kinds:
        raise MitsimError(f"object {path}: ends in {kind or 'nothing'}; read are .ply (triangles) and .obj")
    try:
        smooth, unread = kinds[kind](path)
        mesh = mi.load_dict({"type": kind[1:], "filename": str(path)})
    except (ValueError, RuntimeError, OSError) as error:
        said = str(error).strip().splitlines()[-1]
        raise MitsimError(f"object {path}: the file {said}") from None
    props.set_plugin_name(kind[1:])
    props["filename"] = str(path)
    props["face_normals"] = not smooth  # Mitsuba would smooth the edges of a mesh that states no normals
    _, sides = tilts(props)
    behind = int((sides < 0).sum())
    if behind > _BEHIND * sides.size:
        raise MitsimError(
            f"object {path}: the normals of {behind} of {sides.size} corners face against the way that their faces are "
            "wound; recompute normals outwards, or export without"
        )
    corners = np.array(mi.traverse(mesh)["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    longest = float((high - low).max())
    if longest <= 0:
        raise MitsimError(f"object {path}: all its vertices are one point; export the mesh again")
    middle = (low + high) / 2
    upright = np.diag([1 / longest, 1 / longest, 1 / longest, 1.0])
    upright[:3, 3] = -np.array([middle[0], low[1], middle[2]]) / longest
    props["to_world"] = mi.ScalarAffineTransform4d(placement_of(props) @ upright)
    return unread

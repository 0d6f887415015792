"""A picture or a mesh of the user's in; a bench whose sheet shows it, or on whose shelf it stands, out."""

from __future__ import annotations

import hashlib
import tempfile
from pathlib import Path
from typing import Any

from mitsim.api.bench import Bench, open_bench
from mitsim.core.errors import ArgumentError, check_arguments, is_masked

_LIT_MM = 120.0
"""Side of what the projector lights of a sheet 400 mm away, as all flat scenes have it: 128 pixels of 0.9375 mm."""


@check_arguments
def flat_scene(picture: Any, size_mm: float = _LIT_MM, distance_mm: float = 400.0, **options: Any) -> Bench:
    """The scene ``photograph`` with a picture of yours on its sheet.

    Parameters
    ----------
    picture
        a PNG, TIFF, NPY, OpenEXR or JPEG file, or an array (rows, columns) or (rows, columns, 3). Its numbers are
        reflectances, 0 to 1, of whole numbers the part of their type's largest; of colours the mean is taken. It is as
        high to wide as its pixels are; what is left of the sheet is black.
    size_mm
        side of the sheet, and longer side of the picture [mm]. At 400 mm the projector lights 120 mm: there an array
        of 128 x 128 numbers has one for each of its pixels.
    distance_mm
        from the camera to the sheet [mm]. The bench stays aligned to 400 mm, and so does its calibration.
    **options
        other arguments of :func:`mitsim.open_bench`: ``camera``, ``projector``, ``variant``, parameters of the scene.

    Returns
    -------
    the bench; its truth is the picture where the projector lights it.

    Raises
    ------
    MitsimError
        for a picture that cannot be read or whose numbers are no reflectances, and as :func:`mitsim.open_bench`.
    """
    path = picture if isinstance(picture, str | Path) else _write_array(picture)
    return open_bench("photograph", picture=path, sheet_mm=size_mm, sheet_z=distance_mm, **options)


@check_arguments
def shelf_scene(
    mesh: Path | str, size_mm: float = 60.0, reflectance: float = 0.7, turn_deg: float = 0.0, **options: Any
) -> Bench:
    """The scene ``shelf`` with an object of yours.

    Parameters
    ----------
    mesh
        a PLY file of triangles, or an OBJ file; its y axis is up. It is centred, and stands on the shelf.
    size_mm
        its longest side [mm].
    reflectance
        of its matt surface, on either side, 0 to 1.
    turn_deg
        about its upright axis [degrees].
    **options
        other arguments of :func:`mitsim.open_bench`.

    Raises
    ------
    MitsimError
        for a mesh that cannot be read, has no faces, or normals that face into it, and as :func:`mitsim.open_bench`.
    """
    stated: dict[str, Any] = {"object_mm": size_mm, "object_albedo": reflectance, "object_turn": turn_deg}
    return open_bench("shelf", object=mesh, **stated, **options)


_ALLOWED = "give a file, or an array of real numbers 0 to 1 or of unsigned ones, (rows, columns) or (rows, columns, 3)"


def _write_array(picture: object) -> Path:
    """A file that holds an array, by its content: who opens the same scene again, in another process, finds it."""
    import numpy as np

    try:
        values = np.asarray(picture)
    except ValueError as error:
        raise ArgumentError("picture", f"{error}; {_ALLOWED}") from None
    if (
        is_masked(picture)
        or values.dtype.kind not in "buf"
        or values.ndim not in (2, 3)
        or values.shape[2:] not in ((), (1,), (3,))
    ):
        raise ArgumentError(
            "picture",
            f"got {'masked ' * is_masked(picture)}numbers of type {values.dtype} and shape {values.shape}; {_ALLOWED}",
        )
    most = float(np.iinfo(values.dtype).max) if values.dtype.kind == "u" else 1.0
    values = values.astype(np.float64) / most
    values = values.mean(axis=2) if values.ndim == 3 else values
    digest = hashlib.sha256(f"{values.shape}".encode() + values.tobytes()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / "mitsim-pictures"
    folder.mkdir(exist_ok=True)
    path = folder / f"{digest}.npy"
    if not path.is_file():
        with tempfile.NamedTemporaryFile(dir=folder, suffix=".npy", delete=False) as file:
            np.save(file, values)
        Path(file.name).replace(path)  # whole, or not at all
    return path

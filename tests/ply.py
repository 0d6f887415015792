"""Meshes as texts of the Stanford format, for tests that need a file of a few triangles."""

from collections.abc import Iterable, Sequence


def ply_text(rows: Sequence[Sequence[float]], faces: Iterable[Sequence[int]], comment: str = "") -> str:
    """Return a mesh of corners ``rows``, whose last three of six numbers are a normal, and of triangles ``faces``."""
    names, triangles = ("x", "y", "z", "nx", "ny", "nz")[: len(rows[0])], [(3, *face) for face in faces]
    header = ["ply", "format ascii 1.0", *filter(None, [comment]), f"element vertex {len(rows)}"]
    header += [*(f"property float {name}" for name in names), f"element face {len(triangles)}"]
    header += ["property list uchar int vertex_indices", "end_header"]
    return "\n".join([*header, *(" ".join(map(str, row)) for row in [*rows, *triangles])]) + "\n"

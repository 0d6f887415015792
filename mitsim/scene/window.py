"""A projector's picture in; how many pixels a side it lights out, where that is known without the renderer."""

from __future__ import annotations

from pathlib import Path

_MODES = ("1", "L", "RGB")
"""Of pictures whose dark texels are 0 in every channel, and nothing else is."""
_MOST_TEXELS = 1 << 24
"""A picture of 4096 x 4096, decoded in 0.1 s."""


def lit_side(picture: Path) -> int | None:
    """Rows and columns of the lit square in the PNG file ``picture``; None where it is no such picture: what is wrong
    with it, :func:`mitsim.scene.projector.locate_projector` says."""
    from PIL.PngImagePlugin import PngImageFile

    try:
        with PngImageFile(picture) as image:
            if image.mode not in _MODES or image.width * image.height > _MOST_TEXELS:
                return None
            left, top, right, bottom = image.getbbox() or (0, 0, 0, 0)
    except (SyntaxError, OSError, ValueError):
        return None
    return right - left if right - left == bottom - top > 0 else None

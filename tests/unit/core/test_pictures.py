"""Pictures for people: what is in the PNG, and what stands around it in a notebook."""

import io

import numpy as np
from PIL import Image

from mitsim.core.images import card, normalise, png, span, table


def opened(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)), dtype=float)


def test_a_picture_is_grey_cut_and_curved() -> None:
    """0.5 is 0.7354 on the sRGB curve (IEC 61966-2-1)."""
    assert np.array_equal(opened(png([[-1.0, 0.0, 0.5, 1.0, 7.0]])), [[0, 0, np.rint(255 * 0.7354), 255, 255]])


def test_a_large_picture_is_averaged_never_thinned() -> None:
    """Every second row of a fine pattern would show another pattern."""
    stripes = np.tile([0.0, 1.0], (10, 5))
    small = opened(png(stripes, largest=5))
    assert small.shape == (5, 5) and np.all(np.abs(small - 127.5) <= 1)
    assert opened(png(stripes, largest=10)).shape == (10, 10)
    assert opened(png(np.ones((9, 4)), largest=4)).shape == (3, 2)


def test_a_span_is_short() -> None:
    assert span([[65520.0, 12.0]], "DN") == "12 to 65520 DN"
    assert span([0.00098642, 0.0104], "W/m^2") == "0.000986 to 0.0104 W/m^2"


def test_scaled_numbers_fill_their_range() -> None:
    assert np.array_equal(normalise([2, 4, 3]), [0, 1, 0.5]) and np.array_equal(normalise([[5, 5]]), [[0, 0]])


def test_text_is_escaped_and_numbers_stand_right() -> None:
    assert "a &lt; b" in card("a < b", {"c & d": [[0.5]]}, ["e > f"])
    shown = table("t", ("name", "x [s]"), [("long" * 10, "1.5")], ["fact"], numbers=1)
    assert shown.count("text-align:right") == 2 and shown.count("text-align:left") == 2
    assert shown.count("nowrap") == 3  # not the long one

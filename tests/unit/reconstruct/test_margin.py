"""Light from outside the projector's window: what a margin takes up of it, on an ideal camera; nothing is rendered."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.runs import Capture
from mitsim.devices.camera import centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.focus import widen_factors
from mitsim.reconstruct.reconstruct import reconstruct
from tests.ideal_sessions import PITCH, PIXELS, Bench, picture
from tests.shadow_factor import scene_factor
from tests.unit.reconstruct.test_focus import PARALLAX, WINDOW, N, shadow

CARD = 3
"""Columns of cells beside the window that are lit, all rows of them."""


def wide() -> np.ndarray:
    """(PIXELS, N + 2 CARD) closed-form factor of a wider window."""
    edges = centred_edges(N + 2 * CARD, WINDOW / N) * 400
    return scene_factor(mls_mask().terms[0][1], 0.06, centred_edges(PIXELS, PITCH), edges, 2.0, 400.0)


def calibrated() -> Factors:
    factors = Bench(shadow(400.0, 0, baseline=(0, 0)), shadow(400.0, 1, baseline=(0, 0))).calibrated(0)
    return replace(factors, manifest=factors.manifest.model_copy(update={"parallax": PARALLAX}))


def shots(patterns: str, bright: float) -> Capture:
    """Frames of the window, and of a card on its left as bright as so many boards, whatever the pattern."""
    own = shadow(400.0, 0)
    card = np.zeros((N + 2 * CARD,) * 2)
    card[CARD:-CARD, :CARD] = bright
    outside = wide() @ card @ wide().T

    class Lit(Bench):
        def light(self, shown: np.ndarray) -> np.ndarray:
            return super().light(shown) + outside

    return Lit(own, own).run(patterns, picture(n=N), 0)


def psnr(image: np.ndarray) -> float:
    return -10 * float(np.log10(np.mean(np.square(image - picture(n=N)))))


@pytest.mark.parametrize(("patterns", "bright", "gained"), [("uniform", 1.0, 9), ("dots:4", 0.03, 18)])
def test_a_margin_takes_up_light_from_outside_the_window(patterns: str, bright: float, gained: float) -> None:
    """All but 3 dB of what a card costs; the image and its uncertainty are of the window. (Planted: the margin dark
    in all patterns; the image not cropped; the margin on the far side alone.)"""
    seen, factors = shots(patterns, bright), calibrated()
    without, found = reconstruct(seen, factors), reconstruct(seen, factors, margin=CARD)
    assert found.image.shape == (N, N) == found.uncertainty.shape
    assert psnr(found.image) > psnr(without.image) + gained
    assert found.inputs["margin"] == CARD and "margin" not in without.inputs


def test_a_margins_factors_are_those_of_a_wider_window() -> None:
    """With its parallax: cells are as wide as the window's, and move as they would. (Planted: the parallax as it was;
    one side's cells.)"""
    found = widen_factors(calibrated(), 4)
    known, rows = found.factors.manifest.parallax, found.rows.stop - found.rows.start
    assert PIXELS - 12 < rows < PIXELS and found.factors.left.shape == (rows, N + 8)
    cell = WINDOW / N
    assert known.row_tan == pytest.approx((-WINDOW / 2 - 4 * cell, WINDOW / 2 + 4 * cell))
    assert known.column_mm == pytest.approx(PARALLAX.column_mm) and known.depth_mm == PARALLAX.depth_mm


def test_what_a_margin_cannot_do_is_refused() -> None:
    """(Planted: signed patterns let pass; columns of 100 000 cells formed, which overflows.)"""
    seen, factors = shots("dots:4", 0.0), calibrated()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for margin in (-1, 1.5, True, N + 1, 100_000):
            with pytest.raises(ArgumentError, match="margin"):
                reconstruct(seen, factors, margin=margin)
    with pytest.raises(ArgumentError, match="leave out focus"):
        reconstruct(seen, factors, margin=1, focus=380.0)
    with pytest.raises(MitsimError, match="patterns of -1"):
        reconstruct(shots("hadamard:4", 0.0), factors, margin=1)
    bare = replace(factors, manifest=factors.manifest.model_copy(update={"parallax": None}))
    with pytest.raises(MitsimError, match="does not state its parallax"):
        reconstruct(seen, bare, margin=1)

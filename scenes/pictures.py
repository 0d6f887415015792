"""Nothing in, drawn 8-bit grey pictures out: what is printed on the objects of the shipped scenes.

All reflectances are chosen, between 0.05 and 0.90 as on ordinary print. Lengths are mm on the object.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from drawing import Grey, Sheet, text_width

INK, PAPER = 0.06, 0.85
# A unit circle in steps of 22.5 degrees, tabulated: a platform's own sine may differ in the last bit.
_EIGHTHS = (0.0, 0.3826834, 0.7071068, 0.9238795, 1.0)


def _unit(step: int) -> tuple[float, float]:
    """(cos, sin) of `step` times 22.5 degrees."""
    step %= 16
    quarter, rest = divmod(step, 4)
    cosine, sine = _EIGHTHS[4 - rest], _EIGHTHS[rest]
    return ((cosine, sine), (-sine, cosine), (-cosine, -sine), (sine, -cosine))[quarter]


def front_card() -> Grey:
    """(216, 272) grey, 68 x 54 mm: the near card, a dark frame, its name, a star and a moon."""
    sheet = Sheet(68, 54, 4, INK)
    sheet.box(-31, -24, 31, 24, PAPER)
    sheet.text("FRONT", -27, 6, 13, INK)
    sheet.text("370", -27, -19, 9, 0.3)
    sheet.disc(6, -10, 9, 0.45)
    sheet.disc(9.5, -8, 7.5, PAPER)
    star = [(22 + r * c, -10 + r * s) for k in range(8) for r, (c, s) in [((9, 3.5)[k % 2], _unit(2 * k + 4))]]
    sheet.polygon(star, INK)
    return sheet.grey()


def back_card() -> Grey:
    """(576, 576) grey, 144 x 144 mm: the far card, its name twice, rings, a triangle, squares and a grey scale."""
    sheet = Sheet(144, 144, 4, 0.75)
    sheet.text("BACK CARD", -60, 38, 15, INK)
    sheet.disc(44, 4, 22, 0.10, hole=16)
    sheet.disc(44, 4, 11, 0.35)
    sheet.polygon([(-62, 2), (-34, 2), (-48, 30)], 0.20)
    for index in range(4):
        sheet.box(-20 + 9 * index, 8, -12 + 9 * index, 28, 0.05 + 0.15 * index)
    sheet.text("430", 22, -42, 14, 0.15)
    for row in range(4):
        for column in range(row % 2, 9, 2):
            sheet.box(8 + 6 * column, -66 + 4 * row, 14 + 6 * column, -62 + 4 * row, INK)
    sheet.text("BEHIND", -60, -30, 12, 0.3)  # the near card covers most of it
    return sheet.grey()


def bench_chart() -> Grey:
    """(512, 512) grey, 128 x 128 mm: a technical chart with a title, a star of spokes, a diagram, a grey scale, lines
    of text from 8 down to 2 mm and bars from 4 to 1 mm wide."""
    sheet = Sheet(128, 128, 4, PAPER)
    sheet.box(-58, 44, 58, 58, 0.12)
    sheet.text("BENCH CHART 7", -54, 46.5, 9, PAPER)
    for k in range(0, 16, 2):
        (c, s), (d, t) = _unit(k), _unit(k + 1)
        sheet.polygon([(-34, 18), (-34 + 22 * c, 18 + 22 * s), (-34 + 22 * d, 18 + 22 * t)], INK)
    sheet.disc(-34, 18, 4, PAPER)
    sheet.disc(-34, 18, 2.5, INK)
    _diagram(sheet)
    for index in range(9):
        sheet.box(-58 + 6.5 * index, -16, -51.5 + 6.5 * index, -8, 0.05 + 0.10 * index)
    bottom = -28.0
    for height, words in (
        (8.0, "MASK 2 MM"),
        (6.0, "LENS NONE"),
        (4.0, "SCENE 400 MM"),
        (3.0, "120 MM WIDE"),
        (2.0, "END"),
    ):
        sheet.text(words, -58, bottom, height, INK)
        bottom -= 0.75 * height + 2.5
    left = 14.0
    for width in (4.0, 3.0, 2.0, 1.0):
        for _ in range(2):
            sheet.box(left, -56, left + width, -32 - 12 / width, INK)
            left += 2 * width
    sheet.polygon([(58, -24), (58, -34), (48, -24)], 0.4)
    return sheet.grey()


def _diagram(sheet: Sheet) -> None:
    """Axes, a grid of 8 mm and a falling curve, in the upper right of the chart."""
    for k in range(6):
        sheet.box(4 + 10 * k, -6, 4.5 + 10 * k, 38, 0.55)
        sheet.box(4, -6 + 8 * k, 56, -5.5 + 8 * k, 0.55)
    sheet.box(3, -7, 58, -5, INK)
    sheet.box(3, -7, 5, 40, INK)
    points = [(4 + x, -5 + 40 / (1 + x / 8)) for x in range(0, 51, 2)]
    for start, end in pairwise(points):
        sheet.line(start, end, 2.0, 0.2)
    sheet.text("1/Z", 36, 22, 8, INK)


def cookie_bag() -> Grey:
    """(400, 304) grey, 76 x 100 mm: the bag's print. Ribbed seams, its name on a dark band, six cookies with chips, the
    weight. Chips lie at random, seed 1."""
    sheet = Sheet(76, 100, 4, 0.72)
    for k in range(38):  # ribs of the two seams
        for bottom, top in ((42, 50), (-50, -46)):
            sheet.box(-38 + 2 * k, bottom, -37 + 2 * k, top, 0.45)
    sheet.box(-38, 12, 38, 33, 0.08)
    sheet.box(-38, 10.5, 38, 11.5, 0.08)
    sheet.text("COOKIES", -text_width("COOKIES", 10) / 2, 17.5, 10, 0.88)
    chips = np.random.default_rng(1)
    for x, y, radius in ((-21, -4, 10.5), (1, -1, 9.5), (22, -6, 10.5), (-13, -26, 10), (9, -22, 9), (26, -27, 8)):
        _cookie(sheet, x, y, radius, chips)
    sheet.text("150 G", -30, -43.5, 5.5, INK)
    return sheet.grey()


def _cookie(sheet: Sheet, x: float, y: float, radius: float, chips: np.random.Generator) -> None:
    sheet.disc(x, y, radius, 0.22)
    sheet.disc(x, y, radius - 0.9, 0.48)
    for _ in range(9):
        while True:
            dx, dy = (2 * chips.random(2) - 1) * radius
            if dx * dx + dy * dy < (radius - 2.6) ** 2:
                break
        sheet.disc(x + dx, y + dy, 1.0 + 0.7 * chips.random(), INK)


def cardboard_box() -> Grey:
    """(336, 320) grey, 80 x 84 mm: the box's front, left side and top as `meshes.box` lays them out."""
    sheet = Sheet(80, 84, 4, 0.42)
    # Front: x from -40 to 4, y from -6 to 42.
    sheet.box(-38, -4, 2, 40, 0.60)
    sheet.text("TEA", -text_width("TEA", 11) / 2 - 18, 24, 11, INK)
    sheet.disc(-18, 8, 9, 0.15)
    sheet.disc(-18, 8, 6.5, 0.75)
    sheet.polygon([(-23, 8), (-18, 13), (-13, 8), (-18, 3)], 0.15)
    # Left side: x from 4 to 40, y from -6 to 42.
    sheet.box(4, 28, 40, 34, 0.10)
    sheet.text("NO 5", 8, 12, 9, 0.12)
    for k, width in enumerate((1.5, 0.8, 2.2, 1.2, 0.8, 1.8, 1.0)):
        sheet.box(10 + 3.6 * k, -2, 10 + 3.6 * k + width, 8, INK)
    # Top: x from -40 to 4, y from -42 to -6.
    sheet.box(-40, -27, 4, -21, 0.70)
    sheet.polygon([(-34, -11), (-28, -11), (-31, -17)], 0.12)
    return sheet.grey()


def gift_card() -> Grey:
    """(324, 514) grey, 85.6 x 54 mm (ISO/IEC 7810 ID-1 to 0.1 mm): ribbon and bow, a title, a value and a number."""
    sheet = Sheet(85.6, 54, 6, 0.35)
    sheet.box(14, -27, 22, 27, 0.75)
    sheet.box(-42.8, -4, 42.8, 3, 0.75)
    for side in (-1, 1):
        sheet.polygon([(18, -0.5), (18 + side * 15, 9), (18 + side * 15, -10)], 0.55)
    sheet.disc(18, -0.5, 4, 0.85)
    sheet.text("GIFT CARD", -40, 11, 7, 0.85)
    sheet.text("50", -38, -18.5, 10.5, 0.06)
    sheet.text("1234 5678", -14, -22.5, 3.5, 0.85)
    return sheet.grey()


def blade_etching() -> Grey:
    """(152, 368) grey, 92 x 38 mm: what etching leaves of the bare metal's reflection (1): 0.2 in letters."""
    sheet = Sheet(92, 38, 4, 1.0)
    sheet.text("MITSIM", -41, 2, 10, 0.2)
    for k in range(13):
        sheet.box(-41 + 5 * k, 14.5 if k % 5 else 13.5, -40.2 + 5 * k, 17.5, 0.2)
    sheet.polygon([(13, 2), (22, 2), (22, 11)], 0.2)
    return sheet.grey()

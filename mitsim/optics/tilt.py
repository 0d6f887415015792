"""A tilted mask in, its shadow out: a sum of shadows of masks that are tilted along one axis each.

Where a mask's distance grows by alpha along its rows and by beta along its columns, a ray of slope t that would cross
the even plane at s crosses the mask at s + t (alpha s_row + beta s_col) / (1 - t . (alpha, beta)). Along the rows::

    s_row + t_row (alpha s_row + beta s_col) / (1 - alpha t_row)

but for the other axis's part of the slope, beta t_col of the shift, 30 nm of 5 um at 40 mrad. The rows' own tilt moves
rows alone: the profile stays one. What the other axis adds is a profile that is moved by beta s_col t_row, as much as
the column says; between Chebyshev's nodes sigma_k of s_col it is interpolated by Lagrange's polynomials l_k::

    a(s_row + t_row beta s_col / ..) = sum_k l_k(s_col) a(s_row + t_row beta sigma_k / ..)

so K nodes make K terms of each, and two tilts K L. Waves come from as far as the mask is where the ray crosses it: rows
are formed at d + beta sigma_k, and interpolated over alpha s_row between those of three distances
(:mod:`mitsim.optics.diffraction`), which keeps them one profile.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.optics.shadow import Directions, SeparableTerms, ShadowGeometry


def tilted_terms(
    shadow: ShadowGeometry,
    rows: Directions,
    columns: Directions,
    tilt: tuple[float, float],
    nodes: tuple[int, int],
    formed: Callable[[ShadowGeometry], SeparableTerms],
) -> SeparableTerms:
    """Shadow of a mask whose distance grows along both axes, as separable terms.

    Parameters
    ----------
    shadow
        sensor, even mask and depth.
    rows, columns
        r and c directions.
    tilt
        how the distance grows along rows, and along columns.
    nodes
        of the columns' coordinate that rows are moved by, and of the rows' that columns are; 1 where nothing moves.
    formed
        gives the terms of a shadow whose axes have a tilt each.
    """
    along, across = tilt
    by_row, by_column = (
        shadow.along(axis).crossings(directions) - shadow.offset_mm[axis]
        for axis, directions in enumerate((rows, columns))
    )
    first, second = nodes_between(by_column, nodes[0]), nodes_between(by_row, nodes[1])
    # One look at both axes serves a node of each; the last of fewer nodes is looked at again.
    seen = [
        formed(replace(shadow, tilt=((along, across * float(row)), (across, along * float(column)))))
        for row, column in zip(
            *(np.pad(each, (0, max(nodes) - len(each)), "edge") for each in (first, second)), strict=True
        )
    ]
    row_weights, column_weights = polynomials(by_column, first), polynomials(by_row, second)
    return [
        (left * column_weights[second_node], right * row_weights[first_node])
        for first_node in range(nodes[0])
        for second_node in range(nodes[1])
        for (left, _), (_, right) in zip(seen[first_node], seen[second_node], strict=True)
    ]


def nodes_between(places: FloatArray, count: int) -> FloatArray:
    """(``count``,) Chebyshev's nodes between those of ``places`` that are farthest from 0; 0 for one."""
    reach = float(np.abs(places).max())
    return np.asarray(reach * np.cos(np.pi * (np.arange(count) + 0.5) / count) if count > 1 else np.zeros(1))


def polynomials(places: FloatArray, nodes: FloatArray) -> list[FloatArray]:
    """At each of the ``places``, the polynomial that is 1 at each of the ``nodes`` and 0 at the others."""
    weights = []
    for node in nodes:
        others = nodes[nodes != node]
        weights.append(np.prod([(places - other) / (node - other) for other in others], axis=0) * np.ones_like(places))
    return weights

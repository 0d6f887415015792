"""Lists of point spread functions, of several depths or of several places in the field.

A list is a TOML file with a table ``[[psf]]`` for each picture, which states its ``file`` and either ``depth_mm`` or
``place``, the rows and columns of the frame by which the picture's light is displaced from that of the middle point.

**Depths.** The scene has a slice X_z for each depth (Antipa et al., Optica 5, 1, 2018): Y_i = crop(sum_z h_z * (P_i o
X_z)). Each h_z has sum 1, so that a slice is the light of its depth that reaches the sensor.

**Places.** Points between the places p cast a blend of their lights (Denis, Thiebaut, Soulez, Becker and Mourya, Int.
J. Comput. Vis. 115, 2015): Y_i = crop(sum_p h_p * (w_p o P_i o X)). Each picture has its light where the sensor saw it,
and h_p is the picture shifted back by its place. The brightest has sum 1: dimmer ones are vignetting, for which the
image is corrected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator
from scipy import fft
from scipy.ndimage import shift
from scipy.spatial import Delaunay

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import LARGEST, Configuration, Positive, load_model
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import load_psf_channels

_MOST = 64
_OFF, _CLEARLY, _LIKE = 2, 1.2, 0.5
"""Pixels by which lights may be misplaced; they are more if a shift correlates that much better, and at least so."""
_FLAT = 1e-6


_Shift = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]


class _Entry(Configuration):
    file: str
    depth_mm: Positive | None = None
    place: tuple[_Shift, _Shift] | None = Field(default=None, strict=False)


class _List(Configuration):
    psf: tuple[_Entry, ...] = Field(strict=False)

    @model_validator(mode="after")
    def _have_one_kind(self) -> _List:
        if not 2 <= len(self.psf) <= _MOST:
            raise ValueError(f"psf: got {len(self.psf)} tables [[psf]]; give 2 to {_MOST}")
        for entry in self.psf:
            if (entry.depth_mm is None) == (entry.place is None):
                raise ValueError(f"psf: {entry.file}: give depth_mm or place, one of them")
        if len({entry.place is None for entry in self.psf}) > 1:
            raise ValueError("psf: some have depth_mm and some place; give one of them for all")
        for first, second in combinations(self.psf, 2):
            if first.depth_mm is not None and first.depth_mm == second.depth_mm:
                raise ValueError(f"{first.file} and {second.file} have one depth, {first.depth_mm:g} mm; give it once")
            if first.place and second.place and math.dist(first.place, second.place) < 1:
                raise ValueError(f"{first.file} and {second.file} have places less than a pixel apart; give one")
        return self


@dataclass(frozen=True, eq=False)
class Lights:
    """Light (k, k') of a scene pixel, or (D, k, k') at ``depths_mm`` (D,) or ``places`` (D, 2) [pixels]."""

    light: FloatArray
    depths_mm: FloatArray | None = None
    places: FloatArray | None = None
    doubt: str = ""

    @property
    def count(self) -> int:
        return 1 if self.light.ndim == 2 else len(self.light)


def load_lights(path: Path, reduce: int) -> Lights:
    """Read the list ``path``; ``reduce`` x ``reduce`` pixels become one.

    MitsimError for a list that breaks rules, and for pictures that :func:`mitsim.devices.camera.load_psf` refuses, in
    colour, of unequal sizes, or without light after they are shifted back.
    """
    entries = load_model(path, _List).psf
    entries = tuple(sorted(entries, key=lambda entry: entry.depth_mm or 0.0))
    pictures = [load_psf_channels(path.parent / entry.file, ("light",), (0, 0), {}, reduce)[0] for entry in entries]
    for entry, picture in zip(entries, pictures, strict=True):
        if picture.shape != pictures[0].shape:
            sizes = " and ".join(f"{each.shape[0]} x {each.shape[1]}" for each in (picture, pictures[0]))
            raise MitsimError(f"file {path}: {entry.file} and {entries[0].file} have {sizes} pixels; give one size")
    light = np.stack(pictures)
    if entries[0].place is None:
        light /= light.sum(axis=(1, 2), keepdims=True)
        depths = np.array([entry.depth_mm for entry in entries])
        return Lights(light, depths_mm=depths)
    places = np.array([entry.place for entry in entries]) / reduce
    for own, entry, place in zip(light, entries, places, strict=True):
        own[:] = np.maximum(shift(own, -place, order=3), 0.0) if np.abs(place).max() < max(own.shape) else 0.0
        if not own.any():
            raise MitsimError(
                f"file {path}: {entry.file}: no light is left after shifting it back by its place, "
                f"{entry.place}; give the rows and columns by which the light is displaced"
            )
    light /= light.sum(axis=(1, 2)).max()
    return Lights(light, places=places, doubt=_displaced(light, places, [entry.file for entry in entries]))


def _displaced(light: FloatArray, places: FloatArray, files: list[str]) -> str:
    """Return a warning if two lights fit each other better when they are shifted by more than their places differ."""
    size, grid = light.shape[1:], [2 * side for side in light.shape[1:]]
    apart = light - light.mean(axis=(1, 2), keepdims=True)
    spectra, energies = fft.rfft2(apart, grid), np.square(apart).sum(axis=(1, 2))
    for first, second in combinations(range(len(light)), 2):
        like = fft.irfft2(spectra[first].conj() * spectra[second], grid) / math.sqrt(energies[first] * energies[second])
        peak = np.array(np.unravel_index(int(like.argmax()), like.shape))
        off, near = np.where(peak >= size, peak - grid, peak), np.arange(-_OFF, _OFF + 1)
        if np.abs(off).max() > _OFF and like.max() > max(_LIKE, _CLEARLY * like[np.ix_(near, near)].max()):
            stated = places[second] - places[first]
            found = stated + off
            return (
                f"Misfit: the light of {files[second]} is displaced by {found[0]:+.0f} rows and {found[1]:+.0f} "
                f"columns from that of {files[first]}, but their places differ by {stated[0]:+.0f} and "
                f"{stated[1]:+.0f}; give pictures as the sensor saw them, not centred, and the places of their light."
            )
    return ""


def blend(places: FloatArray, rows: FloatArray, columns: FloatArray) -> FloatArray:
    """Return the weights (D, n, n') of lights at ``places`` (D, 2) in pixels at ``rows`` (n,) and ``columns`` (n',).

    They are linear in each triangle of Delaunay's triangulation and, outside, those of the nearest point of its edge;
    they are at least 0 and have sum 1.
    """
    points = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)
    weights, outside = np.zeros((len(places), len(points))), np.ones(len(points), dtype=bool)
    _, sizes, (along, _) = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)
    if len(sizes) > 1 and sizes[1] > _FLAT * sizes[0]:
        mesh = Delaunay(places)
        found, edges = mesh.find_simplex(points), mesh.convex_hull
        inside, outside = np.flatnonzero(found >= 0), found < 0
        turned = mesh.transform[found[inside]]
        parts = np.einsum("pij,pj->pi", turned[:, :2], points[inside] - turned[:, 2])
        parts = np.maximum(np.column_stack([parts, 1 - parts.sum(axis=1)]), 0.0)
        weights[mesh.simplices[found[inside]], inside[:, None]] = parts / parts.sum(axis=1, keepdims=True)
    else:
        order = np.argsort(places @ along)
        edges = np.stack([order[:-1], order[1:]], axis=1)
    far, numbers = points[outside], np.flatnonzero(outside)
    nearest = np.full(len(far), np.inf)
    for first, last in edges:
        step = places[last] - places[first]
        part = np.clip((far - places[first]) @ step / (step @ step), 0.0, 1.0)
        distance = np.square(far - places[first] - part[:, None] * step).sum(axis=1)
        nearer = distance < nearest
        nearest[nearer] = distance[nearer]
        weights[:, numbers[nearer]] = 0.0
        weights[first, numbers[nearer]], weights[last, numbers[nearer]] = 1 - part[nearer], part[nearer]
    return weights.reshape(len(places), len(rows), len(columns))

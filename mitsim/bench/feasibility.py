"""Check, from geometry alone and before any light is simulated, whether frames of a bench can give an image."""

from __future__ import annotations

import math
from itertools import count
from typing import NamedTuple

import numpy as np

from mitsim.bench.apparatus import Apparatus
from mitsim.core.arrays import FloatArray
from mitsim.core.environment import keep_scenes
from mitsim.devices.mask import Mask
from mitsim.devices.patterns import PatternFamily, is_prime
from mitsim.devices.plate import Plate
from mitsim.optics.shadow import Directions, ShadowGeometry
from mitsim.scene.load import why_dark
from mitsim.transport.direct import DirectTracer

_SEEN = 0.25
"""Part of the projector's pixels that must be visible; shipped scenes have 0.96 to 1, and 0.75 beside a mirror."""
MOST_LOST = 0.3
"""Part of the mask without factors (rms) from which a calibration is refused: a tenth of the light's energy."""
_SEPARABLE = 0.01
"""Residual of a separable mask, as :data:`mitsim.reconstruct.factors.SEPARABLE_RESIDUAL`."""
_PLACES = 256
"""Points of the mask per axis that are compared; the singular values take 20 ms."""


class Fault(NamedTuple):
    """Reason without image, remedy, and the missing part of the image; 1 if no image can be solved for."""

    reason: str
    remedy: str
    lost: float = 1.0


def obstacles(bench: Apparatus, family: PatternFamily | None = None) -> tuple[str, ...]:
    """Return why no calibration can give an image, with the remedy, one sentence per reason; () if it can.

    Parameters
    ----------
    bench
        Scene, camera and projector.
    family
        Patterns of the frames; None if they are not known yet, so that data are not counted.
    """
    found = _unseen_scene(bench), mask_fault(bench), family and shortage(bench, family)
    return tuple(f"{fault.reason}; {fault.remedy}" for fault in found if fault)


# ---- The scene ----


@keep_scenes()
def seen_light(bench: Apparatus) -> tuple[int, tuple[float, float] | None]:
    """Return the number of projector pixels that light points visible from the sensor's centre, and their depths.

    The nearest and farthest depth [mm] are None if there is none. One ray is traced per pixel.
    """
    light = DirectTracer(bench.setup, 1).trace(0, 0, 1)
    inverse = light.inverse_depth[light.value > 0]
    depths = (1 / float(inverse.max()), 1 / float(inverse.min())) if len(inverse) else None
    return len(np.unique(light.pixel[light.value > 0])), depths


def _unseen_scene(bench: Apparatus) -> Fault | None:
    if bench.loaded.mirrors:
        return None
    (seen, _), every = seen_light(bench), bench.n**2
    if not seen:
        return Fault("no light of the projector reaches the camera", why_dark(bench.loaded))
    if seen >= _SEEN * every:
        return None
    return Fault(
        f"the camera sees the light of {seen} of {every} projector pixels ({seen / every:.1%}), and the rest of the "
        "image is empty",
        f"move the scene to {bench.geometry.scene_distance:g} mm, where the projector's window lies in the camera's "
        "view, or make it larger",
    )


# ---- The mask ----


def mask_fault(bench: Apparatus) -> Fault | None:
    """Return why the mask of a ``bench`` has no two factors, even without diffraction and tilt; None if it has.

    The part of the mask that the sensor sees is compared with the best product of a row and a column profile, with and
    without the means that a solver subtracts.
    """
    geometry, mask = bench.geometry, bench.geometry.build_mask()
    crossings = _crossings(bench)
    rows, columns = (np.linspace(each.min(), each.max(), _PLACES) for each in crossings)
    seen = mask.transmission(rows[:, None], columns)
    centred = seen - seen.mean(axis=0) - seen.mean(axis=1)[:, None] + seen.mean()
    residual = min(_beyond_one(seen), _beyond_one(centred))
    if residual <= _SEPARABLE:
        return None
    own = 0.0 if isinstance(mask, Mask) else mask.residual
    if own > residual / 2:
        return Fault(
            f"the mask ({geometry.mask_words}) has no two factors: frames can be captured, but the best separable mask "
            f"leaves {own:.0%} of it, which images lack",
            "use a mask of the kind separable, flatcam or mura",
            residual,
        )
    needed = 2 * max(float(np.abs(each).max()) for each in crossings)
    if isinstance(mask, Plate) and mask.flaws.turn_deg:
        return Fault(
            f"the mask ({geometry.mask_words}) has no two factors as it is mounted, because the best separable one "
            f"leaves {residual:.0%} of it",
            "mount it straight",
            residual,
        )
    return Fault(
        f"the mask covers {mask.extent_mm:.2g} mm of the {needed:.2g} mm that the sensor sees through it, and its edge "
        f"leaves {residual:.0%} of what is seen without factors",
        _larger(mask.feature_mm, needed, geometry.mask_plate is not None),
        residual,
    )


def _beyond_one(values: FloatArray) -> float:
    energy = np.square(np.linalg.svd(values, compute_uv=False))
    return float(np.sqrt(energy[1:].sum() / energy.sum())) if energy.sum() > 0 else 0.0


def _larger(feature_mm: float, needed_mm: float, of_a_file: bool) -> str:
    least, feature = math.ceil(needed_mm / feature_mm), f"{feature_mm * 1e3:g} um"
    if of_a_file:
        return f"use at least {next(n for n in count(least) if n > 2 and is_prime(n))} features of {feature}"
    order = least.bit_length()
    return f"use order {order} ({2**order - 1} features of {feature}), or larger features"


def _crossings(bench: Apparatus) -> list[FloatArray]:
    """Where rays from each sensor row, and column, to both ends of the window cross the mask, from its centre [mm]."""
    geometry = bench.geometry
    shadow = ShadowGeometry.of(geometry, geometry.scene_distance)
    return [
        shadow.along(axis).crossings(Directions(np.array(edges), 0.0)) - geometry.mask_offset[axis]
        for axis, edges in enumerate(bench.windows)
    ]


# ---- Data and unknowns ----


def shortage(bench: Apparatus, family: PatternFamily) -> Fault | None:
    """Return why frames of a ``bench`` under a ``family`` are too few, or None if they suffice.

    Data are counted on the sensor rows and columns that the mask lights, and unknowns on the projector pixels that any
    pattern lights. Behind colour filters, every line of the light has its own unknowns.
    """
    geometry, n = bench.geometry, bench.n
    half = geometry.build_mask().extent_mm / 2
    lit = [
        int(np.count_nonzero((each.min(axis=1) <= half) & (each.max(axis=1) >= -half))) - geometry.centred
        for each in _crossings(bench)
    ]
    patterns = family.left.shape[1], family.right.shape[1]
    lines = len(bench.lines.wavelengths_nm) if bench.filters and bench.lines else 1
    needed = [int(np.count_nonzero(side.any(axis=1))) for side in (family.left, family.right)]
    ranks = [min(rows * count, most) for rows, count, most in zip(lit, patterns, needed, strict=True)]
    data, rank = math.prod(lit) * math.prod(patterns), math.prod(ranks) * lines
    if data > rank and ranks == needed:
        return None
    least = " x ".join(str(n // max(rows, 1) + 1) for rows in lit)
    return Fault(
        f"{patterns[0]} x {patterns[1]} patterns ({family.name}) on {lit[0]} x {lit[1]} sensor pixels that the mask "
        f"lights give {patterns[0] * lit[0]} x {patterns[1] * lit[1]} numbers for {n} x {n} unknowns"
        f"{f' of each of {lines} lines' if lines > 1 else ''}, so that "
        + ("noise cannot be told from the image" if data <= rank else "the image is not determined"),
        f"use at least {least} patterns, or more sensor pixels",
        1.0 if data <= rank else 1 - math.prod(ranks) / math.prod(needed),
    )

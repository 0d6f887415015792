"""What simulating takes: from settings, what the pilot found and paces to seconds of each stage.

The plan compares its choices at :data:`FIXED` paces, not at those of this machine and moment: the same seed must mean
the same settings. What the pilot measured only scales the prediction that people read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import cast

import numpy as np

from mitsim.bench.effects import names
from mitsim.core.arrays import FloatArray
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.plate import FEW, Plate
from mitsim.devices.projector import Spectrum
from mitsim.light.settings import GROUPS, Effort, Evidence, Forming, Number, Settings, whole
from mitsim.optics.fft_shadow import cells_a_side, cells_per_pixel, points_per_cell
from mitsim.optics.frames import PROBES, formed_frames, mixes
from mitsim.transport.accumulator import MOST_PLACES

ROUNDS, CHECKED_SHOTS = 1.5, 16
"""Rounds that sampling takes, one or two, of followed light one more; and shots that each looks at to see the error of
many: shots' errors differ by a few percent, and each costs its look."""
MOST_CHECKED = 64
"""Shots that are looked at where light is followed over several surfaces, as heavy paths strike single ones (cookie_bag
at 1e-3 met its target in eight of 49, and not in all); and classes whose frames tell of all shots, which are formed of
them: what a look finds of them is used again."""
_LOOK = 0.4
"""Time of a look at a frame's error in that of forming the frame: 0.36 in corner, 0.44 in cookie_bag, 0.40 in
gift_card."""
MIXING = "black-level"
"""Effect that lights every pixel in every shot, so that shots are no longer single classes."""
_SPLIT, _EDGES = 2.0, 2.0
"""Layers, at most, that share the light of one depth; and how many times the cells of a pixel its light lies in, at
most, where it lies across an edge or at another depth than the cells are aligned at (measured: 1.6)."""
ANCHORS_OF = MappingProxyType(
    {
        "anchored": "anchors",
        "followed": "followed_anchors",
        "followed_from_camera": "followed_anchors",
        "occluded": "occluded_anchors",
    }
)
"""What counts the anchors of each kind of light that has several."""
_GEOMETRIC_ENTRIES = 0.03
"""An entry of a geometric shadow over one of a wave-optical one: a sum over features against samples of a field."""

TRUTH_PART = 1 / 6
"""Of the error that the frames' own sampling leaves in any image, what the truth may be off by: it then adds at most
0.12 dB to the error of the best image that a run could give."""
TRUTH_GROUPS = 4
"""Independent estimates of the truth: their spread is its standard error. An edge's error falls with the samples of one
estimate, but with the root of the number of estimates: four need 0.7 of the rays of eight."""
TRUTH_SAMPLES, BOARD_SAMPLES = 16, 8
"""Samples a pixel that each of these groups begins with. 64 in all show all but a corner of a hundredth of a pixel,
which their spread would not tell of; a board has no corners."""
MOST_RAYS, MOST_SAMPLES = 2**22, 128
"""Rays of each flux, and samples a pixel where that is more, beyond which it is left as it is: some one and a half
seconds on two cores. The standard error tells how good it is then."""
_ALLOTTED = 0.5
"""Part of the rays that the truth takes for its pixels being sampled where that helps most (measured: photograph 0.5,
gift_card 0.3)."""


@dataclass(frozen=True)
class Paces:
    """Seconds of a path or connection of each kind, of a frame and of a multiplication in forming it, of an entry of a
    wave-optical shadow and of one of filed light, of a ray of the truth, and of a pixel of a shot that is looked
    through for its brightest and its energy."""

    direct: float
    anchored: float
    indirect: float
    from_camera: float
    followed: float
    followed_from_camera: float
    occluded: float
    sharp: float
    frame: float
    product: float
    entry: float
    filed: float
    ray: float
    pixel: float = 0.0


FIXED = Paces(
    direct=1.8e-7,
    anchored=1.6e-7,
    indirect=1.2e-7,
    from_camera=2e-7,
    followed=1.3e-7,
    followed_from_camera=1.3e-7,
    occluded=5e-7,
    sharp=3e-7,
    frame=2.2e-3,
    product=2.1e-11,
    entry=3.5e-8,
    filed=1e-8,
    ray=1e-7,
    pixel=3e-8,
)
"""Chosen near what was measured of eight shipped scenes on two cores (plans at 1e-3, November 2026); only their ratios
decide. Direct light takes half as much where one cell a pixel holds it, and more in many fine ones."""


_CORRELATION = 125.0
"""Multiplications a pixel that each phase of a correlation with a raster takes as long as, for each pair of anchors and
layer: 0.08 to 0.13 processor seconds of 512 x 512 pixels and 36 phases, where sums take 8e-11 a multiplication
(benchmarks/masks.py)."""
_MANY_ENTRIES = 1.2
"""An entry of a geometric shadow of many terms over one of a wave-optical one (benchmarks/masks.py)."""
_FILED = 0.2
"""What tracing takes more for each further line: 0.15 of a mono capture's seconds, 0.3 of one line's (three lines of
photograph, benchmarks/colour.py)."""
_PASSED = 0.4
"""A place of a ledger, which is emptied and looked through, over an entry of light that is filed (corner in three
lines: 4e-9 s)."""
SHARED_COST = 6
"""Paths that a path of shared indirect light takes as long as: corner 5.7, cookie_bag 3.4."""


@dataclass(frozen=True)
class Numbers:
    """The numbers of settings that cost depends on, one choice or (m,) of them at once."""

    anchors: Number
    layers: Number
    cells: Number
    coarse_cells: Number
    coarse_layers: Number
    followed_anchors: Number
    followed_width: Number
    waves: Number
    indirect: Number
    mixed: Number
    occluded: Number = 0.0
    """Pixels of their own anchors."""
    occluded_anchors: Number = 1.0
    raster_cells: float = 0.0
    """Along a pixel, where frames are correlations by choice; 0: sums, or as few cells as a raster has."""

    @property
    def of_followed(self) -> tuple[FloatArray, FloatArray]:
        """Cells a side of a projector pixel, and layers, for what anchors see of followed light."""
        width = np.asarray(self.followed_width)
        return np.where(width > 1, 1 / width, self.coarse_cells), np.where(width > 1, 1.0, self.coarse_layers)

    @classmethod
    def coarsest(cls) -> Numbers:
        """One of everything, and a wave-optical shadow."""
        return cls(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0)

    @classmethod
    def of(cls, settings: Settings) -> Numbers:
        """Those of ``settings``."""
        layers = float(len(settings.depths))
        return cls(
            anchors=float(settings.anchors),
            layers=layers,
            cells=float(settings.subdivision),
            coarse_cells=float(settings.coarse_cells),
            coarse_layers=layers if settings.coarse_layers else 1.0,
            followed_anchors=float(settings.followed_anchors),
            followed_width=float(settings.followed_width),
            waves=float(bool(settings.effects & names(lambda effect: effect.in_shadow))),
            indirect=float("interreflection" in settings.effects),
            mixed=float(MIXING in settings.effects),
            occluded=float(len(settings.with_own_anchors)),
            occluded_anchors=float(settings.occluded_anchors),
            raster_cells=float(settings.raster_cells),
        )


def paces_of(evidence: Evidence) -> Paces:
    """Those that the ``evidence`` measured, where it measured any."""
    forming = evidence.forming
    products = float(_products(forming, Numbers.coarsest(), (forming.lit, forming.lit), 1.0, 1.0, 1.0))
    slower = forming.seconds / (FIXED.frame + FIXED.product * products) if forming.seconds else 1.0
    product = forming.product or slower * FIXED.product
    # The frame that the pilot forms is small: beside its products there is what every frame takes.
    frame = max(forming.seconds - product * products, 0.0) if forming.product else slower * FIXED.frame
    return Paces(
        direct=evidence.direct.seconds or FIXED.direct,
        anchored=evidence.anchored.seconds or FIXED.anchored,
        indirect=evidence.indirect.seconds or FIXED.indirect,
        from_camera=evidence.from_camera.seconds or FIXED.from_camera,
        followed=evidence.followed.seconds or FIXED.followed,
        followed_from_camera=evidence.followed_from_camera.seconds or FIXED.followed_from_camera,
        occluded=evidence.occluded_light.seconds or FIXED.occluded,
        sharp=evidence.sharp_light.seconds or FIXED.sharp,
        frame=float(frame),
        product=float(product),
        entry=float(product / FIXED.product * FIXED.entry),
        filed=float(product / FIXED.product * FIXED.filed),
        ray=evidence.spread.seconds * FIXED.ray / FIXED.direct or FIXED.ray,
        pixel=float(product / FIXED.product * FIXED.pixel),
    )


def priced() -> frozenset[str]:
    """Names of effects that take time; to have the others on costs nothing."""
    return names(lambda effect: effect.followed or effect.in_shadow) | {MIXING}


def efforts(evidence: Evidence, effects: frozenset[str]) -> dict[str, Effort]:
    """What each kind of light that ``effects`` call for takes by the ``evidence``; connections to anchors: to one."""
    found = {"direct": evidence.direct, "anchored": evidence.anchored}
    if evidence.occluded:
        found["occluded"] = evidence.occluded_light
    if evidence.sharp:
        found["sharp"] = evidence.sharp_light
    if effects & names(lambda effect: effect.followed):
        found |= {"indirect": evidence.indirect, "from_camera": evidence.from_camera, "followed": evidence.followed}
        found["followed_from_camera"] = evidence.followed_from_camera
    return found


def connections(name: str, numbers: Numbers) -> Number:
    """Connections of each path of the light ``name``; 0 for what anchors see beyond their mean where there is one.

    Parameters
    ----------
    name
        as in :func:`efforts`.
    numbers
        of the settings.
    """
    if name not in ANCHORS_OF:
        return 1.0 + 0 * numbers.anchors
    count = np.asarray(getattr(numbers, ANCHORS_OF[name]), dtype=np.float64)
    return cast(Number, count**2 * (count > 1))


def _by_fft(forming: Forming, numbers: Numbers) -> bool:
    """Whether frames are correlations, as they must be or as was chosen."""
    return bool(numbers.raster_cells) or forming.correlated[bool(numbers.waves)]


def _phases(forming: Forming, numbers: Numbers) -> float:
    """Raster cells that a pixel has, where frames are correlations."""
    return numbers.raster_cells**2 or forming.phases


def _products(
    forming: Forming, numbers: Numbers, lit: tuple[Number, Number], cells: Number, layers: Number, anchors: Number
) -> Number:
    """Multiplications of one frame, ``lit`` of whose rows and columns of cells hold light, and of the probes that tell
    its error.

    Parameters
    ----------
    forming, numbers
        what it depends on, and whether the shadow is wave-optical, and on a raster.
    lit, cells, layers, anchors
        parts of the rows and of the columns, cells and layers, and anchors.
    """
    rows, columns = (part * forming.cells * cells * anchors for part in lit)
    pixels = forming.pixels
    if _by_fft(forming, numbers):
        phases = _phases(forming, numbers)
        return cast(Number, _CORRELATION * phases * layers * np.square(anchors) * (1 + GROUPS) * pixels**2 + 0 * rows)
    probes = GROUPS * (PROBES + 1) * (np.minimum(columns, pixels) + pixels) * rows
    terms = forming.geometric_terms + (forming.terms - forming.geometric_terms) * numbers.waves
    # The shorter side is multiplied out first.
    return cast(Number, terms * layers * (pixels * rows * columns + pixels**2 * np.minimum(rows, columns) + probes))


def _entries(forming: Forming, numbers: Numbers) -> Number:
    """Entries of all shadows that are prepared, as many as wave-optical ones take as long."""
    coarse = (np.asarray(numbers.anchors) > 1) + numbers.indirect
    followed = (np.asarray(numbers.followed_anchors) > 1) * math.prod(numbers.of_followed)
    sides = numbers.cells * numbers.layers + coarse * numbers.coarse_cells * numbers.coarse_layers + followed
    if _by_fft(forming, numbers):
        return cast(Number, 0.0 * sides)
    many = forming.geometric_terms > FEW
    geometric = _MANY_ENTRIES * forming.geometric_terms if many else _GEOMETRIC_ENTRIES
    terms = forming.terms * numbers.waves + geometric * (1 - numbers.waves)
    return cast(Number, 2 * forming.pixels * forming.cells * sides * terms)


def _lit_by_occluded(forming: Forming, numbers: Numbers) -> tuple[Number, Number]:
    """Parts of the rows and of the columns of cells that hold light of occluded pixels in a frame: each pixel lights
    its own, and a frame shows as many of them as of all pixels."""
    most = _EDGES * numbers.occluded * np.square(forming.lit) / forming.cells
    rows, columns = (np.minimum(forming.lit * part, most) for part in forming.occluded)
    return rows, columns


def forming_seconds(forming: Forming, numbers: Numbers, frames: Number, paces: Paces) -> Number:
    """Seconds of forming so many ``frames`` of each line.

    Parameters
    ----------
    forming, numbers
        what it depends on.
    frames
        to be formed of a line.
    paces
        of this machine, or the fixed ones.
    """
    several = np.asarray(numbers.anchors) > 1
    coarse = numbers.coarse_cells, numbers.coarse_layers
    lit, every = (forming.lit, forming.lit), (1.0, 1.0)
    products = (
        _products(forming, numbers, lit, numbers.cells, numbers.layers, 1.0)
        + several * _products(forming, numbers, lit, *coarse, numbers.anchors)
        + (np.asarray(numbers.occluded_anchors) > 1)
        * _products(forming, numbers, _lit_by_occluded(forming, numbers), *coarse, numbers.occluded_anchors)
        + numbers.indirect * _products(forming, numbers, every, *coarse, 1.0)
        + (np.asarray(numbers.followed_anchors) > 1)
        * _products(forming, numbers, every, *numbers.of_followed, numbers.followed_anchors)
    )
    if mixes(forming.classes, forming.shots, forming.pixels):
        products = products + numbers.mixed * forming.classes * forming.pixels**2
    return cast(Number, forming.lines * frames * (paces.frame + paces.product * products))


def optics_seconds(forming: Forming, numbers: Numbers, paces: Paces) -> Number:
    """Seconds of all frames of the family, with the shadows that form them.

    Parameters
    ----------
    forming, numbers, paces
        as for :func:`forming_seconds`.
    """
    shadows = paces.entry * _entries(forming, numbers)
    if _by_fft(forming, numbers):
        drawing = forming.drawing[bool(numbers.waves)] * paces.product / FIXED.product
        if not numbers.waves:  # Waves are squared at as many points whatever the cells.
            drawing *= _phases(forming, numbers) / forming.phases
        # Coarse light of several layers is seen at a depth of its own.
        shadows = cast(Number, shadows + drawing * (numbers.layers + (np.asarray(numbers.layers) > 1)))
    frames = formed_frames(forming.classes, forming.shots, forming.pixels)
    seen = paces.pixel * forming.shots * forming.pixels**2
    return forming.lines * (shadows + seen) + forming_seconds(forming, numbers, frames, paces)


def checking_seconds(forming: Forming, numbers: Numbers, paces: Paces) -> Number:
    """Seconds of seeing how large the Monte Carlo error is, while light is traced.

    Parameters
    ----------
    forming, numbers, paces
        as for :func:`forming_seconds`.
    """
    rounds = ROUNDS + numbers.indirect
    if tells_all(forming.classes, forming.shots, forming.pixels):
        # The last look takes its part of forming the frames over.
        return forming_seconds(forming, numbers, _LOOK * (rounds - 1) * forming.classes, paces)
    few, many = (min(shots, forming.shots) for shots in (CHECKED_SHOTS, MOST_CHECKED))
    return forming_seconds(forming, numbers, _LOOK * rounds * (few + numbers.indirect * (many - few)), paces)


def tells_all(classes: int, shots: int, pixels: float) -> bool:
    """Whether looks see all shots, by the frames of their classes.

    Parameters
    ----------
    classes, shots, pixels
        of the family, and a side of the sensor.
    """
    return classes <= MOST_CHECKED and mixes(classes, shots, pixels)


def tracing_seconds(evidence: Evidence, settings: Settings, paces: Paces) -> dict[str, float]:
    """Seconds of tracing the samples in ``settings``, by kind of light.

    Parameters
    ----------
    evidence
        paths in a sample.
    settings
        the samples.
    paces
        as for :func:`forming_seconds`.
    """
    return {
        name: traced_for(evidence.forming.lines, evidence.forming.parted)
        * GROUPS
        * float(whole(name, getattr(settings, f"{name}_samples")))
        * effort.paths
        * getattr(paces, name)
        * float(connections(name, Numbers.of(settings)))
        for name, effort in efforts(evidence, settings.effects).items()
    }


def traced_for(lines: int, parted: bool = False) -> float:
    """Times what one line takes that tracing and filing take for so many ``lines`` on the same paths, or on paths of
    their own where glass has ``parted`` them."""
    return lines if parted else 1 + _FILED * (lines - 1)


def predicted_rays(pixels: int, samples: float, rate: float) -> float:
    """Rays that truth will take for both fluxes (:mod:`mitsim.light.truth`).

    Parameters
    ----------
    pixels
        of the projector.
    samples, rate
        that each group of the frames' direct light takes a pixel, and the power of their number that its error falls
        with.
    """
    first = TRUTH_GROUPS * pixels * (TRUTH_SAMPLES + BOARD_SAMPLES)
    wanted = _ALLOTTED * GROUPS * pixels * samples * float(TRUTH_PART ** (-1 / rate))
    return min(first + wanted, max(MOST_RAYS, MOST_SAMPLES * pixels))


def entries(pixels: int, classes: int, numbers: Numbers, samples: Settings | Mapping[str, Number]) -> Number:
    """Entries of one group's filed light, at most: a pixel's direct light lies in its own cells, indirect light in all.

    Parameters
    ----------
    pixels, classes
        of the projector, and of the family.
    numbers, samples
        of the settings; samples by kind of light, or as settings have them.
    """

    def of(name: str) -> Number:
        return whole(name, getattr(samples, f"{name}_samples") if isinstance(samples, Settings) else samples[name])

    coarse, layers = np.square(numbers.coarse_cells), np.minimum(numbers.coarse_layers, _SPLIT)
    several, followed = (np.asarray(count) > 1 for count in (numbers.anchors, numbers.followed_anchors))
    found = np.minimum(of("direct"), _EDGES * np.square(numbers.cells)) * np.minimum(numbers.layers, _SPLIT)
    if np.any(several):
        seen = _EDGES * np.minimum(of("anchored"), coarse) * layers
        found = found + several * _EDGES * np.square(numbers.anchors) * seen
    beyond = numbers.occluded / pixels * (np.asarray(numbers.occluded_anchors) > 1)
    if np.any(beyond):
        seen = _EDGES * np.minimum(of("occluded"), coarse) * layers
        found = found + beyond * _EDGES * np.square(numbers.occluded_anchors) * seen
    # Pixels of the projector, not of all cells: light from beyond its window is a small part.
    places = classes * coarse * numbers.coarse_layers
    if np.any(numbers.indirect):
        found = found + numbers.indirect * np.minimum(_SPLIT * of("indirect"), places)
    if np.any(followed):
        cells, seen_in = numbers.of_followed
        most = np.maximum(of("followed"), of("followed_from_camera"))
        seen = np.minimum(_SPLIT * most, classes * np.square(cells) * seen_in)
        found = found + followed * _EDGES * np.square(numbers.followed_anchors) * seen
    return cast(Number, pixels * found)


def filing_seconds(forming: Forming, numbers: Numbers, filed: Number, paces: Paces) -> Number:
    """Seconds of filing the light of each line.

    Parameters
    ----------
    forming, numbers, paces
        as for :func:`forming_seconds`.
    filed
        entries of one group's light.
    """
    ledger = forming.classes * np.square(forming.cells * numbers.coarse_cells) * numbers.coarse_layers
    passed = numbers.indirect * _PASSED * np.where(ledger < MOST_PLACES, ledger, 0.0)
    return cast(Number, forming.lines * GROUPS * paces.filed * (filed + passed))


def truth_seconds(evidence: Evidence, settings: Settings, paces: Paces) -> float:
    """Seconds of tracing what a perfect image would show.

    Parameters
    ----------
    evidence, settings, paces
        as for :func:`tracing_seconds`.
    """
    direct = evidence.spread if settings.anchors > 1 else evidence.direct
    rate = direct.noise.rate
    return (
        traced_for(evidence.forming.lines, evidence.forming.parted)
        * paces.ray
        * predicted_rays(evidence.direct.paths, float(whole("direct", settings.direct_samples)), rate)
    )


# -------- What drawing a mask's shadow on a raster takes (

_MEANS_S, _TURNED_S = 8e-8, 5e-7
"""A cell of a shadow without diffraction, of a mask that is straight and of one that is turned; here and below 0.7 of
the processor seconds of 2310 to 3466 cells a side on a busy core (benchmarks/masks.py)."""
_POINT_S, _TERM_S = 9e-9, 8e-11
"""A point at which waves are squared, and a term of their field there."""
_AROUND = 2.0
"""Cells of the light that is turned over those of its turned square."""
_HELD, _AT_WORK, _BLOCK_BYTES = 10, 14, 1.2e8
"""Numbers of 8 bytes that are held for each cell, of the 8 shadows that are kept and of their spectra; that are worked
on while another is made or a frame formed; and what points that are asked for at a time take."""
_FINER = (4 / 3, 2)
"""Times the fewest cells: 8 and 12 for 6."""
_MOST_BYTES = 2.0**32
"""Memory that more cells than the fewest are chosen for: twice as many of 320 pixels a side, 4 / 3 of 512."""


def cells_to_choose(geometry: CameraGeometry, spectrum: Spectrum | None) -> tuple[int, ...]:
    """Raster cells a pixel, fewest first, that a plan may choose for a camera whose mask is drawn.

    Parameters
    ----------
    geometry, spectrum
        as for :func:`drawing_seconds`.
    """
    fewest = cells_per_pixel(geometry)

    def held(cells: int) -> bool:
        return raster_bytes(geometry.model_copy(update={"mask_cells": cells}), spectrum) <= _MOST_BYTES

    return fewest, *filter(held, (math.ceil(by * fewest) for by in _FINER))


def drawing_seconds(geometry: CameraGeometry, spectrum: Spectrum | None) -> float:
    """Seconds of drawing the shadow of one depth; 0 for a mask that is never drawn.

    Parameters
    ----------
    geometry
        the camera.
    spectrum
        lines of the light; None: without diffraction.
    """
    mask = geometry.mask_plate
    waves = spectrum is not None
    if mask is None or not (geometry.drawn(waves) or geometry.may_be_drawn(waves)):
        return 0.0
    cells, turned = float(cells_a_side(geometry, spectrum)) ** 2, bool(mask.flaws.turn_deg)
    if spectrum is None or mask.irradiance:
        return cells * (_TURNED_S if turned else _MEANS_S)
    seen = geometry.build_mask()
    assert isinstance(seen, Plate)
    step = geometry.pixel_pitch / cells_per_pixel(geometry)
    points = (points_per_cell(float(line), geometry.mask_distance, step) for line in spectrum.wavelengths_nm)
    each = _POINT_S + _TERM_S * len(seen.amplitude.terms)
    return cells * (_AROUND if turned else 1.0) * each * sum(count**2 for count in points)


def raster_bytes(geometry: CameraGeometry, spectrum: Spectrum | None) -> float:
    """Memory of shadows on rasters behind a camera whose mask is drawn [bytes].

    Parameters
    ----------
    geometry, spectrum
        as for :func:`drawing_seconds`.
    """
    return 8.0 * (_HELD + _AT_WORK) * cells_a_side(geometry, spectrum) ** 2 + _BLOCK_BYTES

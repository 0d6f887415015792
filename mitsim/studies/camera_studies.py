"""The paper's studies of the camera vary the mask's distance, the sensor's pixels, the resolution, and the depth.

*distance*, section IV-C and figure 5: the mask at 500 to 2000 um, and on to where diffraction ends the shadow.
*binning*, section V-D: frames averaged after capture to 512 to 64 pixels a side. *resolution*, section V-C and figure
11: bars, by their contrast at their own frequency, because the paper's (I_max - I_min) / (I_max + I_min) is 0.2 to 0.5
by noise alone. *depth*, section V-A: parallax moves each projector
pixel's light by B (1/z - 1/z_0), with the baseline B. Idealised: a plane beside the calibrated distance, any baseline.
Rendered: the shipped devices, 60 mm, with the sheet moved, and its depth neglected, found, or calibrated; and scenes of
many depths. *volume*: scenes of many depths with several a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from math import inf
from typing import Any

import numpy as np

from mitsim.bench.layout import seen_depths
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.reconstruct.request import TV
from mitsim.report import EQUAL_FRAME, EQUAL_PEAK, IDEALISED, MODELS, RENDERED
from mitsim.report.lit_scene import Plane
from mitsim.studies.framework.claims import Gain, Level, stated
from mitsim.studies.framework.experiment import Axes, Found, Point, Scope, Study, group_by_setup
from mitsim.studies.framework.panels import Images, Lines, Pivot
from mitsim.studies.framework.studio import PRINT_MM, Image, Studio, finding, image_arrays, measure_image

_FAMILIES, _SHOWN = ("uniform", "dots:5", "dots:7"), ("uniform", "dots:7")
_STABLE_DB = 3.0

# -------- The distance of the mask

DISTANCE = Study(
    "distance",
    "How far the mask is from the sensor",
    "What does a thin camera cost, and how much of it do patterns give back?",
    points=Axes(
        {"patterns": _FAMILIES, "exposure": (EQUAL_PEAK, EQUAL_FRAME), "model": MODELS},
        # The paper's four; features of 60 um have a Fresnel number of 3.2 at 2 mm and of 0.8 at 8 mm.
        scene={"mask_distance": (0.5, 0.75, 1.0, 2.0, 4.0, 8.0)},
        quick={"mask_distance": (0.75, 2.0)},
    ),
    measure=partial(measure_image, shown=_SHOWN),
    claims=(
        stated("At 750 um, uniform light gives 16.9 to 19 dB", 16.9, 19.0, mask_distance="0.75", patterns="uniform"),
        stated("At 750 um, 49 dots give 30 to 30.5 dB", 30.0, 30.5, mask_distance="0.75", patterns="dots:7"),
        Gain("25 dots at 750 um are comparable to uniform light at 2000 um (within 1 dB)",
             {"mask_distance": "0.75", "patterns": "dots:5"}, {"mask_distance": "2.0", "patterns": "uniform"},
             paper="comparable", at_least=-1.0, at_most=1.0),
    ),
    panels=(
        Lines("mask_distance", "sensor to mask [mm]", each="exposure", title="PSNR by the mask's distance", log=True),
        Images("mask_distance", each="patterns", where={"exposure": EQUAL_FRAME, "patterns": _SHOWN}, names="{} mm"),
    ),
)  # fmt: skip

# -------- The number of sensor pixels

_FINE, *_, _COARSE = BINNINGS = (1, 2, 4, 8)
"""Pixels a side that are averaged."""


def _binning_measure(studio: Studio, point: Point) -> Found:
    binning = int(point["binning"])
    frames = studio.frames(point.setup, point["model"], point["patterns"], int(point["seed"]))
    # With fewer data than unknowns the noise can't be estimated, so the best lambda stands in for the automatic one.
    image = Image.of(frames, frames.seconds(EQUAL_PEAK), "best", binning)
    pixels = frames.lit.bench.geometry.frame_shape[0] // binning
    return finding(studio, point, image.image if point["patterns"] in _SHOWN else None, pixels=pixels, **image.row())


_loss = partial(Gain, one={"binning": _FINE}, other={"binning": _COARSE})
BINNING = Study(
    "binning",
    "How many sensor pixels",
    "What is left where the sensor has fewer pixels than the image, with one frame and with 49?",
    points=Axes(
        {"patterns": _FAMILIES, "binning": BINNINGS, "model": MODELS},
        quick={"patterns": _SHOWN, "binning": (_FINE, _COARSE)},
    ),
    measure=_binning_measure,
    claims=(
        _loss("49 dots lose at most 3 dB on 64 x 64 pixels", where="dots:7", at_least=-inf, at_most=_STABLE_DB),
        _loss("Uniform light degrades with fewer pixels", where="uniform", paper="degrades"),
        Gain("49 dots on 64 x 64 pixels are better than uniform light on 512 x 512",
             {"patterns": "dots:7", "binning": _COARSE}, {"patterns": "uniform", "binning": _FINE}, paper="better"),
    ),
    panels=(
        Lines("pixels", "rows of the sensor [pixel]", title="PSNR by the sensor's rows, equal peak", log=True),
        Images("pixels", each="patterns", where={"patterns": _SHOWN}, names="{} rows"),
    ),
)  # fmt: skip

# -------- The resolution

_FINEST = 0.52
_SEEN, _BESIDE = slice(16, -16), slice(8, -8)
"""Evaluated pixels, without margins."""


def _resolution_measure(studio: Studio, point: Point) -> Found:
    image = studio.image(point.setup, point["model"], point["patterns"], int(point["seed"]), EQUAL_FRAME)
    lit, frequency = studio.lit_scene(point.setup), float(str(point.setup.picture).removeprefix("bars "))
    depth = lit.light.plan.settings.depth
    pixel_mm = float(np.mean([high - low for low, high in lit.bench.windows_at(depth)])) * depth / lit.bench.n

    def contrast(picture: FloatArray) -> float:
        left, right = np.split(picture, 2, axis=1)
        halves = (left[_SEEN, _BESIDE], 0), (right[_SEEN, _BESIDE], 1)
        return float(np.mean([modulation(*half, frequency * pixel_mm) for half in halves]))

    if frequency * pixel_mm < 0.35 and (there := contrast(lit.truth)) < 0.4:
        raise MitsimError(
            f"scene {point.setup.scene}: bars of {frequency:g} line pairs a mm have a contrast of {there:.2f} in its "
            f"truth; give a print {PRINT_MM:g} mm wide, flat and facing the camera, that fills the image"
        )
    row = point.row(**image.row(), pairs_a_mm=frequency, contrast=contrast(image.image))
    return Found((row,), image_arrays(image.image, lit.truth))


def modulation(image: FloatArray, axis: int, frequency: float) -> float:
    """Return the contrast of bars along an ``axis`` at a ``frequency`` [cycles a pixel].

    It is the fundamental's amplitude over the mean, times pi / 4, because a square wave of contrast c has a fundamental
    of 4 c / pi.
    """
    profile = image.mean(axis=axis)
    phase = 2 * np.pi * frequency * np.arange(len(profile))
    waves = np.stack([np.cos(phase), np.sin(phase), np.ones(len(profile))], axis=1)
    cosine, sine, mean = np.linalg.lstsq(waves, profile, rcond=None)[0]
    return float(np.hypot(cosine, sine) / mean * np.pi / 4)


RESOLUTION = Study(
    "resolution",
    "How fine",
    "Which bars are resolved?",
    points=Axes(
        {"patterns": ("uniform", "dots:3", "dots:4", "dots:7"), "model": MODELS, "exposure": (EQUAL_FRAME,)},
        quick={"patterns": _SHOWN, "picture": ("bars 0.13", "bars 0.26", "bars 0.52")},
        prints=tuple(f"bars {pairs:g}" for pairs in (0.13, 0.17, 0.21, 0.26, 0.35, 0.43, 0.52, 0.6)),
        repeats=True,
    ),
    measure=_resolution_measure,
    claims=(
        Gain(f"49 patterns resolve finer bars than one (contrast at {_FINEST} line pairs a mm)", "dots:7", "uniform",
             where={"pairs_a_mm": _FINEST}, column="contrast", unit="", paper="rises"),
        Level(f"49 patterns resolve {_FINEST} line pairs a mm (contrast of 10 %)", every="pairs_a_mm", unit="",
              where={"patterns": "dots:7", "pairs_a_mm": lambda pairs: pairs <= _FINEST}, column="contrast",
              paper="told apart", at_least=0.1),
    ),
    panels=(
        Lines("pairs_a_mm", "spatial frequency on the print [line pairs/mm]", y="contrast",
              y_label="contrast of bars at their own frequency [1]"),
        Images("picture", title=f"Bars by line pairs/mm of the print, exposure {EQUAL_FRAME}",
               down=("patterns", "model"), caption="contrast {contrast:.2f}"),
    ),
    note="Pixels of the image are 0.94 mm on the shipped print, so 0.533 line pairs/mm are the most that they show; "
    "bars just below beat with them. A contrast of 10 % is the eye's limit for a print.",
)  # fmt: skip

# -------- Depth

CALIBRATED_MM = 400.0
_BESIDE_MM = (395.0, 405.0)
DEPTHS_MM = (360.0, 380.0, 395.0, CALIBRATED_MM, 405.0, 420.0, 440.0)
BASELINES_MM = (0.0, 15.0, 60.0, 150.0, 300.0)
"""From co-located to the other side of a bench."""
DEEP = {"cards": "dots:7x14", "cookie_bag": "dots:7x16"}
"""Scenes of many depths, and patterns of a period long enough for their parallax."""
NONE, AUTO, MAP, OWN = ("none", "auto", "map", "own calibration")
_FOCUSED = {NONE: "factors as calibrated", AUTO: "depth found (--focus auto)", OWN: "calibrated at its own depth"}


def _depth_points(scope: Scope) -> Sequence[Point]:
    setups = [replace(scope.setup, picture=name) for name in scope.choose(scope.pictures, scope.pictures[:1])]
    seed, depths = scope.seeds[0], scope.choose(DEPTHS_MM, (395.0, CALIBRATED_MM))
    ideal = [
        Point.of(setup, model=IDEALISED, patterns="dots:7", seed=seed, depth=depth, baseline=baseline)
        for setup in setups
        for baseline in scope.choose(BASELINES_MM, (0.0, 60.0))
        for depth in depths
    ]
    moved = [
        Point.of(own, model=RENDERED, patterns="dots:7", seed=seed, depth=depth, focus=focus)
        for setup in setups
        for depth in depths
        for focus in (NONE, AUTO, OWN)
        if not (focus == OWN and depth == CALIBRATED_MM)  # that is the bench as it is
        for own in (setup.with_parameters(sheet_z=depth, **({"scene_distance": depth} if focus == OWN else {})),)
    ]
    deep = [
        Point.of(replace(scope.setup, scene=scene), model=RENDERED, patterns=family, seed=each, focus=focus)
        for scene, family in scope.choose(tuple(DEEP.items()), tuple(DEEP.items())[:1])
        for each in scope.repeats
        for focus in (NONE, MAP)
    ]
    # The longest first, so that no process is left with it at the end.
    return group_by_setup([*(deep if scope.setup.scene == "photograph" else []), *moved, *ideal])


def _depth_measure(studio: Studio, point: Point) -> Found:
    setup, patterns, seed = point.setup, str(point["patterns"]), int(point["seed"])
    if point["model"] == RENDERED:
        # Frames of the sheet elsewhere, factors of the bench as it was aligned.
        focus = point["focus"] if point["focus"] in (AUTO, MAP) else None
        image = studio.image(setup, RENDERED, patterns, seed, focus=focus)
    else:
        lit, plane = studio.lit_scene(setup), Plane(point["depth"], (0.0, -point["baseline"]))
        frames = lit.idealised_frames(lit.bench.family(patterns, seed), seed, plane)
        image = Image.of(frames, frames.seconds(EQUAL_PEAK))
    return finding(studio, point, image.image, scene=setup.scene, **image.row())


_by_depth = partial(Lines, "depth", "depth of the plane [mm]", facet="")
_IDEAL = {"model": IDEALISED}
_MOVED = {"model": RENDERED, "patterns": "dots:7", "focus": tuple(_FOCUSED)}
_robust = partial(Gain, one={"depth": CALIBRATED_MM}, other={"depth": _BESIDE_MM}, paper="robust", at_least=-inf,
                  at_most=_STABLE_DB)  # fmt: skip
DEPTH = Study(
    "depth",
    "Depth",
    "What does a scene beside the calibrated distance cost, and what is left once its depth is found?",
    points=_depth_points,
    measure=_depth_measure,
    claims=(
        _robust("49 dots are robust to 5 mm of depth, at any baseline", where=_IDEAL, every="baseline"),
        _robust("49 dots are robust to 5 mm of depth, 60 mm beside the projector", where=_MOVED | {"focus": NONE}),
        Gain("A plane whose depth is found (--focus auto) is within 3 dB of a calibration at its depth",
             {"focus": AUTO}, {"focus": OWN}, every="depth", at_least=-_STABLE_DB,
             where=_MOVED | {"focus": (AUTO, OWN), "depth": lambda depth: depth != CALIBRATED_MM}),
        Gain("A depth for each pixel (--focus map) mends {scene}", {"focus": MAP}, {"focus": NONE}, each="scene",
             where={"scene": tuple(DEEP), "patterns": tuple(DEEP.values())}, at_least=_STABLE_DB, optional=True),
    ),
    panels=(
        _by_depth(file="baseline", where=_IDEAL, colour="baseline", names="{} mm"),
        _by_depth(file="focus", title="Rendered, 49 dots", where=_MOVED, colour="focus", names=_FOCUSED),
        Images("focus", where={"scene": tuple(DEEP), "focus": (NONE, MAP)}, down=("scene", "patterns")),
    ),
)  # fmt: skip

# -------- Several depths of a pixel

VOLUMES = DEEP | {"shelf": "dots:7x24"}
VOLUME, UNIFORM = ("volume", "volume, uniform light")


def _volume_points(scope: Scope) -> Sequence[Point]:
    setup = replace(scope.setup, picture=None, camera=scope.setup.camera or ("small" if scope.quick else None))
    families = VOLUMES if setup.scene == "photograph" else {setup.scene: "dots:7x16"}
    return [
        Point.of(replace(setup, scene=scene), model=RENDERED, patterns=patterns, seed=seed, way=way)
        for scene, family in scope.choose(tuple(families.items()), tuple(families.items())[:1])
        for seed in replace(scope, quick=False).repeats
        for way, patterns in ((MAP, family), (VOLUME, family), (UNIFORM, "uniform"))
    ]


def _volume_measure(studio: Studio, point: Point) -> Found:
    setup, way = point.setup, point["way"]
    depths = studio.once("depths", 1, setup, lambda: seen_depths(studio.bench(setup)))
    # Of uniform light all depths are alike, so its range is the scene's.
    ends = (0.97 * float(np.nanmin(depths)), 1.03 * float(np.nanmax(depths))) if way == UNIFORM else None
    options: dict[str, Any] = {"focus": MAP} if way == MAP else {"focus": VOLUME, "method": TV, "depth_range": ends}
    image = studio.image(setup, RENDERED, str(point["patterns"]), int(point["seed"]), **options)
    assert image.depths_mm is not None, "map and volume have depths"
    lit = (studio.lit_scene(setup).truth > _LIT) & np.isfinite(depths)
    off = np.abs(image.depths_mm - depths)[lit]
    errors = {"rms_mm": float(np.sqrt(np.square(off).mean())), "median_mm": float(np.median(off))}
    return finding(studio, point, image.image, scene=setup.scene, **image.row(), **errors)


_LIT = 0.05
"""Least reflectance of pixels whose depth is judged."""
_beats = partial(Gain, one={"way": VOLUME}, other={"way": UNIFORM}, every="scene")
_better = partial(Gain, one={"way": VOLUME}, other={"way": MAP}, each="scene")
_nearer = partial(_better, unit="mm", at_least=-inf, at_most=0.0)
SEVERAL = Study(
    "volume",
    "Several depths of a pixel",
    "What do dots bring to a volume, and a volume to one depth of each pixel?",
    points=_volume_points,
    measure=_volume_measure,
    claims=(
        _beats("Dots bring a volume 10 dB over uniform light", at_least=10.0),
        _beats("Dots bring its depths 20 mm (rms) nearer to the truth than uniform light does", column="rms_mm",
               unit="mm", at_least=-inf, at_most=-20.0),
        _better("A volume of {scene} beats one depth of each pixel (--focus map)"),
        _nearer("The volume's depths of {scene} have a smaller rms error", column="rms_mm"),
        _nearer("The volume's depths of {scene} have a smaller median error", column="median_mm"),
    ),
    panels=(Images("way", down=("scene",)),),
    tables=(Pivot(("scene", "way"), title="Means", columns={
        "psnr_db": "PSNR [dB]", "rms_mm": "rms error of depth [mm]", "median_mm": "median error of depth [mm]"}),),
    about="Frames are exposed at equal peak and solved with factors of a session at 400 mm: one depth of each pixel by "
    "--focus map, volumes by --focus volume --method tv. Volumes under dots have the default range, and those under "
    "uniform light the scene's. The true depth is the mean over 16 rays of a pixel, and pixels of reflectance above "
    "0.05 count. After +-: one standard error over three seeds of session and noise. A quick study has the camera "
    "small where none is named. Your own scene is lit by dots:7x16.",
    heads=("", "", "Measured"),
)  # fmt: skip

STUDIES = {each.name: each for each in (DISTANCE, BINNING, RESOLUTION, DEPTH, SEVERAL)}

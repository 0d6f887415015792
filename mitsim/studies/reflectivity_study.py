"""What light does in the scene: gloss by its causes, and direct light apart from light over several surfaces.

*Gloss*, supplement of the paper: gift card, metal blade, compact disc, then roughness from 1 to a mirror on a
plate, to 0.03 on a ball. Gift card and metal blade come out quite good, the disc with severe artefacts. Every scene has
a twin of matt paint (``finish=matt``), whose reflectance is the Lambertian truth; the image's error against it is split
by cause. At one lambda an image R(Y) is linear in the frames Y, so its error against the reflectance L of the matt twin
is a sum of differences that leaves nothing over. With t the apparent reflectance of the glossy scene, its mean over the
sensor,

    pixels           = t - L                         brightness that is not the matt one
    sensor           = R(Y_direct) - R(Y_even)       light of a projector pixel that changes over the sensor
    interreflection  = R(Y_all) - R(Y_direct)
    saturation       = R(what the sensor reads of Y_all in the mean) - R(Y_all)
    rest             = R(Y_even) - t and noise       what a matt scene of the same brightness has as well

Y_even is the twin's light, that of each projector pixel times t / L: as bright, from the same places, but matt.

*Global light*: dots separate direct from global light, which improves on images that take all light for direct. Nayar,
Krishnan, Grossberg and Raskar (2006) need a camera with a lens; here :mod:`mitsim.reconstruct.convolution` separates
them, in scenes whose light over several surfaces is known. Depth hides most of the gain, so every scene is shown twice:
as it is, and with direct light as the calibrated factors have it at any depth, as if depth were mended.

A scene of the user's own is measured for gloss if it has a parameter ``finish``, for global light otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse
from scipy.interpolate import RegularGridInterpolator

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import locate
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas
from mitsim.devices.patterns import Shot
from mitsim.light.grids import LightEstimate
from mitsim.light.light import SampledLight
from mitsim.metrics import psnr
from mitsim.optics.frames import ExpectedFrames, Frame
from mitsim.reconstruct.focus import FactorOfDepths, parallax_of, separate
from mitsim.reconstruct.solution import Solution
from mitsim.reconstruct.solver import Accumulator, Prepared
from mitsim.report import EQUAL_PEAK, RENDERED
from mitsim.report.lit_scene import LitScene, Unexposed, peak_time
from mitsim.report.pages import Value
from mitsim.sensor.moments import frame_moments
from mitsim.studies.framework.claims import Holds, Judged, Level, choose_rows, distinct, every, mean_of, within
from mitsim.studies.framework.experiment import Found, Point, Scope, Study
from mitsim.studies.framework.panels import Images, Lines
from mitsim.studies.framework.studio import Studio, flags_of, single_precision

if TYPE_CHECKING:
    from pandas import DataFrame

# -------- Light of a glossy scene and of its matt twin in

PIXELS, SENSOR, INTERREFLECTION, SATURATION, REST = ERROR_SOURCES = (
    "pixels", "sensor", "interreflection", "saturation", "rest",
)  # fmt: skip
_DARK = 1e-3
"""Reflectance below which a pixel of the twin has no light to be scaled: shadows, beyond which sampling decides."""


@dataclass(frozen=True, eq=False)
class Split:
    """The image of one noisy exposure, and its error against the matt twin's reflectance.

    Attributes
    ----------
    solution
        with the image (n, n).
    parts
        (n, n) by :data:`ERROR_SOURCES`; image and the twin's reflectance are their sum apart.
    """

    solution: Solution
    parts: Mapping[str, FloatArray]


@single_threaded_blas()
def split(frames: Unexposed, twin: LitScene, seconds: float) -> Split:
    """The image of an exposure of so many ``seconds``, and what each cause puts into it.

    Parameters
    ----------
    frames
        rendered, under a family whose every pattern is one shot.
    twin
        the same scene without gloss, in its light.
    seconds
        of each frame.
    """
    model, sums = frames.data(seconds)
    solution, exposer = model.solve(sums), frames.exposer(seconds)
    lit, family = frames.lit, frames.family

    def light(frame: Frame) -> FloatArray:
        return exposer.electrons(frame) / seconds

    def read(frame: Frame) -> FloatArray:
        mean, _ = frame_moments(exposer.electrons(frame), seconds, lit.bench.sensor)
        return exposer.rate(mean)

    def image(expected: ExpectedFrames, seen: Callable[[Frame], FloatArray]) -> FloatArray:
        return _image(model, frames, solution.lam, expected, seen)

    own, matt = lit.truth, twin.truth
    even, direct = (
        LitScene(each).expected_frames(RENDERED, family)
        for each in (as_bright(twin.light, lit.light), direct_of(lit.light))
    )
    images = [image(even, light), image(direct, light), image(frames.expected, light), image(frames.expected, read)]
    parts = {
        PIXELS: own - matt,
        SENSOR: images[1] - images[0],
        INTERREFLECTION: images[2] - images[1],
        SATURATION: images[3] - images[2],
    }
    return Split(solution, {**parts, REST: solution.image - matt - sum(parts.values())})


def direct_of(light: SampledLight) -> SampledLight:
    """A ``light`` without what was followed over several surfaces."""

    def without(part: LightEstimate) -> LightEstimate:
        return part.with_light({name: sparse.csr_array(part[name].shape) for name in ("indirect", "indirect_residual")})

    return replace(light, groups=tuple(without(group) for group in light.groups))


def as_bright(matt: SampledLight, glossy: SampledLight) -> SampledLight:
    """Direct light of a ``matt`` scene, scaled projector pixel by projector pixel to the brightness of a ``glossy``
    one. The scale comes from the traced light and not from the truth, so that sampling noise of a pixel's brightness
    does not count as gloss."""
    lit = matt.flux > _DARK * matt.apparent.board_flux
    ratio = np.divide(glossy.flux, matt.flux, out=np.zeros_like(glossy.flux), where=lit)
    rows = sparse.diags_array(np.append(ratio, 1.0))  # the last row is ambient light
    matt = direct_of(matt)
    groups = (
        each.with_light({grid: sparse.csr_array(rows @ light) for grid, light in each.light.items()})
        for each in matt.groups
    )
    return replace(matt, groups=tuple(groups))


def _image(
    model: Prepared, frames: Unexposed, lam: float, expected: ExpectedFrames, seen: Callable[[Frame], FloatArray]
) -> FloatArray:
    """Of ``expected`` frames as they are ``seen`` [electrons/s], without noise."""
    sums = model.accumulator()
    for shot, frame in zip(frames.family.shots, expected, strict=True):
        sums.add(seen(frame), shot.row, shot.column)
    return model.solve(sums, lam).image


# -------- Gloss

CARD, _, DISC = SHIPPED = ("gift_card", "metal_blade", "compact_disc")
SHAPES = {"plate": {"shape": "rectangle", "z": "400"}, "ball": {"shape": "sphere", "z": "440"}}
"""Of the scene `highlight`."""
ROUGHNESSES = (1.0, 0.3, 0.1, 0.03, 0.003, 0.001)
"""Of GGX lobes: from all directions to 0.8 mm at the sensor, which is 6 mm wide. At 0.01 lobes are neither wide enough
for a few anchors nor sharp enough to be aimed at: light takes minutes."""
_COUNTS = {"plate": 6, "ball": 4}
"""Of them, as light of sharper lobes of a ball and of its backdrop takes minutes."""
GLOSS_FAMILIES = ("uniform", "dots:7")
AS_MATT = "as the matt scene"
"""The exposure time of the twin, with which highlights saturate."""
EXPOSURES = (EQUAL_PEAK, AS_MATT)
_ACCURACY = 3e-3
"""Of the light: a tenth of the artefacts that matter, and of global light, in a third of the time of 1e-3."""
_TRUTHS = ("matt paint", "apparent")
_GREY = 0.5
"""Grey of an error of 0, as images of errors are kept."""
_ROUNDING = 1e-12
"""Mean square of an error that is rounding: factors of a condition of 1e7 leave 1e-28 to 1e-14 of the image's."""
_PLAIN_DB = 20.0
"""Artefacts of a tenth of white are plainly seen."""
_ARTEFACTS = "artefacts_db"
"""PSNR that the errors by gloss alone would leave."""
_NAMES = {
    PIXELS: "gloss over pixels", SENSOR: "gloss over sensor", INTERREFLECTION: INTERREFLECTION,
    SATURATION: SATURATION, REST: "rest",
}  # fmt: skip
_DRAWN = {"patterns": "dots:7", "exposure": EQUAL_PEAK}
"""Rows whose causes are shown as images."""
GLOSS, GLOBAL_LIGHT = PARTS = ("gloss", "global light")


def _points(scope: Scope) -> list[Point]:
    base = replace(scope.setup, accuracy=max(scope.setup.accuracy, _ACCURACY))
    if scope.pictures == (None,):
        glossy = 'name="finish"' in locate(base.scene, "scenes", "scene.xml").read_text(errors="replace")
        gloss, bounced = ({base.scene: [base]}, []) if glossy else ({}, [base])
    else:
        gloss = {name: [replace(base, scene=name)] for name in scope.choose(SHIPPED, (CARD, DISC))}
        for name, shape in () if scope.quick else SHAPES.items():
            gloss[name] = [
                replace(base, scene="highlight").with_parameters(roughness=each, **shape)
                for each in ROUGHNESSES[: _COUNTS[name]]
            ]
        bounced = [replace(base, scene=name) for name in scope.choose(SCENES, SCENES[:1])]
    found = [
        Point.of(setup, part=GLOSS, subject=name, seed=seed)
        for name, each in gloss.items()
        for setup in each
        for seed in scope.repeats
    ]
    return found + [
        Point.of(setup, part=GLOBAL_LIGHT, subject=setup.scene, patterns=family, seed=seed)
        for setup in bounced
        for seed in scope.repeats
        for family in scope.choose(DOTS, DOTS[1:2])
    ]


def _measure(studio: Studio, point: Point) -> Found:
    return _measure_gloss(studio, point) if point["part"] == GLOSS else _measure_global(studio, point)


def _measure_gloss(studio: Studio, point: Point) -> Found:
    seed = int(point["seed"])
    factors = studio.factors(point.setup, seed)
    twin = studio.lit_scene(point.setup.with_parameters(finish="matt"))
    lit = studio.lit_scene(point.setup)
    rows, images = [], dict(zip(_TRUTHS, (twin.truth, lit.truth), strict=True))
    for name in GLOSS_FAMILIES:
        family = lit.bench.family(name, seed)
        frames = lit.rendered_frames(factors, family, seed)
        times = frames.seconds(EQUAL_PEAK), peak_time(twin.bench, twin.expected_frames(RENDERED, family))
        for exposure, seconds in zip(EXPOSURES, times, strict=True):
            found = split(frames, twin, seconds)
            image = found.solution.image
            measured: dict[str, Value] = {"psnr_db": psnr(image, lit.truth), "psnr_matt_db": psnr(image, twin.truth)}
            measured |= flags_of(found.solution.status)
            measured |= {f"{cause}_db": _decibels(part) for cause, part in found.parts.items()}
            added = np.sum([found.parts[cause] for cause in (SENSOR, INTERREFLECTION, SATURATION)], axis=0)
            own: dict[str, Value] = {"patterns": name, "exposure": exposure, "exposure_s": seconds}
            rows.append(point.row(**own, artefacts_db=_decibels(added), **measured))
            images[_KEPT_AS.format(**own)] = image
            if own | _DRAWN == own:
                images |= {cause: part + _GREY for cause, part in found.parts.items()}
    return Found(tuple(rows), single_precision(images))


def _decibels(error: FloatArray) -> float | None:
    """Return the PSNR of an image that has this ``error`` alone; None where there is none."""
    power = float(np.square(error).mean())
    return -10 * float(np.log10(power)) if power > _ROUNDING else None


def _is_worst(rows: DataFrame) -> tuple[str, Holds]:
    """Judge whether the disc has plain artefacts, and more than each other subject."""
    by_name = {name: choose_rows(rows, {"subject": name}) for name in distinct(rows, "subject")}
    levels = {name: mean_of(own, _ARTEFACTS) for name, own in by_name.items()}
    text = ", ".join(f"{name} {level} dB" for name, level in levels.items()).replace("_", " ")
    disc = by_name.pop(DISC)
    more = (within(mean_of(disc, _ARTEFACTS, own), high=0) for own in by_name.values())
    return text, every(within(levels[DISC], high=_PLAIN_DB), *more)


# -------- Direct and global light

SCENES = ("corner", "cookie_bag")
DOTS = ("dots:4", "dots:7", "dots:10")
AS_IT_IS, MENDED = DEPTHS = ("as it is", "depth mended")
_DEPTHS = {AS_IT_IS: "as they are", MENDED: "with depth mended"}
_ALL, SEPARATED, ALONE, GLOBAL = IMAGES = ("all light", "separated", "direct alone", "global")
"""Images of all light taken for direct, of what is left once global light is told apart, of direct light without any
other, and of global light."""
_MARGIN = 2
"""Periods of the dots beyond the window that light comes from: in the corner four give no more."""
Measured = list[tuple[Shot, FloatArray]]
"""Frames [electrons/s] with their shots."""


def _measure_global(studio: Studio, point: Point) -> Found:
    frames = studio.frames(point.setup, RENDERED, str(point["patterns"]), int(point["seed"]))
    lit = frames.lit
    if not lit.light.simulation.physics.interreflection:
        raise MitsimError(
            f"study reflectivity: light over several surfaces is not worth following in {point['subject']}"
        )
    parallax = parallax_of(studio.factors(point.setup, int(point["seed"])))
    margin = _MARGIN * max(frames.family.left.shape[1], frames.family.right.shape[1])
    left, right = (FactorOfDepths(factor, parallax, axis).beyond(margin)[0] for axis, factor in enumerate(frames.sides))
    electrons = frames.exposer(1.0).electrons
    direct = [electrons(frame) for frame in LitScene(direct_of(lit.light)).expected_frames(RENDERED, frames.family)]
    bounced = [electrons(frame) - own for frame, own in zip(frames.expected, direct, strict=True)]
    known = global_truth(lit.light)
    rows, arrays = [], {"direct, true": lit.truth, "global, true": known}
    for depth in DEPTHS:
        own = direct if depth == AS_IT_IS else [_direct_by_factors(frames, shot) for shot in frames.family.shots]
        images, reported = _separate_images(frames, own, bounced, (left, right))
        levels = {f"{name}_db": psnr(image, known if name == GLOBAL else lit.truth) for name, image in images.items()}
        gain = levels[f"{SEPARATED}_db"] - levels[f"{_ALL}_db"]
        rows.append(point.row(depth=depth, gain_db=gain, told=reported, **levels))
        arrays |= {f"{depth} {name}": image for name, image in images.items()}
    return Found(tuple(rows), single_precision(arrays))


def _separate_images(
    frames: Unexposed, direct: Sequence[FloatArray], bounced: Sequence[FloatArray], seen: tuple[FloatArray, FloatArray]
) -> tuple[dict[str, FloatArray], float]:
    """Images of one exposure of all light, and the least part of a mode that the patterns tell.

    Parameters
    ----------
    frames
        patterns, exposure time and factors.
    direct, bounced
        light of each frame [electrons/s].
    seen
        the factors, and more columns beside.
    """
    model = frames.prepare()
    measured = _noisy(frames, [own + more for own, more in zip(direct, bounced, strict=True)])
    whole = _weights(model, measured)
    patterns = frames.family.left.astype(float), frames.family.right.astype(float)
    total = np.sum([frame for _, frame in measured], axis=0)
    found = separate(model, seen, patterns, whole.sum, total)
    less = _weights(model, [(shot, frame - found.common) for shot, frame in measured])
    solved = {_ALL: whole, SEPARATED: less, ALONE: _weights(model, _noisy(frames, direct))}
    images = {name: model.solve(sums).image for name, sums in solved.items()}
    return {**images, GLOBAL: found.image}, float(found.eigenvalues[0])


def _direct_by_factors(frames: Unexposed, shot: Shot) -> FloatArray:
    """Direct light [electrons/s] of a ``shot`` as the factors have it."""
    left, right = frames.sides
    return np.asarray(left @ (frames.family.light(shot) * frames.lit.truth) @ right.T)


def _noisy(frames: Unexposed, rates: Sequence[FloatArray]) -> Measured:
    """One exposure at equal peak of frames of these ``rates`` [electrons/s]; the peak is that of rendered frames."""
    seconds = frames.seconds(EQUAL_PEAK)
    exposer = frames.exposer(seconds)
    return [
        (shot, exposer.rate(exposer.digital(np.maximum(rate, 0.0) * seconds, *shot.names)))
        for shot, rate in zip(frames.family.shots, rates, strict=True)
    ]


def _weights(model: Prepared, measured: Measured) -> Accumulator:
    sums = model.accumulator()
    for shot, frame in measured:
        sums.add(frame, shot.row, shot.column)
    return sums


def global_truth(light: SampledLight) -> FloatArray:
    """(n, n) what a ``light`` that bounced looks like under uniform light: in each direction that the calibrated window
    has a pixel in, over the board's light there."""
    bench, grid = light.bench, light.simulation.grids["indirect"].bundle
    cells = np.asarray(sum(group["indirect"].sum(axis=0) for group in light.groups)) / len(light.groups)
    shape = len(grid.rows.centres), len(grid.columns.centres)
    density = cells.reshape(-1, *shape).sum(axis=0) / (grid.rows.width * grid.columns.width)
    windows = [np.linspace(*edges, bench.n + 1) for edges in bench.windows]
    rows, columns = ((edges[1:] + edges[:-1]) / 2 for edges in windows)
    seen = RegularGridInterpolator(
        (grid.rows.centres, grid.columns.centres), density, bounds_error=False, fill_value=None
    )(np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1))
    area = np.outer(*(np.diff(edges) for edges in windows))
    return np.asarray(seen * area / light.apparent.board_flux.reshape(bench.n, bench.n))


# -------- The study

_LIGHT = {
    "direct, true": ("direct, true", ""),
    **{f"{{depth}} {name}": (name, f"{{{name}_db:.1f}} dB") for name in IMAGES[:-1]},
    "global, true": ("global, true", ""),
    f"{{depth}} {GLOBAL}": (GLOBAL, f"{{{GLOBAL}_db:.1f}} dB"),
}
"""Titles and captions of the arrays of a scene with global light, from left to right."""

_GLOSS_OF_DOTS = {"part": GLOSS, "patterns": "dots:7"}
_SWEPT, _NOT_SWEPT = (
    {**_GLOSS_OF_DOTS, "subject": tuple(SHAPES)},
    {"part": GLOSS, "subject": lambda name: name not in SHAPES},
)
_KEPT_AS = "{patterns}, {exposure}"
"""Names of the images of gloss."""

STUDY = Study(
    "reflectivity",
    "Gloss and global light",
    "What do shiny surfaces and light over several surfaces do to the image, and what do dots tell of it?",
    points=_points,
    measure=_measure,
    claims=(
        Level(
            "Gift card and metal blade come out well (artefacts of gloss, 49 dots)",
            where={**_GLOSS_OF_DOTS, "subject": [name for name in SHIPPED if name != DISC]},
            every="subject",
            column=_ARTEFACTS,
            paper="quite good",
            at_least=_PLAIN_DB,
            optional=True,
        ),
        Judged(
            "The compact disc is the worst, with severe artefacts (artefacts of gloss, 49 dots)",
            _is_worst,
            where={**_GLOSS_OF_DOTS, "subject": SHIPPED},
            paper="severe artefacts",
            optional=True,
        ),
        *(
            Level(
                f"49 dots tell global light apart in scenes {words}, and the image gains (Nayar et al. 2006)",
                where={"part": GLOBAL_LIGHT, "patterns": "dots:7", "depth": depth},
                every="subject",
                column="gain_db",
                at_least=0.0,
                optional=True,
            )
            for depth, words in _DEPTHS.items()
        ),
    ),
    panels=(
        Lines(
            "roughness",
            "roughness, alpha of GGX [1]",
            file="causes",
            y_label="PSNR against matt paint [dB]",
            where=_SWEPT,
            each="exposure",
            colour={"psnr_matt_db": "image", **{f"{cause}_db": f"{name} alone" for cause, name in _NAMES.items()}},
            facet="subject",
            log=True,
        ),
        Images(
            "roughness",
            title="By roughness, 49 dots, equal peak",
            where=_SWEPT | _DRAWN,
            each="subject",
            down=("subject",),
            array=_KEPT_AS,
            names="alpha {}",
        ),
        Images(
            ("patterns", "exposure"),
            file="images_shipped",
            where=_NOT_SWEPT,
            down=("subject",),
            array=_KEPT_AS,
            before={name: name for name in _TRUTHS},
        ),
        Images(
            {cause: (name, f"{{{cause}_db:.1f}} dB") for cause, name in _NAMES.items()},
            file="causes_shipped",
            title="Errors against matt paint by cause, 49 dots, equal peak: grey is no error",
            where=_NOT_SWEPT | _DRAWN,
            down=("subject",),
        ),
        Images(
            _LIGHT,
            title="49 dots, scenes",
            where={"part": GLOBAL_LIGHT, "patterns": "dots:7"},
            each="depth",
            down=("subject",),
            names=_DEPTHS,
        ),
    ),
    heads=("Paper", "", "Rendered"),
    note="Each scene with gloss has a twin of matt paint, the truth that errors are taken against; apparent is what "
    "the glossy scene shows, its mean over the sensor, the truth of the images' decibels. As the matt scene: "
    "exposed as long as the twin, so that highlights saturate. Decibels of a cause are the PSNR that its errors "
    "alone would leave. Gloss over pixels: brightness that is not the matt one; gloss over sensor: light of a "
    "projector pixel that changes over the sensor. Global light came over several surfaces, direct light over "
    "one. Its images, exposed at equal peak: of all light taken for direct; of what is left once global light "
    "is told apart (Nayar et al. 2006, without a lens); of direct light alone, which is the best that telling "
    "apart can do; and the global light itself. Twice: of scenes as they are, whose depth the solver does not "
    "know, and with direct light as the calibration has it at any depth.",
)

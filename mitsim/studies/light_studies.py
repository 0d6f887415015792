"""The paper's studies of light vary the patterns, their exposure, ambient light, gloss and interreflection.

*patterns* repeats section IV-B and figure 4. *ambient* repeats the supplement: the lamp has from 1/100 to 100 times
the projector's light.

*exposure* repeats section V-B, figure 9, and the supplement's error analysis. A least-squares image x' of a scene x has
||x|| / ||x - x'|| = ||x|| / (s rho), where rho^2 = Tr (A^T A)^-1 = sum 1 / s_i^2 over the singular values of A, the
model of all frames, and s is the noise of a datum. (The paper writes SER = sqrt(T) SNR / rho for T equal frames.)

*reflectivity* repeats the supplement. *Gloss*: every scene has a matt twin (``finish=matt``), whose reflectance L is
the truth. At one lambda an image R(Y) is linear in the frames Y. Therefore its error is a sum of differences, with t
the apparent reflectance of the glossy scene, its mean over the sensor:

    pixels           = t - L                         brightness that differs from the matt one
    sensor           = R(Y_direct) - R(Y_even)       light of a projector pixel that changes over the sensor
    interreflection  = R(Y_all) - R(Y_direct)
    rest             = R(Y_even) - t and noise       error that a matt scene of the same brightness has as well

where Y_even is the twin's light, with that of each projector pixel times t / L. A user's scene is measured for gloss
if it has a parameter ``finish``, otherwise for global light.

*Global light*, which came over several surfaces, is nearly the same in all frames under shifting dots (Nayar, Krishnan,
Grossberg and Raskar 2006). With P_ij the patterns, frames are Y_ij = L (P_ij o X) R^T + F, and the image of F is linear
between nodes as far apart as the dots: F = Q f S^T. The least squares of all K frames over X and f have, with A =
(sum_i U_i)^T Q and B alike,

    K f - A^T (A f B^T) B = Q^T (sum_ij Y_ij) S - A^T W B

where W are the summed products of frames and patterns. An eigenvalue of the left side over K is the part of a mode of F
that lit pixels do not explain: 0 under uniform light.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
from scipy import sparse

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import locate
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas
from mitsim.devices.patterns import PatternFamily
from mitsim.light.light import SampledLight
from mitsim.metrics import psnr
from mitsim.optics.frames import ExpectedFrames
from mitsim.reconstruct.solver import Accumulator, Prepared, Solution
from mitsim.report import CONVENTIONS, EQUAL_FRAME, EQUAL_PEAK, IDEALISED, MODELS, RENDERED
from mitsim.report.lit_scene import DIM, LitScene, Pair, Unexposed
from mitsim.studies.framework.claims import Gain, Level, measured, stated
from mitsim.studies.framework.experiment import Axes, Found, Point, Scope, Study
from mitsim.studies.framework.panels import Bars, Images, Lines
from mitsim.studies.framework.studio import Image, Studio, finding, flags_of, measure_image, single_precision

# -------- The patterns, and their number

FAMILIES = (
    "uniform", "random:2", "random:4", "random:5", "random:7", "random:8", "dots:2", "dots:3", "dots:4", "dots:5",
    "dots:6", "dots:7", "dots:8", "hadamard:2", "hadamard:4", "hadamard:8",
)  # fmt: skip
_FEW = "uniform", "random:7", "dots:2", "dots:4", "dots:7", "dots:8", "hadamard:4", "hadamard:8"
_SHOWN = "uniform", "random:7", "dots:4", "dots:7", "hadamard:8"
_STATED = "uniform", "dots:7"
"""Families whose PSNR the paper's figures 4 to 6 state, mask at 2000 um."""


def _patterns_measure(studio: Studio, point: Point) -> Found:
    family, kind = studio.bench(point.setup).family(point["patterns"]), str(point["patterns"]).partition(":")[0]
    count, found = family.left.shape[1] * family.right.shape[1], measure_image(studio, point, _SHOWN)
    return replace(found, rows=tuple({**row, "patterns_count": count, "kind": kind} for row in found.rows))


_ANY = {"exposure": CONVENTIONS}
PATTERNS = Study(
    "patterns",
    "Which patterns, and how many",
    "What do uniform, random, shifting-dots and Hadamard patterns recover, by their number and exposure?",
    points=Axes(
        {"patterns": FAMILIES, "exposure": (*CONVENTIONS, DIM), "model": MODELS},
        quick={"patterns": _FEW, "exposure": (*CONVENTIONS[:2], DIM)},
        kept=lambda values: values["exposure"] != DIM or values["patterns"] in _STATED,
    ),
    measure=_patterns_measure,
    claims=(
        stated("One uniform pattern gives 21 to 23 dB", 21.0, 23.0, patterns="uniform"),
        stated("49 shifting dots give 34 to 35.5 dB", 34.0, 35.5, patterns="dots:7"),
        Gain("More dots, better images (49 against 4)", "dots:7", "dots:2", where=_ANY, paper="higher"),
        Gain("Orthogonal patterns outperform random ones", "dots:7", "random:7", where=_ANY, paper="higher"),
        Gain("Hadamard patterns perform best, for their light", "hadamard:8", "dots:8", where=_ANY, paper="higher"),
    ),
    panels=(
        Lines("patterns_count", "number of patterns [1]", where=_ANY, each="exposure", colour="kind", shared="uniform"),
        Images("patterns", columns=_SHOWN, title=f"exposure {EQUAL_FRAME}", where={"exposure": EQUAL_FRAME}),
    ),
)

# -------- The same time, shared differently

FRAMES = 49
ONE, MANY, DOTS = SHARED = ("1 uniform", "49 uniform", "49 dots")
_LAW_WITHIN = 0.1
"""Relative difference of law and measurement: one draw scatters by 1 %."""


def _exposure_measure(studio: Studio, point: Point) -> Found:
    bench, name = studio.bench(point.setup), str(point["patterns"])
    ones, count = np.ones((bench.n, 1), np.int8), 1 if name == ONE else FRAMES
    family = bench.family("dots:7") if name == DOTS else PatternFamily(name, ones.repeat(count, axis=1), ones)
    frames = studio.frames(point.setup, point["model"], family, int(point["seed"]))
    seconds = frames.seconds(EQUAL_FRAME)
    image, law = Image.of(frames, seconds), {}
    if point["model"] == IDEALISED and name == DOTS:
        # Elsewhere the law's model is not that of the frames, or least squares magnifies rounding beyond any image.
        truth, model = frames.lit.truth, frames.prepare()
        signal, error = (float(np.linalg.norm(each)) for each in (truth, frames.solve(seconds, 0.0).image - truth))
        rho = float(np.sqrt(np.square(1 / np.outer(model.left.singular, model.right.singular)).sum()))
        expected = signal / (frames.noise(seconds) * rho)
        law = {"ser": signal / error, "ser_law": expected, "ser_over_law": signal / error / expected}
    return finding(studio, point, image.image, **image.row(), **law)


EXPOSURE = Study(
    "exposure",
    "The same time, shared differently",
    "Do many dots beat as many uniform frames that take as long?",
    points=Axes({"patterns": SHARED, "model": MODELS}),
    measure=_exposure_measure,
    claims=(
        Gain("49 dots beat 49 uniform frames of the same time", DOTS, MANY, paper="higher"),
        Gain("49 uniform frames are slightly better than one", MANY, ONE, paper="slightly higher"),
        Level(
            "Without regularisation, ||x|| / ||x - x'|| is SNR / rho (49 dots)",
            paper="equal",
            where={"ser_over_law": measured},
            column="ser_over_law",
            unit="of the law",
            at_least=1 - _LAW_WITHIN,
            at_most=1 + _LAW_WITHIN,
        ),
    ),
    panels=(
        Bars("patterns", title=f"exposure {EQUAL_FRAME}"),
        Images("patterns", columns=SHARED, title=f"exposure {EQUAL_FRAME}"),
    ),
)

# -------- Ambient light

RADIANCES = WEAK, _, AS_BRIGHT, BRIGHTER, STRONG = ("1.17", "11.7", "117", "1170", "11700")
"""Radiance of the scene's lamp [W m^-2 sr^-1]."""
_BRIGHT = 99.0
"""Percentile at the end of a dynamic range, because the noise of single pixels is no signal."""
_BETTER, _OTHER = "hadamard:8", "dots:8"


def _ambient_measure(studio: Studio, point: Point) -> Found:
    setup, patterns, seed = point.setup, str(point["patterns"]), int(point["seed"])
    image, frames = studio.image(setup, RENDERED, patterns, seed), studio.frames(setup, RENDERED, patterns, seed)
    exposer = frames.exposer(frames.seconds(EQUAL_PEAK))
    dark = exposer.electrons(frames.expected.projector_off)
    bright = [np.percentile(exposer.electrons(frame) - dark, _BRIGHT) for frame in frames.expected]
    part = float(np.mean(bright)) / frames.lit.bench.sensor.superpixel_full_well_e
    return finding(studio, point, image.image, range_high=part, **image.row())


AMBIENT = Study(
    "ambient",
    "A lamp beside the projector",
    "How much ambient light does each kind of pattern stand?",
    points=Axes(
        {"patterns": ("uniform", "dots:8", "hadamard:8"), "model": (RENDERED,), "exposure": (EQUAL_PEAK,)},
        scene={"lamp": RADIANCES},
        quick={"lamp": RADIANCES[::2]},
        quick_prints=1,
        default="lamp_bench",
    ),
    measure=_ambient_measure,
    claims=(
        Gain(
            "Under a lamp as bright as the projector Hadamard patterns have more dynamic range (part of the full well)",
            _BETTER,
            _OTHER,
            where={"lamp": AS_BRIGHT},
            column="range_high",
            unit="",
            paper="0.06 to 0.17 against 0 to 0.02",
        ),
        Gain(
            "Hadamard patterns are better under lamps as bright as the projector or brighter",
            _BETTER,
            _OTHER,
            where={"lamp": (AS_BRIGHT, BRIGHTER, STRONG)},
            every="lamp",
            paper="better",
        ),
        Gain(
            "Dots, half of the frames, are preferred under a weak lamp",
            _OTHER,
            _BETTER,
            where={"lamp": WEAK},
            paper="preferred",
        ),
    ),
    panels=(
        Lines(
            "lamp",
            "radiance of the lamp [W m$^{-2}$ sr$^{-1}$]",
            title="PSNR by the lamp, exposure equal peak",
            facet="",
            log=True,
        ),
        Images("lamp", title="Images by the lamp's radiance, exposure equal peak", down=("patterns",)),
    ),
    heads=("Paper", "", "Rendered"),
    note="From every frame a frame with the projector off is subtracted; its noise stays. An even grey has a PSNR of "
    "12 to 20 dB.",
)

# -------- Gloss: the error against the matt twin by cause

PIXELS, SENSOR, INTERREFLECTION, REST = ERROR_SOURCES = ("pixels", "sensor", "interreflection", "rest")
_DARK = 1e-3
"""Reflectance of shadows, whose scale is only sampling noise."""


@single_threaded_blas()
def split(frames: Unexposed, twin: LitScene, seconds: float) -> tuple[Solution, dict[str, FloatArray]]:
    """Solve one noisy exposure of ``seconds`` a frame, and split its error against the matt ``twin``.

    Return the solution, and (n, n) errors by :data:`ERROR_SOURCES`, whose sum is the image less the twin's reflectance.
    """
    model, sums = frames.data(seconds)
    solution, exposer, lit = model.solve(sums), frames.exposer(seconds), frames.lit

    def image(expected: ExpectedFrames) -> FloatArray:
        measured = frames.family.measurements(exposer.electrons(frame) / seconds for frame in expected)
        return model.solve(model.accumulator(measured), solution.lam).image

    lights = as_bright(twin.light, lit.light), direct_of(lit.light)
    even, direct = (image(LitScene(light).expected_frames(RENDERED, frames.family)) for light in lights)
    whole = image(frames.expected)
    parts = {PIXELS: lit.truth - twin.truth, SENSOR: direct - even, INTERREFLECTION: whole - direct}
    return solution, {**parts, REST: solution.image - twin.truth - sum(parts.values())}


def direct_of(light: SampledLight) -> SampledLight:
    names = "indirect", "indirect_residual"
    groups = (each.with_light({name: sparse.csr_array(each[name].shape) for name in names}) for each in light.groups)
    return replace(light, groups=tuple(groups))


def as_bright(matt: SampledLight, glossy: SampledLight) -> SampledLight:
    """Return direct light of a matt scene, scaled pixel by pixel to the brightness of a glossy one.

    The scale comes from the traced light, so that sampling noise does not count as gloss.
    """
    lit = matt.flux > _DARK * matt.apparent.board_flux
    ratio = np.divide(glossy.flux, matt.flux, out=np.zeros_like(glossy.flux), where=lit)
    rows = sparse.diags_array(np.append(ratio, 1.0))  # the last row is ambient light
    matt = direct_of(matt)
    scaled = ({grid: sparse.csr_array(rows @ light) for grid, light in each.light.items()} for each in matt.groups)
    groups = (each.with_light(light) for each, light in zip(matt.groups, scaled, strict=True))
    return replace(matt, groups=tuple(groups))


CARD, BLADE, DISC = SHIPPED = ("gift_card", "metal_blade", "compact_disc")
BOUNCING = ("corner", "cookie_bag")
GLOSS, GLOBAL_LIGHT = ("gloss", "global light")
AS_IT_IS, MENDED = ("as it is", "depth mended")
_ALL, SEPARATED, _ = DIRECT_IMAGES = ("all light", "separated", "direct alone")
_TRUTHS, _IMAGE, _PLAIN_DB, _ACCURACY = ("matt paint", "apparent"), "49 dots", 20.0, 3e-3
_LEAST_EIGENVALUE = 1e-3


def _reflectivity_points(scope: Scope) -> list[Point]:
    base = replace(scope.setup, accuracy=max(scope.setup.accuracy, _ACCURACY))
    parts = {GLOSS: scope.choose(SHIPPED, (CARD, DISC)), GLOBAL_LIGHT: scope.choose(BOUNCING, BOUNCING[:1])}
    if scope.pictures == (None,):
        glossy = 'name="finish"' in locate(base.scene, "scenes", "scene.xml").read_text(errors="replace")
        parts = {GLOSS if glossy else GLOBAL_LIGHT: (base.scene,)}
    return [
        Point.of(replace(base, scene=name), part=part, subject=name, seed=seed)
        for part, names in parts.items()
        for name in names
        for seed in scope.repeats
    ]


@single_threaded_blas()
def separate(model: Prepared, factors: Pair, patterns: Pair, weights: FloatArray, total: FloatArray) -> FloatArray:
    """Return the (m, m') light that all frames under shifting dots share.

    ``weights`` (n, n) are the sums of a `model` over the frames, and ``total`` (m, m') is the sum of all frames.
    """
    lit, bases, measured = [], [], (model.sigma > 0).astype(np.float64)
    for side, factor, lights in zip((model.left, model.right), factors, patterns, strict=True):
        pixels, dots = lights.shape
        # Functions linear between nodes a period of the dots apart, the outer ones at the window's ends.
        count = max(2, 1 + -(-(pixels - 1) // dots))
        place = np.arange(pixels) * (count - 1) / max(pixels - 1, 1)
        hats = np.maximum(0.0, 1 - np.abs(place[:, None] - np.arange(count)))
        bases.append(np.linalg.qr(factor @ hats)[0])
        lit.append(side.common.T @ bases[-1])
    (rows, columns), frames = (each.shape[1] for each in lit), model.left.pattern_count * model.right.pattern_count
    pairs = [(each[:, :, None] * each[:, None, :]).reshape(len(each), -1) for each in lit]
    explained = (pairs[0].T @ measured @ pairs[1]).reshape(rows, rows, columns, columns).transpose(0, 2, 1, 3)
    target = bases[0].T @ total @ bases[1] - lit[0].T @ (measured * weights) @ lit[1]
    left, modes = np.linalg.eigh(np.eye(target.size) - explained.reshape(target.size, target.size) / frames)
    if left[-1] < _LEAST_EIGENVALUE:
        raise MitsimError("separation: these patterns light all pixels in each frame; use dots:K with K of 2 or more")
    inverse = np.divide(1.0, frames * left, out=np.zeros_like(left), where=left > _LEAST_EIGENVALUE)
    return np.asarray(bases[0] @ (modes @ (inverse * (modes.T @ target.ravel()))).reshape(rows, columns) @ bases[1].T)


def _measure_global(studio: Studio, point: Point) -> Found:
    frames = studio.frames(point.setup, RENDERED, "dots:7", int(point["seed"]))
    lit, family, model = frames.lit, frames.family, frames.prepare()
    if not lit.light.simulation.physics.interreflection:
        raise MitsimError(f"study reflectivity: {point['subject']} has no light over several surfaces to follow")
    seconds, electrons = frames.seconds(EQUAL_PEAK), frames.exposer(1.0).electrons
    exposer, (left, right) = frames.exposer(seconds), frames.sides
    direct = [electrons(frame) for frame in LitScene(direct_of(lit.light)).expected_frames(RENDERED, family)]
    bounced = [electrons(frame) - own for frame, own in zip(frames.expected, direct, strict=True)]
    mended = [np.asarray(left @ (family.light(shot) * lit.truth) @ right.T) for shot in family.shots]

    def expose(rates: list[FloatArray]) -> list[FloatArray]:
        shown = zip(family.shots, rates, strict=True)
        return [exposer.rate(exposer.digital(np.maximum(rate, 0.0) * seconds, *shot.names)) for shot, rate in shown]

    def accumulate(taken: list[FloatArray], less: FloatArray | float = 0.0) -> Accumulator:
        return model.accumulator(family.measurements(frame - less for frame in taken))

    rows, arrays = [], {"direct, true": lit.truth}
    for depth, own in ((AS_IT_IS, direct), (MENDED, mended)):
        taken = expose([one + more for one, more in zip(own, bounced, strict=True)])
        whole, patterns = accumulate(taken), (family.left.astype(float), family.right.astype(float))
        common = separate(model, frames.sides, patterns, whole.sum, np.sum(taken, axis=0))
        solved = zip(DIRECT_IMAGES, (whole, accumulate(taken, common), accumulate(expose(own))), strict=True)
        images = {name: model.solve(sums).image for name, sums in solved}
        levels = {f"{name}_db": psnr(image, lit.truth) for name, image in images.items()}
        gain = levels[f"{SEPARATED}_db"] - levels[f"{_ALL}_db"]
        rows.append(point.row(depth=depth, gain_db=gain, **levels))
        arrays |= {f"{depth} {name}": image for name, image in images.items()}
    return Found(tuple(rows), single_precision(arrays))


def _measure_gloss(studio: Studio, point: Point) -> Found:
    def decibels(error: FloatArray) -> float | None:
        power = float(np.square(error).mean())
        return -10 * float(np.log10(power)) if power > 1e-12 else None  # else rounding alone

    seed = int(point["seed"])
    factors = studio.factors(point.setup, seed)
    twin, lit = studio.lit_scene(point.setup.with_parameters(finish="matt")), studio.lit_scene(point.setup)
    frames = lit.rendered_frames(factors, lit.bench.family("dots:7", seed), seed)
    seconds = frames.seconds(EQUAL_PEAK)
    solution, parts = split(frames, twin, seconds)
    row = point.row(
        exposure_s=seconds,
        artefacts_db=decibels(parts[SENSOR] + parts[INTERREFLECTION]),
        psnr_db=psnr(solution.image, lit.truth),
        psnr_matt_db=psnr(solution.image, twin.truth),
        **flags_of(solution.status),
        **{f"{cause}_db": decibels(part) for cause, part in parts.items()},
    )
    images = {**dict(zip(_TRUTHS, (twin.truth, lit.truth), strict=True)), _IMAGE: solution.image}
    images |= {cause: part + 0.5 for cause, part in parts.items()}
    return Found((row,), single_precision(images))


REFLECTIVITY = Study(
    "reflectivity",
    "Gloss and global light",
    "What do shiny surfaces and light over several surfaces do to the image?",
    points=_reflectivity_points,
    measure=lambda studio, point: (_measure_gloss if point["part"] == GLOSS else _measure_global)(studio, point),
    claims=(
        *(
            Level(
                f"{words} (artefacts of gloss, 49 dots)", paper=paper, where={"subject": name}, column="artefacts_db",
                at_least=low, at_most=high, optional=True,
            )
            for name, words, paper, low, high in (
                (CARD, "The gift card comes out well", "quite good", _PLAIN_DB, inf),
                (BLADE, "The metal blade comes out well", "quite good", _PLAIN_DB, inf),
                (DISC, "The compact disc is worst", "severe artefacts", -inf, _PLAIN_DB),
            )
        ),
        *(
            Level(
                f"49 dots separate global light, {depth} (Nayar et al. 2006)", every="subject", column="gain_db",
                where={"part": GLOBAL_LIGHT, "depth": depth}, at_least=0.0, optional=True,
            )
            for depth in (AS_IT_IS, MENDED)
        ),
    ),
    panels=(
        Images(
            {_IMAGE: (_IMAGE, "{psnr_db:.1f} dB"),
             **{cause: (cause.replace("interr", "inter-r"), f"{{{cause}_db:.1f}} dB") for cause in ERROR_SOURCES}},
            title="Images and their errors by cause, grey is none", before={name: name for name in _TRUTHS},
            down=("subject",), where={"part": GLOSS},
        ),
        Images(
            {"direct, true": ("direct, true", ""),
             **{f"{{depth}} {name}": (name, f"{{{name}_db:.1f}} dB") for name in DIRECT_IMAGES}},
            file="global", title="49 dots", down=("subject",), where={"part": GLOBAL_LIGHT}, each="depth",
        ),
    ),
    heads=("Paper", "", "Rendered"),
    note="Each scene with gloss has a twin of matt paint, the truth of errors; apparent is the mean of the glossy "
    "scene over the sensor, the truth of the image's decibels. Decibels of a cause are the PSNR that its errors alone "
    "would leave. Pixels: brightness that is not the matt one; sensor: light of a projector pixel that changes over "
    "the sensor. Global light came over several surfaces. All light: taken for direct; separated: less the light that "
    "all frames share; direct alone: the best that separation can reach. Depth mended: direct light is that of the "
    "calibration at any depth.",
)  # fmt: skip

STUDIES = {each.name: each for each in (PATTERNS, EXPOSURE, AMBIENT, REFLECTIVITY)}

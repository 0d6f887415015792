"""Studies of the paper on illumination: the patterns, the exposure that they share, and ambient light.

*patterns*, section IV-B and figure 4: uniform, random, shifting dots and repeated Hadamard, 1 to 64 of them, by three
ways to expose them; singular values, and the mean PSNR of eight test images by the number of patterns.

*exposure*, section V-B, figure 9, and the error analysis of the supplement: one uniform frame, 49 uniform frames, and
49 dots in the same time. Of a least-squares image x' of a scene x, ||x|| / ||x - x'|| = ||x|| / (s rho), rho^2 =
Tr (A^T A)^-1 = sum 1 / s_i^2 over the singular values of the model A of all frames, s being the noise of a datum. (The
paper writes it as SER = sqrt(T) SNR / rho, of T equal frames.)

*ambient*, supplement: one uniform pattern, 64 dots and 64 Hadamard patterns under ambient light, from a hundredth of
the projector's to a hundred times, whose reference frame is subtracted; the dynamic range of the measurements decides.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mitsim.devices.patterns import PatternFamily
from mitsim.report import CONVENTIONS, EQUAL_FRAME, EQUAL_PEAK, IDEALISED, MODELS, RENDERED, label
from mitsim.report.lit_scene import DIM, Unexposed
from mitsim.studies.framework.claims import (
    Gain,
    Holds,
    Judged,
    Level,
    choose_rows,
    distinct,
    mean_of,
    measured,
    stated,
    with_unit,
    within,
)
from mitsim.studies.framework.experiment import Axes, Found, Point, Results, Study
from mitsim.studies.framework.panels import Bars, Images, Lines
from mitsim.studies.framework.studio import Image, Studio, finding, measure_image

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

# -------- The patterns, and their number

FAMILIES = (
    "uniform", "random:2", "random:4", "random:5", "random:7", "random:8", "dots:2", "dots:3", "dots:4", "dots:5",
    "dots:6", "dots:7", "dots:8", "hadamard:2", "hadamard:4", "hadamard:8",
)  # fmt: skip
_KINDS = {"dots": "shifting dots", "hadamard": "repeated Hadamard", "random": "random"}
_STATED = ("uniform", "dots:7")
"""Families that the paper's figures 4 to 6 give decibels of, mask at 2000 um."""
_SHOWN = ("uniform", "random:7", "dots:4", "dots:7", "hadamard:8")
_SPECTRUM = "spectrum"
"""Squares of the left factor's singular values, of the calibrated camera with the family's patterns."""


def _patterns_measure(studio: Studio, point: Point) -> Found:
    frames = studio.frames(point.setup, point["model"], point["patterns"], int(point["seed"]))
    made, kind = measure_image(studio, point, _SHOWN), str(point["patterns"]).partition(":")[0]
    count = frames.family.left.shape[1] * frames.family.right.shape[1]
    arrays = dict(made.arrays)
    if point["patterns"] in _SHOWN and point["model"] == RENDERED:
        arrays[_SPECTRUM] = frames.prepare().left.singular ** 2
    return Found(tuple({**row, "patterns_count": count, "kind": kind} for row in made.rows), arrays)


def _spectra(results: Results) -> Mapping[str, Figure]:
    from mitsim.report.plots import singular_values

    found = ((str(row["patterns"]), results.array(row, _SPECTRUM)) for row in results.rows)
    return {"singular_values.png": singular_values({label(name): each for name, each in found if each is not None})}


PATTERNS = Study(
    "patterns",
    "Which patterns, and how many",
    "What do uniform, random, shifting-dots and Hadamard patterns recover, by their number and exposure?",
    points=Axes(
        {"patterns": FAMILIES, "exposure": (*CONVENTIONS, DIM), "model": MODELS},
        quick={
            "patterns": ("uniform", "random:7", "dots:2", "dots:4", "dots:7", "dots:8", "hadamard:4", "hadamard:8"),
            "exposure": (*CONVENTIONS[:2], DIM),
        },
        kept=lambda values: values["exposure"] != DIM or values["patterns"] in _STATED,
    ),
    measure=_patterns_measure,
    claims=(
        stated("One uniform pattern gives 21 to 23 dB", 21.0, 23.0, patterns="uniform"),
        stated("49 shifting dots give 34 to 35.5 dB", 34.0, 35.5, patterns="dots:7"),
        *(
            Gain(claim, better, other, where={"exposure": CONVENTIONS}, paper="higher")
            for claim, better, other in (
                ("More dots, better images (49 against 4)", "dots:7", "dots:2"),
                ("Orthogonal patterns outperform random ones (49 each)", "dots:7", "random:7"),
                ("Hadamard patterns perform best, for their light (64 each)", "hadamard:8", "dots:8"),
            )
        ),
    ),
    panels=(
        Lines(
            "patterns_count",
            "number of patterns [1]",
            title="PSNR by the number of patterns",
            where={"exposure": CONVENTIONS},
            each="exposure",
            colour="kind",
            shared="uniform",
            names=_KINDS,
        ),
        _spectra,
        Images("patterns", columns=_SHOWN, title=f"exposure {EQUAL_FRAME}", where={"exposure": EQUAL_FRAME}),
    ),
)

# -------- The same time, shared differently

FRAMES = 49
"""As the paper's."""
ONE, MANY, DOTS = SHARED = ("1 uniform", "49 uniform", "49 dots")
_LAW_WITHIN = 0.1
"""Relative difference of law and measurement: one draw of 16384 unknowns scatters by 1 %, dots' noise is not white."""


def _family(studio: Studio, point: Point) -> PatternFamily:
    bench = studio.bench(point.setup)
    if point["patterns"] == DOTS:
        return bench.family("dots:7")
    count = 1 if point["patterns"] == ONE else FRAMES
    return PatternFamily(point["patterns"], np.ones((bench.n, count), np.int8), np.ones((bench.n, 1), np.int8))


def _exposure_measure(studio: Studio, point: Point) -> Found:
    """All frames have the time in which one of uniform light fills the full well as far as it may."""
    frames = studio.frames(point.setup, point["model"], _family(studio, point), int(point["seed"]))
    seconds = frames.seconds(EQUAL_FRAME)
    image, law = Image.of(frames, seconds), {}
    if point["model"] == IDEALISED and point["patterns"] == DOTS:
        # Elsewhere the law's model is not that of the frames, or least squares magnifies rounding beyond any image.
        law = _law(frames, seconds)
    return finding(studio, point, image.image, **image.row(), **law)


def _law(frames: Unexposed, seconds: float) -> dict[str, float]:
    """Signal to error of a least-squares image without regularisation, measured and by the law."""
    truth = frames.lit.truth
    signal, error = (float(np.linalg.norm(each)) for each in (truth, frames.solve(seconds, 0.0).image - truth))
    model = frames.prepare()
    rho = float(np.sqrt(np.square(1 / np.outer(model.left.singular, model.right.singular)).sum()))
    law = signal / (frames.noise(seconds) * rho)
    return {"ser": signal / error, "ser_law": law, "ser_over_law": signal / error / law}


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

RADIANCES = ("1.17", "11.7", "117", "1170", "11700")
"""Of the scene's lamp [W m^-2 sr^-1]: that of lamp_bench lights its sheet a hundredth as the projector does, to a
hundred times."""
AMBIENT_FAMILIES = ("uniform", "dots:8", "hadamard:8")
_SPREAD = (1.0, 99.0)
"""Percentiles that bound a dynamic range: the noise of single pixels is no signal."""


def _ambient_measure(studio: Studio, point: Point) -> Found:
    setup, patterns, seed = point.setup, str(point["patterns"]), int(point["seed"])
    image = studio.image(setup, RENDERED, patterns, seed)
    low, high = _range(studio.frames(setup, RENDERED, patterns, seed))
    ratio = _ratio(studio.frames(setup, RENDERED, "uniform", seed))
    return finding(studio, point, image.image, ratio=ratio, range_low=low, range_high=high, **image.row())


def _ratio(uniform: Unexposed) -> float:
    """Light of the lamp over the projector's in frames of ``uniform`` light, on the whole sensor."""
    (white,) = uniform.expected
    lamp = uniform.expected.projector_off.irradiance.sum()
    return float(lamp / (white.irradiance.sum() - lamp))


def _range(frames: Unexposed) -> tuple[float, float]:
    """Part of the full well that ``frames`` take up without the lamp's light, from dark to bright pixels."""
    exposer = frames.exposer(frames.seconds(EQUAL_PEAK))
    dark = exposer.electrons(frames.expected.projector_off)
    ends = [np.percentile(exposer.electrons(frame) - dark, _SPREAD) for frame in frames.expected]
    low, high = np.mean(ends, axis=0) / frames.lit.bench.sensor.superpixel_full_well_e
    return float(low), float(high)


def _by_lamp(results: Results) -> Results:
    """Return results whose lamp has one ratio for all prints, which differ by a tenth, to two digits.

    The column ``least`` is True for the weakest lamp, ``strong`` for the first one as bright as the projector.
    """
    lamps = {
        lamp: float(f"{choose_rows(results.frame, {'lamp': lamp})['ratio'].mean():.2g}")
        for lamp in distinct(results.frame, "lamp")
    }
    least, most = min(lamps.values()), max(lamps.values())
    strong = min((ratio for ratio in lamps.values() if ratio >= 1), default=most)
    rows = [{**row, "ratio": lamps[row["lamp"]]} for row in results.rows]
    return replace(
        results, rows=[{**row, "least": row["ratio"] == least, "strong": row["ratio"] == strong} for row in rows]
    )


def _better_beyond(rows: DataFrame) -> tuple[str, Holds | str]:
    """Judge whether Hadamard patterns are better from some ratio of the lamp's light on."""
    ratios = sorted(distinct(rows, "ratio"))
    gains = {}
    for ratio in ratios:
        dots, hadamard = (choose_rows(rows, {"ratio": ratio, "patterns": name}) for name in AMBIENT_FAMILIES[1:])
        gains[ratio] = mean_of(hadamard, "psnr_db", dots)
    holds = {ratio: within(gain, low=0) for ratio, gain in gains.items()}
    better = [ratio for ratio in ratios if holds[ratio]]
    beyond = bool(better) and all(holds[ratio] for ratio in ratios if ratio >= better[0])
    where = f"from {better[0]:g} times on" if beyond else "at some ratios alone" if better else "at no ratio"
    text = ", ".join(f"{with_unit(gain, 'dB', '+')} at {ratio:g} times" for ratio, gain in gains.items())
    decided = beyond or "confirmed only at some ratios" if better else None if None in holds.values() else False
    return f"{where}: {text}", decided


_RATIO = "ratio", "lamp's light over the projector's [1]"

AMBIENT = Study(
    "ambient",
    "A lamp beside the projector",
    "How much ambient light does each kind of pattern stand?",
    points=Axes(
        {"patterns": AMBIENT_FAMILIES, "model": (RENDERED,), "exposure": (EQUAL_PEAK,)},
        scene={"lamp": RADIANCES},
        quick={"lamp": RADIANCES[::2]},
        quick_prints=1,
        default="lamp_bench",
    ),
    measure=_ambient_measure,
    derive=_by_lamp,
    claims=(
        Gain(
            "Under strong ambient light dots keep less dynamic range than Hadamard patterns (part of the full well)",
            "hadamard:8",
            "dots:8",
            where={"strong": True},
            every="ratio",
            column="range_high",
            unit="",
            paper="0 to 0.02 against 0.06 to 0.17",
        ),
        Judged("Hadamard patterns are better under strong ambient light", _better_beyond, paper="better"),
        Gain(
            "Dots are preferred when ambient light is not strong: they take half the frames",
            "dots:8",
            "hadamard:8",
            where={"least": True},
            every="ratio",
            paper="preferred",
        ),
    ),
    panels=(
        Lines(*_RATIO, title="PSNR by the lamp's light, exposure equal peak", facet="", log=True),
        Lines(
            *_RATIO,
            file="range",
            title="The projector's light in bright pixels (99th percentile)",
            y="range_high",
            y_label="part of the full well [1]",
            facet="",
            log=True,
        ),
        Images("ratio", title="Images by the lamp's light, exposure equal peak", down=("patterns",), names="{} times"),
    ),
    heads=("Paper", "", "Rendered"),
    note="The lamp's light is its part of a frame of uniform light over the projector's, on the whole sensor. From "
    "every frame a frame with the projector off is taken; its noise stays. PSNR of an even grey is that of no image: "
    "12 to 20 dB, by the print's contrast.",
)


STUDIES = {each.name: each for each in (PATTERNS, EXPOSURE, AMBIENT)}

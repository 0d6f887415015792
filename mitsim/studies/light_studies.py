"""Studies of the paper by the light that is cast: which patterns, how they share the time, and a lamp beside them.

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

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from mitsim.devices.patterns import PatternFamily
from mitsim.report import CONVENTIONS, EQUAL_FRAME, EQUAL_PEAK, IDEALISED, MODELS, RENDERED, in_text, label
from mitsim.report.lit_scene import DIM, Unexposed
from mitsim.report.pages import Mean, Table, Value
from mitsim.report.plots import curves, quality_bars, singular_values
from mitsim.studies.framework import claims
from mitsim.studies.framework.claims import Lines, by_patterns, difference, finding, images, verdict, within
from mitsim.studies.framework.experiment import Claim, Experiment, Found, Point, Results, Scope
from mitsim.studies.framework.studio import Image, Studio

# -------- Which patterns, and how many

FAMILIES = (
    "uniform", "random:2", "random:4", "random:5", "random:7", "random:8", "dots:2", "dots:3", "dots:4", "dots:5",
    "dots:6", "dots:7", "dots:8", "hadamard:2", "hadamard:4", "hadamard:8",
)  # fmt: skip
_FEW = ("uniform", "random:7", "dots:2", "dots:4", "dots:7", "dots:8", "hadamard:4", "hadamard:8")
_KINDS = {"dots": "shifting dots", "hadamard": "repeated Hadamard", "random": "random"}
_STATED = {"uniform": (21.0, 23.0), "dots:7": (34.0, 35.5)}
"""Decibels in the paper's figures 4 to 6, of one uniform pattern and of 49 dots, mask at 2000 um."""
_SHOWN = ("uniform", "random:7", "dots:4", "dots:7", "hadamard:8")
_SPECTRUM = "spectrum"
"""Squares of the left factor's singular values, of the calibrated camera with the family's patterns."""


def _patterns_points(scope: Scope) -> Sequence[Point]:
    return [
        Point.of(scope.setup.with_print(name), model=model, patterns=family, exposure=exposure, seed=seed)
        for name in scope.pictures
        for seed in scope.seeds
        for family in scope.choose(FAMILIES, _FEW)
        for exposure in (*scope.choose(CONVENTIONS, CONVENTIONS[:2]), *((DIM,) if family in _STATED else ()))
        for model in MODELS
    ]


def _patterns_measure(studio: Studio, point: Point) -> Found:
    frames = studio.frames(point.setup, point["model"], point["patterns"], int(point["seed"]))
    made = claims.measure_image(studio, point, _SHOWN)
    count = frames.family.left.shape[1] * frames.family.right.shape[1]
    arrays = dict(made.arrays)
    if point["patterns"] in _SHOWN and point["model"] == RENDERED:
        arrays[_SPECTRUM] = frames.prepare().left.singular ** 2
    return replace(made, rows=tuple({**row, "patterns_count": count} for row in made.rows), arrays=arrays)


def _patterns_claims(results: Results) -> Sequence[Claim]:
    table = results.table
    families = Table(tuple(row for row in table.rows if row["exposure"] != DIM))

    def better(claim: str, family: str, other: str) -> Claim:
        return claims.gain_claim(families, claim, "higher", ({"patterns": family}, {"patterns": other}))

    return [
        claims.psnr_claim(table.where(patterns="uniform"), "One uniform pattern gives 21 to 23 dB", _STATED["uniform"]),
        claims.psnr_claim(table.where(patterns="dots:7"), "49 shifting dots give 34 to 35.5 dB", _STATED["dots:7"]),
        better("More dots, better images (49 against 4)", "dots:7", "dots:2"),
        better("Orthogonal patterns outperform random ones (49 each)", "dots:7", "random:7"),
        better("Hadamard patterns perform best, for their light (64 each)", "hadamard:8", "dots:8"),
    ]


def _patterns_figures(results: Results) -> Mapping[str, Figure]:
    table = results.table

    def lines(rows: Table) -> Lines:
        """By kind; one uniform pattern is the first of each."""
        kinds = {kind: (kind, "uniform") for kind in _KINDS}
        return {
            _KINDS[kind]: Table(tuple(row for row in rows.rows if str(row["patterns"]).partition(":")[0] in of))
            for kind, of in kinds.items()
        }

    known = Table(tuple(row for row in table.rows if row["exposure"] in CONVENTIONS))
    drawn = dict(
        claims.by_exposure(known, lines, "patterns_count", "number of patterns [1]", "PSNR by the number of patterns")
    )
    spectra = {
        label(str(row["patterns"])): found for row in table.rows if (found := results.array(row, _SPECTRUM)) is not None
    }
    drawn["singular_values.png"] = singular_values(spectra)
    shown, names = claims.by_print(table.where(exposure=EQUAL_FRAME)), [label(family) for family in _SHOWN]
    return drawn | claims.images("images.png", results, shown, "patterns", _SHOWN, f"exposure {EQUAL_FRAME}", names)


PATTERNS = Experiment(
    "patterns",
    "Which patterns, and how many",
    "What do uniform, random, shifting-dots and Hadamard patterns recover, by their number and exposure?",
    _patterns_points, _patterns_measure, _patterns_claims, _patterns_figures,
)  # fmt: skip


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


def _exposure_points(scope: Scope) -> Sequence[Point]:
    setups = map(scope.setup.with_print, scope.pictures)
    return Point.grid(setups, "model patterns seed", seed=scope.seeds, patterns=SHARED, model=MODELS)


def _exposure_measure(studio: Studio, point: Point) -> Found:
    """All frames have the time in which one of uniform light fills the full well as far as it may."""
    frames = studio.frames(point.setup, point["model"], _family(studio, point), int(point["seed"]))
    seconds = frames.seconds(EQUAL_FRAME)
    image, law = Image.of(frames, seconds), {}
    if point["model"] == IDEALISED and point["patterns"] == DOTS:
        # Elsewhere the law's model is not that of the frames, or least squares magnifies rounding beyond any image.
        law = _law(frames, seconds)
    return claims.finding(studio, point, image.image, **image.row(), **law)


def _law(frames: Unexposed, seconds: float) -> dict[str, float]:
    """Signal to error of a least-squares image without regularisation, measured and by the law."""
    truth = frames.lit.truth
    signal, error = (float(np.linalg.norm(each)) for each in (truth, frames.solve(seconds, 0.0).image - truth))
    model = frames.prepare()
    rho = float(np.sqrt(np.square(1 / np.outer(model.left.singular, model.right.singular)).sum()))
    return {"ser": signal / error, "ser_law": signal / (frames.noise(seconds) * rho)}


def _exposure_claims(results: Results) -> Sequence[Claim]:
    slightly, table, text = "49 uniform frames are slightly better than one", results.table, "{one} dB, {gain:+} dB"
    ratio = np.divide(table.numbers("ser"), table.numbers("ser_law")).tolist()
    one, many, dots = ({"patterns": name} for name in SHARED)
    return [
        claims.gain_claim(table, "49 dots beat 49 uniform frames of the same time", "higher", (dots, many), text),
        claims.gain_claim(table, slightly, "slightly higher", (many, one), text),
        Claim(
            "Without regularisation, ||x|| / ||x - x'|| is SNR / rho (49 dots)", "equal",
            f"measured / law {min(ratio):.3f} to {max(ratio):.3f}", "not defined: factors are calibrated",
            claims.verdict(claims.within(Mean.of_numbers(ratio, "ser"), 1 - _LAW_WITHIN, 1 + _LAW_WITHIN)),
        ),
    ]  # fmt: skip


def _exposure_figures(results: Results) -> Mapping[str, Figure]:
    table, title = results.table, f"exposure {EQUAL_FRAME}"
    lines = {name: table.where(patterns=name) for name in SHARED}
    psnr = {"psnr.png": quality_bars(claims.bars(lines), title)}
    return psnr | claims.images("images.png", results, claims.by_print(table), "patterns", SHARED, title)


EXPOSURE = Experiment(
    "exposure",
    "The same time, shared differently",
    "Do many dots beat as many uniform frames that take as long?",
    _exposure_points, _exposure_measure, _exposure_claims, _exposure_figures,
)  # fmt: skip


# -------- A lamp beside the projector

RADIANCES = (1.17, 11.7, 117.0, 1170.0, 11700.0)
"""Of the scene's lamp [W m^-2 sr^-1]: that of lamp_bench lights its sheet a hundredth as the projector does, to a
hundred times."""
AMBIENT_FAMILIES = ("uniform", "dots:8", "hadamard:8")
_SPREAD = (1.0, 99.0)
"""Percentiles that a dynamic range lies between: single pixels' noise is no signal."""


def _ambient_points(scope: Scope) -> Sequence[Point]:
    own = scope.pictures == (None,)
    setup = scope.setup if own else replace(scope.setup, scene="lamp_bench")
    setups = [
        setup.with_print(name).with_parameters(lamp=f"{radiance:g}")
        for name in scope.choose(scope.pictures, scope.pictures[:1])
        for radiance in scope.choose(RADIANCES, RADIANCES[::2])
    ]
    fixed = {"model": (RENDERED,), "exposure": (EQUAL_PEAK,)}
    return Point.grid(setups, "model patterns exposure seed", seed=scope.seeds, patterns=AMBIENT_FAMILIES, **fixed)


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


def _by_lamp(table: Table) -> Table:
    """Rows with the lamp's ratio a mean over prints, which differ by a tenth, to two digits."""
    ratios = {lamp: float(f"{table.mean('ratio', lamp=lamp).value:.2g}") for lamp in table.distinct("lamp")}
    return Table(tuple({**row, "ratio": ratios[row["lamp"]]} for row in table.rows))


def _range(frames: Unexposed) -> tuple[float, float]:
    """Part of the full well that ``frames`` take up without the lamp's light, from dark to bright pixels."""
    exposer = frames.exposer(frames.seconds(EQUAL_PEAK))
    dark = exposer.electrons(frames.expected.projector_off)
    ends = [np.percentile(exposer.electrons(frame) - dark, _SPREAD) for frame in frames.expected]
    low, high = np.mean(ends, axis=0) / frames.lit.bench.sensor.superpixel_full_well_e
    return float(low), float(high)


def _ambient_claims(results: Results) -> Sequence[Claim]:
    table = _by_lamp(results.table)
    ratios = table.distinct("ratio")
    least, most = ratios[0], ratios[-1]
    strong = next((ratio for ratio in ratios if ratio >= 1), most)

    def psnr_text(family: str, ratio: float) -> str:
        return f"{in_text(family)} {table.mean('psnr_db', patterns=family, ratio=ratio)} dB"

    def spread(family: str) -> str:
        rows = table.where(patterns=family, ratio=strong)
        low, high = (rows.mean(name).value for name in ("range_low", "range_high"))
        return f"{in_text(family)} {low:.3f} to {high:.3f}"

    def more(ratio: float, column: str) -> Mean:
        hadamard, dots = (table.where(patterns=name, ratio=ratio) for name in ("hadamard:8", "dots:8"))
        return difference(hadamard, dots, column)

    gains = {ratio: more(ratio, "psnr_db") for ratio in ratios}
    holds = {ratio: within(gain, low=0) for ratio, gain in gains.items()}
    better = [ratio for ratio, each in holds.items() if each]
    beyond = better == [ratio for ratio in ratios if better and ratio >= better[0]]
    where = f"from {better[0]:g} times on" if better else "at no ratio"
    return [
        Claim(
            "Under strong ambient light dots keep less dynamic range than Hadamard patterns (part of the full well)",
            "0 to 0.02 against 0.06 to 0.17", "",
            f"lamp {strong:g} times: {spread('dots:8')}, {spread('hadamard:8')}",
            verdict(within(more(strong, "range_high"), low=0)),
        ),
        Claim(
            "Hadamard patterns are better under strong ambient light", "better", "",
            f"{where}; lamp {strong:g} times: {psnr_text('dots:8', strong)}, {psnr_text('hadamard:8', strong)}; "
            f"lamp {most:g} times: {psnr_text('dots:8', most)}, {psnr_text('hadamard:8', most)}",
            "confirmed only at some ratios" if better and not beyond else
            verdict(True if better else None if None in holds.values() else False),
        ),
        Claim(
            "Dots are preferred when ambient light is not strong: they take half the frames", "preferred",
            "", f"lamp {least:g} times: {psnr_text('dots:8', least)}, {psnr_text('hadamard:8', least)}",
            verdict(within(gains[least], high=0)),
        ),
    ]  # fmt: skip


def _ambient_figures(results: Results) -> Mapping[str, Figure]:
    table = _by_lamp(results.table)
    axis, lines = "lamp's light over the projector's [1]", by_patterns(table)

    def panel(title: str, column: str, y_axis: str) -> Figure:
        shown = {name: rows.means(column, "ratio") for name, rows in lines.items()}
        return curves({"": shown}, axis, y_axis, log=True, title=title)

    drawn = {
        "psnr.png": panel("PSNR by the lamp's light, exposure equal peak", "psnr_db", "PSNR [dB]"),
        "range.png": panel(
            "The projector's light in bright pixels (99th percentile)", "range_high", "part of the full well [1]"
        ),
    }
    ratios: list[Value] = table.distinct("ratio")
    names, title = [f"lamp {ratio:g} times" for ratio in ratios], "Images by the lamp's light, exposure equal peak"
    return drawn | images("images.png", results, lines, "ratio", ratios, title, names)


AMBIENT = Experiment(
    "ambient",
    "A lamp beside the projector",
    "How much ambient light does each kind of pattern stand?",
    _ambient_points, _ambient_measure, _ambient_claims, _ambient_figures,
    heads=("Paper", "", "Rendered"),
    note="The lamp's light is its part of a frame of uniform light over the projector's, on the whole sensor. From "
    "every frame a frame with the projector off is taken; its noise stays. PSNR of an even grey is that of no image: "
    "12 to 20 dB, by the print's contrast.",
)  # fmt: skip


EXPERIMENTS = {each.name: each for each in (PATTERNS, EXPOSURE, AMBIENT)}

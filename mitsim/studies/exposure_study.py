"""One uniform frame, 49 uniform frames, and 49 dots in the same time; and the law of the paper's noise analysis.

Paper, section V-B, figure 9, and the error analysis of its supplement: of a least-squares image x' of a scene x,
||x|| / ||x - x'|| = ||x|| / (s rho), rho^2 = Tr (A^T A)^-1 = sum 1 / s_i^2 over the singular values of the model A of
all frames, s being the noise of a datum. (The paper writes it as SER = sqrt(T) SNR / rho, of T equal frames.)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from mitsim.devices.patterns import PatternFamily
from mitsim.report import EQUAL_FRAME, IDEALISED, MODELS
from mitsim.report.lit_scene import Unexposed
from mitsim.report.pages import Mean
from mitsim.report.plots import quality_bars
from mitsim.studies.framework import claims
from mitsim.studies.framework.experiment import Claim, Experiment, Found, Results, Scope
from mitsim.studies.framework.setup import Point
from mitsim.studies.framework.studio import Image, Studio

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


def _points(scope: Scope) -> Sequence[Point]:
    setups = map(scope.setup.printed, scope.pictures)
    return Point.grid(setups, "model patterns seed", seed=scope.seeds, patterns=SHARED, model=MODELS)


def _measure(studio: Studio, point: Point) -> Found:
    """All frames have the time in which one of uniform light fills the full well as far as it may."""
    frames = studio.frames(point.setup, point["model"], _family(studio, point), int(point["seed"]))
    seconds = frames.seconds(EQUAL_FRAME)
    image, law = Image.of(frames, seconds), {}
    if point["model"] == IDEALISED and point["patterns"] == DOTS:
        # Elsewhere the law's model is not that of the frames, or least squares magnifies rounding beyond any image.
        law = _law(frames, seconds)
    return claims.finding(point, image.image, **image.row(), **law)


def _law(frames: Unexposed, seconds: float) -> dict[str, float]:
    """Signal to error of a least-squares image without regularisation, measured and by the law."""
    truth = frames.lit.truth
    signal, error = (float(np.linalg.norm(each)) for each in (truth, frames.solve(seconds, 0.0).image - truth))
    model = frames.prepared()
    rho = float(np.sqrt(np.square(1 / np.outer(model.left.singular, model.right.singular)).sum()))
    return {"ser": signal / error, "ser_law": signal / (frames.noise(seconds) * rho)}


def _claims(results: Results) -> Sequence[Claim]:
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


def _figures(results: Results) -> Mapping[str, Figure]:
    table, title = results.table, f"exposure {EQUAL_FRAME}"
    lines = {name: table.where(patterns=name) for name in SHARED}
    psnr = {"psnr.png": quality_bars(claims.bars(lines), title)}
    return psnr | claims.images("images.png", results, claims.by_print(table), "patterns", SHARED, title)


EXPERIMENT = Experiment(
    "exposure",
    "The same time, shared differently",
    "Do many dots beat as many uniform frames that take as long?",
    _points, _measure, _claims, _figures,
)  # fmt: skip

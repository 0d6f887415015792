"""Direct from global light by the dots themselves: what it gains over images that take all light for direct.

Nayar, Krishnan, Grossberg and Raskar (2006) need a camera with a lens; here :mod:`mitsim.reconstruct.convolution` does
it, in scenes whose light over several surfaces is known. Depth hides most of it, so every scene is shown twice: as it
is, and with direct light as the calibrated factors have it at any depth, as if depth were mended.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from scipy.interpolate import RegularGridInterpolator

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import Shot
from mitsim.light.light import SampledLight
from mitsim.metrics import psnr
from mitsim.reconstruct.focus import FactorOfDepths, parallax_of
from mitsim.reconstruct.separation import separate
from mitsim.reconstruct.solver import Accumulator, Prepared
from mitsim.report import EQUAL_PEAK, RENDERED
from mitsim.report.lit_scene import LitScene, Unexposed
from mitsim.report.plots import image_grid
from mitsim.studies.framework.claims import every, sample_mean, single_precision, verdict, within
from mitsim.studies.framework.experiment import Claim, Experiment, Found, Point, Results, Scope
from mitsim.studies.framework.studio import Studio
from mitsim.studies.reflectivity_study import direct_of

SCENES = ("corner", "cookie_bag")
FAMILIES = ("dots:4", "dots:7", "dots:10")
AS_IT_IS, MENDED = DEPTHS = ("as it is", "depth mended")
_DEPTHS = {AS_IT_IS: "as they are", MENDED: "with depth mended"}
ALL, SEPARATED, ALONE, GLOBAL = IMAGES = ("all light", "separated", "direct alone", "global")
"""Images of all light taken for direct, of what is left once global light is told apart, of direct light without any
other, and of global light."""
_ACCURACY = 3e-3
"""Of the light: global light is a tenth of it and more."""
_MARGIN = 2
"""Periods of the dots beyond the window that light comes from: in the corner four give no more."""
Measured = list[tuple[Shot, FloatArray]]
"""Frames [electrons/s] with their shots."""


def _points(scope: Scope) -> Sequence[Point]:
    base = replace(scope.setup, accuracy=max(scope.setup.accuracy, _ACCURACY))
    own = scope.pictures == (None,)
    setups = [base] if own else [replace(base, scene=name) for name in scope.chosen(SCENES, SCENES[:1])]
    return [
        Point.of(setup, subject=setup.scene, patterns=family, seed=seed)
        for setup in setups
        for seed in scope.repeats
        for family in scope.chosen(FAMILIES, FAMILIES[1:2])
    ]


def _measure(studio: Studio, point: Point) -> Found:
    frames = studio.frames(point.setup, RENDERED, str(point["patterns"]), int(point["seed"]))
    lit = frames.lit
    if not lit.light.simulation.physics.interreflection:
        raise MitsimError(f"study separation: light over several surfaces is not worth following in {point['subject']}")
    parallax = parallax_of(studio.factors(point.setup, int(point["seed"])))
    margin = _MARGIN * max(frames.family.left.shape[1], frames.family.right.shape[1])
    left, right = (FactorOfDepths(factor, parallax, axis).beyond(margin)[0] for axis, factor in enumerate(frames.sides))
    electrons = frames.exposer(1.0).electrons
    direct = [electrons(frame) for frame in LitScene(direct_of(lit.light)).expected(RENDERED, frames.family)]
    bounced = [electrons(frame) - own for frame, own in zip(frames.expected, direct, strict=True)]
    known = global_truth(lit.light)
    rows, arrays = [], {"direct, true": lit.truth, "global, true": known}
    for depth in DEPTHS:
        own = direct if depth == AS_IT_IS else [_direct_by_factors(frames, shot) for shot in frames.family.shots]
        images, reported = _images(frames, own, bounced, (left, right))
        levels = {f"{name}_db": psnr(image, known if name == GLOBAL else lit.truth) for name, image in images.items()}
        gain = levels[f"{SEPARATED}_db"] - levels[f"{ALL}_db"]
        rows.append(point.row(depth=depth, gain_db=gain, told=reported, **levels))
        arrays |= {f"{depth} {name}": image for name, image in images.items()}
    return Found(tuple(rows), single_precision(arrays))


def _images(
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
    model = frames.prepared()
    measured = _noisy(frames, [own + more for own, more in zip(direct, bounced, strict=True)])
    whole = _weights(model, measured)
    patterns = frames.family.left.astype(float), frames.family.right.astype(float)
    total = np.sum([frame for _, frame in measured], axis=0)
    found = separate(model, seen, patterns, whole.sum, total)
    less = _weights(model, [(shot, frame - found.common) for shot, frame in measured])
    solved = {ALL: whole, SEPARATED: less, ALONE: _weights(model, _noisy(frames, direct))}
    images = {name: model.solve(sums).image for name, sums in solved.items()}
    return {**images, GLOBAL: found.image}, float(found.told[0])


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


def _claims(results: Results) -> Sequence[Claim]:
    table = results.table

    def claim(depth: str) -> Claim:
        rows = table.where(depth=depth)
        gains = {
            name: sample_mean(rows.where(subject=name, patterns="dots:7"), "gain_db")
            for name in table.distinct("subject")
        }
        reported = ", ".join(f"{name.replace('_', ' ')} {gain} dB" for name, gain in gains.items())
        gained = every(*(within(gain, low=0) for gain in gains.values()))
        text = f"49 dots tell global light apart in scenes {_DEPTHS[depth]}, and the image gains (Nayar et al. 2006)"
        return Claim(text, "", "", reported, verdict(gained))

    return [claim(depth) for depth in table.distinct("depth")]


def _figures(results: Results) -> Mapping[str, Figure]:
    drawn = {}
    table = results.table.where(patterns="dots:7")
    for depth in table.distinct("depth"):
        grid = {}
        for row in table.where(depth=depth).rows:
            truths = [(results.array(row, name), None) for name in ("direct, true", "global, true")]
            images = [(results.array(row, f"{depth} {name}"), row[f"{name}_db"]) for name in IMAGES]
            shown = [truths[0], *images[:-1], truths[1], images[-1]]
            grid[str(row["subject"]).replace("_", " ")] = [
                (image, "" if level is None else f"{level:.1f} dB") for image, level in shown if image is not None
            ]
        drawn[f"images_{depth.replace(' ', '_')}.png"] = image_grid(
            grid, ["direct, true", *IMAGES[:-1], "global, true", GLOBAL], f"Scenes {_DEPTHS[depth]}, 49 dots"
        )
    return drawn


EXPERIMENT = Experiment(
    "separation",
    "Direct and global light",
    "What do dots tell of light that came over several surfaces, and what does the image gain?",
    _points, _measure, _claims, _figures,
    about="Global light came over several surfaces, direct light over one. Images of frames under dots, exposed at "
    "equal peak: of all light taken for direct; of what is left once global light is told apart (Nayar et al. 2006, "
    "without a lens); of direct light alone, as if there were no other, which is the best that telling apart can do; "
    "and the global light itself. Twice: of scenes as they are, whose depth the solver does not know, and with "
    "direct light as the calibration has it at any depth. PSNR below each, against the true direct or global light.",
    heads=("", "", "Gain in PSNR"),
)  # fmt: skip

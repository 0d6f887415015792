"""Learned methods, judged by rendered frames: what each gains over the best classical image, by what it was trained on
and what it is tested on.

Paper, section "Deep Network-based Denoising vs Reconstruction": on simulated frames learned methods look best; on real
ones FlatNet fails under uniform light, a U-Net removes artefacts and resolves no more; under coded light all do well;
"catastrophic results in case of any mismatch". It shows pictures. Here frames are rendered where the paper's are real.

It takes torch, and hours. So it is no part of `mitsim study all`. Pairs, networks and frames are kept in the folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas
from mitsim.learn.requests import PREPROCESSED
from mitsim.learn.verbs import check_torch
from mitsim.report import RENDERED
from mitsim.report.pages import Value
from mitsim.studies.framework.experiment import QUICK_IMAGES, Found, Point, Scope
from mitsim.studies.framework.legacy import Experiment
from mitsim.studies.framework.studio import Studio, single_precision
from mitsim.studies.learned_bench import DEPTH, PLACES, Shown
from mitsim.studies.learned_cells import FULL, PICTURES, QUICK, Budget, Cell, School, cells
from mitsim.studies.learned_claims import find_claims
from mitsim.studies.learned_page import TRUTH, figures, tables
from mitsim.studies.learned_scores import classical_rows, network_row

FAMILIES = ("uniform", "dots:4", "dots:7")
BARS = ("bars 0.12", "bars 0.16", "bars 0.24")
"""0.225, 0.3 and 0.45 cycles a pixel: under uniform light least squares leaves nine tenths, two thirds and half of the
contrast that they have."""
TRAININGS = 3
"""Trainings of a cell, from other first weights and orders of the pairs: their spread has a standard error."""


def _points(scope: Scope) -> Sequence[Point]:
    """Classical images of every print at every place, which keep its frames; then all networks."""
    check_torch()
    if scope.pictures == (None,):
        raise MitsimError("study learned: has a bench of its own, the middle of the photograph; leave the scene out")
    families, budget = scope.choose(FAMILIES, FAMILIES[:1]), QUICK if scope.quick else FULL
    seed, places = scope.seeds[0], scope.choose(tuple(PLACES), (RENDERED, DEPTH))
    bars = scope.choose(BARS, BARS[1:2])
    prints = [(place, name) for place in places for name in _prints(scope.pictures, bars, place)]
    shown = [
        Point.of(scope.setup.with_print(name), place=place, families=" ".join(families), seed=seed)
        for place, name in prints
    ]
    seeds = scope.choose(tuple(seed + more for more in range(TRAININGS)), (seed,))
    networks = [
        Point.of(
            scope.setup, **vars(cell), families=" ".join(families), places=" ".join(places),
            prints=",".join(str(name) for name in scope.pictures), bars=",".join(bars), noise=seed, **vars(budget),
        )
        for cell in cells(seeds, families, scope.quick)
    ]  # fmt: skip
    return [*shown, *networks]


def _prints(pictures: Sequence[str | None], bars: Sequence[str], place: str) -> tuple[str, ...]:
    """Prints at a ``place``: ``bars`` stand where nothing is amiss, ``pictures`` everywhere."""
    return (*map(str, pictures), *(bars if place == RENDERED else ()))


@single_threaded_blas()
def _measure(studio: Studio, point: Point) -> Found:
    import torch

    torch.set_num_threads(1)  # processes share the processors, and a training ends with the same bits at one number
    values = dict(point.values)
    return _classical(studio, point, values) if "place" in values else _networks(studio, point, values)


def _classical(studio: Studio, point: Point, values: dict[str, Any]) -> Found:
    picture = str(point.setup.picture)
    shown = Shown(point.setup, values["place"], tuple(values["families"].split()), values["seed"])
    rows: list[dict[str, Value]] = []
    arrays = {}
    for (condition, family), case in shown.cases(studio).items():
        named = {"picture": picture, "condition": condition, "patterns": family, "seed": values["seed"]}
        for row, image in classical_rows(case, picture):
            rows.append({**named, **row})
            if picture in QUICK_IMAGES:
                arrays[f"{condition} {family} {row['method']} {row['weight']}"] = image
        if picture in QUICK_IMAGES:
            arrays[f"{condition} {family} {TRUTH}"] = case.truth
    return Found(tuple(rows), single_precision(arrays))


def _networks(studio: Studio, point: Point, values: dict[str, Any]) -> Found:
    cell = Cell(*(values[name] for name in ("training", "patterns", "method", "seed")))
    families, noise = tuple(values["families"].split()), int(values["noise"])
    budget = Budget(*(int(values[name]) for name in ("pairs", "steps", "groups")))
    school = School(studio, point.setup, noise, budget)
    model, seconds = school.network(cell)
    named = {**vars(cell), "train_s": seconds}
    rows: list[dict[str, Value]] = []
    arrays = {}
    pictures, bars = (tuple(values[name].split(",")) for name in ("prints", "bars"))
    for place in values["places"].split():
        for name in _prints(pictures, bars, place):
            shown = Shown(point.setup.with_print(name), place, families, noise)
            for (condition, family), case in shown.cases(studio).items():
                if family != cell.patterns:
                    continue
                factors = school.factors_for(case)
                own = replace(model, sides=factors.sides) if cell.training == PICTURES else model
                row, image = network_row(own, factors, case, name)
                rows.append({**named, "picture": name, "condition": condition, **row})
                if name in QUICK_IMAGES and cell.seed == noise:
                    arrays[f"{condition} {name}"] = image
    return Found(tuple(rows), single_precision(arrays))


EXPERIMENT = Experiment(
    "learned",
    "Learned methods",
    "What do networks gain over the best classical image, and what do they lose on another bench than they learned?",
    _points, _measure, find_claims, figures, tables=tables, kept=True,
    note="The bench is the middle of the photograph: its camera, 64 x 64 projector pixels. Trained: on pairs of the "
    f"idealised model; rendered; rendered on {FULL.groups} varied benches (sheet 5 mm either way, mask 4 um either "
    "way, a tenth of the light to all of it); elsewhere: on a camera whose mask is at 1 mm, not 2; pictures: by "
    f"pictures alone. Each of {FULL.pairs} pairs, in {FULL.steps} steps ({QUICK.pairs} and "
    f"{QUICK.steps} of a first look). Tested: depth 5 mm behind the calibrated "
    "distance; drift of the mask by 4 um; dim, a tenth of the light; gloss, the coat of the gift card; ambient, a lamp "
    "of a tenth of the light, taken off. The best classical image is, print by print, that of the highest PSNR among "
    "Tikhonov, Markov, total variation and nonnegative at their best weights, which takes the truth to choose: no user "
    f"has it. {PREPROCESSED.capitalize()} networks read frames, so they are trained under uniform light alone. "
    "Exposure equal peak.",
)  # fmt: skip

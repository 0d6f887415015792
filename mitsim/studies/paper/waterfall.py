"""From the paper's idealised model of a scene to its rendered frames, one effect at a time: what each costs [dB].

Each effect three ways: *alone*, added to the idealised model; *in order*, added to it after all effects before it, so
that the steps add up to the whole; *left out* of the whole. What is on and off is stated in
:mod:`mitsim.studies.accuracy.partial_light` and :mod:`mitsim.studies.drift.levels`. The paper has no such figure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from mitsim.core.arrays import FloatArray
from mitsim.metrics import psnr
from mitsim.report.charts import Fall, Step, image_grid, waterfall
from mitsim.report.table import Table
from mitsim.studies.accuracy.partial_light import Anatomy
from mitsim.studies.drift.levels import ASSUMED, CALIBRATED, EFFECTS, MODELS, Levels, Sessions
from mitsim.studies.framework.experiment import Claim, Experiment, Found, Results, Scope
from mitsim.studies.framework.pictures import QUICK_IMAGES
from mitsim.studies.framework.setup import Point
from mitsim.studies.framework.studio import Studio
from mitsim.studies.framework.verdicts import difference, verdict, within
from mitsim.studies.paper.measure import TOLERANCE_DB, single

PATTERNS = "dots:7"
ALONE, IN_ORDER, LEFT_OUT = WAYS = ("alone", "in order", "left out")
_FACTORS = {ASSUMED: "the idealised camera", CALIBRATED: "a session with the same effects"}
_SEEN_DB = 0.2
"""Change from which an effect is drawn: three deviations of what another draw of noise makes of two images' difference
(1 % of the squared error of 16384 pixels each, 0.05 dB)."""
_KEPT = 64
"""Levels of a scene that are kept: of 17 effects three ways, and the two ends."""


def _points(scope: Scope) -> Sequence[Point]:
    pictures = [name for name in scope.pictures if name in (*QUICK_IMAGES, None)] or list(scope.pictures)
    return [
        Point.of(scope.setup.printed(name), patterns=PATTERNS, seed=seed, way=way, effect=effect)
        for name in scope.chosen(pictures, pictures[:1])
        for seed in scope.repeats
        for way in scope.chosen(WAYS, WAYS[:2])
        for effect in EFFECTS
    ]


def _measure(studio: Studio, point: Point) -> Found:
    """What the effect changes, and the level that it comes to: without it, for one that is left out."""
    setup, seed, way, effect = point.setup, int(point["seed"]), point["way"], str(point["effect"])
    lit = studio.lit(setup)
    anatomy = studio.once("anatomy", 1, setup, lambda: Anatomy.of(lit.light))
    sessions = studio.once("sessions", 1, (setup, seed), lambda: Sessions(lit.bench, seed))
    levels = studio.once(
        "levels", 1, (setup, seed), lambda: Levels(lit, anatomy, sessions, str(point["patterns"]), seed)
    )

    def images(on: frozenset[str]) -> Mapping[str, FloatArray]:
        own = on & frozenset(levels.effects)
        return studio.once("images", _KEPT, (setup, seed, own), lambda: levels.images(own))

    without, having = (images(on) for on in ends(way, effect))
    rows = [
        point.row(
            model=model,
            called_for=effect in levels.effects,
            without_db=(before := psnr(without[model], lit.truth)),
            with_db=(after := psnr(having[model], lit.truth)),
            change_db=after - before,
        )
        for model in MODELS
    ]
    return Found(tuple(rows), _kept(way, effect, without, having))


def _kept(
    way: str, effect: str, without: Mapping[str, FloatArray], having: Mapping[str, FloatArray]
) -> dict[str, FloatArray]:
    """Images of the two ends, by model, as findings keep them."""
    ends_of = {EFFECTS[0]: without, EFFECTS[-1]: having} if way == IN_ORDER else {}
    return single(ends_of.get(effect, {}))


def ends(way: str, effect: str) -> tuple[frozenset[str], frozenset[str]]:
    """Effects that are on without an ``effect`` and with it, one ``way``."""
    if way == ALONE:
        return frozenset(), frozenset({effect})
    if way == LEFT_OUT:
        return frozenset(EFFECTS) - {effect}, frozenset(EFFECTS)
    place = EFFECTS.index(effect)
    return frozenset(EFFECTS[:place]), frozenset(EFFECTS[: place + 1])


def fall(table: Table, model: str) -> Fall:
    """Levels and changes in one ``model`` of a ``table``, means over prints and seeds."""
    rows = table.where(model=model)
    found = [
        Step(
            effect,
            **{
                way.replace(" ", "_"): rows.mean("change_db", way=way, effect=effect)
                for way in WAYS
                if way in rows.distinct("way")
            },
        )
        for effect in EFFECTS
    ]
    first = rows.mean("without_db", way=IN_ORDER, effect=EFFECTS[0])
    return Fall(first, tuple(found), rows.mean("with_db", way=IN_ORDER, effect=EFFECTS[-1]))


def _claims(results: Results) -> Sequence[Claim]:
    assumed, calibrated = (fall(results.table, model) for model in MODELS)
    dearest = min(calibrated.steps, key=lambda step: step.in_order.value)
    ends = {model: results.table.where(model=model, way=IN_ORDER) for model in MODELS}
    last = {model: rows.where(effect=EFFECTS[-1]) for model, rows in ends.items()}
    lost = difference(ends[CALIBRATED].where(effect=EFFECTS[0]), last[CALIBRATED], "without_db", "with_db")
    gained = difference(last[CALIBRATED], last[ASSUMED], "with_db")
    return [
        Claim(
            "A calibrated camera keeps what the idealised model promises (2 dB lost at most)", "",
            f"{calibrated.first} dB", f"{calibrated.last} dB; largest step: {dearest.name}, {dearest.in_order} dB",
            verdict(within(lost, high=TOLERANCE_DB)),
        ),
        Claim(
            "A calibrated model is better than the idealised one", "", f"{assumed.last} dB assumed",
            f"{calibrated.last} dB calibrated", verdict(within(gained, low=0)),
        ),
    ]  # fmt: skip


def _figures(results: Results) -> Mapping[str, Figure]:
    panels = {f"model {model}: factors of {_FACTORS[model]}": fall(results.table, model) for model in MODELS}
    drawn = {"waterfall.png": waterfall(panels, seen=_SEEN_DB)}
    if images := _images(results):
        drawn["images.png"] = image_grid(images, ["idealised", "model assumed", "model calibrated"])
    return drawn


def _images(results: Results) -> dict[str, list[tuple[FloatArray, str]]]:
    """The idealised image and both rendered ones of each print, of the first seed."""
    grid = {}
    table = results.table.where(way=IN_ORDER)
    rendered = [(EFFECTS[-1], model, "with_db") for model in MODELS]
    columns = [(EFFECTS[0], CALIBRATED, "without_db"), *rendered]
    for name in (*table.distinct("picture"), None):
        cells = []
        for effect, model, column in columns:
            rows = table.where(picture=name, effect=effect, model=model).rows[:1]
            kept = ((results.array(row, model), f"{row[column]:.1f} dB") for row in rows)
            cells += [(image, caption) for image, caption in kept if image is not None]
        if len(cells) == len(columns):
            grid[str(name or "scene")] = cells
    return grid


EXPERIMENT = Experiment(
    "waterfall",
    "From the idealised model to rendered frames",
    "What does each physical effect cost in decibels: alone, in order, and left out of the whole?",
    _points, _measure, _claims, _figures,
    about="An image of 49 dots, exposed at equal peak, from the idealised model (even light on a plane, the mask's "
    "geometric shadow, factors known) to rendered frames, one physical effect after the other. Model assumed: the "
    "solver keeps the idealised camera's factors. Model calibrated: it has factors of a session with the same "
    "effects.",
    heads=("", "Before", "After"),
)  # fmt: skip

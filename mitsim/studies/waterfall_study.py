"""From the paper's idealised model of a scene to its rendered frames, one effect at a time: the cost of each in dB.

The ladder begins with the paper's idealised model: an evenly lit sheet at the aligned distance that shows the truth,
under the geometric shadow of the mask. *Falloff* gives each projector pixel its traced brightness, which falls off
towards the edges, and *diffraction* acts on the mask's shadow. *Scene* replaces the sheet by the traced light, with
depth, gloss, edges, and detail inside projector pixels. The other effects are those of
:data:`mitsim.bench.effects.EFFECTS` that the plan simulates. The sensor and its noise are the same on all steps. The
exposure is that of equal peak.

Images are made with the *model assumed*, the exact factors of the idealised camera. The last image is made again with
the *model calibrated*, the factors of a session (:mod:`mitsim.studies.calibration_study` shares out what this image
still loses).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from mitsim.acquire.capture import expose
from mitsim.bench import effects
from mitsim.core.manifests import CalibrationManifest
from mitsim.light.light import SampledLight, traced_again
from mitsim.light.passes import Simulation
from mitsim.light.settings import Settings
from mitsim.metrics import psnr
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import Reconstruction, reconstruct
from mitsim.reconstruct.solver import Status, Verdict
from mitsim.report import RENDERED
from mitsim.report.lit_scene import IdealCamera
from mitsim.studies.framework.claims import TOLERANCE_DB, Gain
from mitsim.studies.framework.experiment import QUICK_IMAGES, TRUTH, Found, Point, Scope, Study
from mitsim.studies.framework.panels import Bars, Images
from mitsim.studies.framework.studio import Studio, flags_of, single_precision
from mitsim.transport.records import DIRECT, PathSamples

FALLOFF, DIFFRACTION, SCENE = "falloff", "diffraction", "scene"
_OF_CAMERA = {"mask-thickness", "pixel-response"}
"""Effects that the idealised camera has as well."""
EFFECTS = (FALLOFF, DIFFRACTION, SCENE, *(name for name in effects.EFFECTS if name not in {DIFFRACTION, *_OF_CAMERA}))
"""Effects in the order in which they are added."""


class Ablation:
    """Light of a scene without some of its ``effects``, the truth unchanged; falloff is removed with the scene only."""

    def __init__(self, light: SampledLight) -> None:
        self.light = replace(light, known_truth=light.apparent)
        simulated = {FALLOFF, SCENE, *(light.simulation.settings.effects & {*effects.present(light.bench)})}
        self.effects = tuple(name for name in EFFECTS if name in simulated)
        self.without = cache(self._without)

    def _without(self, off: frozenset[str]) -> SampledLight:
        light, bench, settings = self.light, self.light.bench, self.light.simulation.settings
        kept = settings.effects - off
        if SCENE not in off:
            simulation = Simulation(bench, replace(settings, effects=kept))
            absent = settings.effects & off - {DIFFRACTION, "black-level", "speckle"}  # of which no light is traced
            return traced_again(light, simulation) if absent else replace(light, simulation=simulation)
        unlit = effects.names(lambda effect: effect.followed) | {"glare"}
        even = Simulation(bench, Settings(bench.geometry.scene_distance, effects=kept - unlit))
        rows, columns = (np.linspace(*edges, 2 * bench.n + 1)[1::2] for edges in bench.windows)
        row, column = (places.ravel() for places in np.meshgrid(rows, columns, indexing="ij"))
        truth, flux = light.apparent, light.flux / light.simulation.physics.projector.share
        if FALLOFF in off:
            flux = truth.reflectance.ravel() * truth.board_flux.mean()
        pixel, depth = np.arange(bench.n**2), np.full(bench.n**2, 1 / bench.geometry.scene_distance)
        anchor, kind = np.zeros_like(pixel), np.full(bench.n**2, DIRECT, dtype=np.int16)
        points = PathSamples(pixel, anchor, anchor, row, column, depth, flux, kind)
        group = even.accumulate("direct", points, light.labels, 1)
        return replace(light, groups=(group,) * len(light.groups), simulation=even)


def assumed_image(light: SampledLight, patterns: str, seed: int) -> Reconstruction:
    """Return the image of light, exposed at equal peak, by the exact factors of the idealised camera."""
    bench, shots = light.bench, expose(light, patterns, seed=seed)
    sides = IdealCamera(bench, bench.geometry.mask).calibrated(float(light.apparent.board_flux.mean()))
    manifest = CalibrationManifest(camera=shots.manifest.camera, centre=bench.geometry.centred, parallax=bench.parallax)
    return reconstruct(shots, Factors(*sides, manifest, Status(Verdict.CALIBRATED, "Factors of the idealised camera")))


# -------- The study

_IMAGES = 16
_IDEAL, _ASSUMED, _CALIBRATED = "idealised", "assumed", "calibrated"
_LAST = {"effect": EFFECTS[-1]}


def _points(scope: Scope) -> Sequence[Point]:
    pictures = [name for name in scope.pictures if name in (*QUICK_IMAGES, None)] or list(scope.pictures)
    return [
        Point.of(replace(scope.setup, picture=name), patterns="dots:7", seed=seed, effect=effect)
        for name in scope.choose(pictures, pictures[:1])
        for seed in scope.repeats
        for effect in EFFECTS
    ]


def _measure(studio: Studio, point: Point) -> Found:
    setup, seed, patterns, effect = point.setup, int(point["seed"]), str(point["patterns"]), str(point["effect"])
    lit, step = studio.lit_scene(setup), EFFECTS.index(effect)
    ablation = studio.once("ablation", 1, setup, lambda: Ablation(lit.light))

    def image(on: Sequence[str]) -> Reconstruction:
        off = frozenset(ablation.effects).difference(on)
        make = lambda: assumed_image(ablation.without(off), patterns, seed)  # noqa: E731
        return studio.once("images", _IMAGES, (setup, seed, off), make)

    ideal, without, having = (image(EFFECTS[:count]) for count in (0, step, step + 1))
    ideal_db, before, after = (psnr(each.image, lit.truth) for each in (ideal, without, having))
    row = point.row(
        called_for=effect in ablation.effects, ideal_db=ideal_db, without_db=before, with_db=after,
        change_db=after - before, **flags_of(having.status),
    )  # fmt: skip
    if effect != EFFECTS[-1]:
        return Found((row,))
    calibrated = studio.image(setup, RENDERED, patterns, seed)
    kept = {_IDEAL: ideal.image, _ASSUMED: having.image, _CALIBRATED: calibrated.image, TRUTH: lit.truth}
    return Found(({**row, "calibrated_db": calibrated.quality.psnr_db},), single_precision(kept))


STUDY = Study(
    "waterfall",
    "From the idealised model to rendered frames",
    "What does each physical effect cost in decibels, added one after the other?",
    points=_points,
    measure=_measure,
    claims=(
        Gain(
            "A calibrated camera keeps what the idealised model promises (2 dB lost at most)", {}, {}, where=_LAST,
            column="calibrated_db", other_column="ideal_db", at_least=-TOLERANCE_DB, apart=True,
        ),
        Gain(
            "A calibrated model is better than the idealised one", {}, {}, where=_LAST, column="calibrated_db",
            other_column="with_db", apart=True,
        ),
    ),
    panels=(
        Bars(
            "effect", file="waterfall", title="Change of PSNR by each effect that the scene has", x="change_db",
            x_label="change of PSNR [dB]", colour="patterns", where={"called_for": True},
        ),
        Images(
            {
                _IDEAL: ("idealised", "{ideal_db:.1f} dB"), _ASSUMED: ("rendered, model assumed", "{with_db:.1f} dB"),
                _CALIBRATED: ("rendered, model calibrated", "{calibrated_db:.1f} dB"),
            },
            before={TRUTH: "truth"}, down=("picture",), where=_LAST,
        ),
    ),
    about="An image of 49 dots, exposed at equal peak, from the idealised model (even light on a plane, the mask's "
    "geometric shadow, factors known) to rendered frames, one physical effect after the other. Scene: depth, gloss, "
    "edges, and detail inside projector pixels. Model assumed: the solver keeps the idealised camera's factors. Model "
    "calibrated: it has factors of a session.",
    heads=("", "Before", "After"),
)  # fmt: skip

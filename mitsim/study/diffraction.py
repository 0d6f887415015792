"""`mitsim study diffraction`: what the mask's diffraction does to separability, and to a model that leaves it out.

Three questions, for both masks and for light of one line, the projector's lines and a broad band:

* How far is the wave-optical shadow from the geometric one?
* How far is it from one separable term, all that a calibration can find and a separable solver can use?
* What does an image lose whose solver assumes the geometric mask, and what one with factors of the true shadow?

The last is asked of idealised frames (an evenly lit plane without falloff, as in :mod:`mitsim.study.ideal`), so that
only diffraction differs from the model, and once of rendered ones: the scene's own mask, the projector's lines, a
rendered calibration session. Every family is exposed at equal peak, with the camera's noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.capture.bench import Bench
from mitsim.capture.calibrate import estimate
from mitsim.capture.exposer import Exposer
from mitsim.capture.light import Light, collect, make_plan, speckle_of
from mitsim.capture.plan import Plan
from mitsim.capture.run import board_flux, truth
from mitsim.capture.session import Session
from mitsim.capture.simulation import Simulation
from mitsim.core.arrays import FloatArray, Progress
from mitsim.core.job import Job
from mitsim.core.manifest import versions, write_json
from mitsim.core.output import output_folder, whole_file
from mitsim.core.parallel import single_threaded_blas
from mitsim.optics.frames import ExpectedFrames
from mitsim.reconstruct.solver import prepare
from mitsim.rig.mask import MaskKind
from mitsim.rig.patterns import PatternFamily
from mitsim.rig.recipe import load_recipe
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.study import plots
from mitsim.study.compare import accumulate, peak_time
from mitsim.study.ideal import IdealCamera, ideal_factors
from mitsim.study.metrics import psnr, ssim
from mitsim.study.shadows import GEOMETRIC, LINE, PROJECTOR, ShadowRow, lights, point_profiles, shadow_row

Factors = tuple[FloatArray, FloatArray]
ACCURACY = 1e-3
MASKS: tuple[MaskKind, ...] = ("separable", "flatcam")
ASSUMED, SEPARABLE, CALIBRATED = "geometric factors", "best separable factors", "calibrated factors"
PROFILE_MM = 0.7
LAMBDAS = tuple(10.0 ** (-step / 2) for step in range(17))
"""Relative to the largest sigma^2."""


@dataclass(frozen=True)
class QualityRow:
    """One reconstruction: which frames (idealised or rendered) in which light, and which factors the solver used.

    ``psnr_db`` and ``ssim`` are of the image with the solver's own lambda, ``psnr_best_db`` of the best lambda that a
    judge who knows the truth can choose: an unbiased risk estimate is misled by factors that are wrong. ``residual`` is
    ||Y - model|| / ||Y||: the sensor's noise, and what the factors cannot explain.
    """

    frames: str
    mask: str
    light: str
    patterns: str
    factors: str
    captures: int
    psnr_db: float
    psnr_best_db: float
    ssim: float
    lam: float
    residual: float
    status: str


@dataclass(frozen=True)
class DiffractionStudy:
    """All rows, and the difference in PSNR that each choice of factors makes."""

    scene: str
    patterns: str
    shadows: tuple[ShadowRow, ...]
    quality: tuple[QualityRow, ...]
    output: str

    def loss_db(self, frames: str, mask: str, light: str, patterns: str, factors: str) -> float:
        """PSNR [dB] lost against the same frames without diffraction, solved with the factors that fit them."""
        right = CALIBRATED if frames == "rendered" else ASSUMED
        return self._psnr(frames, mask, GEOMETRIC, patterns, right) - self._psnr(frames, mask, light, patterns, factors)

    def _psnr(self, *wanted: str) -> float:
        return next(
            row.psnr_db
            for row in self.quality
            if (row.frames, row.mask, row.light, row.patterns, row.factors) == wanted
        )

    def payload(self) -> dict[str, Any]:
        """The JSON of the command line."""
        return {
            "shadows": [asdict(row) for row in self.shadows],
            "quality": [
                {**asdict(row), "loss_db": self.loss_db(row.frames, row.mask, row.light, row.patterns, row.factors)}
                for row in self.quality
            ],
            "scene": self.scene,
            "patterns": self.patterns,
            "output": self.output,
        }

    def lines(self) -> list[str]:
        """For people."""
        shadows = [
            f"{row.mask:>10} {row.light:<14} off the geometric shadow by {row.point_source:5.1%} (point), "
            f"{row.scene_pixel:5.1%} (scene pixel); off one separable term by {row.separability:.1e}, centred "
            f"{row.separability_centred:.1e}"
            for row in self.shadows
        ]
        quality = [
            f"{row.frames:>10} {row.mask:<10} {row.light:<14} {row.patterns:<8} {row.factors:<22} "
            f"{row.psnr_db:5.1f} dB, {row.psnr_best_db:5.1f} dB with the best lambda; residual {row.residual:.1e}"
            for row in self.quality
        ]
        return [*shadows, *quality, f"{self.verdict}.", f"Plots: {self.output}/quality.png, {self.output}/shadow.png"]

    @property
    def verdict(self) -> str:
        """What idealised frames of the separable mask in the projector's light say, in one clause."""
        case = "idealised", MASKS[0], PROJECTOR, self.patterns
        wrong, right = (self.loss_db(*case, factors) for factors in (ASSUMED, SEPARABLE))
        kept = f"lose {right:.1f} dB" if right > 0 else f"lose nothing ({-right:+.1f} dB)"
        return (
            f"Assuming the geometric mask costs {wrong:.1f} dB under {self.patterns}; factors of the true shadow {kept}"
        )


def study_diffraction(
    bench: Bench, output: Path | str, patterns: str, seed: int, progress: Progress
) -> DiffractionStudy:
    """Measure shadows and reconstructions and write diffraction.json, quality.png and shadow.png to ``output``."""
    # Only an earlier study is replaced.
    with output_folder(output, overwrite=(Path(output) / "diffraction.json").is_file()) as folder:
        families = [bench.family(name, seed) for name in dict.fromkeys((patterns, "uniform"))]
        main = families[0].classes()
        plan = make_plan(bench, *main, ACCURACY, seed, {"diffraction": True})
        light = collect(bench, plan, *main, seed, progress)
        flux = float(board_flux(bench, plan, seed).mean())
        image = truth(bench, plan, light, seed)
        shadows, quality = [], []
        spectra = lights(bench)
        for done, mask in enumerate(MASKS):
            progress("idealised frames", done / len(MASKS))
            systems = {name: IdealCamera(bench, mask, spectrum) for name, spectrum in spectra.items()}
            shadows += [shadow_row(name, systems) for name in systems]
            quality += list(_idealised(bench, systems, families, image, flux, seed))
        progress("rendered session", 0.0)
        quality += list(_rendered(bench, plan, light, families, image, flux, seed))
        study = DiffractionStudy(str(bench.loaded.path), patterns, tuple(shadows), tuple(quality), str(folder))
        _plot(bench, study, folder)
        write_json(folder / "diffraction.json", {**study.payload(), "seed": seed, "versions": versions()})
        return study


def _idealised(
    bench: Bench,
    systems: Mapping[str, IdealCamera],
    families: list[PatternFamily],
    image: FloatArray,
    flux: float,
    seed: int,
) -> Iterator[QualityRow]:
    """Frames of an evenly lit plane in every light, solved with geometric factors and with the true shadow's."""
    root = np.sqrt(flux * _electrons_per_joule(bench))
    for light, system in systems.items():
        known = {ASSUMED: systems[GEOMETRIC].factors, SEPARABLE: system.factors}
        if light == GEOMETRIC:
            del known[SEPARABLE]
        scaled = {name: (left * root, right * root) for name, (left, right) in known.items()}
        for family in families:
            expected = system.frames(family, image * flux, seed)
            exposer = Exposer(bench, peak_time(bench, expected), seed)
            yield from _rows("idealised", system.mask, light, exposer, family, expected, scaled, image)


def _rendered(
    bench: Bench,
    plan: Plan,
    light: Light,
    families: list[PatternFamily],
    image: FloatArray,
    flux: float,
    seed: int,
) -> Iterator[QualityRow]:
    """Rendered frames of the scene, solved with geometric factors and with those of a rendered noisy session.

    Without diffraction the same light of scene and board goes through the geometric shadow.
    """
    session, job = Session(bench, load_recipe(), seed), Job()
    board_plan = session.plan(ACCURACY, job)
    lit = session.lit(board_plan, session.trace(board_plan, job), job)
    assumed = ideal_factors(bench, flux, _electrons_per_joule(bench))
    for name, effects in ((PROJECTOR, plan.settings.effects), (GEOMETRIC, plan.settings.effects - {"diffraction"})):
        settings = replace(plan.settings, effects=effects)
        scene = replace(light, simulation=Simulation(bench, settings)).merged()
        board = replace(board_plan.settings, effects=board_plan.settings.effects - (plan.settings.effects - effects))
        found, _ = estimate(replace(lit, light=replace(lit.light, simulation=Simulation(session.board, board))), job)
        known = {ASSUMED: assumed, CALIBRATED: (found.left, found.right)}
        for family in families:
            expected = scene.frames(*family.classes(), seed)
            exposer = Exposer(bench, peak_time(bench, expected), seed, speckle_of(bench, plan))
            yield from _rows("rendered", bench.geometry.mask, name, exposer, family, expected, known, image)


def _rows(
    frames: str,
    mask: str,
    light: str,
    exposer: Exposer,
    family: PatternFamily,
    expected: ExpectedFrames,
    known: Mapping[str, Factors],
    image: FloatArray,
) -> Iterator[QualityRow]:
    """One noisy exposure of a family, solved with each pair of factors."""
    models = [prepare(*pair, family.left, family.right, centre=mask == "flatcam") for pair in known.values()]
    sums = accumulate(exposer, family, expected, models)
    for factors, model, measured in zip(known, models, sums, strict=True):
        found = model.solve(measured, "auto")
        quality = psnr(found.image, image)
        largest = (model.left.singular.max() * model.right.singular.max()) ** 2
        with single_threaded_blas():
            best = max(psnr(model.solve(measured, largest * part).image, image) for part in LAMBDAS)
        yield QualityRow(
            frames=frames,
            mask=mask,
            light=light,
            patterns=family.name,
            factors=factors,
            captures=len(family.captures),
            psnr_db=quality,
            psnr_best_db=max(quality, best),
            ssim=ssim(found.image, image),
            lam=found.lam,
            residual=found.residual,
            status=found.status,
        )


def _electrons_per_joule(bench: Bench) -> float:
    """Electrons a second of one sensor pixel at 1 W m^-2."""
    return float(electrons_from_irradiance(1.0, 1.0, bench.sensor, bench.projector.effective_wavelength_nm))


def _plot(bench: Bench, study: DiffractionStudy, folder: Path) -> None:
    quality = [
        (f"{row.frames}, {row.mask},\n{row.light}", row.factors, row.psnr_db)
        for row in study.quality
        if row.patterns == study.patterns
    ]
    profiles = point_profiles(bench)
    # It lies on the projector's lines, to the width of a plotted line.
    del profiles[LINE]
    edges = bench.geometry.pixel_edges
    off = next(row for row in study.shadows if (row.mask, row.light) == (MASKS[0], PROJECTOR))
    message = f"A point's shadow in the projector's light is {off.point_source:.0%} off the geometric one"
    figures = {
        "quality.png": plots.quality_by_factors(quality, study.verdict),
        "shadow.png": plots.shadow_profiles((edges[:-1] + edges[1:]) / 2, profiles, PROFILE_MM, message),
    }
    for name, figure in figures.items():
        with whole_file(folder / name) as part:
            figure.savefig(part, dpi=150, format="png")

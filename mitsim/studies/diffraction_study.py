"""`mitsim study diffraction`: what the mask's diffraction does to separability, and to a model that leaves it out.

Three questions, for both masks and for light of one line, the projector's lines and a broad band:

* How far is the wave-optical shadow from the geometric one?
* How far is it from one separable term, all that a calibration can find and a separable solver can use?
* What does an image lose whose solver assumes the geometric mask, and what one with factors of the true shadow?

The last is asked of idealised frames (an evenly lit plane without falloff, :mod:`mitsim.report.lit_scene`), so that
only diffraction differs from the model, and once of rendered ones: the scene's own mask, the projector's lines, a
rendered calibration session. Every family is exposed at equal peak, with the camera's noise. Light of the scene and of
the session's board is traced once, and formed with either shadow.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from textwrap import fill
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from mitsim.acquire.exposure import Exposer
from mitsim.api.bench import Bench
from mitsim.bench.request import Exposure, Request
from mitsim.calibrate.board_session import Session
from mitsim.calibrate.calibrate import estimate
from mitsim.calibrate.lit_session import LitSession
from mitsim.core.arrays import FloatArray
from mitsim.core.job import Job
from mitsim.core.parallel import single_threaded_blas
from mitsim.devices.mask import CameraMask
from mitsim.devices.patterns import PatternFamily
from mitsim.devices.session import load_recipe
from mitsim.light.light import SampledLight
from mitsim.metrics import Quality, psnr
from mitsim.optics.frames import ExpectedFrames
from mitsim.reconstruct.solver import prepare
from mitsim.report import label, plots
from mitsim.report.lit_scene import (
    GEOMETRIC,
    LINE,
    PROJECTOR,
    IdealCamera,
    Pair,
    ShadowRow,
    accumulate,
    lights,
    peak_time,
    point_profiles,
    shadow_row,
)
from mitsim.report.pages import Mean
from mitsim.studies.ablation import reform
from mitsim.studies.framework.page import Part
from mitsim.studies.framework.run import Findings

MASKS: tuple[CameraMask, ...] = ("separable", "flatcam")
ASSUMED, SEPARABLE, CALIBRATED = "geometric factors", "best separable factors", "calibrated factors"
_PROFILE_MM = 0.7
"""Half of what is shown of a point's shadow: a dozen mask features, whose fringes can be told apart."""
_LAMBDAS = tuple(10.0 ** (-step / 2) for step in range(17))
"""Relative to the largest sigma^2, down to where rounding begins to show; PSNR changes little over half a decade."""


@dataclass(frozen=True)
class QualityRow:
    """One reconstruction: which frames (idealised or rendered) in which light, and which factors the solver used.

    ``psnr_db`` and ``ssim`` are of the image with the solver's own lambda, ``psnr_best_db`` of the best lambda that a
    judge who knows the truth can choose: an unbiased risk estimate is misled by factors that are wrong. ``residual`` is
    ||Y - model|| / ||Y||: the sensor's noise, and what the factors cannot explain. ``captures`` counts frames.
    """

    frames: str
    mask: str
    light: str
    patterns: str
    factors: str
    captures: int
    psnr_db: float
    psnr_best_db: float
    ssim: float | None
    lam: float
    residual: float
    status: str


@dataclass(frozen=True, eq=False)
class DiffractionFindings(Findings):
    """All rows, and the difference in PSNR that each choice of factors makes; figures are of ``patterns``."""

    bench: Bench
    patterns: str
    shadows: tuple[ShadowRow, ...]
    quality: tuple[QualityRow, ...]
    title: ClassVar[str] = "What diffraction at the mask does to images"

    def loss_db(self, row: QualityRow) -> float:
        """PSNR [dB] lost in a ``row`` against the same frames without diffraction, solved with the factors that fit."""
        fitting = CALIBRATED if row.frames == "rendered" else ASSUMED
        return self.row(row.frames, row.mask, GEOMETRIC, row.patterns, fitting).psnr_db - row.psnr_db

    def row(self, *case: str) -> QualityRow:
        """The row of a ``case``: frames, mask, light, patterns, factors."""
        return next(row for row in self.quality if (row.frames, row.mask, row.light, row.patterns, row.factors) == case)

    def payload(self) -> dict[str, Any]:
        """The JSON of the command line."""
        return {
            "shadows": [asdict(row) for row in self.shadows],
            "quality": [{**asdict(row), "loss_db": self.loss_db(row)} for row in self.quality],
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
        return [f"{self.verdict}.", *shadows, *quality]

    def parts(self) -> Sequence[Part]:
        """Of the page: images, and shadows."""
        images = [
            (row.frames, row.mask, row.light, label(row.patterns), row.factors, f"{row.psnr_db:.1f}",
             f"{row.psnr_best_db:.1f}", f"{round(self.loss_db(row), 1) + 0.0:.1f}", f"{row.residual:.1e}")
            for row in self.quality
        ]  # fmt: skip
        shadows = [
            (row.mask, row.light, f"{100 * row.point_source:.1f}", f"{100 * row.scene_pixel:.1f}",
             f"{row.separability:.1e}", f"{row.separability_centred:.1e}")
            for row in self.shadows
        ]  # fmt: skip
        return [
            Part(
                "Images",
                "Frames through the mask in each light, solved with factors of its geometric shadow, and with those "
                "that fit. Lost: against frames without diffraction and factors that fit them.",
                ("Frames", "Mask", "Light", "Patterns", "Factors", "PSNR [dB]", "With the best lambda [dB]",
                 "Lost [dB]", "Residual [1]"),
                tuple(images),
                ("quality.png",),
            ),
            Part(
                "Shadows",
                "How far the mask's shadow is off the geometric one, of a point and of a pixel of the scene; and what "
                "one separable term leaves of it, of the frames as they are and centred.",
                ("Mask", "Light", "Point [%]", "Pixel [%]", "Not separable [1]", "The same, centred [1]"),
                tuple(shadows),
                ("shadow.png",),
            ),
        ]  # fmt: skip

    @property
    def message(self) -> str:
        """As the last line says."""
        return self.verdict

    @property
    def verdict(self) -> str:
        """What idealised frames of the separable mask in the projector's light say, in one clause."""
        case = "idealised", MASKS[0], PROJECTOR, self.patterns
        wrong, right = (self.loss_db(self.row(*case, factors)) for factors in (ASSUMED, SEPARABLE))
        verb = "lose" if right > 0 else "gain"
        return (
            f"Under {self.patterns}, against a mask that does not diffract: geometric factors lose {wrong:.1f} dB, "
            f"factors of the true shadow {verb} {abs(right):.1f} dB"
        )

    def figures(self) -> dict[str, Figure]:
        """Image quality by the solver's factors, and shadows of a point."""
        profiles = point_profiles(self.bench)
        # It lies on the projector's lines, to the width of a plotted line.
        del profiles[LINE]
        off = next(row for row in self.shadows if (row.mask, row.light) == (MASKS[0], PROJECTOR))
        message = f"A point's shadow in the projector's light is {100 * off.point_source:.0f} % off the geometric one"
        position = self.bench.geometry.centres(0)
        return {
            "quality.png": quality_by_factors(
                [row for row in self.quality if row.patterns == self.patterns], self.verdict
            ),
            "shadow.png": shadow_profiles(position, profiles, _PROFILE_MM, message),
        }


def measure(bench: Bench, request: Request, job: Job) -> DiffractionFindings:
    """Shadows, and reconstructions under the patterns asked for and under uniform light.

    MitsimError for patterns that do not fit, a camera without a full well, or a scene without light.

    Parameters
    ----------
    bench, request, job
        the scene, patterns, seed and accuracy (diffraction is on, whatever it is worth), progress and limits.
    """
    Exposure().check(bench.sensor, bench.devices.camera_file)
    request = request.with_values(effects={**request.effects, "diffraction": True})
    families = [bench.family(name, request.seed) for name in dict.fromkeys((request.patterns, "uniform"))]
    light = bench.light(job=job, **request.model_dump())
    trials = _Trials(families, light.truth, float(light.apparent.board_flux.mean()), request.seed)
    shadows, quality = [], []
    for done, mask in enumerate(MASKS):
        job.progress("idealised frames", done / len(MASKS))
        cameras = {name: IdealCamera(bench, mask, spectrum) for name, spectrum in lights(bench).items()}
        shadows += [shadow_row(name, cameras) for name in cameras]
        quality += list(trials.idealised_rows(cameras))
    job.progress("rendered session", 0.0)
    with job.clock.stage("rendered session"):
        quality += list(trials.rendered_rows(light, request.accuracy, job))
    return DiffractionFindings(bench, request.patterns, tuple(shadows), tuple(quality))


@dataclass(frozen=True, eq=False)
class _Trials:
    """Reconstructions of one scene under a few families: its truth, and the board's mean flux a pixel [W m^-2]."""

    families: list[PatternFamily]
    truth: FloatArray
    flux: float
    seed: int

    def idealised_rows(self, cameras: Mapping[str, IdealCamera]) -> Iterator[QualityRow]:
        """Frames of an evenly lit plane in every light, solved with geometric factors and with the true shadow's."""
        for name, camera in cameras.items():
            known = {ASSUMED: cameras[GEOMETRIC].calibrated(self.flux)}
            if name != GEOMETRIC:
                known[SEPARABLE] = camera.calibrated(self.flux)
            for family in self.families:
                expected = camera.frames(family, self.truth * self.flux)
                exposer = Exposer(camera.bench.devices, peak_time(camera.bench, expected), self.seed)
                yield from self._rows(("idealised", camera.mask, name), exposer, family, expected, known)

    def rendered_rows(self, light: SampledLight, accuracy: float, job: Job) -> Iterator[QualityRow]:
        """Rendered frames of the scene, solved with geometric factors and with those of a rendered noisy session.

        Without diffraction the same light of scene and board goes through the geometric shadow.
        """
        bench = light.bench
        mask = bench.geometry.mask
        session = Session(bench, load_recipe(), self.seed)
        board = session.trace(session.plan(accuracy, job), job)
        assumed = IdealCamera(bench, mask).calibrated(self.flux)
        for name, absent in ((PROJECTOR, frozenset[str]()), (GEOMETRIC, frozenset({"diffraction"}))):
            scene = reform(light, absent).merge()
            fitted, _ = estimate(LitSession.of(session, reform(board, absent), job), job)
            known = {ASSUMED: assumed, CALIBRATED: (fitted.left, fitted.right)}
            for family in self.families:
                expected = scene.frames(family.lighting, self.seed)
                speckle = scene.speckle(family)
                exposer = Exposer(bench.devices, peak_time(bench, expected), self.seed, speckle)
                yield from self._rows(("rendered", mask, name), exposer, family, expected, known)

    def _rows(
        self,
        case: tuple[str, CameraMask, str],
        exposer: Exposer,
        family: PatternFamily,
        expected: ExpectedFrames,
        known: Mapping[str, Pair],
    ) -> Iterator[QualityRow]:
        """One noisy exposure of a family, solved with each pair of factors."""
        frames, mask, light = case
        models = [prepare(*pair, family.left, family.right, centre=mask == "flatcam") for pair in known.values()]
        for factors, model, sums in zip(known, models, accumulate(exposer, family, expected, models), strict=True):
            solution = model.solve(sums, "auto")
            quality = Quality.of(solution.image, self.truth)
            largest = (model.left.singular.max() * model.right.singular.max()) ** 2
            with single_threaded_blas():
                best = max(psnr(model.solve(sums, largest * part).image, self.truth) for part in _LAMBDAS)
            yield QualityRow(
                frames=frames,
                mask=mask,
                light=light,
                patterns=family.name,
                factors=factors,
                captures=len(family.shots),
                psnr_db=quality.psnr_db,
                psnr_best_db=max(quality.psnr_db, best),
                ssim=quality.ssim,
                lam=solution.lam,
                residual=solution.residual,
                status=str(solution.status),
            )


# -------- Figures

_TITLE_LETTERS = 66
"""Of a line above a figure of bars."""


def quality_by_factors(rows: Sequence[QualityRow], message: str) -> Figure:
    """PSNR [dB] of each system in ``rows``, with geometric factors and with those that fit it; ``message`` above."""
    assumed, fitting = (
        {
            f"{row.frames}, {row.mask}, {row.light}": Mean(row.psnr_db, np.nan, 1)
            for row in rows
            if (row.factors == ASSUMED) == geometric
        }
        for geometric in (True, False)
    )
    # Of light that does not diffract the geometric factors are the true ones, and no others are tried.
    untried = Mean(np.nan, np.nan, 0)
    pairs = {system: (mean, fitting.get(system, untried)) for system, mean in assumed.items()}
    figure = plots.pair_chart(pairs, (ASSUMED, f"{SEPARABLE}, or {CALIBRATED}"), "PSNR of the image [dB]")
    figure.suptitle(fill(message, _TITLE_LETTERS), fontsize=plots.FONT)
    return figure


def shadow_profiles(
    position_mm: npt.ArrayLike, profiles: Mapping[str, npt.ArrayLike], reach_mm: float, message: str
) -> Figure:
    """Shadows on one row of the sensor.

    Parameters
    ----------
    position_mm, profiles
        (pixels,) along the row, and relative irradiance there by light.
    reach_mm, message
        how far from the middle of the ``position_mm`` is shown, and what is said above.
    """
    figure, axes = plots.figure_of(0.4 * plots.WIDTH)
    position = np.asarray(position_mm, dtype=np.float64)
    inside = np.abs(position - position.mean()) <= reach_mm
    for index, (name, values) in enumerate(profiles.items()):
        axes.plot(position[inside], np.asarray(values)[inside], lw=1.8, label=name, **plots.line_style(index))
    axes.set_title(message, fontsize=plots.FONT)
    plots.label_axes(axes, "position on the sensor [mm]", "irradiance, open sensor = 1 [1]")
    axes.legend(fontsize=plots.FONT - 1, frameon=False, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    return figure

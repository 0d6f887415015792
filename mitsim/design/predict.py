"""Prediction of the image of a bench: light and mean exposures of a scene without frames, and the error by cause."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from mitsim.acquire.exposure import ambient_shots
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import EFFECTS
from mitsim.bench.layout import before_board
from mitsim.bench.request import Exposure, PredictRequest
from mitsim.calibrate.board_session import Session, entry_variances
from mitsim.core.arrays import FloatArray
from mitsim.core.images import fit_square, read_reflectance
from mitsim.core.job import Job
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.picture_files import picture_files
from mitsim.design.predictor import ELSEWHERE, Camera, Errors, Noise, Predictor, Scene, decibels
from mitsim.devices.patterns import Lighting, PatternFamily
from mitsim.devices.sensor import digital_of
from mitsim.devices.session import Drift, load_recipe
from mitsim.light.light import Group, trace_groups
from mitsim.light.passes import LightEstimate, Simulation
from mitsim.light.settings import Settings
from mitsim.optics.frames import ExpectedFrames
from mitsim.optics.shadow import Directions, SeparableTerms
from mitsim.optics.terms import centre_terms, shadow_terms, stripe_term
from mitsim.reconstruct.accumulation import pattern_response
from mitsim.sensor.chain import electrons_from_irradiance, response_variance

CELLS = 4
"""Cells along a projector pixel: print within them is a sixteenth of the print within pixels."""
_DIRECT, _FOLLOWED = 64, 4
"""Samples of each projector pixel's direct light, and of other light."""
_MOST_KINDS = 256
"""Kinds of projector pixels, by the patterns that light them, whose light is kept apart."""
_SHOWN, _SMALL, _UNSURE_DB = 1e-3, 1e-3, 0.5
"""Parts of the error that the report shows, and of light that it mentions, and doubt about lambda that it mentions."""


@dataclass(frozen=True, eq=False)
class TracedLight:
    """Light of a bench by projector pixel and by cell, without the mask [W m^-2].

    Attributes
    ----------
    by_pixel
        Grids' names and their light, (n^2 + 1, cells); the last row is ambient light.
    cells
        (c n, c n) direct light of the cells of each projector pixel.
    beyond
        Light over several surfaces relative to direct light.
    """

    simulation: Simulation
    estimate: LightEstimate
    cells: FloatArray
    beyond: float

    @classmethod
    def of(cls, bench: Apparatus, seed: int) -> TracedLight:
        n = bench.n
        settings = Settings(bench.geometry.scene_distance, subdivision=CELLS, effects=frozenset(EFFECTS))
        simulation = Simulation(bench, settings)
        group = Group(simulation, np.arange(n * n), seed)
        trace_groups([group], {name: _DIRECT if name == "direct" else _FOLLOWED for name in simulation.passes})
        estimate, direct = group.light(), group.part("direct")["fine"].tocoo()
        pixel, place = (each.astype(np.int64) for each in direct.coords)
        bundle = simulation.grids["fine"].bundle
        # Light that a surface at another depth moves into the next pixels stays in its own here, at the same fraction.
        first = [_before(edges, window) for edges, window in zip(bundle.directions, bench.windows, strict=True)]
        rows, columns = (
            (at - start) % CELLS for at, start in zip(np.divmod(place, bundle.cells[1]), first, strict=True)
        )
        row, column = (CELLS * at + inside for at, inside in zip(np.divmod(pixel, n), (rows, columns), strict=True))
        lit = pixel < n * n
        flat = np.zeros((CELLS * n) ** 2)
        flat += np.bincount((row * CELLS * n + column)[lit], direct.data[lit], len(flat))
        every, own = float(estimate.totals[: n * n].sum()), float(flat.sum())
        return cls(simulation, estimate, flat.reshape(CELLS * n, -1), every / own - 1 if own else 0.0)

    @property
    def pixels(self) -> FloatArray:
        n = len(self.cells) // CELLS
        return np.asarray(self.cells.reshape(n, CELLS, n, CELLS).sum(axis=(1, 3)))


def _before(directions: Directions, window: tuple[float, float]) -> int:
    return round((window[0] - float(directions.centres[0])) / directions.width + 0.5)


@dataclass(frozen=True, eq=False)
class Stand:
    """A bench before its scene: what all patterns, exposures and sessions share.

    ``unit`` is the mean light of a pixel of a white board [electrons / s], without the mask.
    """

    bench: Apparatus
    scene: TracedLight
    board: TracedLight
    waves: bool = True

    @classmethod
    def of(cls, session: Session) -> Stand:
        """Trace the light of a ``session``'s bench and of its white board."""
        board = before_board(session.bench, session.recipe.board_reflectance)
        return cls(session.bench, TracedLight.of(session.bench, session.seed), TracedLight.of(board, session.seed))

    @cached_property
    def unit(self) -> float:
        return self._rate(float(self.board.pixels.mean()))

    def _rate(self, irradiance: float) -> float:
        wavelength = self.bench.projector.effective_wavelength_nm
        return float(electrons_from_irradiance(irradiance, 1.0, self.bench.sensor, wavelength))

    @property
    def truth(self) -> FloatArray:
        """Return the apparent reflectance (n, n)."""
        return _over(self.scene.pixels, self.board.pixels)

    def shadow(self, directions: tuple[Directions, Directions]) -> SeparableTerms:
        """Return the shadow's terms of ``directions``, for the light of a white pixel [(electrons / s)^(1/2)]."""
        geometry, spectrum = self.bench.geometry, self.bench.waves if self.waves else None
        terms, root = shadow_terms(geometry, *directions, geometry.scene_distance, spectrum), self.unit**0.5
        return [(left * root, right * root) for left, right in terms]

    @cached_property
    def camera(self) -> Camera:
        n, board, centre = self.bench.n, self.board.cells, self.bench.geometry.centred
        windows = self.bench.windows
        cells = tuple(Directions.cells(np.linspace(*window, CELLS * n + 1)) for window in windows)
        bright = [board.mean(axis=axis) / board.mean() for axis in (1, 0)]
        terms = [(left * bright[0], right * bright[1]) for left, right in self.shadow((cells[0], cells[1]))]
        best = stripe_term(centre_terms(terms) if centre else terms)
        left, right = (side.reshape(len(side), n, CELLS).mean(axis=2) for side in best)
        black = self.scene.simulation.physics.black_level
        return Camera((left, right), best, terms, centre, black / (1 - black))

    @cached_property
    def ambient(self) -> FloatArray | None:
        """Return the light of lamps behind the mask (m, m') [electrons / s]; None without lamps."""
        made, n = self.scene.simulation, self.bench.n
        if not made.physics.lamps:
            return None
        frames = ExpectedFrames(made.of_lamps([self.scene.estimate], n * n), Lighting.uniform(1), 0)
        frame = next(iter(frames)).irradiance
        return self._rate(1.0) * frame

    def seen(self, predictor: Predictor, family: PatternFamily) -> FloatArray | None:
        """Return the data (r, r') of the traced light, None for patterns of many kinds of pixels."""
        sides, made, n = (predictor.prepared.left, predictor.prepared.right), self.scene.simulation, self.bench.n
        kinds = [np.unique(side, axis=0, return_inverse=True) for side in (family.left, family.right)]
        if len(kinds[0][0]) * len(kinds[1][0]) > _MOST_KINDS:
            return None
        total = np.zeros((len(sides[0].singular), len(sides[1].singular)))
        count = len(kinds[1][0])
        label = (kinds[0][1].reshape(-1, 1) * count + kinds[1][1].reshape(1, -1)).ravel()
        for name, light in self.scene.estimate.light.items():
            if not light.nnz:
                continue
            bundle = made.grids[name].bundle
            chosen = sparse.csr_array(
                (np.ones(n * n), (label, np.arange(n * n))), shape=(label.max() + 1, light.shape[0])
            )
            by_kind = sparse.csr_array(chosen @ light)
            for left, right in self.shadow(bundle.directions):
                seen = [
                    [_of_kind(side, factor, kind) for kind in own[0]]
                    for side, factor, own in zip(sides, (left, right), kinds, strict=True)
                ]
                for number in range(by_kind.shape[0]):
                    (rows, first), (columns, second) = seen[0][number // count], seen[1][number % count]
                    image = by_kind[[number]].toarray().reshape(bundle.cells) / self.board.pixels.mean()
                    total[np.ix_(rows, columns)] += first @ image @ second.T
        return total

    @cached_property
    def white(self) -> FloatArray:
        """Return the light of a white board, of which all pixels are lit (m, m') [electrons / s]."""
        terms = self.camera.pixel_terms
        return np.asarray(sum(np.outer(left.sum(axis=1), right.sum(axis=1)) for left, right in terms))

    def session_noise(self, session: Session) -> tuple[tuple[float, float], float]:
        """Return the deviations of the factors' numbers by the noise of a ``session``, and its exposure time [s]."""
        timing = Exposure(None, session.recipe.exposure_fraction)
        seconds = timing.choose(self.bench.devices, float(self.white.max()) / self._rate(1.0))
        left, right = (
            float(np.sqrt(sum(each.values(), np.zeros(1)).mean()))
            for each in entry_variances(session, self.white, seconds, self.camera.factors)
        )
        return (left, right), seconds

    @cached_property
    def own(self) -> Scene:
        """Return the scene in front of the camera, as it was traced."""
        return Scene(_over(self.scene.cells, self.board.cells), beyond=self.scene.beyond)

    def predictor(self, scene: Scene, family: PatternFamily, session: Session, asked: PredictRequest) -> Predictor:
        """Return the predictor of a ``scene`` under a ``family``, exposed as it is ``asked``."""
        ambient = self.ambient
        shown = family.left.astype(np.float64), family.right.astype(np.float64)
        peak = self.camera.brightest(scene, shown, 0.0 if ambient is None else ambient)
        timing = asked.timing
        if asked.exposure_total is not None:
            timing = Exposure(asked.exposure_total / len(family.shots))
        exposure_s = timing.choose(self.bench.devices, peak / self._rate(1.0))
        noise = noise_of(self.bench, family, exposure_s, self.session_noise(session)[0], ambient)
        model = Predictor(self.camera, shown, scene, noise)
        model.seen = self.seen(model, family) if scene is self.own else None
        return model


def noise_of(
    bench: Apparatus, family: PatternFamily, seconds: float, factors: tuple[float, float], ambient: FloatArray | None
) -> Noise:
    """Return the noise of a ``bench`` under a ``family``; ``factors`` and ``ambient`` as of :class:`Noise`."""
    dark, digital = bench.sensor.superpixel_dark_current_e_per_s, digital_of(bench.sensor, seconds)
    return Noise(
        seconds=seconds,
        dark=dark,
        read=float(digital.variance(0.0)) * seconds**2 - dark * seconds,
        uneven=response_variance(bench.sensor) + bench.speckle(family) ** 2,
        factors=factors,
        ambient=ambient,
        ambient_shots=0 if ambient is None or family.signed else ambient_shots(family),
    )


def _of_kind(side: Any, factor: FloatArray, kind: FloatArray) -> tuple[Any, FloatArray]:
    every = pattern_response(side, factor, np.broadcast_to(kind.astype(np.float64), (factor.shape[1], len(kind))))
    rows = np.flatnonzero(every.any(axis=1))
    return rows, every[rows]


def _over(flux: FloatArray, unit: FloatArray) -> FloatArray:
    return np.divide(flux, unit, out=np.zeros_like(flux), where=unit > 0)


@dataclass(frozen=True, eq=False)
class Prediction:
    """Expected quality of an image, its errors by cause, and the exposure.

    Attributes
    ----------
    patterns
        Family of the capture.
    errors
        Expected squared errors of the image; their means over the pictures of a folder.
    psnr_db
        PSNR of the mean squared error.
    pictures
        PSNR by picture of a folder.
    frames, exposure_s
        Frames of the capture, and exposure time of each [s].
    electrons
        Mean electrons per pixel and frame, without dark current.
    session_exposure_s
        Exposure time of each frame of the calibration [s].
    without_diffraction_db
        PSNR if the mask's shadow were geometric, as are the factors then; None if diffraction is not simulated.
    warnings
        Causes that the prediction lacks, with their size.
    """

    patterns: str
    errors: Errors
    pictures: Mapping[str, float]
    frames: int
    exposure_s: float
    electrons: float
    session_exposure_s: float
    without_diffraction_db: float | None
    warnings: tuple[str, ...]

    @property
    def psnr_db(self) -> float:
        return self.errors.psnr_db

    def payload(self) -> dict[str, Any]:
        """Return the values of the command line's JSON."""
        return {
            "patterns": self.patterns,
            "psnr": self.psnr_db,
            "mean_squared_error": self.errors.total,
            "causes": dict(self.errors.causes),
            "lambda": self.errors.lam,
            "pictures": dict(self.pictures),
            "frames": self.frames,
            "exposure_s": self.exposure_s,
            "exposure_total_s": self.frames * self.exposure_s,
            "electrons_a_pixel": self.electrons,
            "electrons_a_pixel_total": self.frames * self.electrons,
            "session_exposure_s": self.session_exposure_s,
            "psnr_without_diffraction": self.without_diffraction_db,
            "warnings": self.warnings,
        }

    def lines(self) -> list[str]:
        """Return the report as lines of text."""
        total, causes = self.errors.total, sorted(self.errors.causes.items(), key=lambda each: -abs(each[1]))
        shots = f"{self.frames} frames of {self.exposure_s:.3g} s, {self.electrons:.3g} electrons a pixel"
        lines = [f"PSNR {self.psnr_db:.1f} dB predicted under {self.patterns}: {shots}"]
        if self.pictures:
            low, high = min(self.pictures.values()), max(self.pictures.values())
            lines.append(f"{len(self.pictures)} pictures, from {low:.1f} to {high:.1f} dB")
        columns = "{:24} {:>9} {:>8}  {}"
        lines.append(columns.format("cause", "rms error", "part", "PSNR of this cause alone [dB]"))
        for name, square in causes:
            if abs(square) >= _SHOWN * total:
                own = f"{decibels(square):.1f}" if square > 0 else "- (it cancels a part of the others)"
                words = name.replace("_", " ")
                lines.append(columns.format(words, f"{abs(square) ** 0.5:.1e}", f"{square / total:.1%}", own))
        if self.without_diffraction_db is not None:
            lines.append(f"PSNR {self.without_diffraction_db:.1f} dB if light were not diffracted at the mask")
        return lines


@single_threaded_blas()
def predict(bench: Apparatus, asked: PredictRequest, job: Job | None = None) -> Prediction:
    """Predict the image of a bench; see :meth:`mitsim.api.bench.Bench.predict`."""
    job, recipe = job or Job(), (asked.recipe or load_recipe()).of_one_depth()
    family, session = bench.family(asked.patterns, asked.seed), Session(bench, recipe, asked.seed)
    session.check_mask(job)
    with job.clock.stage("transport"):
        stand = Stand.of(session)
    with job.clock.stage("predict"):
        found, lam = list[tuple[str, Predictor, Errors]](), asked.weight
        for name, each in scenes_of(asked, stand):
            model = stand.predictor(each, family, session, asked)
            found.append((name, model, model.errors(lam)))
        _, model, errors = found[0]
        mean = {cause: float(np.mean([each.causes[cause] for *_, each in found])) for cause in errors.causes}
        without = None
        if bench.waves is not None:
            rays = replace(stand, waves=False)
            noise = replace(model.noise, factors=rays.session_noise(session)[0])
            ideal = Predictor(rays.camera, model.patterns, model.scene, noise).errors(lam)
            without = decibels(ideal.total + errors.causes[ELSEWHERE])
    return Prediction(
        patterns=asked.patterns,
        errors=Errors(mean, errors.lam),
        pictures={name: each.psnr_db for name, _, each in found if name},
        frames=len(family.shots),
        exposure_s=model.noise.seconds,
        electrons=float(model.light[0].mean()) * model.noise.seconds / (2 if family.signed else 1),
        session_exposure_s=stand.session_noise(session)[1],
        without_diffraction_db=without,
        warnings=tuple(lacks(stand, model, session, lam is not None)),
    )


def scenes_of(asked: PredictRequest, stand: Stand) -> Iterator[tuple[str, Scene]]:
    """Yield names and scenes: the prior's, those of pictures, or the bench's own."""
    side = CELLS * stand.bench.n
    if asked.prior is not None:
        mean, variance, length = asked.prior
        yield "", Scene.prior(side, mean, variance, CELLS * length)
    elif asked.pictures is not None:
        for path in picture_files(Path(asked.pictures)):
            square = fit_square(read_reflectance(path))
            below = np.clip(
                np.arange(len(square) + 1) - np.linspace(0, len(square), side + 1)[:-1, None], 0, len(square) / side
            )
            weights = np.diff(below, axis=1) * side / len(square)
            yield path.name, Scene(weights @ square @ weights.T)
    else:
        yield "", stand.own


def lacks(stand: Stand, model: Predictor, session: Session, asked_lambda: bool = False) -> Iterator[str]:
    """Yield the causes that the prediction lacks, with their size."""
    bench, scene, energy = stand.bench, stand.scene, float(np.square(stand.truth).mean())
    yield from session.warnings
    if session.recipe.drift != Drift():
        yield "drift: the recipe's table [drift] is not in this prediction; `mitsim study drift` measures its cost"
    if model.prepared.spare <= 0 and not asked_lambda:
        yield "too few data: a solver cannot estimate noise and choose lambda from these frames; take more patterns"
    if model.seen is None and scene.beyond > _SMALL:
        size = f"{scene.beyond:.1%} of the direct light, an error of {decibels(scene.beyond**2 * energy):.1f} dB alone"
        yield f"indirect light: light over several surfaces is {size}, and this prediction lacks it"
    if bench.loaded.glossy and (part := _gloss(bench, session.seed)) > _SMALL:
        size = f"{part:.1%} (rms) of the direct light, an error of {decibels(part**2 * energy):.1f} dB alone"
        yield f"gloss: light that changes over the sensor is {size}, and this prediction lacks it"
    if not (asked_lambda or model.seen is None):
        low, high = sorted(model.errors(lam).psnr_db for lam in model.lambdas)
        if high - low > _UNSURE_DB:
            yield (
                f"misfit: light from other depths and over several surfaces does not fit the calibration and decides "
                f"the automatic lambda; the image may have {low:.1f} to {high:.1f} dB; give lambda to predict one"
            )
    if scene.simulation.physics.mirrors:
        yield "mirrors: light over mirrors is not in this prediction; capture the scene to see what it costs"
    peak = model.camera.brightest(model.scene, model.patterns, 0.0 if stand.ambient is None else stand.ambient)
    if peak * model.noise.seconds > bench.sensor.superpixel_full_well_e:
        full = peak * model.noise.seconds / bench.sensor.superpixel_full_well_e
        yield f"saturation: the brightest pixel would have {full:.3g} times the full well; use a shorter exposure"


def _gloss(bench: Apparatus, seed: int) -> float:
    """Return the part (rms) of direct light that differs between four points of the sensor."""
    simulation = Simulation(bench, Settings(bench.geometry.scene_distance, anchors=2))
    group = Group(simulation, np.arange(bench.n**2), seed)
    trace_groups([group], dict.fromkeys(simulation.passes, _DIRECT // 4))
    residual, direct = (
        group.part("anchor_residual")["anchor_residual"].tocoo(),
        group.part("direct")["fine"].sum(axis=1),
    )
    pixel, place = (each.astype(np.int64) for each in residual.coords)
    rows, columns = simulation.grids["anchor_residual"].bundle.cells
    anchor = place // (2 * columns) // rows * 2 + place % (2 * columns) // columns
    by_anchor = np.bincount(4 * pixel + anchor, residual.data, 4 * len(direct))
    return float(np.sqrt(np.square(by_anchor).sum() / 4 / np.square(direct).sum()))

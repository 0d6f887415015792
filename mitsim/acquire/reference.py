"""Expected frame of a scene under its own light, by either estimator, with its error."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import names, present
from mitsim.bench.request import FEWEST_PASSES, REFERENCE, check_accuracy, check_samples
from mitsim.core.arrays import FloatArray, integer
from mitsim.core.environment import DEFAULT_VARIANT, keep_scenes, load_variant, versions
from mitsim.core.errors import MitsimError, check_arguments
from mitsim.core.exr import write_frame
from mitsim.core.job import Cost, Job
from mitsim.devices.patterns import Lighting
from mitsim.light.cost_model import first_shadow, frames_cost
from mitsim.light.light import Sampling, trace_light
from mitsim.optics.frames import monte_carlo_bound
from mitsim.planner.planner import make_plan, unseen_lamps

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from mitsim.scene.load import LoadedScene

_SAMPLERS = ("IndependentSampler", "OrthogonalSampler")
"""Samplers without correlated dimensions; others of Mitsuba 3.9.1 correlate pairs by 0.15 to 0.8."""
_SAMPLES = 64
"""Default samples per pixel, as in the shipped scenes."""
_UNKNOWN = 1.0
"""Relative noise above which a frame counts as unknown."""
_SAMPLES_A_PASS = 64
"""Samples per pixel of one pass: 2^24 paths of a 512 x 512 sensor fit in memory."""


@dataclass(frozen=True, eq=False)
class Rendered:
    """One frame of irradiance [W m^-2].

    Attributes
    ----------
    mean, error
        (m, m', channels) irradiance and its standard error.
    facts
        estimator, spp (None for factored), seconds, variant, seed, notes (changes of objects, and neglected effects),
        and mc_error_bound (95 % bound of the factored estimator's relative Monte Carlo error).
    warnings
        Reasons why the frame is flagged.
    """

    mean: FloatArray
    error: FloatArray
    facts: Mapping[str, Any]
    warnings: tuple[str, ...] = ()

    @property
    def mc_error(self) -> float:
        """Return ||standard error|| / ||frame||, where the energy of the noise is subtracted from the frame's."""
        noise = float(np.square(self.error).sum())
        energy = float(np.square(self.mean).sum()) - noise
        return math.sqrt(noise / energy) if energy > 0 else math.inf

    def summary(self) -> dict[str, Any]:
        return {**self.facts, "mean": float(self.mean.mean()), "mc_error": self.mc_error, "warnings": self.warnings}

    @check_arguments
    def save(self, path: Path | str) -> Path:
        """Write the frame and its error to the OpenEXR file ``path`` and return it; raise MitsimError if that fails."""
        names = ("Y",) if self.mean.shape[2] == 1 else ("R", "G", "B")
        channels = {name: self.mean[..., i].astype(np.float32) for i, name in enumerate(names)}
        channels |= {f"error.{name}": self.error[..., i].astype(np.float32) for i, name in enumerate(names)}
        facts = {key: self.facts[key] for key in ("estimator", "seed", "variant")}
        write_frame(path, channels, {"unit": "W/m^2", **facts, **versions()})
        return Path(path)

    @check_arguments
    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the mean of the channels with a colour bar on ``ax`` or a new figure, and return the axes."""
        from mitsim.core.images import from_above

        return from_above("report.plots", "draw_rendered")(self, ax)

    def __repr__(self) -> str:
        rows, columns = self.mean.shape[:2]
        return f"Rendered({rows} x {columns}: {self.facts['estimator']}, relative noise {self.mc_error:.1e})"


def reference(loaded: LoadedScene, spp: int, seed: int, job: Job | None = None) -> tuple[FloatArray, FloatArray]:
    """Return (m, m', channels) irradiance [W m^-2] and its standard error, by the scene's own integrator.

    Passes of Owen-scrambled Sobol points are scrambled anew, and their spread gives the error; ``spp`` is at least 4.
    MitsimError is raised for an unsuitable number of samples, an integrator that cannot render this sensor or loses
    light, or work beyond the limits.
    """
    import mitsuba as mi

    from mitsim.scene.outline import one_line

    if loaded.unfit.reference is not None:
        raise loaded.unfit.reference
    if loaded.parting and mi.is_spectral:
        rule = f"{mi.variant()} carries several wavelengths on a path, which this glass parts; use a mono variant"
        raise loaded.parting[0].refusal("type", "'mitsim_glass'", rule)
    check_samples(REFERENCE, spp)
    job = job or Job()
    passes = max(FEWEST_PASSES, math.ceil(spp / _SAMPLES_A_PASS))
    each = math.ceil(spp / passes)
    total: FloatArray | float = 0.0
    squares: FloatArray | float = 0.0
    started = time.perf_counter()
    job.progress("reference", 0.0)
    for index in range(passes):
        child = integer(seed, "reference", index)
        loaded.camera.stratify((integer(seed, "reference points", index), each))
        try:
            with keep_scenes():
                image = np.array(mi.render(loaded.scene, sensor=loaded.camera, spp=each, seed=child), dtype=np.float64)
        except RuntimeError as error:
            cause: BaseException = error
            while cause.__cause__ is not None:  # what Dr.Jit raises says only that something below it failed
                cause = cause.__cause__
            raise MitsimError(
                f"{loaded.path}: Mitsuba cannot render this scene in {mi.variant()}: {one_line(cause)}; change what it "
                "names, or try another --variant"
            ) from None
        finally:
            loaded.camera.stratify(None)
        total, squares = total + image, squares + image**2
        job.progress("reference", (index + 1) / passes)
        if index == 0:
            Cost(seconds=(time.perf_counter() - started) * passes).check(f"{spp} samples a pixel", job.limits)
    mean = np.asarray(total) / passes
    variance = np.maximum(np.asarray(squares) / passes - mean**2, 0) / (passes - 1)
    return mean.reshape(*mean.shape[:2], -1), np.sqrt(variance).reshape(*mean.shape[:2], -1)


@contextmanager
def show_pattern(bench: Apparatus, pattern: FloatArray) -> Iterator[None]:
    """Show a ``pattern`` (n, n) of 0..1 on the projector within the context."""
    import mitsuba as mi

    parameters = mi.traverse(bench.loaded.projector)
    white = np.array(parameters["irradiance.data"])
    grid = bench.loaded.pixels
    texels = np.zeros_like(white)
    rows = slice(grid.first_row, grid.first_row + grid.n)
    columns = slice(grid.first_column, grid.first_column + grid.n)
    texels[rows, columns] = white[rows, columns] * pattern.reshape(grid.n, grid.n, *([1] * (white.ndim - 2)))
    try:
        parameters["irradiance.data"] = mi.TensorXf(texels)
        parameters.update()
        yield
    finally:
        parameters["irradiance.data"] = mi.TensorXf(white)
        parameters.update()


def render(
    bench: Apparatus,
    estimator: str,
    spp: int | None,
    accuracy: float,
    seed: int,
    effects: Mapping[str, bool] | None = None,
    job: Job | None = None,
) -> Rendered:
    job = job or Job()
    check_samples(estimator, spp)
    if spp is None:
        spp = bench.loaded.samples or _SAMPLES
        try:
            check_samples(estimator, spp)
        except MitsimError as wrong:
            raise MitsimError(f"{bench.loaded.path}: sample_count of its sampler, taken for {wrong}") from None
    check_accuracy(accuracy)
    warnings, notes, bound = tuple[str, ...](), tuple[str, ...](), None
    started = time.perf_counter()
    if estimator == REFERENCE:
        if bench.loaded.projector is not None:
            absent = names(lambda effect: effect.in_frames and not effect.in_reference) - {"black-level"}
            left_out = ", ".join(name for name in present(bench) if name in absent)
            notes += (f"the reference leaves out {left_out}; --estimator factored does not",) if left_out else ()
        mean, error = reference(bench.loaded, spp, seed, job)
        warnings = (bench.loaded.unfit.caustics,) if bench.loaded.unfit.caustics else ()
        sampler = bench.loaded.camera.sampler().class_name()
        if sampler not in _SAMPLERS:
            warnings += (
                f"{bench.loaded.path}: the points of sampler {sampler} depend on each other (at 4 paths by 15 to 80 "
                '%), so light over several turns may come out wrong; use <sampler type="independent"/>, the first turn '
                "is stratified anyway",
            )
        if bench.loaded.in_view:
            warnings += (
                f"{bench.loaded.path}: the projector shines on the sensor itself, and the reference has no light of it "
                "but over surfaces, so that is missing; keep it out of the view, or use --estimator factored",
            )
        warnings += tuple(unseen_lamps(bench.loaded, spp * mean.shape[0] * mean.shape[1], "the reference"))
    else:
        uniform = Lighting.uniform(bench.n)
        with job.planning(str(bench.loaded.path), first_shadow(bench, effects or {})):
            plan = make_plan(bench, uniform, accuracy, seed, effects)
        frames_cost(bench, plan.settings, uniform, plan.predicted_seconds).check(str(bench.loaded.path), job.limits)
        with job.clock.stage("transport"):
            light = trace_light(bench, plan, uniform, seed, Sampling(by_pixel=False), job.progress)
        warnings = (*light.warnings, *light.unreached)
        frame = next(iter(light.frames(uniform, seed)))
        bound = monte_carlo_bound([frame])
        mean = frame.irradiance[..., None]
        error = np.full_like(mean, math.sqrt(frame.variance))
    if not mean.any():
        warnings += ("the frame is wholly dark; check the scene's light, the mask and the field stop",)
    facts = {
        "estimator": estimator,
        "spp": spp if estimator == REFERENCE else None,
        "seconds": time.perf_counter() - started,
        "variant": bench.variant,
        "seed": seed,
        "notes": notes,
        "mc_error_bound": bound,
    }
    rendered = Rendered(mean, error, facts, warnings)
    if mean.any() and not rendered.mc_error < _UNKNOWN:
        rule = "too few paths met any light to tell how much there is; give more samples (--spp), or more light"
        return replace(rendered, warnings=(*warnings, f"relative noise {rendered.mc_error:.1e}: {rule}"))
    return rendered


def rendered_psf(
    shape: tuple[int, int], pitch_mm: float, variant: str = DEFAULT_VARIANT, rays: int = 4096, seed: int = 0
) -> FloatArray:
    """Return the light of a distant point behind the default diffuser, with a sum of 1.

    The ``variant`` of Mitsuba is selected for the process.
    """
    load_variant(variant)
    from mitsim.transport.plugins.lens import Diffuser, point_spread

    light = point_spread(Diffuser(), shape, pitch_mm, rays=rays, seed=seed)
    return np.asarray(light / light.sum())

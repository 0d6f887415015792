"""`mitsim render`: one expected frame of a scene under its own light, by the reference or the factored estimator."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.capture.bench import Bench, open_bench
from mitsim.capture.cost import frames_cost
from mitsim.capture.light import collect, make_plan, uniform_light
from mitsim.core.arrays import FloatArray, Progress, silent
from mitsim.core.environment import load_variant
from mitsim.core.errors import MitsimError
from mitsim.core.framefile import write_frame
from mitsim.core.manifest import versions
from mitsim.core.output import prepare_output
from mitsim.core.resources import Cost, Limits
from mitsim.core.seeds import integer
from mitsim.scene.load import LoadedScene, load_scene
from mitsim.transport import plugins

ESTIMATORS = ("reference", "factored")
_SAMPLES_A_PASS = 64
_FEWEST_PASSES = 4
_MOST_SAMPLES = 2**20


@dataclass(frozen=True)
class RenderResult:
    """What `mitsim render` reports: mean irradiance [W m^-2], relative Monte Carlo error of the frame, wall time."""

    estimator: str
    spp: int | None
    mean: float
    mc_error: float
    seconds: float
    variant: str
    seed: int
    output: str
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Rendered:
    """Frame (pixels, pixels, channels) by the reference, and the standard error of each value."""

    mean: FloatArray
    error: FloatArray

    @property
    def mc_error(self) -> float:
        """||standard error|| / ||frame||, with the noise's own energy taken off the frame's."""
        noise = float(np.square(self.error).sum())
        energy = float(np.square(self.mean).sum()) - noise
        return math.sqrt(noise / energy) if energy > 0 else math.inf


def reference(
    loaded: LoadedScene, spp: int, seed: int, progress: Progress = silent, limits: Limits | None = None
) -> Rendered:
    """Render with the scene's own integrator in independent passes, summed in float64.

    Raises
    ------
    MitsimError
        for fewer than 4 samples a pixel: passes are compared to tell the noise; or when the first pass shows that all
        of them would take longer than ``limits`` allow.
    """
    import mitsuba as mi

    if not _FEWEST_PASSES <= spp <= _MOST_SAMPLES:
        raise MitsimError(f"--spp {spp}: give at least {_FEWEST_PASSES} samples a pixel, at most {_MOST_SAMPLES}")
    limits = limits or Limits()
    passes = max(_FEWEST_PASSES, math.ceil(spp / _SAMPLES_A_PASS))
    each = math.ceil(spp / passes)
    total: Any = 0.0
    squares: Any = 0.0
    started = time.perf_counter()
    for index in range(passes):
        child = integer(seed, "reference", index)
        try:
            image = np.array(mi.render(loaded.scene, sensor=loaded.camera, spp=each, seed=child), dtype=np.float64)
        except RuntimeError as error:
            raise MitsimError(
                f"{loaded.path}: the integrator cannot render this sensor ({' '.join(str(error).split())[-200:]}); "
                "use path, direct or volpath"
            ) from None
        total, squares = total + image, squares + image**2
        progress("reference", (index + 1) / passes)
        if index == 0:
            Cost(seconds=(time.perf_counter() - started) * passes).check(f"--spp {spp}", limits)
    mean = total / passes
    variance = np.maximum(squares / passes - mean**2, 0) / (passes - 1)
    return Rendered(mean.reshape(*mean.shape[:2], -1), np.sqrt(variance).reshape(*mean.shape[:2], -1))


@contextmanager
def projected(bench: Bench, pattern: FloatArray) -> Iterator[None]:
    """Show a pattern (n, n) of 0..1 on the scene's projector while the context lasts, for the reference estimator."""
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
    scene: Path,
    output: Path,
    estimator: str = "reference",
    spp: int = 64,
    accuracy: float = 1e-3,
    seed: int = 0,
    variant: str = "llvm_ad_mono",
    defines: Mapping[str, str] | None = None,
    progress: Progress = silent,
    effects: Mapping[str, bool] | None = None,
    limits: Limits | None = None,
    outside: bool = False,
) -> RenderResult:
    """Write one frame of irradiance [W m^-2] and its standard error to ``output``.

    The reference works on any scene with a ``mitsim_lensless`` sensor and any integrator; the factored estimator needs
    a projector too. ``outside`` allows files of the scene outside its folder.

    Raises
    ------
    MitsimError
        for an unknown estimator, a scene that does not load, an output that cannot be written, or a frame that would
        take more memory or time than ``limits`` allow.
    """
    if estimator not in ESTIMATORS:
        raise MitsimError(f"--estimator {estimator!r}: use {' or '.join(ESTIMATORS)}")
    path = prepare_output(output, overwrite=True, kind="file")
    warnings: tuple[str, ...] = ()
    if estimator == "reference":
        mi = load_variant(variant)
        mi.set_log_level(mi.LogLevel.Error)
        plugins.register()
        loaded = load_scene(scene, defines, needs_projector=False, outside=outside)
        started = time.perf_counter()
        frame = reference(loaded, spp, seed, progress, limits)
    else:
        bench = open_bench(scene, variant, defines=defines, check_camera=False, outside=outside)
        started = time.perf_counter()
        uniform = uniform_light(bench.n)
        plan = make_plan(bench, *uniform, accuracy, seed, effects)
        frames_cost(bench, plan.settings, 1, 1, plan.predicted_seconds).check(str(scene), limits or Limits(), path)
        light = collect(bench, plan, *uniform, seed, progress, by_pixel=False)
        warnings = plan.warnings
        found = next(iter(light.frames(*uniform, seed)))
        irradiance = found.irradiance[..., None]
        frame = Rendered(irradiance, np.full_like(irradiance, math.sqrt(found.variance)))
    seconds = time.perf_counter() - started
    if not frame.mean.any():
        warnings += ("the frame is wholly dark; check the scene's light, the mask and the field stop",)
    names = ("Y",) if frame.mean.shape[2] == 1 else ("R", "G", "B")
    channels = {name: frame.mean[..., i].astype(np.float32) for i, name in enumerate(names)}
    channels |= {f"error.{name}": frame.error[..., i].astype(np.float32) for i, name in enumerate(names)}
    metadata: dict[str, str | int | float] = {
        "unit": "W/m^2",
        "estimator": estimator,
        "seed": seed,
        "variant": variant,
        **versions(),
    }
    write_frame(path, channels, metadata)
    return RenderResult(
        estimator=estimator,
        spp=spp if estimator == "reference" else None,
        mean=float(frame.mean.mean()),
        mc_error=frame.mc_error,
        seconds=seconds,
        variant=variant,
        seed=seed,
        output=str(path),
        warnings=warnings,
    )

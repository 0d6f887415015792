"""mitsim: coded light on a scene in, frames of a lensless camera and the images recovered from them out.

>>> import mitsim as ms
>>> bench = ms.open_bench("photograph")
>>> shots = bench.capture("dots:7", accuracy=1e-3)
>>> image = ms.reconstruct(shots, bench.calibrate())
>>> ms.psnr(image.image, shots.truth)

Importing this package imports nothing, selects no Mitsuba variant and touches no global state: names are fetched when
they are first used.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mitsim.capture.bench import Bench
    from mitsim.capture.light import Light
    from mitsim.capture.modelling import calibrate_model
    from mitsim.capture.opening import open_bench
    from mitsim.capture.plan import Plan
    from mitsim.capture.render import Rendered
    from mitsim.capture.request import Request
    from mitsim.core.errors import ArgumentError, MitsimError
    from mitsim.core.job import Clock, Job
    from mitsim.core.mosaics import MosaicCapture, load_mosaic
    from mitsim.core.resources import Limits
    from mitsim.core.runs import Capture, load_run
    from mitsim.reconstruct.factors import Factors, load_calibration
    from mitsim.reconstruct.measured import calibrate_frames
    from mitsim.reconstruct.reconstruction import reconstruct
    from mitsim.reconstruct.result import Reconstruction
    from mitsim.rig.modelling import Modelling
    from mitsim.rig.recipe import load_recipe
    from mitsim.study.calibration_plan import CalibrationPlan, plan_calibration
    from mitsim.study.colour.by_line import reconstruct_colours
    from mitsim.study.metrics import psnr, ssim

__version__ = "0.5.0"

_HOMES = {
    "open_bench": "capture.opening",
    "load_run": "core.runs",
    "load_mosaic": "core.mosaics",
    "load_calibration": "reconstruct.factors",
    "load_recipe": "rig.recipe",
    "calibrate_frames": "reconstruct.measured",
    "calibrate_model": "capture.modelling",
    "plan_calibration": "study.calibration_plan",
    "reconstruct": "reconstruct.reconstruction",
    "reconstruct_colours": "study.colour.by_line",
    "psnr": "study.metrics",
    "ssim": "study.metrics",
    "Bench": "capture.bench",
    "Plan": "capture.plan",
    "Request": "capture.request",
    "Light": "capture.light",
    "Capture": "core.runs",
    "MosaicCapture": "core.mosaics",
    "CalibrationPlan": "study.calibration_plan",
    "Factors": "reconstruct.factors",
    "Reconstruction": "reconstruct.result",
    "Rendered": "capture.render",
    "Modelling": "rig.modelling",
    "Job": "core.job",
    "Clock": "core.job",
    "Limits": "core.resources",
    "MitsimError": "core.errors",
    "ArgumentError": "core.errors",
}
__all__ = [
    "ArgumentError",
    "Bench",
    "CalibrationPlan",
    "Capture",
    "Clock",
    "Factors",
    "Job",
    "Light",
    "Limits",
    "MitsimError",
    "Modelling",
    "MosaicCapture",
    "Plan",
    "Reconstruction",
    "Rendered",
    "Request",
    "calibrate_frames",
    "calibrate_model",
    "load_calibration",
    "load_mosaic",
    "load_recipe",
    "load_run",
    "open_bench",
    "plan_calibration",
    "psnr",
    "reconstruct",
    "reconstruct_colours",
    "ssim",
]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'mitsim' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"mitsim.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


class _Face(ModuleType):
    """This package; ``mitsim.reconstruct`` stays the function when Python imports the room of that name."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Face

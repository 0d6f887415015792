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

from mitsim.version import __version__ as __version__

if TYPE_CHECKING:
    from mitsim.acquire.capture import Light
    from mitsim.acquire.reference import Rendered
    from mitsim.api.bench import Bench, open_bench
    from mitsim.bench.request import Request
    from mitsim.calibrate.model import calibrate_model
    from mitsim.calibrate.plan import CalibrationPlan, plan_calibration
    from mitsim.core.errors import ArgumentError, MitsimError
    from mitsim.core.job import Clock, Job
    from mitsim.core.resources import Limits
    from mitsim.core.runs import Capture, MosaicCapture, load_mosaic, load_run
    from mitsim.devices.session import Modelling, load_recipe
    from mitsim.light.plan import Plan
    from mitsim.metrics import psnr, ssim
    from mitsim.reconstruct.captured_session import calibrate_frames
    from mitsim.reconstruct.factors import Factors, load_calibration
    from mitsim.reconstruct.reconstruct import reconstruct
    from mitsim.reconstruct.result import Reconstruction
    from mitsim.report.line_images import reconstruct_colours

_HOMES = {
    "open_bench": "api.bench",
    "load_run": "core.runs",
    "load_mosaic": "core.runs",
    "load_calibration": "reconstruct.factors",
    "load_recipe": "devices.session",
    "calibrate_frames": "reconstruct.captured_session",
    "calibrate_model": "calibrate.model",
    "plan_calibration": "calibrate.plan",
    "reconstruct": "reconstruct.reconstruct",
    "reconstruct_colours": "report.line_images",
    "psnr": "metrics",
    "ssim": "metrics",
    "Bench": "api.bench",
    "Plan": "light.plan",
    "Request": "bench.request",
    "Light": "acquire.capture",
    "Capture": "core.runs",
    "MosaicCapture": "core.runs",
    "CalibrationPlan": "calibrate.plan",
    "Factors": "reconstruct.factors",
    "Reconstruction": "reconstruct.result",
    "Rendered": "acquire.reference",
    "Modelling": "devices.session",
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

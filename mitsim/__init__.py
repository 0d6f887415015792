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
    from mitsim.acquire.capture import Light as Light
    from mitsim.acquire.reference import Rendered as Rendered
    from mitsim.api.bench import Bench as Bench
    from mitsim.api.bench import flat_scene as flat_scene
    from mitsim.api.bench import open_bench as open_bench
    from mitsim.api.bench import shelf_scene as shelf_scene
    from mitsim.bench.request import Request as Request
    from mitsim.calibrate.model import calibrate_model as calibrate_model
    from mitsim.calibrate.session_plan import CalibrationPlan as CalibrationPlan
    from mitsim.calibrate.session_plan import plan_calibration as plan_calibration
    from mitsim.core.errors import ArgumentError as ArgumentError
    from mitsim.core.errors import MitsimError as MitsimError
    from mitsim.core.job import Clock as Clock
    from mitsim.core.job import Job as Job
    from mitsim.core.job import Limits as Limits
    from mitsim.core.job import progress as progress
    from mitsim.core.runs import Capture as Capture
    from mitsim.core.runs import MosaicCapture as MosaicCapture
    from mitsim.core.runs import load_mosaic as load_mosaic
    from mitsim.core.runs import load_run as load_run
    from mitsim.devices.session import Modelling as Modelling
    from mitsim.devices.session import load_recipe as load_recipe
    from mitsim.exchange.formats import export as export
    from mitsim.exchange.formats import import_file as import_file
    from mitsim.exchange.formats import import_frames as import_frames
    from mitsim.exchange.formats import pattern_pictures as pattern_pictures
    from mitsim.learn.pair_store import PairStore as PairStore
    from mitsim.learn.verbs import load_network as load_network
    from mitsim.learn.verbs import make_pairs as make_pairs
    from mitsim.learn.verbs import train as train
    from mitsim.light.plan import Plan as Plan
    from mitsim.metrics import psnr as psnr
    from mitsim.metrics import ssim as ssim
    from mitsim.reconstruct.captured_session import calibrate_frames as calibrate_frames
    from mitsim.reconstruct.factors import Factors as Factors
    from mitsim.reconstruct.factors import load_calibration as load_calibration
    from mitsim.reconstruct.known_pictures import calibrate_known as calibrate_known
    from mitsim.reconstruct.point_spread_image import reconstruct_psf as reconstruct_psf
    from mitsim.reconstruct.reconstruct import Reconstruction as Reconstruction
    from mitsim.reconstruct.reconstruct import reconstruct as reconstruct
    from mitsim.report.folder_page import report_folder as report_folder
    from mitsim.report.reconstruct_run import reconstruct_colours as reconstruct_colours
    from mitsim.sessions.repeat import session_of as session_of
    from mitsim.sessions.run_session import run as run
    from mitsim.verbs import characterise as characterise
    from mitsim.verbs import demo as demo
    from mitsim.verbs import doctor as doctor
    from mitsim.verbs import scenes as scenes
    from mitsim.verbs import sense as sense
    from mitsim.verbs import study as study

_HOMES = {
    name: home
    for home, names in {
        "acquire.capture": "Light",
        "acquire.reference": "Rendered",
        "api.bench": "Bench flat_scene open_bench shelf_scene",
        "bench.request": "Request",
        "calibrate.model": "calibrate_model",
        "calibrate.session_plan": "CalibrationPlan plan_calibration",
        "core.errors": "ArgumentError MitsimError",
        "core.job": "Clock Job Limits progress",
        "core.runs": "Capture MosaicCapture load_mosaic load_run",
        "devices.session": "Modelling load_recipe",
        "exchange.formats": "export import_file import_frames pattern_pictures",
        "learn.pair_store": "PairStore",
        "learn.verbs": "load_network make_pairs train",
        "light.plan": "Plan",
        "metrics": "psnr ssim",
        "reconstruct.captured_session": "calibrate_frames",
        "reconstruct.factors": "Factors load_calibration",
        "reconstruct.known_pictures": "calibrate_known",
        "reconstruct.point_spread_image": "reconstruct_psf",
        "reconstruct.reconstruct": "Reconstruction reconstruct",
        "report.folder_page": "report_folder",
        "report.reconstruct_run": "reconstruct_colours",
        "sessions.repeat": "session_of",
        "sessions.run_session": "run",
        "verbs": "characterise demo doctor scenes sense study",
    }.items()
    for name in names.split()
}
"""Module of each name of the face."""
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'mitsim' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"mitsim.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


class _Face(ModuleType):
    """Module type whose ``mitsim.reconstruct`` stays the function when Python imports the room of that name."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Face

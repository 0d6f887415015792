"""Experiments: capture, calibrate and reconstruct together, judged against the truth and shown to people."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING

from mitsim.core.errors import MitsimError

if TYPE_CHECKING:
    from mitsim.capture.bench import Bench
    from mitsim.capture.request import Request
    from mitsim.core.job import Job
    from mitsim.study.experiment import Experiment
    from mitsim.study.runner import Findings, Study

STUDIES: Mapping[str, str] = MappingProxyType(
    {
        "accuracy": "accuracy:measure",
        "calibration": "calibration:measure",
        "diffraction": "diffraction:measure",
        "solver": "solver:measure",
    }
)
"""Studies of one bench by name, as ``module:function``; the function takes (bench, request, job) and gives
:class:`mitsim.study.runner.Findings`."""
OF_NO_SCENE = ("solver",)
"""Those whose bench is None."""
EXPOSED = ("calibration", "diffraction")
"""Those whose frames fill a part of the camera's full well."""
PAPER = (
    "patterns",
    "distance",
    "binning",
    "multishot",
    "exposure",
    "resolution",
    "ambient",
    "reflectivity",
    "regularisation",
    "convolutional",
    "depth",
    "separation",
    "waterfall",
)
"""Studies of the paper's experiments, and of what lies beyond them, which `mitsim study all` puts on one page in this
order."""
EXPERIMENTS = (*PAPER, "colour", "drift", "models", "sweep")
"""Studies of many points: modules of :mod:`mitsim.study.paper`, each with its ``EXPERIMENT``."""
ALL = "all"
"""What the study of all experiments of the paper is called."""


def find_study(name: str, **settings: object) -> Study:
    """The study ``name``, to be called with (bench, output, request, job); nothing heavy is imported before the name is
    known to be one, and its folder to be free.

    Parameters
    ----------
    name
        of the study.
    **settings
        further arguments of its function.

    Raises
    ------
    MitsimError
        for another name, with those that there are.
    """
    if name not in STUDIES:
        raise MitsimError(f"study {name!r}: there is no such study; use {', '.join((*STUDIES, *EXPERIMENTS))}")
    from mitsim.study.runner import run_study

    def measure(bench: Bench | None, request: Request, job: Job) -> Findings:
        """What the study finds."""
        module, function = STUDIES[name].split(":")
        found: Findings = getattr(importlib.import_module(f"mitsim.study.{module}"), function)(
            bench, request, job, **settings
        )
        return found

    return partial(run_study, name, measure)


def find_experiment(name: str) -> Experiment:
    """The experiment ``name``, a shipped one or a module of the user's with a dot in its name.

    MitsimError for another name, with those that there are, and for a module without an ``EXPERIMENT``.
    """
    if not is_experiment(name) or name == ALL:
        raise MitsimError(f"study {name!r}: there is no such study; use {', '.join((*STUDIES, *EXPERIMENTS))}")
    module = name if "." in name else f"mitsim.study.paper.{name}"
    try:
        found: Experiment = importlib.import_module(module).EXPERIMENT
    except (ImportError, AttributeError) as error:
        raise MitsimError(
            f"study {name}: the module {module} cannot be used ({error}); it needs an EXPERIMENT"
        ) from error
    return found


def is_experiment(name: str) -> bool:
    """Whether ``name`` is that of a study of many points."""
    return name in (*EXPERIMENTS, ALL) or "." in name

"""Experiments: capture, calibrate and reconstruct together, judged against the truth and shown to people."""

from __future__ import annotations

import importlib
from functools import partial
from typing import TYPE_CHECKING

from mitsim.core.errors import MitsimError
from mitsim.studies.names import ALL, EXPERIMENTS, STUDIES

if TYPE_CHECKING:
    from mitsim.api.bench import Bench
    from mitsim.bench.request import Request
    from mitsim.core.job import Job
    from mitsim.studies.framework.experiment import Experiment
    from mitsim.studies.framework.run import Findings, Study


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
    from mitsim.studies.framework.run import run_study

    def measure(bench: Bench | None, request: Request, job: Job) -> Findings:
        """What the study finds."""
        module, function = STUDIES[name].split(":")
        found: Findings = getattr(importlib.import_module(f"mitsim.studies.{module}"), function)(
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
    module = name if "." in name else f"mitsim.studies.paper.{name}"
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

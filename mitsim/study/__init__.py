"""Experiments: capture, calibrate and reconstruct together, judged against the truth and shown to people."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING

from mitsim.core.errors import MitsimError

if TYPE_CHECKING:
    from mitsim.study.runner import Study

STUDIES: Mapping[str, str] = MappingProxyType({"accuracy": "accuracy:measure", "diffraction": "diffraction:measure"})
"""Studies by name, as ``module:function``; the function takes (bench, request, job) and gives
:class:`mitsim.study.runner.Findings`."""


def find_study(name: str) -> Study:
    """The study ``name``, to be called with (bench, output, request, job); nothing heavy is imported before the name is
    known to be one.

    MitsimError for another name, with those that there are.
    """
    if name not in STUDIES:
        raise MitsimError(f"study {name!r}: there is no such study; use {', '.join(STUDIES)}")
    from mitsim.study.runner import run_study

    module, function = STUDIES[name].split(":")
    return partial(run_study, name, getattr(importlib.import_module(f"mitsim.study.{module}"), function))

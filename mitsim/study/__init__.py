"""Experiments: capture, calibrate and reconstruct together, judged against the truth and shown to people."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

STUDIES: Mapping[str, str] = MappingProxyType(
    {
        "accuracy": "mitsim.study.accuracy:study_accuracy",
        "diffraction": "mitsim.study.diffraction:study_diffraction",
    }
)
"""Studies by name, as ``module:function``; a study takes (bench, output, patterns, seed, progress)."""

"""Names of all studies, and where each lives; nothing heavy is imported to know them."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

STUDIES: Mapping[str, str] = MappingProxyType(
    {
        "accuracy": "accuracy.study:measure",
        "calibration": "calibration:measure",
        "diffraction": "diffraction:measure",
        "solver": "solver:measure",
    }
)
"""Studies of one bench by name, as ``module:function``; the function takes (bench, request, job) and gives
:class:`mitsim.studies.framework.run.Findings`."""
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
"""Studies of many points: modules of :mod:`mitsim.studies.paper`, each with its ``EXPERIMENT``."""
ALL = "all"
"""What the study of all experiments of the paper is called."""

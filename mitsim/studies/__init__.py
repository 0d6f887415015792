"""Experiments: capture, calibrate and reconstruct together, judged against the truth and shown to people.

This file has their names alone. The study NAME is the module ``mitsim.studies.NAME_study``, or one of :data:`SHARED`.
"""

from __future__ import annotations

OF_NO_SCENE = ("twin",)
"""Those whose bench is None."""
OF_CAPTURES = ("learned", "twin")
"""Those of real captures (`--data`)."""
PAPER = (
    "patterns",
    "distance",
    "binning",
    "multishot",
    "exposure",
    "resolution",
    "ambient",
    "reflectivity",
    "convolutional",
    "depth",
    "waterfall",
)
"""Studies of the paper's experiments, and of what lies beyond them, which `mitsim study all` puts on one page in this
order."""
EXPERIMENTS = (*PAPER, "accuracy", "calibration", "colour", "drift", "learned", "sweep", "twin")
"""Studies of many points: their modules have a ``STUDY``. ``learned`` is not on the page of all: it takes hours,
and torch, which may be missing."""
SHARED = {
    **dict.fromkeys(("distance", "binning", "resolution", "depth"), "camera_studies"),
    **dict.fromkeys(("patterns", "exposure", "ambient", "reflectivity"), "light_studies"),
    **dict.fromkeys(("multishot", "convolutional"), "other_cameras"),
}
"""Modules of several studies of many points, whose ``STUDIES`` have each by its name."""
GONE = {
    **dict.fromkeys(("diffraction", "models"), "calibration SCENE"),
    "regularisation": "sweep SCENE --over method=tikhonov,tv",
    "separation": "reflectivity",
    "transfer": "learned --data DIR",
}
"""Names of studies that became part of others, and the arguments of `mitsim study` that replace them."""
ALL = "all"
"""What the study of all experiments of the paper is called."""

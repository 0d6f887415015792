"""Experiments: capture, calibrate and reconstruct together, judged against the truth.

The study NAME is the module ``mitsim.studies.NAME_study``, or one of :data:`SHARED`.
"""

from __future__ import annotations

OF_NO_SCENE = ("twin",)
OF_CAPTURES = ("learned", "twin")
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
"""Studies that `mitsim study all` puts on one page, in this order."""
EXPERIMENTS = (*PAPER, "accuracy", "calibration", "colour", "drift", "learned", "sweep", "twin")
"""Studies of many points, whose modules have a ``STUDY``. The page of all lacks ``learned``, because it takes hours and
needs torch."""
SHARED = {
    **dict.fromkeys(("distance", "binning", "resolution", "depth"), "camera_studies"),
    **dict.fromkeys(("patterns", "exposure", "ambient", "reflectivity"), "light_studies"),
    **dict.fromkeys(("multishot", "convolutional"), "other_cameras"),
}
"""Modules of several studies, whose ``STUDIES`` have each by its name."""
GONE = {
    "diffraction": "study calibration SCENE",
    "models": "calibrate SCENE --model wave",
    "regularisation": "study sweep SCENE --over method=tikhonov,tv",
    "transfer": "study learned --data DIR",
}
"""Former studies, and the command that replaces each."""
ALL = "all"

"""Experiments: capture, calibrate and reconstruct together, judged against the truth.

The study NAME is the module ``mitsim.studies.NAME_study``, or one of :data:`SHARED`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from mitsim.core.errors import MitsimError
from mitsim.core.files import check_plain

OF_NO_SCENE = ("twin",)
OF_CAPTURES = ("learned", "twin")
PAPER = (
    "patterns", "distance", "binning", "multishot", "exposure", "resolution", "ambient", "reflectivity",
    "convolutional", "depth", "waterfall",
)  # fmt: skip
"""Studies that `mitsim study all` puts on one page, in this order."""
EXPERIMENTS = (*PAPER, "accuracy", "calibration", "colour", "design", "drift", "learned", "sweep", "twin", "volume")
"""Studies of many points, whose modules have a ``STUDY``. The page of all lacks ``learned``, because it takes hours and
needs torch."""
SHARED = {
    **dict.fromkeys(("distance", "binning", "resolution", "depth", "volume"), "camera_studies"),
    **dict.fromkeys(("patterns", "exposure", "ambient", "reflectivity"), "light_studies"),
    **dict.fromkeys(("multishot", "convolutional"), "other_cameras"),
}
"""Modules of several studies, whose ``STUDIES`` have each by its name."""
GONE = {
    "diffraction": "study calibration SCENE",
    "models": "calibrate SCENE --model wave",
    "regularisation": "study sweep SCENE --over method=tikhonov,tv",
    "separation": "study reflectivity",
    "transfer": "study learned --data DIR",
}
"""Former studies, and the command that replaces each."""
ALL = "all"

Captures = Mapping[str, tuple[Path, Path]]
"""Raw frame and authors' image by the capture's name."""


def find_files(folder: Path | None, study: str = "twin") -> tuple[Captures, Path | None]:
    """Return the captures and the point spread function in a ``folder``; MitsimError where there are too few."""
    sources = "flatcam/fc_6.png, rec_6.png, .. of github.com/siddiquesalman/flatnet"
    if study == "twin":
        sources += ", diffusercam/psf_sample.tif of github.com/Waller-Lab/DiffuserCam-Tutorial, or one of both"
    if folder is None or not folder.is_dir():
        given = "needs real captures" if folder is None else f"--data {folder}: there is no such folder"
        raise MitsimError(f"study {study}: {given}; give --data FOLDER with {sources}")
    frames = sorted((folder / "flatcam").glob("fc_*.png"))
    captures = {frame.stem: (frame, frame.with_name(f"rec_{frame.stem[3:]}.png")) for frame in frames}
    psf = folder / "diffusercam" / "psf_sample.tif"
    seen = study == "twin" and psf.exists()
    for file in (*(each for pair in captures.values() for each in pair), *([psf] if seen else ())):
        check_plain(file, "capture")
    if not captures and not seen:
        raise MitsimError(f"--data {folder}: has no captures; give a folder with {sources}")
    if len(captures) == 1:
        raise MitsimError(
            f"--data {folder}: has one capture of a FlatCam, and its mask is learned from others; give a second and "
            "its image"
        )
    return captures, psf if seen else None

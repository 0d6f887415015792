"""Files of real captures for `mitsim study twin` and `transfer`, in folders named as the public repositories.

* ``flatcam``: raw captures ``fc_6.png``, .. of a FlatCam behind a Bayer sensor, and their authors' images of them,
  ``rec_6.png``, .. (siddiquesalman/flatnet on GitHub);
* ``diffusercam``: the point spread function of a DiffuserCam, ``psf_sample.tif`` (Waller-Lab/DiffuserCam-Tutorial).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mitsim.core.errors import MitsimError
from mitsim.core.files import check_plain

FLATCAM, DIFFUSERCAM = "flatcam", "diffusercam"
PSF = "psf_sample.tif"
SOURCES = (
    f"{FLATCAM}/fc_6.png, rec_6.png, .. of github.com/siddiquesalman/flatnet, {DIFFUSERCAM}/{PSF} of "
    "github.com/Waller-Lab/DiffuserCam-Tutorial, or one of both"
)


@dataclass(frozen=True)
class TwinFiles:
    """Raw frame and authors' image by the capture's name, and a DiffuserCam's point spread function or None."""

    captures: dict[str, tuple[Path, Path]]
    psf: Path | None

    @classmethod
    def find(cls, folder: Path | None, study: str = "twin") -> TwinFiles:
        """Return the files in a ``folder`` for a ``study``; MitsimError where there are too few."""
        if folder is None:
            raise MitsimError(f"study {study}: needs real captures; give --data FOLDER with {SOURCES}")
        if not folder.is_dir():
            raise MitsimError(f"--data {folder}: there is no such folder; give one with {SOURCES}")
        frames = sorted((folder / FLATCAM).glob("fc_*.png"))
        captures = {frame.stem: (frame, frame.with_name(f"rec_{frame.stem[3:]}.png")) for frame in frames}
        psf = folder / DIFFUSERCAM / PSF
        found = cls(captures, psf if psf.exists() else None)
        for file in (*(each for pair in captures.values() for each in pair), *([found.psf] if found.psf else ())):
            check_plain(file, "capture")
        if not captures and found.psf is None:
            raise MitsimError(f"--data {folder}: has no captures; give a folder with {SOURCES}")
        if len(captures) == 1:
            raise MitsimError(
                f"--data {folder}: has one capture of a FlatCam, and its mask is learned from others; give a second "
                "and its image"
            )
        return found

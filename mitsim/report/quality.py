"""`mitsim reconstruct`: a RUN and a CAL folder in, the image written, and compared with the truth if there is one.

It stands alone so that an image starts without what pages and figures load.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from mitsim.core.files import output_folder
from mitsim.core.runs import load_run
from mitsim.metrics import Quality, truth_error_for, truth_for
from mitsim.reconstruct.factors import load_calibration
from mitsim.reconstruct.reconstruct import Reconstruction, may_replace
from mitsim.reconstruct.reconstruct import reconstruct as solve
from mitsim.reconstruct.request import ImageRequest


@dataclass(frozen=True)
class Judged:
    """A reconstruction, its quality (None for frames without a truth), and the folder ``output`` that holds it."""

    reconstruction: Reconstruction
    quality: Quality | None
    output: str

    def summary(self) -> dict[str, Any]:
        """All but the image, by the keys of the command line's JSON."""
        measured = {"psnr": self.quality and self.quality.psnr_db, "ssim": self.quality and self.quality.ssim}
        error = self.quality and self.quality.truth_error
        return {**measured, "truth_error": error, **self.reconstruction.summary(), "output": self.output}


def reconstruct(
    run: Path | str,
    calibration: Path | str,
    output: Path | str,
    lam: float | Literal["auto"] = "auto",
    method: str = "tikhonov",
    overwrite: bool = False,
    **place: Any,
) -> Judged:
    """Recover the image of a run with a calibration; writes image.exr, image.png and result.json.

    MitsimError for folders that do not fit, an unknown method, lambda, focus or margin, or an output that cannot be
    written.

    Parameters
    ----------
    run, calibration, output
        RUN and CAL folders, and one for the image: new or empty, or with an earlier image of the same inputs.
    lam, method
        as for :func:`mitsim.reconstruct.reconstruct.reconstruct`.
    overwrite
        whether an earlier image of other inputs may be replaced.
    **place
        ``focus``, ``margin`` and ``depth_range``, as there.
    """
    started = time.perf_counter()
    shots, factors = load_run(run), load_calibration(calibration)
    factors.check_fit(shots)
    board = factors.manifest.board_reflectance
    truth, truth_error = truth_for(shots, board), truth_error_for(shots, board)
    replaces = may_replace(Path(output), ImageRequest(lam, method, **place).inputs(shots, factors), overwrite)
    with output_folder(output, overwrite=replaces) as folder:
        read = time.perf_counter() - started
        image = solve(shots, factors, lam, method, **place)
        judged = Judged(
            reconstruction=replace(image, seconds={"read": read, **image.seconds}),
            quality=None if truth is None else Quality.of(image.image, truth, truth_error),
            output=str(folder),
        )
        judged.reconstruction.write(folder, judged.summary())
    return judged

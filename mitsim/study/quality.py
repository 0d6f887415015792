"""`mitsim reconstruct`: a RUN and a CAL folder in, the image written, and compared with the truth if there is one."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from mitsim.core.output import output_folder
from mitsim.core.runs import load_run
from mitsim.reconstruct.factors import load_calibration
from mitsim.reconstruct.reconstruction import Reconstruction, inputs, may_replace
from mitsim.reconstruct.reconstruction import reconstruct as solve
from mitsim.study.metrics import SSIM_WINDOW, psnr, ssim, truth_for


@dataclass(frozen=True)
class Judged:
    """A reconstruction with its quality: ``psnr`` [dB] and ``ssim`` are None for frames without a truth, ``ssim`` also
    for images smaller than its window; ``output`` is the folder that holds it."""

    reconstruction: Reconstruction
    psnr: float | None
    ssim: float | None
    output: str

    def summary(self) -> dict[str, Any]:
        """All but the image, by the keys of the command line's JSON."""
        return {"psnr": self.psnr, "ssim": self.ssim, **self.reconstruction.summary(), "output": self.output}


def reconstruct(
    run: Path | str,
    calibration: Path | str,
    output: Path | str,
    lam: float | Literal["auto"] = "auto",
    method: str = "tikhonov",
    overwrite: bool = False,
) -> Judged:
    """Recover the image of a run with a calibration; writes image.exr, image.png and result.json.

    Parameters
    ----------
    run, calibration
        RUN and CAL folders.
    output
        folder for the image: new or empty, or with an earlier image of the same inputs.
    lam, method
        as for :func:`mitsim.reconstruct.reconstruction.reconstruct`.
    overwrite
        whether an earlier image of other inputs may be replaced.

    Raises
    ------
    MitsimError
        for folders that do not fit each other, an unknown method or lambda, or an output that cannot be written.
    """
    started = time.perf_counter()
    shots, factors = load_run(run), load_calibration(calibration)
    factors.check_fit(shots)
    truth = truth_for(shots, factors.manifest.board_reflectance)
    replaces = may_replace(Path(output), inputs(shots, factors, lam, method), overwrite)
    with output_folder(output, overwrite=replaces) as folder:
        read = time.perf_counter() - started
        image = solve(shots, factors, lam, method)
        judged = Judged(
            reconstruction=replace(image, seconds={"read": read, **image.seconds}),
            psnr=None if truth is None else psnr(image.image, truth),
            ssim=None if truth is None or min(truth.shape) < SSIM_WINDOW else ssim(image.image, truth),
            output=str(folder),
        )
        judged.reconstruction.write(folder, judged.summary())
    return judged

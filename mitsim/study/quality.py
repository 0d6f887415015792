"""`mitsim reconstruct` as a study sees it: solve, compare with the truth where there is one, write the image."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib import image as matplotlib_image

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.framefile import write_frame
from mitsim.core.manifest import write_json
from mitsim.core.output import output_folder, whole_file
from mitsim.reconstruct.folders import check_fit, inherited, load, read_calibration, read_run, solve, verify
from mitsim.reconstruct.solver import Solution
from mitsim.study.metrics import TRUTH_FILE, psnr, read_truth, ssim

IMAGE_FILE = "image.exr"


@dataclass(frozen=True)
class ReconstructionResult:
    """What `mitsim reconstruct` reports; ``psnr`` [dB] and ``ssim`` are None for frames without a truth."""

    image: FloatArray
    psnr: float | None
    ssim: float | None
    lam: float
    rank: int
    condition: float
    residual: float
    ok: bool
    status: str
    seconds: dict[str, float]
    output: str


def reconstruct(
    run: Path | str,
    calibration: Path | str,
    output: Path | str,
    lam: float | Literal["auto"] = "auto",
    method: str = "tikhonov",
) -> ReconstructionResult:
    """Recover the image of a run with a calibration; writes image.exr, image.png and result.json to ``output``.

    Raises
    ------
    MitsimError
        for folders that do not fit each other, an unknown method or lambda, or an output that cannot be written.
    """
    started = time.perf_counter()
    if method not in ("tikhonov", "tv"):
        raise MitsimError(f"--method {method!r}: use tikhonov or tv")
    measurements, factors = read_run(run), read_calibration(calibration)
    check_fit(measurements, factors, calibration)
    truth = None
    if (Path(run) / TRUTH_FILE).is_file():
        verify(Path(run), TRUTH_FILE, measurements.manifest.checksums, "remove it, or capture again with --resume")
        truth = read_truth(Path(run), factors.manifest.board_reflectance)
    # Only an earlier result is replaced: image.exr is the first file of one.
    with output_folder(output, overwrite=(Path(output) / IMAGE_FILE).is_file()) as folder:
        read = time.perf_counter()
        prepared, frames = load(measurements, factors)
        added = time.perf_counter()
        solution = solve(prepared, frames, lam, method)
        solved = time.perf_counter()
        flags = inherited(measurements, factors)
        result = ReconstructionResult(
            image=solution.image,
            psnr=psnr(solution.image, truth) if truth is not None else None,
            ssim=ssim(solution.image, truth) if truth is not None else None,
            lam=solution.lam if isinstance(solution, Solution) else solution.weight,
            rank=prepared.rank,
            condition=prepared.condition,
            residual=solution.residual,
            ok=solution.ok and not flags,
            status=" ".join((solution.status, *flags)),
            seconds={"read": read - started, "accumulate": added - read, "solve": solved - added},
            output=str(folder),
        )
        _write(folder, result, method)
    return result


def summary(result: ReconstructionResult) -> dict[str, object]:
    """The report of a reconstruction without its image, by the keys of the command line's JSON."""
    return {
        "psnr": result.psnr,
        "ssim": result.ssim,
        "lambda": result.lam,
        "rank": result.rank,
        "condition": result.condition,
        "residual": result.residual,
        "status": result.status,
        "seconds": {**result.seconds, "total": sum(result.seconds.values())},
        "output": result.output,
    }


def _write(folder: Path, result: ReconstructionResult, method: str) -> None:
    write_frame(folder / IMAGE_FILE, {"reflectance": result.image.astype(np.float32)}, {"method": method})
    # Display only: clipped to 0..1 and with the sRGB curve's approximate 1/2.2.
    display = np.clip(result.image, 0, 1) ** (1 / 2.2)
    with whole_file(folder / "image.png") as part:
        matplotlib_image.imsave(part, display, cmap="gray", vmin=0, vmax=1, format="png")
    write_json(folder / "result.json", summary(result))

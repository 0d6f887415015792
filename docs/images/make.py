"""The picture of the README, from nothing but mitsim's own commands: truth, one frame, and two reconstructions.

    python docs/images/make.py WORK

Commands run in the folder WORK, which is made; results of an earlier call found there are used again.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mitsim.core.framefile import read_frame
from mitsim.core.pictures import lightness

COMMANDS = {
    "run": ("capture", "photograph", "--patterns", "dots:7"),
    "run-uniform": ("capture", "photograph", "--patterns", "uniform"),
    "cal": ("calibrate", "photograph"),
}


def main() -> None:
    work = Path(sys.argv[1])
    work.mkdir(exist_ok=True)
    for folder, command in COMMANDS.items():
        if not (work / folder).exists():
            mitsim(work, *command, "-o", folder)
    psnr = {}
    for run in ("run-uniform", "run"):
        mitsim(work, "reconstruct", run, "--calibration", "cal")
        psnr[run] = json.loads((work / run / "reconstruction" / "result.json").read_text())["psnr"]

    def image(path: str, channel: str = "reflectance") -> np.ndarray:
        return read_frame(work / path)[0][channel].astype(float)

    frame = image("run/frame_00024.exr", "DN")
    panels = (
        ("The scene (truth)", lightness(image("run/truth.exr"))),
        ("What the camera records: frame 25 of 49", frame / frame.max()),
        (
            f"Uniform light, 1 frame: {psnr['run-uniform']:.1f} dB",
            lightness(image("run-uniform/reconstruction/image.exr")),
        ),
        (f"Shifting dots, 49 frames: {psnr['run']:.1f} dB", lightness(image("run/reconstruction/image.exr"))),
    )
    figure = Figure(figsize=(12, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (title, values) in zip(figure.subplots(1, 4), panels, strict=True):
        axes.imshow(values, cmap="gray", vmin=0, vmax=1, interpolation="none")
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()
    figure.savefig(Path(__file__).with_name("demo.png"), dpi=120)


def mitsim(work: Path, *arguments: str) -> None:
    """Run a verb of mitsim in ``work``; an exit status above 1 ends the script."""
    program = [sys.executable, "-m", "mitsim", *arguments, "--quiet"]
    if subprocess.run(program, cwd=work, check=False).returncode > 1:
        raise SystemExit(2)


if __name__ == "__main__":
    main()

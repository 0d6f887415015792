"""The pictures of the README, from nothing but mitsim's own commands: a demo, and a scene of many depths.

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
    "bag": ("capture", "cookie_bag", "--patterns", "dots:7x16"),
}
Panel = tuple[str, np.ndarray]
"""Title, and image (n, n) as it is shown: numbers in 0..1 in grey, anything else is a depth [mm]."""


def main() -> None:
    work = Path(sys.argv[1])
    work.mkdir(exist_ok=True)
    for folder, command in COMMANDS.items():
        if not (work / folder).exists():
            mitsim(work, *command, "-o", folder)
    psnr = {}
    for run, focus in (("run-uniform", ()), ("run", ()), ("bag", ()), ("bag", ("--focus", "map"))):
        folder = f"{run}-image{'-map' if focus else ''}"
        mitsim(work, "reconstruct", run, "--calibration", "cal", *focus, "-o", folder)
        psnr[folder] = json.loads((work / folder / "result.json").read_text())["psnr"]

    def image(path: str, channel: str = "reflectance") -> np.ndarray:
        return read_frame(work / path)[0][channel].astype(float)

    frame = image("run/frame_00024.exr", "DN")
    draw(
        "demo",
        ("The scene (truth)", lightness(image("run/truth.exr"))),
        ("What the camera records: frame 25 of 49", frame / frame.max()),
        (
            f"Uniform light, 1 frame: {psnr['run-uniform-image']:.1f} dB",
            lightness(image("run-uniform-image/image.exr")),
        ),
        (f"Shifting dots, 49 frames: {psnr['run-image']:.1f} dB", lightness(image("run-image/image.exr"))),
    )
    draw(
        "depth",
        ("The scene (truth)", lightness(image("bag/truth.exr"))),
        (f"One depth: {psnr['bag-image']:.1f} dB", lightness(image("bag-image/image.exr"))),
        (f"A depth for each pixel: {psnr['bag-image-map']:.1f} dB", lightness(image("bag-image-map/image.exr"))),
        ("These depths [mm]", image("bag-image-map/depth.exr", "depth_mm")),
    )


def draw(name: str, *panels: Panel) -> None:
    """The picture ``name`` of four ``panels``."""
    figure = Figure(figsize=(12, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (title, values) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        if values.max() <= 1:
            axes.imshow(values, cmap="gray", vmin=0, vmax=1, interpolation="none")
        else:
            figure.colorbar(axes.imshow(values, cmap="viridis_r", interpolation="none"), ax=axes, shrink=0.8)
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()
    figure.savefig(Path(__file__).with_name(f"{name}.png"), dpi=120)


def mitsim(work: Path, *arguments: str) -> None:
    """Run a verb of mitsim in ``work``; an exit status above 1 ends the script."""
    program = [sys.executable, "-m", "mitsim", *arguments, "--quiet"]
    if subprocess.run(program, cwd=work, check=False).returncode > 1:
        raise SystemExit(2)


if __name__ == "__main__":
    main()

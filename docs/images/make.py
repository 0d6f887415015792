"""The pictures of README, docs/tour.md, docs/bench.md and docs/gallery.md, from nothing but mitsim's own commands.

    python docs/images/make.py WORK [demo] [depth] [bench] [pictures] [gallery]
    python docs/images/make.py WORK flatcam diffusercam

All of the first line, or those that are named; *gallery* runs the commands of docs/gallery.md. Commands run in the
folder WORK, which is made; runs of an earlier call found there are used again. Those of the second are of what the
walks of docs/bench.md left in WORK.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from mitsim.core.exr import read_frame
from mitsim.core.images import lightness
from mitsim.learn.pairs import DrawnPictures

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = {
    "run": ("capture", "photograph", "--patterns", "dots:7"),
    "run-uniform": ("capture", "photograph", "--patterns", "uniform"),
    "cal": ("calibrate", "photograph"),
    "bag": ("capture", "cookie_bag", "--patterns", "dots:7x16"),
    "dots": ("patterns", "dots:7"),
    "stripes": ("patterns", "stripes", "--camera", "imx249", "--exposure", "0.006"),
}
TILES = {
    "view": "view.png",
    "patterns": "dots/patterns/pattern_00024.png",
    "capture": "run/pictures/frame.png",
    "calibrate": "cal/pictures/left.png",
    "reconstruct": "image/pictures/image.png",
    "uncertainty": "image/pictures/uncertainty.png",
    "truth": "bag/pictures/truth.png",
    "depth": "depths/pictures/depth.png",
    "highlight": "card/pictures/truth.png",
    "ambient": "lamp/pictures/ambient.png",
    "colour": "coloured/pictures/image.png",
    "sweep": "sweep/images.png",
    "flatcam": "run7/gb/pictures/frames.png",
    "diffuser": "seen/pictures/image.png",
}
"""What a tile of docs/gallery.md shows of what its commands wrote."""
PARTS = {
    "view": (0.768, 0.722, 0.94, 0.97),
    "patterns": (0.4375, 0.375, 0.5625, 0.625),
    "sweep": (0, 0.34, 1, 1),
    "network": (0, 0, 0.508, 1),
}
"""Left, upper, right and lower end of the part that a tile shows, in pictures, because the whole is not legible."""
WIDEST = 560
"""Pixels of a tile's picture: two for each of a tile's on the page, nearly."""
LARGEST = 60_000
"""Bytes of a tile's picture, so that the page loads at once."""
Panel = tuple[str, np.ndarray]
"""Title, and image (n, n) as it is shown: numbers in 0..1 in grey or of red, green and blue, else a depth [mm]."""


def main() -> None:
    work, names = Path(sys.argv[1]), sys.argv[2:]
    work.mkdir(exist_ok=True)
    if not names or "gallery" in names:
        gallery(work)
    for picture in (demo, depth, bench, pictures, flatcam, diffusercam):
        if picture.__name__ in (names or ("demo", "depth", "bench", "pictures")):
            draw(picture.__name__, *picture(work))


def demo(work: Path) -> list[Panel]:
    """One depth, and what dots gain over uniform light."""
    made(work, "run-uniform", "run", "cal")
    uniform, dots = (psnr(work, run) for run in ("run-uniform", "run"))
    frame = image(work, "run/frame_00024.exr", "DN")
    return [
        ("The scene (truth)", lightness(image(work, "run/truth.exr"))),
        ("What the camera records: frame 25 of 49", frame / frame.max()),
        (f"Uniform light, 1 frame: {uniform:.1f} dB", lightness(image(work, "run-uniform-image/image.exr"))),
        (f"Shifting dots, 49 frames: {dots:.1f} dB", lightness(image(work, "run-image/image.exr"))),
    ]


def depth(work: Path) -> list[Panel]:
    """Many depths, reconstructed at one and at a depth for each pixel."""
    made(work, "bag", "cal")
    one, each = psnr(work, "bag"), psnr(work, "bag", "--focus", "map")
    return [
        ("The scene (truth)", lightness(image(work, "bag/truth.exr"))),
        (f"One depth: {one:.1f} dB", lightness(image(work, "bag-image/image.exr"))),
        (f"A depth for each pixel: {each:.1f} dB", lightness(image(work, "bag-image-map/image.exr"))),
        ("These depths [mm]", image(work, "bag-image-map/depth.exr", "depth_mm")),
    ]


def bench(work: Path) -> list[Panel]:
    """What a projector shows, what a camera records, and what comes of it."""
    made(work, "run", "cal", "dots", "stripes")
    frame, found = image(work, "run/frame_00024.exr", "DN"), psnr(work, "run")
    return [
        ("On the board: pattern 13 of 512", lit(work / "stripes/patterns/pattern_00012.png")),
        ("On the object: pattern 25 of 49", lit(work / "dots/patterns/pattern_00024.png")),
        ("The frame under it", frame / frame.max()),
        (f"The image of all 49 frames: {found:.1f} dB", lightness(image(work, "run-image/image.exr"))),
    ]


def flatcam(work: Path) -> list[Panel]:
    """A raw capture, and its images by factors that another capture told and by its authors' calibration."""
    raw = picture(work / "captures/flatcam/fc_7.png")[::2, 1::2]  # as a mosaic it would be a grid of dots
    return [
        ("Green plane of the raw capture", (raw - raw.min()) / (raw.max() - raw.min())),
        ("Image by what another capture told", picture(work / "run7/reconstruction/image.png")),
        ("The authors' image", lightness(picture(work / "captures/flatcam/rec_7.png"))),
    ]


def diffusercam(work: Path) -> list[Panel]:
    """The light of a point, a raw capture and the image."""
    light, raw = (picture(work / f"captures/diffusercam/{name}.tif") for name in ("psf_sample", "rawdata_hand_sample"))
    return [
        ("Light of one point", light / light.max()),
        ("Raw capture", raw / raw.max()),
        ("Image", picture(work / "hand/reconstruction/image.png")),
    ]


def tiles() -> dict[str, list[str]]:
    """Commands after `mitsim` of each tile of docs/gallery.md, by the name of its picture."""
    page = ROOT.joinpath("docs/gallery.md").read_text(encoding="utf-8")
    found = re.findall(r"\(images/gallery/(\w+)\.png\)(.*?)^</div>", page, flags=re.M | re.S)
    return {name: re.findall(r"^    \$ mitsim (.*)$", text, flags=re.M) for name, text in found}


def gallery(work: Path) -> None:
    """Small pictures of what the commands of docs/gallery.md write; what is there already is used."""
    if not (work / "captures").exists():
        (work / "captures").symlink_to(ROOT / "captures")
    shrink(ROOT / "docs/images/learned.png", "network")  # of a training of an hour
    for name, commands in tiles().items():
        for command in map(shlex.split, commands):
            if "-o" not in command or not (work / command[command.index("-o") + 1]).exists():
                mitsim(work, *command)
        if name == "view":
            shutil.copyfile(work / TILES[name], ROOT / "docs/images/view.png")  # the tour shows it whole
        if name in TILES:
            shrink(work / TILES[name], name)


def shrink(path: Path, name: str) -> None:
    """Write the tile ``name`` of the picture at ``path``, with as many greys or colours as ``LARGEST`` allows.

    A tile shows one of ``PARTS``, or the left square of a long picture.
    """
    smaller, shown = ROOT / f"docs/images/gallery/{name}.png", Image.open(path).convert("RGB")
    if name in PARTS:
        left, upper, right, lower = PARTS[name]
        shown = shown.crop(
            tuple(round(end * side) for end, side in zip((left, upper, right, lower), shown.size * 2, strict=True))
        )
        if shown.width < WIDEST / 2:
            shown = shown.resize((2 * shown.width, 2 * shown.height), Image.Resampling.LANCZOS)
    elif shown.width > 3 * shown.height:
        shown = shown.crop((0, 0, shown.height, shown.height)).resize((WIDEST, WIDEST), Image.Resampling.NEAREST)
    shown.thumbnail((WIDEST, WIDEST), Image.Resampling.LANCZOS)
    for colours in (256, 128, 64, 32, 16):
        shown.quantize(colours).save(smaller, optimize=True)
        if smaller.stat().st_size < LARGEST:
            return
    raise SystemExit(f"{path}: no {LARGEST} bytes are enough for it")


def lit(path: Path) -> np.ndarray:
    """A number for each cell of a projector's picture: of the part that `white.png` beside it lights."""
    rows, columns = (np.flatnonzero(picture(path.with_name("white.png")).any(axis=axis)) for axis in (1, 0))
    cells = (side[side.size // 256 :: side.size // 128] for side in (rows, columns))  # the middle of each of 128
    return picture(path)[np.ix_(*cells)]


def picture(path: Path) -> np.ndarray:
    """Numbers of a picture of 8 or 16 bits over the largest that it may hold."""
    values = np.array(Image.open(path))
    return values / np.iinfo(values.dtype).max


def pictures(_: Path) -> list[Panel]:
    """What networks learn from."""
    return [(f"Picture {number}", DrawnPictures(0).draw(number, 128) / 255) for number in (1, 3, 5, 8, 14)]


def made(work: Path, *folders: str) -> None:
    """Run the commands of the ``folders`` that are not there yet."""
    for folder in folders:
        if not (work / folder).exists():
            mitsim(work, *COMMANDS[folder], "-o", folder)


def psnr(work: Path, run: str, *focus: str) -> float:
    """PSNR [dB] of the image of a ``run``, which is made."""
    folder = f"{run}-image{'-map' if focus else ''}"
    mitsim(work, "reconstruct", run, "--calibration", "cal", *focus, "-o", folder)
    return float(json.loads((work / folder / "result.json").read_text())["psnr"])


def image(work: Path, path: str, channel: str = "reflectance") -> np.ndarray:
    """A channel of an OpenEXR file."""
    return read_frame(work / path)[0][channel].astype(float)


def draw(name: str, *panels: Panel) -> None:
    """The picture ``name`` of some ``panels``, their titles as text in the file too."""
    figure = Figure(figsize=(3 * len(panels), 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (title, values) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        if values.max() <= 1:
            axes.imshow(values, cmap="gray", vmin=0, vmax=1, interpolation="none")
        else:
            figure.colorbar(axes.imshow(values, cmap="viridis_r", interpolation="none"), ax=axes, shrink=0.8)
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()
    titles = {"Description": "; ".join(title for title, _ in panels)}
    figure.savefig(Path(__file__).with_name(f"{name}.png"), dpi=120, metadata=titles)


def mitsim(work: Path, *arguments: str) -> None:
    """Run a verb of mitsim in ``work``; an exit status above 1 ends the script."""
    program = [sys.executable, "-m", "mitsim", *arguments, "--quiet"]
    if subprocess.run(program, cwd=work, check=False).returncode > 1:
        raise SystemExit(2)


if __name__ == "__main__":
    main()

"""The walks of docs/bench.md, by their own commands: from files of a camera alone to an image."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import mitsim as ms
from mitsim.core.exr import read_frame
from mitsim.core.images import lightness
from tests.system.refusals import Call
from tests.taken import RealBench
from tests.test_docs import blocks, examples, figures

PAGE = "docs/bench.md"


def pictures(folder: Path) -> list[Path]:
    """What the projector shows, in order."""
    return sorted((folder / "patterns").glob("pattern_*.png"))


def files(folder: Path, count: int, ending: str) -> list[Path]:
    """Names as a camera counts."""
    return [folder / f"shot {index + 7}.{ending}" for index in range(count)]


@pytest.mark.slow
def test_a_bench_of_ones_own_leads_to_an_image(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variant: str
) -> None:
    """Every command, with the page's devices; frames are taken when their pictures are drawn. The image is as good as
    one of a run that mitsim captured and calibrated itself, with the same noise (49.8 dB)."""
    monkeypatch.chdir(tmp_path)
    for name, text in zip(("camera", "projector"), blocks(PAGE, "toml"), strict=False):
        Path(f"{name}.toml").write_text(text)
    bench = ms.open_bench("photograph", camera="camera.toml")
    real = RealBench.of(bench, 1e-3)
    assert real.white(real.board) == pytest.approx(0.006, rel=0.2), "the page's exposure"

    def take() -> None:
        """All frames of whose pictures there are none."""
        if Path("stripes").is_dir() and not Path("board").exists():
            shown = pictures(Path("stripes"))
            real.take(real.board, shown, 0.006, files(Path("board"), len(shown), "tif"))
            shutil.copy("stripes/session.json", "board")
        if Path("dots").is_dir() and not Path("object").exists():
            shown = pictures(Path("dots"))
            real.take(real.thing, shown, 0.8, files(Path("object"), len(shown), "png"))
            real.take(real.thing, [Path("dots/patterns/black.png")] * 16, 0.8, files(Path("dark"), 16, "png"))

    for example in examples(PAGE, "## 1. A bench of your own"):
        outcome = call(*example.arguments)
        assert outcome.code == example.status, outcome.err
        take()
    image = read_frame(Path("run/reconstruction/image.exr"))[0]["reflectance"]
    assert ms.psnr(image, real.thing.truth) > 49.5


def walk(call: Call, heading: str) -> None:
    """Run the commands under a ``heading``. They print what the page has: words, and figures to a tenth.

    Lambda is left out, because it is sought at a flat minimum. Kernels of BLAS for other processors move it by a sixth,
    and the image and its stated error, which are compared, by less than a tenth.
    """
    figures.put_inputs(heading, Path())
    for example in examples(PAGE, heading):
        outcome = call(*example.arguments, "--quiet", pictures=True)
        assert outcome.code == example.status, outcome.err
        texts = (re.sub(r"lambda [\d.e+-]+", "lambda", text) for text in (example.output, outcome.out + outcome.err))
        for reported, now in figures.pairs(*texts):
            assert float(now) == pytest.approx(float(reported), rel=0.1), example.arguments


def test_a_flatcams_captures_lead_to_the_image_of_its_authors(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a capture that was not learned from, in colour, no darker and no brighter. (Planted: planes of another
    mosaic; the image turned by a half; a run that does not say by which command it was made.)"""
    monkeypatch.chdir(tmp_path)
    walk(call, figures.WALKS[0])
    for name, stated in figures.correlations(tmp_path).items():
        assert stated == pytest.approx(figures.read()["walks"][f"correlation_{name}"], abs=0.01), name
    assert "mitsim import captures/flatcam/fc_7.png -o run7" in Path("run7/report.html").read_text(encoding="utf-8")
    ours = np.array(Image.open("run7/reconstruction/image.png")) / 255
    theirs = lightness(np.array(Image.open("captures/flatcam/rec_7.png")) / 255)
    assert np.abs(ours.mean(axis=(0, 1)) - theirs.mean(axis=(0, 1))).max() < 0.05
    assert np.abs(ours - theirs).mean() < 0.1


def test_a_diffusercams_capture_leads_to_a_hand(call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where one division by the spectrum of the light has it, too, and dark around it. (Planted: the image turned by a
    half.)"""
    monkeypatch.chdir(tmp_path)
    walk(call, figures.WALKS[1])
    image = read_frame(Path("hand/reconstruction/image.exr"))[0]["reflectance"]
    light, frame = (
        np.array(Image.open(f"captures/diffusercam/{name}.tif"), float)
        for name in ("psf_sample", "rawdata_hand_sample")
    )
    rows, columns = light.shape
    spectrum = np.fft.rfft2(light / light.sum(), (2 * rows, 2 * columns))
    seen = np.fft.rfft2(frame, (2 * rows, 2 * columns))
    divided = np.fft.irfft2(seen * spectrum.conj() / (np.abs(spectrum) ** 2 + 1e-3))
    # The light of a point lies about the middle of its picture.
    middle = np.roll(divided, ((rows - 1) // 2, (columns - 1) // 2), axis=(0, 1))[:rows, :columns]
    assert np.corrcoef(middle.ravel(), image.ravel())[0, 1] > 0.8, "0.89 of the other solver's"
    shown = np.array(Image.open("hand/reconstruction/image.png"))
    assert shown.max() == 255 and np.median(shown) == 0

"""From pictures that a projector shows to an image, by the commands of docs/bench.md and files of a camera alone."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import mitsim as ms
from mitsim.core.exr import read_frame
from tests.taken import RealBench
from tests.test_docs import blocks, examples

PAGE = "docs/bench.md"


def pictures(folder: Path) -> list[Path]:
    """What the projector shows, in order."""
    return sorted((folder / "patterns").glob("pattern_*.png"))


def files(folder: Path, count: int, ending: str) -> list[Path]:
    """Names as a camera counts."""
    return [folder / f"shot {index + 7}.{ending}" for index in range(count)]


@pytest.mark.slow
def test_the_page_leads_to_an_image(
    call: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variant: str
) -> None:
    """Every command of the page, in its order, with its devices; frames are taken when their pictures are drawn. The
    image is as good as one of a run that mitsim captured and calibrated itself, with the same noise (49.8 dB)."""
    monkeypatch.chdir(tmp_path)
    for name, text in zip(("camera", "projector"), blocks(PAGE, "toml"), strict=True):
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

    for example in examples(PAGE):
        outcome = call(*example.arguments)
        assert outcome.code == example.status, outcome.err
        take()
    image = read_frame(Path("run/reconstruction/image.exr"))[0]["reflectance"]
    assert ms.psnr(image, real.thing.truth) > 49.5

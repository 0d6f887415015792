"""Options that have no effect are refused: what is passed over in silence is taken for obeyed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mitsim.exchange.formats import export
from tests.exchanged import Made, made


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """A run and a calibration, the same as files, a picture, and an image of irradiance."""
    bench = made(tmp_path_factory.mktemp("bench"))
    folder = bench.run.parent
    export(bench.run, "hdf5", folder / "run.h5", bench.calibration)
    Image.new("L", (8, 8)).save(folder / "a.png")
    np.zeros(64, np.uint16).tofile(folder / "a.raw")
    np.save(folder / "light.npy", np.ones((4, 4)))
    return bench


FRAMES = "--camera imx249 --patterns uniform --exposure 1 --projector-pixels 4"
CASES = [
    ("export {run} --format png -o {out}", "--overwrite"),
    *(
        ("import {folder}/run.h5 -o {out}", option)
        for option in (
            *("--patterns uniform", "--camera imx249", "--exposure 1", "--calibration {cal}", "--projector-pixels 128"),
            *("--black-level 3", "--ambient-frame {folder}/a.png", "--ambient-shots 2", "--shape 8x8", "--bits 8"),
            *("--byte-order little", "--seed 0", "--pixel-format Mono10p"),
        )
    ),
    (f"import {{folder}}/a.png {FRAMES} -o {{out}}", "--bits 8"),
    (f"import {{folder}}/a.png {FRAMES} -o {{out}}", "--byte-order big"),
    (f"import {{folder}}/a.png {FRAMES} -o {{out}}", "--shape 8x8"),
    (f"import {{folder}}/a.raw {FRAMES} --shape 8x8 --bits 16 -o {{out}}", "--seed 3"),
    (f"import {{folder}}/a.raw {FRAMES} --shape 8x8 --pixel-format Mono12p -o {{out}}", "--bits 12"),
    ("patterns dots:3 -o {out}", "--seed 1"),
    ("patterns dots:3 -o {out}", "--signed-capture pair"),
    ("patterns stripes --camera imx249 --exposure 1 -o {out}", "--seed 1"),
    ("capture photograph --patterns dots:3 --exposure 0.1 -o {out}", "--exposure-fraction 0.5"),
    ("pairs photograph --count 2 --exposure 0.1 -o {out}", "--exposure-fraction 0.5"),
    ("characterise imx249 -o {out}", "--wavelength 550"),
    ("sense {folder}/light.npy --camera imx249 --exposure 1 -o {out}.npy", "--exposure-fraction 0.8"),
    *(
        ("study merge {folder} -o {out}", option)
        for option in (
            *("--patterns dots:7", "--seed 0", "--camera imx249", "--projector mp_cl1", "-D a=1", "--quick"),
            *("--allow-outside-files", "--shard 1/1", "--jobs 1", "--scheduler tcp://a:1", "--over seed=1:2:2"),
            *("--measure psnr", "--recipe {folder}/a.toml", "--data {folder}"),
        )
    ),
    ("study distance -o {out}", "--experiment a.b"),
    ("study distance -o {out}", "--patterns dots:7"),
    ("study distance --scheduler tcp://a:1 -o {out}", "--jobs 1"),
    ("study twin -o {out}", "--camera imx249"),
    ("study twin -o {out}", "-D a=1"),
]


@pytest.mark.parametrize(("command", "option"), CASES, ids=[f"{c.split(' -o ')[0]} {o}" for c, o in CASES])
def test_an_option_without_effect_is_refused(
    call: Callable[..., Any], bench: Made, tmp_path: Path, command: str, option: str
) -> None:
    """In a line that names it, before any work. (Planted: one left out of its verb's list.)"""
    places = {"run": bench.run, "cal": bench.calibration, "folder": bench.run.parent, "out": tmp_path / "out"}
    found = call(*f"{command} {option}".format(**places).split())
    assert found.code == 2 and len(found.err.strip().splitlines()) == 1, found.err
    assert option.split()[0] in found.err and "has no effect" in found.err and "leave it out" in found.err
    assert not [*tmp_path.iterdir()]

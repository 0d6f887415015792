"""Light from outside the projector's window: what a margin of calibrated cells round it would buy, and what does.

    python benchmarks/margin.py [--json FILE] [--seeds 2] [--rendered]

The photograph's bench in closed form (geometric shadow), the astronaut in the window, and beside it a white card that
fills the ``CARD`` columns of cells that the field stop lets through, ``b`` times as bright as a white board in the
projector's uniform light. ``steady``: by a lamp, equal in every frame. ``indirect``: by light of the projector that the
scene scatters there, as much of it as a pattern lights. Frames have shot and read noise at equal peak; lambda is the
solver's. Images are made with factors of the window alone; with the mean of as many projector-off frames taken off as
there are patterns; and with factors that have a margin of so many cells on each side, lit in every pattern. PSNR is of
the window. A separable solver takes the margin's light for a product of a row's pattern and a column's there, which
neither light is under coded patterns.

``--rendered``: instead, runs of the photograph with a white wall (reflectance 0.9, 60 mm deep) that stands beside the
window, square to the sheet, out of the projector's light, and of the photograph alone, reconstructed with margins.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import mitsim as ms
from mitsim.core.parallel import single_threaded_blas
from mitsim.metrics import psnr
from mitsim.optics.shadow import Directions
from mitsim.optics.terms import best_term, shadow_terms
from mitsim.reconstruct.solver import prepare
from mitsim.studies.framework.experiment import SIDE, TEST_IMAGES, picture

CARD = 11
"""Columns of cells beside the window that the field stop of 20 degrees lets through."""
MARGINS = (4, 8, 11, 16)
BRIGHT = (0.0, 0.01, 0.1, 1.0)
FULL_WELL_PART = 0.8


def factors(bench: ms.Bench, margin: int) -> tuple[np.ndarray, np.ndarray]:
    """(m, n + 2 margin) left and right factor, of transmissions, with so many cells more on each side."""
    sides = []
    for first, last in bench.windows:
        cell = (last - first) / bench.n
        edges = np.linspace(first - margin * cell, last + margin * cell, bench.n + 2 * margin + 1)
        sides.append(Directions.cells(edges))
    rows, columns = sides
    best = best_term(shadow_terms(bench.geometry, rows, columns, bench.geometry.scene_distance))
    return best.left, best.right


def padded(patterns: np.ndarray, margin: int) -> np.ndarray:
    """(n + 2 margin, K) ``patterns`` (n, K) whose cells in the margin are always lit."""
    return np.pad(patterns.astype(np.float64), ((margin, margin), (0, 0)), constant_values=1.0)


@dataclass(frozen=True, eq=False)
class Stand:
    """Frames of one family with light of a card outside, and images of them."""

    bench: ms.Bench
    scene: np.ndarray
    patterns: str
    kind: str
    bright: float

    def images(self, seed: int) -> dict[str, float]:
        """PSNR [dB] of each way to make an image."""
        family, sensor = self.bench.family(self.patterns), self.bench.sensor
        left, right = factors(self.bench, 0)
        wide = factors(self.bench, CARD)
        card = np.zeros((self.bench.n + 2 * CARD,) * 2)
        card[CARD:-CARD, :CARD] = self.bright
        outside = wide[0] @ card @ wide[1].T
        # (K, K', m, m') expected frames, in white boards of one projector pixel.
        frames = np.empty((family.left.shape[1], family.right.shape[1], *outside.shape))
        for row, column in np.ndindex(frames.shape[:2]):
            lit = np.outer(family.left[:, row], family.right[:, column])
            part = 1.0 if self.kind == "steady" else lit.mean()
            frames[row, column] = left @ (lit * self.scene) @ right.T + part * outside
        gain = FULL_WELL_PART * sensor.superpixel_full_well_e / frames.max()
        read, rng = sensor.superpixel_reading_noise_e, np.random.default_rng(seed)

        def exposed(expected: np.ndarray, shots: int = 1) -> np.ndarray:
            noisy = rng.poisson(gain * expected * shots) / shots
            return np.asarray((noisy + read / shots**0.5 * rng.standard_normal(expected.shape)) / gain)

        shots = np.stack([[exposed(frame) for frame in line] for line in frames])
        off = exposed(outside if self.kind == "steady" else np.zeros_like(outside), shots.shape[0] * shots.shape[1])
        found = {"window": self._psnr(shots, 0), "projector off": self._psnr(shots - off, 0)}
        return found | {f"margin {margin}": self._psnr(shots, margin) for margin in MARGINS}

    def _psnr(self, frames: np.ndarray, margin: int) -> float:
        family = self.bench.family(self.patterns)
        model = prepare(
            *factors(self.bench, margin), padded(family.left, margin), padded(family.right, margin), centre=False
        )
        sums = model.accumulator()
        for row, column in np.ndindex(frames.shape[:2]):
            sums.add(frames[row, column], row, column)
        image = model.solve(sums, "auto").image
        inside = slice(margin, margin + self.bench.n)
        return psnr(image[inside, inside], self.scene)


WALL = """
<shape type="rectangle">
    <transform name="to_world">
        <scale x="30" y="64" z="1"/> <rotate y="1" angle="-90"/> <translate x="61" y="0" z="369"/>
    </transform>
    <bsdf type="diffuse"><spectrum name="reflectance" value="0.9"/></bsdf>
</shape>
</scene>"""


Row = dict[str, object]


def rendered() -> list[Row]:
    """Rows of images of the photograph with a wall and without, by patterns and margin."""
    source, rows = Path(ms.open_bench("photograph").loaded.path), list[Row]()
    calibration = ms.open_bench("photograph").calibrate()
    with tempfile.TemporaryDirectory() as folder:
        walled = shutil.copytree(source.parent, Path(folder) / "wall") / source.name
        walled.write_text(source.read_text().replace("</scene>", WALL))
        for name, scene in (("wall", walled), ("none", source)):
            bench = ms.open_bench(scene)
            for patterns in ("uniform", "dots:7"):
                shots = bench.capture(patterns)
                for margin in (0, *MARGINS):
                    image = ms.reconstruct(shots, calibration, margin=margin)
                    assert shots.truth is not None
                    found = ms.psnr(image.image, shots.truth)
                    rows.append({"scene": name, "patterns": patterns, "margin": margin, "psnr": found, "ok": image.ok})
                    print(f"{name} {patterns:>8} margin {margin:2}: {found:.1f} dB{'' if image.ok else ', flagged'}")
    return rows


@single_threaded_blas()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--rendered", action="store_true")
    options = parser.parse_args()
    if options.rendered:
        report(rendered(), options.json)
        return
    bench = ms.open_bench("photograph")
    side, rows = bench.n, list[Row]()
    scene = picture(TEST_IMAGES[0]).reshape(side, SIDE // side, side, SIDE // side).mean(axis=(1, 3)) / 255
    for patterns in ("uniform", "dots:7"):
        for kind in ("steady", "indirect"):
            for bright in BRIGHT:
                stand = Stand(bench, scene, patterns, kind, bright)
                runs = [stand.images(seed) for seed in range(options.seeds)]
                row = {name: float(np.mean([run[name] for run in runs])) for name in runs[0]}
                spread = float(np.std([run["window"] for run in runs], ddof=1)) if len(runs) > 1 else 0.0
                rows.append({"patterns": patterns, "light": kind, "b": bright, "spread": spread, **row})
                reported = ", ".join(f"{name} {value:.1f}" for name, value in row.items())
                print(f"{patterns:>8} {kind:>8} b {bright:g}: {reported} dB (one run +-{spread:.2f})", flush=True)
    report(rows, options.json)


def report(rows: list[Row], path: Path | None) -> None:
    """Write ``rows`` to ``path``."""
    if path:
        path.write_text(json.dumps({"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()

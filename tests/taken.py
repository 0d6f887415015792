"""A real bench as tests make it: a projector that shows pictures, and a camera that leaves files of numbers.

Simulated, but nothing of the simulation leaves it: what a user gets are the files that a camera's program writes.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from mitsim.acquire.exposure import Exposer
from mitsim.api.bench import Bench
from mitsim.devices.patterns import Lighting
from mitsim.light.light import SampledLight
from mitsim.sensor.chain import electrons_from_irradiance


@dataclass(frozen=True)
class RealBench:
    """A projector and a camera, and the light of a board and of an object before them.

    Attributes
    ----------
    bench
        that the light is of.
    board, thing
        light by projector pixel.
    """

    bench: Bench
    board: SampledLight
    thing: SampledLight

    @classmethod
    def of(cls, bench: Bench, accuracy: float, patterns: str = "dots:7") -> RealBench:
        """That of a ``bench``, whose frames of ``patterns`` are good to ``accuracy``."""
        board = bench.with_board(0.99).light(patterns, accuracy=accuracy)
        return cls(bench, board.merge(), bench.light(patterns, accuracy=accuracy).merge())

    def white(self, light: SampledLight) -> float:
        """Exposure [s] after which a white picture fills four fifths of the camera's range."""
        (frame,) = light.frames(Lighting.uniform(self.bench.n), 0)
        return 0.8 / self._filled(float(frame.irradiance.max()))

    def _filled(self, irradiance: float) -> float:
        sensor, wavelength = self.bench.sensor, self.bench.devices.projector.effective_wavelength_nm
        return float(electrons_from_irradiance(irradiance, 1.0, sensor, wavelength)) / sensor.superpixel_full_well_e

    def take(self, light: SampledLight, pictures: list[Path], exposure_s: float, names: list[Path]) -> None:
        """A frame of each of the ``pictures`` that the projector shows, under the ``names`` that the camera gives.

        16 bits, PNG or TIFF by the ending. The projector lights a pixel of the simulation by the mean of the picture's
        square there, as `patterns.json` beside the pictures places it.
        """
        where = json.loads((pictures[0].parents[1] / "patterns.json").read_text())["projector"]
        shown = np.stack([self._shown(path, where) for path in pictures])
        lighting = Lighting(np.arange(self.bench.n**2), shown)
        exposer = Exposer(self.bench.devices, exposure_s, 5)
        for name, frame in zip(names, light.frames(lighting, 0), strict=True):
            numbers = exposer.digital(exposer.electrons(frame), str(name))
            name.parent.mkdir(exist_ok=True)
            Image.fromarray(np.asarray(numbers).astype(np.uint16)).save(name)

    def _shown(self, path: Path, where: dict[str, int]) -> np.ndarray:
        """(n^2,) light of 0 to 1."""
        with Image.open(path) as picture:
            assert picture.size == (where["columns"], where["rows"])
            values = np.asarray(picture, float) / 255
        n, cell = self.bench.n, (where["cell"], where["cell_columns"])
        rows, columns = (
            slice(where[first], where[first] + n * side)
            for first, side in zip(("first_row", "first_column"), cell, strict=True)
        )
        return values[rows, columns].reshape(n, cell[0], n, cell[1]).mean(axis=(1, 3)).ravel()

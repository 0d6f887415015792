"""Benches that networks are judged on: a test condition and a print in, what the frames add up to and their truth out.

The bench is the middle of the shipped photograph: its camera, and 64 x 64 of the projector's pixels, each as large as
there, on a sheet half as wide. So every direction is as hard to tell from its neighbours as on the whole, and a step of
a training takes a quarter of the time. The other conditions are those of other studies: the sheet moved (`depth`), the
mask moved (`drift`), an exposure of a tenth, the coat of the gift card (`reflectivity`), the lamp (`ambient`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mitsim.acquire.exposure import drift_mask, taken_off
from mitsim.core.arrays import FloatArray, read_npz
from mitsim.core.configuration import locate
from mitsim.core.errors import MitsimError
from mitsim.devices.session import Drift
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.solver import Accumulator, Prepared, prepare
from mitsim.report import EQUAL_PEAK, IDEALISED, RENDERED
from mitsim.report.lit_scene import accumulate
from mitsim.studies.framework.experiment import Setup
from mitsim.studies.framework.studio import Studio

SIDE = 64
"""Projector pixels a side: half of the photograph's, so that a training takes a quarter of the time."""
_CANVAS_PIXELS, _CANVAS_MM = 3 * SIDE, 180.0
"""Width of the projector's picture, whose last third is the window: it lies even about the projector, which stands
60 mm beside the camera, and its pixels have the photograph's 0.9375 mm at 400 mm."""
SHEET_MM = 64.0
"""Width of the sheet: half of the photograph's."""
DEPTH, DRIFT, DIM, GLOSS, AMBIENT = "depth", "drift", "dim", "gloss", "ambient"
CONDITIONS = (IDEALISED, RENDERED, DEPTH, DRIFT, DIM, GLOSS, AMBIENT)
"""What networks are tested on."""
MISMATCHES = (DEPTH, DRIFT, GLOSS, AMBIENT)
"""Those that a calibration does not know; what is dim has noise that a capture states."""
PLACES = {
    RENDERED: (IDEALISED, RENDERED, DRIFT, DIM),
    DEPTH: (DEPTH,),
    GLOSS: (GLOSS,),
    AMBIENT: (AMBIENT,),
}
"""Conditions that share their light, by the place that it is of."""
DEPTH_MM = 405.0
"""Of a sheet 5 mm behind the calibrated distance: what the study of depth calls a small variation."""
DRIFT_UM = 4.0
"""That the mask moves down the rows: the image moves by 0.9 pixels, as much as by 5 mm of depth along the columns."""
DIM_FRACTION = 0.1
"""Of the light, in the dim condition."""
_COAT = """<bsdf type="roughplastic" id="sheet_bsdf">
            <string name="distribution" value="ggx"/>
            <float name="alpha" value="0.1"/>
            <float name="int_ior" value="1.49"/>
            <texture name="diffuse_reflectance" type="bitmap">"""
"""The gift card's coat, in place of plain paint."""
_PAINT = """<bsdf type="diffuse" id="sheet_bsdf">
            <texture name="reflectance" type="bitmap">"""
_SCENES = {RENDERED: "photograph", DEPTH: "photograph", GLOSS: "photograph", AMBIENT: "lamp_bench"}
"""Shipped scenes that the places are made of."""


def place_setup(studio: Studio, setup: Setup, place: str) -> Setup:
    """The setup of a place.

    Parameters
    ----------
    studio, setup
        in a folder of which the scene file stands, and what else the bench is of.
    place
        one of :data:`PLACES`.

    Raises
    ------
    MitsimError
        where the shipped scene is not as its middle is taken of.
    """
    name = f"{_SCENES[place]}_{GLOSS}" if place == GLOSS else _SCENES[place]
    folder = studio.made_once("scenes", name, lambda part: _write_scene(part, _SCENES[place], place == GLOSS))
    own = replace(setup, scene=str(folder / "scene.xml"))
    return own.with_parameters(sheet_z=DEPTH_MM) if place == DEPTH else own


def _write_scene(folder: Path, shipped: str, glossy: bool) -> None:
    """The middle of a ``shipped`` scene, its sheet ``glossy`` or not, in a new ``folder``."""
    from skimage import io

    folder.mkdir()
    text = locate(shipped, "scenes", "scene.xml").read_text(encoding="utf-8")
    half = f"{SHEET_MM / 2:g}"
    fov = math.degrees(2 * math.atan(_CANVAS_MM / 2 / 400))
    changes = [
        ('name="fov" value="33.398488"', f'name="fov" value="{fov:.6f}"'),
        ('<scale x="64" y="64" z="1"/>', f'<scale x="{half}" y="{half}" z="1"/>'),
        *([(_PAINT, _COAT)] if glossy else []),
    ]
    for old, new in changes:
        if text.count(old) != 1:
            raise MitsimError(f"study learned: the shipped scene {shipped} has no {old!r}, whose middle is to be taken")
        text = text.replace(old, new)
    (folder / "scene.xml").write_text(text, encoding="utf-8")
    canvas = np.zeros((SIDE, _CANVAS_PIXELS), np.uint8)
    canvas[:, -SIDE:] = 255
    io.imsave(folder / "projector.png", canvas, check_contrast=False)
    io.imsave(folder / "reflectance.png", np.full((SIDE, SIDE), 128, np.uint8), check_contrast=False)


# -------- What frames add up to


@dataclass(frozen=True, eq=False)
class Case:
    """A print under one condition and one family of patterns, as any method takes it.

    Attributes
    ----------
    truth
        (n, n) apparent reflectance.
    sides, centre
        (m, n) factors that images are made with, and whether frames lose their means.
    patterns
        P_L and P_R.
    quarters, energy
        of the sum of all frames, see :class:`mitsim.reconstruct.solver.Accumulator`.
    frame
        (m, m') the frame itself, where it is one.
    basis
        first row of the left singular vectors that the sum is told in.
    unexplained
        part of the frames, rms, that no image gives, beyond the sensor's noise.
    """

    truth: FloatArray
    sides: tuple[FloatArray, FloatArray]
    centre: bool
    patterns: tuple[FloatArray, FloatArray]
    quarters: FloatArray
    energy: float
    frame: FloatArray | None
    basis: FloatArray
    unexplained: float = 0.0

    def prepare(self) -> Prepared:
        """The factorised model."""
        return prepare(*self.sides, *self.patterns, centre=self.centre)

    def sums(self, prepared: Prepared) -> Accumulator:
        """All frames, added up for a ``prepared`` model of these factors.

        MitsimError where its singular vectors are not those of the sum.
        """
        if self.frame is not None:
            sums = prepared.accumulator()
            sums.add(self.frame, 0, 0)
            return sums
        if not np.array_equal(prepared.left.basis[0], self.basis):
            raise MitsimError(
                "study learned: test frames were added up on another machine, whose rounding differs; choose another "
                "folder"
            )
        return Accumulator.of_sums(prepared, self.quarters, self.energy)

    def arrays(self) -> dict[str, FloatArray]:
        """As a file has it."""
        frame = np.zeros((0, 0)) if self.frame is None else self.frame
        numbers = np.array([self.energy, float(self.centre), self.unexplained])
        return dict(zip(_FIELDS, (self.truth, *self.sides, *self.patterns, self.quarters, frame, self.basis, numbers),
                        strict=True))  # fmt: skip

    @classmethod
    def of_arrays(cls, arrays: Sequence[FloatArray]) -> Case:
        """Of ``arrays`` in the order of :meth:`arrays`."""
        truth, left, right, rows, columns, quarters, frame, basis, (energy, centre, unexplained) = arrays
        kept = frame if frame.size else None
        return cls(truth, (left, right), bool(centre), (rows, columns), quarters, float(energy), kept, basis,
                   float(unexplained))  # fmt: skip


_FIELDS = ("truth", "left", "right", "P_L", "P_R", "quarters", "frame", "basis", "numbers")
"""Arrays of a case."""
Cases = dict[tuple[str, str], Case]
"""By condition and patterns."""


@dataclass(frozen=True)
class Shown:
    """A print of a ``setup`` at a ``place``, ``families`` of patterns, and the ``seed`` of all noise."""

    setup: Setup
    place: str
    families: tuple[str, ...]
    seed: int

    def cases(self, studio: Studio) -> Cases:
        """All of them, from a file that the ``studio`` shares with others, or made for it."""
        name = f"{self.place} {self.setup.picture} {' '.join(self.families)} {self.seed}.npz".replace(":", "")
        path = studio.made_once("frames", name, lambda part: self._write(studio, part))
        with path.open("rb") as file:
            arrays = read_npz(file, path)
        keys = [(condition, family) for condition in PLACES[self.place] for family in self.families]
        return {key: Case.of_arrays([arrays[f"{key[0]} {key[1]} {each}"] for each in _FIELDS]) for key in keys}

    def _write(self, studio: Studio, path: Path) -> None:
        """Expose all frames and keep what they add up to."""
        arrays = {
            f"{condition} {family} {name}": values
            for condition in PLACES[self.place]
            for family in self.families
            for name, values in self._expose(studio, condition, family).arrays().items()
        }
        with path.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)

    def _expose(self, studio: Studio, condition: str, name: str) -> Case:
        lit = studio.lit_scene(place_setup(studio, self.setup, self.place))
        family = lit.bench.family(name, self.seed)
        if condition == IDEALISED:
            frames = lit.idealised_frames(family, self.seed)
        else:
            frames = lit.rendered_frames(factors_of(studio, self.setup, self.seed), family, self.seed)
        expected = frames.expected
        if condition == DRIFT:
            expected = lit.expected_frames(RENDERED, family, bench=drift_mask(lit.bench, Drift(mask_rows_um=DRIFT_UM)))
        seconds = frames.seconds(EQUAL_PEAK) * (DIM_FRACTION if condition == DIM else 1.0)
        model, exposer, frame = frames.prepare(), frames.exposer(seconds), None
        if len(family.shots) == 1:
            ((measured, _, _),) = exposer.measurements(family, expected)
            frame, sums = measured - taken_off(exposer, family, expected), model.accumulator()
            sums.add(frame, 0, 0)
        else:
            (sums,) = accumulate(exposer, family, expected, [model])
        patterns = family.left.astype(np.float64), family.right.astype(np.float64)
        problem = model.problem(sums)
        outside = problem.energy - float(np.square(problem.projected).sum())
        beyond = max(outside - frames.noise(seconds) ** 2 * (problem.data_count - model.rank), 0.0)
        return Case(
            lit.truth, frames.sides, frames.centre, patterns, sums.quarters, sums.energy, frame,
            model.left.basis[0], float(np.sqrt(beyond / problem.energy)),
        )  # fmt: skip


def factors_of(studio: Studio, setup: Setup, seed: int) -> Factors:
    """What a session at the calibrated distance estimates.

    Parameters
    ----------
    studio, setup
        where it is kept, and the bench, whatever it shows.
    seed
        of the session's noise.
    """
    return studio.factors(place_setup(studio, setup.with_print(None), RENDERED), seed)

"""Bench of the study of learned methods: frames of prints under test conditions, and the networks that are trained.

The bench is the middle of the shipped photograph: its camera, and 64 x 64 of the projector's pixels, each as large as
there, on a sheet half as wide. Every direction is therefore as hard to distinguish from its neighbours as on the whole,
and a step of a training takes a quarter of the time. The other conditions are those of other studies: the sheet moved
(`depth`), the mask moved (`drift`), an exposure of a tenth, the coat of the gift card (`reflectivity`), the lamp
(`ambient`). Frames and networks are kept in the study's folder. torch, an extra, is imported when a network is used.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from filelock import FileLock

from mitsim.acquire.exposure import drift_mask, taken_off
from mitsim.api.bench import open_bench
from mitsim.bench.request import Request, Task
from mitsim.core.arrays import FloatArray, read_npz
from mitsim.core.configuration import locate
from mitsim.core.errors import MitsimError
from mitsim.core.files import PAIRS
from mitsim.core.manifests import CalibrationManifest
from mitsim.devices.session import Drift
from mitsim.learn.requests import PairsRequest, Training, Variation
from mitsim.reconstruct.factors import Factors, load_calibration
from mitsim.reconstruct.solution import Status, Verdict
from mitsim.reconstruct.solver import Accumulator, Prepared, prepare
from mitsim.report import EQUAL_PEAK, IDEALISED, RENDERED
from mitsim.report.lit_scene import accumulate
from mitsim.studies.framework.experiment import Setup
from mitsim.studies.framework.studio import Studio

if TYPE_CHECKING:
    from mitsim.learn.learned_solver import LearnedSolver
    from mitsim.learn.pair_store import PairStore

SIDE = 64
_CANVAS_PIXELS, _CANVAS_MM = 3 * SIDE, 180.0
"""Width of the projector's picture, whose last third is the window: the picture is even about the projector, 60 mm
beside the camera, and its pixels have the photograph's 0.9375 mm at 400 mm."""
_SHEET_MM = 64.0
"""Width of the sheet: half of the photograph's."""
DEPTH, DRIFT, DIM, GLOSS, AMBIENT = "depth", "drift", "dim", "gloss", "ambient"
MISMATCHES = (DEPTH, DRIFT, GLOSS, AMBIENT)
"""Conditions that a calibration does not know; the noise of dim frames is stated by the capture."""
PLACES = {RENDERED: (IDEALISED, RENDERED, DRIFT, DIM), DEPTH: (DEPTH,), GLOSS: (GLOSS,), AMBIENT: (AMBIENT,)}
"""Conditions that share their light, by the place that the light is of."""
_DEPTH_MM = 405.0
"""Distance of a sheet 5 mm behind the calibrated distance, a small variation in the study of depth."""
_DRIFT_UM = 4.0
"""Motion of the mask down the rows: the image moves by 0.9 pixels, as much as by 5 mm of depth along the columns."""
_DIM = 0.1
_COAT = """<bsdf type="roughplastic" id="sheet_bsdf">
            <string name="distribution" value="ggx"/>
            <float name="alpha" value="0.1"/>
            <float name="int_ior" value="1.49"/>
            <texture name="diffuse_reflectance" type="bitmap">"""
"""The gift card's coat, in place of plain paint."""
_PAINT = """<bsdf type="diffuse" id="sheet_bsdf">
            <texture name="reflectance" type="bitmap">"""


def place_setup(studio: Studio, setup: Setup, place: str) -> Setup:
    """Return the setup of one of :data:`PLACES`, whose scene file is written to the ``studio``'s shared folder.

    MitsimError where a shipped scene lacks what is changed in it.
    """
    shipped = "lamp_bench" if place == AMBIENT else "photograph"

    def write(folder: Path) -> None:
        from skimage import io

        folder.mkdir()
        text = locate(shipped, "scenes", "scene.xml").read_text(encoding="utf-8")
        fov = math.degrees(2 * math.atan(_CANVAS_MM / 2 / 400))
        changes = {
            'name="fov" value="33.398488"': f'name="fov" value="{fov:.6f}"',
            '<scale x="64" y="64" z="1"/>': f'<scale x="{_SHEET_MM / 2:g}" y="{_SHEET_MM / 2:g}" z="1"/>',
            **({_PAINT: _COAT} if place == GLOSS else {}),
        }
        for old, new in changes.items():
            if text.count(old) != 1:
                raise MitsimError(f"study learned: the shipped scene {shipped} has no {old!r}, which it changes")
            text = text.replace(old, new)
        (folder / "scene.xml").write_text(text, encoding="utf-8")
        canvas = np.zeros((SIDE, _CANVAS_PIXELS), np.uint8)
        canvas[:, -SIDE:] = 255
        io.imsave(folder / "projector.png", canvas, check_contrast=False)
        io.imsave(folder / "reflectance.png", np.full((SIDE, SIDE), 128, np.uint8), check_contrast=False)

    folder = studio.made_once("scenes", f"{shipped}_{GLOSS}" if place == GLOSS else shipped, write)
    own = replace(setup, scene=str(folder / "scene.xml"))
    return own.with_parameters(sheet_z=_DEPTH_MM) if place == DEPTH else own


# -------- Frames of a print under a condition


@dataclass(frozen=True, eq=False)
class Case:
    """A print under one condition and one family of patterns, as a file has it.

    Attributes
    ----------
    truth, left, right, rows, columns
        (n, n) apparent reflectance, (m, n) factors that images are made with, patterns P_L and P_R.
    centre
        True where frames lose their means.
    quarters, energy
        sum of all frames, see :class:`mitsim.reconstruct.solver.Accumulator`.
    frame
        (m, m') the frame itself if there is one, else empty.
    basis
        first row of the left singular vectors that the sum refers to.
    unexplained
        part of the frames, rms, that no image gives, beyond the sensor's noise.
    """

    truth: FloatArray
    left: FloatArray
    right: FloatArray
    rows: FloatArray
    columns: FloatArray
    centre: Any
    quarters: FloatArray
    energy: Any
    frame: FloatArray
    basis: FloatArray
    unexplained: Any = 0.0

    def prepare(self) -> Prepared:
        """Return the factorised model."""
        return prepare(self.left, self.right, self.rows, self.columns, centre=bool(self.centre))

    def sums(self, prepared: Prepared) -> Accumulator:
        """Return the sum of all frames for a ``prepared`` model of these factors.

        MitsimError where its singular vectors are not those of the sum.
        """
        if self.frame.size:
            sums = prepared.accumulator()
            sums.add(self.frame, 0, 0)
            return sums
        if not np.array_equal(prepared.left.basis[0], self.basis):
            raise MitsimError(
                "study learned: test frames were added up on another machine, whose rounding differs; choose another "
                "folder"
            )
        return Accumulator.of_sums(prepared, self.quarters, float(self.energy))

    def write(self, path: Path) -> None:
        """Write the case to a file."""
        with path.open("wb") as file:
            np.savez(file, allow_pickle=False, **vars(self))

    @classmethod
    def read(cls, path: Path) -> Case:
        """Read a case from a file."""
        with path.open("rb") as file:
            return cls(**read_npz(file, path))


def case_of(studio: Studio, setup: Setup, condition: str, patterns: str, seed: int) -> Case:
    """Return the frames of a setup's print, exposed at equal peak, from a file that studios share.

    Parameters
    ----------
    studio, setup
        Studio, and bench with its print.
    condition, patterns, seed
        Test condition, pattern family, and seed of all noise.
    """

    def write(path: Path) -> None:
        place = next(name for name, conditions in PLACES.items() if condition in conditions)
        lit = studio.lit_scene(place_setup(studio, setup, place))
        family = lit.bench.family(patterns, seed)
        if condition == IDEALISED:
            frames = lit.idealised_frames(family, seed)
        else:
            frames = lit.rendered_frames(calibrated(studio, setup, seed), family, seed)
        expected = frames.expected
        if condition == DRIFT:
            moved = drift_mask(lit.bench, Drift(mask_rows_um=_DRIFT_UM))
            expected = lit.expected_frames(RENDERED, family, bench=moved)
        seconds = frames.seconds(EQUAL_PEAK) * (_DIM if condition == DIM else 1.0)
        model, exposer, frame = frames.prepare(), frames.exposer(seconds), np.zeros((0, 0))
        if len(family.shots) == 1:
            ((measured, _, _),) = exposer.measurements(family, expected)
            frame, sums = measured - taken_off(exposer, family, expected), model.accumulator()
            sums.add(frame, 0, 0)
        else:
            (sums,) = accumulate(exposer, family, expected, [model])
        problem = model.problem(sums)
        outside = problem.energy - float(np.square(problem.projected).sum())
        beyond = max(outside - frames.noise(seconds) ** 2 * (problem.data_count - model.rank), 0.0)
        Case(
            lit.truth, *frames.sides, family.left.astype(np.float64), family.right.astype(np.float64), frames.centre,
            sums.quarters, sums.energy, frame, model.left.basis[0], np.sqrt(beyond / problem.energy),
        ).write(path)  # fmt: skip

    name = f"{condition} {setup.picture} {patterns} {seed}.npz".replace(":", "")
    return Case.read(studio.made_once("frames", name, write))


def calibrated(studio: Studio, setup: Setup, seed: int) -> Factors:
    """Return the factors that a session at the calibrated distance estimates, its noise from ``seed``."""
    return studio.factors(place_setup(studio, setup.with_print(None), RENDERED), seed)


# -------- Networks


@dataclass(frozen=True)
class Budget:
    """Pairs of a training set, steps of a training, and benches (``groups``) of a varied set."""

    pairs: int
    steps: int
    groups: int


FULL = Budget(pairs=256, steps=800, groups=16)
"""About a minute of a processor a training, so that a hundred of them take hours; `mitsim train` has 4000 steps on 128
pixels a side, 20 times as much."""
QUICK = Budget(pairs=16, steps=6, groups=2)
"""A first look at the page, in about a minute; such networks show nothing."""
VARIED, ELSEWHERE, PICTURES = "varied", "elsewhere", "pictures"
TRAININGS = (IDEALISED, RENDERED, VARIED)
"""Training sets beside pairs of another camera, and pictures alone."""
_ELSEWHERE_MM = 1.0
"""Distance of the mask from the sensor of another camera: half of this one's."""


@dataclass(frozen=True)
class Cell:
    """A network that is trained: training set, patterns, method, and the ``seed`` of the training."""

    training: str
    patterns: str
    method: str
    seed: int


@dataclass(frozen=True)
class School:
    """Training of networks for the bench of a ``setup``, in the shared folder of a ``studio``, with pairs and
    calibration of a ``seed``, within a ``budget``."""

    studio: Studio
    setup: Setup
    seed: int
    budget: Budget

    def network(self, cell: Cell) -> tuple[LearnedSolver, float | None]:
        """Return the network of a ``cell``, and the processor time of its training [s]; None if it was trained before,
        or in parts.

        An interrupted training is resumed. One network that pictures alone taught serves all patterns.
        """
        from mitsim.learn.learned_solver import read_network
        from mitsim.learn.training import train_network

        own = replace(cell, training=IDEALISED, patterns="uniform") if cell.training == PICTURES else cell
        file = f"{own.method} {own.training} {own.patterns} {own.seed} {self.budget.pairs} {self.budget.steps}.pt"
        place, seconds = self.studio.shared_folder("networks") / file.replace(":", ""), None
        with FileLock(place.with_suffix(".lock")):
            if not place.is_file():
                store, factors = self._store(own.training, own.patterns), self._factors(own.training, own.patterns)
                whole = not Path(f"{place}.unfinished").is_file()
                started = time.process_time()
                request = Training(method=own.method, steps=self.budget.steps, seed=own.seed)
                train_network(store, factors, request, place, resume=True)
                seconds = time.process_time() - started if whole else None
        model = read_network(place, "cpu")
        if cell.training == PICTURES:  # no frame taught it, so that it serves any camera, patterns and noise
            camera = self._factors(RENDERED).manifest.camera
            manifest = model.manifest.model_copy(update={"camera": camera, "noise": (0.0, math.inf)})
            patterns = self._store(IDEALISED, cell.patterns).patterns
            model = replace(model, manifest=manifest, sides=self._factors(RENDERED).sides, patterns=patterns)
        return model, seconds

    def _store(self, training: str, patterns: str) -> PairStore:
        """Return the pairs of a set, which are made once; their interrupted making is resumed."""
        from mitsim.learn.pair_store import PairStore, read_pairs_manifest
        from mitsim.learn.pairs import make_pairs

        setup = self._setup(training)

        def opening(drawn: Mapping[str, str]) -> Any:
            parameters: dict[str, Any] = {**dict(setup.parameters), **drawn}
            return open_bench(setup.scene, setup.variant, setup.camera, setup.projector, setup.outside, **parameters)

        vary = None
        if training == VARIED:  # by as much as the tests do, but for gloss and lamps
            least = 2 * 400.0 - _DEPTH_MM
            moved = (-_DRIFT_UM, _DRIFT_UM)
            vary = Variation(
                groups=self.budget.groups, exposure_fraction=(0.8 * _DIM, 0.8), scene={"sheet_z": (least, _DEPTH_MM)},
                mask={"mask_rows_um": moved, "mask_columns_um": moved},
            )  # fmt: skip
        folder = self.studio.shared_folder("pairs") / f"{training} {patterns} {self.budget.pairs}".replace(":", "")
        with FileLock(folder.with_suffix(".lock")):
            begun = (folder / PAIRS).is_file()
            if not begun or read_pairs_manifest(folder).status != "complete":
                request = Request.of(patterns=patterns, seed=self.seed)
                asked = PairsRequest(
                    capture=request, count=self.budget.pairs, idealised=training == IDEALISED, vary=vary
                )
                make_pairs(opening, asked, Task(folder, resume=begun))
        return PairStore.open(folder)

    def _setup(self, training: str) -> Setup:
        own = place_setup(self.studio, self.setup, RENDERED)
        return own.with_parameters(mask_distance=_ELSEWHERE_MM) if training == ELSEWHERE else own

    def _factors(self, training: str, patterns: str = "uniform") -> Factors:
        """Return the calibration of a training set; idealised pairs have their own exact factors."""
        if training == IDEALISED:
            return load_calibration(self._store(training, patterns).folder / "calibration")
        if training == ELSEWHERE:
            return self.studio.factors(self._setup(training), self.seed)
        return calibrated(self.studio, self.setup, self.seed)

    def factors_for(self, case: Case) -> Factors:
        """Return the factors of a ``case`` with the identity of the bench's camera, which networks check."""
        identity = self._factors(RENDERED).manifest.camera
        status = Status(Verdict.CALIBRATED, "Factors of a test case")
        manifest = CalibrationManifest(
            camera=identity, centre=bool(case.centre), estimate=str(status), verdict=status.verdict.value, versions={}
        )
        return Factors(case.left, case.right, manifest, status)

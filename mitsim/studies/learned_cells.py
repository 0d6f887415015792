"""What is trained: a cell (training, patterns, method, seed) in, its network out, from pairs that are made once.

torch, an extra, is imported when a network is trained.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from filelock import FileLock

from mitsim.api.bench import open_bench
from mitsim.bench.request import Request, Task
from mitsim.core.arrays import FloatArray, read_npz
from mitsim.core.files import PAIRS
from mitsim.core.manifests import CalibrationManifest
from mitsim.learn.requests import (
    FLATNET,
    METHODS,
    PLUG_AND_PLAY,
    PREPROCESSED,
    REFINED,
    UNROLLED,
    PairsRequest,
    Training,
    Variation,
)
from mitsim.reconstruct.factors import Factors, load_calibration
from mitsim.reconstruct.request import TIKHONOV
from mitsim.reconstruct.solution import Status, Verdict
from mitsim.report import IDEALISED, RENDERED
from mitsim.studies.framework.experiment import Setup
from mitsim.studies.framework.studio import Studio
from mitsim.studies.learned_bench import DEPTH_MM, DIM_FRACTION, DRIFT_UM, Case, factors_of, place_setup

if TYPE_CHECKING:
    from mitsim.learn.learned_solver import LearnedSolver
    from mitsim.learn.pair_store import PairStore
    from mitsim.learn.training import Sums


@dataclass(frozen=True)
class Budget:
    """What a training may take.

    Attributes
    ----------
    pairs, steps
        pairs of a training set, and steps of a training.
    groups
        benches that a varied set is of.
    """

    pairs: int
    steps: int
    groups: int


FULL = Budget(pairs=256, steps=800, groups=16)
"""Chosen: some minute of a processor a training, so that a hundred of them take hours and not days; `mitsim train` has
4000 steps on 128 pixels a side, 20 times as much."""
QUICK = Budget(pairs=16, steps=6, groups=2)
"""So little that a network shows nothing: a first look at the page, in about a minute."""

VARIED, ELSEWHERE, PICTURES = "varied", "elsewhere", "pictures"
TRAININGS = (IDEALISED, RENDERED, VARIED)
"""Training sets; besides, pairs of another camera, and pictures alone."""
ELSEWHERE_MM = 1.0
"""Distance of the mask from the sensor of another camera: half of this one's."""
_NEAREST_MM, _FARTHEST_MM = 2 * 400.0 - DEPTH_MM, DEPTH_MM
"""Of the sheet of a varied bench: 5 mm either way."""
_FULL_EXPOSURE = 0.8
"""Part of the full well that the brightest pixel fills, as of any capture."""


@dataclass(frozen=True)
class Cell:
    """A network that is trained: on which set, under which patterns, by which method, and the ``seed`` of it all."""

    training: str
    patterns: str
    method: str
    seed: int


def cells(seeds: tuple[int, ...], families: tuple[str, ...], quick: bool) -> list[Cell]:
    """All networks, the quickest first.

    Parameters
    ----------
    seeds, families
        of trainings, and of patterns.
    quick
        whether two methods and sets suffice.
    """
    if quick:
        kinds = [(training, family, method) for family in families for training in TRAININGS[:2]
                 for method in (REFINED, UNROLLED)]  # fmt: skip
    else:
        kinds = [(training, family, method) for family in families for training in TRAININGS
                 for method in (REFINED, FLATNET, UNROLLED)]  # fmt: skip
        kinds += [(ELSEWHERE, family, REFINED) for family in families]
        kinds += [(PICTURES, family, PLUG_AND_PLAY) for family in families]
        # It reads frames: under many patterns a step takes as many times as long.
        kinds += [(training, families[0], PREPROCESSED) for training in TRAININGS]
    order = {method: number for number, method in enumerate((PLUG_AND_PLAY, REFINED, FLATNET, UNROLLED, PREPROCESSED))}
    assert set(order) == set(METHODS), "every method has its place"
    return [Cell(*kind, seed) for seed in seeds for kind in sorted(kinds, key=lambda kind: order[kind[2]])]


@dataclass(frozen=True)
class School:
    """Where networks are trained: a ``studio``, the ``setup`` of the bench, the ``seed`` of pairs and calibration, and
    a ``budget``."""

    studio: Studio
    setup: Setup
    seed: int
    budget: Budget

    def network(self, cell: Cell) -> tuple[LearnedSolver, float | None]:
        """The trained network of a ``cell``, and processor seconds of its training; None where it was trained before,
        or in parts.

        One that was interrupted goes on where it stopped. Taught by pictures alone, one network serves all patterns.
        """
        from mitsim.learn.learned_solver import read_network

        own, patterns = cell, cell.patterns
        if cell.training == PICTURES:
            own = replace(cell, training=IDEALISED, patterns="uniform")
        file = f"{own.method} {own.training} {own.patterns} {own.seed} {self.budget.pairs} {self.budget.steps}.pt"
        place = self.studio.shared_folder("networks") / file.replace(":", "")
        seconds = None
        with FileLock(place.with_suffix(".lock")):
            if not place.is_file():
                seconds = self._train(own, place)
        model = read_network(place, "cpu")
        if cell.training == PICTURES:
            model = _for_any_camera(model, self._factors(RENDERED), self._store(IDEALISED, patterns).patterns)
        return model, seconds

    def _train(self, cell: Cell, place: Path) -> float | None:
        from mitsim.learn.training import train_network

        store, factors = self._store(cell.training, cell.patterns), self._factors(cell.training, cell.patterns)
        whole = not Path(f"{place}.unfinished").is_file()
        sums, started = self._sums(store, factors, cell.method == PREPROCESSED), time.process_time()
        train_network(
            store,
            factors,
            Training(method=cell.method, steps=self.budget.steps, seed=cell.seed),
            place,
            resume=True,
            sums=sums,
        )
        return time.process_time() - started if whole else None

    def _sums(self, store: PairStore, factors: Factors, keep: bool) -> Sums:
        """What the frames of a ``store`` add up to, read once for all methods and seeds that ``keep`` frames or not."""
        from mitsim.core.job import Job
        from mitsim.learn.training import Sums
        from mitsim.reconstruct.solvers import SOLVERS

        prepared = SOLVERS[TIKHONOV].init(factors, store.patterns)

        def write(path: Path) -> None:
            sums = vars(Sums.of(store, prepared, Job(), keep))
            with path.open("wb") as file:
                np.savez(
                    file, basis=prepared.left.basis, **{name: held for name, held in sums.items() if held is not None}
                )

        path = self.studio.made_once("sums", f"{store.folder.name}{' frames' if keep else ''}.npz", write)
        with path.open("rb") as file:
            held = read_npz(file, path)
        if not np.array_equal(held.pop("basis"), prepared.left.basis):  # another machine's rounding, whose signs differ
            path.unlink()
            return self._sums(store, factors, keep)
        low, high = held.pop("noise")
        return Sums(**held, noise=(float(low), float(high)))

    def _store(self, training: str, patterns: str) -> PairStore:
        """The pairs of a set, made once; an interrupted making goes on."""
        from mitsim.learn.pair_store import PairStore
        from mitsim.learn.pairs import make_pairs

        name = f"{training} {patterns} {self.budget.pairs}".replace(":", "")
        folder = self.studio.shared_folder("pairs") / name
        with FileLock(folder.with_suffix(".lock")):
            if not _is_complete(folder):
                vary = variation(self.budget.groups) if training == VARIED else None
                request = Request.of(patterns=patterns, seed=self.seed)
                asked = PairsRequest(
                    capture=request, count=self.budget.pairs, idealised=training == IDEALISED, vary=vary
                )
                make_pairs(self._opening(training), asked, Task(folder, resume=(folder / PAIRS).is_file()))
        return PairStore.open(folder)

    def _opening(self, training: str) -> Callable[..., Any]:
        setup = self._setup(training)

        def opening(drawn: dict[str, str]) -> Any:
            parameters: dict[str, Any] = {**dict(setup.parameters), **drawn}
            return open_bench(setup.scene, setup.variant, setup.camera, setup.projector, setup.outside, **parameters)

        return opening

    def _setup(self, training: str) -> Setup:
        own = place_setup(self.studio, self.setup, RENDERED)
        return own.with_parameters(mask_distance=ELSEWHERE_MM) if training == ELSEWHERE else own

    def _factors(self, training: str, patterns: str = "uniform") -> Factors:
        """The calibration of a training set: of idealised pairs their own exact factors."""
        if training == IDEALISED:
            return load_calibration(self._store(training, patterns).folder / "calibration")
        if training == ELSEWHERE:
            return self.studio.factors(self._setup(training), self.seed)
        return factors_of(self.studio, self.setup, self.seed)

    def factors_for(self, case: Case) -> Factors:
        """The factors of a ``case`` with the identity of the bench's camera, as a network asks for them."""
        identity = self._factors(RENDERED).manifest.camera
        status = Status(Verdict.CALIBRATED, "Factors of a test case")
        manifest = CalibrationManifest(
            camera=identity, centre=case.centre, estimate=str(status), verdict=status.verdict.value, versions={}
        )
        return Factors(*case.sides, manifest, status)


def variation(groups: int) -> Variation:
    """How the benches of a varied set differ: by as much as the tests do, but for gloss and lamps; ``groups`` of
    them."""
    return Variation(
        groups=groups,
        exposure_fraction=(_FULL_EXPOSURE * DIM_FRACTION, _FULL_EXPOSURE),
        scene={"sheet_z": (_NEAREST_MM, _FARTHEST_MM)},
        mask={"mask_rows_um": (-DRIFT_UM, DRIFT_UM), "mask_columns_um": (-DRIFT_UM, DRIFT_UM)},
    )


def _is_complete(folder: Path) -> bool:
    from mitsim.learn.pair_store import read_pairs_manifest

    return (folder / PAIRS).is_file() and read_pairs_manifest(folder).status == "complete"


def _for_any_camera(model: LearnedSolver, factors: Factors, patterns: tuple[FloatArray, FloatArray]) -> LearnedSolver:
    """A network that no frame taught, for other ``factors`` and ``patterns``, at any noise."""
    manifest = model.manifest.model_copy(update={"camera": factors.manifest.camera, "noise": (0.0, math.inf)})
    return replace(model, manifest=manifest, sides=factors.sides, patterns=patterns)

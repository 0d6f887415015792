"""Learned methods on rendered frames: their gain over the best classical image, by training set and test condition.

Paper, section "Deep Network-based Denoising vs Reconstruction": on simulated frames learned methods look best; on real
ones FlatNet fails under uniform light; under coded light all do well; "catastrophic results in case of any mismatch".
Here frames are rendered where the paper's are real. A gain is of each print, over the classical image of the same
frames with the highest PSNR.

With `--data DIR`, factors of codes learned from one real capture of a FlatCam (:mod:`mitsim.studies.twin_study`) make
the frames that teach networks. The other capture is reconstructed and compared with the authors' image, because no
truth is known.

The bench of rendered frames is the middle of the shipped photograph, 64 x 64 projector pixels, so that a training step
takes a quarter of the time. The study needs torch and hours, and therefore is no part of `mitsim study all`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from filelock import FileLock
from scipy.ndimage import gaussian_filter

from mitsim.acquire.exposure import drift_mask, taken_off
from mitsim.api.bench import open_bench
from mitsim.bench.request import Request, Task
from mitsim.core.arrays import FloatArray, read_npz
from mitsim.core.configuration import locate
from mitsim.core.errors import MitsimError
from mitsim.core.files import PAIRS
from mitsim.core.job import Job
from mitsim.core.manifests import CalibrationManifest
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import stream
from mitsim.devices.session import Drift
from mitsim.learn.pair_store import WHITE
from mitsim.learn.pairs import DrawnPictures
from mitsim.learn.requests import (
    FLATNET,
    PLUG_AND_PLAY,
    PREPROCESSED,
    REFINED,
    UNROLLED,
    PairsRequest,
    Training,
    Variation,
)
from mitsim.learn.verbs import check_torch
from mitsim.metrics import psnr, ssim
from mitsim.reconstruct.factors import Factors, load_calibration
from mitsim.reconstruct.misfit import UNEXPLAINED
from mitsim.reconstruct.request import MARKOV, NONNEGATIVE, TIKHONOV, TV
from mitsim.reconstruct.shifted_codes import TURNS
from mitsim.reconstruct.solution import Solution, Status, Verdict
from mitsim.reconstruct.solver import Accumulator, Prepared, prepare
from mitsim.reconstruct.solvers import solve_nonnegative, solve_tv
from mitsim.report import EQUAL_PEAK, IDEALISED, RENDERED
from mitsim.report.lit_scene import LAMBDAS, accumulate
from mitsim.report.pages import Value
from mitsim.studies.framework.claims import Gain, Level
from mitsim.studies.framework.experiment import QUICK_IMAGES, Found, Point, Results, Scope, Setup, Study
from mitsim.studies.framework.panels import Bars, Images, Pivot
from mitsim.studies.framework.studio import Studio, flags_of, single_precision
from mitsim.studies.twin_files import SOURCES, TwinFiles
from mitsim.studies.twin_study import Learned, Measured, correlation, read_captures

if TYPE_CHECKING:
    from pandas import DataFrame

    from mitsim.learn.learned_solver import LearnedSolver
    from mitsim.learn.pair_store import PairStore
    from mitsim.learn.training import Sums

# ---- The bench ----

SIDE = 64
_CANVAS_PIXELS, _CANVAS_MM = 3 * SIDE, 180.0
"""Width of the projector's picture, whose last third is the window of the photograph's pixels."""
_SHEET_MM = 64.0
DEPTH, DRIFT, DIM, GLOSS, AMBIENT = "depth", "drift", "dim", "gloss", "ambient"
MISMATCHES = (DEPTH, DRIFT, GLOSS, AMBIENT)
"""Conditions that a calibration does not include."""
PLACES = {RENDERED: (IDEALISED, RENDERED, DRIFT, DIM), DEPTH: (DEPTH,), GLOSS: (GLOSS,), AMBIENT: (AMBIENT,)}
_DEPTH_MM = 405.0
_DRIFT_UM = 4.0
"""Motion of the mask down the rows, which moves the image by 0.9 pixels."""
_DIM = 0.1
_COAT = """<bsdf type="roughplastic" id="sheet_bsdf">
            <string name="distribution" value="ggx"/>
            <float name="alpha" value="0.1"/>
            <float name="int_ior" value="1.49"/>
            <texture name="diffuse_reflectance" type="bitmap">"""
_PAINT = """<bsdf type="diffuse" id="sheet_bsdf">
            <texture name="reflectance" type="bitmap">"""


def place_setup(studio: Studio, setup: Setup, place: str) -> Setup:
    """Return a setup of :data:`PLACES`; MitsimError where a shipped scene lacks the changed part."""
    shipped = "lamp_bench" if place == AMBIENT else "photograph"

    def write(folder: Path) -> None:
        from skimage import io

        folder.mkdir()
        text = locate(shipped, "scenes", "scene.xml").read_text(encoding="utf-8")
        fov = math.degrees(2 * math.atan(_CANVAS_MM / 2 / 400))
        changes = {'name="fov" value="33.398488"': f'name="fov" value="{fov:.6f}"'}
        changes |= {_PAINT: _COAT} if place == GLOSS else {}
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
    own = replace(setup, scene=str(folder / "scene.xml")).with_parameters(sheet_mm=_SHEET_MM)
    return own.with_parameters(sheet_z=_DEPTH_MM) if place == DEPTH else own


# -------- Frames of a print under a condition


@dataclass(frozen=True, eq=False)
class Case:
    """A print under one condition and one family of patterns, as stored in a file.

    Attributes
    ----------
    truth, left, right, rows, columns
        (n, n) apparent reflectance, (m, n) factors, patterns P_L and P_R.
    quarters, energy, basis
        sum of all frames (:class:`mitsim.reconstruct.solver.Accumulator`), and first row of its singular vectors.
    unexplained
        rms part of the frames, beyond noise, that no image gives.
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
        return prepare(self.left, self.right, self.rows, self.columns, centre=bool(self.centre))

    def sums(self, prepared: Prepared) -> Accumulator:
        """Return the sum of all frames; MitsimError if its singular vectors are not those of ``prepared``."""
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
        with path.open("wb") as file:
            np.savez(file, allow_pickle=False, **vars(self))

    @classmethod
    def read(cls, path: Path) -> Case:
        with path.open("rb") as file:
            return cls(**read_npz(file, path))


def case_of(studio: Studio, setup: Setup, condition: str, patterns: str, seed: int) -> Case:

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
    return studio.factors(place_setup(studio, setup.with_print(None), RENDERED), seed)


# -------- Networks


@dataclass(frozen=True)
class Budget:
    pairs: int
    steps: int
    groups: int


FULL = Budget(pairs=256, steps=800, groups=16)
"""About a minute of a processor per training."""
QUICK = Budget(pairs=16, steps=6, groups=2)
"""First look; such networks show nothing."""
VARIED, ELSEWHERE, PICTURES = "varied", "elsewhere", "pictures"
TRAININGS = (IDEALISED, RENDERED, VARIED)
_ELSEWHERE_MM = 1.0


@dataclass(frozen=True)
class Cell:
    training: str
    patterns: str
    method: str
    seed: int


@dataclass(frozen=True)
class School:
    studio: Studio
    setup: Setup
    seed: int
    budget: Budget

    def network(self, cell: Cell) -> tuple[LearnedSolver, float | None]:
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
        if training == IDEALISED:
            return load_calibration(self._store(training, patterns).folder / "calibration")
        if training == ELSEWHERE:
            return self.studio.factors(self._setup(training), self.seed)
        return calibrated(self.studio, self.setup, self.seed)

    def factors_for(self, case: Case) -> Factors:
        identity = self._factors(RENDERED).manifest.camera
        status = Status(Verdict.CALIBRATED, "Factors of a test case")
        manifest = CalibrationManifest(
            camera=identity, centre=bool(case.centre), estimate=str(status), verdict=status.verdict.value, versions={}
        )
        return Factors(case.left, case.right, manifest, status)


# ---- Points ----

FAMILIES = ("uniform", "dots:4", "dots:7")
_TRAININGS = 3
NONE, AUTOMATIC, BEST = "none", "automatic", "best"
CLASSICAL = (TIKHONOV, MARKOV, TV, NONNEGATIVE)
_AROUND = tuple(float(weight) for weight in np.logspace(-0.75, 2.0, 12))
"""Weights of iterative methods over the automatic one."""
_DETAIL_PIXELS = 1.5
"""Blur [pixels] that separates detail."""


def cells(seeds: Sequence[int], families: Sequence[str], quick: bool) -> list[Cell]:
    methods = (REFINED, UNROLLED) if quick else (REFINED, FLATNET, UNROLLED)
    kinds = [*product(TRAININGS[:2] if quick else TRAININGS, families, methods)]
    if not quick:
        kinds += [*product((ELSEWHERE,), families, (REFINED,)), *product((PICTURES,), families, (PLUG_AND_PLAY,))]
        # It reads frames: under many patterns a step takes as many times as long.
        kinds += [*product(TRAININGS, families[:1], (PREPROCESSED,))]
    order = (PLUG_AND_PLAY, REFINED, FLATNET, UNROLLED, PREPROCESSED)
    return [Cell(*kind, seed) for seed in seeds for kind in sorted(kinds, key=lambda kind: order.index(kind[2]))]


def _points(scope: Scope) -> Sequence[Point]:
    check_torch()
    seed, setup = scope.seeds[0], scope.setup
    if scope.data is not None:
        return [Point.of(setup, data=scope.data, held_out=name, seed=seed) for name in _captures(scope.data)]
    if scope.pictures == (None,):
        raise MitsimError("study learned: has a bench of its own, the middle of the photograph; leave the scene out")
    families, budget = scope.choose(FAMILIES, FAMILIES[:1]), QUICK if scope.quick else FULL
    places, prints = scope.choose(tuple(PLACES), (RENDERED, DEPTH)), ",".join(map(str, scope.pictures))
    shared: dict[str, Value] = {"families": " ".join(families), "noise": seed}
    shown = [Point.of(setup.with_print(name), place=place, **shared) for place, name in product(places, scope.pictures)]
    seeds = scope.choose(tuple(seed + more for more in range(_TRAININGS)), (seed,))
    networks = [
        Point.of(setup, **vars(cell), **shared, places=" ".join(places), prints=prints, **vars(budget))
        for cell in cells(seeds, families, scope.quick)
    ]
    return [*shown, *networks]


@single_threaded_blas()
def _measure(studio: Studio, point: Point) -> Found:
    import torch

    torch.set_num_threads(1)  # processes share the processors, and a training ends with the same bits at one number
    values: dict[str, Any] = dict(point.values)
    if "held_out" in values:
        return transfer(values["data"], values["held_out"], values["seed"])
    rows: list[dict[str, Value]] = []
    arrays: dict[str, FloatArray] = {}
    if "place" in values:
        for condition, family in product(PLACES[values["place"]], values["families"].split()):
            case = case_of(studio, point.setup, condition, family, values["noise"])
            named = {"picture": point.setup.picture, "condition": condition, "patterns": family, "training": NONE}
            arrays[f"{condition} {family} truth"] = case.truth
            for row, image in classical_rows(case):
                shown = f"{condition} {family} {row['method']} {row['weight']}"
                rows.append({**named, "seed": values["noise"], "shown": shown, **row})
                arrays[shown] = image
        kept = point.setup.picture in QUICK_IMAGES
    else:
        cell = Cell(*(values[name] for name in ("training", "patterns", "method", "seed")))
        school = School(
            studio, point.setup, values["noise"], Budget(*(values[n] for n in ("pairs", "steps", "groups")))
        )
        model, seconds = school.network(cell)
        conditions = [each for place in values["places"].split() for each in PLACES[place]]
        for condition, picture in product(conditions, values["prints"].split(",")):
            case = case_of(studio, point.setup.with_print(picture), condition, cell.patterns, values["noise"])
            factors = school.factors_for(case)
            own = replace(model, sides=factors.sides) if cell.training == PICTURES else model
            row, image = network_row(own, factors, case)
            named = {"picture": picture, "condition": condition, "shown": f"{condition} {picture}"}
            rows.append({**vars(cell), **named, "train_s": seconds, **row})
            if picture in QUICK_IMAGES:
                arrays[f"{condition} {picture}"] = image
        kept = cell.seed == values["noise"]
    return Found(tuple(rows), single_precision(arrays) if kept else {})


# -------- Images and their scores


def scores(image: FloatArray, truth: FloatArray) -> dict[str, Value]:
    """Return PSNR and SSIM of an image (n, n), and correlation and relative rms of its detail.

    Strong detail that does not correlate with the truth's is invented.
    """
    own, true = (each - gaussian_filter(each, _DETAIL_PIXELS) for each in (image, truth))
    correlated = float(np.corrcoef(own.ravel(), true.ravel())[0, 1])
    energy = float(own.std() / true.std())
    return {"psnr_db": psnr(image, truth), "ssim": ssim(image, truth), "detail": correlated, "detail_energy": energy}


def classical_rows(case: Case) -> Iterator[tuple[dict[str, Value], FloatArray]]:
    from mitsim.learn.learned_solver import beyond_noise

    prepared = case.prepare()
    sums = case.sums(prepared)
    problem, alike = prepared.problem(sums), _with_correlation(prepared, sums)
    for method in CLASSICAL:
        solve: Any = {
            TIKHONOV: partial(prepared.solve, sums), MARKOV: partial(alike[0].solve, alike[1]),
            TV: partial(solve_tv, prepared, sums), NONNEGATIVE: partial(solve_nonnegative, prepared, sums),
        }[method]  # fmt: skip
        started = time.process_time()
        own = solve("auto")
        seconds = time.process_time() - started
        others = _AROUND if method in (TV, NONNEGATIVE) else [each * problem.scale / own.lam for each in LAMBDAS]
        best = max(own, *(solve(own.lam * factor) for factor in others), key=lambda each: psnr(each.image, case.truth))
        for weight, found in ((AUTOMATIC, own), (BEST, best)):
            beyond = beyond_noise(prepared, problem, found.image)[1]
            row: dict[str, Value] = {"method": method, "weight": weight, "beyond": beyond, "seconds": seconds}
            yield row | _flags(found, case) | scores(found.image, case.truth), found.image


def _with_correlation(prepared: Prepared, sums: Accumulator) -> tuple[Prepared, Accumulator]:
    """Return the model and rotated sums for correlated neighbouring pixels."""
    other = prepared.with_correlation()
    turns = []
    for before, after in ((prepared.left, other.left), (prepared.right, other.right)):
        turn = np.zeros((len(before.singular), len(after.singular)))
        for index, (one, two) in enumerate(zip(before.slabs, after.slabs, strict=True)):
            turn[before.columns(index)] += one.matrix.T @ two.matrix
        turns.append(turn)
    return other, Accumulator.of_sums(other, turns[0].T @ sums.quarters @ turns[1], sums.energy)


def _flags(found: Solution, case: Case) -> dict[str, Value]:
    unexplained = float(case.unexplained)
    others = ("frames fit no image",) * (unexplained > UNEXPLAINED)
    return {"unexplained": unexplained, **flags_of(found.status, others=others)}


def network_row(model: LearnedSolver, factors: Factors, case: Case) -> tuple[dict[str, Value], FloatArray]:
    """Return scores, flags and image of a network.

    Flags are for frames that the image does not reproduce (``flag_image``), frames that no image gives
    (``flag_frames``), another camera or calibration, and unknown noise.
    """
    from mitsim.learn.learned_solver import beyond_noise

    prepared: Any = model.init(factors, (case.rows, case.columns))
    sums, started = case.sums(prepared), time.process_time()
    solution = model.compute(prepared, sums, "auto")
    seconds = time.process_time() - started
    beyond = beyond_noise(prepared, prepared.problem(sums), solution.image)[1]
    image, camera = beyond > UNEXPLAINED, bool(prepared.doubts)
    frames, noise = float(case.unexplained) > UNEXPLAINED, len(solution.status.flags) > image + camera
    row: dict[str, Value] = {"beyond": beyond, "seconds": seconds, "flag_image": image, "flag_frames": frames}
    row |= {"flag_camera": camera, "flag_noise": noise, "misfit": float(image or frames)}
    return row | _flags(solution, case) | scores(solution.image, case.truth), solution.image


# -------- Real captures, and a twin that teaches

AUTHORS, REAL, SIMULATED = "authors' image", "real", "simulated"
_TAUGHT = "gb"
"""Plane whose factors teach networks; those of the others differ by half a pixel and a gain."""
_MARGIN = 1.5
"""Factor by which the noise range exceeds the known capture's."""
_COLOURS = (("r",), ("gb", "gr"), ("b",))
_BACK = {"transposed, mirrored": "transposed, upside down", "transposed, upside down": "transposed, mirrored"}
TEACHING = {"pairs": 192, "steps": 300, "batch": 2}
"""Pictures, steps and batch of a training."""


def _captures(data: str) -> Mapping[str, tuple[Path, Path]]:
    captures = TwinFiles.find(Path(data), "learned").captures
    if not captures:
        raise MitsimError(f"study learned: needs captures of a FlatCam; give --data FOLDER with {SOURCES}")
    return captures


def twin_camera(measured: Measured, learned: Learned) -> tuple[tuple[FloatArray, FloatArray], Prepared]:
    sides = learned.codes.factors(measured.offset, measured.plane)
    rows, columns = (np.ones((side.shape[1], 1)) for side in sides)
    return sides, prepare(*sides, rows, columns, centre=True)


def noise_range(planes: Sequence[Measured], learned: Learned) -> tuple[float, float]:
    """Return the range of the twin's white noise [DN of the taught plane]: the noise of known ``planes`` to their whole
    unexplained part, over each plane's gain.
    """
    gains = learned.codes.gains
    scales = [abs(gains[_TAUGHT] / gains[each.plane]) for each in planes]
    noise = [scale * float(each.noise.std()) for scale, each in zip(scales, planes, strict=True)]
    left = [scale * float(np.sqrt(each)) for scale, each in zip(scales, learned.codes.variances, strict=True)]
    return min(noise) / _MARGIN, max(left) * _MARGIN


def twin_sums(prepared: Prepared, noise: tuple[float, float], truths: FloatArray, seed: int) -> Sums:
    """Return the sums of idealised frames of ``truths`` (N, n, n), 0 to 1, with white noise."""
    from mitsim.learn.training import Sums

    weights, deviations = [], []
    for number, truth in enumerate(truths):
        draws = stream(seed, "transfer", number)
        deviations.append(float(np.exp(draws.uniform(*np.log(noise)))))
        sums = prepared.sigma * prepared.coefficients(truth)
        weights.append((sums + deviations[-1] * draws.standard_normal(sums.shape)).astype(np.float32))
    return Sums(truths, np.stack(weights), np.square(deviations), noise)


def teach(method: str, prepared: Prepared, sums: Sums, seed: int) -> Any:
    from mitsim.learn.training import Trainer, first_network

    request = Training(method=method, steps=TEACHING["steps"], batch=TEACHING["batch"], seed=seed)
    shape = prepared.left.scene_size, prepared.right.scene_size
    trainer = Trainer(request, prepared, sums, first_network(request, shape))
    trainer.choose()
    while not trainer.is_over():
        trainer.go_on(Job())
    trainer.network.load_state_dict(trainer.best)
    return trainer.network.eval()


def _image(prepared: Prepared, frame: FloatArray, method: str, network: Any) -> tuple[FloatArray, float]:
    import torch

    from mitsim.learn.learned_solver import beyond_noise, datum_variance
    from mitsim.learn.methods import Data, Diagonal

    sums = prepared.accumulator()
    sums.add(frame, 0, 0)
    problem = prepared.problem(sums)
    if network is None:
        found = solve_tv(prepared, sums).image if method == TV else prepared.solve(sums).image
    else:
        like = next(network.parameters())
        data = Data.of(problem.projected[None], datum_variance(problem), like)
        with torch.no_grad():
            found = network.images(data, Diagonal.of(prepared, like))[0, 0].numpy().astype(np.float64)
    return found, beyond_noise(prepared, problem, found)[1]


def transfer(data: str, held_out: str, seed: int) -> Found:
    """Return rows and images of a capture ``held_out``, by codes and networks of the others in the folder ``data``.

    MitsimError for files that are no such captures.
    """
    planes = read_captures(_captures(data), seed)
    known = [each for each in planes if each.capture != held_out]
    learned = Learned.of(known)
    seen_by = {
        each.plane: (learned.see(each), *twin_camera(each, learned)) for each in planes if each.capture == held_out
    }
    pictures, n = DrawnPictures(seed), len(planes[0].scene)
    truths = np.stack([pictures.draw(number, n) / np.float32(WHITE) for number in range(TEACHING["pairs"])])
    taught = seen_by[_TAUGHT][2]
    sums = twin_sums(taught, noise_range(known, learned), truths, seed)
    networks = {TIKHONOV: None, TV: None}
    rows: list[dict[str, Value]] = []
    images = {(AUTHORS, plane): measured.scene for plane, (measured, *_) in seen_by.items()}
    for method in (TIKHONOV, TV, REFINED, UNROLLED):
        started = time.process_time()
        network = None if method in networks else teach(method, taught, sums, seed)
        named = {"held_out": held_out, "method": method, "train_s": time.process_time() - started if network else None}
        for plane, (measured, (left, right), prepared) in seen_by.items():
            frames = {REAL: measured.frame}
            if plane == _TAUGHT:
                frames[SIMULATED] = np.asarray(left @ measured.scene @ right.T + measured.noise)
            for kind, frame in frames.items():
                seen, beyond = _image(prepared, frame, method, network)
                like = correlation(np.maximum(seen, 0), measured.scene)
                rows.append({**named, "picture": measured.name, "frame": kind, "correlation": like, "beyond": beyond})
                if kind == REAL:
                    images[method, plane] = seen
    turn, arrays = TURNS[_BACK.get(learned.pose.orientation, learned.pose.orientation)], {}
    for shown in dict.fromkeys(name for name, _ in images):
        colours = [turn(np.mean([images[shown, plane] for plane in each], axis=0)) for each in _COLOURS]
        arrays[shown] = np.stack(colours, axis=-1)
        scale = np.vdot(arrays[shown], arrays[AUTHORS]) / np.vdot(arrays[shown], arrays[shown])
        arrays[shown] = np.clip(float(scale) * arrays[shown], 0, 1)
    return Found(tuple(rows), single_precision(arrays))


# -------- The study


def compare(results: Results) -> Results:
    """Add ``gain_db`` and ``detail_gain`` over the best classical image, ``below_db`` below a calibrated bench, and
    ``network``.
    """
    rows = results.frame
    if "weight" not in rows:
        return results
    same = ["picture", "patterns", "condition"]
    best = rows[rows["weight"] == BEST].sort_values("psnr_db", key=lambda level: level.astype(float))
    best = best.drop_duplicates(same, keep="last").set_index(same)[["psnr_db", "detail"]].astype(float)

    def of_best(condition: Any) -> DataFrame:
        return best.reindex([*zip(rows["picture"], rows["patterns"], condition, strict=True)]).set_axis(rows.index)

    own = rows[["psnr_db", "detail"]].astype(float) - of_best(rows["condition"])
    home = of_best(rows["condition"].where(~rows["condition"].isin(MISMATCHES), RENDERED))
    below = rows["psnr_db"].astype(float) - home["psnr_db"]
    network = rows["method"] + " " + rows["training"] + " " + rows["patterns"]
    return results.with_columns(gain_db=own["psnr_db"], detail_gain=own["detail"], below_db=below, network=network)


def _gains(
    claim: str, training: str, condition: str, patterns: str, method: Any = (REFINED, FLATNET, UNROLLED), **more: Any
) -> Level:
    where = {"training": training, "condition": condition, "patterns": patterns, "method": method}
    return Level(
        claim, **{"where": where, "column": "gain_db", "each": "method", "every": "seed", "optional": True, **more}
    )


_NETWORKS: dict[str, Any] = {"training": (*TRAININGS, ELSEWHERE, PICTURES)}
_REAL: dict[str, Any] = {"frame": REAL}
_BY_NETWORK = ("method", "training")
STUDY = Study(
    "learned",
    "Learned methods",
    "What do networks gain over the best classical image, and what do they lose on another bench than they learned?",
    points=_points,
    measure=_measure,
    derive=compare,
    claims=(
        _gains("Trained and tested on idealised frames, {method} exceeds the best classical image (uniform light)",
               IDEALISED, IDEALISED, "uniform", at_least=0, paper="best"),
        _gains("{method} of idealised pairs fails on real frames under uniform light (by 3 dB)", IDEALISED, RENDERED,
               "uniform", at_most=-3, paper="fails to recover", method=FLATNET),
        _gains("A U-Net after least squares removes artefacts (uniform light)", RENDERED, RENDERED, "uniform",
               at_least=0, method=REFINED),
        _gains("A U-Net after least squares resolves no more: detail correlates by at most 0.05 more (uniform light)",
               RENDERED, RENDERED, "uniform", at_most=0.05, paper="fails to improve the spatial resolution",
               method=REFINED, column="detail_gain", unit=""),
        _gains("{method} of idealised pairs is within 3 dB of the best classical image under 49 dots", IDEALISED,
               RENDERED, "dots:7", at_least=-3, paper="similar to least squares"),
        Level("No mismatch costs 10 dB against the best classical image ({condition})", paper="catastrophic",
              where={**_NETWORKS, "condition": MISMATCHES}, column="gain_db", at_least=-10, each="condition",
              every="network", optional=True),
        _gains("{method} of rendered pairs is 1 dB over the best classical image under uniform light", RENDERED,
               RENDERED, "uniform", at_least=1),
        _gains("{method} of rendered pairs is no worse than the best classical image under 49 dots (by 0.5 dB)",
               RENDERED, RENDERED, "dots:7", at_least=-0.5),
        Gain("Benches that vary in training make networks bear a mismatch ({patterns})", {"training": VARIED},
             {"training": RENDERED}, where={"condition": MISMATCHES, "method": (REFINED, FLATNET, UNROLLED)},
             column="gain_db", each="patterns", every="method", optional=True),
        Level("Misfit flags images 3 dB below the best classical image of a calibrated bench ({patterns}; 90 %)",
              where={**_NETWORKS, "below_db": lambda below: below < -3}, column="misfit", unit="", at_least=0.9,
              each="patterns", optional=True),
        Level("Misfit flags few others ({patterns}; 10 %)", where={**_NETWORKS, "below_db": lambda below: below >= -3},
              column="misfit", unit="", at_most=0.1, each="patterns", optional=True),
        Gain("On real captures an unrolled network, taught by a twin, correlates as total variation does (0.01)",
             {"method": UNROLLED}, {"method": TV}, where=_REAL, column="correlation", unit="", at_least=-0.01,
             optional=True),
    ),
    panels=(
        Bars(_BY_NETWORK, file="gain", x="gain_db", x_label="PSNR over the best classical image [dB]", where=_NETWORKS,
             title="Gain of each network (training set)", colour="patterns", each="condition"),
        Images(_BY_NETWORK, title="Uniform light, networks of rendered pairs", array="{shown}", each="condition",
               before={"{condition} {patterns} truth": "truth"}, down=("picture",),
               where={"patterns": "uniform", "training": (NONE, RENDERED), "weight": (BEST, None),
                      "method": (TIKHONOV, TV, REFINED, FLATNET, UNROLLED)}),
        Images("method", file="flatcam", title="Real captures, by networks of a simulated twin", array="{method}",
               before={AUTHORS: AUTHORS}, down=("held_out",), caption="", where=_REAL),
    ),
    tables=(
        Pivot(("method", "training", "weight"), columns="condition", value="psnr_db", each="patterns",
              title="Mean PSNR [dB]"),
        Pivot(_BY_NETWORK, columns="condition", value="gain_db", each="patterns", where=_NETWORKS,
              title="Gain over the best classical image [dB]"),
        Pivot(_BY_NETWORK, columns={"train_s": "training [s]", "seconds": "image [s]", "detail": "detail, correlation",
              "detail_energy": "detail, rms over true"}, where={"condition": RENDERED}, each="patterns",
              title="Processor time, and detail on rendered frames"),
        Pivot(("picture", "frame"), columns="method", value="correlation", where={"frame": (REAL, SIMULATED)},
              title="Correlation with the authors' image"),
        Pivot(("picture", "frame"), columns="method", value="beyond", where={"frame": (REAL, SIMULATED)},
              title="Part of the frame that an image would not give, rms"),
    ),
    kept=True,
    note="The bench is the middle of the photograph: its camera, 64 x 64 projector pixels. Trained: on pairs of the "
    f"idealised model; rendered; rendered on {FULL.groups} varied benches (sheet 5 mm either way, mask 4 um either "
    "way, a tenth of the light to all of it); elsewhere: on a camera whose mask is at 1 mm, not 2; pictures: by "
    f"pictures alone. Each of {FULL.pairs} pairs, in {FULL.steps} steps ({QUICK.pairs} and "
    f"{QUICK.steps} of a first look). Tested: depth 5 mm behind the calibrated "
    "distance; drift of the mask by 4 um; dim, a tenth of the light; gloss, the coat of the gift card; ambient, a lamp "
    "of a tenth of the light, taken off. The best classical image is, print by print, that of the highest PSNR among "
    "Tikhonov, Markov, total variation and nonnegative at their best weights, which takes the truth to choose: no user "
    f"has it. {PREPROCESSED.capitalize()} networks read frames, so they are trained under uniform light alone. "
    "Exposure equal peak.",
)  # fmt: skip

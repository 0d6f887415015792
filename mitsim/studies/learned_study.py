"""Measure the gain of learned methods over the best classical image, and their loss on another bench.

The paper's section "Deep Network-based Denoising vs Reconstruction" states that learned methods are best on frames like
those of their training, with "catastrophic results in case of any mismatch". The gain is computed for each print, over
the classical image from the same frames with the highest PSNR. Each method has its best weight, which a user cannot
choose, because the choice needs the truth.

The bench is the middle of the shipped photograph, 64 x 64 projector pixels, so that a training step takes a quarter of
the time. Networks are trained on pairs of this bench, or of benches whose mask and exposure vary, and tested on the
bench as it is calibrated, and with the sheet 5 mm behind the calibrated distance.

With `--data DIR`, factors of codes learned from one real capture of a FlatCam (:mod:`mitsim.studies.twin_study`) make
the frames that teach a network. The other capture is reconstructed and compared with the authors' image, because no
truth is known.

The study needs torch and hours, and therefore is no part of `mitsim study all`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsim.bench.request import Request, Task
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import locate
from mitsim.core.errors import MitsimError
from mitsim.core.images import grey_png
from mitsim.core.job import Job
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import stream
from mitsim.learn.pair_store import WHITE
from mitsim.learn.pairs import DrawnPictures, make_pairs
from mitsim.learn.requests import FLATNET, REFINED, UNROLLED, PairsRequest, Training, Variation, check_torch
from mitsim.metrics import psnr
from mitsim.reconstruct.request import MARKOV, TIKHONOV, TV
from mitsim.reconstruct.solver import Prepared, Solution, prepare
from mitsim.reconstruct.solvers import SOLVERS, solve_tv
from mitsim.report import EQUAL_PEAK
from mitsim.report.lit_scene import LAMBDAS, accumulate
from mitsim.report.pages import Value
from mitsim.studies import find_files
from mitsim.studies.framework.claims import Gain, Level
from mitsim.studies.framework.experiment import QUICK_IMAGES, Found, Point, Scope, Setup, Study
from mitsim.studies.framework.panels import Bars, Images, Pivot
from mitsim.studies.framework.studio import Studio, flags_of, single_precision
from mitsim.studies.twin_study import Learned, Measured, correlation, read_captures

if TYPE_CHECKING:
    from mitsim.learn.networks import LearnedSolver, Sums

# -------- The bench, its networks, and the images of a print

SIDE = 64
_CANVAS_PIXELS, _CANVAS_MM, _SHEET_MM = 3 * SIDE, 180.0, 64.0
"""Width of the projector's picture, whose last third is the window of the photograph's pixels, and of the sheet."""
_FOV = 'name="fov" value="33.398488"'
SAME, DEEPER = "as calibrated", "5 mm deeper"
ONE, VARIED = "one bench", "varied benches"
METHODS = (REFINED, FLATNET, UNROLLED)
BEST = "best classical"
_AROUND = tuple(float(weight) for weight in np.logspace(-0.75, 2.0, 12))
"""Weights of total variation over the automatic one."""
FULL, QUICK = {"pairs": 256, "steps": 800, "groups": 16}, {"pairs": 16, "steps": 6, "groups": 2}
"""About a minute of a processor per training; a first look, whose networks show nothing."""


def middle(studio: Studio, setup: Setup, place: str = SAME) -> Setup:
    """Return the ``setup`` with the middle of the shipped photograph, whose sheet is at a place."""

    def write(folder: Path) -> None:
        folder.mkdir()
        text = locate("photograph", "scenes", "scene.xml").read_text(encoding="utf-8")
        if text.count(_FOV) != 1:
            raise MitsimError(f"study learned: the shipped photograph has no {_FOV!r}, which the study changes")
        fov = math.degrees(2 * math.atan(_CANVAS_MM / 2 / 400))
        (folder / "scene.xml").write_text(text.replace(_FOV, f'name="fov" value="{fov:.6f}"'), encoding="utf-8")
        canvas = np.zeros((SIDE, _CANVAS_PIXELS))
        canvas[:, -SIDE:] = 1
        (folder / "projector.png").write_bytes(grey_png(canvas))
        (folder / "reflectance.png").write_bytes(grey_png(np.full((SIDE, SIDE), 0.5)))

    scene = studio.made_once("scenes", "middle", write) / "scene.xml"
    own = replace(setup, scene=str(scene)).with_parameters(sheet_mm=_SHEET_MM)
    return own.with_parameters(sheet_z=405.0) if place == DEEPER else own


def network_of(studio: Studio, point: Point, training: str, method: str, patterns: str, seed: int) -> LearnedSolver:
    """Return a network of the study's folder, which is trained first if it is not there."""
    from mitsim.learn.networks import read_network, train_network
    from mitsim.learn.pair_store import PairStore

    setup, count, noise = middle(studio, replace(point.setup, picture=None)), int(point["pairs"]), int(point["noise"])

    def write_pairs(folder: Path) -> None:
        mask = {"mask_rows_um": (-4.0, 4.0), "mask_columns_um": (-4.0, 4.0)}  # 4 um move the image as 5 mm of depth do
        vary = Variation(groups=int(point["groups"]), exposure_fraction=(0.08, 0.8), mask=mask)
        asked = PairsRequest(capture=Request.of(patterns=patterns, seed=noise), count=count,
                             vary=vary if training == VARIED else None)  # fmt: skip
        make_pairs(studio.bench(setup), asked, Task(folder))

    def write_network(path: Path) -> None:
        store = PairStore.open(
            studio.made_once("pairs", f"{training} {patterns} {count}".replace(":", ""), write_pairs)
        )
        request = Training(method=method, steps=int(point["steps"]), seed=seed)
        train_network(store, studio.factors(setup, noise), request, path, resume=True)

    name = f"{method} {training} {patterns} {seed} {count} {point['steps']}.pt".replace(":", "")
    return read_network(studio.made_once("networks", name, write_network), "cpu")


def images_of(studio: Studio, point: Point) -> Found:
    """Return a row and an image for the best classical method and for each network; one print at one place."""
    patterns, noise = str(point["patterns"]), int(point["noise"])
    lit = studio.lit_scene(middle(studio, point.setup, str(point["place"])))
    factors = studio.factors(middle(studio, replace(point.setup, picture=None)), noise)
    frames = lit.rendered_frames(factors, lit.bench.family(patterns, noise), noise)
    family = frames.family.left.astype(np.float64), frames.family.right.astype(np.float64)
    plain = SOLVERS[TIKHONOV].init(factors, family)
    models = plain, plain.with_correlation()
    sums = accumulate(frames.exposer(frames.seconds(EQUAL_PEAK)), frames.family, frames.expected, models)
    found: dict[tuple[str, float], Solution] = {}
    for method, model, own in zip((TIKHONOV, MARKOV), models, sums, strict=True):
        found |= {(method, each): model.solve(own, each * model.problem(own).scale) for each in LAMBDAS}
    automatic = solve_tv(plain, sums[0])
    found |= {(TV, each): solve_tv(plain, sums[0], each * automatic.lam) for each in (1.0, *_AROUND)}
    quality = {name: psnr(each.image, lit.truth) for name, each in found.items()}
    best = max(quality, key=lambda name: quality[name])
    solved: list[tuple[dict[str, Any], Solution]] = [
        ({"training": "none", "method": BEST, "seed": noise, "classical": best[0]}, found[best])
    ]
    for training, method, seed in product((ONE, VARIED), METHODS, range(noise, noise + int(point["trainings"]))):
        network = network_of(studio, point, training, method, patterns, seed)
        prepared = replace(network.init(factors, family), left=plain.left, right=plain.right)  # whose sums these are
        solution = network.compute(prepared, sums[0], "auto")
        solved.append(({"training": training, "method": method, "seed": seed, "classical": ""}, solution))
    rows, arrays = [], {"truth": lit.truth}
    for named, solution in solved:
        db = psnr(solution.image, lit.truth)
        shown = f"{named['method']} {named['training']}"
        row = {"psnr_db": db, "gain_db": db - quality[best], "shown": shown, **flags_of(solution.status)}
        rows.append(point.row(**named, **row))
        arrays.setdefault(shown, solution.image)
    return Found(tuple(rows), single_precision(arrays) if point.setup.picture in QUICK_IMAGES else {})


# -------- Real captures, and a twin that teaches

AUTHORS = "authors' image"
_TAUGHT = "gb"
"""Plane whose factors teach the network; those of the others differ by half a pixel and a gain."""
TEACHING = {"pairs": 192, "steps": 300, "batch": 2}
"""Pictures, steps and batch of a training."""


def twin_camera(measured: Measured, learned: Learned) -> Prepared:
    sides = learned.codes.factors(measured.offset, measured.plane)
    rows, columns = (np.ones((side.shape[1], 1)) for side in sides)
    return prepare(*sides, rows, columns, centre=True)


def twin_sums(prepared: Prepared, noise: tuple[float, float], truths: FloatArray, seed: int) -> Sums:
    """Return sums of idealised frames of ``truths`` (N, n, n), 0 to 1, whose noise deviates within ``noise`` [DN]."""
    from mitsim.learn.networks import Sums

    weights, deviations = [], []
    for number, truth in enumerate(truths):
        draws = stream(seed, "transfer", number)
        deviations.append(float(np.exp(draws.uniform(*np.log(noise)))))
        sums = prepared.sigma * prepared.coefficients(truth)
        weights.append((sums + deviations[-1] * draws.standard_normal(sums.shape)).astype(np.float32))
    return Sums(truths, np.stack(weights), np.square(deviations), noise, np.arange(len(truths)))


def transfer(data: str, held_out: str, seed: int) -> Found:
    """Return rows and images of a capture ``held_out``, by codes and a network of the others in the folder ``data``.

    The training noise lies between the noise of the known frames and everything that the codes leave unexplained, so
    that the network treats the unexplained part as white noise. MitsimError for files that are no captures.
    """
    import torch

    from mitsim.learn.networks import Data, Diagonal, Trainer, datum_variance, first_network

    planes = read_captures(find_files(Path(data), "learned")[0], seed)
    known = [each for each in planes if each.capture != held_out]
    learned = Learned.of(known)
    seen = {each.plane: learned.see(each) for each in planes if each.capture == held_out}
    taught, n, pictures = twin_camera(seen[_TAUGHT], learned), len(planes[0].scene), DrawnPictures(seed)
    truths = np.stack([pictures.draw(number, n) / np.float32(WHITE) for number in range(TEACHING["pairs"])])
    gains, left = learned.codes.gains, np.sqrt(learned.codes.variances)
    scales = [abs(gains[_TAUGHT] / gains[each.plane]) for each in known]
    least = min(scale * float(each.noise.std()) for scale, each in zip(scales, known, strict=True))
    most = max(scale * float(each) for scale, each in zip(scales, left, strict=True))
    request = Training(method=UNROLLED, steps=TEACHING["steps"], batch=TEACHING["batch"], seed=seed)
    shape = taught.left.scene_size, taught.right.scene_size
    sums = twin_sums(taught, (least, max(least, most)), truths, seed)
    trainer, started = Trainer(request, taught, sums, first_network(request, shape)), time.process_time()
    trainer.run(Job())
    trainer.network.load_state_dict(trainer.best)
    network, taught_s = trainer.network.eval(), time.process_time() - started
    like, rows, arrays = next(network.parameters()), [], {AUTHORS: seen[_TAUGHT].scene}
    for plane, measured in seen.items():
        prepared = twin_camera(measured, learned)
        frames = prepared.accumulator([(measured.frame, 0, 0)])
        problem = prepared.problem(frames)
        found = {TIKHONOV: prepared.solve(frames).image, TV: solve_tv(prepared, frames).image}
        with torch.no_grad():
            data_of = Data.of(problem.projected[None], datum_variance(problem), like)
            found[UNROLLED] = network.images(data_of, Diagonal.of(prepared, like))[0, 0].numpy().astype(np.float64)
        for method, image in found.items():
            named: dict[str, Value] = {"held_out": held_out, "picture": measured.name, "method": method, "seed": seed}
            alike = correlation(np.maximum(image, 0), measured.scene)
            rows.append({**named, "correlation": alike, "train_s": taught_s if method == UNROLLED else None})
            if plane == _TAUGHT:
                scale = float(np.vdot(image, measured.scene) / np.vdot(image, image))
                arrays[method] = np.clip(scale * image, 0, 1)
    return Found(tuple(rows), single_precision(arrays))


# -------- The study


def _points(scope: Scope) -> Sequence[Point]:
    check_torch()
    if scope.data is not None:
        held_out = find_files(Path(scope.data), "learned")[0]
        return [Point.of(scope.setup, data=scope.data, held_out=name, seed=scope.seeds[0]) for name in held_out]
    if scope.pictures == (None,):
        raise MitsimError("study learned: has a bench of its own, the middle of the photograph; leave the scene out")
    shared: dict[str, Any] = {"noise": scope.seeds[0], "trainings": 1 if scope.quick else 3}
    shared |= QUICK if scope.quick else FULL
    families = scope.choose(("uniform", "dots:7"), ("uniform",))
    seeds = range(shared["noise"], shared["noise"] + shared["trainings"])
    # Networks are trained first, each by one process.
    networks = [
        Point.of(scope.setup, training=training, method=method, patterns=patterns, seed=seed, **shared)
        for patterns, training, method, seed in product(families, (ONE, VARIED), METHODS, seeds)
    ]
    shown = [
        Point.of(replace(scope.setup, picture=name), place=place, patterns=patterns, **shared)
        for patterns, name, place in product(families, scope.pictures, (SAME, DEEPER))
    ]
    return [*networks, *shown]


@single_threaded_blas()
def _measure(studio: Studio, point: Point) -> Found:
    import torch

    torch.set_num_threads(1)  # processes share the processors, and a training ends with the same bits at one number
    values: dict[str, Any] = dict(point.values)
    if "held_out" in values:
        return transfer(values["data"], values["held_out"], values["seed"])
    if "place" in values:
        return images_of(studio, point)
    started = time.process_time()
    network_of(studio, point, *(values[name] for name in ("training", "method", "patterns", "seed")))
    return Found((point.row(train_s=time.process_time() - started),))


_NETWORKS: dict[str, Any] = {"training": (ONE, VARIED), "place": (SAME, DEEPER)}
_OWN = {"training": ONE, "place": SAME}
_CAPTURES: dict[str, Any] = {"held_out": lambda name: isinstance(name, str)}
_BY_NETWORK = ("method", "training")
STUDY = Study(
    "learned",
    "Learned methods",
    "What do networks gain over the best classical image, and what do they lose on another bench than they learned?",
    points=_points,
    measure=_measure,
    claims=(
        Level("{method} exceeds the best classical image under uniform light", paper="best", column="gain_db",
              where=_OWN | {"patterns": "uniform"}, at_least=0, each="method", every="seed", optional=True),
        Level("{method} is no worse than the best classical image under 49 dots (by 0.5 dB)", column="gain_db",
              where=_OWN | {"patterns": "dots:7"}, at_least=-0.5, each="method", every="seed", optional=True),
        Level("5 mm of depth cost no network 10 dB against the best classical image ({patterns})", column="gain_db",
              paper="catastrophic", where={"training": ONE, "place": DEEPER}, at_least=-10, each="patterns",
              every="method", optional=True),
        Gain("Benches that vary in training make networks bear 5 mm of depth ({patterns})", {"training": VARIED},
             {"training": ONE}, where={"place": DEEPER, "method": METHODS}, column="gain_db", each="patterns",
             every="method", optional=True),
        Gain("On real captures an unrolled network, taught by a twin, correlates as total variation does (0.01)",
             {"method": UNROLLED}, {"method": TV}, where=_CAPTURES, column="correlation", unit="", at_least=-0.01,
             optional=True),
    ),
    panels=(
        Bars(_BY_NETWORK, file="gain", x="gain_db", x_label="PSNR over the best classical image [dB]", where=_NETWORKS,
             title="Gain of each network (training)", colour="patterns", each="place"),
        Images(_BY_NETWORK, title="Uniform light", array="{shown}", before={"truth": "truth"}, down=("picture",),
               each="place", where={"patterns": "uniform", "place": (SAME, DEEPER)}),
        Images("method", file="flatcam", title="Real captures, by a network of a simulated twin", array="{method}",
               before={AUTHORS: AUTHORS}, down=("held_out",), caption="", where=_CAPTURES),
    ),
    tables=(
        Pivot(_BY_NETWORK, columns="place", each="patterns", title="Mean PSNR [dB]",
              where={"place": (SAME, DEEPER)}),
        Pivot("picture", columns="method", value="correlation", where=_CAPTURES,
              title="Correlation with the authors' image"),
    ),
    kept=True,
    note="The bench is the middle of the photograph: its camera, 64 x 64 projector pixels. Trained on "
    f"{FULL['pairs']} rendered pairs in {FULL['steps']} steps ({QUICK['pairs']} and {QUICK['steps']} of a first look), "
    f"of one bench, or of {FULL['groups']} whose mask lies up to 4 um aside and whose light is a tenth to all. The "
    "best classical image is, print by print, that of the highest PSNR among Tikhonov, Markov and total variation at "
    "their best weights, which takes the truth to choose. Exposure equal peak.",
)  # fmt: skip

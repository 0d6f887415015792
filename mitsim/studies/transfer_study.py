"""`mitsim study transfer`: networks that a simulated twin taught, on real captures; beside classical images.

Codes of a FlatCam's mask are learned from one capture and its authors' image (:mod:`mitsim.studies.twin_study`).
Their factors are the twin: frames of drawn pictures through them, with noise, teach networks, and no real frame does.
The other capture is then reconstructed. How like the authors' image that is, is all that can be measured: no truth is
known.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from mitsim.bench.request import Request
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import stream
from mitsim.learn.pair_store import WHITE
from mitsim.learn.pairs import DrawnPictures
from mitsim.learn.requests import REFINED, UNROLLED, Training
from mitsim.learn.verbs import check_torch
from mitsim.reconstruct.request import TIKHONOV, TV
from mitsim.reconstruct.shifted_codes import TURNS
from mitsim.reconstruct.solver import Prepared, prepare
from mitsim.reconstruct.solvers import solve_tv
from mitsim.report import plots
from mitsim.studies.framework.page import Part
from mitsim.studies.framework.run import Findings
from mitsim.studies.twin_files import SOURCES, TwinFiles
from mitsim.studies.twin_study import Learned, Measured, correlation, read_captures

if TYPE_CHECKING:
    from mitsim.learn.methods import Method
    from mitsim.learn.training import Sums

NETWORKS, CLASSICAL = (REFINED, UNROLLED), (TIKHONOV, TV)
METHODS = (*CLASSICAL, *NETWORKS)
AUTHORS, SIMULATED = "authors' image", "simulated"
_TAUGHT = "gb"
"""Plane whose factors networks learn by; those of the others are the same but for half a pixel and a gain."""
_MARGIN = 1.5
"""Factor by which noise is drawn beyond that of the known capture's planes: what a network may meet unflagged."""
_COLOURS = (("r",), ("gb", "gr"), ("b",))
"""Planes that make the red, green and blue of an image."""
_BACK = {"transposed, mirrored": "transposed, upside down", "transposed, upside down": "transposed, mirrored"}
"""Orientations that turn an image back, where it is another one."""


@dataclass(frozen=True)
class Budget:
    """Number of ``pairs`` that teach, and ``steps`` and ``batch`` of a training."""

    pairs: int
    steps: int
    batch: int


FULL = Budget(pairs=192, steps=300, batch=2)
"""Chosen: some minutes of a processor a training of 256 x 256 pixels; `mitsim train` has 4000 steps of 4."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A capture's ``measured`` plane, with its scene as it lies before the mask, and the ``prepared`` factors of
    ``sides`` by the codes of another."""

    measured: Measured
    sides: tuple[FloatArray, FloatArray]
    prepared: Prepared

    @classmethod
    def of(cls, measured: Measured, learned: Learned) -> Camera:
        """Of a ``measured`` plane, and codes that were ``learned``."""
        sides = learned.codes.factors(measured.offset, measured.plane)
        rows, columns = (np.ones((side.shape[1], 1)) for side in sides)
        return cls(learned.see(measured), sides, prepare(*sides, rows, columns, centre=True))

    def twin_frame(self) -> FloatArray:
        """(m, m') frame of the twin, of the authors' image, with noise as the real one's [DN]."""
        left, right = self.sides
        return np.asarray(left @ self.measured.scene @ right.T + self.measured.noise)


def noise_range(planes: Sequence[Measured], learned: Learned) -> tuple[float, float]:
    """Least and largest standard deviation of white noise that pairs have [DN of the taught plane].

    From the noise of the known ``planes`` alone to all that the codes leave of them, noise or not, each over its
    plane's gain; and a factor :data:`_MARGIN` beyond either.

    Parameters
    ----------
    planes
        that codes were learned from, in their order.
    learned
        the codes.
    """
    gains = learned.codes.gains
    scales = [abs(gains[_TAUGHT] / gains[each.plane]) for each in planes]
    noise = [scale * float(each.noise.std()) for scale, each in zip(scales, planes, strict=True)]
    left = [scale * float(np.sqrt(each)) for scale, each in zip(scales, learned.codes.variances, strict=True)]
    return min(noise) / _MARGIN, max(left) * _MARGIN


def twin_sums(prepared: Prepared, noise: tuple[float, float], truths: FloatArray, seed: int) -> Sums:
    """What frames of pictures add up to: the idealised product, and white noise.

    Parameters
    ----------
    prepared
        the twin's camera.
    noise
        least and largest standard deviation of a datum, between which logarithms are drawn evenly [DN].
    truths, seed
        (N, n, n) pictures, 0 to 1; of the noise.
    """
    from mitsim.learn.training import Sums

    weights, deviations = [], []
    for number, truth in enumerate(truths):
        draws = stream(seed, "transfer", number)
        deviations.append(float(np.exp(draws.uniform(*np.log(noise)))))
        sums = prepared.sigma * prepared.coefficients(truth)
        weights.append((sums + deviations[-1] * draws.standard_normal(sums.shape)).astype(np.float32))
    return Sums(truths, np.stack(weights), np.square(deviations), noise)


@dataclass(frozen=True, eq=False)
class Taught:
    """A ``network``; the ``curve`` of its steps and the PSNR of pairs that did not teach; processor ``seconds``."""

    network: Method
    curve: list[tuple[int, float]]
    seconds: float


def teach(method: str, prepared: Prepared, sums: Sums, budget: Budget, seed: int, job: Job) -> Taught:
    """A network that learned from a twin's frames.

    Parameters
    ----------
    method, budget, seed
        of the training.
    prepared, sums
        the twin's camera, and what its frames add up to.
    job
        is told how far it is.
    """
    from mitsim.learn.training import Trainer, first_network

    started, request = time.process_time(), Training(method=method, steps=budget.steps, batch=budget.batch, seed=seed)
    shape = prepared.left.scene_size, prepared.right.scene_size
    trainer = Trainer(request, prepared, sums, first_network(request, shape))
    trainer.choose()
    while not trainer.is_over():
        trainer.go_on(job)
    trainer.network.load_state_dict(trainer.best)
    return Taught(trainer.network.eval(), trainer.curve, time.process_time() - started)


def image(camera: Camera, frame: FloatArray, method: str, taught: dict[str, Taught]) -> tuple[FloatArray, float]:
    """(n, n) image of a frame, and the part of the frame that it would not give beyond noise, rms.

    Parameters
    ----------
    camera, frame
        (m, m') of that camera [DN].
    method, taught
        one of :data:`METHODS`, and the networks.
    """
    import torch

    from mitsim.learn.learned_solver import beyond_noise, datum_variance
    from mitsim.learn.methods import Data, Diagonal

    prepared = camera.prepared
    sums = prepared.accumulator()
    sums.add(frame, 0, 0)
    problem = prepared.problem(sums)
    if method in taught:
        network = taught[method].network
        like = next(network.parameters())
        data = Data.of(problem.projected[None], datum_variance(problem), like)
        with torch.no_grad():
            found = network.images(data, Diagonal.of(prepared, like))[0, 0].numpy().astype(np.float64)
    else:
        found = solve_tv(prepared, sums).image if method == TV else prepared.solve(sums).image
    return found, beyond_noise(prepared, problem, found)[1]


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A ``capture`` that taught nothing.

    Attributes
    ----------
    capture
        its name.
    rows
        by frame and method, correlation and what the image leaves.
    images
        (n, n, 3) by method, and the authors', as their files lie.
    taught, noise
        networks by method, and the noise of their pairs (:func:`noise_range`).
    """

    capture: str
    rows: list[dict[str, Any]]
    images: dict[str, FloatArray]
    taught: dict[str, Taught]
    noise: tuple[float, float]


@dataclass(frozen=True, eq=False)
class TransferFindings(Findings):
    """Every capture as it was ``held_out``, and the ``budget`` of trainings."""

    held_out: tuple[HeldOut, ...]
    budget: Budget

    title = "Networks of a simulated twin on real captures"

    def payload(self) -> dict[str, Any]:
        """The JSON of the command line."""
        networks = [
            {"held_out": each.capture, "method": method, "curve": taught.curve, "seconds": taught.seconds,
             "noise": each.noise}
            for each in self.held_out for method, taught in each.taught.items()
        ]  # fmt: skip
        rows = [row for each in self.held_out for row in each.rows]
        return {"captures": rows, "networks": networks, "budget": vars(self.budget)}

    def parts(self) -> Sequence[Part]:
        """Of its page."""
        budget = f"{self.budget.pairs} pairs, {self.budget.steps} steps of {self.budget.batch}"
        return [
            self._table(
                "Images", "correlation",
                "Correlation with the authors' image of the same frame, numbers below 0 cut as theirs are. Codes of "
                f"the mask are of the other capture; networks learned from its twin alone ({budget}).",
                ("flatcam.png",),
                "The authors' image is a Tikhonov image of the same frame by their own calibration. It has the frame's "
                "noise and the prior's blur, as ours by Tikhonov has; it is no truth.",
                f"{SIMULATED.capitalize()}: the twin's frame of the authors' image, with the real frame's noise. What "
                "is lost from there to the real frame is what the twin does not have.",
            ),
            self._table(
                "What images leave", "beyond",
                "Part of the frame, rms, that an image would not give, within the camera's range and beyond noise.",
            ),
        ]  # fmt: skip

    def _table(self, title: str, name: str, lead: str, figures: tuple[str, ...] = (), *notes: str) -> Part:
        found: dict[str, list[str]] = {}
        for row in (row for each in self.held_out for row in each.rows):
            found.setdefault(row["frame"], []).append(format(row[name], ".3f"))
        return Part(
            title, lead, ("frame", *METHODS), tuple((frame, *cells) for frame, cells in found.items()), figures, notes
        )

    def figures(self) -> dict[str, Figure]:
        """By file name."""
        columns = (AUTHORS, *METHODS)
        height = len(self.held_out) * (plots.WIDTH / len(columns) + 0.1) + 0.2
        figure, places = plots.panels_of(len(self.held_out), len(columns), height, layout="compressed")
        for number, (line, each) in enumerate(zip(places, self.held_out, strict=True)):
            for axes, column in zip(line, columns, strict=True):
                shown, theirs = each.images[column], each.images[AUTHORS]
                scale = float(np.vdot(shown, theirs) / np.vdot(shown, shown))
                axes.imshow(np.clip(scale * shown, 0, 1), interpolation="none")
                axes.set(xticks=[], yticks=[])
                axes.set_title("" if number else column, fontsize=plots.FONT - 1)
            line[0].set_ylabel(each.capture, fontsize=plots.FONT - 1)
        return {"flatcam.png": figure}


@single_threaded_blas()
def measure(
    bench: None, request: Request, job: Job, files: TwinFiles | None = None, budget: Budget = FULL
) -> TransferFindings:
    """Images of every capture in the ``files``, by codes and networks of the others.

    Parameters
    ----------
    bench
        none: the twin is made of the captures.
    request, job
        the seed of noise, pictures and networks, and who is told how far the work is.
    files
        real captures.
    budget
        of trainings.

    Raises
    ------
    MitsimError
        without torch or captures of a FlatCam, and for files that are not what they are to be.
    """
    check_torch()
    files = files or TwinFiles.find(None, "transfer")
    if not files.captures:
        raise MitsimError(f"study transfer: needs captures of a FlatCam; give --data FOLDER with {SOURCES}")
    planes = read_captures(files.captures, request.seed)
    pictures, n = DrawnPictures(request.seed), len(planes[0].scene)
    truths = np.stack([pictures.draw(number, n) / np.float32(WHITE) for number in range(budget.pairs)])
    held_out: list[HeldOut] = []
    for name in files.captures:
        job.progress("codes", len(held_out) / len(files.captures))
        known = [each for each in planes if each.capture != name]
        learned = Learned.of(known)
        cameras = {each.plane: Camera.of(each, learned) for each in planes if each.capture == name}
        noise, taught = noise_range(known, learned), cameras[_TAUGHT].prepared
        sums = twin_sums(taught, noise, truths, request.seed)
        networks = {method: teach(method, taught, sums, budget, request.seed, job) for method in NETWORKS}
        rows, images = _see(cameras, networks, _BACK.get(learned.pose.orientation, learned.pose.orientation))
        held_out.append(HeldOut(name, rows, images, networks, noise))
    return TransferFindings(tuple(held_out), budget)


def _see(
    cameras: dict[str, Camera], networks: dict[str, Taught], back: str
) -> tuple[list[dict[str, Any]], dict[str, FloatArray]]:
    """Rows of a capture by plane, with a simulated frame of the taught one; and (n, n, 3) images by method, turned
    ``back``."""
    rows: list[dict[str, Any]] = []
    found = {(AUTHORS, plane): camera.measured.scene for plane, camera in cameras.items()}
    for plane, camera in cameras.items():
        name, real = camera.measured.name, camera.measured.frame
        frames = {name: real, **({f"{name} {SIMULATED}": camera.twin_frame()} if plane == _TAUGHT else {})}
        for (shown, frame), method in product(frames.items(), METHODS):
            seen, beyond = image(camera, frame, method, networks)
            like = correlation(np.maximum(seen, 0), camera.measured.scene)
            rows.append({"frame": shown, "method": method, "correlation": like, "beyond": beyond})
            if frame is real:
                found[method, plane] = seen

    def in_colour(method: str) -> FloatArray:
        colours = [TURNS[back](np.mean([found[method, plane] for plane in each], axis=0)) for each in _COLOURS]
        return np.stack(colours, axis=-1)

    return rows, {method: in_colour(method) for method in (AUTHORS, *METHODS)}

"""Train a network on a store of pairs: sums of frames, batches, steps, judgement, and resumption.

Frames are read once into their sum W (:mod:`mitsim.learn.methods`), so that a step takes as long under 49 patterns as
under one. Every step draws from random streams of its own number, so that an interrupted training continues bit-equal
at the same number of threads.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mitsim.core.arrays import FloatArray, Labels, integer, single_threaded_blas, stream
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError, cut, reason_of
from mitsim.core.job import Cost, Job
from mitsim.learn.methods import (
    CLASSES,
    Data,
    Diagonal,
    LearnedSolver,
    Method,
    datum_variance,
    has_half,
    on_device,
    relative_noise,
    write_tensors,
)
from mitsim.learn.pair_store import ModelManifest, PairStore
from mitsim.learn.requests import FEWEST_PAIRS, FEWEST_PHOTOGRAPHS, Training
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.request import TIKHONOV
from mitsim.reconstruct.solver import Prepared
from mitsim.reconstruct.solvers import SOLVERS

_PART, _MOST = 16, 48
"""One photograph in 16 chooses the best step, and one judges, up to 48 pairs each."""
_LOOKS = 20
_PATIENCE = 6
_GAIN_DB = 0.01
_RISING = 0.15
"""Part of the steps over which the learning rate rises."""
_DECAY, _BETAS, _LONGEST_GRADIENT = 1e-4, (0.9, 0.99), 1.0
"""Options of AdamW, and the norm to which gradients are cut, because the first steps would diverge otherwise."""
_BASE_BYTES, _CHANNEL_BYTES, _HALF = 6e8, 100.0, 0.6
"""Bytes of torch; bytes per pixel and channel of the first level (76 to 96 measured); and the part in half precision.
"""
_LOOK = 0.05
_UNFINISHED = ".unfinished"


# -------- Pairs


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums of the frames of all pairs.

    Attributes
    ----------
    truths, weights, variances
        (N, n, n'), (N, r, r') W, and (N,) noise variance of a datum.
    noise
        Smallest and largest noise of a datum over its rms.
    photographs
        (N,) number of the photograph that each pair shows.
    """

    truths: FloatArray
    weights: FloatArray
    variances: FloatArray
    noise: tuple[float, float]
    photographs: Labels

    @classmethod
    def of(cls, store: PairStore, prepared: Prepared, job: Job) -> Sums:
        count, started = len(store), time.perf_counter()
        truths, weights, variances, noise = [], [], np.empty(count), np.empty(count)
        for index in range(count):
            frames = prepared.accumulator()
            for frame, (row, column) in zip(store.frames(index), store.indices, strict=True):
                frames.add(frame, row, column)
            problem = prepared.problem(frames)
            variances[index], noise[index] = datum_variance(problem), relative_noise(problem)
            weights.append(problem.projected.astype(np.float32))
            truths.append(store.truth(index))
            if not index:
                held = 4.0 * count * (problem.projected.size + truths[0].size)
                Cost((time.perf_counter() - started) * count, held).check(
                    f"{store.folder}: reading {count} pairs", job.limits
                )
            job.progress("read", (index + 1) / count)
        limits = float(noise.min()), float(noise.max())
        return cls(np.stack(truths), np.stack(weights), variances, limits, store.photographs)


def part_photographs(photographs: Labels, seed: int) -> tuple[Labels, Labels, Labels]:
    """Return the numbers of the pairs that teach, that choose the best step, and that judge.

    All pairs of a photograph belong to one part, because a network that has learned one crop knows much of the next.
    """
    names = stream(seed, "judging").permutation(np.unique(photographs))
    count = min(max(len(names) // _PART, 1), _MOST)
    parts = names[2 * count :], names[:count], names[count : 2 * count]
    teaching, choosing, judging = (np.flatnonzero(np.isin(photographs, part)) for part in parts)
    return teaching, choosing[:_MOST], judging[:_MOST]


# -------- Steps


@dataclass(eq=False)
class Trainer:
    """Network in training; ``curve`` has the judgements (step, PSNR), ``best`` the weights after the best step."""

    request: Training
    prepared: Prepared
    sums: Sums
    network: Method
    taken: int = 0
    curve: list[tuple[int, float]] = field(default_factory=list)
    best: dict[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.optimiser = torch.optim.AdamW(self.network.parameters(), betas=_BETAS, weight_decay=_DECAY)
        self._like = next(self.network.parameters())
        self.model = Diagonal.of(self.prepared, self._like)
        self.teaching, self.choosing, self.judging = part_photographs(self.sums.photographs, self.request.seed)

    def run(self, job: Job, keep: Callable[[], object] = lambda: None) -> None:
        """Take all steps, with a judgement and ``keep`` after each twentieth; MitsimError if the loss is not finite."""
        steps = self.request.steps
        while True:
            if not self.curve or self.curve[-1][0] < self.taken:
                self.curve.append((self.taken, self.judge(self.choosing)))
                if self.curve[-1][1] >= max(value for _, value in self.curve):
                    self.best = weights_of(self.network)
            if self.taken:
                job.progress(f"train, {self.curve[-1][1]:.2f} dB", self.taken / steps)
                keep()
            psnr = [value for _, value in self.curve]
            gone = max(psnr[:-_PATIENCE], default=-math.inf) > max(psnr[-_PATIENCE:]) - _GAIN_DB
            if self.taken >= steps or gone:
                return
            for number in range(self.taken, min(self.taken + max(steps // _LOOKS, 1), steps)):
                if not math.isfinite(self.step(number)):
                    raise MitsimError(f"training: its numbers ran away at step {number}; give a smaller rate")
                self.taken = number + 1
                job.progress("train", self.taken / steps)

    def save(self, path: Path, digest: str) -> None:
        state = {"step": self.taken, "curve": self.curve, "best": self.best, "network": weights_of(self.network)}
        write_tensors(path, {"digest": digest, **state, "optimiser": self.optimiser.state_dict()})

    def load(self, path: Path, digest: str) -> None:
        """Continue from a state; raise MitsimError if it cannot be read or belongs to another training."""
        try:
            held = torch.load(path, map_location="cpu", weights_only=True)
            own, self.taken, self.curve, self.best = (held[name] for name in ("digest", "step", "curve", "best"))
        except Exception as error:  # torch.load raises errors of many classes
            raise MitsimError(f"{path}: cannot be read ({cut(reason_of(error), 200)}); remove it") from error
        if own != digest:
            raise MitsimError(
                f"{path}: is of a training of other pairs, factors or options, or of numbers of other precision "
                "on another processor; give those, or remove it"
            )
        self.network.load_state_dict(held["network"])
        self.optimiser.load_state_dict(held["optimiser"])

    def step(self, number: int) -> float:
        random = stream(self.request.seed, "step", number)
        chosen = self.teaching[random.integers(len(self.teaching), size=self.request.batch)]
        truths, data = self._turn(*self.batch(chosen), random)
        part, rate = (number + 0.5) / self.request.steps, self.request.rate
        falling = 0.5 * (1 + math.cos(math.pi * (part - _RISING) / (1 - _RISING)))
        for group in self.optimiser.param_groups:
            group["lr"] = rate * (part / _RISING if part < _RISING else falling)
        self.network.train()
        loss = self.gradients(truths, data, integer(self.request.seed, "noise", number))
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), _LONGEST_GRADIENT)
        self.optimiser.step()
        return loss

    def gradients(self, truths: Tensor, data: Data, seed: int) -> float:
        self.optimiser.zero_grad()
        loss = self.network.loss(truths, data, self.model, torch.Generator().manual_seed(seed))
        loss.backward()
        return float(loss.detach())

    def batch(self, chosen: Any) -> tuple[Tensor, Data]:
        truths = torch.as_tensor(self.sums.truths[chosen])[:, None].to(self._like)
        return truths, Data.of(self.sums.weights[chosen], self.sums.variances[chosen], self._like)

    def _turn(self, truths: Tensor, data: Data, random: np.random.Generator) -> tuple[Tensor, Data]:
        half = len(truths) // 2
        ways = [axis for axis in (-2, -1) if random.random() < 0.5]
        turned = truths[half:].flip(ways)
        if truths.shape[-1] == truths.shape[-2] and random.random() < 0.5:
            turned = turned.transpose(-2, -1)
        sigma = self.model.sigma / data.deviation[half:]
        moved = data.weights[half:] + sigma * self.model.coefficients(turned - truths[half:])
        weights = torch.cat([data.weights[:half], moved])
        return torch.cat([truths[:half], turned]), Data(weights, data.deviation)

    def judge(self, pairs: Labels) -> float:
        found = []
        self.network.eval()
        with torch.no_grad():
            for index in pairs:
                truths, data = self.batch(np.array([index]))
                found.append(-10 * math.log10(float((self.network(data, self.model) - truths).square().mean())))
        return float(np.mean(found))


# -------- A training


def weights_of(network: Method) -> dict[str, Tensor]:
    return {name: values.detach().cpu().clone() for name, values in network.state_dict().items()}


@dataclass(frozen=True, eq=False)
class Trained:
    """Result of a training.

    ``curve`` has steps and mean PSNR [dB] of the pairs that choose; ``psnr_db`` is that of the pairs that judge.
    """

    model: LearnedSolver
    curve: tuple[tuple[int, float], ...]
    psnr_before_db: float
    psnr_db: float
    predicted_seconds: float
    output: str

    def summary(self) -> dict[str, Any]:
        return {
            "model": self.model.name,
            "weights": sum(values.numel() for values in self.model.network.parameters()),
            "curve": [list(point) for point in self.curve],
            "psnr_before_db": self.psnr_before_db,
            "psnr_db": self.psnr_db,
            "steps": self.curve[-1][0],
            "predicted_seconds": self.predicted_seconds,
            "output": self.output,
        }


@single_threaded_blas()
def train_network(
    store: PairStore,
    factors: Factors,
    request: Training,
    output: Path | str,
    job: Job | None = None,
    resume: bool = False,
) -> Trained:
    """Train a network for the calibration ``factors`` and write its file, beside which the resumable state lies."""
    job, output = job or Job(), Path(output)
    started = time.perf_counter()
    if len(store) < FEWEST_PAIRS:
        raise MitsimError(f"{store.folder}: holds {len(store)} pairs; give at least {FEWEST_PAIRS}")
    if (count := len(np.unique(store.photographs))) < FEWEST_PHOTOGRAPHS:
        raise MitsimError(
            f"{store.folder}: its pairs show {count} photographs; give at least {FEWEST_PHOTOGRAPHS}, because one "
            "chooses the best step and one judges, and neither may teach"
        )
    frame, shape = (len(factors.left), len(factors.right)), (factors.left.shape[1], factors.right.shape[1])
    found = tuple(store.manifest.m), tuple(len(side) for side in store.patterns)
    if (frame, shape) != found:
        raise MitsimError(
            f"calibration {factors.name}: has frames of {frame} and images of {shape} pixels, but {store.folder} "
            f"{found[0]} and {found[1]}; calibrate this camera"
        )
    with job.clock.stage("read"):
        prepared = SOLVERS[TIKHONOV].init(factors, store.patterns)
        network = first_network(request, shape)
        half = has_half(next(network.parameters()).device)
        pixels = math.prod(shape)
        memory = _CHANNEL_BYTES * network.WIDTH * (_HALF if half else 1.0) * request.batch * pixels * network.PASSES
        memory += _BASE_BYTES + 4.0 * len(store) * 2 * pixels
        Cost(memory_bytes=memory).check(f"{store.folder}: training {request.method}", job.limits)
        sums = Sums.of(store, prepared, job)
    trainer, first = Trainer(request, prepared, sums, network), weights_of(network)
    about = store.manifest.model_dump(mode="json", exclude={"shards", "sensor"})
    parts = request.model_dump(), factors.fingerprint, about, half
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
    unfinished = Path(f"{output}{_UNFINISHED}")
    if resume and unfinished.is_file():
        trainer.load(unfinished, digest)
    with job.clock.stage("train"):
        truths, data = trainer.batch(trainer.teaching[: request.batch])
        network.train()
        for _ in range(2):  # the first fills caches
            before_step = time.perf_counter()
            trainer.gradients(truths, data, 0)
        each = (1 + _LOOK) * (time.perf_counter() - before_step)
        predicted = time.perf_counter() - started + each * (request.steps - trainer.taken)
        Cost(predicted).check(f"{store.folder}: training {request.method}", job.limits)
        trainer.run(job, lambda: trainer.save(unfinished, digest))
    network.load_state_dict(first)
    before = trainer.judge(trainer.judging)
    network.load_state_dict(trainer.best)
    after = trainer.judge(trainer.judging)
    how = {**request.model_dump(), "half_precision": half, "curve": trainer.curve, "psnr_db": after}
    manifest = ModelManifest(
        method=request.method, camera=factors.manifest.camera, factors=factors.fingerprint,
        patterns=store.manifest.patterns, exposure_s=store.manifest.exposure_s, noise=sums.noise, pairs=about,
        training=how, versions={**versions(), "torch": str(torch.__version__)},
    )  # fmt: skip
    model = LearnedSolver(manifest, network.eval(), factors.sides, store.patterns)
    model.save(output)
    unfinished.unlink(missing_ok=True)
    return Trained(model, tuple(trainer.curve), before, after, predicted, str(output))


def first_network(request: Training, shape: tuple[int, int]) -> Method:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(integer(request.seed, "weights"))
        return on_device(CLASSES[request.method](shape), request.device)

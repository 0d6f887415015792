"""Networks that make images of frames: their architecture, files, use as methods of solving, and training.

*Network.* A U-Net (Ronneberger et al., arXiv 1505.04597) returns a change of its input. Its last layer begins at zero.
Training turns and mirrors images; a reconstructed image is the mean over all eight ways.

*Camera.* In the basis where the model is diagonal (:mod:`mitsim.reconstruct.solver`), over the noise's standard
deviation, w = s o C + noise of variance 1, with C = V_L^T X V_R the coefficients of the image X. The image nearest to
both the data and an image Z, argmin ||w - s o C||^2 + rho ||X - Z||^2, is ::

    X = Z + V_L [s (w - s o V_L^T Z V_R) / (s^2 + rho)] V_R^T

Unmeasured directions remain those of Z. All methods begin at the image nearest to the frames and to an even grey.

*Files.* `torch.load` reads a network's file with `weights_only`, so that nothing in it is executed.

*Training.* Frames are read once into their sum W, so that a step takes as long under 49 patterns as under one. Every
step draws from random streams of its own number, so that an interrupted training continues bit-equal at the same number
of threads.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal
from zipfile import is_zipfile

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.configuration import validate
from mitsim.core.environment import versions
from mitsim.core.errors import ArgumentError, MitsimError, cut, reason_of
from mitsim.core.files import check_plain, json_text, whole_file
from mitsim.core.job import Cost, Job
from mitsim.core.manifests import SIDES
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer, stream
from mitsim.learn.pair_store import ModelManifest, PairStore, check_sizes, part_photographs
from mitsim.learn.requests import FEWEST_PAIRS, FEWEST_PHOTOGRAPHS, FLATNET, REFINED, UNROLLED, Training
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.misfit import UNEXPLAINED
from mitsim.reconstruct.request import TIKHONOV
from mitsim.reconstruct.solver import Accumulator, DiagonalProblem, Prepared, Solution, Status, Verdict, noise_variance
from mitsim.reconstruct.solvers import SOLVERS, Patterns, Solver

# ---- Network ----

LEVELS = (1, 2, 4, 6)
"""Channels of each level over those of the first."""
WAYS = 8


class UNet(nn.Module):
    """U-Net that returns a change of images."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        sizes = [width * level for level in LEVELS]

        def block(size: int) -> nn.Sequential:
            first, second = (nn.Conv2d(size, size, 3, padding=1) for _ in range(2))
            return nn.Sequential(nn.ReLU(), first, nn.ReLU(), second)

        self.first = nn.Conv2d(channels, sizes[0], 3, padding=1)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in pairwise(sizes))
        self.up = nn.ModuleList(nn.Conv2d(b, 4 * a, 1) for a, b in pairwise(sizes))
        self.before = nn.ModuleList(block(size) for size in sizes)
        self.after = nn.ModuleList(block(size) for size in sizes[:-1])
        self.last = nn.Conv2d(sizes[0], 1, 3, padding=1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)
        self.to(memory_format=torch.channels_last)

    def forward(self, images: Tensor, way: int = 0) -> Tensor:
        """Return the change of images (B, channels, n, n'), mirrored and transposed by the bits of ``way``.

        Training uses bfloat16 where the processor computes with it, because it is twice as fast.
        """
        axes = [axis for axis in (-2, -1) if way >> (axis + 2) & 1]
        with torch.autocast(images.device.type, torch.bfloat16, enabled=self.training and has_half(images.device)):
            turned = images.flip(axes)
            turned = turned.transpose(-2, -1) if way & 4 else turned
            rows, columns = turned.shape[-2:]
            whole = 2 ** (len(LEVELS) - 1)
            padded = functional.pad(turned, (0, -columns % whole, 0, -rows % whole), mode="replicate")
            values = self.first(padded.contiguous(memory_format=torch.channels_last))
            levels: list[Tensor] = []
            for level, block in enumerate(self.before):
                values = self.down[level - 1](values) if level else values
                values = values + block(values)
                levels.append(values)
            values = levels.pop()
            for up, after in zip(reversed(self.up), reversed(self.after), strict=True):
                values = functional.pixel_shuffle(up(values), 2) + levels.pop()
                values = values + after(values)
            change = self.last(functional.relu(values))[..., :rows, :columns]
            change = change.transpose(-2, -1) if way & 4 else change
            return change.flip(axes).to(images.dtype)


def has_half(device: torch.device) -> bool:
    if device.type == "cpu":
        return bool(getattr(torch.cpu, "_is_avx512_bf16_supported", bool)())
    return bool(getattr(torch.get_device_module(device), "is_bf16_supported", bool)())


# ---- Camera ----


@dataclass(frozen=True, eq=False)
class Diagonal:
    """Model of a camera under its patterns.

    ``left`` and ``right`` are V_L (n, r) and V_R (n', r'); ``sigma`` has the (r, r') singular values of the whole model
    [electrons / s].
    """

    left: Tensor
    right: Tensor
    sigma: Tensor

    @classmethod
    def of(cls, prepared: Prepared, like: Tensor) -> Diagonal:
        arrays = prepared.left.basis, prepared.right.basis, prepared.sigma
        return cls(*(torch.as_tensor(values.copy()).to(like) for values in arrays))

    def coefficients(self, images: Tensor) -> Tensor:
        return self.left.T @ images @ self.right

    def images(self, coefficients: Tensor) -> Tensor:
        return self.left @ coefficients @ self.right.T

    def nearest(self, data: Data, images: Tensor, rho: Tensor) -> Tensor:
        """Return the images nearest to both the data and `images` (B, 1, n, n').

        `rho` is one over the variance of the errors of `images`, broadcast to (B, 1, r, r').
        """
        s = self.sigma / data.deviation
        return images + self.images(s * (data.weights - s * self.coefficients(images)) / (s * s + rho))


@dataclass(frozen=True, eq=False)
class Data:
    """Measurements of B scenes.

    ``weights`` (B, 1, r, r') are W over the noise of a datum, and ``deviation`` (B, 1, 1, 1) is the standard deviation
    of that noise [electrons / s].
    """

    weights: Tensor
    deviation: Tensor

    @classmethod
    def of(cls, weights: FloatArray, variance: FloatArray | float, like: Tensor) -> Data:
        deviation = np.sqrt(np.broadcast_to(variance, len(weights)))[:, None, None]
        scaled = torch.as_tensor(weights / deviation)
        return cls(scaled[:, None].to(like), torch.as_tensor(deviation)[:, None].to(like))


# ---- Methods ----

_GREY = 0.5
_START = 60.0
"""Inverse variance of drawn pictures about grey."""
_LEAST_ERROR = 1e-5


class Method(nn.Module):
    PASSES, WIDTH = 1, 24
    holds_camera = False

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__()
        self.shape = shape
        self.log_start = nn.Parameter(torch.tensor(math.log(_START)))

    def start(self, data: Data, model: Diagonal) -> Tensor:
        grey = torch.full((len(data.weights), 1, *self.shape), _GREY).to(data.weights)
        return model.nearest(data, grey, torch.exp(self.log_start)) - _GREY

    def forward(self, data: Data, model: Diagonal, way: int = 0) -> Tensor:
        raise NotImplementedError

    def images(self, data: Data, model: Diagonal) -> Tensor:
        return torch.stack([self(data, model, way) for way in range(WAYS)]).mean(0)

    def loss(self, truths: Tensor, data: Data, model: Diagonal, noise: torch.Generator) -> Tensor:
        """Return the mean logarithm of each image's squared error, seen in a drawn way."""
        way = int(torch.randint(WAYS, (), generator=noise))
        errors = (self(data, model, way) - truths).square().mean(dim=(1, 2, 3))
        return torch.log(errors + _LEAST_ERROR).mean()


class Refined(Method):
    """Least squares, and a U-Net after it.

    For another camera or other patterns the network was trained elsewhere.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__(shape)
        self.network = UNet(1, self.WIDTH)

    def forward(self, data: Data, model: Diagonal, way: int = 0) -> Tensor:
        start = self.start(data, model)
        return start + self.network(start, way) + _GREY


class FlatNet(Refined):
    """A trainable matrix on either side of least squares, and a U-Net after them, trained together.

    This is FlatNet for separable cameras (Khan et al., arXiv 2010.15440).
    """

    holds_camera = True

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__(shape)
        self.left, self.right = (nn.Parameter(torch.eye(size)) for size in shape)

    def start(self, data: Data, model: Diagonal) -> Tensor:
        return self.left @ super().start(data, model) @ self.right.T


class Unrolled(Method):
    """Half-quadratic splitting of a few steps, each a U-Net and the image nearest to the frames and to its output.

    The splitting is that of Geman and Yang (1995).
    """

    STEPS, WIDTH = 3, 16
    PASSES = STEPS
    FIRST, LAST = 100.0, 1000.0
    """One over the variance of the first and last network's errors before training: 0.1 and 0.03 of white."""

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__(shape)
        self.networks = nn.ModuleList(UNet(2, self.WIDTH) for _ in range(self.STEPS))
        self.log_rho = nn.Parameter(torch.linspace(math.log(self.FIRST), math.log(self.LAST), self.STEPS))

    def forward(self, data: Data, model: Diagonal, way: int = 0) -> Tensor:
        start = self.start(data, model)
        images = start
        for network, rho in zip(self.networks, torch.exp(self.log_rho), strict=True):
            images = images + network(torch.cat([start, images], 1), way)
            images = model.nearest(data, images + _GREY, rho) - _GREY
        return images + _GREY


CLASSES: dict[str, type[Method]] = {UNROLLED: Unrolled, REFINED: Refined, FLATNET: FlatNet}

# ---- Trained networks, and their files ----

_MOST_BYTES = 1 << 28
_SAME_CAMERA = 0.02
"""Relative difference of models that indicates another camera: four times that of two sessions of 512 frames."""
_OTHER_NOISE = 1.5
"""Allowed factor of the noise outside the training's range; half an exposure gives 1.4."""
_NO_NOISE = 1e-14
"""Part of the frames' energy that counts as noise: rounding of single precision."""
_TENSORS = (*SIDES, "P_L", "P_R")


@dataclass(frozen=True, eq=False)
class _Doubted(Prepared):
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class LearnedSolver(Solver):
    """Trained network as a method of solving, with the factors and patterns of its training."""

    manifest: ModelManifest
    network: Method
    sides: tuple[FloatArray, FloatArray]
    patterns: Patterns

    linear, whole = False, False

    @property
    def name(self) -> str:
        digest = hashlib.sha256(self.manifest.model_dump_json().encode())
        for name, values in self.network.state_dict().items():
            digest.update(name.encode() + values.cpu().contiguous().numpy().tobytes())
        return f"{self.manifest.method} {digest.hexdigest()[:12]}"

    def init(self, camera: Factors, patterns: Patterns) -> Prepared:
        """Factorise the camera's model, with doubts where it differs from that of the training.

        Raise MitsimError for images of another size, other patterns, and another camera where the weights belong to
        one.
        """
        shape = camera.left.shape[1], camera.right.shape[1]
        if shape != self.network.shape:
            (own_rows, own_columns), (rows, columns) = self.network.shape, shape
            raise MitsimError(
                f"model {self.name}: makes images of {own_rows} x {own_columns} pixels, but calibration {camera.name} "
                f"has {rows} x {columns}; train a network for this calibration"
            )
        if not all(np.array_equal(own, other) for own, other in zip(self.patterns, patterns, strict=True)):
            raise MitsimError(
                f"model {self.name}: was trained for the patterns {cut(self.manifest.patterns)}, but this run has "
                "others; capture those patterns, or train a network for these"
            )
        doubts, (ours, theirs) = list[str](), (self.manifest.camera, camera.manifest.camera)
        if names := [cut(name) for name in sorted({*ours, *theirs}) if ours.get(name) != theirs.get(name)]:
            other = f"{', '.join(names)} differ"
            if self.network.holds_camera:
                raise MitsimError(
                    f"model {self.name}: was trained for another camera ({other}), and its weights contain that "
                    f"camera; train a network for calibration {camera.name}, or use {UNROLLED} or {REFINED}, which "
                    "accept other cameras and flag their images"
                )
            doubts.append(f"The network was trained for another camera: {other}.")
        else:
            difference = 1.0  # of the products of both sides; of other shapes all of it
            if all(a.shape == b.shape for a, b in zip(self.sides, camera.sides, strict=True)):
                pairs = (self.sides, self.sides), (camera.sides, camera.sides), (self.sides, camera.sides)
                own, theirs_too, both = (
                    float(np.prod([np.vdot(a, b) for a, b in zip(*pair, strict=True)])) for pair in pairs
                )
                difference = float(np.sqrt(max(own + theirs_too - 2 * both, 0.0) / own))
            if difference > _SAME_CAMERA:
                doubts.append(f"The network was trained with a calibration that differs by {difference:.1%}.")
        return _Doubted(**vars(SOLVERS[TIKHONOV].init(camera, patterns)), doubts=tuple(doubts))

    def compute(
        self, prepared: Prepared, frames: Accumulator, lam: float | Literal["auto"], **iterative: Any
    ) -> Solution:
        """Return the image of the frames; raise MitsimError if it is not finite."""
        problem = prepared.problem(frames)
        variance = datum_variance(problem)
        like = next(self.network.parameters())
        with torch.no_grad():
            data = Data.of(problem.projected[None], variance, like)
            found = self.network.images(data, Diagonal.of(prepared, like))[0, 0]
        image = found.cpu().numpy().astype(np.float64)
        if not np.isfinite(image).all():
            raise MitsimError(f"model {self.name}: its image of these frames is not finite; train it anew")
        # The frames' energy in the model's range that the image does not reproduce, and its rms part beyond noise.
        missed = float(np.square(problem.projected - problem.sigma * prepared.coefficients(image)).sum())
        beyond = float(np.sqrt(max(missed - variance * prepared.rank, 0.0) / problem.energy))
        outside = max(problem.energy - float(np.square(problem.projected).sum()), 0.0)
        flags = [*(prepared.doubts if isinstance(prepared, _Doubted) else ())]
        relative, (low, high) = relative_noise(problem), self.manifest.noise
        if not low / _OTHER_NOISE <= relative <= high * _OTHER_NOISE:
            flags.append(
                f"The network was trained with noise of {low:.1e} to {high:.1e} of the light, but these frames have "
                f"{relative:.1e}."
            )
        if beyond > UNEXPLAINED:
            flags.append(f"The image does not explain the frames: {beyond:.1e} of them, beyond noise, differ.")
        return Solution(
            image=image,
            lam=variance * float(torch.exp(self.network.log_start.detach())),
            residual=float(np.sqrt((missed + outside) / problem.energy)),
            status=Status(
                Verdict.SOLVED,
                f"Computed by a trained network, {self.name}: details that the frames do not determine are guesses, "
                "and their uncertainty is not known",
                figures=f"{prepared.extent}.",
                flags=tuple(flags),
            ),
        )

    def save(self, path: Path | str) -> None:
        tensors = dict(zip(_TENSORS, (*self.sides, *self.patterns), strict=True))
        held = {
            "manifest": json_text(self.manifest.model_dump()),
            "tensors": {name: torch.as_tensor(np.asarray(values, np.float64)) for name, values in tensors.items()},
            "weights": {name: values.cpu() for name, values in self.network.state_dict().items()},
        }
        write_tensors(path, held)


def read_network(path: Path | str, device: str) -> LearnedSolver:
    """Read a file of `mitsim train` for a device of torch; raise MitsimError for any other file."""
    if check_plain(path, "model").st_size > _MOST_BYTES:
        raise MitsimError(f"model {path}: is larger than {_MOST_BYTES >> 20} MiB; give a file of `mitsim train`")
    try:
        if not is_zipfile(path):  # torch reads older files with warnings
            raise ValueError("no file of torch")
        held = torch.load(path, map_location="cpu", weights_only=True)
        manifest = validate(ModelManifest, json.loads(held["manifest"]), f"model {path}")
        left, right, *patterns = (held["tensors"][name].numpy() for name in _TENSORS)
        network = CLASSES[manifest.method]((left.shape[1], right.shape[1]))
        network.load_state_dict(held["weights"])
        finite = all(bool(values.isfinite().all()) for values in network.state_dict().values())
    except MitsimError:
        raise
    except Exception as error:  # torch.load raises errors of many classes
        raise MitsimError(
            f"model {path}: is no file of `mitsim train` ({cut(reason_of(error), 200)}); train one"
        ) from error
    if not finite:
        raise MitsimError(f"model {path}: has weights that are not finite; train it anew")
    return LearnedSolver(manifest, on_device(network, device).eval(), (left, right), (patterns[0], patterns[1]))


def write_tensors(path: Path | str, held: dict[str, Any]) -> None:
    """Write a file for ``torch.load`` as a whole; raise MitsimError if it cannot be written.

    The buffer exists because torch reports a full disk with pages of text.
    """
    buffer = BytesIO()
    torch.save(held, buffer)
    with whole_file(path) as part:
        part.write_bytes(buffer.getbuffer())


def on_device(network: Method, device: str) -> Method:
    try:
        network.to(device)
        float(network.log_start.detach())
    except (RuntimeError, AssertionError) as error:  # torch: unknown device, none built in, and `meta`
        raise ArgumentError("device", f"{device!r}: cannot be used ({cut(reason_of(error))}); use cpu") from error
    return network


def datum_variance(problem: DiagonalProblem) -> float:
    return max(noise_variance(problem), _NO_NOISE * problem.energy / problem.data_count)


def relative_noise(problem: DiagonalProblem) -> float:
    return float(np.sqrt(datum_variance(problem) * problem.data_count / problem.energy))


# ---- Pairs, and their parts ----

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
            shown = zip(store.frames(index), *store.indices.T, strict=True)
            problem = prepared.problem(prepared.accumulator(shown))
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


# ---- Steps ----


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
                    raise MitsimError(f"training: the loss diverged at step {number}; give a smaller rate")
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
                f"{path}: belongs to a training with other pairs, factors or options, or on another processor; "
                "continue with the same ones, or remove the file"
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


# ---- A training ----


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
    store: PairStore, factors: Factors, request: Training, output: Path, job: Job | None = None, resume: bool = False
) -> Trained:
    """Train a network for the calibration ``factors`` and write its file, beside which the resumable state lies."""
    job, started = job or Job(), time.perf_counter()
    if len(store) < FEWEST_PAIRS:
        raise MitsimError(f"{store.folder}: holds {len(store)} pairs; give at least {FEWEST_PAIRS}")
    if (count := len(np.unique(store.photographs))) < FEWEST_PHOTOGRAPHS:
        raise MitsimError(
            f"{store.folder}: its pairs show {count} photographs; give at least {FEWEST_PHOTOGRAPHS}, because one "
            "chooses the best step and one judges, and neither may teach"
        )
    shape = check_sizes(store, factors)
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

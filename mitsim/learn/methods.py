"""Learned methods: the network that all share, the camera's model as tensors, the methods, and FlatNet's losses.

*Network.* A U-Net (Ronneberger et al., arXiv 1505.04597) returns a change of its input. Its last layer begins at zero.
Training turns and mirrors images; a reconstructed image is the mean over all eight ways.

*Camera.* In the basis where the model is diagonal (:mod:`mitsim.reconstruct.solver`), over the noise's standard
deviation, w = s o C + noise of variance 1, with C = V_L^T X V_R the coefficients of the image X. The image nearest to
both the data and an image Z, argmin ||w - s o C||^2 + rho ||X - Z||^2, is ::

    X = Z + V_L [s (w - s o V_L^T Z V_R) / (s^2 + rho)] V_R^T

Unmeasured directions remain those of Z. All methods begin at the image nearest to the frames and to an even grey.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional

from mitsim.core.arrays import FloatArray
from mitsim.core.seeds import integer
from mitsim.learn.requests import FLATNET, PLUG_AND_PLAY, PREPROCESSED, REFINED, UNROLLED, Training
from mitsim.reconstruct.factorisation import Side
from mitsim.reconstruct.solver import Accumulator, Prepared

# -------- Network

LEVELS = (1, 2, 4, 6)
"""Channels of each level over those of the first."""
WAYS = 8


class UNet(nn.Module):
    """U-Net that returns a change of images; frames are ``stacked`` as channels before the first level."""

    def __init__(self, channels_in: int, channels_out: int, width: int, stacked: int = 1) -> None:
        super().__init__()
        self.stacked, square = stacked, stacked * stacked
        sizes = [width * level for level in LEVELS]
        self.first = nn.Conv2d(channels_in * square, sizes[0], 3, padding=1)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in pairwise(sizes))
        self.up = nn.ModuleList(nn.Conv2d(b, 4 * a, 1) for a, b in pairwise(sizes))
        self.before = nn.ModuleList(_block(size) for size in sizes)
        self.after = nn.ModuleList(_block(size) for size in sizes[:-1])
        self.last = nn.Conv2d(sizes[0], channels_out * square, 3, padding=1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)
        self.to(memory_format=torch.channels_last)

    def forward(self, images: Tensor, way: int = 0) -> Tensor:
        """Return the change of images (B, channels_in, n, n'), mirrored and transposed by the bits of ``way``.

        Training uses bfloat16 where the processor computes with it, because it is twice as fast.
        """
        axes = [axis for axis in (-2, -1) if way >> (axis + 2) & 1]
        half = self.training and has_half(images.device)
        with torch.autocast(images.device.type, torch.bfloat16, enabled=half):
            turned = images.flip(axes)
            turned = turned.transpose(-2, -1) if way & 4 else turned
            rows, columns = turned.shape[-2:]
            levels = self.levels(turned)
            values = levels.pop()
            for up, after in zip(reversed(self.up), reversed(self.after), strict=True):
                values = functional.pixel_shuffle(up(values), 2) + levels.pop()
                values = values + after(values)
            change = functional.pixel_shuffle(self.last(functional.relu(values)), self.stacked)[..., :rows, :columns]
            change = change.transpose(-2, -1) if way & 4 else change
            return change.flip(axes).to(images.dtype)

    def levels(self, images: Tensor) -> list[Tensor]:
        rows, columns = images.shape[-2:]
        whole = self.stacked * 2 ** (len(LEVELS) - 1)
        padded = functional.pad(images, (0, -columns % whole, 0, -rows % whole), mode="replicate")
        squares = functional.pixel_unshuffle(padded, self.stacked)
        values = self.first(squares.contiguous(memory_format=torch.channels_last))
        found: list[Tensor] = []
        for level, block in enumerate(self.before):
            values = self.down[level - 1](values) if level else values
            values = values + block(values)
            found.append(values)
        return found


def _block(size: int) -> nn.Sequential:
    first, second = (nn.Conv2d(size, size, 3, padding=1) for _ in range(2))
    return nn.Sequential(nn.ReLU(), first, nn.ReLU(), second)


def drawn_way(noise: torch.Generator) -> int:
    return int(torch.randint(WAYS, (), generator=noise))


def has_half(device: torch.device) -> bool:
    if device.type == "cpu":
        return bool(getattr(torch.cpu, "_is_avx512_bf16_supported", bool)())
    return bool(getattr(torch.get_device_module(device), "is_bf16_supported", bool)())


# -------- Camera

BIN = 4
"""Sensor pixels along an axis of one bin, so that frames under 49 patterns need 3 MB a pair."""


@dataclass(frozen=True, eq=False)
class Diagonal:
    """Model of a camera under its patterns.

    Attributes
    ----------
    left, right
        V_L (n, r) and V_R (n', r').
    sigma
        (r, r') singular values of the whole model [electrons / s].
    slabs
        (K, b, r) and (K', b', r') sums of U_L and U_R over the pixels of a bin, for every pattern; 0 where unlit.
    """

    left: Tensor
    right: Tensor
    sigma: Tensor
    slabs: tuple[Tensor, Tensor]

    @classmethod
    def of(cls, prepared: Prepared, like: Tensor) -> Diagonal:
        def slabs(side: Side) -> FloatArray:
            stack = np.zeros((side.pattern_count, -(-side.sensor_size // BIN), len(side.singular)))
            for whole, slab in zip(stack, side.slabs, strict=True):
                whole[:, slab.columns] = _bin(slab.matrix)
            return stack

        left, right = prepared.left, prepared.right
        arrays = left.basis, right.basis, prepared.sigma, slabs(left), slabs(right)
        v_left, v_right, sigma, *sums = (torch.as_tensor(values.copy()).to(like) for values in arrays)
        return cls(v_left, v_right, sigma, (sums[0], sums[1]))

    def coefficients(self, images: Tensor) -> Tensor:
        return self.left.T @ images @ self.right

    def images(self, coefficients: Tensor) -> Tensor:
        return self.left @ coefficients @ self.right.T

    def project(self, frames: Tensor) -> Tensor:
        """Return W = sum_ij U_Li^T Y_ij U_Rj (B, r, r') of frames (B, K, K', b, b') that are even over each bin."""
        left, right = self.slabs
        return (left.transpose(1, 2) @ (frames @ right).sum(2)).sum(1)

    def nearest(self, data: Data, images: Tensor, rho: Tensor) -> Tensor:
        """Return the images nearest to both the data and `images` (B, 1, n, n').

        `rho` is one over the variance of the errors of `images`, broadcast to (B, 1, r, r').
        """
        s = self.sigma / data.deviation
        return images + self.images(s * (data.weights - s * self.coefficients(images)) / (s * s + rho))


@dataclass(frozen=True, eq=False)
class Data:
    """Measurements of B scenes.

    Attributes
    ----------
    weights
        (B, 1, r, r') W over the noise of a datum.
    deviation
        (B, 1, 1, 1) standard deviation of that noise [electrons / s].
    frames
        (B, K, K', b, b') binned frames [electrons / s]; None for methods that read none.
    """

    weights: Tensor
    deviation: Tensor
    frames: Tensor | None = None

    @classmethod
    def of(cls, weights: FloatArray, variance: FloatArray | float, like: Tensor) -> Data:
        deviation = np.sqrt(np.broadcast_to(variance, len(weights)))[:, None, None]
        scaled = torch.as_tensor(weights / deviation)
        return cls(scaled[:, None].to(like), torch.as_tensor(deviation)[:, None].to(like))


class Binning(Accumulator):
    def __init__(self, prepared: Prepared) -> None:
        super().__init__(prepared)
        sides = prepared.left, prepared.right
        bins = (-(-side.sensor_size // BIN) for side in sides)
        self.frames = np.zeros((*(side.pattern_count for side in sides), *bins), np.float32)

    def add(self, frame: npt.ArrayLike, row: int, column: int) -> FloatArray:
        own = super().add(frame, row, column)
        values = np.asarray(frame)
        pixels = np.outer(*(_bin(np.ones(size)) for size in values.shape))
        self.frames[row, column] = _bin(_bin(values).T).T / pixels
        return own


def _bin(values: FloatArray) -> FloatArray:
    return np.asarray(np.add.reduceat(values, np.arange(0, len(values), BIN)))


# -------- Methods

_GREY = 0.5
_START = 60.0
"""Inverse variance of drawn pictures about grey."""
_LEAST_ERROR = 1e-5


class Method(nn.Module):
    PASSES, WIDTH = 1, 24
    reads_frames, holds_camera = False, False

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
        return decibels(self(data, model, drawn_way(noise)), truths)


class Refined(Method):
    """Least squares, and a U-Net after it.

    For another camera or other patterns the network was trained elsewhere.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__(shape)
        self.network = UNet(1, 1, self.WIDTH)

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
        self.networks = nn.ModuleList(UNet(2, 1, self.WIDTH) for _ in range(self.STEPS))
        self.log_rho = nn.Parameter(torch.linspace(math.log(self.FIRST), math.log(self.LAST), self.STEPS))

    def forward(self, data: Data, model: Diagonal, way: int = 0) -> Tensor:
        start = self.start(data, model)
        images = start
        for network, rho in zip(self.networks, torch.exp(self.log_rho), strict=True):
            images = images + network(torch.cat([start, images], 1), way)
            images = model.nearest(data, images + _GREY, rho) - _GREY
        return images + _GREY


class PlugAndPlay(Method):
    """A denoiser that learned from pictures alone, in the same splitting.

    The method is that of Zhang et al. (arXiv 2008.13751).
    """

    STEPS = 8
    NOISIEST, CLEANEST = 0.3, 0.01
    """Standard deviations of the noise that the first and last step remove: that of least squares under uniform light,
    and a hundredth of white."""

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__(shape)
        self.network = UNet(2, 1, self.WIDTH)

    def denoise(self, images: Tensor, deviation: Tensor, way: int = 0) -> Tensor:
        """Remove white noise of a standard deviation (B, 1, 1, 1) from images (B, 1, n, n'), less grey."""
        return images + self.network(torch.cat([images, deviation.expand_as(images)], 1), way)

    def forward(self, data: Data, model: Diagonal, way: int = 0) -> Tensor:
        images = self.start(data, model)
        deviations = torch.logspace(math.log10(self.NOISIEST), math.log10(self.CLEANEST), self.STEPS)
        for deviation in deviations.to(images):
            images = self.denoise(images, deviation.reshape(1, 1, 1, 1), way)
            images = model.nearest(data, images + _GREY, 1 / deviation**2) - _GREY
        return images + _GREY

    def loss(self, truths: Tensor, data: Data, model: Diagonal, noise: torch.Generator) -> Tensor:
        low, high = math.log(self.CLEANEST), math.log(self.NOISIEST)
        part = torch.rand((len(truths), 1, 1, 1), generator=noise).to(truths)
        deviation = torch.exp(low + (high - low) * part)
        noisy = truths - _GREY + deviation * torch.randn(truths.shape, generator=noise).to(truths)
        return decibels(self.denoise(noisy, deviation, drawn_way(noise)), truths - _GREY)


class Denoiser(nn.Module):
    def __init__(self, network: PlugAndPlay) -> None:
        super().__init__()
        self.network = network

    def forward(self, x: Tensor, sigma: Tensor | float, **_: Any) -> Tensor:
        deviation = torch.as_tensor(sigma).to(x).reshape(-1, 1, 1, 1)
        return self.network.denoise(x - _GREY, deviation.expand(len(x), 1, 1, 1)) + _GREY


class Preprocessed(Refined):
    """A network on every frame, least squares of its output, and a U-Net after that.

    This is modular reconstruction (Bezzam et al., arXiv 2502.01102); the network sees binned frames.
    """

    reads_frames, holds_camera = True, True
    FRAME_WIDTH, FRAME_STACKED = 16, 4

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__(shape)
        self.of_frames = UNet(1, 1, self.FRAME_WIDTH, self.FRAME_STACKED)

    def start(self, data: Data, model: Diagonal) -> Tensor:
        frames = data.frames
        assert frames is not None, "this method reads frames"
        scale = frames.mean(dim=(1, 2, 3, 4), keepdim=True)
        change = scale * self.of_frames((frames / scale).flatten(0, 2)[:, None]).reshape(frames.shape)
        added = model.project(change)[:, None] / data.deviation
        return super().start(Data(data.weights + added, data.deviation), model)


def decibels(images: Tensor, truths: Tensor) -> Tensor:
    return torch.log((images - truths).square().mean(dim=(1, 2, 3)) + _LEAST_ERROR).mean()


CLASSES: dict[str, type[Method]] = {
    UNROLLED: Unrolled,
    REFINED: Refined,
    FLATNET: FlatNet,
    PLUG_AND_PLAY: PlugAndPlay,
    PREPROCESSED: Preprocessed,
}

# -------- Losses beside the squared error

_FEATURES = 16
_LEAST_FEATURES = 1e-5
_PATCH = (32, 64, 128)
"""Channels of the adversary's layers, half of those of Isola et al. (arXiv 1611.07004), whose pictures have colours."""
_RATE, _BETAS, _SLOPE = 2e-4, (0.5, 0.999), 0.2


class Critic:
    """FlatNet's two other losses: differences of features, and an adversary.

    Features come from drawn weights, which work as well as learned ones (Liu et al., arXiv 2103.10571).
    """

    def __init__(self, request: Training, like: Tensor) -> None:
        self._weights = request.feature_weight, request.adversary_weight
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(integer(request.seed, "critic"))
            self._features = UNet(1, 1, _FEATURES).to(like).requires_grad_(False)
            layers: list[nn.Module] = []
            for before, after in zip((1, *_PATCH), _PATCH, strict=False):
                layers += [nn.Conv2d(before, after, 4, stride=2, padding=1), nn.LeakyReLU(_SLOPE)]
            self.adversary = nn.Sequential(*layers, nn.Conv2d(_PATCH[-1], 1, 4, padding=2)).to(like)
        self.optimiser = torch.optim.Adam(self.adversary.parameters(), lr=_RATE, betas=_BETAS)

    def loss(self, images: Tensor, truths: Tensor) -> Tensor:
        """Return the loss to add for images (B, 1, n, n'): differences of features, and the adversary's."""
        features, adversary = self._weights
        found = images.new_zeros(())
        if features:
            for own, true in zip(self._features.levels(images), self._features.levels(truths), strict=True):
                part = (own - true).square().mean(dim=(1, 2, 3)) / true.square().mean(dim=(1, 2, 3))
                found = found + features * torch.log(part + _LEAST_FEATURES).mean()
        return found - adversary * self.adversary(images).mean() if adversary else found

    def learn(self, images: Tensor, truths: Tensor) -> None:
        self.optimiser.zero_grad()
        if self._weights[1]:
            found = self.adversary(torch.cat([truths, images.detach()]))
            real, made = functional.relu(1 - found[: len(truths)]), functional.relu(1 + found[len(truths) :])
            (real.mean() + made.mean()).backward()

    def state(self) -> dict[str, Any]:
        return {"adversary": self.adversary.state_dict(), "optimiser": self.optimiser.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        self.adversary.load_state_dict(state["adversary"])
        self.optimiser.load_state_dict(state["optimiser"])

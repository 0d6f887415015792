"""Data of frames in, images out: the learned methods, each a short module around the same network.

All begin at the image that is nearest to the frames and to an even grey. Where the camera tells a direction of the
image well they keep it; a network fills in what the camera does not tell.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from mitsim.learn.diagonal import Data, Diagonal
from mitsim.learn.networks import WAYS, UNet, drawn_way
from mitsim.learn.training_request import FLATNET, PLUG_AND_PLAY, PREPROCESSED, REFINED, UNROLLED

_GREY = 0.5
"""Reflectance between black and white, which images are told from."""
_START = 60.0
"""1 over the variance of pictures about grey (a standard deviation of 0.13) before the first step: drawn ones have 0.13
in the mean."""
_LEAST_ERROR = 1e-5
"""Squared error below which a picture counts no more: 50 dB, above what frames of an 8-bit scene give."""


class Method(nn.Module):
    """What all have in common: the image that they begin at, and what training makes small.

    Parameters
    ----------
    shape
        (n, n') of the images.
    """

    PASSES, WIDTH = 1, 24
    """Times that an image goes through a network in training, and channels of its first level: 0.97 million weights,
    three times those that gained 0.2 dB over least squares at its best weight."""
    reads_frames, holds_camera = False, False
    """Whether it reads frames, and not only what they add up to; and whether its weights stand for one camera, not only
    for pictures."""

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__()
        self.shape = shape
        self.log_start = nn.Parameter(torch.tensor(math.log(_START)))

    def start(self, data: Data, model: Diagonal) -> Tensor:
        """Images less grey, (B, 1, n, n'), nearest to the ``data`` of a ``model`` and to none."""
        grey = torch.full((len(data.weights), 1, *self.shape), _GREY).to(data.weights)
        return model.nearest(data, grey, torch.exp(self.log_start)) - _GREY

    def forward(self, data: Data, model: Diagonal, way: int = 0) -> Tensor:
        """The images (B, 1, n, n').

        Parameters
        ----------
        data, model
            of the scenes' frames, and of the camera under its patterns.
        way
            that networks look at images in (:class:`mitsim.learn.networks.UNet`).
        """
        raise NotImplementedError

    def images(self, data: Data, model: Diagonal) -> Tensor:
        """The mean of the images that networks make in all eight ways: 0.06 to 0.08 dB nearer to the truth.

        Parameters
        ----------
        data, model
            as of :meth:`forward`.
        """
        return torch.stack([self(data, model, way) for way in range(WAYS)]).mean(0)

    def loss(self, truths: Tensor, data: Data, model: Diagonal, noise: torch.Generator) -> Tensor:
        """What training makes small: the mean logarithm of each picture's squared error, so that all count by their
        decibels.

        Parameters
        ----------
        truths
            (B, 1, n, n') images as they should be.
        data, model
            of their frames, and of the camera.
        noise
            draws the way, and what a method draws of its own.
        """
        return decibels(self(data, model, drawn_way(noise)), truths)


class Refined(Method):
    """Least squares, and a U-Net after it. Of another camera or other pairs it is the network trained elsewhere.

    Parameters
    ----------
    shape
        (n, n') of the images.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__(shape)
        self.network = UNet(1, 1, self.WIDTH)

    def forward(self, data: Data, model: Diagonal, way: int = 0) -> Tensor:
        """See :class:`Method`.

        Parameters
        ----------
        data, model, way
            as of :meth:`Method.forward`.
        """
        start = self.start(data, model)
        return start + self.network(start, way) + _GREY


class FlatNet(Refined):
    """A trainable matrix on either side of least squares, and a U-Net after them, trained together: FlatNet for
    separable cameras (Khan et al., arXiv 2010.15440), whose inverse begins at the factors' own.

    Parameters
    ----------
    shape
        (n, n') of the images.
    """

    holds_camera = True

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__(shape)
        self.left, self.right = (nn.Parameter(torch.eye(size)) for size in shape)

    def start(self, data: Data, model: Diagonal) -> Tensor:
        """See :class:`Method`; of ``data`` and ``model``."""
        return self.left @ super().start(data, model) @ self.right.T


class Unrolled(Method):
    """Half-quadratic splitting of a few steps (Geman and Yang, 1995), each a U-Net and the image nearest to the frames
    and to what it gives. The last step is of the frames: so much as they tell is theirs.

    Parameters
    ----------
    shape
        (n, n') of the images.
    """

    STEPS, WIDTH = 3, 16
    """1.3 million weights in all, and 0.37 s of a processor for a step of 4 pictures of 128 x 128; chosen so. Three
    steps, or four on squares of 2 x 2 pixels, gain by processor time alone; eight narrow ones learn slower."""
    PASSES = STEPS
    FIRST, LAST = 100.0, 1000.0
    """1 over the variance of what the first and the last network leave, before training: 0.1 and 0.03 of white."""

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__(shape)
        self.networks = nn.ModuleList(UNet(2, 1, self.WIDTH) for _ in range(self.STEPS))
        self.log_rho = nn.Parameter(torch.linspace(math.log(self.FIRST), math.log(self.LAST), self.STEPS))

    def forward(self, data: Data, model: Diagonal, way: int = 0) -> Tensor:
        """See :class:`Method`.

        Parameters
        ----------
        data, model, way
            as of :meth:`Method.forward`.
        """
        start = self.start(data, model)
        images = start
        for network, rho in zip(self.networks, torch.exp(self.log_rho), strict=True):
            images = images + network(torch.cat([start, images], 1), way)
            images = model.nearest(data, images + _GREY, rho) - _GREY
        return images + _GREY


class PlugAndPlay(Method):
    """A denoiser that learned from pictures alone, in the same splitting (Zhang et al., arXiv 2008.13751): no frame
    teaches it, and it serves any camera.

    Parameters
    ----------
    shape
        (n, n') of the images.
    """

    STEPS = 8
    """Chosen: as few as the noise falls smoothly in."""
    NOISIEST, CLEANEST = 0.3, 0.01
    """Standard deviations of the noise that the first and the last step take away: least squares under uniform light,
    and what a hundredth of white is seen by."""

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__(shape)
        self.network = UNet(2, 1, self.WIDTH)

    def denoise(self, images: Tensor, deviation: Tensor, way: int = 0) -> Tensor:
        """Images without white noise.

        Parameters
        ----------
        images, deviation
            (B, 1, n, n') with it, less grey, and its (B, 1, 1, 1) standard deviation.
        way
            that the network looks at them in.
        """
        return images + self.network(torch.cat([images, deviation.expand_as(images)], 1), way)

    @property
    def deviations(self) -> Tensor:
        """(steps,) standard deviations of the noise that the steps take away."""
        return torch.logspace(math.log10(self.NOISIEST), math.log10(self.CLEANEST), self.STEPS)

    def forward(self, data: Data, model: Diagonal, way: int = 0) -> Tensor:
        """See :class:`Method`.

        Parameters
        ----------
        data, model, way
            as of :meth:`Method.forward`.
        """
        images = self.start(data, model)
        for deviation in self.deviations.to(images):
            images = self.denoise(images, deviation.reshape(1, 1, 1, 1), way)
            images = model.nearest(data, images + _GREY, 1 / deviation**2) - _GREY
        return images + _GREY

    def loss(self, truths: Tensor, data: Data, model: Diagonal, noise: torch.Generator) -> Tensor:
        """See :class:`Method`.

        Parameters
        ----------
        truths, noise
            images, and what draws the white noise that is to be taken off them.
        data, model
            which teach nothing here.
        """
        low, high = math.log(self.CLEANEST), math.log(self.NOISIEST)
        part = torch.rand((len(truths), 1, 1, 1), generator=noise).to(truths)
        deviation = torch.exp(low + (high - low) * part)
        noisy = truths - _GREY + deviation * torch.randn(truths.shape, generator=noise).to(truths)
        return decibels(self.denoise(noisy, deviation, drawn_way(noise)), truths - _GREY)


class Denoiser(nn.Module):
    """Images with white noise in, without it out, as `deepinv.models.Denoiser` is called: that of a ``network``, a
    plug-and-play one."""

    def __init__(self, network: PlugAndPlay) -> None:
        super().__init__()
        self.network = network

    def forward(self, x: Tensor, sigma: Tensor | float, **_: Any) -> Tensor:
        """Images ``x`` (B, 1, n, n'), white at 1, less noise of a standard deviation ``sigma``: one, or (B,)."""
        deviation = torch.as_tensor(sigma).to(x).reshape(-1, 1, 1, 1)
        return self.network.denoise(x - _GREY, deviation.expand(len(x), 1, 1, 1)) + _GREY


class Preprocessed(Refined):
    """A network on every frame, least squares of what it gives, and a U-Net after that: modular reconstruction (Bezzam
    et al., arXiv 2502.01102). The network sees frames binned, and what it changes is even over a bin.

    Parameters
    ----------
    shape
        (n, n') of the images.
    """

    reads_frames, holds_camera = True, True
    FRAME_WIDTH, FRAME_STACKED = 16, 4
    """On squares of 4 x 4 bins, as there are many frames; chosen so."""

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__(shape)
        self.of_frames = UNet(1, 1, self.FRAME_WIDTH, self.FRAME_STACKED)

    def start(self, data: Data, model: Diagonal) -> Tensor:
        """See :class:`Method`; of ``data`` with frames and a ``model`` with slabs."""
        frames = data.frames
        assert frames is not None, "this method reads frames"
        scale = frames.mean(dim=(1, 2, 3, 4), keepdim=True)
        change = scale * self.of_frames((frames / scale).flatten(0, 2)[:, None]).reshape(frames.shape)
        added = model.project(change)[:, None] / data.deviation
        return super().start(Data(data.weights + added, data.deviation), model)


def decibels(images: Tensor, truths: Tensor) -> Tensor:
    """Mean logarithm of the squared error of ``images`` against ``truths``, (B, 1, n, n') each."""
    return torch.log((images - truths).square().mean(dim=(1, 2, 3)) + _LEAST_ERROR).mean()


CLASSES: dict[str, type[Method]] = {
    UNROLLED: Unrolled,
    REFINED: Refined,
    FLATNET: FlatNet,
    PLUG_AND_PLAY: PlugAndPlay,
    PREPROCESSED: Preprocessed,
}
"""By the name that a method is asked by."""

"""Images in, images of the same size out: the convolutional network that every learned method uses.

A U-Net (Ronneberger et al., arXiv 1505.04597) that adds to its input. Its last layer begins at zero, so an untrained
network changes nothing. It may look at images in any of eight ways, turned and mirrored: in training one of them is
drawn for each step, and an image is the mean over all.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

LEVELS = (1, 2, 4, 6)
"""Channels of each level, over those of the first; a level has half the pixels a side of that before it. Chosen: all
but the last take the same arithmetic, and a pixel of the image sees 50 others on either side. Squares of 2 x 2 pixels
as channels of the first level learn as fast by processor time; of 4 x 4, far slower."""
WAYS = 8
"""To turn and mirror a square."""


class UNet(nn.Module):
    """The network.

    Parameters
    ----------
    channels_in, channels_out
        images that it reads, and that it changes.
    width
        channels of the first level.
    stacked
        pixels a side that are stacked as channels before the first level, for frames.
    """

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
        """What is to be added to the images.

        Half precision (bfloat16) is used in training where the processor computes with it, twice as fast; otherwise
        single precision.

        Parameters
        ----------
        images
            (B, channels_in, n, n') of any size; edges are repeated up to a whole number of squares.
        way
            that it looks at them in, 0 to 7.
        """
        half = self.training and has_half(images.device)
        with torch.autocast(images.device.type, torch.bfloat16, enabled=half):
            return _turn_back(self._change(_turn(images, way)), way).to(images.dtype)

    def _change(self, images: Tensor) -> Tensor:
        rows, columns = images.shape[-2:]
        levels = self.levels(images)
        values = levels.pop()
        for level in reversed(range(len(self.up))):
            values = functional.pixel_shuffle(self.up[level](values), 2) + levels.pop()
            values = values + self.after[level](values)
        changed = functional.pixel_shuffle(self.last(functional.relu(values)), self.stacked)
        return changed[..., :rows, :columns]

    def levels(self, images: Tensor) -> list[Tensor]:
        """What the first half makes of ``images`` (B, channels_in, n, n'): channels of each level, of half the pixels a
        side of that before it."""
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


def drawn_way(noise: torch.Generator) -> int:
    """One of the ways, drawn by ``noise``."""
    return int(torch.randint(WAYS, (), generator=noise))


def has_half(device: torch.device) -> bool:
    """Whether a ``device`` computes with bfloat16, and does not only know it."""
    if device.type == "cpu":
        return bool(getattr(torch.cpu, "_is_avx512_bf16_supported", bool)())
    return bool(getattr(torch.get_device_module(device), "is_bf16_supported", bool)())


def _turn(images: Tensor, way: int) -> Tensor:
    """``images`` (..., n, n') mirrored along both axes and across the diagonal, as the bits of a ``way`` say."""
    images = images.flip([axis for axis in (-2, -1) if way >> (axis + 2) & 1])
    return images.transpose(-2, -1) if way & 4 else images


def _turn_back(images: Tensor, way: int) -> Tensor:
    """What :func:`_turn` the same ``way`` gives ``images`` of."""
    images = images.transpose(-2, -1) if way & 4 else images
    return images.flip([axis for axis in (-2, -1) if way >> (axis + 2) & 1])


def _block(size: int) -> nn.Sequential:
    """Two convolutions that keep the number of channels, ``size``."""
    convolutions = (nn.Conv2d(size, size, 3, padding=1) for _ in range(2))
    return nn.Sequential(nn.ReLU(), next(convolutions), nn.ReLU(), next(convolutions))

"""Images in, images of the same size out: the convolutional network that every learned method uses.

A U-Net (Ronneberger et al., arXiv 1505.04597) that adds to its input. Its last layer begins at zero, so an untrained
network changes nothing. Squares of 2 x 2 pixels are stacked as channels before the first layer, which takes a quarter
of the arithmetic of the same network on all pixels.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

LEVELS = (1.0, 1.5, 2.0)
"""Channels of each level, over those of the first; a level has half the pixels a side of that before it. Chosen: a
pixel of the image then sees 50 others on either side."""


class UNet(nn.Module):
    """The network.

    Parameters
    ----------
    channels_in, channels_out
        images that it reads, and that it changes.
    width
        channels of the first level.
    stacked
        pixels a side that are stacked as channels.
    """

    def __init__(self, channels_in: int, channels_out: int, width: int, stacked: int = 2) -> None:
        super().__init__()
        self.stacked, square = stacked, stacked * stacked
        sizes = [int(width * level) for level in LEVELS]
        self.first = nn.Conv2d(channels_in * square, sizes[0], 3, padding=1)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in pairwise(sizes))
        self.up = nn.ModuleList(nn.Conv2d(b, 4 * a, 1) for a, b in pairwise(sizes))
        self.before = nn.ModuleList(_block(size) for size in sizes)
        self.after = nn.ModuleList(_block(size) for size in sizes[:-1])
        self.last = nn.Conv2d(sizes[0], channels_out * square, 3, padding=1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)
        self.to(memory_format=torch.channels_last)

    def forward(self, images: Tensor) -> Tensor:
        """What is to be added to the images.

        Parameters
        ----------
        images
            (B, channels_in, n, n') of any size; edges are repeated up to a whole number of squares.
        """
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


def _block(size: int) -> nn.Sequential:
    """Two convolutions that keep the number of channels, ``size``."""
    convolutions = (nn.Conv2d(size, size, 3, padding=1) for _ in range(2))
    return nn.Sequential(nn.ReLU(), next(convolutions), nn.ReLU(), next(convolutions))

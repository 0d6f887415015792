"""Images and truths in, what a training may make small beside their squared error out: differences of features, and
what an adversary tells apart. These are FlatNet's other two losses (Khan et al., arXiv 2010.15440), without any weights
that are downloaded.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from mitsim.core.seeds import integer
from mitsim.learn.networks import UNet
from mitsim.learn.training_request import Training

_FEATURES = 16
"""Channels of the first level of features; chosen: as many as of `unrolled`."""
_LEAST_FEATURES = 1e-5
"""Part of the features' energy below which a difference counts no more, as that of images does at 50 dB."""
_PATCH = (32, 64, 128)
"""Channels of the adversary's layers, each of half the pixels a side: a number of the last is told by 46 x 46 pixels.
Half of those of Isola et al. (arXiv 1611.07004), whose pictures have colours."""
_RATE, _BETAS, _SLOPE = 2e-4, (0.5, 0.999), 0.2
"""Of the adversary's optimiser and layers: those of Isola et al."""


class Critic:
    """What judges images beside their squared error.

    Parameters
    ----------
    request
        weights of both losses, and the seed that the networks are drawn by.
    like
        a tensor of whose device and precision it is to be.
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
        """What is added to the loss of ``images`` (B, 1, n, n'), whose ``truths`` are known.

        Features are those of a network with drawn weights, which serve as well as learned ones (Liu et al., arXiv
        2103.10571): of each level the mean logarithm of the squared difference over the squared features.
        """
        features, adversary = self._weights
        found = images.new_zeros(())
        if features:
            for own, true in zip(self._features.levels(images), self._features.levels(truths), strict=True):
                part = (own - true).square().mean(dim=(1, 2, 3)) / true.square().mean(dim=(1, 2, 3))
                found = found + features * torch.log(part + _LEAST_FEATURES).mean()
        return found - adversary * self.adversary(images).mean() if adversary else found

    def learn(self, images: Tensor, truths: Tensor) -> None:
        """Gradients of the adversary, that it may tell ``images`` from ``truths``: hinge loss, of each patch."""
        self.optimiser.zero_grad()
        if self._weights[1]:
            told = self.adversary(torch.cat([truths, images.detach()]))
            real, made = functional.relu(1 - told[: len(truths)]), functional.relu(1 + told[len(truths) :])
            (real.mean() + made.mean()).backward()

    def state(self) -> dict[str, Any]:
        """What a training goes on from: the adversary, and what its optimiser knows."""
        return {"adversary": self.adversary.state_dict(), "optimiser": self.optimiser.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a ``state``."""
        self.adversary.load_state_dict(state["adversary"])
        self.optimiser.load_state_dict(state["optimiser"])

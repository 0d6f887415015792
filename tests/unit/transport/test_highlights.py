"""Highlights of glossy balls: their light by the closed form of a mirror ball, what hides them, which are never met."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.transport.connect import OpticalSetup, ProjectorOptics
from mitsim.transport.missed import Highlights, highlights
from tests.physics.test_mirror import SCALE, MirrorBench, N

PLACES = np.array([[12.3, 5.1, 371.0], [-31.7, 20.9, 388.3], [2.6, -33.2, 362.9]])


def found(alpha: float, radius: float, **more: dict) -> Highlights:
    gloss = {"type": "roughconductor", "distribution": "ggx", "alpha": alpha, "material": "none"}
    balls = {
        f"ball{i}": {"type": "sphere", "center": place.tolist(), "radius": radius, "bsdf": gloss}
        for i, place in enumerate(PLACES)
    }
    scene = MirrorBench((60, 0, 0)).scene("open", 64, **balls, **more)
    projector = ProjectorOptics(scene.emitters()[0], N, 0, N, (N, 2 * N))
    camera = scene.sensors()[0]
    return highlights(OpticalSetup(scene, camera, projector, camera.geometry))


@pytest.mark.parametrize(("alpha", "radius"), [(0.003, 0.4), (0.003, 5.0), (0.01, 0.02)])
def test_light_is_that_of_mirror_balls(variant: str, alpha: float, radius: float) -> None:
    """A ball spreads E pi r^2 evenly over all directions, whatever its narrow lobe: E r^2 / 4 d^2 on the sensor.

    GGX lobes have alpha^2 / (t^2 + alpha^2) of their light beyond an angle t, and there a density of alpha^2 / (4 pi
    (t^2 + alpha^2)^2): below 10, which is left to connections, sqrt(40 pi) alpha of it. (Planted: points
    stand for a tenth more of the ball.)
    """
    to = PLACES - [60, 0, 0]
    cosine, far = to[:, 2] / np.linalg.norm(to, axis=1), np.linalg.norm(PLACES, axis=1)
    expected = np.pi * SCALE / to[:, 2] ** 2 / cosine * radius**2 / 4 * PLACES[:, 2] / far**3
    expected *= 1 - np.sqrt(40 * np.pi) * alpha
    light = found(alpha, radius)
    assert light.irradiance == pytest.approx(expected, rel=0.03)
    # A spot of some alpha r is met in proportion.
    hits = np.square(light.irradiance) / light.moments
    pixel = (2 * 0.15 / N * to[:, 2]) ** 2
    assert (hits < 4 * np.pi * (alpha * radius) ** 2 / pixel).all() and (
        hits > 0.1 * (alpha * radius) ** 2 / pixel
    ).all()


def test_what_is_hidden_counts_for_nothing(variant: str) -> None:
    """By a card before the sensor's view of the first ball; none are glossy enough at a roughness of 0.3."""
    card = {"type": "sphere", "center": (PLACES[0] / 2).tolist(), "radius": 3.0}
    hidden, open_ = found(0.01, 0.4, card=card).irradiance, found(0.01, 0.4).irradiance
    assert hidden[0] == 0 and hidden[1:] == pytest.approx(open_[1:])
    assert not found(0.3, 0.4).irradiance.any()

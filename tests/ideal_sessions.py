"""Sessions of an ideal camera in numpy: frames of the paper's model with sensor noise, factors with a calibration's.

No part of mitsim's renderer, sensor or calibration is in it, so that misfit and uncertainty are judged independently:
noise is drawn, not stated, and only its law is what the manifests say.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mitsim.core.manifests import CalibrationManifest, Digital, FactorNoise, Patterns, RunManifest
from mitsim.core.runs import Capture, Recorder, frame_name
from mitsim.devices.camera import centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.devices.patterns import parse_patterns
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.solver import Status, Verdict
from tests.shadow_factor import scene_factor

N, PIXELS, PITCH = 16, 96, 0.02
PEAK, READ, GAIN, BLACK, CODES, DARK = 2e4, 4.0, 0.2, 100.0, 2**13, 50.0
"""Electrons of the brightest pixel; read noise in electrons; DN an electron; DN; codes; dark electrons a shot."""
CALIBRATION_ERROR = 2e-3
"""Relative error of each factor; the anchor's session has 1.9e-3 a side."""


def shadow(shift: float = 0.0, n: int = N) -> np.ndarray:
    """(PIXELS, n) geometric shadow of the anchor's mask, the scene's pixels moved by ``shift`` of one."""
    edges = centred_edges(n, 120 / n) + shift * 120 / n
    return scene_factor(mls_mask().terms[0][1], 0.06, centred_edges(PIXELS, PITCH), edges, 2.0, 400.0)


def picture(seed: int = 0, n: int = N) -> np.ndarray:
    """A smooth print with a bright and a dark square, reflectance 0.1 to 0.9."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:n, :n] / n
    image = 0.5 + 0.25 * np.sin(2 * np.pi * (x + rng.random())) * np.cos(np.pi * (y + rng.random()))
    image[n // 8 : n // 3, n // 8 : n // 3] = 0.9
    image[n // 2 : 3 * n // 4, n // 2 : 3 * n // 4] = 0.1
    return np.asarray(image)


@dataclass(frozen=True)
class Bench:
    """What is seen: true factors, and what changes the light of a shot on its way.

    ``optics`` takes the light (PIXELS, PIXELS) [electrons] of a shot and gives what the sensor gets; ``stated`` is
    whether the manifests state the noise. Factors and scenes have ``parts`` x ``parts`` numbers for each pixel.
    """

    left: np.ndarray
    right: np.ndarray
    optics: Callable[[np.ndarray], np.ndarray] = lambda light: light
    peak: float = PEAK
    stated: bool = True
    parts: int = 1

    def light(self, shown: np.ndarray) -> np.ndarray:
        """(PIXELS, PIXELS) light of a scene as it is lit."""
        return self.left @ shown @ self.right.T

    def run(self, patterns: str, scene: np.ndarray, seed: int) -> Capture:
        """Noisy shots of a family, the brightest pixel at ``peak``."""
        family, whole = parse_patterns(patterns, len(scene) // self.parts, seed), np.ones((self.parts, self.parts))
        lights = [self.light(np.kron(family.light(shot), whole) * scene) for shot in family.shots]
        gain = self.peak / max(light.max() for light in lights)
        rng, memory = np.random.default_rng([seed, 1]), Recorder()
        for index, light in enumerate(lights):
            electrons = rng.poisson(self.optics(gain * light) + DARK) + READ * rng.standard_normal(light.shape)
            dn = np.clip(np.rint(GAIN * electrons + BLACK), 0, CODES - 1).astype(np.uint32)
            memory.write_frame(index, {"DN": dn}, {})
        memory.write_truth(scene, 0.99)
        noise = {"read_noise_e": READ, "step_dn": 1.0, "saturation_dn": CODES - 1.0} if self.stated else {}
        files = [frame_name(index) for index in range(len(lights))]
        # An exposure of that many seconds turns electrons into the factors' unit, so that the image is the scene.
        digital = Digital(
            exposure_s=gain, gain_dn_per_e=GAIN, black_level_dn=BLACK, dark_current_e_per_s=DARK / gain, **noise
        )
        return memory.finish(RunManifest(camera={}, digital=digital, patterns=Patterns.of(family, files)))

    def calibrated(self, seed: int, error: float = CALIBRATION_ERROR) -> Factors:
        """Factors as a session finds them: each with independent noise of that relative ``error``."""
        rng = np.random.default_rng([seed, 2])
        sides = self.left, self.right
        deviations = [error * float(np.linalg.norm(side) / np.sqrt(side.size)) for side in sides]
        left, right = (side + s * rng.standard_normal(side.shape) for side, s in zip(sides, deviations, strict=True))
        noise = FactorNoise(left=deviations[0], right=deviations[1], unexplained=0.0) if self.stated else None
        status = Status(Verdict.CALIBRATED, "Calibrated: responses are separable")
        return Factors(left, right, CalibrationManifest(camera={}, noise=noise), status)


def bench(shift: float = 0.0, **changes: object) -> Bench:
    """The anchor's camera made small; ``shift`` moves the scene's columns by so many pixels."""
    return Bench(shadow(), shadow(shift), **changes)

"""A small camera before a near board, and light of a few projector pixels in its cells: numbers in, frames' optics out.

The board is near (40 mm), so that the falloff across the sensor is a few percent and every discretisation has something
to get wrong.
"""

import numpy as np
from scipy import sparse

from mitsim.devices.camera import CameraGeometry
from mitsim.devices.patterns import Lighting
from mitsim.optics.frames import AccumulatedLight, ExpectedFrames
from mitsim.optics.image_formation import FrameOptics
from mitsim.optics.shadow import Directions

Z, WINDOW = 40.0, (-0.13, 0.17)
CAMERA = CameraGeometry(
    pixels=96, pixel_pitch=6 / 96, mask="separable", mask_order=3, mask_feature=1.5, scene_distance=Z
)


def cell_optics(camera: CameraGeometry, rows: np.ndarray, columns: np.ndarray, anchors: int = 1) -> FrameOptics:
    """Light that is even in cells, at the board's depth."""
    return FrameOptics(camera, Directions.cells(rows), Directions.cells(columns), (Z,), anchors)


PIXELS, CELLS = 16, 10


def random_groups(count: int, seed: int, spread: float = 1.0) -> list[sparse.csr_array]:
    """Independent estimates of one light (16 pixels, 10 x 10 cells): mean 1 on a third of the entries."""
    fixed = np.random.default_rng(99).random((PIXELS, CELLS**2)) < 0.3
    rng = np.random.default_rng(seed)
    return [sparse.csr_array(fixed * (1 + spread * rng.standard_normal(fixed.shape))) for _ in range(count)]


def small_optics(pixels: int = 40) -> FrameOptics:
    edges = np.linspace(*WINDOW, CELLS + 1)
    # Features three times smaller than a cell's shadow: the cells look different to the sensor.
    fine = {"pixels": pixels, "pixel_pitch": 6.0 / pixels, "mask_order": 9, "mask_feature": 0.02}
    camera = CAMERA.model_copy(update=fine)
    return cell_optics(camera, edges, edges)


LABELS = np.arange(PIXELS) % 4


def expected_frames(optics, groups, labels, weights, seed, more=(), **others) -> ExpectedFrames:
    """Frames of ``groups`` in the cells of ``optics``, and of light accumulated elsewhere."""
    return ExpectedFrames([AccumulatedLight(optics, tuple(groups)), *more], Lighting(labels, weights), seed, **others)


FAMILIES = {
    "identity": np.eye(4),
    "permuted": np.eye(4)[::-1],
    "mixing": np.vstack(
        [np.ones(4), 0.5 + 0.5 * np.array([[1, 1, 1, 1], [1, -1, 1, -1], [1, 1, -1, -1], [0, 1, 0.3, 1]])]
    ),
    "a class or two that leak": 0.02
    + 0.98 * np.array([[1, 0.7, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 0, 1]]),
}


SPLIT = np.arange(PIXELS) % 12
MANY = np.random.default_rng(12).random((3, 12))
"""Twelve classes for three captures: formed capture by capture, not mixed from classes."""
BESIDE = {"mixed": (LABELS, FAMILIES["mixing"]), "by capture": (SPLIT, MANY)}


def ambient_groups(count: int, seed: int = 31) -> tuple[sparse.csr_array, ...]:
    return tuple(group[[0]] for group in random_groups(count, seed, 0.3))

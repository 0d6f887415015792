"""The devices of a bench, as pure data: what they are, apart from the scene that they look at."""

from __future__ import annotations

from dataclasses import dataclass

from mitsim.rig.camera import CameraGeometry
from mitsim.rig.projector import ProjectorModel
from mitsim.rig.sensor import SensorModel


@dataclass(frozen=True)
class Rig:
    """Camera and projector.

    Attributes
    ----------
    camera
        sensor and mask in space, as the scene states them.
    sensor
        the camera's electronics.
    projector
        light and lens of the projector.
    camera_file
        where the electronics stand, for messages.
    """

    camera: CameraGeometry
    sensor: SensorModel
    projector: ProjectorModel
    camera_file: str

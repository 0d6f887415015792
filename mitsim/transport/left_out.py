"""Light that no tracer finds: a scene and its pinhole projector in, how much of it there is out.

Light that mirrors or curved glass bring both from the projector to a surface and from there to the camera (a print in a
bottle), or that comes over a mirror and a lobe too sharp for connections, and the part of indirect light that is
followed from the camera to a caustic: a path from the camera meets no pinhole, and none from the projector the sensor's
centre. A small lens in the pinhole's place casts the same light, and paths run into it.
"""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi

from mitsim.rig.camera import CameraGeometry
from mitsim.transport.cells import CellGrid
from mitsim.transport.from_camera import FromCameraTracer, Paths
from mitsim.transport.projector import ProjectorOptics

_LENS = 0.02
"""Radius of the lens over the scene's distance: 8 mm at 400, which one path in 3000 meets from a matt surface."""


def left_out_light(
    scene: mi.Scene,
    camera: mi.Sensor,
    projector: ProjectorOptics,
    grid: CellGrid,
    geometry: CameraGeometry,
    seed: int,
    samples: int,
) -> float:
    """Irradiance at the sensor's centre [W m^-2] of light that is left out; 0 where a lens of its own lets it be found.

    Parameters
    ----------
    scene, camera, projector
        what light meets, the sensor that it is received on, and where it comes from.
    grid, geometry
        cells that paths start in, and the camera's own.
    seed, samples
        of the random numbers, and paths of each cell.

    Raises
    ------
    MitsimError
        when the scene sends NaN or infinite light to the camera.
    """
    if projector.aperture > 0:
        return 0.0
    lens = replace(projector, aperture=_LENS * geometry.scene_distance, focus=geometry.scene_distance)
    paths = Paths(mirrors=True, interreflection=True, caustics_alone=True)
    return (
        float(FromCameraTracer(scene, camera, lens, grid, paths, geometry).trace(seed, 0, samples).value.sum())
        / samples
    )

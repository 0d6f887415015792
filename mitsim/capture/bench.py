"""An optical bench, ready to use: scene, camera and projector files in, one object that holds them all out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.capture.glint import MirrorLight
from mitsim.core.configuration import load_model, shipped
from mitsim.core.environment import load_variant
from mitsim.core.errors import MitsimError
from mitsim.core.framefile import checksum
from mitsim.rig.camera import CameraGeometry
from mitsim.rig.patterns import PatternFamily, parse_patterns
from mitsim.rig.projector import ProjectorModel, Spectrum
from mitsim.rig.sensor import SensorModel, load_sensor
from mitsim.scene.load import LoadedScene, load_scene
from mitsim.scene.projector import window_at
from mitsim.transport import plugins
from mitsim.transport.beams import trace_beams
from mitsim.transport.source import Projector

DEFAULT_VARIANT = "llvm_ad_mono"
_PITCH_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Bench:
    """A loaded scene with the camera's electronics and the projector's light.

    ``defines`` are the ``-D`` parameters that the scene was loaded with, ``camera_file`` where the electronics stand.
    """

    loaded: LoadedScene
    sensor: SensorModel
    projector: ProjectorModel
    variant: str
    defines: dict[str, str]
    camera_file: str

    @property
    def geometry(self) -> CameraGeometry:
        """The camera's geometry, as the scene states it."""
        geometry: CameraGeometry = self.loaded.camera.geometry
        return geometry

    @property
    def n(self) -> int:
        """Projector pixels a side."""
        return self.loaded.pixels.n

    @property
    def source(self) -> Projector:
        """The projector as the tracer wants it."""
        grid, model = self.loaded.pixels, self.projector
        return Projector(
            self.loaded.projector,
            grid.n,
            grid.first_row,
            grid.first_column,
            grid.canvas,
            model.aperture_radius_mm,
            model.focus_mm or self.geometry.scene_distance,
            model.blur_pixels,
        )

    @property
    def spectrum(self) -> Spectrum:
        """The projector's photons by wavelength."""
        return self.projector.spectrum

    @cached_property
    def mirror_light(self) -> MirrorLight:
        """Light of the projector that mirrors alone bring to the sensor."""
        return MirrorLight(trace_beams(self.loaded.scene, self.loaded.camera, self.source))

    @property
    def windows(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Row and column tan-angles of the projector's window on the aligned plane."""
        return self.loaded.pixels.row_tan, self.loaded.pixels.column_tan

    def windows_at(self, depth: float) -> tuple[tuple[float, float], tuple[float, float]]:
        """The same on a plane at ``depth`` [mm]."""
        if depth == self.geometry.scene_distance:
            return self.windows
        return window_at(str(self.loaded.path), self.loaded.projector, self.loaded.camera, self.loaded.pixels, depth)

    @property
    def field_stop_cuts(self) -> bool:
        """Whether some sensor point does not see all of the projector's window through the field stop."""
        reach = max(abs(edge) for window in self.windows for edge in window)
        shift = self.geometry.half_width / self.geometry.scene_distance
        return bool(reach + shift > self.geometry.tan_half_fov)

    def family(self, patterns: str, seed: int = 0) -> PatternFamily:
        """The pattern family of that name on this projector; MitsimError when it does not fit."""
        return parse_patterns(patterns, self.n, seed)

    def identity(self) -> dict[str, Any]:
        """What must be equal for a calibration to fit a capture: camera geometry, electronics, projector grid."""
        grid = self.loaded.pixels
        return {
            "geometry": self.geometry.model_dump(),
            "sensor": self.sensor.model_dump(exclude={"source"}),
            "projector": {
                "name": self.projector.name,
                "n": grid.n,
                "row_tan": [round(value, 7) for value in grid.row_tan],
                "column_tan": [round(value, 7) for value in grid.column_tan],
            },
        }

    def provenance(self) -> dict[str, Any]:
        """Where the scene came from: path, checksums of the XML and all that it reads, parameters, variant."""
        return {
            "scene": str(self.loaded.path),
            "scene_sha256": checksum(self.loaded.path),
            "scene_files": {str(path): checksum(path) for path in self.loaded.files[1:]},
            "defines": self.defines,
            "variant": self.variant,
            "projector_model": {
                **self.projector.model_dump(mode="json", exclude={"contrast_ratio"}),
                "black_level": self.projector.black_level,
            },
        }

    def with_board(self, reflectance: float) -> Bench:
        """The same rig in front of a diffuse board on the aligned plane, larger than the field stop's view."""
        import mitsuba as mi

        z = self.geometry.scene_distance
        half = 1.1 * (self.geometry.tan_half_fov * z + self.geometry.half_width)
        place = mi.ScalarAffineTransform4f().translate([0, 0, z]).rotate([0, 1, 0], 180).scale([half, half, 1])
        board = {
            "type": "rectangle",
            "to_world": _scalar_transform(self.loaded.camera) @ place,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": reflectance}},
        }
        scene = mi.load_dict(
            {"type": "scene", "camera": self.loaded.camera, "projector": self.loaded.projector, "board": board}
        )
        return replace(self, loaded=replace(self.loaded, scene=scene, lamps=(), mirrors=False, glossy=False))


def open_bench(
    scene: Path | str,
    variant: str = DEFAULT_VARIANT,
    camera: Path | str | None = None,
    projector: Path | str | None = None,
    defines: Mapping[str, str] | None = None,
    check_camera: bool = True,
    outside: bool = False,
) -> Bench:
    """Load a scene with its camera and projector; selects the Mitsuba variant for the process.

    ``camera`` and ``projector`` are TOML files; the shipped IMX249 and MP-CL1 are used without them.
    ``outside`` allows files of the scene outside its folder.
    ``check_camera`` is off where only light matters and the electronics are not used.

    Raises
    ------
    MitsimError
        for anything wrong with the files, or a camera file whose pixel pitch is not the scene's.
    """
    mi = load_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)
    plugins.register()
    sensor_path = Path(camera) if camera is not None else shipped("calibration", "imx249.toml")
    sensor = load_sensor(sensor_path)
    projector_path = Path(projector) if projector is not None else shipped("calibration", "mp_cl1.toml")
    light = load_model(projector_path, ProjectorModel)
    loaded = load_scene(Path(scene), defines, outside=outside)
    pitch, stated = sensor.superpixel_pitch_um * 1e-3, loaded.camera.geometry.pixel_pitch
    if check_camera and abs(pitch - stated) > _PITCH_TOLERANCE * stated:
        raise MitsimError(
            f"camera {sensor_path}: its binned pixel pitch is {pitch * 1e3:g} um, but {scene} has {stated * 1e3:g} um; "
            "use the camera of that scene, or change pixel_pitch, or binning"
        )
    return Bench(loaded, sensor, light, variant, dict(defines or {}), str(sensor_path))


def _scalar_transform(camera: Any) -> Any:
    import mitsuba as mi

    matrix = np.array(camera.world_transform().matrix, dtype=np.float64).reshape(4, 4, -1)[..., 0]
    return mi.ScalarAffineTransform4f(matrix.tolist())

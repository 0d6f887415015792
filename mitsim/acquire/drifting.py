"""Drift of a bench and of a camera's exposure.

Light is traced up to the mask, so that a mask that moved, turned or shakes changes only the optics of traced light
(:meth:`mitsim.light.light.SampledLight.behind`). The cells suffice because a moved shadow is averaged over the same
cells. The light of a moved projector is traced anew because it reaches other places. Power, lamps, temperature,
exposure time and black level are part of the exposure.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from mitsim.acquire.exposure import Exposer, ambient_shots
from mitsim.bench.apparatus import Apparatus
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import stream
from mitsim.devices.patterns import PatternFamily
from mitsim.devices.sensor import SensorModel
from mitsim.devices.session import Drift
from mitsim.optics.frames import Frame
from mitsim.scene.window import window_at
from mitsim.sensor.chain import (
    Digital,
    ripple_level,
    ripple_response,
)

_OF_TERMS = ("mask_rotation_mrad", "mask_tilt_rows_mrad", "mask_tilt_columns_mrad", "vibration_um")
"""Kinds of drift after which other separable terms form the mask's shadow."""


def levels(seed: int, name: str, count: int, ramp: float = 0.0, flicker: float = 0.0) -> FloatArray:
    """Return the (count,) relative light of a source in successive frames; 1 at their begin.

    Parameters
    ----------
    seed, name
        Random stream.
    count
        Number of frames; each takes the value at its middle.
    ramp, flicker
        Linear change from the begin of the first frame to the end of the last, and normal deviation of each.
    """
    changed = 1 + ramp * (np.arange(count) + 0.5) / count
    if flicker:
        changed = changed * (1 + flicker * stream(seed, "drift", name).standard_normal(count))
    return np.asarray(np.maximum(changed, 0.0))


def drift_mask(bench: Apparatus, drift: Drift) -> Apparatus:
    """Return a ``bench`` whose mask has moved by a ``drift``, for light that was traced before.

    Raises MitsimError for a mask that turns, tilts or shakes before mirrors or is drawn on a raster, for a thick mask
    that tilts or one that tilts too far, and for one that moves into the sensor or the scene.
    """
    row, column, axis = drift.mask_mm
    camera, kinds = bench.geometry, " and ".join(kind for kind in drift.kinds if kind in _OF_TERMS)
    if kinds and camera.is_correlated(camera.diffracts):
        raise MitsimError(
            f"drift: {kinds} would be formed of separable terms, and {camera.mask_words} has none; turn or tilt that "
            "mask in the camera file's [mask]"
        )
    if kinds and bench.loaded.mirrors:
        raise MitsimError(
            f"drift: {kinds} would be formed of light in cells, and mirrors bring light in none; take a scene without "
            "mirrors"
        )
    if drift.tilt_mrad and camera.mask_thickness:
        raise MitsimError(
            f"drift: {kinds} would tilt a mask of {camera.mask_thickness:g} mm, and only thin ones are formed tilted; "
            "set mask_thickness to 0"
        )
    if not camera.mask_distance + axis > 0:
        raise MitsimError(
            f"drift: mask_axis_um moves the mask {-axis:g} mm, to the sensor; it is {camera.mask_distance:g} mm off"
        )
    changed: dict[str, object] = {
        "mask_offset_row": camera.mask_offset_row + row,
        "mask_offset_column": camera.mask_offset_column + column,
        "mask_distance": camera.mask_distance + axis,
        "mask_motion": drift.motion,
        "mask_lean_mrad": drift.tilt_mrad,
    }
    moved = camera.model_copy(update=changed)
    if drift.tilt_mrad and moved.tilt_left_out(moved.diffracts):
        raise MitsimError(
            f"drift: {kinds} would tilt the mask until its shadow takes more terms than are formed; give less, or one "
            "of the two alone"
        )
    return replace(bench, devices=replace(bench.devices, camera=moved))


def drift_projector(bench: Apparatus, drift: Drift) -> Apparatus:
    """Return a ``bench`` whose projector's picture has moved by a ``drift``; its light must be traced anew."""
    if not (drift.projector_rows or drift.projector_columns):
        return bench
    loaded, grid = bench.loaded, bench.loaded.pixels
    first_row, first_column = grid.first_row + drift.projector_rows, grid.first_column + drift.projector_columns
    moved = replace(grid, first_row=first_row, first_column=first_column)
    windows = window_at(str(loaded.path), loaded.projector, loaded.camera, moved, bench.geometry.scene_distance)
    placed = replace(moved, row_tan=windows[0], column_tan=windows[1])
    return replace(bench, loaded=replace(loaded, grid=placed))


def warmer(sensor: SensorModel, kelvin: float) -> SensorModel:
    """Return a ``sensor`` that is ``kelvin`` warmer, or the same if its file states no temperature."""
    if sensor.dark_current_temperature_c is None or sensor.dark_doubling_c is None or not kelvin:
        return sensor
    now = sensor.dark_current_temperature_c if sensor.temperature_c is None else sensor.temperature_c
    return sensor.model_copy(update={"temperature_c": now + kelvin})


@dataclass(frozen=True)
class DriftedExposer(Exposer):
    """A camera that has drifted: frames are exposed in its true state and interpreted in its known one.

    Attributes
    ----------
    drift
        The drift.
    family
        Patterns in the order of the shots.
    ambient
        (m, m') light of lamps [W m^-2] when the ambient frame was taken.
    """

    drift: Drift = field(default_factory=Drift)
    family: PatternFamily | None = None
    ambient: FloatArray | float = 0.0

    def electrons(self, frame: Frame) -> FloatArray:
        """Return the expected photoelectrons (m, m') of ``frame`` while the shutter is open."""
        return self._open.electrons(frame)

    def shot_electrons(self, frame: Frame, *names: str | int) -> FloatArray:
        """Return the expected photoelectrons of ``frame`` with projector and lamps at their level."""
        rows = len(frame.irradiance)
        power, lamp = (
            level * self._ripple(source, rows, *names)
            for source, level in zip(("power", "lamp"), self.levels[names], strict=True)
        )
        light = frame.irradiance + (power - 1) * (frame.irradiance - self.ambient)
        return super().shot_electrons(replace(frame, irradiance=light + (lamp - 1) * self.ambient), *names)

    def digital(self, electrons: FloatArray, *names: str | int) -> Digital:
        """Draw noisy digital numbers of expected ``electrons``."""
        if names[0] == "ambient":
            level = self.ambient_levels[int(names[1])] * self._ripple("lamp", len(electrons), *names)
            electrons = level * electrons
        return self._open.digital(electrons, *names)

    def _ripple(self, source: str, rows: int, *names: str | int) -> FloatArray | float:
        if source not in self.drift.ripples:
            return 1.0
        amplitude, hertz = self.drift.ripples[source]
        response = ripple_response(self.devices.sensor, self._open.exposure_s, hertz, rows)
        phase = stream(self.seed, "drift", f"{source} ripple", *names).uniform(0, 2 * np.pi)
        return ripple_level(response, amplitude, phase)

    @cached_property
    def _open(self) -> Exposer:
        sensor, drift = warmer(self.devices.sensor, self.drift.temperature_k), self.drift
        black = {"black_level_dn": sensor.black_level_dn + drift.black_level_dn}
        devices = replace(self.devices, sensor=sensor.model_copy(update=black))
        return Exposer(devices, self.exposure_s * (1 + drift.exposure), self.seed, self.speckle)

    @cached_property
    def levels(self) -> dict[tuple[str | int, ...], tuple[float, float]]:
        """Return the relative level of projector and lamps in each shot, by its names."""
        assert self.family is not None
        shots, drift = self.family.shots, self.drift
        power = (1 + drift.power) * levels(self.seed, "power", len(shots), drift.power_ramp, drift.power_flicker)
        lamp = (1 + drift.lamp) * levels(self.seed, "lamp", len(shots), flicker=drift.lamp_flicker)
        found = zip(power.tolist(), lamp.tolist(), strict=True)
        return dict(zip((shot.names for shot in shots), found, strict=True))

    @cached_property
    def ambient_levels(self) -> FloatArray:
        """Return the (shots,) relative level of the lamps in each shot of the ambient frame."""
        assert self.family is not None
        return levels(self.seed, "ambient", ambient_shots(self.family), flicker=self.drift.lamp_flicker)

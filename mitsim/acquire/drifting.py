"""A drift in; a bench, and a camera's exposure, as they are after it, out.

Light is traced up to the mask, so a mask that moved, turned or shakes changes the optics of traced light alone
(:meth:`mitsim.light.light.SampledLight.behind`): a moved shadow is averaged over the same cells, so cells that hold
frames to an accuracy hold what the drift changes in them as well. A moved projector lights other places: its light is
traced anew. All else - power, lamps, temperature, exposure time, black level - is in the exposure.
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
"""Kinds after which the mask's shadow is formed of other separable terms than at rest."""


def levels(seed: int, name: str, count: int, ramp: float = 0.0, flicker: float = 0.0) -> FloatArray:
    """(count,) light of a source in frames one after the other, 1 at their begin.

    Parameters
    ----------
    seed, name
        of the random stream.
    count
        frames, of which each stands for its middle.
    ramp, flicker
        even change from the begin of the first frame to the end of the last, and normal deviation of each, both as
        parts of the light; none goes below 0.
    """
    changed = 1 + ramp * (np.arange(count) + 0.5) / count
    if flicker:
        changed = changed * (1 + flicker * stream(seed, "drift", name).standard_normal(count))
    return np.asarray(np.maximum(changed, 0.0))


def drift_mask(bench: Apparatus, drift: Drift) -> Apparatus:
    """A ``bench`` whose mask has moved as a ``drift`` says, for all that is made of light traced before.

    MitsimError for a mask that turns, tilts or shakes before mirrors, whose light is formed ray by ray, or whose
    shadow is drawn on a raster; for one that tilts and is thick, or is tilted too far; and for one that moves into the
    sensor or the scene.
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
    """A ``bench`` whose projector's picture has moved as a ``drift`` says, whose light is to be traced."""
    if not (drift.projector_rows or drift.projector_columns):
        return bench
    loaded, grid = bench.loaded, bench.loaded.pixels
    first_row, first_column = grid.first_row + drift.projector_rows, grid.first_column + drift.projector_columns
    moved = replace(grid, first_row=first_row, first_column=first_column)
    windows = window_at(str(loaded.path), loaded.projector, loaded.camera, moved, bench.geometry.scene_distance)
    placed = replace(moved, row_tan=windows[0], column_tan=windows[1])
    return replace(bench, loaded=replace(loaded, grid=placed))


def warmer(sensor: SensorModel, kelvin: float) -> SensorModel:
    """A ``sensor`` so many ``kelvin`` warmer; one whose file says nothing of temperature stays as it is."""
    if sensor.dark_current_temperature_c is None or sensor.dark_doubling_c is None or not kelvin:
        return sensor
    now = sensor.dark_current_temperature_c if sensor.temperature_c is None else sensor.temperature_c
    return sensor.model_copy(update={"temperature_c": now + kelvin})


@dataclass(frozen=True)
class DriftedExposer(Exposer):
    """A camera whose user knows it as it was: frames are exposed as it is, and read as it was.

    Attributes
    ----------
    drift
        what has changed.
    family
        patterns whose frames are exposed, in the order of its shots.
    ambient
        (m, m') light of lamps [W m^-2], as it was when their frame was taken.
    """

    drift: Drift = field(default_factory=Drift)
    family: PatternFamily | None = None
    ambient: FloatArray | float = 0.0

    def electrons(self, frame: Frame) -> FloatArray:
        """Expected photoelectrons (m, m') of ``frame`` in the time that the shutter is open."""
        return self._open.electrons(frame)

    def shot_electrons(self, frame: Frame, *names: str | int) -> FloatArray:
        """Expected photoelectrons of the ``frame`` that ``names`` find, projector and lamps at their level."""
        rows = len(frame.irradiance)
        power, lamp = (
            level * self._ripple(source, rows, *names)
            for source, level in zip(("power", "lamp"), self.levels[names], strict=True)
        )
        light = frame.irradiance + (power - 1) * (frame.irradiance - self.ambient)
        return super().shot_electrons(replace(frame, irradiance=light + (lamp - 1) * self.ambient), *names)

    def digital(self, electrons: FloatArray, *names: str | int) -> Digital:
        """Noisy digital numbers of expected ``electrons``; ``names`` find the frame's own noise."""
        if names[0] == "ambient":
            level = self.ambient_levels[int(names[1])] * self._ripple("lamp", len(electrons), *names)
            electrons = level * electrons
        return self._open.digital(electrons, *names)

    def _ripple(self, source: str, rows: int, *names: str | int) -> FloatArray | float:
        """(rows, 1) level of a ``source`` that ripples, in the frame that ``names`` find; 1 of one that does not.

        The camera runs free of it: each frame has a phase of its own.
        """
        if source not in self.drift.ripples:
            return 1.0
        amplitude, hertz = self.drift.ripples[source]
        response = ripple_response(self.devices.sensor, self._open.exposure_s, hertz, rows)
        phase = stream(self.seed, "drift", f"{source} ripple", *names).uniform(0, 2 * np.pi)
        return ripple_level(response, amplitude, phase)

    @cached_property
    def _open(self) -> Exposer:
        """The camera as it is."""
        sensor, drift = warmer(self.devices.sensor, self.drift.temperature_k), self.drift
        black = {"black_level_dn": sensor.black_level_dn + drift.black_level_dn}
        devices = replace(self.devices, sensor=sensor.model_copy(update=black))
        return Exposer(devices, self.exposure_s * (1 + drift.exposure), self.seed, self.speckle)

    @cached_property
    def levels(self) -> dict[tuple[str | int, ...], tuple[float, float]]:
        """Level of the projector and of the lamps in each shot, by its names; 1 as they were."""
        assert self.family is not None
        shots, drift = self.family.shots, self.drift
        power = (1 + drift.power) * levels(self.seed, "power", len(shots), drift.power_ramp, drift.power_flicker)
        lamp = (1 + drift.lamp) * levels(self.seed, "lamp", len(shots), flicker=drift.lamp_flicker)
        found = zip(power.tolist(), lamp.tolist(), strict=True)
        return dict(zip((shot.names for shot in shots), found, strict=True))

    @cached_property
    def ambient_levels(self) -> FloatArray:
        """(shots,) level of the lamps in each shot of the ambient frame."""
        assert self.family is not None
        return levels(self.seed, "ambient", ambient_shots(self.family), flicker=self.drift.lamp_flicker)

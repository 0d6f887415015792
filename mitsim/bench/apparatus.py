"""A scene with camera and projector, opened from names or files, or a refusal."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from mitsim.core.configuration import CAMERA, DEFAULT_CAMERA, PROJECTOR, load_model, locate
from mitsim.core.environment import DEFAULT_VARIANT, deciding_versions, load_variant
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments
from mitsim.core.files import plain
from mitsim.core.worker import pause_collector
from mitsim.devices.patterns import read_name
from mitsim.scene.outline import Outline, lit_side

if TYPE_CHECKING:
    from typing_extensions import Self

    from mitsim.core.manifests import Parallax
    from mitsim.devices.camera import CameraGeometry, Devices, MaskProfile
    from mitsim.devices.patterns import PatternFamily
    from mitsim.devices.projector import CountedLamps, Lines, ProjectorModel, Spectrum
    from mitsim.devices.sensor import SensorModel
    from mitsim.optics.frames import SpecularLight
    from mitsim.scene.load import LoadedScene
    from mitsim.transport.connect import OpticalSetup, ProjectorOptics


_OF_COLOURS = {"quantum_efficiency_curve", "mosaic", "mosaic_curves"}
"""Fields of a sensor that weight wavelengths."""
_NOT_SIMULATED = {
    "name", "luminous_flux_lm", "luminous_efficacy_lm_per_w", "radiant_flux_w", "throw_ratio", "columns", "rows",
    "pixel_aspect", "laser_class", "assumed", "derived", "source",
}  # fmt: skip
"""Fields of a projector that describe it and change no light."""
_SPECKLED_SHOTS = 8
"""Shots whose contrast stands for a family's."""


# -------- What is loaded


def check_depth(depth: float) -> float:
    """Return ``depth`` [mm], or raise ArgumentError if it is not in front of the camera."""
    if not 0 < depth < math.inf:
        raise ArgumentError("depth", f"{depth:g}: give millimetres above 0")
    return depth


@dataclass(frozen=True)
class Apparatus:
    """A loaded scene with the camera's electronics and the projector's light.

    Attributes
    ----------
    loaded
        The scene.
    devices
        Camera, sensor and projector as data.
    variant
        Variant of Mitsuba.
    defines
        Parameters with which the scene was loaded.
    lines
        Lines of the projector that spectral variants trace; None draws wavelengths from all.
    counted_lamps
        How the camera counts lamps' light of all wavelengths; None treats it like the projector's.
    filters
        The camera with its colour filters, which are applied to frames; the sensor in ``devices`` then has none and
        makes one electron per photon. None without filters.
    board
        Reflectance, depth and shape of the board that replaces the scene; None for the scene itself.
    opened
        ``camera``, ``projector`` (absolute paths or None) and ``allow_outside_files`` as given; None if unknown.
    """

    loaded: LoadedScene
    devices: Devices
    variant: str
    defines: dict[str, str]
    lines: Lines | None = None
    counted_lamps: CountedLamps | None = None
    filters: SensorModel | None = None
    board: Mapping[str, Any] | None = None
    opened: dict[str, Any] | None = None

    @property
    def geometry(self) -> CameraGeometry:
        """Return the camera's geometry."""
        return self.devices.camera

    @property
    def sensor(self) -> SensorModel:
        """Return the camera's electronics."""
        return self.devices.sensor

    @property
    def counting(self) -> SensorModel:
        """Return the electronics whose efficiency counts lamps' light, with colour filters."""
        return self.filters or self.sensor

    @property
    def projector(self) -> ProjectorModel:
        """Return the projector's light and lens."""
        return self.devices.projector

    @property
    def n(self) -> int:
        """Return the projector pixels per side."""
        return self.loaded.pixels.n

    @cached_property
    def projector_optics(self) -> ProjectorOptics:
        """Return the projector as tracers need it."""
        from mitsim.transport.connect import ProjectorOptics

        grid, model = self.loaded.pixels, self.projector
        window = grid.n, grid.first_row, grid.first_column, grid.canvas
        lens = model.aperture_radius_mm, model.focus_mm or self.geometry.scene_distance, model.blur_pixels
        glare = 1 - model.glare, model.glare_spread * grid.n
        return ProjectorOptics(self.loaded.projector, *window, *lens, self.lines, bool(self.loaded.parting), *glare)

    @property
    def setup(self) -> OpticalSetup:
        """Return the setup in which light is traced."""
        from mitsim.transport.connect import OpticalSetup

        return OpticalSetup(self.loaded.scene, self.loaded.camera, self.projector_optics, self.geometry)

    @property
    def spectrum(self) -> Spectrum:
        """Return the projector's photons by wavelength."""
        return self.projector.spectrum

    @cached_property
    def waves(self) -> Spectrum | None:
        """Return the lines whose diffraction is computed, or None."""
        from mitsim.optics.diffraction import narrowest_mm
        from mitsim.optics.fft_shadow import check_waves

        narrow = self.geometry.build_mask().opening_mm < narrowest_mm(float(self.spectrum.wavelengths_nm.max()))
        if narrow or not self.geometry.diffracts:
            return None
        try:
            check_waves(self.geometry, self.spectrum)
        except MitsimError:  # as with too narrow openings, a plan is refused unless it leaves waves out
            return None
        return self.spectrum

    @cached_property
    def specular(self) -> SpecularLight:
        """Return the light that reaches the sensor over mirrors or free space alone."""
        from mitsim.optics.frames import SpecularLight
        from mitsim.transport.specular import trace_specular_chains

        return SpecularLight(trace_specular_chains(self.loaded.scene, self.loaded.camera, self.projector_optics))

    @property
    def windows(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return row and column tan-angles of the projector's window on the aligned plane."""
        return self.loaded.pixels.row_tan, self.loaded.pixels.column_tan

    @check_arguments
    def windows_at(self, depth: float) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the window's tan-angles at ``depth`` [mm]; raise ArgumentError for one behind the camera."""
        check_depth(depth)
        if depth == self.geometry.scene_distance:
            return self.windows
        from mitsim.scene.load import window_at

        loaded = self.loaded
        return window_at(str(loaded.path), loaded.projector, loaded.camera, loaded.pixels, depth)

    @property
    def parallax(self) -> Parallax:
        """Return how factors of a calibration on the aligned plane change with depth."""
        return self.parallax_from(self.geometry.scene_distance)

    @check_arguments
    def parallax_from(self, depth: float) -> Parallax:
        """Return the parallax of a calibration at ``depth`` [mm], which lies between the mask and 1e10 mm."""
        from mitsim.core.manifests import FARTHEST, Parallax

        if depth <= self.geometry.mask_distance:
            raise ArgumentError("depth", f"{depth:g}: the mask is at {self.geometry.mask_distance:g} mm; give more")
        if depth > FARTHEST:
            raise ArgumentError("depth", f"{depth:g}: give at most {FARTHEST:g} mm")
        import numpy as np

        # At twice the depth, which is in 1/z halfway to infinity: far enough that rounding of uv does not show.
        near, far = (np.array(self.windows_at(z)) for z in (depth, 2 * depth))
        # Seen from the frames' middle, c off the axis: tangents are c / z less.
        centres, slope = np.zeros((2, 1)), (far - near) / (1 / (2 * depth) - 1 / depth)
        if self.geometry.roi is not None:
            centres[:, 0] = [(each[0] + each[-1]) / 2 for each in map(self.geometry.centres, (0, 1))]
        row_tan, column_tan = map(tuple, (near - centres / depth).tolist())
        rows, columns = map(tuple, (slope - centres).tolist())
        return Parallax(
            depth_mm=depth,
            row_tan=row_tan,
            column_tan=column_tan,
            row_mm=rows,
            column_mm=columns,
            pixel_pitch_mm=self.geometry.pixel_pitch,
            row_pitch_mm=self.geometry.row_pitch,
            mask_distance_mm=self.geometry.mask_distance,
            stop_tan=self.geometry.tan_half_fov,
        )

    @property
    def field_stop_cuts(self) -> bool:
        """Return True if a sensor point does not see the whole projector window through the field stop."""
        geometry = self.geometry
        sides = zip(self.windows, geometry.half_sides, strict=True)
        return any(max(map(abs, tan)) + half / geometry.scene_distance > geometry.tan_half_fov for tan, half in sides)

    @check_arguments
    def family(self, patterns: str, seed: int = 0) -> PatternFamily:
        """Return the pattern family on this projector; raise MitsimError if it does not fit."""
        from mitsim.devices.patterns import parse_patterns

        return parse_patterns(patterns, self.n, seed, self.projector.grey_light)

    @check_arguments
    def speckle(self, family: PatternFamily | None = None) -> float:
        """Return the speckle contrast in a sensor pixel, stated or computed for a ``family`` (None: white)."""
        if self.projector.speckle is None:
            return self.projector.speckle_contrast
        import numpy as np

        from mitsim.optics.frames import contrast_of

        key = None if family is None else (family.left.tobytes(), family.right.tobytes())
        if key not in self._contrasts:
            rows, columns = ((far - near) * self.geometry.scene_distance / self.n for near, far in self.windows)
            shots = () if family is None else family.shots[:: -(-len(family.shots) // _SPECKLED_SHOTS)]
            lit = [family.light(shot) for shot in shots] if family else [np.ones((self.n, self.n))]
            each = [contrast_of(self.devices, (rows, columns), light) for light in lit if light.any()]
            self._contrasts[key] = float(np.sqrt(np.mean(np.square(each))))
        return self._contrasts[key]

    @cached_property
    def _contrasts(self) -> dict[tuple[bytes, bytes] | None, float]:
        return {}

    def identity(self) -> dict[str, Any]:
        """Return all that must be equal for a calibration to fit a capture."""
        grid, lines = self.loaded.pixels, self.projector.lines
        shares = [round(share, 7) for share in lines.shares]
        of_lines: dict[str, Any] = {"lines_nm": list(lines.wavelengths_nm), "radiant_shares": shares}
        if self.filters and self.lines and self.lines.several:
            of_lines = {}  # colour.json has them
        return {
            "geometry": self.geometry.identity,
            "sensor": self.counting.identity,
            "projector": {
                "name": self.projector.name,
                "n": grid.n,
                "row_tan": [round(value, 7) for value in grid.row_tan],
                "column_tan": [round(value, 7) for value in grid.column_tan],
                **of_lines,
            },
        }

    def provenance(self) -> dict[str, Any]:
        """Return path, checksums, parameters and variant of the scene."""
        from mitsim.core.exr import checksum

        return {
            "scene": str(self.loaded.path),
            "scene_sha256": checksum(self.loaded.path),
            "scene_files": {str(path): checksum(path) for path in self.loaded.files[1:]},
            "defines": self.defines,
            "variant": self.variant,
            **({} if self.board is None else {"board": dict(self.board)}),
            **({} if self.lines is None else {"lines": asdict(self.lines)}),
            **({} if self.counted_lamps is None else {"lamps_nm": list(self.counted_lamps.range_nm)}),
            "projector_model": {
                **self.projector.model_dump(mode="json", exclude={"contrast_ratio"}),
                "black_level": self.projector.black_level,
            },
        }

    @property
    def deciding(self) -> dict[str, Any]:
        """Return all that determines a plan, by name, for JSON.

        Paths are excluded, and so are properties that only affect exposure: noise, full well, a constant efficiency.
        """
        from mitsim.core.exr import checksum

        folder, own = self.loaded.path.parent, self.counting.model_dump(include=_OF_COLOURS, exclude_none=True)
        named = self.loaded.own  # wherever they lie
        others = self.loaded.files[1:]
        files = {named.get(str(path)) or os.path.relpath(path, folder): checksum(path) for path in others}
        lit = self.projector.model_dump(mode="json", exclude={"contrast_ratio", *_NOT_SIMULATED})
        stated: dict[str, Any] = plain(
            {
                "version": deciding_versions(),
                "colour": None if self.lines is None else {"filters": self.filters is not None, **asdict(self.lines)},
                "variant": self.variant,
                "scene": {"its XML": checksum(self.loaded.path), **files},
                "parameter": {name: self.defines[name] for name in self.defines.keys() - {*named.values()}},
                "board": self.board,
                "camera": {**self.geometry.identity, **own},
                "projector": {**lit, "black_level": self.projector.black_level},
            }
        )
        return stated

    @cached_property
    def devices_digest(self) -> str:
        """Return the SHA-256 of all that a board in the scene's place shows: devices, places, light."""
        import mitsuba as mi
        import numpy as np

        light, pose = mi.traverse(self.loaded.projector), self.loaded.camera.world_transform()
        said = self.variant, self.geometry.identity, self.sensor, self.projector, self.lines, self.loaded.pixels
        digest = hashlib.sha256(repr(said).encode())
        for name, value in (*light.items(), ("camera", pose)):
            values = np.asarray(getattr(value, "matrix", value))
            digest.update(f"{name} {values.dtype} {values.shape}".encode() + values.tobytes())
        return digest.hexdigest()

    @check_arguments
    def in_bands(self, count: int) -> Self:
        """Return the bench whose projector has ``count`` bands of its lines as lines."""
        return replace(self, devices=replace(self.devices, projector=self.projector.in_bands(count)))


# -------- Opening a scene, a camera and a projector

Opened = TypeVar("Opened", bound=Apparatus)


def check_scene(
    scene: Path | str, defines: Mapping[str, str], outside: bool = False, patterns: Iterable[str] = ()
) -> Path:
    """Return the path of a scene, and refuse it without the renderer where possible.

    Parameters
    ----------
    scene
        Scene as for :func:`mitsim.api.bench.open_bench`.
    defines
        Values of its parameters by name.
    outside
        Allow files outside its folder.
    patterns
        Families that its projector is to show.

    Raises
    ------
    MitsimError
        For a missing scene, unknown parameters, malformed XML, and patterns that need more pixels than the projector
        has.
    """
    path = locate(scene, "scenes", "scene.xml")
    pictures = Outline(path, defines, outside).projected
    n = lit_side(pictures[0]) if len(pictures) == 1 else None
    for family in patterns:
        read_name(family, n)
    return path


def check_devices(camera: Path | str | None, projector: Path | str | None) -> tuple[Path, Path]:
    """Return the files of a ``camera`` and a ``projector``; raise MitsimError if one is missing."""
    found = ((camera, DEFAULT_CAMERA, CAMERA), (projector, "mp_cl1", PROJECTOR))
    first, second = (locate(name or default, "calibration", ".toml", field) for name, default, field in found)
    return first, second


def open_apparatus(
    scene: Path | str,
    variant: str = DEFAULT_VARIANT,
    camera: Path | str | None = None,
    projector: Path | str | None = None,
    allow_outside_files: bool = False,
    for_render: bool = False,
    **parameters: object,
) -> Apparatus:
    """Load scene, camera and projector; parameters and errors as for :func:`mitsim.api.bench.open_bench`."""
    defines = {name: spelling(value) for name, value in parameters.items()}
    path = check_scene(scene, defines, allow_outside_files)
    sensor_path, projector_path = check_devices(camera, projector)
    from mitsim.devices.sensor import PITCH_TOLERANCE, load_sensor

    sensor = load_sensor(sensor_path)
    # What imports numpy comes after what does not.
    from mitsim.devices.camera import Devices, load_mask
    from mitsim.devices.projector import ProjectorModel

    mask = load_mask(sensor_path)
    if mask is not None and "mask" in defines:
        problem = f"camera {sensor_path}: has a table [mask], and the scene's mask was set to {defines['mask']!r}"
        raise MitsimError(f"{problem} as well; give one of the two")
    light = load_model(projector_path, ProjectorModel)
    # All lines at once behind colour filters are for variants that tell them apart.
    if not for_render and not (sensor.mosaic and variant.endswith("_spectral")):
        try:
            sensor.efficiency(light.effective_wavelength_nm)
        except MitsimError as error:
            raise MitsimError(f"camera {sensor_path}: {error}") from None
    # Only now, with all else checked: the renderer takes a second to import.
    options = {"needs_projector": not for_render, "outside": allow_outside_files}
    loaded = _load(variant, path, defines, **options, **({} if camera is None else {"sensor": sensor}))
    names = () if camera is not None or for_render else ("row_pitch", "pixel_pitch")
    for axis, name in reversed([*enumerate(names)]):
        own, stated = sensor.pitches_mm[axis], loaded.camera.geometry.pitches[axis]
        if abs(own - stated) > PITCH_TOLERANCE * stated:
            own_um, stated_um = f"{own * 1e3:g} um", f"{scene} has {stated * 1e3:g} um"
            problem = f"camera {sensor_path}: its binned {name.replace('_', ' ')} is {own_um}, but {stated_um}"
            raise MitsimError(f"{problem}; name the scene's own camera by --camera, or change {name}")
    if mask is not None and (distance := mask.distance_mm) is not None:
        stated = loaded.camera.geometry.mask_distance
        if "mask_distance" in defines and not math.isclose(distance, stated):
            problem = f"camera {sensor_path}: its table [mask] has distance_mm {distance:g}"
            raise MitsimError(f"{problem}, and mask_distance was set to {stated:g}; give one of the two")
        note = f"mask: {distance:g} mm before the sensor, as its camera file says, in place of the scene's {stated:g}"
        notes = [loaded.sensor_note, "" if math.isclose(distance, stated) else note]
        loaded = replace(loaded, sensor_note="; ".join(filter(None, notes)))
    _adapt(loaded, mask, sensor_path, light)
    devices = Devices(loaded.camera.geometry, sensor, light, str(sensor_path))
    # By their whole paths: who repeats this from another folder finds them.
    whole = {**defines, **{name: path for path, name in loaded.own.items()}}
    opened: dict[str, Any] = {"camera": camera and str(sensor_path.absolute())}
    opened |= {"projector": projector and str(projector_path.absolute()), "allow_outside_files": allow_outside_files}
    return Apparatus(loaded, devices, variant, whole, opened=opened)


def reopen(bench: Opened, variant: str) -> Opened:
    """Load the ``bench`` anew in a ``variant``, which is set from then on."""
    from mitsim.devices.camera import load_mask

    camera = Path(bench.devices.camera_file)
    given = {} if bench.loaded.sensor_note is None else {"sensor": bench.sensor}
    loaded = _load(variant, bench.loaded.path, bench.defines, outside=True, **given)
    _adapt(loaded, load_mask(camera), camera, bench.projector)
    return replace(bench, loaded=loaded, variant=variant)


def _adapt(loaded: LoadedScene, mask: MaskProfile | None, camera: Path, projector: ProjectorModel) -> None:
    """Give a scene the mask of the file of its ``camera``, and its glass the index for the light of its projector."""
    if mask is not None:
        loaded.camera.wear(mask.put_on(loaded.camera.geometry, camera.parent))
    if loaded.parting:
        from mitsim.transport.plugins.materials import tune

        tune(loaded.scene, projector.effective_wavelength_nm)


@pause_collector()
def _load(variant: str, path: Path, defines: Mapping[str, str], **options: Any) -> LoadedScene:
    mitsuba = load_variant(variant)
    from mitsim.scene.load import load_scene
    from mitsim.transport import plugins
    from mitsim.transport.connect import shines_in
    from mitsim.transport.transmission import contacts

    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    plugins.register()
    loaded = load_scene(path, defines, **options)
    refusals = list[MitsimError | None]()
    for contact in contacts(loaded.scene):
        if contact is None:
            refusals.append(None)
            continue
        shape, got, rule = contact
        refusal = MitsimError(f"{loaded.path}: shape {shape}: got {got}; {rule}")
        refusals.append(loaded.shapes[shape].refusal("shape", got, rule) if loaded.shapes else refusal)
    factored, reference = refusals
    if factored is not None and options.get("needs_projector", True):
        raise factored
    own = loaded.unfit
    unfit = replace(own, factored=own.factored or factored, reference=own.reference or reference)
    projectors = [emitter for emitter in loaded.scene.emitters() if emitter.class_name() == "Projector"]
    in_view = any(shines_in(loaded.scene, loaded.camera, each) for each in projectors)
    return replace(loaded, unfit=unfit, in_view=in_view, mirrors=loaded.mirrors or in_view)


def spelling(value: object) -> str:
    """Return the ``value`` of a parameter as a scene spells it."""
    return str(value).lower() if isinstance(value, bool) else str(value)

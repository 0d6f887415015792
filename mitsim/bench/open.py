"""Opening a bench: names or files of a scene, a camera and a projector in; a bench, or a refusal, out.

What can be refused without numpy or the renderer is refused before they are imported.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from mitsim.bench.apparatus import Apparatus
from mitsim.core.configuration import DEFAULT_CAMERA, load_model, locate
from mitsim.core.environment import DEFAULT_VARIANT, load_variant
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import read_name
from mitsim.scene.outline import Outline, SceneFiles, lit_side

if TYPE_CHECKING:
    from mitsim.devices.mask_profile import MaskProfile
    from mitsim.devices.projector import ProjectorModel
    from mitsim.scene.load import LoadedScene
    from mitsim.transport.transmission import Contact

Opened = TypeVar("Opened", bound=Apparatus)
_PITCH_TOLERANCE = 1e-3
"""Relative difference of the scene's pixel pitch from the camera's that is rounding in a data sheet."""


def check_scene(
    scene: Path | str, defines: Mapping[str, str], outside: bool = False, patterns: Iterable[str] = ()
) -> Path:
    """Where a scene lies, which is refused without the renderer where that is possible.

    Parameters
    ----------
    scene
        as of :func:`mitsim.api.bench.open_bench`.
    defines
        values of its parameters by name.
    outside
        as ``allow_outside_files`` there.
    patterns
        families that its projector is to show.

    Raises
    ------
    MitsimError
        for a scene that there is not, a parameter that it does not have, XML that is not well-formed, and patterns that
        need more pixels than the projector's picture lights.
    """
    path = locate(scene, "scenes", "scene.xml")
    pictures = Outline(path, defines, SceneFiles(path, outside)).projected
    n = lit_side(pictures[0]) if len(pictures) == 1 else None
    for family in patterns:
        read_name(family, n)
    return path


def check_devices(camera: Path | str | None, projector: Path | str | None) -> tuple[Path, Path]:
    """Files of a ``camera`` and a ``projector``, as of :func:`mitsim.api.bench.open_bench`; MitsimError for one that
    there is not."""
    found = ((camera, DEFAULT_CAMERA), (projector, "mp_cl1"))
    first, second = (locate(default if name is None else name, "calibration", ".toml") for name, default in found)
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
    """Scene, camera and projector, loaded.

    Parameters
    ----------
    scene, variant, camera, projector, allow_outside_files, for_render, **parameters
        as for :func:`mitsim.api.bench.open_bench`, which has the errors raised as well.
    """
    defines = {name: _text(value) for name, value in parameters.items()}
    path = check_scene(scene, defines, allow_outside_files)
    sensor_path, projector_path = check_devices(camera, projector)
    from mitsim.devices.sensor import load_sensor

    sensor = load_sensor(sensor_path)
    # What imports numpy comes after what does not.
    from mitsim.devices.camera import Rig
    from mitsim.devices.mask_profile import load_mask
    from mitsim.devices.projector import ProjectorModel

    mask = load_mask(sensor_path)
    if mask is not None and "mask" in defines:
        raise MitsimError(
            f"camera {sensor_path}: has a table [mask], and the scene's mask was set to {defines['mask']!r} as well; "
            "give one of the two"
        )
    light = load_model(projector_path, ProjectorModel)
    # All lines at once behind colour filters are for variants that tell them apart.
    if not for_render and not (sensor.mosaic and variant.endswith("_spectral")):
        try:
            sensor.efficiency(light.effective_wavelength_nm)
        except MitsimError as error:
            fits = f"it goes with scenes whose pixel_pitch is {sensor.superpixel_pitch_um * 1e-3:g} mm"
            raise MitsimError(f"camera {sensor_path}: {error}; {fits}") from None
    # Only now, with all else checked: the renderer takes a second to import.
    loaded = _load(variant, path, defines, needs_projector=not for_render, outside=allow_outside_files)
    row_um = (sensor.row_pitch_um or sensor.pixel_pitch_um) * sensor.binning
    of_rows, of_columns = zip((row_um, sensor.superpixel_pitch_um), loaded.camera.geometry.pitches, strict=True)
    for name, (um, stated) in (("pixel_pitch", of_columns), ("row_pitch", of_rows)):
        if not for_render and abs(um * 1e-3 - stated) > _PITCH_TOLERANCE * stated:
            raise MitsimError(
                f"camera {sensor_path}: its binned {name.replace('_', ' ')} is {um:g} um, but {scene} has "
                f"{stated * 1e3:g} um; use the camera of that scene, or change {name}, or binning"
            )
    _wear(loaded, mask, sensor_path)
    _tune(loaded, light)
    rig = Rig(loaded.camera.geometry, sensor, light, str(sensor_path))
    return Apparatus(loaded, rig, variant, defines)


def reopened(bench: Opened, variant: str) -> Opened:
    """The ``bench`` loaded anew into a ``variant``, which is set from then on. MitsimError as
    :func:`mitsim.api.bench.open_bench`."""
    from mitsim.devices.mask_profile import load_mask

    camera = Path(bench.rig.camera_file)
    loaded = _load(variant, bench.loaded.path, bench.defines, outside=True)
    _wear(loaded, load_mask(camera), camera)
    _tune(loaded, bench.projector)
    return replace(bench, loaded=loaded, variant=variant)


def _wear(loaded: LoadedScene, mask: MaskProfile | None, camera: Path) -> None:
    """Put a ``mask`` of the file of a ``camera``, where it has one, before the sensor of a ``loaded`` scene."""
    if mask is not None:
        loaded.camera.wear(mask.worn(loaded.camera.geometry, camera.parent))


def _tune(loaded: LoadedScene, projector: ProjectorModel) -> None:
    """Give glass of a ``loaded`` scene the one wavelength of a ``projector`` that is not told apart by line."""
    if loaded.parting:
        from mitsim.transport.plugins.glass import tune

        tune(loaded.scene, projector.effective_wavelength_nm)


def _load(variant: str, path: Path, defines: Mapping[str, str], **options: bool) -> LoadedScene:
    """A scene in a variant that is set from then on, as :func:`mitsim.scene.load.load_scene` takes it."""
    mitsuba = load_variant(variant)
    from mitsim.scene.load import load_scene
    from mitsim.transport import plugins
    from mitsim.transport.transmission import contacts

    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    plugins.register()
    loaded = load_scene(path, defines, **options)
    of_factored, of_reference = contacts(loaded.scene)
    factored = _refusal_of(loaded, of_factored, "the factored estimator")
    reference = _refusal_of(loaded, of_reference, "the reference")
    if factored is not None and options.get("needs_projector", True):
        raise factored
    unfit = replace(
        loaded.unfit, factored=loaded.unfit.factored or factored, reference=loaded.unfit.reference or reference
    )
    return replace(loaded, unfit=unfit)


def _refusal_of(loaded: LoadedScene, contact: Contact | None, estimator: str) -> MitsimError | None:
    """The refusal of a scene with a ``contact`` by an ``estimator``."""
    if contact is None:
        return None
    got, rule = contact.words(estimator)
    if loaded.shapes:
        return loaded.shapes[contact.shape].refusal("shape", got, rule)
    return MitsimError(f"{loaded.path}: shape {contact.shape}: got {got}; {rule}")


def _text(value: object) -> str:
    """A parameter as a scene spells it."""
    return str(value).lower() if isinstance(value, bool) else str(value)

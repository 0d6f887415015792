"""The session file that repeats a folder which mitsim wrote, from the folder's own files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field

from mitsim.bench.apparatus import check_devices, spelling
from mitsim.bench.request import Request
from mitsim.core.colour_files import COLOUR, IMAGE, KINDS, is_coloured, open_lines, spectral_of
from mitsim.core.configuration import load_model, shipped_path, validate
from mitsim.core.environment import DEFAULT_VARIANT, deciding_versions
from mitsim.core.errors import MitsimError, check_arguments, cut
from mitsim.core.exr import checksum
from mitsim.core.files import plain, read_json, write_text
from mitsim.core.manifests import MANIFEST, CalibrationManifest, RunManifest, read_manifest
from mitsim.devices.projector import ProjectorModel
from mitsim.devices.sensor import load_sensor
from mitsim.devices.session import load_recipe
from mitsim.reconstruct.reconstruct import MADE_OF, read_result
from mitsim.reconstruct.request import METHODS, RESULT_FILE
from mitsim.sessions.session_file import SESSION_FILE, SUMMARY, fields_of, read_session, session_text, value_of


class _Opened(BaseModel):
    """Files in a manifest that opened its bench."""

    camera: str | None = None
    projector: str | None = None
    allow_outside_files: bool = False


class _Scene(BaseModel):
    """The scene in the configuration of a manifest."""

    scene: str
    defines: dict[str, str]
    variant: str
    scene_sha256: str | None = None
    scene_files: dict[str, str] = Field(default_factory=dict)


@dataclass(frozen=True)
class Repeat:
    """The ``text`` of a session file that repeats a folder, and reasons why its results may differ.

    Attributes
    ----------
    text
        Text of the file, with whole paths.
    warnings
        Sentences.
    tables, notes
        Tables of the file, and lines of comment before them.
    """

    text: str
    warnings: tuple[str, ...] = ()
    tables: Mapping[str, Any] = field(default_factory=dict, repr=False)
    notes: tuple[str, ...] = field(default=(), repr=False)

    @check_arguments
    def save(self, path: Path | str) -> Path:
        """Write the session file to ``path``, which is replaced, with paths as seen from there; return the path.

        MitsimError when it cannot be written.
        """
        write_text(path, session_text(self.tables, Path(path).absolute().parent, *self.notes))
        return Path(path)


@check_arguments
def session_of(folder: Path | str) -> Repeat:
    """Return the session file that repeats a folder, with the calibration and the images that belong to its frames.

    Parameters
    ----------
    folder
        Folder of a session, a capture, a calibration, or an image.

    Returns
    -------
    Repeat
        The ``text``; ``warnings`` name files that have changed since, or that the folder does not name.

    Raises
    ------
    MitsimError
        for a folder that holds none of these, and for work that no session file describes: frames of a real camera,
        a bench before a board, a capture by a stored plan, a calibration that is fitted to pictures.
    """
    folder = Path(folder)
    if (folder / SUMMARY).is_file() and (folder / SESSION_FILE).is_file():
        tables = read_session(folder / SESSION_FILE).tables
        return Repeat(session_text(tables), (), tables)
    place, found, coloured = folder.absolute(), _Found(), is_coloured(folder)
    data = read_json(folder / COLOUR) if coloured else {}
    if (folder / RESULT_FILE).is_file() or (isinstance(data, dict) and data.get("kind") == IMAGE):
        found.add_image(place)
    elif coloured or (folder / MANIFEST).is_file():
        manifest_data = read_json(_first(place) / MANIFEST)
        if isinstance(manifest_data, dict) and manifest_data.get("kind") == "calibration":
            found.add_calibration(place)
        else:
            found.add_run(place)
            for path in sorted([*place.iterdir(), *place.parent.iterdir()]):
                if path.is_dir() and _made_of(path).get("run") == str(place):
                    found.add_image(path)
    else:
        raise MitsimError(
            f"{folder}: holds nothing that a session file repeats; give a folder of mitsim run, capture, calibrate or "
            "reconstruct"
        )
    tables = read_session(found.tables).tables  # which refuses values that a damaged folder states
    notes = f"Repeats {place}: mitsim run FILE -o FOLDER", *found.warnings
    return Repeat(session_text(tables, None, *notes), tuple(found.warnings), tables, notes)


@dataclass
class _Found:
    """Tables of a session that were found in folders, and ``warnings`` on changes since.

    ``taken`` has the folders that the tables of capture and calibration were taken from.
    """

    tables: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    taken: dict[str, str] = field(default_factory=dict)

    def warn(self, text: str) -> None:
        if text not in self.warnings:
            self.warnings.append(text)

    def add_scene(self, manifest: RunManifest | CalibrationManifest, folder: Path, coloured: bool) -> None:
        """Add the table of the scene that a ``manifest`` describes; MitsimError if it differs from an earlier one.

        Warn of files that differ from those that it describes.
        """
        conf, where = manifest.configuration, f"{folder}/{MANIFEST}"
        if "scene" not in conf or "defines" not in conf:
            raise MitsimError(f"{folder}: is not of a simulated scene, so no session file makes it anew")
        if "board" in conf:
            raise MitsimError(f"{folder}: is of a bench before a board, which only Python makes")
        if manifest.opened is None:
            self.warn(f"{folder} does not tell its devices' files: the usual ones are taken")
        files, scene = validate(_Opened, dict(manifest.opened or {}), where), validate(_Scene, dict(conf), where)
        if own := scene.defines.keys() & fields_of("scene").keys():
            raise MitsimError(f"{where}: defines.{min(own)} is no parameter of a scene; remove it")
        devices = {name: _short_name(getattr(files, name), "calibration") for name in ("camera", "projector")}
        usual = spectral_of(DEFAULT_VARIANT) if coloured else DEFAULT_VARIANT
        given = {
            "scene": _short_name(scene.scene, "scenes"),
            **devices,
            "variant": None if scene.variant == usual else scene.variant,
            "allow_outside_files": files.allow_outside_files or None,
            **{name: _value(text) for name, text in scene.defines.items()},
        }
        table = {name: value for name, value in given.items() if value is not None}
        if self.tables.setdefault("scene", table) != table:
            raise MitsimError(f"{folder}: is of another scene or of other devices than its frames")
        for name, known in {scene.scene: scene.scene_sha256, **scene.scene_files}.items():
            if not Path(name).is_file():
                self.warn(f"{name} is not there")
            elif checksum(Path(name)) != known:
                self.warn(f"{name} was changed since")
        try:
            camera, projector = check_devices(devices["camera"], devices["projector"])
            sensor, light = load_sensor(camera), load_model(projector, ProjectorModel)
        except MitsimError as error:
            self.warn(str(error))
            return
        shown = {**light.model_dump(mode="json", exclude={"contrast_ratio"}), "black_level": light.black_level}
        if plain(sensor.identity) != conf.get("sensor"):
            self.warn(f"camera {camera} is not the one that the manifest tells")
        if plain(shown) != conf.get("projector_model") and not coloured:
            self.warn(f"projector {projector} is not the one that the manifest tells")
        if (made := conf.get("versions")) != deciding_versions():
            self.warn(f"it was made by {made}, and here is {deciding_versions()}")

    def add_run(self, folder: Path) -> None:
        """Add the request of the frames in a ``folder``."""
        manifest = read_manifest(_first(folder), RunManifest)
        conf = manifest.configuration
        self.add_scene(manifest, folder, is_coloured(folder))
        request = {name: conf[name] for name in Request.model_fields if name in conf}
        if gone := [name for name in ("noise_fraction", "closing_frame", "ambient_shots") if conf.get(name)]:
            self.warn(f"it was made with {' and '.join(gone)}, which are no more")
        if request.pop("seconds", None) is not None:
            request["accuracy"] = (manifest.plan or {}).get("accuracy")
            self.warn("it was planned by seconds: the accuracy is what they bought then")
        always = "patterns", "accuracy", "seed"
        asked = {
            name: value
            for name, value in request.items()
            if name in always or value != Request.model_fields[name].default
        }
        if "plan_seed" in conf:
            raise MitsimError(f"{folder}: was captured by a stored plan, which no session file holds")
        if "light" in conf:
            above = {name: asked[name] for name in (*always, "effects") if name in asked}  # on which light depends
            self.tables["transport"] = {**above, **conf["light"]}
            asked = {name: value for name, value in asked.items() if name not in ("accuracy", "effects")}
        self.tables["capture"] = {**asked, **self.colour_of(folder)}
        self.taken["capture"] = str(folder)

    def colour_of(self, folder: Path) -> dict[str, str]:
        """Return the option ``colour`` of a ``folder``; nothing for light of all lines together."""
        lines = open_lines(folder, *KINDS)
        if lines.colours is None or lines.filters:
            return {"colour": "mosaic"} if lines.filters else {}
        count = len(lines.names)
        _, projector = check_devices(None, self.tables["scene"].get("projector"))
        several = load_model(projector, ProjectorModel).wavelengths_nm or ()
        return {"colour": "lines" if count == len(several) else f"bands:{count}"}

    def add_calibration(self, folder: Path) -> None:
        """Add the request of the calibration in a ``folder``."""
        manifest = read_manifest(_first(folder), CalibrationManifest)
        conf = manifest.configuration
        simulated = {"accuracy", "seed", "recipe"} <= conf.keys() and not {"aged", "depth_mm"} & conf.keys()
        if manifest.modelled or not simulated:
            raise MitsimError(f"{folder}: is not of one simulated session, so no session file makes it anew")
        self.add_scene(manifest, folder, is_coloured(folder))
        own = load_recipe().model_dump(exclude_defaults=True, exclude={"depths"})
        recipe = {} if conf["recipe"] == plain(own) else {"recipe": conf["recipe"]}
        colour = self.colour_of(folder)
        if colour and (capture := self.tables.get("capture")):
            colour = {"colour": capture["colour"]}
        self.tables["calibrate"] = {"seed": conf["seed"], "accuracy": conf["accuracy"], **recipe, **colour}
        self.taken["calibrate"] = str(folder)

    def add_image(self, folder: Path) -> None:
        """Add the request of the image in a ``folder``, of its frames and of its calibration."""
        made_of, first = _made_of(folder), _first(folder)
        if "calibration" not in made_of:
            raise MitsimError(f"{folder}: does not tell the calibration that it is made of")
        stated = read_result(first).get("inputs") if (first / RESULT_FILE).is_file() else {}
        stated = stated if isinstance(stated, dict) else {}
        inputs = {name: value for name, value in stated.items() if name not in made_of}
        if inputs.get("method", METHODS[0]) not in METHODS:
            method = cut(str(inputs["method"]))
            raise MitsimError(f"{folder}: was solved by {method}, a trained network, whose file it does not tell")
        if isinstance(ends := inputs.get("bounds"), list):
            infinite = -math.inf, math.inf
            inputs["bounds"] = [infinite[place % 2] if end is None else end for place, end in enumerate(ends)]
        for name, verb, add in (
            ("run", "capture", self.add_run),
            ("calibration", "calibrate", self.add_calibration),
        ):
            if self.taken.get(verb) == made_of[name]:
                continue
            try:
                if verb in self.taken:
                    raise MitsimError(f"{made_of[name]}: is another than that of the first image")
                add(Path(made_of[name]))
            except MitsimError as error:
                self.warn(f"{error}; it is read where it is")
                inputs[name] = made_of[name]
        images = self.tables.setdefault("reconstruct", [])
        named = {} if folder.name in (each.get("output") for each in images) else {"output": folder.name}
        images.append({**inputs, **named})


def _first(folder: Path) -> Path:
    """Return the folder whose manifest describes a ``folder``: of several lines, that of the first."""
    return next(iter(open_lines(folder, *KINDS).parts.values()))


def _made_of(folder: Path) -> dict[str, str]:
    """Return the folders that the image in a ``folder`` is made of; none for another folder."""
    for name in (RESULT_FILE, COLOUR):
        data = read_json(folder / name) if (folder / name).is_file() else {}
        if isinstance(data, dict) and isinstance(data.get(MADE_OF), dict):
            return {str(key): str(value) for key, value in data[MADE_OF].items()}
    return {}


def _short_name(path: str | None, shelf: str) -> str | None:
    """Return the name of a shipped file at a ``path`` on its ``shelf``; else the path."""
    if path is None:
        return None
    own = Path(path).parent if shelf == "scenes" else Path(path)
    return own.stem if own.parent == shipped_path(shelf) else path


def _value(text: str) -> Any:
    """Return the number or truth that a scene spells as this ``text``; else the text."""
    value = value_of(text)
    return value if isinstance(value, (bool, int, float)) and spelling(value) == text else text

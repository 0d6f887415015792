"""A folder that mitsim wrote in; the session file that repeats it, as its own files tell, out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field

from mitsim.bench.apparatus import check_devices, spelling
from mitsim.bench.request import Request
from mitsim.core.configuration import load_model, shipped_path, validate
from mitsim.core.environment import DEFAULT_VARIANT, deciding_versions
from mitsim.core.errors import MitsimError, check_arguments, cut
from mitsim.core.exr import checksum
from mitsim.core.files import plain, read_json, write_text
from mitsim.core.manifests import (
    COLOUR,
    IMAGE,
    KINDS,
    MANIFEST,
    CalibrationManifest,
    RunManifest,
    is_coloured,
    open_lines,
    read_manifest,
    spectral_of,
)
from mitsim.devices.projector import ProjectorModel
from mitsim.devices.sensor import load_sensor
from mitsim.devices.session import load_recipe
from mitsim.reconstruct.reconstruct import MADE_OF, read_result
from mitsim.reconstruct.request import METHODS, RESULT_FILE
from mitsim.sessions.session_file import SESSION_FILE, SUMMARY, fields_of, read_session, session_text, value_of
from mitsim.studies.framework.campaign import read_scope

_PLANNED = "patterns", "accuracy", "seed", "effects"
"""Fields of a request that light hangs on."""


class _Opened(BaseModel):
    """How a manifest names the files that opened its bench."""

    camera: str | None = None
    projector: str | None = None
    allow_outside_files: bool = False


class _Scene(BaseModel):
    """What the configuration in a manifest states of the scene."""

    scene: str
    defines: dict[str, str]
    variant: str
    scene_sha256: str | None = None
    scene_files: dict[str, str] = Field(default_factory=dict)


@dataclass(frozen=True)
class Repeat:
    """What repeats a folder: the ``text`` of a session file, and why it may come to something else.

    Attributes
    ----------
    text
        with whole paths.
    warnings
        sentences.
    tables, notes
        of the file, and lines of comment before them.
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
        of a session, a capture, a calibration, an image, the demo, or a study of many points.

    Returns
    -------
    Repeat
        its ``text``; ``warnings`` say which of its files are others now, or are not told.

    Raises
    ------
    MitsimError
        for a folder that holds none of these, and for what no session file tells: frames of a real camera, a bench
        before a board, a calibration that is fitted to pictures.
    """
    folder = Path(folder)
    if (folder / SUMMARY).is_file() and (folder / SESSION_FILE).is_file():
        tables = read_session(folder / SESSION_FILE).tables
        return Repeat(session_text(tables), (), tables)
    found = _Found(folder.absolute())
    data = read_json(folder / COLOUR) if is_coloured(folder) else {}
    if (folder / "demo.json").is_file():
        found.demo()
    elif (folder / RESULT_FILE).is_file() or (isinstance(data, dict) and data.get("kind") == IMAGE):
        found.image(folder.absolute())
    elif (folder / MANIFEST).is_file() or is_coloured(folder):
        found.run_or_calibration()
    else:
        found.study()
    tables = read_session(found.tables).tables  # which refuses values that a damaged folder states
    notes = f"Repeats {folder.absolute()}: mitsim run FILE -o FOLDER", *found.warnings
    return Repeat(session_text(tables, None, *notes), tuple(found.warnings), tables, notes)


@dataclass
class _Found:
    """Tables of a session, found in a ``folder``; ``warnings`` on what is not as it was; and the folders that the
    tables of capture and calibration were ``taken`` from."""

    folder: Path
    tables: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    taken: dict[str, str] = field(default_factory=dict)

    def run_or_calibration(self) -> None:
        data = read_json(self._first(self.folder) / MANIFEST)
        if isinstance(data, dict) and data.get("kind") == "calibration":
            self.calibration(self.folder)
            return
        self.run(self.folder)
        for image in self._images():
            self.image(image)

    def _images(self) -> Iterator[Path]:
        """Iterate over folders of images of the folder's frames, in the folder and next to it."""
        for path in sorted([*self.folder.iterdir(), *self.folder.parent.iterdir()]):
            made_of = _made_of(path) if path.is_dir() else {}
            if made_of.get("run") == str(self.folder):
                yield path

    def _first(self, folder: Path) -> Path:
        """Return the folder whose manifest describes a ``folder``: of several lines, that of the first."""
        return next(iter(open_lines(folder, *KINDS).parts.values()))

    def _scene(self, conf: Mapping[str, Any], opened: Mapping[str, Any] | None, folder: Path, coloured: bool) -> None:
        """Add the table of the scene that a manifest's ``conf`` describes; raise MitsimError if another scene is there
        already."""
        if "scene" not in conf or "defines" not in conf:
            raise MitsimError(f"{folder}: is not of a simulated scene, so no session file makes it anew")
        if "board" in conf:
            raise MitsimError(f"{folder}: is of a bench before a board, which only Python makes")
        if opened is None:
            self._warn(f"{folder} does not tell its devices' files: the usual ones are taken")
        where = f"{folder}/{MANIFEST}"
        files, scene = validate(_Opened, dict(opened or {}), where), validate(_Scene, dict(conf), where)
        if own := scene.defines.keys() & fields_of("scene").keys():
            raise MitsimError(f"{where}: defines.{min(own)} is no parameter of a scene; remove it")
        devices = {name: _short_name(getattr(files, name), "calibration") for name in ("camera", "projector")}
        usual = spectral_of(DEFAULT_VARIANT) if coloured else DEFAULT_VARIANT
        table = {
            "scene": _short_name(scene.scene, "scenes"),
            **{name: value for name, value in devices.items() if value is not None},
            **({} if scene.variant == usual else {"variant": scene.variant}),
            **({"allow_outside_files": True} if files.allow_outside_files else {}),
            **{name: _value(text) for name, text in scene.defines.items()},
        }
        if self.tables.setdefault("scene", table) != table:
            raise MitsimError(f"{folder}: is of another scene or of other devices than its frames")
        self._compare(conf, {scene.scene: scene.scene_sha256, **scene.scene_files}, devices, coloured)

    def _compare(
        self, conf: Mapping[str, Any], sums: Mapping[str, str | None], devices: Mapping[str, str | None], coloured: bool
    ) -> None:
        """Warn of files that differ from those that a manifest's ``conf`` and its ``sums`` describe."""
        for name, known in sums.items():
            if not Path(name).is_file():
                self._warn(f"{name} is not there")
            elif checksum(Path(name)) != known:
                self._warn(f"{name} was changed since")
        try:
            camera, projector = check_devices(devices["camera"], devices["projector"])
            sensor, light = load_sensor(camera), load_model(projector, ProjectorModel)
        except MitsimError as error:
            self._warn(str(error))
            return
        if plain(sensor.identity) != conf.get("sensor"):
            self._warn(f"camera {camera} is not the one that the manifest tells")
        own = {**light.model_dump(mode="json", exclude={"contrast_ratio"}), "black_level": light.black_level}
        if plain(own) != conf.get("projector_model") and not coloured:
            self._warn(f"projector {projector} is not the one that the manifest tells")
        if (made := conf.get("versions")) != deciding_versions():
            self._warn(f"it was made by {made}, and here is {deciding_versions()}")

    def _warn(self, text: str) -> None:
        if text not in self.warnings:
            self.warnings.append(text)

    def run(self, folder: Path) -> None:
        """Add the request of the frames in a ``folder``."""
        manifest = read_manifest(self._first(folder), RunManifest)
        conf, coloured = manifest.configuration, is_coloured(folder)
        self._scene(conf, manifest.opened, folder, coloured)
        request = {name: conf[name] for name in Request.model_fields if name in conf}
        if request.pop("seconds", None) is not None:
            request["accuracy"] = (manifest.plan or {}).get("accuracy")
            self._warn("it was planned by seconds: the accuracy is what they bought then")
        asked = {
            name: value for name, value in request.items()
            if name in ("patterns", "accuracy", "seed") or value != Request.model_fields[name].default
        }  # fmt: skip
        above = {name: asked[name] for name in _PLANNED if name in asked}
        if "light" in conf:
            self.tables["transport"] = {**above, **conf["light"]}
        elif "plan_seed" in conf:
            self.tables["plan"] = {**above, "seed": conf["plan_seed"]}
        if {"light", "plan_seed"} & conf.keys():
            asked = {name: value for name, value in asked.items() if name not in ("accuracy", "effects")}
        self.tables["capture"] = {**asked, **self._colour(folder)}
        self.taken["capture"] = str(folder)

    def _colour(self, folder: Path) -> dict[str, str]:
        """Return the word of the colours of a ``folder``; nothing if none are told apart."""
        lines = open_lines(folder, *KINDS)
        if lines.colours is None or lines.filters:
            return {"colour": "mosaic"} if lines.filters else {}
        count = len(lines.names)
        _, projector = check_devices(None, self.tables["scene"].get("projector"))
        several = load_model(projector, ProjectorModel).wavelengths_nm or ()
        return {"colour": "lines" if count == len(several) else f"bands:{count}"}

    def calibration(self, folder: Path) -> None:
        """Add the request of the calibration in a ``folder``."""
        manifest = read_manifest(self._first(folder), CalibrationManifest)
        conf = manifest.configuration
        if (
            manifest.modelled
            or "aged" in conf
            or "depth_mm" in conf
            or not {"accuracy", "seed", "recipe"} <= conf.keys()
        ):
            raise MitsimError(f"{folder}: is not of one simulated session, so no session file makes it anew")
        self._scene(conf, manifest.opened, folder, is_coloured(folder))
        own = load_recipe().model_dump(exclude_defaults=True, exclude={"depths"})
        recipe = {} if conf["recipe"] == plain(own) else {"recipe": conf["recipe"]}
        colour = self._colour(folder)
        if colour and (capture := self.tables.get("capture")):
            colour = {"colour": capture["colour"]}
        self.tables["calibrate"] = {"seed": conf["seed"], "accuracy": conf["accuracy"], **recipe, **colour}
        self.taken["calibrate"] = str(folder)

    def image(self, folder: Path) -> None:
        """Add the request of the image in a ``folder``, of its frames and of its calibration."""
        made_of = _made_of(folder)
        if "calibration" not in made_of:
            raise MitsimError(f"{folder}: does not tell the calibration that it is made of")
        first = self._first(folder)
        stated = read_result(first).get("inputs") if (first / RESULT_FILE).is_file() else {}
        inputs = {
            name: value for name, value in (stated if isinstance(stated, dict) else {}).items() if name not in made_of
        }
        if inputs.get("method", METHODS[0]) not in METHODS:
            raise MitsimError(
                f"{folder}: was solved by {cut(str(inputs['method']))}, a trained network, whose file it does not tell"
            )
        if isinstance(ends := inputs.get("bounds"), list):
            inputs["bounds"] = [
                end if end is not None else (-1) ** (place + 1) * math.inf for place, end in enumerate(ends)
            ]
        for name, verb, take in (("run", "capture", self.run), ("calibration", "calibrate", self.calibration)):
            if self.taken.get(verb) == made_of[name]:
                continue
            try:
                if verb in self.taken:
                    raise MitsimError(f"{made_of[name]}: is another than that of the first image")
                take(Path(made_of[name]))
            except MitsimError as error:
                self._warn(f"{error}; it is read where it is")
                inputs[name] = made_of[name]
        images = self.tables.setdefault("reconstruct", [])
        named = {} if folder.name in (each.get("output") for each in images) else {"output": folder.name}
        images.append({**inputs, **named})

    def demo(self) -> None:
        manifest = read_manifest(self.folder / "run", RunManifest)
        conf = manifest.configuration
        self._scene(conf, manifest.opened, self.folder, False)
        self.tables["demo"] = {name: conf[name] for name in ("patterns", "accuracy", "seed")}

    def study(self) -> None:
        name, scope = read_scope(self.folder)
        setup = scope.setup
        given = {
            "scene": None if any(scope.pictures) else _short_name(setup.scene, "scenes"),
            "patterns": scope.patterns if name in ("sweep", "drift") else None,
            "seed": scope.seeds[0],
            "quick": scope.quick or None,
            "camera": setup.camera,
            "projector": setup.projector,
            "variant": None if setup.variant == DEFAULT_VARIANT else setup.variant,
            "allow_outside_files": setup.outside or None,
            "recipe": scope.recipe,
            "parameters": dict(setup.parameters) or None,
            "measure": ",".join(scope.measures) or None,
            "over": {knob: [*values] for knob, values in scope.sweep} or None,
        }
        table = {"name": name, **{key: value for key, value in given.items() if value is not None}}
        self.tables["study"] = [table]


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
    place = Path(path)
    own = place.parent if shelf == "scenes" else place
    return own.stem if own.parent == shipped_path(shelf) else path


def _value(text: str) -> Any:
    """Return the number or truth that a scene spells as this ``text``; else the text."""
    value = value_of(text)
    return value if isinstance(value, (bool, int, float)) and spelling(value) == text else text

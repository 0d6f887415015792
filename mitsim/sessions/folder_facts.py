"""`mitsim show`: kind, origin, main numbers and next commands of a folder, from its JSON files alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from mitsim.core import colour_files
from mitsim.core.errors import MitsimError, check_arguments, cut
from mitsim.core.files import PAGE, read_json
from mitsim.core.manifests import MANIFEST, CalibrationManifest, RunManifest, kind_of, read_manifest
from mitsim.reconstruct.request import RESULT_FILE

_KINDS = {"capture": "run", "depths": "calibration", "characterise": "characterised camera"}
"""Words for kinds that their files call otherwise."""
_IMAGE, _MORE = "mitsim reconstruct {} --calibration {}", ("mitsim report {0}", "mitsim run --from {0} -o again.toml")
_NEXT: Mapping[str, tuple[str, ...]] = {
    "run": (_IMAGE.format("{0}", "CAL"), *_MORE),
    "calibration": (_IMAGE.format("RUN", "{0}"), *_MORE),
    "image": ("mitsim compare {0} OTHER -o compared", *_MORE),
    "pairs": ("mitsim train unrolled {0} -o model.pt",),
    "session": ("mitsim run {0}/session.toml -o again",),
    "design": ("mitsim capture SCENE --camera {0}/design/camera.toml -o run", "mitsim design {0}/goal.toml -o again"),
}
"""Commands that take a folder, by the last word of its kind."""
_NUMBERS = """scene=configuration.scene scene=scene camera=camera.sensor.name camera=camera patterns=patterns.family
projector=camera.projector.name patterns=patterns frames=patterns.captures frames=frames lines=channels pairs=count
exposure_s=digital.exposure_s error_at_most=total_error_bound monte_carlo_error=mc_error verdict=verdict study=study
factor_error=result.phi_error separability_residual=result.separability_residual psnr_db=psnr ssim=ssim claims=claims
delta_e=delta_e uncertainty=uncertainty chi_square=misfit.chi_square method=inputs.method lambda=lambda points=points
missing=missing steps=steps masks=candidates run=made_of.run calibration=made_of.calibration"""
"""Main numbers as LABEL=KEY, with dotted keys of the JSON files of all kinds; a file has some of them."""
_UNITS = {"exposure_s": "exposure [s]", "psnr_db": "PSNR [dB]", "ssim": "SSIM"}
_OF_PARTS = "depths", colour_files.RUN, colour_files.CALIBRATION
"""Kinds whose numbers are those of the folders in them."""
_MODELS: Mapping[str, Any] = {"capture": RunManifest, "calibration": CalibrationManifest}


@dataclass(frozen=True)
class FolderFacts:
    """Facts on a folder of results.

    Attributes
    ----------
    folder, kind, finished
        Path, kind in words such as ``run``, and False if the work was interrupted.
    command, version, date
        Command line (None if it is not stated) and version of mitsim that made the folder, and date of its file.
    numbers
        Main numbers by name.
    warnings, next
        Reasons why the folder is flagged, and commands that take the folder.
    """

    folder: str
    kind: str
    finished: bool
    command: str | None
    version: str
    date: str
    numbers: Mapping[str, Any]
    warnings: tuple[str, ...]
    next: tuple[str, ...]

    def lines(self) -> list[str]:
        """Return the lines of `mitsim show`, of which the first one is a summary."""
        state = f"{self.kind}, {'' if self.finished else 'not '}finished{', flagged' if self.warnings else ''}"
        known = {_UNITS.get(name, name.replace("_", " ")): value for name, value in self.numbers.items()}
        by = self.command or "Python, or not stated"
        found: dict[str, Any] = {"made by": by, "version": self.version, "date": self.date, **known}
        texts = [
            f"{name}: {value:.4g}" if isinstance(value, float) else f"{name}: {value}" for name, value in found.items()
        ]
        return [f"{self.folder}: {state}", *texts, *(f"next: {command}" for command in self.next)]

    def __repr__(self) -> str:
        return "; ".join(self.lines())


@check_arguments
def show(folder: Path | str) -> FolderFacts:
    """Return the kind of a folder, its origin, its main numbers, its warnings and the next commands.

    Only the folder's JSON files are read.

    Parameters
    ----------
    folder
        Folder of any command: run, calibration, image, study, session, pairs, demo, design or characterised camera.

    Raises
    ------
    MitsimError
        for a folder that is not one of mitsim's, or whose JSON file is damaged.

    Examples
    --------
    >>> import mitsim as ms
    >>> facts = ms.show("run")
    >>> facts.kind, facts.numbers["frames"], facts.next[0]
    ('run', 6, 'mitsim reconstruct run --calibration CAL')
    """
    folder = Path(folder)
    path, kind, data = _described(folder)
    name, finished = _KINDS.get(kind, kind.replace("-", " ")), data.get("status") != "incomplete"
    try:
        if finished and kind in _MODELS:
            read_manifest(folder, _MODELS[kind])
        each = ((label, _shown(data, key)) for label, key in (pair.split("=") for pair in _NUMBERS.split()))
        numbers = {label: value for label, value in each if value is not None}
        versions = _at(data, "versions") or _at(data, "configuration.versions") or {}
        command, version = data.get("command"), versions.get("mitsim", "not stated")
        warnings = [str(text) for text in data.get("warnings") or ()]
        steps = data["steps"] if kind == "session" else ()
        warnings += [f"{step['output']}: {text}" for step in steps for text in step["warnings"]]
    except (AttributeError, KeyError, TypeError) as error:
        raise MitsimError(f"file {path}: is not that of a {name}; write or copy it again") from error
    for part in [show(each) for each in sorted(folder.iterdir()) if kind in _OF_PARTS and (each / MANIFEST).is_file()]:
        numbers[Path(part.folder).name] = ", ".join(line for line in part.lines() if "error" in line or "resid" in line)
        warnings += [f"{Path(part.folder).name}: {text}" for text in part.warnings]
        command, version, finished = command or part.command, part.version, finished and part.finished
    if not finished:
        warnings.append("the work was interrupted; give its command again, with --resume if it has that option")
    nexts = [f"open {folder / PAGE}"] * (folder / PAGE).is_file()
    repeats = kind == "image" or "scene" in numbers  # no session file repeats frames of a real camera
    own = (each for each in _NEXT.get(name.split()[-1], ()) if finished and (repeats or "--from" not in each))
    nexts += [each.format(folder) for each in own]
    date = f"{datetime.fromtimestamp(path.stat().st_mtime):%Y-%m-%d %H:%M}"
    return FolderFacts(str(folder), name, finished, command, version, date, numbers, tuple(warnings), tuple(nexts))


def _described(folder: Path) -> tuple[Path, str, dict[str, Any]]:
    if not folder.is_dir():
        raise MitsimError(f"{folder}: {'is a file' if folder.exists() else 'no such folder'}; give a folder of results")
    first = [folder / name for name in (colour_files.COLOUR, MANIFEST, RESULT_FILE) if (folder / name).is_file()]
    for path in [*first, *sorted(folder.glob("*.json"))]:
        data = read_json(path)
        kind = "image" if path.name == RESULT_FILE else kind_of(data)
        if isinstance(data, dict) and (kind in ("image", *_MODELS, *colour_files.KINDS) or kind == path.stem):
            return path, "study" if "study" in data else kind, data
    depths = [each for each in sorted(folder.glob(f"*/{MANIFEST}")) if each.parent.name.replace(".", "").isdigit()]
    if depths:
        return depths[0], "depths", {}
    raise MitsimError(f"{folder}: holds no results of mitsim; give a folder that one of its commands made")


def _at(data: Any, key: str) -> Any:
    for part in key.split("."):
        data = data.get(part) if isinstance(data, Mapping) else None
    return data


def _shown(data: Any, key: str) -> Any:
    """Return a number or text; of a list its length, with the verdicts, folders or names of its members."""
    value = _at(data, key)
    if isinstance(value, list):
        names = [str(each[name]) for each in value for name in ("verdict", "output", "name") if name in each]
        return f"{len(value)} ({cut(', '.join(names), 100)})" if names else len(value)
    return cut(value, 100) if isinstance(value, str) else value if isinstance(value, (int, float)) else None

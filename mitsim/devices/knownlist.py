"""Captures of known pictures that a camera is calibrated by: a list in; which run shows which picture, checked, out.

Paths in a list begin in its own folder.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import FailFast, Field, model_validator

from mitsim.core.configuration import Configuration, read_table, validate
from mitsim.core.errors import MitsimError
from mitsim.core.files import check_plain
from mitsim.core.imagelist import Preparation
from mitsim.core.manifests import MOSAIC, RUN, ColourManifest, RunManifest, open_lines, read_manifest

MOST_CAPTURES = 4096
"""Of a list: more than a day of taking them."""
MOST_TERMS = 4
"""Codes of a side: a normal matrix of that many times their numbers is inverted."""
Colour = Literal["red", "green", "blue"]
Orientation = Literal["upright", "mirrored", "upside down", "turned"]
"""How a picture lies as the camera's code runs; turned is both others."""
Scale = Annotated[float, Field(ge=1e-3, le=1e3, allow_inf_nan=False)]


class KnownCapture(Configuration):
    """One capture of a known picture."""

    run: Annotated[str, Field(min_length=1)]
    """RUN folder, or coloured folder of one, a path from the list's folder."""
    picture: Annotated[str, Field(min_length=1)]
    """File of what was before the camera, of as many pixels as the run's patterns: PNG, TIFF, NPY or OpenEXR, a path
    from the list's folder."""
    colour: Colour | None = None
    """Plane of a colour picture that this run shows; none: the picture is grey, or the run has planes of its own."""


class KnownList(Configuration):
    """Captures of known pictures, and what is known of their camera."""

    centre: bool = False
    """Frames lose row and column means (FlatCam masks)."""
    gamma: Annotated[float, Field(ge=0.1, le=10, allow_inf_nan=False)] = 1.0
    """Power of a picture's numbers that its light goes with; 2.2 of most screens, 1 of images by a calibration."""
    orientation: Orientation | None = None
    """How pictures lie as the camera sees them; none: it is found."""
    scale: Annotated[tuple[Scale, Scale], Field(strict=False)] | None = None
    """Sensor pixels that a scene pixel shifts the mask's shadow by, of rows and columns; none: they are found."""
    terms: int | None = Field(default=None, ge=1, le=MOST_TERMS)
    """Codes of a side: 1, all directions are alike; more, the code changes smoothly over the scene; none: by frames
    that are held out."""
    board_reflectance: float | None = Field(default=None, gt=0, le=1)
    """Reflectance that counts as 1 in pictures and images; none: unknown."""
    known: Annotated[tuple[KnownCapture, ...], FailFast()] = Field(strict=False, min_length=1, max_length=MOST_CAPTURES)
    """The captures."""

    @model_validator(mode="after")
    def _each_once(self) -> KnownList:
        runs = [(each.run, each.colour) for each in self.known]
        twice = next((run for run in runs if runs.count(run) > 1), None)
        if twice is not None:
            raise ValueError(f"known: the run {twice[0]!r} is there twice; name each once")
        return self


@dataclass(frozen=True, eq=False)
class KnownCaptures:
    """A list whose runs and pictures are there.

    Attributes
    ----------
    path
        of the list.
    listed
        what it says.
    lines
        planes that every run has, in folders of their own; None: each is a single RUN folder.
    manifests
        of the first run, by the names of its lines; "" where there are none.
    """

    path: Path
    listed: KnownList
    lines: ColourManifest | None
    manifests: dict[str, RunManifest]

    def run(self, capture: KnownCapture, line: str = "") -> Path:
        """RUN folder of a ``capture``, of a ``line`` of it."""
        return self.path.parent / capture.run / line

    def picture(self, capture: KnownCapture) -> Path:
        """File of a ``capture``'s picture."""
        return self.path.parent / capture.picture


def load_known(path: Path | str) -> KnownCaptures:
    """The list in the file ``path``, TOML or JSON.

    MitsimError for a list that breaks a rule, and for runs or pictures that are missing, unfinished, of several
    cameras, or of other lines than the first.
    """
    path = Path(path)
    if path.is_dir():
        raise MitsimError(f"list {path}: is a folder; give the TOML or JSON file in it that names runs and pictures")
    data = read_table(path, "list")
    listed = validate(KnownList, data, f"list {path}")
    found = KnownCaptures(path, listed, None, {})
    for number, capture in enumerate(listed.known):
        lines, manifests = _run_of(found.run(capture))
        check_plain(found.picture(capture), "picture")
        if capture.colour is not None and lines is not None:
            raise MitsimError(
                f"list {path}: {capture.run} has planes of its own, so its colour is known; leave colour "
                f"{capture.colour!r} out"
            )
        if number == 0:
            found = KnownCaptures(path, listed, lines, manifests)
        _check_alike(found, capture, manifests)
    return found


def preparation_of(manifest: RunManifest, place: Path | str) -> Preparation:
    """What an import did to files before they were the frames of a ``manifest`` at a ``place``; of other runs nothing.
    MitsimError where the manifest says what no import does."""
    return validate(Preparation, manifest.configuration.get("prepare") or {}, f"{place}: a run's configuration.prepare")


_PLACING = "mosaic", "orientation", "turn_deg", "turn_about", "crop"
"""Of a preparation, what moves pixels: frames of two such are of two cameras."""


def _run_of(folder: Path) -> tuple[ColourManifest | None, dict[str, RunManifest]]:
    lines = open_lines(folder, RUN, MOSAIC)
    if lines.filters:
        raise MitsimError(
            f"{folder}: is behind colour filters, all in one frame; import its planes, or calibrate --colour mosaic"
        )
    return lines.colours, {name: read_manifest(part, RunManifest) for name, part in lines.parts.items()}


def _check_alike(found: KnownCaptures, capture: KnownCapture, manifests: dict[str, RunManifest]) -> None:
    """MitsimError where a ``capture`` is of other lines, another camera or other scene pixels than the first."""
    first = found.listed.known[0].run
    if [*manifests] != [*found.manifests]:
        names = [", ".join(name for name in each if name) or "no" for each in (manifests, found.manifests)]
        raise MitsimError(
            f"list {found.path}: {capture.run} has {names[0]} planes, but {first} has {names[1]}; give runs of one kind"
        )
    for name, manifest in manifests.items():
        ours = found.manifests[name]
        if manifest.camera != ours.camera:
            raise MitsimError(
                f"list {found.path}: {capture.run} is of another camera than {first}; calibrate each by its own"
            )
        how, first_how = (preparation_of(each, found.path) for each in (manifest, ours))
        unlike = next((field for field in _PLACING if getattr(how, field) != getattr(first_how, field)), None)
        if unlike is not None:
            raise MitsimError(
                f"list {found.path}: {capture.run} was imported with another {unlike} than {first}, so its pixels see "
                "other parts of the mask; import both alike"
            )
        sides, own = ([len(rows) for rows in (each.patterns.P_L, each.patterns.P_R)] for each in (manifest, ours))
        if sides != own:
            raise MitsimError(
                f"list {found.path}: {capture.run} has {sides[0]} x {sides[1]} scene pixels, but {first} "
                f"{own[0]} x {own[1]}; give runs of one size"
            )

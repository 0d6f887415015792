"""Lists that a user writes about files of a real camera: its session, flat frames, known pictures, a chart.

A list of frames is `session.toml` or `session.json` in their folder. Without named frames, the order of their names
counts. Paths of a list of known pictures begin in its own folder.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, FailFast, Field, field_validator, model_validator

from mitsim.core import colour_files, manifests, picture_files
from mitsim.core.configuration import Configuration, Positive, locate, read_table, validate
from mitsim.core.errors import MitsimError, cut, near_name
from mitsim.core.files import check_plain, read_json
from mitsim.core.manifests import MOST_PIXELS, MOST_SHOTS, Digital, FileName, Plain
from mitsim.core.picture_files import Preparation, Wanted
from mitsim.devices.patterns import stripe_count
from mitsim.devices.sensor import SensorModel
from mitsim.devices.session import MOST_REPEATS, MOST_RUNGS, UNIFORM, Exposures, Half, Merge, Side, halves_in_order

if TYPE_CHECKING:  # numpy takes 0.1 s to import, and a refusal needs none of it
    from mitsim.core.arrays import FloatArray
    from mitsim.core.images import Numbers, Preparer

LISTS = ("session.toml", "session.json")
"""Names of a list of frames."""
DARK = "dark"
"""Beginning of the names of dark frames where no list names them."""


def read_list(folder: Path, fields: str) -> tuple[Path, dict[str, Any]]:
    """Return path and contents of the list in a ``folder``; raise MitsimError for none or two."""
    lists = [folder / name for name in LISTS if (folder / name).is_file()]
    if len(lists) != 1:
        found = "holds both" if lists else "holds neither" if folder.is_dir() else "no such folder, nor"
        names = (" and " if lists else " nor ").join(LISTS)
        raise _refusal(folder, f"{found} {names}; give one, with {fields}")
    return lists[0], read_table(lists[0], "frames")


def _refusal(folder: Path, text: str) -> MitsimError:
    return MitsimError(f"frames {folder}: {text}")


def _check_files(folder: Path, names: Iterable[str]) -> None:
    seen = set[str]()
    for name in names:
        if name in seen:
            raise _refusal(folder, f"{name} is listed twice; give each frame its own file")
        seen.add(name)
        if not (folder / name).is_file():
            near = near_name(name, [path.name for path in folder.iterdir()])
            raise _refusal(folder, f"{name} is listed, but no file of that name is there; {near}copy it there")


# -------- A calibration session

Key = tuple[Side, int, int, int, int]
"""Side, number of the pattern, sign, number of the exposure and repeat of a frame."""


class StripeFile(Configuration):
    """One frame of a session: the +1 or -1 half of a stripe pattern, or the uniform frame of a side."""

    file: FileName
    """Name of the frame in the folder, without a path."""
    side: Side
    """Stripes along rows, H[:, index] 1^T, or along columns, 1 H[:, index]^T."""
    index: int = Field(ge=0, lt=2 * MOST_PIXELS)
    """Column of H; 0 of a uniform frame."""
    sign: int = Field(ge=-1, le=1)
    """Half (1 + P)/2 or (1 - P)/2 of a pattern P; 0: uniform frame."""
    repeat: int = Field(default=0, ge=0, lt=MOST_REPEATS)
    """Which one of `repeats`."""
    exposure: int = Field(default=0, ge=0, lt=MOST_RUNGS)
    """Which one of `exposure_ladder`."""
    exposure_s: Positive | None = None
    """Its exposure [s]; none: as in `digital`, times that of `exposure_ladder`."""


class DarkFile(Configuration):
    """One frame with the projector off."""

    file: FileName
    """Name of the frame in the folder, without a path."""
    exposure: int = Field(default=0, ge=0, lt=MOST_RUNGS)
    """Which one of `exposure_ladder`."""
    exposure_s: Positive | None = None
    """Its exposure [s]; none: as for other frames."""


Identity = Annotated[Plain, BeforeValidator(lambda camera: {"name": camera} if isinstance(camera, str) else camera)]
"""A camera: a name, or anything as a run's manifest has it."""


class FrameList(Configuration):
    """Frames of a real session, and how they are read."""

    camera: Identity
    """Identity that a run must share: a name, or anything as a run's manifest has it."""
    n: int = Field(ge=1, le=MOST_PIXELS)
    """Projector pixels a side."""
    signed_capture: Literal["pair", "uniform"]
    """How a +-1 pattern was captured."""
    repeats: int = Field(default=1, ge=1, le=MOST_REPEATS)
    """Frames of each half, whose mean is taken."""
    exposure_ladder: Exposures = (1.0,)
    """Exposures of every frame, over the shortest, which `digital` states."""
    ladder_merge: Merge = "weighted"
    """How they make one: by variance, or the longest alone."""
    digital: Digital
    """How digital numbers become electrons a second, as in a run's manifest."""
    centre: bool = False
    """Frames lose row and column means (FlatCam masks)."""
    board_reflectance: float | None = Field(default=None, gt=0, le=1)
    """Reflectance of the board that counts as 1 in the image; none: unknown."""
    parallax: manifests.Parallax | None = None
    """How the factors move with depth; none: not known, and no `--focus`."""
    raw: picture_files.Raw | None = None
    """How frames without a header are read; none: there are none."""
    prepare: Preparation = Preparation()
    """Table: what is done to the files' numbers before they are frames."""
    frames: Annotated[tuple[StripeFile, ...], FailFast()] = Field(default=(), strict=False, max_length=MOST_SHOTS)
    """Every frame; none: by the order of their names."""
    dark: Annotated[tuple[DarkFile, ...], FailFast()] = Field(default=(), strict=False, max_length=MOST_SHOTS)
    """Frames with the projector off."""

    @model_validator(mode="after")
    def _saturation_is_known(self) -> FrameList:
        if len(self.exposure_ladder) > 1 and self.digital.saturation_dn is None:
            raise ValueError("digital.saturation_dn: is not given; an exposure_ladder needs it to find saturation")
        return self


@dataclass(frozen=True, eq=False)
class SessionFrames:
    folder: Path
    listed: FrameList
    shots: dict[Key, StripeFile]
    dark: tuple[DarkFile, ...]
    preparer: Preparer | None = None

    @property
    def wanted(self) -> Wanted:
        return Wanted(raw=self.listed.raw)

    @property
    def planes(self) -> tuple[str, ...]:
        return picture_files.PLANES if self.listed.prepare.channel == picture_files.ALL else ("",)

    def of_plane(self, name: str) -> SessionFrames:
        if not name:
            return self
        prepare = self.listed.prepare.model_copy(update={"channel": name})
        camera = {**self.listed.camera, "channel": name}
        return replace(self, listed=self.listed.model_copy(update={"prepare": prepare, "camera": camera}))

    def with_preparer(self) -> SessionFrames:
        """Return the session with its preparer and the end of its scale.

        Raises MitsimError for frames that cannot be read, and for a list of all planes.
        """
        if self.preparer is not None or self.listed.prepare == Preparation():
            return self
        from mitsim.core.images import Preparer

        if self.listed.prepare.channel == picture_files.ALL:
            raise _refusal(self.folder, "prepare.channel all is of every plane; take one, by `of_plane`")
        preparer = Preparer.of(self.listed.prepare, self.listed.digital, self.wanted, self.folder)
        return replace(self, listed=self.listed.model_copy(update={"digital": preparer.digital}), preparer=preparer)

    def read(self, name: str) -> Numbers:
        from mitsim.core.images import read_image

        values = read_image(self.folder / name, self.wanted)
        return values if self.preparer is None else self.preparer.frame(self.folder / name, values)

    @property
    def pairs(self) -> bool:
        return self.listed.signed_capture == "pair"

    def repeats_of(self, half: Half, exposure: int = 0) -> tuple[StripeFile, ...]:
        return tuple(self.shots[(*half, exposure, repeat)] for repeat in range(self.listed.repeats))

    @cached_property
    def files(self) -> tuple[str, ...]:
        return (*(shot.file for shot in self.shots.values()), *(frame.file for frame in self.dark))

    @cached_property
    def order(self) -> list[Half]:
        keys = [(f.side, f.index, f.sign) for f in self.listed.frames or self.shots.values()]
        return list(dict.fromkeys(keys))

    def frame_name(self, half: Half) -> str:
        files = [shot.file for key, shot in self.shots.items() if key[:3] == half]
        more = f" and {len(files) - 1} more" if len(files) > 1 else ""
        return f"{files[0]}{more} ({_words((*half, 0, 0))})"

    def exposure_s(self, frame: StripeFile | DarkFile) -> float:
        return frame.exposure_s or self.listed.digital.exposure_s * self.listed.exposure_ladder[frame.exposure]


def load_frames(folder: Path | str) -> SessionFrames:
    """Return which file of the ``folder`` shows which pattern.

    Raises MitsimError without a list, for a list that breaks a rule, and for frames that are missing or there twice.
    """
    folder = Path(folder)
    place, data = read_list(folder, "camera, n, signed_capture and digital")
    listed = validate(FrameList, data, f"frames {place}")
    rungs, repeats = len(listed.exposure_ladder), listed.repeats
    wanted: list[Key] = [
        (*half, exposure, repeat)
        for half in halves_in_order(stripe_count(listed.n), listed.signed_capture == "pair")
        for exposure in range(rungs)
        for repeat in range(repeats)
    ]
    frames, dark = listed.frames, listed.dark
    if not frames:
        names = [path.name for path in picture_files.image_files(folder, Wanted(raw=listed.raw))]
        dark = dark or tuple(DarkFile(file=name) for name in names if name.startswith(DARK))
        names = [name for name in names if name not in {frame.file for frame in dark}]
        if len(names) != len(wanted):
            times = (f", repeats {repeats}" if repeats > 1 else "") + (f", {rungs} exposures" if rungs > 1 else "")
            files = (path.name for path in folder.iterdir() if path.is_file())
            others = [cut(name) for name in sorted({*files} - {*names, *LISTS})]
            listing = ", ".join([*others[:3], "..."] if len(others) > 3 else others)
            raise _refusal(
                folder,
                f"holds {len(names)} frames, and n {listed.n}, signed_capture {listed.signed_capture!r}{times} are "
                f"{len(wanted)}, from {wanted[0][0]} to {wanted[-1][0]}; take the others, or name each in {place.name}"
                + (f" (not counted: {listing})" if others else ""),
            )
        frames = tuple(
            StripeFile(file=name, side=side, index=index, sign=sign, exposure=exposure, repeat=repeat)
            for name, (side, index, sign, exposure, repeat) in zip(names, wanted, strict=True)
        )
    shots: dict[Key, StripeFile] = {}
    known = set(wanted)
    for frame in frames:
        key = frame.side, frame.index, frame.sign, frame.exposure, frame.repeat
        if key not in known:
            problem = f"{frame.file} is {_words(key)}, which no such session has; it has {_words(wanted[0])} to"
            raise _refusal(folder, f"{problem} {_words(wanted[-1])}; correct n, signed_capture or the frame's entry")
        if key in shots:
            raise _refusal(folder, f"{_words(key)} is there twice, {shots[key].file} and {frame.file}; leave one out")
        shots[key] = frame
    if missing := [key for key in wanted if key not in shots]:
        raise _refusal(folder, f"{len(missing)} of {len(wanted)} frames are missing, as {_words(missing[0])}; add them")
    session = SessionFrames(folder, listed, {key: shots[key] for key in wanted}, dark)
    _check_files(folder, session.files)
    every: tuple[StripeFile | DarkFile, ...] = (*session.shots.values(), *session.dark)
    for each in every:
        if each.exposure >= rungs:
            raise _refusal(folder, f"{each.file} is of exposure {each.exposure}; exposure_ladder has 0 to {rungs - 1}")
        if rungs > 1 and each.exposure_s is not None:
            raise _refusal(folder, f"{each.file} states exposure_s beside exposure_ladder; give the number `exposure`")
    for (side, index, sign, exposure, repeat), shot in session.shots.items():
        other = session.shots[side, index, sign if repeat or not session.pairs else -sign, exposure, 0]
        seconds, expected = session.exposure_s(shot), session.exposure_s(other)
        if seconds != expected:
            problem = f"{shot.file} and {other.file} are {'repeats' if repeat else 'halves'} of one pattern"
            raise _refusal(folder, f"{problem}, exposed for {seconds:g} and {expected:g} s; expose them alike")
    exposures = {session.exposure_s(shot) for shot in session.shots.values()}
    without = exposures - {session.exposure_s(frame) for frame in session.dark}
    if session.dark and without and not session.pairs:
        raise _refusal(folder, f"no dark frame is exposed for {min(without):g} s, as others are; take one, or none")
    return session


def _words(key: Key) -> str:
    side, index, sign, exposure, repeat = key
    words = f"the uniform frame of {side} stripes" if sign == UNIFORM else f"{side} stripes {index} of sign {sign:+d}"
    words += f", exposure {exposure}" if exposure else ""
    return f"{words}, repeat {repeat}" if repeat else words


# -------- Frames that characterise a camera

_MOST_SETS, _MOST_FRAMES = 4096, 10_000


def capacity_of(sensor: SensorModel) -> float:
    """Return the electrons that saturate a pixel: full well or end of the ADC; MitsimError without either."""
    full = sensor.superpixel_full_well_e
    if sensor.largest_dn is not None:
        full = min(full, (sensor.largest_dn - sensor.superpixel_black_level_dn) / sensor.gain_dn_per_e)
    if not math.isfinite(full):
        raise MitsimError(f"camera {sensor.name!r}: no light saturates it; give full_well_e or bits")
    return full


class DarkSet(Configuration):
    """Frames that were taken alike, without light."""

    files: Annotated[tuple[FileName, ...], FailFast()] = Field(strict=False, max_length=_MOST_FRAMES)
    """Names of the frames in the folder, without a path: two, or more."""
    exposure_s: Positive
    """Exposure of each [s]."""


class LitSet(DarkSet):
    """Frames that were taken alike, under even light."""

    light: Positive = 1.0
    """Power of the lamp, over that which `photons_per_s` states."""


class FlatList(Configuration):
    """Frames of a camera, and how they are read."""

    name: str = Field(min_length=1, max_length=200)
    """What the camera is called."""
    pixel_pitch_um: float = Field(ge=1e-3, le=1e4)
    """Distance between centres of the frames' pixels, um."""
    bits: int | None = Field(default=None, ge=1, le=24)
    """Bits of a number; none: real numbers."""
    photons_per_s: Positive | None = None
    """Photons that fall on a pixel in a second under a `light` of 1; none: not known, and no quantum efficiency."""
    source: str = Field(default="measured by mitsim characterise", max_length=1000)
    """Which specimen, gain setting and temperature: goes into the camera's file."""
    raw: picture_files.Raw | None = None
    """How frames without a header are read; none: there are none."""
    lit: Annotated[tuple[LitSet, ...], FailFast()] = Field(strict=False, max_length=_MOST_SETS)
    """Sets under even light."""
    dark: Annotated[tuple[DarkSet, ...], FailFast()] = Field(strict=False, max_length=_MOST_SETS)
    """Sets in the dark, one for each exposure under light."""


@dataclass(frozen=True)
class FlatFrames:
    folder: Path
    listed: FlatList

    @property
    def wanted(self) -> Wanted:
        return Wanted(raw=self.listed.raw)

    @property
    def sets(self) -> tuple[DarkSet, ...]:
        return (*self.listed.lit, *self.listed.dark)


def load_flats(folder: Path | str) -> FlatFrames:
    """Return the files of the ``folder`` with their meaning.

    Raises MitsimError without a list, for a list that breaks a rule, for frames that are missing or without a partner,
    and for an exposure under light without one in the dark.
    """
    folder = Path(folder)
    place, data = read_list(folder, "name, pixel_pitch_um, bits, and sets lit and dark of files and exposure_s")
    flats = FlatFrames(folder, validate(FlatList, data, f"frames {place}"))
    for kind, sets in (("lit", flats.listed.lit), ("dark", flats.listed.dark)):
        if not sets:
            raise _refusal(folder, f"no set is {kind}; give pairs of frames under even light, and in the dark")
        for number, each in enumerate(sets):
            if len(each.files) < 2:
                held = each.files[0] if each.files else "no frame"
                problem = f"{kind}.{number} holds {held} alone, of {each.exposure_s:g} s; one frame cannot show noise"
                raise _refusal(folder, f"{problem}; add its partner, taken alike")
    _check_files(folder, (name for each in flats.sets for name in each.files))
    exposures = {each.exposure_s for each in flats.listed.dark}
    for number, each in enumerate(flats.listed.lit):
        if each.exposure_s not in exposures:
            problem = f"lit.{number} ({each.files[0]}) is exposed for {each.exposure_s:g} s, and no dark set is"
            raise _refusal(folder, f"{problem}; add a dark pair of that exposure")
    return flats


# -------- Captures of known pictures that a camera is calibrated by

MOST_CAPTURES = 4096
MOST_TERMS = 4
"""Most codes of a side, because a normal matrix grows with them."""
Orientation = Literal["upright", "mirrored", "upside down", "turned"]
"""How a picture lies as the camera's code runs; turned is both others."""
Scale = Annotated[float, Field(ge=1e-3, le=1e3, allow_inf_nan=False)]
_PLACING = "mosaic", "orientation", "turn_deg", "turn_about", "crop"


class KnownCapture(Configuration):
    """One capture of a known picture."""

    run: Annotated[str, Field(min_length=1)]
    """RUN folder, or coloured folder of one, a path from the list's folder."""
    picture: Annotated[str, Field(min_length=1)]
    """File of what was before the camera, of as many pixels as the run's patterns: PNG, TIFF, NPY or OpenEXR, a path
    from the list's folder."""


class KnownList(Configuration):
    """Captures of known pictures, and known properties of their camera."""

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
        runs = [each.run for each in self.known]
        twice = next((run for run in runs if runs.count(run) > 1), None)
        if twice is not None:
            raise ValueError(f"known: the run {twice!r} is there twice; name each once")
        return self


@dataclass(frozen=True, eq=False)
class KnownCaptures:
    """A list whose runs and pictures exist, and manifests of the first run by line (``lines``; None without them)."""

    path: Path
    listed: KnownList
    lines: colour_files.ColourManifest | None
    manifests: dict[str, manifests.RunManifest]

    def run(self, capture: KnownCapture, line: str = "") -> Path:
        return self.path.parent / capture.run / line

    def picture(self, capture: KnownCapture) -> Path:
        return self.path.parent / capture.picture


def load_known(path: Path | str) -> KnownCaptures:
    """Return the list in the file ``path``, TOML or JSON.

    Raises MitsimError for a list that breaks a rule, and for runs or pictures that are missing, unfinished, of several
    cameras, or of other lines than the first.
    """
    path = Path(path)
    if path.is_dir():
        raise MitsimError(f"list {path}: is a folder; give the TOML or JSON file in it that names runs and pictures")
    listed = validate(KnownList, read_table(path, "list"), f"list {path}")
    found = KnownCaptures(path, listed, None, {})
    for number, capture in enumerate(listed.known):
        folder = found.run(capture)
        lines = colour_files.open_lines(folder, colour_files.RUN, colour_files.MOSAIC)
        if lines.filters:
            raise MitsimError(f"{folder}: is behind colour filters; import its planes, or calibrate --colour mosaic")
        planes = {name: manifests.read_manifest(part, manifests.RunManifest) for name, part in lines.parts.items()}
        check_plain(found.picture(capture), "picture")
        if number == 0:
            found = KnownCaptures(path, listed, lines.colours, planes)
        if [*planes] != [*found.manifests]:
            names = [", ".join(name for name in each if name) or "no" for each in (planes, found.manifests)]
            problem = f"list {path}: {capture.run} has {names[0]} planes, but {listed.known[0].run} has {names[1]}"
            raise MitsimError(f"{problem}; give runs of one kind")
        for name, manifest in planes.items():
            ours, run, first = found.manifests[name], f"list {path}: {capture.run}", listed.known[0].run
            if manifest.camera != ours.camera:
                raise MitsimError(f"{run} is of another camera than {first}; calibrate each by its own")
            how, first_how = (preparation_of(each, path) for each in (manifest, ours))
            unlike = next((field for field in _PLACING if getattr(how, field) != getattr(first_how, field)), None)
            if unlike is not None:
                raise MitsimError(f"{run} was imported with another {unlike} than {first}; import both alike")
            sides, own = ([len(rows) for rows in (each.patterns.P_L, each.patterns.P_R)] for each in (manifest, ours))
            if sides != own:
                pixels = f"{sides[0]} x {sides[1]} scene pixels, but {first} {own[0]} x {own[1]}"
                raise MitsimError(f"{run} has {pixels}; give runs of one size")
    return found


def preparation_of(manifest: manifests.RunManifest, place: Path | str) -> Preparation:
    """Return the preparation that an import applied before the frames of a ``manifest``; empty for other runs.

    Raises MitsimError if the manifest states another one.
    """
    return validate(Preparation, manifest.configuration.get("prepare") or {}, f"{place}: a run's configuration.prepare")


# -------- Places of a colour chart's patches in an image

PATCHES = 24
"""Patches of a ColorChecker."""
Edge = Annotated[int, Field(ge=0, le=1 << 14)]
Box = Annotated[tuple[Edge, ...], Field(strict=False, min_length=4, max_length=4)]
"""First row, row after the last, first column, column after the last [projector pixels]."""


class ChartPlace(Configuration):
    """The patches of a chart in an image."""

    spectra: Literal["ColorChecker N Ohta"]
    """Measured spectra of the patches, in colour-science."""
    patches: Annotated[tuple[Box, ...], Field(strict=False, min_length=PATCHES, max_length=PATCHES)]
    """For each patch, row by row: [first row, end, first column, end] inside it [image pixels]."""

    @field_validator("patches")
    @classmethod
    def _not_empty(cls, patches: tuple[Box, ...]) -> tuple[Box, ...]:
        for number, (top, bottom, left, right) in enumerate(patches):
            if not (top < bottom and left < right):
                raise ValueError(f"patch {number} is [{top}, {bottom}, {left}, {right}]; ends must lie beyond firsts")
        return patches

    def means(self, image: FloatArray) -> FloatArray:
        import numpy as np

        return np.array([block.mean(axis=(0, 1)) for block in self.blocks(image)])

    def blocks(self, image: FloatArray) -> list[FloatArray]:
        rows, columns = image.shape[:2]
        outside = next((box for box in self.patches if box[1] > rows or box[3] > columns), None)
        if outside is not None:
            problem = f"chart: a patch is {list(outside)}, but the image has {rows} x {columns} pixels"
            raise MitsimError(f"{problem}; give the chart's place in this image")
        return [image[top:bottom, left:right] for top, bottom, left, right in self.patches]


def load_chart(name: Path | str) -> ChartPlace:
    """Return the chart of a shipped scene or a JSON file; MitsimError when it cannot be read."""
    path = locate(name, "scenes", "chart.json")
    return validate(ChartPlace, read_json(path), f"file {path}")

"""What the frames of a real calibration session show: a folder with its list in; which file shows what, checked, out.

The list is `session.toml` or `session.json`. Without a list of frames in it the folder's frames count in the order of
their names.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, FailFast, Field, model_validator

from mitsim.core.configuration import Configuration, Positive, Table, read_table, validate
from mitsim.core.errors import MitsimError, cut, near_name
from mitsim.core.imagelist import ALL, PLANES, Preparation, Raw, Wanted, image_files
from mitsim.core.manifests import MOST_PIXELS, MOST_SHOTS, Digital, FileName, Parallax, Plain
from mitsim.devices.patterns import stripe_count
from mitsim.devices.session import MOST_REPEATS, MOST_RUNGS, UNIFORM, Exposures, Half, Merge, Side, halves_in_order

if TYPE_CHECKING:  # numpy takes 0.1 s to import, and a refusal needs none of it
    from mitsim.core.images import Numbers
    from mitsim.core.prepare import Preparer

LISTS = ("session.toml", "session.json")
"""Names of the list."""
DARK = "dark"
"""What names of dark frames begin with, where no list names them."""
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


def _with_name(camera: Any) -> Any:
    return {"name": camera} if isinstance(camera, str) else camera


Identity = Annotated[Plain, BeforeValidator(_with_name)]
"""Of a camera: a name, or anything as a run's manifest has it."""


class FrameList(Configuration):
    """What a real session's frames are of, and how they are read."""

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
    parallax: Parallax | None = None
    """How the factors move with depth; none: not known, and no `--focus`."""
    raw: Raw | None = None
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
            raise ValueError(
                "digital.saturation_dn: is not given; an exposure_ladder needs it, to leave out what is saturated"
            )
        return self


@dataclass(frozen=True, eq=False)
class SessionFrames:
    """A real session's frames, every one of them there once.

    Attributes
    ----------
    folder
        that holds them.
    listed
        what its list says.
    shots
        frame by side, number of the pattern, sign and repeat.
    dark
        frames with the projector off.
    preparer
        makes frames of the files' numbers; None: nothing is done to them.
    """

    folder: Path
    listed: FrameList
    shots: dict[Key, StripeFile]
    dark: tuple[DarkFile, ...]
    preparer: Preparer | None = None

    @property
    def wanted(self) -> Wanted:
        """How its frames are read."""
        return Wanted.of(self.listed.raw, self.listed.prepare)

    @property
    def planes(self) -> tuple[str, ...]:
        """Planes of a mosaic that its frames are of, where each is calibrated; "" alone where they are of one."""
        return PLANES if self.listed.prepare.channel == ALL else ("",)

    def of_plane(self, name: str) -> SessionFrames:
        """The same of the one of the :attr:`planes` called ``name``, which its camera's identity then has."""
        if not name:
            return self
        prepare = self.listed.prepare.model_copy(update={"channel": name})
        camera = {**self.listed.camera, "channel": name}
        return replace(self, listed=self.listed.model_copy(update={"prepare": prepare, "camera": camera}))

    def with_preparer(self) -> SessionFrames:
        """The same with what makes frames of the files' numbers, and the end of its scale; MitsimError for dark and
        flat frames that cannot be read, and where the list is of all planes."""
        if self.preparer is not None or self.listed.prepare == Preparation():
            return self
        from mitsim.core.prepare import Preparer

        if self.listed.prepare.channel == ALL:
            raise MitsimError(f"frames {self.folder}: prepare.channel all is of every plane; take one, by `of_plane`")
        preparer = Preparer.of(self.listed.prepare, self.listed.digital, self.wanted, self.folder)
        return replace(self, listed=self.listed.model_copy(update={"digital": preparer.digital}), preparer=preparer)

    def read(self, name: str) -> Numbers:
        """The frame in the file called ``name``, (rows, columns)."""
        from mitsim.core.images import read_image

        values = read_image(self.folder / name, self.wanted)
        return values if self.preparer is None else self.preparer.frame(self.folder / name, values)

    @property
    def pairs(self) -> bool:
        """Whether a +-1 pattern is the difference of two frames, and not taken from one and a uniform one."""
        return self.listed.signed_capture == "pair"

    def repeats_of(self, half: Half, exposure: int = 0) -> tuple[StripeFile, ...]:
        """All repeats of one ``half`` of a pattern, at one ``exposure`` of the ladder."""
        return tuple(self.shots[(*half, exposure, repeat)] for repeat in range(self.listed.repeats))

    @cached_property
    def files(self) -> tuple[str, ...]:
        """Names of all frames, dark ones last."""
        return (*(shot.file for shot in self.shots.values()), *(frame.file for frame in self.dark))

    @cached_property
    def order(self) -> list[Half]:
        """What the frames show, as they were taken: in the order of the list."""
        keys = [(f.side, f.index, f.sign) for f in self.listed.frames or self.shots.values()]
        return list(dict.fromkeys(keys))

    def frame_name(self, half: Half) -> str:
        """Names of the files that show a ``half`` of a pattern, and which it is."""
        files = [shot.file for key, shot in self.shots.items() if key[:3] == half]
        side, index, sign, *_ = half
        more = f" and {len(files) - 1} more" if len(files) > 1 else ""
        return f"{files[0]}{more} ({_words((side, index, sign, 0, 0))})"

    def exposure_s(self, frame: StripeFile | DarkFile) -> float:
        """Exposure of a ``frame`` [s]."""
        return frame.exposure_s or self.listed.digital.exposure_s * self.listed.exposure_ladder[frame.exposure]


def read_list(folder: Path, fields: str) -> tuple[Path, Table]:
    """The list in a ``folder``, and what it says; MitsimError, which names its ``fields``, unless there is one."""
    lists = [folder / name for name in LISTS if (folder / name).is_file()]
    if len(lists) != 1:
        found = "holds both" if lists else "holds neither" if folder.is_dir() else "no such folder, nor"
        names = (" and " if lists else " nor ").join(LISTS)
        raise MitsimError(f"frames {folder}: {found} {names}; give one, with {fields}")
    return lists[0], read_table(lists[0], "frames")


def load_frames(folder: Path | str) -> SessionFrames:
    """Which file of the ``folder`` shows what.

    MitsimError for a folder without a list, a list that breaks a rule, and for frames that are missing or there twice.
    """
    folder = Path(folder)
    place, data = read_list(folder, "camera, n, signed_capture and digital")
    listed = validate(FrameList, data, f"frames {place}")
    wanted = [*_keys_of_session(listed)]
    if listed.frames:
        frames, dark = listed.frames, listed.dark
    else:
        names = [path.name for path in image_files(folder, Wanted(raw=listed.raw))]
        dark = listed.dark or tuple(DarkFile(file=name) for name in names if name.startswith(DARK))
        names = [name for name in names if name not in {frame.file for frame in dark}]
        if len(names) != len(wanted):
            raise MitsimError(
                f"frames {folder}: holds {len(names)} frames, and n {listed.n}, signed_capture "
                f"{listed.signed_capture!r}{_times(listed)} are {len(wanted)}, from {wanted[0][0]} to {wanted[-1][0]}; "
                f"take the others, or name each in {place.name}{_not_counted(folder, names)}"
            )
        frames = tuple(
            StripeFile(file=name, side=side, index=index, sign=sign, exposure=exposure, repeat=repeat)
            for name, (side, index, sign, exposure, repeat) in zip(names, wanted, strict=True)
        )
    shots = _each_once(folder, frames, wanted)
    session = SessionFrames(folder, listed, {key: shots[key] for key in wanted}, dark)
    _check_files(session)
    return session


def _not_counted(folder: Path, names: Sequence[str]) -> str:
    """Which files of the ``folder`` are none of the frames called ``names``, in words: nothing where all are."""
    known = {*names, *LISTS}
    others = sorted(path.name for path in folder.iterdir() if path.is_file() and path.name not in known)
    return f" (not counted: {', '.join(map(cut, others[:3]))}{', ...' if others[3:] else ''})" if others else ""


def _keys_of_session(listed: FrameList) -> Iterator[Key]:
    """Frames of a session in the order in which they are listed."""
    for half in halves_in_order(stripe_count(listed.n), listed.signed_capture == "pair"):
        for exposure in range(len(listed.exposure_ladder)):
            for repeat in range(listed.repeats):
                yield *half, exposure, repeat


def _times(listed: FrameList) -> str:
    times = f", repeats {listed.repeats}" if listed.repeats > 1 else ""
    return times + (f", {len(listed.exposure_ladder)} exposures" if len(listed.exposure_ladder) > 1 else "")


def _each_once(folder: Path, frames: Sequence[StripeFile], wanted: Sequence[Key]) -> dict[Key, StripeFile]:
    """Frames by what they show; MitsimError for one that is wanted and missing, there twice, or not wanted."""
    shots: dict[Key, StripeFile] = {}
    known = set(wanted)
    for frame in frames:
        key = frame.side, frame.index, frame.sign, frame.exposure, frame.repeat
        if key not in known:
            raise MitsimError(
                f"frames {folder}: {frame.file} is {_words(key)}, which no such session has; it has "
                f"{_words(wanted[0])} to {_words(wanted[-1])}; correct n, signed_capture or the frame's entry"
            )
        if key in shots:
            raise MitsimError(
                f"frames {folder}: {_words(key)} is there twice, {shots[key].file} and {frame.file}; leave one out"
            )
        shots[key] = frame
    missing = [key for key in wanted if key not in shots]
    if missing:
        raise MitsimError(
            f"frames {folder}: {len(missing)} of {len(wanted)} frames are missing, first {_words(missing[0])}; take "
            "them, and name them in the list"
        )
    return shots


def _check_files(session: SessionFrames) -> None:
    """Every file is in the folder, and shows one thing; halves of a pair are exposed alike, dark frames as the others;
    MitsimError otherwise."""
    folder, seen = session.folder, set[str]()
    for name in session.files:
        if name in seen:
            raise MitsimError(f"frames {folder}: {name} is listed twice; give each frame its own file")
        seen.add(name)
        if not (folder / name).is_file():
            near = near_name(name, [path.name for path in folder.iterdir()])
            raise MitsimError(
                f"frames {folder}: {name} is listed, but no file of that name is there; {near}copy it there"
            )
    exposures = {session.exposure_s(shot) for shot in session.shots.values()}
    _check_ladder(session)
    for (side, index, sign, exposure, repeat), shot in session.shots.items():
        other = session.shots[side, index, sign if repeat or not session.pairs else -sign, exposure, 0]
        if session.exposure_s(shot) != session.exposure_s(other):
            raise MitsimError(
                f"frames {folder}: {shot.file} and {other.file} are {'repeats' if repeat else 'halves'} of one "
                f"pattern, exposed for {session.exposure_s(shot):g} and {session.exposure_s(other):g} s; expose them "
                "alike"
            )
    if session.pairs:
        return
    if session.dark and (without := exposures - {session.exposure_s(frame) for frame in session.dark}):
        raise MitsimError(
            f"frames {folder}: no dark frame is exposed for {min(without):g} s, as other frames are; take one for each "
            "exposure, or none"
        )


def _check_ladder(session: SessionFrames) -> None:
    """Frames of several exposures state their numbers, and no seconds; MitsimError otherwise."""
    rungs = len(session.listed.exposure_ladder)
    frames: tuple[StripeFile | DarkFile, ...] = (*session.shots.values(), *session.dark)
    for frame in frames:
        if frame.exposure >= rungs:
            raise MitsimError(
                f"frames {session.folder}: {frame.file} is of exposure {frame.exposure}, but exposure_ladder has "
                f"{rungs}; give 0 to {rungs - 1}"
            )
        if rungs > 1 and frame.exposure_s is not None:
            raise MitsimError(
                f"frames {session.folder}: {frame.file} states exposure_s, and exposure_ladder as well; leave it out, "
                "and give the number `exposure`"
            )


def _words(key: Key) -> str:
    side, index, sign, exposure, repeat = key
    words = f"the uniform frame of {side} stripes" if sign == UNIFORM else f"{side} stripes {index} of sign {sign:+d}"
    words += f", exposure {exposure}" if exposure else ""
    return f"{words}, repeat {repeat}" if repeat else words

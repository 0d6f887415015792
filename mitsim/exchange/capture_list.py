"""Facts about a real camera's frames, from a list or the command line; checked before any frame is opened."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from mitsim.core import colour_files, configuration, manifests, picture_files
from mitsim.core.colour_files import ColourManifest
from mitsim.core.configuration import Configuration, FilePath, Options, Positive, option, validate
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.files import check_plain
from mitsim.core.manifests import MOST_PIXELS, CalibrationManifest, ClosingKind, Digital
from mitsim.core.picture_files import CORRECTIONS, Crop, PixelFormat, Preparation, Raw, Wanted, image_files
from mitsim.devices.framelist import Identity
from mitsim.devices.patterns import is_own, read_name, takes_seed
from mitsim.devices.sensor import check_exposure, digital_of, load_sensor

_OTHERS = {
    "full_well_e": "a camera's file; give it to --camera, and the list of a capture to --list",
    "signed_capture": "the list of a calibration's frames; `mitsim calibrate --frames` reads it, in their folder",
}
"""Kinds of files that are no capture list, by a field that each of them has."""
TURNED = "turn_deg"
"""Field of a calibration's configuration with the angle by which its frames are turned."""


class CaptureList(Configuration):
    """Facts of a real capture, and preparation of its files.

    Options of `mitsim import` replace them.
    """

    camera: Identity | None = None
    """Identity that a calibration must share: a name, or any value as in a run's manifest; none: by --camera or
    --calibration."""
    digital: Digital | None = None
    """Conversion of digital numbers to electrons a second, as in a run's manifest; none: by --camera and --exposure."""
    bits: int | None = Field(default=None, ge=1, le=32)
    """Bits of the camera's whole numbers; none: real numbers, or as in the camera file."""
    patterns: str | None = None
    """Name of the family; or a path from the list's folder: own patterns, or patterns.json of `mitsim export --format
    png`."""
    n: int | None = Field(default=None, ge=1, le=MOST_PIXELS)
    """Scene pixels a side, without a calibration."""
    seed: int = Field(default=0, ge=0, lt=2**64)
    """Seed of patterns of a `random` family."""
    ambient: str | None = None
    """Frame with the projector off, or a folder of such frames; a path from the list's folder."""
    ambient_shots: int | None = Field(default=None, ge=1)
    """Number of shots averaged in a single ambient frame."""
    closing_frame: ClosingKind | None = None
    """`first` or `uniform`: the last frame checks lamp, camera and scene, and shows the first shot again, or all
    projector pixels lit; none: no such frame."""
    closing_exposure_s: Positive | None = None
    """Exposure of the closing frame [s]; none: that of all frames."""
    order: str | None = None
    """Order in which the shots were taken, such as `column-major`; none: row-major, of signed ones + before -."""
    raw: Raw | None = None
    """Layout of files without a header; none: there are no such files."""
    centre: bool | None = None
    """True if calibrations of these frames remove row and column means (FlatCam masks); none: as the calibration
    states."""
    prepare: Preparation = Preparation()
    """Table: preparation of the files' numbers."""
    source: str | None = None
    """Source of these facts."""

    @model_validator(mode="after")
    def _is_whole(self) -> CaptureList:
        if self.digital is not None and self.camera is None:
            raise ValueError("digital is of a camera; give camera, its name, too")
        if self.bits is not None and self.digital is None:
            raise ValueError("bits are of digital's numbers; give digital too, or leave both to --camera")
        if self.ambient_shots is not None and self.ambient is None:
            raise ValueError("ambient_shots are of an ambient frame; give ambient too")
        if self.closing_exposure_s is not None and self.closing_frame is None:
            raise ValueError("closing_exposure_s is of a closing frame; give closing_frame too")
        return self


def names_file(patterns: str) -> bool:
    return patterns.endswith(".json") or is_own(patterns)


def load_capture_list(name: Path | str) -> CaptureList:
    path = configuration.locate(name, "calibration", ".toml", configuration.LIST)
    data = configuration.read_table(path, "list")
    for name_of_field, kind in _OTHERS.items():
        if name_of_field in data:
            raise MitsimError(f"list {path}: is {kind}")
    listed = validate(CaptureList, data, f"list {path}")

    def from_folder(holder: Configuration, *names: str) -> dict[str, str]:
        return {name: str(path.parent / each) for name in names if (each := getattr(holder, name)) is not None}

    prepare = listed.prepare.model_copy(update=from_folder(listed.prepare, *CORRECTIONS))
    in_file = ("patterns",) if listed.patterns is not None and names_file(listed.patterns) else ()
    return listed.model_copy(update={"prepare": prepare, **from_folder(listed, "ambient", *in_file)})


@dataclass(frozen=True)
class Electronics:
    name: str
    identity: dict[str, Any]
    digital: Digital
    largest: int | None
    stated: dict[str, Any]


@dataclass(frozen=True)
class RealCapture:
    """Facts about a real capture; None: as ``listed`` states.

    ``calibration`` is a CAL folder of the same camera, coloured for all planes, which states identity and projector
    pixels. The files are ``rgb`` if their pixels have three numbers, of which each is a line. Frames of a ``point``
    source have no patterns.
    """

    listed: CaptureList
    camera: str | None = None
    exposure_s: float | None = None
    calibration: Path | None = None
    black_level_dn: float | None = None
    rgb: bool = False
    point: bool = False

    @property
    def patterns(self) -> str:
        """Return the name of the family, or the file of patterns; ArgumentError if none is stated."""
        self.check_facts()
        assert self.listed.patterns is not None
        return self.listed.patterns

    def check_facts(self) -> None:
        """Raise ArgumentError that names all facts that neither options nor the list state."""
        listed, named = self.listed, self.camera is None and self.listed.camera is not None
        known = {
            "patterns": listed.patterns is not None or self.point,
            "camera": self.camera is not None or (named and listed.digital is not None),
            "exposure": self.exposure_s is not None or (named and listed.digital is not None),
        }
        if missing := [name for name, stated in known.items() if not stated]:
            others = "".join(f", nor is {name}" for name in missing[1:])
            raise ArgumentError(missing[0], f"is not given{others}; frames do not state this, so give it, or a list")

    @property
    def wanted(self) -> Wanted:
        return Wanted(raw=self.listed.raw, colour=True)

    @property
    def colours(self) -> ColourManifest | None:
        """Return all planes as lines of a coloured folder; None for a single plane, or a picture without mosaic."""
        prepare = self.listed.prepare
        if prepare.channel != picture_files.ALL and not self.rgb:
            return None
        names = picture_files.RGB if self.rgb else picture_files.PLANES
        return colour_files.lines_of_planes(colour_files.RUN, prepare.wavelengths_nm, names)

    def of_file(self, path: Path, size: tuple[int, ...]) -> RealCapture:
        """Return the capture with ``rgb`` as the ``size`` of a file says; MitsimError if options do not fit that."""
        if len(size) == 2:
            return self
        if size[2] != len(picture_files.RGB):
            raise MitsimError(f"{path}: has {size[2]} numbers a pixel; save red, green and blue alone")
        if (channel := self.listed.prepare.channel) is not None:
            raise ArgumentError("channel", f"{channel}: {path} is in colour and no mosaic; leave it out")
        known = replace(self, rgb=True)
        known.check(path)
        return known

    def electronics(self) -> tuple[Electronics, Preparation]:
        """Return camera and preparation with its mosaic; MitsimError if neither file nor list has them."""
        self.check_facts()
        listed = self.listed
        prepare = listed.prepare
        if self.camera is not None:
            assert self.exposure_s is not None
            sensor = load_sensor(configuration.locate(self.camera, "calibration", ".toml", configuration.CAMERA))
            digital, name, largest = digital_of(sensor, check_exposure(self.exposure_s)), sensor.name, sensor.largest_dn
            if prepare.mosaic is None and prepare.channel is not None and sensor.mosaic is not None:
                prepare = prepare.model_copy(update={"mosaic": sensor.mosaic})
            identity = {"name": name}
            stated = {"sensor": sensor.model_dump(mode="json", exclude={"full_well_e"})}
        else:
            assert listed.digital is not None and listed.camera is not None
            seconds = check_exposure(self.exposure_s or listed.digital.exposure_s)
            digital, identity = listed.digital.model_copy(update={"exposure_s": seconds}), dict(listed.camera)
            name, largest = str(identity.get("name", "named")), None if listed.bits is None else 2**listed.bits - 1
            stated = {"sensor": {"name": name, "digital": listed.digital.model_dump(mode="json"), "bits": listed.bits}}
        if self.black_level_dn is not None:
            changed = {**digital.model_dump(), "black_level_dn": self.black_level_dn}
            digital = validate(Digital, changed, "black_level")
        return Electronics(name, identity, digital, largest, stated), prepare

    def check(self, source: Path) -> None:
        """Raise MitsimError for invalid values, and a ``source`` without frames, before any frame is opened."""
        listed, prepare = self.listed, self.listed.prepare
        if listed.closing_exposure_s is not None:
            check_exposure(listed.closing_exposure_s)
            if prepare.dark is not None:
                said = f"{listed.closing_exposure_s:g}: is of no use beside dark frames of another; leave it out"
                raise ArgumentError("closing_exposure", said)
        self.electronics()
        folder, colours = self.calibration, self.colours
        if folder is None and listed.n is None and not self.point:
            needed = "is not given, and patterns need its projector; give it, or --projector-pixels"
            raise ArgumentError("calibration", needed)
        if folder is not None and colours is not None:
            colour_files.read_colours(folder, colour_files.CALIBRATION)
            colour_files.check_lines(colours, "channel all", folder)
        for part in [] if folder is None else [folder / line for line in (colours.names if colours else ("",))]:
            manifest = manifests.read_manifest(part, CalibrationManifest)
            if listed.centre not in (None, manifest.centre):
                raise MitsimError(
                    f"calibration {part}: its centre is {str(manifest.centre).lower()}, and the list's "
                    f"{str(listed.centre).lower()}: it takes other means off frames; calibrate as the list says"
                )
            turned = manifest.configuration.get(TURNED, prepare.turn_deg)
            if turned != prepare.turn_deg:
                raise MitsimError(
                    f"calibration {part}: is of frames turned by {turned} degrees, not by {prepare.turn_deg:g}; "
                    f"give --turn {turned}"
                )
        if not self.point and self.patterns.endswith(".json"):
            check_plain(self.patterns)
        elif not self.point:
            read_name(self.patterns, listed.n)
        for place in (source, *(getattr(prepare, name) for name in CORRECTIONS)):
            if place is not None:
                image_files(Path(place), self.wanted)


# ---- Options in place of a list ----

_FIELDS = {
    "closing_exposure": "closing_exposure_s", "ambient_frame": "ambient", "projector_pixels": "n",
    "divide": "divide_by", "turn": "turn_deg",
    "dark_frame": "dark", "flat_frame": "flat", "flat_dark_frame": "flat_dark",
}  # fmt: skip
"""Fields of a list, or of its preparation, by the option of another name that replaces each."""
_OWN = {"camera", "bits", "crop"}
"""Options whose fields of the same name have another meaning or form."""
_OF_PATTERNS = (
    "patterns calibration projector_pixels ambient_frame ambient_shots closing_frame closing_exposure order seed"
)
"""Options without effect on frames of a point source."""
LISTS, CAMERAS, PROJECTORS = (
    partial(configuration.shipped_names, field)
    for field in (configuration.LIST, configuration.CAMERA, configuration.PROJECTOR)
)
"""Names of shipped files, for completion."""
said = partial(option, None)


class FrameFacts(Options):
    """Facts about a real camera's frames that replace a list's; None if unknown."""

    VERB = "import_frames"
    PANEL = "A real camera's frames"

    list: FilePath | None = said(
        "list of facts about the capture; other options replace its entries", metavar="NAME|FILE", complete=LISTS
    )
    patterns: str | None = said(
        "patterns that were shown: a family, own patterns, or a file patterns.json", metavar="NAME|FILE"
    )
    camera: FilePath | None = said("camera: shipped name, or TOML file", metavar="NAME|FILE", complete=CAMERAS)
    exposure: float | None = said("exposure time of each frame [s]", metavar="SECONDS")
    calibration: FilePath | None = said("calibration folder of the same camera", metavar="CAL")
    projector_pixels: int | None = said("rows and columns of the patterns, if no calibration is given", metavar="N")
    black_level: float | None = said("digital number of a dark pixel; by default that of the camera")
    ambient_frame: FilePath | None = said("frame, or folder of frames, with the projector off", metavar="PATH")
    ambient_shots: int | None = said("number of shots that were averaged to one ambient frame", metavar="N")
    closing_frame: Literal["first", "uniform"] | None = said(
        "the last frame is a check: it repeats the first pattern, or shows uniform light", metavar="first|uniform"
    )
    closing_exposure: float | None = said("exposure time of the closing frame [s], if it differs", metavar="SECONDS")
    order: str | None = said(
        "order in which the patterns were shown, such as column-major; by default row-major", metavar="NAME"
    )
    shape: str | tuple[int, int] | None = said("frame size, for .raw, .bin and .dat files", metavar="ROWSxCOLUMNS")
    bits: int | None = said("bits of each number in .raw, .bin and .dat files", metavar="N")
    byte_order: str | None = said("byte order of .raw, .bin and .dat files: little or big", metavar="ORDER")
    pixel_format: PixelFormat | None = said(
        "packed format of .raw, .bin and .dat files, in place of bits and byte order",
        metavar="Mono10p|Mono12p|Mono10Packed|Mono12Packed",
    )
    channel: str | None = said("colour plane to use behind colour filters, or all planes", metavar="r|gb|gr|b|all")
    mosaic: str | None = said(
        "colour filters of the first 2 x 2 pixels; by default those of the camera", metavar="RGGB|BGGR|GRBG|GBRG"
    )
    divide: int | None = said("factor that all numbers contain, such as 16; by default it is detected", metavar="N")
    dark_frame: FilePath | None = said("frame, or folder of frames, without any light", metavar="PATH")
    flat_frame: FilePath | None = said("frame, or folder of frames, of uniform light without the mask", metavar="PATH")
    flat_dark_frame: FilePath | None = said("dark frame, or folder, with the flat frame's exposure", metavar="PATH")
    orientation: int | None = said("orientation of the frames, as numbered by Exif", min=1, max=8, metavar="1..8")
    turn: float | None = said("angle to rotate the frames counter-clockwise, after --orientation", metavar="DEGREES")
    crop: str | tuple[int, ...] | None = said(
        "part of the frames to keep, after all rotations", metavar="ROW,COLUMN[,ROWS,COLUMNS]"
    )
    seed: int | None = said("only for random patterns: seed of their random numbers")
    point: bool | None = said(
        "all frames show one point source: stack them to a point spread function, a file .npy for `reconstruct --psf`"
    )

    def of(self, source: Path) -> RealCapture:
        bare = any(
            path.suffix.lower() in picture_files.BARE
            for path in (source, *(source.iterdir() if source.is_dir() else ()))
        )
        if self.shape is None or not bare:
            self.refuse(
                ("shape", "bits", "byte_order", "pixel_format"), "on files that have a header, or without a shape"
            )
        if self.pixel_format is not None:
            self.refuse(("bits", "byte_order"), f"with {self.pixel_format}, which states it")
        listed = CaptureList() if self.list is None else load_capture_list(self.list)
        known, prepare = (
            {name: getattr(each, name) for name in each.model_fields_set} for each in (listed, listed.prepare)
        )
        stated = {_FIELDS.get(name, name): each for name, each in self if each is not None}
        given = {name: str(each) if isinstance(each, Path) else each for name, each in stated.items()}
        same = given.keys() - _OWN
        prepare |= {name: given[name] for name in same & Preparation.model_fields.keys()}
        if self.channel is not None:
            picture_files.check_channel(self.channel)
        if self.crop is not None:
            prepare["crop"] = Crop.of(_text_of(self.crop, ","))
        if self.turn is not None:
            prepare["turn_about"] = "centre"
        if self.ambient_frame is not None:
            known.pop("ambient_shots", None)
        if self.calibration is not None:
            known.pop("n", None)
        if self.shape is not None:
            known["raw"] = Raw.of(_text_of(self.shape, "x"), self.bits, self.byte_order or "little", self.pixel_format)
        known |= {name: given[name] for name in same & CaptureList.model_fields.keys()}
        known["prepare"] = validate(Preparation, prepare, "import")
        calibration = None if self.calibration is None else Path(self.calibration)
        listed = validate(CaptureList, known, "import")
        if self.point:
            self.refuse(_OF_PATTERNS.split(), "on frames of a point source")
        capture = RealCapture(
            listed, given.get("camera"), self.exposure, calibration, self.black_level, point=bool(self.point)
        )
        if not self.point and not takes_seed(capture.patterns):
            self.refuse(("seed",), "on patterns that are not drawn at random")
        capture.check(source)
        return capture


def _text_of(parts: str | tuple[int, ...], sign: str) -> str:
    return parts if isinstance(parts, str) else sign.join(map(str, parts))

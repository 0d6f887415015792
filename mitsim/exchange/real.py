"""Frames of a real camera and what is known of it in; a RUN folder that `mitsim reconstruct` takes out, of all planes
of a mosaic a coloured one.

What a real capture lacks - truth, scene, expected electrons, predicted error - is left out.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from mitsim.core.configuration import validate
from mitsim.core.environment import versions
from mitsim.core.errors import ArgumentError, MitsimError, cut
from mitsim.core.exr import Channel, Channels, Metadata, checksum
from mitsim.core.files import read_json, whole_folder
from mitsim.core.imagelist import CORRECTIONS, Preparation, image_files
from mitsim.core.images import Numbers, image_pages, read_images
from mitsim.core.job import Cost, Limits
from mitsim.core.manifests import AmbientFile, CalibrationManifest, ClosingFile, Patterns, RunHead, RunManifest
from mitsim.core.prepare import LEAST_RESPONSE, CommonFactor, Preparer
from mitsim.core.runs import AMBIENT, CLOSING, frame_name
from mitsim.devices.patterns import PatternFamily, parse_patterns, shot_orders
from mitsim.devices.sensor import PITCH_TOLERANCE
from mitsim.exchange.capture_list import Electronics, RealCapture
from mitsim.exchange.packed import FACTORS, Content, Packed, pack_calibration

_SECONDS_PER_PIXEL = 1e-7
"""Of an import, which reads every frame twice and writes it once: some 30 s for 256 megapixels on a slow disk."""
_MOST_STAMPED = 1e-3
"""Of a picture's numbers, that are not light: of the public DiffuserCam capture two, chosen beyond a line of text."""
LEFT_OUT = ("truth", "scene", "expected electrons", "plan and predicted error")
"""What nobody knows of a real capture."""


def import_capture(source: Path, output: Path, known: RealCapture, command: str | None = None) -> dict[str, Any]:
    """Write the RUN folder of a real capture, of all planes a coloured one, whole or not at all.

    Parameters
    ----------
    source
        folder of frames, in the order of the numbers in their names; or one file.
    output
        RUN folder to make.
    known
        what is known of the capture.
    command
        command line that asks for it, which the manifests keep; None: Python does.

    Returns
    -------
    dict
        `frames`, `shape`, `output`, `calibration_output` (None), `holds`, `left_out`, `divided_by`, `planes`,
        `notes`, `warnings`: what the command line prints.

    Raises
    ------
    MitsimError
        for values that cannot be, frames that are missing, too many, unlike each other or beyond the camera's range, or
        a place that holds something.
    """
    known.check(source)
    files = image_files(source, known.wanted)
    camera, prepare = known.electronics()
    colours = known.colours
    fits = {name: _Fit.of(known, name) for name in (colours.names if colours else ("",))}
    for fit in fits.values():
        fit.check_pixels(camera)
    patterns = {name: _patterns(known, fit.scene) for name, fit in fits.items()}
    shown, order, closing = next(iter(patterns.values())), known.listed.order, known.listed.closing_frame
    orders, count = shot_orders(shown), len(shown.captures)
    if order is not None and order not in orders:
        raise ArgumentError("order", f"{cut(repr(order))}: give {', '.join(orders)}")
    pages = [image_pages(path, known.wanted) for path in files]
    if (held := sum(number for number, _ in pages)) != count + bool(closing):
        last = " and a closing frame" if closing else ""
        hint = " (is the last a closing frame? say so)" if held == count + 1 else ""
        raise MitsimError(
            f"{source}: holds {held} frames, but patterns {known.patterns!r} take {count}{last}, in the order "
            f"(row, column), of signed ones + before -; give all of them and no others{hint}{_many_pages(files, pages)}"
        )
    pixels = sum(number * math.prod(size) for number, size in pages)
    cost = Cost(seconds=pixels * _SECONDS_PER_PIXEL, disk_bytes=pixels * np.dtype(np.uint32).itemsize)
    cost.check(f"import of {count} frames", Limits(), output)
    scan = _Scan(files, known, camera)
    factor, notes, warnings = scan.factor(prepare.divide_by)
    prepare = prepare.model_copy(update={"divide_by": factor})
    scan.check(factor)
    if order is not None:
        scan.places[:count] = [scan.places[frame] for frame in orders[order]]
    runs = {}
    for name, fit in fits.items():
        how = prepare.model_copy(update={"channel": name}) if name else prepare
        run, shape, unlit = _run_of(source, known, camera, how, fit, patterns[name], scan)
        runs[name] = replace(run, manifest=run.manifest.model_copy(update={"command": command}))
        if unlit:
            warnings.append(
                f"flat: {unlit} pixels{f' of {name}' if name else ''} have less than {LEAST_RESPONSE:g} of the mean "
                "response, and are not corrected; leave them out by a crop, or take a flat without a mask"
            )
    if prepare.turn_deg:
        notes.append(
            f"turned by {prepare.turn_deg:g} degrees: noise of neighbouring pixels is no more independent, so an "
            "image's stated uncertainty is rough"
        )
    text = "" if colours is None else json.dumps(colours.model_dump(mode="json"))
    content = Content(runs, colours, text)
    with whole_folder(output) as place:
        content.fill(place)
    return {
        "frames": count * len(runs),
        "shape": [*shape],
        "output": str(output),
        "calibration_output": None,
        "holds": ["run"],
        "left_out": [*LEFT_OUT],
        "divided_by": factor,
        "planes": [name for name in runs if name],
        "notes": notes,
        "warnings": warnings,
    }


def _run_of(
    source: Path,
    known: RealCapture,
    camera: Electronics,
    how: Preparation,
    fit: _Fit,
    patterns: Patterns,
    scan: _Scan,
) -> tuple[Packed[RunManifest], tuple[int, ...], int]:
    """The run of one plane, the size of its frames, and how many pixels are not corrected for want of light.

    Parameters
    ----------
    source, known, camera
        of the capture.
    how
        what is done to its numbers.
    fit, patterns
        of its calibration, and what is shown.
    scan
        of all frames.
    """
    preparer = Preparer.of(how, camera.digital, known.wanted)
    shots = _Shots(known, preparer, fit, scan.places, camera.largest is not None)
    shape = shots.frame(scan.places[0][0], scan.first).shape
    ambient = None if known.ambient is None else _ambient(known, camera, preparer, fit, shape)
    kind, last_s = known.listed.closing_frame, known.listed.closing_exposure_s or camera.digital.exposure_s
    closing = None if kind is None else ClosingFile(kind=kind, file=CLOSING, exposure_s=last_s)
    others = *((AMBIENT,) if ambient else ()), *((CLOSING,) if closing else ())
    names = (*(shot.file for shot in patterns.captures), *others)
    head = RunHead.of(_configuration(known, camera, how, scan.files))
    identity = camera.identity if known.prepare.channel == how.channel else {**camera.identity, "channel": how.channel}
    manifest = RunManifest(
        configuration=head.configuration,
        configuration_sha256=head.configuration_sha256,
        camera=fit.camera or identity,
        digital=preparer.digital,
        patterns=patterns,
        sensor_noise=None,
        ambient_frame=None if ambient is None else AmbientFile(file=AMBIENT, shots=ambient[1]),
        closing_frame=closing,
        order=known.listed.order,
        checksums=dict.fromkeys(names, ""),  # worked out as the files are written
        versions=versions(),
    )
    index = {shot.file: number for number, shot in enumerate(patterns.captures)}

    def read(name: str) -> tuple[Channels, Metadata]:
        if name == CLOSING:
            digital = preparer.digital.model_copy(update={"exposure_s": last_s})  # the dark level depends on it
            last = _Shots(known, replace(preparer, digital=digital), fit, scan.places, camera.largest is not None)
            return {"DN": last.read(len(index))}, {"source": scan.places[-1][0].name, "exposure_s": last_s}
        if name not in index and ambient is not None:
            return {"DN": ambient[0]}, {"shots": ambient[1], "exposure_s": camera.digital.exposure_s}
        shot, (path, _) = patterns.captures[index[name]], scan.places[index[name]]
        about: Metadata = {
            "row": shot.row,
            "column": shot.column,
            "sign": shot.sign,
            "source": path.name,
            "exposure_s": camera.digital.exposure_s,
        }
        return {"DN": shots.read(index[name])}, about

    return Packed(manifest, "", names, read, source), shape, preparer.unlit


def _many_pages(files: tuple[Path, ...], pages: list[tuple[int, tuple[int, int]]]) -> str:
    several = [f"{path.name} has {number}" for path, (number, _) in zip(files, pages, strict=True) if number > 1]
    return f" (each page is a frame: {several[0]})" if several else ""


# ---- What is known of the frames, and their numbers ----


@dataclass(frozen=True)
class _Fit:
    """What a calibration of the same camera tells: its identity, frames' shape and projector pixels."""

    camera: dict[str, Any] | None
    shape: tuple[int, int] | None
    scene: tuple[int, int]

    @classmethod
    def of(cls, known: RealCapture, line: str = "") -> _Fit:
        """Of a ``line`` of the calibration; of the whole one by ""."""
        n = known.listed.n
        if known.calibration is None:
            if n is None:
                raise AssertionError  # refused by RealCapture.check
            return cls(None, None, (n, n))
        calibration: Packed[CalibrationManifest] = pack_calibration(known.calibration / line)
        left, right = (calibration.read(name)[0]["factor"].shape for name in FACTORS)
        if n is not None and (n, n) != (left[1], right[1]):
            raise ArgumentError("projector_pixels", f"{n}: the calibration has {left[1]} x {right[1]}; leave it out")
        return cls(dict(calibration.manifest.camera), (left[0], right[0]), (left[1], right[1]))

    def check_pixels(self, camera: Electronics) -> None:
        """ArgumentError for a ``camera`` whose pixels have another pitch than those of the calibration, where the files
        of both state it: its frames would be taken for frames of the calibration's camera."""
        calibrated, own = (data.get("sensor", {}) for data in (self.camera or {}, camera.stated))
        if not {"pixel_pitch_um", "binning"} <= calibrated.keys() & own.keys():
            return
        for axis in ("row", "pixel"):
            theirs, ours = (
                (each.get(f"{axis}_pitch_um") or each["pixel_pitch_um"]) * each["binning"] for each in (calibrated, own)
            )
            if abs(ours - theirs) > PITCH_TOLERANCE * theirs:
                raise ArgumentError(
                    "camera",
                    f"{camera.name}: has pixels of {ours:g} um, but the calibration's camera of {theirs:g} um; give "
                    "the camera of the calibration, or a calibration of this camera",
                )

    def part(self, path: Path, frame: Channel, how: Preparation) -> Channel:
        """Of a ``frame`` of the file ``path`` the part that the calibration is of: all of it, or the middle of a plane
        of which nobody states a crop. MitsimError for another size."""
        if self.shape is None:
            return frame
        if how.channel is not None and how.crop is None:
            row, column = ((side - wanted) // 2 for side, wanted in zip(frame.shape, self.shape, strict=True))
            if min(row, column) >= 0:  # as FlatCam's loader cuts it
                frame = frame[row : row + self.shape[0], column : column + self.shape[1]]
        if frame.shape != self.shape:
            raise MitsimError(f"{path}: is {_size(frame.shape)}, but the calibration's frames are {_size(self.shape)}")
        return frame


@dataclass(frozen=True)
class _Numbers:
    """What the numbers of one frame are: smallest and largest, whether all are whole, the type of their file, and what
    else is seen of numbers that a camera does not count to."""

    path: Path
    low: float
    high: float
    whole: bool
    kind: np.dtype[Any]
    cause: str

    @classmethod
    def of(cls, path: Path, frame: Numbers, camera: Electronics) -> _Numbers:
        """Of a ``frame`` (rows, columns) in the file ``path``."""
        whole, high = frame.dtype.kind != "f" or np.array_equal(frame, np.rint(frame)), float(frame.max())
        cause = "they were scaled, or the camera is another; save them as they are, or give the right camera file"
        if camera.largest is not None and high > camera.largest:
            bits = 8 * frame.itemsize
            shift = 1 << max(bits - camera.largest.bit_length(), 0)
            others = np.count_nonzero(frame % shift)
            if 0 < others <= frame.size * _MOST_STAMPED:
                cause = (
                    f"but for {others} all are multiples of {shift}: the camera writes more than light into pictures; "
                )
                cause += f"switch that off, or give a camera file of {bits} bits"
        return cls(path, float(frame.min()), high, whole, frame.dtype, cause)

    def check(self, camera: Electronics, factor: int, mean: bool = False) -> None:
        """MitsimError for numbers that, divided by a ``factor``, a ``camera`` does not give; a ``mean`` need not be
        whole."""
        largest, low, high = camera.largest, self.low / factor, self.high / factor
        if largest is None:
            return
        counts = f"camera {camera.name} counts"
        if not mean and not self.whole:
            raise MitsimError(f"{self.path}: holds fractions, but {counts} whole numbers; give single shots")
        if high > largest or (low < 0 and not mean):
            number = low if low < 0 else high
            raise MitsimError(f"{self.path}: has the number {number:g}, but {counts} 0 to {largest}: {self.cause}")
        if not mean and self.kind.kind != "f" and np.iinfo(self.kind).max < largest:
            raise MitsimError(
                f"{self.path}: holds numbers of {8 * self.kind.itemsize} bits, but {counts} to {largest}: they were "
                "made smaller; save them as they are, or give a camera file of these numbers"
            )


class _Scan:
    """All frames, looked at once: where they are, their size and numbers."""

    def __init__(self, files: tuple[Path, ...], known: RealCapture, camera: Electronics) -> None:
        self.files, self._camera = files, camera
        self.places: list[tuple[Path, int]] = []
        self._numbers: list[_Numbers] = []
        self._common = CommonFactor()
        for path in files:
            for number, frame in enumerate(read_images(path, known.wanted)):
                if not self.places:
                    self.first = frame
                elif frame.shape != self.first.shape:
                    raise MitsimError(
                        f"{path}: is {_size(frame.shape)}, but {self.places[0][0].name} {_size(self.first.shape)}; "
                        "give frames of one size"
                    )
                self.places.append((path, number))
                self._numbers.append(_Numbers.of(path, frame, camera))
                self._common.add(frame)

    def factor(self, stated: int | None) -> tuple[int, list[str], list[str]]:
        """What all numbers are divided by, what is said of it, and what is doubtful; it is the factor that somebody
        ``stated``, if not None. MitsimError for one that they do not have."""
        found, largest = self._common.factor, self._camera.largest
        if stated is not None:
            if found % stated:
                raise ArgumentError("divide_by", f"{stated}: the numbers' common factor is {found}; give that, or 1")
            return stated, [], []
        factor, doubtful = self._common.choose(largest)
        if factor > 1:
            of = ""
            if factor == self._common.shift(largest) and largest is not None:
                of = f" ({largest.bit_length()} bits in the high bits of {8 * self.first.itemsize})"
            return factor, [f"numbers are divided by {factor}, which all are multiples of{of}"], []
        if doubtful > 1:
            doubt = (
                f"all numbers are multiples of {found}, and are taken as they are: if the camera's numbers were "
                f"shifted or scaled, give --divide {doubtful}, else --divide 1"
            )
            return 1, [], [doubt]
        return 1, [], []

    def check(self, factor: int) -> None:
        """MitsimError for numbers that, divided by a ``factor``, this camera does not give."""
        for each in self._numbers:
            each.check(self._camera, factor)


# ---- The parts of a run ----


class _Shots:
    """Every frame of the ``places``, read again when it is asked for, and prepared."""

    def __init__(
        self, known: RealCapture, preparer: Preparer, fit: _Fit, places: list[tuple[Path, int]], counts: bool
    ) -> None:
        self._known, self._preparer, self._fit, self._places = known, preparer, fit, places
        self._kind = np.uint32 if counts and preparer.counts else np.float32
        self._pages: tuple[int, Iterator[Numbers]] = (0, iter(()))

    def read(self, index: int) -> Channel:
        """The frame number ``index``, (rows, columns) digital numbers."""
        (path, page), (expected, pages) = self._places[index], self._pages
        if page == 0 or index != expected:
            pages = islice(read_images(path, self._known.wanted), page, None)
        self._pages = index + 1, pages  # of one file, page after page is asked for
        frame = next(pages, None)
        if frame is None:
            raise MitsimError(f"{path}: has fewer frames than before; leave it alone while it is read")
        return self.frame(path, frame)

    def frame(self, path: Path, values: Numbers) -> Channel:
        """The frame of ``values`` (rows, columns) of the file ``path``."""
        made = self._fit.part(path, self._preparer.frame(path, values), self._preparer.how)
        return cast(Channel, np.array(made, self._kind))  # whole pictures are not kept for their parts


def _ambient(
    known: RealCapture, camera: Electronics, preparer: Preparer, fit: _Fit, shape: tuple[int, ...]
) -> tuple[npt.NDArray[np.float32], int]:
    """The mean of all frames with the projector off, and how many there are."""
    if known.ambient is None:
        raise ArgumentError("ambient", "is not given")
    total, count = np.zeros(shape), 0
    for path in image_files(known.ambient, known.wanted):
        for frame in read_images(path, known.wanted):
            _Numbers.of(path, frame, camera).check(camera, preparer.how.divide_by or 1, mean=True)
            part = fit.part(path, preparer.frame(path, frame, mean=True), preparer.how)
            if part.shape != shape:
                raise MitsimError(f"{path}: is {_size(part.shape)}, but others are {_size(shape)}")
            total, count = total + part, count + 1
    stated = known.listed.ambient_shots
    if stated is not None and count != 1:
        raise ArgumentError("ambient_shots", f"{stated}: {known.ambient} holds {count} frames; leave it out")
    return (total / count).astype(np.float32), stated or count


def _patterns(known: RealCapture, scene: tuple[int, int]) -> Patterns:
    """Patterns of the shots, in their files, for a scene of so many projector pixels."""
    if known.in_file:
        data = read_json(known.patterns)
        if not isinstance(data, dict) or "shots" not in data:
            raise MitsimError(f"{known.patterns}: has no shots; give patterns.json of `mitsim export --format png`")
        shots = data["shots"] if isinstance(data["shots"], list) else []
        captures = [
            {**{key: shot.get(key) for key in ("row", "column", "sign")}, "file": frame_name(index)}
            for index, shot in enumerate(shots)
            if isinstance(shot, dict)
        ]
        named = {key: data[key] for key in ("family", "n", "P_L", "P_R") if key in data}
        patterns = validate(Patterns, {**named, "captures": captures}, known.patterns)
    else:
        left, right = (parse_patterns(known.patterns, side, known.listed.seed) for side in scene)
        family = PatternFamily(known.patterns, left.left, right.right)
        patterns = Patterns.of(family, [frame_name(index) for index in range(len(family.shots))])
    sides = tuple(len(matrix) for matrix in patterns.matrices)
    if sides != scene:
        raise MitsimError(
            f"{known.patterns}: is for {_size(sides)} projector pixels, but {_size(scene)} are calibrated or stated"
        )
    return patterns


def _configuration(
    known: RealCapture, camera: Electronics, how: Preparation, files: tuple[Path, ...]
) -> dict[str, Any]:
    """All that decides the frames: whose files, and as what they are read."""
    more = () if known.ambient is None else image_files(known.ambient, known.wanted)
    corrected = {
        name: {path.name: checksum(path) for path in image_files(Path(place), known.wanted)}
        for name in CORRECTIONS
        if (place := getattr(how, name)) is not None
    }
    return {
        "imported": {path.name: checksum(path) for path in files},
        "ambient": {path.name: checksum(path) for path in more},
        "patterns": known.patterns,
        **camera.stated,
        "exposure_s": camera.digital.exposure_s,
        "black_level_dn": known.black_level_dn,
        "channel": how.channel,
        "prepare": {**how.model_dump(mode="json", exclude_defaults=True), **corrected},
        "seed": known.listed.seed,
        **known.listed.model_dump(include={"closing_frame", "closing_exposure_s", "order"}, exclude_none=True),
    }


def _size(shape: tuple[int, ...]) -> str:
    return "x".join(map(str, shape))

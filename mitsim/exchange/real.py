"""Import of a real camera's frames as a RUN folder; all planes of a mosaic make a coloured one."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, cast

import numpy as np

from mitsim.core.colour_files import CORRECTIONS, Preparation, image_files
from mitsim.core.configuration import validate
from mitsim.core.environment import versions
from mitsim.core.errors import ArgumentError, MitsimError, cut
from mitsim.core.exr import Channel, Channels, Metadata, checksum
from mitsim.core.files import read_json, whole_folder
from mitsim.core.images import LEAST_RESPONSE, CommonFactor, Numbers, Preparer, image_pages, read_images
from mitsim.core.job import Cost, Limits
from mitsim.core.manifests import AmbientFile, ClosingFile, Patterns, RunHead, RunManifest
from mitsim.core.runs import AMBIENT, CLOSING, frame_name
from mitsim.devices.patterns import PatternFamily, parse_patterns, shot_orders
from mitsim.devices.sensor import PITCH_TOLERANCE
from mitsim.exchange.formats import Electronics, RealCapture
from mitsim.exchange.packed import FACTORS, Content, Packed, pack_calibration

_SECONDS_PER_PIXEL = 1e-7
"""Every frame is read twice and written once: 30 s for 256 megapixels on a slow disk."""
LEFT_OUT = ("truth", "scene", "expected electrons", "plan and predicted error")
"""Parts of a run that are unknown for a real capture."""


def import_capture(source: Path, output: Path, known: RealCapture, command: str | None = None) -> dict[str, Any]:
    """Write the RUN folder of a real capture, whole or not at all, and return the output of the command line.

    MitsimError for invalid values, frames that are missing, too many, unlike each other or beyond the camera's range,
    or a place that holds something.
    """
    known.check(source)
    files = image_files(source, known.wanted)
    camera, prepare = known.electronics()
    colours, listed = known.colours, known.listed
    planes = [_Plane(known, camera, name) for name in (colours.names if colours else ("",))]
    shown = planes[0].patterns
    orders, count, order, closing = shot_orders(shown), len(shown.captures), listed.order, listed.closing_frame
    if order is not None and order not in orders:
        raise ArgumentError("order", f"{cut(repr(order))}: give {', '.join(orders)}")
    pages = {path: image_pages(path, known.wanted) for path in files}
    if (held := sum(number for number, _ in pages.values())) != count + bool(closing):
        last = " and a closing frame" if closing else ""
        hint = " (is the last a closing frame? say so)" if held == count + 1 else ""
        raise MitsimError(
            f"{source}: holds {held} frames, but patterns {known.patterns!r} take {count}{last}, in the order "
            f"(row, column), of signed ones + before -; give all of them and no others, each page a frame{hint}"
        )
    pixels = sum(number * math.prod(size) for number, size in pages.values())
    cost = Cost(seconds=pixels * _SECONDS_PER_PIXEL, disk_bytes=pixels * np.dtype(np.uint32).itemsize)
    cost.check(f"import of {count} frames", Limits(), output)
    first, common = np.empty(0), CommonFactor()
    places, notes, warnings = list[tuple[Path, int]](), list[str](), list[str]()
    for path in files:
        for number, frame in enumerate(read_images(path, known.wanted)):
            first = first if places else frame
            if frame.shape != first.shape:
                raise MitsimError(
                    f"{path}: is {_size(frame.shape)}, but {files[0].name} {_size(first.shape)}; "
                    "give frames of one size"
                )
            places.append((path, number))
            common.add(frame)
    factor = prepare.divide_by
    if factor is None:
        factor = common.choose(camera.largest)
        if factor > 1:
            notes.append(f"numbers are divided by {factor}, because all are multiples of it")
        elif common.factor > 1:
            warnings.append(
                f"all numbers are multiples of {common.factor}, and are taken as they are: if the camera's numbers "
                f"were shifted or scaled, give --divide {common.factor}, else --divide 1"
            )
    elif common.factor % factor:
        raise ArgumentError("divide_by", f"{factor}: the numbers' common factor is {common.factor}; give that, or 1")
    if order is not None:
        places[:count] = [places[frame] for frame in orders[order]]
    prepare, runs = prepare.model_copy(update={"divide_by": factor}), {}
    for plane in planes:
        how = prepare.model_copy(update={"channel": plane.name}) if plane.name else prepare
        runs[plane.name], shape, unlit = plane.pack(how, source, files, places, first, command)
        if unlit:
            warnings.append(
                f"flat: {unlit} pixels{f' of {plane.name}' if plane.name else ''} have less than {LEAST_RESPONSE:g} of "
                "the mean response, and are not corrected; leave them out by a crop, or take a flat without a mask"
            )
    if prepare.turn_deg:
        notes.append(
            f"turned by {prepare.turn_deg:g} degrees: noise of neighbouring pixels is no more independent, so an "
            "image's stated uncertainty is rough"
        )
    content = Content(runs, colours, "" if colours is None else json.dumps(colours.model_dump(mode="json")))
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


def _check_range(path: Path, frame: Numbers, camera: Electronics, factor: int, mean: bool = False) -> None:
    """Raise MitsimError if numbers, divided by a factor, are none of the camera; ``mean`` marks means of frames."""
    largest, low, high, kind = camera.largest, float(frame.min()), float(frame.max()), frame.dtype
    if largest is None:
        return
    counts = f"camera {camera.name} counts"
    if not mean and kind.kind == "f" and not np.array_equal(frame, np.rint(frame)):
        raise MitsimError(f"{path}: holds fractions, but {counts} whole numbers; give single shots")
    if high / factor > largest or (low < 0 and not mean):
        raise MitsimError(
            f"{path}: has the number {(low if low < 0 else high) / factor:g}, but {counts} 0 to {largest}: they were "
            "scaled, hold more than light (as a text in the picture), or the camera is another; save them as they are, "
            "or give the right camera file"
        )
    if not mean and kind.kind != "f" and np.iinfo(kind).max < largest:
        raise MitsimError(
            f"{path}: holds numbers of {8 * kind.itemsize} bits, but {counts} to {largest}: they were made "
            "smaller; save them as they are, or give a camera file of these numbers"
        )


class _Plane:
    """One plane of a mosaic, or by the name "" the whole picture; a calibration states identity, shape and pixels."""

    def __init__(self, known: RealCapture, camera: Electronics, name: str) -> None:
        self.known, self.camera, self.name = known, camera, name
        self.identity: dict[str, Any] = {}
        self.shape: tuple[int, ...] | None = None
        n = known.listed.n
        scene: tuple[Any, ...] = (n, n)
        if known.calibration is not None:
            calibration = pack_calibration(known.calibration / name)
            self.identity = dict(calibration.manifest.camera)
            self.shape, scene = zip(*(calibration.read(file)[0]["factor"].shape for file in FACTORS), strict=True)
            if n is not None and (n, n) != scene:
                raise ArgumentError(
                    "projector_pixels", f"{n}: the calibration has {scene[0]} x {scene[1]}; leave it out"
                )
        # Otherwise frames of a camera with another pitch would count as frames of the calibration's camera.
        calibrated, own = (data.get("sensor", {}) for data in (self.identity, camera.stated))
        for axis in ("row", "pixel") if {"pixel_pitch_um", "binning"} <= calibrated.keys() & own.keys() else ():
            theirs, ours = (
                (each.get(f"{axis}_pitch_um") or each["pixel_pitch_um"]) * each["binning"] for each in (calibrated, own)
            )
            if abs(ours - theirs) > PITCH_TOLERANCE * theirs:
                raise ArgumentError(
                    "camera",
                    f"{camera.name}: has pixels of {ours:g} um, but the calibration's camera of {theirs:g} um; give "
                    "the camera of the calibration, or a calibration of this camera",
                )
        if known.patterns.endswith(".json"):
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
            self.patterns = validate(Patterns, {**named, "captures": captures}, known.patterns)
        else:
            left, right = (parse_patterns(known.patterns, side, known.listed.seed) for side in scene)
            family = PatternFamily(known.patterns, left.left, right.right)
            self.patterns = Patterns.of(family, [frame_name(index) for index in range(len(family.shots))])
        sides = tuple(len(matrix) for matrix in self.patterns.matrices)
        if sides != scene:
            raise MitsimError(
                f"{known.patterns}: is for {_size(sides)} projector pixels, but {_size(scene)} are calibrated or stated"
            )

    def pack(
        self,
        how: Preparation,
        source: Path,
        files: tuple[Path, ...],
        places: list[tuple[Path, int]],
        first: Numbers,
        command: str | None,
    ) -> tuple[Packed[RunManifest], tuple[int, ...], int]:
        """Return the run, the shape of its frames, and the number of pixels with too little response."""
        known, camera, listed, captures = self.known, self.camera, self.known.listed, self.patterns.captures
        preparer = Preparer.of(how, camera.digital, known.wanted)
        kind = np.uint32 if camera.largest is not None and preparer.counts else np.float32
        shape = self._part(places[0][0], preparer.frame(places[0][0], first), how).shape
        ambient = listed.ambient and self._ambient(Path(listed.ambient), preparer, shape)
        seconds = listed.closing_exposure_s or camera.digital.exposure_s
        closing = listed.closing_frame and ClosingFile(kind=listed.closing_frame, file=CLOSING, exposure_s=seconds)
        # The dark level depends on the exposure.
        of_last = replace(preparer, digital=preparer.digital.model_copy(update={"exposure_s": seconds}))
        names = (
            *(shot.file for shot in captures), *((AMBIENT,) if ambient else ()), *((CLOSING,) if closing else ()),
        )  # fmt: skip
        own = camera.identity | ({} if listed.prepare.channel == how.channel else {"channel": how.channel})
        more = () if listed.ambient is None else image_files(Path(listed.ambient), known.wanted)
        corrected = {
            name: {path.name: checksum(path) for path in image_files(Path(place), known.wanted)}
            for name in CORRECTIONS
            if (place := getattr(how, name)) is not None
        }
        configuration = {
            "imported": {path.name: checksum(path) for path in files},
            "ambient": {path.name: checksum(path) for path in more},
            "patterns": known.patterns,
            **camera.stated,
            "exposure_s": camera.digital.exposure_s,
            "black_level_dn": known.black_level_dn,
            "channel": how.channel,
            "prepare": {**how.model_dump(mode="json", exclude_defaults=True), **corrected},
            "seed": listed.seed,
            **listed.model_dump(include={"closing_frame", "closing_exposure_s", "order"}, exclude_none=True),
        }
        head = RunHead.of(configuration)
        manifest = RunManifest(
            configuration=head.configuration,
            configuration_sha256=head.configuration_sha256,
            camera=self.identity or own,
            digital=preparer.digital,
            patterns=self.patterns,
            sensor_noise=None,
            ambient_frame=AmbientFile(file=AMBIENT, shots=ambient[1]) if ambient else None,
            closing_frame=closing,
            order=listed.order,
            checksums=dict.fromkeys(names, ""),  # worked out as the files are written
            versions=versions(),
            command=command,
        )
        index = {shot.file: number for number, shot in enumerate(captures)}
        index[CLOSING] = len(captures)
        pages: Iterator[Numbers] = iter(())
        following = places[0][0], -1

        def read(name: str) -> tuple[Channels, Metadata]:
            """Read and prepare a frame again; pages of one file are read in order."""
            nonlocal pages, following
            if ambient and name == AMBIENT:
                return {"DN": ambient[0]}, {"shots": ambient[1], "exposure_s": camera.digital.exposure_s}
            path, page = places[index[name]]
            if (path, page) != following:
                pages = islice(read_images(path, known.wanted), page, None)
            following = path, page + 1
            if (values := next(pages, None)) is None:
                raise MitsimError(f"{path}: has fewer frames than before; leave it alone while it is read")
            _check_range(path, values, camera, how.divide_by or 1)
            made = (of_last if name == CLOSING else preparer).frame(path, values)
            channels = {"DN": cast(Channel, np.array(self._part(path, made, how), kind))}  # parts do not keep pictures
            if name == CLOSING:
                return channels, {"source": path.name, "exposure_s": seconds}
            shot = captures[index[name]]
            about: Metadata = {"row": shot.row, "column": shot.column, "sign": shot.sign, "source": path.name}
            return channels, {**about, "exposure_s": camera.digital.exposure_s}

        return Packed(manifest, "", names, read, source), shape, preparer.unlit

    def _part(self, path: Path, frame: Numbers, how: Preparation) -> Numbers:
        """Return the calibrated part of a ``frame``: all of it, or the middle of a plane without a stated crop.

        MitsimError for another size.
        """
        if self.shape is not None and how.channel is not None and how.crop is None:
            row, column = ((side - wanted) // 2 for side, wanted in zip(frame.shape, self.shape, strict=True))
            if min(row, column) >= 0:  # as FlatCam's loader cuts it
                frame = frame[row : row + self.shape[0], column : column + self.shape[1]]
        if self.shape is not None and frame.shape != self.shape:
            raise MitsimError(f"{path}: is {_size(frame.shape)}, but the calibration's frames are {_size(self.shape)}")
        return frame

    def _ambient(self, source: Path, preparer: Preparer, shape: tuple[int, ...]) -> tuple[Channel, int]:
        total, count, stated = np.zeros(shape), 0, self.known.listed.ambient_shots
        for path in image_files(source, self.known.wanted):
            for frame in read_images(path, self.known.wanted):
                _check_range(path, frame, self.camera, preparer.how.divide_by or 1, mean=True)
                part = self._part(path, preparer.frame(path, frame, mean=True), preparer.how)
                if part.shape != shape:
                    raise MitsimError(f"{path}: is {_size(part.shape)}, but others are {_size(shape)}")
                total, count = total + part, count + 1
        if stated is not None and count != 1:
            raise ArgumentError("ambient_shots", f"{stated}: {source} holds {count} frames; leave it out")
        return (total / count).astype(np.float32), stated or count


def _size(shape: tuple[int, ...]) -> str:
    return "x".join(map(str, shape))

"""Frames of a real camera and what is known of it in; a RUN folder that `mitsim reconstruct` takes out.

What a real capture lacks - truth, scene, expected electrons, predicted error - is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.configuration import locate, validate
from mitsim.core.environment import versions
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.exr import Channel, Channels, Metadata, checksum
from mitsim.core.files import read_json
from mitsim.core.imagelist import image_files
from mitsim.core.images import Numbers, image_pages, read_images
from mitsim.core.job import Cost, Limits
from mitsim.core.manifests import AmbientFile, CalibrationManifest, Digital, Patterns, RunHead, RunManifest
from mitsim.core.recorders import AMBIENT, frame_name
from mitsim.devices.patterns import PatternFamily, parse_patterns
from mitsim.devices.sensor import SensorModel, digital_of, load_sensor
from mitsim.exchange.formats import PLANES, RealCapture
from mitsim.exchange.packed import FACTORS, Packed, pack_calibration

_SECONDS_PER_PIXEL = 1e-7
"""Of an import, which reads every frame twice and writes it once: some 30 s for 256 megapixels on a slow disk."""
LEFT_OUT = ("truth", "scene", "expected electrons", "plan and predicted error")
"""What nobody knows of a real capture."""


def import_frames(source: Path, output: Path, known: RealCapture) -> dict[str, Any]:
    """Write the RUN folder of a real capture, whole or not at all.

    Parameters
    ----------
    source
        folder of frames, in the order of the numbers in their names; or one file.
    output
        RUN folder to make.
    known
        what is known of the capture.

    Returns
    -------
    dict
        `frames`, `shape`, `output`, `calibration_output` (None), `holds`, `left_out`, `warnings`: what the command line
        prints.

    Raises
    ------
    MitsimError
        for values that cannot be, frames that are missing, too many, unlike each other or beyond the camera's range, or
        a place that holds something.
    """
    known.check(source)
    sensor = load_sensor(locate(known.camera, "calibration", ".toml"))
    fit = _Fit.of(known)
    digital = digital_of(sensor, known.exposure_s)
    if known.black_level_dn is not None:
        stated = {**digital.model_dump(), "black_level_dn": known.black_level_dn}
        digital = validate(Digital, stated, "black_level")
    patterns = _patterns(known, fit.scene)
    files = image_files(source, known.wanted)
    pages, count = [image_pages(path, known.wanted) for path in files], len(patterns.captures)
    if (held := sum(number for number, _ in pages)) != count:
        raise MitsimError(
            f"{source}: holds {held} frames, but patterns {known.patterns!r} take {count}, in the order "
            "(row, column), of signed ones + before -; give all of them and no others"
        )
    pixels = sum(number * math.prod(size) for number, size in pages)
    cost = Cost(seconds=pixels * _SECONDS_PER_PIXEL, disk_bytes=pixels * np.dtype(np.uint32).itemsize)
    cost.check(f"import of {count} frames", Limits(), output)
    shots = _Shots(files, known, sensor, fit)
    ambient = None if known.ambient is None else _ambient(known, sensor, fit)
    names = (*(shot.file for shot in patterns.captures), *((AMBIENT,) if ambient else ()))
    head = RunHead.of(_configuration(known, sensor, files))
    manifest = RunManifest(
        configuration=head.configuration,
        configuration_sha256=head.configuration_sha256,
        camera=fit.camera or {"name": sensor.name},
        digital=digital,
        patterns=patterns,
        sensor_noise=None,
        ambient_frame=None if ambient is None else AmbientFile(file=AMBIENT, shots=ambient[1]),
        checksums=dict.fromkeys(names, ""),  # worked out as the files are written
        versions=versions(),
    )
    index = {shot.file: number for number, shot in enumerate(patterns.captures)}

    def read(name: str) -> tuple[Channels, Metadata]:
        if name not in index and ambient is not None:
            return {"DN": ambient[0]}, {"shots": ambient[1], "exposure_s": known.exposure_s}
        shot, (path, _) = patterns.captures[index[name]], shots.places[index[name]]
        about: Metadata = {
            "row": shot.row,
            "column": shot.column,
            "sign": shot.sign,
            "source": path.name,
            "exposure_s": known.exposure_s,
        }
        return {"DN": shots.read(index[name])}, about

    Packed(manifest, "", names, read, source).save(output)
    return {
        "frames": count,
        "shape": list(shots.shape),
        "output": str(output),
        "calibration_output": None,
        "holds": ["run"],
        "left_out": list(LEFT_OUT),
        "warnings": [],
    }


@dataclass(frozen=True)
class _Fit:
    """What a calibration of the same camera tells: its identity, frames' shape and projector pixels."""

    camera: dict[str, Any] | None
    shape: tuple[int, int] | None
    scene: tuple[int, int]

    @classmethod
    def of(cls, known: RealCapture) -> _Fit:
        if known.calibration is None:
            if known.n is None:
                raise AssertionError  # refused by RealCapture.check
            return cls(None, None, (known.n, known.n))
        calibration: Packed[CalibrationManifest] = pack_calibration(known.calibration)
        left, right = (calibration.read(name)[0]["factor"].shape for name in FACTORS)
        if known.n is not None and (known.n, known.n) != (left[1], right[1]):
            raise ArgumentError(
                "projector_pixels", f"{known.n}: the calibration has {left[1]} x {right[1]}; leave it out"
            )
        return cls(dict(calibration.manifest.camera), (left[0], right[0]), (left[1], right[1]))


class _Shots:
    """Every frame of some files, checked when it is first looked at and read again when it is written."""

    def __init__(self, files: tuple[Path, ...], known: RealCapture, sensor: SensorModel, fit: _Fit) -> None:
        self._known, self._sensor, self._fit = known, sensor, fit
        self._pages: tuple[int, Iterator[Numbers]] = (0, iter(()))
        self.places: list[tuple[Path, int]] = []
        self.shape: tuple[int, int] = (0, 0)
        for path in files:
            for number, frame in enumerate(read_images(path, known.wanted)):
                digital = self._digital(path, frame)
                self.shape = digital.shape if not self.places else self.shape
                if digital.shape != self.shape:
                    raise MitsimError(
                        f"{path}: is {_size(digital.shape)}, but {self.places[0][0].name} {_size(self.shape)}; "
                        "give frames of one size"
                    )
                self.places.append((path, number))

    def read(self, index: int) -> Channel:
        """The frame number ``index``, (rows, columns) digital numbers."""
        (path, page), (expected, pages) = self.places[index], self._pages
        if page == 0 or index != expected:
            pages = islice(read_images(path, self._known.wanted), page, None)
        self._pages = index + 1, pages  # of one file, page after page is asked for
        frame = next(pages, None)
        if frame is None:
            raise MitsimError(f"{path}: has fewer frames than before; leave it alone while it is read")
        return self._digital(path, frame)

    def _digital(self, path: Path, frame: Numbers) -> Channel:
        """The wanted part of a ``frame`` of the file ``path``, checked against the camera."""
        return part_of(path, digital_numbers(path, frame, self._sensor), self._known.channel, self._fit.shape)


def part_of(path: Path, frame: Channel, channel: str | None, shape: tuple[int, int] | None) -> Channel:
    """The plane of a ``channel``, and of that the middle that a calibration is of.

    Parameters
    ----------
    path
        of the frame, for messages.
    frame
        (rows, columns).
    channel
        plane of a colour sensor; None: the frame as it is.
    shape
        of the calibration's frames; None: no calibration. Without a channel it must be the frame's.

    Raises
    ------
    MitsimError
        for a frame of another size.
    """
    if channel is not None:
        row, column = PLANES[channel]
        frame = frame[row::2, column::2]
        if shape is not None and all(side >= wanted for side, wanted in zip(frame.shape, shape, strict=True)):
            # As FlatCam's loader cuts it.
            row, column = ((side - wanted) // 2 for side, wanted in zip(frame.shape, shape, strict=True))
            frame = frame[row : row + shape[0], column : column + shape[1]]
    if shape is not None and frame.shape != shape:
        raise MitsimError(f"{path}: is {_size(frame.shape)}, but the calibration's frames are {_size(shape)}")
    return frame.copy()


def digital_numbers(path: Path, frame: Numbers, sensor: SensorModel, mean: bool = False) -> Channel:
    """Numbers of a file as a frame of a camera holds them, uint32 or float32.

    Parameters
    ----------
    path
        of the file, for messages.
    frame
        (rows, columns).
    sensor
        the camera.
    mean
        whether this is a mean of frames, which need not be whole.

    Raises
    ------
    MitsimError
        for numbers that this camera does not give.
    """
    largest = sensor.largest_dn
    if largest is None or mean:
        top = float(frame.max())
        if largest is not None and top > largest:
            raise MitsimError(_beyond(path, top, sensor))
        return frame.astype(np.float32)
    if frame.dtype.kind == "f" and not np.array_equal(frame, np.rint(frame)):
        raise MitsimError(f"{path}: holds fractions, but camera {sensor.name} counts whole numbers; give single shots")
    if frame.min() < 0 or frame.max() > largest:
        raise MitsimError(_beyond(path, float(frame.min() if frame.min() < 0 else frame.max()), sensor))
    if frame.dtype.kind != "f" and np.iinfo(frame.dtype).max < largest:
        raise MitsimError(
            f"{path}: holds numbers of {8 * frame.dtype.itemsize} bits, but camera {sensor.name} counts to {largest}: "
            "they were made smaller; save them as they are, or give a camera file of these numbers"
        )
    return frame.astype(np.uint32)


def _beyond(path: Path, number: float, sensor: SensorModel) -> str:
    return (
        f"{path}: has the number {number:g}, but camera {sensor.name} counts 0 to {sensor.largest_dn}: they were "
        "scaled, or the camera is another; save them as they are, or give the right camera file"
    )


def _ambient(known: RealCapture, sensor: SensorModel, fit: _Fit) -> tuple[npt.NDArray[np.float32], int]:
    """The mean of all frames with the projector off, and how many there are."""
    if known.ambient is None:
        raise ArgumentError("ambient", "is not given")
    total, count = np.zeros(()), 0
    for path in image_files(known.ambient, known.wanted):
        for frame in read_images(path, known.wanted):
            part = part_of(path, digital_numbers(path, frame, sensor, mean=True), known.channel, fit.shape)
            if count and part.shape != total.shape:
                raise MitsimError(f"{path}: is {_size(part.shape)}, but others are {_size(total.shape)}")
            total, count = total + part, count + 1
    if known.ambient_shots is not None and count != 1:
        raise ArgumentError(
            "ambient_shots", f"{known.ambient_shots}: {known.ambient} holds {count} frames; leave it out"
        )
    return (total / count).astype(np.float32), known.ambient_shots or count


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
        left, right = (parse_patterns(known.patterns, side, known.seed) for side in scene)
        family = PatternFamily(known.patterns, left.left, right.right)
        patterns = Patterns.of(family, [frame_name(index) for index in range(len(family.shots))])
    sides = tuple(len(matrix) for matrix in patterns.matrices)
    if sides != scene:
        raise MitsimError(
            f"{known.patterns}: is for {_size(sides)} projector pixels, but {_size(scene)} are calibrated or stated"
        )
    return patterns


def _configuration(known: RealCapture, sensor: SensorModel, files: tuple[Path, ...]) -> dict[str, Any]:
    """All that decides the frames: whose files, and as what they are read."""
    more = () if known.ambient is None else image_files(known.ambient, known.wanted)
    return {
        "imported": {path.name: checksum(path) for path in files},
        "ambient": {path.name: checksum(path) for path in more},
        "patterns": known.patterns,
        "sensor": sensor.model_dump(mode="json", exclude={"full_well_e"}),
        "exposure_s": known.exposure_s,
        "black_level_dn": known.black_level_dn,
        "channel": known.channel,
        "seed": known.seed,
    }


def _size(shape: tuple[int, ...]) -> str:
    return "x".join(map(str, shape))

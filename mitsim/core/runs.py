"""Captures in memory and on disk: shots of a pattern family in, one object out that reads the same from either.

A capture is recorded by a :class:`RunFolder` or a :class:`RunMemory`, which take the same calls; each ends in a
:class:`Capture`.
"""

from __future__ import annotations

import hashlib
import shutil
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.framefile import Channel, Value, checksum, read_frame, write_frame
from mitsim.core.manifests import MANIFEST, RunHead, RunManifest, read_head, read_manifest, write_manifest
from mitsim.core.output import output_folder, sweep
from mitsim.core.pictures import card, scaled, span

TRUTH, AMBIENT = "truth.exr", "ambient.exr"
Channels = Mapping[str, Channel]
Metadata = Mapping[str, Value]
_SHOWN = 3
"""Frames that a notebook shows: with the truth they fill a line."""


def frame_name(index: int) -> str:
    """File name of shot number ``index`` in its run folder."""
    return f"frame_{index:05d}.exr"


@dataclass(frozen=True, eq=False)
class Ambient:
    """What a camera sees with the projector off, as it is taken off every frame of a run.

    Attributes
    ----------
    rate
        (rows, columns) mean over the shots [electrons/s].
    variance
        (rows, columns) of that mean [(electrons/s)^2], of what the manifest states of the sensor's noise. It is one
        draw, the same in all frames.
    shots
        that were averaged.
    """

    rate: FloatArray
    variance: FloatArray
    shots: int


@dataclass(frozen=True, eq=False)
class Measurement:
    """What was measured under one pattern.

    Attributes
    ----------
    frame
        (rows, columns) [electrons/s], of a signed pattern the difference of its halves; of others without ambient
        light.
    row, column
        indices (i, j) of the pattern.
    light
        (rows, columns) [electrons/s] sum of its shots as they were read: what their shot noise is of.
    shots
        their number.
    saturated
        readings of them at the full well or the ADC's end.
    """

    frame: FloatArray
    row: int
    column: int
    light: FloatArray
    shots: int
    saturated: int

    def __add__(self, other: Measurement) -> Measurement:
        """Both halves of a signed pattern as one measurement."""
        shots, saturated = self.shots + other.shots, self.saturated + other.saturated
        return Measurement(self.frame + other.frame, self.row, self.column, self.light + other.light, shots, saturated)

    @property
    def power(self) -> FloatArray:
        """(rows, columns) sum of the squares of its shots [(electrons/s)^2]."""
        # For halves p and q, p^2 + q^2 = ((p - q)^2 + (p + q)^2) / 2.
        return np.square(self.light) if self.shots == 1 else (np.square(self.frame) + np.square(self.light)) / 2


class Capture:
    """All shots of one pattern family, in memory or in their folder.

    Attributes
    ----------
    manifest
        what was projected and how the frames are read.
    folder
        where the files lie; None for a capture in memory. Frames are then read when they are first asked for.
    """

    def __init__(
        self,
        manifest: RunManifest,
        folder: Path | None = None,
        memory: Mapping[str, tuple[Channels, Metadata]] | None = None,
    ) -> None:
        """Channels and metadata of a capture's files, by ``manifest``.

        Parameters
        ----------
        manifest
            of the finished capture.
        folder
            that holds the files.
        memory
            channels and metadata by file name, instead of a folder.
        """
        self.manifest, self.folder = manifest, folder
        self._memory = dict(memory or {})

    @property
    def name(self) -> str:
        """The folder, or what messages call a capture in memory."""
        return str(self.folder) if self.folder else "the capture"

    @cached_property
    def dn(self) -> Channel:
        """(shots, rows, columns) digital numbers, uint32; float32 of a sensor without an ADC."""
        return self._stacked("DN")

    @cached_property
    def electrons(self) -> Channel | None:
        """(shots, rows, columns) expected photoelectrons; None for a real camera, whose expectation nobody knows."""
        first = self.manifest.patterns.captures[0].file
        return self._stacked("electrons") if "electrons" in self._read(first)[0] else None

    @cached_property
    def truth(self) -> FloatArray | None:
        """(n, n) apparent reflectance, relative to the board of :attr:`truth_board`; None for a real camera."""
        known = TRUTH in self._memory if self.folder is None else (self.folder / TRUTH).is_file()
        return self._channel(TRUTH, "reflectance") if known else None

    @cached_property
    def truth_standard_error(self) -> FloatArray | None:
        """(n, n) standard error of :attr:`truth`, from sampling; None where nobody stated it, as in 0.4.0."""
        known = self.truth is not None and "standard_error" in self._read(TRUTH)[0]
        return self._channel(TRUTH, "standard_error") if known else None

    @property
    def truth_board(self) -> float | None:
        """Reflectance of the board that counts as 1 in :attr:`truth`, where that is known."""
        board = None if self.truth is None else self._read(TRUTH)[1].get("board_reflectance")
        return None if board is None else float(board)

    @property
    def exposure_s(self) -> float:
        """Exposure of every frame [s]."""
        return self.manifest.digital.exposure_s

    @property
    def plan(self) -> dict[str, Any] | None:
        """The effect plan, as the manifest holds it; None for a real camera."""
        return self.manifest.plan

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why the capture is flagged."""
        return self.manifest.warnings

    @cached_property
    def ambient(self) -> Ambient | None:
        """What is taken off every frame but those of signed pairs; None where no ambient frame was taken."""
        if self.manifest.ambient_frame is None:
            return None
        block, digital = self.manifest.ambient_frame, self.manifest.digital
        rate = digital.rate(self._channel(block.file, "DN"))
        return Ambient(rate, np.maximum(digital.variance(rate), 0.0) / block.shots, block.shots)

    @cached_property
    def patterns(self) -> tuple[FloatArray, FloatArray]:
        """P_L (n, K) and P_R (n', K')."""
        return self.manifest.patterns.matrices

    def measurements(self, shape: tuple[int, int] | None = None) -> Iterator[tuple[FloatArray, int, int]]:
        """(frame, i, j) of every pattern; see :meth:`measured`, which also takes ``shape``."""
        for each in self.measured(shape):
            yield each.frame, each.row, each.column

    def measured(self, shape: tuple[int, int] | None = None) -> Iterator[Measurement]:
        """What was measured under every pattern, read one at a time; the halves of a signed one come as their
        difference, others without the ambient frame, if one was taken. MitsimError for a frame that is missing,
        damaged, not finite or of another ``shape`` than is asked for."""
        digital = self.manifest.digital
        waiting: dict[tuple[int, int], Measurement] = {}
        for shot in self.manifest.patterns.captures:
            index = (shot.row, shot.column)
            dn = self._channel(shot.file, "DN")
            if dn.shape != (shape or dn.shape):
                raise MitsimError(
                    f"{(self.folder or Path()) / shot.file}: the frame is {_size(dn.shape)}, but the calibration's are "
                    f"{_size(shape or ())}; calibrate this camera"
                )
            light = digital.rate(dn)
            full = 0 if digital.saturation_dn is None else int(np.count_nonzero(dn >= digital.saturation_dn))
            half = Measurement(light * shot.sign if shot.sign else self._lit(light), *index, light, 1, full)
            if shot.sign and index not in waiting:
                waiting[index] = half
                continue
            yield waiting.pop(index) + half if shot.sign else half

    def _lit(self, light: FloatArray) -> FloatArray:
        """The projector's part of a shot's ``light``."""
        if self.ambient is None:
            return light
        ambient = self.ambient.rate
        if ambient.shape != light.shape:
            raise MitsimError(
                f"{self.name}: the ambient frame is {_size(ambient.shape)}, but the frames are {_size(light.shape)}; "
                "take it with the same camera"
            )
        return light - ambient

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 that captures of the same frames share, in memory or on disk."""
        manifest = self.manifest
        # What is not stated is left out: folders of 0.4.0 keep their fingerprints.
        digest = hashlib.sha256(manifest.digital.model_dump_json(exclude_defaults=True).encode())
        digest.update(manifest.patterns.model_dump_json().encode() + manifest.configuration_sha256.encode())
        files = [shot.file for shot in manifest.patterns.captures]
        if manifest.ambient_frame is not None:
            digest.update(manifest.ambient_frame.model_dump_json().encode())
            files.append(manifest.ambient_frame.file)
        for file in files:
            if self.folder and not (manifest.configuration_sha256 and file in manifest.checksums):
                verify(self.folder, file, {}, "")  # no link out of it
                digest.update(checksum(self.folder / file).encode())
        return digest.hexdigest()

    def summary(self) -> dict[str, Any]:
        """What the command line reports; fields of a real camera's capture that nobody knows are None."""
        manifest = self.manifest
        known = (
            "mc_error",
            "total_error",
            "total_error_bound",
            "total_error_of_projector",
            "mc_to_sensor_noise",
            "sensor_noise",
            "heaviest_group",
            "truth_error",
            "lost_light",
            "seconds",
            "warnings",
        )
        return {
            "frames": len(manifest.patterns.captures),
            "shape": self._channel(manifest.patterns.captures[0].file, "DN").shape,
            "variant": manifest.configuration.get("variant"),
            "seed": manifest.configuration.get("seed"),
            "output": None if self.folder is None else str(self.folder),
            "exposure_s": self.exposure_s,
            "ambient_frame": None if manifest.ambient_frame is None else manifest.ambient_frame.model_dump(),
            **{name: getattr(manifest, name) for name in known},
        }

    def save(self, folder: Path | str) -> Path:
        """Write the RUN folder that `mitsim capture` writes, to a new or empty ``folder``; returns it.

        MitsimError when it holds something, or cannot be written.
        """
        with claimed(Path(folder), self.manifest, resume=False) as run:
            if self.folder is not None:
                ambient = self.manifest.ambient_frame
                also = () if ambient is None else (ambient.file,)
                for name in (*(shot.file for shot in self.manifest.patterns.captures), *also, TRUTH, MANIFEST):
                    if (self.folder / name).is_file():
                        shutil.copyfile(self.folder / name, run.path / name)
            else:
                run.begin()
                for index, shot in enumerate(self.manifest.patterns.captures):
                    run.write_frame(index, *self._memory[shot.file])
                for name in (TRUTH, AMBIENT):
                    if name in self._memory:
                        run.write(name, *self._memory[name])
                run.finish(self.manifest)
        return run.path

    def __repr__(self) -> str:
        return f"Capture({self._family}: {self._size}, {self.folder or 'in memory'})"

    def _repr_html_(self) -> str:
        shots = self.manifest.patterns.captures[:_SHOWN]
        frames = [self._channel(shot.file, "DN") for shot in shots]
        pictures = {
            f"shot {i}, pattern ({shot.row}, {shot.column})\n{span(frame, 'DN')}": scaled(frame)
            for i, (shot, frame) in enumerate(zip(shots, frames, strict=True))
        }
        truth = {} if self.truth is None else {"truth\nreflectance 0 to 1": self.truth}
        facts = f"{self._size}, exposure {self.exposure_s:.3g} s a shot; {self.folder or 'in memory'}"
        return card(f"Capture: {self._family}", {**pictures, **truth}, (facts, *self.warnings))

    @property
    def _family(self) -> str:
        return self.manifest.patterns.family or "patterns"

    @property
    def _size(self) -> str:
        shots = self.manifest.patterns.captures
        rows, columns = self._channel(shots[0].file, "DN").shape
        return f"{len(shots)} shots of {rows} x {columns} pixels"

    def _read(self, name: str) -> tuple[Channels, Metadata]:
        if self.folder is None:
            return self._memory[name]
        verify(self.folder, name, self.manifest.checksums, "capture it again with resume=True")
        return read_frame(self.folder / name)

    def _channel(self, name: str, channel: str) -> FloatArray:
        return finite_channel(self._read(name)[0], channel, self.folder / name if self.folder else Path(name))

    def _stacked(self, channel: str) -> Channel:
        shots = self.manifest.patterns.captures
        stack: Channel = np.array([self._read(shot.file)[0][channel] for shot in shots])
        if self.folder is None:  # one copy: the shots become views of the stack
            for shot, values in zip(shots, stack, strict=True):
                channels, metadata = self._memory[shot.file]
                self._memory[shot.file] = {**channels, channel: values}, metadata
        return stack


def load_run(folder: Path | str) -> Capture:
    """The capture in the RUN folder ``folder``. MitsimError when it is not a complete one."""
    return Capture(read_manifest(Path(folder), RunManifest), Path(folder))


def verify(folder: Path, name: str, checksums: Mapping[str, str], remedy: str) -> None:
    """Check that a file is the one whose checksum was noted; files without one are taken as they are.

    Parameters
    ----------
    folder, name
        of the file.
    checksums
        SHA-256 by name.
    remedy
        what to do where they differ.

    Raises
    ------
    MitsimError
        when they differ, or the name leads out of the folder by a link.
    """
    if not (folder / name).resolve().is_relative_to(folder.resolve()):
        raise MitsimError(f"{folder / name}: leads out of its folder; copy the file there")
    expected = checksums.get(name)
    if expected is not None and checksum(folder / name) != expected:
        raise MitsimError(f"{folder / name}: not the file that was written (its checksum differs); {remedy}")


def finite_channel(channels: Channels, name: str, path: Path) -> FloatArray:
    """One channel of a frame in double precision.

    Parameters
    ----------
    channels
        of the frame, (rows, columns) each.
    name
        of the one that is needed.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        when it is not there, or holds a value that is not finite.
    """
    if name not in channels:
        raise MitsimError(f"{path}: channels are {', '.join(channels)}; {name} is needed")
    values = channels[name].astype(np.float64)
    bad = int(np.count_nonzero(~np.isfinite(values)))
    if bad:
        raise MitsimError(f"{path}: {bad} values are not finite; capture or calibrate again")
    return values


class RunMemory:
    """Records a capture in memory; the same calls as :class:`RunFolder`."""

    def __init__(self) -> None:
        self._files: dict[str, tuple[Channels, Metadata]] = {}

    def begin(self) -> None:
        """Nothing is there yet."""

    def keeps(self, index: int) -> bool:
        """Whether shot number ``index`` is there already: never."""
        return False

    def write_frame(self, index: int, channels: Channels, metadata: Metadata) -> None:
        """Keep one shot.

        Parameters
        ----------
        index
            its number.
        channels, metadata
            of its file, (rows, columns) each.
        """
        self._files[frame_name(index)] = channels, metadata

    def write(self, name: str, channels: Channels, metadata: Metadata) -> None:
        """Keep a file of the run.

        Parameters
        ----------
        name
            of the file.
        channels, metadata
            of it, (rows, columns) each.
        """
        self._files[name] = channels, metadata

    def write_truth(self, reflectance: FloatArray, board: float, standard_error: FloatArray | None = None) -> None:
        """Keep the truth.

        Parameters
        ----------
        reflectance, board
            (n, n), relative to a board of that reflectance.
        standard_error
            (n, n) of it, where known.
        """
        self._files[TRUTH] = _truth(reflectance, board, standard_error)

    def finish(self, manifest: RunManifest) -> Capture:
        """The capture of that ``manifest``."""
        return Capture(manifest, memory=dict(sorted(self._files.items())))


class RunFolder:
    """Records a capture in a folder, whole, resumable and checked; made by :func:`claimed`.

    A frame is kept on resume when it is the one that a finished run's checksum names, or, in an interrupted run, when
    it is readable, carries this run's digest, and its pixels have the checksum that was noted with it.
    """

    def __init__(self, path: Path, head: RunHead, known: Mapping[str, str]) -> None:
        """A run in its folder.

        Parameters
        ----------
        path, head
            of the folder, and the configuration.
        known
            checksums of an earlier, finished run, by file name.
        """
        self.path, self.head = path, head
        self._known, self._checksums, self._lock = known, dict[str, str](), threading.Lock()

    def begin(self) -> None:
        """Mark the folder as an unfinished run of this configuration, and clear what a killed process left."""
        sweep(self.path)
        configuration, digest = self.head.configuration, self.head.configuration_sha256
        head = RunHead(status="incomplete", configuration=configuration, configuration_sha256=digest)
        write_manifest(self.path, head)

    def keeps(self, index: int) -> bool:
        """Whether shot number ``index`` is there already; it then counts as written."""
        name = frame_name(index)
        path = self.path / name
        if not path.is_file():
            return False
        actual = checksum(path)
        same = self._known[name] == actual if name in self._known else self._is_ours(path, index)
        if same:
            self._note(name, actual)
        return same

    def write_frame(self, index: int, channels: Channels, metadata: Metadata) -> None:
        """Write one shot, whole or not at all.

        Parameters
        ----------
        index
            its number.
        channels, metadata
            of its file, (rows, columns) each.
        """
        self.write(frame_name(index), channels, {**self._identity(index, channels), **metadata})

    def write_truth(self, reflectance: FloatArray, board: float, standard_error: FloatArray | None = None) -> None:
        """Write the truth.

        Parameters
        ----------
        reflectance, board
            (n, n), relative to a board of that reflectance.
        standard_error
            (n, n) of it, where known.
        """
        self.write(TRUTH, *_truth(reflectance, board, standard_error))

    def write(self, name: str, channels: Channels, metadata: Metadata) -> None:
        """Write a file of the run.

        Parameters
        ----------
        name
            of the file.
        channels, metadata
            of it, (rows, columns) each.
        """
        write_frame(self.path / name, channels, metadata)
        self._note(name, checksum(self.path / name))

    def finish(self, manifest: RunManifest) -> Capture:
        """Write the ``manifest`` of the finished run, with checksums; the capture that lies there."""
        checksums = dict(sorted(self._checksums.items()))
        manifest = manifest.model_copy(update={"status": "complete", "checksums": checksums})
        write_manifest(self.path, manifest)
        return Capture(manifest, self.path)

    def _note(self, name: str, value: str) -> None:
        with self._lock:
            self._checksums[name] = value

    def _is_ours(self, path: Path, index: int) -> bool:
        try:
            channels, metadata = read_frame(path)
        except MitsimError:
            return False
        return all(metadata.get(key) == value for key, value in self._identity(index, channels).items())

    def _identity(self, index: int, channels: Channels) -> dict[str, Value]:
        """What tells a frame from one of another run, another place in this one, or one that was damaged."""
        return {"run": self.head.configuration_sha256, "index": index, "pixels_sha256": _pixels(channels)}


def _truth(
    reflectance: FloatArray, board: float, standard_error: FloatArray | None
) -> tuple[dict[str, Channel], Metadata]:
    channels: dict[str, Channel] = {"reflectance": reflectance.astype(np.float32)}
    if standard_error is not None:
        channels["standard_error"] = standard_error.astype(np.float32)
    return channels, {"board_reflectance": board}


def _size(shape: tuple[int, ...]) -> str:
    return "x".join(map(str, shape))


def _pixels(channels: Channels) -> str:
    """SHA-256 of the channels' names and values: in an interrupted run no manifest holds checksums of files yet."""
    digest = hashlib.sha256()
    for name, values in sorted(channels.items()):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


@contextmanager
def claimed(path: Path, head: RunHead, resume: bool) -> Iterator[RunFolder]:
    """A folder for a run, checked before any work; if that fails before writing, a new folder is removed.

    Parameters
    ----------
    path
        of the folder.
    head
        the configuration of the run.
    resume
        whether the folder may hold an unfinished or finished run of the same configuration.

    Raises
    ------
    MitsimError
        for a place that cannot be written, that holds something else, or, with ``resume``, another configuration.
    """
    known: Mapping[str, str] = {}
    again = resume and (path / MANIFEST).is_file()
    if again:
        known = _checked(path, head)
    with output_folder(path, overwrite=again) as folder:
        yield RunFolder(folder, head, known)


def _checked(path: Path, head: RunHead) -> Mapping[str, str]:
    """Checksums of the frames of a finished run of the same configuration; none of an interrupted one."""
    before = read_head(path)
    if before.configuration_sha256 != head.configuration_sha256:
        changed = [key for key, value in head.configuration.items() if before.configuration.get(key) != value]
        raise MitsimError(
            f"resume=True: {path} holds a run of another configuration ({', '.join(changed) or 'unknown'} differ); "
            "use the same options, or another folder"
        )
    return read_manifest(path, RunManifest).checksums if before.status == "complete" else {}

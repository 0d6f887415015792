"""Captures in memory and on disk, behind one interface."""

from __future__ import annotations

import hashlib
import math
import shutil
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from mitsim.core import colour_files, manifests
from mitsim.core.arrays import FloatArray
from mitsim.core.colour_files import MosaicManifest
from mitsim.core.configuration import Drawn, takes, validate
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, cut
from mitsim.core.exr import Channel, Channels, Metadata, checksum, finite_channel, read_frame, verify, write_frame
from mitsim.core.files import output_folder, remove_page
from mitsim.core.images import CommonFactor, card, from_above, normalise, size_of, span
from mitsim.core.manifests import MANIFEST, ClosingKind, Digital, RunHead, RunManifest

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from xarray import Dataset

Memory = Mapping[str, tuple[Channels, Metadata]]
"""Channels and metadata by file name."""
_SHOWN = 3
_EVERY = 8
"""Stride of rows and columns that distinguish frames: 4096 noisy numbers of 512 x 512 pixels."""
_CLIPPED, _UNLIKELY, _LEVELS = 10, 20.0, 16
"""Clipping needs 10 readings at a frame's largest number, with -log of the chance probability above 20 (2e-9), compared
with at most 16 numbers below."""


class Capture:
    """All shots of one pattern family, in memory or in their folder.

    Attributes
    ----------
    manifest
        Projected patterns, and how the frames are read.
    folder
        Folder of the files; None for a capture in memory. Frames are read when they are first requested.
    """

    def __init__(self, manifest: RunManifest, folder: Path | None = None, memory: Memory | None = None) -> None:
        """Make a capture from a folder, or from channels and metadata by file name in ``memory``."""
        self.manifest, self.folder = manifest, folder
        self._memory: Memory = memory or {}

    @property
    def name(self) -> str:
        """Return the folder, or the name of a capture in memory for messages."""
        return str(self.folder) if self.folder else "the capture"

    @cached_property
    def dn(self) -> Channel:
        """Return (shots, rows, columns) digital numbers, uint32; float32 for a sensor without an ADC."""
        return self._stack("DN")

    @cached_property
    def electrons(self) -> Channel | None:
        """Return (shots, rows, columns) expected photoelectrons; None for a real camera."""
        first = self.manifest.patterns.captures[0].file
        return self._stack("electrons") if "electrons" in self.read(first)[0] else None

    @cached_property
    def truth(self) -> FloatArray | None:
        """Return the (n, n) apparent reflectance relative to :attr:`truth_board`; None for a real camera."""
        return self._channel(TRUTH, "reflectance") if self._has_truth else None

    @cached_property
    def truth_standard_error(self) -> FloatArray | None:
        """Return the (n, n) sampling error of :attr:`truth`; None if unknown, as in version 0.4.0."""
        known = self.truth is not None and "standard_error" in self.read(TRUTH)[0]
        return self._channel(TRUTH, "standard_error") if known else None

    @property
    def truth_board(self) -> float | None:
        """Return the reflectance of the board that counts as 1 in :attr:`truth`, if known."""
        board = None if self.truth is None else self.read(TRUTH)[1].get("board_reflectance")
        return None if board is None else float(board)

    @property
    def exposure_s(self) -> float:
        """Return the exposure of every frame [s]."""
        return self.manifest.digital.exposure_s

    @property
    def plan(self) -> dict[str, Any] | None:
        """Return the effect plan in the manifest; None for a real camera."""
        return self.manifest.plan

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return the reasons why the capture is flagged."""
        return self.manifest.warnings

    @cached_property
    def ambient(self) -> Ambient | None:
        """Return the light that is subtracted from every frame except signed pairs; None without an ambient frame."""
        if self.manifest.ambient_frame is None:
            return None
        block, digital = self.manifest.ambient_frame, self.manifest.digital
        rate = digital.rate(self._channel(block.file, "DN"))
        return Ambient(rate, np.maximum(digital.variance(rate), 0.0) / block.shots, block.shots)

    @cached_property
    def closing(self) -> ClosingFrame | None:
        """Return the closing frame, or None if none was taken; MitsimError if it is missing or damaged."""
        block = self.manifest.closing_frame
        if block is None:
            return None
        digital = self.manifest.digital.model_copy(update={"exposure_s": block.exposure_s})
        dn = self._channel(block.file, "DN")
        light, end = digital.rate(dn), digital.saturation_dn
        signed = any(shot.sign for shot in self.manifest.patterns.captures)
        full = 0 if end is None else int(np.count_nonzero(dn >= end))
        own = light if signed else self._projector_part(light)
        return ClosingFrame(block.kind, own, np.maximum(digital.variance(light), 0.0), full)

    @cached_property
    def patterns(self) -> tuple[FloatArray, FloatArray]:
        """Return P_L (n, K) and P_R (n', K')."""
        return self.manifest.patterns.matrices

    def measurements(self, shape: tuple[int, int] | None = None) -> Iterator[tuple[FloatArray, int, int]]:
        """Yield (frame, i, j) of every pattern, see :meth:`pattern_measurements`."""
        for each in self.pattern_measurements(shape):
            yield each.frame, each.row, each.column

    def pattern_measurements(self, shape: tuple[int, int] | None = None) -> Iterator[Measurement]:
        """Yield the measurement of every pattern, read one at a time.

        Signed patterns give the difference of their halves; other frames lose the ambient frame, if one was taken.
        MitsimError for a frame that is missing, damaged, not finite, or not of the required ``shape``.
        """
        digital = self.manifest.digital
        waiting: dict[tuple[int, int], Measurement] = {}
        for shot in self.manifest.patterns.captures:
            index = (shot.row, shot.column)
            dn = self._channel(shot.file, "DN")
            if dn.shape != (shape or dn.shape):
                raise MitsimError(
                    f"{(self.folder or Path()) / shot.file}: the frame is {size_of(dn)}, but the calibration's are "
                    f"{'x'.join(map(str, shape or ()))}; calibrate this camera"
                )
            light = digital.rate(dn)
            own = light * shot.sign if shot.sign else self._projector_part(light)
            top, end = float(dn.max()), digital.saturation_dn
            full = int(np.count_nonzero(dn >= end)) if end is not None and top >= end else 0
            clipped = 0 if full else clipped_readings(dn, top, digital)
            # Identical frames share a digest; constant frames have none.
            some = np.ascontiguousarray(dn[::_EVERY, ::_EVERY])
            digest = 0 if (some == some.flat[0]).all() else 1 + zlib.crc32(some.tobytes())
            half = Measurement(own, *index, light, 1, full, (digest,), (clipped,))
            if shot.sign and index not in waiting:
                waiting[index] = half
                continue
            yield waiting.pop(index) + half if shot.sign else half

    def _projector_part(self, light: FloatArray) -> FloatArray:
        if self.ambient is None:
            return light
        ambient = self.ambient.rate
        if ambient.shape != light.shape:
            raise MitsimError(
                f"{self.name}: the ambient frame is {size_of(ambient)}, but the frames are {size_of(light)}; "
                "take it with the same camera"
            )
        return light - ambient

    @property
    def files(self) -> tuple[str, ...]:
        names = [*(shot.file for shot in self.manifest.patterns.captures), *self.manifest.others.values()]
        return (*names, TRUTH) if self._has_truth else tuple(names)

    @check_arguments
    def read(self, name: str) -> tuple[Channels, Metadata]:
        """Return channels and metadata of one of the :attr:`files`; MitsimError if it is missing or damaged."""
        if name not in self._memory if self.folder is None else Path(name).name != name or "\0" in name:
            raise ArgumentError("name", f"{cut(repr(name))}: is no file of this capture; see files")
        if self.folder is None:
            return self._memory[name]
        verify(self.folder, name, self.manifest.checksums, "capture it again with resume=True")
        return read_frame(self.folder / name)

    @cached_property
    def fingerprint(self) -> str:
        """Return a SHA-256 that captures of the same frames share.

        Simulated captures share it in memory and on disk, captures of a real camera only in the same folder.
        """
        manifest = self.manifest
        # Fields that are not stated are left out, so that folders of 0.4.0 keep their fingerprints.
        digest = hashlib.sha256(manifest.digital.model_dump_json(exclude_defaults=True).encode())
        digest.update(manifest.patterns.model_dump_json().encode() + manifest.configuration_sha256.encode())
        files = [shot.file for shot in manifest.patterns.captures]
        for other in (manifest.ambient_frame, manifest.closing_frame):
            if other is not None:
                digest.update(other.model_dump_json().encode())
                files.append(other.file)
        for file in files:
            if self.folder and not (manifest.configuration_sha256 and file in manifest.checksums):
                verify(self.folder, file, {}, "")  # no link out of it
                digest.update(checksum(self.folder / file).encode())
            elif not self.folder and not manifest.configuration_sha256:
                digest.update(self.read(file)[0]["DN"].tobytes())
        return digest.hexdigest()

    def summary(self) -> dict[str, Any]:
        """Return the facts that the command line reports; unknown ones are None."""
        manifest = self.manifest
        # The second, fourth and last are of plans of earlier versions.
        planned = "accuracy", "asked_seconds", "predicted_seconds", "predicted_range", "colour"
        known = (
            "mc_error", "total_error", "total_error_bound", "total_error_of_projector",
            "mc_to_sensor_noise", "sensor_noise", "heaviest_group", "truth_error", "lost_light",
            "seconds", "kernels", "predicted_memory_bytes", "warnings",
        )  # fmt: skip
        others = {"ambient_frame": manifest.ambient_frame, "closing_frame": manifest.closing_frame}
        return {
            "frames": len(manifest.patterns.captures),
            "shape": self._channel(manifest.patterns.captures[0].file, "DN").shape,
            "variant": manifest.configuration.get("variant"),
            "seed": manifest.configuration.get("seed"),
            "output": None if self.folder is None else str(self.folder),
            "exposure_s": self.exposure_s,
            **{name: (manifest.plan or {}).get(name) for name in planned},
            **{name: None if frame is None else frame.model_dump() for name, frame in others.items()},
            **{name: getattr(manifest, name) for name in known},
        }

    @check_arguments
    def save(self, folder: Path | str) -> Path:
        """Write the RUN folder of `mitsim capture` to a new or empty ``folder`` and return it.

        MitsimError if the folder holds something, or cannot be written.
        """
        folder = Path(folder)
        with claim_run(folder, self.manifest, resume=False) as run:
            if self.folder is not None:
                for name in (*self.files, MANIFEST):
                    if (self.folder / name).is_file():
                        shutil.copyfile(self.folder / name, folder / name)
            else:
                run.begin()
                for index, name in enumerate(self.files):
                    if name == frame_name(index):
                        run.write_frame(index, *self._memory[name])
                    else:
                        run.write(name, *self._memory[name])
                run.finish(self.manifest)
        return folder

    @takes(Drawn)
    def plot(
        self, shot: int = 0, quantity: Literal["dn", "electrons", "truth"] = "dn", ax: Axes | None = None, **figure: Any
    ) -> Axes:
        """Draw a frame, or the truth, with a colour bar, and return the axes.

        Parameters
        ----------
        shot
            Number of the frame, from 0; ignored for the truth.
        quantity
            ``dn``, digital numbers; ``electrons``, expected photoelectrons; ``truth``, apparent reflectance.
        ax
            Matplotlib axes; None: a new figure's.

        Raises
        ------
        MitsimError
            for a shot that does not exist, or a quantity that a real camera does not have.
        """
        return from_above("report.plots", "draw_shot")(self, shot, quantity, ax, **figure)

    def to_xarray(self) -> Dataset:
        """Return frames, expected electrons and truth, if known, as an ``xarray.Dataset`` with coordinates.

        MitsimError if xarray, an extra, is not installed.
        """
        return from_above("exchange.other_programs", "label_capture")(self)

    def __repr__(self) -> str:
        return f"Capture({self.manifest.patterns.family or 'patterns'}: {self._size}, {self.folder or 'in memory'})"

    def _repr_html_(self) -> str:
        pictures = {}
        for index, shot in enumerate(self.manifest.patterns.captures[:_SHOWN]):
            frame = self._channel(shot.file, "DN")
            caption = f"shot {index}, pattern ({shot.row}, {shot.column})\n{span(frame, 'DN')}"
            pictures[caption] = normalise(frame)
        truth = {} if self.truth is None else {"truth\nreflectance 0 to 1": self.truth}
        title = f"Capture: {self.manifest.patterns.family or 'patterns'}"
        rows = {"frames": self._size, "exposure": f"{self.exposure_s:.3g} s each", "place": self.folder or "memory"}
        return card(title, {**pictures, **truth}, self.warnings, rows)

    @property
    def _has_truth(self) -> bool:
        return TRUTH in self._memory if self.folder is None else (self.folder / TRUTH).is_file()

    @property
    def _size(self) -> str:
        shots = self.manifest.patterns.captures
        rows, columns = self._channel(shots[0].file, "DN").shape
        return f"{len(shots)} shots of {rows} x {columns} pixels"

    def _channel(self, name: str, channel: str) -> FloatArray:
        return finite_channel(self.read(name)[0], channel, self.folder / name if self.folder else Path(name))

    def _stack(self, channel: str) -> Channel:
        shots = self.manifest.patterns.captures
        stack: Channel = np.array([self.read(shot.file)[0][channel] for shot in shots])
        if self.folder is None and isinstance(self._memory, dict):  # one copy: the shots become views of the stack
            known = self._memory.copy()
            for shot, values in zip(shots, stack, strict=True):
                channels, metadata = known[shot.file]
                known[shot.file] = {**channels, channel: values}, metadata
            self._memory = known
        return stack


@check_arguments
def load_run(folder: Path | str) -> Capture:
    """Return the capture in a RUN folder; MitsimError if it is not complete."""
    return Capture(manifests.read_manifest(Path(folder), RunManifest), Path(folder))


def clipped_readings(dn: FloatArray, top: float, digital: Digital) -> int:
    """Return the number of readings at the largest number, ``top``, if noise makes so many unlikely; else 0.

    Without clipping, a frame's largest number is not more frequent than the numbers just below it.
    """
    count = int(np.count_nonzero(dn == top))
    if not _CLIPPED <= count < dn.size:
        return 0
    variance = float(digital.variance(digital.rate(np.array(top))))
    deviation = math.sqrt(max(variance, 0.0)) * digital.exposure_s * digital.gain_dn_per_e
    (common := CommonFactor()).add(dn)
    step = max(digital.step_dn, float(common.factor)) if digital.step_dn else 0.0
    levels = _LEVELS if not step else min(int(deviation / step), _LEVELS)
    below = int(np.count_nonzero(dn > top - (levels + 0.5) * (step or deviation / _LEVELS))) - count
    share, least = count / (count + below), 1 / (1 + levels)
    if share <= least:
        return 0
    # The binomial tail after Chernoff (1952).
    unlikely = count * math.log(share / least) + (below * math.log((1 - share) / (1 - least)) if below else 0.0)
    return count if unlikely > _UNLIKELY else 0


# -------- Measurements from the shots of one pattern


@dataclass(frozen=True, eq=False)
class Ambient:
    """Ambient light, which is subtracted from the frames of a run.

    Attributes
    ----------
    rate
        (rows, columns) mean over the shots [electrons/s].
    variance
        (rows, columns) noise variance of that mean [(electrons/s)^2]; the noise itself is the same in all frames.
    """

    rate: FloatArray
    variance: FloatArray
    shots: int


@dataclass(frozen=True, eq=False)
class ClosingFrame:
    """Frame that was taken after all others to check that lamp, camera and scene stayed the same.

    Attributes
    ----------
    light
        (rows, columns) [electrons/s] without black level and dark current, and without ambient light unless the
        patterns
        are signed.
    variance
        (rows, columns) noise variance [(electrons/s)^2].
    saturated
        Readings at the full well or the ADC's end.
    """

    kind: ClosingKind
    light: FloatArray
    variance: FloatArray
    saturated: int


@dataclass(frozen=True, eq=False)
class Measurement:
    """Measurement under one pattern (i, j), which is ``row``, ``column``.

    Attributes
    ----------
    frame
        (rows, columns) [electrons/s]: difference of the halves of a signed pattern, otherwise without ambient light.
    light
        (rows, columns) [electrons/s] sum of the shots as read, which determines shot noise.
    saturated
        Readings at the full well or the ADC's end.
    digests
        Hash of each shot, different for independent readings; 0 for a constant frame.
    clipped
        For each shot, readings at its largest number, below the end of the range, if noise makes so many unlikely; else
        0.
    """

    frame: FloatArray
    row: int
    column: int
    light: FloatArray
    shots: int
    saturated: int
    digests: tuple[int, ...] = ()
    clipped: tuple[int, ...] = ()

    def __add__(self, other: Measurement) -> Measurement:
        """Combine both halves of a signed pattern."""
        summed = ("frame", "light", "shots", "saturated", "digests", "clipped")
        sums = {name: getattr(self, name) + getattr(other, name) for name in summed}
        return replace(self, **sums)

    @property
    def power(self) -> float:
        """Return the sum of squares of the shots [(electrons/s)^2]."""
        # For halves p and q, p^2 + q^2 = ((p - q)^2 + (p + q)^2) / 2.
        halves = (self.light,) if self.shots == 1 else (self.frame, self.light)
        return float(sum(np.vdot(values, values) for values in halves)) / len(halves)


# -------- A run behind colour filters, in memory or in its folder
# The folder is a RUN folder of the frames, with colour.json, and ``638nm/truth.exr`` for each line.


@dataclass(frozen=True, eq=False)
class LineTruth:
    """Perfect image (n, n) of a spectral line, relative to the ``board`` of that reflectance."""

    reflectance: FloatArray
    standard_error: FloatArray
    board: float


@dataclass(frozen=True, eq=False)
class MosaicCapture:
    """All shots of a family, seen through a mosaic of colour filters.

    Attributes
    ----------
    shots
        Frames; their own truth is the mean of the lines, weighted by the light that all pixels together receive.
    manifest
        Lines, filters, and the light that each filter passes.
    truths
        Perfect image of each line by name; none for a real camera.
    """

    shots: Capture
    manifest: MosaicManifest
    truths: Mapping[str, LineTruth]

    @property
    def weights(self) -> FloatArray:
        """Return (4, lines) electrons per photon of each of 2 x 2 pixels, row by row."""
        return np.array(self.manifest.weights, dtype=np.float64)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return the reasons why the capture is flagged."""
        return self.shots.warnings

    def truth(self, board: float | None = None) -> FloatArray | None:
        """Return the (n, n, lines) truth relative to a ``board`` of that reflectance, or None."""
        if not self.truths:
            return None
        each = (self.truths[name] for name in self.manifest.names)
        return np.stack([one.reflectance * (one.board / (board or one.board)) for one in each], axis=-1)

    @check_arguments
    def save(self, folder: Path | str) -> Path:
        """Write the folder of `mitsim capture --colour mosaic` to a new or empty ``folder`` and return it.

        MitsimError if the folder holds something, or cannot be written.
        """
        self.write_lines(path := self.shots.save(folder))
        return path

    def write_lines(self, folder: Path) -> None:
        for name, truth in self.truths.items():
            with output_folder(folder / name, overwrite=True) as place:
                Recorder(place).write_truth(truth.reflectance, truth.board, truth.standard_error)
        colour_files.write_colours(folder, self.manifest)

    def summary(self) -> dict[str, Any]:
        """Return the facts that the command line reports: the keys of a capture, and of colour.json."""
        return {**self.manifest.model_dump(), **self.shots.summary()}

    def __repr__(self) -> str:
        return f"MosaicCapture({', '.join(self.manifest.names)} behind {self.manifest.mosaic}: {self.shots!r})"

    def _repr_html_(self) -> str:
        return self.shots._repr_html_()


@check_arguments
def load_mosaic(folder: Path | str) -> MosaicCapture:
    """Return the run behind colour filters in ``folder``; MitsimError if it is not complete."""
    folder = Path(folder)
    manifest = cast("MosaicManifest", colour_files.read_colours(folder, colour_files.MOSAIC))
    truths = {}
    for name in manifest.names:
        if (path := folder / name / TRUTH).is_file():
            channels, metadata = read_frame(path)
            image, error = (finite_channel(channels, key, path) for key in ("reflectance", "standard_error"))
            board = metadata.get("board_reflectance")
            truths[name] = LineTruth(image, error, 1.0 if board is None else float(board))
    return MosaicCapture(load_run(folder), manifest, truths if len(truths) == len(manifest.names) else {})


# -------- Shots of a run as they are exposed

TRUTH, AMBIENT, CLOSING = "truth.exr", "ambient.exr", "closing.exr"


def frame_name(index: int) -> str:
    return f"frame_{index:05d}.exr"


class Recorder:
    """Keeper of a run's files, from any thread: in memory, or in the folder that :func:`claim_run` claims.

    On resume a frame of a folder is kept if its checksum is in a finished run's manifest or, in an interrupted run, if
    it has this run's digest, and its pixels have the checksum in its metadata.
    """

    def __init__(
        self, folder: Path | None = None, head: RunHead | None = None, known: Mapping[str, str] | None = None
    ) -> None:
        self.folder, self.head, self._known = folder, head or RunHead(), known or {}
        self.files, self._checksums = dict[str, tuple[Channels, Metadata]](), dict[str, str]()

    def begin(self) -> None:
        """Begin to write after all input was checked."""
        if self.folder is not None:
            remove_page(self.folder)
            configuration, digest = self.head.configuration, self.head.configuration_sha256
            head = RunHead(status="incomplete", configuration=configuration, configuration_sha256=digest)
            manifests.write_manifest(self.folder, head)

    def keeps(self, index: int) -> bool:
        """Return True if shot ``index`` exists already, and count it as written."""
        name = frame_name(index)
        if self.folder is None or not (path := self.folder / name).is_file():
            return False
        actual = checksum(path)
        if name in self._known:
            same = self._known[name] == actual
        else:
            try:
                channels, metadata = read_frame(path)
            except MitsimError:
                return False
            same = self._identity(index, channels).items() <= dict(metadata).items()
        if same:
            self._checksums[name] = actual
        return same

    def write(self, name: str, channels: Channels, metadata: Metadata) -> None:
        if self.folder is None:
            self.files[name] = channels, metadata
        else:
            self._checksums[name] = write_frame(self.folder / name, channels, metadata)

    def write_frame(self, index: int, channels: Channels, metadata: Metadata) -> None:
        identity = {} if self.folder is None else self._identity(index, channels)
        self.write(frame_name(index), channels, {**identity, **metadata})

    def write_truth(self, reflectance: FloatArray, board: float, standard_error: FloatArray | None = None) -> None:
        known = {"reflectance": reflectance, "standard_error": standard_error}
        channels = {name: values.astype(np.float32) for name, values in known.items() if values is not None}
        self.write(TRUTH, channels, {"board_reflectance": board})

    def finish(self, manifest: RunManifest) -> Capture:
        if self.folder is None:
            return Capture(manifest, None, dict(sorted(self.files.items())))
        checksums = dict(sorted(self._checksums.items()))
        manifest = manifest.model_copy(update={"status": "complete", "checksums": checksums})
        manifests.write_manifest(self.folder, manifest)
        return Capture(manifest, self.folder)

    def _identity(self, index: int, channels: Channels) -> Metadata:
        """Return the metadata that identify a frame of an interrupted run, whose manifest has no checksums yet."""
        digest = hashlib.sha256()
        for name, values in sorted(channels.items()):
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(values).data)
        return {"run": self.head.configuration_sha256, "index": index, "pixels_sha256": digest.hexdigest()}


@contextmanager
def claim_run(path: Path, head: RunHead, resume: bool) -> Iterator[Recorder]:
    """Claim a folder for a run; a new folder is removed if the run fails before writing.

    ``resume`` allows an earlier run of the same configuration. MitsimError for a place that cannot be written, or that
    holds something else.
    """
    known: Mapping[str, str] = {}
    again = resume and (path / MANIFEST).is_file()
    if again:
        data, place = manifests.resumable(path, "capture"), f"{path}/{MANIFEST}"
        before = validate(RunHead, data, place, manifests.UNVERSIONED)
        if before.configuration_sha256 != head.configuration_sha256:
            raise manifests.other_request(path, "a run", before.configuration, head.configuration)
        if before.status == "complete":
            known = manifests.read_manifest(path, RunManifest).checksums
    with output_folder(path, overwrite=again) as folder:
        yield Recorder(folder, head, known)

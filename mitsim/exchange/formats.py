"""A RUN folder, and perhaps a CAL folder, in; one file, or one folder, of a format that other programs read out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mitsim.core.configuration import locate
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.files import check_apart, check_plain, output_file
from mitsim.core.imagelist import Raw, Wanted, image_files
from mitsim.core.manifests import CalibrationManifest, RunManifest, read_manifest
from mitsim.core.seeds import check_root
from mitsim.core.spectral_manifests import (
    RUN,
    check_lines,
    is_coloured,
    is_mosaic,
    read_colours,
    read_mosaic,
    same_lines,
)
from mitsim.devices.patterns import read_name
from mitsim.devices.sensor import check_exposure, load_sensor
from mitsim.exchange.planes import check_channel

if TYPE_CHECKING:
    from mitsim.exchange.packed import Coloured, Filtered, Packed

    Run = Packed[RunManifest]
    Calibration = Packed[CalibrationManifest]
    ColouredRun = Coloured[RunManifest] | Filtered
    ColouredCalibration = Coloured[CalibrationManifest]


Written = tuple[str, ...]
"""Sentences on what of the run the format does not hold, or how it is used."""


@dataclass(frozen=True)
class Format:
    """A format that runs are exported to.

    Attributes
    ----------
    what
        that a user gets, in a few words.
    kind
        whether it is one file or a folder.
    calibration
        whether a calibration is needed, or may be given.
    write
        from the place, the run, the calibration and a projector's name to what is said about them.
    write_lines
        the same of a coloured run, but for the calibration where there may be none.
    filters
        whether it holds runs behind colour filters.
    """

    what: str
    kind: Literal["file", "folder"]
    calibration: Literal["needed", "optional", "none"]
    write: Callable[[Path, Run, Calibration | None, str | None], Written]
    write_lines: Callable[[Path, Any, ColouredCalibration | None, str | None], Written]
    filters: bool = True


def _hdf5(path: Path, run: Run, calibration: Calibration | None, projector: str | None) -> Written:
    from mitsim.exchange.hdf5 import write_hdf5

    write_hdf5(path, run, calibration)
    return ()


def _hdf5_lines(
    path: Path, run: ColouredRun, calibration: ColouredCalibration | None, projector: str | None
) -> Written:
    from mitsim.exchange.hdf5 import write_hdf5_lines

    write_hdf5_lines(path, run, calibration)
    return ()


def _mat(path: Path, run: Run, calibration: Calibration | None, projector: str | None) -> Written:
    from mitsim.exchange.matlab import ELECTRONS, write_matlab

    write_matlab(path, run, calibration)
    without = () if calibration else ("phi_left and phi_right are left out: no calibration was given",)
    return (*without, f"Left out: {ELECTRONS}")


def _mat_lines(path: Path, run: ColouredRun, calibration: ColouredCalibration | None, projector: str | None) -> Written:
    from mitsim.exchange.matlab import ELECTRONS, write_matlab_lines

    write_matlab_lines(path, run, calibration)
    without = () if calibration else ("phi_left and phi_right are left out: no calibration was given",)
    return (*without, f"Left out: {ELECTRONS}")


def _flatcam(path: Path, run: Run, calibration: Calibration | None, projector: str | None) -> Written:
    from mitsim.exchange.flatcam import write_flatcam
    from mitsim.exchange.matlab import ELECTRONS

    if calibration is not None:  # what export_run has seen to
        write_flatcam(path, run, calibration)
    return (f"Left out: {ELECTRONS}",)


def _flatcam_lines(
    path: Path, run: Coloured[RunManifest], calibration: ColouredCalibration | None, projector: str | None
) -> Written:
    from mitsim.exchange.flatcam import write_flatcam_lines
    from mitsim.exchange.matlab import ELECTRONS

    if calibration is not None:  # what export_run has seen to
        write_flatcam_lines(path, run, calibration)
    return (f"Left out: {ELECTRONS}",)


def _png(path: Path, run: Run, calibration: Calibration | None, projector: str | None) -> Written:
    from mitsim.exchange.pictures import write_pngs

    return write_pngs(path, run, projector)


def _png_lines(
    path: Path, run: Coloured[RunManifest], calibration: ColouredCalibration | None, projector: str | None
) -> Written:
    from mitsim.exchange.pictures import write_pngs_lines

    return write_pngs_lines(path, run, projector)


def _torch(path: Path, run: Run, calibration: Calibration | None, projector: str | None) -> Written:
    from mitsim.exchange.tensors import write_tensors

    write_tensors(path, run, calibration)
    return ()


def _torch_lines(
    path: Path, run: ColouredRun, calibration: ColouredCalibration | None, projector: str | None
) -> Written:
    from mitsim.exchange.tensors import write_tensors_lines

    write_tensors_lines(path, run, calibration)
    return ()


def _deepinv(path: Path, run: Run, calibration: Calibration | None, projector: str | None) -> Written:
    from mitsim.exchange.tensors import extra, write_tensors

    extra("deepinv")
    write_tensors(path, run, calibration)
    return _read_by(path)


def _deepinv_lines(
    path: Path, run: ColouredRun, calibration: ColouredCalibration | None, projector: str | None
) -> Written:
    from mitsim.exchange.tensors import extra

    extra("deepinv")
    _torch_lines(path, run, calibration, projector)
    return _read_by(path)


def _read_by(path: Path) -> Written:
    return (f"Read it by mitsim.exchange.tensors.load_physics({str(path)!r})",)


FORMATS: dict[str, Format] = {
    "hdf5": Format("one HDF5 file, all of RUN and CAL", "file", "optional", _hdf5, _hdf5_lines),
    "mat": Format("the paper's variables, for MATLAB and Octave", "file", "optional", _mat, _mat_lines),
    "flatcam": Format("FlatCam's variables, for its scripts", "file", "needed", _flatcam, _flatcam_lines, False),
    "deepinv": Format("tensors of a deepinv physics", "file", "needed", _deepinv, _deepinv_lines),
    "torch": Format("tensors for torch.load", "file", "optional", _torch, _torch_lines),
    "png": Format("pictures of frames, patterns for a real projector", "folder", "none", _png, _png_lines, False),
}
"""Formats by the name that `--format` takes."""


_ENDINGS = {".h5": ("hdf5",), ".hdf5": ("hdf5",), ".mat": ("mat", "flatcam")}
"""Formats by how names end that `mitsim import` takes them by."""


def export_run(
    run: Path | str,
    format: str,
    output: Path | str,
    calibration: Path | str | None = None,
    overwrite: bool = False,
    projector: str | None = None,
) -> dict[str, Any]:
    """Write a run in a format that other programs read.

    Parameters
    ----------
    run
        RUN folder, a coloured one, or one behind colour filters.
    format
        a key of :data:`FORMATS`.
    output
        file or folder to make.
    calibration
        CAL folder that goes with it.
    overwrite
        whether a file may be replaced.
    projector
        name or TOML file whose raster pictures are drawn for, of `png` alone; None: the run's own.

    Returns
    -------
    dict
        `format`, `output`, `frames` (of all lines), `calibration`, `notes`: what the command line prints.

    Raises
    ------
    MitsimError
        before anything is written, for an unknown format, a missing calibration, a place that holds something or is
        called as one of another format, a folder that is none, or a calibration of other lines; and for a run that the
        format cannot hold.
    """
    if format not in FORMATS:
        raise ArgumentError("format", f"{format!r}: use {', '.join(FORMATS)}")
    chosen = FORMATS[format]
    if projector is not None and format != "png":
        raise ArgumentError("projector", f"{projector}: {format} draws no pictures for one; leave it out")
    if calibration is None and chosen.calibration == "needed":
        raise ArgumentError("calibration", f"is not given, and {format} is of its factors; give a folder of it")
    if calibration is not None and chosen.calibration == "none":
        raise ArgumentError("calibration", f"{calibration}: {format} holds none; leave it out")
    folder, factors, place = Path(run), None if calibration is None else Path(calibration), Path(output)
    if format not in _ENDINGS.get(ending := place.suffix.lower(), (format,)):
        raise MitsimError(
            f"output {place}: {ending} is of {' and '.join(_ENDINGS[ending])}, not of {format}; rename it"
        )
    lines = _lines(folder, factors)
    if is_mosaic(folder) and not chosen.filters:
        able = ", ".join(name for name, other in FORMATS.items() if other.filters)
        raise MitsimError(f"{folder}: is behind colour filters, of which {format} knows nothing; use {able}")
    for line in lines or ("",):  # refused before numpy is imported
        read_manifest(folder if is_mosaic(folder) else folder / line, RunManifest)
        if factors is not None:
            read_manifest(factors / line, CalibrationManifest)
    check_apart(place, [folder, *([factors] if factors else [])])
    with output_file(place, overwrite) if chosen.kind == "file" else nullcontext():
        shots, notes = _write(place, chosen, folder, factors, lines, projector)
    return {
        "format": format,
        "frames": sum(len(part.manifest.patterns.captures) for part in shots),
        "calibration": None if calibration is None else str(calibration),
        "notes": list(notes),
        "output": str(place),
    }


def _write(
    place: Path, chosen: Format, folder: Path, factors: Path | None, lines: Sequence[str], projector: str | None
) -> tuple[list[Run], Written]:
    """Write a run of these ``lines`` to ``place``; returns its parts, and what is said about them."""
    if lines:
        from mitsim.exchange.packed import coloured_calibration, coloured_run, filtered_run, run_parts

        coloured = filtered_run(folder) if is_mosaic(folder) else coloured_run(folder)
        calibrated = None if factors is None else coloured_calibration(factors)
        return [*run_parts(coloured).values()], chosen.write_lines(place, coloured, calibrated, projector)
    from mitsim.exchange.packed import packed_calibration, packed_run

    shots = packed_run(folder)
    return [shots], chosen.write(place, shots, None if factors is None else packed_calibration(factors), projector)


def _lines(run: Path, calibration: Path | None) -> tuple[str, ...]:
    """Names of a run's lines, which are its calibration's too; none of a run that tells none apart."""
    if is_mosaic(run):
        colours = read_mosaic(run)
        if calibration is not None:
            check_lines(colours, str(run), calibration)
        return colours.names
    if not is_coloured(run):
        if calibration is not None and is_coloured(calibration):
            raise ArgumentError("calibration", f"{calibration}: is coloured, but {run} is not; give a line's folder")
        return ()
    return (read_colours(run, RUN) if calibration is None else same_lines(run, calibration)).names


# -------- What a person knows of a real capture in


@dataclass(frozen=True)
class RealCapture:
    """What a person knows of a real capture.

    Attributes
    ----------
    patterns
        name of the family, or `patterns.json` of `mitsim export --format png`.
    camera
        electronics: name of a shipped file, or a TOML file.
    exposure_s
        of every frame [s].
    calibration
        CAL folder of the same camera, which tells its identity and the projector's pixels.
    n
        projector pixels a side, without a calibration.
    black_level_dn
        digital number of a (binned) pixel without charge, where it is another than the camera file's.
    ambient
        frame, or folder of frames, with the projector off.
    ambient_shots
        that the single frame is the mean of.
    raw
        how files without a header are read.
    channel
        plane of a colour sensor's frames that is taken, a key of :data:`mitsim.exchange.planes.PLANES`.
    seed
        of patterns of a `random` family.
    """

    patterns: str
    camera: str
    exposure_s: float
    calibration: Path | None = None
    n: int | None = None
    black_level_dn: float | None = None
    ambient: Path | None = None
    ambient_shots: int | None = None
    raw: Raw | None = None
    channel: str | None = None
    seed: int = 0

    @property
    def wanted(self) -> Wanted:
        """How its files are read."""
        return Wanted(raw=self.raw)

    @property
    def in_file(self) -> bool:
        """Whether the patterns stand in a file."""
        return Path(self.patterns).suffix == ".json"

    def check(self, source: Path) -> None:
        """MitsimError for values that cannot be, and a ``source`` without frames, before any frame is opened."""
        check_exposure(self.exposure_s)
        check_root(self.seed)
        if self.n is not None and self.n < 1:
            raise ArgumentError("projector_pixels", f"{self.n}: give 1 or more, those a side")
        if self.channel is not None:
            check_channel(self.channel)
        if self.ambient_shots is not None and (self.ambient is None or self.ambient_shots < 1):
            raise ArgumentError("ambient_shots", f"{self.ambient_shots}: give 1 or more, of an ambient frame")
        load_sensor(locate(self.camera, "calibration", ".toml"))
        if self.calibration is not None:
            read_manifest(self.calibration, CalibrationManifest)
        elif self.n is None:
            raise ArgumentError(
                "calibration", "is not given, and patterns need its projector; give it, or --projector-pixels"
            )
        if self.in_file:
            check_plain(self.patterns)
        else:
            read_name(self.patterns, self.n)
        image_files(source, self.wanted)

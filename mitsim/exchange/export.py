"""A RUN folder, and perhaps a CAL folder, in; one file, or one folder, of a format that other programs read out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mitsim.core.errors import ArgumentError
from mitsim.core.manifests import CalibrationManifest, RunManifest, read_manifest
from mitsim.core.output import prepare_output

if TYPE_CHECKING:
    from mitsim.exchange.packed import Packed

    Run = Packed[RunManifest]
    Calibration = Packed[CalibrationManifest]
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
    """

    what: str
    kind: Literal["file", "folder"]
    calibration: Literal["needed", "optional", "none"]
    write: Callable[[Path, Run, Calibration | None, str | None], Written]


def _hdf5(path: Path, run: Run, calibration: Calibration | None, projector: str | None) -> Written:
    from mitsim.exchange.hdf5 import write_hdf5

    write_hdf5(path, run, calibration)
    return ()


def _mat(path: Path, run: Run, calibration: Calibration | None, projector: str | None) -> Written:
    from mitsim.exchange.matlab import ELECTRONS, write_matlab

    write_matlab(path, run, calibration)
    without = () if calibration else ("phi_left and phi_right are left out: no calibration was given",)
    return (*without, f"Left out: {ELECTRONS}")


def _flatcam(path: Path, run: Run, calibration: Calibration | None, projector: str | None) -> Written:
    from mitsim.exchange.flatcam import write_flatcam
    from mitsim.exchange.matlab import ELECTRONS

    if calibration is not None:  # what export_run has seen to
        write_flatcam(path, run, calibration)
    return (f"Left out: {ELECTRONS}",)


def _png(path: Path, run: Run, calibration: Calibration | None, projector: str | None) -> Written:
    from mitsim.exchange.pngs import write_pngs

    return write_pngs(path, run, projector)


def _torch(path: Path, run: Run, calibration: Calibration | None, projector: str | None) -> Written:
    from mitsim.exchange.tensors import write_tensors

    write_tensors(path, run, calibration)
    return ()


def _deepinv(path: Path, run: Run, calibration: Calibration | None, projector: str | None) -> Written:
    from mitsim.exchange.tensors import extra, write_tensors

    extra("deepinv")
    write_tensors(path, run, calibration)
    return (f"Read it by mitsim.exchange.tensors.load_physics({str(path)!r})",)


FORMATS: dict[str, Format] = {
    "hdf5": Format("one HDF5 file, all of RUN and CAL", "file", "optional", _hdf5),
    "mat": Format("the paper's variables, for MATLAB and Octave", "file", "optional", _mat),
    "flatcam": Format("FlatCam's variables, for its scripts", "file", "needed", _flatcam),
    "deepinv": Format("tensors of a deepinv physics", "file", "needed", _deepinv),
    "torch": Format("tensors for torch.load", "file", "optional", _torch),
    "png": Format("frames as pictures, patterns for a real projector", "folder", "none", _png),
}
"""Formats by the name that `--format` takes."""


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
        RUN folder.
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
        `format`, `output`, `frames`, `calibration`, `notes`: what the command line prints.

    Raises
    ------
    MitsimError
        before anything is written, for an unknown format, a missing calibration, a place that holds something, or a
        folder that is none; and for a run that the format cannot hold.
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
    # Refused before numpy is imported.
    read_manifest(Path(run), RunManifest)
    if calibration is not None:
        read_manifest(Path(calibration), CalibrationManifest)
    place = Path(output)
    if chosen.kind == "file":
        prepare_output(place, overwrite, "file")
    from mitsim.exchange.packed import packed_calibration, packed_run

    shots = packed_run(Path(run))
    factors = None if calibration is None else packed_calibration(Path(calibration))
    notes = chosen.write(place, shots, factors, projector)
    return {
        "format": format,
        "frames": len(shots.manifest.patterns.captures),
        "calibration": None if calibration is None else str(calibration),
        "notes": list(notes),
        "output": str(place),
    }

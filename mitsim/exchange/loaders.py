"""A file that `mitsim export` wrote in; the RUN and CAL folders that it was made of out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsim.core.errors import ArgumentError
from mitsim.core.files import check_plain, whole_folder
from mitsim.exchange.planes import check_channel

if TYPE_CHECKING:
    from mitsim.core.manifests import CalibrationManifest, RunManifest
    from mitsim.exchange.packed import Coloured, Filtered, Packed


@dataclass(frozen=True, eq=False)
class Loaded:
    """What an exchanged file holds.

    Attributes
    ----------
    run, calibration
        content of the folders, where the file has them.
    left_out
        parts of a run that the file does not hold.
    """

    run: Packed[RunManifest] | Coloured[RunManifest] | Filtered | None
    calibration: Packed[CalibrationManifest] | Coloured[CalibrationManifest] | None
    left_out: tuple[str, ...] = ()


@contextmanager
def _read_hdf5(path: Path, channel: str | None) -> Iterator[Loaded]:
    from mitsim.exchange.hdf5 import open_folders

    if channel is not None:
        raise ArgumentError("channel", f"{channel}: {path} has frames of one; leave it out")
    with open_folders(path) as (run, calibration):
        yield Loaded(run, calibration)


@contextmanager
def _matlab(path: Path, channel: str | None) -> Iterator[Loaded]:
    from mitsim.exchange.flatcam import flatcam_calibration, read_flatcam, read_flatcam_lines
    from mitsim.exchange.matlab import COLOURED, ELECTRONS, FILTERED, names_in, read_matlab, read_matlab_lines

    if channel is not None:
        yield Loaded(None, flatcam_calibration(path, channel))
    else:
        names = names_in(path)
        read: Any = read_matlab_lines if names & {COLOURED, FILTERED} else read_matlab
        if "meas" in names:
            read = read_flatcam_lines if COLOURED in names else read_flatcam
        run, calibration = read(path)
        yield Loaded(run, calibration, (ELECTRONS,))


READERS: dict[str, Callable[[Path, str | None], Any]] = {".h5": _read_hdf5, ".hdf5": _read_hdf5, ".mat": _matlab}
"""What opens a file, by the end of its name."""

_CALLED = {"output": "run", "calibration_output": "calibration"}
"""What the folder of an argument is, in messages."""


def import_file(
    source: Path, output: Path | None, calibration_output: Path | None = None, channel: str | None = None
) -> dict[str, Any]:
    """Write the folders that a file of `mitsim export` holds, each whole or not at all.

    Parameters
    ----------
    source
        the file.
    output
        RUN folder to make; None: only the calibration is wanted.
    calibration_output
        CAL folder to make; None: the file's calibration, if it has one, is not wanted.
    channel
        plane of a real FlatCam's calibration that is taken.

    Returns
    -------
    dict
        `frames` (of all lines), `output`, `calibration_output`, `holds`, `left_out`, `warnings`: what the command line
        prints.

    Raises
    ------
    MitsimError
        for a file that is none or is damaged, a part that it does not hold, or a place that holds something.
    """
    check_plain(source)  # refused before numpy is imported
    if channel is not None:
        check_channel(channel)
    with READERS[source.suffix.lower()](source, channel) as loaded:
        wanted = {"output": (output, loaded.run), "calibration_output": (calibration_output, loaded.calibration)}
        for argument, (place, held) in wanted.items():
            if place is not None and held is None:
                raise ArgumentError(argument, f"{place}: {source} holds no {_CALLED[argument]}; leave this out")
        with ExitStack() as stack:
            folders = [(stack.enter_context(whole_folder(place)), held) for place, held in wanted.values() if place]
            for folder, held in folders:
                held.fill(folder)
    from mitsim.exchange.packed import parts_of, run_parts

    runs = {} if loaded.run is None else run_parts(loaded.run)
    calibrations = {} if loaded.calibration is None else parts_of(loaded.calibration)
    return {
        "frames": sum(len(part.manifest.patterns.captures) for part in runs.values()) if runs else None,
        "output": None if output is None else str(output),
        "calibration_output": None if calibration_output is None else str(calibration_output),
        "holds": [name for name, (_, held) in zip(("run", "calibration"), wanted.values(), strict=True) if held],
        "left_out": list(loaded.left_out),
        "warnings": [
            f"{line}{text}"
            for line, part in calibrations.items()
            for text in part.manifest.warnings
            if calibration_output is not None
        ],
    }

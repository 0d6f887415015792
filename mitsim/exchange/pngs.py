"""A run as PNG files: frames of 16 bits, and its patterns at a projector's own resolution, to show on a real one."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mitsim.core.errors import MitsimError
from mitsim.core.jsonfile import write_json
from mitsim.core.manifests import RunManifest
from mitsim.core.output import whole_folder
from mitsim.exchange.drawn import (
    PATTERNS,
    Raster,
    cells_told,
    described,
    draw,
    frame_name,
    pictures_of,
    write_png,
)
from mitsim.exchange.packed import Packed, shots_of

_LARGEST = 2**16 - 1
"""Of a PNG's numbers."""


def write_pngs(folder: Path, run: Packed[RunManifest], projector: str | None = None) -> tuple[str, ...]:
    """Write the frames of a run, and its patterns as a projector shows them, to a new folder, whole or not at all.

    Parameters
    ----------
    folder
        to make: `frames/`, `patterns/`, `patterns.json`, and `ambient.npy` where an ambient frame was taken.
    run
        with digital numbers of up to 16 bits.
    projector
        name or TOML file; None: the run's own.

    Returns
    -------
    tuple of str
        how the frames are read again, and how large the patterns' cells are.

    Raises
    ------
    MitsimError
        for numbers that PNG cannot hold, patterns that are not of 0, 1 and -1, or a projector of unknown or too few
        pixels.
    """
    manifest = run.manifest
    raster = _raster(run, projector)
    light = pictures_of(manifest.patterns, str(run.place))
    with whole_folder(folder) as place:
        where = draw(place, light, raster, str(run.place))
        (place / "frames").mkdir()
        names = []
        for index, (shot, channels, _) in enumerate(shots_of(run)):
            dn = channels["DN"]
            if dn.dtype != np.uint32 or int(dn.max()) > _LARGEST:
                raise MitsimError(
                    f"{run.place / shot.file}: has {dn.dtype} numbers up to {dn.max():g}, and PNG holds whole ones "
                    f"up to {_LARGEST}; use the format hdf5"
                )
            names.append(frame_name(index))
            write_png(place / "frames" / names[-1], dn.astype(np.uint16))
        if manifest.ambient_frame is not None:
            np.save(place / "ambient.npy", run.read(manifest.ambient_frame.file)[0]["DN"])
        write_json(place / PATTERNS, described(manifest.patterns, names, where))
    again = f"--patterns {folder / PATTERNS} --exposure {manifest.digital.exposure_s!r}"
    if manifest.ambient_frame is not None:
        again += f" --ambient-frame {folder / 'ambient.npy'} --ambient-shots {manifest.ambient_frame.shots}"
    return (
        f"Read again by: mitsim import {folder / 'frames'} {again} --camera NAME --calibration CAL -o RUN",
        f"Patterns in cells of {cells_told(where)}",
    )


def _raster(run: Packed[RunManifest], projector: str | None) -> Raster:
    """That of the ``projector``, or of the one that took part in the ``run``."""
    if projector is not None:
        return Raster.of(projector)
    known = run.manifest.configuration.get("projector_model")
    return Raster.known(known if isinstance(known, dict) else {})

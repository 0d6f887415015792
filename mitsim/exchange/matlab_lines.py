"""A run and a calibration of several lines in; variables of a MATLAB file that say which lines these are, or end in a
line's name, out, and back.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mitsim.core.colours import CALIBRATION, RUN
from mitsim.core.errors import MitsimError, cut
from mitsim.core.manifests import CalibrationManifest, RunManifest
from mitsim.exchange.coloured import Coloured, Filtered, unpacked_colours
from mitsim.exchange.matlab_file import Variables, text_in
from mitsim.exchange.packed import Packed

COLOURED, FILTERED, _CALIBRATED = "colour_run", "mosaic_run", "colour_calibration"
"""Variables that hold the colour.json of a coloured run, of one behind colour filters, and of a calibration."""
_LONGEST_LINE = 31
"""Letters of a line's name: a variable of MATLAB has 63 at most, truth_board_reflectance_ half of them."""


def lines_in(
    variables: Variables,
    folders_in: Callable[[str, Variables], tuple[Packed[RunManifest], Packed[CalibrationManifest] | None]],
    path: Path,
) -> tuple[Coloured[RunManifest], Coloured[CalibrationManifest] | None]:
    """Coloured run and calibration in a file.

    Parameters
    ----------
    variables
        of the file.
    folders_in
        from a line's name and the variables that end in it, without that ending, to its run and calibration.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        for a line that is missing, and as ``folders_in``.
    """
    text = text_in(variables, COLOURED, path)
    colours = unpacked_colours(text, RUN, path)
    held = {name: folders_in(name, own) for name, own in by_line(variables, colours.names, path).items()}
    run = Coloured(colours, text, {name: shots for name, (shots, _) in held.items()})
    return run, calibrations_in(variables, {name: calibration for name, (_, calibration) in held.items()}, path)


def calibrations_in(
    variables: Variables, held: Mapping[str, Packed[CalibrationManifest] | None], path: Path
) -> Coloured[CalibrationManifest] | None:
    """The coloured calibration in a file; None where it holds none.

    Parameters
    ----------
    variables
        of the file.
    held
        the calibration of each line, where there is one, by its name.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        where some line has none.
    """
    if _CALIBRATED not in variables:
        return None
    text = text_in(variables, _CALIBRATED, path)
    colours = unpacked_colours(text, CALIBRATION, path)
    lines = {name: calibration for name, calibration in held.items() if calibration is not None}
    if {*lines} != {*colours.names}:
        raise MitsimError(f"{path}: has calibrations of {', '.join(lines)}, not of {', '.join(colours.names)}")
    return Coloured(colours, text, lines)


def by_line(variables: Variables, names: Sequence[str], path: Path) -> dict[str, dict[str, Any]]:
    """Variables of each line by its name, without their ending.

    Parameters
    ----------
    variables
        of the file.
    names
        of the lines.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        as :func:`endings`.
    """
    return {
        name: {key.removesuffix(end): values for key, values in variables.items() if key.endswith(end)}
        for name, end in endings(names, path).items()
    }


def colours_in(
    run: Coloured[RunManifest] | Filtered, calibration: Coloured[CalibrationManifest] | None
) -> dict[str, Any]:
    """Variables that say of which lines a file is: the colour.json of ``run`` and ``calibration``."""
    variables = {FILTERED if isinstance(run, Filtered) else COLOURED: run.text}
    return variables if calibration is None else {**variables, _CALIBRATED: calibration.text}


def endings(names: Sequence[str], path: Path) -> dict[str, str]:
    """What variables of each line end in, by the line's name: of letters, digits and _, as MATLAB wants it.

    Parameters
    ----------
    names
        of the lines.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        for a name that no variable can end in, or two that are the same to MATLAB.
    """
    ends = {name: "_" + re.sub(r"[^0-9A-Za-z_]", "_", name) for name in names}
    for name in names:
        # Beginning with a digit, they are no end of another variable: truth_standard_error is not of a line `error`.
        if not (name[0].isdigit() and len(name) <= _LONGEST_LINE) or [*ends.values()].count(ends[name]) > 1:
            raise MitsimError(
                f"{path}: a line is called {cut(name)}, which no variable of MATLAB can end in; use the format hdf5"
            )
    return ends

"""`mitsim report`: any folder that mitsim wrote in, its pictures and its page out."""

from __future__ import annotations

from pathlib import Path

from mitsim.core.errors import MitsimError, check_arguments
from mitsim.core.files import read_json
from mitsim.core.spectral_manifests import COLOUR, IMAGE, is_coloured


@check_arguments
def report_folder(folder: Path | str) -> Path:
    """Write the pictures and the page of a folder, from its own files alone; those of before are replaced.

    Parameters
    ----------
    folder
        of ``mitsim capture``, ``calibrate``, ``reconstruct`` or ``import``, or that Python saved.

    Returns
    -------
    Path
        of the page, ``report.html``; its pictures lie in the folder ``pictures`` beside it.

    Raises
    ------
    MitsimError
        for a folder that holds none of these or is damaged, and one that cannot be written.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise MitsimError(f"{folder}: no such folder; give one of mitsim capture, calibrate, reconstruct or import")
    data = read_json(folder / COLOUR) if is_coloured(folder) else {}
    if isinstance(data, dict) and data.get("kind") == IMAGE:
        from mitsim.report.colour_image import report_colours  # it takes long to import

        return report_colours(folder)
    from mitsim.report.folder_page import write_folder

    return write_folder(folder)

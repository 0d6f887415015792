"""`mitsim report`, and the pictures that other verbs make when their work is done."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mitsim.cli.options import Common, Pictured, message_of, verb
from mitsim.cli.screen import finish
from mitsim.core.errors import MitsimError
from mitsim.core.files import PICTURES

if TYPE_CHECKING:
    import numpy.typing as npt


@verb
def report(
    *,
    folder: Annotated[Path, typer.Argument(help="of capture, calibrate, reconstruct or import", metavar="FOLDER")],
    common: Common,
) -> int:
    """Make the pictures and the page of a folder again.

    From its files alone: a run, a calibration or an image.

    $ mitsim report run
    $ mitsim report cal
    """
    made = _page_of(folder)
    return finish(common.as_json, {**made, "output": str(folder)}, [_page_line(made)], ())


def finish_folder(
    options: Pictured, folder: Path, payload: dict[str, Any], lines: Sequence[str], warnings: Sequence[str]
) -> int:
    """Make the pictures and the page of a folder whose work is done, and print the result; the exit status.

    Parameters
    ----------
    options
        of the verb.
    folder
        of the work, which is not lost where they cannot be made: a warning says so.
    payload, lines, warnings
        as for :func:`mitsim.cli.screen.finish`; JSON gains ``report``, null without a page.
    """
    again = f"`mitsim report {folder}` makes them later"
    made, failed = _attempt(options, lambda: _page_of(folder), again)
    said = [] if made is None else [_page_line(made)]
    return finish(options.as_json, {**payload, "report": made}, [*lines, *said], [*warnings, *failed])


def finish_frame(
    options: Pictured,
    frame: tuple[Path, npt.NDArray[Any], str],
    payload: dict[str, Any],
    lines: Sequence[str],
    warnings: Sequence[str],
) -> int:
    """Make a picture beside a file of one frame, and print the result; the exit status.

    Parameters
    ----------
    options
        of the verb.
    frame
        its file, its numbers (rows, columns), or (rows, columns, 3) in colour, and their unit.
    payload, lines, warnings
        as for :func:`mitsim.cli.screen.finish`; JSON gains ``picture``, null without one.
    """

    def make() -> dict[str, Any]:
        from mitsim.report.pages import write_beside

        started = time.perf_counter()
        file, words = write_beside(*frame)
        return {"file": str(file), "shows": words, "seconds": time.perf_counter() - started}

    made, failed = _attempt(options, make, "the frame is kept")
    said = [] if made is None else [f"picture {made['file']}: {made['shows']}"]
    return finish(options.as_json, {**payload, "picture": made}, [*lines, *said], [*warnings, *failed])


def _page_of(folder: Path) -> dict[str, Any]:
    """The page of a ``folder`` and its pictures, for JSON."""
    started = time.perf_counter()
    from mitsim.report.folder_page import report_folder

    page = report_folder(folder)
    pictures = sorted(map(str, (folder / PICTURES).glob("*.png")))
    return {"page": str(page), "pictures": pictures, "seconds": time.perf_counter() - started}


def _page_line(made: dict[str, Any]) -> str:
    return f"Page: {made['page']} (pictures in {made['seconds']:.1f} s)"


def _attempt(
    options: Pictured, make: Callable[[], dict[str, Any]], kept: str
) -> tuple[dict[str, Any] | None, tuple[str, ...]]:
    """What is to be made, unless nobody wants it; where that fails, nothing, and a warning with what is ``kept``."""
    if options.no_pictures:
        return None, ()
    try:
        return make(), ()
    except MitsimError as error:
        return None, (f"pictures: {message_of(error)}; {kept}",)
    except (OSError, MemoryError) as error:
        return None, (f"pictures: {getattr(error, 'strerror', None) or 'out of memory'}; {kept}",)

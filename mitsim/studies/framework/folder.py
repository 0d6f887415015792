"""The folder of a study: its place and the study's name in; the folder, held, out, or a refusal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path
from types import MappingProxyType

from mitsim.core.files import check_output, output_folder, read_json, sweep
from mitsim.studies.names import ALL, PAPER, STUDIES

POINTS = "points"
"""Folder of what the points of a study came to."""
DEMO_FOLDERS, DEMO_PAGE = ("run", "calibration"), "report.html"
"""What `mitsim demo` writes."""
_PARTS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        ALL: (*PAPER, "*.html"),
        "characterise": ("*.png",),
        "demo": (*DEMO_FOLDERS, DEMO_PAGE),
        **{name: ("*.png", "*.csv", f"{name}.html") for name in STUDIES},
    }
)
"""What a study writes beside NAME.json, with wildcards."""
_OF_POINTS = ("*.png", "*.csv", "*.html", POINTS)
"""The same of all others, which are of many points."""


def check_study_folder(output: Path | str, name: str) -> None:
    """Refuse an ``output`` that :func:`study_folder` of the study ``name`` would refuse, before what is slow to import.

    MitsimError as there.
    """
    check_output(output, overwrite=_is_earlier(Path(output), name))


@contextmanager
def study_folder(output: Path | str, name: str) -> Iterator[Path]:
    """The folder ``output`` of the study ``name``, held while the context lasts.

    It is new or empty, or holds an earlier study of that name alone, of which nothing is removed. MitsimError when it
    holds anything else, or cannot be written.
    """
    with output_folder(output, overwrite=_is_earlier(Path(output), name)) as folder:
        sweep(folder)
        yield folder


def _is_earlier(place: Path, name: str) -> bool:
    """Whether an earlier study of a ``name``, whose NAME.json says ``"kind": NAME``, has a ``place`` to itself."""
    head, names = place / f"{name}.json", (f"{name}.json", ".*", *_PARTS.get(name, _OF_POINTS))
    found = read_json(head) if head.is_file() else None
    if not isinstance(found, dict) or found.get("kind") != name:
        return False
    return all(any(fnmatch(item.name, known) for known in names) for item in place.iterdir())

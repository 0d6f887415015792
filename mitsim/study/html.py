"""What every page is made by: a template and what it shows in, one self-contained HTML file out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from mitsim.core.output import whole_file
from mitsim.core.pictures import data_uri
from mitsim.study.typeset import scientific, sentence, typeset

_DPI, _SHOWN_DPI = 220, 110
"""Figures are 8.6 inches wide at most: 946 pixels of the page, in two dots each."""


def rendered(template: str, filters: Mapping[str, Callable[..., str]] | None = None, **shown: Any) -> str:
    """A page as text.

    Parameters
    ----------
    template
        file of ``mitsim/study/templates``.
    filters
        of its own, by name, beside ``sci`` of a number, ``typeset`` of a text and ``sentence`` of a warning.
    **shown
        what it shows, by the names that it has there; one that is missing is an error.
    """
    loader = PackageLoader("mitsim.study")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    own = {"sci": scientific, "typeset": typeset, "sentence": sentence}
    environment.filters.update({**own, **(filters or {})})
    return environment.get_template(template).render(**shown)


def write_html(path: Path, text: str) -> Path:
    """Write a page, all or nothing.

    Parameters
    ----------
    path
        the file.
    text
        of the page.

    Returns
    -------
    Path
        of the file.

    Raises
    ------
    MitsimError
        when it cannot be written.
    """
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
    return path


def shown_figure(figure: Figure) -> tuple[str, int]:
    """A figure for a page.

    Parameters
    ----------
    figure
        drawn.

    Returns
    -------
    tuple of str and int
        its data URI, and how wide it is shown [pixels].
    """
    return figure_uri(figure, _DPI), round(float(figure.get_figwidth()) * _SHOWN_DPI)


def figure_uri(figure: Figure, dots_per_inch: int) -> str:
    """A figure as a data URI.

    Parameters
    ----------
    figure
        drawn.
    dots_per_inch
        of its picture.
    """
    figure.savefig(buffer := BytesIO(), format="png", dpi=dots_per_inch)
    return data_uri(buffer.getvalue())

"""Headline of a result: its main figure and, if it is flagged, the main reason.

Terminal, page and JSON have the headline from here, so that they cannot differ. Every reason is text of the form
``label: details; remedy``, in which details and remedy may be missing.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

_ORIGIN, _NUMBER, _END = map(re.compile, (r"^[Ii]n [^,:;]+, ", r"[-+]?\d[\w.,+-]*", r"[:;.](?:\s|$)"))


def headline(made: str, reasons: Sequence[str] = ()) -> str:
    """Return ``made``, which names the result and its main figure, with the label of the first of the ``reasons``."""
    return f"{made}. Flagged: {_lower(_END.split(reasons[0], maxsplit=1)[0])}" if reasons else made


def frames_headline(runs: Sequence[Mapping[str, Any]], reasons: Sequence[str] = ()) -> str:
    """Return the headline of a capture from each line's ``summary``, with "Imported" for a real camera's frames."""
    (rows, columns), count = runs[0]["shape"][:2], runs[0]["frames"]
    errors = [run["total_error_bound"] for run in runs if run["total_error_bound"] is not None]
    made = f"{'Captured' if errors else 'Imported'} {count} frame{'s' * (count > 1)} of {rows} x {columns} pixels"
    made += f" in each of {len(runs)} lines" if len(runs) > 1 else ""
    return headline(made + (f", total error up to {max(errors):.1e}" if errors else ""), reasons)


def calibration_headline(results: Sequence[Mapping[str, Any]], reasons: Sequence[str] = ()) -> str:
    """Return the headline of a calibration by the result of each line or depth, with the largest factor error."""
    size, errors = results[0].get("n"), list[float]()
    made = f"Calibrated {size} x {size} pixels" if size else "Calibrated"
    kind = "depths" if len({result.get("depth_mm") for result in results}) > 1 else "lines"
    made += f" in each of {len(results)} {kind}" if len(results) > 1 else ""
    for result in results:
        known = (result.get(name) for name in ("phi_error", "predicted_frame_error", "predicted_phi_error"))
        errors += [error for error in known if error is not None][:1]
    return headline(made + (f", factor error {max(errors):.1e}" if errors else ""), reasons)


def image_headline(result: Mapping[str, Any], reasons: Sequence[str] = ()) -> str:
    """Return the headline of an image by its ``result``: PSNR if the truth is known, else the stated uncertainty."""
    (rows, columns), lines = result["shape"], len(result.get("channels", ()))
    made = f"Reconstructed {rows} x {columns} pixels{f' in each of {lines} lines' if lines else ''}"
    if result.get("psnr") is not None:
        made += f", PSNR {result['psnr']:.2f} dB"
    elif result.get("uncertainty") is not None:
        made += f", standard uncertainty {result['uncertainty']:.1e}"
    return headline(made, reasons)


def each_once(found: Mapping[str, Iterable[str]]) -> tuple[str, ...]:
    """Return each reason of several parts once, with the names of its parts unless all have it; "" has no name.

    Reasons that differ in numbers only count as one, with the numbers of the first part. A part that inherits a reason
    from an earlier part is not named again.
    """
    named: dict[str, tuple[str, str, list[str]]] = {}
    for name, reasons in found.items():
        for reason in reasons:
            whole = " ".join(reason.split()).rstrip(".")
            own = _ORIGIN.sub("", whole)
            first, text, names = named.setdefault(_NUMBER.sub("#", own.casefold()), (whole, own, []))
            if name and name not in names and (own == whole or first != text):
                names.append(name)
    every = max(len(found), 2)
    return tuple(
        f"In {' and '.join(names)}, {_lower(text)}" if 0 < len(names) < every else text
        for _, text, names in named.values()
    )


def _lower(text: str) -> str:
    return text[0].lower() + text[1:] if text[1:2].islower() else text

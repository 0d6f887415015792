"""Parts of HTML pages: templates, numbers as text, plans as bars, and pictures of numbers."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.files import write_bytes
from mitsim.core.images import data_uri, grey_png, lightness, png
from mitsim.core.job import size_text
from mitsim.core.parallel import in_threads

if TYPE_CHECKING:
    from jinja2 import Environment
    from matplotlib.figure import Figure

# -------- Pages

_SHOWN_DPI = 110


def render_page(template: str, **shown: Any) -> str:
    """Render a template of ``mitsim/report/templates``; a missing variable is an error."""
    return _environment().get_template(template).render(**shown)


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("mitsim.report")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    filters: dict[str, Any] = {"sci": scientific, "typeset": typeset, "sentence": sentence, "seconds": duration}
    environment.filters.update({**filters, "stages": stages_of})
    return environment


def page_figure(figure: Figure) -> tuple[str, int]:
    """Return a figure as the data URI of an SVG, the same bytes for the same figure, and its width [pixels]."""
    from matplotlib import rc_context

    with rc_context({"svg.hashsalt": "mitsim"}):  # names inside the file; without it they are random
        figure.savefig(buffer := BytesIO(), format="svg", metadata={"Date": None})
    return data_uri(buffer.getvalue(), "svg+xml"), round(float(figure.get_figwidth()) * _SHOWN_DPI)


# -------- Numbers and plain text as pages and figures print them

DASH = "\N{EN DASH}"
_SUPERSCRIPT = str.maketrans("+-0123456789", "⁺⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_TIMES = "\N{MULTIPLICATION SIGN}"
_POWER = re.compile(r"(?<![\w.])(\d+(?:\.\d+)?)e([+-]?\d+)(?![\w.]\w)")
_SIZE = re.compile(r"(?<![\w:.])(\d+(?:\.\d+)?)( ?)x\2(?=\d+(?:\.\d+)?(?![\w:]))")
"""512 x 512 and 3x3, but not dots:7x16."""


def scientific(value: float | None) -> str:
    """Print three digits, or two and a power of ten below 0.01 and from 10,000; None is a dash."""
    if value is None or value == 0.0:
        return DASH if value is None else "0"
    if 1e-2 <= abs(value) < 1e4:
        return f"{value:.0f}" if abs(value) >= 99.95 else f"{value:#.3g}"
    return typeset(f"{value:.1e}")


def duration(value: float) -> str:
    return f"{value:.2f} s" if value < 10 else f"{value:.1f} s" if value < 100 else f"{value:.0f} s"


def round_to_error(value: float, error: float) -> str:
    """Print a number to the second digit of its standard error, else five digits."""
    if not (error > 0 and math.isfinite(error) and math.isfinite(value)):
        return f"{value:.5g}"
    places = 1 - math.floor(math.log10(error))
    return f"{round(value, places) + 0.0:.{max(places, 0)}f}"


def reflectance(value: float) -> str:
    return f"{value:.4f}" if value >= 1e-3 else scientific(value)


def scene_name(scene: Path) -> str:
    return scene.parent.name if scene.name == "scene.xml" else scene.stem


def subject(scene: str, camera: str, file: Path | None = None) -> str:
    """Return scene, camera and date for the title of a page; the date is that of a ``file``, or the present one."""
    moment = time.localtime(None if file is None else file.stat().st_mtime)
    return ", ".join(filter(None, (scene, camera, time.strftime("%Y-%m-%d %H:%M", moment))))


def sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def typeset(text: str) -> str:
    """Replace 4.9e-03 by a power of ten, +- and x in sizes by signs, and um by µm."""

    def power(found: re.Match[str]) -> str:
        mantissa, exponent = found[1], int(found[2])
        if not float(mantissa):
            return "0"
        if mantissa != "1" and 1e-2 <= float(found[0]) < 1e4:  # as ``scientific`` prints it, with the digits it has
            return f"{float(found[0]):.{max(len(mantissa.partition('.')[2]) - exponent, 0)}f}"
        power = f"10{str(exponent).translate(_SUPERSCRIPT)}"
        return power if float(mantissa) == 1 and "." not in mantissa else f"{mantissa}{_TIMES}{power}"

    text = _POWER.sub(power, text).replace("+-", "\N{PLUS-MINUS SIGN}")
    text = _SIZE.sub(rf"\1\2{_TIMES}\2", text)
    return re.sub(r"(?<=[\d\[(] )um\b|(?<=[\[(/])um\b", "\N{GREEK SMALL LETTER MU}m", text)


# -------- Plans, times and plain data on a page

_LEAST_STAGE = 0.01
"""Part of the total time below which a stage has no line of its own."""
_MOST_LISTED = 6


def stages_of(seconds: Mapping[str, float]) -> dict[str, float]:
    """Return the seconds of stages, of all else and in total; stages of little time are in all else."""
    total = seconds.get("total", math.fsum(seconds.values()))
    stages = {name: value for name, value in seconds.items() if name != "total"}
    shown = {name: value for name, value in stages.items() if value >= _LEAST_STAGE * total}
    rest = total - math.fsum(shown.values())
    return shown | ({"all else": rest} if stages and rest > _LEAST_STAGE * total else {}) | {"total": total}


def lines_of(data: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Flatten JSON ``data`` to lines by dotted name, without long lists and missing values."""
    lines: dict[str, str] = {}
    for key, value in data.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            lines |= lines_of(value, f"{name}.")
        elif isinstance(value, Sequence) and not isinstance(value, str):
            plain = not any(isinstance(each, (Mapping, list, tuple)) for each in value)
            if value and plain and len(value) <= _MOST_LISTED:
                lines[name] = ", ".join(map(_text, value))
        elif value is not None:
            lines[name] = size_text(value) if key.endswith("_bytes") else _text(value)
    return lines


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


# -------- Pictures of numbers, with the meaning of black and white

SMALLEST, LARGEST = 512, 1024
_MOST_FRAMES = 64
_MOST_READ = _MOST_FRAMES << 18
"""Pixels that are read for a contact sheet, which takes 0.3 s."""
_GAP = 2


REFLECTANCE = "reflectance (1 = white board)"
_SEQUENTIAL = "#440154", "#3b528b", "#21918c", "#5ec962", "#fde725"
_DIVERGING = "#003c5e", "#0072b2", "#f5f5f5", "#d55e00", "#6e2f00"
_GREY = tuple(f"#{3 * f'{round(255 * level):02x}'}" for level in lightness(np.linspace(0, 1, 9)).tolist())
"""Equal steps of light, as :func:`mitsim.core.images.png` shows them."""
MAPS: dict[str, tuple[tuple[str, ...], float | None]] = {
    "light": (_GREY, None),
    **dict.fromkeys(("uncertainty", "error", "depth", "confidence"), (_SEQUENTIAL, None)),
    "difference": (_DIVERGING, 0.0),
    "chi-square": (_DIVERGING, 1.0),
}
"""Colours of each quantity from its lowest to its highest number, and the number in their middle.

Light and reflectance are grey. Quantities that begin at a lowest number have a sequential map. Quantities that may lie
on either side of an ideal number have a diverging map, in which that number is almost white."""


@dataclass(frozen=True)
class Picture:
    """A picture of numbers for a page.

    Attributes
    ----------
    caption
        What is shown, without the scale.
    colours, ends, unit
        Colours of equal steps and the numbers of the first, of the middle (if it has a meaning) and of the last;
        empty for pictures in colour, whose caption states the scale.
    """

    name: str
    title: str
    caption: str
    data: bytes
    wide: bool = False
    colours: tuple[str, ...] = ()
    ends: tuple[str, ...] = ()
    unit: str = ""

    @classmethod
    def of(
        cls,
        name: str,
        title: str,
        values: npt.NDArray[Any],
        about: str = "",
        unit: str = REFLECTANCE,
        ends: tuple[float | None, float | None] = (0.0, 1.0),
        wide: bool = False,
        quantity: str = "light",
    ) -> Picture:
        """Draw ``values`` in a ``unit`` between the ``ends`` of a scale; an end of None is that of the values.

        ``quantity`` chooses the colours (:data:`MAPS`).
        """
        low, high = (
            float(known(values)) if end is None else end for end, known in zip(ends, (np.min, np.max), strict=True)
        )
        high, (colours, centre) = high if high > low else low + 1.0, MAPS[quantity]
        beyond = 100 * float(np.mean((values < low) | (values > high)))
        cut = f"{beyond:.2g} % of the pixels lie outside the scale" if beyond else ""
        numbers, steps = [low, *([] if centre is None else [centre]), high], np.linspace(0, 1, len(colours))
        levels = np.interp(values, numbers, np.linspace(0, 1, len(numbers)))
        if quantity == "light":
            data = png(levels, LARGEST, SMALLEST)
        else:
            shades = np.array([[*bytes.fromhex(each[1:])] for each in colours]) / 255
            painted = np.stack([np.interp(levels, steps, shade) for shade in shades.T], axis=-1)
            data = grey_png(painted, LARGEST, SMALLEST)
        stated = tuple(f"{end:.0f}" if abs(end) >= 1000 else f"{end:.3g}" for end in numbers)
        return cls(name, title, "; ".join(filter(None, (about, cut))), data, wide, colours, stated, unit)

    @property
    def scale(self) -> str:
        return f"black {self.ends[0]}, white {self.ends[-1]} {self.unit}"

    @property
    def uri(self) -> str:
        return data_uri(self.data)

    def write(self, folder: Path) -> Path:
        path = folder / f"{self.name}.png"
        write_bytes(path, self.data)
        return path


def contact_sheet(read: Callable[[int], FloatArray], count: int, shape: tuple[int, int]) -> Picture:
    """Draw ``count`` frames of a ``shape`` side by side, or as many evenly spaced ones as fit a page.

    ``read`` returns frame i less the black level [DN].
    """
    most = max(1, min(_MOST_FRAMES, _MOST_READ // math.prod(shape)))
    chosen = [number * count // most for number in range(most)] if count > most else [*range(count)]
    columns, frames = math.ceil(math.sqrt(len(chosen))), in_threads(read, chosen)
    rows, white = math.ceil(len(chosen) / columns), max(float(frame.max()) for frame in frames)
    sheet = np.full((rows * (shape[0] + _GAP) - _GAP, columns * (shape[1] + _GAP) - _GAP), white)
    for place, frame in enumerate(frames):
        top, left = place // columns * (shape[0] + _GAP), place % columns * (shape[1] + _GAP)
        sheet[top : top + shape[0], left : left + shape[1]] = frame
    which = f"all {count} frames" if len(chosen) == count else f"{len(chosen)} of {count} frames, evenly spaced"
    about = f"{which}, {columns} in each row, on one scale"
    return Picture.of("frames", "Contact sheet", sheet, about, "DN above the black level", (0.0, white), wide=True)


# -------- Means of the rows of a study

Value = str | int | float | bool | None
_SEEN = 0.05
_CONFIDENCE = 0.95


class Mean(NamedTuple):
    """A mean, its standard error (NaN of a single value), and the number of values."""

    value: float
    error: float
    of: int

    def __str__(self) -> str:
        return format(self)

    def __format__(self, sign: str) -> str:
        """Print the mean with its error; ``sign`` "+" always shows its sign."""
        if math.isnan(self.error):
            return f"{self.value:{sign}.1f}"
        places = 1 if self.error >= _SEEN else 2
        return f"{self.value:{sign}.{places}f} \N{PLUS-MINUS SIGN} {self.error:.{places}f}"

    @property
    def reach(self) -> float:
        """Half of the mean's 95 % confidence interval, by Student's t; NaN of a single value."""
        from scipy.special import stdtrit

        return float(stdtrit(self.of - 1, 1 - (1 - _CONFIDENCE) / 2)) * self.error if self.of > 1 else math.nan

    @classmethod
    def of_numbers(cls, numbers: Sequence[float], what: str) -> Mean:
        """Return the mean of independent ``numbers``; MitsimError that names ``what`` without any."""
        if not numbers:
            raise MitsimError(f"study: nothing was measured of {what}")
        array = np.array(numbers)
        error = float(array.std(ddof=1) / math.sqrt(len(array))) if len(array) > 1 else math.nan
        return cls(float(array.mean()), error, len(array))

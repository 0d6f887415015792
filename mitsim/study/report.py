"""Results of a study in, one self-contained HTML page out: images inside, no script, no link.

`ReportData` says what a page shows; whatever is None or empty is left out, section by section. The page
carries no time of writing, so the same data give the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from mitsim.core.errors import MitsimError
from mitsim.core.output import whole_file
from mitsim.study import plots
from mitsim.study.images import PATTERN_CORNER, figure_png, finite, pattern_png, reflectance_png

Array = NDArray[Any]

_DASH = "\N{EN DASH}"
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Recovery:
    """One reconstruction: (n, n) reflectance, PSNR [dB, peak 1, no fit], SSIM, the lambda it took, and the
    solver's sentence, shown only when it says more than "Solved: ...".
    """

    image: Array
    psnr_db: float
    ssim: float
    lam: float | None = None
    status: str = ""


@dataclass(frozen=True)
class FamilyResult:
    """A pattern family, e.g. name "dots:7", label "49 dots". `patterns`: some (n, n) examples, 0..1 or -1..1.

    `captures` counts frames taken (a signed pattern is two). `idealised` solves the paper's noisy ideal model
    with its own factors, `rendered` the rendered frames with calibrated factors.
    """

    name: str
    label: str
    captures: int
    patterns: tuple[Array, ...] = ()
    singular_values: Array | None = None
    idealised: Recovery | None = None
    rendered: Recovery | None = None


@dataclass(frozen=True)
class CapturedFrame:
    """One frame as the camera gave it: (m, m) DN, with a short label ("49 dots, frame 1 of 49")."""

    label: str
    dn: Array


@dataclass(frozen=True)
class ExposureRow:
    """PSNR in dB of one family under the three exposure conventions; None: not computed."""

    family: str
    equal_peak_db: float | None = None
    equal_frame_db: float | None = None
    equal_total_db: float | None = None


@dataclass(frozen=True)
class CalibrationFacts:
    """What calibration found: scene pixels a side, frames, relative residuals [1], condition of A_L [1]."""

    n: int
    frames: int
    separability_residual: float
    phi_error: float | None
    condition: float
    status: str = ""


@dataclass(frozen=True)
class BudgetRow:
    """One source of error: relative rms of the expected frames [1], and what that number means."""

    name: str
    value: float
    meaning: str


@dataclass(frozen=True)
class EffectRow:
    """One line of the effect plan. `state`: exact, approximate or off; error relative [1], cost in s."""

    name: str
    state: str
    reason: str
    error_if_off: float | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class ReportData:
    """All that one report shows.

    Images are as seen along +z, row 0 at the top; `truth` (n, n) and `render` (any size) are reflectances,
    1 = calibration board. `seconds` maps stages to wall time, in order. `exposure_used` says which convention
    the reconstructions above the table used.
    """

    title: str
    verdict: str
    truth: Array
    scene: str
    verdict_detail: str = ""
    render: Array | None = None
    render_caption: str = ""
    families: tuple[FamilyResult, ...] = ()
    frames: tuple[CapturedFrame, ...] = ()
    exposure: tuple[ExposureRow, ...] = ()
    exposure_used: str = ""
    calibration: CalibrationFacts | None = None
    budget: tuple[BudgetRow, ...] = ()
    accuracy: float | None = None
    effects: tuple[EffectRow, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    configuration: Mapping[str, object] = field(default_factory=dict)
    seeds: Mapping[str, int] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def verdict(best: FamilyResult, baseline: FamilyResult) -> tuple[str, str]:
    """Headline and detail from the rendered results: "49 dots beat uniform by 11.0 dB", and both PSNRs.

    Raises MitsimError when one of the two has no rendered result.
    """
    if best.rendered is None or baseline.rendered is None:
        raise MitsimError(f"report: no rendered result of {best.label} or {baseline.label}; reconstruct both first")
    gain = best.rendered.psnr_db - baseline.rendered.psnr_db
    other = baseline.label[:1].lower() + baseline.label[1:]
    beat = f"{best.label} beat {other} by {gain:.1f} dB"
    headline = beat if gain >= 0 else f"{best.label}: {-gain:.1f} dB below {other}"
    ours, theirs = best.rendered.psnr_db, baseline.rendered.psnr_db
    detail = f"{ours:.1f} against {theirs:.1f} dB PSNR, rendered light and calibrated factors."
    if best.idealised is not None and baseline.idealised is not None:
        ideal = best.idealised.psnr_db - baseline.idealised.psnr_db
        detail += f" The idealised model says {ideal:+.1f} dB."
    return headline, detail


def build_report(report: ReportData, path: Path) -> Path:
    """Write the page to `path`, all or nothing, and return it.

    Raises MitsimError when an image holds values that are not finite or the place cannot be written.
    """
    text = render_html(report)
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
    return Path(path)


def render_html(report: ReportData) -> str:
    """The page as text; `build_report` writes it."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("mitsim.study"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        sci=_scientific,
        db=_decibel,
        seconds=_seconds,
        trouble=_trouble,
        reflectance=reflectance_png,
        pattern=pattern_png,
    )
    page = environment.get_template("report.html")
    return page.render(
        report=report, figures=_figures(report), best=_best(report.families), pattern_corner=PATTERN_CORNER
    )


def _figures(report: ReportData) -> dict[str, Any]:
    """The page's plots as data URIs, by name, where there are data for them; and the total time in s."""
    figures: dict[str, Any] = {"total": report.seconds.get("total", math.fsum(report.seconds.values()))}
    figures["frames"] = [(f.label, figure_png(plots.frame(finite(f.dn, f.label)))) for f in report.frames]
    spectra = {f.label: f.singular_values for f in report.families if f.singular_values is not None}
    if spectra:
        figures["spectra"] = figure_png(plots.singular_values(spectra))
    both = [
        (f.label, f.idealised, f.rendered)
        for f in report.families
        if f.idealised is not None and f.rendered is not None
    ]
    if both:
        figures["quality"] = figure_png(
            plots.quality_bars(
                [label for label, _, _ in both],
                [ideal.psnr_db for _, ideal, _ in both],
                [rendered.psnr_db for _, _, rendered in both],
            )
        )
    positive = {row.name: row.value for row in report.budget if row.value > 0.0}
    if positive:
        figures["budget"] = figure_png(plots.error_bars(positive, report.accuracy))
    figures["stages"] = _stages(report.seconds)
    if figures["stages"]:
        figures["seconds"] = figure_png(plots.seconds_by_stage(figures["stages"]))
    return figures


def _stages(seconds: Mapping[str, float]) -> dict[str, float]:
    """Seconds by stage, and as "not in a stage" what the total holds beside them, where that is more than 1 %."""
    stages = {name: value for name, value in seconds.items() if name != "total"}
    total = seconds.get("total", 0.0)
    rest = total - math.fsum(stages.values())
    if stages and rest > 0.01 * total:
        stages["not in a stage"] = rest
    return stages


def _best(families: tuple[FamilyResult, ...]) -> dict[str, str]:
    """Name of the family of highest PSNR, for each of the two rows of reconstructions."""
    best: dict[str, str] = {}
    for row in ("idealised", "rendered"):
        found = {f.name: getattr(f, row).psnr_db for f in families if getattr(f, row) is not None}
        best[row] = max(found, key=lambda name: found[name]) if found else ""
    return best


def _scientific(value: float | None) -> str:
    """Three digits, a power of ten as a superscript sign; None as a dash."""
    if value is None:
        return _DASH
    if value == 0.0 or 1e-2 <= abs(value) < 1e4:
        return f"{value:.3g}"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa}\N{MULTIPLICATION SIGN}10" + str(int(exponent)).translate(_SUPERSCRIPT)


def _decibel(value: float | None) -> str:
    return _DASH if value is None else f"{value:.1f} dB"


def _seconds(value: float | None) -> str:
    if value is None:
        return _DASH
    return f"{value:.2f} s" if value < 10 else f"{value:.1f} s" if value < 100 else f"{value:.0f} s"


def _trouble(status: str) -> str:
    """The solver's sentence unless it says that nothing is missing: those sentences begin with "Solved: "."""
    return "" if status.startswith("Solved: ") else status

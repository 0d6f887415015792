"""Results of a study in, one self-contained HTML page out: images inside, no script, no link.

`ReportData` says what a page shows; whatever is None or empty is left out, section by section. The page
carries no time of writing, so the same data give the same bytes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.files import write_text
from mitsim.core.images import data_uri, grey_png, lightness
from mitsim.light.plan import PlanRow
from mitsim.metrics import Quality
from mitsim.reconstruct.misfit import chi_square_text
from mitsim.reconstruct.reconstruct import Reconstruction
from mitsim.report import plots
from mitsim.report.pages import (
    DASH,
    Mean,
    PlanChart,
    figure_uri,
    reflectance,
    render_page,
    sentence,
    stages_of,
    total_of,
)
from mitsim.report.plots import FONT, WIDTH, figure_of, panels_of

_PATTERN_CORNER = 40
"""Projector pixels a side that are shown of a pattern, so that single ones can be told apart."""
_SMALLEST = 384
"""Pixels a side of a picture: the width of a column of the page, on a screen of two dots a pixel."""
_FIGURE_DPI = 160
"""Figures are 8.6 inches wide: 1376 pixels, what the page's width shows on the same screen."""
_TELLS_DB = 0.5
"""A gain that counts: a tenth of the squared error."""


@dataclass(frozen=True, eq=False)
class Recovery:
    """One reconstruction: (n, n) reflectance, its quality, the lambda it took, the solver's sentence (shown if it says
    more than "Solved: ..."), and how far to trust it, where that is known."""

    image: FloatArray
    quality: Quality
    lam: float | None = None
    status: str = ""
    trust: Trust | None = None


@dataclass(frozen=True, eq=False)
class FamilyResult:
    """A pattern family, e.g. name "dots:7", label "49 dots"; ``patterns`` are some (n, n) examples, 0..1 or -1..1.

    ``shots`` counts frames (a signed pattern is two). ``idealised`` solves the paper's noisy ideal model with its own
    factors, ``rendered`` the rendered frames with calibrated ones, whose PSNR [dB] by exposure convention is
    ``by_exposure``.
    """

    name: str
    label: str
    shots: int
    patterns: tuple[FloatArray, ...] = ()
    singular_values: FloatArray | None = None
    idealised: Recovery | None = None
    rendered: Recovery | None = None
    by_exposure: Mapping[str, float] = field(default_factory=dict)


class BudgetRow(NamedTuple):
    """One source of error: relative rms of the expected frames [1] (None: unknown), and what that number means."""

    name: str
    value: float | None
    meaning: str


@dataclass(frozen=True, eq=False)
class ReportData:
    """All that one report shows.

    ``truth`` (n, n) and ``render`` (any size) are reflectances, 1 = calibration board, as seen along +z, row 0 at the
    top. The first of the ``families`` is the one that the tiles compare the best with; of the one named ``main`` the
    errors are shown as a picture. ``frames`` are (m, m) [DN] by caption, ``exposure`` says which convention the
    reconstructions used, ``calibration`` is what `calibrate --json`
    says of the session, and its ``status``. ``accuracy`` and ``effects`` are the plan's. ``warnings`` say why the
    results are flagged, at the head of the page. ``error`` is of the expected frames, all in all. ``kernels`` are the
    ``number`` that was compiled, and the ``seconds`` of that.
    """

    title: str
    verdict: str
    truth: FloatArray
    scene: str
    verdict_detail: str = ""
    render: FloatArray | None = None
    families: tuple[FamilyResult, ...] = ()
    main: str = ""
    frames: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)
    exposure: str = ""
    calibration: Mapping[str, Any] | None = None
    budget: tuple[BudgetRow, ...] = ()
    accuracy: float | None = None
    error: float | None = None
    effects: tuple[PlanRow, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    kernels: Mapping[str, float] = field(default_factory=dict)
    configuration: Mapping[str, object] = field(default_factory=dict)
    seeds: Mapping[str, int] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def verdict(best: FamilyResult, baseline: FamilyResult) -> tuple[str, str]:
    """Headline and detail from the rendered results of the ``best`` family and of the ``baseline``: "49 dots beat
    uniform by 11.0 dB", and both PSNRs; "no image" where the ``best`` is none.

    MitsimError when one of the two has no rendered result.
    """
    if best.rendered is None or baseline.rendered is None:
        raise MitsimError(f"report: no rendered result of {best.label} or {baseline.label}; reconstruct both first")
    ours, theirs = best.rendered.quality.psnr_db, baseline.rendered.quality.psnr_db
    if best.name == baseline.name:
        return f"{best.label}: {ours:.1f} dB", "PSNR, rendered light and calibrated factors."
    gain = ours - theirs
    name = baseline.label[:1].lower() + baseline.label[1:]
    beat = f"{best.label} beat {name} by {gain:.1f} dB"
    headline = (
        beat if gain >= _TELLS_DB else f"{best.label}: {abs(gain):.1f} dB {'above' if gain >= 0 else 'below'} {name}"
    )
    if gain >= 0 and best.rendered.trust and best.rendered.trust.cause:
        headline += ", but part of their light fits no image"
    if not best.rendered.quality.is_image:
        headline = f"{best.label}: no image, {ours:.1f} dB"
    detail = f"{ours:.1f} against {theirs:.1f} dB PSNR, rendered light and calibrated factors."
    if best.idealised is not None and baseline.idealised is not None:
        ideal = best.idealised.quality.psnr_db - baseline.idealised.quality.psnr_db
        detail += f" The idealised model says {ideal:+.1f} dB."
    return headline, detail


def build_report(report: ReportData, path: Path) -> Path:
    """Write the page of a ``report`` to ``path``, all or nothing, and return it.

    MitsimError when an image holds values that are not finite or the place cannot be written.
    """
    write_text(path, render_html(report))
    return Path(path)


def render_html(report: ReportData) -> str:
    """The page of a ``report`` as text; `build_report` writes it."""
    filters: dict[str, Callable[..., str]] = {
        "chi": _chi_square,
        "db": _decibel,
        "rms": reflectance,
        "trouble": _trouble,
        "reflectance": _reflectance,
        "pattern": _pattern,
    }
    facts = {"figures": _figures(report), "best": _best(report.families), "pattern_corner": _PATTERN_CORNER}
    return render_page("report.html", filters, report=report, **facts)


def _reflectance(image: npt.ArrayLike, name: str = "image") -> str:
    """Reflectance as a grey PNG, cut to 0..1 for display only."""
    return data_uri(grey_png(lightness(_finite(image, name)), smallest=_SMALLEST))


def _pattern(pattern: npt.ArrayLike) -> str:
    """Top left corner of a pattern: 0..1 as it is, -1..1 with -1 black."""
    values = _finite(pattern, "pattern")[:_PATTERN_CORNER, :_PATTERN_CORNER]
    return data_uri(grey_png((values + 1.0) / 2.0 if values.min() < 0.0 else values, smallest=_SMALLEST))


def _picture(figure: Figure) -> str:
    return figure_uri(figure, _FIGURE_DPI)


def _finite(image: npt.ArrayLike, name: str) -> FloatArray:
    values = np.asarray(image, dtype=np.float64)
    if values.ndim != 2 or values.size == 0 or not np.all(np.isfinite(values)):
        raise MitsimError(f"report: {name} of shape {values.shape} must be rows x columns of finite numbers")
    return values


def _figures(report: ReportData) -> dict[str, Any]:
    """The page's plots as data URIs, by name, where there are data for them; and the total time in s."""
    figures: dict[str, Any] = {"total": total_of(report.seconds), "stages": stages_of(report.seconds)}
    figures["plan"] = PlanChart.of(report.effects, report.accuracy) if report.effects else None
    figures["frames"] = {name: _picture(frame(_finite(dn, name))) for name, dn in report.frames.items()}
    curves = {f.label: f.singular_values for f in report.families if f.singular_values is not None}
    if curves:
        figures["singular_values"] = _picture(plots.singular_values(curves))
    both = {
        f.label: (Mean(f.idealised.quality.psnr_db, math.nan, 1), Mean(f.rendered.quality.psnr_db, math.nan, 1))
        for f in report.families
        if f.idealised is not None and f.rendered is not None
    }
    if both:
        figures["quality"] = _picture(plots.quality_bars(both))
    trusted = next((f.rendered.trust for f in report.families if f.rendered and f.name == report.main), None)
    if trusted:
        figures["trust"] = _picture(stated_and_actual(trusted.uncertainty, trusted.error))
    positive = {row.name: row.value for row in report.budget if row.value}
    if positive:
        figures["budget"] = _picture(plots.error_bars(positive, report.accuracy))
    return figures


def _best(families: tuple[FamilyResult, ...]) -> dict[str, str]:
    """Name of the family of highest PSNR, for each of the two rows of reconstructions."""
    best: dict[str, str] = {}
    for row in ("idealised", "rendered"):
        psnr = {f.name: getattr(f, row).quality.psnr_db for f in families if getattr(f, row) is not None}
        best[row] = max(psnr, key=lambda name: psnr[name]) if psnr else ""
    return best


def _chi_square(value: float | None) -> str:
    return DASH if value is None else chi_square_text(value)


def _decibel(value: float | None) -> str:
    return DASH if value is None else f"{value:.1f} dB"


def _trouble(status: str) -> str:
    """How the solver's sentence begins, unless it says that nothing is missing: those begin with "Solved: "."""
    return "" if status.startswith("Solved: ") else sentence(re.split(r"; |\. ", status)[0])


# -------- Frames and errors as figures

_FRAME_WIDTH = 3.6
"""Inches of a frame: three stand side by side with room for their labels."""
_SHOWN_PERCENT = 99.0
"""Of the errors, those that the scale holds: a normal error's are then within 2.6 deviations."""


def frame(values: npt.ArrayLike) -> Figure:
    """A sensor frame ``values`` (m, m') [DN] with its colour bar; pixel (0, 0) is top left."""
    figure, axes = figure_of(0.75 * _FRAME_WIDTH, _FRAME_WIDTH, layout="compressed")
    drawn = axes.imshow(np.asarray(values, dtype=np.float64), cmap="viridis", interpolation="none")
    bar = figure.colorbar(drawn, ax=axes)
    bar.set_label("signal [DN]", fontsize=FONT - 1)
    bar.ax.tick_params(labelsize=FONT - 2)
    axes.set_xlabel("sensor column [pixel]", fontsize=FONT - 1)
    axes.set_ylabel("sensor row [pixel]", fontsize=FONT - 1)
    axes.tick_params(labelsize=FONT - 2)
    return figure


def stated_and_actual(uncertainty: FloatArray, error: FloatArray) -> Figure:
    """An image's standard ``uncertainty`` beside its actual ``error``, both (n, n') [reflectance], on one scale."""
    figure, (panels,) = panels_of(1, 2, 0.46 * WIDTH, layout="compressed", sharex=True, sharey=True)
    largest = max(float(uncertainty.max()), float(np.percentile(error, _SHOWN_PERCENT)))
    titled = {"stated: standard uncertainty": uncertainty, "actual: |image \N{MINUS SIGN} truth|": error}
    for axes, (title, values) in zip(panels, titled.items(), strict=True):
        drawn = axes.imshow(values, vmin=0, vmax=largest, cmap="viridis", interpolation="none")
        axes.set_title(f"{title}\nrms {reflectance(float(np.sqrt(np.mean(np.square(values)))))}", fontsize=FONT)
        axes.set_xlabel("column [projector pixel]", fontsize=FONT - 1)
        axes.tick_params(labelsize=FONT - 2)
    panels[0].set_ylabel("row [projector pixel]", fontsize=FONT - 1)
    bar = figure.colorbar(drawn, ax=panels, extend="max")
    bar.set_label("reflectance, 1 = board", fontsize=FONT - 1)
    bar.ax.tick_params(labelsize=FONT - 2)
    return figure


# -------- A reconstruction and the truth in

COVERED = 1.96
"""Standard uncertainties on either side of a pixel within which the truth is expected with a chance of 95 %."""


@dataclass(frozen=True, eq=False)
class Trust:
    """What an image states of itself, beside what it is.

    Attributes
    ----------
    uncertainty, error
        (n, n') stated standard uncertainty of each pixel, and actual |image - truth| [reflectance, 1 = the board].
    chi_square
        misfit a datum; None where there are no more data than unknowns.
    cause
        finding that flags the misfit; empty where the frames fit.
    """

    uncertainty: FloatArray
    error: FloatArray
    chi_square: float | None = None
    cause: str = ""

    @classmethod
    def of(cls, image: Reconstruction, truth: FloatArray) -> Trust | None:
        """That of an ``image`` against the (n, n') ``truth``; None where its uncertainty is not known."""
        if image.uncertainty is None:
            return None
        misfit = image.misfit
        cause = misfit.reason if misfit else ""
        chi_square = misfit.chi_square if misfit else None
        return cls(image.uncertainty, np.abs(image.image - truth), chi_square, cause)

    @property
    def stated(self) -> float:
        """Standard uncertainty, rms over the image."""
        return float(np.sqrt(np.mean(np.square(self.uncertainty))))

    @property
    def actual(self) -> float:
        """Error, rms over the image."""
        return float(np.sqrt(np.mean(np.square(self.error))))

    @property
    def within(self) -> float:
        """Part of the pixels whose truth lies in their 95 % interval."""
        return float(np.mean(self.error <= COVERED * self.uncertainty))

    def summary(self) -> dict[str, Any]:
        """What demo.json says of it."""
        return {
            "uncertainty": self.stated,
            "rms_error": self.actual,
            "within_95": self.within,
            "chi_square": self.chi_square,
            "cause": self.cause or None,
        }

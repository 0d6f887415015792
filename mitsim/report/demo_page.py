"""The page of `mitsim demo`: one self-contained HTML file without scripts or links.

Sections without data are left out. The same data give the same bytes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

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
    Picture,
    Scale,
    page_figure,
    reflectance,
    render_page,
    stages_of,
    total_of,
)

_PATTERN_CORNER = 40
_SMALLEST = 384
_GAIN_DB = 0.5
"""Least gain that counts: a tenth of the squared error."""
_SHOWN_PERCENT = 99.0
"""Part of the errors within the scale of their picture."""
COVERED = 1.96
"""Standard uncertainties of a 95 % interval."""


@dataclass(frozen=True, eq=False)
class Trust:
    """Stated standard ``uncertainty`` and actual ``error`` of an image, (n, n') reflectance.

    ``chi_square`` is None where there are no more data than unknowns; ``cause`` flags the misfit.
    """

    uncertainty: FloatArray
    error: FloatArray
    chi_square: float | None = None
    cause: str = ""

    @classmethod
    def of(cls, image: Reconstruction, truth: FloatArray) -> Trust | None:
        """Compare an ``image`` with the truth; None where its uncertainty is not known."""
        if image.uncertainty is None:
            return None
        found = (image.misfit.chi_square, image.misfit.reason) if image.misfit else (None, "")
        return cls(image.uncertainty, np.abs(image.image - truth), *found)

    @property
    def stated(self) -> float:
        return float(np.sqrt(np.mean(np.square(self.uncertainty))))

    @property
    def actual(self) -> float:
        return float(np.sqrt(np.mean(np.square(self.error))))

    @property
    def within(self) -> float:
        return float(np.mean(self.error <= COVERED * self.uncertainty))

    def pictures(self) -> tuple[Picture, Picture]:
        largest = max(float(self.uncertainty.max()), float(np.percentile(self.error, _SHOWN_PERCENT)))
        scale = Scale(0.0, largest, "of the board's reflectance")
        stated, actual = (f"rms {reflectance(value)}" for value in (self.stated, self.actual))
        return (
            Picture.of("stated", "Stated: standard uncertainty", self.uncertainty, scale, stated),
            Picture.of("actual", "Actual: |image \N{MINUS SIGN} truth|", self.error, scale, actual),
        )

    def summary(self) -> dict[str, Any]:
        return {
            "uncertainty": self.stated,
            "rms_error": self.actual,
            "within_95": self.within,
            "chi_square": self.chi_square,
            "cause": self.cause or None,
        }


@dataclass(frozen=True, eq=False)
class Recovery:
    image: FloatArray
    quality: Quality
    lam: float | None = None
    status: str = ""
    trust: Trust | None = None


@dataclass(frozen=True, eq=False)
class FamilyResult:
    """A pattern family.

    ``shots`` counts frames. ``patterns`` are some (n, n) examples. ``idealised`` solves the paper's model, ``rendered``
    rendered frames with calibrated factors, whose PSNR [dB] by exposure convention is ``by_exposure``.
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
    """A source of error: relative rms of the expected frames (None: unknown), and its meaning."""

    name: str
    value: float | None
    meaning: str


@dataclass(frozen=True, eq=False)
class ReportData:
    """Content of the demo's page.

    ``truth`` (n, n) and ``render`` are reflectances, 1 = calibration board, row 0 at the top as seen along +z. ``main``
    is the family whose errors are shown; the tiles compare the best family with the first. ``frames`` are in DN by
    caption.
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
    """Return headline and detail, such as "49 dots beat uniform by 11.0 dB"; MitsimError without a rendered result."""
    if best.rendered is None or baseline.rendered is None:
        raise MitsimError(f"report: no rendered result of {best.label} or {baseline.label}; reconstruct both first")
    ours, theirs = best.rendered.quality.psnr_db, baseline.rendered.quality.psnr_db
    if best.name == baseline.name:
        return f"{best.label}: {ours:.1f} dB", "PSNR, rendered light and calibrated factors."
    gain, name = ours - theirs, baseline.label[:1].lower() + baseline.label[1:]
    if not best.rendered.quality.is_image:
        headline = f"{best.label}: no image, {ours:.1f} dB"
    elif gain >= _GAIN_DB:
        headline = f"{best.label} beat {name} by {gain:.1f} dB"
    else:
        headline = f"{best.label}: {abs(gain):.1f} dB {'above' if gain >= 0 else 'below'} {name}"
    if best.rendered.quality.is_image and gain >= 0 and best.rendered.trust and best.rendered.trust.cause:
        headline += ", but part of their light fits no image"
    detail = f"{ours:.1f} against {theirs:.1f} dB PSNR, rendered light and calibrated factors."
    if best.idealised is not None and baseline.idealised is not None:
        ideal = best.idealised.quality.psnr_db - baseline.idealised.quality.psnr_db
        detail += f" The idealised model says {ideal:+.1f} dB."
    return headline, detail


def build_report(report: ReportData, path: Path) -> Path:
    write_text(path, render_html(report))
    return Path(path)


def render_html(report: ReportData) -> str:
    """Render the page; MitsimError when an image is not finite."""
    best = {}
    for row in ("idealised", "rendered"):
        psnr = {f.name: getattr(f, row).quality.psnr_db for f in report.families if getattr(f, row) is not None}
        best[row] = max(psnr, key=lambda name: psnr[name]) if psnr else ""
    curves = {f.label: f.singular_values for f in report.families if f.singular_values is not None}
    trust = next((f.rendered.trust for f in report.families if f.rendered and f.name == report.main), None)
    return render_page(
        "report.html",
        report=report,
        best=best,
        singular_values=page_figure(plots.singular_values(curves))[0] if curves else "",
        frames=[Picture.of(name, name, _finite(dn, name), Scale.of(dn, "DN")) for name, dn in report.frames.items()],
        errors=trust.pictures() if trust else (),
        total=total_of(report.seconds),
        stages=stages_of(report.seconds),
        pattern_corner=_PATTERN_CORNER,
        picture_of=_reflectance,
        pattern_of=_pattern,
        chi_square=chi_square_text,
    )


def _reflectance(image: npt.ArrayLike, name: str = "image") -> str:
    return data_uri(grey_png(lightness(_finite(image, name)), smallest=_SMALLEST))


def _pattern(pattern: npt.ArrayLike) -> str:
    values = _finite(pattern, "pattern")[:_PATTERN_CORNER, :_PATTERN_CORNER]
    return data_uri(grey_png((values + 1.0) / 2.0 if values.min() < 0.0 else values, smallest=_SMALLEST))


def _finite(image: npt.ArrayLike, name: str) -> FloatArray:
    values = np.asarray(image, dtype=np.float64)
    if values.ndim != 2 or values.size == 0 or not np.all(np.isfinite(values)):
        raise MitsimError(f"report: {name} of shape {values.shape} must be rows x columns of finite numbers")
    return values

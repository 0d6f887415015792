"""`mitsim study twin`: real captures beside their simulations; what agrees, what does not, and why.

A FlatCam's captures (:mod:`mitsim.studies.twin_capture`): codes of its mask are learned from the other captures. The
scene, as the authors' own calibration shows it, is put on a sheet, and captured by a simulated camera
(:mod:`mitsim.studies.twin_frame`). A DiffuserCam's point spread function: a diffuser whose statistics are fitted to it
is traced (:mod:`mitsim.studies.twin_diffuser`).
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mitsim.bench.request import Request
from mitsim.core.arrays import FloatArray
from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.job import Job
from mitsim.report import plots
from mitsim.studies.framework.page import Part
from mitsim.studies.framework.run import Findings
from mitsim.studies.twin_capture import Learned, Measured, read_captures
from mitsim.studies.twin_diffuser import DiffuserTwin, frequencies, radial_power, read_spread, twin_of
from mitsim.studies.twin_files import TwinFiles
from mitsim.studies.twin_frame import CAUSES, Twin, compare, correlation, render

_GREEN = "gb"
"""Plane whose frames are shown."""
_SHOWN = 160
"""Side of the middle of a frame that is shown [pixels]: features of four pixels are seen on a page."""
_BRIGHT = 3.0
"""Standard deviations of a frame from mid-grey to white."""
_EDGES = np.geomspace(0.005, 0.5, 29)
"""Of the bands of a frame's radial spectrum [cycles / pixel]: a sixth of a frequency wide."""
_TICKS = (0.02, 0.05, 0.1, 0.2, 0.4)
"""Frequencies that are named along a diffuser's spectrum [cycles / pixel]."""
_RENDERED = 0.1
"""Relative error of a simulated frame from which a twin is not to be trusted: its energy is then a hundredth, as much
as causes are told by."""
_NUMBERS = (
    ("correlation", "correlation", ".3f"),
    ("other", "other scene", ".3f"),
    ("explained", "explained", ".1%"),
    ("chi_square", "chi-square", ".2f"),
    ("noise_part", "noise alone", ".1%"),
    ("gain", "scale", ".2f"),
)
"""Of a twin: name, head of a column, format."""
_UNKNOWN = (
    "Distances of mask and scene: only the product of the mask's distance and an angle moves a shadow.",
    "The scene: its image by the authors' own calibration stands for it, with what that smooths and cuts at 0.",
    "The mask's mean transmission, black level and stray light: means of rows and columns are off before codes are "
    "learned. Where coded parts agree, the mean levels do not: the drawn mask, whose code is scaled by its largest "
    "value, lets more even light through than the real one.",
    "The mask as it was made: learned codes hold its diffraction and flaws as far as these are separable, and errors "
    "of the scenes that they were learned from.",
)
"""What no comparison of these frames can tell."""


@dataclass(frozen=True, eq=False)
class TwinFindings(Findings):
    """Twins of captures, codes of each capture's mask by the capture's name, and a twin of a diffuser."""

    twins: tuple[Twin, ...]
    learned: Mapping[str, Learned]
    diffuser: DiffuserTwin | None

    title = "Real captures beside their simulation"

    def payload(self) -> dict[str, Any]:
        """The JSON of the command line."""
        return {
            "captures": [_row(twin) for twin in self.twins],
            "learned": {
                name: {
                    "orientation": each.pose.orientation,
                    "scale": [*each.pose.scales],
                    "explained": each.codes.explained,
                    "told": [*each.codes.told],
                }
                for name, each in self.learned.items()
            },
            "diffuser": None if self.diffuser is None else _diffuser_row(self.diffuser),
            "not_known": list(_UNKNOWN),
        }

    @property
    def warnings(self) -> Sequence[str]:
        """That frames are not of their images, or not rendered well."""
        found = [
            f"{name}: the other captures do not tell how images lie before the mask; give more captures"
            for name, each in self.learned.items()
            if not each.pose.certain
        ]
        for twin in self.twins:
            if twin.correlation <= twin.other:
                found.append(
                    f"{twin.measured.name}: another capture's scene explains the frame no worse (correlation "
                    f"{twin.other:.2f} and {twin.correlation:.2f}); check that each capture lies with its own image"
                )
            if twin.render_error > _RENDERED:
                found.append(
                    f"{twin.measured.name}: the simulated frame is {twin.render_error:.0%} off the product of its "
                    "factors; report this"
                )
        return found

    def parts(self) -> Sequence[Part]:
        """Of its page."""
        return [
            *(self._capture_parts() if self.twins else ()),
            *(_diffuser_parts(self.diffuser) if self.diffuser else ()),
        ]

    def _capture_parts(self) -> Iterator[Part]:
        yield Part(
            "FlatCam: frames",
            "The mask's codes were learned from the other captures and their images alone, so every frame is a "
            "prediction; one number is fitted, the light. Row and column means are off.",
            ("frame", *(head for _, head, _ in _NUMBERS)),
            tuple(
                (twin.measured.name, *(format(getattr(twin, name), form) for name, _, form in _NUMBERS))
                for twin in self.twins
            ),
            ("frames.png", "spectra.png"),
            (
                "Frames are planes of the Bayer sensor: red, green beside blue, green beside red, blue.",
                "Other scene: correlation with another capture's scene through the same codes: what bright scenes have "
                "in common. A twin is worth what it has above that.",
                "Explained: part of the frame's energy. Noise alone: part that no model explains, by the frame's own "
                "fine structure. Chi-square: energy that is left, over the noise's: 1 where only noise is left. Scale: "
                "light over what the learned codes expect.",
            ),
        )
        yield Part(
            "By cause",
            "The energy of a frame about its mean, in percent, by what takes it out of what the causes before leave; "
            "bars show what the simulation leaves. Smooth field: polynomials of light and of gain. Mask's code: codes "
            "fitted to this very frame. Scene's image: a correction of least risk. Noise that a fit takes with it "
            "counts as noise; the rest is not explained: of what is not separable, moved or grew.",
            ("frame", *CAUSES),
            tuple((twin.measured.name, *(f"{100 * twin.parts[each]:.1f}" for each in CAUSES)) for twin in self.twins),
            ("causes.png",),
        )
        yield Part(
            "Means of rows and columns, and what cannot be known",
            "The camera's program takes the means off. Correlation of measured and simulated means, and the measured "
            "mean level over the simulated one where coded parts agree. What no comparison of these frames can tell "
            "stands below.",
            ("frame", "rows", "columns", "level"),
            tuple(
                (twin.measured.name, *(f"{each:.2f}" for each in (*_of_means(twin), twin.level))) for twin in self.twins
            ),
            ("means.png",),
            _UNKNOWN,
        )

    def figures(self) -> dict[str, Figure]:
        """By file name."""
        shown: dict[str, Figure] = {}
        if self.twins:
            green = [twin for twin in self.twins if twin.measured.plane == _GREEN][:2]
            parts = {
                twin.measured.name: {name: max(100 * twin.parts[name], 0.0) for name in CAUSES[2:]}
                for twin in self.twins
            }
            shown |= {
                "frames.png": _frames_figure(green),
                "spectra.png": _spectra_figure(green),
                "causes.png": plots.stacked_bars(parts, "not explained by the simulation [% of the frame's energy]"),
                "means.png": _means_figure(green[0]),
            }
        if self.diffuser:
            shown |= {
                "diffuser.png": _light_figure(self.diffuser),
                "diffuser_spectrum.png": _rings_figure(self.diffuser),
            }
        return shown


def measure(
    bench: None, request: Request, job: Job, files: TwinFiles | None = None, variant: str = DEFAULT_VARIANT
) -> TwinFindings:
    """Twins of all that the ``files`` hold.

    Parameters
    ----------
    bench
        none: benches are made of the captures.
    request, job
        the seed of noise and diffusers, and who is told how far the work is.
    files
        real captures.
    variant
        of Mitsuba.

    Raises
    ------
    MitsimError
        without files, and for files that are not what they are to be.
    """
    files = files or TwinFiles.find(None)
    spread = None if files.psf is None else read_spread(files.psf)
    planes = read_captures(files.captures, request.seed)
    learned: dict[str, Learned] = {}
    twins: list[Twin] = []
    for name in files.captures:
        job.progress("FlatCam", len(learned) / len(files.captures))
        learned[name] = Learned.of([each for each in planes if each.capture != name])
        twins += [_twin(each, learned[name], planes, variant) for each in planes if each.capture == name]
    diffuser = None if spread is None else twin_of(spread, request.seed, variant, job.progress)
    return TwinFindings(tuple(twins), learned, diffuser)


def _twin(measured: Measured, learned: Learned, planes: Sequence[Measured], variant: str) -> Twin:
    seen = learned.see(measured)
    other = next(each for each in planes if each.plane == measured.plane and each.capture != measured.capture)
    with tempfile.TemporaryDirectory(prefix="mitsim-twin-") as folder:
        electrons = render(seen, learned.codes, Path(folder), variant)
    return compare(seen, learned.codes, electrons, learned.see(other).scene)


# ---- Tables ----


def _of_means(twin: Twin) -> list[float]:
    """Correlation of measured and simulated means of rows, and of columns."""
    return [correlation(*twin.means(axis).values()) for axis in (1, 0)]


def _row(twin: Twin) -> dict[str, Any]:
    measured, (rows, columns) = twin.measured, _of_means(twin)
    return {
        "frame": measured.name,
        "correlation": twin.correlation,
        "explained": twin.explained,
        "correlation_other_scene": twin.other,
        "chi_square": twin.chi_square,
        "noise": twin.noise_part,
        "scale": twin.gain,
        "gain_dn_per_e": measured.gain,
        "read_variance_dn2": measured.read_variance,
        "rows": rows,
        "columns": columns,
        "level": twin.level,
        "render_error": twin.render_error,
        "parts": {name: float(part) for name, part in twin.parts.items()},
    }


def _diffuser_row(twin: DiffuserTwin) -> dict[str, Any]:
    found = dict(zip(("correlation_mm", "move_mm", "blur", "haze"), twin.scatter, strict=True))
    compared = {name: twin.deviations(name) for name in ("contrast", "brightest")}
    return {
        **{name: getattr(twin, name) for name in found},
        "scatter": found,
        **{name: {"measured": a, "simulated": b, "scatter": c} for name, (a, b, c) in compared.items()},
        "spectrum_error": {"measured": twin.spectrum_error[0], "simulated": twin.spectrum_error[1]},
    }


def _diffuser_parts(twin: DiffuserTwin) -> list[Part]:
    rows = []
    for name, text in (
        ("contrast", "contrast of the light: deviation over mean"),
        ("brightest", "light in the brightest twentieth of the pixels"),
    ):
        value, mean, scatter = twin.deviations(name)
        rows.append((text, f"{value:.3f}", f"{mean:.3f} \N{PLUS-MINUS SIGN} {scatter:.3f}"))
    own, others = twin.spectrum_error
    rows.append(("radial spectrum: rms of the logarithm, to the mean of simulated ones", f"{own:.2f}", f"{others:.2f}"))
    numbers = zip(
        ("correlation length", "light moved, rms along an axis", "blur", "even part of the light"),
        (f"{twin.correlation_mm:.3f} mm", f"{twin.move_mm:.3f} mm", f"{twin.blur:.1f} pixels", f"{twin.haze:.2f}"),
        twin.scatter,
        strict=True,
    )
    return [
        Part(
            "A DiffuserCam's point spread function",
            "A normal relief with the measured picture's statistics, traced by Mitsuba. No caustic of a random one "
            "lies where the real one has it: what is compared holds for all of its kind. The spectrum was fitted, "
            "contrast and brightest pixels were not.",
            ("of the lit square", "measured", "simulated"),
            tuple(rows),
            ("diffuser.png", "diffuser_spectrum.png"),
        ),
        Part(
            "The diffuser that was fitted",
            "By the radial spectrum, on a grid (blur in steps of 0.2). Scatter: "
            "standard deviation of fits to single simulated diffusers.",
            ("number", "fitted", "scatter"),
            tuple((name, text, f"{scatter:.3f}") for name, text, scatter in numbers),
            notes=(
                "Lengths are in pixels of 23.4 um, which the public file does not state.",
                "The relief's height and its distance cannot be told apart: light is moved by distance x (n - 1) x "
                "slope, the slope of a normal relief being its rms height over its correlation length.",
                "Blur and the even part stand for the size of the point, diffraction, pixels and stray light together.",
            ),
        ),
    ]


# ---- Figures ----


def _pictures(rows: Sequence[Mapping[str, FloatArray]], ends: Sequence[tuple[float, float]], unit: str) -> Figure:
    """Pictures in ``rows`` by their titles, in greys between each row's ``ends``, which its scale names in a
    ``unit``."""
    count = len(rows[0])
    figure, places = plots.panels_of(
        len(rows), count, len(rows) * (0.9 * plots.WIDTH / count + 0.3), layout="compressed"
    )
    for line, images, (least, most) in zip(places, rows, ends, strict=True):
        for axes, (title, image) in zip(line, images.items(), strict=True):
            drawn = axes.imshow(image, cmap="gray", vmin=least, vmax=most, interpolation="none")
            axes.set(xticks=[], yticks=[])
            axes.set_title(title, fontsize=plots.FONT - 1)
        bar = figure.colorbar(drawn, ax=line, extend="max" if least == 0 else "both")
        bar.set_label(unit, fontsize=plots.FONT - 1)
        bar.ax.tick_params(labelsize=plots.FONT - 2)
    return figure


def _frames_figure(twins: Sequence[Twin]) -> Figure:
    """Middles of measured and simulated frames with noise, and their difference."""
    rows, ends = [], []
    for twin in twins:
        frame = twin.measured.frame
        row, column = ((side - _SHOWN) // 2 for side in frame.shape)
        images = {
            f"{twin.measured.name}: measured": frame,
            "simulated, with noise": twin.noisy,
            "measured less simulated": frame - twin.expected,
        }
        rows.append({name: image[row : row + _SHOWN, column : column + _SHOWN] for name, image in images.items()})
        ends.append((-_BRIGHT * float(frame.std()), _BRIGHT * float(frame.std())))
    figure = _pictures(rows, ends, "light [DN]")
    figure.suptitle(f"Middle {_SHOWN} x {_SHOWN} pixels, row and column means off", fontsize=plots.FONT)
    return figure


def _spectra_figure(twins: Sequence[Twin]) -> Figure:
    figure, places = plots.panels_of(1, len(twins), 0.42 * plots.WIDTH, sharey=True)
    for axes, twin in zip(places[0], twins, strict=True):
        frame = twin.measured.frame
        curves = {
            "measured": frame,
            "simulated, with noise": twin.noisy,
            "simulated, its noise alone": twin.noisy - twin.expected,
            "measured less simulated": frame - twin.expected,
        }
        for index, (name, shown) in enumerate(curves.items()):
            axes.loglog(
                np.sqrt(_EDGES[1:] * _EDGES[:-1]),
                radial_power(shown, _EDGES),
                label=name,
                lw=1.8,
                **plots.line_style(index),
            )
        axes.set_title(twin.measured.name, fontsize=plots.FONT)
        first = axes is places[0][0]
        plots.label_axes(axes, "frequency [cycles / pixel]", "power [DN\N{SUPERSCRIPT TWO}]" if first else "")
    plots.legend_below(figure, *places[0][0].get_legend_handles_labels())
    return figure


def _means_figure(twin: Twin) -> Figure:
    """Means of rows and of columns about their mean, the simulated ones in the measured scale."""
    figure, places = plots.panels_of(1, 2, 0.4 * plots.WIDTH)
    for axes, axis, name in zip(places[0], (1, 0), ("row", "column"), strict=True):
        for index, (label, values) in enumerate(twin.means(axis).items()):
            axes.plot(values, label=label, lw=1.5, **plots.line_style(index))
        axes.set_title(f"{twin.measured.name}: means of {name}s, about their mean", fontsize=plots.FONT - 1)
        plots.label_axes(axes, f"{name} [pixel]", "light [DN]" if axis else "")
    plots.legend_below(figure, *places[0][0].get_legend_handles_labels())
    return figure


def _light_figure(twin: DiffuserTwin) -> Figure:
    images = {"measured": twin.measured, "simulated": twin.simulated}
    rows = {f"{name}, {len(light)} x {len(light)} pixels": np.sqrt(light) for name, light in images.items()}
    return _pictures([rows], [(0.0, _BRIGHT)], "root of light over mean [1]")


def _rings_figure(twin: DiffuserTwin) -> Figure:
    figure, axes = plots.figure_of(0.45 * plots.WIDTH)
    simulated = np.array([each.spectrum for each in twin.spreads[1:]])
    axes.fill_between(
        frequencies(), simulated.min(axis=0), simulated.max(axis=0), color=plots.PALE, label="simulated, all"
    )
    axes.plot(frequencies(), simulated.mean(axis=0), label="simulated, mean", lw=1.8, **plots.line_style(0))
    axes.plot(frequencies(), twin.spreads[0].spectrum, label="measured", lw=1.8, **plots.line_style(1))
    axes.set(xscale="log", yscale="log")
    axes.set_xticks(_TICKS, map(str, _TICKS))
    axes.minorticks_off()
    plots.label_axes(axes, "frequency [cycles / pixel]", "power of light over its mean [1]")
    plots.legend_below(figure, *axes.get_legend_handles_labels())
    return figure

"""What a reconstruction shows of itself in a notebook: beside the image how far to trust each pixel, and why."""

from __future__ import annotations

import base64
import html
import io
import re

import numpy as np
from PIL import Image

from mitsim.reconstruct.reconstruct import Reconstruction, reconstruct
from tests.ideal_sessions import Bench, N, bench, picture


def shown(image: Reconstruction) -> tuple[list[np.ndarray], list[str], list[str]]:
    """Its pictures (grey levels), their captions, and the lines below them."""
    page = image._repr_html_()
    sources = re.findall(r"base64,([A-Za-z0-9+/=]+)", page)
    pictures = [np.asarray(Image.open(io.BytesIO(base64.b64decode(source)))).astype(float) for source in sources]
    captions, lines = (
        [html.unescape(text) for text in re.findall(pattern, page)]
        for pattern in (r"<figcaption[^>]*>([^<]*)<", r"<div>([^<]+)</div>")
    )
    return pictures, captions, lines


def test_uncertainty_is_shown_with_its_scale_and_sources() -> None:
    """(Planted: the smallest source first; the image shown again in place of its uncertainty.)"""
    image = reconstruct(bench().run("dots:4", picture(), 0), bench().calibrated(0))
    pictures, captions, lines = shown(image)
    assert image.uncertainty is not None and image.uncertainties is not None
    assert [each.shape for each in pictures] == [(N, N)] * 2
    least, most = float(image.uncertainty.min()), float(image.uncertainty.max())
    assert captions[1] == f"standard uncertainty of each pixel\n{least:.3g} to {most:.3g} of reflectance"
    assert pictures[1].min() == 0 and pictures[1].max() == 255
    order = np.argsort(image.uncertainty.ravel(), kind="stable")
    assert np.all(np.diff(pictures[1].ravel()[order]) >= 0), "the less certain, the lighter"
    (line,) = (line for line in lines if line.startswith("standard uncertainty "))
    reported = dict(re.findall(r"([a-z ]+) (\d\.\de-\d+)", line.partition(": ")[2]))
    values = [float(value) for value in reported.values()]
    assert values == sorted(values, reverse=True) and len(values) >= 3
    budget = image.uncertainties.budget
    for name, value in reported.items():
        assert float(value) == float(f"{budget[name.strip().replace(' ', '_')]:.1e}")
    assert line.startswith(f"standard uncertainty {image.summary()['uncertainty']:.1e} rms: ")


def test_misfit_is_shown_and_its_cause_where_flagged() -> None:
    """(Planted: the cause left out.)"""
    fits = reconstruct(bench().run("dots:4", picture(), 0), bench().calibrated(0))
    moved = reconstruct(bench(0.3).run("dots:4", picture(), 0), bench().calibrated(0))
    for image, cause, digits in ((fits, "", ".3f"), (moved, "; light that the calibrated camera does not see", ".3g")):
        (line,) = (line for line in shown(image)[2] if line.startswith("misfit: "))
        assert image.misfit is not None
        assert line.startswith(f"misfit: chi-square {image.misfit.chi_square:{digits}} a datum, ")
        assert cause in line and ("calibrated camera" in line) == bool(cause)


def test_what_is_not_known_is_not_shown() -> None:
    """Least total variation is not linear in the frames; as many data as unknowns tell no misfit."""
    tv = reconstruct(bench().run("dots:4", picture(), 0), bench().calibrated(0), method="tv")
    assert len(shown(tv)[0]) == 1 and [line[:6] for line in tv.trust] == ["misfit"]
    square = Bench(bench().left[:N], bench().right[:N])
    exact = reconstruct(square.run("uniform", picture(), 0), square.calibrated(0), 1.0)
    assert exact.misfit is None and [line[:20] for line in exact.trust] == ["standard uncertainty"]

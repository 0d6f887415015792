"""The idealised camera of a 16 x 16 scene against other computations."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.devices.patterns import hadamard_matrix
from mitsim.devices.projector import Spectrum
from mitsim.metrics import relative_error
from mitsim.optics.shadow import Directions
from mitsim.optics.terms import best_term, centre_terms, shadow_terms
from mitsim.report.lit_scene import IdealCamera
from mitsim.sensor.chain import electrons_from_irradiance
from tests.stripes import estimated

N = 16


@pytest.fixture(scope="module", params=["separable", "flatcam"])
def bench(request: pytest.FixtureRequest, shared_scene: Callable[..., Path], variant: str) -> Bench:
    return open_bench(shared_scene(f"diffraction_{request.param}", mask=request.param), variant)


def test_without_diffraction_its_factors_are_the_papers(bench: Bench) -> None:
    """Those of the coded term, up to a factor between the two sides; centred for FlatCam, whose other term vanishes."""
    camera = IdealCamera(bench, bench.geometry.mask)
    rows, columns = (Directions.cells(np.linspace(*window, N + 1)) for window in bench.windows)
    factors = shadow_terms(bench.geometry, rows, columns, bench.geometry.scene_distance)[-1]
    if camera.centre:
        factors = tuple(factor - factor.mean(axis=0) for factor in factors)
    expected, operator = (np.einsum("ir,jc->irjc", left, right) for left, right in (factors, camera.factors))
    assert relative_error(operator, expected) < 1e-9
    rate = np.einsum("ir,jc->irjc", *camera.calibrated(2.0)) / np.where(operator == 0, 1, operator)
    model = bench.projector.effective_wavelength_nm
    assert np.allclose(rate[operator != 0], electrons_from_irradiance(2.0, 1.0, bench.sensor, model), rtol=1e-9)


def test_frames_are_what_the_terms_say(bench: Bench) -> None:
    """Checked at one pattern: the wave-optical operator applied to the lit image, term by term."""
    camera = IdealCamera(bench, bench.geometry.mask, Spectrum(np.linspace(412.0, 688.0, 13), np.full(13, 1 / 13)))
    image, family = np.random.default_rng(6).random((N, N)), bench.family("dots:2")
    lit = image * np.outer(family.left[:, 1], family.right[:, 0])
    expected = sum(left @ lit @ right.T for left, right in camera.terms)
    index = next(k for k, shown in enumerate(family.shots) if (shown.row, shown.column) == (1, 0))
    frame = list(camera.frames(family, image))[index]
    assert relative_error(frame.irradiance, expected) < 1e-9


def test_light_of_short_waves_is_not_told_from_rays(bench: Bench) -> None:
    geometric = IdealCamera(bench, bench.geometry.mask)
    for wavelength_nm, least, most in ((550 / 256, 0.0, 1e-2), (550.0, 0.05, 0.5)):
        camera = IdealCamera(bench, bench.geometry.mask, Spectrum(np.array([wavelength_nm]), np.ones(1)))
        factor, assumed = camera.factors[0], geometric.factors[0]
        sign = 1.0 if np.vdot(factor, assumed) >= 0 else -1.0  # the sign of a pair of factors is free
        assert least <= relative_error(sign * factor, assumed) < most
        terms, rays = (sum(np.einsum("ir,jc->irjc", *pair) for pair in each.terms) for each in (camera, geometric))
        assert least <= relative_error(terms, rays) < most


def test_calibration_finds_the_best_separable_factors(bench: Bench) -> None:
    """The Hadamard procedure on noise-free frames of a board, in the projector's light.

    One term is found exactly; FlatCam's centred operator is not separable, and then the procedure's factors (exact for
    light that is uniform along one axis) and the nearest ones are two compromises. They differ by less than what one
    separable operator leaves.
    """
    camera = IdealCamera(bench, bench.geometry.mask, Spectrum(np.array([562.0]), np.ones(1)))
    signs = hadamard_matrix(N).astype(float)
    ones = np.ones(N)
    stripes = [[sum(np.outer(a @ h, b @ ones) for a, b in camera.terms) for h in signs.T]]
    stripes.append([sum(np.outer(a @ ones, b @ h) for a, b in camera.terms) for h in signs.T])
    found = estimated(*stripes, signs, centre=camera.centre)
    left, right = camera.factors
    operator = np.einsum("ir,jc->irjc", left, right)
    difference = relative_error(np.einsum("ir,jc->irjc", found.left, found.right), operator)
    if not camera.centre:
        assert difference < 1e-10
    else:
        assert 1e-4 < difference < best_term(centre_terms(camera.terms)).residual

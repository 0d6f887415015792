"""The diffraction study on a 16 x 16 scene: its idealised camera against other computations, and what its rows say."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.bench.request import Request
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import hadamard_matrix
from mitsim.devices.projector import Spectrum
from mitsim.metrics import relative_error
from mitsim.optics.shadow import Directions
from mitsim.optics.terms import best_term, centre_terms, shadow_terms
from mitsim.reconstruct.factors import estimate_factors
from mitsim.report import lit_scene
from mitsim.report.lit_scene import IdealCamera
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.studies import diffraction_study
from mitsim.studies.framework.run import StudyResult, find_study

pytestmark = pytest.mark.usefixtures("draft_figures")

N = 16
PRINT = np.clip(60 + 150 * np.random.default_rng(3).random((32, 32)), 0, 255)


@pytest.fixture(scope="module", params=["separable", "flatcam"])
def bench(request: pytest.FixtureRequest, shared_scene: Callable[..., Path], variant: str) -> Bench:
    return open_bench(shared_scene(f"diffraction_{request.param}", mask=request.param), variant)


@pytest.fixture(scope="module")
def result(shared_scene: Callable[..., Path], variant: str, tmp_path_factory: pytest.TempPathFactory) -> StudyResult:
    bench = open_bench(shared_scene("diffraction_print", reflectance=PRINT), variant)
    folder = tmp_path_factory.mktemp("study") / "out"
    return find_study("diffraction")(bench, folder, Request.of(patterns="dots:4", seed=1), None)


@pytest.fixture(scope="module")
def study(result: StudyResult) -> diffraction_study.DiffractionFindings:
    assert isinstance(result.findings, diffraction_study.DiffractionFindings)
    return result.findings


def loss(study: diffraction_study.DiffractionFindings, *case: str) -> float:
    return study.loss_db(study.row(*case))


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
    camera = IdealCamera(bench, bench.geometry.mask, lit_scene.lights(bench)["broadband"])
    image, family = np.random.default_rng(6).random((N, N)), bench.family("dots:2")
    lit = image * np.outer(family.left[:, 1], family.right[:, 0])
    expected = sum(left @ lit @ right.T for left, right in camera.terms)
    index = next(k for k, shown in enumerate(family.shots) if (shown.row, shown.column) == (1, 0))
    frame = list(camera.frames(family, image))[index]
    assert relative_error(frame.irradiance, expected) < 1e-9


def test_light_of_short_waves_is_not_told_from_rays(bench: Bench) -> None:
    systems = {
        lit_scene.GEOMETRIC: IdealCamera(bench, bench.geometry.mask),
        "short": IdealCamera(bench, bench.geometry.mask, Spectrum(np.array([550 / 256]), np.ones(1))),
        "green": IdealCamera(bench, bench.geometry.mask, Spectrum(np.array([550.0]), np.ones(1))),
    }
    rows = {name: lit_scene.shadow_row(name, systems) for name in systems}
    for measure in ("scene_pixel", "factor"):
        found = {name: getattr(row, measure) for name, row in rows.items()}
        assert found[lit_scene.GEOMETRIC] < 1e-7 and found["short"] < 1e-2 < 0.05 < found["green"], found
    assert rows["short"].separability_centred < 1e-2


def test_calibration_finds_the_best_separable_factors(bench: Bench) -> None:
    """The Hadamard procedure on noise-free frames of a board, in the projector's light.

    One term is found exactly; FlatCam's centred operator is not separable, and then the procedure's factors (exact for
    light that is uniform along one axis) and the nearest ones are two compromises. They differ by less than what one
    separable operator leaves.
    """
    camera = IdealCamera(bench, bench.geometry.mask, lit_scene.lights(bench)[lit_scene.LINE])
    signs = hadamard_matrix(N).astype(float)
    ones = np.ones(N)
    stripes = [[sum(np.outer(a @ h, b @ ones) for a, b in camera.terms) for h in signs.T]]
    stripes.append([sum(np.outer(a @ ones, b @ h) for a, b in camera.terms) for h in signs.T])
    found = estimate_factors(*stripes, signs, centre=camera.centre)
    left, right = camera.factors
    operator = np.einsum("ir,jc->irjc", left, right)
    difference = relative_error(np.einsum("ir,jc->irjc", found.left, found.right), operator)
    if not camera.centre:
        assert difference < 1e-10
    else:
        assert 1e-4 < difference < best_term(centre_terms(camera.terms)).residual


def test_the_geometric_mask_costs_image_quality_and_the_true_shadow_does_not(
    study: diffraction_study.DiffractionFindings,
) -> None:
    """3 dB for "nothing": the true shadow has another condition number, for better or worse."""
    for light in ("one line", "projector", "broadband"):
        case = "idealised", "separable", light, "dots:4"
        assert loss(study, *case, "geometric factors") > 5
        assert loss(study, *case, "best separable factors") < 3
        flat = "idealised", "flatcam", light, "dots:4"
        assert loss(study, *flat, "geometric factors") > 5
        assert loss(study, *flat, "best separable factors") < loss(study, *flat, "geometric factors")
    case = "rendered", "separable", "projector", "dots:4"
    assert loss(study, *case, "geometric factors") > 5
    assert loss(study, *case, "calibrated factors") < 3


def test_the_best_lambda_is_at_least_as_good_as_the_solvers_own(study: diffraction_study.DiffractionFindings) -> None:
    assert all(row.psnr_best_db >= row.psnr_db for row in study.quality)
    right = [row for row in study.quality if row.light == "no diffraction" and row.frames == "idealised"]
    assert all(row.psnr_best_db < row.psnr_db + 1 for row in right), "with the right factors its own is near the best"


def test_separability_of_each_light(study: diffraction_study.DiffractionFindings) -> None:
    rows = {(row.mask, row.light): row for row in study.shadows}
    assert rows["separable", "one line"].separability < 1e-12
    assert 1e-4 < rows["separable", "broadband"].separability < 1e-2
    assert rows["separable", "broadband"].wavelengths == rows["separable", "broadband"].terms == 13
    assert rows["flatcam", "no diffraction"].separability_centred < 1e-9
    assert rows["flatcam", "one line"].separability_centred > 0.01
    assert rows["flatcam", "one line"].terms == 4
    for mask in ("separable", "flatcam"):
        assert 0 < rows[mask, "one line"].factor < 0.5, "the sign of a pair of factors is free"
        assert rows[mask, "one line"].scene_pixel < rows[mask, "one line"].point_source, "a pixel blurs what differs"


def test_a_camera_without_a_full_well_is_refused_before_any_light_is_traced(bench: Bench, tmp_path: Path) -> None:
    bottomless = replace(
        bench, devices=replace(bench.devices, sensor=bench.sensor.model_copy(update={"full_well_e": np.inf}))
    )
    with pytest.raises(MitsimError, match="no full well to fill"):
        find_study("diffraction")(bottomless, tmp_path / "out", None, None)
    assert not (tmp_path / "out").exists()


def test_files_and_report(result: StudyResult, study: diffraction_study.DiffractionFindings) -> None:
    folder = Path(result.output)
    assert sorted(path.name for path in folder.iterdir()) == [
        "diffraction.html",
        "diffraction.json",
        "quality.png",
        "shadow.png",
    ]
    kept = json.loads((folder / "diffraction.json").read_text())
    assert len(kept["shadows"]) == 8
    assert len(kept["quality"]) == 2 * 2 * 7 + 2 * 2 * 2, "idealised: one pair of factors without diffraction"
    assert kept["seed"] == 1 and result.payload().keys() >= {*kept, "output"} - {"kind", "seed", "versions"}
    keys = {"mask", "light", "wavelengths", "terms", "separability", "separability_centred", "factor", "scene_pixel"}
    assert all(row.keys() >= keys | {"point_source"} for row in kept["shadows"])
    keys = {
        "frames",
        "mask",
        "light",
        "patterns",
        "factors",
        "psnr_db",
        "psnr_best_db",
        "loss_db",
        "residual",
        "status",
    }
    assert all(row.keys() >= keys for row in kept["quality"])
    assert study.verdict in " ".join(result.lines())

"""`reconstruct`: the same image from memory and from disk, a status that is an object, and no image that gets lost."""

from __future__ import annotations

import base64
import html
import io
import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import mitsim.reconstruct
from mitsim.core.errors import MitsimError
from mitsim.core.exr import read_frame
from mitsim.core.job import Cost
from mitsim.core.manifests import CalibrationManifest, Digital, Patterns, RunHead, RunManifest
from mitsim.core.runs import Capture, Recorder, frame_name, load_run
from mitsim.devices.patterns import parse_patterns
from mitsim.reconstruct import request
from mitsim.reconstruct.accumulation import accumulate
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import POINT_SPREAD, Reconstruction, may_replace, reconstruct
from mitsim.reconstruct.request import ImageCost
from mitsim.reconstruct.solver import Accumulator, Prepared, Solution, Status, Verdict
from mitsim.reconstruct.solvers import SOLVERS, Tikhonov
from mitsim.report import reconstruct_run
from mitsim.report.reconstruct_run import reconstruct as reconstruct_folders
from tests.ideal_sessions import Bench, bench, picture

N, PIXELS = 4, 9


@pytest.fixture
def factors() -> Factors:
    rng = np.random.default_rng(7)
    left, right = (rng.random((PIXELS, N)).astype(np.float32).astype(np.float64) for _ in range(2))
    status = Status(Verdict.CALIBRATED, "Calibrated: responses are separable")
    return Factors(left, right, CalibrationManifest(camera={"name": "bench"}), status)


@pytest.fixture
def shots(factors: Factors) -> Capture:
    """Noisy frames of a scene under 2 x 2 Hadamard patterns, as pairs."""
    family, rng, memory = parse_patterns("hadamard:2", N), np.random.default_rng(2), Recorder()
    scene = rng.random((N, N))
    for index, shot in enumerate(family.shots):
        electrons = 1e4 * factors.left @ (family.light(shot) * scene) @ factors.right.T
        memory.write_frame(index, {"DN": rng.poisson(electrons).astype(np.uint32)}, {"row": shot.row})
    memory.write_truth(scene, 0.99)
    head = RunHead.of({"seed": 2})
    files = [frame_name(index) for index in range(len(family.shots))]
    return memory.finish(
        RunManifest(
            configuration=head.configuration,
            configuration_sha256=head.configuration_sha256,
            camera={"name": "bench"},
            digital=Digital(exposure_s=1e4, gain_dn_per_e=1.0, black_level_dn=0.0, dark_current_e_per_s=0.0),
            patterns=Patterns.of(family, files),
        )
    )


@pytest.mark.parametrize("method", SOLVERS)
def test_memory_and_disk_give_the_same_image(shots: Capture, factors: Factors, tmp_path: Path, method: str) -> None:
    memory = reconstruct(shots, factors, method=method)
    factors.save(tmp_path / "cal")
    disk = reconstruct(load_run(shots.save(tmp_path / "run")), factors, method=method)
    judged = reconstruct_folders(tmp_path / "run", tmp_path / "cal", tmp_path / "image", method=method)
    assert np.array_equal(memory.image, disk.image) and np.array_equal(memory.image, judged.reconstruction.image)
    assert memory.ok and memory.status.verdict is Verdict.SOLVED and memory.inputs == disk.inputs
    assert np.abs(memory.image - shots.truth).max() < 0.1
    quality = judged.quality
    assert quality.psnr_db > 20 and quality.ssim is None, "4 pixels are less than its window"


class Projected(Tikhonov):
    """Least squares without negative pixels, by projected gradients."""

    linear = False

    def compute(self, prepared: Prepared, frames: Accumulator, lam: float | str) -> Solution:
        problem = prepared.problem(frames)
        power = np.square(problem.sigma)
        image, spent = np.zeros((N, N)), 5000
        for _ in range(spent):
            slope = prepared.image(power * prepared.coefficients(image) - problem.sigma * problem.projected)
            image = np.maximum(image - slope / problem.scale, 0.0)
        residual = np.linalg.norm(problem.sigma * prepared.coefficients(image) - problem.projected)
        status = Status(Verdict.SOLVED, "Solved: no pixel is negative")
        return Solution(image, 0.0, float(residual / np.sqrt(problem.energy)), status, iterations=spent)


def test_a_further_solver(shots: Capture, factors: Factors, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Asked for by its name, judged for misfit, written and refused as all are. (Planted: its image replaced by the
    closed form's; uncertainties of an image that is not linear in the frames.)"""
    monkeypatch.setitem(SOLVERS, "projected", Projected())
    monkeypatch.setattr(request, "METHODS", (*request.METHODS, "projected"))
    found = reconstruct(shots, factors, method="projected")
    least = reconstruct(shots, factors, 0.0)
    assert str(found.status).startswith("Solved: no pixel is negative") and found.image.min() >= 0
    np.testing.assert_allclose(found.image, np.maximum(least.image, 0), atol=1e-5)
    assert found.uncertainties is None and found.misfit.unexplained == least.misfit.unexplained
    assert json.loads((found.save(tmp_path / "image") / "result.json").read_text())["inputs"]["method"] == "projected"
    with pytest.raises(
        MitsimError, match=r"use tikhonov, markov, nonnegative, tv.* projected or the file of a trained"
    ):
        reconstruct(shots, factors, method="positive")


def test_solvers_prepare_once_and_solve_any_number_of_scenes(shots: Capture, factors: Factors) -> None:
    """(Planted: sums of a scene that stay for the next.)"""
    for solver in SOLVERS.values():
        prepared = solver.init(factors, shots.patterns)
        images = []
        for scale in (1.0, 2.0, 1.0):
            sums = prepared.accumulator()
            for each in shots.pattern_measurements():
                sums.add(scale * each.frame, each.row, each.column)
            images.append(solver.compute(prepared, sums, 1e-9 if solver.linear else "auto").image)
        assert np.array_equal(images[0], images[2])
        np.testing.assert_allclose(images[1], 2 * images[0], rtol=1e-3)


def test_a_capture_of_another_camera_is_refused(shots: Capture, factors: Factors) -> None:
    """Sizes fit, so that nothing else would say it."""
    manifest = factors.manifest.model_copy(update={"camera": {"name": "other"}})
    with pytest.raises(MitsimError, match=r"name is other, but in .* it is bench; calibrate the run's camera"):
        reconstruct(shots, Factors(factors.left, factors.right, manifest, factors.status))
    geometry = {"mask": "plate", "mask_plate": "MURA of 101"}
    masked = manifest.model_copy(update={"camera": {**shots.manifest.camera, "geometry": geometry}})
    with pytest.raises(MitsimError, match=r"mask is MURA of 101, but in .* it is not stated; .* --calibration"):
        reconstruct(shots, Factors(factors.left, factors.right, masked, factors.status))


def test_what_an_image_takes_is_predicted_where_that_can_be_told(shots: Capture, factors: Factors) -> None:
    """By the stages that it states; every shot is read, and held against the model. (Planted: half of the shots.)"""
    image = reconstruct(shots, factors)
    assert image.predicted == ImageCost.of(shots, factors)
    assert image.white == 1.0 and replace(image, inputs={POINT_SPREAD: "x"}).white == image.image.max()
    assert image.predicted.seconds.keys() == image.seconds.keys()
    summary = image.summary()
    assert summary["predicted_seconds"] == sum(summary["predicted"].values()) > 0
    assert 1e8 < summary["predicted_memory_bytes"] < 2e8
    assert reconstruct(shots, factors, method="tv").summary()["predicted_memory_bytes"] is None


def test_memory_holds_the_model(shots: Capture, factors: Factors, monkeypatch: pytest.MonkeyPatch) -> None:
    """At least what the slabs and bases take, at most thirty times as much (of so few numbers)."""
    asked: list[float] = []
    monkeypatch.setattr(Cost, "check", lambda self, *_: asked.append(self.memory_bytes))
    prepared = accumulate(shots, factors).prepared
    sides = prepared.left, prepared.right
    held = sum(side.basis.nbytes + sum(slab.matrix.nbytes for slab in side.slabs) for side in sides)
    assert len(asked) == 1 and held <= asked[0] <= 30 * held


def test_noise_of_an_ambient_frame(shots: Capture, factors: Factors, monkeypatch: pytest.MonkeyPatch) -> None:
    """Means of its variance; of pairs, whose ambient light takes itself off, there is none."""
    variance = np.random.default_rng(0).random((PIXELS, PIXELS))
    ambient = SimpleNamespace(variance=variance, rate=np.zeros((PIXELS, PIXELS)))
    monkeypatch.setattr(Capture, "ambient", ambient)
    assert accumulate(shots, factors).noise.ambient is None
    patterns = shots.manifest.patterns
    halves = tuple(shot.model_copy(update={"sign": 0}) for shot in patterns.captures if shot.sign >= 0)
    manifest = shots.manifest.model_copy(update={"patterns": patterns.model_copy(update={"captures": halves})})
    by_row, by_column = accumulate(Capture(manifest, memory=shots._memory), factors).noise.ambient
    assert by_row == pytest.approx(variance.mean(axis=1)) and by_column == pytest.approx(variance.mean(axis=0))


def test_the_truth_is_not_looked_at(shots: Capture, factors: Factors, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Capture, "truth", property(lambda self: pytest.fail("looked at")))
    assert reconstruct(shots, factors).ok
    for path in (Path(mitsim.__file__).parent / "reconstruct").glob("*.py"):
        assert ".truth" not in path.read_text(encoding="utf-8"), path


def test_a_status_is_a_verdict_with_a_remedy(shots: Capture, factors: Factors) -> None:
    twin = factors.left.copy()
    twin[:, 1] = twin[:, 0]
    twins = Factors(twin, factors.right, factors.manifest, factors.status)
    lost = reconstruct(shots, Factors(np.ones_like(twin), factors.right, factors.manifest, factors.status), 0)
    assert lost.status.verdict is Verdict.RANK_DEFICIENT and not lost.ok
    assert lost.status.remedy == "use more patterns, or lambda above 0"
    assert str(lost.status).startswith(f"{lost.status.sentence}; {lost.status.remedy}. Rank 8 of 16")
    flagged = Factors(twins.left, twins.right, factors.manifest.model_copy(update={"warnings": ("old",)}), twins.status)
    result = reconstruct(shots, flagged, 1.0)
    assert not result.ok and str(result.status).endswith("In the calibration, old")
    assert Status(Verdict.SOLVED, "Solved", flags=("old",)).reasons == ("old",)
    assert "data:image/png" in result._repr_html_() and "old" in result._repr_html_()


def test_another_image_is_not_overwritten(shots: Capture, factors: Factors, tmp_path: Path) -> None:
    """A second `reconstruct` into the same folder replaced the first. (Planted: ``earlier`` not compared.)"""
    first = reconstruct(shots, factors, 1.0)
    first.save(tmp_path / "image")
    kept = (tmp_path / "image" / "image.exr").read_bytes()
    reconstruct(shots, factors, 1.0).save(tmp_path / "image")  # the same once more
    others = reconstruct(shots, factors, 2.0), reconstruct(shots, factors, 1.0, "tv")
    for other, words in zip(others, ("lambda differ", "method differ"), strict=True):
        with pytest.raises(MitsimError, match=rf"an image of other inputs \({words}\)"):
            other.save(tmp_path / "image")
    assert (tmp_path / "image" / "image.exr").read_bytes() == kept
    others[0].save(tmp_path / "image", overwrite=True)
    seen = read_frame(tmp_path / "image" / "image.exr")[0]["reflectance"]
    assert np.array_equal(seen, others[0].image.astype(np.float32))
    result = json.loads((tmp_path / "image" / "result.json").read_text())
    assert result["lambda"] == 2.0 and result["status"] == str(others[0].status)


def test_an_image_at_another_depth_is_another_image(tmp_path: Path) -> None:
    """One by ``focus`` gave way to one without. (Planted: only what is asked for now is compared.)"""
    asked: dict[str, str | float] = {"run": "a", "lambda": "auto"}
    (tmp_path / "image.exr").write_text("an image")
    for earlier in (asked, {**asked, "focus": 350.0}):
        (tmp_path / "result.json").write_text(json.dumps({"inputs": earlier}))
        if earlier == asked:
            assert may_replace(tmp_path, asked, overwrite=False)
            continue
        with pytest.raises(MitsimError, match=r"other inputs \(focus differ\)"):
            may_replace(tmp_path, asked, overwrite=False)
        assert may_replace(tmp_path, asked, overwrite=True)


def test_the_folders_are_refused_before_work(
    shots: Capture, factors: Factors, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = shots.save(tmp_path / "run"), factors.save(tmp_path / "cal"), tmp_path / "image"
    reconstruct_folders(*folders, lam=1.0)
    reconstruct_folders(*folders, lam=1.0)
    monkeypatch.setattr(reconstruct_run, "reconstruct_request", lambda *_: pytest.fail("work was done first"))
    with pytest.raises(MitsimError, match=r"other inputs \(lambda differ\).*overwrite=True"):
        reconstruct_folders(*folders, lam=2.0)
    (tmp_path / "image" / "result.json").unlink()
    with pytest.raises(MitsimError, match="run, calibration, lambda, method differ"):
        reconstruct_folders(*folders, lam=1.0)


# ---- Results in a notebook -------------------------------------------------------------------------------------------

# What a reconstruction shows of itself in a notebook: beside the image how far to trust each pixel, and why.


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
    assert image.uncertainties is not None
    assert [each.shape for each in pictures] == [(len(picture()), len(picture()))] * 2
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
        assert line.startswith(f"misfit: chi-square {image.misfit.chi_square:{digits}} a datum, ")
        assert cause in line and ("calibrated camera" in line) == bool(cause)


def test_what_is_not_known_is_not_shown() -> None:
    """Least total variation is not linear in the frames; as many data as unknowns tell no misfit."""
    tv = reconstruct(bench().run("dots:4", picture(), 0), bench().calibrated(0), method="tv")
    assert len(shown(tv)[0]) == 1 and [line[:6] for line in tv.trust] == ["misfit"]
    square = Bench(bench().left[: len(picture())], bench().right[: len(picture())])
    exact = reconstruct(square.run("uniform", picture(), 0), square.calibrated(0), 1.0)
    assert exact.misfit is None and [line[:20] for line in exact.trust] == ["standard uncertainty"]

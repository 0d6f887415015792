"""`reconstruct`: the same image from memory and from disk, a status that is an object, and no image that gets lost."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import mitsim.reconstruct
from mitsim.core.errors import MitsimError
from mitsim.core.framefile import read_frame
from mitsim.core.manifests import CalibrationManifest, Digital, Patterns, RunHead, RunManifest
from mitsim.core.runs import Capture, RunMemory, frame_name, load_run
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruction import reconstruct
from mitsim.reconstruct.status import Status, Verdict
from mitsim.rig.patterns import parse_patterns
from mitsim.study.quality import reconstruct as reconstruct_folders

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
    family, rng, memory = parse_patterns("hadamard:2", N), np.random.default_rng(2), RunMemory()
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


@pytest.mark.parametrize("method", ["tikhonov", "tv"])
def test_memory_and_disk_give_the_same_image(shots: Capture, factors: Factors, tmp_path: Path, method: str) -> None:
    memory = reconstruct(shots, factors, method=method)
    factors.save(tmp_path / "cal")
    disk = reconstruct(load_run(shots.save(tmp_path / "run")), factors, method=method)
    judged = reconstruct_folders(tmp_path / "run", tmp_path / "cal", tmp_path / "image", method=method)
    assert np.array_equal(memory.image, disk.image) and np.array_equal(memory.image, judged.reconstruction.image)
    assert memory.ok and memory.status.verdict is Verdict.SOLVED and memory.inputs == disk.inputs
    assert np.abs(memory.image - shots.truth).max() < 0.1
    quality = judged.quality
    assert quality is not None and quality.psnr_db > 20 and quality.ssim is None, "4 pixels are less than its window"


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
    assert not result.ok and str(result.status).endswith("The calibration was flagged: old.")
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
    assert np.array_equal(
        read_frame(tmp_path / "image" / "image.exr")[0]["reflectance"], others[0].image.astype(np.float32)
    )
    result = json.loads((tmp_path / "image" / "result.json").read_text())
    assert result["lambda"] == 2.0 and result["status"] == str(others[0].status)


def test_the_folders_are_refused_before_work(
    shots: Capture, factors: Factors, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = shots.save(tmp_path / "run"), factors.save(tmp_path / "cal"), tmp_path / "image"
    reconstruct_folders(*folders, 1.0)
    reconstruct_folders(*folders, 1.0)
    monkeypatch.setattr("mitsim.study.quality.solve", lambda *_: pytest.fail("work was done first"))
    with pytest.raises(MitsimError, match=r"other inputs \(lambda differ\).*overwrite=True"):
        reconstruct_folders(*folders, 2.0)
    (tmp_path / "image" / "result.json").unlink()
    with pytest.raises(MitsimError, match="run, calibration, lambda, method differ"):
        reconstruct_folders(*folders, 1.0)

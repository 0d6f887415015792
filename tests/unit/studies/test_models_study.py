"""The study of modelled factors: its points, the camera that they are of, and what it says of invented results; nothing
is rendered."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import pytest

from mitsim.devices.camera import CameraGeometry
from mitsim.report.pages import Value
from mitsim.studies import models_study
from mitsim.studies.framework.experiment import Results, Scope, Setup, find_experiment

STUDY = find_experiment("models")


def row(factors: str, frames: int, psnr: float, fraction: float = 0.8, seed: int = 0) -> dict[str, Value]:
    return {"factors": factors, "frames": frames, "psnr_db": psnr, "exposure_fraction": fraction, "seed": seed}


def results(wave: float) -> Results:
    """A session of 512 frames gives 48 and 50 dB, one of 2048 50 and 52, a wave-optical model of two frames ``wave``
    dB, of 16 51, a geometric one always 30."""
    rows = [row("measured", frames, psnr + seed * 2, seed=seed) for frames, psnr in ((512, 48.0), (2048, 50.0))
            for seed in (0, 1)]  # fmt: skip
    for seed in (0, 1):  # pairs differ alike
        rows += [row("wave", 2, wave - 1 + seed * 2, seed=seed), row("wave", 16, 50.0 + seed * 2, seed=seed)]
        rows += [row("geometric", frames, 29.0 + seed * 2, seed=seed) for frames in (2, 16)]
    return Results(rows)


def test_points_are_models_by_frames_and_sessions_by_how_they_are_taken() -> None:
    """Of both exposures and two seeds; a quick study is a start of the whole. (Planted: repeats of the wrong session;
    sessions of as many frames as models.)"""
    points, few = (STUDY.points(Scope(Setup(), ("astronaut", "page"), quick=quick)) for quick in (False, True))
    assert len({point.key for point in points}) == len(points) == 2 * 2 * 2 * (3 + 2 * 5)
    assert {point.key for point in few} <= {point.key for point in points} and len(few) == 3 + 2 * 2
    taken = {point["mode"]: models_study._recipe(point) for point in points if point["factors"] == "measured"}
    assert {mode: (recipe.signed_capture, recipe.repeats) for mode, recipe in taken.items()} == {
        "uniform": ("uniform", 1), "pair": ("pair", 1), "pair x 4": ("pair", 4)
    }  # fmt: skip
    assert {point["wanted"] for point in points if point["factors"] == "wave"} == {2, 4, 8, 16, 64}
    assert {models_study._recipe(point).exposure_fraction for point in points} == {0.8, 0.01}


@dataclass(frozen=True)
class ToyDevices:
    camera: CameraGeometry


@dataclass(frozen=True)
class ToyBench:
    devices: ToyDevices

    @property
    def geometry(self) -> CameraGeometry:
        return self.devices.camera


def test_the_camera_as_built_has_its_mask_off_its_place() -> None:
    """(Planted: rows and columns exchanged; the offset in place of what is added to it.)"""
    camera = CameraGeometry(pixels=64, pixel_pitch=0.02, mask_distance=2.0, scene_distance=400.0, mask_offset_row=0.01)
    built = models_study.as_built(cast(Any, ToyBench(ToyDevices(camera)))).devices.camera
    assert built.mask_distance == pytest.approx(2.05)
    assert (built.mask_offset_row, built.mask_offset_column) == pytest.approx((0.047, -0.021))


@pytest.mark.parametrize(("wave", "enough"), [(50.6, 2), (50.4, 16)])
def test_few_frames_suffice_where_their_image_is_as_good_as_the_longest_sessions(wave: float, enough: int) -> None:
    """Within 0.5 dB of 51.0. (Planted: the shortest session's image; the mean over all frames.)"""
    wave_claim, geometric = STUDY.judge(results(wave))
    assert wave_claim.verdict == "confirmed" and geometric.verdict == "not confirmed"
    assert f"with {enough} frames; measured factors 51.0 \N{PLUS-MINUS SIGN} 1.0 dB with 2048" in wave_claim.rendered
    assert (
        geometric.rendered.startswith("30.0 \N{PLUS-MINUS SIGN} 1.0 dB with 16 frames")
        and "0.8 of the full well" in geometric.claim
    )


def test_each_exposure_is_a_panel_with_all_factors() -> None:
    both = results(51.0)
    dim = tuple({**one, "exposure_fraction": 0.01} for one in both.rows)
    figures = STUDY.draw(Results([*both.rows, *dim]))
    (figure,) = figures.values()
    assert [axes.get_title() for axes in figure.axes][:2] == [
        f"brightest pixel at {fraction} of the full well" for fraction in ("0.8", "0.01")
    ]

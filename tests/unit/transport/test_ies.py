"""Lamps of IES profiles against their files' candelas, closed forms and quadrature."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsim.api.bench import open_bench
from mitsim.core.errors import MitsimError
from mitsim.scene.headers import read_ies
from mitsim.transport.plugins import ies
from tests.hard.hard_light import HALF, MIRROR_Z, SCALE, gauss, matt, plate

LAMP, AIM = np.array([-20.0, 90.0, 360.0]), np.array([10.0, 60.0, 395.0])
VERTICAL = np.linspace(0, 90, 19)
PEAK, ALBEDO = 2e5, 0.5
EMITTER = """<emitter type="mitsim_ies"><string name="filename" value="lamp.ies"/>
    <float name="intensity" value="2e5"/><transform name="to_world"><lookat origin="-20, 90, 360"
    target="10, 60, 395" up="1, 0, 0"/></transform></emitter>"""
TURNED = f'<scale x="{HALF}" y="{HALF}"/><rotate y="1" angle="180"/><translate x="30" z="{MIRROR_Z}"/>'


SIDES: dict[int, tuple[Callable[..., np.ndarray], float]] = {
    0: (np.ones_like, 2 * np.pi),
    90: (lambda turn: np.abs(np.cos(turn)), 4.0),
    180: (np.cos, 0.0),
    360: (np.sin, 0.0),
}
"""Dependence on the horizontal angle and its integral over a turn, by the last angle that a file states."""


def shape(vertical: np.ndarray, horizontal: np.ndarray, end: int = 180) -> np.ndarray:
    """Candelas / 100 by angles in degrees: a beam that is stronger on some sides."""
    v = np.radians(vertical)
    beam = np.cos(v) ** 3 * (1 + 0.8 * np.sin(v) * SIDES[end][0](np.radians(horizontal)))
    return np.where(vertical <= 90, 0.1 + beam, 0)


def text(end: int = 180, kind: int = 1) -> str:
    horizontal = np.linspace(0, end, 1 + end // 5)
    rows = 100 * shape(VERTICAL[None], horizontal[:, None], end)
    lines = [f"1 -1 1 {len(VERTICAL)} {len(horizontal)} {kind} 2 0 0 0", "1 1 10", VERTICAL, horizontal, *rows]
    body = "\n".join(each if isinstance(each, str) else " ".join(f"{one:.5f}" for one in each) for each in lines)
    return f"IESNA:LM-63-2002\n[TEST] none\nTILT=NONE\n{body}\n"


def on_plate(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Irradiance of the lamp on the plate at z = MIRROR_Z: I cos / d^2."""
    away = np.stack(np.broadcast_arrays(x, y, MIRROR_Z), axis=-1) - LAMP
    axis = (AIM - LAMP) / np.linalg.norm(AIM - LAMP)
    left = np.cross([1, 0, 0], axis)  # Mitsuba's look-at: x = up x z, y = z x x
    frame = np.stack([left / np.linalg.norm(left), np.cross(axis, left / np.linalg.norm(left)), axis])
    d = np.linalg.norm(away, axis=-1)
    local = away @ frame.T / d[..., None]
    turn = np.abs(np.degrees(np.arctan2(local[..., 1], local[..., 0])))
    part = shape(np.degrees(np.arccos(local[..., 2])), turn) / shape(VERTICAL, np.zeros(19)).max()
    return PEAK * part * away[..., 2] / d**3


def test_both_estimators_see_the_plate_that_a_profile_lights(small_scene: Callable[..., Path], variant: str) -> None:
    """Against quadrature; the table's steps of 5 degrees are right to 2e-3."""
    path = small_scene("lamp", n=16, mask="open", pitch=0.1, sheet_z=-500, extra=plate(TURNED, matt(ALBEDO)) + EMITTER)
    path.with_name("lamp.ies").write_text(text())
    bench = open_bench(path, variant, for_render=True)
    (x, wx), (y, wy) = gauss(0, 2 * HALF), gauss(-HALF, HALF)
    x, y = np.meshgrid(x, y, indexing="ij")
    some = np.ix_(*[np.arange(4, 64, 8)] * 2)
    expected = np.zeros((2, 8, 8))
    for i, row in enumerate(bench.geometry.centres(1)[some[0].ravel()]):
        for j, column in enumerate(bench.geometry.centres(1)[some[0].ravel()]):
            r = np.sqrt((x + column) ** 2 + (y + row) ** 2 + MIRROR_Z**2)
            kernel = np.outer(wx, wy) * ALBEDO / np.pi * MIRROR_Z**2 / r**4
            expected[:, i, j] = (kernel * on_plate(x, y)).sum(), (kernel * np.pi * SCALE / MIRROR_Z**2).sum()
    total = expected.sum(axis=0)
    assert expected[0].sum() > 0.5 * total.sum()
    for estimator, request in (("factored", {"accuracy": 3e-3}), ("reference", {"spp": 256})):
        frame = bench.render(estimator, **request)
        error = np.linalg.norm(frame.error) / frame.mean.sum() if estimator == "reference" else 3e-3
        assert abs(frame.mean.mean() / total.mean() - 1) < 3 * error + 2e-3 < 0.015


@pytest.mark.parametrize("end", [*SIDES])
def test_light_in_all_directions_is_that_of_the_file(tmp_path: Path, variant: str, end: int) -> None:
    """Light at random points against I / d^2, and lumens against their integral, for each symmetry of type C.

    (Planted: no mirror image of a half turn or a quarter; a turn without wrap; vertical angles from -z; light / d.)
    """
    (tmp_path / "lamp.ies").write_text(text(end))
    profile = ies.even_profile(*read_ies(tmp_path / "lamp.ies"))
    lumens = np.radians(0.5) ** 2 * (profile[:-1] * np.sin(np.radians(np.arange(361) / 2))).sum()
    assert lumens == pytest.approx(100 * (0.1 * 2 * np.pi + 2 * np.pi / 4 + 0.8 * 2 / 15 * SIDES[end][1]), rel=5e-3)
    lamp = mi.load_dict({"type": "mitsim_ies", "filename": str(tmp_path / "lamp.ies"), "intensity": 3.0})
    points = np.random.default_rng(end).normal(size=(3, 2000))
    at = dr.zeros(mi.SurfaceInteraction3f, 2000)
    at.p, d = mi.Point3f(points.astype(np.float32)), np.linalg.norm(points, axis=0)
    ds, light = lamp.sample_direction(at, mi.Point2f(0.5))
    vertical, turn = np.degrees(np.arccos(points[2] / d)), np.degrees(np.arctan2(points[1], points[0])) % 360
    peak = shape(VERTICAL[None], np.arange(360)[:, None], end).max()
    found, some = np.array(light[0]) * d**2, np.abs(vertical - 90) > 0.5  # where the profile ends
    np.testing.assert_allclose(found[some], 3 * shape(vertical, turn, end)[some] / peak, atol=3e-2)
    np.testing.assert_allclose(np.array(ds.d) * d, -points, atol=1e-5)


def test_damaged_profiles_are_refused_in_one_line(small_scene: Callable[..., Path], variant: str) -> None:
    path = small_scene("lamp", n=16, mask="open", extra=EMITTER)
    good = text()
    wrong = {
        "without tilt": good.replace("NONE\n", "INCLUDE\n"),
        "no numbers": good.replace("\n110.00000", "\nmany"),
        "are no numbers": good.replace("\n110.00000", "\nnan"),
        "type 2": text(kind=2),
        "claims 18 x 37": good.replace("1 19 37", "1 18 37"),
        "claims 19 x 1e": good.replace("1 19 37", "1 19 1e12"),
        "angles beyond": good.replace("\n0.00000 5.00000", "\n-1.00000 5.00000", 1),
        "do not grow": good.replace("10.00000", "1.00000", 1),
        "angles that do not grow": good.replace("175.00000", "170.00000", 1),
        "negative candelas": good.replace("\n110.00000", "\n-110.00000"),
    }
    for words, content in wrong.items():
        path.with_name("lamp.ies").write_text(content)
        with pytest.raises(MitsimError, match=f"lamp.ies.*{words}") as refused:
            open_bench(path, variant, for_render=True)
        assert "\n" not in str(refused.value) and f"{path}:" in str(refused.value)

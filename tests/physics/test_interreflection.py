"""Light of many reflections against answers that no renderer had a part in.

Two scenes, each under the four classes of ``dots:2`` on 15 x 15 pixels (an odd number, so that no two classes are
equal). In a *corner* of two diffuse walls the radiosity equation is solved numerically
(:mod:`tests.physics.radiosity`). Inside a diffuse *sphere* light of two and more reflections has a closed form: it is
the same everywhere, wherever the projector shines.

Light of one reflection and of more are gated apart. Gates are SIGMAS standard errors of the estimator plus the judge's
own error; five sigma is a chance of 6e-7 a comparison. Each test asserts that its gate is narrow enough to see the
mistake it is there for. Seeds are fixed.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.physics.radiosity import ROOT2, SCALE, WALLS, Corner, Furnace, gauss

pytestmark = pytest.mark.usefixtures("variant")
SIGMAS = 5.0
JUDGE_ERROR = (
    1e-3  # of the corner's light of more than one reflection, relative; the tests of the judge hold it to that
)
N, K, PIXELS, PITCH = 15, 2, 64, 0.09375  # a sensor of 6 mm
HALF = PIXELS * PITCH / 2
GROUPS = 32
"""Independent parts whose spread is the factored estimator's error; five sigma of a t with 31 degrees: 2e-5."""
WALL = """<shape type="rectangle">
    <transform name="to_world"><matrix value="{x} 0 {nx} {cx}  0 80 0 0  {z} 0 {nz} {cz}  0 0 0 1"/></transform>
    <bsdf type="diffuse"><spectrum name="reflectance" value="{rho}"/></bsdf></shape>"""
SPHERE = """<shape type="sphere"><point name="center" x="0" y="0" z="180"/><float name="radius" value="220"/>
    <boolean name="flip_normals" value="true"/>
    <bsdf type="diffuse"><spectrum name="reflectance" value="{rho}"/></bsdf></shape>"""


@dataclass(frozen=True)
class Measured:
    """Irradiance of the unmasked sensor under each class, its quadrants' means: (k^2, 2, 2), and standard errors.

    ``one`` reflection, and ``more``; quadrant [row, column] as in a frame: row 0 at +y, column 0 at +x.
    """

    one: np.ndarray
    one_error: np.ndarray
    more: np.ndarray
    more_error: np.ndarray


def factored(scene: Path, spp: int, seed: int) -> Measured:
    """The factored estimator: light accumulated and made into frames as a capture does, in GROUPS independent parts.

    Light of one reflection is traced apart from light of more.
    """
    from mitsim.api.bench import open_bench
    from mitsim.light.passes import Simulation, expected_of
    from mitsim.light.settings import Settings

    bench = open_bench(scene, for_render=True)
    family = bench.family(f"dots:{K}", 0)
    lighting = family.lighting
    settings = Settings(depth=400.0, anchors=3, effects=frozenset({"interreflection"}))
    # Cells as narrow as a real projector's: the wide ones of 15 pixels would hide light lost at the field stop's rim.
    simulation = Simulation(bench, settings, pixels=8 * N)
    samples = max(1, spp // 256)
    quadrants = []
    for group in range(GROUPS):
        own = 1000 * seed + group
        one, more = (
            [
                simulation.accumulate(name, each.tracer.trace(own, 0, count), lighting.labels, count)
                for name, each in simulation.passes.items()
                if name in names
            ]
            for names, count in ((("direct", "anchor_residual"), samples), (("indirect",), 64 * samples))
        )
        for light in (sum(one[1:], one[0]), more[0]):
            frames = [frame.irradiance for frame in expected_of([(simulation, [light])], np.arange(K**2), lighting, 0)]
            quadrants.append(np.reshape(frames, (K**2, 2, PIXELS // 2, 2, PIXELS // 2)).mean(axis=(2, 4)))
    values = np.reshape(quadrants, (GROUPS, 2, K**2, 2, 2))
    mean, error = values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(GROUPS)
    return Measured(mean[0], error[0], mean[1], error[1])


def write_scene(small_scene: Callable[..., Path], name: str, shapes: str) -> Path:
    """The small scene, with these shapes in place of its sheet."""
    scene = small_scene(name, n=N, mask="open", pixels=PIXELS, pitch=PITCH)
    text, replaced = re.subn(r'<shape type="rectangle">.*?</shape>', shapes, scene.read_text(), flags=re.DOTALL)
    assert replaced == 1
    scene.write_text(text)
    return scene


def write_corner(small_scene: Callable[..., Path], rho: float) -> Path:
    walls = [
        # Axes 60 mm (from the edge) and 80 mm (up); the third is the normal, which faces the camera.
        WALL.format(x=-side * x, z=x, nx=-side / ROOT2, nz=-1 / ROOT2, cx=side * x, cz=450 - x, rho=rho)
        for side, x in ((1, 60 / ROOT2), (-1, -60 / ROOT2))
        for x in (abs(x),)
    ]
    return write_scene(small_scene, "corner", "".join(walls))


def check(found: np.ndarray, error: np.ndarray, expected: np.ndarray, judge: float, sees: float, what: str) -> None:
    """Every class and quadrant within the gate, and their mean within its own; the mean must see a share ``sees``."""
    gate = SIGMAS * error + judge * expected
    assert (abs(found - expected) < gate).all(), f"{what}: z {((found - expected) / error).round(1).tolist()}"
    mean_gate = SIGMAS * np.linalg.norm(error) / error.size + judge * expected.mean()
    assert mean_gate < sees * expected.mean(), f"{what}: too few samples to see {sees:.1%}"
    assert abs(found.mean() - expected.mean()) < mean_gate, f"{what}: {found.mean() / expected.mean() - 1:+.2%}"


# ---- the judge of the corner judged


def test_the_radiosity_solution_converges() -> None:
    """Patches are second order: a third of the last change is left. Strips and direction matter far less."""
    coarse, fine, finest = (Corner(0.8, N, K, cells=cells).expected()[1] for cells in (12, 24, 40))
    assert (abs(finest - fine) < abs(fine - coarse) / 3).all()
    limit = finest + (finest - fine) / 3
    assert abs(fine / limit - 1).max() < 0.5 * JUDGE_ERROR
    strips = Corner(0.8, N, K, strips=80).expected()[1]
    assert abs(strips / fine - 1).max() < 1e-5


def test_light_followed_forward_gives_what_importance_gives() -> None:
    """Radiance of the walls, integrated over the field stop, for all classes together: another route to the number."""
    corner, found = Corner(0.8, N, K), 0.0
    t_x, d_x = gauss(0.0, corner.tan_half, 24)
    z = 450 / (1 + t_x)
    t_y, d_y = gauss(*(sign * np.minimum(corner.tan_half, 80 / z) for sign in (-1, 1)), 60)
    weight = (d_x[:, None] * d_y / (1 + t_x[:, None] ** 2 + t_y**2) ** 2).ravel()
    a = np.broadcast_to((ROOT2 * (450 - z))[:, None], t_y.shape).ravel()
    for wall in WALLS:
        found += weight @ corner.radiance(wall, a, (t_y * z[:, None]).ravel())[1]
    expected = corner.expected()[1]
    assert found.sum() == pytest.approx(expected.sum(), rel=JUDGE_ERROR)
    # Single classes are striped on the walls, which this quadrature resolves less well.
    assert found == pytest.approx(expected, rel=3 * JUDGE_ERROR)


def test_radiance_of_one_reflection_is_that_of_its_irradiance() -> None:
    """At (a, y) = (30, 10) of wall A: E = pi scale n.(P - x) / z^3 worked out by hand, in the class of its pixel."""
    x = np.array([30 / ROOT2, 10.0, 450 - 30 / ROOT2])
    normal, away = np.array([-1, 0, -1]) / ROOT2, np.array([60.0, 0, 0]) - x
    by_hand = 0.8 * SCALE * normal @ away / x[2] ** 3
    row, column = (0.15 - x[1] / x[2]) / 0.3 * N, (60 - x[0]) / x[2] / 0.3 * N
    one, more = Corner(0.8, N, K).radiance(0, np.array([30.0]), np.array([10.0]))
    expected = np.zeros(4)
    expected[int(row) % 2 * 2 + int(column) % 2] = by_hand
    assert one[0] == pytest.approx(expected)
    assert 0.1 * by_hand < more.sum() < by_hand


# ---- estimators


@pytest.mark.parametrize("rho", [pytest.param(0.3, marks=pytest.mark.slow), 0.8])
def test_corner(small_scene: Callable[..., Path], rho: float) -> None:
    found = factored(write_corner(small_scene, rho), 256, 7)
    corner, places = Corner(rho, N, K), np.array([1, -1]) * HALF / 2
    expected = np.array([[corner.expected(x, y) for x in places] for y in places])  # row 0 at +y, column 0 at +x
    one, more = expected.transpose(2, 3, 0, 1)
    check(found.one, found.one_error, one, 1e-5, 0.01, "one reflection")
    check(found.more, found.more_error, more, JUDGE_ERROR, 0.015, "more reflections")


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.3, 0.6, 0.9])
def test_furnace(small_scene: Callable[..., Path], rho: float) -> None:
    scene = write_scene(small_scene, "furnace", SPHERE.format(rho=rho))
    found, furnace = factored(scene, 256, 11), Furnace(rho)
    tan_half = float(np.tan(np.radians(10)))
    share = np.outer([8, 7], [8, 7]).ravel() / N**2  # of the window's pixels: rows and columns 0, 2, ... and 1, 3, ...
    expected = furnace.indirect(tan_half) * np.broadcast_to(share[:, None, None], (K**2, 2, 2))
    check(found.more, found.more_error, expected, 0.0, 0.03, "more reflections")
    # Of one reflection, all classes and the whole sensor together: quadrature at the centre, falloff is second order.
    one, error = found.one.mean(axis=(1, 2)).sum(), np.linalg.norm(found.one_error) / K**2
    assert abs(one - furnace.direct()) < SIGMAS * error + 1e-4 * one < 0.01 * one

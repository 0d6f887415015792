"""With every effect off a simulation is the plain geometric model; each effect changes its own part and no other."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.devices.patterns import Lighting
from mitsim.light.passes import LightEstimate, Simulation, emission, expected_of
from mitsim.light.settings import Settings, SharpPixels
from mitsim.optics.image_formation import FrameOptics
from mitsim.optics.shadow import Directions
from mitsim.transport.records import AMBIENT, PathSamples

pytestmark = pytest.mark.usefixtures("variant")
N, Z, BLACK = 16, 400.0, 0.01
NON_IDEAL = """
name = "lens, spot and grey black"
effective_wavelength_nm = 562.0
wavelengths_nm = [450.0, 640.0]
radiant_shares = [0.5, 0.5]
contrast_ratio = 100.0
aperture_radius_mm = 3.0
focus_mm = 300.0
blur_pixels = 0.6
ansi_contrast = 20.0
"""
NUMBERS = (
    '<float name="mask_thickness" value="0.05"/><float name="pixel_fill_factor" value="0.6"/>'
    '<float name="angular_exponent" value="3"/>'
)
LAMP = '<emitter type="constant"><spectrum name="radiance" value="0.2"/></emitter>'
MIRROR = """<shape type="rectangle"><transform name="to_world"><scale x="5" y="5"/><rotate y="1" angle="170"/>
    <translate x="-90" z="300"/></transform><bsdf type="conductor"/></shape>"""


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str, tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """Everything that an effect could act on."""
    path = shared_scene("everything", extra=LAMP + MIRROR)
    path.write_text(
        path.read_text().replace('<float name="fov" value="20"/>', f'<float name="fov" value="20"/>{NUMBERS}')
    )
    projector = tmp_path_factory.mktemp("projector") / "projector.toml"
    projector.write_text(NON_IDEAL)
    return open_bench(path, variant, projector=projector)


def simulation(bench: Bench, *effects: str, **settings: object) -> Simulation:
    return Simulation(bench, Settings(depth=Z, effects=frozenset(effects), **settings))


def uniform(made: Simulation, samples: int = 8, weight: float = 1.0) -> np.ndarray:
    """The frame of one capture with every pixel alike."""
    labels = np.zeros(N * N, dtype=np.int64)
    light = made.accumulate("direct", made.direct.trace(3, 0, samples), labels, samples)
    light = light + made.accumulate("indirect", made.follow(3, 4), labels, 4)
    (frame,) = expected_of([(made, [light])], np.zeros(1, dtype=np.int64), Lighting(labels, np.array([[weight]])), 0)
    return frame.irradiance


def test_every_effect_off_is_the_geometric_model(bench: Bench) -> None:
    """The board's radiance L through the mask's shadow: integrals of (1 + t^2)^-2 over the projector's pixels.

    Nothing of it comes from the simulation: no lens, no spot, a thin mask, whole pixels, no lamp and no bounce.
    """
    plain = bench.geometry.model_copy(update={"mask_thickness": 0.0, "pixel_fill_factor": 1.0, "angular_exponent": 0.0})
    edges = np.linspace(-0.15, 0.15, N + 1)
    cells = Directions.cells(edges)
    node, weight = np.polynomial.legendre.leggauss(5)
    tau = ((edges[:-1] + edges[1:])[:, None] / 2 + node * 0.15 / N).ravel()
    weights = np.tile(weight * 0.15 / N, N)
    light = np.outer(weights, weights) * (1 + np.square(tau)[:, None] + np.square(tau)[None, :]) ** -2
    light = 0.5 * 111000 / Z**2 * light.reshape(N, 5, N, 5).sum(axis=(1, 3))
    expected = FrameOptics(plain, cells, cells, (Z,), 1).frame(np.arange(N * N), light.ravel())
    # One path in a thousand or so of the mirror's corner is missing: the board behind it (10 mm) is out of sight.
    found = uniform(simulation(bench), 256)
    assert np.linalg.norm(found - expected) < 2e-3 * np.linalg.norm(expected)
    assert simulation(bench).physics.geometry == plain


PARTS = (
    *("interreflection", "mirrors", "ambient", "diffraction", "mask-thickness", "pixel-response", "aperture", "blur"),
    *("glare", "black-level"),
)
"""Effects that are told by what is simulated here."""


@pytest.mark.parametrize("effect", PARTS)
def test_each_effect_changes_its_own_part(bench: Bench, effect: str) -> None:
    """That no other effect's values change is held of all of them: tests/unit/bench/test_effects.py."""
    on, off = simulation(bench, effect), simulation(bench)
    changed = {
        "mask-thickness": on.physics.geometry.mask_thickness == 0.05,
        "pixel-response": (on.physics.geometry.pixel_fill_factor, on.physics.geometry.angular_exponent) == (0.6, 3.0),
        "aperture": (on.physics.projector.aperture, on.physics.projector.focus) == (3.0, 300.0),
        "blur": on.physics.projector.blur == 0.6,
        "glare": on.physics.projector.share < 1 and on.glare is not None,
        "black-level": on.physics.black_level == pytest.approx(BLACK),
        "diffraction": on.physics.spectrum is not None,
        "ambient": bool(on.physics.lamps) and on.from_camera is not None and len(on.from_camera.paths.emitters) == 1,
        "interreflection": on.indirect is not None and on.indirect.paths.interreflection,
        "mirrors": on.indirect is not None and on.indirect.paths.mirrors and on.from_camera.paths.mirrors,
    }
    assert [name for name, holds in changed.items() if holds] == [effect]
    if effect not in ("mask-thickness", "pixel-response"):
        assert on.physics.geometry == off.physics.geometry
    if effect not in ("aperture", "blur"):
        assert on.physics.projector.ideal


def test_black_is_a_part_of_white(bench: Bench) -> None:
    """A dark capture is the black level of a white one, and white is white."""
    made = simulation(bench, "black-level")
    white, dark, plain = uniform(made), uniform(made, weight=0.0), uniform(simulation(bench))
    assert np.allclose(dark, BLACK * white, rtol=1e-9) and np.allclose(white, plain, rtol=1e-9)
    assert not uniform(simulation(bench), weight=0.0).any()


def test_indirect_light_goes_to_its_own_cells(bench: Bench) -> None:
    made = simulation(bench, "interreflection", "ambient", subdivision=2)
    assert made.grids["fine"].bundle.cells == tuple(2 * count for count in made.grids["indirect"].bundle.cells)
    labels = np.zeros(N * N, dtype=np.int64)
    found = made.follow(1, 64)
    light = made.accumulate("indirect", found, labels, 64)
    kinds = {kind: found.value[found.kind == kind].sum() / 64 for kind in (0, 2)}
    assert light["fine"][[1]].sum() == pytest.approx(kinds[0], rel=0.02) and not light["fine"][[0]].nnz
    assert light["indirect"].sum() == pytest.approx(kinds[2], rel=0.02) and not light["anchor_residual"].nnz


def test_followed_lights_mean_and_its_anchors_make_one_frame(bench: Bench) -> None:
    """With the same light at all anchors nothing is left beyond the mean; ambient light is seen from random points."""
    made = simulation(bench, "interreflection", "mirrors", "ambient", followed_anchors=2)
    residuals = "indirect_residual", "camera_residual"
    assert set(made.passes) == {"direct", "indirect", "from_camera", *residuals}
    labels = np.zeros(N * N, dtype=np.int64)
    assert (made.passes[residuals[1]].tracer.trace(1, 0, 16).kind == AMBIENT).any()
    rng = np.random.default_rng(1)
    number, place = rng.integers(0, 2, (3, 200)), rng.uniform(-0.14, 0.14, (2, 200))
    found = PathSamples(0 * number[0], *number[:2], *place, np.full(200, 1 / Z), rng.random(200), 1 + number[2])
    light = made.accumulate("indirect_residual", found, labels, 16)["indirect_residual"][[0]].toarray()
    rows, columns = made.grids["indirect_residual"].bundle.cells
    weights = [0.5, 0.5]
    assert np.abs(np.einsum("a,b,aybx->yx", weights, weights, light.reshape(2, rows, 2, columns))).max() < 1e-12
    one = found.where((found.anchor_row == 0) & (found.anchor_column == 0))
    same = [
        replace(one, anchor_row=one.anchor_row + a, anchor_column=one.anchor_column + b) for a, b in np.ndindex(2, 2)
    ]
    light = made.accumulate("indirect_residual", PathSamples.join(same), labels, 16)["indirect_residual"]
    assert np.abs(light.data).max(initial=0) < 1e-15
    ambient = [made.from_camera.trace(seed, 0, 64) for seed in range(2)]
    assert all((one.kind == AMBIENT).any() for one in ambient)


def test_flux_counts_each_pixels_direct_light(bench: Bench) -> None:
    made = simulation(bench)
    found = made.direct.trace(1, 0, 2)
    assert made.flux(found, 2) == pytest.approx(np.bincount(found.pixel, found.value, N * N) / 2)
    ambient = replace(found, pixel=np.full_like(found.pixel, N * N), kind=0 * found.kind)
    indirect = replace(found, kind=0 * found.kind + 2)
    assert (
        not made.flux(indirect, 2).any()
        and not made.flux(ambient, 2).any()
        and not made.flux(PathSamples.none(), 1).any()
    )


# -------- Direct light that is accumulated on the device
#
# Direct light that is accumulated on the device: what the host accumulates of the same paths, place by place.

BALL = """<shape type="sphere"><point name="center" x="10" y="5" z="330"/><float name="radius" value="20"/>
    <bsdf type="roughconductor"><string name="material" value="none"/>
    <float name="alpha" value="0.05"/></bsdf></shape>"""
SAMPLES = 96
SETTINGS = Settings(
    depth=380.0,
    anchors=3,
    layers=(400.0, 350.0, 310.0),
    coarse_layers=True,
    subdivision=2,
    # A window that holds most of the light of these pixels, and not all.
    sharp=SharpPixels(tuple(range(50, 200, 7)), 3, (-0.03, 0.05, -0.03, 0.05)),
    samples={"anchor_residual": SAMPLES, "sharp": 1000.0},
)


@pytest.fixture(scope="module")
def ball(shared_scene: Callable[..., Path], variant: str) -> Bench:
    """A ball before the sheet, seen by a sensor of 6.4 mm."""
    return open_bench(shared_scene("ball", n=N, pitch=0.1, extra=BALL), variant, for_render=True)


def both(simulation: Simulation, name: str, labels: np.ndarray) -> tuple[LightEstimate, LightEstimate]:
    """Light of a pass by the host and by the device."""
    each = simulation.passes[name]
    path_samples, accumulator = each.trace(3, 0, SAMPLES), simulation.accumulator(name, labels, 1)
    assert accumulator is not None
    rest = each.trace(3, 0, SAMPLES, accumulator)
    assert not len(rest.value) and len(path_samples.value) > 1000
    (sums,) = accumulator.fetch()
    host, device = (simulation.accumulate(name, found, labels, SAMPLES) for found in (path_samples, sums))
    return host, device


@pytest.mark.parametrize("name", ["anchor_residual", "sharp"])
def test_the_device_adds_up_what_the_host_does(ball: Bench, name: str) -> None:
    """Light between layers and between cells is split, not drawn. (Planted: rows and columns of anchors exchanged; the
    nearer layer's part for the farther; the first cell of two alone; what lies outside accumulated as the first
    anchor's; pixels' rows for classes'.)"""
    labels = np.random.default_rng(1).integers(0, 5, N * N)
    host, device = both(Simulation(ball, SETTINGS), name, labels)
    expected, found = (light[name].toarray() for light in (host, device))
    assert found.shape == expected.shape and np.count_nonzero(expected) > 500
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=2e-5 * np.abs(expected).max())
    assert np.abs(found - expected).sum() < 2e-5 * np.abs(expected).sum()
    if name == "sharp":
        assert 0 < host.outside < 0.5 * host.received
        assert (device.received, device.outside) == pytest.approx((host.received, host.outside), rel=1e-5)
        np.testing.assert_allclose(device.flux, host.flux, rtol=1e-5, atol=1e-7 * host.flux.max())


def test_few_paths_for_many_cells_are_left_to_the_host(ball: Bench) -> None:
    """An accumulator would be mostly empty. (Planted: always an accumulator.)"""
    labels = np.arange(N * N) % 49
    names = "anchor_residual", "sharp"
    few = Simulation(ball, replace(SETTINGS, samples=dict.fromkeys(names, 1.0)))
    many = Simulation(ball, replace(SETTINGS, samples=dict.fromkeys(names, 1000.0)))
    assert all(few.accumulator(name, labels, 1) is None for name in names)
    assert all(many.accumulator(name, labels, 3) is not None for name in names)


def test_the_middle_of_the_sharpest_lobe_is_light(ball: Bench, variant: str) -> None:
    """Accumulators refuse what is no light; what the sharpest lobe of Mitsuba brings is, and what is dim is not rounded
    away. (Planted: light compared to a board's own; `_LOBE` of 2^20.)"""
    simulation = Simulation(ball, SETTINGS)
    tracer = simulation.anchored
    assert tracer is not None
    lobe = mi.load_dict({"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": 1e-6})
    square = dr.zeros(mi.SurfaceInteraction3f)
    square.wi = mi.Vector3f(0, 0, 1)
    brightest = math.pi * float(np.max(np.array(lobe.eval(mi.BSDFContext(), square, mi.Vector3f(0, 0, 1)))))
    assert brightest > 2e7
    board = tracer.setup.board
    accumulator = simulation.accumulator("anchor_residual", np.zeros(N * N, dtype=np.int64), 1)
    for place, light in enumerate([10 * brightest * board, 1e-5 * board]):
        accumulator.add([mi.Float(light)], mi.UInt32(0), mi.UInt32(place))
    accumulated, *_ = accumulator.fetch()[0].light()
    np.testing.assert_allclose(accumulated.toarray()[0, :2] / board, [10 * brightest, 1e-5], rtol=0.02)


# -------- Glare
#
# A traced chessboard has its projector's ANSI contrast.

FIELD, GROUPS, RAYS = 4, 8, 256
CONTRAST = 20.0
PROJECTOR = f"""
name = "a projector of little contrast"
effective_wavelength_nm = 562.0
contrast_ratio = 100.0
ansi_contrast = {CONTRAST}
"""
WHITE = np.add.outer(np.arange(N) // FIELD, np.arange(N) // FIELD) % 2 == 1


@pytest.fixture
def made(small_scene: Callable[..., Path], tmp_path: Path) -> Simulation:
    """Before a sheet that catches all glare within five standard deviations, and through a stop that shows it all."""
    scene, sheet = small_scene(fov=110), '<scale x="64" y="64"/>'
    scene.write_text(scene.read_text().replace(sheet, '<scale x="600" y="600"/>'))
    projector = tmp_path / "glare.toml"
    projector.write_text(PROJECTOR)
    effects = frozenset({"glare", "black-level"})
    return Simulation(open_bench(scene, projector=projector), Settings(depth=400.0, effects=effects))


def traced(made: Simulation, name: str, labels: np.ndarray, seed: int) -> np.ndarray:
    """(classes, rows, columns) light of a pass in the cells of the window."""
    bundle = made.grids["fine"].bundle
    light = made.accumulate(name, made.passes[name].tracer.trace(seed, 0, RAYS), labels, RAYS)["fine"].toarray()
    rows, columns = bundle.cells
    first = (rows - N) // 2
    assert (rows, columns) == (N + 2 * first,) * 2, "the window is in the middle"
    window = slice(first, first + N)
    return light[:2].reshape(2, rows, columns)[:, window, window]


def test_a_chessboard_has_the_ansi_contrast(made: Simulation) -> None:
    """Each cell over its light in a white picture without glare, the four in the middle of each field.

    Eight seeds of 256 rays a pixel. The mean of their contrasts must be within 4 of its standard errors (a false alarm
    in 200, of Student's t with 7 degrees of freedom), which are below 1 %.
    """
    labels = WHITE.ravel().astype(np.int64)
    shown = emission(made.physics, Lighting(labels, np.array([[0.0, 1.0]])))[0]
    middle = np.isin(np.arange(N) % FIELD, (FIELD // 2 - 1, FIELD // 2))
    chosen, contrasts = np.outer(middle, middle), []
    for seed in range(GROUPS):
        direct, glare = (traced(made, name, labels, seed) for name in ("direct", "glare"))
        white = direct.sum(axis=0) / made.physics.projector.share
        light = np.tensordot(shown, direct + glare, 1) / white
        contrasts.append(light[chosen & WHITE].mean() / light[chosen & ~WHITE].mean())
    error = np.std(contrasts, ddof=1) / np.sqrt(GROUPS)
    assert error < 0.01 * CONTRAST and abs(np.mean(contrasts) - CONTRAST) < 4 * error

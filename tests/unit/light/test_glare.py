"""Glare: a traced chessboard has its projector's ANSI contrast, and scattered rays carry what pixels lack."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import open_bench
from mitsim.devices.patterns import Lighting
from mitsim.light.passes import Simulation, emission
from mitsim.light.settings import Settings

pytestmark = pytest.mark.usefixtures("variant")
N, FIELD, GROUPS, SAMPLES = 16, 4, 8, 256
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
    light = made.accumulate(name, made.passes[name].tracer.trace(seed, 0, SAMPLES), labels, SAMPLES)["fine"].toarray()
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


def test_scattered_rays_carry_the_rest_about_their_pixels(made: Simulation) -> None:
    """On a matt sheet that faces the sensor, a ray that is seen at the tan-angle t brings its flux / (1 + t^2)^2.

    Thus every ray of a pass carries the same, none is lost, and both passes carry g and 1 - g. About its pixel a ray
    lies as the Gaussian and the pixel are wide: 65 536 rays tell the mean to 0.4 % of that, the standard deviation to
    0.3 %; four times as much is allowed (a false alarm in 4000).
    """
    g = made.bench.projector.glare
    assert made.physics.projector.share == 1 - g and 0.05 < g < 0.2
    carried = []
    for name, deviation in (("direct", 0.0), ("glare", 0.25 * N)):
        light = made.passes[name].tracer.trace(5, 0, SAMPLES)
        flux = light.value * np.square(1 + np.square(light.row) + np.square(light.column))
        assert len(flux) == N * N * SAMPLES and np.ptp(flux) < 1e-4 * flux.mean()
        carried.append(flux.mean())
        for place, own, (low, high) in zip(
            (light.row, light.column), np.divmod(light.pixel, N), made.bench.windows, strict=True
        ):
            away = (place - low) / (high - low) * N - own - 0.5
            wide = np.hypot(deviation, np.sqrt(1 / 12))
            assert abs(away.mean()) < 0.016 * wide and away.std() == pytest.approx(wide, rel=0.012)
    assert carried[1] / carried[0] == pytest.approx(g / (1 - g), rel=1e-5)

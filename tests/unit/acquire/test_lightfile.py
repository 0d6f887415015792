"""Light in a file: frames that the lines of docs/exchange.md form of it, by h5py and SciPy, against the optics' own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy import sparse

from mitsim.acquire.capture import Light
from mitsim.api.bench import Bench, open_bench
from mitsim.bench.effects import EFFECTS
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import Lighting
from mitsim.light.light import Sampling, trace_light, write_light
from mitsim.light.passes import GRIDS, LightEstimate, Simulation
from mitsim.light.plan import Plan
from mitsim.light.settings import Settings, SharpPixels
from mitsim.planner.planner import make_plan
from tests.exchanged import frame_of

N, GROUPS = 16, 3
LAMP = '<emitter type="constant"><spectrum name="radiance" value="0.01"/></emitter>'
MIRROR = """<shape type="rectangle">
    <transform name="to_world"><scale x="8" y="8"/><translate x="30" z="300"/></transform>
    <boolean name="flip_normals" value="true"/>
    <bsdf type="conductor"><spectrum name="specular_reflectance" value="0.8"/></bsdf>
</shape>"""
PROJECTOR = 'name = "of low contrast"\neffective_wavelength_nm = 562.0\ncontrast_ratio = 50.0\n'


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str) -> Bench:
    """Its mask has two terms and is off the axis, differently along rows and columns."""
    path = shared_scene("lightfile", extra=LAMP + MIRROR, mask="flatcam")
    place = '<string name="mask" value="flatcam"/>'
    path.write_text(path.read_text().replace(place, f'{place} <float name="mask_offset_row" value="0.14"/>'))
    (path.parent / "device.toml").write_text(PROJECTOR)
    return open_bench(path, variant, projector=path.parent / "device.toml")


@pytest.fixture(scope="module")
def light(bench: Bench) -> Light:
    return some_light(bench)


def some_light(bench: Bench) -> Light:
    """A light that nobody traced, with something in every kind of cells, and as much of lamps and of a mirror."""
    settings = Settings(
        depth=400.0,
        anchors=2,
        layers=(430.0, 380.0),
        subdivision=2,
        effects=frozenset({"diffraction", "black-level", "interreflection", "ambient", "mirrors"}),
        followed_anchors=3,
        sharp=SharpPixels((5,), 3, (-0.05, 0.05, -0.05, 0.05)),
        occluded=(3, 4),
        occluded_anchors=4,
    )
    simulation, rng = Simulation(bench, settings), np.random.default_rng(11)
    sizes = {name: grid.bundle.size for name, grid in simulation.grids.items()}

    def some(size: int) -> sparse.csr_array:
        return sparse.random_array((N**2 + 1, size), density=3 / size, format="csr", rng=rng)

    groups = tuple(LightEstimate({name: some(size) for name, size in sizes.items()}) for _ in range(GROUPS))
    plan = Plan(0.1, (), 1.0, settings, 0.1, 0.0, 0.0, ())
    return Light(groups, simulation, plan, 4, np.arange(N**2), np.ones(N**2), np.ones(N**2), 1, 0.02, True)


def test_a_file_gives_the_frame_of_any_pattern(light: Light, tmp_path: Path) -> None:
    """To single precision, of light of every kind, and its standard error as the groups' frames have it. (Planted: rows
    for columns, one term of the mask left out, layers in the other order, no leak of black pixels, lamps of the first
    group alone, specular chain of the next pixel.)"""
    path = light.save(tmp_path / "light.h5")
    pattern = np.random.default_rng(12).random((N, N))
    frame, error = frame_of(path, pattern)
    lighting = Lighting(np.arange(N**2), pattern.reshape(1, -1))
    (exact,) = light.frames(lighting, 0)
    assert np.abs(frame - exact.irradiance).max() < 1e-6 * exact.irradiance.max()
    alone = [
        next(iter(replace(light, groups=(group,)).frames(lighting, 0))).irradiance - exact.irradiance
        for group in light.groups
    ]
    of_groups = np.sqrt(np.square(alone).sum(axis=0) / (GROUPS * (GROUPS - 1)))
    assert np.abs(error - of_groups).max() < 1e-5 * of_groups.max()
    with h5py.File(path) as file:
        assert set(file) == {"light", "ambient", "glint"} and set(file["light"]) == {row.key for row in GRIDS.values()}
        assert (file.attrs["n"], file.attrs["pixels"], file.attrs["groups"]) == (N, 64, GROUPS)
        assert file.attrs["black_level"] == pytest.approx(1 / 50)
        assert file["glint"].attrs["shape"].tolist() == [N**2, 64**2] and len(file["glint/data"]) > 100


def test_a_scene_without_lamps_and_mirrors_has_none_in_its_file(
    shared_scene: Callable[..., Path], variant: str, tmp_path: Path
) -> None:
    plain = open_bench(shared_scene("plain"), variant)
    plan = make_plan(plain, Lighting.uniform(N), 0.1, 0, dict.fromkeys(EFFECTS, False))
    light = trace_light(plain, plan, Lighting.uniform(N), 0)
    write_light(tmp_path / "light.h5", light)
    with h5py.File(tmp_path / "light.h5") as file:
        assert set(file) == {"light"} and set(file["light"]) == {"fine"}
        assert file["light/fine"].attrs["shape"][0] == len(light.groups) * N**2
    by_class = trace_light(plain, plan, Lighting.uniform(N), 0, Sampling(by_pixel=False))
    with pytest.raises(MitsimError, match="traced for one family alone"):
        write_light(tmp_path / "other.h5", by_class)
    assert not (tmp_path / "other.h5").exists()


def test_too_much_light_over_mirrors_is_refused(light: Light, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mitsim.light.light._SPECULAR_BYTES", 1000)
    with pytest.raises(MitsimError, match="projector pixels shine over mirrors"):
        light.save(tmp_path / "light.h5")
    assert not (tmp_path / "light.h5").exists()

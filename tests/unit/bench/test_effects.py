"""The registry of effects: each has a neutral value that passes light through."""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.bench import effects
from mitsim.bench.effects import _TABLE, EFFECTS, Physics
from mitsim.devices.patterns import Lighting
from mitsim.light.passes import Simulation, expected_of
from mitsim.light.settings import Settings

pytestmark = pytest.mark.usefixtures("variant")
N, Z = 16, 400.0
IDEAL = 'name = "pinhole"\neffective_wavelength_nm = 562.0\n'
REAL = f"{IDEAL}contrast_ratio = 100.0\naperture_radius_mm = 3.0\nblur_pixels = 0.6\nspeckle_contrast = 0.02\n"
REAL += "ansi_contrast = 50.0\n"
NUMBERS = (
    '<float name="mask_thickness" value="0.05"/><float name="pixel_fill_factor" value="0.6"/>'
    '<float name="angular_exponent" value="3"/>'
)
LAMP_AND_MIRROR = """<emitter type="constant"><spectrum name="radiance" value="0.2"/></emitter>
    <shape type="rectangle"><transform name="to_world"><scale x="5" y="5"/><rotate y="1" angle="170"/>
    <translate x="-90" z="300"/></transform><bsdf type="conductor"/></shape>"""
ALWAYS = ("interreflection", "diffraction")
"""Light turns at several surfaces and bends at masks wherever there are any."""


def device(tmp_path_factory: pytest.TempPathFactory, text: str) -> Path:
    path = tmp_path_factory.mktemp("projector") / "projector.toml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def everything(shared_scene: Callable[..., Path], variant: str, tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """A bench that has every effect."""
    path = shared_scene("everything", extra=LAMP_AND_MIRROR)
    fov = '<float name="fov" value="20"/>'
    path.write_text(path.read_text().replace(fov, fov + NUMBERS))
    return open_bench(path, variant, projector=device(tmp_path_factory, REAL))


@pytest.fixture(scope="module")
def nothing(shared_scene: Callable[..., Path], variant: str, tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """A flat sheet, a thin mask, whole pixels and a pinhole that is black where it shows black."""
    return open_bench(shared_scene("nothing"), variant, projector=device(tmp_path_factory, IDEAL))


def frame(bench: Bench, *names: str) -> np.ndarray:
    """A half-bright shot of direct and followed light, by the same paths whatever effects are on."""
    simulation = Simulation(bench, Settings(depth=Z, effects=frozenset(names)))
    labels = np.zeros(N * N, dtype=np.int64)
    light = simulation.accumulate("direct", simulation.direct.trace(3, 0, 8), labels, 8)
    light = light + simulation.accumulate("indirect", simulation.follow(3, 4), labels, 4)
    (shot,) = expected_of([(simulation, [light])], np.zeros(1, dtype=np.int64), Lighting(labels, np.array([[0.5]])), 0)
    return shot.irradiance


def test_a_bench_has_what_its_devices_and_scene_have(everything: Bench, nothing: Bench) -> None:
    assert effects.present(everything) == tuple(EFFECTS)
    assert effects.present(nothing) == ALWAYS
    for name, effect in EFFECTS.items():
        assert effect.name == name and effect.present(everything) and effect.present(nothing) == (name in ALWAYS)
        assert effect.absent or name in ALWAYS, "a plan says why it is left off"


def test_a_simulation_has_what_is_on(everything: Bench) -> None:
    for name in EFFECTS:
        physics = Physics.with_effects(everything, {name})
        neutral = {other: effect.neutral.items() for other, effect in EFFECTS.items()}
        on = {other for other, values in neutral.items() if any(attrgetter(f)(physics) != v for f, v in values)}
        assert on == {name}


@pytest.mark.parametrize("name", [name for name in EFFECTS if name != "diffraction"])
def test_neutral_values_pass_light_through(nothing: Bench, name: str) -> None:
    """Switched on where a bench has no such thing, an effect changes no pixel, but for the order of sums (1e-12).

    Light over several surfaces is none before one flat sheet. A geometric shadow is its own closed form
    (tests/unit/light/test_simulation.py), so diffraction is left out.
    """
    off, on = frame(nothing), frame(nothing, name)
    assert off.any() and np.abs(on - off).max() <= 1e-12 * off.max()


def test_each_effect_has_a_name_of_its_own_and_the_table_stays() -> None:
    assert list(EFFECTS) == [effect.name for effect in _TABLE]
    with pytest.raises(TypeError):
        EFFECTS["fog"] = EFFECTS["blur"]  # type: ignore[index]


def test_computed_speckle_is_that_of_the_shots(small_scene: Callable[..., Path], tmp_path: Path, variant: str) -> None:
    """A scanned beam averages over fewer places under dots; frames have the family's contrast, and none without it."""
    projector = tmp_path / "laser.toml"
    projector.write_text(IDEAL + "[speckle]\nbeam_radius_mm = 0.5\n", encoding="utf-8")
    bench = open_bench(small_scene(), variant, None, projector)
    white, dots = bench.speckle(), bench.speckle(bench.family("dots:4"))
    assert 0 < white < dots < 1 and Physics.of(bench).speckle == white and "speckle" in effects.present(bench)
    assert bench.speckle(bench.family("uniform")) == pytest.approx(white)
    light = bench.light("dots:4", accuracy=1e-2, effects={"speckle": True})
    assert light.speckle(bench.family("dots:4")) == dots
    assert bench.light("dots:4", accuracy=1e-2, effects={"speckle": False}).speckle(bench.family("dots:4")) == 0

"""Measured materials: tables of known materials against closed forms, quadrature and Mitsuba's own plugin.

The judges are a Lambertian's albedo / pi, GGX by :func:`tests.hard.hard_light.lobe`, and ``measured`` of RGB variants.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsim.api.bench import open_bench
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import Lighting
from mitsim.light.light import Sampling, trace_light
from mitsim.planner.planner import make_plan
from tests import measured_tables as tables
from tests.hard.hard_light import HALF, MIRROR_Z, lobe, plate

N, ALPHA, SIGMAS, TABLE = 32, 0.3, 5.0, 3e-3
"""Tables of 64 x 64 half vectors at 24 angles are right to 2e-3."""
MATERIAL = '<bsdf type="measured"><string name="filename" value="table.bsdf"/></bsdf>'
TURNED = f'<scale x="{HALF}" y="{HALF}"/><rotate y="1" angle="180"/><translate x="30" z="{MIRROR_Z}"/>'


def written(small_scene: Callable[..., Path], fields: dict[str, np.ndarray]) -> Path:
    path = small_scene("table", n=N, mask="open", pitch=0.1, sheet_z=-500, extra=plate(TURNED, MATERIAL))
    tables.save(path.with_name("table.bsdf"), fields)
    return path


def test_both_estimators_render_a_table_of_a_known_lobe(small_scene: Callable[..., Path], variant: str) -> None:
    """A plate of GGX against quadrature."""
    bench = open_bench(written(small_scene, tables.known(ALPHA)), variant, for_render=True)
    some = np.ix_(*[np.arange(4, 64, 8)] * 2)
    place = bench.geometry.centres(1)[some[1][0]]
    expected = np.array([[lobe(ALPHA, row, column) for column in place] for row in place])
    plan = make_plan(bench, lighting := Lighting.uniform(N), 5e-3, 0, {"interreflection": False, "diffraction": False})
    light = trace_light(bench, plan, lighting, 0, Sampling(by_pixel=False))
    found = next(iter(light.frames(lighting, 0))).irradiance[some]
    allowed = SIGMAS * float(np.hypot(light.sampling_error, plan.systematic_error)) + TABLE
    assert light.reached and not light.warnings
    assert np.linalg.norm(found - expected) / np.linalg.norm(expected) < allowed < 0.02
    frame = bench.render("reference", spp=256)
    error = np.linalg.norm(frame.error[some]) / expected.sum()
    assert abs(frame.mean[some].sum() / expected.sum() - 1) < SIGMAS * error + TABLE < 0.03


def directions(count: int, seed: int) -> mi.Vector3f:
    z, phi = np.random.default_rng(seed).uniform((0.1, 0), (1, 7), (count, 2)).T
    return mi.Vector3f(*np.float32([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z]))


def compared(path: Path, other: dict[str, object], colour: float = 1.0) -> tuple[float, float]:
    """Relative differences of values and of densities between a table and another material."""
    si = dr.zeros(mi.SurfaceInteraction3f, 20_000)
    si.wi, wo = directions(20_000, 0), directions(20_000, 1)
    pairs = [mi.load_dict(each).eval_pdf(mi.BSDFContext(), si, wo)
             for each in ({"type": "mitsim_measured", "filename": str(path)}, other)]  # fmt: skip
    (a, pa), (b, pb) = ([np.array(each, dtype=np.float64) for each in pair] for pair in pairs)
    return tuple(float(np.linalg.norm(x - y) / np.linalg.norm(y)) for x, y in ((a, b * colour), (pa, pb)))


def sent(material: dict[str, object]) -> np.ndarray:
    """Integral of f cos(theta_o) times the direction, by samples on an even grid, for light from an azimuth of 1."""
    even = (np.arange(128) + 0.5) / 128
    s1, s2 = (np.float32(each.ravel()) for each in np.meshgrid(even, even))
    si = dr.zeros(mi.SurfaceInteraction3f, s1.size)
    si.wi = mi.Vector3f(*map(float, (0.7 * np.cos(1), 0.7 * np.sin(1), np.sqrt(0.51))))
    bs, weight = mi.load_dict(material).sample(mi.BSDFContext(), si, mi.Float(s1), mi.Point2f(s1, s2))
    return (np.array(weight[0], dtype=np.float64) * np.array(bs.wo, dtype=np.float64)).mean(axis=1)


@pytest.mark.parametrize("spectra", [False, True])
@pytest.mark.parametrize("alpha", [None, ALPHA])
def test_colours_in_mono(tmp_path: Path, variant: str, alpha: float | None, spectra: bool) -> None:
    """Values of a known material; the effective wavelength of spectra, the luminance of RGB (IEC 61966-2-1).

    (Planted: phi_m or its samples not relative to phi_i, no wrap, values without D / sigma, other weights.)
    """
    fields = tables.known(alpha, spectra=spectra)
    name, tints = ("spectra", [0.2, 0.8]) if spectra else ("rgb", [0.9, 0.5, 0.1])
    fields[name] *= np.float32(tints)[:, None, None]
    tables.save(tmp_path / "table.bsdf", fields)
    table = mi.load_dict({"type": "mitsim_measured", "filename": str(tmp_path / "table.bsdf")})
    wavelength = float(table.wavelength[0])
    part = np.interp(wavelength, [400, 700], tints) if spectra else np.dot([0.2126, 0.7152, 0.0722], tints)
    metal = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": ALPHA}
    known = {"type": "diffuse"} if alpha is None else metal
    assert compared(tmp_path / "table.bsdf", known, part)[0] < TABLE
    found = sent({"type": "mitsim_measured", "filename": str(tmp_path / "table.bsdf")})
    np.testing.assert_allclose(found, part * sent(known), atol=TABLE)


def test_values_and_densities_are_those_of_mitsuba(tmp_path: Path) -> None:
    """Tables over a whole turn, a half and a quarter, in RGB. (Planted: signs of a quarter; another Jacobian.)"""
    for parts in (1, 2, 4):
        tables.save(tmp_path / f"{parts}.bsdf", tables.random(parts, spectra=False))
    script = """import sys; from pathlib import Path; from mitsim.core.environment import load_variant
load_variant("llvm_ad_rgb"); from mitsim.transport import plugins; plugins.register()
from tests.physics.test_measured import compared
for path in sorted(Path(sys.argv[1]).iterdir()): print(*compared(path, {"type": "measured", "filename": str(path)}))"""
    done = subprocess.run([sys.executable, "-c", script, tmp_path], capture_output=True, text=True, check=True)
    found = np.array(done.stdout.split(), dtype=np.float64)
    assert found.size == 6 and found.max() < 1e-5


def test_damaged_tables_are_refused_in_one_line(small_scene: Callable[..., Path], variant: str) -> None:
    """And one that reflects 1.2 of the light gives a warning."""
    good = tables.random(2, spectra=True)
    wrong = {
        "other type or shape": good | {"sigma": good["sigma"][0]},
        "another type or shape": good | {"luminance": good["luminance"][:3]},
        "claims more values of jacobian": good,
        "negative or not finite": good | {"vndf": good["vndf"] * np.float32("nan")},
        "that are negative": good | {"spectra": good["spectra"] - 1},
        "do not grow": good | {"theta_i": good["theta_i"][::-1]},
        "-180 to 36 degrees": good | {"phi_i": good["phi_i"] * 1.2 + np.float32(0.2 * np.pi)},
        "axis of a single value": good | {"ndf": good["ndf"][:1]},
        "without light in": good | {"luminance": good["luminance"] * 0},
        "is no measured material": {name: each for name, each in good.items() if name != "theta_i"},
    }
    for words, fields in wrong.items():
        path = written(small_scene, fields)
        table = path.with_name("table.bsdf")
        if words.startswith("claims"):
            table.write_bytes(table.read_bytes()[:-4000])
        with pytest.raises(MitsimError, match=f"table.bsdf.*{words.removeprefix('other ')}") as refused:
            open_bench(path, variant, for_render=True)
        assert "\n" not in str(refused.value) and f"{path}:" in str(refused.value)
    path = written(small_scene, tables.known(None, 1.2))
    with pytest.warns(UserWarning, match=r"table.bsdf: reflects up to 1\.2"):
        open_bench(path, variant, for_render=True)

"""Shared second points in three lines at once: each line's light is that of paths of its own, and of closed forms.

A child process traces them, for this one has another variant. Gates on Monte Carlo means are seven standard errors of
eight independent seeds: five sigma of the t distribution.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.acquire.spectral import SpectralBench
from mitsim.api.bench import open_bench
from mitsim.core.colour_files import RUN
from mitsim.transport.records import Bundle, DeviceAccumulator, PathSamples, aligned_grid
from tests.conftest import write_small_scene
from tests.unit.transport.closed_forms import in_child
from tests.unit.transport.test_path_reuse import BENT, OBJECT, WALL, tracers

N, SEEDS, SIGMAS, SAMPLES = 16, 8, 7.0, 256
LINES, SHARES = (450.0, 530.0, 640.0), (0.5, 0.3, 0.2)
REFLECTANCES = (0.2, 0.5, 0.8)
COLOURED = '<spectrum name="reflectance" value="{}"/>'
"""A spectrum by wavelength, linear between them."""


def spectrum(*values: float) -> str:
    """Of a reflectance at each line, flat about it."""
    pairs = ((wave + side, value) for wave, value in zip(LINES, values, strict=True) for side in (-5, 5))
    return COLOURED.format(
        ", ".join(f"{wave:g}:{value}" for wave, value in [(360, values[0]), *pairs, (830, values[-1])])
    )


def matt(*values: float) -> str:
    """A diffuse material of a reflectance at each line."""
    return f'<bsdf type="diffuse">{spectrum(*values)}</bsdf>'


SHINY = f"""<bsdf type="blendbsdf"><float name="weight" value="0.5"/>{matt(0.1, 0.6, 0.3)}
    <bsdf type="roughconductor"><string name="material" value="none"/><float name="alpha" value="0.2"/>
        <spectrum name="specular_reflectance" value="0.5"/></bsdf></bsdf>"""
SPHERE = """<shape type="sphere"><float name="radius" value="1000"/><boolean name="flip_normals" value="true"/>
    {bsdf}</shape>"""
SCENES = {
    "coloured sphere": SPHERE.format(bsdf=matt(*REFLECTANCES)),
    "matt walls": WALL.format(turn=90, x=-30, bsdf=matt(0.8, 0.0, 0.4))
    + WALL.format(turn=-60, x=40, bsdf=matt(0.2, 0.9, 0.5)),
    "shiny wall": WALL.format(turn=90, x=-30, bsdf=SHINY) + WALL.format(turn=-60, x=40, bsdf=matt(0.0, 0.9, 0.3)),
    "bent wall": OBJECT + WALL.format(turn=-60, x=40, bsdf=matt(0.9, 0.2, 0.5)),
}
QUICK = ("coloured sphere",)
"""What surfaces turn is told by cosines alone there; a glossy wall's material is asked for each pair, and the matt one
beside it is black in a line."""


def by_line(light: PathSamples) -> list[list[float]]:
    """Of each line, light of each fourth of the columns of pixels in all, and by the row that it comes from."""
    found = []
    for each in light.by_line(len(LINES)):
        part = each.pixel % N // 4
        found.append([*np.bincount(part, each.value, 4), *np.bincount(part, each.value * each.row, 4)])
    return (np.array(found) / SAMPLES).tolist()


def traced(folder: str, *names: str) -> dict[str, Any]:
    """Light of some scenes by paths of their own and by shared ones; its process has a spectral variant for good."""
    place, found = Path(folder), dict[str, Any]()
    (place / "bent.obj").write_text(BENT)
    (place / "lines.toml").write_text(
        f'name = "lines"\neffective_wavelength_nm = 550\nwavelengths_nm = {list(LINES)}\n'
        f"radiant_shares = {list(SHARES)}\n"
    )
    for name in names:
        extra = SCENES[name]
        far = {"sheet_z": 3000} if "sphere" in name else {}
        path = write_small_scene(place, name, n=N, extra=extra, **far)
        bench = SpectralBench.of(open_bench(path, "llvm_ad_spectral", None, place / "lines.toml"), RUN).whole
        own, shared = tracers(bench)
        assert shared.shares() and shared.all_diffuse == ("shiny" not in name)
        runs = [[side.trace(seed, 0, SAMPLES) for seed in range(SEEDS)] for side in (own, shared)]
        grid = aligned_grid(*bench.windows, N, 1, bench.geometry.tan_half_fov)
        bundle, labels = Bundle(grid, 1, (400.0,)), np.arange(N * N) % 5
        accumulator = DeviceAccumulator(bundle, labels, shared.board, len(LINES))
        rest = shared.trace(0, 0, SAMPLES, accumulator)
        every = runs[1][0].by_line(len(LINES))
        found[name] = {
            "own": [by_line(run) for run in runs[0]],
            "shared": [by_line(run) for run in runs[1]],
            "whole": [[run.value.sum(), run.lines[: len(LINES)].sum()] for run in runs[1] if run.lines is not None],
            "ledgers": [
                (sums.light()[0] + bundle.accumulate(light, labels)).sum(axis=1).tolist()
                for sums, light in zip(accumulator.fetch(), rest.by_line(len(LINES)), strict=True)
            ],
            "host": [bundle.accumulate(light, labels).sum(axis=1).tolist() for light in every],
            "tan": bench.geometry.tan_half_fov,
        }
    return found


@pytest.fixture(scope="module")
def light(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], dict[str, Any]]:
    """Light of a scene, traced with that of all others that are as quick."""

    @cache
    def trace(*names: str) -> dict[str, Any]:
        return in_child("tests.unit.transport.test_path_reuse_by_line", tmp_path_factory.mktemp("by_line"), *names)

    def of(name: str) -> dict[str, Any]:
        found: dict[str, Any] = trace(*(each for each in SCENES if (each in QUICK) == (name in QUICK)))[name]
        return found

    return of


every_scene = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in SCENES]
)


@every_scene
def test_each_line_is_that_of_paths_of_their_own(light: Callable[[str], dict[str, Any]], name: str) -> None:
    """Of each fourth of the pixels' columns: how much, and from which mean row."""
    runs = np.array([light(name)[way] for way in ("own", "shared")])
    means, errors = runs.mean(axis=1), runs.std(axis=1, ddof=1) / SEEDS**0.5
    bound = SIGMAS * np.hypot(*errors)
    assert (np.abs(means[0] - means[1]) <= bound + 1e-9 * means.max()).all()
    lit = means[0, :, :4] > 0.01 * means[0, :, :4].max()
    assert lit.sum() >= 4 and np.median(bound[:, :4][lit] / means[0, :, :4][lit]) < 0.2


@every_scene
def test_lines_add_up_and_accumulators_hold_each(light: Callable[[str], dict[str, Any]], name: str) -> None:
    """All light is the sum of the lines', and an accumulator of each line holds what the host files."""
    whole = np.array(light(name)["whole"])
    assert len(whole) == SEEDS
    np.testing.assert_allclose(whole[:, 0], whole[:, 1], rtol=1e-5)
    np.testing.assert_allclose(light(name)["ledgers"], light(name)["host"], rtol=1e-5, atol=1e-12)

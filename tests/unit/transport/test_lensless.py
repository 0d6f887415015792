"""The sensor plugin, one ray at a time, against the mask's own transmission (whole frames: tests/physics)."""

import re

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsim.devices.camera import CameraGeometry
from mitsim.transport.plugins import lensless
from mitsim.transport.plugins.base import generator, shuffle, sobol_point
from tests.unit.core.test_formats import documents

pytestmark = pytest.mark.usefixtures("variant")
SIGMAS = 5.0


def rays(geometry: CameraGeometry, count: int = 4000) -> tuple[np.ndarray, ...]:
    """Origins (count, 3), directions (count, 3), weights (count,) and the samples (count, 4) behind them."""
    camera = mi.load_dict({"type": "mitsim_lensless", **plugin(geometry)})
    samples = np.random.default_rng(5).random((count, 4)).astype(np.float32)
    position = mi.Point2f(samples[:, 0], samples[:, 1])
    ray, weight = camera.sample_ray(0.0, 0.5, position, mi.Point2f(samples[:, 2], samples[:, 3]))
    return np.array(ray.o).T, np.array(ray.d).T, np.array(weight).reshape(-1), samples.astype(np.float64)


def plugin(geometry: CameraGeometry) -> dict[str, object]:
    values = geometry.model_dump(exclude={"pixels"}, exclude_none=True)
    film = {"type": "hdrfilm", "width": geometry.pixels, "height": geometry.pixels, "rfilter": {"type": "box"}}
    return {**values, "film": film}


def part_open(geometry: CameraGeometry, origin: np.ndarray) -> np.ndarray:
    """(count,) part of the near face's plane that is open in what the field stop shows of it, from the mask's terms."""
    mask, reach = geometry.build_mask(), geometry.mask_distance * geometry.tan_half_fov
    edges = (np.arange(len(mask.bits) + 1) - len(mask.bits) / 2) * mask.feature_mm
    total = np.zeros(len(origin))
    for weight, *profiles in mask.terms:
        product = np.full(len(origin), weight)
        for profile, coordinate, centre in zip(
            profiles, (-origin[:, 1], -origin[:, 0]), geometry.mask_offset, strict=True
        ):
            sums = np.append(0, np.cumsum(profile * mask.feature_mm))
            low, high = (np.interp(coordinate - centre + end, edges, sums) for end in (-reach, reach))
            product *= (high - low) / (2 * reach)
        total += product
    return total


def crossing(geometry: CameraGeometry, origin: np.ndarray, t: np.ndarray, plane: float) -> tuple[np.ndarray, ...]:
    """The mask's transmission where rays cross a plane, and whether float32 could tell the feature."""
    at_mask = origin[:, :2] + plane * t
    row, column = geometry.mask_offset
    known = geometry.build_mask().transmission(-at_mask[:, 1] - row, -at_mask[:, 0] - column)
    features = len(geometry.build_mask().bits)
    place = (-at_mask[:, ::-1] - (row, column)) / geometry.mask_feature + features / 2
    return known, (np.abs(place % 1 - 0.5) < 0.499).all(axis=1)


WINDOWS = {"inside": {}, "moved": {"mask_offset_row": 0.131, "mask_offset_column": -0.077}}
# What the field stop shows, 0.7 mm beside 3.8 mm of mask, ends beyond the mask's edge.
WINDOWS["edge"] = {"mask_order": 6, "mask_offset_row": 1.9, "mask_offset_column": -1.8}


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize("mask", ["separable", "flatcam", "open"])
def test_a_ray_passes_where_the_mask_is_open_and_carries_the_open_part(mask: str, window: str) -> None:
    geometry = CameraGeometry(mask=mask, pixels=64, **WINDOWS[window])
    origin, direction, weight, samples = rays(geometry)
    side, reach = 2 * geometry.half_width, 2 * geometry.tan_half_fov
    # Film sample (0, 0) is row 0, column 0: the sensor's +y, +x corner.
    assert np.allclose(origin[:, :2], (0.5 - samples[:, :2]) * side, atol=1e-6) and not origin[:, 2].any()
    t = direction[:, :2] / direction[:, 2:]
    assert np.abs(t).max() < geometry.tan_half_fov * (1 + 1e-6)
    known, clear = crossing(geometry, origin, t, geometry.mask_distance)
    lit = part_open(geometry, origin) > 1e-4
    assert clear[lit].mean() > 0.98 and lit.mean() > (0.1 if window == "edge" else 0.999)
    assert (known[clear & lit] == 1).all()
    expected = part_open(geometry, origin) * reach**2 / (1 + np.square(t).sum(axis=1)) ** 2
    assert np.allclose(weight, expected, rtol=2e-5, atol=1e-5 * expected.max())
    if mask != "open" and window != "edge":
        flipped = geometry.build_mask().transmission(*(geometry.mask_distance * t + origin[:, :2]).T[::-1])
        assert not flipped.all(), "the check must be able to tell up from down"


@pytest.mark.parametrize("mask", ["separable", "flatcam"])
def test_every_open_place_is_met_as_often_as_any_other(mask: str) -> None:
    """A pixel of 1 nm: counts in cells of a fifth of a feature are multinomial. Chi-square, alpha 1e-4."""
    geometry = CameraGeometry(mask=mask, pixels=1, pixel_pitch=1e-6, mask_order=4, mask_offset_row=0.31)
    _, direction, *_ = rays(geometry, 400_000)
    t = direction[:, :2] / direction[:, 2:]
    edges = np.linspace(-geometry.tan_half_fov, geometry.tan_half_fov, 60)
    found = np.histogram2d(-t[:, 1], -t[:, 0], [edges, edges])[0]
    fine = (np.arange(59 * 40) + 0.5) / (59 * 40) * (edges[-1] - edges[0]) + edges[0]
    row, column = fine * geometry.mask_distance - 0.31, fine * geometry.mask_distance
    plate = geometry.build_mask().transmission(row[:, None], column[None, :])
    expected = plate.reshape(59, 40, 59, 40).mean(axis=(1, 3))
    expected *= found.sum() / expected.sum()
    cells = expected > 10
    assert 0.15 < cells.mean() < 0.6 and found[expected == 0].sum() < 200
    chi_square = (np.square(found - expected)[cells] / expected[cells]).sum()
    # Cells at a feature's edge hold 1/40 of themselves more or less than the sum says: 20 counts of 1000 there.
    assert stats.chi2.sf(chi_square, cells.sum() - 1) > 1e-4


@pytest.mark.parametrize("mask", ["separable", "flatcam", "open"])
def test_a_ray_has_to_pass_both_faces_and_hits_the_active_area_at_its_angle(mask: str) -> None:
    """Every effect at once; each alone is told apart by what the last lines leave out."""
    geometry = CameraGeometry(
        mask=mask, mask_thickness=0.3, pixel_fill_factor=0.49, angular_exponent=4.0, mask_order=7, pixels=32
    )
    origin, direction, weight, samples = rays(geometry)
    pixel, within = np.divmod(samples[:, :2] * 32, 1)
    active = (pixel + 0.5 + (within - 0.5) * 0.7) / 32
    assert np.allclose(origin[:, :2], (0.5 - active) * 2 * geometry.half_width, atol=1e-6)
    t = direction[:, :2] / direction[:, 2:]
    far, clear = crossing(geometry, origin, t, 2.3)
    assert clear.mean() > 0.98
    cosine = direction[:, 2]
    falloff = part_open(geometry, origin) * 0.49 * (2 * geometry.tan_half_fov) ** 2 * cosine**4
    expected = far * cosine**4.0 * falloff
    assert np.allclose(weight[clear], expected[clear], rtol=2e-5)
    assert np.allclose(expected, far * geometry.angular_response(1 / cosine**2 - 1) * falloff)
    assert not np.allclose(weight[clear], (far * falloff)[clear], rtol=1e-3)
    if mask != "open":
        assert not far.all()


def test_the_manual_lists_the_parameters_of_the_geometry() -> None:
    """The table of the module's docstring: every field that a scene states but the film's, in order, with its
    default."""
    rows = re.findall(r"^``(\w+)`` +(\S+) +(\S+) ", lensless.__doc__, re.M)
    films = "pixels", "rows", "columns", "roi"
    fields = {
        name: field for name, field in CameraGeometry.model_fields.items() if not (name in films or field.exclude)
    }
    assert [name for name, _, _ in rows] == [*fields, "to_world"]
    meanings = documents().meanings(CameraGeometry)
    for name, unit, default in rows[:-1]:
        stated = fields[name]
        known = "-" if stated.default is None else stated.default
        assert default == (known if isinstance(known, str) else f"{known:g}"), name
        assert f"[{unit}]" in meanings[name] or unit == "-", name


# -------- Random numbers of tracers
#
# Random numbers of the tracer: stratified in their first two dimensions, unbiased, and independent between streams.
#
# Gates on random quantities are five standard deviations of what uniform numbers would give, at fixed seeds.


def points(samples: int, streams: int = 1, seed: int = 7, first: int = 0) -> np.ndarray:
    """(streams, samples, 2) points ``first``.. of some streams of one seed."""
    lane = np.arange(streams * samples)
    index, stream = mi.UInt32(first + lane % samples), mi.UInt32(lane // samples)
    found = sobol_point(index, generator(mi.UInt32(seed), stream))
    return np.stack([np.array(found.x), np.array(found.y)], axis=1).reshape(streams, samples, 2).astype(np.float64)


@pytest.mark.parametrize("power", [0, 1, 3, 4, 7, 10])
@pytest.mark.parametrize("seed", [0, 12345])
def test_every_prefix_is_a_net(power: int, seed: int) -> None:
    """2^k points put one in each box of every partition into 2^j x 2^(k-j) equal boxes: a (0, 2)-sequence in base 2."""
    count = 2**power
    for found in points(count, streams=5, seed=seed):
        assert found.min() >= 0 and found.max() < 1
        for j in range(power + 1):
            across = np.floor(found[:, 0] * 2**j).astype(int)
            along = np.floor(found[:, 1] * 2 ** (power - j)).astype(int)
            boxes = across * 2 ** (power - j) + along
            assert len(np.unique(boxes)) == count, f"boxes of 2^-{j} x 2^-{power - j}"


def test_streams_dimensions_and_seeds_are_independent() -> None:
    """Correlations of the first point between neighbouring streams, its two dimensions, and neighbouring seeds."""
    streams = 2**14
    found, other = points(1, streams)[:, 0], points(1, streams, seed=8)[:, 0]
    gate = SIGMAS / np.sqrt(streams)
    assert abs(np.corrcoef(found[:, 0], found[:, 1])[0, 1]) < gate
    for axis in (0, 1):
        assert abs(np.corrcoef(found[1:, axis], found[:-1, axis])[0, 1]) < gate
        assert abs(np.corrcoef(found[:, axis], other[:, axis])[0, 1]) < gate


def test_two_pairs_of_dimensions_pad_to_four() -> None:
    """Shuffled, 64 points of each stream are a net as before, and tell nothing of the unshuffled pair of dimensions.

    Over 256 streams no product of one dimension of each pair has a mean beyond its five deviations. (Planted: the same
    order for both pairs.)
    """
    streams, samples = 256, 64
    lane = np.arange(streams * samples)
    index, rng = mi.UInt32(lane % samples), generator(mi.UInt32(7), mi.UInt32(lane // samples))
    first, second = sobol_point(index, rng), sobol_point(shuffle(index, rng), rng)
    pairs = [np.stack([np.array(p.x), np.array(p.y)], axis=1).reshape(streams, samples, 2) for p in (first, second)]
    for found in pairs[1]:
        assert len(np.unique(np.floor(found * 8).astype(int) @ [8, 1])) == samples
    for a in (0, 1):
        for b in (0, 1):
            for power in (1, 2, 4):  # coarse structure shared by both pairs
                cells = [
                    np.floor(part[..., axis] * 2**power) % 2 - 0.5 for part, axis in zip(pairs, (a, b), strict=True)
                ]
                product = (cells[0] * cells[1]).mean(axis=1)
                assert abs(product.mean()) < SIGMAS * 0.25 / np.sqrt(streams * samples)

"""The sensor plugin, one ray at a time, against the mask's own transmission (whole frames: tests/physics)."""

import re
import subprocess
import sys

import numpy as np
import pytest

from mitsim.rig.camera import CameraGeometry

pytestmark = pytest.mark.usefixtures("variant")
SIGMAS = 5.0


def rays(geometry: CameraGeometry, count: int = 4000) -> tuple[np.ndarray, ...]:
    """Origins (count, 3), directions (count, 3), weights (count,) and the samples (count, 4) behind them."""
    import mitsuba as mi

    camera = mi.load_dict({"type": "mitsim_lensless", **plugin(geometry)})
    samples = np.random.default_rng(5).random((count, 4)).astype(np.float32)
    position = mi.Point2f(samples[:, 0], samples[:, 1])
    ray, weight = camera.sample_ray(0.0, 0.5, position, mi.Point2f(samples[:, 2], samples[:, 3]))
    return np.array(ray.o).T, np.array(ray.d).T, np.array(weight).reshape(-1), samples.astype(np.float64)


def plugin(geometry: CameraGeometry) -> dict[str, object]:
    values = geometry.model_dump(exclude={"pixels"})
    film = {
        "type": "hdrfilm",
        "width": geometry.pixels,
        "height": geometry.pixels,
        "rfilter": {"type": "box"},
    }
    return {**values, "film": film}


@pytest.mark.parametrize("mask", ["separable", "flatcam", "open"])
def test_a_ray_carries_the_masks_transmission_where_it_crosses(mask: str) -> None:
    geometry = CameraGeometry(mask=mask, pixels=64)
    origin, direction, weight, samples = rays(geometry)
    side, reach = 2 * geometry.half_width, 2 * geometry.tan_half_fov
    # Film sample (0, 0) is row 0, column 0: the sensor's +y, +x corner.
    assert np.allclose(origin[:, :2], (0.5 - samples[:, :2]) * side, atol=1e-6) and not origin[:, 2].any()
    t = direction[:, :2] / direction[:, 2:]
    assert np.allclose(t, (0.5 - samples[:, 2:]) * reach, atol=1e-6)
    at_mask = origin[:, :2] + geometry.mask_distance * t
    known = geometry.build_mask().transmission(-at_mask[:, 1], -at_mask[:, 0])
    expected = known * reach**2 / (1 + np.square(t).sum(axis=1)) ** 2
    feature = (at_mask / geometry.mask_feature) % 1
    clear = (np.abs(feature - 0.5) % 1 > 0.001).all(axis=1)  # float32 may choose either side of a feature's edge
    assert clear.mean() > 0.99
    assert np.allclose(weight[clear], expected[clear], rtol=1e-5)
    if mask != "open":
        mirrored = geometry.build_mask().transmission(at_mask[:, 1], -at_mask[:, 0])
        assert not np.allclose(known, mirrored), "the check must be able to tell up from down"


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
    faces, clear = [], np.ones(len(t), bool)
    for plane in (2.0, 2.3):
        at_mask = origin[:, :2] + plane * t
        faces.append(geometry.build_mask().transmission(-at_mask[:, 1], -at_mask[:, 0]))
        clear &= (np.abs((at_mask / 0.06 + 127 / 2) % 1 - 0.5) < 0.499).all(axis=1)
    assert clear.mean() > 0.98
    cosine = direction[:, 2]
    falloff = 0.49 * (2 * geometry.tan_half_fov) ** 2 * cosine**4
    expected = faces[0] * faces[1] * cosine**4.0 * falloff
    assert np.allclose(weight[clear], expected[clear], rtol=1e-5)
    assert np.allclose(expected, faces[0] * faces[1] * geometry.angular_response(1 / cosine**2 - 1) * falloff)
    assert not np.allclose(weight[clear], (faces[0] * faces[1] * falloff)[clear], rtol=1e-3)
    if mask != "open":
        assert not np.array_equal(faces[0], faces[1])


@pytest.mark.parametrize(("mask", "open_part"), [("separable", (256 / 511) ** 2), ("flatcam", 0.5 + 0.5 / 511**2)])
def test_how_much_of_the_mask_is_open(mask: str, open_part: float) -> None:
    # A field stop that sees the whole mask: tan(half fov) = 8, mask 30.66 mm wide at 2 mm distance.
    geometry = CameraGeometry(mask=mask, pixels=2, fov=2 * np.degrees(np.arctan(8.0)))
    origin, direction, weight, _ = rays(geometry, 200_000)
    at_mask = origin[:, :2] + geometry.mask_distance * direction[:, :2] / direction[:, 2:]
    inside = (np.abs(at_mask) < 511 * 0.06 / 2).all(axis=1)
    assert inside.sum() > 100_000
    passed = weight[inside] > 0
    deviation = np.sqrt(open_part * (1 - open_part) / inside.sum())
    assert abs(passed.mean() - open_part) < SIGMAS * deviation
    assert SIGMAS * deviation < 0.01
    beyond = (np.abs(at_mask) > 511 * 0.06 / 2 + 1e-4).any(axis=1)
    assert beyond.sum() > 10_000 and not weight[beyond].any(), "opaque outside its features"


def test_registering_twice_does_nothing() -> None:
    import mitsuba as mi

    from mitsim.transport import lensless

    lensless.register()
    lensless.register()
    assert mi.load_dict({"type": "mitsim_lensless", **plugin(CameraGeometry(pixels=2))}).geometry.pixels == 2


def test_registering_needs_a_variant() -> None:
    program = "from mitsim.transport import lensless; lensless.register()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 1 and "MitsimError: no Mitsuba variant is selected" in done.stderr


def test_the_manual_lists_the_parameters_of_the_geometry() -> None:
    """The table of the module's docstring: every field but ``pixels`` (the film's), in order, with its default."""
    from mitsim.rig.camera import CameraGeometry
    from mitsim.transport import lensless

    rows = re.findall(r"^``(\w+)`` +(\S+) +(\S+) ", lensless.__doc__, re.M)
    fields = {name: field for name, field in CameraGeometry.model_fields.items() if name != "pixels"}
    assert [name for name, _, _ in rows] == [*fields, "to_world"]
    for name, unit, default in rows[:-1]:
        stated = fields[name]
        assert default == (stated.default if isinstance(stated.default, str) else f"{stated.default:g}"), name
        assert f"[{unit}]" in stated.description or unit == "-", name

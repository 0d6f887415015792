"""A thick mask against closed forms: what a slit of two faces lets through, and rays counted through both.

Rationale: a ray of slope t that leaves a mask of thickness h through s entered at s + h t. So a slit of width a passes
the part 1 - h |t| / a of a parallel beam, whatever the distance; everything else follows from where edges fall.

The rendering of the last test uses fixed seeds; its gate is given there.
"""

import numpy as np
import pytest

from mitsim.core.configuration import validate
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry, centred_edges
from mitsim.devices.mask import Mask
from mitsim.devices.projector import Spectrum
from mitsim.optics.shadow import Directions, ShadowGeometry, geometric_terms
from mitsim.optics.terms import shadow_terms

WIDTH, THICK = 0.06, 0.1


def slit(depth: float, thickness: float = THICK) -> ShadowGeometry:
    """One open feature 2 mm in front of 400 pixels of 0.01 mm, which see all of it."""
    edges = centred_edges(400, 0.01)
    return ShadowGeometry(Mask("open", WIDTH, np.ones(1)), (edges[:-1] + edges[1:]) / 2, 0.01, 2.0, thickness, depth)


@pytest.mark.parametrize("width", [0.0, 1e-3])
def test_one_slit_passes_its_width_less_the_wall_shift(width: float) -> None:
    tau = np.array([-0.65, -0.55, -0.3, -0.1, 0.0, 0.2, 0.59, 0.61])
    ((left, _),) = geometric_terms(slit(np.inf), Directions(tau, width), Directions([0.0], 0.0))
    through = left.sum(axis=0) * 0.01 / WIDTH
    expected = np.maximum(1 - THICK * np.abs(tau) / WIDTH, 0)
    assert np.allclose(through, expected, rtol=0, atol=1e-9)
    ((thin, _),) = geometric_terms(slit(np.inf, 0.0), Directions(tau, width), Directions([0.0], 0.0))
    assert np.allclose(thin.sum(axis=0) * 0.01 / WIDTH, 1, rtol=0, atol=1e-9)


@pytest.mark.parametrize("tau", [0.0, 0.2, -0.35])
def test_a_slit_seen_by_a_near_point_keeps_what_both_faces_let_pass(tau: float) -> None:
    """Edges of both faces projected from the point onto the sensor: the lit part lies between the inner ones."""
    depth, d = 20.0, 2.0
    ((left, _),) = geometric_terms(slit(depth), Directions([tau], 0.0), Directions([0.0], 0.0))

    def on_sensor(s: float, plane: float) -> float:
        return tau * depth + (s - tau * depth) * depth / (depth - plane)

    low = max(on_sensor(-WIDTH / 2, plane) for plane in (d, d + THICK))
    high = min(on_sensor(WIDTH / 2, plane) for plane in (d, d + THICK))
    edges = centred_edges(400, 0.01)
    expected = np.clip((np.minimum(edges[1:], high) - np.maximum(edges[:-1], low)) / 0.01, 0, 1)
    assert 0.1 < expected.sum() * 0.01 / WIDTH < 1.2
    assert np.allclose(left[:, 0], expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["separable", "flatcam", "open"])
def test_a_frame_equals_rays_counted_through_both_faces(kind: str) -> None:
    """A point source: its rays to 40 x 40 points of each pixel, each asked whether both faces let it pass."""
    geometry = CameraGeometry(
        pixels=16, pixel_pitch=0.03, mask=kind, mask_order=4, mask_thickness=0.15, scene_distance=30.0
    )
    tau_row, tau_column, depth, d = 0.12, -0.16, 30.0, 2.0
    terms = shadow_terms(geometry, Directions([tau_row], 0.0), Directions([tau_column], 0.0), depth)
    got = sum(np.outer(left[:, 0], right[:, 0]) for left, right in terms)
    u = (np.arange(16 * 40) - 320 + 0.5) * 0.03 / 40

    def crossing(tau: float, plane: float) -> np.ndarray:
        return u + (tau * depth - u) / depth * plane

    mask = geometry.build_mask()
    rays = np.ones((u.size, u.size))
    for plane in (d, d + 0.15):
        rays *= mask.transmission(crossing(tau_row, plane)[:, None], crossing(tau_column, plane)[None, :])
    counted = rays.reshape(16, 40, 16, 40).mean(axis=(1, 3))
    # At most two edges a pixel and axis, each placed to half of 1/40.
    assert np.abs(got - counted).max() < 0.05
    assert abs(got.mean() - counted.mean()) < 2e-3
    thin = geometry.model_copy(update={"mask_thickness": 0.0})
    terms = shadow_terms(thin, Directions([tau_row], 0.0), Directions([tau_column], 0.0), depth)
    single = sum(np.outer(left[:, 0], right[:, 0]) for left, right in terms)
    if kind != "open":
        assert np.abs(single - counted).max() > 0.3, "the second face has to matter"


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("kind", ["separable", "flatcam"])
def test_rendered_frames_are_the_closed_form(kind: str) -> None:
    """Uniform sky seen through a thick mask by small pixels with an angular response, against the shadow's terms.

    Sixteen passes of 64 x 64 x 64 rays. Two numbers: the mean, and the projection on the expected pattern. Gate: six
    standard errors from 16 passes: chance 2e-5 each (Student, 15 degrees of freedom).
    """
    import mitsuba as mi

    values = {"mask_order": 3, "mask_feature": 0.6, "pixel_pitch": 0.05, "mask_thickness": 0.6, "fov": 40.0}
    effects = {"pixel_fill_factor": 0.5, "angular_exponent": 3.0}
    geometry = CameraGeometry(pixels=64, mask=kind, **values, **effects)

    def closed(camera: CameraGeometry) -> np.ndarray:
        at = Directions.cells(np.linspace(-1, 1, 401) * camera.tan_half_fov)
        squared = np.square(at.centres)[:, None] + np.square(at.centres)[None, :]
        light = (1 + squared) ** -2 * camera.angular_response(squared) * at.width**2
        return np.asarray(sum(left @ light @ right.T for left, right in shadow_terms(camera, at, at, np.inf)))

    film = {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    camera = {"type": "mitsim_lensless", "mask": kind, **values, **effects, "film": film}
    scene = mi.load_dict({"type": "scene", "camera": camera, "sky": {"type": "constant"}, "path": {"type": "path"}})
    passes = [np.array(mi.render(scene, spp=64, seed=seed), np.float64)[..., 0] for seed in range(16)]
    expected = closed(geometry)
    pattern = expected - expected.mean()

    def numbers(frame: np.ndarray) -> np.ndarray:
        return np.array([frame.mean() / expected.mean(), (frame * pattern).sum() / np.square(pattern).sum()])

    found = np.array([numbers(frame) for frame in passes])
    error = found.std(axis=0, ddof=1) / 4
    assert (error < 0.002).all()
    assert (np.abs(found.mean(axis=0) - 1) < 6 * error).all()
    for name in ("mask_thickness", "pixel_fill_factor", "angular_exponent"):
        neutral = CameraGeometry.model_fields[name].default
        other = numbers(closed(geometry.model_copy(update={name: neutral})))
        assert (np.abs(other - 1) > 12 * error).any(), f"{name} has to show"


@pytest.mark.parametrize("kind", ["separable", "flatcam"])
@pytest.mark.parametrize("spectrum", [None, Spectrum([450.0, 640.0], [0.4, 0.6])])
def test_a_mask_of_next_to_no_thickness_is_a_thin_one(kind: str, spectrum: Spectrum | None) -> None:
    """Faces a picometre apart: other code, the same frame (the grid of a thick mask's waves is twice as coarse)."""
    at = Directions(np.linspace(-0.15, 0.15, 5), 2e-3)
    frames = []
    for thickness in (0.0, 1e-9):
        geometry = CameraGeometry(mask=kind, pixels=64, mask_order=6, mask_thickness=thickness)
        terms = shadow_terms(geometry, at, at, 400.0, spectrum)
        frames.append(np.asarray(sum(np.einsum("ir,jc->ijrc", left, right) for left, right in terms)))
    thin, thick = frames
    error = np.linalg.norm(thick - thin) / np.linalg.norm(thin)
    assert error < (1e-8 if spectrum is None else 1e-3)


@pytest.mark.parametrize("spectrum", [None, Spectrum([550.0], [1.0])])
def test_each_direction_sees_an_aperture_of_its_own(spectrum: Spectrum | None) -> None:
    geometry = CameraGeometry(mask="flatcam", pixels=32, mask_order=6, mask_thickness=0.1)
    at = Directions([-0.14, 0.02, 0.13], 1e-3)
    together = shadow_terms(geometry, at, at, 50.0, spectrum)
    for j, tau in enumerate(at.centres):
        alone = shadow_terms(geometry, Directions([tau], 1e-3), Directions([tau], 1e-3), 50.0, spectrum)
        for (left, right), (one_left, one_right) in zip(together, alone, strict=True):
            assert np.allclose(left[:, [j]], one_left, rtol=0, atol=1e-9)
            assert np.allclose(right[:, [j]], one_right, rtol=0, atol=1e-9)


def test_a_thick_flatcam_mask_has_four_products_or_sixteen_terms_of_waves() -> None:
    geometry = CameraGeometry(mask="flatcam", pixels=8, mask_order=4, mask_thickness=0.05)
    at = Directions([0.05], 0.0)
    assert len(shadow_terms(geometry, at, at, 400.0)) == 4
    assert len(shadow_terms(geometry, at, at, 400.0, Spectrum([550.0], [1.0]))) == 16


def test_a_cell_takes_the_clear_profile_of_its_centre() -> None:
    """What that leaves: over a scene pixel of the paper, 2e-3 of the shadow of a mask as thick as a feature is wide."""
    geometry = CameraGeometry(pixels=128, mask_order=7, mask_thickness=0.06)
    width = 120 / 128 / 400
    centres = np.linspace(-0.15, 0.15, 5)
    ((left, _),) = shadow_terms(geometry, Directions(centres, width), Directions([0.0], 0.0), 400.0)
    parts = (centres[:, None] + (np.arange(64) - 31.5) / 64 * width).ravel()
    ((fine, _),) = shadow_terms(geometry, Directions(parts, width / 64), Directions([0.0], 0.0), 400.0)
    mean = fine.reshape(128, 5, 64).mean(axis=2)
    assert 0 < np.linalg.norm(left - mean) / np.linalg.norm(mean) < 2e-3


def test_wall_shift_in_features() -> None:
    geometry = CameraGeometry(mask_thickness=0.1)
    assert geometry.wall_shift_features == pytest.approx(0.1 * np.tan(np.radians(10)) / 0.06)
    assert CameraGeometry().wall_shift_features == 0


def test_a_mask_reaching_into_the_scene_is_refused() -> None:
    with pytest.raises(MitsimError, match="mask_thickness 398"):
        validate(CameraGeometry, {"mask_thickness": 398.0}, "here")
    at = Directions([0.0], 0.0)
    with pytest.raises(MitsimError, match=r"beyond the mask at 2\.5 mm"):
        shadow_terms(CameraGeometry(mask_thickness=0.5), at, at, 2.2)

"""Surfaces that stand too close behind glass, and such that only seem to."""

from collections.abc import Callable
from pathlib import Path

import pytest

from mitsim.api.bench import open_bench
from mitsim.core.errors import MitsimError
from mitsim.scene.load import LoadedScene
from tests.physics.passages import THIN, plate
from tests.unit.transport.test_panes import slab

pytestmark = pytest.mark.usefixtures("variant")
Scene = Callable[..., LoadedScene]


@pytest.fixture
def loaded(small_scene: Callable[..., Path], variant: str) -> Scene:
    """The small scene's sheet at 400 mm, with more."""
    return lambda extra: open_bench(small_scene(extra=extra, integrator="volpath"), variant).loaded


@pytest.mark.parametrize("gap", [0.0, 1e-3, -1e-3])
@pytest.mark.parametrize("glass", [slab(398, 4), plate(400, THIN, 60), plate(400, '<bsdf type="null"/>', 60)])
def test_contact_is_refused(loaded: Scene, glass: str, gap: float) -> None:
    moved = glass.replace('z="398"', f'z="{398 - gap}"').replace('z="400"', f'z="{400 - gap}"')
    with pytest.raises(
        MitsimError, match=r"small.xml:\d+: shape: got another surface at a distance of .* the factored"
    ):
        loaded(moved)


def test_a_gap_that_mitsuba_skips_is_the_references_refusal(loaded: Scene) -> None:
    for z, refused in ((398 - 0.02, True), (398 - 0.06, False)):
        unfit = loaded(slab(z, 4)).unfit
        assert unfit.factored is None and (unfit.reference is not None) == refused
    assert "the reference sees what stands at least 0.039 mm" in str(loaded(slab(398 - 0.02, 4)).unfit.reference)


def test_a_foil_of_glass_is_too_thin_for_the_reference(loaded: Scene) -> None:
    unfit = loaded(slab(350, 0.02)).unfit
    assert unfit.factored is None and unfit.reference is not None


def test_what_touches_along_a_line_or_in_a_point_is_no_contact(loaded: Scene) -> None:
    ball = '<shape type="sphere"><point name="center" x="3" y="2" z="356"/><float name="radius" value="10"/></shape>'
    crossing = plate(340, THIN, 25, turn=20) + plate(340, "", 25, turn=-10)
    unfit = loaded(slab(368, 4) + ball + crossing).unfit
    assert unfit.factored is None and unfit.reference is None

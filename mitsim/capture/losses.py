"""Light that frames are known to lack, whatever the plan: a loaded scene and switches in, sentences out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mitsim.scene.load import LoadedScene


_PATHS = 2**15
"""Paths of the pilot's shortest looks, 4 of 2 x 64 x 64: light that these miss is in no plan."""
_FEWEST = 8.0
"""Hits of a lamp by all paths below which they may meet it so seldom that nobody knows its light: of Poisson's numbers
about 8, one in 3000 is none."""


def known_losses(loaded: LoadedScene, effects: Mapping[str, bool]) -> Iterator[str]:
    """What the factored estimator does not find of a scene; nothing of effects that are switched off.

    Parameters
    ----------
    loaded
        the scene.
    effects
        switched on or off by the user.
    """
    if effects.get("ambient", True):
        yield from unseen_lamps(loaded, _PATHS, "the factored estimator")
    if effects.get("mirrors", True):
        if loaded.unfit.lamps and effects.get("ambient", True):
            yield loaded.unfit.lamps
        if loaded.unfit.instances:
            yield loaded.unfit.instances


def unseen_lamps(loaded: LoadedScene, paths: float, estimator: str) -> Iterator[str]:
    """Lamps that shine on the sensor itself, and that paths from there do not meet, or hardly.

    Parameters
    ----------
    loaded
        the scene.
    paths
        from all over the field stop.
    estimator
        whose they are, in words.
    """
    from mitsim.transport.shining import part_of_view, shines_in

    for lamp, tag in loaded.small_lamps:
        if shines_in(loaded.scene, loaded.camera, lamp):
            rule = (
                f"it shines on the sensor itself, and {estimator} has no light of a lamp but over surfaces, so that is "
                "missing; keep it out of the view, or use a light that has a surface (area)"
            )
            yield str(tag.refusal("light", repr(tag.attributes.get("type", "")), rule))
    for tag, shape in zip(loaded.shapes, loaded.scene.shapes(), strict=True) if loaded.shapes else ():
        part = part_of_view(loaded.scene, loaded.camera, shape) if shape.is_emitter() else 0.0
        if 0 < part * paths < _FEWEST:
            rule = (
                f"{estimator} meets what shines on the sensor itself by chance, and {paths:.2g} paths meet this "
                f"{part * paths:.1g} times, so its light may be missing; keep it out of the view, or take a lamp that "
                f"is {(_FEWEST / (part * paths)) ** 0.5:.2g} times as wide and as much dimmer"
            )
            yield str(tag.refusal("lamp", f"{part:.1e} of the field of view", rule))

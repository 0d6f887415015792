"""Light that frames are known to lack, whatever the plan: a loaded scene and switches in, sentences out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mitsim.scene.load import LoadedScene


def known_losses(loaded: LoadedScene, effects: Mapping[str, bool]) -> Iterator[str]:
    """What the factored estimator does not find of a scene; nothing of effects that are switched off.

    Parameters
    ----------
    loaded
        the scene.
    effects
        switched on or off by the user.
    """
    from mitsim.transport.shining import shines_in

    for lamp, tag in loaded.small_lamps if effects.get("ambient", True) else ():
        if shines_in(loaded.scene, loaded.camera, lamp):
            rule = (
                "it shines on the sensor itself, and the factored estimator has no light of a lamp but over surfaces, "
                "so that is missing; keep it out of the view, or use a light that has a surface (area)"
            )
            yield str(tag.refusal("light", repr(tag.attributes.get("type", "")), rule))
    if effects.get("mirrors", True):
        if loaded.unfit.lamps and effects.get("ambient", True):
            yield loaded.unfit.lamps
        if loaded.unfit.instances:
            yield loaded.unfit.instances

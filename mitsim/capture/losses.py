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
    if effects.get("mirrors", True):
        if loaded.unfit.lamps and effects.get("ambient", True):
            yield loaded.unfit.lamps
        if loaded.unfit.instances:
            yield loaded.unfit.instances

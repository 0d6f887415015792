"""How a camera's factors are modelled: words of a command line, or arguments of Python, in; a checked request out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, get_args

from mitsim.core.arguments import checked_fields
from mitsim.core.errors import ArgumentError
from mitsim.devices.session import Side

Model = Literal["geometric", "wave"]
"""Of the mask's shadow: rays, or waves of the projector's lines."""
UNITS: Mapping[str, str] = MappingProxyType(
    {
        "mask_distance": "mm",
        "mask_shift_row": "mm",
        "mask_shift_column": "mm",
        "mask_rotation": "rad",
        "magnification": "1",
        "projector_row": "tan",
        "projector_column": "tan",
        "gain": "e-/s",
    }
)
"""Numbers of a rig that can be fitted (:class:`mitsim.optics.camera_model.Placement`), and their units."""
FITTED = ("mask_distance", "mask_shift_row", "mask_shift_column", "mask_rotation", "magnification", "gain")
"""Those that are, where nothing is said: a shift of the projector's window looks like one of the mask."""


@checked_fields
@dataclass(frozen=True)
class Modelling:
    """Which model is fitted to how many frames.

    Attributes
    ----------
    model
        of the mask's shadow.
    frames
        of the session that are used, at most.
    fitted
        names of :data:`UNITS`; the rest is as the scene states it. The gain is always fitted.
    accuracy
        of a simulated session's light.
    """

    model: Model
    frames: int = 16
    fitted: tuple[str, ...] = FITTED
    accuracy: float = 1e-3

    def __post_init__(self) -> None:
        if not isinstance(self.model, str) or self.model not in get_args(Model):
            raise ArgumentError("model", f"{self.model!r}: use {' or '.join(get_args(Model))}")
        if self.frames < 2:
            raise ArgumentError("frames_used", f"{self.frames}: give 2 or more; a +-1 pattern is two frames")
        for name in self.fitted:
            if name not in UNITS:
                raise ArgumentError("fit", f"{name!r}: use names of {', '.join(UNITS)}")
        for axis in ("row", "column"):
            if {f"mask_shift_{axis}", f"projector_{axis}"} <= {*self.fitted}:
                raise ArgumentError(
                    "fit",
                    f"mask_shift_{axis},projector_{axis}: both move the shadow alike, and cannot be told apart but by "
                    "how its brightness falls off; fit one of them",
                )

    @property
    def free(self) -> tuple[str, ...]:
        """What is fitted, each once."""
        return tuple(name for name in UNITS if name in (*self.fitted, "gain"))

    def chosen(self, changes: Sequence[int], pairs: bool, repeats: int) -> list[tuple[Side, int]]:
        """Side and number of the +-1 patterns whose frames are used: uniform light, then ever finer stripes, vertical
        and horizontal ones. Coarse stripes cast the deepest shadows, which a mask's fringes change least.

        Parameters
        ----------
        changes
            of sign in each pattern of a side; none in number 0.
        pairs, repeats
            whether a pattern is two frames, or one beside its side's uniform one; and how often each is taken.
        """
        shots = max(self.frames // repeats, 2)
        most = shots // 2 if pairs else max(shots - 2, 1)
        finer = sorted(range(1, len(changes)), key=lambda index: changes[index])
        turns: tuple[Side, Side] = "vertical", "horizontal"
        order: list[tuple[Side, int]] = [("horizontal", 0)]
        order += [(side, index) for index in finer for side in turns]
        return order[:most]


def frames_of(chosen: Sequence[tuple[Side, int]], pairs: bool, repeats: int) -> int:
    """How many frames the ``chosen`` patterns are.

    Parameters
    ----------
    chosen, pairs, repeats
        as :meth:`Modelling.chosen` has them.
    """
    sides = len({side for side, _ in chosen})
    return repeats * (2 * len(chosen) if pairs else len(chosen) + sides)

"""Where a study measures: setups, whose points share light and calibration, and points."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from mitsim.core.environment import DEFAULT_VARIANT

if TYPE_CHECKING:
    from mitsim.report.table import Value

_KEY_DIGITS = 16
"""Of a point's name: two of 10^4 points have the same with a chance of 10^-11."""


@dataclass(frozen=True)
class Setup:
    """What light is traced for and a camera calibrated: points that share one share its light.

    Attributes
    ----------
    scene
        scene XML, or the name of a shipped scene.
    picture
        print that the scene's own is replaced with (:mod:`mitsim.studies.framework.pictures`); None: its own.
    parameters
        (name, value) of the scene's parameters.
    camera, projector, variant, outside
        as for :func:`mitsim.open_bench`; ``outside`` is its ``allow_outside_files``.
    accuracy
        of the light.
    """

    scene: str = "photograph"
    picture: str | None = None
    parameters: tuple[tuple[str, str], ...] = ()
    camera: str | None = None
    projector: str | None = None
    variant: str = DEFAULT_VARIANT
    outside: bool = False
    accuracy: float = 1e-3

    def changed(self, **parameters: object) -> Setup:
        """The same with other ``parameters`` of the scene."""
        new = {**dict(self.parameters), **{name: f"{value}" for name, value in parameters.items()}}
        return replace(self, parameters=tuple(sorted(new.items())))

    def printed(self, picture: str | None) -> Setup:
        """The same with another ``picture`` on its print."""
        return replace(self, picture=picture)


@dataclass(frozen=True)
class Point:
    """One measurement of a study: its ``setup``, and the ``values`` of all else that varies, by name."""

    setup: Setup
    values: tuple[tuple[str, Value], ...]

    @classmethod
    def of(cls, setup: Setup, **values: Value) -> Point:
        """Of a ``setup``, with these ``values``."""
        return cls(setup, tuple(values.items()))

    def __getitem__(self, name: str) -> Any:
        return dict(self.values)[name]

    def row(self, **measured: Value) -> dict[str, Value]:
        """A row of the table: all that varies, and what was ``measured``."""
        return {"picture": self.setup.picture, **dict(self.setup.parameters), **dict(self.values), **measured}

    @property
    def key(self) -> str:
        """Name of the file that keeps its findings."""
        text = json.dumps(asdict(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:_KEY_DIGITS]

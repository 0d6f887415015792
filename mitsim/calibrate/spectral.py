"""Calibration by line: a bench of several spectral lines and how a session is run in; factors at each line out.

Apart from :mod:`mitsim.acquire.spectral`: captures need neither sessions nor what makes factors of them, and importing
these takes a fifth of a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsim.acquire.mosaic import MosaicBench, mosaic_manifest
from mitsim.acquire.spectral import ColourBench, claimed
from mitsim.calibrate.calibrate import calibrate_session
from mitsim.calibrate.session import Session
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.core.spectral_manifests import CALIBRATION
from mitsim.devices.session import SessionRecipe, load_recipe
from mitsim.light.light import SampledLight
from mitsim.light.plan import Plan
from mitsim.reconstruct.mosaic import behind

if TYPE_CHECKING:
    from mitsim.bench.bench import Apparatus
    from mitsim.reconstruct.factors import Factors

_REPEATS_BEHIND_FILTERS = 4
"""Of every shot of a session behind filters, unless a recipe says otherwise: most pixels see a tenth of a line that
fills others, and of single shots some directions of the OV5647's filters over the IMX249 are not above the noise."""


def calibrate_lines(
    bench: Apparatus,
    seed: int = 0,
    accuracy: float = 1e-3,
    recipe: SessionRecipe | None = None,
    output: Path | str | None = None,
    resume: bool = False,
    job: Job | None = None,
) -> dict[str, Factors]:
    """Factors at each line, by its name; see :meth:`mitsim.api.bench.Bench.calibrate_lines`.

    Parameters
    ----------
    bench, seed, accuracy, recipe, output, resume, job
        as there.

    Raises
    ------
    MitsimError
        as there.
    """
    colours = ColourBench.of(bench, CALIBRATION)
    sessions = line_sessions(colours, (recipe or load_recipe()).of_one_depth(), seed)
    return run_sessions(colours, sessions, accuracy, output, resume, job or Job())


def line_sessions(
    colours: ColourBench, recipe: SessionRecipe, seed: int, filters: Sequence[FloatArray] | None = None
) -> list[Session]:
    """The session of each line, whose light is traced with the others'.

    Parameters
    ----------
    colours, recipe, seed
        bench and lines, how they are run, and the root of their random streams.
    filters
        (pixels, pixels) part of each line's light that filters pass; None: all.
    """
    shared = _SharedLight(colours, Session(colours.whole, recipe, seed))
    passed: Sequence[FloatArray | None] = filters or [None] * len(colours.benches)
    return [
        _LineSession(each, recipe, seed, filters=own, shared=shared, line=number)
        for number, (each, own) in enumerate(zip(colours.benches, passed, strict=True))
    ]


def run_sessions(
    colours: ColourBench,
    sessions: Sequence[Session],
    accuracy: float,
    output: Path | str | None,
    resume: bool,
    job: Job,
) -> dict[str, Factors]:
    """Factors at each line, by its name.

    Parameters
    ----------
    colours, sessions
        bench and lines, and the session of each.
    accuracy, output, resume, job
        as for :meth:`mitsim.api.bench.Bench.calibrate_lines`.
    """
    with claimed(output, colours.manifest, resume) as places:
        lines = zip(colours.manifest.names, sessions, places, strict=True)
        return {name: calibrate_session(each, accuracy, place, resume, job) for name, each, place in lines}


@dataclass(frozen=True, eq=False)
class _SharedLight:
    """Light of the board by line, traced when it is first asked for."""

    colours: ColourBench
    session: Session
    _found: dict[str, Any] = field(default_factory=dict)

    def plan(self, accuracy: float, job: Job) -> Plan:
        """As :meth:`Session.plan`, of all lines together."""
        if "plan" not in self._found:
            self._found["plan"] = self.session.plan(accuracy, job)
        plan: Plan = self._found["plan"]
        return plan

    def light(self, line: int, plan: Plan, job: Job) -> SampledLight:
        """As :meth:`Session.trace`.

        Parameters
        ----------
        line
            its number.
        plan, job
            as there.
        """
        if "lights" not in self._found:
            boards = _boards(self.colours, self.session.recipe)
            self._found["lights"] = self.session.trace_lines(boards, plan, job)
        light: SampledLight = self._found["lights"][line]
        return light


@dataclass(frozen=True)
class _LineSession(Session):
    """A session whose light is traced with that of other lines."""

    shared: _SharedLight | None = None
    line: int = 0

    @cached_property
    def board(self) -> Apparatus:
        assert self.shared is not None
        return _boards(self.shared.colours, self.recipe)[self.line]

    def plan(self, accuracy: float, job: Job) -> Plan:
        assert self.shared is not None
        return self.shared.plan(accuracy, job)

    def trace(self, plan: Plan, job: Job) -> SampledLight:
        assert self.shared is not None
        return self.shared.light(self.line, plan, job)


def _boards(colours: ColourBench, recipe: SessionRecipe) -> tuple[Apparatus, ...]:
    """The bench of each line before one board of a ``recipe``."""
    board = Session(colours.whole, recipe).board
    return tuple(replace(bench, loaded=board.loaded) for bench in colours.benches)


def calibrate_mosaic(
    bench: Apparatus,
    seed: int = 0,
    accuracy: float = 1e-3,
    recipe: SessionRecipe | None = None,
    output: Path | str | None = None,
    resume: bool = False,
    job: Job | None = None,
) -> dict[str, Factors]:
    """Factors at each line; see :meth:`mitsim.api.bench.Bench.calibrate_mosaic`.

    Parameters
    ----------
    bench, seed, accuracy, recipe, output, resume, job
        as there.

    Raises
    ------
    MitsimError
        as there.
    """
    whole = MosaicBench.of(bench)
    colours = ColourBench.of(whole, CALIBRATION)
    weights = np.array(mosaic_manifest(whole, colours).weights)
    if (dark := np.argwhere(weights == 0)).size:
        plane, line = dark[0]
        raise MitsimError(
            f"camera {bench.rig.camera_file}: its {whole.mosaic.mosaic[plane] if whole.mosaic.mosaic else ''} filters "
            f"pass nothing of {colours.manifest.names[line]}, so a calibration in this line alone does not see all "
            "pixels; use a projector whose lines all filters pass"
        )
    passed = behind(weights, bench.geometry.frame_shape)
    recipe = recipe or load_recipe().model_copy(update={"repeats": _REPEATS_BEHIND_FILTERS})
    sessions = line_sessions(colours, recipe.of_one_depth(), seed, list(passed))
    return run_sessions(colours, sessions, accuracy, output, resume, job or Job())

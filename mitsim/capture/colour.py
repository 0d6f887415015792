"""Sequential colour: a bench of several spectral lines in; a run for each line alone out.

A camera without colours sees one line of the projector at a time. Light of all lines is traced on the same paths
(:func:`mitsim.capture.light.trace_lines`), which carry a wavelength for each; from there on every line is a bench of
its own, with the line's power, diffraction and photons, and what is made of it is an ordinary run. Calibrations are in
:mod:`mitsim.capture.colour_session`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mitsim.capture.evidence import Settings
from mitsim.capture.lamplight import lit_by_lamps
from mitsim.capture.light import Light, Sampling, trace_lines
from mitsim.capture.plan import Plan
from mitsim.capture.request import check_untimed
from mitsim.capture.run import capture, check_run, plan_request, sampling_of
from mitsim.capture.simulation import Simulation
from mitsim.capture.truth import trace_truths
from mitsim.core.colours import RUN, ColourManifest, Line, spectral_of, write_colours
from mitsim.core.errors import ArgumentError
from mitsim.core.job import Job
from mitsim.core.output import output_folder
from mitsim.core.seeds import integer
from mitsim.rig.patterns import Lighting
from mitsim.rig.projector import Lines
from mitsim.transport.histogram import Deposits

if TYPE_CHECKING:
    from mitsim.capture.bench import Bench
    from mitsim.capture.request import Request
    from mitsim.core.runs import Capture

_RAYS, _ALIKE = 4, 0.9
"""Rays of each pixel that tell how rough a line's light is, and paths of each cell that tell lamps' light, a tenth of a
second; and the part of the roughest line's differences from which a line counts as rough: what a plan leaves follows
their root, of which this is a twentieth."""


@dataclass(frozen=True)
class ColourBench:
    """A bench by the lines of its projector.

    Attributes
    ----------
    whole
        all lines, which paths carry together.
    manifest
        names of the lines.
    """

    whole: Bench
    manifest: ColourManifest

    @classmethod
    def of(cls, bench: Bench, kind: str) -> ColourBench:
        """Of a ``bench``, for folders of a ``kind``. MitsimError where its light cannot be traced by line."""
        if not bench.variant.endswith("_spectral"):
            needed = spectral_of(bench.variant)
            raise ArgumentError("variant", f"{bench.variant}: knows no wavelengths; open the bench with {needed}")
        lines = bench.projector.traced_lines
        named = [
            Line(name=f"{wavelength:g}nm", wavelength_nm=wavelength, radiant_share=share)
            for wavelength, share in zip(lines.wavelengths_nm, lines.shares, strict=True)
        ]
        manifest = ColourManifest.model_validate({"kind": kind, "channels": tuple(named)})
        return cls(replace(bench, lines=lines), manifest)

    @cached_property
    def benches(self) -> tuple[Bench, ...]:
        """The bench of each line alone."""
        assert self.whole.lines is not None, "of the projector"
        return tuple(line_alone(self.whole, line) for line in self.whole.lines.single)

    def lit_by_lamps(self, effects: Mapping[str, bool], seed: int) -> ColourBench:
        """The same with lamps that shine at wavelengths of their own; itself where they do.

        Parameters
        ----------
        effects, seed
            as :func:`mitsim.capture.lamplight.lit_by_lamps` takes them.

        Raises
        ------
        MitsimError
            as there.
        """
        if self.whole.lamplight is not None:
            return self
        return replace(self, whole=lit_by_lamps(self.whole, effects, seed))

    def roughest(self, seed: int, lit: float = 1.0) -> Bench:
        """The line that is planned for: that whose light differs most between neighbouring pixels of the projector,
        as a part of all light.

        What a plan makes coarse leaves most of such light. Of lines that are alike the longest, whose shadow has the
        widest fringes, is the worst.

        Parameters
        ----------
        seed
            of a few rays for each pixel.
        lit
            part of the pixels that a shot lights, beside which lamps shine.
        """
        bench = self.whole
        simulation = Simulation(bench, Settings(bench.geometry.scene_distance, effects=frozenset({"ambient"})))
        stream = integer(seed, "colour")
        deposits, lamps = simulation.direct.trace(stream, 0, _RAYS), Deposits.none()
        if bench.lamplight is not None and simulation.from_camera is not None:
            lamps = simulation.from_camera.trace(stream, 0, _RAYS)
        wavelengths = [line.wavelength_nm for line in self.manifest.channels]
        steps = []
        pairs = zip(deposits.by_line(len(wavelengths)), lamps.by_line(len(wavelengths)), strict=True)
        for light, ambient in pairs:
            flux = np.bincount(light.pixel, light.value, bench.n**2).reshape(bench.n, bench.n)
            differences = sum(float(np.square(np.diff(flux, axis=axis)).sum()) for axis in (0, 1))
            energy = float(np.square(flux).sum())
            own = lit * float(flux.sum())
            part = own / (own + float(ambient.value.sum())) if own else 0.0
            steps.append(differences / energy * part**2 if energy else 0.0)
        alike = [line for line, step in enumerate(steps) if step >= _ALIKE * max(steps)]
        return self.benches[max(alike, key=lambda line: wavelengths[line])]


def capture_lines(
    bench: Bench,
    request: Request,
    job: Job | None = None,
    output: Path | str | None = None,
    resume: bool = False,
    plan: Plan | None = None,
) -> dict[str, Capture]:
    """A run for each line, by its name; see :meth:`mitsim.capture.bench.Bench.capture_lines`.

    Parameters
    ----------
    bench, request, job, output, resume
        as there.
    plan
        of all lines together, made already.

    Raises
    ------
    MitsimError
        as there.
    """
    job = job or Job()
    colours = ColourBench.of(bench, RUN)
    check_untimed(request.seconds)
    colours = colours.lit_by_lamps(request.effects, request.seed)
    with claimed(output, colours.manifest, resume) as places:
        for each, place in zip(colours.benches, places, strict=True):
            check_run(each, request, place, resume)
        lights = traced_lines(colours, request, job, plan)
        runs = zip(colours.manifest.names, colours.benches, lights, places, strict=True)
        return {name: capture(each, request, job, place, resume, light=light) for name, each, light, place in runs}


def line_alone(bench: Bench, line: Lines) -> Bench:
    """The ``bench`` whose projector shows a ``line`` alone."""
    rig = replace(bench.rig, projector=bench.projector.at(line.wavelengths_nm[0]))
    return replace(bench, rig=rig, lines=line)


def plan_lines(colours: ColourBench, request: Request) -> Plan:
    """The plan of all lines of ``colours`` together, which is that of the roughest, for a ``request``. MitsimError for
    what is not simulated in colour."""
    check_untimed(request.seconds)
    lighting = colours.whole.family(request.patterns, request.seed).lighting
    roughest = colours.lit_by_lamps(request.effects, request.seed).roughest(request.seed, _lit(lighting))
    lines = len(colours.manifest.channels)
    plan = plan_request(roughest, request, lines)
    if roughest.lamplight is not None and "ambient" not in plan.settings.effects:
        # Beside a weaker line lamps may count.
        plan = plan_request(roughest, request.changed(effects={**request.effects, "ambient": True}), lines)
    return plan


def traced_lines(
    colours: ColourBench, request: Request, job: Job, plan: Plan | None = None, sampling: Sampling | None = None
) -> list[Light]:
    """Light of each line with its truth, traced on the same paths.

    Parameters
    ----------
    colours
        bench and lines.
    request, job
        what is asked for; clock, progress and limits.
    plan
        made already.
    sampling
        other than the request's.

    Raises
    ------
    MitsimError
        for what is not simulated in colour, and work beyond the limits.
    """
    lighting = colours.whole.family(request.patterns, request.seed).lighting
    with job.planning(request.patterns):
        plan = plan or plan_lines(colours, request)
    if plan.cost:
        plan.cost.check(request.patterns, job.limits)
    with job.clock.stage("transport"):
        sampling = sampling or sampling_of(colours.whole, request)
        lights = trace_lines(colours.whole, colours.benches, plan, lighting, request.seed, sampling, job.progress)
    with job.clock.stage("truth"):
        errors = np.stack([light.flux_error for light in lights])
        truths = trace_truths(colours.whole, plan.settings, request.seed, errors)
    return [replace(light, known_truth=truth) for light, truth in zip(lights, truths, strict=True)]


def _lit(lighting: Lighting) -> float:
    """Part of the projector's pixels that a shot of a ``lighting`` lights, in the mean."""
    return float(np.mean(lighting.weights.mean(axis=0)[lighting.labels]))


@contextmanager
def claimed(output: Path | str | None, manifest: ColourManifest, resume: bool) -> Iterator[Sequence[Path | None]]:
    """Places for the lines' folders, None in memory; colour.json is written when all of them are finished.

    Parameters
    ----------
    output, resume
        as for :meth:`mitsim.capture.bench.Bench.capture_lines`.
    manifest
        of the lines.

    Raises
    ------
    MitsimError
        where the output cannot be written.
    """
    if output is None:
        yield [None] * len(manifest.names)
        return
    path = Path(output)
    again = resume and any((path / name).is_dir() for name in manifest.names)
    with output_folder(path, overwrite=again) as folder:
        yield [folder / name for name in manifest.names]
        write_colours(folder, manifest)

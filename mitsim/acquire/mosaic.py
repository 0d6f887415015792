"""A camera under a mosaic of colour filters: a bench of several lines in; a run of all, and factors of each, out.

Lines are traced as for sequential colour (:mod:`mitsim.acquire.spectral`). With w_pl the electrons that a pixel of
plane p of the 2 x 2 filters makes of a photon of line l, its expected electrons are

    e_p = t A sum_l w_pl E_l lambda_l / (h c),

those of a pixel without a filter, one electron a photon, in an irradiance sum_l w_pl E_l lambda_l / lambda of the
projector's effective wavelength lambda. Frames of that irradiance go through the sensor as any other's. Lamps shine at
wavelengths of their own, which each colour of filters counts for itself (:mod:`mitsim.devices.lamps`): a count c is an
irradiance c / lambda. The lines share their paths, for plan and sampling; here they are taken apart again.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsim.acquire.capture import capture, check_run, sampling_of
from mitsim.acquire.spectral import ColourBench, plan_lines, traced_lines
from mitsim.bench.bench import Apparatus
from mitsim.bench.request import check_untimed
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.files import prepare_output
from mitsim.core.job import Job
from mitsim.core.manifests import MANIFEST
from mitsim.core.runs import LineTruth, MosaicCapture
from mitsim.core.spectral_manifests import MOSAIC, MosaicManifest
from mitsim.devices.patterns import Lighting, PatternFamily
from mitsim.devices.sensor import SensorModel
from mitsim.devices.session import load_recipe
from mitsim.light.light import SampledLight
from mitsim.light.passes import Simulation
from mitsim.light.plan import Plan
from mitsim.light.truth import Truth
from mitsim.optics.frames import ExpectedFrames, Frame
from mitsim.reconstruct.mosaic import PLANES, behind

if TYPE_CHECKING:
    from mitsim.bench.request import Request


@dataclass(frozen=True)
class MosaicBench(Apparatus):
    """A bench whose camera is thought without its filters, one electron a photon; they are put over its frames.

    Attributes
    ----------
    camera
        as its file states it, filters and all.
    """

    camera: SensorModel | None = None

    @classmethod
    def of(cls, bench: Apparatus) -> MosaicBench:
        """Of a ``bench`` whose camera has a mosaic. MitsimError for another camera, or an odd number of pixels."""
        sensor = bench.sensor
        if sensor.mosaic is None:
            raise MitsimError(
                f"camera {bench.rig.camera_file}: has no mosaic of colour filters, and colour mosaic was asked for; "
                "use a camera that has one, such as imx249_rggb, or colour lines"
            )
        (rows, columns), first = bench.geometry.frame_shape, (bench.geometry.roi or (0, 0))[:2]
        if rows % 2 or columns % 2 or any(at % 2 for at in first):
            raise MitsimError(
                f"camera {bench.rig.camera_file}: frames of {rows} x {columns} pixels from row {first[0]} and column "
                f"{first[1]} do not hold whole filters of 2 x 2; give the scene's film even numbers"
            )
        bare = {"mosaic": None, "mosaic_curves": None, "quantum_efficiency": 1.0}
        rig = replace(bench.rig, sensor=sensor.model_copy(update=bare))
        return cls(**{each.name: getattr(bench, each.name) for each in fields(Apparatus)} | {"rig": rig}, camera=sensor)

    @property
    def counting(self) -> SensorModel:
        """:attr:`camera`: lamps' light is counted through its filters."""
        return self.mosaic

    @property
    def mosaic(self) -> SensorModel:
        """:attr:`camera`, which every bench that is made by :meth:`of` has."""
        assert self.camera is not None, "made by of()"
        return self.camera

    def identity(self) -> dict[str, Any]:
        """As of any bench, of the camera with its filters; lines are named by colour.json, not by a run of all."""
        found = super().identity()
        projector = found["projector"]
        if self.lines is not None and self.lines.several:
            projector = {key: value for key, value in projector.items() if key not in ("lines_nm", "radiant_shares")}
        return {**found, "sensor": self.mosaic.identity, "projector": projector}


@dataclass(frozen=True, eq=False)
class MosaicLight(SampledLight):
    """Light of all lines together behind the filters.

    Attributes
    ----------
    by_line
        light of each, traced on the same paths.
    passed
        (lines, m, m') part of each line's irradiance that counts, as that of the effective wavelength.
    """

    by_line: tuple[SampledLight, ...] = ()
    passed: FloatArray | None = None

    @classmethod
    def of(cls, bench: MosaicBench, lights: Sequence[SampledLight], wavelengths_nm: Sequence[float]) -> MosaicLight:
        """Of all lines together.

        Parameters
        ----------
        bench
            with all lines.
        lights, wavelengths_nm
            of each line.
        """
        weights = np.array(bench.mosaic.planes(wavelengths_nm))
        counted = weights * np.asarray(wavelengths_nm) / bench.projector.effective_wavelength_nm
        first = lights[0]
        own = {
            "simulation": Simulation(bench, first.plan.settings),
            "flux": np.tensordot(counted.mean(axis=0), [light.flux for light in lights], axes=1),
            "flux_error": np.tensordot(counted.mean(axis=0), [light.flux_error for light in lights], axes=1),
            "sampling_error": max(light.sampling_error for light in lights),
            "reached": all(light.reached for light in lights),
            "looked": None,
            "known_truth": _truth_of_all(lights, counted.mean(axis=0)),
            "by_line": tuple(lights),
            "passed": behind(counted, bench.geometry.frame_shape),
        }
        return cls(**{each.name: getattr(first, each.name) for each in fields(SampledLight)} | own)

    @property
    def lost(self) -> float:
        """The largest of any line."""
        return max(light.lost for light in self.by_line)

    def frames(self, lighting: Lighting, seed: int, leaking: bool = True) -> ExpectedFrames:
        """Expected frames of all lines together; see :meth:`Light.frames`.

        Parameters
        ----------
        lighting, seed, leaking
            as there.
        """
        assert self.passed is not None, "made by of()"
        lines = [light.frames(lighting, seed, leaking).of_projector for light in self.by_line]
        return MosaicFrames(lines, self.passed, self._lamps(seed), self.by_line[0].simulation.lamps_apart)

    def _lamps(self, seed: int) -> Frame | None:
        """Lamps' light behind the filters, with its error by probes of a ``seed``; None without lamps."""
        lamplight = self.bench.lamplight
        if lamplight is None:
            return None
        each = [lamplight.units_of(light.bench.projector.lines)[0] for light in self.by_line]
        unit, line = max((unit, line) for line, unit in enumerate(each))
        light = self.by_line[line]
        frames, counted = list[Frame](), np.zeros((len(PLANES), len(lamplight.responses)))
        for number, response in enumerate(lamplight.responses):
            frames += _lamps_alone(light, lamplight.rows(number), seed)
            # Filed is the mean over all pixels, of which the response's have it all.
            counted[list(response.planes), number] = 1 / (
                response.part * unit * self.bench.projector.effective_wavelength_nm
            )
        shape = self.bench.geometry.frame_shape
        irradiance = np.einsum("fij,fij->ij", behind(counted, shape), np.stack([each.irradiance for each in frames]))
        parts = np.square(counted).mean(axis=0) @ np.array([each.by_group for each in frames])  # no pixel has two
        variance = float(parts.sum())
        heaviest = float(parts.max()) / variance if variance else 0.0
        return Frame(irradiance, variance, max(each.removed for each in frames), heaviest, tuple(parts))

    def speckle(self, family: PatternFamily | None = None) -> float:
        """None, of any ``family``: a projector with speckle is refused."""
        return 0.0


def _lamps_alone(light: SampledLight, bands: slice, seed: int) -> ExpectedFrames:
    """One frame of lamps of a ``light``, of some ``bands`` of theirs; a ``seed`` of its probes."""
    lamplight = light.bench.lamplight
    assert lamplight is not None, "asked before"
    filed = light.simulation.of_lamps(light.groups, light.groups[0].rows - len(lamplight.bands), bands)
    return ExpectedFrames(filed, Lighting(np.zeros(1, np.int64), np.ones((1, 1))), seed)


def _excess(lights: Sequence[SampledLight]) -> float:
    """By how much the error of lamps' light behind filters exceeds that of their mean over all pixels, which is in
    every line's light; 1 without ``lights`` of lamps.

    A filter's few wavelengths are sampled worse than all. Its frames weigh by their energy, which for the same scene is
    that of what a pixel counts.
    """
    light, lamplight = lights[0], lights[0].bench.lamplight
    if lamplight is None or lamplight.shares is None:
        return 1.0
    whole, _ = _lamps_alone(light, slice(None), light.seed).sampling_error()
    energy = variance = 0.0
    for number, response in enumerate(lamplight.responses):
        rows = lamplight.rows(number)
        error, _ = _lamps_alone(light, rows, light.seed).sampling_error()
        own = float(lamplight.shares[rows].sum()) ** 2 / response.part
        energy, variance = energy + own, variance + own * error**2
    return max(1.0, math.sqrt(variance / energy) / whole) if whole else 1.0


class MosaicFrames(ExpectedFrames):
    """Frames of every shot behind the filters; iterate as often as needed.

    Lines are traced on the same paths, so their errors go together: that of the sum is at most the sum of theirs.
    So do they with that of lamps' light, but where no other light is on lamps' paths.

    Parameters
    ----------
    lines
        frames of each line, of the projector's light alone.
    passed
        (lines, m, m') part of its irradiance that counts.
    lamps
        their light, as it counts, which is in every frame.
    apart
        whether no other light is on their paths.
    """

    def __init__(
        self, lines: Sequence[ExpectedFrames], passed: FloatArray, lamps: Frame | None = None, apart: bool = False
    ) -> None:
        self._lines, self._passed, self._lamps, self._apart = tuple(lines), passed, lamps, apart
        self._spread = np.sqrt(np.square(passed).mean(axis=(1, 2)))

    def __len__(self) -> int:
        return len(self._lines[0])

    @property
    def has_ambient(self) -> bool:
        """Whether lamps shine."""
        return self._lamps is not None

    @property
    def projector_off(self) -> Frame:
        """The frame of lamps alone, dark where there are none; its Monte Carlo error is that of all frames."""
        return self._lines[0].projector_off if self._lamps is None else replace(self._lamps, variance=0.0, by_group=())

    def __iter__(self) -> Iterator[Frame]:
        always = () if self._lamps is None else (self._lamps,)
        for shot in zip(*self._lines, strict=True):
            light = np.einsum("lij,lij->ij", self._passed, np.stack([frame.irradiance for frame in shot]))
            if self._lamps is not None:
                light += self._lamps.irradiance
            groups = zip(*(frame.by_group or (frame.variance,) for frame in (*shot, *always)), strict=True)
            parts = [self._added(each) for each in groups]
            variance = sum(parts)
            yield Frame(
                light,
                variance,
                max(frame.removed for frame in (*shot, *always)),
                max(parts) / variance if variance else 0.0,
                tuple(parts) if shot[0].by_group else (),
            )

    def _added(self, variances: Sequence[float]) -> float:
        """Variance of the sum of all lines' light and lamps', from a group's of each."""
        lines, lamps = variances[: len(self._lines)], sum(variances[len(self._lines) :])
        own = float(self._spread @ np.sqrt(lines))
        return own**2 + lamps if self._apart else (own + math.sqrt(lamps)) ** 2


def capture_mosaic(
    bench: Apparatus, request: Request, job: Job | None = None, output: Path | str | None = None, resume: bool = False
) -> MosaicCapture:
    """A run of all lines at once; see :meth:`mitsim.api.bench.Bench.capture_mosaic`.

    Parameters
    ----------
    bench, request, job, output, resume
        as there.

    Raises
    ------
    MitsimError
        as there.
    """
    job, colours = job or Job(), _coloured(bench, request)
    assert isinstance(colours.whole, MosaicBench)
    manifest = mosaic_manifest(colours.whole, colours)
    place = None if output is None else Path(output)
    with _usable(place, resume):
        colours = colours.lit_by_lamps(request.effects, request.seed)
        all_lines = colours.whole
        assert isinstance(all_lines, MosaicBench)
        check_run(all_lines, request, place, resume)
        sampling = replace(sampling_of(all_lines, request), excess=_excess)
        lights = traced_lines(colours, request, job, sampling=sampling)
        light = MosaicLight.of(all_lines, lights, manifest.wavelengths_nm)
        shots = capture(all_lines, request, job, place, resume, light=light)
    board = load_recipe().board_reflectance
    truths = {
        name: LineTruth(own.apparent.reflectance, own.apparent.standard_error, board)
        for name, own in zip(manifest.names, lights, strict=True)
    }
    found = MosaicCapture(shots, manifest, truths)
    if shots.folder is not None:
        found.write_lines(shots.folder)
    return found


def plan_mosaic(bench: Apparatus, request: Request) -> Plan:
    """The plan of a run of all lines at once.

    Parameters
    ----------
    bench, request
        as of :func:`capture_mosaic`.

    Raises
    ------
    MitsimError
        as there.
    """
    return plan_lines(_coloured(bench, request), request)


@contextmanager
def _usable(place: Path | None, resume: bool) -> Iterator[None]:
    """Before light is traced: MitsimError where a run cannot be written to ``place``. A new folder in which nothing was
    written is removed."""
    new = place is not None and not place.exists()
    if place is not None:
        prepare_output(place, overwrite=resume and (place / MANIFEST).is_file())
    try:
        yield
    except BaseException:
        if new and place is not None:
            with suppress(OSError):  # not empty: what was written stays
                place.rmdir()
        raise


def mosaic_manifest(whole: MosaicBench, colours: ColourBench) -> MosaicManifest:
    """What colour.json says of a run of the ``whole`` rig with its ``colours``. MitsimError for a line that the
    filters' curves do not hold."""
    weights = whole.mosaic.planes(colours.manifest.wavelengths_nm)
    assert whole.mosaic.mosaic is not None, "checked before"
    lines = colours.manifest.channels
    return MosaicManifest(kind="mosaic-run", channels=lines, mosaic=whole.mosaic.mosaic, weights=weights)


def _coloured(bench: Apparatus, request: Request) -> ColourBench:
    """A ``bench`` behind its filters, by line. MitsimError for what of a ``request`` is not simulated there."""
    whole = MosaicBench.of(bench)
    colours = ColourBench.of(whole, MOSAIC)
    mosaic_manifest(whole, colours)
    check_untimed(request.seconds)
    _refuse_speckle(whole, request)
    return colours


def _refuse_speckle(bench: Apparatus, request: Request) -> None:
    """MitsimError for speckle: each line has its own, and each filter another mixture of them."""
    if request.effects.get("speckle", True) and (bench.projector.speckle_contrast or bench.projector.speckle):
        raise ArgumentError(
            "effects",
            f"projector {bench.projector.name} has speckle, which is not simulated behind colour filters; switch it "
            "off with -speckle",
        )


def _truth_of_all(lights: Sequence[SampledLight], counted: FloatArray) -> Truth:
    """What a perfect image of all pixels together would show: the lines' truths by the light that is counted of each
    on the board.

    Parameters
    ----------
    lights
        of the lines.
    counted
        (lines,) part of each line's light.
    """
    truths = [light.apparent for light in lights]
    shape = truths[0].reflectance.shape
    board = counted[:, None] * np.stack([truth.board_flux for truth in truths])
    whole = board.sum(axis=0)
    shares = np.divide(board, whole, out=np.zeros_like(board), where=whole > 0).reshape(-1, *shape)
    return Truth(
        reflectance=sum(
            (share * truth.reflectance for share, truth in zip(shares, truths, strict=True)), np.zeros(shape)
        ),
        standard_error=sum(
            (share * truth.standard_error for share, truth in zip(shares, truths, strict=True)), np.zeros(shape)
        ),
        board_flux=whole,
        rays=truths[0].rays,
    )

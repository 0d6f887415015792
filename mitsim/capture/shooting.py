"""Expected frames of a family in; its shots out, exposed and recorded, with what they all say of light and noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mitsim.capture.ambient import AmbientFrame
from mitsim.capture.evidence import GROUPS, Estimate
from mitsim.capture.exposer import Exposer, in_chunks
from mitsim.core.arrays import FloatArray, sum_of_squares
from mitsim.core.framefile import Channel
from mitsim.core.job import Job
from mitsim.core.manifests import AmbientFile
from mitsim.core.parallel import Behind, in_threads
from mitsim.core.recorders import AMBIENT, Recorder
from mitsim.optics.frames import ExpectedFrames, Frame, bound_of
from mitsim.rig.patterns import PatternFamily, Shot
from mitsim.sensor.chain import Digital


@dataclass(frozen=True)
class Totals:
    """Over all expected frames: brightest pixel [W m^-2], relative Monte Carlo error, most light below zero.

    ``heaviest``: the largest part of the Monte Carlo variance that one group of the light brings; ``mc_bound``: what
    that error is below, at 95 %.
    """

    peak: float
    mc_error: float
    removed: float
    heaviest: float
    mc_bound: float

    @property
    def noise(self) -> Estimate:
        """The Monte Carlo error, and its bound."""
        return Estimate(self.mc_error, self.mc_bound)

    @classmethod
    def of(cls, expected: ExpectedFrames) -> Totals:
        """Those of all ``expected`` frames, which are formed for it."""
        peak = energy = variance = removed = heaviest = 0.0
        parts = np.zeros(GROUPS)
        for chunk in in_chunks((frame,) for frame in expected):
            for (frame,), (brightest, squares) in zip(chunk, in_threads(_seen, chunk), strict=True):
                removed = max(removed, frame.removed)
                peak = max(peak, brightest)
                energy += squares
                variance += frame.variance * frame.irradiance.size
                heaviest += frame.heaviest * frame.variance * frame.irradiance.size
                parts += np.asarray(frame.by_group or (0.0,)) * frame.irradiance.size
        mc_error = float(np.sqrt(variance / energy)) if energy else 0.0
        return cls(peak, mc_error, removed, heaviest / variance if variance else 0.0, bound_of(parts, energy))


def _seen(item: tuple[Frame]) -> tuple[float, float]:
    """Irradiance of the brightest pixel of a frame, and the sum of its squares."""
    (frame,) = item
    return float(frame.irradiance.max()), sum_of_squares(frame.irradiance)


@dataclass(frozen=True, eq=False)
class _Exposed:
    """One exposed shot: expected electrons, digital numbers, the two noises [electrons, rms], sums over its pixels.

    ``light``, ``energy`` and ``signal``: of the electrons, of their squares, and of the squares without ambient light.
    """

    index: int
    shot: Shot
    electrons: FloatArray
    digital: Digital
    rendering_noise: float
    sensor_noise: float
    saturated: bool
    light: float
    energy: float
    signal: float


class Shooting:
    """Turns expected frames into noisy ones and records them; frames that a resumed run has already are kept."""

    def __init__(
        self,
        family: PatternFamily,
        recorder: Recorder,
        exposer: Exposer,
        ambient: AmbientFrame | None,
        always: FloatArray,
    ) -> None:
        """Nothing is exposed yet.

        Parameters
        ----------
        family, recorder, exposer
            the shots, where they are kept, and the camera.
        ambient
            what is taken off the frames.
        always
            (m, m') expected electrons of ambient light, which is in every frame.
        """
        self.family, self.recorder, self.exposer = family, recorder, exposer
        self.ambient, self.always = ambient, always
        self._has_ambient = bool(always.any())
        self.saturated, self.noise_ratio = 0, 0.0
        self._noise_energy = self._energy = self._signal = self._light = 0.0

    @property
    def sensor_noise(self) -> float:
        """Relative noise of the sensor, ||noise|| / ||expected||, over all frames, from its closed form."""
        return math.sqrt(self._noise_energy / self._energy) if self._energy else 0.0

    @property
    def dilution(self) -> float:
        """Norm of the frames' light over that of the projector's: by so much lamps dilute an error relative to all."""
        return math.sqrt(self._energy / self._signal) if self._signal else 1.0

    @property
    def ambient_part(self) -> float:
        """Ambient light in all light of the frames."""
        return float(self.always.sum()) * len(self.family.shots) / self._light if self._light else 0.0

    @property
    def noise_to_signal(self) -> float:
        """Noise of the frames less the ambient frame, ||noise|| / ||light of the projector||, over all frames."""
        own = 0.0
        if self.ambient is not None and not self.family.signed:
            own = self.exposer.sensor_noise(self.always) ** 2 / self.ambient.shots
            own *= self.always.size * len(self.family.shots)
        return math.sqrt((self._noise_energy + own) / self._signal) if self._signal else math.inf

    @property
    def ambient_file(self) -> AmbientFile | None:
        """What the manifest says of the ambient frame."""
        if self.ambient is None:
            return None
        return AmbientFile(file=AMBIENT, shots=self.ambient.shots, part=self.ambient_part, noise=self.noise_to_signal)

    def shoot(self, expected: ExpectedFrames, job: Job) -> None:
        """Expose and record the ``expected`` frames in chunks, one thread a processor; the ``job`` times its stages.

        Files are written while the next chunk is formed and exposed: ``write`` is the time that work waits for them.
        """
        chunks = in_chunks(zip(range(len(expected)), self.family.shots, expected, strict=True))
        with Behind(self._record) as writing:
            while True:
                with job.clock.stage("optics"):
                    chunk = next(chunks, None)
                if chunk is None:
                    break
                with job.clock.stage("sensor"):
                    exposed = in_threads(self._expose, chunk)
                with job.clock.stage("write"):
                    writing.give(exposed)
                for shot in exposed:
                    self._count(shot)
                job.progress("frames", (chunk[-1][0] + 1) / len(expected))
            with job.clock.stage("write"):
                writing.wait()

    def _count(self, shot: _Exposed) -> None:
        """Add what a ``shot`` says to what all say."""
        if shot.rendering_noise:
            ratio = shot.rendering_noise / shot.sensor_noise if shot.sensor_noise else np.inf
            self.noise_ratio = max(self.noise_ratio, ratio)
        self.saturated += shot.saturated
        self._noise_energy += shot.sensor_noise**2 * shot.electrons.size
        self._energy += shot.energy
        self._signal += shot.signal
        self._light += shot.light

    def _expose(self, item: tuple[int, Shot, Frame]) -> _Exposed:
        index, shot, frame = item
        electrons = self.exposer.lit(frame, *shot.names)
        digital = self.exposer.digital(electrons, *shot.names)
        energy = sum_of_squares(electrons)
        return _Exposed(
            index=index,
            shot=shot,
            electrons=electrons,
            digital=digital,
            rendering_noise=self.exposer.rendering_noise(frame),
            sensor_noise=self.exposer.sensor_noise(electrons),
            saturated=self.exposer.saturated(digital, electrons),
            light=float(electrons.sum()),
            energy=energy,
            signal=sum_of_squares(electrons - self.always) if self._has_ambient else energy,
        )

    def _record(self, exposed: _Exposed) -> None:
        if self.recorder.keeps(exposed.index):
            return
        metadata: dict[str, str | int | float] = {
            "row": exposed.shot.row,
            "column": exposed.shot.column,
            "sign": exposed.shot.sign,
            "exposure_s": self.exposer.exposure_s,
            "rendering_noise_e": exposed.rendering_noise,
            "seed": self.exposer.seed,
        }
        electrons = exposed.electrons.astype(np.float32)
        # EXR has no 64-bit numbers: the real-valued output of a sensor without an ADC is kept in single precision.
        whole = exposed.digital.dtype == np.uint32
        dn: Channel = exposed.digital.astype(np.uint32, copy=False) if whole else exposed.digital.astype(np.float32)
        self.recorder.write_frame(exposed.index, {"DN": dn, "electrons": electrons}, metadata)

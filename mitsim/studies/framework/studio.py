"""Where points of a study are measured: setups in; light, factors and images out, kept while neighbours share them."""

from __future__ import annotations

import shutil
import tempfile
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from filelock import FileLock
from skimage import io

from mitsim.acquire.capture import expose
from mitsim.api.bench import Bench, open_bench
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import locate
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import PatternFamily
from mitsim.light.plan import Plan
from mitsim.metrics import Quality
from mitsim.reconstruct.factors import Factors, load_calibration
from mitsim.reconstruct.misfit import Misfit
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.reconstruct.solution import Status
from mitsim.report import EQUAL_PEAK, RENDERED
from mitsim.report.lit_scene import LitScene, Unexposed
from mitsim.report.pages import Value
from mitsim.studies.framework.experiment import Point, Setup, picture

Kept = TypeVar("Kept")
_KEY_DIGITS = 16
"""Of a calibration's name: as of a point's."""
_PRINT = "reflectance.png"
"""What a scene with a print of its own has beside it."""


@dataclass(frozen=True, eq=False)
class Image:
    """One reconstruction and how good it is.

    Attributes
    ----------
    image, quality, lam
        (n, n) reflectance, against the truth, and lambda.
    shots, exposure_s
        frames, and seconds of each.
    flags
        columns of :func:`flags_of`.
    trust
        where it is known: the unexplained part of the measurements, their chi-square, the image's standard uncertainty.
    """

    image: FloatArray
    quality: Quality
    lam: float
    shots: int
    exposure_s: float
    flags: Mapping[str, Value]
    trust: Mapping[str, float | None] = field(default_factory=dict)

    @classmethod
    def of(
        cls, frames: Unexposed, seconds: float, lam: float | Literal["auto", "best"] = "auto", binning: int = 1
    ) -> Image:
        """That of one exposure.

        Parameters
        ----------
        frames
            what is exposed.
        seconds, lam, binning
            as for :meth:`mitsim.report.lit_scene.Unexposed.solve`.
        """
        solution = frames.solve(seconds, lam, binning)
        quality, shots = frames.lit.quality(solution.image), len(frames.family.shots)
        return cls(solution.image, quality, solution.lam, shots, seconds, flags_of(solution.status))

    def row(self) -> dict[str, Value]:
        """As a table has it."""
        return {
            "psnr_db": self.quality.psnr_db,
            "ssim": self.quality.ssim,
            "lambda": self.lam,
            "shots": self.shots,
            "exposure_s": self.exposure_s,
            **self.flags,
            **self.trust,
        }


def flags_of(*statuses: Status, misfit: Misfit | None = None, others: Iterable[str] = ()) -> dict[str, Value]:
    """Return the columns `flagged` and `reason` of an image, which every study's table has.

    Parameters
    ----------
    statuses, misfit
        of the solution, or of the solution of each line.
    others
        warnings of what the image was made of.
    """
    cause = f", {misfit.reason}" if misfit and misfit.flagged and misfit.cause else ""
    reasons = [f"{each.verdict.value}{cause}" for each in statuses if not each.verdict.good]
    flags = [text for each in statuses for text in each.flags]
    reasons += [text.partition(". ")[0].rstrip(".").replace("; ", ", ") for text in (*flags, *others)]
    return {"flagged": bool(reasons), "reason": "; ".join(dict.fromkeys(reasons))}


def _made_once(place: Path, make: Callable[[Path], object]) -> Path:
    """A ``place`` that several processes share, with what the first of them ``make``s there: whole or not at all, for
    it may be ended meanwhile."""
    place.parent.mkdir(exist_ok=True)
    with FileLock(place.with_suffix(".lock")):
        if not place.exists():
            part = place.with_suffix(".part")
            shutil.rmtree(part, ignore_errors=True)
            make(part)
            part.rename(place)
    return place


class Studio:
    """Benches, their light and their factors, the last few of each; a temporary folder holds scenes with other prints.

    To be used as a context, which removes that folder.

    Parameters
    ----------
    shared
        folder of plans and calibrations that several studios share; None: this one's are its own.
    """

    def __init__(self, shared: str | None = None) -> None:
        self._shared = None if shared is None else Path(shared)
        self._folder = tempfile.TemporaryDirectory(prefix="mitsim-study-")
        self._kept: dict[str, OrderedDict[Hashable, Any]] = {}

    def __enter__(self) -> Studio:
        return self

    def __exit__(self, *_: object) -> None:
        self._kept.clear()
        self._folder.cleanup()

    def folder(self, name: str) -> Path:
        """A new folder of this studio's own, which ends with it; what was in one of that ``name`` is removed."""
        place = Path(self._folder.name) / "own" / name
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        return place

    def made_once(self, kind: str, name: str, make: Callable[[Path], object]) -> Path:
        """A file or folder that studios share: whole or not at all.

        Parameters
        ----------
        kind, name
            folder that it is in, and what it is called there.
        make
            makes it at a path that does not exist.
        """
        return _made_once(self.shared_folder(kind) / name, make)

    def shared_folder(self, kind: str) -> Path:
        """Folder of what studios share of a ``kind``; this studio's own where there are no others."""
        place = (self._shared or Path(self._folder.name) / "shared") / kind
        place.mkdir(parents=True, exist_ok=True)
        return place

    def bench(self, setup: Setup) -> Bench:
        """The bench of a ``setup``.

        MitsimError as :func:`mitsim.open_bench`, and for another print on a scene that has none.
        """
        return self.once("bench", 3, setup, lambda: self._open(setup))

    def lit_scene(self, setup: Setup) -> LitScene:
        """The scene of a ``setup`` in its light."""
        return self.once("light", 1, setup, lambda: LitScene(self.bench(setup).light(self._plan(setup))))

    def factors(self, setup: Setup, seed: int) -> Factors:
        """What a session with the devices of a ``setup`` estimates, its noise from ``seed``; whatever the scene is."""
        bench = self.bench(setup)
        return self.once("factors", 4, (bench.devices_digest, seed), lambda: self._calibrate(bench, seed))

    def frames(self, setup: Setup, model: str, patterns: str | PatternFamily, seed: int = 0) -> Unexposed:
        """Frames of a family before any exposure.

        Parameters
        ----------
        setup, model, seed
            as for :meth:`image`.
        patterns
            the family, or its name.
        """
        factors = self.factors(setup, seed) if model == RENDERED else None  # first: a mask may have none
        lit = self.lit_scene(setup)
        family = lit.bench.family(patterns, seed) if isinstance(patterns, str) else patterns
        return lit.idealised_frames(family, seed) if factors is None else lit.rendered_frames(factors, family, seed)

    def image(
        self,
        setup: Setup,
        model: str,
        patterns: str,
        seed: int = 0,
        exposure: str = EQUAL_PEAK,
        focus: Literal["auto", "map"] | None = None,
    ) -> Image:
        """A scene as it comes out: rendered, as a user's own frames are exposed and reconstructed.

        Parameters
        ----------
        setup
            the scene.
        model
            one of :data:`mitsim.report.MODELS`.
        patterns
            the family.
        seed
            of the frames' noise, and of the calibration's.
        exposure
            one of :data:`mitsim.report.CONVENTIONS`, or ``DIM``.
        focus
            of rendered frames, as for :func:`mitsim.reconstruct`.
        """
        frames = self.frames(setup, model, patterns, seed)
        if model != RENDERED:
            return Image.of(frames, frames.seconds(exposure))
        seconds = "auto" if exposure == EQUAL_PEAK else frames.seconds(exposure)
        shots = expose(frames.lit.light, patterns, seed=seed, exposure=seconds)
        found = reconstruct(shots, self.factors(setup, seed), focus=focus)
        misfit, uncertainty = found.misfit, found.uncertainty
        trust = {
            "misfit": misfit.unexplained if misfit else None,
            "chi_square": misfit.chi_square if misfit else None,
            "uncertainty": None if uncertainty is None else float(np.sqrt(np.square(uncertainty).mean())),
        }
        count, quality = len(frames.family.shots), frames.lit.quality(found.image)
        flags = flags_of(found.status, misfit=misfit)
        return Image(found.image, quality, found.lam, count, shots.exposure_s, flags, trust)

    def _plan(self, setup: Setup) -> Plan:
        """That of a ``setup``, made by this studio or by another that was first: one in a file is as one in memory."""

        def make() -> Plan:
            return self.bench(setup).plan(accuracy=setup.accuracy)

        if self._shared is None:
            return make()
        return Plan.load(_made_once(self._shared / "plans" / Point.of(setup).key, lambda part: make().save(part)))

    def _calibrate(self, bench: Bench, seed: int) -> Factors:
        """The same of factors."""
        if self._shared is None:
            return bench.calibrate(seed)
        place = self._shared / "calibrations" / f"{bench.devices_digest[:_KEY_DIGITS]}-{seed}"
        return load_calibration(_made_once(place, lambda part: bench.calibrate(seed).save(part)))

    def _open(self, setup: Setup) -> Bench:
        path = setup.scene if setup.picture is None else self._copy_with_print(setup.scene, setup.picture)
        parameters: dict[str, Any] = dict(setup.parameters)
        return open_bench(path, setup.variant, setup.camera, setup.projector, setup.outside, **parameters)

    def _copy_with_print(self, scene: str, name: str) -> Path:
        """A copy of a ``scene`` with the picture ``name`` for its print."""
        own = locate(scene, "scenes", "scene.xml")
        if not (own.parent / _PRINT).is_file():
            raise MitsimError(
                f"scene {scene}: has no {_PRINT} beside it, so there is no print to replace; keep its own"
            )
        place = Path(self._folder.name) / own.parent.name / name
        if not place.exists():
            shutil.copytree(own.parent, place)
            io.imsave(place / _PRINT, picture(name), check_contrast=False)
        return place / own.name

    def once(self, kind: str, most: int, key: Hashable, make: Callable[[], Kept]) -> Kept:
        """What is made once while neighbours share it.

        Parameters
        ----------
        kind, most, key
            what it is, how many of its kind are kept, and which of them it is.
        make
            makes it.
        """
        kept = self._kept.setdefault(kind, OrderedDict())
        if key not in kept:
            while len(kept) >= most:
                kept.popitem(last=False)  # before the new one is made: two lights need not fit
            kept[key] = make()
        kept.move_to_end(key)
        found: Kept = kept[key]
        return found

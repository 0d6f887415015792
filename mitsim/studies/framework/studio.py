"""Measurement of points of a study: light, factors and images of setups, kept while neighbouring points share them."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt
from filelock import FileLock
from skimage import data, io
from skimage.transform import resize

from mitsim.acquire.capture import expose
from mitsim.api.bench import Bench, open_bench
from mitsim.bench.request import AUTO
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import locate
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import PatternFamily
from mitsim.light.plan import Plan
from mitsim.metrics import Quality
from mitsim.reconstruct.depth import DepthMap
from mitsim.reconstruct.factors import Factors, load_calibration
from mitsim.reconstruct.misfit import Misfit
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.reconstruct.request import TIKHONOV
from mitsim.reconstruct.solver import Status
from mitsim.report import EQUAL_PEAK, RENDERED
from mitsim.report.lit_scene import LitScene, Unexposed
from mitsim.report.pages import Value
from mitsim.studies.framework.experiment import ASKED, IMAGE, QUICK_IMAGES, TEST_IMAGES, TRUTH, Found, Point, Setup

Kept = TypeVar("Kept")


@dataclass(frozen=True, eq=False)
class Image:
    """One reconstruction: (n, n) reflectance ``image``, its ``quality`` against the truth, and stated ``trust``."""

    image: FloatArray
    quality: Quality
    lam: float
    shots: int
    exposure_s: float
    flags: Mapping[str, Value]
    trust: Mapping[str, float | None] = field(default_factory=dict)
    seconds: float | None = None
    depths_mm: FloatArray | None = None

    @classmethod
    def of(
        cls, frames: Unexposed, seconds: float, lam: float | Literal["auto", "best"] = "auto", binning: int = 1
    ) -> Image:
        solution = frames.solve(seconds, lam, binning)
        quality, shots = frames.lit.quality(solution.image), len(frames.family.shots)
        return cls(solution.image, quality, solution.lam, shots, seconds, flags_of(solution.status))

    def row(self) -> dict[str, Value]:
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
    cause = f", {misfit.reason}" if misfit and misfit.flagged and misfit.cause else ""
    reasons = [f"{each.verdict.value}{cause}" for each in statuses if not each.verdict.good]
    flags = [text for each in statuses for text in each.flags]
    reasons += [text.partition(". ")[0].rstrip(".").replace("; ", ", ") for text in (*flags, *others)]
    return {"flagged": bool(reasons), "reason": "; ".join(dict.fromkeys(reasons))}


class Studio:
    """Benches, their light and their factors, the last few of each; a context that removes its temporary folder.

    Studios with one ``shared`` folder share plans and calibrations.
    """

    def __init__(self, shared: str | None = None) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="mitsim-study-")
        self._shared = Path(self._folder.name) / "shared" if shared is None else Path(shared)
        self._kept: dict[str, dict[Hashable, Any]] = {}

    def __enter__(self) -> Studio:
        return self

    def __exit__(self, *_: object) -> None:
        self._kept.clear()
        self._folder.cleanup()

    def folder(self, name: str) -> Path:
        place = Path(self._folder.name) / "own" / name
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        return place

    def made_once(self, kind: str, name: str, make: Callable[[Path], object]) -> Path:
        """Return a shared file or folder, which ``make`` creates whole or not at all."""
        place = self._shared / kind / name
        place.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(place.with_suffix(".lock")):
            if not place.exists():  # a studio may have been ended while it made it
                part = place.with_suffix(".part")
                shutil.rmtree(part, ignore_errors=True)
                make(part)
                part.rename(place)
        return place

    def bench(self, setup: Setup) -> Bench:
        """Return the bench of a ``setup``.

        MitsimError as :func:`mitsim.open_bench`, and for another print on a scene that has none.
        """

        def make() -> Bench:
            path: Path | str = setup.scene
            if setup.picture is not None:
                own = locate(setup.scene, "scenes", "scene.xml")
                shown = "reflectance.png"
                if not (own.parent / shown).is_file():
                    raise MitsimError(
                        f"scene {setup.scene}: has no {shown} beside it, so there is no print to replace; keep its own"
                    )
                place = Path(self._folder.name) / own.parent.name / setup.picture
                if not place.exists():
                    shutil.copytree(own.parent, place)
                    io.imsave(place / shown, picture(setup.picture), check_contrast=False)
                path = place / own.name
            parameters: dict[str, Any] = dict(setup.parameters)
            return open_bench(path, setup.variant, setup.camera, setup.projector, setup.outside, **parameters)

        return self.once("bench", 3, setup, make)

    def lit_scene(self, setup: Setup) -> LitScene:

        def make() -> LitScene:
            bench, key = self.bench(setup), Point.of(setup).key
            plan = self.made_once("plans", key, lambda part: bench.plan(accuracy=setup.accuracy).save(part))
            return LitScene(bench.light(Plan.load(plan)))

        return self.once("light", 1, setup, make)

    def factors(self, setup: Setup, seed: int) -> Factors:
        bench = self.bench(setup)
        name = f"{bench.devices_digest[:16]}-{seed}"

        def make() -> Factors:
            place = self.made_once("calibrations", name, lambda part: bench.calibrate(seed=seed).save(part))
            return load_calibration(place)

        return self.once("factors", 4, name, make)

    def frames(self, setup: Setup, model: str, patterns: str | PatternFamily, seed: int = 0) -> Unexposed:
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
        focus: Literal["auto", "map", "volume"] | None = None,
        method: str = TIKHONOV,
        depth_range: tuple[float, float] | None = None,
        lam: float | Literal["auto"] = "auto",
    ) -> Image:
        """Return the image of a scene; a rendered one is exposed and reconstructed as a user's own frames are.

        ``model`` is one of :data:`mitsim.report.MODELS`, ``exposure`` one of :data:`mitsim.report.CONVENTIONS` or
        ``DIM``.
        """
        frames = self.frames(setup, model, patterns, seed)
        if model != RENDERED:
            return Image.of(frames, frames.seconds(exposure))
        exposure_s = "auto" if exposure == EQUAL_PEAK else frames.seconds(exposure)
        shots = expose(frames.lit.light, patterns, seed=seed, exposure=exposure_s)
        found = reconstruct(
            shots, self.factors(setup, seed), lam=lam, focus=focus, method=method, depth_range=depth_range
        )
        misfit, uncertainty = found.misfit, found.uncertainty
        trust = {
            "misfit": misfit.unexplained if misfit else None,
            "chi_square": misfit.chi_square if misfit else None,
            "uncertainty": None if uncertainty is None else float(np.sqrt(np.square(uncertainty).mean())),
        }
        count, quality = len(frames.family.shots), frames.lit.quality(found.image)
        flags = flags_of(found.status, misfit=misfit)
        depths, seconds = found.focus.mm if isinstance(found.focus, DepthMap) else None, sum(found.seconds.values())
        return Image(found.image, quality, found.lam, count, shots.exposure_s, flags, trust, seconds, depths)

    def once(self, kind: str, most: int, key: Hashable, make: Callable[[], Kept]) -> Kept:
        """Return what ``make`` returned for the ``key``; the ``most`` last used of a ``kind`` are kept."""
        kept = self._kept.setdefault(kind, {})
        if key not in kept:
            while len(kept) >= most:
                del kept[next(iter(kept))]  # before the new one is made: two lights need not fit
            kept[key] = make()
        found: Kept = kept.pop(key)
        kept[key] = found  # as the last
        return found


# -------- Images to print


PRINT_MM = 128.0
SIDE = 512


def picture(name: str) -> npt.NDArray[np.uint8]:
    """Return the (512, 512) eight-bit reflectance of the test image ``name``: its middle square, grey.

    ``bars 0.26`` has bars of 0.26 line pairs per mm of the print, vertical on the left, horizontal on the right.
    MitsimError for another name.
    """
    kind, _, frequency = name.partition(" ")
    if kind == "bars" and frequency:  # each texel is the mean of the bars over it
        edges = np.arange(SIDE + 1) * PRINT_MM / SIDE * float(frequency)
        white = np.floor(edges) / 2 + np.minimum(edges % 1, 0.5)  # integral of the bars, in periods
        across = np.broadcast_to(np.diff(white) / np.diff(edges), (SIDE, SIDE))
        grey = np.concatenate([across[:, : SIDE // 2], across.T[:, SIDE // 2 :]], axis=1)
    elif name in TEST_IMAGES:
        image = np.asarray(getattr(data, name)(), dtype=np.float64)
        grey = image.mean(axis=2) if image.ndim == 3 else image
        side = min(grey.shape)
        top, left = ((size - side) // 2 for size in grey.shape)
        square = resize(grey[top : top + side, left : left + side], (SIDE, SIDE), anti_aliasing=True)
        grey = (square - square.min()) / (square.max() - square.min())
    else:
        raise MitsimError(f"picture {name!r}: use {', '.join((*TEST_IMAGES, 'bars PAIRS_A_MM'))}")
    # Reflectances of black and white print, as on the shipped scenes.
    return np.asarray(np.rint(255 * (0.05 + (0.90 - 0.05) * grey)), dtype=np.uint8)


# -------- The measurement of one point


def finding(studio: Studio, point: Point, image: FloatArray | None = None, **measured: Value) -> Found:
    kept = image is not None and point.setup.picture in (*QUICK_IMAGES, None)
    arrays = image_arrays(image, studio.lit_scene(point.setup).truth) if kept and image is not None else {}
    return Found((point.row(**measured),), arrays)


def image_arrays(image: FloatArray, truth: FloatArray) -> dict[str, FloatArray]:
    return single_precision({IMAGE: image, TRUTH: truth})


def single_precision(arrays: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    return {name: array.astype("float32") for name, array in arrays.items()}


def measure_image(studio: Studio, point: Point, shown: Collection[str] | None = None) -> Found:
    """Return the quality of the image at a point; images are kept of the patterns ``shown``, or of all."""
    values = dict(point.values)
    patterns, exposure = str(values["patterns"]), str(values.get("exposure", EQUAL_PEAK))
    asked: dict[str, Any] = {"method": values.get("method", TIKHONOV)}
    asked |= {"lam": float(str(values[ASKED]))} if values.get(ASKED, AUTO) != AUTO else {}
    image = studio.image(point.setup, str(values["model"]), patterns, int(point["seed"]), exposure, **asked)
    measured = image.row() | ({"seconds": image.seconds} if "method" in values else {})
    return finding(studio, point, image.image if shown is None or patterns in shown else None, **measured)

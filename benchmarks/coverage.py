"""How often the stated uncertainty covers the truth: a new calibration and new noise each session, by print and family.

    python benchmarks/coverage.py RESULT.json --closed-form [--seeds 3] [--families ...] [--fractions ...]
    python benchmarks/coverage.py RESULT.json [--sessions 200] [--places 10] [--prints ...] [--families ...] [--n 16]

Shipped prints, and shades of noise, lie 400 mm before a small camera of 64 x 64 sensor and n x n scene pixels. What
print within a pixel does is the same in all sessions of a print, so each session takes the next of ``--places`` ways to
lay it: a part of 7/8 anywhere, turned. Light of board and prints is traced once. RESULT.json holds, by print and
family, the part of all pixels of all sessions that are within 1.96 standard uncertainties of the truth, and the rms of
error over uncertainty; an interrupted run goes on where it was. 200 sessions of four prints and five families take 12
minutes on two cores.

``--closed-form`` forms frames of an ideal camera in numpy (tests/ideal_sessions.py), so that many scenes, cameras,
families and parts of the full well can be tried: RESULT.json then holds, for each, the part of the pixels inside, and
the rms that is stated and that the image is off by, all seeds together; it ends with a table of images that state
their uncertainty as it is, of those that say it is extrapolated, and of flagged ones. 1056 rows of a seed take 10
minutes.

``--regimes 200`` counts 200 images of an ideal camera in each of six regimes of light and patterns: the part of all
pixels within the 68, 90 and 95 % intervals, and stated over actual error of each image.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter
from skimage import data, io
from skimage.transform import resize

from mitsim.acquire.capture import expose
from mitsim.api.bench import Bench, open_bench
from mitsim.calibrate.board_session import Session
from mitsim.calibrate.calibrate import estimate
from mitsim.calibrate.lit_session import LitSession
from mitsim.core.job import Job
from mitsim.core.manifests import CalibrationManifest
from mitsim.devices.camera import centred_edges
from mitsim.devices.session import load_recipe
from mitsim.light.light import SampledLight
from mitsim.optics.shadow import scene_factor
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import reconstruct

ROOT = Path(__file__).parent.parent
PRINTS = ("shades", "photograph", "colour_chart", "resolution_target")
FAMILIES = ("uniform", "dots:4", "dots:7", "hadamard:4", "random:4")
EXPOSURE = 0.1
"""Part of the full well, so that noise weighs as much as what else is wrong."""


def picture(name: str, place: int) -> np.ndarray:
    """Eight-bit reflectances of a print, laid the ``place``-th way; the first is the print as it is."""
    rng = np.random.default_rng(4 + place)
    if name == "shades":
        shades = gaussian_filter(rng.standard_normal((64, 64)), 8, mode="nearest")
        return 128 + 90 * shades / np.abs(shades).max()
    values = io.imread(ROOT / "scenes" / name / "reflectance.png")
    values = values if values.ndim == 2 else values[..., :3].mean(axis=2)
    if place == 0:
        return values
    side = 7 * len(values) // 8
    row, column = rng.integers(0, len(values) - side + 1, 2)
    return np.rot90(values[row : row + side, column : column + side], rng.integers(4))


def opened(name: str, place: int, n: int, folder: Path) -> Bench:
    """The small camera of the tests before a print."""
    sys.path.insert(0, str(ROOT))
    from tests.conftest import write_small_scene

    return open_bench(
        write_small_scene(folder / f"{name}{place}", name, reflectance=picture(name, place), n=n, sheet_z=400)
    )


def calibrated(board: LitSession, seed: int) -> Factors:
    """Factors of a session with noise of its own."""
    session = board.session
    noisy, _ = estimate(replace(board, session=replace(session, seed=1000 + seed)), Job())
    reflectance = session.recipe.board_reflectance
    camera = session.bench.identity()
    return Factors.of(noisy, CalibrationManifest(camera=camera, centre=session.centre, board_reflectance=reflectance))


def session(light: SampledLight, family: str, factors: Factors, seed: int) -> dict[str, float]:
    """What one image is worth: part of its pixels inside, mean square of error over uncertainty, and what is stated."""
    shots = expose(light, family, seed=seed, exposure_fraction=EXPOSURE)
    image = reconstruct(shots, factors)
    assert image.uncertainty is not None and image.uncertainties is not None and shots.truth is not None
    error = (image.image - shots.truth) / image.uncertainty
    return {
        "inside": float(np.mean(np.abs(error) < 1.96)),
        "square": float(np.square(error).mean()),
        "error": float(np.sqrt(np.mean(np.square(image.image - shots.truth)))),
        "explained": float(not (image.misfit and image.misfit.flagged)),
        **image.uncertainties.budget,
    }


def put_together(sessions: list[dict[str, float]]) -> dict[str, float]:
    """Means over all sessions; rms of error over uncertainty."""
    mean = {name: float(np.mean([one[name] for one in sessions])) for name in sessions[0]}
    return {"sessions": len(sessions), "rms": mean.pop("square") ** 0.5, **mean}


FRACTIONS = (0.003, 0.008, 0.02, 0.05)
FULL_WELL, CELLS = 1e4, 64


def closed_form_scenes() -> dict[str, np.ndarray]:
    """(CELLS, CELLS) reflectances of kinds that lose detail differently."""
    rng = np.random.default_rng(5)

    def of(picture: np.ndarray) -> np.ndarray:
        grey = picture.mean(axis=2) if picture.ndim == 3 else picture
        side = min(grey.shape)
        return resize(grey[:side, :side] / 255, (CELLS, CELLS), anti_aliasing=True)

    text, stars = np.full((CELLS, CELLS), 0.92), np.full((CELLS, CELLS), 0.02)
    for row in range(3, CELLS - 4, 7):
        column = 3
        while column < CELLS - 6:
            width = int(rng.integers(1, 4))
            text[row : row + 4, column : column + width][rng.random((4, width)) < 0.5] = 0.05
            column += width + 1
    stars[rng.integers(0, CELLS, 40), rng.integers(0, CELLS, 40)] = 0.1 + 0.9 * rng.random(40)
    shades = gaussian_filter(rng.standard_normal((CELLS, CELLS)), 8)
    bars, card = np.full((CELLS, CELLS), 0.9), np.full((CELLS, CELLS), 0.15)
    for row, width in enumerate((1, 2, 3, 5, 8)):
        bars[6 + 11 * row : 14 + 11 * row, 4:60][:, (np.arange(56) // width) % 2 == 0] = 0.1
    card[10:50, 14:56], card[20:30, 20:34] = 0.8, 0.3
    return {
        "photograph": of(data.camera()),
        "cat": of(data.chelsea()),
        "coffee": of(data.coffee()),
        "page": of(data.page()),
        "text": text,
        "stars": stars,
        "checker": 0.1 + 0.8 * ((np.indices((CELLS, CELLS)) // 5).sum(axis=0) % 2),
        "grey": np.full((CELLS, CELLS), 0.5),
        "bars": bars,
        "card": card,
        "shades": 0.5 + 0.35 * shades / np.abs(shades).max(),
    }


REGIMES = {
    "bright, uniform": ("uniform", 0.5),
    "dim, uniform": ("uniform", 0.02),
    "bright, dots": ("dots:7", 0.5),
    "dim, dots": ("dots:4", 0.02),
    "bright, Hadamard": ("hadamard:4", 0.5),
    "dim, random": ("random:4", 0.02),
}
"""Patterns and part of the full well of each regime."""
INTERVALS = {0.68: 0.9945, 0.90: 1.6449, 0.95: 1.9600}
"""Standard deviations of normal intervals."""


def count_regimes(result: Path, images: int) -> None:
    """Write and print the coverage of ``images`` in each regime; scenes in turn, with a new calibration and noise."""
    sys.path.insert(0, str(ROOT))
    from tests.ideal_sessions import Bench as Ideal
    from tests.ideal_sessions import shadow

    camera, scenes = Ideal(shadow(n=CELLS), shadow(n=CELLS)), list(closed_form_scenes().values())
    rows = {}
    for name, (family, fraction) in REGIMES.items():
        ratios, within, kinds = [], [], []
        for seed in range(images):
            truth = np.rot90(scenes[seed % len(scenes)], seed // len(scenes))
            shots = replace(camera, peak=fraction * FULL_WELL).run(family, truth, 5000 + seed)
            image = reconstruct(shots, camera.calibrated(5000 + seed))
            assert image.uncertainty is not None and image.uncertainties is not None
            deviations = np.abs(image.image - truth) / image.uncertainty
            within.append([float(np.mean(deviations < most)) for most in INTERVALS.values()])
            ratios.append(float(np.sqrt(np.square(image.uncertainty).mean() / np.square(image.image - truth).mean())))
            kinds.append(
                "flagged" if not image.ok else "extrapolated" if image.uncertainties.extrapolated else "stated"
            )
        for kind in ("stated", "extrapolated", "flagged"):
            chosen = [index for index, each in enumerate(kinds) if each == kind]
            if chosen:
                own, inside = np.array(ratios)[chosen], np.mean([within[index] for index in chosen], axis=0)
                rows[f"{name}, {kind}"] = {
                    "images": len(chosen),
                    **{f"{part:.0%}": float(value) for part, value in zip(INTERVALS, inside, strict=True)},
                    "least": float(own.min()),
                    "median": float(np.median(own)),
                    "most": float(own.max()),
                    "error above twice the stated": int(np.sum(own < 0.5)),
                }
                print(f"{name}, {kind}", *(f"{value:.3g}" for value in rows[f"{name}, {kind}"].values()), flush=True)
        result.write_text(json.dumps(rows, indent=1), encoding="utf-8")


def closed_form(result: Path, seeds: int, families: list[str], fractions: list[float]) -> None:
    """The table over scenes, cameras, families and parts of the full well."""
    sys.path.insert(0, str(ROOT))
    from tests.ideal_sessions import PITCH, PIXELS, shadow
    from tests.ideal_sessions import Bench as Ideal

    @dataclass(frozen=True, eq=False)
    class FlatCam(Ideal):
        """A mask (1 + m m^T) / 2, whose constant term is centred away."""

        def light(self, shown: np.ndarray) -> np.ndarray:
            return np.maximum(shown.sum() * np.abs(self.left).max() ** 2 + super().light(shown), 0.0) / 2

        def calibrated(self, seed: int, error: float = 2e-3) -> Factors:
            found = super().calibrated(seed, error)
            manifest = found.manifest.model_copy(update={"centre": True})
            return Factors(found.left / np.sqrt(2), found.right / np.sqrt(2), manifest, found.status)

    def cast(profile: np.ndarray) -> np.ndarray:
        """Shadow of a mask of 60 um features, where :func:`shadow` has that of the MLS."""
        edges = centred_edges(PIXELS, PITCH), centred_edges(CELLS, 120 / CELLS)
        return scene_factor(profile, 0.06, *edges, 2.0, 400.0)

    side = shadow(n=CELLS)
    residues = np.isin(np.arange(101), np.square(np.arange(1, 101)) % 101).astype(float)
    cameras = {
        "separable": Ideal(side, side),
        "FlatCam": FlatCam(*2 * [2 * side - side.max()]),
        "MURA": FlatCam(*2 * [2 * cast(residues) - cast(np.ones(101))]),
    }
    rows = json.loads(result.read_text())["rows"] if result.is_file() else []
    done = {(row["camera"], row["patterns"], row["scene"], row["fraction"]) for row in rows}
    for (name, camera), family, (scene, truth), fraction in itertools.product(
        cameras.items(), families, closed_form_scenes().items(), fractions
    ):
        if (name, family, scene, fraction) in done:
            continue
        found = []
        for seed in range(seeds):
            shots = replace(camera, peak=fraction * FULL_WELL).run(family, truth, seed)
            image = reconstruct(shots, camera.calibrated(seed))
            assert image.uncertainty is not None and image.uncertainties is not None
            error = image.image - truth
            extrapolated = image.uncertainties.extrapolated
            squares = (float(np.square(each).mean()) for each in (image.uncertainty, error))
            found.append((float(np.mean(np.abs(error) < 1.96 * image.uncertainty)), *squares, extrapolated, image.ok))
        inside, stated, actual, extrapolated, good = np.mean(found, axis=0).tolist()
        rows.append(
            {
                "camera": name,
                "patterns": family,
                "scene": scene,
                "fraction": fraction,
                "inside": inside,
                "stated": stated**0.5,
                "error": actual**0.5,
                "ratio": (stated / actual) ** 0.5,
                "extrapolated": extrapolated,
                "unflagged": good,
            }
        )
        result.write_text(json.dumps({"seeds": seeds, "rows": rows}, indent=1), encoding="utf-8")
        print(*(f"{value:.3g}" if isinstance(value, float) else value for value in rows[-1].values()), flush=True)
    for camera in (*cameras, "all"):
        of_camera = [row for row in rows if camera in (row["camera"], "all")]
        for kind, chosen in {
            "as stated": [row for row in of_camera if row["unflagged"] == 1 and row["extrapolated"] == 0],
            "extrapolated": [row for row in of_camera if row["unflagged"] == 1 and row["extrapolated"] > 0],
            "flagged": [row for row in of_camera if row["unflagged"] < 1],
        }.items():
            if chosen:
                print(f"{camera:10s} {kind:13s}", together(chosen))


def together(rows: list[dict[str, float]]) -> str:
    """How well images of ``rows`` are covered, and stated over actual error."""
    inside, ratio = (np.array([row[name] for row in rows]) for name in ("inside", "ratio"))
    least, low, middle, high, most = np.quantile(ratio, [0, 0.05, 0.5, 0.95, 1])
    return (
        f"{len(rows):4d} images: 93 to 97 % inside in {np.mean(np.abs(inside - 0.95) <= 0.02):.0%}, 90 % and more in "
        f"{np.mean(inside >= 0.9):.0%}, median {np.median(inside):.1%}, least {inside.min():.0%}; stated over error "
        f"{least:.2f} {low:.2f} {middle:.2f} {high:.2f} {most:.2f} (least, 5 %, median, 95 %, most), above 2 in "
        f"{np.sum(ratio > 2)}, below 0.5 in {np.sum(ratio < 0.5)}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path)
    parser.add_argument("--sessions", type=int, default=200)
    parser.add_argument("--prints", nargs="+", default=PRINTS)
    parser.add_argument("--families", nargs="+", default=FAMILIES)
    parser.add_argument("--places", type=int, default=10)
    parser.add_argument("--n", type=int, default=16)
    parser.add_argument("--closed-form", action="store_true", help="scenes, cameras and exposures in numpy")
    parser.add_argument("--seeds", type=int, default=3, help="of --closed-form")
    parser.add_argument("--fractions", nargs="+", type=float, default=FRACTIONS, help="of --closed-form")
    parser.add_argument("--regimes", type=int, help="images in each regime, of an ideal camera")
    options = parser.parse_args()
    if options.regimes:
        count_regimes(options.result, options.regimes)
        return
    if options.closed_form:
        closed_form(options.result, options.seeds, list(options.families), options.fractions)
        return
    done = json.loads(options.result.read_text())["sessions"] if options.result.is_file() else {}
    with tempfile.TemporaryDirectory() as folder:
        kinds = [(name, place) for name in options.prints for place in range(options.places)]
        benches = {kind: opened(*kind, options.n, Path(folder)) for kind in kinds}
        lights = {kind: bench.light(options.families[-1], accuracy=3e-4) for kind, bench in benches.items()}
        camera = Session(benches[kinds[0]], load_recipe(), 0)
        board = LitSession.of(camera, camera.trace(camera.plan(2e-4, Job()), Job()), Job())
        for seed in range(options.sessions):
            factors: Factors | None = None
            for name in options.prints:
                light = lights[name, seed % options.places]
                for family in options.families:
                    found = done.setdefault(f"{name} {family}", [])
                    if len(found) == seed:
                        factors = factors or calibrated(board, seed)
                        found.append(session(light, family, factors, seed))
            if factors and (seed % 10 == 9 or seed == options.sessions - 1):
                together = {key: put_together(sessions) for key, sessions in done.items()}
                options.result.write_text(json.dumps({"together": together, "sessions": done}), encoding="utf-8")
                print(f"{seed + 1} sessions", flush=True)
    for key, one in together.items():
        print(f"{key:28s} {one['inside']:.1%} inside, rms {one['rms']:.2f}, {one['sessions']} sessions", flush=True)


if __name__ == "__main__":
    main()

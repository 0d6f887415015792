"""Decibels that the automatic lambda loses against the best one, on shipped scenes and on others.

    python benchmarks/lambda_losses.py RESULT.json [--work FOLDER] [--scenes ...] [--families ...] [--seeds 0 1 2 3]
    python benchmarks/lambda_losses.py RESULT.json --held-out [--work FOLDER]

Light of each scene is traced once (accuracy 1e-3), exposed for every family and seed, and reconstructed with a
calibration of the same seed. PSNR of the image is taken at 113 lambdas from 1e-14 to 1 of the largest sigma^2 ("best"
is the highest of these), at the automatic lambda, and at that of version 0.4.0, which took the noise for white and
every frame for explained. Losses are put together by what `mitsim reconstruct` says of the frames: explained by the
model or not. ``--held-out`` takes scenes, cameras and families that the rule was not chosen on.

Runs and calibrations are kept in FOLDER, results in RESULT.json: an interrupted benchmark goes on where it was. The
192 cases take 60 minutes and 20 GB on two cores.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from skimage import data, io
from skimage.transform import resize

import mitsim
from mitsim.metrics import psnr
from mitsim.reconstruct.accumulation import accumulate
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.reconstruct.solver import automatic_lambda

SCENES = (
    "photograph", "colour_chart", "resolution_target", "keystone", "lamp_bench", "cards", "corner", "gift_card",
    "metal_blade", "mirror", "compact_disc", "cookie_bag",
)  # fmt: skip
FAMILIES = ("uniform", "dots:4", "dots:7", "hadamard:8")
LAMBDAS = np.logspace(-14, 0, 113)


@dataclass(frozen=True)
class Subject:
    """A scene with its parameters, and the one whose calibration serves it (itself: its own)."""

    name: str
    scene: str
    calibration: str
    parameters: dict[str, str] = field(default_factory=dict)
    picture: str | None = None
    exposure_fraction: float | None = None
    families: tuple[str, ...] = FAMILIES


SHIPPED = tuple(Subject(name, name, "keystone" if name == "keystone" else "photograph") for name in SCENES)
_MORE = ("uniform", "dots:2", "dots:3", "dots:5", "hadamard:4", "random:4")
HELD_OUT = (
    Subject("coins", "photograph", "photograph", picture="coins", families=_MORE),
    Subject("page", "photograph", "photograph", picture="page", families=_MORE),
    Subject("bricks", "photograph", "photograph", picture="brick", families=_MORE),
    Subject("white noise", "photograph", "photograph", picture="noise", families=_MORE),
    Subject("squares", "photograph", "photograph", picture="squares", families=_MORE),
    Subject("moon, dim", "photograph", "photograph", picture="moon", exposure_fraction=0.05, families=_MORE),
    Subject("sheet at 398", "photograph", "photograph", {"sheet_z": "398"}, "cat", families=_MORE),
    Subject("sheet at 390", "photograph", "photograph", {"sheet_z": "390"}, "cat", families=_MORE),
    Subject("card, rough", "gift_card", "photograph", {"roughness": "0.3", "tilt_left": "8"}, families=_MORE),
    Subject("cards, apart", "cards", "photograph", {"front_z": "330", "back_z": "440"}, families=_MORE),
    Subject("corner, dark", "corner", "photograph", {"albedo": "0.2"}, families=_MORE),
    Subject("FlatCam", "photograph", "FlatCam", {"mask": "flatcam"}, "cat", families=_MORE),
    Subject("mask at 0.75", "photograph", "mask at 0.75", {"mask_distance": "0.75"}, "coins", families=_MORE),
)


def picture(name: str) -> np.ndarray:
    """(512, 512, 3) eight-bit picture to print on a sheet."""
    if name == "noise":
        grey = np.random.default_rng(1).random((128, 128)).repeat(4, axis=0).repeat(4, axis=1)
    elif name == "squares":
        grey = 0.1 + 0.8 * (np.indices((512, 512)) // 48).sum(axis=0) % 2
    else:
        image = np.asarray({"cat": data.chelsea}.get(name, getattr(data, name, None))())
        image = image.mean(axis=2) if image.ndim == 3 else image
        side = min(image.shape)
        grey = resize(image[:side, :side] / 255, (512, 512), anti_aliasing=True)
    return np.repeat(np.rint(255 * np.clip(grey, 0, 1)).astype(np.uint8)[:, :, None], 3, axis=2)


def opened(subject: Subject, work: Path) -> mitsim.Bench:
    """The subject's bench; one with a picture of its own is a copy of the shipped scene with another print."""
    if subject.picture is None:
        return mitsim.open_bench(subject.scene, **subject.parameters)
    place = work / subject.name / "scene"
    if not place.exists():
        shutil.copytree(Path(__file__).parent.parent / "scenes" / subject.scene, place)
        io.imsave(place / "reflectance.png", picture(subject.picture), check_contrast=False)
    return mitsim.open_bench(place / "scene.xml", **subject.parameters)


def captures(
    subject: Subject, families: tuple[str, ...], seeds: list[int], work: Path
) -> Iterator[tuple[str, int, mitsim.Capture]]:
    """Every capture of a subject, made where it is not in ``work`` yet."""
    light = None
    (work / subject.name).mkdir(parents=True, exist_ok=True)
    for family in families:
        for seed in seeds:
            folder = work / subject.name / f"{family.replace(':', '')}-{seed}"
            if not (folder / "manifest.json").is_file():
                light = light or opened(subject, work).light(families[-1], accuracy=1e-3)
                more = {} if subject.exposure_fraction is None else {"exposure_fraction": subject.exposure_fraction}
                light.expose(family, output=folder, seed=seed, **more)
            yield family, seed, mitsim.load_run(folder)


def calibration(subject: Subject, seed: int, work: Path) -> mitsim.Factors:
    """The factors that serve a subject, made where they are not in ``work`` yet."""
    folder = work / subject.calibration / f"cal-{seed}"
    if not (folder / "manifest.json").is_file():
        folder.parent.mkdir(parents=True, exist_ok=True)
        owner = next(one for one in (*SHIPPED, *HELD_OUT) if subject.calibration in (one.name, one.calibration))
        opened(owner, work).calibrate(seed=seed, output=folder)
    return mitsim.load_calibration(folder)


def case(shots: mitsim.Capture, factors: mitsim.Factors) -> dict[str, object]:
    """PSNR at the best lambda, at the automatic one and at that of version 0.4.0."""
    result = reconstruct(shots, factors)
    sums = accumulate(shots, factors)
    problem = sums.prepared.problem(sums.frames)

    def quality(lam: float) -> float:
        return psnr(sums.prepared.solve(sums.frames, lam).image, shots.truth)

    curve = [quality(problem.scale * relative) for relative in LAMBDAS]
    lambdas = {"new": result.lam, "old": automatic_lambda(replace(problem, halves=None))}
    best = max(curve)
    return {
        "best": best,
        "lambda_best": float(LAMBDAS[int(np.argmax(curve))]),
        **{f"lambda_{rule}": lam / problem.scale for rule, lam in lambdas.items()},
        **{f"loss_{rule}": best - quality(lam) for rule, lam in lambdas.items()},
        "explained": not (result.misfit and result.misfit.flagged) and factors.ok,
    }


def put_together(cases: dict[str, dict[str, object]]) -> dict[str, object]:
    """Median and worst loss of both rules, over all cases and by what is said of the frames."""
    groups = {
        "all": list(cases.values()),
        "explained": [one for one in cases.values() if one["explained"]],
        "not explained": [one for one in cases.values() if not one["explained"]],
    }
    return {
        name: {
            "cases": len(group),
            **{
                f"{rule}_{what}": float(f([one[f"loss_{rule}"] for one in group]))
                for rule in ("old", "new")
                for what, f in (("median", np.median), ("worst", np.max))
            },
        }
        for name, group in groups.items()
        if group
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path)
    parser.add_argument("--work", type=Path, default=Path("lambda_runs"), help="folder of runs and calibrations")
    parser.add_argument("--held-out", action="store_true", help="scenes that the rule was not chosen on")
    parser.add_argument("--scenes", nargs="+")
    parser.add_argument("--families", nargs="+")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3])
    options = parser.parse_args()
    cases = json.loads(options.result.read_text())["cases"] if options.result.is_file() else {}
    for subject in HELD_OUT if options.held_out else SHIPPED:
        if options.scenes and subject.name not in options.scenes:
            continue
        families = tuple(options.families or subject.families)
        todo = [f for f in families if any(f"{subject.name} {f} {seed}" not in cases for seed in options.seeds)]
        for family, seed, shots in captures(subject, tuple(todo), options.seeds, options.work):
            key = f"{subject.name} {family} {seed}"
            if key in cases:
                continue
            cases[key] = case(shots, calibration(subject, seed, options.work))
            print(
                f"{key:32s} best {cases[key]['best']:6.2f} dB, old rule loses {cases[key]['loss_old']:6.2f}, "
                f"new {cases[key]['loss_new']:6.2f}{'' if cases[key]['explained'] else '  not explained'}",
                flush=True,
            )
            text = json.dumps({"together": put_together(cases), "cases": cases}, indent=1)
            options.result.write_text(text, encoding="utf-8")
    print(json.dumps(put_together(cases), indent=1))


if __name__ == "__main__":
    main()

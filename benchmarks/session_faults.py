"""How often a calibration session's faults are named, and good sessions flagged; actual over stated factor error.

    python benchmarks/session_faults.py RESULT.json [--sessions 20] [--clean 200] [--faults ...] [--seed 0] [--n 64 128]

Sessions of ideal cameras in numpy (a mask's geometric shadow, light that falls off, Poisson and read noise, rounding),
written as files and read by :func:`mitsim.reconstruct.captured_session.calibrate_frames`. Each has a camera of its own
by its seed: 64 or 128 projector pixels, a separable, FlatCam or MURA mask, sensor, read noise, ambient light, repeats,
and an exposure that leaves 1 to 10 times the anchor calibration's factor error, ``NOISE``. ``--sessions`` of each fault
are taken, and ``--clean`` of none. RESULT.json has counts with their binomial errors, and quantiles of the actual
factor error over the stated one, after what is wrong is left out. 200 clean and 20 of each of 10 faults take ten
minutes."""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas
from mitsim.devices.camera import centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.devices.patterns import stripe_signs
from mitsim.devices.session import SIDES, UNIFORM, Half, Side, halves_in_order
from mitsim.optics.shadow import scene_factor
from mitsim.reconstruct.captured_session import calibrate_frames
from mitsim.reconstruct.estimate_factors import predicted_error
from mitsim.reconstruct.factors import Factors

NOISE = 2.3e-3
"""Relative error of both factors, in quadrature, that the shipped session leaves with the anchor camera."""
DRIFT, FLICKER = 0.05, 0.005
BLACK, DARK, CODES, BRIGHTEST = 200.0, 20.0, 2**16, 5e4
"""DN, electrons a frame, codes, and DN of the brightest pixel at most."""
NAMES = {"half exposure": "dim"}
"""What the calibration calls a fault of another name."""
SHAPES = ("half lost", "shifted", "clipped")
"""Faults of a frame's shape, which are `wrong` where no pair foretells it."""
FIRST = False
"""Whether the uniform pattern is the one that is wrong."""
FRAME_FAULTS = ("black", "half lost", "half exposure", "repeated", "shifted", "clipped")
FAULTS = (*FRAME_FAULTS, "exchanged", "swapped", "drift", "flicker")


@dataclass(frozen=True)
class Camera:
    """An ideal camera before a white board, by its ``seed``, with ``n`` projector pixels."""

    seed: int
    n: int
    uniform: bool = False

    @cached_property
    def rng(self) -> np.random.Generator:
        """What it is like."""
        return np.random.default_rng([self.seed, self.n])

    @cached_property
    def traits(self) -> dict[str, Any]:
        """What differs from camera to camera."""
        rng = self.rng
        return {
            "mask": str(rng.choice(["separable", "separable", "flatcam", "mura"])),
            "shape": (int(rng.integers(120, 260)), int(rng.integers(120, 260))),
            "view_mm": float(rng.uniform(3.5, 6.0)),
            "gap_mm": float(rng.uniform(1.5, 3.0)),
            "feature_mm": float(rng.uniform(0.05, 0.1)),
            "read_noise_e": float(rng.uniform(2, 15)),
            "ambient": 0.0 if self.uniform else float(rng.uniform(0, 0.2)),
            "repeats": int(rng.choice([1, 1, 1, 2])),
            "level": float(np.exp(rng.uniform(0, np.log(10)))),
        }

    @property
    def centre(self) -> bool:
        return bool(self.traits["mask"] != "separable")

    def _code(self) -> np.ndarray:
        if self.traits["mask"] == "mura":
            prime = 251
            squares = {k * k % prime for k in range(1, prime)}
            return np.array([1.0 if k in squares else -1.0 for k in range(prime)])
        mask = mls_mask("separable")
        return np.asarray(mask.terms[0][1])

    @cached_property
    def factors(self) -> tuple[np.ndarray, np.ndarray]:
        """Exact factors, of unit scale; of FlatCam and MURA masks those of the +-1 code."""
        traits = self.traits
        found = []
        for pixels in traits["shape"]:
            code = self._code()
            if traits["mask"] == "flatcam":
                code = 2 * code - 1
            edges = centred_edges(pixels, traits["view_mm"] / pixels)
            scene = centred_edges(self.n, 120 / self.n)
            factor = scene_factor(code, traits["feature_mm"], edges, scene, traits["gap_mm"], 400.0)
            falloff = 1 - 0.02 * np.square(np.linspace(-1, 1, self.n))
            found.append(factor * falloff / np.abs(factor).max())
        return found[0], found[1]

    def light(self, shown: np.ndarray) -> np.ndarray:
        """(rows, columns) light of a pattern ``shown`` (n, n), of any scale."""
        left, right = self.factors
        frame = left @ shown @ right.T
        if self.centre:
            frame = frame + shown.sum() * np.ones_like(frame)
            frame = frame / 2
        return np.asarray(frame)

    @cached_property
    def scale(self) -> float:
        """Electrons of a unit of light at which factors have the error that is wanted."""
        uniform = self.light(np.ones((self.n, self.n)))
        sides = self.exact(1.0)
        wanted, scale = self.traits["level"] * NOISE, 1.0
        vectors = [side.sum(axis=1) for side in sides]
        count = stripe_signs(self.n).shape[1]

        def error(scale: float) -> float:
            still = 2 * (self.traits["read_noise_e"] ** 2 + DARK + 1 / 12)
            light = (1 + 2 * self.traits["ambient"]) * uniform.mean() * scale
            noise = np.sqrt((light + still) / self.traits["repeats"]) / scale
            each = [
                predicted_error(side, noise, float(np.linalg.norm(vector)), count)
                for side, vector in zip(sides, reversed(vectors), strict=True)
            ]
            return float(np.hypot(each[0], each[1]))

        for _ in range(60):
            scale *= (error(scale) / wanted) ** 1.5
        return scale

    def exact(self, scale: float) -> tuple[np.ndarray, np.ndarray]:
        """Factors as a calibration has them: balanced, and centred where frames are."""
        left, right = self.factors
        if self.centre:
            left, right = left - left.mean(axis=0), right - right.mean(axis=0)
            scale = scale / 2
        norms = [np.linalg.norm(side.sum(axis=1)) for side in (left, right)]
        balance = np.sqrt(norms[1] / norms[0])
        return left * balance * np.sqrt(scale), right / balance * np.sqrt(scale)


@dataclass(frozen=True)
class Fault:
    """What is wrong with a session, by its ``kind`` and ``half``; ``other`` is the index of a second pattern."""

    kind: str
    half: Half
    other: int
    part: float
    uniform: bool

    @classmethod
    def of(cls, kind: str, count: int, rng: np.random.Generator, uniform: bool) -> Fault:
        """A fault of a ``kind`` at random; what exchanges or swaps patterns leaves the uniform one alone."""
        first, other = (int(number) for number in rng.choice(np.arange(1, count), 2, replace=False))
        if FIRST and kind in FRAME_FAULTS:
            first = 0
        side: Side = SIDES[int(rng.integers(2))]
        return cls(
            kind,
            (side, first, 1 if uniform else int(rng.choice([1, -1]))),
            other,
            float(rng.uniform(0.3, 0.7)),
            uniform,
        )

    def named(self, factors: Factors) -> bool:
        """Whether a calibration names it, and nothing else."""
        faults, lamp = factors.manifest.result["faults"], factors.manifest.result["lamp"]
        if self.kind in ("drift", "flicker"):
            return not faults and lamp is not None and bool(lamp[self.kind])
        if len(faults) != 1 or lamp is not None:
            return False
        fault, (side, index, sign) = faults[0], self.half
        kinds = (NAMES.get(self.kind, self.kind), *(["wrong"] if self.uniform and self.kind in SHAPES else []))
        if fault["side"] != side or fault["kind"] not in kinds:
            return False
        if self.kind == "swapped":
            return {fault["index"], fault["other"][1]} == {index, self.other}
        return bool(fault["index"] == index and fault["sign"] in (sign, None))


def session(camera: Camera, folder: Path, fault: Fault | None) -> Path:
    """Files of a session with a ``fault``, in a new ``folder``."""
    rng, signs, traits = np.random.default_rng([camera.seed, 7]), stripe_signs(camera.n), camera.traits
    folder.mkdir()
    order = halves_in_order(signs.shape[1], not camera.uniform)
    uniform = camera.light(np.ones((camera.n, camera.n))) * camera.scale
    still = traits["ambient"] * uniform.mean() + DARK
    gain = min(1.0, BRIGHTEST / float(uniform.max() + still))
    read: dict[Half, np.ndarray] = {}

    def shown(half: Half) -> np.ndarray:
        side, index, sign = half
        line = np.ones(camera.n) if sign == UNIFORM else (1 + sign * signs[:, index].astype(float)) / 2
        across = np.ones(camera.n)
        lit = np.outer(line, across) if side == SIDES[0] else np.outer(across, line)
        return camera.light(lit) * camera.scale

    def numbers(half: Half, power: float) -> np.ndarray:
        target = _target(half, fault)
        frame = power * shown(target)
        if fault is not None and half == fault.half:
            frame = _spoiled(frame, fault, still)
        mean = frame + still
        electrons = mean + np.sqrt(np.maximum(mean, 0) + traits["read_noise_e"] ** 2) * rng.standard_normal(
            mean.shape, dtype=np.float32
        )
        if fault is not None and half == fault.half and fault.kind == "clipped":
            electrons = np.minimum(electrons, np.quantile(electrons, 0.8))
        return np.asarray(np.clip(np.rint(electrons * gain + BLACK), 0, CODES - 1), np.uint16)

    for place, half in enumerate(order):
        power = 1.0
        if fault is not None and fault.kind == "drift":
            power += DRIFT * (place / len(order) - 0.5)
        for repeat in range(traits["repeats"]):
            if fault is not None and fault.kind == "flicker":
                power = 1 + FLICKER * float(rng.standard_normal())
            frame = numbers(half, power)
            if fault is not None and fault.kind == "repeated" and half == fault.half:
                frame = read[order[place - 1]]
            read[half] = frame
            np.save(folder / f"f_{place * traits['repeats'] + repeat:05d}.npy", frame)
    digital = {
        "exposure_s": 1.0,
        "gain_dn_per_e": gain,
        "black_level_dn": BLACK,
        "dark_current_e_per_s": DARK,
        "read_noise_e": traits["read_noise_e"],
        "step_dn": 1,
        "saturation_dn": CODES - 1,
    }
    listed = {
        "camera": "ideal",
        "n": camera.n,
        "signed_capture": "uniform" if camera.uniform else "pair",
        "repeats": traits["repeats"],
        "digital": digital,
        "centre": camera.centre,
    }
    (folder / "session.json").write_text(json.dumps(listed))
    return folder


def _target(half: Half, fault: Fault | None) -> Half:
    """What is shown in place of a ``half``."""
    if fault is None or half[0] != fault.half[0]:
        return half
    side, index, sign = half
    if fault.kind == "exchanged" and index == fault.half[1]:
        return side, index, -sign
    if fault.kind == "swapped" and index in (fault.half[1], fault.other):
        return side, fault.half[1] + fault.other - index, sign
    return half


def _spoiled(frame: np.ndarray, fault: Fault, still: float) -> np.ndarray:
    """Light of a frame with a ``fault``."""
    if fault.kind == "black":
        return np.full_like(frame, -still)
    if fault.kind == "half exposure":
        return frame / 2 - still / 2
    if fault.kind == "half lost":
        lost = frame.copy()
        rows = int(fault.part * frame.shape[fault.other % 2])
        part = slice(rows, None) if fault.other % 4 < 2 else slice(0, rows)
        lost[(part, slice(None)) if fault.other % 2 == 0 else (slice(None), part)] = -still
        return lost
    if fault.kind == "shifted":
        axis, by = fault.other % 2, 1 + fault.other % 3
        return np.roll(frame, by if fault.other % 4 < 2 else -by, axis)
    return frame


def ratio(camera: Camera, factors: Factors) -> float:
    """Actual over stated error of both factors, in quadrature."""
    errors = []
    assert factors.estimate is not None
    for found, exact in zip((factors.left, factors.right), camera.exact(camera.scale), strict=True):
        sign = np.sign(np.vdot(found, exact))
        errors.append(float(np.linalg.norm(sign * found - exact) / np.linalg.norm(exact)))
    return float(np.hypot(errors[0], errors[1]) / np.hypot(*factors.estimate.predicted_error))


@single_threaded_blas()
def one(seed: int, n: int, kind: str | None, uniform: bool) -> dict[str, Any]:
    """One session: what was said of it."""
    camera = Camera(seed, n, uniform)
    fault = (
        None if kind is None else Fault.of(kind, stripe_signs(n).shape[1], np.random.default_rng([seed, n, 3]), uniform)
    )
    row: dict[str, Any] = {
        "seed": seed,
        "n": n,
        **camera.traits,
        "fault": fault and [fault.kind, *fault.half, fault.other],
    }
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        try:
            factors = calibrate_frames(session(camera, Path(folder) / "frames", fault))
        except MitsimError as error:
            return {**row, "refused": str(error), "named": False, "flagged": True}
    result = factors.manifest.result
    return {
        **row,
        "named": fault is None or fault.named(factors),
        "flagged": bool(result["faults"] or result["lamp"]),
        "stated": result["predicted_phi_error"],
        "ratio": ratio(camera, factors),
        "warnings": list(factors.warnings),
    }


def rate(rows: list[dict[str, Any]], key: str) -> dict[str, float]:
    """How often, with its binomial standard error (that of one more of each outcome)."""
    count, total = sum(bool(row[key]) for row in rows), len(rows)
    part = (count + 1) / (total + 2)
    return {
        "count": count,
        "of": total,
        "part": count / max(total, 1),
        "error": float(np.sqrt(part * (1 - part) / total)),
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Rates of sessions of one kind."""
    ratios = [row["ratio"] for row in rows if "ratio" in row]
    quantiles = np.quantile(ratios, [0.05, 0.5, 0.95, 1.0]).round(3).tolist() if ratios else None
    return {"named": rate(rows, "named"), "flagged": rate(rows, "flagged"), "actual_over_stated": quantiles}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path)
    parser.add_argument("--sessions", type=int, default=20)
    parser.add_argument("--clean", type=int, default=200)
    parser.add_argument("--faults", nargs="*", default=FAULTS)
    parser.add_argument("--n", nargs="+", type=int, default=(64, 128))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--uniform", action="store_true", help="patterns against one uniform frame, no pairs")
    options = parser.parse_args()
    found: dict[str, list[dict[str, Any]]] = {}
    for kind in ("clean", *options.faults):
        count = options.clean if kind == "clean" else options.sessions
        rows = found.setdefault(kind, [])
        for number in range(count):
            n = options.n[number % len(options.n)]
            rows.append(one(options.seed + number, n, None if kind == "clean" else kind, options.uniform))
        if rows:
            print(kind, json.dumps(summary(rows)), flush=True)
        facts = {"noise": NOISE, "seed": options.seed, "uniform": options.uniform, "versions": versions()}
        text = {**facts, "summary": {name: summary(each) for name, each in found.items() if each}, "sessions": found}
        options.result.write_text(json.dumps(text, indent=1) + "\n")


if __name__ == "__main__":
    main()

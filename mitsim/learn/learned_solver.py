"""A trained network as a method of solving, and its file.

`torch.load` reads the file with `weights_only`, so that nothing in it is executed.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, Literal
from zipfile import is_zipfile

import numpy as np
import torch

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import validate
from mitsim.core.errors import ArgumentError, MitsimError, cut, reason_of
from mitsim.core.files import check_plain, json_text, whole_file
from mitsim.core.manifests import SIDES
from mitsim.learn.methods import CLASSES, Binning, Data, Denoiser, Diagonal, Method, PlugAndPlay
from mitsim.learn.pair_store import ModelManifest
from mitsim.learn.requests import PLUG_AND_PLAY, REFINED, UNROLLED
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.misfit import UNEXPLAINED
from mitsim.reconstruct.request import TIKHONOV
from mitsim.reconstruct.solution import Solution, Status, Verdict
from mitsim.reconstruct.solver import Accumulator, DiagonalProblem, Prepared, noise_variance
from mitsim.reconstruct.solvers import SOLVERS, Patterns, Solver

_MOST_BYTES = 1 << 28
_SAME_CAMERA = 0.02
"""Relative difference of models that indicates another camera: four times that of two sessions of 512 frames."""
_OTHER_NOISE = 1.5
"""Allowed factor of the noise outside the training's range; half an exposure gives 1.4."""
_NO_NOISE = 1e-14
"""Part of the frames' energy that counts as noise: rounding of single precision."""
_PATTERNS = ("P_L", "P_R")


@dataclass(frozen=True, eq=False)
class _Doubted(Prepared):
    doubts: tuple[str, ...] = ()
    reads_frames: bool = False

    def accumulator(self) -> Accumulator:
        return Binning(self) if self.reads_frames else Accumulator(self)


@dataclass(frozen=True, eq=False)
class LearnedSolver(Solver):
    """Trained network as a method of solving, with the factors and patterns of its training."""

    manifest: ModelManifest
    network: Method
    sides: tuple[FloatArray, FloatArray]
    patterns: Patterns

    linear, whole = False, False

    @property
    def name(self) -> str:
        digest = hashlib.sha256(self.manifest.model_dump_json().encode())
        for name, values in self.network.state_dict().items():
            digest.update(name.encode() + values.cpu().contiguous().numpy().tobytes())
        return f"{self.manifest.method} {digest.hexdigest()[:12]}"

    def init(self, camera: Factors, patterns: Patterns) -> Prepared:
        """Factorise the camera's model, with doubts where it differs from that of the training.

        Raise MitsimError for images of another size, other patterns, and another camera where the weights belong to
        one.
        """
        shape = camera.left.shape[1], camera.right.shape[1]
        if shape != self.network.shape:
            (own_rows, own_columns), (rows, columns) = self.network.shape, shape
            raise MitsimError(
                f"model {self.name}: makes images of {own_rows} x {own_columns} pixels, but calibration {camera.name} "
                f"has {rows} x {columns}; train one for it"
            )
        if not all(np.array_equal(own, other) for own, other in zip(self.patterns, patterns, strict=True)):
            raise MitsimError(
                f"model {self.name}: was trained under the patterns {cut(self.manifest.patterns)}, and these are "
                "others; capture those, or train one for these"
            )
        doubts, (ours, theirs) = list[str](), (self.manifest.camera, camera.manifest.camera)
        if names := [cut(name) for name in sorted({*ours, *theirs}) if ours.get(name) != theirs.get(name)]:
            other = f"{', '.join(names)} differ"
            if self.network.holds_camera:
                raise MitsimError(
                    f"model {self.name}: was trained for another camera ({other}), and its weights stand for that one; "
                    f"train one for calibration {camera.name}, or {UNROLLED} or {REFINED}, which serve others, flagged"
                )
            doubts.append(f"The network was trained for another camera: {other}.")
        elif (difference := _difference(self.sides, camera.sides)) > _SAME_CAMERA:
            doubts.append(f"The network was trained with a calibration that differs by {difference:.1%}.")
        whole = SOLVERS[TIKHONOV].init(camera, patterns)
        return _Doubted(**vars(whole), doubts=tuple(doubts), reads_frames=self.network.reads_frames)

    def compute(
        self, prepared: Prepared, frames: Accumulator, lam: float | Literal["auto"], **iterative: Any
    ) -> Solution:
        """Return the image of the frames; raise MitsimError if it is not finite."""
        problem = prepared.problem(frames)
        variance = datum_variance(problem)
        like = next(self.network.parameters())
        data = Data.of(problem.projected[None], variance, like)
        if isinstance(frames, Binning):
            data = replace(data, frames=torch.as_tensor(frames.frames).to(like)[None])
        with torch.no_grad():
            found = self.network.images(data, Diagonal.of(prepared, like))[0, 0]
        image = found.cpu().numpy().astype(np.float64)
        if not np.isfinite(image).all():
            raise MitsimError(f"model {self.name}: its image of these frames is not finite; train it anew")
        missed, beyond = beyond_noise(prepared, problem, image)
        outside = max(problem.energy - float(np.square(problem.projected).sum()), 0.0)
        flags = [*(prepared.doubts if isinstance(prepared, _Doubted) else ())]
        relative, (low, high) = relative_noise(problem), self.manifest.noise
        if not low / _OTHER_NOISE <= relative <= high * _OTHER_NOISE:
            flags.append(
                f"The network was trained with noise of {low:.1e} to {high:.1e} of the light, and here it is "
                f"{relative:.1e}."
            )
        if beyond > UNEXPLAINED:
            flags.append(f"The image does not give the frames: {beyond:.1e} of them, beyond noise, are others.")
        return Solution(
            image=image,
            lam=variance * float(torch.exp(self.network.log_start.detach())),
            residual=float(np.sqrt((missed + outside) / problem.energy)),
            status=Status(
                Verdict.SOLVED,
                f"Found by a trained network, {self.name}: what it adds to the frames is likely, not measured, and its "
                "uncertainty is not known",
                figures=f"{prepared.extent}.",
                flags=tuple(flags),
            ),
        )

    def denoiser(self) -> Denoiser:
        if not isinstance(self.network, PlugAndPlay):
            raise MitsimError(f"model {self.name}: has no denoiser; train {PLUG_AND_PLAY}")
        return Denoiser(self.network)

    def save(self, path: Path | str) -> None:
        tensors = dict(zip((*SIDES, *_PATTERNS), (*self.sides, *self.patterns), strict=True))
        held = {
            "manifest": json_text(self.manifest.model_dump()),
            "tensors": {name: torch.as_tensor(np.asarray(values, np.float64)) for name, values in tensors.items()},
            "weights": {name: values.cpu() for name, values in self.network.state_dict().items()},
        }
        write_tensors(path, held)


def read_network(path: Path | str, device: str) -> LearnedSolver:
    """Read a file of `mitsim train` for a device of torch; raise MitsimError for any other file."""
    if check_plain(path, "model").st_size > _MOST_BYTES:
        raise MitsimError(f"model {path}: is larger than {_MOST_BYTES >> 20} MiB; give a file of `mitsim train`")
    try:
        if not is_zipfile(path):  # torch reads older files with warnings
            raise ValueError("no file of torch")
        held = torch.load(path, map_location="cpu", weights_only=True)
        manifest = validate(ModelManifest, json.loads(held["manifest"]), f"model {path}")
        left, right, *patterns = (held["tensors"][name].numpy() for name in (*SIDES, *_PATTERNS))
        network = CLASSES[manifest.method]((left.shape[1], right.shape[1]))
        network.load_state_dict(held["weights"])
        finite = all(bool(values.isfinite().all()) for values in network.state_dict().values())
    except MitsimError:
        raise
    except Exception as error:  # torch.load raises errors of many classes
        raise MitsimError(
            f"model {path}: is no file of `mitsim train` ({cut(reason_of(error), 200)}); train one"
        ) from error
    if not finite:
        raise MitsimError(f"model {path}: has weights that are not finite; train it anew")
    return LearnedSolver(manifest, on_device(network, device).eval(), (left, right), (patterns[0], patterns[1]))


def write_tensors(path: Path | str, held: dict[str, Any]) -> None:
    """Write a file for ``torch.load`` as a whole; raise MitsimError if it cannot be written.

    The buffer exists because torch reports a full disk with pages of text.
    """
    buffer = BytesIO()
    torch.save(held, buffer)
    with whole_file(path) as part:
        part.write_bytes(buffer.getbuffer())


def on_device(network: Method, device: str) -> Method:
    try:
        network.to(device)
        float(network.log_start.detach())
    except (RuntimeError, AssertionError) as error:  # torch: unknown device, none built in, and `meta`
        raise ArgumentError("device", f"{device!r}: cannot be used ({cut(reason_of(error))}); use cpu") from error
    return network


def datum_variance(problem: DiagonalProblem) -> float:
    return max(noise_variance(problem), _NO_NOISE * problem.energy / problem.data_count)


def beyond_noise(prepared: Prepared, problem: DiagonalProblem, image: FloatArray) -> tuple[float, float]:
    """Return the frames' energy in the model's range that an image does not reproduce, and the rms unexplained part."""
    missed = float(np.square(problem.projected - problem.sigma * prepared.coefficients(image)).sum())
    beyond = max(missed - datum_variance(problem) * prepared.rank, 0.0)
    return missed, float(np.sqrt(beyond / problem.energy))


def relative_noise(problem: DiagonalProblem) -> float:
    return float(np.sqrt(datum_variance(problem) * problem.data_count / problem.energy))


def _difference(ours: Patterns, theirs: Patterns) -> float:
    if any(a.shape != b.shape for a, b in zip(ours, theirs, strict=True)):
        return 1.0
    own, other, both = (
        float(np.prod([np.vdot(a, b) for a, b in zip(first, second, strict=True)]))
        for first, second in ((ours, ours), (theirs, theirs), (ours, theirs))
    )
    return float(np.sqrt(max(own + other - 2 * both, 0.0) / own))

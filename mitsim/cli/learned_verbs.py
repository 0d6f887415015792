"""Verbs on networks and what they learn from: words of a command line in, folders of pairs and trained networks out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import mitsim
from mitsim.cli.help_page import LIMITS, QUALITY, WHAT
from mitsim.cli.options import (
    Accuracy,
    Devices,
    Effects,
    ExposureFraction,
    Limited,
    Patterns,
    Resume,
    Scene,
    Seed,
    completing,
    number_of,
    option,
    refuse_unused,
    request_of,
    verb,
)
from mitsim.cli.screen import finish
from mitsim.core.errors import MitsimError
from mitsim.core.worker import RESUME, advise
from mitsim.learn.training_request import METHODS, Training
from mitsim.reconstruct.request import MODEL

if TYPE_CHECKING:
    from mitsim.api.bench import Bench


@dataclass(frozen=True)
class OfPairs:
    """What pairs are asked for."""

    PANEL = WHAT

    count: int = option(..., "pairs to make", metavar="N")
    patterns: Patterns = "dots:7"
    idealised: bool = option(False, "frames of the paper's separable model, not rendered", "--idealised")
    pictures: Path | None = option(None, "folder of pictures; drawn by code if not given", metavar="FOLDER")
    vary: Path | None = option(None, "how benches vary from one group of pairs to the next", metavar="FILE.toml")
    resume: Resume = False


@dataclass(frozen=True)
class PairFrames:
    """How the frames of pairs are made: fields of a request."""

    PANEL = WHAT

    accuracy: Accuracy = 1e-3
    seed: Seed = 0
    effects: Effects = ""
    exposure: str = option("auto", "seconds a frame, or auto: each pair for itself", metavar="auto|SECONDS")
    exposure_fraction: ExposureFraction = 0.8
    ambient_frame: str = option("auto", "take a frame with the projector off and lamps on", metavar="auto|yes|no")
    ambient_shots: int | None = option(None, "shots of that frame; by the patterns if not given", metavar="N")


@verb
def pairs(
    *,
    context: typer.Context,
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="folder to make", metavar="DIR")],
    asked: OfPairs,
    frames: PairFrames,
    devices: Devices,
    limited: Limited,
) -> int:
    """Make pairs to learn from: pictures and their frames.

    Pictures stand on a scene's print, and the camera takes frames of them.

    $ mitsim pairs photograph --count 500 -o pairs
    $ mitsim pairs photograph --count 500 --pictures photos -o mine
    """
    from mitsim.bench.request import Task
    from mitsim.core.configuration import load_model
    from mitsim.core.files import PAIRS, check_output
    from mitsim.learn.pair_request import PairsRequest, Variation

    if frames.exposure != "auto":
        refuse_unused(context, ["exposure_fraction"], "on an --exposure in seconds")
    if frames.ambient_frame == "no":
        refuse_unused(context, ["ambient_shots"], "with --ambient-frame no")
    fields = {**vars(frames), "exposure": number_of("exposure", frames.exposure), "patterns": asked.patterns}
    request = mitsim.Request.of(**request_of(**fields))
    variation = None if asked.vary is None else load_model(asked.vary, Variation)
    wanted = PairsRequest(request, asked.count, asked.idealised, asked.pictures, variation)
    wanted.check()
    check_output(output, overwrite=asked.resume and (output / PAIRS).is_file())
    devices.check_exposure(request.timing)
    devices.check(scene, asked.patterns)
    advise(RESUME)
    with limited.job() as job:
        from mitsim.learn.pairs import make_pairs

        def opening(drawn: Mapping[str, str]) -> Bench:
            define = [*(devices.define or ()), *(f"{name}={value}" for name, value in drawn.items())]
            return replace(devices, define=define).open(scene, limited.variant, job)

        made, cost = make_pairs(opening, wanted, Task(output, asked.resume, job))
        payload = {**made.summary(), "predicted_seconds": cost.seconds, "predicted_bytes": cost.disk_bytes}
        payload |= {"seconds": job.clock.seconds(), "kernels": job.clock.kernels()}
    rows, columns = payload["shape"]
    lines = [
        f"{payload['count']} pairs of {payload['frames']} frames of {rows}x{columns} in "
        f"{payload['seconds']['total']:.1f} s ({cost.seconds:.3g} s predicted), "
        f"{payload['bytes'] / 2**20:.3g} MiB: {output}",
        *([f"Light is traced for each picture: {payload['traced_anew']}"] if payload["traced_anew"] else []),
    ]
    return finish(limited.as_json, payload, lines, payload["warnings"])


@dataclass(frozen=True)
class Schedule:
    """How a network is trained."""

    PANEL = QUALITY

    steps: int = option(Training.steps, "of the optimiser")
    batch: int = option(Training.batch, "pairs a step")
    rate: float = option(Training.rate, "largest learning rate of the cycle")
    seed: Seed = 0
    device: str = option(Training.device, "that torch works on", metavar="NAME", rich_help_panel=LIMITS)
    feature_weight: float = option(Training.feature_weight, "of differences of features, beside the squared error")
    adversary_weight: float = option(Training.adversary_weight, "of what an adversary tells from truths, beside it")


@verb
def train(
    *,
    method: Annotated[
        str,
        typer.Argument(
            help=f"{', '.join(METHODS[:-1])} or {METHODS[-1]}",
            metavar="METHOD",
            autocompletion=completing(lambda: METHODS),
        ),
    ],
    pairs: Annotated[Path, typer.Argument(help="folder of `mitsim pairs`", metavar="PAIRS")],
    output: Annotated[Path, typer.Option("-o", "--output", help="file to make", metavar="MODEL.pt")],
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="folder of `mitsim calibrate`",
            metavar="CAL",
            show_default="PAIRS/calibration",
            rich_help_panel=WHAT,
        ),
    ] = None,
    schedule: Schedule,
    resume: Resume = False,
    limited: Limited,
) -> int:
    """Train a network that makes images of frames.

    For reconstruct --method MODEL.pt. Needs torch: mitsim[learn].

    $ mitsim train unrolled pairs -o model.pt
    $ mitsim reconstruct run --calibration cal --method model.pt
    """
    from mitsim.learn.verbs import train as train_model

    if output.suffix != MODEL:
        raise MitsimError(f"--output {output}: a trained network is a file that ends in {MODEL}; give such a name")
    Training(method, **vars(schedule))  # refused before anything is imported for it
    advise(RESUME)
    with limited.job() as job:
        made = train_model(method, pairs, output, calibration, resume, job, **vars(schedule))
        payload = {**made.summary(), "seconds": job.clock.seconds()}
    lines = [
        f"{payload['model']}: {payload['weights']} weights, {made.curve[-1][0]} of {schedule.steps} steps in "
        f"{payload['seconds']['total']:.0f} s (predicted {made.predicted_seconds:.0f}): {output}",
        f"PSNR of photographs held out: {made.psnr_before_db:.2f} dB before, {made.psnr_db:.2f} dB after",
    ]
    return finish(limited.as_json, payload, lines, ())

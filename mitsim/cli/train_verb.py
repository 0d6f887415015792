"""`mitsim train`: a method and a folder of pairs in; a trained network, and what the terminal shows of it, out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from mitsim.cli.options import Limited, Resume, Seed, option, verb
from mitsim.cli.screen import finish
from mitsim.core.errors import MitsimError
from mitsim.core.worker import RESUME, advise
from mitsim.learn.request import METHODS, Training
from mitsim.reconstruct.request import MODEL


@dataclass(frozen=True)
class Schedule:
    """How a network is trained."""

    steps: int = option(Training.steps, "of the optimiser")
    batch: int = option(Training.batch, "pairs a step")
    rate: float = option(Training.rate, "largest learning rate of the cycle")
    seed: Seed = 0
    device: str = option(Training.device, "of torch: cpu, cuda, mps, ...")


@verb
def train(
    *,
    method: Annotated[str, typer.Argument(help=f"{', '.join(METHODS[:-1])} or {METHODS[-1]}", metavar="METHOD")],
    pairs: Annotated[Path, typer.Argument(help="folder of `mitsim pairs`", metavar="PAIRS")],
    output: Annotated[Path, typer.Option("-o", "--output", help="file to make", metavar="MODEL.pt")],
    calibration: Annotated[
        Path | None,
        typer.Option(help="folder of `mitsim calibrate`", metavar="CAL", show_default="PAIRS/calibration"),
    ] = None,
    schedule: Schedule,
    resume: Resume = False,
    limited: Limited,
) -> int:
    """Train a network that makes images of frames, for reconstruct --method MODEL.pt. Needs torch: mitsim[learn]."""
    from mitsim.learn.verbs import train as train_model

    if output.suffix != MODEL:
        raise MitsimError(f"--output {output}: a trained network is a file that ends in {MODEL}; give such a name")
    Training(method, **vars(schedule))  # refused before anything is imported for it
    advise(RESUME)
    with limited.job() as job:
        made = train_model(method, pairs, output, calibration, resume, job, **vars(schedule))
    payload = made.summary()
    (_, before), (last, _) = made.curve[0], made.curve[-1]
    lines = [
        f"{payload['model']}: {payload['weights']} weights, {last} of {schedule.steps} steps in {made.seconds:.0f} s "
        f"(predicted {made.predicted_seconds:.0f}): {output}",
        f"PSNR of pairs that did not teach: {before:.2f} dB before, {payload['psnr_db']:.2f} dB after",
    ]
    return finish(limited.as_json, payload, lines, ())

"""`mitsim calibrate --plan` and `--model`: words of a command line in; a plan, a fit's words, or a refusal, out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsim.cli.screen import finish
from mitsim.core.errors import MitsimError

if TYPE_CHECKING:
    from mitsim.capture.bench import Bench
    from mitsim.core.job import Job
    from mitsim.rig.modelling import Modelling
    from mitsim.rig.recipe import SessionRecipe

PATTERNS = "dots:7"
"""Of the capture, where none are given."""


@dataclass(frozen=True)
class Wanted:
    """What --plan is asked for: PSNR [dB] under patterns, and a file for the recipe; None: none is written."""

    psnr: float
    patterns: str
    output: Path | None

    @classmethod
    def of(cls, psnr: float | None, patterns: str | None, output: Path | None, resume: bool) -> Wanted:
        """Of the command line's options; refused before work.

        Parameters
        ----------
        psnr, patterns, output, resume
            as `mitsim calibrate` has them.

        Raises
        ------
        MitsimError
            for a missing PSNR, values that are not allowed, and a file that cannot be written.
        """
        from mitsim.capture.request import Request, check_psnr
        from mitsim.core.output import prepare_output

        if psnr is None:
            raise MitsimError("--plan: give the PSNR that the image is to have, such as --psnr 35")
        if resume:
            raise MitsimError("--resume: a plan writes no parts to go on with; leave it out")
        if output is not None:
            prepare_output(output, kind="file")
        asked = Request.of(patterns=patterns or PATTERNS)
        return cls(check_psnr(psnr), asked.patterns, output)

    def planned(self, bench: Bench, recipe: SessionRecipe, request: dict[str, Any], job: Job, as_json: bool) -> int:
        """Make, write and print the plan; returns the exit status.

        Parameters
        ----------
        bench, recipe, request, job
            the scene, the session's recipe, accuracy and seed, progress and limits.
        as_json
            one JSON object instead of text.
        """
        from mitsim.core.output import whole_file
        from mitsim.rig.recipe import recipe_text
        from mitsim.study.calibration_plan import plan_calibration

        found = plan_calibration(bench, self.psnr, self.patterns, recipe, **request, job=job)
        lines = found.lines()
        if self.output is not None:
            with whole_file(self.output) as part:
                part.write_text(recipe_text(found.recipe), encoding="utf-8")
            lines.append(f"Recipe: {self.output}")
        payload = {**found.payload(), "output": None if self.output is None else str(self.output)}
        return finish(as_json, payload, lines, found.warnings)


def modelling_of(model: str, frames_used: int | None, fit: str | None, accuracy: float) -> Modelling:
    """What `--model` is asked for; MitsimError for words that it does not know.

    Parameters
    ----------
    model, frames_used, fit, accuracy
        the options; None where not given.
    """
    from mitsim.rig.modelling import FITTED, Modelling

    names = FITTED if fit is None else tuple(name.strip() for name in fit.split(","))
    words: Any = model  # checked there
    return Modelling(words, **({} if frames_used is None else {"frames": frames_used}), fitted=names, accuracy=accuracy)


def model_lines(result: Mapping[str, Any], output: Path) -> list[str]:
    """What people read of a fit's ``result``, in the folder ``output``."""
    numbers = [
        f"{name.replace('_', ' ')} {number['value']:.6g} +-{number['standard_error']:.2g} {number['unit']}"
        for name, number in result["parameters"].items()
        if number["standard_error"] is not None
    ]
    return [
        f"{result['model']} model fitted to {result['frames']} frames in {result['seconds']['total']:.1f} s: {output}",
        *numbers,
        f"unexplained {result['unexplained_residual']:.2%}, chi-square {result['chi_square']:.3g} a datum, condition "
        f"{result['condition']:.2e}",
    ]


def check_no_plan(psnr: float | None, patterns: str | None, output: Path | None) -> Path:
    """The output of a calibration that is no plan.

    Parameters
    ----------
    psnr, patterns
        options of --plan; MitsimError where one is given.
    output
        the folder; MitsimError without one.
    """
    for name, value in (("--psnr", psnr), ("--patterns", patterns)):
        if value is not None:
            raise MitsimError(f"{name} {value}: is for --plan; a calibration serves all patterns, so leave it out")
    if output is None:
        raise MitsimError("Missing option '-o' / '--output': give the calibration folder to make")
    return output

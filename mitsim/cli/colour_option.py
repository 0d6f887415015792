"""--colour of `mitsim plan`, `capture` and `calibrate`: the option in; a bench, and what the terminal shows of runs and
calibrations of a projector's lines, out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from mitsim.cli.options import Devices, option
from mitsim.core.errors import MitsimError
from mitsim.core.spectral_manifests import (
    BANDS,
    CALIBRATION,
    LINES,
    RUN,
    bands_of,
    check_undecided,
    read_colours,
    spectral_of,
)
from mitsim.core.spectral_manifests import MOSAIC as MOSAIC_RUN

if TYPE_CHECKING:
    from mitsim.api.bench import Bench
    from mitsim.core.runs import Capture, MosaicCapture
    from mitsim.light.plan import Plan
    from mitsim.reconstruct.factors import Factors

NO, MOSAIC, AUTO = "no", "mosaic", "auto"


def _choice(context: typer.Context, name: str) -> str:
    words = [NO, LINES, f"{BANDS}:K", MOSAIC, AUTO]
    if context.info_name == "calibrate":
        words.remove(AUTO)
    if name.startswith(f"{BANDS}:"):
        bands_of(name)
    elif name not in words:
        raise MitsimError(f"--colour {name!r}: use {', '.join(words[:-1])} or {words[-1]}")
    return name


@dataclass(frozen=True)
class Coloured(Devices):
    """What opens a bench, and which of its projector's light is told apart."""

    colour: str = option(
        NO,
        "lines: sequential colour, each line of the projector in a folder of its own; bands:K: the same of K "
        "bands of its lines; mosaic: all lines at once, by a camera under colour filters; auto: no, bands or "
        "lines, as the accuracy needs (not calibrate); no: light that is not told apart",
        metavar="no|lines|bands:K|mosaic|auto",
        callback=_choice,
    )

    def traced_in(self, variant: str) -> str:
        """The variant that light is traced in: told apart, by the backend of ``variant`` that knows wavelengths.

        MitsimError for colour that the camera cannot have.
        """
        if self.colour == NO:
            return variant
        from mitsim.bench.apparatus import check_devices
        from mitsim.devices.sensor import load_sensor

        path, _ = check_devices(self.camera, None)
        mosaic = load_sensor(path).mosaic
        if self.colour == MOSAIC and mosaic is None:
            raise MitsimError(
                f"--colour mosaic: camera {path} has no mosaic of colour filters; give one that has, such as "
                "--camera imx249_rggb, or use --colour lines"
            )
        if self.colour != MOSAIC and mosaic is not None:
            raise MitsimError(
                f"--colour {self.colour}: camera {path} has a mosaic {mosaic}, whose frames show all lines at once; "
                "use --colour mosaic"
            )
        return variant if self.colour == AUTO else spectral_of(variant)

    def check_colour(self, variant: str, seconds: float | None = None) -> None:
        """Refuse colour that a bench would refuse, before the renderer is imported.

        Parameters
        ----------
        variant
            as asked for.
        seconds
            that a capture is to take; None: not said.

        Raises
        ------
        MitsimError
            for seconds, a variant that colours cannot be weighed from, and lines or bands that the projector does not
            have.
        """
        if self.colour == NO:
            return
        from mitsim.bench.apparatus import check_devices
        from mitsim.bench.request import check_untimed
        from mitsim.core.configuration import load_model

        check_untimed(seconds)
        _, path = check_devices(None, self.projector)
        if self.colour == AUTO:
            check_undecided(variant)
            return
        from mitsim.devices.projector import ProjectorModel

        model = load_model(path, ProjectorModel)
        lit = model.in_bands(bands_of(self.colour)) if self.colour.startswith(BANDS) else model
        lit.traced_lines  # noqa: B018 - checks itself


def by_line(colour: str) -> bool:
    """Whether ``colour`` is of lines, or bands of them, one after the other."""
    return colour.partition(":")[0] in (LINES, BANDS)


def in_colour(bench: Bench, colour: str) -> Bench:
    """The ``bench`` with the lines that ``colour`` names; MitsimError for more bands than its projector has lines."""
    return bench.in_bands(bands_of(colour)) if colour.startswith(BANDS) else bench


def plan_of(bench: Bench, colour: str, request: dict[str, Any]) -> Plan:
    """The plan that a command line asks for.

    Parameters
    ----------
    bench, colour, request
        what it names; of the request, its fields.
    """
    if colour == AUTO:
        return bench.choose_colour(**request).plan
    if colour == NO:
        return bench.plan(**request)
    from mitsim.acquire.spectral import SpectralBench
    from mitsim.bench.request import Request

    kind = MOSAIC_RUN if colour == MOSAIC else RUN
    return SpectralBench.of(in_colour(bench, colour), kind).plan(Request.of(**request))


# ---- what the terminal shows -----------------------------------------------------------------------------------------


def of_capture(runs: Mapping[str, Capture], output: Path) -> tuple[dict[str, Any], list[str]]:
    """JSON and lines of text of a coloured capture: its ``runs`` by line, in the folder ``output``."""
    payload = _payload(RUN, {name: run.summary() for name, run in runs.items()}, output)
    lines = [
        f"{part['name']}: {part['frames']} frames of {part['shape'][0]}x{part['shape'][1]}, Monte Carlo error "
        f"{part['mc_error']:.1e}, total error up to {part['total_error_bound']:.1e}, exposure {part['exposure_s']:.3g} "
        "s a frame"
        for part in payload["channels"]
    ]
    return payload, [*lines, _last(payload), *weighed(payload)]


def weighed(payload: Mapping[str, Any]) -> list[str]:
    """The line that a capture's ``payload`` says of what was weighed for colour; none where that was not asked for."""
    choice = payload["colour"]
    if choice is None or len(choice["candidates"]) < 2:
        return []
    errors = ", ".join(f"{each['name']} {each['error']:.1e}" for each in choice["candidates"])
    return [f"Colour: {choice['chosen']} (error that each leaves: {errors})"]


def of_mosaic(shots: MosaicCapture) -> tuple[dict[str, Any], list[str]]:
    """JSON and lines of text of ``shots`` behind colour filters, in their folder."""
    payload = shots.summary()
    lines = [
        f"{payload['frames']} frames of {payload['shape'][0]}x{payload['shape'][1]} behind {payload['mosaic']} "
        f"filters, {len(payload['channels'])} lines at once, in {payload['seconds']['total']:.1f} s: "
        f"{payload['output']}",
        f"Monte Carlo error at most {payload['mc_error']:.1e}, total error up to {payload['total_error_bound']:.1e}, "
        f"exposure {payload['exposure_s']:.3g} s a frame",
    ]
    return payload, [*lines, *ambient_of(payload)]


def ambient_of(payload: Mapping[str, Any]) -> list[str]:
    """The line that a capture's ``payload`` says of its ambient frame; none where none was taken."""
    ambient = payload["ambient_frame"]
    if not ambient:
        return []
    return [
        f"Ambient frame: the mean of {ambient['shots']} shots with the projector off, to be taken off; "
        f"{ambient['part']:.1%} of the frames' light is ambient, noise {ambient['noise']:.2g} of the projector's, "
        f"total error up to {payload['total_error_of_projector']:.1e} of it"
    ]


def of_calibration(factors: Mapping[str, Factors], output: Path) -> tuple[dict[str, Any], list[str]]:
    """The same of a coloured calibration: its ``factors`` by line, in the folder ``output``."""
    results = {
        name: {**each.manifest.result, "warnings": each.warnings, "output": str(output / name)}
        for name, each in factors.items()
    }
    payload = _payload(CALIBRATION, results, output)
    lines = [
        f"{part['name']}: {part['frames']} frames of {part['n']} stripes, separability residual "
        f"{_percent(part['separability_residual'])}, factor error {part['phi_error']:.1e}"
        for part in payload["channels"]
    ]
    return payload, [*lines, _last(payload)]


def _percent(part: float | None) -> str:
    return "unknown" if part is None else f"{part:.2%}"


def _payload(kind: str, results: Mapping[str, Mapping[str, Any]], output: Path) -> dict[str, Any]:
    colours = read_colours(output, kind)
    return {
        "kind": colours.kind,
        "channels": [{**line.model_dump(), **results[line.name]} for line in colours.channels],
        "seconds": results[colours.names[-1]]["seconds"],
        **{name: results[colours.names[0]].get(name) for name in ("colour",) if kind == RUN},
        "warnings": tuple(f"{name}: {text}" for name, result in results.items() for text in result["warnings"]),
        "output": str(output),
    }


def _last(payload: Mapping[str, Any]) -> str:
    return f"{len(payload['channels'])} lines in {payload['seconds']['total']:.1f} s: {payload['output']}"

"""The verb that draws a bench: a scene and its devices in; a picture or a page of it, and its distances, out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitsim.cli.options import Common, Devices, Scene, verb
from mitsim.cli.screen import finish


@verb
def view(
    scene: Scene,
    *,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="picture, or page to turn the bench on", metavar="FILE.png|FILE.html"),
    ] = Path("view.png"),
    devices: Devices,
    common: Common,
) -> int:
    """Draw the bench to scale, before any light is simulated.

    With its distances, the depths that light is seen at, and what the camera sees. A page (.html) can be turned.

    $ mitsim view cookie_bag
    $ mitsim view photograph -D sheet_z=420 -o bench.html
    """
    from mitsim.bench.request import check_view
    from mitsim.core.files import check_apart, check_output, output_file

    check_output(check_view(output), overwrite=True, kind="file")
    devices.check(scene)
    with output_file(output, overwrite=True) as place, common.job() as job:
        bench = devices.open(scene, common.variant, job)
        check_apart(place, (*bench.loaded.files, *devices.models))
        with job.clock.stage("view"):
            seen = bench.view()
        with job.clock.stage("draw"):
            payload = {**seen.summary(), "output": str(seen.save(place))}
    return finish(common.as_json, payload, [*seen.lines(), f"Drawn: {payload['output']}"], seen.warnings)

"""Verbs of a camera's sensor alone: words of a command line in, its characterisation or a frame behind it out."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from mitsim.cli.options import Json, Quiet, Seed, Variant, job_of, number_of, refuse_unused
from mitsim.cli.screen import finish
from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.errors import MitsimError

app = typer.Typer()


@app.command()
def characterise(
    context: typer.Context,
    camera: Annotated[str, typer.Argument(help="camera electronics: name or TOML file", metavar="CAMERA")],
    output: Annotated[Path, typer.Option("-o", "--output", help="folder of JSON and plots")] = Path(
        "characterise-output"
    ),
    pixels: Annotated[int, typer.Option(help="rows and columns of the frames")] = 256,
    steps: Annotated[int, typer.Option(help="steps of light, from dark to beyond saturation")] = 50,
    frames: Annotated[int, typer.Option(help="frames of each stack")] = 100,
    wavelength: Annotated[float, typer.Option(help="of the light, for a curve of quantum efficiency [nm]")] = 550.0,
    seed: Seed = 0,
    variant: Variant = DEFAULT_VARIANT,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Measure a camera after EMVA 1288 on simulated frames; figures found beside those that its file sets."""
    from mitsim.core.configuration import locate
    from mitsim.devices.sensor import load_sensor
    from mitsim.studies.emva_options import Procedure, capacity_of, efficiency_of
    from mitsim.studies.framework.run import check_study_folder

    sensor = load_sensor(locate(camera, "calibration", ".toml"))
    procedure = Procedure(pixels, steps, frames, seed, wavelength)
    capacity_of(sensor)
    efficiency_of(sensor, procedure)
    if sensor.quantum_efficiency_curve is None:
        refuse_unused(context, ["wavelength"], f"on {camera}, whose file has no curve of quantum efficiency")
    check_study_folder(output, "characterise")
    from mitsim.studies.characterise import characterise as run_characterise

    with job_of(quiet or as_json) as job:
        done = run_characterise(sensor, procedure, output, job)
    return finish(as_json, done.payload(), done.lines(), done.warnings)


@app.command()
def sense(
    context: typer.Context,
    image: Annotated[Path, typer.Argument(help="irradiance [W/m^2], OpenEXR or NPY", metavar="IMAGE.exr")],
    camera: Annotated[str, typer.Option("--camera", help="camera electronics: name or TOML file", metavar="NAME|FILE")],
    output: Annotated[Path, typer.Option("-o", "--output", help="frame to write", metavar="FRAME.png|exr|npy")],
    exposure: Annotated[str, typer.Option(help="seconds, or auto", metavar="auto|SECONDS")] = "auto",
    exposure_fraction: Annotated[float, typer.Option(help="brightest pixel, as a part of full well")] = 0.8,
    f_number: Annotated[
        float | None, typer.Option(help="the image is radiance [W/m^2/sr] before a lens of this f-number", metavar="N")
    ] = None,
    scale: Annotated[float, typer.Option(help="what its numbers are multiplied by")] = 1.0,
    channel: Annotated[str | None, typer.Option(help="of several channels, the one to take", metavar="NAME")] = None,
    wavelength: Annotated[float, typer.Option(help="of the light [nm]")] = 550.0,
    seed: Seed = 0,
    variant: Variant = DEFAULT_VARIANT,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Put an image of any renderer behind a camera's sensor: digital numbers with its noise."""
    from mitsim.bench.request import Exposure, check_ending, check_f_number, check_image, check_wavelength
    from mitsim.core.configuration import locate
    from mitsim.core.files import check_apart, output_file
    from mitsim.core.seeds import check_root
    from mitsim.devices.sensor import load_sensor

    sensor = load_sensor(locate(camera, "calibration", ".toml"))
    seconds = number_of("exposure", exposure)
    if seconds != "auto":
        refuse_unused(context, ["exposure_fraction"], "on an --exposure in seconds")
    asked = Exposure(None if seconds == "auto" else seconds, exposure_fraction)
    if not 0 < scale < math.inf:
        raise MitsimError(f"--scale {scale:g}: give a finite number above 0")
    check_ending(output, sensor)
    check_wavelength(wavelength)
    if f_number is not None:
        check_f_number(f_number)
    check_root(seed)
    check_image(image)
    check_apart(output, [image])
    with output_file(output, overwrite=True) as place:
        from mitsim.acquire.sense import irradiance_behind_lens, read_image
        from mitsim.acquire.sense import sense as run_sense

        light, notes = read_image(image, channel)
        light = light * scale if f_number is None else irradiance_behind_lens(light * scale, f_number)
        frame = run_sense(light, sensor, asked, seed, wavelength, notes)
        payload = {**frame.summary(), "output": str(frame.save(place))}
    lines = [
        f"{sensor.name}: {payload['shape'][0]}x{payload['shape'][1]} pixels, exposure {frame.exposure_s:.3g} s, "
        f"mean {payload['mean_dn']:.5g} DN, largest {payload['largest_dn']:.5g}: {payload['output']}",
        *frame.notes,
    ]
    return finish(as_json, payload, lines, frame.warnings)

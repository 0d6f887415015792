"""Verbs on folders and files, without a scene: images, a camera's sensor, reports, exchange and learning."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import mitsim
from mitsim.bench.request import Irradiance
from mitsim.cli.commands import Common, Limited, Overwritten, Pictured, Resumed, completing, option_name, show, verb
from mitsim.cli.screen import finish, finish_folder, finish_frame, page_line, page_of
from mitsim.core.configuration import CAMERA, DEVICES, WHAT, option, shipped_names
from mitsim.core.errors import MitsimError
from mitsim.core.manifests import JOINT, MOSAIC, RUN, SpectralFolder, check_way, is_coloured, open_lines
from mitsim.core.worker import RESUME, advise
from mitsim.devices.patterns import pattern_names
from mitsim.exchange.capture_list import FrameFacts
from mitsim.exchange.formats import Exported, Pictures
from mitsim.learn.requests import METHODS, Schedule, Training
from mitsim.reconstruct.request import MODEL, ImageRequest
from mitsim.studies.emva_options import Procedure

if TYPE_CHECKING:
    from mitsim.report.colour_image import ColourImage
    from mitsim.report.reconstruct_run import Judged

# ---- images of frames ------------------------------------------------------------------------------------------------


class ImageInputs(Overwritten):
    """What an image is made of."""

    PANEL = WHAT

    calibration: Path | None = option(None, "folder of `mitsim calibrate`; needed without --psf", metavar="CAL")
    psf: Path | None = option(
        None, "in place of a calibration: picture of the light of a scene point, of the frames' pixels", metavar="FILE"
    )
    reduce: int = option(1, "with --psf: pixels a side, of frames and picture, that become one", min=1, metavar="K")
    chart: str | None = option(
        None,
        "of a coloured run: the chart in the image that colours are fitted on, a scene's name or a file",
        metavar="NAME|FILE.json",
    )
    mosaic: str | None = option(
        None,
        "of a run behind colour filters: how its images are found",
        metavar="joint|half|demosaic",
        show_default="joint",
    )


def _method(name: str) -> Any:
    """Return a method's name, or the network in a file."""
    if not name.endswith(MODEL):
        return name
    from mitsim.learn.verbs import load_network

    return load_network(name)


@verb
def reconstruct(
    run: Annotated[Path, typer.Argument(help="folder of `mitsim capture`", metavar="RUN")],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="folder for the image; RUN/reconstruction if not given", metavar="DIR"),
    ] = None,
    *,
    asked: Annotated[ImageRequest, show(method={"read": _method})],
    inputs: Annotated[ImageInputs, show(overwrite={"help": "replace an earlier image in the folder", "panel": ""})],
    common: Pictured,
) -> int:
    """Recover the image from frames and a calibration alone.

    Of coloured folders, an image of each line, and one in colour.

    $ mitsim reconstruct run --calibration cal
    $ mitsim reconstruct run --calibration cal --method markov -o smooth
    $ mitsim reconstruct run --calibration cal --focus auto -o sharp
    """
    from mitsim.core.files import check_output
    from mitsim.core.job import memory_from_here, memory_since
    from mitsim.core.manifests import CalibrationManifest, RunManifest, read_manifest
    from mitsim.reconstruct.request import check_parallax, holds_image

    # All of it is refused before the solver is imported, which takes half a second.
    output, lines, chart = output or run / "reconstruction", open_lines(run, RUN, MOSAIC), None
    _check_inputs(lines, asked, inputs)
    for part in lines.parts.values():
        read_manifest(part, RunManifest)
    if inputs.calibration is not None:
        for name, part in lines.check_calibration(inputs.calibration).parts.items():
            manifest = read_manifest(part, CalibrationManifest)
            if asked.focus is not None or asked.margin:
                check_parallax(manifest.parallax, str(inputs.calibration / name))
    if inputs.chart is not None:
        from mitsim.devices.framelist import load_chart

        chart = load_chart(inputs.chart)
    # An image of the same inputs may be replaced, and which inputs a folder has is looked into later.
    check_output(output, overwrite=is_coloured(output) if lines.colours else holds_image(output))
    from mitsim.report import reconstruct_run

    held = memory_from_here()
    with common.job() as job:
        options = {"lam": asked.lam, "way": inputs.mosaic or JOINT} if lines.filters else asked.given
        where: Any = {"output": output, "overwrite": inputs.overwrite, "job": job, **options}
        found: Any
        calibration: Any = inputs.calibration
        if inputs.psf is not None:
            found = reconstruct_run.reconstruct_psf(run, inputs.psf, reduce=inputs.reduce, **where)
        elif lines.colours:
            found = reconstruct_run.reconstruct_colours(run, calibration, chart=chart, page=False, **where)
        else:
            found = reconstruct_run.reconstruct(run, calibration, **where)
    payload = {**found.summary(), "memory_bytes": memory_since(held)}
    shown = _colours_lines(found, common) if lines.colours else _image_lines(found, payload, common)
    return finish_folder(common, output, payload, shown, payload["warnings"])


def _check_inputs(lines: SpectralFolder, asked: ImageRequest, inputs: ImageInputs) -> None:
    """Refuse options that have no effect on a run of these ``lines``, and inputs that are missing."""
    run = lines.folder
    if inputs.psf is not None:
        inputs.refuse(["calibration", "chart", "mosaic"], "with --psf")
        if lines.colours:
            raise MitsimError(f"--psf {inputs.psf}: {run} is coloured; reconstruct one of its lines, {run}/NAME")
        asked.check_point_spread(inputs.reduce)
        if not inputs.psf.is_file():
            raise MitsimError(f"--psf {inputs.psf}: is no file; give a picture of the light of a scene point")
        return
    if inputs.reduce != 1:
        inputs.refuse(["reduce"], "without --psf")
    if inputs.calibration is None:
        raise MitsimError("--calibration: is missing; give the folder of `mitsim calibrate`, or --psf FILE")
    if not lines.colours:
        inputs.refuse(["chart", "mosaic"], f"on {run}, which is not coloured")
    elif not lines.filters:
        inputs.refuse(["mosaic"], f"on {run}, which has a run for each line")
    else:
        from mitsim.reconstruct.request import check_joint

        check_way(inputs.mosaic or JOINT)
        check_joint(asked.lam)
        for name, value in asked.without("lam").items():
            if value != ImageRequest.model_fields[name].default:
                raise MitsimError(
                    f"{option_name(name)} {value}: runs behind colour filters are solved by tikhonov at the calibrated "
                    "depth; leave it out"
                )


def _image_lines(result: Judged, payload: dict[str, Any], common: Pictured) -> list[str]:
    """Return what the terminal shows of an image, by its ``payload``."""
    image, rank = result.reconstruction, payload["rank"]
    inherits = image.status.verdict.good and not image.ok
    verdict = "Flagged" if inherits else image.status.verdict.value.capitalize()
    rank_words = "" if rank is None else f", rank {rank}, condition {payload['condition_whole']:.3g}"
    trust = "; ".join(known.gist for known in (image.uncertainties, image.misfit, image.fit) if known)
    return [
        f"{f'Flagged: {image.status.flags[0]}' if inherits else f'{image.status.sentence}.'}"
        if result.quality is None
        else f"{verdict}: {result.quality}",
        f"Image: {payload['output']}",
        *([] if payload["white"] == 1 else [f"image.png shows {payload['white']:.3g} electrons/s as white"]),
        *([] if image.focus is None else [str(image.focus)]),
        *([trust.capitalize()] if trust else []),
        *image.limits,
        *common.details(
            *([str(image.status)] if image.ok else []),  # a warning has it otherwise
            f"lambda {payload['lambda']:.3g}, residual {payload['residual']:.1e}{rank_words}",
            *image.trust,
        ),
    ]


def _colours_lines(found: ColourImage, common: Common) -> list[str]:
    """Return what the terminal shows of an image in colour."""
    verdict = "Solved" if found.ok else "Flagged"
    quality = f"PSNR {found.psnr_db:.2f} dB over all lines" if found.psnr_db is not None else "an image of every line"
    return [
        f"{verdict}: {quality}",
        f"Image: {found.output}",
        *(f"{name}: {row}" for name, row in found.table.items()),
        *(f"{text[0].upper()}{text[1:]}" for text in found.sentences),
        *common.details(*found.described),
    ]


@verb
def report(
    folder: Annotated[Path, typer.Argument(help="of capture, calibrate, reconstruct or import", metavar="FOLDER")],
    common: Common,
) -> int:
    """Make the pictures and the page of a folder again.

    From its files alone: a run, a calibration or an image.

    $ mitsim report run
    $ mitsim report cal
    """
    made = page_of(folder)
    return finish(common.as_json, {**made, "output": str(folder)}, [page_line(made)], ())


# ---- a camera's sensor alone -----------------------------------------------------------------------------------------

_CAMERA_HELP = "camera electronics: name or TOML file"
_complete_camera = completing(lambda: shipped_names(CAMERA))


@verb
def characterise(
    camera: Annotated[
        str | None,
        typer.Argument(help=_CAMERA_HELP, metavar="[CAMERA]", show_default=False, autocompletion=_complete_camera),
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="folder of page, plots, JSON and camera.toml", metavar="DIR")
    ] = Path("characterise-output"),
    frames: Annotated[
        str,
        typer.Option(
            help="frames of each stack; without CAMERA: folder of a real camera's frames under even light and in the "
            "dark",
            metavar="N|DIR",
            rich_help_panel=WHAT,
        ),
    ] = "100",
    *,
    asked: Procedure,
    common: Common,
    given: set[str],
) -> int:
    """Measure a camera after EMVA 1288, simulated or real.

    On simulated frames, beside what the camera's file sets, or on real frames (--frames DIR).

    $ mitsim characterise imx249 -o figures
    $ mitsim characterise --frames flats -o mine
    """
    if camera is None and "frames" not in given:
        raise MitsimError("characterise: got no CAMERA; give one to simulate, or --frames DIR of a real one")
    stacks = int(frames) if frames.isdecimal() and camera is not None else Path(frames)
    with common.job() as job:
        done = mitsim.characterise(camera, output, stacks, job, **asked.given)
    return finish(common.as_json, done.payload(), done.lines(), done.warnings)


@verb
def sense(
    image: Annotated[Path, typer.Argument(help="irradiance [W/m^2], OpenEXR or NPY", metavar="IMAGE.exr")],
    output: Annotated[Path, typer.Option("-o", "--output", help="frame to write", metavar="FRAME.png|exr|npy")],
    camera: Annotated[
        str,
        typer.Option(help=_CAMERA_HELP, metavar="NAME|FILE", rich_help_panel=DEVICES, autocompletion=_complete_camera),
    ],
    asked: Irradiance,
    common: Pictured,
) -> int:
    """Put an image of any renderer behind a camera's sensor.

    Out come digital numbers, with the sensor's noise.

    $ mitsim sense frame.exr --camera imx249 -o frame.png
    $ mitsim sense photo.exr --camera imx249 --f-number 2.8 -o photo.png
    """
    from mitsim.bench.request import check_ending, check_image
    from mitsim.core.configuration import locate
    from mitsim.core.files import check_apart, output_file
    from mitsim.devices.sensor import load_sensor

    asked.refuse_idle()
    sensor = load_sensor(locate(camera, "calibration", ".toml", CAMERA))
    check_ending(output, sensor)
    check_image(image)
    check_apart(output, [image])
    with output_file(output, overwrite=True) as place:
        frame = mitsim.sense(image, camera, **asked.given)
        payload = {**frame.summary(), "output": str(frame.save(place))}
    lines = [
        f"{sensor.name}: {payload['shape'][0]}x{payload['shape'][1]} pixels, exposure {frame.exposure_s:.3g} s, "
        f"mean {payload['mean_dn']:.5g} DN, largest {payload['largest_dn']:.5g}: {payload['output']}",
        *frame.notes,
    ]
    return finish_frame(common, (output, frame.digital, "DN"), payload, lines, frame.warnings)


# ---- exchange --------------------------------------------------------------------------------------------------------


@verb
def export(
    run: Annotated[Path, typer.Argument(help="folder of `mitsim capture`", metavar="RUN")],
    exported: Exported,
    common: Common,
) -> int:
    """Write a run in a format that other programs read.

    $ mitsim export run --format hdf5 -o run.h5
    $ mitsim export run --format mat -o run.mat --calibration cal
    """
    if exported.format == "png":
        exported.refuse(["overwrite"], "on a folder of pictures, which takes the place of none")
    payload = mitsim.export(run, **exported.given)
    with_it = f" with {payload['calibration']}" if payload["calibration"] else ""
    lines = [f"{payload['frames']} frames{with_it} as {exported.format}: {payload['output']}", *payload["notes"]]
    return finish(common.as_json, payload, lines, ())


@verb
def import_(
    source: Annotated[
        Path, typer.Argument(help="file of `mitsim export`, or frames: a folder of them, or one file", metavar="SOURCE")
    ],
    facts: Annotated[FrameFacts, show(seed={"default": 0}, byte_order={"default": "little"})],
    pictured: Pictured,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="run folder to make", metavar="RUN")] = None,
    calibration_output: Annotated[
        Path | None, typer.Option(help="folder to make of the file's calibration", metavar="CAL")
    ] = None,
) -> int:
    """Make a run of a real camera's frames, or of an exported file.

    $ mitsim import frames -o run --list mine.toml --calibration cal
    $ mitsim import hand.png -o hand --list diffusercam
    $ mitsim import run.h5 -o copy
    """
    from mitsim.exchange.formats import READERS

    if output is None and calibration_output is None:
        raise MitsimError("import: nothing to make; give -o RUN, --calibration-output CAL, or both")
    if source.suffix.lower() in READERS:
        facts.refuse(facts.without("channel"), f"on {source}, which says itself what its frames are")
        payload = mitsim.import_file(source, output, calibration_output, facts.channel)
    elif output is None or calibration_output is not None:
        raise MitsimError(f"{source}: frames hold no calibration; give -o RUN, and no --calibration-output")
    else:
        with pictured.job() as job:
            payload = mitsim.import_frames(source, output, job, **facts.given)
    lines = []
    if payload["output"]:
        lines.append(f"{payload['frames']} frame{'s' if payload['frames'] != 1 else ''}: {payload['output']}")
    if payload["calibration_output"]:
        lines.append(f"calibration: {payload['calibration_output']}")
    elif "calibration" in payload["holds"]:
        lines.append("The file holds a calibration too; give --calibration-output to have it")
    lines += payload.get("notes", ())
    if payload["left_out"]:
        lines.append(f"Not known, and left out: {', '.join(payload['left_out'])}")
    if payload["output"]:
        return finish_folder(pictured, Path(payload["output"]), payload, lines, payload["warnings"])
    return finish(pictured.as_json, {**payload, "report": None}, lines, payload["warnings"])


@verb
def patterns(
    family: Annotated[
        str, typer.Argument(help=f"{pattern_names()}; or stripes, those of a calibration", metavar="PATTERNS|stripes")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="folder to make", metavar="DIR")],
    asked: Annotated[Pictures, show(seed={"default": 0}, signed_capture={"default": "pair"})],
    common: Common,
) -> int:
    """Draw patterns as pictures for a real projector.

    Or a calibration's stripes, with the list that its frames need.

    $ mitsim patterns dots:7 -o pictures
    $ mitsim patterns stripes -o stripes --camera imx249 --exposure 0.02
    """
    payload, last = mitsim.pattern_pictures(family, output, **asked.given), asked.closing_frame
    if payload["session"]:
        after = (
            f"Copy {payload['session']} into the folder of their frames; then: mitsim calibrate --frames FRAMES -o CAL"
        )
    else:
        after = (
            f"Their frames are read by: mitsim import FRAMES --patterns {output / 'patterns.json'} --camera NAME "
            f"--exposure SECONDS --calibration CAL -o RUN{f' --closing-frame {last}' if last else ''}"
        )
    from mitsim.exchange.png_files import describe_cells

    where = payload["projector"]
    lines = [
        f"{payload['pictures']} pictures of {where['rows']}x{where['columns']}, {payload['n']}x{payload['n']} cells of "
        f"{describe_cells(where)}: {output}",
        after,
    ]
    return finish(common.as_json, payload, lines, ())


# ---- learning --------------------------------------------------------------------------------------------------------


@verb
def train(
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
    *,
    schedule: Schedule,
    resumed: Resumed,
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
    Training(method=method, **schedule.given)  # refused before anything is imported for it
    advise(RESUME)
    with limited.job() as job:
        made = train_model(method, pairs, output, calibration, resumed.resume, job, **schedule.given)
        payload = {**made.summary(), "seconds": job.clock.seconds()}
    lines = [
        f"{payload['model']}: {payload['weights']} weights, {made.curve[-1][0]} of {schedule.steps} steps in "
        f"{payload['seconds']['total']:.0f} s (predicted {made.predicted_seconds:.0f}): {output}",
        f"PSNR of photographs held out: {made.psnr_before_db:.2f} dB before, {made.psnr_db:.2f} dB after",
    ]
    return finish(limited.as_json, payload, lines, ())

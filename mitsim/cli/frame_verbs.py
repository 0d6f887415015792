"""Verbs on folders and files, without a scene: images, a camera's sensor, reports, exchange and learning."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import mitsim
from mitsim.bench.request import Irradiance, Procedure, check_ending, check_image
from mitsim.cli.commands import (
    Common,
    Limited,
    Pictured,
    Replaced,
    Replacing,
    Resumed,
    argument,
    command,
    option_name,
    page_line,
    page_of,
    shown,
    to_make,
)
from mitsim.cli.shelf_verbs import is_scene, list_parameters
from mitsim.core.colour_files import CALIBRATION, MOSAIC, RUN, SpectralFolder, is_coloured, open_lines
from mitsim.core.configuration import CAMERA, DEVICES, OUTPUT, WHAT, locate, option, shipped_names
from mitsim.core.errors import MitsimError
from mitsim.core.files import check_apart, check_output, output_file
from mitsim.core.job import memory_from_here, memory_since
from mitsim.core.manifests import CalibrationManifest, RunManifest, read_manifest
from mitsim.core.worker import RESUME, advise
from mitsim.devices.framelist import load_chart
from mitsim.devices.patterns import pattern_names
from mitsim.devices.sensor import load_sensor
from mitsim.exchange.capture_list import FrameFacts
from mitsim.exchange.formats import OF_FOLDERS, READERS, Exported, Pictures
from mitsim.learn.requests import METHODS, Schedule, Training
from mitsim.reconstruct.request import LIST, MODEL, ImageRequest, check_joint, check_parallax, holds_image
from mitsim.verbs import CompareOptions, load_network
from mitsim.verbs import train as train_model

if TYPE_CHECKING:
    from mitsim.report.folder_page import ColourImage
    from mitsim.report.reconstruct_run import Judged

# ---- Images of frames ------------------------------------------------------------------------------------------------


class Reconstructing(ImageRequest, Pictured):
    """Options of `mitsim reconstruct`."""

    PANEL = WHAT
    FIRST = "run output calibration"
    CHANGES = shown(method={"read": lambda name: load_network(name) if name.endswith(MODEL) else name})

    run: Path = argument(..., "run folder, of `mitsim capture` or `mitsim import`", "RUN")
    output: Path | None = to_make(None, "folder to make for the image", "DIR", show_default="RUN/reconstruction")
    calibration: Path | None = option(None, "calibration folder; required unless --psf is given", metavar="CAL")
    psf: Path | None = option(
        None,
        "measured point spread function, a picture, in place of a calibration; for coloured runs with one channel, or "
        "one for each line; or a list of pictures of several depths or places",
        metavar="FILE|LIST.toml",
    )
    reduce: int = option(1, "only with --psf: average blocks of K x K pixels", min=1, metavar="K")
    mend_psf: bool = option(False, "only with --psf: first fit scale, rotation and, under patterns, shift")
    chart: str | None = option(
        None,
        "only for coloured runs: colour chart in the image, to which the colours are fitted; name of a scene, or file",
        metavar="NAME|FILE.json",
    )
    overwrite: bool = option(False, "replace an earlier image in the folder", panel=OUTPUT)

    def check_inputs(self, lines: SpectralFolder) -> None:
        """Refuse options that have no effect on a run of these ``lines``, and inputs that are missing."""
        run = lines.folder
        if self.psf is not None:
            self.refuse(["calibration", "chart"], "with --psf")
            if lines.filters:
                raise MitsimError(f"--psf {self.psf}: {run} has the frames of a mosaic in one; use a calibration")
            self.check_point_spread(self.reduce)
            if lines.colours and self.psf.suffix.lower() == LIST:
                raise MitsimError(f"--psf {self.psf}: {run} is coloured, and lists are of one line; give a picture")
            if self.psf.suffix.lower() == LIST:
                self.refuse(["mend_psf"], "with a list of point spread functions")
            if not self.psf.is_file():
                raise MitsimError(f"--psf {self.psf}: is no file; give a picture of the light of a scene point")
            return
        if self.reduce != 1 or self.mend_psf:
            self.refuse(["reduce", "mend_psf"], "without --psf")
        if self.calibration is None:
            raise MitsimError("--calibration: is missing; give the folder of `mitsim calibrate`, or --psf FILE")
        if not lines.colours:
            self.refuse(["chart"], f"on {run}, which is not coloured")
        elif lines.filters:
            check_joint(self.lam)
            for name, value in self.given_of(ImageRequest).items():
                if name != "lam" and value != ImageRequest.model_fields[name].default:
                    raise MitsimError(
                        f"{option_name(name)} {value}: runs behind colour filters are solved by tikhonov at the "
                        "calibrated depth; leave it out"
                    )


@command
def reconstruct(asked: Reconstructing) -> int:
    """Compute the image from frames and a calibration.

    A coloured run gives one image for each spectral line, and one in colour.

    $ mitsim reconstruct run --calibration cal
    $ mitsim reconstruct run --calibration cal --method markov -o smooth
    $ mitsim reconstruct run --calibration cal --focus auto -o sharp
    """
    # All of it is refused before the solver is imported, which takes half a second.
    run, output, lines = asked.run, asked.output or asked.run / "reconstruction", open_lines(asked.run, RUN, MOSAIC)
    calibration: Any = asked.calibration
    chart = None
    asked.check_inputs(lines)
    for part in lines.parts.values():
        read_manifest(part, RunManifest)
    if calibration is not None:
        for name, part in lines.check_calibration(calibration).parts.items():
            manifest = read_manifest(part, CalibrationManifest)
            if asked.focus is not None:
                check_parallax(manifest.parallax, str(calibration / name))
    if asked.chart is not None:
        chart = load_chart(asked.chart)
    # An image of the same inputs may be replaced, and which inputs a folder has is looked into later.
    check_output(output, overwrite=is_coloured(output) if lines.colours else holds_image(output))
    from mitsim.report import reconstruct_run

    held = memory_from_here()
    with asked.job() as job:
        options = asked.given_of(ImageRequest)
        if lines.filters:
            options = {"lam": asked.lam}
        where: Any = {"output": output, "overwrite": asked.overwrite, "job": job, **options}
        spread: Any = {"reduce": asked.reduce, "mend": asked.mend_psf}
        found: Any
        if asked.psf is not None and lines.colours:
            found = reconstruct_run.reconstruct_colours(run, asked.psf, page=False, **spread, **where)
        elif asked.psf is not None:
            found = reconstruct_run.reconstruct_psf(run, asked.psf, **spread, **where)
        elif lines.colours:
            found = reconstruct_run.reconstruct_colours(run, calibration, chart=chart, page=False, **where)
        else:
            found = reconstruct_run.reconstruct(run, calibration, **where)
    payload = {**found.summary(), "memory_bytes": memory_since(held)}
    shown = _colours_lines(found, asked) if lines.colours else _image_lines(found, payload, asked)
    return asked.finish_folder(output, payload, shown)


def _image_lines(result: Judged, payload: dict[str, Any], common: Pictured) -> list[str]:
    image, rank = result.reconstruction, payload["rank"]
    rank_words = "" if rank is None else f", rank {rank}, condition {payload['condition_whole']:.3g}"
    quality = str(result.quality or "").partition(", ")[2]  # its PSNR is in the headline
    trust = "; ".join(known.gist for known in (image.uncertainties, image.misfit, image.fit) if known)
    partly = image.ok and image.status.remedy
    return [
        f"Image: {payload['output']}",
        *([f"{image.status.sentence}; {image.status.remedy}"] if partly else []),
        *([] if payload["white"] == 1 else [f"image.png shows {payload['white']:.3g} electrons/s as white"]),
        *([] if image.focus is None else [str(image.focus)]),
        *([quality] if quality else []),
        *([trust.capitalize()] if trust else []),
        *image.limits,
        *common.details(
            *([image.status.figures] if image.status.figures else []),
            f"lambda {payload['lambda']:.3g}, residual {payload['residual']:.1e}{rank_words}",
            *image.trust,
        ),
    ]


def _colours_lines(found: ColourImage, common: Pictured) -> list[str]:
    return [
        f"Image: {found.output}",
        *(f"{name}: {row}" for name, row in found.table.items()),
        *found.sentences,
        *common.details(*found.described),
    ]


class Comparing(CompareOptions, Common):
    """Options of `mitsim compare`."""

    images: list[str] = argument(
        ..., "two or more folders of reconstruct or run, or pictures (EXR, PNG, TIFF, NPY); the first is compared with",
        "RUN|IMAGE...", kind=list[str],
    )  # fmt: skip
    output: Path = to_make(..., "folder to make for page, figures and compare.json", "DIR")


@command
def compare(asked: Comparing) -> int:
    """Compare images side by side, with difference maps, PSNR and SSIM.

    On one scale, with the truth if the folders' runs have it.

    $ mitsim compare run smooth -o beside
    $ mitsim compare run other.npy -o figures --style paper
    """
    return asked.call(mitsim.compare, asked.images, asked.output, **asked.given_of(CompareOptions))


class Reporting(Common):
    """Options of `mitsim report`."""

    folder: Path = argument(..., "folder that capture, calibrate, reconstruct or import made", "FOLDER")


@command
def report(asked: Reporting) -> int:
    """Make the pictures and the page of a folder again.

    Only the files of the folder are read. It holds a run, a calibration or an image.

    $ mitsim report run
    $ mitsim report cal
    """
    made = page_of(asked.folder)
    return asked.finish({**made, "output": str(asked.folder)}, [page_line(made)])


class ShowingFolder(Common):
    """Options of `mitsim show`."""

    folder: Path = argument(..., "folder of any command, or a scene", "FOLDER|SCENE")


@command
def show(asked: ShowingFolder) -> int:
    """Describe a folder of results, or the parameters of a scene.

    Only its JSON files are read. The status is 1 if the folder is flagged, or its work was interrupted.

    $ mitsim show run
    $ mitsim show lamp_bench
    """
    if is_scene(str(asked.folder)):
        return list_parameters(str(asked.folder), asked)
    found = mitsim.show(asked.folder)
    return asked.finish(vars(found), found.lines(), found.warnings)


# ---- A camera's sensor alone -----------------------------------------------------------------------------------------

_CAMERA: dict[str, Any] = {"help": "camera: shipped name, or TOML file", "complete": lambda: shipped_names(CAMERA)}


class Characterising(Procedure, Replacing, Common):
    """Options of `mitsim characterise`."""

    camera: str | None = argument(None, metavar="[CAMERA]", show_default=False, **_CAMERA)
    output: Path = to_make(Path("characterise-output"), "folder to make; an earlier result is replaced", "DIR")
    stacks: str | None = option(
        None,
        "folder of a real camera's frames, in uniform light and in the dark",
        "--frames",
        metavar="DIR",
        panel=WHAT,
    )
    stack_size: int | None = option(None, "frames in each simulated stack; default: 100", panel=WHAT, ge=2, le=10_000)


@command
def characterise(asked: Characterising) -> int:
    """Measure a simulated or real camera by the standard EMVA 1288.

    With CAMERA, frames are simulated, and the results are compared with the camera's file. With --frames DIR, a real
    camera is measured.

    $ mitsim characterise imx249 -o figures
    $ mitsim characterise --frames flats -o mine
    """
    frames: int | Path = asked.stack_size or 100
    if asked.stacks is not None:
        asked.refuse(["stack_size"], "with --frames")
        simulated = asked.stacks.isdecimal() and asked.camera is not None  # --frames N, the earlier --stack-size N
        frames = int(asked.stacks) if simulated else Path(asked.stacks)
    elif asked.camera is None:
        raise MitsimError("characterise: got no CAMERA; name one to simulate, or give --frames DIR of a real one")
    return asked.call(mitsim.characterise, asked.camera, asked.output, frames, **asked.given_of(Procedure))


class Sensing(Irradiance, Replacing, Pictured):
    """Options of `mitsim sense`."""

    FIRST = "image output camera exposure exposure_fraction"

    image: Path = argument(..., "image of irradiance [W/m^2], OpenEXR or NPY", "IMAGE.exr")
    output: Path = to_make(..., "frame to write; an existing file is replaced", "FRAME.png|exr|npy")
    camera: str = option(..., metavar="NAME|FILE", panel=DEVICES, **_CAMERA)


@command
def sense(asked: Sensing) -> int:
    """Convert irradiance to the noisy digital numbers of a camera.

    The image may come from any renderer.

    $ mitsim sense frame.exr --camera imx249 -o frame.png
    $ mitsim sense photo.exr --camera imx249 --f-number 2.8 -o photo.png
    """
    asked.refuse_idle()
    sensor = load_sensor(locate(asked.camera, "calibration", ".toml", CAMERA))
    check_ending(asked.output, sensor)
    check_image(asked.image)
    check_apart(asked.output, [asked.image])
    with output_file(asked.output, overwrite=True) as place:
        frame = mitsim.sense(asked.image, asked.camera, **asked.given_of(Irradiance))
        payload = {**frame.summary(), "output": str(frame.save(place))}
    lines = [
        f"{sensor.name}: {payload['shape'][0]}x{payload['shape'][1]} pixels, exposure {frame.exposure_s:.3g} s, "
        f"mean {payload['mean_dn']:.5g} DN, largest {payload['largest_dn']:.5g}: {payload['output']}",
        *frame.notes,
    ]
    return asked.finish_frame((asked.output, frame.digital, "DN"), payload, lines)


# ---- Exchange --------------------------------------------------------------------------------------------------------


class Exporting(Exported, Common):
    """Options of `mitsim export`."""

    run: Path = argument(
        ..., "run folder, of `mitsim capture` or `mitsim import`; for a dataset, of `mitsim pairs`", "RUN"
    )


@command
def export(asked: Exporting) -> int:
    """Convert a run, or pairs, to files that other programs read.

    $ mitsim export run --format hdf5 -o run.h5
    $ mitsim export run --format mat -o run.mat --calibration cal
    $ mitsim export pairs --format dataset -o dataset --calibration cal
    """
    if asked.format in OF_FOLDERS:
        asked.refuse(["overwrite"], f"with {asked.format}, which never replaces a folder")
    payload = mitsim.export(asked.run, **asked.given_of(Exported))
    with_it = f" with {payload['calibration']}" if payload["calibration"] else ""
    number = f"{payload['frames']} frames" if payload["pairs"] is None else f"{payload['pairs']} pairs"
    lines = [f"{number}{with_it} as {asked.format}: {payload['output']}", *payload["notes"]]
    return asked.finish(payload, lines)


class Importing(FrameFacts, Replaced, Pictured):
    """Options of `mitsim import`."""

    FIRST = "source list"
    MARKS = (*Replaced.MARKS, "calibration", CALIBRATION)
    CHANGES = shown(seed={"default": 0}, byte_order={"default": "little"})

    source: Path = argument(..., "folder of frames, or one frame; or an exported file", "SOURCE")
    output: Path | None = to_make(None, "folder to make for the run", "RUN")
    calibration_output: Path | None = option(
        None, "folder to make for the calibration that the file holds", metavar="CAL", panel="An exported file"
    )


@command
def import_(asked: Importing) -> int:
    """Make a run from a real camera's frames or an exported file.

    A real camera's frames are a folder of pictures, or one picture. Options, or a list, state what the pictures do not:
    camera, exposure, patterns, and the calibration that they are to be reconstructed with.

    An exported file ends in .h5, .hdf5 or .mat, and states all of this itself.

    $ mitsim import frames -o run --list mine.toml --calibration cal
    $ mitsim import hand.png -o hand --list diffusercam
    $ mitsim import point --point -o psf.npy --list diffusercam --dark-frame dark
    $ mitsim import run.h5 -o copy --calibration-output cal
    """
    source, output, calibration = asked.source, asked.output, asked.calibration_output
    facts = asked.given_of(FrameFacts)
    if output is None and calibration is None:
        raise MitsimError("import: nothing to make; give -o RUN, --calibration-output CAL, or both")
    if source.suffix.lower() in READERS:
        asked.refuse([name for name in facts if name != "channel"], f"on {source}, which states these facts itself")
        payload = mitsim.import_file(source, output, calibration, asked.channel)
    elif output is None or calibration is not None:
        raise MitsimError(f"{source}: frames contain no calibration; give -o RUN, and leave out --calibration-output")
    else:
        with asked.job() as job:
            payload = mitsim.import_frames(source, output, job, overwrite=asked.overwrite, **facts)
    if payload["holds"] == ["psf"]:
        import numpy as np

        light = np.atleast_3d(np.load(payload["output"])).mean(axis=2)
        lines = [payload["headline"], f"Point spread function: {output}", *payload["notes"]]
        return asked.finish_frame((Path(payload["output"]), light, "electrons/s"), {**payload, "report": None}, lines)
    lines = [f"Run: {payload['output']}"] if payload["output"] else []
    if payload["calibration_output"]:
        lines.append(f"Calibration: {payload['calibration_output']}")
    elif "calibration" in payload["holds"]:
        lines.append("The file also contains a calibration; write it with --calibration-output CAL")
    lines += payload.get("notes", ())
    if payload["left_out"]:
        lines.append(f"Not known, and left out: {', '.join(payload['left_out'])}")
    if payload["output"]:
        return asked.finish_folder(Path(payload["output"]), payload, lines)
    return asked.finish({**payload, "report": None}, [payload["headline"], *lines], payload["warnings"])


class Drawing(Pictures, Replaced, Common):
    """Options of `mitsim patterns`."""

    CHANGES = shown(seed={"default": 0}, signed_capture={"default": "pair"})
    MARKS = ("patterns.json",)

    family: str = argument(..., f"{pattern_names()}; or stripes, for a calibration session", "PATTERNS|stripes")
    output: Path = to_make(..., "folder to make for the pictures", "DIR")


@command
def patterns(asked: Drawing) -> int:
    """Draw patterns as pictures to show with a real projector.

    With stripes, the pictures of a calibration session are drawn, with the session file that their frames need.

    $ mitsim patterns dots:7 -o pictures
    $ mitsim patterns stripes -o stripes --camera imx249 --exposure 0.02
    """
    payload = mitsim.pattern_pictures(asked.family, asked.output, **asked.given_of(Pictures))
    last = f" --closing-frame {asked.closing_frame}" if asked.closing_frame else ""
    after = (
        "Import the frames that the camera records with: mitsim import FRAMES --patterns "
        f"{asked.output / 'patterns.json'} --camera NAME --exposure SECONDS --calibration CAL -o RUN{last}"
    )
    if session := payload["session"]:
        after = f"Copy {session} into the folder of their frames; then: mitsim calibrate --frames FRAMES -o CAL"
    from mitsim.exchange.other_programs import describe_cells

    where = payload["projector"]
    lines = [
        f"{payload['pictures']} pictures of {where['rows']}x{where['columns']}, {payload['n']}x{payload['n']} cells of "
        f"{describe_cells(where)}: {asked.output}",
        after,
    ]
    return asked.finish(payload, lines)


# ---- Learning --------------------------------------------------------------------------------------------------------


class Learning(Schedule, Resumed, Replaced, Limited):
    """Options of `mitsim train`."""

    FIRST = "method pairs output calibration"

    method: str = argument(..., f"{', '.join(METHODS[:-1])} or {METHODS[-1]}", "METHOD", complete=lambda: METHODS)
    pairs: Path = argument(..., "folder with training pairs, of `mitsim pairs`", "PAIRS")
    output: Path = to_make(..., "file to write the trained network to", "MODEL.pt")
    calibration: Path | None = option(
        None, "calibration folder of the pairs' camera", metavar="CAL", show_default="PAIRS/calibration", panel=WHAT
    )


@command
def train(asked: Learning) -> int:
    """Train a network that computes images from frames.

    The network is then used with `mitsim reconstruct --method MODEL.pt`. This needs torch: pip install 'mitsim[learn]'.

    $ mitsim train unrolled pairs -o model.pt
    $ mitsim reconstruct run --calibration cal --method model.pt
    """
    output, schedule = asked.output, asked.given_of(Schedule)
    if output.suffix != MODEL:
        raise MitsimError(f"--output {output}: a trained network is a file that ends in {MODEL}; give such a name")
    Training(method=asked.method, **schedule)  # refused before anything is imported for it
    advise(RESUME)
    with asked.job() as job:
        where = asked.pairs, output, asked.calibration, asked.overwrite
        made = train_model(asked.method, *where, resume=asked.resume, job=job, **schedule)
        payload = {**made.summary(), "seconds": job.clock.seconds()}
    lines = [
        f"{payload['model']}: {payload['weights']} weights, {made.curve[-1][0]} of {asked.steps} steps in "
        f"{payload['seconds']['total']:.0f} s (predicted {made.predicted_seconds:.0f}): {output}",
        f"PSNR of photographs held out: {made.psnr_before_db:.2f} dB before, {made.psnr_db:.2f} dB after",
    ]
    return asked.finish(payload, lines)

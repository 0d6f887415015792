"""A folder that mitsim wrote in, its pictures and its page out: of a run, a calibration, an image, and those by line.

Only the folder's own files are read; an image's truth is taken from its run, as long as that is where it was.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.exr import finite_channel, read_frame
from mitsim.core.files import PAGE, PICTURES, output_folder, prepare_output, read_json, remove_page, write_text
from mitsim.core.job import size_text
from mitsim.core.manifests import MANIFEST, CalibrationManifest, read_manifest
from mitsim.core.recorders import TRUTH
from mitsim.core.runs import Capture, load_run
from mitsim.core.spectral_manifests import CALIBRATION, COLOUR, RUN, is_coloured, is_mosaic, read_colours, read_mosaic
from mitsim.metrics import truth_for
from mitsim.reconstruct.factors import load_calibration
from mitsim.reconstruct.reconstruct import DEPTH_FILE, MADE_OF, POINT_SPREAD, UNCERTAINTY_FILE, read_result
from mitsim.reconstruct.request import IMAGE_FILE, RESULT_FILE
from mitsim.report.folder_pictures import REFLECTANCE, Picture, Scale, contact_sheet, error_picture
from mitsim.report.pages import render_page
from mitsim.report.parts import PlanChart, lines_of, plan_rows, stages_of, total_of

_ELSEWHERE = {
    *("kind", "format", "status", "configuration", "configuration_sha256", "checksums", "patterns", "plan"),
    *("seconds", "warnings", "versions", "command", "kernels", "result", "estimate", "verdict", "camera"),
    "opened",
}
"""Keys of a manifest that are no lines of the table of numbers: they stand elsewhere on the page, or for programs."""

_TRUTH = "what a perfect image shows: of each projector pixel what it lights, black where that is not seen"
_MISFIT = 2.0
"""Chi-square a datum that is white at least: chance alone, some hundredths about 1, would fill any smaller scale."""


@dataclass(frozen=True)
class Shown:
    """What the page of a folder shows.

    Attributes
    ----------
    kind
        of folder, in a word.
    verdict, detail
        a line, and what there is to add.
    warnings
        why it is flagged.
    command
        that made it; None: nobody says.
    pictures
        of it, in order.
    plan
        as bars; None where there is none.
    seconds, kernels
        by stage; number and seconds of kernels that were compiled.
    numbers, camera, configuration, versions
        lines of tables, by name.
    parts
        what is shown of the folders in it, by their names, each with a page of its own.
    """

    kind: str
    verdict: str
    detail: str = ""
    warnings: tuple[str, ...] = ()
    command: str | None = None
    pictures: tuple[Picture, ...] = ()
    plan: PlanChart | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    kernels: Mapping[str, float] = field(default_factory=dict)
    numbers: Mapping[str, str] = field(default_factory=dict)
    camera: Mapping[str, str] = field(default_factory=dict)
    configuration: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    parts: Mapping[str, Shown] = field(default_factory=dict)


def write_folder(folder: Path) -> Path:
    """Write the pictures and the page of a ``folder``, and of those of lines and depths in it; the page's path.

    MitsimError for a folder that holds no run, calibration or image, or that cannot be written.
    """
    _write(folder, _content(folder))
    return folder / PAGE


def _write(folder: Path, shown: Shown) -> None:
    """Pictures and page of a folder, and of those in it, whose pages come first."""
    for name, part in shown.parts.items():
        _write(folder / name, part)
    with output_folder(folder, overwrite=True):
        write_page(folder, shown.pictures, "folder.html", page=shown, images=[*_images_in(folder)])


def write_page(folder: Path, pictures: tuple[Picture, ...], template: str, **shown: Any) -> None:
    """Write pictures and page to a folder that this process holds: the page last, as it says that all is there.

    Parameters
    ----------
    folder
        it is of.
    pictures
        of it.
    template, shown
        of the page, and what it shows.
    """
    remove_page(folder)
    text = render_page(
        template, pictures=pictures, folder=folder.absolute(), stages_of=stages_of, total_of=total_of, **shown
    )
    try:
        if pictures:
            prepare_output(folder / PICTURES, overwrite=True)
        for picture in pictures:
            picture.write(folder / PICTURES)
        write_text(folder / PAGE, text)
    except BaseException:
        remove_page(folder)
        raise


def _images_in(folder: Path) -> Iterator[str]:
    """Names of folders of images in a ``folder`` of frames."""
    for path in sorted(folder.iterdir()):
        if (path / IMAGE_FILE).is_file() and (path / PAGE).is_file():
            yield path.name


def _content(folder: Path) -> Shown:
    """What the page of a ``folder`` shows, by the kind of its files."""
    if is_coloured(folder) and not is_mosaic(folder):
        kind = read_json(folder / COLOUR).get("kind")
        return _of_parts(folder, read_colours(folder, CALIBRATION if kind == CALIBRATION else RUN).names, "line")
    if (folder / MANIFEST).is_file():
        kind = read_json(folder / MANIFEST)
        calibrated = isinstance(kind, dict) and kind.get("kind") == "calibration"
        return _of_calibration(folder) if calibrated else _of_run(folder)
    if (folder / IMAGE_FILE).is_file() and (folder / RESULT_FILE).is_file():
        return _of_image(folder)
    depths = sorted((path.name for path in folder.iterdir() if (path / MANIFEST).is_file()), key=_number)
    if depths and all(_number(name) < np.inf for name in depths):
        return _of_parts(folder, depths, "depth", " mm")
    raise MitsimError(
        f"{folder}: holds no run, calibration or image; give a folder of mitsim capture, calibrate, reconstruct or "
        "import (studies and the demo write their page as they run)"
    )


def _number(name: str) -> float:
    try:
        return float(name)
    except ValueError:
        return float("inf")


# ---- Runs ----


def _of_run(folder: Path) -> Shown:
    shots = load_run(folder)
    manifest, taken = shots.manifest, shots.manifest.patterns
    plan = manifest.plan or {}
    accuracy = plan.get("accuracy")
    accuracy = accuracy if isinstance(accuracy, float) else None
    rows = plan_rows(plan)
    first = shots.read(taken.captures[0].file)[0]["DN"]
    error = manifest.total_error_bound
    known = "" if error is None else f", error at most {error:.1e}"
    asked = "" if error is None or accuracy is None else f"accuracy {accuracy:g} asked for, "
    return Shown(
        kind="Capture",
        verdict=f"{len(taken.captures)} frame{'s' if len(taken.captures) > 1 else ''}{known}",
        detail=f"{first.shape[0]} x {first.shape[1]} pixels, patterns {taken.family or 'from elsewhere'}, {asked}"
        f"exposure {shots.exposure_s:.3g} s a frame",
        warnings=manifest.warnings,
        command=manifest.command,
        pictures=tuple(_run_pictures(shots)),
        plan=PlanChart.of(rows, accuracy) if rows else None,
        seconds=manifest.seconds,
        kernels=manifest.kernels,
        numbers={
            **lines_of({"patterns": {"family": taken.family, "n": taken.n, "frames": len(taken.captures)}}),
            **_numbers(manifest.model_dump(), folder),
        },
        camera=lines_of(manifest.camera),
        configuration=lines_of(manifest.configuration),
        versions=manifest.versions,
    )


def _run_pictures(shots: Capture) -> Iterator[Picture]:
    files, left = shots.manifest.patterns.captures, shots.patterns[0]
    black = shots.manifest.digital.black_level_dn

    def read(number: int) -> FloatArray:
        """Frame of that number, less the black level [DN]."""
        return np.asarray(shots.read(files[number].file)[0]["DN"] - np.float64(black))

    first = read(0)
    yield contact_sheet(read, len(files), first.shape, max(len(files) // left.shape[1], 1))
    if len(files) > 1:
        yield Picture.of("frame", f"One of them, {files[0].file}", first, Scale.of(first, _ABOVE_BLACK, 0.0))
    titles = {"ambient": "Projector off: what is taken off", "closing": "Closing frame: no part of the image"}
    for kind, name in shots.manifest.others.items():
        frame = np.asarray(shots.read(name)[0]["DN"] - np.float64(black))
        yield Picture.of(kind, titles[kind], frame, Scale.of(frame, _ABOVE_BLACK, 0.0), name)
    if shots.truth is not None:
        yield Picture.of("truth", "The truth", shots.truth, REFLECTANCE, _TRUTH)
    if shots.folder is not None and is_mosaic(shots.folder):
        for name in read_mosaic(shots.folder).names:
            if (path := shots.folder / name / TRUTH).is_file():
                truth = finite_channel(read_frame(path)[0], "reflectance", path)
                yield Picture.of(f"truth_{name}", f"The truth at {name}", truth, REFLECTANCE)


_ABOVE_BLACK = "DN above the black level"


def _numbers(manifest: Mapping[str, Any], folder: Path) -> dict[str, str]:
    """Lines of the table of numbers, of a ``manifest`` and of the sizes in its ``folder``."""
    files = [path for path in folder.iterdir() if path.is_file() and path.name != PAGE]
    sizes = f"{len(files)}, {size_text(sum(path.stat().st_size for path in files))}"
    return {**lines_of({key: value for key, value in manifest.items() if key not in _ELSEWHERE}), "files": sizes}


# ---- Calibrations ----


def _of_calibration(folder: Path) -> Shown:
    factors = load_calibration(folder)
    manifest, result = factors.manifest, factors.manifest.result
    errors = (result.get(name) for name in ("phi_error", "predicted_phi_error"))
    error = next((value for value in errors if isinstance(value, float)), None)
    verdict = (manifest.verdict or "a calibration").capitalize()
    verdict = f"Flagged. {verdict}" if manifest.warnings else verdict
    seconds, kernels = result.get("seconds"), result.get("kernels")
    sides = {"left": (factors.left, "rows"), "right": (factors.right, "columns")}
    return Shown(
        kind="Calibration",
        verdict=verdict if error is None else f"{verdict}, factor error {error:.1e}",
        detail="" if manifest.estimate in manifest.warnings else manifest.estimate or "",
        warnings=manifest.warnings,
        command=manifest.command,
        pictures=tuple(
            Picture.of(
                name,
                f"The {name} factor, of {axis}",
                side.T,
                Scale.of(side, "sqrt(electrons/s)"),
                f"{side.shape[1]} projector {axis} (down) x {side.shape[0]} sensor {axis} (across)",
                wide=True,
            )
            for name, (side, axis) in sides.items()
        ),
        seconds=_by_stage(seconds),
        kernels=_by_stage(kernels),
        numbers={
            **lines_of({key: value for key, value in result.items() if key not in _ELSEWHERE}),
            **_numbers(manifest.model_dump(), folder),
        },
        camera=lines_of(manifest.camera),
        configuration=lines_of(manifest.configuration),
        versions=manifest.versions,
    )


def _by_stage(data: Any) -> dict[str, float]:
    """Those of some ``data`` that are numbers, by name: others may have written them."""
    listed = data.items() if isinstance(data, Mapping) else ()
    return {name: value for name, value in listed if isinstance(value, (int, float))}


# ---- Images ----


def _of_image(folder: Path) -> Shown:
    result = read_result(folder)
    image = finite_channel(read_frame(folder / IMAGE_FILE)[0], "reflectance", folder / IMAGE_FILE)
    truth, quality = truth_of(result), result.get("psnr")
    similar = result.get("ssim")
    known = [f"PSNR {quality:.1f} dB"] if isinstance(quality, float) else ["An image, and no truth to judge it by"]
    known += [f"SSIM {similar:.3f}"] if isinstance(similar, float) else []
    warnings = result.get("warnings") or ()
    inputs = result.get("inputs") if isinstance(result.get("inputs"), dict) else {}
    numbers = {key: value for key, value in result.items() if key not in {*_ELSEWHERE, "inputs", MADE_OF}}
    return Shown(
        kind="Image",
        verdict=("Flagged. " if warnings else "") + ", ".join(known),
        detail="" if warnings else str(result.get("status", "")),
        warnings=tuple(map(str, warnings)),
        command=result.get("command"),
        pictures=tuple(_image_pictures(folder, result, image, truth)),
        seconds=_by_stage(result.get("seconds")),
        numbers=lines_of(numbers),
        configuration=lines_of({"inputs": inputs, MADE_OF: result.get(MADE_OF) or {}}),
    )


def _image_pictures(
    folder: Path, result: Mapping[str, Any], image: FloatArray, truth: FloatArray | None
) -> Iterator[Picture]:
    """Of an ``image`` in a ``folder``, by its ``result``, and of its ``truth``, where that is known."""
    by_spread = POINT_SPREAD in (result.get("inputs") or {})
    white = result.get("white")
    scale = Scale(0.0, white, "electrons/s") if by_spread and isinstance(white, float) else REFLECTANCE
    yield Picture.of("image", "The image", image, scale, f"{image.shape[0]} x {image.shape[1]} projector pixels")
    if truth is not None and truth.shape == image.shape:
        yield Picture.of("truth", "The truth", truth, REFLECTANCE, _TRUTH)
        yield error_picture(image, truth)
    if (path := folder / UNCERTAINTY_FILE).is_file():
        values = finite_channel(read_frame(path)[0], "uncertainty", path)
        about = "standard uncertainty that the image states of each pixel"
        yield Picture.of("uncertainty", "How far to trust it", values, Scale.of(values, REFLECTANCE.unit, 0.0), about)
    if (path := folder / DEPTH_FILE).is_file():
        channels = read_frame(path)[0]
        for name, channel, unit, title in (
            ("depth", "depth_mm", "mm", "Depth of each pixel"),
            ("confidence", "confidence", "(1: certain)", "How sure the depth is"),
        ):
            values = finite_channel(channels, channel, path)
            scale = Scale.of(values, unit) if name == "depth" else Scale(0.0, 1.0, unit)
            yield Picture.of(name, title, values, scale)
    misfit = result.get("misfit")
    tiles = np.array(misfit.get("map", []) if isinstance(misfit, dict) else [], dtype=np.float64)
    if tiles.ndim == 2 and tiles.size > 1 and np.isfinite(tiles).all():
        about = "chi-square a datum by place on the sensor, 1 where only noise is left"
        scale = Scale(0.0, max(float(tiles.max()), _MISFIT), "a datum")
        yield Picture.of("misfit", "Where the frames do not fit", tiles, scale, about)


def truth_of(result: Mapping[str, Any]) -> FloatArray | None:
    """The truth that an image was compared with, while its run and calibration are where they were; None where they are
    not, or have changed.

    Parameters
    ----------
    result
        what result.json holds.
    """
    made_of, inputs = result.get(MADE_OF), result.get("inputs")
    if not isinstance(made_of, dict) or not isinstance(inputs, dict):
        return None
    try:
        run, calibration = (Path(str(made_of[name])) for name in ("run", "calibration"))
        shots, board = load_run(run), read_manifest(calibration, CalibrationManifest).board_reflectance
        return truth_for(shots, board) if shots.fingerprint == inputs.get("run") else None
    except (KeyError, MitsimError):
        return None


# ---- Folders of several ----


def _of_parts(folder: Path, names: Sequence[str], axis: str, unit: str = "") -> Shown:
    """Of a ``folder`` of those ``names``, each a value of an ``axis`` in a ``unit``."""
    parts = {name: _content(folder / name) for name in names}
    first = next(iter(parts.values()))
    return Shown(
        kind=f"{first.kind} by {axis}",
        verdict=f"{len(parts)} {axis}{'s' if len(parts) > 1 else ''}: {', '.join(parts)}{unit}",
        warnings=tuple(f"{name}: {text}" for name, part in parts.items() for text in part.warnings),
        command=first.command,
        seconds=next(reversed(parts.values())).seconds,
        versions=first.versions,
        parts=parts,
    )

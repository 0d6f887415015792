"""`mitsim report`: pictures and a page of a run, a calibration or an image, from its folder's files alone.

The truth of an image is read from its run, if the run is still in its place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import validate
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError, check_arguments
from mitsim.core.exr import finite_channel, read_frame, verify_files
from mitsim.core.files import PAGE, PICTURES, output_folder, prepare_output, read_json, remove_page, write_text
from mitsim.core.images import lightness, png
from mitsim.core.job import size_text
from mitsim.core.manifests import (
    CALIBRATION,
    COLOUR,
    IMAGE,
    MANIFEST,
    MOSAIC,
    RUN,
    CalibrationManifest,
    SpectralFolder,
    open_lines,
    read_manifest,
)
from mitsim.core.runs import TRUTH, load_mosaic, load_run
from mitsim.devices.framelist import ChartPlace
from mitsim.metrics import Quality, truth_for
from mitsim.reconstruct.colour import chart, linear_srgb
from mitsim.reconstruct.factors import load_calibration
from mitsim.reconstruct.reconstruct import DEPTH_FILE, MADE_OF, POINT_SPREAD, UNCERTAINTY_FILE, read_result
from mitsim.reconstruct.request import IMAGE_FILE, RESULT_FILE
from mitsim.report.colour_image import ColourImage
from mitsim.report.pages import (
    LARGEST,
    REFLECTANCE,
    SMALLEST,
    Picture,
    Scale,
    contact_sheet,
    lines_of,
    plan_rows,
    render_page,
    stages_of,
    total_of,
)

_ELSEWHERE = {
    *("kind", "format", "status", "configuration", "configuration_sha256", "checksums", "patterns", "plan"),
    *("seconds", "warnings", "versions", "command", "kernels", "result", "estimate", "verdict", "camera"),
    *("opened", "inputs", MADE_OF),
}
"""Keys of a manifest or result outside the table of numbers."""
_TRUTH = "what a perfect image shows: of each projector pixel what it lights, black where that is not seen"
_MISFIT = 2.0
"""Least chi-square that is white, so that chance fills no scale."""
_SHOWN_PERCENT = 99.0
"""Part of the errors within the scale of their picture."""


Shown = dict[str, Any]
"""Content of a folder's page: variables of its template, of which `parts` are pages of the folders in it."""


def _shown(kind: str, verdict: str, **more: Any) -> Shown:
    absent = {"detail": "", "command": None, "accuracy": None, "colours": None, "plan": (), "pictures": ()}
    tables: Shown = {"warnings": (), "seconds": {}, "kernels": {}, "tables": {}, "parts": {}, "facts": {}}
    return {"kind": kind, "verdict": verdict, **absent, **tables, **more}


@check_arguments
def report_folder(folder: Path | str) -> Path:
    """Write the pictures and the page of a folder, from its own files alone, in place of earlier ones.

    Parameters
    ----------
    folder
        A folder of ``mitsim capture``, ``calibrate``, ``reconstruct`` or ``import``, or one that Python saved.

    Returns
    -------
    Path
        The page, ``report.html``; its pictures are in the folder ``pictures`` beside it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise MitsimError(f"{folder}: no such folder; give one of mitsim capture, calibrate, reconstruct or import")
    _write(folder, _content(folder))
    return folder / PAGE


def _write(folder: Path, shown: Shown) -> None:
    """Write pictures and pages, the folder's own page last, because it marks completion."""
    for name, part in shown["parts"].items():
        _write(folder / name, part)
    with output_folder(folder, overwrite=True):
        remove_page(folder)
        images = [path.name for path in sorted(folder.iterdir()) if (path / IMAGE_FILE).is_file()]
        text = render_page(
            "folder.html",
            page=shown,
            folder=folder.absolute(),
            images=[name for name in images if (folder / name / PAGE).is_file() and name not in shown["parts"]],
            stages=stages_of(shown["seconds"]),
            total=total_of(shown["seconds"]),
        )
        try:
            if shown["pictures"]:
                prepare_output(folder / PICTURES, overwrite=True)
            for picture in shown["pictures"]:
                picture.write(folder / PICTURES)
            write_text(folder / PAGE, text)
        except BaseException:
            remove_page(folder)
            raise


def _content(folder: Path) -> Shown:
    lines = open_lines(folder, RUN, MOSAIC, CALIBRATION, IMAGE)
    if lines.colours and lines.colours.kind == IMAGE:
        return _of_colours(lines)
    if lines.colours and not lines.filters:
        return _of_parts(folder, lines.names, "line")
    if (folder / MANIFEST).is_file():
        kind = read_json(folder / MANIFEST)
        calibrated = isinstance(kind, dict) and kind.get("kind") == "calibration"
        return _of_calibration(folder) if calibrated else _of_run(lines)
    if (folder / IMAGE_FILE).is_file() and (folder / RESULT_FILE).is_file():
        return _of_image(folder)
    depths = [path.name for path in folder.iterdir() if (path / MANIFEST).is_file()]
    try:
        depths.sort(key=float)
    except ValueError:  # other folders are not called by their depth
        depths = []
    if depths:
        return _of_parts(folder, depths, "depth", " mm")
    raise MitsimError(
        f"{folder}: holds no run, calibration or image; give a folder of mitsim capture, calibrate, reconstruct or "
        "import (studies and the demo write their page as they run)"
    )


def _of_parts(folder: Path, names: Sequence[str], axis: str, unit: str = "") -> Shown:
    parts = {name: _content(folder / name) for name in names}
    first, *_, last = *parts.values(), *parts.values()
    return _shown(
        f"{first['kind']} by {axis}",
        f"{len(parts)} {axis}{'s' if len(parts) > 1 else ''}: {', '.join(parts)}{unit}",
        warnings=[f"{name}: {text}" for name, part in parts.items() for text in part["warnings"]],
        command=first["command"],
        seconds=last["seconds"],
        tables={"Versions": first["tables"]["Versions"]},
        parts=parts,
    )


# -------- Runs and calibrations


def _of_run(lines: SpectralFolder) -> Shown:
    shots = load_run(lines.folder)
    manifest, taken, black = shots.manifest, shots.manifest.patterns, np.float64(shots.manifest.digital.black_level_dn)
    accuracy = (manifest.plan or {}).get("accuracy")
    accuracy = accuracy if isinstance(accuracy, float) else None
    error, count = manifest.total_error_bound, len(taken.captures)

    def frame(name: str) -> FloatArray:
        return np.asarray(shots.read(name)[0]["DN"] - black)

    first = frame(taken.captures[0].file)
    single = {"frame": (f"One of them, {taken.captures[0].file}", first, "")} if count > 1 else {}
    titles = {"ambient": "Projector off: what is taken off", "closing": "Closing frame: no part of the image"}
    single |= {kind: (titles[kind], frame(name), name) for kind, name in manifest.others.items()}
    pictures = [contact_sheet(lambda number: frame(taken.captures[number].file), count, first.shape)]
    for name, (title, values, about) in single.items():
        pictures.append(Picture.of(name, title, values, Scale.of(values, "DN above the black level", 0.0), about))
    if shots.truth is not None:
        pictures.append(Picture.of("truth", "The truth", shots.truth, REFLECTANCE, _TRUTH))
    for name in lines.names if lines.filters else ():
        if (path := lines.folder / name / TRUTH).is_file():
            truth = finite_channel(read_frame(path)[0], "reflectance", path)
            pictures.append(Picture.of(f"truth_{name}", f"The truth at {name}", truth, REFLECTANCE))
    asked = "" if error is None or accuracy is None else f"accuracy {accuracy:g} asked for, "
    return _shown(
        "Capture",
        f"{count} frame{'s' if count > 1 else ''}{'' if error is None else f', error at most {error:.1e}'}",
        detail=f"{first.shape[0]} x {first.shape[1]} pixels, patterns {taken.family or 'from elsewhere'}, {asked}"
        f"exposure {shots.exposure_s:.3g} s a frame",
        warnings=manifest.warnings,
        command=manifest.command,
        pictures=pictures,
        plan=plan_rows(manifest.plan),
        accuracy=accuracy,
        seconds=manifest.seconds,
        kernels=manifest.kernels,
        tables=_tables(manifest, lines.folder, {"patterns": {"family": taken.family, "n": taken.n, "frames": count}}),
    )


def _of_calibration(folder: Path) -> Shown:
    factors = load_calibration(folder)
    manifest, result = factors.manifest, factors.manifest.result
    errors = (result.get(name) for name in ("phi_error", "predicted_phi_error"))
    error = next((value for value in errors if isinstance(value, float)), None)
    verdict = (manifest.verdict or "a calibration").capitalize()
    verdict = f"Flagged. {verdict}" if manifest.warnings else verdict
    pictures = []
    for name, side, axis in (("left", factors.left, "rows"), ("right", factors.right, "columns")):
        about = f"{side.shape[1]} projector {axis} (down) x {side.shape[0]} sensor {axis} (across)"
        scale = Scale.of(side, "sqrt(electrons/s)")
        pictures.append(Picture.of(name, f"The {name} factor, of {axis}", side.T, scale, about, wide=True))
    known = {key: value for key, value in result.items() if key not in _ELSEWHERE}
    return _shown(
        "Calibration",
        verdict if error is None else f"{verdict}, factor error {error:.1e}",
        detail="" if manifest.estimate in manifest.warnings else manifest.estimate or "",
        warnings=manifest.warnings,
        command=manifest.command,
        pictures=pictures,
        seconds=_numbers(result.get("seconds")),
        kernels=_numbers(result.get("kernels")),
        tables=_tables(manifest, folder, known),
    )


def _tables(manifest: Any, folder: Path, known: Mapping[str, Any]) -> dict[str, Mapping[str, str]]:
    files = [path for path in folder.iterdir() if path.is_file() and path.name != PAGE]
    sizes = f"{len(files)}, {size_text(sum(path.stat().st_size for path in files))}"
    numbers = {key: value for key, value in manifest.model_dump().items() if key not in _ELSEWHERE}
    return {
        "Numbers": {**lines_of(known), **lines_of(numbers), "files": sizes},
        "Camera": lines_of(manifest.camera),
        "Configuration": lines_of(manifest.configuration),
        "Versions": manifest.versions,
    }


def _numbers(data: Any) -> dict[str, float]:
    listed = data.items() if isinstance(data, Mapping) else ()
    return {name: value for name, value in listed if isinstance(value, (int, float))}


# -------- Images


def _of_image(folder: Path) -> Shown:
    result = read_result(folder)
    image = finite_channel(read_frame(folder / IMAGE_FILE)[0], "reflectance", folder / IMAGE_FILE)
    quality, similar, warnings = result.get("psnr"), result.get("ssim"), result.get("warnings") or ()
    known = [f"PSNR {quality:.1f} dB"] if isinstance(quality, float) else ["An image, and no truth to judge it by"]
    known += [f"SSIM {similar:.3f}"] if isinstance(similar, float) else []
    inputs = result.get("inputs") if isinstance(result.get("inputs"), dict) else {}
    white, truth, size = result.get("white"), _truth_of(result), f"{image.shape[0]} x {image.shape[1]} projector pixels"
    by_spread = POINT_SPREAD in (inputs or {}) and isinstance(white, float)
    scale = Scale(0.0, white, "electrons/s") if by_spread and isinstance(white, float) else REFLECTANCE
    pictures = [Picture.of("image", "The image", image, scale, size)]
    if truth is not None and truth.shape == image.shape:
        pictures.append(Picture.of("truth", "The truth", truth, REFLECTANCE, _TRUTH))
        pictures.append(_error_picture(np.abs(image - truth), REFLECTANCE.unit, "|image \N{MINUS SIGN} truth|"))
    trust = "How far to trust it", "standard uncertainty that the image states of each pixel"
    for file, channel, unit, (title, about) in (
        (UNCERTAINTY_FILE, "uncertainty", REFLECTANCE.unit, trust),
        (DEPTH_FILE, "depth_mm", "mm", ("Depth of each pixel", "")),
        (DEPTH_FILE, "confidence", "(1: certain)", ("How sure the depth is", "")),
    ):
        if (path := folder / file).is_file():
            values = finite_channel(read_frame(path)[0], channel, path)
            scale = Scale.of(values, unit, None if channel == "depth_mm" else 0.0)
            scale = Scale(0.0, 1.0, unit) if channel == "confidence" else scale
            pictures.append(Picture.of(channel.removesuffix("_mm"), title, values, scale, about))
    misfit = result.get("misfit")
    tiles = np.array(misfit.get("map", []) if isinstance(misfit, dict) else [], dtype=np.float64)
    if tiles.ndim == 2 and tiles.size > 1 and np.isfinite(tiles).all():
        about = "chi-square a datum by place on the sensor, 1 where only noise is left"
        scale = Scale(0.0, max(float(tiles.max()), _MISFIT), "a datum")
        pictures.append(Picture.of("misfit", "Where the frames do not fit", tiles, scale, about))
    return _shown(
        "Image",
        ("Flagged. " if warnings else "") + ", ".join(known),
        detail="" if warnings else str(result.get("status", "")),
        warnings=[*map(str, warnings)],
        command=result.get("command"),
        pictures=pictures,
        seconds=_numbers(result.get("seconds")),
        tables={
            "Numbers": lines_of({key: value for key, value in result.items() if key not in _ELSEWHERE}),
            "Configuration": lines_of({"inputs": inputs, MADE_OF: result.get(MADE_OF) or {}}),
            "Versions": {},
        },
    )


def _error_picture(error: FloatArray, unit: str, about: str, least: float = 0.0) -> Picture:
    scale = Scale(0.0, max(float(np.percentile(error, _SHOWN_PERCENT)), least), unit)
    return Picture.of("error", "How they differ", error, scale, about)


def _truth_of(result: Mapping[str, Any]) -> FloatArray | None:
    """Return the truth of an image; None where run or calibration are gone, or have changed."""
    made_of, inputs = result.get(MADE_OF), result.get("inputs")
    if not isinstance(made_of, dict) or not isinstance(inputs, dict):
        return None
    try:
        run = Path(str(made_of["run"]))
        if open_lines(run, RUN, MOSAIC).filters:
            mosaic = load_mosaic(run)
            shots, truth = mosaic.shots, mosaic.truth(result.get("board_reflectance"))
        else:
            calibration = read_manifest(Path(str(made_of["calibration"])), CalibrationManifest)
            shots = load_run(run)
            truth = truth_for(shots, calibration.board_reflectance)
        return truth if shots.fingerprint == inputs.get("run") else None
    except (KeyError, MitsimError):
        return None


def _of_colours(lines: SpectralFolder) -> Shown:
    folder, colours, names = lines.folder, lines.colours, lines.names
    assert colours is not None
    data = read_json(folder / COLOUR)
    if data.get("status") == "incomplete":
        raise MitsimError(f"{folder / COLOUR}: holds no result of a finished image; reconstruct it again")
    verify_files(folder, data.get("checksums"), "reconstruct it again")
    parts = {name: _of_image(folder / name) for name in names if (folder / name / RESULT_FILE).is_file()}
    files = [folder / name / IMAGE_FILE for name in names]
    images = np.stack([finite_channel(read_frame(file)[0], "reflectance", file) for file in files], axis=-1)
    if parts:
        truths = [_truth_of(read_json(folder / name / RESULT_FILE)) for name in parts]
        known = [each for each in truths if each is not None and each.shape == images.shape[:2]]
        truth = np.stack(known, axis=-1) if len(known) == len(names) else None
    else:
        truth = _truth_of(data)
        truth = truth if truth is not None and truth.shape == images.shape else None
    image = ColourImage(
        lines=colours,
        images=images,
        board=data.get("board_reflectance") or 1.0,
        chart=None if data.get("chart") is None else validate(ChartPlace, data["chart"], f"{folder / COLOUR}: chart"),
        truth=truth,
        qualities={
            name: None if truth is None else Quality.of(images[..., number], truth[..., number])
            for number, name in enumerate(names)
        },
    )
    verdict, detail = f"An image from {len(files)} spectral lines", "No truth to compare it with."
    quality = "" if image.psnr_db is None else f"PSNR of the {len(files)} lines: {image.psnr_db:.1f} dB. "
    if image.patches:
        verdict = f"Mean Delta E 2000 of {len(image.patches)} patches: {image.patch_mean('delta_e'):.2f}"
        floor = image.patch_mean("floor")
        detail = f"{quality}The floor is {floor:.2f}: these spectral lines alone, without a camera."
    elif image.delta_e is not None:
        verdict = f"Mean Delta E 2000 to the truth: {image.delta_e.mean():.2f}"
        detail = f"{quality}Mean over all pixels."
    swatches = []
    if image.chart is not None:  # the spectrum's colour, and this image's
        both = np.stack([chart().xyz, image.chart.means(image.xyz)], axis=1)
        levels = np.rint(255 * lightness(linear_srgb(both))).astype(np.uint8)
        swatches = [[f"#{bytes(each).hex()}" for each in pair] for pair in levels]
    size = f"in sRGB under D65, {images.shape[0]} x {images.shape[1]} projector pixels"
    ideal, pictures = "what a perfect image of the same lines would show, by the same matrix", list[Picture]()
    for name, xyz, about in (("image", image.xyz, size), ("truth", image.truth_xyz, ideal)):
        if xyz is not None:
            caption = f"{about}; white is a perfect reflector, and what lies beyond the screen's colours is cut"
            pictures.append(Picture(name, f"The {name}", caption, png(linear_srgb(xyz), LARGEST, SMALLEST)))
    if image.delta_e is not None:
        about = "1 is about the least difference that an eye sees side by side"
        pictures.append(_error_picture(image.delta_e, "Delta E 2000", about, 1.0))
    for number, line in enumerate(colours.channels):
        title = f"{line.wavelength_nm:g} nm"
        pictures.append(Picture.of(f"image_{line.name}", title, images[..., number], REFLECTANCE))
        if truth is not None:
            pictures.append(Picture.of(f"truth_{line.name}", f"{title}, truth", truth[..., number], REFLECTANCE))
    return _shown(
        "Image in colour",
        verdict,
        detail=detail,
        warnings=data.get("warnings") or (),
        command=data.get("command"),
        pictures=pictures,
        tables={"Versions": versions()},
        parts=parts,
        colours=image,
        swatches=swatches,
        facts=data.get("facts") or {},
    )

"""Pages of a run, a calibration or an image, from its folder's files alone (`mitsim report`).

The truth of an image is read from its run, if the run is still in its place.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from mitsim.core import colour_files, files
from mitsim.core.arrays import FloatArray
from mitsim.core.colour_files import ColourManifest, SpectralFolder, open_lines
from mitsim.core.configuration import validate
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError, check_arguments
from mitsim.core.exr import checksum, finite_channel, read_frame, verify_files, write_frame
from mitsim.core.files import PAGE, PICTURES, output_folder, read_json, remove_page, write_bytes, write_text
from mitsim.core.headline import calibration_headline, each_once, frames_headline, image_headline
from mitsim.core.images import card, lightness, png
from mitsim.core.job import size_text
from mitsim.core.manifests import MANIFEST, CalibrationManifest, RunManifest, read_manifest
from mitsim.core.runs import TRUTH, load_mosaic, load_run
from mitsim.devices.framelist import ChartPlace
from mitsim.light.plan import PlanRow
from mitsim.metrics import Quality, psnr, summary_of, truth_for
from mitsim.reconstruct import reconstruct
from mitsim.reconstruct.colour import ColourModel, chart, delta_e, linear_srgb
from mitsim.reconstruct.factors import camera_parts, load_calibration
from mitsim.reconstruct.request import IMAGE_FILE, PICTURE_FILE, RESULT_FILE
from mitsim.report import pages
from mitsim.report.pages import LARGEST, REFLECTANCE, SMALLEST, Picture, lines_of, render_page

_ELSEWHERE = {
    *("kind", "format", "status", "configuration", "configuration_sha256", "checksums", "patterns", "plan"),
    *("seconds", "warnings", "versions", "command", "kernels", "result", "estimate", "verdict", "camera"),
    *("opened", "inputs", "headline", reconstruct.MADE_OF),
}
"""Keys of a manifest or result outside the table of numbers."""
_ABOVE_BLACK = "DN above the black level"
_TRUTH = "image that a perfect camera would recover; projector pixels whose light the camera cannot see are black"
_MISFIT = 2.0
"""Least end of the scale of chi-square, so that chance does not fill the scale."""
_SLICES = 6
"""Most slices of a volume in its picture."""
_SHOWN_PERCENT = 99.0
"""Percentage of the errors that lie within the scale of their picture."""


Shown = dict[str, Any]
"""Content of a folder's page: variables of its template, of which `parts` are pages of the folders in it."""


def _shown(kind: str, subject: str, verdict: str, **more: Any) -> Shown:
    absent = {"detail": "", "command": None, "accuracy": None, "colours": None, "plan": (), "pictures": ()}
    tables: Shown = {"warnings": (), "seconds": {}, "kernels": {}, "tables": {}, "parts": {}, "facts": {}}
    head = {"kind": kind, "subject": subject, "title": f"{kind}: {subject}", "verdict": verdict}
    return {**head, **absent, **tables, **more}


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


report = report_folder


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
        )
        try:
            if shown["pictures"]:
                files.prepare_output(folder / PICTURES, overwrite=True)
            for picture in shown["pictures"]:
                picture.write(folder / PICTURES)
            write_text(folder / PAGE, text)
        except BaseException:
            remove_page(folder)
            raise


def _content(folder: Path) -> Shown:
    lines = open_lines(folder, colour_files.RUN, colour_files.MOSAIC, colour_files.CALIBRATION, colour_files.IMAGE)
    if lines.colours and lines.colours.kind == colour_files.IMAGE:
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
    reasons = each_once({name: part["warnings"] for name, part in parts.items()})
    name_all = calibration_headline if first["kind"] == "Calibration" else frames_headline
    return _shown(
        f"{first['kind']} by {axis}",
        first["subject"],
        name_all([part["result"] for part in parts.values()], reasons),
        detail=f"{len(parts)} {axis}{'s' if len(parts) > 1 else ''}: {', '.join(parts)}{unit}.",
        warnings=reasons,
        command=first["command"],
        seconds=last["seconds"],
        tables={"Versions": first["tables"]["Versions"]},
        parts=parts,
    )


def _subject(manifest: RunManifest | CalibrationManifest, file: Path) -> str:
    """Return scene and camera of a ``manifest`` and the date of a ``file``, for the title of a page."""
    scene, camera = manifest.configuration.get("scene"), manifest.camera.get("sensor", manifest.camera)
    named = str(camera.get("name") or "") if isinstance(camera, Mapping) else ""
    return pages.subject(pages.scene_name(Path(scene)) if isinstance(scene, str) else "", named, file)


def _subject_of_image(made_of: Any, file: Path) -> str:
    """Return :func:`_subject` of the run that an image was made of, or the run's folder if it is gone or damaged."""
    if not (isinstance(made_of, Mapping) and made_of.get("run")):
        return pages.subject("", "", file)
    run = Path(str(made_of["run"]))
    with suppress(MitsimError):
        # A run of several spectral lines has a manifest for each line.
        found = [run / MANIFEST] if (run / MANIFEST).is_file() else sorted(run.glob(f"*/{MANIFEST}"))
        return _subject(read_manifest(found[0].parent if found else run, RunManifest), file)
    return pages.subject(f"frames of {run.name}", "", file)


# -------- Runs and calibrations


def _of_run(lines: SpectralFolder) -> Shown:
    shots = load_run(lines.folder)
    manifest, taken, black = shots.manifest, shots.manifest.patterns, np.float64(shots.manifest.digital.black_level_dn)
    accuracy = (manifest.plan or {}).get("accuracy")
    accuracy = accuracy if isinstance(accuracy, float) else None
    result, count = shots.summary(), len(taken.captures)

    def frame(name: str) -> FloatArray:
        return np.asarray(shots.read(name)[0]["DN"] - black)

    first = frame(taken.captures[0].file)
    titles = {"ambient": "Subtracted frame with the projector off", "closing": "Closing frame, which checks the others"}
    single = {"frame": ("First frame", first, f"file {taken.captures[0].file}")} if count > 1 else {}
    single |= {kind: (titles[kind], frame(name), f"file {name}") for kind, name in manifest.others.items()}
    pictures = [Picture.of(kind, *shown, _ABOVE_BLACK, (0.0, None)) for kind, shown in single.items()]
    if shots.truth is not None:
        pictures.append(Picture.of("truth", "The truth", shots.truth, _TRUTH))
    for name in lines.names if lines.filters else ():
        if (path := lines.folder / name / TRUTH).is_file():
            truth = finite_channel(read_frame(path)[0], "reflectance", path)
            pictures.append(Picture.of(f"truth_{name}", f"The truth at {name}", truth))
    pictures.append(pages.contact_sheet(lambda number: frame(taken.captures[number].file), count, first.shape))
    effects = (manifest.plan or {}).get("effects")
    plan, row = list[PlanRow](), TypeAdapter(PlanRow)
    for each in effects if isinstance(effects, list) else ():
        with suppress(ValidationError):
            plan.append(row.validate_python(each))
    asked = "" if accuracy is None else f", accuracy {accuracy:g} asked for"
    return _shown(
        "Capture",
        _subject(manifest, lines.folder / MANIFEST),
        frames_headline([result], manifest.warnings),
        result=result,
        detail=f"Patterns {taken.family or 'from elsewhere'}{asked}, exposure {shots.exposure_s:.3g} s a frame.",
        warnings=manifest.warnings,
        command=manifest.command,
        pictures=pictures,
        plan=plan,
        accuracy=accuracy,
        seconds=manifest.seconds,
        kernels=manifest.kernels,
        tables=_tables(manifest, lines.folder, {"patterns": {"family": taken.family, "n": taken.n, "frames": count}}),
    )


def _of_calibration(folder: Path) -> Shown:
    factors = load_calibration(folder)
    manifest, result = factors.manifest, factors.manifest.result
    pictures = []
    for name, side, axis in (("left", factors.left, "rows"), ("right", factors.right, "columns")):
        about = f"{side.shape[1]} projector {axis} (down) x {side.shape[0]} sensor {axis} (across)"
        title, unit, most = f"{name.capitalize()} factor, for {axis}", "√(electrons/s)", float(np.abs(side).max())
        ends, quantity = ((-most, most), "difference") if manifest.centre else ((None, None), "light")
        pictures.append(Picture.of(name, title, side.T, about, unit, ends, wide=True, quantity=quantity))
    known = {key: value for key, value in result.items() if key not in _ELSEWHERE}
    return _shown(
        "Calibration",
        _subject(manifest, folder / MANIFEST),
        calibration_headline([result], manifest.warnings),
        result=result,
        detail="" if manifest.warnings else manifest.estimate or "",
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
        "Camera": lines_of(camera_parts(manifest.camera)),
        "Configuration": lines_of(manifest.configuration),
        "Versions": manifest.versions,
    }


def _numbers(data: Any) -> dict[str, float]:
    listed = data.items() if isinstance(data, Mapping) else ()
    return {name: value for name, value in listed if isinstance(value, (int, float))}


# -------- Images


def _of_image(folder: Path) -> Shown:
    result = reconstruct.read_result(folder)
    image = finite_channel(read_frame(folder / IMAGE_FILE)[0], "reflectance", folder / IMAGE_FILE)
    warnings = [*map(str, result.get("warnings") or ())]
    inputs = result.get("inputs") if isinstance(result.get("inputs"), dict) else {}
    white, truth, size = result.get("white"), truth_of(result), f"{image.shape[0]} x {image.shape[1]} projector pixels"
    by_spread = reconstruct.POINT_SPREAD in (inputs or {}) and isinstance(white, float)
    unit, most = ("electrons/s", white) if by_spread else (REFLECTANCE, 1.0)
    method, weight = (inputs or {}).get("method"), result.get("lambda")
    how = [f"method {method}"] if isinstance(method, str) else []
    how += [f"lambda {weight:.2g} (electrons/s)²"] if isinstance(weight, float) else []
    known = {"PSNR {:.1f} dB": result.get("psnr"), "SSIM {:.3f}": result.get("ssim")}
    how += [text.format(value) for text, value in known.items() if isinstance(value, float)]
    about = ", ".join([*how, size])
    pictures = [Picture.of("image", "The image", image, about, unit, (0.0, most))]
    if truth is not None and truth.shape == image.shape:
        pictures += [Picture.of("truth", "The truth", truth, _TRUTH), _difference("error", "Difference", image, truth)]
    if (path := folder / reconstruct.VOLUME_FILE).is_file():
        volume, depths = read_frame(path)[0], result.get("volume_depths_mm")
        names = [sorted(volume)[k] for k in sorted({int(k) for k in np.linspace(0, len(volume) - 1, _SLICES)})]
        known = dict(zip(sorted(volume), depths, strict=False)) if isinstance(depths, list) else {}
        about = "from left to right at " + ", ".join(f"{known.get(name, name)} mm" for name in names)
        strip = np.concatenate([finite_channel(volume, name, path) for name in names], axis=1)
        pictures.append(Picture.of("slices", "Slices of the volume", strip, about, unit, (0.0, None), wide=True))
    sigma, depth = reconstruct.UNCERTAINTY_FILE, reconstruct.DEPTH_FILE
    for file, channel, title, about, unit, ends in (
        (sigma, "uncertainty", "Standard uncertainty", "without the truth", REFLECTANCE, (0.0, None)),
        (depth, "depth_mm", "Depth", "distance from the sensor", "mm", (None, None)),
        (depth, "confidence", "Confidence of the depth", "", "1 = certain", (0.0, 1.0)),
    ):
        if (path := folder / file).is_file():
            values, name = finite_channel(read_frame(path)[0], channel, path), channel.removesuffix("_mm")
            pictures.append(Picture.of(name, title, values, about, unit, ends, quantity=name))
    misfit = result.get("misfit")
    tiles = np.array(misfit.get("map", []) if isinstance(misfit, dict) else [], dtype=np.float64)
    if tiles.ndim == 2 and tiles.size > 1 and np.isfinite(tiles).all():
        about = "mean squared residual of each part of the sensor, relative to its noise; 1 where only noise is left"
        ends = 0.0, max(float(tiles.max()), _MISFIT)
        chi = "chi-square per datum"
        pictures.append(Picture.of("misfit", "Misfit of the frames", tiles, about, chi, ends, quantity="chi-square"))
    numbers = lines_of({key: value for key, value in result.items() if key not in _ELSEWHERE})
    return _shown(
        "Image",
        _subject_of_image(result.get(reconstruct.MADE_OF), folder / RESULT_FILE),
        image_headline({**result, "shape": image.shape}, warnings),
        detail="" if warnings else str(result.get("status", "")),
        warnings=warnings,
        command=result.get("command"),
        pictures=pictures,
        seconds=_numbers(result.get("seconds")),
        tables={
            "Numbers": {key: value for key, value in numbers.items() if key != "misfit.reason"},  # a warning has it
            "Configuration": lines_of({"inputs": inputs, reconstruct.MADE_OF: result.get(reconstruct.MADE_OF) or {}}),
            "Versions": result.get("versions") or {},
        },
    )


def _difference(name: str, title: str, image: FloatArray, truth: FloatArray) -> Picture:
    error = image - truth
    most = float(np.percentile(np.abs(error), _SHOWN_PERCENT)) or 1.0
    about = "image \N{MINUS SIGN} truth"
    return Picture.of(name, title, error, about, ends=(-most, most), quantity="difference")


def truth_of(result: Mapping[str, Any]) -> FloatArray | None:
    """Return the truth of an image; None where run or calibration are gone, or have changed."""
    made_of, inputs = result.get(reconstruct.MADE_OF), result.get("inputs")
    if not isinstance(made_of, dict) or not isinstance(inputs, dict):
        return None
    try:
        run = Path(str(made_of["run"]))
        if open_lines(run, colour_files.RUN, colour_files.MOSAIC).filters:
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
    data = read_json(folder / colour_files.COLOUR)
    if data.get("status") == "incomplete":
        raise MitsimError(f"{folder / colour_files.COLOUR}: holds no result of a finished image; reconstruct it again")
    verify_files(folder, data.get("checksums"), "reconstruct it again")
    parts = {name: _of_image(folder / name) for name in names if (folder / name / RESULT_FILE).is_file()}
    files = [folder / name / IMAGE_FILE for name in names]
    images = np.stack([finite_channel(read_frame(file)[0], "reflectance", file) for file in files], axis=-1)
    if parts:
        truths = [truth_of(read_json(folder / name / RESULT_FILE)) for name in parts]
        known = [each for each in truths if each is not None and each.shape == images.shape[:2]]
        truth = np.stack(known, axis=-1) if len(known) == len(names) else None
    else:
        truth = truth_of(data)
        truth = truth if truth is not None and truth.shape == images.shape else None
    place = data.get("chart")
    image = ColourImage(
        lines=colours,
        images=images,
        board=data.get("board_reflectance") or 1.0,
        chart=None if place is None else validate(ChartPlace, place, f"{folder / colour_files.COLOUR}: chart"),
        truth=truth,
        qualities={
            name: None if truth is None else Quality.of(images[..., number], truth[..., number])
            for number, name in enumerate(names)
        },
    )
    by_spread = reconstruct.POINT_SPREAD in (data.get("inputs") or {})
    if by_spread:
        model = ColourModel(colours.wavelengths_nm, np.array(data["matrix"]), str(data["matrix_fitted_on"]))
        image = replace(image, by_point=model, solution=data)
    data |= {"shape": images.shape[:2], "channels": colours.channels}
    reasons = data.get("warnings") or ()
    swatches = []
    if image.chart is not None:  # the spectrum's colour, and this image's
        both = np.stack([chart().xyz, image.chart.means(image.xyz)], axis=1)
        levels = np.rint(255 * lightness(linear_srgb(both))).astype(np.uint8)
        swatches = [[f"#{bytes(each).hex()}" for each in pair] for pair in levels]
    quality = f"PSNR {data['psnr']:.1f} dB in all lines, " if isinstance(data.get("psnr"), float) else ""
    size = f"{quality}sRGB under D65, {images.shape[0]} x {images.shape[1]} projector pixels"
    ideal, pictures = "image that a perfect camera would recover of the same lines, by the same matrix", list[Picture]()
    for name, xyz, about in (("image", image.xyz, size), ("truth", image.truth_xyz, ideal)):
        if xyz is not None:
            white = "the brightest pixel" if by_spread else "a perfect reflector"
            caption = f"{about}; white is {white}; colours beyond the screen's are clipped"
            pictures.append(Picture(name, f"The {name}", caption, png(linear_srgb(xyz), LARGEST, SMALLEST)))
    if image.delta_e is not None:
        ends = 0.0, max(float(np.percentile(image.delta_e, 99)), 1.0)
        title, unit, about = "Colour difference of image and truth", "CIE Delta E 2000", "an eye sees a difference of 1"
        pictures.append(Picture.of("error", title, image.delta_e, about, unit, ends, quantity="error"))
    for number, line in enumerate(colours.channels):
        title, own, quality_of_line = f"{line.wavelength_nm:g} nm", images[..., number], image.qualities[line.name]
        unit, most = ("electrons/s", None) if by_spread else (REFLECTANCE, 1.0)
        about = str(quality_of_line or "")
        pictures.append(Picture.of(f"image_{line.name}", f"{title}, image", own, about, unit, (0.0, most)))
        if truth is not None:
            pictures.append(Picture.of(f"truth_{line.name}", f"{title}, truth", truth[..., number]))
            pictures.append(_difference(f"error_{line.name}", f"{title}, difference", own, truth[..., number]))
    return _shown(
        "Image in colour",
        _subject_of_image(data.get(reconstruct.MADE_OF), folder / colour_files.COLOUR),
        image_headline(data, reasons),
        detail="" if truth is None and not image.patches else " ".join(f"{text}." for text in image.sentences[1:]),
        warnings=reasons,
        command=data.get("command"),
        pictures=pictures,
        tables={"Versions": versions()},
        parts=parts,
        colours=image,
        swatches=swatches,
        facts=data.get("facts") or {},
    )


# -------- An image in colour from images of spectral lines


@dataclass(frozen=True, eq=False, kw_only=True)
class ColourImage:
    """Images of a scene at spectral lines, their colours, and how well both are known.

    ``images`` and ``truth`` (n, n', lines) are reflectances relative to the calibration's ``board``. Colours are fitted
    on a ``chart``; MitsimError if it lies outside. ``solution`` and ``of_lines`` are numbers of one solve for all
    lines, or of each line's, by the keys of the JSON. An image of other ``inputs`` is not replaced. By a point spread
    function the images are in electrons/s, of which ``by_point`` makes colours.
    """

    lines: ColourManifest
    images: FloatArray
    board: float
    truth: FloatArray | None = None
    chart: ChartPlace | None = None
    qualities: Mapping[str, Quality | None] = field(default_factory=dict)
    facts: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    output: str = ""
    solution: Mapping[str, Any] = field(default_factory=dict)
    of_lines: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    inputs: Mapping[str, Any] = field(default_factory=dict)
    by_point: ColourModel | None = None

    def __post_init__(self) -> None:
        self.model  # noqa: B018 - refuses a chart outside the image

    @cached_property
    def model(self) -> ColourModel:
        waves = self.lines.wavelengths_nm
        if self.by_point:
            return self.by_point
        if self.chart is None:
            return ColourModel.of_lines(waves)
        return ColourModel.fit(waves, self.board * self.chart.means(self.images), "the chart in this image")

    @property
    def reflectances(self) -> FloatArray:
        """(n, n', lines) reflectances, 1 = a perfect reflector."""
        return self.board * self.images

    @property
    def ok(self) -> bool:
        return not self.warnings

    @property
    def psnr_db(self) -> float | None:
        """PSNR over all lines together; None without a truth."""
        count = self.images.shape[0]
        return None if self.truth is None else psnr(self.images.reshape(count, -1), self.truth.reshape(count, -1))

    @cached_property
    def xyz(self) -> FloatArray:
        """(n, n', 3) CIE XYZ under D65; a perfect reflector has Y = 1."""
        return self.model.xyz(self.reflectances)

    @cached_property
    def truth_xyz(self) -> FloatArray | None:
        return None if self.truth is None else self.model.xyz(self.board * self.truth)

    @cached_property
    def delta_e(self) -> FloatArray | None:
        """(n, n') CIE Delta E 2000 to the truth; None without a truth."""
        return None if self.truth_xyz is None else delta_e(self.xyz, self.truth_xyz)

    @cached_property
    def patches(self) -> list[dict[str, Any]]:
        """Return CIE Delta E 2000 of the mean of each patch to its spectrum in D65; empty without a chart.

        ``floor`` is that of the patch's spectrum at the lines by the fixed matrix, the least for these lines. ``truth``
        is that of the truth by the image's matrix.
        """
        if self.chart is None:
            return []
        known, waves = chart(), self.lines.wavelengths_nm
        columns = {
            "delta_e": delta_e(self.chart.means(self.xyz), known.xyz),
            "floor": delta_e(ColourModel.of_lines(waves).xyz(known.at(waves)), known.xyz),
            "truth": None if self.truth_xyz is None else delta_e(self.chart.means(self.truth_xyz), known.xyz),
        }
        return [
            {"name": name, **{key: None if each is None else float(each[number]) for key, each in columns.items()}}
            for number, name in enumerate(known.names)
        ]

    def patch_mean(self, key: str) -> float | None:
        return _mean(patch[key] for patch in self.patches)

    @property
    def sentences(self) -> list[str]:
        sentences = [f"Colours follow from a matrix fitted on {self.model.fitted_on}"]
        if self.by_point:
            white = f"image.png shows {self.solution['white']:.3g} electrons/s"
            sentences = [f"{white} of the mean line as white, with {self.model.fitted_on}"]
        if self.delta_e is not None:
            sentences.append(f"The mean Delta E 2000 of all pixels to the truth is {self.delta_e.mean():.2f}")
        if self.patches:
            mean, floor = self.patch_mean("delta_e"), self.patch_mean("floor")
            sentences.append(
                f"The mean Delta E 2000 of {len(self.patches)} patches to their spectra is {mean:.2f}; these spectral "
                f"lines alone, without a camera, leave {floor:.2f}"
            )
        return sentences

    @property
    def described(self) -> list[str]:
        qualities = [f"{name}: {each or 'no truth to compare with'}" for name, each in self.qualities.items()]
        return [*qualities, *(f"{name}: {value}" for name, value in self.facts.items())]

    @property
    def table(self) -> dict[str, str]:
        rows = {}
        for number, line in enumerate(self.lines.names if self.of_lines else ()):
            found, size = self.of_lines[line], float(np.sqrt(np.square(self.images[..., number]).mean()))
            fit = "" if found["misfit"] is None else f", chi-square {found['misfit']['chi_square']:.3g}"
            known = "" if found["uncertainty"] is None else f" +- {found['uncertainty']:.2e}"
            rows[line] = f"lambda {found['lambda']:.3g}{fit}, image {size:.2e}{known} rms"
        return rows

    def summary(self) -> dict[str, Any]:
        channels = [
            {**line.model_dump(), **summary_of(self.qualities[line.name]), **self.of_lines.get(line.name, {})}
            for line in self.lines.channels
        ]
        known = {"psnr": self.psnr_db, "shape": self.images.shape[:2], "channels": channels}
        return {
            "headline": image_headline(known, self.warnings),
            **self.solution,
            **known,
            "ssim": _mean(channel["ssim"] or None for channel in channels),
            **self.model.summary(),
            "delta_e": None if self.delta_e is None else float(self.delta_e.mean()),
            "delta_e_chart": self.patch_mean("delta_e"),
            "delta_e_floor": self.patch_mean("floor"),
            "patches": self.patches or None,
            "warnings": self.warnings,
            "status": " ".join(self.warnings) or "Every line's image can be used as it is.",
            "seconds": dict(self.seconds),
            "output": self.output,
        }

    def write(self, folder: Path, **origin: Any) -> None:
        """Write image.exr, image.png, and colour.json last; an earlier page is removed."""
        rgb = linear_srgb(self.xyz)
        named = dict(zip("RGBXYZ", np.moveaxis(np.concatenate([rgb, self.xyz], axis=-1), -1, 0), strict=True))
        channels = {name: values.astype(np.float32) for name, values in named.items()}
        units = {"rgb": "linear sRGB", "xyz": "CIE 1931 under D65, perfect reflector Y = 1"}
        remove_page(folder)
        checksums = {
            IMAGE_FILE: write_frame(folder / IMAGE_FILE, channels, units),
            PICTURE_FILE: write_bytes(folder / PICTURE_FILE, png(rgb)),
        }
        of_lines = (f"{name}/{IMAGE_FILE}" for name in self.lines.names)
        checksums |= {name: checksum(folder / name) for name in of_lines if (folder / name).is_file()}
        more = {key: value for key, value in self.summary().items() if key != "channels"}
        more |= {"inputs": self.inputs} if self.inputs else {}
        more |= {**origin, "facts": {**self.facts, **self.table}, "board_reflectance": self.board, "chart": self.chart}
        state_image(folder, self.lines, checksums=checksums, **more)

    def _repr_html_(self) -> str:
        pictures = {"in colour\nsRGB under D65": linear_srgb(self.xyz)}
        if self.truth_xyz is not None:
            pictures["truth\nsRGB under D65"] = linear_srgb(self.truth_xyz)
        for number, name in enumerate(self.lines.names):
            pictures[f"{name}\nreflectance 0 to 1"] = self.reflectances[..., number]
        return card("Image in colour", pictures, self.sentences)


def state_image(folder: Path, lines: ColourManifest, **more: Any) -> None:
    """Write colour.json; with ``status="incomplete"``, a killed work can be replaced."""
    remove_page(folder)
    colour_files.write_colours(folder, ColourManifest(kind="colour-image", channels=lines.channels), **more)


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None

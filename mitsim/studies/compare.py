"""Images of several reconstructions on one scale, their differences to the first, and their quality."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.colour_files import is_coloured
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError
from mitsim.core.exr import finite_channel, read_frame
from mitsim.core.files import output_folder, write_json
from mitsim.core.images import linear_light, own_end, read_image, size_of
from mitsim.core.manifests import RunManifest, read_manifest
from mitsim.core.picture_files import Wanted
from mitsim.metrics import Quality, summary_of
from mitsim.reconstruct.factors import camera_parts
from mitsim.reconstruct.reconstruct import MADE_OF, POINT_SPREAD, read_result
from mitsim.reconstruct.request import IMAGE_FILE
from mitsim.report.folder_page import truth_of
from mitsim.report.pages import DASH, Mean, page_figure, reflectance
from mitsim.report.plots import image_grid, reflectance_norm
from mitsim.studies.framework.campaign import is_earlier, write_figures
from mitsim.studies.framework.panels import Part, Section, write_page

STORED = "as stored"
_SHOWN = 0.999
"""Part of the pixels within the scale of a figure: single pixels of noise do not determine it."""


@dataclass(frozen=True, eq=False)
class Image:
    """One image [reflectance], the conversion of its numbers (``scale``), its warnings, and truth and run if known."""

    name: str
    values: FloatArray
    scale: str = STORED
    warnings: Sequence[str] = ()
    truth: FloatArray | None = None
    run: Mapping[str, Any] = field(default_factory=dict)


_COLUMNS = {
    "psnr": "PSNR to truth [dB]", "ssim": "SSIM to truth", "psnr_to_first": "PSNR to first [dB]",
    "ssim_to_first": "SSIM to first", "rms_difference": "rms difference to first",
}  # fmt: skip
_RUN = {"mask": "mask", "patterns": "patterns", "method": "method", "exposure_s": "exposure [s]", "seed": "seed"}


@dataclass(frozen=True)
class Comparison:
    """Result of a comparison.

    Attributes
    ----------
    images
        For each image its name, the conversion of its numbers, whether it is flagged, mask, patterns, method, exposure
        and seed of its run, PSNR and SSIM against the truth and against the first image (None if unknown), and mean and
        rms difference to the first image [reflectance].
    means
        For each mask, patterns and method with several seeds these, the number of images, and mean and half of the 95 %
        interval of their PSNR.
    white, largest_difference
        Ends of the scales of the figures [reflectance].
    """

    images: tuple[dict[str, Any], ...]
    white: float
    largest_difference: float
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    output: str
    figures: tuple[str, ...]
    means: tuple[dict[str, Any], ...] = ()

    def payload(self) -> dict[str, Any]:
        return asdict(self)

    def tables(self) -> tuple[Part, ...]:
        """Return the quality of the images, and the facts on their runs if any is known."""
        quality, runs = (
            tuple((row["name"], *(_cell(row[key]) for key in columns)) for row in self.images)
            for columns in (_COLUMNS, _RUN)
        )
        lead = f"Figures show differences up to {reflectance(self.largest_difference)} of the board's reflectance."
        means = [
            f"{', '.join(map(str, mean['of']))}: PSNR {mean['psnr']:.2f} +- {mean['psnr_ci95']:.2f} dB "
            f"(mean of {mean['images']} seeds and its 95 % interval)"
            for mean in self.means
        ]
        first = Part("Quality", lead, ("image", *_COLUMNS.values()), quality, notes=(*means, *self.notes))
        known = any(row["mask"] for row in self.images)
        return (first, *[Part("Runs", "", ("image", *_RUN.values()), runs)] * known)

    def lines(self) -> list[str]:
        quality, *runs = (table.lines() for table in self.tables())
        first = f"{len(self.images)} images, compared with {self.images[0]['name']}"
        return [first, *(line for run in runs for line in [*run, ""]), *quality, f"Figures and page: {self.output}"]


def _cell(value: Any) -> str:
    return DASH if value is None else value if isinstance(value, str) else f"{value:.4g}"


def _run_of(result: Mapping[str, Any]) -> dict[str, Any]:
    """Return mask, patterns, method, exposure and seed of the run of an image; nothing if its folder is gone."""
    try:
        run = read_manifest(Path(result[MADE_OF]["run"]), RunManifest)
    except (MitsimError, KeyError, TypeError):
        return {}
    mask = camera_parts(run.camera).get("geometry.mask")
    how = {name: each for name, each in result["inputs"].items() if name not in ("run", "calibration")}
    return {
        "mask": mask and str(mask).partition(",")[0], "patterns": run.patterns.family, "method": how["method"],
        "exposure_s": run.digital.exposure_s, "seed": run.configuration.get("seed"),
        "setting": json.dumps([{**run.configuration, "seed": None}, how], sort_keys=True),
    }  # fmt: skip


def means_over_seeds(images: Sequence[Image], rows: Sequence[Mapping[str, Any]]) -> tuple[dict[str, Any], ...]:
    """Return the mean PSNR, with half of its 95 % interval, of images that differ in the seed alone."""
    groups: dict[str, dict[Any, Mapping[str, Any]]] = {}
    for each, row in zip(images, rows, strict=True):
        if row["psnr"] is not None and row["seed"] is not None:
            groups.setdefault(each.run["setting"], {})[row["seed"]] = row
    found = []
    for same in (list(each.values()) for each in groups.values() if len(each) > 1):
        mean = Mean.of_numbers([row["psnr"] for row in same], "psnr")
        of = [same[0][name] for name in ("mask", "patterns", "method")]
        found.append({"of": of, "images": mean.of, "psnr": mean.value, "psnr_ci95": mean.reach})
    return tuple(found)


def images_in(path: Path) -> list[Image]:
    """Read a picture, or all images of a folder; MitsimError for files that cannot be read."""
    if not path.is_dir():
        values = read_image(path, Wanted("image"))
        end, drawn = own_end(values), path.suffix.lower() in (".png", ".tif", ".tiff")
        numbers = values.astype(np.float64) / (end or 1.0)
        scale = f"divided by {end:g}{', then decoded by the sRGB curve' if drawn else ''}" if end else STORED
        return [Image(path.name, linear_light(numbers) if end and drawn else numbers, scale)]
    folders = [path] if (path / IMAGE_FILE).is_file() else sorted(each.parent for each in path.glob(f"*/{IMAGE_FILE}"))
    if not folders:
        raise MitsimError(f"image {path}: holds no image; give a folder of mitsim reconstruct or run, or a picture")
    found = []
    for folder in folders:
        if is_coloured(folder):
            raise MitsimError(f"image {folder}: is in colour; give the folders of its lines, {folder}/NAME")
        result, file = read_result(folder), folder / IMAGE_FILE
        values, scale = finite_channel(read_frame(file)[0], "reflectance", file), STORED
        if POINT_SPREAD in (result.get("inputs") or {}):
            values, scale = values / result["white"], f"divided by its white, {result['white']:.3g} electrons/s"
        name = path.name if len(folders) == 1 else f"{path.name}/{folder.name}"
        warnings = [*map(str, result.get("warnings") or ())]
        found.append(Image(name, values, scale, warnings, truth_of(result), _run_of(result)))
    return found


def compare(paths: Sequence[Path], output: Path | str, overwrite: bool = False, style: str = "screen") -> Comparison:
    """Compare images, and write page, figures and compare.json to a new folder, or to one of an earlier comparison."""
    images = [each for path in paths for each in images_in(path)]
    if len(images) < 2:
        raise MitsimError(f"compare: got {len(images)} image; give two or more")
    first, *others = images
    for each in others:
        if each.values.shape != first.values.shape:
            sizes = f"has {size_of(each.values)} pixels, but {first.name} has {size_of(first.values)}"
            raise MitsimError(f"image {each.name}: {sizes}; compare images of one size")
    truths = [each.truth for each in images if each.truth is not None]
    seeds = len({each.run.get("setting") for each in images}) == 1  # truths then differ by their sampling noise alone
    common = truths[0] if truths and (seeds or all(np.array_equal(truths[0], each) for each in truths)) else None
    offs = [each.values - first.values for each in images]
    rows = []
    for each, off in zip(images, offs, strict=True):
        truth = common if each.truth is None else each.truth
        known = None if truth is None else summary_of(Quality.of(each.values, truth))
        beside = None if each is first else summary_of(Quality.of(each.values, first.values))
        row: dict[str, Any] = {"name": each.name, "scale": each.scale, "flagged": bool(each.warnings)}
        row |= {key: each.run.get(key) for key in _RUN}
        for key in ("psnr", "ssim"):
            row |= {key: known and known[key], f"{key}_to_first": beside and beside[key]}
        row |= {"mean_difference": float(off.mean()), "rms_difference": float(np.sqrt(np.square(off).mean()))}
        rows.append(row)
    white = max(float(np.quantile(each.values, _SHOWN)) for each in images)
    largest = max(float(np.quantile(np.abs(off), _SHOWN)) for off in offs)
    white, largest = (end if end > 0 else 1.0 for end in (white, largest))
    matched = [f"{each.name} was {each.scale}" for each in images if each.scale != STORED]
    notes = (
        f"Figures have one scale: black 0, white {reflectance(white)}, of differences -{reflectance(largest)} to "
        f"{reflectance(largest)}. At most {1 - _SHOWN:.1%} of the pixels of an image lie above.",
        *([f"Scales were matched: {'; '.join(matched)}."] if matched else []),
        *(["The truths differ: the folders show different scenes or light."] if truths and common is None else []),
    )
    captions = ["" if row["psnr"] is None else f"PSNR {row['psnr']:.2f} dB" for row in rows]
    shown = [(each.values, caption) for each, caption in zip(images, captions, strict=True)]
    names = [each.name + ("\nflagged" if each.warnings else "") for each in images]
    if common is not None:
        shown, names = [*shown, (common, "")], [*names, "truth"]
    signed = [(off, f"rms {row['rms_difference']:.2g}") for off, row in zip(offs[1:], rows[1:], strict=True)]
    grey = {"cmap": "gray", "norm": reflectance_norm(white)}, "reflectance, 1 = board, by the sRGB curve"
    colours = {"cmap": "RdBu_r", "vmin": -largest, "vmax": largest}, "difference [reflectance]"
    titles = [f"{each.name} \N{MINUS SIGN} {first.name}" for each in others]
    figures = {"images.png": image_grid({"": shown}, names, scale=grey)}
    figures["differences.png"] = image_grid({"": signed}, titles, scale=colours)
    reasons: dict[str, list[str]] = {}
    for name, text in ((each.name, text) for each in images for text in each.warnings):
        reasons.setdefault(text, []).append(name)
    warnings = tuple(
        f"{', '.join(names)} {'are' if len(names) > 1 else 'is'} flagged: {text}" for text, names in reasons.items()
    )
    with output_folder(output, overwrite=overwrite and is_earlier(Path(output), "compare")) as folder:
        drawn = write_figures(folder, figures, style)
        means = means_over_seeds(images, rows)
        done = Comparison(tuple(rows), white, largest, notes, warnings, str(folder), tuple(drawn), means)
        pictures = {file: page_figure(figure) for file, figure in drawn.items()}
        title = f"{len(images)} images, compared with {first.name}"
        section = Section("compare", title, title, title, pictures, done.tables(), warnings=warnings)
        write_page([section], folder / "compare.html", title)
        write_json(folder / "compare.json", {**done.payload(), "kind": "compare", "versions": versions()})
    return done

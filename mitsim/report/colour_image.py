"""Reflectances at spectral lines in, an image in colour out: its colours, and how far they are from what is known."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import validate
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError
from mitsim.core.exr import checksum, finite_channel, read_frame, verify_files, write_frame
from mitsim.core.files import PAGE, output_folder, read_json, remove_page, write_bytes
from mitsim.core.images import card, lightness, png
from mitsim.core.manifests import CalibrationManifest, read_manifest
from mitsim.core.runs import load_mosaic
from mitsim.core.spectral_manifests import COLOUR, IMAGE, ColourManifest, checked_colours, is_mosaic, write_colours
from mitsim.devices.chart import ChartPlace
from mitsim.metrics import Quality, psnr, summary_of
from mitsim.reconstruct.colour import ColourModel, chart, delta_e, linear_srgb
from mitsim.reconstruct.reconstruct import MADE_OF
from mitsim.reconstruct.request import IMAGE_FILE, PICTURE_FILE, RESULT_FILE
from mitsim.reconstruct.solution import Status
from mitsim.report.folder_page import truth_of, write_folder, write_page
from mitsim.report.folder_pictures import LARGEST, REFLECTANCE, SMALLEST, Picture, Scale, shown_error


@dataclass(frozen=True)
class Patch:
    """A patch of the chart.

    Attributes
    ----------
    name
        of its colour.
    delta_e
        CIE Delta E 2000 of its mean in the image to its spectrum in D65.
    floor
        the same of its spectrum at the lines, by the fixed matrix: what no camera behind these lines is below.
    truth
        the same of its mean in the truth, by the image's matrix; None without a truth.
    """

    name: str
    delta_e: float
    floor: float
    truth: float | None


@dataclass(frozen=True, eq=False)
class ColourImage:
    """An image in colour.

    Attributes
    ----------
    lines
        spectral lines and their names.
    images
        (n, n', lines) reflectances, 1 = the calibration's board.
    board
        reflectance of that board.
    model
        from reflectances to colours.
    truth
        (n, n', lines) what perfect images would show, relative to the board; None for a real camera.
    chart
        where the image shows the chart; None: it shows none, or nobody says so.
    """

    lines: ColourManifest
    images: FloatArray
    board: float
    model: ColourModel
    truth: FloatArray | None = None
    chart: ChartPlace | None = None

    @classmethod
    def of(
        cls,
        lines: ColourManifest,
        images: FloatArray,
        board: float | None,
        truth: FloatArray | None,
        place: ChartPlace | None,
    ) -> ColourImage:
        """The image, by a matrix fitted on the chart where it is known, else by the fixed one.

        Parameters
        ----------
        lines
            of the images.
        images, board
            (n, n', lines) relative to a board of that reflectance; None: unknown, and taken for 1.
        truth
            (n, n', lines) relative to it, too; None without one.
        place
            the chart in the image.

        Raises
        ------
        MitsimError
            where the chart lies outside the image.
        """
        model, board = ColourModel.of_lines(lines.wavelengths_nm), board or 1.0
        if place is not None:
            means = board * place.means(images)
            model = ColourModel.fit(lines.wavelengths_nm, means, "the chart in this image")
        return cls(lines, images, board, model, truth, place)

    @property
    def reflectances(self) -> FloatArray:
        """(n, n', lines) 1 = a perfect reflector."""
        return self.board * self.images

    @property
    def psnr_db(self) -> float | None:
        """Of all lines' images together: of the mean of their squared errors; None without a truth."""
        count = self.images.shape[0]
        return None if self.truth is None else psnr(self.images.reshape(count, -1), self.truth.reshape(count, -1))

    @cached_property
    def xyz(self) -> FloatArray:
        """(n, n', 3) CIE XYZ under D65; a perfect reflector has Y = 1."""
        return self.model.xyz(self.reflectances)

    @cached_property
    def truth_xyz(self) -> FloatArray | None:
        """(n, n', 3) the same of the truth, by the same matrix; None without one."""
        return None if self.truth is None else self.model.xyz(self.board * self.truth)

    @cached_property
    def delta_e(self) -> FloatArray | None:
        """(n, n') CIE Delta E 2000 of each pixel to the truth's, by the same matrix; None without a truth."""
        return None if self.truth_xyz is None else delta_e(self.xyz, self.truth_xyz)

    @cached_property
    def patches(self) -> tuple[Patch, ...]:
        """Of the chart; none where the image shows none."""
        if self.chart is None:
            return ()
        known, waves = chart(), self.lines.wavelengths_nm
        seen = delta_e(self.chart.means(self.xyz), known.xyz)
        floor = delta_e(ColourModel.of_lines(waves).xyz(known.at(waves)), known.xyz)
        truth = None if self.truth_xyz is None else delta_e(self.chart.means(self.truth_xyz), known.xyz)
        return tuple(
            Patch(name, float(seen[number]), float(floor[number]), None if truth is None else float(truth[number]))
            for number, name in enumerate(known.names)
        )

    @property
    def patch_means(self) -> list[float | None]:
        """Means over the patches of Delta E: found, floor, and the truth's; None where there are none."""
        known = ((getattr(patch, name) for patch in self.patches) for name in ("delta_e", "floor", "truth"))
        return [mean_of(value for value in values if value is not None) for values in known]

    def summary(self) -> dict[str, Any]:
        """For colour.json and the command line's JSON."""
        found, floor, _ = self.patch_means
        return {
            **self.model.summary(),
            "psnr": self.psnr_db,
            "delta_e": None if self.delta_e is None else float(self.delta_e.mean()),
            "delta_e_chart": found,
            "delta_e_floor": floor,
            "patches": [vars(patch) for patch in self.patches] or None,
        }

    @property
    def sentences(self) -> list[str]:
        """What the command line says of its colours."""
        sentences = [f"colours by a matrix fitted on {self.model.fitted_on}"]
        if self.delta_e is not None:
            sentences.append(f"Delta E 2000 of a pixel to the truth {self.delta_e.mean():.2f} in the mean")
        if self.patches:
            mean, floor, _ = self.patch_means
            sentences.append(f"of {len(self.patches)} patches to their spectra {mean:.2f}, floor {floor:.2f}")
        return sentences

    def write(self, folder: Path) -> dict[str, str]:
        """Write image.exr and image.png to a ``folder``; return their checksums by name. MitsimError when they cannot
        be written."""
        rgb = linear_srgb(self.xyz)
        named = dict(zip("RGBXYZ", np.moveaxis(np.concatenate([rgb, self.xyz], axis=-1), -1, 0), strict=True))
        channels = {name: values.astype(np.float32) for name, values in named.items()}
        image = write_frame(
            folder / IMAGE_FILE, channels, {"rgb": "linear sRGB", "xyz": "CIE 1931 under D65, perfect reflector Y = 1"}
        )
        picture = write_bytes(folder / PICTURE_FILE, png(rgb))
        return {IMAGE_FILE: image, PICTURE_FILE: picture}

    def _repr_html_(self) -> str:
        pictures = {"in colour\nsRGB under D65": linear_srgb(self.xyz)}
        if self.truth_xyz is not None:
            pictures["truth\nsRGB under D65"] = linear_srgb(self.truth_xyz)
        for number, name in enumerate(self.lines.names):
            pictures[f"{name}\nreflectance 0 to 1"] = self.reflectances[..., number]
        return card("Image in colour", pictures, self.sentences)


def board_of(calibration: Path, lines: ColourManifest) -> float | None:
    """Reflectance of the board that a ``calibration``'s images are relative to, the same for all ``lines``; None where
    it is not stated. MitsimError where lines have different boards."""
    boards = {read_manifest(calibration / name, CalibrationManifest).board_reflectance for name in lines.names}
    if len(boards) > 1:
        raise MitsimError(
            f"calibration {calibration}: its lines' boards reflect {boards}; calibrate all with one board"
        )
    return boards.pop()


def mean_of(values: Iterable[float]) -> float | None:
    """Mean of ``values``; None where there are none."""
    known = list(values)
    return float(np.mean(known)) if known else None


# -------- An image in colour with what is known of it, and its files


def one_paragraph(statuses: Mapping[str, Status]) -> tuple[str, ...]:
    """Return one warning on the ``statuses`` of a run's lines by name: each verdict once, with the sentence of the
    first line that has it, and each flag once; nothing where all lines can be used as they are."""
    flagged = {name: status for name, status in statuses.items() if not status.ok}
    parts = []
    for verdict in dict.fromkeys(status.verdict for status in flagged.values()):
        names = [name for name, status in flagged.items() if status.verdict is verdict]
        first = flagged[names[0]]
        alike = len({flagged[name].sentence for name in names}) == 1
        of_first = "" if alike else f" (so {names[0]}; the table has the others)"
        parts.append(f"{', '.join(names)}: {first.sentence}{of_first}{'; ' if first.remedy else ''}{first.remedy}.")
    flags = dict.fromkeys(flag for status in flagged.values() for flag in status.flags)
    return (" ".join([*parts, *flags]),) if parts else ()


@dataclass(frozen=True, eq=False)
class JudgedColours:
    """An image in colour, and how good it and the images of its lines are.

    Attributes
    ----------
    colours
        the image in colour.
    qualities
        of each line's image by its name; None without a truth.
    described
        sentences on how the images were found.
    facts
        the same by name, for the page.
    warnings
        what is wrong with the images.
    seconds
        by stage.
    output
        the folder that holds all.
    solution
        numbers of one solve for all lines, by the keys of the command line's JSON; none where each has its own.
    of_lines
        numbers of the solve of each line, by its name, where each has its own.
    """

    colours: ColourImage
    qualities: Mapping[str, Quality | None]
    described: Sequence[str]
    facts: Mapping[str, str]
    warnings: tuple[str, ...]
    seconds: Mapping[str, float]
    output: str
    solution: Mapping[str, Any] = field(default_factory=dict)
    of_lines: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def model(self) -> ColourModel:
        """From reflectances at the lines to colours."""
        return self.colours.model

    @property
    def reflectances(self) -> FloatArray:
        """(n, n', lines) reflectance at each line, 1 = a perfect reflector."""
        return self.colours.reflectances

    @property
    def xyz(self) -> FloatArray:
        """(n, n', 3) CIE XYZ under D65; a perfect reflector has Y = 1."""
        return self.colours.xyz

    @property
    def ok(self) -> bool:
        """Whether the images of all lines can be used as they are."""
        return not self.warnings

    @property
    def psnr_db(self) -> float | None:
        """Of all lines' images together: of the mean of their squared errors; None without a truth."""
        return self.colours.psnr_db

    @property
    def sentences(self) -> list[str]:
        """What the command line says of it."""
        return [*self.described, *self.colours.sentences]

    @property
    def table(self) -> dict[str, str]:
        """Return for each line that was solved by itself what differs between lines, in columns."""
        rows = {}
        for number, line in enumerate(self.colours.lines.names if self.of_lines else ()):
            found, size = self.of_lines[line], float(np.sqrt(np.square(self.colours.images[..., number]).mean()))
            fit = "" if found["misfit"] is None else f", chi-square {found['misfit']['chi_square']:.3g}"
            known = "" if found["uncertainty"] is None else f" +- {found['uncertainty']:.2e}"
            rows[line] = f"lambda {found['lambda']:.3g}{fit}, image {size:.2e}{known} rms"
        return rows

    def summary(self) -> dict[str, Any]:
        """All but the pictures, by the keys of the command line's JSON."""
        known = [found.ssim for found in self.qualities.values() if found and found.ssim]
        return {
            **self.solution,
            "channels": [
                {**line.model_dump(), **summary_of(self.qualities[line.name]), **self.of_lines.get(line.name, {})}
                for line in self.colours.lines.channels
            ],
            "ssim": mean_of(known),
            **self.colours.summary(),
            "warnings": self.warnings,
            "status": " ".join(self.warnings) or "Solved: every line's image can be used as it is.",
            "seconds": dict(self.seconds),
            "output": self.output,
        }

    def write(self, folder: Path, **inputs: Any) -> None:
        """Write the image in colour, and colour.json last, to a ``folder``; a page of an earlier one is removed.

        Parameters
        ----------
        folder
            that holds all.
        **inputs
            further entries of colour.json.
        """
        checksums = self.colours.write(folder)
        of_lines = (f"{name}/{IMAGE_FILE}" for name in self.colours.lines.names)
        checksums |= {name: checksum(folder / name) for name in of_lines if (folder / name).is_file()}
        parts = {key: value for key, value in self.summary().items() if key != "channels"}
        lines = ColourManifest(kind="colour-image", channels=self.colours.lines.channels)
        made = {
            "facts": {**self.facts, **self.table},
            "board_reflectance": self.colours.board,
            "chart": self.colours.chart,
            "checksums": checksums,
        }
        write_colours(folder, lines, **inputs, **parts, **made)

    def _repr_html_(self) -> str:
        return self.colours._repr_html_()


# -------- A folder of an image in colour in, its pictures and page out


def begin_image(folder: Path, lines: ColourManifest, **inputs: Any) -> None:
    """Note in colour.json that an image of ``lines`` is being made, so that the same work takes over a killed one's
    folder."""
    remove_page(folder)
    write_colours(folder, ColourManifest(kind="colour-image", channels=lines.channels), status="incomplete", **inputs)


def report_colours(folder: Path) -> Path:
    """Write the pictures and the page of an image in colour, and of those of its lines, from their files alone.

    Parameters
    ----------
    folder
        of the image; the page's path is returned.

    Raises
    ------
    MitsimError
        when its files are damaged or missing, or the folder cannot be written.
    """
    data = read_json(folder / COLOUR)
    lines = checked_colours(data, IMAGE, folder)
    if data.get("status") == "incomplete":
        raise MitsimError(f"{folder / COLOUR}: holds no result of a finished image; reconstruct it again")
    verify_files(folder, data.get("checksums"), "reconstruct it again")
    for name in lines.names:
        if (folder / name / RESULT_FILE).is_file():
            write_folder(folder / name)
    files = [folder / name / IMAGE_FILE for name in lines.names]
    stack = np.stack([finite_channel(read_frame(file)[0], "reflectance", file) for file in files], axis=-1)
    place = None if data.get("chart") is None else validate(ChartPlace, data["chart"], f"{folder / COLOUR}: chart")
    truth = _truth_of(folder, data, lines)
    image = ColourImage.of(
        lines,
        stack,
        data.get("board_reflectance"),
        truth if truth is not None and truth.shape == stack.shape else None,
        place,
    )
    with output_folder(folder, overwrite=True):
        write_page(
            folder,
            tuple(_pictures(image)),
            "colour.html",
            verdict=_verdict(image),
            lines=[_line(image, number) for number in range(len(lines.names))],
            patches=_patches(image),
            means=image.patch_means,
            matrix=[
                (axis, [f"{value:.4f}" for value in row]) for axis, row in zip("XYZ", image.model.matrix, strict=True)
            ],
            names=[f"{line.wavelength_nm:g} nm" for line in lines.channels],
            model=image.model.summary(),
            facts=data.get("facts") or {},
            warnings=data.get("warnings") or (),
            command=data.get("command"),
            board=image.board,
            versions=versions(),
        )
    return folder / PAGE


def _truth_of(folder: Path, data: Mapping[str, Any], lines: ColourManifest) -> FloatArray | None:
    """(n, n', lines) truths of the image in a ``folder`` whose colour.json has this ``data``, while its run is where it
    was."""
    run = Path(str((data.get(MADE_OF) or {}).get("run", folder)))
    if is_mosaic(run):
        try:
            shots = load_mosaic(run)
        except MitsimError:
            return None
        same = (data.get("inputs") or {}).get("run") == shots.shots.fingerprint
        return shots.truth(data.get("board_reflectance")) if same else None
    results = [folder / name / RESULT_FILE for name in lines.names]
    truths = [truth_of(read_json(path)) if path.is_file() else None for path in results]
    known = [truth for truth in truths if truth is not None]
    return np.stack(known, axis=-1) if len(known) == len(truths) else None


def _pictures(image: ColourImage) -> Iterator[Picture]:
    size = f"in sRGB under D65, {image.images.shape[0]} x {image.images.shape[1]} projector pixels"
    shown = {"image": ("The image", image.xyz), "truth": ("The truth", image.truth_xyz)}
    for name, (title, xyz) in shown.items():
        if xyz is not None:
            about = size if name == "image" else "what a perfect image of the same lines would show, by the same matrix"
            caption = f"{about}; white is a perfect reflector, and what lies beyond the screen's colours is cut"
            yield Picture(name, title, caption, png(linear_srgb(xyz), LARGEST, SMALLEST))
    if image.delta_e is not None:
        scale = Scale(0.0, max(shown_error(image.delta_e), 1.0), "Delta E 2000")
        about = "1 is about the least difference that an eye sees side by side"
        yield Picture.of("error", "How they differ", image.delta_e, scale, about)
    for number, line in enumerate(image.lines.channels):
        title = f"{line.wavelength_nm:g} nm"
        yield Picture.of(f"image_{line.name}", title, image.images[..., number], REFLECTANCE)
        if image.truth is not None:
            yield Picture.of(f"truth_{line.name}", f"{title}, truth", image.truth[..., number], REFLECTANCE)


def _verdict(image: ColourImage) -> tuple[str, str]:
    """Headline and detail."""
    quality = "" if image.psnr_db is None else f"PSNR of the {len(image.lines.names)} lines: {image.psnr_db:.1f} dB. "
    if image.patches:
        mean, floor, _ = image.patch_means
        return (
            f"Mean Delta E 2000 of {len(image.patches)} patches: {mean:.2f}",
            f"{quality}The floor is {floor:.2f}: these spectral lines alone, without a camera.",
        )
    if image.delta_e is not None:
        return f"Mean Delta E 2000 to the truth: {image.delta_e.mean():.2f}", f"{quality}Mean over all pixels."
    return f"An image from {len(image.lines.names)} spectral lines", "No truth to compare it with."


def _line(image: ColourImage, number: int) -> dict[str, Any]:
    """What is said of one spectral line."""
    line, truth = image.lines.channels[number], image.truth
    quality = None if truth is None else Quality.of(image.images[..., number], truth[..., number])
    return {
        "name": f"{line.wavelength_nm:g} nm",
        "share": None if line.radiant_share is None else f"{100 * line.radiant_share:.0f} %",
        "quality": quality,
    }


def _patches(image: ColourImage) -> list[dict[str, Any]]:
    """What is said of each patch, with the colours of its spectrum and of this image as a page names them."""
    if image.chart is None:
        return []
    colours = zip(_hexes(chart().xyz), _hexes(image.chart.means(image.xyz)), strict=True)
    return [{**vars(patch), "known": a, "seen": b} for patch, (a, b) in zip(image.patches, colours, strict=True)]


def _hexes(xyz: FloatArray) -> list[str]:
    return [f"#{bytes(level).hex()}" for level in np.rint(255 * lightness(linear_srgb(xyz))).astype(np.uint8)]

"""A list of captures of known pictures in; their frames, scenes and noise out, and what a model leaves of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.exr import checksum, finite_channel, read_frame
from mitsim.core.imagelist import BGGR, PLANES, Crop, Preparation, Wanted, planes_of
from mitsim.core.images import orient, own_end, read_image
from mitsim.core.job import Cost, Limits
from mitsim.core.manifests import MANIFEST
from mitsim.core.runs import load_run
from mitsim.devices.knownlist import KnownCapture, KnownCaptures, preparation_of
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.shifted_codes import (
    Exposure,
)
from mitsim.reconstruct.solver import centre_frame

_COLOURS = {"red": 0, "green": 1, "blue": 2}
_PICTURE = Wanted("picture", colour=True)
_REFLECTANCE = "reflectance"
"""Channel of an image, or of a truth, in OpenEXR."""


class KnownFrames:
    """All frames of a list, and what they are of.

    Parameters
    ----------
    captures
        the list, its runs and pictures; :meth:`of` reads them.

    Attributes
    ----------
    exposures
        frames and scenes.
    noises
        (exposures,) noise variance of a number of each frame by the sensor that its run states; NaN where it does not.
    saturated
        names of runs with readings at the full well or the ADC's end.
    frames
        shots that were read.
    sums
        SHA-256 of pictures and of the runs' manifests.
    prepared
        what the import did to files before they were frames.
    places
        of the planes of a colour sensor in its cell, down and to the right, in pixels of a plane.
    """

    def __init__(self, captures: KnownCaptures) -> None:
        self.exposures: list[Exposure] = []
        self.noises: list[float] = []
        self.saturated: list[str] = []
        self.frames = 0
        self.sums: dict[str, str] = {}
        self.prepared = preparation_of(next(iter(captures.manifests.values())), captures.path)
        self.places = plane_offsets(self.prepared)

    @classmethod
    def of(cls, captures: KnownCaptures, aged: Mapping[str, Factors] | None = None) -> KnownFrames:
        """Those of all ``captures``; MitsimError for files that cannot be read, pictures of another size, and runs of
        another camera than ``aged`` factors."""
        read = cls(captures)
        for number, capture in enumerate(captures.listed.known):
            picture = _picture(captures, capture)
            read.sums[capture.picture] = checksum(captures.picture(capture))
            for line in captures.manifests:
                if captures.lines is not None and line not in PLANES:
                    raise MitsimError(
                        f"list {captures.path}: {capture.run} has the line {line}, and lines of a projector see codes "
                        f"of their own; calibrate each alone, by runs such as {capture.run}/{line}"
                    )
                light = _plane(captures, capture, picture, line)
                read._add(captures, number, line, light, None if aged is None else aged[line])
        return read

    def _add(self, captures: KnownCaptures, number: int, line: str, light: FloatArray, aged: Factors | None) -> None:
        capture = captures.listed.known[number]
        folder = captures.run(capture, line)
        shots = load_run(folder)
        self.sums[str(Path(capture.run) / line)] = checksum(folder / MANIFEST)
        left, right = shots.patterns
        if light.shape != (len(left), len(right)):
            raise MitsimError(
                f"picture {captures.picture(capture)}: is {light.shape[0]} x {light.shape[1]} pixels, but the run "
                f"{folder} has {len(left)} x {len(right)} scene pixels; give one of its size"
            )
        first = self.exposures[0].frame.shape if self.exposures else None
        if aged is not None:
            aged.check_fit(shots)
            first = len(aged.left), len(aged.right)
        digital, centre = shots.manifest.digital, captures.listed.centre if aged is None else aged.manifest.centre
        saturated = 0
        for each in shots.pattern_measurements(first):
            if not self.exposures:
                count = len(captures.listed.known) * len(captures.manifests) * left.shape[1] * right.shape[1]
                held = Cost(memory_bytes=_COPIES * float(each.frame.nbytes) * count)
                held.check(f"list {captures.path}: its frames", Limits())
            frame = centre_frame(each.frame) if centre else each.frame
            scene = light * np.multiply.outer(left[:, each.row], right[:, each.column])
            self.exposures.append(Exposure(scene, frame, number, line, self.places.get(line, (0.0, 0.0))))
            variance = float(np.mean(np.maximum(digital.variance(each.light, each.shots), 0.0)))
            self.noises.append(variance if digital.noise_is_stated else np.nan)
            self.frames += each.shots
            saturated += each.saturated
        if saturated:
            self.saturated.append(str(Path(capture.run) / line))

    def noise(self, number: int, misfit: FloatArray) -> float:
        """Variance of noise in the exposure of a ``number``: what its sensor states; where it does not, what second
        differences of the ``misfit`` tell along rows and columns at once, in which there is hardly any scene."""
        if np.isfinite(self.noises[number]):
            return self.noises[number]
        guess = float(np.mean(np.square(np.diff(np.diff(misfit, 2, 0), 2, 1)))) / _OF_DIFFERENCES**2
        return guess / _differences_of_turned(misfit.shape, self.prepared)

    def misfit(self, models: Iterable[tuple[FloatArray, float]]) -> tuple[float, float, float]:
        """What models of all frames leave of them, centred: even light is explained whatever picture is named.

        Parameters
        ----------
        models
            frame by frame, with the variance of its numbers by errors that it is known to have.

        Returns
        -------
        float, float, float
            part of the energy that is explained; part, rms, that neither models nor noise explain; mean of misfit over
            noise.
        """
        excess = energy = total = 0.0
        ratios = []
        for number, (each, (model, error)) in enumerate(zip(self.exposures, models, strict=True)):
            misfit = centre_frame(each.frame - model)
            noise = self.noise(number, misfit) + error
            left_over = float(np.mean(np.square(misfit)))
            excess += left_over - noise
            total += left_over
            energy += float(np.mean(np.square(centre_frame(each.frame))))
            ratios.append(left_over / noise if noise > 0 else 1.0)
        return 1 - total / energy, float(np.sqrt(max(excess, 0.0) / energy)), float(np.mean(ratios))

    def warnings(self) -> Iterator[str]:
        """That runs are saturated, if any is."""
        if self.saturated:
            yield (
                f"saturation: {len(self.saturated)} runs have readings at the full well or the ADC's end, first "
                f"{self.saturated[0]}, so their frames are not linear; expose for less"
            )


_OF_DIFFERENCES = 6
"""Squares of 1, -2, 1 added up: variance of second differences of white noise over its own."""


def _differences_of_turned(shape: tuple[int, ...], how: Preparation) -> float:
    """Noise that second differences along rows and columns tell, over that which is there, in a frame of a ``shape``
    that was turned by bilinear interpolation: 4/9 where all places between pixels occur, 1 where none was turned.

    A pixel that is r of one neighbour and 1 - r of the other has r^2 + (1 - r)^2 of the noise, and its second
    differences, as of (r, 1 - 3 r, 3 r - 2, 1 - r), less.
    """
    angle, crop = np.radians(how.turn_deg), how.crop or Crop()
    pivot = (np.array(shape) - 1) / 2 if how.turn_about == "centre" else np.array([-crop.row, -crop.column])
    y, x = np.arange(shape[0])[:, None] - pivot[0], np.arange(shape[1]) - pivot[1]
    sources = np.cos(angle) * y + np.sin(angle) * x + pivot[0], np.cos(angle) * x - np.sin(angle) * y + pivot[1]
    kept, seen = np.ones(shape), np.ones(shape)
    for r in (source % 1 for source in sources):
        kept *= r**2 + (1 - r) ** 2
        seen *= (r**2 + (1 - 3 * r) ** 2 + (3 * r - 2) ** 2 + (1 - r) ** 2) / _OF_DIFFERENCES
    return float(seen.mean() / kept.mean())


def plane_offsets(how: Preparation) -> dict[str, tuple[float, float]]:
    """Place of each plane of a mosaic in its cell, down and to the right, in pixels of a plane, as frames that were
    prepared so show it.

    Parameters
    ----------
    how
        what was done to the frames.
    """
    cell = np.empty((2, 2), dtype=object)
    for name, place in planes_of(how.mosaic or BGGR).items():
        cell[place] = name
    turned = orient(cell, how.orientation) if isinstance(how.orientation, int) else cell
    return {str(turned[row, column]): (row / 2, column / 2) for row in (0, 1) for column in (0, 1)}


_COPIES = 4
"""Of all frames that are held at a time: as read, as they are compared, and what a model and its misfit take."""


def _picture(captures: KnownCaptures, capture: KnownCapture) -> FloatArray:
    """Light of a picture (rows, columns) or (rows, columns, 3), 1 at the largest number of its file."""
    path, gamma = captures.picture(capture), captures.listed.gamma
    if path.suffix.lower() == ".exr":
        channels = read_frame(path)[0]
        values = (
            finite_channel(channels, _REFLECTANCE, path) if _REFLECTANCE in channels else read_image(path, _PICTURE)
        )
    else:
        values = read_image(path, _PICTURE)
    if values.ndim == 3 and values.shape[2] != 3:
        raise MitsimError(f"picture {path}: has {values.shape[2]} channels; save it without transparency")
    light = np.asarray(values, dtype=np.float64) / (own_end(values) or 1.0)
    if gamma == 1:
        return light
    if light.min() < 0:
        raise MitsimError(f"picture {path}: has numbers below 0, which have no gamma; leave gamma out of the list")
    return np.asarray(light**gamma)


def _plane(captures: KnownCaptures, capture: KnownCapture, picture: FloatArray, line: str) -> FloatArray:
    """What the run's ``line`` sees of a ``picture``."""
    if picture.ndim == 2:
        if capture.colour is not None:
            raise MitsimError(
                f"list {captures.path}: picture {capture.picture} is grey; leave colour {capture.colour!r} out"
            )
        return picture
    if line:
        return picture[:, :, "rgb".index(line[0])]
    if capture.colour is None:
        raise MitsimError(
            f"list {captures.path}: picture {capture.picture} is in colour; say which plane {capture.run} shows, "
            f"colour = {', '.join(map(repr, _COLOURS))}, or give a grey one"
        )
    return picture[:, :, _COLOURS[capture.colour]]

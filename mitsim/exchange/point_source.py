"""Point spread function from a real camera's frames of one point source."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.files import output_file, resolve
from mitsim.core.headline import headline
from mitsim.core.images import Numbers, Preparer, image_header, read_images, write_numbers
from mitsim.core.job import Cost, Limits
from mitsim.core.manifests import Digital
from mitsim.core.picture_files import CORRECTIONS, image_files
from mitsim.core.runs import clipped_readings
from mitsim.devices.camera import PSF_BORDER
from mitsim.exchange.capture_list import Electronics, RealCapture
from mitsim.exchange.packed import check_range, survey

_UNLIKE = 2.0
"""Least ratio of a frame's difference from the mean to the median one that is more than noise."""
_MISJUDGED = 5.0
"""Median difference relative to the stated noise up to which the camera's file is wrong rather than all frames."""
_NOTHING = 1e-300
_NUMBER_BYTES = 48.0
_LIT, _SIDE = 5.0, 5
"""Deviations of the background above which the mean of 5 x 5 pixels is light."""
_EDGE = 0.05
"""Share of the mean light above which the edges are lit."""


def stack_point(source: Path, output: Path, known: RealCapture, overwrite: bool = False) -> dict[str, Any]:
    """Write the mean light [electrons/s] of all frames, less the background, to an NPY file.

    The array is (rows, columns), or (rows, columns, lines) for several lines. Without a stated crop it is cut to the
    light, whose centre becomes its middle. Return the output of the command line. MitsimError as for
    :func:`mitsim.exchange.packed.import_capture`.
    """
    if output.suffix.lower() != ".npy":
        raise ArgumentError("output", f"{output}: a point spread function is an array; give a file that ends in .npy")
    stated = (getattr(known.listed.prepare, name) for name in CORRECTIONS)
    if {*map(resolve, (source, *filter(None, stated)))} & {resolve(output), resolve(output).parent}:
        raise ArgumentError("output", f"{output}: lies among the frames that are read; choose another folder")
    files = image_files(source, known.wanted)
    size = image_header(files[0], known.wanted)[1]
    known = known.of_file(files[0], size)
    Cost(memory_bytes=_NUMBER_BYTES * math.prod(size)).check(f"stack of {source}", Limits())
    with output_file(output, overwrite) as place:
        camera, prepare = known.electronics()
        found = survey(files, known, camera, prepare)
        names = known.colours.names if known.colours else ("",)
        prepared = [Preparer.of(found.of_line(name), camera.digital, known.wanted) for name in names]
        light, saturated, unlike = _mean_light(files, known, camera, prepared)
        warnings = [*found.warnings, *unlike]
        if saturated:
            warnings.append(f"Saturated: {saturated} readings are at the end of the range or clipped; expose for less")
        edges = np.ones(light.shape[1:], dtype=bool)
        edges[PSF_BORDER:-PSF_BORDER, PSF_BORDER:-PSF_BORDER] = False
        background = np.median(light[:, edges], axis=1)
        noise = 1.4826 * np.median(np.abs(light[:, edges] - background[:, None]), axis=1)
        light -= background[:, None, None]
        left = float((background / np.maximum(light.mean(axis=(1, 2)), _NOTHING)).max())
        if prepare.dark and left > _EDGE:
            warnings.append(
                f"Lit edges: they have {left:.0%} of the mean light after the dark frames: light of the room, or light "
                "of the point that falls beside the sensor; take dark frames with the point alone covered"
            )
        lit = (uniform_filter(light, (0, _SIDE, _SIDE)) > _LIT / _SIDE * noise[:, None, None]).any(axis=0)
        ratio = float((light.max(axis=(1, 2)) / np.maximum(noise, _NOTHING)).min())
        if not lit.any() or ratio < _LIT:
            raise MitsimError(f"{source}: nothing is brighter than the frames' edges; expose for longer")
        if prepare.crop is None:
            light = _cut(light, lit)
        write_numbers(place, np.moveaxis(light, 0, -1).astype(np.float32).squeeze())
    rows, columns = light.shape[1:]
    count = len(found.places)
    made = f"Stacked {count} frame{'s' * (count > 1)} to a point spread function of {rows} x {columns} pixels"
    return {
        "headline": headline(made + (f" for each of {len(names)} lines" if names[0] else ""), warnings),
        "frames": count,
        "shape": [rows, columns],
        "output": str(output),
        "calibration_output": None,
        "holds": ["psf"],
        "left_out": [],
        "divided_by": found.prepare.divide_by,
        "planes": [name for name in names if name],
        "background": background.tolist(),
        "peak_to_noise": ratio,
        "saturated": saturated,
        "notes": [*found.notes, f"the brightest pixel is {ratio:.3g} times the noise of the background"],
        "warnings": warnings,
    }


def _mean_light(
    files: Sequence[Path], known: RealCapture, camera: Electronics, prepared: Sequence[Preparer]
) -> tuple[FloatArray, int, list[str]]:
    """Return the mean light (lines, rows, columns), the number of saturated readings, and warnings on single frames."""

    def frames() -> Iterator[tuple[Path, list[tuple[Digital, Numbers]]]]:
        for path in files:
            for values in read_images(path, known.wanted):
                check_range(path, values, camera, prepared[0].how.divide_by or 1)
                yield path, [(each.digital, each.frame(path, values)) for each in prepared]

    total: Any = 0.0
    count = saturated = 0
    for _, lines in frames():
        total, count = total + np.stack([digital.rate(dn) for digital, dn in lines]), count + 1
        for digital, dn in lines:
            end = digital.saturation_dn
            full = 0 if end is None else int(np.count_nonzero(dn >= end))
            saturated += full or clipped_readings(dn, float(dn.max()), digital)
    mean, off, stated = np.asarray(total / count), dict[str, float](), camera.digital.noise_is_stated
    for number, (path, lines) in enumerate(frames(), start=1):
        error = 0.0
        for (digital, dn), own in zip(lines, mean, strict=True):
            light = digital.rate(dn)
            gain = float(np.vdot(light, own) / max(np.vdot(own, own), _NOTHING))  # the lamp may flicker
            noise = float(np.maximum(digital.variance(light), 0.0).sum()) if stated else 1.0
            error += float(np.square(light - gain * own).sum()) / max(noise, _NOTHING) / len(lines)
        off[f"{path.name} ({number})"] = error
    usual = float(np.median([*off.values()]))
    unlike = [name for name, each in off.items() if each > _UNLIKE * usual]
    if not unlike and stated and usual > _MISJUDGED:
        unlike = [*off]
    if not unlike or count == 1:
        return mean, saturated, []
    named = f"{len(unlike)} of {count} differ from the mean by more than noise, {', '.join(unlike[:3])}"
    return mean, saturated, [f"Unlike frames: {named}; leave them out, or take them again with nothing moving"]


def _cut(light: FloatArray, lit: Any) -> FloatArray:
    """Return the part of the light (lines, rows, columns) that is ``lit``, about its centre and with a dark margin."""
    weight = np.where(lit, np.maximum(light, 0).sum(axis=0), 0)
    for axis in (0, 1):
        places, along = np.flatnonzero(lit.any(axis=1 - axis)), np.arange(lit.shape[axis])
        centre = round(float(np.average(along, weights=weight.sum(axis=1 - axis))))
        reach = max(centre - places[0], places[-1] - centre) + PSF_BORDER
        first, last = centre - reach, centre + reach + 1
        beside = max(-first, 0), max(last - lit.shape[axis], 0)
        part = [slice(None)] * 3
        part[axis + 1] = slice(max(first, 0), min(last, lit.shape[axis]))
        light = np.pad(light[tuple(part)], [beside if each == axis + 1 else (0, 0) for each in range(3)])
    return light

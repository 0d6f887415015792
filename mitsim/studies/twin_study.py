"""Real captures of two lensless cameras, compared with simulations of these cameras.

*FlatCam*. The codes of the mask are learned from the other captures and their authors' images
(:mod:`mitsim.reconstruct.known_pictures`), so that every frame is a prediction. The authors' image is put on an evenly
lit sheet, and a camera with a mask of the transmission (1 + c_r(row) c_c(column)) / 2 captures it, without diffraction,
because the learned codes contain it.

*DiffuserCam*. Caustics of a random relief differ in every draw, so that statistics are compared. The slopes of a normal
relief move light by d (n - 1) grad h (:mod:`mitsim.transport.plugins.lens`). The relief's correlation length, rms
move, blur and haze are those whose radial spectrum fits the public picture's best; the light is traced by Mitsuba.

Files lie in folders named as the public repositories: ``flatcam/fc_6.png``, .. and ``rec_6.png``, .. are raw captures
of a FlatCam behind a Bayer sensor and their authors' images; ``diffusercam/psf_sample.tif`` is a point spread function.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from mitsim.api.bench import open_bench
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import read_toml, shipped_path, validate
from mitsim.core.errors import MitsimError
from mitsim.core.images import Preparer, grey_png, read_image
from mitsim.core.manifests import Digital
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.picture_files import BGGR, PLANES, Preparation, Wanted, planes_of
from mitsim.core.seeds import stream
from mitsim.devices.camera import load_psf
from mitsim.reconstruct.known_pictures import Codes, Exposure, Pose, Shape, find_pose, fit_codes, plane_offsets
from mitsim.reconstruct.solver import centre_frame
from mitsim.report.pages import Value
from mitsim.studies import Captures, find_files
from mitsim.studies.framework.claims import Judged
from mitsim.studies.framework.experiment import Found, Point, Scope, Study
from mitsim.studies.framework.panels import Bars, Images
from mitsim.studies.framework.studio import Studio, single_precision
from mitsim.transport.plugins.lens import Diffuser, point_spread, random_relief

if TYPE_CHECKING:
    from pandas import DataFrame

# -------- Captures of a FlatCam: frames, their noise, and the codes of the mask

_RAW, _STEP = (1024, 1280), 64
"""Shape of a raw frame, whose numbers of 10 bits lie in the high bits of 16."""
PITCH_MM = 0.0106
"""Width of a plane's pixels: twice 5.3 um. Frames do not depend on it."""
_BLOCK, _SMOOTH = 48, 31
"""Side of the blocks of noise, and of the square of a pixel's mean light [pixels]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Measured(Exposure):
    """One plane of a capture: ``level`` and ``noise`` (m, m') [DN]; ``scene`` is the authors' image, 0 to 1.

    Row and column means are off the frame and the noise.
    """

    capture: str
    level: FloatArray
    noise: FloatArray

    @property
    def name(self) -> str:
        return f"{self.capture} {self.plane}"


@cache
def preparation() -> tuple[Preparer, int]:
    """Return the steps that place a plane, and the pixels per side of the authors' images."""
    path = shipped_path("calibration", "flatcam.toml")
    listed = read_toml(path)
    how = validate(Preparation, {**listed["prepare"], "mosaic": None, "channel": None}, f"list {path}")
    return Preparer.of(how, validate(Digital, listed["digital"], f"list {path}"), Wanted()), listed["n"]


def read_planes(frame: Path, image: Path) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return the whole raw plane [DN] and the authors' image (n, n), 0 to 1, by the plane's name.

    MitsimError for files that are no capture and its image.
    """
    numbers, n = read_image(frame, Wanted("capture")), preparation()[1]
    if numbers.shape != _RAW or (numbers % _STEP).any() or numbers.min() == numbers.max():
        raise MitsimError(
            f"capture {frame}: is {numbers.shape} of {numbers.min():g} to {numbers.max():g}; give the raw frame, {_RAW}"
            f" multiples of {_STEP}"
        )
    colours = read_image(image, Wanted("image", bits=(8,), colour=True))
    if colours.shape != (n, n, 3):
        raise MitsimError(f"image {image}: is {colours.shape}; give the authors', {n} x {n} of red, green and blue")
    return {
        name: (np.asarray(numbers[row::2, column::2] / _STEP), np.asarray(colours[..., "rgb".index(name[0])] / 255))
        for name, (row, column) in planes_of(BGGR).items()
    }


def read_captures(files: Captures, seed: int) -> list[Measured]:
    """Return every plane; MitsimError for files that are no captures."""
    (preparer, _), found = preparation(), []
    raw, offsets = {name: read_planes(*both) for name, both in files.items()}, plane_offsets(preparer.how)
    for plane in PLANES:
        gain, dark = noise_of([planes[plane][0] for planes in raw.values()])
        for name, planes in raw.items():
            whole, scene = planes[plane]
            light = np.maximum(ndimage.uniform_filter(whole, _SMOOTH), 0)
            draws = stream(seed, "twin", f"{name} {plane}").standard_normal(whole.shape)
            noise, level = (
                preparer.frame(files[name][0], each).astype(np.float64)
                for each in (draws * np.sqrt(gain * light + dark), whole)
            )
            place = scene, centre_frame(level), 0, plane, offsets[plane]
            found.append(Measured(*place, capture=name, level=level, noise=centre_frame(noise)))
    return found


def noise_of(planes: Sequence[FloatArray]) -> tuple[float, float]:
    """Return gain [DN per electron] and variance without light [DN^2] from the ``planes`` of several captures.

    Second differences along both axes remove the light: between the two green planes of a capture they correlate by
    less than 0.01. Their mean squares in blocks are a line over the means.
    """
    means, squares = [], []
    for plane in planes:
        fine = np.square(np.diff(np.diff(plane, 2, 0), 2, 1)) / 36
        light = plane[1:-1, 1:-1]
        corners = (range(0, side - _BLOCK, _BLOCK) for side in light.shape)
        for block in (np.s_[row : row + _BLOCK, column : column + _BLOCK] for row, column in product(*corners)):
            means.append(light[block].mean())
            squares.append(fine[block].mean())
    light, variance = np.array(means), np.array(squares)
    gain, dark = np.polyfit(light, variance, 1)
    if dark < 0 or gain <= 0:  # no dark light is seen: all noise is that of photons
        gain, dark = float(light @ variance / (light @ light)), 0.0
    return float(gain), float(dark)


@dataclass(frozen=True, eq=False)
class Learned:
    pose: Pose
    codes: Codes

    @classmethod
    def of(cls, planes: Sequence[Measured]) -> Learned:
        names = list(dict.fromkeys(each.capture for each in planes))
        exposures = [replace(each, group=names.index(each.capture)) for each in planes]
        pose = find_pose(exposures)
        turned = [each.turn_scene(pose.orientation) for each in exposures]
        return cls(pose, fit_codes(turned, Shape(pose.scales, 1, True)))

    def see(self, measured: Measured) -> Measured:
        return measured.turn_scene(self.pose.orientation)


# -------- The simulated camera

_MASK_MM, _SHEET_MM = 10.0, 1000.0
"""Sensor to mask and to sheet. Frames determine only the product of the mask's distance and an angle."""
_WIDER = 1.05
_TEMPLATE = Path(__file__).parent / "templates" / "twin_scene.xml"
"""Scene of the simulated camera, with $names in place of numbers."""


@single_threaded_blas()
def render(measured: Measured, codes: Codes, folder: Path, variant: str) -> FloatArray:
    """Return the expected electrons (m, m') of a simulated camera that sees a frame's scene through a mask of codes.

    ``folder`` gets the bench's files, which any verb accepts.
    """
    lines = [code[0] for code in codes.codes]
    feature = PITCH_MM * (1 - _MASK_MM / _SHEET_MM)
    # The sensor's middle sees the scene's at this number of the code; the drawing's middle is the axis.
    beside = [
        ((len(line) - 1) / 2 - ((side.sensor - 1 + side.scale * (side.scene - 1)) / 2 + offset)) * feature
        for line, side, offset in zip(lines, codes.sides, measured.offset, strict=True)
    ]
    height, width = (side.scale * feature / _MASK_MM * side.scene / 2 * _SHEET_MM for side in codes.sides)
    half = _WIDER * max(height, width)
    np.save(folder / "mask.npy", (1 + np.outer(*(line / np.abs(line).max() for line in lines))) / 2)
    (folder / "reflectance.png").write_bytes(grey_png(measured.scene))
    window = np.zeros((128, 256))
    window[:, 128:] = 1  # as the photograph's: the right half of a shifted lens
    (folder / "projector.png").write_bytes(grey_png(window))
    text = Template(_TEMPLATE.read_text("utf-8")).substitute(
        pitch=PITCH_MM, mask=_MASK_MM, sheet=_SHEET_MM, offset_row=beside[0], offset_column=beside[1],
        rows=codes.sides[0].sensor, columns=codes.sides[1].sensor, width=width, height=height, half=half,
        fov=2 * np.degrees(np.arctan(_WIDER * half / _SHEET_MM)), throw=2 * np.degrees(np.arctan(2 * half / _SHEET_MM)),
    )  # fmt: skip
    (folder / "scene.xml").write_text(text, encoding="utf-8")
    camera = f'name = "twin"\npixel_pitch_um = {PITCH_MM * 1e3}\nfull_well_e = inf\nread_noise_e = 0.0\n'
    camera += 'quantum_efficiency = 1.0\ngain_dn_per_e = 1.0\nsource = "mitsim study twin"\n'
    camera += f'[mask]\nkind = "drawing"\nfeature_mm = {feature!r}\nfile = "mask.npy"\n'
    (folder / "camera.toml").write_text(camera, encoding="utf-8")
    bench = open_bench(str(folder), variant, str(folder / "camera.toml"))
    plan = bench.plan("uniform", accuracy=1e-3, effects="-diffraction")
    expected = bench.capture(plan, exposure=0.01).electrons
    assert expected is not None, "a simulated capture has them"
    return np.asarray(expected[0], dtype=np.float64)


# -------- Explained part of a measured frame

CAUSES = "row and column means", "explained", "mask's code", "noise", "rest"
COLUMNS = tuple(f"part_{cause.replace(' ', '_')}" for cause in CAUSES)
"""Columns of the parts of a measured frame's energy by cause, in the order of their removal."""


@single_threaded_blas()
def compare(measured: Measured, codes: Codes, electrons: FloatArray, other: FloatArray) -> dict[str, Value]:
    """Return the columns of a measured frame beside simulated ``electrons`` (m, m'), of which only the scale is fitted.

    ``other`` is the scene of another capture.
    """
    frame, expected, noise = measured.frame, fitted(measured, electrons), energy(measured.noise)
    sides, simulated = codes.factors(measured.offset, measured.plane), centre_frame(electrons)
    model = sides[0] @ measured.scene @ sides[1].T
    own = float(np.vdot(model, simulated)) / energy(simulated)
    # Codes that are fitted to this frame alone take noise with them, a datum's for each number that they determine.
    # Two numbers are none: the scale of one side over the other, and of both, which `expected` has taken.
    shape = Shape((codes.sides[0].scale, codes.sides[1].scale), 1, True)
    better = fit_codes([measured], shape, codes.codes[1][0])
    left, right = better.factors(measured.offset, measured.plane)
    taken = noise / frame.size * (sum(better.told) - 2)
    whole, rest = energy(measured.level - measured.level.mean()), energy(frame - left @ measured.scene @ right.T)
    missed = energy(frame - expected)
    parts = whole - energy(frame), energy(frame) - missed, missed - rest - taken, noise, rest + taken - noise
    return {
        "frame": measured.name,
        "correlation": correlation(frame, expected),
        "correlation_other_scene": correlation(frame, sides[0] @ other @ sides[1].T),
        "explained": 1 - missed / energy(frame),
        "chi_square": missed / max(noise, np.finfo(float).tiny),
        "noise": noise / energy(frame),
        "render_error": float(np.linalg.norm(own * simulated - model) / np.linalg.norm(model)),
        **{column: part / whole for column, part in zip(COLUMNS, parts, strict=True)},
    }


def fitted(measured: Measured, electrons: FloatArray) -> FloatArray:
    """Return expected ``electrons`` (m, m') without row and column means, in the scale of a measured frame [DN]."""
    simulated = centre_frame(electrons)
    return np.asarray(np.vdot(measured.frame, simulated) / energy(simulated) * simulated)


def energy(values: FloatArray) -> float:
    return float(np.vdot(values, values))


def correlation(first: FloatArray, second: FloatArray) -> float:
    return float(np.corrcoef(first.ravel(), second.ravel())[0, 1])


# -------- A DiffuserCam's point spread function, and diffusers with its statistics

_REDUCE = 4
SPREAD_MM = _REDUCE * 5.86e-3
"""Width of binned pixels; all lengths are proportional to it."""
_CORRELATION_MM, _MOVE_MM, _BLUR, _HAZE = 0.2402, 0.1254, 0.6, 0.25
"""Correlation length, rms move of light, blur [pixels] and even part of the light that fitted the radial spectrum of
``psf_sample.tif`` best, by periods of 2.5 to 70 pixels."""
TRACED, _RAYS = 6, 2048
"""Simulated diffusers, and rays per side."""
_LIT, _SURE, _LEAST = 0.2, 12.0, 140
"""Part of the brightest smoothed light that counts as lit; width of the smoothing, and least lit width [pixels]."""
_MARGIN_MM = 1.2


def statistics(light: FloatArray) -> tuple[float, float]:
    """Return the contrast of light, and the share of it in the brightest twentieth of the pixels."""
    ordered = np.sort(light.ravel())
    count = max(1, round(0.05 * light.size))
    return float(light.std() / light.mean()), float(ordered[-count:].sum() / ordered.sum())


def read_spread(path: Path) -> FloatArray:
    """Return the lit square of a point spread function; MitsimError for one in colour or with too small a lit part."""
    if read_image(path, Wanted("point spread function", colour=True)).ndim != 2:
        raise MitsimError(f"point spread function {path}: is in colour; give the sensor's own grey picture")
    light = load_psf(path, _REDUCE)
    smooth = ndimage.gaussian_filter(light, _SURE)
    lit = smooth > _LIT * smooth.max()
    ends = [np.flatnonzero(lit.any(axis=axis))[[0, -1]] for axis in (1, 0)]
    middle = [int(each.mean()) for each in ends]
    half = int(min(np.ptp(each) for each in ends) / 2 - _SURE)
    if 2 * half < _LEAST:
        raise MitsimError(
            f"point spread function {path}: its lit part is {max(2 * half, 0)} pixels wide; a twin needs {_LEAST}, so "
            "give a larger picture"
        )
    return light[middle[0] - half : middle[0] + half, middle[1] - half : middle[1] + half]


def simulated_spreads(count: int, seed: int) -> list[FloatArray]:
    """Return squares of light (count, count) behind random diffusers."""
    squares, glass = [], Diffuser()
    slope = _MOVE_MM / (glass.distance_mm * (glass.index - 1))
    for each in range(TRACED):
        relief = random_relief(count * SPREAD_MM + 2 * _MARGIN_MM, _CORRELATION_MM, slope, seed + each)
        traced = point_spread(Diffuser(relief), (count, count), SPREAD_MM, rays=_RAYS, seed=each)
        squares.append((1 - _HAZE) * ndimage.gaussian_filter(traced / traced.mean(), _BLUR) + _HAZE)
    return squares


# -------- The study

_DIFFUSER, _SHOWN, _BRIGHT = "diffuser", 160, 3.0
"""Value of the column capture; shown pixels; standard deviations from grey to white."""
_RENDERED = 0.1
"""Relative error of a simulated frame from which a twin is not reliable."""


def _points(scope: Scope) -> list[Point]:
    captures, psf = find_files(None if scope.data is None else Path(scope.data))
    for both in captures.values():  # refused before there is a folder
        read_planes(*both)
    if psf is not None:
        read_spread(psf)
    named = [*product(captures, PLANES), *([(_DIFFUSER, "")] if psf else [])]
    return [
        Point.of(scope.setup, data=scope.data, capture=capture, plane=plane, seed=scope.seeds[0])
        for capture, plane in named
    ]


def _measure(studio: Studio, point: Point) -> Found:
    (captures, psf), seed, name = find_files(Path(point["data"])), int(point["seed"]), str(point["capture"])
    if name == _DIFFUSER:
        assert psf is not None, "there is a point of it"
        return _measure_diffuser(point, read_spread(psf), seed)
    planes = studio.once("captures", 1, (point["data"], seed), lambda: read_captures(captures, seed))
    others = [each for each in planes if each.capture != name]
    learned = studio.once("codes", 1, (point["data"], seed, name), lambda: Learned.of(others))
    measured = next(each for each in planes if each.name == f"{name} {point['plane']}")
    seen, other = learned.see(measured), next(each for each in others if each.plane == measured.plane)
    electrons = render(seen, learned.codes, studio.folder("twin"), point.setup.variant)
    row = compare(seen, learned.codes, electrons, learned.see(other).scene)
    reasons = {
        "the other captures do not determine how images lie before the mask; give more captures":
            not learned.pose.certain,
        "another capture's scene explains the frame no worse; check that each capture lies with its own image":
            float(str(row["correlation"])) <= float(str(row["correlation_other_scene"])),
        f"the simulated frame is more than {_RENDERED:.0%} off the product of its factors; report this":
            float(str(row["render_error"])) > _RENDERED,
    }  # fmt: skip
    found = [text for text, holds in reasons.items() if holds]
    row |= {"orientation": learned.pose.orientation, "flagged": bool(found), "reason": "; ".join(found)}
    for side, scale, told in zip(("rows", "columns"), learned.pose.scales, learned.codes.told, strict=True):
        row |= {f"scale_{side}": float(scale), f"told_{side}": float(told)}
    expected = fitted(seen, electrons)
    frames = {"measured": seen.frame, "simulated": expected + seen.noise, "difference": seen.frame - expected}
    middle = tuple(slice(max(0, (side - _SHOWN) // 2), (side + _SHOWN) // 2) for side in seen.frame.shape)
    shown = {name: 0.5 + frame[middle] / (2 * _BRIGHT * seen.frame.std()) for name, frame in frames.items()}
    return Found((point.row(kind="frame", **row),), single_precision(shown))


def _measure_diffuser(point: Point, square: FloatArray, seed: int) -> Found:
    simulated = simulated_spreads(len(square), seed)
    lights = {"measured": square, **{f"simulated {number}": each for number, each in enumerate(simulated, 1)}}
    rows = []
    for name, light in lights.items():
        contrast, brightest = statistics(light)
        named: dict[str, Value] = {"kind": _DIFFUSER, "source": name.split()[0], "draw": name}
        rows.append(point.row(**named, contrast=contrast, brightest=brightest))
    # The root of light, because a few pixels are many times as bright as their mean.
    shown = {name: np.sqrt(lights[name] / lights[name].mean()) / _BRIGHT for name in ("measured", "simulated 1")}
    return Found(tuple(rows), single_precision(shown))


def _own_scene(rows: DataFrame) -> tuple[str, bool]:
    apart = (rows["correlation"] - rows["correlation_other_scene"]).astype(float)
    low, high = rows["correlation"].min(), rows["correlation"].max()
    text = f"correlation {low:.3f} to {high:.3f}, by {apart.min():.3f} to {apart.max():.3f} higher"
    return text, bool((apart > 0).all())


def _noise_left(rows: DataFrame) -> tuple[str, bool]:
    low, high = rows["chi_square"].min(), rows["chi_square"].max()
    return f"chi-square {low:.2f} to {high:.2f}", bool(high < 2)


def _alike(rows: DataFrame, column: str) -> tuple[str, bool]:
    found = {name: own[column].astype(float) for name, own in rows.groupby("source")}
    measured, simulated = float(found["measured"].iloc[0]), found["simulated"]
    text = f"{measured:.3f} against {simulated.mean():.3f} \N{PLUS-MINUS SIGN} {simulated.std():.3f}"
    return text, bool(abs(simulated.mean() / measured - 1) < 0.2)


_FRAMES, _DIFFUSERS = {"kind": "frame"}, {"kind": _DIFFUSER}
_claim = partial(Judged, optional=True)
STUDY = Study(
    "twin",
    "Real captures beside their simulation",
    "What do simulations of two real cameras explain of these cameras' frames, and by which causes do they differ?",
    points=_points,
    measure=_measure,
    claims=(
        _claim("Every frame is predicted better by its own scene than by another capture's", _own_scene, where=_FRAMES),
        _claim("A simulated frame leaves less than twice the energy of the noise", _noise_left, where=_FRAMES),
        _claim("Simulated diffusers have the contrast of light of the real one within a fifth",
               partial(_alike, column="contrast"), where=_DIFFUSERS),
        _claim("Simulated diffusers have the light in the brightest pixels of the real one within a fifth",
               partial(_alike, column="brightest"), where=_DIFFUSERS),
    ),
    panels=(
        Images({"measured": ("measured", ""), "simulated": ("simulated, with noise", "correlation {correlation:.3f}"),
                "difference": ("measured less simulated", "")}, file="frames", down=("frame",),
               title=f"Middle {_SHOWN} x {_SHOWN} pixels, row and column means off", where=_FRAMES | {"plane": "gb"}),
        Bars("frame", file="causes", where=_FRAMES, title="Energy that the simulation leaves, by cause",
             colour=dict(zip(COLUMNS[2:], CAUSES[2:], strict=True)), x_label="part of the frame's energy [1]"),
        Images({"measured": ("measured", ""), "simulated 1": ("simulated", "")}, file=_DIFFUSER, down=("source",),
               title="Root of light over its mean", where=_DIFFUSERS | {"draw": "measured"}),
    ),
    about="Frames are planes of the Bayer sensor: red, green beside blue, green beside red, blue. The mask's codes are "
    "learned from the other captures and their images; one number is fitted, the light. The correlation with another "
    "capture's scene is what bright scenes have in common. Parts of the energy are removed in order; noise that a fit "
    "takes with it counts as noise. The simulated diffusers have a correlation length of 0.24 mm, move light by 0.13 "
    "mm rms, are blurred by 0.6 pixels, and a quarter of the light is even: so fitted to the measured spectrum, by "
    "pixels of 23.4 um, which the public file does not state. Contrast and brightest pixels were not fitted.",
    heads=("", "", "Found"),
    traced=False,
)  # fmt: skip

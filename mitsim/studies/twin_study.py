"""Real captures of two lensless cameras, compared with simulations of these cameras.

*FlatCam*. The codes of the mask are learned from the other captures and their authors' images
(:mod:`mitsim.reconstruct.shifted_codes`), so that every frame is a prediction. The authors' image is put on an evenly
lit sheet, and a camera with a mask of the transmission (1 + c_r(row) c_c(column)) / 2 captures it, without diffraction,
because the learned codes contain it.

*DiffuserCam*. Caustics of a random relief differ in every draw, so that statistics are compared. The slopes of a normal
relief move light by d (n - 1) grad h (:mod:`mitsim.transport.plugins.diffuser`). The relief's correlation length, rms
move, blur and haze are fitted by landing rays of small slopes on a grid; the compared light is traced by Mitsuba.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy import ndimage

from mitsim.api.bench import open_bench
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import read_toml, shipped_path, validate
from mitsim.core.environment import load_variant
from mitsim.core.errors import MitsimError
from mitsim.core.imagelist import BGGR, PLANES, Preparation, Wanted, planes_of
from mitsim.core.images import Numbers, grey_png, read_image
from mitsim.core.manifests import Digital
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.prepare import CommonFactor, Preparer
from mitsim.core.seeds import stream
from mitsim.devices.mask_profile import load_psf
from mitsim.devices.sensor import SensorModel
from mitsim.reconstruct.shifted_codes import Codes, Exposure, Pose, Shape, find_pose, fit_codes, plane_offsets
from mitsim.reconstruct.solver import centre_frame
from mitsim.report.pages import Value
from mitsim.sensor.chain import expose
from mitsim.studies.framework.claims import Judged
from mitsim.studies.framework.experiment import Found, Point, Scope, Study
from mitsim.studies.framework.panels import Bars, Images, Lines
from mitsim.studies.framework.studio import Studio, single_precision
from mitsim.studies.twin_files import TwinFiles
from mitsim.transport.plugins.diffuser import Diffuser, Relief, point_spread, random_relief

if TYPE_CHECKING:
    from pandas import DataFrame

# -------- Captures of a FlatCam: frames, their noise, and the codes of the mask

_RAW = 1024, 1280
PITCH_MM = 0.0106
"""Width of a plane's pixels: twice 5.3 um. Frames do not depend on it."""
EXPOSURE_S = 0.01
_BLOCK, _SMOOTH = 48, 31
"""Side of the blocks of noise, and of the square of a pixel's mean light [pixels]."""


@dataclass(frozen=True, eq=False)
class Measured:
    """One plane of a capture: ``level`` and ``noise`` (m, m') [DN], the authors' image ``scene`` (n, n'), 0 to 1,
    ``gain`` [DN per electron] and ``read_variance`` [DN^2] of the raw plane.
    """

    capture: str
    plane: str
    offset: tuple[float, float]
    level: FloatArray
    noise: FloatArray
    scene: FloatArray
    gain: float
    read_variance: float

    @property
    def name(self) -> str:
        return f"{self.capture} {self.plane}"

    @cached_property
    def frame(self) -> FloatArray:
        return centre_frame(self.level)

    def exposure(self, frame: FloatArray | None = None, group: int = 0) -> Exposure:
        return Exposure(self.scene, self.frame if frame is None else frame, group, self.plane, self.offset)


@dataclass(frozen=True)
class Recipe:
    """Contents of `calibration/flatcam.toml`, with ``n`` scene pixels a side."""

    how: Preparation
    digital: Digital
    bits: int
    n: int

    @classmethod
    def load(cls) -> Recipe:
        path = shipped_path("calibration", "flatcam.toml")
        listed = read_toml(path)
        how = validate(Preparation, listed["prepare"], f"list {path}")
        return cls(how, validate(Digital, listed["digital"], f"list {path}"), listed["bits"], listed["n"])

    def planes(self, path: Path) -> dict[str, FloatArray]:
        """Return the whole planes [DN]; MitsimError for a file that is no capture."""
        numbers = read_image(path, Wanted("capture", mosaic=self.how.mosaic))
        if numbers.shape != _RAW:
            raise MitsimError(f"capture {path}: is {_size(numbers)}; give the raw frame, {_RAW[0]} x {_RAW[1]}")
        common, largest = CommonFactor(), 2**self.bits - 1
        common.add(numbers)
        factor = common.shift(largest)
        if not 0 <= numbers.min() < numbers.max() <= factor * largest:
            raise MitsimError(
                f"capture {path}: holds {numbers.min():g} to {numbers.max():g}, no light in numbers of {self.bits} "
                "bits; give the raw frame"
            )
        places = planes_of(self.how.mosaic or BGGR)
        return {name: np.asarray(numbers[places[name][0] :: 2, places[name][1] :: 2] / factor) for name in PLANES}

    def place(self, plane: FloatArray) -> FloatArray:
        how = self.how.model_copy(update={"channel": None, "mosaic": None, "divide_by": 1})
        return Preparer.of(how, self.digital, Wanted()).frame(Path(), plane).astype(np.float64)

    def scene(self, path: Path) -> FloatArray:
        """Return the authors' image (n, n, 3), 0 to 1; MitsimError for another size."""
        image = read_image(path, Wanted("image", bits=(8,), colour=True))
        if image.shape != (self.n, self.n, 3):
            raise MitsimError(
                f"image {path}: is {_size(image)}; give the authors', {self.n} x {self.n} of red, green and blue"
            )
        return np.asarray(image / 255, dtype=np.float64)


def _size(values: Numbers) -> str:
    return " x ".join(map(str, values.shape))


def read_captures(files: Mapping[str, tuple[Path, Path]], seed: int) -> list[Measured]:
    """Return every plane; MitsimError for files that are no captures."""
    recipe, found = Recipe.load(), []
    raw = {name: recipe.planes(frame) for name, (frame, _) in files.items()}
    offsets = plane_offsets(recipe.how)
    scenes = {name: recipe.scene(image) for name, (_, image) in files.items()}
    for plane in PLANES:
        gain, dark = noise_of([planes[plane] for planes in raw.values()])
        for name, planes in raw.items():
            noise = recipe.place(draw_noise(planes[plane], gain, dark, seed, f"{name} {plane}"))
            scene, level = scenes[name][..., "rgb".index(plane[0])], recipe.place(planes[plane])
            found.append(Measured(name, plane, offsets[plane], level, centre_frame(noise), scene, gain, dark))
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


def draw_noise(plane: FloatArray, gain: float, read_variance: float, seed: int, name: str) -> FloatArray:
    sensor = SensorModel(
        name="twin", pixel_pitch_um=PITCH_MM * 1e3, full_well_e=float("inf"), gain_dn_per_e=gain,
        read_noise_e=float(np.sqrt(read_variance)) / gain, source="mitsim study twin",
    )  # fmt: skip
    light = np.maximum(ndimage.uniform_filter(plane, _SMOOTH), 0)
    shot, read = (stream(seed, "twin", kind, name) for kind in ("shot", "read"))
    return np.asarray(expose(light / gain, EXPOSURE_S, sensor, shot, read) - light, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Learned:
    pose: Pose
    codes: Codes

    @classmethod
    def of(cls, planes: Sequence[Measured]) -> Learned:
        names = list(dict.fromkeys(each.capture for each in planes))
        exposures = [each.exposure(group=names.index(each.capture)) for each in planes]
        pose = find_pose(exposures)
        turned = [each.turn_scene(pose.orientation) for each in exposures]
        return cls(pose, fit_codes(turned, Shape(pose.scales, 1, True)))

    def see(self, measured: Measured) -> Measured:
        return replace(measured, scene=measured.exposure().turn_scene(self.pose.orientation).scene)


# -------- The simulated camera

_MASK_MM, _SHEET_MM = 10.0, 1000.0
"""Sensor to mask and to sheet. Frames determine only the product of the mask's distance and an angle."""
_ACCURACY = 1e-3
_WIDER = 1.05
_SCENE = Template("""<scene version="3.0.0">
<integrator type="path"><integer name="max_depth" value="2"/></integrator>
<sensor type="mitsim_lensless" id="camera">
    <float name="pixel_pitch" value="$pitch"/><float name="mask_distance" value="$mask"/>
    <float name="mask_offset_row" value="$offset_row"/><float name="mask_offset_column" value="$offset_column"/>
    <float name="scene_distance" value="$sheet"/><float name="fov" value="$fov"/>
    <film type="hdrfilm"><integer name="width" value="$columns"/><integer name="height" value="$rows"/>
        <rfilter type="box"/><string name="pixel_format" value="luminance"/>
        <string name="component_format" value="float32"/></film>
    <sampler type="independent"><integer name="sample_count" value="16"/></sampler>
</sensor>
<emitter type="projector" id="projector">
    <transform name="to_world"><translate x="$half" y="0" z="0"/></transform>
    <string name="fov_axis" value="x"/><float name="fov" value="$throw"/><float name="scale" value="1e6"/>
    <texture name="irradiance" type="bitmap"><string name="filename" value="projector.png"/>
        <boolean name="raw" value="true"/><string name="filter_type" value="nearest"/>
        <string name="wrap_mode" value="clamp"/></texture>
</emitter>
<shape type="rectangle" id="sheet">
    <transform name="to_world"><rotate z="1" angle="180"/><scale x="$width" y="$height" z="1"/>
        <translate z="$sheet"/></transform>
    <boolean name="flip_normals" value="true"/>
    <bsdf type="diffuse"><texture name="reflectance" type="bitmap"><string name="filename" value="reflectance.png"/>
        <boolean name="raw" value="true"/><string name="filter_type" value="nearest"/>
        <string name="wrap_mode" value="clamp"/></texture></bsdf>
</shape>
</scene>
""")


@single_threaded_blas()
def render(measured: Measured, codes: Codes, folder: Path, variant: str) -> FloatArray:
    """Return the expected electrons (m, m') of a simulated camera that sees a frame's scene through a mask of
    ``codes``.

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
    text = _SCENE.substitute(
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
    plan = bench.plan("uniform", accuracy=_ACCURACY, effects="-diffraction")
    expected = bench.capture(plan, exposure=EXPOSURE_S).electrons
    assert expected is not None, "a simulated capture has them"
    return np.asarray(expected[0], dtype=np.float64)


# -------- Explained part of a measured frame

CAUSES = ("row and column means", "explained", "scale", "smooth field", "mask's code", "scene's image", "noise", "rest")
"""Parts of a measured frame's energy, in the order of their removal."""
_DEGREE = 3
_LAMBDAS = np.geomspace(1e-6, 1e2, 49)
"""Weights of the scene's correction over its largest singular value squared."""


def column_of(cause: str) -> str:
    return f"part_{cause.replace(' ', '_')}"


@single_threaded_blas()
def compare(measured: Measured, codes: Codes, electrons: FloatArray, other: FloatArray) -> dict[str, Value]:
    """Return the columns of a measured frame beside simulated ``electrons`` (m, m'), of which only the scale is fitted.

    ``other`` is the scene of another capture.
    """
    frame, expected = measured.frame, fitted(measured, electrons)
    simulated, left = centre_frame(electrons), frame - expected
    sides = codes.factors(measured.offset, measured.plane)
    model = sides[0] @ measured.scene @ sides[1].T
    scale, own = (float(np.vdot(each, simulated)) / _energy(simulated) for each in (frame, model))
    parts = _parts(measured, codes, expected, scale / own)
    return {
        "frame": measured.name,
        "correlation": correlation(frame, expected),
        "correlation_other_scene": correlation(frame, sides[0] @ other @ sides[1].T),
        "explained": 1 - _energy(left) / _energy(frame),
        "chi_square": _energy(left) / max(_energy(measured.noise), np.finfo(float).tiny),
        "noise": _energy(measured.noise) / _energy(frame),
        "scale": scale / own,
        "gain_dn_per_e": measured.gain,
        "read_variance_dn2": measured.read_variance,
        "rows": correlation(measured.level.mean(axis=1), electrons.mean(axis=1)),
        "columns": correlation(measured.level.mean(axis=0), electrons.mean(axis=0)),
        "level": float(measured.level.mean() / (abs(scale) * electrons.mean())),
        "render_error": float(np.linalg.norm(own * simulated - model) / np.linalg.norm(model)),
        **{column_of(name): float(part) for name, part in zip(CAUSES, parts, strict=True)},
    }


def fitted(measured: Measured, electrons: FloatArray) -> FloatArray:
    """Return expected ``electrons`` (m, m') without row and column means, in the scale of a measured frame [DN]."""
    simulated = centre_frame(electrons)
    return np.asarray(np.vdot(measured.frame, simulated) / _energy(simulated) * simulated)


def _parts(measured: Measured, codes: Codes, expected: FloatArray, gain: float) -> FloatArray:
    """Return the parts of a measured frame's energy by :data:`CAUSES`; noise that a correction fits counts as noise."""
    frame, noise = measured.frame, _energy(measured.noise)
    whole, level = _energy(measured.level - measured.level.mean()), noise / measured.frame.size
    field, smooth = _smooth_field(frame - expected, expected)
    mended = measured.exposure(frame - field)
    shape = Shape((codes.sides[0].scale, codes.sides[1].scale), 1, True)
    better = fit_codes([mended], shape, codes.codes[1][0])
    left, right = better.factors(mended.offset, measured.plane)
    rest = mended.frame - left @ measured.scene @ right.T
    more, corrected = _scene_correction(rest, (left, right), level)
    energies = [whole, *map(_energy, (frame, frame - expected / gain, frame - expected, mended.frame - expected))]
    energies += [_energy(rest), _energy(rest - more)]
    # Two of the codes' numbers are none: the scale of one side over the other, and of both, which `scale` has taken.
    free = np.array([0.0, 0.0, 1.0, smooth, sum(better.told) - 2, corrected])
    return np.array([*(-np.diff(energies) - level * free), noise, energies[-1] + level * free.sum() - noise]) / whole


def _smooth_field(rest: FloatArray, expected: FloatArray) -> tuple[FloatArray, float]:
    sides = [legvander(np.linspace(-1, 1, count), _DEGREE).astype(np.float64) for count in rest.shape]
    degrees = [each for each in product(range(_DEGREE + 1), repeat=2) if 0 < sum(each) <= _DEGREE]
    shapes: list[FloatArray] = [np.outer(sides[0][:, row], sides[1][:, column]) for row, column in degrees]
    # Light along one axis alone is a mean of rows or columns, which frames do not have.
    light = [shape for shape, each in zip(shapes, degrees, strict=True) if min(each)]
    fields = [expected * shape for shape in shapes] + light
    design = np.stack([centre_frame(each).ravel() for each in fields], axis=1)
    found = np.linalg.solve(design.T @ design, design.T @ rest.ravel())
    return (design @ found).reshape(rest.shape), float(len(fields))


def _scene_correction(
    rest: FloatArray, factors: tuple[FloatArray, FloatArray], level: float
) -> tuple[FloatArray, float]:
    """Return the frame of a correction of the scene, by Tikhonov with the weight of least risk, and its number of
    parameters.
    """
    (left, first, _), (right, second, _) = (np.linalg.svd(each, full_matrices=False) for each in factors)
    seen, strength = left.T @ rest @ right, np.square(np.outer(first, second))
    largest = strength.max()

    def part(lam: float) -> FloatArray:
        return np.asarray(strength / (strength + lam * largest))

    def risk(lam: float) -> float:
        return float(np.square((1 - part(lam)) * seen).sum() + 2 * level * part(lam).sum())

    kept = part(min(_LAMBDAS, key=risk))
    return left @ (kept * seen) @ right.T, float((2 * kept - kept**2).sum())


def _energy(values: FloatArray) -> float:
    return float(np.vdot(values, values))


def correlation(first: FloatArray, second: FloatArray) -> float:
    return float(np.corrcoef(first.ravel(), second.ravel())[0, 1])


# -------- A DiffuserCam's point spread function, and diffusers with its statistics

_REDUCE = 4
SPREAD_MM = _REDUCE * 5.86e-3
"""Width of binned pixels; all lengths are proportional to it."""
CORRELATIONS_MM, MOVES_MM = np.geomspace(0.15, 0.45, 8), np.geomspace(0.05, 0.25, 8)
"""Trial correlation lengths and rms moves of light."""
BLURS, HAZES = np.linspace(0.0, 2.0, 11), np.linspace(0.0, 0.5, 11)
"""Trial blurs [pixels] and even parts of the light."""
_SEEDS, TRACED = 2, 6
_RAYS = 1280, 2048
"""Rays per side, of the fit and of the traced light."""
_LOWEST, _HIGHEST, _BANDS = 1 / 70, 0.4, 14
"""Bands of the radial spectrum, from a few caustic cells to the noise of rays [cycles / pixel]."""
_EDGES = np.geomspace(_LOWEST, _HIGHEST, _BANDS + 1)
FREQUENCIES = np.sqrt(_EDGES[1:] * _EDGES[:-1])
_LIT, _SURE = 0.2, 12.0
"""Part of the brightest smoothed light that counts as lit; width of the smoothing [pixels]."""
_MARGIN_MM = 1.2
_SLOPE = 0.1


class Spread(NamedTuple):
    """Statistics of a square of light over its mean: power of each radial band, standard deviation, and share of the
    light in the brightest twentieth of the pixels.
    """

    spectrum: FloatArray
    contrast: float
    brightest: float


def radial_power(values: FloatArray) -> FloatArray:
    """Return the mean power (bands,) per pixel of ``values`` (rows, columns), windowed and without their mean."""
    window = np.outer(*(np.hanning(side) for side in values.shape))
    window /= np.sqrt(np.square(window).mean())
    power = np.square(np.abs(np.fft.fft2((values - (values * window**2).mean()) * window))) / values.size
    radius = np.hypot(*np.meshgrid(*(np.fft.fftfreq(side) for side in values.shape), indexing="ij"))
    which = np.digitize(radius.ravel(), _EDGES)
    sums, counts = (np.bincount(which, weights, len(_EDGES) + 1) for weights in (power.ravel(), None))
    return np.asarray(sums[1:-1] / np.maximum(counts[1:-1], 1))


def spread_of(light: FloatArray) -> Spread:
    even = light / light.mean()
    ordered = np.sort(even.ravel())
    count = max(1, round(0.05 * even.size))
    return Spread(radial_power(even), float(even.std()), float(ordered[-count:].sum() / ordered.sum()))


def read_spread(path: Path) -> FloatArray:
    """Return the lit square of the point spread function in a picture; MitsimError for a picture in colour or too small
    a lit part.
    """
    if read_image(path, Wanted("point spread function", colour=True)).ndim != 2:
        raise MitsimError(f"point spread function {path}: is in colour; give the sensor's own grey picture")
    return lit_square(load_psf(path, _REDUCE))


def lit_square(light: FloatArray) -> FloatArray:
    smooth = ndimage.gaussian_filter(light, _SURE)
    lit = smooth > _LIT * smooth.max()
    ends = [np.flatnonzero(lit.any(axis=axis))[[0, -1]] for axis in (1, 0)]
    middle = [int(each.mean()) for each in ends]
    half = int(min(np.ptp(each) for each in ends) / 2 - _SURE)
    if half < 1 / _LOWEST:  # else bands have no frequency
        raise MitsimError(
            f"point spread function: its lit part is {2 * half} pixels wide; a twin needs {2 / _LOWEST:.0f}, so give a "
            "larger picture"
        )
    return light[middle[0] - half : middle[0] + half, middle[1] - half : middle[1] + half]


def land(relief: Relief, move_mm: float, count: int, seed: int) -> FloatArray:
    """Return light over its mean (count, count) of rays that a ``relief`` moves by ``move_mm`` rms."""
    rays, side = _RAYS[0], relief.side_mm
    jitter = stream(seed, "twin's rays").random((2, rays, rays))
    places = (np.stack(np.meshgrid(np.arange(rays), np.arange(rays), indexing="ij")) + jitter).reshape(2, -1) / rays
    at = places * (len(relief.height_mm) - 1)
    landed = [
        (place - 0.5) * side + move_mm / _SLOPE * ndimage.map_coordinates(slope, at, order=1)
        for place, slope in zip(places, (relief.slope_x, relief.slope_y), strict=True)
    ]
    row, column = (np.floor(count / 2 + each / SPREAD_MM).astype(np.intp) for each in landed)
    seen = (row >= 0) & (row < count) & (column >= 0) & (column < count)
    light = np.bincount(row[seen] * count + column[seen], minlength=count * count).reshape(count, count)
    return np.asarray(light * (side / rays / SPREAD_MM) ** 2)


def fit(measured: FloatArray, grid: FloatArray) -> tuple[int, int, float, float]:
    """Return indices on the ``grid`` (correlations, moves, bands), blur and haze of the most similar spectrum (bands,),
    by logarithms, because each band scatters by some tenths of itself.
    """
    damped = np.exp(-np.square(2 * np.pi * FREQUENCIES * BLURS[:, None]))  # of power
    best = (np.inf, 0, 0, 0.0, 0.0)
    for first, second in product(range(grid.shape[0]), range(grid.shape[1])):
        logs = np.log(grid[first, second] * damped)  # (blurs, bands)
        off = np.log(measured) - logs[None] - 2 * np.log1p(-HAZES)[:, None, None]
        errors = np.square(off).mean(axis=2)
        haze, blur = np.unravel_index(int(np.argmin(errors)), errors.shape)
        best = min(best, (float(errors[haze, blur]), first, second, float(BLURS[blur]), float(HAZES[haze])))
    return best[1:]


def diffusers_like(square: FloatArray, seed: int, variant: str) -> tuple[list[FloatArray], FloatArray]:
    """Return squares of light of traced diffusers fitted to a measured ``square``, and the spectra of the grid."""
    count = len(square)
    side = count * SPREAD_MM + 2 * _MARGIN_MM
    grids = np.empty((_SEEDS, len(CORRELATIONS_MM), len(MOVES_MM), _BANDS))
    floor = (_RAYS[0] / side * SPREAD_MM) ** -2.0 / 6  # of jittered rays: at most a sixth of even ones' noise
    for (row, correlated), each in product(enumerate(CORRELATIONS_MM), range(_SEEDS)):
        relief = random_relief(side, float(correlated), _SLOPE, seed + each)
        for column, move in enumerate(MOVES_MM):
            spectrum = radial_power(land(relief, float(move), count, each))
            grids[each, row, column] = np.maximum(spectrum - floor, spectrum / 10)
    grid = grids.mean(axis=0)
    row, column, blur, haze = fit(spread_of(square).spectrum, grid)
    load_variant(variant)
    squares, glass = [], Diffuser()
    for each in range(TRACED):
        slope = float(MOVES_MM[column]) / (glass.distance_mm * (glass.index - 1))
        relief = random_relief(side, float(CORRELATIONS_MM[row]), slope, seed + _SEEDS + each)
        traced = point_spread(Diffuser(relief), (count, count), SPREAD_MM, rays=_RAYS[1], seed=each)
        even = ndimage.gaussian_filter(traced / traced.mean(), blur) if blur else traced / traced.mean()
        squares.append((1 - haze) * even + haze)
    return squares, grid


# -------- The study

_DIFFUSER, _SHOWN, _BRIGHT = "diffuser", 160, 3.0
"""Value of the column capture; shown pixels; standard deviations from grey to white."""
_RENDERED = 0.1
"""Relative error of a simulated frame from which a twin is not reliable."""


def _points(scope: Scope) -> list[Point]:
    files = TwinFiles.find(None if scope.data is None else Path(scope.data))
    recipe = Recipe.load()
    for frame, image in files.captures.values():  # refused before there is a folder
        recipe.planes(frame), recipe.scene(image)
    if files.psf is not None:
        read_spread(files.psf)
    both = [*product(files.captures, PLANES), *([(_DIFFUSER, "")] if files.psf else [])]
    return [
        Point.of(scope.setup, data=scope.data, capture=capture, plane=plane, seed=scope.seeds[0])
        for capture, plane in both
    ]


def _measure(studio: Studio, point: Point) -> Found:
    files, seed, name = TwinFiles.find(Path(point["data"])), int(point["seed"]), str(point["capture"])
    if name == _DIFFUSER:
        assert files.psf is not None, "there is a point of it"
        return _measure_diffuser(point, read_spread(files.psf), seed)
    planes = studio.once("captures", 1, (point["data"], seed), lambda: read_captures(files.captures, seed))
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
    row |= {
        "orientation": learned.pose.orientation, "codes_explained": learned.codes.explained,
        **dict(zip(("scale_rows", "scale_columns"), map(float, learned.pose.scales), strict=True)),
        **dict(zip(("told_rows", "told_columns"), map(float, learned.codes.told), strict=True)),
        "flagged": bool(found), "reason": "; ".join(found),
    }  # fmt: skip
    expected = fitted(seen, electrons)
    frames = {"measured": seen.frame, "simulated": expected + seen.noise, "difference": seen.frame - expected}
    corner = [(side - _SHOWN) // 2 for side in seen.frame.shape]
    middle = tuple(slice(max(0, first), max(0, first) + _SHOWN) for first in corner)
    shown = {name: 0.5 + frame[middle] / (2 * _BRIGHT * seen.frame.std()) for name, frame in frames.items()}
    return Found((point.row(kind="frame", **row),), single_precision(shown))


def _measure_diffuser(point: Point, square: FloatArray, seed: int) -> Found:
    simulated, grid = diffusers_like(square, seed, point.setup.variant)
    lights = {"measured": square, **{f"simulated {number}": each for number, each in enumerate(simulated, 1)}}
    spreads = {name: spread_of(light) for name, light in lights.items()}
    rows: list[dict[str, Value]] = []
    for name, each in spreads.items():
        kind = name.split()[0]
        others = [other.spectrum for title, other in spreads.items() if title not in ("measured", name)]
        off = np.log(each.spectrum) - np.log(others).mean(axis=0)
        row, column, blur, haze = fit(each.spectrum, grid)
        numbers = {"correlation_mm": float(CORRELATIONS_MM[row]), "move_mm": float(MOVES_MM[column])}
        rows.append(
            point.row(
                kind=_DIFFUSER, source=kind, draw=name, contrast=each.contrast, brightest=each.brightest,
                **numbers, blur=blur, haze=haze, spectrum_error=float(np.sqrt(np.square(off).mean())),
            )
        )  # fmt: skip
        rows += [
            point.row(kind="spectrum", source=kind, draw=name, frequency=float(middle), power=float(power))
            for middle, power in zip(FREQUENCIES, each.spectrum, strict=True)
        ]
    # The root of light, because a few pixels are many times as bright as their mean.
    shown = {name: np.sqrt(lights[name] / lights[name].mean()) / _BRIGHT for name in ("measured", "simulated 1")}
    return Found(tuple(rows), single_precision(shown))


def _own_scene(rows: DataFrame) -> tuple[str, bool]:
    apart = (rows["correlation"] - rows["correlation_other_scene"]).astype(float)
    low, high = rows["correlation"].min(), rows["correlation"].max()
    return f"correlation {low:.3f} to {high:.3f}, by {apart.min():.3f} to {apart.max():.3f} higher", bool(
        (apart > 0).all()
    )


def _noise_left(rows: DataFrame) -> tuple[str, bool]:
    low, high = rows["chi_square"].min(), rows["chi_square"].max()
    return f"chi-square {low:.2f} to {high:.2f}", bool(high < 2)


def _alike(rows: DataFrame, column: str) -> tuple[str, bool]:
    found = {name: own[column].astype(float) for name, own in rows.groupby("source")}
    measured, simulated = float(found["measured"].iloc[0]), found["simulated"]
    text = f"{measured:.3f} against {simulated.mean():.3f} \N{PLUS-MINUS SIGN} {simulated.std():.3f}"
    return text, bool(abs(simulated.mean() / measured - 1) < 0.2)


STUDY = Study(
    "twin",
    "Real captures beside their simulation",
    "What do simulations of two real cameras explain of these cameras' frames, and by which causes do they differ?",
    points=_points,
    measure=_measure,
    claims=(
        Judged(
            "Every frame is predicted better by its own scene than by another capture's", _own_scene,
            where={"kind": "frame"}, optional=True,
        ),
        Judged(
            "A simulated frame leaves less than twice the energy of the noise", _noise_left, where={"kind": "frame"},
            optional=True,
        ),
        *(
            Judged(
                f"Simulated diffusers have the {words} of the real one within a fifth", partial(_alike, column=column),
                where={"kind": _DIFFUSER}, optional=True,
            )
            for column, words in (("contrast", "contrast of light"), ("brightest", "light in the brightest pixels"))
        ),
    ),
    panels=(
        Images(
            {"measured": ("measured", ""), "simulated": ("simulated, with noise", "correlation {correlation:.3f}"),
             "difference": ("measured less simulated", "")},
            file="frames", title=f"Middle {_SHOWN} x {_SHOWN} pixels, row and column means off",
            where={"kind": "frame", "plane": "gb"}, down=("frame",),
        ),
        Bars(
            "frame", file="causes", where={"kind": "frame"}, title="Energy that the simulation leaves, by cause",
            colour={column_of(name): name for name in CAUSES[2:]}, x_label="part of the frame's energy [1]",
        ),
        Images(
            {"measured": ("measured", ""), "simulated 1": ("simulated", "")}, file=_DIFFUSER,
            title="Root of light over its mean", where={"draw": "measured", "kind": _DIFFUSER}, down=("source",),
        ),
        Lines(
            "frequency", "frequency [cycles / pixel]", file="diffuser_spectrum", y="power", log=True, ticks=False,
            y_label="power of light over its mean [1]", where={"kind": "spectrum"}, colour="source", facet="",
        ),
    ),
    about="Frames are planes of the Bayer sensor: red, green beside blue, green beside red, blue. The mask's codes are "
    "learned from the other captures and their images; one number is fitted, the light. The correlation with another "
    "capture's scene is what bright scenes have in common. Parts of the energy are removed in order; noise that a fit "
    "takes with it counts as noise. Not known are the distances of mask and scene, of which frames determine a product "
    "alone; the scene, which its image by the authors' own calibration replaces; the mask's mean transmission, black "
    "level and stray light. A diffuser's spectrum was fitted, contrast and brightest pixels were not. Its lengths are "
    "in pixels of 23.4 um, which the public file does not state.",
    heads=("", "", "Found"),
    traced=False,
)  # fmt: skip

"""A measured frame, its scene and the mask's codes in; the frame of a simulated camera like the real one out, and
what of the measured one it does not explain, by cause.

The bench: the scene's image on a matt sheet, evenly lit; before the sensor a drawn mask of the transmission
(1 + c_r(row) c_c(column)) / 2, codes scaled to 1, without diffraction, which the learned codes have in them. Light and
frame are those of any mitsim scene. How far the real camera's mask and scene were no frame tells: only the product of
the mask's distance and an angle moves a shadow. The bench takes distances at which the angle hardly dims light.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from string import Template

import numpy as np
from numpy.polynomial.legendre import legvander

from mitsim.api.bench import open_bench
from mitsim.core.arrays import FloatArray
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import stream
from mitsim.devices.sensor import SensorModel
from mitsim.reconstruct.solver import centre_frame
from mitsim.sensor.chain import expose
from mitsim.studies.twin_capture import CROP, Code, Measured, learn_codes, turn_plane

_PITCH_MM = 0.0106
"""Of a Bayer plane's pixels, twice 5.3 um: the sensors of 1024 x 1280 pixels in use then have it. Frames do not depend
on it."""
_MASK_MM, _SHEET_MM = 10.0, 1000.0
"""Sensor to mask and to sheet: the scene then ends at 4 degrees, where light falls by 1 % by its angle."""
_ACCURACY = 1e-3
"""Of frames, whose coded part is a fiftieth: it is then good to 2 to 3 %, where 24 to 60 % are not explained."""
_WIDER = 1.05
"""Projector's window over the sheet."""
_EXPOSURE_S = 0.01
"""Any: frames before noise are compared, and scaled."""
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
"""As the shipped photograph's, which explains each line."""


@single_threaded_blas()
def render(scene: FloatArray, codes: tuple[Code, Code], folder: Path, variant: str) -> FloatArray:
    """(m, m') expected electrons of a simulated camera that sees a ``scene`` (n, n') through a mask of ``codes``.

    Parameters
    ----------
    scene
        as the camera sees it, 0 to 1.
    codes
        of rows and of columns.
    folder
        that gets the bench's files, which any verb takes; it exists.
    variant
        of Mitsuba.
    """
    shape = tuple(len(code.values) - int(code.scale * (code.scene - 1)) - 1 for code in codes)
    feature = _PITCH_MM * (1 - _MASK_MM / _SHEET_MM)
    beside = [
        ((len(code.values) - 1) / 2 - (pixels - 1 + code.scale * (code.scene - 1)) / 2) * feature
        for code, pixels in zip(codes, shape, strict=True)
    ]
    height, width = (code.scale * feature / _MASK_MM * code.scene / 2 * _SHEET_MM for code in codes)
    half = _WIDER * max(height, width)
    np.save(folder / "mask.npy", (1 + np.outer(*(code.values / np.abs(code.values).max() for code in codes))) / 2)
    (folder / "reflectance.png").write_bytes(_picture(scene))
    window = np.zeros((128, 256))
    window[:, 128:] = 1  # as the photograph's: the right half of a shifted lens
    (folder / "projector.png").write_bytes(_picture(window))
    text = _SCENE.substitute(
        pitch=_PITCH_MM, mask=_MASK_MM, sheet=_SHEET_MM, offset_row=beside[0], offset_column=beside[1],
        rows=shape[0], columns=shape[1], width=width, height=height, half=half,
        fov=2 * np.degrees(np.arctan(_WIDER * half / _SHEET_MM)), throw=2 * np.degrees(np.arctan(2 * half / _SHEET_MM)),
    )  # fmt: skip
    (folder / "scene.xml").write_text(text, encoding="utf-8")
    camera = f'name = "twin"\npixel_pitch_um = {_PITCH_MM * 1e3}\nfull_well_e = inf\nread_noise_e = 0.0\n'
    camera += 'quantum_efficiency = 1.0\ngain_dn_per_e = 1.0\nsource = "mitsim study twin"\n'
    camera += f'[mask]\nkind = "drawing"\nfeature_mm = {feature!r}\nfile = "mask.npy"\n'
    (folder / "camera.toml").write_text(camera, encoding="utf-8")
    bench = open_bench(str(folder), variant, str(folder / "camera.toml"))
    plan = bench.plan("uniform", accuracy=_ACCURACY, effects="-diffraction")
    expected = bench.capture(plan, exposure=_EXPOSURE_S).electrons
    if expected is None:
        raise AssertionError  # a simulated capture has them
    return np.asarray(expected[0], dtype=np.float64)


def _picture(values: FloatArray) -> bytes:
    """A PNG of ``values``, 0 to 1, as they are."""
    from io import BytesIO

    from PIL import Image

    held = BytesIO()
    Image.fromarray(np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)).save(held, "PNG")
    return held.getvalue()


def draw_noise(measured: Measured, seed: int) -> FloatArray:
    """(m, m') noise [DN] of the simulated sensor at the ``measured`` light, put through the same turn and cut; its
    ``seed``."""
    sensor = SensorModel(
        name="twin", pixel_pitch_um=_PITCH_MM * 1e3, full_well_e=float("inf"), gain_dn_per_e=measured.gain,
        read_noise_e=float(np.sqrt(measured.read_variance)) / measured.gain, source="mitsim study twin",
    )  # fmt: skip
    light = np.full(tuple(side.start + side.stop for side in CROP), measured.level.mean() / measured.gain)
    shot, read = (stream(seed, "twin", kind, measured.name) for kind in ("shot", "read"))
    noisy = np.asarray(expose(light, _EXPOSURE_S, sensor, shot, read), dtype=np.float64)
    return centre_frame(turn_plane(noisy - noisy.mean()))


# ---- What is compared ----

CAUSES = ("row and column means", "explained", "scale", "smooth field", "mask's code", "scene's image", "noise", "rest")
"""Parts of a measured frame, in the order in which each is taken out of what the ones before leave."""
_DEGREE = 3
"""Of the polynomials of a smooth field: what changes over a third of the frame."""
_LAMBDAS = np.geomspace(1e-6, 1e2, 49)
"""Weights of the scene's correction that are tried, over the largest of its singular values squared."""


@dataclass(frozen=True, eq=False)
class Twin:
    """A measured frame beside its simulation.

    Attributes
    ----------
    measured
        the frame.
    expected, noisy
        (m, m') the simulated frame without noise and with it, means off, in the measured one's scale [DN].
    gain
        found, over that of the learned codes; None where codes are of a calibration in another unit.
    correlation, chi_square
        of the two frames, means off; the latter with the measured frame's noise.
    other
        correlation of the measured frame with another capture's scene through the same codes: what any bright scene has
        in common; None where there is no other.
    parts
        of the measured frame's energy by :data:`CAUSES`; noise that a correction takes with it counts as noise.
    rows, columns
        correlation of the means of rows, and of columns.
    level
        measured mean light over the simulated, of frames whose coded parts agree.
    render_error
        simulated frame against the product of factors, relative.
    electrons
        (m, m') expected of the simulated camera, means and all.
    """

    measured: Measured
    expected: FloatArray
    noisy: FloatArray
    gain: float | None
    correlation: float
    chi_square: float
    other: float | None
    parts: dict[str, float]
    rows: float
    columns: float
    level: float
    render_error: float
    electrons: FloatArray

    def means(self, axis: int) -> dict[str, FloatArray]:
        """Means along an ``axis`` about their mean [DN], measured and simulated."""
        scale = float(np.linalg.norm(self.expected) / np.linalg.norm(centre_frame(self.electrons)))
        found = {"measured": self.measured.level, "simulated": scale * self.electrons}
        return {name: each.mean(axis=axis) - each.mean() for name, each in found.items()}


@single_threaded_blas()
def compare(
    measured: Measured,
    codes: tuple[Code, Code],
    electrons: FloatArray,
    seed: int,
    learned: bool = True,
    other: FloatArray | None = None,
) -> Twin:
    """A measured frame beside a simulated one, whose scale is the only number that is fitted.

    Parameters
    ----------
    measured
        the frame.
    codes, electrons
        of rows and of columns; and what the simulated camera expects behind them.
    seed
        of the simulated noise.
    learned
        whether codes were learned from frames in DN, so that they state the scale.
    other
        scene of another capture.
    """
    frame, simulated = measured.frame, centre_frame(electrons)
    scale = _dot(frame, simulated) / _dot(simulated, simulated)
    expected = scale * simulated
    model = codes[0].factor @ measured.scene @ codes[1].factor.T
    own = _dot(model, simulated) / _dot(simulated, simulated)
    wrong = None if other is None else codes[0].factor @ other @ codes[1].factor.T
    rows, columns = (_correlation(measured.level.mean(axis=axis), electrons.mean(axis=axis)) for axis in (1, 0))
    return Twin(
        measured,
        expected,
        expected + draw_noise(measured, seed),
        scale / own if learned else None,
        _correlation(frame, expected),
        float((np.square(frame - expected) / measured.variance).mean()),
        None if wrong is None else _correlation(frame, wrong),
        _parts(measured, codes, expected, scale / own if learned else 1.0),
        rows,
        columns,
        float(measured.level.mean() / (scale * electrons.mean())),
        float(np.linalg.norm(own * simulated - model) / np.linalg.norm(model)),
        electrons,
    )


def _parts(measured: Measured, codes: tuple[Code, Code], expected: FloatArray, gain: float) -> dict[str, float]:
    """Energy of a measured frame by :data:`CAUSES`."""
    frame, noise, whole = measured.frame, float(measured.variance.sum()), measured.energy
    level = noise / frame.size
    energies, free = [whole, _dot(frame, frame)], [0.0, 0.0]
    energies += [_energy(frame - expected / gain), _energy(frame - expected)]
    free += [0.0, 1.0]
    field, count = _smooth_field(frame - expected, expected)
    energies.append(_energy(frame - expected - field))
    free.append(count)
    mended = Measured(measured.name, measured.level, measured.variance, frame - field, measured.scene, 1.0, 0.0)
    better = learn_codes([mended], (codes[0].scale, codes[1].scale), codes[1])
    model = better[0].factor @ measured.scene @ better[1].factor.T
    energies.append(_energy(mended.frame - model))
    free.append(float(sum(len(code.values) for code in better) - 2))
    more, count = _scene_correction(mended.frame - model, better, level)
    energies.append(_energy(mended.frame - model - more))
    free.append(count)
    steps = [a - b - level * used for a, b, used in zip(energies[:-1], energies[1:], free[1:], strict=True)]
    rest = energies[-1] + level * sum(free) - noise
    return dict(zip(CAUSES, np.array([*steps, noise, rest]) / whole, strict=True))


def _smooth_field(rest: FloatArray, expected: FloatArray) -> tuple[FloatArray, float]:
    """What of a ``rest`` is smooth light, or a smooth gain of the ``expected`` frame; and of how many numbers."""
    sides = [legvander(np.linspace(-1, 1, count), _DEGREE).astype(np.float64) for count in rest.shape]
    degrees = [each for each in product(range(_DEGREE + 1), repeat=2) if 0 < sum(each) <= _DEGREE]
    shapes: list[FloatArray] = [np.outer(sides[0][:, row], sides[1][:, column]) for row, column in degrees]
    fields = [expected * shape for shape in shapes] + [
        shape
        for shape, each in zip(shapes, degrees, strict=True)
        if min(each)  # others are means of rows or columns
    ]
    design = np.stack([centre_frame(each).ravel() for each in fields], axis=1)
    found = np.linalg.solve(design.T @ design, design.T @ rest.ravel())
    return (design @ found).reshape(rest.shape), float(len(fields))


def _scene_correction(rest: FloatArray, codes: tuple[Code, Code], level: float) -> tuple[FloatArray, float]:
    """The frame of what is to be added to the scene, by Tikhonov with the weight of least risk; and the numbers that it
    takes of noise of variance ``level``."""
    (left, first, _), (right, second, _) = (np.linalg.svd(code.factor, full_matrices=False) for code in codes)
    seen, strength = left.T @ rest @ right, np.square(np.outer(first, second))
    largest = strength.max()

    def part(lam: float) -> FloatArray:
        return np.asarray(strength / (strength + lam * largest))

    def risk(lam: float) -> float:
        return float(np.square((1 - part(lam)) * seen).sum() + 2 * level * part(lam).sum())

    kept = part(min(_LAMBDAS, key=risk))
    return left @ (kept * seen) @ right.T, float((2 * kept - kept**2).sum())


def _dot(first: FloatArray, second: FloatArray) -> float:
    return float(np.vdot(first, second))


def _energy(values: FloatArray) -> float:
    return _dot(values, values)


def _correlation(first: FloatArray, second: FloatArray) -> float:
    return float(np.corrcoef(first.ravel(), second.ravel())[0, 1])

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
from mitsim.core.images import grey_png
from mitsim.core.parallel import single_threaded_blas
from mitsim.reconstruct.shifted_codes import Codes, Shape, fit_codes
from mitsim.reconstruct.solver import centre_frame
from mitsim.studies.twin_capture import EXPOSURE_S, PITCH_MM, Measured

_MASK_MM, _SHEET_MM = 10.0, 1000.0
"""Sensor to mask and to sheet: the scene then ends at 4 degrees, where light falls by 1 % by its angle."""
_ACCURACY = 1e-3
"""Of frames, whose coded part is a thirtieth: it is then good to 2 to 5 %, where 22 to 58 % are not explained."""
_WIDER = 1.05
"""Projector's window over the sheet."""
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
def render(measured: Measured, codes: Codes, folder: Path, variant: str) -> FloatArray:
    """(m, m') expected electrons of a simulated camera that sees a frame's scene through a mask of ``codes``.

    Parameters
    ----------
    measured
        the frame, its scene as it lies before the mask.
    codes
        of its mask, one a side.
    folder
        that gets the bench's files, which any verb takes; it exists.
    variant
        of Mitsuba.
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
    if expected is None:
        raise AssertionError  # a simulated capture has them
    return np.asarray(expected[0], dtype=np.float64)


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
    expected
        (m, m') the simulated frame without noise, means off, in the measured one's scale [DN].
    electrons
        (m, m') expected of the simulated camera, means and all.
    gain
        light found, over that of the learned codes.
    other
        correlation of the measured frame with another capture's scene through the same codes: what any bright scene has
        in common.
    parts
        of the measured frame's energy about its mean by :data:`CAUSES`; noise that a correction takes with it counts as
        noise.
    render_error
        simulated frame against the product of factors, relative.
    """

    measured: Measured
    expected: FloatArray
    electrons: FloatArray
    gain: float
    other: float
    parts: dict[str, float]
    render_error: float

    @property
    def noisy(self) -> FloatArray:
        """(m, m') the simulated frame with its noise [DN]."""
        return self.expected + self.measured.noise

    @property
    def correlation(self) -> float:
        """Of the two frames, means off."""
        return correlation(self.measured.frame, self.expected)

    @property
    def chi_square(self) -> float:
        """Energy that the simulated frame leaves, over the noise's."""
        return _energy(self.measured.frame - self.expected) / _energy(self.measured.noise)

    @property
    def explained(self) -> float:
        """Part of the frame's energy, means off."""
        return 1 - _energy(self.measured.frame - self.expected) / _energy(self.measured.frame)

    @property
    def noise_part(self) -> float:
        """Part of the frame's energy, means off, that is noise."""
        return _energy(self.measured.noise) / _energy(self.measured.frame)

    @property
    def level(self) -> float:
        """Measured mean light over the simulated, where coded parts agree."""
        return float(self.measured.level.mean() / (self._scale * self.electrons.mean()))

    @property
    def _scale(self) -> float:
        return float(np.linalg.norm(self.expected) / np.linalg.norm(centre_frame(self.electrons)))

    def means(self, axis: int) -> dict[str, FloatArray]:
        """Means along an ``axis`` about their mean [DN], measured and simulated."""
        found = {"measured": self.measured.level, "simulated": self._scale * self.electrons}
        return {name: each.mean(axis=axis) - each.mean() for name, each in found.items()}


@single_threaded_blas()
def compare(measured: Measured, codes: Codes, electrons: FloatArray, other: FloatArray) -> Twin:
    """A measured frame beside a simulated one, whose scale is the only number that is fitted.

    Parameters
    ----------
    measured
        the frame, its scene as it lies before the mask.
    codes, electrons
        of its mask; and what the simulated camera expects behind it.
    other
        scene of another capture.
    """
    frame, simulated = measured.frame, centre_frame(electrons)
    left, right = codes.factors(measured.offset, measured.plane)
    model = left @ measured.scene @ right.T
    scale, own = (_dot(each, simulated) / _energy(simulated) for each in (frame, model))
    expected, gain = scale * simulated, scale / own
    parts = _parts(measured, codes, expected, gain)
    error = float(np.linalg.norm(own * simulated - model) / np.linalg.norm(model))
    return Twin(measured, expected, electrons, gain, correlation(frame, left @ other @ right.T), parts, error)


def _parts(measured: Measured, codes: Codes, expected: FloatArray, gain: float) -> dict[str, float]:
    """Energy of a measured frame by :data:`CAUSES`."""
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
    parts = [*(-np.diff(energies) - level * free), noise, energies[-1] + level * free.sum() - noise]
    return dict(zip(CAUSES, (float(part / whole) for part in parts), strict=True))


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


def _scene_correction(
    rest: FloatArray, factors: tuple[FloatArray, FloatArray], level: float
) -> tuple[FloatArray, float]:
    """The frame of what is to be added to the scene, by Tikhonov with the weight of least risk; and the numbers that it
    takes of noise of variance ``level``."""
    (left, first, _), (right, second, _) = (np.linalg.svd(each, full_matrices=False) for each in factors)
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


def correlation(first: FloatArray, second: FloatArray) -> float:
    """Of all numbers of the ``first`` array and the ``second``."""
    return float(np.corrcoef(first.ravel(), second.ravel())[0, 1])

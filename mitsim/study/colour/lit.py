"""A scene with measured spectra in; the same scene in the light of each line of its projector, lit and calibrated, out.

Each line has a bench of its own, with the line's power, diffraction, photons and factors; light of all is traced on the
same paths (:mod:`mitsim.capture.colour`). Daylight beside the projector is that of a lamp, in frames of its own.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.capture.bench import Bench
from mitsim.capture.colour import ColourBench
from mitsim.capture.light import trace_lines
from mitsim.capture.opening import open_bench
from mitsim.capture.request import Request
from mitsim.capture.run import plan_request
from mitsim.core.arrays import FloatArray
from mitsim.core.colours import RUN
from mitsim.core.configuration import locate
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import integer
from mitsim.reconstruct.colour import daylight
from mitsim.reconstruct.factors import Factors
from mitsim.study.experiment import Setup
from mitsim.study.exposures import LitScene

_SPECTRUM = re.compile(r'value="(\s*[\d.]+\s*:[^"]*)"')
"""Wavelengths and values, nm:value, as Mitsuba reads them."""
_LAMP = """
    <shape type="rectangle" id="daylight">
        <transform name="to_world">
            <scale x="200" y="80" z="1"/> <rotate x="1" angle="90"/> <translate x="0" y="600" z="300"/>
        </transform>
        <emitter type="area"> <spectrum name="radiance" value="{radiance:g}"/> </emitter>
        <bsdf type="diffuse"> <spectrum name="reflectance" value="0"/> </bsdf>
    </shape>
</scene>"""
"""The lamp of scenes/lamp_bench."""
DAYLIGHT_RADIANCE = 117.0
"""Of the lamp [W m^-2 sr^-1]: it lights the sheet as the projector's white does, 2.97 W/m^2 at its middle."""
Weigh = Callable[[FloatArray, FloatArray], float]
"""From wavelengths [nm] and values of a spectrum to one number."""


@dataclass(frozen=True, eq=False)
class LitLine:
    """A scene in one line's light, and the camera's factors there.

    Attributes
    ----------
    name, wavelength_nm
        of the line [nm].
    lit
        the scene in its light.
    factors
        calibrated in it.
    """

    name: str
    wavelength_nm: float
    lit: LitScene
    factors: Factors

    def seed(self, seed: int) -> int:
        """One of this line's own, from the ``seed`` of all."""
        return integer(seed, "line", self.name)


def lit_lines(setup: Setup, seed: int) -> tuple[LitLine, ...]:
    """The scene of a setup in the light of each line.

    Parameters
    ----------
    setup
        the scene, and its projector, whose lines they are.
    seed
        of the light, and of the calibrations' noise.

    Raises
    ------
    MitsimError
        as :meth:`mitsim.capture.bench.Bench.capture_lines`.
    """
    colours = ColourBench.of(_opened(setup, locate(setup.scene, "scenes", "scene.xml")), RUN)
    request = Request.of(accuracy=setup.accuracy, seed=seed)
    plan = plan_request(colours.whole, request)
    lighting = colours.whole.family(request.patterns, seed).lighting
    lights = trace_lines(colours.whole, colours.benches, plan, lighting, seed)
    factors = colours.whole.calibrate_lines(seed, setup.accuracy)
    return tuple(
        LitLine(line.name, line.wavelength_nm, LitScene(light), factors[line.name])
        for line, light in zip(colours.manifest.channels, lights, strict=True)
    )


def daylit(setup: Setup, folder: Path) -> tuple[FloatArray, float]:
    """What the camera sees of a scene in a lamp's daylight (D65) with the projector off.

    Its spectra count as D65's photons do, 380 to 780 nm, in a camera of equal efficiency for all of them.

    Parameters
    ----------
    setup
        a scene with spectra.
    folder
        for scene files.

    Returns
    -------
    irradiance, wavelength_nm
        (m, m') [W m^-2], and the wavelength whose photons carry as much energy.
    """

    def weigh(at: FloatArray, values: FloatArray) -> float:
        photons = daylight(at) * at
        return float((values * photons).sum() / photons.sum())

    scene = respectred(setup.scene, folder / "daylight", weigh)
    text = scene.read_text(encoding="utf-8")
    end = text.rindex("</scene>")
    scene.write_text(text[:end] + _LAMP.format(radiance=DAYLIGHT_RADIANCE), encoding="utf-8")
    wavelengths = np.arange(380.0, 781.0, 5.0)
    mean = float((daylight(wavelengths) * wavelengths).sum() / daylight(wavelengths).sum())
    bench = _opened(setup, scene)
    bench = replace(bench, rig=replace(bench.rig, projector=bench.projector.at(mean)))
    light = bench.light("uniform", accuracy=setup.accuracy)
    return light.merged().frames(bench.family("uniform").lighting, light.seed).projector_off.irradiance, mean


def respectred(scene: str, folder: Path, weigh: Weigh) -> Path:
    """A copy of a scene whose spectra are single numbers; its XML.

    Parameters
    ----------
    scene
        shipped name, or path.
    folder
        new, for the copy.
    weigh
        from a spectrum to its number.

    Raises
    ------
    MitsimError
        for a scene without spectra.
    """
    own = locate(scene, "scenes", "scene.xml")
    shutil.copytree(own.parent, folder)
    found = 0

    def number(match: re.Match[str]) -> str:
        pairs = np.array([[float(part) for part in pair.split(":")] for pair in re.split(r"[,\s]+", match[1].strip())])
        return f'value="{weigh(pairs[:, 0], pairs[:, 1]):.9g}"'

    for file in folder.glob("*.xml"):
        text, count = _SPECTRUM.subn(number, file.read_text(encoding="utf-8"))
        file.write_text(text, encoding="utf-8")
        found += count
    if not found:
        raise MitsimError(
            f"scene {scene}: has no spectra (nm:value), so it looks alike in all lines; give one such as colour_checker"
        )
    return folder / own.name


def serving(line: LitLine, other: LitLine) -> Factors:
    """The factors of an ``other`` line, said to be of a ``line``, with the gain that is nearest to its own factors."""
    own, model = line.factors, other.factors
    gain = 1.0
    for mine, theirs in ((own.left, model.left), (own.right, model.right)):
        gain *= float(np.vdot(mine, theirs) / np.vdot(theirs, theirs))
    root = np.sqrt(gain)
    manifest = model.manifest.model_copy(update={"camera": own.manifest.camera})
    return replace(model, left=root * model.left, right=root * model.right, manifest=manifest, lacking=())


def _opened(setup: Setup, scene: Path) -> Bench:
    parameters: dict[str, Any] = dict(setup.parameters)
    variant = f"{setup.variant.rpartition('_')[0]}_spectral"
    return open_bench(scene, variant, setup.camera, setup.projector, setup.outside, **parameters)

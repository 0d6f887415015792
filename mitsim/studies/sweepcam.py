"""A lit scene and places of its camera's mask in; the image that uniform frames through the mask at all places come to,
out.

SweepCam (Hua, Nakamura, Asif & Sankaranarayanan, TPAMI 2020) moves the mask instead of the light. Moved by a along the
rows and by b along the columns, a separable mask casts Y_ab = Phi_L(a) X Phi_R(b)^T. Of places on a grid, all frames
side by side are one frame of a separable camera whose factors are those of the places on top of each other,

    [Y_ab]_ab = [Phi_L(a)]_a X [Phi_R(b)]_b^T,

so :mod:`mitsim.reconstruct.solver` solves them exactly, as it does one frame. Light is traced up to the mask, so
one scene's light serves all places."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from mitsim.acquire.exposure import Exposer, peak_irradiance, taken_off
from mitsim.bench.bench import Apparatus
from mitsim.bench.request import Exposure
from mitsim.calibrate.calibrate import estimate
from mitsim.calibrate.lit_session import LitSession
from mitsim.calibrate.session import Session
from mitsim.core.arrays import FloatArray
from mitsim.core.job import Job
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer, stream
from mitsim.devices.session import load_recipe
from mitsim.light.light import SampledLight
from mitsim.optics.frames import ExpectedFrames, Frame
from mitsim.reconstruct.solver import centred, centred_columns, prepare
from mitsim.reconstruct.status import Solution
from mitsim.report.exposures import EQUAL_PEAK, EQUAL_TOTAL, RENDERED, IdealCamera, LitScene, Pair

Places = Mapping[float, Pair]
"""Left and right factor, (pixels, n) each, of the camera with its mask moved so far [mm], along both axes."""


def moved(bench: Apparatus, row_mm: float, column_mm: float) -> Apparatus:
    """A bench with its mask elsewhere, for all that is made of traced light.

    Parameters
    ----------
    bench
        what is changed.
    row_mm, column_mm
        the mask's centre off the axis.
    """
    offset = {"mask_offset_row": row_mm, "mask_offset_column": column_mm}
    return replace(bench, rig=replace(bench.rig, camera=bench.geometry.model_copy(update=offset)))


def ideal_places(bench: Apparatus, places_mm: Iterable[float], board_flux: float) -> Places:
    """Factors of the paper's model.

    Parameters
    ----------
    bench, places_mm
        whose mask is moved, and how far along both axes.
    board_flux
        that each pixel of a white board puts on the sensor [W m^-2].
    """

    def camera(row: float, column: float) -> IdealCamera:
        return IdealCamera(moved(bench, row, column), bench.geometry.mask)

    def white(row: float, column: float) -> Frame:
        (frame,) = camera(row, column).frames(bench.family("uniform"), np.full((bench.n, bench.n), board_flux))
        return frame

    return _consistent({place: camera(place, place).calibrated(board_flux) for place in places_mm}, bench, white)


def calibrated_places(bench: Apparatus, places_mm: Sequence[float], seed: int, accuracy: float = 1e-3) -> Places:
    """Factors as sessions with the mask at each place estimate them, all of one board's light.

    One place a side needs one session, not each frame: a mask that has moved along both axes tells the left factor of
    its row and the right one of its column.

    The sessions are rendered without the sensor's noise, and what it does to factors is added in closed form
    (:func:`mitsim.reconstruct.estimate_factors.predicted_error`): seven times 512 noisy frames take four times as long.

    Parameters
    ----------
    bench, places_mm
        whose mask is moved, and how far along both axes.
    seed, accuracy
        as for :meth:`mitsim.bench.bench.Bench.calibrate`; every place has noise of its own.
    """
    recipe, job = load_recipe(), Job()
    session = Session(bench, recipe, seed)
    light = session.trace(session.plan(accuracy, job), job)

    def at(row: float, column: float) -> Session:
        return Session(moved(bench, row, column), recipe, seed)

    def white(row: float, column: float) -> Frame:
        return LitSession.of(at(row, column), light.behind(at(row, column).board), Job()).white

    return _consistent({place: _calibrated(at(place, place), light, place) for place in places_mm}, bench, white)


def _consistent(factors: Places, bench: Apparatus, white: Callable[[float, float], Frame]) -> Places:
    """Factors whose products hold between places as well.

    A session leaves open how its product is shared between left and right, even their sign. One frame of the board
    through the mask at each place's row and the first one's column tells.

    Parameters
    ----------
    factors, bench
        as the sessions of each place left them, and the rig.
    white
        the board in uniform light through the mask at a row and a column [mm].
    """
    first, found = next(iter(factors)), {}
    for place, (left, right) in factors.items():
        told = np.outer(left.sum(axis=1), factors[first][1].sum(axis=1))
        seen = Exposer(bench.rig, 1.0, 0).electrons(white(place, first))
        if bench.geometry.centred:
            told, seen = centred(told), centred(seen)
        share = float(np.vdot(told, seen) / np.vdot(seen, seen))
        found[place] = left / share, right * share
    return found


def _calibrated(session: Session, light: SampledLight, place: float) -> Pair:
    """Both factors of a ``session`` before the board's ``light``, its noise found by the ``place``."""
    lit = LitSession.of(session, light.behind(session.board), Job())
    clean, _ = estimate(lit, Job(), noise_free=True)
    count = np.sqrt(session.signs.shape[1])
    sides = {"left": (clean.left, clean.right), "right": (clean.right, clean.left)}
    noisy = {}
    for name, (side, other) in sides.items():
        deviation = lit.response_noise / (count * np.linalg.norm(other.sum(axis=1)))
        noise = stream(session.seed, "mask", name, f"{place:g}").standard_normal(side.shape)
        noisy[name] = side + deviation * noise
    return noisy["left"], noisy["right"]


@dataclass(frozen=True, eq=False)
class MovedMask:
    """Uniform frames of a scene through a mask at several places.

    Attributes
    ----------
    lit, model
        the scene, and one of :data:`mitsim.report.exposures.MODELS`.
    factors
        of the places.
    seed
        of the noise.
    """

    lit: LitScene
    model: str
    factors: Places
    seed: int
    _formed: dict[tuple[float, float], ExpectedFrames] = field(default_factory=dict)

    def expected(self, row_mm: float, column_mm: float) -> ExpectedFrames:
        """The frame through the mask at one place, without noise.

        Parameters
        ----------
        row_mm, column_mm
            the mask's centre off the axis.
        """
        place = row_mm, column_mm
        if place not in self._formed:
            bench = moved(self.lit.bench, *place)
            self._formed[place] = self.lit.expected(self.model, bench.family("uniform"), bench=bench)
        return self._formed[place]

    def seconds(self, rows_mm: Sequence[float], columns_mm: Sequence[float], exposure: str) -> float:
        """Exposure time [s] of each frame.

        Parameters
        ----------
        rows_mm, columns_mm
            places of the frames.
        exposure
            one of :data:`mitsim.report.exposures.CONVENTIONS`.
        """
        places = list(product(rows_mm, columns_mm))
        if exposure == EQUAL_PEAK:
            brightest = max(peak_irradiance(self.expected(*place)) for place in places)
            return Exposure().choose(self.lit.bench.rig, brightest)
        return self.lit.uniform_s(self.model) / (len(places) if exposure == EQUAL_TOTAL else 1)

    def solve(self, rows_mm: Sequence[float], columns_mm: Sequence[float], seconds: float) -> Solution:
        """The image of one exposure at each place of a grid, at automatic lambda.

        Parameters
        ----------
        rows_mm, columns_mm
            the grid.
        seconds
            exposure time of each frame.
        """
        left = np.concatenate([self._side(0, place) for place in rows_mm])
        right = np.concatenate([self._side(1, place) for place in columns_mm])
        uniform = np.ones((self.lit.bench.n, 1))
        model = prepare(left, right, uniform, uniform)
        sums = model.accumulator()
        with single_threaded_blas():
            frames = [[self._measured(row, column, seconds) for column in columns_mm] for row in rows_mm]
            sums.add(np.block(frames), 0, 0)
            return model.solve(sums)

    @property
    def _centre(self) -> bool:
        """Whether every frame and factor loses its means, which stacked ones must lose one by one."""
        return self.lit.bench.geometry.centred

    def _side(self, axis: int, place: float) -> FloatArray:
        factor = self.factors[place][axis]
        return centred_columns(factor) if self._centre else factor

    def _measured(self, row_mm: float, column_mm: float, seconds: float) -> FloatArray:
        """Noisy electrons a second at one place, of ambient light what a user takes off."""
        bench, expected = self.lit.bench, self.expected(row_mm, column_mm)
        speckle = self.lit.light.simulation.physics.speckle if self.model == RENDERED else 0.0
        exposer = Exposer(bench.rig, seconds, integer(self.seed, "mask", f"{row_mm:g}", f"{column_mm:g}"), speckle)
        family = bench.family("uniform")
        ((frame, _, _),) = exposer.measurements(family, expected)
        frame = frame - taken_off(exposer, family, expected)
        return centred(frame) if self._centre else frame

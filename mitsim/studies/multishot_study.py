"""The mask moved instead of the light: SweepCam's uniform frames at 49 places of the mask, 49 uniform frames, 49 dots.

Paper, section IV-D: the mask moves by -15 to +15 of its features, and there are as many frames as patterns. It does not
say along which axes; a grid of k x k places has as many frames as dots of period k, and is taken here. A line of 49
places along the rows, as a mask on one slide would go, is in the table as well: idealised only, because it would take
49 calibrations.

Frames through a mask that rests share the error of one calibration, those through a moved one have seven.

SweepCam (Hua, Nakamura, Asif & Sankaranarayanan, TPAMI 2020) moves the mask instead of the light. Moved by a along the
rows and by b along the columns, a separable mask casts Y_ab = Phi_L(a) X Phi_R(b)^T. Of places on a grid, all frames
side by side are one frame of a separable camera whose factors are those of the places on top of each other,

    [Y_ab]_ab = [Phi_L(a)]_a X [Phi_R(b)]_b^T,

so :mod:`mitsim.reconstruct.solver` solves them exactly, as it does one frame. Light is traced up to the mask, so one
scene's light serves all places.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from mitsim.acquire.exposure import Exposer, peak_irradiance, taken_off
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.request import Exposure
from mitsim.calibrate.board_session import Session
from mitsim.calibrate.calibrate import estimate
from mitsim.calibrate.lit_session import LitSession
from mitsim.core.arrays import FloatArray
from mitsim.core.job import Job
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer, stream
from mitsim.devices.patterns import PatternFamily
from mitsim.devices.session import load_recipe
from mitsim.light.light import SampledLight
from mitsim.optics.frames import ExpectedFrames, Frame
from mitsim.reconstruct.solution import Solution
from mitsim.reconstruct.solver import centre_columns, centre_frame, prepare
from mitsim.report import EQUAL_FRAME, EQUAL_PEAK, EQUAL_TOTAL, IDEALISED, MODELS, RENDERED
from mitsim.report.lit_scene import IdealCamera, LitScene, Pair, Unexposed
from mitsim.studies.framework.claims import CONFIRMED, Gain, stated
from mitsim.studies.framework.experiment import QUICK_IMAGES, Axes, Claim, Found, Point, Results, Study
from mitsim.studies.framework.panels import Images, Lines
from mitsim.studies.framework.studio import Image, Studio, flags_of, image_arrays

REACH = 15.0
"""Features that the mask moves either way."""
GRIDS = {2: (0, 6), 3: (0, 3, 6), 4: (0, 2, 4, 6), 7: tuple(range(7))}
"""Which of seven places between both ends are taken along an axis, by their number: all are calibrated once."""
UNIFORM, SWEPT, LINE, DOTS = "uniform frames", "SweepCam", "SweepCam, along rows alone", "shifting dots"
_FRAMES = 49
"""As the paper's."""
_SWEPT_DB = (24.9, 26.8)
"""In the paper's figure 6."""
_TELLS_DB = 0.5
"""A gain that counts: a tenth of the squared error."""
EXPOSURES = (EQUAL_PEAK, EQUAL_FRAME)


def _measure(studio: Studio, point: Point) -> Found:
    method, side, lit = point["patterns"], round(point["frames"] ** 0.5), studio.lit_scene(point.setup)
    images = _moving(studio, point, lit) if method in (SWEPT, LINE) else _still(studio, point, lit)
    rows = tuple(point.row(exposure=exposure, **image.row()) for exposure, image in images.items())
    kept = point.setup.picture in (*QUICK_IMAGES, None) and side in (1, 7) and method != LINE
    return Found(rows, image_arrays(images[EQUAL_FRAME].image, lit.truth) if kept else {})


def _still(studio: Studio, point: Point, lit: LitScene) -> dict[str, Image]:
    model, seed, n = point["model"], int(point["seed"]), lit.bench.n
    if point["patterns"] == DOTS:
        family = lit.bench.family(f"dots:{round(point['frames'] ** 0.5)}")
    else:
        family = PatternFamily(UNIFORM, np.ones((n, point["frames"]), np.int8), np.ones((n, 1), np.int8))
    centre, sides = lit.bench.geometry.centred, _factors(studio, point, lit)[0.0]
    frames = Unexposed(lit, model, family, sides, centre, seed if model == RENDERED else seed + 1)
    return {exposure: Image.of(frames, frames.seconds(exposure)) for exposure in EXPOSURES}


def _moving(studio: Studio, point: Point, lit: LitScene) -> dict[str, Image]:
    model, feature = point["model"], lit.bench.geometry.mask_feature
    columns: tuple[float, ...]
    if point["patterns"] == LINE:
        rows, columns = _spread(_FRAMES, feature), (0.0,)
        factors = ideal_places(lit.bench, {*rows, *columns}, lit.board_flux)
    else:
        seven, factors = _spread(7, feature), _factors(studio, point, lit)
        rows = columns = tuple(seven[index] for index in GRIDS[round(point["frames"] ** 0.5)])
    mask = MovedMask(lit, model, factors, int(point["seed"]) + (model == IDEALISED))
    images = {}
    for exposure in EXPOSURES:
        seconds = mask.seconds(rows, columns, exposure)
        found = mask.solve(rows, columns, seconds)
        quality, flags = lit.quality(found.image), flags_of(found.status)
        images[exposure] = Image(found.image, quality, found.lam, point["frames"], seconds, flags)
    return images


def _factors(studio: Studio, point: Point, lit: LitScene) -> Places:
    """Of a camera with its mask at seven places, the middle one on the axis."""
    places = _spread(7, lit.bench.geometry.mask_feature)
    if point["model"] == RENDERED:
        bench, seed = lit.bench, int(point["seed"])
        key = bench.devices_digest, places, seed  # what a session sees, whatever is printed
        return studio.once("places", 1, key, lambda: calibrated_places(bench, places, seed))
    return ideal_places(lit.bench, places, lit.board_flux)


def _spread(count: int, feature_mm: float) -> tuple[float, ...]:
    return tuple(float(place) for place in np.linspace(-REACH, REACH, count) * feature_mm)


def _on_a_line(results: Results) -> list[Claim]:
    """Judge the frames along one axis, which exist in the idealised model alone."""
    band = stated("The same on a line along the rows", *_SWEPT_DB, patterns=LINE)
    (claim,) = band.judge(results)
    return [replace(claim, verdict="confirmed only idealised") if claim.verdict == CONFIRMED else claim]


_MANY = {"frames": _FRAMES}

STUDY = Study(
    "multishot",
    "The mask moved, or the light",
    "Do dots beat as many uniform frames through a mask that moves?",
    points=Axes(
        {"patterns": (UNIFORM, SWEPT, DOTS, LINE), "frames": (1, *(side**2 for side in GRIDS)), "model": MODELS},
        quick={"frames": (1, _FRAMES)},
        quick_prints=1,
        kept=lambda values: (
            (values["model"] == IDEALISED and values["frames"] == _FRAMES)
            if values["patterns"] == LINE
            else values["frames"] != 1 or values["patterns"] == UNIFORM
        ),
    ),
    measure=_measure,
    claims=(
        stated("One uniform frame gives 21.3 to 22.9 dB", 21.3, 22.9, patterns=UNIFORM, frames=1),
        stated("SweepCam with 49 frames gives 24.9 to 26.8 dB, here on a grid", *_SWEPT_DB, patterns=SWEPT, frames=49),
        _on_a_line,
        stated("49 shifting dots give 34 to 35.5 dB", 34.0, 35.5, patterns=DOTS, frames=_FRAMES),
        Gain("49 dots beat SweepCam's 49 frames", DOTS, SWEPT, where=_MANY, paper="higher", at_least=_TELLS_DB),
        Gain(
            "SweepCam's 49 frames beat 49 frames through a mask that rests",
            SWEPT,
            UNIFORM,
            where=_MANY,
            at_least=_TELLS_DB,
        ),
    ),
    panels=(
        Lines(
            "frames",
            "number of frames [1]",
            title="PSNR by the number of frames",
            where={"patterns": (UNIFORM, SWEPT, DOTS)},
            each="exposure",
            shared={"patterns": UNIFORM, "frames": 1},
            log=True,
        ),
        Images(
            "patterns",
            title=f"Images of 49 frames, exposure {EQUAL_FRAME}",
            where={"exposure": EQUAL_FRAME, **_MANY},
            columns=(UNIFORM, SWEPT, DOTS),
        ),
    ),
)


# -------- A lit scene and places of its camera's mask in

Places = Mapping[float, Pair]
"""Left and right factor, (pixels, n) each, of the camera with its mask moved so far [mm], along both axes."""


def move_mask(bench: Apparatus, row_mm: float, column_mm: float) -> Apparatus:
    """A bench with its mask elsewhere, for all that is made of traced light.

    Parameters
    ----------
    bench
        what is changed.
    row_mm, column_mm
        the mask's centre off the axis.
    """
    offset = {"mask_offset_row": row_mm, "mask_offset_column": column_mm}
    return replace(bench, devices=replace(bench.devices, camera=bench.geometry.model_copy(update=offset)))


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
        return IdealCamera(move_mask(bench, row, column), bench.geometry.mask)

    def white(row: float, column: float) -> Frame:
        (frame,) = camera(row, column).frames(bench.family("uniform"), np.full((bench.n, bench.n), board_flux))
        return frame

    return _consistent({place: camera(place, place).calibrated(board_flux) for place in places_mm}, bench, white)


def calibrated_places(bench: Apparatus, places_mm: Sequence[float], seed: int, accuracy: float = 1e-3) -> Places:
    """Factors as sessions with the mask at each place estimate them, all of one board's light.

    One place a side needs one session, not each frame: a mask that has moved along both axes tells the left factor of
    its row and the right one of its column.

    The sessions are rendered without the sensor's noise, and what it does to factors is added in closed form
    (:func:`mitsim.reconstruct.factors.predicted_error`): seven times 512 noisy frames take four times as long.

    Parameters
    ----------
    bench, places_mm
        whose mask is moved, and how far along both axes.
    seed, accuracy
        as for :meth:`mitsim.bench.apparatus.Bench.calibrate`; every place has noise of its own.
    """
    recipe, job = load_recipe(), Job()
    session = Session(bench, recipe, seed)
    light = session.trace(session.plan(accuracy, job), job)

    def at(row: float, column: float) -> Session:
        return Session(move_mask(bench, row, column), recipe, seed)

    def white(row: float, column: float) -> Frame:
        return LitSession.of(at(row, column), light.behind(at(row, column).board), Job()).white

    return _consistent({place: _calibrate_place(at(place, place), light, place) for place in places_mm}, bench, white)


def _consistent(factors: Places, bench: Apparatus, white: Callable[[float, float], Frame]) -> Places:
    """Factors whose products hold between places as well.

    A session leaves open how its product is shared between left and right, even their sign. One frame of the board
    through the mask at each place's row and the first one's column tells.

    Parameters
    ----------
    factors, bench
        as the sessions of each place left them, and the devices.
    white
        the board in uniform light through the mask at a row and a column [mm].
    """
    first, found = next(iter(factors)), {}
    for place, (left, right) in factors.items():
        modelled = np.outer(left.sum(axis=1), factors[first][1].sum(axis=1))
        measured = Exposer(bench.devices, 1.0, 0).electrons(white(place, first))
        if bench.geometry.centred:
            modelled, measured = centre_frame(modelled), centre_frame(measured)
        share = float(np.vdot(modelled, measured) / np.vdot(measured, measured))
        found[place] = left / share, right * share
    return found


def _calibrate_place(session: Session, light: SampledLight, place: float) -> Pair:
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
        the scene, and one of :data:`mitsim.report.MODELS`.
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

    def expected_frames(self, row_mm: float, column_mm: float) -> ExpectedFrames:
        """The frame through the mask at one place, without noise.

        Parameters
        ----------
        row_mm, column_mm
            the mask's centre off the axis.
        """
        place = row_mm, column_mm
        if place not in self._formed:
            bench = move_mask(self.lit.bench, *place)
            self._formed[place] = self.lit.expected_frames(self.model, bench.family("uniform"), bench=bench)
        return self._formed[place]

    def seconds(self, rows_mm: Sequence[float], columns_mm: Sequence[float], exposure: str) -> float:
        """Exposure time [s] of each frame.

        Parameters
        ----------
        rows_mm, columns_mm
            places of the frames.
        exposure
            one of :data:`mitsim.report.CONVENTIONS`.
        """
        places = list(product(rows_mm, columns_mm))
        if exposure == EQUAL_PEAK:
            brightest = max(peak_irradiance(self.expected_frames(*place)) for place in places)
            return Exposure().choose(self.lit.bench.devices, brightest)
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
            frames = [[self._measure_at(row, column, seconds) for column in columns_mm] for row in rows_mm]
            sums.add(np.block(frames), 0, 0)
            return model.solve(sums)

    @property
    def _centre(self) -> bool:
        """Whether every frame and factor loses its means, which stacked ones must lose one by one."""
        return self.lit.bench.geometry.centred

    def _side(self, axis: int, place: float) -> FloatArray:
        factor = self.factors[place][axis]
        return centre_columns(factor) if self._centre else factor

    def _measure_at(self, row_mm: float, column_mm: float, seconds: float) -> FloatArray:
        """Noisy electrons a second at one place, of ambient light what a user takes off."""
        bench, expected = self.lit.bench, self.expected_frames(row_mm, column_mm)
        speckle = self.lit.light.simulation.physics.speckle if self.model == RENDERED else 0.0
        exposer = Exposer(bench.devices, seconds, integer(self.seed, "mask", f"{row_mm:g}", f"{column_mm:g}"), speckle)
        family = bench.family("uniform")
        ((frame, _, _),) = exposer.measurements(family, expected)
        frame = frame - taken_off(exposer, family, expected)
        return centre_frame(frame) if self._centre else frame

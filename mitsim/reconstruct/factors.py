"""Factors of a calibrated camera, and their estimate from responses to +-1 stripes on a white board.

Under X = h_i 1^T a separable camera records Y_i = Phi_L h_i (Phi_R 1)^T = u_i v^T, and under 1 h_i^T it records a w_i^T
with a = Phi_L 1. The uniform response a v^T gives a and v. Projections on them give u_i and w_i, and H H^T = N I gives
Phi_L = U H^T / N (arXiv 2111.12862, section IV-A, after the FlatCam procedure; the paper omits 1/N). Factors are known
up to (c Phi_L, Phi_R / c) only. They are returned balanced, |Phi_L 1| = |Phi_R 1|."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray, SeparableTerm, sum_of_squares
from mitsim.core.configuration import Drawn, takes
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, checked_fields, cut
from mitsim.core.exr import Channels, Metadata, checksum, finite_channel, read_frame, verify, write_frame
from mitsim.core.files import output_folder
from mitsim.core.images import card, from_above, normalise, span
from mitsim.core.manifests import SIDES, CalibrationManifest, FactorNoise, read_manifest, write_manifest
from mitsim.core.runs import Capture
from mitsim.devices.patterns import PatternFamily, parse_patterns
from mitsim.reconstruct.solver import Pair, Status, Verdict, centre_columns, centre_frame

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from scipy.sparse.linalg import LinearOperator
    from xarray import Dataset

SEPARABLE_RESIDUAL = 0.01
"""Residual above which the status warns: a keystone of 1.5 % costs 16 %; falloff and diffraction leave below 1e-3."""

UNKNOWN_NOISE = 0.05


LARGEST_ERROR = 0.1
_NUMBERS_AT_ONCE = 2**15
_TURNS, _TURNED = 30, 1e-13


# ---- Estimated factors ----


@dataclass(frozen=True, eq=False)
class Estimate:
    """Estimated factors Phi_L (m, n), Phi_R (m', n), in the square root of the frames' unit, and their quality.

    ``separability_residual`` is sqrt(sum ||Y_i - u_i v^T||^2 / sum ||Y_i||^2), and ``unexplained`` its part beyond
    stated noise. ``noise`` is the rms of Y_i - u_i v^T [frame unit], and ``predicted_error`` the relative error by
    such noise.
    """

    left: FloatArray
    right: FloatArray
    separability_residual: float
    unexplained: float
    condition: float
    noise: float
    predicted_error: tuple[float, float]
    rank: tuple[int, int]
    status: Status

    @property
    def ok(self) -> bool:
        return self.status.ok


# ---- Sums over the responses of a side ----


@dataclass(frozen=True, eq=False)
class ResponseFit:
    """Contribution of one response to :class:`StripeSums`: least-squares u_i or w_i in Y_i = u_i common^T."""

    vector: FloatArray
    misfit: float
    energy: float
    ambient: FloatArray
    light: FloatArray | None = None


@dataclass
class StripeSums:
    """Running sums over the responses of one side, which continue to the same bits after being saved.

    ``common`` is v of Y_i = u_i v^T or, for vertical stripes, a of Y_i^T = w_i a^T. ``lights`` (m, N) are the
    projected sums of each response's two frames, (m, 0) where they are unknown.
    """

    side: str
    centre: bool
    common: FloatArray
    vectors: FloatArray
    misfit: float = 0.0
    energy: float = 0.0
    done: int = 0
    misfits: FloatArray = field(init=False)
    energies: FloatArray = field(init=False)
    ambient: FloatArray = field(init=False)
    lights: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self.misfits, self.energies = np.zeros((2, self.vectors.shape[1]))
        self.ambient = np.zeros((self.vectors.shape[1], 3))
        self.lights = np.zeros((len(self.vectors), 0))

    def fit_response(self, given: FloatArray, light: FloatArray | None = None) -> ResponseFit:
        across, response = self.side == "horizontal", centre_frame(given) if self.centre else given
        common = self.common / np.dot(self.common, self.common)
        vector = (response if across else response.T) @ common
        rows, columns = (vector, self.common) if across else (self.common, vector)
        misfit = energy = 0.0
        step = max(1, _NUMBERS_AT_ONCE // response.shape[1])
        for start in range(0, len(response), step):
            block = response[start : start + step]
            explained = np.multiply.outer(rows[start : start + step], columns)
            misfit += sum_of_squares(np.subtract(block, explained, out=explained))
            energy += sum_of_squares(block)
        # Both factors' means are zero if centred, so that light of no mask is not in their vectors.
        shown = AmbientLight(self.common, len(vector)).measure(given if across else given.T)
        if light is not None:
            light = (light if across else light.T) @ common
            light -= light.mean() * self.centre
        return ResponseFit(vector, misfit, energy, shown * (not self.centre), light)

    def put(self, seen: ResponseFit) -> None:
        self.vectors[:, self.done] = seen.vector
        self.misfit += seen.misfit
        self.energy += seen.energy
        self.misfits[self.done], self.energies[self.done] = seen.misfit, seen.energy
        self.ambient[self.done] = seen.ambient
        if seen.light is not None:
            self.lights = self.lights if self.lights.size else np.zeros_like(self.vectors)
            self.lights[:, self.done] = seen.light
        self.done += 1


def stripe_sums(
    horizontal: FloatArray,
    vertical: FloatArray,
    count: int,
    centre: bool = False,
    lights: Sequence[FloatArray | None] = (None, None),
) -> tuple[StripeSums, StripeSums]:
    first, second = (centre_frame(each) if centre else each for each in (horizontal, vertical))
    mean = (upright(first, horizontal) + upright(second, vertical)) / 2
    a, v = _rank_one_split(mean)
    left = StripeSums("horizontal", centre, v, np.empty((len(a), count)))
    right = StripeSums("vertical", centre, a, np.empty((len(v), count)))
    for sums, response, light in zip((left, right), (horizontal, vertical), lights, strict=True):
        sums.put(sums.fit_response(response, light))
    return left, right


def upright(response: FloatArray, light: npt.ArrayLike) -> FloatArray:
    negative = np.sum(light) < -0.1 * np.abs(light).sum()
    return -response if negative else response


# ---- From responses, or their sums, to factors ----


def factors_of_sums(
    left: StripeSums,
    right: StripeSums,
    signs: FloatArray,
    stated_noise: float | None = None,
    extra: tuple[float, float] = (0.0, 0.0),
) -> Estimate:
    v, a = left.common, right.common
    count = signs.shape[1]
    phi = left.vectors @ signs.T / count, right.vectors @ signs.T / count
    energy = left.energy + right.energy
    residual = float(np.sqrt((left.misfit + right.misfit) / energy))
    # Each response of m m' numbers spends one fitted number a sensor row (or column).
    spare = count * (len(a) * (len(v) - 1) + len(v) * (len(a) - 1))
    noise = float(np.sqrt((left.misfit + right.misfit) / spare))
    expected = spare * (stated_noise or 0.0) ** 2 / energy
    unexplained = float(np.sqrt(max(residual**2 - expected, 0.0)))
    allowed = UNKNOWN_NOISE if stated_noise is None else max(SEPARABLE_RESIDUAL, 0.2 * float(np.sqrt(expected)))
    n, predicted, rank, dark = len(signs), list[float](), list[int](), list[int]()
    singular = [np.asarray(np.linalg.svd(factor, compute_uv=False)) for factor in phi]
    condition = max(squared_condition(factor, values) for factor, values in zip(phi, singular, strict=True))
    for factor, common, values, more in zip(phi, (v, a), singular, extra, strict=True):
        error = predicted_error(factor, noise, float(np.linalg.norm(common)), count)
        if more:
            error = float(np.hypot(error, np.sqrt(more / count) / np.linalg.norm(factor)))
        predicted.append(error)
        rank.append(rank_above_noise(factor, error, values))
        # Patterns resolve lines whose shadows are alike, but not a line without a shadow.
        dark.append(int(np.count_nonzero(np.linalg.norm(factor, axis=0) <= _least(factor, error, values))))
    shown = f"rank {rank[0]} of {n} and {rank[1]} of {n}, condition {condition:.1e}"
    figures = f"Factor error {predicted[0]:.1e} and {predicted[1]:.1e}, {shown}."
    if unexplained > allowed:
        verdict, words = Verdict.NOT_SEPARABLE, f"Responses are not separable: {unexplained:.1%} of them is left over"
        words += f" ({decibels(unexplained):.1f} dB)"
        remedy = "for a FlatCam or MURA mask give centre = true in the list, otherwise look for ambient light or a "
        remedy += "rotated part, or average more shots (repeats = 4 in the recipe)"
    elif max(predicted) > LARGEST_ERROR:
        verdict, times = Verdict.MOSTLY_NOISE, int(np.ceil(min((max(predicted) / LARGEST_ERROR) ** 2, 1024)))
        remedy = f"average {times} times as many shots (repeats = {times} in the recipe)"
        words = f"Factors are mostly noise: an error of {max(predicted):.0%} is expected of them, allowed are "
        words += f"{LARGEST_ERROR:.0%}"
    elif any(dark):
        verdict, remedy = Verdict.RANK_DEFICIENT, "check the projector, or average more shots (repeats = 4)"
        words = f"Factors are rank deficient: {dark[0]} scene rows and {dark[1]} scene columns are not above noise"
    else:
        verdict, words, remedy = Verdict.CALIBRATED, "Calibrated: responses are separable", ""
        if rank != [n, n]:
            words += f"; uniform light alone leaves {n - rank[0]} directions of scene rows and {n - rank[1]} of columns"
            words += " below noise and rounding, which dots resolve (--patterns dots:7)"
    status = Status(verdict, words, remedy, figures)
    errors, ranks = (predicted[0], predicted[1]), (rank[0], rank[1])
    return Estimate(phi[0], phi[1], residual, unexplained, condition, noise, errors, ranks, status)


# ---- The error that noise makes ----


def predicted_error(factor: FloatArray, noise: float, common_norm: float, count: int) -> float:
    """Return the relative Frobenius error of a factor by independent noise of each datum.

    u_i = Y_i v / |v|^2 has variance noise^2 / |v|^2 a number, with |v| the ``common_norm``, and U H^T / N averages N
    (``count``) of them. The error of v is neglected, because it is of second order.
    """
    deviation = noise / (np.sqrt(count) * common_norm)
    norm = float(np.linalg.norm(factor))
    return float(deviation * np.sqrt(factor.size) / norm) if norm else float("inf")


# ---- Light that is no mask's ----


class AmbientLight:
    def __init__(self, common: FloatArray, length: int) -> None:
        self._places, even = np.linspace(-1, 1, length), np.ones(length)
        shapes = np.stack([np.ones(len(common)), np.linspace(-1, 1, len(common))], axis=1)
        shares = common @ shapes / np.dot(common, common)
        self.effects = np.stack([shares[0] * even, shares[0] * self._places, shares[1] * even])
        self._across = shapes - np.outer(common, shares)
        self._products = np.zeros((3, 3))
        self._products[::2, ::2] = length * self._across.T @ self._across
        self._products[1, 1] = np.dot(self._places, self._places) * np.square(self._across[:, 0]).sum()
        self._inverse = np.linalg.pinv(self._products)
        self.variances = np.diag(self._inverse)

    def measure(self, response: FloatArray) -> FloatArray:
        seen = response @ self._across
        return np.asarray(self._inverse @ [seen[:, 0].sum(), self._places @ seen[:, 0], seen[:, 1].sum()])

    def energies(self, sizes: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("ki,ij,kj->k", sizes, self._products, sizes))


# ---- Decibels, condition and rank ----


def decibels(part: float) -> float:
    return float(20 * np.log10(part))


def squared_condition(phi: FloatArray, values: FloatArray | None = None) -> float:
    values = np.asarray(np.linalg.svd(phi, compute_uv=False)) if values is None else values
    lost = phi.shape[0] < phi.shape[1] or values[-1] <= _rounding(phi, values)
    return float("inf") if lost else float((values[0] / values[-1]) ** 2)


def rank_above_noise(phi: FloatArray, error: float, values: FloatArray | None = None) -> int:
    """Return the number of singular ``values`` of ``phi`` (m, n) above rounding and noise of a relative ``error``."""
    values = np.asarray(np.linalg.svd(phi, compute_uv=False)) if values is None else values
    return int(np.count_nonzero(values > _least(phi, error, values)))


def _least(phi: FloatArray, error: float, values: FloatArray) -> float:
    if not phi.any():
        return 0.0
    # Six standard deviations above the mean of chi-square of m degrees.
    deviation, rows = error * np.linalg.norm(phi) / np.sqrt(phi.size), phi.shape[0]
    return max(float(deviation * np.sqrt(rows + 6 * np.sqrt(2 * rows))), _rounding(phi, values))


def _rounding(phi: FloatArray, values: FloatArray) -> float:
    return float(values[0] * max(phi.shape) * np.finfo(np.float64).eps)


# ---- The uniform response as a product of two vectors ----


def _rank_one_split(mean: FloatArray) -> Pair:
    """Return a (m,) and v (n,) whose product is nearest to a uniform response ``mean`` (m, n).

    Power iteration is tried first, because an SVD takes half a minute at 2048 x 2048.
    """

    def unit(vector: FloatArray) -> FloatArray:
        norm = float(np.linalg.norm(vector))
        return vector / norm if norm else vector

    # No direction of the data: what starts across the first singular vector would not find it.
    right = unit(np.random.default_rng(0).standard_normal(len(mean)) @ mean)
    for _ in range(_TURNS):
        before, right = right, unit(unit(mean @ right) @ mean)
        if np.linalg.norm(right - before) <= _TURNED:
            break
    else:
        right = np.asarray(np.linalg.svd(mean, full_matrices=False)[2][0])
    left = mean @ right
    size = float(np.linalg.norm(left))
    if size == 0:
        raise MitsimError("the uniform response is zero everywhere; check exposure and black level")
    root = np.sqrt(size) if left.sum() >= 0 else -np.sqrt(size)
    return left * (root / size), right * root


# ---- Factors of a calibrated camera ----

_LACKING = "lacking"
_LIGHT = ("projector.lines_nm", "projector.radiant_shares")


@checked_fields
@dataclass(frozen=True, eq=False)
class Factors:
    """Factors of a calibrated camera: a frame under pattern P is Phi_L (P o X) Phi_R^T.

    Attributes
    ----------
    left, right
        Phi_L (m, n), Phi_R (m', n') [sqrt(electrons / s)], in single precision as in files.
    manifest
        Camera, and use of the factors.
    status
        Status of the estimate.
    name
        Folder, or name in messages.
    estimate
        Estimate with residual and predicted error; None for factors from a folder.
    lacking
        Separable terms [(m, n), (m', n')] of the camera's model that the factors lack.
    """

    left: FloatArray
    right: FloatArray
    manifest: CalibrationManifest
    status: Status
    name: str = "in memory"
    estimate: Estimate | None = None
    lacking: tuple[SeparableTerm, ...] = ()

    def __post_init__(self) -> None:
        for name, side in self._sides():
            if side.ndim != 2:
                raise ArgumentError(name, f"has {side.ndim} dimensions; give (sensor, projector) pixels")

    @classmethod
    @check_arguments
    def of(cls, estimate: Estimate, manifest: CalibrationManifest, lacking: Iterable[SeparableTerm] = ()) -> Factors:
        """Return the factors of an ``estimate`` with the ``manifest`` of its camera, and the terms that they lack."""
        left, right = _single(estimate.left), _single(estimate.right)
        sides = zip((estimate.left, estimate.right), estimate.predicted_error, strict=True)
        own, other = (float(error * float(np.linalg.norm(side)) / np.sqrt(side.size)) for side, error in sides)
        known = np.isfinite([own, other]).all()
        noise = FactorNoise(left=own, right=other, unexplained=estimate.unexplained) if known else None
        update = {"estimate": str(estimate.status), "verdict": estimate.status.verdict.value, "noise": noise}
        terms = tuple((_single(a), _single(b)) for a, b in lacking)
        return cls(left, right, manifest.model_copy(update=update), estimate.status, estimate=estimate, lacking=terms)

    @cached_property
    def condition(self) -> float:
        """Larger cond(Phi)^2 of the two; inf when rank deficient."""
        return max(squared_condition(self.left), squared_condition(self.right))

    @property
    def stated_rank(self) -> tuple[int, int] | None:
        """Ranks of both factors above the noise, as the calibration states them; None for sessions."""
        match self.manifest.result.get("rank"):
            case [int(rows), int(columns)]:
                return rows, columns
        return None

    @property
    def sides(self) -> Pair:
        """Both factors, centred if frames are."""
        if not self.manifest.centre:
            return self.left, self.right
        return centre_columns(self.left), centre_columns(self.right)

    @property
    def ok(self) -> bool:
        """Whether the status is good and there are no warnings."""
        return self.status.ok and not self.warnings

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of the calibration."""
        return self.manifest.warnings

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 that equal factors share, in memory or on disk."""
        centre = str(self.manifest.centre).encode()
        return hashlib.sha256(self.left.tobytes() + self.right.tobytes() + centre).hexdigest()

    @check_arguments
    def save(self, folder: Path | str) -> Path:
        """Write the CAL folder of `mitsim calibrate` to a new or empty ``folder``, and return it."""
        with output_folder(folder) as place:
            return self.write(place)

    @check_arguments
    def write(self, folder: Path | str) -> Path:
        """Write the files to a ``folder`` that this process holds already (:func:`mitsim.core.files.output_folder`)."""
        folder = Path(folder)
        metadata: dict[str, str | float] = {"unit": "sqrt(e-/s)"}
        if self.manifest.board_reflectance is not None:
            metadata["reflectance"] = self.manifest.board_reflectance
        for axis, (name, factor) in enumerate(self._sides()):
            channels = {"factor": factor} | {f"{_LACKING}{k}": term[axis] for k, term in enumerate(self.lacking)}
            single = {channel: values.astype(np.float32) for channel, values in channels.items()}
            write_frame(folder / f"{name}.exr", single, metadata)
        checksums = {f"{name}.exr": checksum(folder / f"{name}.exr") for name in SIDES}
        write_manifest(folder, self.manifest.model_copy(update={"checksums": checksums, "status": "complete"}))
        return folder

    @check_arguments
    def check_fit(self, shots: Capture) -> None:
        """Raise MitsimError if ``shots`` are of another camera, mask, distance, projector or light."""
        ours, theirs = (camera_parts(each.manifest.camera) for each in (shots, self))
        for name in sorted({*ours, *theirs}, key=lambda name: (not name.endswith("name"), name)):
            own, other = ours.get(name), theirs.get(name)
            if own == other or (name in _LIGHT and None in (own, other)):
                continue
            which = "calibrate the run's camera, with its scene, --camera, --projector and -D"
            if name in _LIGHT:
                which = "calibrate in this light: its diffraction at the mask differs"
            if None in (own, other) and shots.manifest.plan is None:
                which = f"if it is the same camera, import the frames again with --calibration {self.name}"
            theirs_is, ours_is = ("not stated" if each is None else cut(str(each)) for each in (other, own))
            both = f"{cut(name)} is {theirs_is}, but in {shots.name} it is {ours_is}"
            raise MitsimError(f"calibration {self.name}: {both}; {which}")
        for side, pattern, factor in zip(("P_L", "P_R"), shots.patterns, (self.left, self.right), strict=True):
            if len(pattern) != factor.shape[1]:
                own = f"patterns.{side} has {len(pattern)} scene pixels"
                other = f"calibration {self.name} has {factor.shape[1]}"
                raise MitsimError(f"{shots.name}: {own}, but {other}; calibrate with this projector")

    @check_arguments
    def operator(self, patterns: str | PatternFamily, seed: int = 0) -> LinearOperator:
        """Return the whole model as a linear operator, with its adjoint.

        Parameters
        ----------
        patterns
            Pattern family, or its name such as ``dots:7``.
        seed
            Seed of a ``random`` family given by name.

        Returns
        -------
        LinearOperator
            (K K' m m', n n'): from an image (n, n'), row by row, to the measurements (K, K', m, m') [electrons/s] of
            all patterns (i, j), centred where the calibration is.
        """
        from scipy.sparse.linalg import LinearOperator

        rows, columns = self.left.shape[1], self.right.shape[1]
        if isinstance(patterns, str):
            patterns = parse_patterns(patterns, rows, seed)
        lit = len(patterns.left), len(patterns.right)
        if lit != (rows, columns):
            words = f"are for {lit[0]} x {lit[1]} scene pixels, but the factors have {rows} x {columns}"
            raise MitsimError(f"patterns {patterns.name!r} {words}; use patterns of that size")
        factors = self.sides
        # (K, m, n) stacks Phi diag(p_i): frame (i, j) is lefts[i] X rights[j]^T.
        sides = zip(factors, (patterns.left, patterns.right), strict=True)
        lefts, rights = (factor[None] * side.T[:, None, :].astype(np.float64) for factor, side in sides)
        shape = len(lefts), len(rights), len(self.left), len(self.right)

        def forward(image: FloatArray) -> FloatArray:
            half = lefts @ image.reshape(rows, columns)
            return np.asarray(half[:, None] @ rights.transpose(0, 2, 1)).ravel()

        def adjoint(frames: FloatArray) -> FloatArray:
            gathered = (frames.reshape(shape) @ rights).sum(axis=1)
            return np.asarray((lefts.transpose(0, 2, 1) @ gathered).sum(axis=0)).ravel()

        size = int(np.prod(shape)), rows * columns
        return LinearOperator(size, matvec=forward, rmatvec=adjoint, dtype=np.dtype(np.float64))

    @takes(Drawn)
    def plot(self, side: Literal["left", "right"] = "left", ax: Axes | None = None, **figure: Any) -> Axes:
        """Draw a factor (``left`` of rows, ``right`` of columns) with a colour bar, and return the axes."""
        return from_above("report.plots", "draw_factor")(self, side, ax, **figure)

    def to_xarray(self) -> Dataset:
        """Return both factors as an ``xarray.Dataset`` with units and, where they are known, coordinates in mm."""
        return from_above("exchange.other_programs", "label_factors")(self)

    def __repr__(self) -> str:
        shapes = ", ".join(f"{name} {side.shape[0]} x {side.shape[1]}" for name, side in self._sides())
        return f"Factors({shapes}: {self.status.verdict.value}, {self.name})"

    def _repr_html_(self) -> str:
        pictures = {}
        for name, side in self._sides():
            caption = f"{name}: {side.shape[0]} sensor x {side.shape[1]} projector pixels"
            pictures[f"{caption}\n{span(side, 'sqrt(e-/s)')}"] = normalise(side)
        return card(f"Factors: {self.status.verdict.value}", pictures, (str(self.status), *self.warnings))

    def _sides(self) -> tuple[tuple[str, FloatArray], ...]:
        return tuple(zip(SIDES, (self.left, self.right), strict=True))


def _single(values: FloatArray) -> FloatArray:
    return values.astype(np.float32).astype(np.float64)


def camera_parts(camera: Mapping[str, Any]) -> dict[str, Any]:
    """Return the facts of a manifest's ``camera`` by dotted name, with the mask of a camera file in words."""
    found: dict[str, Any] = {}
    for part, value in camera.items():
        inner = value.items() if isinstance(value, Mapping) else ()
        found |= {f"{part}.{name}": each for name, each in inner} if inner else {part: value}
    words = found.pop("geometry.mask_plate", None)
    return found if words is None else {**found, "geometry.mask": words}


@check_arguments
def load_calibration(folder: Path | str) -> Factors:
    """Return the factors in a CAL ``folder``, or raise MitsimError if it is not a complete calibration."""
    folder = Path(folder)
    manifest = read_manifest(folder, CalibrationManifest)

    def read(name: str) -> tuple[Channels, Metadata]:
        verify(folder, name, manifest.checksums, "calibrate again")
        return read_frame(folder / name)

    return factors_of(manifest, read, str(folder))


def factors_of(
    manifest: CalibrationManifest, read: Callable[[str], tuple[Channels, Metadata]], name: str = "in memory"
) -> Factors:
    files = [(Path(name) / f"{side}.exr", read(f"{side}.exr")[0]) for side in SIDES]
    left, right = (finite_channel(channels, "factor", path) for path, channels in files)
    terms = max(sum(channel.startswith(_LACKING) for channel in channels) for _, channels in files)
    names = [f"{_LACKING}{k}" for k in range(terms)]
    rows, columns = ([finite_channel(channels, each, path) for each in names] for path, channels in files)
    sentence = manifest.estimate or "Factors from elsewhere, without a word on how good they are"
    known = {verdict.value: verdict for verdict in Verdict}
    status = Status(known.get(manifest.verdict or "", Verdict.UNKNOWN), sentence.rstrip("."))
    return Factors(left, right, manifest, status, name, lacking=tuple(zip(rows, columns, strict=True)))

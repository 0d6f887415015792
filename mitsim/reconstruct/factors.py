"""The two factors of a calibrated camera: arrays or a CAL folder in, the linear operator of any pattern family out."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from mitsim.core.arrays import FloatArray, SeparableTerm
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, checked_fields, cut
from mitsim.core.exr import Channels, Metadata, checksum, finite_channel, read_frame, verify, write_frame
from mitsim.core.files import output_folder
from mitsim.core.images import card, from_above, normalise, span
from mitsim.core.manifests import SIDES, CalibrationManifest, FactorNoise, read_manifest, write_manifest
from mitsim.core.runs import Capture
from mitsim.devices.patterns import PatternFamily, parse_patterns
from mitsim.reconstruct.estimate_factors import Estimate, squared_condition
from mitsim.reconstruct.solution import Status, Verdict
from mitsim.reconstruct.solver import centre_columns

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from scipy.sparse.linalg import LinearOperator
    from xarray import Dataset

_LACKING = "lacking"
"""What channels of a factor's file begin with that hold terms which it lacks; their number follows."""
_LIGHT = ("projector.lines_nm", "projector.radiant_shares")
"""Parts of an identity that manifests of 0.4.0 do not state; where one of two states none, its light may be any."""


@checked_fields
@dataclass(frozen=True, eq=False)
class Factors:
    """A camera's factors, as a CAL folder holds them: a frame under pattern P is Phi_L (P o X) Phi_R^T.

    Attributes
    ----------
    left, right
        Phi_L (m, n), Phi_R (m', n') [sqrt(electrons / s)], numbers of single precision, so that factors from memory and
        from disk are the same.
    manifest
        of which camera they are, and how they are used.
    status
        what the estimator thought of them.
    name
        the folder, or what messages call factors in memory.
    estimate
        what they were fitted as, with residual and predicted error; None for factors from a folder.
    lacking
        separable terms [(m, n), (m', n')] of the camera that the factors lack, where a model of it tells them: they
        predict what images leave unexplained. Of other pixels, or scaled, factors have none.
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
        """The factors of an estimate.

        Parameters
        ----------
        estimate
            as it was fitted.
        manifest
            which names the camera.
        lacking
            what the factors lack of the camera, as separable terms.
        """
        left, right = _single(estimate.left), _single(estimate.right)
        update = {
            "estimate": str(estimate.status),
            "verdict": estimate.status.verdict.value,
            "noise": _factor_noise(estimate),
        }
        terms = tuple((_single(a), _single(b)) for a, b in lacking)
        return cls(left, right, manifest.model_copy(update=update), estimate.status, estimate=estimate, lacking=terms)

    @cached_property
    def condition(self) -> float:
        """The larger cond(Phi)^2 of the two: the conditioning of A under uniform light; inf when rank deficient."""
        return max(squared_condition(self.left), squared_condition(self.right))

    @property
    def stated_rank(self) -> tuple[int, int] | None:
        """Directions of scene rows and of columns that the calibration states to be above its noise; None: not stated,
        as of sessions, which are flagged where they lack any."""
        match self.manifest.result.get("rank"):
            case [int(rows), int(columns)]:
                return rows, columns
        return None

    @property
    def sides(self) -> tuple[FloatArray, FloatArray]:
        """Both factors as the solver takes them: without their columns' means where frames are centred."""
        if not self.manifest.centre:
            return self.left, self.right
        return centre_columns(self.left), centre_columns(self.right)

    @property
    def ok(self) -> bool:
        """Whether the factors can be used as they are: a good status, and no warnings."""
        return self.status.ok and not self.warnings

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why the calibration is flagged."""
        return self.manifest.warnings

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 that equal factors share, in memory or on disk."""
        centre = str(self.manifest.centre).encode()
        return hashlib.sha256(self.left.tobytes() + self.right.tobytes() + centre).hexdigest()

    @check_arguments
    def save(self, folder: Path | str) -> Path:
        """Write the CAL folder that `mitsim calibrate` writes, to a new or empty ``folder``; returns it.

        MitsimError when it holds something, or cannot be written.
        """
        with output_folder(folder) as place:
            return self.write(place)

    @check_arguments
    def write(self, folder: Path | str) -> Path:
        """The same in a ``folder`` that this process holds already (:func:`mitsim.core.files.output_folder`)."""
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
        """MitsimError when ``shots`` are of another camera, mask, distance, projector or light: names first, then
        the first thing that differs."""
        ours, theirs = (_parts(each.manifest.camera) for each in (shots, self))
        for name in sorted({*ours, *theirs}, key=lambda name: (not name.endswith("name"), name)):
            own, other = ours.get(name), theirs.get(name)
            if own == other or (name in _LIGHT and None in (own, other)):
                continue
            which = "the run's camera, with its scene, --camera, --projector and -D"
            if name in _LIGHT:
                which = "in this light: its diffraction at the mask differs"
            said = [cut("that of a camera file" if each == "plate" else str(each)) for each in (other, own)]
            raise MitsimError(
                f"calibration {self.name}: {cut(name)} is {said[0]}, but {shots.name} has {said[1]}; calibrate {which}"
            )
        for side, pattern, factor in zip(("P_L", "P_R"), shots.patterns, (self.left, self.right), strict=True):
            if len(pattern) != factor.shape[1]:
                raise MitsimError(
                    f"{shots.name}: patterns.{side} has {len(pattern)} scene pixels, but calibration {self.name} has "
                    f"{factor.shape[1]}; calibrate with this projector"
                )

    @check_arguments
    def operator(self, patterns: str | PatternFamily, seed: int = 0) -> LinearOperator:
        """The whole model as a linear operator, with its adjoint.

        Parameters
        ----------
        patterns
            a family, or its name such as ``dots:7``.
        seed
            of the patterns of a ``random`` family given by name.

        Returns
        -------
        LinearOperator
            (K K' m m', n n'): takes an image (n, n'), row by row, to the measurements (K, K', m, m') [electrons/s] of
            all patterns (i, j), the differences of signed pairs; centred where the calibration is.

        Raises
        ------
        MitsimError
            for patterns that do not fit the factors.
        """
        from scipy.sparse.linalg import LinearOperator

        rows, columns = self.left.shape[1], self.right.shape[1]
        if isinstance(patterns, str):
            patterns = parse_patterns(patterns, rows, seed)
        lit = len(patterns.left), len(patterns.right)
        if lit != (rows, columns):
            raise MitsimError(
                f"patterns {patterns.name!r} are for {lit[0]} x {lit[1]} scene pixels, but the factors have "
                f"{rows} x {columns}; use patterns of that size"
            )
        factors = self.sides
        # (K, m, n) stacks Phi diag(p_i): frame (i, j) is lefts[i] X rights[j]^T.
        lefts, rights = (
            factor[None] * side.T[:, None, :].astype(np.float64)
            for factor, side in zip(factors, (patterns.left, patterns.right), strict=True)
        )
        shape = len(lefts), len(rights), len(self.left), len(self.right)

        def forward(image: FloatArray) -> FloatArray:
            half = lefts @ image.reshape(rows, columns)
            return np.asarray(half[:, None] @ rights.transpose(0, 2, 1)).ravel()

        def adjoint(frames: FloatArray) -> FloatArray:
            gathered = (frames.reshape(shape) @ rights).sum(axis=1)
            return np.asarray((lefts.transpose(0, 2, 1) @ gathered).sum(axis=0)).ravel()

        return LinearOperator(
            (int(np.prod(shape)), rows * columns), matvec=forward, rmatvec=adjoint, dtype=np.dtype(np.float64)
        )

    @check_arguments
    def plot(self, side: Literal["left", "right"] = "left", ax: Axes | None = None) -> Axes:
        """Draw a factor with a colour bar; returns the axes.

        Parameters
        ----------
        side
            ``left``: of rows; ``right``: of columns.
        ax
            matplotlib's axes to draw on; None: those of a new figure.
        """
        return from_above("report.plots", "draw_factor")(self, side, ax)

    def to_xarray(self) -> Dataset:
        """Both factors as an ``xarray.Dataset`` with units and, where they are known, coordinates in mm; MitsimError
        where xarray, an extra, is not installed."""
        return from_above("exchange.labelled", "label_factors")(self)

    def __repr__(self) -> str:
        shapes = ", ".join(f"{name} {side.shape[0]} x {side.shape[1]}" for name, side in self._sides())
        return f"Factors({shapes}: {self.status.verdict.value}, {self.name})"

    def _repr_html_(self) -> str:
        pictures = {
            f"{name}: {side.shape[0]} sensor x {side.shape[1]} projector pixels\n{span(side, 'sqrt(e-/s)')}": normalise(
                side
            )
            for name, side in self._sides()
        }
        return card(f"Factors: {self.status.verdict.value}", pictures, (str(self.status), *self.warnings))

    def _sides(self) -> tuple[tuple[str, FloatArray], ...]:
        return tuple(zip(SIDES, (self.left, self.right), strict=True))


def _single(values: FloatArray) -> FloatArray:
    """``values`` rounded to single precision."""
    return values.astype(np.float32).astype(np.float64)


def _parts(camera: Mapping[str, Any]) -> dict[str, Any]:
    """What the identity of a ``camera`` says, by names such as ``projector.n``."""
    found: dict[str, Any] = {}
    for part, value in camera.items():
        inner = value.items() if isinstance(value, Mapping) else ()
        found |= {f"{part}.{name}": each for name, each in inner} if inner else {part: value}
    return found


def _factor_noise(estimate: Estimate) -> FactorNoise | None:
    """How exact the factors of an ``estimate`` are; None where all is noise."""
    left, right = (
        error * float(np.linalg.norm(side)) / np.sqrt(side.size)
        for side, error in zip((estimate.left, estimate.right), estimate.predicted_error, strict=True)
    )
    if not np.isfinite([left, right]).all():
        return None
    return FactorNoise(left=float(left), right=float(right), unexplained=estimate.unexplained)


@check_arguments
def load_calibration(folder: Path | str) -> Factors:
    """The factors in the CAL folder ``folder``. MitsimError when it is not a complete calibration."""
    folder = Path(folder)
    manifest = read_manifest(folder, CalibrationManifest)

    def read(name: str) -> tuple[Channels, Metadata]:
        """Channels and metadata of the file ``name``."""
        verify(folder, name, manifest.checksums, "calibrate again")
        return read_frame(folder / name)

    return factors_of(manifest, read, str(folder))


def factors_of(
    manifest: CalibrationManifest, read: Callable[[str], tuple[Channels, Metadata]], name: str = "in memory"
) -> Factors:
    """Factors from a calibration's manifest and files.

    Parameters
    ----------
    manifest
        of the calibration.
    read
        channels and metadata of a file, by its name.
    name
        where they lie, for messages.

    Raises
    ------
    MitsimError
        when a factor is not there, or not finite.
    """
    files = [(Path(name) / f"{side}.exr", read(f"{side}.exr")[0]) for side in SIDES]
    left, right = (finite_channel(channels, "factor", path) for path, channels in files)
    terms = max(sum(channel.startswith(_LACKING) for channel in channels) for _, channels in files)
    rows, columns = (
        [finite_channel(channels, f"{_LACKING}{k}", path) for k in range(terms)] for path, channels in files
    )
    sentence = manifest.estimate or "Factors from elsewhere, without a word on how good they are"
    known = {verdict.value: verdict for verdict in Verdict}
    status = Status(known.get(manifest.verdict or "", Verdict.UNKNOWN), sentence.rstrip("."))
    return Factors(left, right, manifest, status, name, lacking=tuple(zip(rows, columns, strict=True)))

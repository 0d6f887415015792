"""A recovered image and the truth in; PSNR and SSIM out. The only reader of the truth.

Images are reflectances, 1.0 = the calibration board. Nothing here fits a gain or an offset, and nothing
clips: a reconstruction of the wrong brightness is a wrong reconstruction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.runs import Capture

_LIMITED = ", which limits the PSNR"
Image = NDArray[np.floating[Any]]

_SSIM_WINDOW = 7
"""Pixels a side; scikit-image's default."""
_LIMITS_DB = 10.0
"""How far above an image's PSNR the truth must be: nearer, it makes more than a tenth of the squared error."""


@dataclass(frozen=True)
class Quality:
    """How close an image is to the truth.

    Attributes
    ----------
    psnr_db
        as :func:`psnr`.
    ssim
        as :func:`ssim`; None for images smaller than its window.
    truth_error
        standard error of the truth, rms over the image; None where nobody stated it.
    """

    psnr_db: float
    ssim: float | None
    truth_error: float | None = None

    @property
    def truth_db(self) -> float | None:
        """PSNR [dB] of the truth against exact values: no image can be judged beyond it."""
        if self.truth_error is None:
            return None
        return float("inf") if self.truth_error == 0 else float(-20 * np.log10(self.truth_error))

    @property
    def limited_by_truth(self) -> bool:
        """Whether the truth's own error makes more than a tenth of the squared error."""
        return self.truth_db is not None and self.truth_db - self.psnr_db < _LIMITS_DB

    def __str__(self) -> str:
        text = f"PSNR {self.psnr_db:.2f} dB" + ("" if self.ssim is None else f", SSIM {self.ssim:.3f}")
        if self.truth_db is None:
            return text
        return f"{text}, truth good to {self.truth_db:.1f} dB{_LIMITED if self.limited_by_truth else ''}"

    @property
    def is_image(self) -> bool:
        """Whether the rms error is below the whole range of reflectance, 0 dB; a gain over a worse image is none."""
        return self.psnr_db > 0

    @classmethod
    def of(cls, image: Image, truth: Image, truth_error: float | None = None) -> Quality:
        """That of an image.

        Parameters
        ----------
        image, truth
            (rows, columns) each.
        truth_error
            rms standard error of the truth, where known.

        Raises
        ------
        MitsimError
            as :func:`psnr`.
        """
        similar = ssim(image, truth) if min(truth.shape) >= _SSIM_WINDOW else None
        return cls(psnr(image, truth), similar, truth_error)


def summary_of(quality: Quality | None) -> dict[str, float | None]:
    """A ``quality`` by the keys of the command line's JSON; None of each without one."""
    keys = {"psnr": "psnr_db", "ssim": "ssim", "truth_error": "truth_error"}
    return {key: None if quality is None else getattr(quality, name) for key, name in keys.items()}


def psnr(image: Image, truth: Image) -> float:
    """Peak signal-to-noise ratio in dB, peak 1: -10 log10(mean((image - truth)^2)); inf when they are equal.

    ``image`` and ``truth`` are (rows, columns). MitsimError when the shapes differ or a value is not finite.
    """
    image, truth = _pair(image, truth)
    mean_square = float(np.mean((image - truth) ** 2))
    return float("inf") if mean_square == 0.0 else float(-10.0 * np.log10(mean_square))


def ssim(image: Image, truth: Image) -> float:
    """Structural similarity (Wang et al. 2004; scikit-image, 7 x 7 uniform window, data range 1), 1 = equal.

    ``image`` and ``truth`` are (rows, columns). MitsimError as :func:`psnr`, and for images smaller than the window.
    """
    from skimage.metrics import structural_similarity

    image, truth = _pair(image, truth)
    if min(image.shape) < _SSIM_WINDOW:
        raise MitsimError(f"SSIM: image is {_size(image)} pixels; needs at least {_SSIM_WINDOW} x {_SSIM_WINDOW}")
    return float(structural_similarity(image, truth, win_size=_SSIM_WINDOW, data_range=1.0))


def relative_error(values: Image, reference: Image) -> float:
    """||a - b|| / ||b|| over all entries of ``values`` a and a ``reference`` b of one shape."""
    b = np.asarray(reference, dtype=np.float64)
    return float(np.linalg.norm(np.asarray(values, dtype=np.float64) - b) / np.linalg.norm(b))


def truth_for(shots: Capture, board_reflectance: float | None = None) -> NDArray[np.float64] | None:
    """(n, n) apparent reflectance that was written beside the ``shots``; None for frames of a real camera.

    It is relative to a board of ``board_reflectance`` where that and the truth's own board are known, otherwise to the
    latter, that of the shipped session recipe.
    """
    return None if shots.truth is None else shots.truth * _rescaling(shots, board_reflectance)


def truth_error_for(shots: Capture, board_reflectance: float | None = None) -> float | None:
    """Standard error of :func:`truth_for` the ``shots`` and ``board_reflectance``, rms over the image; None where
    nobody stated it."""
    error = shots.truth_standard_error
    return None if error is None else float(np.sqrt(np.mean(np.square(error)))) * _rescaling(shots, board_reflectance)


def _rescaling(shots: Capture, board_reflectance: float | None) -> float:
    board = shots.truth_board
    return 1.0 if board_reflectance is None or board is None else board / board_reflectance


def _pair(image: Image, truth: Image) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    a, b = (_real(values, name) for values, name in ((image, "image"), (truth, "truth")))
    if a.ndim != 2 or a.shape != b.shape:
        raise MitsimError(
            f"image quality: image is {_size(a)}, truth {_size(b)}; both must have the same rows x columns"
        )
    for name, values in (("image", a), ("truth", b)):
        bad = int(np.count_nonzero(~np.isfinite(values)))
        if bad:
            raise MitsimError(f"image quality: {name} has {bad} values that are not finite; see the solver's status")
    return a, b


def _real(values: Image, name: str) -> NDArray[np.float64]:
    try:
        found = np.asarray(values)
    except ValueError as error:
        raise ArgumentError(name, f"is no array ({error}); give rows of real numbers") from None
    if found.dtype.kind not in "biuf":
        raise ArgumentError(name, f"has numbers of type {found.dtype}; give real ones")
    return np.asarray(found, dtype=np.float64)


def _size(image: Image) -> str:
    return " x ".join(str(n) for n in image.shape) or "a single number"

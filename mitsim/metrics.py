"""Image quality against the truth: PSNR, SSIM and relative error.

Images are reflectances relative to the calibration board. Values are neither rescaled nor clipped, because an image of
the wrong brightness is a wrong image. No other module reads the truth.
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
"""Pixels a side: the default of scikit-image."""
_LIMITS_DB = 10.0
"""The truth makes more than a tenth of the squared error if its own PSNR is less than this above the image's."""


@dataclass(frozen=True)
class Quality:
    """PSNR [dB] and SSIM of an image, and the rms standard error of the truth.

    ``ssim`` is None for images smaller than its window, ``truth_error`` if it is unknown.
    """

    psnr_db: float
    ssim: float | None
    truth_error: float | None = None

    @property
    def truth_db(self) -> float | None:
        """PSNR [dB] of the truth itself, beyond which no image can be judged; None if the error is unknown."""
        if self.truth_error is None:
            return None
        return float("inf") if self.truth_error == 0 else float(-20 * np.log10(self.truth_error))

    @property
    def limited_by_truth(self) -> bool:
        """True if the truth's own error makes more than a tenth of the squared error."""
        return self.truth_db is not None and self.truth_db - self.psnr_db < _LIMITS_DB

    def __str__(self) -> str:
        text = f"PSNR {self.psnr_db:.2f} dB" + ("" if self.ssim is None else f", SSIM {self.ssim:.3f}")
        if self.truth_db is None:
            return text
        return f"{text}, truth good to {self.truth_db:.1f} dB{_LIMITED if self.limited_by_truth else ''}"

    @property
    def is_image(self) -> bool:
        """True if the rms error is below the whole range of reflectance (0 dB)."""
        return self.psnr_db > 0

    @classmethod
    def of(cls, image: Image, truth: Image, truth_error: float | None = None) -> Quality:
        """Return the quality of an image against the truth, both (rows, columns) [reflectance]."""
        similar = ssim(image, truth) if min(truth.shape) >= _SSIM_WINDOW else None
        return cls(psnr(image, truth), similar, truth_error)


def summary_of(quality: Quality | None) -> dict[str, float | None]:
    """Return the values for JSON; all are None if there is no quality."""
    keys = {"psnr": "psnr_db", "ssim": "ssim", "truth_error": "truth_error"}
    return {key: None if quality is None else getattr(quality, name) for key, name in keys.items()}


def psnr(image: Image, truth: Image) -> float:
    """Return the peak signal-to-noise ratio in dB for a peak of 1: -10 log10(mean((image - truth)^2)).

    Parameters
    ----------
    image, truth : (rows, columns) arrays, reflectance

    Returns
    -------
    float
        Infinite if both are equal.

    Raises
    ------
    MitsimError
        If the shapes differ, or a value is not finite.
    """
    image, truth = _pair(image, truth)
    mean_square = float(np.mean((image - truth) ** 2))
    return float("inf") if mean_square == 0.0 else float(-10.0 * np.log10(mean_square))


def ssim(image: Image, truth: Image) -> float:
    """Return the structural similarity (Wang et al. 2004) with a uniform window of 7 x 7 pixels and data range 1.

    Parameters
    ----------
    image, truth : (rows, columns) arrays, reflectance

    Raises
    ------
    MitsimError
        If the shapes differ, a value is not finite, or the images are smaller than the window.
    """
    from skimage.metrics import structural_similarity

    image, truth = _pair(image, truth)
    if min(image.shape) < _SSIM_WINDOW:
        raise MitsimError(f"SSIM: image is {_size(image)} pixels; needs at least {_SSIM_WINDOW} x {_SSIM_WINDOW}")
    return float(structural_similarity(image, truth, win_size=_SSIM_WINDOW, data_range=1.0))


def relative_error(values: Image, reference: Image) -> float:
    """Return ||values - reference|| / ||reference|| over all entries of two arrays of one shape."""
    b = np.asarray(reference, dtype=np.float64)
    return float(np.linalg.norm(np.asarray(values, dtype=np.float64) - b) / np.linalg.norm(b))


def truth_for(shots: Capture, board_reflectance: float | None = None) -> NDArray[np.float64] | None:
    """Return the true (n, n) apparent reflectance that a simulated capture carries; None for frames of a real camera.

    The truth is relative to a board of ``board_reflectance`` if that and the board of the truth are known.
    """
    return None if shots.truth is None else shots.truth * _rescaling(shots, board_reflectance)


def truth_error_for(shots: Capture, board_reflectance: float | None = None) -> float | None:
    """Return the rms standard error of :func:`truth_for`; None if it is unknown."""
    error = shots.truth_standard_error
    return None if error is None else float(np.sqrt(np.mean(np.square(error)))) * _rescaling(shots, board_reflectance)


def _rescaling(shots: Capture, board_reflectance: float | None) -> float:
    board = shots.truth_board
    return 1.0 if board_reflectance is None or board is None else board / board_reflectance


def _pair(image: Image, truth: Image) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    a, b = (_real(values, name) for values, name in ((image, "image"), (truth, "truth")))
    if a.ndim != 2 or a.shape != b.shape:
        raise MitsimError(f"image quality: image is {_size(a)}, truth {_size(b)}; both must have the same shape")
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

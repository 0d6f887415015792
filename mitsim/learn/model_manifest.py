"""What the file of a network says of it."""

from __future__ import annotations

from pydantic import Field

from mitsim.core.configuration import Configuration, Positive
from mitsim.core.manifests import FORMAT, Plain


class ModelManifest(Configuration):
    """What a network was trained for, and how."""

    format: int = Field(default=FORMAT, ge=1, le=FORMAT)
    """Version of this format."""
    method: str
    """Name of the method, as `mitsim train` takes it."""
    camera: Plain
    """Identity of the camera, as its calibration states it."""
    factors: str
    """Fingerprint of the calibration's factors."""
    patterns: str
    """Name of the patterns' family."""
    exposure_s: Positive
    """Of the pairs' frames [s]."""
    noise: tuple[float, float] = Field(strict=False)
    """Noise of a datum over its rms, least and largest of the pairs."""
    pairs: Plain
    """What the store of the pairs says of itself."""
    training: Plain
    """Steps, batch, rate, seed and weights of losses; `curve`, the PSNR of pairs that choose, by step; `psnr_db` of
    pairs that neither teach nor choose."""
    versions: dict[str, str]
    """Of mitsim, torch and others."""

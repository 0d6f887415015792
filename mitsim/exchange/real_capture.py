"""What a person knows of a real capture in, checked before any frame is opened; planes of a colour sensor's frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mitsim.core.configuration import locate
from mitsim.core.errors import ArgumentError
from mitsim.core.files import check_plain
from mitsim.core.imagelist import Raw, Wanted, image_files
from mitsim.core.manifests import CalibrationManifest, read_manifest
from mitsim.core.seeds import check_root
from mitsim.devices.patterns import read_name
from mitsim.devices.sensor import check_exposure, load_sensor

PLANES = {"r": (1, 1), "gb": (0, 1), "gr": (1, 0), "b": (0, 0)}
"""First row and first column of each plane of a frame, as FlatCam names them."""


def check_channel(name: str) -> str:
    """The ``name``, where a plane is called so; MitsimError otherwise."""
    if name not in PLANES:
        raise ArgumentError("channel", f"{name!r}: use {', '.join(PLANES)}")
    return name


@dataclass(frozen=True)
class RealCapture:
    """What a person knows of a real capture.

    Attributes
    ----------
    patterns
        name of the family, or `patterns.json` of `mitsim export --format png`.
    camera
        electronics: name of a shipped file, or a TOML file.
    exposure_s
        of every frame [s].
    calibration
        CAL folder of the same camera, which tells its identity and the projector's pixels.
    n
        projector pixels a side, without a calibration.
    black_level_dn
        digital number of a (binned) pixel without charge, where it is another than the camera file's.
    ambient
        frame, or folder of frames, with the projector off.
    ambient_shots
        that the single frame is the mean of.
    raw
        how files without a header are read.
    channel
        plane of a colour sensor's frames that is taken, a key of :data:`PLANES`.
    seed
        of patterns of a `random` family.
    """

    patterns: str
    camera: str
    exposure_s: float
    calibration: Path | None = None
    n: int | None = None
    black_level_dn: float | None = None
    ambient: Path | None = None
    ambient_shots: int | None = None
    raw: Raw | None = None
    channel: str | None = None
    seed: int = 0

    @property
    def wanted(self) -> Wanted:
        """How its files are read."""
        return Wanted(raw=self.raw)

    @property
    def in_file(self) -> bool:
        """Whether the patterns stand in a file."""
        return Path(self.patterns).suffix == ".json"

    def check(self, source: Path) -> None:
        """MitsimError for values that cannot be, and a ``source`` without frames, before any frame is opened."""
        check_exposure(self.exposure_s)
        check_root(self.seed)
        if self.n is not None and self.n < 1:
            raise ArgumentError("projector_pixels", f"{self.n}: give 1 or more, those a side")
        if self.channel is not None:
            check_channel(self.channel)
        if self.ambient_shots is not None and (self.ambient is None or self.ambient_shots < 1):
            raise ArgumentError("ambient_shots", f"{self.ambient_shots}: give 1 or more, of an ambient frame")
        load_sensor(locate(self.camera, "calibration", ".toml"))
        if self.calibration is not None:
            read_manifest(self.calibration, CalibrationManifest)
        elif self.n is None:
            raise ArgumentError(
                "calibration", "is not given, and patterns need its projector; give it, or --projector-pixels"
            )
        if self.in_file:
            check_plain(self.patterns)
        else:
            read_name(self.patterns, self.n)
        image_files(source, self.wanted)

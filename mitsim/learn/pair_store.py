"""Store of pairs: frames and truths to learn from, in a folder; and the manifests of stores and of models.

The folder holds `pairs.json` and shards `pairs_00000.h5` and so on. A shard keeps pictures, truths, and the light of a
white print: times a picture, that is the light of the picture. A thousand pairs of 49 frames therefore take 100 MB
instead of 25 GB. Frames are formed, and noise is drawn, when a pair is read.
"""

from __future__ import annotations

import json
import re
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy import sparse

from mitsim.core.arrays import PACKED, FloatArray, Labels, checked_hdf5, hdf5_errors, whole_hdf5
from mitsim.core.configuration import Configuration, Positive, validate
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments
from mitsim.core.files import PAIRS, read_json
from mitsim.core.manifests import FORMAT as MODEL_FORMAT
from mitsim.core.manifests import Digital, Plain, Rows
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer, stream
from mitsim.devices.patterns import Lighting, PatternFamily, parse_patterns
from mitsim.devices.sensor import SensorModel, digital_of
from mitsim.optics.frames import AccumulatedLight, ExpectedFrames, add_speckle
from mitsim.optics.image_formation import FrameOptics
from mitsim.reconstruct.factors import Factors
from mitsim.sensor.chain import expose

if TYPE_CHECKING:
    import h5py

FORMAT = 1
WHITE = 255
_LIGHTS_KEPT = 32
"""Lights of shards in memory, some 10 MB each."""
_PART, _MOST = 16, 48
"""One photograph in 16 chooses the best step, and one judges, up to 48 pairs each."""
Frames = npt.NDArray[np.float32]


# -------- Manifests


class Shard(BaseModel):
    model_config = ConfigDict(frozen=True)

    file: str = Field(pattern=r"^pairs_[0-9]{5}\.h5$")
    """Name in the folder."""
    first: int = Field(ge=0)
    """Number of its first pair."""
    count: int = Field(ge=1)
    """Its pairs."""
    group: int = Field(ge=0)
    """Number of its bench, among `groups`."""


class PairsManifest(BaseModel):
    """Manifest of a store of pairs."""

    model_config = ConfigDict(frozen=True)

    format: int = Field(default=FORMAT, ge=1, le=FORMAT)
    """Version of the layout."""
    kind: Literal["pairs"] = "pairs"
    """Kind of the folder."""
    status: Literal["incomplete", "complete"] = "complete"
    """Whether all shards are written."""
    configuration: dict[str, Any] = {}
    """All that decides the pairs; a store is resumed by the same alone."""
    n: int = Field(ge=1, le=4096)
    """Projector pixels a side, and those of a truth."""
    m: tuple[int, int]
    """Rows and columns of a frame."""
    frames: int = Field(ge=1)
    """Frames of a pair, K: one a pattern, of a signed one the difference of two shots."""
    patterns: str
    """Name of the family, or path and SHA-256 of own patterns."""
    own_patterns: tuple[Rows, Rows] | None = None
    """Rows of P_L and of P_R, of own patterns."""
    exposure_s: float = Field(gt=0)
    """Seconds of a shot; where each pair is exposed for itself, the median."""
    camera: dict[str, Any]
    """Identity that a calibration shares."""
    sensor: str
    """The sensor's model as JSON, by which noise is drawn."""
    digital: Digital
    """Conversion of numbers to electrons a second, and their noise, at that exposure."""
    scene: str
    """Where the scene lies."""
    idealised: bool = False
    """Whether frames are of the separable model, as those of some stores of version 1."""
    traced_anew: str = ""
    """Why light was traced for each picture, in stores of version 1, which are refused."""
    seed: int
    """Root of every random stream."""
    count: int = Field(ge=1)
    """Pairs."""
    pictures: str
    """Where the pictures came from."""
    photographs: tuple[int, ...] = ()
    """Photograph that each file of a folder shows, the same for equal files; pair i shows that of file i, modulo their
    number. Empty: every pair has a picture of its own."""
    ambient_shots: int = Field(ge=0)
    """Shots of the ambient frame that is taken off; 0: none is."""
    groups: tuple[dict[str, float], ...] = ()
    """Drawn numbers of each bench, where benches vary."""
    shards: tuple[Shard, ...] = ()
    """Files, in order."""
    warnings: tuple[str, ...] = ()
    """Why the store is flagged."""
    versions: dict[str, str] = {}
    """Of mitsim, Python and packages."""

    @model_validator(mode="after")
    def _every_pair_has_a_shard(self) -> PairsManifest:
        ends = [0, *(shard.first + shard.count for shard in self.shards)]
        if [shard.first for shard in self.shards] != ends[:-1] or ends[-1] != self.count:
            raise ValueError(f"shards do not hold pairs 0 to {self.count - 1}, each once; make or copy them again")
        return self

    @cached_property
    def family(self) -> PatternFamily:
        if self.own_patterns is not None:
            left, right = map(np.array, self.own_patterns)
            return PatternFamily(self.patterns, left, right)
        return parse_patterns(self.patterns, self.n, self.seed)


class ModelManifest(Configuration):
    """Manifest of a trained network."""

    format: int = Field(default=MODEL_FORMAT, ge=1, le=MODEL_FORMAT)
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
    """Facts of the store of the pairs."""
    training: Plain
    """Steps, batch, rate and seed; `curve`, the PSNR of pairs that choose, by step; `psnr_db` of pairs that neither
    teach nor choose."""
    versions: dict[str, str]
    """Of mitsim, torch and others."""


# -------- Light of a white print


@dataclass(frozen=True, eq=False)
class PrintPart:
    """Light (classes, places) of a white print in one kind of cells [electrons/s], and its optics.

    `rows` and `columns` give the picture's pixel of each row and column of cells.
    """

    optics: FrameOptics
    light: sparse.csr_array
    rows: npt.NDArray[np.int64]
    columns: npt.NDArray[np.int64]
    lamps: bool

    def times(self, reflectance: FloatArray) -> AccumulatedLight:
        """Return the light of a picture (n, n), whose cells repeat for every anchor."""
        cells = reflectance[np.ix_(self.rows, self.columns)]
        height, width = self.optics.cells
        anchors = self.optics.shape[0] // height, self.optics.shape[1] // width
        of_entries = np.tile(cells, anchors).ravel()[self.light.indices]
        light = (self.light.data * of_entries, self.light.indices, self.light.indptr)
        return AccumulatedLight(self.optics, (sparse.csr_array(light, shape=self.light.shape),))


@dataclass(frozen=True, eq=False)
class PrintLight:
    """Light of a white print in parts, and the emission (shots, classes) of a family."""

    parts: tuple[PrintPart, ...]
    emission: FloatArray

    def frames_of(self, reflectance: FloatArray) -> ExpectedFrames:
        """Return the expected frames [electrons/s] of a picture (n, n)."""
        lights = [part.times(reflectance) for part in self.parts if not part.lamps]
        lamps = [part.times(reflectance) for part in self.parts if part.lamps]
        lighting = Lighting(np.arange(self.emission.shape[1]), self.emission)
        return ExpectedFrames(lights, lighting, seed=0, ambient=lamps)

    def write(self, group: h5py.Group) -> None:
        group.create_dataset("emission", data=self.emission, **PACKED)
        for number, part in enumerate(self.parts):
            place = group.create_group(f"part_{number}", track_order=True)
            assert part.optics.terms is not None, "no mask whose shadow is drawn on a raster"
            (terms,) = part.optics.terms
            for axis, side in enumerate(("left", "right")):
                place.create_dataset(side, data=np.stack([term[axis] for term in terms]), **PACKED)
                place.create_dataset(f"{side}_anchors", data=part.optics.weights[axis])
            for name in ("data", "indices", "indptr"):
                place.create_dataset(name, data=getattr(part.light, name), **PACKED)
            place.create_dataset("rows", data=part.rows)
            place.create_dataset("columns", data=part.columns)
            place.attrs.update({"shape": part.light.shape, "lamps": part.lamps})

    @classmethod
    def read(cls, group: h5py.Group) -> PrintLight:
        parts = []
        for name in sorted(name for name in group if name.startswith("part_")):
            place = group[name]
            terms = list(zip(place["left"][:], place["right"][:], strict=True))
            optics = FrameOptics.of_terms([terms], (place["left_anchors"][:], place["right_anchors"][:]))
            entries = tuple(place[each][:] for each in ("data", "indices", "indptr"))
            light = sparse.csr_array(entries, shape=tuple(place.attrs["shape"]))
            light.check_format(full_check=True)
            parts.append(PrintPart(optics, light, place["rows"][:], place["columns"][:], bool(place.attrs["lamps"])))
        return cls(tuple(parts), group["emission"][:])


# -------- Writing


def write_shard(
    path: Path, digest: str, pairs: Iterable[dict[str, Any]], light: PrintLight, speckle: float, warnings: Iterable[str]
) -> None:
    with whole_hdf5(path) as file:
        attributes = {"configuration_sha256": digest, "speckle": speckle, "warnings": json.dumps([*warnings])}
        file.attrs.update(attributes)
        light.write(file.create_group("light", track_order=True))
        for number, rows in enumerate(pairs):
            for name, values in rows.items():
                row = np.asarray(values)
                if name not in file:
                    packed = PACKED if row.ndim == 2 else {}
                    chunks = (1, *row.shape) if row.ndim else True
                    shape, most = (0, *row.shape), (None, *row.shape)
                    file.create_dataset(name, shape, row.dtype, maxshape=most, chunks=chunks, **packed)
                file[name].resize(number + 1, axis=0)
                file[name][number] = row


def is_shard(path: Path, digest: str, count: int) -> bool:
    try:
        with hdf5_errors(path), _open_shard(path) as file:
            return bool(file.attrs["configuration_sha256"] == digest and len(file["truth"]) == count)
    except MitsimError:
        return False


# -------- Reading


def _open_shard(path: Path, known: set[object] | None = None) -> AbstractContextManager[h5py.File]:
    rows = {"/picture", "/truth"}  # of which one row is read at a time
    return checked_hdf5(path, lambda each: 1 / max(each.shape[0], 1) if each.name in rows else 1.0, known)


class PairStore:
    """Pairs in a folder, read one at a time."""

    def __init__(self, folder: Path, manifest: PairsManifest) -> None:
        self.folder, self.manifest = folder, manifest
        self._light = lru_cache(_LIGHTS_KEPT)(self._read_light)
        self._known = set[object]()

    @classmethod
    @check_arguments
    def open(cls, path: Path | str) -> PairStore:
        """Open the finished store in a folder; raise MitsimError if there is none, or if it lacks a file."""
        folder = Path(path)
        if not (folder / PAIRS).is_file():
            raise MitsimError(f"{folder}: holds no {PAIRS}; give a folder of `mitsim pairs`")
        manifest = read_pairs_manifest(folder)
        if manifest.status != "complete":
            raise MitsimError(f"{folder}: its pairs are {manifest.status}; finish them with resume=True")
        missing = [shard.file for shard in manifest.shards if not (folder / shard.file).is_file()]
        if missing:
            raise MitsimError(f"{folder}: lacks {missing[0]}; make or copy the pairs again")
        return cls(folder, manifest)

    def __len__(self) -> int:
        return self.manifest.count

    @property
    def photographs(self) -> Labels:
        numbers = np.arange(len(self))
        files = re.match(r"([0-9]+) files of", self.manifest.pictures)  # stores that were made before files had numbers
        labels = self.manifest.photographs or (range(int(files[1])) if files else numbers)
        return np.asarray(labels)[numbers % len(labels)]

    def __repr__(self) -> str:
        made = self.manifest
        size = "x".join(map(str, made.m))
        return f"PairStore({len(self)} pairs, {made.frames} frames of {size} under {made.patterns}: {self.folder})"

    def summary(self) -> dict[str, Any]:
        made = self.manifest
        named = ("count", "n", "frames", "patterns", "exposure_s", "idealised", "traced_anew", "seed", "pictures")
        return {
            **{name: getattr(made, name) for name in named},
            "shape": list(made.m),
            "groups": max(len(made.groups), 1),
            "ambient_shots": made.ambient_shots,
            "bytes": sum(path.stat().st_size for path in self.folder.iterdir() if path.is_file()),
            "output": str(self.folder),
            "warnings": made.warnings,
        }

    @property
    def patterns(self) -> tuple[FloatArray, FloatArray]:
        family = self.manifest.family
        return family.left.astype(np.float64), family.right.astype(np.float64)

    @cached_property
    def indices(self) -> npt.NDArray[np.int64]:
        return np.array([(shot.row, shot.column) for shot in self.manifest.family.shots if shot.sign != -1])

    @check_arguments
    def truth(self, index: int) -> npt.NDArray[np.float32]:
        """Return the apparent reflectance (n, n) of a pair, relative to the calibration's board."""
        return np.asarray(self._rows(index, "truth")["truth"])

    @check_arguments
    def picture(self, index: int) -> npt.NDArray[np.uint8]:
        return np.asarray(self._rows(index, "picture")["picture"])

    @check_arguments
    def exposure_s(self, index: int) -> float:
        return float(self._rows(index, "exposure_s")["exposure_s"])

    @check_arguments
    def expected_frames(self, index: int) -> Frames:
        """Return the noiseless frames (K, m, m') of a pair [electrons/s], less light of lamps if subtracted."""
        rates, lamps, _, _ = self._light_of(index)
        off = lamps if self.manifest.ambient_shots else 0.0
        return self._measurements(rates, off)

    def frames(self, index: int) -> Frames:
        """Return the noisy frames (K, m, m') of a pair [electrons/s], with the noise of the store's seed."""
        return self.draw(index, self.manifest.seed)

    @check_arguments
    @single_threaded_blas()
    def draw(self, index: int, seed: int) -> Frames:
        made, sensor = self.manifest, SensorModel.model_validate_json(self.manifest.sensor)
        rates, lamps, exposure_s, speckle = self._light_of(index)
        root, digital = integer(seed, "pair", index), digital_of(sensor, exposure_s)

        def shoot(rate: FloatArray, *names: str | int) -> FloatArray:
            shot, read = (stream(root, noise, *names) for noise in ("shot", "read"))
            return digital.rate(expose(rate * exposure_s, exposure_s, sensor, shot, read))

        off: FloatArray | float = 0.0
        if made.ambient_shots:
            off = sum(shoot(lamps, "ambient", shot) for shot in range(made.ambient_shots)) / made.ambient_shots
        shots = zip(rates, made.family.shots, strict=True)
        speckled = ((add_speckle(rate, speckle, stream(root, "speckle", *shot.names)), shot) for rate, shot in shots)
        return self._measurements((shoot(rate, *shot.names) for rate, shot in speckled), off)

    def _measurements(self, rates: Iterable[FloatArray], off: FloatArray | float) -> Frames:
        """Return differences of signed patterns, and other shots less the light `off`."""
        family = self.manifest.family
        seen = family.measurements(rates if family.signed else (rate - off for rate in rates))
        return np.stack([measurement.astype(np.float32) for measurement, _, _ in seen])

    def _light_of(self, index: int) -> tuple[Iterable[FloatArray], FloatArray, float, float]:
        """Return the light of each shot and of lamps [electrons/s], the exposure [s] and the speckle's contrast."""
        light, speckle = self._light(self._shard(index))
        rows = self._rows(index, "picture", "exposure_s")
        expected = light.frames_of(rows["picture"] / WHITE)
        rates = (frame.irradiance for frame in expected)
        return rates, expected.projector_off.irradiance, float(rows["exposure_s"]), speckle

    def _read_light(self, number: int) -> tuple[PrintLight, float]:
        with self._file(self.manifest.shards[number]) as file:
            if "light" not in file:  # of version 1
                why = self.manifest.traced_anew or "the mask's shadow is drawn on a raster"
                raise MitsimError(
                    f"{self.folder}: keeps frames in place of light ({why}), which is not read; make new pairs"
                )
            return PrintLight.read(file["light"]), float(file.attrs["speckle"])

    def facts(self, shard: Shard) -> tuple[FloatArray, int, list[str]]:
        """Return the exposures (pairs,) [s], the number of saturated pairs, and warnings of a shard."""
        with self._file(shard) as file:
            return file["exposure_s"][:], int(file["saturated"][:].sum()), json.loads(file.attrs["warnings"])

    def _rows(self, index: int, *names: str) -> dict[str, Any]:
        shard = self.manifest.shards[self._shard(index)]
        with self._file(shard) as file:
            return {name: file[name][index - shard.first] for name in names}

    def _shard(self, index: int) -> int:
        if not 0 <= index < len(self):
            raise ArgumentError("index", f"{index}: the store holds pairs 0 to {len(self) - 1}")
        firsts = [shard.first for shard in self.manifest.shards]
        return bisect_right(firsts, index) - 1

    @contextmanager
    def _file(self, shard: Shard) -> Iterator[h5py.File]:
        path = self.folder / shard.file
        with hdf5_errors(path), _open_shard(path, self._known) as file:
            yield file


def check_sizes(store: PairStore, factors: Factors) -> tuple[int, int]:
    """Return the shape of images; MitsimError if a calibration has frames or images of other sizes than the pairs."""
    frame, shape = (len(factors.left), len(factors.right)), (factors.left.shape[1], factors.right.shape[1])
    found = tuple(store.manifest.m), tuple(len(side) for side in store.patterns)
    if (frame, shape) != found:
        raise MitsimError(
            f"calibration {factors.name}: has frames of {frame} and images of {shape} pixels, but {store.folder} "
            f"{found[0]} and {found[1]}; calibrate this camera"
        )
    return shape


def part_photographs(photographs: Labels, seed: int, most: int | None = _MOST) -> tuple[Labels, Labels, Labels]:
    """Return the numbers of the pairs that teach, that choose the best step, and that judge, ``most`` of each of these.

    All pairs of a photograph belong to one part, because a network that has learned one crop knows much of the next.
    """
    names = stream(seed, "judging").permutation(np.unique(photographs))
    count = min(max(len(names) // _PART, 1), _MOST)
    parts = names[2 * count :], names[:count], names[count : 2 * count]
    teaching, choosing, judging = (np.flatnonzero(np.isin(photographs, part)) for part in parts)
    return teaching, choosing[:most], judging[:most]


def read_pairs_manifest(folder: Path) -> PairsManifest:
    """Read the manifest of a store, finished or not; raise MitsimError if it breaks a rule."""
    data = read_json(folder / PAIRS)
    if not isinstance(data, dict) or data.get("kind") != "pairs":
        raise MitsimError(f"{folder / PAIRS}: is no manifest of pairs; give a folder of `mitsim pairs`")
    return validate(PairsManifest, data, str(folder / PAIRS))

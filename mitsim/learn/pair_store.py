"""A store of pairs: pictures and the light that turns them into frames in, a folder out; and from that folder pairs of
frames and truths.

The folder holds `pairs.json` and shards `pairs_00000.h5` and so on. A shard keeps its pairs' pictures and truths, and
the light of a white print, which times a picture is the light of that picture: so a thousand pairs of 49 frames take
some 100 MB in place of 25 GB. Where light is no such product, or the mask's shadow no sum of few terms, a shard keeps
each pair's expected frames. Noise is drawn when a pair is read, by the sensor's own chain, always the same for the same
seed.
"""

from __future__ import annotations

import json
import re
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy import sparse

from mitsim.core.arrays import PACKED, FloatArray, Labels, checked_hdf5, hdf5_errors, whole_hdf5
from mitsim.core.configuration import validate
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments
from mitsim.core.files import PAIRS, read_json, write_json
from mitsim.core.manifests import Digital
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer, stream
from mitsim.devices.patterns import Lighting, PatternFamily, parse_patterns
from mitsim.devices.sensor import SensorModel, digital_of
from mitsim.learn.pictures import WHITE
from mitsim.optics.forming import AccumulatedLight
from mitsim.optics.frames import ExpectedFrames
from mitsim.optics.image_formation import FrameOptics
from mitsim.optics.speckle import add_speckle
from mitsim.sensor.chain import expose

if TYPE_CHECKING:
    import h5py

FORMAT = 1
"""Version of the store's layout."""
_LIGHTS_KEPT = 32
"""Lights of shards that are held in memory, some 10 MB each: as many as a network's batch meets."""
Frames = npt.NDArray[np.float32]
"""(K, m, m') electrons a second."""


# -------- What a store says of itself


class Shard(BaseModel):
    """A file of pairs that share a bench."""

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
    """What the pairs are of, and how they are read."""

    model_config = ConfigDict(frozen=True)

    format: int = Field(default=FORMAT, ge=1, le=FORMAT)
    """Version of the layout."""
    kind: Literal["pairs"] = "pairs"
    """What the folder is."""
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
    """Name of the family."""
    exposure_s: float = Field(gt=0)
    """Seconds of a shot; where each pair is exposed for itself, the median."""
    camera: dict[str, Any]
    """Identity that a calibration shares."""
    sensor: str
    """The sensor's model as JSON, by which noise is drawn."""
    digital: Digital
    """How numbers become electrons a second, and what noise they have, at that exposure."""
    scene: str
    """Where the scene lies."""
    idealised: bool
    """Whether frames are of the separable model, and not rendered."""
    traced_anew: str
    """Why light was traced for each picture; empty: light of a white print, times the picture."""
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
    """What was drawn for each bench, where benches vary."""
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

    @property
    def mask(self) -> Any:
        """The mask, by name."""
        geometry = self.camera.get("geometry", {})
        return geometry.get("mask_plate", geometry.get("mask"))

    @cached_property
    def family(self) -> PatternFamily:
        """The patterns."""
        return parse_patterns(self.patterns, self.n, self.seed)

    @cached_property
    def sensor_model(self) -> SensorModel:
        """The sensor that draws noise."""
        return SensorModel.model_validate_json(self.sensor)


# -------- Light of a white print


@dataclass(frozen=True, eq=False)
class PrintPart:
    """Light of a white print in one kind of cells, and the optics that forms its frames.

    Attributes
    ----------
    optics
        with one layer.
    light
        (classes, places) [electrons/s].
    rows, columns
        (r,) and (c,) row and column of the picture's pixel that each row and column of cells lies in.
    lamps
        whether it is light of lamps: then of one class, in every shot.
    """

    optics: FrameOptics
    light: sparse.csr_array
    rows: npt.NDArray[np.int64]
    columns: npt.NDArray[np.int64]
    lamps: bool

    def times(self, reflectance: FloatArray) -> AccumulatedLight:
        """The light of a picture of ``reflectance`` (n, n)."""
        of_entries = reflectance.ravel()[self._pixel(reflectance.shape[1])]
        light = (self.light.data * of_entries, self.light.indices, self.light.indptr)
        return AccumulatedLight(self.optics, (sparse.csr_array(light, shape=self.light.shape),))

    def _pixel(self, side: int) -> npt.NDArray[np.int64]:
        """(entries,) pixel of a picture, ``side`` wide, that each entry of the light lies in."""
        if side not in self._known:
            line, place = np.divmod(self.light.indices.astype(np.int64), self.optics.shape[1])
            (height, width) = self.optics.cells
            self._known[side] = self.rows[line % height] * side + self.columns[place % width]
        return self._known[side]

    @cached_property
    def _known(self) -> dict[int, npt.NDArray[np.int64]]:
        return {}


@dataclass(frozen=True, eq=False)
class PrintLight:
    """Light of a white print: ``parts`` of it, and the ``emission`` (shots, classes) of a family."""

    parts: tuple[PrintPart, ...]
    emission: FloatArray

    @property
    def few(self) -> bool:
        """Whether the mask's shadow is a sum of few terms, which a file can hold."""
        return all(part.optics.terms is not None for part in self.parts)

    def frames_of(self, reflectance: FloatArray) -> ExpectedFrames:
        """Expected frames [electrons/s] of a picture of ``reflectance`` (n, n)."""
        lights = [part.times(reflectance) for part in self.parts if not part.lamps]
        lamps = [part.times(reflectance) for part in self.parts if part.lamps]
        lighting = Lighting(np.arange(self.emission.shape[1]), self.emission)
        return ExpectedFrames(lights, lighting, seed=0, ambient=lamps)

    def write(self, group: h5py.Group) -> None:
        """Keep it in a ``group`` of a file."""
        group.create_dataset("emission", data=self.emission, **PACKED)
        for number, part in enumerate(self.parts):
            place = group.create_group(f"part_{number}", track_order=True)
            assert part.optics.terms is not None, "light that is kept has few"
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
        """What :meth:`write` kept in a ``group``."""
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


@dataclass(frozen=True, eq=False)
class Pair:
    """A pair before it is kept.

    Attributes
    ----------
    picture
        (n, n) codes of eight bits.
    truth
        (n, n) apparent reflectance.
    exposure_s
        of each shot [s].
    saturated
        whether a pixel is expected to reach the full well.
    warnings
        of its light.
    frames
        (shots, m, m') expected [electrons/s], and (m, m') of them what lamps bring; None: the shard's light has them.
    """

    picture: npt.NDArray[np.uint8]
    truth: FloatArray
    exposure_s: float
    saturated: bool = False
    warnings: tuple[str, ...] = ()
    frames: tuple[Frames, npt.NDArray[np.float32]] | None = None


def write_shard(path: Path, digest: str, pairs: Iterable[Pair], speckle: float, light: PrintLight | None) -> None:
    """Write the file of a shard, whole or not at all; MitsimError where it cannot be written.

    Parameters
    ----------
    path, digest
        of the file; and of the store's configuration, by which it is known again.
    pairs
        in order, held one at a time.
    speckle
        contrast of speckle in a frame.
    light
        whose pairs they are; None: each has its frames.
    """
    with whole_hdf5(path) as file:
        file.attrs.update({"configuration_sha256": digest, "speckle": speckle})
        if light is not None:
            light.write(file.create_group("light", track_order=True))
        warnings = dict[str, None]()
        for number, pair in enumerate(pairs):
            warnings |= dict.fromkeys(pair.warnings)
            rows: dict[str, Any] = {"picture": pair.picture, "truth": pair.truth.astype(np.float32)}
            rows |= {"exposure_s": pair.exposure_s, "saturated": np.uint8(pair.saturated)}
            if pair.frames is not None:
                rows["expected"], rows["lamps"] = pair.frames
            for name, values in rows.items():
                row = np.asarray(values)
                if name not in file:
                    packed = PACKED if row.ndim == 2 else {}
                    chunks = (1, *row.shape) if row.ndim else None
                    file.create_dataset(
                        name, (0, *row.shape), row.dtype, maxshape=(None, *row.shape), chunks=chunks or True, **packed
                    )
                file[name].resize(number + 1, axis=0)
                file[name][number] = row
        file.attrs["warnings"] = json.dumps([*warnings])


def is_shard(path: Path, digest: str, count: int) -> bool:
    """Whether a file is a whole shard of a store.

    Parameters
    ----------
    path
        of the file.
    digest, count
        of the store's configuration, and the shard's pairs.
    """
    try:
        with hdf5_errors(path), _open_shard(path) as file:
            return bool(file.attrs["configuration_sha256"] == digest and len(file["truth"]) == count)
    except MitsimError:
        return False


# -------- Reading


def _open_shard(path: Path, known: set[object] | None = None) -> AbstractContextManager[h5py.File]:
    """Open the shard ``path``: its light is read as a whole, and of the pairs' pictures and frames one row."""
    rows = {"/picture", "/truth", "/expected", "/lamps"}
    return checked_hdf5(path, lambda each: 1 / max(each.shape[0], 1) if each.name in rows else 1.0, known)


@dataclass(frozen=True, eq=False)
class ShardFacts:
    """Of all pairs of a shard: ``exposure_s`` (pairs,), how many are ``saturated``, and ``warnings`` of their light."""

    exposure_s: FloatArray
    saturated: int
    warnings: tuple[str, ...]


class PairStore:
    """Pairs in a folder, read one at a time.

    Attributes
    ----------
    folder, manifest
        where it lies, and what it says of itself.
    """

    def __init__(self, folder: Path, manifest: PairsManifest) -> None:
        """A store whose ``manifest`` was read from a ``folder``."""
        self.folder, self.manifest = folder, manifest
        self._lights: OrderedDict[int, tuple[PrintLight | None, float]] = OrderedDict()
        self._known = set[object]()

    @classmethod
    @check_arguments
    def open(cls, path: Path | str) -> PairStore:
        """The finished store in the folder ``path``. MitsimError where there is none, or it lacks a file."""
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
        """(N,) number of the photograph that each pair shows: all crops of a photograph have one number."""
        numbers = np.arange(len(self))
        files = re.match(r"([0-9]+) files of", self.manifest.pictures)  # stores that were made before files had numbers
        labels = self.manifest.photographs or (range(int(files[1])) if files else numbers)
        return np.asarray(labels)[numbers % len(labels)]

    def __repr__(self) -> str:
        made = self.manifest
        size = "x".join(map(str, made.m))
        return f"PairStore({len(self)} pairs, {made.frames} frames of {size} under {made.patterns}: {self.folder})"

    def summary(self) -> dict[str, Any]:
        """What the command line reports, but for seconds."""
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
        """P_L (n, K) and P_R (n, K'), as of a run."""
        family = self.manifest.family
        return family.left.astype(np.float64), family.right.astype(np.float64)

    @cached_property
    def indices(self) -> npt.NDArray[np.int64]:
        """(frames, 2) pattern (i, j) of each frame of a pair."""
        return np.array([(shot.row, shot.column) for shot in self.manifest.family.shots if shot.sign != -1])

    @check_arguments
    def truth(self, index: int) -> npt.NDArray[np.float32]:
        """(n, n) apparent reflectance of pair ``index``: 1 is the calibration's board."""
        return np.asarray(self._rows(index, "truth")["truth"])

    @check_arguments
    def picture(self, index: int) -> npt.NDArray[np.uint8]:
        """(n, n) picture of pair ``index``: its reflectance in steps of 1/255."""
        return np.asarray(self._rows(index, "picture")["picture"])

    @check_arguments
    def exposure_s(self, index: int) -> float:
        """Seconds of a shot of pair ``index``."""
        return float(self._rows(index, "exposure_s")["exposure_s"])

    @check_arguments
    def expected_frames(self, index: int) -> Frames:
        """(K, m, m') frames of pair ``index`` without noise, and without light of lamps where that is taken off
        [electrons/s]."""
        rates, lamps, _, _ = self._light_of(index)
        off = lamps if self.manifest.ambient_shots else 0.0
        return self._measurements(rates, off)

    def frames(self, index: int) -> Frames:
        """(K, m, m') noisy frames of pair ``index`` [electrons/s], as a run's measurements are: always the same."""
        return self.draw(index, self.manifest.seed)

    @check_arguments
    @single_threaded_blas()
    def draw(self, index: int, seed: int) -> Frames:
        """The same with other noise.

        Parameters
        ----------
        index
            of the pair.
        seed
            of the noise: root of the random streams of every pair.
        """
        made, sensor = self.manifest, self.manifest.sensor_model
        rates, lamps, exposure_s, speckle = self._light_of(index)
        root, digital = integer(seed, "pair", index), digital_of(sensor, exposure_s)

        def shoot(rate: FloatArray, *names: str | int) -> FloatArray:
            shot, read = (stream(root, noise, *names) for noise in ("shot", "read"))
            return digital.rate(expose(rate * exposure_s, exposure_s, sensor, shot, read))

        off: FloatArray | float = 0.0
        if made.ambient_shots:
            off = sum(shoot(lamps, "ambient", shot) for shot in range(made.ambient_shots)) / made.ambient_shots
        shots = zip(rates, made.family.shots, strict=True)
        return self._measurements(
            (
                shoot(add_speckle(rate, speckle, stream(root, "speckle", *shot.names)), *shot.names)
                for rate, shot in shots
            ),
            off,
        )

    def _measurements(self, rates: Iterable[FloatArray], off: FloatArray | float) -> Frames:
        """Measurements of shots: differences of the halves of signed patterns, others less what is taken ``off``."""
        found, shots = [], self.manifest.family.shots
        positive: FloatArray | float = 0.0
        for rate, shot in zip(rates, shots, strict=True):
            if shot.sign == 1:
                positive = rate
            else:
                found.append(np.asarray(positive - rate if shot.sign else rate - off, dtype=np.float32))
        return np.stack(found)

    def _light_of(self, index: int) -> tuple[Iterator[FloatArray], FloatArray, float, float]:
        """Expected light of each shot of a pair and that of lamps [electrons/s]; its exposure [s], and the contrast of
        speckle."""
        shard = self._shard(index)
        light, speckle = self._light(shard)
        if light is None:
            rows = self._rows(index, "expected", "lamps", "exposure_s")
            rates: Iterator[FloatArray] = (np.asarray(frame, dtype=np.float64) for frame in rows["expected"])
            return rates, np.asarray(rows["lamps"], dtype=np.float64), float(rows["exposure_s"]), speckle
        rows = self._rows(index, "picture", "exposure_s")
        expected = light.frames_of(rows["picture"] / WHITE)
        rates = (frame.irradiance for frame in expected)
        return rates, expected.projector_off.irradiance, float(rows["exposure_s"]), speckle

    def _light(self, shard: int) -> tuple[PrintLight | None, float]:
        """Light of a white print of a shard, where it has it, and the contrast of its frames' speckle."""
        if shard not in self._lights:
            with self._file(self.manifest.shards[shard]) as file:
                light = PrintLight.read(file["light"]) if "light" in file else None
                self._lights[shard] = light, float(file.attrs["speckle"])
            if len(self._lights) > _LIGHTS_KEPT:
                self._lights.popitem(last=False)
        self._lights.move_to_end(shard)
        return self._lights[shard]

    def facts(self, shard: Shard) -> ShardFacts:
        """What the file of a ``shard`` says of all its pairs."""
        with self._file(shard) as file:
            saturated = int(file["saturated"][:].sum())
            return ShardFacts(file["exposure_s"][:], saturated, tuple(json.loads(file.attrs["warnings"])))

    def _rows(self, index: int, *names: str) -> dict[str, Any]:
        """What a pair has of the data sets ``names``."""
        shard = self.manifest.shards[self._shard(index)]
        with self._file(shard) as file:
            return {name: file[name][index - shard.first] for name in names}

    def _shard(self, index: int) -> int:
        """Number of the shard that holds pair ``index``; ArgumentError for one that there is not."""
        if not 0 <= index < len(self):
            raise ArgumentError("index", f"{index}: the store holds pairs 0 to {len(self) - 1}")
        firsts = [shard.first for shard in self.manifest.shards]
        return bisect_right(firsts, index) - 1

    @contextmanager
    def _file(self, shard: Shard) -> Iterator[h5py.File]:
        path = self.folder / shard.file
        with hdf5_errors(path), _open_shard(path, self._known) as file:
            yield file


def read_pairs_manifest(folder: Path) -> PairsManifest:
    """The manifest of a store in a ``folder``, finished or not; MitsimError where it breaks a rule."""
    data = read_json(folder / PAIRS)
    if not isinstance(data, dict) or data.get("kind") != "pairs":
        raise MitsimError(f"{folder / PAIRS}: is no manifest of pairs; give a folder of `mitsim pairs`")
    return validate(PairsManifest, data, str(folder / PAIRS))


def check_same(folder: Path, configuration: dict[str, Any]) -> None:
    """MitsimError where the store in a ``folder`` is of another ``configuration``."""
    before = read_pairs_manifest(folder).configuration
    changed = [key for key, value in configuration.items() if before.get(key) != value]
    if changed:
        raise MitsimError(
            f"resume=True: {folder} holds pairs of another configuration ({', '.join(changed)} differ); use the same "
            "options, or another folder"
        )


def write_pairs_manifest(folder: Path, manifest: PairsManifest) -> None:
    """Write the ``manifest`` of a store into its ``folder``, all or nothing; MitsimError where it cannot be written."""
    write_json(folder / PAIRS, manifest)

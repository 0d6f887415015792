"""Files of a calibration session: finished parts in its CAL folder, and its frames if the user wants them.

Frames contain only what a real user has: digital numbers, patterns and camera settings; no expected light, exact
factors, parallax, seeds or plan. A part is a ``.npz`` file with a SHA-256 of the session's configuration and of the
data; a damaged or foreign part is computed again.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy import sparse

from mitsim.calibrate.board_session import Session
from mitsim.core.errors import MitsimError
from mitsim.core.files import PARTS, output_folder, plain, read_json, remove_page, whole_file, write_json
from mitsim.core.manifests import MANIFEST, Digital, resumable
from mitsim.devices.framelist import LISTS, DarkFile, FrameList, StripeFile
from mitsim.devices.session import SIDES, Side
from mitsim.light.light import SampledLight
from mitsim.light.passes import GRIDS, LightEstimate
from mitsim.light.plan import Plan
from mitsim.light.simulation import Simulation
from mitsim.reconstruct.factors import StripeSums
from mitsim.sensor.chain import Digital as DigitalNumbers

KIND = "calibration"
_SUFFIX = PARTS.removeprefix("*")
_DIGEST = hashlib.sha256().digest_size


class Checkpoint:
    """Parts of one session; nothing is kept without a folder."""

    def __init__(self, folder: Path | None = None, configuration: Mapping[str, Any] | None = None) -> None:
        self.folder, self.configuration = folder, dict(configuration or {})
        self._session = json.dumps(plain(self.configuration), sort_keys=True).encode()

    def begin(self) -> None:
        """Mark the folder as an unfinished session."""
        if self.folder is not None:
            remove_page(self.folder)
            head = {"kind": KIND, "status": "incomplete", "configuration": plain(self.configuration)}
            write_json(self.folder / MANIFEST, head)

    def save(self, name: str, arrays: Mapping[str, npt.ArrayLike]) -> None:
        """Write ``arrays`` as the part ``name`` atomically; raise MitsimError if that fails."""
        if self.folder is None:
            return
        memory = io.BytesIO()
        np.savez(memory, allow_pickle=False, **{key: np.asarray(value) for key, value in arrays.items()})
        with whole_file(self.folder / f"{name}{_SUFFIX}") as part, part.open("wb") as file:
            file.write(memory.getbuffer())
            file.write(self._digest(memory.getbuffer()))

    def load(self, name: str) -> dict[str, npt.NDArray[Any]] | None:
        """Return the arrays of the part ``name``; None if it is missing, damaged, or of another session."""
        path = None if self.folder is None else self.folder / f"{name}{_SUFFIX}"
        if path is None or not path.is_file():
            return None
        data = memoryview(path.read_bytes())
        if self._digest(data[:-_DIGEST]) != data[-_DIGEST:]:
            return None
        with np.load(io.BytesIO(data[:-_DIGEST]), allow_pickle=False) as arrays:
            return dict(arrays)

    def clear(self) -> None:
        """Remove the parts of a complete session."""
        if self.folder is not None:
            for path in self.folder.glob(PARTS):
                path.unlink()

    def _digest(self, data: memoryview) -> bytes:
        return hashlib.sha256(hashlib.sha256(self._session).digest() + data).digest()


@contextmanager
def claimed_session(
    output: Path | None, configuration: Mapping[str, Any], resume: bool = False
) -> Iterator[Checkpoint]:
    """Claim the place for a session's parts before any work; remove a new folder if the session fails before writing.

    Parameters
    ----------
    output
        CAL folder; None keeps nothing.
    configuration
        All values that determine the factors.
    resume
        Allow a folder with a session of the same configuration.

    Raises
    ------
    MitsimError
        If the place cannot be written, or holds other files or another configuration.
    """
    if output is None:
        yield Checkpoint(None, configuration)
        return
    again = resume and (output / MANIFEST).is_file()
    if again:
        _check_same(output, plain(configuration))
    with output_folder(output, overwrite=again) as folder:
        yield Checkpoint(folder, configuration)


def is_finished(output: Path, configuration: Mapping[str, Any]) -> bool:
    """Return True if the folder holds a finished session; raise MitsimError for another ``configuration``."""
    if not (output / MANIFEST).is_file():
        return False
    _check_same(output, plain(configuration))
    return bool(read_json(output / MANIFEST).get("status") == "complete")


def _check_same(path: Path, configuration: Mapping[str, Any]) -> None:
    before = resumable(path, KIND).get("configuration")
    before = before if isinstance(before, dict) else {}
    changed = [key for key in {**configuration, **before} if before.get(key) != configuration.get(key)]
    if changed:
        raise MitsimError(
            f"resume=True: {path} holds a session of another configuration ({', '.join(changed)} differ); "
            "use the same options, or another folder"
        )


# ---- Light and sums of responses as parts of a checkpoint ----


def kept_light(checkpoint: Checkpoint, session: Session, plan: Plan) -> SampledLight | None:
    """Return the stored light of a session's board, or None."""
    arrays = checkpoint.load("light")
    if arrays is None:
        return None
    by_grid = {
        name: sparse.csr_array(
            tuple(arrays[f"{row.key}_{part}"] for part in ("data", "indices", "indptr")),
            shape=tuple(arrays[f"{row.key}_shape"]),
        )
        for name, row in GRIDS.items()
    }
    return SampledLight(
        groups=(LightEstimate(by_grid, float(arrays["received"]), float(arrays["outside"])),),
        simulation=Simulation(session.board, plan.settings),
        plan=plan,
        seed=session.seed,
        labels=arrays["labels"],
        flux=arrays["flux"],
        flux_error=arrays["flux_error"],
        paths=int(arrays["paths"]),
        sampling_error=float(arrays["sampling_error"]),
        reached=bool(arrays["reached"]),
    )


def keep_light(checkpoint: Checkpoint, light: SampledLight) -> None:
    """Save a ``light`` of one group in a ``checkpoint``."""
    (group,) = light.groups
    own = ("labels", "flux", "flux_error", "paths", "sampling_error", "reached")
    facts = {name: getattr(light, name) for name in own}
    facts |= {name: getattr(group, name) for name in ("received", "outside")}
    for name, row in GRIDS.items():
        matrix = group[name]
        facts |= {f"{row.key}_{part}": getattr(matrix, part) for part in ("data", "indices", "indptr", "shape")}
    checkpoint.save("light", facts)


@dataclass
class SessionSums:
    """Sums over finished stripes by kind and side, and the number of ``saturated`` shots."""

    sums: dict[str, tuple[StripeSums, StripeSums]]
    saturated: int

    def save(self, checkpoint: Checkpoint) -> None:
        """Save the sums in a ``checkpoint``."""
        arrays: dict[str, npt.ArrayLike] = {"saturated": self.saturated}
        for kind, both in self.sums.items():
            for sums in both:
                arrays |= {f"{kind}_{sums.side}_{name}": value for name, value in vars(sums).items() if name != "side"}
        checkpoint.save("stripes", arrays)

    @classmethod
    def from_checkpoint(cls, checkpoint: Checkpoint, kinds: Sequence[str]) -> SessionSums | None:
        """Return the sums of an interrupted session for some ``kinds`` of responses, or None."""
        arrays = checkpoint.load("stripes")
        if arrays is None:
            return None
        horizontal, vertical = SIDES
        by_kind = {kind: (_kept_sums(arrays, kind, horizontal), _kept_sums(arrays, kind, vertical)) for kind in kinds}
        return cls(by_kind, int(arrays["saturated"]))


def _kept_sums(arrays: Mapping[str, Any], kind: str, side: Side) -> StripeSums:
    own = {name.removeprefix(f"{kind}_{side}_"): values for name, values in arrays.items()}
    single = float(own["misfit"]), float(own["energy"]), int(own["done"])
    sums = StripeSums(side, bool(own["centre"]), own["common"], own["vectors"], *single)
    sums.misfits, sums.energies, sums.ambient = own["misfits"], own["energies"], own["ambient"]
    sums.lights = own["lights"]
    return sums


# ---- Frames as a real camera's user has them ----

MOST_TIFF = 2**16 - 1
"""Largest digital number of a 16-bit TIFF; frames with larger or real numbers become NPY."""


Names = tuple[str | int, ...]
"""Side and number of a frame's shot, or ``dark`` with numbers of exposure and frame."""


def repeat_names(shot: tuple[str, int], exposure: int, repeat: int) -> Names:
    """Return the names of a frame of a shot."""
    own: Names = ("exposure", exposure) if exposure else ()
    return (*shot, *own, "repeat", repeat) if repeat else (*shot, *own)


@dataclass(frozen=True, eq=False)
class KeptFrames:
    """Frames of a ``session`` in a ``folder``, named by the order in which they are taken."""

    session: Session
    folder: Path

    def write(self, names: Names, numbers: DigitalNumbers) -> None:
        """Write one frame of digital ``numbers`` (rows, columns)."""
        place = (self._dark if names[0] == "dark" else self._lit)[names].file
        with whole_file(self.folder / place) as part, part.open("wb") as file:
            if self._tiff:
                Image.fromarray(numbers.astype(np.uint16)).save(file, "TIFF")
            else:
                np.save(file, numbers)

    def finish(self, digital: Digital) -> None:
        """Write the list when all frames are complete."""
        session, recipe = self.session, self.session.recipe
        listed = FrameList(
            camera=session.bench.identity(),
            n=session.bench.n,
            signed_capture=recipe.signed_capture,
            repeats=recipe.repeats,
            exposure_ladder=recipe.exposure_ladder,
            ladder_merge=recipe.ladder_merge,
            digital=digital,
            centre=session.centre,
            board_reflectance=recipe.board_reflectance,
            frames=tuple(self._lit.values()),
            dark=tuple(self._dark.values()),
        )
        write_json(self.folder / LISTS[1], listed.model_dump(mode="json", exclude_defaults=True))

    @cached_property
    def _tiff(self) -> bool:
        largest = self.session.bench.sensor.largest_dn
        return largest is not None and largest <= MOST_TIFF

    def _name(self, kind: str, number: int) -> str:
        return f"{kind}_{number:05d}{'.tif' if self._tiff else '.npy'}"

    @cached_property
    def _lit(self) -> dict[Names, StripeFile]:
        found: dict[Names, StripeFile] = {}
        exposures, repeats = range(len(self.session.recipe.exposure_ladder)), range(self.session.recipe.repeats)
        for half, exposure, repeat in itertools.product(self.session.order, exposures, repeats):
            names, (side, index, sign) = repeat_names(self.session.shot(half), exposure, repeat), half
            file = self._name("frame", len(found))
            found[names] = StripeFile(file=file, side=side, index=index, sign=sign, exposure=exposure, repeat=repeat)
        return found

    @cached_property
    def _dark(self) -> dict[Names, DarkFile]:
        found: dict[Names, DarkFile] = {}
        recipe = self.session.recipe
        for exposure, number in itertools.product(range(len(recipe.exposure_ladder)), range(recipe.dark_frames)):
            found["dark", exposure, number] = DarkFile(file=self._name("dark", len(found)), exposure=exposure)
        return found

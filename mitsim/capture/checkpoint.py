"""What is finished of a calibration session, in its CAL folder until the whole is: named arrays in, whole files out,
and back.

A part is a ``.npz`` file with a SHA-256 of the session's configuration and the file behind it: one that is damaged or
of another session is computed again.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.errors import MitsimError
from mitsim.core.jsonfile import plain, read_json, write_json
from mitsim.core.manifests import MANIFEST, resumable
from mitsim.core.output import PARTS, output_folder, sweep, whole_file

KIND = "calibration"
_SUFFIX = PARTS.removeprefix("*")
_DIGEST = hashlib.sha256().digest_size


class Checkpoint:
    """Parts of one session; without a folder nothing is kept."""

    def __init__(self, folder: Path | None = None, configuration: Mapping[str, Any] | None = None) -> None:
        """Parts in ``folder``, of the session with this ``configuration``."""
        self.folder, self._configuration = folder, plain(configuration or {})
        self._session = json.dumps(self._configuration, sort_keys=True).encode()

    def begin(self) -> None:
        """Mark the folder as an unfinished session, and clear what a killed process left half-written."""
        if self.folder is not None:
            sweep(self.folder)
            head = {"kind": KIND, "status": "incomplete", "configuration": self._configuration}
            write_json(self.folder / MANIFEST, head)

    def save(self, name: str, arrays: Mapping[str, npt.ArrayLike]) -> None:
        """Write ``arrays`` as the part ``name``, whole or not at all. MitsimError when it cannot be written."""
        if self.folder is None:
            return
        memory = io.BytesIO()
        np.savez(memory, allow_pickle=False, **{key: np.asarray(value) for key, value in arrays.items()})
        with whole_file(self.folder / f"{name}{_SUFFIX}") as part, part.open("wb") as file:
            file.write(memory.getbuffer())
            file.write(self._digest(memory.getbuffer()))

    def load(self, name: str) -> dict[str, npt.NDArray[Any]] | None:
        """The arrays of the part ``name``; None when it is not there, damaged, or of another session."""
        path = None if self.folder is None else self.folder / f"{name}{_SUFFIX}"
        if path is None or not path.is_file():
            return None
        data = memoryview(path.read_bytes())
        if self._digest(data[:-_DIGEST]) != data[-_DIGEST:]:
            return None
        with np.load(io.BytesIO(data[:-_DIGEST]), allow_pickle=False) as arrays:
            return dict(arrays)

    def clear(self) -> None:
        """Remove the parts of a session that is complete."""
        if self.folder is not None:
            for path in self.folder.glob(PARTS):
                path.unlink()

    def _digest(self, data: memoryview) -> bytes:
        return hashlib.sha256(hashlib.sha256(self._session).digest() + data).digest()


@contextmanager
def claimed_session(
    output: Path | str | None, configuration: Mapping[str, Any], resume: bool = False
) -> Iterator[Checkpoint]:
    """The place for a session's parts, checked before any work; if the session fails before writing, a new folder is
    removed.

    Parameters
    ----------
    output
        CAL folder; None keeps nothing.
    configuration
        all that decides the factors.
    resume
        whether the folder may hold a session of the same configuration.

    Raises
    ------
    MitsimError
        for a place that cannot be written, or that holds something else or another configuration.
    """
    if output is None:
        yield Checkpoint()
        return
    path = Path(output)
    again = resume and (path / MANIFEST).is_file()
    if again:
        _check_same(path, plain(configuration))
    with output_folder(path, overwrite=again) as folder:
        yield Checkpoint(folder, configuration)


def is_finished(output: Path | str, configuration: Mapping[str, Any]) -> bool:
    """Whether the folder ``output`` holds a finished session; MitsimError when its ``configuration`` is another."""
    path = Path(output)
    if not (path / MANIFEST).is_file():
        return False
    _check_same(path, plain(configuration))
    return bool(read_json(path / MANIFEST).get("status") == "complete")


def _check_same(path: Path, configuration: Mapping[str, Any]) -> None:
    before = resumable(path, KIND).get("configuration")
    before = before if isinstance(before, dict) else {}
    changed = [key for key in {**configuration, **before} if before.get(key) != configuration.get(key)]
    if changed:
        raise MitsimError(
            f"resume=True: {path} holds a session of another configuration ({', '.join(changed)} differ); "
            "use the same options, or another folder"
        )

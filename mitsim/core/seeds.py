"""Independent random streams by root seed and name.

A stream depends only on the root and its own name, so frame 17's shot noise does not depend on frames 0 to 16.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from mitsim.core.errors import MitsimError

if TYPE_CHECKING:  # and where streams are made: checking a seed does not need it
    import numpy as np

_LARGEST_ROOT = 2**64
"""Seeds are unsigned 64-bit integers in a frame's metadata and in other programs."""


def check_root(root: int) -> int:
    if not 0 <= root < _LARGEST_ROOT:
        raise MitsimError(f"seed: got {root}; allowed are whole numbers from 0 to 2^64 - 1")
    return root


def stream(root: int, *names: str | int) -> np.random.Generator:
    """Return the generator of a name, for example ``stream(seed, "shot", frame)``; MitsimError for an invalid root."""
    import numpy as np

    return np.random.Generator(np.random.PCG64(_sequence(root, "stream", names)))


def integer(root: int, *names: str | int) -> int:
    """Return a seed in [0, 2^32) for libraries that need an integer, unrelated to the :func:`stream` of that name."""
    import numpy as np

    return int(_sequence(root, "integer", names).generate_state(1, np.uint32)[0])


def _sequence(root: int, purpose: str, names: tuple[str | int, ...]) -> np.random.SeedSequence:
    import numpy as np

    check_root(root)
    digest = hashlib.sha256()
    # Type and length go in as well, so that ("a", "b"), ("ab",), (1,) and ("1",) are four different names.
    for name in (purpose, *names):
        text = str(name).encode()
        kind = b"s" if isinstance(name, str) else b"i"
        digest.update(kind + len(text).to_bytes(8, "little") + text)
    words = np.frombuffer(digest.digest(), dtype="<u4")
    return np.random.SeedSequence(entropy=int(root), spawn_key=tuple(int(word) for word in words))

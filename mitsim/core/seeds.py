"""Independent random streams: one root seed and a name in, a generator out.

A stream depends on the root and its own name only, never on how many others were asked for or in which order,
so frame 17's shot noise is the same whether frames 0 to 16 were drawn or not.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from mitsim.core.errors import MitsimError

if TYPE_CHECKING:  # and where streams are made: checking a seed does not need it
    import numpy as np

_LARGEST_ROOT = 2**64
"""What a frame's metadata and other programs hold as an unsigned integer."""


def check_root(root: int) -> int:
    """Return the seed ``root`` of all streams; MitsimError when it is out of range."""
    if not 0 <= root < _LARGEST_ROOT:
        raise MitsimError(f"seed: got {root}; allowed are whole numbers from 0 to 2^64 - 1")
    return root


def stream(root: int, *names: str | int) -> np.random.Generator:
    """Return a generator of its own for ``names`` under the seed ``root`` (0 <= root < 2^64).

    For example ``stream(seed, "shot", frame)``. MitsimError for a root out of range.
    """
    import numpy as np

    return np.random.Generator(np.random.PCG64(_sequence(root, "stream", names)))


def integer(root: int, *names: str | int) -> int:
    """Return a child seed in [0, 2^32) for ``names`` under the seed ``root``, for libraries that want an integer.

    It is unrelated to the :func:`stream` of that name. MitsimError for a root out of range.
    """
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

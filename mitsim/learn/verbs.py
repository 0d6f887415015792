"""Verbs of pairs, training and trained networks for programs.

torch, an extra, is imported when it is used; a MitsimError states how to install it.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsim.bench.request import Request, Task
from mitsim.core.configuration import takes
from mitsim.core.errors import MitsimError, check_arguments
from mitsim.core.files import PAIRS, check_apart, check_output, check_plain, output_file
from mitsim.core.job import Job
from mitsim.learn.requests import PairOptions, PairsRequest, Schedule, Training

if TYPE_CHECKING:
    from mitsim.api.bench import Bench
    from mitsim.learn.methods import LearnedSolver
    from mitsim.learn.pair_store import PairStore
    from mitsim.learn.training import Trained


def check_torch() -> None:
    if find_spec("torch") is None:
        raise MitsimError("torch is not installed, which networks need; type: pip install 'mitsim[learn]'")


@takes(PairOptions, Request)
def make_pairs(
    bench: Bench,
    output: Path | str,
    count: int,
    patterns: str = "dots:7",
    resume: bool = False,
    job: Job | None = None,
    **options: Any,
) -> PairStore:
    """Make pairs to learn from: pictures on a scene's print, and the frames that the camera takes of them.

    Parameters
    ----------
    output
        Folder of the pairs.
    count
        Number of pairs.
    patterns
        Name of the pattern family.
    resume
        True to continue interrupted work of the same request.
    job
        Limits, and the receiver of progress.

    Raises
    ------
    MitsimError
        For a request that cannot be served, a scene that is no flat diffuse sheet with a print, pictures that cannot be
        read, an output that cannot be written or holds something else, and more memory, disk or time than is allowed.
    """
    output = Path(output)
    own = {name: options.pop(name) for name in ("pictures", "vary") if name in options}
    asked = PairsRequest(capture=Request(patterns=patterns, **options), count=count, **own)
    check_output(output, overwrite=resume and (output / PAIRS).is_file())
    task = Task.of(output, resume, job)
    with task.importing():
        from mitsim.learn import pairs

    return pairs.make_pairs(bench, asked, task)[0]


@check_arguments
def load_network(path: Path | str, device: str = "cpu") -> LearnedSolver:
    """Load a trained network, which :func:`mitsim.reconstruct` takes as ``method``.

    Parameters
    ----------
    path
        File of `mitsim train`.
    device
        Device of torch for the network.

    Raises
    ------
    MitsimError
        If torch is not installed, or the file does not hold a network.
    """
    check_plain(path, "model")
    check_torch()
    from mitsim.learn.methods import read_network

    return read_network(path, device)


@takes(Schedule)
def train(
    method: str,
    pairs: Path | str,
    output: Path | str,
    calibration: Path | str | None = None,
    resume: bool = False,
    job: Job | None = None,
    **options: Any,
) -> Trained:
    """Train a network on pairs, and write its file.

    Parameters
    ----------
    method
        One of :data:`mitsim.learn.requests.METHODS`.
    pairs, output
        Folder of `mitsim pairs`, and the file, which ends in ``.pt``.
    calibration
        CAL folder of the pairs' camera; None takes the folder ``calibration`` in that of the pairs.
    resume
        True to continue an interrupted training of the same options.
    job
        Limits, and the receiver of progress.

    Raises
    ------
    MitsimError
        If torch is not installed, for options that no network is trained by, folders that cannot be read or do not
        fit each other, a file that is there, and more time or memory than is allowed.
    """
    request = Training(method=method, **options)
    place = Path(pairs) / "calibration" if calibration is None else Path(calibration)
    if calibration is None and not place.is_dir():
        raise MitsimError(f"calibration: {pairs} holds none; give the folder of `mitsim calibrate`")
    check_apart(output, [pairs, place])
    check_torch()
    with output_file(output) as file:
        from mitsim.learn.pair_store import PairStore
        from mitsim.reconstruct.factors import load_calibration

        store, factors = PairStore.open(Path(pairs)), load_calibration(place)
        from mitsim.learn.training import train_network  # only now: torch takes seconds to import

        return train_network(store, factors, request, file, job, resume)

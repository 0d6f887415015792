"""Batches of points in, measured in processes of their own: here or on a cluster; findings out as they come.

A process keeps its studio from batch to batch. One that dies loses the point it was at, which another tries again.
"""

from __future__ import annotations

import multiprocessing
import tempfile
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING, Any, cast

from mitsim.core.errors import MitsimError
from mitsim.studies.framework.experiment import Found, Point

if TYPE_CHECKING:
    from mitsim.studies.framework.studio import Studio

Batch = tuple[Point, ...]
_TRIES = 2
"""Times that a point is begun: what ended two processes would end the third."""


@dataclass(frozen=True)
class _Studio:
    """This process's own studio, opened when it is first asked for something: to load the renderer takes seconds."""

    shared: str | None

    def __getattr__(self, name: str) -> Any:
        return getattr(_open(self.shared), name)


@cache
def _open(shared: str | None) -> Any:
    from mitsim.studies.framework.studio import Studio

    return Studio(shared)


def measure_point(name: str, point: Point, shared: str | None = None) -> Found:
    """What an experiment finds at a point, in this process's studio.

    Parameters
    ----------
    name, point
        of the experiment, and where it is measured.
    shared
        folder of calibrations that processes share; None: this process keeps its own.
    """
    from mitsim.studies.framework.experiment import find_experiment

    return find_experiment(name).measure(cast("Studio", _Studio(shared)), point)


def in_processes(
    name: str, batches: Sequence[Batch], jobs: int, shared: str | None = None
) -> Iterator[tuple[Point, Found]]:
    """Findings of all points, in any order.

    MitsimError for what a point refuses, and for one that ended two processes.

    Parameters
    ----------
    name
        of the experiment.
    batches
        points, those of a batch by one process one after the other.
    jobs
        processes at a time.
    shared
        folder of calibrations that they share with others; None: with each other alone.
    """
    waiting, tries = deque(batches), dict[Point, int]()
    # Processes are ended, not asked to end: what they leave in their temporary folder goes with it.
    scratch = tempfile.TemporaryDirectory(prefix="mitsim-study-")
    folders = scratch.name, shared or scratch.name
    crew = [_Worker.started(name, folders) for _ in range(min(jobs, len(batches)))]
    try:
        while True:
            for worker in crew:
                if not worker.left and waiting:
                    worker.give(waiting.popleft())
            busy = [worker for worker in crew if worker.left]
            if not busy:
                return
            ready = wait([worker.pipe for worker in busy])
            for worker in busy:
                if worker.pipe not in ready:
                    continue
                point = worker.left[0]
                answer = worker.answer()
                if answer is None:
                    tries[point] = tries.get(point, 0) + 1
                    if tries[point] == _TRIES:
                        raise MitsimError(
                            f"study {name}: {_TRIES} processes ended at one point ({_point_text(point)}), the last "
                            f"with exit code {worker.process.exitcode}; finished points are kept. Is memory short? Try "
                            "--jobs 1"
                        )
                    waiting.appendleft(tuple(worker.left))
                    crew[crew.index(worker)] = _Worker.started(name, folders)
                else:
                    yield worker.left.popleft(), answer
    finally:
        for worker in crew:
            worker.end()
        scratch.cleanup()


def on_cluster(name: str, batches: Sequence[Batch], address: str) -> Iterator[tuple[Point, Found]]:
    """The same by workers of a Dask cluster, a batch a task.

    MitsimError without the package ``distributed``, without a scheduler there, and as :func:`in_processes`.

    Parameters
    ----------
    name, batches
        as for :func:`in_processes`.
    address
        of the scheduler.
    """
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise MitsimError("--scheduler: needs the package distributed; pip install 'mitsim[dask]'") from None
    try:
        client = Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        raise MitsimError(f"--scheduler {address}: no Dask scheduler answers there ({error})") from error
    with client:
        tasks = {client.submit(_batch, name, batch, pure=False): batch for batch in batches}
        for task in as_completed(tasks):
            found, refusal = task.result()
            yield from zip(tasks[task], found, strict=False)
            if refusal:
                raise MitsimError(refusal)


def _batch(name: str, batch: Batch) -> tuple[list[Found], str]:
    """Findings of a whole batch, and what refused it."""
    found = []
    for point in batch:
        try:
            found.append(measure_point(name, point))
        except MitsimError as error:
            return found, str(error)
    return found, ""


@dataclass(eq=False)
class _Worker:
    """A process, the pipe to it, and the points that it has not answered."""

    process: BaseProcess
    pipe: Connection
    left: deque[Point] = field(default_factory=deque)

    @classmethod
    def started(cls, name: str, folders: tuple[str, str]) -> _Worker:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(name, folders, theirs), daemon=True)
        process.start()
        theirs.close()  # so that its death ends the pipe
        return cls(process, ours)

    def give(self, batch: Batch) -> None:
        self.left = deque(batch)
        with suppress(OSError):  # it died; its answer says so
            self.pipe.send(batch)

    def answer(self) -> Found | None:
        """The next; None of a process that died. MitsimError for what the point refuses."""
        try:
            answer = self.pipe.recv()
        except (EOFError, OSError):
            self.process.join()
            return None
        if isinstance(answer, str):
            raise MitsimError(answer)
        assert isinstance(answer, Found)
        return answer

    def end(self) -> None:
        self.pipe.close()
        self.process.terminate()
        self.process.join()


def _serve(name: str, folders: tuple[str, str], pipe: Connection) -> None:
    """Measure every batch that comes, point by point, until the parent is gone; ``folders`` are for temporary files and
    for calibrations that are shared."""
    tempfile.tempdir, shared = folders
    with suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            for point in pipe.recv():
                try:
                    pipe.send(measure_point(name, point, shared))
                except MitsimError as error:
                    pipe.send(str(error))
                    break


def _point_text(point: Point) -> str:
    values = {**dict(point.setup.parameters), "picture": point.setup.picture, **dict(point.values)}
    return ", ".join(f"{name} = {value}" for name, value in values.items() if value is not None)

"""What this machine has left, and the refusal of work that would take more: estimates in, silence or one line out."""

from __future__ import annotations

import os
import shutil
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from mitsim.core.arguments import checked_fields
from mitsim.core.errors import ArgumentError, MitsimError

_CGROUPS = (
    (Path("/sys/fs/cgroup"), "memory.max", "memory.current", "inactive_file"),
    (Path("/sys/fs/cgroup/memory"), "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
)
"""Where control groups of version 2 and 1 say what a container may take, what it takes, and how much of that is cache
of files, which the kernel gives back when it is needed."""
_USABLE = 0.9
"""Part of the free memory that work may take: the rest is for what estimates and other programs add."""


@checked_fields
@dataclass(frozen=True)
class Limits:
    """What one command may take: wall seconds, and bytes of memory (None: nine tenths of what is free)."""

    seconds: float = 86400.0
    memory_bytes: float | None = None

    def __post_init__(self) -> None:
        if not self.seconds > 0:
            raise ArgumentError("max_seconds", f"{self.seconds:g}: give a number above 0")
        if self.memory_bytes is not None and not self.memory_bytes > 0:
            raise ArgumentError("max_memory", f"{self.memory_bytes / 2**30:g}: give a number of GiB above 0")


@dataclass(frozen=True)
class Cost:
    """What a work is estimated to take: wall seconds, bytes of memory beyond those in use now, bytes of disk."""

    seconds: float = 0.0
    memory_bytes: float = 0.0
    disk_bytes: float = 0.0

    def check(self, what: str, limits: Limits, output: Path | None = None) -> None:
        """Refuse work that takes too much.

        Parameters
        ----------
        what
            the work, for the message.
        limits
            on time and memory.
        output
            where it writes, if it does.

        Raises
        ------
        MitsimError
            when the work takes more than its limits, or than the disk of ``output`` has free.
        """
        if not self.seconds <= limits.seconds:
            raise MitsimError(
                f"{what}: would take about {self.seconds:.3g} s; allowed are {limits.seconds:.3g} s; "
                "ask for less accuracy or fewer frames, or raise max_seconds"
            )
        free = free_memory() * _USABLE
        allowed = free if limits.memory_bytes is None else min(limits.memory_bytes, free)
        if not self.memory_bytes <= allowed:
            raise MitsimError(
                f"{what}: would take about {_size(self.memory_bytes)} of memory; allowed are {_size(allowed)}; "
                "ask for fewer pixels or patterns, or free memory"
            )
        if output is not None and not self.disk_bytes <= (left := free_disk(output)):
            raise MitsimError(
                f"{what}: would write about {_size(self.disk_bytes)}, but {output} has {_size(left)} left; "
                "choose another place or fewer frames"
            )


def workers() -> int:
    """Processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def free_memory() -> float:
    """Bytes that this process can still take: the machine's, its control group's, or its own limit's, the least."""
    import psutil  # here: it takes 10 ms to import, and no refusal needs it

    left = [float(psutil.virtual_memory().available)]
    for folder, limit, used, cached in _CGROUPS:
        try:
            counts = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
            taken = float((folder / used).read_text()) - float(counts.get(cached, 0))
            left.append(float((folder / limit).read_text()) - taken)
        except (OSError, ValueError):  # no such group, or "max"
            continue
    if hasattr(psutil, "RLIMIT_AS"):  # Linux and FreeBSD
        process = psutil.Process()
        soft, _ = process.rlimit(psutil.RLIMIT_AS)
        if soft != psutil.RLIM_INFINITY:
            left.append(float(soft - process.memory_info().vms))
    return max(min(left), 0.0)


def memory_from_here() -> float:
    """Bytes of memory that this process holds; :func:`peak_memory` counts anew from here, where the system lets it."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # proc(5): the peak becomes what is held now
    import psutil

    return float(psutil.Process().memory_info().rss)


def peak_memory() -> float:
    """Most bytes of memory that this process has held since it began, or since :func:`memory_from_here`."""
    try:
        # Not getrusage, where there is this: its peak is inherited from the process that started this one.
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) * 1024.0 for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        import resource  # not on Windows

        peak = float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
        return peak if sys.platform == "darwin" else peak * 1024


def memory_since(held: float) -> float:
    """Bytes of memory taken at most beyond those ``held`` at :func:`memory_from_here`."""
    return max(peak_memory() - held, 0.0)


def running_seconds() -> float:
    """Seconds since this process began: what its start took, when asked for at the beginning of work."""
    try:
        # proc(5): in ticks since boot. psutil adds the time of boot to it, which Linux tells in whole seconds.
        began = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19]) / os.sysconf("SC_CLK_TCK")
        return max(time.clock_gettime(time.CLOCK_BOOTTIME) - began, 0.0)
    except (OSError, AttributeError):  # not Linux
        import psutil

        return max(time.time() - float(psutil.Process().create_time()), 0.0)


def free_disk(path: Path) -> float:
    """Bytes left on the disk where ``path`` is, or will be."""
    existing = next(place for place in (path.absolute(), *path.absolute().parents) if place.exists())
    return float(shutil.disk_usage(existing).free)


def _size(count: float) -> str:
    return f"{count / 2**30:.3g} GiB" if count >= 2**30 else f"{count / 2**20:.3g} MiB"

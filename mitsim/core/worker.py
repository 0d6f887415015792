"""A process of its own for long work: whatever becomes of it, somebody is left to say so.

Native code (Dr.Jit, LLVM, OpenEXR) can end a process without an exception, and the kernel kills what takes too much
memory. So the program splits in two before anything heavy is imported: the worker goes on, and the parent waits,
passes signals on and turns the worker's end into an exit status and, where it died, one clear line.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from types import FrameType

_STOPS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT") if hasattr(signal, name))
_CRASHES = ("SIGABRT", "SIGSEGV", "SIGBUS", "SIGILL", "SIGFPE", "SIGTRAP")
_stopped_by: int | None = None


def enter_worker() -> None:
    """Return in a child process; the parent never returns, but exits with the child's status.

    A worker that a signal ended gives 128 + its number, as in a shell. SIGINT, SIGTERM, SIGHUP and SIGQUIT to the
    parent reach the worker, where they raise KeyboardInterrupt (see :func:`stop_signal`); a second one kills it. When
    the parent is killed, so is the worker. To be called once, before threads are started: RuntimeError when Dr.Jit is
    there already, whose threads a fork leaves behind. Without ``os.fork`` the process stays one.
    """
    if not hasattr(os, "fork"):
        return
    if "drjit" in sys.modules:
        raise RuntimeError("enter_worker: Dr.Jit is imported already, and its threads do not survive a fork")
    reading, writing = os.pipe()
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child:
        os.close(reading)
        _watch(child)
    os.close(writing)
    threading.Thread(target=_end_with_parent, args=(reading,), daemon=True).start()
    for number in _heeded():
        signal.signal(number, _stop)


def stop_signal() -> int | None:
    """The signal that asked this process to stop, None when none did."""
    return _stopped_by


def _heeded() -> list[int]:
    """Signals that are not ignored already, as nohup and background jobs of a shell have it."""
    return [number for number in _STOPS if signal.getsignal(number) is not signal.SIG_IGN]


def _stop(number: int, _: FrameType | None) -> None:
    global _stopped_by
    _stopped_by = number
    for other in _heeded():  # a terminal sends Control-C to both processes, and the parent passes it on
        signal.signal(other, signal.SIG_IGN)
    raise KeyboardInterrupt


def _end_with_parent(reading: int) -> None:
    os.read(reading, 1)  # nothing is ever written: this returns when the parent is gone
    os.kill(os.getpid(), signal.SIGKILL)


def _watch(child: int) -> None:
    """Wait for the worker, pass signals on, report its end, and exit."""
    asked: list[int] = []

    def forward(number: int, _: FrameType | None) -> None:
        os.kill(child, signal.SIGKILL if asked else number)
        asked.append(number)

    for number in _heeded():
        signal.signal(number, forward)
    _, status = os.waitpid(child, 0)
    for number in _STOPS:
        signal.signal(number, signal.SIG_IGN)
    if os.WIFEXITED(status):
        os._exit(os.WEXITSTATUS(status))
    ended_by = os.WTERMSIG(status)
    sys.stderr.write(f"mitsim: {_obituary(signal.Signals(ended_by).name, bool(asked))}\n")
    sys.stderr.flush()
    os._exit(128 + (asked[0] if asked else ended_by))


def _obituary(name: str, asked: bool) -> str:
    if asked:
        return "stopped at once; finished frames of a capture are kept, go on with --resume"
    cause = "a crash in native code" if name in _CRASHES else "out of memory, or killed from outside"
    remedy = "run: mitsim doctor" if name in _CRASHES else "free memory or ask for less"
    return (
        f"the worker process was ended by {name} ({cause}); finished frames of a capture are kept, go on with "
        f"--resume; {remedy}"
    )

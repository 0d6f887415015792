"""Worker process for long work, and a parent that reports the worker's end.

Native code (Dr.Jit, LLVM, OpenEXR) can end a process without an exception, and the kernel kills a process that takes
too much memory. Therefore the program forks before heavy imports: the parent passes signals on, and converts the
worker's end to an exit status and, if it died, one line.
"""

from __future__ import annotations

import gc
import mmap
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

INTERRUPTED = 128 + signal.SIGINT
"""Exit status after Control-C, as in a shell."""
RESUME = "finished work is kept; continue with --resume"
_STOPS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT") if hasattr(signal, name))
_CRASHES = ("SIGABRT", "SIGSEGV", "SIGBUS", "SIGILL", "SIGFPE", "SIGTRAP")
_SPACE_BYTES = 0.7e9
"""Address space that a command needs to reach its own check of memory (measured); below, LLVM ends the process."""
_SPACE_BYTES_PER_PROCESSOR = 85e6
"""Buffers and stacks of two OpenBLAS for each processor (measured)."""
_AGAIN_S = 0.01
"""A lost interrupt repeats at this interval, because a callback may drop it, or Python may begin to wait just after it.
"""
_LONGEST_FAULT = 300
_LONGEST_ADVICE = 256


def workers() -> int:
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


_WHOLE = "\r\x1b[J\x1b[?25h"
"""Clears the line and shows the cursor of a terminal after the worker died."""


_stopped_by: int | None = None
_advice: mmap.mmap | None = None


def enter_worker() -> None:
    """Fork, and return in the child; the parent exits with the child's status, or 128 + the signal that ended it.

    Signals that stop the parent are passed to the worker, where they raise KeyboardInterrupt (see :func:`end_stopped`);
    a second one kills it. The worker dies with the parent. Call it once, before threads start: RuntimeError if Dr.Jit
    is loaded, because a fork loses its threads. Without ``os.fork`` there is no second process.
    """
    global _advice
    if not hasattr(os, "fork"):
        return
    if "drjit" in sys.modules:
        raise RuntimeError("enter_worker: Dr.Jit is imported already, and its threads do not survive a fork")
    # A file that is opened later would get the number of a closed standard output, and the program's output. Closed
    # input and error become /dev/null instead.
    for number, mode in ((0, os.O_RDONLY), (1, os.O_WRONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            if number == 1:
                _say("standard output is closed; give it a file, a pipe or /dev/null")
                sys.exit(2)
            os.open(os.devnull, mode)  # which takes the lowest number that is free
            if number == 2:
                sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115
    import resource

    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    needed = _SPACE_BYTES + _SPACE_BYTES_PER_PROCESSOR * workers()
    if limit != resource.RLIM_INFINITY and limit < needed:  # in which OpenBLAS, loaded with numpy, would try for ever
        _say(
            f"address space is limited to {limit / 2**30:.2g} GiB; at least {needed / 2**30:.2g} GiB are needed to "
            "start; raise the limit, for example with: ulimit -v unlimited"
        )
        sys.exit(2)
    # Blocked until both processes have installed their handlers.
    signal.pthread_sigmask(signal.SIG_BLOCK, {*_STOPS, signal.SIGCHLD})
    _advice = mmap.mmap(-1, _LONGEST_ADVICE)  # shared: what the worker notes, its parent reads
    reading, writing = os.pipe()
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child:
        os.close(reading)
        _watch(child)
    os.close(writing)

    def end_with_parent() -> None:
        os.read(reading, 1)  # nothing is ever written: this returns when the parent is gone
        os.kill(os.getpid(), signal.SIGKILL)

    # Signals stay blocked in this thread, so it is the main one that they interrupt.
    threading.Thread(target=end_with_parent, daemon=True).start()
    _insist_on_signals()
    for number in _signals_to_heed():
        signal.signal(number, _stop)
    signal.signal(signal.SIGALRM, _again)
    sys.unraisablehook = _unraisable
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {*_STOPS, signal.SIGCHLD})


def end_with(status: object) -> None:
    """End a worker with an exit ``status`` without taking down interpreter and libraries, which takes 0.2 s."""
    if _advice is None or not isinstance(status, int):
        return
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except (OSError, ValueError):
        os._exit(2)  # what was printed is lost; the interpreter would say so with a traceback
    os._exit(status)


def advise(text: str) -> None:
    if _advice is not None:
        _advice[:] = text.encode()[:_LONGEST_ADVICE].ljust(_LONGEST_ADVICE, b"\0")


@contextmanager
def held_back() -> Iterator[None]:
    """Delay signals that stop this process until the block ends.

    Native code that is being imported turns their exceptions into its own errors or ends the process. Threads that
    start in the block never receive the signals.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    kept: list[int] = []
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, _STOPS)
    handlers = {number: handler for number in _STOPS if callable(handler := signal.getsignal(number))}
    if threading.current_thread() is not threading.main_thread():
        handlers = {}  # which run in the main thread alone
    try:
        for number in handlers:
            signal.signal(number, lambda taken, _: kept.append(taken))
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if kept:
            signal.raise_signal(kept[0])


@contextmanager
def pause_collector() -> Iterator[None]:
    """Pause Python's collector during imports, which saves 0.06 to 0.1 s of a capture."""
    collecting, known = gc.isenabled(), len(sys.modules)
    gc.disable()
    try:
        yield
    finally:
        # Only if modules were imported, because garbage in cycles is kept as well.
        if _advice is not None and len(sys.modules) > known:
            gc.freeze()
        if collecting:
            gc.enable()


def has_rows() -> bool:
    return sys.stderr is not None and sys.stderr.isatty() and os.environ.get("TERM", "dumb") not in ("dumb", "unknown")


def is_stopped() -> bool:
    return _stopped_by is not None


def end_stopped() -> NoReturn:
    number = signal.Signals(_stopped_by or signal.SIGINT)
    _say_end(number)
    sys.exit(128 + number)


def end_uncaught(error: BaseException) -> NoReturn:
    """Report an uncaught ``error`` in one line, and exit with 2, because 1 means a result.

    If an interrupt became that error, for example during an import, the interrupt is reported.
    """
    if is_stopped():
        end_stopped()
    import tempfile
    import traceback

    from mitsim.core.errors import cut

    log = "could not be kept"
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="mitsim-", suffix=".log", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as file:
            file.write("".join(traceback.format_exception(type(error), error, error.__traceback__)))
            log = f"is in {file.name}"
    except OSError:
        pass
    fault = cut(f"{type(error).__name__}: {error}", _LONGEST_FAULT)
    _say(f"a fault of mitsim's own, {fault}; its traceback {log}; please report it with the command")
    sys.exit(2)


def _say_end(text: str | signal.Signals, remedy: str = "") -> None:
    """Report an end by a signal, or a text about one, with the advice of the command and a ``remedy``."""
    if isinstance(text, signal.Signals):
        text = "interrupted" if text == signal.SIGINT else f"ended by {text.name}"
    noted = _advice[:].rstrip(b"\0").decode(errors="ignore") if _advice is not None else ""
    _say("; ".join(filter(None, (text, noted, remedy))))


def _say(text: str) -> None:
    if sys.stderr is not None:
        sys.stderr.write(f"mitsim: {text}\n")
        sys.stderr.flush()


def say_note(text: str) -> None:
    _say(f"note: {' '.join(text.split())}")


def _signals_to_heed() -> list[int]:
    return [number for number in _STOPS if signal.getsignal(number) is not signal.SIG_IGN]


def _stop(number: int, _: FrameType | None) -> None:
    global _stopped_by
    _stopped_by = number
    for heeded in _signals_to_heed():  # a terminal sends Control-C to both processes, and the parent passes it on
        signal.signal(heeded, signal.SIG_IGN)
    raise KeyboardInterrupt


def _insist_on_signals() -> None:
    """Repeat a signal until its handler has run, because a signal just before a wait does not end it."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    main = threading.get_ident()

    def insist() -> None:
        while number := os.read(reading, 1)[0]:
            while signal.getsignal(number) is _stop:  # which puts another handler in its own place
                time.sleep(_AGAIN_S)
                signal.pthread_kill(main, number)

    threading.Thread(target=insist, daemon=True).start()


def _again(_: int, __: FrameType | None) -> None:
    signal.setitimer(signal.ITIMER_REAL, 0)
    raise KeyboardInterrupt


def _unraisable(lost: sys.UnraisableHookArgs) -> None:
    """Repeat an interrupt that Python dropped in a callback or destructor."""
    if not is_stopped():
        sys.__unraisablehook__(lost)
    elif lost.exc_type is KeyboardInterrupt:
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S, _AGAIN_S)


def _watch(child: int) -> NoReturn:
    asked: list[int] = []
    # Signals stay blocked and are waited for, the worker's end among them: a handler's call can be late by a wait.
    signal.signal(signal.SIGCHLD, lambda *_: None)  # some systems drop what is ignored, blocked or not
    awaited = {*_signals_to_heed(), signal.SIGCHLD}
    while not (ended := os.waitpid(child, os.WNOHANG))[0]:
        number = signal.sigwait(awaited)
        if number != signal.SIGCHLD:
            os.kill(child, signal.SIGKILL if asked else number)
            asked.append(number)
    status = ended[1]
    if (asked or os.WIFSIGNALED(status)) and has_rows():
        sys.stderr.write(_WHOLE)
        sys.stderr.flush()
    if os.WIFEXITED(status):
        os._exit(os.WEXITSTATUS(status))
    killer = signal.Signals(os.WTERMSIG(status))
    if asked:
        # A first signal ends it without a word once Python has given up its handlers, in the last moment.
        _say_end(killer if killer == asked[0] else "stopped at once")
    else:
        crash = killer.name in _CRASHES
        cause = "a crash in native code" if crash else "out of memory, or killed from outside"
        remedy = "run: mitsim doctor" if crash else "free memory or ask for less"
        _say_end(f"the worker process was ended by {killer.name} ({cause})", remedy)
    os._exit(128 + (asked[0] if asked else killer))

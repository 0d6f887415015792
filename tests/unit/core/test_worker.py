"""The worker process: its end becomes an exit status and one line, whatever that end is."""

import contextlib
import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="one process where there is no fork")

HANGS_S = 120
"""Seconds on the clock after which a program counts as hung, also on a loaded machine; fewer than programs sleep."""

PROGRAM = """
import ctypes, os, signal, sys, time
from mitsim.core.worker import advise, end_stopped, enter_worker
enter_worker()
{work}
"""
WAIT = "print(os.getpid(), flush=True)\ntime.sleep(600)"
HEED = """
try:
    print(os.getpid(), flush=True)
    time.sleep(600)
except KeyboardInterrupt:
"""
TELL = HEED + "    end_stopped()\n"
STUBBORN = "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n" + WAIT


@pytest.fixture(autouse=True)
def _interrupts() -> Iterator[None]:
    """A shell's background jobs ignore SIGINT, those of nohup SIGHUP, and so would what they start."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGINT, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def start(work: str, **more: Any) -> subprocess.Popen[str]:
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    command, pipe = [sys.executable, "-c", PROGRAM.format(work=work)], subprocess.PIPE
    return subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=buffered, **more)


def started(work: str) -> tuple[subprocess.Popen[str], int]:
    """The parent, and the worker's process number once it works."""
    process = start(work)
    assert process.stdout is not None
    return process, int(process.stdout.readline())


def ended_by(number: signal.Signals) -> str:
    """The line that says so."""
    return "mitsim: interrupted\n" if number == signal.SIGINT else f"mitsim: ended by {number.name}\n"


def insist(process: subprocess.Popen[str]) -> None:
    """Send SIGTERM until the parent ends. Two signals count as one if the parent had no turn between them."""
    while process.poll() is None:
        process.send_signal(signal.SIGTERM)
        time.sleep(0.2)


@pytest.mark.parametrize("status", [0, 77])
def test_an_exit_status_is_passed_on(status: int) -> None:
    process = start(f"print('out'); print('err', file=sys.stderr); sys.exit({status})")
    assert (*process.communicate(), process.returncode) == ("out\n", "err\n", status)


LEAVING = """
from mitsim.core.worker import end_with
class Library:
    def __del__(self): os.write(1, b"taken apart")
kept = Library()
print("unflushed")
end_with({status})
sys.exit({status})
"""


@pytest.mark.parametrize(
    ("status", "ended"), [("3", ("unflushed\n", "", 3)), ("'no'", ("unflushed\ntaken apart", "no\n", 1))]
)
def test_a_worker_ends_and_takes_nothing_apart(status: str, ended: tuple[str, str, int]) -> None:
    """(Planted: no flush; a status that is no number.)"""
    process = start(LEAVING.format(status=status))
    assert (*process.communicate(), process.returncode) == ended


@pytest.mark.parametrize(
    ("work", "name", "words"),
    [
        ("os.abort()", "SIGABRT", "a crash in native code"),
        ("ctypes.string_at(0)", "SIGSEGV", "a crash in native code"),
        ("os.kill(os.getpid(), signal.SIGKILL)", "SIGKILL", "out of memory, or killed from outside"),
    ],
)
def test_a_worker_that_dies_leaves_one_clear_line(work: str, name: str, words: str) -> None:
    process = start(work)
    out, err = process.communicate()
    assert process.returncode == 128 + signal.Signals[name] and out == ""
    assert err.startswith(f"mitsim: the worker process was ended by {name} ({words})")
    assert err.endswith(("); run: mitsim doctor\n", "); free memory or ask for less\n")) and err.count("\n") == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_the_parent_stops_the_worker(number: signal.Signals) -> None:
    process, _ = started(TELL)
    process.send_signal(number)
    assert (*process.communicate(timeout=HANGS_S), process.returncode) == ("", ended_by(number), 128 + number)


LATE = """
import operator
from functools import partial
def just_before(wait, *arguments):
    # Native calls alone: Python does not look for signals between the two.
    calls = partial(ctypes.PyDLL(None)["raise"], int(signal.SIGTERM)), partial(wait, *arguments)
    return [*map(operator.methodcaller("__call__"), calls)][-1]
"""
LATE_IN_THE_WORKER = LATE + HEED.replace("time.sleep(600)", "just_before(time.sleep, 600)") + "    end_stopped()\n"
IN_THE_PARENT = """
waitpid = os.waitpid
def once(*given):
    os.waitpid = waitpid
    return just_before(waitpid, *given)
os.waitpid = once
"""


def test_a_signal_just_before_a_wait_ends_it() -> None:
    """Python notes a signal, and calls the handler once it is back in its own code. (Planted: the worker does not
    insist; a parent that waits for the worker's end alone.)"""
    process, _ = started(LATE_IN_THE_WORKER)
    assert process.communicate(timeout=HANGS_S) == ("", "mitsim: ended by SIGTERM\n")
    assert process.returncode == 143
    program = PROGRAM.replace("enter_worker()\n", LATE + IN_THE_PARENT).format(
        work=TELL.replace("print(os.getpid(), flush=True)", "enter_worker()")
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=HANGS_S)
    assert (done.stderr, done.returncode) == ("mitsim: ended by SIGTERM\n", 143)


def test_control_c_on_a_terminal_reaches_both_and_stops_once() -> None:
    """A terminal sends it to the whole group: the worker gets it twice, its own and the one passed on.

    On a busy machine the latter may come too late, so that one more is sent while the worker cleans up.
    """
    cleaning = HEED + "    print('cleaning up', flush=True)\n    time.sleep(0.3)\n    print('cleaned up')\n"
    process = start(cleaning, start_new_session=True)
    assert process.stdout is not None
    worker = int(process.stdout.readline())
    os.killpg(process.pid, signal.SIGINT)
    assert process.stdout.readline() == "cleaning up\n"
    os.kill(worker, signal.SIGINT)
    out, err = process.communicate(timeout=HANGS_S)
    assert (out, err, process.returncode) == ("cleaned up\n", "", 0)


def test_a_killed_worker_leaves_the_terminal_whole() -> None:
    """The cursor that its rows of progress hid is there again, and the line is free. (Planted: nothing written.)"""
    hidden = "sys.stderr.write('\\x1b[?25lrows'); sys.stderr.flush(); os.kill(os.getpid(), signal.SIGKILL)"
    command = [sys.executable, "-c", PROGRAM.format(work=hidden)]
    ours, theirs = pty.openpty()
    process = subprocess.Popen(command, stderr=theirs, env={**os.environ, "TERM": "xterm"})
    os.close(theirs)
    seen = b""
    with contextlib.suppress(OSError):  # the terminal's end, once nobody holds the other one
        while data := os.read(ours, 4096):
            seen += data
    os.close(ours)
    assert process.wait(timeout=HANGS_S) == 128 + signal.SIGKILL
    before, _, after = seen.decode().partition("rows")
    assert before == "\x1b[?25l" and after.startswith(
        "\r\x1b[J\x1b[?25hmitsim: the worker process was ended by SIGKILL"
    )


def test_a_second_signal_stops_a_worker_that_does_not_listen() -> None:
    process, worker = started(STUBBORN)
    process.send_signal(signal.SIGTERM)
    time.sleep(0.2)
    assert process.poll() is None
    insist(process)
    out, err = process.communicate(timeout=HANGS_S)
    assert process.returncode == 128 + signal.SIGTERM and not psutil.pid_exists(worker)
    assert (out, err) == ("", "mitsim: stopped at once\n")


@pytest.mark.parametrize("advice", ["", "do this next"])
def test_the_advice_is_that_of_the_command_which_runs(advice: str) -> None:
    """The worker notes it, and whoever is left repeats it: the worker after a signal, else the parent."""
    note = f"advise('another')\nadvise({advice!r})\n"
    more = f"; {advice}" if advice else ""
    process, _ = started(note + TELL)
    process.send_signal(signal.SIGTERM)
    assert process.communicate(timeout=HANGS_S) == ("", f"mitsim: ended by SIGTERM{more}\n")
    process, _ = started(note + STUBBORN)
    insist(process)
    assert process.communicate(timeout=HANGS_S) == ("", f"mitsim: stopped at once{more}\n")
    _, err = start(note + "os.abort()").communicate()
    assert f"(a crash in native code){more}; run: mitsim doctor\n" in err


def test_a_killed_parent_takes_the_worker_along() -> None:
    process, worker = started(WAIT)
    watched = psutil.Process(worker)
    process.kill()
    process.communicate(timeout=HANGS_S)
    limit = time.monotonic() + HANGS_S
    while watched.is_running() and watched.status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < limit
        time.sleep(0.01)


def test_signals_that_are_ignored_stay_ignored() -> None:
    """`nohup` and a shell's background jobs ignore signals before the program starts."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    process, _ = started("print(os.getpid(), flush=True)\ntime.sleep(0.3)\nprint('done')")
    process.send_signal(signal.SIGHUP)
    out, err = process.communicate(timeout=HANGS_S)
    assert (out, err, process.returncode) == ("done\n", "", 0)


def test_a_process_with_threads_of_drjit_is_not_split() -> None:
    done = start("").communicate()
    assert done == ("", "")
    program = "import sys\nsys.modules['drjit'] = sys\nfrom mitsim.core.worker import enter_worker\nenter_worker()"
    late = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert late.returncode == 1 and "do not survive a fork" in late.stderr


DROPPED = """
class Callback:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.1)
try:
    Callback()
    time.sleep(600)
except KeyboardInterrupt:
    end_stopped()
"""


def test_an_interrupt_that_a_callback_drops_comes_again() -> None:
    """Python prints a traceback and goes on; so did a program that was stopped while it imported. (Planted: the hook
    left out.)"""
    process = start(DROPPED)
    out, err = process.communicate(timeout=HANGS_S)
    assert (out, err, process.returncode) == ("", "mitsim: interrupted\n", 130)


MITSIM = [sys.executable, "-m", "mitsim"]


@pytest.mark.parametrize(("moment", "gap"), [(0.0, 0.0), (0.05, 0.1), (0.1, 0.02), (0.2, 0.0), (0.4, 0.1)])
def test_control_c_during_start_up_is_one_line(moment: float, gap: float) -> None:
    """Twice, as a terminal sends it: to both processes. ``moment`` is what the worker has taken of a processor [s], so
    that it stands at the same place on a busy machine.

    Before there is a worker Python itself starts, and says in its own way that it was interrupted.
    """
    command, pipe = [*MITSIM, "plan", "photograph"], subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, start_new_session=True)
    parent = psutil.Process(process.pid)
    while not (children := parent.children()):
        assert process.poll() is None
    while sum(children[0].cpu_times()[:2]) < moment:
        assert process.poll() is None
        time.sleep(0.002)
    os.killpg(process.pid, signal.SIGINT)
    time.sleep(gap)
    with contextlib.suppress(ProcessLookupError):  # it may be over
        os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=HANGS_S)
    assert (process.returncode, out) == (130, ""), err
    assert set(err.splitlines()) <= {"mitsim: interrupted", "mitsim: stopped at once"} and err


def limited(kilobytes: int, *arguments: str) -> subprocess.CompletedProcess[str]:
    """mitsim with a limit on its address space, as ``ulimit -v`` sets it."""
    import resource

    space = kilobytes * 1024
    limit = partial(resource.setrlimit, resource.RLIMIT_AS, (space, space))
    return subprocess.run([*MITSIM, *arguments], capture_output=True, text=True, timeout=HANGS_S, preexec_fn=limit)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems do not hold to RLIMIT_AS")
@pytest.mark.parametrize("kilobytes", [100_000, 300_000])
def test_too_little_address_space_is_refused_at_once(kilobytes: int) -> None:
    """OpenBLAS would try for its buffers for ever at 300 000, and Dr.Jit, LLVM or the kernel would end the process."""
    done = limited(kilobytes, "plan", "photograph")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith(f"mitsim: address space is limited to {kilobytes * 1024 / 2**30:.2g} GiB; at least ")
    assert "ulimit -v unlimited" in done.stderr


HELD = """
import threading
from mitsim.core.worker import held_back
for _ in range({threads}):
    threading.Thread(target=time.sleep, args=(600,), daemon=True).start()
try:
    with held_back():
        print(os.getpid(), flush=True)
        sys.stdin.readline()
        time.sleep(0.2)
        print("imported", flush=True)
    print("not reached")
except KeyboardInterrupt:
    end_stopped()
"""


@pytest.mark.parametrize("threads", [0, 1], ids=["alone", "beside a thread that takes signals"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_waits_for_what_holds_it_back(number: signal.Signals, threads: int) -> None:
    """As the import of Mitsuba does, in which an interrupt ended with a traceback, and so it did where a thread of
    OpenBLAS took it. (Planted: nothing held back; handlers left in their places; what was kept not raised.)"""
    process, _ = started(HELD.format(threads=threads))
    process.send_signal(number)
    out, err = process.communicate("\n", timeout=HANGS_S)
    assert (out, err, process.returncode) == ("imported\n", ended_by(number), 128 + number)


IMPORT = """
from mitsim.core.environment import load_variant
class Interrupting:
    def find_spec(self, name, *_):
        if name == "mitsuba":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
try:
    load_variant("llvm_ad_mono")
    print("not reached")
except KeyboardInterrupt:
    print("mitsuba" in sys.modules, "drjit" in sys.modules)
    end_stopped()
"""


def test_control_c_while_mitsuba_is_imported_waits_for_it() -> None:
    """(Planted: nothing held back.)"""
    process = start(IMPORT)
    assert (*process.communicate(), process.returncode) == ("True True\n", "mitsim: interrupted\n", 130)


CLOSED = """
import os, sys
os.close({number})
os.execv(sys.executable, [sys.executable, "-c", {program!r}])
"""
PRINTS = """
import sys
from mitsim.core.worker import enter_worker
enter_worker()
with open("kept", "w"):
    print("out")
    print("err", file=sys.stderr)
"""


@pytest.mark.parametrize("number", [0, 1, 2])
def test_a_closed_stream_is_no_file(tmp_path: Path, number: int) -> None:
    """A file would get its number, and whatever is printed. (Planted: nothing in its place: "err" came out on stdout,
    and "out" in the file.)"""
    command = [sys.executable, "-c", CLOSED.format(number=number, program=PRINTS)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    if number == 1:
        line = "mitsim: standard output is closed; give it a file, a pipe or /dev/null\n"
        assert (done.returncode, done.stdout, done.stderr) == (2, "", line) and not (tmp_path / "kept").exists()
    else:
        assert (done.returncode, done.stdout, done.stderr) == (0, "out\n", "err\n" if number == 0 else "")
        assert (tmp_path / "kept").read_text() == ""

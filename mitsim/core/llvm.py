"""The LLVM library Dr.Jit compiles with: what is on this machine in, a proven path out.

Dr.Jit 1.5 refuses LLVM 14 and older with a message about a missing file, and LLVM 15 and 16 load and then end
the process (`Cannot select ... fminimum`, SIGABRT, no exception). So a library is taken only if its name says
17 or newer and a child process has compiled with it.
"""

import json
import os
import platform
import re
import site
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from mitsim.core.errors import MitsimError

VARIABLE = "DRJIT_LIBLLVM_PATH"
"""Environment variable by which Dr.Jit finds the library."""
OLDEST = 17
"""First version that works: 14 is refused by Dr.Jit 1.5, 15 and 16 abort the process."""
_NEWEST = 30
"""Names up to this version are looked for, the probe decides; chosen with years of releases to spare."""
_PROBE_SECONDS = 60
"""Longest time for a probe; chosen so: it takes about one, on a busy machine several."""

# minimum and maximum are the operations LLVM 15 and 16 cannot select.
_PROBE_PROGRAM = """
import drjit as dr
from drjit.llvm import Float
x = dr.arange(Float, 16)
total = dr.sum(dr.minimum(x, 3) + dr.maximum(x, 2))
assert abs(float(total[0]) - 165.0) < 1e-3, total
"""


@dataclass(frozen=True)
class Probe:
    """Whether a child process did what it should, and what was seen."""

    ok: bool
    detail: str


def install_command() -> str:
    """The one command that installs a fitting LLVM on this machine."""
    if platform.system() == "Darwin":
        return "brew install llvm"
    sudo = "" if os.geteuid() == 0 else "sudo "
    return f"{sudo}apt-get update && {sudo}apt-get install -y libllvm19"


def version(path: Path | str) -> int | None:
    """LLVM's major version as the library's file name at ``path`` (links followed) tells it, None if it does not."""
    for name in (Path(path).name, Path(os.path.realpath(path)).name):
        match = re.search(r"libLLVM(?:-|\.so\.)(\d+)", name)
        if match:
            return int(match.group(1))
    return None


def candidates() -> list[Path]:
    """Existing LLVM libraries of version 17 or newer (or unknown), newest first, each file once."""
    by_file: dict[str, Path] = {}
    for path in _names():
        if path.exists() and (version(path) or OLDEST) >= OLDEST:
            by_file.setdefault(os.path.realpath(path), path)
    return list(by_file.values())


def run_child(program: str, seconds: float, variables: Mapping[str, str] | None = None) -> Probe:
    """Run a Python program in a child process, which may hang or die.

    Parameters
    ----------
    program
        source text.
    seconds
        longest time that it may take.
    variables
        environment variables beside this process's own.
    """
    try:
        done = subprocess.run(
            [sys.executable, "-c", program],
            env={**os.environ, **(variables or {})},
            capture_output=True,
            text=True,
            errors="replace",
            timeout=seconds,
        )
    except subprocess.TimeoutExpired:
        return Probe(False, f"gives no answer within {seconds:g} s")
    if done.returncode == 0:
        return Probe(True, "compiles and runs")
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()] or ["no message"]
    reason = next((line for line in lines if "LLVM ERROR" in line), lines[-1])
    status = f"signal {-done.returncode}" if done.returncode < 0 else f"exit status {done.returncode}"
    return Probe(False, f"fails with {status} ({reason})")


def probe(path: Path | str) -> Probe:
    """Compile and run a small program with the library at ``path`` in a child process."""
    # A home of its own: a kernel that a good LLVM left in ~/.drjit would make any other look good.
    with tempfile.TemporaryDirectory() as home:
        variables = {VARIABLE: str(path), "PYTHONUSERBASE": site.getuserbase(), "HOME": home}
        return run_child(_PROBE_PROGRAM, _PROBE_SECONDS, variables)


def find_llvm() -> Path:
    """The first library that works: the one DRJIT_LIBLLVM_PATH names, else the newest on this machine.

    Raises MitsimError if the named one is too old or does not work, or if none is found.
    """
    named = os.environ.get(VARIABLE)
    if named:
        return _checked(Path(named))
    tried = []
    for path in candidates():
        result = _cached_probe(path)
        if result.ok:
            return path
        tried.append(f"{path} {result.detail}")
    failures = "; ".join(tried) or "none found"
    raise MitsimError(f"LLVM: no usable library of version {OLDEST} or newer ({failures}); run: {install_command()}")


def select_llvm() -> Path:
    """Point Dr.Jit at a proven LLVM by setting DRJIT_LIBLLVM_PATH; to be called before drjit is imported.

    Returns the library's path. Raises MitsimError as `find_llvm` does.
    """
    path = find_llvm()
    os.environ[VARIABLE] = str(path)
    return path


def _checked(path: Path) -> Path:
    major = version(path)
    if major is not None and major < OLDEST:
        raise MitsimError(
            f"{VARIABLE}: {path} is LLVM {major}, but Dr.Jit needs {OLDEST} or newer; run: unset {VARIABLE}"
        )
    if not path.exists():
        raise MitsimError(f"{VARIABLE}: {path} does not exist; run: unset {VARIABLE}")
    result = _cached_probe(path)
    if not result.ok:
        raise MitsimError(f"{VARIABLE}: {path} {result.detail}; run: unset {VARIABLE}")
    return path


def _names() -> Iterable[Path]:
    machine = platform.machine()
    folders = [
        Path(f"/usr/lib/{machine}-linux-gnu"),
        Path("/usr/lib64"),
        Path("/usr/lib"),
        Path("/usr/local/lib"),
    ]
    folders += [Path(sys.prefix) / "lib", Path("/opt/homebrew/opt/llvm/lib"), Path("/usr/local/opt/llvm/lib")]
    for number in range(_NEWEST, OLDEST - 1, -1):
        for folder in [*folders, Path(f"/usr/lib/llvm-{number}/lib"), Path(f"/usr/lib/llvm/{number}/lib64")]:
            # Debian ships libLLVM-19.so as a link to libLLVM.so.19.1; up to 17 the file was libLLVM-17.so.1.
            yield from (folder / f"libLLVM.so.{number}.1", folder / f"libLLVM-{number}.so.1")
            yield from (folder / f"libLLVM-{number}.so", folder / f"libLLVM.so.{number}")
    for folder in folders:
        yield from (folder / "libLLVM.so", folder / "libLLVM.dylib")


def _cached_probe(path: Path) -> Probe:
    """`probe`, remembering good results on disk: it costs about a second, and start-up should not."""
    import importlib.metadata  # here: it takes 20 ms to import, and no refusal needs it

    store = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mitsim" / "llvm.json"
    try:
        stat = path.stat()
        drjit = importlib.metadata.version("drjit")
    except (OSError, importlib.metadata.PackageNotFoundError):
        return probe(path)
    key = f"{os.path.realpath(path)} {stat.st_mtime_ns} {stat.st_size} drjit {drjit}"
    try:
        proven = json.loads(store.read_text(encoding="utf-8"))
        if isinstance(proven, list) and key in proven:
            return Probe(True, "compiles and runs")
    except (OSError, ValueError):
        pass
    result = probe(path)
    if result.ok:
        _remember(store, key)
    return result


def _remember(store: Path, key: str) -> None:
    temporary = store.with_name(f"{store.name}.{os.getpid()}.part")
    try:
        store.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(json.dumps([key]), encoding="utf-8")
        os.replace(temporary, store)
    except OSError:
        return  # without a cache the probe runs again next time

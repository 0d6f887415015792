"""Selection of Mitsuba's variant and of LLVM, and the checks of `mitsim doctor`."""

from __future__ import annotations

import gc
import importlib.metadata
import json
import os
import platform
import re
import site
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from mitsim.core.errors import ArgumentError, MitsimError, reason_of
from mitsim.core.files import write_json
from mitsim.core.worker import held_back
from mitsim.version import __version__

DEFAULT_VARIANT = "llvm_ad_mono"
"""The other variants cost time and do not change monochrome frames."""
VARIANTS = ("llvm_ad_mono", "llvm_ad_rgb", "llvm_ad_spectral")
"""Tested variants, also with cuda_ for llvm_ on a GPU (tests/physics/test_cuda.py)."""

_CHILD_SECONDS = 120
"""Importing and rendering take about 5 s, on a busy machine several times that."""
_FEWEST_THREADS = 2
"""Mitsuba 3.9.1 with a pool of one thread waits for ever when it reads an OpenEXR file."""
_REINSTALL = f"{sys.executable} -m pip install --force-reinstall"
_LEAST_MEMORY = 2**30
"""Bytes that a capture of a shipped scene needs."""

_IMPORT = """
import OpenEXR, PIL.Image, h5py, matplotlib.figure, numpy, scipy.linalg, skimage.metrics
"""
_RENDER = """
from mitsim.core.environment import load_variant
mi = load_variant({name!r})
scene = mi.load_dict({{"type": "scene", "integrator": {{"type": "direct"}},
    "sensor": {{"type": "perspective", "film": {{"type": "hdrfilm", "width": 4, "height": 4}}}},
    "shape": {{"type": "sphere", "center": [0, 0, 5]}}, "light": {{"type": "constant"}}}})
import numpy
image = numpy.array(mi.render(scene, spp=4, seed=0))
assert numpy.isfinite(image).all() and image.max() > 0, image
"""


def load_variant(name: str) -> ModuleType:
    """Return Mitsuba with the variant ``name`` set, after choosing a working LLVM.

    Only this function changes Mitsuba's process-wide variant. MitsimError for an unknown variant, a Mitsuba that cannot
    be imported, a missing LLVM, or a missing GPU. Control-C waits until Mitsuba is imported.
    """
    if name.startswith("llvm_"):
        select_llvm()
    with held_back():
        try:
            import mitsuba
        except ImportError as error:
            raise MitsimError(f"mitsuba: cannot be imported ({error}); run: {_REINSTALL} mitsuba") from error
        variants = mitsuba.variants()
        if name not in variants:
            raise MitsimError(f"variant: got {name!r}; this Mitsuba has {', '.join(variants)}; choose one of these")
        import drjit

        if name.startswith("cuda_") and not drjit.has_backend(drjit.JitBackend.CUDA):
            llvm_name = name.replace("cuda_", "llvm_", 1)
            raise MitsimError(f"variant {name}: Dr.Jit finds no NVIDIA GPU and driver here; use {llvm_name}")
        try:
            mitsuba.set_variant(name)
        except ImportError as error:
            raise MitsimError(f"variant {name}: cannot be loaded ({reason_of(error)}); run: mitsim doctor") from error
        drjit.set_flag(drjit.JitFlag.KernelHistory, True)  # for core.job.compiled_kernels; it costs 3 ms a run
        if drjit.thread_count() < _FEWEST_THREADS:
            drjit.set_thread_count(_FEWEST_THREADS)
    module: ModuleType = mitsuba
    return module


@contextmanager
def keep_scenes() -> Iterator[None]:
    """Pause Python's garbage collector, so that no scene is freed while a kernel is assembled.

    Dr.Jit 1.5.0 counts the objects of all scenes at each call. If the collector frees a cyclic scene between two calls
    of a kernel, one function enters the kernel twice, and LLVM ends the process.
    """
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


@cache
def compiled_arrays() -> tuple[ModuleType, ModuleType]:
    """Return Dr.Jit and its arrays on this machine's processors, the same under every variant.

    MitsimError for a missing LLVM.
    """
    select_llvm()
    with held_back():
        import drjit
        import drjit.llvm
    return drjit, drjit.llvm


_VECTOR = 16
"""Numbers that a kernel of Dr.Jit loads at once, at most."""


def device_array(kind: Any, values: Any) -> Any:
    """Return numbers ``values`` of numpy, in memory order, as a flat array of Dr.Jit's type ``kind``.

    Dr.Jit 1.5.0 uses numpy's memory in place, and its kernels load whole vectors. The last one of ``kind(values)`` ends
    beyond the array, which ends the process where no memory follows. Therefore such arrays get room for it.
    """
    import drjit
    import numpy as np

    flat = np.ascontiguousarray(values, drjit.type_v(kind).name.lower()).ravel()
    spare = -len(flat) % _VECTOR
    return kind(np.append(flat, np.zeros(spare, flat.dtype))[: len(flat)] if spare else flat)


def check_variant(variant: str) -> None:
    """Raise ArgumentError for a ``variant`` in which light cannot be traced; loading it finds a missing GPU."""
    if variant.replace("cuda_", "llvm_", 1) not in VARIANTS:
        raise ArgumentError("variant", f"{variant!r}: use {', '.join(VARIANTS)}")


# -------- The doctor


@dataclass(frozen=True)
class Check:
    name: str
    ok: bool
    detail: str
    remedy: str = ""


def doctor(variant: str = DEFAULT_VARIANT) -> list[Check]:
    """Check this machine in about five seconds; each check has ``ok``, a finding, and the command that mends it.

    Imports, and the rendering of a test image in the ``variant`` of Mitsuba, can crash or hang, so that they run in
    child processes.
    """
    check_variant(variant)
    from mitsim.core.job import free_memory, size_text

    def child(name: str, program: str, package: str, success: Callable[[], str]) -> Check:
        fault = run_child(program, _CHILD_SECONDS)
        return Check(name, not fault, fault or success(), f"{_REINSTALL} {package}" if fault else "")

    python = f"Python {platform.python_version()} at {sys.executable}"
    try:
        path = find_llvm()
        llvm = Check("llvm", True, f"LLVM {version(path) or 'of unknown version'} at {path} compiles and runs")
    except MitsimError as error:
        mend = f"unset {VARIABLE}" if os.environ.get(VARIABLE) else install_command()
        llvm = Check("llvm", False, str(error), mend)
    memory = free_memory()
    enough = memory >= _LEAST_MEMORY
    return [
        Check("python", new := sys.version_info >= (3, 10), python, "" if new else "apt-get install -y python3.11"),
        llvm,
        child("packages", _IMPORT, "mitsim", lambda: ", ".join(map(" ".join, versions().items()))),
        child(f"render {variant}", _RENDER.format(name=variant), "mitsuba", lambda: "renders a test image"),
        Check("memory", enough, f"{size_text(memory)} are free", "" if enough else "close other programs"),
    ]


# -------- The LLVM library Dr.Jit compiles with
# Dr.Jit 1.5 refuses LLVM 14 and older with a message about a missing file, and LLVM 15 and 16 load and then end the
# process (`Cannot select ... fminimum`, SIGABRT, no exception). So a library is taken only if its name says 17 or
# newer and a child process has compiled with it.

VARIABLE = "DRJIT_LIBLLVM_PATH"
OLDEST = 17
"""Dr.Jit 1.5 refuses version 14, and versions 15 and 16 abort the process."""
_NEWEST = 30
_PROBE_SECONDS = 60

# minimum and maximum are the operations LLVM 15 and 16 cannot select.
_PROBE_PROGRAM = """
import drjit as dr
from drjit.llvm import Float
x = dr.arange(Float, 16)
total = dr.sum(dr.minimum(x, 3) + dr.maximum(x, 2))
assert abs(float(total[0]) - 165.0) < 1e-3, total
"""


def install_command() -> str:
    if platform.system() == "Darwin":
        return "brew install llvm"
    sudo = "" if os.geteuid() == 0 else "sudo "
    return f"{sudo}apt-get update && {sudo}apt-get install -y libllvm19"


def version(path: Path | str) -> int | None:
    for name in (Path(path).name, Path(os.path.realpath(path)).name):
        match = re.search(r"libLLVM(?:-|\.so\.)(\d+)", name)
        if match:
            return int(match.group(1))
    return None


def candidates() -> list[Path]:
    by_file: dict[str, Path] = {}
    for path in _names():
        if path.exists() and (version(path) or OLDEST) >= OLDEST:
            by_file.setdefault(os.path.realpath(path), path)
    return list(by_file.values())


def run_child(program: str, seconds: float, variables: Mapping[str, str] | None = None) -> str:
    """Run a source text in a child process, which may hang or die; return how it failed, or an empty text."""
    try:
        own, command = {**os.environ, **(variables or {})}, [sys.executable, "-c", program]
        done = subprocess.run(command, env=own, capture_output=True, text=True, errors="replace", timeout=seconds)
    except subprocess.TimeoutExpired:
        return f"gives no answer within {seconds:g} s"
    if done.returncode == 0:
        return ""
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()] or ["no message"]
    reason = next((line for line in lines if "LLVM ERROR" in line), lines[-1])
    status = f"signal {-done.returncode}" if done.returncode < 0 else f"exit status {done.returncode}"
    return f"fails with {status} ({reason})"


def probe(path: Path | str) -> str:
    """Return how compiling with the library at ``path`` fails; an empty text if it works."""
    # A cache of its own: a kernel that a good LLVM left in the usual one would make any other look good.
    with tempfile.TemporaryDirectory() as home:
        variables = {"PYTHONUSERBASE": site.getuserbase(), "HOME": home, "DRJIT_CACHE_DIR": home}
        return run_child(_PROBE_PROGRAM, _PROBE_SECONDS, {VARIABLE: str(path), **variables})


def find_llvm() -> Path:
    """Return the library that DRJIT_LIBLLVM_PATH names, else the newest working one; MitsimError if none works."""
    tried = []
    named = os.environ.get(VARIABLE)
    # A success is noted on disk, because a probe takes about a second.
    store = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mitsim" / "llvm.json"
    for path in [Path(named)] if named else candidates():
        major, fault = version(path), "does not exist"
        if named and major is not None and major < OLDEST:
            fault = f"is LLVM {major}, but Dr.Jit needs {OLDEST} or newer"
        elif path.exists():
            stat, drjit = path.stat(), importlib.metadata.version("drjit")
            key = f"{os.path.realpath(path)} {stat.st_mtime_ns} {stat.st_size} drjit {drjit}"
            with suppress(OSError, ValueError):
                if json.loads(store.read_text(encoding="utf-8")) == [key]:
                    return path
            fault = probe(path)
            if not fault:
                with suppress(OSError, MitsimError):  # without a cache the probe runs again next time
                    store.parent.mkdir(parents=True, exist_ok=True)
                    write_json(store, [key])
        if not fault:
            return path
        tried.append(f"{path} {fault}")
    if named:
        raise MitsimError(f"{VARIABLE}: {tried[0]}; run: unset {VARIABLE}")
    failures = "; ".join(tried) or "none found"
    raise MitsimError(f"LLVM: no usable library of version {OLDEST} or newer ({failures}); run: {install_command()}")


def select_llvm() -> Path:
    """Set DRJIT_LIBLLVM_PATH to a working LLVM; call this before drjit is imported. Raises as :func:`find_llvm`."""
    path = find_llvm()
    os.environ[VARIABLE] = str(path)
    return path


def _names() -> Iterator[Path]:
    folders = [f"/usr/lib/{platform.machine()}-linux-gnu", "/usr/lib64", "/usr/lib", "/usr/local/lib"]
    folders += [f"{sys.prefix}/lib", "/opt/homebrew/opt/llvm/lib", "/usr/local/opt/llvm/lib"]
    for number in range(_NEWEST, OLDEST - 1, -1):
        # Debian ships libLLVM-19.so as a link to libLLVM.so.19.1; up to 17 the file was libLLVM-17.so.1.
        names = f"libLLVM.so.{number}.1", f"libLLVM-{number}.so.1", f"libLLVM-{number}.so", f"libLLVM.so.{number}"
        own = f"/usr/lib/llvm-{number}/lib", f"/usr/lib/llvm/{number}/lib64"
        yield from (Path(folder, name) for folder in (*folders, *own) for name in names)
    yield from (Path(folder, f"libLLVM.{ending}") for folder in folders for ending in ("so", "dylib"))


# -------- Versions of packages

DECIDING = ("mitsim", "mitsuba", "drjit", "numpy", "scipy")
"""Packages whose version may change frames for a given seed."""
_PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "scikit-image", "OpenEXR")


@cache
def versions() -> dict[str, str]:
    """Return the versions of mitsim, Python and packages without importing them, read once because it takes 8 ms."""
    return {
        "mitsim": __version__,
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in _PACKAGES},
    }


def deciding_versions() -> dict[str, str]:
    """Return the versions that a manifest's configuration contains."""
    return {name: version for name, version in versions().items() if name in DECIDING}

"""Selection of Mitsuba's variant and of LLVM, and the checks of `mitsim doctor`."""

from __future__ import annotations

import ctypes
import gc
import json
import os
import platform
import re
import site
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType

from mitsim.core.errors import ArgumentError, MitsimError, reason_of
from mitsim.core.files import write_json
from mitsim.core.worker import held_back, workers
from mitsim.version import __version__

DEFAULT_VARIANT = "llvm_ad_mono"
"""The other variants cost time and do not change monochrome frames."""
VARIANTS = ("llvm_ad_mono", "llvm_ad_rgb", "llvm_ad_spectral")
"""Tested variants, also with cuda_ for llvm_ on a GPU (tests/physics/test_cuda.py)."""

_CHILD_SECONDS = 120
"""All checks together take about 10 s, on a busy machine several times that."""
_WARM_SECONDS = 1800
"""The longest capture that warms the cache takes 20 s on two idle cores."""
_WARM_ACCURACY = "3e-3"
"""Three times the default, because plans still include the default's effects and take half the time."""
_FEWEST_THREADS = 2
"""Mitsuba 3.9.1 with a pool of one thread waits for ever when it reads an OpenEXR file."""
_CACHE = "DRJIT_CACHE_DIR"
_DRIVERS, _DRIVER_FOLDERS = ("libcuda.so", "libcuda.so.1"), ("x86_64-linux-gnu", "aarch64-linux-gnu", "wsl/lib")
"""Names and folders in which Dr.Jit 1.4 looks for the driver."""

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

_FIGURE = """
import io, matplotlib
matplotlib.use("Agg")
from matplotlib.figure import Figure
figure = Figure()
figure.subplots().plot([0, 1])
figure.savefig(io.BytesIO(), format="png")
"""


@dataclass(frozen=True)
class Check:
    name: str
    ok: bool
    detail: str
    remedy: str = ""


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
            raise MitsimError(f"mitsuba: cannot be imported ({error}); run: {_reinstall('mitsuba')}") from error
        variants = mitsuba.variants()
        if name not in variants:
            raise MitsimError(f"variant: got {name!r}; this Mitsuba has {', '.join(variants)}; choose one of these")
        if name.startswith("cuda_") and not has_gpu():
            raise _without_gpu(name)
        try:
            mitsuba.set_variant(name)
        except ImportError as error:
            raise MitsimError(f"variant {name}: cannot be loaded ({reason_of(error)}); run: mitsim doctor") from error
        import drjit

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

    MitsimError for a missing LLVM, or a Dr.Jit that cannot be imported.
    """
    select_llvm()
    with held_back():
        try:
            import drjit
            import drjit.llvm
        except ImportError as error:
            raise MitsimError(f"drjit: cannot be imported ({error}); run: {_reinstall('mitsuba')}") from error
    return drjit, drjit.llvm


def check_variant(variant: str) -> None:
    """Raise ArgumentError for a ``variant`` in which light cannot be traced, or MitsimError as :func:`check_driver`."""
    # CUDA has the same kinds; whether a driver has a GPU too shows when the variant is loaded.
    if variant.replace("cuda_", "llvm_", 1) not in VARIANTS:
        raise ArgumentError("variant", f"{variant!r}: use {', '.join(VARIANTS)}")
    check_driver(variant)


def check_driver(variant: str) -> None:
    """Raise MitsimError for a cuda_ ``variant`` without an NVIDIA driver; Dr.Jit is not imported."""
    if not variant.startswith("cuda_") or os.environ.get("DRJIT_LIBCUDA_PATH") or not sys.platform.startswith("linux"):
        return  # Dr.Jit knows
    for name in _DRIVERS:
        with suppress(OSError):
            ctypes.CDLL(name)
            return
    if not any(any(Path("/usr/lib", folder).glob("libcuda.so.*")) for folder in _DRIVER_FOLDERS):
        raise _without_gpu(variant)


def _without_gpu(variant: str) -> MitsimError:
    llvm_name = variant.replace("cuda_", "llvm_", 1)
    return MitsimError(f"variant {variant}: Dr.Jit finds no NVIDIA GPU and driver here; use {llvm_name}")


def has_gpu() -> bool:
    """Return True if Dr.Jit finds a GPU; choose an LLVM first, because Dr.Jit reads its path when imported."""
    import drjit

    return bool(drjit.has_backend(drjit.JitBackend.CUDA))


def doctor() -> list[Check]:
    """Run all checks in about 10 s; checks that can crash or hang run in child processes."""

    def check_openexr() -> str:
        # Imported here: a broken OpenEXR must be a finding, not the end of the doctor.
        import numpy as np

        from mitsim.core.exr import read_frame, write_frame

        values = np.arange(6, dtype=np.uint32).reshape(2, 3)
        with tempfile.TemporaryDirectory() as folder:
            write_frame(Path(folder) / "frame.exr", {"DN": values}, {"seed": 2**40})
            channels, metadata = read_frame(Path(folder) / "frame.exr")
        if not np.array_equal(channels["DN"], values) or metadata != {"seed": 2**40}:
            raise MitsimError("a frame read back differs from the one written")
        return "writes a frame and reads it back"

    def check_llvm() -> str:
        path = find_llvm()
        return f"LLVM {version(path) or 'of unknown version'} at {path} compiles and runs"

    def check_cache() -> str:
        folder = Path(os.environ.get(_CACHE) or Path.home() / ".drjit")
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return f"{folder} is writable: compiled kernels are kept"

    def child(name: str, program: str, success: str, remedy: str) -> Check:
        result = run_child(program, _CHILD_SECONDS)
        return Check(name, True, success) if result.ok else Check(name, False, result.detail, remedy)

    python = f"Python {platform.python_version()} at {sys.executable}"
    mend = f"unset {VARIABLE}" if os.environ.get(VARIABLE) else install_command()
    llvm, mitsuba = _attempt("llvm", check_llvm, mend), _reinstall("mitsuba")
    return [
        Check("python", new := sys.version_info >= (3, 10), python, "" if new else "apt-get install -y python3.11"),
        llvm,
        child("mitsuba", "import mitsuba", "imports", mitsuba),
        *(
            child(f"render {name}", _RENDER.format(name=name), "renders a test image", llvm.remedy or mitsuba)
            for name in VARIANTS
        ),
        _attempt("openexr", check_openexr, _reinstall("OpenEXR")),
        _attempt("kernel cache", check_cache, "export HOME=$(mktemp -d)"),
        child("matplotlib", _FIGURE, "draws without a display", _reinstall("matplotlib")),
    ]


USUAL_SCENES = "cookie_bag", "gift_card", "metal_blade", "lamp_bench", "cards", "photograph"
"""Shipped scenes whose captures compile the usual kernels, slowest first."""


def warm_up(variant: str = DEFAULT_VARIANT, scenes: Sequence[str] = USUAL_SCENES) -> Check:
    """Compile the usual kernels into Dr.Jit's cache by capturing ``scenes``.

    Each scene has its own process, because Dr.Jit compiles the kernels of a process one after the other.
    """

    def capture(scene: str) -> float:
        with tempfile.TemporaryDirectory() as folder:
            words = "-m", "mitsim", "capture", scene, "--patterns", "dots:7", "--accuracy", _WARM_ACCURACY, "--json"
            command = [sys.executable, *words, "--quiet", "--variant", variant, "--output", f"{folder}/run"]
            done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=_WARM_SECONDS)
        if done.returncode not in (0, 1):
            raise MitsimError(f"{scene}: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
        return float(json.loads(done.stdout)["kernels"]["number"])

    def look() -> str:
        started = time.perf_counter()
        with ThreadPoolExecutor(workers()) as pool:
            number = sum(pool.map(capture, scenes))
        return f"{number:.0f} usual ones compiled in {time.perf_counter() - started:.0f} s, all others were there"

    return _attempt("kernels", look, "mitsim doctor")


def _attempt(name: str, look: Callable[[], str], remedy: str) -> Check:
    try:
        return Check(name, True, look())
    except (MitsimError, OSError, ImportError, subprocess.TimeoutExpired) as error:
        return Check(name, False, reason_of(error), remedy)


def _reinstall(package: str) -> str:
    return f"{sys.executable} -m pip install --force-reinstall {package}"


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


@dataclass(frozen=True)
class Probe:
    ok: bool
    detail: str


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


def run_child(program: str, seconds: float, variables: Mapping[str, str] | None = None) -> Probe:
    """Run a source text in a child process, which may hang or die."""
    try:
        own, command = {**os.environ, **(variables or {})}, [sys.executable, "-c", program]
        done = subprocess.run(command, env=own, capture_output=True, text=True, errors="replace", timeout=seconds)
    except subprocess.TimeoutExpired:
        return Probe(False, f"gives no answer within {seconds:g} s")
    if done.returncode == 0:
        return Probe(True, "compiles and runs")
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()] or ["no message"]
    reason = next((line for line in lines if "LLVM ERROR" in line), lines[-1])
    status = f"signal {-done.returncode}" if done.returncode < 0 else f"exit status {done.returncode}"
    return Probe(False, f"fails with {status} ({reason})")


def probe(path: Path | str) -> Probe:
    # A cache of its own: a kernel that a good LLVM left in the usual one would make any other look good.
    with tempfile.TemporaryDirectory() as home:
        variables = {VARIABLE: str(path), "PYTHONUSERBASE": site.getuserbase(), "HOME": home, _CACHE: home}
        return run_child(_PROBE_PROGRAM, _PROBE_SECONDS, variables)


def find_llvm() -> Path:
    """Return the library that DRJIT_LIBLLVM_PATH names, else the newest working one; MitsimError if none works."""
    tried = []
    named = os.environ.get(VARIABLE)
    for path in [Path(named)] if named else candidates():
        major, result = version(path), Probe(False, "does not exist")
        if named and major is not None and major < OLDEST:
            result = Probe(False, f"is LLVM {major}, but Dr.Jit needs {OLDEST} or newer")
        elif path.exists():
            result = _cached_probe(path)
        if result.ok:
            return path
        tried.append(f"{path} {result.detail}")
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


def _cached_probe(path: Path) -> Probe:
    """Return `probe`'s result, cached on disk because a probe takes about a second."""
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
        with suppress(OSError, MitsimError):  # without a cache the probe runs again next time
            store.parent.mkdir(parents=True, exist_ok=True)
            write_json(store, [key])
    return result


# -------- Versions of packages

DECIDING = ("mitsim", "mitsuba", "drjit", "numpy", "scipy")
"""Packages whose version may change frames for a given seed."""
_PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "scikit-image", "OpenEXR")


@cache
def _versions() -> dict[str, str]:
    import importlib.metadata  # read once: it takes 8 ms, and a coloured run states them nine times

    by_name = {"mitsim": __version__, "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            by_name[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            by_name[name] = "not installed"
    return by_name


def versions() -> dict[str, str]:
    """Return the versions of Python and of the :data:`DECIDING` packages without importing them."""
    return dict(_versions())


def deciding_versions() -> dict[str, str]:
    """Return the versions that a manifest's configuration contains."""
    return {name: version for name, version in versions().items() if name in DECIDING}

"""This machine: a variant's name in, Mitsuba ready to use out; and the checks behind `mitsim doctor`."""

import ctypes
import os
import platform
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType

from mitsim.core import llvm
from mitsim.core.errors import MitsimError
from mitsim.core.worker import held_back

DEFAULT_VARIANT = "llvm_ad_mono"
"""One panchromatic reflectance, as the factored estimator has it; the others cost time and change nothing else."""
VARIANTS = ("llvm_ad_mono", "llvm_ad_rgb", "llvm_ad_spectral")
"""Variants mitsim is tested with, and with cuda_ for llvm_ where there is a GPU (tests/physics/test_cuda.py);
`load_variant` takes any that the installed Mitsuba has."""

_CHILD_SECONDS = 120
"""Longest time for a check; chosen so: all of them take some ten, on a busy machine several times that."""
_FEWEST_THREADS = 2
"""With a pool of one thread, Mitsuba 3.9.1 waits for ever when it reads an OpenEXR file."""
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
    """One thing the doctor looked at: ``ok`` or not, what was seen, and the one command that mends it."""

    name: str
    ok: bool
    detail: str
    remedy: str = ""


def load_variant(name: str) -> ModuleType:
    """Mitsuba with the variant ``name`` set, after choosing an LLVM that works for the llvm_ variants.

    Setting a variant is Mitsuba's own process-wide state; nothing in mitsim does so except by this call.
    Raises MitsimError for an unknown variant, a Mitsuba that cannot be imported, a missing LLVM, or a missing GPU.
    Control-C counts once Mitsuba is there.
    """
    if name.startswith("llvm_"):
        llvm.select_llvm()
    with held_back():
        return _loaded(name)


def _loaded(name: str) -> ModuleType:
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
        raise MitsimError(f"variant {name}: cannot be loaded ({_one_line(error)}); run: mitsim doctor") from error
    import drjit

    if drjit.thread_count() < _FEWEST_THREADS:
        drjit.set_thread_count(_FEWEST_THREADS)
    module: ModuleType = mitsuba
    return module


@cache
def compiled_arrays() -> tuple[ModuleType, ModuleType]:
    """Dr.Jit's functions, and its arrays on this machine's processors: the same numbers whatever the variant is.

    MitsimError for a missing LLVM, or a Dr.Jit that cannot be imported.
    """
    llvm.select_llvm()
    with held_back():
        try:
            import drjit
            import drjit.llvm
        except ImportError as error:
            raise MitsimError(f"drjit: cannot be imported ({error}); run: {_reinstall('mitsuba')}") from error
    return drjit, drjit.llvm


def check_driver(variant: str) -> None:
    """MitsimError for a cuda_ ``variant`` where no NVIDIA driver is that Dr.Jit, which is not imported, could find."""
    if variant.startswith("cuda_") and not _has_driver():
        raise _without_gpu(variant)


def _has_driver() -> bool:
    if os.environ.get("DRJIT_LIBCUDA_PATH") or not sys.platform.startswith("linux"):
        return True  # Dr.Jit knows
    for name in _DRIVERS:
        with suppress(OSError):
            ctypes.CDLL(name)
            return True
    return any(any(Path("/usr/lib", folder).glob("libcuda.so.*")) for folder in _DRIVER_FOLDERS)


def _without_gpu(variant: str) -> MitsimError:
    llvm_name = variant.replace("cuda_", "llvm_", 1)
    return MitsimError(f"variant {variant}: Dr.Jit finds no NVIDIA GPU and driver here; use {llvm_name}")


def has_gpu() -> bool:
    """Whether Dr.Jit finds a GPU for the cuda_ variants; never raises for the lack of one.

    It imports Dr.Jit, which reads the path of its LLVM then: not to be asked before an LLVM is chosen.
    """
    import drjit

    return bool(drjit.has_backend(drjit.JitBackend.CUDA))


def doctor() -> list[Check]:
    """All checks in order. What can crash or hang runs in child processes; takes some ten seconds."""
    checks = [_python(), _llvm(), _child("mitsuba", "import mitsuba", "imports", _reinstall("mitsuba"))]
    remedy = _reinstall("mitsuba") if checks[1].ok else checks[1].remedy
    checks += [_child(f"render {name}", _RENDER.format(name=name), "renders a test image", remedy) for name in VARIANTS]
    checks += [_openexr(), _kernel_cache()]
    checks.append(_child("matplotlib", _FIGURE, "draws without a display", _reinstall("matplotlib")))
    return checks


def _python() -> Check:
    detail = f"Python {platform.python_version()} at {sys.executable}"
    new_enough = sys.version_info >= (3, 10)
    return Check("python", new_enough, detail, "" if new_enough else "apt-get install -y python3.11")


def _llvm() -> Check:
    def look() -> str:
        path = llvm.find_llvm()
        return f"LLVM {llvm.version(path) or 'of unknown version'} at {path} compiles and runs"

    remedy = f"unset {llvm.VARIABLE}" if os.environ.get(llvm.VARIABLE) else llvm.install_command()
    return _attempt("llvm", look, remedy)


def _openexr() -> Check:
    def look() -> str:
        # Imported here: a broken OpenEXR must be a finding, not the end of the doctor.
        import numpy as np

        from mitsim.core.framefile import read_frame, write_frame

        values = np.arange(6, dtype=np.uint32).reshape(2, 3)
        with tempfile.TemporaryDirectory() as folder:
            write_frame(Path(folder) / "frame.exr", {"DN": values}, {"seed": 2**40})
            channels, metadata = read_frame(Path(folder) / "frame.exr")
        if not np.array_equal(channels["DN"], values) or metadata != {"seed": 2**40}:
            raise MitsimError("a frame read back differs from the one written")
        return "writes a frame and reads it back"

    return _attempt("openexr", look, _reinstall("OpenEXR"))


def _kernel_cache() -> Check:
    folder = Path.home() / ".drjit"

    def look() -> str:
        folder.mkdir(exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return f"{folder} is writable: compiled kernels are kept"

    return _attempt("kernel cache", look, "export HOME=$(mktemp -d)")


def _attempt(name: str, look: Callable[[], str], remedy: str) -> Check:
    try:
        return Check(name, True, look())
    except (MitsimError, OSError, ImportError) as error:
        return Check(name, False, _one_line(error), remedy)


def _child(name: str, program: str, success: str, remedy: str) -> Check:
    result = llvm.run_child(program, _CHILD_SECONDS)
    return Check(name, True, success) if result.ok else Check(name, False, result.detail, remedy)


def _reinstall(package: str) -> str:
    return f"{sys.executable} -m pip install --force-reinstall {package}"


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())

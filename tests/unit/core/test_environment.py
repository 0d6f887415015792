import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mitsim.core import environment
from mitsim.core.errors import MitsimError
from mitsim.core.exr import write_frame


def in_child(program: str, **env: str) -> subprocess.CompletedProcess[str]:
    """Setting a variant is for the whole process, so it is done in another one."""
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env={**os.environ, **env})


def test_load_variant_gives_mitsuba_with_the_variant_set() -> None:
    done = in_child(
        "from mitsim.core.environment import load_variant\n"
        "mi = load_variant('llvm_ad_mono')\n"
        "assert mi.variant() == 'llvm_ad_mono'\n"
        "assert float((mi.Float(1) + 1)[0]) == 2"
    )
    assert done.returncode == 0, done.stderr


def test_an_unknown_variant_is_refused_with_the_known_ones() -> None:
    with pytest.raises(MitsimError, match=r"variant: got 'llvm_mono'; this Mitsuba has .*llvm_ad_mono"):
        environment.load_variant("llvm_mono")


def test_without_a_gpu_a_cuda_variant_is_refused_in_one_line() -> None:
    """In a child, in which no LLVM is looked for: the cuda variants need none."""
    done = in_child(
        "from mitsim.core import environment\n"
        "environment.has_gpu = lambda: False\n"
        "environment.select_llvm = lambda: 1 / 0\n"
        "try: environment.load_variant('cuda_ad_rgb')\n"
        "except Exception as error: print(type(error).__name__, error)"
    )
    assert done.returncode == 0, done.stderr
    assert "MitsimError variant cuda_ad_rgb: Dr.Jit finds no NVIDIA GPU" in done.stdout and "llvm_ad_rgb" in done.stdout


def test_without_a_driver_a_cuda_variant_is_refused_before_drjit_is_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dr.Jit takes any library that its variable names. (Planted: a driver seen everywhere; the variable ignored.)"""
    monkeypatch.setattr(environment, "_DRIVERS", ("libnone.so",))
    monkeypatch.setattr(environment, "_DRIVER_FOLDERS", ("none",))
    monkeypatch.delenv("DRJIT_LIBCUDA_PATH", raising=False)
    if sys.platform.startswith("linux"):
        with pytest.raises(MitsimError, match=r"^variant cuda_ad_rgb: .* no NVIDIA GPU .*; use llvm_ad_rgb$"):
            environment.check_driver("cuda_ad_rgb")
    environment.check_driver("llvm_ad_rgb")
    monkeypatch.setenv("DRJIT_LIBCUDA_PATH", "/somewhere/libcuda.so")
    environment.check_driver("cuda_ad_rgb")
    monkeypatch.delenv("DRJIT_LIBCUDA_PATH")
    monkeypatch.setattr(environment, "_DRIVERS", ("libc.so.6",))
    environment.check_driver("cuda_ad_rgb")


def test_an_old_llvm_never_reaches_mitsuba() -> None:
    old = Path("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1")
    if not old.exists():
        pytest.skip("LLVM 15 is not installed here")
    done = in_child(
        "from mitsim.core.environment import load_variant\n"
        "from mitsim.core.errors import MitsimError\n"
        "try: load_variant('llvm_ad_mono')\n"
        "except MitsimError as error: print(error)",
        **{environment.VARIABLE: str(old)},
    )
    assert done.returncode == 0 and "LLVM 15, but Dr.Jit needs 17 or newer" in done.stdout


def test_the_doctor_names_one_command_for_all_that_fails(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / ".drjit").touch()  # a file where the cache folder should be
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("DRJIT_CACHE_DIR", raising=False)
    monkeypatch.setenv(environment.VARIABLE, "/nowhere/libLLVM.so.19.1")
    monkeypatch.setattr(environment, "_RENDER", "import sys; sys.exit('{name} is broken')")
    monkeypatch.setattr(environment, "_FIGURE", "import os; os.abort()")
    checks = {check.name: check for check in environment.doctor()}
    assert checks["python"].ok and checks["openexr"].ok and checks["mitsuba"].ok
    broken = ["llvm", "kernel cache", "matplotlib", *(f"render {name}" for name in environment.VARIANTS)]
    for name in broken:
        assert not checks[name].ok, name
        assert checks[name].remedy and "\n" not in checks[name].remedy + checks[name].detail
    assert checks["llvm"].remedy == f"unset {environment.VARIABLE}"
    assert "llvm_ad_rgb is broken" in checks["render llvm_ad_rgb"].detail
    assert "signal 6" in checks["matplotlib"].detail
    assert set(broken) | {"python", "openexr", "mitsuba"} == set(checks)


def test_warming_up_captures_the_usual_scenes_and_counts_their_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """(Planted: a capture that failed taken for one that was done.)"""

    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        scene = command[command.index("capture") + 1]
        text = json.dumps({"kernels": {"number": {"cards": 2, "photograph": 10}.get(scene, 0), "seconds": 1.5}})
        status = {"glass": 2, "photograph": 1}.get(scene, 0)  # a flagged run is a run
        return subprocess.CompletedProcess(command, status, text, "first\nmitsim: no glass here\n")

    monkeypatch.setattr(environment.subprocess, "run", run)
    found = environment.warm_up(scenes=("photograph", "cards", "mirror"))
    assert found.ok and found.detail.startswith("12 usual ones compiled in ")
    found = environment.warm_up(scenes=("cards", "glass"))
    assert not found.ok and found.detail == "glass: mitsim: no glass here" and found.remedy


READ = """
import os, sys
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])
from mitsim.core.environment import load_variant
mi = load_variant("llvm_ad_mono")
print(mi.Bitmap(sys.argv[1]).size())
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs Linux's affinity")
def test_a_machine_of_one_processor_reads_openexr(tmp_path: Path) -> None:
    """Mitsuba 3.9.1 waits for ever where Dr.Jit has one thread."""
    write_frame(tmp_path / "print.exr", {"Y": np.ones((3, 5), np.float32)}, {})
    arguments = [sys.executable, "-c", READ, str(tmp_path / "print.exr")]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=600)
    assert done.stdout.strip() == "[5, 3]", done.stderr

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
        "import drjit\n"
        "drjit.has_backend = lambda _: False\n"
        "from mitsim.core import environment\n"
        "environment.select_llvm = lambda: 1 / 0\n"
        "try: environment.load_variant('cuda_ad_rgb')\n"
        "except Exception as error: print(type(error).__name__, error)"
    )
    assert done.returncode == 0, done.stderr
    assert "MitsimError variant cuda_ad_rgb: Dr.Jit finds no NVIDIA GPU" in done.stdout and "llvm_ad_rgb" in done.stdout


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


def test_the_doctor_names_one_command_for_all_that_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(environment.VARIABLE, "/nowhere/libLLVM.so.19.1")
    monkeypatch.setattr(environment, "_RENDER", "import sys; sys.exit('{name} is broken')")
    monkeypatch.setattr(environment, "_IMPORT", "import os; os.abort()")
    monkeypatch.setattr("mitsim.core.job.free_memory", lambda: 1e6)
    checks = {check.name: check for check in environment.doctor()}
    assert [name for name, check in checks.items() if check.ok] == ["python"]
    assert all("\n" not in check.remedy + check.detail for check in checks.values())
    assert checks["llvm"].remedy == f"unset {environment.VARIABLE}"
    assert "llvm_ad_mono is broken" in checks["render llvm_ad_mono"].detail
    assert "signal 6" in checks["packages"].detail and "pip install" in checks["packages"].remedy
    assert checks["memory"].detail == "0.954 MiB are free"


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

import os
import re
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


# ---- LLVM selection --------------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _clean(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(environment.VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def fake_libraries(monkeypatch: pytest.MonkeyPatch, folder: Path, *names: str) -> list[Path]:
    paths = [folder / name for name in names]
    for path in paths:
        path.touch()
    monkeypatch.setattr(environment, "_names", lambda: paths)
    return paths


def test_the_version_is_read_from_the_name() -> None:
    known = {"libLLVM-14.so.1": 14, "libLLVM-14.0.6.so.1": 14, "libLLVM.so.19.1": 19, "libLLVM-19.so": 19}
    for name, version in {**known, "libLLVM.so": None, "libLLVM.dylib": None}.items():
        assert environment.version(Path("/nowhere") / name) == version


def test_a_link_tells_its_target_s_version(tmp_path: Path) -> None:
    (tmp_path / "libLLVM-15.so.1").touch()
    (tmp_path / "libLLVM.so").symlink_to(tmp_path / "libLLVM-15.so.1")
    assert environment.version(tmp_path / "libLLVM.so") == 15


def test_old_libraries_are_no_candidates_and_links_count_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "libLLVM.so.19.1").touch()
    (tmp_path / "libLLVM-19.so").symlink_to(tmp_path / "libLLVM.so.19.1")
    names = ["libLLVM.so.20.1", "libLLVM.so.19.1", "libLLVM-19.so", "libLLVM-15.so.1", "libLLVM-14.so.1"]
    fake_libraries(monkeypatch, tmp_path, *names)
    assert [path.name for path in environment.candidates()] == ["libLLVM.so.20.1", "libLLVM.so.19.1"]


def test_a_library_that_fails_the_probe_is_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_libraries(monkeypatch, tmp_path, "libLLVM.so.20.1", "libLLVM.so.19.1")
    monkeypatch.setattr(environment, "probe", lambda path: "" if "19" in path.name else "seen")
    assert environment.find_llvm().name == "libLLVM.so.19.1"


def test_without_a_library_the_error_names_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_libraries(monkeypatch, tmp_path, "libLLVM-14.so.1")
    with pytest.raises(MitsimError, match=r"none found.*install") as caught:
        environment.select_llvm()
    assert "\n" not in str(caught.value)
    assert environment.VARIABLE not in os.environ


@pytest.mark.parametrize("name", ["libLLVM-14.so.1", "libLLVM-15.so.1"])
def test_select_refuses_a_named_old_library_without_loading_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    (tmp_path / name).touch()
    monkeypatch.setenv(environment.VARIABLE, str(tmp_path / name))
    monkeypatch.setattr(environment, "probe", lambda _: pytest.fail("an old library was loaded"))
    with pytest.raises(MitsimError, match=rf"{name} is LLVM 1[45].*17 or newer"):
        environment.select_llvm()


def test_a_named_library_must_exist_and_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(environment.VARIABLE, str(tmp_path / "libLLVM.so.19.1"))
    with pytest.raises(MitsimError, match="does not exist"):
        environment.find_llvm()
    (tmp_path / "libLLVM.so.19.1").write_text("no library")
    with pytest.raises(MitsimError, match="fails"):
        environment.find_llvm()


def test_a_good_probe_is_remembered_until_the_library_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (path,) = fake_libraries(monkeypatch, tmp_path, "libLLVM.so.19.1")
    probed: list[Path] = []

    def probe(library: Path) -> str:
        probed.append(library)
        return ""

    monkeypatch.setattr(environment, "probe", probe)
    environment.find_llvm()
    environment.find_llvm()
    assert len(probed) == 1
    path.write_text("a new build")
    environment.find_llvm()
    assert len(probed) == 2


def test_the_library_of_this_machine_works() -> None:
    path = environment.select_llvm()
    assert (environment.version(path) or environment.OLDEST) >= environment.OLDEST
    assert os.environ[environment.VARIABLE] == str(path)


def test_the_set_up_asks_for_a_library_by_a_function_that_is_there() -> None:
    setup = (Path(__file__).parents[3] / "scripts/setup.sh").read_text(encoding="utf-8")
    (line,) = re.findall(r"-c '(from mitsim.*?)'", setup)
    done = subprocess.run([sys.executable, "-c", line], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr

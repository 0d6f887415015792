"""LLVM selection. Tests with a real old library run only where one is installed; nothing here may crash."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from mitsim.core import environment
from mitsim.core.errors import MitsimError

DEBIAN = Path("/usr/lib/x86_64-linux-gnu")


def needs(name: str) -> Path:
    if not (DEBIAN / name).exists():
        pytest.skip(f"{name} is not installed here")
    return DEBIAN / name


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


def test_llvm_15_dies_in_the_child_and_is_reported() -> None:
    # LLVM 15 loads and then aborts the process while compiling; that this line is reached is half of the
    # test.
    result = environment.probe(needs("libLLVM-15.so.1"))
    assert "signal 6" in result and "\n" not in result


def test_the_library_of_this_machine_works() -> None:
    path = environment.select_llvm()
    assert (environment.version(path) or environment.OLDEST) >= environment.OLDEST
    assert os.environ[environment.VARIABLE] == str(path)


def test_the_set_up_asks_for_a_library_by_a_function_that_is_there() -> None:
    setup = (Path(__file__).parents[3] / "scripts/setup.sh").read_text(encoding="utf-8")
    (line,) = re.findall(r"-c '(from mitsim.*?)'", setup)
    done = subprocess.run([sys.executable, "-c", line], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr

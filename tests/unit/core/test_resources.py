"""Work that would take more than there is, or than is allowed, is refused in one line that says how much."""

import resource
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from mitsim.core import job
from mitsim.core.errors import MitsimError
from mitsim.core.job import Cost, Job, Limits, free_memory


def refusal(cost: Cost, limits: Limits, output: Path | None = None) -> str:
    with pytest.raises(MitsimError) as caught:
        cost.check("dots:7", limits, output)
    return str(caught.value)


def test_each_limit_is_named_with_what_is_allowed(tmp_path: Path) -> None:
    assert "about 90 s; allowed are 60 s" in refusal(Cost(seconds=90), Limits(seconds=60))
    assert "about 2 GiB of memory; allowed are 1 GiB" in refusal(Cost(memory_bytes=2**31), Limits(memory_bytes=2**30))
    line = refusal(Cost(disk_bytes=1e18), Limits(), tmp_path / "run")
    assert "would write about" in line and f"{tmp_path / 'run'} has" in line


def test_a_plan_that_takes_too_long_is_refused() -> None:
    job = Job(limits=Limits(seconds=0.01))
    refused = r"dots:3: was not planned within the 0.01 s that are allowed.*max_seconds"
    with pytest.raises(MitsimError, match=refused), job.planning("dots:3"):
        time.sleep(0.02)
    assert job.clock.seconds()["plan"] > 0.01


def test_free_memory_is_a_limit_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(job, "free_memory", lambda: 1e9)
    Cost(memory_bytes=0.89e9).check("dots:7", Limits(memory_bytes=1e15))
    refusal(Cost(memory_bytes=0.91e9), Limits(memory_bytes=1e15))


def test_a_control_group_counts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A container with 2 GiB of which 0.5 are in use has 1.5 left, whatever the machine has; "max" is no limit.

    Cache of files, another 0.25 GiB here, counts as in use, but is given back when it is needed.
    """
    (tmp_path / "memory.max").write_text(f"{2 * 2**30}\n")
    (tmp_path / "memory.current").write_text(f"{2**29 + 2**28}\n")
    (tmp_path / "memory.stat").write_text(f"anon {2**29}\ninactive_file {2**28}\n")
    monkeypatch.setattr(job, "_CGROUPS", ((tmp_path, *job._CGROUPS[0][1:]),))
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=10 * 2**30))
    assert free_memory() == 1.5 * 2**30
    (tmp_path / "memory.max").write_text("max\n")
    assert free_memory() == 10 * 2**30


def test_the_limit_of_the_process_counts() -> None:
    program = "from mitsim.core.job import free_memory; print(free_memory())"

    def bound() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (2**30, 2**30))

    out = subprocess.run([sys.executable, "-c", program], preexec_fn=bound, capture_output=True, text=True, check=True)
    assert 0 < float(out.stdout) < 2**30


@pytest.mark.parametrize("wrong", [{"seconds": 0.0}, {"seconds": float("nan")}, {"memory_bytes": -1.0}])
def test_limits_that_are_no_limits(wrong: dict[str, float]) -> None:
    with pytest.raises(MitsimError, match="above 0"):
        Limits(**wrong)

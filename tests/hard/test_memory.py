"""The memory that a capture is estimated to take, against what it took in a process of its own."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.robustness import Recorder

pytestmark = pytest.mark.robustness("Faults")
PROGRAM = """
import sys
from pathlib import Path
from mitsim.api.bench import open_bench
from mitsim.light.memory import frames_cost
from mitsim.core.configuration import shipped_path

def used():
    # Not getrusage: its peak is inherited from the process that started this one.
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024.0 for line in lines if line.startswith("VmHWM"))

bench = open_bench(shipped_path("scenes", sys.argv[1], "scene.xml"))
before = used()
plan = bench.plan(sys.argv[2], accuracy=float(sys.argv[4]))
bench.capture(plan, sys.argv[3])
cost = frames_cost(bench, plan.settings, bench.family(sys.argv[2]).lighting)
written = sum(path.stat().st_size for path in Path(sys.argv[3]).glob("*.exr"))
print(used() - before, cost.memory_bytes, written, cost.disk_bytes)
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux's /proc")
@pytest.mark.parametrize(
    ("scene", "patterns", "accuracy"),
    [("photograph", "dots:7", 1e-3), ("photograph", "hadamard:8", 1e-3), ("cookie_bag", "dots:7", 5e-3)],
)
def test_the_estimate_is_an_upper_one_within_a_factor_of_three(
    measured: Recorder, variant: str, tmp_path: Path, scene: str, patterns: str, accuracy: float
) -> None:
    arguments = [sys.executable, "-c", PROGRAM, scene, patterns, str(tmp_path / "run"), str(accuracy)]
    done = subprocess.run(arguments, capture_output=True, text=True, check=True)
    taken, estimated, written, on_disk = map(float, done.stdout.split())
    measured(estimated / taken, at_least=1, at_most=3, what="estimated for what was taken")
    assert on_disk / 1.1 < written <= on_disk

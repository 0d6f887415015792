"""Our figures against those of the `emva1288` reference package, release 4.0, on the same frames.

The package needs NumPy 1, so it is installed into an environment of its own, once for a session.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.seeds import stream
from mitsim.devices.sensor import SensorModel
from mitsim.sensor.chain import expose
from mitsim.sensor.emva import Session, alike, figures
from tests.invented import sensor

pytestmark = pytest.mark.slow
PACKAGES = ("emva1288==1.0.2", "numpy<2", "scipy<1.14", "lxml", "pillow", "matplotlib")
DRIVER = Path(__file__).with_name("emva_reference.py")
SHAPE, STEPS, STACK = (90, 120), 50, 20
HALF = 10_000.0


@pytest.fixture(scope="module")
def reference_python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("emva1288")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", place], check=True)
    python = place / "bin" / "python"
    pip = sys.executable, "-m", "pip", "--python", python
    installed = subprocess.run([*pip, "install", "-q", "--no-compile", *PACKAGES], capture_output=True, text=True)
    if installed.returncode:
        pytest.skip(f"emva1288 cannot be installed here: {installed.stderr.strip().splitlines()[-1:]}")
    return python


@pytest.mark.parametrize("bent", [(), (-0.02, 0.01)])
def test_the_reference_package_agrees_on_the_same_frames(
    reference_python: Path, tmp_path: Path, bent: tuple[float, ...]
) -> None:
    """Estimators of the same definition: equal to rounding, but where the definitions differ and that is small.

    The package divides a pair's variance by n, ours by n - 1 (1e-4 of it), so gain and what is divided by it differ by
    that; the same of a stack's noise, of which 1/20 is taken off.
    """
    model = sensor(
        full_well_e=20_000.0, read_noise_e=4.0, gain_dn_per_e=0.19, black_level_dn=60.0, bits=12, dsnu_pixel_e=3.0,
        dsnu_row_e=1.5, dsnu_column_e=2.0, prnu_pixel=0.01, prnu_row=0.003, prnu_column=0.004, linearity=bent,
    )  # fmt: skip
    # Two steps are saturated: the package looks for the largest variance from the last step down, and stops at a local
    # one, so noise among more of them would end its search.
    light = 20_800.0 * np.arange(1, STEPS + 1) / STEPS
    ladder = np.array([[frame(model, e, "ladder", i, side) for side in (0, 1)] for i, e in enumerate(light)])
    dark = np.array([frame(model, 0.0, "dark", side) for side in (0, 1)])
    stacks = [np.array([frame(model, e, "stack", e, i) for i in range(STACK)]) for e in (0.0, HALF)]
    given = tmp_path / "frames.npz"
    np.savez(given, ladder=ladder, photons=light, dark=dark, dark_stack=stacks[0], bright_stack=stacks[1], half=HALF)
    ran = subprocess.run([reference_python, DRIVER, given], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    reference = json.loads(ran.stdout.splitlines()[-1])
    pairs = [alike(pair) for pair in (*ladder, dark)]
    sets = [np.array([getattr(pair, name) for pair in pairs]) for name in ("mean", "variance", "rows")]
    of_stacks = [alike(stack).stack for stack in stacks]
    found = figures(Session(SHAPE, np.append(light, 0.0), np.zeros(STEPS + 1), *sets, STEPS, STEPS // 2, *of_stacks))
    for name, value in reference.items():
        # Rows and columns: both leave out 1/M of their variance; differences of variances cancel to some 1e-3 of them.
        assert float(found[name]) == pytest.approx(value, rel=2e-3, abs=1e-7), name


def frame(model: SensorModel, electrons: float, *names: object) -> np.ndarray:
    rngs = (stream(1288, noise, *map(str, names)) for noise in ("shot", "read"))
    return np.asarray(expose(np.full(SHAPE, electrons), 0.0, model, *rngs), dtype=np.int64)

"""Who may import whom (the house rules), read from the source text, and that importing mitsim does nothing.

Exceptions to the general rule - a stage imports only core - carry their reason here.
"""

import ast
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import mitsim

PACKAGE = Path(mitsim.__file__).parent
STAGES = {"scene", "transport", "optics", "sensor", "reconstruct"}
GROUND = {"core", "rig"}
ALLOWED = {
    "core": set(),
    # Pure data: what the devices are. Every stage may see it.
    "rig": {"core"},
    **{stage: GROUND for stage in STAGES},
    # The factored estimator ends in the closed-form shadow.
    "transport": GROUND | {"optics"},
    # The composer: it alone sees all stages of a capture, and hands a session's responses to the calibration.
    "capture": GROUND | STAGES,
    "study": GROUND | {"capture", "reconstruct", "optics", "sensor"},
    "cli": GROUND | {"capture", "study"} | STAGES,
    "__main__": {"cli", "core"},
}
MITSUBA_ROOMS = ("mitsim.scene", "mitsim.transport", "mitsim.capture", "mitsim.core.environment")
RENDERER = {"mitsuba", "drjit"}


def imports_of(module: str, source: str, is_package: bool) -> list[str]:
    """Absolute dotted names of everything a module imports, anywhere in its text (lazy imports count)."""
    package = module.split(".") if is_package else module.split(".")[:-1]
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            found += [f"{stem}.{alias.name}" for alias in node.names]
    return found


def violations(module: str, source: str, is_package: bool = False) -> list[str]:
    room = module.split(".")[1] if "." in module else ""
    broken = []
    for name in imports_of(module, source, is_package):
        parts = name.split(".")
        in_rooms = any(module == place or module.startswith(place + ".") for place in MITSUBA_ROOMS)
        if parts[0] in RENDERER and not in_rooms:
            broken.append(f"{module} imports {name}: only {', '.join(MITSUBA_ROOMS)} may")
        if parts[0] != "mitsim" or len(parts) == 1 or parts[1] == "__version__":
            continue
        if room == "" or (parts[1] != room and parts[1] not in ALLOWED.get(room, set())):
            broken.append(f"{module} imports {name}: {room or 'mitsim'} may import {ALLOWED.get(room)}")
    return broken


def modules() -> list[tuple[str, Path]]:
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = ["mitsim", *path.relative_to(PACKAGE).with_suffix("").parts]
        found.append((".".join(parts[:-1] if parts[-1] == "__init__" else parts), path))
    return found


def test_import_directions() -> None:
    broken = [
        line
        for name, path in modules()
        for line in violations(name, path.read_text(encoding="utf-8"), path.name == "__init__.py")
    ]
    assert not broken, "\n".join(broken)


def test_every_room_has_rules() -> None:
    rooms = {name.split(".")[1] for name, _ in modules() if "." in name}
    assert rooms <= set(ALLOWED), f"no import rule for {rooms - set(ALLOWED)}"


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("mitsim.core.seeds", "from mitsim.rig import mask"),
        ("mitsim.sensor.chain", "def f():\n    from ..optics import shadow"),
        ("mitsim.sensor.chain", "from mitsim import scene"),
        ("mitsim.reconstruct.calibration", "import mitsim.sensor.chain"),
        ("mitsim.reconstruct.solver", "import drjit"),
        ("mitsim.core.llvm", "import mitsuba as mi"),
        ("mitsim.rig.camera", "from mitsim.optics import shadow"),
        ("mitsim.study.report", "from mitsim.scene.load import load_scene"),
        ("mitsim.sensor.chain", "from mitsim.capture.plan import Settings"),
        ("mitsim", "from mitsim import core"),
    ],
)
def test_the_rules_catch_a_planted_violation(module: str, source: str) -> None:
    assert violations(module, source)


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("mitsim.transport.direct", "import mitsuba\nfrom mitsim.optics import shadow"),
        ("mitsim.core.environment", "import mitsuba"),
        ("mitsim.sensor.chain", "from . import model\nfrom ..core import units"),
        ("mitsim.core.manifest", "import mitsim"),
    ],
)
def test_the_rules_let_through_what_is_allowed(module: str, source: str) -> None:
    assert not violations(module, source)


def test_importing_mitsim_imports_nothing_else() -> None:
    program = "import sys, mitsim; assert not {'mitsuba', 'drjit', 'numpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)


def test_importing_every_module_selects_no_variant_and_touches_no_global_state() -> None:
    names = [m.name for m in pkgutil.walk_packages(mitsim.__path__, "mitsim.") if "__main__" not in m.name]
    program = f"""
import importlib, os, random, sys
import numpy
before = (dict(os.environ), random.getstate(), str(numpy.random.get_state()), numpy.geterr())
for name in {names!r}:
    importlib.import_module(name)
assert before == (dict(os.environ), random.getstate(), str(numpy.random.get_state()), numpy.geterr())
if "mitsuba" in sys.modules:
    assert sys.modules["mitsuba"].variant() is None, sys.modules["mitsuba"].variant()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not done.stdout, "importing prints"

"""Who may import whom (the house rules), read from the source text, and that importing mitsim does nothing.

The table of rooms in docs/architecture.md says the same. Exceptions to the general rule - a stage imports only core and
rig - carry their reason here.
"""

import ast
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import mitsim
from mitsim.core.configuration import shipped
from tests.exchanged import made

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
    # Files for others are of runs and of factors.
    "exchange": GROUND | {"reconstruct"},
    "study": GROUND | {"capture", "reconstruct", "optics", "sensor"},
    "cli": GROUND | {"capture", "study", "exchange"} | STAGES,
    "__main__": {"cli", "core"},
    # The face, `mitsim` itself: names for type checkers alone; what a user asks for is imported when it is asked for.
    "": set(),
}
FACE = GROUND | STAGES | {"capture", "study"}
"""Rooms whose names the face may give to type checkers."""
MITSUBA_ROOMS = ("mitsim.scene", "mitsim.transport", "mitsim.capture", "mitsim.core.environment")
RENDERER = {"mitsuba", "drjit"}
CHECKS_A_REQUEST = (
    "mitsim.cli",
    "mitsim.capture.request",
    "mitsim.core.manifests",
    "mitsim.core.imagelist",
    "mitsim.rig.sensor",
    "mitsim.rig.recipe",
    "mitsim.rig.framelist",
    "mitsim.exchange.export",
    "mitsim.exchange.load",
    "mitsim.exchange.known",
)
"""What looks at words, manifests and lists before work begins."""


def imports_of(module: str, source: str | ast.AST, is_package: bool) -> list[str]:
    """Absolute dotted names of everything a module imports, anywhere in its text (lazy imports count)."""
    package = module.split(".") if is_package else module.split(".")[:-1]
    found = []
    for node in ast.walk(ast.parse(source) if isinstance(source, str) else source):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            found += [f"{stem}.{alias.name}" for alias in node.names]
    return found


def for_type_checkers(source: str) -> tuple[ast.Module, ast.Module]:
    """A module without its `if TYPE_CHECKING:` blocks at the top level, and these blocks alone."""
    tree = ast.parse(source)
    blocks = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    assert not any(block.orelse for block in blocks)
    rest = [node for node in tree.body if node not in blocks]
    return ast.Module(rest, []), ast.Module([node for block in blocks for node in block.body], [])


def violations(module: str, source: str, is_package: bool = False) -> list[str]:
    if module != "mitsim":
        return broken_rules(module, imports_of(module, source, is_package), ALLOWED)
    run, checked = (imports_of(module, part, True) for part in for_type_checkers(source))
    return broken_rules(module, run, ALLOWED) + broken_rules(module, checked, {"": FACE})


def broken_rules(module: str, names: list[str], allowed: dict[str, set[str]]) -> list[str]:
    """A sentence for each of the imported ``names`` that a module's room may not import."""
    room = module.split(".")[1] if "." in module else ""
    broken = []
    for name in names:
        parts = name.split(".")
        in_rooms = any(module == place or module.startswith(place + ".") for place in MITSUBA_ROOMS)
        if parts[0] in RENDERER and not in_rooms:
            broken.append(f"{module} imports {name}: only {', '.join(MITSUBA_ROOMS)} may")
        if parts[0] != "mitsim" or len(parts) == 1 or parts[1] == "__version__":
            continue
        if parts[1] != room and parts[1] not in allowed.get(room, set()):
            broken.append(f"{module} imports {name}: {room or 'mitsim'} may import {allowed.get(room)}")
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
    rooms = {"", *(name.split(".")[1] for name, _ in modules() if "." in name)}
    assert rooms == set(ALLOWED), f"rooms and rules differ: {rooms ^ set(ALLOWED)}"


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
        ("mitsim.study.report", "from mitsim.transport import source"),
        ("mitsim.exchange.hdf5", "from mitsim.capture.bench import Bench"),
        ("mitsim.reconstruct.factors", "from mitsim.exchange.packed import Packed"),
        ("mitsim.rig.recipe", "def f():\n    from mitsim.capture import bench"),
        ("mitsim.scene.load", "if TYPE_CHECKING:\n    from mitsim.capture.bench import Bench"),
        ("mitsim.__main__", "import mitsim.capture.bench"),
        ("mitsim", "from mitsim import core"),
        ("mitsim", "def __getattr__(name):\n    from mitsim.capture.bench import open_bench"),
        ("mitsim", "if TYPE_CHECKING:\n    from mitsim.cli import app"),
        ("mitsim", "if TYPE_CHECKING:\n    import mitsuba"),
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
        ("mitsim.core.jsonfile", "import mitsim"),
        ("mitsim.reconstruct.factors", "from mitsim.rig.patterns import PatternFamily"),
        ("mitsim.cli", "def f():\n    from mitsim.study.demo import demo"),
        ("mitsim", "if TYPE_CHECKING:\n    from mitsim.capture.bench import Bench"),
    ],
)
def test_the_rules_let_through_what_is_allowed(module: str, source: str) -> None:
    assert not violations(module, source)


def test_importing_mitsim_imports_nothing_else() -> None:
    program = "import sys, mitsim; assert not {'mitsuba', 'drjit', 'numpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)


def test_what_checks_a_request_imports_no_numpy() -> None:
    """Half the time of a refusal would be numpy's."""
    rooms = ", ".join(CHECKS_A_REQUEST)
    program = f"import sys, {rooms}; assert 'numpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True)


WITHOUT_NUMPY = (
    "export none --format hdf5 -o x.h5",
    "export bad --format hdf5 -o x.h5",
    "export bad --format hdf6 -o x.h5",
    "export made/run --format mat -o x.h5",
    "export made/run --format hdf5 -o x.mat",
    "import none -o r",
    "import none.mat -o r",
    "import none.h5 -o r",
    "import bad -o r --camera imx249 --exposure 1 --patterns dots:3 --calibration bad",
    "import bad -o r --camera imx249 --exposure 1 --patterns dotz:3 --projector-pixels 8",
    "import bad -o r --camera imx249 --exposure 1 --patterns dots:3 --projector-pixels 8",
    "import bad -o r --camera imx249 --exposure 1 --patterns none.json --projector-pixels 8",
    "import bad -o r --camera imx249 --exposure 1 --patterns uniform --projector-pixels 0",
    "import bad -o r --camera imx249 --exposure 1 --patterns uniform --projector-pixels 8 --seed -1",
    "calibrate --frames none -o c",
    "calibrate --frames bad -o c",
    "calibrate photograph --model wave --frames bad -o c",
    "calibrate photograph --model wave -o full",
    "calibrate photograph -o full",
    "calibrate photograph -o full --resume",
    "calibrate photograph -o none/c",
    "calibrate photograph -o c --write-frames full",
    "calibrate photograph -o c --write-frames f --recipe depths.toml",
    "calibrate photograph -o c --colour mosaic",
    "calibrate photograph -o c --camera endless.toml",
    "calibrate photograph -o c --camera imx249_rggb",
    "calibrate photograph --plan --psnr 35 --camera endless.toml",
    "capture photograph --patterns dots:3 -o full",
    "capture photograph --patterns dots:3 -o full --resume",
    "capture photograph --patterns dots:3 -o none/r",
    "capture photograph --patterns dots:3 -o x.txt",
    "capture photograph --patterns dots:3 -o full --colour auto",
    "capture photograph --patterns dots:3 -o full --colour lines",
    "calibrate photograph -o full --colour lines",
    "capture photograph --patterns dots:3 -o full --colour mosaic --camera imx249_rggb",
    "capture photograph --patterns dots:3 -o r --colour auto --seconds 5",
    "capture photograph --patterns dots:3 -o r --colour auto --variant llvm_ad_spectral",
    "capture photograph --patterns dots:3 -o r --colour lines --seconds 5",
    "capture photograph --patterns dots:3 -o r --camera endless.toml",
    "capture photograph --patterns dots:3 -o r --camera slip.toml",
    "capture photograph --patterns hadamard:7 -o r",
    "capture photograph --patterns dots:200 -o r",
    "capture photograph --patterns dots:3 -o made/cal --resume",
    "capture photograph --patterns dots:3 -o made/run --resume --colour lines",
    "calibrate photograph -o made/run --resume",
    "calibrate photograph --plan --psnr 35 --patterns dots:200",
    "plan photograph --patterns dots:1x129",
    "demo -o r --patterns hadamard:256",
    "transport photograph -o x.h5 --patterns random:129",
    "plan photograph --colour auto --seconds 5",
    "plan photograph --colour bands:2 --seconds 5",
    "demo -o full",
    "demo -o r --camera endless.toml",
    "render photograph -o x.exr --estimator fast",
    "render photograph -o x.exr --spp 0",
    "transport photograph -o x.txt",
    "sense x.npy --camera imx249 -o y.png",
    "sense x.txt --camera imx249 -o y.png",
    "sense x.txt --camera imx249 -o y.jpg",
    "sense x.txt --camera imx249 -o y.png --wavelength 0",
    "sense x.txt --camera imx249 -o y.png --f-number 0.1",
    "characterise imx249 -o full",
    "characterise imx249 -o r --pixels 3",
    "characterise imx249 -o r --seed -1",
    "characterise imx249 -o r --wavelength nan",
    "reconstruct bad --calibration bad",
    "reconstruct made/run --calibration made/cal -o r --lambda -1",
    "reconstruct made/run --calibration made/cal -o r --method wiener",
    "reconstruct made/run --calibration made/cal -o r --focus map --method tv",
    "reconstruct made/run --calibration made/cal -o r --focus 400",
    "reconstruct made/run --calibration made/cal -o r --margin 2",
    "reconstruct made/run --calibration made/cal -o full",
    "reconstruct made/run --calibration made/cal -o none/r",
    "patterns dotz:3 -o p",
    "patterns dots:3 -o p --seed -1",
    "study weather -o s",
    "study sweep photograph -o s --over x=1:2:3",
    "study sweep photograph -o s --over patterns=dots:3,dotz:3",
    "study sweep photograph -o s --over seed=-1",
    "study sweep photograph -o s --over accuracy=0,1",
    "study sweep photograph -o s --over sheet_z=1:2:3 --measure speed",
    "study sweep -o s",
    "study drift -o s --over x=1",
    "study all photograph -o s -D x=1",
    "study all photograph -o s --shard 2/1",
    "study patterns -o s --camera none",
    "study patterns -o s --camera slip.toml",
    "study patterns -o s --seed -1",
    "study accuracy photograph -o s -D x=1",
    "study accuracy photograph -o s --over x=1:2:3",
    "study accuracy photograph -o s --patterns dots:200",
    "study sweep photograph -o s --over patterns=dots:3,dots:200",
    "study sweep photograph -o s --patterns dots:200 --over sheet_z=400,410",
    "study sweep photograph -o s --over sheet_z=400,nan",
    "study patterns -o s --camera endless.toml",
    "study all -o s --camera endless.toml",
    "study drift -o s --camera endless.toml",
    "study accuracy photograph -o full",
    "study calibration photograph -o s --camera endless.toml",
    "study solver -o full",
    "study merge bad -o s",
)
"""Of a folder that is missing or holds something, a bad manifest, and words that are not known."""
WITHOUT_RENDERER = (
    "study sweep photograph -o full --over sheet_z=1:2:3",
    "study drift -o full",
    "study colour -o full",
    "study all -o full",
    "study patterns -o full",
    "plan photograph --projector slip.toml",
    "study patterns -o s --projector slip.toml",
    "plan photograph --camera imx249_rggb",
    "capture photograph --patterns dots:3 -o r --colour bands:4",
    "capture photograph --patterns dots:3 -o r --colour lines --projector rainbow.toml",
    "calibrate photograph -o c --colour lines --projector rainbow.toml",
    "calibrate photograph -o c -D mask=flatcam --camera masked.toml",
)
"""The same of models that count in numpy's arrays."""


@pytest.fixture(scope="module")
def refusing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with inputs that cannot be used, a run and its calibration."""
    folder = tmp_path_factory.mktemp("refusing")
    (folder / "x.txt").write_text("mine")
    (folder / "full").mkdir()
    (folder / "full" / "letter.txt").write_text("mine")
    (folder / "bad").mkdir()
    (folder / "bad" / "manifest.json").write_text("{}")
    (folder / "bad" / "session.toml").write_text("n = 4")
    camera = shipped("calibration", "imx249.toml").read_text()
    (folder / "endless.toml").write_text(re.sub(r"(?m)^full_well_e = .*", "full_well_e = inf", camera))
    (folder / "slip.toml").write_text(re.sub(r"(?m)^bits = .*", "bits = 5", camera))
    (folder / "masked.toml").write_text(f'{camera}\n[mask]\nkind = "separable"\nfeature_mm = 0.03\n')
    waves = range(450, 651, 50)
    (folder / "rainbow.toml").write_text(
        f'name = "x"\neffective_wavelength_nm = 550\nwavelengths_nm = {[float(wave) for wave in waves]}\n'
        f"radiant_shares = {[0.2 for _ in waves]}\n"
    )
    recipe = shipped("calibration", "session.toml").read_text()
    (folder / "depths.toml").write_text(f"depths = [350.0, 400.0]\n{recipe}")
    made(folder / "made")
    return folder


@pytest.mark.parametrize(
    ("lines", "heavy"),
    [
        (WITHOUT_NUMPY, {"numpy"}),
        (WITHOUT_RENDERER, {"mitsuba", "drjit", "scipy", "matplotlib", "skimage"}),
    ],
    ids=["numpy", "renderer"],
)
def test_a_refusal_imports_nothing_heavy(refusing: Path, lines: tuple[str, ...], heavy: set[str]) -> None:
    """And leaves nothing behind. (Planted: the name of the patterns read by `parse_patterns`; the manifest of export
    read by `packed_run`; outputs, patterns or full wells looked at once the bench is open; a check of an output that
    leaves its folder.)"""
    before = sorted(refusing.rglob("*"))
    program = f"""
import sys
from mitsim.cli import run
for line in {lines!r}:
    sys.argv = ["mitsim", *line.split()]
    try:
        run()
    except SystemExit as ended:
        assert ended.code == 2, line
    assert not {heavy!r} & set(sys.modules), line
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=refusing, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("mitsim: ") == len(lines)
    assert sorted(refusing.rglob("*")) == before


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


BACKENDS = re.compile(r"llvm|cuda|thread_count", re.IGNORECASE)
KNOWS_BACKENDS = {
    "mitsim.core.llvm": "finds the library",
    "mitsim.core.environment": "chooses the variant",
    "mitsim.cli.options": "says in the help what there is to choose",
}
SUMS = {"sum", "mean", "prod", "prefix_sum", "cumsum", "block_sum", "block_reduce", "block_prefix_sum", "reduce"}
OF_A_LANE = {
    "mitsim.transport.sampling": "the channels of a spectrum",
    "mitsim.transport.grating": "the orders of a grating",
}


def named(tree: ast.AST) -> list[str]:
    """Names, attributes, imports and strings of a module, but for docstrings."""
    found, texts = [], set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            texts.add(id(node.value))  # walked before what it holds; what stands below a constant, too
        if isinstance(node, ast.Name | ast.Attribute):
            found.append(node.id if isinstance(node, ast.Name) else node.attr)
        elif isinstance(node, ast.ImportFrom | ast.alias):
            found.append((node.module if isinstance(node, ast.ImportFrom) else node.name) or "")
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in texts:
            found.append(node.value)
    return found


def names_a_backend(module: str, source: str) -> bool:
    return module not in KNOWS_BACKENDS and any(BACKENDS.search(name) for name in named(ast.parse(source)))


def sums_lanes(module: str, source: str) -> list[str]:
    """Sums that Dr.Jit would add up over lanes, in the lanes' own 32 bits."""
    if module in OF_A_LANE:
        return []
    calls = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call))
    narrow = (call.func for call in calls if not in_double_precision(call))
    found = (call for call in narrow if isinstance(call, ast.Attribute) and call.attr in SUMS)
    return [call.attr for call in found if isinstance(call.value, ast.Name) and call.value.id in ("dr", "drjit")]


def in_double_precision(call: ast.Call) -> bool:
    """Whether what is added up has been turned into 64 bits in the call itself."""
    first = call.args[0] if call.args else None
    return isinstance(first, ast.Call) and isinstance(first.func, ast.Attribute) and first.func.attr == "Float64"


def test_no_module_but_core_knows_a_backend() -> None:
    """All others take their types from the variant in use, so that they run on any."""
    assert not [name for name, path in modules() if names_a_backend(name, path.read_text(encoding="utf-8"))]
    for planted in ("from drjit.llvm import Float", "mi.set_variant('llvm_ad_mono')", "dr.set_thread_count(2)"):
        assert names_a_backend("mitsim.transport.direct", planted)
    assert not names_a_backend("mitsim.transport.direct", '"""Runs on LLVM."""\nimport mitsuba as mi')


def test_lanes_are_not_added_up_in_32_bits() -> None:
    """Light is added up on the device in whole numbers or floats of 64 bits, or on the host in double precision."""
    assert not [name for name, path in modules() if sums_lanes(name, path.read_text(encoding="utf-8"))]
    assert sums_lanes("mitsim.transport.flux", "total = dr.sum(light)") == ["sum"]
    assert not sums_lanes("mitsim.transport.flux", "total = dr.block_sum(mi.Float64(light), 4)")

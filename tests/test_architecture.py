"""Who may import whom (the house rules), read from the source text, and that importing mitsim does nothing.

Rooms stand on floors: a file imports from floors below its own room, or inside its room, and nowhere is there a circle
between files. Imports in functions and those for type checkers count. docs/architecture.md says the same.
"""

import ast
import importlib.machinery
import io
import operator
import pkgutil
import re
import subprocess
import sys
import tokenize
from collections import defaultdict
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import pytest

import mitsim
from mitsim.core.configuration import shipped_path
from tests.exchanged import made

pytestmark = pytest.mark.usefixtures("trees")
PACKAGE = Path(mitsim.__file__).parent
FLOORS = (
    "version",
    "core",
    "devices",
    "scene sensor optics reconstruct",
    "transport metrics",
    "bench",
    "light",
    "planner",
    "acquire",
    "calibrate",
    "design report",
    "api",
    "learn",
    "studies",
    "exchange",
    "verbs",
    "sessions",
    # The command line stands on the face, as a user's own program does.
    "mitsim",
    "cli",
    "__main__",
)
"""Rooms, and files that stand by themselves, from the ground up."""
FLOOR = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms.split()}
MITSUBA_ROOMS = (
    "mitsim.scene",
    "mitsim.transport",
    "mitsim.bench",
    "mitsim.light",
    "mitsim.planner",
    "mitsim.acquire",
    "mitsim.core.environment",
)
RENDERER = {"mitsuba", "drjit"}
CHECKS_A_REQUEST = (
    "mitsim.cli",
    "mitsim.bench.request",
    "mitsim.core.manifests",
    "mitsim.core.colour_files",
    "mitsim.core.picture_files",
    "mitsim.devices.sensor",
    "mitsim.devices.session",
    "mitsim.devices.framelist",
    "mitsim.exchange.formats",
    "mitsim.exchange.capture_list",
    "mitsim.learn.requests",
)
"""What looks at words, manifests and lists before work begins."""


@cache
def parsed(source: str) -> ast.Module:
    """The tree of a text, which several tests walk; nobody changes it."""
    return ast.parse(source)


@cache
def imports_of(module: str, source: str, is_package: bool) -> list[str]:
    """Absolute dotted names of everything a module imports, anywhere in its text."""
    package = module.split(".") if is_package else module.split(".")[:-1]
    found = []
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            found += [f"{stem}.{alias.name}" for alias in node.names]
    return found


def room_of(name: str) -> str:
    """The room of a module or of a name in it: the face is ``mitsim``."""
    parts = name.split(".")
    return parts[1] if len(parts) > 1 and parts[1] in FLOOR else "mitsim"


def violations(module: str, source: str, is_package: bool = False) -> list[str]:
    """A sentence for each import of a module that the house does not allow."""
    broken = []
    for name in imports_of(module, source, is_package):
        top = name.split(".")[0]
        in_rooms = any(module == place or module.startswith(place + ".") for place in MITSUBA_ROOMS)
        if top in RENDERER and not in_rooms:
            broken.append(f"{module} imports {name}: only {', '.join(MITSUBA_ROOMS)} may")
        own, other = room_of(module), room_of(name)
        if top == "mitsim" and own != other and FLOOR[other] >= FLOOR[own]:
            broken.append(f"{module} imports {name}: {other} is not below {own}")
    return broken


def modules() -> list[tuple[str, Path]]:
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = ["mitsim", *path.relative_to(PACKAGE).with_suffix("").parts]
        found.append((".".join(parts[:-1] if parts[-1] == "__init__" else parts), path))
    return found


def sources() -> dict[str, tuple[str, bool]]:
    """Text of every module, and whether it is a package, by its name."""
    return {name: (path.read_text(encoding="utf-8"), path.name == "__init__.py") for name, path in modules()}


def circles(texts: Mapping[str, tuple[str, bool]]) -> list[list[str]]:
    """Modules that import each other, over however many others."""
    graph = {}
    for module, (source, is_package) in texts.items():
        named = imports_of(module, source, is_package)
        ends = {name if name in texts else name.rpartition(".")[0] for name in named}
        graph[module] = (ends & set(texts)) - {module}
    below: dict[str, set[str]] = {}
    for start in graph:
        seen, left = set(), list(graph[start])
        while left:
            if (at := left.pop()) not in seen:
                seen.add(at)
                left += graph[at]
        below[start] = seen
    return sorted({tuple(sorted(b for b in below[a] if a in below[b])) for a in graph if a in below[a]})  # type: ignore[arg-type]


def test_import_directions() -> None:
    broken = [line for name, (source, package) in sources().items() for line in violations(name, source, package)]
    assert not broken, "\n".join(broken)


def test_no_file_imports_itself_over_others() -> None:
    """(Planted: a name of the bench asked of the light, for type checkers alone, in a function.)"""
    texts = sources()
    assert not circles(texts)
    source, package = texts["mitsim.bench.apparatus"]
    for planted in (
        "\nfrom mitsim.light.light import SampledLight\n",
        "\ndef f():\n    from mitsim.light.light import SampledLight\n",
        "\nif TYPE_CHECKING:\n    from mitsim.light.light import SampledLight\n",
    ):
        found = circles({**texts, "mitsim.bench.apparatus": (source + planted, package)})
        assert any("mitsim.bench.apparatus" in circle and "mitsim.light.light" in circle for circle in found)


def test_every_room_has_a_floor() -> None:
    rooms = {name.split(".")[1] for name, _ in modules() if "." in name} | {"mitsim"}
    assert rooms == set(FLOOR), f"rooms and floors differ: {rooms ^ set(FLOOR)}"


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("mitsim.core.arrays", "from mitsim.devices import mask"),
        ("mitsim.sensor.chain", "def f():\n    from ..optics import shadow"),
        ("mitsim.sensor.chain", "from mitsim import scene"),
        ("mitsim.reconstruct.factors", "import mitsim.sensor.chain"),
        ("mitsim.reconstruct.solver", "import drjit"),
        ("mitsim.core.manifests", "import mitsuba as mi"),
        ("mitsim.devices.camera", "from mitsim.optics import shadow"),
        ("mitsim.sensor.chain", "from mitsim.light.settings import Settings"),
        ("mitsim.bench.apparatus", "from mitsim.light.light import SampledLight"),
        ("mitsim.planner.planner", "from mitsim.acquire.capture import capture"),
        ("mitsim.acquire.capture", "from mitsim.api.bench import Bench"),
        ("mitsim.reconstruct.factors", "from mitsim.exchange.packed import Packed"),
        ("mitsim.devices.session", "def f():\n    from mitsim.bench import apparatus as bench"),
        ("mitsim.scene.load", "if TYPE_CHECKING:\n    from mitsim.bench.apparatus import Apparatus"),
        ("mitsim.report.folder_page", "from mitsim.studies.demo import demo"),
        ("mitsim.core.files", "import mitsim"),
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
        ("mitsim.sensor.chain", "from . import moments\nfrom ..core import arrays"),
        ("mitsim.reconstruct.factors", "from mitsim.devices.patterns import PatternFamily"),
        ("mitsim.cli", "import mitsim\ndef f():\n    from mitsim.studies.demo import demo"),
        ("mitsim", "if TYPE_CHECKING:\n    from mitsim.api.bench import Bench"),
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


SLOW_TO_IMPORT = {
    "scipy.special",
    "scipy.fft",
    "scipy.linalg",
    "scipy.ndimage",
    "matplotlib",
    "skimage",
    "h5py",
    "rich",
}
"""What a capture can do without: 0.02 to 0.5 s each. scipy.sparse, 0.05 s, holds its light."""


def test_what_a_capture_is_made_of_is_soon_imported() -> None:
    """(Planted: Fresnel's integrals imported from scipy.special.)"""
    rooms = "mitsim.cli, mitsim.api.bench, mitsim.acquire.spectral, mitsim.acquire.capture, mitsim.transport.plugins"
    program = f"import sys, {rooms}; assert not {SLOW_TO_IMPORT!r} & set(sys.modules), sys.modules.keys()"
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.slow
def test_a_capture_imports_nothing_slow(small_scene: Callable[..., Path], tmp_path: Path) -> None:
    """Nor where it is used. (Planted: the same inside the function that uses them.)"""
    options = "--patterns", "dots:2", "--accuracy", "0.01", "--effects=+diffraction", "--no-pictures"
    command = "capture", small_scene(), "-o", tmp_path / "run", *options
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "mitsim", *map(str, command)], capture_output=True, text=True
    )
    assert done.returncode in (0, 1), done.stderr[-1000:]
    names = [name.split(".") for name in re.findall(r"\| +([\w.]+)$", done.stderr, re.MULTILINE)]
    imported = {
        ".".join(name[:parts]) for name in names for parts in (1, 2)
    }  # packages that are loaded late have no line
    assert "mitsim.optics" in imported and not SLOW_TO_IMPORT & imported


WITHOUT_NUMPY = (
    "export none --format hdf5 -o x.h5",
    "export bad --format hdf5 -o x.h5",
    "export made/run --format mat -o x.h5",
    "import none.h5 -o r",
    "import bad -o r --camera imx249 --exposure 1 --patterns dots:3 --calibration bad",
    "import bad -o r --camera imx249 --exposure 1 --patterns none.json --projector-pixels 8",
    "import bad -o r --camera imx249 --exposure 1 --patterns uniform --projector-pixels 0",
    "calibrate --frames bad -o c",
    "calibrate photograph --model wave --frames bad -o c",
    "calibrate photograph -o full",
    "calibrate photograph -o full --resume",
    "calibrate photograph -o c --write-frames f --recipe depths.toml",
    "calibrate photograph -o c --camera endless.toml",
    "calibrate photograph --plan --psnr 35 --camera endless.toml",
    "capture photograph --patterns dots:3 -o full",
    "capture photograph --patterns dots:3 -o x.txt",
    "capture photograph --patterns dots:3 -o full --colour lines",
    "capture photograph --patterns dots:3 -o full --colour mosaic --camera imx249_rggb",
    "capture photograph --patterns dots:3 -o r --camera endless.toml",
    "capture photograph --patterns dots:200 -o r",
    "capture photograph --patterns dots:3 -o made/cal --resume",
    "capture photograph --patterns dots:3 -o made/run --resume --colour lines",
    "plan photograph --patterns dots:1x129",
    "transport photograph -o x.h5 --patterns random:129",
    "demo -o full",
    "view photograph -o x.jpg",
    "view photograph -D nosuch=1",
    "render photograph -o x.exr --estimator fast",
    "transport photograph -o x.txt",
    "pairs photograph --count 5 -o full",
    "pairs photograph --count 5 -o p --pictures none",
    "pairs photograph --count 5 -o p --patterns dots:200",
    "sense x.npy --camera imx249 -o y.png",
    "sense x.txt --camera imx249 -o y.png --f-number 0.1",
    "characterise imx249 -o full",
    "characterise imx249 -o r --wavelength nan",
    "reconstruct bad --calibration bad",
    "reconstruct made/run --calibration made/cal -o r --method wiener",
    "reconstruct made/run --calibration made/cal -o r --focus 400",
    "reconstruct made/run --calibration made/cal -o full",
    "reconstruct made/run --calibration made/cal -o r --method none.pt",
    "train unroled bad -o m.pt",
    "train unrolled bad -o m.pt",
    "train unrolled bad --calibration bad -o full/m.pt --rate 0",
    "patterns dotz:3 -o p",
    "study weather -o s",
    "study sweep photograph -o s --over patterns=dots:3,dotz:3",
    "study sweep photograph -o s --over sheet_z=1:2:3 --measure speed",
    "study drift -o s --over x=1",
    "study all photograph -o s --shard 2/1",
    "study patterns -o s --camera slip.toml",
    "study accuracy photograph -o s -D x=1",
    "study accuracy photograph -o s --patterns dots:200",
    "study sweep photograph -o s --over patterns=dots:3,dots:200",
    "study patterns -o s --camera endless.toml",
    "study calibration photograph -o s --camera endless.toml",
    "study transfer -o s",
    "study twin --data none -o s",
    "study merge bad -o s",
)
"""Of a folder that is missing or holds something, a bad manifest, and words that are not known."""
WITHOUT_RENDERER = (
    "study accuracy photograph -o full",
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
    camera = shipped_path("calibration", "imx249.toml").read_text()
    (folder / "endless.toml").write_text(re.sub(r"(?m)^full_well_e = .*", "full_well_e = inf", camera))
    (folder / "slip.toml").write_text(re.sub(r"(?m)^bits = .*", "bits = 5", camera))
    (folder / "masked.toml").write_text(f'{camera}\n[mask]\nkind = "separable"\nfeature_mm = 0.03\n')
    waves = range(450, 651, 50)
    (folder / "rainbow.toml").write_text(
        f'name = "x"\neffective_wavelength_nm = 550\nwavelengths_nm = {[float(wave) for wave in waves]}\n'
        f"radiant_shares = {[0.2 for _ in waves]}\n"
    )
    recipe = shipped_path("calibration", "session.toml").read_text()
    (folder / "depths.toml").write_text(f"depths = [350.0, 400.0]\n{recipe}")
    made(folder / "made")
    return folder


@pytest.mark.parametrize(
    ("lines", "heavy"),
    [(WITHOUT_NUMPY, {"numpy"}), (WITHOUT_RENDERER, {"mitsuba", "drjit", "scipy", "matplotlib", "skimage"})],
    ids=["numpy", "renderer"],
)
def test_a_refusal_imports_nothing_heavy(refusing: Path, lines: tuple[str, ...], heavy: set[str]) -> None:
    """And leaves nothing behind. (Planted: the name of the patterns read by `parse_patterns`; the manifest of export
    read by `packed_run`; outputs, patterns or full wells looked at once the bench is open; a check of an output that
    leaves its folder.)"""
    before = sorted(refusing.rglob("*"))
    program = f"""
import functools, sys, typer.main
from mitsim.cli import run
typer.main.get_command = functools.cache(typer.main.get_command)  # commands are built once, not for every line
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
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as missing:
        assert missing.name == "torch", missing  # an extra: networks
assert before == (dict(os.environ), random.getstate(), str(numpy.random.get_state()), numpy.geterr())
if "mitsuba" in sys.modules:
    assert sys.modules["mitsuba"].variant() is None, sys.modules["mitsuba"].variant()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not done.stdout, "importing prints"


BACKENDS = re.compile(r"llvm|cuda|thread_count", re.IGNORECASE)
KNOWS_BACKENDS = {
    "mitsim.core.environment": "finds the library and chooses the variant",
    "mitsim.bench.request": "names in the help which variants there are",
}
SUMS = {"sum", "mean", "prod", "prefix_sum", "cumsum", "block_sum", "block_reduce", "block_prefix_sum", "reduce"}
OF_A_LANE = {
    "mitsim.transport.plugins.base": "the channels of a spectrum",
    "mitsim.transport.plugins.materials": "the orders of a grating",
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
    return module not in KNOWS_BACKENDS and any(BACKENDS.search(name) for name in named(parsed(source)))


def sums_lanes(module: str, source: str) -> list[str]:
    """Sums that Dr.Jit would add up over lanes, in the lanes' own 32 bits."""
    if module in OF_A_LANE:
        return []
    calls = (node for node in ast.walk(parsed(source)) if isinstance(node, ast.Call))
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


def test_samples_are_not_added_up_in_32_bits() -> None:
    """Light is added up on the device in whole numbers or floats of 64 bits, or on the host in double precision."""
    assert not [name for name, path in modules() if sums_lanes(name, path.read_text(encoding="utf-8"))]
    assert sums_lanes("mitsim.transport.direct", "total = dr.sum(light)") == ["sum"]
    assert not sums_lanes("mitsim.transport.direct", "total = dr.block_sum(mi.Float64(light), 4)")


HANDED = re.compile(r"\b(mi|types|llvm)\.(Float|U?Int|Bool)\d*\(.*(\bnp\.|\.astype\(|\.ravel\()")


def test_arrays_of_numpy_are_handed_to_kernels_with_room_past_their_end() -> None:
    """`device_array` alone hands them over, because Dr.Jit reads past the end of numpy's memory."""
    assert not [name for name, path in modules() if HANDED.search(path.read_text(encoding="utf-8"))]
    assert HANDED.search("x = mi.Float(values.astype(np.float32))")
    assert not HANDED.search("x = device_array(mi.Float, values.ravel())")


# ---- sizes and names -------------------------------------------------------------------------------------------------

SIZES = {
    "acquire": (5, 1198),
    "api": (2, 188),
    "bench": (5, 1202),
    "calibrate": (4, 963),
    "cli": (6, 1557),
    "core": (17, 3162),
    "design": (9, 1581),
    "devices": (9, 2238),
    "exchange": (7, 1616),
    "learn": (5, 1194),
    "light": (6, 1672),
    "optics": (7, 1751),
    "planner": (6, 1627),
    "reconstruct": (19, 6111),
    "report": (6, 1903),
    "scene": (5, 1438),
    "sensor": (4, 1105),
    "sessions": (4, 918),
    "studies": (24, 5059),
    "top level": (5, 525),
    "transport": (17, 4131),
}
"""Files and lines of code of each room. The limits only ever fall: a change that needs more in one room takes it from
another, and says which code went."""
LONG = 450
"""Lines of a file that a reader does not scroll without headings; chosen: some six screens."""
HEADING = re.compile(r"^\s*# -{4,} ?\w", flags=re.M)
UNNAMED = {"__init__", "__main__"}
ALIKE: set[str] = {"request"}
"""Names that files of several rooms have still: a change takes some away, and adds none."""
TOKENS_WITHOUT_CODE = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
}


def lines_of_code(source: str) -> int:
    """Lines that hold more than a docstring, a comment or nothing."""
    texts: set[int] = set()
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            texts |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in TOKENS_WITHOUT_CODE:
            lines |= set(range(token.start[0], token.end[0] + 1))
    return len(lines - texts)


def rooms_by_file(names: list[str]) -> dict[str, set[str]]:
    """Rooms that have a file of a name, by that name."""
    rooms: dict[str, set[str]] = defaultdict(set)
    for name in names:
        if (file := name.rpartition(".")[2]) not in UNNAMED and name.count(".") > 1:
            rooms[file].add(room_of(name))
    return rooms


def test_no_room_grows() -> None:
    sizes: dict[str, tuple[int, int]] = {}
    for name, (text, _) in sources().items():
        parts = name.split(".")
        room = parts[1] if len(parts) > 1 and (PACKAGE / parts[1]).is_dir() else "top level"
        files, lines = sizes.get(room, (0, 0))
        sizes[room] = files + 1, lines + lines_of_code(text)
    larger = {room: size for room, size in sizes.items() if any(map(operator.gt, size, SIZES.get(room, (0, 0))))}
    assert not larger, f"rooms with more files or lines of code than their limits: {larger}"
    assert lines_of_code('"""Text."""\n\nx = (\n    1,  # one\n)\n# two\n"""More."""\ny = """a\nb"""\n') == 5


def test_long_files_have_headings() -> None:
    texts = {name: text for name, (text, _) in sources().items() if text.count("\n") > LONG}
    without = {name for name, text in texts.items() if len(HEADING.findall(text)) < 2}
    assert not without, without
    assert HEADING.findall("# ---- Anchors\n\n    # -------- anchors of it\n") and not HEADING.findall("# --\n#----")


def test_a_file_name_means_one_thing() -> None:
    """In all rooms; a room inside a room is the same."""
    shared = {file for file, rooms in rooms_by_file([*sources()]).items() if len(rooms) > 1}
    assert shared == ALIKE, shared ^ ALIKE
    planted = rooms_by_file(["mitsim.cli.run", "mitsim.core.run", "mitsim.core", "mitsim.cli.inner.run", "mitsim.run"])
    assert planted == {"run": {"cli", "core"}}


def test_no_benchmark_hides_a_library_by_its_name() -> None:
    """A script's folder is the first place where Python looks. (Seen: benchmarks/colour.py in place of colour-science,
    for every benchmark that asked for it.)"""
    folder = Path(__file__).resolve().parents[1] / "benchmarks"
    elsewhere = [place for place in sys.path if Path(place).resolve() != folder]
    for name in (file.stem for file in folder.glob("*.py")):
        assert importlib.machinery.PathFinder.find_spec(name, elsewhere) is None, name
    assert importlib.machinery.PathFinder.find_spec("colour", elsewhere) is not None

"""README and docs: every example runs, every command line is one that the program takes, every link leads somewhere.

An example is a line ``$ mitsim ...`` or a Python block. Those of a page run in their order in one empty folder; the
lines of output under a command say how it ends. Quick tests hold each command line against the program's own options.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mitsim
from mitsim.studies import EXPERIMENTS
from tests.conftest import write_small_scene
from tests.exchanged import made
from tests.known_camera import KnownCamera
from tests.robustness import Recorder, Row, page_of
from tests.test_architecture import FLOORS
from tests.test_verbs import verbs

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(path.relative_to(ROOT).as_posix() for path in [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
EXAMPLES = [page for page in PAGES if page not in ("CHANGELOG.md", "CONTRIBUTING.md", "docs/migrating.md")]
FIRST_SCREEN = 40
"""Lines of README that a browser shows before one scrolls; chosen."""

MOST_WORDS_OF_README = 1200
"""What one reads in five minutes; chosen."""

ELSEWHERE = {"--check", "--cover", "--closed-form", "--install-completion", "--regimes", "--strict"}
"""Options in the docs that are of no verb: of scenes/generate.py, benchmarks/coverage.py, mitsim itself and mypy."""

ELSEWHERE_RUN = {"docs/bench.md", "docs/extending.md"}
"""Pages whose commands need files that a camera writes between them (tests/system/test_real_bench.py), or that a reader
writes (tests/test_extending.py)."""

WRITTEN = {"docs/sessions.md": ("session.toml", "sweep.toml")}
"""Files that a reader writes of a page's blocks, by page."""

MANY = {*EXPERIMENTS, "all"} - {"sweep"}
"""Studies of many points."""

NO_MODULES = {"mitsim.key"}
"""Names in the docs that only look like modules: metadata of OpenEXR files."""

READERS = "DIR"
"""A folder of real captures that a reader has: commands on it are those of tests that have some."""
ACCURACY = "0.02"
"""For examples that name none: how the verbs fit together does not depend on it, and they take a tenth of the time."""


def script(name: str, folder: str = "docs") -> Any:
    """A script of docs, as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / folder / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


figures = script("figures")


def text_of(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def prose_of(page: str) -> str:
    """The page without its blocks of code."""
    fenceless = re.sub(r"^```.*?^```", "", text_of(page), flags=re.M | re.S)
    return re.sub(r"^    .*$", "", fenceless, flags=re.M)


@dataclass(frozen=True)
class Example:
    """A command of a page: its arguments after `mitsim`, the output under it, and the exit status that this tells."""

    arguments: list[str]
    status: int
    output: str


def examples(page: str, heading: str = "") -> list[Example]:
    """Of a page, or of what stands under one ``heading`` of it."""
    found = []
    for line, output in figures.examples(figures.section(page, heading) if heading else text_of(page)):
        status = 1 if "mitsim: warning" in output else 2 if "mitsim: " in output else 0
        found.append(Example(shlex.split(line, comments=True), status, output))
    return found


def command_lines() -> list[tuple[str, str]]:
    """(page, arguments) of all lines and inline spans of code that begin with `mitsim` and a verb."""
    found = []
    for page in EXAMPLES:
        lines = re.findall(r"^    (?:\$ )?mitsim ([a-z].*)$", text_of(page), flags=re.M)
        spans = re.findall(r"`mitsim ([a-z][^`]*)`", prose_of(page))
        found += [(page, " ".join(line.split())) for line in [*lines, *spans]]
    return found


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text_of(page), flags=re.M | re.S)


# ---- the command line ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("page", "line"), command_lines())
def test_a_command_line_is_one_that_the_program_takes(page: str, line: str) -> None:
    verb, *arguments = shlex.split(line, comments=True)
    try:
        verbs()[verb].make_context(verb, arguments)
    except Exception as error:
        # A sentence may name a verb or its option alone; typer does not say where it keeps click.
        if "--help" in line and type(error).__name__ == "Exit":
            return
        if type(error).__name__ not in ("MissingParameter", "BadOptionUsage") or f"`mitsim {line}`" not in text_of(
            page
        ):
            raise


def test_every_option_in_the_docs_is_one_of_a_verb() -> None:
    options = {option for verb in verbs().values() for parameter in verb.params for option in parameter.opts}
    options |= {"--help", "--version", *ELSEWHERE}
    stale = {
        f"{page}: {option}"
        for page in EXAMPLES
        for span in re.findall(r"`([^`\n]+)`", prose_of(page))
        for option in re.findall(r"(?<![\w-])--[a-z][a-z-]*", span)
        if option not in options
    }
    assert not stale, stale


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in EXAMPLES if examples(page) and page not in ELSEWHERE_RUN])
def test_the_commands_of_a_page_run_in_their_order(page: str, tmp_path: Path) -> None:
    (tmp_path / "captures").symlink_to(ROOT / "captures")  # as the repository's folder has it
    for name, text in zip(WRITTEN.get(page, ()), blocks(page, "toml"), strict=False):
        (tmp_path / name).write_text(text, encoding="utf-8")
    for example in examples(page):
        if READERS in example.arguments:
            continue
        command = verbs()[example.arguments[0]]
        options = {option for parameter in command.params for option in parameter.opts}
        coarse = ["--accuracy", ACCURACY] if "--accuracy" in options - set(example.arguments) else []
        if example.arguments[0] == "render" and "factored" not in example.arguments:
            coarse = []  # the reference has samples in its place
        if example.arguments[0] == "study" and example.arguments[1] in MANY and "--quick" not in example.arguments:
            coarse.append("--quick")  # all points of a study take minutes, of all studies an hour
        done = subprocess.run(
            [sys.executable, "-m", "mitsim", *example.arguments, *coarse],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == example.status, f"mitsim {shlex.join(example.arguments)}\n{done.stderr}"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("status", "line", "sentence"),
    re.findall(r'^\| (\d) \|.*\| `mitsim ([^`]+)`: "([^"]+)" \|$', figures.STATUSES.read_text("utf-8"), flags=re.M),
)
def test_the_exit_statuses_of_the_table(status: str, line: str, sentence: str, tmp_path: Path) -> None:
    program = [sys.executable, "-m", "mitsim", *shlex.split(line)]
    done = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == int(status)
    assert sentence in " ".join(done.stderr.split())


# ---- Python ----------------------------------------------------------------------------------------------------------


def exchanged_file() -> dict[str, object]:
    """The files that docs/exchange.md reads."""
    from mitsim.api.bench import open_bench
    from mitsim.exchange.formats import export

    bench = made(Path())
    export(bench.run, "hdf5", "all.h5", bench.calibration)
    open_bench(write_small_scene(Path("scenes"))).light("dots:4", accuracy=0.1).save("light.h5")
    return {}


def stored_pairs() -> dict[str, object]:
    """The store that docs/learned.md reads."""
    from mitsim.api.bench import open_bench
    from mitsim.bench.request import Request, Task
    from mitsim.learn.pairs import make_pairs
    from mitsim.learn.requests import PairsRequest

    scene = write_small_scene(Path("scenes"))
    asked = PairsRequest(capture=Request.of(patterns="uniform", accuracy=0.1), count=2)
    make_pairs(open_bench(scene), asked, Task(Path("pairs")))
    return {}


def made_folders() -> dict[str, object]:
    """The folders `run` and `cal` that docs/api.md reads."""
    made(Path())
    return {}


GIVEN: dict[str, Callable[[], dict[str, object]]] = {
    "docs/api.md": made_folders,
    "docs/exchange.md": exchanged_file,
    "docs/learned.md": stored_pairs,
}
SLOW = {"README.md"}


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.slow] if page in SLOW else [])
        for page in EXAMPLES
        if blocks(page, "python") and page not in ELSEWHERE_RUN
    ],
)
def test_the_python_of_a_page_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variant: str) -> None:
    monkeypatch.chdir(tmp_path)
    names = GIVEN.get(page, dict)()
    for block in blocks(page, "python"):
        exec(compile(block, page, "exec"), names)


@pytest.mark.slow
def test_the_slow_examples_of_the_python_page_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variant: str
) -> None:
    """After the quick ones, whose names they use."""
    monkeypatch.chdir(tmp_path)
    names = made_folders()
    KnownCamera(1).write_session(tmp_path / "known", 3)
    for block in [*blocks("docs/api.md", "python"), *blocks("docs/api.md", "python slow")]:
        exec(compile(block, "docs/api.md", "exec"), names)


def test_every_public_name_has_an_example_that_runs() -> None:
    """In a block of Python that a test runs. (Planted: a name without one.)"""
    pages = [page for page in EXAMPLES if page not in ELSEWHERE_RUN]
    code = "\n".join(block for page in pages for kind in ("python", "python slow") for block in blocks(page, kind))
    assert not {name for name in mitsim.__all__ if not re.search(rf"\b(?:ms|mitsim)\.{name}\b", code)}


@pytest.mark.parametrize("page", [page for page in EXAMPLES if blocks(page, "json")])
def test_the_json_of_a_page_is_json(page: str) -> None:
    for block in blocks(page, "json"):
        json.loads(block)


# ---- figures ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_figures_of_the_tour_are_what_its_commands_print(tmp_path: Path) -> None:
    """To one of the last digit printed; seconds and memory are the machine's. `make figures` writes them anew.

    (Seen failing: 50.81 dB and a Monte Carlo error of 3.0e-4, where the commands gave 49.71 and 4.3e-4.)
    """
    stale = {verb: figures.differences(figures.printed(verb)[1], now) for verb, now in figures.outputs(tmp_path)}
    assert not any(stale.values()), stale


@pytest.mark.slow
def test_the_file_has_what_plans_of_the_photograph_say(tmp_path: Path) -> None:
    """To 2e-2: figures are printed to two digits. (Seen: cells stated at 3.3e-4, where the plan gives 3.2e-4.)"""
    assert figures.read()["plan"] == {
        name: pytest.approx(value, rel=2e-2) for name, value in figures.plan(tmp_path).items()
    }


def test_pages_state_what_the_file_of_figures_has() -> None:
    """(Seen failing: README's 49.71 dB, where bench.md, studies.md and the picture had 50.8.)"""
    assert not figures.stale(figures.read()), "run: make figures"


def test_the_file_has_what_the_tour_prints_and_its_pictures_show() -> None:
    kept = figures.read()
    assert kept["tour"] == figures.tour_figures()
    assert kept["pictures"] == figures.picture_figures()
    assert abs(kept["pictures"]["dots_psnr_db"] - kept["tour"]["psnr_db"]) <= 0.05 + 1e-9


def test_figures_that_no_machine_changes_are_what_their_closed_forms_give() -> None:
    """To 1e-3: what a rounding of another machine's BLAS leaves is a millionth of that."""
    now = figures.closed()
    assert figures.read()["closed"] == {name: pytest.approx(value, rel=1e-3) for name, value in now.items()}


def test_a_stale_figure_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the file, or on a page: 50.81 where the commands gave 49.71."""
    kept = figures.read()
    kept["tour"]["psnr_db"] = 50.81
    assert len(figures.stale(kept)) == sum(place.name == "tour.psnr_db" for place in figures.STATED) == 3


def test_figures_are_compared_to_the_last_digit_printed() -> None:
    reported = "49 frames in 4.3 s: run\nPSNR 50.81 dB, lambda 8.03e+06\nSeconds: write 0.07\nAt most 0.5 GiB"
    for now, found in (
        ("PSNR 50.82 dB, lambda 8.04e+06", []),
        ("PSNR 50.79 dB, lambda 8.03e+06", ["50.81 -> 50.79"]),
        ("PSNR 50.81 dB, lambda 8.05e+06", ["8.03e+06 -> 8.05e+06"]),
    ):
        new = f"49 frames in 9.9 s: run\n{now}\nSeconds: write 1.07\nAt most 2 GiB"
        new += "\n27 kernels were compiled in 2.1 s of this time, and are kept"
        assert figures.differences(reported, new) == found
    assert len(figures.differences(reported, reported.replace("frames", "shots"))) == 1


def test_the_devices_are_drawn_as_they_are_shipped() -> None:
    """Distances in the drawings are those of scenes/photograph."""
    from mitsim.devices.camera import CameraGeometry

    sys.path.insert(0, str(ROOT / "docs" / "images"))
    try:
        drawings = importlib.import_module("drawings")
    finally:
        sys.path.pop(0)
    camera, scene = CameraGeometry(), text_of("scenes/photograph/scene.xml")
    assert (camera.scene_distance, camera.mask_distance, camera.fov) == (
        drawings.SCENE_MM,
        drawings.MASK_MM,
        drawings.FIELD_DEGREES,
    )
    assert (camera.pixel_pitch, camera.pixels) == (drawings.PITCH_MM, drawings.SENSOR_PIXELS)
    assert (camera.mask_feature, 2**camera.mask_order - 1) == (drawings.FEATURE_MM, drawings.FEATURES)
    assert f'<translate x="{drawings.BASELINE_MM:g}" y="0" z="0"/>' in scene
    for drawing in drawings.DRAWINGS:
        assert (ROOT / "docs" / "images" / f"{drawing.__name__}.png").is_file()
        assert any(f"images/{drawing.__name__}.png" in text_of(page) for page in PAGES)


def test_each_tile_of_the_gallery_has_its_picture_a_sentence_and_commands_that_make_it() -> None:
    """Pictures are small, none is left over, and of what a tile's commands write one is shown: its path begins as their
    output. Whether the program takes the commands, and whether they run, tests above say.

    (Planted: a tile without a command, a picture that no tile shows, an output under another name, a picture of 70 kB.)
    """
    make, page = script("make", "docs/images"), text_of("docs/gallery.md")
    tiles = make.tiles()
    pictures = {path.stem: path.stat().st_size for path in (ROOT / "docs/images/gallery").glob("*.png")}
    assert pictures.keys() == tiles.keys() and len(tiles) >= 12
    assert max(pictures.values()) < make.LARGEST
    assert page.count("\n<div>\n") == len(tiles) == len(re.findall(r"^\*\*.+\*\*", page, flags=re.M))
    assert [name for name, commands in tiles.items() if name not in make.TILES or not commands] == ["network"]
    for name, shown in make.TILES.items():
        outputs = [re.findall(r"(?:-o|report) (\S+)", command) for command in tiles[name]]
        assert any(shown == output or shown.startswith(f"{output}/") for found in outputs for output in found), name


# ---- what the text says ----------------------------------------------------------------------------------------------


def slugs(page: str) -> set[str]:
    """Anchors of a page's headings, as GitHub and the site make them."""
    titles = re.findall(r"^#+ (.+)$", re.sub(r"^```.*?^```", "", text_of(page), flags=re.M | re.S), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", prose_of(page)):
        if target.startswith(("http://", "https://")):
            continue
        name, _, anchor = target.partition("#")
        path = (ROOT / page).parent / name if name else ROOT / page
        found = path.exists() and (not anchor or anchor in slugs(os.path.relpath(path, ROOT)))
        broken += [] if found else [target]
    assert not broken, f"{page}: {broken}"


@pytest.mark.parametrize("page", EXAMPLES)
def test_files_tests_and_modules_that_a_page_names_exist(page: str) -> None:
    """But for those that a reader makes."""
    missing, new = [], set(re.findall(r"^New file `(.+)`:$", text_of(page), flags=re.M))
    for span in re.findall(r"`([^`\n]+)`", prose_of(page)):
        for name, test in re.findall(r"\b((?:mitsim|tests|benchmarks|scenes|docs)/[\w/]+\.\w+)(?:::(\w+))?", span):
            path = ROOT / name
            if not ("NAME" in name or name in new) and not (
                path.is_file() and (f"def {test}(" if test else "") in text_of(name)
            ):
                missing.append(span)
        dotted = set(re.findall(r"^mitsim(?:\.\w+)+$", span)) - NO_MODULES
        missing += [name for name in dotted if not resolves(name)]
    assert not missing, f"{page}: {missing}"


def resolves(dotted: str) -> bool:
    """Whether a dotted name is a module, or something in one."""
    parts = dotted.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for part in parts[length:]:
            found = getattr(found, part, None)
        return found is not None
    return False


def test_the_house_stands_on_its_page_as_it_is_tested() -> None:
    """Floors and rooms of docs/architecture.md; files that stand by themselves are not in its tables."""
    page, alone = text_of("docs/architecture.md"), {"version", "metrics", "mitsim", "__main__"}
    path = re.findall(r"^\| \d+ \| `([\w/.]+)` \|", page, flags=re.M)
    assert len(path) == 12 and all((ROOT / name).is_file() for name in path)
    floors = [set(re.findall(r"\w+", rooms)) for rooms in re.findall(r"^\| \d+ \| ([\w, ]+) \|$", page, flags=re.M)]
    assert floors == [rooms for floor in FLOORS if (rooms := set(floor.split()) - alone)]
    assert re.findall(r"^\| `(\w+)` \|", page.split("## Passes of light")[0], flags=re.M) == [
        room for floor in FLOORS for room in floor.split() if room not in alone
    ]


def test_every_pass_of_light_stands_in_the_table_of_passes(variant: str) -> None:
    passes = pytest.importorskip("mitsim.light.passes").PASSES
    table = text_of("docs/architecture.md").split("## Passes of light")[1].split("## Data that is passed on")[0]
    named = {name for row in re.findall(r"^\| ([a-z ,]+) \|", table, flags=re.M) for name in row.split(", ")}
    assert named - {"pass", "specular chain"} == {name.replace("_", " ") for name in passes}


def test_the_first_screen_says_what_shows_a_picture_and_two_commands() -> None:
    screen = "\n".join(text_of("README.md").splitlines()[:FIRST_SCREEN])
    opening = screen.split("\n## ")[0]
    assert re.match(r"# mitsim\n\nmitsim \w+", opening)
    assert "](docs/images/" in opening
    commands = re.findall(r"^    (\S+ \S+)", opening, flags=re.M)
    assert commands == ["make demo", "make test"]


def test_readme_is_short() -> None:
    """The rest stands on the pages that it leads to."""
    assert len(text_of("README.md").split()) <= MOST_WORDS_OF_README


def test_every_page_stands_on_the_index() -> None:
    """(Planted: the line of growth.md taken away.)"""
    linked = set(re.findall(r"\]\(([^)#]+)\)", text_of("docs/index.md")))
    expected = {os.path.relpath(ROOT / page, ROOT / "docs") for page in PAGES}
    assert expected - {"index.md"} <= linked


def test_the_citation_names_this_version() -> None:
    assert f"\nversion: {mitsim.__version__}\n" in text_of("CITATION.cff")


@pytest.mark.slow
def test_the_site_builds_without_a_warning_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    """(Seen failing: MathJax and Mermaid, which pages with formulas and a diagram loaded from a network.)"""
    pytest.importorskip("myst_nb", reason="make docs installs it")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-c", "docs", ".", tmp_path / "html"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    pages = {path: path.read_text(encoding="utf-8") for path in (tmp_path / "html").rglob("*.html")}
    assert tmp_path / "html" / "docs" / "api.html" in pages
    fetched = r"<(?:script|img|iframe)[^>]* src=\"(?:https?:)?//[^>]*>|<link[^>]* href=\"(?:https?:)?//[^>]*>"
    assert not {path.name: found for path, text in pages.items() if (found := re.findall(fetched, text))}


@pytest.mark.parametrize(("value", "gates"), [(2, {"at_most": 1}), (0, {"at_least": 1}), (np.nan, {"at_most": 1})])
def test_a_figure_beyond_its_gate_fails(value: float, gates: dict[str, float]) -> None:
    with pytest.raises(AssertionError, match="what"):
        Recorder()(value, **gates, what="what")


def test_a_row_shows_the_figure_nearest_to_its_gate() -> None:
    figures = Recorder()
    for value in (1e-9, 3e-7, -2e-8):
        figures(value, at_most=1e-6, what="error")
    row = Row("Optics", "tests/t.py", 1, "test_a_b", ["x", "y"], figures.figures)
    page = page_of("{Optics}\n", [row, Row("Optics", "tests/t.py", 2, "test_c")])
    assert page.splitlines()[2:] == [
        "| a b (2 cases) | error: 3e-7 | <= 1e-6 |",
        "",
        "Tests: [t.py](../tests/t.py) (1 more).",
    ]


def test_the_page_of_figures_has_every_test_that_measures() -> None:
    """`make robustness` writes the page anew. (Planted: a row removed.)"""
    page, missing = text_of("docs/robustness.md"), []
    for path in (ROOT / "tests").rglob("test_*.py"):
        source = path.read_text(encoding="utf-8")
        whole = re.search(r"^pytestmark = .*mark\.robustness\(", source, flags=re.M)
        mark = "" if whole else r"@pytest\.mark\.robustness\(.*\n"
        names = re.findall(rf"^{mark}(?:@.*\n)*def test_(\w+)\([^)]*\bmeasured\b", source, flags=re.M)
        table = f"](../{os.path.relpath(path, ROOT)})" in page
        rows = {row.replace(" ", "_") for row in re.findall(r"^\| ([\w ]+?) (?:\(|\|)", page, flags=re.M)}
        missing += [name for name in names if not table or name not in rows]
    assert not missing, missing

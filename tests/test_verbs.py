"""The Python face has a call for each verb of the command line, with its options, and refuses wrong arguments.

Quick: nothing is rendered.
"""

from __future__ import annotations

import importlib
import inspect
import math
import pydoc
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mitsim as ms
from mitsim.bench.request import Request
from mitsim.cli.commands import message_of
from mitsim.core.configuration import Options
from mitsim.core.errors import ArgumentError
from tests.exchanged import made

CALLS = {
    "demo": ["demo"],
    "run": ["run", "session_of"],
    "view": ["Bench.view"],
    "predict": ["predict", "Bench.predict"],
    "plan": ["Bench.plan", "Bench.choose_colour", "Plan.save"],
    "capture": ["Bench.capture", "Bench.capture_lines", "Bench.capture_mosaic", "Light.expose"],
    "calibrate": ["Bench.calibrate", "Bench.calibrate_lines", "Bench.calibrate_mosaic", "Bench.calibrate_depths",
                  "Bench.write_session", "calibrate_frames", "calibrate_known", "calibrate_model", "plan_calibration"],
    "reconstruct": ["reconstruct", "reconstruct_colours", "reconstruct_psf", "Reconstruction.save"],
    "render": ["Bench.render", "Rendered.save"],
    "study": ["study"],
    "design": ["design"],
    "compare": ["compare"],
    "show": ["show"],
    "report": ["report", "report_folder"],
    "pairs": ["pairs", "make_pairs"],
    "train": ["train"],
    "export": ["export"],
    "import": ["import_file", "import_frames"],
    "patterns": ["patterns", "pattern_pictures"],
    "transport": ["Bench.transport", "Bench.light", "Light.save"],
    "characterise": ["characterise"],
    "sense": ["sense"],
    "list": ["scenes"],
    "new": [],
    "doctor": ["doctor"],
}  # fmt: skip
"""Python calls that do what a verb does, by its name."""
UNLIKE = {"import", "list", "new"}
"""Verbs without a call of their name: a word of Python's own, names of what is shipped, and files to edit."""
ONE_CALL = [
    "show",
    "demo",
    "run",
    "study",
    "compare",
    "design",
    "import",
    "patterns",
    "characterise",
    "sense",
    "doctor",
    "export",
]
"""Verbs that are one call with the same options."""
ALIKE = {"scenes": "scene", "family": "patterns", "repeated": "folder", "stacks": "frames", "stack_size": "frames"}
"""Arguments that the command line calls otherwise."""
OF_THE_COMMAND_LINE = {
    *("as_json", "quiet", "verbose", "help", "variant", "no_pictures", "max_seconds", "max_memory", "overwrite"),
}
"""Options that say how it is reported and bounded, as a job does; the variant is a bench's."""
ANYWAY = {("sense", "output")}
"""Of the verb and option, what a method of the result is for."""


@cache
def verbs() -> dict[str, Any]:
    """Return all commands by name. Typer takes longer to build them than to parse a line."""
    import typer

    from mitsim.cli import app

    commands: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    return commands


def called(name: str) -> Callable[..., Any]:
    """The call of a dotted name of the face."""
    found: Any = ms
    for part in name.split("."):
        found = getattr(found, part)
    assert callable(found), name
    return found  # type: ignore[no-any-return]


def test_every_verb_has_a_python_call() -> None:
    """A new verb needs a row here, and what it names must be there. (Planted: a verb that the table lacks; a name that
    the face lacks.)"""
    assert verbs().keys() == CALLS.keys()
    for names in CALLS.values():
        for name in names:
            called(name)


def test_verbs_have_their_name_in_python() -> None:
    """Of the package or of a bench; the earlier names are the same functions. (Planted: report_folder alone.)"""
    missing = {verb for verb in verbs() if not hasattr(ms, verb) and not hasattr(ms.Bench, verb)}
    assert missing == UNLIKE
    assert (ms.report, ms.pairs, ms.patterns) == (ms.report_folder, ms.make_pairs, ms.pattern_pictures)
    assert ms.Bench.transport is ms.Bench.light


def test_keywords_are_listed() -> None:
    """Signatures have no keywords that are not named, except parameters that a scene declares. (Planted: **options of
    reconstruct_colours.)"""
    calls = {name: getattr(ms, name) for name in ms.__all__ if not name[0].isupper()}
    calls |= {f"Bench.{name}": getattr(ms.Bench, name) for name in methods(object.__new__(ms.Bench))}
    calls["Light.expose"] = ms.Light.expose
    kinds = {name: inspect.signature(call).parameters.values() for name, call in calls.items()}
    free = {name for name, all_ in kinds.items() for each in all_ if each.kind == each.VAR_KEYWORD}
    assert free == {"open_bench", "flat_scene", "shelf_scene"}


def test_a_bench_lists_the_names_that_a_user_needs() -> None:
    """(Planted: a name that is not there. Seen: 66 names, of which most serve the package.)"""
    bench = object.__new__(ms.Bench)
    assert {"capture", "calibrate", "view", "geometry", "variant"} <= {*dir(bench)} and len(dir(bench)) < 25
    assert not {*dir(bench)} - {*dir(ms.Bench)} - {*inspect.get_annotations(ms.Bench.__mro__[1])}


@pytest.mark.parametrize("verb", ONE_CALL)
def test_every_option_of_a_verb_is_an_argument(verb: str) -> None:
    """(Planted: an option that the call does not take.)"""
    known = {each for name in CALLS[verb] for each in inspect.signature(called(name)).parameters}
    options = {ALIKE.get(each.name, each.name) for each in verbs()[verb].params} - OF_THE_COMMAND_LINE
    options -= {"context"}
    missing = {name for name in options - known if (verb, name) not in ANYWAY}
    assert not missing, missing


@pytest.mark.parametrize(
    ("argument", "option"), [("lam", "--lambda"), ("parameters", "-D"), ("flat_dark_frame", "--flat-dark-frame")]
)
def test_refusals_name_options_on_the_command_line(argument: str, option: str) -> None:
    assert message_of(ArgumentError(argument, "has no effect")) == f"{option} has no effect"


# ---- wrong arguments -------------------------------------------------------------------------------------------------

WRONG: list[Any] = [
    *(object(), b"x", 1j, None, True, False, 0, -1, 10**40, 0.5, -1e300, math.nan, math.inf),
    *("", "x", "a\0b", "n" * 5000, "\udcff"),
    *((), [], {}, [1, "x"], (1.0, 2.0), {"x": object()}, type, Path("no such"), Path(".")),
    *(np.array([]), np.ones((2, 3)), np.array([1j]), np.array([None, "x"]), np.float32("nan"), np.int8(-1)),
]
"""Values that are wrong for most arguments; a folder where a file belongs is the last path."""
OF_A_BENCH = [object(), b"x", 1j, np.array([]), np.array([1j]), np.array([None])]
"""Values that no argument of a bench may be."""
RENDERS = {"open_bench", "make_pairs", "pairs", "calibrate_model", "plan_calibration", "demo", "run", "study"}
RENDERS |= {"doctor", "predict", "train"}
"""What may begin long work by an argument of the right kind: it gets those of no kind alone."""
CLASSES = ["Clock", "Job", "Limits", "Modelling", "Request"]
"""Classes that users make things of."""


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A capture, factors and an image that nobody rendered, and what cannot be without a scene: an empty bench."""
    bench = made(tmp_path_factory.mktemp("verbs") / "made")
    shots, factors = ms.load_run(bench.run), ms.load_calibration(bench.calibration)
    sensed = ms.sense(np.full((4, 4), 1e-3), "imx249")
    owners = {"shots": shots, "factors": factors, "image": ms.reconstruct(shots, factors), "sensed": sensed}
    return {**owners, "bench": object.__new__(ms.Bench), "light": object.__new__(ms.Light)}


def methods(owner: object) -> list[str]:
    """Public methods of an object, of classes of mitsim's own, that take arguments."""
    found = []
    for name in dir(type(owner)):
        if name.startswith("_") or isinstance(inspect.getattr_static(type(owner), name), property):
            continue
        method = getattr(type(owner), name, None)
        if callable(method) and (method.__module__ or "").startswith("mitsim"):
            found.append(name)
    return found


def right(call: Callable[..., Any], results: dict[str, Any]) -> dict[str, Any]:
    """Arguments of the right kind for parameters without a default."""
    texts = dict.fromkeys(inspect.signature(call).parameters, "new")
    given = {**texts, **results, "image": np.ones((8, 8)), "truth": np.ones((8, 8)), "count": 1, "depth": 400.0}
    given |= {"modelling": ms.Modelling("wave"), "reflectance": 0.5, "stages": {}, "psnr": 30.0, "method": "unrolled"}
    given |= {"model": "wave", "irradiance": np.ones((4, 4)), "format": "mat", "camera": "imx249"}
    parameters = inspect.signature(call).parameters.values()
    return {each.name: given[each.name] for each in parameters if each.default is each.empty and each.kind < 2}


def raised(call: Callable[..., Any], results: dict[str, Any], values: list[Any]) -> list[str]:
    """What is raised for wrong values, one argument after the other, but for MitsimError of one line."""
    found = []
    for parameter in inspect.signature(call).parameters.values():
        if parameter.kind == parameter.VAR_POSITIONAL or parameter.annotation in ("object", "Any"):
            continue
        name = "no_such_name" if parameter.kind == parameter.VAR_KEYWORD else parameter.name
        for value in values:
            try:
                call(**{**right(call, results), name: value})
            except ms.MitsimError as refusal:
                if len(str(refusal).splitlines()) != 1 or not str(refusal).isprintable():
                    found.append(f"{name}={value!r:.40}: {refusal!r:.200}")
            except Exception as error:
                found.append(f"{name}={value!r:.40}: {error!r:.200}")
    return found


@pytest.mark.parametrize("name", [name for name in ms.__all__ if not name[0].isupper()] + CLASSES)
def test_wrong_arguments_of_functions_are_refused_in_a_line(
    name: str, results: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every function of the face, with values of every kind: MitsimError, or it works. (Planted: a function that checks
    nothing; a list for an array.)"""
    monkeypatch.chdir(tmp_path)
    call = getattr(ms, name)
    assert not (wrong := raised(call, results, OF_A_BENCH if name in RENDERS else WRONG)), "\n".join(wrong)


@pytest.mark.parametrize("of", ["shots", "factors", "image", "sensed", "bench", "light"])
def test_wrong_arguments_of_methods_are_refused_in_a_line(
    of: str, results: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every public method of what functions give; of a bench and its light by kind alone, for they have no scene here.
    (Planted: a method that checks nothing.)"""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("matplotlib.pyplot.subplots", no_figure)
    owner, wrong = results[of], []
    for name in methods(owner):
        values = OF_A_BENCH if of in ("bench", "light") else WRONG
        wrong += [f"{name}: {line}" for line in raised(getattr(owner, name), results, values)]
    assert not wrong, "\n".join(wrong)


def no_figure(**_: Any) -> Any:
    """A figure that pyplot does not hold."""
    from matplotlib.figure import Figure

    figure = Figure()
    return figure, figure.subplots()


def test_numpy_scalars_are_numbers(results: dict[str, Any]) -> None:
    """Also where a function looks closer than its annotation. (Seen: a margin of ``np.int8(0)`` refused.)"""
    frame = ms.sense(np.full((3, 3), 1e-3), "imx249", exposure=np.float32(0.01), seed=np.int64(2))
    assert np.array_equal(
        frame.digital, ms.sense(np.full((3, 3), 1e-3), "imx249", float(np.float32(0.01)), seed=2).digital
    )
    assert ms.reconstruct(results["shots"], results["factors"], lam=np.float64(1.0)).lam == 1.0
    asked = Request.of(seed=np.int64(3), accuracy=np.float32(0.25))
    assert (asked.seed, asked.accuracy) == (3, 0.25) and type(asked.seed) is int


def test_an_image_has_the_options_of_its_verb(results: dict[str, Any]) -> None:
    """(Planted: bounds that are passed over.)"""
    shots, factors = results["shots"], results["factors"]
    image = ms.reconstruct(shots, factors, method="nonnegative", bounds=(0.2, 0.6), iterations=500).image
    assert image.min() >= 0.2 - 1e-9 and image.max() <= 0.6 + 1e-9
    with pytest.raises(ms.ArgumentError, match="bound is no option of reconstruct; did you mean bounds"):
        ms.reconstruct(shots, factors, bound=(0, 1))


def test_a_misspelt_option_is_refused_with_what_was_meant() -> None:
    for call, line in (
        (lambda: ms.study("patterns", quik=True), r"quik is no option of study; did you mean quick\? use seed"),
        (lambda: ms.import_frames("x", "y", expsure=1), r"expsure is no option of import_frames; did you mean exp"),
        (lambda: ms.characterise("imx249", step=3), r"step is no option of characterise; did you mean steps\?"),
    ):
        with pytest.raises(ms.ArgumentError, match=line):
            call()


def models(one: type[Options] = Options) -> set[type[Options]]:
    """Models of options, and those that derive from them."""
    return {one}.union(*map(models, one.__subclasses__()))


def test_options_of_every_model_are_checked() -> None:
    """All of them, whatever is added. (Planted: a field of the kind Any without a check.)"""
    found = [model for model in models() if model.__module__.startswith("mitsim")]
    assert len(found) > 20
    for model in found:
        for name in model.model_fields:
            if (model.__name__, name) in {(kind, "method") for kind in ("ImageRequest", "_Image", "Reconstructing")}:
                continue
            with pytest.raises(ms.ArgumentError) as refused:
                model(**{name: object()})
            named = {each.argument for each in (refused.value, *refused.value.others)}
            assert name in named, (model, name, refused.value)


def test_help_of_a_call_states_its_options() -> None:
    """(Planted: a docstring without them.)"""
    text = pydoc.render_doc(ms.Bench.calibrate, renderer=pydoc.plaintext)
    assert "accuracy: float = 0.001" in text and "allowed relative rms error of the expected frames" in text
    assert "**" not in str(inspect.signature(ms.Bench.calibrate))


# ---- what is shipped, and this machine -------------------------------------------------------------------------------


def test_scenes_are_told_in_a_sentence() -> None:
    found = ms.scenes()
    assert {"photograph", "cookie_bag", "lamp_bench"} <= found.keys() and len(found) == 15
    assert all(text and text[0].isupper() and "\n" not in text for text in found.values())


def test_the_doctor_renders_in_a_known_variant(monkeypatch: pytest.MonkeyPatch) -> None:
    environment = importlib.import_module("mitsim.core.environment")
    monkeypatch.setattr(environment, "run_child", lambda *_: "")
    assert "render llvm_ad_rgb" in [each.name for each in ms.doctor("llvm_ad_rgb") if each.ok]
    with pytest.raises(ms.ArgumentError, match="variant 'x': use llvm_ad_mono"):
        ms.doctor(variant="x")

"""Options that several commands share: words of a command line in, a bench, a request or a job out, or a refusal.

Options that go together are one frozen dataclass, whose fields are the options; :func:`verb` decorates a function of
such groups.
"""

from __future__ import annotations

import copy
import functools
import inspect
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import MISSING, dataclass, field, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin, get_type_hints

import typer
from typer.models import OptionInfo

import mitsim
from mitsim.cli.help_page import DEVICES, LIMITS, OUTPUT, QUALITY, WHAT, metavar_of
from mitsim.core.configuration import CAMERA, LIST, PROJECTOR, shipped_files
from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.errors import ArgumentError, MitsimError, printable
from mitsim.core.job import Limits, running_seconds
from mitsim.core.progress import progress
from mitsim.core.spectral_manifests import BANDS, LINES, bands_of, check_undecided, spectral_of
from mitsim.devices.patterns import pattern_names

if TYPE_CHECKING:
    from mitsim.api.bench import Bench
    from mitsim.bench.request import Exposure
    from mitsim.core.job import Job
    from mitsim.light.plan import Plan

_SPELLED = {
    "scene": "SCENE",
    "define": "-D",
    "outside": "--allow-outside-files",
    "planning": "--plan",
    "as_json": "--json",
    "everything": "--all",
    "aged": "--from",
    "lam": "--lambda",
    "parameters": "-D",
    "values": "-D",
    "repeated": "--from",
}
"""Options that are not called like their parameter."""
_BENCH_ARGUMENTS = ("scene", "variant", "camera", "projector", "allow_outside_files", "for_render")

NO, MOSAIC, AUTO = "no", "mosaic", "auto"
"""Words of --colour beside `lines` and `bands:K`."""


def completing(names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """What a shell completes a word by: those of some ``names``, asked for when it does, that begin with it."""

    def complete(incomplete: str) -> list[str]:
        return [name for name in names() if name.startswith(incomplete)]

    return complete


complete_scene = completing(lambda: shipped_files("scenes", "scene.xml"))
complete_camera, complete_projector, complete_list = (
    completing(functools.partial(shipped_files, "calibration", ".toml", field)) for field in (CAMERA, PROJECTOR, LIST)
)
Scene = Annotated[
    str,
    typer.Argument(help="scene XML, or the name of a shipped scene", metavar="SCENE", autocompletion=complete_scene),
]
_SAMPLED: dict[str, Any] = {"rich_help_panel": QUALITY}
Patterns = Annotated[str, typer.Option(help=pattern_names(), metavar="PATTERNS", rich_help_panel=WHAT)]
Accuracy = Annotated[float, typer.Option(help="relative rms error of the expected frames", **_SAMPLED)]
Seed = Annotated[int, typer.Option(help="root of every random stream", **_SAMPLED)]
Effects = Annotated[
    str, typer.Option("--effects", help="override the plan: +NAME,-NAME", metavar="+NAME,-NAME", **_SAMPLED)
]
Camera = Annotated[
    str | None,
    typer.Option(
        help="camera electronics: name or TOML file",
        metavar="NAME|FILE",
        rich_help_panel=DEVICES,
        autocompletion=complete_camera,
    ),
]
Projector = Annotated[
    str | None,
    typer.Option(
        help="projector: name or TOML file",
        metavar="NAME|FILE",
        rich_help_panel=DEVICES,
        autocompletion=complete_projector,
    ),
]
ExposureFraction = Annotated[float, typer.Option(help="brightest pixel, as a part of full well", metavar="PART")]
Resume = Annotated[
    bool,
    typer.Option("--resume", help="go on where an interrupted one of the same options stopped", rich_help_panel=OUTPUT),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="replace the file", rich_help_panel=OUTPUT)]


# ---- groups of options -----------------------------------------------------------------------------------------------


def option(default: Any, help: str, *names: str, **more: Any) -> Any:
    """A field of a group of options.

    Parameters
    ----------
    default
        its value where it is not given; ``...``: it must be given.
    help
        what the help says of it.
    names
        of the option, where they are not the field's.
    more
        arguments of :class:`typer.Option`.
    """
    metadata = {"option": typer.Option(*names, help=help, **more)}
    return field(metadata=metadata) if default is ... else field(default=default, metadata=metadata)


def verb(function: Callable[..., int]) -> Callable[..., int]:
    """The ``function`` of a verb with the fields of its groups of options for parameters, as typer reads them. A
    group's own fields stand before those that it inherits, below the heading of the help that its ``PANEL`` names."""
    hints = get_type_hints(function, include_extras=True)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    options: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(function).parameters.items():
        options += _options_of(groups[name]) if name in groups else [_option(name, hints[name], parameter.default)]

    @functools.wraps(function)
    def call_ungrouped(**values: Any) -> int:
        for name, group in groups.items():
            values[name] = group(**{field: values.pop(field) for field in group.__dataclass_fields__})
        return function(**values)

    call_ungrouped.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    call_ungrouped.__annotations__ = {option.name: option.annotation for option in options}
    return call_ungrouped


def _options_of(group: Any) -> Iterator[inspect.Parameter]:
    hints, fields = get_type_hints(group, include_extras=True), group.__dataclass_fields__
    for base in group.__mro__:
        for name in inspect.get_annotations(base):
            declared = fields[name].metadata.get("option")
            default = inspect.Parameter.empty if fields[name].default is MISSING else fields[name].default
            hint = Annotated[hints[name], declared] if declared else hints[name]
            yield _option(name, hint, default, vars(base).get("PANEL"))


def _option(name: str, hint: Any, default: Any, panel: str | None = None) -> inspect.Parameter:
    """A parameter, whose option has the ``panel`` where it names none, and a word for its value."""
    if get_origin(hint) is Annotated and isinstance(hint.__metadata__[0], OptionInfo):
        shown = copy.copy(hint.__metadata__[0])
        shown.rich_help_panel = shown.rich_help_panel or panel
        shown.metavar = shown.metavar or metavar_of((hint.__origin__, *get_args(hint.__origin__)))
        hint = Annotated[hint.__origin__, shown]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=hint)


def _variant(name: str) -> str:
    """The ``name``, refused when it is none that light can be traced in; every verb checks it alike."""
    from mitsim.core.environment import check_variant

    check_variant(name)
    return name


@dataclass(frozen=True)
class Common:
    """Options that every verb has."""

    PANEL = OUTPUT

    variant: str = option(
        DEFAULT_VARIANT,
        "Mitsuba variant: llvm_ad_mono, llvm_ad_rgb or llvm_ad_spectral; with a GPU, cuda_ for llvm_",
        callback=_variant,
        metavar="VARIANT",
        rich_help_panel=LIMITS,
    )
    as_json: bool = option(False, "one JSON object on stdout, nothing else there", "--json")
    quiet: bool = option(False, "no progress", "--quiet")
    verbose: bool = option(False, "say all that was found, not the result alone", "--verbose")

    def details(self, *lines: str) -> Sequence[str]:
        """Those ``lines`` that are printed with --verbose alone."""
        return lines if self.verbose else ()

    @contextmanager
    def job(self) -> Iterator[Job]:
        """A job of the verb's limits, with progress on stderr while the context lasts."""
        with progress(self.limits, self.quiet or self.as_json, running_seconds()) as job:
            yield replace(job, command=command_line())

    @property
    def limits(self) -> Limits:
        """Longest time and most memory of the job."""
        return Limits()


@dataclass(frozen=True)
class Limited(Common):
    """Options of verbs that may work for long."""

    PANEL = LIMITS

    max_seconds: float = option(Limits().seconds, "refuse work that would take longer", metavar="S")
    max_memory: float | None = option(
        None, "refuse work that would take more; nine tenths of what is free if not given", metavar="GIB"
    )

    @property
    def limits(self) -> Limits:
        """Those that are asked for."""
        return Limits(self.max_seconds, None if self.max_memory is None else self.max_memory * 2**30)


@dataclass(frozen=True)
class Pictured(Common):
    """Options of verbs whose work has pictures."""

    no_pictures: bool = option(False, "leave out pictures and the page report.html", "--no-pictures")


@dataclass(frozen=True)
class LimitedPictured(Limited, Pictured):
    """The same of those that may work for long."""


@dataclass(frozen=True)
class Sampling:
    """How finely light is sampled."""

    PANEL = QUALITY

    accuracy: float | None = option(None, "relative rms error of the expected frames", show_default="0.001")
    seconds: float | None = option(None, "the finest accuracy that a run of so long buys", metavar="S")
    seed: Seed = 0
    effects: Effects = ""


@dataclass(frozen=True)
class OfPatterns(Sampling):
    """The same of frames under patterns."""

    patterns: Patterns = "dots:7"


@dataclass(frozen=True)
class KnownPlan:
    """What is planned already."""

    PANEL = WHAT

    plan: Path | None = option(None, "file of `mitsim plan -o`: nothing is planned again", "--plan", metavar="FILE")

    def read(self, context: typer.Context, fields: Mapping[str, Any]) -> tuple[dict[str, Any], Plan | None]:
        """Checked fields of a request, and the plan in the file; None without one.

        Parameters
        ----------
        context, fields
            of the command line, and what it asks for; beside a plan that alone which is given.

        Raises
        ------
        MitsimError
            for a value that a field cannot have or that needs another plan, and a file that cannot be read.
        """
        if self.plan is None:
            return request_of(**fields), None
        request, found = request_of(**given_of(context, fields)), mitsim.Plan.load(self.plan)
        found.request_with(request)
        return request, found


@dataclass(frozen=True)
class LitScene:
    """What opens a scene, under its own light."""

    PANEL = DEVICES

    projector: Projector = None
    define: list[str] | None = option(None, "set a <default> of the scene", "-D", metavar="NAME=VALUE")
    outside: bool = option(False, "let the scene read files outside its own folder", "--allow-outside-files")

    def open_for_render(self, scene: str, variant: str) -> Bench:
        """The bench of a ``scene`` in a ``variant``; MitsimError as :func:`mitsim.open_bench`."""
        return mitsim.open_bench(scene, variant, None, self.projector, self.outside, True, **self.parameters)

    def check(self, scene: str, *patterns: str) -> None:
        """MitsimError, before the renderer is imported, for ``patterns`` that the ``scene``'s projector has too few
        pixels for."""
        from mitsim.bench.apparatus import check_scene

        check_scene(scene, self.parameters, self.outside, patterns)

    @property
    def parameters(self) -> dict[str, Any]:
        """The scene's parameters, by NAME=VALUE of each -D; MitsimError for what is not written so."""
        parameters = {}
        for text in self.define or ():
            name, equals, value = text.partition("=")
            if not (name and equals):
                raise MitsimError(f"-D {text!r}: give NAME=VALUE")
            if name in _BENCH_ARGUMENTS:
                raise MitsimError(
                    f"-D {text!r}: mitsim itself uses the name {name}; give the scene's <default> another"
                )
            parameters[name] = value
        return parameters


@dataclass(frozen=True)
class Devices(LitScene):
    """What opens a bench: a scene with its camera and projector."""

    camera: Camera = None

    def open(self, scene: str, variant: str, job: Job | None = None) -> Bench:
        """The bench that the options describe; MitsimError as :func:`mitsim.open_bench`.

        Parameters
        ----------
        scene, variant
            as there.
        job
            whose clock takes the seconds.
        """
        with nullcontext() if job is None else job.clock.stage("open scene"):
            return mitsim.open_bench(scene, variant, self.camera, self.projector, self.outside, **self.parameters)

    @property
    def arguments(self) -> dict[str, Any]:
        """What opens the bench in Python, by the names of :class:`mitsim.verbs.Opening`."""
        named = {"camera": self.camera, "projector": self.projector, "allow_outside_files": self.outside}
        return {**named, "parameters": self.parameters}

    @property
    def models(self) -> list[Path]:
        """Files of the camera and its mask, and of the projector, that are named."""
        from mitsim.core.configuration import locate
        from mitsim.devices.mask_profile import load_mask  # here: it imports numpy

        named = (self.camera, CAMERA), (self.projector, PROJECTOR)
        files = [locate(each, "calibration", ".toml", field) for each, field in named if each]
        mask = load_mask(files[0]) if self.camera else None
        return files if mask is None or mask.file is None else [*files, files[0].parent / mask.file]

    def check_exposure(self, exposure: Exposure) -> None:
        """MitsimError, before the renderer is imported, for an ``exposure`` that the camera cannot have."""
        from mitsim.bench.apparatus import check_devices
        from mitsim.devices.sensor import load_sensor

        path, _ = check_devices(self.camera, None)
        exposure.check(load_sensor(path), path)


def _choice(context: typer.Context, name: str) -> str:
    words = [NO, LINES, f"{BANDS}:K", MOSAIC, AUTO]
    if context.info_name == "calibrate":
        words.remove(AUTO)
    if name.startswith(f"{BANDS}:"):
        bands_of(name)
    elif name not in words:
        raise MitsimError(f"--colour {name!r}: use {', '.join(words[:-1])} or {words[-1]}")
    return name


@dataclass(frozen=True)
class Coloured(Devices):
    """What opens a bench, and which of its projector's light is told apart."""

    PANEL = WHAT

    colour: str = option(
        NO,
        "lines: sequential colour, each line of the projector in a folder of its own; bands:K: the same of K "
        "bands of its lines; mosaic: all lines at once, by a camera under colour filters; auto: no, bands or "
        "lines, as the accuracy needs (not calibrate); no: light that is not told apart",
        metavar="no|lines|bands:K|mosaic|auto",
        callback=_choice,
    )

    def traced_in(self, variant: str) -> str:
        """The variant that light is traced in: told apart, by the backend of ``variant`` that knows wavelengths.

        MitsimError for colour that the camera cannot have.
        """
        if self.colour == NO:
            return variant
        from mitsim.bench.apparatus import check_devices
        from mitsim.devices.sensor import load_sensor

        path, _ = check_devices(self.camera, None)
        mosaic = load_sensor(path).mosaic
        if self.colour == MOSAIC and mosaic is None:
            raise MitsimError(
                f"--colour mosaic: camera {path} has no mosaic of colour filters; give one that has, such as "
                "--camera imx249_rggb, or use --colour lines"
            )
        if self.colour != MOSAIC and mosaic is not None:
            raise MitsimError(
                f"--colour {self.colour}: camera {path} has a mosaic {mosaic}, whose frames show all lines at once; "
                "use --colour mosaic"
            )
        return variant if self.colour == AUTO else spectral_of(variant)

    def check_colour(self, variant: str, seconds: float | None = None) -> None:
        """Refuse colour that a bench would refuse, before the renderer is imported.

        Parameters
        ----------
        variant
            as asked for.
        seconds
            that a capture is to take; None: not said.

        Raises
        ------
        MitsimError
            for seconds, a variant that colours cannot be weighed from, and lines or bands that the projector does not
            have.
        """
        if self.colour == NO:
            return
        from mitsim.bench.apparatus import check_devices
        from mitsim.bench.request import check_untimed
        from mitsim.core.configuration import load_model

        check_untimed(seconds)
        _, path = check_devices(None, self.projector)
        if self.colour == AUTO:
            check_undecided(variant)
            return
        from mitsim.devices.projector import ProjectorModel

        model = load_model(path, ProjectorModel)
        lit = model.in_bands(bands_of(self.colour)) if self.colour.startswith(BANDS) else model
        lit.traced_lines  # noqa: B018 - checks itself


def by_line(colour: str) -> bool:
    """Whether ``colour`` is of lines, or bands of them, one after the other."""
    return colour.partition(":")[0] in (LINES, BANDS)


def in_colour(bench: Bench, colour: str) -> Bench:
    """The ``bench`` with the lines that ``colour`` names; MitsimError for more bands than its projector has lines."""
    return bench.in_bands(bands_of(colour)) if colour.startswith(BANDS) else bench


def command_line() -> str | None:
    """The command line of this program, as a shell takes it; None where another program calls what serves it."""
    program = Path(sys.argv[0])
    if program.stem != "mitsim" and (program.parent.name, program.stem) != ("mitsim", "__main__"):
        return None
    return printable(shlex.join(["mitsim", *sys.argv[1:]]))


# ---- what words say --------------------------------------------------------------------------------------------------


def request_of(options: object | None = None, **values: object) -> dict[str, Any]:
    """Checked fields of a request, without an accuracy that was not given; refused before work.

    Parameters
    ----------
    options, values
        a group of options, and single ones.
    """
    from mitsim.bench.request import Request

    values |= {} if options is None else vars(options)
    values = {name: value for name, value in values.items() if name != "accuracy" or value is not None}
    request = Request.of(**values).model_dump()
    return {name: request[name] for name in values}


def number_of(argument: str, text: str, words: Sequence[str] = ("auto",)) -> Any:
    """The number in a text, or one of a few words.

    Parameters
    ----------
    argument
        what a refusal names.
    text, words
        what was given, and the words that are allowed instead of a number.
    """
    if text in words:
        return text
    try:
        return float(text)
    except ValueError:
        raise ArgumentError(argument, f"{text!r}: give a number or {' or '.join(words)}") from None


def check_work(output: Path, resume: bool, kind: str, several: bool = False) -> None:
    """MitsimError, before the renderer is imported, where a RUN or CAL folder cannot be written.

    Parameters
    ----------
    output, resume
        the folder, and whether work in it is to go on.
    kind
        capture or calibration.
    several
        whether it is to hold several such folders.
    """
    from mitsim.core.files import check_output
    from mitsim.core.manifests import MANIFEST, resumable

    begun = (output / MANIFEST).is_file()
    if resume and begun and not several:
        resumable(output, kind)
    check_output(output, overwrite=resume and begun != several)


# ---- options that are not to be given --------------------------------------------------------------------------------


def option_name(name: str) -> str:
    """The option of the parameter ``name``."""
    return _SPELLED.get(name, f"--{name.replace('_', '-')}")


def is_given(context: typer.Context, name: str) -> bool:
    """Whether the command line of a ``context`` names the parameter ``name``."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def pop_patterns(request: dict[str, Any], known: Plan | None) -> str:
    """The patterns of a ``request``, which are taken out of its fields, or of a ``known`` plan; ArgumentError where
    both have some and they differ."""
    planned = () if known is None else (known.known_request.patterns,)
    patterns: str = request.pop("patterns", *planned)
    if known is not None and patterns != known.known_request.patterns:
        raise ArgumentError("patterns", f"{patterns!r}: {known.made_for('patterns')}")
    return patterns


def given_of(context: typer.Context, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Those ``fields`` that the command line of a ``context`` names."""
    return {name: value for name, value in fields.items() if is_given(context, name)}


def refuse_unused(context: typer.Context, names: Sequence[str], where: str) -> None:
    """Refuse options that have no effect: one that is passed over would be taken for obeyed.

    Parameters
    ----------
    context
        of the command line.
    names
        parameters that have no effect.
    where
        they have none, for the message.

    Raises
    ------
    MitsimError
        when one of them is given.
    """
    for name in names:
        if is_given(context, name):
            raise MitsimError(f"{option_name(name)}: has no effect {where}; leave it out")


def message_of(error: MitsimError) -> str:
    """The message of an ``error`` with its arguments written as options."""
    text = str(error)
    if isinstance(error, ArgumentError):
        text = f"{option_name(error.argument)}{text.removeprefix(error.argument)}"
    text = re.sub(r"^parameter (?=\w+=)", "-D ", text)
    return re.sub(
        r"(?<!-)\b(\w+(?==True)|max_seconds|max_memory)(=True)?", lambda m: "--" + m[1].replace("_", "-"), text
    )

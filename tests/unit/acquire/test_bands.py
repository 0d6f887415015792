"""Mono, bands or lines: the fewest runs that keep half of the accuracy, what is left of it, and what is said."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from mitsim.acquire import spectral as bands
from mitsim.api.bench import Bench
from mitsim.bench.request import Request
from mitsim.core.errors import MitsimError
from mitsim.core.manifests import RUN
from mitsim.core.seeds import integer
from mitsim.devices.patterns import Lighting
from mitsim.devices.projector import Lines
from mitsim.light.plan import Plan
from tests.unit.planner.invented_pilot_result import plan

LASERS = Lines((638.0, 520.0, 445.0), (0.5, 0.3, 0.2))
STAGES = {"plan": 1.0, "transport": 2.0, "truth": 3.0, "optics": 4.0, "write": 5.0}


def bench(coloured: bool = True, lines: Lines = LASERS, curve: object = None) -> Bench:
    """Plain numbers that are called a bench, whose other variants and bands say so."""
    found = SimpleNamespace(
        variant="llvm_ad_mono", projector=SimpleNamespace(lines=lines), words=("mono",),
        loaded=SimpleNamespace(coloured=("a tag",) if coloured else (), parting=()),
        sensor=SimpleNamespace(quantum_efficiency_curve=curve),
    )  # fmt: skip
    found.reopened = lambda name: SimpleNamespace(
        words=(name,), in_bands=lambda count: SimpleNamespace(words=(name, count))
    )
    return found  # type: ignore[return-value]


@pytest.fixture
def chosen(monkeypatch: pytest.MonkeyPatch) -> Callable[..., bands.Coloured]:
    """Chooses with invented errors; None of them may be looked for where none are given."""

    def choose(of: Bench, accuracy: float = 1e-2, errors: dict[str, float] | None = None) -> bands.Coloured:
        def found(self: Any, names: Any) -> dict[str, float]:
            assert errors is not None, "nothing needs to be looked for"
            assert [*names] == [*errors]
            return errors

        def planned(on: Any, request: Request) -> Plan:
            stages = sum(STAGES.values())
            return replace(plan(accuracy=request.accuracy), predicted=STAGES, predicted_seconds=stages, request=request)

        def looking(self: Any, whole: Bench, request: Request) -> None:
            self._bench = whole

        monkeypatch.setattr(bands._ColourPilot, "__init__", looking)
        monkeypatch.setattr(bands._ColourPilot, "errors", found)
        monkeypatch.setattr(bands, "reopen", lambda of, variant: of.reopened(variant))
        monkeypatch.setattr(bands, "plan_request", planned)

        def of_lines(whole: Any, kind: str) -> Any:
            return SimpleNamespace(plan=lambda request: planned({RUN: whole}[kind], request))

        monkeypatch.setattr(bands.SpectralBench, "of", of_lines)
        return bands.choose_colour(of, Request.of(accuracy=accuracy))

    return choose


@pytest.mark.parametrize(
    ("mono", "one", "two", "name", "words"),
    [
        (5e-3, 4e-3, 3e-3, "mono", ("llvm_ad_mono",)),
        (5.1e-3, 5e-3, 3e-3, "bands:1", ("llvm_ad_spectral", 1)),
        (6e-3, 6e-3, 4e-3, "bands:2", ("llvm_ad_spectral", 2)),
        (6e-3, 6e-3, 6e-3, "lines", ("llvm_ad_spectral",)),
    ],
)
def test_the_fewest_runs_that_leave_half_of_the_accuracy_are_chosen(
    chosen: Callable[..., bands.Coloured], mono: float, one: float, two: float, name: str, words: tuple[object, ...]
) -> None:
    """The frames get what the colours leave, in squares (planted: the whole accuracy for both)."""
    errors = {"mono": mono, "bands:1": one, "bands:2": two, "lines": 0.0}
    found = chosen(bench(), errors=errors)
    assert found.plan.colour is not None and found.plan.colour.chosen == name
    assert found.mono == (name == "mono") and found.bench.words == words  # type: ignore[attr-defined]
    assert found.plan.request is not None
    assert found.plan.accuracy**2 + errors[name] ** 2 == pytest.approx(1e-4)
    assert {each.name: each.error for each in found.plan.colour.candidates} == errors
    assert found.plan.warnings == plan(accuracy=found.plan.accuracy).warnings
    assert found.plan.row("spectrum").error_if_off == mono


def test_seconds_grow_by_what_lines_do_not_share(chosen: Callable[..., bands.Coloured]) -> None:
    """One plan, a fifth more tracing for each further run, all else anew; later stages are added to every way."""
    found = chosen(bench(), errors={"mono": 0.0, "bands:1": 0.0, "bands:2": 0.0, "lines": 0.0}).plan
    assert found.colour is not None
    looked = found.predicted["plan"] - STAGES["plan"]
    seconds = [each.seconds - looked for each in found.colour.candidates]
    assert seconds == pytest.approx([15, 15, 1 + 1.2 * 5 + 2 * 9, 1 + 1.4 * 5 + 3 * 9])
    # The same of a plan of three runs. (Planted: more of them for fewer.)
    of_three = bands._seconds({"plan": 1.0, "transport": 7.0, "optics": 27.0}, 3, 1, False)
    assert of_three == pytest.approx(1 + 5 + 9)
    # Where glass parts the lines they share nothing but the plan. (Planted: shared paths.)
    parted = bands._seconds({"plan": 1.0, "transport": 6.0, "optics": 27.0}, 3, 1, True)
    assert parted == pytest.approx(1 + 2 + 9)
    later = found.taking(start=7.0)
    assert later.colour is not None and later.colour.taken.seconds == pytest.approx(later.predicted_seconds)


def test_a_scene_in_greys_is_mono_without_a_look(chosen: Callable[..., bands.Coloured]) -> None:
    """But not under a camera whose efficiency differs by line; bands differ in the mask's shadow and are not told."""
    found = chosen(bench(coloured=False)).plan
    assert found.colour is not None and found.colour.chosen == "mono" and found.accuracy == 1e-2
    assert [(each.name, each.error) for each in found.colour.candidates] == [("mono", 0.0), ("lines", 0.0)]
    errors = {"mono": 0.1, "bands:1": 0.1, "bands:2": 0.1, "lines": 0.0}
    by_line = chosen(bench(coloured=False, curve="a curve"), errors=errors)
    assert by_line.plan.colour is not None and by_line.plan.colour.chosen == "lines"


def test_light_of_too_many_lines_is_flagged(chosen: Callable[..., bands.Coloured]) -> None:
    """Five lines are no candidate; the best of what is traced is taken, at the accuracy asked for, and says so."""
    many = Lines((450.0, 500.0, 550.0, 600.0, 650.0), (0.2,) * 5)
    errors = {"mono": 0.3, "bands:1": 0.2, "bands:2": 0.1, "bands:3": 0.03, "bands:4": 0.02}
    found = chosen(bench(lines=many), errors=errors).plan
    assert found.colour is not None and found.colour.chosen == "bands:4" and found.accuracy == 1e-2
    assert "colour: bands:4 leaves 2.0e-02 of a band's light" in found.warnings[-1]


def test_what_has_no_answer_is_refused() -> None:
    with pytest.raises(MitsimError, match="seconds 5: runs in colour are not planned by time"):
        bands.choose_colour(bench(), Request.of(seconds=5.0))
    spectral = SimpleNamespace(variant="llvm_ad_spectral")
    with pytest.raises(MitsimError, match="variant llvm_ad_spectral: open the bench with a mono variant"):
        bands.choose_colour(spectral, Request.of())  # type: ignore[arg-type]


@pytest.mark.parametrize(("error", "reported"), [(0.0, 0.0), (9e-7, 0.0), (0.0123, 0.013), (0.02, 0.02), (0.0991, 0.1)])
def test_errors_are_rounded_up_to_two_digits(error: float, reported: float) -> None:
    """A resumed run must find the same, whatever the order of its sums; rounding of single precision is none."""
    import numpy as np

    true = np.full((2, 3), 4.0)
    assert bands._relative(true * (1 + error), true) == reported
    assert bands._relative(np.zeros(3), np.zeros(3)) == 0.0


def test_a_plan_says_of_which_tag_mono_knows_no_colours(small_scene: Callable[..., Path]) -> None:
    """Without tracing: the error of a scene in greys is 0, that of another is not known."""
    from mitsim.api.bench import open_bench
    from mitsim.planner.planner import SceneFacts

    scene = small_scene()
    grey, red = (SceneFacts.of(open_bench(scene, albedo=a)).spectrum for a in ("0.5", "400:0.2, 700:0.5"))
    assert (grey.error_if_off, red.error_if_off) == (0.0, None)
    assert "1 of the scene's tags may have colours, the first small.xml:" in red.reason


@dataclass
class OfLines:
    """What a look asks of a bench: lines, and what the one alone is."""

    lines: Lines | None = None
    own: Lines = LASERS
    alone: Lines | None = None
    variant: str = "llvm_ad_mono"

    @property
    def projector(self) -> Any:
        return SimpleNamespace(lines=self.own, effective_wavelength_nm=self.own.wavelengths_nm[0])


def light(line: Lines) -> Any:
    """(1, 2, 1) of a single line: even in one pixel, and rising with the wavelength in the other."""
    import numpy as np

    (nm,), (share,) = line.wavelengths_nm, line.shares
    return share * np.array([[[1.0], [(nm / 500) ** 3]]])


@pytest.mark.parametrize(
    ("lines", "traced"),
    [(LASERS, [3, 2]), (Lines((450.0, 500.0, 550.0, 600.0, 650.0), (0.1, 0.3, 0.2, 0.3, 0.1)), [4, 1, 3])],
)
def test_a_look_finds_what_bands_leave_of_all_lines(
    lines: Lines, traced: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each against the sum of its own lines, the worst of several; mono before any other variant, and no more lines at
    once than paths carry. (Planted: bands against all lines; the last band's error for all.)"""
    import numpy as np

    asked: list[Any] = []

    def path_samples(self: Any, of: OfLines) -> list[Lines | None]:
        asked.append((of.variant, len(of.lines.shares) if of.lines else 0))
        return [*of.lines.single] if of.lines else [None]

    def electrons(self: Any, of: OfLines, found: Lines | None) -> Any:
        assert of.alone == found
        return np.array([[[1.0], [3.0]]]) if found is None else light(found)

    monkeypatch.setattr(bands._ColourPilot, "__init__", lambda self, whole: setattr(self, "_bench", whole))
    monkeypatch.setattr(bands._ColourPilot, "_path_samples", path_samples)
    monkeypatch.setattr(bands._ColourPilot, "_electrons", electrons)
    monkeypatch.setattr(bands, "reopen", lambda of, variant: replace(of, variant=variant))
    monkeypatch.setattr(bands, "line_alone", lambda of, line: replace(of, alone=line))
    look: Any = bands._ColourPilot
    found = look(OfLines(own=lines)).errors(["lines", "bands:1", "bands:2", "mono"])
    assert asked == [("llvm_ad_mono", 0), *(("llvm_ad_spectral", count) for count in traced)]

    def left(of: list[Lines], frames: Any) -> float:
        whole = sum(light(line) for line in of)
        return bands._relative(frames, whole)

    def leaves(band: Lines) -> float:
        return left([*band.single], light(Lines((band.mean_nm,), (sum(band.shares),))))

    first, second = lines.bands(2)
    assert list(found) == ["lines", "bands:1", "bands:2", "mono"] and found["lines"] == 0
    assert found["mono"] == left([*lines.single], np.array([[[1.0], [3.0]]])) > 0.1
    assert found["bands:1"] == leaves(*lines.bands(1))
    assert found["bands:2"] == max(leaves(first), leaves(second)) > 0


def test_a_look_is_at_few_rays_of_four_shots(monkeypatch: pytest.MonkeyPatch) -> None:
    """From the first to the last, pixels that they light alike in one class; electrons are photons times efficiency.
    (Planted: shots from the second on; irradiance alone.)"""
    import numpy as np

    rng, labels = np.random.default_rng(0), np.array([0, 1, 2, 3, 1])
    weights = np.array(rng.integers(0, 2, (9, 4)), dtype=float)
    weights[:, 3] = weights[:, 1]
    family = SimpleNamespace(lighting=Lighting(labels, weights))
    asked: dict[str, Any] = {}

    def simulation(of: Any, settings: Any) -> Any:
        def trace(seed: int, first: int, rays: int) -> Any:
            asked.update(traced=(seed, first, rays), settings=settings)
            return SimpleNamespace(by_line=lambda count: ["light"] * count)

        def accumulate(name: str, found: Any, of_labels: Any, rays: int) -> Any:
            asked.update(accumulated=(found, rays), labels=of_labels)
            return "accumulated"

        return SimpleNamespace(direct=SimpleNamespace(trace=trace), accumulate=accumulate)

    def expected(parts: Any, rows: Any, lighting: Any, seed: int, leaking: bool) -> Any:
        asked.update(rows=list(rows), lighting=lighting, leaking=leaking)
        return [SimpleNamespace(irradiance=np.full((2, 2), float(number))) for number in range(2)]

    monkeypatch.setattr(bands, "Simulation", simulation)
    monkeypatch.setattr(bands, "expected_of", expected)
    of: Any = SimpleNamespace(
        family=lambda patterns, seed: family,
        geometry=SimpleNamespace(diffracts=True, scene_distance=400.0),
        lines=None,
        projector=SimpleNamespace(effective_wavelength_nm=500.0),
        sensor=SimpleNamespace(efficiency=lambda nm: nm / 1000),
    )
    look = bands._ColourPilot(of, Request.of(patterns="dots:3", seed=3))
    assert np.array_equal(look._lighting.weights[:, look._lighting.labels], weights[[0, 2, 5, 8]][:, labels])
    assert look._lighting.weights.shape[1] == len({tuple(each) for each in weights[[0, 2, 5, 8]].T})
    assert look._settings.effects == {"diffraction"} and look._settings.depth == 400
    assert look._path_samples(of) == ["light"]
    of.lines = LASERS
    assert look._path_samples(of) == ["light"] * 3
    assert asked["traced"] == (integer(3, "colour"), 0, bands._RAYS_OF_BANDS) and asked["settings"] == look._settings
    found = look._electrons(of, "light")  # type: ignore[arg-type]
    assert found.shape == (2, 2, 2) and (found[1] == 250).all() and not found[0].any()
    assert asked["accumulated"] == ("light", bands._RAYS_OF_BANDS) and asked["labels"] is look._lighting.labels
    assert asked["rows"] == list(range(look._lighting.weights.shape[1])) and not asked["leaking"]
    for diffracts, effects in ((False, {}), (True, {"diffraction": False})):
        of.geometry.diffracts = diffracts
        assert not bands._ColourPilot(of, Request.of(effects=effects))._settings.effects
    few = SimpleNamespace(lighting=family.lighting.shots([1, 4]))
    of.family = lambda patterns, seed: few
    assert len(bands._ColourPilot(of, Request.of())._lighting.weights) == 2


def test_a_choice_falls_back_on_the_variant_that_was_set(chosen: Callable[..., bands.Coloured]) -> None:
    """Mono after a look at lines sets its own variant again; without a look the bench is the one that it was."""
    of = bench()
    found = chosen(of, errors={"mono": 0.0, "bands:1": 0.0, "bands:2": 0.0, "lines": 0.0})
    assert found.bench is not of and found.bench.words == ("llvm_ad_mono",)  # type: ignore[attr-defined]
    grey = bench(coloured=False)
    assert chosen(grey).bench is grey

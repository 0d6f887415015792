"""Mono, bands or lines: the fewest runs that keep half of the accuracy, what is left of it, and what is said."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from mitsim.capture import bands
from mitsim.capture.bench import Bench
from mitsim.capture.plan import Plan
from mitsim.capture.request import Request
from mitsim.core.errors import MitsimError
from mitsim.rig.projector import Lines
from tests.unit.capture.invented_evidence import plan

LASERS = Lines((638.0, 520.0, 445.0), (0.5, 0.3, 0.2))
STAGES = {"plan": 1.0, "transport": 2.0, "truth": 3.0, "optics": 4.0, "write": 5.0}


def bench(coloured: bool = True, lines: Lines = LASERS, curve: object = None) -> Bench:
    """Plain numbers that are called a bench, whose other variants and bands say so."""
    found = SimpleNamespace(
        variant="llvm_ad_mono", projector=SimpleNamespace(lines=lines), words=("mono",),
        loaded=SimpleNamespace(coloured=("a tag",) if coloured else ()),
        sensor=SimpleNamespace(quantum_efficiency_curve=curve),
    )  # fmt: skip
    found.in_variant = lambda name: SimpleNamespace(
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

        monkeypatch.setattr(bands._Look, "__init__", looking)
        monkeypatch.setattr(bands._Look, "errors", found)
        monkeypatch.setattr(bands, "plan_request", planned)
        monkeypatch.setattr(bands, "plan_lines", planned)
        monkeypatch.setattr(bands.ColourBench, "of", lambda whole, kind: whole)
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


@pytest.mark.parametrize(("error", "said"), [(0.0, 0.0), (9e-7, 0.0), (0.0123, 0.013), (0.02, 0.02), (0.0991, 0.1)])
def test_errors_are_rounded_up_to_two_digits(error: float, said: float) -> None:
    """A resumed run must find the same, whatever the order of its sums; rounding of single precision is none."""
    import numpy as np

    true = np.full((2, 3), 4.0)
    assert bands._relative(true * (1 + error), true) == said
    assert bands._relative(np.zeros(3), np.zeros(3)) == 0.0


def test_a_plan_says_of_which_tag_mono_knows_no_colours(small_scene: Callable[..., Path]) -> None:
    """Without tracing: the error of a scene in greys is 0, that of another is not known."""
    from mitsim.capture.decision import SceneFacts
    from mitsim.capture.opening import open_bench

    scene = small_scene()
    grey, red = (SceneFacts.of(open_bench(scene, albedo=a)).spectrum for a in ("0.5", "400:0.2, 700:0.5"))
    assert (grey.error_if_off, red.error_if_off) == (0.0, None)
    assert "1 of the scene's tags may have colours, the first small.xml:" in red.reason

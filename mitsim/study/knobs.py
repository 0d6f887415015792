"""One knob at a time: from a plan to the plans that differ from it in one choice, for `mitsim study accuracy`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from mitsim.capture.bench import Bench
from mitsim.capture.evidence import GROUPS, Evidence, Settings
from mitsim.capture.plan import Plan
from mitsim.optics.frames import ExpectedFrames

Target = Callable[[ExpectedFrames], float]
CELLS = (1, 2, 4)
ANCHORS = (1, 2, 3, 5)
LAYERS = (1, 2, 4, 8)
LINE_WIDTH_NM = 2.0
"""Assumed width of a laser diode's line, for the finer spectrum."""
SAMPLES = (1, 8, 64)


@dataclass(frozen=True)
class Variant:
    """One setting of the factored estimator: what was turned, to what, and the bench and plan that it makes.

    ``target`` as in :func:`mitsim.capture.light.collect`; the plan's own without it.
    """

    knob: str
    setting: str
    bench: Bench
    plan: Plan
    target: Target | None = None


def at_once(_: ExpectedFrames) -> float:
    """A target that any error meets: sampling stops after its first round, half of what the settings predict."""
    return float("inf")


def sampled(settings: Settings, samples: int) -> Settings:
    """Settings under which the first round takes so many samples of a projector pixel and of a cell in each group."""
    each = 2.0 * samples
    return replace(
        settings, direct_samples=each, anchored_samples=each / 8, indirect_samples=each, from_camera_samples=each
    )


def variants(bench: Bench, plan: Plan, evidence: Evidence, patience: float) -> Iterator[Variant]:
    """The plan with one knob turned; what would be traced for longer than ``patience`` [s] is left out."""
    now = plan.settings

    def changed(knob: str, setting: str, settings: Settings) -> Variant:
        return Variant(knob, setting, bench, replace(plan, settings=settings))

    for samples in SAMPLES:
        fixed = sampled(now, samples)
        if _tracing(fixed, evidence) <= patience:
            yield Variant("samples", f"{GROUPS * samples} samples", bench, replace(plan, settings=fixed), at_once)
    for cells in CELLS:
        yield changed("cells", f"{cells}x{cells} a pixel", replace(now, subdivision=cells))
    for anchors in ANCHORS:
        settings = replace(now, anchors=anchors)
        if _tracing(settings, evidence) <= patience:
            yield changed("anchors", f"{anchors}x{anchors}", settings)
    for layers in LAYERS:
        if layers in evidence.layers and (layers > 1 or len(evidence.layers) > 1):
            depths = evidence.layers[layers] if layers > 1 else ()
            yield changed("layers", str(layers), replace(now, layers=depths))
    yield changed("bounces", "one reflection", replace(now, effects=now.effects - {"interreflection"}))
    bounced = replace(now, effects=now.effects | {"interreflection"})
    if _tracing(bounced, evidence) <= patience:
        yield changed("bounces", "all, roulette", bounced)
    yield from (Variant("wavelengths", name, lit, plan) for name, lit in _spectra(bench))


def without(settings: Settings, names: frozenset[str]) -> Iterator[tuple[str, Settings]]:
    """Each effect's name, and the settings without it; numbers fall to one."""
    for name in sorted(names - {"speckle"}):
        yield name, replace(settings, effects=settings.effects - {name})
    if settings.anchors > 1:
        yield "anchors", replace(settings, anchors=1)
    if len(settings.depths) > 1:
        yield "layers", replace(settings, layers=())


def _spectra(bench: Bench) -> Iterator[tuple[str, Bench]]:
    """One effective wavelength, the projector's lines, and each of them as three of a line's width."""
    model = bench.projector
    lines = model.wavelengths_nm or (model.effective_wavelength_nm,)
    shares = model.radiant_shares or (1.0,)
    finer = tuple(line + step * LINE_WIDTH_NM / 3 for line in lines for step in (-1, 0, 1))
    choices = {
        "1 wavelength": ((model.effective_wavelength_nm,), (1.0,)),
        f"{len(lines)} line(s), the projector's": (lines, shares),
        f"{len(finer)}, lines {LINE_WIDTH_NM:g} nm wide": (finer, tuple(s / 3 for s in shares for _ in range(3))),
    }
    for name, (wavelengths, parts) in choices.items():
        changes = {"wavelengths_nm": wavelengths, "radiant_shares": parts}
        yield name, replace(bench, projector=model.model_copy(update=changes))


def _tracing(settings: Settings, evidence: Evidence) -> float:
    """Seconds of tracing what the settings predict, at the pilot's pace."""
    return evidence.connecting(settings, settings.anchors) + evidence.following(settings)

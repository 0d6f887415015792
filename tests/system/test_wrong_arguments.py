"""Wrong arguments of all that the Python face has: MitsimError of one line, and no other."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mitsim as ms

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.slow]

NO_KIND: list[Any] = [object(), b"x", np.array([]), 1j]
"""What no argument of the face may be."""


def needed(bench: ms.Bench, shots: ms.Capture, factors: ms.Factors, called: Callable[..., object]) -> dict[str, Any]:
    """Right arguments for those parameters of ``called`` that have no default."""
    given = {"scene": bench.loaded.path, "shots": shots, "factors": factors, "bench": bench, "psnr": 30.0}
    given |= dict.fromkeys(("image", "truth"), np.ones((2, 2)))
    given |= dict.fromkeys(("folder", "run", "calibration", "output", "path", "frames", "listed", "psf"), "new")
    given |= {"modelling": ms.Modelling("wave"), "model": "wave", "patterns": "dots:2", "variant": "llvm_ad_mono"}
    given |= {"method": "unrolled", "pairs": "new", "source": "new", "format": "mat", "camera": "imx249"}
    given |= {"reflectance": 0.5, "count": 1, "depth": 400.0, "stages": {}, "name": "x"}
    given |= {"picture": "new.png", "mesh": "new.obj", "size": 120.0, "distance": 400.0, "session": {}}
    parameters = inspect.signature(called).parameters.values()
    return {each.name: given[each.name] for each in parameters if each.default is each.empty and each.kind < 2}


FACE = {
    "ms": [name for name in ms.__all__ if not name[0].isupper()] + ["Limits", "Modelling", "Clock", "Job"],
    "bench": ["plan", "light", "capture", "capture_lines", "choose_colour", "in_variant", "in_bands", "calibrate_lines",
              "capture_mosaic", "calibrate_mosaic", "calibrate", "calibrate_depths", "write_session", "render",
              "with_board", "family", "windows_at", "parallax_from"],
    "shots": ["save"],
    "factors": ["save", "operator", "check_fit"],
}  # fmt: skip
"""Public functions, classes and methods that take arguments."""
WRONG: list[Any] = [
    *NO_KIND,
    *(None, True, False, 0, -1, 3, 10**40, 2**63, 0.5, -1e-300, 1e300, float("nan"), float("inf"), -float("inf")),
    *("", "x", "a\0b", "\udcff", "n" * 5000, (), [], {}, {"x": object()}, [1, "x"], (1.0, 2.0), np.ones((2, 3))),
    *(np.float32("nan"), np.int8(-1), Path("no such"), Path("n" * 5000), type, lambda: None, ms),
]
"""These, and values that are wrong for most."""
MORE = {
    # Whose right arguments check this machine, or make a whole demo: by kind alone, in test_verbs.py.
    "ms": [*(name for name in FACE["ms"] if name not in ("doctor", "demo")), "Request"],
    "bench": [*FACE["bench"], "speckle"],
    "shots": [*FACE["shots"], "read", "pattern_measurements", "measurements"],
    "factors": FACE["factors"],
    "light": ["expose", "save", "load", "speckle"],
    "image": ["save"],
    "rendered": ["save"],
    "plan": ["row", "taking", "save", "load"],
    "Request": ["of"],
    "request": ["with_values"],
    "clock": ["add"],
}
"""The same, and those of what they make in turn."""


class Worked(Exception):
    """Arguments were taken: work begins, which is another test's."""


@pytest.fixture(scope="module")
def face(shared_scene: Callable[..., Path]) -> dict[str, Any]:
    """What has public functions, by name."""
    bench = ms.open_bench(shared_scene("wrong", n=4))
    shots, factors = bench.capture("dots:2", accuracy=0.1), bench.calibrate(accuracy=0.1)
    return {
        "ms": ms,
        "bench": bench,
        "shots": shots,
        "factors": factors,
        "light": bench.light("dots:2", accuracy=0.1),
        "image": ms.reconstruct(shots, factors),
        "rendered": bench.render(spp=4),
        "plan": bench.plan("dots:2", accuracy=0.1),
        "Request": ms.Request,
        "request": ms.Request(),
        "clock": ms.Clock(),
    }


@pytest.fixture
def no_work(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Whatever traces light ends at once."""
    import mitsuba as mi

    from mitsim.transport import direct, integrator

    def works(*_: object, **__: object) -> None:
        raise Worked

    monkeypatch.setattr(integrator.Tracer, "_flights", works)
    monkeypatch.setattr(direct.FluxTracer, "sums", works)
    monkeypatch.setattr(mi, "render", works)
    yield


@pytest.mark.parametrize("of", MORE)
def test_any_value_is_taken_or_refused_in_a_line(
    of: str, face: dict[str, Any], no_work: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of many values for each parameter, also for those that a request has and of names that nothing has."""
    monkeypatch.chdir(tmp_path)
    owner, wrong = face[of], list[str]()
    for name in MORE[of]:
        called = getattr(owner, name)
        right = needed(face["bench"], face["shots"], face["factors"], called)
        parameters = inspect.signature(called).parameters
        names = [each.name for each in parameters.values() if each.kind in (1, 3)]
        if any(each.kind == each.VAR_KEYWORD for each in parameters.values()):
            names += [*(ms.Request.model_fields if of != "plan" else ()), "no_such_name"]
        for parameter in dict.fromkeys(names):
            for value in WRONG:
                try:
                    called(**{**right, parameter: value})
                except Worked:
                    pass
                except ms.MitsimError as refusal:
                    if len(str(refusal).splitlines()) != 1 or not str(refusal).isprintable():
                        wrong.append(f"{name}({parameter}={value!r:.60}): {refusal!r:.200}")
                except Exception as error:
                    wrong.append(f"{name}({parameter}={value!r:.60}): {error!r:.200}")
    assert not wrong, "\n".join(wrong)

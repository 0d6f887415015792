"""Wrong arguments of all that the Python face has: MitsimError of one line, and no other."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mitsim as ms
from tests import test_verbs

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.slow]


WRONG: list[Any] = [
    *test_verbs.WRONG,
    *(3, 2**63, -1e-300, 1e300, -float("inf"), "\udcff", Path("n" * 5000), lambda: None, ms),
]
"""These, and values that are wrong for most."""
MORE = {
    # Whose right arguments check this machine, or make a whole demo: by kind alone, in test_verbs.py.
    "ms": [name for name in (*ms.__all__,) if not name[0].isupper() and name not in ("doctor", "demo")],
    "classes": test_verbs.CLASSES,
    "bench": ["plan", "light", "capture", "capture_lines", "choose_colour", "in_variant", "in_bands", "calibrate_lines",
              "capture_mosaic", "calibrate_mosaic", "calibrate", "calibrate_depths", "write_session", "render",
              "with_board", "family", "windows_at", "parallax_from", "speckle"],
    "shots": ["save", "read", "pattern_measurements", "measurements"],
    "factors": ["save", "operator", "check_fit"],
    "light": ["expose", "save"],
    "image": ["save"],
    "rendered": ["save"],
    "plan": ["row", "taking", "save", "load"],
    "Request": ["of"],
    "request": ["with_values"],
    "clock": ["add"],
}  # fmt: skip
"""Public functions, classes and methods that take arguments, and those of what they make in turn."""


NEEDED = {"name": "x", "image": np.ones((2, 2)), "patterns": "dots:2", "session": {}}
"""Arguments of the right kind that the quick tests do not have."""


class Worked(Exception):
    """Arguments were taken: work begins, which is another test's."""


@pytest.fixture(scope="module")
def face(shared_scene: Callable[..., Path]) -> dict[str, Any]:
    """What has public functions, by name."""
    bench = ms.open_bench(shared_scene("wrong", n=4))
    shots, factors = bench.capture("dots:2", accuracy=0.1), bench.calibrate(accuracy=0.1)
    return {
        "ms": ms,
        "classes": ms,
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
        right = test_verbs.right(called, {**face, **NEEDED, "scene": face["bench"].loaded.path})
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
                    lines = str(refusal).splitlines()  # of the tables of a session all mistakes at once
                    if (len(lines) != 1 and "mistakes:" not in lines[0]) or not all(map(str.isprintable, lines)):
                        wrong.append(f"{name}({parameter}={value!r:.60}): {refusal!r:.200}")
                except Exception as error:
                    wrong.append(f"{name}({parameter}={value!r:.60}): {error!r:.200}")
    assert not wrong, "\n".join(wrong)

"""A study as a user may write one: squares of numbers, in two setups; a file named ``fatal`` ends the process once."""

import os
import signal
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mitsim.core.errors import MitsimError
from mitsim.studies.framework.experiment import Claim, Found, Point, Results, Scope
from mitsim.studies.framework.legacy import Experiment


def points(scope: Scope) -> Sequence[Point]:
    numbers = scope.choose((1, 2, 3), (1, 2))
    return [Point.of(scope.setup.with_parameters(mask=place), number=number) for place in "abcd" for number in numbers]


def measure(_: object, point: Point) -> Found:
    place, number = dict(point.setup.parameters)["mask"], int(point["number"])
    folder = Path(os.environ.get("TOY_FOLDER", "/nowhere"))
    (folder / "begun").open("a").write(f"{place}{number}\n")
    if (fatal := folder / f"fatal {place}{number}").exists():
        if fatal.read_text() == "once":
            fatal.unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    if (folder / f"refuse {place}{number}").exists():
        raise MitsimError(f"number {number}: is not wanted; give another")
    tempfile.mkdtemp()  # as a studio's, of a process that is ended
    seed = np.random.default_rng([ord(place), number])
    square = number**2 + seed.normal() / 100
    return Found(({"place": place, "number": number, "square": square},), {f"{place}{number}": np.full((2, 2), square)})


def claims(results: Results) -> Sequence[Claim]:
    mean = results.table.mean("square", number=2)
    return [Claim("Two squared is four", "4", "4", f"{mean}", "confirmed" if abs(mean.value - 4) < 0.1 else "wrong")]


def figures(results: Results) -> Mapping[str, object]:
    from mitsim.report.plots import curves  # not in the processes that measure: it takes a second

    by_number = results.table.means("square", "number")
    return {"squares.png": curves({"all": {"square": by_number}}, "number [1]", "square [1]")}


EXPERIMENT = Experiment("toy", "Squares", "How large are squares?", points, measure, claims, figures)

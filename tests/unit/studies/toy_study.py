"""A study as a user may write one: squares of numbers, in two setups; a file named ``fatal`` ends the process once."""

import os
import signal
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mitsim.core.errors import MitsimError
from mitsim.studies.framework.claims import Judged, mean_of
from mitsim.studies.framework.experiment import Found, Point, Scope, Study
from mitsim.studies.framework.panels import Lines


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


def at_four(rows: object) -> tuple[str, bool]:
    mean = mean_of(rows, "square")  # type: ignore[arg-type]
    return f"{mean}", abs(mean.value - 4) < 0.1


STUDY = Study(
    "toy",
    "Squares",
    "How large are squares?",
    points=points,
    measure=measure,
    claims=(Judged("Two squared is four", at_four, paper="4", where={"number": 2}),),
    panels=(Lines("number", "number [1]", file="squares", y="square", y_label="square [1]", colour="", facet=""),),
)

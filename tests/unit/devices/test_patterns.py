"""Pattern families: what is projected, what the solver is told, and what the light is sorted into are one thing."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import FAMILIES, hadamard_matrix, parse_patterns, pattern_family, shot_count

EXAMPLES = [
    *(form.replace("RxC", "3x5").replace("K", "4") for family in FAMILIES.values() for form in family.forms),
    *("dots:1", "dots:3", "dots:5", "dots:16", "dots:16x1", "hadamard:1", "hadamard:12", "random:5"),
]
"""Each form of every family, and more of some."""


@pytest.mark.parametrize("n", [16, 23])
@pytest.mark.parametrize("name", EXAMPLES)
def test_captures_are_the_patterns_that_the_solver_is_told(name: str, n: int) -> None:
    family = parse_patterns(name, n)
    rows, cross, columns = name.partition(":")[2].partition("x")
    k = int(rows or 1)
    # hadamard:1 is all ones, so it needs no second half.
    count = (k * int(columns) if cross else k**2) * (2 if name.startswith("hadamard") and k > 1 else 1)
    assert len(family.shots) == count == shot_count(name), "counted before patterns are made"
    assert len({capture.names for capture in family.shots}) == count, "streams would be shared"
    labels, weights = family.lighting.labels, family.lighting.weights
    assert labels.shape == (n * n,) and weights.shape[0] == count
    assert np.array_equal(np.unique(labels), np.arange(weights.shape[1])), "a class without pixels"
    measured: dict[tuple[int, int], np.ndarray] = {}
    for capture, row in zip(family.shots, weights, strict=True):
        light = family.light(capture)
        assert light.shape == (n, n) and np.array_equal(row[labels], light.ravel())
        assert np.isin(light, (0, 1)).all(), "a projector shows no other light than these families use"
        part = light if capture.sign == 0 else capture.sign * light
        measured[capture.row, capture.column] = measured.get((capture.row, capture.column), 0) + part
    assert len(measured) == family.left.shape[1] * family.right.shape[1]
    for (i, j), pattern in measured.items():
        assert np.array_equal(pattern, np.outer(family.left[:, i], family.right[:, j]))


@settings(max_examples=25, deadline=None)
@given(n=st.integers(1, 40), data=st.data())
def test_dots_light_every_pixel_exactly_once(n: int, data: st.DataObject) -> None:
    rows, columns = data.draw(st.integers(1, n)), data.draw(st.integers(1, n))
    family = parse_patterns(f"dots:{rows}x{columns}", n)
    assert np.array_equal(sum(family.light(capture) for capture in family.shots), np.ones((n, n)))
    labels, weights = family.lighting.labels, family.lighting.weights
    assert weights.shape == (rows * columns, rows * columns)
    assert np.array_equal(weights.sum(axis=0), np.ones(rows * columns)), "each class belongs to one pattern"
    assert len(np.unique(labels)) == rows * columns


def test_dots_of_two_periods_repeat_each_along_its_own_axis() -> None:
    family = parse_patterns("dots:3x2", 7)
    lit = family.light(next(c for c in family.shots if (c.row, c.column) == (1, 1)))
    assert np.array_equal(np.argwhere(lit), [(r, c) for r in (1, 4) for c in (1, 3, 5)])
    both, one = parse_patterns("dots:3x3", 7), parse_patterns("dots:3", 7)
    assert both.shots == one.shots
    assert np.array_equal(both.left, one.left) and np.array_equal(both.right, one.right)
    assert np.array_equal(both.lighting.labels, one.lighting.labels)


def test_hadamard_repeats_its_matrix_and_the_halves_complement() -> None:
    family = parse_patterns("hadamard:4", 10)
    assert family.signed
    assert np.array_equal(family.left[4:8], family.left[:4]) and np.array_equal(family.left[8:], family.left[:2])
    first, second = family.shots[6:8]
    assert (first.row, first.column) == (second.row, second.column) and (first.sign, second.sign) == (1, -1)
    assert np.array_equal(family.light(first) + family.light(second), np.ones((10, 10)))


@pytest.mark.parametrize("order", [1, 2, *(order for order in range(4, 69, 4) if order != 52)])
def test_hadamard_matrices_are_hadamard(order: int) -> None:
    matrix = hadamard_matrix(order).astype(int)
    assert np.isin(matrix, (-1, 1)).all()
    assert np.array_equal(matrix @ matrix.T, order * np.eye(order, dtype=int))
    assert (matrix[:, 0] == 1).all(), "the uniform pattern has to be among them"


def test_random_is_seeded_and_covers_every_pixel() -> None:
    # With k = 2 a quarter of the rows would be dark by chance: the cover must be made, not hoped for.
    family = parse_patterns("random:2", 64, seed=3)
    assert family.left.any(axis=1).all() and family.right.any(axis=1).all()
    assert sum(family.light(c) for c in family.shots).min() >= 1
    again, other = parse_patterns("random:2", 64, seed=3), parse_patterns("random:2", 64, seed=4)
    assert np.array_equal(family.left, again.left) and np.array_equal(family.right, again.right)
    assert not np.array_equal(family.left, other.left)
    assert not np.array_equal(family.left, family.right), "rows and columns need streams of their own"


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        *(("dots:17", "1 to 16"), ("dots:-1", "whole number"), ("dots:\u0667", "whole number")),
        *(("dots: 3", "whole number"), ("dots:7x", "whole number"), ("dots:7x14x3", "whole number")),
        *(("dots:4x17", "1 to 16"), ("hadamard:4x4", "whole number"), ("dots:", "use uniform")),
        *(("stripes:4", "use uniform"), ("Dots:4", "use uniform"), ("hadamard:32", "1 to 16")),
    ],
)
def test_refusals_are_one_line_that_names_the_value(text: str, fragment: str) -> None:
    with pytest.raises(MitsimError, match=fragment) as caught:
        parse_patterns(text, 16)
    message = str(caught.value)
    assert "\n" not in message
    # Which Hadamard matrices there are is told by what knows orders alone.
    assert repr(text) in message or (text == "hadamard:3" and "order 3 " in message)


TOY = """
import contextlib, io, json, sys
from mitsim.devices.patterns import pattern_family

@pattern_family("bars:K", label="broad bars")
def bars(axis):
    import numpy as np
    return (np.arange(axis.n)[:, None] * axis.k // axis.n == np.arange(axis.k)).astype(np.int8)

from mitsim.cli import run
done = {}
for line in sys.argv[1:]:
    sys.argv[1:] = line.split()
    code, out, err = 0, io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            run()
        except SystemExit as ended:
            code = ended.code or 0
    done[line] = code, out.getvalue(), err.getvalue(), "numpy" in sys.modules
from mitsim.report import label
print(json.dumps([done, label("bars:3")]))
"""
"""A family that is registered, and nothing else, and command lines of it."""


def test_a_registered_family_is_known_to_the_command_line(tmp_path: Path) -> None:
    """Help, pictures, a refusal before numpy's import and a label in reports, of one entry. (Planted: names of families
    written out in the help, or in what reads them.)"""
    helps = [f"{command} --help" for command in ("capture", "patterns")]
    refused = {
        "patterns bars:9 -o q --projector-pixels 8": "give 1 to 8, the projector's",
        "capture photograph --patterns bars:200 -o q": "give 1 to 128",
        "capture photograph --patterns bars -o q": "random:K or bars:K",
        "patterns bars:2 -o q --seed 1": "not drawn at random",
    }
    drawn = "patterns bars:2 -o p --projector-pixels 8"
    done = subprocess.run(
        [sys.executable, "-c", TOY, *helps, *refused, drawn],
        cwd=tmp_path, capture_output=True, text=True, env={"COLUMNS": "200", "HOME": str(tmp_path)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found, label = json.loads(done.stdout)
    for line in helps:
        assert "random:K or bars:K" in " ".join(found[line][1].split())
    for line, fragment in refused.items():
        code, _, err, numpy_is_there = found[line]
        assert code == 2 and fragment in err and (not numpy_is_there or "--seed" in line), found[line]
    assert found[drawn][0] == 0, found[drawn]
    assert len([*(tmp_path / "p" / "patterns").glob("pattern_*")]) == 4
    assert label == "9 broad bars"


def test_a_name_is_registered_once() -> None:
    with pytest.raises(ValueError, match="'dots' is there already; known are uniform, dots, "):
        pattern_family("dots:K")

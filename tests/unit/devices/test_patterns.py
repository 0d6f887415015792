"""Pattern families: what is projected, what the solver is told, and what the light is sorted into are one thing."""

import hashlib
import json
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import (
    FAMILIES,
    PatternFamily,
    hadamard_matrix,
    parse_patterns,
    pattern_family,
    read_name,
    shot_count,
)

EXAMPLES = [
    *(
        form.replace("RxC", "3x5").replace("K", "4").replace("ORDER", "cake-cutting")
        for family in FAMILIES.values()
        for form in family.forms
    ),
    *("dots:1", "dots:3", "dots:5", "dots:16", "dots:16x1", "hadamard:1", "hadamard:12", "random:5"),
]
"""Each form of every family, and more of some."""


@pytest.mark.parametrize("n", [16, 23])
@pytest.mark.parametrize("name", EXAMPLES)
def test_captures_are_the_patterns_that_the_solver_is_told(name: str, n: int) -> None:
    family = parse_patterns(name, n)
    rows, cross, columns = name.split(":")[1].partition("x") if ":" in name else ("", "", "")
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
        *(("hadamard:8:walsh", "order is 'walsh'; use natural, sequency, dyadic, cake-"), ("hadamard:8:", "is ''")),
        *(("hadamard:12:dyadic", "powers of 2; use such, or hadamard:12"), ("dots:4:dyadic", "whole number")),
        *(("hadamard::dyadic", "use uniform"), ("hadamard:32:natural", "1 to 16"), ("uniform:natural", "use uniform")),
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

@pattern_family("slats:K", label="broad slats")
def slats(axis):
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
print(json.dumps([done, [label("slats:3"), label("hadamard:8:dyadic")]]))
"""
"""A family that is registered, and nothing else, and command lines of it."""


def test_a_registered_family_is_known_to_the_command_line(tmp_path: Path) -> None:
    """Help, pictures, a refusal before numpy's import and a label in reports, of one entry. (Planted: names of families
    written out in the help, or in what reads them.)"""
    helps = [f"{command} --help" for command in ("capture", "patterns")]
    refused = {
        "patterns slats:9 -o q --projector-pixels 8": "give 1 to 8, the projector's",
        "capture photograph --patterns slats:200 -o q": "give 1 to 128",
        "capture photograph --patterns slats -o q": "random:K, slats:K",
        "patterns slats:2 -o q --seed 1": "not drawn at random",
    }
    drawn = "patterns slats:2 -o p --projector-pixels 8"
    environment = {"COLUMNS": "200", "HOME": str(tmp_path), "PYTHONPATH": str(Path(__file__).parents[3])}
    done = subprocess.run(
        [sys.executable, "-c", TOY, *helps, *refused, drawn],
        cwd=tmp_path, capture_output=True, text=True, env=environment,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found, label = json.loads(done.stdout)
    for line in helps:
        assert "random:K, slats:K" in " ".join(found[line][1].split())
    for line, fragment in refused.items():
        code, _, err, numpy_is_there = found[line]
        assert code == 2 and fragment in err and (not numpy_is_there or "--seed" in line), found[line]
    assert found[drawn][0] == 0, found[drawn]
    assert len([*(tmp_path / "p" / "patterns").glob("pattern_*")]) == 4
    assert label == ["9 broad slats", "64 Hadamard, dyadic"]


def test_a_name_is_registered_once() -> None:
    with pytest.raises(ValueError, match="'dots' is there already; known are uniform, dots, "):
        pattern_family("dots:K")


# ---- Own patterns ----

SQUARED = tuple((np.arange(256) / 255) ** 2)
"""Light of each grey level."""
FAMILY = parse_patterns("dots:3x5", 16)
STACK = np.stack([FAMILY.light(shot) for shot in FAMILY.shots])
GREY = np.random.default_rng(2).uniform(0.05, 1, (2, 16, 3))


def write_pngs(folder: Path, levels: np.ndarray) -> None:
    from PIL import Image

    folder.mkdir()
    for number, picture in enumerate(levels.astype(np.uint8)):
        Image.fromarray(picture).save(folder / f"{number}.png")


def factors_text(left: np.ndarray, right: np.ndarray) -> str:
    return f"left = {left.T.tolist()}\nright = {right.T.tolist()}\n"


WRITERS = {
    "real.npy": lambda path: np.save(path, STACK),
    "levels.npy": lambda path: np.save(path, (255 * STACK).astype(np.uint8)),
    "ones.npy": lambda path: np.save(path, STACK.astype(np.uint8)),
    "true.npy": lambda path: np.save(path, STACK.astype(bool)),
    "pages.tif": lambda path: tifffile.imwrite(path, (255 * STACK).astype(np.uint8), photometric="minisblack"),
    "pictures": lambda path: write_pngs(path, 255 * STACK),
    "colours": lambda path: write_pngs(path, np.stack([255 * STACK] * 3 + [255 + 0 * STACK], axis=-1)),
    "factors.toml": lambda path: path.write_text(factors_text(FAMILY.left, FAMILY.right)),
}


@pytest.mark.parametrize("name", WRITERS)
def test_own_patterns_that_equal_a_family_are_the_family(name: str, tmp_path: Path) -> None:
    """To the last bit, whatever holds them. (Planted: pages sorted as text; 0/1 of whole numbers taken for levels.)"""
    WRITERS[name](tmp_path / name)
    own = parse_patterns(str(tmp_path / name), 16)
    assert own.name == name and own.grey is None and own.shots == FAMILY.shots
    for mine, theirs in (
        *((own.left, FAMILY.left), (own.right, FAMILY.right)),
        *((own.lighting.labels, FAMILY.lighting.labels), (own.lighting.weights, FAMILY.lighting.weights)),
    ):
        assert mine.dtype == theirs.dtype and np.array_equal(mine, theirs)


@pytest.mark.parametrize("name", ["grey.npy", "grey", "grey.toml"])
def test_grey_patterns_show_rounded_levels_and_solve_with_their_factors(name: str, tmp_path: Path) -> None:
    """Light is that of the level of 8 bits; the product of the factors is nearest, within one level.

    (Planted: light of the product in place of the levels; the tone curve before the product.)
    """
    products = np.einsum("ri,cj->ijrc", *GREY).reshape(-1, 16, 16)
    levels, path = np.rint(255 * products), tmp_path / name
    if name == "grey":
        write_pngs(path, levels)
    elif name == "grey.npy":
        np.save(path, products)
    else:
        path.write_text(factors_text(*GREY))
    own = parse_patterns(read_name(str(path)), 16, 0, SQUARED)
    assert isinstance(own, PatternFamily) and len(own.shots) == 9
    for shot, level, weights in zip(own.shots, levels, own.lighting.weights, strict=True):
        light = own.light(shot)
        assert np.array_equal(light, (level / 255) ** 2) and np.array_equal(weights[own.lighting.labels], light.ravel())
        product = np.outer(own.left[:, shot.row], own.right[:, shot.column])
        assert np.abs(255 * np.sqrt(product) - level).max() < 1
        # Rounding is not what factors solve with: they are the ones that were asked for, but for a common scale.
        assert product == pytest.approx(np.outer(GREY[0][:, shot.row], GREY[1][:, shot.column]) ** 2, abs=4e-3)
    with pytest.raises(MitsimError, match="tone curve that is not known here"):
        parse_patterns(str(path), 16)


BLOT = STACK.copy()
BLOT[7, 3, 3] = 1 - BLOT[7, 3, 3]
HOSTILE = {
    "of NaN": (np.where(STACK, np.nan, 0), "values are not finite"),
    "negative": (STACK - 0.1, "numbers of -0.1 to 0.9; give numbers of 0 to 1"),
    "beyond 255": (300 * STACK, "numbers of 0 to 300"),
    "between": (2.5 * STACK, "numbers of 0 to 2.5; give numbers of 0 to 1, or whole numbers"),
    "none": (STACK[:0], "hold no pattern"),
    "dark": (0 * STACK, "are all dark"),
    "small": (STACK[:, :8, :8], "are of 8 x 8 pixels, and 16 x 16 are lit"),
    "not separable": (BLOT, "pattern 8 of 15 is no column times a row; give every pair"),
    "column by column": (
        np.roll(STACK, 1, axis=0),
        "not all, or not in order; give every pair of K left profiles",
    ),
    "incomplete": (STACK[:-1], "not all, or not in order"),
    "with a dark one": (np.concatenate([STACK, 0 * STACK[:1]]), "not all, or not in order"),
    "too many": (np.broadcast_to(np.uint8(1), (70_000, 2, 2)), "are 70000 or more; at most 65536"),
    "Python": (np.array([{}], dtype=object), "objects of Python"),
    "broken.toml": ("left = [1, ", "not valid TOML"),
    "half.toml": ("left = [[1]]", "two fields, left and right"),
    "ragged.toml": ("left = [[1], [1, 2]]\nright = [[1]]", "left is no list of rows of 16 numbers"),
    "words.toml": ("left = 3\nright = 4", "left is no list of rows of 16 numbers"),
    "nan.toml": (f"left = [{[math.nan] * 16}]\nright = [{[1] * 16}]", "numbers of nan to nan"),
    "tinted": (np.stack([255 * STACK, 255 * STACK, 0 * STACK], axis=-1), "are coloured or transparent"),
    "clear": (np.stack([255 * STACK] * 4, axis=-1), "are coloured or transparent"),
    "text.npy": ("no array", "cannot be read: damaged"),
    "words.png": ("no picture", "does not begin as a PNG"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_own_patterns_that_cannot_be_used_are_refused_in_one_line(case: str, tmp_path: Path) -> None:
    """(Planted: no look at numbers, at their size or at single patterns.)"""
    content, fragment = HOSTILE[case]
    path = tmp_path / (case if "." in case else "own" if np.ndim(content) == 4 else "own.npy")
    if isinstance(content, str):
        path.write_text(content)
    elif path.suffix:
        np.save(path, content, allow_pickle=True)
    else:
        write_pngs(path, content)
    with pytest.raises(MitsimError, match=re.escape(fragment)) as caught:
        parse_patterns(str(path), 16, 0, SQUARED)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_a_changed_file_is_noticed_by_its_sum(tmp_path: Path) -> None:
    """(Planted: a stated SHA-256 that nothing compares.)"""
    path = tmp_path / "own.npy"
    np.save(path, STACK)
    name = read_name(str(path))
    assert name == f"{path}#{hashlib.sha256(path.read_bytes()).hexdigest()}" and read_name(name) == name
    assert np.array_equal(parse_patterns(name, 16).left, FAMILY.left)
    np.save(path, STACK[::-1])
    for read in (read_name, lambda text: parse_patterns(text, 16)):
        with pytest.raises(MitsimError, match="were changed since"):
            read(name)

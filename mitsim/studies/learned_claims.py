"""Rows of networks and classical images in; what a network gains over the best classical image, with standard errors of
prints and of trainings, and what becomes of the paper's claims, out.

A gain is of each print, paired with the best classical image of the same frames. It has two standard errors: over
prints, each a mean over trainings, and over trainings, each a mean over prints. A claim holds where both say so. A
claim on the best or the worst of many has wider intervals, because chance has a part in that choice.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from mitsim.learn.requests import FLATNET, REFINED
from mitsim.report import IDEALISED, RENDERED, in_text
from mitsim.report.pages import Mean, Table, Value
from mitsim.studies.framework.claims import Holds, every, verdict, within
from mitsim.studies.framework.experiment import Claim, Results
from mitsim.studies.learned_bench import CONDITIONS, MISMATCHES
from mitsim.studies.learned_cells import VARIED
from mitsim.studies.learned_scores import AUTOMATIC, BEST

NONE = "none"
"""The training of classical images."""
_FAILS_DB = 3.0
"""What an image loses that fails: its squared error is then twice that of the best classical one."""
_CATASTROPHE_DB = 10.0
"""What a catastrophe loses: ten times the squared error. Chosen."""
_GOAL_DB = 1.0
"""Gain that is worth a network: what may be seen (the study of regularisation)."""
_AS_GOOD_DB = 0.5
"""What an image may lose and still be called no worse: half of what may be seen."""
_RESOLVED = 0.1
"""Contrast of fine bars that counts as resolution: what the eye needs of a print."""
_CAUGHT = 0.9
"""Part of the failed images that a flag must catch to be relied on. Chosen."""
_HOMES = {RENDERED: RENDERED, VARIED: RENDERED}
"""The condition that a set is of, without any mismatch; all others': idealised."""


class Kind(NamedTuple):
    """Networks that differ in their seed alone."""

    training: str
    method: str
    patterns: str

    @property
    def home(self) -> str:
        """The condition without mismatch."""
        return _HOMES.get(self.training, IDEALISED)

    def __str__(self) -> str:
        return f"{self.method} ({self.training})"


@dataclass(frozen=True)
class Gain:
    """A mean over ``prints``, and over ``trainings``; the best or worst of ``among`` such means."""

    prints: Mean
    trainings: Mean
    among: int = 1

    def within(self, low: float = -math.inf, high: float = math.inf) -> Holds:
        """Return whether it lies in a range from ``low`` to ``high``, by prints and by trainings."""
        return every(*(within(each, low, high, self.among) for each in (self.prints, self.trainings)))

    def __str__(self) -> str:
        """With both standard errors, where there are such."""
        return format(self)

    def __format__(self, sign: str) -> str:
        spread = "" if math.isnan(self.trainings.error) else f" (trainings {self.trainings.error:.2f})"
        return f"{self.prints:{sign}}{spread}"


class Matrix:
    """Everything that was scored, by kind and condition.

    Parameters
    ----------
    table
        rows of classical images and of networks.
    """

    def __init__(self, table: Table) -> None:
        self.rows: dict[tuple[Kind, str], list[Mapping[str, Value]]] = defaultdict(list)
        self.classical: dict[tuple[str, str, str], list[Mapping[str, Value]]] = defaultdict(list)
        for row in table.rows:
            training, method, patterns, condition = (
                str(row[name]) for name in ("training", "method", "patterns", "condition")
            )
            if training == NONE:
                self.classical[patterns, condition, str(row["weight"])].append(row)
            else:
                self.rows[Kind(training, method, patterns), condition].append(row)
        self.kinds = list(dict.fromkeys(kind for kind, _ in self.rows))
        self.patterns = list(dict.fromkeys(patterns for patterns, *_ in self.classical))
        there = {condition for _, condition, _ in self.classical}
        self.conditions = [name for name in CONDITIONS if name in there]

    def best_classical(self, patterns: str, condition: str, weight: str = BEST) -> dict[Value, Mapping[str, Value]]:
        """The classical row of the highest PSNR for each print.

        Parameters
        ----------
        patterns, condition
            of the frames.
        weight
            how methods' weights were chosen.
        """
        best: dict[Value, Mapping[str, Value]] = {}
        for row in self.classical[patterns, condition, weight]:
            if row["picture"] not in best or _level(row) > _level(best[row["picture"]]):
                best[row["picture"]] = row
        return best

    def level(self, kind: Kind, condition: str, column: str = "psnr_db") -> Gain:
        """Mean of a column.

        Parameters
        ----------
        kind, condition
            whose images, of what.
        column
            that is averaged.
        """
        return _mean((row["picture"], row["seed"], row[column]) for row in self.rows_with(kind, condition, column))

    def gain(self, kind: Kind, condition: str, column: str = "psnr_db", weight: str = BEST) -> Gain:
        """Mean of what a kind has over the best classical image.

        Parameters
        ----------
        kind, condition
            whose images, of what.
        column
            that is compared.
        weight
            how classical weights were chosen.
        """
        best = self.best_classical(kind.patterns, condition, weight)
        return _mean(
            (row["picture"], row["seed"], _number(row, column) - _number(best[row["picture"]], column))
            for row in self.rows_with(kind, condition, column)
        )

    def loss(self, kind: Kind, condition: str) -> Gain:
        """What a ``kind`` loses under a ``condition`` of its own PSNR without mismatch [dB]."""
        home = {(row["picture"], row["seed"]): row["psnr_db"] for row in self.rows_with(kind, kind.home, "psnr_db")}
        return _mean(
            (row["picture"], row["seed"], float(home[row["picture"], row["seed"]]) - _number(row, "psnr_db"))  # type: ignore[arg-type]
            for row in self.rows_with(kind, condition, "psnr_db")
        )

    def mismatches(self, kind: Kind) -> list[str]:
        """Conditions that networks of a ``kind`` did not learn on."""
        return [name for name in self.conditions if name not in (kind.home, IDEALISED)]

    def of(self, training: str, patterns: str) -> list[Kind]:
        """All kinds of a ``training`` under some ``patterns``."""
        return [kind for kind in self.kinds if (kind.training, kind.patterns) == (training, patterns)]

    def rows_with(self, kind: Kind, condition: str, column: str = "psnr_db") -> list[Mapping[str, Value]]:
        """Rows of a kind that have a number in a column: PSNR is of pictures, and not of bars.

        Parameters
        ----------
        kind, condition
            whose rows.
        column
            the column.
        """
        return [row for row in self.rows[kind, condition] if row.get(column) is not None]


def _level(row: Mapping[str, Value]) -> float:
    """PSNR of a row, of bars that of bars [dB]."""
    return _number(row, "psnr_db" if row.get("psnr_db") is not None else "bars_db")


def _number(row: Mapping[str, Value], column: str) -> float:
    value = row[column]
    assert isinstance(value, (int, float)), "a column of numbers"
    return float(value)


def _mean(values: Iterable[tuple[Value, Value, Any]]) -> Gain:
    """Of (print, seed, number)."""
    prints, seeds = defaultdict(list), defaultdict(list)
    for picture, seed, value in values:
        prints[picture].append(float(value))
        seeds[seed].append(float(value))
    means = ([sum(each) / len(each) for each in by.values()] for by in (prints, seeds))
    of_prints, of_trainings = (Mean.of_numbers(each, "a network") for each in means)
    return Gain(of_prints, of_trainings)


# -------- Claims


def find_claims(results: Results) -> Sequence[Claim]:
    """Verdicts from all ``results``, of what was measured."""
    matrix = Matrix(results.table)
    makers = (_simulation, _flatnet, _resolution, _coded_light, _catastrophe, _goal, _many_patterns, _variation, _flags)
    return [claim for make in makers for claim in make(matrix)]


def _best(matrix: Matrix, training: str, patterns: str, condition: str) -> tuple[Kind, Gain] | None:
    """Return the kind of a training that gains most, and its gain as the best of all these kinds."""
    kinds = matrix.of(training, patterns)
    gains = [(kind, replace(matrix.gain(kind, condition), among=len(kinds))) for kind in kinds]
    return max(gains, key=lambda item: item[1].prints.value, default=None)


def _simulation(matrix: Matrix) -> list[Claim]:
    ideal, rendered = (_best(matrix, name, "uniform", name) for name in (IDEALISED, RENDERED))
    if not ideal or not rendered:
        return []
    one, other = (f"{kind.method} {gain:+} dB over the best classical image" for kind, gain in (ideal, rendered))
    claim = "On frames like those that they were trained on learned methods are best (uniform light)"
    return [Claim(claim, "best", one, other, verdict(ideal[1].within(low=0)))]


def _flatnet(matrix: Matrix) -> list[Claim]:
    kind, own = Kind(IDEALISED, FLATNET, "uniform"), Kind(RENDERED, FLATNET, "uniform")
    if kind not in matrix.kinds or own not in matrix.kinds:
        return []
    gain = matrix.gain(kind, RENDERED)
    texts = (
        f"{matrix.gain(kind, IDEALISED):+} dB over the best classical image",
        f"{gain:+} dB; trained on rendered pairs {matrix.gain(own, RENDERED):+} dB",
    )
    claim = f"FlatNet trained on the idealised model fails on real frames under uniform light (by {_FAILS_DB:g} dB)"
    return [Claim(claim, "fails to recover", *texts, verdict(gain.within(high=-_FAILS_DB)))]


def _resolution(matrix: Matrix) -> list[Claim]:
    kind = Kind(RENDERED, REFINED, "uniform")
    bars = [row["cycles"] for row in matrix.rows[kind, RENDERED] if row.get("cycles") is not None]
    if not bars:
        return []
    gain, cycles = matrix.gain(kind, RENDERED), max(float(each) for each in bars)  # type: ignore[arg-type]
    best = matrix.best_classical("uniform", RENDERED)
    fine = [row for row in matrix.rows[kind, RENDERED] if row.get("cycles") == cycles]
    contrast = _mean((row["picture"], row["seed"], row["contrast"]) for row in fine)
    more = _mean((row["picture"], row["seed"], _more(row, best)) for row in fine)
    detail = matrix.gain(kind, RENDERED, "detail")
    text = (
        f"{gain:+} dB; contrast at {cycles:g} cycles a pixel {contrast.trainings} of {fine[0]['true_contrast']:.2f}, "
        f"{more.trainings:+} over the best classical image; correlation of detail {detail.prints:+}"
    )
    claim = "A U-Net after least squares removes artefacts, and resolves no more (uniform light)"
    holds = every(gain.within(low=0), within(more.trainings, high=_RESOLVED))
    return [Claim(claim, "fails to improve the spatial resolution", "", text, verdict(holds))]


def _more(row: Mapping[str, Value], best: Mapping[Value, Mapping[str, Value]]) -> float:
    return _number(row, "contrast") - _number(best[row["picture"]], "contrast")


def _coded_light(matrix: Matrix) -> list[Claim]:
    kinds = matrix.of(IDEALISED, "dots:7")
    if not kinds:
        return []
    ideal, rendered = ({kind: matrix.gain(kind, name) for kind in kinds} for name in (IDEALISED, RENDERED))
    one, other = (", ".join(f"{kind.method} {gain:+} dB" for kind, gain in each.items()) for each in (ideal, rendered))
    holds = every(*(gain.within(low=-_FAILS_DB) for gain in rendered.values()))
    claim = f"Trained on the idealised model, all do well under 49 dots (within {_FAILS_DB:g} dB of the best classical)"
    return [Claim(claim, "similar to least squares", one, other, verdict(holds))]


def _catastrophe(matrix: Matrix) -> list[Claim]:
    found = [(matrix.gain(kind, name), kind, name) for kind in matrix.kinds for name in matrix.mismatches(kind)]
    if not found:
        return []
    gain, kind, name = min(found, key=lambda item: item[0].prints.value)
    gain = replace(gain, among=len(found))
    own = max(
        ((matrix.loss(other, each), other, each) for other in matrix.kinds for each in matrix.mismatches(other)),
        key=lambda item: item[0].prints.value,
    )
    plain = matrix.gain(kind, name, weight=AUTOMATIC)
    text = (
        f"worst of {len(found)} {gain:+} dB against the best classical image of the same frames "
        f"({plain.prints:+} at automatic weights): "
        f"{kind}, {in_text(kind.patterns)}, {name}; "
        f"worst loss of its own {own[0]} dB: {own[1]}, {in_text(own[1].patterns)}, {own[2]}"
    )
    claim = f"The worst mismatch is catastrophic (loses {_CATASTROPHE_DB:g} dB against the best classical image)"
    return [Claim(claim, "catastrophic results in case of any mismatch", "", text,
                  verdict(gain.within(high=-_CATASTROPHE_DB)))]  # fmt: skip


def _goal(matrix: Matrix) -> list[Claim]:
    best = _best(matrix, RENDERED, "uniform", RENDERED)
    if not best:
        return []
    kind, gain = best
    claim = f"The best network is {_GOAL_DB:g} dB over the best classical image under uniform light"
    return [Claim(claim, "", "", f"{kind} {gain:+} dB", verdict(gain.within(low=_GOAL_DB)))]


def _many_patterns(matrix: Matrix) -> list[Claim]:
    best = _best(matrix, RENDERED, "dots:7", RENDERED)
    if not best:
        return []
    kind, gain = best
    claim = f"Under 49 dots the best network is no worse than the best classical image (by {_AS_GOOD_DB:g} dB)"
    return [Claim(claim, "", "", f"{kind} {gain:+} dB", verdict(gain.within(low=-_AS_GOOD_DB)))]


def mean_mismatch(matrix: Matrix, kind: Kind) -> Gain:
    """Mean gain over all mismatches.

    Parameters
    ----------
    matrix, kind
        of everything, the networks.
    """
    found = []
    for name in matrix.mismatches(kind):
        best = matrix.best_classical(kind.patterns, name)
        rows = matrix.rows_with(kind, name)
        found += [(row["picture"], row["seed"], _level(row) - _level(best[row["picture"]])) for row in rows]
    return _mean(found)


def _variation(matrix: Matrix) -> list[Claim]:
    """Of each method, on the conditions that all sets but the idealised call a mismatch."""
    claims = []
    for patterns in matrix.patterns:
        pairs = [(Kind(RENDERED, kind.method, patterns), kind) for kind in matrix.of(VARIED, patterns)]
        gains = {}
        for plain, varied in pairs:
            more = [
                (row["picture"], row["seed"], _level(row) - _level(other))
                for name in matrix.mismatches(varied)
                for row in matrix.rows_with(varied, name)
                for other in matrix.rows_with(plain, name)
                if (row["picture"], row["seed"]) == (other["picture"], other["seed"])
            ]
            gains[varied.method] = _mean(more)
        if gains:
            text = ", ".join(f"{method} {gain:+} dB" for method, gain in gains.items())
            claim = f"Benches that vary in training make networks bear a mismatch ({in_text(patterns)})"
            holds = every(*(gain.within(low=0) for gain in gains.values()))
            claims.append(Claim(claim, "", "", text, verdict(holds)))
    return claims


MISFIT = ("flag_image", "flag_frames")
"""Columns on misfit: frames that the image does not give, and frames that no image gives."""


def count_failures(matrix: Matrix, kinds: Iterable[Kind]) -> tuple[int, int, int, int]:
    """Images that fail and are flagged for misfit, those that fail; others that are flagged for it, and all others.

    One fails that is far below the best classical image of the same print and patterns, on a calibrated bench where the
    condition is a mismatch: there the classical image of its own frames fails too.

    Parameters
    ----------
    matrix, kinds
        of everything, and whose images are counted.
    """
    counts = [0, 0, 0, 0]
    for kind in kinds:
        for condition in matrix.conditions:
            best = matrix.best_classical(kind.patterns, RENDERED if condition in MISMATCHES else condition)
            for row in matrix.rows_with(kind, condition):
                place = 0 if _level(row) < _level(best[row["picture"]]) - _FAILS_DB else 2
                counts[place] += any(bool(row[flag]) for flag in MISFIT)
                counts[place + 1] += 1
    return counts[0], counts[1], counts[2], counts[3]


def _flags(matrix: Matrix) -> list[Claim]:
    few = len({row["seed"] for rows in matrix.rows.values() for row in rows}) < 2
    claims = []
    for patterns in matrix.patterns:
        own = [kind for kind in matrix.kinds if kind.patterns == patterns]
        bad, of_bad, false, of_good = count_failures(matrix, own)
        if not of_bad:
            continue
        text = f"{bad} of {of_bad} that fail are flagged, and {false} of {of_good} others"
        claim = (
            f"Misfit, of the re-projected image or of the frames, flags what is {_FAILS_DB:g} dB below the best "
            f"classical image of a calibrated bench ({_CAUGHT:.0%} or more of it, and at most {1 - _CAUGHT:.0%} of the "
            f"others; {in_text(patterns)})"
        )
        holds = bad >= _CAUGHT * of_bad and false <= (1 - _CAUGHT) * of_good
        claims.append(Claim(claim, "", "", text, verdict(None if few else holds)))
    return claims

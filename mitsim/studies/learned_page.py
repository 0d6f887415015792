"""What networks were scored, in; tables and figures of the study's page out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from matplotlib.figure import Figure

from mitsim.core.arrays import FloatArray
from mitsim.learn.requests import FLATNET
from mitsim.reconstruct.misfit import UNEXPLAINED
from mitsim.reconstruct.request import TIKHONOV
from mitsim.report import IDEALISED, RENDERED, in_text, label
from mitsim.report.pages import DASH, Mean
from mitsim.report.plots import grouped_bars, image_grid
from mitsim.studies.framework.experiment import QUICK_IMAGES, Results
from mitsim.studies.framework.page import Part
from mitsim.studies.learned_cells import ELSEWHERE, PICTURES
from mitsim.studies.learned_claims import MISFIT, Gain, Kind, Matrix, count_failures, mean_mismatch
from mitsim.studies.learned_scores import AUTOMATIC, BEST, WEIGHTS

TRUTH = "truth"
"""Among the arrays of a classical point: what images are compared with."""


def tables(results: Results) -> Sequence[Part]:
    """PSNR and gain for each family of patterns; flags, detail, and costs; of all ``results``."""
    matrix = Matrix(results.table)
    found = [make(matrix, patterns) for patterns in matrix.patterns for make in (_psnr_table, _gain_table)]
    return [*found, _flag_table(matrix), _misfit_table(matrix), _detail_table(matrix), _cost_table(matrix)]


def _psnr_table(matrix: Matrix, patterns: str) -> Part:
    rows = []
    for weight in WEIGHTS:
        by_condition = [matrix.classical[patterns, name, weight] for name in matrix.conditions]
        for method in dict.fromkeys(row["method"] for own in by_condition for row in own):
            cells = [_numbers((row for row in own if row["method"] == method), "psnr_db") for own in by_condition]
            shown = (str(Mean.of_numbers(each, "PSNR")) if each else DASH for each in cells)
            rows.append((f"{method}, {weight} weight", *shown))
    for kind in (kind for kind in matrix.kinds if kind.patterns == patterns):
        rows.append((str(kind), *(str(matrix.level(kind, name).prints) for name in matrix.conditions)))
    title = f"{label(patterns)}: mean PSNR [dB] by what is tested on, with its standard error over prints"
    return Part(title, "", ("image (training set)", *matrix.conditions), tuple(rows))


def _gain_table(matrix: Matrix, patterns: str) -> Part:
    rows = [
        (str(kind), *(_gain_text(matrix.gain(kind, name)) for name in matrix.conditions))
        for kind in matrix.kinds
        if kind.patterns == patterns
    ]
    title = (
        f"{label(patterns)}: gain over the best classical image of each print [dB], with its standard error over "
        "prints, and behind the comma that over trainings"
    )
    return Part(title, "", ("network (training set)", *matrix.conditions), tuple(rows))


def _gain_text(gain: Gain) -> str:
    """A gain with both standard errors, in few letters."""
    spread = "" if gain.trainings.of < 2 else f", {gain.trainings.error:.1f}"
    return f"{gain.prints:+}{spread}"


def _numbers(rows: Iterable[Mapping[str, object]], column: str) -> list[float]:
    """Numbers of the ``rows`` that have one in a ``column``."""
    return [float(value) for row in rows if isinstance(value := row.get(column), (int, float))]


def _flag_table(matrix: Matrix) -> Part:
    rows = []
    for kind in matrix.kinds:
        shares = []
        for name in matrix.conditions:
            own = matrix.rows_with(kind, name)
            flags = [sum(any(bool(row[flag]) for flag in both) for row in own) / len(own) for both in _FLAGS]
            shares.append(" / ".join(f"{100 * share:.0f}" for share in flags))
        bad, of_bad, false, of_good = count_failures(matrix, [kind])
        rows.append((f"{kind}, {in_text(kind.patterns)}", *shares, f"{bad} of {of_bad}", f"{false} of {of_good}"))
    title = (
        "Images that are flagged [%]: for misfit / for noise, a camera or a calibration that the network does not "
        "know; and of images 3 dB below the best classical one of a calibrated bench, and of others, how many misfit "
        "flags"
    )
    return Part(title, "", ("network", *matrix.conditions, "failed", "others"), tuple(rows))


_FLAGS = MISFIT, ("flag_noise", "flag_camera")
"""Columns of a network's row."""


def _misfit_table(matrix: Matrix) -> Part:
    rows = [
        (label(patterns), *(_mean(matrix.classical[patterns, name, BEST], "unexplained", "{:.1e}") for name in
                            matrix.conditions))
        for patterns in matrix.patterns
    ]  # fmt: skip
    title = f"Part of the frames that no image gives, beyond the sensor's noise, rms [1]; flagged above {UNEXPLAINED:g}"
    return Part(title, "", ("patterns", *matrix.conditions), tuple(rows))


def _detail_table(matrix: Matrix) -> Part:
    """Of rendered frames, where nothing is amiss."""
    every = [row for rows in matrix.classical.values() for row in rows]
    cycles = sorted(set(_numbers(every, "cycles")))
    rows = []
    for patterns in matrix.patterns:
        best = list(matrix.best_classical(patterns, RENDERED).values())
        true = (_mean(_bars(best, each), "true_contrast") for each in cycles)
        rows.append((f"{label(patterns)}, truth", *true, "1.00", "1.00"))
        named = [("best classical", best)]
        named += [(str(kind), matrix.rows[kind, RENDERED]) for kind in matrix.kinds if kind.patterns == patterns]
        for name, own in named:
            seen = (_mean(_bars(own, each), "contrast") for each in cycles)
            rows.append((f"{label(patterns)}, {name}", *seen, _mean(own, "detail"), _mean(own, "detail_energy")))
    heads = (*(f"contrast at {each:g}" for each in cycles), "detail, correlation", "detail, rms over true")
    title = (
        "Recovered or invented, rendered frames: contrast of bars by cycles a pixel; correlation of the image's detail "
        "(above an eighth of a cycle a pixel) with the truth's, and how much there is: much that does not correlate is "
        "invented"
    )
    return Part(title, "", ("image", *heads), tuple(rows))


def _bars(rows: Iterable[Mapping[str, object]], cycles: float) -> list[Mapping[str, object]]:
    return [row for row in rows if row.get("cycles") == cycles]


def _mean(rows: Iterable[Mapping[str, object]], column: str, form: str = "{:.2f}") -> str:
    """Mean of a column, or a dash."""
    own = _numbers(rows, column)
    return form.format(sum(own) / len(own)) if own else DASH


def _cost_table(matrix: Matrix) -> Part:
    rows = []
    for kind in matrix.kinds:
        own = [row for name in matrix.conditions for row in matrix.rows[kind, name]]
        gains = {name: matrix.gain(kind, name) for name in matrix.mismatches(kind)}
        worst = min(gains, key=lambda name: gains[name].prints.value)
        spent = _mean(own, "train_s", "{:.0f}"), _mean(own, "seconds", "{:.3f}")
        losses = _gain_text(mean_mismatch(matrix, kind)), f"{_gain_text(gains[worst])} ({worst})"
        rows.append((f"{kind}, {in_text(kind.patterns)}", *losses, *spent))
    for method in dict.fromkeys(row["method"] for own in matrix.classical.values() for row in own):
        for patterns in matrix.patterns:
            plain = (matrix.classical[patterns, name, AUTOMATIC] for name in matrix.conditions)
            seconds = _mean((row for each in plain for row in each if row["method"] == method), "seconds", "{:.3f}")
            rows.append((f"{method}, {in_text(patterns)}", DASH, DASH, "0", seconds))
    title = (
        "What a mismatch costs: gain over the best classical image [dB], mean of all mismatches and the worst of them; "
        "processor seconds of a training, and of an image"
    )
    return Part(title, "", ("image", "mean mismatch", "worst mismatch", "training [s]", "image [s]"), tuple(rows))


# -------- Figures


def figures(results: Results) -> Mapping[str, Figure]:
    """Losses by family; images where nothing is amiss, and of the worst mismatch; of all ``results``."""
    matrix, drawn = Matrix(results.table), {}
    for patterns in matrix.patterns:
        kinds = [kind for kind in matrix.kinds if kind.patterns == patterns]
        values = {
            f"{kind.method}, {kind.training}": (matrix.gain(kind, RENDERED).prints, mean_mismatch(matrix, kind).prints)
            for kind in kinds
        }
        axis = f"PSNR over the best classical image, {label(patterns).lower()} [dB]"
        name = f"mismatch_{patterns.replace(':', '')}.png"
        heads = "rendered frames", "mean of mismatches"
        groups = {mismatch: dict(zip(heads, pair, strict=True)) for mismatch, pair in values.items()}
        drawn[name] = grouped_bars(groups, axis, ordered=True)
    first = matrix.patterns[0]
    worst = min(
        ((matrix.gain(kind, name).prints.value, name) for kind in matrix.kinds if kind.patterns == first
         for name in matrix.mismatches(kind)),
        default=(0.0, RENDERED),
    )[1]  # fmt: skip
    for name in dict.fromkeys((RENDERED, worst)):
        drawn |= _images(results, matrix, first, name)
    return drawn


def _images(results: Results, matrix: Matrix, patterns: str, condition: str) -> dict[str, Figure]:
    """Truth, best classical image and networks, a row for each shown print; nothing where no images were kept."""
    shown = [name for name in QUICK_IMAGES if name in matrix.best_classical(patterns, condition)]
    best = matrix.best_classical(patterns, condition)
    rows: dict[str, list[tuple[FloatArray, str]]] = {}

    def add(name: str, row: Mapping[str, object], array: str) -> None:
        image = results.arrays.get((str(row["point"]), array))
        if image is not None:
            rows.setdefault(name, []).append((image, f"{row['psnr_db']:.1f} dB" if name != TRUTH else ""))

    for name in shown:
        add(TRUTH, best[name], f"{condition} {patterns} {TRUTH}")
        add("best classical", best[name], f"{condition} {patterns} {best[name]['method']} {BEST}")
        plain = _of_print(matrix.classical[patterns, condition, AUTOMATIC], name, TIKHONOV)
        add("automatic Tikhonov", plain, f"{condition} {patterns} {TIKHONOV} {AUTOMATIC}")
    for kind in (kind for kind in matrix.kinds if kind.patterns == patterns and _is_drawn(kind)):
        seed = min(row["seed"] for row in matrix.rows[kind, condition])  # type: ignore[type-var]
        by_print = {row["picture"]: row for row in matrix.rows[kind, condition] if row["seed"] == seed}
        for name in shown:
            add(_short(kind), by_print[name], f"{condition} {name}")
    whole = {name: cells for name, cells in rows.items() if len(cells) == len(shown)}
    across = {print_: [cells[index] for cells in whole.values()] for index, print_ in enumerate(shown)}
    title = f"{label(patterns)}, tested on {condition}; networks by their training set"
    return {f"images_{condition}.png": image_grid(across, list(whole), title)} if whole else {}


def _of_print(rows: Iterable[Mapping[str, object]], picture: str, method: str) -> Mapping[str, object]:
    """The row of a method and a print."""
    return next(row for row in rows if (row["picture"], row["method"]) == (picture, method))


def _is_drawn(kind: Kind) -> bool:
    """Whether it has a column among the images: the idealised FlatNet of the paper's claim, and all that was not
    trained on idealised or varied benches, so that a page holds them."""
    return kind.training in (RENDERED, ELSEWHERE, PICTURES) or (kind.training, kind.method) == (IDEALISED, FLATNET)


def _short(kind: Kind) -> str:
    return f"{kind.method} {kind.training}"

"""The report of a session: errors of factors beside their prediction, on drawn noise; losses of an image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from mitsim.calibrate import board_session
from mitsim.calibrate.calibrate import NOISE_FREE, NOISY, estimates
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import shipped_path
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.devices.patterns import parse_patterns, stripe_signs
from mitsim.reconstruct.solver import prepare
from mitsim.report.lit_scene import NONUNIFORMITY, SPECKLE
from mitsim.studies import calibration_study as module
from mitsim.studies.calibration_study import (
    AMBIENT,
    ERROR_SOURCES,
    LAMBDA,
    OFFSETS,
    RENDERING,
    REST,
    SESSION,
    STUDY,
    _tables,
    gain_without,
    judge_factors,
    judge_rest,
    losses,
    noises_of,
)
from mitsim.studies.framework.experiment import Point, Results, Scope, Setup
from mitsim.studies.framework.panels import flag_warnings
from mitsim.studies.framework.studio import Studio
from mitsim.studies.waterfall_study import SCENE
from tests.unit.calibrate.test_responses import CLIPPED, EXPOSURE_S, lit_session

N = 4
RNG = np.random.default_rng(2)
SEEDS = 40
Rows = list[dict[str, Any]]


def of_kind(rows: Rows, kind: str) -> Rows:
    return [row for row in rows if row["kind"] == kind]


def left_deviations(lit: Any, noisy: Any, clean: Any) -> FloatArray:
    """Errors (m, n) of the left factor's entries in predicted deviations."""
    found = noisy.left * (np.vdot(clean.left, clean.left) / np.vdot(noisy.left, clean.left))
    variances, _ = board_session.entry_variances(
        lit.session, lit.uniform_rate, lit.exposure_s, (clean.left, clean.right)
    )
    return np.asarray((found - clean.left) / np.sqrt(sum(variances.values(), np.zeros(1))))


@pytest.mark.parametrize(("mode", "repeats"), [("pair", 3), ("uniform", 1)])
def test_errors_of_factors_are_those_that_are_predicted(mode: str, repeats: int) -> None:
    """Over 40 sessions of their own noise: 168 and 189 entries of unit variance each, less what a common scale takes.
    What the uniform shot brings to all responses is in one column alone, and there as much as predicted. (Planted: the
    other side's common vector, N left out; shared noise over all columns, and left out.)"""
    lit = lit_session(7, mode, repeats=repeats)
    squares: dict[str, list[float]] = {"left": [], "right": []}
    found_errors, stated_errors, columns = [], [], []
    for seed in range(SEEDS):
        own = replace(lit, session=replace(lit.session, seed=seed))
        (noisy, clean), _, checked = estimates(own, Job(), (NOISY, NOISE_FREE))
        assert not checked.warnings, f"seed {seed}"
        rows = judge_factors(own, noisy, clean)
        columns.append(np.square(left_deviations(own, noisy, clean)).mean(axis=0))
        for row in of_kind(cast(Rows, rows), "entries"):
            squares[row["factor"]].append(row["chi_square"])
            found_errors.append(row["error"])
            stated_errors.append(row["predicted_error"])
    for values in squares.values():
        assert np.mean(values) == pytest.approx(1, abs=0.06)
    # 40 x 24 squares of unit variance: 5 standard errors.
    assert np.mean(columns, axis=0) == pytest.approx(1, abs=5 * np.sqrt(2 / (SEEDS * 24)))
    assert np.sqrt(np.mean(np.square(found_errors))) == pytest.approx(np.mean(stated_errors), rel=0.03)


def test_a_part_of_the_error_gains_what_is_left_without_it() -> None:
    """A quarter of an image's error is 1.25 dB; a model that has half of that error has it for half of its own, 3.01
    dB. Where twice as much is predicted as there is, it is an eighth, and it may be that all of what is too much is
    this part. (Planted: the sum over the part; uncertainty of the predicted image alone.)"""
    assert gain_without(1.0, 4.0, 2.0) == pytest.approx((1.2494, 3.0103 - 1.2494), abs=1e-4)
    assert gain_without(1.0, 4.0, 8.0) == pytest.approx((0.5799, 0.5799), abs=1e-4)
    assert gain_without(3.0, 4.0, 5.0) == pytest.approx((3.9794, 3.9794 - 3.0103), abs=1e-4)
    assert gain_without(0.0, 4.0, 0.0) == (0.0, 0.0) and gain_without(4.0, 4.0, 4.0)[0] == pytest.approx(90)
    # A deviation as large as the part; with what is not explained as squares add.
    alone = gain_without(1.0, 4.0, 4.0, 1.0)
    assert alone == pytest.approx((1.2494, 3.0103 - 1.2494), abs=1e-4)
    assert gain_without(1.0, 4.0, 2.0, 1.0)[1] == pytest.approx(2**0.5 * alone[1])


def test_noise_is_told_by_source_and_by_factor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a session whose noise is all in a row of pixels that sees no even light: mean over the rows of V over |v|^2 in
    the left factor, whose entries each stand for a row, and none in the right one, which sees rows weighed by v^2.
    Of an ambient frame and of speckle only where there are any. (Planted: both factors by the one side or by the other;
    sampling of the truth left out; one shot of a pair; the ambient frame's shots left out.)"""
    factors = 1 + RNG.random((3, N)), 1 + RNG.random((5, N))
    factors[0][0] = 0.0
    variance = np.zeros((3, 5))
    variance[0] = 6.0
    both = {"shot noise": variance}, {"shot noise": variance / 2}
    monkeypatch.setattr(board_session, "response_variances", lambda *_: both)
    session: Any = SimpleNamespace(
        session=SimpleNamespace(signs=stripe_signs(N)),
        uniform_rate=np.ones((3, 5)),
        exposure_s=1.0,
    )
    sampled = SimpleNamespace(flux_error=3.0, apparent=SimpleNamespace(error_of=lambda error: 2 * error, error=0.5))
    expected: Any = SimpleNamespace(has_ambient=False, projector_off=None)
    exposer = SimpleNamespace(electrons=lambda frame: frame, sensor_noise=lambda _: 6.0)
    amounts = {SPECKLE: 0.0, "read noise": 3.0, NONUNIFORMITY: 5.0}
    frames = SimpleNamespace(noises=lambda seconds: amounts, expected=expected, exposer=lambda seconds: exposer)
    stand: Any = SimpleNamespace(
        frames=frames, exposure_s=2.0, family=parse_patterns("dots:2", N),
        factors=SimpleNamespace(left=factors[0], right=factors[1]), lit=SimpleNamespace(light=sampled),
    )  # fmt: skip
    found = dict(noises_of(stand, session))
    common = factors[1].sum(axis=1)
    reported = found.pop((SESSION, "shot noise"))
    # Of noise of its own a mean over N responses; what these share is in the first of N columns.
    assert reported["left"] == pytest.approx(6 / 3 / (common @ common) * (1 / N + 0.5 / N)) and reported["right"] == 0
    assert found == {("capture", "read noise"): {"datum": 3.0}, ("capture", RENDERING): {"light": 36.25}}
    amounts[SPECKLE], expected.has_ambient = 1.0, True
    found = dict(noises_of(stand, session))
    assert found["capture", SPECKLE] == {"datum": 1.0}
    assert found["capture", AMBIENT] == {"ambient": pytest.approx(9.0 / 16)}, "a sixteenth of an image's for dots"
    stand.family = parse_patterns("hadamard:2", N)
    found = dict(noises_of(stand, session))
    assert found["capture", "read noise"] == {"datum": 6.0} and ("capture", AMBIENT) not in found


def test_parts_of_an_image_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise that is drawn is judged beside all that is, sampled light beside it and itself; causes are taken out one
    after another, pixels' differences first, and lambda's part is no part of the light. Independent coefficients of
    energies E have the mean E, and |b + e|^2 scatters by the root of 2 E^2 + 4 E b^2, and of 4 E E' in common with
    others: 4000 draws determine it to 1 %. (Planted: sampled light among what is drawn; each difference alone; each
    cause alone; lambda's part left out; common parts left out; the filter left out.)"""
    scene, left, right = RNG.random((N, N)), RNG.standard_normal((6, N)) + 0.3, RNG.standard_normal((7, N)) + 0.3
    noises = {("capture", "shot noise"): {"datum": 1e-4}, ("capture", "read noise"): {"datum": 2e-4}}
    noises["capture", RENDERING] = {"light": 3e-4}
    effects = "falloff", "mirrors", SCENE
    errors = {(): 0.1, ("mirrors",): 0.08, ("mirrors", SCENE): 0.05}
    off = {names: size * RNG.standard_normal((N, N)) for names, size in errors.items()}
    ablation = SimpleNamespace(effects=effects, without=lambda names: tuple(sorted(names)))
    monkeypatch.setattr(module.waterfall, "Ablation", lambda light: ablation)
    monkeypatch.setattr(module, "noises_of", lambda *_: noises)
    monkeypatch.setattr(module, "_DRAWS", 4000)
    family, lam = parse_patterns("dots:2", N), 0.1
    model = prepare(left, right, family.left, family.right)
    gain = model.sigma / (np.square(model.sigma) + lam)
    fixed = {NONUNIFORMITY: 0.1 * RNG.standard_normal((N, N)), OFFSETS: 0.1 * RNG.standard_normal((N, N))}
    data = tuple(model.coefficients(each) / gain for each in fixed.values())
    monkeypatch.setattr(module, "fixed_data", lambda *_: data)
    image = scene + 0.1 * RNG.standard_normal((N, N))
    clear, frames = cast(Any, SimpleNamespace()), {True: SimpleNamespace(prepare=lambda: model)}
    stand: Any = SimpleNamespace(
        lit=SimpleNamespace(truth=scene, light=(), rendered_frames=lambda own, *_: frames[own is clear]),
        before=SimpleNamespace(image=image, lam=lam), family=family, seed=1,
        clear=lambda factors, light: scene + off[light] if factors is clear else None,
    )  # fmt: skip
    rows = losses(stand, cast(Any, "session"), clear)
    found, (*_, last) = {(row["of"], row["source"]): row for row in rows}, rows
    steps = [off[()], off[()] + fixed[NONUNIFORMITY], off[()] + fixed[NONUNIFORMITY] + fixed[OFFSETS]]
    shot, read = (v * np.square(gain) for v in (1e-4, 2e-4))
    light = 3e-4 * np.square(gain * model.sigma)

    def deviation(energy: FloatArray, beside: FloatArray, others: FloatArray | float = 0.0) -> Any:
        square = np.square(model.coefficients(beside))
        return pytest.approx(float(np.sqrt((energy * (2 * energy + 4 * square + 4 * others)).sum())) / N**2, rel=0.06)

    for source, energy, others in (
        ("shot noise", shot, read),
        ("read noise", read, shot),
        (RENDERING, light, shot + read),
    ):
        assert found["capture", source]["squared_error"] == pytest.approx(energy.sum() / N**2, rel=0.04)
        assert found["capture", source]["deviation"] == deviation(energy, steps[2], others)
    squares = [float(np.mean(step**2)) for step in (*steps, *off.values())]
    for name, before, after in zip(fixed, squares, squares[1:], strict=False):
        assert found["capture", name]["squared_error"] == pytest.approx(after - before)
    for name, before, after in zip(("mirrors", SCENE), squares[3:], squares[4:], strict=False):
        assert found["scene", ERROR_SOURCES[name]]["squared_error"] == pytest.approx(before - after)
    moved = np.sqrt((light * np.square(model.coefficients(off[()] - off["mirrors",]))).sum()) * 2 / N**2
    assert found["scene", ERROR_SOURCES["mirrors"]]["deviation"] == pytest.approx(moved, rel=0.06)
    kept = model.image(gain * model.sigma * model.coefficients(scene))
    bias = float(np.mean((kept - scene) ** 2))
    assert found["solver", LAMBDA]["squared_error"] == pytest.approx(bias)
    rest = squares[5] - bias - found["capture", RENDERING]["squared_error"]
    assert found["scene", REST]["squared_error"] == pytest.approx(rest)
    assert found["scene", REST]["deviation"] == deviation(light, off["mirrors", SCENE])
    whole, explained = float(np.mean((image - scene) ** 2)), sum(row["squared_error"] for row in rows[:-1])
    assert last["of"] == "unexplained" and last["squared_error"] == pytest.approx(whole - explained)
    assert last["deviation"] == deviation(shot + read, steps[2])
    assert last["lost_db"] == pytest.approx(-10 * np.log10(explained / whole))
    own = found["capture", "shot noise"]
    assert (own["lost_db"], own["error_db"]) == gain_without(own["squared_error"], whole, explained, own["deviation"])


def test_noise_by_source_is_all_noise() -> None:
    """Of a session with repeats, in both ways to take signed patterns: the shares of shot, dark and read noise and of
    rounding, and that only a uniform shot is shared. (Planted: repeats left out of what is shared.)"""
    for mode in ("pair", "uniform"):
        lit = lit_session(7, mode, devices=CLIPPED, repeats=2)
        own, shared = board_session.response_variances(lit.session, lit.uniform_rate, lit.exposure_s)
        assert set(own) == set(shared) == {"shot noise", "dark current", "read noise", "quantisation"}
        whole = sum(part.mean() for parts in (own, shared) for part in parts.values())
        assert whole == pytest.approx(lit.response_noise**2)
        assert all(part.any() == (mode == "uniform") for part in shared.values())
    sensor, time = CLIPPED.sensor, EXPOSURE_S
    dark, read = sensor.dark_current_e_per_s / time, sensor.read_noise_e**2 / time**2
    assert own["dark current"] == pytest.approx(4 * dark / 2)
    assert shared["dark current"] == pytest.approx(dark / 2)
    assert own["read noise"] == pytest.approx(4 * read / 2) and shared["read noise"] == pytest.approx(read / 2)
    assert own["quantisation"] == pytest.approx(own["read noise"] / 12 / sensor.read_noise_e**2)


@pytest.mark.parametrize(
    ("camera", "largest"),
    [({"prnu_pixel": 0.08, "prnu_row": 0.02, "prnu_column": 0.02}, "response nonuniformity"),
     pytest.param({"dsnu_pixel_e": 400.0, "dsnu_row_e": 100.0, "dark_current_spread_e_per_s": 5.0,
                   "dark_current_e_per_s": 10.0}, "offset nonuniformity", marks=pytest.mark.slow)],
)  # fmt: skip
def test_all_sources_together_are_what_the_image_is_off(
    camera: dict[str, float], largest: str, small_scene: Callable[..., Path], tmp_path: Path, variant: str
) -> None:
    """An even print, of which the model leaves nothing out: to 0.5 dB of a loss that the nonuniformity is most of, its
    rows' and columns' part of the response nothing of it."""
    own = tmp_path / "camera.toml"
    stated = shipped_path("calibration", "imx249.toml").read_text().splitlines()
    kept = [line for line in stated if line.partition(" =")[0] not in camera]
    own.write_text("\n".join([*(f"{name} = {value}" for name, value in camera.items()), *kept]))
    found, rows = losses_of(small_scene(name="even"), variant, camera=own)
    (image,) = of_kind(found, "image")
    assert image["predicted_psnr_db"] == pytest.approx(image["psnr_db"], abs=0.5)
    reported = {(row["of"], row["source"]): row["squared_error"] for row in rows.values()}
    left = reported.pop(("unexplained", "not explained"))
    assert reported["capture", largest] > 0.7 * sum(reported.values())
    assert image["predicted_psnr_db"] == pytest.approx(-10 * np.log10(sum(reported.values())))
    assert image["psnr_db"] == pytest.approx(-10 * np.log10(sum(reported.values()) + left)) and not image["flagged"]
    assert image["geometric_psnr_db"] < image["psnr_db"] - 2, "the mask diffracts"
    results = Results(found)
    assert STUDY.judge(results)[0].verdict == "confirmed"
    assert STUDY.draw(results).keys() == {"losses.png"}
    titles = [part.title for part in _tables(results)]
    assert titles == ["What an image loses", "The session", "The image", "Errors of the factors"]


def print_of_squares(pixels: float) -> FloatArray:
    """(256, 256) print of squares of so many projector pixels a side."""
    place = (np.arange(256) + 0.5) / 256 * 17.06 / pixels  # 128 mm of the sheet, pixels of 7.5 mm
    return 25 + 200 * np.not_equal.outer(place.astype(int) % 2, place.astype(int) % 2)


def losses_of(scene: Path, variant: str, camera: Path | None = None) -> tuple[Rows, dict[str, dict[str, Any]]]:
    """Rows of a session of 16 patterns, and losses by name."""
    setup = Setup(str(scene), variant=variant, accuracy=2e-3, camera=camera and str(camera))
    with Studio() as studio:
        found = STUDY.measure(studio, Point.of(setup, recipe=None, patterns="dots:4", seed=1))
    rows = [dict(row) for row in found.rows]
    return rows, {row["name"]: row for row in of_kind(rows, "losses")}


def test_detail_inside_projector_pixels_is_told_from_all_else(small_scene: Callable[..., Path], variant: str) -> None:
    """Squares of one and a half projector pixels take 16 dB, all but a hundredth of the squared error, and what is left
    is within three of its standard errors; an even print loses a tenth of a decibel at most. (Planted: detail left in
    the light.)"""
    found, rows = losses_of(small_scene("squares", reflectance=print_of_squares(1.5)), variant)
    (image,) = of_kind(found, "image")
    whole = 10 ** (-image["psnr_db"] / 10)
    detail, left = rows["scene: depth, gloss, edges and detail"], rows["not explained"]
    assert 0.95 < detail["squared_error"] / whole < 1 and detail["lost_db"] > 13
    assert abs(left["squared_error"]) < 3 * left["deviation"] < 0.03 * whole and not image["flagged"]
    assert image["predicted_psnr_db"] == pytest.approx(image["psnr_db"], abs=0.1)
    assert abs(rows["scene: all else"]["squared_error"]) < 0.01 * whole
    even = losses_of(small_scene("even"), variant)[1]
    assert abs(even["scene: depth, gloss, edges and detail"]["lost_db"]) < 0.1
    assert abs(even["scene: all else"]["squared_error"]) < 0.5 * even["capture: rendering"]["squared_error"]


def test_a_cause_without_a_row_is_said_to_be_missing(
    small_scene: Callable[..., Path], tmp_path: Path, variant: str
) -> None:
    """A camera that is not linear, of which no row knows. (Planted: a warning for none.)"""
    own = tmp_path / "camera.toml"
    own.write_text(f"linearity = [0.03]\n{shipped_path('calibration', 'imx249.toml').read_text()}")
    found, rows = losses_of(small_scene("even"), variant, camera=own)
    assert rows["not explained"]["squared_error"] > 10 * rows["not explained"]["deviation"]
    (warning,) = flag_warnings("calibration", Results(found))
    assert "a cause is missing" in warning and of_kind(found, "image")[0]["flagged"]


def test_what_is_not_explained_is_said_by_its_standard_errors() -> None:
    words, by_chance = judge_rest({"squared_error": 0.9e-6, "deviation": 1e-6})
    assert "0.9 of its standard errors" in words and by_chance
    words, by_chance = judge_rest({"squared_error": -3.5e-6, "deviation": 1e-6})
    assert "a cause is missing" in words and not by_chance


def test_the_page_has_every_loss_in_one_table() -> None:
    """With its uncertainty, the largest first; the figure has those that are seen. (Planted: the order of the rows;
    small or unknown losses drawn.)"""
    drawn = cast(Any, STUDY.panels[0]).where["lost_db"]
    assert [drawn(lost) for lost in (0.1, -0.1, 0.001, float("nan"), None)] == [True, True, False, False, False]
    lost = ("capture", "shot noise", 2.0, 0.1), ("scene", "all else", 3.0, 0.2), ("session", "read noise", 0.0, 0.0)
    columns = "of", "source", "lost_db", "error_db"
    table = _tables(Results([{"kind": "losses", **dict(zip(columns, row, strict=True))} for row in lost]))[0]
    assert table.head[2] == "lost db" and table.rows[0][:4] == ("scene", "all else", "3", "0.2")
    assert [row[1] for row in table.rows[1:]] == ["shot noise", "read noise"]


def test_a_recipe_with_depths_is_refused_before_anything_is_traced(tmp_path: Path) -> None:
    """(Planted: let pass.)"""
    shipped = shipped_path("calibration", "session.toml").read_text()
    (tmp_path / "depths.toml").write_text(f"depths = [350.0, 400.0]\n{shipped}")
    with pytest.raises(MitsimError, match=r"has 2 depths; .*leave depths out"):
        STUDY.points(Scope(Setup(), (None,), recipe=str(tmp_path / "depths.toml")))

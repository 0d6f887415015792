"""What other programs may rely on: verbs, JSON keys, exit statuses, and where output goes."""

from __future__ import annotations

import contextlib
import json
import math
import os
import pty
import re
import sys
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.bench.layout import Preview
from mitsim.report import lit_scene
from tests.system.conftest import Outcome
from tests.system.refusals import Call

VERBS = ["demo", "run", "view", "plan", "capture", "calibrate", "reconstruct", "render", "study", "report", "doctor"]
VERBS += ["characterise", "sense", "export", "import", "patterns", "transport", "list", "new", "pairs", "train"]
VERBS += ["show", "compare", "predict", "design"]
HIDDEN = {
    "--variant": "characterise compare design export import list new patterns reconstruct report sense show train",
    "--overwrite": "characterise demo render sense study view",
}
"""Verbs that accept an option without a line in their help, because it has no effect there."""


def number(value: object, least: float = 0.0, most: float = math.inf) -> bool:
    """A finite JSON number in a range."""
    return (
        isinstance(value, (int, float)) and not isinstance(value, bool) and least <= value <= most and value < math.inf
    )


def assert_seconds(seconds: dict[str, object], *stages: str) -> None:
    """All stages are there, and they fit into the total."""
    assert {*stages, "total"} <= seconds.keys()
    assert all(number(value) for value in seconds.values())
    assert sum(seconds[stage] for stage in stages) <= seconds["total"] * 1.001


def assert_said_once(outcome: Outcome, folder: Path) -> None:
    """No sentence of eight words or more is twice on the terminal, or on the page of the ``folder``."""
    page = (folder / "report.html").read_text(encoding="utf-8")
    page = re.sub(r"<(style|script|svg|title)\b.*?</\1>|<!--.*?-->", "", page, flags=re.DOTALL)
    lines = (outcome.out + outcome.err).replace("\n  ", " "), re.sub(r"<[^>]*>", "\n", page)
    for text in lines:
        parts = (part.strip().lower() for part in re.split(r"[:;.]\s|\n", text))
        counts = Counter(part for part in parts if len(part.split()) >= 8)
        assert not [part for part, count in counts.items() if count > 1]


# ---- keys and types --------------------------------------------------------------------------------------------------


def test_view(call: Call, lab: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without its previews, which unit/bench/test_layout.py renders."""
    blank = Preview(np.ones((4, 4, 1)), np.eye(4), 0.2)
    monkeypatch.setattr(lit_scene, "previews", lambda *_: (blank, blank))
    devices = lab.scene, "--camera", lab.camera, "--projector", lab.projector
    options = "--json", "--quiet", "--variant", "llvm_ad_mono"
    found = call("view", *devices, "-o", tmp_path / "bench.png", *options).payload
    assert found.keys() == {
        *("scene", "projector_mm", "scene_distance_mm", "window_mm", "projector_pixels", "keystone_pixels"),
        *("depths_mm", "warnings", "output"),
        *("seen_pixels", "parallax_pixels", "field_stop_deg", "field_stop_cuts", "sensor_pixels", "sensor_mm"),
        *("mask_distance_mm", "surfaces"),
    }
    assert found["projector_mm"] == pytest.approx([60, 0, 0], abs=1e-3) and found["projector_pixels"] == 16
    assert found["output"] == str(tmp_path / "bench.png") and found["surfaces"][0].keys() == {
        *("name", "lamp", "low_mm", "high_mm")
    }
    assert [path.name for path in tmp_path.iterdir()] == ["bench.png"]
    text = call("view", *devices, "--quiet", cwd=tmp_path).out
    assert text.endswith("Drawn: view.png\n") and "parallax: " in text and (tmp_path / "view.png").is_file()


def test_plan(call: Call, lab: Any) -> None:
    options = "--patterns", "dots:4", "--json", "--quiet", "--variant", "llvm_ad_mono"
    plan = call("plan", *lab.arguments, *options).payload
    assert {"effects", "accuracy", "predicted_seconds", "predicted_range", "kernels"} <= plan.keys()
    assert plan["kernels"].keys() == {"number", "seconds"}
    assert plan["accuracy"] == 0.005 and number(plan["predicted_seconds"], 1e-6)
    assert len({effect["name"] for effect in plan["effects"]}) == len(plan["effects"]) >= 5
    for effect in plan["effects"]:
        assert {"name", "state", "reason", "error_if_off", "seconds"} <= effect.keys()
        assert effect["state"] in ("exact", "approximate", "off")
        # An error that the effect would leave is a reason.
        assert isinstance(effect["reason"], str) and (effect["reason"] or effect["error_if_off"] is not None), effect
        assert effect["error_if_off"] is None or number(effect["error_if_off"])
        assert number(effect["seconds"])
    # The names are those that docs/json_keys.md lists.
    names = " ".join(effect["name"] for effect in plan["effects"])
    for effect in ("anchors", "layers", "interreflection", "aperture", "ambient", "diffraction", "thickness", "noise"):
        assert effect in names


def test_capture(lab: Any) -> None:
    captured = lab.captured.payload
    keys = {"frames", "shape", "seconds", "mc_error", "variant", "seed", "output", "predicted_range"}
    assert keys <= captured.keys()
    assert (captured["frames"], captured["shape"]) == (16, [64, 64])
    assert (captured["variant"], captured["seed"], captured["output"]) == ("llvm_ad_mono", 0, str(lab.run))
    assert_seconds(captured["seconds"], "transport", "optics", "sensor", "write")
    assert number(captured["kernels"]["number"]) and number(captured["kernels"]["seconds"])
    assert number(captured["mc_error"], 1e-9, 0.005)
    assert len(list(lab.run.glob("*.exr"))) == 17, "16 frames and the truth"


def test_calibrate(lab: Any) -> None:
    found = lab.calibrated.payload
    keys = {"n", "frames", "separability_residual", "phi_error", "condition", "seconds", "output"}
    keys |= {"predicted", "predicted_seconds", "predicted_memory_bytes", "memory_bytes", "kernels"}
    assert keys <= found.keys()
    assert (found["n"], found["output"]) == (16, str(lab.calibration))
    assert found["frames"] == 2 * 2 * 16, "n horizontal and n vertical patterns, two captures each"
    assert number(found["separability_residual"], 1e-9, 0.1) and number(found["phi_error"], 1e-9, 0.1)
    assert number(found["condition"], 1, 1e6)
    assert_seconds(found["seconds"])


def test_reconstruct(call: Call, lab: Any, tmp_path: Path) -> None:
    options = "--json", "--quiet", "--variant", "llvm_ad_mono", "-o", tmp_path / "image"
    found = call("reconstruct", lab.run, "--calibration", lab.calibration, *options, pictures=True).payload
    keys = {"psnr", "ssim", "lambda", "rank", "condition", "residual", "status", "warnings", "seconds", "output"}
    assert found.keys() == keys | {
        *("truth_error", "rank_sides", "condition_whole", "condition_sides"),
        *("misfit", "uncertainty", "uncertainty_budget", "focus_mm", "focus_error_mm", "depths"),
        *("uncertainty_extrapolated", "regularisation_bias_factor", "focus_range_mm", "focus_alternatives"),
        *("objective", "relative_gap", "iterations", "white", "headline", "shape", "volume_depths_mm"),
        *("predicted", "predicted_seconds", "predicted_memory_bytes", "memory_bytes", "report"),
    }
    assert found["focus_mm"] is None and found["focus_error_mm"] is None
    assert number(found["uncertainty"], 1e-6, 0.1) and all(map(number, found["uncertainty_budget"].values()))
    keys = (
        "chi_square unexplained worst_tile noise_stated flagged cause reason noise_ratio gain_stated "
        "gain_measured readings places power_error limits foretold map faults reading defective_pixels detail "
    )
    assert {*found["misfit"]} == {*keys.split()}
    assert number(found["misfit"]["chi_square"], 0.5, 1.2) and found["misfit"]["noise_stated"]
    assert not found["misfit"]["flagged"] and found["misfit"]["cause"] is None
    assert found["rank_sides"] == [16, 16] and found["condition"] == max(found["condition_sides"])
    assert found["condition_whole"] == pytest.approx(np.prod(found["condition_sides"]))
    assert number(found["psnr"], 20, 100) and number(found["ssim"], 0.5, 1)
    assert number(found["lambda"]) and found["rank"] == 16 * 16 and number(found["condition"], 1, 1e6)
    assert number(found["residual"], 1e-9, 0.5) and found["status"].endswith(".")
    assert_seconds(found["seconds"])
    assert found["output"] == str(tmp_path / "image")
    names = {"image.exr", "image.png", "pictures", "report.html", "result.json", "uncertainty.exr"}
    assert {path.name for path in (tmp_path / "image").iterdir()} == names
    made = found.pop("report")
    assert made.keys() == {"page", "pictures", "seconds"} and number(made["seconds"], 0, 60)
    assert made["page"] == str(tmp_path / "image" / "report.html") and all(
        Path(each).is_file() for each in made["pictures"]
    )
    written = json.loads((tmp_path / "image" / "result.json").read_text())
    assert written.pop("inputs").keys() == {"run", "calibration", "lambda", "method"}
    assert written.pop("made_of") == {"run": str(lab.run), "calibration": str(lab.calibration)}
    assert written.pop("checksums").keys() == {"image.exr", "image.png", "uncertainty.exr"}
    assert written.pop("versions").keys() >= {"mitsim", "mitsuba"}
    assert written.pop("command").startswith(f"mitsim reconstruct {lab.run} --calibration")
    assert number(found.pop("memory_bytes"), 0)  # of the process, which may do more than this
    assert written == found


def test_reconstruct_at_another_depth(call: Call, lab: Any, tmp_path: Path) -> None:
    options = "--calibration", lab.calibration, "--json", "--quiet", "-o"
    found = call("reconstruct", lab.run, *options, tmp_path / "image", "--focus", "400").payload
    assert found["focus_mm"] == 400 and found["focus_error_mm"] is None
    assert_seconds(found["seconds"], "focus", "accumulate")
    assert json.loads((tmp_path / "image" / "result.json").read_text())["inputs"]["focus"] == 400
    assert call("reconstruct", lab.run, *options, tmp_path / "other", "--focus", "near").refusal.startswith(
        "--focus 'near': give"
    )
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("estimator", ["reference", "factored"])
def test_render(call: Call, lab: Any, tmp_path: Path, estimator: str) -> None:
    options = "--estimator", estimator, "--spp", 16, "--accuracy", "0.02", "--seed", 3, "--json", "--quiet"
    found = call("render", lab.scene, "-o", tmp_path / "frame.exr", *options).payload
    assert (found["estimator"], found["seed"], found["output"]) == (estimator, 3, str(tmp_path / "frame.exr"))
    assert number(found["mean"], 1e-6, 1) and number(found["mc_error"], 1e-9, 10) and number(found["seconds"])
    # Programs give both estimators all options; what has no effect is said, and refuses nothing.
    unused = "--accuracy" if estimator == "reference" else "--spp"
    *others, note = found["notes"]
    assert note == f"{unused} has no effect on the {estimator}"
    assert len(others) == (estimator == "reference")  # what the reference leaves out
    assert [path.name for path in tmp_path.iterdir()] == ["frame.exr"] and found["picture"] is None


def test_doctor(call: Call) -> None:
    found = call("doctor", "--json", "--quiet", "--variant", "llvm_ad_mono").payload
    assert found["ok"] is True and len(found["checks"]) == 5, found
    assert all({"name", "ok", "detail", "remedy"} <= check.keys() for check in found["checks"])


def test_characterise_and_sense(call: Call, tmp_path: Path) -> None:
    small = "--pixels", 32, "--steps", 20, "--frames", 2, "--json", "--quiet", "--variant", "llvm_ad_mono"
    found = call("characterise", "imx477", "-o", tmp_path / "figures", *small).payload
    assert {"camera", "pixels", "steps", "frames", "seed", "exposure_s", "warnings", "output"} <= found.keys()
    assert {"camera_found", "light", "notes"} <= found.keys()
    keys = {"name", "symbol", "unit", "set", "expected", "found", "standard_error", "deviations", "bias"}
    for figure in found["figures"]:
        assert figure.keys() == keys
        assert isinstance(figure["set"], float) and isinstance(figure["found"], float)
    np.save(tmp_path / "image.npy", np.full((4, 6), 1e-6))
    options = "--camera", "imx249", "-o", tmp_path / "frame.png", "--json", "--quiet", "--variant", "llvm_ad_mono"
    sensed = call("sense", tmp_path / "image.npy", *options).payload
    assert sensed["shape"] == [4, 6] and (tmp_path / "frame.png").is_file() and sensed["saturated_pixels"] == 0
    assert {"camera", "exposure_s", "wavelength_nm", "seed", "mean_dn", "largest_dn", "notes"} <= sensed.keys()
    refused = call("sense", tmp_path / "image.npy", "--camera", "imx477", "-o", tmp_path / "other.png")
    assert "quantum_efficiency" in refused.refusal and not (tmp_path / "other.png").exists()


def test_pairs(call: Call, lab: Any, tmp_path: Path) -> None:
    options = "--count", 3, "--patterns", "dots:4", "--json", "--quiet", "--variant", "llvm_ad_mono"
    found = call("pairs", *lab.arguments, "-o", tmp_path / "pairs", *options).payload
    assert found.keys() == {
        *("count", "n", "frames", "shape", "patterns", "exposure_s", "idealised", "traced_anew", "seed", "pictures"),
        *("groups", "ambient_shots", "predicted_seconds", "predicted_bytes", "bytes", "seconds", "kernels"),
        *("warnings", "output"),
    }
    assert (found["count"], found["n"], found["frames"], found["shape"]) == (3, 16, 16, [64, 64])
    assert (found["groups"], found["idealised"], found["traced_anew"]) == (1, False, "")
    assert number(found["exposure_s"], 1e-6) and number(found["predicted_seconds"], 1e-6)
    assert_seconds(found["seconds"], "plan", "pairs")
    assert sorted(path.name for path in (tmp_path / "pairs").iterdir()) == ["pairs.json", "pairs_00000.h5"]
    flagged = call("pairs", *lab.arguments, "-o", tmp_path / "bright", *options, "--exposure", "1000")
    assert flagged.code == 1 and "3 pairs are expected to fill the full well" in flagged.payload["warnings"][0]


def test_design(call: Call, lab: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupted between search and proof, and resumed. (Planted: the goal written before the search is checked;
    design.json without a status; a resumed design of another goal; nothing moved aside.)"""
    goal, out = tmp_path / "goal.toml", tmp_path / "out"
    lines = [f'scene = "{lab.scene}"', f'camera = "{lab.camera}"', 'patterns = ["dots:2"]', "exposure_total_s = 1.0"]
    lines += ["feature_um = [120.0]", "evaluations = 10", "starts = 1", "seeds = 2", "accuracy = 0.05"]
    options = "--json", "--quiet", "-o", out

    def asked(*more: str) -> Path:
        goal.write_text("\n".join([*lines, *more]))
        return goal

    refused = call("design", asked("open_part = [0.0, 0.0]"), *options)
    assert "open_part" in refused.refusal and not out.exists()

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("mitsim.studies.mask_design.prove", interrupt)
        assert call("design", asked(), *options).code == 130
    begun = call("show", out, "--json", "--quiet")
    assert begun.code == 1 and begun.payload["kind"] == "design" and not begun.payload["finished"]
    kept = (out / "search.json").read_bytes()
    for more, words in (((), "--overwrite"), (("--resume",), "another goal")):
        line = call("design", asked("seed = 1"), *options, *more).refusal
        assert words in line
    found = call("design", asked(), *options, "--resume").payload
    assert found.keys() == {
        *(
            "headline",
            "psnr",
            "candidates",
            "bounds",
            "distances",
            "sensitivity",
            "seconds_for_psnr",
            "complete",
            "seconds",
        ),
        *("output", "warnings"),
    }
    assert (out / "search.json").read_bytes() == kept and found["complete"] and found["seconds_for_psnr"] is None
    keys = "name feature_um mask_distance_mm patterns origin code evaluations exposure_total_s cases psnr_of_search "
    keys += "psnr_predicted causes psnr_rendered psnr_scatter session_exposure_s warnings"
    for each in found["candidates"]:
        assert each.keys() == {*keys.split()} and number(each["psnr_rendered"], 5, 60)
        assert (out / each["name"].replace(" ", "_") / "camera.toml").is_file()
    assert found["psnr"] == found["candidates"][0]["psnr_rendered"]
    shown = call("show", out, "--json", "--quiet").payload
    assert shown["finished"] and shown["numbers"]["masks"].startswith("4 (design, random")
    (out / "mine.txt").write_text("kept if the command is refused")
    assert "open_part" in call("design", asked("open_part = [0.0, 0.0]"), *options, "--overwrite").refusal
    assert (out / "mine.txt").is_file() and (out / "report.html").is_file()


def test_train(call: Call, lab: Any, tmp_path: Path) -> None:
    """And the network asked for an image of frames that it was not trained for: it comes with the doubt."""
    pytest.importorskip("torch", reason="torch is an extra: pip install 'mitsim[learn]'")
    common = "--json", "--quiet", "--variant", "llvm_ad_mono"
    options = "--count", 8, "--patterns", "dots:4", "--exposure-fraction", 0.05, *common
    call("pairs", *lab.arguments, "-o", tmp_path / "pairs", *options)
    call("calibrate", *lab.arguments, "-o", tmp_path / "pairs" / "calibration", *common)
    found = call("train", "refined", tmp_path / "pairs", "-o", tmp_path / "m.pt", "--steps", 2, *common).payload
    assert found.keys() == {
        *("model", "weights", "curve", "psnr_before_db", "psnr_db", "steps", "predicted_seconds", "seconds", "output")
    }
    assert found["model"].startswith("refined ") and found["steps"] == 2 and len(found["curve"]) == 3
    assert_seconds(found["seconds"], "read", "train")
    assert not (tmp_path / "m.pt.unfinished").exists()
    asked = "reconstruct", lab.run, "--calibration", lab.calibration, "--method", tmp_path / "m.pt"
    image = call(*asked, "-o", tmp_path / "image", *common)
    assert image.payload["uncertainty"] is None and found["model"] in image.payload["status"]
    assert image.code == 1 and "trained with" in image.payload["status"]
    refused = call(*asked, "-o", tmp_path / "other", "--lambda", "1")
    assert refused.code == 2 and "--lambda 1.0: refined" in refused.err and "has none" in refused.err


# ---- exit statuses ---------------------------------------------------------------------------------------------------


def test_a_flagged_result_exits_with_1_and_says_why(call: Call, lab: Any, tmp_path: Path) -> None:
    for verb in (("plan",), ("capture", "-o", tmp_path / "run")):
        outcome = call(*verb, *lab.arguments, "--patterns", "dots:4", "--effects=-diffraction", "--json")
        assert outcome.code == 1
        assert outcome.payload["warnings"] and "diffraction (off)" in outcome.payload["warnings"][0]
        lines = outcome.err.splitlines()
        assert len(lines) == len(outcome.payload["warnings"])
        assert all(line.startswith("mitsim: warning: ") for line in lines)


def test_a_saturated_capture_is_flagged(call: Call, lab: Any, tmp_path: Path) -> None:
    arguments = "-o", tmp_path / "run", "--patterns", "dots:4", "--exposure", "1000"
    outcome = call("capture", *lab.arguments, *arguments, pictures=True)
    assert outcome.code == 1 and "full well" in outcome.err
    assert_said_once(outcome, tmp_path / "run")
    image = call("reconstruct", tmp_path / "run", "--calibration", lab.calibration, pictures=True)
    assert image.code == 1
    assert_said_once(image, tmp_path / "run" / "reconstruction")


def test_a_fault_of_the_program_is_one_line_and_its_traceback_is_kept(
    call: Call, monkeypatch: pytest.MonkeyPatch, lab: Any, tmp_path: Path
) -> None:
    """Status 2: 1 would say that there is a result. (Planted: the exception raised on; the log left out.)"""

    def broken(*arguments: object) -> None:
        raise ZeroDivisionError("planted\x1b[31m\nand more")

    monkeypatch.setattr("mitsim.acquire.spectral.make_plan", broken)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    line = call("plan", *lab.arguments).refusal
    assert line.startswith("a fault of mitsim's own, ZeroDivisionError: planted [31m and more; its traceback is in /")
    (log,) = tmp_path.glob("mitsim-*.log")
    assert str(log) in line and "in broken" in log.read_text() and "planted\x1b[31m" in log.read_text()


# ---- the installed program -------------------------------------------------------------------------------------------


def test_the_program(shell: Call, lab: Any, tmp_path: Path) -> None:
    good = shell("capture", *lab.arguments, "-o", "run", "--patterns", "uniform", "--json", cwd=tmp_path)
    assert good.code == 0 and good.err == ""
    assert good.payload["output"] == "run"
    bad = shell("capture", *lab.arguments, "-o", "run", "--patterns", "uniform", "--json", cwd=tmp_path)
    assert "run" in bad.refusal


def test_version(shell: Call) -> None:
    import mitsim

    version = shell("--version")
    assert (version.code, version.out, version.err) == (0, f"{mitsim.__version__}\n", "")


def test_help_of_every_verb_names_every_option(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a description. Options are hidden where they have no effect, because every verb accepts --variant. (Planted:
    an option without a description; a hidden --json; a listed --variant of show.)"""
    from typer.main import get_command

    from mitsim.cli import app

    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("TERM", "dumb")
    commands = get_command(app).commands
    assert {*commands} == {*VERBS}
    for verb in VERBS:
        text = call(verb, "--help")
        assert text.code == 0 and text.err == ""
        options = [option for option in commands[verb].params if option.param_type_name == "option"]
        assert {"--json", "--variant", "--quiet"} <= {name for option in options for name in option.opts}, verb
        hidden = {name for option in options if option.hidden for name in option.opts}
        assert hidden == {name for name, verbs in HIDDEN.items() if verb in verbs.split()}, verb
        for option in options:
            seen = option.hidden or all(re.search(rf"{name}\b", text.out) for name in option.opts)
            assert seen and option.help, (verb, option.opts)
        assert max(map(len, text.out.splitlines())) <= 100
    text = " ".join(call("capture", "--help").out.replace("│", " ").split())
    for fragment in ("SCENE", "dots:K", "hadamard:K", "--accuracy", "0.001", "--resume", "NAME=VALUE", "auto|SECONDS"):
        assert fragment in text, fragment


def test_no_arguments_show_the_help(call: Call) -> None:
    outcome = call()
    assert outcome.code == 2 and "Usage" in outcome.out + outcome.err
    assert [line for line in outcome.err.splitlines() if line.startswith("mitsim:")] == [
        "mitsim: give one of the commands above"
    ]


# ---- the progress bar ------------------------------------------------------------------------------------------------


def on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: object
) -> tuple[str, str]:
    """stdout, and what a terminal on stderr received, of one call in this process."""
    from mitsim import cli

    master, slave = pty.openpty()
    seen: list[bytes] = []

    def read() -> None:
        # The terminal's end reports an error once nobody holds the other one.
        with contextlib.suppress(OSError):
            while data := os.read(master, 4096):
                seen.append(data)

    reader = threading.Thread(target=read)
    reader.start()
    capsys.readouterr()
    with monkeypatch.context() as patch, os.fdopen(slave, "w", buffering=1) as file:
        patch.setenv("TERM", "xterm")
        patch.setattr(sys, "argv", ["mitsim", *map(str, arguments)])
        patch.setattr(sys, "stderr", file)
        with pytest.raises(SystemExit):
            cli.run()
    reader.join(timeout=120)
    os.close(master)
    return capsys.readouterr().out, b"".join(seen).decode()


@pytest.mark.parametrize("verb", ["capture", "reconstruct"])
def test_a_terminal_sees_rows_that_go_away(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], lab: Any, tmp_path: Path, verb: str
) -> None:
    arguments = {
        "capture": ("capture", *lab.arguments, "--patterns", "dots:4", "-o"),
        "reconstruct": ("reconstruct", lab.run, "--calibration", lab.calibration, "-o"),
    }[verb]

    def call(name: str, *options: str) -> tuple[str, str]:
        return on_a_terminal(monkeypatch, capsys, *arguments, tmp_path / name, *options)

    out, err = call("loud.exr")
    assert "\x1b" not in out and str(tmp_path / "loud.exr") in out
    rows = {"capture": ("plan", "transport", "frames"), "reconstruct": ("read", "accumulate", "solve")}[verb]
    assert all(re.search(rf"{row} [^\n]*━[^\n]* s", err) for row in rows), "each stage has its row"
    assert err.rstrip().endswith("\x1b[2K"), "the rows' lines are erased"
    assert err.count("\x1b[?25l") == err.count("\x1b[?25h") == 1, "and the cursor is there again"
    for option in ("--quiet", "--json"):
        out, err = call(f"{option}.exr", option)
        assert err == ""
        assert out.startswith("{") == (option == "--json")


def test_an_interrupt_leaves_the_terminal_whole(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], lab: Any
) -> None:
    """Rows are gone, the cursor is there, and one line says what happened. (Planted: rows that stay.)"""

    def interrupt(*_: object) -> None:
        time.sleep(0.3)  # a few refreshes
        raise KeyboardInterrupt

    monkeypatch.setattr("mitsim.cli.bench_verbs.plan_in", interrupt)
    out, err = on_a_terminal(monkeypatch, capsys, "plan", *lab.arguments)
    shown, _, after = err.rpartition("\x1b[?25h")
    assert out == "" and "plan" in shown and "mitsim: interrupted" in after
    assert re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", after).strip() == "mitsim: interrupted"
    assert "\x1b[2K" in after

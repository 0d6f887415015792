"""The figures of docs/validation.md, from measurements by mitsim's own commands and benchmarks.

    python docs/images/checks.py measure [closed] [estimators] [judge] [emva] [coverage]
    python docs/images/checks.py

The first command measures all claims, unless some are named, and keeps the numbers in checks.json: half an hour on two
idle processors. The second command draws the figures again from that file.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
FILE = HERE / "checks.json"
BLUE, ORANGE, GREY = "#0b62a4", "#d95f02", "#8a8a8a"
GAPS, ALBEDOS, PITCH = (0.5, 2.0, 8.0), (0.2, 0.6, 0.95), 0.01172
CAMERAS = "imx249", "imx250", "imx477", "mt9m031", "ov5647"
REGIMES = 40
JUDGED = "print 0.03 mm behind glass", "print 0.005 mm behind glass", "devices 300 m away", "leaf behind leaf"
JUDGED += "mirror balls of 0.4 mm", *(f"drawn {number}" for number in range(2))
"""Scenes of the third judge that take seconds, not minutes."""


# ---- measure ---------------------------------------------------------------------------------------------------------


def closed() -> dict[str, Any]:
    """Measure the shadow of one opening and the light between two walls, and compute their closed forms.

    The code is that of the notebooks on diffraction and on interreflection.
    """
    waves, walls = _run_notebook("diffraction"), _run_notebook("interreflection")
    edges = {}
    for gap in GAPS:
        level = float(np.median(waves["rays"][gap][waves["rays"][gap] > waves["rays"][gap].max() / 2]))
        edges[str(gap)] = {
            "mitsim": (waves["waves"][gap] / level).tolist(),
            "closed": waves["closed_form"](gap).tolist(),
        }
    return {
        "edges": edges,
        "walls": {"mitsim": [*map(float, walls["measured"])], "closed": [*map(float, walls["expected"])]},
    }


def _run_notebook(name: str) -> dict[str, Any]:
    """Run the first three cells of code of a notebook: imports, measurement and closed form."""
    cells = json.loads((ROOT / f"docs/notebooks/{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    sources = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"][:3]
    names: dict[str, Any] = {}
    home = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            for source in sources:
                exec(source.replace("plt.show()", ""), names)
        finally:
            os.chdir(home)
    return names


def estimators() -> dict[str, list[float]]:
    """Measure z of the difference of both estimators in 64 parts of a frame, for scenes of the test that they agree."""
    from mitsim.api.bench import open_bench
    from tests.physics import test_estimators_agree as agree

    found = {}
    for case in (agree.PHOTOGRAPH, agree.CORNER, agree.CARDS, agree.LAMP, agree.BAG):
        bench = open_bench(case.scene, mask=case.mask)
        pair = agree.pair_of(bench, case.patterns, case.index, case.accuracy, case.spp, case.on)
        found[case.scene] = list(agree.z_scores(pair).values())[5:]
    return found


def judge() -> list[dict[str, Any]]:
    """Measure the difference of frames to float64 rays of the third judge."""
    return _benchmark("third_judge.py", "--scenes", *JUDGED)


def coverage() -> dict[str, Any]:
    """Measure the part of the pixels within the stated intervals."""
    return _benchmark("coverage.py", "--regimes", str(REGIMES))


def _benchmark(name: str, *options: str) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder, "found.json")
        command = [sys.executable, str(ROOT / "benchmarks" / name), "--json", str(result), *options]
        subprocess.run(command, check=True, cwd=ROOT)
        return json.loads(result.read_text(encoding="utf-8"))


def emva() -> dict[str, dict[str, float]]:
    """Measure how many standard errors each number of a camera is off its file."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for seed, name in enumerate(CAMERAS):
            command = [sys.executable, "-m", "mitsim", "characterise", name, "-o", f"{folder}/{name}", "--json"]
            command += ["--seed", str(seed)]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            fields = json.loads(done.stdout)["camera_found"]
            found[name] = {row["name"]: row["deviations"] for row in fields if row["deviations"] is not None}
    return found


# ---- draw ------------------------------------------------------------------------------------------------------------


def main() -> None:
    """Measure the named claims, or draw all figures."""
    kept = json.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {}
    if sys.argv[1:2] == ["measure"]:
        for claim in (closed, estimators, judge, emva, coverage):
            if claim.__name__ in (sys.argv[2:] or [claim.__name__]):
                kept[claim.__name__] = _rounded(claim())
                FILE.write_text(json.dumps(kept) + "\n", encoding="utf-8")
    for drawing in (draw_closed, draw_estimators, draw_judge, draw_emva, draw_coverage):
        name = drawing.__name__.removeprefix("draw_")
        if name in kept:
            drawing(kept[name]).savefig(HERE / f"{name}.png", dpi=110, metadata={"Software": None})


def draw_closed(found: dict[str, Any]) -> Figure:
    """Draw the light behind an opening, and the light between two walls."""
    figure, (*edges, walls) = _panels(4)
    place = (np.arange(512) - 255.5) * PITCH
    for axes, (gap, light) in zip(edges, found["edges"].items(), strict=True):
        axes.plot(place, light["closed"], color=ORANGE, lw=1.4, label="Fresnel's integrals")
        axes.plot(place, light["mitsim"], ".", ms=3, color=BLUE, label="mitsim")
        axes.set(xlim=(-0.75, 0.75), ylim=(0, 1.75), title=f"gap of {gap} mm", xlabel="place on the sensor [mm]")
    edges[0].set_ylabel("light, 1 = without edges")
    edges[0].legend(frameon=False, fontsize=8, loc="upper center")
    walls.plot(
        ALBEDOS, 100 * np.array(found["walls"]["closed"]), "s", ms=9, mfc="none", color=ORANGE, label="radiosity"
    )
    walls.plot(ALBEDOS, 100 * np.array(found["walls"]["mitsim"]), "o", ms=5, color=BLUE, label="mitsim")
    walls.set(title="two walls", xlabel="albedo of the walls", ylabel="indirect light / direct light [%]")
    walls.legend(frameon=False, fontsize=8)
    return figure


def draw_estimators(found: dict[str, list[float]]) -> Figure:
    """Draw the distribution of normalised differences, and the normal one."""
    figure, panels = _panels(len(found), width=11.5)
    z = np.linspace(-4, 4, 200)
    for axes, (scene, scores) in zip(panels, found.items(), strict=True):
        axes.hist(scores, np.arange(-4, 4.1, 0.5), density=True, color=BLUE, alpha=0.6)
        axes.plot(z, np.exp(-np.square(z) / 2) / np.sqrt(2 * np.pi), color=ORANGE, lw=1.4)
        axes.set(xlim=(-4, 4), ylim=(0, 0.65), title=scene, xlabel="difference / standard error")
    panels[0].set_ylabel("density of 64 parts")
    return figure


def draw_judge(rows: list[dict[str, Any]]) -> Figure:
    """Draw each scene's difference to the judge, and the bound that is stated for it."""
    rows = [row for row in rows if "difference" in row]
    figure, (axes,) = _panels(1, width=7.2, height=0.9 + 0.27 * len(rows))
    places = np.arange(len(rows))[::-1]
    bounds = [float(np.hypot(row["bound"], row["uncertain"])) for row in rows]
    axes.barh(places, [row["difference"] for row in rows], 0.6, color=BLUE, label="difference")
    axes.plot(bounds, places, "|", ms=13, mew=2, color=ORANGE, label="stated bound")
    axes.set_yticks(places, [row["scene"] for row in rows], fontsize=8)
    axes.set(xlabel="relative difference of the frames", xlim=(0, None))
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure


def draw_emva(found: dict[str, dict[str, float]]) -> Figure:
    """Draw deviations of found numbers in standard errors, a column for each camera."""
    figure, (axes,) = _panels(1, width=8.2, height=3.8)
    names = [name for name in dict.fromkeys(name for each in found.values() for name in each)]
    names = [name for name in names if any(found[camera].get(name) for camera in found)]
    for index, (camera, fields) in enumerate(found.items()):
        places = [names.index(name) + 0.12 * (index - len(found) / 2) for name in fields if name in names]
        axes.plot(places, [fields[name] for name in fields if name in names], "o", ms=4, label=camera)
    axes.axhspan(-2, 2, color=GREY, alpha=0.15, lw=0)
    axes.set_xticks(range(len(names)), [name.replace("_", " ") for name in names], rotation=35, ha="right", fontsize=8)
    axes.set(ylim=(-4, 4), ylabel="(found - set) / standard error")
    axes.legend(frameon=False, fontsize=8, ncols=len(found), loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure


def draw_coverage(found: dict[str, Any]) -> Figure:
    """Draw the coverage of each interval by regime, for images that are not flagged."""
    figure, (axes,) = _panels(1, width=8.2, height=3.6)
    rows: dict[str, dict[str, float]] = {}
    for name, row in found.items():
        regime, _, kind = name.rpartition(", ")
        if kind != "flagged":
            shown = rows.setdefault(regime, {"images": 0, "68%": 0.0, "90%": 0.0, "95%": 0.0})
            images = shown["images"] + row["images"]
            for part in ("68%", "90%", "95%"):
                shown[part] = (shown[part] * shown["images"] + row[part] * row["images"]) / images
            shown["images"] = images
    for part, color in (("68%", BLUE), ("90%", ORANGE), ("95%", "#1b7f4d")):
        axes.axhline(float(part.rstrip("%")), color=color, lw=0.8, ls="--")
        axes.plot(range(len(rows)), [100 * row[part] for row in rows.values()], "o", color=color, label=part)
    labels = [f"{name}\n{row['images']} images" for name, row in rows.items()]
    axes.set_xticks(range(len(rows)), labels, fontsize=8)
    axes.set(ylim=(50, 101), ylabel="pixels within the interval [%]")
    axes.legend(frameon=False, fontsize=8, ncols=3, loc="lower right", title="stated interval", title_fontsize=8)
    return figure


def _panels(count: int, width: float = 11.5, height: float = 3.2) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(1, count, squeeze=False)[0])


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_rounded(each) for each in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


if __name__ == "__main__":
    main()

"""EMVA 1288 figures of every shipped camera: those that its file sets beside those that `characterise` finds.

    python benchmarks/cameras.py [--pixels N] [--frames N] [--seed N]

Prints a markdown table for docs/physics.md: figures that are set, found with their predicted standard error; the last
columns are the figures in all, how far the worst is off in these errors, and which it is. Ends with 1 where one is off
by five or more.
"""

from __future__ import annotations

import argparse

from mitsim.core.configuration import shipped_path
from mitsim.devices.sensor import SensorModel, load_sensor
from mitsim.studies.characterise import characterise
from mitsim.studies.emva_options import Procedure
from mitsim.studies.emva_results import Row

SHOWN = {"system_gain": "K [DN/e-]", "quantum_efficiency": "eta", "dark_noise": "sigma_d [e-]", "full_well": "F [e-]"}
"""Figures that have a column of their own."""


def cameras() -> dict[str, SensorModel]:
    """Shipped cameras by name."""
    paths = sorted(shipped_path("calibration").glob("*.toml"))
    return {path.stem: load_sensor(path) for path in paths if "full_well_e" in path.read_text(encoding="utf-8")}


def cell(row: Row | None) -> str:
    """Set, and found with its standard error."""
    if row is None:
        return "-"
    aim = "" if row.expected is None else f" (to be found {row.expected:.4g})"
    return f"{row.set:.4g}{aim}: {row.found:.5g} +- {row.standard_error:.1g}"


def main() -> int:
    """The table."""
    parser = argparse.ArgumentParser()
    for name in ("pixels", "frames", "seed"):
        parser.add_argument(f"--{name}", type=int, default=getattr(Procedure, name))
    given = parser.parse_args()
    procedure, worst = Procedure(pixels=given.pixels, frames=given.frames, seed=given.seed), 0.0
    print(
        f"| camera | {' | '.join(SHOWN.values())} | figures | worst off by | which |\n|---|{'---|' * (len(SHOWN) + 3)}"
    )
    for name, sensor in cameras().items():
        rows = {row.name: row for row in characterise(sensor, procedure).rows}
        last = max(rows.values(), key=lambda row: abs(row.deviations))
        worst = max(worst, abs(last.deviations))
        cells = " | ".join(cell(rows.get(figure)) for figure in SHOWN)
        print(f"| `{name}` | {cells} | {len(rows)} | {abs(last.deviations):.1f} | {last.symbol} |", flush=True)
    return int(worst >= 5)


if __name__ == "__main__":
    raise SystemExit(main())

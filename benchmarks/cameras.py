"""EMVA 1288 figures of every shipped camera: those that its file sets beside those that `characterise` finds.

    python benchmarks/cameras.py [--pixels N] [--frames N] [--seed N] [--json FILE]

Prints a markdown table for docs/physics.md: figures that are set, found with their predicted standard error; the last
columns are the figures and fields of the camera found in all, how far the worst is off in these errors, and which it
is. Ends with 1 where one is off by five or more.
"""

from __future__ import annotations

from typing import Any

from harness import arguments, write

from mitsim.core.configuration import shipped_path
from mitsim.devices.sensor import SensorModel, load_sensor
from mitsim.studies.characterise import Row, characterise
from mitsim.studies.emva_options import Procedure

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
    parser = arguments(__doc__, seed=True)
    for name in ("pixels", "frames"):
        parser.add_argument(f"--{name}", type=int, default=getattr(Procedure, name))
    given = parser.parse_args()
    procedure, report = Procedure(pixels=given.pixels, frames=given.frames, seed=given.seed), dict[str, Any]()
    print(
        f"| camera | {' | '.join(SHOWN.values())} | numbers | worst off by | which |\n|---|{'---|' * (len(SHOWN) + 3)}"
    )
    for name, sensor in cameras().items():
        done = characterise(sensor, procedure)
        rows = {row.name: row for row in done.rows}
        off = {row.name: row.deviations for row in (*done.rows, *done.fields) if row.deviations is not None}
        worst = max(off, key=lambda figure: abs(off[figure]))
        cells = " | ".join(cell(rows.get(figure)) for figure in SHOWN)
        print(f"| `{name}` | {cells} | {len(off)} | {abs(off[worst]):.1f} | `{worst}` |", flush=True)
        report[name] = done.payload()
    write(given.json, report)
    return int(any(
        abs(row["deviations"] or 0) >= 5
        for done in report.values() for row in (*done["figures"], *done["camera_found"])
    ))  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())

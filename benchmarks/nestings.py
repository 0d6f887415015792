"""Light of wrapped mirrors and glass against float64 rays: all nestings of two wrappers, in both estimators.

    python benchmarks/nestings.py --json FILE [--spp 8192] [--only TEXT] [--factored]

A row each: two of ``blendbsdf``, ``mask``, ``twosided``, ``bumpmap`` and ``normalmap`` around a mirror or glass, with
constant or textured weights, that turn a projector's whole beam to two matt cards (`tests/physics/nestings.py`). The
factored estimator has a pinhole: its tracers of direct light and of caustics, eight seeds. The reference has a lens of
30 mm, which its paths meet. For both: the relative difference of the irradiance from the judge's (true), the relative
standard error (stated), and whether three stated errors cover the difference; the judge's own error, 5e-4, is added.
FILE is written after each row, and rows that it holds are not repeated. Half a minute a row; ``--factored`` leaves the
reference out: three seconds.
"""

from __future__ import annotations

import math
import tempfile
import time
from pathlib import Path

import numpy as np
from harness import arguments, held, show, write

import mitsim as ms
from tests.physics import nestings

LENS, JUDGED, SIGMAS = 30.0, 5e-4, 3.0


def judged(light: float, error: float, right: float) -> dict[str, float | bool]:
    """Relative difference of some ``light`` from what is right, its standard error, and whether the two agree."""
    true, stated = light / right - 1, error / right
    return {"true": true, "stated": stated, "within": abs(true) <= SIGMAS * math.hypot(stated, JUDGED)}


def row(case: tuple[str, str, str, bool], spp: int, both: bool) -> dict[str, object]:
    """Both estimators on one nesting."""
    material = nestings.nested(*case)
    found: dict[str, object] = {"irradiance": nestings.irradiance(material)}
    try:
        with tempfile.TemporaryDirectory() as folder:
            bench = ms.open_bench(nestings.write_scene(Path(folder), material))
            light = nestings.traced(bench)
        found["factored"] = judged(*light, nestings.irradiance(material))
        if both:
            with tempfile.TemporaryDirectory() as folder:
                path = nestings.write_scene(Path(folder), material, LENS)
                frame = ms.open_bench(path, for_render=True).render("reference", spp=spp)
            error = math.sqrt(np.square(frame.error).sum()) / frame.error.size
            found["reference"] = judged(float(frame.mean.mean()), error, nestings.irradiance(material, lens=LENS))
    except ms.MitsimError as error:
        found["refused"] = str(error).replace(folder, "")
    return found


def main() -> None:
    parser = arguments(__doc__, required=True)
    parser.add_argument("--spp", type=int, default=8192)
    parser.add_argument("--only", default="", help="rows whose name holds this text")
    parser.add_argument("--factored", action="store_true", help="leave the reference out")
    options = parser.parse_args()
    rows = held(options.json, {})
    for case in nestings.all_nestings():
        name = "{}({}({})){}".format(*case[:3], " textured" if case[3] else "")
        if name in rows or options.only not in name:
            continue
        begun = time.perf_counter()
        rows[name] = row(case, options.spp, not options.factored)
        rows[name]["seconds"] = time.perf_counter() - begun
        write(options.json, rows)
        show(name, rows[name])
    for which in ("factored", "reference"):
        of = [each[which] for each in rows.values() if which in each]
        largest = max((abs(each["true"]) for each in of), default=0.0)
        within = sum(each["within"] for each in of)
        print(f"{which}: {within} of {len(of)} within {SIGMAS:g} stated errors; largest true error {largest:.2%}")
    print(f"refused: {[name for name, each in rows.items() if 'refused' in each]}")


if __name__ == "__main__":
    main()

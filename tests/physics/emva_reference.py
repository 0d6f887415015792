"""Frames in, the figures of the `emva1288` reference package out; run by its own Python, see test_emva_reference.py.

The file that it is given (.npz) holds `ladder` (S, 2, M, N), `photons` (S,), `dark` (2, M, N), `dark_stack` and
`bright_stack` (L, M, N), and `half`, the photons of the last. Prints JSON.
"""

import json
import logging
import sys

import numpy as np
from emva1288.process import routines
from emva1288.process.data import Data1288
from emva1288.process.results import Results1288

given = np.load(sys.argv[1])


def temporal(frames):
    """What the package's loader keeps of a pair."""
    kept = routines.get_int_imgs(list(frames))
    return {"sum": np.sum(kept["sum"]), "pvar": np.sum(kept["pvar"]), "dmean": kept["dmean"]}


time = 1e7  # ns
ladder = {float(p): temporal(pair) for p, pair in zip(given["photons"], given["ladder"])}  # noqa: B905
rows, columns = given["dark"].shape[1:]
data = Data1288(
    {
        "width": columns,
        "height": rows,
        "temporal": {time: {0.0: temporal(given["dark"]), **ladder}},
        "spatial": {
            time: {
                0.0: routines.get_int_imgs(list(given["dark_stack"])),
                float(given["half"]): routines.get_int_imgs(list(given["bright_stack"])),
            }
        },
    },
    loglevel=logging.ERROR,
)
found = Results1288(data.data, loglevel=logging.ERROR)
gain = found.K
contrast = found.spatial["avg_mean"] - found.spatial["avg_mean_dark"]
figures = {
    "system_gain": gain,
    "quantum_efficiency": found.QE / 100,
    "dark_noise": found.sigma_d,
    "saturation_capacity": found.u_e_sat,
    "linearity_min": found.LE_min / 100,
    "linearity_max": found.LE_max / 100,
}
for part, ending in (("total", ""), ("row", "_row"), ("column", "_col"), ("pixel", "_pixel")):
    dark, lit = (getattr(found, f"s_2_y{ending}{kind}") for kind in ("_dark", ""))
    figures[f"dsnu_{part}"] = dark / gain**2
    figures[f"prnu_{part}"] = (lit - dark) / contrast**2
print(json.dumps({name: float(value) for name, value in figures.items()}))

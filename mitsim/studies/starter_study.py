"""Distance of the sheet: a study to begin with, complete as it is.

A study declares its axes, what is measured at each point, claims with thresholds, and panels. Change these;
`mitsim study --help` lists the options, such as --quick for a first look at a few points.
"""

from mitsim.report import EQUAL_PEAK, RENDERED
from mitsim.studies.framework.claims import Gain
from mitsim.studies.framework.experiment import Axes, Study
from mitsim.studies.framework.panels import Images, Lines
from mitsim.studies.framework.studio import measure_image

STUDY = Study(
    "starter",
    "Distance of the sheet",
    "What does a sheet beside the calibrated distance cost?",
    points=Axes(
        {"patterns": ("uniform", "dots:7"), "exposure": (EQUAL_PEAK,), "model": (RENDERED,)},
        scene={"sheet_z": (380, 390, 400, 410, 420)},  # a parameter of the scene file, in mm
        quick={"sheet_z": (390, 400)},
    ),
    measure=measure_image,
    claims=(
        Gain(
            "400 mm is best under 49 dots", {"sheet_z": "400"}, {"sheet_z": "390"}, where="dots:7", at_least=0.0
        ),  # dB
    ),
    panels=(
        Lines("sheet_z", "distance of the sheet [mm]", title="PSNR by distance"),
        Images("sheet_z", title="Images by distance", down=("picture", "patterns"), names="{} mm"),
    ),
    heads=("", "", "Rendered"),
)

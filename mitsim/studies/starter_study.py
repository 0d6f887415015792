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
            claim="The calibrated distance, 400 mm, is best under 49 dots",
            where={"patterns": "dots:7"},
            one={"sheet_z": "400"},
            other={"sheet_z": "390"},
            at_least=0.0,  # dB
        ),
    ),
    panels=(
        Lines(file="psnr.png", title="PSNR by distance", x="sheet_z", x_label="distance of the sheet [mm]"),
        Images(file="images.png", title="Images by distance", across="sheet_z", down=("picture", "patterns")),
    ),
    heads=("", "", "Rendered"),
)

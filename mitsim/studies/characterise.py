"""A camera's file, or frames of a real camera, in; its figures after EMVA 1288 release 4.0 and its file out.

Of a file, frames are simulated, and what they show is held against what is set. Real frames show the camera that
explains them (`mitsim.sensor.found_camera`), and figures are held against what that camera's frames would show. Each
figure's standard error is predicted: closed-form moments tell how far every statistic may be off, and a thousand
sessions of such statistics are evaluated as that of the frames is (GUM, supplement 1).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.environment import versions
from mitsim.core.files import write_json, write_text
from mitsim.core.job import Job
from mitsim.devices.flatlist import FlatFrames
from mitsim.devices.sensor import SensorModel
from mitsim.report.pages import written_figure
from mitsim.sensor import emva
from mitsim.sensor.found_camera import FoundCamera, Stated, find_camera
from mitsim.sensor.photon_transfer import Taken
from mitsim.studies.emva_frames import Frames, draw_sessions
from mitsim.studies.emva_options import Procedure, capacity_of, efficiency_of
from mitsim.studies.emva_plots import figures_of
from mitsim.studies.emva_results import UNITS, Characterisation, fields_of, row_of
from mitsim.studies.flat_frames import read_again, read_sets, remarks
from mitsim.studies.framework.page import build_findings
from mitsim.studies.framework.run import study_folder, write_figures

CAMERA_FILE = "camera.toml"
"""The camera that was found."""


def characterise(
    sensor: SensorModel, procedure: Procedure | None = None, output: Path | str | None = None, job: Job | None = None
) -> Characterisation:
    """Run EMVA 1288's procedure on frames of a camera, and write page, plots, JSON and the camera found where a folder
    is given.

    Parameters
    ----------
    sensor
        the camera.
    procedure
        sizes and seed.
    output
        new or empty folder, or one of an earlier characterisation, which is replaced.
    job
        told how far it is.

    Raises
    ------
    MitsimError
        for a camera that light never saturates, a wavelength outside its curve, or a folder that holds something else.
    """
    procedure, job = procedure or Procedure(), job or Job()
    frames = Frames.of(sensor, procedure, capacity_of(sensor))

    def measure(folder: str | None) -> Characterisation:
        taken = frames.take(job)
        efficiency_of(sensor, procedure)
        bits = None if sensor.largest_dn is None else int(sensor.largest_dn).bit_length()
        source = f"simulated frames of {sensor.name}"
        stated = Stated(f"{sensor.name}, found", sensor.superpixel_pitch_um, source, bits, sensor.states_efficiency)
        images = lambda index: np.mean([*frames.images(index)], axis=0)  # noqa: E731
        found = find_camera(taken, images, stated, lambda places: frames.take(job, places))
        return _hold_against(frames, taken, found, {"asked": procedure.stated, "camera": sensor.name}, folder)

    return _write(measure, output)


def characterise_frames(
    listed: FlatFrames, output: Path | str | None = None, job: Job | None = None
) -> Characterisation:
    """Measure a real camera by its frames, and write page, plots, JSON and the camera's file where a folder is given.

    Parameters
    ----------
    listed
        frames under even light and in the dark (:func:`mitsim.devices.flatlist.load_flats`).
    output
        new or empty folder, or one of an earlier characterisation, which is replaced.
    job
        told how far it is.

    Raises
    ------
    MitsimError
        for frames that cannot be read, that are not what the list says, or that tell nothing of the camera.
    """
    job = job or Job()

    def measure(folder: str | None) -> Characterisation:
        sets = read_sets(listed, job)
        taken = [each.taken for each in sets]
        facts = listed.listed
        stated = Stated(facts.name, facts.pixel_pitch_um, facts.source, facts.bits, facts.photons_per_s is not None)
        found = find_camera(
            taken, lambda index: sets[index].mean_image(), stated,
            lambda places: read_again(listed, places, taken[0].said.shape),
        )  # fmt: skip
        frames = Frames.as_taken(taken, found)
        asked = {"folder": str(listed.folder), "shape": frames.shape, "sets": len(sets)}
        about = remarks(sets, found)
        return _hold_against(
            frames, taken, found, {"asked": asked, "camera": facts.name, "real": True, "about": about}, folder
        )

    return _write(measure, output)


def _hold_against(
    frames: Frames, taken: list[Taken], found: FoundCamera, what: Mapping[str, Any], output: str | None
) -> Characterisation:
    """Figures of sets that were ``taken``, beside those of the sensor of ``frames``, which real frames have found."""
    expected, session = frames.expect(), frames.session(taken)
    spread, figures = emva.figures(draw_sessions(frames, expected)), emva.figures(session)
    # Without a quantum efficiency light is counted in electrons, and there is none to find.
    sensor = frames.sensor
    names = [name for name in UNITS if name in figures and name in spread]
    names = [name for name in names if sensor.states_efficiency or name != "quantum_efficiency"]
    bend = found.transfer.error("bend") if what.get("real") else 0.0  # what is expected is then known to that
    rows = tuple(row_of(frames, name, figures[name], spread[name], bend) for name in names)
    fields = fields_of(found, None if what.get("real") else sensor)
    return Characterisation(
        frames=frames, session=session, expected=expected, rows=rows, found=found, fields=fields, output=output, **what
    )


def _write(measure: Callable[[str | None], Characterisation], output: Path | str | None) -> Characterisation:
    """What is measured, written to the folder ``output`` where there is one."""
    if output is None:
        return measure(None)
    with study_folder(output, "characterise") as folder:
        done = measure(str(folder))
        results = folder / "characterise.json"  # last, so that a folder with it is whole
        results.unlink(missing_ok=True)
        figures = write_figures(folder, figures_of(done))
        pictures = {name: written_figure(figure, folder / name) for name, figure in figures.items()}
        titles = done.title, done.message
        page = build_findings("characterise", titles, done.where, done.parts, pictures, done.warnings)
        write_text(folder / "characterise.html", page)
        write_text(folder / CAMERA_FILE, done.found.toml())
        write_json(results, {**done.payload(), "kind": "characterise", "versions": versions()})
    return done

"""A checked scene and a camera file's sensor in; the scene's camera with its pixels, and a sentence on it, out.

A scene's film and ``pixel_pitch`` stand for what no camera file says: a file that is named says what the sensor is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mitsuba as mi

from mitsim.devices.camera import CameraGeometry
from mitsim.devices.sensor import PITCH_TOLERANCE, SensorModel
from mitsim.scene.limits import PLUGINS, references

if TYPE_CHECKING:
    from mitsim.scene.check import CheckedScene

_WINDOW = "crop_offset_x", "crop_offset_y", "crop_width", "crop_height"
_PITCH = float(CameraGeometry.model_fields["pixel_pitch"].default)


def fit_film(checked: CheckedScene, sensor: SensorModel) -> str:
    """Give the cameras of a scene the pitch and the format of a camera file.

    Parameters
    ----------
    checked
        the scene, whose tree is changed.
    sensor
        whose pitch counts where it differs by more than :data:`PITCH_TOLERANCE`, and whose rows and columns, where it
        states them, count in place of the film's size and crop window.

    Returns
    -------
    a sentence that names both, where something changes; else nothing.

    Raises
    ------
    MitsimError
        for a camera without a film whose size can be set.
    """
    nodes, words = checked.state.nodes, ""
    for node in nodes:
        if node.props.plugin_name() != "mitsim_lensless":
            continue
        films = [nodes[at].props for at in references(node.props) if nodes[at].props.plugin_name() in _FILMS]
        if not films:
            tag = checked.outline.tag(mi.parser.SceneNode(node))
            raise tag.refusal("film", "none", "the camera file's rows and columns are its size; give it a <film>")
        before = _sensor_words(node.props, films[0])
        _set_pitch(node.props, sensor)
        _set_size(films[0], sensor)
        after = _sensor_words(node.props, films[0])
        if after != before:
            words = (
                f"sensor {sensor.name!r}: {after}, as its camera file says; the scene's own, {before}, stand where no "
                "camera is named"
            )
    return words


_FILMS = PLUGINS["film"].split()


def _sensor_words(camera: mi.Properties, film: mi.Properties) -> str:
    """Pixels and pitch of a film in words."""
    column = float(camera.get("pixel_pitch", _PITCH))
    row = float(camera.get("row_pitch", column))
    rows, columns = (int(film.get(name, default)) for name, default in (("height", 576), ("width", 768)))
    pitch = f"{column * 1e3:g}" if row == column else f"{row * 1e3:g} x {column * 1e3:g}"
    window = f", of which a window of {film['crop_height']} x {film['crop_width']}" if _WINDOW[-1] in film else ""
    return f"{rows} x {columns} pixels of {pitch} um ({rows * row:.3g} x {columns * column:.3g} mm){window}"


def _set_pitch(camera: mi.Properties, sensor: SensorModel) -> None:
    own_row, own_column = sensor.pitches_mm
    column = float(camera.get("pixel_pitch", _PITCH))
    row = float(camera.get("row_pitch", column))
    if abs(own_column - column) > PITCH_TOLERANCE * column or abs(own_row - row) > PITCH_TOLERANCE * row:
        camera["pixel_pitch"] = own_column
        if "row_pitch" in camera:
            del camera["row_pitch"]
        if own_row != own_column:
            camera["row_pitch"] = own_row


def _set_size(film: mi.Properties, sensor: SensorModel) -> None:
    if sensor.frame_shape is not None:
        film["height"], film["width"] = sensor.frame_shape
        for name in _WINDOW:
            if name in film:
                del film[name]

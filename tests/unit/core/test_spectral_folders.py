"""A run without lines, one with a folder for each line, and one behind colour filters are opened in one way."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mitsim.core.colour_files import CALIBRATION, MOSAIC, RUN, open_lines
from mitsim.core.errors import MitsimError

NAMES = ("638nm", "520nm")
LINES = [{"name": name, "wavelength_nm": float(name[:3])} for name in NAMES]


def folder(place: Path, kind: str, lines: list[dict[str, object]] = LINES) -> Path:
    place.mkdir()
    filters = {"mosaic": "RGGB", "weights": [[0.5] * len(lines)] * 4} if kind == MOSAIC else {}
    (place / "colour.json").write_text(json.dumps({"kind": kind, "channels": lines, **filters}))
    return place


def test_every_kind_of_run_states_its_lines_and_where_its_frames_are(tmp_path: Path) -> None:
    """(Planted: the frames of a run behind filters looked for in the folders of its lines.)"""
    mono, lines, mosaic = (
        open_lines(place, RUN, MOSAIC)
        for place in (tmp_path, folder(tmp_path / "lines", RUN), folder(tmp_path / "mosaic", MOSAIC))
    )
    assert (mono.names, mono.filters, mono.parts) == (("",), None, {"": tmp_path})
    assert lines.names == mosaic.names == NAMES and lines.filters is None
    assert lines.parts == {name: tmp_path / "lines" / name for name in NAMES}
    assert mosaic.parts == {"": tmp_path / "mosaic"}
    assert mosaic.filters is not None and mosaic.filters.mosaic == "RGGB"
    with pytest.raises(MitsimError, match="holds a mosaic-run, not a colour-run"):
        open_lines(tmp_path / "mosaic", RUN)


def test_a_calibration_has_the_lines_of_its_run(tmp_path: Path) -> None:
    """(Planted: lines compared by name alone.)"""
    calibration = folder(tmp_path / "cal", CALIBRATION)
    other = folder(tmp_path / "other", CALIBRATION, [{**line, "wavelength_nm": 600.0} for line in LINES])
    for place in (folder(tmp_path / "lines", RUN), folder(tmp_path / "mosaic", MOSAIC)):
        run = open_lines(place, RUN, MOSAIC)
        assert run.check_calibration(calibration).parts == {name: calibration / name for name in NAMES}
        for wrong, words in ((other, "calibrate each line"), (tmp_path, "holds no colour.json")):
            with pytest.raises(MitsimError, match=words):
                run.check_calibration(wrong)
    mono = open_lines(tmp_path, RUN)
    assert mono.check_calibration(tmp_path).parts == {"": tmp_path}
    with pytest.raises(MitsimError, match=r"is coloured, but .* is not"):
        mono.check_calibration(calibration)

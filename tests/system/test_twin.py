"""`mitsim study twin` on real captures, where these are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
"""Beside the project; public, and too large for it."""


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason="real captures are not there")
def test_real_captures_are_predicted(call: Callable[..., Any], tmp_path: Path) -> None:
    """Codes of one FlatCam capture predict the other's frame far better than its neighbour's scene does, and only half
    as much energy again as noise is left; a diffuser's contrast and brightest pixels are within a tenth."""
    found = call("study", "twin", "--data", SHARED, "-o", tmp_path / "out", "--json", "--quiet").payload
    green = {row["frame"]: row for row in found["captures"] if row["frame"].endswith("gb")}
    for name, least in {"fc_6 gb": 0.86, "fc_7 gb": 0.79}.items():
        assert green[name]["correlation"] > least
        assert green[name]["correlation_other_scene"] < least - 0.1
        assert 1.4 < green[name]["chi_square"] < 1.9 and green[name]["render_error"] < 0.03
    for name in ("contrast", "brightest"):
        numbers = found["diffuser"][name]
        assert numbers["simulated"] == pytest.approx(numbers["measured"], rel=0.2)

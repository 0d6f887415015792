"""Tables of docs/formats.md and docs/shipped.md: models of formats and lists of what is shipped in, Markdown out.

    python docs/tables.py

rewrites what stands between ``<!-- fields: NAME -->`` and ``<!-- end -->``, and, as `mitsim list KIND` says it, between
``<!-- list: KIND -->`` and the same. tests/unit/core/test_formats.py fails when a file differs from models or lists.
"""

from __future__ import annotations

import re
from pathlib import Path

from pydantic import BaseModel

from mitsim.cli.shelf_verbs import KINDS, allowed_text, default_text, meanings
from mitsim.core.imagelist import Crop, Preparation, Raw
from mitsim.core.manifests import (
    AmbientFile,
    CalibrationManifest,
    ClosingFile,
    ColourManifest,
    Digital,
    FactorNoise,
    Line,
    MosaicManifest,
    Parallax,
    Patterns,
    RunManifest,
    ShotFile,
)
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.framelist import ChartPlace, DarkFile, FrameList, KnownCapture, KnownList, StripeFile
from mitsim.devices.mask_profile import MaskProfile
from mitsim.devices.projector import Coherence, ProjectorModel
from mitsim.devices.sensor import EfficiencyCurve, SensorModel
from mitsim.devices.session import BoardShape, Drift, SessionRecipe
from mitsim.exchange.capture_list import CaptureList
from mitsim.learn.pair_store import ModelManifest, PairsManifest, Shard
from mitsim.learn.requests import Variation
from mitsim.light.plan import PlanFile

FORMATS, SHIPPED = (Path(__file__).with_name(name) for name in ("formats.md", "shipped.md"))
MODELS = (
    *(CameraGeometry, MaskProfile, ProjectorModel, Coherence),
    *(SensorModel, EfficiencyCurve),
    *(SessionRecipe, BoardShape, Drift),
    *(RunManifest, Digital, Patterns, ShotFile, AmbientFile, ClosingFile),
    *(CalibrationManifest, FactorNoise, Parallax),
    *(FrameList, StripeFile, DarkFile, Raw, Preparation, Crop),
    *(CaptureList, KnownList, KnownCapture),
    *(ColourManifest, Line, ChartPlace),
    MosaicManifest,
    PlanFile,
    *(PairsManifest, Shard, Variation),
    ModelManifest,
)


def table(model: type[BaseModel]) -> str:
    """Markdown table of a ``model``: its fields, what is allowed, the default and the meaning."""
    schema, known = model.model_json_schema(), meanings(model)
    lines = ["| field | allowed | default | meaning |", "|---|---|---|---|"]
    for name, rules in schema["properties"].items():
        default = "required" if name in schema.get("required", ()) else default_text(model.model_fields[name].default)
        lines.append(f"| `{name}` | {allowed_text(rules)} | {default} | {known[name]} |")
    return "\n".join(lines)


def list_table(kind: str) -> str:
    """Markdown table of what `mitsim list` says of a ``kind``."""
    entries = [*KINDS[kind]()]
    two = any(each.what for each in entries)
    rows = [f"| `{each.name}` |{f' {each.what} |' if two else ''} {each.serves} |" for each in entries]
    return "\n".join(["| name | what | for |" if two else "| name | what |", "|---" * (2 + two) + "|", *rows])


def rewritten(text: str) -> str:
    """``text`` of formats.md with every table between its marks as the models have it, and its lists."""
    for model in MODELS:
        text = _between(f"fields: {model.__name__}", table(model), text)
    return with_lists(text)


def with_lists(text: str) -> str:
    """The ``text`` of any page with the lists that it has marks for."""
    for kind in re.findall("<!-- list: (\\w+) -->", text):
        text = _between(f"list: {kind}", list_table(kind), text)
    return text


def _between(mark: str, made: str, text: str) -> str:
    start, end = f"<!-- {mark} -->\n", "<!-- end -->"
    before, rest = text.split(start)
    return f"{before}{start}\n{made}\n\n{end}{rest.split(end, 1)[1]}"


if __name__ == "__main__":
    FORMATS.write_text(rewritten(FORMATS.read_text(encoding="utf-8")), encoding="utf-8")
    SHIPPED.write_text(with_lists(SHIPPED.read_text(encoding="utf-8")), encoding="utf-8")

"""Tables of docs/formats.md: the models that read and write each format in, Markdown out.

    python docs/tables.py

rewrites what stands between ``<!-- fields: NAME -->`` and ``<!-- end -->``. tests/unit/core/test_formats.py fails when
the file differs from the models.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from mitsim.core.imagelist import Crop, Preparation, Raw
from mitsim.core.manifests import (
    AmbientFile,
    CalibrationManifest,
    Digital,
    FactorNoise,
    Parallax,
    Patterns,
    RunManifest,
    ShotFile,
)
from mitsim.core.mistakes import meanings
from mitsim.core.spectral_manifests import ColourManifest, Line, MosaicManifest
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.chart import ChartPlace
from mitsim.devices.framelist import DarkFile, FrameList, StripeFile
from mitsim.devices.knownlist import KnownCapture, KnownList
from mitsim.devices.mask_profile import MaskProfile
from mitsim.devices.projector import Coherence, ProjectorModel
from mitsim.devices.sensor import EfficiencyCurve, SensorModel
from mitsim.devices.session import BoardShape, Drift, SessionRecipe
from mitsim.exchange.capture_list import CaptureList
from mitsim.learn.pair_request import Variation
from mitsim.learn.pair_store import PairsManifest, Shard
from mitsim.learn.training_request import ModelManifest
from mitsim.light.plan import PlanFile

FORMATS = Path(__file__).with_name("formats.md")
MODELS = (
    *(CameraGeometry, MaskProfile, ProjectorModel, Coherence),
    *(SensorModel, EfficiencyCurve),
    *(SessionRecipe, BoardShape, Drift),
    *(RunManifest, Digital, Patterns, ShotFile, AmbientFile, CalibrationManifest, FactorNoise, Parallax),
    *(FrameList, StripeFile, DarkFile, Raw, Preparation, Crop),
    *(CaptureList, KnownList, KnownCapture),
    *(ColourManifest, Line, ChartPlace),
    MosaicManifest,
    PlanFile,
    *(PairsManifest, Shard, Variation),
    ModelManifest,
)
_PLAIN = {"string": "text", "boolean": "true or false", "integer": "whole number", "number": "number"}


def table(model: type[BaseModel]) -> str:
    """Markdown table of a ``model``: its fields, what is allowed, the default and the meaning."""
    schema, known = model.model_json_schema(), meanings(model)
    lines = ["| field | allowed | default | meaning |", "|---|---|---|---|"]
    for name, rules in schema["properties"].items():
        default = "required" if name in schema.get("required", ()) else _default(model.model_fields[name].default)
        lines.append(f"| `{name}` | {_allowed(rules)} | {default} | {known[name]} |")
    return "\n".join(lines)


def _default(value: Any) -> str:
    if value is None or value in ({}, (), "") or isinstance(value, BaseModel):
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    return "infinite" if value == float("inf") else f"{value:g}" if isinstance(value, float) else str(value)


def _allowed(rules: dict[str, Any]) -> str:
    """What a field takes, from its JSON schema."""
    if "anyOf" in rules:
        return ", ".join("null" if choice.get("type") == "null" else _allowed(choice) for choice in rules["anyOf"])
    if "const" in rules or "enum" in rules:
        return ", ".join(f"`{value}`" for value in rules.get("enum", [rules.get("const")]))
    if "$ref" in rules or rules.get("type") == "object":
        return "object"
    if "prefixItems" in rules:
        return f"list of {len(rules['prefixItems'])}: {_allowed(rules['prefixItems'][0])}"
    if rules.get("type") == "array":
        if "prefixItems" in rules:
            return f"list of {len(rules['prefixItems'])}: {_allowed(rules['prefixItems'][0])}"
        most = f", at most {rules['maxItems']}" if "maxItems" in rules else ""
        return f"list: {_allowed(rules['items'])}{most}"
    if "pattern" in rules:
        words = re.fullmatch(r"\^\(([\w|]+)\)\$", rules["pattern"])
        return ", ".join(f"`{word}`" for word in words[1].split("|")) if words else "text without / and \\"
    least, above = rules.get("minimum"), rules.get("exclusiveMinimum")
    most, below = rules.get("maximum"), rules.get("exclusiveMaximum")
    start = f"{least:g}" if least is not None else f"above {above:g}" if above is not None else ""
    end = f"{most:g}" if most is not None else f"below {below:g}" if below is not None else ""
    if start and end:
        return start if start == end else f"{start} to {end}"
    kind = _PLAIN.get(rules.get("type", ""), "anything")
    return f"{kind}, at least {start}" if least is not None else f"{kind}, {start}" if start else kind


def rewritten(text: str) -> str:
    """``text`` with every table between its marks as the models have it."""
    for model in MODELS:
        start, end = f"<!-- fields: {model.__name__} -->\n", "\n<!-- end -->"
        before, rest = text.split(start)
        text = f"{before}{start}\n{table(model)}\n{end}{rest.split(end, 1)[1]}"
    return text


if __name__ == "__main__":
    FORMATS.write_text(rewritten(FORMATS.read_text(encoding="utf-8")), encoding="utf-8")

"""Write the tables of the docs from the models of file formats and from the lists of shipped things.

    python docs/tables.py

replaces the text between ``<!-- fields: NAME -->`` and ``<!-- end -->`` by the fields of a model, and the text between
``<!-- list: KIND -->`` and ``<!-- end -->`` by the output of `mitsim list KIND`. tests/unit/core/test_formats.py fails
if a page differs from models or lists.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from mitsim.cli.shelf_verbs import KINDS, meanings
from mitsim.core.colour_files import ColourManifest, Line, MosaicManifest
from mitsim.core.manifests import (
    AmbientFile,
    CalibrationManifest,
    ClosingFile,
    Digital,
    FactorNoise,
    Parallax,
    Patterns,
    RunManifest,
    ShotFile,
    _Head,
)
from mitsim.core.picture_files import Crop, Preparation, Raw
from mitsim.design.goal import Goal
from mitsim.devices.camera import CameraGeometry, MaskProfile
from mitsim.devices.framelist import ChartPlace, DarkFile, FrameList, KnownCapture, KnownList, StripeFile
from mitsim.devices.projector import Coherence, ProjectorModel
from mitsim.devices.sensor import EfficiencyCurve, SensorModel
from mitsim.devices.session import BoardShape, Drift, SessionRecipe
from mitsim.exchange.capture_list import CaptureList
from mitsim.learn.requests import Variation

PAGES = sorted(Path(__file__).parent.glob("*.md"))
MODELS = (
    *(CameraGeometry, MaskProfile, ProjectorModel, Coherence),
    *(SensorModel, EfficiencyCurve),
    *(SessionRecipe, BoardShape, Drift),
    *(_Head, RunManifest, Digital, Patterns, ShotFile, AmbientFile, ClosingFile),
    *(CalibrationManifest, FactorNoise, Parallax),
    *(FrameList, StripeFile, DarkFile, Raw, Preparation, Crop),
    *(CaptureList, KnownList, KnownCapture),
    *(ColourManifest, Line, ChartPlace),
    MosaicManifest,
    Variation,
    Goal,
)


_PLAIN = {"string": "text", "boolean": "true or false", "integer": "whole number", "number": "number"}


def default_text(value: object) -> str:
    """Return a field's default ``value`` in words."""
    if value is None or value in ({}, (), "") or isinstance(value, BaseModel):
        return "none"
    if isinstance(value, tuple):
        return ", ".join(map(default_text, value))
    if isinstance(value, bool):
        return str(value).lower()
    return "infinite" if value == float("inf") else f"{value:g}" if isinstance(value, float) else str(value)


def allowed_text(rules: Mapping[str, Any]) -> str:
    """Return the values that a field may have, from the ``rules`` of its JSON schema."""
    if "anyOf" in rules:
        # The default "none" already says that a value may be absent.
        return ", ".join({allowed_text(choice): 1 for choice in rules["anyOf"] if choice.get("type") != "null"})
    if "const" in rules or "enum" in rules:
        return ", ".join(f"`{value}`" for value in rules.get("enum", [rules.get("const")]))
    if "$ref" in rules or rules.get("type") == "object":
        return "object"
    if "prefixItems" in rules:
        return f"list of {len(rules['prefixItems'])}: {allowed_text(rules['prefixItems'][0])}"
    if rules.get("type") == "array":
        length = f", at most {rules['maxItems']}" if "maxItems" in rules else ""
        return f"list: {allowed_text(rules['items'])}{length}"
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


def table(model: type[BaseModel]) -> str:
    """Return the Markdown table of a ``model``: fields, allowed values, defaults and meanings.

    Fields of a base class are in the table of that class.
    """
    schema, known = model.model_json_schema(), meanings(model)
    inherited = {name for base in model.__mro__[1:] if base in MODELS for name in base.model_fields}
    lines = ["| field | allowed | default | meaning |", "|---|---|---|---|"]
    for name, rules in schema["properties"].items():
        if name in inherited:
            continue
        default = "required" if name in schema.get("required", ()) else default_text(model.model_fields[name].default)
        lines.append(f"| `{name}` | {allowed_text(rules)} | {default} | {known[name]} |")
    return "\n".join(lines)


def list_table(kind: str) -> str:
    """Return the output of `mitsim list` for a ``kind`` as a Markdown table."""
    entries = [*KINDS[kind]()]
    two = any(each.what for each in entries)
    rows = [f"| `{each.name}` |{f' {each.what} |' if two else ''} {each.serves} |" for each in entries]
    head = "| name | description | use |" if two else "| name | description |"
    return "\n".join([head, "|---" * (2 + two) + "|", *rows])


def rewritten(text: str) -> str:
    """Return the ``text`` of a page with all tables between its marks made anew."""
    fields = {model.__name__: model for model in MODELS}
    for name in re.findall(r"<!-- fields: (\w+) -->", text):
        text = _between(f"fields: {name}", table(fields[name]), text)
    for kind in re.findall(r"<!-- list: (\w+) -->", text):
        text = _between(f"list: {kind}", list_table(kind), text)
    return text


def _between(mark: str, made: str, text: str) -> str:
    start, end = f"<!-- {mark} -->\n", "<!-- end -->"
    before, rest = text.split(start)
    return f"{before}{start}\n{made}\n\n{end}{rest.split(end, 1)[1]}"


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(rewritten(page.read_text(encoding="utf-8")), encoding="utf-8")

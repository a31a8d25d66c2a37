"""docs/reference/scene_json.md: scene.json and the lines of --log-json, from the schemas they are held against."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

ASSETS = Path(__file__).parents[1] / "more2_jax" / "assets"
HEAD = """# scene.json

What the folder of a living scene says of it in `scene.json`. Lengths are in meters and angles in degrees. A pose
`T_a_b` is a 4×4 matrix, row by row, that takes points of frame b to frame a. What is stored keeps to the JSON Schema
in the package, `more2_jax/assets/scene.schema.json`.

"""
LOG = """
## Lines of --log-json

One JSON object a line. The schema is `more2_jax/assets/log.schema.json`.

"""


def scene_json_page() -> str:
    """Markdown: a table of the whole file, and one of every record in it."""
    return HEAD + tables(schema("scene")) + LOG + table(schema("log"))


def schema(name: str) -> dict[str, Any]:
    """A schema of the package."""
    return json.loads((ASSETS / f"{name}.schema.json").read_text(encoding="utf-8"))


def tables(whole: dict[str, Any]) -> str:
    """The file itself and each record that it names."""
    parts = [f"## The file\n{table(whole)}"]
    for name, inner in whole["$defs"].items():
        if "properties" in inner:
            parts.append(f"## {name}\n{inner.get('description', '')}\n\n{table(inner)}")
    plain = {k: v for k, v in whole["$defs"].items() if "properties" not in v}
    rows = [f"| {k} | {kind(v)} | {v.get('description', '')} |" for k, v in plain.items()]
    parts.append("\n".join(["## Plain values", "| name | is | means |", "|---|---|---|", *rows, ""]))
    return "\n".join(parts)


def table(record: dict[str, Any]) -> str:
    """The keys of one record."""
    needed = set(record.get("required", ()))
    rows = []
    for key, value in record["properties"].items():
        present = "always" if key in needed else "where there is any"
        rows.append(f"| `{key}` | {kind(value)} | {present} | {value.get('description', '')} |")
    return "\n".join(["| key | is | present | means |", "|---|---|---|---|", *rows, ""])


def kind(value: dict[str, Any]) -> str:
    """What a value is, in words; records link to their tables."""
    if "$ref" in value:
        name = value["$ref"].rsplit("/", 1)[1]
        return f"[{name}](#{name})" if "properties" in schema("scene")["$defs"].get(name, {}) else f"{name}"
    if "const" in value:
        return f"`{json.dumps(value['const'])}`"
    if "enum" in value:
        return ", ".join(f"`{json.dumps(v)}`" for v in value["enum"])
    if "oneOf" in value:
        return " or ".join(kind(v) for v in value["oneOf"])
    kinds = value.get("type", "any")
    if kinds == "array":
        length = (
            f"{value['minItems']} × " if value.get("minItems") == value.get("maxItems", -1) else "list of "
        )
        return length + kind(value["items"])
    if kinds == "object" and isinstance(value.get("additionalProperties"), dict):
        keys = kind(value["propertyNames"]) if "propertyNames" in value else "string"
        return f"{keys} → {kind(value['additionalProperties'])}"
    return " or ".join(kinds) if isinstance(kinds, list) else str(kinds)

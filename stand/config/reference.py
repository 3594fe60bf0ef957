"""A configuration file's reference in Markdown, from its JSON Schema: each key with its kind, bounds and default."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, cast

Schema = Mapping[str, Any]
_BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}


def make_reference(title: str, schema: Schema) -> str:
    """A page: what the file has at its top, then a section for each model, in the order in which they are named."""
    models = cast("dict[str, Schema]", schema.get("$defs", {}))
    lines = [f"# {title}", "", *_describe_model(schema)]
    for name, model in models.items():
        if "properties" in model:
            lines += ["", f"## {name}", "", *_describe_model(model)]
    return "\n".join(lines) + "\n"


def _describe_model(model: Schema) -> Iterator[str]:
    if text := str(model.get("description", "")):
        yield _escape_markdown(text)
        yield ""
    yield "| key | what | default |"
    yield "|---|---|---|"
    needed = set(cast("list[str]", model.get("required", [])))
    for key, value in cast("dict[str, Schema]", model.get("properties", {})).items():
        default = "to be given" if key in needed else f"`{value['default']}`" if "default" in value else ""
        yield f"| `{key}` | {_describe_kind(value)} | {default.replace('|', '/')} |"


def _describe_kind(value: Schema) -> str:
    """What may stand there; models as links to their sections."""
    if "$ref" in value:
        name = str(value["$ref"]).rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if "const" in value:
        return f"`{value['const']}`"
    if "enum" in value:
        return " or ".join(f"`{each}`" for each in value["enum"])
    for several in ("anyOf", "oneOf", "allOf"):
        if several in value:
            kinds = [_describe_kind(each) for each in value[several] if each.get("type") != "null"]
            return " or ".join(dict.fromkeys(kinds)) + _describe_bounds(value)
    kind = str(value.get("type", "anything"))
    if kind == "array":
        items = value.get("items") or next(iter(value.get("prefixItems", [])), {})
        return f"list of {_describe_kind(items)}"
    if kind == "object" and isinstance(value.get("additionalProperties"), Mapping):
        return f"by name: {_describe_kind(value['additionalProperties'])}"
    return kind + _describe_bounds(value)


def _describe_bounds(value: Schema) -> str:
    found = [f"{sign} {value[name]}" for name, sign in _BOUNDS.items() if name in value]
    return f" {', '.join(found)}" if found else ""


def _escape_markdown(text: str) -> str:
    """No line of it is taken for Markdown's own."""
    return " ".join(text.split()).replace("<", "&lt;").replace("*", "\\*")

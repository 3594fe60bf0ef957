"""Values as JSON can hold them, and JSON texts that may be anything."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, cast


def make_plain(value: Any) -> Any:
    """Objects, lists, texts and numbers at any depth: fields of dataclasses and models under their names, arrays as
    lists, NaN and infinities as null. What else there is stays as it is."""
    if is_dataclass(value):
        return {field.name: make_plain(getattr(value, field.name)) for field in fields(value)}
    if hasattr(value, "model_dump"):
        return make_plain(value.model_dump())
    if isinstance(value, Mapping):
        return {str(key): make_plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [make_plain(one) for one in value]
    if hasattr(value, "tolist"):
        return make_plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def parse_json_object(text: str | bytes) -> dict[str, object] | None:
    """The keys and values of a JSON text; None when it is no JSON object, or nested deeper than Python goes."""
    try:
        found: object = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return cast("dict[str, object]", found) if isinstance(found, dict) else None

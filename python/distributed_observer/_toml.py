"""Python's values as TOML, for changes of keys."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any


def changes(values: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return keys and values as the command line's ``--set`` takes them."""
    return [(str(key), _toml(key, value)) for key, value in values.items()]


def _toml(key: str, value: Any) -> str:
    # Arrays and numbers of NumPy.
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        parts = (f"{json.dumps(str(name))} = {_toml(key, part)}" for name, part in value.items())
        return "{ " + ", ".join(parts) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(key, part) for part in value) + "]"
    found = type(value).__name__
    raise TypeError(f"set: {key}: {found} is not a TOML value; give a number, text, list or dict")

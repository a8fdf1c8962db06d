"""Python's values as TOML, for changes of keys."""

from __future__ import annotations

import json
import re
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
        return _text(value)
    if isinstance(value, Mapping):
        parts = (f"{_name(str(name))} = {_toml(key, part)}" for name, part in value.items())
        return "{ " + ", ".join(parts) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(key, part) for part in value) + "]"
    found = type(value).__name__
    raise TypeError(f"set: {key}: {found} is not a TOML value; give a number, text, list or dict")


def _text(value: str) -> str:
    # A text of JSON is one of TOML, but for one character.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _name(name: str) -> str:
    return name if re.fullmatch("[A-Za-z0-9_-]+", name) else _text(name)

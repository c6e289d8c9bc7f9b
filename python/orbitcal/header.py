"""`header.toml` of a recording, as a dictionary and as text (docs/recording.md)."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from ._orbitcal import InputError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def header_of_text(text: str) -> dict[str, Any]:
    """The header as a dictionary."""
    return tomllib.loads(text)


def text_of_header(header: Mapping[str, Any]) -> str:
    """The text of a header: keys with texts, numbers, lists and tables of these."""
    return "".join(f"{_key(key)} = {_value(value)}\n" for key, value in header.items() if value is not None)


def _key(key: str) -> str:
    return json.dumps(key, ensure_ascii=False)


def _value(value: Any) -> str:
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(str(key))} = {_value(one)}" for key, one in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, float):
        return repr(value)
    raise InputError(f"header: expected texts, numbers, lists and tables of these, found {value!r}")

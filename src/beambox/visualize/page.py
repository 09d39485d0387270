"""Pages filled from templates: every mark is replaced once, in one pass, so that no content is read as a mark."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

__all__ = ["data_url", "fill", "script_json", "template"]

MARK = re.compile(r"\{\{([A-Z_]+)\}\}")


def template(name: str) -> str:
    """Read a file that lies beside this module, or in a folder there."""
    return (Path(__file__).parent / name).read_text(encoding="utf-8")


def fill(text: str, values: Mapping[str, str]) -> str:
    """Replace each ``{{NAME}}`` of a template by its value; values are taken as they are, marks in them too.

    Raises:
        KeyError: if the template has a mark without a value.
    """
    return MARK.sub(lambda mark: values[mark.group(1)], text)


def script_json(content: Any) -> str:
    """Write JSON that can stand inside ``<script type="application/json">``: nothing in it ends or begins a tag."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def data_url(content: bytes, kind: str) -> str:
    """Return an address that holds its content, such as a picture of kind ``image/jpeg``."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"

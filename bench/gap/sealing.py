"""Answers kept so that nobody reads them by accident, with a digest that says they are untouched.

Compressed JSON in base 85: not secret, but neither a search through the files nor a look at one
shows what it holds.
"""

from __future__ import annotations

import base64
import hashlib
import json
import zlib
from pathlib import Path
from typing import Any

NOTE = "sealed: opened by score.py only\n"


def seal(answer: dict[str, Any]) -> str:
    """The text of a sealed answer."""
    packed = zlib.compress(json.dumps(answer, sort_keys=True).encode(), 9)
    return NOTE + base64.b85encode(packed).decode() + "\n"


def unseal(text: str) -> dict[str, Any]:
    """The answer in a sealed text.

    Raises
    ------
    ValueError : the text is not one that `seal` wrote.
    """
    if not text.startswith(NOTE):
        raise ValueError("not a sealed answer: it does not begin with the note of seal()")
    try:
        return json.loads(zlib.decompress(base64.b85decode(text[len(NOTE) :].strip())))
    except (zlib.error, json.JSONDecodeError, ValueError) as error:
        raise ValueError(f"a damaged sealed answer: {error}") from error


def digest(*contents: bytes) -> str:
    """SHA-256 of byte strings, each preceded by its length."""
    total = hashlib.sha256()
    for content in contents:
        total.update(len(content).to_bytes(8, "little") + content)
    return total.hexdigest()


def file_digest(*paths: Path) -> str:
    return digest(*(path.read_bytes() for path in paths))

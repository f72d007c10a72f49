"""Writes texts and keys in TOML syntax; reading them gives the same texts.

Knows quoting and escapes; knows no file.
"""

import json
import re
from typing import Final

_BARE_KEY: Final = re.compile(r"[A-Za-z0-9_-]+")


def toml_string(text: str) -> str:
    """Return a text as a quoted TOML string on one line, with all invisible characters escaped."""
    quoted = json.dumps(text, ensure_ascii=False)
    if quoted.isprintable():
        return quoted
    return "".join(each if each.isprintable() else f"\\U{ord(each):08X}" for each in quoted)


def toml_key(name: str) -> str:
    """Return the name of a key in TOML: as it is where that is allowed, else as a quoted string."""
    return name if _BARE_KEY.fullmatch(name) else toml_string(name)

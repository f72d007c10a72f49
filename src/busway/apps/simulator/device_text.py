"""Writes units as the text of a device file; reading that text gives the same units.

Knows how TOML is written and the keys of a unit; writes no file.

1. Keys that were not set for a unit are left out of its text, so that the file shows only what was decided.
2. A point is written with one line for each key, as people do; with ``compact``, each point is one line.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from pydantic import BaseModel

from ...config.toml_text import toml_key, toml_string

_RUNNING: Final = b"\xff"


def device_text(
    units: Iterable[BaseModel], *, listen: Sequence[str] = (), remarks: Iterable[str] = (), compact: bool = False
) -> str:
    """Return the text of a device file, in TOML, for these units.

    Args:
        units: the units (`UnitSection`).
        listen: URLs to listen on when the file is served; empty for the default.
        remarks: comment lines at the top of the file, without ``#``.
        compact: whether each point is written on one line.
    """
    lines = [f"# {_on_one_line(line)}".rstrip() for line in remarks]
    lines += [""] if lines else []
    if listen:
        lines += [f"listen = {written(list(listen))}", ""]
    for unit in units:
        lines += _unit_lines(unit, compact)
    return "\n".join(lines).rstrip("\n") + "\n"


def _on_one_line(text: str) -> str:
    """Return a text for a comment: line ends and characters that TOML forbids become spaces."""
    return " ".join("".join(each if each.isprintable() else " " for each in text).split())


def _unit_lines(unit: BaseModel, compact: bool) -> list[str]:
    lines = ["[[unit]]"]
    keys = _decided(unit)
    sections = {key: keys.pop(key) for key in ("point", "file", "fifo") if key in keys}
    if compact and sections.get("point"):
        points = sections.pop("point")
        keys["point"] = points
    for key, value in keys.items():
        lines += _key_lines(key, value)
    lines.append("")
    for name, several in sections.items():
        for each in several:
            lines.append(f"[[unit.{name}]]")
            lines += [f"{key} = {written(value)}" for key, value in each.items()]
            lines.append("")
    return lines


def _key_lines(key: str, value: Any) -> list[str]:
    """Return the TOML lines of a key: one line, or for a list of tables a line for each table, between brackets."""
    if isinstance(value, list) and value and all(isinstance(each, dict) for each in value):
        return [f"{toml_key(str(key))} = [", *(f"    {written(each)}," for each in value), "]"]
    return [f"{toml_key(str(key))} = {written(value)}"]


def _decided(section: BaseModel) -> dict[str, Any]:  # Any: what TOML has
    """Return the keys of a section that were set explicitly, with their values as a file has them."""
    return {
        field.alias or name: _plain(name, getattr(section, name))
        for name, field in type(section).model_fields.items()
        if name in section.model_fields_set
    }


def _plain(key: str, value: Any) -> Any:
    if isinstance(value, BaseModel):
        return _decided(value)
    if isinstance(value, bytes):
        return _bytes(value, running=key == "server_id")
    if isinstance(value, Mapping):
        return {str(each): _plain("", one) for each, one in value.items()}
    if isinstance(value, list | tuple):
        plain = [_plain("", each) for each in value]
        return plain[0] if key == "unit" and len(plain) == 1 else plain
    return value


def _bytes(data: bytes, *, running: bool) -> Any:
    """Return bytes in the form of a file: a text if they are printable UTF-8, else a table with hexadecimal digits.

    Args:
        data: the bytes.
        running: whether the bytes are a server id, whose last byte is the run indicator. A text is returned only if
            that is ``FF``, and without it: reading a text adds it again.
    """
    body = data.removesuffix(_RUNNING) if running else data
    if body != data or not running:
        try:
            text = body.decode("utf-8")
        except UnicodeDecodeError:
            text = "\0"
        if text.isprintable():
            return text
    return {"hex": data.hex(" ")}


def written(value: Any) -> str:
    """Return a Python value as text in TOML syntax, on one line. Raises `TypeError` for types that TOML lacks.

    ``${`` in a text becomes ``$${``, so that a reader does not take it for a parameter. Entries None of a mapping are
    left out.
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else "nan" if math.isnan(value) else f"{value}"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, str):
        # What a file means as a parameter is written twice as dollars, if it only looks like one.
        return toml_string(value.replace("${", "$${"))
    if isinstance(value, Mapping):
        inner = ", ".join(f"{toml_key(str(key))} = {written(each)}" for key, each in value.items() if each is not None)
        return f"{{ {inner} }}" if inner else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(written(each) for each in value)}]"
    raise TypeError(f"TOML has nothing for {type(value).__name__}")

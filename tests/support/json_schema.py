"""A small judge of JSON Schema: as much of draft 2020-12 as our own schemas use, and an error for everything else."""

import math
import re
from collections.abc import Iterator, Mapping
from typing import Any

KNOWN = {
    "$schema",
    "$defs",
    "$ref",
    "title",
    "description",
    "default",
    "type",
    "properties",
    "required",
    "additionalProperties",
    "items",
    "anyOf",
    "oneOf",
    "discriminator",
    "enum",
    "const",
    "minimum",
    "maximum",
    "exclusiveMinimum",
    "minItems",
    "maxItems",
    "minLength",
    "maxLength",
    "pattern",
}
TYPES: dict[str, tuple[type, ...]] = {
    "object": (dict,),
    "array": (list,),
    "string": (str,),
    "integer": (int,),
    "number": (int, float),
    "boolean": (bool,),
    "null": (type(None),),
}


def faults(schema: Mapping[str, Any], data: Any) -> list[str]:
    """What a schema finds wrong with data, as places."""
    return list(_faults(schema, data, schema, "$"))


def _faults(schema: Mapping[str, Any], data: Any, root: Mapping[str, Any], at: str) -> Iterator[str]:
    assert set(schema) <= KNOWN, set(schema) - KNOWN
    if "$ref" in schema:
        yield from _faults(root["$defs"][schema["$ref"].removeprefix("#/$defs/")], data, root, at)
    if "anyOf" in schema and not any(not list(_faults(one, data, root, at)) for one in schema["anyOf"]):
        yield f"{at}: none of the alternatives"
    if "oneOf" in schema and sum(not list(_faults(one, data, root, at)) for one in schema["oneOf"]) != 1:
        yield f"{at}: not exactly one of the alternatives"
    if "enum" in schema and data not in schema["enum"]:
        yield f"{at}: not one of {schema['enum']}"
    if "const" in schema and data != schema["const"]:
        yield f"{at}: not {schema['const']}"
    kind = schema.get("type")
    if kind is not None and (not isinstance(data, TYPES[kind]) or (isinstance(data, bool) and kind != "boolean")):
        yield f"{at}: no {kind}"
        return
    if isinstance(data, dict):
        yield from _object_faults(schema, data, root, at)
    elif isinstance(data, list):
        if not schema.get("minItems", 0) <= len(data) <= schema.get("maxItems", len(data)):
            yield f"{at}: {len(data)} items"
        for index, each in enumerate(data):
            yield from _faults(schema.get("items", {}), each, root, f"{at}[{index}]")
    elif isinstance(data, str):
        if not schema.get("minLength", 0) <= len(data) <= schema.get("maxLength", len(data)):
            yield f"{at}: {len(data)} characters"
        if not re.search(schema.get("pattern", ""), data):
            yield f"{at}: not as the pattern"
    elif isinstance(data, int | float) and not _is_within(schema, data):
        yield f"{at}: {data} is out of range"


def _is_within(schema: Mapping[str, Any], number: float) -> bool:
    return schema.get("minimum", number) <= number <= schema.get("maximum", number) and (
        number > schema.get("exclusiveMinimum", -math.inf)
    )


def _object_faults(schema: Mapping[str, Any], data: dict[str, Any], root: Mapping[str, Any], at: str) -> Iterator[str]:
    properties = schema.get("properties", {})
    for key in schema.get("required", ()):
        if key not in data:
            yield f"{at}: {key} is missing"
    others = schema.get("additionalProperties", True)
    for key, value in data.items():
        if key in properties:
            yield from _faults(properties[key], value, root, f"{at}.{key}")
        elif others is False:
            yield f"{at}.{key}: unknown key"
        elif isinstance(others, dict):
            yield from _faults(others, value, root, f"{at}.{key}")

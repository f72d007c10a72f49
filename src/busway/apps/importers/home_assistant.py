"""Importer for Home Assistant: its ``modbus:`` configuration.

Knows the keys of its sensors, binary sensors and switches. Other entities (climates, covers, fans, lights) combine
several points; they are reported and left out. Addresses count from 0.
"""

from collections.abc import Iterator, Mapping
from typing import Any, Final

from ...codes import MAX_READ_BITS, MAX_READ_REGISTERS
from ...config.files.key_lines import KeyPath
from ...values.unfit_values import shown
from .imported import ImportedDevice, others_of, tables_in
from .plain_yaml import YamlDocument, parse_yaml

_TABLES: Final = {"holding": "holding", "input": "input", "coil": "coil", "discrete_input": "discrete"}
_SWAPS: Final = {None: None, "none": None, "byte": "BADC", "word": "CDAB", "word_byte": "DCBA"}
_OF_HUB: Final = {"name", "type", "host", "port", "sensors", "binary_sensors", "switches"}
_FRAMINGS: Final = {"rtuovertcp": ", RTU over TCP", "udp": ", UDP"}
"""What the connection of a hub says more than its host and port, by its type."""
_USED: Final = {
    "name", "address", "input_type", "data_type", "scale", "offset", "unit_of_measurement", "swap", "count",
    "structure", "slave", "device_address", "nan_value", "scan_interval", "unique_id", "device_class", "state_class",
    "precision", "write_type", "command_on", "command_off", "verify", "virtual_count", "slave_count",
}  # fmt: skip
_META: Final = ("unique_id", "device_class", "state_class", "precision", "scan_interval")


def read_home_assistant(text: str, name: str) -> ImportedDevice:
    """Import the points of a Home Assistant configuration (its ``modbus:`` part).

    Args:
        text: the YAML text, with the key ``modbus`` or only what is below it.
        name: the file's name, for errors.

    Returns:
        The points, by unit; and as ``omissions`` what could not be carried over.

    Raises:
        ConfigError: the text is no YAML, has more than plain data (such as the tag ``!include``), or is too large; or
            PyYAML is not installed.
    """
    document = parse_yaml(text, name)
    data, root = document.data, ()
    found = ImportedDevice()
    place: KeyPath = root
    if isinstance(data, dict) and "modbus" in data:
        for key in others_of(data, {"modbus"}):
            found.omit(f"line {document.line((key,))}", key, "is not Modbus")
        data, place = data["modbus"], ("modbus",)
    for at, hub in enumerate(data if isinstance(data, list) else [data]):
        if isinstance(hub, dict):
            _hub(hub, (*place, at) if isinstance(data, list) else place, document, found)
    return found


def _hub(hub: Mapping[str, Any], place: KeyPath, document: YamlDocument, found: ImportedDevice) -> None:
    connection = _connection(hub)
    if connection:
        found.remarks.append(f"Home Assistant's hub {hub.get('name', '')}: {connection}")
    for key in others_of(hub, _OF_HUB):
        is_list = isinstance(hub[key], list)
        why = "is more than a point: write its registers as points" if is_list else "is an option of the link"
        found.omit(f"line {document.line((*place, key))}", key, why)
    for key, make in (("sensors", _sensor), ("binary_sensors", _binary_sensor), ("switches", _switch)):
        for at, entity in tables_in(hub.get(key)):
            here = (*place, key, at)
            where = f"line {document.line(here)}"
            name = str(entity.get("name", f"{key}_{at + 1}"))
            for other in others_of(entity, _USED):
                found.omit(f"line {document.line((*here, other))}", f"{name}.{other}", "is Home Assistant's own")
            if not isinstance(entity.get("address"), int):
                found.omit(where, name, f"has no address: {shown(entity.get('address'))}")
                continue
            keys: dict[str, Any] = {"name": name, "unit_of_measure": entity.get("unit_of_measurement")}
            keys["meta"] = {each: entity[each] for each in _META if entity.get(each) is not None} or None
            with found.reporting(where, name):
                for made in make(entity, keys, where, found):
                    found.add(_unit(entity), made, where, connection=connection)


def _connection(hub: Mapping[str, Any]) -> str:
    """Return how a hub reaches its devices: host and port, or the path of a serial port; empty if it says neither."""
    if "host" in hub:
        return f"{hub['host']}:{hub.get('port', 502)}{_FRAMINGS.get(str(hub.get('type')), '')}"
    return str(hub.get("port", ""))


def _sensor(
    entity: Mapping[str, Any], keys: dict[str, Any], where: str, found: ImportedDevice
) -> Iterator[dict[str, Any]]:
    table = _TABLES.get(str(entity.get("input_type", "holding")), "")
    kind, count = str(entity.get("data_type", "int16")), entity.get("count", 1)
    if kind == "string":
        kind = f"string:{2 * int(count)}"
    elif kind == "custom":
        structure = str(entity.get("structure", ""))
        kind = f"custom:{structure if structure[:1] in '<>' else '>' + structure}"
    swap = entity.get("swap")
    if swap not in _SWAPS:
        found.omit(where, f"{keys['name']}.swap", f"is no swap that there is: {shown(swap)}")
    numbers = not kind.startswith(("string", "custom"))
    scale, offset = entity.get("scale", 1), entity.get("offset", 0)
    if not numbers and (scale != 1 or offset):
        found.omit(where, f"{keys['name']}.scale", f"{kind} is no number")
    keys |= {"type": kind, "order": _SWAPS.get(swap)}
    if numbers:
        keys |= {"scale": None if scale == 1 else float(scale), "offset": None if not offset else float(offset)}
        keys["invalid"] = None if entity.get("nan_value") is None else [_number(entity["nan_value"])]
    size = {"16": 1, "32": 2, "64": 4}.get(kind[-2:], 0) if numbers else 0
    several = _several(entity, MAX_READ_REGISTERS // (size or 1))
    if several and not size:
        found.omit(where, f"{keys['name']}.virtual_count", "is not carried over for this type")
        several = 0
    for place in range(several + 1):
        name = keys["name"] if not place else f"{keys['name']}_{place}"
        yield {**keys, "name": name, "address": f"{table}:{entity['address'] + place * size}"}


def _binary_sensor(
    entity: Mapping[str, Any], keys: dict[str, Any], where: str, found: ImportedDevice
) -> Iterator[dict[str, Any]]:
    """Yield the points of a binary sensor: coils, or the lowest bits of registers that follow each other."""
    table = _TABLES.get(str(entity.get("input_type", "coil")), "")
    is_bit = table in ("holding", "input")
    for place in range(_several(entity, MAX_READ_REGISTERS if is_bit else MAX_READ_BITS) + 1):
        name = keys["name"] if not place else f"{keys['name']}_{place}"
        address = f"{table}:{entity['address'] + place}{'.0' if is_bit else ''}"
        yield {**keys, "name": name, "address": address, "unit_of_measure": None}


def _switch(
    entity: Mapping[str, Any], keys: dict[str, Any], where: str, found: ImportedDevice
) -> Iterator[dict[str, Any]]:
    table = _TABLES.get(str(entity.get("write_type", "holding")), "")
    address = f"{table}:{entity['address']}"
    write: dict[str, Any] = {}
    verify = entity.get("verify", False)
    if isinstance(verify, dict) or verify is None:
        place = dict(verify or {})
        own = _TABLES.get(str(place.get("input_type", entity.get("write_type", "holding"))), table)
        at = place.get("address", entity["address"])
        write["verify"] = "read-back" if (own, at) == (table, entity["address"]) else f"{own}:{at}"
        for key in others_of(place, {"input_type", "address"}):
            found.omit(where, f"{keys['name']}.verify.{key}", "what is read back is the value itself")
    if table == "holding":
        write |= {"on": int(entity.get("command_on", 1)), "off": int(entity.get("command_off", 0))}
    yield {**keys, "address": address, "write": write or None}


def _several(entity: Mapping[str, Any], most: int) -> int:
    """Return how many items are read beside the first one of an entity; all come by one request in Home Assistant.

    Args:
        entity: the entity.
        most: number of such items that one request can read.

    Raises:
        ValueError: the number is no integer, is negative, or one request cannot read as many; the message has the key.
    """
    key = "virtual_count" if "virtual_count" in entity else "slave_count"
    number = 0 if entity.get(key) is None else entity[key]
    if not isinstance(number, int) or not 0 <= number < most:
        raise ValueError(f"{key} is 0…{most - 1}, not {shown(number)}")
    return number


def _unit(entity: Mapping[str, Any]) -> int:
    """Return the unit number of an entity, 1 if it names none. Raises `ValueError` if it is no number."""
    unit = entity.get("slave", entity.get("device_address"))
    return 1 if unit is None else int(unit)


def _number(value: Any) -> Any:
    return int(value, 16) if isinstance(value, str) else value

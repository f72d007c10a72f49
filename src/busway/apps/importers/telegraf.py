"""Importer for Telegraf: its ``[[inputs.modbus]]`` in three styles (register, request, metric).

Knows Telegraf's keys and types. Addresses of Telegraf count from 0.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from ...config.files.toml_source import Source, read_source
from ...values.counts import counted
from ...values.unfit_values import shown
from .imported import ImportedDevice, others_of, tables_in

_TABLES: Final = {
    "coil": "coil", "discrete": "discrete", "holding": "holding", "input": "input",
    "coils": "coil", "discrete_inputs": "discrete", "holding_registers": "holding", "input_registers": "input",
}  # fmt: skip
_TYPES: Final = {
    "INT8L": "int8:low", "INT8H": "int8:high", "UINT8L": "uint8:low", "UINT8H": "uint8:high",
    "FLOAT16-IEEE": "float16", "FLOAT32-IEEE": "float32", "FLOAT64-IEEE": "float64",
    "FLOAT16": "float16", "FLOAT64": "float64",
    **{name.upper(): name for name in ("int16", "uint16", "int32", "uint32", "int64", "uint64")},
}  # fmt: skip
_REGISTERS: Final = {kind: 4 if "64" in kind else 2 if "32" in kind else 1 for kind in _TYPES}
"""Number of registers of each type that has a size of its own."""
_SCALED: Final = {"FIXED": "int", "UFIXED": "uint", "FLOAT32": "uint"}
"""Types of the register style that have no size of their own, each with the beginning of its value type.

The size follows from the number of addresses, 16 bits for each: FIXED with two addresses is ``int32``.
FLOAT32 is an old name of UFIXED (an integer) in this style. In the other styles it is a float of IEEE 754.
"""
_KNOWN: Final = {
    "name", "slave_id", "controller", "configuration_type", "coils", "discrete_inputs", "holding_registers",
    "input_registers", "request", "metric",
}  # fmt: skip
_FIELD_KEYS: Final = {
    "name", "address", "type", "data_type", "byte_order", "scale", "bit", "length", "register", "omit", "measurement",
    "output",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Section:
    """What the fields of one section have in common; a field may say otherwise for itself.

    Attributes:
        connection: the controller of the plugin.
        unit: the unit number.
        table: the table; empty if the section names one that there is not.
        order: the order of bytes; empty if the section names none.
        measurement: the name of the measurement; empty if the section has none.
    """

    connection: str
    unit: Any  # what the file has
    table: str
    order: str = ""
    measurement: str = ""


def read_telegraf(text: str, name: str) -> ImportedDevice:
    """Import the points of a Telegraf configuration (``[[inputs.modbus]]``).

    Args:
        text: the TOML text.
        name: the file's name, for errors.

    Returns:
        The points, by unit; and as ``omissions`` what could not be carried over.

    Raises:
        FileError: the text is no TOML.
    """
    source = read_source(text, name)
    found = ImportedDevice()
    inputs = source.data.get("inputs")
    plugins = inputs.get("modbus", []) if isinstance(inputs, dict) else []
    for index, plugin in enumerate(plugins if isinstance(plugins, list) else []):
        if isinstance(plugin, dict):
            _plugin(plugin, ("inputs", "modbus", index), source, found)
    return found


def _plugin(plugin: Mapping[str, Any], path: tuple[Any, ...], source: Source, found: ImportedDevice) -> None:
    connection = str(plugin.get("controller", ""))
    if connection:
        of = f" of {plugin['name']}" if plugin.get("name") else ""
        found.remarks.append(f"Telegraf's controller{of}: {connection}")
    for key in others_of(plugin, _KNOWN):
        found.omit(_line(source, (*path, key)), key, "an option of Telegraf's connection, not of the device")
    unit = plugin.get("slave_id", 1)
    for key in ("coils", "discrete_inputs", "holding_registers", "input_registers"):
        for at, field in tables_in(plugin.get(key)):
            _field(field, _Section(connection, unit, _TABLES[key]), (*path, key, at), source, found)
    for style in ("request", "metric"):
        for at, section in tables_in(plugin.get(style)):
            for key in others_of(section, {"slave_id", "byte_order", "register", "measurement", "fields"}):
                found.omit(_line(source, (*path, style, at, key)), key, "is Telegraf's own")
            common = _Section(
                connection,
                section.get("slave_id", unit),
                _TABLES.get(str(section.get("register", "holding")), ""),
                str(section.get("byte_order", "")),
                str(section.get("measurement", "")),
            )
            for place, field in tables_in(section.get("fields")):
                _field(field, common, (*path, style, at, "fields", place), source, found)


def _field(
    field: Mapping[str, Any], section: _Section, path: tuple[Any, ...], source: Source, found: ImportedDevice
) -> None:
    where, name = _line(source, path), str(field.get("name", ""))
    with found.reporting(where, name or "a field"):
        _known_field(field, section, where, name, found)


def _known_field(field: Mapping[str, Any], section: _Section, where: str, name: str, found: ImportedDevice) -> None:
    table = _TABLES.get(str(field["register"]), "") if "register" in field else section.table
    if field.get("omit"):
        found.omit(where, name or "a field", "is omitted by Telegraf too: only registers between others")
        return
    for key in others_of(field, _FIELD_KEYS):
        found.omit(where, f"{name}.{key}", "is Telegraf's own")
    addresses = field.get("address")
    first = addresses[0] if isinstance(addresses, list) and addresses else addresses
    if not isinstance(first, int) or not table:
        found.omit(where, name or "a field", f"has no address or register that is known: {shown(dict(field))}")
        return
    keys: dict[str, Any] = {"name": name or f"{table}_{first}", "address": f"{table}:{first}"}
    if table in ("holding", "input"):
        kind = str(field.get("data_type", field.get("type", "UINT16")))
        registers = len(addresses) if isinstance(addresses, list) else 0
        form = _type(kind, registers, field.get("length"))
        if registers and addresses != list(range(first, first + registers)):
            found.omit(where, name, f"has addresses that do not follow each other: {shown(addresses)}")
            return
        if registers and _REGISTERS.get(kind, registers) != registers:
            found.omit(where, name, f"is of {counted(_REGISTERS[kind], 'register')} as {kind}: {shown(addresses)}")
            return
        if kind == "BIT" or "bit" in field:
            keys["address"] += f".{field.get('bit', 0)}"
        elif form is None:
            found.omit(where, name, f"has a type that there is not: {shown(kind)}")
            return
        else:
            keys |= {"type": form, "order": str(field.get("byte_order", section.order)) or None}
            if field.get("scale", 1.0) != 1.0:
                keys["scale"] = float(field["scale"])
    if field.get("output"):
        found.omit(where, f"{name}.output", "the type in the database is chosen by the sink")
    measurement = field.get("measurement", section.measurement)
    if measurement:
        keys["meta"] = {"measurement": measurement}
    found.add(int(section.unit), keys, where, connection=section.connection)


def _type(kind: str, registers: int, length: object) -> str | None:
    if kind in _TYPES:
        return _TYPES[kind]
    if kind in _SCALED and registers in (1, 2, 4):
        return f"{_SCALED[kind]}{16 * registers}"
    if kind == "FLOAT32" and not registers:
        return "float32"
    if kind == "STRING":
        return f"string:{2 * (length if isinstance(length, int) else max(registers, 1))}"
    return None


def _line(source: Source, path: tuple[Any, ...]) -> str:
    return f"line {source.problem(path, '').line}"

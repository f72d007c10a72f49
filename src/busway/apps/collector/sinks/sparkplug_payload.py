"""Payloads of Sparkplug B 3.0: metrics with type, time and quality, as protobuf bytes.

Knows names, field numbers and types of the payload (Sparkplug 3.0 §6.4); knows no topic and no broker. The encoding is
protobuf's (``busway[sparkplug]``).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from importlib import import_module
from typing import Any, Final

from ....extras import require
from ..samples import NANOSECONDS, SampleValue

_MILLISECOND: Final = NANOSECONDS // 1000
_OPTIONAL, _REPEATED = 1, 3
_UINT32, _UINT64, _FLOAT, _DOUBLE, _BOOL, _STRING, _BYTES, _MESSAGE = 13, 4, 2, 1, 8, 9, 12, 11  # of descriptor.proto
_VALUES: Final = {
    "int_value": _UINT32,
    "long_value": _UINT64,
    "float_value": _FLOAT,
    "double_value": _DOUBLE,
    "boolean_value": _BOOL,
    "string_value": _STRING,
}


class DataType(IntEnum):
    """Numbers of the Sparkplug data types of metrics in data and commands (Sparkplug 3.0 §6.4).

    Metrics of samples have only those that `type_of` returns.
    """

    INT8 = 1
    INT16 = 2
    INT32 = 3
    INT64 = 4
    UINT8 = 5
    UINT16 = 6
    UINT32 = 7
    UINT64 = 8
    FLOAT = 9
    DOUBLE = 10
    BOOLEAN = 11
    STRING = 12


class SparkplugQuality(IntEnum):
    """Values of the Sparkplug property ``Quality`` of a metric."""

    BAD = 0
    GOOD = 192
    STALE = 500


@dataclass(frozen=True, slots=True)
class Metric:
    """One metric of a Sparkplug payload: name, type, value, time and quality.

    Attributes:
        name: the name of the metric.
        time: nanoseconds since 1970 UTC; it is sent in milliseconds.
        kind: its type.
        value: the value; None if it has none.
        is_historical: whether the value is from before the connection, so that hosts do not show it as current.
        properties: pairs of a name and its text or quality, such as ``engUnit`` or ``Quality``.
    """

    name: str
    time: int
    kind: DataType
    value: SampleValue | None
    is_historical: bool = False
    properties: tuple[tuple[str, str | SparkplugQuality], ...] = ()


def type_of(value: SampleValue) -> DataType:
    """Return the Sparkplug type of a metric with this value: BOOLEAN, INT64, UINT64, DOUBLE or STRING."""
    if isinstance(value, bool):
        return DataType.BOOLEAN
    if isinstance(value, int):
        return DataType.INT64 if value < 2**63 else DataType.UINT64
    return DataType.DOUBLE if isinstance(value, float) else DataType.STRING


def encode_payload(metrics: Iterable[Metric], time: int, sequence: int | None) -> bytes:
    """Return a Sparkplug payload as bytes.

    Args:
        metrics: its metrics, in order.
        time: nanoseconds since 1970 UTC at which it is sent.
        sequence: number of the message, 0…255; None for a death of an edge node, which has none.

    Raises:
        MissingExtra: protobuf is not installed.
    """
    payload = _messages()["Payload"]()
    payload.timestamp = time // _MILLISECOND
    if sequence is not None:
        payload.seq = sequence
    for metric in metrics:
        _fill(payload.metrics.add(), metric)
    content: bytes = payload.SerializeToString()
    return content


@dataclass(frozen=True, slots=True)
class CommandPayload:
    """The payload of a command that a host application sends to an edge node or a device: values for metrics.

    Attributes:
        time: when it was sent, milliseconds since 1970 UTC by the host's clock; None if the payload has no time.
        values: pairs of name and value of each metric, in order. The value is None if the metric has none, or one of a
            type that samples cannot have.
    """

    time: int | None
    values: tuple[tuple[str, SampleValue | None], ...]


def decode_command(content: bytes, kinds: Mapping[str, DataType] | None = None) -> CommandPayload:
    """Decode the payload of a command from a host: the values that it sets, by metric.

    Args:
        content: the payload.
        kinds: types of metrics by name, as their birth announced them, for metrics whose type the command leaves out.

    Raises:
        ValueError: the bytes are no Sparkplug payload.
    """
    payload = _messages()["Payload"]()
    try:
        payload.ParseFromString(content)
    except import_module("google.protobuf.message").DecodeError as error:
        raise ValueError(str(error)) from error
    known = kinds or {}
    values = tuple((metric.name, _value_in(metric, known.get(metric.name))) for metric in payload.metrics)
    return CommandPayload(payload.timestamp or None, values)


def _value_in(metric: Any, born: DataType | None) -> SampleValue | None:  # a message of protobuf
    which = metric.WhichOneof("value")
    if which is None or metric.is_null:
        return None
    value: SampleValue = getattr(metric, which)
    kind = metric.datatype or (int(born) if born is not None else 0)
    if which == "int_value" and kind in (DataType.INT8, DataType.INT16, DataType.INT32):
        return _signed(int(value), 32)
    return _signed(int(value), 64) if which == "long_value" and kind == DataType.INT64 else value


def _signed(value: int, bits: int) -> int:
    """Convert an unsigned number of ``bits`` bits that is two's complement to the signed integer that it stands for."""
    return value - (1 << bits) if value >= 1 << (bits - 1) else value


def _fill(message: Any, metric: Metric) -> None:
    message.name = metric.name
    message.timestamp = metric.time // _MILLISECOND
    message.datatype = int(metric.kind)
    if metric.is_historical:
        message.is_historical = True
    if metric.value is None:
        message.is_null = True
    elif metric.kind in (DataType.INT64, DataType.UINT64):
        message.long_value = int(metric.value) % 2**64  # negative numbers as two's complement
    elif metric.kind is DataType.BOOLEAN:
        message.boolean_value = bool(metric.value)
    elif metric.kind is DataType.DOUBLE:
        message.double_value = float(metric.value)
    else:
        message.string_value = str(metric.value)
    for name, content in metric.properties:
        message.properties.keys.append(name)
        one = message.properties.values.add()
        if isinstance(content, SparkplugQuality):
            one.type, one.int_value = int(DataType.INT32), int(content)
        else:
            one.type, one.string_value = int(DataType.STRING), content


@cache
def _messages() -> dict[str, Any]:
    """Return the protobuf classes of Sparkplug messages, by name. Raises `MissingExtra`."""
    require("google.protobuf", "a sink for Sparkplug")
    file = import_module("google.protobuf.descriptor_pb2").FileDescriptorProto()
    file.name, file.package, file.syntax = "busway_sparkplug.proto", "busway.sparkplug", "proto2"
    for message, fields in _FIELDS.items():
        described = file.message_type.add()
        described.name = message
        if message != "PropertySet" and "int_value" in fields:
            described.oneof_decl.add().name = "value"
        for name, (number, kind, label, refers) in fields.items():
            field = described.field.add()
            field.name, field.number, field.type, field.label = name, number, kind, label
            if refers:
                field.type_name = f".busway.sparkplug.{refers}"
            if name in _VALUES:
                field.oneof_index = 0
    pool = import_module("google.protobuf.descriptor_pool").DescriptorPool()
    pool.Add(file)
    classes = import_module("google.protobuf.message_factory")
    return {name: classes.GetMessageClass(pool.FindMessageTypeByName(f"busway.sparkplug.{name}")) for name in _FIELDS}


_Field = tuple[int, int, int, str]
"""A field of a protobuf message: number, type, label, and name of the message that it contains, empty for none."""


def _values(first: int) -> dict[str, _Field]:
    return {name: (number, kind, _OPTIONAL, "") for number, (name, kind) in enumerate(_VALUES.items(), first)}


_FIELDS: Final[dict[str, dict[str, _Field]]] = {
    "Payload": {
        "timestamp": (1, _UINT64, _OPTIONAL, ""),
        "metrics": (2, _MESSAGE, _REPEATED, "Metric"),
        "seq": (3, _UINT64, _OPTIONAL, ""),
    },
    "Metric": {
        "name": (1, _STRING, _OPTIONAL, ""),
        "timestamp": (3, _UINT64, _OPTIONAL, ""),
        "datatype": (4, _UINT32, _OPTIONAL, ""),
        "is_historical": (5, _BOOL, _OPTIONAL, ""),
        "is_null": (7, _BOOL, _OPTIONAL, ""),
        "properties": (9, _MESSAGE, _OPTIONAL, "PropertySet"),
        **_values(10),
    },
    "PropertySet": {
        "keys": (1, _STRING, _REPEATED, ""),
        "values": (2, _MESSAGE, _REPEATED, "PropertyValue"),
    },
    "PropertyValue": {
        "type": (1, _UINT32, _OPTIONAL, ""),
        "is_null": (2, _BOOL, _OPTIONAL, ""),
        **_values(3),
    },
}

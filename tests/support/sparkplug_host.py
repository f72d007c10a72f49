"""A host application of Sparkplug B 3.0 as a model: it holds one edge node to the rules, and keeps what it is told.

Written from the standard and from `docs/how-to/send-samples-on.md`, not from the sink.
"""

from dataclasses import dataclass, field

from busway.apps.collector.samples import SampleValue
from busway.apps.collector.sinks.sparkplug_payload import DataType, _messages

WORDS = {DataType.INT64: "long_value", DataType.UINT64: "long_value", DataType.DOUBLE: "double_value"}
WORDS |= {DataType.BOOLEAN: "boolean_value", DataType.STRING: "string_value"}


@dataclass(frozen=True)
class Told:
    """A metric of a message: quality 192 where nothing is said of it."""

    name: str
    kind: int
    time: int
    value: SampleValue | None
    quality: int
    reason: str
    unit: str
    is_historical: bool


@dataclass
class SparkplugHost:
    """What one edge node has told.

    Attributes:
        current: what the metrics of each device are now, by its births and by data that are not historical.
        data: each value that came as data, with the device and the number of the connection.
        events: values of alarm events, likewise.
        may_speak: whether the primary host is online.
        sessions, began: bdSeq of each connection that was born, and when, in milliseconds.
        births: of the node, those within a connection too.
    """

    node: str = "hall"
    is_online: bool = False
    may_speak: bool = True
    current: dict[str, dict[str, Told]] = field(default_factory=dict)
    data: list[tuple[int, str, Told]] = field(default_factory=list)
    events: list[tuple[int, Told]] = field(default_factory=list)
    sessions: list[int] = field(default_factory=list)
    began: list[int] = field(default_factory=list)
    births: int = 0
    _next: int = 0
    _node_metrics: dict[str, int] = field(default_factory=dict)

    def take(self, topic: str, content: bytes) -> None:
        if not topic.startswith("spBv1.0/"):
            return
        _, group, kind, node, *device = topic.split("/")
        assert (group, node) == ("plant", self.node)
        payload = _messages()["Payload"].FromString(content)
        metrics = [_told(each) for each in payload.metrics]
        assert len({each.name for each in metrics}) == len(metrics) or kind == "DDATA"
        if kind == "NDEATH":
            assert not payload.HasField("seq")
            assert [each.name for each in metrics] == ["bdSeq"]
            if self.is_online:  # else of a connection that was lost before its birth
                assert metrics[0].value == self.sessions[-1]
            self.is_online = False
            self.current.clear()
            return
        assert self.may_speak, f"{kind} while the primary host is offline"
        if kind == "NBIRTH":
            self._born(payload, {each.name: each for each in metrics})
            return
        assert self.is_online, f"{kind} before the birth of the node"
        assert payload.seq == self._next, f"{kind} has {payload.seq}, not {self._next}"
        self._next = (self._next + 1) % 256
        if kind == "NDATA":
            for each in metrics:
                assert self._node_metrics[each.name] == each.kind
                self.events.append((self.connection, each))
            return
        name = device[0]
        if kind == "DBIRTH":
            assert not [each for each in metrics if each.is_historical]
            self.current[name] = {each.name: each for each in metrics}
            return
        assert name in self.current, f"{kind} of {name}, which is not born"
        if kind == "DDEATH":
            del self.current[name]
            return
        assert kind == "DDATA"
        for each in metrics:
            known = self.current[name].get(each.name)
            assert known is not None, f"data of {name}/{each.name}, which no birth has"
            assert known.kind == each.kind, f"data of {name}/{each.name} have another type than its birth"
            self.data.append((self.connection, name, each))
            if not each.is_historical:
                self.current[name][each.name] = each

    @property
    def connection(self) -> int:
        return len(self.sessions)

    def _born(self, payload: object, metrics: dict[str, Told]) -> None:
        assert payload.seq == 0  # type: ignore[attr-defined]
        self._next = 1
        number = metrics["bdSeq"].value
        assert isinstance(number, int)
        assert metrics["Node Control/Rebirth"].value is False
        assert not [each for each in metrics.values() if each.is_historical]
        if self.is_online:
            assert number == self.sessions[-1], "born again within a connection"
        else:
            self.sessions.append(number)
            self.began.append(metrics["bdSeq"].time)
        self.is_online = True
        self.births += 1
        self._node_metrics = {name: each.kind for name, each in metrics.items()}
        self.current.clear()


def _told(metric: object) -> Told:
    said: object = metric
    properties = dict(zip(said.properties.keys, said.properties.values, strict=True))  # type: ignore[attr-defined]
    which = said.WhichOneof("value")  # type: ignore[attr-defined]
    kind = DataType(said.datatype)  # type: ignore[attr-defined]
    assert (which is None) is said.is_null  # type: ignore[attr-defined]
    value: SampleValue | None = None
    if which is not None:
        assert which == WORDS[kind]
        value = getattr(said, which)
        if kind is DataType.INT64 and isinstance(value, int) and value >= 2**63:
            value -= 2**64
    quality = properties["Quality"].int_value if "Quality" in properties else 192
    reason = properties["reason"].string_value if "reason" in properties else ""
    unit = properties["engUnit"].string_value if "engUnit" in properties else ""
    name, time, old = said.name, said.timestamp, said.is_historical  # type: ignore[attr-defined]
    return Told(name, kind, time, value, quality, reason, unit, old)

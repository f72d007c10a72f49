"""``commands`` of a table ``[[sink]]`` → what receives commands from the same server.

Knows the keys; connects to nothing.

1. Off unless the table has ``commands``. It names the points that may be written, and where their commands come from.
2. Commands come on topics of their own: one on which samples are sent, or answers, is refused.
"""

from collections.abc import Mapping
from typing import Any
from urllib.parse import SplitResult, unquote, urlsplit

from ..sinks.options import SinkTable, host_of
from .command import LONGEST_SECONDS
from .inputs import CommandInput, InputRights, overlap


def make_input(name: str, values: Mapping[str, Any], commands: Any) -> CommandInput:  # what TOML has
    """Create the receiver of commands that the table of a sink asks for.

    Args:
        name: of the sink.
        values: its other keys, ``url`` with them; they were checked.
        commands: the table.

    Raises:
        ConfigError: a key or value cannot be; names it.
        MissingExtra: a package that it needs is not installed.
    """
    table = SinkTable(name, values)
    parts = urlsplit(str(values["url"]))
    if parts.scheme in ("mqtt", "mqtts"):
        return _mqtt(parts, table, _rights(table, commands, "topic", "/", _mqtt_topic(table)))
    if parts.scheme in ("nats", "tls"):
        return _nats(
            parts, table, _rights(table, commands, "subject", ".", table.get("subject", str, "busway.{device}"))
        )
    raise table.refuse("commands", f"come by MQTT or NATS, not by {parts.scheme}")


def _mqtt_topic(table: SinkTable) -> str:
    topic = str(table.get("topic", str, "busway/{device}"))
    per_point = table.get("per_point", bool, False)
    return f"{topic}/{{point}}" if per_point and "{point}" not in topic else topic


def _rights(table: SinkTable, commands: Any, where: str, separator: str, samples: str) -> InputRights:
    if not isinstance(commands, dict):
        raise table.refuse("commands", f'a table is needed: {{ points = ["meter-7/setpoint"], {where} = "…" }}')
    for key in commands:
        if key not in ("points", where, "seconds"):
            raise table.refuse("commands", f"unknown key {key}; there are points, {where} and seconds")
    points = commands.get("points")
    if not isinstance(points, list) or not points or not all(isinstance(each, str) and "/" in each for each in points):
        raise table.refuse("commands", 'points names what may be written: ["meter-7/setpoint", "pump-*/speed"]')
    usual = separator.join(("busway", "{device}", "{point}", "set"))
    template = commands.get(where, usual)
    levels = template.split(separator) if isinstance(template, str) else []
    plain = [each for each in levels if each not in ("{device}", "{point}")]
    if sorted(set(levels) - set(plain)) != ["{device}", "{point}"] or len(levels) != len(plain) + 2:
        raise table.refuse("commands", f"{where} has {{device}} and {{point}}, each once and as a level of its own")
    if not all(plain) or any(set(each) & set("{}+#*> \x00") for each in plain):
        raise table.refuse("commands", f"{where} has no wildcards, braces or empty levels, not {template!r}")
    if overlap(template, samples, separator):
        raise table.refuse("commands", f"{where} is one on which samples are sent: {samples}")
    seconds = commands.get("seconds", 10.0)
    if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not 0 < seconds <= LONGEST_SECONDS:
        raise table.refuse("commands", f"seconds are above 0 and at most {LONGEST_SECONDS:g}, not {seconds!r}")
    return InputRights(template, tuple(points), float(seconds))


def _mqtt(parts: SplitResult, table: SinkTable, rights: InputRights) -> CommandInput:
    from .mqtt import MqttCommands

    encrypts = parts.scheme == "mqtts"
    client_id = table.get("client_id", str)
    return MqttCommands(
        host_of(parts, table),
        parts.port or (8883 if encrypts else 1883),
        rights,
        user=None if parts.username is None else unquote(parts.username),
        password=table.secret("password"),
        tls=table.tls(encrypts),
        client_id=None if client_id is None else f"{client_id}-commands",
    )


def _nats(parts: SplitResult, table: SinkTable, rights: InputRights) -> CommandInput:
    from .nats import NatsCommands

    return NatsCommands(
        parts._replace(netloc=f"{host_of(parts, table)}:{parts.port or 4222}").geturl(),
        rights,
        user=None if parts.username is None else unquote(parts.username),
        password=table.secret("password"),
        token=table.secret("token"),
        tls=table.tls(parts.scheme == "tls"),
    )

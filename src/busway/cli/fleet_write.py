"""``busway fleet write``: writes a value to a point of a zone, by asking the collector that owns the device's link.

1. The zone's configuration tells on which link a device is; the collector makes all checks.
2. A write has a key, that of ``--key`` or a new one, and is sent to the device at most once for each key. If no answer
   came, the same command can be repeated with the same key.
3. The exit code says how the write ended: 0 done, 2 refused (nothing was sent), 3 unknown or too late, 4 failed, 5 no
   collector owns the link, 7 the device holds another value.
"""

import getpass
import json
import secrets
import time
import tomllib
from typing import TYPE_CHECKING, Any, Final

from ..errors import ConfigError, WriteOutcomeUnknown
from .exits import ExitCode
from .output import print_json, say, shown_value, warn

if TYPE_CHECKING:
    from ..apps.fleet.coordinator import Coordinator

MORE_SECONDS: Final = 30.0
"""Seconds to wait for the answer after the time of a command is over: the value may still be read back and recorded."""
_CODES: Final = {
    "done": ExitCode.DONE,
    "refused": ExitCode.WRONG_USE,
    "unknown": ExitCode.NO_REPLY,
    "expired": ExitCode.NO_REPLY,
    "failed": ExitCode.REFUSED,
}
_STATES: Final = {"on": True, "off": False}


async def write_point(
    table: "Coordinator",
    zone: str,
    words: list[str],
    *,
    key: str | None,
    by: str | None,
    seconds: float,
    as_json: bool,
) -> int:
    """Ask the collector that owns a link to write a value to a point, print the outcome, and return the exit code.

    Args:
        table: the coordinator of the zone.
        zone: name of the zone.
        words: three texts: name of the device, name of the point, and value (see `value_of`).
        key: identifies the write, which is sent to the device at most once for each key; None for a new key.
        by: name of who writes; None for the account of this process.
        seconds: time within which the write must be sent to the device; later it is not sent.
        as_json: whether to print the answer as JSON.

    Raises:
        ConfigError: the coordinator is not NATS, or the zone has no configuration or no such device; nothing was sent.
        LinkDown: no collector owns the link; nothing was sent.
        WriteOutcomeUnknown: no answer came; the write may have been sent.
    """
    from ..apps.fleet.control_entries import read_configuration
    from ..apps.fleet.fleet_commands import send_command

    client = getattr(table, "client", None)
    if client is None:
        raise ConfigError(
            "commands go over NATS (nats://host:4222); with another coordinator write by the page or the HTTP API of "
            "the collector that owns the link",
            key="--coordinator",
        )
    shared = await read_configuration(table)
    if shared is None:
        raise ConfigError("the zone has no configuration yet: busway fleet apply FILE", key="--zone")
    device, point, text = words
    link = link_of(shared.text, device)
    key = key or f"write-{secrets.token_hex(12)}"
    content = {"key": key, "device": device, "point": point, "value": value_of(text)}
    content |= {"by": by or getpass.getuser(), "expires": time.time() + seconds}
    say(f"key {key}")
    try:
        answer = await send_command(client, zone, link, content, seconds + MORE_SECONDS)
    except WriteOutcomeUnknown as error:
        raise WriteOutcomeUnknown(f"{error.message}; ask again with --key {key}") from error
    return print_answer({**content, **answer}, as_json=as_json)


def link_of(text: str, device: str) -> str:
    """Return the name of the link of a device.

    Args:
        text: contents of a collector file.
        device: name of the device.

    Raises:
        ConfigError: the file has no such device.
    """
    links = {each["name"]: each["link"] for each in tomllib.loads(text).get("device", ())}
    if device not in links:
        there = ", ".join(sorted(links)[:10]) + (", …" if len(links) > 10 else "")
        raise ConfigError(f"the zone has no device {device}; there are {there or 'none'}", key="DEVICE")
    return str(links[device])


def value_of(text: str) -> Any:  # JSON
    """Return the value of an argument: True for ``on``, False for ``off``, the value of JSON, or else the text."""
    if text in _STATES:
        return _STATES[text]
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


def print_answer(answer: dict[str, Any], *, as_json: bool) -> int:
    """Print a collector's answer to a write, and return the exit code: see rule 3 of this module.

    The answer has at least ``device``, ``point``, ``value`` and ``state``, perhaps ``reason`` and ``read_back``.
    """
    state = answer["state"]
    holds_another = state == "failed" and answer.get("read_back") is not None
    if as_json:
        print_json(answer)
    else:
        print(f"{answer['device']}/{answer['point']}  {shown_value(answer['value'])}  {state}", flush=True)
    if answer.get("reason"):
        warn(f"{answer['device']}/{answer['point']}: {shown_value(answer['reason'])}")
    return ExitCode.NOT_VERIFIED if holds_another else _CODES[state]

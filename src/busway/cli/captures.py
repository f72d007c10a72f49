"""What commands that read capture files share: options, opening the file, and warnings about packets without Modbus.

Knows paths and texts; `busway.observe.capture_files` knows the contents of captures.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

import typer

from ..errors import ConfigError
from ..safe_files import open_to_read
from ..values.counts import counted
from .arguments import whole_number
from .output import warn

if TYPE_CHECKING:
    from ..observe.capture_files.frame_extraction import CapturedTraffic
    from ..observe.capture_files.packet_file import PacketFile

PORT = typer.Option(None, "--port", metavar="LIST", help="Of a capture: ports of Modbus servers: 502,5020. 502.")
STDIN: Final = "-"
_NAMES: Final = (".pcap", ".pcapng", ".cap", ".ntar")
_FRAMINGS: Final = ("mbap", "rtu", "ascii")


def names_capture(text: str) -> bool:
    """Whether an argument names a capture file, by its suffix or the first bytes of the file.

    The suffixes are ``.pcap``, ``.pcapng``, ``.cap`` and ``.ntar``; with one of them the file need not exist.
    """
    from ..observe.capture_files.packet_file import is_capture_file

    if text.lower().endswith(_NAMES):
        return True
    if not os.path.isfile(text):
        return False
    try:
        with os.fdopen(open_to_read(text), "rb") as file:
            return is_capture_file(file.read(4))
    except (ConfigError, OSError):
        return False


@contextmanager
def open_packets(name: str) -> Iterator["PacketFile"]:
    """Context manager that opens a capture file and yields an iterator over its packets.

    ``-`` is standard input. The iterator raises `ConfigError` where the file is broken.

    Raises:
        ConfigError: the file cannot be opened; the error names the file.
    """
    from ..observe.capture_files.packet_file import PacketFile

    if name == STDIN:
        yield PacketFile(sys.stdin.buffer, "standard input")
        return
    with os.fdopen(open_to_read(name), "rb") as file:
        yield PacketFile(file, name)


def traffic_of(ports: str | None, framing: str | None) -> "CapturedTraffic":
    """Return the object that finds the Modbus frames in the packets of a capture.

    Args:
        ports: text of ``--port``, such as ``502,5020``; None for 502.
        framing: text of ``--framing``: ``mbap``, ``rtu`` or ``ascii``; None for ``mbap``.

    Raises:
        ConfigError: a port or the framing is invalid.
    """
    from ..observe.capture_files.frame_extraction import MODBUS_PORT, CapturedTraffic
    from ..observe.dissect import Framing

    if framing is not None and framing not in _FRAMINGS:
        raise ConfigError(f"one of {', '.join(_FRAMINGS)} is needed, not {framing!r}", key="--framing")
    numbers = [MODBUS_PORT]
    if ports is not None:
        numbers = [whole_number(each.strip(), "--port", 1, 65_535) for each in ports.split(",")]
    return CapturedTraffic(numbers, framing=Framing.MBAP if framing is None else Framing(framing))


def time_text(time: float) -> str:
    """Return a time of a capture (seconds since 1970) as text in UTC, with microseconds.

    A time that is beyond all calendars, as a broken file may have, is returned in seconds.
    """
    try:
        moment = datetime.fromtimestamp(time, UTC)
    except (OverflowError, ValueError, OSError):  # a file may say any time
        return f"{time:g} s"
    return moment.replace(tzinfo=None).isoformat(sep=" ", timespec="microseconds")


def say_what_was_left_out(file: "PacketFile", traffic: "CapturedTraffic", frames: int) -> None:
    """Warn on stderr if a capture file is truncated; and if no Modbus was found in it, say what it contains instead.

    Args:
        file: the file, read to its end.
        traffic: what was found in its packets.
        frames: number of Modbus frames or conversations that were shown; 0 means that no Modbus was found.
    """
    if file.truncated_at is not None:
        packets = counted(file.packets, "packet", "was")
        warn(f"the file ends inside a record at offset {file.truncated_at}; {packets} read")
    if frames:
        return
    if traffic.other_ports:
        port, count = min(traffic.other_ports.items(), key=lambda each: (-each[1], each[0]))
        warn(f"no Modbus on these ports, but {counted(count, 'frame')} of port {port}: --port {port}")
        return
    reasons = ", ".join(f"{count} {reason}" for reason, count in traffic.ignored.most_common(5))
    warn(f"no Modbus in {counted(file.packets, 'packet')}{f': {reasons}' if reasons else ''}")

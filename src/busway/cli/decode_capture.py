"""``busway decode CAPTURE``: explains the Modbus frames of a capture file, field by field.

1. Each frame has a line with packet, time and addresses above it. Packets are numbered as Wireshark numbers them.
2. A reply is compared with its request, also where several are in flight.
3. What is broken or missing in the capture is printed at its place among the frames; the exit code is then 6.
"""

from collections import OrderedDict
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from ..values.printable import printable
from .captures import open_packets, say_what_was_left_out, time_text, traffic_of
from .dissection import dissection_json, show_dissection
from .exits import ExitCode
from .output import print_json

if TYPE_CHECKING:
    from ..observe.capture_files.frame_extraction import CapturedFrame, CapturedTraffic, FaultyBytes, TrafficEvent
    from ..observe.capture_files.packet_file import PacketFile
    from ..observe.dissect import Dissection, Dissector

_MOST_ASKED: Final = 4096
"""Most requests that are kept until their replies come, which are explained by them; then the oldest is forgotten."""


def decode_capture(name: str, *, ports: str | None, framing: str | None, as_json: bool) -> int:
    """Print the Modbus frames of a capture file on stdout, field by field; return the exit code.

    Args:
        name: path of the file; ``-`` for standard input.
        ports: text of ``--port``; None for 502.
        framing: text of ``--framing``; None for ``mbap``.
        as_json: True prints one JSON object for each frame; False prints lines.

    Returns:
        ``DONE``, or ``BROKEN`` if a frame is invalid or the capture lacks bytes.

    Raises:
        ConfigError: an option is invalid, or the file is broken; the frames before the broken place are printed.
    """
    from ..observe.capture_files.frame_extraction import ChannelEnd

    traffic = traffic_of(ports, framing)
    explaining = _Explaining(as_json)
    with open_packets(name) as file:
        try:
            for event in _events(file, traffic):
                if not isinstance(event, ChannelEnd):
                    explaining.show(event)
        finally:
            say_what_was_left_out(file, traffic, explaining.shown)
    return explaining.code


def _events(file: "PacketFile", traffic: "CapturedTraffic") -> Iterator["TrafficEvent"]:
    for packet in file:
        yield from traffic.take(packet)
    yield from traffic.finish()


class _Explaining:
    """Prints the frames of one capture file, each below a line with its packet number, time and addresses.

    Attributes:
        code: exit code for the command: ``DONE``, or ``BROKEN`` once something broken was printed.
        shown: number of frames and faults printed so far.
    """

    def __init__(self, as_json: bool) -> None:
        self.code: ExitCode = ExitCode.DONE
        self.shown: int = 0
        self._as_json = as_json
        self._asked: OrderedDict[object, Dissector] = OrderedDict()
        self._lines: dict[int, Dissector] = {}

    def show(self, event: "CapturedFrame | FaultyBytes") -> None:
        """Print one frame, field by field; or what is broken or missing at one place of the capture."""
        from ..observe.capture_files.frame_extraction import FaultyBytes

        said = event.text if isinstance(event, FaultyBytes) else ""
        dissection = self._dissected(event)
        if said or (dissection is not None and dissection.problems):
            self.code = ExitCode.BROKEN
        if self._as_json:
            print_json(_json(event, said, dissection))
        else:
            if self.shown:
                print()
            print(_heading(event) + (f": {said}" if said else ""))
            if dissection is not None:
                show_dissection(dissection)
        self.shown += 1

    def _dissected(self, event: "CapturedFrame | FaultyBytes") -> "Dissection | None":
        from ..framing.received import Direction
        from ..observe.capture_files.frame_extraction import CapturedFrame
        from ..observe.dissect import Dissector, MessageDirection

        channel = event.channel
        if not isinstance(event, CapturedFrame):
            return Dissector(framing=channel.framing).dissect(event.raw)[0] if event.raw else None
        if channel.client is None:
            return self._lines.setdefault(channel.number, Dissector(framing=channel.framing)).dissect(event.raw)[0]
        key = channel.number, event.transaction
        dissector = self._asked.pop(key, None) or Dissector(framing=channel.framing)
        if event.direction is Direction.REPLY:
            dissector.direction = MessageDirection.REPLY
        else:
            dissector.direction = MessageDirection.REQUEST
            self._asked[key] = dissector
            if len(self._asked) > _MOST_ASKED:
                self._asked.popitem(last=False)
        return dissector.dissect(event.raw)[0]


def _heading(event: "CapturedFrame | FaultyBytes") -> str:
    return f"packet {event.packet}, {time_text(event.time)}, {_ends(event)}"


def _ends(event: "CapturedFrame | FaultyBytes") -> str:
    source, destination = _addresses(event)
    return f"{source} → {destination}" if destination else source


def _addresses(event: "CapturedFrame | FaultyBytes") -> tuple[str, str]:
    """Return source and destination of a frame as text; for a serial line, its name and an empty text."""
    from ..framing.received import Direction
    from ..observe.capture_files.frame_extraction import node_text

    channel = event.channel
    if channel.client is None or channel.server is None:
        return printable(channel.name), ""
    ends = node_text(channel.client), node_text(channel.server)
    return (ends[1], ends[0]) if event.direction is Direction.REPLY else ends


def _json(event: "CapturedFrame | FaultyBytes", said: str, dissection: "Dissection | None") -> dict[str, object]:
    source, destination = _addresses(event)
    found: dict[str, object] = {"packet": event.packet, "time": event.time, "from": source, "to": destination}
    if said:
        found["fault"] = said
    return found | (dissection_json(dissection) if dissection is not None else {})

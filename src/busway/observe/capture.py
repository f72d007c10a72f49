"""Capture files for Wireshark: writes the bytes of connections and the frames of serial lines as packets.

Knows how Wireshark dissects each kind of packet; knows no driver. Drivers pass in what they received and sent.

1. TCP: each receive and send is one TCP segment (several above 32 768 bytes), UDP: each datagram is one; with the true
   addresses and ports. Wireshark decodes port 502 by default, and others by its preference
   (``tshark -o mbtcp.tcp.port:502,5020``).
2. Serial lines: each frame is a packet that Wireshark decodes as Modbus RTU. The master has the address 0.0.0.0,
   unit 7 has 0.0.0.7, so that replies are matched with their requests. Where requests and replies look alike (05, 06,
   08, 22), Wireshark tells them apart with ``mbrtu.tcp.port:1``: port 1 means the units.
3. Wireshark dissects no RTU frame of four bytes (07, 11, 12, 17) and no broadcast: those are written as data, with our
   description as comment (and in the list of packets, from Wireshark 4.2 on). An ASCII frame is written in its RTU
   form, with its characters in the comment: there is no dissector for ASCII.
4. Damaged bytes are packets too; their comment says what is wrong with them.
5. Capturing never disturbs the conversation: if the file cannot be written, the capture ends, one log line says so,
   and everything else goes on.
6. A packet is written as soon as its frame is complete: on a line, as soon as silence ends the frame. `close` writes
   what is incomplete then.
"""

import logging
import threading
import time
from collections.abc import Callable
from ipaddress import IPv4Address
from typing import BinaryIO, Final

from ..codes import BROADCAST_UNIT
from ..framing.received import Damaged, Direction, FrameOrDamage
from ..framing.rtu import encode_rtu
from .capture_headers import Node, line_pdu, tcp_packet, udp_packet
from .pcapng import SECTION_HEADER, Flow, LinkType, PcapngWriter
from .socket_addresses import SocketAddresses
from .trace import TRACE
from .wording import described, in_words

_log = logging.getLogger("busway.capture")

LARGEST_SEGMENT: Final = 32_768
"""Most bytes of one packet; a larger receive becomes several packets."""
_MASTER_PORT: Final = 50_000
_UNIT_PORT: Final = 1
"""Port number that stands for the units of a serial line in its packets.

No Modbus server uses it, so Wireshark's preference for lines does not affect TCP.
"""
_SHORTEST_DISSECTED: Final = 5
"""Fewest bytes of an RTU frame that Wireshark 4.0 dissects; shorter frames are written as data."""
_MARK: Final = "Made by busway"
_HINT: Final = (
    f"{_MARK} from payloads; packet headers are synthetic. On serial lines the master is 0.0.0.0 and unit n is"
    " 0.0.0.n, port 1. Wireshark decodes everything with the preferences mbrtu.tcp.port:1 and, for Modbus/TCP on other"
    " ports than 502, mbtcp.tcp.port:502,5020."
)


def is_capture(head: bytes) -> bool:
    """Whether a file is a capture file that busway wrote; ``head`` has its first bytes, at least 42."""
    return head.startswith(SECTION_HEADER) and _MARK.encode("ascii") in head


class Capture:
    """A capture file for Wireshark; a context manager that closes it. Its methods may be called from several threads.

    Connections and serial lines write into the file through recorders, which `connection`, `stream` and `line` return.
    If the file cannot be written, no method raises: `failure` then has the reason, and later packets are dropped.

    Attributes:
        failure: why nothing more is written: the error of the file, or ``closed``; empty while packets are written.
    """

    def __init__(self, stream: BinaryIO, *, clock: Callable[[], float] = time.time) -> None:
        """Write the beginning of a capture file into ``stream``. `close` closes the stream.

        Args:
            stream: the file to write, opened in binary mode.
            clock: returns the time in seconds since 1970.

        Raises:
            OSError: the beginning cannot be written.
        """
        self.failure: str = ""
        self._stream = stream
        self._clock = clock
        self._lock = threading.Lock()
        self._writer = PcapngWriter(stream, comment=_HINT)
        self._ip_interface: int | None = None
        self._lines: dict[str, int] = {}

    def __enter__(self) -> "Capture":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def packets(self) -> int:
        """Number of packets written to the capture file so far."""
        return self._writer.packets

    def stream(self, local: object, peer: object) -> "StreamCapture":
        """Return a recorder for one TCP connection.

        In the file, each recorder is a connection of its own: its sequence numbers begin with 1 in both directions.

        Args:
            local, peer: socket addresses from ``getsockname`` and ``getpeername``; anything else, such as None, is
                written as 0.0.0.0:0.
        """
        return StreamCapture(self, Node.of(local), Node.of(peer))

    def connection(self, addresses: SocketAddresses) -> "StreamCapture | DatagramCapture":
        """Return a recorder for a TCP connection, or for the datagrams between two UDP addresses.

        An address that is None in ``addresses`` is written as 0.0.0.0:0.
        """
        return (
            DatagramCapture(self, addresses) if addresses.is_datagram else self.stream(addresses.local, addresses.peer)
        )

    def datagram(self, local: object, peer: object, data: bytes, *, is_outgoing: bool) -> None:
        """Write a UDP datagram between two socket addresses to the capture file.

        Args:
            local, peer: addresses from ``getsockname`` and ``getpeername``.
            data: the bytes of the datagram.
            is_outgoing: whether it was sent by this program.
        """
        here, there = Node.of(local), Node.of(peer)
        source, destination = (here, there) if is_outgoing else (there, here)
        self.ip_packet(udp_packet(source, destination, data), is_outgoing=is_outgoing)

    def line(self, name: str, *, is_server: bool = True) -> "LineCapture":
        """Return a recorder for a serial line; lines of the same name are one interface of the file.

        ``is_server`` is ignored: the file says of each frame which way it went.
        """

        def interface() -> int:
            if name not in self._lines:
                self._lines[name] = self._writer.add_interface(LinkType.UPPER_PDU, name, "serial line")
            return self._lines[name]

        return LineCapture(self, self._guarded(interface))

    def close(self) -> None:
        """Write the received bytes of unfinished frames of serial lines, and close the file. Later packets are dropped.

        Does not raise if the file cannot be written. May be called twice.
        """
        TRACE.settle()
        with self._lock:
            self.failure = self.failure or "closed"
            try:
                self._stream.close()
            except OSError as error:  # what a full disk did not take; the failure to write it was said
                _log.debug("closing the capture file: %s", error)

    # What the connections and lines of this file hand in.

    def ip_packet(self, packet: bytes, *, is_outgoing: bool) -> None:
        """Write an IP packet to the capture file, with the current time."""

        def write() -> int:
            if self._ip_interface is None:
                self._ip_interface = self._writer.add_interface(LinkType.RAW_IP, "ip", "network connections")
            flow = Flow.OUTGOING if is_outgoing else Flow.INCOMING
            self._writer.add_packet(self._ip_interface, packet, self._clock(), flow=flow)
            return 0

        self._guarded(write)

    def line_packet(self, interface: int, packet: bytes, at: float | None, flow: Flow, comment: str) -> None:
        """Write a frame of a serial line to the capture file.

        Args:
            interface: number of the line's interface in the file.
            packet: the frame, with the tags that `line_pdu` puts before it.
            at: when the frame began, in seconds since 1970; None for now.
            flow: whether it was received or sent, or UNKNOWN.
            comment: comment of the packet; empty for none.
        """

        def write() -> int:
            self._writer.add_packet(interface, packet, self._clock() if at is None else at, flow=flow, comment=comment)
            return 0

        self._guarded(write)

    def _guarded(self, write: Callable[[], int]) -> int:
        """Call ``write`` under the lock, and return its result; 0 if it fails, or if the file has ended already.

        The first failure ends the capture file and is logged.
        """
        with self._lock:
            if self.failure:
                return 0
            try:
                return write()
            except (OSError, ValueError) as error:  # ValueError: the stream was closed by its owner
                self.failure = getattr(error, "strerror", None) or str(error)
        _log.warning("the capture file ends here, it cannot be written any more: %s", self.failure)
        return 0


class StreamCapture:
    """Recorder of one TCP connection in a capture file. Used by one thread at a time."""

    __slots__ = ("_capture", "_local", "_peer", "_received", "_sent")

    def __init__(self, capture: Capture, local: Node, peer: Node) -> None:
        self._capture = capture
        self._local = local
        self._peer = peer
        self._received = self._sent = 1  # sequence numbers behind a handshake that was not seen

    def received(self, data: bytes) -> None:
        """Write bytes that the connection received to the capture file, as TCP packets with the current time."""
        for at in range(0, len(data), LARGEST_SEGMENT):
            piece = data[at : at + LARGEST_SEGMENT]
            packet = tcp_packet(self._peer, self._local, piece, self._received, self._sent)
            self._received += len(piece)
            self._capture.ip_packet(packet, is_outgoing=False)

    def sent(self, data: bytes) -> None:
        """Write bytes that the connection sent to the capture file, as TCP packets with the current time."""
        for at in range(0, len(data), LARGEST_SEGMENT):
            piece = data[at : at + LARGEST_SEGMENT]
            packet = tcp_packet(self._local, self._peer, piece, self._sent, self._received)
            self._sent += len(piece)
            self._capture.ip_packet(packet, is_outgoing=True)


class DatagramCapture:
    """Recorder of the datagrams between two addresses in a capture file."""

    __slots__ = ("_addresses", "_capture")

    def __init__(self, capture: Capture, addresses: SocketAddresses) -> None:
        self._capture = capture
        self._addresses = addresses

    def received(self, data: bytes) -> None:
        """Write a received datagram to the capture file, with the current time."""
        self._capture.datagram(self._addresses.local, self._addresses.peer, data, is_outgoing=False)

    def sent(self, data: bytes) -> None:
        """Write a sent datagram to the capture file, with the current time."""
        self._capture.datagram(self._addresses.local, self._addresses.peer, data, is_outgoing=True)


class LineCapture:
    """Recorder of one serial line in a capture file."""

    __slots__ = ("_capture", "_interface")

    def __init__(self, capture: Capture, interface: int) -> None:
        self._capture = capture
        self._interface = interface

    def heard(
        self,
        found: FrameOrDamage,
        *,
        at: float | None = None,
        direction: Direction | None = None,
        is_outgoing: bool = False,
    ) -> None:
        """Write a frame, or damaged bytes, of the serial line to the capture file as one packet.

        Args:
            found: the frame or damaged bytes.
            at: time in seconds since 1970 at which the frame or the damaged bytes began; None for now.
            direction: request or reply; None for the direction in ``found``. Without effect for damaged bytes.
            is_outgoing: whether this program sent the bytes.
        """
        flow = Flow.OUTGOING if is_outgoing else Flow.INCOMING
        if isinstance(found, Damaged):
            info = f"{found.size} damaged bytes: {found.reason.value}"
            self._write("data", found.raw, 0, Direction.UNKNOWN, at, flow, info, info=info)
        else:
            self._frame(found.unit, found.pdu, found.raw, direction or found.direction, at, flow)

    def _frame(self, unit: int, pdu: bytes, raw: bytes, direction: Direction, at: float | None, flow: Flow) -> None:
        comment = ""
        if raw != encode_rtu(unit, pdu):
            comment = f"ASCII frame {raw.decode('ascii', errors='backslashreplace').rstrip()}"
            raw = encode_rtu(unit, pdu)
        if unit == BROADCAST_UNIT or len(raw) < _SHORTEST_DISSECTED:
            info = f"unit {unit}: {in_words(described(pdu, direction))}"
            self._write("data", raw, unit, direction, at, flow, comment or info, info=info)
        else:
            self._write("mbrtu", raw, unit, direction, at, flow, comment)

    def _write(
        self,
        dissector: str,
        raw: bytes,
        unit: int,
        direction: Direction,
        at: float | None,
        flow: Flow,
        comment: str,
        *,
        info: str = "",
    ) -> None:
        master, device = Node(IPv4Address(0), _MASTER_PORT), Node(IPv4Address(unit), _UNIT_PORT)
        addresses = (device, master) if direction is Direction.REPLY else (master, device)
        packet = line_pdu(dissector, *addresses, raw, info=info)
        self._capture.line_packet(self._interface, packet, at, flow, comment)

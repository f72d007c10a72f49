"""Finds the Modbus frames in the packets of a capture file, connection by connection and line by line.

Knows packets, streams and framings; knows no file, and not which reply answers which request. No function raises an
error, whatever the packets are.

1. The end of a connection with one of the given ports is the server. If both ends have one, the server is the end to
   which the SYN was sent, or without a SYN the destination of the first packet.
2. A stream that begins in the middle, or behind missing bytes, is out of step: reading goes on at a segment that
   begins like a frame, and the bytes skipped until then are reported. An impossible length has the same effect.
3. Each datagram is read by itself, and so is each packet of a line whose kind makes it one frame; other bytes of a
   line are one stream, in which silence ends frames.
4. Limits: `MOST_CHANNELS` at once of TCP connections and lines together, and as many pairs of UDP addresses; then the
   one that was silent longest is ended. Each keeps part of a frame, and the segments that `tcp_reassembly` holds back.
"""

from collections import Counter, OrderedDict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

from ...framing.character_times import SerialTiming
from ...framing.frame_direction import LineRole
from ...framing.mbap import HEADER_SIZE, MAX_LENGTH, MIN_LENGTH, FrameKind, MbapFrame, MbapReceiver, encode_mbap
from ...framing.received import Damaged, Direction, FrameOrDamage, SerialFrame, SerialReceiver
from ...pdu.functions import STANDARD
from ...session.line_framing import line_framing
from ...values.counts import counted
from ..capture_headers import Node
from ..dissect import Framing
from .layers import Ignored, LineBytes, TcpSegment, UdpDatagram, carried
from .packet_file import CapturedPacket
from .tcp_reassembly import StreamAssembler, StreamGap, StreamPart, StreamPiece

MODBUS_PORT: Final = 502
"""The port of Modbus servers, unless others are given."""
MOST_CHANNELS: Final = 2048
"""Most TCP connections and lines that are followed at once; also the most pairs of UDP addresses.

Beyond that, the one that was silent longest is ended.
"""
_MOST_REASONS: Final = 64
_MOST_PORTS: Final = 1024


@dataclass(frozen=True, slots=True)
class CapturedChannel:
    """A connection, or a serial line, in a capture file.

    Attributes:
        number: counted from 1.
        carrier: ``tcp``, ``udp`` or ``line``.
        framing: framing of its frames.
        client, server: its ends; None for a line.
        name: name of a line; empty for a connection.
    """

    number: int
    carrier: str
    framing: Framing
    client: Node | None = None
    server: Node | None = None
    name: str = ""

    @property
    def client_text(self) -> str:
        """The address of the client as text, without its port; empty for a line."""
        return "" if self.client is None else str(self.client.address)

    @property
    def server_text(self) -> str:
        """The address of the server as text, with its port; the name of a line."""
        return self.name if self.server is None else node_text(self.server)


def node_text(node: Node) -> str:
    """Return an address with its port as text: ``10.0.0.5:502``, ``[fe80::2]:502``."""
    return f"[{node.address}]:{node.port}" if node.address.version == 6 else f"{node.address}:{node.port}"


class TrafficFault(Enum):
    """What can be wrong with the bytes of a connection or a line in a capture file."""

    MISSING = "missing in the capture"
    SKIPPED = "skipped"
    BAD_LENGTH = "bad length"
    CUT_OFF = "cut off"
    FOREIGN_PROTOCOL = "foreign protocol"
    DAMAGED = "damaged"


@dataclass(frozen=True, slots=True)
class CapturedFrame:
    """A Modbus frame in a capture file.

    Attributes:
        channel: its connection or line.
        packet: number of the packet that completed it, as Wireshark counts.
        time: seconds since 1970 of that packet.
        direction: request or reply; on a line judged from the frames before it, and UNKNOWN if they do not tell.
        raw: the bytes of the frame.
        unit: unit identifier, 0…255.
        pdu: function code and data.
        transaction: transaction identifier; None without MBAP header.
        received: the frame as the receiver of a line returned it; None with MBAP header.
    """

    channel: CapturedChannel
    packet: int
    time: float
    direction: Direction
    raw: bytes
    unit: int
    pdu: bytes
    transaction: int | None = None
    received: FrameOrDamage | None = None


@dataclass(frozen=True, slots=True)
class FaultyBytes:
    """Bytes in a capture file that are no frame, or that are missing.

    Attributes:
        channel: the connection or line.
        packet, time: number and time of the packet at which the fault was found.
        direction: REQUEST for bytes from the client, REPLY for bytes from the server; UNKNOWN if that cannot be told.
        fault: what is wrong.
        text: what is wrong, in words and with numbers.
        raw: the bytes that are no frame; empty for ``MISSING`` and ``CUT_OFF``.
        received: the damaged bytes as the receiver of a line returned them; otherwise None.
    """

    channel: CapturedChannel
    packet: int
    time: float
    direction: Direction
    fault: TrafficFault
    text: str
    raw: bytes = b""
    received: FrameOrDamage | None = None


class ChannelEnding(Enum):
    """How a connection or line in a capture file ended: closed, reset, or by the end of the capture.

    FORGOTTEN: it was silent longest when there were too many (`MOST_CHANNELS`).
    """

    CLOSED = "closed"
    RESET = "reset"
    FORGOTTEN = "forgotten"
    CAPTURE_ENDS = "the capture ends"


@dataclass(frozen=True, slots=True)
class ChannelEnd:
    """The end of a connection or line in a capture file; no event of the channel follows.

    It comes at the end of the file, or when a new connection has the same addresses or the channel is forgotten; not as
    soon as a connection is closed or reset.

    Attributes:
        channel: the connection or line.
        time: the latest time of all packets up to then, in seconds since 1970.
        ending: why it ended.
    """

    channel: CapturedChannel
    time: float
    ending: ChannelEnding


TrafficEvent = CapturedFrame | FaultyBytes | ChannelEnd
"""An event found in the packets of a capture file: a frame, faulty bytes, or the end of a connection or line."""


class CapturedTraffic:
    """Finds the Modbus frames in the packets of a capture file.

    Args:
        ports: TCP and UDP ports of Modbus servers.
        framing: framing on these ports, `Framing.MBAP`, `Framing.RTU` or `Framing.ASCII`; lines have RTU, or ASCII
            where the first packet begins with a colon.

    Attributes:
        ignored: number of packets without Modbus, by reason; rare reasons are counted together beyond 64.
        other_ports: number of packets on other ports that look like one MBAP frame, by port, for at most 1024 ports;
            each packet is counted at both of its ports.
        repeated: number of bytes that TCP sent again, on connections that have ended.
        out_of_order: number of segments that came too early, on connections that have ended.
        begun_inside: number of TCP connections whose beginning the capture does not have. One that begins with sequence
            number 1 counts as complete: captures of this library have no SYN.
        channels: number of connections and lines so far.
    """

    def __init__(self, ports: Iterable[int] = (MODBUS_PORT,), *, framing: Framing = Framing.MBAP) -> None:
        self.ignored: Counter[str] = Counter()
        self.other_ports: Counter[int] = Counter()
        self.repeated: int = 0
        self.out_of_order: int = 0
        self.begun_inside: int = 0
        self.channels: int = 0
        self._ports = frozenset(ports)
        self._framing = framing
        self._open: OrderedDict[object, _TcpChannel | _LineChannel] = OrderedDict()
        self._datagrams: OrderedDict[object, _DatagramChannel] = OrderedDict()
        self._last = 0.0

    def take(self, packet: CapturedPacket) -> list[TrafficEvent]:
        """Process the next packet of the file. Returns the events that follow from it, in order.

        They are frames that it completes, faulty bytes, and connections or lines that end. Empty for most packets
        without Modbus, which are counted in ``ignored``.
        """
        self._last = max(self._last, packet.time)
        inner = carried(packet.link_type, packet.data)
        if isinstance(inner, TcpSegment):
            return self._segment(packet, inner)
        if isinstance(inner, UdpDatagram):
            return self._datagram(packet, inner)
        if isinstance(inner, LineBytes):
            return self._line(packet, inner)
        self._ignore(inner)
        return []

    def finish(self) -> list[TrafficEvent]:
        """Return the last events at the end of the file: frames and faulty bytes not returned yet, ends of channels."""
        found: list[TrafficEvent] = []
        for each in self._open.values():
            found += self._ended(each, ChannelEnding.CAPTURE_ENDS)
        for peers in self._datagrams.values():
            found.append(ChannelEnd(peers.channel, self._last, ChannelEnding.CAPTURE_ENDS))
        self._open.clear()
        self._datagrams.clear()
        return found

    # Inside.

    def _ignore(self, what: Ignored) -> None:
        reason = what.reason if what.reason in self.ignored or len(self.ignored) < _MOST_REASONS else "other protocols"
        self.ignored[reason] += 1

    def _is_request(self, source: Node, destination: Node, *, asks_to_open: bool) -> bool | None:
        """Whether a packet goes from client to server; None if neither port is that of a server.

        If both are, False only if the connection is known with the source as server, and the packet does not open it
        anew. ``asks_to_open``: whether the packet is a SYN without ACK, whose destination is the server.
        """
        to, of = destination.port in self._ports, source.port in self._ports
        if to and of:
            known = self._open.get((destination, source)) or self._datagrams.get((destination, source))
            return known is None or asks_to_open
        return True if to else False if of else None

    def _foreign(self, source: Node, destination: Node, payload: bytes, what: str) -> list[TrafficEvent]:
        """Count a packet of which neither port is that of a server. Always returns an empty list.

        Its ports are counted too (``other_ports``) if its bytes are one MBAP frame. ``what``: ``TCP`` or ``UDP``.
        """
        self._ignore(Ignored(f"{what} of other ports"))
        if _begins_like_a_frame(payload) and len(payload) == 6 + (payload[4] << 8 | payload[5]):
            for port in (source.port, destination.port):
                if port in self.other_ports or len(self.other_ports) < _MOST_PORTS:
                    self.other_ports[port] += 1
        return []

    def _segment(self, packet: CapturedPacket, segment: TcpSegment) -> list[TrafficEvent]:
        asks = segment.syn and segment.acknowledged is None
        is_request = self._is_request(segment.source, segment.destination, asks_to_open=asks)
        if is_request is None:
            return self._foreign(segment.source, segment.destination, segment.payload, "TCP")
        client, server = segment.source, segment.destination
        if not is_request:
            client, server = server, client
        key = client, server
        found: list[TrafficEvent] = []
        open_channel = self._open.get(key)
        if isinstance(open_channel, _TcpChannel) and asks and open_channel.is_another(segment):
            found += self._ended(open_channel, ChannelEnding.CLOSED)
            del self._open[key]
            open_channel = None
        if open_channel is None:
            if not (segment.syn or segment.payload or segment.missing):
                return found
            found += self._make_room()
            channel = CapturedChannel(self._count(), "tcp", self._framing, client, server)
            open_channel = self._open[key] = _TcpChannel(channel)
            # A capture of busway has payloads only: the numbers of each connection begin with 1, behind a handshake
            # that was not there to be seen. Real ones begin anywhere (RFC 9293 §3.4.1).
            self.begun_inside += not (segment.syn or segment.sequence == 1)
        self._open.move_to_end(key)
        assert isinstance(open_channel, _TcpChannel)
        return [*found, *open_channel.take(packet, segment, is_request=is_request)]

    def _datagram(self, packet: CapturedPacket, datagram: UdpDatagram) -> list[TrafficEvent]:
        is_request = self._is_request(datagram.source, datagram.destination, asks_to_open=False)
        if is_request is None:
            return self._foreign(datagram.source, datagram.destination, datagram.payload, "UDP")
        client, server = datagram.source, datagram.destination
        if not is_request:
            client, server = server, client
        found: list[TrafficEvent] = []
        peers = self._datagrams.get((client, server))
        if peers is None:
            if len(self._datagrams) == MOST_CHANNELS:
                _, oldest = self._datagrams.popitem(last=False)
                found.append(ChannelEnd(oldest.channel, self._last, ChannelEnding.FORGOTTEN))
            peers = _DatagramChannel(CapturedChannel(self._count(), "udp", self._framing, client, server))
            self._datagrams[client, server] = peers
        self._datagrams.move_to_end((client, server))
        return found + peers.take(packet, datagram, Direction.REQUEST if is_request else Direction.REPLY)

    def _line(self, packet: CapturedPacket, inner: LineBytes) -> list[TrafficEvent]:
        found: list[TrafficEvent] = []
        line = self._open.get(packet.interface)
        if line is None:
            found += self._make_room()
            framing = Framing.ASCII if inner.payload.startswith(b":") else Framing.RTU
            name = packet.interface_name or f"line {packet.interface}"
            channel = CapturedChannel(self._count(), "line", framing, name=name)
            line = self._open[packet.interface] = _LineChannel(channel)
        self._open.move_to_end(packet.interface)
        assert isinstance(line, _LineChannel)
        if packet.missing:
            text = f"{counted(packet.missing, 'byte', 'was')} not captured"
            found.append(_fault(line.channel, packet, Direction.UNKNOWN, TrafficFault.MISSING, text))
        found += line.take(inner.payload, packet.number, packet.time, whole=inner.whole)
        return found

    def _count(self) -> int:
        self.channels += 1
        return self.channels

    def _make_room(self) -> list[TrafficEvent]:
        """If there are `MOST_CHANNELS`, end the connection or line that was silent longest. Returns its last events.

        Empty if there was room.
        """
        if len(self._open) < MOST_CHANNELS:
            return []
        _, oldest = self._open.popitem(last=False)
        return self._ended(oldest, ChannelEnding.FORGOTTEN)

    def _ended(self, channel: "_TcpChannel | _LineChannel", ending: ChannelEnding) -> list[TrafficEvent]:
        found = channel.finish()
        if isinstance(channel, _TcpChannel):
            self.repeated += sum(each.stream.repeated for each in channel.sides)
            self.out_of_order += sum(each.stream.out_of_order for each in channel.sides)
            ending = channel.ending or ending
        return [*found, ChannelEnd(channel.channel, self._last, ending)]


# TCP.


class _Side:
    """One direction of a TCP connection: its bytes in order, and the MBAP frames in them."""

    def __init__(self, channel: CapturedChannel, direction: Direction) -> None:
        self.stream = StreamAssembler()
        self.is_finished = False
        self.first: int | None = None  # sequence number of its SYN
        self._channel = channel
        self.direction = direction
        self._receiver = MbapReceiver()
        self._in_step = True

    def frames(self, part: StreamPart) -> Iterator[TrafficEvent]:
        """Yield the frames that a part of the stream completes, and the faulty bytes in it."""
        if isinstance(part, StreamGap):
            yield from self._gap(part)
        elif self._in_step or _begins_like_a_frame(part.data):
            self._in_step = True
            yield from self._received(part)
        else:
            text = f"{counted(len(part.data), 'byte')} skipped: no frame begins so"
            yield self._fault(part, TrafficFault.SKIPPED, text, part.data)

    def _gap(self, gap: StreamGap) -> Iterator[TrafficEvent]:
        yield from self.cut_off(gap)
        if gap.size is not None:
            yield self._fault(gap, TrafficFault.MISSING, f"{counted(gap.size, 'byte', 'is')} missing in the capture")
        self._in_step = False

    def cut_off(self, part: StreamPart) -> Iterator[TrafficEvent]:
        """Drop a frame of which only the beginning has come, and yield a `TrafficFault.CUT_OFF` event for it.

        Nothing if there is none. The event has packet and time of ``part``, which does not continue the frame.
        """
        if self._receiver.unfinished:
            text = f"the frame ends after {counted(len(self._receiver.unfinished), 'byte')}"
            yield self._fault(part, TrafficFault.CUT_OFF, text)
        self._receiver = MbapReceiver()

    def _received(self, part: StreamPiece) -> Iterator[TrafficEvent]:
        for frame in self._receiver.receive(part.data):
            yield _mbap_event(self._channel, frame, part.packet, part.time, self.direction)
        if self._receiver.broken:
            self._receiver = MbapReceiver()
            self._in_step = False

    def _fault(self, part: StreamPart, fault: TrafficFault, text: str, raw: bytes = b"") -> FaultyBytes:
        return FaultyBytes(self._channel, part.packet, part.time, self.direction, fault, text, raw)


class _TcpChannel:
    """One captured TCP connection.

    With MBAP headers its two directions are read apart. RTU and ASCII frames do not tell their direction, so one
    receiver reads both.
    """

    def __init__(self, channel: CapturedChannel) -> None:
        self.channel = channel
        self.ending: ChannelEnding | None = None
        self.sides = _Side(channel, Direction.REPLY), _Side(channel, Direction.REQUEST)
        self._line = None if channel.framing is Framing.MBAP else _LineChannel(channel)
        self._last = StreamGap(None, 0, 0.0)

    def is_another(self, segment: TcpSegment) -> bool:
        """Whether a SYN from the client opens another connection between the same ends; False if it repeats the SYN."""
        return self.sides[True].first != segment.sequence

    def take(self, packet: CapturedPacket, segment: TcpSegment, *, is_request: bool) -> list[TrafficEvent]:
        """Process a segment, from the client if ``is_request``. Returns the frames that it completes, and faulty bytes.

        They are in order.
        """
        side, peer = self.sides[is_request], self.sides[not is_request]
        self._last = StreamGap(None, packet.number, packet.time)
        sequence = segment.sequence
        if segment.syn:
            side.first = sequence
            side.stream.begin(sequence)
            sequence += 1
        parts: list[tuple[_Side, StreamPart]] = []
        if segment.acknowledged is not None:
            parts += [(peer, part) for part in peer.stream.acknowledge(segment.acknowledged)]
        if segment.payload or segment.missing:
            arrived = side.stream.segment(
                sequence & 0xFFFF_FFFF, segment.payload, segment.missing, packet.number, packet.time
            )
            parts += [(side, part) for part in arrived]
        side.is_finished = side.is_finished or segment.fin
        if segment.rst:
            self.ending = ChannelEnding.RESET
        elif self.ending is None and all(each.is_finished for each in self.sides):
            self.ending = ChannelEnding.CLOSED
        return [event for each, part in parts for event in self._events(each, part)]

    def finish(self) -> list[TrafficEvent]:
        """Return the last events of the connection, of segments that waited and of unfinished frames."""
        found: list[TrafficEvent] = []
        for side in self.sides:
            for part in side.stream.finish():
                found += self._events(side, part)
            found += side.cut_off(self._last)
        return found + (self._line.finish() if self._line is not None else [])

    def _events(self, side: _Side, part: StreamPart) -> Iterable[TrafficEvent]:
        if self._line is None:
            return side.frames(part)
        if isinstance(part, StreamPiece):
            found = self._line.take(part.data, part.packet, part.time, whole=False)
            return [_directed(each, side.direction) for each in found]
        if part.size is None:
            return []
        text = f"{counted(part.size, 'byte', 'is')} missing in the capture"
        return [FaultyBytes(self.channel, part.packet, part.time, Direction.UNKNOWN, TrafficFault.MISSING, text)]


def _begins_like_a_frame(data: bytes) -> bool:
    """Whether bytes begin with a valid MBAP header and a known function code."""
    if len(data) <= HEADER_SIZE or data[2] or data[3]:
        return False
    return MIN_LENGTH <= data[4] << 8 | data[5] <= MAX_LENGTH and data[HEADER_SIZE] & 0x7F in STANDARD


def _mbap_event(
    channel: CapturedChannel, frame: MbapFrame, packet: int, time: float, direction: Direction
) -> TrafficEvent:
    if frame.kind is FrameKind.FRAME:
        raw = encode_mbap(frame.transaction, frame.unit, frame.pdu)
        return CapturedFrame(channel, packet, time, direction, raw, frame.unit, frame.pdu, frame.transaction)
    if frame.kind is FrameKind.BROKEN:
        return FaultyBytes(channel, packet, time, direction, TrafficFault.BAD_LENGTH, frame.reason, frame.pdu)
    text = f"protocol {frame.protocol}, where Modbus has 0"
    head = encode_mbap(frame.transaction, frame.unit, frame.pdu)
    raw = head[:2] + frame.protocol.to_bytes(2, "big") + head[4:]
    return FaultyBytes(channel, packet, time, direction, TrafficFault.FOREIGN_PROTOCOL, text, raw)


def _fault(
    channel: CapturedChannel, packet: CapturedPacket, direction: Direction, fault: TrafficFault, text: str
) -> FaultyBytes:
    return FaultyBytes(channel, packet.number, packet.time, direction, fault, text)


# Datagrams and lines.


class _DatagramChannel:
    """The datagrams between two addresses; each is read by itself."""

    def __init__(self, channel: CapturedChannel) -> None:
        self.channel = channel
        self._line = None if channel.framing is Framing.MBAP else _LineChannel(channel)

    def take(self, packet: CapturedPacket, datagram: UdpDatagram, direction: Direction) -> list[TrafficEvent]:
        """Process a datagram. Returns the frames in it, and faulty bytes, in order."""
        found: list[TrafficEvent] = []
        if datagram.missing:
            text = f"{counted(datagram.missing, 'byte', 'was')} not captured"
            found.append(_fault(self.channel, packet, direction, TrafficFault.MISSING, text))
        if self._line is not None:
            heard = self._line.take(datagram.payload, packet.number, packet.time, whole=True)
            return found + [_directed(each, direction) for each in heard]
        receiver = MbapReceiver()
        for frame in receiver.receive(datagram.payload):
            found.append(_mbap_event(self.channel, frame, packet.number, packet.time, direction))
        if receiver.unfinished and not datagram.missing:
            text = f"the frame ends after {counted(len(receiver.unfinished), 'byte')}"
            found.append(_fault(self.channel, packet, direction, TrafficFault.CUT_OFF, text))
        return found


def _directed(event: TrafficEvent, direction: Direction) -> TrafficEvent:
    """Return a copy of an event of serial framing over TCP or UDP with the direction that the packet's addresses tell.

    The end of a channel has no direction and is returned unchanged.
    """
    if isinstance(event, CapturedFrame) and isinstance(event.received, SerialFrame):
        return replace(event, direction=direction, received=replace(event.received, direction=direction))
    return replace(event, direction=direction) if isinstance(event, FaultyBytes) else event


class _LineChannel:
    """A serial line, or a connection with serial framing: one receiver gets the bytes of both directions."""

    def __init__(self, channel: CapturedChannel) -> None:
        self.channel = channel
        self._receiver: SerialReceiver = line_framing(
            channel.framing.value, LineRole.OBSERVER, SerialTiming.of_network()
        ).receiver
        self._now = 0.0
        self._packet = 0
        self._time = 0.0

    def take(self, data: bytes, packet: int, time: float, *, whole: bool) -> list[TrafficEvent]:
        """Process the bytes of one packet. Returns the frames that they complete, and damaged bytes.

        If a silence before ``time`` (seconds) ended a frame of earlier packets, that frame is returned first.
        ``whole``: the bytes are one frame, so nothing is kept for later packets.
        """
        self._now = max(self._now, time)  # clocks of captures jump back
        found = self._events(self._receiver.tick(self._now))
        self._packet, self._time = packet, time
        found += self._events(self._receiver.receive(data, self._now))
        return found + (self._events(self._receiver.flush(self._now)) if whole else [])

    def finish(self) -> list[TrafficEvent]:
        """Return the last events of the line: bytes that still waited for a silence, as frames or as damaged bytes."""
        return self._events(self._receiver.flush(self._now))

    def _events(self, received: list[FrameOrDamage]) -> list[TrafficEvent]:
        return [self._event(each) for each in received]

    def _event(self, found: FrameOrDamage) -> TrafficEvent:
        if isinstance(found, Damaged):
            text = f"{found.size} damaged bytes: {found.reason.value}"
            unknown = Direction.UNKNOWN
            return FaultyBytes(
                self.channel, self._packet, self._time, unknown, TrafficFault.DAMAGED, text, found.raw, found
            )
        return CapturedFrame(
            self.channel, self._packet, self._time, found.direction, found.raw, found.unit, found.pdu, received=found
        )

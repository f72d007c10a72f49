"""Routes, translation and memory against plain models of what they should do, with whatever requests there are.

The listener's handler and its lines are the real ones; their link answers at once, or when it is told to.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

import busway
from busway.apps.gateway.forwarding import Forwarder
from busway.apps.gateway.router import ListenerRouter
from busway.apps.gateway.routes import AddressRange, Route, RouteAction, RoutingTable
from busway.apps.gateway.upstream import Upstream
from busway.client.settings import link_settings
from busway.codes import Table
from busway.faults.clock import FakeClock
from busway.pdu.message import Message
from busway.session.call import Call
from busway.session.diagnostic_counters import CommunicationState
from busway.session.responder import ALONE, SILENCE, ClientIdentity, Deferral, Forwarding, RequestContext

SIZE = 3000
"""Items of each table of a device. What lies beyond does not exist."""


@dataclass
class PlainDevice:
    """Registers and coils, without any of the library's code."""

    registers: list[int] = field(default_factory=lambda: [n * 7 & 0xFFFF for n in range(SIZE)])
    coils: list[bool] = field(default_factory=lambda: [n % 3 == 0 for n in range(SIZE)])

    def answer(self, pdu: bytes) -> bytes:
        """What a device answers to functions 01, 03, 06, 15 and 16."""
        function, address, word = struct.unpack(">BHH", pdu[:5])
        count = 1 if function == 6 else word
        if address + count > SIZE:
            return bytes((function | 0x80, 2))
        if function == 3:
            return bytes((3, 2 * count)) + struct.pack(f">{count}H", *self.registers[address : address + count])
        if function == 1:
            bits = sum(bit << n for n, bit in enumerate(self.coils[address : address + count]))
            return bytes((1, (count + 7) // 8)) + bits.to_bytes((count + 7) // 8, "little")
        if function == 6:
            self.registers[address] = word
        elif function == 16:
            self.registers[address : address + count] = struct.unpack(f">{count}H", pdu[6:])
        else:
            bits = int.from_bytes(pdu[6:], "little")
            self.coils[address : address + count] = [bool(bits >> n & 1) for n in range(count)]
        return pdu[:5]


@dataclass
class InstantLink:
    """What a line needs of a link; it answers in the very call that asks.

    Attributes:
        asked: unit and PDU of every request.
    """

    devices: dict[int, PlainDevice]
    asked: list[tuple[int, bytes]] = field(default_factory=list)

    def now(self) -> float:
        return 0.0

    def begin(self, call: Call, now: float) -> None:
        for position, request in enumerate(call.requests):
            pdu = request.prepare()
            self.asked.append((call.unit, pdu))
            reply = self.devices.setdefault(call.unit, PlainDevice()).answer(pdu)
            if reply[0] & 0x80:
                call.outcomes[position] = busway.ExceptionReply(reply[1])
            else:
                call.outcomes[position] = request.accept(reply)
        call.open = 0
        call.ended = True
        call.owner.set_result(None)


def asked_by(handler: ListenerRouter, unit: int, pdu: bytes, *, peer: str = "client") -> bytes | None:
    """The answer to a request; None for silence."""
    seen: list[Message | Deferral] = []
    context = RequestContext(
        unit=unit,
        function=pdu[0],
        diagnostics=CommunicationState(),
        finish=lambda _, reply: seen.append(reply),
        client=ClientIdentity(peer=peer),
    )
    outcome = handler.answer(context, handler.functions.decode_request(pdu))
    if isinstance(outcome, Forwarding):
        for target, asked in outcome.asks:
            target.ask(outcome, ALONE, (asked,))
    else:
        assert not seen
        seen.append(outcome)  # type: ignore[arg-type]
    (reply,) = seen
    return None if reply is SILENCE else reply.encode()  # type: ignore[union-attr]


# --- routing -------------------------------------------------------------------------------------

ROUTES = st.builds(
    lambda line, units, functions, addresses, unit, shift, limits, writes, refusal: Route(
        upstream="" if refusal else line,
        units=units,
        functions=functions,
        addresses=None if addresses is None else AddressRange(addresses[0], addresses[1], addresses[1] + addresses[2]),
        unit=unit,
        shift=shift,
        max_registers=limits[0],
        max_bits=limits[1],
        split_writes=writes,
        action=refusal or RouteAction.FORWARD,
        code=4,
    ),
    st.sampled_from(["a", "b"]),
    st.frozensets(st.integers(1, 4), min_size=1),
    st.one_of(st.just(frozenset()), st.frozensets(st.sampled_from([1, 3, 6, 15, 16]), min_size=1)),
    st.one_of(
        st.none(),
        st.tuples(st.sampled_from([Table.COILS, Table.HOLDING_REGISTERS]), st.integers(0, 400), st.integers(1, 400)),
    ),
    st.one_of(st.none(), st.integers(1, 9)),
    st.sampled_from([0, 0, 7, -5, 300]),
    st.tuples(
        st.one_of(st.none(), st.integers(1, 130).map(lambda n: min(n, 125))), st.one_of(st.none(), st.integers(1, 400))
    ),
    st.booleans(),
    st.sampled_from([None, None, None, RouteAction.REFUSE, RouteAction.DROP]),
)


@st.composite
def pdus(draw: st.DrawFn) -> bytes:
    """Right requests of five functions."""
    function = draw(st.sampled_from([1, 3, 6, 15, 16]))
    address = draw(st.integers(0, 600))
    if function == 1:
        return struct.pack(">BHH", 1, address, draw(st.integers(1, 500)))
    if function == 3:
        return struct.pack(">BHH", 3, address, draw(st.integers(1, 125)))
    if function == 6:
        return struct.pack(">BHH", 6, address, draw(st.integers(0, 0xFFFF)))
    if function == 16:
        values = draw(st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=123))
        return struct.pack(f">BHHB{len(values)}H", 16, address, len(values), 2 * len(values), *values)
    count = draw(st.integers(1, 300))
    bits = draw(st.integers(0, (1 << count) - 1))
    data = bits.to_bytes((count + 7) // 8, "little")
    return struct.pack(">BHHB", 15, address, count, len(data)) + data


def expected(routes: Sequence[Route], unit: int, pdu: bytes) -> tuple[str, int, list[bytes]] | int | None:
    """By the words of the rules: line, unit and PDUs behind, an exception code, or None for silence."""
    function, address, word = struct.unpack(">BHH", pdu[:5])
    count = 1 if function == 6 else word
    is_bits = function in (1, 15)
    wanted = range(address, address + count)
    for route in routes:
        if unit not in route.units or (route.functions and function not in route.functions):
            continue
        if route.addresses is not None:
            if (route.addresses.table is Table.COILS) != is_bits:
                continue
            inside = [n for n in wanted if route.addresses.first <= n < route.addresses.end]
            if not inside:
                continue
            if len(inside) < count:
                return 2
        if route.action is RouteAction.REFUSE:
            return 4
        if route.action is RouteAction.DROP:
            return None
        if address + route.shift < 0:
            return 2
        limit = route.max_bits if is_bits else route.max_registers
        if limit is None or function == 6 or (function in (15, 16) and not route.split_writes):
            limit = count
        return (
            route.upstream,
            route.unit or unit,
            [_piece(pdu, at, min(limit, count - at), address + route.shift) for at in range(0, count, limit)],
        )
    return 0x0A


def _piece(pdu: bytes, at: int, count: int, address: int) -> bytes:
    """A part of a request, ``count`` items from the one at ``at``; ``address`` is that of the first of all."""
    function = pdu[0]
    if function == 6:
        return struct.pack(">BH", 6, address) + pdu[3:]
    head = struct.pack(">BHH", function, address + at, count)
    if function == 16:
        data = pdu[6 + 2 * at :][: 2 * count]
        return head + bytes((len(data),)) + data
    if function == 15:
        bits = int.from_bytes(pdu[6:], "little") >> at & (1 << count) - 1
        return head + bytes(((count + 7) // 8,)) + bits.to_bytes((count + 7) // 8, "little")
    return head


def _line(name: str, devices: dict[int, PlainDevice]) -> tuple[Upstream, InstantLink]:
    line = Upstream(name, link_settings("tcp://127.0.0.1:1", {}))
    link = InstantLink(devices)
    line.links.append(link)  # type: ignore[arg-type]  # instead of a connection
    return line, link


@settings(max_examples=examples(150), deadline=None)
@given(
    st.lists(ROUTES, min_size=1, max_size=4),
    st.lists(st.tuples(st.integers(1, 5), pdus()), min_size=1, max_size=6),
)
def test_what_reaches_the_devices_and_what_comes_back_is_what_the_rules_say(
    routes: list[Route], requests: list[tuple[int, bytes]]
) -> None:
    try:
        table = RoutingTable(tuple(routes))
    except busway.ConfigError:
        return  # a route that can never be reached
    behind: dict[str, dict[int, PlainDevice]] = {"a": {}, "b": {}}
    model: dict[str, dict[int, PlainDevice]] = {"a": {}, "b": {}}
    lines = {name: _line(name, devices) for name, devices in behind.items()}
    handler = ListenerRouter("office", busway.STANDARD)
    forwarders = {name: Forwarder(line) for name, (line, _) in lines.items()}
    handler.follow(table.of_listener("office"), forwarders)
    for unit, pdu in requests:
        for _, link in lines.values():
            link.asked.clear()
        reply = asked_by(handler, unit, pdu)
        found = expected(routes, unit, pdu)
        asked = {name: list(link.asked) for name, (_, link) in lines.items() if link.asked}
        if not isinstance(found, tuple):
            assert asked == {}
            assert reply == (None if found is None else bytes((pdu[0] | 0x80, found)))
            continue
        name, upstream_unit, pieces = found
        assert asked == {name: [(upstream_unit, piece) for piece in pieces]}
        device = model[name].setdefault(upstream_unit, PlainDevice())
        answers = [device.answer(piece) for piece in pieces]
        bad = next((one for one in answers if one[0] & 0x80), None)
        if bad is not None:
            assert reply == bad
        elif pdu[0] in (6, 15, 16):
            assert reply == pdu[:5]
        else:
            assert reply == _whole(pdu, answers, pieces)
    for name, devices in behind.items():
        assert {unit: (one.registers, one.coils) for unit, one in devices.items()} == {
            unit: (one.registers, one.coils) for unit, one in model[name].items()
        }
        assert forwarders[name].open_requests == 0


def _whole(pdu: bytes, answers: list[bytes], pieces: list[bytes]) -> bytes:
    """One answer out of those to the parts of a read."""
    if pdu[0] == 3:
        data = b"".join(one[2:] for one in answers)
        return bytes((3, len(data))) + data
    bits: list[int] = []
    for answer, piece in zip(answers, pieces, strict=True):
        count = struct.unpack(">H", piece[3:5])[0]
        bits += [int.from_bytes(answer[2:], "little") >> n & 1 for n in range(count)]
    size = (len(bits) + 7) // 8
    return bytes((1, size)) + sum(bit << n for n, bit in enumerate(bits)).to_bytes(size, "little")


# --- memory --------------------------------------------------------------------------------------


@dataclass
class Chronicle:
    """A device whose registers say when they changed.

    Attributes:
        changes: by register, each change: when, and to what.
    """

    clock: FakeClock
    changes: list[list[tuple[float, int]]] = field(default_factory=lambda: [[(0.0, 0)] for _ in range(40)])
    number: int = 0

    def change(self, address: int) -> int:
        self.number += 1
        self.changes[address].append((self.clock.now(), self.number))
        return self.number

    def answer(self, pdu: bytes) -> bytes:
        function, address, word = struct.unpack(">BHH", pdu[:5])
        if function == 6:
            self.changes[address].append((self.clock.now(), word))
            return pdu
        return bytes((3, 2 * word)) + struct.pack(f">{word}H", *(one[-1][1] for one in self.changes[address:][:word]))

    def held(self, address: int, value: int, since: float) -> bool:
        """Whether a register held a value at some moment from ``since`` on."""
        history = self.changes[address]
        return any(
            one[1] == value and (n + 1 == len(history) or history[n + 1][0] >= since) for n, one in enumerate(history)
        )


STEPS = st.one_of(
    st.tuples(st.just("wait"), st.floats(0.0, 3.0), st.just(0)),
    st.tuples(st.just("read"), st.integers(0, 20), st.integers(1, 20)),
    st.tuples(st.just("read"), st.integers(0, 20), st.integers(1, 20)),
    st.tuples(st.just("change"), st.integers(0, 39), st.just(0)),
    st.tuples(st.just("write"), st.integers(0, 39), st.sampled_from([1, 1, 1, 255])),
)


@settings(max_examples=examples(150), deadline=None)
@given(st.lists(STEPS, max_size=40), st.sampled_from([0.5, 1.0, 2.0]), st.sampled_from([None, 3]))
def test_a_remembered_value_is_never_older_than_its_time_to_live_nor_than_a_write(
    steps: list[tuple[str, Any, int]], live: float, limit: int | None
) -> None:
    clock = FakeClock(100.0)
    device = Chronicle(clock)
    link = InstantLink(dict.fromkeys((1, 255), device))  # type: ignore[arg-type]  # 255 is the device itself
    line = Upstream("line", link_settings("tcp://127.0.0.1:1", {}), clock=clock.now)
    line.links.append(link)  # type: ignore[arg-type]
    handler = ListenerRouter("office", busway.STANDARD)
    route = Route(upstream="line", units=frozenset({1, 255}), cache=live, max_registers=limit)
    handler.follow(RoutingTable((route,)).of_listener("office"), {"line": Forwarder(line)})
    written: dict[int, tuple[float, int]] = {}  # when a client last saw a write end
    for action, number, extra in steps:
        if action == "wait":
            clock.advance(number)
        elif action == "change":
            device.change(number)
        elif action == "write":
            value = device.number = device.number + 1
            assert asked_by(handler, extra, struct.pack(">BHH", 6, number, value)) is not None
            written[number] = (clock.now(), value)
        else:
            reply = asked_by(handler, 1, struct.pack(">BHH", 3, number, extra))
            assert reply is not None
            for at, value in enumerate(struct.unpack(f">{extra}H", reply[2:])):
                assert device.held(number + at, value, clock.now() - live)
                assert value >= written.get(number + at, (0.0, 0))[1]
    counters = line.counters
    assert counters.recalled + counters.answered == sum(one[0] in ("read", "write") for one in steps)


def test_a_remembered_value_is_used_at_all() -> None:
    """Or the property above would say nothing."""
    clock = FakeClock(100.0)
    link = InstantLink({1: PlainDevice()})
    line = Upstream("line", link_settings("tcp://127.0.0.1:1", {}), clock=clock.now)
    line.links.append(link)  # type: ignore[arg-type]
    handler = ListenerRouter("office", busway.STANDARD)
    handler.follow(RoutingTable((Route(upstream="line", cache=1.0),)).of_listener("office"), {"line": Forwarder(line)})
    for seconds, requests in ((0.0, 1), (0.5, 1), (0.49, 1), (0.02, 2)):
        clock.advance(seconds)
        assert asked_by(handler, 1, bytes.fromhex("03 0001 0001")) == bytes.fromhex("03 02 0007")
        assert len(link.asked) == requests

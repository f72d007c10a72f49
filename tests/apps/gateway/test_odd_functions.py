"""Functions that are not declared: carried through serial lines of either kind, on both sides, byte by byte."""

import contextlib
import itertools
from collections.abc import AsyncIterator

import pytest
from handlers import ScriptedHandler
from whole_frames import line_of_whole_frames

import busway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings
from busway.apps.gateway.routes import Route, RoutingTable
from busway.pdu.exception_response import ExceptionResponse
from busway.pdu.fields import u16
from busway.pdu.functions import STANDARD, AnyRequest, FunctionTable
from busway.pdu.message import ReplyMessage, Request
from busway.pdu.unknown_functions import OpaqueRequest
from busway.server.listener import Listener
from busway.session.responder import Responder, ResponderAnswer, ServedUnit

BAUD = 115_200
SIZES = (0, 1, 2, 3, 7, 61, 252)
"""With 62 bytes one of the answers begins with a whole frame and its check: a pause just there would make two of it."""

pytestmark = [pytest.mark.clause("T32"), pytest.mark.clause("S8"), pytest.mark.real_time]


class Serving(ScriptedHandler):
    """Says which units are its own, so that it may stand on a line."""

    def serves(self, unit: int) -> ServedUnit | None:
        """Unit 3."""
        return ServedUnit(unit) if unit == 3 else None


@contextlib.asynccontextmanager
async def between(
    listener: str, line: str, handler: Responder, functions: FunctionTable = STANDARD, line_timeout: float = 2.0
) -> AsyncIterator[busway.AsyncUnit]:
    """Unit 3 of ``handler`` on a line, seen through a gateway."""
    with contextlib.ExitStack() as stack:

        def ends(scheme: str) -> tuple[str, str]:
            if scheme not in ("rtu", "ascii"):
                return f"{scheme}://127.0.0.1:0", ""
            wire = stack.enter_context(line_of_whole_frames(ports=2, baud=BAUD, data_bits=8 if scheme == "rtu" else 7))
            return tuple(f"{scheme}://{path}?baud={BAUD}" for path in wire.paths)  # type: ignore[return-value]

        outer, inner = ends(listener), ends(line)
        async with busway.serve(inner[0], responder=handler) as server:
            plan = GatewayPlan(
                (GatewayListener("office", Listener(outer[0])),),
                (UpstreamSettings.of("line", inner[1] or server.endpoints[0], timeout=line_timeout),),
                RoutingTable((Route(upstream="line", units=frozenset({3})),)),
                functions=functions,
                own_unit=None,
            )
            async with (
                Gateway(plan) as gateway,
                busway.open(outer[1] or gateway.endpoints[0], timeout=4.0, retries=0) as link,
            ):
                yield link.unit(3)


ATTEMPTS = 6
"""Silence ends a frame of unknown length, and a pause of the machine within one is silence: then it is asked again."""


async def ask(unit: busway.AsyncUnit, request: OpaqueRequest) -> busway.Message:
    """The reply, to the first attempt in which the machine did not pause."""
    for _ in range(ATTEMPTS - 1):
        with contextlib.suppress(busway.WriteOutcomeUnknown):
            return await unit.execute(request)
    return await unit.execute(request)


def turned_round(context: busway.RequestContext, request: AnyRequest) -> busway.Message:
    """The data backwards, with one byte more; 0x42 is refused."""
    assert isinstance(request, OpaqueRequest)
    if request.function == 0x42:
        return ExceptionResponse(0x42, 0x55)
    return OpaqueRequest(request.function, (request.data[::-1] + b"!")[:252])


@pytest.mark.parametrize(
    ("listener", "line"), [("tcp", "rtu"), ("rtu", "tcp"), ("rtu", "rtu"), ("ascii", "rtu"), ("rtu+tcp", "ascii")]
)
async def test_unknown_functions_of_any_length_go_through_unread(listener: str, line: str) -> None:
    async with between(listener, line, Serving(turned_round)) as unit:
        for function, size in itertools.product((0x41, 0x64, 0x7F), SIZES):
            data = bytes((function + n) & 0xFF for n in range(size))
            reply = await ask(unit, OpaqueRequest(function, data))
            assert reply.encode() == bytes((function,)) + (data[::-1] + b"!")[:252]
        with pytest.raises(busway.ExceptionReply) as error:
            await ask(unit, OpaqueRequest(0x42, b"\1\2\3"))
        assert error.value.code == 0x55


@pytest.mark.parametrize(("listener", "line"), [("tcp", "rtu"), ("rtu", "tcp")])
async def test_an_unknown_function_counts_as_a_write(listener: str, line: str) -> None:
    asked: list[bytes] = []

    def silent(context: busway.RequestContext, request: AnyRequest) -> ResponderAnswer:
        asked.append(request.encode())
        return busway.SILENCE

    async with between(listener, line, Serving(silent), line_timeout=0.2) as unit:
        with pytest.raises((busway.WriteOutcomeUnknown, busway.NoReply)):
            await unit.execute(OpaqueRequest(0x41, b"\1"))
        assert len(asked) == 1


class Torque(Request):
    """A user's function: reads a torque."""

    code = 65
    axis: int = u16(0, 9)

    class Reply(ReplyMessage):
        newton_metres: int = u16()


class SetTorque(Request):
    """A user's function: sets a torque; the answer repeats it."""

    code = 66
    is_write = True
    echoes = True
    axis: int = u16(0, 9)
    newton_metres: int = u16()


@pytest.mark.parametrize(
    ("listener", "line"), [("tcp", "tcp"), ("tcp", "rtu"), ("rtu", "tcp"), ("rtu", "rtu"), ("ascii+tcp", "rtu+tcp")]
)
async def test_functions_of_users_are_known_to_the_gateway_that_has_them_in_its_table(listener: str, line: str) -> None:
    functions = STANDARD.with_functions(Torque, SetTorque)
    torques = {axis: 100 * axis for axis in range(10)}

    def decide(context: busway.RequestContext, request: AnyRequest) -> busway.Message:
        if isinstance(request, SetTorque):
            torques[request.axis] = request.newton_metres
            return request
        assert isinstance(request, Torque)
        return Torque.Reply(torques[request.axis])

    async with between(listener, line, Serving(decide, functions), functions) as unit:
        assert await unit.execute(Torque(3)) == Torque.Reply(300)
        await unit.execute(SetTorque(3, 77))
        assert await unit.execute(Torque(3)) == Torque.Reply(77)
        with pytest.raises(busway.ExceptionReply) as error:  # a rule of the function: refused by the gateway
            await unit.execute(OpaqueRequest(65, b"\0\x0a"))
        assert error.value.code == 3

"""Handlers for tests of servers: they do what the test says, and keep what they were asked."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

import busway
from busway.pdu.functions import AnyRequest
from busway.session.responder import ResponderAnswer, ServedUnit

Decide = Callable[[busway.RequestContext, AnyRequest], ResponderAnswer]


def registers(*values: int) -> busway.Message:
    """A reply of function 03."""
    return busway.ReadHoldingRegisters.Reply(b"".join(value.to_bytes(2, "big") for value in values))


@dataclass
class ScriptedHandler:
    """Asks ``decide`` for every request.

    Attributes:
        contexts: of the requests so far.
    """

    decide: Decide
    functions: busway.FunctionTable = busway.STANDARD
    generation: int = 0
    contexts: list[busway.RequestContext] = field(default_factory=list)

    def serves(self, unit: int) -> ServedUnit | None:
        return ServedUnit(unit)

    def answer(self, context: busway.RequestContext, request: AnyRequest) -> ResponderAnswer:
        """As scripted."""
        self.contexts.append(context)
        return self.decide(context, request)


def address_of(request: AnyRequest) -> int:
    """The address that a read of holding registers names."""
    assert isinstance(request, busway.ReadHoldingRegisters)
    return request.address


def later(context: busway.RequestContext, request: AnyRequest) -> ResponderAnswer:
    """A handler that promises a reply and leaves it to the test to give it."""
    return busway.LATER


@dataclass
class HeldReplies:
    """An asynchronous handler that lets requests for address 1000 and above wait until the test opens it.

    Others are answered with their address at once, without waiting.
    """

    opened: asyncio.Event = field(default_factory=asyncio.Event)

    def decide(self, context: busway.RequestContext, request: AnyRequest) -> ResponderAnswer:
        """Whether to wait."""
        address = address_of(request)
        return self._wait(address) if address >= 1000 else registers(address)

    async def _wait(self, address: int) -> busway.Message:
        await self.opened.wait()
        return registers(address)

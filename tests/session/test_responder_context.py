"""What a handler learns of a client that goes away before its late reply."""

from busway.codes import FunctionCode
from busway.pdu.exception_response import ExceptionResponse
from busway.pdu.functions import STANDARD, AnyRequest
from busway.session.diagnostic_counters import LineDiagnostics
from busway.session.responder import LATER, RequestContext, ResponderAnswer, ServedUnit
from busway.session.server_pipeline import RequestPipeline
from busway.session.server_transaction_slots import ServerTransactionSlots
from busway.session.tcp_server import TcpServerSession


class _Promises:
    """Promises every reply, and notes who has gone."""

    functions = STANDARD
    generation = 0

    def __init__(self) -> None:
        self.contexts: list[RequestContext] = []
        self.gone: list[int] = []

    def serves(self, unit: int) -> ServedUnit | None:
        return ServedUnit(unit)

    def answer(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        self.contexts.append(context)
        context.gone = lambda: self.gone.append(context.transaction)
        return LATER


def _session(handler: _Promises, sent: list[bytes]) -> TcpServerSession:
    return TcpServerSession(
        RequestPipeline(handler), diagnostics=LineDiagnostics(), slots=ServerTransactionSlots(16), deliver=sent.append
    )


def _read(transaction: int) -> bytes:
    return bytes((0, transaction, 0, 0, 0, 6, 1, FunctionCode.READ_HOLDING_REGISTERS, 0, 0, 0, 1))


def test_those_whose_reply_is_awaited_are_told_when_their_client_goes():
    handler, sent = _Promises(), list[bytes]()
    session = _session(handler, sent)
    data = _read(1) + _read(2) + _read(3)
    session.receive(data, len(data))
    handler.contexts[1].reply(ExceptionResponse(3, 4))
    session.close()
    assert sorted(handler.gone) == [1, 3]
    assert len(sent) == 1


def test_a_reply_to_a_client_that_has_gone_goes_nowhere():
    handler, sent = _Promises(), list[bytes]()
    session = _session(handler, sent)
    session.receive(_read(1), 12)
    session.close()
    handler.contexts[0].reply(ExceptionResponse(3, 4))
    assert sent == []
    assert handler.contexts[0].replied


def test_who_watches_a_reply_learns_of_it_or_that_the_client_has_gone():
    seen: list[object] = []

    class Watched(_Promises):
        def answer(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
            context.watch(seen.append)
            return super().answer(context, request)

    handler, sent = Watched(), list[bytes]()
    session = _session(handler, sent)
    session.receive(_read(1) + _read(2), 24)
    reply = ExceptionResponse(3, 4)
    handler.contexts[0].reply(reply)
    session.close()
    handler.contexts[1].reply(reply)
    assert seen == [reply, None]
    assert handler.gone == [2]

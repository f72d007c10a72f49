"""The observer of a server's requests that records writes and denied requests in the audit log.

Knows the outcome of requests; decides nothing. Writes on the fast path do not come here: the fast path appends their
lines itself (`busway.access.fast_path_rights`).
"""

from collections.abc import Sequence
from functools import partial

from ..options.networks import host_of_peer
from ..pdu.functions import AnyRequest
from ..pdu.message import Message
from ..session.responder import ClientIdentity, Deferral, RequestContext
from .audit_line import DENIED, audit_line, outcome_of
from .audit_log import AuditLog


class AuditObserver:
    """Observer of a server's requests that appends an audit line for each denied request, and for each write.

    Only writes of the generic path come here; the fast path records its own (`busway.access.fast_path_rights`). The
    first of a client's equal denials gets a line of its own; the later ones get one line with their number.
    """

    def __init__(self, log: AuditLog) -> None:
        self._log = log

    def answered(self, client: ClientIdentity, replies: Sequence[bytes], seconds: float) -> None:
        """Do nothing for requests of the fast path: their writes are recorded already, and reads are not recorded."""

    def unanswered(self, client: ClientIdentity, requests: int) -> None:
        """Do nothing for reads whose client disconnected before the reply: reads are not recorded."""

    def ended(
        self, context: RequestContext, request: AnyRequest, outcome: Message | Deferral | None, seconds: float
    ) -> None:
        """Append an audit line for a request of the generic path that has ended, if it was a write or was denied.

        A denial that the client repeats is only counted. A request without ``context.judged`` is not recorded.
        """
        judged = context.judged
        if judged is None:
            return
        text, code = outcome_of(outcome)
        if judged.is_denied:
            about = host_of_peer(context.peer), context.role or "", judged.rule
            self._log.append_denied(about, partial(self._denied_line, context, request, code))
        elif judged.is_write:
            self._log.append(audit_line(context, request, self._log.timestamp(), text, code))

    def _denied_line(self, context: RequestContext, request: AnyRequest, code: int | None, repeated: int) -> str:
        return audit_line(context, request, self._log.timestamp(), DENIED, code, repeated)

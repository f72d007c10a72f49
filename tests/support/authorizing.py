"""A responder with a policy beside it, as a server has it."""

from collections.abc import Callable, Sequence

from busway.access.audit_log import AuditLog
from busway.access.audit_observer import AuditObserver
from busway.access.authorizer import PolicyAuthorizer
from busway.access.rates import Rates
from busway.access.rules import Policy
from busway.pdu.functions import AnyRequest
from busway.session.responder import RequestContext, Responder, ResponderAnswer
from busway.session.server_pipeline import RequestObserver, RequestPipeline, ResponderFailure


class AuthorizedPipeline(RequestPipeline):
    """A pipeline with a policy.

    Attributes:
        handled: number of requests on the generic path.
    """

    authorizer: PolicyAuthorizer

    def __init__(
        self,
        responder: Responder,
        policy: Policy,
        audit: AuditLog | None = None,
        *,
        rates: dict[str, Rates] | None = None,
        clock: Callable[[], float] = lambda: 0.0,
    ) -> None:
        observers: Sequence[RequestObserver] = () if audit is None else (AuditObserver(audit),)
        super().__init__(responder, PolicyAuthorizer(policy, audit, rates=rates, clock=clock), observers)
        self.replace_policy = self.authorizer.replace_policy
        self.handled = 0

    @property
    def policy(self) -> Policy:
        """The policy in force."""
        return self.authorizer.policy

    @property
    def refusals(self) -> dict[str, int]:
        """Refused requests by rule."""
        return dict(self.authorizer.refusals)

    def answer(self, context: RequestContext, pdu: bytes, failures: list[ResponderFailure]) -> ResponderAnswer:
        """As the pipeline, counted."""
        self.handled += 1
        return super().answer(context, pdu, failures)

    def handle(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        """The outcome of a request on the generic path."""
        return self.answer(context, request.encode(), [])

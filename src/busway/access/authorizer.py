"""The authorizer of a server: permits or denies every request by the rules of a policy (M6, T15).

Knows requests, clients and the policy; executes nothing: the responder does that.

1. A denied request never reaches the responder, except a mask write (function 22) that is decided by the register's
   old value. It is answered with the exception code of the rule: 01, or 02 if a rule about items says so. A permitted
   request above the rate of its rule is answered 06, because the client may try again.
2. The rules that apply to a client are compiled once for all clients with equal rights
   (`busway.access.rule_evaluation`). They decide on the generic path, and what they permit is bound to the fast path
   (`busway.access.fast_path_rights`).
3. A policy can be replaced at any time: ``generation`` changes, and sessions ask for the rights again before their next
   request. No connection is dropped. A rule that has the same name and rate as before goes on counting, so that
   reloading a file lifts no rate limit.
4. While the audit log refuses writes (``on_failure="refuse"``), a write is answered 04 and not executed.
"""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final

from ..codes import BROADCAST_UNIT, ExceptionCode
from ..errors import ConfigError
from ..log_limiter import LogLimiter, suppressed_note
from ..pdu.exception_response import ExceptionResponse
from ..pdu.fast_answers import FastAnswer
from ..pdu.functions import AnyRequest
from ..pdu.message import Request
from ..session.responder import ClientIdentity, Judged, Refusal, Replaced, RequestContext, ServedUnit
from ..values.printable import printable
from .access_request import AccessRequest, AccessSubject
from .fast_path_rights import bind
from .rates import Rates
from .rule_evaluation import Decision, Rights
from .rules import Policy, Rule

if TYPE_CHECKING:
    from .audit_log import AuditLog

_log = logging.getLogger("busway.policy")

_MOST_CLIENTS: Final = 4096
"""Most clients whose rights are kept; beyond that, all are dropped and determined anew."""
_MOST_RIGHTS: Final = 256
"""Most sets of rights that are kept; beyond that, the oldest is dropped."""


class PolicyRights:
    """The rights that a policy gives to clients; the fast path is built from them.

    Attributes:
        rights: the compiled rules.
    """

    __slots__ = ("_audit", "rights")

    def __init__(self, rights: Rights, audit: "AuditLog | None") -> None:
        self.rights: Rights = rights
        self._audit = audit

    def bind(self, unit: int, served: ServedUnit, kind: type[Request]) -> FastAnswer | None:
        """Return the function of the fast path that answers permitted requests of the class ``kind`` from their bytes.

        None if all requests of that class must take the generic path: the policy decides about each, or the device
        gives no direct access to its memory. ``unit`` is the unit asked, 0…255.
        """
        return bind(self.rights, unit, served, kind, self._audit)

    def permits_prepared(self, unit: int, served: ServedUnit | None, request: AnyRequest) -> bool:
        """Whether a gateway or server may cache how it answers a read, so that repetitions of it are not checked again.

        True if the request is no write and is permitted without a rate limit to all clients that have these rights.
        ``unit`` is the unit asked, 0…255. ``served`` is None if no device answers for the unit.
        """
        access_request = AccessRequest.of(
            request, unit=unit, listed=_NO_UNITS if served is None else served.units, subject=_ANY_CLIENT
        )
        decision = self.rights.decide(access_request)
        return decision.allowed and not decision.rates and not access_request.writes


_NO_UNITS: Final[frozenset[int]] = frozenset()
_ANY_CLIENT: Final = AccessSubject()
"""A client without a name, for questions to compiled rights: these hold for any client that has them."""


class _InForce:
    """The policy in use, with caches of the rights compiled from it; replaced as a whole with the policy."""

    __slots__ = ("of_clients", "of_rules", "of_subjects", "policy")

    def __init__(self, policy: Policy) -> None:
        if not isinstance(policy, Policy):
            raise ConfigError(f"must be a Policy, such as Policy.read_only(), not {policy!r}", key="policy")
        self.policy = policy
        self.of_clients: dict[ClientIdentity, tuple[AccessSubject, PolicyRights]] = {}
        # A host that connects anew has the rights it had, and all connections of a host have one subject.
        self.of_subjects: dict[AccessSubject, tuple[AccessSubject, PolicyRights]] = {}
        self.of_rules: dict[tuple[str, ...], PolicyRights] = {}


class PolicyAuthorizer:
    """Permits or denies the requests to a server by a policy, which can be replaced while the server runs.

    Args:
        policy: the rules; None permits every request, until `replace_policy`.
        audit: the audit log, for writes on the fast path; an `AuditObserver` records the others. None records no write.
        rates: token buckets by rule name, for several authorizers that count together; None: this one counts alone.
        clock: monotonic seconds, for rates and for repeated log messages.

    Attributes:
        refusals: number of requests that the policy refused, also those above a rate, by name of the rule that decided
            (``default`` if no rule applied).
        generation: a number that grows by 1 when the policy is replaced.
        has_policy: whether a policy was given, even one that permits everything.

    Raises:
        ConfigError: ``policy`` is no `Policy`.
    """

    def __init__(
        self,
        policy: Policy | None,
        audit: "AuditLog | None" = None,
        *,
        rates: dict[str, Rates] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.refusals: Counter[str] = Counter()
        self.generation: int = 0
        self.has_policy: bool = policy is not None
        self._audit = audit
        self._in_force = _InForce(Policy.allow_all() if policy is None else policy)
        self._lock = threading.Lock()
        self._clock = clock
        self._rates: dict[str, Rates] = {} if rates is None else rates
        self._log_limiter = LogLimiter()

    @property
    def policy(self) -> Policy:
        """The policy that decides requests now."""
        return self._in_force.policy

    def replace_policy(self, policy: Policy) -> None:
        """Use another policy from the next request on; connections stay open. It can be called from any thread.

        Changes `generation`. A rule whose name and rate stay the same goes on counting requests; the counts of other
        rules are dropped, also for other authorizers that were given the same ``rates``.

        Raises:
            ConfigError: it is no `Policy`; the one before holds.
        """
        with self._lock:
            self._in_force = _InForce(policy)
            self.has_policy = True
            rates = {rule.name: rule.rate for rule in policy.rules}
            for name, counted in list(self._rates.items()):
                if rates.get(name) != counted.rate:
                    self._rates.pop(name, None)
            self.generation += 1

    def rights_of(self, client: ClientIdentity) -> PolicyRights:
        """Return what the policy permits to a client, from a cache or determined now.

        Clients to whom the same rules apply get the same object, until the policy is replaced or the cache is full.
        """
        return self._known(client)[1]

    def authorize(
        self, context: RequestContext, request: AnyRequest, served: ServedUnit | None
    ) -> ExceptionResponse | None:
        """Return None if a request may be executed, otherwise the exception reply that refuses it.

        A request is refused by the policy, or, if it is a write and the audit log takes none now, with exception 04.
        What the policy refuses is counted in `refusals`, logged, and marked as denied in ``context.judged``. For a
        permitted request, ``context.judged`` has the name of the rule; it stays None only if the policy permits
        everything and there is no audit log.

        Function 22 (mask write) can depend on the register's old value if a rule bounds the values. Then it is
        permitted for now if the device is in this process, and decided when the responder reports that value
        (`RequestContext.replacing`). ``served`` is None if no device answers for the unit.
        """
        subject, known = self._known(context.client)
        rights = known.rights
        if rights.permits_all and self._audit is None:
            return None
        listed = _NO_UNITS if served is None else served.units
        access_request = AccessRequest.of(request, unit=context.unit, listed=listed, subject=subject)
        decision = rights.decide(access_request)
        if context.executed is not None:
            decision = _denied_to_all(rights, access_request) or decision
        waits = decision.needs_current and served is not None and served.device is not None
        if not waits:
            if decision.allowed:
                decision = self._too_fast(decision, subject, context.executed) or decision
            if not decision.allowed:
                return self._refuse(context, subject, decision)
        is_write = waits or (access_request.writes and self._audit is not None)
        judged = context.judged = Judged(decision.rule_name, is_write=is_write)
        if waits:
            judged.check = partial(self._judge, context, rights, access_request)
        if is_write and self._audit is not None and not self._audit.takes_writes:
            return ExceptionResponse(context.function, ExceptionCode.SERVER_DEVICE_FAILURE)
        return None

    def _judge(
        self, context: RequestContext, rights: Rights, access_request: AccessRequest, replaced: Replaced
    ) -> None:
        """Decide about a mask write (function 22) when the responder reports the old register value.

        Raises `Refusal` if the policy refuses the write, also if the value in ``replaced`` is None (unknown) and the
        masks alone do not keep the result within the limits.
        """
        current = replaced[0] if replaced else None
        if current is not None:
            access_request = access_request.with_current(int.from_bytes(current, "big"))
        decision = rights.decide(access_request)
        if decision.allowed:
            decision = self._too_fast(decision, access_request.subject, context.executed) or decision
        if not decision.allowed:
            self._refuse(context, access_request.subject, decision)
            raise Refusal(decision.code, decision.reason)
        assert context.judged is not None
        context.judged.rule = decision.rule_name

    def refusal_of(self, context: RequestContext, request: AnyRequest, units: Iterable[int], charged: set[int]) -> int:
        """Return the exception code that refuses a request to several units; 0 if it is permitted for all of them.

        A rule with a rate counts the request once, whatever the number of units. A refusal is counted, logged and
        marked as denied in ``context.judged``, like that of a request to one unit.

        Args:
            context: the context of the request as received. If it is no broadcast, the rules for ``context.unit`` have
                counted the request already.
            request: the request.
            units: the units that the request reaches, 0…255.
            charged: ids (``id(rule)``) of the rules that have counted the request already; rules that count it now are
                added.
        """
        subject, known = self._known(context.client)
        rights = known.rights
        if rights.permits_all:
            return 0

        def decided(unit: int) -> Decision:
            return rights.decide(AccessRequest.of(request, unit=unit, subject=subject))

        if context.executed is None:  # it was taken as a request to its own unit before it came here
            charged.update(map(id, decided(context.unit).rates))
        rates: dict[int, Rule] = {}
        for unit in units:
            decision = decided(unit)
            if not decision.allowed:
                self._refuse(context, subject, decision)
                return decision.code
            rates |= {id(rule): rule for rule in decision.rates}
        too_fast = self._too_fast(Decision(True, rates=tuple(rates.values())), subject, charged)
        if too_fast is None:
            return 0
        self._refuse(context, subject, too_fast)
        return too_fast.code

    def _refuse(self, context: RequestContext, subject: AccessSubject, decision: Decision) -> ExceptionResponse:
        rule = decision.rule_name
        context.judged = Judged(rule, is_denied=True)
        self.refusals[rule] += 1
        repeated = self._log_limiter.admit(f"{rule} {subject.host}", self._clock())
        if repeated is not None:
            _log.warning(
                "%s: function %d of unit %d refused with %d by %s: %s%s",
                context.peer,
                context.function,
                context.unit,
                decision.code,
                rule,
                printable(decision.reason),
                suppressed_note(repeated),
            )
        return ExceptionResponse(context.function, decision.code)

    def _too_fast(self, decision: Decision, subject: AccessSubject, charged: set[int] | None) -> Decision | None:
        """Count a permitted request against the rates of its rules; return its refusal if it is above one, else None.

        The rules are taken in order up to the first whose rate is exceeded; those before it have counted the request.

        Args:
            decision: the permission, with its rules in ``rates``.
            subject: the client.
            charged: ids (``id(rule)``) of the rules that have counted this request already, so that a broadcast counts
                once; rules that count it now are added. None for a request to one unit.
        """
        for rule in decision.rates:
            if charged is not None and id(rule) in charged:
                continue
            assert rule.rate is not None  # that is why it is among them
            rates = self._rates.get(rule.name)
            if rates is None or rates.rate != rule.rate:
                rates = self._rates[rule.name] = Rates(rule.rate)
            if not rates.allows(subject.host, self._clock()):
                return _busy(rule)
            if charged is not None:
                charged.add(id(rule))
        return None

    def _known(self, client: ClientIdentity) -> tuple[AccessSubject, PolicyRights]:
        """Return a client's host, role and listener, as rules compare them, and its rights: from a cache if known."""
        in_force = self._in_force
        found = in_force.of_clients.get(client)
        if found is None:
            if len(in_force.of_clients) >= _MOST_CLIENTS:
                in_force.of_clients.clear()
            subject = AccessSubject(client.host, client.role, client.listener, client.listener_names)
            found = in_force.of_clients[client] = _known_subject(subject, in_force, self._audit)
        return found


def _denied_to_all(rights: Rights, access_request: AccessRequest) -> Decision | None:
    """Return the refusal of a broadcast if a rule that names unit 0 denies it; else None.

    A permission for unit 0 is not enough: a broadcast must be permitted for each unit that receives it.
    """
    decision = rights.decide(replace(access_request, unit=BROADCAST_UNIT, listed=_NO_UNITS))
    is_named = decision.rule is not None and decision.rule.units is not None
    return decision if is_named and not decision.allowed and not decision.needs_current else None


def _known_subject(
    subject: AccessSubject, in_force: _InForce, audit: "AuditLog | None"
) -> tuple[AccessSubject, PolicyRights]:
    """Return the subject that is equal to ``subject`` and known already, or ``subject`` itself, with its rights."""
    known = in_force.of_subjects.get(subject)
    if known is not None:
        return known
    if len(in_force.of_subjects) >= _MOST_CLIENTS:
        in_force.of_subjects.clear()
    rules = in_force.policy.rules_for(subject)
    key = tuple(rule.name for rule in rules)
    found = in_force.of_rules.get(key)
    if found is None:
        if len(in_force.of_rules) >= _MOST_RIGHTS:
            del in_force.of_rules[next(iter(in_force.of_rules))]
        found = in_force.of_rules[key] = PolicyRights(Rights(rules, in_force.policy.default), audit)
    known = in_force.of_subjects[subject] = subject, found
    return known


def _busy(rule: Rule) -> Decision:
    """Return the refusal (exception code 06) of a permitted request that is above the rate of its rule."""
    return Decision(False, int(ExceptionCode.SERVER_DEVICE_BUSY), rule, f"more than {rule.rate:g} requests a second")

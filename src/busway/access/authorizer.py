"""The authorizer: a handler wrapper that checks every request against a policy and writes the audit log (M6, T15).

Knows requests, contexts and the policy; knows no connection and no device.

1. A denied request never reaches the wrapped handler. It is answered with the exception code of the rule: 01, or 02
   where a rule about items chooses it. A permitted request above the rate of its rule is answered 06, because the
   client may try again.
2. The compiled path and the read plans contain only what the rights of the client permit (`busway.access.compiled`).
   Clients with equal rights share plans; clients with other rights never use them.
3. Every write and every denied request is recorded in the audit log, on every path; repeated denials of a client are
   recorded as one line with their number. Writes on the compiled path write their own lines (`busway.access.writes`).
4. A policy can be replaced at any time: ``generation`` changes, and sessions ask again before their next request.
   No connection is dropped.
5. With ``on_failure="refuse"``, a write is answered 04 and not executed while the log cannot be written.
"""

import logging
import threading
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Container, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final

from ..codes import ExceptionCode
from ..options.networks import host_of_peer
from ..pdu.direct import Answer, ReadPlan
from ..pdu.functions import AnyRequest, FunctionTable
from ..pdu.general import ExceptionResponse
from ..pdu.message import Message, Request
from ..session.forwarding import ForwardPlan, ForwardPlans, ReadForwarder
from ..session.handler import (
    LATER,
    SILENCE,
    Deferral,
    Handler,
    ListedUnits,
    Outcome,
    ReadPlanner,
    Refusal,
    RequestContext,
    UnitHolder,
    WriteObserver,
)
from ..values.printable import printable
from .audit import AuditLog
from .compiled import noted_writes, permitted_answers
from .decisions import decision_key
from .entries import DENIED, NO_ANSWER, Entry, Replaced, WallClock, outcome_of, who_text
from .question import Asker, Question
from .rates import Rates
from .repeats import Repeats, so_often
from .rules import Action, Decision, Policy, Rule
from .writes import NotedWrites, WriteLines, with_lines

_log = logging.getLogger("busway.policy")

_MOST_ASKERS: Final = 4096
"""Most peers whose rights are cached; beyond that, the cache is cleared."""
_MOST_DECISIONS: Final = 1024
"""Most decisions cached for each set of rights; beyond that, the cache is cleared."""
_MOST_RIGHTS: Final = 256
"""Most sets of rights whose plans are shared; beyond that, the oldest is dropped."""


@dataclass(frozen=True, slots=True)
class _Offer:
    """Compiled answers for one unit, shared by clients with equal rights.

    Attributes:
        of: the answers of the wrapped handler that these were made from.
        answers: answers that need no audit line.
        writes: audited writes, which each client gets with lines of its own; None without any.
    """

    of: Mapping[int, Answer]
    answers: Mapping[int, Answer]
    writes: NotedWrites | None


class _Rights:
    """A set of rights: the rules that apply to some clients, and the answers, plans and decisions they share."""

    __slots__ = ("decided", "forwards", "has_limits", "offers", "permits_all", "plans", "policy")

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        # No rule applies to them: saves 9 µs of each request on the generic path, which every gateway request takes.
        self.permits_all = not policy.rules and policy.default is Action.ALLOW
        self.has_limits = any(rule.limits is not None for rule in policy.rules)
        self.offers: dict[tuple[int, int | None], _Offer] = {}  # by unit asked and listed
        self.decided: dict[object, tuple[Decision, bool]] = {}  # and whether it is about a write
        # By the plans of the handler inside, which may tell askers apart by more than the policy does.
        self.plans: dict[int, tuple[object, dict[bytes, ReadPlan]]] = {}
        self.forwards: dict[int, tuple[object, ForwardPlans]] = {}


class _Known:
    """A client with its rights and its part of an audit line, looked up once."""

    __slots__ = ("asker", "rights", "who")

    def __init__(self, asker: Asker, rights: _Rights, who: str) -> None:
        self.asker = asker
        self.rights = rights
        self.who = who


class _InForce:
    """A policy and all that is cached from it. Replaced as a whole, so that no cache outlives its policy.

    Args:
        policy: the policy.
        inside: generation of the wrapped handler when the plans were made.
    """

    __slots__ = ("askers", "inside", "policy", "rights", "rights_of_hosts")

    def __init__(self, policy: Policy, inside: int) -> None:
        self.policy = policy
        self.inside = inside
        self.askers: dict[tuple[str, str | None, str], _Known] = {}
        self.rights: dict[tuple[str, ...], _Rights] = {}
        self.rights_of_hosts: dict[Asker, _Rights] = {}  # a host that connects anew has the rights it had


class _Denied(Refusal):
    """A refusal by the policy, raised when the wrapped handler shows the values that a write would replace."""

    def __init__(self, decision: Decision) -> None:
        super().__init__(decision.code, decision.reason)
        self.decision = decision


class PolicyHandler:
    """A handler that lets another handler answer only the requests that a policy permits.

    Args:
        inner: the wrapped handler, which answers permitted requests.
        policy: the rules.
        audit: the audit log for writes and denied requests; None for no log.
        rates: token buckets by rule name, for several handlers that count together.
        clock: monotonic seconds, for rates.
        now: seconds since 1970, for audit lines.

    Attributes:
        refusals: number of refused requests by name of the rule (``default`` where none decided).
        serial_units, listed_unit: those of the wrapped handler, if it has them.
        forward_plans, forward_plan: those of the wrapped handler, if it is a `ReadForwarder`: reads that are permitted
            without a rate are forwarded as without a policy.
    """

    serial_units: Container[int]
    listed_unit: Callable[[int], int]
    forward_plans: Callable[[RequestContext], ForwardPlans]
    forward_plan: Callable[[RequestContext, bytes], ForwardPlan | None]

    def __init__(
        self,
        inner: Handler,
        policy: Policy,
        audit: AuditLog | None = None,
        *,
        rates: dict[str, Rates] | None = None,
        clock: Callable[[], float] = time.monotonic,
        now: Callable[[], float] = time.time,
    ) -> None:
        self.inner = inner
        self.audit = audit
        self.refusals: Counter[str] = Counter()
        self._in_force = _InForce(policy, inner.generation)
        self._lock = threading.Lock()
        self._clock = clock
        self._time = WallClock(now)
        self._replaced_policies = 0
        self._planner = inner if isinstance(inner, ReadPlanner) else None
        self._observer = inner if isinstance(inner, WriteObserver) else None
        self._names = inner if isinstance(inner, ListedUnits) else None
        # Set only where the wrapped handler has it, so that an isinstance test against `UnitHolder` stays right.
        if isinstance(inner, UnitHolder):
            self.serial_units = inner.serial_units
        if isinstance(inner, ListedUnits):
            self.listed_unit = inner.listed_unit
        if isinstance(inner, ReadForwarder):
            self.forward_plans = partial(self._forward_plans, inner)
            self.forward_plan = partial(self._forward_plan, inner)
        self._rates: dict[str, Rates] = {} if rates is None else rates
        self._repeats = Repeats()

    @property
    def functions(self) -> FunctionTable:
        """The functions of the wrapped handler."""
        return self.inner.functions

    @property
    def generation(self) -> int:
        """A number that changes with the policy and with the wrapped handler."""
        return self.inner.generation + self._replaced_policies

    @property
    def policy(self) -> Policy:
        """The policy in force."""
        return self._in_force.policy

    def replace_policy(self, policy: Policy) -> None:
        """Replace the policy, from the next request on; connections stay open. May be called from any thread."""
        with self._lock:
            self._in_force = _InForce(policy, self.inner.generation)
            self._rates.clear()
            self._replaced_policies += 1

    # ---- the compiled path

    def direct(self, context: RequestContext) -> Mapping[int, Answer]:
        """The compiled answers of the wrapped handler that the client may use without a further check."""
        answers = self.inner.direct(context)
        if not answers:
            return answers
        known = self._known(context)
        listed = self._listed(context)
        offered = known.rights.offers.get((context.unit, listed))
        if offered is None or offered.of is not answers:
            offered = self._offer(known.rights, context.unit, listed, answers)
        if self.audit is None or offered.writes is None:
            return offered.answers
        return with_lines(offered.answers, offered.writes, WriteLines(self.audit, self._time, known.who, context.unit))

    def _offer(self, rights: _Rights, unit: int, listed: int | None, answers: Mapping[int, Answer]) -> _Offer:
        """Compile and cache the answers of one unit for one set of rights."""
        functions, audited = self.inner.functions, self.audit is not None
        offered = rights.offers[unit, listed] = _Offer(
            answers,
            permitted_answers(rights.policy, unit, functions, answers, audited=audited, listed=listed),
            noted_writes(rights.policy, unit, functions, answers, listed=listed) if audited else None,
        )
        return offered

    def plans(self, context: RequestContext) -> dict[bytes, ReadPlan]:
        """Read plans, shared by clients with equal rights."""
        if self._planner is None:
            return {}
        inside = self._planner.plans(context)
        found = self._known(context).rights.plans
        if len(found) >= _MOST_RIGHTS:
            found.clear()
        return found.setdefault(id(inside), (inside, {}))[1]

    def plan(self, context: RequestContext, pdu: bytes) -> ReadPlan | None:
        """The plan of a read; None unless the read is permitted without a rate."""
        if self._planner is None:
            return None
        known = self._known(context)
        request = self.functions.decode_request(pdu)
        decision, writes = self._decide(context, request, known)
        if not decision.allowed or decision.rates or writes:
            return None
        return self._planner.plan(context, pdu)

    def _forward_plans(self, inner: ReadForwarder, context: RequestContext) -> ForwardPlans:
        """Plans of forwarded reads, shared by clients with equal rights."""
        inside = inner.forward_plans(context)
        found = self._known(context).rights.forwards
        if len(found) >= _MOST_RIGHTS:
            found.clear()
        return found.setdefault(id(inside), (inside, ForwardPlans()))[1]

    def _forward_plan(self, inner: ReadForwarder, context: RequestContext, pdu: bytes) -> ForwardPlan | None:
        """The plan of a forwarded read; None unless the read is permitted without a rate."""
        request = self.functions.decode_request(pdu)
        decision, writes = self._decide(context, request, self._known(context))
        if not decision.allowed or decision.rates or writes:
            return None
        return inner.forward_plan(context, pdu)

    # ---- the generic path

    def handle(self, context: RequestContext, request: AnyRequest) -> Outcome:
        """Check a request against the policy, and let the wrapped handler answer it if it is permitted."""
        known = self._known(context)
        if known.rights.permits_all and self.audit is None:
            return self.inner.handle(context, request)
        decision, writes = self._decide(context, request, known)
        if decision.needs_current and self._observer is not None and isinstance(request, Request):
            return self._write(context, request, known, decision)
        if not decision.allowed:
            return self._refuse(context, request, known, decision)
        too_fast = self._too_fast(decision, known.asker, context.executed)
        if too_fast is not None:
            return self._refuse(context, request, known, too_fast)
        if self.audit is None or not writes:
            return self.inner.handle(context, request)
        return self._write(context, request, known, decision)

    def _decide(self, context: RequestContext, request: AnyRequest, known: _Known) -> tuple[Decision, bool]:
        """The decision of the policy, and whether the request is a write. Cached for equal requests."""
        rights = known.rights
        key = decision_key(request, context.unit, self._listed(context), limits=rights.has_limits)
        decided = rights.decided.get(key)
        if decided is None:
            question = self._question(context, request, known)
            decided = rights.policy.decide(question), question.writes
            if key is not None:
                if len(rights.decided) >= _MOST_DECISIONS:
                    rights.decided.clear()
                rights.decided[key] = decided
        return decided

    def _question(self, context: RequestContext, request: AnyRequest, known: _Known) -> Question:
        return Question.of(request, unit=context.unit, listed=self._listed(context), asker=known.asker)

    def refusal_of(self, context: RequestContext, request: AnyRequest, units: Iterable[int], charged: set[int]) -> int:
        """The exception code that refuses a request to several units; 0 if it is permitted for all of them.

        For requests that reach several units at once. A rule with a rate counts it as one request, however many of the
        units it is about. Nothing else is counted, and nothing is recorded in the audit log.

        Args:
            context: of the request as it was received.
            request: the request.
            units: the units that it reaches.
            charged: ids of the rules that have counted it already; rules that count it now are added.
        """
        known = self._known(context)
        if known.rights.permits_all:
            return 0
        if context.executed is None:  # it was taken as a request to its own unit before it came here
            charged.update(map(id, self._decided_for(context.unit, request, known).rates))
        rates: dict[int, Rule] = {}
        for unit in units:
            decision = self._decided_for(unit, request, known)
            if not decision.allowed:
                return decision.code
            rates |= {id(rule): rule for rule in decision.rates}
        too_fast = self._too_fast(Decision(True, rates=tuple(rates.values())), known.asker, charged)
        return 0 if too_fast is None else too_fast.code

    def _decided_for(self, unit: int, request: AnyRequest, known: _Known) -> Decision:
        return known.rights.policy.decide(Question.of(request, unit=unit, asker=known.asker))

    def _refuse(self, context: RequestContext, request: AnyRequest, known: _Known, decision: Decision) -> Message:
        rule = decision.rule_name
        self.refusals[rule] += 1
        repeated = self._repeats.again(f"{rule} {known.asker.host}", self._clock())
        if repeated is not None:
            _log.warning(
                "%s: function %d of unit %d refused with %d by %s: %s%s",
                context.peer,
                context.function,
                context.unit,
                decision.code,
                rule,
                printable(decision.reason),
                so_often(repeated),
            )
        if self.audit is not None:
            entry = Entry(known.who, context, request)
            entry.rule = rule
            about = known.asker.host, known.asker.role or "", rule
            self.audit.append_denied(about, partial(self._denied_line, entry, decision.code))
        return ExceptionResponse(context.function, decision.code)

    def _denied_line(self, entry: Entry, code: int, repeated: int) -> str:
        return entry.line(self._time(), DENIED, code, repeated)

    def _too_fast(self, decision: Decision, asker: Asker, charged: set[int] | None) -> Decision | None:
        """The refusal of a request above the rate of a rule; None within all rates.

        ``charged`` holds the ids of rules that have counted the request already, so that a broadcast counts once.
        """
        for rule in decision.rates:
            if charged is not None and id(rule) in charged:
                continue
            assert rule.rate is not None  # that is why it is among them
            rates = self._rates.get(rule.name)
            if rates is None or rates.rate != rule.rate:
                rates = self._rates[rule.name] = Rates(rule.rate)
            if not rates.allows(asker.host, self._clock()):
                return _busy(rule)
            if charged is not None:
                charged.add(id(rule))
        return None

    def _write(self, context: RequestContext, request: AnyRequest, known: _Known, decision: Decision) -> Outcome:
        """Execute a write and record it; function 22 is first checked against the value that it changes."""
        entry = Entry(known.who, context, request)
        entry.rule = decision.rule_name
        if self.audit is not None and not self.audit.takes_writes:
            return self._finish(entry, ExceptionResponse(context.function, ExceptionCode.SERVER_DEVICE_FAILURE))

        def see(replaced: Replaced) -> None:
            if decision.needs_current:
                current = replaced[0] if replaced else None
                judged = decision
                if current is not None:
                    question = self._question(context, request, known).with_current(int.from_bytes(current, "big"))
                    judged = known.rights.policy.decide(question)
                if judged.allowed:
                    judged = self._too_fast(judged, known.asker, context.executed) or judged
                if not judged.allowed:
                    raise _Denied(judged)
                entry.rule = judged.rule_name
            entry.replaced = replaced

        if self.audit is not None and context.executed is None:
            context.watch(lambda reply: self._note(entry, *outcome_of(reply)), gone=lambda: self._client_gone(entry))
        try:
            if self._observer is not None and isinstance(request, Request):
                outcome = self._observer.observe_write(context, request, see)
            else:
                outcome = self.inner.handle(context, request)
        except _Denied as denied:
            return self._refuse(context, request, known, denied.decision)
        except Refusal as refusal:
            self._note(entry, "exception", refusal.code)
            raise
        except Exception:
            self._note(entry, "exception", ExceptionCode.SERVER_DEVICE_FAILURE)
            raise
        return self._finish(entry, outcome, is_broadcast=context.executed is not None)

    def _finish(self, entry: Entry, outcome: Outcome, *, is_broadcast: bool = False) -> Outcome:
        """Record the outcome of a write, now or when it has ended."""
        if self.audit is None:
            return outcome
        if isinstance(outcome, Message):
            self._note(entry, *outcome_of(outcome))
        elif outcome is LATER:
            if is_broadcast:  # nobody replies to it
                self._note(entry, NO_ANSWER, None)
        elif outcome is SILENCE:
            # A device with several units executes a broadcast once; for its other units nothing was written.
            if not is_broadcast or self._observer is None or entry.replaced is not None:
                self._note(entry, NO_ANSWER, None)
        elif not isinstance(outcome, Deferral):
            entry.is_awaited = True
            return self._noted(entry, outcome)
        return outcome

    def _client_gone(self, entry: Entry) -> None:
        """Record a write without an answer when its client disconnects; an awaited write is recorded when it ends."""
        if not entry.is_awaited:
            self._note(entry, NO_ANSWER, None)

    async def _noted(self, entry: Entry, awaitable: Awaitable[Message]) -> Message:
        """Await the reply of a write, and record its outcome."""
        try:
            reply = await awaitable
        except Refusal as refusal:
            self._note(entry, "exception", refusal.code)
            raise
        except Exception:
            self._note(entry, "exception", ExceptionCode.SERVER_DEVICE_FAILURE)
            raise
        except BaseException:  # cancelled: whether it was executed is not known
            self._note(entry, NO_ANSWER, None)
            raise
        self._note(entry, *outcome_of(reply))
        return reply

    def _note(self, entry: Entry, outcome: str, code: int | None) -> None:
        """Append the audit line of a write, once."""
        if self.audit is not None and not entry.is_noted:
            entry.is_noted = True
            self.audit.append(entry.line(self._time(), outcome, None if code is None else int(code)))

    # ---- who asks, and whom

    def _listed(self, context: RequestContext) -> int | None:
        """The unit number under which the device is configured; None where the wrapped handler has no such list."""
        return None if self._names is None else self._names.listed_unit(context.unit)

    def _known(self, context: RequestContext) -> _Known:
        in_force = self._in_force
        if in_force.inside != self.inner.generation:
            in_force = self._renewed()
        key = context.peer, context.role, context.listener
        known = in_force.askers.get(key)
        if known is None:
            if len(in_force.askers) >= _MOST_ASKERS:
                in_force.askers.clear()
            asker = Asker(host_of_peer(context.peer), context.role, context.listener)
            known = in_force.askers[key] = _Known(asker, _rights_of(asker, in_force), who_text(*key))
        return known

    def _renewed(self) -> _InForce:
        """The policy in force, with its caches cleared if the wrapped handler has changed."""
        with self._lock:
            old = self._in_force
            if old.inside != self.inner.generation:
                self._in_force = _InForce(old.policy, self.inner.generation)
            return self._in_force


def _rights_of(asker: Asker, in_force: _InForce) -> _Rights:
    rights = in_force.rights_of_hosts.get(asker)
    if rights is None:
        if len(in_force.rights_of_hosts) >= _MOST_ASKERS:
            in_force.rights_of_hosts.clear()
        rights = in_force.rights_of_hosts[asker] = _new_rights_of(asker, in_force)
    return rights


def _new_rights_of(asker: Asker, in_force: _InForce) -> _Rights:
    policy = in_force.policy.for_asker(asker)
    key = tuple(rule.name for rule in policy.rules)
    rights = in_force.rights.get(key)
    if rights is None:
        if len(in_force.rights) >= _MOST_RIGHTS:
            del in_force.rights[next(iter(in_force.rights))]
        rights = in_force.rights[key] = _Rights(policy)
    return rights


def _busy(rule: Rule) -> Decision:
    """The refusal of a request that is permitted but above the rate of its rule."""
    return Decision(False, int(ExceptionCode.SERVER_DEVICE_BUSY), rule, f"more than {rule.rate:g} requests a second")

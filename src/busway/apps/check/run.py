"""Runs checks against a device, one after the other, and gives the result of each.

Knows connections, frames, judgements and the clock; knows no single check.

1. Basic checks come first. A facet that failed there is not judged again in other checks. After a wrong unit or
   protocol identifier, and on a serial line after extra bytes, the other checks are made all the same; after any other
   failed basic check all later checks are undecided, also basic ones.
2. Then checks run from safe to risky. After each, the probe is read: if the device no longer answers, all further
   checks are aborted.
3. To find out that a request stays unanswered, a run does not wait for the whole timeout: after ``quiet`` seconds, or
   as soon as something comes, it sends a read of the probe. What comes before the reply to this read is the answer to
   the request. The gap is needed between two frames on a line, and on TCP for devices that drop the second of two
   requests in one segment. If the request may be answered, on a serial line the whole timeout is waited for: no other
   frame may come between request and reply.
4. The scratch items are read before the first check that writes, written back after the last check, and read again.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

from ...codes import Table
from ...errors import ConfigError, LinkDown
from ...observe.dissect import Dissector, Framing, MessageDirection
from ...pdu.functions import STANDARD
from .check import (
    Accepts,
    Ask,
    BesideIt,
    Check,
    CheckResult,
    CheckStep,
    CutOff,
    Evidence,
    Facet,
    FrameDamage,
    Idle,
    Items,
    Level,
    Outcome,
    Reopen,
    Strength,
    Target,
    TlsChange,
    Together,
)
from .frames import Frame, encode_frame, new_search
from .judgement import CheckedExchange, Finding, is_refused_function, judge
from .tls_wire import CannotOffer
from .wire import Dialer, Wire

_OVERLOOKED: Final = frozenset({Facet.UNIT, Facet.PROTOCOL})
"""Facets that do not hide other faults: if a basic check finds one of them wrong, the other checks are still made.

If it finds another facet wrong, all later checks are undecided.
"""
_LINES_TOO: Final = frozenset({Facet.CLEAN})
"""Facets that do not hide other faults on serial lines: extra bytes, which the search for frames skips there."""
_REVIVALS: Final = 3
_READS: Final = {Table.COILS: 1, Table.DISCRETE_INPUTS: 2, Table.HOLDING_REGISTERS: 3, Table.INPUT_REGISTERS: 4}


@dataclass(frozen=True, slots=True)
class Pace:
    """The waiting times of a run, in seconds.

    Attributes:
        timeout: the longest wait for a reply.
        quiet: pause after a request that may stay unanswered, before the next frame is sent.
        idle: time in which checks of idle connections send nothing.
    """

    timeout: float = 1.0
    quiet: float = 0.05
    idle: float = 2.0


class _DiedError(Exception):
    """Error: the device no longer answers the probe, not even on new connections."""


class _Conversation:
    """Sends the requests of checks over one connection or serial line, and collects evidence of the traffic.

    Args:
        dialer: opens the connection.
        target: the device.
        pace: the waiting times.
    """

    def __init__(self, dialer: Dialer, target: Target, pace: Pace) -> None:
        self._dialer = dialer
        self._target = target
        self._pace = pace
        self._wire: Wire | None = None
        self._search = new_search(target.framing)
        self._transaction = 0
        self._evidence: list[Evidence] = []
        self._has_echo = False

    # Connection.

    def open(self) -> None:
        """Open the connection if there is none. Raises `LinkDown` if that fails."""
        if self._wire is None:
            self._wire = self._dialer.open()
            self._search = new_search(self._target.framing)

    def close(self) -> None:
        """Close the connection if there is one."""
        if self._wire is not None:
            self._wire.close()
            self._wire = None

    def reopen(self) -> None:
        """Close the connection and open a new one; a serial port stays open. Raises `LinkDown` if that fails."""
        if self._dialer.has_connections:
            self._note_words("the connection is closed and made again")
            self.close()
        self.open()

    @property
    def is_open(self) -> bool:
        """Whether there is a connection."""
        return self._wire is not None

    def idle(self) -> None:
        """Open the connection if there is none, and send nothing for the idle time of the run. May raise `LinkDown`."""
        self._note_words(f"nothing is sent for {self._pace.idle:g} s")
        self.open()
        self._dialer.sleep(self._pace.idle)

    def second(self, change: TlsChange | None = None) -> "_Conversation":
        """Return a conversation over a second connection to the same device; the connection is opened when it is used.

        ``change``: how its TLS handshake is changed; None for a correct connection.
        """
        if change is None:
            return _Conversation(self._dialer, self._target, self._pace)
        self._note_words(f"a connection {change.value} is made")
        return _Conversation(self._dialer.changed(change), self._target, self._pace)

    # Evidence.

    def take_evidence(self) -> tuple[Evidence, ...]:
        """Return the evidence collected since the previous call, in order, and forget it."""
        taken, self._evidence = tuple(self._evidence), []
        return taken

    def add_evidence(self, more: Sequence[Evidence]) -> None:
        """Append evidence that another conversation has collected, such as that over a second connection."""
        self._evidence += more

    def _note_words(self, words: str) -> None:
        self._evidence.append(Evidence(True, b"", words))

    def _note(self, data: bytes, *, sent: bool) -> None:
        (first, *_) = Dissector(
            framing=Framing(self._target.framing),
            direction=MessageDirection.REQUEST if sent else MessageDirection.REPLY,
        ).dissect(data)
        self._evidence.append(Evidence(sent, data, "; ".join([first.title, *first.problems])))

    # Asking.

    def ask(self, ask: Ask) -> CheckedExchange:
        """Send one request, and return it with what came back until its reply, the timeout or the connection's end.

        Opens the connection if there is none. If the device closes it, the exchange says so. If silence is accepted, a
        read of the probe follows the request (rule 3), and the exchange has the frames that came before the reply to
        that read.

        Raises:
            LinkDown: no connection can be made.
        """
        self.open()
        unit = self._target.unit if ask.unit is None else ask.unit
        transaction = self._next_transaction() if ask.transaction is None else ask.transaction
        frame = encode_frame(self._target.framing, unit, ask.pdu, transaction, ask.damage)
        if not self._sent(frame, ask.pieces):
            return CheckedExchange(ask, unit, transaction, frame, (), closed=True)
        if ask.accepts.silence:
            return self._followed(ask, unit, transaction, frame)
        frames, rest, closed = self._received(ask.pdu[0], self._ends(transaction, frame))
        if len(frames) > 1 and frame.endswith(frames[0].raw) and not _is_echo_alike(frames):
            self._has_echo = True
        return CheckedExchange(ask, unit, transaction, frame, tuple(frames), rest, closed)

    def ask_together(self, pdus: Sequence[bytes]) -> list[CheckedExchange]:
        """Send several requests in one write, and return an exchange for each, in order. For MBAP only.

        An exchange has the frames with its own transaction identifier; bytes that are in no frame are in the last
        exchange.

        Raises:
            LinkDown: no connection can be made.
        """
        self.open()
        numbered = [(self._next_transaction(), pdu) for pdu in pdus]
        frames = [encode_frame(self._target.framing, self._target.unit, pdu, number) for number, pdu in numbered]
        came: list[Frame] = []
        rest, closed = b"", True
        if self._sent(b"".join(frames), ()):
            waited = {number for number, _ in numbered}

            def ends(found: Sequence[Frame]) -> bool:
                return waited <= {one.transaction for one in found}

            came, rest, closed = self._received(pdus[0][0], ends)
        accepts = Accepts(reply=True, exceptions=frozenset({6}))
        exchanges = []
        for (number, pdu), frame in zip(numbered, frames, strict=True):
            own = tuple(one for one in came if one.transaction == number)
            exchanges.append(CheckedExchange(Ask(pdu, accepts), self._target.unit, number, frame, own, b"", closed))
        if rest:
            exchanges[-1] = replace(exchanges[-1], rest=rest)
        return exchanges

    def cut_off(self, pdu: bytes, size: int) -> None:
        """Send only the first ``size`` bytes of the frame of a request, and close the connection.

        Raises:
            LinkDown: no connection can be made.
        """
        self.open()
        frame = encode_frame(self._target.framing, self._target.unit, pdu, self._next_transaction())
        self._sent(frame[:size], ())
        self._note_words("the connection is closed")
        self.close()

    def _next_transaction(self) -> int:
        self._transaction = self._transaction % 0xFFF0 + 1
        return self._transaction

    def _sent(self, frame: bytes, pieces: tuple[int, ...]) -> bool:
        """Discard bytes that came late, and send a frame, in pieces cut at the offsets ``pieces``.

        Returns False if the device has closed the connection.
        """
        assert self._wire is not None
        while late := self._wire.receive(0):  # for an earlier request; on a stream it may end a frame that had begun
            self._search.receive(late, 0)
        self._search.take_rest()
        self._note(frame, sent=True)
        cuts = (0, *pieces, len(frame))
        try:
            for number, (start, end) in enumerate(pairwise(cuts)):
                if number:
                    self._dialer.sleep(_BETWEEN_PIECES)
                self._wire.send(frame[start:end])
        except LinkDown:
            self._lost()
            return False
        return True

    def _lost(self) -> None:
        self._evidence.append(Evidence(False, b"", "the device closed the connection"))
        self.close()

    def _ends(self, transaction: int, sent: bytes) -> Callable[[Sequence[Frame]], bool]:
        if self._target.framing == "mbap":
            return lambda found: any(one.transaction == transaction for one in found)
        if self._has_echo:
            return lambda found: len(found) > 1
        return lambda found: any(not sent.endswith(one.raw) for one in found) or len(found) > 1 or _is_echo_alike(found)

    def _received(self, function: int, ends: Callable[[Sequence[Frame]], bool]) -> tuple[list[Frame], bytes, bool]:
        """Receive frames until ``ends`` returns True, the timeout is over, or the connection ends.

        Args:
            function: function code of the request whose reply is expected.
            ends: tells from the frames received so far whether they are all.

        Returns:
            The frames, the bytes that are in no frame, and whether the device closed the connection.
        """
        assert self._wire is not None
        until = self._dialer.now() + self._pace.timeout
        frames: list[Frame] = []
        while not ends(frames):
            data = self._wire.receive(max(until - self._dialer.now(), 0))
            if data is None:
                rest = self._search.take_rest()
                self._lost()
                return frames, rest, True
            came = self._search.receive(data, function) if data else self._search.finish(function)
            for one in came:
                self._note(one.raw, sent=False)
                frames.append(one)
            if not data:
                break
        rest = self._search.take_rest()
        if rest:
            self._evidence.append(Evidence(False, rest, "bytes that are in no frame"))
        return frames, rest, False

    def _followed(self, ask: Ask, unit: int, transaction: int, frame: bytes) -> CheckedExchange:
        """Send a read of the probe behind a request that may stay unanswered, and return the exchange of the request.

        The request (``frame``) was sent just before. What comes before the reply to the probe is its answer. On a line
        where the request may be answered, its answer is waited for first, and the probe is read only if none comes.
        """
        if self._target.framing != "mbap":
            if ask.accepts.reply or ask.accepts.exceptions:  # the device may answer: it must not be interrupted
                frames, rest, closed = self._received(ask.pdu[0], self._ends(transaction, frame))
                if frames or closed:
                    return CheckedExchange(ask, unit, transaction, frame, tuple(frames), rest, closed)
            else:
                self._dialer.sleep(self._pace.quiet)
        probe = probe_of(self._target)
        number = self._next_transaction()
        marker = encode_frame(self._target.framing, self._target.unit, probe, number)
        assert self._wire is not None
        early = self._wire.receive(self._pace.quiet if self._target.framing == "mbap" else 0)
        found: list[Frame] = []
        if early is None:
            self._lost()
            return CheckedExchange(ask, unit, transaction, frame, (), closed=True)
        if early:
            found = self._search.receive(early, ask.pdu[0])
            for one in found:
                self._note(one.raw, sent=False)
        self._note(marker, sent=True)
        try:
            self._wire.send(marker)
        except LinkDown:
            self._lost()
            return CheckedExchange(ask, unit, transaction, frame, tuple(found), closed=True)
        asked = CheckedExchange(Ask(probe, Accepts(reply=True)), self._target.unit, number, marker, ())

        def is_markers(one: Frame) -> bool:
            if self._target.framing == "mbap":
                return one.transaction == number
            faults = judge(replace(asked, frames=(one,)), framing=self._target.framing)
            return not any(fault.facet not in (Facet.UNIT, Facet.PROTOCOL) for fault in faults)

        frames, _, closed = self._received(probe[0], lambda came: any(is_markers(one) for one in came))
        came = (*found, *frames)
        is_deaf = not closed and self._must_hear_on(ask) and not any(is_markers(one) for one in came)
        before = tuple(one for one in came if not is_markers(one) and one.raw not in (frame, marker))
        return CheckedExchange(ask, unit, transaction, frame, before, b"", closed, is_deaf)

    def _must_hear_on(self, ask: Ask) -> bool:
        """Whether a correct device answers a read that follows this request, whatever it does with the request itself.

        False where the device may not recognise where the request ends, such as after a damaged frame.
        """
        if self._target.framing == "mbap":
            return ask.damage in (None, FrameDamage.PROTOCOL_1, FrameDamage.PROTOCOL_FFFF)
        return ask.damage is None and ask.pdu[0] in STANDARD


_BETWEEN_PIECES: Final = 0.01


def _is_echo_alike(found: Sequence[Frame]) -> bool:
    """Whether the first frame is of function 05, 06, 08 or 22, whose normal reply has the bytes of the request."""
    return bool(found) and found[0].pdu[0] in (5, 6, 8, 22)


def probe_of(target: Target, count: int = 1) -> bytes:
    """Return the PDU of a request that reads ``count`` items of the target, beginning with its probe."""
    probe = target.probe
    return bytes((_READS[probe.table],)) + probe.address.to_bytes(2, "big") + count.to_bytes(2, "big")


class CheckRun:
    """One run of checks against one device.

    Args:
        dialer: opens connections to the device.
        target: how the device is reached, and which items may be read and written; the one for which the checks were
            made.
        pace: the waiting times.

    Attributes:
        is_dead: whether the device has stopped answering during the run.
    """

    def __init__(self, dialer: Dialer, target: Target, pace: Pace) -> None:
        self._target = target
        self._talk = _Conversation(dialer, target, pace)
        self._wrong: set[Facet] = set()
        self._hidden_by = ""
        self._closed_functions: dict[int, tuple[Outcome, str]] = {}
        self.is_dead: bool = False

    def results(self, checks: Sequence[Check]) -> Iterator[CheckResult]:
        """Run the checks in their order, and yield the result of each as soon as it is known.

        If one of the checks writes, the scratch items are restored at the end, and one more result (`RESTORED`) tells
        whether that succeeded; if nothing was written, it is undecided. The iterator has to be used up or closed, since
        only then the items are restored.

        Raises:
            LinkDown: no connection to the device can be made at the beginning; nothing was sent.
            ConfigError: a serial port does not support its settings; nothing was sent.
        """
        self._talk.open()
        scratch = _Scratch(self._talk, self._target)
        try:
            for check in checks:
                yield self._result(check, scratch)
        finally:
            fault = scratch.restore()
            self._talk.close()
        if not scratch.is_saved and any(check.writes for check in checks):
            yield CheckResult(RESTORED, Outcome.UNDECIDED, "nothing was written", self._talk.take_evidence())
        elif scratch.is_saved:
            yield CheckResult(
                RESTORED,
                Outcome.FAILED if fault else Outcome.PASSED,
                fault,
                self._talk.take_evidence(),
            )

    # One check.

    def _result(self, check: Check, scratch: "_Scratch") -> CheckResult:
        if self.is_dead:
            return CheckResult(check, Outcome.ABORTED, "the device had died before")
        if self._hidden_by:
            return CheckResult(check, Outcome.UNDECIDED, f"nothing can be said after {self._hidden_by} failed")
        if check.function is not None and check.function in self._closed_functions:
            outcome, reason = self._closed_functions[check.function]
            return CheckResult(check, outcome, reason)
        missing = [pdu[0] for pdu in check.requests if pdu[0] in self._closed_functions]
        if missing:
            return CheckResult(check, Outcome.UNDECIDED, f"it needs function {missing[0]}, which cannot be relied on")
        evidence: tuple[Evidence, ...] = ()
        try:
            if check.writes and not scratch.save():
                reason = "the scratch items cannot be read, so nothing is written to them"
                return CheckResult(check, Outcome.UNDECIDED, reason, self._talk.take_evidence())
            try:
                outcome, reason = self._judged(check)
            except (CannotOffer, ConfigError) as error:
                outcome, reason = Outcome.UNDECIDED, str(error)
            evidence = self._talk.take_evidence()
            if check.facet is None:
                alive = self._alive(check, outcome, reason)
                later = self._talk.take_evidence()
                evidence += later if alive != (outcome, reason) else ()
                outcome, reason = alive
        except LinkDown as error:
            self.is_dead = True
            return CheckResult(
                check, Outcome.ABORTED, f"no connection any more: {error}", (*evidence, *self._talk.take_evidence())
            )
        except _DiedError:
            self.is_dead = True
            return CheckResult(
                check,
                Outcome.ABORTED,
                "the device died: it no longer answers",
                (*evidence, *self._talk.take_evidence()),
            )
        self._learn(check, outcome)
        return CheckResult(check, outcome, reason, evidence)

    def _learn(self, check: Check, outcome: Outcome) -> None:
        """Store what a check's outcome means for later checks: which facets are wrong, which functions are missing."""
        failed = outcome in (Outcome.FAILED, Outcome.WARNED)
        if check.facet is not None and failed:
            overlooked = _OVERLOOKED | (_LINES_TOO if self._target.framing != "mbap" else frozenset())
            self._wrong.add(check.facet)
            if check.facet not in overlooked:
                self._hidden_by = check.id
        if check.opens and check.function is not None:
            if outcome is Outcome.NOT_OFFERED:
                self._closed_functions[check.function] = (Outcome.NOT_OFFERED, "the device answers 01")
            elif failed:
                self._closed_functions[check.function] = (Outcome.UNDECIDED, f"{check.id} failed before")

    def _judged(self, check: Check) -> tuple[Outcome, str]:
        """Execute the steps of a check until one fails; return the outcome and its reason, empty for ``PASSED``.

        Raises:
            LinkDown: no connection can be made.
            CannotOffer: this machine cannot make the changed TLS handshake of the check.
            ConfigError: a certificate for it cannot be read, such as one that was deleted during the run.
        """
        for step in check.steps:
            for exchange in self._taken(step):
                is_about_one = check.function is not None and 1 not in exchange.ask.accepts.exceptions
                if is_about_one and is_refused_function(exchange):
                    return Outcome.NOT_OFFERED, "the device answers 01"
                faults = judge(exchange, framing=self._target.framing)
                outcome = self._outcome(check, faults)
                if outcome is not None:
                    return outcome
        return Outcome.PASSED, ""

    def _outcome(self, check: Check, faults: Sequence[Finding]) -> tuple[Outcome, str] | None:
        """Return the outcome of a check and its reason if a fault of one exchange fails it; None if the check goes on.

        A basic check looks at the faults of its own facet only. Other checks ignore facets that a basic check found
        wrong.
        """
        failure = Outcome.FAILED if check.word is Strength.MUST else Outcome.WARNED
        if check.facet is not None:
            for fault in faults:
                if fault.facet is check.facet:
                    return failure, fault.words
            return None
        for fault in faults:
            if fault.facet not in self._wrong:
                return failure, fault.words
        return None

    def _taken(self, step: CheckStep) -> Iterator[CheckedExchange]:
        """Execute one step of a check, and yield its exchanges to be judged: none, one, or for `Together` several."""
        talk = self._talk
        match step:
            case Ask():
                yield talk.ask(step)
            case Together(pdus):
                yield from talk.ask_together(pdus)
            case Idle():
                talk.idle()
            case Reopen():
                talk.reopen()
            case CutOff(pdu, size):
                talk.cut_off(pdu, size)
            case BesideIt(ask, change):
                yield self._asked_beside(ask, change)

    def _asked_beside(self, ask: Ask, change: TlsChange | None) -> CheckedExchange:
        """Send a request over a second connection while the first stays open, and return the exchange.

        If the second connection cannot be made, the exchange says that the device closed it.

        Raises:
            LinkDown: the first connection cannot be made.
            CannotOffer: this machine cannot make the changed TLS handshake.
        """
        self._talk.open()
        second = self._talk.second(change)
        try:
            return second.ask(ask)
        except LinkDown:
            return CheckedExchange(ask, self._target.unit, 0, b"", (), closed=True)
        finally:
            second.close()
            self._talk.add_evidence(second.take_evidence())

    # Life.

    def _alive(self, check: Check, outcome: Outcome, reason: str) -> tuple[Outcome, str]:
        """Read the probe after a check, in up to three attempts, and return the check's outcome and reason.

        A new connection is made before the first attempt if the check has left none open, or if its outcome is neither
        `PASSED` nor `NOT_OFFERED`; and after each attempt without an answer. If a check has passed but the first
        attempt is not answered, the outcome becomes `FAILED`, or `WARNED` if the check is a should; it stays `PASSED`
        if the check allows the device to close the connection.

        Raises:
            _DiedError: no attempt was answered.
            LinkDown: no connection can be made.
        """
        expects_close = any(isinstance(step, Ask) and step.accepts.closed for step in check.steps)
        kept_open = self._talk.is_open
        if not kept_open or (outcome is not Outcome.PASSED and outcome is not Outcome.NOT_OFFERED):
            self._talk.reopen()
        for attempt in range(_REVIVALS):
            exchange = self._talk.ask(Ask(probe_of(self._target), Accepts(reply=True)))
            if exchange.frames:
                if attempt and outcome is Outcome.PASSED and not expects_close:
                    failure = Outcome.FAILED if check.word is Strength.MUST else Outcome.WARNED
                    return failure, "afterwards the device did not answer the probe at first"
                return outcome, reason
            self._talk.reopen()
        raise _DiedError


# Scratch items.


class _Scratch:
    """Saves the values of the scratch items before checks write to them, and restores them after the last check.

    Attributes:
        is_saved: whether the values of all scratch items are known.
    """

    def __init__(self, talk: _Conversation, target: Target) -> None:
        self._talk = talk
        self._items = [one for one in (target.registers, target.coils) if one is not None]
        self._saved: list[tuple[Items, bytes]] = []
        self.is_saved: bool = False

    def save(self) -> bool:
        """Read the scratch items, unless their values are known already; return whether they are known now.

        Raises:
            LinkDown: no connection can be made.
        """
        if self.is_saved:
            return True
        found = [(items, self._read(items)) for items in self._items]
        self._saved = [(items, data) for items, data in found if data is not None]
        self.is_saved = len(self._saved) == len(self._items)
        self._talk.take_evidence()
        return self.is_saved

    def restore(self) -> str:
        """Write the saved values back and read them again; return what is wrong with each table, empty if nothing.

        Nothing is sent if the values are not known. An error of the connection is told like this too, and not raised.
        """
        faults = [self._restore(items, data) for items, data in (self._saved if self.is_saved else ())]
        return "; ".join(fault for fault in faults if fault)

    def _restore(self, items: Items, data: bytes) -> str:
        place = f"{items.table.label}s from {items.address} on"
        try:
            self._write(items, data)
            return "" if self._read(items) == data else f"{place} do not hold what they held before"
        except LinkDown as error:
            return f"{place} could not be restored: {error}"

    def _read(self, items: Items) -> bytes | None:
        pdu = bytes((_READS[items.table],)) + items.address.to_bytes(2, "big") + items.count.to_bytes(2, "big")
        frames = self._talk.ask(Ask(pdu, Accepts(reply=True))).frames
        size = (items.count + 7) // 8 if items.table is Table.COILS else 2 * items.count
        own = [one.pdu for one in frames if one.pdu[:2] == bytes((pdu[0], size)) and len(one.pdu) == 2 + size]
        return own[0][2:] if own else None

    def _write(self, items: Items, data: bytes) -> None:
        code = 15 if items.table is Table.COILS else 16
        span = items.address.to_bytes(2, "big") + items.count.to_bytes(2, "big")
        self._talk.ask(Ask(bytes((code,)) + span + bytes((len(data),)) + data, Accepts(reply=True)))
        if code == 16:  # a device may have the functions for one item only
            for index in range(items.count):
                address = (items.address + index).to_bytes(2, "big")
                value = data[2 * index : 2 * index + 2]
                if self._read(replace(items, address=items.address + index, count=1)) != value:
                    self._talk.ask(Ask(b"\x06" + address + value, Accepts(reply=True)))
        else:
            for index in range(items.count):
                on = data[index // 8] >> index % 8 & 1
                place = replace(items, address=items.address + index, count=1)
                if self._read(place) != bytes((on,)):
                    address = place.address.to_bytes(2, "big")
                    self._talk.ask(Ask(b"\x05" + address + (b"\xff\x00" if on else b"\x00\x00"), Accepts(reply=True)))


RESTORED: Final = Check(
    "scratch-restored",
    "A4",
    "the scratch items hold again what they held before",
    Strength.MUST,
    Level.WRITE,
    (),
)
"""The check that a run adds at its end if it may have written: whether the scratch items have their old values."""

"""A master and units that answer late, in virtual time, with an oracle that knows which request each reply answers.

Knows every frame that was sent, which call it was sent for, which unit executed it, and when its reply arrived. Knows
nothing of how the master guards itself: it looks at frames and outcomes only.

1. A unit answers each request that it received at most once and in their order (`UnitModel.ordered`), with any delay
   and any loss. Each reply carries the number of its request where there is room for it.
2. Every outcome that a reply brought is judged at the moment it appears, by the replies that had arrived until then.
3. What the master sends of its own belongs to no call; it must not change anything.
4. A path that echoes gives back each frame before what answers it, in the order of the frames, and may lose a copy.
"""

from __future__ import annotations

import heapq
import random
from bisect import bisect_left
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from busway.errors import BadReply, ExceptionReply, ModbusError, NoReply, UnitSuspended, WriteOutcomeUnknown
from busway.framing.character_times import SerialTiming
from busway.framing.echo import Echo
from busway.framing.frame_direction import LineRole
from busway.options.client import ClientParameters
from busway.options.lines import BreakerParameters, SerialClientParameters
from busway.pdu.message import Message, Request
from busway.session.call import Call
from busway.session.line_framing import line_framing
from busway.session.serial_client import SerialClientSession
from busway.testing.virtual_line import VirtualLine

PROMPT = 0.03
"""Seconds that a unit in good health takes."""
LATENCY = 0.001
"""Seconds of a network from end to end."""
LONGEST_CALL = 1000.0
"""Seconds after which a call that has not ended hangs. A read is repeated once for each reply that the unit owes, which
may be 256 and more; one that takes nearly twice the timeout for each needs 500 s for them."""
TURNS_AT_ONE_MOMENT = 200
"""So many steps without time passing are a master that spins."""

BASIC = frozenset({3, 6, 16})
DATA = frozenset({1, 2, 3, 4, 5, 6, 15, 16, 22, 23})
WRITES = frozenset({5, 6, 15, 16, 22, 23, 21})


class Breach(AssertionError):
    """The promise is broken; the message has what happened before."""


# --- what travels ------------------------------------------------------------------------------


@dataclass(slots=True, eq=False)
class Frame:
    """One request frame that the master sent; ``question`` is None where it is of the master's own."""

    number: int
    at: float
    unit: int
    pdu: bytes
    question: Question | None
    position: int
    executed: bool = False

    def __str__(self) -> str:
        return f"#{self.number} {self.pdu.hex(' ')} to unit {self.unit} of {self.question or 'the master itself'}"


@dataclass(slots=True, eq=False)
class Reply:
    """One reply that was sent to the master; ``arrived`` is when its last byte did."""

    frame: Frame
    pdu: bytes
    arrived: float
    used: bool = False


class TracedCall(Call):
    """A demand that tells when one of its requests is about to be sent."""

    told: Callable[[int], None] | None = None

    def take(self, at_most: int) -> Sequence[int]:
        taken = super().take(at_most)
        if self.told is not None:
            for position in taken:
                self.told(position)
        return taken


class Question:
    """One call of a caller, and the frames that were sent for it."""

    def __init__(self, number: int, call: Call, now: float, frames_allowed: Sequence[int]) -> None:
        self.number = number
        self.call = call
        self.asked = now
        self.frames_allowed = frames_allowed
        self.wanted = {(call.unit, one.encode()): position for position, one in enumerate(call.requests)}
        self.frames: list[list[Frame]] = [[] for _ in call.requests]
        self.sent = [0] * len(call.requests)
        self.judged = [False] * len(call.requests)
        self.cancelled = False
        self.ended: float | None = None
        self.confirmed: list[Reply | None] = [None] * len(call.requests)

    def __str__(self) -> str:
        return f"call {self.number}"

    @property
    def live(self) -> bool:
        return self.ended is None and not self.cancelled

    @property
    def outcome(self) -> object:
        return self.call.outcomes[0]

    @property
    def succeeded(self) -> bool:
        return self.ended is not None and all(isinstance(one, Message) for one in self.call.outcomes)


# --- units ----------------------------------------------------------------------------------------


@dataclass
class UnitModel:
    """One unit: how long it takes, what it loses, what it knows.

    Attributes:
        number: its address.
        delay: seconds for the next request, or None where it is not answered.
        knows: what becomes of functions: ``all``, ``refuses`` (01 for what is no data function) or ``silent`` (for
            whatever is not 03, 06, 16).
        serves: whether a delay holds up what comes behind it (True), or all requests wait side by side, and only their
            replies keep the order.
        ordered: whether replies keep the order of their requests.
        loses_requests, loses_replies, refuses: probabilities.
        room: requests that it can hold; more are lost.
        executes_at_once: whether a request takes effect when it arrives, and not when it is answered.
    """

    number: int
    delay: Callable[[], float | None] = lambda: PROMPT
    knows: str = "all"
    serves: bool = True
    ordered: bool = True
    loses_requests: float = 0.0
    loses_replies: float = 0.0
    refuses: float = 0.0
    room: int = 1000
    executes_at_once: bool = True
    free_at: float = 0.0
    waiting: int = 0
    executed: list[Frame] = field(default_factory=list)
    store: dict[int, int] = field(default_factory=dict)

    def answers(self, function: int) -> bool:
        """Whether it says anything to this function."""
        return self.knows != "silent" or function in BASIC

    def execute(self, frame: Frame, chance: random.Random) -> bytes:
        """Do what is asked, and say so."""
        if frame.executed:
            raise Breach(f"the model executes {frame} twice")
        pdu, function = frame.pdu, frame.pdu[0]
        if self.knows == "refuses" and function not in DATA:
            return bytes((function | 0x80, 1))
        if self.refuses and chance.random() < self.refuses:
            return bytes((function | 0x80, chance.choice((1, 2, 4, 6))))
        frame.executed = True
        self.executed.append(frame)
        return self._reply(frame.number, pdu, function)

    def _reply(self, number: int, pdu: bytes, function: int) -> bytes:
        address, count = int.from_bytes(pdu[1:3], "big"), int.from_bytes(pdu[3:5], "big")
        if function in (3, 4, 23):
            if function == 23:
                self.store[int.from_bytes(pdu[5:7], "big")] = number
            words = [number & 0xFFFF] if count == 1 else [number >> 16, number & 0xFFFF, *[address] * (count - 2)]
            return bytes((function, 2 * count)) + b"".join(one.to_bytes(2, "big") for one in words)
        if function in (1, 2):
            size = (count + 7) // 8
            return bytes((function, size)) + (number & ((1 << count) - 1)).to_bytes(max(size, 8), "little")[:size]
        if function in (5, 6, 22):
            self.store[address] = number
            return pdu
        if function in (15, 16):
            self.store[address] = number
            return pdu[:5]
        if function == 8:
            return pdu if pdu[1:3] == b"\x00\x00" else pdu[:3] + (number & 0xFFFF).to_bytes(2, "big")
        if function == 7:
            return bytes((7, number & 0xFF))
        if function == 11:
            return b"\x0b\x00\x00" + (number & 0xFFFF).to_bytes(2, "big")
        if function == 17:
            return b"\x11\x03\x55\xff" + bytes((number & 0xFF,))
        return bytes((function | 0x80, 1))


# --- the world --------------------------------------------------------------------------------------


class World:
    """One master on one path, and the units at the other end of it.

    Args:
        seed: of all that is random.
        framing: ``rtu`` or ``ascii``.
        path: ``tcp`` (a stream that ends and is made anew), ``udp`` (datagrams), or ``port`` (a wire with characters).
        echo_after: for a path that echoes, returns after how many seconds the copy of the next frame comes back; None
            for a copy that is lost. On a wire each frame comes back as it is sent.
        echo: the option of the port.
    """

    def __init__(
        self,
        seed: int,
        *units: UnitModel,
        framing: str = "rtu",
        path: str = "tcp",
        parameters: ClientParameters | None = None,
        breaker: BreakerParameters | None = None,
        serial: SerialClientParameters | None = None,
        echo_after: Callable[[], float | None] | None = None,
        echo: Echo = Echo.OFF,
    ) -> None:
        self.echo_after = echo_after
        self.chance = random.Random(seed)
        self.units = {one.number: one for one in units}
        self.path = path
        self.framing = framing
        self.now = 0.0
        self.line = VirtualLine(
            2,
            115_200,
            data_bits=8 if framing == "rtu" else 7,
            seed=seed,
            tap_size=2000,
            echo=[] if echo_after is None else [0],
        )
        timing = self.line.settings.timing if path == "port" else SerialTiming.of_network()
        self.parameters = parameters or ClientParameters(queue=1000)
        self.session = SerialClientSession(
            self.parameters,
            framing=line_framing(framing, LineRole.MASTER, timing, echo=echo),
            jitter=random.Random(seed).random,
            serial=serial,
            breaker=breaker,
            endpoint=f"{framing}://model",
        )
        self.encode = line_framing(framing, LineRole.SERVER, timing).encode
        self.gap = 2 * timing.t3_5 if path == "port" else 0.0
        self.connected = False
        self.live: list[Question] = []
        self.frames: list[Frame] = []
        self.replies: deque[Reply] = deque(maxlen=200)
        self.arrivals: defaultdict[tuple[int, int], list[float]] = defaultdict(list)
        self.own_frames = 0
        self.suspended = 0
        self.in_doubt = 0
        self.right = 0
        self.without_reply = 0
        self.connections = 0
        self.longest_call = 0.0
        self.history: deque[str] = deque(maxlen=80)
        self._calls = 0
        self._taken: dict[tuple[int, bytes], tuple[Question, int]] = {}
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._order = 0
        self._held: list[Reply] = []
        self._stream_until = 0.0
        self._connection = 0
        self._outgoing: Frame | None = None
        self._spun = 0
        self.connect()

    # What callers do.

    def ask(
        self,
        unit: int,
        *requests: Request,
        retries: int | None = None,
        timeout: float | None = None,
        deadline: float | None = None,
        caller: object = None,
        idempotent: bool = False,
    ) -> Question | None:
        """Begin a call; None where the unit is suspended."""
        parameters = self.parameters
        is_write = any(one.is_write for one in requests)
        call = TracedCall(
            unit,
            requests,
            is_write,
            parameters.timeout if timeout is None else timeout,
            parameters.retries if retries is None else retries,
            idempotent,
            caller,
            None if deadline is None else self.now + deadline,
        )
        allowed = [
            1 + (parameters.write_retries if one.is_write and not idempotent else call.retries) for one in requests
        ]
        question = Question(self._calls, call, self.now, allowed)
        self._calls += 1
        call.told = lambda position: self._told(question, position)
        self._say(
            f"{question} asks unit {unit} {' + '.join(one.encode().hex(' ') for one in requests)}, "
            f"timeout {call.timeout:g}, retries {call.retries}"
        )
        self.live.append(question)
        try:
            self.session.submit(call, self.now)
        except UnitSuspended:
            self.live.remove(question)
            self.suspended += 1
            question.ended = self.now
            return None
        self._pump()
        return question

    def get(self, unit: int, *requests: Request, **options: object) -> Question | None:
        """Ask, and let time pass until the call has ended."""
        question = self.ask(unit, *requests, **options)  # type: ignore[arg-type]
        if question is not None:
            self.run(until=lambda: not question.live)
        return question

    def cancel(self, question: Question) -> None:
        """The caller goes away."""
        if not question.live:
            return
        self._say(f"{question} is cancelled")
        question.cancelled = True
        self.live.remove(question)
        self.session.cancel(question.call)
        self._pump()

    def disconnect(self, back_after: float, *, keeps: bool = True) -> None:
        """The connection ends; what the units say meanwhile is lost, or waits for the next one."""
        if not self.connected:
            return
        self._say(f"the connection ends, {'replies wait' if keeps else 'replies are lost'}")
        self._keeps = keeps
        self._drop("the peer closed it", lost=True)
        self.at(self.now + back_after, self.connect)
        self._pump()

    def connect(self) -> None:
        """The connection is there, with what has waited for it."""
        if self.connected:
            return
        self.connected = True
        self.connections += 1
        self._connection += 1
        self._stream_until = self.now
        self._keeps = True
        self.session.connected(self.now)
        held, self._held = self._held, []
        for reply in held:
            self._carry(reply)

    # Time.

    def run(self, seconds: float | None = None, *, until: Callable[[], bool] | None = None) -> None:
        """Let time pass: so many seconds, or until a condition holds (`LONGEST_CALL` at most)."""
        end = self.now + (LONGEST_CALL if seconds is None else seconds)
        while until is None or not until():
            times = [self._due[0][0]] if self._due else []
            if (wanted := self.session.deadline()) is not None:
                times.append(wanted)
            if self.path == "port" and (pause := self.line.pause_at()) is not None:
                times.append(pause)
            moment = min(times, default=end + 1)
            if moment > end:
                if until is not None:
                    raise Breach(self._told_all("what was waited for did not come"))
                self._move(end)
                return
            self._spun = self._spun + 1 if moment <= self.now else 0
            if self._spun > TURNS_AT_ONE_MOMENT:
                raise Breach(self._told_all("the master spins: it wants to act at this moment, and does nothing"))
            self._move(max(moment, self.now))
            self._step()

    def at(self, moment: float, action: Callable[[], None]) -> None:
        """Do something later."""
        self._order += 1
        heapq.heappush(self._due, (moment, self._order, action))

    def _move(self, now: float) -> None:
        self.now = now
        if self.path == "port":
            self.line.advance(now)

    def _step(self) -> None:
        if self.path == "port":
            self._hear()
        while self._due and self._due[0][0] <= self.now:
            heapq.heappop(self._due)[2]()
        wanted = self.session.deadline()
        if wanted is not None and wanted <= self.now:
            self.session.tick(self.now)
        self._pump()

    def _hear(self) -> None:
        at_master, at_units = self.line.ports[0].read(), self.line.ports[1].read()
        if at_master.data and self.connected:
            if at_master.errors:
                self.session.receive_damaged(at_master.data, self.now)
            else:
                self.session.receive(at_master.data, len(at_master.data), self.now)
            self._judge()
        sent = self._outgoing
        if at_units.data and sent is not None and not at_units.errors:
            frame = self.encode(sent.unit, sent.pdu)
            if at_units.data.endswith(frame):
                self._outgoing = None
                self._arrive(sent)

    # The master's frames.

    def _pump(self) -> None:
        self._judge()
        for data in self.session.transmit(self.now):
            frame = self._frame(data)
            if self.path == "port":
                self._outgoing = frame
                self.session.written(self.line.ports[0].write(data, self.now))
            else:
                self.session.written(self.now)
                self.at(self.now + LATENCY, lambda frame=frame: self._arrive(frame))  # type: ignore[misc]
                self._give_back(data)
        self._judge()
        if self.session.recycle and self.connected:
            self._say(f"the master wants a new connection: {self.session.recycle}")
            self._drop(self.session.recycle, lost=False)
            self.at(self.now + 0.01, self.connect)
            self._judge()

    def _give_back(self, data: bytes) -> None:
        """The path echoes a frame."""
        after = None if self.echo_after is None else self.echo_after()
        if after is not None:
            self._stream_until = max(self.now + after, self._stream_until)
            self._say(f"#{len(self.frames)} will come back at {self._stream_until:.4f}")
            connection = self._connection
            self.at(self._stream_until, lambda: self._receive(data, None, connection))

    def _drop(self, reason: str, *, lost: bool) -> None:
        self.connected = False
        self._connection += 1
        self.session.disconnected(self.now, reason, lost=lost)

    def _frame(self, data: bytes) -> Frame:
        if self.framing == "rtu":
            unit, pdu = data[0], bytes(data[1:-2])
        else:
            body = bytes.fromhex(data[1:-4].decode("ascii"))
            unit, pdu = body[0], body[1:]
        question, position = self._owner(unit, pdu)
        frame = Frame(len(self.frames) + 1, self.now, unit, pdu, question, position)
        self.frames.append(frame)
        self._say(f"sent {frame}")
        if question is None:
            self.own_frames += 1
            if pdu[0] in WRITES:
                raise Breach(self._told_all(f"a write without a call was sent: {frame}"))
        else:
            question.frames[position].append(frame)
            if question.sent[position] > question.frames_allowed[position] + self._absorbed(question, pdu):
                raise Breach(self._told_all(f"{frame} is one more than {question.frames_allowed[position]}"))
        return frame

    def _absorbed(self, question: Question, pdu: bytes) -> int:
        """How often a read may be sent beyond its retries: once for each reply that may have been its own and was not
        taken."""
        if pdu[0] in WRITES:
            return 0
        arrivals = self.arrivals[question.call.unit, pdu[0]]
        return len(arrivals) - bisect_left(arrivals, question.asked)

    def _told(self, question: Question, position: int) -> None:
        self._taken[question.call.unit, question.call.requests[position].encode()] = question, position

    def _owner(self, unit: int, pdu: bytes) -> tuple[Question | None, int]:
        taken = self._taken.pop((unit, pdu), None)
        if taken is not None and taken[0].live:
            question, position = taken
            question.sent[position] += 1
            return taken
        for question in self.live:
            if (unit, pdu) in question.wanted:
                position = question.wanted[unit, pdu]
                question.sent[position] += pdu[0] in WRITES
                return question, position  # it, or something of the master's own that reads the same
        return None, 0

    # The units.

    def _arrive(self, frame: Frame) -> None:
        if frame.unit == 0:
            return
        unit = self.units.get(frame.unit)
        chance = self.chance
        if unit is None or not unit.answers(frame.pdu[0]):
            return
        if unit.waiting >= unit.room or (unit.loses_requests and chance.random() < unit.loses_requests):
            self._say(f"lost on its way to the unit: #{frame.number}")
            return
        delay = unit.delay()
        if delay is None:
            self._say(f"#{frame.number} is not answered")
            return
        begun = max(self.now, unit.free_at) if unit.ordered and unit.serves else self.now
        answered = begun + delay
        if unit.ordered:
            answered = unit.free_at = max(answered, unit.free_at)
        unit.waiting += 1
        done = unit.execute(frame, chance) if unit.executes_at_once else None
        self._say(f"#{frame.number} will be answered at {answered:.3f}")
        self.at(answered, lambda: self._answer(unit, frame, done))

    def _answer(self, unit: UnitModel, frame: Frame, done: bytes | None) -> None:
        unit.waiting -= 1
        pdu = unit.execute(frame, self.chance) if done is None else done
        if unit.loses_replies and self.chance.random() < unit.loses_replies:
            self._say(f"the reply to #{frame.number} is lost")
            return
        self._carry(Reply(frame, pdu, self.now))

    def double(self, reply: Reply, after: float) -> None:
        """Say something once more, unasked: what no unit of the promise does."""
        self.at(self.now + after, lambda: self._carry(Reply(reply.frame, reply.pdu, self.now)))

    def _carry(self, reply: Reply) -> None:
        data = self.encode(reply.frame.unit, reply.pdu)
        if self.path == "port":
            start = max(self.now, self.line.ports[1].free_at + self.gap)
            if start > self.now:
                self.at(start, lambda: self._carry(reply))
                return
            reply.arrived = self.line.ports[1].write(data, self.now)
            self._say(f"the reply to #{reply.frame.number} arrives at {reply.arrived:.3f}: {reply.pdu.hex(' ')}")
            self._arrives(reply)
            return
        if not self.connected:
            if self._keeps:
                self._held.append(reply)
            return
        arrives = max(self.now + LATENCY, self._stream_until)
        connection = self._connection
        if self.path == "tcp" and self.chance.random() < 0.05:
            cut = self.chance.randrange(1, len(data))
            begin, data = data[:cut], data[cut:]
            self.at(arrives, lambda: self._receive(begin, None, connection))
            arrives += 0.004
        self._stream_until = arrives
        self.at(arrives, lambda: self._receive(data, reply, connection))

    def _receive(self, data: bytes, reply: Reply | None, connection: int) -> None:
        if connection != self._connection:
            return
        if reply is not None:
            reply.arrived = self.now
            self._say(f"the reply to #{reply.frame.number} arrives: {reply.pdu.hex(' ')}")
            self._arrives(reply)
        self.session.receive(data, len(data), self.now)
        self._pump()

    def _arrives(self, reply: Reply) -> None:
        self.replies.append(reply)
        self.arrivals[reply.frame.unit, reply.pdu[0] & 0x7F].append(reply.arrived)

    # The oracle.

    def _judge(self) -> None:
        for question in self.live:
            for position, outcome in enumerate(question.call.outcomes):
                if outcome is not None and not question.judged[position]:
                    question.judged[position] = True
                    self._judge_outcome(question, position, outcome)
        for call in self.session.finished:
            for question in self.live:
                if question.call is call:
                    question.ended = self.now
                    self.longest_call = max(self.longest_call, self.now - question.asked)
                    self.live.remove(question)
                    break
        self.session.finished.clear()
        if self.live and self.now - self.live[0].asked > LONGEST_CALL:
            raise Breach(self._told_all(f"{self.live[0]} hangs"))

    def _judge_outcome(self, question: Question, position: int, outcome: object) -> None:
        self._say(f"{question}[{position}] ends: {outcome!r}")
        if question.call.unit == 0:
            return
        request = question.call.requests[position]
        cause = outcome.__cause__ if isinstance(outcome, WriteOutcomeUnknown) else outcome
        if isinstance(cause, Message):
            self._judge_reply(question, position, cause.encode())
            self.right += 1
        elif isinstance(cause, ExceptionReply):
            self._judge_reply(question, position, bytes((request.code | 0x80, cause.code)))
            self.right += 1
        elif isinstance(cause, BadReply):
            self._judge_broken(question, position, cause)
        else:
            self.without_reply += 1
            if isinstance(cause, NoReply) and cause.kind == "in doubt":
                self.in_doubt += 1
                self._judge_doubt(question, position)
        if (
            not isinstance(outcome, Message | ExceptionReply | WriteOutcomeUnknown)
            and request.is_write
            and question.frames[position]
        ):
            raise Breach(self._told_all(f"{question}, a write that was sent, ends as {outcome!r}"))

    def _judge_doubt(self, question: Question, position: int) -> None:
        if question.sent[position]:
            raise Breach(self._told_all(f"{question} ends as in doubt, but was sent"))

    def _judge_reply(self, question: Question, position: int, pdu: bytes) -> None:
        wait = 0.25 if self.path == "port" else 0.1  # a receiver may wait 50 ms for a silence
        # Of several frames with equal bytes none says which of them is the echo.
        since = self.now - wait if self.echo_after is None else question.asked
        arrived = [
            one
            for one in reversed(self.replies)
            if since <= one.arrived <= self.now + 1e-6
            and not one.used
            and one.frame.unit == question.call.unit
            and one.pdu == pdu
        ]
        for reply in arrived:
            if reply.frame in question.frames[position]:
                reply.used = True
                question.confirmed[position] = reply
                return
        by = f"the reply to {arrived[0].frame}" if arrived else "no reply that has just arrived"
        raise Breach(self._told_all(f"{question}[{position}] was completed with {pdu.hex(' ')} by {by}"))

    def _judge_broken(self, question: Question, position: int, error: BadReply) -> None:
        for reply in reversed(self.replies):
            whole = self.encode(reply.frame.unit, reply.pdu)
            if whole == error.raw or reply.pdu == error.raw:
                if reply.frame not in question.frames[position]:
                    raise Breach(
                        self._told_all(f"{question}[{position}] was ended by the reply to {reply.frame}: {error}")
                    )
                return
        if self.path != "port":
            raise Breach(self._told_all(f"{question}[{position}] ended by a broken reply, and none was sent: {error}"))

    def _say(self, what: str) -> None:
        self.history.append(f"{self.now:10.3f}  {what}")

    def _told_all(self, what: str) -> str:
        return f"{what}, at {self.now:.3f}\n" + "\n".join(self.history)


def is_error(outcome: object) -> bool:
    """Whether a call ended without what it asked for."""
    return isinstance(outcome, ModbusError)

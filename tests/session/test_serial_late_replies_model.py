"""No reply ever completes another call: late ones, lost ones and exceptions, against an oracle that knows the frames.

The promise: for one client that is the only master, over a path that neither reorders, forges nor answers unprompted,
and a unit that answers each request that it received at most once and in their order, with any delay and any loss, no
reply ever completes another call.
"""

import itertools
import random
from collections.abc import Callable

import pytest
from late_reply_world import BASIC, PROMPT, Breach, Question, UnitModel, World

from busway.errors import ModbusError, NoReply
from busway.framing.echo import Echo
from busway.options.client import ClientParameters
from busway.options.lines import BreakerParameters, SerialClientParameters
from busway.pdu.message import Message, Request
from busway.pdu.read_items import ReadCoils, ReadHoldingRegisters, ReadInputRegisters
from busway.pdu.write_items import (
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
)
from busway.session.serial_late_replies import OWED_LIMIT

STEPS = 2000
SEEDS = range(50)
"""Together 100 000 steps."""
SOAK_SEEDS = range(1000, 2000)

LIVE_AT_MOST = 8
NO_BREAKER = BreakerParameters(open_after=0)
PATHS = [("rtu", "tcp"), ("rtu", "udp"), ("ascii", "tcp"), ("rtu", "port"), ("ascii", "port")]

WRONG_AFTER_A_DOUBLED_REPLY = 100
"""Wrong values at most that callers get before a shift by a second answer is noticed."""

RECOVERY = 60.0
"""Seconds at most from the moment at which a unit answers everything promptly to its first success."""


# --- how units misbehave -------------------------------------------------------------------------


def habits(chance: random.Random, timeout: float) -> dict[str, Callable[[], float | None]]:
    """Delays of the next request by the name of the habit."""
    burst = [0]

    def bursts() -> float:
        if burst[0] == 0 and chance.random() < 0.1:
            burst[0] = chance.randrange(2, 8)
        if burst[0]:
            burst[0] -= 1
            return chance.uniform(0.5, 4) * timeout
        return PROMPT

    return {
        "prompt": lambda: PROMPT,
        "hiccups": lambda: 1.2 * timeout if chance.random() < 0.1 else PROMPT,
        "long hiccups": lambda: chance.uniform(1, 6) * timeout if chance.random() < 0.1 else PROMPT,
        "bursts": bursts,
        "slow for ever": lambda: chance.uniform(1.1, 1.9) * timeout,
        "any delay": lambda: PROMPT * 1000 ** chance.random(),
        "around the timeout": lambda: timeout * chance.uniform(0.9, 1.15),
        "mute now and then": lambda: None if chance.random() < 0.3 else PROMPT,
        "dead": lambda: None,
    }


def drawn_unit(number: int, chance: random.Random) -> UnitModel:
    """A unit of a kind that there is."""
    return UnitModel(
        number,
        knows=chance.choice(("all", "all", "refuses", "silent")),
        serves=chance.random() < 0.6,
        loses_requests=chance.choice((0, 0, 0.1)),
        loses_replies=chance.choice((0, 0, 0.1)),
        refuses=chance.choice((0, 0.1, 0.4)),
        room=chance.choice((1, 2, 1000, 1000)),
        executes_at_once=chance.random() < 0.5,
    )


def drawn_request(chance: random.Random, number: int, knows: str) -> Request:
    """Few shapes, so that most replies fit most requests."""
    address = chance.choice((0, 0, 10))
    value = chance.choice((1, 2, number & 0xFFFF))
    basic: list[Callable[[], Request]] = [
        lambda: ReadHoldingRegisters(address, 2),
        lambda: ReadHoldingRegisters(address, 2),
        lambda: ReadHoldingRegisters(address, 2),
        lambda: ReadHoldingRegisters(address, 1),
        lambda: WriteSingleRegister(address, value),
        lambda: WriteMultipleRegisters.of(address, [value, value]),
    ]
    more: list[Callable[[], Request]] = [
        lambda: ReadInputRegisters(address, 2),
        lambda: ReadCoils(address, 1),
        lambda: ReadCoils(address, 1),
        lambda: WriteSingleCoil(address, 0xFF00 if value & 1 else 0),
        lambda: WriteMultipleCoils.of(address, [bool(value & 1)] * 3),
        lambda: MaskWriteRegister(address, value, 0),
        lambda: ReadWriteMultipleRegisters.of(address, 2, address, [value]),
    ]
    return chance.choice(basic if knows == "silent" or chance.random() < 0.5 else more)()


def echoes_of(chance: random.Random, timeout: float) -> Callable[[], float | None]:
    """When the path gives back the next frame: at once, at times late, also after the timeout; rarely not at all."""
    count = itertools.count(1)
    late = chance.choice((0.0, 0.1, 0.5))

    def after() -> float | None:
        if next(count) % 20 == 0:
            return None
        return chance.uniform(0.05, 3.0) * timeout if chance.random() < late else 0.0005

    return after


class Chaos:
    """So many random steps of callers, units and the path."""

    def __init__(self, seed: int, *, trusts: bool = False, echoes: bool = False, echo: Echo = Echo.OFF) -> None:
        self.chance = chance = random.Random(seed)
        framing, path = PATHS[seed % len(PATHS)]
        timeout = chance.choice((1.0, 1.0, 0.5))
        self.world = World(
            seed,
            *(drawn_unit(number, chance) for number in (1, 2, 3)),
            framing=framing,
            path=path,
            parameters=ClientParameters(
                timeout=timeout, retries=chance.randrange(4), write_retries=chance.choice((0, 0, 0, 1, 2)), queue=1000
            ),
            breaker=chance.choice((None, NO_BREAKER)),
            serial=SerialClientParameters(trust_reply_order=trusts),
            echo_after=echoes_of(chance, timeout) if echoes else None,
            echo=echo,
        )
        self.timeout = timeout
        self.habits = habits(chance, timeout)
        self.mixed_timeouts = chance.random() < 0.3
        self.asked = 0
        for unit in self.world.units.values():
            self.change(unit)

    def change(self, unit: UnitModel) -> None:
        """Give a unit another habit."""
        name = self.chance.choice(list(self.habits))
        unit.delay = self.habits[name]
        self.world._say(f"unit {unit.number} is now {name}")

    def step(self) -> None:
        """One random step."""
        world, chance = self.world, self.chance
        drawn = chance.random()
        if drawn < 0.65:
            self.ask()
        elif drawn < 0.70 and world.live:
            world.cancel(chance.choice(world.live))
        elif drawn < 0.72:
            world.disconnect(chance.choice((0.001, 0.3, 3.0)), keeps=chance.random() < 0.7)
        elif drawn < 0.74:
            self.change(chance.choice(list(world.units.values())))
        elif drawn < 0.76:
            world.run(chance.choice((1.0, 3.0, 40.0)))
        else:
            world.run(chance.choice((0.001, 0.02, 0.2)))
        while len(world.live) >= LIVE_AT_MOST:
            world.run(until=lambda: len(world.live) < LIVE_AT_MOST)

    def ask(self) -> None:
        """Begin a random call."""
        world, chance = self.world, self.chance
        number = chance.choice((1, 1, 1, 2, 3))
        self.asked += 1
        if chance.random() < 0.01:
            world.ask(0, WriteSingleRegister(5, self.asked & 0xFFFF))
            return
        wanted = 1 if chance.random() < 0.9 else 3
        requests = {one.encode(): one for one in (drawn_request(chance, self.asked, world.units[number].knows),) * 1}
        while len(requests) < wanted:
            address = chance.randrange(20)
            requests.setdefault(ReadHoldingRegisters(address, 2).encode(), ReadHoldingRegisters(address, 2))
        for pdu, request in requests.items():  # two equal writes at one time could not be told apart by the oracle
            if request.is_write and any((number, pdu) in question.wanted for question in world.live):
                return
        world.ask(
            number,
            *requests.values(),
            retries=chance.choice((None, None, 0, 1, 3)),
            timeout=self.timeout * chance.choice((0.3, 1, 2)) if self.mixed_timeouts else None,
            deadline=chance.choice((None, None, None, 0.5, 3.0)),
            caller=chance.randrange(3),
            idempotent=chance.random() < 0.1,
        )

    def end(self) -> None:
        """Let all calls end."""
        self.world.run(until=lambda: not self.world.live)


def chaos(seed: int, steps: int, *, trusts: bool = False, echoes: bool = False, echo: Echo = Echo.OFF) -> World:
    """A run; raises `Breach` where something is wrong. On a path that echoes, reads show that first."""
    run = Chaos(seed, trusts=trusts, echoes=echoes, echo=echo)
    if echoes:
        for unit in run.world.units:
            run.world.get(unit, ReadHoldingRegisters(0, 2))
    for _ in range(steps):
        run.step()
    run.end()
    return run.world


# --- the promise ------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
def test_no_reply_completes_another_call(seed: int) -> None:
    world = chaos(seed, STEPS)
    assert world.right > 20


@pytest.mark.parametrize("seed", SEEDS[:10])
def test_no_reply_completes_another_call_where_the_order_is_trusted(seed: int) -> None:
    """These units keep it, so nothing waits for twice the timeout, and calls of several callers meet more often."""
    world = chaos(seed, STEPS, trusts=True)
    assert world.right > 20


@pytest.mark.parametrize("trusts", [False, True])
@pytest.mark.parametrize("seed", SEEDS[:10])
def test_no_reply_and_no_echo_completes_another_call_where_the_path_echoes(seed: int, trusts: bool) -> None:
    """A reply may have the bytes of its request, and the copy of a write that no unit has received is none."""
    world = chaos(seed, STEPS, trusts=trusts, echoes=True)
    assert world.right > 20


@pytest.mark.parametrize("echo", [Echo.ON, Echo.AUTOMATIC])
@pytest.mark.parametrize("seed", SEEDS[:10])
def test_no_reply_and_no_echo_completes_another_call_where_the_port_removes_its_echo(seed: int, echo: Echo) -> None:
    world = chaos(seed, STEPS, echoes=True, echo=echo)
    assert world.right > 20


@pytest.mark.soak
@pytest.mark.parametrize("seed", SOAK_SEEDS)
def test_no_reply_completes_another_call_for_long(seed: int) -> None:
    chaos(seed, 5 * STEPS)


# --- plain stories -----------------------------------------------------------------------------------

HICCUP = 1.2


def hiccup_at(*requests: int) -> Callable[[], float]:
    """A unit that takes 1.2 s for these requests, counted from 1, and is prompt otherwise."""
    count = itertools.count(1)
    return lambda: HICCUP if next(count) in requests else PROMPT


KINDS = ("all", "refuses", "silent")


@pytest.mark.parametrize("knows", KINDS)
@pytest.mark.parametrize(("framing", "path"), PATHS)
@pytest.mark.parametrize("retries", [0, 1, 3])
def test_one_hiccup_shifts_nothing(framing: str, path: str, retries: int, knows: str) -> None:
    world = World(
        1,
        UnitModel(1, hiccup_at(3), knows=knows),
        framing=framing,
        path=path,
        parameters=ClientParameters(retries=retries),
    )
    questions = [world.get(1, ReadHoldingRegisters(10 * number, 2)) for number in range(20)]
    assert all(question is not None and question.succeeded for question in questions[-10:])


@pytest.mark.parametrize("knows", KINDS)
@pytest.mark.parametrize("known", [True, False])
def test_the_same_read_asked_again_is_not_answered_by_what_was_read_before_a_write(known: bool, knows: str) -> None:
    """The value is of before the write in between."""
    world = World(1, UnitModel(1, hiccup_at(2 if known else 1), knows=knows), parameters=ClientParameters(retries=0))
    if known:
        world.get(1, ReadHoldingRegisters(0, 2))
    first = world.get(1, ReadHoldingRegisters(0, 2))
    assert first is not None
    assert isinstance(first.outcome, NoReply)
    world.get(1, WriteSingleRegister(0, 7))
    for _ in range(10):
        world.get(1, ReadHoldingRegisters(0, 2))


def writes(value: int) -> dict[str, Request]:
    """Writes whose replies do not tell which of them they answer."""
    return {
        "06": WriteSingleRegister(0, 7),
        "05": WriteSingleCoil(0, 0xFF00),
        "15": WriteMultipleCoils.of(0, [bool(value & 1), True]),
        "16": WriteMultipleRegisters.of(0, [value, value]),
        "22": MaskWriteRegister(0, 1, 2),
        "23": ReadWriteMultipleRegisters.of(0, 2, 0, [value]),
    }


@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize("knows", KINDS)
@pytest.mark.parametrize("kind", list(writes(0)))
def test_a_write_is_not_confirmed_by_the_reply_to_another_write(kind: str, knows: str, lost: bool) -> None:
    """The second write may be lost on its way: then its confirmation would be a lie."""
    count = itertools.count(1)
    delays = {2: HICCUP, 3: None if lost else PROMPT}
    knows = "all" if knows == "silent" and int(kind) not in BASIC else knows
    world = World(1, UnitModel(1, lambda: delays.get(next(count), PROMPT), knows=knows), breaker=NO_BREAKER)
    world.get(1, ReadHoldingRegisters(0, 2))
    for value in (100, 200, 300, 400, 500):
        question = world.get(1, writes(value)[kind])
        assert question is not None
        assert len(question.frames[0]) <= 1
        if question.succeeded:
            assert question.frames[0][0].executed


@pytest.mark.parametrize("knows", KINDS)
def test_a_late_exception_ends_no_other_call(knows: str) -> None:
    chance = random.Random(5)
    world = World(
        5,
        UnitModel(1, lambda: HICCUP if chance.random() < 0.1 else PROMPT, knows=knows, refuses=0.5),
        breaker=NO_BREAKER,
    )
    for number in range(300):
        world.get(1, ReadHoldingRegisters(number % 2, 2))


@pytest.mark.parametrize("knows", KINDS)
@pytest.mark.parametrize("keeps", [True, False])
def test_doubt_outlives_the_connection(keeps: bool, knows: str) -> None:
    """A converter keeps what the unit says while no client is connected, and gives it to the next connection."""
    world = World(1, UnitModel(1, hiccup_at(3), knows=knows), parameters=ClientParameters(retries=0))
    for number in range(20):
        question = world.ask(1, ReadHoldingRegisters(10 * number, 2))
        if number in (2, 5):
            world.run(0.5)
            world.disconnect(0.2, keeps=keeps)
        world.run(until=lambda question=question: question is None or not question.live)  # type: ignore[misc]


@pytest.mark.parametrize("knows", KINDS)
def test_a_cancelled_call_leaves_nothing_to_the_next(knows: str) -> None:
    world = World(1, UnitModel(1, hiccup_at(3, 7), knows=knows))
    for number in range(20):
        question = world.ask(1, ReadHoldingRegisters(10 * number, 2))
        assert question is not None
        if number in (2, 5):
            world.run(0.1)
            world.cancel(question)
        world.run(until=lambda question=question: not question.live)  # type: ignore[misc]


@pytest.mark.parametrize("knows", KINDS)
@pytest.mark.parametrize("seed", range(60))
def test_two_callers_of_a_slow_unit_with_little_room(seed: int, knows: str) -> None:
    """A repetition of one call, behind a request of another that is owed still, is no place for the first reply."""
    chance = random.Random(seed)
    unit = UnitModel(
        1,
        lambda: chance.uniform(0.9, 1.15) if chance.random() < 0.7 else PROMPT,
        knows=knows,
        serves=chance.random() < 0.5,
        room=chance.choice((1, 2, 3, 1000)),
    )
    world = World(seed, unit, path="udp", breaker=NO_BREAKER)
    for number in range(30):
        world.ask(
            1,
            ReadHoldingRegisters(10 * number, 2),
            timeout=chance.choice((0.3, 1.0)),
            retries=chance.choice((0, 1, 3)),
            caller=chance.randrange(2),
        )
        world.run(chance.choice((0.001, 0.3, 1.0)))
    world.run(until=lambda: not world.live)


@pytest.mark.parametrize("callers", [1, 2, 3])
@pytest.mark.parametrize("trusts", [False, True])
def test_reads_of_several_callers_end_where_one_reply_is_lost_and_no_marker_works(trusts: bool, callers: int) -> None:
    """Each read has to be repeated, and the repetitions of two callers must not owe each other their replies."""
    count = itertools.count(1)
    world = World(
        1,
        UnitModel(1, lambda: None if next(count) == 3 else PROMPT, knows="silent"),
        breaker=NO_BREAKER,
        serial=SerialClientParameters(trust_reply_order=trusts),
    )
    for _ in range(2):
        world.get(1, ReadHoldingRegisters(0, 1))
    for _ in range(6):
        questions = [world.ask(1, ReadHoldingRegisters(caller, 1), caller=caller) for caller in range(callers)]
        world.run(until=lambda: not world.live)
    assert all(question is not None and question.succeeded for question in questions)


@pytest.mark.parametrize("delay", [0.6, 0.9])
def test_two_reads_of_other_lengths_do_not_repeat_each_other_for_ever_after_a_hiccup(delay: float) -> None:
    """A late reply that is too long or too short for the read in flight says nothing about it."""
    count = itertools.count(1)
    world = World(
        1,
        UnitModel(1, lambda: 3.0 if next(count) == 1 else delay, knows="silent"),
        breaker=NO_BREAKER,
        serial=SerialClientParameters(trust_reply_order=True),
    )
    for _ in range(6):
        questions = [world.ask(1, ReadHoldingRegisters(0, 1 + caller), caller=caller) for caller in range(2)]
        world.run(until=lambda: not world.live)
    assert all(question is not None and question.succeeded for question in questions)
    assert len(world.frames) < 40


def test_a_read_ends_after_an_outage_with_more_owed_replies_than_are_kept_one_by_one() -> None:
    """No marker works: the read is repeated once for each owed reply, and its own attempts must not add to them."""
    mute = True
    world = World(
        1,
        UnitModel(1, lambda: None if mute else PROMPT, knows="silent"),
        breaker=NO_BREAKER,
        parameters=ClientParameters(retries=0),
        serial=SerialClientParameters(trust_reply_order=True),
    )
    for _ in range(OWED_LIMIT + 40):
        world.get(1, ReadHoldingRegisters(0, 1))
    mute = False
    question = world.get(1, ReadHoldingRegisters(0, 1))
    assert question is not None
    assert question.succeeded
    assert OWED_LIMIT < len(question.frames[0]) < OWED_LIMIT + 60


# --- units that do not keep the order ---------------------------------------------------------------


@pytest.mark.parametrize("knows", KINDS)
@pytest.mark.parametrize("seed", range(6))
def test_unordered_unit_below_twice_the_timeout(seed: int, knows: str) -> None:
    chance = random.Random(seed)
    timeout = 1.0
    delays: list[Callable[[], float]] = [
        lambda: chance.uniform(PROMPT, 1.95 * timeout),
        lambda: chance.uniform(PROMPT, 1.95 * timeout) if chance.random() < 0.2 else PROMPT,
        lambda: 1.95 * timeout if chance.random() < 0.2 else PROMPT,
    ]
    world = World(
        seed,
        UnitModel(1, delays[seed % 3], knows=knows, ordered=False, loses_replies=chance.choice((0.0, 0.1))),
        path=PATHS[seed % 2][1],
        parameters=ClientParameters(timeout=timeout, retries=seed % 4, queue=1000),
        breaker=NO_BREAKER,
    )
    for number in range(400):
        question = world.ask(1, drawn_request(chance, number, knows))
        if question is not None and chance.random() < 0.05:
            world.run(chance.random())
            if question.live:
                world.cancel(question)
        world.run(until=lambda: not world.live)
    assert world.right > 20


# --- units that answer twice ------------------------------------------------------------------------


class Doubler:
    """Reads one after the other of a unit that now and then gives one answer twice, and counts the wrong values."""

    def __init__(self, seed: int, knows: str) -> None:
        self.world = World(seed, UnitModel(1, knows=knows), breaker=NO_BREAKER)
        self.wrong = 0
        self.world._judge_reply = self._count  # type: ignore[method-assign]
        self.number = 0

    def _count(self, question: Question, position: int, pdu: bytes) -> None:
        own = [frame.number for frame in question.frames[position]]
        self.wrong += int.from_bytes(pdu[2:6], "big") not in own

    def read(self, times: int) -> None:
        for _ in range(times):
            self.number += 1
            self.world.get(1, ReadHoldingRegisters(10 * (self.number % 100), 2))

    def double(self) -> None:
        """The last reply comes once more, before the next one."""
        self.world.double(self.world.replies[-1], PROMPT / 2)


@pytest.mark.parametrize("knows", ["all", "refuses"])
@pytest.mark.parametrize("doubles", [1, 2])
def test_shift_by_a_second_answer_is_noticed(knows: str, doubles: int) -> None:
    run = Doubler(1, knows)
    run.read(37)
    for _ in range(doubles):
        run.double()
    run.read(5 * WRONG_AFTER_A_DOUBLED_REPLY)
    assert run.wrong <= doubles * WRONG_AFTER_A_DOUBLED_REPLY
    before = run.wrong
    run.read(2 * WRONG_AFTER_A_DOUBLED_REPLY)
    assert run.wrong == before, "and the shift is gone for good"


# --- liveness -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("breaker", [None, NO_BREAKER], ids=["breaker", "no breaker"])
@pytest.mark.parametrize("knows", KINDS)
@pytest.mark.parametrize("habit", ["slow for ever", "any delay", "bursts", "dead", "mute now and then"])
@pytest.mark.parametrize("seed", range(3))
def test_unit_that_recovers_is_asked_again_soon(
    seed: int, habit: str, knows: str, breaker: BreakerParameters | None
) -> None:
    chance = random.Random(seed)
    unit = UnitModel(1, habits(chance, 1.0)[habit], knows=knows, serves=seed != 1, loses_replies=0.1 * (seed == 2))
    world = World(seed, unit, breaker=breaker, path=PATHS[seed % 2][1])
    for number in range(60):
        world.get(1, drawn_request(chance, number, knows))
        world.run(0.05)
    unit.delay, unit.loses_replies = lambda: PROMPT, 0.0
    world.run(max(0.0, unit.free_at - world.now) + (32.0 if not unit.serves else 0.0))
    healthy = world.now
    assert seconds_to_success(world, healthy) < RECOVERY
    for number in range(20):
        question = world.get(1, ReadHoldingRegisters(number, 2))
        assert question is not None
        assert question.succeeded, "once well, it stays so"


def seconds_to_success(world: World, since: float) -> float:
    """How long reads and writes fail."""
    for number in itertools.count():
        question = world.get(1, WriteSingleRegister(0, number) if number % 2 else ReadHoldingRegisters(10 * number, 2))
        if question is not None and question.succeeded:
            return world.now - since
        assert world.now - since < RECOVERY
        world.run(0.1)
    raise AssertionError


@pytest.mark.parametrize("breaker", [None, NO_BREAKER], ids=["breaker", "no breaker"])
@pytest.mark.parametrize("knows", KINDS)
@pytest.mark.parametrize("habit", ["slow for ever", "any delay", "bursts", "hiccups", "dead"])
def test_unit_in_doubt_stalls_no_other(habit: str, knows: str, breaker: BreakerParameters | None) -> None:
    """A call to another unit waits for what is in flight, its drain and what the master sends of its own: no more."""
    chance = random.Random(3)
    timeout = 1.0
    world = World(3, UnitModel(1, habits(chance, timeout)[habit], knows=knows), UnitModel(2), breaker=breaker)
    slowest = 0.0
    done = 0
    while world.now < 200:
        for _ in range(2 - sum(question.call.unit == 1 for question in world.live)):
            world.ask(1, drawn_request(chance, done, knows), caller="patient")
        begun = world.now
        question = world.get(2, ReadHoldingRegisters(0, 2), caller="other")
        assert question is not None
        assert isinstance(question.outcome, Message), question.outcome
        slowest = max(slowest, world.now - begun)
        done += 1
        world.run(0.05)
    assert slowest < 2 * (timeout + 1.0) + 0.5
    assert done > 90


# --- the oracle itself --------------------------------------------------------------------------------


def test_the_oracle_sees_a_reply_of_another_call() -> None:
    world = World(1, UnitModel(1))
    world.get(1, ReadHoldingRegisters(0, 2))
    world.double(world.replies[-1], PROMPT / 2)
    with pytest.raises(Breach, match="was completed with"):
        world.get(1, ReadHoldingRegisters(10, 2))


def test_the_oracle_sees_exceptions_of_another_call() -> None:
    world = World(1, UnitModel(1, refuses=1.0))
    first = world.get(1, ReadHoldingRegisters(0, 2))
    assert first is not None
    assert isinstance(first.outcome, ModbusError)
    world.double(world.replies[-1], PROMPT / 2)
    with pytest.raises(Breach, match="was completed with"):
        world.get(1, ReadHoldingRegisters(10, 2))

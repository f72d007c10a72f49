"""No way round a rule: points with rules of writing by chance, commanded on all ways by all callers, and an oracle that
says from the documentation alone what may reach the device.

Each point has an address of its own, and each write is judged by what was asked just before it, so the record of the
device shows who got round which rule.
"""

import asyncio
import itertools
import json
import math
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from examples import examples
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from ruled_plant import RuledPlant
from waiting import until

from busway.apps.collector.commands.command import CommandResult
from busway.apps.collector.commands.rights import WriterRights
from busway.apps.collector.commands.runner import NoSuchPoint
from busway.codes import Table
from busway.errors import InvalidRequest
from busway.points import Point, WriteRule
from busway.values import value_type

DAY = 86_400.0
MINUTE = 60.0
RANKS = {"": 1, "view": 1, "operate": 2, "configure": 3}
NAMES = ("set", "Set", "s\u00e9t", "se\u0301t", "a/b", "a_b")
"""Names that differ in case, in how a letter is composed, and in what becomes the same level of a topic."""
STRANGE = ("SET", "set ", "\uff53et", "set\u200b", "set\x00", "", "s" * 201, "level", "boiler/set", "*", "../set")
"""Names that are those of no point, or of one that is only read."""
VALUES = (20, 10, 50, 7, 17, 100, 20.0, 0, 51, 101, 65_535, 65_536, -1, 20.5, 20.000001, True, "20", [20], 1e300)
KEYS = ("k0", "k1", "k2", "K0", "k" * 100)
WRONG_KEYS = ("busway-1", "k" * 101, "k\u00e9", " k0", "", "k0\n")
LATER = (30.0, 30.0, 30.0, 1e-3 + 30, 0.0, -1.0, DAY, DAY + 1, math.inf)
NO_KEYS: tuple[Any, ...] = ("busway-0", "", "\ud800", "x" * 5000, None, 5, [], {}, ["k0"], True)
TOKENS = {
    "vera-0123456789-vera": ("vera", "view"),
    "olga-0123456789-olga": ("olga", "operate"),
    "carl-0123456789-carl": ("carl", "configure"),
    "sam-00123456789-sam1": ("sam", "operate"),
    "sam-00123456789-sam2": ("sam", "configure"),
    "rosa-0123456789-rosa": ("rosa", "configure"),
}
CALLERS = ("", *TOKENS)
SENDERS = ("", "anna", "bert", "x" * 100 + "1", "x" * 100 + "2")
SINKS = {
    "broker": ("mqtt", ("boiler/*",)),
    "olga": ("mqtt", ("boiler/set", "*/S*")),  # has the name of a person
    "carl": ("nats", ("b*/s?t", "boiler/[ab]*", "boiler/level")),
    "scada": ("sparkplug", ("boiler/*",)),
}
PERMITTED = {
    "broker": set(NAMES) - {"a/b", "a_b"},  # one topic for two points
    "olga": {"set", "Set"},
    "carl": {"set", "s\u00e9t"},
    "scada": set(NAMES),
}


@dataclass(frozen=True)
class Rule:
    """What the file says of a point."""

    is_writable: bool
    role: str
    is_armed: bool
    low: int
    high: int
    step: int | None
    is_shown: bool

    def keeps(self, value: Any) -> bool:
        """Whether a value may be written."""
        if isinstance(value, bool) or not isinstance(value, int) or not self.is_writable:
            return False
        return self.low <= value <= self.high and (self.step is None or (value - self.low) % self.step == 0)

    def takes(self, role: str) -> bool:
        return self.is_writable and RANKS[role] >= RANKS[self.role]


@dataclass
class Armed:
    """A command that waits to be confirmed."""

    writer: tuple[str, str]
    """The way, and who on it."""
    point: str
    value: Any
    now: float
    moment: float
    generation: int
    was_tried: bool = field(default=False)


rules = st.builds(
    Rule,
    is_writable=st.sampled_from([True, True, True, False]),
    role=st.sampled_from(["operate", "operate", "configure"]),
    is_armed=st.sampled_from([False, False, True]),
    low=st.sampled_from([0, 0, 7, 10]),
    high=st.sampled_from([50, 100, 65_535]),
    step=st.sampled_from([None, 1, 7, 10]),
    is_shown=st.booleans(),
)
plants = st.lists(rules, min_size=len(NAMES), max_size=len(NAMES))
roles = st.sampled_from(["operate", "operate", "configure"])
points = st.sampled_from([*NAMES, *NAMES, "set", "set", *STRANGE])
values = st.one_of(st.sampled_from([20, 10, 50]), st.sampled_from(VALUES))
laters = st.sampled_from(LATER)
keys = st.one_of(st.none(), st.none(), st.sampled_from(KEYS), st.sampled_from(WRONG_KEYS))
waits = st.sampled_from([0.0, 0.0, 0.0, 4.0, 10.0, 11.0])
lives = st.sampled_from([None, None, None, 0.0, 9.0, 1e9])


class Ways:
    """All ways to a plant, and what the documentation says of each deed on them."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self.folder = tempfile.TemporaryDirectory()
        self.held: dict[str, Rule] = {}
        self.places = list(range(len(NAMES)))
        self.used: set[str] = set()
        self.armed: dict[str, Armed] = {}
        self.sink_roles = dict.fromkeys(SINKS, "operate")
        self.generation = self.number = self.seen = self.done = 0

    def begin(self, found: list[Rule], roles: list[str]) -> None:
        self.sink_roles = dict(zip(SINKS, roles, strict=True))
        self.held = dict(zip(NAMES, found, strict=True))
        self.plant = RuledPlant(Path(self.folder.name), self.made_points(), dict(TOKENS))
        self.run(self.plant.start())
        self.set_inputs()

    def made_points(self) -> list[Point]:
        made = []
        for place, (name, each) in zip(self.places, self.held.items(), strict=True):
            verify = "read-back" if each.is_shown else "none"
            # `WriteRule` has the words of the file: the name of each of its fields is that of a key.
            writing = WriteRule(6, verify, each.low, each.high, each.step, role=each.role, armed=each.is_armed)  # type: ignore[arg-type]
            writes = writing if each.is_writable else None
            made.append(Point(name, Table.HOLDING_REGISTERS, place, value_type("uint16"), writing=writes))
        return made

    def set_inputs(self) -> None:
        for name, (kind, patterns) in SINKS.items():
            self.plant.add_input(name, kind, patterns, self.sink_roles[name])

    def teardown(self) -> None:
        if hasattr(self, "plant"):
            self.run(self.plant.stop())
        self.loop.close()
        self.folder.cleanup()

    def run(self, made: Any) -> Any:
        return self.loop.run_until_complete(made)

    # What may reach the device.

    def image(self, point: str, value: Any) -> tuple[int, int]:
        return self.places[NAMES.index(point)], int(value)

    def may(self, point: str, value: Any, role: str, *, in_two_steps: bool = False) -> bool:
        rule = self.held.get(point)
        if rule is None or self.plant.is_paused:
            return False
        return rule.takes(role) and rule.keeps(value) and (in_two_steps or not rule.is_armed)

    def is_time(self, expires: float) -> bool:
        return 0 < expires - self.plant.now <= DAY

    def wrote(self, permitted: tuple[int, int] | None, what: Any) -> bool:
        """Judge what the device has got by one deed; return whether it got something."""
        got = self.plant.device.writes[self.seen :]
        self.seen += len(got)
        assert got == ([] if permitted is None else [permitted]), (got, permitted, what)
        return bool(got)

    def one_step(self, key: str | None, point: str, value: Any, role: str, expires: float) -> tuple[int, int] | None:
        """What one step may write; its key is used from now on where it is one, and there is such a point."""
        if key in WRONG_KEYS or (point not in NAMES and point != "level"):
            return None
        is_new = key is None or key not in self.used
        if key is not None and math.isfinite(expires):
            self.used.add(key)
        is_permitted = is_new and self.may(point, value, role) and self.is_time(expires)
        return self.image(point, value) if is_permitted else None

    # One step.

    def page_writes(self, token: str, point: str, value: Any, key: str | None, later: float) -> None:
        expires = self.plant.now + later
        role = self.plant.tokens[token][1] if token else ""
        body = {"device": "boiler", "point": point, "value": value, "expires": expires}
        status, answer = self.run(self.plant.page(token, "", body if key is None else body | {"key": key}))
        may_ask = RANKS[role] >= RANKS["operate"] and 0 < len(point) <= 200 and (key is None or len(key) <= 100)
        assert status < 500, answer
        permitted = self.one_step(key, point, value, role, expires) if may_ask else None
        if self.wrote(permitted, (token, body, answer)):
            assert answer["state"] == "done", answer

    def program_writes(self, point: str, value: Any, key: str | None, later: float) -> None:
        expires = self.plant.now + later
        write = self.plant.commands.write("boiler", point, value, by="plan", origin="program", expires=expires, key=key)
        answer = self.run(_refused_or(write))
        self.wrote(self.one_step(key, point, value, "configure", expires), answer)

    def fleet_writes(self, point: str, value: Any, key: str | None, later: float, role: Any) -> None:
        self.number += 1
        expires = self.plant.now + later
        content = {"key": f"f{self.number}" if key is None else key, "device": "boiler", "point": point, "value": value}
        content |= {"expires": expires} | ({} if role is None else {"role": role})
        answer = self.run(self.plant.fleet(content))
        is_role = role in (None, "operate", "configure")
        permitted = self.one_step(content["key"], point, value, role or "configure", expires) if is_role else None
        self.wrote(permitted, (content, answer))

    def sink_writes(
        self,
        sink: str,
        point: str,
        value: Any,
        key: str | None,
        later: float | None,
        waited: float,
        life: float | None,
        retained: bool,
    ) -> None:
        arrived = self.plant.now - waited
        expires = arrived + 10 if later is None else self.plant.now + later
        content = {"value": value} | ({} if key is None else {"key": key})
        content |= {} if later is None else {"expires": expires}
        expires = expires if life is None else min(expires, arrived + life)
        answer = self.send(sink, point, content, waited=waited, life=life, retained=retained)
        is_there = point in PERMITTED[sink] and self.held[point].is_writable and not retained
        role = self.sink_roles[sink]
        permitted = self.one_step(key, point, value, role, expires) if is_there else None
        if self.wrote(permitted, (sink, point, content, answer)):
            assert answer["state"] == "done", answer

    def send(
        self,
        sink: str,
        point: str,
        content: Any,
        *,
        waited: float = 0.0,
        life: float | None = None,
        retained: bool = False,
    ) -> dict[str, Any]:
        more = {"arrived": self.plant.moment - waited, "seconds_left": life, "is_retained": retained}
        answer: dict[str, Any] = self.run(self.plant.message(sink, point, json.dumps(content).encode(), **more))
        return answer

    # Two steps.

    def note_armed(self, key: str | None, permitted: bool, writer: tuple[str, str], point: str, value: Any) -> None:
        self.wrote(None, "to arm sends nothing")
        assert (key is not None) is permitted, (key, writer, point, value, self.held.get(point))
        if key is not None:
            plant = self.plant
            self.armed[key] = Armed(writer, point, value, plant.now, plant.moment, self.generation)

    def page_arms(self, token: str, point: str, value: Any) -> None:
        name, role = self.plant.tokens[token] if token else ("", "")
        body = {"device": "boiler", "point": point, "value": value}
        status, answer = self.run(self.plant.page(token, "/arm", body))
        assert status < 500, answer
        key = answer["key"] if status == 200 else None
        self.note_armed(key, self.may(point, value, role, in_two_steps=True), ("page", name), point, value)

    def program_arms(self, point: str, value: Any, role: str) -> None:
        made, rights = self.plant.commands, WriterRights(role)
        try:
            key = made.arm("boiler", point, value, by="plan", origin="program", rights=rights).command.key
        except InvalidRequest:
            key = None
        self.note_armed(key, self.may(point, value, role, in_two_steps=True), ("program", "plan"), point, value)

    def sink_arms(
        self,
        sink: str,
        point: str,
        value: Any,
        by: str,
        waited: float = 0.0,
        life: float | None = None,
        *,
        retained: bool = False,
    ) -> None:
        content = {"value": value, "arm": True} | ({"by": by} if by else {})
        answer = self.send(sink, point, content, waited=waited, life=life, retained=retained)
        key = answer["key"] if answer["state"] == "armed" else None
        in_time = waited < min(10.0, math.inf if life is None else life)
        is_there = point in PERMITTED[sink] and not retained and len(by) <= 100 and in_time
        permitted = is_there and self.may(point, value, self.sink_roles[sink], in_two_steps=True)
        self.note_armed(key, permitted, (sink, by), point, value)

    def confirmed(self, key: Any, writer: tuple[str, str], role: str, *, point: str | None = None) -> Any:
        """What a confirmation may write; whether it must, where nothing was tried with the key before."""
        armed = self.armed.get(key) if isinstance(key, str) else None
        if armed is None or armed.writer != writer or point not in (None, armed.point):
            return None
        plant = self.plant
        in_time = plant.moment < armed.moment + MINUTE and plant.now < armed.now + MINUTE
        is_permitted = in_time and armed.generation == self.generation and not armed.was_tried
        armed.was_tried = True
        if not is_permitted or not self.may(armed.point, armed.value, role, in_two_steps=True):
            return None
        return self.image(armed.point, armed.value)

    def page_confirms(self, key: str, token: str) -> None:
        name, role = self.plant.tokens[token] if token else ("", "")
        status, answer = self.run(self.plant.page(token, f"/{key}/confirm"))
        assert status < 500, answer
        permitted = self.confirmed(key, ("page", name), role) if RANKS[role] >= RANKS["operate"] else None
        self.wrote(permitted, (token, key, answer))

    def program_confirms(self, key: Any, role: str) -> None:
        confirm = self.plant.commands.confirm(key, by="plan", origin="program", rights=WriterRights(role))
        answer = self.run(_refused_or(confirm))
        self.wrote(self.confirmed(key, ("program", "plan"), role), (key, answer))

    def sink_confirms(
        self, key: Any, sink: str, point: str, by: str, waited: float = 0.0, life: float | None = None
    ) -> None:
        answer = self.send(sink, point, {"confirm": key} | ({"by": by} if by else {}), waited=waited, life=life)
        assert answer["state"] != "armed"
        is_there = point in PERMITTED[sink] and self.held[point].is_writable and len(by) <= 100
        permitted = self.confirmed(key, (sink, by), self.sink_roles[sink], point=point) if is_there else None
        in_time = waited < min(10.0, math.inf if life is None else life)
        self.wrote(permitted if in_time else None, (sink, point, by, key, answer))

    def confirm_over_http(self, data: st.DataObject, token: str) -> None:
        self.page_confirms(data.draw(st.sampled_from(list(self.armed))), token)

    def confirm_by_a_program(self, data: st.DataObject, role: str) -> None:
        self.program_confirms(data.draw(st.sampled_from([*self.armed, *KEYS, *NO_KEYS])), role)

    def confirm_by_a_message(self, data: st.DataObject, sink: str, point: str, by: str) -> None:
        self.sink_confirms(data.draw(st.sampled_from([*self.armed, *KEYS, *NO_KEYS])), sink, point, by)

    # What changes meanwhile.

    def read_again(self, found: list[Rule], data: st.DataObject) -> None:
        self.use(found, data)
        self.run(self.plant.reload(self.made_points()))

    def use(self, found: list[Rule], data: st.DataObject) -> None:
        self.held = dict(zip(NAMES, found, strict=True))
        self.places = data.draw(st.permutations(range(len(NAMES))))
        self.generation += 1

    def change_the_role_of_a_sink(self, sink: str, role: str) -> None:
        self.sink_roles[sink] = role
        self.set_inputs()

    def change_the_role_of_a_person(self, role: str) -> None:
        self.plant.tokens["rosa-0123456789-rosa"] = ("rosa", role)

    def maintain(self, begins: bool) -> None:
        self.plant.maintain(begins)

    def pass_time(self, seconds: float) -> None:
        self.plant.now += seconds
        self.plant.moment += seconds

    def set_the_clock(self, seconds: float) -> None:
        self.plant.now += seconds

    # Commands that wait while another file is read, a role is taken away, or their time passes.

    def let_commands_wait(self, data: st.DataObject, found: list[Rule], seconds: float, begins: bool) -> None:
        asked: list[tuple[str, int, str, float]] = []
        for number in range(4):  # numbers of their own: the record shows which of them it was
            point, token = data.draw(st.sampled_from(NAMES)), data.draw(st.sampled_from(list(TOKENS)[1:5]))
            asked.append((point, 10 * (number + 1), token, self.plant.now + data.draw(st.sampled_from([30.0, 90.0]))))
        confirm = None
        if self.armed:
            confirm = self.confirm_by_its_writer(data.draw(st.sampled_from(list(self.armed))))
        before = [
            self.may(point, value, TOKENS[token][1]) and self.is_time(expires) for point, value, token, expires in asked
        ]
        self.run(self.wait_and_change(asked, confirm, lambda: self.change(data, found, seconds, begins)))
        got = self.plant.device.writes[self.seen :]
        self.seen += len(got)
        may_be = [
            self.image(point, value)
            for could, (point, value, token, expires) in zip(before, asked, strict=True)
            if could and self.may(point, value, TOKENS[token][1]) and self.is_time(expires)
        ]
        assert not Counter(got) - Counter(may_be), (got, may_be, asked)

    def confirm_by_its_writer(self, key: str) -> Any:
        """A confirmation by who may; after the change it must not write any more, as its link was begun anew."""
        armed = self.armed[key]
        armed.was_tried = True
        if armed.writer[0] != "page":
            return None
        token = next(each for each in TOKENS if TOKENS[each][0] == armed.writer[1])
        return self.plant.page(token, f"/{key}/confirm")

    async def wait_and_change(self, asked: list[tuple[str, int, str, float]], confirm: Any, change: Any) -> None:
        plant = self.plant
        plant.claims.released.clear()
        waiting = [asyncio.create_task(confirm)] if confirm is not None else []
        for point, value, token, expires in asked:
            body = {"device": "boiler", "point": point, "value": value, "expires": expires}
            waiting.append(asyncio.create_task(plant.page(token, "", body)))
        await until(lambda: plant.claims.waiting + sum(each.done() for each in waiting) == len(waiting))
        assert self.plant.device.writes[self.seen :] == []
        change()
        await plant.reload(self.made_points())
        plant.claims.released.set()
        await asyncio.gather(*waiting)

    def change(self, data: st.DataObject, found: list[Rule], seconds: float, begins: bool) -> None:
        self.use(found, data)
        self.plant.now += seconds
        self.plant.moment += seconds
        self.plant.is_paused = begins and seconds == 0.0

    def nothing_else_was_written(self) -> None:
        if hasattr(self, "plant"):
            assert len(self.plant.device.writes) == self.seen


class Commanded(Ways, RuleBasedStateMachine):
    """All callers on all ways, in any order."""

    def __init__(self) -> None:
        RuleBasedStateMachine.__init__(self)
        Ways.__init__(self)

    begin = initialize(found=plants, roles=st.lists(roles, min_size=len(SINKS), max_size=len(SINKS)))(Ways.begin)
    write_over_http = rule(token=st.sampled_from(CALLERS), point=points, value=values, key=keys, later=laters)(
        Ways.page_writes
    )
    write_by_a_program = rule(point=points, value=values, key=keys, later=laters)(Ways.program_writes)
    write_over_a_fleet = rule(
        point=points,
        value=values,
        key=keys,
        later=laters,
        role=st.sampled_from([None, "operate", "configure", "view", "", "admin", 3, ["configure"]]),
    )(Ways.fleet_writes)
    write_by_a_message = rule(
        sink=st.sampled_from(list(SINKS)),
        point=st.sampled_from([*NAMES, "level", "SET", "s"]),
        value=values,
        key=keys,
        later=st.one_of(st.none(), laters),
        waited=waits,
        life=lives,
        retained=st.sampled_from([False, False, False, True]),
    )(Ways.sink_writes)
    arm_over_http = rule(token=st.sampled_from(CALLERS), point=points, value=values)(Ways.page_arms)
    arm_by_a_program = rule(point=points, value=values, role=st.sampled_from(["view", "operate", "configure"]))(
        Ways.program_arms
    )
    arm_by_a_message = rule(
        sink=st.sampled_from(list(SINKS)),
        point=st.sampled_from(NAMES),
        value=values,
        by=st.sampled_from(SENDERS),
        waited=waits,
        life=lives,
        retained=st.sampled_from([False, False, False, True]),
    )(Ways.sink_arms)
    confirm_over_http = precondition(lambda self: self.armed)(
        rule(data=st.data(), token=st.sampled_from(CALLERS))(Ways.confirm_over_http)
    )
    confirm_by_a_program = rule(data=st.data(), role=st.sampled_from(["configure", "operate", "view"]))(
        Ways.confirm_by_a_program
    )
    confirm_by_a_message = rule(
        data=st.data(), sink=st.sampled_from(list(SINKS)), point=st.sampled_from(NAMES), by=st.sampled_from(SENDERS)
    )(Ways.confirm_by_a_message)
    read_again = rule(found=plants, data=st.data())(Ways.read_again)
    change_the_role_of_a_sink = rule(sink=st.sampled_from(list(SINKS)), role=roles)(Ways.change_the_role_of_a_sink)
    change_the_role_of_a_person = rule(role=st.sampled_from(["view", "operate", "configure"]))(
        Ways.change_the_role_of_a_person
    )
    maintain = rule(begins=st.sampled_from([True, False, False]))(Ways.maintain)
    pass_time = rule(seconds=st.sampled_from([1.0, 9.0, 40.0, 60.0]))(Ways.pass_time)
    set_the_clock = rule(seconds=st.sampled_from([-3600.0, 3600.0, -10.0]))(Ways.set_the_clock)
    let_commands_wait = rule(
        data=st.data(), found=plants, seconds=st.sampled_from([0.0, 0.0, 20.0, 31.0]), begins=st.booleans()
    )(Ways.let_commands_wait)
    nothing_else_was_written = invariant()(Ways.nothing_else_was_written)


async def _refused_or(made: Any) -> CommandResult | str:
    try:
        result: CommandResult = await made
    except (InvalidRequest, NoSuchPoint) as error:
        return error.message
    return result


class Tried(Ways):
    """Everything on each way, one after the other, at a plant whose points have one rule."""

    def __init__(self) -> None:
        super().__init__()
        self.begin([Rule(True, "operate", False, 0, 100, None, False)] * len(NAMES), ["operate"] * len(SINKS))

    def use_rule(self, role: str, *, is_armed: bool) -> None:
        """Use one rule for all points; all callers have the roles that they had at first."""
        self.held = dict.fromkeys(NAMES, Rule(True, role, is_armed, 0, 100, None, False))
        self.plant.tokens.update(TOKENS)
        self.plant.is_paused = False
        self.generation += 1
        self.run(self.plant.reload(self.made_points()))

    def use_sinks(self, role: str) -> None:
        self.sink_roles = dict.fromkeys(SINKS, role)
        self.set_inputs()

    def arms(self, way: str, who: str, role: str) -> str:
        before = set(self.armed)
        if way == "page":
            self.page_arms(who, "set", 20)
        elif way == "program":
            self.program_arms("set", 20, role)
        else:
            self.sink_arms(way, "set", 20, who)
        (key,) = self.armed.keys() - before
        return key

    def confirms(self, key: str, way: str, who: str, waited: float = 0.0, life: float | None = None) -> None:
        if way == "page":
            self.page_confirms(key, who)
        elif way == "program":
            self.program_confirms(key, "configure")
        else:
            self.sink_confirms(key, way, "set", who, waited, life)

    def between(self, way: str, who: str) -> Iterator[Callable[[str], None]]:
        """What may come between the two steps."""
        yield lambda key: None
        yield lambda key: self.program_confirms(key, "configure")
        yield lambda key: self.program_confirms(key, "operate")
        yield from (partial(self.page_confirms, token=token) for token in CALLERS)
        for sink, by in itertools.product(SINKS, SENDERS):
            yield partial(self.sink_confirms, sink=sink, point="set", by=by)
        if way in SINKS:
            yield lambda key: self.sink_confirms(key, way, "Set", who)
            yield lambda key: self.confirms(key, way, who, waited=10.0)
            yield lambda key: self.confirms(key, way, who, life=0.0)
            yield lambda key: self.confirms(key, way, who, waited=9.0, life=9.0)
        for seconds, clock in ((59.0, 59.0 - 3600), (60.0, 0.0), (60.0, -3600.0), (61.0, 61.0), (0.0, 60.0)):
            yield partial(self.pass_both, seconds=seconds, clock=clock)
        yield lambda key: self.maintain(True)
        yield lambda key: self.change_the_role_of_a_person("operate")
        yield lambda key: self.use_sinks("operate")
        yield lambda key: self.use_rule("operate", is_armed=True)

    def pass_both(self, key: str, seconds: float, clock: float) -> None:
        self.plant.moment += seconds
        self.plant.now += clock


@pytest.fixture
def tried() -> Iterator[Tried]:
    made = Tried()
    yield made
    made.teardown()


@pytest.mark.parametrize("needed", ["operate", "configure"])
@pytest.mark.parametrize("is_armed", [False, True])
def test_one_step_writes_what_its_writer_may_on_each_way_and_nothing_else(
    tried: Tried, needed: str, is_armed: bool
) -> None:
    tried.use_rule(needed, is_armed=is_armed)
    for token in CALLERS:
        tried.page_writes(token, "set", 20, None, 30.0)
    for name in (*NAMES, *STRANGE):
        tried.page_writes(list(TOKENS)[2], name, 20, None, 30.0)
    for value in VALUES:
        tried.program_writes("set", value, None, 30.0)
    for key in (*KEYS, *WRONG_KEYS, "k0"):
        tried.program_writes("set", 20, key, 30.0)
    for later in LATER:
        tried.page_writes(list(TOKENS)[2], "set", 20, None, later)
    for role in (None, "operate", "configure", "view", "", "admin", 3, ["configure"]):
        tried.fleet_writes("set", 20, None, 30.0, role)
    for role in ("operate", "configure"):
        tried.use_sinks(role)
        for sink, name in itertools.product(SINKS, (*NAMES, "SET", "level")):
            tried.sink_writes(sink, name, 20, None, None, 0.0, None, False)
        for waited, life, retained in ((0.0, None, True), (10.0, None, False), (9.0, 9.0, False), (9.0, 1e9, False)):
            tried.sink_writes("broker", "set", 20, None, None, waited, life, retained)
    has_written = bool(tried.plant.device.writes)
    assert has_written is not is_armed


@pytest.mark.parametrize(
    ("way", "who", "role"),
    [
        *(("page", token, role) for token, (_, role) in TOKENS.items() if role != "view"),
        ("program", "plan", "configure"),
        *((sink, by, "configure") for sink in SINKS for by in SENDERS[:2]),
    ],
)
def test_a_command_in_two_steps_is_sent_for_its_writer_alone_whatever_comes_between(
    tried: Tried, way: str, who: str, role: str
) -> None:
    for come_between in tried.between(way, who):
        tried.use_rule(role, is_armed=True)  # just what this writer has
        tried.use_sinks("configure")
        key = tried.arms(way, who, role)
        come_between(key)
        tried.confirms(key, way, who)
        tried.confirms(key, way, who)
        tried.nothing_else_was_written()
    assert tried.plant.device.writes


@pytest.fixture(autouse=True)
def _quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busway.apps.collector.commands.runner.SHOWN_AFTER", (0.0, 0.0))


TestCommanded = Commanded.TestCase
TestCommanded.settings = settings(max_examples=examples(20), stateful_step_count=30, deadline=None)

"""A walk by chance of people and programs that command a plant, and an oracle of what may be on the wire then.

Written from the documentation alone.

1. A *ticket* permits one write: a key, once and for ever, or one message without a key. It is valid where the value
   keeps the rule of its point, and the caller may write it on that way.
2. Each write on the wire needs a ticket of its own that asked for this very thing, and was not told to be unsent.
3. What was told of a ticket stays true; what was told to be done is on the wire once.
4. The result of a write is what the device did with it: refused is failed, no answer is unknown, and what it does not
   hold is not done where the rule asks for reading back.
5. The audit log has each command that ended, with who, on which way, and what; one line, in the order of the wire.
"""

import concurrent.futures
import json
import math
import os
import random
import signal
import subprocess
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from typing import Any

from command_plant import PEOPLE, CommandedPlant, Image, Told, Wish
from wire_recorder import WireRequest

SLACK = 5.0
"""Seconds that a write may be seen after its time is over: how long a busy machine may stand still."""
FINAL = {"done", "failed", "unknown", "expired"}
NOT_SENT = {"expired", "refused"}
SHOWN = {"whole", "heat", "coil"}
"""The points that are read back."""
ENDS = {"refuse": {"failed"}, "other": {"failed", "unknown"}, "overwritten": {"failed", "unknown"}}
ENDS |= {deed: {"unknown"} for deed in ("silent", "lost", "late", "later", "cut", "cut before")}
"""What may be said of a write with which the device did this; of another, anything that says it may have been sent."""
BROKER_POINTS = ("*/whole", "*/scaled", "hall-?/text", "hall-1/heat", "*/level")
DEEDS = ("refuse", "silent", "lost", "late", "later", "cut", "cut before", "other", "overwritten")

ALL_DEEDS = (
    *("fresh",) * 12,
    *("again",) * 10,
    *("at_once",) * 8,
    *("on_the_page",) * 8,
    *("wrong",) * 8,
    *("behave",) * 4,
    *("soon_over",) * 4,
    *("link",) * 4,
    *("kill",) * 2,
    *("read_again",) * 2,
    *("pause",) * 2,
    *("terminate", "maintain", "broker", "second"),
)


def keeps_the_rule(point: str, value: Any) -> bool:
    """Whether a value may be written to a point, by the device file of `command_plant`."""
    number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    if point == "whole":
        return number and 10 <= value <= 60000 and value == int(value) and int(value) % 10 == 0
    if point == "scaled":
        return number and -1000 <= value <= 1_000_000 and (value * 2) == int(value * 2)
    if point == "heat":
        return number and 0 <= value <= 100_000
    if point == "text":
        return isinstance(value, str) and value.isascii() and len(value) <= 16
    if point in ("pump", "door", "coil"):
        return isinstance(value, bool)
    return point == "mode" and value in ("off", "auto", "hand")


def is_permitted(by: str, way: str, wish: Wish) -> bool:
    """Whether this caller may write this point on this way."""
    if way in ("api", "page"):
        return by in PEOPLE and PEOPLE[by][0] != "view"
    return any(fnmatch(f"{wish.device}/{wish.point}", pattern) for pattern in BROKER_POINTS)


@dataclass
class Ticket:
    """A permission to write once.

    Attributes:
        images: what it may be on the wire, with the wishes that ask for it.
        told: by wish, the answers that name a state.
    """

    name: str
    images: dict[Image, Wish] = field(default_factory=dict)
    told: dict[Wish, list[Told]] = field(default_factory=lambda: defaultdict(list))
    until: float = 0.0

    def states(self, wish: Wish) -> set[str]:
        return {each.state for each in self.told[wish]}


class CommandWalk:
    """What happens by chance, and what was told of it."""

    def __init__(self, plant: CommandedPlant, seed: int) -> None:
        self.plant, self.chance = plant, random.Random(seed)
        self.number = 0
        self.told: list[Told] = []
        self.used: list[Wish] = []
        self.sent: list[tuple[str, str, Wish, float]] = []
        self.confirmed: set[str] = set()
        self.armed: dict[str, tuple[Wish, str]] = {}
        self.kills: list[float] = []
        self._pool = concurrent.futures.ThreadPoolExecutor(16)
        self._pending: list[concurrent.futures.Future[object]] = []
        self.down: set[str] = set()

    # What happens.

    def run(self, steps: int, ends: int = 1000) -> None:
        """Do so many things, and end the collector so often at most."""
        for _ in range(steps):
            deed = self.chance.choice(ALL_DEEDS)
            if deed in ("kill", "terminate", "second") and len(self.kills) >= ends:
                deed = "fresh"
            print(f"{time.time():.3f} {deed}")
            getattr(self, deed)()
            assert self.plant.process.poll() is None, self.plant.log()
            if self.chance.random() < 0.5:
                time.sleep(self.chance.uniform(0, 0.15))

    def settle(self) -> None:
        """Let all be well, and ask once more for what was not told to have ended."""
        for link in sorted(self.down):
            self.plant.wire.bring_up(link)
        for unit in self.plant.wire.units.values():
            unit.next.clear()
            unit.usual = "done"
        self.collect()
        self._again(signal.SIGKILL)
        for device in self.plant.places:
            self.plant.ask("POST", f"devices/{device}/maintenance", {"on": False, "reason": "end"}, "anna")
        for wish in dict.fromkeys(self.used):
            if wish.key is not None and not any(told.wish == wish and told.state in FINAL for told in self.told):
                self.note("anna", "api", wish, time.time() + 30)
                self.told.append(self.plant.send(wish, "anna", "api"))
        self._pool.shutdown()

    def collect(self) -> None:
        """Wait for all answers."""
        done, waiting = concurrent.futures.wait(self._pending, 60)
        assert not waiting, "an answer never came"
        for each in done:
            each.result()
        self._pending.clear()

    def wish(self, key: str | None = None, *, device: str = "", point: str = "") -> Wish:
        """Something new: a value that was not asked for yet, where the point has so many."""
        self.number += 1
        n = self.number
        point = point or self.chance.choice(
            ("whole",) * 4 + ("scaled", "heat", "text", "text", "scaled", "pump", "door", "mode", "coil")
        )
        values: dict[str, Any] = {
            "whole": 10 + 10 * (n % 5999),
            "scaled": n * 0.5,
            "heat": float(n),
            "text": f"n{n}",
            "mode": self.chance.choice(("off", "auto", "hand")),
        }
        value = values.get(point, self.chance.random() < 0.5)
        return Wish(key, device or self.chance.choice(list(self.plant.places)), point, value)

    def note(self, by: str, way: str, wish: Wish, until: float) -> None:
        self.sent.append((by, way, wish, until))

    def give(self, wish: Wish, by: str, way: str, seconds: float = 30.0) -> None:
        """Send it, and take the answer when it comes."""
        self.used.append(wish)
        if self.chance.random() < 0.15:
            self.plant.wire.units[self.plant.places[wish.device]].next.append(self.chance.choice(DEEDS))
        self.note(by, way, wish, time.time() + seconds)

        def send() -> None:
            self.told.append(self.plant.send(wish, by, way, seconds))

        self._pending.append(self._pool.submit(send))

    def _new_key(self) -> str | None:
        return None if self.chance.random() < 0.2 else f"k{self.number}.{self.chance.randrange(1000)}"

    def _who(self, wish: Wish) -> tuple[str, str]:
        by, way = self.chance.choice(("anna", "ben", "carl")), self.chance.choice(self.plant.ways)
        return by, way if is_permitted(by, way, wish) or self.chance.random() < 0.1 else "api"

    def fresh(self) -> None:
        """Some new commands at once."""
        device = self.chance.choice(["", "hall-1"])
        for _ in range(self.chance.randrange(1, 5)):
            wish = self.wish(self._new_key(), device=device)
            self.give(wish, *self._who(wish))

    def _another(self, wish: Wish) -> Wish:
        """The same, or the same key for something else."""
        roll = self.chance.random()
        if roll < 0.6:
            return wish
        if roll < 0.8:
            return replace(self.wish(wish.key, device=wish.device, point=wish.point))
        if roll < 0.9:
            return self.wish(wish.key)
        return replace(wish, device=self.chance.choice(list(self.plant.places)))

    def again(self) -> None:
        """Keys that were used, by any sender, on any way."""
        keyed = [wish for wish in self.used if wish.key is not None]
        for _ in range(self.chance.randrange(1, 4) if keyed else 0):
            wish = self.chance.choice(keyed[-5:] if self.chance.random() < 0.5 else keyed)
            other = self._another(wish)
            self.give(other, *self._who(other))

    def at_once(self) -> None:
        """One new key several times at once, also for other things, and by those who may not."""
        wish = self.wish(f"k{self.number}.at-once")
        for _ in range(self.chance.randrange(2, 5)):
            other = self._another(wish)
            self.give(other, *self._who(other))
        if self.chance.random() < 0.3:
            self.give(self._another(wish), "vera", "api")

    def soon_over(self) -> None:
        """Several for one device, whose time is over soon."""
        device = self.chance.choice(list(self.plant.places))
        for _ in range(self.chance.randrange(1, 5)):
            wish = self.wish(self._new_key(), device=device)
            self.give(wish, *self._who(wish), self.chance.choice((0.0, 0.01, 0.1, 0.5)))

    def wrong(self) -> None:
        """What no sender may write, and what this one may not."""
        wish = self.wish(self._new_key())
        if self.plant.mqtt is not None and self.chance.random() < 0.3:
            self.plant.retained(self.wish(point="whole"))
        point, n = wish.point, self.number
        bad: dict[str, list[Any]] = {
            "whole": [10 * n + 1, 0, 60010, -10, 1e300, str(10 * n), True, None, (10 * n,)],
            "scaled": [n * 0.5 + 0.25, 1_000_001, "1", False, 2**70],
            "heat": [-1, 100_001, 1e39, "nan", "1.5"],
            "text": ["x" * 17, 5, "é" * 20],
        }
        way = self.chance.choice(self.plant.ways) if is_permitted("", "mqtt", wish) else "api"
        roll = self.chance.random()
        if roll < 0.6 and point in bad:
            self.give(replace(wish, value=self.chance.choice(bad[point])), "anna", way)
        elif roll < 0.75:
            self.give(wish, self.chance.choice(("vera", "unknown")), "api")
        else:
            other = self.chance.choice(("level", "shown", "nothing", "whole-"))
            self.give(replace(wish, point=other, value=7), "anna", way)

    def on_the_page(self) -> None:
        """Armed by one, confirmed by several, several times."""
        wish, by = self.wish(), self.chance.choice(("anna", "ben"))

        def act() -> None:
            try:
                status, armed = self.plant.ask(
                    "POST", "commands/arm", {"device": wish.device, "point": wish.point, "value": wish.value}, by
                )
            except (OSError, ValueError):
                return
            if status != 200:
                return
            key = armed["key"]
            self.armed[key] = replace(wish, key=key), by

        self._pending.append(self._pool.submit(act))
        for key in self.chance.sample(sorted(self.armed), min(len(self.armed), 3)):
            self._confirm(key)

    def _confirm(self, key: str) -> None:
        wish, by = self.armed[key]
        who = by if self.chance.random() < 0.6 else self.chance.choice(("anna", "ben", "carl", "vera"))
        if who == by:
            self.confirmed.add(key)

        def act() -> None:
            told = Told(wish, who, "page", begun=time.time(), boot=self.plant.boot)
            try:
                told.status, told.content = self.plant.ask("POST", f"commands/{key}/confirm", by=who)
            except (OSError, ValueError):
                return
            told.state = str(told.content.get("state", ""))
            told.ended = time.time()
            self.told.append(told)
            if who != by and told.status == 200 and told.state not in NOT_SENT and key not in self.confirmed:
                self.told.append(replace(told, state="confirmed by another"))

        for _ in range(self.chance.choice((1, 1, 2, 3))):
            self._pending.append(self._pool.submit(act))

    def behave(self) -> None:
        """What a device does with its next writes."""
        unit = self.plant.wire.units[self.chance.choice(list(self.plant.wire.units))]
        roll = self.chance.random()
        if roll < 0.6:
            unit.next.extend(self.chance.choice(DEEDS) for _ in range(self.chance.randrange(1, 4)))
        elif roll < 0.8:
            unit.next.clear()
            unit.read_delay = self.chance.choice((0.0, 0.02, 0.1))
        else:
            unit.is_dead = not unit.is_dead and self.chance.random() < 0.3

    def link(self) -> None:
        """A link that ends, or comes back."""
        link = self.chance.choice(("hall", "roof"))
        if link in self.down:
            self.plant.wire.bring_up(link)
            self.down.discard(link)
        elif self.chance.random() < 0.6:
            self.plant.wire.cut(link)
        else:
            self.plant.wire.take_down(link)
            self.down.add(link)

    def maintain(self) -> None:
        """Begin or end maintenance."""
        device, on = self.chance.choice(list(self.plant.places)), self.chance.random() < 0.25

        def act() -> None:
            try:
                self.plant.ask("POST", f"devices/{device}/maintenance", {"on": on, "reason": "walk"}, "ben")
            except (OSError, ValueError):
                return

        self._pending.append(self._pool.submit(act))

    def read_again(self) -> None:
        """Another period: all links are begun anew, also while they write."""
        text = self.plant.configure(self.chance.choice((0.05, 0.1, 0.2)))
        if self.chance.random() < 0.5:
            self.plant.process.send_signal(signal.SIGHUP)
        else:
            self.plant.ask("POST", "configuration", text.encode(), "carl", **{"Content-Type": "application/toml"})

    def broker(self) -> None:
        """A broker that goes and comes."""
        servers = [server for server in (self.plant.mqtt, self.plant.nats) if server is not None]
        if servers:
            server = self.chance.choice(servers)
            server.stop()
            server.start()

    def second(self) -> None:
        """A second collector on the store: refused with the pid of the first."""
        done = subprocess.run(self.plant._command, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode != 0
        assert str(self.plant.process.pid) in done.stderr, done.stderr

    def pause(self) -> None:
        """The process stands still, as on a machine that sleeps."""
        self.plant.process.send_signal(signal.SIGSTOP)
        time.sleep(self.chance.uniform(0.05, 0.7))
        self.plant.process.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        """At any moment of what is under way."""
        if self.chance.random() < 0.7:
            self.fresh()
            time.sleep(self.chance.uniform(0, 0.08))
        self._again(signal.SIGKILL)

    def terminate(self) -> None:
        self._again(signal.SIGTERM)

    def _again(self, number: int) -> None:
        self.kills.append(time.time())
        code = self.plant.end(number)
        assert code in (0, -number), self.plant.log()
        self.plant.start()
        self.plant.wait_until_up()

    # What is wrong.

    def tickets(self) -> dict[str, Ticket]:
        """All that may be written."""
        found: dict[str, Ticket] = {}
        for count, (by, way, wish, until) in enumerate(self.sent):
            name = wish.key if wish.key is not None else f"#{count}"
            if is_permitted(by, way, wish) and keeps_the_rule(wish.point, wish.value):
                ticket = found.setdefault(name, Ticket(name))
                ticket.images[wish.image(self.plant.places)] = wish
                ticket.until = max(ticket.until, until)
        for key in self.confirmed:
            wish, _ = self.armed[key]
            found[key] = Ticket(key, {wish.image(self.plant.places): wish}, until=math.inf)
        for told in self.told:
            if told.state and told.wish.key in found and is_permitted(told.by, told.way, told.wish):
                assert told.wish.key is not None
                found[told.wish.key].told[told.wish].append(told)
        return found

    def problems(self) -> list[str]:
        tickets = self.tickets()
        wrong = [*self._words(tickets)]
        writes = [_image(write) for write in self.plant.wire.writes()]
        edges: list[list[str]] = [
            [
                name
                for name, ticket in tickets.items()
                if (wish := ticket.images.get(image)) is not None and self._may_be_sent(ticket, wish)
            ]
            for image in writes
        ]
        unmatched = _unmatched(edges)
        for number in unmatched:
            owners = [name for name, ticket in tickets.items() if writes[number] in ticket.images]
            said = {
                name: [told.content for told in tickets[name].told[tickets[name].images[writes[number]]]]
                for name in owners
            }
            wrong.append(f"a write without a ticket: {writes[number]}, wanted by {said}")
        wrong += self._not_written(tickets, writes)
        wrong += self._late(tickets)
        wrong += self._deeds(tickets)
        wrong += self._audit(tickets)
        print(f"{len(self.sent)} sent, {len(writes)} writes, {len(tickets)} tickets, {len(self.kills)} ends")
        print(json.dumps({state: sum(each.state == state for each in self.told) for state in _states(self.told)}))
        return wrong

    def _may_be_sent(self, ticket: Ticket, wish: Wish) -> bool:
        answers = ticket.told[wish]
        if not answers:
            return True
        last = max(answers, key=lambda each: each.ended)
        return last.state not in NOT_SENT and "nothing was sent" not in str(last.content.get("reason"))

    def _words(self, tickets: dict[str, Ticket]) -> Iterable[str]:
        """Answers that do not agree, or should not be."""
        for told in self.told:
            if told.state == "confirmed by another":
                yield f"{told.wish} was confirmed by {told.by}, who has not armed it"
            if told.way in ("api", "page") and told.state and not is_permitted(told.by, told.way, told.wish):
                yield f"{told.by} got {told.content} for {told.wish}"
            if told.state in FINAL - {"expired"} and not keeps_the_rule(told.wish.point, told.wish.value):
                yield f"{told.wish} is {told.state}, and is against the rule"
            if told.state and told.state not in FINAL | {"refused", "confirmed by another"}:
                yield f"{told.wish} was told {told.content}"
            if told.status >= 500:
                yield f"{told.wish} was answered with {told.status}: {told.content}"
        for ticket in tickets.values():
            final = set()
            for wish, answers in ticket.told.items():
                kinds = {_result(each) for each in answers if each.state in FINAL}
                if len(kinds) > 1:
                    yield f"{wish} ended in several ways: {kinds}"
                if kinds:
                    final.add(wish)
                    yield from _refused_after_its_end(wish, answers)
            if len(final) > 1:
                yield f"{ticket.name} ended for several: {final}"

    def _not_written(self, tickets: dict[str, Ticket], writes: list[Image]) -> Iterable[str]:
        """What was done, and is not on the wire."""
        done = [
            wish.image(self.plant.places)
            for ticket in tickets.values()
            for wish in ticket.told
            if "done" in ticket.states(wish)
        ]
        done += [
            told.wish.image(self.plant.places) for told in self.told if told.wish.key is None and told.state == "done"
        ]
        left = list(writes)
        for image in done:
            if image in left:
                left.remove(image)
            else:
                yield f"{image} is done, and was not written"

    def _deeds(self, tickets: dict[str, Ticket]) -> Iterable[str]:
        """Results of writes that their device did not do as it should."""
        for write in self.plant.wire.writes():
            owners = [ticket for ticket in tickets.values() if _image(write) in ticket.images]
            wishes = [ticket.images[_image(write)] for ticket in owners]
            if len(owners) != 1 or (wishes[0].point not in SHOWN and write.deed in ("other", "overwritten")):
                continue
            said = owners[0].states(wishes[0]) & FINAL
            if said - {"unknown"} - ENDS.get(write.deed, FINAL - {"expired"}):
                yield f"{write} is said to be {[each.content for each in owners[0].told[wishes[0]]]}"

    def _late(self, tickets: dict[str, Ticket]) -> Iterable[str]:
        """Writes that came after the time of all who wanted them."""
        for write in self.plant.wire.writes():
            until = [ticket.until for ticket in tickets.values() if _image(write) in ticket.images]
            if until and write.at > max(until) + SLACK:
                yield f"{write} was sent {write.at - max(until):.1f} s after its time"

    def _audit(self, tickets: dict[str, Ticket]) -> Iterable[str]:
        lines = [line for line in self.plant.audit() if line.get("event") == "command"]
        ended: dict[str, list[dict[str, Any]]] = defaultdict(list)
        for line in lines:
            if line["outcome"] in FINAL:
                ended[line["key"]].append(line)
        for key, found in ended.items():
            outcomes = [line["outcome"] for line in found]
            if len(found) > 2 or (len(found) == 2 and outcomes[1] != "unknown"):
                yield f"{key} has several lines in the audit log: {outcomes}"
        for ticket in tickets.values():
            for wish, answers in ticket.told.items():
                for told in answers[:1] if ticket.states(wish) & FINAL else ():
                    found = ended.get(ticket.name, [])
                    if not found or found[-1]["outcome"] != next(a.state for a in answers if a.state in FINAL):
                        yield f"{ticket.name} was told {told.state}, and the audit log has {found}"
                    elif (found[-1]["device"], found[-1]["point"], found[-1]["new"]) != (
                        wish.device,
                        wish.point,
                        wish.value,
                    ):
                        yield f"the audit log says {found[-1]} of {wish}"
        yield from self._missing_in_the_audit(lines)
        yield from self._order(lines)
        texts = {"the audit log": (self.plant.folder / "data" / "audit.log").read_text(), "the log": self.plant.log()}
        for name, text in texts.items():
            for person, (_, token) in PEOPLE.items():
                if token in text:
                    yield f"{name} has the token of {person}"

    def _missing_in_the_audit(self, lines: list[dict[str, Any]]) -> Iterable[str]:
        """Writes that no line speaks of."""
        left = [
            Wish(None, line["device"], line["point"], line["new"]).image(self.plant.places)
            for line in lines
            if line["outcome"] in ("done", "failed", "unknown")
        ]
        for write in self.plant.wire.writes():
            if _image(write) in left:
                left.remove(_image(write))
            else:
                yield f"no line of the audit log speaks of {write}"

    def _order(self, lines: list[dict[str, Any]]) -> Iterable[str]:
        """Lines of one device that are not in the order of the wire."""
        for device, (link, unit) in self.plant.places.items():
            done = [
                Wish(None, device, line["point"], line["new"]).image(self.plant.places)
                for line in lines
                if line["device"] == device and line["outcome"] == "done"
            ]
            wire = [_image(write) for write in self.plant.wire.writes(link, unit)]
            place = -1
            for image in done:
                try:
                    place = wire.index(image, place + 1)
                except ValueError:
                    yield f"{image} of {device} is not in the order of the wire"
                    break


def _image(write: WireRequest) -> Image:
    is_door = write.address == 41 and write.function in (6, 16)
    return write.link, write.unit, write.address, (write.items[0] >> 3 & 1,) if is_door else write.items


def _refused_after_its_end(wish: Wish, answers: list[Told]) -> Iterable[str]:
    """Answers that say of what has ended that it was not sent."""
    ended = min(each.ended for each in answers if each.state in FINAL)
    for each in answers:
        if each.state == "refused" and (each.begun > ended or "another command" in str(each.content.get("reason"))):
            yield f"{wish} has ended, and was refused then: {each.content}"


def _result(told: Told) -> tuple[object, ...]:
    return tuple(str(told.content.get(name)) for name in ("state", "at", "by", "value", "read_back", "reason"))


def _states(told: list[Told]) -> list[str]:
    return sorted({each.state for each in told})


def _unmatched(edges: list[list[str]]) -> list[int]:
    """Writes for which no ticket is left, by a largest matching."""
    owner: dict[str, int] = {}

    def find(number: int, seen: set[str]) -> bool:
        for name in edges[number]:
            if name not in seen:
                seen.add(name)
                if name not in owner or find(owner[name], seen):
                    owner[name] = number
                    return True
        return False

    return [number for number in range(len(edges)) if not find(number, set())]


def story(check: Callable[[], list[str]]) -> None:
    """Fail with the first problems."""
    wrong = check()
    assert wrong[:20] == [], os.linesep.join(wrong[:20])

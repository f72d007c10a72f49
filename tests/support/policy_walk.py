"""A walk by chance of many clients over one server, judged step by step by an oracle.

Knows clients, the oracle, and a *world*: the server or gateway with what stands behind it. Every step is judged at
once: the replies, what the device holds and was asked, and the new lines of the audit log.

1. A denied request gets the exception of its rule, and nothing of it arrives behind the policy. It leaves one line.
2. A permitted request gets what the device says. Writes leave one line, reads none.
3. Requests of one step are byte by byte the same for all clients that send them.
4. A line is asked only what a line answers: units that it has, in frames whose end can be seen.
"""

import asyncio
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

from policy_chance import Chance
from policy_clients import PlainClient, Reply
from policy_oracle import (
    COIL,
    HOLDING,
    KNOWN,
    WRITING_FUNCTIONS,
    Asked,
    Asker,
    Bucket,
    Masks,
    ModelPolicy,
    Verdict,
    asked,
)


class World(Protocol):
    """What a walk asks of its world."""

    endpoints: Sequence[str]
    line_units: frozenset[int]
    audit: Path | None

    def judge(self, policy: ModelPolicy, asker: Asker, unit: int, pdu: bytes) -> Verdict:
        """What the oracle says, for the units that hear a request."""

    def held(self, unit: int, space: str) -> list[int] | None:
        """What a table of a unit holds by the model; None where an audit log cannot know it."""

    def permitted(self, unit: int, pdu: bytes) -> bytes | None:
        """Execute a permitted request on the model: its reply; None where any reply is right that is no denial."""

    def refused(self, unit: int, pdu: bytes) -> None:
        """A request that was refused, by the policy or by the device: which one is not known."""

    def replace(self, policy: ModelPolicy) -> None:
        """Put a policy into force."""

    def check(self, about: object) -> None:
        """Fail where the devices differ from the model, or were asked what they should not have been."""

    def hold(self) -> None:
        """Let replies of devices wait."""

    def release(self) -> None:
        """Let them go."""


@dataclass
class Sent:
    """A request on its way."""

    client: PlainClient
    unit: int
    pdu: bytes
    at: float = 0.0
    answered: float = 0.0
    reply: bytes = b""

    def __str__(self) -> str:
        return f"{self.client.asker} unit {self.unit}: {self.pdu.hex(' ')} -> {self.reply.hex(' ')}"


@dataclass
class About:
    """What a failure says; it is put together only if there is one."""

    seed: int
    sent: Sent
    policy: ModelPolicy

    def __str__(self) -> str:
        return f"seed {self.seed}: {self.sent} by {self.policy}"


@dataclass
class Steps:
    """What a failure says that concerns all of a step."""

    seed: int
    about: tuple[About, ...]

    def __str__(self) -> str:
        return f"seed {self.seed} after {'; '.join(map(str, self.about))}"


@dataclass
class Line:
    """What the audit log should say of one request.

    Attributes:
        must: whether there must be a line; otherwise there may be one.
        fields: what the line says.
        rules: of which it names one.
    """

    client: PlainClient
    must: bool
    fields: dict[str, Any]
    rules: set[str]
    about: About

    def fits(self, line: Mapping[str, Any]) -> bool:
        """Whether a line is this one."""
        return all(line.get(key) == value for key, value in self.fields.items()) and line["rule"] in self.rules


@dataclass
class Tally:
    """What a walk met, so that a test can demand that it met everything.

    Attributes:
        permitted, denied, slowed, open: requests by verdict.
    """

    permitted: int = 0
    denied: int = 0
    slowed: int = 0
    open: int = 0
    equal_bytes: int = 0


class Judge:
    """Holds every reply, and every line of the log, against the oracle."""

    def __init__(self, world: World, policy: ModelPolicy, seed: int) -> None:
        self.world = world
        self.policy = policy
        self.seed = seed
        self.tally = Tally()
        self.transaction = 0
        self._buckets: dict[tuple[str, str], Bucket] = {}
        self._lines: list[Line] = []
        self._log = None if world.audit is None else world.audit.open()

    def close(self) -> None:
        """Close the log."""
        if self._log is not None:
            self._log.close()

    def replace(self, policy: ModelPolicy) -> None:
        """Another policy from now on."""
        self.policy = policy
        self.world.replace(policy)
        for bucket in self._buckets.values():
            bucket.forget()

    def take(self, sent: Sent) -> None:
        """Judge one reply; the requests of a client in the order in which they are executed."""
        verdict = self.verdict(sent)
        about = About(self.seed, sent, self.policy)
        code = sent.reply[1] if sent.reply[0] & 0x80 else 0
        if verdict.open:
            self.tally.open += 1
            self._take_open(sent, verdict, code, about)
        elif verdict.denials and not (code == 6 and sent.unit == 0 and verdict.charged):  # units are judged in turn
            self.tally.denied += 1
            assert len(sent.reply) == 2, f"not denied: {about}"
            assert code in {one for one, _ in verdict.denials}, f"not denied: {about}"
            self._doubt(sent, verdict)
            self._expect_denied(sent, code, {name for one, name in verdict.denials if one == code}, about)
        elif self._is_slowed(sent, verdict, code, about):
            self.tally.slowed += 1
            self._expect_denied(sent, 6, set(verdict.charged), about)
        else:
            self.tally.permitted += 1
            self._take_permitted(sent, verdict, code, about)

    def verdict(self, sent: Sent) -> Verdict:
        """What the oracle says."""
        return self.world.judge(self.policy, sent.client.asker, sent.unit, sent.pdu)

    def after_step(self) -> None:
        """Judge the lines of the log that are new, and the devices."""
        if self._log is not None:
            self._check_lines([json.loads(line) for line in self._log])
        self.world.check(Steps(self.seed, tuple(one.about for one in self._lines)))
        self._lines.clear()

    def _check_lines(self, new: list[dict[str, Any]]) -> None:
        about = f"seed {self.seed}"
        for required in (True, False):
            for expected in [one for one in self._lines if one.must == required]:
                found = next((line for line in new if expected.fits(line)), None)
                assert found or not required, f"no line {expected.fields} {expected.rules} in {new}: {expected.about}"
                if found:
                    new.remove(found)
        assert not new, f"lines that nothing was asked for: {new}; {about}"

    def _take_open(self, sent: Sent, verdict: Verdict, code: int, about: About) -> None:
        """A case that the documentation leaves open; one that is answered as denied must not have arrived."""
        self._doubt(sent, verdict)
        rules = (
            verdict.deciding | {name for _, name in verdict.denials} | {"default"} | {r.name for r in self.policy.rules}
        )
        fields = {"peer": sent.client.local, "unit": sent.unit, "function": sent.pdu[0]}
        if code in (1, 2, 6):  # denied, or refused by the device
            self.world.refused(sent.unit, sent.pdu)
        else:
            self.world.permitted(sent.unit, sent.pdu)
        self._lines.append(Line(sent.client, False, fields, rules, about))

    def _take_permitted(self, sent: Sent, verdict: Verdict, code: int, about: About) -> None:
        request = asked(sent.pdu)
        old = self._items(sent, request)
        reply = self.world.permitted(sent.unit, sent.pdu)
        if reply is not None:
            if reply[0] & 0x80:
                assert code, f"refused by the device, and answered: {about}"
            else:
                assert sent.reply == reply, f"expected {reply.hex(' ')}: {about}"
        elif sent.reply[0] & 0x80 == 0:
            assert sent.reply[0] == sent.pdu[0], about
        fields: dict[str, Any] = {
            "peer": sent.client.local,
            "unit": sent.unit,
            "function": sent.pdu[0],
            "outcome": "exception" if code else "done",
            "code": code or None,
            "listener": sent.client.asker.listener,
            "role": sent.client.asker.role,
        }
        if sent.pdu[0] in WRITING_FUNCTIONS:
            if not request.malformed:
                fields |= self._written(sent, request)
                if not code and sent.pdu[0] in (5, 6, 15, 16, 22):
                    fields["old"] = old
            self._lines.append(Line(sent.client, not request.malformed, fields, verdict.deciding, about))
        elif sent.pdu[0] not in KNOWN or sent.pdu[0] in (8, 43):
            self._lines.append(Line(sent.client, False, fields, verdict.deciding, about))

    def _expect_denied(self, sent: Sent, code: int, rules: set[str], about: About) -> None:
        fields: dict[str, Any] = {
            "peer": sent.client.local,
            "unit": sent.unit,
            "function": sent.pdu[0],
            "outcome": "denied",
            "code": code,
            "listener": sent.client.asker.listener,
            "role": sent.client.asker.role,
            "old": None,
        }
        request = asked(sent.pdu)
        if not request.malformed and sent.pdu[0] in WRITING_FUNCTIONS:
            fields |= self._written(sent, request)
        self._lines.append(Line(sent.client, True, fields, rules, about))

    @staticmethod
    def _written(sent: Sent, request: Asked) -> dict[str, Any]:
        """What a line says of a write."""
        written = request.touched[-1]
        if sent.pdu[0] == 21:
            return {}
        said = {"address": written.first, "count": written.last - written.first + 1}
        if isinstance(written.values, Masks):
            return said
        assert written.values is not None
        values = [int(bool(value)) for value in written.values] if written.space != HOLDING else list(written.values)
        return said | {"new": values}

    def _items(self, sent: Sent, request: Asked) -> list[int] | None:
        """What the items of a write hold now."""
        written = request.touched[-1] if request.touched else None
        if written is None or not written.writes or written.space not in (HOLDING, COIL):
            return None
        held = self.world.held(sent.unit, written.space)
        return None if held is None else [int(one) for one in held[written.first : written.last + 1]]

    def _is_slowed(self, sent: Sent, verdict: Verdict, code: int, about: About) -> bool:
        """Whether a rate refused it; what it does to the buckets is kept."""
        buckets = [self._bucket(sent, name, rate) for name, rate in verdict.charged.items()]
        if not buckets:
            return False
        may = [bucket.before(sent.at, sent.answered) for bucket in buckets]
        if code == 6:
            assert any(refused for _, refused in may), f"too early for 06: {about}"
            for bucket in buckets:
                if len(buckets) == 1:
                    bucket.after(sent.at, sent.answered, permitted=False)
                else:
                    bucket.doubt()
            return True
        assert all(permitted for permitted, _ in may), f"over its rate: {about}"
        for bucket in buckets:
            bucket.after(sent.at, sent.answered, permitted=True)
        return False

    def _doubt(self, sent: Sent, verdict: Verdict) -> None:
        for name, rate in verdict.charged.items():
            self._bucket(sent, name, rate).doubt()

    def _bucket(self, sent: Sent, rule: str, rate: float) -> Bucket:
        key = (rule, sent.client.asker.host)
        if key not in self._buckets:
            self._buckets[key] = Bucket(rate, sent.at)
        return self._buckets[key]


@dataclass
class Walk:
    """One walk: what is done next is drawn, what comes of it is judged.

    Attributes:
        pool: requests that are asked again and again.
    """

    world: World
    clients: Sequence[PlainClient]
    chance: Chance
    judge: Judge
    one_unit_together: bool
    pool: list[tuple[int, bytes]] = field(default_factory=list)

    async def go(self, steps: int) -> Tally:
        """Take so many steps."""
        self._refill(24)
        kinds = (self.equal_bytes, self.pipelined, self.side_by_side, self.reloaded, self.again_and_again, self.renewed)
        for _ in range(steps):
            (kind,) = self.chance.random.choices(kinds, (50, 12, 14, 9, 2, 8))
            await kind()
            self.judge.after_step()
        for client in self.clients:
            assert not client.unexpected, f"seed {self.judge.seed}: {client.asker} got what it did not ask for"
        return self.judge.tally

    def _refill(self, count: int) -> None:
        made = [self.chance.request(self.judge.policy) for _ in range(count)]
        self.pool = (made + self.pool)[:24]

    def _some(self, least: int, clients: Sequence[PlainClient] | None = None) -> list[PlainClient]:
        chosen = list(self.clients if clients is None else clients)
        self.chance.random.shuffle(chosen)
        return chosen[: max(least, self.chance.random.randrange(len(chosen) + 1))]

    async def equal_bytes(self) -> None:
        """The same bytes from one client after the other, permitted and denied in any order."""
        unit, pdu = self.chance.random.choice(self.pool)
        for client in self._some(2)[:4]:
            self.judge.tally.equal_bytes += 1
            await self.ask(client, [(unit, pdu)])

    async def pipelined(self) -> None:
        """Several requests in one segment, or in pieces that end anywhere."""
        streams = [client for client in self.clients if client.scheme in ("tcp", "tls")]
        client = self.chance.random.choice(streams)
        requests = self.chance.random.choices(self.pool, k=self.chance.random.randrange(2, 9))
        if self.one_unit_together:
            requests = [one for one in requests if one[0] == requests[0][0]]
        pieces = self.chance.random.choice((0, 0, 1, 3))
        same = not self.one_unit_together and self.chance.random.random() < 0.5
        await self.ask(client, requests, pieces=pieces, same_transaction=same)

    async def side_by_side(self) -> None:
        """The same read from several clients at once; who is denied need not wait for the device."""
        reads = [one for one in self.pool if one[1][0] in (1, 2, 3, 4, 20, 24)]
        if not reads:
            return
        request = self.chance.random.choice(reads)
        clients = [one for one in self._some(3) if not one.is_line]
        self.world.hold()
        asked_now = [self._send(client, request) for client in clients]
        for one in asked_now:
            if self.judge.verdict(one).denials and not self.judge.verdict(one).open:
                await self._receive(one)
        self.world.release()
        for one in asked_now:
            if not one.reply:
                await self._receive(one)
        for one in sorted(asked_now, key=lambda one: one.reply[1:] == b"\x06"):  # who came first is not known
            self.judge.take(one)

    async def reloaded(self) -> None:
        """Another policy, and at once the bytes that were asked before, by the connections that are open."""
        unit, pdu = self.chance.random.choice(self.pool)
        clients = self._some(2)[:3]
        for client in clients:
            await self.ask(client, [(unit, pdu)])
        self.judge.after_step()
        self.judge.replace(self.chance.changed(self.judge.policy))
        for client in clients:
            await self.ask(client, [(unit, pdu)])

    async def again_and_again(self) -> None:
        """One request so often that every shortcut knows it, then by others."""
        unit, pdu = self.chance.random.choice(self.pool)
        first, *others = self._some(2)
        if first.is_line:
            return
        for _ in range(4):
            await self.ask(first, [(unit, pdu)] * (1 if first.scheme == "udp" else 8))
        for client in [*others[:2], first]:
            await self.ask(client, [(unit, pdu)])

    async def renewed(self) -> None:
        """Other requests from now on."""
        self._refill(3)

    def _send(self, client: PlainClient, request: tuple[int, bytes]) -> Sent:
        self.judge.transaction = (self.judge.transaction + 1) & 0xFFFF
        sent = Sent(client, *request, at=time.monotonic())
        client.send(client.frame(self.judge.transaction, *request))
        return sent

    async def _receive(self, sent: Sent) -> None:
        try:
            (reply,) = await sent.client.receive()
        except TimeoutError:
            raise AssertionError(f"no reply: {About(self.judge.seed, sent, self.judge.policy)}") from None
        sent.answered = time.monotonic()
        self._note(sent, reply)

    @staticmethod
    def _note(sent: Sent, reply: Reply) -> None:
        assert reply.unit == sent.unit, f"{reply} to {sent}"
        assert reply.pdu[0] & 0x7F == sent.pdu[0], f"{reply} to {sent}"
        sent.reply = reply.pdu

    async def ask(
        self,
        client: PlainClient,
        requests: Iterable[tuple[int, bytes]],
        *,
        pieces: int = 0,
        same_transaction: bool = False,
    ) -> None:
        """Send requests together, and judge the replies."""
        if client.is_line or client.scheme == "udp":
            for request in requests:
                if client.is_line and not self._fits_a_line(*request):
                    continue
                one = self._send(client, request)
                await self._receive(one)
                self.judge.take(one)
            return
        sent, data = [], b""
        start = self.judge.transaction
        for unit, pdu in requests:
            self.judge.transaction = start + 1 if same_transaction else (self.judge.transaction + 1) & 0xFFFF
            sent.append((self.judge.transaction, Sent(client, unit, pdu, at=time.monotonic())))
            data += client.frame(self.judge.transaction, unit, pdu)
        for piece in self._cut(data, pieces):
            client.send(piece)
            await _turns(3)
        replies = list(await client.receive(len(sent)))
        now = time.monotonic()
        for position, (transaction, one) in enumerate(sent):
            reply = replies[position]
            if not same_transaction:
                reply = next(reply for reply in replies if reply.transaction == transaction)
            one.answered = now
            self._note(one, reply)
            self.judge.take(one)

    def _fits_a_line(self, unit: int, pdu: bytes) -> bool:
        request = asked(pdu)
        mutes = (request.function, request.sub_function) in ((8, 1), (8, 4))
        return unit in self.world.line_units and not (request.malformed or mutes)

    def _cut(self, data: bytes, pieces: int) -> list[bytes]:
        cuts = sorted({0, len(data), *(self.chance.random.randrange(1, len(data)) for _ in range(pieces))})
        return [data[start:end] for start, end in pairwise(cuts)]


async def _turns(count: int) -> None:
    for _ in range(count):
        await asyncio.sleep(0)

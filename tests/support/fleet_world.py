"""A zone on a virtual clock: members, a coordinator, networks that lose, delay and part, clocks that drift, freezes.

The world sees what no member sees: the true time, and every transaction that a member begins on a shard. It judges by
these alone (`World.breaches`, `World.holes`).
"""

import heapq
import random
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import count

from busway.apps.fleet.coordinator import Entry
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.lease_holder import LeaseHolder, NotConfirmed, OwnershipChange, Proposal
from busway.apps.fleet.lease_times import LeaseTimes


@dataclass(slots=True)
class Network:
    """How messages of members fare.

    Attributes:
        delay: seconds from … to, one way.
        loss: part of the proposals or answers that are lost.
        late: part of the proposals that are executed long after their answer was given up.
    """

    delay: tuple[float, float] = (0.001, 0.02)
    loss: float = 0.0
    late: float = 0.0


@dataclass(slots=True)
class Wire:
    """What was on the wires of one shard: the last transaction, and what is judged by it."""

    epoch: Epoch | None = None
    owner: str = ""
    until: float = 0.0
    last: float = 0.0


@dataclass(slots=True)
class Driver:
    """What drives one member in the world."""

    member: LeaseHolder
    rate: float
    offset: float
    begun: float
    alive: bool = True
    is_reached: bool = True
    frozen_until: float = 0.0
    waiting: list[Callable[[], None]] = field(default_factory=list)
    wake_at: float = float("inf")
    wake_number: int = 0
    polls: dict[str, int] = field(default_factory=dict)
    buffer: deque[Entry] = field(default_factory=deque)

    def local(self, true: float) -> float:
        return self.offset + true * self.rate

    def true(self, local: float) -> float:
        return (local - self.offset) / self.rate


class World:
    """A zone; `run` moves the true time on.

    Args:
        costs: of the shards.
        times: of the leases.
        seed: of everything that is left to chance.
        network: between members and the coordinator.
        drift: how much too fast or too slow a clock runs at most, as a part of the time.
        poll: seconds between two transactions on a shard; None to judge the balance alone.
        worst: seconds that a transaction may take.
        member_kind: what makes a member; mutants give another one.
    """

    def __init__(
        self,
        costs: Mapping[str, float],
        *,
        times: LeaseTimes | None = None,
        seed: int = 0,
        network: Network | None = None,
        drift: float = 0.0,
        poll: float | None = 0.5,
        worst: float = 0.8,
        member_kind: type[LeaseHolder] = LeaseHolder,
    ) -> None:
        self.costs = dict(costs)
        self.times = times or LeaseTimes()
        self.chance = random.Random(seed)
        self.network = network or Network()
        self.drift, self.poll, self.worst = drift, poll, worst
        self.member_kind = member_kind
        self.now = 0.0
        self.drivers: dict[str, Driver] = {}
        self.entries: dict[str, Entry] = {}
        self.revision = 0
        self.is_up = True
        self.wire_of: dict[str, Wire] = {}
        self.breaches: list[str] = []
        self.holes: list[tuple[str, float, float]] = []
        self.changes: list[float] = []  # seconds without a transaction where a shard got another owner
        self.proposals = self.deliveries = self.gains = 0
        self._heap: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = count()
        self._runs = count(1)

    # What happens to the world.

    def start(self, name: str, host: str = "", capacity: float = 1.0) -> Driver:
        """Start a collector; a former process of this name has ended."""
        rate = 1.0 + self.chance.uniform(-self.drift, self.drift)
        member = self.member_kind(
            name,
            f"run-{next(self._runs)}",
            host or name,
            self.times,
            random.Random(self.chance.random()),
            capacity=capacity,
        )
        member.set_shards(self.costs)
        driver = Driver(member, rate, self.chance.uniform(0, 1e6), self.now)
        self.drivers[name] = driver
        self._snapshot(driver)
        return driver

    def kill(self, name: str) -> None:
        """End a collector as kill -9 does."""
        self.drivers.pop(name).alive = False

    def freeze(self, name: str, seconds: float) -> None:
        """Stop a process for a time; what comes meanwhile waits."""
        driver = self.drivers[name]
        driver.frozen_until = self.now + seconds
        self._at(driver.frozen_until, lambda: self._thaw(driver))

    def part(self, name: str, *, parted: bool) -> None:
        """Cut a collector off from the coordinator, or join it again."""
        driver = self.drivers[name]
        driver.is_reached = not parted
        if not parted:
            self._snapshot(driver)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while self._heap and self._heap[0][0] <= end:
            self.now, _, act = heapq.heappop(self._heap)
            act()
        self.now = end

    def owners(self) -> dict[str, str]:
        """The shards that are owned now, each with its collector."""
        return {
            shard: name
            for name, driver in self.drivers.items()
            for shard in driver.member.owned
            if driver.member.deadline(shard) > driver.local(self.now)
        }

    def loads(self) -> dict[str, float]:
        """The load of each collector that lives."""
        found = dict.fromkeys(self.drivers, 0.0)
        for shard, name in self.owners().items():
            found[name] += self.costs[shard]
        return found

    def imbalance(self) -> float:
        """How far the most loaded is above its fair part, and the least loaded below, the greater of both."""
        loads = self.loads()
        capacity = {name: driver.member._me.capacity for name, driver in self.drivers.items()}
        fair = sum(self.costs.values()) / sum(capacity.values())
        return max(abs(load / capacity[name] - fair) / fair for name, load in loads.items())

    def open_holes(self) -> dict[str, float]:
        """Seconds since the last transaction of each shard."""
        return {
            shard: self.now - self.wire_of[shard].last if shard in self.wire_of else self.now for shard in self.costs
        }

    # The coordinator.

    def _propose(self, driver: Driver, proposal: Proposal) -> None:
        self.proposals += 1
        chance, network = self.chance, self.network
        answer_at = driver.true(proposal.asked + self.times.answer)
        arrives = self.now + chance.uniform(*network.delay)
        is_lost = not driver.is_reached or chance.random() < network.loss
        if chance.random() < network.late:
            arrives, is_lost = answer_at + chance.uniform(0.0, 2 * self.times.ttl), False

        def answer(result: int | NotConfirmed) -> None:
            self._to(driver, lambda: driver.member.outcome(proposal, result, driver.local(self.now)))

        def arrive() -> None:
            if not self.is_up:
                if chance.random() < 0.5:  # a leader that has it, and passes it on only when it is back
                    self._at(self.now + chance.uniform(0.5, 5.0), arrive)
                return
            result = self._apply(proposal)
            back = self.now + chance.uniform(*network.delay)
            if driver.is_reached and chance.random() >= network.loss and back < answer_at:
                answered.append(True)
                self._at(back, lambda: answer(result))

        answered: list[bool] = []
        if not is_lost:
            self._at(arrives, arrive)
        self._at(answer_at, lambda: None if answered else answer(NotConfirmed.UNKNOWN))

    def _apply(self, proposal: Proposal) -> int | NotConfirmed:
        present = self.entries.get(proposal.key)
        if (0 if present is None else present.revision) != proposal.revision:
            return NotConfirmed.CONFLICT
        self.revision += 1
        entry = Entry(proposal.key, proposal.value, self.revision)
        self.entries[proposal.key] = entry
        for driver in self.drivers.values():
            if driver.is_reached:
                self._deliver(driver, entry)
        return self.revision

    def _deliver(self, driver: Driver, entry: Entry) -> None:
        driver.buffer.append(entry)
        if len(driver.buffer) == 1:
            self._at(self.now + self.chance.uniform(*self.network.delay), lambda: self._flush(driver))

    def _flush(self, driver: Driver) -> None:
        entries = list(driver.buffer)
        driver.buffer.clear()
        if not driver.is_reached:
            return

        def take() -> None:
            local = driver.local(self.now)
            for each in entries:
                self.deliveries += 1
                driver.member.entry(each, local)

        self._to(driver, take)

    def _snapshot(self, driver: Driver) -> None:
        entries = list(self.entries.values())
        driver.buffer.clear()

        def take() -> None:
            local = driver.local(self.now)
            driver.member.begin_snapshot()
            for each in entries:
                driver.member.entry(each, local)
            driver.member.end_snapshot(local)

        self._at(self.now + self.chance.uniform(*self.network.delay), lambda: self._to(driver, take))

    # Processes.

    def _at(self, when: float, act: Callable[[], None]) -> None:
        heapq.heappush(self._heap, (max(when, self.now), next(self._numbers), act))

    def _to(self, driver: Driver, act: Callable[[], None]) -> None:
        """Have a process do something: never after its end, and later where it is frozen."""
        if not driver.alive:
            return
        if driver.frozen_until > self.now:
            driver.waiting.append(act)
            return
        act()
        self._turn(driver)

    def _thaw(self, driver: Driver) -> None:
        if driver.frozen_until > self.now:
            return
        # Tasks that wait run in any order when a process goes on: those of links too, before it has read anything.
        waiting, driver.waiting = driver.waiting, []
        self.chance.shuffle(waiting)
        for act in waiting:
            self._to(driver, act)
        self._to(driver, lambda: None)

    def _turn(self, driver: Driver) -> None:
        for proposal in driver.member.turn(driver.local(self.now)):
            self._propose(driver, proposal)
        for event in driver.member.events():
            if event.change is OwnershipChange.GAINED:
                self.gains += 1
                self._poll_soon(driver, event.shard, event.epoch)
            elif event.change is OwnershipChange.LEAVE:
                shard = event.shard
                wire = self.wire_of.get(shard)
                ended = self.now if wire is None else max(self.now, wire.until)
                self._at(ended, self._leaving(driver, shard))
        wake = max(driver.true(driver.member.next_turn()), self.now + 0.001)
        if wake < driver.wake_at - 1e-9 or driver.wake_at <= self.now:
            driver.wake_at = wake
            driver.wake_number += 1
            number = driver.wake_number
            self._at(wake, lambda: self._wake(driver, number))

    def _leaving(self, driver: Driver, shard: str) -> Callable[[], None]:
        return lambda: self._to(driver, lambda: driver.member.left(shard))

    def _wake(self, driver: Driver, number: int) -> None:
        if number == driver.wake_number:
            driver.wake_at = float("inf")
            self._to(driver, lambda: None)

    def _poll_soon(self, driver: Driver, shard: str, epoch: Epoch) -> None:
        if self.poll is not None:
            act = lambda: self._transaction(driver, shard, epoch)  # noqa: E731
            self._at(self.now + self.chance.uniform(0.0, self.poll), lambda: self._to(driver, act))

    def _transaction(self, driver: Driver, shard: str, epoch: Epoch) -> None:
        owned = driver.member.owned.get(shard)
        if owned is None or owned.epoch != epoch or owned.has_left:
            return
        if owned.leaving is None and driver.member.permits(shard, driver.local(self.now), self.worst):
            self._judge(driver.member.name, shard, epoch)
        self._poll_soon(driver, shard, epoch)

    def _judge(self, name: str, shard: str, epoch: Epoch) -> None:
        wire = self.wire_of.setdefault(shard, Wire())
        if wire.epoch is not None:
            if epoch < wire.epoch:
                self.breaches.append(f"{self.now:.3f}: {shard} by {name} in {epoch} after {wire.epoch}")
            if wire.owner != name and self.now < wire.until:
                self.breaches.append(f"{self.now:.3f}: {shard} by {name} while {wire.owner} has it")
        if wire.owner and wire.owner != name:
            self.changes.append(self.now - wire.last)
        if self.now - wire.last > 2.0:
            self.holes.append((shard, wire.last, self.now))
        wire.epoch, wire.owner = epoch, name
        wire.until = self.now + self.chance.uniform(0.0, self.worst)
        wire.last = self.now


def random_walk(seed: int, steps: int = 25, member_kind: type[LeaseHolder] = LeaseHolder) -> World:
    """A zone of 16 shards and four collectors to which everything happens; at its end all is well again for a minute.

    Args:
        seed: of what happens.
        steps: how many things.
        member_kind: what makes a member.
    """
    chance = random.Random(seed)
    slow = chance.choice([0.02, 0.5, 2.0])
    world = World(
        {f"{number:04d}": chance.uniform(0.01, 0.1) for number in range(16)},
        times=LeaseTimes(answer=chance.choice([2.5, 5.0])),
        seed=seed,
        drift=0.005,
        network=Network((0.001, slow), chance.choice([0, 0.05, 0.2]), chance.choice([0, 0.02, 0.1])),
        member_kind=member_kind,
    )
    for number in range(4):
        world.start(f"c{number}")
    ended: list[str] = []
    world.run(20)
    for _ in range(steps):
        _happens(world, chance, ended)
        world.run(chance.uniform(0, 20))
    world.is_up = True
    world.network = Network()
    for name, driver in world.drivers.items():
        driver.frozen_until = min(driver.frozen_until, world.now)
        world._thaw(driver)
        driver.member.drain(draining=False)
        world.part(name, parted=False)
    world.run(75)
    return world


def _happens(world: World, chance: random.Random, ended: list[str]) -> None:
    what = chance.choice(["kill", "start", "freeze", "part", "join", "down", "up", "drain"])
    name = chance.choice(sorted(world.drivers))
    if what == "kill" and len(world.drivers) > 1:
        world.kill(name)
        ended.append(name)
    elif what == "start" and ended:
        world.start(ended.pop())
    elif what == "freeze":
        world.freeze(name, chance.choice([1, 5, 14, 15, 16, 17, 30]))
    elif what == "part":
        world.part(name, parted=True)
    elif what == "join":
        for each, driver in world.drivers.items():
            if not driver.is_reached:
                world.part(each, parted=False)
    elif what in ("down", "up"):
        world.is_up = what == "up"
    elif what == "drain":
        world.drivers[name].member.drain(draining=chance.random() < 0.5)

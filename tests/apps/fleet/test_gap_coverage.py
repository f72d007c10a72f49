"""A collector that takes a shard that was not handed on says since when it had no owner: no such time is untold.

The world sees each transaction. Where the owner of a shard changes, the time from the last one of the former owner to
the first one of the next must be told: by events of takeovers (from the last renewal of the silent owner on), by the
release of an owner that went in order, or by both. The seeds are those in which takings had no answer, and collectors
that had taken a shard ended before they knew of it.
"""

from collections.abc import Callable

import fleet_world
import pytest
from fleet_world import Driver, World, random_walk

from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.lease_holder import NotConfirmed, OwnershipChange, Proposal, ShardEvent
from busway.apps.fleet.table_records import LEASES, decode_lease

SLACK = 2.5
"""Seconds between two transactions at most, and a transaction, and the way to the coordinator."""


class ToldWorld(World):
    """A world whose members have right wall clocks, and that compares the gaps that they tell with the true ones."""

    def __init__(self, *given: object, **options: object) -> None:
        super().__init__(*given, **options)  # type: ignore[arg-type]
        self.told: dict[str, list[tuple[float, float]]] = {}
        self.gained: dict[str, float] = {}
        self.released: dict[str, float] = {}
        self.untold: list[str] = []
        self.takeovers = 0

    def start(self, name: str, host: str = "", capacity: float = 1.0) -> Driver:
        driver = super().start(name, host, capacity)
        honest = driver.member.events
        driver.member.events = lambda: self._heard(honest)  # type: ignore[method-assign]
        return driver

    def _turn(self, driver: Driver) -> None:
        driver.member.wall_ahead = self.now - driver.local(self.now)
        super()._turn(driver)

    def _heard(self, honest: Callable[[], list[ShardEvent]]) -> list[ShardEvent]:
        found = honest()
        for event in found:
            if event.change is OwnershipChange.GAINED:
                self.gained[event.shard] = self.now
                begin = self.released.pop(event.shard, None) if event.silent_since is None else event.silent_since
                if begin is not None:
                    self.told.setdefault(event.shard, []).append((begin, self.now))
        return found

    def _apply(self, proposal: Proposal) -> int | NotConfirmed:
        result = super()._apply(proposal)
        record = decode_lease(proposal.value) if proposal.key.startswith(LEASES) else None
        if isinstance(result, int) and record is not None and not record.held:  # it was the owner until now
            shard = proposal.key[len(LEASES) :]
            self.released[shard] = self.now
            self.told.setdefault(shard, []).append((self.gained[shard], self.now))
        return result

    def _judge(self, name: str, shard: str, epoch: Epoch) -> None:
        wire = self.wire_of.get(shard)
        if wire is not None and wire.epoch not in (None, epoch) and self.now - wire.last > SLACK:
            self.takeovers += 1
            at = wire.last
            for begin, end in sorted(self.told.get(shard, ())):
                if begin <= at + SLACK:
                    at = max(at, end)
            if at + SLACK < self.now:
                self.untold.append(f"{self.now:.3f}: {shard} by {name} in {epoch}: {wire.last:.3f}, told to {at:.3f}")
        super()._judge(name, shard, epoch)


@pytest.mark.parametrize("seed", [6, 10, 14, 19, 21])
def test_no_time_without_an_owner_is_untold(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_world, "World", ToldWorld)
    world = random_walk(seed)
    assert isinstance(world, ToldWorld)
    assert world.takeovers
    assert not world.untold, world.untold

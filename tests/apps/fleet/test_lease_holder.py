"""A zone on the virtual clock: at most one owner at a time, and all shards polled once all is well."""

import random
from dataclasses import replace

import pytest
from fleet_scale import scale
from fleet_world import Network, World, random_walk

from busway.apps.fleet.balance import BEGIN
from busway.apps.fleet.coordinator import Entry
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.lease_holder import LeaseHolder, NotConfirmed, OwnershipChange, Proposal, _SeenLease
from busway.apps.fleet.lease_times import LeaseTimes
from busway.apps.fleet.table_records import LEASES, LeaseHole, LeaseRecord, MemberRecord, ZoneRecord, decode_lease

COSTS = {f"{number:04d}": 0.02 + 0.001 * (number % 7) for number in range(32)}


def settled(members: int = 3, costs: dict[str, float] = COSTS) -> World:
    world = World(costs, seed=members)
    for number in range(members):
        world.start(f"c{number}")
    world.run(15)
    assert len(world.owners()) == len(costs)
    return world


def test_collectors_that_start_together_share_the_shards_fairly() -> None:
    assert settled().imbalance() < BEGIN


def test_the_shards_of_a_killed_collector_are_polled_again_within_the_bound() -> None:
    world = settled()
    lost = sorted(shard for shard, name in world.owners().items() if name == "c1")
    world.kill("c1")
    killed = world.now
    world.run(LeaseTimes().ttl + LeaseTimes().guard + 3.0)
    assert sorted(shard for shard, begin, _ in world.holes if begin > 5) == lost
    assert all(end - killed <= 15 + 1 + 1 for _, begin, end in world.holes if begin > 5)
    world.run(20)
    assert world.imbalance() < BEGIN


def test_a_new_collector_gets_its_part_with_no_hole_longer_than_a_period_and_a_second() -> None:
    world = settled()
    world.start("c3")
    holes = len(world.holes)
    world.run(30)
    assert world.imbalance() < BEGIN
    assert len(world.holes) == holes, "holes of over two seconds"


def test_a_larger_zone_over_a_bad_network_is_level_and_takes_over_in_time() -> None:
    found = scale(8, shards=128)
    assert found.imbalance < 0.1
    assert found.takeover < LeaseTimes().ttl + LeaseTimes().guard + 1.0


def test_a_collector_that_drains_hands_everything_on_without_a_hole() -> None:
    world = settled()
    holes = len(world.holes)
    world.drivers["c0"].member.drain()
    world.run(20)
    assert set(world.owners().values()) == {"c1", "c2"}
    assert len(world.holes) == holes


def test_a_rolling_restart_in_order_leaves_no_hole() -> None:
    world = settled()
    holes = len(world.holes)
    for name in ("c0", "c1", "c2"):
        member = world.drivers[name].member
        member.end()
        world.run(10)
        assert member.has_ended
        world.kill(name)
        world.start(name)
        world.run(15)
    assert len(world.holes) == holes
    assert len(world.owners()) == len(COSTS)


def test_a_shard_of_a_collector_that_ends_goes_to_another_at_once() -> None:
    changes: list[float] = []
    for seed in range(4):
        world = World(COSTS, seed=seed, poll=0.2, worst=0.05, network=Network((0.01, 0.1)))
        for number in range(3):
            world.start(f"c{number}")
        world.run(15)
        world.changes.clear()
        for name in ("c0", "c1", "c2"):
            world.drivers[name].member.end()
            world.run(10)
            world.kill(name)
            world.start(name)
            world.run(15)
        changes += world.changes
    assert len(changes) > 100
    assert max(changes) < 0.8, "a period of 0.2 s, and four messages of up to 0.1 s"


def test_a_pinned_shard_waits_for_its_host_and_goes_to_its_backup() -> None:
    world = World({**COSTS, "pin.a": 0.1, "pin.b.c": 0.1}, seed=1)
    for host in "bcd":
        world.start(f"on-{host}", host)
    world.run(15)
    assert "pin.a" not in world.owners()
    assert world.owners()["pin.b.c"] == "on-b"
    world.kill("on-b")
    world.run(25)
    assert world.owners()["pin.b.c"] == "on-c"
    assert len(world.owners()) == len(COSTS) + 1, "a shard that no collector can take stops no other"


def test_a_second_process_of_the_same_name_owns_nothing_while_the_first_lives() -> None:
    world = settled(2)
    first = world.drivers.pop("c0")
    second = world.start("c0")
    world.drivers["first c0"] = first
    world.run(60)
    assert not second.member.owned
    assert second.member.rival == first.member._me.run
    assert first.member.owned
    world.kill("first c0")
    world.run(40)
    assert second.member.owned
    assert second.member.rival is None


def test_a_table_that_is_read_anew_again_and_again_does_not_keep_a_collector_from_its_name() -> None:
    """As where heartbeats of a watch are missing, so that it begins anew every four seconds."""
    times = LeaseTimes()
    member = LeaseHolder("west", "run", "west", times, random.Random(1), shards=4)
    dead = Entry("member.west", MemberRecord("west", "another run", "west", 5).encode(), 8)
    begin = now = 100.0
    while now < begin + 60.0:
        member.begin_snapshot()
        member.entry(dead, now)
        member.end_snapshot(now)
        for _ in range(40):
            if "member.west" in proposed(member, now):
                assert times.free_at(begin) <= now <= times.free_at(begin) + 5.0
                return
            now += 0.1
    raise AssertionError("the name of a process that has ended is never taken")


def test_an_older_record_of_another_process_does_not_take_the_name_back() -> None:
    member = alone()
    first = proposed(member, 0.0)
    member.outcome(first["member.west"], 9, 0.0)
    member.entry(Entry("member.west", MemberRecord("west", "another run", "west", 5).encode(), 8), 1.0)
    assert member.rival is None
    member.entry(Entry("member.west", MemberRecord("west", "another run", "west", 6).encode(), 10), 2.0)
    assert member.rival == "another run"


def test_a_renewal_without_an_answer_is_none() -> None:
    world = settled(1)
    member = world.drivers["c0"].member
    before = {shard: member.deadline(shard) for shard in member.owned}
    world.network = Network(loss=1.0)
    world.run(10)
    assert before.items() == {shard: member.deadline(shard) for shard in member.owned}.items() or all(
        member.deadline(shard) <= before[shard] + 3 for shard in member.owned
    )
    world.run(6)
    assert not member.owned
    assert member.counts.lapsed == len(COSTS)


def test_a_lease_counts_from_before_its_renewal_was_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(COSTS, seed=1, network=Network((1.0, 1.0)))
    member = world.start("c0").member
    world.run(20)
    asked: list[float] = []
    answer = member.outcome

    def late(proposal: Proposal, result: int | NotConfirmed, now: float) -> None:
        answer(proposal, result, now)
        if proposal.key == "lease.0000":
            assert now - proposal.asked == pytest.approx(2.0)
            asked.append(proposal.asked)

    monkeypatch.setattr(member, "outcome", late)
    world.run(10)
    assert member.deadline("0000") == asked[-1] + 14.0


def test_a_transaction_that_would_end_exactly_at_the_deadline_does_not_begin() -> None:
    world = settled(1)
    member = world.drivers["c0"].member
    deadline = member.deadline("0000")
    assert not member.permits("0000", deadline - 1.0, 1.0)
    assert member.permits("0000", deadline - 1.0, 0.999)


def test_shards_that_no_link_belongs_to_are_handed_back() -> None:
    world = settled(2)
    for driver in world.drivers.values():
        driver.member.set_shards({"0001": 0.1, "0002": 0.1})
    world.run(10)
    assert set(world.owners()) == {"0001", "0002"}


def test_a_generation_that_was_raised_is_in_every_new_epoch() -> None:
    world = settled(2)
    world.entries["generation"] = replace(next(iter(world.entries.values())), key="generation", value=b"7")
    for name in list(world.drivers):
        world.kill(name)
        world.start(f"new {name}")
    world.run(40)
    assert {each.epoch.generation for driver in world.drivers.values() for each in driver.member.owned.values()} == {7}


def judged(world: World) -> list[str]:
    """What was wrong in a walk: two owners at once, an epoch that went back, a shard that is not polled at its end."""
    silent = [f"{shard} silent for {seconds:.1f} s" for shard, seconds in world.open_holes().items() if seconds > 2]
    return world.breaches + silent


@pytest.mark.parametrize("seed", range(10))
def test_whatever_happens_a_shard_has_one_owner_and_is_polled_when_all_is_well_again(seed: int) -> None:
    world = random_walk(seed)
    assert judged(world) == []
    assert world.gains > 16


@pytest.mark.soak
def test_many_walks() -> None:
    for seed in range(10, 1000):
        assert judged(random_walk(seed, 60)) == [], seed


# What the walks must find: members that break one rule each.


class WithoutDeadline(LeaseHolder):
    def turn(self, now: float) -> list[Proposal]:
        for each in self.owned.values():
            each.asked = max(each.asked, now - 1.0)
        return super().turn(now)


class RenewedByAnUnansweredRenewal(LeaseHolder):
    def outcome(self, proposal: Proposal, result: int | NotConfirmed, now: float) -> None:
        owned = self.owned.get(proposal.key.removeprefix(LEASES))
        if result is NotConfirmed.UNKNOWN and owned is not None:
            owned.asked = proposal.asked
        super().outcome(proposal, result, now)


class TakesTooEarly(LeaseHolder):
    def _free_at(self, seen: _SeenLease) -> float:
        return super()._free_at(seen) - 3 * self.times.guard


class HandsOnBeforeItsLinksStopped(LeaseHolder):
    def turn(self, now: float) -> list[Proposal]:
        for shard, owned in self.owned.items():
            if owned.leaving is not None and not owned.has_left:
                self.left(shard)
        return super().turn(now)


class NeverTakesOver(LeaseHolder):
    def _free_at(self, seen: _SeenLease) -> float:
        return super()._free_at(seen) if seen.record is None or not seen.record.held else float("inf")


@pytest.mark.parametrize(
    "kind",
    [
        WithoutDeadline,
        RenewedByAnUnansweredRenewal,
        TakesTooEarly,
        HandsOnBeforeItsLinksStopped,
        NeverTakesOver,
    ],
)
def test_the_walks_find_a_member_that_breaks_a_rule(kind: type[LeaseHolder]) -> None:
    assert any(judged(random_walk(seed, member_kind=kind)) for seed in range(60))


def test_the_walks_find_a_coordinator_that_does_not_compare(monkeypatch: pytest.MonkeyPatch) -> None:
    honest = World._apply

    def careless(world: World, proposal: Proposal) -> int | NotConfirmed:
        present = world.entries.get(proposal.key)
        return honest(world, replace(proposal, revision=0 if present is None else present.revision))

    monkeypatch.setattr(World, "_apply", careless)
    assert any(judged(random_walk(seed)) for seed in range(20))


CLOCK = 1_000_000.0
"""The time by the coordinator's clock, where that of leases is 0."""


def clocks(ahead: float, *others: float) -> LeaseHolder:
    """A member whose clock is so far ahead of the coordinator's, with others whose clocks are too."""
    member = LeaseHolder("west", "run", "west", LeaseTimes(), random.Random(1))
    member.wall_ahead = CLOCK + ahead
    member.set_shards({"0001": 0.1})
    for number, each in enumerate(others):
        record = MemberRecord(f"c{number}", "run", "box", 1, at=CLOCK + each)
        member.entry(Entry(f"member.c{number}", record.encode(), number + 1, CLOCK + 0.1), 0.0)
    member.entry(Entry("zone", ZoneRecord(256, 15.0, 1.0).encode(), 49), 0.0)
    member.end_snapshot(0.0)
    (proposal,) = member.turn(0.0)
    member.entry(Entry(proposal.key, proposal.value, 50, CLOCK + 3.0), 4.0)
    member.outcome(proposal, 50, 4.0)
    member.turn(4.0)
    return member


@pytest.mark.parametrize(
    ("ahead", "others", "problem"),
    [
        (0.0, [], ""),
        (10.0, [], "its clock is 7 s ahead of the coordinator's"),
        (-60.0, [], "its clock is 59 s behind the coordinator's"),
        (60.0, [0.0, 60.0], "its clock is 57 s ahead of the coordinator's"),
        (60.0, [57.0, 58.0, 0.0], ""),
        (60.0, [57.0], ""),
    ],
)
def test_a_clock_is_wrong_unless_most_collectors_agree_with_it(ahead: float, others: list[float], problem: str) -> None:
    member = clocks(ahead, *others)
    assert member.problem == problem
    member.turn(6.0)
    assert ("lease.0001" in member._open) is not bool(problem)


def test_an_answer_that_takes_long_makes_no_clock_wrong() -> None:
    member = clocks(0.0)
    member.turn(8.0)
    proposal = member._open["member.west"]
    member.entry(Entry(proposal.key, proposal.value, 51, CLOCK + 9.0), 900.0)
    assert member.clock_error == 0.0


def alone(times: LeaseTimes | None = None, *, shards: int = 4) -> LeaseHolder:
    """A member that has seen a table without entries, and whose own record is confirmed."""
    member = LeaseHolder("west", "run", "west", times or LeaseTimes(), random.Random(1), shards=shards)
    member.set_shards({"0001": 0.1})
    member.end_snapshot(0.0)
    return member


def proposed(member: LeaseHolder, now: float) -> dict[str, Proposal]:
    return {each.key: each for each in member.turn(now)}


def acted(seed: int) -> dict[str, float]:
    """When a collector takes its first shard, renews it, and gives one to a collector that comes after ten seconds.

    All that it sees, and when, is the same for each seed.
    """
    member = LeaseHolder("west", "run", "west", LeaseTimes(), random.Random(seed), shards=8)
    member.set_shards({f"{number:04d}": 0.1 for number in range(8)})
    member.end_snapshot(0.0)
    found: dict[str, float] = {}
    now, revision = 0.0, 0
    while "gives" not in found and now < 25.0:
        now = max(now + 1e-3, member.next_turn())
        if now > 10.0 and revision < 1000:
            revision = 1000
            member.entry(Entry("member.east", MemberRecord("east", "run", "east", 1).encode(), revision), 10.0)
        for each in member.turn(now):
            revision += 1
            member.entry(Entry(each.key, each.value, revision), now)
            member.outcome(each, revision, now)
            if each.key == f"{LEASES}0000":
                found.setdefault("renews" if "takes" in found else "takes", now)
        if any(event.change is OwnershipChange.LEAVE for event in member.events()):
            found.setdefault("gives", now)
    return found


@pytest.mark.parametrize(("act", "spread"), [("takes", 0.1), ("renews", 0.2), ("gives", 1.5)])
def test_collectors_that_see_the_same_do_not_act_at_the_same_moment(act: str, spread: float) -> None:
    """Each would make a change that is in vain, or all renewals would come at once."""
    moments = sorted(acted(seed)[act] for seed in range(40))
    assert len({round(each, 3) for each in moments}) > 30
    assert moments[-1] - moments[0] > spread


def test_the_first_collector_records_the_figures_of_the_zone_and_owns_nothing_before_that_is_confirmed() -> None:
    member = alone()
    first = proposed(member, 0.0)
    member.entry(Entry("member.west", first["member.west"].value, 1), 0.0)
    member.outcome(first["member.west"], 1, 0.0)
    assert "lease.0001" not in proposed(member, 10.0)
    member.outcome(first["zone"], NotConfirmed.UNKNOWN, 10.0)
    again = proposed(member, 11.0)
    assert "lease.0001" not in again
    member.outcome(again["zone"], 2, 11.0)
    assert "lease.0001" in proposed(member, 12.0)


@pytest.mark.parametrize(
    ("zone", "problem"),
    [
        (ZoneRecord(8, 15.0, 1.0), "the zone has 8 shards and not 4; all its collectors must have the same"),
        (ZoneRecord(4, 30.0, 1.0), "the zone has leases of 30 s and not 15; all its collectors must have the same"),
        (ZoneRecord(8, 15.0, 2.0),
         "the zone has 8 shards and not 4, a guard of 2 s and not 1; all its collectors must have the same"),
    ],
)  # fmt: skip
def test_a_collector_with_other_figures_than_its_zone_says_so_and_owns_nothing(zone: ZoneRecord, problem: str) -> None:
    member = alone()
    first = proposed(member, 0.0)
    member.entry(Entry("member.west", first["member.west"].value, 2), 0.0)
    member.outcome(first["member.west"], 2, 0.0)
    member.entry(Entry("zone", zone.encode(), 1), 0.0)
    member.outcome(first["zone"], NotConfirmed.CONFLICT, 0.0)
    for now in (1.0, 10.0, 60.0):
        assert not [key for key in proposed(member, now) if key.startswith((LEASES, "zone"))]
    assert member.problem == problem
    member.entry(Entry("zone", ZoneRecord(4, 15.0, 1.0).encode(), 3), 61.0)
    member.turn(62.0)
    assert not member.problem


@pytest.mark.parametrize("is_there", [True, False], ids=["at once", "later"])
def test_other_figures_of_the_zone_count_also_where_a_table_that_is_read_anew_has_lower_revisions(
    is_there: bool,
) -> None:
    """As after the coordinator has lost its entries, when a collector with other figures came first."""
    member = LeaseHolder("west", "run", "west", LeaseTimes(), random.Random(1), shards=256)
    member.entry(Entry("zone", ZoneRecord(256, 15.0, 1.0).encode(), 500), 0.0)
    member.end_snapshot(0.0)
    member.turn(0.0)
    assert not member.problem
    lower = Entry("zone", ZoneRecord(64, 15.0, 1.0).encode(), 3)
    member.begin_snapshot()
    if is_there:
        member.entry(lower, 1.0)
    member.end_snapshot(1.0)
    if not is_there:
        member.entry(lower, 1.5)
    member.turn(2.0)
    assert member.problem == "the zone has 64 shards and not 256; all its collectors must have the same"
    member.entry(Entry("zone", ZoneRecord(256, 15.0, 1.0).encode(), 2), 3.0)
    member.turn(4.0)
    assert "64 shards" in member.problem, "revisions rise again from there on"


def test_what_is_owned_is_given_back_where_the_figures_of_the_zone_change() -> None:
    world = settled(1)
    member = world.drivers["c0"].member
    member.entry(Entry("zone", ZoneRecord(8, 15.0, 1.0).encode(), 10**6), world.now)
    world.run(5)
    assert not member.owned
    assert "8 shards" in member.problem


def test_revisions_that_were_shown_too_high_are_replaced_when_the_table_is_read_anew() -> None:
    """As where the watch of a server with another count was left for that of the server that leads."""
    times = LeaseTimes()
    member = LeaseHolder("west", "run", "west", times, random.Random(1), shards=4)
    member.set_shards({"0001": 0.1})
    held = LeaseRecord("east", "dead", True, 3, 0.1, None)
    dead = MemberRecord("west", "another run", "west", 5)
    for lead, now in ((15, 100.0), (0, 104.0)):
        member.begin_snapshot()
        member.entry(Entry("zone", ZoneRecord(4, times.ttl, times.guard).encode(), 2), now)
        member.entry(Entry("lease.0001", held.encode(), 50 + lead), now)
        member.entry(Entry("member.west", dead.encode(), 51 + lead), now)
        member.end_snapshot(now)
    asked: dict[str, int] = {}
    revision, now = 60, 104.0
    while now < 180.0 and "lease.0001" not in asked:
        for proposal in member.turn(now):
            asked.setdefault(proposal.key, proposal.revision)
            revision += 1
            if proposal.key == "member.west":
                member.entry(Entry(proposal.key, proposal.value, revision), now)
            member.outcome(proposal, revision, now)
        now += 0.1
    assert asked["lease.0001"] == 50
    assert asked["member.west"] == 51


def test_an_epoch_is_above_the_last_one_also_where_a_server_counts_lower_than_before() -> None:
    member = alone()
    first = proposed(member, 0.0)
    member.entry(Entry("member.west", first["member.west"].value, 1), 0.0)
    member.outcome(first["member.west"], 1, 0.0)
    member.outcome(first["zone"], 2, 0.0)
    member.entry(Entry("lease.0001", LeaseRecord("east", "r", True, 3, 0.1, Epoch(1, 500)).encode(), 503), 0.0)
    member.begin_snapshot()
    released = LeaseRecord("east", "r", False, 1, 0.1, Epoch(1, 80))
    member.entry(Entry("lease.0001", released.encode(), 90), 1.0)
    member.end_snapshot(1.0)
    taken = proposed(member, 4.0)["lease.0001"]
    assert taken.revision == 90
    member.outcome(taken, 91, 4.0)
    assert member.owned["0001"].epoch == Epoch(1, 501)
    record = decode_lease(taken.value)
    assert record is not None
    assert record.epoch_at(91, 1) == Epoch(1, 501)  # what all others compute of the entry
    assert record.epoch_at(700, 1) == Epoch(1, 700)


def test_an_entry_of_an_older_version_has_no_epoch_before_it() -> None:
    record = decode_lease(b'["east","r",1,0,0.1,null,"",5.0]')
    assert record == LeaseRecord("east", "r", True, 0, 0.1, None, at=5.0)
    assert record.epoch_at(7, 2) == Epoch(2, 7)


def test_a_lease_says_the_hole_before_it_as_long_as_it_is_held() -> None:
    member = alone()
    member.wall_ahead = 1000.0
    first = proposed(member, 0.0)
    member.entry(Entry("member.west", first["member.west"].value, 1), 0.0)
    member.outcome(first["member.west"], 1, 0.0)
    member.outcome(first["zone"], 2, 0.0)
    member.entry(Entry("lease.0001", LeaseRecord("east", "r", True, 3, 0.1, Epoch(1, 5), at=1001.0).encode(), 8), 1.0)
    taken = proposed(member, 17.5)["lease.0001"]
    hole = LeaseHole("east", True, 1001.0, 1017.5)
    record = decode_lease(taken.value)
    assert record is not None
    assert record.hole == hole
    member.outcome(taken, 9, 17.5)
    renewal = decode_lease(proposed(member, 21.0)["lease.0001"].value)
    assert renewal is not None
    assert (renewal.count, renewal.hole) == (1, hole)


def test_the_first_owner_of_a_shard_has_no_hole_before_it() -> None:
    world = settled(1)
    assert all(owned.hole is None for owned in world.drivers["c0"].member.owned.values())


@pytest.mark.parametrize(
    ("own", "of_the_lease", "free_at"),
    [
        (LeaseTimes(), LeaseTimes.lasting(60.0).silence, 64.0),
        (LeaseTimes.lasting(60.0), LeaseTimes().silence, 64.0),
        (LeaseTimes(), LeaseTimes().silence, 16.0),
        (LeaseTimes(), 0.0, 16.0),
        (LeaseTimes(), 1e300, 375.0),
    ],
)
def test_a_lease_holds_for_its_own_time_and_for_that_of_the_collector_that_wants_its_shard(
    own: LeaseTimes, of_the_lease: float, free_at: float
) -> None:
    """As where a collector was cut off while all others were stopped and started with other times."""
    member = alone(own)
    first = proposed(member, 0.0)
    member.entry(Entry("member.west", first["member.west"].value, 1), 0.0)
    member.outcome(first["member.west"], 1, 0.0)
    member.outcome(first["zone"], 2, 0.0)
    held = LeaseRecord("east", "run of east", True, 3, 0.1, Epoch(1, 3), silence=of_the_lease)
    member.entry(Entry("lease.0001", held.encode(), 5), 0.0)
    now, taken = 3.0, None
    while taken is None:
        now += 0.1
        turned = proposed(member, now)
        taken = turned.get("lease.0001")
    assert free_at <= now < free_at + 2.0
    record = decode_lease(taken.value)
    assert record is not None
    assert record.silence == own.silence, "the new owner writes what holds for its own lease"


def test_every_renewal_says_how_long_the_lease_holds() -> None:
    world = settled(1)
    world.run(10)
    records = [decode_lease(entry.value) for key, entry in world.entries.items() if key.startswith(LEASES)]
    assert {each.silence for each in records if each is not None} == {LeaseTimes().silence}


def test_a_shard_whose_taking_had_no_answer_is_taken_again_with_the_gap_since_the_owner_before() -> None:
    """The lease is in the table, and this collector has polled nothing by it."""
    member = alone()
    member.wall_ahead = 1000.0
    first = proposed(member, 0.0)
    member.entry(Entry("member.west", first["member.west"].value, 1), 0.0)
    member.outcome(first["member.west"], 1, 0.0)
    member.outcome(first["zone"], 2, 0.0)
    member.entry(Entry("lease.0001", LeaseRecord("east", "r", True, 3, 0.1, Epoch(1, 5), at=1001.0).encode(), 8), 1.0)
    now = 17.5
    taken = proposed(member, now)["lease.0001"]
    for revision in (9, 10):
        member.outcome(taken, NotConfirmed.UNKNOWN, now)
        member.entry(Entry("lease.0001", taken.value, revision), now)
        assert not member.owned
        now += 3.0
        taken = proposed(member, now)["lease.0001"]
        assert taken.revision == revision
    member.outcome(taken, 11, now)
    (event,) = member.events()
    assert event.silent_since == 1001.0
    assert member.owned["0001"].hole == LeaseHole("east", True, 1001.0, 1000.0 + now)


def test_a_shard_that_was_owned_and_lapsed_has_a_gap_since_its_own_last_renewal() -> None:
    member = alone()
    member.wall_ahead = 1000.0
    first = proposed(member, 0.0)
    member.entry(Entry("member.west", first["member.west"].value, 1), 0.0)
    member.outcome(first["member.west"], 1, 0.0)
    member.outcome(first["zone"], 2, 0.0)
    member.entry(Entry("lease.0001", LeaseRecord("east", "r", True, 3, 0.1, Epoch(1, 5), at=1001.0).encode(), 8), 1.0)
    taken = proposed(member, 17.5)["lease.0001"]
    member.outcome(taken, 9, 17.5)
    assert [event.silent_since for event in member.events()] == [1001.0]
    again = proposed(member, 40.0)["lease.0001"]
    member.outcome(again, 10, 40.0)
    lost, gained = member.events()
    assert (lost.change, gained.change) == (OwnershipChange.LOST, OwnershipChange.GAINED)
    assert lost.silent_since == gained.silent_since == 1017.5


@pytest.mark.parametrize(("wall_ahead", "begin"), [(1.8e9, 1.8e9 + 1.0), (1000.0, 61.0)])
def test_a_gap_after_an_owner_whose_clock_was_not_set_begins_when_its_lease_was_seen_last(
    wall_ahead: float, begin: float
) -> None:
    """Both collectors began in 1970. Where the clock is set now, the time in the lease says nothing."""
    member = alone()
    first = proposed(member, 0.0)
    member.entry(Entry("member.west", first["member.west"].value, 1), 0.0)
    member.outcome(first["member.west"], 1, 0.0)
    member.outcome(first["zone"], 2, 0.0)
    member.entry(Entry("lease.0001", LeaseRecord("east", "r", True, 3, 0.1, Epoch(1, 5), at=61.0).encode(), 8), 1.0)
    member.wall_ahead = wall_ahead
    member.outcome(proposed(member, 17.5)["lease.0001"], 9, 17.5)
    (event,) = member.events()
    assert event.silent_since == begin

import random

from hypothesis import given
from hypothesis import strategies as st

from busway.apps.fleet.balance import BEGIN, MOST_MOVES, Move, Share, moves, takers

COSTS = st.lists(st.floats(0.001, 1.0), min_size=1, max_size=40)


def shares(*loads: float) -> list[Share]:
    return [Share(f"c{number}", f"h{number}", load) for number, load in enumerate(loads)]


def test_free_shards_go_to_the_least_loaded_and_the_dearest_first() -> None:
    found = takers({"0000": 0.1, "0001": 0.5, "0002": 0.3}, shares(0.0, 0.15))
    assert found == {"0001": "c0", "0002": "c1", "0000": "c1"} or found["0001"] == "c0"


def test_who_drains_takes_nothing() -> None:
    assert takers({"0000": 0.1}, [Share("c0", "h0", 0.0, draining=True), Share("c1", "h1", 9.0)]) == {"0000": "c1"}
    assert takers({"0000": 0.1}, [Share("c0", "h0", 0.0, draining=True)]) == {}


def test_a_pinned_shard_goes_to_its_first_host_that_lives_and_to_no_other() -> None:
    members = shares(0.0, 5.0, 0.0)
    assert takers({"pin.h1.h2": 0.1}, members) == {"pin.h1.h2": "c1"}
    assert takers({"pin.h1.h2": 0.1}, [members[0], members[2]]) == {"pin.h1.h2": "c2"}
    assert takers({"pin.h1": 0.1}, [members[0]]) == {}


@given(COSTS, st.integers(1, 8))
def test_taking_never_loads_one_more_than_the_fair_part_and_one_shard(costs: list[float], members: int) -> None:
    free = {f"{number:04d}": cost for number, cost in enumerate(costs)}
    loads = [0.0] * members
    for shard, taker in takers(free, shares(*loads)).items():
        loads[int(taker[1:])] += free[shard]
    assert abs(sum(loads) - sum(costs)) < 1e-9
    assert max(loads) <= sum(costs) / members + max(costs) + 1e-9


def owned_by(chance: random.Random, members: int, shards: int) -> dict[str, tuple[str, float]]:
    return {f"{number:04d}": (f"c{chance.randrange(members)}", chance.uniform(0.01, 0.1)) for number in range(shards)}


def after(owned: dict[str, tuple[str, float]], found: list[Move]) -> dict[str, tuple[str, float]]:
    made = dict(owned)
    for move in found:
        assert made[move.shard][0] == move.giver
        made[move.shard] = (move.taker, made[move.shard][1])
    return made


def members_of(owned: dict[str, tuple[str, float]], count: int) -> list[Share]:
    loads = [0.0] * count
    for owner, cost in owned.values():
        loads[int(owner[1:])] += cost
    return shares(*loads)


@given(st.integers(0, 10_000), st.integers(2, 6))
def test_moves_level_the_loads_and_then_end(seed: int, members: int) -> None:
    owned = owned_by(random.Random(seed), members, 60)
    for _ in range(20):
        found = moves(owned, members_of(owned, members), moving=True)
        assert len(found) <= MOST_MOVES
        owned = after(owned, found)
        if not found:
            break
    assert not moves(owned, members_of(owned, members))
    loads = [each.load for each in members_of(owned, members)]
    fair = sum(loads) / members
    assert max(loads) <= fair * (1 + BEGIN) + 1e-9


def test_two_collectors_exchange_shards_where_none_is_small_enough_to_move() -> None:
    owned = {"0000": ("c0", 0.6), "0001": ("c0", 0.5), "0002": ("c1", 0.4), "0003": ("c1", 0.3)}
    found = moves(owned, members_of(owned, 2))
    assert {(move.giver, move.taker) for move in found} == {("c0", "c1"), ("c1", "c0")}
    owned = after(owned, found)
    assert [round(each.load, 9) for each in members_of(owned, 2)] == [0.9, 0.9]
    assert not moves(owned, members_of(owned, 2), moving=True)


def test_an_exchange_that_leaves_most_of_the_difference_is_not_worth_two_moves() -> None:
    owned = {"0000": ("c0", 1.2), "0001": ("c1", 0.45), "0002": ("c1", 0.45)}
    assert moves(owned, members_of(owned, 2)) == []


@given(st.integers(0, 10_000), st.integers(50, 250))
def test_a_zone_of_many_collectors_with_few_shards_each_becomes_level(seed: int, members: int) -> None:
    chance = random.Random(seed)
    owned = owned_by(chance, members, 6 * members)
    for _ in range(40):
        found = moves(owned, members_of(owned, members), moving=True)
        if not found:
            break
        owned = after(owned, found)
    loads = [each.load for each in members_of(owned, members)]
    fair = sum(loads) / members
    assert max(abs(load - fair) for load in loads) <= fair * 0.1


def test_a_difference_exactly_at_the_limit_moves_nothing() -> None:
    owned = {"0000": ("c0", 1.0 + BEGIN), "0001": ("c1", 1.0 - BEGIN), "0002": ("c0", 0.0), "0003": ("c1", 0.0)}
    assert moves(owned, members_of(owned, 2)) == []


def test_a_shard_that_alone_is_too_much_does_not_wander() -> None:
    owned = {"0000": ("c0", 5.0), "0001": ("c1", 0.1)}
    assert moves(owned, members_of(owned, 2)) == []


def test_who_drains_gives_all_that_others_can_reach() -> None:
    owned = {"0000": ("c0", 0.5), "pin.h0": ("c0", 0.5), "pin.h0.h1": ("c0", 0.1), "0001": ("c1", 0.5)}
    members = members_of(owned, 2)
    members[0].draining = True
    assert {(move.shard, move.taker) for move in moves(owned, members)} == {("0000", "c1"), ("pin.h0.h1", "c1")}
    assert moves(owned, members[:1]) == []

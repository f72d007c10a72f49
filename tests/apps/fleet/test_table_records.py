"""Entries of the shared table: what was written is read, and what no collector writes counts as missing."""

import json
import random

import pytest

from busway.apps.fleet.coordinator import Entry
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.lease_holder import LeaseHolder
from busway.apps.fleet.lease_times import LeaseTimes
from busway.apps.fleet.table_records import (
    LARGEST,
    LeaseHole,
    LeaseRecord,
    MaintainedDevice,
    MemberRecord,
    ZoneRecord,
    decode_generation,
    decode_lease,
    decode_member,
    decode_zone,
)

LEASE = b'["a","r",1,2,0.1,[1,7],"",5.0,[1,6],["b",1,3.0,4.0],16.0,[["d",9,"anna","new sensor"]]]'
MEMBER = b'["a","r","a",1,1.0,0,0,0,5.0,"",0]'
ZONE = b"[256,15.0,1.0]"
IMPOSSIBLE = [b"1e999", b"-1e999", b"NaN", b"Infinity", b"1e300", b"9" * 400, b"9" * 5000, b'"9"', b"[]", b"null"]


def in_each_place_of_a_number(record: bytes) -> list[bytes]:
    """The record again and again, each time with another impossible number in the place of one of its numbers."""
    parts = record.replace(b"[", b" [ ").replace(b"]", b" ] ").replace(b",", b" , ").split()
    numbers = [at for at, part in enumerate(parts) if part[:1].isdigit()]
    return [b"".join([*parts[:at], wrong, *parts[at + 1 :]]) for at in numbers for wrong in IMPOSSIBLE]


def test_records_are_read_as_they_were_written() -> None:
    hole, maintained = LeaseHole("b", True, 3.0, 4.0), MaintainedDevice("d", 9, "anna", "new sensor")
    lease = LeaseRecord("a", "r", True, 2, 0.1, Epoch(1, 7), "", 5.0, Epoch(1, 6), hole, 16.0, (maintained,))
    assert lease.encode() == LEASE
    assert decode_lease(LEASE) == lease
    assert decode_member(MEMBER) == MemberRecord("a", "r", "a", 1, at=5.0)
    assert decode_zone(ZONE) == ZoneRecord(256, 15.0, 1.0)


def test_a_lease_of_an_older_version_says_nothing_of_maintenance() -> None:
    older = decode_lease(json.dumps(json.loads(LEASE)[:11]).encode())
    assert older is not None
    assert older.maintenance is None
    none = decode_lease(LeaseRecord("a", "r", True, 2, 0.1, None, maintenance=()).encode())
    assert none is not None
    assert none.maintenance == ()


def test_a_record_with_a_number_that_no_record_has_is_never_an_error_and_gives_no_such_number() -> None:
    for wrong in in_each_place_of_a_number(LEASE):
        found = decode_lease(wrong)
        epochs = () if found is None else (found.epoch, found.before)
        assert all(each is None or each.revision <= LARGEST for each in epochs), wrong
        assert found is None or abs(found.at) <= LARGEST, wrong
    for wrong in in_each_place_of_a_number(MEMBER):
        assert (member := decode_member(wrong)) is None or abs(member.at) <= LARGEST, wrong
    assert not any(map(decode_zone, in_each_place_of_a_number(ZONE)))


@pytest.mark.parametrize("fields", range(14))
def test_a_collector_of_any_version_is_read_with_what_it_writes(fields: int) -> None:
    written = ["a", "r", "h", 1, 2.0, 1, 3, 0, 5.0, "its clock", 7, "of a later version", 9]
    row = [*written[:fields], *[0.0, "", 0][max(0, fields - 8) :]]
    found = decode_member(json.dumps(written[:fields]).encode())
    if fields < 8:
        assert found is None
    else:
        assert found == MemberRecord("a", "r", "h", 1, 2.0, True, 3, False, *row[8:11])


@pytest.mark.parametrize(
    "wrong",
    [
        b'["a","r",1,1e999,0.1,null,"",0.0,null,null,1]',
        b'["a","r",1,1,NaN,null,"",0.0,null,null,1]',
        b'["a","r",1,1,0.1,[1,1e30],"",0.0,null,null,1]',
        b'["a","r",1,1,0.1,{},"",0.0,null,null,1]',
        b'["a","r",1,1,0.1,null,"",0.0,null,{"b":1},1]',
        b"[" * 100_000,
        b"\xff",
        b"{}",
        b"",
    ],
)
def test_a_lease_that_cannot_be_read_is_missing_and_its_shard_is_taken(wrong: bytes) -> None:
    assert decode_lease(wrong) is None
    member = LeaseHolder("west", "run", "west", LeaseTimes(), random.Random(1), shards=4)
    member.set_shards({"0001": 0.1})
    for at, key in enumerate(("lease.0001", "member.east", "zone", "generation"), 1):
        member.entry(Entry(key, wrong, at), 0.0)
    member.entry(Entry("zone", ZoneRecord(4, 15.0, 1.0).encode(), 5), 0.0)
    member.end_snapshot(0.0)
    asked, now = {}, 0.0
    while now < 20.0 and "lease.0001" not in asked:
        for proposal in member.turn(now):
            asked[proposal.key] = proposal.revision
            member.entry(Entry(proposal.key, proposal.value, 10), now)
            member.outcome(proposal, 10, now)
        now += 0.1
    assert asked["lease.0001"] == 1


@pytest.mark.parametrize("capacity", [b"0", b"-1.0"])
def test_a_collector_without_a_capacity_above_zero_is_missing(capacity: bytes) -> None:
    assert decode_member(MEMBER.replace(b"1.0", capacity)) is None


@pytest.mark.parametrize(("value", "generation"), [(b"7", 7), (b"-1", 1), (b"", 1), (b"\xff", 1), (b"9" * 30, 1)])
def test_a_generation_that_cannot_be_read_is_the_first(value: bytes, generation: int) -> None:
    assert decode_generation(value) == generation

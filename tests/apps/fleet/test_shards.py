from collections import Counter

import pytest

from busway.apps.fleet.shards import (
    checked_name,
    checked_zone,
    hosts_of,
    keys_zone,
    links_by_shard,
    pinned_shard,
    shard_names,
    shard_of,
)
from busway.errors import ConfigError

LINKS = [f"link-{number}" for number in range(5000)]


def test_links_are_spread_evenly_over_the_shards() -> None:
    found = Counter(shard_of(link, 50) for link in LINKS)
    assert set(found) == set(shard_names(50))
    assert max(found.values()) < 150
    assert min(found.values()) > 60


def test_a_further_shard_takes_its_part_of_the_links_and_moves_no_other() -> None:
    moved = [link for link in LINKS if shard_of(link, 64) != shard_of(link, 65)]
    assert all(shard_of(link, 65) == "0064" for link in moved)
    assert 30 < len(moved) < 130


def test_the_shard_of_a_link_is_the_same_on_every_machine_and_for_ever() -> None:
    assert [shard_of(link, 256) for link in ("hall", "roof", "plant 7")] == ["0048", "0156", "0234"]


def test_links_that_only_some_hosts_can_reach_have_a_shard_of_their_own() -> None:
    found = links_by_shard([("bus", ["box-1", "box-2"]), ("bus 2", ["box-1", "box-2"]), ("net", ())], 8)
    assert found[pinned_shard(["box-1", "box-2"])] == ["bus", "bus 2"]
    assert hosts_of("pin.box-1.box-2") == ("box-1", "box-2")
    assert hosts_of("0003") == ()


@pytest.mark.parametrize("name", ["", "a.b", "a b", "-a", "ä", "a" * 64, "a>"])
def test_what_cannot_be_part_of_a_key_is_refused_by_name(name: str) -> None:
    with pytest.raises(ConfigError, match="cannot be a name"):
        checked_name(name, "host")


def test_a_zone_has_room_for_the_zone_of_its_keys_and_a_longer_name_is_refused_with_the_limit() -> None:
    assert checked_name(keys_zone(checked_zone("a" * 54)), "zone")
    with pytest.raises(ConfigError, match=r"up to 54 characters, and 'a+' has 55"):
        checked_zone("a" * 55)

"""What a line remembers of reads, and what it forgets at a write."""

from busway.apps.gateway.read_cache import BLOCKS_PER_UNIT, ReadCache
from busway.codes import Table

HOLDING, COILS = Table.HOLDING_REGISTERS, Table.COILS
KEY = b"\3\0\0\0\12"


def read_begins(cache: ReadCache[str], unit: int, key: bytes, read: str) -> int:
    """A read is sent; others may share it where the cache lets them."""
    shared = cache.shared(unit)
    if shared is not None:
        shared[key] = read
    return cache.changes(unit)


def read_ended(cache: ReadCache[str], unit: int, key: bytes, read: str) -> None:
    shared = cache.shared(unit)
    if shared is not None and shared.get(key) == read:
        del shared[key]


def reading(cache: ReadCache[str], unit: int, key: bytes) -> str | None:
    """The read in flight that a new one would share."""
    return (cache.shared(unit) or {}).get(key)


def _remembered(cache: ReadCache[str], unit: int = 1, place: tuple[Table, int, int] = (HOLDING, 100, 4)) -> None:
    since = read_begins(cache, unit, KEY, "one")
    cache.remember(unit, place, bytes(range(8)), since=since, read_at=10.0)
    read_ended(cache, unit, KEY, "one")


def test_a_read_in_flight_may_be_shared_until_it_ends() -> None:
    cache: ReadCache[str] = ReadCache()
    read_begins(cache, 1, KEY, "one")
    assert reading(cache, 1, KEY) == "one"
    assert reading(cache, 2, KEY) is None
    read_ended(cache, 1, KEY, "one")
    assert reading(cache, 1, KEY) is None


def test_nothing_is_shared_from_the_asking_of_a_write_to_its_end() -> None:
    cache: ReadCache[str] = ReadCache()
    read_begins(cache, 1, KEY, "before")
    cache.write_begins(1)
    assert reading(cache, 1, KEY) is None
    read_begins(cache, 1, KEY, "meanwhile")
    assert reading(cache, 1, KEY) is None
    cache.write_ended(1)
    assert reading(cache, 1, KEY) is None
    read_begins(cache, 1, KEY, "after")
    assert reading(cache, 1, KEY) == "after"


def test_two_writes_at_once_both_have_to_end() -> None:
    cache: ReadCache[str] = ReadCache()
    cache.write_begins(1)
    cache.write_begins(1)
    cache.write_ended(1)
    read_begins(cache, 1, KEY, "one")
    assert reading(cache, 1, KEY) is None


def test_a_write_to_one_unit_leaves_the_others() -> None:
    cache: ReadCache[str] = ReadCache()
    _remembered(cache, unit=2)
    cache.write_begins(1)
    assert cache.recall(2, (HOLDING, 100, 4), 10.5, for_seconds=1) == bytes(range(8))


def test_a_broadcast_concerns_all_units() -> None:
    cache: ReadCache[str] = ReadCache()
    _remembered(cache, unit=2)
    cache.write_begins(0)
    assert cache.recall(2, (HOLDING, 100, 4), 10.5, for_seconds=1) is None
    read_begins(cache, 2, KEY, "meanwhile")
    assert reading(cache, 2, KEY) is None


def test_a_value_is_recalled_until_its_time_is_over() -> None:
    cache: ReadCache[str] = ReadCache()
    _remembered(cache)
    assert cache.recall(1, (HOLDING, 100, 4), 10.9, for_seconds=1) == bytes(range(8))
    assert cache.recall(1, (HOLDING, 100, 4), 11.0, for_seconds=1) is None


def test_a_part_is_recalled_out_of_a_larger_block() -> None:
    cache: ReadCache[str] = ReadCache()
    _remembered(cache)
    assert cache.recall(1, (HOLDING, 101, 2), 10.1, for_seconds=1) == bytes((2, 3, 4, 5))
    assert cache.recall(1, (HOLDING, 99, 2), 10.1, for_seconds=1) is None
    assert cache.recall(1, (HOLDING, 103, 2), 10.1, for_seconds=1) is None
    assert cache.recall(1, (Table.INPUT_REGISTERS, 101, 2), 10.1, for_seconds=1) is None


def test_bits_are_cut_out_of_a_larger_block() -> None:
    cache: ReadCache[str] = ReadCache()
    since = read_begins(cache, 1, KEY, "one")
    cache.remember(1, (COILS, 8, 16), b"\x0f\xf0", since=since, read_at=0.0)
    assert cache.recall(1, (COILS, 10, 4), 0.5, for_seconds=1) == b"\x03"


def test_a_read_that_was_asked_before_a_write_ended_is_not_remembered() -> None:
    cache: ReadCache[str] = ReadCache()
    since = read_begins(cache, 1, KEY, "one")
    cache.write_begins(1)
    cache.write_ended(1)
    cache.remember(1, (HOLDING, 100, 4), bytes(8), since=since, read_at=10.0)
    assert cache.recall(1, (HOLDING, 100, 4), 10.1, for_seconds=1) is None


def test_what_is_remembered_is_bounded() -> None:
    cache: ReadCache[str] = ReadCache()
    for first in range(BLOCKS_PER_UNIT + 1):
        since = read_begins(cache, 1, KEY, "one")
        cache.remember(1, (HOLDING, first * 10, 4), bytes(8), since=since, read_at=0.0)
    assert cache.recall(1, (HOLDING, 0, 4), 0.5, for_seconds=1) is None
    assert cache.recall(1, (HOLDING, 10, 4), 0.5, for_seconds=1) is not None


def test_the_device_itself_may_be_any_of_its_units() -> None:
    cache: ReadCache[str] = ReadCache()
    _remembered(cache, unit=2)
    _remembered(cache, unit=255)
    read_begins(cache, 2, KEY, "meanwhile")
    cache.write_begins(255)
    assert reading(cache, 2, KEY) is None
    assert cache.recall(2, (HOLDING, 100, 4), 10.5, for_seconds=1) is None
    cache.write_ended(255)
    _remembered(cache, unit=255)
    cache.write_begins(2)
    assert cache.recall(255, (HOLDING, 100, 4), 10.5, for_seconds=1) is None
    read_begins(cache, 255, KEY, "meanwhile")
    assert reading(cache, 255, KEY) is None
    cache.write_ended(2)
    read_begins(cache, 255, KEY, "after")
    assert reading(cache, 255, KEY) == "after"


def test_a_write_to_one_unit_of_a_device_forgets_what_is_remembered_of_its_others() -> None:
    cache: ReadCache[str] = ReadCache(same_device=[{1, 2}, {5, 6, 7}])
    for unit in (1, 2, 3, 5, 6, 7):
        _remembered(cache, unit=unit)
    cache.write_begins(2)
    cache.write_ended(2)
    place = (HOLDING, 100, 4)
    recalled = [unit for unit in (1, 2, 3, 5, 6, 7) if cache.recall(unit, place, 10.5, for_seconds=1) is not None]
    assert recalled == [3, 5, 6, 7]


def test_while_one_unit_of_a_device_is_written_nothing_of_its_others_is_shared_or_remembered() -> None:
    cache: ReadCache[str] = ReadCache(same_device=[{1, 2}])
    read_begins(cache, 1, KEY, "before")
    cache.write_begins(2)
    assert reading(cache, 1, KEY) is None
    assert cache.shared(1) is None
    _remembered(cache, unit=1)
    assert cache.recall(1, (HOLDING, 100, 4), 10.5, for_seconds=1) is None
    cache.write_ended(2)
    _remembered(cache, unit=1)
    assert cache.recall(1, (HOLDING, 100, 4), 10.5, for_seconds=1) == bytes(range(8))


def test_a_write_to_the_device_itself_forgets_the_units_of_a_group_too_and_theirs_forgets_255() -> None:
    cache: ReadCache[str] = ReadCache(same_device=[{1, 2}])
    place = (HOLDING, 100, 4)
    _remembered(cache, unit=1)
    cache.write_begins(255)
    cache.write_ended(255)
    assert cache.recall(1, place, 10.5, for_seconds=1) is None
    _remembered(cache, unit=255)
    cache.write_begins(1)
    cache.write_ended(1)
    assert cache.recall(255, place, 10.5, for_seconds=1) is None

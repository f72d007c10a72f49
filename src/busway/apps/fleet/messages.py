"""Messages that carry the samples of one link in consecutive commits between collectors and sinks, in MessagePack.

1. No two messages have the same name, not even two attempts to send the same samples: a stream drops a message whose
   name it knows. A sink replaces samples with the same device, point and time.
2. ``complete`` is a commit of the same collector: the stream has acknowledged every sample up to that commit before
   this message was sent. A reader that takes the stream in order therefore has them all, if the stream has lost none.
3. A stream can lose messages that it has acknowledged: the last ones, when its server ends, and the oldest, when it is
   full. By the `Chain` of a message a reader sees that it lacks an earlier message of the same sender.
4. A message of another format is refused as a whole; nothing in it is guessed.
5. A message holds each name once, however many of its samples have it; samples refer to names by their place. Samples
   are held in columns; a column of places or reasons that are all below 256 is bytes, others are lists.
6. A message has at most `MOST_BYTES` bytes. An upper bound of its length is computed before it is encoded
   (`longest_head`, `longest_row`).
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import chain, count, starmap
from typing import Any, Final

from ...errors import ModbusError
from ...extras import require
from ..collector.store.committed_samples import CommittedSample
from .epoch import Epoch
from .ownership_gaps import OwnershipGap

FORMAT: Final = 4
MOST_BYTES: Final = 64 * 1024
"""Most bytes of one message."""


class UnreadableMessage(ModbusError):
    """Error: bytes from a stream are not a message with samples, or have a format that this program does not know."""


@dataclass(frozen=True, slots=True)
class Chain:
    """The place of a message in the sequence of messages that its sender has sent since its start.

    Attributes:
        start: a random number for one start of the sender; numbers of messages of different starts are not related.
        number: number of the message since that start, from 1; each attempt to send a message gets a new number.
        after: ``number`` of the last message that the stream had acknowledged before this one; 0 for none.
        is_first: whether the message is the first of a batch: the messages with the samples of all links in some
            commits.
    """

    start: int = 0
    number: int = 0
    after: int = 0
    is_first: bool = True


@dataclass(frozen=True, slots=True)
class SampleMessage:
    """A message with the samples of one link in consecutive commits.

    Attributes:
        collector: name of the collector that sends the message.
        store: a random word for the store of that collector; commits of different stores are not related.
        link: name of the link that the samples were read over; empty for devices without a link.
        epoch: epoch of the link's ownership in which the samples were taken; None for samples from before the fleet.
        revision: revision of the configuration with which the samples were taken; 0 if none is known.
        complete: number of the commit up to which the stream had acknowledged all samples of this store before this
            message was sent.
        kept: number of the commit up to which, as the sender knows, all sinks have the samples of this store. When the
            sender sends samples again, it never begins before that commit.
        samples: the samples in the order of their commits; their ``revision`` is not encoded. Empty in a message that
            only tells ``complete`` or a gap.
        chain: the place of the message among the messages of its sender.
        gap: a time before this epoch in which the link had no owner; the message then has no samples. None otherwise.
    """

    collector: str
    store: str
    link: str
    epoch: Epoch | None
    revision: int
    complete: int
    kept: int
    samples: Sequence[CommittedSample]
    chain: Chain = Chain()
    gap: OwnershipGap | None = None

    @property
    def name(self) -> str:
        """The name of the message, different for each attempt to send it; a stream drops a known name (rule 1)."""
        return f"{self.collector}/{self.store}/{self.chain.start:x}.{self.chain.number}"

    def encode(self) -> bytes:
        """Return the message as bytes in MessagePack. Raises `MissingExtra` without the package msgpack."""
        require("msgpack", "samples of a fleet")
        # One list of all fields, cut by steps. By zip, large messages take 20 % longer: it makes an iterator for each
        # sample, which the garbage collector counts.
        flat: list[Any] = list(chain.from_iterable(self.samples))  # of all types of fields
        commits, devices, points, times, half_widths, values, reasons, units = (
            flat[at :: len(CommittedSample._fields)] for at in range(8)
        )
        places: defaultdict[str, int] = defaultdict(count().__next__)  # of each name, by their first use
        place_of = places.__getitem__
        place_columns = [_small(list(map(place_of, names))) for names in (devices, points, units)]
        content = [
            FORMAT,
            self.collector,
            self.store,
            self.link,
            None if self.epoch is None else [self.epoch.generation, self.epoch.revision],
            self.revision,
            self.complete,
            self.kept,
            [self.chain.start, self.chain.number, self.chain.after, self.chain.is_first],
            None if self.gap is None else [self.gap.commit, self.gap.devices, self.gap.begin, self.gap.end],
            list(places),
            *place_columns,
            commits,
            times,
            half_widths,
            values,
            _small(reasons),
        ]
        pack: Callable[..., bytes] = import_module("msgpack").packb
        try:
            return pack(content, unicode_errors="surrogatepass")
        except OverflowError:  # an integer beyond 64 bits, which few points have
            content[-2] = list(map(_packed, values))
            return pack(content, unicode_errors="surrogatepass")


def decode_message(data: bytes) -> SampleMessage:
    """Return the message with samples that bytes from a stream hold.

    Raises:
        UnreadableMessage: the bytes are no message with samples, or have a format that this program does not know.
        MissingExtra: the package msgpack is not installed.
    """
    require("msgpack", "samples of a fleet")
    msgpack = import_module("msgpack")
    try:
        content = msgpack.unpackb(data, strict_map_key=False, unicode_errors="surrogatepass")
        if content[0] != FORMAT:
            raise UnreadableMessage(f"format {content[0]!r} is not known here: this program is older than its sender")
        _, collector, store, link, epoch, revision, complete, kept, *rest = content
        (start, number, after, is_first), found, names, *columns = rest
        devices, points, units = (map(names.__getitem__, places) for places in columns[:3])
        commits, times, half_widths, values, reasons = columns[3:]
        columns = [commits, devices, points, times, half_widths, map(_unpacked, values), reasons, units]
        samples = list(starmap(CommittedSample, zip(*columns, strict=True)))
        owned = None if epoch is None else Epoch(epoch[0], epoch[1])
        gap = None
        if found is not None and owned is not None:
            commit, devices, begin, end = found
            gap = OwnershipGap(link, owned, commit, tuple(devices), begin, end)
        return SampleMessage(
            collector,
            store,
            link,
            owned,
            revision,
            complete,
            kept,
            samples,
            Chain(start, number, after, is_first),
            gap,
        )
    except UnreadableMessage:
        raise
    except (ValueError, TypeError, AttributeError, LookupError, OverflowError, msgpack.UnpackException) as error:
        raise UnreadableMessage(f"the bytes are no message of samples: {str(error) or type(error).__name__}") from error


def by_link(samples: Sequence[CommittedSample], link_of: dict[str, str]) -> Iterator[tuple[str, list[CommittedSample]]]:
    """Yield for each link its name and its samples in their present order; the links in the order of their names.

    Args:
        samples: samples of any devices.
        link_of: by name of the device, the name of its link; samples of other devices have the link ``""``.
    """

    found: defaultdict[str, list[CommittedSample]] = defaultdict(list)
    for sample in samples:
        found[link_of.get(sample.device, "")].append(sample)
    yield from sorted(found.items())


def longest_head(*names: str) -> int:
    """Return an upper bound, in bytes, of the length of a message without its samples.

    Args:
        names: the names in it: collector, store and link, and the devices of a gap.
    """
    return _MOST_NUMBERS + sum(map(_longest_text, names))


def longest_row(sample: CommittedSample, known: set[str]) -> int:
    """Return an upper bound, in bytes, of what a sample adds to the length of a message in MessagePack.

    Args:
        sample: the sample.
        known: devices, points and units of measure of the samples before it in the same message, which are encoded
            once; those of this sample are added to the set.
    """
    names = 0
    for name in (sample.device, sample.point, sample.unit_of_measure):
        if name not in known:
            known.add(name)
            names += _longest_text(name)
    value = sample.value
    if isinstance(value, str):
        return _MOST_ROW + names + _longest_text(value)
    return _MOST_ROW + names + (len(str(value)) if type(value) is int else 0)


_MOST_NUMBERS: Final = 256
"""Bytes of all numbers and heads of lists of a message together: 15 numbers of 9 bytes, 14 heads of 5."""
_MOST_ROW: Final = 48
"""Bytes of a sample's numbers: commit, time, half width and value 9 each; reason and the places of three names 3 each.

A message of `MOST_BYTES` has no more than 2**16 names, because each takes at least one byte.
"""


def _longest_text(text: str) -> int:
    return 5 + len(text.encode("utf-8", "surrogatepass"))


def _small(numbers: list[int]) -> bytes | list[int]:
    """Return a column of numbers as bytes if each is below 256: just as long in MessagePack, and packed by one copy."""
    try:
        return bytes(numbers)
    except ValueError:
        return numbers


def _packed(value: Any) -> Any:
    """Return a value as it is encoded: unchanged, but an integer beyond 64 bits as a list with its decimal text."""
    if isinstance(value, int) and not -(2**63) <= value < 2**64:
        return [str(value)]
    return value


def _unpacked(value: Any) -> Any:
    return int(value[0]) if isinstance(value, list) else value

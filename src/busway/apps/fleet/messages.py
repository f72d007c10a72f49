"""Messages that carry the samples of one link in consecutive commits between collectors and sinks, in MessagePack.

1. A message is named by link, epoch, its commits and the round of its sender, and never as others. A sink replaces
   samples with the same device, point and time.
2. ``complete`` is a commit of the same collector: every sample up to it was acknowledged by the stream before this
   message was sent. What reads the stream in order therefore has them all.
3. A message of a newer format is refused as a whole, and told; nothing of it is guessed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import groupby
from typing import Any, Final

from ...errors import ModbusError
from ...extras import require
from ..collector.store.committed_samples import CommittedSample
from .lease_times import Epoch

FORMAT: Final = 1
MOST_ROWS: Final = 2000
"""Samples in one message: about 64 kB."""


class UnreadableMessage(ModbusError):
    """Error: received bytes are no message with samples."""


@dataclass(frozen=True, slots=True)
class SampleMessage:
    """A message with the samples of one link in consecutive commits.

    Attributes:
        collector: who sends them.
        store: a word for the store that they are from; another store has other commits.
        link, epoch: which link, and in which ownership of it they were taken; None for samples from before the fleet.
        revision: the revision of the configuration that they were taken by.
        complete: as in rule 2.
        kept: the commit that its sender would begin with if it sent again: it expects no sink to lack those up to it.
        part: which part of its commits it is, from 0.
        round: a number that its sender changes whenever it begins again; a stream that knows the earlier message takes
            this one too.
        samples: by commit, time and point; none in a message that only tells ``complete``.
    """

    collector: str
    store: str
    link: str
    epoch: Epoch | None
    revision: int
    complete: int
    kept: int
    part: int
    round: int
    samples: Sequence[CommittedSample]

    @property
    def name(self) -> str:
        """Return the name of the message, by which a stream drops one that it has already (rule 1)."""
        first, last = (self.samples[0].commit, self.samples[-1].commit) if self.samples else (0, self.complete)
        return f"{self.collector}/{self.store}/{self.link}/{self.epoch or 0}/{first}-{last}.{self.part}.{self.round}"

    def encode(self) -> bytes:
        """Return the message with samples as bytes."""
        require("msgpack", "samples of a fleet")
        columns = tuple(zip(*self.samples, strict=True)) or ((),) * 8
        commits, devices, points, times, half_widths, values, reasons, units = columns
        point_of = list(zip(devices, points, units, strict=True))
        places = {point: place for place, point in enumerate(dict.fromkeys(point_of))}
        content = [
            FORMAT,
            self.collector,
            self.store,
            self.link,
            None if self.epoch is None else [self.epoch.generation, self.epoch.revision],
            self.revision,
            self.complete,
            self.kept,
            self.part,
            self.round,
            list(places),
            [places[point] for point in point_of],
            commits,
            times,
            half_widths,
            [_packed(value) if type(value) is int else value for value in values],
            reasons,
        ]
        packed: bytes = import_module("msgpack").packb(content)
        return packed


def decode_message(data: bytes) -> SampleMessage:
    """Return the message with samples that bytes hold. Raises `UnreadableMessage`."""
    require("msgpack", "samples of a fleet")
    msgpack = import_module("msgpack")
    try:
        content = msgpack.unpackb(data, strict_map_key=False)
        if content[0] != FORMAT:
            raise UnreadableMessage(f"format {content[0]!r} is not known here: this program is older than its sender")
        _, collector, store, link, epoch, revision, complete, kept, part, round_number, points, *columns = content
        samples = [
            CommittedSample(
                commit, points[place][0], points[place][1], time, half, _unpacked(value), reason, points[place][2]
            )
            for place, commit, time, half, value, reason in zip(*columns, strict=True)
        ]
        return SampleMessage(
            collector,
            store,
            link,
            None if epoch is None else Epoch(epoch[0], epoch[1]),
            revision,
            complete,
            kept,
            part,
            round_number,
            samples,
        )
    except UnreadableMessage:
        raise
    except (ValueError, TypeError, IndexError, KeyError, msgpack.UnpackException) as error:
        raise UnreadableMessage(f"the bytes are no message of samples: {error or type(error).__name__}") from error


def by_link(samples: Sequence[CommittedSample], link_of: dict[str, str]) -> Iterator[tuple[str, list[CommittedSample]]]:
    """Return samples by link, in their order; those of devices without a link under an empty name."""

    def link(sample: CommittedSample) -> str:
        return link_of.get(sample.device, "")

    for name, found in groupby(sorted(samples, key=link), key=link):
        yield name, list(found)


def _packed(value: Any) -> Any:
    """Return a value as MessagePack can hold it: integers beyond 64 bits as text in a list."""
    if isinstance(value, int) and not -(2**63) <= value < 2**64:
        return [str(value)]
    return value


def _unpacked(value: Any) -> Any:
    return int(value[0]) if isinstance(value, list) else value

"""Gaps of ownership: times in which a link had no owner, because the former one fell silent.

Pure: knows no file, stream or sink.

1. The new owner records a gap, from the last renewal of the lease before to the begin of its own ownership. The former
   owner may have gone on for a while after that renewal.
2. Nothing of a device is missing before its newest sample in the gap, so the time of that sample is the true begin.
   It may be a sample of either owner, and may arrive late: a later one moves the begin, an earlier one does nothing.
   The order in which samples arrive does not matter.
3. An interval without reads that an owner has recorded (`Reason.OWNERSHIP`) is no sample in this sense.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from .lease_times import Epoch


@dataclass(frozen=True, slots=True)
class OwnershipGap:
    """A time in which a link had no owner, as its next owner has recorded it.

    Attributes:
        link: name of the link.
        epoch: epoch of the ownership that ended the gap.
        commit: the number after that of the last commit of the new owner before it: its first sample in ``epoch`` has
            this commit or a later one.
        devices: names of the devices of the link.
        begin: nanoseconds since 1970 UTC of the last renewal by the former owner.
        end: nanoseconds since 1970 UTC; the first sample of the new owner is later.
    """

    link: str
    epoch: Epoch
    commit: int
    devices: tuple[str, ...]
    begin: int
    end: int


def true_begin(begin: int, end: int, times: Iterable[int]) -> int:
    """Return when a gap of a device really began: at its newest sample within the gap, else at ``begin`` (rule 2).

    Args:
        begin: begin of the gap as it was recorded, nanoseconds since 1970 UTC.
        end: its end.
        times: times of samples of the device, in any order; those outside of the gap do not matter.
    """
    return max((time for time in times if begin <= time < end), default=begin)
